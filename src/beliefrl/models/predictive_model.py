"""A recurrent model that learns only to predict; its state is the belief of `predictive-sac`.

x_t = (o_t, a_{t-1}, r_{t-1}, n_t) is standardised, except for the action. n_t is a memory of observations and m_t one
of unusual rewards. Each has entries for its time constants T, in the units of the task:

    n_t                  = (1 - 1/T) n_{t-1} + o_t,  o_t at the first timestep of an episode
    m_t                  = (1 - 1/T) m_{t-1} + u(r_{t-1}),  zero at the first timestep of an episode
    u(r)                 = r - r̄ where |r - r̄| > 5 δ,  0 elsewhere
    h_t                  = LSTM(h_{t-1}; [x_t, m_t / σ_r])
    prediction           = MLP[h_t, a_t]
    J_model              = E ‖prediction - (o_{t+1}, r_t)‖²,  mean over the entries

To predict, h_t must contain the information of the history about the hidden state. Some cells start with a long
memory: the biases of their forget gates are log U(1, L), so their time constants are 2 to L + 1 steps (Tallec and
Ollivier 2018, "chrono initialisation", but with the usual biases of the input gates). An LSTM with the usual biases
forgets an event within some tens of steps. Predictions one step ahead do not train it to remember longer.

The memories need no learning. If velocities are observed, n_t tells how far the positions have changed. The replay
stores both, so a window that begins in the middle of an episode has the memories of the whole episode. r̄ and δ are the
median and the mean absolute deviation of the rewards of the exploration: averages over the batches of the pre-training.
They do not change afterwards, so m_t has one meaning in the whole replay. m_t has no usual rewards, for two reasons. If
all rewards are equal, m_t would only tell the time. If they vary at every step, m_t might only identify the episode.
But where a better policy has other rewards at most steps than the exploration had, they all count as unusual. Then m_t
/ σ_r can stay at its limit, and tells nothing.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.models.nets import LSTM, MLP, draw
from beliefrl.models.soft_actor_critic import valid_mean

UNUSUAL = 5  # mean absolute deviations from the median at which a reward is unusual


class PredictiveModel(eqx.Module):
    """The weights of an LSTM and of the perceptron that predicts from its state."""

    lstm: LSTM
    predictor: MLP

    def __init__(self, obs: int, action: int, inputs: int, d: int, hidden: int):
        """Sizes of o_t, a_t, the input and the state of the LSTM, and the hidden layer of the predictor."""
        self.lstm = LSTM(inputs, d)
        self.predictor = MLP((d + action, hidden, obs + 1), jax.nn.relu)

    def predict(self, d: Float[Array, " d"], action: Float[Array, " action"]) -> Float[Array, " prediction"]:
        """(o_{t+1}, r_t) in standardised units, given h_t and a_t."""
        return self.predictor(jnp.concatenate([d, action]))


class Usual(NamedTuple):
    """Which rewards are usual; the first two numbers are averages over the batches of the pre-training."""

    reward: Float[Array, ""]  # r̄, the median of a batch
    deviation: Float[Array, ""]  # δ, the mean distance to it
    batches: Float[Array, ""]  # so far; without any, all rewards are usual

    def include(self, reward: Float[Array, "*batch"], valid: Bool[Array, "*batch"]) -> "Usual":
        """With the valid rewards of one more batch."""
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


def remember(
    before: Float[Array, "*entry constants"], new: Float[Array, "*entry"], constants: tuple[float, ...]
) -> Float[Array, "*entry constants"]:
    """m_t or n_t, given that of the timestep before, u(r_{t-1}) or o_t, and the time constants in steps."""
    kept = jnp.broadcast_to(1 - 1 / jnp.array(constants), before.shape)
    return kept * before + new[..., None]


def init_model(
    key: Key[Array, ""],
    obs: int,
    action: int,
    inputs: int,
    d: int,
    hidden: int,
    long_memories: float,
    longest_memory: int,
) -> PredictiveModel:
    """A new model. A fraction `long_memories` of its cells have forget biases log U(1, `longest_memory`)."""
    key_weights, key_memories = jax.random.split(key)
    model = draw(key_weights, PredictiveModel(obs, action, inputs, d, hidden))
    cells = round(long_memories * d)
    steps = jax.random.uniform(key_memories, (cells,), minval=1.0, maxval=float(longest_memory))
    bias = model.lstm.bias.at[d : d + cells].set(jnp.log(steps))  # gates i, f, g, o
    return eqx.tree_at(lambda model: model.lstm.bias, model, bias)


def prediction_loss(
    model: PredictiveModel,
    d: Float[Array, "time batch d"],
    action: Float[Array, "length batch action"],
    target: Float[Array, "length batch prediction"],
    valid: Bool[Array, "length batch"],
) -> Float[Array, ""]:
    """J_model of the transitions that begin at all timesteps but the last; mean over the valid ones."""
    predicted = jax.vmap(jax.vmap(model.predict))(d[:-1], action)
    return valid_mean(jnp.mean((predicted - target) ** 2, axis=-1), valid)
