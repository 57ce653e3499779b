"""Inverse dynamics: the loop on force residuals of measured motion.

Right where the motion is measured far more exactly than the forces are modelled: an unmodelled force then is the
noise of the equation, and the least-squares fit of the decimated equation (inverse dynamic identification model) is the
efficient estimator, also for data taken in closed loop. A simulation would integrate that force noise twice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from harness.diagnosis.descent import Bar
from harness.diagnosis.equation import Equations, bump_rows, decimated, equations_of, expressible
from harness.diagnosis.forms import Fitted
from harness.diagnosis.motion import Motion, measured_coordinates, smooth_motion, thinned
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.signals import Dataset, FloatArray

__all__ = ["EquationForm"]

FARTHEST = 200.0
"""Logarithm beyond which a parameter is as good as infinite."""
LARGEST = 1e100


class EquationForm:
    """Compare force residuals; see :class:`harness.diagnosis.forms.Form`.

    Parameters
    ----------
    nominal : System
        All of its coordinates are measured.
    dataset : Dataset
        Estimation and validation runs.
    sizes : mapping
        Sizes of the data by port, for start values.
    shape : {"strong", "weak"}
        Decimated samples of M a - Q, or means over bumps of the momentum balance.
    """

    def __init__(
        self,
        nominal: Any,
        dataset: Dataset,
        *,
        sizes: Mapping[str, Mapping[str, float]],
        shape: Literal["strong", "weak"] = "strong",
    ) -> None:
        columns = measured_coordinates(nominal)
        if columns is None:
            raise FitError(
                "no inverse dynamics",
                expected="a measured position for every coordinate",
                got=", ".join(channel.name for channel in nominal.outputs),
                remedy="judge this model by simulation",
            )
        self.nominal = nominal
        self.sample_time = dataset.spec.sample_time
        self.shape: Literal["strong", "weak"] = shape
        self.sizes = sizes
        self.columns = tuple((one.name, one.force_unit) for one in nominal.coordinates)
        weak, smooth = shape == "weak", dataset.intersample == "smooth"
        self.motions: dict[str, tuple[Motion, ...]] = {
            use: tuple(
                smooth_motion(run, columns, dataset.intersample if weak or smooth else "foh")
                for run in dataset.using(use)
            )
            for use in ("estimation", "validation", "test")
        }
        if shape == "weak":  # a screen: it need not see every sample
            self.motions = {use: tuple(map(thinned, motions)) for use, motions in self.motions.items()}
        self.weights = np.ones(len(self.columns))
        self.floors: tuple[float | None, ...] = (None,) * len(self.columns)
        self._equations: dict[tuple[str, ...], Equations] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_equations": {}}

    def judges(self, placed: Placed) -> bool:
        """Return True for forces without a state of their own; see :func:`expressible`."""
        return expressible(placed) and placed.at not in {channel.name for channel in self.nominal.outputs} - {
            one.name for one in self.nominal.coordinates
        }

    def equations(self, effects: Sequence[Placed]) -> Equations:
        """Return the equation form with effects, made once."""
        key = tuple(str(one) for one in effects)
        if key not in self._equations:
            system = compose(self.nominal, effects, sizes=self.sizes) if effects else self.nominal
            self._equations[key] = equations_of(system)
        return self._equations[key]

    def solve(
        self, effects: Sequence[Placed], starts: Sequence[Mapping[str, float]], *, seed: int, bar: Bar | None = None
    ) -> dict[str, Any]:
        """Fit by least squares on the force residual from one or more starts; the best end counts. Gives up none."""
        del seed, bar
        equations = self.equations(tuple(effects))
        system = equations.system
        best: tuple[float, dict[str, float], bool, str] | None = None
        for start in list(starts)[:2] or ({},):
            known = {**system.values(), **start}
            found = self._solve(equations, {name: known[name] for name in system.parameter_names})
            if np.isfinite(list(found[1].values())).all() and (best is None or found[0] < best[0]):
                best = found
        if best is None:
            raise FitError(
                "the fit of the force balance left every bound",
                expected="finite parameters",
                got="infinite ones",
                remedy="the effect does not show in these data",
            )
        return dict(zip(("cost", "values", "converged", "message"), best, strict=True))

    def evaluate(self, effects: Sequence[Placed], record: Mapping[str, Any]) -> Fitted:
        """Return residuals and Jacobian of a record."""
        values = record["values"]
        equations = self.equations(tuple(effects))
        system = equations.system
        p = system.vector({name: values[name] for name in system.parameter_names})
        free = tuple(one.name for one in system.parameters if not one.fixed)
        index = [system.parameter_names.index(name) for name in free]
        inside = [equations.residual(motion, p, self.shape, index) for motion in self.motions["estimation"]]
        outside = [equations.residual(motion, p, self.shape, ()) for motion in self.motions["validation"]]
        # a block before the inputs could make the equation small by passing nothing on: count by what it passes on
        inputs = {channel.name for channel in self.nominal.inputs}
        lost = 1.0
        if any(one.at in inputs for one in effects):
            motion = self.motions["estimation"][0]
            passed = equations.input_size(motion, p)
            lost = self.equations(()).input_size(motion, self.nominal.vector()) / max(passed, 1e-300)
        return Fitted(
            effects=tuple(effects),
            system=system,
            values=dict(zip(system.parameter_names, map(float, p), strict=True)),
            free=free,
            converged=bool(record["converged"]),
            message=str(record["message"]),
            estimation=tuple(-lost * r / self.weights for r, _ in inside),
            validation=tuple(-lost * r / self.weights for r, _ in outside),
            jacobian=tuple(lost * j / self.weights[:, None] for _, j in inside),
            record=dict(record),
        )

    def responses(self, base: Fitted, placed: Placed, values: Mapping[str, float]) -> tuple[FloatArray, ...] | None:
        """Return difference and derivatives of the force residual; see :class:`harness.diagnosis.forms.Form`."""
        equations = self.equations((*base.effects, placed))
        system = equations.system
        p = system.vector({**base.values, **{placed.name(key): value for key, value in values.items()}})
        names = [placed.name(one.name) for one in placed.effect.parameters]
        index = [system.parameter_names.index(name) for name in names if not system.parameter(name).fixed]
        parts = []
        for motion, before in zip(self.motions["estimation"], base.estimation, strict=True):
            r, j = equations.residual(motion, p, self.shape, index)
            difference = r / self.weights + before
            parts.append(np.concatenate([difference[:, :, None], j / self.weights[:, None]], axis=2))
        return tuple(parts) if all(np.isfinite(one).all() for one in parts) else None

    def clean(self, base: Fitted, parts: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Return the columns unchanged: there are no initial states."""
        return tuple(parts)

    def averaged(self, columns: FloatArray, motion: Motion) -> FloatArray:
        """Return columns (N, n, k) of forces along a motion as the residual is: decimated, or means over bumps."""
        count, n, k = columns.shape
        slim = decimated if self.shape == "strong" else bump_rows
        return slim(columns.reshape(count, n * k), motion).reshape(-1, n, k)

    def force(self, placed: Sequence[Placed], fitted: Fitted, motion: Motion) -> FloatArray:
        """Return the force (rows, n) that effects of a fitted model exert, decimated as the residual is."""
        keep = [one for one in fitted.effects if str(one) not in {str(gone) for gone in placed}]
        full = self.equations(fitted.effects)
        less = self.equations(tuple(keep))
        a, _ = full.residual(motion, full.system.vector(fitted.values), self.shape)
        known = {name: fitted.values[name] for name in less.system.parameter_names}
        b, _ = less.residual(motion, less.system.vector(known), self.shape)
        return b - a

    def _solve(self, equations: Equations, start: Mapping[str, float]) -> tuple[float, dict[str, float], bool, str]:
        """Run Levenberg-Marquardt from one start; returns cost, parameters, converged, message."""
        from scipy.optimize import least_squares

        system = equations.system
        names = list(system.parameter_names)
        free = [k for k, one in enumerate(system.parameters) if not one.fixed]
        logs = np.array([system.parameters[k].minimum > 0 for k in free], dtype=bool)
        p0 = np.array([start[name] for name in names])

        def inflate(z: FloatArray) -> FloatArray:
            p = p0.copy()
            p[free] = np.where(logs, np.exp(np.clip(np.where(logs, z, 0.0), -FARTHEST, FARTHEST)), z)
            return p

        cache: dict[bytes, tuple[FloatArray, FloatArray]] = {}

        def both(z: FloatArray) -> tuple[FloatArray, FloatArray]:
            key = z.tobytes()
            if key not in cache:
                cache.clear()
                p = inflate(z)
                rows = [equations.residual(motion, p, self.shape) for motion in self.motions["estimation"]]
                r = np.concatenate([(one / self.weights).reshape(-1) for one, _ in rows])
                j = np.concatenate([(one / self.weights[:, None]).reshape(-1, p.size) for _, one in rows])[:, free]
                slopes = j * np.where(logs, p[free], 1.0)
                cache[key] = (np.nan_to_num(r, nan=1e9), np.nan_to_num(slopes, posinf=LARGEST, neginf=-LARGEST))
            return cache[key]

        low = np.array([system.parameters[k].minimum for k in free])
        high = np.array([system.parameters[k].maximum for k in free])
        with np.errstate(divide="ignore", invalid="ignore"):
            z0 = np.where(logs, np.log(np.maximum(p0[free], 1e-300)), p0[free])
            low, high = np.where(logs, np.log(np.maximum(low, 1e-300)), low), np.where(logs, np.log(high), high)
        z0 = np.clip(z0, low + 1e-9 * np.abs(low, where=np.isfinite(low), out=np.ones_like(low)), high)
        if not free:
            r, _ = both(z0)
            return float(r @ r), dict(zip(names, p0.tolist(), strict=True)), True, "nothing to fit"

        def residual(z: FloatArray) -> FloatArray:
            return both(z)[0]

        def jacobian(z: FloatArray) -> FloatArray:
            return both(z)[1]

        found = least_squares(
            residual,
            np.clip(z0, low, high),
            jac=jacobian,
            bounds=(low, high),
            x_scale="jac",
            max_nfev=40,
        )
        p = inflate(found.x)
        return 2 * float(found.cost), dict(zip(names, map(float, p), strict=True)), bool(found.success), found.message
