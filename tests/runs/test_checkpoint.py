"""Checkpoints: what is written comes back whole, the damaged is known and passed over, nothing good is lost."""

import errno
import json
import os
import pathlib
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl.errors import UserError
from beliefrl.runs import arrays, checkpoint
from beliefrl.runs.checkpoint import Checkpoints, listed

CAPACITY, SEEDS = 8, 2


def tree(value=0.0):
    return {
        "weights": jnp.full((SEEDS, 3), value),
        "flags": jnp.array([True, False]),
        "keys": jax.random.split(jax.random.key(int(value)), SEEDS),
        "empty": (),
    }


def numbers(value):
    return np.asarray(jax.random.key_data(value) if jnp.issubdtype(value.dtype, jax.dtypes.prng_key) else value)


def equal(a, b):
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(numbers(x), numbers(y)), a, b)


class Ring:
    """A replay of two seeds whose timesteps are their running numbers."""

    def __init__(self):
        self.timesteps = {"obs": np.zeros((SEEDS, CAPACITY, 2), np.float32), "first": np.zeros((SEEDS, CAPACITY), bool)}
        self.added = np.zeros(SEEDS, int)

    def add(self, *counts):
        for seed, count in enumerate(counts):
            for number in range(self.added[seed], self.added[seed] + count):
                self.timesteps["obs"][seed, number % CAPACITY] = number + 100 * seed
                self.timesteps["first"][seed, number % CAPACITY] = number % 3 == 0
            self.added[seed] += count


def saved(checkpoints, ring, step, value=None):
    value = float(step) if value is None else value
    checkpoints.save(step, {"at": step}, tree(value), ring.timesteps, ring.added)
    checkpoints.wait()


@pytest.fixture
def three(tmp_path):
    """A folder with checkpoints of the steps 10, 20 and 30, and the ring at each."""
    checkpoints, ring, rings = Checkpoints(tmp_path, keep=3), Ring(), {}
    for step, counts in ((10, (3, 2)), (20, (2, 4)), (30, (0, 1))):
        ring.add(*counts)
        saved(checkpoints, ring, step)
        rings[step] = {name: leaf.copy() for name, leaf in ring.timesteps.items()}
    checkpoints.close()
    return tmp_path, rings


def restored(folder):
    return Checkpoints(folder, keep=3).restore(tree(), Ring().timesteps)


def test_everything_comes_back(three):
    folder, rings = three
    found = restored(folder)
    assert (found.step, found.progress, found.passed_over) == (30, {"at": 30}, [])
    equal(found.tree, tree(30.0))
    equal(found.timesteps, rings[30])


@pytest.mark.parametrize("is_old", [False, True])
def test_seeds_whose_numbers_differ_in_length_come_back(tmp_path, is_old):
    """Text and numbers are in another order: "10" is before "9". Version 0.3.0 signed the order of the numbers."""
    ring, checkpoints = Ring(), Checkpoints(tmp_path, keep=2)
    progress = {"metrics": {9: 90, 10: 100}}
    checkpoints.save(5, progress, tree(), ring.timesteps, ring.added)
    checkpoints.close()
    if is_old:
        path = listed(tmp_path)[-1] / "manifest.json"
        content = json.loads(path.read_bytes())["content"] | {"progress": progress}
        signed = {"content": content, "sha256": checkpoint._sha256(checkpoint._canonical(content))}
        path.write_text(json.dumps(signed))
    assert Checkpoints(tmp_path, keep=2).restore(tree(), ring.timesteps).progress == {"metrics": {"9": 90, "10": 100}}


def test_a_checkpoint_writes_only_what_is_new_in_the_replay(three):
    folder, _ = three
    files = sorted((folder / "checkpoints" / "replay").iterdir())
    assert [arrays.load(path)["['first']"].shape[1] for path in files] == [3, 4, 1]


@pytest.mark.parametrize("counts", [(3, 3), (8, 7), (20, 1), (0, 30)])
def test_a_ring_that_has_turned_comes_back(tmp_path, counts):
    checkpoints, ring = Checkpoints(tmp_path, keep=2), Ring()
    for step in range(1, 6):
        ring.add(*counts)
        saved(checkpoints, ring, step)
        equal(restored(tmp_path).timesteps, ring.timesteps)


