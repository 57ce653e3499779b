"""The page on its socket: what the browser may ask for, and when the whole thing ends."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import secrets
import signal
import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from harness.app.commands import LINEAR, matched, ports_told, read_choice, spoken, stated, words
from harness.app.gate import HOST, Gate
from harness.app.jobs import Job, Jobs
from harness.app.logs import Logs
from harness.app.reach import SessionFiles
from harness.errors import UNREADABLE, HarnessError, InputError
from harness.trust import names_fmu

STATIC = Path(__file__).with_name("static")
PARTS = ("page.css", "page.js", "plot.js", "runs.js", "ask.js")
FIRST, CLOSED = 300.0, 30.0
"""Seconds to wait for the first page, and after the last one was closed."""
REQUEST = 1 << 20
"""Bytes of a request that is no upload."""
REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'self'; sandbox allow-downloads"
)
"""A report is a page by itself: no script, nothing loaded, no way out of its frame."""
TYPES = {".html": "text/html", ".json": "application/json", ".csv": "text/plain", ".txt": "text/plain"}


@dataclass
class Session:
    """What one page works with."""

    reach: SessionFiles
    jobs: Jobs = field(init=False)
    logs: Logs = field(default_factory=Logs)
    pages: int = 0
    seen: bool = False
    """True once a page was open."""

    def __post_init__(self) -> None:
        self.jobs = Jobs(self.reach.plain)

    @property
    def results(self) -> Path:
        """Where commands write to."""
        return self.reach.work / "results"

    def target(self, task: str, name: str) -> Path:
        """Return a new path for what a command writes."""
        kind = {"close-loop": "fit", "identify": "fit", "check-data": "check"}.get(task, task)
        folder = self.results / f"{kind}-{self.jobs.next_number(task)}"
        folder.mkdir(parents=True, exist_ok=True)
        return folder / name


def application(session: Session) -> Starlette:
    """Return what answers the page; it is to be put behind a :class:`harness.app.gate.Gate`."""
    asked = _Asked(session)
    routes = [
        Route("/", asked.page),
        Route("/static/{name}", asked.static),
        Route("/session", asked.session_told),
        Route("/parts", asked.parts),
        Route("/upload", asked.upload, methods=["PUT"]),
        Route("/log", asked.log),
        Route("/lines", asked.lines),
        Route("/model", asked.model),
        Route("/command", asked.command, methods=["POST"]),
        Route("/run", asked.run, methods=["POST"]),
        Route("/cancel", asked.cancel, methods=["POST"]),
        Route("/compare", asked.compare, methods=["POST"]),
        Route("/export", asked.export, methods=["POST"]),
        Route("/text", asked.text),
        Route("/events", asked.events),
        Route("/result/{number:int}/{name:path}", asked.result),
    ]

    async def refused(_request: Request, error: Exception) -> Response:
        """Answer with the one line of the command line."""
        if isinstance(error, OSError):
            from harness.data.whole_files import refused_by_system

            error = refused_by_system(error) or error
        return JSONResponse({"error": " ".join(session.reach.plain(str(error)).split())}, 422)

    return Starlette(routes=routes, exception_handlers={HarnessError: refused, OSError: refused, Exception: _fault})


async def _fault(_request: Request, error: Exception) -> Response:
    """Answer with what the command line says of a fault of ours."""
    text = f"a fault in sysid-harness: {type(error).__name__}: {' '.join(str(error).split())}; remedy: report it"
    return JSONResponse({"error": text}, 500)


class _Asked:
    """The answers, one method for each address."""

    def __init__(self, session: Session) -> None:
        self.session, self.reach, self.jobs, self.logs = session, session.reach, session.jobs, session.logs

    # ---- the page itself -------------------------------------------------------------------------------------------

    async def page(self, _request: Request) -> Response:
        return FileResponse(STATIC / "page.html", media_type="text/html")

    async def static(self, request: Request) -> Response:
        name = request.path_params["name"]
        return FileResponse(STATIC / name) if name in PARTS else Response(status_code=404)

    async def session_told(self, _request: Request) -> Response:
        opened = self.reach.opened
        names = await run_in_threadpool(self.reach.names)
        return JSONResponse({
            "opened": None if opened is None else str(opened.absolute()),
            "file": opened.name if opened is not None and not opened.is_dir() else None,
            "jobs": [job.told() for job in self.jobs.all],
            **names,
        })  # fmt: skip

    async def parts(self, _request: Request) -> Response:
        from harness.parts.listing import list_parts

        def listed(kind: str) -> list[dict[str, str]]:
            return [{"id": row["id"], "summary": row["summary"]} for row in list_parts(kind)[kind]]

        catalogue, identifiers = await run_in_threadpool(lambda: (listed("models"), listed("identifiers")))
        catalogue = [row for row in catalogue if row["id"] != LINEAR]
        return JSONResponse({"catalogue": catalogue, "identifiers": identifiers})

    async def upload(self, request: Request) -> Response:
        name = await self.reach.take(request.query_params.get("name", ""), request.stream())
        return JSONResponse({"name": name, **self.reach.names()})

    # ---- logs and models -------------------------------------------------------------------------------------------

    async def log(self, request: Request) -> Response:
        path = self.reach.path(request.query_params["name"])
        if path.suffix == ".toml":
            return JSONResponse(await run_in_threadpool(self._described, path))
        return JSONResponse(await run_in_threadpool(self.logs.describe, path))

    def _described(self, path: Path) -> dict[str, Any]:
        """Return what a data set says: its first record's channels, and that it needs no choices."""
        from harness.data.recipe.description import read_description

        self.reach.runs_within(path)
        described = read_description(path)
        record = path.parent / described.runs[0].file
        found = self.logs.describe(record)
        facts = [f"{path.name}: {len(described.runs)} runs; it says itself what its columns are", *found["facts"]]
        model = None if described.nominal is None else described.nominal.model
        return {**found, "facts": facts, "described": True, "model": model}

    async def lines(self, request: Request) -> Response:
        asked = request.query_params
        path = self.reach.path(asked["name"])
        if path.suffix == ".toml":
            from harness.data.recipe.description import read_description

            self.reach.runs_within(path)
            path = path.parent / read_description(path).runs[0].file
        span = (_number(asked["from"]), _number(asked["to"])) if "from" in asked and "to" in asked else None
        step = _number(asked["step"]) if asked.get("step") else None
        found = await run_in_threadpool(
            lambda: self.logs.lines(
                path,
                asked.getlist("title"),
                clock=asked.get("clock", ""),
                unit=asked.get("unit", ""),
                step=step,
                span=span,
                pixels=int(_number(asked.get("pixels", "800"))),
            )
        )
        return JSONResponse(found)

    async def model(self, request: Request) -> Response:
        name, log = request.query_params.get("name", ""), request.query_params.get("log", "")

        def told() -> dict[str, Any]:
            found = ports_told(name, self.reach)
            path = self.reach.path(log) if log else None
            plain = path is not None and path.suffix != ".toml" and found["fixed"]
            where = name if name in self._catalogue() else str(self.reach.path(name).absolute()) if name else ""
            found["matched"] = (
                {title: port for title, (_, port) in matched(path, where).items()} if plain and path else {}
            )
            found["stated"] = stated(self.logs.describe(path)["titles"], found["ports"]) if plain and path else {}
            return found

        return JSONResponse(await run_in_threadpool(told))

    def _catalogue(self) -> set[str]:
        from harness import registry

        return {entry.id for entry in registry.entries("models")}

    # ---- commands --------------------------------------------------------------------------------------------------

    async def command(self, request: Request) -> Response:
        choice = read_choice(await _body(request))
        shown = await run_in_threadpool(lambda: words(choice, self.reach, shown=True))
        return JSONResponse({"command": spoken([*shown, *_written(choice.task)])})

    async def run(self, request: Request) -> Response:
        choice = read_choice(await _body(request))
        given, shown = await run_in_threadpool(
            lambda: (words(choice, self.reach), words(choice, self.reach, shown=True))
        )
        names = {"close-loop": "report", "identify": "model.json", "check-data": "check.html"}
        out = self.session.target(choice.task, names[choice.task])
        flags = ["--json"] if choice.task == "check-data" else []
        what = [word for word in (Path(choice.model).name, choice.identifier) if word]
        what = what or ([] if choice.log.endswith(".toml") else [LINEAR])
        title = ", ".join([Path(choice.log).name, *what, *choice.options])
        command = spoken([*shown, *_written(choice.task)])
        job = await self.jobs.start(choice.task, [*given, "--out", str(out), *flags], command, out, title)
        return JSONResponse(job.told())

    async def cancel(self, request: Request) -> Response:
        job = self.jobs.find(_chosen(await _body(request))[0])
        await self.jobs.cancel(job)
        return JSONResponse(job.told())

    async def compare(self, request: Request) -> Response:
        """Put fits side by side: two reports as two reports, anything else on the data of the first."""
        jobs = [self.jobs.find(number) for number in _chosen(await _body(request))]
        models = [_model_of(job) for job in jobs]
        short = [str(Path(model).relative_to(self.session.results)) for model in models]  # as the page calls them
        if len(jobs) < 2:
            raise InputError("what to compare", expected="two fits or more", got=str(len(jobs)), remedy="tick another")
        out = self.session.target("compare", "comparison.html")
        data = _data_words(jobs[0].words)
        command = spoken(["compare", *models, *data, "--out", "comparison.html"])
        job = await self.jobs.start(
            "compare", ["compare", *short, *data, "--out", str(out)], command, out,
            " beside ".join(f"fit {one.number}" for one in jobs), self.session.results,
        )  # fmt: skip
        return JSONResponse(job.told())

    async def export(self, request: Request) -> Response:
        """Write the model of a fit as an FMU (around an FMU: as a system of both)."""
        source = self.jobs.find(_chosen(await _body(request))[0])
        if source.status != "done" or source.out is None or source.task not in ("close-loop", "identify"):
            raise InputError("nothing to export", expected="a fit that is done", got=source.status, remedy="run one")
        trusted = [word for word in source.words if names_fmu(word)]
        out = self.session.target("export", "repaired.ssp" if trusted else "model.fmu")
        given = ["export", str(source.out)]
        trust = ["--trust", str(source.out)] if trusted else []
        job = await self.jobs.start(
            "export", [*given, "--out", str(out), *trust], spoken([*given, "--out", out.name, *trust]), out.parent,
            f"model of fit {source.number}",
        )  # fmt: skip
        return JSONResponse(job.told())

    async def text(self, request: Request) -> Response:
        job = self.jobs.find(int(_number(request.query_params.get("job", ""))))
        return JSONResponse({"text": job.text})

    async def result(self, request: Request) -> Response:
        """Return a file that a command wrote, for the frame or to be kept."""
        job, name = self.jobs.find(request.path_params["number"]), request.path_params["name"]
        if job.out is None or name not in job.files():
            raise InputError(
                "no such result", expected=", ".join(job.files()[:12]) or "none", got=name, remedy="reload"
            )
        path = job.out / name if job.out.is_dir() else job.out
        headers = {"content-security-policy": REPORT_POLICY}
        if "keep" in request.query_params:
            return FileResponse(path, filename=path.name, headers=headers)
        kind = TYPES.get(path.suffix, "application/octet-stream")
        return FileResponse(path, media_type=kind, headers=headers)

    async def events(self, _request: Request) -> Response:
        """Tell the page of every command for as long as it is open."""
        session = self.session

        async def told() -> AsyncIterator[str]:
            session.pages, session.seen = session.pages + 1, True
            try:
                yield ": open\n\n"
                async for job in session.jobs.events():
                    yield ": \n\n" if job is None else f"data: {json.dumps(job.told())}\n\n"
            finally:
                session.pages -= 1

        return StreamingResponse(told(), media_type="text/event-stream")


