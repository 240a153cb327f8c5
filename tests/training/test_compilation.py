"""Compiled programs: a broken folder of them stops no training; the precision of their products; the benchmark."""

import json
import math
import os
import pathlib
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from beliefrl import agents, catalogue, cli, evaluate, load, play, resume, tasks, train
from beliefrl.agents.base import SACAgent
from beliefrl.agents.vrm import VRMAgent
from beliefrl.errors import UserError
from beliefrl.training import compilation, phases
from beliefrl.training.bench import Noise, _flop, bench, parameters
from beliefrl.types import Spec
from beliefrl.viewing.prediction import predictions
from worlds import saved, tiny

TRAIN = """
import hashlib, json, sys
import jax
from beliefrl import make_agent, resume, train

assert jax.config.jax_compilation_cache_dir is None  # an import changes nothing
small = {"train_times_fivrm": 2, "d_size": 8, "z_size": 4, "hidden_size": 8, "seq_len": 8, "burn_in": 4}
agent = make_agent("vrm", batch_size=2, step_start_rl=20, policy_layers=(8,), value_layers=(8,), **small)
notes = []
run = train(agent, "pendulum-v", sys.argv[1], lambda event: notes.append(event.note), steps=30, eval_every=30,
            eval_episodes=1, progress=False)
saved = run.folder.rglob("*.safetensors")
digest = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(saved))).hexdigest()
print(json.dumps([digest, run.results()["sampled"], [note for note in notes if note]]))
"""


