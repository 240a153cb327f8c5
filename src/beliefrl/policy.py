"""A trained policy to deploy: numpy in and out, many at once, and an export that needs none of this library.

    policy = beliefrl.load("runs/first")
    action, state = policy.predict(obs)                                          # an episode begins
    action, state = policy.predict(obs, reward, state, episode_start=False)      # and goes on

In the manner of Stable-Baselines3's recurrent policies; the reward is one input more, as beliefs are formed of it.
"""

import os
import pathlib
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from beliefrl.agents import Agent
from beliefrl.arrays import write_whole
from beliefrl.evaluation import restore_seed
from beliefrl.runs import Run
from beliefrl.tasks import Task
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.types import LARGEST, Spec, Step, UserError

State = tuple[np.ndarray, ...]


class Policy:
    """What a training has learned, as a function from perceptions to actions."""

    def __init__(self, agent: Agent, spec: Spec, state: Any, seed: int = 0, precision: str = "float32"):
        """Of one trained state of an agent; `seed` is of the sampled actions, `precision` that of `Run.precision`."""
        self.agent, self.spec, self.precision = agent, spec, precision
        self._state = jax.device_put(state)
        self._structure = jax.tree.structure(agent.reset(spec))
        self._act = jax.jit(lambda *inputs: self._step(self._state, *inputs))
        self._key, self._calls = seed, 0

    def _step(self, agent_state, obs, reward, state, episode_start, seed, deterministic):
        """Act for a batch; `state` is the leaves of the memory and the action before, leaves (batch, ...)."""
        *memory, prev_action = state
        memory = self._structure.unflatten(memory)
        step = Step(
            obs=obs,
            reward=jnp.where(episode_start, 0.0, reward),
            prev_action=jnp.where(episode_start[:, None], 0.0, prev_action),
            is_first=episode_start,
            terminated=jnp.zeros_like(episode_start),
        )
        key = jax.random.key(seed)
        keys = jax.vmap(lambda index: jax.random.fold_in(key, index))(jnp.arange(obs.shape[0]))

        def act(memory, step, key):
            return self.agent.act(agent_state, memory, step, key, ~deterministic)

        with jax.default_matmul_precision(self.precision):
            action, memory = jax.vmap(act)(memory, step, keys)
        return action, (*jax.tree.leaves(memory), action)

    def initial_state(self, batch: int) -> State:
        """The state in which `batch` episodes begin."""
        leaves = [*jax.tree.leaves(self.agent.reset(self.spec)), jnp.zeros(self.spec.action_dim)]
        return tuple(np.zeros((batch, *leaf.shape), leaf.dtype) for leaf in leaves)

    def predict(
        self,
        obs: Any,
        reward: Any = 0.0,
        state: State | None = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, State]:
        """Perceive one moment of one or many episodes, and act.

        Args:
            obs: o_t, (obs,) or (batch, obs).
            reward: r_{t-1} that came with it, a number or (batch,); of no account where an episode begins.
            state: what the last call returned; None where all episodes begin.
            episode_start: whether an episode begins with this moment, a bool or (batch,); None: where `state` is None.
            deterministic: the policy's mode, or a sample.

        Returns:
            The action in [-1, 1], (action,) or (batch, action), and the state for the next call.

        Raises:
            UserError: an input of another shape.
        """
        obs = np.asarray(obs, np.float32)
        single = obs.ndim == 1
        obs = obs[None] if single else obs
        if obs.ndim != 2 or obs.shape[1] != self.spec.obs_dim:
            size = self.spec.obs_dim
            raise UserError(f"obs has the shape {obs.shape[single:]}: it must be ({size},) or (batch, {size}).")
        batch = len(obs)
        begins = state is None if episode_start is None else episode_start
        fresh = self.initial_state(batch)
        state = fresh if state is None else state
        if [np.shape(leaf) for leaf in state] != [leaf.shape for leaf in fresh]:
            raise UserError(f"state does not fit {batch} episodes of this policy: give what `predict` gave for them.")
        reward = self._each(reward, batch, np.float32, "reward")
        begins = self._each(begins, batch, bool, "episode_start")
        self._calls += 1
        seed = np.uint32((self._key * 1_000_003 + self._calls) % (LARGEST + 1))
        action, after = jax.device_get(self._act(obs, reward, state, begins, seed, np.bool_(deterministic)))
        return (action[0] if single else action), after

    @staticmethod
    def _each(value: Any, batch: int, kind: Any, name: str) -> np.ndarray:
        """A number for each episode of a batch."""
        value = np.asarray(value, kind)
        if value.shape not in ((), (batch,)):
            raise UserError(f"{name} has the shape {value.shape}: it must be one number or ({batch},).")
        return np.broadcast_to(value, (batch,))

    def export(self, path: str | os.PathLike[str]) -> None:
        """Write the policy as one file that jax loads without this library, for any batch, on CPUs and NVIDIA GPUs.

            policy = jax.export.deserialize(pathlib.Path("policy.jax").read_bytes())
            action, state = policy.call(obs, reward, state, episode_start, seed, deterministic)

        takes obs (batch, obs), reward and episode_start (batch,) as `predict` does, a uint32 seed of the sampled
        actions, and a bool. The first state is zeros of the shapes that `policy.in_avals` tells. Loading needs the
        package flatbuffers beside jax.

        Raises:
            UserError: the file cannot be written.
        """
        (batch,) = jax.export.symbolic_shape("batch")

        def shaped(shape: tuple[Any, ...], kind: Any) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct(shape, kind)

        state = tuple(shaped((batch, *leaf.shape[1:]), leaf.dtype) for leaf in self.initial_state(1))
        numbers = shaped((batch, self.spec.obs_dim), jnp.float32), shaped((batch,), jnp.float32)
        rest = shaped((batch,), jnp.bool_), shaped((), jnp.uint32), shaped((), jnp.bool_)
        exported = jax.export.export(self._act, platforms=("cpu", "cuda"))(*numbers, state, *rest)
        try:
            write_whole(pathlib.Path(path), bytes(exported.serialize()))
        except OSError as error:
            raise UserError(f"{path} cannot be written ({error.strerror}): choose another file.") from None


def load(
    run: Run | str | os.PathLike[str], seed: int | None = None, task: Task | GymnasiumTask | None = None
) -> Policy:
    """The policy that a run has learned.

    Args:
        run: a run, or its folder.
        seed: which of the run's seeds; None is its first.
        task: needed only where the run was trained on a task of your own.

    Raises:
        UserError: there is no such run, nothing was saved in it, or it has no such seed.
    """
    run = run if isinstance(run, Run) else Run(run)
    agent, found, state, precision = restore_seed(run, seed, task)
    return Policy(agent, found.spec, state, run.seeds[0] if seed is None else seed, precision)
