"""A training from beginning to end, as a user starts it: what it leaves, says and survives, where it starts."""

import dataclasses
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

import inputs
from beliefrl import Options, Run, UserError, agents, resume, tasks, train
from beliefrl.analysis.figures import draw_curve
from beliefrl.runs import arrays
from beliefrl.training import initial
from beliefrl.training.schedule import Phase
from worlds import saved, tiny

TRAIN = "train vrm pendulum-v"
SMALL = inputs.SMALL | {"step_start_rl": 20, "train_times_fivrm": 5, "seq_len": 8}
OPTIONS = {"steps": 60, "seeds": 2, "seed": 0, "eval_every": 30, "eval_episodes": 2}


def flags(settings):
    """Settings as they are given on the command line."""
    words = []
    for name, value in settings.items():
        words += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else (value,))]
    return words


def program(*argv):
    return [sys.executable, "-m", "beliefrl.cli", *map(str, argv)]


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A folder that all workers of pytest share."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


def output(*command):
    """What a program prints; it must end well, and complain of nothing."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.fixture(scope="module")
def trained(shared):
    """The folder of a finished training, and what it printed; made once where several workers want it."""
    folder = shared / "trained"
    printout = folder.with_suffix(".txt")
    try:
        folder.with_suffix(".lock").touch(exist_ok=False)
    except FileExistsError:
        wait_for(printout.exists)
    else:
        printed = "The training failed."
        try:
            printed = output(*program(*TRAIN.split(), *flags(OPTIONS | SMALL), "--out", folder))
        finally:
            printout.with_suffix(".part").write_text(printed)
            printout.with_suffix(".part").rename(printout)
    return folder, printout.read_text()


def wait_for(happened, seconds=400):
    """Wait until something has happened."""
    until = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < until
        time.sleep(0.1)


def rows(folder, seed, kind):
    return list(Run(folder).rows(seed, kind))


@pytest.mark.slow
def test_a_training_leaves_what_the_documentation_says(trained):
    folder, _ = trained
    files = {"config.json", "metrics", "tensorboard", "checkpoints", "agent.safetensors", "results.json", "curve.png"}
    files |= {"best.safetensors", "lock"}
    assert {path.name for path in folder.iterdir()} == files
    config = Run(folder).config
    assert (config["agent"], config["task"]) == ("vrm", "pendulum-v")
    assert agents.make("vrm", **SMALL) == agents.make(
        "vrm", **{k: tuple(v) if isinstance(v, list) else v for k, v in config["hyperparameters"].items()}
    )
    assert OPTIONS.items() <= config["options"].items()
    assert {"versions", "device", "git_commit", "command", "started"} <= set(config)
    for seed in range(2):
        (events,) = (folder / "tensorboard" / f"seed-{seed}").iterdir()
        assert events.stat().st_size > 500
        assert [row["step"] for row in rows(folder, seed, "pretrain")] == [5]
        assert all(np.isfinite(row["loss_q"]) for row in rows(folder, seed, "update"))
    assert rows(folder, 0, "update") != rows(folder, 1, "update")


@pytest.mark.slow
def test_a_training_is_evaluated_in_both_modes(trained):
    folder, printed = trained
    for seed in range(2):
        evaluations = rows(folder, seed, "evaluation")
        assert [row["step"] for row in evaluations] == [30, 60]
        assert all(len(row[mode]) == 2 for row in evaluations for mode in ("sampled", "mode"))
    results = Run(folder).results()
    for mode in ("sampled", "mode"):
        last = [rows(folder, seed, "evaluation")[-1][mode] for seed in range(2)]
        np.testing.assert_allclose(results[mode]["seeds"], np.mean(last, axis=1), rtol=1e-6)
    table = printed[printed.index("vrm on pendulum-v after 60 steps") :]
    (means,) = (line for line in table.splitlines() if "mean ± S.E.M." in line)
    both = [f"{results[mode]['mean']:.1f} ± {results[mode]['sem']:.1f}" for mode in ("sampled", "mode")]
    assert re.findall(r"-[\d.]+ ± [\d.]+", means) == both
    assert both[0] != both[1]
    assert "saved in" in table.splitlines()[-2] + table.splitlines()[-1]


@pytest.mark.slow
def test_evaluate_prints_one_object_and_the_same_for_the_same_seed(trained):
    folder, _ = trained
    command = program("evaluate", folder, "--episodes", 3, "--json")
    first, again, other = output(*command), output(*command), output(*command, "--seed", "1")
    assert first == again
    assert first != other
    assert first.count("\n") == 1
    result = json.loads(first)
    assert set(result) == {"episodes", "diverged", "sampled", "mode"}
    assert result["episodes"] == 3
    for mode in ("sampled", "mode"):
        assert set(result[mode]) == {"mean", "sem", "seeds", "returns", "lengths", "success", "seeds_success"}
        assert len(result[mode]["seeds"]) == 2
        assert result[mode]["success"] is None


@pytest.mark.slow
def test_python_gives_the_metrics_of_the_command_line(trained, tmp_path):
    folder, _ = trained
    script = f"""
