"""The search for hyperparameters, with fake trainings whose return depends on their settings; no JAX program runs."""

import dataclasses
import json
import math
import os
import pathlib
import signal
import sys

import pytest

from beliefrl import Range, agents, cli, tune
from beliefrl.errors import UserError
from beliefrl.runs import records
from beliefrl.runs.folder import locked
from beliefrl.sweeps import places, ranges, study
from beliefrl.sweeps import tune as tuning
from beliefrl.training.stop import Stopped
from inputs import Places, a_folder

EVERY = 1000
BEST = 3e-4  # the learning rate with the highest return; it is the agent's default


def ends_at(choice):
    """An Optuna trial that always draws the lowest (0) or the highest (1) of a range."""

    class Ends:
        def suggest_categorical(self, name, choices):
            return choices[-choice]

        def suggest_float(self, name, low, high, *, log):
            return (low, high)[choice]

        suggest_int = suggest_float

    return Ends()


@pytest.mark.parametrize("name", agents.AGENTS)
@pytest.mark.parametrize("end", [0, 1])
def test_the_ranges_of_every_agent_are_possible(name, end):
    agent = agents.AGENTS[name]
    found = ranges.chosen(agent, name, {})
    drawn = ranges.draw(ends_at(end), found)
    assert drawn.keys() == type(agent).ranges.keys()
    assert dataclasses.asdict(agents.make(name, **drawn)).items() >= drawn.items()
    own = {field: getattr(agent, field) for field in found}
    assert len(ranges.parameters(found, own)) == len(found)  # the first trial is the agent itself


def test_drawn_numbers_lie_in_their_range_and_have_few_digits():
    given = {"gamma": Range(0.9, 0.99), "lr_actor": Range(1.234567e-4, 2.345678e-4), "d_size": Range(10, 20)}
    found = ranges.chosen(agents.make("vrm"), "vrm", given, only=["gamma", "lr_actor", "d_size"])
    assert [found[name].scale for name in ("gamma", "lr_actor", "d_size")] == ["horizon", "log", "linear"]
    low, high = (ranges.draw(ends_at(end), found) for end in (0, 1))
    assert low == {"gamma": 0.99, "lr_actor": 1.235e-4, "d_size": 10}  # the lowest 1 - gamma
    assert high == {"gamma": 0.9, "lr_actor": 2.345678e-4, "d_size": 20}  # not 2.346e-4
    assert isinstance(low["d_size"], int)


def test_ranges_are_read_from_text():
    assert ranges.from_text("tau", "1e-3..0.5") == Range(1e-3, 0.5)
    assert ranges.from_text("tau", "0.1..0.5:log") == Range(0.1, 0.5, "log")
    assert ranges.from_text("d_size", "8..64") == Range(8, 64)
    assert ranges.from_text("d_size", "8,64") is None


class Fake(Places, places.Local):
    """Trainings that make one evaluation at each look: the nearer lr_actor is to BEST, the higher the return."""

    started: list = []
    fails = diverges = ""

    def start(self, training):
        Fake.started.append(training)
        folder = self.folder / training.name
        if not folder.exists():
            settings = json.loads(json.dumps(training.settings))
            a_folder(folder, [[], []], "vrm", "pendulum", training.steps, updates=(), hyperparameters=settings)
        self.running[training.name] = training, []

    def ended(self):
        codes = {}
        for name, (training, asked) in list(self.running.items()):
            if self.fails and self.fails in name:
                (self.folder / "logs" / f"{name}.log").write_text("beliefrl: it broke.\n")
                codes[name] = 2
            elif asked:
                codes[name] = 143
            elif self.evaluate(training) >= training.steps:
                codes[name] = 0
        self.running = {name: each for name, each in self.running.items() if name not in codes}
        return codes

    def evaluate(self, training):
        value = -abs(math.log(training.settings["lr_actor"] / BEST))
        for seed in (0, 1):
            log = self.folder / training.name / "metrics" / f"seed-{seed}.jsonl"
            step = EVERY * (1 + log.read_text().count("evaluation"))
            returns = {"sampled": [value + seed * step], "mode": [-1.0]}
            kind = "diverged" if self.diverges and self.diverges in training.name else "evaluation"
            with log.open("a") as file:
                file.write(json.dumps({"step": step, "kind": kind} | returns) + "\n")
        return step

    def interrupt(self, name):
        self.running[name][1].append("asked")

    def stop(self):
        for _, asked in self.running.values():
            asked.append("asked")


