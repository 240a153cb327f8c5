"""Files of results: what is read back, and that figures are the same as those of the runs themselves."""

import gzip
import json
import pathlib

import numpy as np
import pytest

from beliefrl import agents, cli
from beliefrl.analysis import groups, results
from beliefrl.analysis.panels import draw_elbo, model_loss
from beliefrl.errors import UserError
from beliefrl.report import write_report
from inputs import HOUR, a_folder, a_run, flat

KEPT = sorted((pathlib.Path(__file__).parents[2] / "results").glob("*.json.gz"))
DEFAULTS = {"vrm": {"gamma": 0.99, "layers": [256, 256], "tau": 0.005}}
UPDATES = [(5, {"negative_elbo": 8.0, "alpha": 1.0}), (10, {"negative_elbo": 6.0, "alpha": 1.0})]


def packed(path, *runs):
    results.write(path, runs, DEFAULTS)
    return results.read(path)


def test_a_run_comes_back_with_its_settings_and_evaluations(tmp_path):
    seeds = [[(10, [1.0, 1 / 3], [True, False])], [(10, [-123.456789, 4.0], [False, False])]]
    run = a_run(tmp_path / "run", seeds, settings=DEFAULTS["vrm"] | {"gamma": 0.9}, first=3, **HOUR)
    (kept,) = packed(tmp_path / "kept.json.gz", run)
    assert kept.folder.name == "run"
    assert kept.config == run.config
    for seed in (3, 4):
        (row,), (was,) = kept.rows(seed, "evaluation"), run.rows(seed, "evaluation")
        assert row.keys() == was.keys()
        np.testing.assert_allclose(row["sampled"], was["sampled"], rtol=5e-6)
        assert row["sampled_success"] == was["sampled_success"]


def test_only_settings_that_are_not_the_agents_own_take_room(tmp_path):
    packed(tmp_path / "kept.json.gz", a_run(tmp_path / "run", [flat(1.0)], settings={"gamma": 0.9, "tau": 0.005}))
    (entry,) = json.loads(gzip.decompress((tmp_path / "kept.json.gz").read_bytes()))["runs"]
    assert entry["config"]["hyperparameters"] == {"gamma": 0.9}


def test_a_later_default_does_not_change_what_a_file_says(tmp_path, monkeypatch):
    packed(tmp_path / "kept.json.gz", a_run(tmp_path / "run", [flat(1.0)], settings={"gamma": 0.99}))
    (run,) = groups.find([tmp_path / "kept.json.gz"]).runs
    (group,) = groups.groups([run], {"vrm": {**DEFAULTS["vrm"], "gamma": 0.5}})
    assert group.seeds[0][0].config["hyperparameters"]["gamma"] == 0.99


def test_a_run_that_is_older_than_a_setting_gets_no_value_for_it_when_a_file_is_extended(tmp_path):
    file = tmp_path / "kept.json.gz"
    run = a_run(tmp_path / "run", [flat(1.0)], settings={"gamma": 0.9, "layers": [256, 256], "tau": 0.005})
    kept = packed(file, run)
    for value in (False, True):  # a later version adds the setting; a still later one changes its default
        results.write(file, kept, {"vrm": {**DEFAULTS["vrm"], "normalise": value}})
        kept = results.read(file)
        assert kept[0].config["hyperparameters"] == run.config["hyperparameters"]


def test_updates_are_kept_as_the_models_loss_between_evaluations(tmp_path):
    run = a_run(tmp_path / "run", [flat(1.0, 2.0)], updates=[*UPDATES, (15, {"negative_elbo": 1.0})])
    (kept,) = packed(tmp_path / "kept.json.gz", run)
    assert list(kept.rows(0, "update")) == [
        {"step": 10, "kind": "update", "negative_elbo": 7.0},
        {"step": 20, "kind": "update", "negative_elbo": 1.0},
    ]
    before, after = (model_loss(groups.groups([each])[0]) for each in (run, kept))
    np.testing.assert_array_equal(after.seeds, before.seeds)


def test_the_loss_of_a_model_that_predicts_without_an_elbo_is_kept_and_drawn(tmp_path):
    updates = [(5, {"loss_model": 8.0}), (10, {"loss_model": 6.0})]
    (kept,) = packed(
        tmp_path / "kept.json.gz", a_run(tmp_path / "run", [flat(1.0)], updates=updates, agent="predictive-sac")
    )
    assert draw_elbo(groups.groups([kept]), tmp_path / "elbo.png").exists()
    np.testing.assert_array_equal(model_loss(groups.groups([kept])[0]).seeds, [[7.0]])


def test_a_seed_that_diverged_and_a_run_that_goes_on_are_kept_as_they_are(tmp_path):
    a_folder(tmp_path / "diverged", [flat(1.0, 2.0), flat(1.0)], diverged=(1,))
    a_run(tmp_path / "going", [flat(1.0)], steps=100)
    going, diverged = runs = groups.find([tmp_path / "going", tmp_path / "diverged"]).runs
    kept = packed(tmp_path / "kept.json.gz", *runs)
    assert [groups.is_finished(run) for run in kept] == [True, False]
    assert [row["why"] for row in kept[0].rows(1, "diverged")] == ["a loss is not finite"]
    assert [groups.last_step(run, 0) for run in kept] == [groups.last_step(run, 0) for run in (diverged, going)]


