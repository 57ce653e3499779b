"""Scores: equation error, simulation error, regret of online identifiers, and what a model is worth for control."""

from harness.scoring.control import ControlScore, control_score, linearise
from harness.scoring.prediction import (
    Score,
    equation_error,
    errors,
    predict,
    same_language,
    simulation_error,
    states_ahead,
)
from harness.scoring.regret import Regret, regret

__all__ = [
    "ControlScore",
    "Regret",
    "Score",
    "control_score",
    "equation_error",
    "errors",
    "linearise",
    "predict",
    "regret",
    "same_language",
    "simulation_error",
    "states_ahead",
]
