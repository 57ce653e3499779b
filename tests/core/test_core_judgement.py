"""What moves under a controller alone is told from what something else moves, whatever the sensors' noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from harness import registry
from harness.data.conditioning.suspicion import swapped_in_and_out
from harness.data.oddities import examined
from harness.errors import FitError
from harness.judgement import feedback_of, law_of, refuse_undetermined
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

A, B = np.array([[1.02, 0.2], [0.0, 0.9]]), np.array([[0.0], [1.0]])
SPEC = PlantSpec((Channel("u"),), (Channel("q"), Channel("v")), 0.1)
NOISES = (0.0, 1e-6, 1e-3, 0.03, 0.1)


def closed(seed, noise, *, integral=0.0, dither=0.0, measured=False, n=600):
    """Return a record under ``u = -K y - I sum(y)``, of true states or of the sensors' words for them."""
    rng = np.random.default_rng(seed)
    x, total = np.zeros(2), np.zeros(2)
    u, y = np.zeros((n, 1)), np.zeros((n, 2))
    for k in range(n):
        y[k] = x + noise * rng.normal(size=2)
        seen = y[k] if measured else x
        total += seen
        u[k] = -(0.8 * seen[0] + 0.7 * seen[1]) - integral * total[0] + dither * rng.normal()
        x = A @ x + B @ u[k] + 0.3 * rng.normal(size=2)
    return Trajectory(np.arange(n) * 0.1, u, y, SPEC)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("integral", [0.0, 0.05])
@pytest.mark.parametrize("measured", [False, True])
def test_a_controller_alone_is_seen_at_every_noise(noise, integral, measured):
    assert all(law_of([closed(s, noise, integral=integral, measured=measured)]) is not None for s in range(3))


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("integral", [0.0, 0.05])
def test_what_is_added_to_the_controller_is_enough(noise, integral):
    for seed in range(3):
        data = [closed(seed, noise, integral=integral, dither=1.0)]
        assert feedback_of(data).found
        assert law_of(data) is None


