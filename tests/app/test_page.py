"""The page over its addresses: what it is told, what runs, and that refusals are the line of the command line."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from harness.app.server import Session

CHOICE: dict[str, Any] = {
    "task": "identify",
    "log": "log.csv",
    "columns": [{"title": "u [V]", "use": "input"}, {"title": "y [m]", "use": "output"}],
    "options": ["order=1"],
}
Finished = Callable[..., Awaitable[Any]]
Inside = Callable[[Callable[[httpx.AsyncClient, Session], Any]], Any]


def test_a_log_is_told_with_units_statistics_and_lines(inside: Inside) -> None:
    async def work(client: httpx.AsyncClient, session: Session) -> None:
        told = (await client.get("session")).json()
        assert (told["logs"], told["jobs"]) == (["log.csv"], [])
        log = (await client.get("log", params={"name": "log.csv"})).json()
        assert [(one["name"], one["unit"]) for one in log["channels"]] == [("u", "V"), ("y", "m")]
        assert log["channels"][0]["maximum"] == 1.0
        lines = (await client.get("lines", params={"name": "log.csv", "title": ["y [m]"], "clock": "time [s]"})).json()
        assert (lines[0]["rows"], lines[0]["t"][-1]) == (400, 39.9)

    inside(work)


def test_the_page_and_its_parts_are_served_and_nothing_else(inside: Inside) -> None:
    async def work(client: httpx.AsyncClient, session: Session) -> None:
        page = (await client.get("")).text
        assert "//" not in re.sub(r"<!doctype.*?>", "", page)  # nothing is loaded from elsewhere
        for name in ("page.js", "plot.js", "runs.js", "ask.js", "page.css"):
            assert (await client.get(f"static/{name}")).status_code == 200
        for name in ("page.html", "..%2fserver.py", "%2e%2e/server.py"):
            assert (await client.get(f"static/{name}")).status_code == 404

    inside(work)


def test_refusals_are_the_line_of_the_command_line(inside: Inside) -> None:
    async def work(client: httpx.AsyncClient, session: Session) -> None:
        answers = [
            await client.get("log", params={"name": "../secret.csv"}),
            await client.put("upload", params={"name": "run.exe"}, content=b"MZ"),
            await client.put("upload", params={"name": "log.csv"}, content=b""),
            await client.post("run", content=b"{}"),
            await client.post("run", content=json.dumps({**CHOICE, "log": "../secret.csv"})),
            await client.post("cancel", content=b"[7]"),
            await client.get("result/1/model.json"),
            await client.get("lines", params={"name": "log.csv", "title": "none"}),
            await client.post("run", content=b" " * (2 << 20)),
        ]
        for answer in answers:
            assert answer.status_code == 422
            assert "; remedy: " in answer.json()["error"]
            assert "\n" not in answer.json()["error"]
        assert session.jobs.all == []

    inside(work)


def test_a_bad_upload_says_what_sysid_list_says(inside: Inside, tmp_path: Path) -> None:
    (tmp_path / "bad.xlsx").write_bytes(b"no workbook")

    async def work(client: httpx.AsyncClient, session: Session) -> str:
        name = (await client.put("upload", params={"name": "bad.xlsx"}, content=b"no workbook")).json()["name"]
        found = await client.get("log", params={"name": name})
        assert found.status_code == 422
        return str(found.json()["error"])

    from harness import api
    from harness.errors import InputError

    with pytest.raises(InputError) as own:
        api.describe_file(tmp_path / "bad.xlsx")
    assert inside(work).split(": ", 1)[1] == " ".join(str(own.value).split()).split(": ", 1)[1]


def test_a_fit_runs_is_checked_shown_compared_and_kept(inside: Inside, finished: Finished) -> None:
    async def work(client: httpx.AsyncClient, session: Session) -> None:
        command = (await client.post("command", content=json.dumps(CHOICE))).json()["command"]
        assert command.startswith("sysid identify ")
        assert "--out" in command
        first = (await client.post("run", content=json.dumps(CHOICE))).json()
        busy = await client.post("run", content=json.dumps(CHOICE))
        assert "a run is not finished" in busy.json()["error"]
        check = (await client.post("run", content=json.dumps({**CHOICE, "task": "check-data"}))).json()
        job = await finished(session, first["id"])
        assert (job.status, job.files(), "NRMSE" in job.text) == ("done", ["model.json"], True)
        assert "oddities" in json.loads((await finished(session, check["id"])).text)
        kept = await client.get(f"result/{job.id}/model.json?keep")
        assert kept.json()["kind"]
        assert "attachment" in kept.headers["content-disposition"]
        second = (await client.post("run", content=json.dumps({**CHOICE, "options": ["order=2"]}))).json()
        await finished(session, second["id"])
        both = (await client.post("compare", content=json.dumps([job.id, second["id"]]))).json()
        found = await finished(session, both["id"])
        assert (found.status, found.error) == ("done", "")
        page = await client.get(f"result/{found.id}/comparison.html")
        assert "sandbox" in page.headers["content-security-policy"]
        assert "default-src 'none'" in page.headers["content-security-policy"]

    inside(work)


def test_a_run_that_fails_says_why_in_one_line(inside: Inside, finished: Finished, folder: Path) -> None:
    (folder / "short.csv").write_text("time [s],u [V],y [m]\n0,1,2\n1,2,3\n")

    async def work(client: httpx.AsyncClient, session: Session) -> None:
        started = (await client.post("run", content=json.dumps({**CHOICE, "log": "short.csv"}))).json()
        job = await finished(session, started["id"])
        assert job.status == "failed"
        assert "; remedy: " in job.error

    inside(work)


def test_a_run_can_be_cancelled(inside: Inside, finished: Finished) -> None:
    async def work(client: httpx.AsyncClient, session: Session) -> None:
        choice = {**CHOICE, "task": "close-loop", "options": []}
        started = (await client.post("run", content=json.dumps(choice))).json()
        await client.post("cancel", content=json.dumps([started["id"]]))
        job = await finished(session, started["id"])
        assert job.status == "cancelled"
        assert job.process is not None
        assert job.process.returncode is not None

    inside(work)


ROOT = str(Path(__file__).parents[2])


@contextmanager
def _serving(*words: str, folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a server in a process of its own; yields it with its address."""
    with subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": ROOT},
    ) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().split()[-1]
        finally:
            process.terminate()


