"""The networks that a training starts with, if they come from another run (the option init_from).

They are copied to initial.safetensors in the new run's folder, so the other run is not needed again. Networks and
running statistics are copied. Optimisers, replay, memories and step counts start anew.
"""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl import agents
from beliefrl.agents import Agent
from beliefrl.agents.hyperparameters import named_by, values_before
from beliefrl.errors import UserError
from beliefrl.runs import arrays, best
from beliefrl.runs.options import Options
from beliefrl.runs.records import sessions
from beliefrl.runs.run import Run
from beliefrl.training import initial_replay
from beliefrl.training.phases import SeedState
from beliefrl.types import Spec, plain

FILE = "initial.safetensors"


def seeds_there(source: Run, options: Options) -> list[int]:
    """The index of the seed in the other run, for each seed of this training."""
    return [(seed - source.seeds[0]) % len(source.seeds) for seed in range(options.seed, options.seed + options.seeds)]


def taken(source: Run, options: Options, agent: Agent, spec: Spec) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The initial networks of all seeds by their names, and where they come from, for config.json.

    Seed n starts from seed n of the other run, `source`. If it has fewer seeds, its seeds are reused in a cycle.

    Raises:
        UserError: the other run has no trained agent, its agent was not pre-trained, or the agents differ in
            an array or in one of `network_settings`.
    """
    path = source.agents(options.init_best)
    try:
        saved = _fitting(source, arrays.load(path), agent, spec)
    except UserError:
        if source.config["agent"] == agents.name_of(agent):
            _refuse_other_settings(source, agent)  # a hyperparameter says more than the first array that differs
        raise
    _refuse_other_settings(source, agent)
    seeds, index = range(options.seed, options.seed + options.seeds), seeds_there(source, options)
    ends = best.evaluations(source.folder, len(source.seeds)) if options.init_best else _last_steps(source)
    _refuse_untrained(source, agent, [ends[at] for at in index])
    session = sessions(source.config)[-1]
    origin = {
        "run": source.shown,
        "agent": source.config["agent"],
        "task": source.config["task"],
        "git_commit": session.get("git_commit"),
        "best": options.init_best,
        "seeds": {seed: {"seed": source.seeds[at], **(ends[at] or {})} for seed, at in zip(seeds, index, strict=True)},
    }
    return {name: array[index] for name, array in saved.items()}, origin


def write(folder: pathlib.Path, files: dict[str, dict[str, np.ndarray]]) -> None:
    """Write the initial arrays to files of these names in a run's folder, and forget them: a replay may be large."""
    for name in list(files):
        arrays.write_whole(folder / name, arrays.packed(files.pop(name)))


def started(folder: pathlib.Path, agent: Agent, with_replay: bool, seeds: SeedState) -> SeedState:
    """The seeds of a training before its first step, with the initial arrays in a run's folder.

    Raises:
        UserError: a file is damaged or missing, or does not fit.
    """
    seeds = seeds._replace(state=started_states(folder, agent, seeds.state))
    return seeds._replace(replay=initial_replay.started(folder, seeds.replay)) if with_replay else seeds


def started_states(folder: pathlib.Path, agent: Agent, states: Any) -> Any:
    """The first states of a training, leaves (seed, ...), with the initial networks in a run's folder.

    Raises:
        UserError: the file is damaged, or does not fit the agent.
    """
    networks = arrays.read(folder / FILE, agent.networks(states))
    named = {jax.tree_util.keystr(where): leaf for where, leaf in jax.tree_util.tree_leaves_with_path(networks)}
    return jax.tree_util.tree_map_with_path(
        lambda where, leaf: jnp.asarray(named.get(jax.tree_util.keystr(where), leaf)), states
    )


def _last_steps(source: Run) -> list[dict[str, Any] | None]:
    """{"step"} at which each seed was saved. A seed that has diverged, or a file without its step: the last evaluation.

    At an error of an environment, agents are saved without an evaluation.
    """
    saved = arrays.about(source.agents()).get("step", "")
    steps = []
    for seed in source.seeds:
        evaluated = max((row["step"] for row in source.rows(seed, "evaluation")), default=None)
        steps.append(int(saved) if saved.isdecimal() and not source.has_diverged(seed) else evaluated)
    return [None if step is None else {"step": step} for step in steps]


def _refuse_untrained(source: Run, agent: Agent, ends: list[dict[str, Any] | None]) -> None:
    """Refuse agents that were saved before their pre-training: a training with init_from has none."""
    envs = source.options.envs
    explored = -(-source.config["hyperparameters"].get("step_start_rl", 0) // envs) * envs
    if not agent.pretrain_updates or "initial" in source.config:
        return
    for end in ends:
        if end is not None and end["step"] <= explored:
            raise UserError(
                f"{source.shown} cannot be init_from: its agent was saved at step {end['step']:,}, before the "
                "pre-training; train it for more steps."
            )


def _refuse_other_settings(source: Run, agent: Agent) -> None:
    """Refuse other `network_settings`, which `_fitting` cannot see or names badly.

    Layer normalisation has no arrays of its own, and memories with other time constants may have equal shapes.
    """
    recorded = values_before(agent) | source.config["hyperparameters"]
    for name, here in named_by(agent, "network_settings").items():
        there = plain(recorded.get(name, getattr(type(agent), name, here)))
        if _meaning(here) != _meaning(there):
            raise UserError(
                f"{source.shown} cannot be init_from: it was trained with {name}={there}, and this training "
                f"has {here}; set {name}={there}."
            )


def _meaning(value: Any) -> Any:
    """A list, or whether something else is on. An empty list is off."""
    return value if isinstance(value, list) and value else bool(value)


def _fitting(source: Run, saved: dict[str, np.ndarray], agent: Agent, spec: Spec) -> dict[str, np.ndarray]:
    """The networks among the arrays of a saved agent.

    Raises:
        UserError: they do not fit `agent` on its task; it names the first array that differs.
    """
    state = jax.eval_shape(lambda key: agent.init(key, spec), jax.random.key(0))
    wanted, known = arrays.shapes(jax.eval_shape(agent.networks, state)), arrays.shapes(state)
    for name in wanted.keys() - known.keys():
        raise UserError(f"init_from is impossible: networks() of this agent adds {name.lstrip('.')} to its state.")
    for name in [*wanted, *(name for name in saved if name not in known)]:
        there = f"the shape {saved[name].shape[1:]}" if name in saved else "no such array"
        here = f"the shape {wanted[name].shape}" if name in wanted else "no such array"
        if there != here:
            raise UserError(
                f"{source.shown} ({source.config['agent']} on {source.config['task']}) cannot be init_from: its "
                f"{name.lstrip('.')} has {there}, this training's has {here}; the networks must be the same."
            )
    return {name: saved[name] for name in wanted}
