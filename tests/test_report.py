"""The report: its numbers are those of the metrics, and nothing that comes from a run can become HTML."""

import json
import os
import re

import numpy as np
import pytest
from scipy.stats import t as student

from beliefrl import agents
from beliefrl.analysis.palette import AGENTS, colours
from beliefrl.report import write_report
from beliefrl.report.data import statistics
from beliefrl.types import UserError
from browser import CHROMIUM, Page

EVIL = "</script><img src=x onerror=alert(1)>"
HOUR = {"started": "2026-01-01T10:00:00+00:00", "ended": "2026-01-01T11:00:00+00:00", "device": "cpu"}


def a_run(folder, seeds, agent="vrm", task="pendulum-v", steps=20, first=0, diverged=(), **config):
    """A folder with these evaluations of each seed: (step, returns with sampled actions[, successes])."""
    (folder / "metrics").mkdir(parents=True)
    options = {"seed": first, "seeds": len(seeds), "steps": steps}
    whole = {"agent": agent, "hyperparameters": {}, "task": task, "constants": {}, "options": options} | config
    (folder / "config.json").write_text(json.dumps(whole))
    for seed, rows in enumerate(seeds, first):
        lines = [{"step": 1, "kind": "update", "loss": 0.0}]
        for step, returns, *success in rows:
            rates = {"sampled_success": success[0], "mode_success": [True]} if success else {}
            lines.append({"step": step, "kind": "evaluation", "sampled": returns, "mode": [7.0], **rates})
        if seed in diverged:
            lines.append({"step": lines[-1]["step"] + 5, "kind": "diverged", "why": "a loss is not finite"})
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (folder / "metrics" / f"seed-{seed}.jsonl").write_text(text)
    return folder


TWO_SEEDS = [[(10, [1.0, 2.0]), (20, [3.0, 5.0])], [(10, [-1.0, 4.0]), (20, [7.0, 7.0])]]


def told(folder, **options):
    """What the page of the runs in a folder tells, read out of the page."""
    page = write_report([folder], folder / "page.html", **options).read_text()
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    return json.loads(found[1], parse_constant=pytest.fail)


def test_numbers_are_those_of_the_metrics(tmp_path):
    a_run(tmp_path / "run", TWO_SEEDS)
    (group,) = told(tmp_path)["groups"]
    assert (group["task"], group["label"], group["seeds"], group["steps"]) == ("pendulum-v", "vrm", [0, 1], 20)
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
    a_run(tmp_path / "run", TWO_SEEDS[:1])
    final = told(tmp_path)["groups"][0]["final"]["sampled"]
    assert final == {"count": 1, "mean": 4.0, "sem": None, "interval": None}


def test_seeds_of_several_runs_are_one_line(tmp_path):
    a_run(tmp_path / "a", TWO_SEEDS)
    a_run(tmp_path / "b", TWO_SEEDS[:1], first=2)
    page = told(tmp_path)
    (group,) = page["groups"]
    assert group["seeds"] == [0, 1, 2]
    assert [run["group"] for run in page["runs"]] == [0, 0]


def test_success_is_a_rate(tmp_path):
    a_run(tmp_path / "run", [[(20, [1.0, 1.0], [True, False])]])
    (group,) = told(tmp_path)["groups"]
    assert group["final"]["sampled_success"]["mean"] == 0.5
    assert group["final"]["mode_success"]["mean"] == 1.0


def test_unfinished_runs_are_listed_and_count_when_asked(tmp_path):
    a_run(tmp_path / "done", TWO_SEEDS)
    a_run(tmp_path / "going", [[(10, [9.0])]], agent="slac")
    a_run(tmp_path / "begun", [[]], agent="sac-mlp")
    page = told(tmp_path)
    assert [group["label"] for group in page["groups"]] == ["vrm"]
    of = {run["agent"]: run for run in page["runs"]}
    assert [of[agent]["finished"] for agent in ("vrm", "slac", "sac-mlp")] == [True, False, False]
    assert (of["slac"]["steps"], of["slac"]["of"], of["slac"]["group"]) == (10, 20, None)
    with_them = told(tmp_path, unfinished=True)["groups"]
    assert {group["label"]: group["unfinished"] for group in with_them} == {"vrm": False, "slac": True}


