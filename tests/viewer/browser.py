"""A headless Chromium, driven by its DevTools protocol over a websocket (which viser brings)."""

from __future__ import annotations

import base64
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--hide-scrollbars",
    "--use-angle=swiftshader",  # WebGL without a GPU
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--remote-debugging-port=0",
)


class Browser:
    """One page of a new browser, with a profile of its own.

    Args:
        width, height: of the page in pixels.
        seconds: time that anything may take.
    """

    def __init__(self, width: int = 1280, height: int = 800, *, seconds: float = 120.0) -> None:
        from websockets.sync.client import connect

        assert CHROMIUM is not None
        self.seconds, self._numbers = seconds, itertools.count(1)
        self._folder = tempfile.mkdtemp(prefix="chromium")
        command = [CHROMIUM, *_FLAGS, f"--user-data-dir={self._folder}", f"--window-size={width},{height}"]
        nothing = subprocess.DEVNULL
        self._process = subprocess.Popen([*command, "about:blank"], stdout=nothing, stderr=nothing)
        try:
            port = self.until(self._port)
            found = json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=seconds))
            (page,) = [each for each in found if each["type"] == "page"]
            self._socket = connect(page["webSocketDebuggerUrl"], max_size=2**28, open_timeout=seconds)
            self.call("Page.enable")
            metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
            self.call("Emulation.setDeviceMetricsOverride", **metrics)
        except BaseException:
            self.close()
            raise

    def _port(self) -> str | None:
        file = Path(self._folder) / "DevToolsActivePort"
        lines = file.read_text().splitlines() if file.exists() else []
        return lines[0] if len(lines) > 1 else None

    def call(self, method: str, **parameters: Any) -> dict:
        """Call a method of the protocol and return its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:  # events come in between
            answer = json.loads(self._socket.recv(timeout=self.seconds))
            if answer.get("id") == number:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    def open(self, url: str) -> None:
        """Go to a page."""
        self.call("Page.navigate", url=url)

    def run(self, code: str) -> Any:
        """Return the value of a JavaScript expression."""
        result = self.call("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def until(self, condition: Callable[[], Any] | str) -> Any:
        """Wait until a function, or a JavaScript expression, is true; return its value."""
        deadline = time.monotonic() + self.seconds
        while True:
            value = self.run(condition) if isinstance(condition, str) else condition()
            if value:
                return value
            if time.monotonic() > deadline:
                shown = self.run("document.body?.innerText") if isinstance(condition, str) else ""
                raise AssertionError(f"{condition} did not become true within {self.seconds} s; the page: {shown!r}")
            time.sleep(0.1)

    def click(self, text: str) -> None:
        """Click the button with this text; once more where the page moved it away from the pointer."""
        button = f"[...document.querySelectorAll('button')].find(each => each.innerText.trim() === {text!r})"
        box = f"(({button})?.getBoundingClientRect())"
        self.run(
            "window.clicked = []; window.listens ??= (document.addEventListener('click', event => "
            "window.clicked.push(event.target.closest('button')?.innerText.trim()), true), true)"
        )

        def clicked() -> bool:
            x, y = self.until(f"{box} && [{box}.x + {box}.width / 2, {box}.y + {box}.height / 2]")
            for kind in ("mousePressed", "mouseReleased"):  # either returns once the page has handled it
                self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
            return self.run(f"window.clicked.includes({text!r})")

        self.until(clicked)

    def picture(self) -> bytes:
        """Return a screenshot as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def close(self) -> None:
        """End the browser."""
        self._process.terminate()
        try:
            self._process.wait(self.seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


def save(picture: bytes, path: str | os.PathLike) -> None:
    """Write a screenshot."""
    Path(path).write_bytes(picture)
