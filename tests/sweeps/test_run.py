"""The loop of a sweep, with fake trainings that end at once, and the command line of `beliefrl sweep`."""

import json
import os
import signal

import pytest

from beliefrl import cli, sweep
from beliefrl.errors import UserError
from beliefrl.runs.folder import locked
from beliefrl.sweeps import run as runs
from beliefrl.sweeps import sources
from beliefrl.sweeps.experiments import Experiment, grid
from beliefrl.training.stop import Stopped
from inputs import Places

TWO = grid(["vrm"], ["pendulum", "cartpole"], seeds=2, steps=10)


class Pretence(Places):
    """Fake trainings that end at once: finished, or failed if their name says so."""

    fails = ""
    started = []
    most = 0

    def start(self, training):
        assert self.room > 0
        self.running[training.name] = training
        Pretence.started.append(training.name)
        Pretence.most = max(Pretence.most, len(self.running))

    def ended(self):
        codes = {}
        for name, training in self.running.items():
            failed = self.fails and self.fails in name
            (self.folder / "logs" / f"{name}.log").write_text("beliefrl: it broke.\n" if failed else "")
            if not failed:
                self.finish(training)
            codes[name] = 2 if failed else 0
        self.running = {}
        return codes

    def finish(self, training):
        folder = self.folder / training.name
        folder.mkdir(exist_ok=True)
        rest = {"hyperparameters": {}, "task": "", "constants": {}, "options": {"seed": 0, "seeds": 1}}
        (folder / "config.json").write_text(json.dumps({"agent": "vrm", **rest}))
        mode = {"mean": 0.0, "sem": None, "seeds": [0.0], "success": None, "seeds_success": None}
        results = {"step": training.steps, "sampled": mode, "mode": mode}
        (folder / "results.json").write_text(json.dumps(results))

    def stop(self):
        self.running = {}


@pytest.fixture(autouse=True)
def pretend(monkeypatch):
    monkeypatch.setattr(runs.places, "Local", Pretence)
    monkeypatch.setattr(runs.places, "slots", lambda workers: ["0", "1", "2"][:workers])
    monkeypatch.setattr(runs, "LOOK_EVERY", 0.0)
    monkeypatch.setattr(Pretence, "fails", "")
    monkeypatch.setattr(Pretence, "started", [])
    monkeypatch.setattr(Pretence, "most", 0)


def test_everything_is_done_as_many_at_a_time_as_there_is_room(tmp_path):
    status = sweep(TWO, tmp_path, workers=3)
    assert len(status.finished) == 4
    assert Pretence.most == 3
    assert Pretence.started[:2] == ["vrm-pendulum-seed0", "vrm-cartpole-seed0"]


def test_on_gpus_all_seeds_of_an_experiment_share_a_program(tmp_path, monkeypatch):
    monkeypatch.setattr(Pretence, "has_gpus", True)
    sweep(TWO, tmp_path)
    assert Pretence.started == ["vrm-pendulum-seed0to1", "vrm-cartpole-seed0to1"]


def test_what_is_finished_is_not_done_again(tmp_path):
    sweep(TWO, tmp_path)
    Pretence.started.clear()
    more = grid(["vrm"], ["pendulum", "cartpole"], seeds=3, steps=10)
    assert len(sweep(more, tmp_path).finished) == 6
    assert Pretence.started == ["vrm-pendulum-seed2", "vrm-cartpole-seed2"]


def test_a_sweep_shows_its_trainings_unless_it_is_asked_not_to(tmp_path, capsys):
    sweep(TWO, tmp_path / "shown", workers=3)
    lines = capsys.readouterr().out.splitlines()
    assert "4 trainings, " in lines[0]
    assert any("finished: vrm-" in line for line in lines)
    assert f"4 of 4 trainings finished in {tmp_path / 'shown'}" in lines[-1]
    seen = []
    sweep(TWO, tmp_path / "silent", progress=False, report=seen.append)
    assert capsys.readouterr() == ("", "")
    assert len(seen[-1].finished) == 4


def test_a_finished_sweep_says_so(tmp_path, capsys):
    sweep(TWO, tmp_path, progress=False)
    seen = []
    sweep(TWO, tmp_path, report=seen.append)
    first, last = capsys.readouterr().out.splitlines()
    assert first.endswith("4 trainings, 4 of them finished already")
    assert f"4 of 4 trainings finished in {tmp_path}" in last
    assert len(seen) == 1


def test_nothing_is_started_where_a_cluster_has_shrunk(tmp_path, monkeypatch):
    shrunk, ended = ["at the first look"], Pretence.ended
    monkeypatch.setattr(Pretence, "room", property(lambda self: -1 if shrunk else 1 - len(self.running)))
    monkeypatch.setattr(Pretence, "ended", lambda self: (shrunk.clear(), ended(self))[1])
    assert len(sweep(TWO, tmp_path).finished) == 4


