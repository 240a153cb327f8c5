"""The page of a report in headless Chromium, used as by a reader; skipped without Chromium."""

import json
import re

import pytest

from beliefrl.report import write_report
from browser import CHROMIUM, Page
from written import EVIL, HOUR, TWO_SEEDS, a_folder


@pytest.fixture(scope="module")
def a_page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    success = [[(step, [value], [seed]) for (step, (value, *_)) in rows] for seed, rows in enumerate(TWO_SEEDS)]
    a_folder(folder / "a", TWO_SEEDS, **HOUR)
    a_folder(folder / "b", TWO_SEEDS[:1], agent="slac", hyperparameters={"gamma": 0.5})
    a_folder(folder / "c", success, task="target-reaching")
    a_folder(folder / "d", TWO_SEEDS, agent=EVIL, task=EVIL, command=[EVIL, "a b"])
    a_folder(folder / "e", [TWO_SEEDS[0][:1]], agent="sac-mlp")
    (folder / "d" / "curve.png").write_bytes(b"")
    return write_report([folder], folder / "page.html")


VISIBLE_ROWS = "[...document.querySelectorAll('#final tbody tr:not([hidden])')].map((row) => row.cells[1].innerText)"
PANELS = "[...document.querySelectorAll('.panel:not([hidden]) > figcaption')].map((name) => name.innerText)"
LINES = "[...document.querySelectorAll('.panel:not([hidden]) .line')].map((line) => line.dataset.label)"


def browser_test(test):
    return pytest.mark.slow(pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")(test))


@pytest.fixture
def browser_page(a_page):
    with Page(a_page) as page:
        yield page
        assert page.console == []
        assert page.requests == [a_page.as_uri()]


@browser_test
def test_filters_hide_curves_and_rows(browser_page):
    tasks = ["pendulum-v", "target-reaching", EVIL]
    assert browser_page.run(PANELS) == tasks
    assert sorted(browser_page.run(VISIBLE_ROWS)) == sorted(["pendulum-v", *tasks])
    browser_page.run("document.querySelector('[name=task][value=pendulum-v]').click()")
    assert browser_page.run(PANELS) == tasks[1:]
    assert sorted(browser_page.run(VISIBLE_ROWS)) == sorted(tasks[1:])
    browser_page.run("document.querySelector('[name=task][value=pendulum-v]').click()")
    browser_page.run("document.querySelector('[name=label][value=vrm]').click()")
    assert browser_page.run(LINES) == ["slac", EVIL]
    assert browser_page.run(VISIBLE_ROWS) == ["pendulum-v", EVIL]


@browser_test
def test_hover_shows_the_numbers(browser_page):
    browser_page.hover(".panel > svg", right=0.97)
    shown = browser_page.run("document.querySelector('.tip').innerText")
    assert "step 20" in shown
    assert re.search(r"vrm\s+5.50 ± 1.50\s+2 seeds", shown)
    assert re.search(r"slac\s+4.00\s+1 seed\b", shown)
    browser_page.run("document.querySelector('[value=mode]').click()")
    browser_page.hover(".panel > svg", right=0.5)
    assert re.search(r"step 10\s+vrm\s+7.00 ± 0.00", browser_page.run("document.querySelector('.tip').innerText"))


@browser_test
def test_success_and_seeds_are_switched(browser_page):
    browser_page.run("document.querySelector('[value=_success]').click()")
    assert browser_page.run(PANELS) == ["target-reaching"]
    assert browser_page.run("document.querySelectorAll('.panel:not([hidden]) .seed').length") == 2
    browser_page.run("document.querySelector('[name=seeds]').click()")
    assert browser_page.run("document.querySelectorAll('.panel:not([hidden]) .seed').length") == 0
    browser_page.hover(".panel:not([hidden]) > svg", right=0.97)
    assert "50 % ± 50" in browser_page.run("document.querySelector('.panel:not([hidden]) .tip').innerText")


@browser_test
def test_headings_sort(browser_page):
    names = "[...document.querySelectorAll('#final tbody tr')].map((row) => row.cells[4].innerText.split(' ')[0])"
    browser_page.run("document.querySelectorAll('#final thead button')[4].click()")
    falling = browser_page.run(names)
    assert falling[0] == "5.50"
    browser_page.run("document.querySelectorAll('#final thead button')[4].click()")
    assert list(map(float, browser_page.run(names))) == sorted(map(float, falling))


@browser_test
def test_an_opened_run_shows_its_configuration_as_text(browser_page):
    other, run = (f"document.querySelectorAll('#settings > details')[{index}]" for index in (1, 3))
    for each in (other, run):
        browser_page.run(f"{each}.querySelector('summary').click()")
    browser_page.frame()
    assert "gamma=0.5" in browser_page.run(f"{other}.innerText")
    assert browser_page.run(f"{run}.querySelector('dl code').innerText") == f"'{EVIL}' 'a b'"
    assert json.loads(browser_page.run(f"{run}.querySelector('pre').textContent"))["task"] == EVIL
    assert browser_page.run(f"{run}.querySelector('.media a').getAttribute('href')") == "d/curve.png"
    assert browser_page.run("document.querySelectorAll('[onerror]').length") == 0
    browser_page.requests = [address for address in browser_page.requests if not address.endswith("/d/curve.png")]


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
    with Page(a_page, width=360, height=740, mobile=True) as page:
        assert page.run("document.documentElement.scrollWidth") == 360
        assert page.run("document.querySelector('.panel > svg').getBoundingClientRect().width") <= 360


@browser_test
@pytest.mark.parametrize("width", [360, 600])
def test_a_phone_shows_every_cell_of_every_table_with_its_heading(a_page, width):
    """Phones hide scroll bars, so a reader would not notice columns beyond the edge."""
    with Page(a_page, width=width, height=740, mobile=True) as page:
        rights = page.run("[...document.querySelectorAll('.box *')].map((part) => part.getBoundingClientRect().right)")
        assert len(rights) > 50
        assert max(rights) <= width
        mean = "document.querySelectorAll('#final tbody tr')[0].cells[4]"
        assert page.run(f"getComputedStyle({mean}, '::before').content") == '"return, sampled actions"'
        page.run("document.querySelectorAll('#final thead button')[4].click()")
        assert page.run("document.querySelector('#final [aria-sort]').innerText").startswith("return, sampled actions")
