"""Building blocks of all networks: perceptrons, the LSTM, Gaussians with and without a tanh.

The perceptrons, `LSTM.step` and `tanh_gaussian` are written for one example, and the caller maps them over batches.
`LSTM.unroll` takes a batch. The other functions of Gaussians take arrays of any shape.

The initialisation is PyTorch's: weights and biases are uniform in ±1/√fan_in, those of an LSTM in ±1/√size. A new
module contains these bounds; `draw` replaces them by random weights.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from beliefrl.models.recurrence import Cell, unroll

LOG_2PI = 1.8378770664093453

# Keeps the log-probability of a squashed action finite at ±1, as in the authors' code. It also removes the gradient of
# the correction -log(1 - a² + 1e-6) for large |u|. That gradient should stay near ±2: it is 1.99 at u = 5, 1.54 at 7,
# and 0 from 8 on. The form without it, -2 (log 2 - u - softplus(-2u)), keeps it, but is another loss: at the actions of
# tests/models/golden.npz (|u| up to 2.8) loss_actor differs from the authors' by 4.3e-5 and the actor's gradient by
# 5.7e-5.
TANH_EPSILON = 1e-6

Params = TypeVar("Params")


class Linear(eqx.Module):
    """y = W x + b. Equinox's class would draw its weights here; see `draw`."""

    weight: Float[Array, "output input"]
    bias: Float[Array, " output"]

    def __init__(self, inputs: int, outputs: int):
        self.weight = jnp.full((outputs, inputs), inputs**-0.5)
        self.bias = jnp.full((outputs,), inputs**-0.5)

    def __call__(self, x: Float[Array, " input"]) -> Float[Array, " output"]:
        # W x of a batch is (output, batch), and XLA would copy it to (batch, output). With x @ W.T it would copy W.
        return jax.lax.dot_general(x, self.weight, (((0,), (1,)), ((), ()))) + self.bias


class MLP(eqx.Module):
    """Linear layers with an activation between them, none after the last."""

    layers: tuple[Linear, ...]
    activation: Callable[[Array], Array] = eqx.field(static=True)
    normalise: bool = eqx.field(static=True)

    def __init__(self, sizes: Sequence[int], activation: Callable[[Array], Array], normalise: bool = False):
        """`sizes` are the widths from input to output, at least two.

        With `normalise`, there is layer normalisation without gains before each activation (Ba et al. 2016).
        """
        self.layers = tuple(Linear(m, n) for m, n in itertools.pairwise(sizes))
        self.activation = activation
        self.normalise = normalise

    def __call__(self, x: Float[Array, " input"]) -> Float[Array, " output"]:
        return self.rest(self.layers[0](x))

    def rest(self, first: Float[Array, " hidden"]) -> Float[Array, " output"]:
        """The network's output, given the output of its first layer, for callers that compute the first product."""
        for layer in self.layers[1:]:
            if self.normalise:
                first = eqx.nn.LayerNorm(first.shape, use_weight=False, use_bias=False)(first)
            first = layer(self.activation(first))
        return first


def draw(key: Key[Array, ""], bounds: Params) -> Params:
    """Weights uniform in ±bound, for every number in a tree of bounds.

    All weights come from one random draw, because XLA compiles a draw for each shape, in a quarter of a second.
    """
    leaves, structure = jax.tree.flatten(bounds)
    numbers = jax.random.uniform(key, (sum(leaf.size for leaf in leaves),), minval=-1.0)
    parts = jnp.split(numbers, np.cumsum([leaf.size for leaf in leaves])[:-1])
    return structure.unflatten([leaf * part.reshape(leaf.shape) for leaf, part in zip(leaves, parts, strict=True)])


class LSTMState(NamedTuple):
    """The state of an LSTM; zeros where an episode begins."""

    d: Float[Array, "*batch d"]  # its output, the recurrent state of the paper
    c: Float[Array, "*batch d"]  # its cell

    @classmethod
    def empty(cls, *shape: int) -> "LSTMState":
        """The state at the start of an episode, leaves of this shape."""
        return cls(jnp.zeros(shape), jnp.zeros(shape))


class LSTMSlopes(NamedTuple):
    """Derivatives of one step of an LSTM, entry by entry."""

    gates: Float[Array, "*batch gates"]  # of c' by the pre-activations i, f, g, and of d' by o
    d: Float[Array, "*batch d"]  # of d' by c'
    c: Float[Array, "*batch d"]  # of c' by c


