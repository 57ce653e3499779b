"""The bodies of an arm whose inertial parameters are free: the ones its log asks for that mass can make.

The searches leave directions of the inertial parameters free, as nuisance. What they come to is no answer: bodies are
estimated as everywhere in this project (:mod:`harness.physics.arms.inertial_fit`), by log-Cholesky coordinates of the
pseudo-inertia beside the entropic prior of the URDF, from the same rows with the same coloured errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.diagnosis.arm.joint import CLOCK, JointRegression
from harness.diagnosis.arm.motion import ArmRun
from harness.diagnosis.arm.regression import RegressionForm, regression_detail
from harness.diagnosis.arm.rotor import ROTOR
from harness.diagnosis.arm.wide import WideResult
from harness.diagnosis.arm.wide_regression import WideRegression
from harness.diagnosis.policy import ARM_POLICY
from harness.diagnosis.search.fit import Fit
from harness.errors import FitError
from harness.models.estimate import Estimate
from harness.physics.arms.arm import ArmModel
from harness.physics.arms.inertia import TEN, UNITS, is_consistent
from harness.physics.arms.inertial_fit import Bodies, InertialProblem, by_log_cholesky, by_semidefinite_program
from harness.physics.lumps.identifiability import determined
from harness.signals import FloatArray

TRUST = 0.3
"""Relative standard deviation of the URDF's inertial parameters: the default of the identifier ``inertial``."""


@dataclass(frozen=True, eq=False)
class ArmBodies:
    """Bodies that were estimated.

    Attributes
    ----------
    parameters : array (10 * bodies,)
        Of all bodies, those that are not fitted as in the URDF.
    estimate : Estimate
        Of those that are.
    lost : float
        Log-likelihood of the estimation records by which directions that are free of all limits do better.
    allowed : float
        What chance and the prior make of that.
    """

    parameters: FloatArray
    estimate: Estimate
    lost: float
    allowed: float

    @property
    def possible(self) -> bool:
        """True if free directions do no better than bodies: what they absorb is what mass can make."""
        return self.lost <= self.allowed

    def runs(self, arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]]) -> dict[str, tuple[ArmRun, ...]]:
        """Return records with the torques that these bodies need."""
        change = self.parameters - arm.arm.parameters
        return {
            use: tuple(
                replace(
                    run,
                    rigid=run.rigid + arm.torques(run.motion.q, run.motion.v, run.motion.a, parameters=change),
                )
                for run in parts
            )
            for use, parts in runs.items()
        }


def _free(arm: ArmModel) -> list[int]:
    """Return the numbers of the bodies that can be fitted: those that move and that mass can make in the URDF."""
    table = arm.arm.parameters.reshape(-1, 10)
    return [number for number in arm.links if is_consistent(table[number])]


def bodies_of_arm(
    arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]], joints: Sequence[int], wide: WideResult
) -> ArmBodies:
    """Return the bodies beside friction of every joint by itself and the effects on the whole arm.

    Parameters
    ----------
    arm : ArmModel
    runs : mapping
        With the torques that the URDF's bodies need.
    joints : sequence of int
        Those that move.
    wide : WideResult
        Whose errors weigh the rows.
    """
    chosen = _free(arm)
    regression = WideRegression(arm, runs, joints, _units(arm, chosen))
    form = RegressionForm(regression)
    equation = regression.equation(wide.fit.effects)
    p = np.zeros(len(equation.system.parameters))
    parts = equation.residual(p, "estimation")
    errors = regression_detail(wide.fit).errors["estimation"]
    residual = form.whitened([r for r, _ in parts], "estimation", errors)
    rows = form.whitened([j for _, j in parts], "estimation", errors)
    own = [k for k, name in enumerate(equation.system.parameter_names) if name in regression.inertia]
    others = [k for k in range(rows.shape[1]) if k not in own]
    return _estimated(arm, chosen, [(rows[:, own], rows[:, others], -residual)])


