"""The benchmark's keys and numbers, at sizes that take no time."""

import json
import math
import subprocess
import sys

import jax
import pytest

from beliefrl import agents
from beliefrl.bench import Noise, bench, parameters
from beliefrl.types import Spec, UserError

SMALL = (
    "--obs 2 --actions 1 --seeds 2 --train-times-fivrm 3 --seq-len 4 --burn-in 2 --batch-size 2 --d-size 4 --z-size 2 "
    "--hidden-size 4 --policy-layers 4 --value-layers 4 --step-start-rl 10"
)
MEASURED = {
    "ms_per_step",
    "acting_ms",
    "controller_update_ms",
    "model_update_ms",
    "pretraining_ms",
    "pretraining_ms_per_update",
    "first_training_step_s",
    "compile_s",
    "matmul_gflops",
    "gflop_per_step",
    "share_of_peak",
    "parameters",
}


def shapes(agent, spec):
    """The state of an agent, without its numbers."""
    return jax.eval_shape(lambda key: agent.init(key, spec), jax.random.key(0))


def test_bench_prints_one_object_of_positive_numbers(monkeypatch):
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # compiles sooner
    command = [sys.executable, "-m", "beliefrl.cli", "bench", "vrm", "--json", *SMALL.split()]
    out = subprocess.run(command, capture_output=True, text=True, check=True, timeout=400).stdout
    result = json.loads(out)
    assert out.count("\n") == 1
    assert set(result) == MEASURED | {"obs", "actions", "seeds", "device"}
    assert all(math.isfinite(result[key]) and result[key] > 0 for key in MEASURED)
    assert (result["obs"], result["actions"], result["seeds"]) == (2, 1, 2)
    assert result["device"] == jax.devices()[0].device_kind
    agent = agents.make(
        "vrm", d_size=4, z_size=2, hidden_size=4, policy_layers=(4,), value_layers=(4,), seq_len=4, burn_in=2
    )
    assert result["parameters"] == parameters(shapes(agent, Spec(obs_dim=2, action_dim=1, max_steps=1000)))


def test_parameters_are_the_authors_without_what_they_do_not_use():
    unused, second_lstm_biases, log_alpha = 66_048, 2 * 1_024, 1  # their number leaves log α out
    expected = 2_852_134 - unused - second_lstm_biases + log_alpha
    assert parameters(shapes(agents.make("vrm"), Spec(obs_dim=6, action_dim=3, max_steps=1000))) == expected


@pytest.mark.parametrize("sizes", [(0, 1), (1, -1), (1, 10**20)])
def test_impossible_sizes_are_refused(sizes):
    with pytest.raises(UserError, match="is impossible"):
        Noise(*sizes)


@pytest.mark.parametrize("seeds", [0, -1, 10**20])
def test_impossible_seeds_are_refused(seeds):
    with pytest.raises(UserError, match="seeds"):
        bench(agents.make("vrm"), 2, 1, seeds)
