"""What was found at every joint of an arm, and on the whole of it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from harness.diagnosis.arm.bodies import ArmBodies
from harness.diagnosis.arm.joint import CLOCK, JointRegression
from harness.diagnosis.arm.motion import ArmRun, moving_rows
from harness.diagnosis.arm.regression import regression_detail
from harness.diagnosis.arm.wide import WideResult
from harness.diagnosis.policy import ARM_POLICY, POLICY, ArmPolicy, Policy
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.leftover import Axis, Leftover
from harness.diagnosis.search.outcome import Outcome
from harness.physics.arms.arm import ArmModel
from harness.signals import Dataset, FloatArray


@dataclass(eq=False)
class JointDiagnosis:
    """What was found at one joint.

    Attributes
    ----------
    joint : int
        From 0.
    regression : JointRegression
    outcome : Outcome
        Its nominal model is that after effects on the whole arm, before its own.
    leftover : Leftover
        What free torques would still gain.
    noise : float
        Of the torque's samples, as it shows in the residual.
    closed : (JointRegression, Fit), optional
        The regression beside the bodies that were estimated, where inertial parameters are free, and the same effects
        there: what is left is left by bodies, not by directions of the search.
    """

    joint: int
    regression: JointRegression
    outcome: Outcome
    leftover: Leftover
    noise: float
    policy: ArmPolicy = ARM_POLICY
    closed: tuple[JointRegression, Fit] | None = None

    @property
    def nominal(self) -> Fit:
        """The joint before its own effects."""
        return self.outcome.nominal

    @property
    def final(self) -> Fit:
        """The joint with them."""
        return self.outcome.model

    @functools.cached_property
    def torque(self) -> float:
        """Standard deviation of the joint's torque while it moves, filtered as the residual is (validation records)."""
        rows = []
        for run, counts in zip(self.regression.torque("validation"), self.regression.counts["validation"], strict=True):
            rows.append(run[counts[:, 0] > 0])
        return float(np.std(np.concatenate(rows)))

    @property
    def clock(self) -> float | None:
        """By how long its torque is recorded too late [s]; None where that is more than a clock can be."""
        value = self.final.values[CLOCK]
        return value if abs(value) <= self.regression.latest else None

    def left(self, use: str) -> float:
        """Return the rms of the residual torque of the final model while the joint moves."""
        return self._rms(self.residual(use), use)

    def residual(self, use: str) -> list[FloatArray]:
        """Return the residual torque (rows, 1) of the final model for every record."""
        return self._residual(*(self.closed or (self.regression, self.final)), use)

    def before(self, use: str) -> float:
        """Return the same before the joint's own effects."""
        return self._rms(self._residual(self.regression, self.nominal, use), use)

    def _residual(self, regression: JointRegression, fit: Fit, use: str) -> list[FloatArray]:
        """Return the residual torque (rows, 1) of a fit for every record."""
        known = regression_detail(fit).residual.get(use)
        if known is not None:
            return list(known)
        equation = regression.equation(fit.effects)
        p = np.array([fit.values[name] for name in equation.system.parameter_names])
        return [r for r, _ in equation.residual(p, use)]

    def _rms(self, residual: Sequence[FloatArray], use: str) -> float:
        if not residual:
            return float("nan")
        rows = [r[c[:, 0] > 0] for r, c in zip(residual, self.regression.counts[use], strict=True)]
        return float(np.sqrt(np.mean(np.concatenate(rows) ** 2)))

    @functools.cached_property
    def share(self) -> float:
        """Part of the torque that stays unexplained and is no noise of its samples, on the validation records."""
        count = sum(float(rows.sum()) for rows in self.regression.counts["validation"])
        noise = self.noise**2 * (
            1.0 + ARM_POLICY.sure * np.sqrt(2.0 / max(count, 1.0))
        )  # as large as chance may make it
        return float(np.sqrt(max(self.left("validation") ** 2 - noise, 0.0)) / max(self.torque, 1e-300))

    @functools.cached_property
    def predictable(self) -> Axis | None:
        """What of the residual can be predicted, if it is more than the error of a torque sensor."""
        best = self.leftover.best
        if best is None:
            return None
        change = next(change for change in self.regression.free_torques() if change.names[0] == best.name)
        force = np.concatenate(change.torque["validation"])[:, 0] @ best.values
        moving = np.concatenate(self.regression.counts["validation"])[:, 0] > 0
        return best if float(np.std(force[moving])) > self.policy.sensor * self.torque else None


