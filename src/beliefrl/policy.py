"""A trained policy for deployment: numpy in and out, batched, with an export that runs without this library.

    policy = beliefrl.load("runs/first")
    action, state = policy.predict(obs)                    # an episode starts
    action, state = policy.predict(obs, reward, state)     # and continues

The interface follows Stable-Baselines3's recurrent policies, with the reward as an additional input: beliefs depend on
the rewards.
"""

import functools
import os
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box

from beliefrl import agents, onnx
from beliefrl.agents import Agent
from beliefrl.errors import UserError
from beliefrl.policy_inputs import State, check_finite, each, fitting, flags, numbers
from beliefrl.runs.given_files import check_folder, write_given
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.environment import TaskEnvironment
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.interface import Interface
from beliefrl.tasks.spaces import scale
from beliefrl.training.restore import check_interface, restore_policy, task_of
from beliefrl.types import LARGEST, Spec, Timestep, check_whole


class Policy:
    """A trained agent as a function from observations and rewards to actions."""

    def __init__(
        self,
        agent: Agent,
        spec: Spec,
        state: Any,
        seed: int = 0,
        precision: str = "float32",
        task: str = "",
        environment: Callable[[], Any] | None = None,
        interface: Interface | None = None,
    ):
        """Make a policy of an agent and one of its trained states.

        `seed` is the random seed of sampled actions, `precision` that of matrix products, `task` a
        name for `repr`. `environment` makes an environment as the agent sees it, to check an ONNX export in.
        `interface` has the names of the observed entries and the bounds of the actions, which an ONNX file records.
        """
        self.agent, self.spec, self.seed, self.precision, self.task = agent, spec, seed, precision, task
        self.environment, self.interface = environment, interface
        with jax.enable_x64(False):  # another library of the program may need 64 bits
            self._state = jax.device_put(state)
            self._empty = jax.device_get(agent.reset(spec))  # the memory at the start of an episode
        self._act = jax.jit(self._step)
        self._calls = 0
        self._ignores_reward = False  # found when a reward is left out

    def __repr__(self) -> str:
        """The agent, task, sizes and seed: `<Policy vrm on pendulum-v: observation (1,), action (1,), seed 0>`."""
        sizes = f"observation ({self.spec.obs_dim},), action ({self.spec.action_dim},)"
        on = f" on {self.task}" if self.task else ""
        return f"<Policy {agents.name_of(self.agent)}{on}: {sizes}, seed {self.seed}>"

    def _step(self, obs, reward, state, episode_start, seed, deterministic):
        """Act for a batch. `state` holds the leaves of the memory and the previous action, each (batch, ...)."""
        key = jax.random.key(seed)
        keys = jax.vmap(lambda index: jax.random.fold_in(key, index))(jnp.arange(obs.shape[0]))
        return self._act_with(obs, reward, state, episode_start, keys, ~deterministic)

    def mode(self, obs: Any, reward: Any, episode_start: Any, *state: Any) -> tuple[Any, ...]:
        """The mode action and the parts of the next state, as a pure JAX function of arrays (batch, ...)."""
        key, explore = jax.random.key(0), jnp.array(False)
        action, after = self._act_with(obs, reward, state, episode_start, key, explore)
        return action, *after

    def _act_with(self, obs, reward, state, episode_start, keys, explore):
        """`_step`, given a random key for each episode, or one key for all of them."""
        *memory, prev_action = state
        memory = jax.tree.structure(self._empty).unflatten(memory)
        memory = jax.tree.map(functools.partial(_where_first, episode_start), self._empty, memory)
        step = Timestep(
            obs=obs,
            reward=jnp.where(episode_start, 0.0, reward),
            prev_action=jnp.where(episode_start[:, None], 0.0, prev_action),
            is_first=episode_start,
            terminated=jnp.zeros_like(episode_start),
        )
        act = functools.partial(self.agent.act, self._state)
        axes = 0, 0, 0 if keys.ndim else None, None
        with jax.default_matmul_precision(self.precision):
            action, memory = jax.vmap(act, in_axes=axes)(memory, step, keys, explore)
        return action, (*jax.tree.leaves(memory), action)

    def initial_state(self, batch: int) -> State:
        """The state at the start of `batch` episodes: the agent's empty memory and a zero previous action.

        Raises:
            UserError: `batch` is not a whole number of at least 1.
        """
        check_whole("batch", batch, 1)
        leaves = [*jax.tree.leaves(self._empty), np.zeros(self.spec.action_dim, np.float32)]
        return tuple(np.repeat(np.asarray(leaf)[None], batch, axis=0) for leaf in leaves)

    def predict(
        self,
        obs: Any,
        reward: Any = None,
        state: Any = None,
        episode_start: Any = None,
        deterministic: Any = True,
    ) -> tuple[np.ndarray, State]:
        """Take the next observation of one or many episodes, and choose an action.

        Args:
            obs: o_t, (obs,) or (batch, obs).
            reward: r_{t-1}, which came with `obs`, a number or (batch,); ignored at the start of an episode. It may be
                left out there, and always if the agent does not observe it, such as `sac-mlp`.
            state: the state that the previous call returned; None at the start of all episodes.
            episode_start: whether an episode starts with `obs`, a bool or (batch,); None: True if `state` is None.
            deterministic: True takes the policy's mode, False samples the action.

        Returns:
            The action in [-1, 1], (action,) or (batch, action), and the state for the next call.

        Raises:
            UserError: an input has the wrong shape or type, is not finite as float32, or is so large that the action
                would not be finite, or the reward is missing. `state` stays valid.
        """
        obs = given = numbers(obs, "obs")
        single = obs.ndim == 1
        obs = obs[None] if single else obs
        if obs.ndim != 2 or obs.shape[1] != self.spec.obs_dim:
            size = self.spec.obs_dim
            raise UserError(f"obs has the shape {obs.shape[single:]}: it must be ({size},) or (batch, {size}).")
        batch = len(obs)
        if not batch:
            raise UserError("obs has no episodes: give one or more.")
        starts = flags(state is None if episode_start is None else episode_start, batch, "episode_start")
        is_missing = reward is None and not starts.all()
        reward = each(numbers(0.0 if reward is None else reward, "reward"), batch, "reward")
        reward = np.where(starts, 0, reward)
        check_finite(given, "obs")
        check_finite(reward.reshape(() if single else batch), "reward")
        state = self.initial_state(batch) if state is None else fitting(state, self.initial_state(batch))
        (mode,) = flags(deterministic, 1, "deterministic")
        self._calls += 1
        seed = np.uint32((self.seed * 1_000_003 + self._calls) % (LARGEST + 1))
        obs, reward = obs.astype(np.float32), reward.astype(np.float32)
        action, after = self._called(obs, reward, state, starts, seed, mode)
        if is_missing and not self._ignores_reward:
            _, other = self._called(obs, np.full_like(reward, np.nan), state, starts, seed, mode)
            self._check_unused(after, other)
        finite = np.all([np.isfinite(leaf.reshape(batch, -1)).all(axis=1) for leaf in after], axis=0)
        for episode in np.flatnonzero(~finite):
            which = "" if single else f" of episode {episode}"
            raise UserError(f"obs or reward{which} is too large for this policy: its action would not be finite.")
        return (action[0] if single else action), after

    def _called(self, *inputs: Any) -> tuple[np.ndarray, State]:
        """`_step` in numpy. The caller may change these arrays; the action is not that in the state."""
        with jax.enable_x64(False):
            return jax.tree.map(np.array, jax.device_get(self._act(*inputs)))

    def scale(self, action: Any) -> np.ndarray:
        """Scale actions to the bounds of the actions of the Gymnasium environment of the training.

        Args:
            action: an action of `predict`, (action,) or (batch, action); it is clipped to [-1, 1].

        Returns:
            low + (action + 1) / 2 · (high - low), of the same shape; float32, or float64 if the bounds need it.

        Raises:
            UserError: the policy has no bounds, because it was trained on a task in JAX; or the action has the wrong
                shape, or is not finite.
        """
        if self.interface is None:
            raise UserError("scale needs bounds of actions: a task in JAX has none, its actions are in [-1, 1].")
        bounds = np.array([self.interface.low, self.interface.high])
        kind = np.float32 if np.array_equal(bounds.astype(np.float32), bounds) else np.float64  # which a Box accepts
        space = Box(*bounds.astype(kind), dtype=kind)
        given = numbers(action, "action")
        if given.shape[-1:] != space.shape:
            raise UserError(f"action has the shape {given.shape}: it must end with {space.shape[0]}.")
        check_finite(given, "action")
        return np.array([scale(space, each) for each in given.reshape(-1, *space.shape)]).reshape(given.shape)

    def _check_unused(self, after: State, other: State) -> None:
        """Raise a UserError if the state after a reward that is NaN differs from that after 0."""
        if not all(np.array_equal(a, b) for a, b in zip(after, other, strict=True)):
            name = agents.name_of(self.agent)
            raise UserError(f"reward is missing: {name} observes it. Give the reward that came with obs.")
        self._ignores_reward = True

    def export(self, path: str | os.PathLike[str], overwrite: bool = False) -> float | None:
        """Write the policy to one file that runs without this library, for any batch size.

        The name of the file decides its format. A name that ends in .onnx gives an ONNX graph, which runs without JAX,
        for example in onnxruntime, and takes the mode of the policy (`beliefrl.onnx`). It is compared in an
        episode with this policy, computed in float32. Any other name gives a file for `jax.export`, for CPUs and NVIDIA
        GPUs:

            policy = jax.export.deserialize(pathlib.Path("policy.jax").read_bytes())
            action, state = policy.call(obs, reward, state, episode_start, seed, deterministic)

        takes obs (batch, obs), and reward and episode_start (batch,), as in `predict`; a uint32 seed for sampled
        actions; and a bool. `policy.in_avals` has the shapes of the state. The first state may be zeros, since the
        state is ignored where episode_start is True. Loading needs the packages jax and flatbuffers.

        `overwrite` replaces an existing file. Returns for ONNX the largest difference found, otherwise None.

        Raises:
            UserError: the file exists, or cannot be written. For ONNX also: the extra `onnx` is not installed, the
                agent uses an operation that is not supported, or the difference is more than 1e-5.
        """
        path = pathlib.Path(path)
        check_folder(path)
        place = path.absolute()  # an environment may change the working directory
        if os.path.exists(path) and not overwrite:  # noqa: PTH110 - pathlib's raises where it may not look
            raise UserError(f"{path} exists already: choose another file, or replace it with overwrite (--overwrite).")
        if path.suffix.lower() == ".onnx":
            sizes = self.agent, self.spec, self._state
            in_float32 = Policy(*sizes, task=self.task, seed=self.seed, interface=self.interface)
            content, difference = onnx.export(in_float32, self.environment)
        else:
            content, difference = self._for_jax(), None
        write_given(place, content)
        return difference

    def _for_jax(self) -> bytes:
        (batch,), shaped = jax.export.symbolic_shape("batch"), jax.ShapeDtypeStruct
        state = tuple(shaped((batch, *leaf.shape[1:]), leaf.dtype) for leaf in self.initial_state(1))
        numbers = shaped((batch, self.spec.obs_dim), jnp.float32), shaped((batch,), jnp.float32)
        rest = shaped((batch,), jnp.bool_), shaped((), jnp.uint32), shaped((), jnp.bool_)
        with jax.enable_x64(False):
            return bytes(jax.export.export(self._act, platforms=("cpu", "cuda"))(*numbers, state, *rest).serialize())


