"""Recorded inputs are played at their times: units of time, breakpoints, jumps, held or linear."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness import registry
from harness.errors import InputError
from harness.rng import Streams
from harness.signals import Channel, PlantSpec

ONE = PlantSpec((Channel("u", "N m"),), (Channel("q", "rad"),), 0.1)


def played(path: Path, text: str, spec: PlantSpec = ONE, **options: Any) -> list[float]:
    path.write_text(text)
    scenario = registry.create("scenarios", "replay", file=str(path), **options)
    made = scenario.prepare(spec, streams=Streams("p", "s", 0), role="estimation/0")
    return [float(x) for x in made.excitation.ravel()]


@pytest.mark.parametrize(
    ("text", "options", "expected"),
    [
        ("time [s],u [N m]\n0,1\n0.2,2\n0.3,2\n", {}, [1, 1, 2, 2]),
        ("time [ms],u\n0,1\n200,2\n300,2\n", {}, [1, 1, 2, 2]),
        ("t,u [mN m]\n5,1000\n5.2,2000\n", {}, [1, 1, 2]),  # from its first stamp on, in the plant's unit
        ("time,u\n0,0\n0.1,0\n0.1,5\n0.3,5\n", {}, [0, 5, 5, 5]),  # twice a stamp is a jump
        ("time,u\n0,0\n0.2,2\n0.25,4\n", {"interpolation": "linear"}, [0, 1, 2]),
        ("time,u\n0,0\n0.1,1\n0.1,5\n0.2,5\n", {"interpolation": "linear"}, [0, 5, 5]),
        ("time,u\n0,0\n0.13,1\n0.3,1\n", {"off_grid": "next"}, [0, 0, 1, 1]),
        ("time,u\n0,1\n0.13,1\n0.2,2\n", {}, [1, 1, 2]),  # a row that changes nothing may lie anywhere
        # seconds since 1970, where a number is sure to 0.2 us only
        ("time [s],u\n1700000000,1\n1700000000.3,2\n1700000000.4,2\n", {}, [1, 1, 1, 2, 2]),
        ("time [s],u\n1700000000,1\n1700000000.3,2\n1700000000.4,2\n", {"off_grid": "next"}, [1, 1, 1, 2, 2]),
        ("u\n1\n2\n", {}, [1, 2]),  # inputs only: a row is a sample
        ("when,u\n0,1\n0.2,2\n", {"time": "when"}, [1, 1, 2]),
        ("time,u\n0,1\n0.2,2\n", {"samples": 2}, [1, 1]),
    ],
)
def test_what_is_played(tmp_path: Path, text: str, options: dict[str, Any], expected: list[float]) -> None:
    assert played(tmp_path / "u.csv", text, **options) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("time,u\n0,0\n0.13,1\n", {}, r"changes between samples.*0\.13 s.*off_grid=next"),
        ("time,u\n0,0\n0.2,1\n0.1,1\n", {}, "never go back"),
        ("beat,u\n0,0\n1,1\n", {}, r"no time column.*beat"),
        ("time,u [V]\n0,0\n1,1\n", {}, r"column of input 'u'.*converts to 'N m'.*'V'"),
        ("time,u\n0,0\n1,1\n", {"interpolation": "cubic"}, "linear"),
        ("time,u\n0,0\n1,1\n", {"time": "zeit"}, "zeit"),
    ],
)
def test_what_is_refused(tmp_path: Path, text: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        played(tmp_path / "u.csv", text, **options)


def test_an_input_of_whole_numbers_is_held(tmp_path: Path) -> None:
    spec = PlantSpec((Channel("u", "1", 0, 1, "boolean"),), ONE.outputs, 0.1)
    assert played(tmp_path / "u.csv", "time,u\n0,0\n0.2,1\n", spec) == [0, 0, 1]
    with pytest.raises(InputError, match="whole numbers"):
        played(tmp_path / "u.csv", "time,u\n0,0\n0.2,1\n", spec, interpolation="linear")


@given(
    steps=st.lists(st.integers(1, 7), min_size=1, max_size=12), dt=st.sampled_from([1e-3, 0.02, 1 / 3, 0.1, 2.0]),
    unit=st.sampled_from([("s", 1.0), ("ms", 1e3), ("us", 1e6), ("min", 1 / 60)]), first=st.floats(-50, 50),
)  # fmt: skip
def test_a_record_at_any_rate_and_in_any_unit_is_what_it_says(
    tmp_path_factory: pytest.TempPathFactory, steps: list[int], dt: float, unit: tuple[str, float], first: float
) -> None:
    spec = PlantSpec(ONE.inputs, ONE.outputs, dt)
    at = np.concatenate([[0], np.cumsum(steps)])
    rows = "".join(f"{(first + k * dt) * unit[1]!r},{i}\n" for i, k in enumerate(at.tolist()))
    path = tmp_path_factory.getbasetemp() / "any.csv"
    expected = np.searchsorted(at, np.arange(at[-1] + 1), side="right") - 1
    assert played(path, f"time [{unit[0]}],u\n{rows}", spec) == expected.tolist()


@pytest.mark.parametrize("text", ["u\n0.3\n", "time,u\n0.0,0.3\n"])
def test_one_row_says_nothing_of_its_time(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match="expected two rows or more"):
        played(tmp_path / "one.csv", text)
