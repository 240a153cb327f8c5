"""`beliefrl sweep`."""

import dataclasses
import itertools
import pathlib
from collections.abc import Sequence
from typing import Annotated, Literal

import tyro

from beliefrl.commands.arguments import UsageError, named_values, parse


@dataclasses.dataclass(frozen=True)
class SweepOptions:
    """Many trainings: agents x tasks x settings x seeds, as many at a time as there are cores, one thread each (or one
    a GPU). A sweep that was stopped goes on by the same command, or by --out alone; finished trainings are not done
    again; one that fails is told at the end, and the others go on.
    """

    file: Annotated[tyro.conf.Positional[pathlib.Path | None], tyro.conf.arg(metavar="FILE.py")] = None
    """A Python file that makes a list `experiments`, by `beliefrl.grid` or of `beliefrl.Experiment`."""
    preset: Literal["classic", "robots", "memory", "ablation", "sensitivity", "scalability"] | None = None
    """The paper's experiments (Section 5, Appendices C, F, G); --tasks, --agents, --seeds replace its own."""
    agents: tuple[str, ...] = ()
    """Names of agents."""
    tasks: tuple[str, ...] = ()
    """Names of tasks."""
    seeds: int | None = None
    """Seeds of every experiment, from --seed on. None: as many as the paper has (5; sensitivity 20), 2 with --scale."""
    seed: int = 0
    """Number of the first seed."""
    steps: int | None = None
    """Environment steps of each seed. None: the preset's, or 20,000."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE[,VALUE...]")] = ()
    """Hyperparameters of the agents, options of a training; of those with several values every combination is run."""
    observe: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ENTRIES")] = ()
    """Entries of the observation that the agents see, as in `beliefrl train`."""
    constants: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """The tasks' constants, as in `beliefrl train`."""
    scale: float = 1.0
    """A trial: so many times the steps, the exploration, the pre-training and the steps between evaluations."""
    out: pathlib.Path | None = None
    """The sweep's folder; one that holds a sweep goes on. None: runs/sweep, or runs/sweep-PRESET."""
    workers: int | None = None
    """Most trainings at a time. None: as many as there are cores (or GPUs)."""
    seeds_per_run: int | None = None
    """Seeds trained side by side in one program. None: one on a core (of sac-mlp all), all on a GPU."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="auto|ADDRESS")] = None
    """Run on the Ray cluster whose head is at ADDRESS (HOST:PORT), or on this machine (auto). Needs the extra `sweep`,
    and a folder that all of its machines see."""


def sweep(argv: Sequence[str]) -> None:
    """`beliefrl sweep ...`."""
    options = parse(SweepOptions, argv, "beliefrl sweep")
    from rich.console import Console

    from beliefrl.commands.display import SweepDisplay
    from beliefrl.sweeps.run import sweep as run_sweep

    experiments = _experiments(options)
    folder = options.out or pathlib.Path("runs") / ("sweep" + (f"-{options.preset}" if options.preset else ""))
    alone = options.preset == "scalability" and options.workers is None
    with SweepDisplay(Console(), folder) as display:
        run_sweep(
            experiments,
            folder,
            workers=0 if alone else options.workers,
            seeds_per_run=options.seeds_per_run,
            ray=options.ray,
            report=display,
        )


def _experiments(options: SweepOptions) -> list:
    """What the command line asks for."""
    from beliefrl.runs.options import Options
    from beliefrl.sweeps import files, plan, presets
    from beliefrl.types import check_range

    check_range(options, ("scale",), 0, 1)
    for name in ("seeds", "steps", "workers", "seeds_per_run"):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise UsageError(f"{name}={getattr(options, name)} is impossible: it must be a whole number of at least 1.")
    Options(seed=options.seed, seeds=options.seeds or 1)
    count = options.seeds or (2 if options.scale < 1 else None)
    numbers = None if count is None else range(options.seed, options.seed + count)
    if options.file is not None:
        if options.preset or options.agents or options.tasks:
            raise UsageError("A FILE says which agents and tasks: leave --preset, --agents and --tasks out.")
        chosen = files.load(options.file)
        chosen = [dataclasses.replace(each, seeds=tuple(numbers)) for each in chosen] if numbers else chosen
    elif options.preset is not None:
        chosen = presets.preset(options.preset, options.tasks, options.agents, numbers)
    elif options.agents and options.tasks:
        chosen = plan.grid(options.agents, options.tasks, seeds=numbers or range(options.seed, options.seed + 5))
    elif options.out is not None and _only_where(options) and files.read(options.out):
        return []
    else:
        raise UsageError(
            "Nothing is named to run: give --preset, or --agents and --tasks, or a FILE, or an --out to go on."
        )
    chosen = _with_settings(chosen, options)
    return chosen if options.scale == 1 else [plan.shrunk(each, options.scale) for each in chosen]


def _only_where(options: SweepOptions) -> bool:
    """Whether nothing is said but where a sweep is and how it shall run."""
    where = dataclasses.replace(SweepOptions(), out=options.out, workers=options.workers, ray=options.ray)
    return options == dataclasses.replace(where, seeds_per_run=options.seeds_per_run)


def _with_settings(experiments: list, options: SweepOptions) -> list:
    """The experiments with every combination of --set, and with --steps, --observe and --constants."""
    given = {name: _values(value) for name, value in (_named(each) for each in options.set)}
    if options.steps is not None:
        given["steps"] = [options.steps]
    constants = named_values(options.constants, "--constants")
    made = []
    for experiment in experiments:
        for values in itertools.product(*given.values()):
            settings = {**experiment.settings, **dict(zip(given, values, strict=True))}
            made.append(
                dataclasses.replace(
                    experiment,
                    settings=settings,
                    observe=options.observe or experiment.observe,
                    constants={**experiment.constants, **constants},
                )
            )
    return made


def _named(given: str) -> tuple[str, str]:
    name, separator, value = given.partition("=")
    name = name.replace("-", "_")
    named_values([name + separator + value], "--set")  # complains of what is no NAME=VALUE
    return name, value


def _values(text: str) -> list:
    """The values of A,B,C; one list in brackets is one value."""
    parts = [text] if text.startswith("[") else text.split(",")
    return [named_values([f"value={part}"], "--set")["value"] for part in parts]
