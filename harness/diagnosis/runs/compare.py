"""Free runs of the nominal and the repaired model: the errors that users know, before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.diagnosis.policy import Policy
from harness.diagnosis.records.horizon import Horizon
from harness.diagnosis.records.stretches import about_lines
from harness.diagnosis.runs.fitted import Fitted
from harness.diagnosis.runs.form import FreeRunForm
from harness.diagnosis.runs.states import on_validation, settled_states
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.systems import by_equations
from harness.effects.effect import Placed
from harness.errors import HarnessError
from harness.physics.fitting.likelihood_fit import sensor_noise
from harness.signals import FloatArray, Trajectory


@dataclass(frozen=True, eq=False)
class FreeRuns:
    """Free runs over a horizon."""

    horizon: Horizon
    output: FreeRunForm  # What simulates; its weights are the sensor noise of the final model
    # None where the simulation diverges
    before: Fitted | None
    after: Fitted | None
    left: float
    """Mean square of what the final model leaves of the validation outputs over the horizon, over that of what a
    straight line through the same windows leaves, the noise of the sensors taken off both: the share of the motion, the
    worst output. Not finite where the simulation diverges."""
    beyond_start: float
    """The same over what the fitted start leaves alone: a place goes on along a line, a speed or a level stays where it
    is. A line takes up nearly all of a car that rolls out, and says nothing of why it does."""
    motion: FloatArray  # (ny,): What the fitted start leaves, with its noise
    noise: FloatArray  # (ny,): Variance of what the sensors read besides, as far as neighbours tell it
    worst: int | None  # That output; None where the simulation diverges

    @classmethod
    def of(cls, horizon: Horizon, output: FreeRunForm, before: Fitted | None, after: Fitted | None) -> FreeRuns:
        """Return the free runs of two models with what the second leaves of the validation records."""
        records = output.records["validation"]
        line, still = (_motion(records, horizon, degree) for degree in (1, 0))
        motion = np.where(_places(output), line, still)
        noise = told_noise(output.weights, output.records["estimation"])
        if after is None or not after.finite:
            return cls(horizon, output, before, after, np.inf, np.inf, motion, noise, None)
        square = np.concatenate(list(after.validation)) ** 2 * output.weights**2
        # what cannot be told from noise is not left, of a motion that can be
        least = np.maximum(noise, 1e-300)
        left, beyond = (
            np.maximum(square.mean(axis=0) - noise, 0.0) / np.maximum(moved - noise, least) for moved in (line, motion)
        )
        worst = int(np.argmax(left))
        return cls(horizon, output, before, after, float(left[worst]), float(beyond.max()), motion, noise, worst)

    def worse(self, policy: Policy) -> bool:
        """Return True if the final model runs further from the validation records than the nominal one.

        By more than the standard errors over blocks that validation asks for everywhere; what an unknown torque does to
        both is no difference between them.
        """
        if self.before is None or not self.before.finite or self.after is self.before:
            return False
        if self.after is None or not self.after.finite:
            return True
        change, error = self._change(policy)
        return change > policy.tie_z * error

    def idle(self, policy: Policy) -> bool:
        """Return True if the final model does not run nearer to the validation records at all."""
        known = self.before is not None and self.before.finite and self.after is not None and self.after.finite
        return known and self.after is not self.before and self._change(policy)[0] >= 0.0

    @property
    def further(self) -> float:
        """Times as far as on the estimation records that the final model errs on the others, the worst output."""
        if self.after is None or not self.after.finite:
            return np.inf
        estimation, validation = (
            np.sqrt(np.mean(np.concatenate(list(errors)) ** 2, axis=0))
            for errors in (self.after.estimation, self.after.validation)
        )
        return float(np.max(validation / np.maximum(estimation, 1e-300)))

    def cured_by(self, fit: Fit, policy: Policy) -> bool:
        """Return True if another model brings the validation records as near as the final one has the others."""
        other = seen(self.output, fit)
        if self.after is None or other is None or not other.finite:
            return False
        return replace(self, after=replace(self.after, validation=other.validation)).further <= policy.further

    def nearer(self, policy: Policy) -> bool:
        """Return True if the final model runs nearer to the validation records than the nominal one, by as much.

        And by a share of the mean square that is worth it: that which a model that explains all may leave.
        """
        if self.after is None or not self.after.finite or self.after is self.before:
            return False
        if self.before is None or not self.before.finite:
            return True
        change, error = self._change(policy)
        whole = sum(float((errors**2).sum()) for errors in self.before.validation)
        return change < -max(policy.tie_z * error, policy.explained * whole)

    def to_the_noise(self, policy: Policy) -> bool:
        """Return True if the final model leaves no more of the validation records than the noise of their sensors.

        But for the share of it that a model which explains all may leave.
        """
        if self.after is None or not self.after.finite:
            return False
        square = np.mean(np.concatenate(list(self.after.validation)) ** 2, axis=0) * self.output.weights**2
        return bool(np.all(square <= (1.0 + policy.explained) * self.noise))

    def _change(self, policy: Policy) -> tuple[float, float]:
        """Return by how much the sum of squared errors grows, and its standard error over blocks."""
        assert self.before is not None
        assert self.after is not None
        return changed(self.after, self.before, policy)


def changed(new: Fitted, old: Fitted, policy: Policy) -> tuple[float, float]:
    """Return by how much the sum of squared errors of the validation records grows, and its error over blocks."""
    sums: list[float] = []
    for mine, theirs in zip(new.validation, old.validation, strict=True):
        edges = np.linspace(0, len(mine), policy.blocks + 1).astype(int)
        change = np.concatenate([[0.0], np.cumsum((mine**2 - theirs**2).sum(axis=1))])
        sums += list(np.diff(change[edges]))
    more = np.array(sums)
    return float(more.sum()), float(np.sqrt(len(more)) * more.std(ddof=1))


def free_runs(
    output: FreeRunForm, horizon: Horizon, nominal: Fit, final: Fit, best: Mapping[str, float] | None = None
) -> FreeRuns:
    """Simulate both models over windows, initial states fitted to each.

    ``best`` are parameters of the nominal model that were fitted to free runs: beside a latent force its likelihood is
    largest elsewhere, and what an effect brings is told against the nearest that the nominal model can come.
    """
    before = seen(output, nominal)
    after = before if final is nominal else seen(output, final)
    if best is not None and final is not nominal:
        able = [before, seen_values(output, (), best)]
        before = min((one for one in able if one is not None and one.finite), key=_inside, default=before)
    return FreeRuns.of(horizon, output, before, after)


def told_noise(deviation: FloatArray, records: Sequence[Trajectory]) -> FloatArray:
    """Return the variance of the sensor noise (ny,): what a model leaves is noise only as far as neighbours differ."""
    return np.asarray(np.minimum(np.asarray(deviation, dtype=float), sensor_noise(records)) ** 2)


def _inside(fitted: Fitted) -> float:
    """Return the mean square of the errors of the estimation records."""
    return float(np.mean(np.concatenate(list(fitted.estimation)) ** 2))


def _places(output: FreeRunForm) -> npt.NDArray[np.bool_]:
    """Return which outputs tell where something is that moves on by itself (ny,); all of a plant without equations."""
    import casadi as ca

    system = output.nominal
    if not by_equations(system):
        return np.ones(len(output.columns), dtype=bool)
    places = ca.vertcat(*(system.x[coordinate.q] for coordinate in system.coordinates))
    return np.array([bool(places.numel() and ca.depends_on(system.h[row], places)) for row in range(system.ny)])


def _motion(records: Sequence[Trajectory], horizon: Horizon, degree: int) -> FloatArray:
    """Return the mean square of every output about a straight line, or a constant, through each window (ny,).

    Nothing at all knows an angle that goes round to half a turn.
    """
    spec = records[0].spec
    periods = [channel.period for channel in spec.outputs]
    unwrapped = [
        np.column_stack(
            [
                column if period is None else np.unwrap(column, period=period)
                for column, period in zip(y.T, periods, strict=True)
            ]
        )
        for y in (record.y for record in records)
    ]
    samples = None if horizon.seconds is None else max(3, round(horizon.seconds / spec.sample_time))
    most = [np.inf if period is None else period**2 / 12 for period in periods]
    return np.minimum(about_lines(unwrapped, samples, degree), most)


def seen(output: FreeRunForm, fit: Fit) -> Fitted | None:
    """Return a fit as free runs show it, its parameters held; None where the simulation diverges."""
    return seen_values(output, fit.effects, fit.values, {**fit.own, **fit.day}, converged=fit.converged)


def seen_values(
    output: FreeRunForm,
    effects: Sequence[Placed],
    values: Mapping[str, float],
    own: Mapping[str, float] | None = None,
    *,
    converged: bool = True,
) -> Fitted | None:
    """Return a model with effects as free runs show it, its parameters held; None where the simulation diverges.

    ``own`` is where the search for what belongs to the validation records starts: by default where the estimation
    records have it.
    """
    system = output.system(effects)
    p = system.vector({name: values[name] for name in system.parameter_names})
    per_record = {
        placed.name(parameter.name): values[placed.name(parameter.name)]
        for placed in effects
        for parameter in placed.effect.parameters
        if parameter.per_record and not parameter.fixed
    }
    try:
        with np.errstate(all="ignore"):
            windows = output.windows(system, p, "estimation")
            states = [output.from_data(windows.simulator, run, p)[0] for run in output.records["estimation"]]
            x0 = settled_states(output, system, p, "estimation", windows, windows.starts_from(states))
            record: dict[str, Any] = {
                "values": dict(values), "x0": x0.tolist(), "converged": converged, "message": "",
            }  # fmt: skip
            record.update(on_validation(output, system, record, per_record if own is None else own))
            return output.evaluate(effects, record)
    except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
        return None
