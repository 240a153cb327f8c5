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
from numbers import Real
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from beliefrl import agents, onnx
from beliefrl.agents import Agent
from beliefrl.analysis.figures import check_folder
from beliefrl.runs.arrays import write_whole
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.environment import TaskEnvironment
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.evaluation import restore_seed
from beliefrl.types import LARGEST, Spec, Timestep, UserError, as_array, cause, check_whole, short

State = tuple[np.ndarray, ...]


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
    ):
        """Make a policy of an agent and one of its trained states.

        `seed` is the random seed of sampled actions, `precision` that of matrix products (`Run.precision`), `task` a
        name for `repr`. `environment` makes an environment as the agent sees it, to check an ONNX export in.
        """
        self.agent, self.spec, self.seed, self.precision, self.task = agent, spec, seed, precision, task
        self.environment = environment
        self._state = jax.device_put(state)
        self._empty = jax.device_get(agent.reset(spec))  # the memory at the start of an episode
        self._act = jax.jit(lambda *inputs: self._step(self._state, *inputs))
        self._calls = 0

    def __repr__(self) -> str:
        """The agent, task, sizes and seed: `<Policy vrm on pendulum-v: observation (1,), action (1,), seed 0>`."""
        sizes = f"observation ({self.spec.obs_dim},), action ({self.spec.action_dim},)"
        on = f" on {self.task}" if self.task else ""
        return f"<Policy {agents.name_of(self.agent)}{on}: {sizes}, seed {self.seed}>"

    def _step(self, agent_state, obs, reward, state, episode_start, seed, deterministic):
        """Act for a batch. `state` holds the leaves of the memory and the previous action, each (batch, ...)."""
        key = jax.random.key(seed)
        keys = jax.vmap(lambda index: jax.random.fold_in(key, index))(jnp.arange(obs.shape[0]))
        return self._act_with(agent_state, obs, reward, state, episode_start, keys, ~deterministic)

    def mode(self, obs: Any, reward: Any, episode_start: Any, *state: Any) -> tuple[Any, ...]:
        """The mode action and the parts of the next state, as a pure JAX function of arrays (batch, ...)."""
        key, explore = jax.random.key(0), jnp.array(False)
        action, after = self._act_with(self._state, obs, reward, state, episode_start, key, explore)
        return action, *after

    def _act_with(self, agent_state, obs, reward, state, episode_start, keys, explore):
        """The same with a random key for each episode, or one key for all of them."""
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
        act = functools.partial(self.agent.act, agent_state)
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
        reward: Any = 0.0,
        state: Any = None,
        episode_start: Any = None,
        deterministic: Any = True,
    ) -> tuple[np.ndarray, State]:
        """Take the next observation of one or many episodes, and choose an action.

        Args:
            obs: o_t, (obs,) or (batch, obs).
            reward: r_{t-1}, which came with `obs`, a number or (batch,); ignored at the start of an episode.
            state: the state that the previous call returned; None at the start of all episodes.
            episode_start: whether an episode starts with `obs`, a bool or (batch,); None: True if `state` is None.
            deterministic: True takes the policy's mode, False samples the action.

        Returns:
            The action in [-1, 1], (action,) or (batch, action), and the state for the next call.

        Raises:
            UserError: an input has the wrong shape or type, is not finite as float32, or is so large that the action
                would not be finite. `state` stays valid.
        """
        obs = given = _numbers(obs, "obs")
        single = obs.ndim == 1
        obs = obs[None] if single else obs
        if obs.ndim != 2 or obs.shape[1] != self.spec.obs_dim:
            size = self.spec.obs_dim
            raise UserError(f"obs has the shape {obs.shape[single:]}: it must be ({size},) or (batch, {size}).")
        batch = len(obs)
        if not batch:
            raise UserError("obs has no episodes: give one or more.")
        starts = _flags(state is None if episode_start is None else episode_start, batch, "episode_start")
        reward = _each(_numbers(reward, "reward"), batch, "reward")
        reward = np.where(starts, 0, reward)
        _check_finite(given, "obs")
        _check_finite(reward.reshape(() if single else batch), "reward")
        state = self.initial_state(batch) if state is None else self._fitting(state, batch)
        (mode,) = _flags(deterministic, 1, "deterministic")
        self._calls += 1
        seed = np.uint32((self.seed * 1_000_003 + self._calls) % (LARGEST + 1))
        obs, reward = obs.astype(np.float32), reward.astype(np.float32)
        action, after = jax.device_get(self._act(obs, reward, state, starts, seed, mode))
        finite = np.all([np.isfinite(leaf.reshape(batch, -1)).all(axis=1) for leaf in after], axis=0)
        for episode in np.flatnonzero(~finite):
            which = "" if single else f" of episode {episode}"
            raise UserError(f"obs or reward{which} is too large for this policy: its action would not be finite.")
        return (action[0] if single else action), after

    def _fitting(self, state: Any, batch: int) -> State:
        """The same state, after a check that it is a state of this policy for `batch` episodes."""
        wanted = [(leaf.shape, leaf.dtype) for leaf in self.initial_state(batch)]
        leaves = list(state) if isinstance(state, tuple | list) else []
        if [(np.shape(leaf), getattr(leaf, "dtype", None)) for leaf in leaves] != wanted:
            raise UserError(
                f"state is not one of this policy for {_count(batch, 'episode')}: give the second result of `predict`, "
                "or None at the start of all episodes."
            )
        for leaf in leaves:
            if np.issubdtype(leaf.dtype, np.floating) and not np.isfinite(leaf).all():
                raise UserError("state holds a number that is not finite: give the second result of `predict`.")
        return tuple(leaves)

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
        if path.exists() and not overwrite:
            raise UserError(f"{path} exists already: choose another file, or replace it with overwrite (--overwrite).")
        if path.suffix.lower() == ".onnx":
            in_float32 = Policy(self.agent, self.spec, self._state, task=self.task, seed=self.seed)
            content, difference = onnx.export(in_float32, self.environment)
        else:
            content, difference = self._for_jax(), None
        try:
            write_whole(path, content)
        except OSError as error:
            raise UserError(f"{path} cannot be written ({cause(error)}): choose another file.") from None
        return difference

    def _for_jax(self) -> bytes:
        (batch,), shaped = jax.export.symbolic_shape("batch"), jax.ShapeDtypeStruct
        state = tuple(shaped((batch, *leaf.shape[1:]), leaf.dtype) for leaf in self.initial_state(1))
        numbers = shaped((batch, self.spec.obs_dim), jnp.float32), shaped((batch,), jnp.float32)
        rest = shaped((batch,), jnp.bool_), shaped((), jnp.uint32), shaped((), jnp.bool_)
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
        task: needed only if the run was trained on a task of your own: that task, or the class of its environments.
        agent: needed only if the run was trained by an agent of your own: its class, or an instance.
        best: take the seed's best agent, not its last one; see `evaluate`.

    Raises:
        UserError: there is no such run or seed, or the run has no trained agent yet.
    """
    run = run if isinstance(run, Run) else Run(run)
    trained, found, state, precision = restore_seed(run, seed, task, agent, best)
    seed = run.seeds[0] if seed is None else seed
    environment = found.environment if isinstance(found, GymnasiumTask) else lambda: TaskEnvironment(found)
    return Policy(trained, found.spec, state, seed, precision, run.config["task"], environment)


def _numbers(value: Any, name: str) -> np.ndarray:
    """The value of obs or reward as an array of real numbers.

    Raises:
        UserError: an entry is not a number.
    """
    if isinstance(value, dict):
        raise UserError(f"{name} is a dictionary: give one flat array, with the entries that the agent observes.")
    array = as_array(value)
    for index, entry in np.ndenumerate(array if array.dtype == object else ()):
        if not isinstance(entry, Real):
            raise UserError(f"{_place(name, index)} is {short(entry)}: give finite numbers.")
    if array.dtype.kind not in "iuf":
        raise UserError(f"{name} must be real numbers, not {short(value)}: the arguments are obs, reward, state.")
    return array


def _flags(value: Any, batch: int, name: str) -> np.ndarray:
    """One bool for each episode of a batch."""
    array = as_array(value)
    if array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
        raise UserError(f"{name} must be True or False, not {short(value)}.")
    return _each(array.astype(bool), batch, name)


def _each(array: np.ndarray, batch: int, name: str) -> np.ndarray:
    """One entry for each episode of a batch."""
    if array.shape not in ((), (batch,)):
        raise UserError(f"{name} has the shape {array.shape}: it must be one number or ({batch},).")
    return np.broadcast_to(array, (batch,))


def _check_finite(array: np.ndarray, name: str) -> None:
    """Raise a UserError that names the first entry which is not finite as float32."""
    with np.errstate(over="ignore"):
        wrong = ~np.isfinite(array.astype(np.float32))
    for index in map(tuple, np.argwhere(wrong).tolist()):
        raise UserError(f"{_place(name, index)} is {array[index]}: give finite numbers, within float32.")


def _place(name: str, index: tuple[int, ...]) -> str:
    """The position of an entry as text; `index` is (entry,) or (episode, entry) of obs, () or (episode,) of reward."""
    *episode, entry = index if name == "obs" and index else (*index, None)
    which = name if entry is None else f"entry {entry} of {name}"
    return f"{which} of episode {episode[0]}" if episode else which


def _where_first(is_first: Any, empty: Any, leaf: Any) -> Any:
    """`empty` for the episodes that start, `leaf` for the others; leaves (batch, ...)."""
    return jnp.where(is_first.reshape(-1, *[1] * (leaf.ndim - 1)), empty, leaf)


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
