"""A recurrence over time whose gradient is cheap: what the LSTM, VRM and SLAC's latent variables have in common.

A `Cell` is one step. It computes only what depends on the state before it; all other products are computed before the
scan and are its input `given`. `unroll` repeats the step. Its gradient is written by hand: a scan backwards in time
gives the gradient of every sum that a weight's product enters, and the gradient of each weight is then one product
over (time, batch). Plain differentiation would add up whole matrices at every step.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Cell(NamedTuple):
    """One step of a recurrence for a batch, as three functions. Each weight is a matrix (input, output) or a bias.

    Biases inside the loop are weights and no part of `given`: read at every step from a repeated array, they made the
    unroll of VRM a third slower on the CPU (20 windows of 129 steps).

    forward(weights, before, given, noise) -> (state, output, saved): the next state, what `unroll` returns, and what
        the other two functions need besides.
    backward(transposed, memory, grad_state, grad_output) -> (grad_before, grads): the gradient of one step, and the
        gradients that `factors` needs of it; `transposed` are the weights (output, input).
    factors(memory, grads) -> (grad_given, inputs, grad_products): for all steps, the gradient of `given`, what each
        weight multiplied (for a bias, anything) and the gradient of the product. The last two are trees like the
        weights, leaves (time, batch, ...).
    """

    forward: Callable[..., tuple[Any, Any, Any]]
    backward: Callable[..., tuple[Any, Any]]
    factors: Callable[..., tuple[Any, Any, Any]]


class Memory(NamedTuple):
    """What the gradient needs of the way forward, of one step or of all."""

    output: Any
    saved: Any
    noise: Any


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def unroll(cell: Cell, weights: Any, start: Any, given: Any, is_first: Bool[Array, "time batch"], noise: Any) -> Any:
    """The cell's outputs at every step, from `start` and from zero wherever is_first; leaves (time, batch, ...).

    Differentiable in weights, start and given. Leaves of `start` are (batch, size), of `given` and `noise`
    (time, batch, size).
    """
    return scan(cell, weights, start, given, is_first, noise)[0]


def scan(cell: Cell, weights: Any, start: Any, given: Any, is_first: Bool[Array, "time batch"], noise: Any) -> Any:
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
    output, saved = scan(cell, weights, start, given, is_first, noise)
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
    """The gradient of a weight, given that of its products."""
    is_bias = weight.ndim == 1
    return jnp.sum(grad, (0, 1)) if is_bias else jnp.einsum("tbm,tbn->mn", inputs, grad)


unroll.defvjp(_unroll_forward, _unroll_backward)
