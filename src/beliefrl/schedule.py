"""Training from the first step to the last, on the host: which phase is called when.

The loop is Python over compiled stretches (`phases`); nothing is called back from inside a compiled function. `stages`
yields what happens, `train` records it in a run's folder.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from beliefrl import host_loop, phases, trackers
from beliefrl.agents import Agent
from beliefrl.evaluation import MOST_EPISODES
from beliefrl.lockstep import PROCESSES
from beliefrl.phases import Metrics, Program, Seed
from beliefrl.rollout import Episode
from beliefrl.runs import PRECISIONS
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
    checkpoint_steps: int = 2_000
    """Environment steps between two checkpoints of everything (0: none by steps)."""
    checkpoint_minutes: float = 10.0
    """Minutes between two checkpoints, if they pass sooner (0: none by time)."""
    keep_checkpoints: int = 2
    """How many of the last checkpoints are kept."""
    precision: Literal["float32", "tensorfloat32"] = "float32"
    """Precision of matrix products: float32, or tensorfloat32, which lets an NVIDIA GPU (Ampere or later) round their
    factors to 10 bits of mantissa to be faster. A CPU computes in float32 either way."""
    track: tuple[Literal["tensorboard", "wandb"], ...] = ("tensorboard",)
    """Where numbers go besides the run's own logs: tensorboard, wandb (extra `wandb`; offline unless WANDB_MODE says
    otherwise), both, or nowhere."""

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        check_range(self, ("steps", "eval_every", "replay_capacity"), 1)
        check_range(self, ("eval_episodes",), 1, MOST_EPISODES)
        check_range(self, ("checkpoint_steps", "checkpoint_minutes"), 0)
        check_range(self, ("keep_checkpoints",), 1, 1_000_000)
        check_range(self, ("seeds",), 1, 10_000)
        check_range(self, ("seed",), 0, 2_000_000_000)
        check_choice(self, "processes", PROCESSES)
        check_choice(self, "precision", PRECISIONS)
        for name in self.track:
            if name not in trackers.TRACKERS:
                raise UserError(f"track={name} is impossible: it must be {' or '.join(trackers.TRACKERS)}.")


class Progress(NamedTuple):
    """How far a training is; with all its arrays, what is needed to go on."""

    step: int = 0
    pretrained: int = 0  # updates of the pre-training
    relived: bool = False  # whether the pre-training is over
    evaluated: int = 0  # step of the last evaluation


class Snapshot(NamedTuple):
    """A training between two stretches; its arrays are used up when the next one begins."""

    progress: Progress
    seeds: Seed


class Event(NamedTuple):
    """What has just happened in a training; fields beyond the first three only where they apply."""

    doing: str  # what comes next, in words
    step: int  # environment steps of each seed so far
    metrics: Metrics = {}  # leaves (seed,): means over the last stretch
    episodes: Episode | None = None  # leaves (seed, stretch)
    evaluation: Episode | None = None  # leaves (seed, mode, episodes)
    states: Any = None  # the agents, where they are to be saved
    part: tuple[int, int] | None = None  # of the pre-training: updates done, of how many
    snapshot: Snapshot | None = None  # where a training can be left, and gone on from
    note: str | None = None  # something else that the user should know, a sentence


def stages(
    agent: Agent, task: Task | GymnasiumTask, options: Options, restore: Callable[[Seed], Snapshot] | None = None
) -> Iterator[Event]:
    """Train; yields an Event before whatever takes long and after whatever gave something to tell.

    `restore` is given the shapes of a training's arrays, and returns those to go on from.

    Raises:
        Fault: of a Gymnasium environment, after an Event with what was learned until then.
    """
    numbers = range(options.seed, options.seed + options.seeds)
    sizes = capacity(agent, options), options.eval_episodes
    if isinstance(task, GymnasiumTask):
        program = host_loop.program(agent, task, *sizes, numbers, options.processes)
    else:
        program = phases.compile_program(agent, task, *sizes)
    keys = jax.vmap(jax.random.key)(np.array(numbers))
    try:
        if restore is None:
            start = Snapshot(Progress(), program.begin(keys))
        else:
            at, seeds = restore(program.shapes(keys))
            start = Snapshot(at, program.revive(seeds, at.step))
        yield from _stages(agent, program, options, *start)
    except Fault as fault:
        if fault.seeds is not None:
            metrics, episodes = fault.told or ({}, None)
            yield Event("stopped by a fault", fault.step, metrics, episodes, states=fault.seeds.state)
        raise
    finally:
        program.close()


def _stages(agent: Agent, program: Program, options: Options, at: Progress, seeds: Seed) -> Iterator[Event]:
    explored = min(agent.step_start_rl, options.steps)
    stretch = phases.stretch_length(agent)

    if at.step < explored:
        yield Event("compiling the exploration", at.step)
    while at.step < explored:
        steps = min(stretch, explored - at.step, _until(at.step, options.eval_every))
        seeds, told = program.explore(seeds, at.step, steps)
        at = at._replace(step=at.step + steps)
        yield Event("exploring", at.step, episodes=told.episodes)
        if at.step % options.eval_every == 0:
            yield from _evaluation(program, seeds, at.step)
            at = at._replace(evaluated=at.step)
        yield Event("exploring", at.step, snapshot=Snapshot(at, seeds))

    if at.step < options.steps and agent.pretrain_updates and not at.relived:
        yield Event("compiling the pre-training", at.step)
        while at.pretrained < agent.pretrain_updates:
            updates = min(stretch, agent.pretrain_updates - at.pretrained)
            seeds, metrics = program.pretrain(seeds, at.pretrained, updates)
            at = at._replace(pretrained=at.pretrained + updates)
            told = {f"pretrain_{name}": mean for name, mean in metrics.items()}
            part = at.pretrained, agent.pretrain_updates
            yield Event("pre-training", at.step, told, part=part, snapshot=Snapshot(at, seeds))
        seeds, at = program.relive(seeds), at._replace(relived=True)

    if at.step < options.steps:
        yield Event("compiling the learning", at.step)
    while at.step < options.steps:
        until = min(options.steps - at.step, _until(at.step, options.eval_every))
        cycles = min(-(-until // agent.cycle), stretch // agent.cycle)
        seeds, told = program.learn(seeds, at.step, cycles)
        before, at = at.step, at._replace(step=at.step + cycles * agent.cycle)
        yield Event("learning", at.step, told.metrics, told.episodes)
        if at.step // options.eval_every > before // options.eval_every:
            yield from _evaluation(program, seeds, at.step)
            at = at._replace(evaluated=at.step)
        yield Event("learning", at.step, snapshot=Snapshot(at, seeds))
    if at.evaluated < at.step:
        yield from _evaluation(program, seeds, at.step)
        yield Event("finished", at.step, snapshot=Snapshot(at._replace(evaluated=at.step), seeds))


def capacity(agent: Agent, options: Options) -> int:
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


def _evaluation(program: Program, seeds: Seed, step: int) -> Iterator[Event]:
    yield Event("evaluating", step)
    keys = jax.vmap(lambda key: jax.random.fold_in(jax.random.fold_in(key, phases.EVALUATE), step))(seeds.key)
    try:
        result = program.evaluate(seeds.state, keys)
    except Fault as fault:
        fault.seeds, fault.step = seeds, step
        raise
    yield Event("learning", step, evaluation=result, states=seeds.state)