def test_no_finished_run_makes_a_page_too(tmp_path):
    a_run(tmp_path / "begun", [[]])
    assert told(tmp_path)["groups"] == []


def test_a_seed_that_diverged_is_left_out_and_told(tmp_path):
    a_run(tmp_path / "run", [TWO_SEEDS[0], TWO_SEEDS[1][:1]], diverged=[1])
    page = told(tmp_path)
    (group,) = page["groups"]
    assert group["diverged"] == {"1": 15}
    assert group["curves"]["sampled"]["seeds"] == [[1.5, 4.0], [1.5, None]]
    assert group["final"]["sampled"] == {"count": 1, "mean": 4.0, "sem": None, "interval": None}
    assert page["runs"][0]["diverged"] == ["seed 1: a loss is not finite"]


def test_where_every_seed_diverged_there_is_no_final_return(tmp_path):
    a_run(tmp_path / "run", [[(10, [1.0])], [(10, [2.0])]], diverged=[0, 1])
    (group,) = told(tmp_path)["groups"]
    assert group["final"]["sampled"]["mean"] is None
    assert group["curves"]["sampled"]["mean"] == [1.5]


def test_what_is_not_finite_is_null(tmp_path):
    a_run(tmp_path / "run", [[(10, [float("nan")]), (20, [float("inf")])]], hyperparameters={"gamma": float("nan")})
    (group,) = told(tmp_path)["groups"]
    assert group["curves"]["sampled"]["mean"] == [None, None]


def test_time_is_the_sum_of_all_sessions(tmp_path):
    a_run(tmp_path / "a", TWO_SEEDS, **HOUR, resumed=[HOUR])
    a_run(tmp_path / "b", TWO_SEEDS, **HOUR, resumed=[{"started": HOUR["started"]}])
    a_run(tmp_path / "c", TWO_SEEDS)
    assert [run["seconds"] for run in told(tmp_path)["runs"]] == [7200.0, None, None]


def test_the_plain_agents_line_is_not_dashed(tmp_path):
    a_run(tmp_path / "a", TWO_SEEDS, hyperparameters={"gamma": 0.9})
    a_run(tmp_path / "b", TWO_SEEDS, hyperparameters={})
    assert [(label["name"], label["dash"]) for label in told(tmp_path)["labels"]] == [("vrm gamma=0.9", 1), ("vrm", 0)]


def test_settings_are_those_that_differ_from_the_agents(tmp_path):
    a_run(tmp_path / "a", TWO_SEEDS, hyperparameters={"gamma": 0.99, "d_size": 7, "policy_layers": [256, 256]})
    a_run(tmp_path / "b", TWO_SEEDS, agent="vrm-single", hyperparameters={"models": "single"})
    a_run(tmp_path / "c", TWO_SEEDS, agent="mine:Agent", hyperparameters={"x": 1})
    assert [run["settings"] for run in told(tmp_path)["runs"]] == [["d_size=7"], [], None]


def test_videos_and_curves_are_linked_from_where_the_page_lies(tmp_path):
    run = a_run(tmp_path / "runs" / "a run", TWO_SEEDS)
    for name in ("curve.png", "other.png", "videos/seed 0.mp4", "x.gif"):
        (run / name).parent.mkdir(exist_ok=True)
        (run / name).write_bytes(b"")
    (tmp_path / "pages").mkdir()
    page = write_report([tmp_path], tmp_path / "pages" / "page.html").read_text()
    addresses = re.findall(r'"address":"(.*?)"', page)
    assert addresses == [f"../runs/a%20run/{name}" for name in ("curve.png", "videos/seed%200.mp4", "x.gif")]


