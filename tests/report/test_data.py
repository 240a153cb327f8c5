"""The report: its numbers are those of the logs, and nothing from a run can become HTML."""

import json
import os
import pathlib
import re

import numpy as np
import pytest
from scipy.stats import t as student

from beliefrl import catalogue
from beliefrl.analysis.panels import AGENTS, colours
from beliefrl.errors import UserError
from beliefrl.report import data, write_report
from beliefrl.report.data import statistics
from inputs import EVIL, HOUR, TWO_SEEDS, a_folder


def page_data(folder, **options):
    """The JSON in the report on the runs in a folder."""
    page = write_report([folder], folder / "page.html", **options).read_text()
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    return json.loads(found[1], parse_constant=pytest.fail)


def test_numbers_are_those_of_the_metrics(tmp_path):
    a_folder(tmp_path / "run", TWO_SEEDS)
    (group,) = page_data(tmp_path)["groups"]
    assert (group["task"], group["label"], group["seeds"], group["steps"]) == ("pendulum-v", "vrm", [0, 1], 20)
    assert group["axis"] == "environment steps"
    curve = group["curves"]["sampled"]
    assert curve["steps"] == [10, 20]
    assert curve["seeds"] == [[1.5, 4.0], [1.5, 7.0]]
    assert curve["mean"] == [1.5, 5.5]
    assert curve["sem"] == [0.0, 1.5]
    assert curve["count"] == [2, 2]
    assert group["final"]["sampled"]["mean"] == 5.5
    assert group["final"]["mode"]["mean"] == 7.0
    assert "sampled_success" not in group["curves"]


def test_the_interval_is_students():
    seeds = np.array([3.0, -1.0, 4.0, 1.0, 5.0])
    found = statistics(seeds)
    error = seeds.std(ddof=1) / np.sqrt(5)
    np.testing.assert_allclose(found["interval"], student.interval(0.95, 4, seeds.mean(), error), rtol=1e-6)
    np.testing.assert_allclose((found["mean"], found["sem"]), (seeds.mean(), error), rtol=1e-6)


def test_one_seed_has_no_spread(tmp_path):
    a_folder(tmp_path / "run", TWO_SEEDS[:1])
    final = page_data(tmp_path)["groups"][0]["final"]["sampled"]
    assert final == {"count": 1, "mean": 4.0, "sem": None, "interval": None}


def test_seeds_of_several_runs_are_one_line(tmp_path):
    a_folder(tmp_path / "a", TWO_SEEDS)
    a_folder(tmp_path / "b", TWO_SEEDS[:1], first=2)
    page = page_data(tmp_path)
    (group,) = page["groups"]
    assert group["seeds"] == [0, 1, 2]
    assert [run["group"] for run in page["runs"]] == [0, 0]


def test_success_is_a_rate(tmp_path):
    a_folder(tmp_path / "run", [[(20, [1.0, 1.0], [True, False])]])
    (group,) = page_data(tmp_path)["groups"]
    assert group["final"]["sampled_success"]["mean"] == 0.5
    assert group["final"]["mode_success"]["mean"] == 1.0


def test_unfinished_runs_are_listed_and_count_when_asked(tmp_path):
    a_folder(tmp_path / "done", TWO_SEEDS)
    a_folder(tmp_path / "going", [[(10, [9.0])]], agent="slac")
    a_folder(tmp_path / "begun", [[]], agent="sac-mlp")
    page = page_data(tmp_path)
    assert [group["label"] for group in page["groups"]] == ["vrm"]
    of = {run["agent"]: run for run in page["runs"]}
    assert [of[agent]["finished"] for agent in ("vrm", "slac", "sac-mlp")] == [True, False, False]
    assert (of["slac"]["steps"], of["slac"]["of"], of["slac"]["group"]) == (10, 20, None)
    with_them = page_data(tmp_path, unfinished=True)["groups"]
    assert {group["label"]: group["unfinished"] for group in with_them} == {"vrm": False, "slac": True}


def test_a_seed_that_diverged_before_its_first_evaluation_does_not_hide_an_unfinished_run(tmp_path):
    a_folder(tmp_path / "going", [TWO_SEEDS[0][:1], []], diverged=[1])
    (group,) = page_data(tmp_path, unfinished=True)["groups"]
    assert group["curves"]["sampled"]["seeds"] == [[1.5], [None]]


def test_no_finished_run_makes_a_page_too(tmp_path):
    a_folder(tmp_path / "begun", [[]])
    assert page_data(tmp_path)["groups"] == []


