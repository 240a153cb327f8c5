"""Action repeat: an action is applied for several steps of the task, which are one step for the agent."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

LONGEST = 10_000  # steps of a task for an action


def actions(steps: int, times: int) -> int:
    """The number of actions for `steps` steps of a task, rounded up."""
    return -(-steps // times)


def repeated_step(
    task: Any, state: Any, action: Float[Array, " action"], key: Key[Array, ""], times: int
) -> tuple[Any, Float[Array, " obs"], Float[Array, ""], Bool[Array, ""]]:
    """`times` steps of a JAX task: the last observation, and the sum of the rewards. After the end nothing changes."""
    if times == 1:
        return task.step(state, action, key)

    def once(state: Any, key: Key[Array, ""]) -> Any:
        state, obs, reward, terminated = task.step(state, action, key)
        return state, obs, jnp.asarray(reward, float), terminated

    def again(now: Any, key: Key[Array, ""]) -> tuple[Any, None]:
        state, _, total, terminated = now
        state, obs, reward, ends = once(state, key)
        after = state, obs, total + reward, ends
        return jax.tree.map(lambda old, new: jnp.where(terminated, old, new), now, after), None

    keys = jax.random.split(key, times)
    return jax.lax.scan(again, once(state, keys[0]), keys[1:])[0]
