"""A recurrent model that learns only to predict; its state is the belief of `predictive-sac`.

x_t = (o_t, a_{t-1}, r_{t-1}, n_t) is standardised, except for the action. n_t is a memory of observations and m_t one
of unusual rewards. Each has entries for its time constants T, in the units of the task:

    n_t                  = (1 - 1/T) n_{t-1} + o_t,  o_t at the first timestep of an episode
    m_t                  = (1 - 1/T) m_{t-1} + u(r_{t-1}),  zero at the first timestep of an episode
    u(r)                 = r - r̄ where |r - r̄| > 5 δ,  0 elsewhere (`scales.Usual`)
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

h_t is the LSTM's state after x_0, ..., x_t. Where o_{t+1} and r_t are not observed, the LSTM reads their prediction
instead (`forecast`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.models.double_q import Policy
from beliefrl.models.nets import LSTM, MLP, Gaussian, LSTMState, draw
from beliefrl.models.optimisation import valid_mean
from beliefrl.models.scales import Scales
from beliefrl.types import Timestep


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
    start: LSTMState,
    inputs: Float[Array, "time batch input"],
    step: Timestep,
    target: Float[Array, "length batch prediction"],
    valid: Bool[Array, "length batch"],
) -> tuple[Float[Array, ""], LSTMState]:
    """J_model of the valid transitions between length + 1 timesteps; also returns the states, leaves (time, batch, d).

    Args:
        model: the weights.
        start: the state before the first timestep, leaves (batch, d).
        inputs, step: what the LSTM reads at the timesteps, and the timesteps.
        target: (o_{t+1}, r_t) of each transition, standardised.
        valid: which pairs of neighbours are transitions.
    """
    lstm = model.lstm.unroll(start, inputs, step.is_first)
    predicted = jax.vmap(jax.vmap(model.predict))(lstm.d[:-1], step.prev_action[1:])
    return valid_mean(jnp.mean((predicted - target) ** 2, axis=-1), valid), lstm


class Perceived(NamedTuple):
    """What the LSTM reads besides o_t and a_{t-1}."""

    reward: bool  # r_{t-1}
    reward_memory: tuple[float, ...]  # the time constants of m_t, in steps
    observation_memory: tuple[float, ...]  # those of n_t


class Note(NamedTuple):
    """What the replay stores with a timestep.

    After the pre-training all notes are made anew: for the exploration b is the untrained policy on the new beliefs.
    """

    rewards: Float[Array, "*batch constants"]  # m_t, in units of the reward
    policy: Policy  # b, which chose a_t
    observations: Float[Array, "*batch obs constants"] | None  # n_t, in units of the observation


class Memory(NamedTuple):
    """The recurrent state of an actor."""

    lstm: LSTMState
    note: Note  # on the last timestep

    @classmethod
    def empty(cls, d: int, obs: int, action: int, perceived: Perceived) -> "Memory":
        """The memory before an episode, given the sizes of the LSTM's state, the observation and the action."""
        observations = jnp.zeros((obs, len(perceived.observation_memory))) if perceived.observation_memory else None
        note = Note(jnp.zeros(len(perceived.reward_memory)), Policy(*jnp.zeros((2, action))), observations)
        return cls(LSTMState.empty(d), note)


def remember(
    before: Float[Array, "*entry constants"], new: Float[Array, "*entry"], constants: tuple[float, ...]
) -> Float[Array, "*entry constants"]:
    """m_t or n_t, given that of the timestep before, u(r_{t-1}) or o_t, and the time constants in steps."""
    kept = jnp.broadcast_to(1 - 1 / jnp.array(constants), before.shape)
    return kept * before + new[..., None]


def perceive(
    model: PredictiveModel, scales: Scales, before: Memory, step: Timestep, perceived: Perceived
) -> tuple[Memory, Float[Array, " x"]]:
    """The memory after one more timestep, and x_t. The policy in its note is still the last one; `act` replaces it."""
    excess = jnp.where(step.is_first, 0.0, scales.usual.excess(step.reward))
    rewards = remember(before.note.rewards, excess, perceived.reward_memory)
    observations = before.note.observations
    if observations is not None:
        observations = remember(observations, step.obs, perceived.observation_memory)
    x = scales.perception(step, observations, perceived.reward)
    lstm = model.lstm.step(before.lstm, scales.model_input(x, rewards), step.is_first)
    return Memory(lstm, before.note._replace(rewards=rewards, observations=observations)), x


def forecast(
    model: PredictiveModel, scales: Scales, steps: Timestep, observed: Bool[Array, " time"], perceived: Perceived
) -> Gaussian:
    """Predictions of (o_t, r_{t-1}) along one episode from its first timestep on, in the units of the task.

    The leaves are (time, prediction). Each is made one step ahead, from h_{t-1} and a_{t-1}, so the first timestep has
    none: its entries are NaN. The first timestep must be observed. σ is 0, because the model is deterministic.
    """

    def advance(carry: tuple[Memory, Array], given: tuple) -> tuple[tuple[Memory, Array], Array]:
        (memory, predicted), (step, seen, action) = carry, given
        obs, reward = jnp.where(seen, step.obs, predicted[:-1]), jnp.where(seen, step.reward, predicted[-1])
        memory, _ = perceive(model, scales, memory, step._replace(obs=obs, reward=reward), perceived)
        after = scales.in_units(model.predict(memory.lstm.d, action))
        return (memory, after), predicted

    action = jnp.roll(steps.prev_action, -1, axis=0)  # a_t; the last one is not used
    obs = steps.obs.shape[-1]
    start = Memory.empty(model.lstm.w_d.shape[0], obs, action.shape[-1], perceived), jnp.full(obs + 1, jnp.nan)
    mean = jax.lax.scan(advance, start, (steps, observed, action))[1]
    return Gaussian(mean, jnp.zeros_like(mean))
