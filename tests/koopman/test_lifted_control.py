"""Controllers on lifted models: the plain ones where nothing is lifted, within bounds, honest where they lose."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import api
from harness.errors import InputError
from harness.models.lifted import LiftedController, deviations, eigenfunctions, lifted_lqr, lifted_mpc
from harness.models.lqr import lqr_gain
from harness.physics import Ode
from harness.scoring import linearise
from harness.scoring.regulation import StateFeedback, regulation_costs
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.koopman.koopman import Edmdc, KoopmanModel
from identifiers.sparse.stlsq import Stlsq
from plants.equations.linear import LinearPlant
from plants.equations.ode import pendulum_ode
from plants.equations.ode_plant import OdePlant

Q, R = np.diag([1.0, 0.1]), 0.1 * np.eye(1)


def duffing(limit: float = 2.0) -> OdePlant:
    """A mass between two wells; the top between them is unstable."""
    ode = Ode("duffing", x="x v", u="u")
    (x, v), (u,) = ode.x, ode.u
    ode.rhs = [v, x - x**3 - 0.5 * v + u]
    ode.outputs = {"x": x, "v": v}
    return OdePlant(model=ode, sample_time=0.05, u_limit=limit)


def records(plant: OdePlant | LinearPlant, most: float, count: int = 60, force: float = 2.0) -> list[Trajectory]:
    rng, found = np.random.default_rng(0), []
    names = [channel.name for channel in plant.spec.states]
    spec = PlantSpec(plant.spec.inputs, plant.spec.outputs, plant.spec.sample_time)
    for _ in range(count):
        first = plant.reset(rng=rng, x0={name: float(rng.uniform(-most, most)) for name in names})
        u = np.repeat(rng.uniform(-force, force, (8, 1)), 5, axis=0)
        y = np.asarray(np.vstack([first, plant.rollout(u[:-1])]), dtype=np.float64)
        found.append(Trajectory(spec.sample_time * np.arange(40, dtype=np.float64), u, y, spec))
    return found


def fitted(found: list[Trajectory], **options: object) -> KoopmanModel:
    return Edmdc(**options).fit(found, rng=np.random.default_rng(0))  # type: ignore[arg-type]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), scale=st.floats(1e-2, 1e2))
def test_with_nothing_lifted_it_is_the_lqr_of_the_plant(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(2, 2))
    a *= rng.uniform(0.5, 1.2) / np.abs(np.linalg.eigvals(a)).max()
    b = rng.normal(size=(2, 1))
    plant = LinearPlant(A=a, B=b, C=scale * np.eye(2), u_limit=1e6)
    model = fitted(records(plant, 1.0, count=5), degree=1)
    found = lifted_lqr(model, q=Q / scale**2, r=R)
    gain = lqr_gain(a, b, Q, R)
    assert (found is None) == (gain is None)
    if found is not None and gain is not None:
        y = rng.normal(size=2)
        found.reset(scale * y)
        assert found.act(scale * y) == pytest.approx(-gain @ y, rel=1e-5, abs=1e-8)
        plan = lifted_mpc(model, q=Q / scale**2, r=R, horizon=8)
        assert plan is not None
        plan.reset(scale * y)
        assert plan.act(scale * y) == pytest.approx(-gain @ y, rel=1e-4, abs=1e-6)


def test_mpc_keeps_its_bounds_and_is_no_dearer_than_a_clipped_lqr() -> None:
    a, b = np.array([[1.1, 0.3], [0.0, 0.9]]), np.array([[0.0], [1.0]])
    plant = LinearPlant(A=a, B=b, u_limit=0.3)
    model = fitted(records(plant, 1.0, force=0.3), degree=1)
    point = {"target": np.zeros(2), "hold": np.zeros(1)}
    starts = [{"x1": 0.5, "x2": 0.0}, {"x1": -0.4, "x2": 0.5}, {"x1": 0.0, "x2": 0.8}]
    lqr, mpc = lifted_lqr(model, q=Q, r=R), lifted_mpc(model, q=Q, r=R)
    assert lqr is not None
    assert mpc is not None
    costs = [regulation_costs(plant, one, starts, steps=80, q=Q, r=R, **point) for one in (lqr, mpc)]
    assert np.all(costs[1] <= costs[0] * (1 + 1e-6))
    mpc.reset(np.array([3.0, 3.0]))
    assert abs(mpc.act(np.array([3.0, 3.0]))[0]) == pytest.approx(0.3)


def test_a_lifted_lqr_beats_the_local_one_on_a_duffing_plant() -> None:
    plant = duffing()
    local, starts = _local(plant, {}), [{"x": x, "v": v} for x in (-2.0, -1.0, 1.0, 2.0) for v in (-1.0, 1.0)]
    model = fitted(records(plant, 2.0), degree=5)
    costs = [_costs(plant, one, starts, np.zeros(2)) for one in (local, lifted_lqr(model, q=Q, r=R))]
    assert 0.9 < costs[1].sum() / costs[0].sum() < 1.0


def test_where_monomials_meet_a_swing_up_the_lifted_one_loses() -> None:
    """The pendulum hanging down, held upright: monomials of the angle about 0 bend the design at pi."""
    limit, up = 2.0, np.array([np.pi, 0.0])
    plant = pendulum_ode(sample_time=0.05, u_limit=limit, outputs=[["theta", 0], ["theta", 1]])
    local = _local(plant, {"theta": np.pi}, up)
    starts = [{"theta": 0.0}, {"theta": 2.5}, {"theta": 4.0}]
    data = records(plant, 4.5, count=120)
    ratio = {}
    for name, options in {"sines": {"trigonometric": True, "degree": 1}, "cubes": {"degree": 3}}.items():
        found = lifted_lqr(fitted(data, **options), q=Q, r=R, target=up)
        ratio[name] = _costs(plant, found, starts, up).sum() / _costs(plant, local, starts, up).sum()
    assert ratio["sines"] < 1.1
    assert ratio["cubes"] > 10.0


@settings(max_examples=10, deadline=None)
@given(fast=st.floats(0.2, 0.7), slow=st.floats(0.75, 0.95))
def test_eigenfunctions_are_multiplied_by_their_eigenvalues(fast: float, slow: float) -> None:
    turn = np.array([[1.0, 0.4], [-0.3, 1.0]])
    a = turn @ np.diag([slow, fast]) @ np.linalg.inv(turn)
    plant = LinearPlant(A=a, B=np.ones((2, 1)))
    model = fitted(records(plant, 1.0, count=10), degree=2)
    found = eigenfunctions(model)
    # products of eigenfunctions are eigenfunctions (with inputs, degree 2 is not closed: the linear ones are)
    for value in (slow, fast):
        k = int(np.argmin(np.abs(found.values - value)))
        assert found.values[k] == pytest.approx(value, abs=0.05)
    exact = fitted([_undriven(plant, seed) for seed in range(10)], degree=2)
    found = eigenfunctions(exact)
    y = np.random.default_rng(1).normal(size=(7, 2))
    assert found.at(y @ a.T) == pytest.approx(found.at(y) * found.values, abs=1e-5)
    assert sorted(np.abs(found.values))[-1] == pytest.approx(slow, abs=1e-5)


def test_the_constant_is_no_eigenfunction_beside_a_mode_that_hardly_dies_away() -> None:
    """A fitted row of it errs by 6e-11, and beside a mode of 0.9999 passed for one of a time constant of years."""
    plant = LinearPlant(A=np.diag([0.9999, 0.5]), B=np.ones((2, 1)))
    found = eigenfunctions(fitted(records(plant, 1.0, count=10), degree=2))
    assert found.values[0] == pytest.approx(0.9999, abs=1e-6)
    late = fitted(records(duffing(), 2.0, count=20), degree=2, delays=3)  # badly conditioned
    assert len(deviations(late)[3]) == late.lifted - 1


def test_models_that_are_not_linear_in_lifted_coordinates_are_refused_by_type() -> None:
    data = records(duffing(), 2.0, count=10)
    sparse = Stlsq().fit(data, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="SparseModel: not for control"):
        lifted_lqr(sparse, q=Q, r=R)
    with pytest.raises(InputError, match="point to be held"):
        lifted_lqr(fitted(data), q=Q, r=R, target=np.zeros(3))
    with pytest.raises(InputError, match="horizon"):
        lifted_mpc(fitted(data), q=Q, r=R, horizon=0)
    with pytest.raises(InputError, match="plane"):
        eigenfunctions(fitted(data, delays=2)).plot(np.zeros(2), np.ones(2))
    assert len(deviations(fitted(data, degree=3))[3]) == 9
    assert len(eigenfunctions(fitted(data, degree=3)).plot(-np.ones(2), np.ones(2), points=11).axes) >= 4


def _undriven(plant: LinearPlant, seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    first = plant.reset(rng=rng, x0={"x1": rng.normal(), "x2": rng.normal()})
    y = np.asarray(np.vstack([first, plant.rollout(np.zeros((11, 1)))]), dtype=np.float64)
    return Trajectory(
        0.1 * np.arange(12, dtype=np.float64), np.zeros((12, 0)), y, PlantSpec((), plant.spec.outputs, 0.1)
    )


def _local(plant: OdePlant, point: dict[str, float], target: FloatArray | None = None) -> StateFeedback:
    around = linearise(plant, x0=point)
    gain = lqr_gain(around.a_matrix, around.b_matrix, Q, R)
    assert gain is not None
    return StateFeedback(plant.spec, gain, np.zeros(2) if target is None else target, np.zeros(1))


def _costs(
    plant: OdePlant,
    controller: StateFeedback | LiftedController | None,
    starts: list[dict[str, float]],
    goal: FloatArray,
) -> FloatArray:
    assert controller is not None
    return regulation_costs(plant, controller, starts, steps=200, q=Q, r=R, target=goal, hold=np.zeros(1))


def test_eigenfunctions_by_a_command(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    model = tmp_path / "model.json"
    model.write_text(json.dumps(fitted(records(duffing(), 2.0, count=20), degree=3).to_dict()), encoding="utf-8")
    asked = ["analyse", "eigenfunctions", str(model), "-O", "count=3"]
    rows = json.loads(sysid(*asked, "-o", tmp_path / "plane.png", "--json").out)["rows"]
    assert len(rows) == 3
    assert [row["modulus"] for row in rows] == sorted((row["modulus"] for row in rows), reverse=True)
    assert (tmp_path / "plane.png").stat().st_size > 10_000
    sysid(*asked, "-O", "low=[3, 3]", status=2)
    with pytest.raises(InputError, match="picture of bisimulation"):
        api.analyse("bisimulation", "corridors-mdp", out=tmp_path / "none.svg")
