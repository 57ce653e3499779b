"""Draw docs/open.png: a person's way from a log to a report, in a real browser. Run: python docs/open_figures.py.

Needs the extra dev (Playwright) and Chromium (``apt-get install chromium``).
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

PICTURE = Path(__file__).with_name("open.png")
QUIET = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run")
SIMULATE = (
    "simulate arm-bullet --scenario multisine --option joint_friction=0.15 --scenario-option noise=0.001 -o run.csv"
)


def main() -> None:
    """Simulate README's record, open it, choose the pendulum, run, and take the picture."""
    sysid = [sys.executable, "-m", "harness"]
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([*sysid, *SIMULATE.split()], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        command = [*sysid, "open", "run.csv", "--no-browser"]
        with (
            subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as server,
            sync_playwright() as play,
        ):
            assert server.stdout is not None
            address = server.stdout.readline().split()[-1]
            browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=QUIET)
            page = browser.new_page(viewport={"width": 1300, "height": 900}, device_scale_factor=1)
            page.set_default_timeout(300_000)
            page.goto(address)
            page.wait_for_selector("#model-pick option[value=pendulum]", state="attached")
            page.select_option("#model-pick", "pendulum")
            page.wait_for_selector("#odd .done")
            page.click("#go")
            page.wait_for_selector("#frame:not([hidden])")
            page.frame_locator("#frame").locator("h1").wait_for()
            page.locator("#frame").scroll_into_view_if_needed()
            page.wait_for_timeout(3000)  # a frame is painted once it was in sight
            page.evaluate("() => { document.getElementById('opened').textContent = 'run.csv'; scrollTo(0, 0); }")
            page.screenshot(path=PICTURE, full_page=True)
            browser.close()
            server.terminate()


if __name__ == "__main__":
    main()
