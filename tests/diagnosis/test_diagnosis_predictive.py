"""The density of the validation records given the estimation records: parameters are uncertain, motions amplify."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import api
from harness.diagnosis.forms.halves import judged_by_halves, told_by_halves
from harness.diagnosis.forms.predictive import _outside_starts, predictive, spread_of
from harness.physics import load_model
from harness.physics.compiled.kalman_pass import KalmanPass, PassNoise
from harness.physics.compiled.latent import without_latent_forces
from harness.physics.fitting.likelihood import Likelihood
from harness.physics.fitting.maximum import NoiseModel, Point
from harness.signals import Channel, PlantSpec, Trajectory

R = 1e-3


def swing(seed: int, n: int = 60, dt: float = 0.05, x0: tuple[float, float] = (0.4, 0.0)) -> tuple[Likelihood, Point]:
    """Return the likelihood of a free run of the pendulum from a known law, and its true point."""
    rng = np.random.default_rng(seed)
    system = load_model("pendulum")
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), dt)
    t = np.arange(n) * dt
    blank = Trajectory(t, 0.3 * rng.normal(size=(n, 1)), np.zeros((n, 1)), spec)
    nothing = NoiseModel(np.zeros(0), np.ones(1), latent=False)
    passes = KalmanPass(without_latent_forces(system), dt)
    p = system.vector({"J": 0.25, "b": 0.05, "mgl": 4.9})
    zero = np.zeros(0)
    point = Point(p, [np.array(x0)], PassNoise(np.array([R]), zero, zero, zero))
    run = Likelihood(system, [blank], nothing, passes=passes).filtered(point)
    assert run is not None
    record = Trajectory(t, blank.u, -run[0].e + R * rng.normal(size=(n, 1)), spec)
    return Likelihood(system, [record], nothing, passes=passes), point


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000), wide=st.floats(1e-4, 3e-3))
def test_the_density_is_that_of_the_integral_over_an_uncertain_parameter(seed: int, wide: float) -> None:
    likelihood, truth = swing(seed)
    estimate = truth.p.copy()
    estimate[likelihood.system.parameter_names.index("mgl")] += wide * np.random.default_rng(seed).normal()
    start = Point(estimate, truth.x0, truth.noise)
    found = predictive(likelihood, start, ["mgl"], np.array([[wide]]))
    # by Gauss-Hermite quadrature over mgl, the initial state at its maximum for each value
    nodes, weights = np.polynomial.hermite_e.hermegauss(41)
    values = []
    for node in nodes:
        p = estimate.copy()
        p[likelihood.system.parameter_names.index("mgl")] += wide * node
        fit = likelihood.maximise(Point(p, truth.x0, truth.noise), free=["x0[0].theta", "x0[0].theta_rate"])
        values.append(-fit.nll)
    top = max(values)
    integral = top + np.log(np.sum(weights * np.exp(np.array(values) - top)) / np.sqrt(2 * np.pi))
    assert -likelihood.nll(found.point) - found.price == pytest.approx(integral, abs=0.05)


def test_certain_parameters_cost_nothing_and_stay() -> None:
    likelihood, truth = swing(1)
    found = predictive(likelihood, truth, ["mgl"], np.zeros((1, 0)))
    assert found.price == 0.0
    np.testing.assert_array_equal(found.point.p, truth.p)


def test_the_spread_is_a_root_of_the_covariance_without_what_belongs_to_a_record() -> None:
    likelihood, truth = swing(2)
    fit = likelihood.maximise(truth, free=["J", "b", "mgl", "x0[0].theta", "x0[0].theta_rate"])
    root = spread_of(fit, ["J", "b", "mgl"], ["b"])
    whole = root @ root.T
    assert np.sqrt(whole[0, 0]) == pytest.approx(
        fit.deviation("J") * (fit.parameters["J"] if fit.logarithmic[0] else 1)
    )
    assert whole[1, 1] == 0.0
    assert whole[0, 2] != 0.0


@pytest.mark.parametrize(("seed", "friction"), [(10_109, 0.0), (10_017, 0.1)])
@pytest.mark.slow
def test_a_swing_over_the_top_decides_nothing_by_its_chaos(tmp_path: Path, seed: int, friction: float) -> None:
    """Records of Bullet: judged at the estimates alone, the first was called unexplained and so was the second."""
    api.simulate(
        "arm-bullet",
        scenario="multisine",
        seed=seed,
        out=tmp_path / "record.csv",
        options={"joint_friction": friction, "sample_time": 0.02, "substeps": 160},
        scenario_options={"noise": 0.001},
    )
    report = api.close_loop(tmp_path / "record.csv", model="pendulum", out=tmp_path / "report")
    if friction:
        assert report.data["verdict"] == "effects_found"
        assert "coulomb_friction" in json.dumps(report.data["tie_sets"])
    else:
        assert report.data["verdict"] == "nothing_missing"


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_from_the_top_of_the_swing_the_truth_is_not_likelier_than_what_is_found(seed: int) -> None:
    likelihood, truth = swing(seed, 300, x0=(3.12, 0.0))
    rng = np.random.default_rng(seed)
    spread = np.diag([2e-3, 5e-3, 4e-2])
    estimate = truth.p + spread @ rng.normal(size=3)
    start = Point(estimate, [truth.x0[0] + 1e-3 * rng.normal(size=2)], truth.noise)
    found = predictive(likelihood, start, ["J", "b", "mgl"], spread)
    off = np.linalg.solve(spread, truth.p - estimate)
    best = likelihood.nll(found.point) + 0.5 * float(found.moved @ found.moved)
    assert best <= likelihood.nll(truth) + 0.5 * float(off @ off) + 1e-3


def test_a_step_along_the_spread_takes_the_initial_state_along() -> None:
    """Of what is left, and of the step, no more is seen than the initial state cannot do; an idle one stays."""
    rng = np.random.default_rng(0)
    e, s, j = rng.standard_normal((30, 2)), rng.uniform(0.5, 2.0, (30, 2)), rng.standard_normal((30, 2, 5))
    e[7, 1], j[:, :, 4] = np.nan, 0.0
    j[7, 1] = np.nan  # two parameters, two states that move something, and one that moves nothing
    spread, step = np.array([[0.5, 0.1], [0.0, 2.0]]), np.array([0.3, -0.7])
    passed: Any = SimpleNamespace(e=e, s=s, j=j)
    part = _outside_starts(passed, 2, spread)
    read = np.isfinite(e)
    residual, rows = e[read] / np.sqrt(s[read]), j[read] / np.sqrt(s[read])[:, None]
    moved, starts = residual + rows[:, :2] @ spread @ step, rows[:, 2:4]
    move = -np.linalg.lstsq(starts, moved, rcond=None)[0]
    assert part.start(step) == pytest.approx(np.append(move, 0.0))
    left = moved + starts @ move
    assert np.sum((part.left + part.along @ step) ** 2) == pytest.approx(left @ left)
    assert part.taken == pytest.approx(residual @ residual - part.left @ part.left)


def test_each_half_of_a_record_is_judged_by_the_phases_that_the_other_half_tells() -> None:
    """Fitted where it is judged, a phase would let any line of a spectrum pass for something periodic."""
    records: Any = [np.arange(7.0), np.arange(4.0)]
    noise: Any = None
    point = Point(np.array([0.0]), [np.array([1.0]), np.array([2.0])], noise)
    asked: list[tuple[float, ...]] = []

    class Half:
        start_names = ("x0[q]",)

        def __init__(self, part: np.ndarray) -> None:
            self.part = part

        def maximise(self, start: Point, *, free: list[str], **_: Any) -> Any:
            assert free == ["phi", "x0[q]"]
            asked.append((*self.part, float(start.x0[0][0])))
            return SimpleNamespace(point=SimpleNamespace(p=np.array([self.part[0]])))

    half: Any = Half
    told = told_by_halves(records, point, ["phi"], half, lambda part: np.array([-part[0]]))
    assert asked == [(0, 1, 2, 1), (3, 4, 5, 6, -3), (0, 1, 2), (2, 3, -2)], (
        "the record's own start, then what it reads"
    )

    def passes(record: np.ndarray, p: np.ndarray, x0: np.ndarray, noise: Any) -> Any:
        return SimpleNamespace(e=p[0] + 0.0 * record, s=10.0 * p[0] + 0.0 * record)

    paths: Any = [SimpleNamespace(e=np.full(len(one), np.nan), s=np.full(len(one), np.nan)) for one in records]
    run: Any = passes
    found = judged_by_halves(paths, run, records, point, told)
    assert found is not None
    assert [path.e.tolist() for path in found] == [[3, 3, 3, 0, 0, 0, 0], [2, 2, 0, 0]]
    assert [path.s.tolist() for path in found] == [[30, 30, 30, 0, 0, 0, 0], [20, 20, 0, 0]]
    run = Mock(return_value=None)
    assert judged_by_halves(paths, run, records, point, told) is None
