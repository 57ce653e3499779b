"""Balance while parameters are learned: cheaper and from more starts than with what is believed."""

from __future__ import annotations

import numpy as np
import pytest

from harness import api
from harness.errors import InputError

ACROBOT = {
    "model": "acrobot",
    "believed": {"lc1": 0.4, "lc2": 1.1, "I1": 0.1, "I2": 0.3},
    "target": {"theta1": float(np.pi)},
    "lean": "theta1",
    "start": 0.03,
    "q": [10.0, 10.0, 1.0, 1.0],
    "noise": 1e-4,
    "duration": 3.0,
}
CART = {
    "believed": {"mc": 0.3, "mp": 0.6, "l": 1.2},
    "target": {"theta": float(np.pi)},
    "q": [10.0, 10.0, 1.0, 1.0],
    "start": 0.2,
    "leans": [0.2],
    "shares": [0.0, 1.0],
}


def test_the_acrobot_falls_with_what_is_believed_and_stands_while_it_learns():
    found = api.analyse(
        "adaptive-balance", "ode", subject_options={"model": "acrobot", "sample_time": 0.01},
        options={**ACROBOT, "leans": [0.01, 0.06], "shares": [0.0, 1.0]},
    )  # fmt: skip
    assert found.details["stays"] == {"fixed": False, "adaptive": True, "informed": True}
    assert found.details["costs"]["adaptive"] < 2.0 * found.details["costs"]["informed"]
    off = {row["controller"]: (row["parameters off at first"], row["at last"]) for row in found.rows}
    assert off["adaptive"][1] < 0.7 * off["adaptive"][0]
    assert off["fixed"][1] == off["fixed"][0]
    maps = found.details["maps"]
    assert maps["adaptive"] == [[True, True], [True, True]]
    assert maps["fixed"][0][0]
    assert not maps["fixed"][0][1]
    assert not maps["fixed"][1][1]


def test_a_cart_pole_that_learns_is_balanced_and_moved_for_less():
    found = api.analyse(
        "adaptive-balance", "cart-pole-ode", subject_options={"sample_time": 0.02},
        options={**CART, "move": {"x": 0.5}}, seed=0,
    )  # fmt: skip
    costs = found.details["costs"]
    assert costs["informed"] <= costs["adaptive"] < 0.5 * costs["fixed"]
    assert costs["adaptive"] < 1.2 * costs["informed"]
    states = np.array(found.details["states"]["adaptive"])
    assert abs(states[-1, 0] - 0.5) < 0.1, "the cart has moved"


def test_with_the_true_parameters_nothing_is_lost_by_learning():
    same = {"mc": 1.0, "mp": 0.2, "l": 0.5}
    found = api.analyse(
        "adaptive-balance", "cart-pole-ode", subject_options={"sample_time": 0.02}, options={**CART, "believed": same}
    )
    costs = found.details["costs"]
    assert costs["fixed"] == pytest.approx(costs["informed"])
    assert costs["adaptive"] < 1.1 * costs["informed"]
    assert [axes.get_title() for axes in found.plot().axes][:3] == [
        "from one start", "what is learned", "what stays up"
    ]  # fmt: skip


def test_what_is_believed_has_to_be_said_and_known():
    with pytest.raises(InputError, match="say what is believed"):
        api.analyse("adaptive-balance", "cart-pole-ode")
    with pytest.raises(InputError, match="model and plant"):
        api.analyse("adaptive-balance", "cart-pole-ode", options={**CART, "believed": {"weight": 2.0}})
