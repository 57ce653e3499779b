"""Trends and bands declared in a data set: a linear relation survives them, a nonlinear model is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from harness import api
from harness.data import load_dataset
from harness.errors import InputError

DT = 0.01
TOML = """
name = "conditioned"
{top}
[signals.u]
role = "input"
unit = "V"
[signals.y]
role = "output"
unit = "V"
[[runs]]
file = "run.csv"
{rest}
"""


def written(folder: Path, top: str = "", rest: str = "", disturbed: bool = True) -> Path:
    """Return a data set of y[k+1] = 0.9 y[k] + 0.1 u[k], under a drift and a hum of the sensor."""
    rng = np.random.default_rng(0)
    t = DT * np.arange(4000)
    u = rng.normal(size=t.size) + 3.0
    y = lfilter([0.0, 0.1], [1.0, -0.9], u)
    if disturbed:
        y = y + 5.0 + 0.4 * t
    rows = [
        "time [s],u [V],y [V]",
        *(f"{a!r},{b!r},{c!r}" for a, b, c in zip(t.tolist(), u.tolist(), y.tolist(), strict=True)),
    ]
    (folder / "run.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "dataset.toml").write_text(TOML.format(top=top, rest=rest), encoding="utf-8")
    return folder / "dataset.toml"


def fitted(path: Path) -> np.ndarray:
    """Return the coefficients of y[k] and u[k] by least squares."""
    (run,) = load_dataset(path).dataset.estimation
    y, u = run.y[:, 0], run.u[:, 0]
    return np.linalg.lstsq(np.column_stack([y[:-1], u[:-1]]), y[1:], rcond=None)[0]


def test_without_its_trend_a_drifting_record_shows_the_law(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    assert abs(fitted(written(tmp_path / "a"))[1] - 0.1) > 0.02
    assert fitted(written(tmp_path / "b", 'detrend = "linear"')) == pytest.approx([0.9, 0.1], abs=2e-3)


@pytest.mark.parametrize("band", ["high = 20.0", "low = 0.5", "low = 0.5\nhigh = 20.0", "high = 20.0\norder = 2"])
def test_a_filter_on_both_sides_leaves_a_linear_law_as_it_is(band: str, tmp_path: Path) -> None:
    path = written(tmp_path, rest=f"[filter]\n{band}\n", disturbed=False)
    (run,) = load_dataset(path).dataset.estimation
    y, u = run.y[1500:, 0], run.u[1500:, 0]
    left = y[1:] - 0.9 * y[:-1] - 0.1 * u[:-1]
    assert np.abs(left).max() < 2e-3 * np.abs(y).max()
    spectrum = np.abs(np.fft.rfft(run.u[:, 0])) ** 2
    frequencies = np.fft.rfftfreq(len(run), DT)
    if "high" in band:
        assert spectrum[frequencies > 40.0].sum() < 0.05 * spectrum[(frequencies > 1.0) & (frequencies < 20.0)].sum()
    if "low" in band:
        assert abs(run.u[:, 0].mean()) < 0.1


def test_it_is_said_and_a_nonlinear_model_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, 'detrend = "constant"')
    assert any("without their constant trend" in text for text in load_dataset(path).dataset.warnings)
    text = path.read_text().replace('role = "input"\nunit = "V"', 'role = "input"\nunit = "N m"')
    path.write_text(
        text.replace(
            '[signals.y]\nrole = "output"\nunit = "V"', '[signals.theta]\nrole = "output"\nunit = "rad"\ncolumn = "y"'
        )
    )
    with pytest.raises(InputError, match=r"detrend: .*linear, or none.*pendulum"):
        load_dataset(path, model="pendulum")


@pytest.mark.parametrize(
    ("rest", "words"),
    [
        ("[filter]\n", "low, high or both"),
        ("[filter]\nlow = 60.0\n", "below half the sampling frequency"),
        ("[filter]\nlow = 20.0\nhigh = 2.0\n", "low below high"),
        ("[filter]\nhigh = 5.0\norder = 40\n", "1 to 12"),
        ("[filter]\nhigh = -5.0\n", "filter.high"),
        ("[filter]\nhgh = 5.0\n", "did you mean high"),
        ("[resample]\nintersample = 'zoh'\n", "remedy: write intersample above the first table"),
        ("[resample]\nhigh = 5.0\n", r"remedy: write it under \[filter\]"),
        ("[resample]\nfast = 5.0\n", "remedy: remove it"),
    ],
)
def test_bands_that_cannot_be_meant_are_refused(rest: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        load_dataset(written(tmp_path, rest=rest))


def test_the_command_takes_it(tmp_path: Path) -> None:
    found = api.identify(written(tmp_path, 'detrend = "linear"'), identifier="arx", options={"order": 1})
    assert found.simulation_error["estimation"][0].nrmse[0] < 0.1
