"""What a person finds behind ``import harness``."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harness

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_every_name_is_there_and_lazy() -> None:
    assert 20 <= len(harness.__all__) <= 36
    for name in harness.__all__:
        assert getattr(harness, name) is not None, name
    with pytest.raises(AttributeError, match="no attribute 'trajectory'"):
        harness.trajectory  # noqa: B018
    code = "import sys, harness; print(sorted(m for m in sys.modules if m in ('numpy', 'pint', 'scipy', 'sympy')))"
    code += "; print([n for n in dir(harness) if n.startswith('_') and n != '__version__'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["[]", "[]"]


def test_rooms_are_imported_without_what_only_some_of_their_work_needs() -> None:
    rooms = "benchmark, comparison, conformance, cosim, data, effects, export, fleet, modal, physics, scoring, vetting"
    code = (
        f"import sys; from harness import {rooms}; from harness.data import load_dataset, write_trajectory;"
        "heavy = {'casadi', 'control', 'fmpy', 'lxml', 'matplotlib', 'pandas', 'pyarrow', 'scipy', 'sympy'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_class_of_a_part_comes_from_its_room() -> None:
    for group in ("plants", "identifiers", "scenarios", "analyses"):
        for point in metadata.entry_points(group=f"sysid_harness.{group}"):
            parts = point.module.split(".")
            if parts[0] not in ("plants", "identifiers", "scenarios") or point.attr == parts[-1]:
                continue
            room = importlib.import_module(".".join(parts[: 2 if len(parts) > 2 else 1]))
            assert point.attr in dir(room), point
            assert point.attr in room.__all__, point
    from identifiers.linear import Arx, arx
    from plants.fmu import FmuPlant

    assert Arx is arx.Arx
    assert FmuPlant.__module__ == "plants.fmu.plant"


def test_a_session_reads_as_a_person_would_write_it() -> None:
    record = harness.simulate("pendulum-ode", scenario="multisine", scenario_options={"duration": 4.0, "noise": 1e-3})
    fitted = harness.identify(record.measured(), model="pendulum", identifier="lumped-momentum")
    assert harness.simulation_error(fitted.model, record.measured()).nrmse[0] < 0.2
    for thing in (record, fitted, fitted.simulation_error["validation"][0]):
        text = repr(thing)
        assert text.startswith("<")
        assert len(text) < 250
        assert "\n" not in text
        assert thing._repr_html_().startswith("<div>")
    data = harness.load_dataset(record.measured(), model="pendulum")
    assert "estimation" in data._repr_html_()
    assert (
        repr(data.dataset) == "<Dataset (data): 1 estimation, 1 validation runs, u [N m] -> theta [rad] every 0.01 s>"
    )


def test_pages_escape_what_they_show() -> None:
    spec = harness.PlantSpec((), (harness.Channel("<script>", "m"),), 0.1)
    record = harness.Trajectory(np.arange(5) * 0.1, np.zeros((5, 0)), np.arange(5.0)[:, None], spec)
    assert "<script>" not in record._repr_html_()
    assert "&lt;script&gt;" in record._repr_html_()


def test_a_short_pulse_is_not_lost_in_a_drawing() -> None:
    from harness.display import drawing

    values = np.zeros(100_000)
    values[54_321] = 1.0
    shown = drawing(values, "pulse")
    assert "0 to 1" in shown
    assert len(shown) < 10_000


def test_a_record_can_be_plotted() -> None:
    record = harness.simulate("pendulum-ode", scenario="multisine", scenario_options={"duration": 1.0})
    figure = record.plot()
    assert [axis.get_ylabel() for axis in figure.axes] == ["u [N m]", "theta [rad]"]


def report_in_words(report: Any) -> None:
    """Hold a report in a notebook to its verdict, effect with value and unit, errors before and after, pictures."""
    page = report._repr_html_()
    assert repr(report).startswith("<Report effects_found: pendulum lacks quadratic drag")
    found = report.data["effects"][0]["parameters"]["c"]
    rms = [report.data["errors"][key]["simulation_error"]["validation"]["theta"]["rms"] for key in ("before", "after")]
    for words in ("effects found: pendulum lacks", "quadratic drag at theta</td><td>c", f"{found['value']:.3g}",
                  found["unit"], "<th>before</th><th>after</th><th>unit</th>", "<th>warnings</th>",
                  *(f"{value:.3g}" for value in rms)):  # fmt: skip
        assert words in page, words
    assert page.count('src="data:image/svg+xml;base64,') == 2
    assert len(page) < 400_000


def test_the_notebook_runs_and_shows_its_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = json.loads((DOCS / "first-steps.ipynb").read_text(encoding="utf-8"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(DOCS))
    from run_notebook import run  # type: ignore[import-not-found]

    done = run(json.loads((DOCS / "first-steps.ipynb").read_text(encoding="utf-8")))
    assert done["names"]["report"].verdict == "effects_found"
    for cell, before in zip(done["book"]["cells"], stored["cells"], strict=True):
        if cell["cell_type"] != "code":
            continue
        kinds = [[(o["output_type"], sorted(o.get("data", ()))) for o in one["outputs"]] for one in (cell, before)]
        assert kinds[0] == kinds[1], "run docs/run_notebook.py"
    pages = [
        o["data"]["text/html"][0]
        for cell in stored["cells"]
        for o in cell.get("outputs", ())
        if "text/html" in o.get("data", {})
    ]
    assert sum("data:image/svg+xml;base64," in page for page in pages) >= 3  # fit, figure, report
    assert max(map(len, pages)) < 400_000
    report_in_words(done["names"]["report"])
    assert not any("<script" in page or "http-equiv" in page or "<iframe" in page for page in pages)


def test_what_others_named_is_escaped_in_a_report() -> None:
    from harness.diagnosis.report.notebook import notebook

    entry = {"value": 1.0, "low": 0.9, "high": 1.1, "state": "determined", "unit": "N<m", "meaning": "a & b"}
    data = {
        "verdict": "effects_found", "summary": "<b>arm</b> & more", "warnings": ["<img src=x onerror=alert(1)>"] * 9,
        "effects": [{"name": "drag", "at": "q<1>&", "parameters": {"c": entry}, "summary": ""}],
        "joints": [{"joint": "j<&1", "before": {"validation": 2.0}, "after": {"validation": None}, "unit": "N m"}],
    }  # fmt: skip
    page = notebook(data, {"residual": "<svg viewBox='0 0 1 1'></svg>", "overlay": ""}, "a/<b>.html")
    for words in (
        "&lt;b&gt;arm&lt;/b&gt; &amp; more",
        "drag at q&lt;1&gt;&amp;",
        "N&lt;m",
        "a &amp; b",
        "j&lt;&amp;1",
        "&lt;img src=x",
        "3 more",
        "a/&lt;b&gt;.html",
        "0.90 … 1.10",
    ):
        assert words in page, words
    assert "<b>arm" not in page
    assert page.count("<img ") == 1


def test_figures_and_fits_show_themselves() -> None:
    record = harness.simulate("pendulum-ode", scenario="multisine", scenario_options={"duration": 4.0, "noise": 1e-3})
    assert "data:image/svg+xml;base64," in record.plot()._repr_html_()
    fitted = harness.identify(record.measured(), model="pendulum", identifier="lumped-momentum")
    page = fitted._repr_html_()
    assert "data:image/svg+xml;base64," in page
    assert "<td>J</td>" in page
    assert [line.get_label() for line in fitted.plot().axes[-1].lines] == ["measured", "free run"]
