"""The master algorithm against what the coupled equations give by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np
import pytest
from scipy.linalg import expm

from harness.cosim import Connection, Coupled
from harness.cosim.wiring import ShownOutput
from harness.errors import InputError, PlantError
from harness.protocols import Ability
from harness.signals import Channel, FloatArray, PlantSpec

RNG = np.random.default_rng(0)


class Linear:
    """x' = A x + B u held over a step, y = C x + D u: exact in discrete time."""

    def __init__(
        self,
        a: Any,
        b: Any,
        c: Any,
        d: Any = None,
        *,
        dt: float = 0.1,
        x0: Any = None,
        units: tuple[str, str] = ("1", "1"),
        snapshots: bool = True,
    ) -> None:
        a, b, c = (np.atleast_2d(np.asarray(m, dtype=float)) for m in (a, b, c))
        n, nu = b.shape
        block = expm(dt * np.block([[a, b], [np.zeros((nu, n + nu))]]))
        self.a, self.b, self.c = block[:n, :n], block[:n, n:], c
        self.d = None if d is None else np.atleast_2d(np.asarray(d, dtype=float))
        self.x0 = np.zeros(n) if x0 is None else np.asarray(x0, dtype=float)
        self.spec = PlantSpec(
            tuple(Channel(f"u{i}", units[0]) for i in range(nu)),
            tuple(Channel(f"y{i}", units[1]) for i in range(c.shape[0])),
            dt,
            states=tuple(Channel(f"x{i}") for i in range(n)),
            feedthrough=d is not None,
        )
        abilities: set[Ability] = {"truth"}
        if snapshots:
            abilities.add("snapshots")
        if d is not None:
            abilities.add("feedthrough")
        self.abilities = frozenset(abilities)
        self.x = self.x0.copy()
        self.u = np.zeros(nu)
        self.closed = 0

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        self.x = self.x0.copy()
        for name, value in (x0 or {}).items():
            self.x[int(name[1:])] = value
        return self._y(np.zeros(self.spec.nu))

    def _y(self, u: FloatArray) -> FloatArray:
        return self.c @ self.x + (0 if self.d is None else self.d @ u)

    def step(self, u: FloatArray) -> FloatArray:
        self.x = self.a @ self.x + self.b @ u
        return self._y(u)

    def output(self, u: FloatArray) -> FloatArray:
        return self._y(u)

    def truth(self) -> FloatArray:
        return self.x.copy()

    def get_state(self) -> Any:
        return self.x.copy()

    def set_state(self, state: Any) -> None:
        self.x = state.copy()

    def close(self) -> None:
        self.closed += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def integrator(**options: Any) -> Linear:
    return Linear(0.0, 1.0, 1.0, **options)


def gain(k: float, **options: Any) -> Linear:
    """A static gain: all feedthrough."""
    return Linear(0.0, 0.0, 0.0, k, **options)


def test_feedback_through_a_static_gain_acts_within_the_instant() -> None:
    loop = Coupled(
        {"plant": integrator(x0=[1.0]), "law": gain(-2.0)},
        [("plant.y0", "law.u0"), ("law.y0", "plant.u0")],
        outputs=["plant.y0", "law.y0"],
    )
    y = [loop.reset(rng=RNG)]
    y += [loop.step(np.zeros(0)) for _ in range(5)]
    expected = 0.8 ** np.arange(6)
    np.testing.assert_allclose(np.array(y)[:, 0], expected, rtol=1e-14)
    np.testing.assert_allclose(np.array(y)[:, 1], -2 * expected, rtol=1e-14)


def test_an_algebraic_loop_is_named_where_it_is_to_be_refused() -> None:
    with pytest.raises(InputError, match=r"algebraic loop.*(a -> b -> a|b -> a -> b).*delay=1"):
        Coupled(
            {"a": Linear(0.0, [[0.0, 0.0]], 0.0, [[0.5, 1.0]]), "b": gain(-3.0)},
            [("a.y0", "b.u0"), ("b.y0", "a.u0"), ("push", "a.u1")],
            inputs={"push": "a.u1"},
            outputs=["a.y0", "b.y0"],
            loops="refuse",
        )


