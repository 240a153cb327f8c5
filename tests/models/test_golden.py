"""Our networks and losses give the numbers of the authors' code (golden.npz, toy sizes, PyTorch's layout)."""

import pathlib
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl.agents.sac_mlp import SACMLPAgent
from beliefrl.models.nets import MLP, gaussian_log_prob
from beliefrl.models.optimisation import soft_update
from beliefrl.models.soft_actor_critic import Actor, Batch, Controller, loss
from beliefrl.models.variational_model import VRM, elbo_terms
from beliefrl.types import Timestep, Window

GOLDEN = dict(np.load(pathlib.Path(__file__).parent / "golden.npz"))
D, Z, HIDDEN, X, ACTION = 16, 4, 8, 7, 3


def close(ours, theirs):
    """Equal to 1e-5 of the array's own size."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    assert ours.shape == theirs.shape
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5 * max(np.abs(theirs).max(), 1e-3))


def net(numbers, name, activation):
    """The golden weights `name` as an MLP."""
    count = sum(key.startswith(f"{name}/") and key.endswith("weight") for key in numbers)
    sizes = [numbers[f"{name}/0/weight"].shape[1]] + [numbers[f"{name}/{i}/weight"].shape[0] for i in range(count)]
    mlp = jax.eval_shape(lambda: MLP(sizes, activation))
    layers = tuple(
        eqx.tree_at(
            lambda layer: (layer.weight, layer.bias),
            layer,
            (jnp.array(numbers[f"{name}/{i}/weight"]), jnp.array(numbers[f"{name}/{i}/bias"])),
        )
        for i, layer in enumerate(mlp.layers)
    )
    return eqx.tree_at(lambda mlp: mlp.layers, mlp, layers)


def group(numbers, prefix):
    """All arrays whose names begin with a prefix, such as "sac/" or "w/", without the prefix."""
    return {key.removeprefix(prefix): value for key, value in numbers.items() if key.startswith(prefix)}


def vrm_from(numbers):
    """A VRM whose weights (or whose gradient) are the golden ones; the two LSTM biases become one."""
    vrm = jax.eval_shape(lambda: VRM(X, ACTION, D, Z, HIDDEN))
    mean, sigma = net(numbers, "posterior_mean", jnp.tanh), net(numbers, "posterior_sigma", jnp.tanh)
    posterior = np.concatenate([mean.layers[0].weight, sigma.layers[0].weight]).T  # rows d, action, features
    w_ih, w_hh = numbers["lstm/weight_ih"].T, numbers["lstm/weight_hh"].T  # rows features, z
    joint = (
        np.concatenate([posterior[:D], w_hh], axis=1),
        np.concatenate([posterior[D + ACTION :], w_ih[:HIDDEN]], axis=1),
        posterior[D : D + ACTION],
        w_ih[HIDDEN:],
        np.concatenate([mean.layers[0].bias, sigma.layers[0].bias, numbers["lstm/bias_ih"] + numbers["lstm/bias_hh"]]),
    )
    others = ("features", "prior_mean", "prior_sigma", "decoder_mean", "decoder_sigma")
    return eqx.tree_at(
        lambda vrm: (
            vrm.joint.w_d,
            vrm.joint.w_features,
            vrm.joint.w_action,
            vrm.joint.w_z,
            vrm.joint.bias,
            vrm.posterior_mean,
            vrm.posterior_sigma,
            *(getattr(vrm, name) for name in others),
        ),
        vrm,
        (
            *map(jnp.array, joint),
            mean.layers[1],
            sigma.layers[1],
            *(net(numbers, name, jnp.tanh) for name in others),
        ),
    )


@pytest.fixture(scope="module")
def vrm_numbers():
    return group(GOLDEN, "vrm/")


@pytest.fixture(scope="module")
def inputs(vrm_numbers):
    """x, prev_action, is_first and noise, time first."""
    x, action, noise = (jnp.array(vrm_numbers[name].swapaxes(0, 1)) for name in ("x", "prev_action", "noise"))
    return x, action, jnp.zeros(x.shape[:2], bool), noise


def negative_elbo(vrm, inputs):
    x, action, _, _ = inputs
    inferred = vrm.infer(vrm.start(x.shape[1]), *inputs)
    terms = elbo_terms(vrm, inferred, x, action)
    return jnp.mean(terms.kl) - jnp.mean(terms.log_likelihood), (inferred, terms)


@pytest.fixture(scope="module")
def elbo(vrm_numbers, inputs):
    """The negative ELBO with the unroll and the terms that it comes from, and its gradient."""
    vrm = vrm_from(group(vrm_numbers, "w/"))
    return jax.jit(jax.value_and_grad(negative_elbo, has_aux=True))(vrm, inputs)


def test_inference_equals_the_authors(vrm_numbers, inputs, elbo):
    vrm, (inferred, _) = vrm_from(group(vrm_numbers, "w/")), elbo[0][1]
    prior = jax.jit(jax.vmap(jax.vmap(vrm.prior)))(inferred.before, inputs[1])
    decoded = jax.jit(jax.vmap(jax.vmap(vrm.decode)))(inferred.before, inferred.z)
    ours = {
        "posterior_mean": inferred.posterior.mean,
        "posterior_sigma": inferred.posterior.sigma,
        "prior_mean": prior.mean,
        "prior_sigma": prior.sigma,
        "z": inferred.z,
        "d": inferred.state.d,
        "c": inferred.state.c,
        "decoded_mean": decoded.mean,
        "decoded_sigma": decoded.sigma,
    }
    for name, value in ours.items():
        close(np.asarray(value).swapaxes(0, 1), vrm_numbers[name])


def test_elbo_equals_the_authors(vrm_numbers, elbo):
    value, (_, terms) = elbo[0]
    close(np.asarray(terms.kl).T, vrm_numbers["kl"])
    close(np.asarray(terms.log_likelihood).T, vrm_numbers["log_likelihood"])
    close(value, vrm_numbers["negative_elbo"])


def test_a_step_of_its_own_is_one_of_the_unroll(vrm_numbers, inputs, elbo):
    vrm, (inferred, _) = vrm_from(group(vrm_numbers, "w/")), elbo[0][1]
    before = jax.tree.map(lambda leaf: leaf[2, 0], inferred.state)
    after = jax.jit(lambda: vrm.next_state(before, inputs[0][3, 0], inferred.z[3, 0]))()
    jax.tree.map(lambda ours, theirs: close(ours, theirs[3, 0]), after, inferred.state)


def test_with_noise_of_the_prior_its_draws_are_decoded(vrm_numbers, inputs, elbo):
    vrm, (inferred, _) = vrm_from(group(vrm_numbers, "w/")), elbo[0][1]
    x, action, _, noise = inputs

    @jax.jit
    def both():
        prior = jax.vmap(jax.vmap(vrm.prior))(inferred.before, action)
        decoded = jax.vmap(jax.vmap(vrm.decode))(inferred.before, prior.mean + prior.sigma * noise)
        expected = jnp.mean(gaussian_log_prob(x, *decoded), axis=-1)
        return elbo_terms(vrm, inferred, x, action, prior_noise=noise).log_likelihood, expected

    close(*both())


def test_gradient_of_the_elbo_equals_the_authors(vrm_numbers, elbo):
    numbers = group(vrm_numbers, "g/")
    np.testing.assert_array_equal(numbers["lstm/bias_ih"], numbers["lstm/bias_hh"])
    theirs = vrm_from(numbers | {"lstm/bias_hh": np.zeros_like(numbers["lstm/bias_hh"])})
    jax.tree.map(close, elbo[1], theirs)


@pytest.fixture(scope="module")
def sac_numbers():
    return group(GOLDEN, "sac/")


def controller_from(numbers, log_alpha):
    actor = jax.eval_shape(lambda: Actor(39, 3, (8, 8)))
    networks = {name: net(numbers, name, jax.nn.relu) for name in ("mean", "log_sigma", "value", "q1", "q2")}
    actor = eqx.tree_at(lambda actor: (actor.mean, actor.log_sigma), actor, (networks["mean"], networks["log_sigma"]))
    target = net(numbers, "target_value", jax.nn.relu) if "target_value/0/weight" in numbers else networks["value"]
    return Controller(actor, (networks["q1"], networks["q2"]), networks["value"], target, jnp.array(log_alpha))


@pytest.fixture(scope="module")
def update(sac_numbers):
    controller = controller_from(group(sac_numbers, "w/"), sac_numbers["log_alpha"])
    batch = Batch(
        *(jnp.array(sac_numbers[name]) for name in ("belief", "next_belief", "action", "reward")),
        terminated=jnp.array(sac_numbers["terminated"] > 0),
        discount=jnp.full(11, float(sac_numbers["gamma"])),
        valid=jnp.ones(11, bool),
    )
    learn = jax.jit(partial(jax.grad(loss, has_aux=True), regulariser=1e-3))
    return controller, learn(controller, batch, jnp.array(sac_numbers["noise"]))


def test_losses_equal_the_authors(sac_numbers, update):
    metrics = update[1][1]
    for name in ("loss_value", "loss_q", "loss_actor"):
        close(metrics[name], sac_numbers[name])


def test_gradients_of_the_losses_equal_the_authors(sac_numbers, update):
    gradient = update[1][0]
    theirs = controller_from(group(sac_numbers, "g/"), sac_numbers["g/log_alpha"])
    jax.tree.map(close, gradient._replace(target_value=theirs.value), theirs)


def test_target_value_moves_as_the_authors(sac_numbers, update):
    controller = update[0]
    after = jax.jit(partial(soft_update, tau=0.005))(controller.target_value, controller.value)
    jax.tree.map(close, after, net(group(sac_numbers, "after/"), "target_value", jax.nn.relu))


def test_its_transitions_are_those_of_the_golden_update(sac_numbers):
    """As windows of two timesteps the numbers come out of SAC-MLP as the transitions that are learned from here."""
    agent, numbers = SACMLPAgent(policy_layers=(8, 8), value_layers=(8, 8), batch_size=6), sac_numbers
    timesteps = [numbers["belief"], numbers["next_belief"]]
    rows, actions = len(numbers["reward"]), numbers["action"].shape[-1]
    step = Timestep(
        obs=jnp.stack(timesteps, axis=1),
        reward=jnp.stack([jnp.zeros(rows), numbers["reward"]], axis=1),
        prev_action=jnp.stack([jnp.zeros((rows, actions)), numbers["action"]], axis=1),
        is_first=jnp.zeros((rows, 2), bool).at[:, 0].set(True),
        terminated=jnp.stack([jnp.zeros(rows, bool), numbers["terminated"] > 0], axis=1),
    )
    window = jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), Window(step, (), jnp.ones((rows, 2), bool)))
    batch = jax.jit(agent.batch)(window)
    for name in ("belief", "next_belief", "action", "reward", "terminated"):
        np.testing.assert_array_equal(getattr(batch, name), numbers[name])
    assert batch.valid.all()
