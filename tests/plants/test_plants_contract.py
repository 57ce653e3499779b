"""Every plant keeps the public contract, also with options that change how it steps, and repeats its golden record."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import plants
from harness.conformance import check_plant
from harness.registry import create, entries
from harness.rng import stream

GOLDEN = Path(plants.__file__).parent / "golden"
RNG = np.random.default_rng
MATRICES = {"A": [[0.9, 0.2], [-0.1, 0.7]], "B": [[0.0], [1.0]], "C": [[1.0, 0.5]]}
NOISY = {**MATRICES, "Q": [[0.04, 0.01], [0.01, 0.09]], "R": [[0.25]]}
NEEDED = {"linear": NOISY, "finite-mdp": {"transition": [[[0.5, 0.5]], [[1.0, 0.0]]]}}
TESTED_ELSEWHERE = {
    "fmu": "needs a file: the FMUs of ours are such plants",
    "isolated": "needs a plant: tested in a file of its own",
    "gymnasium": "needs an environment: gymnasium's own checker, in a file of its own",
    "mjcf": "needs a model: tested in the file of MuJoCo",
    "urdf-bullet": "needs a URDF: the arms of ours are such plants",
    "replay": "answers to its recording only: tested in a file of its own",
    "finite-pomdp": "needs tables: grid-pomdp is such a plant",
}
OPTIONS: list[tuple[str, dict[str, Any]]] = [
    ("linear", {**NOISY, "D": [[0.3]]}),
    ("linear", {**NOISY, "C": None, "R": None}),
    ("iiwa-bullet", {"joint_damping": 0.0, "joint_friction": 0.3}),
    ("iiwa-bullet", {"control": "velocity"}),
    ("iiwa-bullet", {"control": "position"}),
    ("iiwa-bullet", {"joint_limits": True}),
    ("iiwa-bullet", {"table": (0.5, 0.0, 0.4), "outputs": ("q", "contact")}),
    ("cart-pole-pymunk", {"friction_x": 0.3, "friction_theta": 0.02}),
    ("cart-pole-pymunk", {"stop_x": 0.05, "stop_theta": 0.5}),
    ("cart-pole-pymunk", {"slack": 0.02}),
    ("cart-pole-ode", {"process_noise": 0.1}),
    ("linear-ode", {"order": 5, "inputs": 2, "outputs": 2, "process_noise": 0.01}),
    ("pendulum-ode", {"effects": [("input_delay", "u", {"tau": 0.013}), ("sensor_delay", "theta", {"tau": 0.017})]}),
    (
        "pendulum-ode",
        {
            "outputs": ["theta", ("theta", 1)],
            "effects": [("coulomb_friction", "theta", {"Fc": 0.05}), ("sensor_quantisation", "theta", {"step": 1e-3})],
        },
    ),
    ("pendulum-ode", {"outputs": [("theta", 2, "acceleration")]}),
    ("pendulum-fmu", {"fmi": 3, "outputs": ("theta", "omega")}),
]
REGISTERED = [
    (one.id, NEEDED.get(one.id, {}))
    for one in entries("plants")
    if one.distribution == "sysid-harness" and one.id not in TESTED_ELSEWHERE
]


def _cases():
    for id, options in (*REGISTERED, *OPTIONS):
        marks = [pytest.mark.slow] if id == "marked-arm" else []  # renders a picture for every sample
        yield pytest.param(id, options, marks=marks, id=" ".join([id, *map(str, options.items() if options else ())]))


@pytest.mark.parametrize(("id", "options"), list(_cases()))
def test_plants_keep_the_contract(id: str, options: dict[str, Any]) -> None:
    results = check_plant(lambda: create("plants", id, **options))
    assert [f"{one.name}: {one.reason}" for one in results if not one.passed] == []


RECORDS: dict[str, tuple[dict[str, Any], dict[str, float]]] = {
    "iiwa-bullet": ({}, {}),
    "arm-bullet": ({"joint_friction": 0.1}, {"theta": 0.5}),
    "double-pendulum-bullet": ({}, {}),
    "panda-bullet": ({}, {}),
    "arm-mujoco": ({"joint_friction": 0.2, "joint_damping": 0.05}, {"theta": 0.5}),
    "cart-pole-pymunk": ({}, {"theta": 0.5}),
    "double-cart-pole-pymunk": ({}, {"theta1": 0.5}),
    "ball-beam-pymunk": ({}, {"r": 0.1}),
    "pendulum-ode": ({}, {"theta": 0.5}),
    "cart-pole-ode": ({}, {"theta": 0.5}),
    "linear-ode": ({}, {}),
    "glider-ode": ({}, {"theta": 0.1}),
    "hydro-cart-pole-ode": ({}, {"theta": 0.1}),
    "linear": ({**NOISY, "D": [[0.3]], "sample_time": 0.1}, {"x1": 1.0}),
    "grid-mdp": ({}, {}),
    "grid-pomdp": ({}, {}),
    "pendulum-fmu": ({"Fc": 0.03, "Fs": 0.05, "c2": 0.001, "outputs": ("theta", "omega")}, {"theta": 1.0}),
    "cart-pole-fmu": ({"Fx": 0.1, "Ftheta": 0.002}, {}),
    "mass-spring-fmu": ({"k3": 0.5}, {}),
    "drive-fmu": ({"sample_time": 0.01, "gap": 0.001, "Fc": 10.0}, {}),
    "two-tanks-fmu": ({"overflow": True, "rim": 3.0}, {}),
}
"""Options and first states of the record in plants/golden/NAME.csv."""
DRAWS = {
    "grid-mdp": lambda: RNG(7),
    "grid-pomdp": lambda: stream("golden"),
}
TOLERANCE = {"grid-mdp": 0.0, "grid-pomdp": 0.0, "arm-mujoco": 1e-6}
"""Elsewhere 1e-9: another processor or mathematical library may round sin and cos otherwise in the last bit."""


@pytest.mark.parametrize("name", RECORDS)
def test_golden_records(name: str) -> None:
    """With SYSID_HARNESS_GOLDEN=write the record is written: do so only when the plant was meant to change."""
    path, (options, x0) = GOLDEN / f"{name}.csv", RECORDS[name]
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    with create("plants", name, **options) as plant:
        columns = ",".join(["time [s]", *map(str, plant.spec.inputs), *map(str, plant.spec.outputs)])
        u = table[:, 1 : 1 + plant.spec.nu]
        first = plant.reset(rng=DRAWS.get(name, lambda: RNG(0))(), x0=x0)
        found = np.hstack([table[:, :1], u, np.vstack([first, plant.rollout(u[:-1])])])
    if os.environ.get("SYSID_HARNESS_GOLDEN") == "write":
        np.savetxt(path, found, fmt="%.17g", delimiter=",", header=columns, comments="")
    assert path.read_text(encoding="utf-8").splitlines()[0] == columns
    np.testing.assert_allclose(found, table, rtol=0, atol=TOLERANCE.get(name, 1e-9))


def test_no_golden_record_is_forgotten() -> None:
    assert {path.stem for path in GOLDEN.glob("*.csv")} == set(RECORDS)
