"""Videos and film strips of trained agents.

A video is an mp4 file or a GIF (`encoders`), or shown in a window (by pygame, extra `render`). A film strip has one row
of frames per run, evenly spaced in time (Appendix "Visualization of Trained Agents").
"""

import functools
import math
import os
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from beliefrl.agents import Agent, is_own
from beliefrl.analysis import figures
from beliefrl.errors import UserError
from beliefrl.runs.given_files import check_folder
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.drawing import INK, PAPER, Viewer
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.restore import restore_seed
from beliefrl.types import LARGEST, check_whole
from beliefrl.viewing.encoders import Writer, encoder
from beliefrl.viewing.episodes import Frame, Pixels, Player, Trajectory, check_episode, pace_of

FASTEST = 50.0  # frames per second that GIFs and screens can show


def video(
    run: Run | str | os.PathLike[str],
    path: str | os.PathLike[str] | None,
    seed: int | None = None,
    episode_seed: int = 0,
    sampled: bool = False,
    episodes: int = 1,
    fps: float | None = None,
    steps: int | None = None,
    task: Task | GymnasiumTask | type | None = None,
    agent: Agent | type | None = None,
    best: bool = False,
    fastest: float = FASTEST,
) -> list[Trajectory]:
    """Record a video of a run's trained agent; returns the episodes, without frames. No file is left half written.

    Args:
        run: a run, or its folder.
        path: the video, .mp4 or .gif. An existing file is replaced. None: a window shows the episodes, which needs a
            display and pygame.
        seed: one of the run's seeds; None: its first.
        episode_seed: random seed of the first episode; the next episodes have the following seeds.
        sampled: sample the actions, instead of taking the policy's mode.
        episodes: number of episodes, shown one after the other.
        fps: timesteps per second of the video, each with a frame. None: real time, with at most `fastest` frames per
            second; a task whose step has no known duration gets 10 steps per second.
        steps: stop each episode after this many steps; None: play until the task ends it.
        task: needed only if the run was trained on a task of your own: that task, or the class of its environments.
        agent: needed only if the run was trained by an agent of your own: its class, or an instance.
        best: take the seed's best agent, not its last one; see `evaluate`.
        fastest: the highest number of frames per second if `fps` is None.

    Raises:
        UserError: there is no such run or seed, a number is impossible, the task cannot be rendered, imageio-ffmpeg is
            missing, the file cannot be written, or no window can be opened.
        KeyboardInterrupt: the window was closed.
    """
    check_episode(episode_seed, steps)
    check_whole("episodes", episodes, 1)
    for name, rate in {"fps": fps, "fastest": fastest}.items():
        if rate is not None and (isinstance(rate, str) or not 0 < rate <= 1000):
            raise UserError(f"{name}={rate!r} is impossible: it must be a number above 0 and up to 1000.")
    show = _window
    if path is not None:  # absolute: an environment may change the working directory
        show = functools.partial(encoder, pathlib.Path(path).absolute(), kind_of(pathlib.Path(path)))
    with Player(*restore_seed(run, seed, task, agent, best), rendered=True) as player:
        pace = pace_of(player.environment)
        every = 1 if fps else math.ceil(pace / fastest)
        with show(fps or pace / every) as add:
            return [
                player.play(
                    episode_seed + index, sampled, steps, range(0, LARGEST, every), _captioned(add, index, episodes)
                )
                for index in range(episodes)
            ]


@contextmanager
def _window(fps: float) -> Iterator[Writer]:
    """A function that shows a frame in a window."""
    viewer = Viewer("BeliefRL")

    def add(pixels: Pixels) -> None:
        viewer.show(pixels, fps)
        if viewer.is_closed:
            raise KeyboardInterrupt("the window was closed.")

    try:
        yield add
    finally:
        viewer.close()


def kind_of(path: pathlib.Path) -> str:
    """The file type of a video, ".mp4" or ".gif".

    Raises:
        UserError: it is neither, imageio-ffmpeg is missing, or the folder of the video does not exist.
    """
    kind = path.suffix.lower()
    if kind not in (".mp4", ".gif"):
        raise UserError(f"{path} is impossible: the name of a video must end in .mp4 or .gif.")
    if kind == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise UserError("An mp4 needs imageio-ffmpeg: pip install 'beliefrl[video]', or make a .gif.") from None
    check_folder(path)
    return kind


def _captioned(add: Writer, index: int, episodes: int) -> Callable[[Frame], None]:
    """A function that adds a frame of an episode, with its step and return below."""
    which = f"episode {index + 1}   " if episodes > 1 else ""

    def watch(frame: Frame) -> None:
        add(caption(frame.pixels, f"{which}step {frame.time}   return {frame.total:.1f}"))

    return watch


