"""The public table is run, kept, resumed and written; what is missing or fails is a row."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.benchmark.public import bench_public, read_public, records
from harness.benchmark.public.blackbox import chosen, parted
from harness.benchmark.public.choices import Candidate, GreyChoice
from harness.benchmark.public.greybox import nominal_data, signals_of
from harness.benchmark.public.reading import found_in, read
from harness.benchmark.public.rules import RULES
from harness.benchmark.public.scores import simulated
from harness.cli.app import app
from harness.errors import InputError
from harness.signals import Trajectory

CHOICES = """
[cascaded-tanks.black]
validation = 0.25
candidates = [{ id = "arx", grid = { order = [1, 2] } }, { id = "arx", options = { order = 3 }, rows = 40 }]
[[cascaded-tanks.peers]]
id = "peer-nobody-has"
[coupled-drives.black]
validation = 0.25
candidates = [{ id = "stlsq" }]
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a set of second order, and the choices above."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(500, 2))
    y = np.zeros((500, 2))
    for k in range(2, 500):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1]
    y += 0.01 * rng.normal(size=y.shape)
    table = np.column_stack([u, y])
    for name, header in (("cascaded_tanks/dataBenchmark.csv", "uEst,uVal,yEst,yVal"),
                         ("coupled_drives/DATAUNIF.csv", "u11,u12,z11,z12")):  # fmt: skip
        (tmp_path / "data" / name).parent.mkdir(parents=True)
        np.savetxt(tmp_path / "data" / name, table, delimiter=",", header=header, comments="")
    (tmp_path / "choices.toml").write_text(CHOICES)
    monkeypatch.setenv("SYSID_HARNESS_DATA", str(tmp_path / "data"))
    return tmp_path


def run(folder: Path, **options: Any) -> Any:
    """Run the table of the fixture."""
    known = {"sets": ["cascaded-tanks", "emps"], "choices": folder / "choices.toml", "out": folder / "out"}
    return bench_public(**{**known, **options})


def test_the_validation_part_chooses_and_the_test_scores(folder: Path) -> None:
    said: list[str] = []
    result = run(folder, progress=lambda done, total, what: said.append(what))
    black = result.by_set["cascaded-tanks"]["black"]
    assert black.status == "ok"
    tried = {(one["identifier"], one["options"]["order"]): one["figure"] for one in black.tried}
    assert set(tried) == {("arx", 1), ("arx", 2), ("arx", 3)}
    assert tried["arx", 2] < tried["arx", 1]
    assert black.validation == min(value for value in tried.values() if value is not None)
    (figure,), (whole,) = black.figures, black.whole_record
    assert figure is not None
    assert whole is not None
    assert 0.009 < whole <= figure < 0.05
    rule = RULES["cascaded-tanks"]
    split = read(rule, found_in(rule))
    model, _, _ = chosen(rule, split.train, 0.25, [Candidate(id="arx", options={"order": 2})])
    assert model is not None
    test = split.tests[0][0]
    if "order 2" in black.model:
        error = simulated(model, test, 50)[50:] - test.y[50:]
        assert figure == pytest.approx(float(np.sqrt(np.mean(error**2))))
    assert any("on all of the data" in text for text in said)
    assert said[-1] == "done"


def test_what_is_missing_not_entered_or_fails_is_a_row(folder: Path) -> None:
    result = run(folder, sets=["cascaded-tanks", "coupled-drives", "emps", "ship"])
    found = {(cell.set, cell.column): cell for cell in result.cells}
    assert found["emps", "black"].status == "missing"
    assert "nonlinearbenchmark.org" in found["emps", "black"].reason
    assert found["ship", "black"].status == "missing"
    assert "identibench" in found["ship", "black"].reason
    assert found["cascaded-tanks", "grey"].status == "not entered"
    assert found["cascaded-tanks", "peer-nobody-has"].status == "unfit"
    assert "peer-nobody-has" in found["cascaded-tanks", "peer-nobody-has"].reason
    assert found["coupled-drives", "black"].status in ("unfit", "ok")
    made = list(csv.DictReader(io.StringIO((folder / "out" / "public.csv").read_text())))
    assert len(made) == len(records(result)) == 3 + 2 * 2 + 2 + 2
    best = next(row for row in made if row["set"] == "emps")
    assert (best["best_published"], best["window"], best["figure"]) == ("2.64", "20", "")


def test_the_tables_show_ours_beside_the_best_published(folder: Path) -> None:
    result = run(folder)
    figure = result.by_set["cascaded-tanks"]["black"].figures[0]
    assert figure is not None
    assert figure < 0.191  # that of the fixture, not of the tanks
    texts = {suffix: (folder / "out" / f"public.{suffix}").read_text() for suffix in ("md", "tex", "html")}
    assert "| 0.191* (grey box, Bayesian) | **0.0" in texts["md"]
    assert "EMPS (n = 20, nonlinearbenchmark.org): put DATA_EMPS.mat" in texts["md"]
    assert r"\textbf{0.0" in texts["tex"]
    assert "CITATION.cff. Versions: sysid-harness" in texts["tex"]
    assert texts["tex"].count("{") == texts["tex"].count("}")
    assert "&#10003;" in texts["html"]
    assert "http" not in texts["html"].split("Sets without data here")[0]
    again = read_public(folder / "out")
    assert [cell.figures for cell in again.cells] == [cell.figures for cell in result.cells]
    with pytest.raises(InputError, match="run sysid bench public first"):
        read_public(folder)


