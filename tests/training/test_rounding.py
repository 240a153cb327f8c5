"""Products with factors rounded to bfloat16: their numbers, where they are rounded, and where nothing changes."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import agents, catalogue, tasks
from beliefrl.training import phases, rounding
from beliefrl.training.rounding import SMALLEST, at_precision, rounded
from inputs import same

N = SMALLEST
A, B = jax.random.normal(jax.random.key(0), (2, 3, 2 * N, 2 * N))
OTHER = jax.random.normal(jax.random.key(1), (2 * N, N))


# Without its optimisations, which the other tests do without, XLA cannot compile some of these products for a CPU.
compiled = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 2})


def short(x):
    """x rounded to bfloat16, as a number of float64."""
    return np.asarray(jnp.asarray(x).astype(jnp.bfloat16).astype(jnp.float32), np.float64)


PRODUCTS = {
    "in order": (lambda a, b: a @ b, lambda a, b: short(a) @ short(b)),
    "left transposed": (lambda a, b: a.T @ b, lambda a, b: short(a).T @ short(b)),
    "right transposed": (lambda a, b: a @ b.T, lambda a, b: short(a) @ short(b).T),
    "both transposed": (lambda a, b: a.T @ b.T, lambda a, b: short(a).T @ short(b).T),
    "rows of a vector": (lambda a, b: jax.vmap(lambda row: b @ row)(a), lambda a, b: short(a) @ short(b).T),
}


@pytest.mark.parametrize("name", PRODUCTS)
def test_the_factors_are_rounded_and_the_sum_is_not(name):
    product, expected = PRODUCTS[name]
    found = compiled(rounded(product))(A[0], B[0])
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected(A[0], B[0]), rtol=0, atol=1e-5)
    assert np.max(np.abs(found - product(A[0], B[0]))) > 1e-3


def test_sums_over_two_axes_and_products_side_by_side():
    found = compiled(rounded(lambda a, b: jnp.einsum("ijk,ijl->kl", a, b)))(A, B)
    np.testing.assert_allclose(found, np.einsum("ijk,ijl->kl", short(A), short(B)), atol=1e-5)
    found = compiled(rounded(lambda a, b: jnp.einsum("ikj,ilj->ikl", a, b)))(A, B)
    np.testing.assert_allclose(found, np.einsum("ikj,ilj->ikl", short(A), short(B)), atol=1e-5)
    alone = [compiled(rounded(lambda a, b: a @ b))(a, b) for a, b in zip(A, B, strict=True)]
    np.testing.assert_allclose(compiled(jax.vmap(rounded(lambda a, b: a @ b)))(A, B), alone, atol=1e-5)


def test_the_products_of_a_gradient_are_rounded_too():
    def loss(a, b):
        return jnp.sum(jnp.tanh(a @ b))

    grad_a, grad_b = compiled(rounded(jax.grad(loss, (0, 1))))(A[0], B[0])
    slope = 1 - np.tanh(short(A[0]) @ short(B[0])) ** 2
    np.testing.assert_allclose(grad_a, short(slope) @ short(B[0]).T, atol=0.05)  # the slope may round the other way
    np.testing.assert_allclose(grad_b, short(A[0]).T @ short(slope), atol=0.05)


def looped(a, b):
    return jax.lax.scan(lambda x, row: (jnp.tanh(x @ b), x @ row), a, B, reverse=True)


def repeated(a, b):
    return jax.lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] + 1, jnp.tanh(s[1] @ b)), (0, a))


def chosen(a, b):
    return jax.lax.cond(a[0, 0] > b[0, 0], lambda: a @ b, lambda: b @ a)


def called(a, b):
    return jax.jit(lambda a: jax.nn.relu(a @ b))(a), jax.checkpoint(lambda a: a @ b)(a), jax.nn.softplus(a @ b)


def each_until_its_own_end(a, b):
    """A loop that vmap has given one condition per row."""
    ends = jnp.arange(len(a)) % 3
    return jax.vmap(lambda end, row: jax.lax.fori_loop(0, end, lambda _, x: x + 1.0, row))(ends, a @ b)


def of_none(a, b):
    """Products of no matrices, as in an associative scan."""
    return jax.vmap(jnp.matmul)(jnp.zeros((0, *a.shape)), jnp.zeros((0, *b.shape))), a @ b


@pytest.mark.parametrize("function", [looped, repeated, chosen, called, each_until_its_own_end, of_none])
def test_loops_branches_and_calls_keep_their_meaning(function, monkeypatch):
    """Without rounding every number is as before; with it, all products are rounded."""
    found = compiled(rounded(function))(A[0], B[0])
    assert not any(large(*each) and each[0] != jnp.bfloat16 for each in products(rounded(function), A[0], B[0]))
    monkeypatch.setattr(rounding, "SMALLEST", math.inf)
    expected = function(A[0], B[0])
    assert same(compiled(rounded(function))(A[0], B[0]), compiled(function)(A[0], B[0]))
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for number, exact in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert number.dtype == exact.dtype
        assert not exact.size or np.mean(np.abs(number - exact)) < 0.1


@pytest.mark.parametrize("cut", [0, 1])
def test_small_products_and_other_functions_keep_all_their_digits(cut):
    """A product is small if one of its sides is."""
    a, b = (A[0, : N - 1], OTHER) if cut else (A[0], OTHER[:, : N - 1])

    def function(a, b):
        return jnp.exp(a) @ b + 1 / 3, jnp.sum(b @ b.T[:, : N - 1] if cut == 0 else a)

    assert same(compiled(rounded(function))(a, b), compiled(function)(a, b))


def test_products_with_a_precision_or_type_of_their_own_keep_it():
    def function(a, b):
        return jnp.matmul(a, b, precision="highest"), jnp.matmul(a, b, preferred_element_type=jnp.bfloat16)

    found = compiled(rounded(function))(A[0], B[0])
    assert same(found, compiled(function)(A[0], B[0]))
    assert found[1].dtype == jnp.bfloat16


def test_what_is_not_finite_stays_so():
    broken = A[0].at[0, 0].set(jnp.nan)
    assert np.isnan(compiled(rounded(lambda a, b: a.T @ b))(broken, B[0])).any()
    assert not np.isfinite(compiled(rounded(lambda a, b: a.T @ b))(A[0].at[0, 0].set(jnp.inf), B[0])).all()


def products(function, *args):
    """(type of the factors, m, n, length) of every matrix product of a function."""

    def found(jaxpr):
        for equation in jaxpr.eqns:
            if equation.primitive.name == "dot_general":
                a, out = equation.invars[0].aval, equation.outvars[0].aval
                if not out.size:
                    continue
                (sums, _), (batch, _) = equation.params["dimension_numbers"]
                length, many = (math.prod(a.shape[i] for i in axes) for axes in (sums, batch))
                m = a.size // length // many
                yield a.dtype, m, out.size // m // many, length
            for inner in jax.tree.leaves(list(equation.params.values())):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from found(inner)

    return list(found(jax.make_jaxpr(function)(*args).jaxpr))


def large(_, *sides):
    return min(sides) >= N


@pytest.mark.parametrize("name", PRODUCTS)
def test_products_of_seeds_side_by_side_are_those_of_one_seed(name):
    """Of the factors one or both differ between seeds."""
    product, _ = PRODUCTS[name]
    alone = [compiled(rounded(product))(A[i], B[i]) for i in range(3)]
    np.testing.assert_allclose(compiled(jax.vmap(rounded(product)))(A, B), jnp.stack(alone), atol=1e-5)
    alone = [compiled(rounded(product))(A[i], B[0]) for i in range(3)]
    np.testing.assert_allclose(compiled(jax.vmap(rounded(product), (0, None)))(A, B[0]), jnp.stack(alone), atol=1e-5)


@pytest.mark.parametrize("name", catalogue.agent_names())
@pytest.mark.parametrize("precision", ["float32", "tensorfloat32", "bfloat16"])
def test_every_large_product_of_an_agents_learning_is_rounded_if_asked(name, precision):
    agent, task = agents.make(name), tasks.make("pendulum-v")
    program = phases.compile_program(agent, task, capacity=2000, episodes=1)
    seeds = program.shapes(jax.random.split(jax.random.key(0), 1))
    with jax.default_matmul_precision(precision):
        found = products(functools.partial(phases.learn, agent, task), seeds, 0, 1)
        found += products(functools.partial(phases.pretrain, agent), seeds, 0, 1)
    kinds = {kind for kind, *sides in found if large(kind, *sides)}
    assert kinds == {jnp.dtype(jnp.bfloat16 if precision == "bfloat16" else jnp.float32)}


@pytest.mark.parametrize("precision", ["float32", "tensorfloat32", "highest"])
def test_without_it_an_update_is_not_touched(precision):
    with jax.default_matmul_precision(precision):
        assert at_precision(looped) is looped
