"""A training that is stopped, killed or extended goes on, on a CPU to the last bit; what cannot go on says why."""

import errno
import json
import os
import shutil
import signal
import threading
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import agents, evaluate, load, resume, train
from beliefrl.analysis.figures import draw_curve
from beliefrl.analysis.groups import groups, is_finished
from beliefrl.cli import main
from beliefrl.errors import UserError
from beliefrl.runs.arrays import load as load_arrays
from beliefrl.runs.arrays import packed
from beliefrl.runs.best import evaluations
from beliefrl.runs.checkpoint import Checkpoints, _sha256, _signed, listed
from beliefrl.runs.recorder import Recorder
from beliefrl.runs.run import Run
from beliefrl.tasks import make, seen_environment
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import session
from beliefrl.training.schedule import Phase
from beliefrl.training.stop import Stopped
from training.test_host_loop import Late
from worlds import Counting, CountingAgent, saved
from wrong import Endless, Fine, Raising

SIZES = {"policy_layers": (8,), "value_layers": (8,), "batch_size": 8, "standardise": True}
AGENT = agents.make("sac-mlp", step_start_rl=20, pretrain_updates=150, **SIZES)
OPTIONS = {"steps": 240, "seeds": 2, "eval_every": 120, "eval_episodes": 1, "checkpoint_steps": 1}


class Crash(Exception):
    """The machine dies."""


def crash_at(number):
    """A callback that crashes at the event of that number."""
    seen = []

    def report(event):
        seen.append(event)
        if len(seen) == number:
            raise Crash

    return report


def files(folder):
    """The contents of what a run has learned and logged."""
    names = ("agent.safetensors", "best.safetensors", "results.json")
    paths = [*sorted((folder / "metrics").iterdir()), *(folder / name for name in names)]
    return {path.name: path.read_bytes() for path in paths}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A training that nothing happened to, and must not: tests that resume it do so with `copied`."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    events = []
    train(AGENT, "pendulum-v", folder, events.append, **OPTIONS)
    return folder, len(events)


@pytest.fixture
def copied(whole, tmp_path):
    """A copy of this training."""
    return shutil.copytree(whole[0], tmp_path / "copied")


@pytest.mark.parametrize(
    "share", [pytest.param(0.3, marks=pytest.mark.nightly), 0.6, pytest.param(0.99, marks=pytest.mark.nightly)]
)
def test_a_crashed_training_goes_on_to_the_last_bit(whole, tmp_path, share):
    folder, events = whole
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", tmp_path / "run", crash_at(max(int(share * events), 5)), **OPTIONS)
    assert listed(tmp_path / "run")
    resume(tmp_path / "run")
    assert files(tmp_path / "run") == files(folder)


@pytest.mark.nightly
def test_faults_of_the_sensors_go_on_to_the_last_bit(tmp_path):
    task = make("pendulum-v", faults={"noise": 0.1, "flicker": 0.2, "flicker_flag": True, "delay": 2, "sticky": 0.1})
    events = []
    train(AGENT, task, tmp_path / "whole", events.append, **OPTIONS)
    with pytest.raises(Crash):
        train(AGENT, task, tmp_path / "run", crash_at(len(events) - 2), **OPTIONS)
    resume(tmp_path / "run")
    assert files(tmp_path / "run") == files(tmp_path / "whole")


def test_a_checkpoint_of_an_older_version_goes_on(whole, tmp_path):
    """It calls the return of an episode that is going on `total`."""
    folder = tmp_path / "run"
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", folder, crash_at(whole[1] // 2), **OPTIONS)
    for path in listed(folder):
        state = load_arrays(path / "state.safetensors")
        state[".actor.total"] = state.pop(".actor.episode_return")
        content = packed(state)
        (path / "state.safetensors").write_bytes(content)
        manifest = json.loads((path / "manifest.json").read_bytes())["content"]
        manifest["files"]["state.safetensors"] = {"size": len(content), "sha256": _sha256(content)}
        (path / "manifest.json").write_bytes(_signed(manifest))
    resume(folder)
    assert files(folder) == files(whole[0])


LINE = "train sac-mlp pendulum-v --step-start-rl 20 --pretrain-updates 150 --policy-layers 8 --value-layers 8"
LINE += " --batch-size 8 --standardise --steps 240 --seeds 2 --eval-every 120 --eval-episodes 1"
LINE += " --checkpoint-steps 1 --resume --out"


