"""Play in a drive: found from wherever the dictionary starts, in records of other laws than the dictionary's."""

from __future__ import annotations

import pytest
from sysid_lab.plan import Task
from sysid_lab.records import make_records

from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.dictionary import laws_of
from harness.diagnosis.kinds import EquationsKind
from harness.diagnosis.policy import POLICY
from harness.diagnosis.records.prepare import checked
from harness.diagnosis.steps import candidates_of, form_of, nominal_fit
from harness.physics import load_model

pytestmark = pytest.mark.slow  # whole loops


DROOPING = Task("confusion", "cart-pole", "hardware", ("backlash@x",), "nominal", "low", 0.0, 0, 0,
                structure="drooping-drive")  # fmt: skip


def task(engine: str, level: str, noise: str, disturbance: float, index: int) -> Task:
    return Task("confusion", "pendulum", engine, ("backlash@theta",), level, noise, disturbance, index, 0)


def test_play_is_found_from_every_start() -> None:
    """With sharp flanks a fit ended where it began, or at elasticity alone (26 209 of 27 083)."""
    records = make_records(task("laws", "nominal", "high", 0.02, 20))
    system = load_model("pendulum")
    dataset, doubts = EquationsKind().prepared(checked(records.dataset, system), system)
    form, _ = form_of(EquationsKind(), system, dataset, POLICY, laws_of().dictionary)
    nominal = nominal_fit(form, form, doubts)  # type: ignore[arg-type]
    candidates, _ = candidates_of(form, laws_of())
    play = next(one for one in candidates if str(one) == "backlash@theta")
    (suspect,) = form.suspects(nominal, None, [play])
    for start in suspect.starts:
        fit = form.fit([play], [{**nominal.values, **start}], nominal)
        assert fit is not None
        assert fit.converged
        assert fit.log_likelihood("estimation") > nominal.log_likelihood("estimation") + 900
        assert fit.values["backlash@theta.gap"] == pytest.approx(records.known[0].named["gap"], rel=0.1)


@pytest.mark.parametrize(
    ("row", "name"),
    [
        (("laws", "nominal", "high", 0.02, 20), "backlash@theta"),
        (("hardware", "nominal", "high", 0.0, 2), "unilateral_backlash@theta"),  # its flanks never pull
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_play_is_named_and_not_the_elasticity_that_it_contains(
    row: tuple[str, str, str, float, int], name: str
) -> None:
    diagnosis = diagnose(make_records(task(*row)).dataset, load_model("pendulum"))
    assert [str(one.placed) for one in diagnosis.outcome.accepted] == [name]
    assert diagnosis.grade == "explained"


def test_flanks_that_part_beside_a_drooping_drive_are_no_play_with_a_dead_zone() -> None:
    """From the play that pulls as well the fit ended below it, with 1400 in log-likelihood still to gain."""
    diagnosis = diagnose(make_records(DROOPING).dataset, load_model("cart-pole"))
    assert [str(one.placed) for one in diagnosis.outcome.accepted] == ["unilateral_backlash@x"]


def test_a_joint_that_hardens_is_tied_with_a_play() -> None:
    hidden = Task("confusion", "pendulum", "hardware", ("elasticity@theta",), "nominal", "high", 0.0, 0, 0)
    diagnosis = diagnose(make_records(hidden).dataset, load_model("pendulum"))
    (found,) = diagnosis.outcome.accepted
    assert {str(one) for member in found.tie for one in member} >= {"hardening_elasticity@theta"}
