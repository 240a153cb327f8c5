"""The running statistics by which `predictive-sac` standardises what it perceives and its belief."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from beliefrl.models.nets import RunningStatistics, deviations, initial_statistics, standardise, update_statistics
from beliefrl.models.predictive_model import Usual
from beliefrl.types import Timestep, Window


class Scales(NamedTuple):
    """Statistics of observations, rewards and beliefs, and which rewards are usual."""

    obs: RunningStatistics
    reward: RunningStatistics
    belief: RunningStatistics
    usual: Usual  # r̄ and δ, from the pre-training
    memory: RunningStatistics | None  # of n_t, if there is one

    def include(self, windows: Window) -> "Scales":
        """With the observations, rewards and memories of observations of one more batch."""
        step, memory = windows.step, self.memory
        if memory is not None:
            memory = update_statistics(memory, _flat(windows.note.observations), windows.exists)
        return self._replace(
            obs=update_statistics(self.obs, step.obs, windows.exists),
            reward=update_statistics(self.reward, step.reward[..., None], windows.exists & ~step.is_first),
            memory=memory,
        )

    def standardised(self, step: Timestep) -> tuple[Float[Array, "*batch obs"], Float[Array, "*batch 1"]]:
        """o_t and r_{t-1}, standardised."""
        return standardise(self.obs, step.obs), standardise(self.reward, step.reward[..., None])

    def perception(
        self, step: Timestep, memory: Float[Array, "*batch obs constants"] | None, with_reward: bool = True
    ) -> Float[Array, "*batch x"]:
        """x_t = (o_t, a_{t-1}, r_{t-1}, n_t), all but the action standardised; the last two only if they are read."""
        obs, reward = self.standardised(step)
        rewards = [reward] if with_reward else []
        remembered = [] if memory is None else [standardise(self.memory, _flat(memory))]
        return jnp.concatenate([obs, step.prev_action, *rewards, *remembered], axis=-1)

    def model_input(
        self, x: Float[Array, "*batch x"], rewards: Float[Array, "*batch constants"]
    ) -> Float[Array, "*batch input"]:
        """[x_t, m_t / σ_r], the second clipped as standardised inputs are."""
        scale = self.reward._replace(mean=jnp.zeros(1))
        return jnp.concatenate([x, standardise(scale, rewards)], axis=-1)

    def prediction(self, step: Timestep) -> Float[Array, "*batch prediction"]:
        """(o_t, r_{t-1}), standardised: what the model predicts from h_{t-1} and a_{t-1}."""
        return jnp.concatenate(self.standardised(step), axis=-1)

    def in_units(self, prediction: Float[Array, "*batch prediction"]) -> Float[Array, "*batch prediction"]:
        """(o_t, r_{t-1}) in the units of the task, from a prediction."""
        both = jax.tree.map(lambda *parts: jnp.concatenate(parts), self.obs[:2], self.reward[:2])
        mean, deviation = (jnp.broadcast_to(leaf, prediction.shape) for leaf in (both[0], deviations(both[1])))
        return mean + deviation * prediction


def initial_scales(obs: int, belief: int, memory: int) -> Scales:
    """The statistics before any batch, given the sizes of o_t, s_t and n_t."""
    of_obs, of_reward, of_belief = map(initial_statistics, (obs, 1, belief))
    return Scales(of_obs, of_reward, of_belief, Usual(*jnp.zeros(3)), initial_statistics(memory) if memory else None)


def _flat(memory: Float[Array, "*batch obs constants"]) -> Float[Array, "*batch entries"]:
    return memory.reshape(*memory.shape[:-2], -1)
