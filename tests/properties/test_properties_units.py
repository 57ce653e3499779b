"""Units of any channel leave every score as it is, for every registered identifier that learns from signals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from harness.errors import FitError
from harness.registry import create, entries
from harness.scoring import equation_error, simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from harness.testing import LinearSystem, linear_systems, simulate_linear

OPTIONS: list[tuple[str, dict[str, Any]]] = [
    ("hold", {}),
    ("least-squares", {"least_excitation": 0.0}),
    ("least-squares", {"least_excitation": 0.0, "method": "iv", "offset": True}),
    ("least-squares", {"least_excitation": 0.0, "method": "tls"}),
    ("least-squares", {"least_excitation": 0.0, "method": "l1"}),
    ("least-squares", {"least_excitation": 0.0, "method": "linf", "scaled": True}),
    ("arx", {}),
    ("arx", {"order": 3}),
    ("dmdc", {}),
    ("dmdc", {"delays": 3, "offset": True}),
    ("dmdc", {"rank": 1}),
    ("dmdc", {"rank": "auto", "total": "auto"}),
    ("edmdc", {}),
    ("edmdc", {"delays": 2, "fourier": 1}),
    ("along-trajectory", {"width": 20}),
    ("along-trajectory", {"width": 40, "order": 2}),
    ("ho-kalman", {"markov": 30}),
    ("ho-kalman", {"markov": 30, "observer": 4}),
    ("n4sid", {"past": 5, "order": 2}),
    ("n4sid", {"past": 5, "method": "parsim"}),
    ("prediction-error", {"order": 1}),
    ("stlsq", {"time": "discrete"}),
    ("stlsq", {"order": 1}),
    ("narx", {"lags": 2}),
]
SLOW = (
    *("volterra", "impulse-response", "piecewise-affine", "random-forest", "gaussian-process", "transfer-function"),
    *("rls", "recursive-polynomial", "gradient-descent", "follow-the-leader"),
)
"""Slow for many systems, or the same for all of them: asked on one."""
PHYSICAL = {
    "true-model": "is the plant itself: its units are its own",
    "output-error": "models of physics speak SI",
    "lumped-torque": "models of physics speak SI",
    "lumped-energy": "models of physics speak SI",
    "lumped-momentum": "models of physics speak SI",
    "lumped-recursive": "models of physics speak SI",
    "inertial": "models of physics speak SI",
    "joint-calibration": "models of physics speak SI",
    "residual-physics": "models of physics speak SI",
    "lagrangian-network": "energies of a mechanism speak SI",
    "attention-network": "a network of torch scales inside; its optimiser rounds differently",
    "embed-to-control": "a network of torch scales inside; its optimiser rounds differently",
    "neural-output-error": "scales inside; a descent over many minima may end in another one",
    "polynomial-state-space": "scales inside; a descent over many minima may end in another one",
    "maximum-likelihood": "models of physics speak SI",
    "ekf": "models of physics speak SI",
    "ukf": "models of physics speak SI",
    "mdp-counting": "categories have no unit",
    "mdp-online": "categories have no unit",
    "factored-counting": "categories have no unit",
    "hidden-markov": "categories have no unit",
    "neural-network": "not asked here: needs the extra learned",
    "neural-state-space": "not asked here: needs the extra learned",
}


def rescaled(record: Trajectory, inputs: FloatArray, outputs: FloatArray) -> Trajectory:
    return Trajectory(record.t, record.u * inputs, record.y * outputs, record.spec)


def _name(case: tuple[str, dict[str, Any]]) -> str:
    return " ".join([case[0], *(f"{key}={value}" for key, value in case[1].items())])


@pytest.mark.first_of_each("case")
@pytest.mark.parametrize("case", OPTIONS, ids=_name)
@given(
    linear_systems(max_states=3, max_outputs=3),
    st.integers(0, 2**32 - 1),
    st.lists(st.integers(-4, 4), min_size=5, max_size=5),
)
@settings(max_examples=8)
def test_units_of_any_channel_leave_scores_unchanged(case, system, seed, exponents):
    hold(case, system, seed, exponents)


@pytest.mark.parametrize("name", SLOW)
def test_units_leave_scores_of_slow_identifiers_unchanged(name):
    spec = PlantSpec((Channel("u0"),), (Channel("y0"), Channel("y1")), 0.1)
    a, b = np.array([[0.8, 0.3], [-0.2, 0.7]]), np.array([[1.0], [0.5]])
    # powers of two scale without rounding, on which the splits of a tree may hang
    hold((name, {}), LinearSystem(a, b, np.eye(2), spec), 0, [3, 0, -3, 2, 0], base=8.0)


@pytest.mark.parametrize(
    "case",
    [
        ("wiener-hammerstein", {}),
        ("prandtl-ishlinskii", {"rounds": 5}),
        ("spectral-filtering", {"filters": 5, "window": 40}),
        ("edmdc", {"degree": 1, "learned": 3, "horizon": 8}),
    ],
    ids=_name,
)
def test_units_leave_scores_with_options_unchanged(case):
    system = LinearSystem(
        np.array([[0.8, 0.3], [-0.2, 0.7]]), np.array([[1.0], [0.5]]), np.array([[1.0, 0.0]]),
        PlantSpec((Channel("u0"),), (Channel("y0"),), 0.1),
    )  # fmt: skip
    hold(case, system, 0, [3, 0, -3, 2, 0], base=8.0)


def bounces(seed: int) -> Trajectory:
    """Return a mass that falls on a floor, which gives back 0.8 of its speed: height and speed, with a little noise."""
    rng, dt = np.random.default_rng(seed), 0.01
    x, rows = np.array([rng.uniform(0.8, 1.2), 0.0]), []
    for _ in range(400):
        rows.append(x)
        x = x + dt * np.array([x[1] - 0.5 * 9.81 * dt, -9.81])
        x = np.array([-x[0], -0.8 * x[1]]) if x[0] < 0 else x
    y = np.array(rows) + 1e-4 * rng.standard_normal((400, 2))
    return Trajectory(dt * np.arange(400), np.zeros((400, 0)), y, PlantSpec((), (Channel("z"), Channel("z_rate")), dt))


def test_units_leave_jumps_of_the_state_where_they_are():
    inputs, outputs = np.zeros(0), np.array([64.0, 64.0])  # a rate goes with its position
    models = [
        create("identifiers", "hybrid-automaton").fit(
            [rescaled(bounces(seed), inputs, scale) for seed in (0, 1)], rng=np.random.default_rng(0)
        )
        for scale in (np.ones(2), outputs)
    ]
    errors = [
        simulation_error(model, rescaled(bounces(2), inputs, scale)).nrmse
        for model, scale in zip(models, (np.ones(2), outputs), strict=True)
    ]
    assert errors[1] == pytest.approx(errors[0], rel=1e-3)


def hold(
    case: tuple[str, dict[str, Any]], system: LinearSystem, seed: int, exponents: list[int], base: float = 10.0
) -> None:
    """Fit and score in two systems of units."""
    rng = np.random.default_rng(seed)
    fit = [simulate_linear(system, 200, rng=rng, noise=0.05) for _ in range(2)]
    held = simulate_linear(system, 150, rng=rng, noise=0.05)
    inputs = base ** np.array(exponents[:2])[: system.spec.nu]
    outputs = base ** np.array(exponents[2:])[: system.spec.ny]
    scores = []
    for i, o in ((np.ones_like(inputs), np.ones_like(outputs)), (inputs, outputs)):
        identifier = create("identifiers", case[0], **case[1])
        try:
            model = identifier.fit([rescaled(one, i, o) for one in fit], rng=np.random.default_rng(0))
        except FitError as error:
            scores.append(str(error).split(":")[1])
            continue
        test = rescaled(held, i, o)
        pair = equation_error(model, test), simulation_error(model, test)
        scores.append([float(value) for one in pair for value in one.nrmse])
    if isinstance(scores[0], str) or isinstance(scores[1], str):
        assert scores[0] == scores[1], "refused in one unit only"
        assume(False)
    assert scores[1] == pytest.approx(scores[0], rel=1e-4, abs=1e-7)


def test_no_identifier_is_forgotten():
    own = {
        one.id
        for one in entries("identifiers")
        if one.distribution == "sysid-harness" and hasattr(create_class(one.id), "fit")
    }
    others = {"wiener-hammerstein", "prandtl-ishlinskii", "hybrid-automaton", "spectral-filtering"}
    tested = {name for name, _ in OPTIONS} | set(PHYSICAL) | set(SLOW) | others
    assert own <= tested, f"ask for their units too: {sorted(own - tested)}"


def create_class(name: str) -> Any:
    from harness.registry import load

    found = load("identifiers", name)
    return found if isinstance(found, type) else create("identifiers", name)
