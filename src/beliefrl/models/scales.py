"""Running statistics by which agents standardise what they perceive and their beliefs.

`Scales` are all those of `predictive-sac`, `Usual` the usual size of its rewards.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from beliefrl.models.optimisation import valid_mean
from beliefrl.types import Timestep, Window

STATISTICS_RATE = 1e-3  # smallest weight of a new batch, reached after 1 / rate batches
DEVIATION_MIN = 1e-3  # added to deviations: entries that vary less than this stay small
STANDARDISED_MAX = 10.0
UNUSUAL = 5  # mean absolute deviations from the median at which a reward is unusual


class RunningStatistics(NamedTuple):
    """Running mean and variance of each entry of a vector."""

    mean: Float[Array, " size"]
    variance: Float[Array, " size"]
    batches: Float[Array, ""]  # batches so far


def initial_statistics(size: int) -> RunningStatistics:
    """The statistics before any batch: mean 0, variance 1."""
    return RunningStatistics(jnp.zeros(size), jnp.ones(size), jnp.zeros(()))


def update_statistics(
    statistics: RunningStatistics, x: Float[Array, "*batch size"], valid: Bool[Array, "*batch"]
) -> RunningStatistics:
    """Include the valid vectors of one more batch. Without valid vectors nothing changes.

    This is an average over batches, and an exponential average after 1 / STATISTICS_RATE batches.
    """
    some = jnp.any(valid)
    batches = statistics.batches + some
    rate = jnp.where(some, jnp.maximum(1 / jnp.maximum(batches, 1), STATISTICS_RATE), 0.0)
    flat, weight = x.reshape(-1, x.shape[-1]), valid.ravel()
    weight = weight / jnp.maximum(jnp.sum(weight), 1)
    mean = statistics.mean + rate * (weight @ flat - statistics.mean)
    variance = statistics.variance + rate * (weight @ (flat - mean[None]) ** 2 - statistics.variance)
    return RunningStatistics(mean, variance, batches)


def deviations(variance: Float[Array, " size"]) -> Float[Array, " size"]:
    """The numbers by which `standardise` divides: standard deviations, plus a small number."""
    return jnp.sqrt(variance) + DEVIATION_MIN


def standardise(statistics: RunningStatistics | None, x: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
    """x with mean 0 and standard deviation 1, clipped to [-10, 10]; x itself if `statistics` is None."""
    if statistics is None:
        return x
    mean, deviation = (jnp.broadcast_to(v, x.shape) for v in (statistics.mean, deviations(statistics.variance)))
    return jnp.clip((x - mean) / deviation, -STANDARDISED_MAX, STANDARDISED_MAX)


class Usual(NamedTuple):
    """Which rewards are usual; the first two numbers are averages over the batches of the pre-training."""

    reward: Float[Array, ""]  # r̄, the median of a batch
    deviation: Float[Array, ""]  # δ, the mean distance to it
    batches: Float[Array, ""]  # so far; without any, all rewards are usual

    def include(self, reward: Float[Array, "*batch"], valid: Bool[Array, "*batch"]) -> "Usual":
        """The same with the valid rewards of one more batch."""
        batches = self.batches + jnp.any(valid)
        rate = jnp.any(valid) / jnp.maximum(batches, 1)
        median = jnp.nan_to_num(jnp.nanmedian(jnp.where(valid, reward, jnp.nan)))
        deviation = valid_mean(jnp.abs(reward - median), valid)
        usual = self.reward + rate * (median - self.reward), self.deviation + rate * (deviation - self.deviation)
        return Usual(*usual, batches)

    def excess(self, reward: Float[Array, ""]) -> Float[Array, ""]:
        """u(r)."""
        difference = reward - self.reward
        is_unusual = (self.batches > 0) & (jnp.abs(difference) > UNUSUAL * self.deviation)
        return jnp.where(is_unusual, difference, 0.0)


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
