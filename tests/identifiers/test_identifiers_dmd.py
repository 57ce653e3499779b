"""Dynamic mode decomposition and its lifted form: exact where the model class holds, less biased where it says so."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import FitError
from harness.scoring import equation_error, simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.dmd import Dmdc
from identifiers.koopman import Dictionary, Edmdc

RNG = np.random.default_rng(0)
MODES = np.array([0.99 * np.exp(0.1j), 0.98 * np.exp(0.3j), 0.97 * np.exp(0.7j)])


def field(samples: int, noise: float, seed: int, n: int = 400) -> Trajectory:
    """Return snapshots of n outputs that live on six modes, driven by one input."""
    rng = np.random.default_rng(seed)
    shapes = np.linalg.qr(rng.normal(size=(n, 6)))[0]
    a = np.zeros((6, 6))
    for i, mode in enumerate(MODES):
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[mode.real, mode.imag], [-mode.imag, mode.real]]
    b, z, u = rng.normal(size=(6, 1)), np.ones((samples, 6)), rng.normal(size=(samples, 1))
    for k in range(samples - 1):
        z[k + 1] = a @ z[k] + b @ u[k]
    spec = PlantSpec((Channel("u"),), tuple(Channel(f"y{i}") for i in range(n)), 1.0)
    return Trajectory(np.arange(samples) * 1.0, u, z @ shapes.T + noise * rng.normal(size=(samples, n)), spec)


def mode_error(model) -> float:
    return max(float(np.abs(model.eigenvalues - mode).min()) for mode in (*MODES, *MODES.conj()))


@pytest.mark.parametrize("total", [False, True])
def test_four_hundred_states_of_rank_six_are_exact_without_noise(total):
    model = Dmdc(rank=6, total=total).fit([field(200, 0.0, 0)], rng=RNG)
    assert model.a_matrix.shape == (6, 6)
    assert mode_error(model) < 1e-12


def test_noise_on_the_snapshots_biases_plain_and_hardly_total():
    fits = [[Dmdc(rank=6, total=t).fit([field(200, s, 1)], rng=RNG) for t in (False, True)] for s in (0.01, 0.1)]
    (plain, total), (plain_loud, total_loud) = [[mode_error(model) for model in pair] for pair in fits]
    assert plain < 1.6e-3  # measured 8e-5
    assert total < 2.8e-4  # measured 6e-5
    assert total_loud < 0.4 * plain_loud  # measured 7e-4 against 3.3e-3


def test_a_new_input_is_predicted():
    whole = field(300, 0.0, 2)
    model = Dmdc(rank=6).fit([whole[:200]], rng=RNG)
    assert simulation_error(model, whole[200:]).nrmse.max() < 1e-9


def test_several_records_and_no_pair_across_a_seam():
    whole = field(200, 0.0, 3, n=8)
    pieces = [whole[50 * i : 50 * i + 40] for i in range(4)]
    for rank in (None, 6):
        model = Dmdc(rank=rank, ridge=0.0 if rank else 1e-13).fit(pieces[::-1], rng=RNG)
        assert mode_error(model) < 1e-6


def test_delays_recover_velocities():
    t = np.arange(300) * 0.05
    spec = PlantSpec((), (Channel("q", "m"),), 0.05)
    swing = Trajectory(t, np.zeros((300, 0)), (np.exp(-0.1 * t) * np.cos(3 * t))[:, None], spec)
    model = Dmdc(delays=2).fit([swing], rng=RNG)
    assert np.log(model.eigenvalues.astype(complex)) / 0.05 == pytest.approx([-0.1 + 3j, -0.1 - 3j], abs=1e-8)
    assert simulation_error(Dmdc().fit([swing], rng=RNG), swing).nrmse[0] > 0.3, "one snapshot is not enough"


@pytest.mark.parametrize(
    "options", [{"rank": 0}, {"rank": 9}, {"delays": 0}, {"total": True}, {"rank": 2, "delays": 2}]
)
def test_options_that_make_no_sense_are_refused(options):
    with pytest.raises(FitError, match=r"dmdc.*expected"):
        Dmdc(**options).fit([field(50, 0.0, 0, n=8)], rng=RNG)


# ---- lifted ---------------------------------------------------------------------------------------------------------


def slow_manifold(seed: int, samples: int = 60, dt: float = 0.1) -> Trajectory:
    """Return x1' = -0.05 x1, x2' = -(x2 - x1^2), solved in closed form: x1, x2, x1^2 span a Koopman-closed space."""
    slow, fast, t = -0.05, -1.0, np.arange(samples) * dt
    start = np.random.default_rng(seed).uniform(-1, 1, 2)
    x1 = start[0] * np.exp(slow * t)
    share = fast / (fast - 2 * slow)
    x2 = share * x1**2 + (start[1] - share * start[0] ** 2) * np.exp(fast * t)
    return Trajectory(
        t, np.zeros((samples, 0)), np.column_stack([x1, x2]), PlantSpec((), (Channel("x1"), Channel("x2")), dt)
    )


def test_a_closed_basis_gives_the_koopman_eigenvalues():
    model = Edmdc(degree=2, ridge=0.0).fit([slow_manifold(seed) for seed in range(5)], rng=RNG)
    rates = np.log(np.linalg.eigvals(model.a_matrix).astype(complex)) / 0.1
    for rate in (-1.0, -0.1, -0.05):
        assert np.abs(rates - rate).min() < 1e-10
    assert simulation_error(model, slow_manifold(99)).rms.max() < 1e-10


def test_lifting_beats_a_plain_linear_map_and_more_degrees_are_no_free_gift():
    fit, held = [slow_manifold(seed) for seed in range(4)], slow_manifold(50)
    errors = {n: simulation_error(Edmdc(degree=n).fit(fit, rng=RNG), held).rms.max() for n in (1, 2, 5)}
    assert errors[2] < 1e-4 * errors[1]
    assert errors[5] > errors[2], "the error is not monotone in the degree"


def test_the_dictionary_counts_and_starts_with_the_arguments():
    dictionary = Dictionary(2, True, ((0.0, 0.0),), (2.0, 1.0))
    lifted = dictionary.lift(np.array([[2.0, 3.0]]))
    assert lifted.shape == (1, 2 + 1 + 3 + 4 + 1)
    assert lifted[0, :6].tolist() == [1.0, 3.0, 1.0, 1.0, 3.0, 9.0]
    assert lifted[0, -1] == pytest.approx(10 * np.log(np.sqrt(10)))


def test_a_koopman_model_with_delays_steps_as_it_lifts():
    rng = np.random.default_rng(4)
    u, y = rng.normal(size=(400, 1)), np.zeros((400, 1))
    for k in range(2, 400):
        y[k] = 1.4 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + 0.4 * u[k - 2]
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    data = Trajectory(np.arange(400.0), u, y, spec)
    model = Edmdc(degree=1, delays=2, ridge=0.0).fit([data[:300]], rng=RNG)
    assert model.burn_in == 2
    assert equation_error(model, data[300:]).rms[0] < 1e-9
