"""The benchmark's keys and numbers, at sizes that take no time."""

import json
import math
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from beliefrl import agents, cli
from beliefrl.training.bench import Noise, _flop, bench, parameters
from beliefrl.types import Spec, UserError

SMALL = (
    "--obs 2 --actions 1 --seeds 2 --train-times-fivrm 3 --seq-len 4 --burn-in 2 --batch-size 2 --d-size 4 --z-size 2 "
    "--hidden-size 4 --policy-layers 4 --value-layers 4 --step-start-rl 10"
)
MEASURED = {
    "ms_per_step",
    "acting_alone_ms",
    "controller_update_alone_ms",
    "model_update_alone_ms",
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
    """The networks of an agent, without their numbers."""
    return jax.eval_shape(lambda key: agent.networks(agent.init(key, spec)), jax.random.key(0))


@pytest.mark.slow
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


def test_bench_all_prints_the_scalability_table(monkeypatch, capsys):
    """Every agent at the sizes asked for; measuring is left to the other tests."""

    def measured(agent, *sizes):
        assert sizes == (4, 2, 3)
        return {"ms_per_step": 12.5, "parameters": parameters(shapes(agent, Spec(4, 2, 10))), "share_of_peak": 0.5}

    monkeypatch.setattr("beliefrl.training.bench.bench", measured)
    monkeypatch.setenv("COLUMNS", "120")
    cli.main(["bench", "all", "--obs", "4", "--actions", "2", "--seeds", "3"])
    lines = capsys.readouterr().out.splitlines()
    for name in agents.names():
        assert any(name in line and "12.5" in line and "20:50" in line and "50%" in line for line in lines)
    cli.main(["bench", "all", "--obs", "4", "--actions", "2", "--seeds", "3", "--json"])
    assert set(json.loads(capsys.readouterr().out)) == set(agents.names())


@pytest.mark.slow
def test_bench_measures_an_agent_without_a_model():
    """Its begin_cycle only prepares the batch, so no time counts as a model's."""
    agent = agents.make("sac-mlp", step_start_rl=10, batch_size=4, policy_layers=(4,), value_layers=(4,))
    result = bench(agent, 2, 1)
    assert result["model_update_alone_ms"] == 0
    assert result["controller_update_alone_ms"] > 0


@pytest.mark.parametrize(("name", "millions"), [("sac-mlp", 0.4), ("sac-lstm", 1.33), ("slac", 1.6)])
def test_parameters_are_those_of_the_papers_table(name, millions):
    """Of SLAC's 2.8 million there, 1.2 are networks that ours does without; SAC-LSTM's 1.1 have no target LSTM."""
    assert parameters(shapes(agents.make(name), Spec(6, 3, 1000))) == pytest.approx(1e6 * millions, abs=5e4)


def test_parameters_are_the_authors_without_what_they_do_not_use():
    unused, second_lstm_biases, log_alpha = 66_048, 2 * 1_024, 1  # their number leaves log α out
    expected = 2_852_134 - unused - second_lstm_biases + log_alpha
    assert parameters(shapes(agents.make("vrm"), Spec(obs_dim=6, action_dim=3, max_steps=1000))) == expected


def test_products_are_counted_as_they_are_executed():
    """Equal ones once, those of a loop as often as it runs, and none over a single entry."""
    a, b, square = jnp.ones((4, 5)), jnp.ones((5, 6)), jnp.ones((6, 6))

    def products(a, b, square):
        twice = jnp.tanh(a) @ b + jax.lax.stop_gradient(jnp.tanh(a)) @ b
        other = (a + 1) @ b
        looped = jax.lax.scan(lambda x, _: (x @ square, None), twice + other, length=7)[0]
        return looped + a[:, :1] @ b[:1]

    assert _flop(products, a, b, square) == 2 * (4 * 5 * 6) * 2 + 7 * 2 * (4 * 6 * 6)


@pytest.mark.parametrize("sizes", [(0, 1), (1, -1), (1, 10**20)])
def test_impossible_sizes_are_refused(sizes):
    with pytest.raises(UserError, match="is impossible"):
        Noise(*sizes)


@pytest.mark.parametrize("seeds", [0, -1, 10**20])
def test_impossible_seeds_are_refused(seeds):
    with pytest.raises(UserError, match="seeds"):
        bench(agents.make("vrm"), 2, 1, seeds)