@pytest.fixture
def search(monkeypatch, tmp_path):
    """Calls `tune` in a new folder, on fake trainings of four evaluations; returns it with the Fake's record."""
    pytest.importorskip("optuna")
    monkeypatch.setattr(tuning.places, "Local", Fake)
    monkeypatch.setattr(tuning.places, "slots", lambda workers: ["0", "1", "2"][:workers])
    monkeypatch.setattr(tuning, "LOOK_EVERY", 0.0)
    monkeypatch.setattr(Fake, "started", [])
    settings = {"steps": 4 * EVERY, "eval_every": EVERY}

    def call(trials, **changes):
        given = {"only": ["lr_actor"], "settings": settings, "seeds": 2, "workers": 1, "out": tmp_path / "search"}
        return tune("vrm", "pendulum", trials=trials, **given | changes)

    return call


def test_the_best_trial_is_returned_and_its_command_trains_it(search, tmp_path, monkeypatch):
    tuned = search(3, workers=2)
    rates = {training.name: training.settings["lr_actor"] for training in Fake.started}
    assert list(rates) == ["trial-000", "trial-001", "trial-002"]
    assert rates["trial-000"] == BEST  # the agent's own
    assert all(1e-4 <= rate <= 3e-3 for rate in rates.values())
    assert len(set(rates.values())) == 3
    assert [trial.state for trial in tuned.trials] == ["complete"] * 3
    assert tuned.settings == {"lr_actor": BEST}
    assert tuned.value == pytest.approx((2000 + 3000 + 4000) / 3 / 2)  # mean over seeds of the last 3 evaluations
    assert tuned.run == tmp_path / "search" / "trial-000"
    assert {"study.journal", "history.png", "importance.png"} <= {path.name for path in tuned.study.parent.iterdir()}

    trained = []
    monkeypatch.setattr("beliefrl.training.train.train", lambda *given, **options: trained.append((given, options)))
    cli.main(tuned.command.split()[1:])
    (agent, _, out), options = trained[0]
    assert agent == agents.make("vrm", lr_actor=BEST)
    assert (options["steps"], options["eval_every"], out) == (4000, 1000, None)
    assert (options["seed"], options["seeds"]) == (2, 2)  # seeds that no trial has used


def test_a_search_goes_on_with_the_trials_that_are_missing(search):
    search(2)
    before = list(Fake.started)
    tuned = search(4)
    assert [training.name for training in Fake.started] == [f"trial-00{number}" for number in range(4)]
    assert Fake.started[:2] == before
    assert len(tuned.trials) == 4
    assert len({trial.settings["lr_actor"] for trial in tuned.trials}) == 4
    search(4)
    assert len(Fake.started) == 4


def test_a_stopped_trial_continues_with_its_settings(search, monkeypatch):
    loop = tuning._Trials.step

    def interrupted(self):
        loop(self)
        if len(Fake.started) == 2:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(tuning._Trials, "step", interrupted)
    with pytest.raises(Stopped, match="stopped with 1 of 3 trials done in"):
        search(3)
    monkeypatch.setattr(tuning._Trials, "step", loop)
    tuned = search(3)
    assert [training.name for training in Fake.started] == ["trial-000", "trial-001", "trial-001", "trial-002"]
    assert Fake.started[1].settings == Fake.started[2].settings
    assert [trial.state for trial in tuned.trials] == ["complete"] * 3


def test_a_trial_that_is_stopped_from_outside_continues_at_once(search, monkeypatch):
    start = Fake.start

    def stopped_once(self, training):
        start(self, training)
        if [each.name for each in Fake.started].count(training.name) == 1:
            self.interrupt(training.name)

    monkeypatch.setattr(Fake, "start", stopped_once)
    tuned = search(3, workers=2)
    assert sorted(each.name for each in Fake.started) == [f"trial-00{number}" for number in (0, 0, 1, 1, 2, 2)]
    assert [trial.state for trial in tuned.trials] == ["complete"] * 3
    rates = {(each.name, each.settings["lr_actor"]) for each in Fake.started}
    assert rates == {(trial.name, trial.settings["lr_actor"]) for trial in tuned.trials}