def test_a_training_that_still_ends_is_waited_for_and_the_others_begin(tmp_path, capsys):
    """After a kill of the sweep its trainings take a while to write their checkpoints."""
    name = "vrm-pendulum-seed0"
    (tmp_path / name).mkdir()
    there = locked(tmp_path / name, "is being trained")

    def end(status):
        if len(status.finished) == 3:
            there.close()

    sweep(TWO, tmp_path, report=end)
    assert Pretence.started[3:] == [name]
    assert capsys.readouterr().out.count(f"waits: {name}, which another process still trains") == 1


def test_an_error_of_a_report_is_not_one_of_the_folder(tmp_path):
    def report(status):
        raise FileNotFoundError(2, "No such file", "mine.txt")

    with pytest.raises(FileNotFoundError, match=r"mine\.txt"):
        sweep(TWO, tmp_path, report=report)


def test_a_sweep_can_be_made_longer(tmp_path):
    sweep(TWO, tmp_path)
    Pretence.started.clear()
    sweep(grid(["vrm"], ["pendulum"], seeds=1, steps=20), tmp_path)
    assert Pretence.started == ["vrm-pendulum-seed0"]


def test_a_failure_is_reported_and_the_others_continue(tmp_path, monkeypatch):
    monkeypatch.setattr(Pretence, "fails", "pendulum-seed0")
    with pytest.raises(UserError, match=r"1 of 4 trainings failed, such as vrm-pendulum-seed0 \(it broke\)"):
        sweep(TWO, tmp_path)
    assert len(Pretence.started) == 4
    Pretence.started.clear()
    monkeypatch.setattr(Pretence, "fails", "")
    sweep([], tmp_path)  # the trainings are read from the folder
    assert Pretence.started == ["vrm-pendulum-seed0"]


def test_a_sweep_that_is_stopped_says_how_to_go_on(tmp_path, capsys):
    def stop(status):
        if len(status.finished) == 2:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Stopped, match=r"stopped with 2 of 4 trainings finished; `beliefrl sweep --out") as stopped:
        sweep(TWO, tmp_path, workers=2, report=stop)
    assert stopped.value.exit_code == 130
    assert "trainings finished in" not in capsys.readouterr().out  # the count is only in the message
    assert len(sweep([], tmp_path).finished) == 4
    assert len(Pretence.started) == 4


def test_a_folder_with_a_space_is_quoted_in_commands(tmp_path, capsys):
    folder = tmp_path / "my sweep"
    with pytest.raises(Stopped, match=r"`beliefrl sweep --out '.*my sweep'` continues"):
        sweep(TWO, folder, workers=1, report=lambda status: os.kill(os.getpid(), signal.SIGINT))
    sweep(TWO, folder)
    assert f"`beliefrl report '{folder}' -o report.html` shows them" in capsys.readouterr().out


def test_trainings_that_finish_while_they_are_stopped_count_as_finished(tmp_path, monkeypatch):
    def finish_all(self):
        for training in self.running.values():
            self.finish(training)
        self.running = {}

    monkeypatch.setattr(Pretence, "ended", lambda self: {})
    monkeypatch.setattr(Pretence, "stop", finish_all)
    with pytest.raises(Stopped, match=r"stopped with 2 of 4 trainings finished"):
        sweep(TWO, tmp_path, workers=2, report=lambda status: os.kill(os.getpid(), signal.SIGINT))


