"""The likelihood as a form of the search: fits to estimation records, and what they say of validation records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Generic, Self, cast

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.forms.apart import Apart, most_apart
from harness.diagnosis.forms.first_steps import from_instants, hopeful, in_sight, looked, settled, stepped
from harness.diagnosis.forms.fit_records import (
    LikelihoodDetail,
    fit_from_record,
    fit_record,
    likelihood_detail,
    point_from_record,
    point_record,
)
from harness.diagnosis.forms.halves import judged_by_halves, told_by_halves
from harness.diagnosis.forms.innovations import linearised
from harness.diagnosis.forms.named import (
    awake,
    beside,
    day_groups,
    known,
    nuisances,
    per_record,
    state_name,
    state_values,
    within,
)
from harness.diagnosis.forms.predictive import PredictiveDensity, day_values, predicted, spread_of
from harness.diagnosis.forms.robust import coloured_deviations
from harness.diagnosis.forms.suspects import lost_signs, piled_up
from harness.diagnosis.forms.system_form import SystemForm
from harness.diagnosis.policy import POLICY
from harness.diagnosis.search.fit import Begun, Fit, InOneGo, Linearised, Suspect
from harness.diagnosis.systems import AnySystem, Starts, SystemT
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed
from harness.errors import FitError, HarnessError
from harness.physics.compiled.kalman_pass import Filtered, Pass, PassNoise
from harness.physics.compiled.smoother import SmoothedStates
from harness.physics.fitting.likelihood import Likelihood
from harness.physics.fitting.likelihood_fit import LONGEST, first_noises, sensor_noise
from harness.physics.fitting.maximum import LikelihoodFit, NoiseModel, Point
from harness.signals import Dataset, FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

NOISE = ("s@", "tau@", "w@", "r@")
USES = ("estimation", "validation")
ROUNDING = np.sqrt(12.0)  # Step of a grid over the deviation of what is rounded to it.
_LONG = 60  # Iterations of a fit that is to come to its end.


@dataclass(frozen=True, eq=False)
class FirstSteps(Generic[SystemT]):
    """What a fit of the likelihood goes on from: the system, its filter, and where the first steps led, best first."""

    system: SystemT
    passes: Pass
    likelihood: Likelihood
    tried: list[LikelihoodFit]


class LikelihoodForm(InOneGo, SystemForm[SystemT]):
    """Fits a system with effects to a data set by maximum likelihood; the kinds of systems are its subclasses.

    Parameters
    ----------
    system : System or FmuSystem
        The nominal one.
    dataset : Dataset
    sizes : mapping
        Sizes of the data by port, see :func:`harness.effects.columns.motion_sizes`.
    laws : Dictionary, optional
        The effects of the run; the built-in ones if not given.
    """

    def __init__(
        self,
        system: SystemT,
        dataset: Dataset,
        sizes: Mapping[str, Mapping[str, float]],
        laws: Dictionary | None = None,
    ) -> None:
        self.nominal, self.dataset, self.sizes = system, dataset, sizes
        self.laws = Dictionary.builtin() if laws is None else laws
        self.latent = self.has_latent_forces()
        self.records: dict[str, list[Trajectory]] = {
            use: [run.measured() for run in dataset.using(use)]  # type: ignore[arg-type]
            for use in USES
        }
        self.dt = dataset.spec.sample_time
        longest = max(len(run) for run in self.records["estimation"]) * self.dt
        y = np.concatenate([run.y for run in self.records["estimation"]])
        self.noise_model = NoiseModel(
            self.force_scale(),
            np.maximum(y.std(axis=0), 1e-12),
            latent=self.latent,
            white=self.latent,
            shortest=self.dt,
            longest=max(longest / LONGEST, 2 * self.dt),
            least=np.array([dataset.resolution.get(channel.name, 0.0) for channel in dataset.spec.outputs]) / ROUNDING,
        )
        self._first_noise = np.maximum(sensor_noise(self.records["estimation"]), self.noise_model.smallest)
        self._floor = self.noise_model.smallest

    def on(self, dataset: Dataset) -> Self:
        """Return the same form of other data."""
        return type(self)(self.nominal, dataset, self.sizes, self.laws)

    # ---- fits ------------------------------------------------------------------------------------------------------

    def begin(self, effects: Sequence[Placed], starts: Starts, base: Fit | None, hope: float = -np.inf) -> Begun | None:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        if self.spent(effects, base, EFFORT.seconds):
            return None
        try:
            system = self.composed(effects)
            vectors = [within(system, awake(system, known(system, start))) for start in starts]
            substeps = int(np.median([self.substeps(system, values) for values in vectors]))
            if base is not None and self._within_it(base, effects):
                least = likelihood_detail(base).passes.substeps  # coarser ones would be compared with finer ones
                substeps = max(substeps, least)
            for finer in range(EFFORT.finer):  # what diverges may do so by its steps alone
                passes = self.passes(system, substeps * 2**finer)
                likelihood, points = self._to_start(system, passes, vectors, starts, effects, base)
                tried = looked(likelihood, points, spare=base is not None, hope=hope)
                if tried:
                    detail, first = FirstSteps(system, passes, likelihood, tried), tried[0]
                    return Begun(tuple(effects), -first.nll, first.parameters, detail, first.pace, system)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):  # two transmissions at one joint, say
            return None
        return None

    def _to_start(
        self,
        system: SystemT,
        passes: Pass,
        vectors: Sequence[Mapping[str, float]],
        starts: Starts,
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
        if effects and self.astray(base):
            p = system.vector({**vectors[0], **self.nominal.values()})
            noise = first_noises(self.noise_model, self._first_noise, self.dt)[0]
            points.append(Point(p, self._starts(system, passes, p, "estimation", None), noise))
        if base is None and effects and self.latent:  # values that were fitted to other readings
            points = settled(likelihood, points)
        return likelihood, points if self.latent else [likelihood.concentrated(point) for point in points]

    @staticmethod
    def _placed(x0: list[FloatArray], passes: Pass, start: Mapping[str, float]) -> list[FloatArray]:
        """Return initial states with those that a start names."""
        names = passes.state_names
        return [
            np.array([start.get(state_name(number, name), value) for name, value in zip(names, state, strict=True)])
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
            if parameter.neutral is not None and parameter.role != "step"
        }

    def _back(
        self, system: SystemT, passes: Pass, likelihood: Likelihood, point: Point, gone: Mapping[str, float], base: Fit
    ) -> Point:
        """Return a start, or the likeliest place on the way back from it to the base if it is worse than that.

        A first-order step may lead far beyond what it holds for; the base itself is always a start.
        """
        best, least = point, likelihood.nll(point)
        enough = -base.log_likelihood("estimation")
        values = dict(zip(system.parameter_names, map(float, point.p), strict=True))
        p = system.vector(within(system, {**values, **known(system, gone)}))
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

    def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, least: float = -np.inf) -> Fit | None:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        if self.spent(begun.effects, base, EFFORT.ending):
            return None
        first = begun.detail
        assert isinstance(first, FirstSteps)
        system, passes, likelihood, tried = first.system, first.passes, first.likelihood, first.tried
        bars = [
            fit for fit in (rival, base) if fit is not None and (fit is rival or self._within_it(fit, begun.effects))
        ]
        reach = EFFORT.margin - max((fit.log_likelihood("estimation") for fit in bars), default=-np.inf)
        close = np.inf if rival is None else EFFORT.close - rival.log_likelihood("estimation")
        try:
            ends = [likelihood.maximise(fit, reach=reach, exact=False) for fit in in_sight(tried)[:2]]
            best = min(ends, key=lambda fit: fit.nll)
            best = best if best.converged or best.beyond else likelihood.maximise(best, reach=reach, exact=False)
            for _ in range(EFFORT.finer):  # coarse steps keep a fit from where its law is fast
                needed = self.substeps(system, {**system.values(), **known(system, best.parameters)})
                if needed <= passes.substeps or best.beyond:
                    break
                finer = self.passes(system, needed)
                likelihood = self._likelihood(system, "estimation", finer)
                followed = likelihood.maximise(best.point, reach=reach, exact=False)
                if followed.beyond:  # what the coarse ones seemed to gain was their own error
                    best = replace(best, converged=False, beyond=True)
                    break
                best, passes = hopeful(followed, least), finer
            best = likelihood.past_forces(from_instants(likelihood, hopeful(best, least), reach=reach))
            if best.nll < close and not best.beyond:  # elsewhere nothing is decided by what the last steps add
                best = likelihood.maximise(best, reach=reach, near=best.converged)
            own, told, expected = self._validated(system, passes, best, base)
            outside = self._outside(system, passes, expected.point, told)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
            return None
        return None if outside is None else self._fitted(
            begun.effects, system, passes, best, own, outside, expected, told
        )  # fmt: skip

    def _within_it(self, base: Fit, effects: Sequence[Placed]) -> bool:
        """Return True for a base that a model with these effects contains: it cannot explain the records worse."""
        return {str(placed) for placed in base.effects} <= self.laws.contained(effects)

    def spent(self, effects: Sequence[Placed], base: Fit | None, seconds: float) -> bool:
        """Return whether a search has cost this much, before effects are fitted beside a base; only an FMU's may."""
        return False

    def astray(self, base: Fit | None) -> bool:
        """Return whether a base may have been driven away by what it lacks, as no latent force took that up."""
        return not self.latent

    def left_out(self) -> list[str]:
        """See :class:`harness.diagnosis.search.fit.Form`: everything was tried."""
        return []

    def record(self, fit: Fit) -> dict[str, Any]:
        """Return a finished fit as plain numbers."""
        detail = likelihood_detail(fit)
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
        expected = PredictiveDensity(point, np.array(record["moved"], dtype=float), float(record["price"]))
        return self._fitted(effects, system, passes, best, dict(record["own"]), outside, expected, told)

    def _fitted(
        self,
        effects: Sequence[Placed],
        system: SystemT,
        passes: Pass,
        best: LikelihoodFit,
        own: dict[str, float],
        outside: list[Filtered],
        expected: PredictiveDensity,
        told: list[tuple[FloatArray, FloatArray]],
    ) -> Fit:
        """Return the fit as the search wants it.

        Initial states do not count: what is known of one comes from the first moments of a record and does not grow
        with its length, as that of a parameter does whose price is half the logarithm of the samples (Schwarz 1978).
        Nor does a smoothing width or the like of which the data say nothing: it lies on its bound, or is not known to a
        factor e.
        """
        names = set(system.parameter_names)
        idle = {*state_values(passes, best.point), *nuisances(effects, best)}
        counted = [name for name in best.names if name not in idle]
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
            own=own,
            day=day_values(effects, best.parameters, expected.moved),
            innovations={
                "estimation": [(passed.e, passed.s) for passed in best.filtered],
                "validation": [(passed.e, passed.s) for passed in outside],
            },
            detail=LikelihoodDetail(
                {"estimation": best.point, "validation": expected.point}, passes, best, expected, told
            ),
            beyond=best.beyond,
            free_run=not self.latent,
            beside=beside(effects, best),
            unseen=self.unseen(system, best.parameters),
        )
        repeating = [placed for placed in effects if per_record([placed], "phase")]
        if not (self.latent and best.converged and repeating):  # elsewhere the innovations are coloured
            return fit
        return replace(fit, line_rivals={str(placed): self.line_rivals_of(fit, placed) for placed in repeating})

    def with_day(self, fit: Fit) -> Fit:
        """See :class:`harness.diagnosis.forms.form.WholeForm`."""
        if not day_groups(fit.effects):
            return fit
        detail, system = likelihood_detail(fit), cast("SystemT", fit.system)
        start = replace(detail.points["validation"], p=system.vector({**fit.values, **fit.own}))
        likelihood = self._likelihood(fit.model, "validation", detail.passes)
        try:
            expected = predicted(likelihood, start, detail.best, fit.free, list(fit.own), fit.effects)
        except (FitError, ArithmeticError, np.linalg.LinAlgError):
            return fit
        outside = self._outside(system, detail.passes, expected.point, detail.told)
        rest = detail.best, fit.own, outside or [], expected, detail.told
        return fit if outside is None else self._fitted(fit.effects, system, detail.passes, *rest)

    def apart(self, fit: Fit) -> Apart | None:
        """See :class:`harness.diagnosis.forms.form.WholeForm`; coloured errors of free runs overstate evidence."""
        if not self.latent:
            return None
        passes = likelihood_detail(fit).passes
        return most_apart(lambda use, runs: self._likelihood(fit.model, use, passes, runs), fit, self.records)

    def with_deviations(self, fit: Fit) -> Fit:
        """Return a fit with deviations for a coloured error of its free runs; one with latent forces as it is."""
        if self.latent:
            return fit
        return coloured_deviations(fit, self.paths(fit, "estimation")[0], POLICY.order, self._floor)

    def _likelihood(
        self, system: AnySystem, use: str, passes: Pass, records: Sequence[Trajectory] | None = None
    ) -> Likelihood:
        rounding = [block.parameter for block in system.sampled if block.kind == "quantise"]
        return Likelihood(
            cast("System", system),  # with passes of its own it asks for names, values and bounds only
            self.records[use] if records is None else records,
            self.noise_model,
            fixed=rounding,
            intersample=self.dataset.intersample,
            passes=passes,
        )

    def _validated(
        self, system: SystemT, passes: Pass, best: LikelihoodFit, base: Fit | None
    ) -> tuple[dict[str, float], list[tuple[FloatArray, FloatArray]], PredictiveDensity]:
        """Fit what belongs to the validation records; return it, what halves tell of phases, and what is expected.

        Initial states and noise belong to a record: a law that leaves one record without any latent force is not to
        be judged as if there could be none in another, where a motion that amplifies small errors has to be followed.
        """
        likelihood = self._likelihood(system, "validation", passes)
        own = [name for name in per_record(system.effects) if not system.parameter(name).fixed]
        turning = set(per_record(system.effects, "phase"))
        free = [name for name in likelihood.names if name not in system.parameter_names] + own
        points = self._outside_starts(likelihood, best, base, own, turning)
        enough = min(value for value, _ in points) + EFFORT.close
        tried = looked(likelihood, [point for value, point in points if value <= enough], free=free)
        before = -np.inf if base is None else base.log_likelihood("validation")
        if not tried or -tried[0].nll < before:  # worse than without what was added: a start may be the cause
            others = looked(likelihood, [point for value, point in points if value > enough], free=free)
            tried = sorted([*tried, *others], key=lambda fit: fit.nll)
        if not tried:
            raise FitError(
                "validation", expected="a model that can be filtered", got="divergence", remedy="start elsewhere"
            )
        chosen = tried[0]
        if not chosen.converged:
            chosen = likelihood.maximise(chosen, free=free, exact=False)
        chosen = from_instants(likelihood, chosen, free=free)
        shared = [name for name in best.names if name in system.parameter_names]
        expected = predicted(likelihood, chosen.point, best, shared, own, system.effects, before)
        phases = [name for name in own if name in turning]
        told = self._told_by_halves(system, passes, expected.point, phases) if phases else []
        return {name: chosen.parameters[name] for name in own}, told, expected

    def _outside_starts(
        self, likelihood: Likelihood, best: LikelihoodFit, base: Fit | None, own: Sequence[str], turning: set[str]
    ) -> list[tuple[float, Point]]:
        """Return where the fit of what belongs to the validation records starts from, each with its value.

        What the base knows of them stays where it is; of the rest nothing is known.
        """
        system, passes = cast("SystemT", likelihood.system), likelihood.filter
        noises = [best.point.noise]
        if base is not None:
            noises.append(likelihood_detail(base).points["validation"].noise)
        longest = max(len(run) for run in self.records["validation"]) * self.dt
        known = {} if base is None else {name: base.own[name] for name in own if name in base.own}
        points: list[tuple[float, Point]] = []
        for part in EFFORT.own_starts if len(known) < len(own) else (0.0,):
            p = best.point.p.copy()
            for name in own:
                looked_for = part * (2 * np.pi if name in turning else longest)
                p[system.parameter_names.index(name)] = known.get(name, looked_for)
            for origin in dict.fromkeys((base, None)):  # narrow friction may catch one of two starts
                x0 = self._starts(system, passes, p, "validation", origin)
                tries = [Point(p, x0, self._woken(noise, best)) for noise in noises]
                points.append(min(((likelihood.nll(point), point) for point in tries), key=lambda pair: pair[0]))
        return points

    def _told_by_halves(
        self, system: SystemT, passes: Pass, whole: Point, phases: Sequence[str]
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Return for every validation record the parameters with the phases that its first half tells, and its second.

        Initial states beyond those of the nominal model start at 0.
        """

        def likelihood(half: Trajectory) -> Likelihood:
            return self._likelihood(system, "validation", passes, records=[half])

        def first_state(half: Trajectory) -> FloatArray:
            start = np.zeros(passes.start_size)
            start[: self.nominal.nx] = self.first_state(system, half, whole.p)[: self.nominal.nx]
            return start

        return told_by_halves(self.records["validation"], whole, phases, likelihood, first_state)

    def _outside(
        self, system: SystemT, passes: Pass, point: Point, told: Sequence[tuple[FloatArray, FloatArray]]
    ) -> list[Filtered] | None:
        """Return the passes over the validation records, each half with the phases that the other half tells."""
        paths = self._likelihood(system, "validation", passes).filtered(point)
        if paths is None or not told:
            return paths
        return judged_by_halves(paths, passes, self.records["validation"], point, told)

    def _noises(self, base: Fit | None, effects: Sequence[Placed] = ()) -> list[PassNoise]:
        """Return the noise to start from: that of the base, which other effects may change, else several."""
        if base is None:
            return first_noises(self.noise_model, self._first_noise, self.dt)
        noise = likelihood_detail(base).points["estimation"].noise
        if effects and {*map(str, effects)} == {*map(str, base.effects)}:
            return [noise]
        return [self._woken(noise, likelihood_detail(base).best)]

    def _woken(self, noise: PassNoise, seen: LikelihoodFit) -> PassNoise:
        """Return noise of which no part is lost, neither a latent force nor a sensor's: it may be needed elsewhere.

        A model that lacks much leaves its innovations to the force alone, as an equation error does, and where r has
        gone to 0 no derivative brings it back. Three tenths of the innovations are a tenth of their variance: little is
        lost where they are not needed, and where a law has taken up the force the next steps find them.
        """
        floor = 1e-3 * self.noise_model.force_scale
        spread = np.sqrt(np.median(np.concatenate([passed.s for passed in seen.filtered]), axis=0))
        r = np.maximum(noise.r, 0.3 * spread)
        return replace(noise, s=np.maximum(noise.s, floor), w=np.maximum(noise.w, 0.1 * floor), r=r)

    def _starts(self, system: SystemT, passes: Pass, p: FloatArray, use: str, base: Fit | None) -> list[FloatArray]:
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
                old = [channel.name for channel in base.model.states]
                start = likelihood_detail(base).points[use].x0[number]
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

    def paths(self, fit: Fit, use: str) -> tuple[list[Filtered], list[SmoothedStates]]:
        """Return the pass of a fit over every record of a use, and the smoothed states; found once."""
        detail = likelihood_detail(fit)
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

    def without_memory(self, fit: Fit) -> Fit | None:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        if not self.latent:
            return None
        longest = max(len(run) for run in self.records["estimation"]) * self.dt
        noise = likelihood_detail(fit).points["estimation"].noise
        slow = (noise.tau > EFFORT.memory * longest) & (noise.s > EFFORT.negligible * self.noise_model.force_scale)
        if not slow.any():
            return None
        points = {}
        for use, point in likelihood_detail(fit).points.items():
            tau = np.where(slow, 0.1 * EFFORT.memory * longest, point.noise.tau)
            s = point.noise.s * np.sqrt(np.minimum(tau / point.noise.tau, 1.0))
            points[use] = replace(point, noise=replace(point.noise, s=s, tau=tau))
        return replace(fit, detail=replace(likelihood_detail(fit), points=points, paths={}, smooth={}))

    def linearised(self, fit: Fit) -> Linearised:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        own = per_record(fit.effects)
        spread = spread_of(likelihood_detail(fit).best, fit.free, own, fit.effects)
        states = state_values(likelihood_detail(fit).passes, likelihood_detail(fit).points["estimation"])
        return linearised(fit, {use: self.paths(fit, use)[0] for use in USES}, spread, states)

    def suspects(self, base: Fit, rival: Begun | None, candidates: Sequence[Placed]) -> list[Suspect]:
        """See :class:`harness.diagnosis.search.fit.Form`: sensors at their limit, lost signs."""
        return piled_up(self, base, candidates) + lost_signs(self, base, candidates)

    def held_fit(self, placed: Placed, start: Mapping[str, float], plain: Fit) -> Fit | None:
        """Return the fit with an effect that starts from a fit without it.

        Parameters stay there until the initial states and the noise of the whole records have been found.
        """
        try:
            system = self.composed([placed])
            passes = self.passes(system, self.substeps(system, {**system.values(), **plain.values, **start}))
            likelihood = self._likelihood(system, "estimation", passes)
            p = system.vector(within(system, {**system.values(), **plain.values, **start}))
            x0 = self._starts(system, passes, p, "estimation", None)
            free = [name for name in likelihood.names if name not in self.nominal.parameter_names]
            tried = stepped(likelihood, [Point(p, x0, noise) for noise in self._noises(None)], _LONG, free)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
            return None
        if not tried:
            return None
        held = tried[0]
        detail = FirstSteps(system, passes, likelihood, [replace(held, converged=False)])
        return self.finish(Begun((placed,), -held.nll, held.parameters, detail, held.pace, system), plain)
