"""Public check lists that hold plants, identifiers, scenarios, effects and models to their contracts.

``sysid check NAME`` runs them on a registered part, ``sysid check FILE.py:NAME`` on one that is being written; tests
call ``check_identifier(MyIdentifier)`` and the like, or parametrize over ``identifier_checks()``.
"""

from __future__ import annotations

from harness.conformance.dispatch import check
from harness.conformance.grey_boxes import check_effect, check_model, effect_checks, model_checks
from harness.conformance.identifiers import check_identifier, identifier_checks
from harness.conformance.online import check_online_identifier, online_checks
from harness.conformance.plants import check_plant, plant_checks
from harness.conformance.results import Broken, Check, CheckResult, NotApplicable, demand, run_checks
from harness.conformance.scenarios import check_scenario, scenario_checks

__all__ = [
    "Broken",
    "Check",
    "CheckResult",
    "NotApplicable",
    "check",
    "check_effect",
    "check_identifier",
    "check_model",
    "check_online_identifier",
    "check_plant",
    "check_scenario",
    "demand",
    "effect_checks",
    "identifier_checks",
    "model_checks",
    "online_checks",
    "plant_checks",
    "run_checks",
    "scenario_checks",
]
