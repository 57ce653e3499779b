"""Two loggers of one run: their files side by side, the offset of their clocks declared, or estimated and shown."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from harness.data import load_dataset
from harness.data.conditioning.offset import offset_between
from harness.errors import InputError
from harness.signals import FloatArray

OFFSET = 7.3146
DESCRIPTION = """name = "rig"
[signals.u]
role = "input"
column = "torque [N m]"
[signals.theta]
role = "output"
column = "angle [deg]"
[resample]
sample_time = 0.01
[[runs]]
file = "drive.csv"
[[runs.beside]]
file = "camera.csv"
"""


def torque(t: FloatArray) -> FloatArray:
    """A motion that does not repeat itself."""
    return np.sin(1.3 * t) + 0.6 * np.sin(0.31 * t**1.5)


def angle(t: FloatArray) -> FloatArray:
    return 20.0 * np.sin(0.9 * t + 0.2 * np.sin(0.4 * t))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A drive at 100 Hz, and a camera at 60 Hz whose clock began later, which sees a noisy copy of the torque."""
    rng = np.random.default_rng(3)
    t = 0.01 * np.arange(3000)
    np.savetxt(tmp_path / "drive.csv", np.c_[t, torque(t)], delimiter=",", header="time [s],torque [N m]", comments="")
    own = np.arange(1200) / 60.0
    at = own + OFFSET
    seen = 3.0 * torque(at) + 1.0 + 0.05 * rng.standard_normal(len(at))
    np.savetxt(
        tmp_path / "camera.csv", np.c_[1e3 * own, seen, angle(at)], delimiter=",",
        header="time [ms],copy [V],angle [deg]", comments="",
    )  # fmt: skip
    return tmp_path


def load(folder: Path, declared: str) -> tuple[FloatArray, FloatArray, FloatArray, str]:
    (folder / "dataset.toml").write_text(DESCRIPTION + declared)
    found = load_dataset(folder / "dataset.toml").dataset
    record = found.estimation[0]
    return record.t + OFFSET - record.t[0], record.u[:, 0], record.y[:, 0], " ".join(found.warnings)


@pytest.mark.parametrize(
    ("declared", "said"),
    [
        (f"offset = {OFFSET}", "as declared"),
        ('same = ["torque [N m]", "copy [V]"]', r"estimated from 'torque \[N m\]' and 'copy \[V\]'"),
    ],
)
def test_signals_of_two_loggers_come_together(folder: Path, declared: str, said: str) -> None:
    t, u, y, notes = load(folder, declared)
    assert len(t) == pytest.approx(20.0 / 0.01, abs=3)
    inner = slice(5, -5)
    assert u[inner] == pytest.approx(torque(t)[inner], abs=0.04)  # held for a sample
    assert y[inner] == pytest.approx(np.radians(angle(t))[inner], abs=0.01)
    assert re.search(said, notes)
    assert "its clock is" in notes


def test_the_offset_is_found_between_the_rows_with_its_error() -> None:
    """Deviations are those of the errors: within three of them nearly always, and not far too large."""
    errors = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        t = 0.01 * np.arange(2000)
        own = np.arange(700) / 60.0
        true = float(rng.uniform(2.0, 6.0))
        y = torque(t)
        found = offset_between(t, y, own, -2.0 * -torque(own + true) + 0.1 * rng.standard_normal(len(own)))
        errors.append((found.seconds - true) / found.deviation)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.35)


def test_a_motion_that_repeats_itself_or_another_quantity_is_refused(folder: Path) -> None:
    t = 0.01 * np.arange(3000)
    with pytest.raises(InputError, match=r"repeats itself"):
        offset_between(t, np.sin(3.0 * t), t[:2000], np.sin(3.0 * (t[:2000] + 4.0)))
    with pytest.raises(InputError, match=r"correlation of at most"):
        load(folder, 'same = ["torque [N m]", "angle [deg]"]')
    with pytest.raises(InputError, match=r"offset = .*or same"):
        load(folder, "")
