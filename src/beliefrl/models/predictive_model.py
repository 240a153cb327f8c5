"""A recurrent model that learns only to predict; its state is the belief of `predictive-sac`.

With x_t = (o_t, a_{t-1}, r_{t-1}), observations and rewards in standardised units, and m_t, which has an average of the
past rewards for each time constant T:

    m_t                  = m_{t-1} + (r_{t-1} - r̄ - m_{t-1}) / T,  zero at the first timestep of an episode
    h_t                  = LSTM(h_{t-1}; [x_t, m_t])
    prediction           = MLP[h_t, a_t]
    J_model              = E ‖prediction - (o_{t+1}, r_t)‖²,  mean over the entries

To predict, h_t must contain the information of the history about the hidden state. Some cells start with a long
memory: the biases of their forget gates are log U(1, T), so that they forget over up to T steps (Tallec and Ollivier
2018, "chrono initialisation"). An LSTM with the usual initialisation forgets an event within some tens of steps.
Predictions one step ahead do not train it to remember longer. The averages m_t remember rewards without learning. The
replay stores them. So a window that begins in the middle of an episode has the memory of the whole episode. r̄ is the
usual reward, the running median. Without it, m_t would tell the time where all rewards are alike. The value of a state
would then seem to depend on the time.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.models.nets import LSTM, MLP, LSTMState, draw
from beliefrl.models.soft_actor_critic import valid_mean


class PredictiveModel(eqx.Module):
    """The weights of an LSTM and of the perceptron that predicts from its state."""

    lstm: LSTM
    predictor: MLP

    def __init__(self, obs: int, action: int, averages: int, d: int, hidden: int):
        """Sizes of o_t, a_t, m_t, the state of the LSTM, and the hidden layer of the predictor."""
        self.lstm = LSTM(obs + action + 1 + averages, d)
        self.predictor = MLP((d + action, hidden, obs + 1), jax.nn.relu)

    def unroll(
        self, x: Float[Array, "time batch input"], is_first: Bool[Array, "time batch"], burn_in: int
    ) -> Float[Array, "kept batch d"]:
        """h_t after the burn-in, given [x_t, m_t]. The burn-in starts with an empty state and gets no gradient."""
        start = self.lstm.start(x.shape[1])
        if burn_in:
            burnt_in = jax.lax.stop_gradient(self.lstm).unroll(start, x[:burn_in], is_first[:burn_in])
            start = jax.tree.map(lambda leaf: leaf[-1], burnt_in)
        return self.lstm.unroll(start, x[burn_in:], is_first[burn_in:]).d

    def next_state(self, state: LSTMState, x: Float[Array, " input"], is_first: Bool[Array, ""]) -> LSTMState:
        """The LSTM's state after [x_t, m_t]."""
        start = jax.tree.map(lambda leaf: leaf[None], state)
        after = self.lstm.unroll(start, x[None, None], is_first[None, None])
        return jax.tree.map(lambda leaf: leaf[0, 0], after)

    def predict(self, d: Float[Array, " d"], action: Float[Array, " action"]) -> Float[Array, " prediction"]:
        """(o_{t+1}, r_t) in standardised units, given h_t and a_t."""
        return self.predictor(jnp.concatenate([d, action]))


def average_rewards(
    before: Float[Array, " averages"], deviation: Float[Array, ""], constants: tuple[float, ...]
) -> Float[Array, " averages"]:
    """m_t, given m_{t-1}, r_{t-1} - r̄ and the time constants in steps."""
    return before + (deviation - before) / jnp.array(constants)


def init_model(
    key: Key[Array, ""],
    obs: int,
    action: int,
    averages: int,
    d: int,
    hidden: int,
    long_memories: float,
    longest_memory: int,
) -> PredictiveModel:
    """A new model. A fraction `long_memories` of its cells forgets over 1 to `longest_memory` steps."""
    key_weights, key_memories = jax.random.split(key)
    model = draw(key_weights, PredictiveModel(obs, action, averages, d, hidden))
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
    return valid_mean(jnp.mean((predicted - target) ** 2, axis=-1).ravel(), valid.ravel())
