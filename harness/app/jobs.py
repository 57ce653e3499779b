"""The commands that run: each a ``sysid`` of its own in a child process, told line by line, and ended on demand."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.errors import InputError, printable

PROGRESS = re.compile(r"[^:]+: (\d+) %(?:, (.*))?")
"""How the command line tells its progress where standard error is no terminal."""
PATIENCE = 4.0
"""Seconds between asking a command to end and ending it."""
LINES, TEXT = 400, 1 << 20
"""Lines of progress and characters of a result that are kept."""
EVERY = "0.2"
"""Seconds between two lines of progress."""


@dataclass
class Job:
    """One command: what it is, how far it has come, what it said."""

    id: int
    number: int
    """Among those that a person started: checks of data are not counted."""
    task: str
    words: list[str]
    command: str
    out: Path | None = None
    title: str = ""
    status: str = "running"
    fraction: float = 0.0
    stages: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    error: str = ""
    text: str = ""
    begun: float = field(default_factory=time.time)
    seconds: float = 0.0
    process: asyncio.subprocess.Process | None = field(default=None, repr=False)

    def told(self) -> dict[str, Any]:
        """Return what the page shows."""
        names = (
            "id",
            "number",
            "task",
            "command",
            "title",
            "status",
            "fraction",
            "stages",
            "notes",
            "error",
            "seconds",
            "begun",
        )
        return {**{name: getattr(self, name) for name in names}, "files": self.files()}

    def files(self) -> list[str]:
        """Return what it wrote, but for what is kept to go on from."""
        if self.out is None or not self.out.exists():
            return []
        if self.out.is_file():
            return [self.out.name]
        found = [path for path in sorted(self.out.rglob("*")) if path.is_file()]
        return [path.relative_to(self.out).as_posix() for path in found if "candidates" not in path.parts]

    def hear(self, line: str) -> None:
        """Take in a line of standard error."""
        line = printable(line.strip())
        found = PROGRESS.fullmatch(line)
        if found is not None:
            self.fraction = int(found[1]) / 100
            stage = (found[2] or "").strip()
            if stage and (not self.stages or self.stages[-1]["what"] != stage) and len(self.stages) < LINES:
                self.stages.append({"what": stage, "at": round(time.time() - self.begun, 1)})
        elif line.startswith("sysid: note: "):
            self.notes.append(line.removeprefix("sysid: note: "))
        elif line.startswith("sysid: "):
            self.error = line.removeprefix("sysid: ")


class Jobs:
    """The commands of a session, one at a time of each kind.

    Parameters
    ----------
    plain : callable
        Makes what a command says readable.
    """

    def __init__(self, plain: Callable[[str], str] = str) -> None:
        self.plain = plain
        self.all: list[Job] = []
        self._hearers: set[asyncio.Queue[Job | None]] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def running(self) -> bool:
        """True while a command runs."""
        return any(job.status == "running" for job in self.all)

    def next_number(self, task: str) -> int:
        """Return what the next command of a kind is called: checks of data are counted apart."""
        return 1 + sum((job.task == "check-data") == (task == "check-data") for job in self.all)

    def find(self, number: int) -> Job:
        """Return a command by its number.

        Raises
        ------
        InputError
            If there is none.
        """
        for job in self.all:
            if job.id == number:
                return job
        raise InputError("no such run", expected="a run of this session", got=str(number), remedy="reload the page")

    async def start(
        self,
        task: str,
        words: Sequence[str],
        command: str,
        out: Path | None = None,
        title: str = "",
        cwd: Path | None = None,
    ) -> Job:
        """Start a command and return at once.

        Raises
        ------
        InputError
            If one of its kind is still running; of a check of data, that one is ended.
        """
        busy = [
            job for job in self.all if job.status == "running" and (job.task == "check-data") == (task == "check-data")
        ]
        for job in busy:
            if task != "check-data":
                raise InputError(
                    "a run is not finished", expected="one at a time", got=job.task, remedy="wait for it, or cancel it"
                )
            await self.cancel(job)
        job = Job(len(self.all) + 1, self.next_number(task), task, list(words), command, out, title)
        self.all.append(job)
        # -P: what lies in the working folder is not imported, as it is not by the installed sysid
        job.process = await asyncio.create_subprocess_exec(
            sys.executable, "-P", "-m", "harness", *words,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, limit=TEXT,
            cwd=cwd, env={**os.environ, "SYSID_HARNESS_PROGRESS": EVERY}, **_group(),
        )  # fmt: skip
        waiting = asyncio.create_task(self._follow(job))
        self._tasks.add(waiting)
        waiting.add_done_callback(self._tasks.discard)
        self._tell(job)
        return job

    async def cancel(self, job: Job) -> None:
        """End a command: first as Ctrl-C does, so that it puts its things away, then at once."""
        if job.process is None or job.status != "running":
            return
        job.status = "cancelling"
        self._tell(job)
        _interrupt(job.process)
        with suppress(TimeoutError):
            await asyncio.wait_for(job.process.wait(), PATIENCE)
        _kill(job.process)

    async def close(self) -> None:
        """End all of them."""
        await asyncio.gather(*(self.cancel(job) for job in self.all))
        for waiting in list(self._tasks):
            with suppress(asyncio.CancelledError, TimeoutError):
                await asyncio.wait_for(waiting, PATIENCE)

    async def events(self) -> AsyncIterator[Job | None]:
        """Yield each command whenever there is news of it; None now and then, to see who still listens."""
        queue: asyncio.Queue[Job | None] = asyncio.Queue()
        self._hearers.add(queue)
        try:
            while True:
                try:
                    news = await asyncio.wait_for(queue.get(), 2.0)
                except TimeoutError:
                    yield None
                    continue
                if news is None:
                    return
                yield news
        finally:
            self._hearers.discard(queue)

    def end_events(self) -> None:
        """End all iterations over :meth:`events`."""
        for queue in self._hearers:
            queue.put_nowait(None)

    def _tell(self, job: Job) -> None:
        job.seconds = round(time.time() - job.begun, 1)
        for queue in self._hearers:
            queue.put_nowait(job)

    async def _follow(self, job: Job) -> None:
        """Hear a command to its end."""
        process = job.process
        assert process is not None
        assert process.stderr is not None
        assert process.stdout is not None
        result = asyncio.create_task(_read(process.stdout))
        try:
            async for line in process.stderr:
                job.hear(self.plain(line.decode("utf-8", "replace")))
                self._tell(job)
        except ValueError:  # a line longer than any that the command line writes
            _kill(process)
        job.text = self.plain(printable(await result))
        code = await process.wait()
        _kill(process)  # what it left behind
        if job.status == "cancelling":
            job.status, job.error = "cancelled", ""
        else:
            job.status = "done" if code == 0 else "failed"
            job.fraction = 1.0 if code == 0 else job.fraction
            if code and not job.error:
                job.error = f"the command ended with status {code}"
        self._tell(job)


async def _read(stream: asyncio.StreamReader) -> str:
    """Return what a command writes, cut where it is too much, and read to the end."""
    kept = bytearray()
    while chunk := await stream.read(1 << 16):
        kept += chunk[: max(0, TEXT - len(kept))]
    return kept.decode("utf-8", "replace")


def _group() -> dict[str, Any]:
    """Return how a child is put into a group of its own, to be interrupted and ended with all that it starts."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def _interrupt(process: asyncio.subprocess.Process) -> None:
    """Send what Ctrl-C sends."""
    with suppress(ProcessLookupError, PermissionError):
        if sys.platform == "win32":
            process.send_signal(signal.CTRL_BREAK_EVENT)
        else:
            process.send_signal(signal.SIGINT)


def _kill(process: asyncio.subprocess.Process) -> None:
    """End a child and its group."""
    with suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        elif process.returncode is None:
            process.kill()