def test_a_larger_ring_takes_what_a_smaller_one_held(three):
    folder, rings = three
    like = {"obs": np.zeros((SEEDS, 20, 2), np.float32), "first": np.zeros((SEEDS, 20), bool)}
    found = Checkpoints(folder, keep=3).restore(tree(), like)
    np.testing.assert_array_equal(found.timesteps["obs"][0, :5], rings[30]["obs"][0, :5])
    assert not found.timesteps["obs"][0, 5:].any()


def test_timesteps_that_have_changed_are_written_anew(tmp_path):
    checkpoints, ring = Checkpoints(tmp_path, keep=1), Ring()
    ring.add(4, 4)
    saved(checkpoints, ring, 1)
    ring.timesteps["obs"][:, :4] += 0.5
    checkpoints.forget_timesteps()
    saved(checkpoints, ring, 2)
    equal(restored(tmp_path).timesteps, ring.timesteps)
    assert len(list((tmp_path / "checkpoints" / "replay").iterdir())) == 1  # what nothing names is gone


def test_the_last_ones_are_kept_and_what_they_name(tmp_path):
    checkpoints, ring = Checkpoints(tmp_path, keep=2), Ring()
    for step in range(5):
        ring.add(1, 1)
        saved(checkpoints, ring, step)
    assert [path.name[-6:] for path in checkpoint.listed(tmp_path)] == ["step-3", "step-4"]
    equal(restored(tmp_path).timesteps, ring.timesteps)


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def cut(path):
    path.write_bytes(path.read_bytes()[:-7])


def no_json(path):
    path.write_text("{")


@pytest.mark.parametrize("harm", [flip, cut, no_json, os.unlink])
@pytest.mark.parametrize("file", ["state.safetensors", "manifest.json"])
def test_a_damaged_checkpoint_is_passed_over_for_the_one_before(three, harm, file):
    folder, rings = three
    newest = checkpoint.listed(folder)[-1]
    harm(newest / file)
    found = restored(folder)
    assert found.step == 20
    equal(found.tree, tree(20.0))
    equal(found.timesteps, rings[20])
    assert len(found.passed_over) == 1
    assert str(newest / file) in found.passed_over[0]
    assert newest.with_name(f"damaged-{newest.name}").exists()  # nothing is removed


@pytest.mark.parametrize("harm", [flip, cut, os.unlink])
def test_damaged_timesteps_are_known(three, harm):
    folder, rings = three
    harm(sorted((folder / "checkpoints" / "replay").iterdir())[-1])
    found = restored(folder)
    assert found.step == 20
    equal(found.timesteps, rings[20])


def test_every_flipped_byte_is_known(three):
    """Not only the one in the middle: every 37th byte of the newest checkpoint's files."""
    folder, _ = three
    newest = checkpoint.listed(folder)[-1]
    for path in newest.iterdir():
        content = path.read_bytes()
        for position in range(0, len(content), 37):
            changed = bytearray(content)
            changed[position] ^= 1
            path.write_bytes(changed)
            with pytest.raises(UserError):
                checkpoint.checked(newest)
            path.write_bytes(content)
    assert restored(folder).step == 30


def test_going_on_after_damage_replaces_nothing(three):
    folder, rings = three
    flip(checkpoint.listed(folder)[-1] / "state.safetensors")
    before = {path: path.read_bytes() for path in folder.rglob("*.safetensors") if "damaged" not in str(path)}
    checkpoints, ring = Checkpoints(folder, keep=3), Ring()
    checkpoints.restore(tree(), ring.timesteps)
    ring.timesteps, ring.added = rings[20], np.array([5, 6])
    ring.add(1, 1)
    saved(checkpoints, ring, 30)
    equal(restored(folder).timesteps, ring.timesteps)
    needed = [path for path in before if path.exists()]
    assert len([path for path in needed if path.parent.name == "replay"]) == 2  # those of the steps 10 and 20
    assert all(path.read_bytes() == before[path] for path in needed if "step-30" not in str(path))


def test_without_a_good_one_there_is_a_sentence(three):
    folder, _ = three
    for path in checkpoint.listed(folder):
        cut(path / "state.safetensors")
    with pytest.raises(UserError, match=r"has no checkpoint to continue from: .*state\.safetensors is damaged"):
        restored(folder)
    with pytest.raises(UserError, match="has no checkpoint to continue from"):
        restored(folder / "nothing")


