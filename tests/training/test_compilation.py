"""What is compiled is kept in a folder of the user's, and a broken folder stops no training."""

import json
import os
import pathlib
import re
import subprocess
import sys

import jax
import pytest

from beliefrl import evaluate, load, play, resume, tasks, train
from beliefrl.agents.base import SACAgent
from beliefrl.agents.vrm import VRMAgent
from beliefrl.training import compilation, phases
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
ASKED = {"float32": "HIGHEST", "tensorfloat32": "HIGH"}  # of XLA


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
