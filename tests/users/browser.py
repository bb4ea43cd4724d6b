"""Drive a page in headless Chromium by its debugging protocol: clicks, keys, touches, prints, pictures."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium")
QUIETLY = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-extensions", "--mute-audio"),
    "--remote-debugging-port=0",
)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed: no page can be tried")
PATIENCE_S = 15.0


class Tab:
    """Show one page at a time, in a window of a chosen size. ``asked`` lists the addresses of its network requests."""

    def __init__(self, line: ClientConnection) -> None:
        self._line = line
        self._number = 0
        self.asked: list[str] = []
        self.troubles: list[str] = []
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **words: Any) -> dict[str, Any]:
        """Send a command to the browser and return its answer."""
        self._number += 1
        self._line.send(json.dumps({"id": self._number, "method": method, "params": words}))
        while True:
            told = json.loads(self._line.recv(timeout=PATIENCE_S))
            if told.get("id") == self._number:
                assert "error" not in told, told["error"]
                return dict(told["result"])
            facts = told.get("params", {})
            if told.get("method") == "Network.requestWillBeSent":
                self.asked.append(facts["request"]["url"])
            elif told.get("method") == "Runtime.exceptionThrown":
                self.troubles.append(facts["exceptionDetails"].get("exception", {}).get("description", "exception"))
            elif told.get("method") == "Log.entryAdded" and facts["entry"]["level"] == "error":
                self.troubles.append(facts["entry"]["text"])

    def run(self, script: str) -> Any:
        """Return the value of a script of one expression."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def open(
        self, page: Path, size: tuple[int, int] = (1280, 900), ready: str = "true", *, touch: bool = False
    ) -> None:
        """Load a page from disk and wait until an expression is true of it."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=touch
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=touch)
        self.asked.clear()
        self.troubles.clear()
        self.call("Page.navigate", url=page.as_uri())
        self.wait(f"document.readyState === 'complete' && ({ready})")

    def wait(self, expression: str) -> None:
        """Wait until an expression is true of the page."""
        end = time.monotonic() + PATIENCE_S
        while not self.run(f"Boolean({expression})"):
            assert time.monotonic() < end, f"{expression} did not come true; {self.troubles}"
            time.sleep(0.03)

    def key(self, name: str, code: int) -> None:
        """Press a key once."""
        for event in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=event, key=name, code=name, windowsVirtualKeyCode=code)

    def pdf(self) -> bytes:
        """Return the page as a PDF, as it prints on A4."""
        found = self.call("Page.printToPDF", paperWidth=8.27, paperHeight=11.69, printBackground=True)
        return base64.b64decode(found["data"])


@contextmanager
def chromium(profile: Path) -> Iterator[Tab]:
    """Start a browser with an empty profile and yield its one tab."""
    assert CHROMIUM is not None
    words = [CHROMIUM, *QUIETLY, f"--user-data-dir={profile}", "about:blank"]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            file = profile / "DevToolsActivePort"
            end = time.monotonic() + PATIENCE_S
            while not (file.exists() and (lines := file.read_text().split())):
                assert time.monotonic() < end, "chromium did not start"
                time.sleep(0.05)
            with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json", timeout=PATIENCE_S) as answer:
                (page, *_) = [one for one in json.load(answer) if one["type"] == "page"]
            with connect(page["webSocketDebuggerUrl"], max_size=None, compression=None) as line:
                yield Tab(line)
        finally:
            process.terminate()