def test_packing_again_changes_no_byte_and_adds_what_is_new(tmp_path):
    file = tmp_path / "kept.json.gz"
    first = packed(file, a_run(tmp_path / "a", [flat(1 / 3)], settings={"tau": 0.1, "gamma": 0.9}, updates=UPDATES))
    content = file.read_bytes()
    packed(file, *first)
    assert file.read_bytes() == content
    both = packed(file, *first, a_run(tmp_path / "b", [flat(2.0)]))
    assert [run.folder.name for run in both] == ["a", "b"]


def test_a_run_that_has_gone_on_takes_its_old_place_and_another_of_its_name_does_not(tmp_path):
    file = tmp_path / "kept.json.gz"
    old = packed(file, a_run(tmp_path / "x" / "run", [flat(1.0)], steps=20, started="monday"))
    (new,) = packed(file, *old, a_run(tmp_path / "y" / "run", [flat(1.0, 2.0)], started="monday"))
    assert groups.last_step(new, 0) == 20
    with pytest.raises(UserError, match="Two trainings are called run"):
        packed(file, new, a_run(tmp_path / "z" / "run", [flat(9.0)], started="tuesday"))
    assert groups.last_step(results.read(file)[0], 0) == 20


def test_where_runs_lay_on_this_machine_is_not_kept(tmp_path):
    command = ["beliefrl", "train", "--out", "/home/me/runs/first"]
    (kept,) = packed(tmp_path / "kept.json.gz", a_run(tmp_path / "run", [flat(1.0)], command=command))
    assert kept.config["command"][-1] == "runs/first"


@pytest.mark.parametrize(
    "content",
    [
        b"no gzip",
        gzip.compress(b"no json"),
        gzip.compress(b"{}"),
        gzip.compress(b'{"format": 1, "defaults": {}, "runs": [{"name": "a", "config": {}, "rows": {}}]}'),
        gzip.compress(b"{}")[:-9],
    ],
    ids=["no gzip", "no json", "empty", "no dates", "cut"],  # gzip's content has the time in it: no name of a test
)
def test_a_file_of_another_kind_is_an_error(tmp_path, content):
    (tmp_path / "kept.json.gz").write_bytes(content)
    with pytest.raises(UserError, match="cannot be read as a file of results"):
        groups.find([tmp_path / "kept.json.gz"])


def test_a_missing_file_and_one_of_a_later_version_are_errors(tmp_path):
    with pytest.raises(UserError, match="There is no file"):
        groups.find([tmp_path / "kept.json.gz"])
    (tmp_path / "kept.json.gz").write_bytes(gzip.compress(b'{"format": 2}'))
    with pytest.raises(UserError, match="has format 2"):
        groups.find([tmp_path / "kept.json.gz"])


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.name)
def test_every_file_of_results_here_can_be_drawn(path):
    runs = groups.find([path]).runs
    made = groups.groups([run for run in runs if groups.is_finished(run)] or runs, agents.defaults(), agents.before())
    assert all(group.curve().steps.size for group in made)


def test_a_kept_figure_is_drawn_by_one_command(tmp_path, capsys):
    (file,) = (str(path) for path in KEPT if path.name == "pendulum-without-sensors.json.gz")
    cli.main(["figure", "elbo", file, "-o", str(tmp_path / "elbo.png")])
    assert (tmp_path / "elbo.png").read_bytes().startswith(b"\x89PNG")
    cli.main(["figure", "table", file, "--agents", "vrm", "--tasks", "pendulum-v", "-o", str(tmp_path / "table.md")])
    assert "| pendulum-v | vrm | 0 to 2 | 15,000 | -285.3 ± 62.2 | -141.7 ± 22.4 |" in capsys.readouterr().out


def test_runs_are_chosen_by_name_and_drawn_up_to_a_step(tmp_path, capsys):
    file = tmp_path / "kept.json.gz"
    packed(file, a_run(tmp_path / "one", [flat(1.0, 2.0, 3.0)]), a_run(tmp_path / "two", [flat(8.0)], first=1))
    cli.main(["figure", "table", str(file), "--names", "o*", "--until", "20", "-o", str(tmp_path / "table.md")])
    assert "| pendulum-v | vrm | 0 | 20 | 2.0 |" in capsys.readouterr().out


def test_the_curve_of_one_run_is_drawn_and_of_two_it_is_asked_which(tmp_path, capsys):
    file = tmp_path / "kept.json.gz"
    packed(file, a_run(tmp_path / "one", [flat(1.0)]), a_run(tmp_path / "two", [flat(2.0)]))
    cli.main(["figure", "run", str(file), "--names", "two", "-o", str(tmp_path / "two.png")])
    assert (tmp_path / "two.png").exists()
    with pytest.raises(SystemExit):
        cli.main(["figure", "run", str(file)])
    assert "choose one of these 2" in capsys.readouterr().err


def test_a_report_has_the_runs_of_a_file_too(tmp_path):
    packed(tmp_path / "kept.json.gz", a_run(tmp_path / "one", [flat(1.0)]))
    assert "kept.json.gz/one" in write_report([tmp_path / "kept.json.gz"], tmp_path / "report.html").read_text()
