"""Closing the loop on an arm: what acts on the whole arm first, then every joint on its own torque residual."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.diagnosis.adequacy import Adequacy, grade, predictable_part
from harness.diagnosis.arm_checks import check_torques
from harness.diagnosis.arm_form import JointForm, joint_dictionary
from harness.diagnosis.arm_motion import ArmRun, arm_runs, moving_rows, standstill
from harness.diagnosis.arm_wide import DETAIL, WideResult, wide_search
from harness.diagnosis.records.prepare import checked
from harness.diagnosis.refitter import Refitter
from harness.diagnosis.response import equation_families
from harness.diagnosis.runs.equation import decimated
from harness.diagnosis.runs.fitted import Fitted, rms, stacked
from harness.diagnosis.store import Store, fingerprint
from harness.diagnosis.subset import Search, SearchResult
from harness.diagnosis.surrogates import orthonormal
from harness.effects.effect import Effect, Placed
from harness.errors import InputError
from harness.physics.arm import ArmModel
from harness.rng import stream
from harness.signals import Dataset, FloatArray

__all__ = ["ArmDiagnosis", "JointDiagnosis", "diagnose_arm"]

STICKS = 1 / 3
"""A joint that stands still for more than this share of the time is not judged."""
SENSOR = 0.005
"""A rest below this share of the joint's torque is not blamed on anything: no torque sensor is more exact."""
Progress = Callable[[float, str], None]


