"""How `predictive-sac` reads an episode, and what its model predicts there.

h_t is the LSTM's state after x_0, ..., x_t. From h_t and a_t the model predicts o_{t+1} and r_t. Where they are not
observed, the LSTM reads the prediction instead.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from beliefrl.models.double_q import Policy
from beliefrl.models.nets import Gaussian, LSTMState
from beliefrl.models.predictive_model import PredictiveModel, remember
from beliefrl.models.scales import Scales
from beliefrl.types import Timestep


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


def no_memory(d: int, obs: int, action: int, perceived: Perceived) -> Memory:
    """The memory before an episode, given the sizes of the LSTM's state, the observation and the action."""
    observations = jnp.zeros((obs, len(perceived.observation_memory))) if perceived.observation_memory else None
    note = Note(jnp.zeros(len(perceived.reward_memory)), Policy(*jnp.zeros((2, action))), observations)
    return Memory(LSTMState.empty(d), note)


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
    start = no_memory(model.lstm.w_d.shape[0], obs, action.shape[-1], perceived), jnp.full(obs + 1, jnp.nan)
    mean = jax.lax.scan(advance, start, (steps, observed, action))[1]
    return Gaussian(mean, jnp.zeros_like(mean))