@pytest.mark.parametrize(
    ("command", "left"),
    [
        ("resume", "a log and half a checkpoint"),
        pytest.param("train --resume", "a log", marks=pytest.mark.nightly),
        pytest.param("train --resume", "no config", marks=pytest.mark.nightly),
        pytest.param("train", "a log", marks=pytest.mark.nightly),
        pytest.param("python", "a log", marks=pytest.mark.nightly),
    ],
)
def test_a_training_that_was_killed_before_its_first_checkpoint_begins_again(whole, tmp_path, capsys, command, left):
    folder = tmp_path / "run"
    (folder / "metrics").mkdir(parents=True)
    if left != "no config":
        (folder / "config.json").write_bytes((whole[0] / "config.json").read_bytes())
        (folder / "metrics" / "seed-0.jsonl").write_text('{"step": 20, "kind": "update"}\n')
    if left == "a log and half a checkpoint":
        (folder / "checkpoints" / ".000001-step-10.tmp").mkdir(parents=True)
        (folder / "checkpoints" / "replay").mkdir()
        (folder / "checkpoints" / "replay" / "000001.safetensors").write_bytes(b"half")
    if command == "python":
        resume(folder, callback=lambda event: event.note and print(event.note))
    else:
        lines = {"resume": "resume", "train": LINE.replace("--resume ", ""), "train --resume": LINE}
        main([*lines[command].split(), str(folder)])
    assert files(folder) == files(whole[0])
    is_resumed = left != "no config" and command != "train"
    assert ("there is no checkpoint: begins again from step 0" in capsys.readouterr().out) == is_resumed
    assert len(Run(folder).config.get("resumed", ())) == is_resumed


def test_what_is_no_unfinished_training_is_not_cleared(whole, tmp_path, capsys):
    finished, other = tmp_path / "finished", tmp_path / "other"
    shutil.copytree(whole[0], finished, ignore=shutil.ignore_patterns("checkpoints"))
    (other / "metrics").mkdir(parents=True)
    (other / "metrics" / "thesis.tex").touch()
    for folder, why in ((finished, "has no usable checkpoint left"), (other, "exists already")):
        before = sorted(folder.rglob("*"))
        with pytest.raises(SystemExit):
            main([*LINE.split(), str(folder)])
        assert why in capsys.readouterr().err
        assert sorted(folder.rglob("*")) == before


AGENTS = {"vrm": pytest.mark.slow, **dict.fromkeys(("sac-lstm", "slac", "predictive-sac"), pytest.mark.nightly)}


@pytest.mark.parametrize("name", [pytest.param(name, marks=mark) for name, mark in AGENTS.items()])
def test_every_agent_goes_on_to_the_last_bit(tmp_path, name):
    models = {"train_times_fivrm": 10, "d_size": 8, "z_size": 4, "hidden_size": 8}
    sequences = {"seq_len": 8, "burn_in": 4, "batch_size": 2}
    sizes = {
        "vrm": models | sequences,
        "sac-lstm": {"d_size": 8, "pretrain_updates": 10} | sequences,
        "predictive-sac": {
            "d_size": 8,
            "hidden_size": 8,
            "pretrain_updates": 10,
            "seq_len": 8,
            "observation_memory": (4.0,),
        },
        "slac": {"z1_size": 2, "z2_size": 4, "model_layers": (8,), "batch_size": 2, "pretrain_updates": 10},
    }
    agent = agents.make(name, step_start_rl=20, policy_layers=(8,), value_layers=(8,), **sizes[name])
    events = []
    train(agent, "pendulum-p", tmp_path / "whole", events.append, **OPTIONS)
    with pytest.raises(Crash):
        train(agent, "pendulum-p", tmp_path / "run", crash_at(len(events) - 4), **OPTIONS)
    resume(tmp_path / "run")
    assert files(tmp_path / "run") == files(tmp_path / "whole")


