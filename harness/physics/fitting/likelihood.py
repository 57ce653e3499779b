"""Maximum likelihood of a stochastic grey box: parameters, initial states and noise together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.physics.compiled.kalman_pass import Filtered, KalmanPass, Noise, Pass
from harness.physics.compiled.latent import with_latent_forces
from harness.physics.fitting.levenberg import log_scaled
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.compiled.simulator import Intersample
    from harness.physics.compiled.system import System

__all__ = ["Likelihood", "LikelihoodFit", "NoiseModel", "Point", "interval"]

_STEP = 1e-6
"""Of the difference quotients, in units of a parameter's scale: half of the digits of a double are left."""
_PART = 1e-3
"""Of the difference quotients, in standard deviations, once these are known."""
_NOISE_STEP = 1e-5
"""Of the difference quotients by logarithms of the noise."""
_ENOUGH = 0.02
"""A step that brings less than this much log-likelihood ends a fit: nothing is decided by a fiftieth."""
_BROKEN = 1.0
"""A promise that no step keeps ends a fit at its maximum up to here: rivals tie within three times as much."""
_ROUGH = 0.3
"""Below this promise the derivatives of gains and variances count, and difference quotients are taken of all."""
_STALE = 0.05
"""Log-likelihood gained since, from which on these are taken anew: it is a third of a standard error."""
_SETTLED = 5
"""Iterations after which a step is taken as typical of those to come."""
_TOLD = 1e-12
"""Curvature along a direction, over the largest, below which it is rounding: nothing is told along it."""
_PARTLY = 1e-3
"""Share of such a direction from which on an entry is undetermined."""
_CORNERS = 3
"""Parameters along which a likelihood may have a corner at once: limits of two outputs, and one to spare."""
_SIDES = tuple(side * part for part in (1.0, 0.1, 0.01, 1e-3) for side in (1.0, -1.0))
"""Of a Newton step along one parameter, to both sides, that must all be worse on a corner."""
_LONGEST = 1.5
"""Longest step of a logarithm."""
_KEPT = 0.5
"""Share of its promise below which a step along a narrow valley is corrected for the bend of the valley."""
_BENT = 0.75
"""Length of a correction over that of the one before it, at most: beyond it they lead nowhere."""
_DAMPING = 1e-3
"""Of the first step, over the diagonal."""
_LEAST_DAMPING = 1e-7
_MOST_DAMPING = 1e9
_POSITIVE = 1e-12


@dataclass(frozen=True)
class NoiseModel:
    """Which noise is estimated, and within what.

    Parameters
    ----------
    force_scale : array (nl,)
        Typical size of each latent force [its unit].
    output_scale : array (ny,)
        Typical size of each output.
    latent : bool
        False for no latent forces: the free run, output error.
    white : bool
        Whether each has a white part too.
    shortest, longest : float
        Bounds of the time constants [s].
    least : array (ny,), optional
        Smallest standard deviation of the noise of each output: that of its resolution.
    """

    force_scale: FloatArray
    output_scale: FloatArray
    latent: bool = True
    white: bool = True
    shortest: float = 1e-3
    longest: float = 10.0
    least: FloatArray | None = None

    @property
    def smallest(self) -> FloatArray:
        """Lower bounds of the noise of the outputs (ny,): what they resolve, or the last digits of a number."""
        exact = 1e-7 * self.output_scale
        return exact if self.least is None else np.maximum(exact, self.least)


@dataclass(eq=False)
class Point:
    """A place in the space of everything unknown.

    Attributes
    ----------
    p : array (np,)
    x0 : list of array (start_size,)
        By record.
    noise : Noise
    """

    p: FloatArray
    x0: list[FloatArray]
    noise: Noise


