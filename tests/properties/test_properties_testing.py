"""The public strategies: what they draw is what they say; and a user tests an estimator of her own with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.signals import Channel, PlantSpec, Trajectory
from harness.testing import DEFECTS, EXCITATIONS, NOISES, Defective, Noise, simulate_linear, tempered_systems
from harness.testing.records import defective_recordings, excitations, mechanisms, noises, placed_effects

SPEC = PlantSpec((Channel("u", "V"),), (Channel("a", "m"), Channel("b", "rad")), 0.1)
T = np.arange(200) * 0.1
CLEAN = Trajectory(T, np.zeros((200, 1)), np.column_stack([np.sin(3 * T), 2 + np.cos(2 * T)]), SPEC)


@pytest.mark.parametrize("kind", EXCITATIONS)
def test_every_excitation_can_tell_a_few_parameters(kind: str) -> None:
    @settings(max_examples=10)
    @given(excitations(300, 2, kinds=(kind,), amplitude=0.7))
    def holds(u):  # type: ignore[no-untyped-def]
        assert u.shape == (300, 2)
        assert np.abs(u).max() <= 0.7 + 1e-12
        lags = np.hstack([u[k : 295 + k] for k in range(3)])  # persistently exciting of order 3 on both inputs
        assert np.linalg.cond(lags) < 1e4

    holds()


@pytest.mark.parametrize("kind", NOISES)
def test_noise_has_its_ratio(kind: str) -> None:
    long = Trajectory(np.arange(4000) * 0.1, np.zeros((4000, 1)), np.tile(CLEAN.y, (20, 1)), SPEC)
    wrong = Noise(kind, 0.05, 3)(long).y - long.y
    ratio = wrong.std(axis=0) / long.y.std(axis=0)
    low, high = (0.03, 0.3) if kind == "outliers" else (0.03, 0.07)
    assert ((ratio > low) & (ratio < high)).all(), ratio
    assert np.array_equal(Noise(kind, 0.05, 3)(long).y, Noise(kind, 0.05, 3)(long).y)


@pytest.mark.parametrize("kind", DEFECTS)
def test_a_defect_is_where_it_says(kind: str) -> None:
    @settings(max_examples=10)
    @given(defective_recordings(CLEAN, kinds=(kind,)))
    def holds(found: Defective) -> None:
        assert found.kind == kind
        if kind == "gap":
            before, after = found.records
            assert after.t[0] > before.t[-1] + 2 * SPEC.sample_time
            return
        (record,) = found.records
        other = 1 - found.column
        assert not np.array_equal(record.y[:, found.column], CLEAN.y[:, found.column])
        assert kind == "exchanged" or np.array_equal(record.y[:, other], CLEAN.y[:, other])
        assert np.array_equal(record.u, CLEAN.u)

    holds()


@settings(max_examples=5, deadline=None)
@given(st.data())
def test_a_placed_effect_composes_with_a_drawn_mechanism(data: st.DataObject) -> None:
    from harness.effects import compose

    system = data.draw(mechanisms(("pendulum", "oscillator")))
    placed = data.draw(placed_effects(system, lambda one: one.effect.name.endswith("friction")))
    whole = compose(system, [placed])
    outputs = whole.simulator(0.01, backend="casadi").rollout(
        whole.vector(), np.zeros(whole.nx), np.ones((30, whole.nu))
    )
    assert np.isfinite(outputs).all()


@dataclass(frozen=True)
class Hers:
    """A user's estimator: the coefficients of y[k+1] = A y[k] + B u[k] by instruments, the outputs one sample older."""

    def fit(self, trajectories: Sequence[Trajectory]) -> np.ndarray:
        pairs = [(np.hstack([t.y[1:-1], t.u[1:-1]]), np.hstack([t.y[:-2], t.u[1:-1]]), t.y[2:]) for t in trajectories]
        rows, instruments, goal = (np.vstack(parts) for parts in zip(*pairs, strict=True))
        return np.linalg.lstsq(instruments.T @ rows, instruments.T @ goal, rcond=None)[0]


@given(
    tempered_systems(measured_state=True, tempers=("stable", "lightly damped")),
    noises(least=0.01, most=0.03, kinds=("white",)),
    st.integers(0, 2**32 - 1),
)
def test_a_user_tests_her_own_estimator(system, noise, seed):  # type: ignore[no-untyped-def]
    record = simulate_linear(system, 3000, rng=np.random.default_rng(seed))
    found = Hers().fit([noise(record)])
    truth = np.vstack([system.A.T, system.B.T])
    assert np.abs(found - truth).max() < 0.25 * np.abs(truth).max()
