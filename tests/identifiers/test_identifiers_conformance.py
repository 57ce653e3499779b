"""Every registered identifier keeps the public contract, on data of the kinds that it accepts."""

from __future__ import annotations

from typing import Any

import pytest

from harness.conformance import check_identifier, check_online_identifier
from harness.registry import create, entries

LINEAR = ("linear", "linear, state measured")
BATCH: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
    ("hold", {}, ("linear", "finite")),
    ("least-squares", {}, ("linear, state measured", "pendulum, rate measured")),
    ("arx", {}, (*LINEAR, "pendulum")),
    ("arx", {"order": 2, "ridge": 1e-8, "offset": False}, LINEAR),
    ("dmdc", {}, LINEAR),
    ("dmdc", {"delays": 2, "offset": True}, ("pendulum", "cart-pole")),
    ("dmdc", {"rank": 1}, LINEAR),
    ("dmdc", {"rank": 1, "total": True}, LINEAR),
    ("edmdc", {}, (*LINEAR, "pendulum, rate measured")),
    ("edmdc", {"delays": 2, "radial": 3, "trigonometric": True}, ("pendulum",)),
    ("ho-kalman", {"markov": 20, "order": 2}, LINEAR),
    ("ho-kalman", {"markov": 30, "direct": True, "stable": True}, LINEAR),
    ("n4sid", {"order": 2, "past": 6}, LINEAR),
    ("n4sid", {"method": "parsim", "past": 5, "stable": True}, LINEAR),
    ("prediction-error", {"order": 2}, ("linear",)),
    ("prediction-error", {"structure": "state-space", "order": 2}, ("linear",)),
    ("impulse-response", {"length": 20, "kernel": "tc"}, ("linear",)),
    ("prediction-error", {"structure": "armax", "order": 2}, ("linear",)),
    ("along-trajectory", {"width": 8}, ("linear, state measured",)),
    ("stlsq", {"order": 1}, ("linear, state measured", "pendulum, rate measured")),
    ("stlsq", {"time": "discrete"}, ("linear, state measured",)),
    ("stlsq", {"order": 2, "half": 12}, ("pendulum",)),
    ("narx", {"lags": 2}, ("linear",)),
    ("narx", {"lags": 1, "degree": 2, "noise": 1}, ("linear, state measured",)),
    ("mdp-counting", {}, ("finite",)),
    ("mdp-counting", {"prior": 0.5}, ("finite",)),
    ("piecewise-affine", {"starts": 1}, ("linear, state measured", "pendulum, rate measured")),
    ("piecewise-affine", {"starts": 1, "modes": None, "guards": "tree"}, ("linear, state measured",)),
    ("hybrid-automaton", {"starts": 1}, ("pendulum, rate measured",)),
    ("volterra", {"memory": 8}, ("linear",)),
    ("random-forest", {"trees": 3, "order": 1}, ("linear, state measured",)),
    ("random-forest", {"trees": 1, "order": 1, "increments": False}, ("linear, state measured",)),
    ("gaussian-process", {"exact": 60, "inducing": 20}, ("pendulum, rate measured",)),
    ("gaussian-process", {"order": 2, "exact": 60, "inducing": 20}, ("pendulum",)),
    ("hidden-markov", {"states": 5, "starts": 2, "prior": 0.1}, ("finite",)),
    ("factored-counting", {}, ("finite",)),
    ("rls", {"order": 1}, ("linear, state measured",)),
    ("mdp-online", {}, ("finite",)),
]
TESTED_ELSEWHERE = {
    "ekf": "needs its own model: tested beside the filters",
    "ukf": "needs its own model: tested beside the filters",
    "inertial": "needs an arm: tested beside the inertial parameters",
    "residual-physics": "needs its own mechanism: tested in a file of its own",
    "joint-calibration": "needs an arm with a marker: tested in a file of its own",
    "true-model": "needs a plant: tested beside the baselines",
    "output-error": "seconds for each fit: tested beside the grey boxes",
    "lumped-torque": "needs its own mechanism: tested beside the lumped forms",
    "lumped-energy": "needs its own mechanism: tested beside the lumped forms",
    "neural-state-space": "needs torch: tested beside the networks",
    "neural-network": "needs torch: tested beside the networks",
    "attention-network": "needs torch: tested in a file of its own",
    "embed-to-control": "needs torch: tested in a file of its own",
    "lagrangian-network": "needs torch: tested in a file of its own",
    "lumped-recursive": "needs its own mechanism: tested in a file of its own",
    "lumped-momentum": "needs its own mechanism: tested beside the lumped forms",
}
ONLINE: list[tuple[str, dict[str, Any]]] = [
    ("rls", {}),
    ("rls", {"order": 1, "offset": False, "forgetting": 0.99}),
    ("recursive-polynomial", {"structure": "arx", "order": 1}),
    ("recursive-polynomial", {"order": 1, "forgetting": 0.99}),
    ("recursive-polynomial", {"structure": "oe", "order": 1}),
    ("mdp-online", {}),
    ("spectral-filtering", {"filters": 5, "window": 40}),
    ("spectral-filtering", {"filters": 5, "window": 40, "update_by": "gradient"}),
    ("gradient-descent", {"order": 3}),
    ("follow-the-leader", {}),
    ("follow-the-leader", {"identifier": "ho-kalman", "options": {"markov": 12, "order": 2}, "burn_in": 60}),
]


