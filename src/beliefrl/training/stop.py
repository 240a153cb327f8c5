"""Ctrl-C, SIGTERM and SIGHUP: the first asks a training to stop, a second Ctrl-C ends the program at once.

The other signals do so only after a while: schedulers and sweeps may send one each. SIGHUP comes when the terminal is
closed. After `nohup` it is ignored.

If a program does not catch `Stopped`, it ends with the sentence and the exit code of `Stopped`, without a traceback.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType, TracebackType
from typing import Any

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
ONE_REQUEST = 0.3  # seconds in which several signals count as one, because a dying parent may send one per thread
PATIENCE = 30.0  # the same for the other signals, because a scheduler and a sweep may both send one


class Stopped(KeyboardInterrupt):
    """A training was stopped by a signal. The message says how to continue it.

    If it is not caught, a script ends with this sentence and `exit_code`: 130 for Ctrl-C, 143 for SIGTERM, 129 for
    SIGHUP. In an interactive session or a notebook the sentence is shown, and the session continues.
    """

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.exit_code = 128 + number

    def _render_traceback_(self) -> list[str]:
        """The lines that IPython shows in place of a traceback."""
        return [f"beliefrl: {self}"]


def _is_another(number: int, since: float) -> bool:
    """Whether a signal that comes so many seconds after the first is a request of its own."""
    return since > (ONE_REQUEST if number == signal.SIGINT else PATIENCE)


class Waiting:
    """A handler while a program imports modules: the first signal waits, and a second one ends the program.

    Python's own handler raises an exception in the middle of an import, where it can be lost.
    """

    received: float | None = None  # when

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.received is None:
            self.received = time.monotonic()
        elif _is_another(number, time.monotonic() - self.received):
            os._exit(128 + number)


@contextlib.contextmanager
def waiting() -> Iterator[None]:
    """A Ctrl-C in this block waits for `Requests` in it, or for the end of the block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = Waiting()
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if handler.received is not None:
        raise KeyboardInterrupt


class Requests:
    """Inside the `with` block, the first signal is stored in `number`. A later Ctrl-C ends the program at once, and so
    does another signal that comes PATIENCE seconds after the first.

    In an interactive session a later signal raises Stopped as soon as a compiled function returns, so the variables of
    the session are not lost. A Stopped that nobody catches is shown without a traceback.

    Python runs handlers between two of its own instructions, so a signal during a compiled function waits until the
    function returns. Therefore the system also writes each signal to a socket at once. A thread reads the socket. It
    confirms the first signal and ends the program at the next request.
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
        waited, first = signal.getsignal(signal.SIGINT), None
        if isinstance(waited, Waiting) and waited.received is not None:
            first, waited.received = waited.received, None
            self.number, self._heard = signal.SIGINT, first
            self._confirm()
        threading.Thread(target=self._watch, args=(self._ours, first), daemon=True).start()
        self._fd = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
        for number in SIGNALS:
            if number in (signal.SIGINT, signal.SIGTERM) or signal.getsignal(number) != signal.SIG_IGN:  # by `nohup`
                self._before[number] = signal.signal(number, self._handle)
        return self

    def renew(self) -> None:
        """Install the handlers again, if an environment has replaced them."""
        for number in self._before:
            if signal.getsignal(number) != self._handle:
                signal.signal(number, self._handle)
                signal.set_wakeup_fd(self._theirs.fileno(), warn_on_full_buffer=False)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and issubclass(kind, Stopped):
            _show_without_traceback()
        if not self._before:
            return
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}
        signal.set_wakeup_fd(self._fd)
        self._theirs.close()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.number is None:
            self.number, self._heard = number, time.monotonic()
        elif is_interactive() and _is_another(number, time.monotonic() - self._heard):
            raise Stopped("stopped at once; what was logged and saved stays in the run's folder.", number)

    def _watch(self, ours: socket.socket, first: float | None) -> None:
        with ours:
            while received := ours.recv(1):
                if received[0] in SIGNALS:
                    now = time.monotonic()
                    if first is None:
                        first = now
                        with contextlib.suppress(Exception):  # an error of `confirm` must not stop the thread
                            self._confirm()
                    elif _is_another(received[0], now - first) and not is_interactive():
                        os._exit(128 + received[0])


def is_interactive() -> bool:
    """Whether the session is interactive: a prompt of Python or IPython, or a notebook."""
    return hasattr(sys, "ps1") or bool(sys.flags.interactive)


def _show_without_traceback() -> None:
    """From now on, show an uncaught Stopped as a sentence and an exit code.

    This replaces Python's hook for uncaught exceptions, and passes all other exceptions on to the previous hook.
    """
    before = sys.excepthook

    def show(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if not isinstance(error, Stopped):
            before(kind, error, trace)
            return
        print(f"beliefrl: {error}", file=sys.stderr)
        if not is_interactive():
            raise SystemExit(error.exit_code)

    sys.excepthook = show