def test_a_loop_without_solution_says_so() -> None:
    loop = Coupled(
        {"a": Linear(0.0, [[0.0, 0.0]], 0.0, [[1.0, 1.0]]), "b": gain(1.0)},
        [("a.y0", "b.u0"), ("b.y0", "a.u0"), ("push", "a.u1")],
        inputs={"push": "a.u1"},
        outputs=["a.y0"],
    )
    loop.reset(rng=RNG)
    with pytest.raises(PlantError, match="no solution"):
        loop.output(np.array([1.0]))


def test_a_delay_breaks_the_loop_and_delays_by_whole_steps() -> None:
    line = Coupled(
        {"law": gain(1.0)},
        [Connection("push", "law.u0", delay=2)],
        inputs={"push": "law.u0"},
        outputs=["law.y0"],
        loops="refuse",
    )
    got = [float(line.reset(rng=RNG)[0])] + [float(line.step(np.array([u]))[0]) for u in (1.0, 2.0, 3.0, 4.0)]
    assert got == [0.0, 0.0, 1.0, 2.0, 3.0]
    assert not line.spec.feedthrough


def test_units_are_converted_or_refused() -> None:
    def build(source: str, target: str) -> Coupled:
        return Coupled(
            {"a": gain(1.0, units=("1", source)), "b": gain(1.0, units=(target, "1"))},
            [("push", "a.u0"), ("a.y0", "b.u0")],
            inputs={"push": "a.u0"},
            outputs=["b.y0"],
        )

    turn = build("deg", "rad")
    turn.reset(rng=RNG)
    assert turn.output(np.array([180.0]))[0] == pytest.approx(np.pi)
    with pytest.raises(InputError, match=r"a.y0 -> b.u0: units.*'rad'.*'V'"):
        build("V", "rad")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"connections": []}, "input left open.*plant.u0"),
        ({"connections": [("law.y0", "plant.u0"), ("plant.y0", "plant.u0")]}, "driven twice"),
        ({"connections": [("law.y1", "plant.u0")]}, "unknown signal of part 'law'.*y0.*'y1'"),
        ({"connections": [("low.y0", "plant.u0")]}, "unknown part.*'low'"),
        ({"sequence": ["plant"]}, "sequence"),
        ({"sample_time": 0.07}, "sample time of part"),
        ({"order": "both"}, "order"),
        ({"parts": {}}, "nothing to couple"),
        ({"parts": {"a.b": integrator()}}, "without a dot"),
    ],
)
def test_a_coupling_that_does_not_fit_is_refused(change: dict[str, Any], words: str) -> None:
    options: dict[str, Any] = {
        "parts": {"plant": integrator(), "law": gain(-1.0)},
        "connections": [("plant.y0", "law.u0"), ("law.y0", "plant.u0")],
        "outputs": ["plant.y0"],
    } | change
    with pytest.raises(InputError, match=words):
        Coupled(options.pop("parts"), options.pop("connections"), **options)


def test_strong_coupling_needs_parts_that_go_back() -> None:
    with pytest.raises(InputError, match=r"rollback.*x without it"):
        Coupled(
            {"x": integrator(snapshots=False)}, [("p", "x.u0")], inputs={"p": "x.u0"}, outputs=["x.y0"], iterations=2
        )


