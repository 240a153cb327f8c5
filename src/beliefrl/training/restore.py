"""The agent, the task and the trained networks of a run, from its folder.

A run's folder is data: a class of a user that only the folder names is never imported.
"""

import contextlib
import dataclasses
import os
import shlex
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from beliefrl import agents, tasks
from beliefrl.agents import Agent, hyperparameters
from beliefrl.catalogue import MASKS, split_mask
from beliefrl.errors import UserError, one_line
from beliefrl.imports import path
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.faults import Faults
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.interface import Interface
from beliefrl.training.checks import about_task, time_limit
from beliefrl.types import LARGEST, Spec, tuples


def restore(
    run: Run, task: Task | GymnasiumTask | type | None = None, agent: Agent | type | None = None, best: bool = False
) -> tuple[Agent, Any, Any, str]:
    """The agent, the task, the trained states (leading axis: seed) and the precision (an option) of a run.

    `task` is needed only if the run was trained on a task of your own, `agent` only if an agent of your own was trained
    (`agent_of`). The states are those of the last evaluation, or of the best one of each seed.

    Raises:
        UserError: the run's agent or task is unknown here, nothing was saved, or JAX is set to 64 bits.
    """
    check_bits()
    made = agent_of(run, agent)
    found = task_of(run, task)
    check_interface(run, found)
    return made, found, _states(run, made, found.spec, best), run.options.precision


def check_bits() -> None:
    """Raise a UserError if JAX is set to 64 bits, where an agent would be another one. A `Policy` does not mind."""
    settings: Any = jax.config  # its options are made at import, unknown to pyright
    if settings.jax_enable_x64:
        raise UserError(
            "JAX is set to 64 bits, but agents learn and play with 32: unset JAX_ENABLE_X64, or call "
            "jax.config.update('jax_enable_x64', False) first."
        )


def _states(run: Run, agent: Agent, spec: Spec, best: bool) -> Any:
    with jax.enable_x64(False):
        keys = jax.random.split(jax.random.key(0), len(run.seeds))
        like = jax.eval_shape(jax.vmap(lambda key: agent.networks(agent.init(key, spec))), keys)
        return run.load(like, best)


def check_interface(run: Run, task: Any) -> None:
    """Raise a UserError if a Gymnasium environment has other entries or actions than in the training of a run."""
    if isinstance(task, GymnasiumTask):
        task.interface.check(run.config.get("interface"), run.shown)


def restore_seed(
    run: Run | str | os.PathLike[str],
    seed: int | None = None,
    task: Task | GymnasiumTask | type | None = None,
    agent: Agent | type | None = None,
    best: bool = False,
) -> tuple[Agent, Any, Any, str]:
    """The same of one seed of a run, its first if `seed` is None; see `restore`.

    Raises:
        UserError: there is no such run, nothing was saved in it, or it has no such seed.
    """
    run = run if isinstance(run, Run) else Run(run)
    _check_seed(run, seed)
    made, found, states, precision = restore(run, task, agent, best)
    return made, found, _of_seed(run, states, seed), precision


def restore_policy(
    run: Run,
    seed: int | None = None,
    task: Task | GymnasiumTask | type | None = None,
    agent: Agent | type | None = None,
    best: bool = False,
) -> tuple[Agent, Spec, Interface | None, Any]:
    """The agent of a run, the sizes of its task, the interface of a Gymnasium environment, and the state of a seed.

    Nothing is made if the run records the interface: the robot may be somewhere else, and must not move. Raises a
    UserError as `restore_seed`.
    """
    _check_seed(run, seed)
    made, interface = agent_of(run, agent), Interface.recorded(run.config.get("interface"))
    if task is not None or interface is None:
        found = task_of(run, task)
        check_interface(run, found)
        spec, interface = found.spec, found.interface if isinstance(found, GymnasiumTask) else None
    else:
        with _naming(run):
            observed = Faults.of(run.config.get("faults")).observed_size(len(interface.entries))
        spec = Spec(observed, len(interface.low), run.config.get("max_steps", LARGEST))
    return made, spec, interface, _of_seed(run, _states(run, made, spec, best), seed)


def _check_seed(run: Run, seed: int | None) -> None:
    """Raise a UserError if the run does not have this seed."""
    if seed is not None and seed not in run.seeds:
        raise UserError(f"{run.shown} has no seed {seed}: it has {', '.join(map(str, run.seeds))}.")


