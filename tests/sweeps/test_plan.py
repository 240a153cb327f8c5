"""The list of trainings in a sweep."""

import dataclasses
import json
import shutil
import sys

import numpy as np
import pytest

from beliefrl import agents, cli, tasks
from beliefrl.errors import UserError
from beliefrl.runs.options import Options
from beliefrl.runs.recorder import Recorder
from beliefrl.sweeps import sources
from beliefrl.sweeps.experiments import Experiment, grid
from beliefrl.sweeps.plan import extended, plan, shrunk
from beliefrl.sweeps.sources import load, read, write


def test_a_grid_is_every_combination():
    made = grid(["vrm", "slac"], ["pendulum"], {"gamma": [0.9, 0.99], "tau": [0.1]}, seeds=2, steps=50)
    assert [(each.agent, each.settings["gamma"], each.settings["tau"]) for each in made] == [
        ("vrm", 0.9, 0.1),
        ("vrm", 0.99, 0.1),
        ("slac", 0.9, 0.1),
        ("slac", 0.99, 0.1),
    ]
    assert all(each.settings["steps"] == 50 and each.seeds == (0, 1) for each in made)


def test_faults_of_the_sensors_are_settings(tmp_path):
    noisy = grid(
        ["sac-mlp"], ["pendulum"], {"noise": [0.0, [0.1, 0.2, 0.3]], "gamma": [0.9]}, seeds=1, flicker_flag=True
    )
    for training, noise in zip(plan(noisy), (["0.0"], ["0.1", "0.2", "0.3"]), strict=True):
        command = training.command(tmp_path)
        assert command[command.index("--noise") :][: len(noise) + 1] == ["--noise", *noise]
        assert "--flicker-flag" in command
        assert training.name == f"sac-mlp-pendulum-gamma=0.9-flicker_flag=True-noise={','.join(noise)}-seed0"
    write(tmp_path, plan(noisy))
    assert extended(read(tmp_path), noisy) == read(tmp_path)
    with pytest.raises(UserError, match=r"noise=0\.1 0\.2 has 2 deviations"):
        plan(grid(["sac-mlp"], ["pendulum"], {"noise": [[0.1, 0.2]]}))


def test_numbers_of_numpy_are_numbers(tmp_path, unchecked):
    settings = {"deterministic": np.bool_(True), "gamma": np.float64(0.9), "policy_layers": np.array([8, 8])}
    given = Experiment("vrm", "cartpole", settings, np.arange(2, 4), constants={"max_steps": np.int64(100)})
    like = {"deterministic": True, "gamma": 0.9, "policy_layers": [8, 8]}
    same = Experiment("vrm", "cartpole", like, (2, 3), constants={"max_steps": 100})
    assert given == same
    assert type(given.seeds[0]) is int
    for training, other in zip(plan([given]), plan([same]), strict=True):
        assert training.command(tmp_path) == other.command(tmp_path)
    (made,) = grid(["vrm"], ["pendulum"], {"gamma": np.array([0.9])}, seeds=np.int64(2))
    assert (made.seeds, made.settings) == ((0, 1), {"gamma": 0.9})


@pytest.mark.parametrize(
    ("seeds", "phrase"),
    [
        (None, "seeds=None is impossible"),
        (3, "seeds=3 is impossible: give the seed numbers"),
        ("012", "seeds='012' is impossible"),
        ((), "seeds has no seed number"),
        ((0, -1), "seed=-1 is impossible"),
        ((0, 0.5), r"seed=0\.5 is impossible"),
        ((True,), "seed=True is impossible"),
        ((3_000_000_000,), "seed=3000000000 is impossible"),
    ],
)
def test_seeds_are_whole_numbers(seeds, phrase, unchecked):
    with pytest.raises(UserError, match=phrase):
        Experiment("vrm", "pendulum", seeds=seeds)


@pytest.mark.parametrize("seeds", [0, -1, None, 1.5, True, iter([0, 1]), "3"])
def test_a_grid_has_one_seed_or_more(seeds, unchecked):
    with pytest.raises(UserError, match=r"seeds=.* is impossible: it must be a whole number of at least 1"):
        grid(["vrm"], ["pendulum"], seeds=seeds)


def test_first_seeds_come_first():
    trainings = plan(grid(["vrm", "slac"], ["pendulum", "cartpole"], seeds=3))
    assert [training.options["seed"] for training in trainings] == [0] * 4 + [1] * 4 + [2] * 4
    assert len({training.name for training in trainings}) == 12