def caption(pixels: Pixels, text: str) -> UInt8[np.ndarray, "taller wider 3"]:
    """The picture with a line of text below it. Width and height are even, as video encoders require."""
    height, width, _ = pixels.shape
    size = max(12, width // 30)
    image = Image.new("RGB", (width + width % 2, height + 2 * size + height % 2), PAPER)
    image.paste(Image.fromarray(pixels), (0, 0))
    at = (size, height + size)
    ImageDraw.Draw(image).text(at, text, INK, ImageFont.load_default(size), anchor="lm")
    return np.array(image)


def film(
    runs: Sequence[Run | str | os.PathLike[str]] | Run | str | os.PathLike[str],
    path: str | os.PathLike[str] | None = None,
    frames: int = 8,
    seed: int | None = None,
    episode_seed: int = 0,
    sampled: bool = False,
    steps: int | None = None,
    task: Task | GymnasiumTask | type | None = None,
    agent: Agent | type | None = None,
    best: bool = False,
    start: int = 0,
) -> pathlib.Path:
    """Draw a film strip: one row per run, with evenly spaced frames of one episode, up to its last step.

    The step is written below each frame. Writes a PNG and a PDF; returns the path of the PNG.

    Args:
        runs: runs or their folders, or one of them.
        path: the PNG or the PDF; None: film.png in the first run's folder.
        frames: number of frames in a row.
        seed: one of each run's seeds; None: its first.
        episode_seed: random seed of the episodes.
        sampled: sample the actions, instead of taking the policy's mode.
        steps: stop the episodes after this many steps; None: play until the task ends them.
        task: needed only if the runs were trained on a task of your own: that task, or the class of its environments.
        agent: needed only if the run was trained by an agent of your own: its class, or an instance.
        best: take the seed's best agent, not its last one; see `evaluate`.
        start: step of the first frame, counted as `steps` from the start of the episode.

    Raises:
        UserError: there is no such run or seed, a number is impossible, an episode ends at or before `start`, or a
            task cannot be rendered.
    """
    check_episode(episode_seed, steps)
    check_whole("frames", frames, 2, 100)
    check_whole("start", start, 0)
    if steps is not None and start >= steps:
        raise UserError(f"start={start} is impossible: it must be less than steps={steps}.")
    if not runs:
        raise UserError("RUN is missing: give one or more runs.")
    given = runs if isinstance(runs, Iterable) and not isinstance(runs, str) else [runs]
    runs = [run if isinstance(run, Run) else Run(run) for run in given]
    path = pathlib.Path(path or runs[0].folder / "film.png")
    png, place = figures.paths(path)[0], path.absolute()  # an environment may change the working directory
    own = [agent if is_own(run.config["agent"]) else None for run in runs]
    rows = [
        _strip(run, restore_seed(run, seed, task, made_by, best), frames, start, (episode_seed, sampled, steps))
        for run, made_by in zip(runs, own, strict=True)
    ]
    figures.save(_draw_strips(runs, rows), place)
    return png


def _strip(
    run: Run, restored: tuple[Agent, Any, Any, str], frames: int, start: int, episode: tuple[int, bool, int | None]
) -> Trajectory:
    """An `episode` (seed, sampled, steps) with evenly spaced frames; played twice, first to find its length."""
    with Player(*restored, rendered=True) as player:
        length = len(player.play(*episode).steps.reward) - 1
        if start >= length:
            raise UserError(f"start={start} is impossible: the episode of {run.shown} ends at step {length}.")
        at = {round(time) for time in np.linspace(start, length, frames)}
        return player.play(*episode, at)


def _draw_strips(runs: Sequence[Run], rows: Sequence[Trajectory]) -> Any:
    """The figure: all frames have the same width, with the step below; each row has a title."""
    side, gap, above, below = 1.5, 0.06, 0.28, 0.26  # inches
    ratios = [max(frame.shape[0] / frame.shape[1] for frame in row.frames.values()) for row in rows]
    width = side * max(len(row.frames) for row in rows)
    height = sum(side * ratio + above + below for ratio in ratios)
    figure, top = figures.figure(width, height, layout=None), height
    for run, row, ratio in zip(runs, rows, ratios, strict=True):
        title = f"{run.config['agent']} on {run.config['task']}, {row.summary}"
        figure.text(gap / width, (top - 0.2) / height, title, fontsize=9)
        low = top - above - side * ratio
        for index, (time, pixels) in enumerate(row.frames.items()):
            left = side * index + gap
            place = (left / width, low / height, (side - 2 * gap) / width, side * ratio / height)
            axis = figure.add_axes(place)
            axis.imshow(pixels)
            axis.set_axis_off()
            figure.text((left + side / 2 - gap) / width, (low - 0.14) / height, f"step {time}", ha="center", fontsize=8)
        top = low - below
    return figure
