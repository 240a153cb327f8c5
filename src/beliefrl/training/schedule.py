"""Training from the first step to the last, on the host: the order of the phases.

The loop is Python over compiled blocks, called stretches (`phases`). A compiled function never calls back. `stages`
yields events, and `session` records them in a run's folder.
"""

import enum
from collections.abc import Callable, Generator, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl.agents import Agent
from beliefrl.errors import Fault, UserError
from beliefrl.runs.options import Options, Processes
from beliefrl.tasks import Task
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import host_loop, keys, phases
from beliefrl.training.lockstep import Lockstep
from beliefrl.training.phases import Program, SeedState
from beliefrl.training.rollout import Episode
from beliefrl.training.rounds import Metrics, round_length, stretch_length


class TrainingProgress(NamedTuple):
    """The position of a training. With all its arrays, it is sufficient to continue."""

    step: int = 0
    pretrained: int = 0  # updates of the pre-training
    refreshed: bool = False  # whether the pre-training is over
    evaluated: int = 0  # step of the last evaluation


class Snapshot(NamedTuple):
    """A training between two stretches. The next stretch reuses the memory of its arrays."""

    progress: TrainingProgress
    seeds: SeedState


class Phase(enum.StrEnum):
    """The activity of a training; the values are shown to the user."""

    STARTING = "starting"
    RESUMING = "resuming"
    MAKING_ENVIRONMENTS = "making the environments"
    COMPILING_AGENT = "compiling the agent"
    COMPILING_EXPLORATION = "compiling the exploration"
    EXPLORING = "exploring"
    COMPILING_PRETRAINING = "compiling the pre-training"
    PRETRAINING = "pre-training"
    COMPILING_LEARNING = "compiling the learning"
    LEARNING = "learning"
    EVALUATING = "evaluating"
    TRAINING = "training"  # for notes from another thread, which does not know the phase
    FAULT = "stopped by a fault"
    FINISHED = "finished"

    @property
    def is_compiling(self) -> bool:
        """Whether the phase is only a compilation."""
        return self.name.startswith("COMPILING")


class Event(NamedTuple):
    """An event of a training. The fields after the first three are set only if they apply."""

    phase: Phase  # the next one
    step: int  # environment steps of each seed so far
    metrics: Metrics = {}  # leaves (seed,): means over the last block of steps
    episodes: Episode | None = None  # leaves (seed, step): of the last block
    evaluation: Episode | None = None  # leaves (seed, mode, episodes)
    states: Any = None  # the agents, if they should be saved
    part: tuple[int, int] | None = None  # of the pre-training: updates done, and their total
    snapshot: Snapshot | None = None  # if the training can stop and be resumed here
    note: str | None = None  # another message for the user, a sentence


def stages(
    agent: Agent,
    task: Task | GymnasiumTask,
    options: Options,
    restore: Callable[[SeedState], Snapshot] | None = None,
    notify: Callable[[str], None] | None = None,
    own_process: bool = False,
    initial: Callable[[SeedState], SeedState] | None = None,
    taken_timesteps: int = 0,
) -> Generator[Event, None, None]:
    """Train; yields an Event before each long operation, and after each operation with results.

    Args:
        agent: the agent to train.
        task: the task to train it on.
        options: the options of the training.
        restore: given the shapes of a training's arrays, returns the snapshot from which to continue.
        notify: called from another thread with a sentence that cannot wait for the next Event.
        own_process: as in `train`.
        initial: given the seeds of a new training, returns them with the arrays of another run (`initial.started`).
            There is no pre-training then, because the networks of the other run have had one.
        taken_timesteps: the largest number of timesteps that a ring has from the other run.

    Raises:
        Fault: a Gymnasium environment failed. It is raised after an Event with everything learned until then.
    """
    numbers = range(options.seed, options.seed + options.seeds)
    sizes = capacity(agent, options, taken_timesteps), options.eval_episodes
    if isinstance(task, GymnasiumTask):
        yield Event(Phase.MAKING_ENVIRONMENTS, 0)
        if own_process:
            host_loop.keep_memory()
        processes = _processes(options, own_process)
        make = partial(Lockstep, task, processes=processes, notify=notify, timeout=options.step_timeout)
        how = options.envs, options.overlap, options.share_env
        program = host_loop.program(agent, task, *sizes, numbers, make, *how)
    else:
        program = phases.compile_program(agent, task, *sizes, options.envs)
    of_seeds, at = jax.vmap(jax.random.key)(np.array(numbers)), TrainingProgress(refreshed=initial is not None)
    try:
        if restore is None:
            yield Event(Phase.COMPILING_AGENT, 0)
            seeds = program.begin(of_seeds)
            seeds = seeds if initial is None else initial(seeds)
        else:
            at, seeds = restore(program.shapes(of_seeds))
            seeds = program.revive(seeds, at.step)
        for event in _stages(agent, program, options, at, seeds):
            at = at if event.snapshot is None else event.snapshot.progress
            yield event
    except Fault as fault:
        if fault.seeds is not None:
            metrics, episodes = fault.stretch or ({}, None)
            event = Event(Phase.FAULT, fault.step, metrics, episodes)
            if fault.step >= agent.step_start_rl:
                snapshot = Snapshot(at._replace(step=fault.step), fault.seeds)
                event = event._replace(states=fault.seeds.state, snapshot=snapshot)
            yield event
        raise
    finally:
        program.close()


