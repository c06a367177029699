"""A headless browser controlled over a pipe: console messages, page contents and network requests."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
OPTIONS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--remote-debugging-pipe")
START = """
import os, sys
read, write = (os.dup(int(number)) for number in sys.argv[1:3])
for number, place in ((read, 3), (write, 4)):
    os.dup2(number, place)
    os.set_inheritable(place, True)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""The browser reads 3 and writes 4."""


class Tab:
    """A page in the browser.

    Attributes:
        said: console messages, errors and exceptions.
        asked: requested addresses other than data URLs; the page itself is removed.
    """

    def __init__(self, commands, answers):
        self._commands, self._answers, self._session = commands, answers, None
        self._read, self._last = b"", 0
        self.said, self.asked = [], []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        self._last += 1
        session = {} if self._session is None else {"sessionId": self._session}
        message = {"id": self._last, "method": method, "params": parameters, **session}
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._last:
            pass
        assert "error" not in answer, answer
        return answer["result"]

    def open(self, path, width, height=800):
        """Show a file in a window of this size and wait until it is loaded."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.said.clear()
        self.asked.clear()
        address = path.resolve().as_uri()
        self.call("Page.navigate", url=address)
        self.wait("document.readyState === 'complete' && location.href !== 'about:blank'")
        assert self.asked.pop(0) == address

    def ask(self, expression):
        """Return the value of an expression, or of its promise."""
        options = {"expression": expression, "returnByValue": True, "awaitPromise": True}
        result = self.call("Runtime.evaluate", **options)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait(self, condition):
        """Wait until an expression is true."""
        poll = f"(async () => {{ while (!({condition})) await new Promise(done => setTimeout(done, 20)); }})()"
        self.ask(poll)

    def _next(self):
        while b"\0" not in self._read:
            piece = os.read(self._answers, 2**20)
            assert piece, "the browser has gone"
            self._read += piece
        message, _, self._read = self._read.partition(b"\0")
        event = json.loads(message)
        kind, parameters = event.get("method"), event.get("params", {})
        if kind == "Network.requestWillBeSent":
            address = parameters["request"]["url"]
            self.asked += [address] if not address.startswith("data:") else []
        elif kind in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
            self.said.append(parameters)
        return event


@contextmanager
def browser(profile):
    """Open a tab in a browser with a new profile folder; skip the test if no browser is installed."""
    if not (program := next(filter(None, map(shutil.which, NAMES)), None)):
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is on the path")
    browser_input, commands = os.pipe()
    answers, browser_output = os.pipe()

    launcher = [sys.executable, "-c", START, str(browser_input), str(browser_output)]
    command = [*launcher, program, *OPTIONS, f"--user-data-dir={profile}"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, pass_fds=(browser_input, browser_output), **quiet) as process:
        os.close(browser_input)
        os.close(browser_output)
        try:
            yield Tab(commands, answers)
        finally:
            process.terminate()
            os.close(commands)
            os.close(answers)
