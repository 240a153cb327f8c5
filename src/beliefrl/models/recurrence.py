"""A recurrence over time with a cheap gradient, used by the LSTM, VRM and SLAC's latent variables.

A `Cell` is one step. It computes only the products that depend on the previous state. All other products are computed
before the scan and are its input `given`. `unroll` repeats the step. Its gradient is written by hand: a scan backwards
in time computes the gradient of every product with a weight. The gradient of each weight is then one matrix product
over (time, batch). Automatic differentiation would add a whole matrix at every step.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Cell(NamedTuple):
    """One step of a recurrence for a batch, as three functions. Each weight is a matrix (input, output) or a bias.

    Biases inside the loop are weights and not a part of `given`. When they were read at every step from a repeated
    array, the unroll of VRM was a third slower on the CPU (20 windows of 129 steps).

    forward(weights, before, given, noise) -> (state, output, saved): the next state, the output of `unroll`, and the
        further values that the other two functions need.
    backward(transposed, memory, grad_state, grad_output) -> (grad_before, grads): the gradient of one step, and the
        gradients that `factors` needs; `transposed` are the weights (output, input).
    factors(memory, grads) -> (grad_given, inputs, grad_products): for all steps, the gradient of `given`, the factor
        of each weight (for a bias, any array) and the gradient of the product. The last two are trees like the
        weights, leaves (time, batch, ...).
    """

    forward: Callable[..., tuple[Any, Any, Any]]
    backward: Callable[..., tuple[Any, Any]]
    factors: Callable[..., tuple[Any, Any, Any]]


class Memory(NamedTuple):
    """Values of the forward pass that the gradient needs, of one step or of all."""

    output: Any
    saved: Any
    noise: Any


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def unroll(cell: Cell, weights: Any, start: Any, given: Any, is_first: Bool[Array, "time batch"], noise: Any) -> Any:
    """The cell's outputs at every step, starting from `start`, and from zero where is_first; leaves (time, batch, ...).

    Differentiable in weights, start and given. Leaves of `start` are (batch, size), of `given` and `noise`
    (time, batch, size).
    """
    return _scan(cell, weights, start, given, is_first, noise)[0]


def _scan(cell: Cell, weights: Any, start: Any, given: Any, is_first: Bool[Array, "time batch"], noise: Any) -> Any:
    """(outputs, saved) of every step."""

    def step(state, inputs):
        given, is_first, noise = inputs
        state, output, saved = cell.forward(weights, _reset(state, is_first), given, noise)
        return state, (output, saved)

    return jax.lax.scan(step, start, (given, is_first, noise))[1]


def _reset(state: Any, is_first: Bool[Array, " batch"]) -> Any:
    """Zero where an episode begins."""
    return jax.tree.map(lambda leaf: jnp.where(is_first[:, None], 0.0, leaf), state)


def _unroll_forward(cell, weights, start, given, is_first, noise):
    output, saved = _scan(cell, weights, start, given, is_first, noise)
    return output, (weights, start, is_first, Memory(output, saved, noise))


def _unroll_backward(cell, residuals, grad_output):
    weights, start, is_first, memory = residuals
    transposed = jax.tree.map(jnp.transpose, weights)

    def step(grad_state, inputs):
        memory, grad_output, is_first = inputs
        grad_before, grads = cell.backward(transposed, memory, grad_state, grad_output)
        return _reset(grad_before, is_first), grads

    zero = jax.tree.map(jnp.zeros_like, start)
    grad_start, grads = jax.lax.scan(step, zero, (memory, grad_output, is_first), reverse=True)
    grad_given, *factors = cell.factors(memory, grads)
    grad_weights = jax.tree.map(_weight_gradient, weights, *factors)
    return grad_weights, grad_start, grad_given, None, None


def _weight_gradient(
    weight: Float[Array, "..."], inputs: Float[Array, "time batch _"], grad: Float[Array, "time batch output"]
) -> Float[Array, "..."]:
    """The gradient of a weight, given the gradient of its products."""
    is_bias = weight.ndim == 1
    # Not einsum: it sums over (batch, time) and not (time, batch), for which XLA copies the arrays.
    return jnp.sum(grad, (0, 1)) if is_bias else jnp.tensordot(inputs, grad, ((0, 1), (0, 1)))


unroll.defvjp(_unroll_forward, _unroll_backward)
