"""What each command does: parse its options, call the library, print."""

import dataclasses
import json
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import tyro

from beliefrl.arguments import agent_name, agent_options, named_values, parse

STARTED = time.time()


@dataclasses.dataclass(frozen=True)
class ResumeOptions:
    """Go on with a training from its last checkpoint, as if it had never stopped."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    steps: int | None = None
    """Train for so many environment steps in all; None: as many as before. They may only grow."""


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """Play new episodes with what a run has learned, with sampled actions and with mode actions."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    episodes: int = 20
    """Episodes for each seed of the run and each mode."""
    seed: int = 0
    """Of these episodes: the same seed gives the same numbers."""
    json: bool = False
    """Print one JSON object: per mode the mean, S.E.M., every seed's mean, and success."""


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Write what a run has learned as one file that jax loads without this library (`beliefrl.Policy.export`)."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    file: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="FILE")]
    """The file to write; one that is there is replaced."""
    seed: int | None = None
    """Which of the run's seeds; None is its first."""


@dataclasses.dataclass(frozen=True)
class ShowOptions:
    """Show what a run was made with, how far it is, and what it is worth."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""


@dataclasses.dataclass(frozen=True)
class ListOptions:
    """Print the names, one a line."""


def train(argv: Sequence[str]) -> None:
    """`beliefrl train AGENT TASK ...`."""
    from rich.console import Console

    from beliefrl import agents, tasks
    from beliefrl.checkpoint import listed
    from beliefrl.display import TrainingDisplay
    from beliefrl.runs import Run
    from beliefrl.schedule import Options
    from beliefrl.train import train as run_training

    name, rest = agent_name(argv, "train", "TASK")
    options_type = agent_options(
        agents.find(name),
        {
            "task": (
                Annotated[
                    tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK", help="`beliefrl tasks` lists them.")
                ],
                dataclasses.MISSING,
            ),
            "observe": (
                Annotated[
                    tuple[str, ...],
                    tyro.conf.arg(
                        metavar="ENTRIES",
                        help="Entries of the observation that the agent sees: indices, or `velocities` or `positions` "
                        "where the task says which they are. None given: all.",
                    ),
                ],
                (),
            ),
            "constants": (
                Annotated[
                    tuple[str, ...],
                    tyro.conf.arg(
                        metavar="NAME=VALUE",
                        help="Of a task's physics, or of a Gymnasium environment, such as max_episode_steps=500.",
                    ),
                ],
                (),
            ),
            "training": (Annotated[Options, tyro.conf.arg(name="", help="How long, how often.")], Options()),
            "out": (
                Annotated[
                    pathlib.Path | None,
                    tyro.conf.arg(help="The run's folder, which must not exist. None: runs/AGENT-TASK-1, or the next."),
                ],
                None,
            ),
            "resume": (
                Annotated[bool, tyro.conf.arg(help="Go on with the training in --out, if there is one already.")],
                False,
            ),
        },
    )
    options = parse(options_type, rest, f"beliefrl train {name}")
    task = tasks.make(options.task, options.observe or None, **named_values(options.constants, "--constants"))
    console = Console()
    if options.resume and options.out is not None and listed(options.out):
        _same_training(Run(options.out), name, tasks.describe(task), options)
        _resume(options.out, options.training.steps)
        return
    with TrainingDisplay(console, options.training.steps) as display:
        run = run_training(options.agent, task, options.out, display, **dataclasses.asdict(options.training))
    _ended(run)


def _ended(run: Any) -> None:
    """What a finished training is worth, and where it lies."""
    from rich.console import Console

    from beliefrl.display import results_table

    console, results = Console(), run.results() or {}
    title = f"{run.config['agent']} on {run.config['task']} after {results['step']:,} steps"
    console.print(results_table(results, run.seeds, title))
    told = f"saved in {run.folder}: see curve.png; `beliefrl evaluate {run.folder}` plays more episodes"
    console.print(told, markup=False, highlight=False, soft_wrap=True)


def _same_training(run: Any, agent: str, task: dict[str, Any], options: Any) -> None:
    """Refuse to go on with a run that is of something else than the command line says."""
    from beliefrl.types import UserError

    asked = {"agent": agent, **task, **dataclasses.asdict(options.training), **dataclasses.asdict(options.agent)}
    there = {**run.config, **run.config["options"], **run.config["hyperparameters"], "steps": options.training.steps}
    for name, value in asked.items():
        value = list(value) if isinstance(value, tuple) else value
        if there.get(name, value) != value:
            raise UserError(f"{run.folder} was trained with {name}={there[name]}, not {value}: choose another --out.")


def resume(argv: Sequence[str]) -> None:
    """`beliefrl resume RUN ...`."""
    options = parse(ResumeOptions, argv, "beliefrl resume")
    _resume(options.run, options.steps)


def _resume(folder: pathlib.Path, steps: int | None) -> None:
    from rich.console import Console

    from beliefrl.display import TrainingDisplay
    from beliefrl.runs import Run
    from beliefrl.train import resume as go_on

    run = Run(folder)
    with TrainingDisplay(Console(), steps or run.config["options"]["steps"]) as display:
        _ended(go_on(run, steps, report=display))


def show(argv: Sequence[str]) -> None:
    """`beliefrl show RUN`."""
    options = parse(ShowOptions, argv, "beliefrl show")
    from rich.console import Console

    from beliefrl.display import results_table, run_table
    from beliefrl.evaluation import agent_of
    from beliefrl.runs import Run

    run, console = Run(options.run), Console()
    table, results = run_table(run, agent_of(run)), run.results()
    console.print(table)
    if results:
        console.print(results_table(results, run.seeds, f"after {results['step']:,} steps"))


def evaluate(argv: Sequence[str]) -> None:
    """`beliefrl evaluate RUN ...`."""
    options = parse(EvaluateOptions, argv, "beliefrl evaluate")
    from rich.console import Console

    from beliefrl.display import results_table
    from beliefrl.evaluation import evaluate as play
    from beliefrl.runs import Run

    run = Run(options.run)
    results = play(run, options.episodes, options.seed)
    if options.json:
        print(json.dumps(results))
        return
    title = f"{run.config['agent']} on {run.config['task']}, {options.episodes} episodes a seed"
    Console().print(results_table(results, run.seeds, title))


def export(argv: Sequence[str]) -> None:
    """`beliefrl export RUN FILE ...`."""
    options = parse(ExportOptions, argv, "beliefrl export")
    from beliefrl.policy import load

    load(options.run, options.seed).export(options.file)
    print(f"written to {options.file}: jax.export.deserialize reads it")


def list_tasks(argv: Sequence[str]) -> None:
    """`beliefrl tasks`."""
    parse(ListOptions, argv, "beliefrl tasks")
    from beliefrl import tasks

    _print_names(tasks.names() | tasks.registered.names())


def list_agents(argv: Sequence[str]) -> None:
    """`beliefrl agents`."""
    parse(ListOptions, argv, "beliefrl agents")
    from beliefrl import agents

    _print_names(agents.names())


def bench(argv: Sequence[str]) -> None:
    """`beliefrl bench AGENT ...`, `beliefrl bench all ...`."""
    from beliefrl import agents

    name, rest = agent_name(argv, "bench")

    def option(kind: Any, default: Any, help: str) -> tuple[Any, Any]:
        return Annotated[kind, tyro.conf.arg(help=help)], default

    own = {
        "obs": option(int, 6, "Numbers in an observation; the default is velocities-only Hopper's."),
        "actions": option(int, 3, "Degrees of freedom; the default is Hopper's."),
        "seeds": option(int, 1, "Seeds trained side by side in one program."),
        "json": option(bool, False, "Print one JSON object."),
    }
    options = parse(agent_options(None if name == "all" else agents.find(name), own), rest, f"beliefrl bench {name}")
    from beliefrl.bench import bench as run_bench

    sizes = (options.obs, options.actions, options.seeds)
    if name == "all":
        results = {each: run_bench(agents.make(each), *sizes) for each in agents.names()}
    else:
        results = run_bench(options.agent, *sizes, STARTED)
    if options.json:
        print(json.dumps(results))
    elif name == "all":
        from rich.console import Console

        from beliefrl.display import scalability_table

        Console().print(scalability_table(results, options.obs, options.actions))
    else:
        for key, value in results.items():
            print(f"{key:<28}{value:,.3f}" if isinstance(value, float) else f"{key:<28}{value}")


COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {
    "train": train,
    "resume": resume,
    "show": show,
    "evaluate": evaluate,
    "export": export,
    "tasks": list_tasks,
    "agents": list_agents,
    "bench": bench,
}


def _print_names(names: dict[str, str]) -> None:
    width = max(map(len, names)) + 2
    for name, about in names.items():
        print(f"{name:<{width}}{about}")
