"""A browser without a window, driven over a pipe: what a page says, shows and asks of the network."""

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
        said: messages on its console, errors among them, and exceptions.
        asked: addresses that it asked for, but its own and those that hold what they lead to.
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
        """Show a file in a window of this size, until it has loaded."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.said.clear()
        self.asked.clear()
        address = path.resolve().as_uri()
        self.call("Page.navigate", url=address)
        self.wait("document.readyState === 'complete' && location.href !== 'about:blank'")
        assert self.asked.pop(0) == address

    def ask(self, expression):
        """The value of an expression, or of what it promises."""
        options = {"expression": expression, "returnByValue": True, "awaitPromise": True}
        result = self.call("Runtime.evaluate", **options)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait(self, condition):
        """Until an expression is true."""
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
    """A tab of a browser whose profile is a new folder; the test is skipped where there is none."""
    if not (program := next(filter(None, map(shutil.which, NAMES)), None)):
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is on the path")
    theirs, commands = os.pipe()
    answers, ours = os.pipe()

    given = [sys.executable, "-c", START, str(theirs), str(ours)]
    command = [*given, program, *OPTIONS, f"--user-data-dir={profile}"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, pass_fds=(theirs, ours), **quiet) as process:
        os.close(theirs)
        os.close(ours)
        try:
            yield Tab(commands, answers)
        finally:
            process.terminate()
            os.close(commands)
            os.close(answers)
