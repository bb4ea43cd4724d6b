"""A page in headless Chromium, driven by its debugging protocol: clicks, keys, touches, prints, pictures."""

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
    *(
        "--disable-component-update",
        "--disable-sync",
        "--disable-extensions",
        "--mute-audio",
        "--remote-debugging-port=0",
    ),
)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed: no page can be tried")
PATIENCE_S = 15.0


class Tab:
    """One page at a time, at a size of one's choice. Whatever it asked the network for is in ``asked``."""

    def __init__(self, line: ClientConnection) -> None:
        self._line, self._number = line, 0
        self.asked: list[str] = []
        self.troubles: list[str] = []
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **words: Any) -> dict[str, Any]:
        """Ask the browser for something and wait for its answer."""
        self._number += 1
        self._line.send(json.dumps({"id": self._number, "method": method, "params": words}))
        while True:
            told = json.loads(self._line.recv(timeout=PATIENCE_S))
            if told.get("id") == self._number:
                assert "error" not in told, told["error"]
                return dict(told["result"])
            self._note(told)

    def _note(self, told: dict[str, Any]) -> None:
        facts = told.get("params", {})
        if told.get("method") == "Network.requestWillBeSent":
            self.asked.append(facts["request"]["url"])
        elif told.get("method") == "Runtime.exceptionThrown":
            self.troubles.append(facts["exceptionDetails"].get("exception", {}).get("description", "exception"))
        elif told.get("method") == "Log.entryAdded" and facts["entry"]["level"] == "error":
            self.troubles.append(facts["entry"]["text"])

    def run(self, script: str) -> Any:
        """What a script of one expression gives."""
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

    def centre(self, selector: str, fraction: tuple[float, float] = (0.5, 0.5)) -> tuple[float, float]:
        """A place of an element scrolled into view, by fractions of its width and height, in px of the window."""
        found = self.run(
            f"(() => {{ const one = document.querySelector({json.dumps(selector)}); "
            "one.scrollIntoView({block: 'center', behavior: 'instant'}); "
            "const box = one.getBoundingClientRect(); return [box.x, box.y, box.width, box.height]; })()"
        )
        return found[0] + fraction[0] * found[2], found[1] + fraction[1] * found[3]

    def mouse(self, kind: str, x: float, y: float, **words: Any) -> None:
        """Move, press or release the mouse."""
        self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, **words)

    def click(self, x: float, y: float) -> None:
        """Click at a place of the window."""
        self.mouse("Moved", x, y)
        self.mouse("Pressed", x, y, button="left", clickCount=1)
        self.mouse("Released", x, y, button="left", clickCount=1)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the mouse, move it, let it go."""
        self.mouse("Moved", *start)
        self.mouse("Pressed", *start, button="left", buttons=1, clickCount=1)
        for part in (0.25, 0.5, 0.75, 1.0):
            x, y = (a + part * (b - a) for a, b in zip(start, end, strict=True))
            self.mouse("Moved", x, y, button="left", buttons=1)
        self.mouse("Released", *end, button="left", clickCount=1)

    def tap(self, x: float, y: float) -> None:
        """Touch a place of the window."""
        self.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def swipe(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Touch, move the finger, let go."""
        (x0, y0), (x1, y1) = start, end
        self.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x0, "y": y0}])
        for part in (0.1, 0.25, 0.5, 0.75, 1.0):
            point = {"x": x0 + part * (x1 - x0), "y": y0 + part * (y1 - y0)}
            self.call("Input.dispatchTouchEvent", type="touchMove", touchPoints=[point])
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def key(self, name: str, code: int) -> None:
        """Press a key once."""
        words = {"key": name, "code": name, "windowsVirtualKeyCode": code}
        if name == "Enter":
            words["text"] = "\r"
        self.call("Input.dispatchKeyEvent", type="keyDown", **words)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=name, code=name, windowsVirtualKeyCode=code)

    def picture(self, whole: bool = False) -> bytes:
        """PNG of what is seen, or of the whole page."""
        return base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=whole)["data"])

    def pdf(self) -> bytes:
        """The page as it prints on A4."""
        found = self.call("Page.printToPDF", paperWidth=8.27, paperHeight=11.69, printBackground=True)
        return base64.b64decode(found["data"])


@contextmanager
def chromium(profile: Path) -> Iterator[Tab]:
    """A browser without a past, and its one tab."""
    assert CHROMIUM is not None
    words = [CHROMIUM, *QUIETLY, f"--user-data-dir={profile}", "about:blank"]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            port = _port(profile / "DevToolsActivePort")
            with _line_to_page(port) as line:
                yield Tab(line)
        finally:
            process.terminate()


def _port(file: Path) -> int:
    end = time.monotonic() + PATIENCE_S
    while not (file.exists() and (lines := file.read_text().split())):
        assert time.monotonic() < end, "chromium did not start"
        time.sleep(0.05)
    return int(lines[0])


def _line_to_page(port: int) -> ClientConnection:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=PATIENCE_S) as answer:
        (page, *_) = [one for one in json.load(answer) if one["type"] == "page"]
    return connect(page["webSocketDebuggerUrl"], max_size=None, compression=None)