def test_another_version_is_refused(three):
    folder, _ = three
    path = checkpoint.listed(folder)[-1] / "manifest.json"
    content = json.loads(path.read_text())["content"] | {"format": 7}
    path.write_bytes(checkpoint._signed(content))
    with pytest.raises(UserError, match="was written in format 7, and this version of BeliefRL reads 1"):
        restored(folder)


def test_another_agent_is_refused(three):
    folder, _ = three
    with pytest.raises(UserError, match="does not fit the agent"):
        Checkpoints(folder, keep=3).restore(tree() | {"weights": jnp.zeros((SEEDS, 4))}, Ring().timesteps)


@pytest.mark.parametrize(
    "others", [{"speed": np.zeros((SEEDS, CAPACITY))}, {"obs": np.zeros((SEEDS, CAPACITY, 3), np.float32)}]
)
def test_a_replay_of_another_task_or_version_is_refused(three, others):
    folder, _ = three
    name = next(iter(others))
    with pytest.raises(UserError, match=rf"0000\d+\.safetensors does not fit the agent .*at \['{name}'\]"):
        Checkpoints(folder, keep=3).restore(tree(), Ring().timesteps | others)


def test_an_array_is_found_under_its_old_name(three):
    folder, _ = three
    present = {"scale" if name == "weights" else name: leaf for name, leaf in tree().items()}
    with pytest.raises(UserError, match="does not fit the agent"):
        Checkpoints(folder, keep=3).restore(present, Ring().timesteps)
    renamed = {"['scale']": "['weights']"}
    found = Checkpoints(folder, keep=3).restore(present, Ring().timesteps, renamed)
    np.testing.assert_array_equal(found.tree["scale"], tree(30.0)["weights"])


class Planted:
    """Unpickled, it would leave a mark."""

    def __reduce__(self):
        return os.mkdir, ("planted",)


def test_no_pickle_is_ever_loaded(three, monkeypatch):
    folder, _ = three
    monkeypatch.chdir(folder)
    harmful = pickle.dumps(Planted())
    for path in checkpoint.listed(folder)[1:]:
        for file in path.iterdir():
            file.write_bytes(harmful)
    assert restored(folder).step == 10
    assert not (folder / "planted").exists()
    pickle.loads(harmful)  # the plant is a good one
    assert (folder / "planted").exists()


@pytest.mark.parametrize("place", ["state.safetensors", "manifest.json", "000004.safetensors"])
def test_a_full_disk_is_an_error_and_the_last_good_one_stands(three, monkeypatch, place):
    folder, rings = three
    checkpoints, ring = Checkpoints(folder, keep=3), Ring()
    checkpoints.restore(tree(), ring.timesteps)
    ring.timesteps, ring.added = rings[30], np.array([5, 7])
    ring.add(1, 1)
    real = arrays.write_whole

    def full(path, content):
        if path.name == place:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(path, content)

    monkeypatch.setattr(checkpoint, "write_whole", full)
    checkpoints.save(40, {}, tree(40.0), ring.timesteps, ring.added)
    with pytest.raises(OSError, match="No space left on device"):
        checkpoints.wait()
    assert restored(folder).step == 30


def test_what_a_kill_leaves_behind_is_cleared_away(three):
    folder, _ = three
    left = folder / "checkpoints" / ".000009-step-40.tmp"
    left.mkdir()
    (left / "state.safetensors").write_bytes(b"half")
    assert restored(folder).step == 30
    checkpoints, ring = Checkpoints(folder, keep=3), Ring()
    checkpoints.restore(tree(), ring.timesteps)
    saved(checkpoints, ring, 40)
    assert not left.exists()


def test_a_ring_that_grew_after_it_wrapped_has_only_what_was_saved(tmp_path):
    checkpoints, ring = Checkpoints(tmp_path, keep=1), Ring()
    ring.add(CAPACITY + 3, CAPACITY + 3)
    saved(checkpoints, ring, 10)
    larger = {
        name: np.zeros((SEEDS, 2 * CAPACITY, *leaf.shape[2:]), leaf.dtype) for name, leaf in ring.timesteps.items()
    }
    checkpoints = Checkpoints(tmp_path, keep=1)
    found = checkpoints.restore(tree(), larger)
    np.testing.assert_array_equal(found.missing, 3)
    np.testing.assert_array_equal(found.timesteps["obs"][0, :CAPACITY, 0], 3 + np.arange(CAPACITY))
    checkpoints.save(20, {}, tree(), found.timesteps, ring.added - found.missing)
    checkpoints.close()
    again = Checkpoints(tmp_path, keep=1).restore(tree(), larger)
    equal(again.timesteps, found.timesteps)
    assert not again.missing.any()