LONG: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
    ("recursive-polynomial", {"order": 1}, ("linear",)),
    ("recursive-polynomial", {"structure": "oe", "order": 1}, ("linear",)),
    ("spectral-filtering", {}, ("linear",)),
    ("gradient-descent", {"order": 3}, ("linear",)),
    ("follow-the-leader", {}, ("linear, state measured",)),
    ("edmdc", {"degree": 1, "learned": 4, "horizon": 8}, ("pendulum, rate measured",)),
    ("gaussian-process", {"order": 2, "exact": 60, "inducing": 20}, ("pendulum",)),
    ("prediction-error", {"structure": "state-space", "order": 2}, ("linear",)),
    ("transfer-function", {"order": 2, "delay": 0.0}, ("linear",)),
    ("maximum-likelihood", {}, ("pendulum",)),
    ("wiener-hammerstein", {}, ("pendulum",)),
    ("prandtl-ishlinskii", {}, ("pendulum",)),
    ("polynomial-state-space", {"order": 2, "degree": 2, "iterations": 20}, ("linear", "pendulum")),
    (
        "neural-output-error",
        {"order": 2, "hidden": 2, "outside": 1, "starts": 2, "members": 2, "iterations": 30, "ridge": 0.01},
        ("linear",),
    ),
]
"""Online ones fitted in one pass, and searches: many seconds for all checks; other choices stand in the gate."""


def _name(case: tuple[Any, ...]) -> str:
    return " ".join([case[0], *(f"{key}={value}" for key, value in case[1].items())])


def _cases():
    """Yield every identifier on every kind of record, searches last."""
    for case in [*(case for case in BATCH if case not in LONG), *LONG]:
        for kind in case[2]:
            marks = [pytest.mark.slow] if case in LONG else []
            yield pytest.param(*case[:2], kind, marks=marks, id=f"{_name(case)}, {kind}")


@pytest.mark.first_of_each("identifier")
@pytest.mark.parametrize(("identifier", "options", "kind"), list(_cases()))
def test_batch_identifiers_keep_the_contract(identifier, options, kind):
    results = check_identifier(lambda: create("identifiers", identifier, **options), kinds=(kind,), examples=1)
    assert [f"{one.name}: {one.reason}" for one in results if not one.passed] == []


@pytest.mark.parametrize(
    "case", [*ONLINE[:-1], pytest.param(ONLINE[-1], marks=pytest.mark.slow, id=_name(ONLINE[-1]))], ids=_name
)  # a fit of markov parameters at every step takes ten seconds
def test_online_identifiers_keep_the_contract(case):
    results = check_online_identifier(lambda: create("identifiers", case[0], **case[1]), examples=2)
    broken = [f"{one.name}: {one.reason}" for one in results if not one.passed]
    assert not broken


def test_no_registered_identifier_is_forgotten():
    tested = {case[0] for case in (*BATCH, *LONG, *ONLINE)} | set(TESTED_ELSEWHERE)
    own = {one.id for one in entries("identifiers") if one.distribution == "sysid-harness"}
    assert own <= tested, f"write tests for {sorted(own - tested)}"
