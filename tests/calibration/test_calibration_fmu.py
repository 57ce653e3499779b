"""Parameters of FMUs from records with known ones: recovered, told apart or not, handed on."""

from __future__ import annotations

import os
import re
import signal
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmu_files import redescribed
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import api, calibrate
from harness.calibration.runs import FreeModel, RecordSimulator
from harness.errors import FitError, InputError, PlantError
from harness.physics.definition.parameters import Parameter
from harness.signals import Channel, Dataset, PlantSpec, Trajectory
from plants.fmu.plant import FmuPlant
from plants.isolation.isolated import IsolatedPlant
from plants.mockups import mockup

from .conftest import made_records


def rig(**changes: Any) -> Dataset:
    asked: dict[str, Any] = {
        "outputs": ["theta"],
        "dt": 0.02,
        "n": 200,
        "starts": [{"theta": 0.3}, {"omega": 1.0}, {"theta": -0.2}],
        "noise": 1e-3,
        "size": 0.3,
    }
    return made_records("pendulum-fmu", {"J": 0.08, "b": 0.05, "mgl": 1.4}, **(asked | changes))


def spread(found: Any) -> dict[str, float]:
    return dict(zip(found.estimate.names, np.sqrt(np.diag(found.estimate.covariance)).tolist(), strict=True))


def test_parameters_starts_and_errors_of_records_that_begin_differently(tmp_path: Path) -> None:
    found = calibrate(rig(), model=mockup("pendulum"), free=["J", "b", "mgl"], starts=1, out=tmp_path / "found.json")
    deviations = spread(found)
    for name, true in {"J": 0.08, "b": 0.05, "mgl": 1.4}.items():
        assert abs(found.parameters[name] - true) < 4 * deviations[name]
        assert deviations[name] < 0.01 * true
    assert found.before == {"J": 0.05, "b": 0.02, "mgl": 1.0}
    for told, (theta, omega) in zip(found.starts, [(0.3, 0.0), (0.0, 1.0)], strict=True):
        assert told["theta"] == pytest.approx(theta, abs=2e-3)
        assert told["omega"] == pytest.approx(omega, abs=2e-2)
    for use, count in (("estimation", 2), ("validation", 1)):
        assert len(found.errors_after[use]) == count
        for was, now in zip(found.errors_before[use], found.errors_after[use], strict=True):
            assert was["theta"][0] > 0.1
            assert now["theta"][0] == pytest.approx(1e-3, rel=0.15)
    assert found.errors()["theta"] == (found.errors_after["validation"][0]["theta"][0], "rad")
    assert not found.untold


def here(data: Any, **asked: Any) -> Any:
    """Calibrate in this process: a child takes longer to begin than our FMUs to run."""
    return calibrate(data, **{"options": {"isolated": False}, **asked})


def test_a_solver_that_is_too_coarse_is_run_more_finely(records: Callable[..., Dataset]) -> None:
    """As it is, its error goes into the parameters, and their intervals do not know of it."""
    truth = {"J": 0.06, "b": 0.03, "mgl": 1.2}
    data = records(
        "pendulum-fmu", truth, outputs=["theta"], dt=0.1, n=200, starts=[{"theta": 0.3}], noise=1e-4, size=0.2
    )
    asked: dict[str, Any] = {"model": mockup("pendulum"), "free": ["J", "mgl"], "starts": 1}
    asked["start"] = {"substep": 1.0, "b": 0.03}
    found = here(data, **asked)
    for name in asked["free"]:
        assert abs(found.parameters[name] - truth[name]) < 4 * spread(found)[name]
    (said,) = [note for note in found.notes if "the FMU is run with" in note]
    assert re.search(r"a communication step of 0\.0\d+ s and a tolerance of .*finer ones move theta by", said)
    coarse = here(data, **asked, options={"isolated": False, "step": 0.1})
    assert any(abs(coarse.parameters[name] - truth[name]) > 10 * spread(found)[name] for name in asked["free"])


def test_an_fmu_that_hangs_is_waited_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def hangs(*asked: Any) -> None:
        made.append(asked)
        raise PlantError("no answer to make within 60 s", status="timeout")

    data = rig()
    monkeypatch.setattr("harness.calibration.fitting.make_plant", hangs)
    with pytest.raises(PlantError, match="no answer to make"):
        calibrate(data, model=mockup("pendulum"), free=["J"], starts=1)
    assert len(made) == 1


