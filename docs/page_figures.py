"""Draw docs/check-data.png and docs/check-fmu.png: pages that commands write, in a real browser.

Run: python docs/page_figures.py. Needs the extra dev (Playwright) and Chromium (``apt-get install chromium``).
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

from plants.mockups import mockup

HERE = Path(__file__).parent
SIMULATE = "simulate pendulum-ode --scenario multisine --scenario-option noise=0.001 -o run.csv"
QUIET = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run")


def damaged(text: str) -> str:
    """Return a log with a code for missing, a spike, and a glitch of the input."""
    lines = [line.split(",") for line in text.splitlines()]
    u, theta = (next(k for k, title in enumerate(lines[0]) if title.startswith(name)) for name in ("u ", "theta "))
    lines[401][theta], lines[1251][theta], lines[701][u] = "9999", str(float(lines[1251][theta]) + 3.0), "5"
    return "\n".join(map(",".join, lines)) + "\n"


def main() -> None:
    """Write both pages and take their pictures."""
    sysid = [sys.executable, "-m", "harness"]
    with tempfile.TemporaryDirectory() as name, sync_playwright() as play:
        folder = Path(name)

        def ran(*words: str) -> None:
            subprocess.run([*sysid, *words], cwd=folder, check=True, stdout=subprocess.DEVNULL)

        ran(*SIMULATE.split())
        (folder / "log.csv").write_text(damaged((folder / "run.csv").read_text(encoding="utf-8")), encoding="utf-8")
        ran("check-data", "log.csv", "--model", "pendulum", "-o", "check-data.html")
        ran("check", str(mockup("pendulum")), "-o", "check-fmu.html")
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=list(QUIET))
        page = browser.new_page(viewport={"width": 1000, "height": 640})
        for which in ("check-data", "check-fmu"):
            page.goto((folder / f"{which}.html").as_uri())
            page.screenshot(path=HERE / f"{which}.png")
        browser.close()


if __name__ == "__main__":
    main()
