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
# Flags with which Chromium needs no display, and calls nobody.
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
        made = self.call("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self._base += f"/session/{made['sessionId']}"
        self.call("POST", "/goog/cdp/execute", {
            "cmd": "Browser.setDownloadBehavior",
            "params": {"behavior": "allow", "downloadPath": str(folder)},
        })  # fmt: skip

    def close(self) -> None:
        """End browser and driver."""
        with contextlib.suppress(OSError):
            self.call("DELETE", "")
        self._process.terminate()
        self._process.wait(20)

    def run(self, code: str, *arguments: Any) -> Any:
        """Return what JavaScript `code` returns, with its `arguments` there."""
        return self.call("POST", "/execute/sync", {"script": code, "args": list(arguments)})

    def wait(self, code: str, *arguments: Any, seconds: float = 60.0) -> None:
        """Run `code` until it returns something true."""
        end = time.monotonic() + seconds
        while not self.run(code, *arguments):
            if time.monotonic() > end:
                raise TimeoutError(f"not within {seconds:g} s: {code}")
            time.sleep(0.05)

    def call(self, method: str, path: str, data: Any = None) -> Any:
        """Return the value with which the driver answers a request of the WebDriver protocol."""
        body = None if method == "GET" else json.dumps(data or {}).encode()
        request = urllib.request.Request(
            self._base + path, body, {"Content-Type": "application/json"}, method=method
        )
        with urllib.request.urlopen(request, timeout=120) as answer:
            return json.load(answer)["value"]
