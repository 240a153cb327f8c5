"""A policy as an ONNX model: it acts like the policy in onnxruntime, for any batch size."""

import functools
import os
import pathlib
import re
import sys
import types

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import cli, onnx, tasks
from beliefrl.errors import UserError
from beliefrl.onnx.graph import model
from beliefrl.policy import Policy, load
from beliefrl.tasks.environment import TaskEnvironment
from worlds import CountingAgent, begun, saved, tiny

TASK = tasks.make("pendulum-p", max_steps=20)
NIGHTLY = (pytest.param(name, marks=pytest.mark.nightly) for name in ("vrm-deterministic", "vrm-first", "slac"))
AGENTS = ("vrm", "sac-mlp", "sac-lstm", "predictive-sac", *NIGHTLY)


def a_policy(name):
    return Policy(tiny(name), TASK.spec, begun(name, TASK.spec, jax.random.key(0)), seed=3)


def session_of(content):
    runtime = pytest.importorskip("onnxruntime")
    return runtime.InferenceSession(content, providers=["CPUExecutionProvider"])


def play(policy, session, batch, steps=8):
    """Actions of both, each with its own state, along episodes of which the first begins again at step 5."""
    random = np.random.default_rng(0)
    ours, theirs = None, [np.zeros_like(part) for part in policy.initial_state(batch)]
    for time in range(steps):
        obs, reward = random.normal(size=(batch, 2)).astype(np.float32), random.normal(size=batch).astype(np.float32)
        start = np.array([time == 0 or (time == 5 and episode == 0) for episode in range(batch)])
        action, ours = policy.predict(obs, reward, ours, start)
        given = {"obs": obs, "reward": reward, "episode_start": start}
        given |= {f"state_{index}": part for index, part in enumerate(theirs)}
        wanted = {each.name for each in session.get_inputs()}
        assert wanted == set(given)
        other, *theirs = session.run(None, given)
        yield action, other


def test_an_agent_that_reads_no_reward_is_exported(tmp_path):
    """A part of its state has no numbers."""
    pytest.importorskip("onnx")
    agent = tiny("predictive-sac", perceive_reward=False)
    policy = Policy(agent, TASK.spec, agent.init(jax.random.key(0), TASK.spec), seed=3)
    assert 0 <= policy.export(tmp_path / "policy.onnx") < 1e-5
    session = session_of((tmp_path / "policy.onnx").read_bytes())
    for batch in (1, 3):
        for ours, theirs in play(policy, session, batch):
            np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-5)
    policy.export(tmp_path / "policy.jax")
    assert jax.export.deserialize(bytearray((tmp_path / "policy.jax").read_bytes())).in_avals


@pytest.mark.parametrize("name", [pytest.param("vrm", marks=pytest.mark.slow), *AGENTS[1:]])
def test_the_model_acts_as_the_policy_does_for_any_batch_size(name, tmp_path):
    pytest.importorskip("onnx")
    policy = a_policy(name)
    assert 0 <= policy.export(tmp_path / "policy.onnx") < 1e-5
    session = session_of((tmp_path / "policy.onnx").read_bytes())
    assert session.get_modelmeta().custom_metadata_map["policy"] == repr(policy)
    assert session.get_outputs()[0].name == "action"
    assert {each.shape[0] for each in (*session.get_inputs(), *session.get_outputs())} == {"batch"}
    for batch in (1, 3):
        for ours, theirs in play(policy, session, batch):
            np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-5)


@pytest.mark.nightly
def test_statistics_and_optional_inputs_are_in_the_model():
    pytest.importorskip("onnx")
    for name, settings in (("sac-mlp", {"standardise": True}), ("sac-lstm", {"perceive_action": True})):
        agent = tiny(name, **settings)
        policy = Policy(agent, TASK.spec, jax.jit(functools.partial(agent.init, spec=TASK.spec))(jax.random.key(1)))
        played = list(play(policy, session_of(onnx.export(policy)[0]), 2))
        for ours, theirs in played:
            np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-5)
        assert len(np.unique([ours for ours, _ in played])) > 4


def test_an_agent_whose_empty_memory_is_not_zero_begins_with_it():
    pytest.importorskip("onnx")
    policy = Policy(CountingAgent(), TASK.spec, CountingAgent().init(jax.random.key(0), TASK.spec))
    content, difference = onnx.export(policy)
    assert difference == 0
    session = session_of(content)
    zeros = {f"state_{index}": np.zeros_like(part) for index, part in enumerate(policy.initial_state(1))}
    given = {"obs": np.zeros((1, 2), np.float32), "reward": np.zeros(1, np.float32)} | zeros
    wanted = {each.name for each in session.get_inputs()}
    given = {name: value for name, value in (given | {"episode_start": np.array([True])}).items() if name in wanted}
    assert session.run(["next_state_0"], given)[0] == CountingAgent.empty + 1