@pytest.mark.slow
def test_train_goes_on_where_it_is_asked_to(whole, tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", folder, crash_at(whole[1] - 4), resume=True, **OPTIONS)
    with pytest.raises(UserError, match=r"exists already: .* in Python out= or resume=True\."):
        train(AGENT, "pendulum-v", folder, **OPTIONS)
    message = (
        r"was trained with seeds=2, not 3: choose another --out, in Python out=\. `beliefrl resume \S+run` continues it"
    )
    with pytest.raises(UserError, match=message):
        train(AGENT, "pendulum-v", folder, resume=True, **OPTIONS | {"seeds": 3})
    for _ in range(2):
        run = train(AGENT, "pendulum-v", folder, resume=True, **OPTIONS)
        assert files(folder) == files(whole[0])
    assert len(run.config["resumed"]) == 2


def test_a_refused_resume_changes_nothing(whole, tmp_path):
    folder, _ = whole
    for task, phrase in (
        (
            make("pendulum-p"),
            "was trained on velocities of the observation, and the given task shows positions: give vel",
        ),
        (make("pendulum-v", mass=2.0), "was trained with constants="),
        (make("pendulum-v", faults={"noise": 0.1}), "was trained with faults=None, not"),
    ):
        config = (folder / "config.json").read_bytes()
        with pytest.raises(UserError, match=phrase):
            resume(folder, steps=240, task=task)
        assert (folder / "config.json").read_bytes() == config
    explored = train(AGENT, "pendulum-v", tmp_path / "run", **OPTIONS | {"steps": 20, "replay_capacity": 30})
    with pytest.raises(UserError, match="replay_capacity=30 is too small"):
        resume(explored, steps=240)
    assert explored.options.steps == 20


def test_a_task_of_ones_own_goes_on_with_other_arguments(tmp_path):
    """A robot may have another port."""

    class Other(Fine):
        pass

    run = train(AGENT, GymnasiumTask(Fine, arguments={"port": 4}), tmp_path / "run", **OPTIONS | {"steps": 60})
    assert resume(run, steps=80, task=GymnasiumTask(Fine, arguments={"port": 5})).options.steps == 80
    with pytest.raises(UserError, match=r"was trained with task=Fine, not .*Other: give that task"):
        resume(run, steps=100, task=Other)


def test_a_class_of_environments_has_the_time_limit_of_the_training(tmp_path):
    run = train(AGENT, GymnasiumTask(Endless, max_steps=10), tmp_path / "run", **OPTIONS | {"steps": 60})
    for mode in ("sampled", "mode"):
        assert evaluate(run, 2, task=Endless, progress=False)[mode]["lengths"] == [[10, 10]] * 2
    resume(run, steps=120, task=Endless)
    assert [row["length"] for row in run.rows(0, "episode")] == [10] * 12


def test_the_recorded_time_limit_is_that_of_the_training(tmp_path):
    options = OPTIONS | {"steps": 20}
    run = train(AGENT, GymnasiumTask(Endless, max_steps=10), tmp_path / "run", **options)
    for task, limit in ((GymnasiumTask(Endless, max_steps=30), "30"), (Endless, "None")):
        with pytest.raises(UserError, match=f"was trained with max_steps=10, not {limit}: choose another --out"):
            train(AGENT, task, run.folder, resume=True, **options)
    run = resume(run, steps=80, task=GymnasiumTask(Endless, max_steps=30))
    assert run.config["max_steps"] == 30
    assert [row["length"] for row in run.rows(0, "episode")] == [10, 10, 30, 30]


def test_episodes_that_never_ended_may_get_a_time_limit(tmp_path, monkeypatch):
    """As the error tells them to."""
    monkeypatch.setattr(seen_environment, "ENDLESS", 25)
    with pytest.raises(UserError, match="the episode has not ended after 25 steps"):
        train(AGENT, Endless, tmp_path / "run", **OPTIONS)
    task = GymnasiumTask(Endless, max_steps=10)
    run = train(AGENT, task, tmp_path / "run", resume=True, **OPTIONS)
    assert run.config["max_steps"] == 10


@pytest.mark.slow
def test_a_finished_training_can_be_made_longer(whole, tmp_path):
    folder, _ = whole
    train(AGENT, "pendulum-v", tmp_path / "run", **OPTIONS | {"steps": 120})
    run = resume(tmp_path / "run", steps=240)
    assert files(run.folder) == files(folder)
    assert run.config["options"]["steps"] == 240
    assert len(run.config["resumed"]) == 1
    with pytest.raises(UserError, match=r"steps=100 is impossible: .* trains for 240, and may only grow"):
        resume(run, steps=100)


def test_resuming_what_is_finished_changes_nothing(copied):
    before = files(copied)
    resume(copied)
    assert files(copied) == before


@pytest.mark.slow
def test_the_log_of_a_resumed_training_has_no_gap_and_no_row_twice(whole, tmp_path):
    """It crashes after the last updates were logged and before they were saved."""
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", tmp_path / "run", crash_at(whole[1] - 2), **OPTIONS)
    logged = {"pretrain": [100, 150], "update": [120, 220, 240], "evaluation": [120, 240]}
    assert [row["step"] for row in Run(tmp_path / "run").rows(0, "update")] == logged["update"]
    run = resume(tmp_path / "run")
    for seed in range(2):
        assert {kind: [row["step"] for row in run.rows(seed, kind)] for kind in logged} == logged


@pytest.mark.parametrize(
    ("due", "steps"),
    [
        ({"checkpoint_steps": 60, "keep_checkpoints": 2}, [120, 180]),
        ({"checkpoint_steps": 0, "checkpoint_minutes": 1.0, "keep_checkpoints": 9}, [20, 120, 180]),
    ],
)
@pytest.mark.slow
def test_checkpoints_are_written_when_they_are_due_and_the_newest_are_kept(tmp_path, monkeypatch, due, steps):
    """A step takes a second. The first checkpoint comes with the end of the pre-training."""
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)

    def report(event):
        clock.now = float(event.step)
        if event.step == 240:
            raise Crash

    monkeypatch.setattr(session, "time", clock)
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", tmp_path / "run", report, **OPTIONS | {"eval_every": 60} | due)
    assert [int(path.name.split("-")[-1]) for path in listed(tmp_path / "run")] == steps


