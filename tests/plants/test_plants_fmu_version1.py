"""FMI 1.0: co-simulation and model exchange, whose functions carry the model's name and other types."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import registry
from harness.cosim import Coupled
from harness.errors import PlantError
from harness.fmi import build
from harness.protocols import Plant
from plants.fmu import engine as fmu_engine
from plants.fmu.plant import FmuPlant

RNG = np.random.default_rng(0)
FOLDER = Path(__file__).resolve().parent / "fmus" / "old"
IMPLEMENTATION = """<Implementation><CoSimulation_StandAlone><Capabilities canHandleVariableCommunicationStepSize="true"
 canHandleEvents="true"/></CoSimulation_StandAlone></Implementation>"""


@pytest.fixture(scope="module")
def old_fmu(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    if build.compiler() is None:
        pytest.skip("no C compiler: install gcc")
    folder = tmp_path_factory.mktemp("old")

    def built(kind: str) -> Path:
        target = folder / f"{kind}.fmu"
        if not target.is_file():
            library = folder / f"{kind}{build.library_suffix()}"
            build.compile_library([FOLDER / "old.c"], library, *(["-DCS"] if kind == "cs" else []))
            text = (FOLDER / "modelDescription.xml.in").read_text()
            with zipfile.ZipFile(target, "w") as archive:
                implementation = IMPLEMENTATION if kind == "cs" else ""
                archive.writestr("modelDescription.xml", text.replace("IMPLEMENTATION", implementation))
                archive.write(library, f"binaries/{build.binary_folder(2)}/Old{build.library_suffix()}")
        return target

    return built


def exact(u: np.ndarray, dt: float = 0.1, k: float = 2.0, x: float = 1.0) -> np.ndarray:
    """Return x' = u - k x in closed form, hold by hold."""
    rows = [x]
    for value in u:
        x = value / k + (x - value / k) * np.exp(-k * dt)
        rows.append(x)
    return np.array(rows)


@pytest.mark.parametrize("native", [True, False], ids=["c-loop", "python-loop"])
@pytest.mark.parametrize("mode", [0, 1, 3], ids=["plain", "warns", "goes half way"])
def test_co_simulation(
    old_fmu: Callable[[str], Path], native: bool, mode: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not native:
        monkeypatch.setattr(fmu_engine, "native_library", lambda: None)
    u = np.sin(np.arange(30.0))
    rows = np.column_stack([u, np.arange(30) % 2])
    with FmuPlant(old_fmu("cs"), sample_time=0.1, parameters={"mode": mode}) as plant:
        assert plant.warnings == () or all("feedthrough" in text for text in plant.warnings)
        assert not plant.tells_feedthrough  # without DirectDependency an output of FMI 1.0 may depend on every input
        assert [c.name for c in plant.spec.inputs] == ["u", "on"]
        assert [c.kind for c in plant.spec.outputs] == ["real", "integer", "boolean"]
        for _ in range(2):
            first = plant.reset(rng=RNG)
            y = np.vstack([first, plant.rollout(rows)])
            assert y[:, 0] == pytest.approx(exact(u), abs=1e-9)
            assert np.array_equal(y[1:, 2], rows[:, 1])
        plant.reset(rng=RNG, x0={"x": 5.0})
        assert np.array([plant.step(row) for row in rows])[:, 0] == pytest.approx(exact(u, x=5.0)[1:], abs=1e-9)


def test_co_simulation_that_fails_says_so(old_fmu: Callable[[str], Path]) -> None:
    with FmuPlant(old_fmu("cs"), sample_time=0.1, parameters={"mode": 2}) as plant:
        plant.reset(rng=RNG)
        with pytest.raises(PlantError, match="gave up after 2 steps"):
            plant.rollout(np.zeros((5, 2)))
    with FmuPlant(old_fmu("cs"), sample_time=0.1, parameters={"mode": 9}) as plant:
        with pytest.raises(PlantError, match="initialisation failed"):
            plant.reset(rng=RNG)


@pytest.mark.parametrize("solver", ["cvode", "rk45"])
def test_model_exchange(old_fmu: Callable[[str], Path], solver: str) -> None:
    u = np.sin(np.arange(20.0))
    options = {"sample_time": 0.1, "inputs": ["u"], "outputs": ["x"], "tolerance": 1e-9, "solver": solver}
    with FmuPlant(old_fmu("me"), **options) as plant:  # type: ignore[arg-type]
        for start in (1.0, 4.0):
            first = plant.reset(rng=RNG, x0={"x": start})
            y = np.vstack([first, plant.rollout(u.reshape(-1, 1))])
            assert y[:, 0] == pytest.approx(exact(u, x=start), abs=1e-6)


@pytest.mark.parametrize("id", ["fmu", "isolated"])
@pytest.mark.parametrize("kind", ["cs", "me"])
def test_a_part_of_a_system_starts_from_what_drives_it(old_fmu: Callable[[str], Path], kind: str, id: str) -> None:
    """In mode 5 each begins with twice its input; fmpy by hand gives 6 and 12."""

    def made(**options: Any) -> Plant:
        given = {"path": str(old_fmu(kind)), "sample_time": 0.1, "outputs": ["x"], "parameters": {"mode": 5}, **options}
        plant: Plant = registry.create("plants", id, **({"plant": "fmu"} if id == "isolated" else {}), **given)
        return plant

    parts = {"c": made(inputs=["u"]), "b": made(inputs=["u"]), "a": made(inputs=[], start={"u": 1.5})}
    with Coupled(parts, [("a.x", "b.u"), ("b.x", "c.u")], outputs=["b.x", "c.x"]) as three:
        for _ in range(3):
            assert three.reset(rng=RNG) == pytest.approx([6.0, 12.0])
            three.step(np.zeros(0))


def test_a_driven_part_is_not_reset_as_some_never_return_from_a_step_after_it(old_fmu: Callable[[str], Path]) -> None:
    def made(mode: int, **options: Any) -> Plant:
        given = {"path": str(old_fmu("cs")), "sample_time": 0.1, "outputs": ["x"], "parameters": {"mode": mode}}
        plant: Plant = registry.create("plants", "isolated", plant="fmu", **given, **options)
        return plant

    with Coupled({"b": made(7, inputs=["u"]), "a": made(0, inputs=[])}, [("a.x", "b.u")], outputs=["b.x"]) as pair:
        for _ in range(3):
            assert pair.reset(rng=RNG) == pytest.approx([2.0])
            pair.step(np.zeros(0))
