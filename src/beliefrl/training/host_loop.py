"""Algorithm 1 with Gymnasium environments, which run on the host: the same phases as in `phases`.

Only the step of the task is outside of what is compiled (`host_steps`). A call of a compiled function takes as much
time as acting, so there is one call for each environment step:

    act             the first action of a stretch of steps
    environments    a step, in lockstep
    go on           record their results; when a round's steps are done, learn (`phases.learn_round`); act again

With the option `overlap`, a second thread starts the updates, and they run while the environments step. The steps of a
round are then chosen with the weights from before the updates of the round before. So what is learned does not depend
on how long a step or an update takes. The first round of a stretch acts with the newest weights. So what is learned
depends on how the steps are divided into stretches, for instance on `eval_every`.

If an environment fails, the training ends. What was learned and recorded until then is saved. During the exploration
nothing is learned, and only the log is saved.
"""

import ctypes
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from beliefrl.agents import Agent
from beliefrl.errors import Fault
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import host_steps, phases, rollout
from beliefrl.training.host_evaluation import Evaluation
from beliefrl.training.host_steps import ActorOutput, StepResult
from beliefrl.training.keys import REVIVE, step_key
from beliefrl.training.lockstep import Lockstep, environment_seeds
from beliefrl.training.phases import Program, SeedState, Stretch
from beliefrl.training.rollout import Episode
from beliefrl.training.rounds import Metrics, round_length


def program(
    agent: Agent,
    task: GymnasiumTask,
    capacity: int,
    episodes: int,
    seeds: Sequence[int],
    make: Callable[[Sequence[str]], Lockstep],
    envs: int = 1,
    overlap: bool = False,
    share: bool = False,
) -> Program:
    """The phases of training, with `envs` environments for each of `seeds`.

    `make` makes environments with these names. With `overlap`, updates are made during steps. With `share`,
    evaluations take place in the environments of the training.
    """
    copies = [""] if envs == 1 else [f", environment {copy}" for copy in range(envs)]
    lanes = [f"seed {seed}{copy}" for seed in seeds for copy in copies]
    loop = HostLoop(agent, task, capacity, make(lanes), envs, overlap)
    evaluation = Evaluation(agent, task, seeds, make, loop.environments if share else None)

    def evaluate(states: Any, keys: Key[Array, " seed"]) -> Episode:
        loop.is_interrupted = share
        return evaluation.play(states, keys, episodes)

    def close() -> None:
        try:
            loop.close()
        finally:
            evaluation.close()

    return Program(
        begin=loop.begin,
        explore=loop.explore,
        pretrain=jax.jit(partial(phases.pretrain, agent), donate_argnums=0),
        refresh=jax.jit(jax.vmap(partial(phases.refresh, agent, task.spec, envs=envs)), donate_argnums=0),
        learn=loop.learn,
        evaluate=evaluate,
        shapes=loop.shapes,
        revive=loop.revive,
        close=close,
    )


def keep_memory() -> None:
    """Let the C library keep freed memory for the next call: a setting of the whole process.

    A compiled function allocates its scratch memory at every call. If it is large, the C library returns it to the
    system each time, and the system clears the pages again: 10 ms for VRM's updates of a cycle.
    """
    if sys.platform == "linux":
        mmap_threshold, trim_threshold, most = -3, -1, 2**31 - 1
        libc = ctypes.CDLL(None)
        if hasattr(libc, "mallopt"):  # glibc's
            libc.mallopt(mmap_threshold, most)
            libc.mallopt(trim_threshold, most)