@dataclass(eq=False)
class JointDiagnosis:
    """What was found at one joint.

    Attributes
    ----------
    joint : int
        From 0.
    form : JointForm
    nominal : Fitted
        After effects on the whole arm, before its own.
    result : SearchResult
    adequacy : Adequacy
    drowned : tuple of str
        Effects that were not tried because the torque is too noisy for them.
    """

    joint: int
    form: JointForm
    nominal: Fitted
    result: SearchResult
    adequacy: Adequacy
    drowned: tuple[str, ...] = ()

    @property
    def predictable(self) -> bool:
        """True if a part of what is left can be predicted, and is more than the error of a torque sensor."""
        best = self.adequacy.best
        if not self.adequacy.predictable or best is None:
            return False
        torque = np.concatenate([one.u[:, 0] for one in self.form.motions["validation"]])
        return float(best.rms[0] * self.form.weights[0]) > SENSOR * float(np.std(torque))


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
    warnings : list of str
    seconds : float
    """

    dataset: Dataset
    arm: ArmModel
    runs: dict[str, tuple[ArmRun, ...]]
    wide: WideResult
    joints: tuple[JointDiagnosis, ...]
    still: FloatArray
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def verdict(self) -> str:
        """See diagnosis: effects_found, nothing_missing, unexplained."""
        if self.wide.accepted or any(one.result.accepted for one in self.joints):
            return "effects_found"
        return "unexplained" if any(one.predictable for one in self.joints) else "nothing_missing"

    @property
    def grade(self) -> str:
        """The adequacy of the joint that is explained worst."""
        order = ("explained", "mostly_explained", "proxy_or_incomplete")
        found = [one.adequacy.grade for one in self.joints if one.predictable]
        return max(found, key=order.index, default="explained")

    def before(self, use: str) -> FloatArray:
        """Return the rms of the torque residual of every joint before anything was added (n,)."""
        return self._rms(use, lambda run: run.motion.u - run.rigid)

    def after(self, use: str) -> FloatArray:
        """Return the rms of the torque residual of every joint with all that was found (n,)."""
        result = self._rms(use, lambda run: run.motion.u - known_torque(run, self.wide))
        for one in self.joints:
            final = one.result.model
            if use == "test":
                equations = one.form.equations(final.effects)
                p = equations.system.vector({name: final.values[name] for name in equations.system.parameter_names})
                parts = [equations.residual(motion, p, "strong", ())[0] for motion in one.form.motions["test"]]
                result[one.joint] = float(rms(parts)[0]) if parts else float("nan")
            else:
                left = final.estimation if use == "estimation" else final.validation
                result[one.joint] = float(rms(left)[0] * one.form.weights[0])
        return result

    def _rms(self, use: str, pick: Callable[[ArmRun], FloatArray]) -> FloatArray:
        """Return the rms of something by joint, while the joints move."""
        parts = [one.slim(pick(one)) * moving_rows(one.motion) for one in self.runs[use]]
        if not parts:
            return np.full(self.arm.n, np.nan)
        return rms(parts)


def diagnose_arm(
    dataset: Dataset,
    arm: ArmModel,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    folder: Path | None = None,
    dictionary: Sequence[Effect] | None = None,
) -> ArmDiagnosis:
    """Find what an arm lacks, by inverse dynamics.

    Given the measured motion of all joints, the equation of each joint stands alone. So what acts on several joints
    (payload, tilt, a wrong link, a joint's zero, elasticity) is looked for first, with the friction of all joints
    taken out; then every joint is searched on its own torque residual, for up to three effects.

    Parameters
    ----------
    dataset : Dataset
        Torques and positions of every joint, estimation and validation runs.
    arm : ArmModel
    seed : int
        Keys surrogates and bootstrap draws.
    progress : callable, optional
        Called as ``progress(fraction_done, what)``.
    folder : Path, optional
        Where finished refits are kept.
    dictionary : sequence of Effect, optional
        Effects to try at the joints; by default :data:`harness.diagnosis.arm_form.JOINT_EFFECTS`.

    Raises
    ------
    InputError
        If the data do not fit the arm, or no joint moves.
    """
    began = time.monotonic()

    def say(part: float, what: str) -> None:
        if progress is not None:
            progress(part, what)

    dataset = checked(dataset, arm)
    warnings = [*dataset.warnings, *check_torques(dataset.runs)]
    say(0.02, "motion of the joints")
    runs = arm_runs(arm, dataset)
    still = standstill(runs)
    moving = [k for k in range(arm.n) if still[k] <= STICKS]
    for k in range(arm.n):
        if k not in moving:
            warnings.append(
                f"{arm.positions[k].name} stands still for {100 * still[k]:.0f} % of the time: "
                "its torque is not judged (record it moving)"
            )
    if not moving:
        raise InputError(
            f"no joint of {dataset.name!r} moves",
            expected="a joint in motion for two thirds of the time",
            got=", ".join(f"{one.name} {100 * (1 - s):.0f} %" for one, s in zip(arm.positions, still, strict=True)),
            remedy="record the arm on a path that keeps its joints moving",
        )
    directions = None if arm.inertia == "fixed" else _inertial_directions(arm, runs["estimation"])
    wide = wide_search(arm, runs, moving, seed=seed, calibrated=directions, say=lambda text: say(0.1, text))
    joints = []
    for place, k in enumerate(moving):
        say(0.3 + 0.55 * place / len(moving), f"joint {k + 1}")
        joints.append(_joint(arm, k, runs, wide, directions, dataset, seed, folder, dictionary))
    for one in joints:
        warnings += [f"joint {one.joint + 1}: {note}" for note in one.result.notes]
    return ArmDiagnosis(dataset, arm, runs, wide, tuple(joints), still, warnings, time.monotonic() - began)


def known_torque(run: ArmRun, wide: WideResult) -> FloatArray:
    """Return the torque (N, n) that the arm needs with all that acts on the whole of it."""
    result = run.rigid.copy()
    sharp = replace(run, calm=replace(run.motion, u=run.calm.u))  # the true motion, not the calm one
    for one in wide.accepted:
        result += one.effect.columns(sharp) @ one.values
    return result


def _joint(
    arm: ArmModel,
    k: int,
    runs: dict[str, tuple[ArmRun, ...]],
    wide: WideResult,
    directions: Sequence[FloatArray] | None,
    dataset: Dataset,
    seed: int,
    folder: Path | None,
    dictionary: Sequence[Effect] | None,
) -> JointDiagnosis:
    """Search one joint."""
    known = {use: [known_torque(one, wide)[:, k] for one in parts] for use, parts in runs.items()}
    free = None if directions is None else _free_columns(arm, k, runs, directions)
    form = JointForm(arm, k, runs, known, free)
    record = form.solve((), [{}], seed=seed)
    form.weights = np.maximum(rms(form.evaluate((), record).estimation), 1e-12)
    nominal = form.evaluate((), record)
    candidates, drowned = joint_dictionary(arm, k, form, runs["estimation"][0], dictionary)
    identity = fingerprint(
        dataset, model=str(arm), joint=k, wide=[(str(one.effect), one.values.tolist()) for one in wide.accepted],
        weights=form.weights.tolist(), parameters=arm.arm.parameters.tolist(), damping=arm.damping.tolist(),
    )  # fmt: skip
    search = Search(form, candidates, form.sizes, Refitter(form, Store(folder, identity), seed), seed)
    result = _without_details(form, search.run(nominal), seed)
    return JointDiagnosis(k, form, nominal, result, _adequacy(form, result.model, seed), tuple(drowned))


def _without_details(form: JointForm, result: SearchResult, seed: int) -> SearchResult:
    """Return a result without effects that are less than 2 % of another one at the joint: details of that one's law."""
    if len(result.accepted) < 2:
        return result
    motion = form.motions["estimation"][0]
    moving = moving_rows(motion)
    sizes = [float(rms([form.force([one.placed], result.model, motion) * moving])[0]) for one in result.accepted]
    kept = tuple(one for one, size in zip(result.accepted, sizes, strict=True) if size >= DETAIL * max(sizes))
    if len(kept) == len(result.accepted):
        return result
    gone = [str(one.placed) for one in result.accepted if one not in kept]
    effects = tuple(one.placed for one in kept)
    start = {key: value for key, value in result.model.values.items() if key.split(".")[0] not in gone}
    model = form.evaluate(effects, form.solve(effects, [start], seed=seed))
    note = f"{', '.join(gone)} left out: less than 2 % of {', '.join(map(str, effects))}"
    return replace(result, model=model, accepted=kept, notes=(*result.notes, note))


def _adequacy(form: JointForm, fitted: Fitted, seed: int) -> Adequacy:
    """Return how much of what is left at a joint can be predicted on validation data."""
    equations = form.equations(fitted.effects)
    p = equations.system.vector({name: fitted.values[name] for name in equations.system.parameter_names})
    index = [equations.system.parameter_names.index(name) for name in fitted.free]
    motions = form.motions["validation"]
    jacobians = {
        "estimation": fitted.jacobian,
        "validation": [equations.residual(one, p, "strong", index)[1] / form.weights[:, None] for one in motions],
    }
    left = {use: orthonormal(stacked(parts), tolerance=1e-9) for use, parts in jacobians.items()}
    families = {one.name: one for one in equation_families(form)}
    responses = {
        name: tuple(
            _without(
                left[use],
                [
                    (decimated(phi, motion) * moving_rows(motion))[:, None, :]
                    for phi, motion in zip(one.basis(use), form.motions[use], strict=True)
                ],
            )
            for use in ("estimation", "validation")
        )
        for name, one in families.items()
    }
    outside = [one[:, :, 0] for one in _without(left["validation"], [one[:, :, None] for one in fitted.validation])]
    found, null = predictable_part(
        list(fitted.estimation),
        outside,
        responses,  # type: ignore[arg-type]
        rng=stream("arm-adequacy", form.joint, seed),
        roughness={name: family.roughness() for name, family in families.items()},
    )
    return grade(found, null, outside, form.floors, rng=stream("arm-adequacy-blocks", form.joint, seed))


def _without(left: FloatArray, parts: Sequence[FloatArray]) -> list[FloatArray]:
    """Return columns (rows_i, 1, k) with what free parameters can do taken out."""
    flat = stacked(parts)
    flat = flat - left @ (left.T @ flat)
    cuts = np.cumsum([one.shape[0] for one in parts])[:-1]
    return [piece[:, None, :] for piece in np.split(flat, cuts)]


def _inertial_directions(arm: ArmModel, runs: Sequence[ArmRun]) -> list[FloatArray]:
    """Return an orthonormal basis of the inertial parameters that this motion moves at all."""
    size = 10 * len(arm.arm.joints)
    rows = slice(None, None, max(runs[0].calm.q.shape[0] // 400, 1))
    m = runs[0].calm
    columns = [arm.torques(m.q[rows], m.v[rows], m.a[rows], parameters=unit).reshape(-1) for unit in np.eye(size)]
    _, singular, right = np.linalg.svd(np.stack(columns, axis=1), full_matrices=False)
    return [row for row, value in zip(right, singular, strict=True) if value > 1e-4 * singular[0]]


def _free_columns(
    arm: ArmModel, k: int, runs: Mapping[str, Sequence[ArmRun]], directions: Sequence[FloatArray]
) -> dict[str, list[FloatArray]]:
    """Return by use the torques (N, c) of one joint that calibrated inertial parameters can make, without doubles."""
    raw = {
        use: [
            np.stack([arm.torques(m.q, m.v, m.a, parameters=one)[:, k] for one in directions], axis=1)
            for m in (run.calm for run in parts)
        ]
        for use, parts in runs.items()
    }
    joined = np.concatenate(raw["estimation"])
    _, singular, right = np.linalg.svd(joined, full_matrices=False)
    kept = singular > 1e-4 * singular[0]
    turn: Any = right[kept].T * (np.sqrt(joined.shape[0]) / singular[kept])
    return {use: [one @ turn for one in parts] for use, parts in raw.items()}


def placed_effects(found: ArmDiagnosis) -> list[tuple[JointDiagnosis, Placed]]:
    """Return the effects found at joints, with the joint."""
    return [(one, accepted.placed) for one in found.joints for accepted in one.result.accepted]
