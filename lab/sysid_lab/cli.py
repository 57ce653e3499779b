"""The ``sysid-lab`` command: the closed loop on simulated truths, and the same records for other tools."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from harness.cli import app as cli
from harness.cli.options import AsJson, Engine, Force, Resume, Workers
from harness.cli.terminal import jobs_bar, print_json, print_written, say
from harness.supervision.interrupts import Interrupts

app = typer.Typer(
    name="sysid-lab",
    help="Try the closed loop, or another tool, on simulated truths.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
Seeds = Annotated[str, typer.Option(help="tuning, or judged: records that no threshold was chosen on")]
Records = Annotated[int | None, typer.Option(help="only the first so many of the plan, a balanced part")]
Plants = Annotated[str, typer.Option(help="separated by commas")]
Cells = Annotated[int, typer.Option(help="records of each effect, of 8 cells noise x size x disturbance")]
Alarms = Annotated[int, typer.Option(help="records with nothing missing, of each class")]


def run_study(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="folder for rows.csv, study.md and confusion.png")],
    seeds: Seeds = "tuning",
    records: Records = None,
    plants: Plants = "pendulum,cart-pole",
    workers: Annotated[int, typer.Option(help="processes")] = 2,
    cells: Cells = 4,
    alarms: Alarms = 400,
    budget: Annotated[float | None, typer.Option(metavar="MINUTES", help="then begin no more")] = None,
    engine: Engine = "local",
    resume: Resume = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Try the closed loop on simulated truths: confusion, false alarms, coverage, cost."""
    from sysid_lab.running import study

    which = str(context.info_name)
    with jobs_bar("study", which) as show:
        result = study(
            which,
            out=out,
            seeds=seeds,
            records=records,
            plants=_separated(plants),
            workers=workers,
            cells=cells,
            alarms=alarms,
            budget=budget,
            engine=engine,
            resume=resume,
            force=force,
            progress=show,
        )
    if as_json:
        print_json({"done": result.done, "planned": result.planned, "text": result.text, "folder": str(out)})
        return
    say(result.text)
    say(f"{result.done} of {result.planned} records done; tables: {out / 'study.md'}")


for _which, _help in {
    "confusion": "Every effect and none, two at once, laws outside the dictionary: what is right, tied, wrong, missed.",
    "false-alarms": "Records with nothing missing.",
    "coverage": "The same records: how many intervals hold the truth.",
    "cost": "Seconds for a record of 20 s, each run alone.",
    "all": "All of these.",
}.items():
    app.command(name=_which, help=_help)(run_study)


@app.command(name="generate")
def generate_study(
    out: Annotated[Path, typer.Option(help="folder for the records and how to answer")],
    truth: Annotated[Path, typer.Option(help="folder for truth.csv, elsewhere")],
    seeds: Seeds = "judged",
    secret: Annotated[int | None, typer.Option(help="instead of seeds: a number that only you know")] = None,
    records: Records = None,
    plants: Plants = "pendulum,cart-pole",
    cells: Cells = 4,
    alarms: Alarms = 400,
    like: Annotated[Path | None, typer.Option(metavar="ROWS", help="only the records of this rows.csv")] = None,
    workers: Workers = None,
    resume: Resume = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Write the records of the study for another tool, the truth apart."""
    from sysid_lab.package import generate

    with jobs_bar("records", "records") as show:
        made = generate(
            out,
            truth=truth,
            seeds=seeds,
            secret=secret,
            records=records,
            plants=_separated(plants),
            cells=cells,
            alarms=alarms,
            like=like,
            workers=workers,
            resume=resume,
            force=force,
            progress=show,
        )
    if as_json:
        print_json({"written": str(out), "truth": str(truth), "text": str(made)})
        return
    say(str(made))


@app.command(name="answer")
def answer_study(
    source: Annotated[
        Path, typer.Argument(metavar="FLEET|ROWS", help="folder of close-loop over records.csv, or rows.csv")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="answers.csv")],
    as_json: AsJson = False,
) -> None:
    """Write the answer file of the closed loop's own run."""
    from sysid_lab.leaderboard import answers_of_fleet, answers_of_rows, write_answers

    answers = answers_of_fleet(source) if source.is_dir() else answers_of_rows(source)
    write_answers(out, answers)
    if as_json:
        print_json({"written": str(out), "answers": len(answers)})
        return
    say(f"wrote {out}: {len(answers)} answers")


@app.command(name="baseline")
def baseline_study(
    method: Annotated[str, typer.Argument(metavar="METHOD", help="lasso, best-subset, stlsq or output-error")],
    records: Annotated[Path, typer.Argument(metavar="RECORDS", help="records.csv")],
    out: Annotated[Path, typer.Option("--out", "-o", help="answers.csv")],
    workers: Annotated[int, typer.Option(help="processes")] = 2,
    resume: Resume = False,
    as_json: AsJson = False,
) -> None:
    """Write the answer file of what others would do: sparse regression of the leftover force, or free runs and BIC."""
    from sysid_lab.baselines import answer_all

    with jobs_bar("baseline", method) as show:
        failed = answer_all(method, records, out, workers=workers, resume=resume, show=show)
    if as_json:
        print_json({"written": str(out), "failed": failed})
        return
    say("\n".join([f"wrote {out}", *(f"not answered: {name}: {reason}" for name, reason in failed.items())]))


@app.command(name="score")
def score_study(
    truth: Annotated[Path, typer.Argument(metavar="TRUTH", help="truth.csv")],
    answers: Annotated[list[Path], typer.Argument(metavar="ANSWERS...", help="answer files, one a tool")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="leaderboard.md")] = None,
    as_json: AsJson = False,
) -> None:
    """Judge answer files against the truth and put the tools side by side."""
    from sysid_lab.leaderboard import score

    text = score(truth, answers)[1]
    if as_json and out is None:
        print_json({"markdown": text})
        return
    if out is None:
        print(text, end="")
        return
    out.write_text(text, encoding="utf-8")
    print_written([out], as_json=as_json)


def _separated(text: str) -> list[str]:
    """Return the words of a list with commas."""
    return [word.strip() for word in text.split(",") if word.strip()]


def run(arguments: Sequence[str] | None, interrupts: Interrupts) -> int:
    """Run the command line and return the exit status; every failure is one line on standard error."""
    return cli.run(arguments, interrupts, application=app, program="sysid-lab")
