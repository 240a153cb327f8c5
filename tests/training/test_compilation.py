"""What is compiled is kept in a folder of the user's, and a broken folder stops no training."""

import json
import os
import pathlib
import subprocess
import sys

import jax
import pytest

from beliefrl.training import compilation

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


@pytest.mark.slow
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


@pytest.mark.slow
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
