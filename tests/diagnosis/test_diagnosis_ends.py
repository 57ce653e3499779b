"""Where a fit ends: on a corner of the likelihood, below what it contains, and what it would take finer steps for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.diagnosis.forms.likelihood_form import LikelihoodForm
from harness.diagnosis.kinds import EquationsKind
from harness.diagnosis.search.fit import Fit
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.physics.compiled.kalman_pass import Filtered, Pass
from harness.physics.fitting.fisher_scoring import FisherScoring, Quadratic
from harness.physics.fitting.likelihood import Likelihood
from harness.physics.fitting.maximum import NoiseModel
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Run, Trajectory

DT, N = 0.02, 600
J, B, MGL = 0.1, 0.05, 1.0


def swing(seed: int, *, line: float = 0.0) -> Trajectory:
    """Return a pendulum under a torque, and one of 15 rad/s and slower ones that nobody records, by Heun's method."""
    rng = np.random.default_rng(seed)
    t, fine = np.arange(N) * DT, 10
    u = 0.5 * sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.3, 0.7, 1.1))
    h = DT / fine

    def rates(x: FloatArray, torque: float, at: float) -> FloatArray:
        slow = sum(0.25 * np.sin(omega * at) for omega in (1.5, 4.1, 6.7))
        force = torque + line * (np.sin(15.0 * at + 1.0) + slow) - B * x[1] - MGL * np.sin(x[0])
        return np.array([x[1], force / J])

    x, angles = np.array([0.2, 0.0]), []
    for k in range(N):
        angles.append(x[0])
        for part in range(fine):
            at = k * DT + part * h
            first = rates(x, u[k], at)
            x = x + 0.5 * h * (first + rates(x + h * first, u[k], at + h))
    y = np.array(angles)[:, None] + 1e-3 * rng.standard_normal((N, 1))
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad", period=2 * np.pi),), DT)
    return Trajectory(t, u[:, None], y, spec)


def form_of(*records: Trajectory) -> LikelihoodForm:
    """Return the form of a pendulum for an estimation and a validation record."""
    runs = (Run(record, use) for record, use in zip(records, ("estimation", "validation"), strict=True))
    form = EquationsKind().form(load_model("pendulum"), Dataset("swings", tuple(runs)))
    assert isinstance(form, LikelihoodForm)
    return form


def nominal_of(form: LikelihoodForm) -> Fit:
    """Return the nominal fit."""
    nominal = form.fit((), form.first_starts(), None)
    assert nominal is not None
    return nominal


class Cornered(Likelihood):
    """A likelihood with a corner along its first entry, smooth along the second: |z0 - corner| and a parabola."""

    def __init__(self, corner: float, top: float) -> None:
        self.corner, self.top = corner, top
        self.noise_model = NoiseModel(np.ones(1), np.ones(1))
        self.filter: Any = SimpleNamespace(ny=0)

    def layout(self) -> tuple[list[str], FloatArray, FloatArray, FloatArray]:
        return ["limit", "b"], np.zeros(2, dtype=bool), np.full(2, -10.0), np.full(2, 10.0)

    def _value(self, z: FloatArray) -> tuple[float, list[Filtered]]:
        return 5.0 * abs(z[0] - self.corner) + 0.5 * (z[1] - self.top) ** 2, []

    def ended(self, z: FloatArray) -> tuple[bool, float | None]:
        """Return whether a place is a maximum, and the value of a likelier one beside it."""
        slope = np.array([5.0 if z[0] >= self.corner else -5.0, z[1] - self.top])
        search = FisherScoring(self, self.place(z), np.arange(2), damping=1.0, exact=False, near=True)
        live = np.ones(2, dtype=bool)
        told, better = search._at_corner(Quadratic(np.zeros((2, 0)), slope, np.diag([4.0, 1.0]), live))
        return told, None if better is None else better.value - search.at.value


@settings(max_examples=50, deadline=None)
@given(corner=st.floats(-3.0, 3.0), top=st.floats(-3.0, 3.0))
def test_a_corner_is_a_maximum_where_the_rest_promises_nothing(corner: float, top: float) -> None:
    """A reading changes sides there: its gradient promises three in log-likelihood, and no step keeps it."""
    assert Cornered(corner, top).ended(np.array([corner, top])) == (True, None)


@settings(max_examples=50, deadline=None)
@given(corner=st.floats(-3.0, 3.0), beside=st.sampled_from([-0.7, -0.05, 0.05, 0.7]))
def test_beside_a_corner_a_step_along_its_own_parameter_is_taken(corner: float, beside: float) -> None:
    told, gain = Cornered(corner, 0.0).ended(np.array([corner + beside, 0.0]))
    assert not told
    assert gain is not None
    assert gain < -0.02


def test_a_corner_is_no_maximum_while_something_smooth_still_promises() -> None:
    told, gain = Cornered(0.0, 3.0).ended(np.zeros(2))
    assert not told
    assert gain is not None, "the smooth parameter has a step of its own"


def test_a_fit_that_ends_below_what_it_contains_is_left() -> None:
    """A pendulum that swings to both sides has not lost the sign: no steps bring such a sensor near the records."""
    form = form_of(swing(0), swing(1))
    nominal = nominal_of(form)
    fit = form.fit([Placed(builtin()["sensor_rectification"], "theta")], [nominal.values], nominal)
    assert fit is not None
    assert fit.beyond
    assert not fit.converged


@pytest.mark.parametrize("finer_is", ["as good", "worse"])
def test_what_coarse_steps_seem_to_gain_is_not_followed_with_finer_ones(
    finer_is: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A law that is faster than the steps: where finer ones leave nothing of it, its fit ends there and says so."""
    form = form_of(swing(0), swing(1))
    nominal = nominal_of(form)
    law = Placed(builtin()["quadratic_drag"], "theta")
    begun = form.begin([law], [nominal.values], nominal)
    assert begun is not None
    coarse = begun.detail.passes.substeps
    tried: list[int] = []

    def substeps(system: object, values: Mapping[str, float]) -> int:
        return 4 * coarse

    def passes(system: object, steps: int) -> Pass:
        tried.append(steps)
        lost = form.composed([law, Placed(builtin()["sensor_rectification"], "theta")])
        return original(lost if finer_is == "worse" and steps > coarse else system, steps)  # type: ignore[arg-type]

    original = form.passes
    monkeypatch.setattr(form, "substeps", substeps)
    monkeypatch.setattr(form, "passes", passes)
    fit = form.finish(begun, nominal)
    assert fit is not None
    assert tried[0] == 4 * coarse
    assert fit.detail.passes.substeps == (4 * coarse if finer_is == "as good" else coarse)
    assert fit.beyond is (finer_is == "worse")


@pytest.mark.parametrize("white", [False, True])
def test_a_line_is_seen_though_the_latent_force_is_white(white: bool) -> None:
    """Where the white part took the line up, the part that remembers shows nothing of it."""
    form = form_of(swing(0, line=0.05), swing(1, line=0.05))
    nominal = nominal_of(form)
    if white:
        one = np.ones(1)
        points = {
            use: replace(point, noise=replace(point.noise, s=1e-6 * one, tau=4.0 * one, w=0.1 * one))
            for use, point in nominal.detail.points.items()
        }
        nominal = replace(nominal, detail=replace(nominal.detail, points=points, paths={}, smooth={}))
    law = Placed(builtin()["periodic_disturbance"], "theta")
    lines = [column.given["omega"] for column in form.columns(nominal, [law])]
    assert min(abs(omega - 15.0) for omega in lines) < np.pi / (N * DT)
    assert len(lines) == len(set(lines))