def test_where_the_checkpoints_are_gone_there_is_a_sentence(whole, tmp_path):
    (tmp_path / "run" / "checkpoints" / "damaged-000001-step-20").mkdir(parents=True)
    (tmp_path / "run" / "config.json").write_bytes((whole[0] / "config.json").read_bytes())
    with pytest.raises(UserError, match="has no usable checkpoint left"):
        resume(tmp_path / "run")
    with pytest.raises(UserError, match="There is no run folder"):
        resume(tmp_path / "nowhere")


@pytest.mark.nightly
def test_a_training_that_fails_before_it_saved_anything_blocks_nothing(tmp_path):
    folder = tmp_path / "run"
    for number in (1, 5, 9):  # an event of the making, the exploration and the pre-training
        with pytest.raises(Crash):
            train(AGENT, "pendulum-v", folder, crash_at(number), **OPTIONS | {"checkpoint_steps": 0})
    with pytest.raises(UserError, match="step raised ValueError"):
        train(AGENT, GymnasiumTask(Raising), folder, **OPTIONS)
    run = train(AGENT, GymnasiumTask(Fine), folder, **OPTIONS | {"steps": 20})
    assert run.config["task"] == "Fine"
    with pytest.raises(UserError, match="exists already: choose another --out, or `beliefrl resume"):
        train(AGENT, "pendulum-v", folder, **OPTIONS)


def test_a_run_that_is_being_trained_is_not_touched(copied):
    recorder = Recorder(copied, None)
    try:
        with pytest.raises(UserError, match=f"is being trained by process {os.getpid()} on .+: stop it"):
            resume(copied)
    finally:
        recorder.close()
    resume(copied)