def test_trials_that_finish_while_they_are_stopped_count_as_done(search, monkeypatch):
    loop = tuning._Trials.step

    def interrupted(self):
        loop(self)
        os.kill(os.getpid(), signal.SIGINT)

    def finish_all(self):
        for training, _ in self.running.values():
            while self.evaluate(training) < training.steps - EVERY:
                pass

    monkeypatch.setattr(tuning._Trials, "step", interrupted)
    monkeypatch.setattr(Fake, "stop", finish_all)
    with pytest.raises(Stopped, match="stopped with 2 of 3 trials done in"):
        search(3, workers=2)


def test_a_poor_trial_is_pruned_unless_pruning_is_off(search, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "STARTUP", 1)
    tuned = search(3)
    assert [trial.state for trial in tuned.trials] == ["complete", "pruned", "pruned"]  # the first is the best there is
    assert "pruned: trial-001: its return was low (1 of 3 done, 1 pruned, 1 waiting)" in capsys.readouterr().out
    log = tmp_path / "search" / "trial-001" / "metrics" / "seed-0.jsonl"
    assert log.read_text().count("evaluation") == 2  # of 4, the first of them before learning
    off = search(3, prune=False, out=tmp_path / "off")
    assert [trial.state for trial in off.trials] == ["complete"] * 3


def test_a_trial_that_diverges_is_pruned_and_one_that_fails_is_reported(search, monkeypatch):
    monkeypatch.setattr(Fake, "diverges", "trial-001")
    monkeypatch.setattr(Fake, "evaluate", lambda self, training, old=Fake.evaluate: max(old(self, training), 4000))
    monkeypatch.setattr(Fake, "fails", "trial-002")
    trials = {trial.name: trial for trial in search(3).trials}
    assert [trials[f"trial-00{number}"].state for number in range(3)] == ["complete", "pruned", "failed"]
    assert trials["trial-002"].why == "it broke."


def test_a_search_in_which_everything_fails_ends(search, monkeypatch):
    monkeypatch.setattr(Fake, "fails", "trial")
    with pytest.raises(UserError, match=r"The last 3 trials failed \(it broke\): fix the cause"):
        search(10)
    assert len(Fake.started) == 3
    monkeypatch.setattr(Fake, "fails", "trial-003")  # failures of earlier sessions do not count
    assert [trial.state for trial in search(5).trials] == ["complete", *["failed"] * 4]


def test_a_search_ends_where_everything_fails_after_a_trial_that_was_complete(search, monkeypatch):
    search(1)
    monkeypatch.setattr(Fake, "fails", "trial")
    with pytest.raises(UserError, match=r"The last 3 trials failed"):
        search(10)
    assert len(Fake.started) == 4


def test_trials_that_do_not_fail_one_after_the_other_end_no_search(search, monkeypatch):
    monkeypatch.setattr(Fake, "evaluate", lambda self, training, old=Fake.evaluate: max(old(self, training), 4000))
    monkeypatch.setattr(Fake, "diverges", "trial-002")
    ended = Fake.ended

    def some_fail(self):
        self.fails = "" if "trial-002" in self.running else "trial"
        return ended(self)

    monkeypatch.setattr(Fake, "ended", some_fail)
    with pytest.raises(UserError, match=r"No trial in .* is complete \(it broke\): give more trials; .*logs has"):
        search(5)
    assert len(Fake.started) == 5


def test_settings_that_the_agent_refuses_fail_and_do_not_end_a_search(search, monkeypatch):
    training = study.Search.training

    def refused(self, name, settings):
        if name.startswith("trial-") and name != "trial-000":
            raise UserError("They do not fit.")
        return training(self, name, settings)

    monkeypatch.setattr(study.Search, "training", refused)
    assert [trial.state for trial in search(6).trials] == ["complete", *["failed"] * 5]


