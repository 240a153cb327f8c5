"""Pictures of trained agents: `beliefrl predict`, `video`, `film` and `demo`."""

import dataclasses
import importlib.util
import os
import pathlib
import sys
import tempfile
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from beliefrl.commands.arguments import Best, Out, OwnAgent, RunFolder, Sampled, Seed, own_agent, parse

SPARING = 20.0  # maximum frames per second of a demo's video, so that it is written in seconds


@dataclasses.dataclass(frozen=True)
class PredictOptions:
    """Compare the predictions of a run's model with a true episode: open loop and closed loop, with σ."""

    run: RunFolder
    out: Out = None
    """The picture to write, as PNG and as PDF. None: predictions.png in the run's folder."""
    model: str | None = None
    """The model to use: lstm for predictive-sac, keep or first for vrm, latent for slac. None: the first of these that
    the agent has."""
    start: int | None = None
    """Number of timesteps that the closed loop observes. None: 50, or half of an episode with fewer than 100."""
    horizon: int = 100
    """Number of timesteps that the closed loop predicts after that, at most to the end of the episode."""
    samples: int = 32
    """Number of samples in the mean of each prediction."""
    entries: tuple[int, ...] = ()
    """Entries of the observation to draw, numbered as in --observe. Empty: the first six that the agent sees."""
    seed: Seed = None
    episode_seed: int = 0
    """Random seed of the episode, its actions and the samples. The same seed gives the same picture."""
    sampled: Sampled = False
    best: Best = False
    agent: OwnAgent = None


@dataclasses.dataclass(frozen=True)
class VideoOptions:
    """Record a video of a run's trained agent."""

    run: RunFolder
    out: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="FILE")]
    """The video to write, .mp4 (needs the extra `video`) or .gif. An existing file is replaced."""
    episodes: int = 1
    """Number of episodes, shown one after the other."""
    fps: float | None = None
    """Timesteps per second of the video. None: real time, with at most 50 frames per second."""
    steps: int | None = None
    """Stop each episode after this many steps. None: play until the task ends it."""
    seed: Seed = None
    episode_seed: int = 0
    """Random seed of the first episode. The next episodes have the following seeds."""
    sampled: Sampled = False
    best: Best = False
    agent: OwnAgent = None


@dataclasses.dataclass(frozen=True)
class FilmOptions:
    """Draw a film strip: evenly spaced frames of an episode, one row per run."""

    runs: Annotated[
        tyro.conf.Positional[tuple[pathlib.Path, ...]], tyro.conf.arg(metavar="RUN", help_behavior_hint="(required)")
    ]
    """The folders of the runs."""
    out: Out = None
    """The strip to write, as PNG and as PDF. None: film.png in the first run's folder."""
    frames: int = 8
    """Number of frames in a row."""
    start: int = 0
    """Step of the first frame."""
    steps: int | None = None
    """Stop the episodes after this many steps. None: play until the task ends them."""
    seed: int | None = None
    """One of each run's seeds. None: its first."""
    episode_seed: int = 0
    """Random seed of the episodes. The same seed gives the same strip."""
    sampled: Sampled = False
    best: Best = False
    agent: OwnAgent = None


