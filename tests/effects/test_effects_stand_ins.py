"""What keeps a law of free shape from standing in for a simpler one: bounds from the data, and declared limits."""

from __future__ import annotations

import pytest

from harness.effects import builtin
from harness.effects.dictionary import Dictionary


def test_an_end_stop_is_no_softer_than_the_plant_itself() -> None:
    stiffness = builtin()["end_stop"].parameter("k")
    sizes = {"F": 0.06, "q": 0.05}
    assert stiffness.start(sizes) == pytest.approx(12.0)
    assert stiffness.lowest(sizes, stiffness.start(sizes)) == pytest.approx(1.2)
    assert stiffness.lowest(sizes, 0.5) == pytest.approx(0.5)  # a value that was given stands
    assert stiffness.lowest({}, 12.0) == 0.0


def test_cogging_must_turn_a_quarter_of_a_period_over_the_travel() -> None:
    waves = builtin()["cogging"].parameter("k")
    assert waves.start({"q": 0.8}) == 6.0
    assert waves.lowest({"q": 0.8}, 6.0) == 2.5
    assert waves.start({"q": 0.05}) == pytest.approx(11.2)
    assert min(waves.starts({"q": 0.05})) == pytest.approx(11.2)
    assert waves.lowest({"q": 0.05}, waves.start({"q": 0.05})) == pytest.approx(11.2)
    assert waves.start({"q": 1e-6}) == 1000.0


def test_cogging_is_compared_with_the_springs_that_it_imitates() -> None:
    found = Dictionary.builtin().family(builtin()["cogging"])
    assert {"cubic_spring", "quadratic_spring", "eccentric_load"} <= {*found.near}
    assert {"cubic_spring", "quadratic_spring"} <= found.limit.keys()
    assert "cogging" in Dictionary.builtin().family(builtin()["cubic_spring"]).near
