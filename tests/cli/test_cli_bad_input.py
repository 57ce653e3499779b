"""Bad input, tried by hand: one line on standard error, exit status 2, never a traceback."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api
from harness.command import main
from harness.errors import InputError

ESTIMATION = "u [N m],theta [rad],time [s]\n" + "".join(
    f"{0.1 * (-1) ** (k // 7)},{0.01 * k * (40 - k)},{0.01 * k:.2f}\n" for k in range(60)
)
DATASET = """
name = "bench pendulum"
sample_time = 0.01
signals.u = { role = "input", unit = "N m", column = "u [N m]" }
signals.theta = { role = "output", unit = "rad", column = "theta [rad]" }
[nominal]
model = "pendulum"
[[runs]]
use = "estimation"
file = "estimation.csv"
[[runs]]
file = "validation.csv"
use = "validation"
"""


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one line that the command leaves with."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    captured = capsys.readouterr()
    assert caught.value.code == 2, captured.err
    assert "Traceback" not in captured.err + captured.out
    lines = [line for line in captured.err.splitlines() if line.strip()]
    assert len(lines) == 1, captured.err
    assert "remedy" in lines[0]
    return lines[0]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a small data set that could be used."""
    (tmp_path / "estimation.csv").write_text(ESTIMATION)
    (tmp_path / "validation.csv").write_text(ESTIMATION.replace("0.1,", "0.2,"))
    (tmp_path / "dataset.toml").write_text(DATASET)
    return tmp_path


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    """Return a change to one file of the folder."""

    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return change