def test_outputs_that_remember_inputs_longer_than_those_are_asked_are_no_controller():
    """Thirty lines, of which a lightly damped plant keeps more than the forty samples that are asked at first."""
    k, x, y, rng = np.arange(1500), np.zeros(4, complex), np.zeros((1500, 2)), np.random.default_rng(1)
    u = np.sin(np.linspace(0.03, 2.2, 30) * k[:, None] + rng.uniform(0, 6, 30)).sum(axis=1)
    for row in k:
        y[row] = x.real @ [[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [1.0, -1.0]] + 1e-4 * rng.normal(size=2)
        x = 0.999 * np.exp(1j * np.array([0.2, 0.6, 1.0, 1.5])) * x + u[row]
    assert not feedback_of([Trajectory(0.1 * k, u[:, None], y, SPEC)]).found


def filtered(seed, noise, *, kept=0.7, dither=0.0, n=800):
    """Return a record under a controller behind a filter of one pole, which acts on what its sensor says."""
    rng = np.random.default_rng(seed)
    x, command, slow = 0.0, 0.0, 0.0
    u, y = np.zeros((n, 1)), np.zeros((n, 1))
    for k in range(n):
        y[k] = x + noise * rng.normal()
        command = kept * command - (1 - kept) * 2.0 * y[k, 0]
        u[k] = command + dither * rng.normal()
        slow = 0.97 * slow + 0.05 * rng.normal()
        x = 0.9 * x + 0.2 * u[k, 0] + slow
    return Trajectory(np.arange(n) * 0.1, u, y, PlantSpec((Channel("u"),), (Channel("q"),), 0.1))


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("kept", [0.3, 0.7, 0.9])
def test_a_controller_behind_a_filter_is_seen_at_every_noise_and_what_is_added_to_it(noise, kept):
    laws = [law_of([filtered(s, noise, kept=kept)]) for s in range(3)]
    assert all(law is not None and "u[k-1]" in law.text for law in laws)
    assert all(law_of([filtered(s, noise, kept=kept, dither=0.5)]) is None for s in range(3))


def test_a_law_is_told_with_its_gains():
    law = law_of([closed(0, 0.05)])
    assert law is not None
    assert law.text.startswith("u = -0.")
    gains = [float(part) for part in law.text.replace("u =", "").replace("- ", "-").split() if part[-1] not in "qv"]
    assert sorted(np.abs(gains)) == pytest.approx([0.7, 0.8], abs=0.05)


@pytest.mark.parametrize("lines", [1, 3, 10, 30])
@pytest.mark.parametrize("noise", [0.0, 0.01, 1.0])
def test_sines_in_open_loop_are_no_feedback(lines, noise):
    rng, k = np.random.default_rng(lines), np.arange(800)
    u = np.sin(np.outer(k, rng.uniform(0.05, 2.5, lines)) + rng.uniform(0, 6, lines)).sum(axis=1)[:, None]
    y = np.zeros((800, 1))
    for j in range(799):
        y[j + 1] = 0.9 * y[j] + u[j]
    seen = y + noise * y.std() * rng.normal(size=y.shape)
    data = [Trajectory(k * 1.0, u, seen, PlantSpec((Channel("u"),), (Channel("y"),), 1.0))]
    assert law_of(data) is None


def test_inputs_that_move_together_are_named():
    rng = np.random.default_rng(0)
    a = rng.normal(size=300)
    spec = PlantSpec((Channel("a"), Channel("b")), (Channel("y"),), 1.0)
    data = Trajectory(np.arange(300.0), np.column_stack([a, 1 - 2 * a]), rng.normal(size=(300, 1)), spec)
    with pytest.raises(FitError, match=r"b = -2 a up to a constant"):
        refuse_undetermined([data], "mine")
    refuse_undetermined([data], "mine", 0.0)


def together(apart: float, noise: float, seed: int) -> Trajectory:
    """Return y[k+1] = .9 y + .1 a + .05 b with ``b = -a`` up to so much, and sensor noise."""
    rng, n = np.random.default_rng(seed), 1200
    a = np.repeat(rng.choice([-1.0, 1.0], n // 6), 6)
    u, y = np.column_stack([a, -a + apart * rng.normal(size=n)]), np.zeros(n)
    for k in range(n - 1):
        y[k + 1] = 0.9 * y[k] + u[k] @ [0.1, 0.05]
    spec = PlantSpec((Channel("a"), Channel("b")), (Channel("y"),), 1.0)
    return Trajectory(np.arange(float(n)), u, (y + noise * rng.normal(size=n))[:, None], spec)


@pytest.mark.parametrize("identifier", ["arx", "n4sid", "prediction-error", "ho-kalman", "dmdc", "stlsq"])
def test_inputs_that_move_apart_by_less_than_noise_hides_are_refused(identifier):
    with pytest.raises(FitError, match=r"b = -1 a|a = -1 b"):
        registry.create("identifiers", identifier).fit([together(1e-3, 0.01, 0)], rng=np.random.default_rng(0))


@pytest.mark.parametrize("noise", [0.0, 1e-4, 0.01])
@pytest.mark.parametrize("seed", range(3))
def test_inputs_that_move_apart_by_more_than_noise_hides_are_fitted(noise, seed):
    record = together(max(10 * noise, 1e-3), noise, seed)
    model = registry.create("identifiers", "arx", order=1).fit([record], rng=np.random.default_rng(0))
    assert model.frequency_response(np.zeros(1))[0, 0].real == pytest.approx([1.0, 0.5], abs=0.25)


def test_an_input_that_rests_behind_a_pulse_is_no_law() -> None:
    """An impulse response as data: the rows that are tested hold a constant, which crashed the test once."""
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    u = np.zeros((60, 1))
    u[0] = 1.0
    y = np.concatenate([[0.0], 0.5 * 0.8 ** np.arange(59)])[:, None]
    data = [Trajectory(np.arange(60.0), u, y, spec)]
    assert law_of(data) is None
    found = registry.create("identifiers", "arx").fit(data, rng=np.random.default_rng(0))
    assert found.frequency_response(np.array([1e-9]))[0, 0, 0].real == pytest.approx(2.5)


def test_an_output_that_answers_within_the_sample_is_told_how_to_be_declared():
    rng = np.random.default_rng(0)
    u, y = rng.choice([-1.0, 1.0], size=(600, 1)), np.zeros((600, 1))
    for k in range(1, 600):
        y[k] = 0.3 * y[k - 1] + u[k] - u[k - 1]
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    with pytest.raises(FitError, match="declare feedthrough = true"):
        refuse_undetermined([Trajectory(np.arange(600.0), u, y, spec)], "mine")
    declared = PlantSpec(spec.inputs, spec.outputs, 1.0, feedthrough=True)
    refuse_undetermined([Trajectory(np.arange(600.0), u, y, declared)], "mine")


@pytest.mark.parametrize("hold", [3, 25])
@pytest.mark.parametrize("first_order", [True, False])
def test_crosstalk_of_a_held_input_is_no_controller(hold, first_order):
    """The plant turned round is a law too; no controller rests while its outputs move."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.normal(size=1000 // hold + 1), hold)[:1000]
        y = lfilter([0.0, 0.1], [1.0, -0.9], u) if first_order else lfilter([0.0, 0.02], [1.0, -1.8, 0.85], u)
        for size in (0.0, 0.3):
            read = (y + size * y.std() * u + 1e-3 * rng.normal(size=1000))[:, None]
            record = Trajectory(
                np.arange(1000) * 1.0, u[:, None], read, PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
            )
            found = examined(Dataset("x", (Run(record),))).oddities
            assert law_of([record]) is None
            assert any(odd.kind == "crosstalk" for odd in found) == (size > 0)


def said(name, record):
    """Return what a fit of the first order warns of, or is refused for."""
    try:
        model = registry.create("identifiers", name, order=1).fit([record], rng=np.random.default_rng(0))
    except FitError as error:
        return str(error)
    return model.notes.get("warning", "")


@pytest.mark.parametrize("noise", [0.05, 0.2])
@pytest.mark.parametrize("name", ["arx", "prediction-error"])
def test_a_fit_says_that_outputs_respond_within_the_sample(name, noise):
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=100), 10)
    y = lfilter([0.0, 0.1], [1.0, -0.9], u) + noise * rng.normal(size=1000)
    for size in (0.0, 0.3):
        read = (y + size * u)[:, None]
        record = Trajectory(np.arange(1000) * 1.0, u[:, None], read, PlantSpec((Channel("u"),), (Channel("y"),), 1.0))
        assert ("declare feedthrough = true" in said(name, record)) == (size > 0)


def pieces_of(record: Trajectory, lost: float, seed: int) -> list[Trajectory]:
    """Return the stretches between lost rows, as ``gaps = "split"`` makes them of a log."""
    kept = np.flatnonzero(np.random.default_rng(seed).random(len(record)) >= lost)
    stretches = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1)
    return [
        Trajectory(record.t[rows], record.u[rows], record.y[rows], record.spec) for rows in stretches if len(rows) > 1
    ]


@pytest.mark.parametrize("lost", [0.0, 0.01, 0.02, 0.05])
@pytest.mark.parametrize("kind", ["multisine", "prbs", "steps"])
def test_seams_between_lost_rows_are_no_feedback(kind: str, lost: float) -> None:
    n, h = 2000, 0.01
    spec = PlantSpec((Channel("u"),), (Channel("y"),), h)
    rng = np.random.default_rng(0)
    drawn = {
        "multisine": lambda: np.sin(
            2 * np.pi * np.arange(1, 51) * 0.05 * h * np.arange(n)[:, None] + rng.uniform(0, 2 * np.pi, 50)
        ).sum(axis=1),
        "prbs": lambda: np.repeat(rng.choice([-1.0, 1.0], n // 7 + 1), 7)[:n],
        "steps": lambda: np.repeat(rng.normal(size=n // 100), 100),
    }
    for stiffness, damping in ((20.0, 0.4), (20.0, 8.0), (350.0, 0.6)):
        u = drawn[kind]()
        y = lfilter([0.0, 0.0, h**2], [1.0, damping * h - 2.0, 1.0 - damping * h + stiffness * h**2], u)
        record = Trajectory(h * np.arange(n), u[:, None], (y + 1e-3 * y.std() * rng.normal(size=n))[:, None], spec)
        pieces = pieces_of(record, lost, 1)
        assert not feedback_of(pieces).found, (stiffness, damping)
        assert not any(map(swapped_in_and_out, pieces)), (stiffness, damping)


@pytest.mark.parametrize("lost", [0.0, 0.01, 0.02, 0.05])
def test_feedback_is_found_in_a_record_with_lost_rows(lost: float) -> None:
    for seed in range(5):
        assert feedback_of(pieces_of(closed(seed, 0.03, dither=0.1, measured=True), lost, seed)).found
