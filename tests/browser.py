"""A headless Chromium for tests: its flags, and a driver that runs scripts on a page."""

import contextlib
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chromium-headless-shell")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
"""Flags with which Chromium needs no display, and calls nobody."""


def chromium() -> str:
    """Return the path of a browser; skip the test if none is installed."""
    found = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if found is None:
        pytest.skip(f"no headless browser is installed: none of {', '.join(_BROWSERS)}")
    return found


class Browser:
    """A running Chromium that chromedriver controls, by the WebDriver protocol.

    `folder`: new profile of the browser, and place of its downloads. The test is skipped if
    chromedriver or a browser is not installed."""

    def __init__(self, folder: Path):
        driver = shutil.which("chromedriver")
        if driver is None:
            pytest.skip("no chromedriver is installed")
        options = {
            "binary": chromium(),
            "args": [*FLAGS, f"--user-data-dir={folder / 'profile'}",
                     "--window-size=1400,900"],
            "prefs": {"download.default_directory": str(folder)},
        }  # fmt: skip
        self._process = subprocess.Popen(
            [driver, "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        started = next(line for line in self._process.stdout if "successfully on port" in line)
        self._base = f"http://127.0.0.1:{started.split()[-1].rstrip('.')}"
        wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
        made = self._call("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self._base += f"/session/{made['sessionId']}"
        self._call("POST", "/goog/cdp/execute", {
            "cmd": "Browser.setDownloadBehavior",
            "params": {"behavior": "allow", "downloadPath": str(folder)},
        })  # fmt: skip

    def close(self) -> None:
        """End browser and driver."""
        with contextlib.suppress(OSError):
            self._call("DELETE", "")
        self._process.terminate()
        self._process.wait(20)

    def open(self, url: str) -> None:
        """Load a page in the present tab."""
        self._call("POST", "/url", {"url": url})

    def tab(self) -> str:
        """Open another tab, and return its handle."""
        return self._call("POST", "/window/new", {"type": "tab"})["handle"]

    def tabs(self) -> list[str]:
        """Return the handles of all tabs."""
        return self._call("GET", "/window/handles")

    def switch(self, handle: str) -> None:
        """Turn to the tab with this handle."""
        self._call("POST", "/window", {"handle": handle})

    def run(self, code: str, *arguments: Any) -> Any:
        """Return what JavaScript `code` returns, with its `arguments` there."""
        return self._call("POST", "/execute/sync", {"script": code, "args": list(arguments)})

    def wait(self, code: str, *arguments: Any, seconds: float = 60.0) -> Any:
        """Run `code` until it returns something true, and return that."""
        end = time.monotonic() + seconds
        while not (found := self.run(code, *arguments)):
            if time.monotonic() > end:
                raise TimeoutError(f"not within {seconds:g} s: {code}")
            time.sleep(0.05)
        return found

    def drag(self, x: float, y: float, dx: float) -> None:
        """Press the mouse at (x, y), move it by `dx` pixels in steps, and let go."""
        steps = [
            {"type": "pointerMove", "x": round(x), "y": round(y), "duration": 0},
            {"type": "pointerDown", "button": 0},
            *(
                {"type": "pointerMove", "x": round(x + k * dx / 5), "y": round(y), "duration": 30}
                for k in range(1, 6)
            ),
            {"type": "pointerUp", "button": 0},
        ]
        pointer = {"type": "pointer", "id": "mouse", "actions": steps}
        self._call("POST", "/actions", {"actions": [pointer]})

    def console(self) -> list[str]:
        """Return the messages on the console since the last call."""
        told = self._call("POST", "/se/log", {"type": "browser"})
        return [f"{one['level']}: {one['message']}" for one in told]

    def _call(self, method: str, path: str, data: Any = None) -> Any:
        body = None if method == "GET" else json.dumps(data or {}).encode()
        request = urllib.request.Request(
            self._base + path, body, {"Content-Type": "application/json"}, method=method
        )
        with urllib.request.urlopen(request, timeout=120) as answer:
            return json.load(answer)["value"]