def rewrite(name: str, rows: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    """Return a change to the rows of one file, its header kept."""

    def change(folder: Path) -> None:
        header, *body = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join([header, *rows(body)]) + "\n")

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda folder: (folder / "estimation.csv").unlink(), ["estimation.csv"]),
        (lambda folder: (folder / "dataset.toml").unlink(), ["dataset.toml"]),
        (edit("dataset.toml", '"theta [rad]"', '"thta"'), ["thta", "theta"]),
        (edit("dataset.toml", 'unit = "rad"', 'unit = "V"'), ["signals.theta.unit", "rad", "V"]),
        (edit("dataset.toml", 'unit = "rad"', 'unit = "gnats"'), ["signals.theta.unit", "gnats"]),
        (edit("dataset.toml", 'role = "output"', 'roll = "output"'), ["dataset.toml", "roll"]),
        (edit("dataset.toml", 'role = "output"', 'role = "sensor"'), ["dataset.toml", "sensor"]),
        (edit("dataset.toml", "sample_time = 0.01", "sample_time = -1.0"), ["sample_time"]),
        (edit("dataset.toml", 'model = "pendulum"', 'model = "pendulm"'), ["pendulm", "pendulum"]),
        (edit("dataset.toml", "signals.theta = { ", 'signals.theta = { port = "u", '), ["u"]),
        (edit("dataset.toml", "[nominal]", "[nominal"), ["dataset.toml"]),
        (rewrite("estimation.csv", lambda rows: rows[:1]), ["estimation.csv"]),
        (rewrite("estimation.csv", lambda rows: ["0.1,0.0," + row.split(",")[2] for row in rows]), ["never move"]),
        (
            rewrite("estimation.csv", lambda rows: [*rows[:30], "0.1,nan,0.30", *rows[31:]]),
            ["estimation.csv", "nan"],
        ),
        (rewrite("estimation.csv", lambda rows: [*rows[:30], "0.1,oops,0.30", *rows[31:]]), ["estimation.csv", "oops"]),
    ],
)
def test_a_data_set_that_cannot_be_used(
    change: Callable[[Path], None], words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change(folder)
    line = refused(["close-loop", str(folder / "dataset.toml"), "--out", str(folder / "out")], capsys)
    for word in words:
        assert word.lower() in line.lower(), line
    assert not (folder / "out" / "report.json").exists()


@pytest.mark.parametrize(
    "rows",
    [
        lambda rows: rows[:20] + rows[25:],  # a gap
        lambda rows: [row.replace("0.30", "0.305") for row in rows],  # jitter
        lambda rows: rows[:20] + rows[10:],  # time runs back
    ],
)
def test_time_that_is_not_uniform(
    rows: Callable[[list[str]], list[str]], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite("estimation.csv", rows)(folder)
    file = str(folder / "estimation.csv")
    line = refused(["close-loop", file, "--model", "pendulum", "--out", str(folder / "out")], capsys)
    assert "estimation.csv" in line
    assert "resample" in line or 'gaps = "split"' in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "pendulum-od", "--scenario", "multisine"], ["pendulum-od", "did you mean pendulum-ode"]),
        (["simulate", "pendulum-ode", "--scenario", "multisin"], ["did you mean multisine"]),
        (["simulate", "pendulum-ode", "--scenario", "multisine", "--option", "mass=3"], ["mass"]),
        (["simulate", "pendulum-ode", "--scenario", "multisine", "--option", "mass"], ["k=v"]),
        (["simulate", "pendulum-ode", "--scenario", "multisine", "-o", "run.xlsx"], [".csv or .parquet"]),
        (["simulate", "pendulum-ode", "--scenario", "multisine", "--hide", "coulomb_friction"], ["EFFECT@PORT"]),
        (["simulate", "pendulum-ode", "--scenario", "multisine", "--hide", "gremlin@theta:k=1"], ["gremlin"]),
        (["bench", "quik"], ["quik", "quick"]),
        (["bench", "quick", "--seeds", "3..1"], ["A..B"]),
        (["bench", "quick", "--engine", "slurm://x"], ["slurm"]),
        (["list", "gadgets"], ["gadgets", "plants"]),
        (["close-loop", "emp", "--out", "out"], ["emp"]),
        (["close-loop", "no/such/file.csv", "--out", "out"], ["no/such/file.csv"]),
        (["check", "no-such-part"], ["no-such-part"]),
        (["table", "no/such/folder"], ["no/such/folder"]),
        (["export", "no/such/folder", "-o", "m.fmu"], ["no/such/folder"]),
        (["identify", "no/such.toml", "--identifier", "dmdc"], ["no/such.toml"]),
        (["simulate"], ["PLANT"]),
        (["frobnicate"], ["frobnicate"]),
    ],
)
def test_words_that_mean_nothing(
    arguments: list[str],
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    line = refused(arguments, capsys)
    for word in words:
        assert word in line
    assert list(tmp_path.iterdir()) == [], "nothing is left behind"


def test_an_fmu_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fake = tmp_path / "fake.fmu"
    fake.write_text("not a zip")
    for arguments in (["list", str(fake)], ["simulate", str(fake), "--scenario", "multisine"]):
        line = refused(arguments, capsys)
        assert "fake.fmu" in line
        assert "zip" in line
    assert "missing.fmu" in refused(["list", str(tmp_path / "missing.fmu")], capsys)


@pytest.mark.parametrize(
    "line",  # what is not there stands in braces
    [
        "list {run7.csv}",
        "list {run7.toml}",
        "list {arm.urdf}",
        "list {model.json}",
        "check-data {run7.csv}",
        "identify {run7.csv} --identifier arx",
        "identify estimation.csv --model {swing.eqs} --identifier output-error",
        "simulate {run7.json}",
        "simulate {arm.urdf} --scenario multisine",
        "simulate {rig.ssp}",
        "compare {model.json} dataset.toml",
        "compare {run7} run8 dataset.toml",
        "open {run7.csv}",
        "equations {model.json}",
        "equations {arm.mjcf}",
        "equations {swing.py}:swing",
        "equations {run7.csv}",
        "modes {run7.csv}",
        "spectrum {run7}",
        "table {results/quick}",
        "query {results/quick} 'select 1'",
        "export {run7.json} -o out.fmu",
        "learn-residual {report} dataset.toml --out learned",
        "check {mine.csv}",
        "check {mine.py}:Mine",
        "isolability {theirs.fmu} --scenario multisine",
        "close-loop {run7.csv} --model pendulum --out out",
        "close-loop estimation.csv --model {theirs.xml} --out out",
        "close-loop fleet.csv --model pendulum --out out",
    ],
)
def test_what_is_not_there_is_said_to_be_not_there(
    line: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    (folder / "fleet.csv").write_text("file,machine,date\nrun7.csv,A,2026-01-01\n")
    said = refused(shlex.split(re.sub(r"[{}]", "", line)), capsys)
    assert re.search(r"no such (file|folder|model|recording)|got no (file|'run7)", said), said
    missing = re.search(r"\{(.*)\}", line)
    assert (missing[1] if missing else "run7.csv") in said  # which the table of the fleet names
    assert "Errno" not in said


def test_a_name_near_the_one_that_is_not_there_is_told(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert "no file (near it: estimation.csv" in refused(["list", "estimatoin.csv"], capsys)
    assert "did you mean" not in refused(["list", "run7"], capsys)  # may be the id of a part as well
    (folder / "bag").mkdir()  # a folder is no recording that is unknown
    assert "bag: no such data set: expected a dataset.toml" in refused(["check-data", "bag"], capsys)


def test_a_bare_csv_needs_its_model(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(["close-loop", str(folder / "estimation.csv"), "--out", str(folder / "out")], capsys)
    assert "--model" in line


def test_a_missing_recording_says_where_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SYSID_HARNESS_DATA", str(tmp_path))
    line = refused(["close-loop", "emps", "--out", str(tmp_path / "out")], capsys)
    assert "DATA_EMPS.mat" in line
    assert "nonlinearbenchmark.org" in line or "http" in line


def test_a_validation_run_that_is_the_estimation_run(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "validation.csv").write_text(ESTIMATION)
    line = refused(["close-loop", str(folder / "dataset.toml"), "--out", str(folder / "out")], capsys)
    assert "validation" in line


def test_nothing_is_overwritten_unasked(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "run.csv"
    out.write_text("mine")
    line = refused(["simulate", "pendulum-ode", "--scenario", "multisine", "-o", str(out)], capsys)
    assert "--force" in line
    assert out.read_text() == "mine"


@pytest.mark.parametrize(("words", "remedy"), [
    ("simulate pendulum", "did you mean pendulum-ode"),  # before a scenario is asked for
    ("simulate pendulum-ode --scenario steps -O J=2", "-O parameters.J="),
    ("simulate pendulum-ode --scenario steps --hide coulomb@theta:Fc=1", "did you mean coulomb_friction"),
    ("simulate pendulum-ode --scenario steps --hide coulomb_friction@hinge:Fc=1", "write coulomb_friction@theta"),
    ("simulate pendulum-ode --scenario steps --seed 1..5", "got '1..5'; remedy: sysid simulate --help"),
    ("identify estimation.csv --input u,theta --output theta", "name each by itself"),
    ("identify estimation.csv --input u --output theta --identifier ARX", "did you mean arx"),
    ("identify estimation.csv --input u --output theta --column theta", "--column NAME=theta"),
    ("identify estimation.csv --input u --output theta --run valid=validation.csv", "did you mean validation?"),
    ("compare estimation.csv other.json", "name models first and the data set last"),
    ("compare other.json estimation.csv", "got JSON without a 'kind'"),
    ("export empty -o x.fmu", "got a folder without model.json"),
    ("check estimation.csv", "--reference FILE"),
    ("list pendlum", "did you mean pendulum"),
    ("list empty", "name a file"),
    ("list other.json", "JSON that holds no table"),
    ("list words.txt", "got words alone"),
    ("record-length estimation.csv", "sysid analyse record-length SUBJECT"),
    ("new robot arm", "dataset (of files)"),
])  # fmt: skip
def test_a_newcomer_is_told_what_came_and_what_to_write(
    folder: Path, words: str, remedy: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    (folder / "empty").mkdir()
    (folder / "other.json").write_text('{"a": 1}')
    (folder / "words.txt").write_text("hello\nthis is a note\n")
    assert remedy in refused(shlex.split(words), capsys)


def test_a_refused_dictionary_leaves_nothing_that_looks_like_an_interrupted_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, seed in (("estimation", 0), ("validation", 1)):
        u, noise = np.random.default_rng(seed).standard_normal((2, 160))
        theta = np.convolve(u, 0.02 * 0.9 ** np.arange(60))[:160] + 1e-3 * noise
        table = np.c_[u, theta, 0.01 * np.arange(160)]
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=ESTIMATION.split("\n")[0], comments="")
    words = ["close-loop", str(folder / "dataset.toml"), "--out", str(folder / "out"), "--dictionary", "coulomb"]
    for _ in range(2):
        assert "did you mean coulomb_friction" in refused(words, capsys)


@pytest.mark.parametrize(("how", "remedy"), [
    ({"options": "order=2"}, 'write {"NAME": value}'),
    ({"unit": "m"}, "unit={NAME: 'm'}"),
    ({"column": "theta"}, "column={NAME: 'theta'}"),
    ({"sample_time": "0.05"}, "a number of seconds"),
    ({"model": 3, "identifier": "output-error"}, "FILE.py:NAME"),
])  # fmt: skip
def test_arguments_of_another_kind_are_refused_in_python(folder: Path, how: dict, remedy: str) -> None:
    with pytest.raises(InputError) as caught:
        api.identify(folder / "estimation.csv", **{"input": "u", "output": "theta", "identifier": "arx", **how})
    assert remedy in str(caught.value)


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("deep.toml", ("bench", "deep.toml")),
        ("deep.toml", ("simulate", "deep.toml")),
        ("deep.toml", ("close-loop", "deep.toml", "--out", "report")),
        ("deep.toml", ("check-data", "deep.toml")),
        ("model.json", ("list", "model.json")),
        ("report.json", ("compare", "report.json", "report.json")),
        ("model.json", ("export", "model.json", "-o", "x.fmu")),
    ],
)
def test_brackets_deeper_than_a_reader_goes_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sysid: Callable[..., Any], name: str, command: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).write_text(("a = " if name.endswith(".toml") else '{"kind": ') + "[" * 5000)
    _, said = sysid(*command, status=2)
    assert len(said.strip().splitlines()) == 1
    assert name in said
