"""Films and film strips of trained agents.

A film is an mp4 (imageio-ffmpeg brings the encoder; extra `video`) or a GIF (Pillow). A film strip is a row of frames
for each run, evenly spaced in time (Appendix "Visualization of Trained Agents").
"""

import math
import os
import pathlib
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from beliefrl.agents import Agent, is_own
from beliefrl.analysis import figures
from beliefrl.runs.arrays import replacing
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.drawing import INK, PAPER
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.evaluation import restore_seed
from beliefrl.types import LARGEST, UserError
from beliefrl.viewing import rendering
from beliefrl.viewing.episodes import Frame, Player, Trajectory, check_episode
from beliefrl.viewing.rendering import Pixels

FASTEST = 50  # frames a second: what both a GIF and a screen can show
Writer = Callable[[Pixels], None]


def video(
    run: Run | str | os.PathLike[str],
    path: str | os.PathLike[str],
    seed: int | None = None,
    episode_seed: int = 0,
    sampled: bool = False,
    episodes: int = 1,
    fps: float | None = None,
    steps: int | None = None,
    task: Task | GymnasiumTask | None = None,
    agent: Agent | type | None = None,
) -> list[Trajectory]:
    """Film episodes of what a run has learned; returns them, without frames. The file is there whole or not at all.

    Args:
        run: a run, or its folder.
        path: of the film, .mp4 or .gif; a file that is there is replaced.
        seed: which of the run's seeds; None is its first.
        episode_seed: of the first episode; the next ones have the numbers that follow.
        sampled: whether actions are sampled; else they are the policy's mode.
        episodes: how many, one after the other.
        fps: steps in a second of the film, a frame each; None is real time (10 where the task does not tell its time),
            in which steps beyond 50 a second are left out.
        steps: end each episode after so many; None: when the task does.
        task: needed only where the run was trained on a task of your own.
        agent: needed only where an agent of your own was trained: its class, or one of them.

    Raises:
        UserError: there is no such run or seed, a number is impossible, the task cannot be rendered, imageio-ffmpeg is
            missing, or the file cannot be written.
    """
    path = pathlib.Path(path)
    check_episode(episode_seed, steps)
    if not 1 <= episodes <= LARGEST:
        raise UserError(f"episodes={episodes} is impossible: it must be a whole number of at least 1.")
    if fps is not None and not 0 < fps <= 1000:
        raise UserError(f"fps={fps} is impossible: it must be a number above 0 and up to 1000.")
    kind = _kind(path)
    figures.check_folder(path)
    with Player(*restore_seed(run, seed, task, agent), rendered=True) as player:
        pace = rendering.pace(player.environment)
        every = 1 if fps else math.ceil(pace / FASTEST)
        with _written(path, kind, fps or pace / every) as add:
            return [
                player.play(
                    episode_seed + index, sampled, steps, range(0, LARGEST, every), _captioned(add, index, episodes)
                )
                for index in range(episodes)
            ]


def _kind(path: pathlib.Path) -> str:
    """How the film is to be encoded."""
    kind = path.suffix.lower()
    if kind not in (".mp4", ".gif"):
        raise UserError(f"{path} is impossible: a film is an mp4 or a gif, so end its name as .mp4 or .gif.")
    if kind == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise UserError("An mp4 needs imageio-ffmpeg: pip install 'beliefrl[video]', or make a .gif.") from None
    return kind


def _captioned(add: Writer, index: int, episodes: int) -> Callable[[Frame], None]:
    """Adds an episode's frames with a line below them."""
    which = f"episode {index + 1}   " if episodes > 1 else ""

    def watch(frame: Frame) -> None:
        add(caption(frame.pixels, f"{which}step {frame.time}   return {frame.total:.1f}"))

    return watch


def caption(pixels: Pixels, text: str) -> UInt8[np.ndarray, "taller wider 3"]:
    """The picture with a line of text below it; both sides are even, as video encoders want them."""
    height, width, _ = pixels.shape
    size = max(12, width // 30)
    image = Image.new("RGB", (width + width % 2, height + 2 * size + height % 2), PAPER)
    image.paste(Image.fromarray(pixels), (0, 0))
    at = (size, height + size)
    ImageDraw.Draw(image).text(at, text, INK, ImageFont.load_default(size), anchor="lm")
    return np.array(image)


@contextmanager
def _written(path: pathlib.Path, kind: str, fps: float) -> Iterator[Writer]:
    """A function that adds a frame to the film."""
    write, shapes = {".mp4": _mp4, ".gif": _gif}[kind], set()
    try:
        with replacing(path) as temporary, write(temporary, fps) as add:

            def checked(pixels: Pixels) -> None:
                shapes.add(pixels.shape)
                if len(shapes) > 1:
                    raise UserError("The environment renders frames of different sizes: make it keep to one.")
                add(pixels)

            yield checked
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror or error}): choose another file.") from None


