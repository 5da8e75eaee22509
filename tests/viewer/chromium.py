"""A headless Chromium, driven over its DevTools protocol: opens a page, evaluates scripts, takes screenshots."""

import base64
import contextlib
import io
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome")
SWITCHES = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "--no-first-run",
    "--hide-scrollbars",
)
SECONDS = 90.0  # for anything, on a busy machine


def find_chromium() -> str:
    """The path of a Chromium; skips the test if there is none."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("no Chromium (Debian: apt-get install chromium)")
    return found


class Page:
    """One page of a browser of its own."""

    def __init__(self, url: str, folder: Path, size=(1280, 720)) -> None:
        client = pytest.importorskip("websockets.sync.client")
        profile = folder / "profile"
        command = [find_chromium(), *SWITCHES, f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}"]
        self.process = subprocess.Popen([*command, "about:blank"], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        self._numbers = itertools.count(1)
        try:
            port = wait_for(lambda: (profile / "DevToolsActivePort").read_text().split()[0])
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=SECONDS) as answer:
                target = next(t for t in json.load(answer) if t["type"] == "page")
            self._socket = client.connect(target["webSocketDebuggerUrl"], max_size=None)
            metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
            self.call("Emulation.setDeviceMetricsOverride", **metrics)
            self.call("Page.navigate", url=url)
        except BaseException:
            self.close()
            raise

    def call(self, method: str, **arguments) -> dict:
        """Calls a method of the protocol and waits for its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": arguments}))
        while True:
            message = json.loads(self._socket.recv(timeout=SECONDS))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]

    def evaluate(self, script: str):
        """The value of a script in the page."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def wait_for(self, script: str):
        """Waits until a script is true in the page."""
        return wait_for(lambda: self.evaluate(script))

    def screenshot(self) -> np.ndarray:
        """The page as RGB in [0, 1]."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        with Image.open(io.BytesIO(data)) as image:
            return np.asarray(image.convert("RGB"), np.float64) / 255

    def click_if_there(self, label: str) -> None:
        """Clicks on the buttons whose class contains a word."""
        self.wait_for("document.querySelectorAll('canvas').length > 0")
        self.evaluate(f"document.querySelectorAll('button[class*={label} i]').forEach(b => b.click())")

    def close(self) -> None:
        """Ends the browser."""
        with contextlib.suppress(Exception):
            self._socket.close()
        self.process.kill()
        self.process.wait()

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, *_) -> None:
        self.close()


def wait_for(answer, seconds: float = SECONDS):
    """The first answer that is true."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError, IndexError):
            if value := answer():
                return value
        time.sleep(0.1)
    raise TimeoutError("nothing came")
