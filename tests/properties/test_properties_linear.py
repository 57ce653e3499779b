"""What every identifier of linear systems must do, and deliberate faults that each of these properties must see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.registry import create
from harness.scoring import equation_error, predict, simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from harness.testing import LinearSystem, simulate_linear, tempered_systems

SEEDS = st.integers(0, 2**32 - 1)
STATES: list[tuple[str, dict[str, Any]]] = [
    ("least-squares", {}),
    ("least-squares", {"method": "iv"}),
    ("least-squares", {"method": "tls"}),
    ("least-squares", {"method": "l1"}),
    ("least-squares", {"method": "linf"}),
    ("arx", {"order": 1}),
    ("dmdc", {}),
    ("edmdc", {"degree": 1, "ridge": 0.0}),
    ("stlsq", {"time": "discrete", "degree": 1, "threshold": 1e-6}),
]
OUTPUTS: list[tuple[str, dict[str, Any]]] = [
    ("arx", {"order": 4, "ridge": 1e-14}),
    ("dmdc", {"delays": 4, "ridge": 1e-14}),
    ("ho-kalman", {"markov": 40, "observer": 5}),
    ("n4sid", {"past": 5, "method": "parsim"}),
]


def _name(case: tuple[str, dict[str, Any]]) -> str:
    return " ".join([case[0], *(f"{key}={value}" for key, value in case[1].items())])


def fitted(case: tuple[str, dict[str, Any]], records: list[Trajectory]) -> Any:
    return create("identifiers", case[0], **case[1]).fit(records, rng=np.random.default_rng(0))


# ---- the properties ----


def predicts_new_inputs(model: Any, held: Trajectory, tolerance: float = 1e-4) -> None:
    """Exact data give a model that is exact on a record with other inputs, one step ahead and in free run."""
    assert equation_error(model, held).nrmse.max() < tolerance, "one step ahead"
    assert simulation_error(model, held).nrmse.max() < tolerance, "free run"


def answers_a_pulse_as_the_system_does(model: Any, system: Any, held: Trajectory, tolerance: float = 1e-4) -> None:
    """What one input sample changes in the free run is what it changes in the system: gain, sign, delay."""
    n, x = 8, model.initial_state(held)
    for column in range(system.spec.nu):
        u = np.zeros((n, system.spec.nu))
        runs = []
        for size in (0.0, 1.0):
            u[0, column] = size
            state, rows = x, []
            for k in range(n):
                rows.append(model.output(state, u[k]))
                state = model.step(state, u[k])
            runs.append(np.array(rows))
        truth = np.zeros((n, system.spec.ny))
        move = system.B[:, column]
        for k in range(1, n):
            truth[k] = system.C @ move
            move = system.A @ move
        assert np.abs(runs[1] - runs[0] - truth).max() < tolerance * np.abs(truth).max(), f"input {column}"


# ---- they hold ----


@pytest.mark.parametrize("case", STATES, ids=_name)
@given(tempered_systems(measured_state=True), SEEDS)
@settings(max_examples=8)
def test_exact_states_give_an_exact_model(case, system, seed):
    rng = np.random.default_rng(seed)
    model = fitted(case, [simulate_linear(system, 60, rng=rng) for _ in range(2)])
    held = simulate_linear(system, 40, rng=rng)
    predicts_new_inputs(model, held)
    answers_a_pulse_as_the_system_does(model, system, held)


@pytest.mark.parametrize("case", OUTPUTS, ids=_name)
@given(tempered_systems(), SEEDS)
@settings(max_examples=8)
def test_exact_outputs_give_an_exact_model(case, system, seed):
    rng = np.random.default_rng(seed)
    model = fitted(case, [simulate_linear(system, 120, rng=rng) for _ in range(2)])
    held = simulate_linear(system, 60, rng=rng)
    assert equation_error(model, held, burn_in=8).nrmse.max() < 1e-3
    answers_a_pulse_as_the_system_does(model, system, held, 1e-3)


@pytest.mark.first_of_each("case")
@pytest.mark.parametrize("case", [*STATES, *OUTPUTS], ids=_name)
@given(tempered_systems(measured_state=True, tempers=("stable", "lightly damped", "delayed")), SEEDS)
@settings(max_examples=5)
def test_time_shift_and_repetition_under_a_seed_leave_the_model_and_the_data_alone(case, system, seed):
    record = simulate_linear(system, 90, rng=np.random.default_rng(seed), noise=0.01)
    kept = record.y.copy(), record.u.copy()
    later = replace(record, t=record.t + 1000.0)
    one, again, shifted = (fitted(case, [data]) for data in (record, record, later))
    held = simulate_linear(system, 40, rng=np.random.default_rng([seed, 1]))
    assert np.array_equal(predict(one, held, 1), predict(again, held, 1), equal_nan=True)
    assert np.array_equal(predict(one, held, 1), predict(shifted, held, 1), equal_nan=True)
    assert np.array_equal(record.y, kept[0])
    assert np.array_equal(record.u, kept[1])


@pytest.mark.first_of_each("case")
@pytest.mark.parametrize("case", [*STATES, *OUTPUTS], ids=_name)
@given(tempered_systems(measured_state=True, tempers=("stable", "lightly damped")), SEEDS)
@settings(max_examples=5)
def test_the_order_of_outputs_does_not_matter(case, system, seed):
    rng = np.random.default_rng(seed)
    record, held = (simulate_linear(system, 150, rng=rng, noise=0.02) for _ in range(2))
    turn = np.roll(np.arange(system.spec.ny), 1)
    plain = fitted(case, [record])
    turned = fitted(case, [replace(record, y=record.y[:, turn])])
    one = predict(plain, held, 1)[10:]
    other = predict(turned, replace(held, y=held.y[:, turn]), 1)[10:]
    assert np.abs(other - one[:, turn]).max() < 1e-5 * np.abs(held.y).max()


EQUIVARIANT: list[tuple[str, dict[str, Any]]] = [
    ("least-squares", {"least_excitation": 0.0}),
    ("least-squares", {"least_excitation": 0.0, "method": "iv"}),
    ("arx", {"order": 1, "least_excitation": 0.0}),
    ("arx", {"order": 2, "least_excitation": 0.0}),
    ("dmdc", {"least_excitation": 0.0}),
    ("dmdc", {"delays": 2, "least_excitation": 0.0}),
]
"""Others weigh the outputs one by one, and are right to change under noise when these are mixed."""


@pytest.mark.parametrize("case", EQUIVARIANT, ids=_name)
@given(tempered_systems(measured_state=True), SEEDS)
@settings(max_examples=6)
def test_other_coordinates_of_the_measured_state_give_the_same_predictions(case, system, seed):
    rng = np.random.default_rng(seed)
    n = system.spec.ny
    mix = np.linalg.qr(rng.normal(size=(n, n)))[0] @ np.diag(rng.uniform(0.5, 2.0, n))
    records = [simulate_linear(system, 80, rng=rng, noise=0.02) for _ in range(2)]
    held = simulate_linear(system, 40, rng=rng)
    plain = fitted(case, records)
    mixed = fitted(case, [replace(one, y=one.y @ mix.T) for one in records])
    one = predict(plain, held, 1)[3:]
    other = predict(mixed, replace(held, y=held.y @ mix.T), 1)[3:]
    assert np.abs(other - one @ mix.T).max() < 1e-6 * np.abs(held.y @ mix.T).max()


@given(tempered_systems(tempers=("stable", "lightly damped")), SEEDS, st.integers(1, 5), st.integers(1, 3))
@settings(max_examples=10)
def test_order_and_lag_are_honoured(system, seed, order, delay):
    record = simulate_linear(system, 200, rng=np.random.default_rng(seed), noise=0.05)
    delay = min(delay, order)
    model = fitted(("arx", {"order": order, "delay": delay}), [record])
    ny, nu = system.spec.ny, system.spec.nu
    assert model.a_matrix.shape[0] == order * ny + (order - 1) * nu
    response = model.impulse_response(delay + 1)
    assert np.all(response[:delay] == 0.0)
    assert np.any(response[delay] != 0.0)
    realized = fitted(("ho-kalman", {"markov": 30, "order": order}), [record])
    assert realized.a_matrix.shape[0] == order


# ---- deliberate faults are seen ----


@dataclass(frozen=True)
class Faulty:
    """A model with one thing wrong."""

    inner: Any
    change: Callable[[FloatArray], FloatArray]

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "inner"), name)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.asarray(self.inner.step(x, self.change(u)))

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.asarray(self.inner.free_run(x, self.change(u)))


FAULTS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "ignores its input": lambda u: 0.0 * u,
    "negated B": lambda u: -u,
    "gain of 1.01": lambda u: 1.01 * u,
    "only the first input": lambda u: np.concatenate([u[..., :1], 0.0 * u[..., 1:]], axis=-1),
    "inputs exchanged": lambda u: u[..., ::-1],
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("holds", ["predicts", "answers"])
def test_a_deliberate_fault_breaks_the_properties(fault, holds):
    rng = np.random.default_rng(1)
    spec = PlantSpec((Channel("u0"), Channel("u1")), (Channel("y0"), Channel("y1")), 0.1)
    system = LinearSystem(np.array([[0.8, 0.3], [-0.2, 0.7]]), np.array([[1.0, -0.4], [0.5, 2.0]]), np.eye(2), spec)
    model = fitted(("least-squares", {}), [simulate_linear(system, 80, rng=rng)])
    held = simulate_linear(system, 40, rng=rng)
    faulty = Faulty(model, FAULTS[fault])

    def check(one: Any) -> None:
        if holds == "predicts":
            predicts_new_inputs(one, held)
        else:
            answers_a_pulse_as_the_system_does(one, system, held)

    check(model)
    with pytest.raises(AssertionError):
        check(faulty)
