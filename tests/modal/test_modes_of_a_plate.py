"""Modes of a plate in two directions: those of its equations, of records of them, and of its FMU are the exact ones."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from harness import api
from harness.errors import InputError
from harness.modal import Modes, identify_modes
from harness.scoring import linearise
from harness.signals import Trajectory
from identifiers.common.linear_model import LinearModel
from plants.equations.ode_plant import OdePlant

PLATE = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "plate.py"))
EXACT = PLATE["plate_modes"]()


@pytest.fixture(scope="module")
def exact() -> LinearModel:
    """Return the sampled plate."""
    with OdePlant(model=PLATE["plate"](), sample_time=1e-3, u_limit=1.0) as plant:
        found = linearise(plant)
        n, nu, ny = len(found.a_matrix), plant.spec.nu, plant.spec.ny
        none = np.zeros((ny, nu)), np.zeros((n, ny)), np.zeros(n), np.zeros(ny)
        return LinearModel(plant.spec, found.a_matrix, found.b_matrix, found.c_matrix, *none)


@pytest.fixture(scope="module")
def found(exact) -> Modes:
    """Return the modes of ten seconds under white forces at two points, every point seen, 1 % of noise."""
    rng = np.random.default_rng(0)
    u = 0.3 * rng.normal(size=(10_000, exact.spec.nu))
    y = exact.free_run(np.zeros((1, len(exact.a_matrix))), u[None])[0]
    y = y + 0.01 * y.std(axis=0) * rng.normal(size=y.shape)
    return identify_modes([Trajectory(1e-3 * np.arange(10_000), u, y, exact.spec)])


def test_the_equations_have_the_modes_of_the_grid_and_these_those_of_the_plate(exact):
    poles = np.log(exact.eigenvalues) / 1e-3
    poles = poles[poles.imag > 0]
    poles = poles[np.argsort(np.abs(poles))]
    assert np.abs(poles) / (2 * np.pi) == pytest.approx([mode["frequency"] for mode in EXACT], rel=2e-4)
    assert -poles.real / np.abs(poles) == pytest.approx([mode["damping"] for mode in EXACT], rel=1e-2)
    first = EXACT[0]
    assert first["frequency"] == pytest.approx(first["of the plate"], rel=0.05), "a coarse grid is a little soft"


def test_shapes_are_drawn_over_the_plate_and_refused_on_a_line(found):
    places = PLATE["places"]()
    titles = [axis.get_title() for axis in found.plot_places(places).axes if axis.get_title()]
    assert titles[0] == "1: 42.31 Hz"
    with pytest.raises(InputError, match="on one line"):
        found.plot_places({name: (place[0], 0.0) for name, place in places.items()})
    with pytest.raises(InputError, match="none of w11"):
        found.plot_places({name: place for name, place in places.items() if name != "w11"})


def test_every_mode_of_the_plate_is_found_with_its_shape(found):
    """Fifteen modes within 450 Hz, 177.7 and 182.5 Hz the closest pair; two hammers, all points seen."""
    assert len(found.modes) == len(EXACT)
    for mode, truth in zip(found.modes, EXACT, strict=True):
        assert mode.frequency == pytest.approx(truth["frequency"], rel=5e-3)
        assert mode.damping == pytest.approx(truth["damping"], rel=0.25)
        assert abs(np.vdot(mode.shape, truth["shape"])) ** 2 > 0.97, truth["waves"]
    held = [
        mode.frequency_interval[0] <= truth["frequency"] <= mode.frequency_interval[1]
        for mode, truth in zip(found.modes, EXACT, strict=True)
    ]
    assert sum(held) >= 13


@pytest.mark.slow
def test_an_fmu_of_the_plate_has_the_modes_of_the_plate(exact, tmp_path: Path):
    (tmp_path / "plate.json").write_text(json.dumps(exact.to_dict()), encoding="utf-8")
    api.export(tmp_path / "plate.json", out=tmp_path / "plate.fmu", fmi="2")
    run = api.simulate(
        str(tmp_path / "plate.fmu"),
        scenario="filtered-noise",
        scenario_options={"duration": 10.0, "amplitude": 0.3, "band": [0.0, 500.0], "noise": 1e-7},
        options={"sample_time": 1e-3},
        out=tmp_path / "run.csv",
    )
    inputs, outputs = ([c.name for c in side] for side in (run.spec.inputs, run.spec.outputs))
    found = api.modes(tmp_path / "run.csv", input=inputs, output=outputs)
    for truth in EXACT[:8]:
        near = min(found.modes, key=lambda mode: abs(mode.frequency - truth["frequency"]))
        assert near.frequency == pytest.approx(truth["frequency"], rel=3e-3)
        assert abs(np.vdot(near.shape, truth["shape"])) ** 2 > 0.98, truth["waves"]
