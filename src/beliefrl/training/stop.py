"""Ctrl-C and SIGTERM: the first is a request, the second leaves at once."""

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
ONE_REQUEST = 0.3  # seconds in which several are one: a parent that dies may send one for each of its threads


class Stopped(KeyboardInterrupt):
    """A training was left at somebody's request; its message says how to go on."""

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.exit_code = 128 + number


class Requests:
    """While entered, the first signal is kept in `number`; a later one ends the program in that moment.

    Python runs handlers between two of its own instructions, so one that comes while a compiled function runs waits
    for it. A thread is therefore told of each signal by the system at once: it answers the first, and the second ends
    the program.
    """

    def __init__(self, answer: Callable[[], None] = lambda: None):
        """`answer` is called once, by that thread, at the first signal."""
        self.number: int | None = None
        self._answer = answer
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Requests":
        if threading.current_thread() is not threading.main_thread():
            return self  # only there can signals be handled
        self._ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        self._theirs = theirs
        threading.Thread(target=self._watch, args=(self._ours,), daemon=True).start()
        self._fd = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
        for number in SIGNALS:
            self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        if not self._before:
            return
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}
        signal.set_wakeup_fd(self._fd)
        self._theirs.close()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.number is None:
            self.number = number

    def _watch(self, ours: socket.socket) -> None:
        first = None
        with ours:
            while told := ours.recv(1):
                if told[0] in SIGNALS:
                    now = time.monotonic()
                    if first is None:
                        first = now
                        with contextlib.suppress(Exception):  # the second signal must be heard all the same
                            self._answer()
                    elif now - first > ONE_REQUEST:
                        os._exit(128 + told[0])
