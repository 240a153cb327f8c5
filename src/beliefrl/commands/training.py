"""`beliefrl check`, `beliefrl train` and `beliefrl resume`."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Annotated, Literal

import tyro

from beliefrl import catalogue
from beliefrl.commands.arguments import (
    OwnAgent,
    RunFolder,
    agent_name,
    agent_options,
    named_values,
    own_agent,
    parse,
    refuse_empty,
)
from beliefrl.errors import UserError
from beliefrl.training.stop import waiting

NewLimit = Annotated[float | Literal["same"] | None, tyro.conf.arg(metavar="FLOAT|None|same")]
TaskName = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK", help="`beliefrl tasks` lists them.")]
Observe = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="ENTRIES",
        help="Entries of the observation that the agent sees: indices, or `velocities` or `positions` if the task "
        "defines them. None: all.",
    ),
]
Constants = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="NAME=VALUE",
        help="Constants of a task's physics, or arguments of a Gymnasium environment, such as max_episode_steps=500. "
        "With steps_per_action=2 each action is applied for two steps of the task.",
    ),
]


@dataclasses.dataclass(frozen=True)
class CheckOptions:
    """Show a task's observations, actions and rewards, and whether you can train on it. Takes random steps in it."""

    task: TaskName
    observe: Observe = ()
    constants: Constants = ()
    steps: int = 200
    """Number of random steps."""
    seed: int = 0
    """Random seed of the steps."""


@dataclasses.dataclass(frozen=True)
class ResumeOptions:
    """Continue a training from its last checkpoint, or from step 0 if it has none yet. Other settings cannot change."""

    run: RunFolder
    steps: int | None = None
    """Total number of environment steps of each seed, at least as many as before. None: as many as before."""
    stop_at: NewLimit = "same"
    """Return at which the training ends, as in `beliefrl train`. None: train for all steps. same: as before."""
    stop_patience: int | None = None
    """Number of evaluations for --stop-at, as in `beliefrl train`. None: as before."""
    step_timeout: NewLimit = "same"
    """Maximum number of seconds of a step, as in `beliefrl train`. None: no limit. same: as before."""
    agent: OwnAgent = None


def check(argv: Sequence[str]) -> None:
    """`beliefrl check TASK ...`."""
    options = parse(CheckOptions, argv, "beliefrl check")
    refuse_empty(argv, "--observe", "--constants")
    from rich.console import Console

    from beliefrl import tasks
    from beliefrl.tasks.check import check as look

    task = tasks.make(options.task, **named_values(options.constants, "--constants"))
    found = look(task, options.observe or None, options.steps, options.seed)
    Console().print(found)
    if found.refusals:
        raise UserError(" ".join(found.refusals))


@waiting()
def train(argv: Sequence[str]) -> None:
    """`beliefrl train AGENT TASK ...`."""
    name, rest = agent_name(argv, "train", "TASK")
    catalogue.check_agent(name)  # before JAX is imported
    from beliefrl import agents, tasks
    from beliefrl.runs.options import Options
    from beliefrl.tasks.faults import Faults
    from beliefrl.training.train import train as run_training

    options_type = agent_options(
        agents.make(name),
        {
            "task": (TaskName, dataclasses.MISSING),
            "observe": (Observe, ()),
            "constants": (Constants, ()),
            "faults": (
                Annotated[Faults, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help="Missing and faulty sensors.")],
                Faults(),
            ),
            "training": (
                Annotated[Options, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help="How the training runs.")],
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
    refuse_empty(rest, "--observe", "--constants")
    constants = named_values(options.constants, "--constants")
    task = tasks.make(options.task, options.observe or None, options.faults, **constants)
    run_training(
        options.agent,
        task,
        options.out,
        own_process=True,
        resume=options.resume,
        **dataclasses.asdict(options.training),
    )


@waiting()
def resume(argv: Sequence[str]) -> None:
    """`beliefrl resume RUN ...`."""
    kept = (
        "a resumed training keeps its settings. `beliefrl train ... --init-from RUN` starts from its agent with others."
    )
    options = parse(ResumeOptions, argv, "beliefrl resume", kept)
    from beliefrl.training.train import resume as go_on

    go_on(
        options.run,
        options.steps,
        agent=own_agent(options.agent),
        own_process=True,
        stop_at=options.stop_at,
        step_timeout=options.step_timeout,
        stop_patience=options.stop_patience,
    )
