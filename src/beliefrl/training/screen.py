"""Screens that show progress: live in a terminal and in a notebook, and as lines in a log."""

import base64
import contextlib
import io
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

SILENCE = 60.0  # seconds without a line, after which a log gets the status
PACE = 0.25  # seconds between two statuses in a notebook


def duration(seconds: float) -> str:
    """Seconds as 12 s, 3:04 or 1:02:03."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


class Output(Console):
    """A console that does not end the program if nobody reads its output any more."""

    def on_broken_pipe(self) -> None:
        """Write to nowhere from now on."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Screen:
    """Progress in a log: only lines. After `SILENCE` seconds without a line, the status is printed."""

    is_live = False  # whether a status is visible at once

    def __init__(self, console: Console, patience: float = SILENCE):
        """`patience`: seconds without a line before the first status is printed."""
        self.console, self.began = console, time.monotonic()
        self._status, self._printed = "", self.began + patience - SILENCE
        self._is_over = threading.Event()

    def __enter__(self) -> "Screen":
        threading.Thread(target=self._break_silence, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()

    def line(self, text: str) -> None:
        """Print a line that stays, with the time since the start."""
        self._printed = time.monotonic()
        self.show(self.stamped(text))

    def stamped(self, text: str) -> str:
        """The text with the time since the start."""
        return f"[{duration(time.monotonic() - self.began)}] {text}"

    def show(self, what: RenderableType) -> None:
        """Print something that stays."""
        with self.unless_gone():
            self.console.print(what, markup=False, highlight=False, soft_wrap=isinstance(what, str))

    @contextlib.contextmanager
    def unless_gone(self) -> Iterator[None]:
        """If the output cannot be written any more, show nothing from then on. The training continues."""
        try:
            yield
        except OSError:
            self.console.quiet = True

    def status(self, text: str, live: RenderableType) -> None:
        """Replace the status. A log prints `text`, a live screen shows `live`."""
        self._status = text

    def picture(self, draw: Callable[[], bytes | None]) -> None:
        """If pictures can be shown, show the PNG that `draw` returns in place of the previous one.

        If it returns None, change nothing.
        """

    def _break_silence(self) -> None:
        while not self._is_over.wait(max(self._printed + SILENCE - time.monotonic(), 0.1)):
            if time.monotonic() - self._printed >= SILENCE:
                with contextlib.suppress(ValueError):  # the output was closed
                    self.line(self._status)


class Terminal(Screen):
    """Progress in a terminal: the status stays at the bottom."""

    is_live = True

    def __enter__(self) -> "Terminal":
        self._live = Live("", console=self.console, transient=True)
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def status(self, text: str, live: RenderableType) -> None:
        with self.unless_gone():
            self._live.update(live)


class Notebook(Screen):
    """Progress in a notebook: a text whose end is the status, and a picture below it. Both are replaced in place."""

    is_live = True

    def __enter__(self) -> "Notebook":
        self._lines, self._shown, self._changed = "", None, 0.0
        self._handles: dict[str, Any] = {}
        return self

    def __exit__(self, *_: object) -> None:
        self._update("")

    def show(self, what: RenderableType) -> None:
        """Add `what` to the text."""
        self._lines += self._text(what)
        self._update("")

    def status(self, text: str, live: RenderableType) -> None:
        if time.monotonic() - self._changed >= PACE:
            self._changed = time.monotonic()
            self._update(self._text(live))

    def picture(self, draw: Callable[[], bytes | None]) -> None:
        png = draw()
        if png is not None:
            self._display("picture", {"image/png": base64.b64encode(png).decode(), "text/plain": "<picture>"})

    def _update(self, status: str) -> None:
        text = (self._lines + status).rstrip()
        if text != self._shown:
            self._shown = text
            self._display("text", {"text/plain": text} if text else {})

    def _text(self, what: RenderableType) -> str:
        console = Console(file=io.StringIO(), width=100, color_system=None, force_terminal=False, force_jupyter=False)
        with console.capture() as captured:
            console.print(what, markup=False, highlight=False, soft_wrap=isinstance(what, str))
        return "".join(line.rstrip() + "\n" for line in captured.get().splitlines())

    def _display(self, name: str, content: dict[str, Any]) -> None:
        from IPython.display import display

        if name in self._handles:
            self._handles[name].update(content, raw=True)
        else:
            self._handles[name] = display(content, raw=True, display_id=True)


def screen(patience: float = SILENCE) -> Screen:
    """The screen of this process. `patience` is as in `Screen`."""
    console = Output()
    kind = Notebook if console.is_jupyter else Terminal if console.is_terminal else Screen
    return kind(console, patience)


@contextlib.contextmanager
def playing(episodes: int) -> Iterator[Callable[[int], None]]:
    """Show the progress of `episodes` episodes. Yields a function to call with the number of finished episodes."""
    shown = screen(patience=3.0)
    columns: Any = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    progress = Progress(*columns, auto_refresh=False)
    bar = progress.add_task(f"playing {episodes:,} episodes", total=None)

    def ended(count: int) -> None:
        progress.update(bar, completed=count, total=episodes if count else None)
        done = f"{count:,} of {episodes:,} episodes are over" if count else f"playing {episodes:,} episodes"
        shown.status(done, progress)

    with shown:
        ended(0)
        yield ended