def _number(text: str) -> float:
    """Return a number that the page sent.

    Raises
    ------
    InputError
        If it is none.
    """
    try:
        return float(text)
    except ValueError as error:
        raise InputError("a number", expected="a number", got=repr(text), remedy="correct it") from error


async def _body(request: Request) -> bytes:
    """Return what the page sent, if it is not too much."""
    found = bytearray()
    async for chunk in request.stream():
        found += chunk
        if len(found) > REQUEST:
            raise InputError("what was sent", expected=f"at most {REQUEST} bytes", got="more", remedy="reload the page")
    return bytes(found)


def _chosen(body: bytes) -> list[int]:
    """Return the runs that the page named."""
    try:
        found = json.loads(body)
    except UNREADABLE:
        found = None
    if not isinstance(found, list) or not found or not all(isinstance(number, int) for number in found):
        raise InputError("which run", expected="its number", got="something else", remedy="reload the page")
    return found


def _model_of(job: Job) -> str:
    """Return the model.json of a fit, or the folder of a closed loop."""
    if job.status != "done" or job.out is None or job.task not in ("close-loop", "identify"):
        raise InputError("what to compare", expected="fits that are done", got=f"run {job.id}", remedy="choose others")
    return str(job.out / "model.json" if job.out.is_dir() else job.out)