@pytest.mark.nightly
def test_a_log_that_was_cut_is_an_error(whole, tmp_path):
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", tmp_path / "run", crash_at(whole[1] - 2), **OPTIONS)
    (tmp_path / "run" / "metrics" / "seed-1.jsonl").write_text("")
    with pytest.raises(UserError, match=r"seed-1\.jsonl is shorter than when the checkpoint was written"):
        resume(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize(("envs", "saved_at"), [(1, 115), (2, 116)])
def test_an_environment_goes_on_from_the_start_of_an_episode(tmp_path, envs, saved_at):
    """Its checkpoint is from the middle of an episode of ten steps."""
    task, notes, options = GymnasiumTask(Fine, "fine"), [], OPTIONS | {"steps": 230, "eval_every": 115, "envs": envs}

    def report(event):
        if event.step > saved_at:
            raise Crash

    with pytest.raises(Crash):
        train(AGENT, task, tmp_path / "run", report, **options)
    run = resume(tmp_path / "run", task=task, callback=lambda event: notes.append(event.note))
    said = [f"goes on from the checkpoint of step {saved_at}", "a new episode begins: an environment cannot be saved"]
    assert [note for note in notes if note] == said
    assert [row["step"] for row in run.rows(0, "evaluation")] == [saved_at, 230]
    assert {row["length"] for row in run.rows(0, "episode")} == {10}


@pytest.mark.parametrize(
    ("what", "why"),
    [
        ("networks", "its networks are not finite"),
        ("loss_q", "loss_q is not finite"),
    ],
)
@pytest.mark.slow
def test_a_seed_that_diverges_stops_alone(tmp_path, monkeypatch, what, why):
    """The second seed's networks, or a loss of it, are made NaN after step 120."""
    from beliefrl.training import phases

    real = phases.compile_program

    def compiled(*args):
        program = real(*args)

        def learn(seeds, first, cycles):
            seeds, stretch = program.learn(seeds, first, cycles)
            if first >= 120 and what in stretch.metrics:
                stretch.metrics[what] = stretch.metrics[what].at[1].set(jnp.nan)
            elif first >= 120:
                alpha = seeds.state.controller.log_alpha.at[1].set(jnp.nan)
                controller = seeds.state.controller._replace(log_alpha=alpha)
                seeds = seeds._replace(state=seeds.state._replace(controller=controller))
            return seeds, stretch

        return program._replace(learn=learn)

    monkeypatch.setattr(phases, "compile_program", compiled)
    notes = []
    run = train(AGENT, "pendulum-v", tmp_path / "run", lambda event: notes.append(event.note), **OPTIONS)
    said = [note for note in notes if note]
    assert len(said) == 1
    assert said[0].startswith(f"seed 1 diverged by step 220: {why}; its last good checkpoint stays in ")
    assert [row["step"] for row in run.rows(0, "evaluation")] == [120, 240]
    assert [row["step"] for row in run.rows(1, "evaluation")] == [120]
    assert run.results()["mode"]["seeds"][1] is None
    assert run.results()["mode"]["mean"] == run.results()["mode"]["seeds"][0]
    kept = load_arrays(run.folder / "checkpoints" / "kept-for-seed-1" / "state.safetensors")
    assert all(np.isfinite(array).all() for array in kept.values())
    assert np.isfinite(load(run, seed=1).predict(np.zeros(1))[0]).all()  # as it was at 120
    _, means = groups([run])[0].curve("mode")
    np.testing.assert_array_equal(np.isnan(means), [[False, False], [False, True]])
    assert draw_curve(run).exists()
    assert json.loads((run.folder / "results.json").read_text())
    resume(run, steps=260)
    assert [len(list(run.rows(seed, "diverged"))) for seed in range(2)] == [0, 1]


def test_the_first_signal_is_a_checkpoint_and_a_word_how_to_go_on(whole, tmp_path):
    folder, events = whole
    seen = []

    def report(event):
        seen.append(event)
        if len(seen) == events // 2:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Stopped, match=r"stopped at step \d+; `beliefrl resume .*run` goes on from there") as stopped:
        train(AGENT, "pendulum-v", tmp_path / "run", report, **OPTIONS | {"checkpoint_steps": 0})
    assert stopped.value.exit_code == 143
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    resume(tmp_path / "run")
    assert files(tmp_path / "run") == files(folder)


@pytest.mark.slow
def test_a_callback_stops_a_training_that_goes_on_to_the_last_bit(whole, tmp_path):
    notes = []

    def stop(event):
        notes.append(event.note)
        return event.evaluation is not None and np.all(event.evaluation.done)

    run = train(AGENT, "pendulum-v", tmp_path / "run", callback=stop, **OPTIONS | {"checkpoint_steps": 0})
    assert run.results()["step"] == 120
    assert [note for note in notes if note] == [
        f"stopped by the callback at step 120; `beliefrl resume {run.folder}` goes on from there, in Python "
        f"beliefrl.resume({str(run.folder)!r})"
    ]
    assert not is_finished(run)
    resume(run, callback=lambda event: "only True stops it")
    assert files(run.folder) == files(whole[0])


@pytest.mark.parametrize(("line", "patience", "end"), [(28.0, 1, 10), (29.0, 1, 30), (28.0, 2, 20)])
def test_a_training_ends_at_the_evaluation_that_reaches_the_line(tmp_path, line, patience, end):
    """Every return is 28."""
    options = {"steps": 30, "eval_every": 10, "eval_episodes": 1, "stop_at": line, "stop_patience": patience}
    run = train(CountingAgent(step_start_rl=30), Counting(), tmp_path / "run", **options)
    assert run.results()["step"] == end


COUNTED = {"steps": 30, "eval_every": 10, "eval_episodes": 1, "progress": False}  # every return is 28


def without_checkpoints(run):
    shutil.rmtree(run.folder / "checkpoints")
    return Run(run.folder)


def test_a_training_that_reached_its_line_but_wrote_nothing_begins_again(tmp_path):
    """It was killed between its last evaluation and its first checkpoint."""
    agent, task = CountingAgent(step_start_rl=30), Counting()
    run = without_checkpoints(train(agent, task, tmp_path / "run", stop_at=28.0, **COUNTED))
    with pytest.raises(UserError, match="has no usable checkpoint left"):
        resume(run, task=task, agent=agent, progress=False)
    (run.folder / "results.json").unlink()
    assert resume(run, task=task, agent=agent, progress=False).results()["step"] == 10


def test_the_results_of_a_training_whose_environment_fails_are_those_of_its_last_evaluation(tmp_path, capsys):
    with pytest.raises(UserError, match="the battery is empty"):
        train(CountingAgent(step_start_rl=30), Late, tmp_path / "run", **COUNTED)
    assert Run(tmp_path / "run").results()["step"] == 20
    assert (tmp_path / "run" / "curve.png").exists()
    main(["show", str(tmp_path / "run")])
    assert "after 20 steps" in capsys.readouterr().out


def test_a_training_that_begins_again_has_no_results_of_before(tmp_path):
    agent, task = CountingAgent(step_start_rl=30), Counting()
    first = train(agent, task, tmp_path / "run", lambda event: event.evaluation is not None, **COUNTED)
    assert first.results()["step"] == 10

    def end(event):
        if event.phase is Phase.EXPLORING:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Stopped):
        resume(without_checkpoints(first), None, task, end, agent, progress=False)
    assert first.results() is None
    assert (first.folder / "before-1" / "results.json").exists()


