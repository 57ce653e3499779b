"""The command of ``sysid`` that opens a page in the browser."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

import typer

from harness.cli.terminal import say
from harness.errors import InputError

NEEDED = ("starlette", "uvicorn")
"""What the extra ``app`` brings."""


def open_page(
    path: Annotated[
        Path | None,
        typer.Argument(metavar="FILE|FOLDER", help="what the page may read: a log, a dataset.toml, a folder"),
    ] = None,
    browser: Annotated[bool, typer.Option(help="open the page in the browser")] = True,
    port: Annotated[int, typer.Option(min=0, max=65535, help="on 127.0.0.1; default any that is free")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="folder that keeps uploads and results; default: nothing is kept")
    ] = None,
) -> None:
    """Look at logs and close the loop on a page in the browser, served to this machine only and offline."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            "a page in the browser", expected=f"{' and '.join(NEEDED)} installed", got=f"no {' and no '.join(missing)}",
            remedy="pip install 'sysid-harness[app]'",
        )  # fmt: skip
    from harness.app.server import serve

    def ready(address: str) -> None:
        print(f"open {address}", flush=True)
        say("Ctrl-C ends it, and so does closing the page")

    serve(path, port=port, browser=browser, keep=out, ready=ready)