@dataclass(eq=False)
class LikelihoodFit:
    """Maximum of the likelihood.

    Attributes
    ----------
    system : System
        Without the latent forces.
    point : Point
    nll : float
        Minus the log-likelihood of all records.
    terms : list of array (K,)
        The same by record and sample.
    names : tuple of str
        What was estimated: parameters, ``x0[record].state``, noise.
    covariance : array
        Of these, in the units of ``scaled``: logarithms for what cannot be negative.
    logarithmic : array of bool
    converged : bool
    on_bound : tuple of str
        Parameters on a bound, and noise on its upper one.
    iterations : int
    message : str
    beyond : bool
        True if it was left because its steps would not have brought it within reach.
    pace : float
        Log-likelihood that its last step gained; 0 where it converged.
    damping : float
        Of its last step: a search that goes on from here begins with it.
    undetermined : tuple of str
        What the records tell in combinations only: it can move along with others and nothing changes. ``covariance``
        is that of the combinations.
    """

    system: System
    point: Point
    nll: float
    terms: list[FloatArray]
    names: tuple[str, ...]
    covariance: FloatArray
    logarithmic: npt.NDArray[np.bool_]
    converged: bool
    on_bound: tuple[str, ...]
    iterations: int
    message: str = ""
    filtered: list[Filtered] = field(default_factory=list, repr=False)
    beyond: bool = False
    pace: float = 0.0
    damping: float = _DAMPING
    undetermined: tuple[str, ...] = ()

    @property
    def parameters(self) -> dict[str, float]:
        """Values of all parameters by name."""
        return dict(zip(self.system.parameter_names, (float(value) for value in self.point.p), strict=True))

    def deviation(self, name: str) -> float:
        """Return the standard deviation of an estimate, from the curvature; of its logarithm where that was fitted.

        Infinite where the records do not determine it.
        """
        if name in self.undetermined:
            return float("inf")
        k = self.names.index(name)
        return float(np.sqrt(max(self.covariance[k, k], 0.0)))

    def interval(self, name: str, level: float = 1.96) -> tuple[float, float]:
        """Return the 95 % interval of a parameter."""
        k = self.names.index(name)
        return interval(self.parameters[name], level * self.deviation(name), bool(self.logarithmic[k]))


