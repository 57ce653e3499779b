"""Which links have other masses: the set is found by exchange over subsets, where one at a time ends elsewhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.diagnosis.arm.links import Elements, settled
from harness.signals import FloatArray


def elements(columns: FloatArray, wanted: FloatArray, alone: tuple[str, ...] = ()) -> Elements:
    """Return single columns a, b, c, ... of one price."""
    count = columns.shape[1]
    names = "abcdefgh"[:count]
    low, high = np.full(count, -1.0), np.full(count, 2.0)
    places = {name: [k] for k, name in enumerate(names)}
    prices = dict.fromkeys(names, 8.0)
    return Elements(columns.T @ columns, columns.T @ wanted, places, low, high, prices, frozenset(alone))


def found(given: Elements, *starts: str, tie: float = 3.0) -> str:
    return "".join(sorted(settled(given, [frozenset(one) for one in starts], tie)[0]))


def hidden() -> tuple[FloatArray, FloatArray]:
    """Return three columns of which the third is nearly the sum of the others, and what the first two make."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 400))
    c = a + b + 0.3 * rng.normal(size=400)
    return np.stack([a, b, c], axis=1), a + b + 0.05 * rng.normal(size=400)


def test_two_links_are_found_where_a_third_looks_like_both() -> None:
    columns, wanted = hidden()
    one_by_one = max("abc", key=lambda name: elements(columns, wanted).value(frozenset(name)))
    assert one_by_one == "c", "the first that is added is the wrong one"
    assert found(elements(10 * columns, 10 * wanted), "c", "abc", "") == "ab"


def test_bounds_hold_and_what_does_as_well_leaves_the_first_answer() -> None:
    columns, _ = hidden()
    given = elements(10 * columns[:, :1], 10 * -3.0 * columns[:, 0])
    at_bound = 100 * float(columns[:, 0] @ columns[:, 0]) * (3.0 - 0.5)
    assert given.value(frozenset("a")) == pytest.approx(at_bound - 8.0), "the coefficient stays at its bound, -1"
    twice = np.repeat(columns[:, :1], 2, axis=1)
    for start in ("a", "b"):
        assert found(elements(10 * twice, 10 * columns[:, 0]), start) == start


def test_what_is_one_body_is_never_named_twice() -> None:
    columns, wanted = hidden()
    given = elements(10 * columns, 10 * wanted, ("a", "b"))
    for starts in (("ab", "abc"), ("ab",), ("", "abc")):
        assert not {"a", "b"} <= set(found(given, *starts))


@pytest.mark.slow
@pytest.mark.parametrize("links", [{1: 0.737, 4: 0.421, 6: 2.472}, {0: 1.8, 3: 2.0, 5: 0.42}], ids=["2 5 7", "1 4 6"])
def test_all_wrong_links_of_a_urdf_are_named_and_nothing_else(tmp_path: Path, links: dict[int, float]) -> None:
    pytest.importorskip("pybullet_data", reason="the URDF of the iiwa comes with pybullet")
    from harness.diagnosis.close import close_loop
    from harness.physics.arms.arm import load_arm
    from harness.physics.arms.urdf_write import urdf_with
    from harness.signals import Dataset, PlantSpec, Run, Trajectory

    dt, t = 0.005, 0.005 * np.arange(2000)
    arm, rng, runs = load_arm("iiwa"), np.random.default_rng(4), []
    for use in ("estimation", "validation"):
        phases = rng.uniform(0, 6, 7)
        q = 0.5 * np.sin(2 * np.pi * np.linspace(0.3, 0.6, 7) * t[:, None] + phases)
        q += 0.2 * np.sin(2 * np.pi * np.linspace(0.5, 0.2, 7) * t[:, None] + 2 * phases)
        v = np.gradient(q, dt, axis=0)
        u = arm.torques(q, v, np.gradient(v, dt, axis=0)) + arm.damped(v) + 0.05 * rng.standard_normal(q.shape)
        spec = PlantSpec(arm.inputs, arm.outputs, dt)
        runs.append(Run(Trajectory(t, u, q + 1e-5 * rng.standard_normal(q.shape), spec), use))  # type: ignore[arg-type]
    bodies = arm.arm.parameters.reshape(-1, 10).copy()
    for link, factor in links.items():
        bodies[list(arm.links)[link - 7]] *= factor
    path = tmp_path / "other.urdf"
    path.write_text(urdf_with(arm, bodies.ravel()))
    report = close_loop(Dataset("iiwa", tuple(runs)), load_arm(path))
    named = {effect["name"] + effect["at"][-2:] for effect in report.data["effects"]}
    assert named == {f"link_mass_{link + 1}" for link in links}
