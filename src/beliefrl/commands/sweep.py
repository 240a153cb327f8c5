"""`beliefrl sweep`."""

import dataclasses
import itertools
import pathlib
from collections.abc import Sequence
from typing import Annotated, Literal

import tyro

from beliefrl.commands.arguments import named_values, parse, refuse_empty, value_lists
from beliefrl.errors import UserError


@dataclasses.dataclass(frozen=True)
class SweepOptions:
    """Run many trainings: agents x tasks x settings x seeds, one training per core or GPU at a time. A stopped sweep
    continues with the same command, or with --out alone. Finished trainings are not repeated. If a training fails, the
    others continue, and the failure is reported at the end.
    """

    file: Annotated[tyro.conf.Positional[pathlib.Path | None], tyro.conf.arg(metavar="FILE.py")] = None
    """A Python file that defines a list `experiments` of `beliefrl.Experiment`, for example with `beliefrl.grid`."""
    preset: Literal["classic", "robots", "memory", "ablation", "sensitivity", "scalability"] | None = None
    """Experiments of the paper (Section 5, Appendices C, F, G); --tasks, --agents, --seeds replace the paper's."""
    agents: tuple[str, ...] = ()
    """Names of the agents."""
    tasks: tuple[str, ...] = ()
    """Names of the tasks."""
    seeds: int | None = None
    """Number of seeds per experiment, starting at --seed. None: as in the paper (5; sensitivity 20; scalability
    1) or in FILE, and 2 with --scale."""
    seed: int | None = None
    """Number of the first seed. Without --seeds, the numbers of all seeds are shifted so that the lowest is this one.
    None: 0, or as FILE has them."""
    steps: int | None = None
    """Environment steps per seed. None: those of the preset, or 20,000."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE[,VALUE...]")] = ()
    """Hyperparameters of the agents, or faults of the sensors such as noise. Every combination of the given values is
    trained. Options of the training can be set too, but only to one value."""
    observe: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ENTRIES")] = ()
    """Entries of the observation that the agents see, as in `beliefrl train`."""
    constants: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """The tasks' constants, as in `beliefrl train`."""
    scale: float = 1.0
    """Scale all step counts, for a quick trial: training, exploration, pre-training, evaluation interval (0 to 1)."""
    out: pathlib.Path | None = None
    """The sweep's folder. A sweep that is in it continues. None: runs/sweep, or runs/sweep-PRESET."""
    workers: int | None = None
    """Maximum number of trainings at a time. None: as many as there are cores (or GPUs)."""
    seeds_per_run: int | None = None
    """Maximum number of seeds side by side in one program. None: one on a core (all of sac-mlp on a JAX task), all on a
    GPU."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="auto|ADDRESS")] = None
    """Run on a Ray cluster. ADDRESS is HOST:PORT of its head, or auto for a head on this machine. Needs the extra
    `sweep`, and a folder that all machines of the cluster see."""


def sweep(argv: Sequence[str]) -> None:
    """`beliefrl sweep ...`."""
    options = parse(SweepOptions, argv, "beliefrl sweep")
    refuse_empty(argv, "--agents", "--tasks", "--set", "--observe", "--constants")
    from beliefrl.sweeps.run import sweep as run_sweep

    experiments = _experiments(options)
    folder = options.out or pathlib.Path("runs") / ("sweep" + (f"-{options.preset}" if options.preset else ""))
    alone = options.preset == "scalability" and options.workers is None
    run_sweep(
        experiments,
        folder,
        workers=0 if alone else options.workers,
        seeds_per_run=options.seeds_per_run,
        ray=options.ray,
    )


def _experiments(options: SweepOptions) -> list:
    """The experiments that the options define. Empty: continue the sweep in --out."""
    from beliefrl.runs.options import Options
    from beliefrl.sweeps import plan, sources
    from beliefrl.sweeps.experiments import grid
    from beliefrl.types import check_range, check_whole

    check_range(options, ("scale",), 0, 1)
    for name in ("seeds", "steps", "workers", "seeds_per_run"):
        check_whole(name, getattr(options, name), 1, optional=True)
    first, count = options.seed or 0, options.seeds or (2 if options.scale < 1 else None)
    Options(seed=first, seeds=count or 1)
    if options.file is not None:
        if options.preset or options.agents or options.tasks:
            raise UserError("FILE defines the agents and tasks: leave --preset, --agents and --tasks out.")
        chosen = sources.load(options.file)
        if count is not None:
            chosen = [dataclasses.replace(each, seeds=tuple(range(first, first + count))) for each in chosen]
        elif options.seed is not None:
            chosen = _shifted(chosen, first)
    elif options.preset is not None:
        numbers = range(first, first + (count or sources.PRESETS[options.preset].seeds))
        chosen = sources.preset(options.preset, options.tasks, options.agents, numbers)
    elif options.agents and options.tasks:
        chosen = grid(options.agents, options.tasks, seeds=range(first, first + (count or 5)))
    elif options.out is not None and _only_continues(options) and sources.read(options.out):
        return []
    else:
        raise UserError(
            "There is nothing to run: give --preset, or --agents and --tasks, or FILE, or the --out of a sweep."
        )
    chosen = _with_settings(chosen, options)
    return chosen if options.scale == 1 else [plan.shrunk(each, options.scale) for each in chosen]


def _only_continues(options: SweepOptions) -> bool:
    """Whether the options only say which sweep to continue, and on which machines or cores."""
    where = dataclasses.replace(SweepOptions(), out=options.out, workers=options.workers, ray=options.ray)
    return options == dataclasses.replace(where, seeds_per_run=options.seeds_per_run)


def _shifted(experiments: list, first: int) -> list:
    """The experiments with the same distance added to the numbers of all seeds, so that the lowest is `first`."""
    distance = first - min((seed for each in experiments for seed in each.seeds), default=first)
    return [dataclasses.replace(each, seeds=tuple(seed + distance for seed in each.seeds)) for each in experiments]


def _with_settings(experiments: list, options: SweepOptions) -> list:
    """The experiments with every combination of --set, and with --steps, --observe and --constants."""
    given = value_lists(options.set, "--set")
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
