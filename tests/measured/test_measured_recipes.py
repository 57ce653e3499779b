"""The recipes of public recordings, on the recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness import registry
from harness.data import read_description
from harness.errors import InputError
from scenarios.recordings import RECORDINGS, load_recording

FACTS = {
    # name: (dt, lengths by run, a value of the first run (row, column of [u y]), what it must be)
    "emps": (1e-3, [24841, 24841], (0, 0), 2.53862809 * 35.15065188),
    "silverbox": (2**14 / 1e7, [52000, 12962, 21638, 40425, 31950], None, 0.0),
    "cascaded-tanks": (4.0, [768, 256, 1024], (1, 0), 3.2466),
    "coupled-drives": (0.02, [225, 225, 225, 75, 75, 75, 200, 200, 200], (0, 1), 0.03174603),
    "coupled-drives-1": (0.02, [225, 75, 200], (0, 1), 0.03174603),
    "coupled-drives-2": (0.02, [225, 75, 200], (0, 0), 1.5),
    "coupled-drives-3": (0.02, [225, 75, 200], (0, 0), 0.5),
    "multi-arm-pendulum": (1e-3, [9167, 9167, 9167, 9167, 9167, 9166], (0, 0), 1.52316373 - np.pi),
    "hair-dryer": (0.08, [500, 500], (1, 1), 4.7636589),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FACTS)
def test_a_recording_is_read_as_its_data_sheet_says(recordings_folder: Path, name: str) -> None:
    dt, lengths, where, value = FACTS[name]
    loaded = load_recording(name)
    data = loaded.dataset
    assert data.spec.sample_time == pytest.approx(dt, rel=1e-12)
    assert [len(run.trajectory) for run in data.runs][: len(lengths)] == lengths
    if where is not None:
        first = data.runs[0].trajectory
        assert np.hstack([first.u, first.y])[where] == pytest.approx(value, rel=1e-7)
    assert not any("SHA-256" in note for note in data.warnings)
    assert data.estimation
    assert data.validation
    system = loaded.system()
    full = loaded.for_system(system)
    assert tuple(c.name for c in full.spec.inputs) == tuple(c.name for c in system.inputs)
    assert system.outputs == full.spec.outputs


@pytest.mark.slow
def test_the_multi_arm_pendulum_hangs_at_zero(recordings_folder: Path) -> None:
    data = load_recording("multi-arm-pendulum").dataset
    assert [c.name for c in data.spec.outputs] == ["theta", "theta_rate"]
    for trajectory in data.validation:
        assert abs(trajectory.y[:, 0].mean()) < 0.05


@pytest.mark.slow
def test_what_the_recordings_show_is_said(recordings_folder: Path) -> None:
    assert any("rests at its largest value 10 V" in n for n in load_recording("cascaded-tanks").dataset.warnings)
    assert any("input u is declared as undriven" in n for n in load_recording("multi-arm-pendulum").dataset.warnings)
    for clean in ("emps", "silverbox", "coupled-drives"):
        assert load_recording(clean).dataset.warnings == (), clean
    (untitled,) = load_recording("hair-dryer").dataset.warnings
    assert "the columns are called 0, 1" in untitled
    references = load_recording("emps").references
    assert references[0]["qg"].shape == (24841,)


def test_every_recipe_is_registered_and_tells_its_source() -> None:
    assert {entry.id for entry in registry.entries("recordings")} == set(RECORDINGS) == set(FACTS)
    for name in RECORDINGS:
        path = Path(registry.load("recordings", name))
        source = read_description(path).source
        assert source is not None
        assert source.download.startswith("https://")
        assert source.citation
        assert {one.file for one in source.files} == {run.file for run in read_description(path).runs}


@pytest.mark.parametrize("name", FACTS)
def test_a_missing_file_says_where_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv("SYSID_HARNESS_DATA", str(tmp_path))
    with pytest.raises(InputError, match=r"missing.*https://.*SYSID_HARNESS_DATA"):
        load_recording(name)
    monkeypatch.delenv("SYSID_HARNESS_DATA")
    with pytest.raises(InputError, match=r"not set.*https://"):
        load_recording(name)


def test_another_file_of_the_same_name_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hair_dryer").mkdir()
    rng = np.random.default_rng(0)
    np.savetxt(tmp_path / "hair_dryer" / "dryer.dat", rng.normal(size=(1000, 2)))
    monkeypatch.setenv("SYSID_HARNESS_DATA", str(tmp_path))
    assert any("SHA-256 differs" in note for note in load_recording("hair-dryer").dataset.warnings)


def test_an_unknown_recording_is_refused() -> None:
    with pytest.raises(InputError, match="unknown recording"):
        load_recording("emp")