def _of_seed(run: Run, states: Any, seed: int | None) -> Any:
    index = 0 if seed is None else run.seeds.index(seed)
    chosen = jax.tree.map(lambda leaf: leaf[index], states)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(chosen)):
        which = f"Seed {run.seeds[index]} of {run.shown}"
        raise UserError(f"{which} has diverged before its first evaluation, so it has no agent: give another seed.")
    return chosen


def agent_of(run: Run, agent: Agent | type | None = None) -> Agent:
    """The agent of a run, before it was trained.

    Args:
        run: a run.
        agent: the class of an agent of your own, or an instance. It gets the hyperparameters that the run records. A
            run's folder is data, so a class that only the folder names is never imported.

    Raises:
        UserError: it is unknown here, one of its settings is unknown or impossible, or `agent` is of another class.
    """
    name = run.config["agent"]
    if agent is None and agents.is_own(name):
        shown = one_line(name)
        raise UserError(f"{run.shown} was trained by {shown}: give --agent {shown}, or in Python agent=.")
    if agent is not None:
        kind = agents.check_class(agent if isinstance(agent, type) else type(agent))
        if not agents.is_of(kind, name):
            raise UserError(f"{run.shown} was trained by {one_line(name)}, not by {path(kind)}: give that agent.")
    with _naming(run):
        like = agents.named(name) if agent is None or name in agents.AGENTS else agent
        return hyperparameters.restored(like, run.config["hyperparameters"])


def as_argument(run: Run) -> str:
    """A run as the argument of a command: its folder, and --agent if the run has a user's own agent."""
    name = run.config["agent"]
    folder = shlex.quote(run.shown)
    return f"{folder} --agent {one_line(name)}" if agents.is_own(name) else folder


def task_of(run: Run | str | os.PathLike[str], task: Task | GymnasiumTask | type | None = None) -> Any:
    """The task that a run was trained on, as `make_task` makes it; a `gym:PACKAGE:ID` imports its package.

    Args:
        run: a run, or its folder.
        task: the task that is returned instead, or the class of its environments. A class gets the time limit of the
            training.

    Raises:
        UserError: there is no such run, one of its constants is impossible, it was trained on a task of your own, which
            cannot be found by a name, or the given task shows other entries or has another action repeat.
    """
    run = run if isinstance(run, Run) else Run(run)
    if task is not None:
        made = tasks.given(task)
        asked, there = map(about_task, (tasks.describe(made), run.config))
        shown, before = map(_entries, (asked, there))
        if asked["observe"] != there["observe"] or {shown, before} == set(MASKS.values()):
            given = f"and the given task shows {shown}: give {before}."
            raise UserError(f"{run.shown} was trained on {before} of the observation, {given}")
        now, before = (each["steps_per_action"] for each in (asked, there))
        if now != before:
            given = f"and the given task has {now}: give the same (beliefrl.with_action_repeat)."
            raise UserError(f"{run.shown} was trained with steps_per_action={before}, {given}")
        return dataclasses.replace(made, max_steps=time_limit(run.config)) if isinstance(task, type) else made
    name, constants = run.config["task"], tuples(run.config["constants"])
    if not tasks.knows(name):
        raise UserError(
            f"{run.shown} was trained on {name}, which has no registered name: in Python, give it with task=. The "
            "command line needs a registered name."
        )
    with _naming(run):
        return tasks.make(name, run.config.get("observe"), run.config.get("faults"), **constants)


def _entries(about: dict[str, Any]) -> str:
    """Which entries the agent sees, given `checks.about_task`."""
    if about["observe"] is not None:
        return f"entries {' '.join(map(str, about['observe']))}"
    return split_mask(about["task"])[1] or "all entries"


@contextlib.contextmanager
def _naming(run: Run) -> Iterator[None]:
    """Name config.json and the commit that wrote it in a UserError about its content, as the version may differ."""
    try:
        yield
    except UserError as error:
        commit = one_line(str(run.config.get("git_commit") or ""))[:12]
        origin = f" (trained at commit {commit})" if commit else ""
        raise UserError(f"{run.given / 'config.json'}{origin} cannot be used: {error}") from None
