"""Couplings described in TOML: built as in Python, refused with file, key and remedy, and run from the command line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api, registry
from harness.cosim import Connection, Coupled, couple
from harness.errors import InputError
from harness.parts.files import make_part
from harness.protocols import Plant
from harness.trust import trusting
from plants.fmu.mockups import pendulum_fmu
from plants.fmu.plant import FmuPlant
from plants.mockups import mockup

RNG = np.random.default_rng(0)
LOOP = """
sample_time = 0.02
inputs = { set = "law.r" }
outputs = ["arm.theta", "law.u"]
initial = { "arm.theta" = 0.3 }
[parts.arm]
plant = "pendulum-fmu"
options = { sample_time = 0.02 }
[parts.law]
fmu = "law.fmu"
options = { parameters = { Kp = 0.8, Ki = 0.3 } }
[[connections]]
from = "set"
to = "law.r"
[[connections]]
from = "arm.theta"
to = "law.y"
[[connections]]
from = "law.u"
to = "arm.u"
gain_unit = "N m"
"""


def make(id: str, options: dict[str, Any]) -> Plant:
    plant: Plant = registry.create("plants", id, **options)
    return plant


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    (tmp_path / "law.fmu").write_bytes(mockup("pi_controller").read_bytes())
    (tmp_path / "loop.toml").write_text(LOOP)
    with trusting(tmp_path):
        yield tmp_path


def loop(order: Any = "gauss-seidel") -> Coupled:
    return Coupled(
        {
            "arm": pendulum_fmu(sample_time=0.02),
            "law": FmuPlant(mockup("pi_controller"), sample_time=0.02, parameters={"Kp": 0.8, "Ki": 0.3}),
        },
        [("set", "law.r"), ("arm.theta", "law.y"), Connection("law.u", "arm.u", gain_unit="N m")],
        inputs={"set": "law.r"},
        outputs=["arm.theta", "law.u"],
        order=order,
        initial={"arm.theta": 0.3},
    )


def motion(plant: Plant, n: int = 50) -> np.ndarray:
    rows = [plant.reset(rng=RNG)]
    rows += [plant.step(np.array([0.4])) for _ in range(n)]
    return np.array(rows)


@pytest.mark.parametrize("order", ["gauss-seidel", "jacobi"])
def test_a_file_gives_the_same_motion_as_python(folder: Path, order: str) -> None:
    with couple(folder / "loop.toml", make, changes={"order": order}) as told, loop(order) as written:
        assert str(told.spec) == str(written.spec)
        assert np.array_equal(motion(told), motion(written))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("sample_time = 0.02\ninputs", "smaple_time = 0.02\ninputs", r"unknown key.*sample_time.*'smaple_time'"),
        ("gain_unit", "gain_units", r"connections\[2\].gain_units: unknown key.*gain_unit.*'gain_units'; remedy"),
        ('plant = "pendulum-fmu"', 'plnat = "pendulum-fmu"', r"parts.*unknown key.*plant, fmu, mockup.*'plnat'"),
        ('plant = "pendulum-fmu"', 'plant = "pendulum-fmv"', r"parts\.arm.*unknown plant.*did you mean"),
        ('fmu = "law.fmu"', 'fmu = "low.fmu"', r"parts\.law.*no such FMU"),
        ('fmu = "law.fmu"', 'fmu = "law.fmu"\nmockup = "quantiser"', r"parts\.law.*fmu and mockup"),
        ('outputs = ["arm.theta", "law.u"]', "", r"missing.*'outputs'"),
        ('gain_unit = "N m"', "gain = true", r"wrong value: expected `?float.*bool"),
        ('gain_unit = "N m"', 'gain_unit = "V"', r"law.u -> arm.u: units.*'N m'.*gain in 'V'"),
        ('gain_unit = "N m"', "", r"law.u -> arm.u: units.*gain_unit"),
        ('"arm.theta" = 0.3', '"leg.theta" = 0.3', r"initial state.*arm, law.*'leg.theta'"),
        ("[parts.arm]", "[parts.arm", r"not TOML"),
        ("sample_time = 0.02\ninputs", 'order = "both"\ninputs', r"order.*both"),
    ],
)
def test_a_mistake_is_named_with_file_place_and_remedy(folder: Path, old: str, new: str, words: str) -> None:
    path = folder / "loop.toml"
    assert old in LOOP
    path.write_text(LOOP.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        couple(path, make)
    assert str(path) in str(caught.value)
    assert "remedy: " in str(caught.value)
    assert "\n" not in str(caught.value)


def test_only_how_it_is_stepped_can_be_changed_from_outside(folder: Path) -> None:
    with pytest.raises(InputError, match=r"option of a coupling.*sample_time, order.*got 'outputs'"):
        couple(folder / "loop.toml", make, changes={"outputs": ["arm.theta"]})
    with pytest.raises(InputError, match="no such coupling"):
        couple(folder / "none.toml", make)


def test_a_coupling_is_a_plant_of_the_command(folder: Path) -> None:
    record = api.simulate(str(folder / "loop.toml"), scenario="multisine", seed=3)
    assert [c.name for c in record.spec.inputs] == ["set"]
    assert [c.name for c in record.spec.outputs] == ["arm.theta", "law.u"]
    assert record.y[0, 0] == 0.3
    again = api.simulate(str(folder / "loop.toml"), scenario="multisine", seed=3)
    assert np.array_equal(record.y, again.y)


def test_the_example_file_keeps_the_pole_up() -> None:
    path = Path(__file__).parents[2] / "examples" / "coupled_cart_pole.toml"
    with couple(path, make_part) as plant:
        plant.reset(rng=RNG)
        for _ in range(600):
            y = plant.step(np.zeros(1))
    assert abs(y[1] - np.pi) < 0.01
    assert abs(y[0]) < 0.05
