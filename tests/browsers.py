"""A real browser that tests look through, where one is installed."""

import base64
import json
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from declared import BROWSER, absent

DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))


class Browser:
    """A headless Chromium, spoken to in the W3C WebDriver protocol."""

    FLAGS = (
        "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
        "--disable-sync", "--window-size=800,600",
    )  # fmt: skip

    def __init__(self, base: str, profile: Path) -> None:
        options = {"args": [*self.FLAGS, f"--user-data-dir={profile}"]}
        self._session = ""
        self._base = f"{base}/session"
        self._session = (
            "/" + self.ask("", capabilities={"alwaysMatch": {"goog:chromeOptions": options}})["sessionId"]
        )

    def ask(self, command: str, **body: Any) -> Any:
        request = urllib.request.Request(
            f"{self._base}{self._session}{command}",
            json.dumps(body).encode(),
            {"Content-Type": "application/json"},
        )
        with DIRECT.open(request, timeout=60) as answer:
            return json.load(answer)["value"]

    def run(self, script: str) -> Any:
        return self.ask("/execute/sync", script=script, args=[])

    def open(self, address: str) -> str:
        """Open the page and return its title once it says that it is ready or failed."""
        self.ask("/url", url="about:blank")
        self.ask("/url", url=address)
        title = ""
        for _ in range(600):
            title = self.run("return document.title")
            if title.startswith(("ready", "failed")):
                break
            time.sleep(0.05)
        return title

    def screenshot(self) -> np.ndarray:
        """RGB (h, w, 3) of what the canvas shows now."""
        self.run("draw()")
        png = self.run("return canvas.toDataURL('image/png')").split(",")[1]
        image = cv2.imdecode(np.frombuffer(base64.b64decode(png), np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return image[..., ::-1]

    def close(self) -> None:
        DIRECT.open(
            urllib.request.Request(f"{self._base}{self._session}", method="DELETE"), timeout=60
        ).close()


@contextmanager
def opened_browser(profile: Path) -> Iterator[Browser]:
    """A browser that ends with the block; without one, the test is skipped."""
    driver = shutil.which("chromedriver")
    if driver is None or not (shutil.which("chromium") or shutil.which("google-chrome")):
        absent(BROWSER, "needs chromium and chromedriver")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [driver, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        session = started(f"http://127.0.0.1:{port}", profile)
        yield session
        session.close()
    finally:
        process.terminate()
        process.wait()


def started(base: str, profile: Path) -> Browser:
    for _ in range(200):
        try:
            DIRECT.open(f"{base}/status", timeout=5).close()
            break
        except urllib.error.URLError:
            time.sleep(0.05)
    try:
        return Browser(base, profile)
    except urllib.error.URLError as error:
        absent(BROWSER, f"the installed browser does not start: {error}")
