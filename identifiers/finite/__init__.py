"""Finite processes: counting, factored transitions, hidden Markov models, beliefs, bisimulation.

May import ``identifiers.common``. Add a method as one file, its entry point in ``pyproject.toml``.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "BeliefLadder": "smaller",
    "Bisimulation": "smaller",
    "FactoredCounting": "factored",
    "HiddenMarkov": "hmm",
    "InformationStates": "information_states",
    "MdpCounting": "mdp",
    "Occupation": "occupation",
    "OnlineCounting": "mdp",
    "action_sufficient": "decision",
    "bisimulation_metric": "bisimulation",
    "information_gap": "bisimulation",
    "policy_values": "decision",
    "value_error_bound": "decision",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