def load(
    run: Run | str | os.PathLike[str],
    seed: int | None = None,
    task: Task | GymnasiumTask | type | None = None,
    agent: Agent | type | None = None,
    best: bool = False,
) -> Policy:
    """Load the trained policy of a run.

    Args:
        run: a run, or its folder.
        seed: one of the run's seeds; None: its first.
        task: needed only if the run was trained on a task of your own in JAX: that task. Of a Gymnasium environment the
            run has the sizes, and no environment is made.
        agent: needed only if the run was trained by an agent of your own: its class, or an instance.
        best: take the seed's best agent, not its last one; see `evaluate`.

    Raises:
        UserError: there is no such run or seed, or the run has no trained agent yet.
    """
    run = run if isinstance(run, Run) else Run(run)
    trained, spec, interface, state = restore_policy(run, seed, task, agent, best)
    environment = None if run.options.share_env else lambda: _environment(run, task)
    seed = run.seeds[0] if seed is None else seed
    return Policy(trained, spec, state, seed, run.options.precision, run.config["task"], environment, interface)


def _environment(run: Run, task: Any) -> Any:
    """An environment of the run's task, as the agent sees it.

    Raises:
        UserError: it cannot be made.
    """
    found = task_of(run, task)
    check_interface(run, found)
    return found.environment() if isinstance(found, GymnasiumTask) else TaskEnvironment(found)


def _where_first(is_first: Any, empty: Any, leaf: Any) -> Any:
    """`empty` for the episodes that start, `leaf` for the others; leaves (batch, ...)."""
    return jnp.where(is_first.reshape(-1, *[1] * (leaf.ndim - 1)), empty, leaf)
