"""What a part computes from its inputs while it initialises, it computes from what drives them then."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import registry
from harness.cosim import Connection, Coupled
from harness.protocols import Plant

ZERO = 273.15
Made = Callable[..., Plant]


@pytest.fixture
def settled(odd_fmu: Callable[..., Path]) -> Made:
    """Return a maker of FMUs whose level is, from the start on, twice the flow (degC, 20 by itself)."""
    path = str(odd_fmu("settled"))

    def made(id: str = "fmu", **options: Any) -> Plant:
        inner = {"path": path, "sample_time": 0.1, **options}
        if id == "isolated":
            return registry.create("plants", id, plant="fmu", **inner)
        return registry.create("plants", id, **inner)

    return made


def levels(plant: Coupled, **x0: float) -> list[float]:
    """Return the outputs at the start [degC]; after a step they are the same."""
    with plant:
        for _ in range(2):
            y = plant.reset(rng=np.random.default_rng(0), x0=x0)
        assert plant.step(np.full(plant.spec.nu, ZERO + 5)) == pytest.approx(y)
    return [float(value) - ZERO for value in y]


def chain(settled: Made, order: str, **first: Any) -> Coupled:
    """Return c -> b -> a, the parts being named in an order of one's choice."""
    parts = {name: settled(inputs=[] if name == "c" else ["flow"], **(first if name == "c" else {})) for name in order}
    return Coupled(parts, [("c.level", "b.flow"), ("b.level", "a.flow")], outputs=["a.level", "b.level", "c.level"])


@pytest.mark.parametrize("order", ["abc", "cba", "bca"])
def test_a_part_starts_from_what_drives_it_in_whatever_order_the_parts_stand(settled: Made, order: str) -> None:
    assert levels(chain(settled, order)) == pytest.approx([160, 80, 40])
    assert levels(chain(settled, order, start={"flow": ZERO + 1})) == pytest.approx([8, 4, 2])


def test_gains_and_delays_count_at_the_start_too(settled: Made) -> None:
    wire = Connection("a.level", "b.flow", 0.5, gain_unit=None, delay=3, offset=0.5 * ZERO)
    parts = {"b": settled(), "a": settled(inputs=[], start={"flow": ZERO + 7})}
    assert levels(Coupled(parts, [wire], outputs=["b.level"])) == pytest.approx([14])


def test_what_comes_from_outside_rests_at_the_own_start_value_unless_it_is_given(settled: Made) -> None:
    def pair() -> Coupled:
        parts = {"b": settled(), "a": settled(start={"flow": ZERO + 3})}
        return Coupled(
            parts, [("push", "a.flow"), ("a.level", "b.flow")], inputs={"push": "a.flow"}, outputs=["b.level"]
        )

    assert levels(pair()) == pytest.approx([12])
    told = pair()
    told.input_starts = (ZERO + 10.0,)
    assert levels(told) == pytest.approx([40])


@pytest.mark.parametrize("gain", [0.25, -0.25, 0.0])
def test_a_loop_starts_where_all_agree(settled: Made, gain: float) -> None:
    there = Connection("a.level", "b.flow", gain, gain_unit=None, offset=(1 - gain) * ZERO + 1)
    back = Connection("b.level", "a.flow", gain, gain_unit=None, offset=(1 - gain) * ZERO + 1)
    y = levels(Coupled({"a": settled(), "b": settled()}, [there, back], outputs=["a.level", "b.level"]))
    assert y == pytest.approx([2 / (1 - 2 * gain)] * 2, abs=1e-6)


def test_parts_of_a_loop_without_an_end_begin_at_their_own_start_values_and_that_is_said(settled: Made) -> None:
    parts = {name: settled(inputs=[] if name == "d" else ["flow"]) for name in "abcd"}
    wires = [("a.level", "b.flow"), ("b.level", "a.flow"), ("d.level", "c.flow")]
    plant = Coupled(parts, wires, outputs=["a.level", "b.level", "c.level"])
    assert levels(plant) == pytest.approx([40, 40, 80])
    (said,) = plant.warnings
    assert said.startswith("a, b: ")


@pytest.mark.parametrize("id", ["fmu", "isolated"])
@pytest.mark.parametrize(
    ("name", "version", "output", "options"),
    [("events", 3, "y", {"event_mode": True}), ("ball", 2, "h", {"kind": "me"}), ("ball", 3, "h", {"kind": "me"})],
)
def test_every_kind_of_part_starts_from_what_drives_it(
    odd_fmu: Callable[..., Path], id: str, name: str, version: int, output: str, options: dict[str, Any]
) -> None:
    """Where the time "when" is past, both begin with twice their input."""
    given = {"sample_time": 0.1, "inputs": ["u"], "parameters": {"when": -1.0}, **options}
    given |= {"path": str(odd_fmu(name, version)), **({"plant": "fmu"} if id == "isolated" else {})}
    driven = registry.create("plants", id, **given)
    first = registry.create("plants", "fmu", path=odd_fmu("events", 3), sample_time=0.1, inputs=[], start={"y": 3.0})
    with Coupled({"b": driven, "a": first}, [("a.y", "b.u")], outputs=[f"b.{output}"]) as pair:
        for _ in range(3):
            assert pair.reset(rng=np.random.default_rng(0)) == pytest.approx([6.0])
            pair.step(np.zeros(0))


def test_a_chain_of_parts_in_their_own_processes_starts_as_one_without(settled: Made) -> None:
    parts = {name: settled("isolated", inputs=[] if name == "c" else ["flow"]) for name in "bac"}
    wires = [("c.level", "b.flow"), ("b.level", "a.flow")]
    assert levels(Coupled(parts, wires, outputs=["a.level", "b.level", "c.level"])) == pytest.approx([160, 80, 40])
