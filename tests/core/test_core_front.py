"""What a person finds behind ``import harness``."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

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


def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    book = json.loads((DOCS / "first-steps.ipynb").read_text(encoding="utf-8"))
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "__main__"}
    cells = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    assert len(cells) >= 5
    for cell in cells:
        assert cell["outputs"] == []
        exec(compile("".join(cell["source"]), "first-steps.ipynb", "exec"), names)
    assert names["report"].verdict == "effects_found"  # type: ignore[attr-defined]