@pytest.mark.slow
def test_the_command_compares_in_an_episode_of_the_task(tmp_path, capsys, monkeypatch):
    pytest.importorskip("onnx")
    calls = []

    class Recording(TaskEnvironment):
        def reset(self, **given):
            calls.append("reset")
            return super().reset(**given)

        def step(self, action):
            calls.append("step")
            obs, reward, _, _, info = super().step(action)
            return obs, reward, False, calls.count("step") == 9, info

        def close(self):
            calls.append("close")

    monkeypatch.setattr("beliefrl.policy.TaskEnvironment", Recording)
    run = saved(tmp_path / "run", "sac-lstm", TASK)
    file = tmp_path / "policy.onnx"
    cli.main(["export", str(run.folder), str(file)])
    assert calls == ["reset", *9 * ["step"], "close"]
    printed = capsys.readouterr().out
    assert f"written to {file}: onnxruntime reads it" in printed
    assert "largest difference from the policy: " in printed
    before = file.read_bytes()
    with pytest.raises(SystemExit) as end:
        cli.main(["export", str(run.folder), str(file)])
    assert end.value.code == 2
    assert "exists already: choose another file, or replace it" in capsys.readouterr().err
    cli.main(["export", str(run.folder), str(file), "--overwrite"])
    assert file.read_bytes() == before
    for ours, theirs in play(load(run), session_of(before), 2):
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-5)


@pytest.mark.nightly
def test_the_loop_on_the_page_of_examples_runs(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    task = tasks.make("gym:Pendulum-v1", observe=(0, 1))
    load(saved(tmp_path / "run", "sac-lstm", task)).export(tmp_path / "policy.onnx")
    page = pathlib.Path(__file__).parent.parent.joinpath("docs", "examples.md").read_text()
    (program,) = [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "onnxruntime" in block]
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(program, names)
    assert names["truncated"]
    assert any(part.any() for part in names["state"].values())


def test_a_missing_package_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(UserError, match=r"not installed: pip install 'beliefrl\[onnx\]'"):
        a_policy("sac-mlp").export(tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def test_an_environment_that_changes_the_working_directory_does_not_move_the_model(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    policy = a_policy("sac-mlp")
    policy.environment = lambda: os.chdir("elsewhere")
    policy.export("policy.onnx")
    assert (tmp_path / "policy.onnx").exists()


def test_a_model_that_differs_is_not_written(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    policy = a_policy("sac-mlp")
    monkeypatch.setattr(Policy, "mode", lambda self, obs, reward, start, last: (last + 1e-3, last))
    with pytest.raises(UserError, match=r"The ONNX model differs from the policy by .*, more than 1e-05"):
        policy.export(tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


class Runtime:
    """An onnxruntime whose models give NaN, or which runs none."""

    SessionOptions = types.SimpleNamespace

    def __init__(self, runs=True):
        self.runs = runs

    def InferenceSession(self, content, options, providers):
        if not self.runs:
            raise RuntimeError("[ONNXRuntimeError] : 9 : NOT_IMPLEMENTED : Scan\n")
        return self

    def get_inputs(self):
        return [types.SimpleNamespace(name="obs")]

    def run(self, outputs, given):
        return [np.full((1, 1), np.nan, np.float32)] * 2


def test_a_model_that_gives_nan_is_not_written(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", Runtime())
    with pytest.raises(UserError, match="The ONNX model differs from the policy by nan"):
        a_policy("sac-mlp").export(tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def test_a_model_that_does_not_run_is_one_sentence_and_no_environment_is_made(monkeypatch):
    pytest.importorskip("onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", Runtime(runs=False))
    made = []
    with pytest.raises(UserError, match=r"cannot run the model \(RuntimeError: .*Scan\): export the policy as a .jax"):
        onnx.export(a_policy("sac-mlp"), lambda: made.append("an environment"))
    assert not made


def test_an_operation_that_is_not_supported_is_named():
    package = pytest.importorskip("onnx")
    with pytest.raises(UserError, match=r"cannot be exported to ONNX \(it uses sort\): export it as a .jax file"):
        model(package, lambda x: [jnp.sort(x)], {"x": ((3,), np.float32)}, ["y"], {})


def loop(x):
    """A scan of three steps, backwards."""
    carry, rows = jax.lax.scan(lambda c, i: (c * i + x, c.sum()), x, jnp.arange(1.0, 4.0), reverse=True)
    return carry + rows


@pytest.mark.parametrize(
    "function",
    [
        loop,
        lambda x: jnp.log1p(jnp.abs(x)) + jnp.expm1(x) + jax.lax.rsqrt(x**2 + 1) + x**3,
        lambda x: jnp.where(x > 0, jnp.clip(x, -0.5, 0.5), jax.nn.sigmoid(x)) * (x != x[0]),
        lambda x: jnp.outer(x, x).ravel() @ jnp.ones((9, 2)) + jnp.stack([x @ x, x[-1]]),
        lambda x: jax.nn.softmax(x) - x.mean() + x[::-1],
        lambda x: (jnp.stack([x, 2 * x]) @ (jnp.arange(6.0).reshape(3, 2) + 1)).ravel(),  # a layer for each row
        lambda x: jnp.tensordot(jnp.ones((2, 4)), jnp.outer(jnp.arange(4.0), x), 1).ravel(),
    ],
)
def test_operations_are_what_they_are_in_jax(function):
    package, batched = pytest.importorskip("onnx"), jax.vmap(function)
    content = model(package, lambda x: [batched(x)], {"x": ((3,), np.float32)}, ["y"], {})
    x = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    np.testing.assert_allclose(session_of(content).run(None, {"x": x})[0], batched(x), rtol=1e-5, atol=1e-5)