@contextmanager
def _mp4(path: pathlib.Path, fps: float) -> Iterator[Writer]:
    """H.264 that any player shows; frames go to ffmpeg one by one."""
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

    # Its own writer forks a process in which JAX runs threads, which may never return.
    encoding = [
        "-c:v",
        "libx264",
        "-pix_fmt",
        "yuv420p",
        "-crf",
        "18",
        "-movflags",
        "+faststart",
        "-f",
        "mp4",
        str(path),
    ]
    encoder: Any = None

    def add(pixels: Pixels) -> None:
        nonlocal encoder
        if encoder is None:
            size = f"{pixels.shape[1]}x{pixels.shape[0]}"
            given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{fps}", "-i", "-"]
            command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", *given, *encoding]
            pipe = subprocess.PIPE  # Ctrl-C is not meant for it
            encoder = subprocess.Popen(command, stdin=pipe, stderr=pipe, start_new_session=True)
        encoder.stdin.write(pixels.tobytes())

    try:
        yield add
        told = encoder.communicate()[1].decode(errors="replace").strip()
        if encoder.returncode:
            raise OSError(told)
    finally:
        if encoder is not None and encoder.poll() is None:
            encoder.kill()
            encoder.communicate()


@contextmanager
def _gif(path: pathlib.Path, fps: float) -> Iterator[Writer]:
    """Frames are kept with 256 colours each until the last one is there."""
    frames: list[Image.Image] = []
    yield lambda pixels: frames.append(Image.fromarray(pixels).quantize(dither=Image.Dither.NONE))
    delay = max(2, round(100 / fps)) * 10  # milliseconds, of which a GIF knows tens
    frames[0].save(path, "GIF", save_all=True, append_images=frames[1:], duration=delay, loop=0)


def film(
    runs: Sequence[Run | str | os.PathLike[str]],
    path: str | os.PathLike[str] | None = None,
    frames: int = 8,
    seed: int | None = None,
    episode_seed: int = 0,
    sampled: bool = False,
    steps: int | None = None,
    task: Task | GymnasiumTask | None = None,
    agent: Agent | type | None = None,
) -> pathlib.Path:
    """Draw a film strip: a row for each run, of one episode's frames, evenly spaced, from its first moment to its last.

    Below each frame is its step. Writes a PNG and a PDF, returns the first.

    Args:
        runs: runs, or their folders.
        path: of the PNG or the PDF; None is film.png in the first run's folder.
        frames: in a row.
        seed: which of each run's seeds; None is its first.
        episode_seed: of the episodes.
        sampled: whether actions are sampled; else they are the policy's mode.
        steps: end the episodes after so many; None: when the task does.
        task: needed only where the runs were trained on a task of your own.
        agent: needed only where agents of your own were trained: their class, or one of them. Runs of other agents are
            drawn without it.

    Raises:
        UserError: there is no such run or seed, a number is impossible, or a task cannot be rendered.
    """
    check_episode(episode_seed, steps)
    if not 2 <= frames <= 100:
        raise UserError(f"frames={frames} is impossible: it must be a whole number from 2 to 100.")
    if not runs:
        raise UserError("RUN is missing: give one run or more.")
    runs = [run if isinstance(run, Run) else Run(run) for run in runs]
    path = pathlib.Path(path or runs[0].folder / "film.png")
    figures.paths(path)
    own = [agent if is_own(run.config["agent"]) else None for run in runs]
    rows = [
        _strip(run, frames, seed, episode_seed, sampled, steps, task, made_by)
        for run, made_by in zip(runs, own, strict=True)
    ]
    return figures.save(_draw_strips(runs, rows), path)


def _strip(
    run: Run, frames: int, seed: int | None, episode_seed: int, sampled: bool, steps: int | None, task: Any, agent: Any
) -> Trajectory:
    """An episode with evenly spaced frames. It is played twice: only then is it known how long it is."""
    with Player(*restore_seed(run, seed, task, agent), rendered=True) as player:
        length = len(player.play(episode_seed, sampled, steps).steps.reward) - 1
        at = {round(time) for time in np.linspace(0, length, frames)}
        return player.play(episode_seed, sampled, steps, at)


def _draw_strips(runs: Sequence[Run], rows: Sequence[Trajectory]) -> Any:
    """Every frame is as wide as the others, with its step below it, and above each row what it is of."""
    side, gap, above, below = 1.5, 0.06, 0.28, 0.26  # inches
    ratios = [max(frame.shape[0] / frame.shape[1] for frame in row.frames.values()) for row in rows]
    width = side * max(len(row.frames) for row in rows)
    height = sum(side * ratio + above + below for ratio in ratios)
    figure, top = figures.figure(width, height, layout=None), height
    for run, row, ratio in zip(runs, rows, ratios, strict=True):
        reached = {None: "", True: ", success", False: ", no success"}[row.success]
        title = f"{run.config['agent']} on {run.config['task']}, return {row.total:.1f}{reached}"
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
