"""Another library of the program may have set JAX to 64 bits: a policy acts as before, and all else is refused."""

import jax
import jax.export
import numpy as np
import pytest

from beliefrl import UserError, evaluate, load, play, predictions, resume, train
from beliefrl.tasks import make
from beliefrl.tasks.gymnasium import GymnasiumTask
from worlds import saved, tiny
from wrong import Fine

TASK = make("pendulum-v", max_steps=4)
REFUSED = "JAX is set to 64 bits, but agents learn and play with 32: unset JAX_ENABLE_X64"


@pytest.fixture
def wide():
    """A function that sets JAX to 64 bits, until the end of the test."""
    yield lambda: jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_x64", False)


def acted(policy):
    """The actions of three steps: two modes and a sample."""
    first, state = policy.predict([0.1])
    second, state = policy.predict([0.2], -1.0, state)
    third, state = policy.predict([0.3], -2.0, state, deterministic=False)
    assert first.dtype == state[-1].dtype == np.float32
    return np.stack([first, second, third])


@pytest.mark.parametrize("name", ["sac-mlp", "predictive-sac"])
def test_a_policy_acts_with_32_bits(tmp_path, wide, name):
    run = saved(tmp_path / "run", name, TASK)
    expected, before = acted(load(run)), load(run)
    wide()
    np.testing.assert_array_equal(acted(before), expected)
    np.testing.assert_array_equal(acted(load(run)), expected)


def test_a_policy_is_exported_with_32_bits(tmp_path, wide):
    policy = load(saved(tmp_path / "run", "predictive-sac", TASK))
    wide()
    policy.export(tmp_path / "policy.jax")
    exported = jax.export.deserialize((tmp_path / "policy.jax").read_bytes())
    assert not any(aval.dtype.itemsize == 8 for aval in (*exported.in_avals, *exported.out_avals))
    state, start = policy.initial_state(1), np.array([True])
    obs, reward = np.full((1, 1), 0.1, np.float32), np.zeros(1, np.float32)
    action, _ = exported.call(obs, reward, state, start, np.uint32(0), np.bool_(True))
    np.testing.assert_allclose(action[0], policy.predict([0.1])[0], rtol=1e-5, atol=1e-6)


def test_a_policy_is_exported_to_onnx_with_32_bits(tmp_path, wide):
    onnx = pytest.importorskip("onnx")
    policy = load(saved(tmp_path / "run", "predictive-sac", TASK))
    wide()
    assert policy.export(tmp_path / "policy.onnx") < 1e-5
    graph = onnx.load(tmp_path / "policy.onnx").graph
    kinds = {value.type.tensor_type.elem_type for value in (*graph.input, *graph.output)}
    assert onnx.TensorProto.DOUBLE not in kinds


def test_the_program_keeps_its_64_bits(tmp_path, wide):
    run = saved(tmp_path / "run", "sac-mlp", GymnasiumTask(Fine))
    wide()
    load(run, task=Fine).predict([0.1, 0.2])
    assert jax.config.read("jax_enable_x64")


def test_a_training_and_all_that_plays_is_refused(tmp_path, wide):
    run = saved(tmp_path / "run", "predictive-sac", TASK)
    wide()
    for call in (
        lambda: train(tiny("sac-mlp"), TASK, tmp_path / "new"),
        lambda: resume(run),
        lambda: evaluate(run, 1),
        lambda: play(run),
        lambda: predictions(run),
    ):
        with pytest.raises(UserError, match=REFUSED):
            call()
    assert not (tmp_path / "new").exists()
