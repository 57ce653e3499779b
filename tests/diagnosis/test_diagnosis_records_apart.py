"""Laws that are fast for the sampling, and records that ask more of a model than those it was fitted to."""

from __future__ import annotations

import numpy as np
import pytest
from sysid_lab.plan import Task
from sysid_lab.records import Records, make_records

from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.diagnosis import Diagnosis
from harness.effects import builtin
from harness.effects.compose import compose, moving, recommended_substeps
from harness.effects.effect import Placed
from harness.physics import load_model

USED = 140_000
"""The base of records that were looked at while this was written."""


def closed(key: str, *names: str) -> tuple[Records, Diagnosis]:
    """Return a record of the study and its diagnosis with some effects of the dictionary."""
    study, plant, engine, effect, level, noise, disturbance, index = key.split("|")
    task = Task(study, plant, engine, (effect,), level, noise, float(disturbance), int(index), USED)
    records = make_records(task)
    return records, diagnose(records.dataset, load_model(task.plant), dictionary=[builtin()[name] for name in names])


@pytest.mark.slow
def test_a_law_that_leaves_one_record_no_force_is_not_refused_for_a_record_that_amplifies_small_errors() -> None:
    records, found = closed("confusion|cart-pole|laws|end_stop@theta|quarter|low|0|0", "end_stop", "cubic_spring")
    assert [str(one.placed) for one in found.outcome.accepted] == ["end_stop@theta"]
    truth = records.hidden[0].named
    assert found.final.values["end_stop@theta.stop"] == pytest.approx(truth["stop"], rel=1e-3)
    assert found.final.values["end_stop@theta.k"] == pytest.approx(truth["k"], rel=0.02)
    estimation, validation = (found.final.detail.points[use].noise for use in ("estimation", "validation"))
    assert (estimation.s + estimation.w < validation.s + validation.w).any()


@pytest.mark.slow
def test_friction_that_slips_within_one_sample_is_named_by_its_law() -> None:
    """Dahl's law is in the dictionary twice: bristles without damping, and hysteresis where beta is 1.

    How it bends within a sample, beta, is not told: rounding decides between 0.84 and 1.
    """
    records, found = closed(
        "confusion|cart-pole|hardware|coulomb_friction@theta|quarter|high|0|0",
        "coulomb_friction", "hysteresis", "lugre_coulomb_friction",
    )  # fmt: skip
    (effect,) = found.outcome.accepted
    law, values, truth = str(effect.placed), found.final.values, records.hidden[0].named
    assert law in ("hysteresis@theta", "lugre_coulomb_friction@theta")
    level = "Fh" if law.startswith("hysteresis") else "Fc"
    assert values[f"{law}.{level}"] == pytest.approx(truth["Fc"], rel=0.01)
    assert values[f"{law}.xs"] == pytest.approx(truth["xs"], rel=0.1)
    after = np.concatenate(found.runs.after.validation)
    assert np.sqrt(np.mean(after**2)) < 1.02  # the sensor noise


def test_what_slips_is_simulated_with_steps_for_its_speed() -> None:
    law = {"Fh": 0.1, "xs": 1e-3, "beta": 1.0, "T": 0.0}
    system = compose(load_model("pendulum"), [Placed(builtin()["hysteresis"], "theta", law)])
    x = moving(system, {"theta": {"v": 2.0}, "u": {"u": 1.0}})
    assert x.tolist() == [0.0, 6.0, 0.0]
    assert recommended_substeps(system, None, 0.004) < 3
    # z' = (v - |v| z)/xs has the eigenvalue 6/1e-3 1/s
    assert recommended_substeps(system, None, 0.004, x=x) == int(np.ceil(6.0 / 1e-3 * 0.004 / 2.5))
