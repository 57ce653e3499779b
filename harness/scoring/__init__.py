"""Scores: equation error, simulation error, regret of online identifiers, and what a model is worth for control."""

from harness.scoring.bound import LeastErrors, LinearTruth, least_errors, linear_truth
from harness.scoring.control import ControlRegret, ControlScore, control_regret, control_score, linearise
from harness.scoring.prediction import (
    Score,
    equation_error,
    errors,
    free_run,
    predict,
    same_language,
    simulation_error,
    states_ahead,
)
from harness.scoring.regret import Regret, regret
from harness.scoring.rounds import RedesignRound, interleaved
from harness.scoring.torques import TorqueError, Torques

__all__ = [
    "ControlRegret",
    "ControlScore",
    "LeastErrors",
    "LinearTruth",
    "RedesignRound",
    "Regret",
    "Score",
    "TorqueError",
    "Torques",
    "control_regret",
    "control_score",
    "equation_error",
    "errors",
    "free_run",
    "interleaved",
    "least_errors",
    "linear_truth",
    "linearise",
    "predict",
    "regret",
    "same_language",
    "simulation_error",
    "states_ahead",
]
