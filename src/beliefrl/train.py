"""Training from the first step to the last, on the host: which phase is called when, and what is logged.

The loop is Python over compiled stretches (`phases`); logs, progress and Ctrl-C live here, nothing is called back
from inside a compiled function. `stages` yields what happens, `train` records it in a run's folder.
"""

import dataclasses
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from beliefrl import agents, host_loop, phases, runs, tasks
from beliefrl.agents import Agent
from beliefrl.analysis.curves import draw_curve
from beliefrl.evaluation import MODES, MOST_EPISODES, summary
from beliefrl.lockstep import PROCESSES
from beliefrl.phases import Metrics, Program
from beliefrl.rollout import Episode
from beliefrl.runs import Recorder, Run
from beliefrl.tasks import Task
from beliefrl.tasks.gymnasium import Fault, GymnasiumTask
from beliefrl.types import UserError, check_choice, check_range


@dataclasses.dataclass(frozen=True)
class Options:
    """How long, how often and how a training is evaluated."""

    steps: int = 20_000
    """Environment steps of each seed, rounded up to whole cycles of the agent."""
    seeds: int = 1
    """How many seeds are trained, side by side in one program."""
    seed: int = 0
    """Number of the first seed; the others follow it."""
    eval_every: int = 2_000
    """Environment steps between two evaluations (Appendix B)."""
    eval_episodes: int = 5
    """Episodes of each evaluation, with sampled actions and again with mode actions."""
    replay_capacity: int = 1_000_000
    """Most moments that a seed's replay keeps; the oldest make room."""
    processes: str = "auto"
    """Gymnasium environments: a process for each (always), for none (never), or where that pays (auto, from the command
    line). A Python script that says always must begin under `if __name__ == "__main__":`."""

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        check_range(self, ("steps", "eval_every", "replay_capacity"), 1)
        check_range(self, ("eval_episodes",), 1, MOST_EPISODES)
        check_range(self, ("seeds",), 1, 10_000)
        check_range(self, ("seed",), 0, 2_000_000_000)
        check_choice(self, "processes", PROCESSES)


class Event(NamedTuple):
    """What has just happened in a training; fields beyond the first three only where they apply."""

    doing: str  # what comes next, in words
    step: int  # environment steps of each seed so far
    metrics: Metrics = {}  # leaves (seed,): means over the last stretch
    episodes: Episode | None = None  # leaves (seed, stretch)
    evaluation: Episode | None = None  # leaves (seed, mode, episodes)
    states: Any = None  # the agents, where they are to be saved
    part: tuple[int, int] | None = None  # of the pre-training: updates done, of how many


def stages(agent: Agent, task: Task | GymnasiumTask, options: Options) -> Iterator[Event]:
    """Train; yields an Event before whatever takes long and after whatever gave something to tell.

    Raises:
        Fault: of a Gymnasium environment, after an Event with what was learned until then.
    """
    numbers = range(options.seed, options.seed + options.seeds)
    sizes = _capacity(agent, options), options.eval_episodes
    if isinstance(task, GymnasiumTask):
        program = host_loop.program(agent, task, *sizes, numbers, options.processes)
    else:
        program = phases.compile_program(agent, task, *sizes)
    try:
        yield from _stages(agent, program, options)
    except Fault as fault:
        if fault.seeds is not None:
            metrics, episodes = fault.told or ({}, None)
            yield Event("stopped by a fault", fault.step, metrics, episodes, states=fault.seeds.state)
        raise
    finally:
        program.close()


