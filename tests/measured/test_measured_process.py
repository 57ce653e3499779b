"""The loop on recordings with many minima: tanks that overflow, a drive whose sensor hides the sign, a dryer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.diagnosis import Diagnosis, diagnose
from harness.effects import builtin
from scenarios.recordings import load_recording

pytestmark = pytest.mark.slow


def diagnosed(name: str, *effects: str) -> Diagnosis:
    """Diagnose a recording with these effects as the dictionary."""
    loaded = load_recording(name)
    system = loaded.system()
    known = builtin()
    return diagnose(loaded.for_system(system), system, dictionary=[known[one] for one in effects] or None)


def errors_of(found: Diagnosis) -> tuple[list[float], list[float]]:
    """Return the errors (rms) of the test runs before and after."""
    before, after = (found.runs.output.simulated(one, "test", None)[0] for one in (found.runs.before, found.runs.after))
    return [float(np.sqrt(np.mean(one**2))) for one in before], [float(np.sqrt(np.mean(one**2))) for one in after]


@pytest.mark.slow
@pytest.mark.parametrize(
    "effects",
    [("overflow", "level_saturation", "sensor_offset", "sensor_saturation"), ()],
    ids=["four laws", "the whole dictionary"],  # a slow disturbance of the pump once took the place of the limit
)
def test_the_tanks_overflow_and_the_lower_level_has_a_limit(recordings_folder: Path, effects: tuple[str, ...]) -> None:
    found = diagnosed("cascaded-tanks", *effects)
    assert found.verdict == "effects_found"
    assert sorted(map(str, found.final.effects)) == ["level_saturation@lower", "overflow@upper"]
    before, after = errors_of(found)
    assert before[0] == pytest.approx(0.72, abs=0.02)  # V
    assert after[0] <= 0.27


@pytest.mark.slow
@pytest.mark.parametrize(("recording", "limit"), [(1, 0.2), (2, 0.4), (3, 0.12)])
def test_each_drive_reads_speed_without_its_sign(recordings_folder: Path, recording: int, limit: float) -> None:
    found = diagnosed(f"coupled-drives-{recording}", "sensor_rectification", "dead_zone", "sensor_offset")
    assert [str(one) for one in found.final.effects] == ["sensor_rectification@y"]
    before, after = errors_of(found)
    assert after[0] <= limit < 0.6 * before[0]  # ticks/s


@pytest.mark.slow
def test_one_model_of_three_drives_of_unlike_gain_names_the_lost_sign_first(recordings_folder: Path) -> None:
    found = diagnosed("coupled-drives", "sensor_rectification", "dead_zone", "sensor_offset")
    assert str(found.final.effects[0]) == "sensor_rectification@y"
    before, after = errors_of(found)
    assert sum(after) < sum(before)  # ticks/s
    # by itself each recording comes down to 0.2, 0.3 and 0.1: one gain for the three does not fit
    assert sum(after) > 0.7


def test_nothing_is_missing_in_the_dryer(recordings_folder: Path) -> None:
    found = diagnosed("hair-dryer", "dead_zone", "saturation", "input_delay", "actuator_lag", "sensor_saturation")
    assert found.verdict == "nothing_missing"
    error = float(np.sqrt(np.mean(found.runs.before.validation[0] ** 2)) * found.runs.output.weights[0])
    assert error < 0.085