@pytest.mark.parametrize("lost", [False, True])
def test_a_resume_on_a_full_disk_is_one_sentence_and_changes_nothing(tmp_path, monkeypatch, lost):
    agent, task = CountingAgent(step_start_rl=30), Counting()
    run = train(agent, task, tmp_path / "run", lambda event: event.evaluation is not None, **COUNTED)
    if lost:
        run = without_checkpoints(run)
    before = (run.folder / "config.json").read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("beliefrl.runs.recorder.write_config", full)
    with pytest.raises(
        UserError, match=r"cannot be written \(No space left on device\): fix that, then `beliefrl resume"
    ):
        resume(run, 40, task, agent=agent, progress=False)
    assert (run.folder / "config.json").read_bytes() == before


@pytest.mark.parametrize(
    ("line", "changes"),
    [
        ("", {}),
        ("--step-timeout same --stop-at same", {}),
        ("--step-timeout None --stop-at None", {"step_timeout": None, "stop_at": None}),
        ("--step-timeout 5", {"step_timeout": 5.0}),
        ("--steps 300 --stop-at -20 --stop-patience 2", {"steps": 300, "stop_at": -20.0, "stop_patience": 2}),
    ],
)
def test_a_resumed_training_gets_the_options_that_change(tmp_path, monkeypatch, line, changes):
    run, asked = saved(tmp_path / "run", "sac-mlp", make("pendulum")), []
    monkeypatch.setattr("beliefrl.training.train._go_on", lambda run, changes, *_: asked.append(changes) or run)
    resume(run, **changes)
    main(["resume", str(run.folder), *line.split()])
    assert asked == [changes, changes]


@pytest.mark.nightly
def test_a_training_ends_where_every_seed_has_reached_the_line(whole, tmp_path):
    first = [np.mean(next(Run(whole[0]).rows(seed, "evaluation"))["sampled"]) for seed in range(2)]
    folder, notes = tmp_path / "run", []
    run = train(AGENT, "pendulum-v", folder, lambda event: notes.append(event.note), **OPTIONS, stop_at=min(first))
    assert run.results()["step"] == 120
    reached = f"ended at step 120, because the return of every seed was at least {min(first):g}"
    assert [note for note in notes if note] == [reached]
    assert is_finished(run)
    before = files(folder)
    resume(folder, callback=lambda event: notes.append(event.note))
    assert notes[-1].startswith(f"this training is finished: it {reached}; `beliefrl resume {folder} --stop-at NUMBER`")
    assert files(folder) == before
    for changes, phrase in (
        ({"stop_at": min(first) - 1}, "has reached"),
        ({"stop_at": None, "stop_patience": 2}, "needs"),
    ):
        with pytest.raises(UserError, match=phrase):
            resume(folder, **changes)
    main(["resume", str(folder), "--stop-at", "None"])
    assert files(folder) == files(whole[0])
    assert (Run(folder).options.stop_at, Run(folder).options.stop_patience) == (None, 1)


def test_trainings_in_other_threads_leave_signals_alone(tmp_path):
    failed = []

    def work():
        try:
            train(AGENT, "pendulum-v", tmp_path / "run", **OPTIONS | {"steps": 20})
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert not failed


@pytest.mark.nightly
def test_constants_that_are_tuples_are_the_same_when_a_run_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    line = "train sac-mlp target-reaching --steps 4 --eval-episodes 1 --constants max_steps=2 --out run --resume"
    for _ in range(2):
        main(line.split())
    with pytest.raises(SystemExit):
        main(line.replace("max_steps=2", "max_steps=2 rewards=[1.0,2.0,3.0]").split())
    assert "run was trained with constants=" in capsys.readouterr().err


