"""Figures of couplings against computations of their own: exchanges, lines, halvings, windows, loops, chains."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.cosim import Connection, Coupled
from harness.cosim.controlled import Controlled, SignalLines
from harness.cosim.convergence import Convergence, halved
from harness.cosim.free_run import free_run, hold, window
from harness.cosim.graph import newton
from harness.cosim.structure.conversion import (
    Chain,
    IntegerConversion,
    LinearConversion,
    Unit,
    change_of_unit,
    named_unit,
    undefined_unit,
)
from harness.cosim.structure.describe import _words
from harness.cosim.structure.flat import channels_of, each, members, start_of
from harness.cosim.structure.package import FolderPackage
from harness.cosim.structure.ssd import SsdReader
from harness.errors import InputError, PlantError
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory


class Lag:
    """``x+ = a x + b u``, ``y = x + d u``; a piece of a sample is a share of the way."""

    def __init__(self, a: float, b: float, d: float = 0.0, *, h: float = 0.1, ends: int | None = None) -> None:
        self.a, self.b, self.d, self.ends, self.count, self.closed = a, b, d, ends, 0, 0
        self.spec = PlantSpec((Channel("u"),), (Channel("y"),), h, (Channel("x"),), feedthrough=d != 0)
        self.abilities = frozenset({"snapshots", "truth", *(["feedthrough"] if d else [])})
        self.divides = True
        self.seen: list[float] = []

    def reset(self, *, rng: np.random.Generator, x0: Any = None) -> FloatArray:
        self.x, self.u, self.count = (x0 or {}).get("x", 0.0), 0.0, 0
        return np.array([self.x])

    def output(self, u: FloatArray) -> FloatArray:
        self.u = float(u[0])
        return np.array([self.x + self.d * self.u])

    def step(self, u: FloatArray) -> FloatArray:
        return self.step_part(u, 0, 1)

    def step_part(self, u: FloatArray, k: int, count: int) -> FloatArray:
        self.count += 1
        if self.ends is not None and self.count >= self.ends:
            raise PlantError("the plant ends")
        self.seen.append(float(u[0]))
        self.u = float(u[0])
        self.x += ((self.a - 1.0) * self.x + self.b * self.u) / count
        return np.array([self.x + self.d * self.u])

    def truth(self) -> FloatArray:
        return np.array([self.x])

    def get_state(self) -> Any:
        return self.x, self.u

    def set_state(self, state: Any) -> None:
        self.x, self.u = state

    def close(self) -> None:
        self.closed += 1


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(["jacobi", "gauss-seidel"]),
    st.sampled_from([("p", "q"), ("q", "p")]),
    st.integers(0, 3),
    st.integers(1, 3),
    st.integers(0, 999),
)
def test_a_coupling_of_two_moves_as_its_equations_say(
    order: str, sequence: tuple[str, str], delay: int, every: int, seed: int
) -> None:
    """Whoever is stepped second under Gauss-Seidel takes the new value; a slow part steps at the end of its sample."""
    rng = np.random.default_rng(seed)
    a, c = rng.uniform(-0.9, 0.9, 2)
    b, d, gain, offset = rng.normal(size=4)
    parts: dict[str, Any] = {"p": Lag(a, b), "q": Lag(c, d, h=0.1 * every)}
    wires = [
        Connection("p.y", "q.u", gain=gain, offset=offset, delay=delay),
        Connection("q.y", "p.u", add=True),
        Connection("w", "p.u", gain=-0.5, add=True),
    ]
    coupled = Coupled(
        parts, wires, inputs={"w": "p.u"}, outputs=["p.y", "q.y"], order=order, sequence=sequence, sample_time=0.1
    )  # type: ignore[arg-type]
    x, z, held = 0.3, -0.7, 0.0
    line = [x] * delay
    assert coupled.reset(rng=rng, x0={"p.x": x, "q.x": z}) == pytest.approx([x, z])
    for k in range(9):
        w = float(rng.normal())
        old, slow = (x, z), z
        arriving = line[0] if delay else None

        def into_q() -> float:
            return gain * (x if arriving is None else arriving) + offset  # noqa: B023

        if order == "jacobi":
            u_p, u_q = old[1] - 0.5 * w, gain * (old[0] if arriving is None else arriving) + offset
        for name in sequence:
            if name == "p":
                x = a * x + b * (u_p if order == "jacobi" else slow - 0.5 * w)
            else:
                if k % every == 0:
                    held = u_q if order == "jacobi" else into_q()
                if (k + 1) % every == 0:
                    z = c * z + d * held
                    slow = z
        if delay:
            line = [*line[1:], old[0]]
        assert coupled.step(np.array([w])) == pytest.approx([x, z], rel=1e-9, abs=1e-9)
    assert coupled.truth() == pytest.approx([x, z])
    coupled.close()
    assert [part.closed for part in parts.values()] == [1, 1]


def test_a_loop_of_feedthrough_is_solved_at_every_instant_and_strong_coupling_is_implicit() -> None:
    parts: dict[str, Any] = {"p": Lag(0.5, 1.0, 0.4), "q": Lag(0.2, 0.3, -0.6)}
    wires = [Connection("p.y", "q.u"), Connection("q.y", "p.u", add=True), Connection("w", "p.u", add=True)]
    with Coupled(parts, wires, inputs={"w": "p.u"}, outputs=["p.y", "q.y"]) as coupled:
        found = coupled.reset(rng=np.random.default_rng(0), x0={"p.x": 1.0, "q.x": 2.0})

        def loop(x: float, z: float, w: float) -> list[float]:
            return np.linalg.solve([[1.0, -0.4], [0.6, 1.0]], [x + 0.4 * w, z]).tolist()

        assert found == pytest.approx(loop(1.0, 2.0, 0.0))
        assert coupled.output(np.array([3.0])) == pytest.approx(loop(1.0, 2.0, 3.0))
        assert coupled.spec.feedthrough
    strong: dict[str, Any] = {"p": Lag(0.5, 0.3), "q": Lag(0.2, -0.4)}
    pair = [("p.y", "q.u"), ("q.y", "p.u")]
    with Coupled(strong, pair, outputs=["p.y", "q.y"], iterations=60) as coupled:
        coupled.reset(rng=np.random.default_rng(0), x0={"p.x": 1.0, "q.x": 2.0})
        implicit = np.linalg.solve([[1.0, -0.3], [0.4, 1.0]], [0.5, 0.4])  # x+ = a x + b y+
        assert coupled.step(np.zeros(0)) == pytest.approx(implicit, rel=1e-9)
        assert max(len(part.seen) for part in strong.values()) < 40  # it ends when the passes agree
    twice: dict[str, Any] = {"p": Lag(0.5, 0.3), "q": Lag(0.2, -0.4)}
    with Coupled(twice, pair, outputs=["p.y", "q.y"], iterations=2) as coupled:
        coupled.reset(rng=np.random.default_rng(0), x0={"p.x": 1.0, "q.x": 2.0})
        first = [0.5 + 0.3 * 2.0, 0.4 - 0.4 * (0.5 + 0.3 * 2.0)]
        assert coupled.step(np.zeros(0)) == pytest.approx([0.5 + 0.3 * first[1], 0.4 - 0.4 * first[0]])
        assert [len(part.seen) for part in twice.values()] == [2, 2]


def test_lines_within_a_step_are_extrapolated_from_the_last_and_interpolated_from_this_one() -> None:
    parts: dict[str, Any] = {"p": Lag(0.9, 0.2), "q": Lag(0.8, -0.3)}
    for order in ("gauss-seidel", "jacobi"):
        with Coupled(
            parts, [("p.y", "q.u"), ("q.y", "p.u")], outputs=["p.y", "q.y"], order=order, hold="linear"
        ) as made:
            made.reset(rng=np.random.default_rng(0), x0={"p.x": 1.0, "q.x": -1.0})
            x, z, rate_x, rate_z = 1.0, -1.0, 0.0, 0.0
            for _ in range(5):
                new_x = 0.9 * x + 0.2 * (z + 0.5 * rate_z)
                middle = 0.5 * (x + new_x) if order == "gauss-seidel" else x + 0.5 * rate_x
                new_z = 0.8 * z - 0.3 * middle
                rate_x, rate_z, x, z = new_x - x, new_z - z, new_x, new_z
                assert made.step(np.zeros(0)) == pytest.approx([x, z])
    words: Any = Lag(0.5, 1.0)
    words.spec = PlantSpec((Channel("u"),), (Channel("y", kind="category", minimum=0, maximum=9),), 0.1)
    with Coupled({"p": words, "q": Lag(0.5, 1.0)}, [("q.y", "p.u")], inputs=["q.u"], outputs=["p.y"]) as made:
        lines = SignalLines(made._parts, 2)
    lines.remember([1.0, 2.0], [3.0, 5.0], 0.5)
    assert lines.rates == [0.0, 6.0]  # a category does not move along a line
    assert lines.extrapolated([3.0, 5.0, 7.0], 0.5) == [3.0, 6.5, 7.0]
    middle = [0.0, 0.0]
    for part in made._parts:
        lines.interpolate(middle, [1.0, 2.0], [3.0, 5.0], part)
    assert middle == [3.0, 3.5]
    lines.forget()
    assert lines.rates == [0.0, 0.0]


def test_a_step_is_halved_until_halving_changes_less_than_the_bound_and_lengthened_where_it_changes_little() -> None:
    """The signal after a step in n exchanges is 1 / n off."""
    control, made, size = Controlled([], 0.1, [], 1), list[int](), 1.0
    state = [0.0]

    def through(count: int) -> None:
        made.append(count)
        state[0] = size / count

    def step() -> list[int]:
        made.clear()
        control.step(lambda: 0.0, lambda kept: state.__setitem__(0, kept), through, lambda: state)
        return list(made)

    # 1 / (2 n) of 1 + 1 / (2 n): 0.33, 0.2, 0.11, 0.059
    assert step() == [1, 2, 4, 8, 16]
    assert control.exchanges == 3 * (1 + 2 + 4 + 8)
    assert step() == [8, 16]
    size = 0.2  # 0.0125 of 1.0125: below a quarter of the bound
    assert step() == [8, 16]
    assert step() == [4, 8]
    size = 0.0
    for expected in ([2, 4], [1, 2], [1, 2]):  # lengthened after the step
        assert step() == expected
    control.forget()
    assert control.exchanges == 0
    size = 1e9
    with pytest.raises(PlantError, match="1024 exchanges in a communication step"):
        step()
    assert max(made) == 1024


@pytest.mark.parametrize("times", [0, 21, -1])
def test_a_step_is_halved_one_to_twenty_times(times: int) -> None:
    with pytest.raises(InputError, match="1 to 20 times"):
        halved(lambda step: None, times)  # type: ignore[arg-type, return-value]


def test_changes_are_the_largest_at_the_instants_of_the_coarsest() -> None:
    asked: list[float | None] = []

    def run(step: float | None, length: float = 1.0) -> Trajectory:
        asked.append(step)
        h = step or 0.25
        t = h * np.arange(round(length / h) + 1)
        y = np.column_stack([t + h * np.sin(9 * t), np.where(np.isclose(t % 0.25, 0), 0.0, 50.0)])
        return Trajectory(t, np.zeros((len(t), 0)), y, PlantSpec((), (Channel("a"), Channel("b")), h))

    found = halved(run, 3)
    assert asked == [None, 0.125, 0.0625, 0.03125]
    assert found.steps.tolist() == [0.25, 0.125, 0.0625, 0.03125]
    most = np.abs(np.sin(9 * 0.25 * np.arange(5))).max()
    assert found.changes[:, 0] == pytest.approx(most * np.array([0.125, 0.0625, 0.03125]))
    assert found.changes[:, 1].tolist() == [0.0, 0.0, 0.0]  # between them nothing is compared
    assert found.ranges == pytest.approx(np.ptp(found.finest.y, axis=0))
    assert halved(run, 1, 0.5).steps.tolist() == [0.5, 0.25]
    rows = found.rows()
    share = found.changes[:, 0] / found.ranges[0]
    assert [row["changes most"] for row in rows] == ["a", "a", "a"]
    assert [row["order"] for row in rows] == ["", "1.00", "1.00"]
    assert rows[1]["step [s]"] == "0.125"
    assert rows[1]["half [s]"] == "0.0625"
    assert rows[1]["by"] == f"{found.changes[1, 0]:.3g}"
    assert rows[1]["of its range"] == f"{100 * share[1]:.2g} %"
    with pytest.raises(InputError, match="runs of one length, 1 s"):
        halved(lambda step: run(step, 1.0 if step is None else 0.5), 1)


def test_what_is_rounding_has_no_order() -> None:
    def orders(*changes: float) -> list[float]:
        table, ranges = np.array([[one] for one in changes]), np.array([2.0])
        return Convergence(np.ones(len(changes) + 1), ("y",), table, ranges, None).orders[:, 0].tolist()  # type: ignore[arg-type]

    assert orders(0.4, 0.1, 0.1) == pytest.approx([2.0, 0.0])
    assert np.isnan(orders(0.4, 2e-12, 1e-13)).all()
    assert orders(0.4, 2.1e-12)[0] == pytest.approx(np.log2(0.4 / 2.1e-12))


def spanned(suggested: dict[str, float | None], **asked: float | None) -> Any:
    own: dict[str, Any] = {"start": None, "stop": None, "step": None} | asked
    return window(suggested, **own, file="x.fmu", who="the FMU")


@pytest.mark.parametrize(
    ("suggested", "asked", "expected", "notes"),
    [
        ({"startTime": 1.0, "stopTime": 3.0, "stepSize": 0.5}, {}, (1.0, 3.0, 0.5, 5), 0),
        (
            {"startTime": 1.0, "stopTime": 3.0, "stepSize": 0.5},
            {"start": 0.0, "stop": 2.0, "step": 0.25},
            (0, 2, 0.25, 9),
            0,
        ),
        ({}, {}, (0.0, 1.0, 0.002, 501), 2),
        ({"startTime": 2.0}, {"step": 0.1}, (2.0, 3.0, 0.1, 11), 1),
        ({"stopTime": float("inf")}, {"step": 0.1}, (0.0, 1.0, 0.1, 11), 2),
        ({"stopTime": 2.0, "stepSize": 0.0}, {}, (0.0, 2.0, 0.004, 501), 1),
        ({"stopTime": 2.0, "fixedInternalStepSize": 0.003}, {}, (0.0, 2.0, 0.003, 667), 2),
        ({"stopTime": 2.0, "fixedInternalStepSize": 0.01}, {}, (0.0, 2.0, 0.01, 201), 1),
        ({"stopTime": 2.0, "fixedInternalStepSize": 2.0}, {}, (0.0, 2.0, 0.004, 501), 1),
        ({"stopTime": 1.0}, {"step": 0.3}, (0.0, 1.0, 0.3, 4), 1),
        ({"stopTime": 1.0}, {"step": 1.0}, (0.0, 1.0, 1.0, 2), 0),
    ],
)
def test_the_window_of_a_run(
    suggested: dict[str, float | None], asked: dict[str, float], expected: tuple[float, ...], notes: int
) -> None:
    found = spanned(suggested, **asked)
    assert (found.first, found.end, found.step, found.count) == pytest.approx(expected)
    assert len(found.notes) == notes
    assert found.instants == pytest.approx(expected[0] + expected[2] * np.arange(expected[3]))


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"stop": 0.0}, "after the start, 0 s"),
        ({"start": 2.0, "stop": 1.0}, "after the start, 2 s"),
        ({"stop": 1.0, "step": 1.5}, "which makes 1"),
        ({"stop": 1.0, "step": 1e-7}, "which makes 10000001"),
        ({"stop": 1.0, "step": -0.1}, "which makes 0"),
        ({"start": float("nan")}, "after the start"),
    ],
)
def test_a_window_that_is_none_is_refused(asked: dict[str, float], says: str) -> None:
    with pytest.raises(InputError, match=says):
        spanned({}, **asked)


def test_a_window_holds_five_million_samples_at_most() -> None:
    assert spanned({}, stop=1.0, step=1 / 4_999_999).count == 5_000_000
    with pytest.raises(InputError, match="2 to 5000000 samples"):
        spanned({}, stop=1.0, step=1 / 5_000_000)


def test_a_run_keeps_what_came_before_its_end() -> None:
    u = np.array([0.5])
    span = spanned({}, start=1.0, stop=2.0, step=0.1)
    found = free_run(Lag(0.8, 1.0), u, span)
    x = np.zeros(11)
    for k in range(10):
        x[k + 1] = 0.8 * x[k] + 0.5
    assert found.trajectory.y[:, 0] == pytest.approx(x)
    assert found.trajectory.t == pytest.approx(1.0 + 0.1 * np.arange(11))
    assert (found.trajectory.u == 0.5).all()
    assert (found.notes, found.ended, found.start) == ((), None, 1.0)
    cut = free_run(Lag(0.8, 1.0, ends=4), u, span)
    assert cut.trajectory.y[:, 0] == pytest.approx(x[:4])
    assert cut.notes == ("the run ends at t = 1.3 s of 2 s (4 of 11 samples are kept): the plant ends",)
    through = hold(Lag(0.8, 1.0, 0.3), u, 4)[0][:, 0]
    assert through == pytest.approx(x[:4] + 0.15)
    told: list[tuple[int, int]] = []
    hold(Lag(0.8, 1.0), u, 600, lambda done, count: told.append((done, count)))
    assert told == [(256, 600), (512, 600)]


def test_newton_solves_what_is_square_whatever_its_size() -> None:
    for size in (1.0, 1e-6, 1e6):
        root = newton(
            lambda x, s=size: np.array([x[0] ** 2 / s - s, x[1] - 3 * x[0]]), np.array([0.5 * size, 0.0]), 1e-12
        )
        assert root is not None
        assert root == pytest.approx([size, 3 * size], rel=1e-6, abs=1e-6)
    passes: list[int] = []

    def far(x: FloatArray) -> FloatArray:
        passes.append(1)
        return np.cosh(np.clip(x, -5, 5))

    assert newton(far, np.array([0.3]), 1e-12) is None
    assert len(passes) == 1 + 2 * 50


CELSIUS, KELVIN = Unit("degC", "K", 1.0, 273.15, (("K", 1.0),)), Unit("K", "K", 1.0, 0.0, (("K", 1.0),))
FAHRENHEIT, METRE = Unit("degF", "K", 5 / 9, 459.67 * 5 / 9, (("K", 1.0),)), Unit("m", "m", 1.0, 0.0, (("m", 1.0),))


@pytest.mark.parametrize(
    ("one", "other", "x", "y"),
    [(CELSIUS, FAHRENHEIT, 100.0, 212.0), (FAHRENHEIT, CELSIUS, 32.0, 0.0), (CELSIUS, KELVIN, 0.0, 273.15),
     (KELVIN, FAHRENHEIT, 0.0, -459.67), (FAHRENHEIT, FAHRENHEIT, 7.0, 7.0)],
)  # fmt: skip
def test_a_number_keeps_its_meaning_in_another_unit(one: Unit, other: Unit, x: float, y: float) -> None:
    change = change_of_unit(one, other)
    assert change is not None
    assert change(x) == pytest.approx(y, abs=1e-9)
    assert other.from_si(one.to_si(x)) == pytest.approx(y, abs=1e-9)
    assert change_of_unit(one, METRE) is None
    assert (str(METRE), str(FAHRENHEIT)) == ("m", "degF (0.555556 K)")


def test_a_unit_that_says_nothing_is_none() -> None:
    assert [undefined_unit(text) for text in ("", "1", "-", " ", "nonsense")] == [None] * 5
    assert [named_unit("x", *one) for one in (("1", 1.0, 0.0), ("nonsense", 2.0, 0.0))] == [None, None]
    percent = named_unit("%", "1", 0.01, 0.0)
    assert percent is not None
    assert (percent.factor, percent.powers) == (0.01, ())
    shifted = named_unit("above", "1", 1.0, 2.0)
    assert shifted is not None
    force = undefined_unit("kN.m")
    assert force is not None
    assert force.factor == pytest.approx(1000.0)
    assert dict(force.powers) == {"kg": 1.0, "m": 2.0, "s": -2.0}


def test_a_chain_reads_as_what_it_does() -> None:
    assert [_words(chain) for chain in (
        Chain(), Chain().then(LinearConversion(2.0)), Chain().then(LinearConversion(1.0, -3.0)),
        Chain().then(LinearConversion(1.5, 0.25)),
        Chain().then(IntegerConversion(((1.0, 2.0),))), Chain((LinearConversion(), )),
    )] == ["", "2 x", "1 x -3", "1.5 x +0.25", "table", ""]  # fmt: skip
    assert IntegerConversion(((1.0, 2.0), (3.0, 1.0)))(3.0) == 1.0
    assert IntegerConversion(((1.0, 2.0),))(5.0) == 5.0
    assert each([1.0, [2.0, "x"], b"y", True], Chain().then(LinearConversion(2.0, 1.0))) == [3.0, [5.0, "x"], b"y", 3.0]


def test_elements_of_arrays_are_counted_from_one_row_by_row() -> None:
    assert channels_of("x", ()) == ["x"]
    assert channels_of("x", (2, 3)) == ["x[1,1]", "x[1,2]", "x[1,3]", "x[2,1]", "x[2,2]", "x[2,3]"]
    assert (members("x", 1), members("x", 2)) == (["x"], ["x[1]", "x[2]"])


@pytest.mark.parametrize(
    ("start", "scale", "value"),
    [("2.5", None, 2.5), ("2.5 3.5", 10.0, 24.0), ("true", None, 1.0), ("false", 7.0, 0.0), (None, 2.0, None),
     ("", None, None), ("word", None, None)],
)  # fmt: skip
def test_a_start_value_is_in_si(start: str | None, scale: float | None, value: float | None) -> None:
    assert start_of({"start": start, "scale": scale, "offset": -1.0}) == value


SSD = """<s:SystemStructureDescription xmlns:s="x" version="2.0" name="whole">
  <s:System name="S"><s:Connectors><s:Connector name="u" kind="input"/></s:Connectors></s:System>
  <s:Units>
    <s:Unit name="plain"/>
    <s:Unit name="degF"><s:BaseUnit K="1" factor="0.5" offset="3"/></s:Unit>
    <s:Unit name="turn"><s:BaseUnit rad="1" s="-1"/></s:Unit>
  </s:Units>
  <s:Enumerations><s:Enumeration name="gear"><s:Item name="low" value="1"/><s:Item name="high" value="4"/>
  </s:Enumeration></s:Enumerations>
  <s:DefaultExperiment startTime="0.5" stopTime="2"/>
  <s:Annotations>{note}</s:Annotations>
