"""The likelihood as a form of the search: compiled systems with latent forces and sensor noise."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from harness.diagnosis.policy import EFFORT, POLICY
from harness.diagnosis.records.prepare import sizes_of
from harness.diagnosis.records.stretches import uncut
from harness.diagnosis.records.unfold import HIDING, unfoldings
from harness.diagnosis.search.apart import Apart
from harness.diagnosis.search.braking import braking
from harness.diagnosis.search.changed import changed_share
from harness.diagnosis.search.coherence import in_parts, wandering
from harness.diagnosis.search.directions import Direction, Trace, directions, line_directions, test_functions
from harness.diagnosis.search.fit import Begun, Column, Fit, Linearised, Suspect
from harness.diagnosis.search.fit_records import fit_from_record, fit_record, point_from_record, point_record
from harness.diagnosis.search.lightened import lightened
from harness.diagnosis.search.predictive import Predictive, predictive, spread_of, whitened
from harness.diagnosis.search.robust import robust_covariance
from harness.effects.compose import compose, moving, recommended_substeps
from harness.effects.effect import Placed
from harness.effects.places import port_of
from harness.errors import FitError, HarnessError
from harness.physics.kalman_pass import Filtered, KalmanPass, Noise, Pass
from harness.physics.latent import with_latent_forces, without_latent_forces
from harness.physics.likelihood import Likelihood, LikelihoodFit, NoiseModel, Point
from harness.physics.likelihood_fit import LONGEST, first_noises, first_state, force_scale, sensor_noise
from harness.physics.simulator import default_substeps
from harness.physics.smoother import Smoothed, innovation_response, smoothed
from harness.physics.start import first_values
from harness.signals import Dataset, FloatArray, Run, Trajectory

__all__ = ["USES", "Detail", "LikelihoodForm"]

NOISE = ("s@", "tau@", "w@", "r@")
USES = ("estimation", "validation")
_FAR = 2.0
"""Factor between typical forces, as declared and as fitted, beyond which a fit is made anew."""
_LONG = 60
"""Iterations of a fit that is to come to its end."""
_TOGETHER = 64
"""Columns of the score test that are answered together."""
OWN = {"payload_step": ("t0",), "periodic_disturbance": ("phi",)}
"""Parameters that belong to a record and not to the plant."""


@dataclass(eq=False)
class Detail:
    """Points and passes by use, the filter that made them, what the parameters' spread costs, and phases by halves."""

    points: dict[str, Point]
    passes: Pass
    best: LikelihoodFit
    predictive: Predictive
    told: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    paths: dict[str, list[Filtered]] = field(default_factory=dict)
    smooth: dict[str, list[Smoothed]] = field(default_factory=dict)


