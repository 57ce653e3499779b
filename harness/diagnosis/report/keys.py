"""The keys of ``report.json``, the same for every kind of model, and the groups of the numbers that decided."""

from __future__ import annotations

from typing import Any

from harness import __version__
from harness.data.oddities import described as odd_numbers
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.number import described
from harness.diagnosis.policy import ARM_POLICY, DATA_POLICY, PLAN_POLICY, RUN_POLICY, Policy

FORMAT = "sysid-harness/close-loop/2"


def blank() -> dict[str, Any]:
    """Return every key of ``report.json`` with what it holds where it does not apply."""
    return {
        "format": FORMAT,
        "version": __version__,
        "dataset": "",
        "model": "",
        "verdict": "",
        "adequacy": "",
        "explained_share": None,
        "misfit": [],
        "stand_in": {"flagged": False, "reasons": []},
        "summary": "",
        "effects": [],
        "searched": [],
        "tie_sets": [],
        "separating_experiments": [],
        "separate_with": [],
        "recorded": {},
        "errors": {when: {"equation_error": {}, "simulation_error": {}, "one_step": {}, "log_likelihood": {}}
                   for when in ("before", "after")},
        "parameters": {"before": {}, "after": {}},
        "ratios": {},
        "noise": {when: {"sensors": {}, "forces": {}} for when in ("before", "after")},
        "candidates": [],
        "withdrawn": [],
        "left_over": [],
        "tests": {"before": {}, "after": {}},
        "isolability": {"effects": [], "cosine": []},
        "not_visible": [],
        "closed_loop": {},
        "closed_loop_bias": {"test": "Durbin-Wu-Hausman", "text": "not tested", "p": None, "statistic": None},
        "horizon": {"seconds": None, "reason": ""},
        "form": "",
        "converged": {"nominal": None, "final": None},
        "intervals": {"hold": False, "meaning": ""},
        "joints": [],
        "inertia": "",
        "inertial_parameters": None,
        "policy": {},
        "dictionary": "",
        "alarms": [],
        "far_from_declared": [],
        "oddities": [],
        "warnings": [],
        "seconds": 0.0,
    }  # fmt: skip


def numbers(policy: Policy) -> dict[str, dict[str, Any]]:
    """Return every deciding number by group."""
    return {
        "policy": described(policy),
        "effort": described(EFFORT),
        "data": described(DATA_POLICY),
        "run": described(RUN_POLICY),
        "plan": described(PLAN_POLICY),
        "arm": described(ARM_POLICY),
        "odd": odd_numbers(),
    }