@pytest.mark.parametrize(
    ("agent", "task", "together", "runs"),
    [
        ("vrm", "pendulum", None, [[0], [1], [2], [5]]),
        ("sac-mlp", "pendulum", None, [[0, 1, 2], [5]]),
        ("sac-mlp", "pendulum", 1, [[0], [1], [2], [5]]),
        ("vrm", "pendulum", 2, [[0, 1], [2], [5]]),
        ("sac-mlp", "cartpole-p", None, [[0, 1, 2], [5]]),
        ("sac-mlp", "gym:Pendulum-v1", None, [[0], [1], [2], [5]]),
    ],
)
def test_seeds_share_a_program_where_that_pays(agent, task, together, runs):
    trainings = plan([Experiment(agent, task, seeds=(2, 0, 1, 5))], together)
    assert [training.seeds for training in trainings] == runs


def test_a_sweep_passes_on_how_trainings_start_and_end(tmp_path):
    settings = {"steps": 40, "stop_at": -200.0, "stop_patience": 2, "init_from": "runs/a", "step_timeout": 5.0}
    (training,) = plan([Experiment("sac-mlp", "pendulum", settings, seeds=(3,))])
    command = training.command(tmp_path)
    for name, value in settings.items():
        flag = f"--{name.replace('_', '-')}"
        assert command[command.index(flag) + 1] == str(value)
    made = tasks.describe(tasks.make("pendulum"))
    config = {"agent": "sac-mlp", "hyperparameters": {}, **made, "options": training.options}
    recorder = Recorder(tmp_path / training.name, config)
    for step, total in ((10, -190.0), (20, -201.0), (30, -150.0)):
        recorder.log(3, "evaluation", step, {"sampled": [total], "mode": [total]})
    recorder.finish({})
    assert not training.is_finished(tmp_path)
    recorder.log(3, "evaluation", 35, {"sampled": [-200.0], "mode": [-999.0]})
    assert training.is_finished(tmp_path)
    recorder.close()
    shutil.copytree(tmp_path / training.name, tmp_path / "again" / training.name)
    (tmp_path / "again" / training.name / "results.json").unlink()
    assert not training.is_finished(tmp_path / "again")
    with (tmp_path / "again" / training.name / "metrics" / "seed-3.jsonl").open("a") as log:
        log.write(json.dumps({"step": 40, "kind": "diverged", "why": "a loss"}) + "\n")
    assert training.is_finished(tmp_path / "again")  # another try would select the seeds that survive
    (tmp_path / training.name / "config.json").write_text("{")
    assert not training.is_finished(tmp_path)  # the training says that its run is damaged


def test_a_sweep_that_grows_trains_no_seed_twice():
    before = plan(grid(["vrm", "sac-mlp"], ["pendulum"], seeds=3, steps=10))
    grown = extended(before, grid(["vrm", "sac-mlp"], ["pendulum"], seeds=5, steps=20))
    seeds = {agent: [each.seeds for each in grown if each.agent == agent] for agent in ("vrm", "sac-mlp")}
    assert seeds == {"vrm": [[0], [1], [2], [3], [4]], "sac-mlp": [[0, 1, 2], [3, 4]]}
    assert all(each.steps == 20 for each in grown)
    assert extended(grown, grid(["vrm"], ["pendulum"], seeds=5, steps=20), seeds_per_run=5) == grown
    other = extended(grown, grid(["vrm"], ["pendulum"], {"gamma": [0.9]}, seeds=1))
    assert [each.name for each in other[len(grown) :]] == ["vrm-pendulum-gamma=0.9-seed0"]
    assert extended(before, []) == before


def test_entries_are_the_same_as_numbers_and_as_text(tmp_path):
    whole = (Experiment("vrm", "pendulum", seeds=(0,), observe=observe) for observe in (None, ()))
    assert len({plan([each])[0].name for each in whole}) == 1
    number, text = (Experiment("vrm", "pendulum", seeds=(0,), observe=observe) for observe in ((0,), "0"))
    assert plan([number]) == plan([text]) == extended(plan([number]), [text])
    assert plan([Experiment("vrm", "pendulum", observe="velocities")])[0].observe == ("velocities",)
    write(tmp_path, plan([number]))
    path = tmp_path / "sweep.json"
    path.write_text(path.read_text().replace('"0"', "0"))  # as older sweeps have it
    assert extended(read(tmp_path), [text]) == plan([text])


def test_a_sweep_has_no_two_trainings_of_one_name():
    one, other = (Experiment("vrm", "pendulum-v", {"noise": noise}, (0,)) for noise in (0.1, [0.1]))
    for planned in (lambda: plan([one, other]), lambda: extended(plan([one]), [other])):
        with pytest.raises(UserError, match=r"training.* vrm-pendulum-v-noise=0\.1-seed0"):
            planned()


