"""Modes of chains of masses, whose frequencies, damping and shapes are known exactly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import FitError, InputError
from harness.modal import Criteria, Modes, identify_modes, mac
from harness.modal.poles import poles_of
from harness.physics.models.chain import chain_modes
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from plants.equations.ode import chain_ode

DT = 0.1


def record(
    count: int,
    seed: int,
    *,
    sensors: tuple[int, ...] = (0, 1, 2),
    force_at: int | None = None,
    noise: float = 0.05,
    chain: Mapping[str, Any] | None = None,
) -> Trajectory:
    """Return positions of a chain under wind on every mass, or under one random force; noise as a share of each."""
    ambient = force_at is None
    plant = chain_ode(**(chain or {}), process_noise=1.0 if ambient else 0.0)
    rng = np.random.default_rng(seed)
    warm = int(ambient) * 2000
    u = np.zeros((count + warm, plant.spec.nu))
    if force_at is not None:
        u[:, force_at] = rng.normal(size=count)
    first = plant.reset(rng=rng)
    y: FloatArray = np.vstack([first, plant.rollout(u[:-1])])[warm:, list(sensors)]
    y += noise * y.std(axis=0) * rng.normal(size=y.shape)
    inputs = () if force_at is None else (plant.spec.inputs[force_at],)
    outputs = tuple(plant.spec.outputs[k] for k in sensors)
    driven = u[warm:, :0] if force_at is None else u[:, [force_at]]
    return Trajectory(
        DT * np.arange(count, dtype=np.float64), driven, np.asarray(y, dtype=np.float64), PlantSpec(inputs, outputs, DT)
    )


def found_near(modes: Modes, frequency: float, within: float = 0.03) -> bool:
    return bool(np.any(np.abs(modes.frequencies / frequency - 1) < within))


@settings(max_examples=25, deadline=None)
@given(
    masses=st.integers(1, 6),
    coupling=st.floats(0.02, 3.0),
    damping=st.floats(0.001, 0.4),
    mass=st.floats(0.1, 10.0),
    dt=st.floats(5e-3, 25e-3),
)
def test_poles_of_exact_matrices_are_the_exact_modes(
    masses: int, coupling: float, damping: float, mass: float, dt: float
) -> None:
    from scipy.linalg import expm

    frequency, ratio, shapes = chain_modes(masses, mass=mass, damping=damping, coupling=coupling)
    speed = 2 * np.pi * frequency
    # modal coordinates, turned: no basis may matter
    blocks = np.block([[np.zeros((masses,) * 2), np.eye(masses)], [-np.diag(speed**2), -np.diag(2 * ratio * speed)]])
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(2 * masses,) * 2))[0]
    a, c = turn @ expm(blocks * dt) @ turn.T, np.hstack([shapes.T, np.zeros((masses,) * 2)]) @ turn.T
    found = poles_of(a, c, dt)
    assert [pole.frequency for pole in found] == pytest.approx(frequency, rel=1e-6)
    assert [pole.damping for pole in found] == pytest.approx(ratio, rel=1e-4, abs=1e-7)
    for pole, shape in zip(found, shapes, strict=True):
        assert mac(pole.shape, shape.astype(complex)) == pytest.approx(1.0, abs=1e-6)
        assert np.linalg.norm(pole.shape) == pytest.approx(1.0)
        assert np.abs(pole.shape.imag).max() < 1e-4


@pytest.mark.parametrize("force_at", [None, 0])
def test_every_mode_of_a_noisy_chain_is_found_and_nothing_else(force_at: int | None) -> None:
    one = record(10000, 1, force_at=force_at)
    found = identify_modes([one])
    frequency, ratio, shapes = chain_modes()
    assert len(found.modes) == 3
    for mode, f, z, shape in zip(found.modes, frequency, ratio, shapes, strict=True):
        assert abs(mode.frequency - f) < 3.5 * mode.pole.frequency_deviation < 0.01 * f
        assert abs(mode.damping - z) < 3.5 * mode.pole.damping_deviation < 1.0 * z
        assert mac(mode.shape, shape.astype(complex)) > 0.99
    middle = found.modes[1]
    assert middle.seen.tolist() == [True, False, True], "the second mode has a node at the middle mass"
    assert "q2 not seen" in found.rows()[1]["shape"]
    assert found.to_dict()["modes"][1]["shape"]["q2"]["real"] is None
    assert sum(mode.share for mode in found.modes) == pytest.approx(1.0, abs=0.1)


def test_a_mode_that_no_sensor_sees_or_no_input_reaches_is_not_printed() -> None:
    frequency = chain_modes()[0]
    for one in (record(10000, 2, sensors=(1,)), record(6000, 2, force_at=1)):
        found = identify_modes([one])
        assert found_near(found, frequency[0])
        assert found_near(found, frequency[2])
        assert not found_near(found, frequency[1]), "it has a node there"
        assert any("no sensor sees" in text or "no input reaches" in text for text in found.words())


def test_modes_two_percent_apart_are_told_apart() -> None:
    frequency, _, shapes = chain_modes(2, coupling=0.02)
    assert frequency[1] / frequency[0] < 1.021
    found = identify_modes([record(20000, 3, sensors=(0, 1), chain={"masses": 2, "coupling": 0.02})])
    assert len(found.modes) == 2
    for mode, f, shape in zip(found.modes, frequency, shapes, strict=True):
        assert abs(mode.frequency - f) < 3.5 * mode.pole.frequency_deviation
        assert mac(mode.shape, shape.astype(complex)) > 0.9


def test_damping_that_a_short_record_leaves_open_is_no_number() -> None:
    found = identify_modes([record(500, 4)])
    assert found_near(found, chain_modes()[0][0])
    vague = [k for k, mode in enumerate(found.modes) if not mode.damping_determined]
    assert vague
    for k in vague:
        assert np.isnan(found.damping[k])
        assert found.rows()[k]["damping [%]"] == "not determined"
        assert found.to_dict()["modes"][k]["damping"] is None


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_noise_alone_has_no_mode_of_which_both_numbers_are_printed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    spec = PlantSpec((), (Channel("a", "m/s2"), Channel("b", "m/s2")), 0.01)
    noise = Trajectory(0.01 * np.arange(4000, dtype=np.float64), np.zeros((4000, 0)), rng.normal(size=(4000, 2)), spec)
    found = identify_modes([noise], orders=range(2, 21, 2))
    assert not [mode for mode in found.modes if mode.share > 0.05]


@settings(max_examples=6, deadline=None)
@given(sizes=st.lists(st.floats(1e-6, 1e6), min_size=3, max_size=3), seed=st.integers(0, 100))
def test_no_unit_changes_frequency_or_damping(sizes: list[float], seed: int) -> None:
    one = record(2000, seed)
    other = Trajectory(one.t, one.u, np.asarray(one.y * sizes, dtype=np.float64), one.spec)
    first, second = (identify_modes([each], orders=range(2, 13, 2)) for each in (one, other))
    poles = [np.array([pole.frequency for pole in each.ladder[6]]) for each in (first, second)]
    assert poles[0] == pytest.approx(poles[1], rel=1e-5)


def test_records_are_used_together_and_none_across_a_seam() -> None:
    whole = record(8000, 5)
    parts = [whole[:2000], whole[2000:5000], whole[5000:]]
    one, several = identify_modes([whole]), identify_modes(parts)
    assert several.frequencies == pytest.approx(one.frequencies, rel=2e-3)
    jumped = [Trajectory(p.t, p.u, p.y + 100.0 * k, p.spec) for k, p in enumerate(parts[:1])]
    assert identify_modes(jumped).frequencies == pytest.approx(identify_modes(parts[:1]).frequencies, rel=1e-6)


def test_a_free_decay_shows_its_modes() -> None:
    plant = chain_ode()
    start = plant.reset(rng=np.random.default_rng(0), x0={"q1": 0.1})
    y: FloatArray = np.vstack([start, plant.rollout(np.zeros((1499, 3)))])
    y += 1e-4 * np.random.default_rng(1).normal(size=y.shape)
    found = identify_modes(
        [
            Trajectory(
                DT * np.arange(1500, dtype=np.float64), np.zeros((1500, 3)), np.asarray(y, dtype=np.float64), plant.spec
            )
        ]
    )
    assert found.spec.nu == 0, "inputs that never move say nothing"
    frequency, ratio, _ = chain_modes()
    assert found.frequencies == pytest.approx(frequency, rel=1e-3)
    assert found.damping == pytest.approx(ratio, rel=0.1)


def test_models_of_an_identifier_give_the_same_modes() -> None:
    one = record(1000, 6, force_at=0, noise=1e-7)
    found = identify_modes([one], identifier="dmdc", orders=[6, 9], criteria=Criteria(least=1))
    frequency, ratio, _ = chain_modes()
    assert found.method == "dmdc"
    assert found.frequencies == pytest.approx(frequency, rel=1e-4)
    assert found.damping == pytest.approx(ratio, rel=1e-2)
    assert all(0 < mode.pole.frequency_deviation < 1e-4 * mode.frequency for mode in found.modes)


@pytest.mark.slow
def test_n4sid_finds_the_modes_of_a_noisy_chain_with_honest_intervals() -> None:
    one = record(6000, 6, force_at=0)
    options = {"method": "moesp", "past": 20}
    found = identify_modes([one], identifier="n4sid", orders=[6, 8, 10], options=options)
    for mode, f, z in zip(found.modes, *chain_modes()[:2], strict=True):
        assert abs(mode.frequency - f) < 4 * mode.pole.frequency_deviation < 0.01 * f
        assert abs(mode.damping - z) < 4 * mode.pole.damping_deviation < 0.3 * z


def test_what_cannot_be_used_is_refused_on_one_line() -> None:
    one = record(1000, 0)
    with pytest.raises(FitError, match="records too short"):
        identify_modes([one[:40]])
    still = Trajectory(one.t, one.u, np.zeros_like(one.y), one.spec)
    with pytest.raises(FitError, match="no motion"):
        identify_modes([still])
    for wrong in ({"orders": [1]}, {"window": 1}, {"options": {"past": 3}}):
        with pytest.raises(InputError):
            identify_modes([one], **wrong)
    with pytest.raises(InputError, match="has no order"):
        identify_modes([one], identifier="edmdc")
    with pytest.raises(InputError, match="criteria"):
        Criteria(mac=2.0)


def test_a_controller_in_the_loop_is_refused_by_the_fit_that_it_would_bias() -> None:
    plant = chain_ode(process_noise=1.0)
    rng = np.random.default_rng(0)
    y = plant.reset(rng=rng)
    rows, inputs, last = [], [], y
    for _ in range(3000):
        seen = y + 0.02 * rng.normal(size=3)
        u = np.array([-6.0 * seen[0] - 4.0 * (seen[0] - last[0]) / DT, 0.0, 0.0]) + np.array([rng.normal(), 0, 0])
        rows.append(seen)
        inputs.append(u[:1])
        last, y = seen, plant.step(u)
    spec = PlantSpec(plant.spec.inputs[:1], plant.spec.outputs, DT)
    loop = Trajectory(DT * np.arange(3000, dtype=np.float64), np.array(inputs), np.array(rows), spec)
    with pytest.raises(FitError, match="n4sid"):
        identify_modes([loop])
    forced = identify_modes([loop], identifier="ssi", orders=range(2, 13, 2))
    assert any("feedback" in text for text in forced.words())


def _covered(seed: int, force_at: int | None, count: int) -> FloatArray:
    """Return which of the intervals of frequency and damping of the three modes hold the truth (3, 2)."""
    frequency, ratio, shapes = chain_modes()
    found = identify_modes([record(count, seed, force_at=force_at)])
    hits = np.full((3, 2), np.nan)
    for k, (f, z, shape) in enumerate(zip(frequency, ratio, shapes, strict=True)):
        near = [m for m in found.modes if abs(m.frequency / f - 1) < 0.03 and mac(m.shape, shape.astype(complex)) > 0.8]
        if near:
            mode = min(near, key=lambda m: abs(m.frequency - f))
            hits[k] = (
                mode.frequency_interval[0] <= f <= mode.frequency_interval[1],
                mode.damping_interval[0] <= z <= mode.damping_interval[1],
            )
    return hits


@pytest.mark.slow
@pytest.mark.parametrize(("force_at", "count"), [(None, 10_000), (0, 6_000)])
def test_intervals_cover_what_they_say(force_at: int | None, count: int) -> None:
    hits = np.array([_covered(seed, force_at, count) for seed in range(20_000, 20_250)])
    assert np.isnan(hits).mean() < 0.01
    share = np.nanmean(hits, axis=(0, 1))
    assert np.all((share > 0.93) & (share < 0.97)), share