def lstm_step(gates: Float[Array, "*batch gates"], c: Float[Array, "*batch d"]) -> tuple[LSTMState, LSTMSlopes]:
    """The next state from the concatenated pre-activations of the gates i, f, g, o, and its derivatives:

    c' = σ(f) c + σ(i) tanh g,   d' = σ(o) tanh c'

    One tanh computes all four gates, because σ(x) = ½ tanh(x/2) + ½. XLA vectorises it over the whole array. It does
    not vectorise four functions of slices, which are 5 times slower.
    """
    size = c.shape[-1]
    is_g = (jnp.arange(4 * size) // size == 2).reshape((1,) * (gates.ndim - 1) + (-1,))
    squashed = jnp.tanh(jnp.where(is_g, gates, 0.5 * gates))
    i, f, g, o = jnp.split(squashed, 4, axis=-1)
    i, f, o = (0.5 * gate + 0.5 for gate in (i, f, o))
    c_next = f * c + i * g
    tanh_c = jnp.tanh(c_next)
    slopes = (g * i * (1 - i), c * f * (1 - f), i * (1 - g**2), tanh_c * o * (1 - o))
    return LSTMState(o * tanh_c, c_next), LSTMSlopes(jnp.concatenate(slopes, axis=-1), o * (1 - tanh_c**2), f)


def lstm_step_backward(
    slopes: LSTMSlopes, grad: LSTMState
) -> tuple[Float[Array, "*batch gates"], Float[Array, "*batch d"]]:
    """The gradients of the gates and of c, given the gradient of the next state."""
    grad_c = grad.c + grad.d * slopes.d
    return jnp.concatenate([grad_c, grad_c, grad_c, grad.d], axis=-1) * slopes.gates, grad_c * slopes.c


class LSTM(eqx.Module):
    """An LSTM over time. Its weights are stored as (input, output), as the loop needs them; gates i, f, g, o."""

    w_x: Float[Array, "input 4*d"]
    w_d: Float[Array, "d 4*d"]
    bias: Float[Array, " 4*d"]

    def __init__(self, inputs: int, d: int):
        self.w_x = jnp.full((inputs, 4 * d), d**-0.5)
        self.w_d = jnp.full((d, 4 * d), d**-0.5)
        self.bias = jnp.full((4 * d,), d**-0.5)

    def start(self, batch: int) -> LSTMState:
        """The state at the start of an episode, leaves (batch, d)."""
        return LSTMState.empty(batch, self.w_d.shape[0])

    def unroll(
        self, start: LSTMState, x: Float[Array, "time batch input"], is_first: Bool[Array, "time batch"]
    ) -> LSTMState:
        """The states at every step, starting from `start`, and from zero where is_first; leaves (time, batch, d)."""
        given = x @ self.w_x
        given = given + jnp.broadcast_to(self.bias, given.shape)
        return unroll(LSTM_CELL, self.w_d, start, given, is_first, None)

    def step(self, before: LSTMState, x: Float[Array, " input"], is_first: Bool[Array, ""]) -> LSTMState:
        """The state after one more step, leaves (d,)."""
        start = jax.tree.map(lambda leaf: leaf[None], before)
        after = self.unroll(start, x[None, None], is_first[None, None])
        return jax.tree.map(lambda leaf: leaf[0, 0], after)


def _lstm_forward(w_d, before, given, noise):
    state, slopes = lstm_step(given + before.d @ w_d, before.c)
    return state, state, (before.d, slopes)


def _lstm_backward(w_d, memory, grad_state, grad_output):
    _, slopes = memory.saved
    grad_gates, grad_c = lstm_step_backward(slopes, jax.tree.map(jnp.add, grad_state, grad_output))
    return LSTMState(grad_gates @ w_d, grad_c), grad_gates


def _lstm_factors(memory, grad_gates):
    d_before, _ = memory.saved
    return grad_gates, d_before, grad_gates


LSTM_CELL = Cell(_lstm_forward, _lstm_backward, _lstm_factors)


class Gaussian(NamedTuple):
    mean: Float[Array, "*shape"]
    sigma: Float[Array, "*shape"]


def gaussian_log_prob(
    x: Float[Array, "*shape"], mean: Float[Array, "*shape"], sigma: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """log N(x; μ, σ²), entry by entry."""
    return -0.5 * (((x - mean) / sigma) ** 2 + LOG_2PI) - jnp.log(sigma)


def gaussian_kl(
    mean_q: Float[Array, "*shape"],
    sigma_q: Float[Array, "*shape"],
    mean_p: Float[Array, "*shape"],
    sigma_p: Float[Array, "*shape"],
) -> Float[Array, "*shape"]:
    """D_KL(q ‖ p) of two Gaussians, entry by entry: log σ_p/σ_q + ((μ_q - μ_p)² + σ_q²) / 2σ_p² - ½.

    In the paper the argument of the logarithm is inverted. This is the divergence, which is never negative.
    """
    return jnp.log(sigma_p / sigma_q) + ((mean_q - mean_p) ** 2 + sigma_q**2) / (2 * sigma_p**2) - 0.5


def tanh_gaussian(
    mean: Float[Array, " action"], log_sigma: Float[Array, " action"], noise: Float[Array, " action"]
) -> tuple[Float[Array, " action"], Float[Array, ""]]:
    """a = tanh(μ + σ ε) and its log-probability, Σ log N(u; μ, σ²) - log(1 - a² + 1e-6), with u before the tanh."""
    sigma = jnp.exp(log_sigma)
    action = jnp.tanh(mean + sigma * noise)
    log_prob = -0.5 * (noise**2 + LOG_2PI) - log_sigma - jnp.log(1 - action**2 + TANH_EPSILON)
    return action, jnp.sum(log_prob)