def test_a_folder_that_cannot_be_locked_is_one_sentence(whole, tmp_path):
    (tmp_path / "lock").mkdir()
    (tmp_path / "config.json").write_bytes((whole[0] / "config.json").read_bytes())
    with pytest.raises(UserError, match="cannot be written"):
        Recorder(tmp_path, None)


@pytest.mark.parametrize(
    ("line", "phrase"),
    [
        ("resume {whole} --steps 10", "may only grow"),
        ("resume {whole} --steps ten", "--steps must be a whole number, not 'ten'"),
        ("train sac-mlp pendulum-v --out {whole}", "exists already: choose another --out, or `beliefrl resume"),
        ("train sac-mlp pendulum-v --out {whole} --resume", "was trained with"),
        ("train sac-mlp pendulum --out {whole} --resume", "was trained with task=pendulum-v, not pendulum"),
        ("train sac-mlp pendulum --observe velocities --out {whole} --resume", "was trained with seeds=2, not 1"),
        ("train sac-mlp pendulum-v --constants mass=3.5 --out {whole} --resume", "was trained with constants="),
        ("train vrm pendulum-v --out {whole} --resume", "was trained with agent=sac-mlp, not vrm"),
    ],
)
def test_mistakes_about_runs_are_sentences(whole, tmp_path, monkeypatch, capsys, line, phrase):
    folder, _ = whole
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(line.format(whole=folder).split())
    err = capsys.readouterr().err
    assert ended.value.code == 2
    assert phrase in err
    assert err.count("\n") == 1


def test_a_resume_that_finds_no_checkpoint_changes_nothing(whole, tmp_path):
    """Its files may come back, for example those of a copy that has not ended."""
    folder = tmp_path / "run"
    shutil.copytree(whole[0], folder)
    before = (folder / "config.json").read_text()
    (folder / "checkpoints" / "replay").rename(tmp_path / "away")
    with pytest.raises(UserError, match="has no checkpoint to continue from"):
        resume(folder, steps=360)
    assert (folder / "config.json").read_text() == before
    assert is_finished(Run(folder))
    (tmp_path / "away").rename(folder / "checkpoints" / "replay")
    assert Run(resume(folder, steps=260).folder).options.steps == 260


def test_a_seed_that_has_never_had_an_agent_is_not_loaded(tmp_path):
    run = saved(tmp_path / "run", "sac-mlp", make("pendulum-v"), seeds=2)
    path = run.agents()
    arrays = {name: array.copy() for name, array in load_arrays(path).items()}
    for array in (each for each in arrays.values() if each.dtype.kind == "f"):
        array[1] = np.nan
    path.write_bytes(packed(arrays))
    with pytest.raises(UserError, match=r"Seed 5 of .* has diverged before its first evaluation, so it has no agent"):
        load(run, seed=5)
    load(run, seed=4)


def test_a_seed_without_an_agent_has_no_returns_whatever_the_task_makes_of_actions_that_are_nan(tmp_path, capsys):
    """CartPole would count 1,000 steps: no comparison with NaN ends an episode."""
    run = saved(tmp_path / "run", "sac-mlp", make("cartpole", max_steps=20), seeds=2)
    arrays = {name: array.copy() for name, array in load_arrays(run.agents()).items()}
    for array in (each for each in arrays.values() if each.dtype.kind == "f"):
        array[1] = np.nan
    run.agents().write_bytes(packed(arrays))
    with (run.folder / "metrics" / "seed-5.jsonl").open("a") as log:
        log.write(json.dumps({"step": 10, "kind": "diverged", "why": "a loss is not finite"}) + "\n")
    found = evaluate(run, episodes=2, progress=False)
    assert found["diverged"] == [5]
    for mode in ("sampled", "mode"):
        assert found[mode]["seeds"] == [found[mode]["mean"], None]
        assert np.isnan(found[mode]["returns"][1]).all()
    main(["evaluate", str(run.folder), "--episodes", "1"])
    assert "seed 5 diverged by step 10: it has no agent" in capsys.readouterr().out
    for array in (each for each in arrays.values() if each.dtype.kind == "f"):
        array[:] = np.nan
    run.agents().write_bytes(packed(arrays))
    with pytest.raises(UserError, match=r"All seeds of .* diverged before their first evaluation, so it has no agent"):
        evaluate(run, episodes=1, progress=False)