</s:SystemStructureDescription>"""


@pytest.mark.parametrize(
    ("note", "step", "exchange"),
    [
        ('<o:FixedStepMaster xmlns:o="o" stepSize="0.25" baseStepSize="9"/>', 0.25, "jacobi"),
        ('<o:FixedStepAlgorithm xmlns:o="o" baseStepSize="0.125" stepSize="9"/>', 0.125, "jacobi"),
        ('<o:FixedStepMaster xmlns:o="o" stepSize="0"/>', None, None),
        ('<o:FixedStepMaster xmlns:o="o" stepSize="x"/>', None, None),
        ('<o:Other xmlns:o="o" stepSize="1" baseStepSize="1"/>', None, None),
    ],
)
def test_what_a_file_says_of_units_and_of_its_experiment(
    note: str, step: float | None, exchange: str | None, tmp_path: Path
) -> None:
    (tmp_path / "SystemStructure.ssd").write_text(SSD.format(note=note))
    reader = SsdReader(FolderPackage(tmp_path / "SystemStructure.ssd", tmp_path), "SystemStructure.ssd")
    found = reader.read()
    assert (found.name, found.start, found.stop, found.step, found.exchange) == ("whole", 0.5, 2.0, step, exchange)
    units = {name: (unit.factor, unit.offset, dict(unit.powers)) for name, unit in reader.units.items()}
    assert units == {"plain": (1.0, 0.0, {}), "degF": (0.5, 3.0, {"K": 1.0}), "turn": (1.0, 0.0, {"s": -1.0})}
    assert reader.enumerations == {"gear": {"low": 1, "high": 4}}


def test_a_file_outside_the_folder_is_said_to_be_there_and_one_that_is_nowhere_is_not(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "beside.fmu").write_text("x")
    package = FolderPackage(inside / "s.ssd", inside)
    for source, remedy in (
        ("../beside.fmu", f"--option within={tmp_path}$"),
        ("../nowhere.fmu", "put it there"),
        ("file:../beside.fmu", "put it there"),
    ):
        with pytest.raises(InputError, match=remedy):
            package.named(source, "s.ssd", "component 'a'")
