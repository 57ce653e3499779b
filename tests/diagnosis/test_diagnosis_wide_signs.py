"""Initial states beside a force whose sign changes sooner than a step of the solver."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis.records.prepare import sizes_of
from harness.diagnosis.runs.form import FreeRunForm
from harness.effects import builtin, compose
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.physics.fitting.levenberg import minimise_states
from harness.signals import Dataset, PlantSpec, Run, Trajectory

FRICTION = Placed(builtin()["coulomb_friction"], "theta")


@pytest.mark.parametrize("seed", [5, 6, 7, 9])
def test_a_swing_with_dry_friction_is_begun_where_its_error_is_least(seed: int) -> None:
    """Derivatives by initial states that tell of single steps alone led a search astray, and it ended there."""
    nominal, dt, rng = load_model("pendulum"), 0.05, np.random.default_rng(seed)
    plant = compose(nominal, [FRICTION])
    known = {"J": 0.1, "mgl": 1.0, "b": 0.002, FRICTION.name("Fc"): 0.03, FRICTION.name("w"): rng.uniform(2e-4, 1e-3)}
    x = plant.simulator(dt / 50).states(
        plant.vector(known), np.array([rng.uniform(0.8, 1.4), rng.uniform(-1, 1)]), np.zeros((10_000, 1))
    )[::50]
    y = x[:, :1] + 1e-3 * rng.standard_normal((len(x), 1))
    record = Trajectory(
        np.arange(len(y)) * dt, np.zeros((len(y), 1)), y, PlantSpec(nominal.inputs, nominal.outputs, dt)
    )
    data = Dataset("swing", (Run(record), Run(record, "validation")))
    sizes = sizes_of(nominal, nominal.values(), data)
    form = FreeRunForm(nominal, data, sizes=sizes, horizon=None, weights=np.array([1e-3]))
    system = form.system([FRICTION])
    p = system.vector({**known, "mgl": 1.005})  # a fit that errs, as in the middle of a search
    windows = form.windows(system, p, "validation")
    start = windows.starts_from([form.from_data(windows.simulator, run, p)[0] for run in form.records["validation"]])
    least = minimise_states(windows, p, x[:1], 60)
    cost = {
        name: float(windows.trial(p, states).costs[0])
        for name, states in {"least": least, "found": form.fit_states(windows, p, start, 25)}.items()
    }
    assert cost["found"] < 1.001 * cost["least"]
