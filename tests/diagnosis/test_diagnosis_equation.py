"""The equation of motion along a measured motion: what it leaves, decimated or over test functions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.diagnosis.records.motion import SmoothedMotion
from harness.diagnosis.runs.equation import decimated, equations_of, expressible, weak_rows
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.signals import FloatArray

DT = 0.01


def swing(n: int = 2000, factor: int = 1, counts: FloatArray | None = None) -> SmoothedMotion:
    """Return a pendulum's motion under the torque that its equation asks for: J = 0.1, b = 0.05, mgl = 1."""
    t = np.arange(n) * DT
    q, v, a = 0.5 * np.sin(2 * t), np.cos(2 * t), -2.0 * np.sin(2 * t)
    u = 0.1 * a + 0.05 * v + np.sin(q)
    columns = [one[:, None] for one in (q, v, a, u)]
    return SmoothedMotion(t, *columns, slice(0, n), factor, DT, counts)


def test_on_exact_motion_the_equation_leaves_what_parameters_are_off_by() -> None:
    system, along = load_model("pendulum"), swing()
    equations = equations_of(system)
    true, other = (
        system.vector(dict(zip(("J", "b", "mgl"), p, strict=True))) for p in ((0.1, 0.05, 1), (0.12, 0.02, 1.1))
    )
    assert np.abs(equations.residual(along, true)).max() < 1e-9
    more = 0.02 * along.a - 0.03 * along.v + 0.1 * np.sin(along.q)
    assert equations.residual(along, other) == pytest.approx(more)
    assert equations.force_of(along, true) == pytest.approx(along.u)
    slower = replace(along, factor=8)
    assert equations.residual(slower, other) == pytest.approx(decimated(more, slower), abs=1e-9)
    parts = {"J": along.a, "mgl": np.sin(along.q)}
    r, j = equations.weak_residual(slower, other, [system.parameter_names.index(name) for name in parts])
    assert r == pytest.approx(weak_rows(more, slower), abs=1e-3)  # sums for integrals
    for k, part in enumerate(parts.values()):
        assert j[:, :, k] == pytest.approx(weak_rows(part, slower), abs=5e-3)


@pytest.mark.parametrize(("n", "factor", "width"), [(2000, 1, 8), (2000, 4, 20), (60, 4, 15)])
def test_means_over_test_functions_keep_a_constant_and_give_the_slope_of_a_line(
    n: int, factor: int, width: int
) -> None:
    along = swing(n, factor)
    rows = np.column_stack([np.full(n, 3.0), along.t])
    means = weak_rows(rows, along)
    centres = (np.arange(0, n - width + 1, width // 2) + 0.5 * (width - 1)) * DT
    assert means[:, 0] == pytest.approx(3.0)
    assert means[:, 1] == pytest.approx(centres)
    slopes = weak_rows(rows, along, derivative=True)
    assert slopes == pytest.approx(np.tile([0.0, 1.0], (len(centres), 1)), abs=0.06)  # sums for integrals


@pytest.mark.parametrize(("n", "cut"), [(4000, 10), (804, 10), (800, 2)])
def test_decimated_rows_are_where_they_were_but_for_ends_and_what_does_not_count(n: int, cut: int) -> None:
    along = swing(n, 4)
    slow, fast = np.sin(along.t), np.cos(0.28 * np.pi / DT * along.t)
    found = decimated(np.column_stack([slow, fast, slow, fast]), along)
    kept = slow[::4][cut:-cut]
    assert found[:, 0] == pytest.approx(kept, abs=0.012)  # the ripple of the filter, twice
    assert np.abs(found[20:-20, 1]).max() < 0.02, "what the decimated rate cannot hold is gone"
    counts = np.column_stack([np.zeros(n), np.ones(n)])
    some = decimated(np.column_stack([slow, fast, slow, fast]), swing(n, 4, counts))
    assert some[:, :2].tolist() == np.zeros((len(kept), 2)).tolist()
    assert some[:, 2] == pytest.approx(kept, abs=0.012)  # the ripple of the filter, twice
    whole = decimated(slow[:, None], swing(n))
    assert whole[:, 0].tolist() == slow.tolist()


def test_a_law_with_a_memory_or_on_samples_or_of_the_sensor_has_no_equation_form() -> None:
    laws = {"coulomb_friction": "theta", "force_bias": "u", "dead_zone": "u", "gravity_tilt": "base"}
    others = {"input_gain": "u", "actuator_lag": "u", "input_delay": "u", "sensor_gain": "theta", "hysteresis": "theta"}
    found = [name for name, at in (laws | others).items() if expressible(Placed(builtin()[name], at))]
    assert found == [*laws]