class Likelihood:
    """The likelihood of some records under a system with latent forces and sensor noise.

    Parameters
    ----------
    system : System
    records : sequence of Trajectory
    noise_model : NoiseModel
    fixed : sequence of str
        Parameters that stay, besides those that the system declares fixed.
    intersample : {"zoh", "foh", "smooth"}
    substeps : int, optional
    compiled : bool
    passes : Pass, optional
        Of the same system, made before.

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
        return self._layout()[0]

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

    def _unpack(self, z: FloatArray) -> Point:
        """Return the point of a vector."""
        n, m, nl, ny = self.filter.parameter_count, self.filter.start_size, self.filter.nl, self.filter.ny
        p = np.clip(np.where(self._log, np.exp(np.where(self._log, z[:n], 0.0)), z[:n]), *self._bounds)
        x0 = [z[n + k * m : n + (k + 1) * m] for k in range(len(self.records))]
        log_noise = z[n + len(self.records) * m :]
        nothing, fast = np.zeros(nl), np.full(nl, self.noise_model.shortest)
        if not self.noise_model.latent:
            return Point(p, x0, Noise(np.exp(log_noise), nothing, fast, nothing))
        white = np.exp(log_noise[2 * nl : 3 * nl]) if self.noise_model.white else nothing
        noise = Noise(np.exp(log_noise[-ny:]), np.exp(log_noise[:nl]), np.exp(log_noise[nl : 2 * nl]), white)
        return Point(p, x0, noise)

    def _layout(self) -> tuple[list[str], npt.NDArray[np.bool_], FloatArray, FloatArray]:
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
            low += [*(force - np.log(1e6)), *([np.log(model.shortest)] * len(ports))]
            high += [*(force + np.log(30.0)), *([np.log(model.longest)] * len(ports))]
            if model.white:
                names += [f"w@{port}" for port in ports]
                low += list(force - np.log(1e6))
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
        with np.errstate(over="ignore"):  # far off its data
            rms = np.sqrt(np.nanmean(np.concatenate([passed.e for passed in found]) ** 2, axis=0))
        if not np.isfinite(rms).all():
            return point
        r = np.clip(rms, self.noise_model.smallest, 10.0 * self.noise_model.output_scale)
        return replace(point, noise=replace(point.noise, r=r))

    def _value(self, z: FloatArray) -> tuple[float, list[Filtered] | None]:
        with np.errstate(all="ignore"):
            found = self.filtered(self._unpack(z))
        total = np.inf if found is None else sum(passed.nll for passed in found)
        return (float(total), found) if np.isfinite(total) else (np.inf, None)

    def _place(self, z: FloatArray) -> _Place:
        """Return a vector with its value and its passes."""
        value, found = self._value(z)
        return _Place(z, value, found or [])

    def _jacobians(
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
        e, s = _joined(found)
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
            e2, s2 = _joined(moved)
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
        point = self._unpack(z)
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
        number, point = (k - n) // self.filter.start_size, self._unpack(trial)
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

        Parameters
        ----------
        start : Point or LikelihoodFit
            A fit of this likelihood to go on from.
        free : sequence of str, optional
            What is estimated (parameters, ``x0[k].state``, ``s@``, ``tau@``, ``w@``, ``r@``); all that is not fixed by
            default.
        most : int
            Iterations.
        reach : float
            A value of minus the log-likelihood that must be come to. If the iterations that are left would not do so,
            were each to bring as much as the last one, the search ends, not converged.
        exact : bool
            Whether the last steps count how parameters and initial states change the variances, too. That takes
            difference quotients, and matters where the innovations are to be judged to less than a tenth. What they
            add is kept until the steps with it have come to their end.
        near : bool
            Whether the start is where a search that was not exact ended: the last steps are taken at once.

        Raises
        ------
        FitError
            If the filter diverges at the start.
        """
        names, _, low, high = self._layout()
        if free is None:
            chosen = np.ones(len(names), dtype=bool)
            chosen[: self.filter.parameter_count] = self._free
        else:
            wanted = set(free)
            chosen = np.array([name in wanted for name in names], dtype=bool)
        if isinstance(start, LikelihoodFit) and start.filtered:
            begin, damping = _Place(self._pack(start.point), start.nll, start.filtered), start.damping
        else:
            point, damping = start.point if isinstance(start, LikelihoodFit) else start, _DAMPING
            begin = self._place(np.clip(self._pack(point), low, high))
        if not begin.passes:
            raise FitError(
                f"likelihood of {self.system.name}",
                expected="a start at which the filter stays finite",
                got="a diverging state",
                remedy="start elsewhere, or check units and signs of the records",
            )
        search = _FisherScoring(self, begin, np.flatnonzero(chosen), damping=damping, exact=exact, near=near)
        search.run(most, reach)
        return search.fit()


@dataclass(frozen=True, eq=False)
class _Place:
    """A vector, minus the log-likelihood there, and the passes: none, and an infinite value, if one diverges."""

    z: FloatArray
    value: float
    passes: list[Filtered]


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """Minus the log-likelihood about a place, to second order in the entries that are estimated.

    Attributes
    ----------
    by_e : array (n, K)
        What the entries do to innovations, over their deviations.
    gradient : array (n,)
    matrix : array (n, n)
        Fisher's.
    live : array of bool (n,)
        Entries that the gradient does not hold on a bound.
    """

    by_e: FloatArray
    gradient: FloatArray
    matrix: FloatArray
    live: npt.NDArray[np.bool_]

    @property
    def finite(self) -> bool:
        """Whether all derivatives are."""
        return bool(np.isfinite(self.gradient).all() and np.isfinite(self.matrix).all())

    @cached_property
    def size(self) -> FloatArray:
        """What turns entries into standard deviations, each with the others held."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.matrix), 1e-12)))

    @cached_property
    def scaled(self) -> FloatArray:
        """The matrix in these units."""
        return np.asarray(self.matrix / np.outer(self.size, self.size))

    def promise(self, moved: FloatArray) -> float:
        """Return the log-likelihood that a step is to bring."""
        return -float(self.gradient @ moved + 0.5 * moved @ self.matrix @ moved)

    def whole_promise(self) -> float:
        """Return what an undamped step of the live entries is to bring."""
        return _undamped(self.scaled[np.ix_(self.live, self.live)], (self.gradient / self.size)[self.live])

    def damped(self, slope: FloatArray, damping: float, low: FloatArray, high: FloatArray) -> FloatArray:
        """Return Levenberg's step against a slope, within bounds of the step, in standard deviations."""
        return _damped(self.scaled, slope / self.size, damping, self.live, low * self.size, high * self.size)