def test_a_description_that_breaks_the_standard_is_read_as_it_is_for_a_run(tmp_path: Path) -> None:
    odd = '<ModelVariables order="1">'
    path = redescribed(tmp_path / "odd.fmu", lambda text: text.replace("<ModelVariables>", odd))
    found = here(rig(), model=path, free=["J", "b", "mgl"], starts=1)
    assert found.parameters["J"] == pytest.approx(0.08, rel=0.02)


def test_what_the_data_do_not_tell_is_said_by_direction(records: Callable[..., Dataset]) -> None:
    data = records(
        "drive-fmu", {"M": 30.0, "Fv": 150.0}, outputs=["q"], dt=5e-3, n=300, starts=[{}], noise=1e-4, size=300.0
    )
    found = here(data, model=mockup("drive"), free=["M", "ML", "Fv"], starts=1)
    assert found.parameters["M"] + found.parameters["ML"] == pytest.approx(85.0, rel=1e-3)  # without a gap: one mass
    assert len(found.untold) == 1
    assert "only in proportion" in found.untold[0]
    assert "fall by 1 for each 1" in found.untold[0]
    assert found.estimate.interval("M") is None
    low, high = found.estimate.interval("Fv") or (0.0, 0.0)
    assert low < 150.0 < high


def test_a_parameter_without_any_effect_is_named() -> None:
    found = here(rig(n=200), model=mockup("pendulum"), free=["J", "vs"], starts=1, start={"b": 0.05, "mgl": 1.4})
    assert any("vs has no effect" in words for words in found.untold)
    assert found.parameters["J"] == pytest.approx(0.08, rel=1e-3)
    assert found.given == {"b": 0.05, "mgl": 1.4}


@settings(max_examples=2, deadline=None)
@given(m=st.floats(0.3, 3.0), c=st.floats(0.05, 0.5), k=st.floats(0.5, 8.0))
def test_exact_records_give_exact_parameters(m: float, c: float, k: float) -> None:
    data = made_records(
        "mass-spring-fmu",
        {"m": m, "c": c, "k": k},
        outputs=["q"],
        dt=0.05,
        n=120,
        starts=[{"v": 0.2}],
        noise=0.0,
        size=1.0,
    )
    found = here(data, model=mockup("mass_spring"), free=["m", "c", "k"], starts=2, bounds={"k": (0.1, 20.0)})
    assert found.parameters == pytest.approx({"m": m, "c": c, "k": k}, rel=1e-5)
    assert found.estimate.converged


def test_the_copy_runs_as_the_model_with_these_parameters(tmp_path: Path) -> None:
    copy, ssv = tmp_path / "rig.fmu", tmp_path / "rig.ssv"
    found = here(
        rig(n=150), model=mockup("pendulum"), free=["J", "mgl"], start={"b": 0.05}, starts=1, model_out=copy, ssv=ssv
    )
    asked = {"stop": 1.0, "step": 0.02}
    start = {"theta": 0.4}
    theirs = api.simulate(str(copy), options={"start": start}, **asked)
    ours = api.simulate(
        str(mockup("pendulum")), options={"start": start, "parameters": {**found.parameters, "b": 0.05}}, **asked
    )
    assert np.array_equal(theirs.y, ours.y)
    assert np.ptp(ours.y[:, 0]) > 0.1
    rows = {row["name"]: row for row in api.describe_fmu(copy)["variables"]}
    assert float(rows["J"]["start"]) == found.parameters["J"]
    with FmuPlant(copy, sample_time=0.02, outputs=["theta"], parameters={"mgl": 1.0}) as plant:  # what is said wins
        assert plant.options["parameters"] == {"mgl": 1.0}
        plant.reset(rng=np.random.default_rng(0), x0=start)
        other = plant.rollout(np.zeros((50, 1)))
    assert not np.array_equal(other, theirs.y[1:51, :1])
    values = {node.get("name"): node[0] for node in ElementTree.parse(ssv).iter() if node.tag.endswith("}Parameter")}
    assert set(values) == {"J", "mgl", "b"}
    assert float(values["J"].get("value", "nan")) == found.parameters["J"]
    assert values["J"].get("unit") == "kg m^2"
    with zipfile.ZipFile(copy) as new, zipfile.ZipFile(mockup("pendulum")) as old:
        assert set(old.namelist()) < set(new.namelist())