def test_initial_states_are_named_by_part_and_all_parts_are_closed() -> None:
    parts: dict[str, Linear] = {"x": integrator(), "v": integrator()}
    make: Callable[[], Coupled] = lambda: Coupled(  # noqa: E731
        parts, [("x.y0", "v.u0"), ("v.y0", "x.u0")], outputs=["x.y0", "v.y0"]
    )
    with make() as both:
        assert both.reset(rng=RNG, x0={"v.x0": 3.0}).tolist() == [0.0, 3.0]
        assert [c.name for c in both.spec.states] == ["x.x0", "v.x0"]
        with pytest.raises(InputError, match="initial state"):
            both.reset(rng=RNG, x0={"w.x0": 3.0})
    assert parts["x"].closed == parts["v"].closed == 1


def test_divergence_names_the_part() -> None:
    bad = Coupled({"x": Linear(0.0, 1.0, np.inf, x0=[1.0])}, [("p", "x.u0")], inputs={"p": "x.u0"}, outputs=["x.y0"])
    with pytest.raises(PlantError, match=r"part 'x'.*t = 0.1 s") as caught:
        bad.step(np.array([0.0]))
    assert caught.value.status == "diverged"


class Echo(Linear):
    """Shows its inputs of the step before: y0 = u0, y1 = u1, ..., in the unit of its inputs."""

    def __init__(self, count: int, unit: str) -> None:
        super().__init__(np.zeros((count, count)), np.eye(count), np.eye(count), units=(unit, unit))
        self.a, self.b = np.zeros((count, count)), np.eye(count)


def test_wires_that_add_up_keep_their_offset_too() -> None:
    # a target is driven by two sources: 300 K and 10 K, each converted on its own wire
    parts = {"room": Echo(2, "K"), "sum": Echo(2, "degC")}
    rooms = {f"room{i}": f"room.u{i}" for i in range(2)}
    wires = [Connection(name, target) for name, target in rooms.items()]
    wires += [
        Connection("room.y0", "sum.u0", add=True),
        Connection("room.y1", "sum.u0", add=True),
        Connection("room.y1", "sum.u1"),
    ]
    with Coupled(parts, wires, inputs=rooms, outputs=["sum.y0", "sum.y1"]) as plant:
        plant.reset(rng=RNG)
        for _ in range(3):
            y = plant.step(np.array([300.0, 10.0]))
    assert y == pytest.approx([26.85 - 263.15, -263.15])


@pytest.mark.parametrize("unit", ["degC", "degF", "K"])
@pytest.mark.parametrize("order", ["gauss-seidel", "jacobi"])
@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("count", [1, 2])
def test_temperatures_keep_their_offset_on_a_wire(unit: str, order: Any, delay: int, count: int) -> None:
    # room [K], external -> first (K) -> second (degC or degF): 300 K must arrive as 26.85 degC
    parts = {"first": Echo(count, "K"), "second": Echo(count, unit)}
    rooms = {f"room{i}": f"first.u{i}" for i in range(count)}
    wires = [Connection(name, target) for name, target in rooms.items()]
    wires += [Connection(f"first.y{i}", f"second.u{i}", delay=delay) for i in range(count)]
    with Coupled(parts, wires, inputs=rooms, outputs=["second.y0"], order=order) as plant:
        plant.reset(rng=RNG)
        for _ in range(4):
            y = plant.step(np.full(count, 300.0))
    assert y == pytest.approx({"degC": [26.85], "degF": [80.33], "K": [300.0]}[unit])


def test_a_snapshot_between_the_samples_of_a_slow_part_keeps_what_it_holds() -> None:
    both = Coupled(
        {"slow": integrator(dt=0.3), "fast": integrator(dt=0.1)},
        [("push", "slow.u0"), ("slow.y0", "fast.u0")],
        inputs={"push": "slow.u0"},
        outputs=["slow.y0", "fast.y0"],
    )
    both.reset(rng=RNG)
    both.step(np.array([1.0]))  # the slow part holds 1 until 0.3 s
    kept = both.get_state()
    first = [both.step(np.array([u])) for u in (7.0, 7.0, 2.0, 2.0)]
    both.set_state(kept)
    again = [both.step(np.array([u])) for u in (7.0, 7.0, 2.0, 2.0)]
    np.testing.assert_array_equal(first, again)
    assert first[1][0] == pytest.approx(0.3)


