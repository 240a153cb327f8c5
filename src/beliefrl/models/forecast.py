"""How the model of `predictive-sac` reads an episode, and what it predicts there.

h_t is the LSTM's state after x_0, ..., x_t. From h_t and a_t the model predicts x_{t+1} = (o_{t+1}, r_t). Where x_t is
not observed, the LSTM reads its prediction instead.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from beliefrl.models.nets import Gaussian, LSTMState
from beliefrl.models.predictive_model import PredictiveModel, remember
from beliefrl.models.scales import Scales
from beliefrl.types import Timestep

State = tuple[LSTMState, Float[Array, " constants"]]  # of the LSTM, and m_t


def perceive(
    model: PredictiveModel, scales: Scales, before: State, step: Timestep, constants: tuple[float, ...]
) -> State:
    """The state after one more timestep, given the time constants of m_t."""
    excess = jnp.where(step.is_first, 0.0, scales.usual.excess(step.reward))
    rewards = remember(before[1], excess, constants)
    inputs = scales.model_input(scales.perception(step), rewards)
    return model.lstm.step(before[0], inputs, step.is_first), rewards


def forecast(
    model: PredictiveModel,
    scales: Scales,
    steps: Timestep,
    observed: Bool[Array, " time"],
    constants: tuple[float, ...],
) -> Gaussian:
    """Predictions of x_t along one episode from its first timestep on, leaves (time, x), in the units of the task.

    Each is made one step ahead, from h_{t-1} and a_{t-1}, so the first timestep has none: its entries are NaN. The
    first timestep must be observed. σ is 0, because the model is deterministic.
    """

    def advance(carry: tuple[State, Array], given: tuple) -> tuple[tuple[State, Array], Array]:
        (state, predicted), (step, seen, action) = carry, given
        obs, reward = jnp.where(seen, step.obs, predicted[:-1]), jnp.where(seen, step.reward, predicted[-1])
        state = perceive(model, scales, state, step._replace(obs=obs, reward=reward), constants)
        after = scales.in_units(model.predict(state[0].d, action))
        return (state, after), predicted

    action = jnp.roll(steps.prev_action, -1, axis=0)  # a_t; the last one is not used
    lstm = jax.tree.map(lambda leaf: leaf[0], model.lstm.start(1))
    start = (lstm, jnp.zeros(len(constants))), jnp.full(steps.obs.shape[-1] + 1, jnp.nan)
    mean = jax.lax.scan(advance, start, (steps, observed, action))[1]
    return Gaussian(mean, jnp.zeros_like(mean))