class HostLoop:
    """The environments of a training, and what is compiled around them."""

    def __init__(
        self,
        agent: Agent,
        task: GymnasiumTask,
        capacity: int,
        environments: Lockstep,
        envs: int = 1,
        overlap: bool = False,
    ):
        """`environments` has `envs` for each seed; with `overlap`, updates are made during their steps."""
        self.agent, self.spec, self.environments, self.envs = agent, task.spec, environments, envs
        self.learner = ThreadPoolExecutor(1, "learner") if overlap else None
        self.is_interrupted = False  # whether an evaluation has used the environments since their last step
        first = phases.on_each_env(envs, lambda obs: rollout.first(agent, task.spec, (), obs))
        sizes = agent, task.spec, envs
        on_seeds = partial(jax.vmap, in_axes=(0, 0, 0, None))
        self._begin = jax.jit(jax.vmap(partial(host_steps.begin, agent, task.spec, capacity, envs)))
        self._first = jax.jit(jax.vmap(first))
        self._act = jax.jit(jax.vmap(partial(host_steps.act, agent, envs), in_axes=(0, None)))
        self._go_on: Any = jax.jit(on_seeds(partial(host_steps.go_on, *sizes)), donate_argnums=1)
        self._learn: Any = jax.jit(jax.vmap(partial(host_steps.learn, *sizes), in_axes=(0, 0, None)), donate_argnums=0)
        self._end_round: Any = jax.jit(on_seeds(partial(host_steps.end_round, *sizes)), donate_argnums=1)
        self._update: Any = jax.jit(jax.vmap(partial(host_steps.update, agent, envs), in_axes=(0, 0, None)))

    def close(self) -> None:
        """End the environments, and the thread of the updates."""
        try:
            self.environments.close()
        finally:
            if self.learner is not None:
                self.learner.shutdown()

    def begin(self, keys: Key[Array, " seed"]) -> SeedState:
        """Seeds before their first steps."""
        return self._begin(keys, self._reset(keys))

    def shapes(self, keys: Key[Array, " seed"]) -> SeedState:
        """What `begin` gives, without its numbers."""
        obs = jax.ShapeDtypeStruct((*self._lanes(len(keys)), self.spec.obs_dim), jnp.float32)
        return jax.eval_shape(self._begin, keys, obs)

    def _lanes(self, seeds: int) -> tuple[int, ...]:
        """The shape of what there is for each environment: (seed,), or (seed, env) with several."""
        return (seeds,) if self.envs == 1 else (seeds, self.envs)

    def _reset(self, keys: Key[Array, " seed"]) -> Any:
        """Begin an episode in every environment; returns the observations, (*lanes, obs)."""
        if self.envs > 1:
            keys = jax.vmap(lambda key: jax.random.split(key, self.envs))(keys)
        obs = self.environments.reset(environment_seeds(keys))
        return obs.reshape(*keys.shape, -1)

    def revive(self, seeds: SeedState, step: int) -> SeedState:
        """Seeds in a new episode of each environment: a checkpoint has no environments, or an evaluation used them."""
        keys = jax.vmap(lambda key: step_key(key, jnp.asarray(step), REVIVE))(seeds.key)
        return seeds._replace(actor=self._first(self._reset(keys)))

    def _continued(self, seeds: SeedState, step: int) -> SeedState:
        """The seeds, in a new episode if an evaluation has interrupted the last one."""
        if self.is_interrupted:
            try:
                seeds = self.revive(seeds, step)
            except Fault as fault:
                fault.seeds, fault.step = seeds, step
                raise
            self.is_interrupted = False
        return seeds

    def explore(self, seeds: SeedState, first: int, steps: int) -> tuple[SeedState, Stretch]:
        """Environment steps without updates; 0 only compiles."""
        seeds = self._continued(seeds, first) if steps else seeds
        log, output = _StretchLog(), self._act(seeds, first)
        if steps == 0:
            self._compile(seeds, output, learns=False)
        for step in range(first, first + steps, self.envs):
            result = self._step(seeds, output, step, log)
            seeds, output, episode = self._proceed(seeds, result, step, seeds.state)
            log.episodes.append(episode)
        return seeds, log.stretch()

    def learn(self, seeds: SeedState, first: int, rounds: int) -> tuple[SeedState, Stretch]:
        """`rounds` rounds of steps and updates from environment step `first` on; 0 only compiles."""
        seeds = self._continued(seeds, first) if rounds else seeds
        log, output, length = _StretchLog(), self._act(seeds, first), round_length(self.agent, self.envs)
        if rounds == 0:
            self._compile(seeds, output, learns=True)
        acting = seeds.state
        for step in range(first, first + rounds * length, self.envs):
            result = self._step(seeds, output, step, log)
            if (step + self.envs - first) % length:
                seeds, output, episode = self._proceed(seeds, result, step, acting)
            else:
                before = seeds.state
                seeds, output, episode, metrics = self._finish(seeds, result, step)
                acting = before if self.learner else seeds.state
                log.metrics.append(metrics)
            log.episodes.append(episode)
        return seeds, log.stretch()

    def _proceed(
        self, seeds: SeedState, result: StepResult, step: int, acting: Any
    ) -> tuple[SeedState, ActorOutput, Episode]:
        """Record the results of a step, and act again with the agent's state `acting`; its newest state stays."""
        rest, output, episode = self._go_on(acting, seeds._replace(state=()), result, step)
        return rest._replace(state=seeds.state), output, episode

    def _finish(
        self, seeds: SeedState, result: StepResult, step: int
    ) -> tuple[SeedState, ActorOutput, Episode, Metrics]:
        """Record the last step of a round, learn, and act again; with a learner, act without waiting for the updates.

        JAX runs the calls of one thread in order, on a CPU too. So a thread of its own starts the updates. `result`
        returns when they have started, and the arrays are ready when they are done.
        """
        if self.learner is None:
            return self._learn(seeds, result, step)
        state = seeds.state
        rest, output, episode, inputs = self._end_round(state, seeds._replace(state=()), result, step)
        state, metrics = self.learner.submit(self._update, state, inputs, step).result()
        return rest._replace(state=state), output, episode, metrics

    def _compile(self, seeds: SeedState, output: ActorOutput, learns: bool) -> None:
        """Compile what follows a step of the environments: else a compilation would look like a slow environment."""
        lanes = output.action.shape[:-1]
        obs, number, never = (
            np.zeros((*lanes, self.spec.obs_dim), np.float32),
            np.zeros(lanes, np.float32),
            np.zeros(lanes, bool),
        )
        result = StepResult(output, obs, number, never, never, dict.fromkeys(self.spec.measures, number), obs)
        single, rest = round_length(self.agent, self.envs) == self.envs, seeds._replace(state=())
        if isinstance(self._go_on, jax.stages.Wrapped) and not (learns and single):  # single: updates after every step
            self._go_on = self._go_on.lower(seeds.state, rest, result, 0).compile()
        if learns and self.learner is None:
            self._learn = self._learn.lower(seeds, result, 0).compile()
        elif learns:
            inputs = jax.eval_shape(self._end_round, seeds.state, rest, result, 0)[-1]
            self._end_round = self._end_round.lower(seeds.state, rest, result, 0).compile()
            self._update = self._update.lower(seeds.state, inputs, 0).compile()

    def _step(self, seeds: SeedState, output: ActorOutput, step: int, log: "_StretchLog") -> StepResult:
        """One step of every environment."""
        try:
            actions = np.asarray(output.action)
            obs, reward, terminated, truncated, measures = self.environments.step(
                actions.reshape(-1, self.spec.action_dim)
            )
            done = terminated | truncated
            fresh = self.environments.restart(done) if done.any() else obs
        except Fault as fault:
            fault.seeds, fault.step, fault.stretch = seeds, step, log.stretch()
            raise
        lanes = actions.shape[:-1]
        results = jax.tree.map(
            lambda leaf: leaf.reshape(*lanes, *leaf.shape[1:]), (obs, reward, terminated, done, measures, fresh)
        )
        return StepResult(output, *results)


class _StretchLog:
    """The metrics and episodes of a stretch, gathered step by step."""

    def __init__(self):
        self.metrics: list[Metrics] = []  # of every round
        self.episodes: list[Episode] = []  # one a step, leaves (*lanes,)

    def stretch(self) -> Stretch:
        """Means over its updates; episodes with leaves (seed, step)."""
        metrics, episodes = jax.device_get((self.metrics, self.episodes))
        means = jax.tree.map(lambda *each: np.mean(each, axis=0), *metrics) if metrics else {}
        columns = jax.tree.map(lambda *each: np.stack(each, axis=1), *episodes) if episodes else None
        return Stretch(means, jax.tree.map(lambda column: column.reshape(len(column), -1), columns))
