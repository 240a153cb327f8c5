"""Matrix products with factors rounded to bfloat16 and sums in float32: the precision `bfloat16` of the updates.

The products of an update are rounded after JAX has differentiated it, so those of the gradients are rounded too, and an
agent needs no code for it. A CPU with AVX-512 BF16 then computes large products up to twice as fast. Everything else
stays in float32: the weights, the optimisers, sums, other functions, small products, and the actor.

A traced function is run again, operation by operation, with other products. Loops and branches are traced again.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.custom_batching
import jax.extend
import jax.numpy as jnp
from jaxtyping import Array, BFloat16, Float, Float32

NAME = "bfloat16"  # of this precision, in JAX
SMALLEST = 16  # products with a side shorter than this are not faster in bfloat16, and stay in float32
CALLS = ("jit", "pjit", "closed_call", "checkpoint", "remat2", "custom_jvp_call", "custom_vjp_call")


def at_precision(update: Callable[..., Any]) -> Callable[..., Any]:
    """`update` with rounded products if the precision of the training is bfloat16, else `update` itself.

    The function cannot be differentiated any more.
    """
    settings: Any = jax.config  # its options are made at import, unknown to pyright
    return rounded(update) if settings.jax_default_matmul_precision == NAME else update


def rounded(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with the factors of its matrix products rounded to bfloat16."""

    def call(*args: Any) -> Any:
        program, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        return jax.tree.unflatten(jax.tree.structure(shapes), _run(program, *jax.tree.leaves(args)))

    return call


def _run(program: Any, *args: Any) -> list[Any]:
    """The outputs of a traced program, with rounded products. Its constants are `program.consts`."""
    jaxpr = program.jaxpr
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*program.consts, *args], strict=True))

    def value(variable: Any) -> Any:
        return variable.val if isinstance(variable, jax.extend.core.Literal) else values[variable]

    for equation in jaxpr.eqns:
        outputs = _apply(equation, [value(variable) for variable in equation.invars])
        values.update(zip(equation.outvars, outputs, strict=True))
    return [value(variable) for variable in jaxpr.outvars]


def _apply(equation: Any, args: Sequence[Any]) -> Sequence[Any]:
    """The outputs of one operation; calls of an inner program are inlined."""
    name, given = equation.primitive.name, equation.params
    if name == "dot_general" and all(arg.dtype == jnp.float32 for arg in args):
        return [_product(*args, **given)]
    if name in CALLS:
        inner = given.get("jaxpr", given.get("call_jaxpr"))
        closed = inner if hasattr(inner, "consts") else jax.extend.core.ClosedJaxpr(inner, ())
        return _run(closed, *args)
    if name == "scan":
        return _scan(args, **given)
    if name == "while":
        test, body = args[: given["cond_nconsts"]], args[given["cond_nconsts"] :][: given["body_nconsts"]]
        start = args[given["cond_nconsts"] + given["body_nconsts"] :]
        go_on, step = partial(_run, given["cond_jaxpr"], *test), partial(_run, given["body_jaxpr"], *body)
        return jax.lax.while_loop(lambda state: go_on(*state)[0], lambda state: step(*state), list(start))
    if name == "cond":
        return jax.lax.switch(args[0], [partial(_run, branch) for branch in given["branches"]], *args[1:])
    outputs = equation.primitive.bind(*args, **given)
    return outputs if equation.primitive.multiple_results else [outputs]


def _scan(
    args: Sequence[Any], num_consts: int, num_carry: int, jaxpr: Any, length: int, reverse: bool, unroll: int, **_: Any
) -> list[Any]:
    consts, start, xs = args[:num_consts], args[num_consts:][:num_carry], args[num_consts + num_carry :]

    def step(state: list[Any], x: list[Any]) -> tuple[list[Any], list[Any]]:
        outputs = _run(jaxpr, *consts, *state, *x)
        return outputs[:num_carry], outputs[num_carry:]

    state, ys = jax.lax.scan(step, list(start), list(xs), length=length, reverse=reverse, unroll=unroll)
    return [*state, *ys]


def _product(
    a: Float[Array, "..."], b: Float[Array, "..."], dimension_numbers: Any, **given: Any
) -> Float[Array, "..."]:
    """`jax.lax.dot_general` of the rounded factors, or of the factors themselves if it is small."""
    (sum_a, sum_b), (batch_a, batch_b) = dimension_numbers
    free_a, free_b = (_others(x.ndim, *axes) for x, axes in ((a, (sum_a, batch_a)), (b, (sum_b, batch_b))))
    batch, rows, columns = ([x.shape[i] for i in axes] for x, axes in ((a, batch_a), (a, free_a), (b, free_b)))
    m, n, length = math.prod(rows), math.prod(columns), math.prod(a.shape[i] for i in sum_a)
    if min(m, n, length) < SMALLEST:
        return jax.lax.dot_general(a, b, dimension_numbers, **given)
    left = _round(a, (*batch_a, *free_a, *sum_a)).reshape(-1, m, length)
    right = _round(b, (*batch_b, *sum_b, *free_b)).reshape(-1, length, n)
    product = jax.vmap(_matmul)(left, right) if batch else _matmul(left[0], right[0])
    return _hidden(product).reshape(*batch, *rows, *columns)


@jax.custom_batching.custom_vmap
def _matmul(a: BFloat16[Array, "m length"], b: BFloat16[Array, "length n"]) -> Float32[Array, "m n"]:
    return jnp.matmul(a, b, precision=jax.lax.Precision.DEFAULT, preferred_element_type=jnp.float32)


@_matmul.def_vmap
def _one_by_one(size: int, mapped: Sequence[bool], a: Array, b: Array) -> tuple[Array, bool]:
    """Products side by side, in a loop: XLA does not compute them at once (JAX 0.10, CPU)."""
    both = [
        x if is_mapped else jnp.broadcast_to(x, (size, *x.shape)) for x, is_mapped in zip((a, b), mapped, strict=True)
    ]
    return jax.lax.map(lambda pair: _matmul(*pair), tuple(both)), True


def _others(axes: int, *taken: Sequence[int]) -> list[int]:
    return [axis for axis in range(axes) if not any(axis in some for some in taken)]


def _round(x: Float[Array, "..."], axes: Sequence[int]) -> Float[Array, "..."]:
    """x in bfloat16, with its axes in this order."""
    if tuple(axes) != tuple(range(x.ndim)):
        x = _hidden(jnp.transpose(x, axes))
    return x.astype(jnp.bfloat16)


def _hidden(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """x, but XLA does not know it: the choice always takes x.

    XLA makes a transposition a part of the product before or after it. It computes such a product in float32, or not at
    all (JAX 0.10, CPU).
    """
    return jnp.where(x[(0,) * x.ndim] > jnp.inf, 0.0, x)
