"""Arrays, integers, booleans, texts as inputs, outputs and parameters, through the C loop and the Python loop."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from harness.errors import InputError
from plants.fmu import engine as fmu_engine
from plants.fmu.archive import read_fmu
from plants.fmu.options import encode, encoded
from plants.fmu.plant import FmuPlant, describe
from plants.fmu.variables import channels, choose, resize

RNG = np.random.default_rng(0)
SIZED = '<UInt64 name="n" valueReference="90" causality="structuralParameter" variability="fixed" start="2"/>'


@pytest.fixture(params=[True, False], ids=["c-loop", "python-loop"])
def zoo(
    request: pytest.FixtureRequest, odd_fmu: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> Iterator[FmuPlant]:
    if not request.param:
        monkeypatch.setattr(fmu_engine, "native_library", lambda: None)
    parameters = {"A": [[1.0, 2.0], [3.0, 4.0]], "label": "longer label"}
    with FmuPlant(odd_fmu("zoo", 3), sample_time=0.1, parameters=parameters) as plant:
        yield plant


def test_channels(zoo: FmuPlant) -> None:
    assert [c.name for c in zoo.spec.inputs] == ["u[1]", "u[2]", "w", "small", "large", "flags[1]", "flags[2]"]
    assert [c.name for c in zoo.spec.outputs] == ["y[1]", "y[2]", "w2", "small_out", "large_out", "both"]
    kinds = ["real", "real", "real", "integer", "integer", "boolean"]
    assert [c.kind for c in zoo.spec.outputs] == kinds
    assert zoo.abilities == {"batch"}
    assert any("direct feedthrough" in text for text in zoo.warnings)


def test_values_travel_through_every_type(zoo: FmuPlant) -> None:
    zoo.reset(rng=RNG)
    rows = np.array(
        [
            [1.0, 10.0, 0.5, 7, 2.0**40, 1, 1],
            [-1.0, 1.0, -0.25, -7, 5, 1, 0],
            [0.0, 0.0, 0.1, 2.6, 0, 0, 1],
        ]
    )
    expected = np.array(
        [
            [21.0, 43.0, 1.0, -7, 2.0**40 + 1, 1],
            [1.0, 1.0, -0.5, 7, 6, 0],
            [0.0, 0.0, 2 * float(np.float32(0.1)), -3, 1, 0],
        ]
    )
    got = np.array([zoo.step(row) for row in rows])
    assert got == pytest.approx(expected, rel=1e-7)
    assert np.array_equal(zoo.rollout(rows), got)


def test_parameters_of_other_types(odd_fmu: Callable[..., Path]) -> None:
    path = odd_fmu("zoo", 3)
    with FmuPlant(path, sample_time=0.1, outputs=["label_length"], parameters={"label": "four"}) as plant:
        assert plant.reset(rng=RNG) == pytest.approx([4.0])
    for parameters, words in (
        ({"A": [1.0, 2.0, 3.0]}, "4 values"),
        ({"A": [[1.0, "x"], [0, 0]]}, "a number"),
        ({"label": 3}, "a text"),
    ):
        with pytest.raises(InputError, match=words):
            FmuPlant(path, sample_time=0.1, parameters=parameters)
    with pytest.raises(InputError, match="cannot be a signal"):
        FmuPlant(path, sample_time=0.1, outputs=["label"])


def test_enumeration_by_name_and_wrong_values() -> None:
    from plants.mockups import mockup

    path = mockup("quantiser")
    for parameters, words in (
        ({"rounding": "sideways"}, "one of nearest, down, toward_zero"),
        ({"bits": 2.5}, "whole number"),
        ({"bits": True}, "a number"),
        ({"enabled": "yes"}, "true or false"),
    ):
        with pytest.raises(InputError, match=words):
            FmuPlant(path, sample_time=0.1, parameters=parameters)
    with FmuPlant(path, sample_time=0.1, outputs=["rounding"], parameters={"rounding": "down"}) as plant:
        assert plant.spec.outputs[0].kind == "category"
        assert plant.reset(rng=RNG) == pytest.approx([2.0])


def test_describe_shows_shapes_and_types(odd_fmu: Callable[..., Path]) -> None:
    rows = {row["name"]: row for row in describe(odd_fmu("zoo", 3))["variables"]}
    assert rows["A"]["shape"] == [2, 2]
    assert rows["label"]["type"] == "String"
    assert rows["label"]["start"] == "zoo"


def test_structural_parameters_give_arrays_their_shape(odd_fmu: Callable[..., Path], tmp_path: Path) -> None:
    """The description alone tells the channels; the matrices that are set must fit them."""
    path = tmp_path / "sized.fmu"
    with zipfile.ZipFile(odd_fmu("zoo", 3)) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "modelDescription.xml":
                text = content.decode().replace("<ModelVariables>", f"<ModelVariables>{SIZED}")
                content = re.sub(r'<Dimension start="2"\s*/>', '<Dimension valueReference="90"/>', text).encode()
            new.writestr(entry, content)
    for n, values in ((None, [1, 0, 0, 1]), (3, list(range(9)))):
        file = read_fmu(path)
        resize(file, {} if n is None else {"n": n})
        assert [c.name for c in channels(choose(file, ["u"], "input"))] == [f"u[{k + 1}]" for k in range(n or 2)]
        assert encoded(file, {"A": values}, "parameters", None) == {"A": [float(x) for x in values]}


@pytest.mark.parametrize("value", ["00ff", b"\x00\xff", bytearray(b"\x00\xff")])
def test_a_binary_value_is_bytes_or_hexadecimal_digits(odd_fmu: Callable[..., Path], value: object) -> None:
    file = read_fmu(odd_fmu("zoo", 3))
    variable = SimpleNamespace(name="blob", type="Binary", shape=None)
    assert encode(file, variable, value) == b"\x00\xff"
    with pytest.raises(InputError, match="hexadecimal"):
        encode(file, variable, "0xzz")