def test_text_of_runs_cannot_become_html(tmp_path):
    run = a_run(tmp_path / "run", TWO_SEEDS, agent=EVIL, task=EVIL, command=[EVIL], hyperparameters={EVIL: EVIL})
    (run / f"{EVIL.replace('/', '')}.gif").write_bytes(b"")
    page = write_report([tmp_path], tmp_path / "page.html").read_text()
    assert "<img" not in page
    assert page.count("</script>") == 2
    assert told(tmp_path)["groups"][0]["task"] == EVIL


def test_a_name_may_be_empty(tmp_path):
    a_run(tmp_path / "run", TWO_SEEDS, agent="", task="")
    assert told(tmp_path)["labels"][0]["name"] == ""


def test_a_page_is_there_whole_or_not_at_all(tmp_path, monkeypatch):
    a_run(tmp_path / "run", TWO_SEEDS)
    page = write_report([tmp_path], tmp_path / "page.html")
    before = page.read_text()
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(UserError, match="No space left"):
        write_report([tmp_path], page, unfinished=True)
    assert page.read_text() == before


@pytest.mark.parametrize(("out", "said"), [("page.txt", "call it"), ("missing/page.html", "no folder")])
def test_a_page_that_cannot_be_written_is_refused(tmp_path, out, said):
    a_run(tmp_path / "run", TWO_SEEDS)
    with pytest.raises(UserError, match=said):
        write_report([tmp_path], tmp_path / out)


def test_every_agent_has_a_colour_of_its_own():
    assert set(agents.names()) == set(AGENTS)
    assert len(set(AGENTS.values())) == len(AGENTS)
    assert colours(["other", "slac", "vrm"])["slac"] == colours(["slac"])["slac"] == AGENTS["slac"]


def test_labels_of_one_agent_have_different_colours():
    labels = ["vrm gamma=0.9", "vrm", "mine", "vrm gamma=0.8"]
    found = colours(labels)
    assert list(found) == labels
    assert found["vrm"] == AGENTS["vrm"]
    assert len(set(found.values())) == 4


@pytest.fixture(scope="module")
def a_page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    success = [[(step, [value], [seed]) for (step, (value, *_)) in rows] for seed, rows in enumerate(TWO_SEEDS)]
    a_run(folder / "a", TWO_SEEDS, **HOUR)
    a_run(folder / "b", TWO_SEEDS[:1], agent="slac", hyperparameters={"gamma": 0.5})
    a_run(folder / "c", success, task="target-reaching")
    a_run(folder / "d", TWO_SEEDS, agent=EVIL, task=EVIL, command=[EVIL, "a b"])
    a_run(folder / "e", [TWO_SEEDS[0][:1]], agent="sac-mlp")
    (folder / "d" / "curve.png").write_bytes(b"")
    return write_report([folder], folder / "page.html")


VISIBLE_ROWS = "[...document.querySelectorAll('#final tbody tr:not([hidden])')].map((row) => row.cells[1].innerText)"
PANELS = "[...document.querySelectorAll('.panel:not([hidden]) > figcaption')].map((name) => name.innerText)"
LINES = "[...document.querySelectorAll('.panel:not([hidden]) .line')].map((line) => line.dataset.label)"


