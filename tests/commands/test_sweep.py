"""The command lines of `beliefrl sweep` and `beliefrl figure`."""

import pytest

from beliefrl import cli
from beliefrl.sweeps import run, sources
from written import a_run, flat


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """The arguments of `sweep`, which is replaced and runs nothing."""
    given = []

    def sweep(experiments, folder, **options):
        given.append((experiments, folder, options))

    monkeypatch.setattr(run, "sweep", sweep)
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
    experiments(asked, "--preset memory --workers 3 --ray auto --out mine")
    _, folder, options = asked[-1]
    assert (str(folder), options["workers"], options["ray"]) == ("mine", 3, "auto")


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


@pytest.mark.parametrize("kind", ["curves", "ablation", "aggregate"])
def test_a_figure_is_one_command(tmp_path, monkeypatch, capsys, kind):
    monkeypatch.chdir(tmp_path)
    a_run(tmp_path / "runs" / "done", [flat(1.0, 2.0)], task="pendulum")
    a_run(tmp_path / "runs" / "going", [flat(1.0)], task="cartpole", steps=20)
    cli.main(["figure", kind, "runs", "-o", "picture"])
    out = capsys.readouterr().out
    assert "left out: runs/going is not finished" in out
    assert "written to picture.png and picture.pdf" in out
    assert (tmp_path / "picture.png").exists()
    cli.main(["figure", kind, "runs", "--tasks", "pendulum"])
    assert "left out" not in capsys.readouterr().out
    assert (tmp_path / f"{kind}.pdf").exists()


def test_the_cost_table_is_printed_and_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    a_run(tmp_path / "done", [flat(1.0, 2.0)])
    cli.main(["figure", "scalability", "done"])
    assert (tmp_path / "scalability.md").read_text() in capsys.readouterr().out
    assert (tmp_path / "scalability.tex").exists()
