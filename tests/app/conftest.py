"""A small log, a session over its folder, and a client that is let in."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

pytest.importorskip("starlette", reason="the extra app is not installed")
pytest.importorskip("uvicorn", reason="the extra app is not installed")

from harness.app.gate import Gate
from harness.app.reach import SessionFiles
from harness.app.server import Session, application

PORT = 5999
TOKEN = "right-token"
HOST = f"127.0.0.1:{PORT}"
ADDRESS = f"http://{HOST}"


def write_log(path: Path, header: str = "time [s],u [V],y [m]", n: int = 400, seed: int = 0) -> Path:
    """Write a first-order system with a little noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 5), 5)
    y = np.zeros(n)
    for k in range(n - 1):
        y[k + 1] = 0.9 * y[k] + 0.2 * u[k]
    y += 1e-3 * rng.standard_normal(n)
    np.savetxt(path, np.c_[0.1 * np.arange(n), u, y], delimiter=",", header=header, comments="", fmt="%.8g")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder to open, with a log, and a secret beside it."""
    opened = tmp_path / "opened"
    opened.mkdir()
    write_log(opened / "log.csv")
    write_log(tmp_path / "secret.csv")
    (tmp_path / "work").mkdir()
    return opened


@pytest.fixture
def reach(folder: Path) -> SessionFiles:
    return SessionFiles(folder, folder.parent / "work")


Work = Callable[[httpx.AsyncClient, Session], Awaitable[Any]]


@pytest.fixture
def inside(reach: SessionFiles) -> Callable[[Work], Any]:
    """Run a coroutine with a client that knows the token and comes from the page, then end what it started."""

    def run(work: Work) -> Any:
        async def begun() -> Any:
            session = Session(reach)
            transport = httpx.ASGITransport(Gate(application(session), TOKEN, PORT), raise_app_exceptions=False)
            async with httpx.AsyncClient(
                transport=transport, base_url=f"{ADDRESS}/{TOKEN}/", headers={"origin": ADDRESS}
            ) as client:
                try:
                    return await work(client, session)
                finally:
                    await session.jobs.close()

        coroutine: Coroutine[Any, Any, Any] = begun()
        return asyncio.run(coroutine)

    return run


@pytest.fixture
def finished() -> Callable[..., Awaitable[Any]]:
    """Wait for the end of a command."""
    return _finished


async def _finished(session: Session, number: int, seconds: float = 120.0) -> Any:
    job = session.jobs.find(number)
    async with asyncio.timeout(seconds):
        async for _ in session.jobs.events():
            if job.status not in ("running", "cancelling"):
                return job