@dataclasses.dataclass(frozen=True)
class DemoOptions:
    """Watch a small trained agent that comes with the package: in a window, or in a video if there is no display."""

    task: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[TASK]")] = "pendulum-v"
    """cartpole-v, pendulum-v or target-reaching."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(metavar="FILE", aliases=["-o"])] = None
    """The video to write, .gif or .mp4. An existing file is replaced. None: a window if there is a display and pygame
    (extra `render`), otherwise beliefrl-demo-TASK.gif."""
    episode_seed: int = 4
    """Random seed of the episode. The same seed gives the same episode."""
    unpack: Annotated[pathlib.Path | None, tyro.conf.arg(metavar="RUN")] = None
    """A new folder for a copy of the agent, as a run for commands such as `beliefrl evaluate RUN`. None: no copy."""


def predict(argv: Sequence[str]) -> None:
    """`beliefrl predict RUN ...`."""
    options = parse(PredictOptions, argv, "beliefrl predict")
    from beliefrl.analysis import figures
    from beliefrl.runs.run import Run
    from beliefrl.viewing.prediction import draw_predictions, predictions

    run = Run(options.run)
    path = options.out or run.given / "predictions.png"
    png, _ = figures.paths(path)  # raises an error before the episode is played
    place = path.absolute()  # an environment may change the working directory
    predicted = predictions(run, **_without(options, "run", "out", "entries"))
    draw_predictions(predicted, place, options.entries or None)
    _written(png)


def video(argv: Sequence[str]) -> None:
    """`beliefrl video RUN FILE ...`."""
    options = parse(VideoOptions, argv, "beliefrl video")
    from beliefrl.viewing import films

    played = films.video(options.run, options.out, **_without(options, "run", "out"))
    _print_episodes(played, options.episode_seed)
    print(f"written to {options.out}")


def film(argv: Sequence[str]) -> None:
    """`beliefrl film RUN ...`."""
    options = parse(FilmOptions, argv, "beliefrl film")
    from beliefrl.viewing import films

    out = options.out or (options.runs[0] / "film.png" if options.runs else None)
    _written(films.film(options.runs, out, **_without(options, "runs", "out")))


def demo(argv: Sequence[str]) -> None:
    """`beliefrl demo [TASK] ...`."""
    options = parse(DemoOptions, argv, "beliefrl demo")
    from beliefrl.viewing import films
    from beliefrl.viewing.demo import demo as copy
    from beliefrl.viewing.episodes import check_episode

    out = options.out or (None if _has_screen() else pathlib.Path(f"beliefrl-demo-{options.task}.gif"))
    check_episode(options.episode_seed)  # these two raise an error before anything is written
    if out is not None:
        films.kind_of(out)
    with tempfile.TemporaryDirectory() as temporary:
        run = copy(options.task, options.unpack or pathlib.Path(temporary) / "run")
        _print_origin(run)
        fastest = films.FASTEST if out is None else SPARING
        played = films.video(run, out, episode_seed=options.episode_seed, fastest=fastest)
    _print_episodes(played, options.episode_seed)
    if options.unpack is not None:
        print(f"copied to {options.unpack}")
    if out is not None:
        print(f"written to {out}")


def _without(options: Any, *names: str) -> dict[str, Any]:
    """The options except these, as arguments of the function with the same names."""
    given = {name: value for name, value in vars(options).items() if name not in names}
    return given | {"agent": own_agent(options.agent)}


def _has_screen() -> bool:
    """Whether a window can be expected to open: pygame is installed, and there is a display."""
    displays = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return importlib.util.find_spec("pygame") is not None and (sys.platform != "linux" or bool(displays))


def _print_origin(run: Any) -> None:
    """How the agent of a demo was trained, and its returns."""
    config, results = run.config, run.results()
    commit, seeds = str(config["git_commit"])[:12], ", ".join(map(str, results["chosen_from"]["seeds"]))
    print(f"{config['agent']} on {config['task']}: {results['step']:,} steps, seed {run.seeds[0]}, the best of {seeds}")
    print(f"trained on {config['device']}, {config['started'][:10]}, commit {commit}")
    for mode in ("sampled", "mode"):
        success = "" if results[mode]["success"] is None else f", success {results[mode]['success']:.0%}"
        print(f"{results['episodes']} episodes, {mode} actions: mean return {results[mode]['mean']:.1f}{success}")


def _print_episodes(played: Sequence[Any], first: int) -> None:
    """The length and return of each episode that was shown; `first` is the seed of the first."""
    for index, episode in enumerate(played):
        print(f"episode {first + index}: {len(episode.steps.reward) - 1} steps, {episode.summary}")


def _written(path: pathlib.Path) -> None:
    print(f"written to {path} and {path.with_suffix('.pdf')}")
