"""A real browser for tests: headless Chromium, driven over ChromeDriver's plain HTTP."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
]


def unpacked(value: dict[str, Any]) -> np.ndarray:
    """Return the numbers of a packed array."""
    return np.frombuffer(base64.b64decode(value["bdata"]), "<" + value["dtype"]).astype(float)


def missing() -> str:
    """Return why no browser can be used here, or ""."""
    for program in ("chromium", "chromedriver"):
        if shutil.which(program) is None:
            return f"{program} is not installed (apt-get install chromium chromium-driver)"
    return ""


class Browser:
    """One page in one window."""

    def __init__(self, base: str, session: str) -> None:
        self._at = f"{base}/session/{session}"

    def open(self, path: Path) -> None:
        self.devtools("Emulation.setFocusEmulationEnabled", {"enabled": True})
        _call("POST", f"{self._at}/url", {"url": path.resolve().as_uri()})

    def resize(self, width: int, height: int) -> None:
        """Set the size of the page itself, whatever the smallest window size."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.devtools("Emulation.setDeviceMetricsOverride", metrics)

    def dark(self, on: bool = True) -> None:
        value = {"name": "prefers-color-scheme", "value": "dark" if on else "light"}
        self.devtools("Emulation.setEmulatedMedia", {"features": [value]})

    def devtools(self, command: str, params: dict[str, Any]) -> Any:
        body = {"cmd": command, "params": params}
        return _call("POST", f"{self._at}/goog/cdp/execute", body)

    def run(self, script: str, *args: Any) -> Any:
        """Run a function body in the page and return its value."""
        return _call("POST", f"{self._at}/execute/sync", {"script": script, "args": list(args)})

    def point(self, selector: str, x: float, y: float) -> None:
        """Move the mouse to a fraction of an element's width and height."""
        place = self.run(
            "const e = document.querySelector(arguments[0]); e.scrollIntoView({block: 'center'});"
            "const b = e.getBoundingClientRect(); return [b.left, b.top, b.width, b.height];",
            selector,
        )
        at = [round(place[0] + x * place[2]), round(place[1] + y * place[3])]
        move = {"type": "pointerMove", "duration": 0, "x": at[0], "y": at[1], "origin": "viewport"}
        mouse = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}}
        _call("POST", f"{self._at}/actions", {"actions": [{**mouse, "actions": [move]}]})

    def drag(self, identity: str, start: float, end: float) -> None:
        """Drag a box over a part of a plot's width."""
        self.point(f"#{identity}", start, 0.4)
        x, y, width, height = self.run(
            "const b = document.getElementById(arguments[0]).getBoundingClientRect();"
            "return [b.left, b.top, b.width, b.height];",
            identity,
        )
        middle = (start + end) / 2
        places = (("Pressed", start), ("Moved", middle), ("Moved", end), ("Released", end))
        for kind, part in places:
            at = {"x": x + part * width, "y": y + 0.4 * height, "button": "left", "buttons": 1}
            self.devtools(
                "Input.dispatchMouseEvent", {"type": f"mouse{kind}", "clickCount": 1, **at}
            )
        time.sleep(0.5)

    def click(self, selector: str) -> None:
        """Press and release the mouse in the middle of an element."""
        self.point(selector, 0.5, 0.5)
        left, top, width, height = self.run(
            "const b = document.querySelector(arguments[0]).getBoundingClientRect();"
            "return [b.left, b.top, b.width, b.height];",
            selector,
        )
        at = {"x": left + width / 2, "y": top + height / 2, "button": "left", "clickCount": 1}
        for kind in ("mousePressed", "mouseReleased"):
            self.devtools("Input.dispatchMouseEvent", {"type": kind, **at})
        time.sleep(0.2)

    def key(self, identity: str, key: str) -> None:
        """Press a key while a plot has the focus."""
        self.run("document.getElementById(arguments[0]).focus()", identity)
        typed = {"key": key} | ({"text": key} if len(key) == 1 else {})
        for kind in ("keyDown", "keyUp"):
            self.devtools("Input.dispatchKeyEvent", {"type": kind, **typed})
        time.sleep(0.3)

    def draw_all(self) -> None:
        """Scroll through the page and back, so that every panel is drawn."""
        self.run("document.querySelectorAll('details').forEach(d => { d.open = true; })")
        for y in range(0, self.run("return document.documentElement.scrollHeight"), 800):
            self.run("window.scrollTo(0, arguments[0])", y)
            time.sleep(0.1)
        for _ in range(100):
            if self.run("return [...document.querySelectorAll('.plot')].every(p => p.drawn)"):
                break
            time.sleep(0.1)
        self.run("window.scrollTo(0, 0)")

    def errors(self) -> list[str]:
        """Return the errors and warnings of the console."""
        lines = _call("POST", f"{self._at}/se/log", {"type": "browser"})
        return [line["message"] for line in lines if line["level"] in ("SEVERE", "WARNING")]


@contextmanager
def browser() -> Iterator[Browser]:
    """Yield a browser with an empty profile; quit it afterwards."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    base = f"http://127.0.0.1:{port}"
    quiet = subprocess.DEVNULL
    driver = subprocess.Popen(["chromedriver", f"--port={port}"], stdout=quiet, stderr=quiet)
    session = ""
    try:
        _wait(base)
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            options = {"args": [*FLAGS, f"--user-data-dir={profile}"]}
            wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
            made = _call("POST", f"{base}/session", {"capabilities": {"alwaysMatch": wanted}})
            session = made["sessionId"]
            try:
                yield Browser(base, session)
            finally:
                _call("DELETE", f"{base}/session/{session}")
    finally:
        driver.terminate()
        driver.wait(timeout=20)


def _wait(base: str) -> None:
    for _ in range(200):
        try:
            if _call("GET", f"{base}/status")["ready"]:
                return
        except OSError:
            time.sleep(0.05)
    raise RuntimeError("chromedriver did not start")


def _call(method: str, url: str, body: dict[str, Any] | None = None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    headers = {"Content-Type": "application/json"}
    request = urllib.request.Request(url, data=data, headers=headers, method=method)
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(request, timeout=60) as answer:
        return json.loads(answer.read())["value"]
