"""Start values, start, stop and step of an FMU do what they say, and its draws hang on the file alone."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from harness import api
from harness.command import main
from plants.mockups import mockup


def test_start_values_reach_a_bare_fmu_and_go_before_what_a_scenario_draws() -> None:
    path = str(mockup("pendulum"))
    bare = api.simulate(path, options={"start": {"theta": 0.3}}, stop=0.1, step=0.05)
    assert bare.y[0, 0] == pytest.approx(0.3)
    for start in (0.3, -0.2):
        chosen = {"start": {"theta": start}, "sample_time": 0.05}
        record = api.simulate(path, scenario="free-swing", options=chosen, scenario_options={"duration": 0.2})
        assert record.y[0, 0] == pytest.approx(start)


def test_the_time_column_is_the_fmus(tmp_path: Path) -> None:
    path = str(mockup("mass_spring"))
    notes: list[str] = []
    record = api.simulate(path, start=0.5, stop=1.0, step=0.25, note=notes.append)
    assert record.t.tolist() == [0.5, 0.75, 1.0]
    assert not any("multiple" in text for text in notes)
    record = api.simulate(path, stop=1.0, step=0.3, note=notes.append)
    assert record.t[-1] == pytest.approx(0.9)
    assert any("t = 0.9 s" in text and "no multiple of the step 0.3 s" in text for text in notes)


def test_options_may_say_what_the_flags_say() -> None:
    path = str(mockup("mass_spring"))
    record = api.simulate(path, stop=2.0, options={"sample_time": 0.25, "start_time": 1.0})
    assert record.t.tolist() == [1.0, 1.25, 1.5, 1.75, 2.0]


def test_the_draws_do_not_hang_on_how_the_path_is_spelt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.fmu").write_bytes(mockup("pendulum").read_bytes())
    (tmp_path / "named.fmu").write_bytes(mockup("pendulum").read_bytes())
    options = {"options": {"sample_time": 0.05, "isolated": False}, "scenario_options": {"duration": 0.5, "noise": 0.1}}
    spelt = ["x.fmu", f".{os.sep}x.fmu", str(tmp_path / "x.fmu"), "named.fmu"]
    records = [api.simulate(path, scenario="prbs", **options) for path in spelt]
    for other in records[1:]:
        assert np.array_equal(records[0].u, other.u)
        assert np.array_equal(records[0].y, other.y)


def test_a_recorded_input_drives_an_fmu_for_as_long_as_it_lasts(tmp_path: Path) -> None:
    source, out = tmp_path / "u.csv", tmp_path / "y.csv"
    source.write_text("time [ms],u [N m]\n0,0\n500,0.4\n1500,0.4\n")
    options = ["-O", "sample_time=0.05", "-S", f"file={source}", "-o", str(out)]
    with pytest.raises(SystemExit) as ended:
        main(["simulate", str(mockup("pendulum")), "--scenario", "replay", *options])
    assert ended.value.code == 0
    rows = np.loadtxt(out, delimiter=",", skiprows=1)
    assert rows[-1, 0] == pytest.approx(1.5)
    assert np.array_equal(rows[:, 1], np.where(rows[:, 0] < 0.5 - 1e-9, 0.0, 0.4))
    assert not rows[:11, 2].any()
    assert rows[11:, 2].all()
