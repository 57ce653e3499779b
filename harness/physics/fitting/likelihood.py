"""Likelihood of a stochastic grey box: parameters, initial states and noise together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.physics.compiled.kalman_pass import Filtered, KalmanPass, Pass, PassNoise
from harness.physics.compiled.latent import with_latent_forces
from harness.physics.fitting.fisher_scoring import ENOUGH, FisherScoring, Place, joined
from harness.physics.fitting.levenberg import log_scaled
from harness.physics.fitting.maximum import FIRST_DAMPING, LikelihoodFit, NoiseModel, Point
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.compiled.simulator import Intersample
    from harness.physics.compiled.system import System

_STEP = 1e-6  # Of the difference quotients, in units of a parameter's scale: half of the digits of a double are left.
_PART = 1e-3  # Of the difference quotients, in standard deviations, once these are known.
_NOISE_STEP = 1e-5  # Of the difference quotients by logarithms of the noise.
_POSITIVE = 1e-12
_LEAST = 1e6  # Typical force over the least latent one that is fitted.
_VALLEY = 120  # Iterations of a search without forces: two ends 8 deviations away along a narrow valley took 80.


class Likelihood:
    """The likelihood of some records under a system with latent forces and sensor noise.

    - ``fixed``: parameters that stay, besides those that the system declares fixed
    - ``intersample`` {"zoh", "foh", "smooth"}
    - ``passes``: of the same system, made before

    Notes
    -----
    ``-log L = 1/2 sum log(2 pi s_k) + e_k^2 / s_k`` with innovations e and variances s of the extended Kalman filter
    (Astrom 1980; Kristensen, Madsen & Jorgensen 2004, eq. 11). Maximised by Fisher scoring with Levenberg's damping:
    the matrix is ``sum de de'/s + 1/2 dlog(s) dlog(s)'``, the gradient exact.
    """

    def __init__(
        self,
        system: System,
        records: Sequence[Trajectory],
        noise_model: NoiseModel,
        *,
        fixed: Sequence[str] = (),
        intersample: Intersample = "zoh",
        substeps: int | None = None,
        compiled: bool = True,
        passes: Pass | None = None,
    ) -> None:
        self.system, self.records, self.noise_model = system, list(records), noise_model
        dt = self.records[0].spec.sample_time
        self.filter: Pass = passes or KalmanPass(
            with_latent_forces(system), dt, intersample=intersample, substeps=substeps, compiled=compiled
        )
        self._log = log_scaled(system)
        self._free = np.array(
            [not (parameter.fixed or parameter.name in fixed) for parameter in system.parameters], dtype=bool
        )
        low = np.array([parameter.minimum for parameter in system.parameters])
        high = np.array([parameter.maximum for parameter in system.parameters])
        self._bounds = low, high
        self._low = np.where(self._log, np.log(np.maximum(low, _POSITIVE)), low)
        self._high = np.where(self._log, np.log(np.maximum(high, _POSITIVE)), high)

    @property
    def names(self) -> list[str]:
        """What can be estimated: parameters, ``x0[record].state``, noise."""
        return self.layout()[0]

    @property
    def start_names(self) -> list[str]:
        """Names of the initial states, record by record."""
        return [f"x0[{number}].{state}" for number in range(len(self.records)) for state in self.filter.state_names]

    # ---- coordinates of the search ---------------------------------------------------------------------------------

    def _pack(self, point: Point) -> FloatArray:
        """Return a point as one vector: parameters, initial states, logarithms of the noise."""
        p = np.where(self._log, np.log(np.maximum(point.p, _POSITIVE)), point.p)
        noise = point.noise
        parts = [p, *point.x0]
        if self.noise_model.latent:
            parts += [_log(noise.s, 1e-9 * self.noise_model.force_scale), np.log(noise.tau)]
            if self.noise_model.white:
                parts.append(_log(noise.w, 1e-9 * self.noise_model.force_scale))
        parts.append(np.log(noise.r))
        return np.concatenate(parts)

    def unpack(self, z: FloatArray) -> Point:
        """Return the point of a vector."""
        n, m, nl, ny = self.filter.parameter_count, self.filter.start_size, self.filter.nl, self.filter.ny
        p = np.clip(np.where(self._log, np.exp(np.where(self._log, z[:n], 0.0)), z[:n]), *self._bounds)
        x0 = [z[n + k * m : n + (k + 1) * m] for k in range(len(self.records))]
        log_noise = z[n + len(self.records) * m :]
        nothing, fast = np.zeros(nl), np.full(nl, self.noise_model.shortest)
        if not self.noise_model.latent:
            return Point(p, x0, PassNoise(np.exp(log_noise), nothing, fast, nothing))
        white = np.exp(log_noise[2 * nl : 3 * nl]) if self.noise_model.white else nothing
        noise = PassNoise(np.exp(log_noise[-ny:]), np.exp(log_noise[:nl]), np.exp(log_noise[nl : 2 * nl]), white)
        return Point(p, x0, noise)

    def layout(self) -> tuple[list[str], npt.NDArray[np.bool_], FloatArray, FloatArray]:
        """Return names, whether logarithmic, lower and upper bounds of the vector."""
        starts = self.start_names
        names = [*self.system.parameter_names, *starts]
        log, low, high = list(self._log), list(self._low), list(self._high)
        log += [False] * len(starts)
        low += [-np.inf] * len(starts)
        high += [np.inf] * len(starts)
        model, ports = self.noise_model, [latent_force.port for latent_force in self.filter.forces]
        if model.latent:
            force = np.log(model.force_scale)
            names += [f"s@{port}" for port in ports] + [f"tau@{port}" for port in ports]
            low += [*(force - np.log(_LEAST)), *([np.log(model.shortest)] * len(ports))]
            high += [*(force + np.log(30.0)), *([np.log(model.longest)] * len(ports))]
            if model.white:
                names += [f"w@{port}" for port in ports]
                low += list(force - np.log(_LEAST))
                high += list(force + np.log(100.0))
        outputs = np.log(model.output_scale)
        names += [f"r@{channel.name}" for channel in self.system.outputs]
        low += list(np.log(model.smallest))
        high += list(outputs + np.log(10.0))
        log += [True] * (len(names) - len(log))
        return names, np.array(log, dtype=bool), np.array(low), np.array(high)

    # ---- evaluation ------------------------------------------------------------------------------------------------

    def filtered(
        self,
        point: Point,
        *,
        columns: npt.NDArray[np.intp] | None = None,
        keep: bool = False,
        by_noise: bool = False,
    ) -> list[Filtered] | None:
        """Return the pass over every record; None if one diverges."""
        if not np.isfinite(point.p).all():  # a step along a logarithm of which the records tell nothing
            return None
        found = []
        for record, x0 in zip(self.records, point.x0, strict=True):
            passed = self.filter(record, point.p, x0, point.noise, columns=columns, keep=keep, by_noise=by_noise)
            if passed is None:
                return None
            found.append(passed)
        return found

    def nll(self, point: Point) -> float:
        """Return minus the log-likelihood of all records; infinite where the filter diverges."""
        with np.errstate(all="ignore"):
            found = self.filtered(point)
        total = np.inf if found is None else sum(passed.nll for passed in found)
        return float(total) if np.isfinite(total) else np.inf

    def concentrated(self, point: Point) -> Point:
        """Return a point with the sensor noise that makes its free run likeliest: the rms of the output error.

        Without latent forces that is the maximum over the noise (Ljung 1999, sec. 7.4); fits then start at a scale at
        which parameters and initial states can move. A run that diverges is returned as it is.
        """
        with np.errstate(all="ignore"):
            found = self.filtered(point)
        if found is None:
            return point
        errors = np.concatenate([passed.e for passed in found])
        read = np.isfinite(errors).sum(axis=0)
        with np.errstate(over="ignore"):  # far off its data
            rms = np.sqrt(np.nansum(errors**2, axis=0) / np.maximum(read, 1))
        if not (np.isfinite(rms) & (read > 0)).all():
            return point
        r = np.clip(rms, self.noise_model.smallest, 10.0 * self.noise_model.output_scale)
        return replace(point, noise=replace(point.noise, r=r))

    def _value(self, z: FloatArray) -> tuple[float, list[Filtered] | None]:
        with np.errstate(all="ignore"):
            found = self.filtered(self.unpack(z))
        total = np.inf if found is None else sum(passed.nll for passed in found)
        return (float(total), found) if np.isfinite(total) else (np.inf, None)

    def place(self, z: FloatArray) -> Place:
        """Return a vector with its value and its passes."""
        value, found = self._value(z)
        return Place(z, value, found or [])

    def jacobians(
        self,
        z: FloatArray,
        found: list[Filtered],
        which: npt.NDArray[np.intp],
        exact: bool,
        deviations: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return what the chosen entries of the vector do to innovations, over their deviations, and to log variances.

        ``deviations`` are standard deviations of the entries, as far as they are known: difference quotients are taken
        over a small part of them.
        """
        e, s = joined(found)
        known = np.isfinite(e)
        root = np.where(known, 1.0 / np.sqrt(s), 0.0)
        by_e, by_s, scale, told = self._sensitivities(z, root, which, exact)
        for row in np.flatnonzero(~told):
            k = int(which[row])
            h = self._quotient_step(k, z[k], None if deviations is None else deviations[row])
            moved = self._moved(z, k, h, found)
            if moved is None:
                h = -h
                moved = self._moved(z, k, h, found)
            if moved is None:
                continue
            e2, s2 = joined(moved)
            by_e[row, known] = (e2[known] - e[known]) / h * root[known]
            by_s[row, known] = np.log(s2[known] / s[known]) / h
        return scale[:, None] * by_e, by_s

    def _sensitivities(
        self, z: FloatArray, root: FloatArray, which: npt.NDArray[np.intp], exact: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.bool_]]:
        """Return the Jacobians that the passes tell, the scale of their rows, and which rows these are.

        If exact, parameters and initial states are left out: a pass does not tell what they do to the variances.
        """
        n, m = self.filter.parameter_count, self.filter.start_size
        limit = self._noise_begins
        by_e, by_s = np.zeros((len(which), len(root))), np.zeros((len(which), len(root)))
        scale, told = np.ones(len(which)), np.zeros(len(which), dtype=bool)
        columns = [] if exact else [int(k) for k in which if k < n]
        starts = list(range(n, n + m)) if not exact and ((which >= n) & (which < limit)).any() else []
        chosen = np.array([*columns, *starts], dtype=np.intp)
        point = self.unpack(z)
        passes = self.filtered(point, columns=chosen if len(chosen) else None, by_noise=bool((which >= limit).any()))
        if passes is None:
            return by_e, by_s, scale, told
        shared = np.flatnonzero(which < n)
        if len(chosen):
            told |= which < limit
            scale[shared] = np.where(self._log, point.p, 1.0)[which[shared]]
        noisy = np.flatnonzero((which >= limit) & all(passed.e_noise is not None for passed in passes))
        told[noisy] = True
        lanes = np.array(self._noise_lanes(), dtype=np.intp)[which[noisy] - limit]
        edges = np.cumsum([0, *(passed.e.size for passed in passes)])
        for number, (passed, first, last) in enumerate(zip(passes, edges[:-1], edges[1:], strict=True)):
            here = root[first:last]  # what is not known is 0 in all derivatives
            if len(chosen):
                j = np.asarray(passed.j).reshape(-1, len(chosen))
                mine = np.flatnonzero((which >= n + number * m) & (which < n + (number + 1) * m))
                places = [*range(len(columns)), *(len(columns) + which[mine] - n - number * m)]
                for column, row in zip(places, [*shared, *mine], strict=True):
                    np.multiply(j[:, column], here, out=by_e[row, first:last])
            if len(noisy):
                e_noise = np.asarray(passed.e_noise).reshape(last - first, -1)
                s_noise = np.asarray(passed.s_noise).reshape(last - first, -1)
                for row, lane in zip(noisy, lanes, strict=True):
                    np.multiply(e_noise[:, lane], here, out=by_e[row, first:last])
                    by_s[row, first:last] = s_noise[:, lane]
        return by_e, by_s, scale, told

    def _quotient_step(self, k: int, value: float, deviation: float | None) -> float:
        """Return the step of a difference quotient by one entry of the vector."""
        if k >= self._noise_begins:
            return _NOISE_STEP
        if deviation is not None:
            return float(np.clip(_PART * deviation, _STEP**1.5, 1e-3))
        return _STEP * max(1e-3 if k >= self.filter.parameter_count else 1.0, abs(value))

    def _moved(self, z: FloatArray, k: int, h: float, found: list[Filtered]) -> list[Filtered] | None:
        """Return the passes with one entry of the vector moved: of one record, if that is where the entry counts."""
        n, trial = self.filter.parameter_count, z.copy()
        trial[k] += h
        if not n <= k < self._noise_begins:
            return self._value(trial)[1]
        number, point = (k - n) // self.filter.start_size, self.unpack(trial)
        moved = self.filter(self.records[number], point.p, point.x0[number], point.noise)
        return None if moved is None else [*found[:number], moved, *found[number + 1 :]]

    @property
    def _noise_begins(self) -> int:
        """Where the noise begins in the vector."""
        return self.filter.parameter_count + len(self.records) * self.filter.start_size

    def _noise_lanes(self) -> list[int]:
        """Return where a pass has the derivative by each logarithm of the noise, in the order of the vector."""
        nl, white = self.filter.nl, self.noise_model.white
        return [k for k in range(3 * nl + self.filter.ny) if white or not 2 * nl <= k < 3 * nl]

    # ---- the maximum -----------------------------------------------------------------------------------------------

    def maximise(
        self,
        start: Point | LikelihoodFit,
        *,
        free: Sequence[str] | None = None,
        most: int = 60,
        reach: float = np.inf,
        exact: bool = True,
        near: bool = False,
    ) -> LikelihoodFit:
        """Return the maximum near a start.

        Raises FitError if the filter diverges at the start.

        - ``start``: a fit of this likelihood to go on from
        - ``free``: what is estimated (parameters, ``x0[k].state``, ``s@``, ``tau@``, ``w@``, ``r@``); all that is not
          fixed by default
        - ``most``: iterations
        - ``reach``: a value of minus the log-likelihood that must be come to. If the iterations that are left would not
          do so, were each to bring as much as the last one, the search ends, not converged.
        - ``exact``: whether the last steps count how parameters and initial states change the variances, too. That
          takes difference quotients, and matters where the innovations are to be judged to less than a tenth. What they
          add is kept until the steps with it have come to their end.
        - ``near``: whether the start is where a search that was not exact ended: the last steps are taken at once
        """
        names, _, low, high = self.layout()
        if free is None:
            chosen = np.ones(len(names), dtype=bool)
            chosen[: self.filter.parameter_count] = self._free
        else:
            wanted = set(free)
            chosen = np.array([name in wanted for name in names], dtype=bool)
        if isinstance(start, LikelihoodFit) and start.filtered:
            begin, damping = Place(self._pack(start.point), start.nll, start.filtered), start.damping
        else:
            point, damping = start.point if isinstance(start, LikelihoodFit) else start, FIRST_DAMPING
            begin = self.place(np.clip(self._pack(point), low, high))
        if not begin.passes:
            raise FitError(
                f"likelihood of {self.system.name}",
                expected="a start at which the filter stays finite",
                got="a diverging state",
                remedy="start elsewhere, or check units and signs of the records",
            )
        search = FisherScoring(self, begin, np.flatnonzero(chosen), damping=damping, exact=exact, near=near)
        search.run(most, reach)
        return search.fit()

    def past_forces(self, fit: LikelihoodFit, *, exact: bool = False) -> LikelihoodFit:
        """Return a fit that goes on from where one without latent forces ends, if that is likelier.

        What parameters have left to go along a narrow valley, faint forces take up: then no step brings much with both,
        though much is left. ``exact`` is that of :meth:`maximise`; what the fit held stays held.
        """
        names, _, low, _ = self.layout()
        forces = slice(self._noise_begins, len(names) - self.filter.ny)
        if not self.noise_model.latent or fit.beyond:
            return fit
        z = self._pack(fit.point)
        z[forces] = low[forces]
        free = [name for name in fit.names if name not in names[forces]]
        try:
            start = self.concentrated(self.unpack(z))
            bare = self.maximise(start, free=free, most=_VALLEY, reach=fit.nll, exact=False)
        except FitError:
            return fit
        return self.maximise(bare.point, free=fit.names, exact=exact) if bare.nll < fit.nll - ENOUGH else fit


def _log(values: FloatArray, least: FloatArray) -> FloatArray:
    """Return logarithms, of what is 0 that of almost nothing."""
    return np.asarray(np.log(np.maximum(values, least)))