@dataclass(frozen=True, eq=False)
class _Step:
    """A step with more and more damping: where it is likelier (None: nowhere), and what it promised first and last."""

    place: _Place | None
    promise: float
    first: float


class _FisherScoring:
    """A search for the maximum of a likelihood by Fisher scoring with Levenberg's damping.

    First derivatives are those of the innovations; the last steps may count those of gains and variances, too.

    Attributes
    ----------
    at : _Place
        The best so far.
    damping : float
        Of the next step, over the diagonal.
    least_raised : float
        From where it rises when a step fails, at least.
    valley : bool
        Whether the search is in a narrow valley that bends: long steps are corrected for the bend.
    last : bool
        Whether these are the last steps: what brings little ends the search.
    more : pair of array, optional
        What gains and variances add to the Jacobians; None if it is to be taken.
    seen : float
        Value where that was taken.
    plain : float
        What a whole step promised there without it.
    gain : float
        Log-likelihood that the last step brought.
    converged, beyond, message, count
        See :class:`LikelihoodFit`.
    """

    def __init__(
        self, likelihood: Likelihood, begin: _Place, entries: npt.NDArray[np.intp], *, damping: float, exact: bool,
        near: bool,
    ) -> None:  # fmt: skip
        names, log, low, high = likelihood._layout()
        ny, latent = likelihood.filter.ny, likelihood.noise_model.latent
        self._likelihood, self._latent, self._entries = likelihood, latent, entries
        self._names, self._log = tuple(names[k] for k in entries), log[entries]
        self._low, self._high = low[entries], high[entries]
        self._longest = np.where(self._log, _LONGEST, np.inf)
        self._noise_bounds = low[-ny:], high[-ny:]
        self._exact = exact and latent
        self._noise_follows = not latent and int((entries >= len(names) - ny).sum()) == ny
        self._matrix = np.eye(len(entries))
        self._deviations: FloatArray | None = None
        self.at, self.damping, self.last, self.valley = begin, damping, near, False
        # free runs of parameters that these records hardly tell apart lie in a narrow valley: there damping rises from
        # where it held, and a short step that brings little is no end while a long one promises more
        self.least_raised = 1e-4 if latent else _LEAST_DAMPING
        self.more: tuple[FloatArray, FloatArray] | None = None
        self.seen, self.plain, self.gain = begin.value, np.inf, 0.0
        self.converged, self.beyond, self.message, self.count = False, False, "", 0

    def run(self, most: int, reach: float) -> None:
        """Take up to ``most`` steps; give up once steps like the last one would not come to ``reach``."""
        for count in range(1, most + 1):
            self.count = count
            with np.errstate(all="ignore"):
                model = self._quadratic()
            if not model.finite:
                self.message = "derivatives are not finite"
                return
            step = self._step(model)
            if step.place is None:
                if self._ends_without(step, model):
                    return
                continue
            self._take(step.place)
            if count >= _SETTLED and self.at.value - (most - count) * self.gain > reach:
                self.message, self.beyond = "its steps do not bring it within reach", True
                return
            if self._ends_with(step, model):
                return
        self.message = f"no maximum after {most} iterations"

    def _quadratic(self) -> _Quadratic:
        """Return the expansion about the place; what is exact is taken in the last steps, and kept."""
        likelihood, at, entries = self._likelihood, self.at, self._entries
        by_e, by_s = likelihood._jacobians(at.z, at.passes, entries, False, self._deviations)
        if self.last and self._exact:
            if self.more is None:
                gradient, matrix = _scored(at.passes, by_e, by_s)
                self.plain = _undamped(matrix, gradient)
                whole = likelihood._jacobians(at.z, at.passes, entries, True, self._deviations)
                self.more, self.seen = (whole[0] - by_e, whole[1] - by_s), at.value
            by_e, by_s = by_e + self.more[0], by_s + self.more[1]
        gradient, self._matrix = _scored(at.passes, by_e, by_s)
        self._deviations = 1.0 / np.sqrt(np.maximum(np.diag(self._matrix), 1e-300))
        z = at.z[entries]
        stuck = ((z <= self._low) & (gradient > 0)) | ((z >= self._high) & (gradient < 0))
        return _Quadratic(by_e, gradient, self._matrix, ~stuck)

    def _step(self, model: _Quadratic) -> _Step:
        """Return a step that is damped until it raises the likelihood, or promises next to nothing."""
        entries, z = self._entries, self.at.z[self._entries]
        low, high = np.maximum(self._low - z, -self._longest), np.minimum(self._high - z, self._longest)
        promise, first, growth, heavy = np.inf, np.inf, 8.0, self.damping > _DAMPING
        while self.damping < _MOST_DAMPING:
            step = model.damped(model.gradient, self.damping, low, high) / model.size
            trial = self.at.z.copy()
            trial[entries] = np.clip(z + step, self._low, self._high)
            moved = trial[entries] - z
            promise = model.promise(moved)
            if heavy and 0 <= promise < _ENOUGH:  # only a long step promises little where there is little
                self.damping, heavy = _DAMPING, False
                continue
            heavy = False
            first = promise if first == np.inf and promise >= 0 else first
            place = self._likelihood._place(trial)
            if self.valley and promise >= _ENOUGH:
                place = self._around_the_bend(model, place, moved, self.at.value - _KEPT * promise)
            if place.value < self.at.value:
                return _Step(place, promise, first)
            if 0 <= promise < _ENOUGH:
                break
            self.damping, growth = max(self.damping, self.least_raised) * growth, 8.0 if self.valley else 32.0
        return _Step(None, promise, first)

    def _around_the_bend(self, model: _Quadratic, first: _Place, moved: FloatArray, wanted: float) -> _Place:
        """Return the best place of a step that is corrected until it keeps its promise, or bends too much for that.

        Along a narrow valley that bends, a step is as short as its straight part is. What its first order missed is
        taken back, all over the same derivatives: the geodesic acceleration of Transtrum & Sethna 2012
        (arXiv:1201.5885, sec. 2), of a whole step and more than once.
        """
        entries, z = self._entries, self.at.z[self._entries]
        low, high = np.maximum(self._low, z - self._longest), np.minimum(self._high, z + self._longest)
        best = place = first
        length = float(np.linalg.norm(moved * model.size))
        e, s = _joined(self.at.passes)
        while place.passes and best.value > wanted:
            missed = (_joined(place.passes)[0] - e) / np.sqrt(s) - moved @ model.by_e
            bent = model.by_e @ np.where(np.isfinite(missed), missed, 0.0)
            here = place.z[entries]
            turn = model.damped(bent, self.damping, low - here, high - here)
            if np.linalg.norm(turn) > _BENT * length:
                break
            length = float(np.linalg.norm(turn))
            trial = place.z.copy()
            trial[entries] = np.clip(here + turn / model.size, low, high)
            place = self._likelihood._place(trial)
            if place.value < best.value:
                best = place
        return best

    def _take(self, place: _Place) -> None:
        """Go to a likelier place."""
        if self._noise_follows:
            place = self._concentrated(place)
        self.gain, self.at = self.at.value - place.value, place
        self.damping = max(self.damping / 8.0, _LEAST_DAMPING)

    def _concentrated(self, place: _Place) -> _Place:
        """Return a place with the sensor noise of its free run at the maximum, in the passes too."""
        z, (low, high) = place.z.copy(), self._noise_bounds
        ny = len(low)
        rms = np.sqrt(np.nanmean(np.concatenate([passed.e for passed in place.passes]) ** 2, axis=0))
        z[-ny:] = np.clip(np.log(np.maximum(rms, 1e-300)), low, high)
        for passed in place.passes:
            passed.s = np.broadcast_to(np.exp(2 * z[-ny:]), passed.s.shape).copy()
        return _Place(z, float(sum(passed.nll for passed in place.passes)), place.passes)

    def _ends_with(self, step: _Step, model: _Quadratic) -> bool:
        """Return whether a step that was taken is the last one; if not, decide how to go on."""
        if not self.last:
            self.last = max(self.gain, step.promise) < _ROUGH
            return False
        if self.gain >= _ENOUGH:
            return False
        short = self.damping > 8.0 * _LEAST_DAMPING and not (self.valley and self._latent)
        if short and not model.whole_promise() < _ROUGH:  # a narrow valley that bends: long steps, corrected for it
            self.valley, self.least_raised, self.damping = True, _LEAST_DAMPING, _LEAST_DAMPING
            return False
        self.converged = self.more is None or self.seen - self.at.value < _STALE
        self.more = None
        return self.converged

    def _ends_without(self, step: _Step, model: _Quadratic) -> bool:
        """Return whether a place that no step leads away from is the end; if not, decide how to go on."""
        if not self.last:
            self.last, self.damping = True, _DAMPING
            return False
        if self.more is not None and self.seen - self.at.value >= _STALE:
            self.more, self.damping = None, _DAMPING
            return False
        # where steps of the solver follow the motion, difference quotients may be rounding: without them then; where
        # they pass over a corner of a law, the likelihood is as rough as that
        self.converged = min(step.first, self.plain) < _BROKEN
        if not self.converged:
            self.converged, better = self._at_corner(model)
            if better is not None:
                self.gain, self.at = self.at.value - better.value, better
                self.last, self.damping = False, _DAMPING
                return False
        self.message = "" if self.converged else "no step raises the likelihood"
        return True

    def _at_corner(self, model: _Quadratic) -> tuple[bool, _Place | None]:
        """Return whether a place that no step leads away from is a maximum on a corner, or a likelier place beside it.

        Where a sample changes sides (a reading at its limit, say) the likelihood has a corner along one parameter, and
        a gradient there that no step keeps. It is a maximum if it falls to both sides of every such parameter, and the
        others, with these held, promise nothing.
        """
        gradient, rest = model.gradient, model.live.copy()
        curvature = np.maximum(np.diag(model.matrix), 1e-12)
        promises = np.where(rest, 0.5 * gradient**2 / curvature, 0.0)
        for row in np.argsort(-promises)[:_CORNERS]:
            if promises[row] < _ENOUGH:
                break
            k = self._entries[row]
            for part in _SIDES:
                trial = self.at.z.copy()
                step = part * abs(gradient[row]) / curvature[row]
                trial[k] = np.clip(trial[k] + step, self._low[row], self._high[row])
                place = self._likelihood._place(trial)
                if place.value < self.at.value - _ENOUGH:
                    return False, place
            rest[row] = False
            if _undamped(model.matrix[np.ix_(rest, rest)], gradient[rest]) < _BROKEN:
                return True, None
        return False, None

    def fit(self) -> LikelihoodFit:
        """Return what was found, with its covariance; what lies on a bound has none."""
        matrix, z = self._matrix, self.at.z[self._entries]
        size = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
        near = 1e-6
        free = self._entries < self._likelihood.filter.parameter_count
        margin = np.where(self._log, near, near * np.maximum(np.abs(z), 1e-12))
        bound = (z <= self._low + margin) | (z >= self._high - margin)
        inner = ~bound
        covariance = np.zeros_like(matrix)
        undetermined = np.zeros(len(z), dtype=bool)
        if not np.isfinite(matrix).all():
            inner = np.zeros_like(bound)
        if inner.any():
            eigenvalues, vectors = np.linalg.eigh(matrix[np.ix_(inner, inner)] / np.outer(size[inner], size[inner]))
            told = eigenvalues > _TOLD * eigenvalues[-1]
            inverse = (vectors[:, told] / eigenvalues[told]) @ vectors[:, told].T
            covariance[np.ix_(inner, inner)] = inverse / np.outer(size[inner], size[inner])
            undetermined[inner] = (np.abs(vectors[:, ~told]) > _PARTLY).any(axis=1)

        def named(where: npt.NDArray[np.bool_]) -> tuple[str, ...]:
            return tuple(self._names[k] for k in np.flatnonzero(where))

        return LikelihoodFit(
            self._likelihood.system,
            self._likelihood._unpack(self.at.z),
            self.at.value,
            [passed.terms for passed in self.at.passes],
            self._names,
            covariance,
            self._log,
            self.converged,
            named(bound & (free | (z > self._low + margin))),
            self.count,
            self.message,
            list(self.at.passes),
            beyond=self.beyond,
            pace=0.0 if self.converged else self.gain,
            damping=self.damping,
            undetermined=named(undetermined),
        )