def _data_words(given: list[str]) -> list[str]:
    """Return of a fit's words what names its data."""
    kept = ("--validation", "--input", "--output", "--column", "--unit", "--sample-time", "--undriven", "--trust")
    found = [given[1]]
    for place, word in enumerate(given):
        if word in kept:
            found += [word, given[place + 1]]
        elif word.partition("=")[0] in kept:
            found.append(word)
    return found


def _written(task: str) -> list[str]:
    """Return where the command that a person copies writes to: a name that is free in the working folder."""
    stem, suffix = {"close-loop": ("report", ""), "identify": ("model", ".json"), "check-data": ("check", ".html")}[
        task
    ]
    names = (f"{stem}{'' if number == 1 else f'-{number}'}{suffix}" for number in range(1, 10_000))
    return ["--out", next(name for name in names if not Path(name).exists())]


class _Server(uvicorn.Server):
    """A server that ends on Ctrl-C without passing it on: ending is what was asked."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def serve(
    path: Path | None = None,
    *,
    port: int = 0,
    browser: bool = True,
    keep: Path | None = None,
    first: float = FIRST,
    closed: float = CLOSED,
    ready: Callable[[str], None] | None = None,
) -> None:
    """Serve the page on this machine until it is closed, or Ctrl-C.

    Parameters
    ----------
    path : Path, optional
        File or folder that the page may read.
    port : int
        On 127.0.0.1; 0 for any that is free.
    browser : bool
        Open the page in the browser.
    keep : Path, optional
        Folder for uploads and results, which then stay; else they go with the session.
    first, closed : float
        Seconds to wait for a page to be opened, and after the last was closed; a running command is waited for.
    ready : callable, optional
        Called with the page's address, token included.

    Raises
    ------
    InputError
        If there is nothing to open, or the port is taken.
    """
    with contextlib.ExitStack() as stack:
        if keep is None:
            work = Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix="sysid-open-", ignore_cleanup_errors=True))
            )
        else:
            work = keep.absolute()
            work.mkdir(parents=True, exist_ok=True)
        reach = SessionFiles(path, work, stays=keep is not None)
        line = stack.enter_context(_socket(port))
        number = line.getsockname()[1]
        token = secrets.token_urlsafe(24)
        address = f"http://{HOST}:{number}/{token}/"

        async def begin() -> None:
            session = Session(reach)
            once = secrets.token_urlsafe(24) if browser and _has_screen() else None
            gate = Gate(application(session), token, number, once)
            server = _Server(
                uvicorn.Config(
                    gate, log_level="error", access_log=False, lifespan="off", ws="none", server_header=False,
                    timeout_graceful_shutdown=1,
                )
            )  # fmt: skip
            threading.Thread(target=_warm, args=(session,), daemon=True).start()
            ending = asyncio.create_task(_end(server, session, first, closed))
            if ready is not None:
                ready(address)
            if once is not None:
                first_address = f"http://{HOST}:{number}/{once}/"
                threading.Thread(target=webbrowser.open, args=(first_address,), daemon=True).start()
            try:
                await server.serve(sockets=[line])
            finally:
                await session.jobs.close()
                ending.cancel()

        asyncio.run(begin())


def _has_screen() -> bool:
    """Return False where only a browser of the terminal could be started, which would take it over."""
    return sys.platform in ("win32", "darwin") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")))


def _warm(session: Session) -> None:
    """Read the log that the page will open first, while the browser draws the page; where there is none, be ready."""
    logs = session.reach.names()["logs"]
    with contextlib.suppress(HarnessError, OSError):  # the page asks for it again and is told
        if len(logs) == 1 and not logs[0].endswith(".toml"):
            session.logs.describe(session.reach.path(logs[0]))
        else:
            session.logs.prepare()


async def _end(server: uvicorn.Server, session: Session, first: float, closed: float) -> None:
    """End the server once nobody has looked at the page for some time."""
    clock = asyncio.get_running_loop().time
    since = clock()
    while not server.should_exit:
        await asyncio.sleep(min(0.2, closed / 4))
        if session.pages or session.jobs.running:
            since = clock()
        elif clock() - since > (closed if session.seen else first):
            server.should_exit = True
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)  # a request that is cut off now is no fault
    session.jobs.end_events()


def _socket(port: int) -> socket.socket:
    """Return a socket on this machine only.

    Raises
    ------
    InputError
        If the port is taken or not allowed.
    """
    found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        found.bind((HOST, port))
        found.listen()  # who is given the address may ask at once
    except (OSError, OverflowError) as error:
        found.close()
        raise InputError(
            "port", expected="a free port of 127.0.0.1", got=f"{port}: {error}", remedy="leave --port out",
            place="--port",
        ) from error  # fmt: skip
    return found
