"""The ``sysid`` command: words and printing only; what it does is in :mod:`harness.api`.

Exit status: 0 done (whatever the verdict), 1 done and it fails what was asked (``--fail-on``, ``--max-error``,
``sysid check``), 2 input that cannot be used, 70 a fault of ours, 130 interrupted.
"""

from __future__ import annotations

import copy
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from harness import __version__, api
from harness.cli.loop import close_loop, isolability, learn_residual
from harness.cli.models import check_data, compare, export, identify, order, spectrum
from harness.cli.opening import open_page
from harness.cli.options import AsJson, Force, Inputs, ModelName, Outputs, Sheet
from harness.cli.results import print_fmu, print_parts, print_system
from harness.cli.runs import bench, query, simulate, table
from harness.cli.structures import analyse, equations, modes
from harness.cli.terminal import fail, print_json, print_rows, print_written, say
from harness.cli.vetting import check
from harness.errors import HarnessError, InputError
from harness.parts.files import is_system
from harness.registry import singular
from harness.supervision.interrupts import INTERRUPTED, Interrupts
from harness.trust import names_fmu

OWN_FAULT = 70
"""Exit status of a fault in this program: EX_SOFTWARE of sysexits.h (4.0BSD)."""

app = typer.Typer(
    name="sysid",
    help="Co-simulation test harness for system identification that closes the loop with measured data.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_NAMED_ALIKE = (simulate, bench, table, query, identify, compare, spectrum, order, modes, analyse, isolability)
for _command in (*_NAMED_ALIKE, export, equations, check):
    app.command()(_command)
app.command(name="check-data")(check_data)
app.command(name="close-loop")(close_loop)
app.command(name="learn-residual")(learn_residual)
app.command(name="open")(open_page)


def _holds_data(path: Path) -> bool:
    """Return True for a file, and for the folder of a bag of ROS 2 or of a closed loop."""
    inside = ("metadata.yaml", "report.json")
    return (bool(path.suffix) and path.is_file()) or any((path / name).is_file() for name in inside)


@app.command(name="list")
def list_command(
    what: Annotated[str | None, typer.Argument(help=f"{' | '.join(api.LISTED)} | ID | FILE")] = None,
    sheet: Sheet = None,
    as_json: AsJson = False,
) -> None:
    """List what is registered, or show what is in a file: data, a robot, an FMU or system, a model, a report."""
    if what is not None and names_fmu(what):
        description = api.describe_fmu(what)
        if as_json:
            print_json(description)
        else:
            print_fmu(description)
        return
    if what is not None and is_system(what):
        system = api.describe_system(what)
        if as_json:
            print_json(system)
        else:
            print_system(system)
        return
    if what is not None and what not in api.LISTED and _holds_data(Path(what)):
        found = api.describe_file(what, sheet)
        if as_json:
            print_json(found["content"])
            return
        for fact in found["facts"]:
            say(fact)
        for rows in found["tables"].values():
            if rows:
                print_rows(rows)
        return
    if what is not None and what not in api.LISTED and (part := api.describe_part(what)) is not None:
        if as_json:
            print_json(part)
            return
        say(f"{part['id']} ({singular(part['kind'])} of {part['distribution']}): {part['text']}")
        for title, fact in part["facts"].items():
            say(f"{title}: {fact}")
        print_rows(part["options"])
        return
    parts = api.list_parts(what)
    if as_json:
        print_json(parts)
        return
    print_parts(parts)


@app.command(name="study", hidden=True, context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def study(context: typer.Context) -> None:
    """Say which command replaces this one."""
    words = " ".join(context.args)
    raise InputError(
        "sysid study",
        expected="the command sysid-lab, which is a distribution of its own",
        got=f"sysid study {words}".rstrip(),
        remedy=f"pip install sysid-harness-lab (from a checkout: pip install -e lab), then sysid-lab {words}".rstrip(),
    )


@app.command()
def new(
    kind: Annotated[
        str, typer.Argument(metavar="KIND", help="identifier | plant | scenario | effect | model | dataset")
    ],
    name: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME", help="id of the plug-in, such as soft-friction; for dataset the files, one for each run"
        ),
    ],
    folder: Annotated[Path, typer.Option(help="folder in which sysid-NAME/ or dataset.toml is written")] = Path("."),
    model: ModelName = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    sheet: Sheet = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="of dataset: file to write; default dataset.toml in --folder")
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Write a plug-in to start from, which passes its checks; or draft a dataset.toml from data files."""
    from harness.scaffold import entry_name

    if kind == "dataset":
        out = api.new_dataset(
            name,
            model=model,
            out=out or folder / "dataset.toml",
            sheet=sheet,
            input=inputs or (),
            output=outputs or (),
            force=force,
        )
        print_written([out], as_json=as_json)
        if not as_json:
            asked = 'replace each "?" in it, then ' if '"?"' in out.read_text(encoding="utf-8") else ""
            say(f"now: {asked}sysid {'identify' if model is None else 'close-loop'} {out}")
        return
    if out is not None:
        raise InputError("--out", expected="a file of new dataset", got=f"new {kind}", remedy="give --folder")
    if len(name) > 1:
        raise InputError("name of a plug-in", expected="one", got=" ".join(name), remedy="begin them one by one")
    print_written(api.new(kind, name[0], folder=folder), as_json=as_json)
    if not as_json:
        say(f"now: cd {folder / f'sysid-{name[0]}'} && pip install -e . && sysid check {entry_name(kind, name[0])}")


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="print the version")] = False) -> None:
    """Co-simulation test harness for system identification that closes the loop with measured data."""
    if version:
        say(f"sysid-harness {__version__}")
        raise typer.Exit()


def run(
    arguments: Sequence[str] | None, interrupts: Interrupts, *, application: typer.Typer = app, program: str = "sysid"
) -> int:
    """Run a command line and return the exit status; every failure is one line on standard error."""
    from typer.main import get_command

    for name in ("stdin", "stdout", "stderr"):  # a descriptor that the caller closed
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r+", encoding="utf-8"))
    try:
        words = sys.argv[1:] if arguments is None else arguments
        code = get_command(_asked(application, words)).main(
            args=None if arguments is None else list(arguments), prog_name=program, standalone_mode=False
        )
        if code == INTERRUPTED or interrupts.seen:  # a library turns Ctrl-C into a status, or swallows it
            raise KeyboardInterrupt
        sys.stdout.flush()
        return code if isinstance(code, int) else 0
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):  # the reader has seen enough
            return 0
        raise
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted()
    except Exception as error:
        return _interrupted() if interrupts.seen else _failed(error)


def _asked(application: typer.Typer, words: Sequence[str]) -> typer.Typer:
    """Return the application with the command alone that is asked for by name: building all of them takes 20 ms."""
    own = [one for one in application.registered_commands if words and _name_of(one) == words[0]]
    if len(own) != 1 or application.registered_callback is None:  # without it one command alone has no name to type
        return application
    alone = copy.copy(application)
    alone.registered_commands, alone.registered_groups = own, []
    return alone


def _name_of(command: Any) -> str:
    """Return what a command is called by: its name, or that of its function."""
    from typer.main import get_command_name

    return str(command.name or get_command_name(command.callback.__name__))


def _interrupted() -> int:
    """Say that Ctrl-C was heard."""
    text = "interrupted; what was finished is kept: --resume continues, a fit goes on from its checkpoint"
    return fail(text, INTERRUPTED)


def _misused(error: Any) -> str:
    """Return what is wrong with the words of a command line, what came, and what to do."""
    text, command = error.format_message(), getattr(getattr(error, "ctx", None), "command_path", None) or "sysid"
    if callable(found := getattr(error.__cause__, "errors", None)):  # of pydantic, which keeps what came
        text = f"{text.partition(', unable')[0]}, got {found()[0].get('input')!r}"
    if (unknown := re.match("No such command '(.+?)'", text)) and (part := api.describe_part(unknown[1])) is not None:
        asked = "analyse WORD SUBJECT" if part["kind"] == "analyses" else "list WORD"
        return f"{text} It is one of the {part['kind']}; remedy: sysid {asked.replace('WORD', unknown[1])}"
    return f"{text}; remedy: {command} --help"


def _failed(error: Exception) -> int:
    """Say what went wrong, and whose it is."""
    if isinstance(error, OSError):
        from harness.data.whole_files import refused_by_system

        error = refused_by_system(error) or error
    debug = bool(os.environ.get("SYSID_HARNESS_DEBUG"))
    if debug and isinstance(error.__cause__, TypeError | ValueError | AttributeError | LookupError):
        raise error
    if isinstance(error, HarnessError):
        return fail(" ".join(str(error).split()), 2)
    if hasattr(error, "format_message") and hasattr(error, "exit_code"):
        return fail(_misused(error), 2)
    if debug:
        raise error
    return fail(
        f"a fault in sysid-harness: {type(error).__name__}: {' '.join(str(error).split())}; "
        "remedy: set SYSID_HARNESS_DEBUG=1 for the traceback and report it",
        OWN_FAULT,
    )