def test_a_seed_that_diverged_is_left_out_and_page_data(tmp_path):
    a_folder(tmp_path / "run", [TWO_SEEDS[0], TWO_SEEDS[1][:1]], diverged=[1])
    page = page_data(tmp_path)
    (group,) = page["groups"]
    assert group["diverged"] == {"1": 15}
    assert group["curves"]["sampled"]["seeds"] == [[1.5, 4.0], [1.5, None]]
    assert group["final"]["sampled"] == {"count": 1, "mean": 4.0, "sem": None, "interval": None}
    assert page["runs"][0]["diverged"] == ["seed 1: a loss is not finite"]


def test_a_group_without_a_curve_and_one_with_a_shorter_curve_are_named(tmp_path):
    a_folder(tmp_path / "lost", [[], []], agent="slac", diverged=[0, 1])
    a_folder(tmp_path / "done", TWO_SEEDS)
    going = a_folder(tmp_path / "going", [TWO_SEEDS[0][:1]], first=2)
    lost = "slac on pendulum-v has no curve: all seeds have diverged"
    page = page_data(tmp_path)
    assert [group["label"] for group in page["groups"]] == ["vrm"]
    assert page["damage"] == [lost]
    assert {pathlib.Path(run["folder"]).name: run["group"] for run in page["runs"]} == {
        "lost": None,
        "done": 0,
        "going": None,
    }
    ends = f"{going}, seed 2, ends at 10, and another seed at 20"
    early = f"vrm on pendulum-v ends at step 10, the last that all of its seeds have: {ends}"
    assert page_data(tmp_path, unfinished=True)["damage"] == [lost, early]


def test_a_seed_that_was_trained_twice_counts_once_and_its_other_run_names_it(tmp_path):
    a_folder(tmp_path / "first", TWO_SEEDS, started="2026-01-01T00:00:00+00:00")
    again = [(step, [100.0]) for step, _ in TWO_SEEDS[1]]
    a_folder(tmp_path / "again", [again], first=1, started="2026-01-02T00:00:00+00:00")
    page = page_data(tmp_path)
    (group,) = page["groups"]
    assert group["seeds"] == [0, 1]
    assert group["curves"]["sampled"]["seeds"] == [[1.5, 4.0], [100.0, 100.0]]
    assert {run["seeds"][0]: run["elsewhere"] for run in page["runs"]} == {0: [1], 1: []}


def test_where_every_seed_diverged_there_is_no_final_return(tmp_path):
    a_folder(tmp_path / "run", [[(10, [1.0])], [(10, [2.0])]], diverged=[0, 1])
    (group,) = page_data(tmp_path)["groups"]
    assert group["final"]["sampled"]["mean"] is None
    assert group["curves"]["sampled"]["mean"] == [1.5]


def test_what_is_not_finite_is_null(tmp_path):
    a_folder(tmp_path / "run", [[(10, [float("nan")]), (20, [float("inf")])]], hyperparameters={"gamma": float("nan")})
    (group,) = page_data(tmp_path)["groups"]
    assert group["curves"]["sampled"]["mean"] == [None, None]


def test_time_is_the_sum_of_all_sessions(tmp_path):
    a_folder(tmp_path / "a", TWO_SEEDS, **HOUR, resumed=[HOUR])
    a_folder(tmp_path / "b", TWO_SEEDS, **HOUR, resumed=[{"started": HOUR["started"]}])
    a_folder(tmp_path / "c", TWO_SEEDS)
    assert [run["seconds"] for run in page_data(tmp_path)["runs"]] == [7200.0, None, None]


def test_the_plain_agents_line_is_not_dashed(tmp_path):
    a_folder(tmp_path / "a", TWO_SEEDS, hyperparameters={"gamma": 0.9})
    a_folder(tmp_path / "b", TWO_SEEDS, hyperparameters={})
    assert [(label["name"], label["dash"]) for label in page_data(tmp_path)["labels"]] == [
        ("vrm gamma=0.9", 1),
        ("vrm", 0),
    ]


def test_settings_are_those_that_differ_from_the_agents_and_all_of_an_own_agent(tmp_path):
    a_folder(tmp_path / "a", TWO_SEEDS, hyperparameters={"gamma": 0.99, "d_size": 7, "policy_layers": [256, 256]})
    a_folder(tmp_path / "b", TWO_SEEDS, agent="vrm-single", hyperparameters={"models": "single"})
    a_folder(tmp_path / "c", TWO_SEEDS, agent="mine:Agent", hyperparameters={"x": 1})
    assert [run["settings"] for run in page_data(tmp_path)["runs"]] == [["d_size=7"], [], ["x=1"]]


def test_a_picture_on_another_drive_has_an_absolute_address(tmp_path, monkeypatch):
    """Windows has no relative path from one drive to another."""

    def refuse(*_):
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(data.os.path, "relpath", refuse)
    assert data._link(tmp_path, tmp_path / "a b.gif") == {"name": "a b.gif", "address": f"file://{tmp_path}/a%20b.gif"}


