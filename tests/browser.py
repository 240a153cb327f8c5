"""Headless Chromium, controlled by the DevTools protocol over a pipe; it needs only a Chromium on the PATH."""

import base64
import itertools
import json
import os
import pathlib
import select
import shutil
import subprocess
import sys
import tempfile

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
