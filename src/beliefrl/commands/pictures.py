"""What a trained agent believes and does: `beliefrl predict`, `video` and `film`."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Annotated

import tyro

from beliefrl.commands.arguments import OwnAgent, own_agent, parse


@dataclasses.dataclass(frozen=True)
class PredictOptions:
    """Draw what a run's model predicts of an episode, beside the truth: open loop and closed loop, with their σ."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    out: pathlib.Path | None = None
    """The picture, written as PNG and as PDF. None: predictions.png in the run's folder."""
    model: str | None = None
    """Which model: keep or first of vrm, latent of slac. None: the first of these that the agent has."""
    start: int | None = None
    """Moments that the closed loop sees. None: 50, or half of a shorter episode."""
    horizon: int = 100
    """Moments that it predicts then, as far as the episode goes."""
    samples: int = 32
    """Draws whose mean each prediction is."""
    entries: tuple[int, ...] = ()
    """Entries of the observation to draw, in the numbers of --observe. None given: the first six that are seen."""
    seed: int | None = None
    """Which of the run's seeds; None is its first."""
    episode_seed: int = 0
    """Of the episode, its actions and the draws: the same one gives the same picture."""
    sampled: bool = False
    """Actions are sampled; else they are the policy's mode."""
    agent: OwnAgent = None


@dataclasses.dataclass(frozen=True)
class VideoOptions:
    """Film episodes of what a run has learned."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    out: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="FILE")]
    """The film, .mp4 (extra `video`) or .gif; one that is there is replaced."""
    episodes: int = 1
    """How many, one after the other."""
    fps: float | None = None
    """Steps in a second of the film. None: real time, where steps beyond 50 a second are left out."""
    steps: int | None = None
    """End each episode after so many; None: when the task does."""
    seed: int | None = None
    """Which of the run's seeds; None is its first."""
    episode_seed: int = 0
    """Of the first episode; the next ones have the numbers that follow."""
    sampled: bool = False
    """Actions are sampled; else they are the policy's mode."""
    agent: OwnAgent = None


@dataclasses.dataclass(frozen=True)
class FilmOptions:
    """Draw a film strip: frames of an episode, evenly spaced in time; a row for each run."""

    runs: Annotated[
        tyro.conf.Positional[tuple[pathlib.Path, ...]], tyro.conf.arg(metavar="RUN", help_behavior_hint="(required)")
    ]
    """The runs' folders."""
    out: pathlib.Path | None = None
    """The strip, written as PNG and as PDF. None: film.png in the first run's folder."""
    frames: int = 8
    """In a row."""
    steps: int | None = None
    """End the episodes after so many; None: when the task does."""
    seed: int | None = None
    """Which of each run's seeds; None is its first."""
    episode_seed: int = 0
    """Of the episodes: the same one gives the same strip."""
    sampled: bool = False
    """Actions are sampled; else they are the policy's mode."""
    agent: OwnAgent = None


def predict(argv: Sequence[str]) -> None:
    """`beliefrl predict RUN ...`."""
    options = parse(PredictOptions, argv, "beliefrl predict")
    from beliefrl.analysis import figures
    from beliefrl.runs.run import Run
    from beliefrl.viewing.prediction import draw_predictions, predictions

    run = Run(options.run)
    path = options.out or run.folder / "predictions.png"
    figures.paths(path)  # before an episode is played for it
    names = ("seed", "model", "start", "horizon", "samples", "episode_seed", "sampled")
    predicted = predictions(run, agent=own_agent(options.agent), **{name: getattr(options, name) for name in names})
    _written(draw_predictions(predicted, path, options.entries or None))


def video(argv: Sequence[str]) -> None:
    """`beliefrl video RUN FILE ...`."""
    options = parse(VideoOptions, argv, "beliefrl video")
    from beliefrl.viewing import films

    names = ("seed", "episode_seed", "sampled", "episodes", "fps", "steps")
    played = films.video(
        options.run, options.out, agent=own_agent(options.agent), **{name: getattr(options, name) for name in names}
    )
    for index, episode in enumerate(played):
        reached = {None: "", True: ", success", False: ", no success"}[episode.success]
        length = len(episode.steps.reward) - 1
        print(f"episode {options.episode_seed + index}: {length} steps, return {episode.total:.1f}{reached}")
    print(f"written to {options.out}")


def film(argv: Sequence[str]) -> None:
    """`beliefrl film RUN ...`."""
    options = parse(FilmOptions, argv, "beliefrl film")
    from beliefrl.viewing import films

    names = ("frames", "seed", "episode_seed", "sampled", "steps")
    given = {name: getattr(options, name) for name in names}
    _written(films.film(options.runs, options.out, agent=own_agent(options.agent), **given))


def _written(path: pathlib.Path) -> None:
    print(f"written to {path} and {path.with_suffix('.pdf')}")