def test_a_finished_cell_is_kept_until_something_changes(folder: Path) -> None:
    first = run(folder).by_set["cascaded-tanks"]["black"]
    with pytest.raises(InputError, match="--resume"):
        run(folder)
    kept = folder / "out" / "cells" / "cascaded-tanks-black.json"
    content = json.loads(kept.read_text())
    kept.write_text(json.dumps({**content, "model": "kept"}))
    assert run(folder, resume=True).by_set["cascaded-tanks"]["black"].model == "kept"
    (folder / "choices.toml").write_text(CHOICES.replace("0.25", "0.3"))
    other = run(folder, resume=True, only="black").by_set["cascaded-tanks"]["black"]
    assert other.model != "kept"
    assert other.key != first.key
    data = folder / "data" / "cascaded_tanks" / "dataBenchmark.csv"
    data.write_text(data.read_text().replace("0", "1", 1))
    assert run(folder, resume=True, only="black").by_set["cascaded-tanks"]["black"].key != other.key


def test_a_cell_that_other_code_made_is_made_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.benchmark.public.running.own_code", lambda: "before" * 6)
    first = run(folder)
    assert "code beforebe" in (folder / "out" / "public.md").read_text()
    monkeypatch.undo()
    monkeypatch.setenv("SYSID_HARNESS_DATA", str(folder / "data"))
    again = run(folder, resume=True)
    old, new = (one.by_set["cascaded-tanks"]["black"] for one in (first, again))
    assert new.key != old.key
    assert new.code != old.code
    assert new.figures == old.figures


def test_a_part_of_the_table_leaves_the_rest_as_it_was(folder: Path) -> None:
    run(folder, sets=["cascaded-tanks"], only="black")
    both = run(folder, sets=["coupled-drives"], only="grey", resume=True)
    assert {(cell.set, cell.column) for cell in both.cells} == {("cascaded-tanks", "black"), ("coupled-drives", "grey")}


def test_options_that_cannot_be_meant_are_refused(folder: Path) -> None:
    with pytest.raises(InputError, match="sets of the public table"):
        run(folder, sets=["silver"])
    with pytest.raises(InputError, match="black, grey, peers"):
        run(folder, only="white")


def test_many_records_are_parted_whole_and_few_at_their_ends() -> None:
    spec = RULES["emps"].spec
    record = Trajectory(np.arange(8.0) * 1e-3, np.zeros((8, 1)), np.zeros((8, 1)), spec)
    learn, validate = parted([record] * 6, 0.17)
    assert ([len(one) for one in learn], [len(one) for one in validate]) == ([8] * 5, [8])
    learn, validate = parted([record] * 2, 0.25)
    assert ([len(one) for one in learn], [len(one) for one in validate]) == ([6, 6], [2, 2])


def test_the_loop_is_shown_no_test_record(recordings_folder: Path) -> None:
    rule, choice = RULES["emps"], GreyChoice(recording="emps")
    place = found_in(rule)
    assert place is not None
    split = read(rule, place)
    loaded, signals = nominal_data(rule, split.train, choice)
    assert [run.use for run in loaded.dataset.runs] == ["estimation", "validation"]
    together = np.vstack([run.trajectory.y for run in loaded.dataset.runs])
    assert np.array_equal(together, split.train[0].y)
    assert loaded.nominal is not None
    assert loaded.nominal.model == "drive"
    force = signals.of(split.tests[0][0]).u
    assert force[0, 0] == pytest.approx(35.15065188 * split.tests[0][0].u[0, 0])


def test_signals_of_recipes_are_those_of_the_published_files(recordings_folder: Path) -> None:
    from scenarios.recordings import load_recording

    rule = RULES["silverbox"]
    place = found_in(rule)
    assert place is not None
    test = signals_of(rule, GreyChoice(recording="silverbox")).of(read(rule, place).tests[0][0])
    recipe = load_recording("silverbox").dataset.test[0]  # the same rows, the first 50 left out
    assert np.allclose(test.u[50:], recipe.u, rtol=0, atol=1e-12)
    assert np.array_equal(test.y[50:], recipe.y)


def test_the_command_prints_the_table_or_json(folder: Path) -> None:
    from typer.testing import CliRunner

    call = ["bench", "public", "--sets", "cascaded-tanks", "--only", "black", "--choices", str(folder / "choices.toml")]
    shown = CliRunner().invoke(app, [*call, "--out", str(folder / "one")])
    assert shown.exit_code == 0, shown.output
    assert "0.191* (grey box, Bayesian)" in shown.output
    assert "public.html" in shown.output
    asked = CliRunner().invoke(app, [*call, "--out", str(folder / "two"), "--json"])
    (row,) = json.loads(asked.stdout)
    assert (row["set"], row["column"], row["status"]) == ("cascaded-tanks", "black", "ok")
    wrong = CliRunner().invoke(app, ["bench", "smoke", "--sets", "emps"])
    assert isinstance(wrong.exception, InputError)
    wrong = CliRunner().invoke(app, ["bench", "public", "--seeds", "0..3"])
    assert isinstance(wrong.exception, InputError)
    again = CliRunner().invoke(app, ["table", str(folder / "one")])
    assert again.exit_code == 0, again.output
    assert "0.191* (grey box, Bayesian)" in again.output
