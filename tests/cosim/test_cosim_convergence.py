"""Halving the communication step: changes that shrink at the order of the method, and runs that cannot be compared."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness import api
from harness.cosim.convergence import Convergence, halved
from harness.errors import InputError
from harness.signals import Channel, PlantSpec, Trajectory

LOOP = """
sample_time = 0.1
connections = [
  { from = "arm.theta", to = "law.y" },
  { from = "law.u", to = "arm.u", gain_unit = "N m" },
  { from = "wish", to = "law.r" },
]
outputs = ["arm.theta"]
initial = { "arm.theta" = 0.5 }
[parts.arm]
mockup = "pendulum"
[parts.law]
mockup = "pi_controller"
options = { parameters = { Kp = 0.5 } }
"""


@given(order=st.sampled_from([1, 2, 4]), rate=st.floats(0.5, 3.0), times=st.integers(2, 5))
def test_the_order_of_a_known_error_is_found(order: int, rate: float, times: int) -> None:
    def run(step: float | None) -> Trajectory:
        h = 0.1 if step is None else step
        t = h * np.arange(round(1 / h) + 1)
        y = np.column_stack([np.exp(-rate * t) + h**order * t, np.ones_like(t)])
        return Trajectory(t, np.zeros((len(t), 0)), y, PlantSpec((), (Channel("x"), Channel("rests")), h))

    found = halved(run, times)
    assert found.steps == pytest.approx(0.1 * 0.5 ** np.arange(times + 1))
    assert found.orders[:, 0] == pytest.approx(order, abs=1e-3)
    assert np.isnan(found.orders[:, 1]).all()
    assert found.changes[0, 0] == pytest.approx(0.1**order * (1 - 0.5**order), rel=1e-6)


def test_a_coupling_settles_at_first_order(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    path = tmp_path / "loop.toml"
    path.write_text(LOOP.replace("outputs =", 'inputs = { wish = "law.r" }\noutputs ='))
    found = api.halve(str(path), times=4, stop=1.0, step=0.1, exchange="jacobi")
    assert found.orders[-1, 0] == pytest.approx(1.0, abs=0.15)
    arguments = ["--stop", "1", "--step", "0.1", "--halve", "2", "-o", tmp_path / "run.csv"]
    assert "arm.theta" in sysid("simulate", path, *arguments).out
    assert len((tmp_path / "run.csv").read_text().splitlines()) == 42


def test_what_cannot_be_halved_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="1 to 20 times"):
        api.halve("pendulum-ode", times=0)
    with pytest.raises(InputError, match="no scenario"):
        api.halve("pendulum-ode", times=1)


def test_the_picture_shows_the_outputs_that_change() -> None:
    found = Convergence(
        steps=np.array([0.1, 0.05, 0.025]),
        outputs=("$x$", "rests"),
        changes=np.array([[0.1, 0.0], [0.05, 0.0]]),
        ranges=np.array([1.0, 0.0]),
        finest=None,  # type: ignore[arg-type]
    )
    axes = found.figure().axes[0]
    labels = [line.get_label() for line in axes.lines]
    assert labels == ["$x$", "order 1", "order 2"]
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [0.1, 0.05])
