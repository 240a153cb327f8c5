"""Each hyperparameter of an update changes the parts of the agent that it is about, and no others."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import pytest

from beliefrl.types import Reading
from inputs import SPEC, same, windows
from worlds import tiny

BASES = {
    "sac-mlp": tiny("sac-mlp", batch_size=6),
    "sac-lstm": tiny("sac-lstm", seq_len=4, batch_size=2, burn_in=2),
    "vrm": tiny("vrm", seq_len=4, batch_size=2, burn_in=2),
    "slac": tiny("slac", batch_size=2),
    "predictive-sac": tiny("predictive-sac", seq_len=6, sequences=2, pool=2, batch_size=16, observation_memory=()),
}
MODEL = {"sac-lstm": "lstm", "vrm": "keep", "slac": "model", "predictive-sac": "model"}  # where it is in the state


def learned(agent, name):
    """The parts of the agent after one cycle and its first update."""
    window = windows(jax.random.key(1), agent.cycle_windows, agent.window.length + 1)
    memory = jax.eval_shape(lambda: agent.note(agent.reset(SPEC)))
    note = jax.tree.map(lambda leaf: jnp.zeros((*window.step.reward.shape, *leaf.shape)), memory)
    reader = jnp.arange(agent.cycle_windows)
    reading = Reading(reader, jnp.zeros(reader.shape, bool)) if name == "predictive-sac" else None
    window = window._replace(note=note, reading=reading)

    @jax.jit
    def cycle(window):
        state, batches, _ = agent.begin_cycle(agent.init(jax.random.key(0), SPEC), window, jax.random.key(2))
        return agent.update(state, jax.tree.map(lambda leaf: leaf[0], batches), jax.random.key(3))[0]

    state = cycle(window)
    controller = state.controller
    critics, targets = ("critics", "targets") if name == "predictive-sac" else (("critics", "value"), "target_value")
    return {
        "actor": controller.actor,
        "critics": [getattr(controller, each) for each in ([critics] if isinstance(critics, str) else critics)],
        "targets": getattr(controller, targets),
        "alpha": controller.log_alpha,
        "model": getattr(state, MODEL[name]) if name in MODEL else (),
        "target_model": getattr(state, "target_lstm", ()),
    }


usual = functools.cache(lambda name: learned(BASES[name], name))

SAC = [
    ("lr_actor", 1e-2, "actor"),
    ("lr_critic", 1e-2, "critics targets"),
    ("lr_alpha", 1e-2, "alpha"),
    ("tau", 0.5, "targets"),
    ("actor_regulariser", 1.0, "actor"),
    ("target_entropy", 50.0, "alpha"),
]
LSTM = "model target_model"  # it learns from the losses of the controller
RETURNS = "actor critics targets"  # the actor's loss is in units of the returns
CASES = [
    *[("sac-mlp", *each) for each in SAC],
    ("sac-mlp", "gamma", 0.1, "critics"),  # V has no reward in its loss
    ("sac-lstm", "lr_critic", 1e-2, "critics targets"),
    ("sac-lstm", "lr_lstm", 1e-2, LSTM),
    ("sac-lstm", "tau", 0.5, "targets target_model"),
    ("sac-lstm", "gamma", 0.1, f"critics {LSTM}"),
    *[("predictive-sac", *each) for each in SAC],
    ("predictive-sac", "lr_model", 1e-2, "model"),
    ("predictive-sac", "gamma", 0.1, RETURNS),
    ("predictive-sac", "trace_decay", 0.1, RETURNS),
    ("predictive-sac", "off_policy_trace", 0.0, RETURNS),
    ("predictive-sac", "trace_per_dimension", True, RETURNS),
    ("predictive-sac", "pessimism", 0.0, RETURNS),
    ("predictive-sac", "critic_likelihood", 1.0, "critics targets"),
]


def changed(name, field, value):
    """The parts that this value of a hyperparameter changes."""
    parts = learned(dataclasses.replace(BASES[name], **{field: value}), name)
    return {part for part in parts if not same(parts[part], usual(name)[part])}


@pytest.mark.parametrize(("name", "field", "value", "expected"), CASES)
def test_a_hyperparameter_changes_what_it_is_about(name, field, value, expected):
    assert changed(name, field, value) == set(expected.split())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "field", "value"),
    [
        ("vrm", "lr_model", 1e-2),
        ("vrm", "elbo_scaling", "sum"),
        ("vrm", "decode_from", "prior"),
        ("slac", "lr_model", 1e-2),
        ("slac", "elbo_scaling", "sum"),
    ],
)
def test_a_hyperparameter_of_a_latent_variable_model_changes_it(name, field, value):
    """The beliefs of the same cycle are those of the new model, so the controller changes, too."""
    assert "model" in changed(name, field, value)