class LikelihoodForm:
    """Fits a system with effects to a data set by maximum likelihood.

    Equations of motion have a latent force each. A process has none, so free runs are compared: a latent force on every
    rate, those of unmeasured levels among them, could do whatever a missing law does. What is estimated is then what
    makes the free run nearest, and intervals count that its error is coloured.

    Parameters
    ----------
    system : System
        The nominal one.
    dataset : Dataset
    sizes : mapping
        Sizes of the data by port, see :func:`harness.effects.columns.motion_sizes`.
    """

    def __init__(self, system: Any, dataset: Dataset, sizes: Mapping[str, Mapping[str, float]]) -> None:
        self.nominal, self.dataset, self.sizes = system, dataset, sizes
        self.latent = self.has_latent_forces()
        self.records: dict[str, list[Trajectory]] = {
            use: [run.measured() for run in dataset.using(use)]  # type: ignore[arg-type]
            for use in USES
        }
        self.dt = dataset.spec.sample_time
        longest = max(len(run) for run in self.records["estimation"]) * self.dt
        y = np.concatenate([run.y for run in self.records["estimation"]])
        self.noise_model = NoiseModel(
            force_scale(system, self.records["estimation"], dataset.intersample) if self.latent else np.zeros(0),
            np.maximum(y.std(axis=0), 1e-12),
            latent=self.latent,
            white=self.latent,
            shortest=self.dt,
            longest=max(longest / LONGEST, 2 * self.dt),
        )
        self._first_noise = sensor_noise(self.records["estimation"])
        self._floor = 1e-7 * self.noise_model.output_scale

    def on(self, dataset: Dataset) -> LikelihoodForm:
        """Return the same form of other data."""
        return type(self)(self.nominal, dataset, self.sizes)

    # ---- what another kind of nominal model does in its own way ----------------------------------------------------

    def judges(self, placed: Placed) -> bool:
        """Return True: every effect can be judged by its equations."""
        return True

    def has_latent_forces(self) -> bool:
        """Return False for output error."""
        return bool(self.nominal.coordinates)

    def composed(self, effects: Sequence[Placed]) -> Any:
        """Return the nominal system with effects."""
        return compose(self.nominal, list(effects), sizes=self.sizes) if effects else self.nominal

    def substeps(self, system: Any, values: Mapping[str, float]) -> int:
        """Return the steps of the solver within a sample."""
        return max(
            default_substeps(system, self.dt, system.vector(values)),
            recommended_substeps(system, values, self.dt, x=moving(system, self.sizes)),
        )

    def passes(self, system: Any, substeps: int) -> Pass:
        """Return the filter of a system."""
        disturbed = with_latent_forces(system) if self.latent else without_latent_forces(system)
        return KalmanPass(disturbed, self.dt, intersample=self.dataset.intersample, substeps=substeps)

    def first_state(self, system: Any, record: Trajectory, p: FloatArray) -> FloatArray:
        """Return the initial state that a record tells, (nx,)."""
        return first_state(system, record, p, self.dataset.intersample)

    def smooth(self, passed: Filtered) -> Smoothed:
        """Return the states given the whole record."""
        return smoothed(passed)

    def first_starts(self) -> list[dict[str, float]]:
        """Return parameters to start the nominal fit from: as declared, and where equation errors are least."""
        system = self.nominal
        free = np.array([not parameter.fixed for parameter in system.parameters], dtype=bool)
        vectors = first_values(
            system, self.records["estimation"], system.values(), free, set(), self.dataset.intersample
        )
        return [dict(zip(system.parameter_names, map(float, vector), strict=True)) for vector in vectors]

    def resize(self, nominal: Fit) -> bool:
        """Take the sizes of forces and of unmeasured levels from the nominal fit: effects start from them.

        The noise is bounded by them as well. True where declared parameters were so far off that a fit must be made
        anew within the new bounds.
        """
        sizes = {port: dict(size) for port, size in sizes_of(self.nominal, nominal.values, self.dataset).items()}
        _, smooth = self.paths(nominal, "estimation")
        x = np.concatenate([motion.x for motion in smooth])
        names = [channel.name for channel in self.nominal.states]
        for port in self.nominal.ports:
            if port.kind == "process":
                level = float(np.sqrt(np.mean(x[:, names.index(port.name)] ** 2)))
                sizes.setdefault(port.name, {})["x"] = level
        self.sizes = sizes
        if not self.latent:
            return False
        old = self.noise_model.force_scale
        scale = force_scale(self.nominal, self.records["estimation"], self.dataset.intersample, nominal.values)
        self.noise_model = replace(self.noise_model, force_scale=scale)
        return bool((np.maximum(scale / old, old / scale) > _FAR).any())

    # ---- fits ------------------------------------------------------------------------------------------------------

    def begin(
        self,
        effects: Sequence[Placed],
        starts: Sequence[Mapping[str, float]],
        base: Fit | None,
        hope: float = -np.inf,
    ) -> Begun | None:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        try:
            system = self.composed(effects)
            vectors = [_within(system, {**system.values(), **_known(system, start)}) for start in starts]
            substeps = int(np.median([self.substeps(system, values) for values in vectors]))
            for finer in range(EFFORT.finer):  # what diverges may do so by its steps alone
                passes = self.passes(system, substeps * 2**finer)
                likelihood, points = self._to_start(system, passes, vectors, starts, effects, base)
                tried = self._looked(likelihood, points, spare=base is not None, hope=hope)
                if tried:
                    detail = system, passes, likelihood, tried
                    return Begun(tuple(effects), -tried[0].nll, tried[0].parameters, detail, tried[0].pace)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):  # two transmissions at one joint, say
            return None
        return None

    def _to_start(
        self,
        system: Any,
        passes: Pass,
        vectors: Sequence[Mapping[str, float]],
        starts: Sequence[Mapping[str, float]],
        effects: Sequence[Placed],
        base: Fit | None,
    ) -> tuple[Likelihood, list[Point]]:
        """Return the likelihood of the estimation records and the points from which first steps are taken."""
        likelihood = self._likelihood(system, "estimation", passes)
        points = [
            Point(p, self._placed(self._starts(system, passes, p, "estimation", base), passes, start), noise)
            for p, start in zip(map(system.vector, vectors), starts, strict=True)
            for noise in self._noises(base, effects)
        ]
        gone = self._without(effects, base)
        if gone is not None:
            assert base is not None
            points = [self._back(system, passes, likelihood, point, {**base.values, **gone}, base) for point in points]
        if len(points) > EFFORT.points:
            points = sorted(points, key=likelihood.nll)[: EFFORT.points]
        if effects and not self.latent:  # no force took up what was missing: it has driven the parameters away
            p = system.vector({**vectors[0], **self.nominal.values()})
            noise = first_noises(self.noise_model, self._first_noise, self.dt)[0]
            points.append(Point(p, self._starts(system, passes, p, "estimation", None), noise))
        return likelihood, points if self.latent else [likelihood.concentrated(point) for point in points]

    @staticmethod
    def _placed(x0: list[FloatArray], passes: Pass, start: Mapping[str, float]) -> list[FloatArray]:
        """Return initial states with those that a start names."""
        names = passes.state_names
        return [
            np.array([start.get(_state(number, name), value) for name, value in zip(names, state, strict=True)])
            for number, state in enumerate(x0)
        ]

    @staticmethod
    def _without(effects: Sequence[Placed], base: Fit | None) -> dict[str, float] | None:
        """Return the values at which what a base lacks vanishes; None where there is no such place."""
        if base is None:
            return None
        present = {str(placed) for placed in base.effects}
        fresh = [placed for placed in effects if str(placed) not in present]
        if not fresh or len(fresh) + len(present) > len(effects) or not all(placed.effect.vanishes for placed in fresh):
            return None
        return {
            placed.name(parameter.name): parameter.neutral
            for placed in fresh
            for parameter in placed.effect.parameters
            if parameter.neutral is not None
        }

    def _back(
        self, system: Any, passes: Pass, likelihood: Likelihood, point: Point, gone: Mapping[str, float], base: Fit
    ) -> Point:
        """Return a start, or the likeliest place on the way back from it to the base if it is worse than that.

        A first-order step may lead far beyond what it holds for; the base itself is always a start.
        """
        best, least = point, likelihood.nll(point)
        enough = -base.log_likelihood("estimation")
        values = dict(zip(system.parameter_names, map(float, point.p), strict=True))
        p = system.vector(_within(system, {**values, **_known(system, gone)}))
        x0 = self._starts(system, passes, p, "estimation", base)
        for part in EFFORT.parts:
            if least < enough:
                break
            starts = [old + part * (new - old) for old, new in zip(x0, point.x0, strict=True)]
            trial = Point(p + part * (point.p - p), starts, point.noise)
            value = likelihood.nll(trial)
            if value < least:
                best, least = trial, value
        return best

    def _looked(
        self,
        likelihood: Likelihood,
        points: Sequence[Point],
        *,
        spare: bool = True,
        free: Sequence[str] | None = None,
        hope: float = -np.inf,
    ) -> list[LikelihoodFit]:
        """Return where first steps lead from some points, likeliest first; those that fall behind take fewer.

        Everything stands on the nominal model: no step is spared there.
        """
        halved = spare and (len(points) > 1 or hope > -np.inf)
        tried = self._stepped(likelihood, points, EFFORT.looks if halved else EFFORT.first_steps, free)
        near = [fit for fit in tried if halved and fit.nll < tried[0].nll + EFFORT.close]
        if any(not fit.converged and -fit.nll + EFFORT.first_steps * fit.pace >= hope for fit in near):
            more = self._stepped(likelihood, [fit.point for fit in near], EFFORT.first_steps - EFFORT.looks, free)
            tried = sorted([*more, *tried[len(near) :]], key=lambda fit: fit.nll)
        return tried

    @staticmethod
    def _stepped(
        likelihood: Likelihood, points: Sequence[Point], most: int, free: Sequence[str] | None = None
    ) -> list[LikelihoodFit]:
        """Return where a few steps lead from each point, likeliest first; without those that cannot be simulated."""
        fits: list[LikelihoodFit] = []
        for point in points:
            try:
                fits.append(likelihood.maximise(point, most=most, free=free, exact=False))
            except (FitError, ArithmeticError, np.linalg.LinAlgError):
                continue
        return sorted(fits, key=lambda fit: fit.nll)

    def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None) -> Fit | None:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        system, passes, likelihood, tried = begun.detail
        reach = np.inf if rival is None else EFFORT.margin - rival.log_likelihood("estimation")
        try:
            near = [fit for fit in tried if fit.nll < tried[0].nll + EFFORT.close]
            ends = [likelihood.maximise(fit.point, reach=reach, near=fit.converged) for fit in near[:2]]
            best = min(ends, key=lambda fit: fit.nll)
            best = best if best.converged or best.beyond else likelihood.maximise(best.point, reach=reach)
            for _ in range(EFFORT.finer):  # coarse steps keep a fit from where its law is fast
                needed = self.substeps(system, {**system.values(), **_known(system, best.parameters)})
                if needed <= passes.substeps or best.beyond:
                    break
                passes = self.passes(system, needed)
                best = self._likelihood(system, "estimation", passes).maximise(best.point, reach=reach)
            own, told, expected = self._validated(system, passes, best, base)
            outside = self._outside(system, passes, expected.point, told)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
            return None
        return None if outside is None else self._fitted(
            begun.effects, system, passes, best, own, outside, expected, told
        )  # fmt: skip

    def record(self, fit: Fit) -> dict[str, Any]:
        """Return a finished fit as plain numbers."""
        detail: Detail = fit.detail
        return {
            "best": fit_record(detail.best),
            "validation": point_record(detail.points["validation"]),
            "moved": detail.predictive.moved.tolist(),
            "price": detail.predictive.price,
            "own": fit.own,
            "told": [[p.tolist() for p in sides] for sides in detail.told],
            "substeps": detail.passes.substeps,
        }

    def restored(self, effects: Sequence[Placed], record: Mapping[str, Any]) -> Fit | None:
        """Return the fit of a record; None if it cannot be filtered."""
        system = self.composed(effects)
        passes = self.passes(system, int(record["substeps"]))
        best = fit_from_record(record["best"], self._likelihood(system, "estimation", passes))
        point = point_from_record(record["validation"])
        told = [(np.array(first), np.array(second)) for first, second in record["told"]]
        outside = self._outside(system, passes, point, told)
        if best is None or outside is None:
            return None
        expected = Predictive(point, np.array(record["moved"], dtype=float), float(record["price"]))
        return self._fitted(effects, system, passes, best, dict(record["own"]), outside, expected, told)

    def fit(
        self,
        effects: Sequence[Placed],
        starts: Sequence[Mapping[str, float]],
        base: Fit | None,
        rival: Fit | None = None,
    ) -> Fit | None:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        begun = self.begin(effects, starts, base)
        return None if begun is None else self.finish(begun, base, rival)

    def _fitted(
        self,
        effects: Sequence[Placed],
        system: Any,
        passes: Pass,
        best: LikelihoodFit,
        own: dict[str, float],
        outside: list[Filtered],
        expected: Predictive,
        told: list[tuple[FloatArray, FloatArray]],
    ) -> Fit:
        """Return the fit as the search wants it.

        Initial states do not count: what is known of one comes from the first moments of a record and does not grow
        with its length, as that of a parameter does whose price is half the logarithm of the samples (Schwarz 1978).
        """
        names = set(system.parameter_names)
        counted = [name for name in best.names if not name.startswith("x0[")]
        each = expected.price / sum(len(record) for record in self.records["validation"])
        fit = Fit(
            tuple(effects),
            system,
            best.parameters,
            tuple(name for name in best.names if name in names),
            len(counted),
            {
                "estimation": [-terms for terms in best.terms],
                "validation": [-passed.terms - each for passed in outside],
            },
            {name: best.deviation(name) for name in best.names if name in names},
            frozenset(name for name, log in zip(best.names, best.logarithmic, strict=True) if log and name in names),
            best.converged,
            best.on_bound,
            own,
            detail=Detail({"estimation": best.point, "validation": expected.point}, passes, best, expected, told),
            beyond=best.beyond,
        )
        fit = replace(fit, change=lambda placed: self.change(fit, placed), braking=lambda at: self._braking(fit, at))
        repeating = [placed for placed in effects if "phi" in OWN.get(placed.effect.name, ())]
        if not (self.latent and best.converged and repeating):  # elsewhere the innovations are coloured
            return fit
        return replace(fit, wandering={str(placed): self._wandering(fit, placed) for placed in repeating})

    def change(self, fit: Fit, placed: Placed) -> float:
        """Return how much an effect changes of rates or readings along the estimation records, as a share of them."""
        less = self.composed([other for other in fit.effects if str(other) != str(placed)])
        rates = [coordinate.v for coordinate in self.nominal.coordinates] or range(self.nominal.nx)
        return changed_share(self._traces(fit, USES[:1])["estimation"], fit.system, less, list(rates))

    def _braking(self, fit: Fit, at: str) -> tuple[FloatArray, FloatArray] | None:
        """Return places along the motion of a coordinate, and the damping of all that brakes it there."""
        row = self.nominal.coordinate(at)
        x = np.concatenate([trace.x for trace in self._traces(fit, USES[:1])["estimation"]])
        return braking(fit.system, fit.values, at, x[:, row.q], x[:, row.v])

    def _wandering(self, fit: Fit, placed: Placed) -> float:
        """Return the evidence that the amplitude and the phase of a line change along the records."""
        line = placed.with_values({"omega": fit.values[placed.name("omega")]})
        waves = line_directions(self._traces(fit, USES), self.nominal, fit.values, line, self.sizes)
        pieces = [piece for wave in waves for piece in in_parts(wave, POLICY.line_parts)]
        return wandering(self.linearised(fit), self._answered(fit, pieces)) if pieces else 0.0

    def apart(self, fit: Fit) -> Apart | None:
        """Return how much likelier the validation records are with parameters of their own; None without latent forces.

        Free runs of processes have coloured errors: their evidence is overstated.
        """
        if not self.latent:
            return None
        likelihood = self._likelihood(fit.system, "validation", fit.detail.passes)
        point = fit.detail.points["validation"]
        try:
            before = likelihood.filtered(point)
            after = likelihood.maximise(point, exact=False)
        except (FitError, ArithmeticError, np.linalg.LinAlgError):
            return None
        if before is None:
            return None
        gains = [passed.terms - own for passed, own in zip(before, after.terms, strict=True)]
        moved = {}
        for name in fit.free:
            spread = float(np.hypot(fit.deviations[name], after.deviation(name) if name in after.names else 0.0))
            change = after.parameters[name] - fit.values[name]
            if name in fit.logarithmic:
                change = float(np.log(max(after.parameters[name], 1e-300) / max(fit.values[name], 1e-300)))
            if 0 < spread < np.inf:
                moved[name] = abs(change) / spread
        farthest = max(moved, key=lambda name: moved[name], default="")
        return Apart(float(sum(gain.sum() for gain in gains)), gains, farthest, after.parameters.get(farthest, np.nan))

    def with_deviations(self, fit: Fit) -> Fit:
        """Return a fit with deviations for a coloured error of its free runs; one with latent forces as it is."""
        if self.latent:
            return fit
        paths, _ = self.paths(fit, "estimation")
        count = len(fit.free)
        own = paths[0].j.shape[2] - count if paths[0].j is not None else 0
        wide = []
        for number, passed in enumerate(paths):
            j = np.zeros((*passed.e.shape, count + own * len(paths)))
            assert passed.j is not None
            j[..., :count] = passed.j[..., :count]
            j[..., count + number * own : count + (number + 1) * own] = passed.j[..., count:]
            wide.append(j)
        keep = [k for k in range(wide[0].shape[2]) if k >= count or fit.deviations[fit.free[k]] > 0]
        parts = [part[..., keep] for part in wide]
        covariance = robust_covariance([passed.e for passed in paths], parts, POLICY.order, self._floor)
        deviations = dict(fit.deviations)
        for k, column in enumerate(keep):
            if column < count and np.isfinite(fit.deviations[fit.free[column]]):
                name = fit.free[column]
                size = abs(fit.values[name]) if name in fit.logarithmic else 1.0
                deviations[name] = float(np.sqrt(max(covariance[k, k], 0.0)) / max(size, 1e-300))
        return replace(fit, deviations=deviations)

    def _likelihood(
        self, system: Any, use: str, passes: Pass, records: Sequence[Trajectory] | None = None
    ) -> Likelihood:
        rounding = [block.parameter for block in system.sampled if block.kind == "quantise"]
        return Likelihood(
            system,
            self.records[use] if records is None else records,
            self.noise_model,
            fixed=rounding,
            intersample=self.dataset.intersample,
            passes=passes,
        )

    def _validated(
        self, system: Any, passes: Pass, best: LikelihoodFit, base: Fit | None
    ) -> tuple[dict[str, float], list[tuple[FloatArray, FloatArray]], Predictive]:
        """Fit what belongs to the validation records; return it, what halves tell of phases, and what is expected.

        Initial states and noise belong to a record: a law that leaves one record without any latent force is not to
        be judged as if there could be none in another, where a motion that amplifies small errors has to be followed.
        """
        likelihood = self._likelihood(system, "validation", passes)
        own = [
            placed.name(name)
            for placed in system.effects
            for name in OWN.get(placed.effect.name, ())
            if not system.parameter(placed.name(name)).fixed
        ]
        free = [name for name in likelihood.names if name.startswith(("x0[", *NOISE))] + own
        noises = [best.point.noise] if base is None else [best.point.noise, base.detail.points["validation"].noise]
        longest = max(len(run) for run in self.records["validation"]) * self.dt
        points = []
        for part in EFFORT.own_starts if own else (0.0,):
            p = best.point.p.copy()
            for name in own:
                p[system.parameter_names.index(name)] = part * (2 * np.pi if name.endswith("phi") else longest)
            for origin in dict.fromkeys((base, None)):  # narrow friction may catch one of two starts
                x0 = self._starts(system, passes, p, "validation", origin)
                points.append(min((Point(p, x0, self._woken(noise, best)) for noise in noises), key=likelihood.nll))
        tried = self._looked(likelihood, points, free=free)
        if not tried:
            raise FitError(
                "validation", expected="a model that can be filtered", got="divergence", remedy="start elsewhere"
            )
        chosen = tried[0]
        if not chosen.converged:
            chosen = likelihood.maximise(chosen.point, free=free, exact=False)
        shared = [name for name in best.names if name in system.parameter_names]
        expected = predictive(likelihood, chosen.point, shared, spread_of(best, shared, own))
        phases = [name for name in own if name.endswith(".phi")]
        told = self._told_by_halves(system, passes, expected.point, phases) if phases else []
        return {name: chosen.parameters[name] for name in own}, told, expected

    def _told_by_halves(
        self, system: Any, passes: Pass, whole: Point, phases: Sequence[str]
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Return for every validation record the parameters with the phases that its first half tells, and its second.

        A phase that is fitted where it is judged would let any line of a spectrum pass for something periodic, but what
        repeats keeps its phase: each half is judged with that of the other.
        """
        told = []
        for record, x0 in zip(self.records["validation"], whole.x0, strict=True):
            sides: list[FloatArray] = []
            for half, start in ((record[: len(record) // 2], x0), (record[len(record) // 2 :], None)):
                part = self._likelihood(system, "validation", passes, records=[half])
                if start is None:
                    start = np.zeros(passes.start_size)
                    start[: self.nominal.nx] = self.first_state(system, half, whole.p)[: self.nominal.nx]
                free = [*phases, *(name for name in part.names if name.startswith("x0["))]
                sides.append(part.maximise(replace(whole, x0=[start]), free=free, most=25, exact=False).point.p)
            told.append((sides[0], sides[1]))
        return told

    def _outside(
        self, system: Any, passes: Pass, point: Point, told: Sequence[tuple[FloatArray, FloatArray]]
    ) -> list[Filtered] | None:
        """Return the passes over the validation records, each half with the phases that the other half tells."""
        paths = self._likelihood(system, "validation", passes).filtered(point)
        if paths is None or not told:
            return paths
        for passed, record, x0, (first, second) in zip(paths, self.records["validation"], point.x0, told, strict=True):
            middle = len(record) // 2
            for p, judged in ((second, slice(None, middle)), (first, slice(middle, None))):
                other = passes(record, p, x0, point.noise)
                if other is None:
                    return None
                passed.e[judged], passed.s[judged] = other.e[judged], other.s[judged]
        return paths

    def _noises(self, base: Fit | None, effects: Sequence[Placed] = ()) -> list[Noise]:
        """Return the noise to start from: that of the base, which other effects may change, else several."""
        if base is None:
            return first_noises(self.noise_model, self._first_noise, self.dt)
        noise = base.detail.points["estimation"].noise
        if effects and {*map(str, effects)} == {*map(str, base.effects)}:
            return [noise]
        return [self._woken(noise, base.detail.best)]

    def _woken(self, noise: Noise, seen: LikelihoodFit) -> Noise:
        """Return noise of which no part is lost, neither a latent force nor a sensor's: it may be needed elsewhere.

        A model that lacks much leaves its innovations to the force alone, as an equation error does, and where r has
        gone to 0 no derivative brings it back. Three tenths of the innovations are a tenth of their variance: little is
        lost where they are not needed, and where a law has taken up the force the next steps find them.
        """
        floor = 1e-3 * self.noise_model.force_scale
        spread = np.sqrt(np.median(np.concatenate([passed.s for passed in seen.filtered]), axis=0))
        r = np.maximum(noise.r, 0.3 * spread)
        return replace(noise, s=np.maximum(noise.s, floor), w=np.maximum(noise.w, 0.1 * floor), r=r)

    def _starts(self, system: Any, passes: Pass, p: FloatArray, use: str, base: Fit | None) -> list[FloatArray]:
        """Return initial states to start from: those of the base, new hidden states where their effects say."""
        starts = []
        names = [channel.name for channel in system.states]
        simulator = passes.simulator
        if base is not None and list(map(len, base.terms[use])) != list(map(len, self.records[use])):
            base = None  # of pieces of these records
        for number, record in enumerate(self.records[use]):
            x = np.zeros(passes.start_size)
            if base is None:
                x[: self.nominal.nx] = self.first_state(system, record, p)[: self.nominal.nx]
            else:
                old = [channel.name for channel in base.system.states]
                start = base.detail.points[use].x0[number]
                fresh = []
                for k, name in enumerate(names):
                    if name in old:
                        x[k] = start[old.index(name)]
                    else:
                        fresh.append(k)
                if fresh:
                    whole = np.concatenate([x, np.zeros(passes.nl)])
                    hidden = simulator.hidden_start(whole, record.u[0], p)
                    first = system.nx - system.hidden_count
                    for k in fresh:
                        x[k] = hidden[k - first]
            starts.append(x)
        return starts

    # ---- what the score test needs -----------------------------------------------------------------------------------

    def paths(self, fit: Fit, use: str) -> tuple[list[Filtered], list[Smoothed]]:
        """Return the pass of a fit over every record of a use, and the smoothed states; found once."""
        detail: Detail = fit.detail
        if use not in detail.paths:
            point = detail.points[use]
            names = [*fit.system.parameter_names]
            free = set(fit.free)
            columns = np.array(
                [k for k, name in enumerate(names) if name in free]
                + list(range(detail.passes.parameter_count, detail.passes.parameter_count + detail.passes.start_size)),
                dtype=np.intp,
            )
            paths = [
                detail.passes(record, point.p, x0, point.noise, columns=columns, keep=True)
                for record, x0 in zip(self.records[use], point.x0, strict=True)
            ]
            if any(passed is None for passed in paths):
                raise FitError("filter", expected="a finite state", got="divergence", remedy="refit the model")
            detail.paths[use] = [passed for passed in paths if passed is not None]
            detail.smooth[use] = [self.smooth(passed) for passed in detail.paths[use]]
        return detail.paths[use], detail.smooth[use]

    def forgetful(self, fit: Fit) -> Fit | None:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        if not self.latent:
            return None
        longest = max(len(run) for run in self.records["estimation"]) * self.dt
        noise = fit.detail.points["estimation"].noise
        slow = (noise.tau > EFFORT.memory * longest) & (noise.s > EFFORT.negligible * self.noise_model.force_scale)
        if not slow.any():
            return None
        points = {}
        for use, point in fit.detail.points.items():
            tau = np.where(slow, 0.1 * EFFORT.memory * longest, point.noise.tau)
            s = point.noise.s * np.sqrt(np.minimum(tau / point.noise.tau, 1.0))
            points[use] = replace(point, noise=replace(point.noise, s=s, tau=tau))
        return replace(fit, detail=replace(fit.detail, points=points, paths={}, smooth={}))

    def linearised(self, fit: Fit) -> Linearised:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        residual, nuisance = {}, {}
        count = len(fit.free)
        for use in USES:
            paths, _ = self.paths(fit, use)
            residual[use] = np.concatenate([whitened(passed.e, passed.s) for passed in paths])
            parts = []
            for number, passed in enumerate(paths):
                assert passed.j is not None
                j = whitened(passed.j, passed.s[..., None])
                wide = np.zeros((len(j), count + len(paths) * (j.shape[1] - count)))
                states = j.shape[1] - count
                wide[:, :count] = j[:, :count]
                wide[:, count + number * states : count + (number + 1) * states] = j[:, count:]
                parts.append(wide)
            nuisance[use] = np.concatenate(parts)
        own = [placed.name(name) for placed in fit.effects for name in OWN.get(placed.effect.name, ())]
        spread = spread_of(fit.detail.best, fit.free, own)
        point: Point = fit.detail.points["estimation"]
        states = _states(fit.detail.passes, point)
        return Linearised(residual, nuisance, tuple(fit.free), spread, fit.detail.predictive.moved, states)

    def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        traces = self._traces(fit, ("estimation",))
        return self._answered(fit, directions(traces, self.nominal, fit.values, candidates, self.sizes))

    def test_functions(self, fit: Fit) -> list[Column]:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        return self._answered(fit, test_functions(self._traces(fit, USES), self.nominal))

    def suspects(self, base: Fit, rival: Begun | None, candidates: Sequence[Placed]) -> list[Suspect]:
        """See :class:`harness.diagnosis.search.fit.Form`: hidden resonances, play, lost signs."""
        point: Point = base.detail.points["estimation"] if rival is None else rival.detail[3][0].point
        noise = point.noise
        left = np.sqrt(noise.s**2 + noise.w**2) / self.noise_model.force_scale
        suspects = []
        lighter: dict[tuple[str, float], dict[str, float]] = {}
        for placed in candidates if left.max(initial=0.0) > EFFORT.negligible else ():
            if placed.effect.linearises or port_of(self.nominal, placed).kind != "coordinate":
                continue
            at = self.sizes.get(placed.at, {})
            free = [parameter for parameter in placed.effect.parameters if not parameter.fixed]
            grids = itertools.product(*(parameter.starts(at) for parameter in free))
            starts = [
                {placed.name(parameter.name): v for parameter, v in zip(free, choice, strict=True)} for choice in grids
            ]
            suspects.append(
                Suspect(placed, tuple({**self._lightened(base, placed, start, lighter), **start} for start in starts))
            )
        return suspects + self._piled_up(base, candidates) + self._lost_signs(base, candidates)

    def _lightened(
        self, base: Fit, placed: Placed, start: Mapping[str, float], known: dict[tuple[str, float], dict[str, float]]
    ) -> dict[str, float]:
        """Return the nominal parameters that leave a motor's inertia out of what it drives; ``known`` is added to.

        The nominal fit holds both. Left as it is, the plant is too heavy by the motor, and a fit makes that small.
        """
        inertias = [
            start[placed.name(parameter.name)] for parameter in placed.effect.parameters if parameter.unit == "F/a"
        ]
        if not inertias:
            return {}
        key = placed.at, sum(inertias)
        if key not in known:
            free = [name for name in base.free if name in self.nominal.parameter_names]
            traces = self._traces(base, USES[:1])[USES[0]]
            known[key] = lightened(traces, self.nominal, base.values, free, *key)
        return known[key]

    def _piled_up(self, base: Fit, candidates: Sequence[Placed]) -> list[Suspect]:
        """Return sensors whose readings pile up at their largest value, to start from there.

        A nominal model that was made to follow the ceiling is no start: it is fitted to what lies below it first.
        """
        names = [channel.name for channel in self.nominal.outputs]
        # a model that does not fit at all may blame a force for everything, and nothing on the sensor
        noise = np.maximum(base.detail.points["estimation"].noise.r, self._first_noise)
        suspects = []
        for placed in candidates:
            main = placed.effect.main
            limits = main is not None and main.unit == "y" and main.neutral is None and main.minimum >= 0
            if not limits or main is None or placed.at not in names:
                continue
            column = names.index(placed.at)
            size = np.abs(np.concatenate([record.y[:, column] for record in self.records["estimation"]]))
            top = float(np.nanmax(size))
            ceiling = top - EFFORT.pile_width * float(noise[column])
            piled = size[size > ceiling]
            if len(piled) <= EFFORT.pile * len(size):
                continue
            start = {placed.name(main.name): float(np.median(piled))}
            anew = None if base.effects else self._from_uncut(placed, column, ceiling, start)
            suspects.append(Suspect(placed, (start if anew is None else anew.values,), anew))
        return suspects

    def _from_uncut(self, placed: Placed, column: int, ceiling: float, start: dict[str, float]) -> Fit | None:
        """Return the fit with a sensor's ceiling that starts from the nominal fit to what lies below it.

        Parameters stay there until the initial states and the noise of the whole records have been found.
        """
        below = uncut(self.dataset, column, ceiling)
        plain = None if below is None else self.on(below).fit((), self.first_starts(), None)
        if plain is None:
            return self.fit([placed], [first | start for first in self.first_starts()], None)
        try:
            system = self.composed([placed])
            passes = self.passes(system, self.substeps(system, {**system.values(), **plain.values, **start}))
            likelihood = self._likelihood(system, "estimation", passes)
            p = system.vector(_within(system, {**system.values(), **plain.values, **start}))
            x0 = self._starts(system, passes, p, "estimation", None)
            free = [name for name in likelihood.names if name not in self.nominal.parameter_names]
            tried = self._stepped(likelihood, [Point(p, x0, noise) for noise in self._noises(None)], _LONG, free)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
            return None
        if not tried:
            return None
        held = tried[0]
        detail = system, passes, likelihood, [replace(held, converged=False)]
        return self.finish(Begun((placed,), -held.nll, held.parameters, detail, held.pace), plain)

    def _lost_signs(self, base: Fit, candidates: Sequence[Placed]) -> list[Suspect]:
        """Return sensors that may have lost a sign, with the fit of the nominal model to the unfolded output."""
        names = [channel.name for channel in self.nominal.outputs]
        suspects: list[Suspect] = []
        for placed in candidates if not base.effects else ():
            if placed.effect.name not in HIDING or placed.at not in names:
                continue
            column = names.index(placed.at)
            runs = [*self.records["estimation"], *self.records["validation"]]
            best: Fit | None = None
            for signs in unfoldings(runs, column, most=2):
                if any(len(sign) != len(run) for sign, run in zip(signs.signs, runs, strict=True)):
                    continue
                form = self.on(self._unfolded(signs.signs, column))
                plain = form.fit((), form.first_starts(), None)
                if plain is not None and (best is None or plain.penalised > best.penalised):
                    best = plain
            if best is not None:
                suspects.append(Suspect(placed, ({},), best))
        return suspects

    def _unfolded(self, signs: Sequence[FloatArray], column: int) -> Dataset:
        """Return the data with the signs of one output."""
        given = iter(signs)
        runs = []
        for use in USES:
            for record in self.records[use]:
                y = record.y.copy()
                y[:, column] *= next(given)
                runs.append(Run(replace(record, y=y), use))  # type: ignore[arg-type]
        return replace(self.dataset, runs=tuple(runs))

    def _traces(self, fit: Fit, uses: Sequence[str]) -> dict[str, list[Trace]]:
        """Return the smoothed motion of every record of some uses."""
        detail: Detail = fit.detail
        if self.latent:
            ports = tuple(force.port for force in detail.passes.forces)
        else:
            ports = tuple(state.name for state in self.nominal.states)
        traces: dict[str, list[Trace]] = {}
        for use in uses:
            _, smooth = self.paths(fit, use)
            traces[use] = [
                Trace(record, motion.x, detail.passes, detail.points[use].p, ports)
                for record, motion in zip(self.records[use], smooth, strict=True)
            ]
        return traces

    def _held(self, placed: Placed | None) -> bool:
        """Return True for a law without memory at an input that is held between samples: its force is held too."""
        if placed is None or port_of(self.nominal, placed).kind != "input" or self.dataset.intersample != "zoh":
            return False
        return not (placed.effect.states or placed.effect.sampled)

    def _answered(self, fit: Fit, asked: Any) -> list[Column]:
        """Return the columns of directions (lists of forces and readings by use and record)."""
        if not asked:
            return []
        paths = {use: self.paths(fit, use)[0] for use in asked[0].forces}
        return [column for group in _portions(asked) for column in self._together(paths, group)]

    def _together(self, paths: Mapping[str, Sequence[Filtered]], group: Sequence[Direction]) -> list[Column]:
        """Return the columns of a few directions."""
        edges = np.cumsum([0, *(len(direction.names) for direction in group)])
        held = np.repeat([self._held(direction.placed) for direction in group], np.diff(edges))
        over = None if self.latent else self.dt
        made = dict.fromkeys(USES, np.zeros((0, edges[-1])))
        for use, filtered in paths.items():
            parts = []
            for number, passed in enumerate(filtered):
                forces = np.concatenate([direction.forces[use][number] for direction in group], axis=2)
                readings = np.concatenate([direction.readings[use][number] for direction in group], axis=2)
                response = innovation_response(passed, forces, readings, rates_over=over, held=held)
                parts.append(whitened(response, passed.s[..., None]))
            made[use] = np.concatenate(parts)
        return [
            Column(direction.placed, direction.given, direction.names, *(made[use][:, first:last] for use in USES))
            for direction, first, last in zip(group, edges[:-1], edges[1:], strict=True)
        ]


def _portions(asked: Sequence[Direction]) -> list[list[Direction]]:
    """Return directions in groups of few enough columns to stay in the cache."""
    groups: list[list[Direction]] = []
    size = _TOGETHER
    for direction in asked:
        size += len(direction.names)
        if size > _TOGETHER:
            groups.append([])
            size = len(direction.names)
        groups[-1].append(direction)
    return groups


def _state(number: int, name: str) -> str:
    """Return the name of an initial state of a record, as :class:`Likelihood` has it."""
    return f"x0[{number}].{name}"


def _states(passes: Pass, point: Point) -> dict[str, float]:
    """Return the initial states of all records by name."""
    return {
        _state(number, name): float(value)
        for number, x0 in enumerate(point.x0)
        for name, value in zip(passes.state_names, x0, strict=True)
    }


def _known(system: Any, values: Mapping[str, float]) -> dict[str, float]:
    """Return the values of parameters that the system has."""
    names = set(system.parameter_names)
    return {name: value for name, value in values.items() if name in names}


def _within(system: Any, values: dict[str, float]) -> dict[str, float]:
    """Return values within the bounds."""
    return {
        parameter.name: float(np.clip(values[parameter.name], parameter.minimum, parameter.maximum))
        for parameter in system.parameters
    }