def test_a_finished_search_says_so(search, tmp_path, capsys):
    search(2, progress=False)
    assert capsys.readouterr().out == ""
    search(2)
    first, last = capsys.readouterr().out.splitlines()
    assert first.endswith("2 trainings, 2 of them finished already")
    assert f"2 of 2 trainings finished in {tmp_path / 'search'}" in last


def test_a_trial_that_still_ends_is_waited_for(search, tmp_path, monkeypatch):
    """After a kill of the search its trainings take a while to write their checkpoints."""
    loop = tuning._Trials.step

    def killed(self):
        loop(self)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(tuning._Trials, "step", killed)
        with pytest.raises(KeyboardInterrupt):
            search(3)
    assert [training.name for training in Fake.started] == ["trial-000"]
    there = locked(tmp_path / "search" / "trial-000", "is being trained")

    def step(self):
        loop(self)
        if len(self.status.finished) == 2:
            there.close()

    monkeypatch.setattr(tuning._Trials, "step", step)
    tuned = search(3)
    assert [training.name for training in Fake.started[1:]] == ["trial-001", "trial-002", "trial-000"]
    assert [trial.state for trial in tuned.trials] == ["complete"] * 3


def test_a_trial_that_is_stopped_with_the_search_continues_whatever_its_exit_code(search, monkeypatch):
    loop, ended = tuning._Trials.step, Fake.ended

    def interrupted(self):
        loop(self)
        os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patched:
        patched.setattr(tuning._Trials, "step", interrupted)
        patched.setattr(Fake, "ended", lambda self: {name: code and 1 for name, code in ended(self).items()})
        with pytest.raises(Stopped):
            search(1)
    assert [trial.state for trial in search(1).trials] == ["complete"]


def test_each_log_is_read_once_in_a_look(search, monkeypatch):
    read, lines = [], records.lines
    monkeypatch.setattr(records, "lines", lambda log: (read.append(log), lines(log))[1])
    watch = tuning._Trials._watch

    def once(self, name):
        read.clear()
        watch(self, name)
        assert len(read) == len(set(read)) == 2  # two seeds

    monkeypatch.setattr(tuning._Trials, "_watch", once)
    search(1)


def test_a_folder_that_cannot_be_read_is_one_sentence(search, tmp_path, monkeypatch):
    def refused(folder):
        raise PermissionError(13, "Permission denied")

    (tmp_path / "search").mkdir()
    with monkeypatch.context() as patched:
        patched.setattr(pathlib.Path, "iterdir", refused)
        with pytest.raises(UserError, match=r"search cannot be written \(Permission denied\)"):
            search(1)


def test_a_journal_is_repaired_in_place(tmp_path, monkeypatch):
    """If it were written again, a full disk would lose it."""
    journal = tmp_path / study.JOURNAL
    monkeypatch.setattr(pathlib.Path, "write_bytes", None)
    for content, repaired in ((b"{}\n{", b"{}\n"), (b"{", b""), (b"{}\n", b"{}\n")):
        with journal.open("wb") as file:
            file.write(content)
        study._repair(journal)
        assert journal.read_bytes() == repaired


def test_the_objective_is_the_area_under_the_curve_or_the_mode(search, tmp_path):
    assert search(1, objective="area").value == pytest.approx(2500 / 2)  # all four evaluations
    assert search(1, actions="mode", out=tmp_path / "mode").value == -1.0


def test_a_study_of_something_else_is_not_continued(search, tmp_path):
    search(1)
    for changes, what in [
        ({"objective": "area"}, "objective: 'last', not 'area'"),
        ({"settings": {"steps": 50, "eval_every": EVERY}}, "steps: 4000, not 50"),
        ({"ranges": {"lr_actor": Range(1e-4, 1e-3)}}, "range of lr_actor: "),
        ({"only": ["lr_critic"]}, "range of lr_"),
    ]:
        with pytest.raises(UserError, match=f"has another {what}"):
            search(2, **changes)
    assert len(Fake.started) == 1
    journal = tmp_path / "search" / study.JOURNAL
    journal.write_text(journal.read_text() + '{"op_code": 4, "tri')  # killed while it wrote
    assert len(search(2).trials) == 2
    journal.write_text("nonsense\n" + journal.read_text())
    with pytest.raises(UserError, match=r"study\.journal is damaged"):
        search(2)