@dataclass(eq=False)
class ArmDiagnosis:
    """Everything that was found on an arm, for the reports.

    Attributes
    ----------
    dataset, arm
        What was given.
    runs : dict
        Motions by use.
    wide : WideResult
        Effects on the whole arm.
    joints : tuple of JointDiagnosis
        Those that were judged.
    still : array (n,)
        Share of the time in which each joint stands still.
    bodies : ArmBodies, optional
        Where inertial parameters are free.
    misfit : tuple of str
        Why the model does not fit at all; empty if it does.
    policy : Policy
    warnings : list of str
    seconds : float
    """

    dataset: Dataset
    arm: ArmModel
    runs: dict[str, tuple[ArmRun, ...]]
    wide: WideResult
    joints: tuple[JointDiagnosis, ...]
    still: FloatArray
    bodies: ArmBodies | None = None
    misfit: tuple[str, ...] = ()
    policy: Policy = POLICY
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def verdict(self) -> str:
        """See diagnosis: model_does_not_fit, effects_found, nothing_missing, unexplained."""
        if self.misfit:
            return "model_does_not_fit"
        if self.wide.accepted or any(joint.outcome.accepted for joint in self.joints):
            return "effects_found"
        return "unexplained" if self.incomplete else "nothing_missing"

    @property
    def incomplete(self) -> list[JointDiagnosis]:
        """The joints at which a part of the residual can be predicted, or it is no small disturbance."""
        return [joint for joint in self.joints if joint.predictable is not None or joint.share > self.policy.large]

    @property
    def grade(self) -> str:
        """How much of the torques is explained, their noise set aside, and whether more could be predicted."""
        if self.misfit:
            return "does_not_fit"
        if self.incomplete:
            return "proxy_or_incomplete"
        left = max(joint.share**2 for joint in self.joints)
        return "explained" if left <= self.policy.explained else "mostly_explained"

    @property
    def explained_share(self) -> float:
        """Share of the variance of the torque that is explained, at the joint where it is least (validation)."""
        return min(1.0 - (joint.left("validation") / max(joint.torque, 1e-300)) ** 2 for joint in self.joints)

    def before(self, use: str) -> FloatArray:
        """Return the rms of the torque residual of every joint before anything was added (n,)."""
        return self._rms(use, lambda run: run.motion.u - run.rigid)

    def after(self, use: str) -> FloatArray:
        """Return the rms of the torque residual of every joint with all that was found (n,)."""
        result = self._rms(use, lambda run: run.motion.u - self.wide.torque(run), self.closed_runs)
        for joint in self.joints:
            result[joint.joint] = joint.left(use)
        return result

    @functools.cached_property
    def closed_runs(self) -> dict[str, tuple[ArmRun, ...]]:
        """The records with the torques that the estimated bodies need."""
        return self.runs if self.bodies is None else self.bodies.runs(self.arm, self.runs)

    def _rms(
        self,
        use: str,
        pick: Callable[[ArmRun], FloatArray],
        runs: dict[str, tuple[ArmRun, ...]] | None = None,
    ) -> FloatArray:
        """Return the rms of something by joint, while the joints move."""
        power, count = np.zeros(self.arm.n), np.zeros(self.arm.n)
        for run in (runs or self.runs)[use]:
            moving = moving_rows(run.motion)
            power += np.sum((run.slim(pick(run)) * moving) ** 2, axis=0)
            count += np.sum(moving, axis=0)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.sqrt(power / np.where(count > 0, count, np.nan)))