def browser_test(test):
    return pytest.mark.slow(pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")(test))


@pytest.fixture
def opened(a_page):
    with Page(a_page) as page:
        yield page
        assert page.console == []
        assert page.requests == [a_page.as_uri()]


@browser_test
def test_filters_hide_curves_and_rows(opened):
    tasks = ["pendulum-v", "target-reaching", EVIL]
    assert opened.run(PANELS) == tasks
    assert sorted(opened.run(VISIBLE_ROWS)) == sorted(["pendulum-v", *tasks])
    opened.run("document.querySelector('[name=task][value=pendulum-v]').click()")
    assert opened.run(PANELS) == tasks[1:]
    assert sorted(opened.run(VISIBLE_ROWS)) == sorted(tasks[1:])
    opened.run("document.querySelector('[name=task][value=pendulum-v]').click()")
    opened.run("document.querySelector('[name=label][value=vrm]').click()")
    assert opened.run(LINES) == ["slac", EVIL]
    assert opened.run(VISIBLE_ROWS) == ["pendulum-v", EVIL]


@browser_test
def test_hover_shows_the_numbers(opened):
    opened.hover(".panel > svg", right=0.97)
    shown = opened.run("document.querySelector('.tip').innerText")
    assert "step 20" in shown
    assert re.search(r"vrm\s+5.50 ± 1.50\s+2 seeds", shown)
    assert re.search(r"slac\s+4.00\s+1 seed\b", shown)
    opened.run("document.querySelector('[value=mode]').click()")
    opened.hover(".panel > svg", right=0.5)
    assert re.search(r"step 10\s+vrm\s+7.00 ± 0.00", opened.run("document.querySelector('.tip').innerText"))


@browser_test
def test_success_and_seeds_are_switched(opened):
    opened.run("document.querySelector('[value=_success]').click()")
    assert opened.run(PANELS) == ["target-reaching"]
    assert opened.run("document.querySelectorAll('.panel:not([hidden]) .seed').length") == 2
    opened.run("document.querySelector('[name=seeds]').click()")
    assert opened.run("document.querySelectorAll('.panel:not([hidden]) .seed').length") == 0
    opened.hover(".panel:not([hidden]) > svg", right=0.97)
    assert "50 % ± 50" in opened.run("document.querySelector('.panel:not([hidden]) .tip').innerText")


@browser_test
def test_headings_sort(opened):
    names = "[...document.querySelectorAll('#final tbody tr')].map((row) => row.cells[4].innerText.split(' ')[0])"
    opened.run("document.querySelectorAll('#final thead button')[4].click()")
    falling = opened.run(names)
    assert falling[0] == "5.50"
    opened.run("document.querySelectorAll('#final thead button')[4].click()")
    assert list(map(float, opened.run(names))) == sorted(map(float, falling))


@browser_test
def test_an_opened_run_shows_its_configuration_as_text(opened):
    other, run = (f"document.querySelectorAll('#settings > details')[{index}]" for index in (1, 3))
    for each in (other, run):
        opened.run(f"{each}.querySelector('summary').click()")
    opened.frame()
    assert "gamma=0.5" in opened.run(f"{other}.innerText")
    assert opened.run(f"{run}.querySelector('dl code').innerText") == f"'{EVIL}' 'a b'"
    assert json.loads(opened.run(f"{run}.querySelector('pre').textContent"))["task"] == EVIL
    assert opened.run(f"{run}.querySelector('.media a').getAttribute('href')") == "d/curve.png"
    assert opened.run("document.querySelectorAll('[onerror]').length") == 0
    opened.requests = [address for address in opened.requests if not address.endswith("/d/curve.png")]


@browser_test
def test_the_pages_policy_forbids_other_scripts_and_the_network(a_page):
    fetched = "fetch('https://example.invalid').catch(() => {})"
    with Page(a_page) as page:
        page.run("document.body.insertAdjacentHTML('beforeend', '<img src=missing.png onerror=\"window.bad = 1\">')")
        page.run(
            "new Promise((done) => {const blocked = []; "
            "document.addEventListener('securitypolicyviolation', (event) => blocked.push(event.effectiveDirective)); "
            f"{fetched}; setTimeout(() => {{window.blocked = blocked; done()}}, 300)}})"
        )
        assert "connect-src" in page.run("window.blocked")
        assert page.run("window.bad === undefined")


@browser_test
def test_a_phone_scrolls_only_downwards(a_page):
    with Page(a_page, width=390, height=844, mobile=True) as page:
        assert page.run("document.documentElement.scrollWidth") == 390
        assert page.run("document.querySelector('.panel > svg').getBoundingClientRect().width") <= 390