def test_files_that_the_ring_has_overwritten_are_removed(tmp_path):
    checkpoints, ring = Checkpoints(tmp_path, keep=1), Ring()
    for step in range(1, 11):
        ring.add(CAPACITY // 2, CAPACITY // 2)
        saved(checkpoints, ring, step)
    assert len(list((tmp_path / "checkpoints" / "replay").iterdir())) <= 3
    found = restored(tmp_path)
    equal(found.timesteps, ring.timesteps)


def test_timesteps_whose_file_was_removed_are_written_again(tmp_path):
    checkpoints, ring = Checkpoints(tmp_path, keep=2), Ring()
    for step in (1, 2):
        ring.add(1, 2)
        saved(checkpoints, ring, step)
        if step == 1:
            (tmp_path / "checkpoints" / "replay" / "000001.safetensors").unlink()
    assert restored(tmp_path).step == 2
    equal(restored(tmp_path).timesteps, ring.timesteps)


def test_a_damaged_older_checkpoint_does_not_prevent_saving(three):
    folder, _ = three
    listed(folder)[1].joinpath("manifest.json").write_text("{")
    checkpoints, ring = Checkpoints(folder, keep=3), Ring()
    checkpoints.restore(tree(), ring.timesteps)
    saved(checkpoints, ring, 40)
    assert restored(folder).step == 40


def test_a_seed_that_is_lost_twice_keeps_the_newer_checkpoint(tmp_path):
    checkpoints, ring = Checkpoints(tmp_path, keep=1), Ring()
    for step in (10, 20):
        ring.add(1, 1)
        saved(checkpoints, ring, step)
        kept = checkpoints.keep_for("seed-999999")
        assert json.loads((kept / "manifest.json").read_bytes())["content"]["step"] == step
    ring.add(1, 1)
    saved(checkpoints, ring, 30)
    assert restored(tmp_path).step == 30


def test_the_last_good_one_of_a_lost_seed_is_kept(tmp_path):
    checkpoints, ring = Checkpoints(tmp_path, keep=1), Ring()
    assert checkpoints.keep_for("seed-3") is None
    ring.add(2, 2)
    saved(checkpoints, ring, 1)
    kept = checkpoints.keep_for("seed-3")
    for step in (2, 3, 4):
        ring.add(1, 1)
        checkpoints.forget_timesteps()
        saved(checkpoints, ring, step)
    content = checkpoint.checked(kept)
    assert content["step"] == 1


def test_a_file_that_is_missing_is_damaged(tmp_path):
    with pytest.raises(arrays.Damaged, match="is damaged"):
        arrays.load(tmp_path / "missing.safetensors")


def test_a_checkpoint_that_cannot_be_read_now_is_not_given_up(three, monkeypatch):
    folder, rings = three

    def failing(path):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patched:
        patched.setattr(pathlib.Path, "read_bytes", failing)
        with pytest.raises(UserError, match=r"cannot be read \(Input/output error\): make it readable"):
            restored(folder)
    found = restored(folder)
    assert (found.step, found.passed_over) == (30, [])
    equal(found.timesteps, rings[30])


def test_a_ring_that_lost_timesteps_in_the_middle_begins_after_them(tmp_path):
    """The second ring still needs the first file. The first ring was overrun between the two checkpoints."""
    checkpoints, rings = Checkpoints(tmp_path, keep=3), Ring()
    rings.add(8, 4)
    saved(checkpoints, rings, 10)
    rings.add(12, 3)
    saved(checkpoints, rings, 20)
    checkpoints.close()
    larger = {"obs": np.zeros((SEEDS, 40, 2), np.float32), "first": np.zeros((SEEDS, 40), bool)}
    found = Checkpoints(tmp_path, keep=3).restore(tree(), larger)
    obs, kept = found.timesteps["obs"][..., 0], 20 - CAPACITY
    np.testing.assert_array_equal(found.missing, [kept, 0])
    np.testing.assert_array_equal(obs[0], [*range(kept, 20), *[0] * 32])
    np.testing.assert_array_equal(obs[1], [*range(100, 107), *[0] * 33])