def test_a_training_is_a_command_that_says_everything(tmp_path):
    experiment = Experiment(
        "vrm",
        "cartpole",
        {"deterministic": True, "policy_layers": [8, 8], "steps": 70, "track": ["wandb"], "target_entropy": None},
        (3,),
        observe=(0, 2),
        constants={"half_length": 0.7},
    )
    (training,) = plan([experiment])
    line = " ".join(training.command(tmp_path))
    for part in (
        "train vrm cartpole",
        "--deterministic",
        "--policy-layers 8 8",
        "--steps 70",
        "--track wandb",
        "--target-entropy None",
        "--observe 0 2",
        "--constants half_length=0.7",
        "--seed 3 --seeds 1",
        f"--out {tmp_path / training.name} --resume",
    ):
        assert part in line
    assert training.name.endswith("-seed3")
    assert "/" not in training.name


def test_the_command_trains_what_was_planned(tmp_path, monkeypatch):
    hyperparameters = {"perceive_reward": False, "target_entropy": None, "policy_layers": [8], "reward_memory": (2.0,)}
    options = {"steps": 70, "stop_at": None, "overlap": False, "track": [], "processes": "never"}
    faults = {"flicker_flag": False, "noise": [0.1, 0.2]}
    settings = {**hyperparameters, **options, **faults}
    (training,) = plan([Experiment("predictive-sac", "cartpole", settings, (3,), (0, 2), {"half_length": 0.7})])
    asked = []
    monkeypatch.setattr("beliefrl.training.train.train", lambda *given, **more: asked.append((given, more)))
    cli.main(training.command(tmp_path))
    (((agent, task, out), more),) = asked
    assert agent == agents.make("predictive-sac", **hyperparameters | {"policy_layers": (8,)})
    assert task == tasks.make("cartpole", (0, 2), faults, half_length=0.7)
    assert out == tmp_path / training.name
    started = dataclasses.asdict(Options(**options | {"track": (), "seed": 3}))
    assert more == {**started, "own_process": True, "resume": True}


def test_names_tell_settings_apart_and_stay_short():
    settings = {"gamma": [0.9, 0.99], "tau": [0.1, 0.2], "lr_actor": [1e-3], "lr_critic": [1e-3], "lr_alpha": [1e-3]}
    settings |= {"policy_layers": [[256, 256]], "value_layers": [[256, 256]], "actor_regulariser": [0.5]}
    names = {training.name for training in plan(grid(["sac-lstm"], ["target-reaching"], settings, seeds=1))}
    assert len(names) == 4
    assert all(len(name) < 140 for name in names)


@pytest.mark.parametrize(
    ("experiment", "phrase"),
    [
        (Experiment("vmr", "pendulum"), "no agent 'vmr'"),
        (Experiment("vrm", "pendulm"), "no task 'pendulm'"),
        (Experiment("vrm", "pendulum", {"gama": 1}), "no hyperparameter 'gama'"),
        (Experiment("vrm", "pendulum", {"gamma": 2}), "gamma=2.0 is impossible"),
        (Experiment("vrm", "pendulum", {"steps": 0}), "steps=0 is impossible"),
        (Experiment("vrm", "pendulum", {"seeds": 3}), "seeds cannot be a setting"),
        (Experiment("vrm", "pendulum", {"replay_capacity": 10}), "replay_capacity=10 is too small"),
        (Experiment("vrm", "pendulum", observe=(7,)), "7 is not an index of the observation"),
        (Experiment("vrm", "pendulum", constants={"wheels": 3}), "no constant 'wheels'"),
        (Experiment("vrm", "gym:No-v0"), "No-v0"),
    ],
)
def test_every_mistake_is_found_before_anything_begins(experiment, phrase):
    with pytest.raises(UserError) as error:
        plan([Experiment("sac-mlp", "pendulum"), experiment])
    assert phrase in str(error.value)


def test_options_of_a_training_cannot_be_varied():
    with pytest.raises(UserError, match="an option of the training can have only one value"):
        plan(grid(["vrm"], ["pendulum"], {"steps": [10, 20]}))


def test_a_smaller_sweep_has_a_fraction_of_every_count():
    small = shrunk(Experiment("vrm", "pendulum", {"steps": 30_000, "gamma": 0.9}), 0.1)
    assert small.settings == {
        "steps": 3000,
        "gamma": 0.9,
        "eval_every": 200,
        "step_start_rl": 100,
        "train_times_fivrm": 500,
    }
    assert shrunk(Experiment("slac", "pendulum", {"pretrain_updates": 0}), 0.5).settings["pretrain_updates"] == 0
    plan([small])