def bodies_of_joints(
    arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]], fits: Mapping[int, Fit], wide: WideResult
) -> ArmBodies:
    """Return the bodies beside all effects that were found, whose values stay; rotors are estimated with the bodies.

    Parameters are those of :func:`bodies_of_arm`, with the fit of every joint that was judged.
    """
    chosen = _free(arm)
    table = unit_torques(arm, runs, chosen)
    blocks = []
    for joint, fit in fits.items():
        known = {use: [wide.torque(run)[:, joint] for run in runs[use]] for use in runs}
        columns = {use: [part[:, joint] for part in parts] for use, parts in table.items()}
        form = RegressionForm(JointRegression(arm, joint, runs, known, columns))
        equation = form.regression.equation(fit.effects)
        names = equation.system.parameter_names
        p = np.array([0.0 if name in form.regression.own else fit.values[name] for name in names])
        parts = equation.residual(p, "estimation")
        errors = regression_detail(fit).errors["estimation"]
        rows = form.whitened([j for _, j in parts], "estimation", errors)
        free = [k for k, name in enumerate(names) if name in form.regression.own]
        residual = form.whitened([r for r, _ in parts], "estimation", errors)
        rotors = [placed for placed in fit.effects if placed.effect.name == ROTOR]
        turning = [names.index(placed.name(one)) for placed in rotors for one in placed.effect.parameter_names]
        beside = [names.index(CLOCK), *turning]
        blocks.append((rows[:, free], rows[:, beside], -residual))
    return _estimated(arm, chosen, blocks)


def unit_torques(
    arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]], chosen: Sequence[int]
) -> dict[str, list[FloatArray]]:
    """Return by use the torques (N, n, 10 B) of all joints for each inertial parameter of the chosen bodies."""
    columns = [10 * number + k for number in chosen for k in range(10)]
    return {
        use: [
            arm.arm.regressor(m.q, m.v, m.a).reshape(len(m.q), arm.n, -1)[:, :, columns]
            for m in (run.calm for run in parts)
        ]
        for use, parts in runs.items()
    }


def _units(arm: ArmModel, chosen: Sequence[int]) -> list[FloatArray]:
    """Return a unit vector (10 * bodies,) for each inertial parameter of the chosen bodies."""
    every = np.eye(10 * len(arm.arm.joints))
    return [every[10 * number + k] for number in chosen for k in range(10)]


def _estimated(
    arm: ArmModel, chosen: Sequence[int], blocks: Sequence[tuple[FloatArray, FloatArray, FloatArray]]
) -> ArmBodies:
    """Return consistent bodies from whitened blocks: rows (M, 10 B) of their parameters, others (M, c), torques (M,).

    The torques are what the bodies of the URDF leave; the others of a block belong to it alone.
    """
    prior = arm.arm.parameters.reshape(-1, 10)[list(chosen)]
    if not len(prior):
        raise FitError(
            f"inertial parameters of {arm.name}",
            expected="a body with a positive definite pseudo-inertia",
            got="a URDF without one",
            remedy='correct its <inertial> elements, or use inertia = "fixed"',
        )
    # what stands beside the bodies is free of limits: its best values for any bodies are projected out
    own, targets = [], []
    for rows, others, target in blocks:
        size = np.linalg.norm(others, axis=0)
        left, singular, _ = np.linalg.svd(others / np.where(size > 0, size, 1.0), full_matrices=False)
        basis = left[:, singular > 1e-9 * singular.max(initial=1e-300)]
        own.append(rows - basis @ (basis.T @ rows))
        targets.append(target - basis @ (basis.T @ target))
    rows, known = np.concatenate(own), np.concatenate(targets) + np.concatenate(own) @ prior.ravel()
    problem = InertialProblem(rows.T @ rows, rows.T @ known, Bodies(prior), TRUST, np.zeros(0, dtype=bool))
    how = "log-Cholesky coordinates"
    try:
        x = by_log_cholesky(problem)
    except FitError:
        x, how = by_semidefinite_program(problem), "semidefinite program"
    names = tuple(f"{name}{number + 1}" for number in chosen for name in TEN)
    decision, _, condition = determined(rows, names, tolerance=ARM_POLICY.moved)
    table = arm.arm.parameters.reshape(-1, 10).copy()
    table[list(chosen)] = x.reshape(-1, 10)
    lost, allowed = _cost_of_reality(rows, known, x, decision.rank)
    record = Estimate(
        names,
        UNITS * len(chosen),
        x,
        method=f"no intervals: they would be the prior's; {how}, prior trusted to {TRUST:.0%}",
        rank=decision,
        condition=condition,
    )
    return ArmBodies(table.ravel(), record, lost, allowed)


def _cost_of_reality(rows: FloatArray, known: FloatArray, x: FloatArray, rank: int) -> tuple[float, float]:
    """Return by how much the log-likelihood of free directions is above that of x, and what chance makes of it."""
    from scipy.stats import chi2

    size = np.linalg.norm(rows, axis=0)
    scaled = rows / np.where(size > 0, size, 1.0)
    free = known - scaled @ np.linalg.lstsq(scaled, known, rcond=1e-9)[0]
    residual = known - rows @ x
    return 0.5 * float(residual @ residual - free @ free), 0.5 * float(
        chi2.ppf(1.0 - ARM_POLICY.by_chance, max(rank, 1))
    )
