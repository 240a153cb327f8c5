"""The precision of matrix products: it reaches the compiled programs, is recorded, and holds for all made of a run."""

import json
import re

import jax
import pytest

from beliefrl import evaluate, load, play, resume, tasks, train
from beliefrl.agents.base import SACAgent
from beliefrl.agents.vrm import VRMAgent
from beliefrl.training import phases
from beliefrl.viewing.prediction import predictions
from worlds import saved, tiny

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


@pytest.mark.parametrize("precision", ASKED)
def test_it_reaches_every_phase_and_a_resumed_run_keeps_it(tmp_path, lowered, precision):
    train(AGENT, "pendulum-v", tmp_path / "run", precision=precision, **OPTIONS)
    both = {(ASKED[precision],) * 2}
    assert {name: asked(text) for name, text in lowered.items()} == dict.fromkeys(PHASES, both)
    lowered.clear()
    run = resume(tmp_path / "run", steps=30)
    assert asked(lowered["learn"]) == both
    assert json.loads((run.folder / "config.json").read_text())["options"]["precision"] == precision


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