def test_what_is_written_down_is_read_again(tmp_path):
    settings = {"policy_layers": [8], "target_entropy": None}
    trainings = plan([Experiment("vrm", "cartpole", settings, (4,), (0, 2), {"half_length": 0.7})])
    assert read(tmp_path) == []
    write(tmp_path, trainings)
    assert read(tmp_path) == trainings
    path = tmp_path / "sweep.json"
    whole = json.loads(path.read_text())
    for content, phrase in [
        ({"format": 1, "trainings": [{"name": "x"}]}, r"sweep\.json is damaged"),
        ({"trainings": []}, r"sweep\.json is damaged"),
        ([], r"sweep\.json is damaged"),
        (whole | {"format": 2}, r"sweep\.json has format 2, which this version cannot read"),
        ({"format": 2, "runs": []}, r"sweep\.json has format 2, which this version cannot read"),
    ]:
        path.write_text(json.dumps(content))
        with pytest.raises(UserError, match=phrase):
            read(tmp_path)
    whole["trainings"][0]["options"]["speed"] = 3
    path.write_text(json.dumps(whole))
    with pytest.raises(UserError, match=r"written by another version: this one has no option 'speed'"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("content", "phrase"),
    [
        ("experiments = 3", "does not define a list `experiments`"),
        ("x = 3", "does not define a list `experiments`"),
        ("1 / 0", "ZeroDivisionError"),
        ("def", "SyntaxError"),
        ("raise SystemExit(3)", "SystemExit: 3"),
    ],
)
def test_a_file_without_experiments_is_refused(tmp_path, content, phrase):
    (tmp_path / "mine.py").write_text(content)
    with pytest.raises(UserError, match=phrase):
        load(tmp_path / "mine.py")
    with pytest.raises(UserError, match="no file"):
        load(tmp_path / "yours.py")


def test_a_file_may_define_a_dataclass_whose_types_are_text(tmp_path):
    lines = ("from __future__ import annotations", "import dataclasses", "@dataclasses.dataclass", "class A:")
    lines += ("    count: int = 3", "experiments = []")
    (tmp_path / "mine.py").write_text("\n".join(lines))
    assert load(tmp_path / "mine.py") == []


@pytest.mark.parametrize("line", ["1 / 0", "raise SystemExit", "import beliefrl; beliefrl.Faults(noise=-1.0)"])
def test_a_file_that_fails_is_not_kept_as_a_module(tmp_path, line):
    (tmp_path / "mine.py").write_text(line)
    with pytest.raises(UserError):
        load(tmp_path / "mine.py")
    assert "beliefrl_sweep" not in sys.modules


def test_names_of_settings_are_texts(unchecked):
    with pytest.raises(UserError, match=r"settings=.* is impossible: its names must be texts"):
        Experiment("vrm", "pendulum", {3: 0.9})


def test_a_file_makes_experiments(tmp_path):
    lines = ("import beliefrl", "experiments = beliefrl.grid(['vrm'], ['pendulum'], seeds=[7])")
    (tmp_path / "mine.py").write_text("\n".join(lines))
    assert [training.name for training in plan(load(tmp_path / "mine.py"))] == ["vrm-pendulum-seed7"]


@pytest.mark.parametrize(
    ("name", "lines", "seeds"),
    [("classic", 24, 5), ("robots", 36, 5), ("memory", 4, 5), ("ablation", 80, 5), ("scalability", 4, 1)],
)
def test_presets_are_the_papers_experiments(name, lines, seeds):
    made = sources.preset(name)
    assert len(made) == lines
    assert all(len(each.seeds) == seeds for each in made)
    assert {each.task for each in made} <= set(tasks.names())
    for each in made:
        assert each.agent in sources.COMPARED + sources.ABLATIONS


def test_the_sensitivity_study_draws_settings_for_each_of_twenty_seeds():
    made = sources.preset("sensitivity", ["pendulum"])
    usual, *other = made
    assert len(usual.seeds) == 20
    for each in other:
        (seed,) = each.seeds
        assert each.settings["seq_len"] * each.settings["batch_size"] == 256
        assert {name: each.settings[name] for name in sources.PAPERS} == sources.drawn(seed)
    same = [seed for seed in range(20) if sources.drawn(seed) == sources.PAPERS]
    assert len(other) == 20 - len(same)
    assert len({tuple(sources.drawn(seed).items()) for seed in range(20)}) > 6
    plan(made)


def test_a_preset_takes_other_tasks_agents_and_seeds():
    made = sources.preset("classic", ["target-reaching"], ["vrm"], [8])
    assert [(each.agent, each.task, tuple(each.seeds)) for each in made] == [("vrm", "target-reaching", (8,))]
    with pytest.raises(UserError, match="no preset 'paper'"):
        sources.preset("paper")


def test_a_seed_that_is_given_twice_is_trained_once():
    made = plan([Experiment("sac-mlp", "pendulum-v", seeds=(0, 1, 1, 0, 2))])
    assert [(training.options["seed"], training.options["seeds"]) for training in made] == [(0, 3)]