def test_a_sweep_that_cannot_be_planned_closes_its_launcher(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    closed = []
    monkeypatch.setattr(runs.sources, "write", full)
    monkeypatch.setattr(Pretence, "stop", lambda self: closed.append(self))
    with pytest.raises(UserError, match=r"cannot be written \(No space left on device\): fix that, then the same"):
        sweep(TWO, tmp_path)
    assert len(closed) == 1


def test_two_processes_cannot_run_one_sweep(tmp_path):
    def again(status):
        with pytest.raises(UserError, match="is in use by process"):
            sweep(TWO, tmp_path)

    sweep(TWO, tmp_path, report=again)


def test_nothing_is_made_where_a_name_is_wrong(tmp_path):
    with pytest.raises(UserError, match="no agent"):
        sweep([Experiment("vmr", "pendulum")], tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be made"):
        sweep(TWO, tmp_path / "file" / "sweep")


@pytest.mark.parametrize(
    ("log", "code", "why"),
    [
        ("step 1\nbeliefrl: It broke: mend it.\n", 2, "It broke: mend it."),
        ("beliefrl: It broke: mend it.\n", -9, "It broke: mend it."),
        ("Traceback\n  line\nValueError: odd\n", 1, "ValueError: odd"),
        ("", 1, "it ended with code 1 and printed nothing"),
        ("step 1\n", -9, "it was killed by SIGKILL (often too little memory: give fewer --workers)"),
        ("step 1\n", -11, "it was killed by SIGSEGV"),
        ("", -99, "it was killed by signal 99"),
    ],
)
def test_the_reason_of_a_failure_is_the_last_thing_that_was_said_or_a_signal(tmp_path, log, code, why):
    (tmp_path / "log").write_text(log)
    assert runs.reason(tmp_path / "log", code) == why


# The command line of `beliefrl sweep`.


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """The arguments of `sweep`, which is replaced and runs nothing."""
    given = []

    def sweep(experiments, folder, **options):
        given.append((experiments, folder, options))

    monkeypatch.setattr(runs, "sweep", sweep)
    monkeypatch.chdir(tmp_path)
    return given


def experiments(asked, line):
    cli.main(f"sweep {line}".split())
    return asked[-1][0]


def test_agents_tasks_and_seeds(asked):
    made = experiments(asked, "--agents vrm slac --tasks pendulum --seeds 3 --seed 4 --steps 70")
    assert [(each.agent, each.task, tuple(each.seeds), each.settings) for each in made] == [
        ("vrm", "pendulum", (4, 5, 6), {"steps": 70}),
        ("slac", "pendulum", (4, 5, 6), {"steps": 70}),
    ]
    assert len(experiments(asked, "--agents vrm --tasks pendulum")[0].seeds) == 5


def test_every_combination_of_settings(asked):
    made = experiments(asked, "--agents vrm --tasks pendulum --set lr-model=4e-4,8e-4 policy_layers=[8,8] models=keep")
    assert [each.settings for each in made] == [
        {"lr_model": rate, "policy_layers": [8, 8], "models": "keep"} for rate in (4e-4, 8e-4)
    ]


def test_a_trial_has_two_seeds_and_a_fraction_of_the_steps(asked):
    made = experiments(asked, "--preset classic --scale 0.1")
    assert len(made) == 24
    assert {each.settings["steps"] for each in made} == {2000, 3000}
    assert all(len(each.seeds) == 2 and each.settings["step_start_rl"] == 100 for each in made)
    assert len(experiments(asked, "--preset classic --scale 0.1 --seeds 4")[0].seeds) == 4
    whole = experiments(asked, "--preset classic")
    assert {tuple(each.settings) for each in whole} == {("steps",)}
    assert {len(each.seeds) for each in whole} == {5}


def test_a_preset_has_a_folder_of_its_own_and_what_is_timed_is_alone(asked):
    experiments(asked, "--preset scalability --tasks pendulum")
    _, folder, options = asked[-1]
    assert str(folder) == "runs/sweep-scalability"
    assert options == {"workers": 0, "seeds_per_run": None, "ray": None}
    experiments(asked, "--preset memory --workers 3 --seeds-per-run 2 --ray auto --out mine")
    _, folder, options = asked[-1]
    assert str(folder) == "mine"
    assert options == {"workers": 3, "seeds_per_run": 2, "ray": "auto"}


def test_a_file_and_the_command_line_go_together(asked, tmp_path):
    lines = ("import beliefrl", "experiments = beliefrl.grid(['vrm'], ['pendulum'], seeds=9, gamma=0.9)")
    (tmp_path / "mine.py").write_text("\n".join(lines))
    (made,) = experiments(asked, "mine.py --steps 40")
    assert (len(made.seeds), made.settings) == (9, {"gamma": 0.9, "steps": 40})
    (made,) = experiments(asked, "mine.py --seeds 2")
    assert len(made.seeds) == 2


def test_the_first_seed_can_be_given_alone(asked, tmp_path):
    for preset, count in (("memory", 5), ("scalability", 1)):
        made = experiments(asked, f"--preset {preset} --seed 7")
        assert {tuple(each.seeds) for each in made} == {tuple(range(7, 7 + count))}
    usual, *other = experiments(asked, "--preset sensitivity --tasks pendulum --seed 3")
    assert usual.seeds == tuple(range(3, 23))
    for each in other:  # the settings are still those that are drawn for the seed
        assert sources.drawn(each.seeds[0]).items() <= each.settings.items()
    lines = (
        "import beliefrl",
        "experiments = [beliefrl.Experiment('vrm', 'pendulum', seeds=s) for s in ([4, 2], [3])]",
    )
    (tmp_path / "mine.py").write_text("\n".join(lines))
    for line, seeds in (("", [[4, 2], [3]]), ("--seed 0", [[2, 0], [1]]), ("--seed 9 --seeds 2", [[9, 10], [9, 10]])):
        assert [list(each.seeds) for each in experiments(asked, f"mine.py {line}")] == seeds


def test_other_options_of_a_training_that_has_begun_are_refused_and_not_kept(tmp_path):
    sweep(TWO, tmp_path)
    plan = (tmp_path / "sweep.json").read_text()
    other = grid(["vrm"], ["pendulum", "cartpole"], seeds=2, steps=20, eval_episodes=50)
    with pytest.raises(
        UserError, match="was trained with eval_episodes=5, not 50: give that value, or choose another --out"
    ):
        sweep(other, tmp_path)
    assert (tmp_path / "sweep.json").read_text() == plan
    assert len(sweep(TWO, tmp_path).finished) == 4
