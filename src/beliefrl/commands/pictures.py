"""Pictures of trained agents: `beliefrl predict`, `video` and `film`."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Annotated

import tyro

from beliefrl.commands.arguments import Best, OwnAgent, own_agent, parse


@dataclasses.dataclass(frozen=True)
class PredictOptions:
    """Compare the predictions of a run's model with a true episode: open loop and closed loop, with σ."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    out: pathlib.Path | None = None
    """The picture to write, as PNG and as PDF. None: predictions.png in the run's folder."""
    model: str | None = None
    """The model to use: keep or first for vrm, latent for slac. None: the first of these that the agent has."""
    start: int | None = None
    """Number of timesteps that the closed loop observes. None: 50, or half of a shorter episode."""
    horizon: int = 100
    """Number of timesteps that the closed loop predicts after that, at most to the end of the episode."""
    samples: int = 32
    """Number of samples in the mean of each prediction."""
    entries: tuple[int, ...] = ()
    """Entries of the observation to draw, numbered as in --observe. Empty: the first six that the agent sees."""
    seed: int | None = None
    """One of the run's seeds. None: its first."""
    episode_seed: int = 0
    """Random seed of the episode, its actions and the samples. The same seed gives the same picture."""
    sampled: bool = False
    """Sample the actions, instead of taking the policy's mode."""
    best: Best = False
    agent: OwnAgent = None


@dataclasses.dataclass(frozen=True)
class VideoOptions:
    """Record a video of a run's trained agent."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    out: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="FILE")]
    """The video to write, .mp4 (needs the extra `video`) or .gif. An existing file is replaced."""
    episodes: int = 1
    """Number of episodes, shown one after the other."""
    fps: float | None = None
    """Timesteps per second of the video. None: real time, with at most 50 frames per second."""
    steps: int | None = None
    """Stop each episode after this many steps. None: play until the task ends it."""
    seed: int | None = None
    """One of the run's seeds. None: its first."""
    episode_seed: int = 0
    """Random seed of the first episode. The next episodes have the following seeds."""
    sampled: bool = False
    """Sample the actions, instead of taking the policy's mode."""
    best: Best = False
    agent: OwnAgent = None


@dataclasses.dataclass(frozen=True)
class FilmOptions:
    """Draw a film strip: evenly spaced frames of an episode, one row per run."""

    runs: Annotated[
        tyro.conf.Positional[tuple[pathlib.Path, ...]], tyro.conf.arg(metavar="RUN", help_behavior_hint="(required)")
    ]
    """The folders of the runs."""
    out: pathlib.Path | None = None
    """The strip to write, as PNG and as PDF. None: film.png in the first run's folder."""
    frames: int = 8
    """Number of frames in a row."""
    steps: int | None = None
    """Stop the episodes after this many steps. None: play until the task ends them."""
    seed: int | None = None
    """One of each run's seeds. None: its first."""
    episode_seed: int = 0
    """Random seed of the episodes. The same seed gives the same strip."""
    sampled: bool = False
    """Sample the actions, instead of taking the policy's mode."""
    best: Best = False
    agent: OwnAgent = None


def predict(argv: Sequence[str]) -> None:
    """`beliefrl predict RUN ...`."""
    options = parse(PredictOptions, argv, "beliefrl predict")
    from beliefrl.analysis import figures
    from beliefrl.runs.run import Run
    from beliefrl.viewing.prediction import draw_predictions, predictions

    run = Run(options.run)
    path = options.out or run.folder / "predictions.png"
    figures.paths(path)  # raises an error before the episode is played
    names = ("seed", "model", "start", "horizon", "samples", "episode_seed", "sampled", "best")
    predicted = predictions(run, agent=own_agent(options.agent), **{name: getattr(options, name) for name in names})
    _written(draw_predictions(predicted, path, options.entries or None))


def video(argv: Sequence[str]) -> None:
    """`beliefrl video RUN FILE ...`."""
    options = parse(VideoOptions, argv, "beliefrl video")
    from beliefrl.viewing import films

    names = ("seed", "episode_seed", "sampled", "best", "episodes", "fps", "steps")
    played = films.video(
        options.run, options.out, agent=own_agent(options.agent), **{name: getattr(options, name) for name in names}
    )
    for index, episode in enumerate(played):
        length = len(episode.steps.reward) - 1
        print(f"episode {options.episode_seed + index}: {length} steps, {episode.summary}")
    print(f"written to {options.out}")


def film(argv: Sequence[str]) -> None:
    """`beliefrl film RUN ...`."""
    options = parse(FilmOptions, argv, "beliefrl film")
    from beliefrl.viewing import films

    names = ("frames", "seed", "episode_seed", "sampled", "best", "steps")
    given = {name: getattr(options, name) for name in names}
    _written(films.film(options.runs, options.out, agent=own_agent(options.agent), **given))


def _written(path: pathlib.Path) -> None:
    print(f"written to {path} and {path.with_suffix('.pdf')}")
