"""Recursive lumped parameters: the batch's answer equation by equation, sample by sample, and forgetting."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.command import main
from harness.errors import FitError, InputError
from harness.models.estimate import estimate_of
from harness.physics import load_model
from harness.scoring import regret
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.mechanics.lumped import Form, Lumped
from identifiers.online.lumped_recursive import RecursiveLumped
from identifiers.online.rls import RecursiveLeastSquares
from identifiers.online.rls_pass import rotated

from .conftest import passed

DT = 0.01


def record(model: str, seed: int, *, samples: int = 400, noise: float = 0.0, p: FloatArray | None = None) -> Trajectory:
    """Return a record of a model under a held random force, rates measured too."""
    system = load_model(model)
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-3, 3, size=(samples // 10, system.nu)), 10, axis=0)
    n = len(system.coordinates)
    x = system.simulator(DT, substeps=4).states(system.vector() if p is None else p, 0.2 * rng.normal(size=2 * n), u)
    rates = [Channel(f"{one.name}_rate", f"{one.unit}/s") for one in system.outputs]
    y = x + noise * np.repeat([1.0, 10.0], n) * rng.normal(size=x.shape)
    return Trajectory(np.arange(samples) * DT, u, y, PlantSpec(system.inputs, (*system.outputs, *rates), DT))


@settings(max_examples=30, deadline=None)
@given(
    k=st.integers(1, 8), n=st.integers(1, 3), rows=st.integers(10, 60), seed=st.integers(0, 10**6),
    forgetting=st.sampled_from([1.0, 0.99, 0.8]), native=st.booleans(),
)  # fmt: skip
def test_rotations_give_weighted_least_squares(
    k: int, n: int, rows: int, seed: int, forgetting: float, native: bool
) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(rows * n, k)), rng.normal(size=rows * n)
    found = rotated(np.zeros((k, k + 1)), np.column_stack([x, y]), group=n, forgetting=forgetting, native=native)
    weight = np.repeat(np.sqrt(forgetting) ** np.arange(rows - 1, -1, -1), n)
    batch = np.linalg.lstsq(x * weight[:, None], y * weight, rcond=None)[0]
    assert np.linalg.solve(found[:, :k], found[:, k]) == pytest.approx(batch, rel=1e-9, abs=1e-9)


@settings(max_examples=12, deadline=None)
@given(
    model=st.sampled_from(["pendulum", "cart-pole", "double-pendulum"]),
    form=st.sampled_from(["torque", "energy", "momentum"]), seed=st.integers(0, 10**6),
    forgetting=st.sampled_from([1.0, 0.995]),
)  # fmt: skip
def test_sample_by_sample_is_the_batch(model: str, form: str, seed: int, forgetting: float) -> None:
    """Random mechanisms: parameters drawn anew, two records, nothing across the seam."""
    rng = np.random.default_rng(seed)
    system = load_model(model)
    p = system.vector() * rng.uniform(0.5, 2.0, size=system.np)
    records = [record(model, seed + k, samples=150, noise=1e-4, p=p) for k in range(2)]
    online = RecursiveLumped(form, model, forgetting=forgetting, width=9)  # type: ignore[arg-type]
    state = passed(online, records)
    blocks = [online.equations(state.context, one) for one in records]
    rows = np.concatenate(blocks)
    n = 1 if form == "energy" else len(system.coordinates)
    assert state.rows == len(rows)
    weight = np.repeat(np.sqrt(forgetting) ** np.arange(len(rows) // n - 1, -1, -1), n)[:, None]
    size = np.linalg.norm(rows[:, :-1], axis=0)
    batch = np.linalg.lstsq(rows[:, :-1] / size * weight, rows[:, -1] * weight[:, 0], rcond=None)[0] / size
    assert state.lumps is not None
    assert np.abs(state.lumps - batch).max() <= 1e-8 * np.abs(batch).max()


@pytest.mark.parametrize("form", ["torque", "energy", "momentum"])
def test_a_fit_finds_the_cart_pole_and_leaves_a_record(form: str) -> None:
    data = [record("cart-pole", seed, samples=800, noise=1e-5) for seed in range(2)]
    fitted = RecursiveLumped(form, "cart-pole", width=5).fit(data, rng=np.random.default_rng(0))  # type: ignore[arg-type]
    truth = load_model("cart-pole").values()
    assert fitted.parameters["mp"] == pytest.approx(truth["mp"], rel=0.03)
    assert fitted.parameters["l"] == pytest.approx(truth["l"], rel=0.03)
    found = estimate_of(fitted)
    assert found is not None
    assert found.intervals is None
    assert found.units[found.names.index("mp")] == "kg"


def test_intervals_hold_what_simulated_the_record() -> None:
    data = record("pendulum", 3, samples=800, noise=1e-3)
    fitted = RecursiveLumped("momentum", "pendulum", intervals=20).fit([data], rng=np.random.default_rng(0))
    found, truth = estimate_of(fitted), load_model("pendulum").values()
    assert found is not None
    for name in found.names:
        low, high = found.interval(name) or (np.inf, -np.inf)
        assert low - 0.5 * (high - low) <= truth[name] <= high + 0.5 * (high - low)


def test_forgetting_follows_a_pendulum_that_changes() -> None:
    system = load_model("pendulum")
    heavy = system.vector()
    heavy[0] *= 2
    heavy[2] *= 2
    records = [record("pendulum", 0, samples=800), record("pendulum", 1, samples=800, p=heavy)]
    keeps, forgets = (
        passed(RecursiveLumped("energy", "pendulum", forgetting=one, width=5), records) for one in (1.0, 0.98)
    )
    assert keeps.lumps is not None
    assert forgets.lumps is not None
    J = keeps.context.regression.names.index("J")
    assert forgets.lumps[J] == pytest.approx(heavy[0], rel=0.02)
    assert abs(keeps.lumps[J] / heavy[0] - 1) > 0.1


@pytest.mark.slow
def test_its_regret_is_far_below_that_of_a_linear_recursion() -> None:
    data = [record("cart-pole", seed, samples=600, noise=1e-5) for seed in range(2)]
    own = regret(RecursiveLumped("momentum", "cart-pole", width=5), data, rng=np.random.default_rng(0))
    linear = regret(RecursiveLeastSquares(), data, rng=np.random.default_rng(0))
    assert own.losses[700:].mean() < 0.5 * linear.losses[700:].mean()


def test_options_and_models_that_do_not_fit_are_refused() -> None:
    for width, said in ((4, r"width: .*a number >= 5"), (6, "odd width")):
        with pytest.raises(InputError, match=said):
            RecursiveLumped(width=width)
    with pytest.raises(InputError, match="forgotten"):
        RecursiveLumped(forgetting=0.9, intervals=20)
    spec = PlantSpec((Channel("u", "N"),), (Channel("x", "m"),), DT)
    with pytest.raises(FitError, match="theta"):
        RecursiveLumped(model="cart-pole").init(spec, rng=np.random.default_rng(0))


@pytest.mark.parametrize("identifier", ["lumped-momentum", "lumped-recursive", "ekf"])
def test_the_command_prints_units_of_parameters_and_lumps(
    identifier: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = record("cart-pole", 0, samples=400, noise=1e-5)
    table = np.column_stack([data.t, data.u, data.y[:, :2]])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="t [s],u [N],x [m],theta [rad]", comments="")
    with contextlib.suppress(SystemExit):
        main(["identify", str(tmp_path / "run.csv"), "--model", "cart-pole", "--identifier", identifier])
    said = capsys.readouterr().out
    assert re.search(r"mc = [\d.]+ kg$", said, re.MULTILINE), said
    assert re.search(r"btheta = [-\d.e]+ N m s/rad$", said, re.MULTILINE), said
    if identifier != "ekf":
        assert re.search(r"l\*\*2\*mp = [\d.e-]+ kg m\^2", said), said


@pytest.mark.parametrize("form", ["energy", "momentum"])
def test_the_defaults_are_those_of_the_batch_on_positions_alone(form: Form) -> None:
    """The energy form looked at steps of one sample: J came out as 0.061 of 0.1, the batch's is 0.099."""
    system = load_model("pendulum")
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-0.6, 0.6, size=(100, 1)), 5, axis=0)
    y = system.simulator(0.02, substeps=4).rollout(system.vector(), np.zeros(2), u)[:, :1]
    data = Trajectory(np.arange(500) * 0.02, u, y + 0.005 * rng.normal(size=y.shape),
                      PlantSpec(system.inputs, system.outputs, 0.02))  # fmt: skip
    online = RecursiveLumped(form, "pendulum").fit([data], rng=rng).parameters
    batch = Lumped(form, "pendulum", smoothing="local").fit([data], rng=rng).parameters
    for name, value in batch.items():
        assert online[name] == pytest.approx(value, rel=0.05)
        assert online[name] == pytest.approx(system.values()[name], rel=0.1)
