"""Free runs that err far more on the validation records than on the others: no green word, and a second look."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import api
from harness.diagnosis.runs.compare import FreeRuns
from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.physics.models import pendulum
from harness.signals import FloatArray


def test_the_worst_output_says_how_much_further() -> None:
    rng = np.random.default_rng(0)
    errors = [rng.standard_normal((4000, 2)) * size for size in ([1.0, 2.0], [1.1, 12.0])]
    after: Any = SimpleNamespace(finite=True, estimation=(errors[0][:1500], errors[0][1500:]), validation=(errors[1],))
    found = FreeRuns(cast(Any, None), cast(Any, None), None, after, 0.0, 0.0, np.ones(2), np.zeros(2), 0)
    assert found.further == pytest.approx(6.0, rel=0.05)
    lost: Any = SimpleNamespace(finite=False)
    none = cast(Any, None)
    assert FreeRuns(none, none, None, lost, 0.0, 0.0, np.ones(2), np.zeros(2), None).further == np.inf


@pytest.mark.slow
@given(seed=st.integers(0, 1000))
@settings(max_examples=1, deadline=None)
def test_two_laws_that_pass_for_damping_at_large_swings_are_seen_in_free_runs(seed: int) -> None:
    """Dry friction and drag together look like viscous damping until the swing is smaller."""
    laws = builtin()
    friction = Placed(laws["coulomb_friction"], "theta", {"Fc": 0.0541, "w": 0.005})
    true = compose(pendulum().system(), [friction, Placed(laws["quadratic_drag"], "theta", {"c": 0.005})])
    p, t = true.vector({"J": 1.0, "b": 0.0, "mgl": 33.3}), np.arange(4000) * 0.01

    def swing(begin: float, draw: int) -> dict[str, FloatArray]:
        y = true.simulator(0.01).rollout(p, [begin, 0.0], np.zeros((t.size, 1)))[:, 0]
        return {"t [s]": t, "theta [rad]": y + 1e-3 * np.random.default_rng(draw).standard_normal(t.size)}

    report = api.close_loop(swing(0.97, seed), model="pendulum", validation=swing(0.5, seed + 1), undriven=["u"])
    assert report.verdict == "effects_found"
    assert any("friction" in one["name"] for one in report.data["effects"])
    errors = [
        report.data["errors"][when]["simulation_error"]["validation"]["theta"]["rms"] for when in ("before", "after")
    ]
    assert errors[1] < 0.5 * errors[0]