def test_a_start_in_the_units_of_the_fmu(tmp_path: Path) -> None:
    """A mass in g is fitted in kg and written in g."""

    def in_grams(text: str) -> str:
        text, count = re.subn(r'<BaseUnit kg="1" ?/>', '<BaseUnit kg="1" factor="0.001"/>', text.replace('"kg"', '"g"'))
        assert count == 1
        return text

    source = redescribed(tmp_path / "gram.fmu", in_grams, "mass_spring")
    with FmuPlant(source, sample_time=0.05, outputs=["q"], parameters={"m": 1.5e-3}) as plant:
        u = np.repeat(np.random.default_rng(0).normal(size=(10, 1)), 20, axis=0)
        y = np.vstack([plant.reset(rng=np.random.default_rng(0)), plant.rollout(u[:-1])])
        record = Trajectory(np.arange(200) * 0.05, u, y, plant.spec)
    found = here(record, model=source, free=["m"], starts=1, model_out=tmp_path / "out.fmu")
    assert found.parameters["m"] == pytest.approx(1.5e-3, rel=1e-6)
    rows = {row["name"]: row for row in api.describe_fmu(tmp_path / "out.fmu")["variables"]}
    assert float(rows["m"]["start"]) == pytest.approx(1.5, rel=1e-6)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"free": []}, "nothing is free"),
        ({"free": ["J", "q"]}, "got 'q'"),
        ({"free": ["JJ"]}, "did you mean J"),
        ({"free": ["J", "J"]}, "twice"),
        ({"free": ["theta"]}, "a variable of the motion"),
        ({"free": ["Fc"]}, "positive number"),
        ({"free": ["J"], "bounds": {"b": (0.0, 1.0)}}, "not free"),
        ({"free": ["J"], "bounds": {"J": (-2.0, -1.0)}}, "overlaps"),
        ({"free": ["J"], "bounds": {"J": (0.1, 1.0)}, "start": {"J": 0.05}}, "value of parameter 'J'"),
        ({"free": ["J"], "start": {"J": float("nan")}}, "finite"),
        ({"free": ["J"], "start": {"u2": 1.0}}, "start value"),
        ({"free": ["J"], "starts": 0}, "1 or more"),
        ({"free": ["J"], "initial": "guessed"}, "estimated"),
        ({"free": ["J"], "model": "pendulum"}, "an FMU or a system"),
        ({"free": ["J"], "model": "none.fmu"}, "no such"),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_line(asked: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        here(rig(n=60), **{"model": mockup("pendulum"), **asked})
    assert "\n" not in str(caught.value)


def test_a_solver_that_is_part_of_what_is_fitted_is_said(odd_fmu: Callable[..., Path]) -> None:
    """An FMU that steps by explicit Euler with the communication step."""
    path, notes = odd_fmu("faulty"), {}
    for mode in (0, 1):
        options = {"sample_time": 0.05, "outputs": ["y"], "parameters": {"mode": mode, "T": 0.3}}
        with FmuPlant(path, **options) as plant:
            u = np.repeat(np.random.default_rng(0).normal(size=(10, 1)), 10, axis=0)
            y = np.vstack([plant.reset(rng=np.random.default_rng(0)), plant.rollout(u[:-1])])
            y += 1e-3 * np.random.default_rng(1).normal(size=y.shape)
            record = Trajectory(np.arange(100) * 0.05, u, y, plant.spec)
        given = {"isolated": False, "parameters": {"mode": mode}}
        found = here(record, model=path, free=["T"], starts=1, options=given)
        assert found.parameters["T"] == pytest.approx(0.3, rel=0.02)
        notes[mode] = " ".join(found.notes)
    assert "half the communication step" in notes[1]
    assert "half the communication step" not in notes[0]


def test_too_few_readings() -> None:
    with pytest.raises(FitError, match="too few readings"):
        here(rig(n=4, starts=[{}]), model=mockup("pendulum"), free=["J", "b"], starts=1)


def test_records_without_inputs_in_their_own_time() -> None:
    """An FMU that nothing drives (its inputs rest at their start values), from records of two lengths."""
    records = []
    with FmuPlant(mockup("mass_spring"), sample_time=0.05, inputs=[], outputs=["q"], parameters={"k": 3.0}) as plant:
        for n in (150, 110):
            y = np.vstack(
                [plant.reset(rng=np.random.default_rng(0), x0={"q": 0.5}), plant.rollout(np.zeros((n - 1, 0)))]
            )
            records.append(Trajectory(np.arange(n) * 0.05, np.zeros((n, 0)), y, plant.spec))
    found = here(records, model=mockup("mass_spring"), free=["k"], starts=1, undriven=["u"])
    assert found.parameters["k"] == pytest.approx(3.0, rel=1e-6)


class Fragile:
    """A first-order lag y' = (u - y) / T that breaks for T below 0.4 s."""

    spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    abilities: frozenset[Any] = frozenset()

    def __init__(self) -> None:
        self.values: dict[str, float] = {}

    def preset(self, values: dict[str, float]) -> None:
        self.values |= values

    def reset(self, *, rng: np.random.Generator, x0: Any = None) -> np.ndarray:
        if self.values["T"] < 0.4:
            raise PlantError("broken", status="crashed")
        self.y = np.zeros(1)
        return self.y

    def step(self, u: np.ndarray) -> np.ndarray:
        a = np.exp(-0.1 / self.values["T"])
        self.y = a * self.y + (1 - a) * u
        return self.y


def test_derivatives_and_a_plant_that_breaks() -> None:
    model = FreeModel(
        "lag", Fragile.spec.inputs, Fragile.spec.outputs, (), (Parameter("T", "s", 1.0, 0.0),), {"T": "T"}
    )
    runs = RecordSimulator(model, Fragile(), {})  # type: ignore[arg-type]
    u = np.ones((30, 1))
    assert np.isnan(runs.run(np.array([0.3]), np.zeros(0), u)).all()
    assert runs.broken is not None
    t = 0.1 * np.arange(30)
    for central, error in ((False, 2e-3), (True, 1e-5)):
        runs.central = central
        _, y, s = runs.windows(np.array([[0.8]]), np.zeros((1, 0)), u[None], None, np.zeros(1))
        assert s is not None
        assert y[0, :, 0] == pytest.approx(1 - np.exp(-t / 0.8))
        assert s[0, :, 0, 0] == pytest.approx(-t / 0.64 * np.exp(-t / 0.8), abs=error)
    _, _, s = runs.windows(np.array([[0.4]]), np.zeros((1, 0)), u[None], None, np.zeros(1))  # one side is gone
    assert s is not None
    assert s[0, :, 0, 0] == pytest.approx(-t / 0.16 * np.exp(-t / 0.4), abs=1e-2)


@pytest.mark.parametrize("isolated", [False, True])
def test_values_set_before_a_run_hold_for_all_that_follow(isolated: bool) -> None:
    options = {"sample_time": 0.02, "outputs": ["theta"]}
    u, rng = np.full((40, 1), 0.2), np.random.default_rng(0)
    with FmuPlant(mockup("pendulum"), parameters={"J": 0.1, "substep": 0.01}, **options) as plant:
        plant.reset(rng=rng)
        wanted = plant.rollout(u)
    made: Any = FmuPlant(mockup("pendulum"), **options)
    if isolated:
        made = IsolatedPlant("plants.fmu.plant:FmuPlant", {"path": str(mockup("pendulum")), **options})
    with made as plant:
        plant.reset(rng=rng)
        before = plant.rollout(u)
        plant.preset({"J": 0.1, "substep": 0.01})  # a fixed one too
        for _ in range(2):
            plant.reset(rng=rng)
            assert np.array_equal(plant.rollout(u), wanted)
        assert not np.array_equal(before, wanted)
        if isolated:
            os.kill(plant._child.process.pid, signal.SIGKILL)
            with pytest.raises(PlantError):
                plant.rollout(u)
            plant.reset(rng=rng)
            assert np.array_equal(plant.rollout(u), wanted)