import beliefrl
agent = beliefrl.make_agent("vrm", **{SMALL})
task, out = beliefrl.make_task("pendulum-v"), {str(tmp_path / "run")!r}
run = beliefrl.train(agent, task, out, progress=False, **{OPTIONS})
assert beliefrl.evaluate(run, episodes=1, progress=False)["episodes"] == 1
"""
    assert output(sys.executable, "-c", script) == ""
    for seed in range(2):
        name = pathlib.Path("metrics") / f"seed-{seed}.jsonl"
        assert (tmp_path / "run" / name).read_text() == (folder / name).read_text()


@pytest.mark.nightly
def test_a_killed_training_can_be_evaluated_and_success_is_reported(tmp_path):
    folder = tmp_path / "run"
    options = OPTIONS | {"steps": 1_000_000, "seeds": 1, "eval_every": 50}
    command = program("train", "vrm", "target-reaching", *flags(options | SMALL), "--out", folder)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        log = folder / "metrics" / "seed-0.jsonl"
        try:
            wait_for(lambda: process.poll() is not None or (log.exists() and len(rows(folder, 0, "update")) > 5))
        finally:
            process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert len(rows(folder, 0, "evaluation")) >= 2
    assert "success" in output(*program("evaluate", folder, "--episodes", 1))
    assert json.loads(output(*program("evaluate", folder, "--episodes", 2, "--json")))["mode"]["success"] in (0, 0.5, 1)
    assert draw_curve(Run(folder)).stat().st_size > 0


@pytest.mark.slow
def test_ctrl_c_ends_with_one_sentence(tmp_path):
    settings = SMALL | {"step_start_rl": 400_000}
    command = program(*TRAIN.split(), "--steps", 400_000, "--seeds", 1, *flags(settings), "--out", tmp_path / "run")
    # A shell's background job ignores SIGINT, and so would what is started from it.
    listening = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from beliefrl.cli import main; main()"
    )
    command = [command[0], "-c", listening, *command[command.index("train") :]]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            for line in process.stdout:
                if line.endswith(" exploring\n"):
                    break
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 130
    assert err.startswith("beliefrl: stopped")
    assert err.count("\n") == 1


# Agents learn a task, from the command to the last evaluation, with their default settings.
#
# VRM takes five minutes to its first solved task; what it reaches is in docs/results, and `test_ablations` has it learn
# small worlds that need memory.

STEPS, ENOUGH = 4_000, -300  # a return that says that the pendulum was swung up and held


@pytest.mark.nightly
@pytest.mark.parametrize("agent", ["predictive-sac", "sac-mlp"])
def test_it_learns(agent, tmp_path):
    run = tmp_path / "run"
    options = ["--steps", STEPS, "--eval-every", STEPS, "--eval-episodes", 20, "--out", run]
    command = [sys.executable, "-m", "beliefrl.cli", "train", agent, "pendulum", *map(str, options)]
    environment = {name: value for name, value in os.environ.items() if name != "JAX_DISABLE_MOST_OPTIMIZATIONS"}
    subprocess.run(command, check=True, timeout=1500, env=environment)
    assert json.loads((run / "results.json").read_text())["sampled"]["mean"] > ENOUGH


# A training that starts from the networks of another run.

TASK = tasks.make("pendulum-v")
AGENT = tiny("sac-mlp", step_start_rl=20, batch_size=8, pretrain_updates=5)


@pytest.fixture
def source(tmp_path):
    """A run of the seeds 4 and 5."""
    return saved(tmp_path / "source", "sac-mlp", TASK, seeds=2)


def test_a_seed_starts_from_its_number_and_others_in_turn(source):
    networks, origin = initial.taken(source, Options(seed=3, seeds=4), AGENT, TASK.spec)
    there = arrays.load(source.agents())
    for name, array in networks.items():
        np.testing.assert_array_equal(array, there[name][[1, 0, 1, 0]])
    assert {seed: found["seed"] for seed, found in origin["seeds"].items()} == {3: 5, 4: 4, 5: 5, 6: 4}
    assert (origin["run"], origin["agent"], origin["task"]) == (str(source.folder), "sac-mlp", "pendulum-v")


@pytest.mark.parametrize(
    ("agent", "task", "phrase"),
    [
        (AGENT, "pendulum", r"weight has the shape \(8, 1\), this training's has the shape \(8, 3\); the networks"),
        (tiny("sac-lstm"), "pendulum-v", r"lstm\.\S+ has no such array, this training's has the shape"),
        (tiny("sac-mlp", standardise=True), "pendulum-v", r"scale\.mean has no such array, this training's has"),
    ],
)
def test_other_sizes_are_one_sentence_and_no_folder(source, tmp_path, agent, task, phrase):
    with pytest.raises(UserError, match=phrase):
        train(agent, task, tmp_path / "run", init_from=source)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("recorded", [{"normalise_critics": False}, {}])  # the second is from before the option
def test_other_layers_are_one_sentence_and_no_folder(tmp_path, recorded):
    source = saved(tmp_path / "source", "predictive-sac", TASK)
    config = json.loads((source.folder / "config.json").read_text())
    assert config["hyperparameters"].pop("normalise_critics")
    config["hyperparameters"] |= recorded
    (source.folder / "config.json").write_text(json.dumps(config))
    initial.taken(Run(source.folder), Options(), tiny("predictive-sac", normalise_critics=False), TASK.spec)
    with pytest.raises(UserError, match=r"was trained with normalise_critics=False, not True"):
        train(tiny("predictive-sac"), TASK, source.folder, resume=True, **source.config["options"])
    with pytest.raises(UserError, match="normalise_critics=False, and this training has True; set normalise_critics=F"):
        train(tiny("predictive-sac"), TASK, tmp_path / "run", init_from=source)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("name", "before", "now", "as_initial"),
    [
        ("critic_likelihood", 0.0, "0.1", r"=0.0, and this training has 0.1; set critic_likelihood=0.0"),
        ("observation_memory", (), r"\[4.0, 32.0\]", r"=\[\], and this training has \[4.0, 32.0\]; set observation_m"),
    ],
)
def test_a_run_from_before_an_option_is_not_continued_with_it(tmp_path, name, before, now, as_initial):
    old = tiny("predictive-sac", **{name: before})
    source = saved(tmp_path / "source", "predictive-sac", TASK, agent=old)
    config = json.loads((source.folder / "config.json").read_text())
    assert not config["hyperparameters"].pop(name)
    (source.folder / "config.json").write_text(json.dumps(config))
    initial.taken(Run(source.folder), Options(), old, TASK.spec)
    with pytest.raises(UserError, match=rf"was trained with {name}=\S+, not {now}"):
        train(tiny("predictive-sac"), TASK, source.folder, resume=True, **source.config["options"])
    with pytest.raises(UserError, match=as_initial):
        train(tiny("predictive-sac"), TASK, tmp_path / "run", init_from=source)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["reward_memory", "observation_memory"])
def test_other_time_constants_are_one_sentence_though_all_shapes_are_equal(tmp_path, name):
    source = saved(tmp_path / "source", "predictive-sac", TASK, agent=tiny("predictive-sac", **{name: (2.0, 5.0)}))
    with pytest.raises(UserError, match=rf"{name}=\[2.0, 5.0\], and this training has \[4.0, 32.0\]; set {name}="):
        train(tiny("predictive-sac", **{name: (4.0, 32.0)}), TASK, tmp_path / "run", init_from=source)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("name", "setting"), [("vrm", "deterministic"), ("sac-lstm", "perceive_action"), ("sac-lstm", "perceive_reward")]
)
def test_other_meanings_of_equal_arrays_are_one_sentence(tmp_path, name, setting):
    other = {"perceive_action": "perceive_reward", "perceive_reward": "perceive_action"}.get(setting)
    source = saved(tmp_path / "source", name, TASK, agent=tiny(name, **{setting: True}))
    with pytest.raises(UserError, match=r"trained with \S+=\S+, and this training has \S+; set \S+="):
        train(tiny(name, **({other: True} if other else {})), TASK, tmp_path / "run", init_from=source)


@dataclasses.dataclass(frozen=True)
class Flipped(type(AGENT)):
    """An agent of a user's whose settings have no arrays."""

    flipped: bool = False
    scales: tuple[float, ...] = ()
    network_settings = ("flipped", "scales")