def _stages(agent: Agent, program: Program, options: Options) -> Iterator[Event]:
    start = min(agent.step_start_rl, options.steps)
    keys = jax.vmap(jax.random.key)(np.arange(options.seed, options.seed + options.seeds))
    stretch = phases.stretch_length(agent)

    yield Event("compiling the exploration", 0)
    seeds, step, evaluated = program.begin(keys), 0, 0
    while step < start:
        steps = min(stretch, start - step, _until(step, options.eval_every))
        seeds, told = program.explore(seeds, step, steps)
        step += steps
        yield Event("exploring", step, episodes=told.episodes)
        if step % options.eval_every == 0:
            yield from _evaluation(program, seeds, evaluated := step)

    if step < options.steps and agent.pretrain_updates:
        yield Event("compiling the pre-training", step)
        for first in range(0, agent.pretrain_updates, stretch):
            updates = min(stretch, agent.pretrain_updates - first)
            seeds, metrics = program.pretrain(seeds, first, updates)
            part = (first + updates, agent.pretrain_updates)
            yield Event("pre-training", step, {f"pretrain_{name}": mean for name, mean in metrics.items()}, part=part)
        seeds = program.relive(seeds)

    if step < options.steps:
        yield Event("compiling the learning", step)
    while step < options.steps:
        until = min(options.steps - step, _until(step, options.eval_every))
        cycles = min(-(-until // agent.cycle), stretch // agent.cycle)
        seeds, told = program.learn(seeds, step, cycles)
        before, step = step, step + cycles * agent.cycle
        yield Event("learning", step, told.metrics, told.episodes)
        if step // options.eval_every > before // options.eval_every:
            yield from _evaluation(program, seeds, evaluated := step)
    if evaluated < step:
        yield from _evaluation(program, seeds, step)


def _capacity(agent: Agent, options: Options) -> int:
    """Moments in a seed's replay: no more than can come, a moment a step and one more where an episode ends."""
    if options.steps > agent.step_start_rl:
        needed = max(2 * agent.step_start_rl, agent.window.length + 1)  # `relive` wants all of the exploration
        if options.replay_capacity < needed:
            raise UserError(
                f"replay_capacity={options.replay_capacity} is too small: this agent needs at least {needed}."
            )
    return min(options.replay_capacity, 2 * options.steps)


def _until(step: int, every: int) -> int:
    """Steps to the next multiple of `every`."""
    return every - step % every


def _evaluation(program: Program, seeds: phases.Seed, step: int) -> Iterator[Event]:
    yield Event("evaluating", step)
    keys = jax.vmap(lambda key: jax.random.fold_in(jax.random.fold_in(key, phases.EVALUATE), step))(seeds.key)
    try:
        result = program.evaluate(seeds.state, keys)
    except Fault as fault:
        fault.seeds, fault.step = seeds, step
        raise
    yield Event("learning", step, evaluation=result, states=seeds.state)


def train(
    agent: Agent | str,
    task: Task | GymnasiumTask | str,
    out: str | os.PathLike[str] | None = None,
    report: Callable[[Event], None] | None = None,
    **options: Any,
) -> Run:
    """Train an agent on a task and record it in a folder.

    Args:
        agent: an agent, or the name of one with its default hyperparameters.
        task: a task, or the name of one.
        out: the run's folder, which must not exist; None is runs/AGENT-TASK-1, or the next free number.
        report: called with every Event as it happens, for progress.
        options: the fields of `Options`: steps, seeds, seed, eval_every, eval_episodes, replay_capacity, processes.

    Returns:
        The finished run: its results, its log, its files (`runs`).

    Raises:
        UserError: an unknown name or option, an impossible value, `out` exists, or a Gymnasium environment did what
            none may do; then what was learned and logged until that step is saved.
    """
    agent = agents.make(agent) if isinstance(agent, str) else agent
    made: Any = tasks.make(task) if isinstance(task, str) else task
    known = [field.name for field in dataclasses.fields(Options)]
    for name in options:
        if name not in known:
            raise UserError(f"Training has no option {name!r}: it has {', '.join(known)}.")
    chosen = Options(**options)
    _capacity(agent, chosen)  # complains before there is a folder, as the next line does
    spec = made.spec
    config = {
        "agent": agents.name_of(agent),
        "hyperparameters": dataclasses.asdict(agent),  # pyright: ignore[reportArgumentType]
        **tasks.describe(made),
        "options": dataclasses.asdict(chosen),
        **runs.provenance(),
    }
    recorder = Recorder(out or runs.free_folder(f"{config['agent']}-{config['task']}"), config)
    results = None
    try:
        for event in stages(agent, made, chosen):
            results = _record(recorder, event, spec.has_success) or results
            if report is not None:
                report(event)
    finally:
        recorder.close()
    recorder.finish(results or {})
    draw_curve(recorder)
    return recorder


def _record(recorder: Recorder, event: Event, has_success: bool) -> dict[str, Any] | None:
    """Log what an event tells of every seed; returns the summary of an evaluation."""
    metrics = {name: np.asarray(values) for name, values in event.metrics.items()}
    for index, seed in enumerate(recorder.seeds):
        if metrics and event.part:
            recorder.log(seed, "pretrain", event.part[0], {k: float(v[index]) for k, v in metrics.items()})
        elif metrics:
            recorder.log(seed, "update", event.step, {k: float(v[index]) for k, v in metrics.items()})
        if event.episodes is not None:
            episodes = jax.tree.map(lambda leaf, index=index: np.asarray(leaf[index]), event.episodes)
            for end in np.flatnonzero(episodes.done):
                recorder.log(seed, "episode", event.step, _episode(episodes, end, has_success))
        if event.evaluation is not None:
            result = jax.tree.map(lambda leaf, index=index: np.asarray(leaf[index]), event.evaluation)
            recorder.log(seed, "evaluation", event.step, _evaluated(result, has_success))
    if event.states is not None:
        recorder.flush()
        recorder.save(event.states)
    if event.evaluation is None:
        return None
    return {"step": event.step} | summary(event.evaluation, has_success)


def _episode(episodes: Episode, end: Any, has_success: bool) -> dict[str, Any]:
    success = {"success": bool(episodes.success[end])} if has_success else {}
    return {"return": float(episodes.total[end]), "length": int(episodes.length[end])} | success


def _evaluated(result: Episode, has_success: bool) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for index, mode in enumerate(MODES):
        values[mode] = [float(total) for total in result.total[index]]
        if has_success:
            values[f"{mode}_success"] = [bool(success) for success in result.success[index]]
    return values
