"""Ctrl-C and SIGTERM: the first asks a training to stop, the second ends the program at once."""

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
ONE_REQUEST = 0.3  # seconds in which several signals count as one: a parent that dies may send one per thread


class Stopped(KeyboardInterrupt):
    """A training was stopped by a signal; its message says how to go on."""

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.exit_code = 128 + number


class Requests:
    """While entered, the first signal is kept in `number`; a later one ends the program at once.

    Python runs handlers between two of its own instructions, so a signal during a compiled function waits until that
    returns. The system therefore also writes each signal to a socket at once. A thread reads it: it confirms the first
    signal and ends the program at the second.
    """

    def __init__(self, confirm: Callable[[], None] = lambda: None):
        """`confirm` is called once, by that thread, at the first signal."""
        self.number: int | None = None
        self._confirm = confirm
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Requests":
        if threading.current_thread() is not threading.main_thread():
            return self  # Python handles signals there only
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
            while received := ours.recv(1):
                if received[0] in SIGNALS:
                    now = time.monotonic()
                    if first is None:
                        first = now
                        with contextlib.suppress(Exception):  # an error of `confirm` must not stop the thread
                            self._confirm()
                    elif now - first > ONE_REQUEST:
                        os._exit(128 + received[0])