def _stages(
    agent: Agent, program: Program, options: Options, at: TrainingProgress, seeds: SeedState
) -> Iterator[Event]:
    if _is_due(options, at):  # a fault came before the end of this evaluation
        at = yield from _evaluate(agent, program, options, at, seeds, Phase.LEARNING)
    if at.step < min(agent.step_start_rl, options.steps):
        at, seeds = yield from _explore(agent, program, options, at, seeds)
    if at.step < options.steps and agent.pretrain_updates and not at.refreshed:
        at, seeds = yield from _pretrain(agent, program, options, at, seeds)
    if at.step < options.steps:
        at, seeds = yield from _learn(agent, program, options, at, seeds)
    last = None
    if at.evaluated < at.step:
        yield from _evaluation(agent, program, at, seeds, Phase.LEARNING)
        last = Snapshot(at._replace(evaluated=at.step), seeds)
    yield Event(Phase.FINISHED, at.step, snapshot=last)


Stage = Generator[Event, None, Snapshot]  # returns the training at its end


def _explore(agent: Agent, program: Program, options: Options, at: TrainingProgress, seeds: SeedState) -> Stage:
    """Steps with the untrained policy."""
    yield Event(Phase.COMPILING_EXPLORATION, at.step)
    seeds, _ = program.explore(seeds, at.step, 0)
    yield Event(Phase.EXPLORING, at.step)
    explored, stretch = min(agent.step_start_rl, options.steps), stretch_length(agent, options.envs)
    while at.step < explored:
        until = min(stretch, explored - at.step, _until(at.step, options.eval_every))
        steps = -(-until // options.envs) * options.envs
        seeds, log = program.explore(seeds, at.step, steps)
        at = at._replace(step=at.step + steps)
        yield Event(Phase.EXPLORING, at.step, episodes=log.episodes)
        at = yield from _evaluate(agent, program, options, at, seeds, Phase.EXPLORING)
    return Snapshot(at, seeds)


def _pretrain(agent: Agent, program: Program, options: Options, at: TrainingProgress, seeds: SeedState) -> Stage:
    """Updates without steps; then the replay is perceived again."""
    if at.pretrained < agent.pretrain_updates:
        yield Event(Phase.COMPILING_PRETRAINING, at.step)
        seeds, _ = program.pretrain(seeds, at.pretrained, 0)
        yield Event(Phase.PRETRAINING, at.step)
    while at.pretrained < agent.pretrain_updates:
        updates = min(stretch_length(agent, options.envs), agent.pretrain_updates - at.pretrained)
        seeds, metrics = program.pretrain(seeds, at.pretrained, updates)
        at = at._replace(pretrained=at.pretrained + updates)
        means = {f"pretrain_{name}": mean for name, mean in metrics.items()}
        part = at.pretrained, agent.pretrain_updates
        yield Event(Phase.PRETRAINING, at.step, means, part=part, snapshot=Snapshot(at, seeds))
    seeds, at = program.refresh(seeds), at._replace(refreshed=True)
    yield Event(Phase.PRETRAINING, at.step, snapshot=Snapshot(at, seeds))
    return Snapshot(at, seeds)


def _learn(agent: Agent, program: Program, options: Options, at: TrainingProgress, seeds: SeedState) -> Stage:
    """Rounds of steps and updates."""
    yield Event(Phase.COMPILING_LEARNING, at.step)
    seeds, _ = program.learn(seeds, at.step, 0)
    yield Event(Phase.LEARNING, at.step)
    length, stretch = round_length(agent, options.envs), stretch_length(agent, options.envs)
    while at.step < options.steps:
        until = min(options.steps - at.step, _until(at.step, options.eval_every))
        rounds = min(-(-until // length), stretch // length)
        seeds, log = program.learn(seeds, at.step, rounds)
        at = at._replace(step=at.step + rounds * length)
        yield Event(Phase.LEARNING, at.step, log.metrics, log.episodes)
        at = yield from _evaluate(agent, program, options, at, seeds, Phase.LEARNING)
    return Snapshot(at, seeds)


def _evaluate(
    agent: Agent, program: Program, options: Options, at: TrainingProgress, seeds: SeedState, then: Phase
) -> Generator[Event, None, TrainingProgress]:
    """Evaluate if an evaluation is due. Then the training can stop."""
    if _is_due(options, at):
        yield from _evaluation(agent, program, at, seeds, then)
        at = at._replace(evaluated=at.step)
    yield Event(then, at.step, snapshot=Snapshot(at, seeds))
    return at


def _is_due(options: Options, at: TrainingProgress) -> bool:
    """Whether a multiple of `eval_every` has passed since the last evaluation."""
    return at.evaluated // options.eval_every < at.step // options.eval_every


ROOM = 1.25  # timesteps in the replay per step: with episodes of at least 4 steps it has the whole training


def capacity(agent: Agent, options: Options, taken_timesteps: int = 0) -> int:
    """Timesteps in the replay of each environment: one for each of its steps, and room for those that end episodes.

    There is also room for `taken_timesteps` from another run. If episodes are shorter than 4 steps on average, the
    oldest timesteps are replaced before the training ends.

    Raises:
        UserError: `replay_capacity` has no room for the exploration, or for a window.
    """
    explored, steps = (-(-each // options.envs) for each in (agent.step_start_rl, options.steps))
    needed = max(2 * explored, agent.window.length + 1)  # `refresh` wants all of the exploration
    if options.steps > agent.step_start_rl and options.replay_capacity < needed * options.envs:
        raise UserError(
            f"replay_capacity={options.replay_capacity} is too small: this agent needs at least "
            f"{needed * options.envs}."
        )
    return min(
        options.replay_capacity // options.envs, max(int(ROOM * steps), min(needed, 2 * steps)) + taken_timesteps
    )


def _processes(options: Options, own_process: bool) -> Processes:
    """Whether environments have processes of their own; "auto" depends on the program and on a time limit.

    Shared environments may be robots. The measurement of "auto" would move them, so there is none.
    """
    if options.processes != "auto":
        return options.processes
    if not own_process:
        return "never"
    if options.share_env:
        return "always" if options.seeds > 1 or options.step_timeout is not None else "never"
    return "auto" if options.step_timeout is None else "always"


def _until(step: int, every: int) -> int:
    """Steps to the next multiple of `every`."""
    return every - step % every


def _evaluation(agent: Agent, program: Program, at: TrainingProgress, seeds: SeedState, then: Phase) -> Iterator[Event]:
    step = at.step
    yield Event(Phase.EVALUATING, step, snapshot=Snapshot(at, seeds))
    of_step = jax.vmap(lambda key: keys.step_key(key, jnp.asarray(step), keys.EVALUATE))
    try:
        result = program.evaluate(agent.networks(seeds.state), of_step(seeds.key))
    except UserError as error:  # also of an environment that cannot be made
        fault = error if isinstance(error, Fault) else Fault(str(error))
        fault.seeds, fault.step = seeds, step
        raise fault from None
    yield Event(then, step, evaluation=result, states=seeds.state)
