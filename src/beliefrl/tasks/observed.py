"""Which entries of its observation a task shows to the agent: their selection, their indices and their names."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.tasks.faults import NONE, faults_of, without_faults
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.types import Spec, UserError


@dataclasses.dataclass(frozen=True)
class Observed:
    """A task with only some entries of its observation (Appendix B: velocities only, no velocities)."""

    task: Any
    indices: tuple[int, ...]

    @property
    def spec(self) -> Spec:
        return self.task.spec._replace(obs_dim=len(self.indices))

    def _see(self, obs: Float[Array, " full"]) -> Float[Array, " obs"]:
        return obs[jnp.array(self.indices)]

    def reset(self, key: Key[Array, ""]) -> tuple[Any, Float[Array, " obs"]]:
        state, obs = self.task.reset(key)
        return state, self._see(obs)

    def step(
        self, state: Any, action: Float[Array, " action"], key: Key[Array, ""]
    ) -> tuple[Any, Float[Array, " obs"], Float[Array, ""], Bool[Array, ""]]:
        state, obs, reward, terminated = self.task.step(state, action, key)
        return state, self._see(obs), reward, terminated

    def measures(self, state: Any) -> dict[str, Array]:
        return self.task.measures(state)


def entries(task: Any) -> tuple[int, ...]:
    """Indices of the entries that the agent sees in the task's full observation, in the agent's order.

    The flag of `Faults.flicker_flag` has the index after the last one of the full observation.
    """
    if faults_of(task) != NONE:
        seen = entries(without_faults(task))
        return (*seen, full(task).spec.obs_dim) if faults_of(task).flicker_flag else seen
    indices = getattr(task, "indices", None)
    return tuple(range(task.spec.obs_dim)) if indices is None else tuple(indices)


def full(task: Any) -> Any:
    """The same task with its full observation and without faults."""
    task = without_faults(task)
    if isinstance(task, GymnasiumTask):
        return dataclasses.replace(task, indices=None)
    return task.task if isinstance(task, Observed) else task


def entry_names(task: Any) -> tuple[str, ...]:
    """The label of each entry that the agent sees: the task's name for it, or its index, "entry 2".

    Raises:
        UserError: the number of names differs from the number of entries.
    """
    if faults_of(task) != NONE:
        inner = entry_names(without_faults(task))
        return (*inner, "lost") if faults_of(task).flicker_flag else inner
    if isinstance(task, Observed):
        inner = entry_names(task.task)
        return tuple(inner[i] for i in task.indices)
    names = getattr(task, "entry_names", None) or [f"entry {i}" for i in entries(task)]
    if len(names) != task.spec.obs_dim:
        raise UserError(
            f"{type(task).__name__} has {len(names)} entry_names for an observation of {task.spec.obs_dim}: give one "
            "name for each entry."
        )
    return tuple(names)