def test_a_run_whose_seeds_have_all_diverged_gets_no_second_try(whole, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(whole[0], folder)
    before = (folder / "config.json").read_text()
    for path in (folder / "metrics").glob("*.jsonl"):
        with path.open("a") as log:
            log.write(json.dumps({"step": 230, "kind": "diverged", "why": "a loss is not finite"}) + "\n")
    with pytest.raises(UserError, match=r"All seeds of .* have diverged: train with other settings, and with another"):
        resume(folder, steps=360)
    assert (folder / "config.json").read_text() == before


def test_a_resume_that_finds_damaged_results_changes_nothing(whole, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(whole[0], folder)
    (folder / "results.json").write_text('{"step": 240}')
    before = (folder / "config.json").read_text()
    with pytest.raises(UserError, match=r"results\.json is damaged"):
        resume(folder, steps=360)
    assert (folder / "config.json").read_text() == before


def test_evaluate_says_of_which_seed_the_agent_is_older(tmp_path, capsys):
    run = saved(tmp_path / "run", "sac-mlp", make("pendulum-v", max_steps=5), seeds=2)
    with (run.folder / "metrics" / "seed-5.jsonl").open("a") as log:
        log.write(json.dumps({"step": 1500, "kind": "diverged", "why": "a loss is not finite"}) + "\n")
    main(["evaluate", str(run.folder), "--episodes", "1"])
    out = capsys.readouterr().out
    assert "seed 5 diverged by step 1,500: its agent is from an evaluation before that" in out
    assert "seed 4 diverged" not in out


def test_a_training_whose_checkpoints_are_gone_begins_again_and_keeps_what_it_had(tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", folder, crash_after_evaluation(), **OPTIONS)
    before = {path.name: path.read_bytes() for path in (*(folder / "metrics").iterdir(), folder / "best.safetensors")}
    shutil.rmtree(folder / "checkpoints")
    notes = []
    run = resume(folder, callback=lambda event: event.note and notes.append(event.note))
    assert any(f"the log and the agents until now are in {folder / 'before-1'}" in note for note in notes)
    aside = {path.name: path.read_bytes() for path in (folder / "before-1").rglob("*") if path.is_file()}
    assert before.items() <= aside.items()
    assert [row["step"] for row in run.rows(0, "evaluation")] == [120, 240]


def crash_after_evaluation():
    """A callback that crashes after the first evaluation."""

    def report(event):
        if event.evaluation is not None:
            raise Crash

    return report


def test_a_signal_before_an_evaluation_is_not_kept_waiting_and_the_results_so_far_are_written(tmp_path):
    def signals(event):
        if event.step > 200 and event.phase is Phase.EVALUATING:
            os.kill(os.getpid(), signal.SIGTERM)

    settings = OPTIONS | {"steps": 239, "eval_every": 120, "checkpoint_steps": 1000}
    with pytest.raises(Stopped, match="stopped at step 2"):
        train(AGENT, "pendulum-v", tmp_path / "run", **settings, callback=signals)
    run = Run(tmp_path / "run")
    assert [row["step"] for row in run.rows(0, "evaluation")] == [120]
    assert run.results()["step"] == 120
    assert [row["step"] for row in resume(run).rows(0, "evaluation")][-1] > 200


def test_a_checkpoint_that_could_not_be_written_is_followed_by_another(tmp_path, monkeypatch):
    fails, write = [True], Checkpoints._write

    def once(self, step, *rest):
        if step == 120 and fails.pop():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(self, step, *rest)

    monkeypatch.setattr(Checkpoints, "_write", once)
    notes = []
    train(
        AGENT, "pendulum-v", tmp_path / "run", **OPTIONS, callback=lambda event: event.note and notes.append(event.note)
    )
    assert any("a checkpoint could not be written (No space left on device)" in note for note in notes)
    assert listed(tmp_path / "run")[-1].name.endswith("-step-240")


def test_a_damaged_best_agent_does_not_end_the_training(tmp_path):
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", tmp_path / "run", crash_after_evaluation(), **OPTIONS)
    (tmp_path / "run" / "best.safetensors").write_bytes(b"half")
    run = resume(tmp_path / "run")
    assert (tmp_path / "run" / "damaged-best.safetensors").read_bytes() == b"half"
    assert None not in evaluations(run.folder, 2)


def test_a_training_goes_on_with_other_options_of_its_recording(tmp_path):
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", tmp_path / "run", crash_after_evaluation(), **OPTIONS)
    run = train(AGENT, "pendulum-v", tmp_path / "run", **OPTIONS | {"keep_checkpoints": 1, "track": ()}, resume=True)
    assert len(listed(run.folder)) == 1
    assert run.options.track == ()