def _undamped(matrix: FloatArray, gradient: FloatArray) -> float:
    """Return what a whole Gauss-Newton step promises."""
    return 0.5 * float(gradient @ np.linalg.pinv(matrix, rcond=_TOLD, hermitian=True) @ gradient)


def _damped(
    matrix: FloatArray,
    gradient: FloatArray,
    damping: float,
    live: npt.NDArray[np.bool_],
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """Return Levenberg's step of the live entries within bounds; what would go beyond stays there, and others follow.

    A logarithm of something that the data hardly tell wants long steps. If it alone were shortened, the step of the
    others would be that for a place where it never comes.
    """
    step = np.zeros(len(gradient))
    free = live.copy()
    for _ in range(3):
        inner = matrix[np.ix_(free, free)] + (damping + 1e-12) * np.eye(int(free.sum()))
        right = gradient[free] + matrix[np.ix_(free, ~free)] @ step[~free]
        step[free] = -np.linalg.solve(inner, right)
        beyond = free & ((step < low) | (step > high))
        step = np.clip(step, low, high)
        if not beyond.any():
            break
        free &= ~beyond
    return step


def interval(value: float, half: float, logarithmic: bool) -> tuple[float, float]:
    """Return an interval about a value, or about its logarithm; without ends where the half width is infinite.

    Examples
    --------
    >>> interval(2.0, float("inf"), True), interval(2.0, 0.5, False)
    ((0.0, inf), (1.5, 2.5))
    """
    if not logarithmic:
        return value - half, value + half
    if not np.isfinite(half):
        return 0.0, float("inf")
    return float(value * np.exp(-min(half, 50.0))), float(value * np.exp(min(half, 50.0)))


def _log(values: FloatArray, least: FloatArray) -> FloatArray:
    """Return logarithms, of what is 0 that of almost nothing."""
    return np.asarray(np.log(np.maximum(values, least)))


def _joined(found: list[Filtered]) -> tuple[FloatArray, FloatArray]:
    """Return innovations and variances of all records, one after the other."""
    e = np.concatenate([passed.e.ravel() for passed in found])
    return e, np.concatenate([passed.s.ravel() for passed in found])


def _scored(found: list[Filtered], by_e: FloatArray, by_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return gradient and Fisher matrix for derivatives of innovations, over their deviations, and log variances."""
    e, s = _joined(found)
    normal = np.where(np.isfinite(e), e, 0.0) / np.sqrt(s)
    gradient, matrix = by_e @ normal, by_e @ by_e.T
    spread = np.flatnonzero(by_s.any(axis=1))
    part = by_s[spread]
    gradient[spread] += 0.5 * (part @ (1.0 - normal**2))
    matrix[np.ix_(spread, spread)] += 0.5 * (part @ part.T)
    return gradient, matrix
