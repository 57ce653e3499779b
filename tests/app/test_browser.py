"""A person's way through the page in a real browser: drop a log, choose by keyboard, run, look, copy what was run."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from harness.cli.app import run
from harness.supervision.interrupts import Interrupts

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra dev)")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
QUIET = (
    "--no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
).split()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium"),
]
DROP = """([name, text]) => {
  const data = new DataTransfer();
  data.items.add(new File([text], name));
  window.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
}"""
NAMELESS = """() => [...document.querySelectorAll("button, select, input, iframe, output, progress")].filter((one) =>
  !(one.labels?.length || one.getAttribute("aria-label") || one.title ||
    one.tagName === "BUTTON" && one.textContent.trim()
    || one.closest("label") || document.querySelector(`label[for="${one.id}"]`))).map((one) => one.outerHTML)"""


@pytest.fixture
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET)
        yield found
        found.close()


@pytest.fixture
def address(folder: Path) -> Iterator[str]:
    """A server over the folder, as the command starts it."""
    with subprocess.Popen(
        [sys.executable, "-m", "harness", "open", ".", "--no-browser"],
        cwd=folder,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
    ) as process:
        assert process.stdout is not None
        yield process.stdout.readline().split()[-1]
        process.terminate()


def _page(browser: Any, address: str, width: int, scheme: str) -> tuple[Any, list[str]]:
    """Open the page; returns it with whatever goes wrong in it or leaves this machine."""
    page = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme).new_page()
    page.set_default_timeout(90_000)
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda message: faults.append(message.text) if "Security" in message.text else None)
    page.on("request", lambda asked: faults.append(asked.url) if not _own(asked.url, address) else None)
    page.goto(address)
    return page, faults


def _own(url: str, address: str) -> bool:
    return url.startswith((address, "data:", "blob:"))


@pytest.mark.parametrize(("width", "scheme"), [(400, "dark"), (1400, "light")])
def test_from_a_dropped_log_to_a_fit_and_its_command(
    browser: Any, address: str, folder: Path, width: int, scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, faults = _page(browser, address, width, scheme)
    page.wait_for_selector("#plot path")  # the one log of the folder is opened at once
    page.evaluate(DROP, ["dropped.csv", (folder / "log.csv").read_text()])
    page.wait_for_selector("#facts:has-text('dropped.csv: 400 rows, 2 channels')")
    page.wait_for_selector("#table select")
    selects = page.locator("#table select")
    for row, use in ((1, "input"), (2, "output")):
        selects.nth(row).focus()
        page.keyboard.type(use)
        assert selects.nth(row).input_value() == use, "every letter counts, not the last one alone"
    page.wait_for_selector("#odd .done:has-text('Nothing odd')")
    page.focus("#task-loop")
    page.keyboard.press("ArrowRight")
    page.wait_for_selector("#command:has-text('identify')")
    told = page.text_content("#plot-told")
    page.focus("[data-move=in]")
    page.keyboard.press("Enter")
    page.wait_for_selector(f"#plot-told:not(:has-text('{told}'))")
    page.focus("#go")
    page.keyboard.press("Enter")
    page.wait_for_selector("#shown-text:has-text('validation')")
    assert page.locator("#shown-files a").all_text_contents() == ["model.json"]
    assert page.evaluate(NAMELESS) == []
    assert page.evaluate("() => document.documentElement.scrollWidth <= document.documentElement.clientWidth")
    assert faults == []
    command = page.text_content("#command").strip()
    monkeypatch.chdir(folder)
    shutil.copyfile(folder / "log.csv", folder / "dropped.csv")  # an upload is called by its name
    assert run(shlex.split(command)[1:], Interrupts()) == 0
    assert (folder / "model.json").is_file()


def test_a_part_of_the_plot_is_chosen_by_dragging_and_gaps_stay_open(browser: Any, address: str, folder: Path) -> None:
    page, faults = _page(browser, address, 1200, "dark")
    rows = (folder / "log.csv").read_text().splitlines()
    rows[100:120] = [f"{row.split(',')[0]},," for row in rows[100:120]]
    page.set_input_files("#upload", {"name": "holes.csv", "mimeType": "x", "buffer": "\n".join(rows).encode()})
    page.wait_for_function(
        "() => document.querySelectorAll('#plot path')[0]?.getAttribute('d').split('M').length === 3"
    )
    page.wait_for_selector("#plot-told:has-text('400 rows')")
    paths = [page.locator("#plot path").nth(k).get_attribute("d") for k in (0, 1)]
    assert [path.count("M") for path in paths] == [2, 2]  # the pen is lifted over the hole
    box = page.locator("#plot").bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 50)
    assert " at " in page.text_content("#plot .reading")
    page.mouse.down()
    page.mouse.move(box["x"] + 300, box["y"] + 90, steps=3)
    page.mouse.up()
    page.wait_for_selector("#plot-told:not(:has-text('400 rows'))")
    page.mouse.dblclick(box["x"] + 250, box["y"] + 50)
    page.wait_for_selector("#plot-told:has-text('400 rows')")
    assert faults == []


def test_equations_are_typed_and_taken_by_keyboard(browser: Any, address: str) -> None:
    page, faults = _page(browser, address, 400, "dark")
    page.wait_for_selector("#plot path")
    page.focus("#typing summary")
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.type("input u [V]\nT = 1 s\nk = 1 m/V\ny' = (k*u - y)/ T\nstate y [m]\n", delay=0)
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_selector("#command:has-text('typed.eqs')")
    assert page.locator("#table select").nth(2).input_value() == "output:y"
    page.check("#task-fit")
    page.wait_for_selector("#command:has-text('--identifier output-error')")  # arx fits no named model
    page.fill("#equations", "y' = k*u")
    page.click("#take")
    page.wait_for_selector("[role=alert]:has-text('line 1'):has-text('unknown name k')")
    assert page.evaluate("() => document.documentElement.scrollWidth <= document.documentElement.clientWidth")
    assert faults == []


def test_a_bad_upload_is_said_aloud_in_one_line(browser: Any, address: str) -> None:
    page, faults = _page(browser, address, 700, "light")
    page.set_input_files("#upload", {"name": "run.exe", "mimeType": "x", "buffer": b"MZ"})
    page.wait_for_selector("[role=alert]:has-text('an upload of this kind')")
    assert "; remedy: " in page.text_content("[role=alert]")
    assert faults == []


def test_another_page_cannot_read_or_run_anything(browser: Any, address: str) -> None:
    page = browser.new_page()
    page.goto("data:text/html,<p>foreign</p>")
    asked = "([where, how]) => fetch(where, how).then(() => 'read', () => 'refused')"
    assert page.evaluate(asked, [f"{address}session", {}]) == "refused"
    assert page.evaluate(asked, [f"{address}run", {"method": "POST", "body": "{}"}]) == "refused"
    bare = address.rsplit("/", 2)[0]
    assert browser.new_page().goto(f"{bare}/").status == 403