@pytest.mark.parametrize(
    ("before", "now", "phrase"),
    [
        ({"flipped": True}, {}, "flipped=True, and this training has False; set flipped=True"),
        ({}, {"scales": (1.0,)}, r"scales=\[\], and this training has \[1.0\]"),
        ({"scales": (1.0,)}, {"scales": (2.0,)}, r"scales=\[1.0\], and this training has \[2.0\]"),
    ],
)
def test_an_agent_of_ones_own_names_what_must_agree(tmp_path, before, now, phrase):
    old, new = (Flipped(**{**vars(AGENT), **changes}) for changes in (before, now))
    source = saved(tmp_path / "source", "mine:Flipped", TASK, agent=old)
    for name in {"flipped", "scales"} - before.keys():  # a run from before a setting had its default
        del source.config["hyperparameters"][name]
    (source.folder / "config.json").write_text(json.dumps(source.config))
    initial.taken(Run(source.folder), Options(), old, TASK.spec)
    with pytest.raises(UserError, match=phrase):
        initial.taken(Run(source.folder), Options(), new, TASK.spec)


@pytest.mark.parametrize("envs", [1, 16])
def test_agents_that_were_not_pretrained_are_refused(tmp_path, envs):
    agent = tiny("predictive-sac")
    source = saved(tmp_path / "source", "predictive-sac", TASK, agent=agent)
    source.config["options"]["envs"] = envs
    (source.folder / "config.json").write_text(json.dumps(source.config))
    early = -(-agent.step_start_rl // envs) * envs
    late = early + 1
    options = Options(seed=4)
    log = source.folder / "metrics" / "seed-4.jsonl"
    log.write_text(json.dumps({"kind": "evaluation", "step": early, "sampled": [-1.0], "mode": [-1.0]}) + "\n")
    with pytest.raises(UserError, match=rf"its agent was saved at step {early:,}, before the pre-training"):
        initial.taken(Run(source.folder), options, agent, TASK.spec)
    log.write_text(log.read_text().replace(f'"step": {early}', f'"step": {late}'))
    initial.taken(Run(source.folder), options, agent, TASK.spec)


@pytest.mark.slow
def test_a_training_starts_there_without_pretraining_and_needs_the_other_run_no_more(source, tmp_path):
    networks = arrays.load(source.agents())
    states, phases = [], []

    def watch(event):
        phases.append(event.phase)
        if event.evaluation is not None:
            states.append(arrays.copied(event.states))

    options = {"steps": 25, "eval_every": 20, "eval_episodes": 1, "seed": 4, "seeds": 2}
    run = train(AGENT, TASK, tmp_path / "run", watch, init_from=source.folder, **options)
    assert not {Phase.PRETRAINING, Phase.COMPILING_PRETRAINING} & set(phases)
    learned = run.folder / "agent.safetensors"
    before, end = learned.read_bytes(), states[-1]
    for name, array in states[0].items():
        np.testing.assert_array_equal(array, networks[name])
    assert any(not np.array_equal(end[name], array) for name, array in states[0].items())
    assert Run(run.folder).config["initial"]["seeds"]["5"] == {"seed": 5}

    shutil.rmtree(source.folder)  # and as if it was killed before its first checkpoint
    shutil.rmtree(run.folder / "checkpoints")
    for name in ("results.json", "agent.safetensors", "best.safetensors"):
        (run.folder / name).unlink()
    resume(run)
    assert learned.read_bytes() == before


def test_optimisers_start_anew(source):
    keys = jax.random.split(jax.random.key(1), 2)
    states = jax.vmap(lambda key: AGENT.init(key, TASK.spec))(keys)
    (source.folder / initial.FILE).write_bytes(source.agents().read_bytes())
    started = initial.started_states(source.folder, AGENT, states)
    jax.tree.map(np.testing.assert_array_equal, started.controller_optimiser, states.controller_optimiser)
    assert jax.tree.structure(started) == jax.tree.structure(states)


def test_an_agent_with_averaged_weights_starts_from_them(tmp_path):
    source, agent = saved(tmp_path / "source", "predictive-sac", TASK), tiny("predictive-sac")
    networks, _ = initial.taken(source, Options(), agent, TASK.spec)
    initial.write(tmp_path, {initial.FILE: networks})
    states = jax.vmap(lambda key: agent.init(key, TASK.spec))(jax.random.split(jax.random.key(9), 1))
    started = agent.networks(initial.started_states(tmp_path, agent, states))
    there = {jax.tree_util.keystr(where): leaf for where, leaf in jax.tree_util.tree_leaves_with_path(started)}
    assert there.keys() == networks.keys()
    saved_there = arrays.load(source.agents())
    for name, array in there.items():
        np.testing.assert_array_equal(array, saved_there[name])