def test_a_study_continues_where_entries_are_given_as_numbers_or_as_text(search, tmp_path):
    search(1, observe=(0,))
    assert len(search(1, observe=("0",)).trials) == 1
    journal = tmp_path / "search" / study.JOURNAL
    journal.write_text(journal.read_text().replace('"observe":["0"]', '"observe":[0]'))  # as older studies have it
    assert '"observe":[0]' in journal.read_text()
    assert len(search(1, observe=("0",)).trials) == 1


def test_a_full_disk_is_one_sentence_and_the_search_goes_on_later(search, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(study, "draw", full)
        with pytest.raises(UserError, match=r"search cannot be written \(No space left on device\): fix that"):
            search(1)
    assert len(search(1).trials) == 1
    assert len(Fake.started) == 1


def test_without_optuna_the_extra_is_named(search, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(UserError, match=r"tune needs Optuna: pip install 'beliefrl\[tune\]'"):
        search(1)
    assert not (tmp_path / "search").exists()


@dataclasses.dataclass(frozen=True)
class Own:
    """A part of an agent of a user's, with a range of its own."""

    width: int = 8
    rate: float = 0.1
    ranges = {"rate": Range(0.01, 1.0, "log")}


def test_an_agent_of_ones_own_has_ranges_or_gets_them():
    assert ranges.chosen(Own(), "m:Own", {}) == {"rate": Range(0.01, 1.0, "log")}
    given = {"width": (4, 8), "rate": Range(0.1, 0.5)}
    assert ranges.chosen(Own(), "m:Own", given) == {"width": (4, 8), "rate": Range(0.1, 0.5, "log")}
    assert ranges.chosen(Own(), "m:Own", {"width": [4, 8]}, fixed=["rate"]) == {"width": (4, 8)}
    with pytest.raises(UserError, match="m:Own has no hyperparameter to tune"):
        ranges.chosen(Own(), "m:Own", {}, fixed=["rate"])


@pytest.mark.parametrize("pictures", [["history.png"], ["history.png", "importance.png"]])
def test_the_command_gives_everything_to_the_search(monkeypatch, capsys, tmp_path, pictures):
    asked = {}
    (tmp_path / "my search").mkdir()
    for name in pictures:
        (tmp_path / "my search" / name).touch()

    def search(**given):
        asked.update(given)
        failed = study.Trial("trial-000", "failed", 0, {}, "it broke")
        trials = (study.Trial("trial-003", "complete", -1.5, {"tau": 0.1}), failed)
        journal = tmp_path / "my search" / study.JOURNAL
        return tuning.Tuned({"tau": 0.1}, -1.5, "beliefrl train vrm pendulum-v", tmp_path, journal, trials)

    monkeypatch.setattr(tuning, "tune", search)
    line = (
        "tune vrm pendulum-v --trials 7 --seeds 2 --seed 5 --steps 70 --set burn_in=8 --only tau policy_layers "
        "--range tau=0.1..0.5:log policy-layers=[8],[8,16] --observe 0 --constants mass=2 length=0.5 --objective area "
        f"--actions mode --no-prune --workers 3 --out {tmp_path / 'search'}"
    )
    cli.main(line.split())
    assert asked == {
        "agent": "vrm",
        "task": "pendulum-v",
        "trials": 7,
        "seeds": 2,
        "seed": 5,
        "ranges": {"tau": Range(0.1, 0.5, "log"), "policy_layers": [[8], [8, 16]]},
        "only": ("tau", "policy_layers"),
        "settings": {"burn_in": 8, "steps": 70},
        "observe": ("0",),
        "constants": {"mass": 2, "length": 0.5},
        "objective": "area",
        "actions": "mode",
        "prune": False,
        "workers": 3,
        "out": tmp_path / "search",
    }
    out = capsys.readouterr().out
    assert "2 trials, 1 complete, 1 failed" in out
    assert "1 failed: it broke" in out
    assert f"my search has {' and '.join(pictures)}; `beliefrl report" in out
    assert f"`beliefrl report '{tmp_path / 'my search'}' --unfinished`" in out
    assert "tau=0.1" in out
    assert out.endswith("beliefrl train vrm pendulum-v\n")
