"""Takes the picture of the operator's page: `python docs/pictures/operator_page.py`. Needs Chromium."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from playwright.sync_api import sync_playwright

HERE = Path(__file__).parent
PORT = 8499
FLAGS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update")
POSES = 11
"""The picture is taken when a slot has so many."""


def found() -> int:
    try:
        with urlopen(f"http://127.0.0.1:{PORT}/api/1/station", timeout=5) as answer:
            state: dict[str, Any] = json.load(answer)
    except OSError:
        return 0
    return max(slot["found"] for slot in state["slots"])


def main() -> None:
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        command = [sys.executable, "-m", "triaxcald.cli", "demo", "--page", "--out", folder, "--port", str(PORT)]
        with subprocess.Popen(command, env={**os.environ, "BROWSER": "true"}) as demo:
            try:
                while not found():
                    time.sleep(0.2)
                browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
                page = browser.new_page(viewport={"width": 1600, "height": 1000}, color_scheme="light")
                page.goto(f"http://127.0.0.1:{PORT}/")
                while found() < POSES:
                    time.sleep(0.05)
                page.screenshot(path=HERE / "operator-page.png")
                browser.close()
            finally:
                demo.terminate()


if __name__ == "__main__":
    main()
