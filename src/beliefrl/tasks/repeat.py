"""Action repeat: an action is applied for several steps of the task, which are one step for the agent."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.types import Spec

LONGEST = 10_000  # steps of a task for an action


def actions(steps: int, times: int) -> int:
    """The number of actions for `steps` steps of a task, rounded up."""
    return -(-steps // times)


@dataclasses.dataclass(frozen=True)
class Repeated:
    """A JAX task whose actions are each applied for several steps. Its states are those of the task."""

    task: Any
    times: int
    """Steps of the task for an action."""

    def __getattr__(self, name: str) -> Any:
        """The optional members of the task, such as `measures` and `entry_names` (`tasks.Task`)."""
        if name in ("task", "times"):  # not there yet, while it is copied
            raise AttributeError(name)
        return getattr(self.task, name)

    @property
    def spec(self) -> Spec:
        """As of the task. The time limit is rounded up to whole actions."""
        spec = self.task.spec
        return spec._replace(max_steps=actions(spec.max_steps, self.times))

    def reset(self, key: Key[Array, ""]) -> tuple[Any, Float[Array, " obs"]]:
        return self.task.reset(key)

    def step(
        self, state: Any, action: Float[Array, " action"], key: Key[Array, ""]
    ) -> tuple[Any, Float[Array, " obs"], Float[Array, ""], Bool[Array, ""]]:
        """The last observation, and the sum of the rewards. After a terminal step nothing changes."""

        def once(state: Any, key: Key[Array, ""]) -> Any:
            state, obs, reward, terminated = self.task.step(state, action, key)
            return state, obs, jnp.asarray(reward, float), terminated

        def again(now: Any, key: Key[Array, ""]) -> tuple[Any, None]:
            state, _, total, terminated = now
            state, obs, reward, ends = once(state, key)
            after = state, obs, total + reward, ends
            return jax.tree.map(lambda old, new: jnp.where(terminated, old, new), now, after), None

        keys = jax.random.split(key, self.times)
        return jax.lax.scan(again, once(state, keys[0]), keys[1:])[0]
