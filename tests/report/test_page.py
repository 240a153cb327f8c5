"""The page of a report in headless Chromium, used as by a reader; skipped without a Chromium on the PATH."""

import base64
import itertools
import json
import os
import pathlib
import re
import select
import shutil
import subprocess
import sys
import tempfile
from importlib import resources

import pytest

from beliefrl.report import write_report
from inputs import EVIL, HOUR, TWO_SEEDS, a_folder

NODE = shutil.which("node")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

# Chromium reads from file 3 and writes to file 4. A new process sets this up, since a fork would disturb JAX's threads
FROM_3_TO_4 = "import os, sys; [os.dup2(int(sys.argv[i]), i + 2) for i in (1, 2)]; os.execv(sys.argv[3], sys.argv[3:])"


class Page:
    """One page. `console` holds its messages and errors, `requests` the addresses that it requested."""

    def __init__(self, path, width=1280, height=900, mobile=False, scheme="light"):
        read, self._to = os.pipe()
        from_it, write = os.pipe()
        self._home = tempfile.mkdtemp()
        options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--disable-gpu", "--disable-dev-shm-usage"]
        options += ["--remote-debugging-pipe", f"--user-data-dir={self._home}"]
        self._browser = subprocess.Popen(
            [sys.executable, "-c", FROM_3_TO_4, str(read), str(write), str(CHROMIUM), *options, "about:blank"],
            pass_fds=(read, write), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(read)
        os.close(write)
        self._from = os.fdopen(from_it, "rb")
        self._numbers, self._buffer, self._session = itertools.count(1), b"", None
        self.console, self.requests, self._loaded = [], [], False
        target = next(t for t in self._ask("Target.getTargets")["targetInfos"] if t["type"] == "page")["targetId"]
        self._session = self._ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._ask(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
        self._ask("Emulation.setDeviceMetricsOverride", **size)
        self._ask("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        self._ask("Page.navigate", url=pathlib.Path(path).resolve().as_uri())
        while not self._loaded:
            self._receive()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        os.close(self._to)
        self._browser.kill()
        self._browser.wait()
        self._from.close()
        shutil.rmtree(self._home, ignore_errors=True)

    def _ask(self, method, **parameters):
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while (answer := self._receive()).get("id") != number:
            pass
        assert "error" not in answer, answer["error"]
        return answer["result"]

    def _receive(self):
        while b"\0" not in self._buffer:
            assert select.select([self._from], [], [], 60)[0], "Chromium does not answer"
            more = os.read(self._from.fileno(), 1 << 16)
            assert more, "Chromium has ended"
            self._buffer += more
        message, _, self._buffer = self._buffer.partition(b"\0")
        event = json.loads(message)
        match event.get("method"):
            case "Runtime.exceptionThrown" | "Runtime.consoleAPICalled" | "Log.entryAdded":
                self.console.append(event["params"])
            case "Network.requestWillBeSent":
                self.requests.append(event["params"]["request"]["url"])
            case "Page.loadEventFired":
                self._loaded = True
        return event

    def run(self, script):
        """The value of an expression in the page."""
        result = self._ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def frame(self):
        """Wait until the page has been redrawn."""
        self.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done())))")

    def hover(self, selector, right=0.5):
        """Move the mouse over an element, to a fraction of its width and half its height."""
        box = f"document.querySelector({json.dumps(selector)})"
        self.run(f"{box}.scrollIntoView({{block: 'center'}})")
        at = self.run(f"(() => {{const b = {box}.getBoundingClientRect(); return [b.x, b.y, b.width, b.height]}})()")
        self._ask("Input.dispatchMouseEvent", type="mouseMoved", x=at[0] + right * at[2], y=at[1] + 0.5 * at[3])
        self.frame()

    def screenshot(self, path, whole=True):
        """A screenshot of the whole page."""
        self.frame()
        picture = self._ask("Page.captureScreenshot", captureBeyondViewport=whole)
        pathlib.Path(path).write_bytes(base64.b64decode(picture["data"]))


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


@pytest.mark.skipif(NODE is None, reason="there is no Node.js")
@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (12_500, 12_600, "12.5k 12.55k 12.6k"),
        (-12_600, -12_500, "-12.6k -12.55k -12.5k"),
        (1_002_500, 1_002_510, "1.0025M 1.002505M 1.00251M"),
        (0, 40_000, "0 20k 40k"),
        (0, 0.2, "0 0.1 0.2"),
    ],
)
def test_ticks_have_all_of_their_digits(low, high, labels):
    page = "const document = {getElementById: () => ({textContent: '{}'})};"
    shown = f"console.log(ticks({low}, {high}, 2).map(short).join(' '))"
    script = "\n".join([page, (resources.files("beliefrl.report") / "curves.js").read_text(encoding="utf-8"), shown])
    done = subprocess.run([NODE, "-"], input=script, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == labels