def test_the_command_serves_on_loopback_and_ctrl_c_ends_it(folder: Path) -> None:
    with _serving("-m", "harness", "open", ".", "--no-browser", folder=folder) as (process, address):
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{32}/", address)
        assert httpx.get(f"{address}session").json()["logs"] == ["log.csv"]
        assert httpx.get(address.rsplit("/", 2)[0] + "/").status_code == 403
        with httpx.stream("GET", f"{address}events", timeout=30) as page:  # also while the page is open
            lines = page.iter_lines()
            assert next(lines) == ": open"
            process.send_signal(signal.SIGINT)
            assert all(line.strip() in ("", ":") for line in lines)
        _, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (0, "")


def test_it_ends_by_itself_once_the_page_was_closed(folder: Path) -> None:
    text = (
        "from pathlib import Path; from harness.app.server import serve; "
        "serve(Path('.'), browser=False, first=60, closed=0.5, ready=lambda address: print(address, flush=True))"
    )
    with _serving("-c", text, folder=folder) as (process, address):
        with httpx.stream("GET", f"{address}events", timeout=30) as page:
            assert next(page.iter_lines()) == ": open"
            assert process.poll() is None
        _, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (0, "")


def test_a_missing_extra_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from harness.cli import opening
    from harness.cli.app import run
    from harness.supervision.interrupts import Interrupts

    monkeypatch.setattr(opening, "NEEDED", ("starlette", "no_such_package_here"))
    assert run(["open", "--no-browser"], Interrupts()) == 2
    assert "pip install 'sysid-harness[app]'" in capsys.readouterr().err