def test_a_slow_static_part_answers_at_its_own_samples_only() -> None:
    both = Coupled(
        {"slow": gain(2.0, dt=0.2), "clock": integrator(dt=0.1)},
        [("push", "slow.u0"), ("push", "clock.u0")],
        inputs={"push": "slow.u0"},
        outputs=["slow.y0"],
    )
    both.reset(rng=RNG)
    got = [float(both.output(np.array([1.0]))[0])]
    both.step(np.array([1.0]))
    got.append(float(both.output(np.array([5.0]))[0]))  # between its samples
    both.step(np.array([5.0]))
    got.append(float(both.output(np.array([3.0]))[0]))
    assert got == [2.0, 2.0, 6.0]


def test_delayed_wires_beside_several_inputs_each_carry_their_own_signal() -> None:
    """Each delayed wire has a place behind the parts' outputs and all inputs."""
    lags = {"a": 1, "b": 2, "c": 3}
    coupled = Coupled(
        {name: gain(1.0) for name in lags},
        [Connection(f"p{name}", f"{name}.u0", delay=lag) for name, lag in lags.items()],
        inputs={f"p{name}": f"{name}.u0" for name in lags},
        outputs=[f"{name}.y0" for name in lags],
        loops="refuse",
    )
    u = RNG.normal(size=(8, 3))
    coupled.reset(rng=np.random.default_rng(0))
    seen = []
    for row in u:
        seen.append(coupled.output(row))
        coupled.step(row)
    for place, lag in enumerate(lags.values()):
        assert np.array(seen)[lag:, place] == pytest.approx(u[:-lag, place]), f"delay of {lag}"


@pytest.mark.parametrize(("unit", "expected"), [("K", 302.5), ("degC", 575.65)])
def test_an_offset_of_a_wire_is_added_in_si(unit: str, expected: float) -> None:
    wire = Connection("push", "law.u0", gain=1.0, offset=2.5)
    law = gain(1.0, units=("K", "K"))
    coupled = Coupled({"law": law}, [wire], inputs={"push": Channel("push", unit)}, outputs=["law.y0"], loops="refuse")
    coupled.reset(rng=np.random.default_rng(0))
    assert coupled.output(np.array([300.0])) == pytest.approx(expected)


def test_a_coupling_shows_its_own_inputs_beside_its_outputs() -> None:
    line = Coupled(
        {"law": gain(3.0), "held": integrator(x0=[5.0])},
        [Connection("pull", "held.u0"), Connection("push", "law.u0")],
        inputs={"pull": "held.u0", "push": "law.u0"},
        outputs=[ShownOutput("push", Channel("push")), "law.y0", ShownOutput("pull", Channel("pull")), "held.y0"],
    )
    line.reset(rng=RNG)
    assert line.output(np.array([2.0, 7.0])) == pytest.approx([7.0, 21.0, 2.0, 5.0])
    assert line.spec.feedthrough


def test_a_delayed_wire_between_parts_breaks_their_loop() -> None:
    def ring(delay: int) -> Coupled:
        return Coupled(
            {"a": gain(0.5), "b": gain(1.0)},
            [
                Connection("a.y0", "b.u0", delay=delay),
                Connection("b.y0", "a.u0", add=True),
                Connection("push", "a.u0", add=True),
            ],
            inputs={"push": "a.u0"},
            outputs=["a.y0"],
            loops="refuse",
        )

    with pytest.raises(InputError, match="algebraic loop"):
        ring(0)
    line = ring(1)
    assert line.reset(rng=RNG) == 0.0
    got = [float(line.output(np.ones(1))[0])]
    for _ in range(3):
        line.step(np.ones(1))
        got.append(float(line.output(np.ones(1))[0]))
    assert got == pytest.approx([0.5, 0.75, 0.875, 0.9375])  # each answer comes back a step later, halved
