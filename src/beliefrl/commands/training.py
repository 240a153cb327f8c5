"""`beliefrl train` and `beliefrl resume`."""

import dataclasses
import json
import os
import pathlib
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from beliefrl import catalogue
from beliefrl.commands.arguments import OwnAgent, agent_name, agent_options, named_values, own_agent, parse


@dataclasses.dataclass(frozen=True)
class ResumeOptions:
    """Continue a training from its last checkpoint, or from step 0 if it has no checkpoint yet."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    steps: int | None = None
    """Total number of environment steps of each seed, at least as many as before. None: as many as before."""
    agent: OwnAgent = None


def train(argv: Sequence[str]) -> None:
    """`beliefrl train AGENT TASK ...`."""
    name, rest = agent_name(argv, "train", "TASK")
    catalogue.check_agent(name)  # before JAX is imported
    from rich.console import Console

    from beliefrl import agents, tasks
    from beliefrl.commands.display import TrainingDisplay
    from beliefrl.runs.options import Options
    from beliefrl.runs.run import Run
    from beliefrl.training.train import train as run_training

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
                        "if the task defines them. None: all.",
                    ),
                ],
                (),
            ),
            "constants": (
                Annotated[
                    tuple[str, ...],
                    tyro.conf.arg(
                        metavar="NAME=VALUE",
                        help="Constants of a task's physics, or arguments of a Gymnasium environment, such as "
                        "max_episode_steps=500.",
                    ),
                ],
                (),
            ),
            "training": (
                Annotated[Options, tyro.conf.arg(name="", help="Length and evaluations.")],
                Options(),
            ),
            "out": (
                Annotated[
                    pathlib.Path | None,
                    tyro.conf.arg(help="A new folder for the run. None: runs/AGENT-TASK-1, or the next free number."),
                ],
                None,
            ),
            "resume": (
                Annotated[bool, tyro.conf.arg(help="Continue the training in --out, if there is one already.")],
                False,
            ),
        },
    )
    options = parse(options_type, rest, f"beliefrl train {name}")
    task = tasks.make(options.task, options.observe or None, **named_values(options.constants, "--constants"))
    console = Console()
    if options.resume and options.out is not None and os.path.exists(options.out / "config.json"):  # noqa: PTH110 - pathlib's version raises if a name is too long
        _same_training(Run(options.out), agents.name_of(options.agent), tasks.describe(task), options)
        _resume(options.out, options.training.steps, type(options.agent) if agents.is_own(name) else None)
        return
    with TrainingDisplay(console, options.training.steps) as display:
        run = run_training(
            options.agent, task, options.out, display, own_process=True, **dataclasses.asdict(options.training)
        )
    _ended(run)


def _ended(run: Any) -> None:
    """Print the results of a finished training, and its folder."""
    from rich.console import Console

    from beliefrl.commands.display import results_table
    from beliefrl.training.evaluation import as_argument

    console, results = Console(), run.results() or {}
    title = f"{run.config['agent']} on {run.config['task']} after {results['step']:,} steps"
    console.print(results_table(results, run.seeds, title))
    line = f"saved in {run.folder}: see curve.png; `beliefrl evaluate {as_argument(run)}` plays more episodes"
    console.print(line, markup=False, highlight=False, soft_wrap=True)


def _same_training(run: Any, agent: str, task: dict[str, Any], options: Any) -> None:
    """Raise a UserError if a run was trained with settings that differ from those on the command line."""
    from beliefrl.types import UserError

    asked = {"agent": agent, **task, **dataclasses.asdict(options.training), **dataclasses.asdict(options.agent)}
    asked = json.loads(json.dumps(asked))  # tuples are lists in the run's config
    there = {**run.config, **run.config["options"], **run.config["hyperparameters"], "steps": options.training.steps}
    for name, value in asked.items():
        if there.get(name, value) != value:
            raise UserError(f"{run.folder} was trained with {name}={there[name]}, not {value}: choose another --out.")


def resume(argv: Sequence[str]) -> None:
    """`beliefrl resume RUN ...`."""
    options = parse(ResumeOptions, argv, "beliefrl resume")
    _resume(options.run, options.steps, own_agent(options.agent))


def _resume(folder: pathlib.Path, steps: int | None, agent: type | None) -> None:
    from rich.console import Console

    from beliefrl.commands.display import TrainingDisplay
    from beliefrl.runs.run import Run
    from beliefrl.training.train import resume as go_on

    run = Run(folder)
    with TrainingDisplay(Console(), steps or run.options.steps) as display:
        _ended(go_on(run, steps, report=display, agent=agent, own_process=True))
