"""Draw the pictures of pages that commands write, in a real browser: PNG files beside the guides.

Run: python docs/page_figures.py [NAME ...], of check-data, check-fmu, compare, fleet; the last takes minutes.
Needs the extra dev (Playwright) and Chromium (``apt-get install chromium``).
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from playwright.sync_api import sync_playwright

from plants.mockups import mockup

HERE = Path(__file__).parent
SIMULATE = "simulate pendulum-ode --scenario multisine --scenario-option noise=0.001 -o run.csv"
ARM = "simulate arm-bullet --scenario multisine --option sample_time=0.02 --scenario-option noise=0.001"
LINEAR = "simulate linear-ode --scenario prbs -S samples=600 -S noise=0.05 -o linear.csv"
COLUMNS = "linear.csv --input u --output y"
QUIET = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run")
Run = Callable[[str], None]


def check_data(folder: Path, run: Run) -> None:
    """Write the page of a log with a code for missing, a spike, and a glitch of the input."""
    run(SIMULATE)
    lines = [line.split(",") for line in (folder / "run.csv").read_text(encoding="utf-8").splitlines()]
    u, theta = (next(k for k, title in enumerate(lines[0]) if title.startswith(name)) for name in ("u ", "theta "))
    lines[401][theta], lines[1251][theta], lines[701][u] = "9999", str(float(lines[1251][theta]) + 3.0), "5"
    (folder / "log.csv").write_text("\n".join(map(",".join, lines)) + "\n", encoding="utf-8")
    run("check-data log.csv --model pendulum -o check-data.html")


def check_fmu(folder: Path, run: Run) -> None:
    """Write the page of a sound FMU."""
    run(f"check {mockup('pendulum')} -o check-fmu.html")


def compare(folder: Path, run: Run) -> None:
    """Write the page of two linear models of one record."""
    run(LINEAR)
    run(f"identify {COLUMNS} --identifier arx -O order=2 -o arx.json")
    run(f"identify {COLUMNS} -o state-space.json")
    run(f"compare arx.json state-space.json {COLUMNS} -o compare.html")


def fleet(folder: Path, run: Run) -> None:
    """Write the page of two machines on five dates: at one the friction has doubled in April."""
    rows = ["file,machine,date"]
    for month in range(1, 6):
        for machine, friction in (("A", 0.05 if month < 4 else 0.12), ("B", 0.1)):
            name = f"{machine}{month}.csv"
            run(f"{ARM} --seed {2 * month + (machine == 'B')} --option joint_friction={friction:.2f} -o {name}")
            rows.append(f"{name},{machine},2026-0{month}-05")
    (folder / "fleet.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    run("close-loop fleet.csv --model pendulum --out fleet --workers 1")
    shutil.copy(folder / "fleet" / "fleet.html", folder / "fleet.html")


PAGES = {
    "check-data": (check_data, 640),
    "check-fmu": (check_fmu, 640),
    "compare": (compare, 1260),
    "fleet": (fleet, 900),
}
"""What writes each page, and the height of its picture [pixels]."""


def main(names: list[str]) -> None:
    """Write the pages that are named, or all, and take their pictures."""
    sysid = [sys.executable, "-m", "harness"]
    with tempfile.TemporaryDirectory() as place, sync_playwright() as play:
        folder = Path(place)

        def run(line: str) -> None:
            subprocess.run([*sysid, *line.split()], cwd=folder, check=True, stdout=subprocess.DEVNULL)

        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=list(QUIET))
        for name in names or PAGES:
            write, height = PAGES[name]
            write(folder, run)
            page = browser.new_page(viewport={"width": 1000, "height": height})
            page.goto((folder / f"{name}.html").as_uri())
            page.screenshot(path=HERE / f"{name}.png")
        browser.close()


if __name__ == "__main__":
    main(sys.argv[1:])