def test_videos_and_curves_are_linked_from_where_the_page_lies(tmp_path):
    run = a_folder(tmp_path / "runs" / "a run", TWO_SEEDS)
    for name in ("curve.png", "other.png", "videos/seed 0.mp4", "x.gif"):
        (run / name).parent.mkdir(exist_ok=True)
        (run / name).write_bytes(b"")
    (tmp_path / "pages").mkdir()
    page = write_report([tmp_path], tmp_path / "pages" / "page.html").read_text()
    addresses = re.findall(r'"address":"(.*?)"', page)
    assert addresses == [f"../runs/a%20run/{name}" for name in ("curve.png", "videos/seed%200.mp4", "x.gif")]


def test_a_page_is_written_while_a_training_removes_its_checkpoints(tmp_path, monkeypatch):
    run = a_folder(tmp_path / "run", TWO_SEEDS)
    (run / "checkpoints" / "000001").mkdir(parents=True)
    scandir = os.scandir

    def removed(path="."):
        if "checkpoints" in os.fspath(path):
            raise FileNotFoundError(2, "No such file or directory", path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", removed)
    assert len(page_data(tmp_path)["runs"]) == 1


def test_action_repeat_is_named_wherever_the_task_is(tmp_path):
    a_folder(tmp_path / "run", TWO_SEEDS, constants={"steps_per_action": 2})
    page = page_data(tmp_path)
    assert {each["task"] for each in (*page["groups"], *page["runs"])} == {"pendulum-v steps_per_action=2"}
    assert page["groups"][0]["axis"] == "steps of the agent"


def test_text_of_runs_cannot_become_html(tmp_path):
    run = a_folder(tmp_path / "run", TWO_SEEDS, agent=EVIL, task=EVIL, command=[EVIL], hyperparameters={EVIL: EVIL})
    (run / f"{EVIL.replace('/', '')}.gif").write_bytes(b"")
    page = write_report([tmp_path], tmp_path / "page.html").read_text()
    assert "<img" not in page
    assert page.count("</script>") == 2
    assert page_data(tmp_path)["groups"][0]["task"] == EVIL


def test_a_name_may_be_empty(tmp_path):
    a_folder(tmp_path / "run", TWO_SEEDS, agent="", task="")
    assert page_data(tmp_path)["labels"][0]["name"] == ""


def test_a_page_is_there_whole_or_not_at_all(tmp_path, monkeypatch):
    a_folder(tmp_path / "run", TWO_SEEDS)
    page = write_report([tmp_path], tmp_path / "page.html")
    before = page.read_text()
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(UserError, match="No space left"):
        write_report([tmp_path], page, unfinished=True)
    assert page.read_text() == before


def test_runs_that_cannot_be_read_and_damaged_lines_are_page_data(tmp_path):
    good, bad = a_folder(tmp_path / "good", TWO_SEEDS), a_folder(tmp_path / "bad", TWO_SEEDS)
    (bad / "config.json").write_bytes(b"\x00\xff")
    log = good / "metrics" / "seed-0.jsonl"
    log.write_text(f'{EVIL}\n{log.read_text()}{{"half')
    sentences = []
    page = page_data(tmp_path, note=sentences.append)
    assert page["damage"] == sentences
    assert "bad/config.json cannot be read" in sentences[0]
    assert "Line 1 of" in sentences[1]
    assert len(sentences) == 2
    assert [run["folder"] for run in page["runs"]] == [str(good)]
    assert page["groups"][0]["curves"]["sampled"]["seeds"] == [[1.5, 4.0], [1.5, 7.0]]


@pytest.mark.parametrize(("out", "message"), [("page.txt", "must end in .html"), ("missing/page.html", "no folder")])
def test_a_page_that_cannot_be_written_is_refused(tmp_path, out, message):
    a_folder(tmp_path / "run", TWO_SEEDS)
    with pytest.raises(UserError, match=message):
        write_report([tmp_path], tmp_path / out)


def test_every_agent_has_a_colour_of_its_own():
    assert set(catalogue.agent_names()) == set(AGENTS)
    assert len(set(AGENTS.values())) == len(AGENTS)
    assert colours(["other", "slac", "vrm"])["slac"] == colours(["slac"])["slac"] == AGENTS["slac"]


def test_labels_of_one_agent_have_different_colours():
    labels = ["vrm gamma=0.9", "vrm", "mine", "vrm gamma=0.8"]
    found = colours(labels)
    assert list(found) == labels
    assert found["vrm"] == AGENTS["vrm"]
    assert len(set(found.values())) == 4
