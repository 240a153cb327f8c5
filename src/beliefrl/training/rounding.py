"""Matrix products with factors rounded to bfloat16 and sums in float32: the precision `bfloat16` of the updates.

The products of an update are rounded after JAX has differentiated it, so those of the gradients are rounded too, and an
agent needs no code for it. A CPU with AVX-512 BF16 then computes large products up to twice as fast. On a CPU
everything else stays in float32: the weights, the optimisers, sums, other functions, small products, and acting.

A traced function is run again, operation by operation, with other products. The programs inside loops and branches are
replaced in the same way. Two kinds of products are not rounded: those that ask for another precision, and those inside
rarer operations (a custom rule for vmap, a linear solver).
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
# Operations that are run inline. An ONNX graph inlines the same ones (onnx/graph.py).
CALLS = ("jit", "pjit", "closed_call", "checkpoint", "remat2", "custom_jvp_call", "custom_vjp_call")
LOOPS = ("scan", "while", "cond")  # operations that contain programs


def at_precision(update: Callable[..., Any]) -> Callable[..., Any]:
    """`update` with rounded products if the precision of the training is bfloat16, else `update` itself.

    The function cannot be differentiated any more.
    """
    settings: Any = jax.config  # its options are made at import, unknown to pyright
    return rounded(update) if settings.jax_default_matmul_precision == NAME else update


def rounded(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with the factors of its matrix products rounded to bfloat16."""

    def call(*args: Any) -> Any:
        with jax.default_matmul_precision(NAME):  # products with another precision asked for it themselves
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
    if name == "dot_general" and _is_plain(args, **given):
        return [_product(*args, **given)]
    if name in CALLS:
        inner = given.get("jaxpr", given.get("call_jaxpr"))
        closed = inner if hasattr(inner, "consts") else jax.extend.core.ClosedJaxpr(inner, ())
        return _run(closed, *args)
    if name in LOOPS:
        given = {key: _rounded_inside(inner) for key, inner in given.items()}
    outputs = equation.primitive.bind(*args, **given)
    return outputs if equation.primitive.multiple_results else [outputs]


def _rounded_inside(given: Any) -> Any:
    """A traced program, or the branches of a choice, with rounded products. Other parameters stay as they are."""
    if isinstance(given, tuple):
        return tuple(map(_rounded_inside, given))
    if not isinstance(given, jax.extend.core.ClosedJaxpr):
        return given
    inputs = [jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type) for x in given.in_avals]
    return jax.make_jaxpr(partial(_run, given))(*inputs)


def _is_plain(args: Sequence[Any], precision: Any, preferred_element_type: Any, **_: Any) -> bool:
    """Whether a product is of float32 throughout, and asks for no precision of its own."""
    usual = jax.lax.Precision.DEFAULT
    types = {arg.dtype for arg in args} | {preferred_element_type or jnp.float32}
    return precision in (None, usual, (usual, usual)) and all(jnp.dtype(each) == jnp.float32 for each in types)


def _product(
    a: Float[Array, "..."], b: Float[Array, "..."], dimension_numbers: Any, **given: Any
) -> Float[Array, "..."]:
    """`jax.lax.dot_general` of the rounded factors, or of the factors themselves if it is small."""
    (sum_a, sum_b), (batch_a, batch_b) = dimension_numbers
    free_a, free_b = (_others(x.ndim, *axes) for x, axes in ((a, (sum_a, batch_a)), (b, (sum_b, batch_b))))
    batch, rows, columns = ([x.shape[i] for i in axes] for x, axes in ((a, batch_a), (a, free_a), (b, free_b)))
    m, n, length = math.prod(rows), math.prod(columns), math.prod(a.shape[i] for i in sum_a)
    if min(m, n, length) < SMALLEST or 0 in a.shape:
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
    """x itself, as a choice whose outcome XLA does not know: it always takes x.

    Otherwise XLA joins a transposition with the product before or after it. Then it computes the product in float32, or
    cannot compile it (JAX 0.10, CPU).
    """
    return jnp.where(x[(0,) * x.ndim] > jnp.inf, 0.0, x)