def trained(folder, **variables):
    """Digest of the networks, results and notes of a small training in a program of its own, and what it warned of."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("JAX_C", "JAX_P", "BELIEFRL"))
    }
    command = [sys.executable, "-c", TRAIN, str(folder)]
    done = subprocess.run(command, env=environment | variables, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return *json.loads(done.stdout), done.stderr


def entries(folder):
    return sorted(folder.rglob("*-cache"))


@pytest.mark.nightly
def test_results_do_not_depend_on_the_cache(tmp_path):
    cache = tmp_path / "cache"
    *without, notes, _ = trained(tmp_path / "off", BELIEFRL_CACHE="off", XDG_CACHE_HOME=str(cache))
    assert not (cache / "beliefrl").exists()  # other libraries may write beside it
    assert notes == []
    *first, notes, _ = trained(tmp_path / "first", XDG_CACHE_HOME=str(cache))
    assert notes == []
    [learn_read] = (cache / "beliefrl").rglob("jit_learn-*-atime")  # JAX writes there when it reads an entry
    before = learn_read.read_bytes()
    *second, notes, warned = trained(tmp_path / "second", XDG_CACHE_HOME=str(cache))
    assert notes == []
    assert "cache" not in warned
    assert learn_read.read_bytes() != before
    assert without == first == second


@pytest.mark.nightly
def test_garbage_in_the_cache_is_a_warning(tmp_path):
    cache = tmp_path / "cache"
    *whole, _, _ = trained(tmp_path / "first", BELIEFRL_CACHE=str(cache))
    for entry in entries(cache):
        entry.write_bytes(b"garbage")
    unfinished = entries(cache)[0].with_name("half-cache")
    unfinished.write_bytes(b"half")
    *again, _, warned = trained(tmp_path / "second", BELIEFRL_CACHE=str(cache))
    assert again == whole
    assert "Error reading" in warned
    assert "Error writing" not in warned
    assert not unfinished.exists()


@pytest.fixture
def unset(monkeypatch):
    """As in a program whose user has set nothing."""
    names = ("compilation_cache_dir", "compilation_cache_max_size", "persistent_cache_min_compile_time_secs")
    before = {f"jax_{name}": getattr(jax.config, f"jax_{name}") for name in names}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.delenv("BELIEFRL_CACHE", raising=False)
    yield monkeypatch
    for name, value in before.items():
        jax.config.update(name, value)


def test_a_folder_that_cannot_be_written_is_a_note(tmp_path, unset):
    (tmp_path / "file").touch()
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    folders = [tmp_path / "file", tmp_path / "file" / "below", pathlib.Path("/proc/none")]
    for folder in folders + [locked] * (os.name == "posix" and os.geteuid() != 0):
        unset.setenv("BELIEFRL_CACHE", str(folder))
        notes = []
        compilation.keep_compiled(notes.append)
        assert len(notes) == 1
        assert "BELIEFRL_CACHE" in notes[0]
        assert jax.config.jax_compilation_cache_dir is None


def test_the_folder_is_the_platforms_and_limited(tmp_path, unset):
    unset.setenv("XDG_CACHE_HOME", str(tmp_path))
    unset.setenv("LOCALAPPDATA", str(tmp_path))
    unset.setenv("HOME", str(tmp_path))
    for platform, inside in (("linux", ""), ("win32", ""), ("darwin", "Library/Caches")):
        unset.setattr(sys, "platform", platform)
        assert compilation.cache_folder().parent == tmp_path / inside / "beliefrl"
    unset.setattr(sys, "platform", "linux")
    compilation.keep_compiled()
    assert jax.config.jax_compilation_cache_dir == str(compilation.cache_folder())
    assert jax.config.jax_compilation_cache_max_size == compilation.LARGEST_BYTES


def test_a_setting_of_the_users_own_wins(tmp_path, unset):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "own"))
    unset.setenv("BELIEFRL_CACHE", str(tmp_path / "other"))
    compilation.keep_compiled()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "own")
    assert not (tmp_path / "other").exists()


# The precision of matrix products: it reaches the compiled programs, is recorded, and holds for all made of a run.

AGENT = tiny("sac-mlp", step_start_rl=10, pretrain_updates=2, batch_size=4)
OPTIONS = {"steps": 20, "eval_every": 20, "eval_episodes": 1, "track": ()}
PHASES = ("explore", "pretrain", "learn", "evaluate")
ASKED = {"float32": "HIGHEST", "tensorfloat32": "HIGH", "bfloat16": "DEFAULT"}  # of XLA


def asked(text):
    """The precisions that a lowered program asks for, over all its matrix products."""
    products = [line for line in text.splitlines() if "stablehlo.dot_general" in line]
    assert products
    return {precision for line in products for precision in re.findall(r"precision = \[(\w+), (\w+)\]", line) or [None]}


@pytest.fixture
def lowered(monkeypatch):
    """The lowered text of every phase that is called while the test runs."""
    texts, compile_program = {}, phases.compile_program

    def spied(name, phase):
        def call(*args):
            texts[name] = phase.lower(*args).as_text()
            return phase(*args)

        return call

    def compile_spied(*args):
        program = compile_program(*args)
        return program._replace(**{name: spied(name, getattr(program, name)) for name in PHASES})

    monkeypatch.setattr(phases, "compile_program", compile_spied)
    return texts


@pytest.mark.nightly
@pytest.mark.parametrize("precision", ASKED)
def test_it_reaches_every_phase_and_a_resumed_run_keeps_it(tmp_path, lowered, precision):
    train(AGENT, "pendulum-v", tmp_path / "run", precision=precision, **OPTIONS)
    both = {(ASKED[precision],) * 2}
    assert {name: asked(text) for name, text in lowered.items()} == dict.fromkeys(PHASES, both)
    lowered.clear()
    run = resume(tmp_path / "run", steps=30)
    assert asked(lowered["learn"]) == both
    assert json.loads((run.folder / "config.json").read_text())["options"]["precision"] == precision


@pytest.mark.nightly
@pytest.mark.parametrize("precision", [*ASKED, None])
def test_what_is_made_of_a_run_has_its_precision(tmp_path, monkeypatch, precision):
    """None: of a run that was made before there was a choice."""
    run = saved(tmp_path / "run", "vrm", tasks.make("pendulum-v", max_steps=3))
    run.config["options"] |= {"precision": precision} if precision else {}
    seen = []

    def spied(function):
        def call(*args):
            seen.append(jax.config.jax_default_matmul_precision)
            return function(*args)

        return call

    monkeypatch.setattr(SACAgent, "choose", spied(SACAgent.choose))
    monkeypatch.setattr(VRMAgent, "predict", spied(VRMAgent.predict))
    for use in (
        lambda: evaluate(run, episodes=1),
        lambda: play(run),
        lambda: predictions(run, samples=1),
        lambda: load(run).predict([0.5]),
        lambda: load(run).export(tmp_path / "policy.jax"),
    ):
        seen.clear()
        use()
        assert set(seen) == {precision or "float32"}


# The benchmark's keys and numbers, at sizes that take no time.

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
    assert set(result) == MEASURED | {"obs", "actions", "seeds", "device", "precision"}
    assert all(math.isfinite(result[key]) and result[key] > 0 for key in MEASURED)
    assert (result["obs"], result["actions"], result["seeds"]) == (2, 1, 2)
    assert result["device"] == jax.devices()[0].device_kind
    assert result["precision"] == "float32"
    agent = agents.make(
        "vrm", d_size=4, z_size=2, hidden_size=4, policy_layers=(4,), value_layers=(4,), seq_len=4, burn_in=2
    )
    assert result["parameters"] == parameters(shapes(agent, Spec(obs_dim=2, action_dim=1, max_steps=1000)))


def test_bench_all_prints_the_scalability_table(monkeypatch, capsys):
    """Every agent at the sizes asked for; measuring is left to the other tests."""

    def measured(agent, *sizes):
        assert sizes == (4, 2, 3, "float32")
        return {"ms_per_step": 12.5, "parameters": parameters(shapes(agent, Spec(4, 2, 10))), "share_of_peak": 0.5}

    monkeypatch.setattr("beliefrl.training.bench.bench", measured)
    monkeypatch.setenv("COLUMNS", "120")
    cli.main(["bench", "all", "--obs", "4", "--actions", "2", "--seeds", "3"])
    lines = capsys.readouterr().out.splitlines()
    for name in catalogue.agent_names():
        assert any(name in line and "12.5" in line and "20:50" in line and "50%" in line for line in lines)
    cli.main(["bench", "all", "--obs", "4", "--actions", "2", "--seeds", "3", "--json"])
    assert set(json.loads(capsys.readouterr().out)) == set(catalogue.agent_names())


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
