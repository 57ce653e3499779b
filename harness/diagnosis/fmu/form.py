"""The likelihood form of an FMU: its state is not disturbed, its directions are pushes on its inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from harness.blackbox.effects import fits_fmu, surround
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator, Loan
from harness.blackbox.system import FmuSystem
from harness.diagnosis.directions.directions import Direction
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.fmu.passes import FreePass, StateRun
from harness.diagnosis.fmu.prepare import measured_states, rough_values, sizes_of
from harness.diagnosis.fmu.pushes import Moved, as_measured, pushes, test_pushes
from harness.diagnosis.forms.fit_records import likelihood_detail
from harness.diagnosis.forms.likelihood_form import USES, FirstSteps, LikelihoodForm
from harness.diagnosis.forms.predictive import whitened
from harness.diagnosis.policy import DATA_POLICY, POLICY
from harness.diagnosis.search.fit import Begun, Column, Fit
from harness.diagnosis.systems import Starts
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed
from harness.errors import HarnessError
from harness.physics.compiled.kalman_pass import Filtered, Pass
from harness.physics.compiled.sampled import SampledBlocks
from harness.physics.compiled.smoother import SmoothedStates
from harness.physics.fitting.likelihood_fit import first_noises, sensor_noise
from harness.signals import Dataset, FloatArray, Trajectory


class FmuForm(LikelihoodForm[FmuSystem]):
    """Fits an FMU with effects around it; see :class:`harness.diagnosis.forms.likelihood_form.LikelihoodForm`."""

    def __init__(
        self,
        system: FmuSystem,
        dataset: Dataset,
        sizes: Mapping[str, Mapping[str, float]],
        laws: Dictionary | None = None,
        beside: FmuForm | None = None,
    ) -> None:
        self.runner: Runner = Runner(system, dataset.spec.sample_time) if beside is None else beside.runner
        self._beside = beside
        self._left: dict[str, None] = {}
        self._lent: dict[int, list[Loan]] = {}  # While first steps are taken
        self._lender: Fit | None = None
        self._lendings: dict[int, list[Loan]] = {}
        self._finished: set[frozenset[str]] = set()
        super().__init__(system, dataset, sizes, laws)

    def on(self, dataset: Dataset) -> FmuForm:
        """Return the same form of other data; what it costs is part of the same search."""
        return FmuForm(self.nominal, dataset, self.sizes, self.laws, self)

    def spent(self, effects: Sequence[Placed], base: Fit | None, seconds: float) -> bool:
        """Return whether the FMU's runs took the time that a search may cost, and keep what that leaves out.

        The fit of the nominal model to the data themselves is no part of a search. What was finished once is asked for
        again to be confirmed, which is to end it: that may cost what finishing may.
        """
        which = frozenset(map(str, effects))
        limit = EFFORT.ending if which in self._finished else seconds
        if base is not None and self.runner.before is None:
            self.runner.before = self.runner.seconds
        cost = 0.0 if self.runner.before is None else self.runner.seconds - self.runner.before
        if (base is None and self._beside is None) or cost <= limit:
            if seconds == EFFORT.ending:
                self._finished.add(which)
            return False
        known = set() if base is None else set(map(str, base.effects))
        self._left |= dict.fromkeys(name for name in map(str, effects) if name not in known)
        return True

    def astray(self, base: Fit | None) -> bool:
        """Return True of a base whose free runs do not follow their records; each start beside one costs many runs."""
        if base is None:
            return True
        noise = likelihood_detail(base).points["estimation"].noise
        return bool((noise.r > POLICY.tie * sensor_noise(self.records["estimation"])).any())

    def left_out(self) -> list[str]:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        return list(self._left)

    def limited(self) -> bool:
        """See :class:`harness.diagnosis.search.fit.Form`: by what the FMU's runs cost."""
        return True

    def judges(self, placed: Placed) -> bool:
        """Return True for an effect that can be put around an FMU."""
        return fits_fmu(placed.effect)

    def has_latent_forces(self) -> bool:
        """Return False: only what the FMU lets us set could be disturbed."""
        return False

    def composed(self, effects: Sequence[Placed]) -> FmuSystem:
        """Return the FMU with effects around it; rounding of readings counts as noise."""
        made = surround(self.nominal, effects, self.sizes) if effects else self.nominal
        return replace(made, sampled=tuple(block for block in made.sampled if block.kind != "quantise"))

    def substeps(self, system: FmuSystem, values: Mapping[str, float]) -> int:
        """Return 1: the FMU chooses its own steps."""
        return 1

    def passes(self, system: FmuSystem, substeps: int) -> Pass:
        """Return the free runs of a system."""
        made = FreePass(FmuSimulator(system, self.runner))
        made.lent = self._lent
        return made

    def begin(self, effects: Sequence[Placed], starts: Starts, base: Fit | None, hope: float = -np.inf) -> Begun | None:
        """See :class:`harness.diagnosis.search.fit.Form`.

        First steps beside a base, which only rank, take its derivatives by what is the FMU's own: each costs a run or
        two. What is finished takes its own, from the likeliest end of first steps that cost much.
        """
        before = self.runner.seconds
        try:
            if not self.spent(effects, base, EFFORT.seconds):
                loans = {} if base is None else self._loans(base)
                self._lent = {id(record): [*loans.get(id(record), ())] for record in self.records["estimation"]}
            begun = super().begin(effects, starts, base, hope)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
            return None
        finally:
            self._lent = {}
        if begun is not None:
            assert isinstance(begun.detail, FirstSteps)
            assert isinstance(begun.detail.passes, FreePass)
            begun.detail.passes.take_own()
            if self.runner.seconds - before > EFFORT.dear:
                del begun.detail.tried[1:]
        return begun

    def _loans(self, base: Fit) -> dict[int, list[Loan]]:
        """Return the derivatives of a base's free runs, and of the declared model's, by the identity of a record."""
        if self._lender is not base:
            detail = likelihood_detail(base)
            self._lender, self._lendings = base, {id(record): [] for record in self.records["estimation"]}
            declared = self.nominal.vector()
            passes = self.passes(self.nominal, 1)
            begun = self._starts(self.nominal, passes, declared, "estimation", None)
            places = [(detail.passes, detail.points["estimation"].p, detail.points["estimation"].x0)]
            places += [(passes, declared, begun)] if self.astray(base) else []
            for lender, p, starts in places:
                simulator = lender.simulator
                own = [*range(simulator.system.inner_count),
                       *(simulator.np + k for k in range(len(simulator.system.inner_states)))]  # fmt: skip
                for record, x0 in zip(self.records["estimation"], starts, strict=True):
                    seen = simulator.sampled.inputs(record.u[None], p[None], False)[0]
                    with simulator.deriving(own, self._lendings[id(record)]):
                        simulator.windows(p[None], x0[None], seen, None, record.t[:1])
        return self._lendings

    def first_state(self, system: FmuSystem, record: Trajectory, p: FloatArray) -> FloatArray:
        """Return the initial state that a record tells, (nx,)."""
        simulator = FmuSimulator(self.nominal, self.runner)
        return np.asarray(measured_states(self.nominal, simulator, record, p[: self.nominal.np])[0][0])

    def _starts(self, system: FmuSystem, passes: Pass, p: FloatArray, use: str, base: Fit | None) -> list[FloatArray]:
        """Return initial states to start from; what went in before a record, where a delay is new, is as it tells.

        Begun as the first value, a delay would go to 0, where nothing is told of the time before.
        """
        starts = super()._starts(system, passes, p, use, base)
        known = [] if base is None else [channel.name for channel in base.model.states]
        sampled: SampledBlocks = passes.simulator.sampled
        new = [(column, state) for column, _, state in sampled.before if system.states[state].name not in known]
        if new:
            for record, x0 in zip(self.records[use], starts, strict=True):
                found = self._by_least_squares(passes, record[: DATA_POLICY.shortest], p, x0)
                for column, state in new:
                    u = record.u[:, column]
                    x0[state] = float(np.clip(found[state], min(u.min(), 0.0) - u[0], max(u.max(), 0.0) - u[0]))
        return starts

    def _by_least_squares(self, passes: Pass, record: Trajectory, p: FloatArray, x0: FloatArray) -> FloatArray:
        """Return the initial states (nx,) that a short record tells, in two Gauss-Newton steps."""
        noise = first_noises(self.noise_model, self._first_noise, self.dt)[0]
        for _ in range(2):
            passed = passes(record, p, x0, noise, columns=np.arange(len(p), len(p) + len(x0)))
            if passed is None or passed.j is None:
                break
            e, j = whitened(passed.e, passed.s), whitened(passed.j, passed.s[..., None])
            x0 = x0 - np.linalg.lstsq(j, e, rcond=1e-9)[0]
        return x0

    def smooth(self, passed: Filtered) -> SmoothedStates:
        """Return the states of the free run itself."""
        assert isinstance(passed, StateRun)
        return SmoothedStates(passed.x, np.zeros_like(passed.x))

    def first_starts(self) -> list[dict[str, float]]:
        """Return parameters to start the nominal fit from: as declared, and fitted over short windows.

        Other data begin where those do beside which they are looked at: the rough fit costs more than the fit itself.
        """
        return self._first_starts if self._beside is None else self._beside.first_starts()

    @cached_property
    def _first_starts(self) -> list[dict[str, float]]:
        declared = self.nominal.values()
        rough = rough_values(self.nominal, self.dataset, self.runner)
        return [declared] if rough is None else [rough, declared]

    def without_memory(self, fit: Fit) -> Fit | None:
        """Return the nominal model with its declared parameters, None where its free runs follow their record.

        A spring without the friction that damps it comes nearest to its record where it hardly moves: from there no law
        promises anything. What the user believes in is nearer to the plant.
        """
        point = likelihood_detail(fit).points["estimation"]
        if fit.effects or not self.astray(fit):
            return None
        system, passes = self.nominal, likelihood_detail(fit).passes
        likelihood = self._likelihood(system, "estimation", passes)
        held = [name for name in likelihood.names if name not in system.parameter_names]
        p = system.vector()
        try:
            start = likelihood.concentrated(replace(point, p=p, x0=self._starts(system, passes, p, "estimation", None)))
            near = likelihood.maximise(start, free=held, most=EFFORT.first_steps, exact=False)
            best = likelihood.maximise(near.point, most=0, exact=False)
            own, told, expected = self._validated(system, passes, best, None)
            outside = self._outside(system, passes, expected.point, told)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
            return None
        return None if outside is None else self._fitted((), system, passes, best, own, outside, expected, told)

    def resize(self, nominal: Fit) -> bool:
        """Take the sizes of positions and rates from the nominal fit; False: it stands."""
        self.sizes = sizes_of(self.nominal, [motion for use in USES for motion in self._moved(nominal, USES)[use]])
        return False

    # ---- what the score test needs -----------------------------------------------------------------------------------

    def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        return self._pushed(fit, pushes(self.nominal, self._moved(fit, ("estimation",)), candidates, self.sizes))

    def test_functions(self, fit: Fit) -> list[Column]:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        return self._pushed(fit, test_pushes(self.nominal, self._moved(fit, USES)))

    def change(self, fit: Fit, placed: Placed) -> float:
        """Return infinity: within a run the states of an FMU may not be set, so no step is made without an effect."""
        return float("inf")

    def _moved(self, fit: Fit, uses: Sequence[str]) -> dict[str, list[Moved]]:
        """Return the motion of every record of some uses: the free run of a fit, led to what the sensors tell."""
        simulator: FmuSimulator = likelihood_detail(fit).passes.simulator
        moved: dict[str, list[Moved]] = {}
        for use in uses:
            point = likelihood_detail(fit).points[use]
            moved[use] = []
            for record, x0 in zip(self.records[use], point.x0, strict=True):
                seen = simulator.sampled.inputs(record.u[None], point.p[None], False)[0][0]
                q, v, y = simulator.motion(point.p, x0, seen, float(record.t[0]))
                q, v = as_measured(self.nominal, record, q, v, y)
                moved[use].append(Moved(record, seen, q, v, y, self.dt))
        return moved

    def _pushed(self, fit: Fit, found: Sequence[Direction]) -> list[Column]:
        """Return the columns of directions: pushes by difference quotients of runs, readings as they are."""
        made = [{use: [np.zeros((0, len(direction.names)))] for use in USES} for direction in found]
        for use in found[0].forces if found else ():
            passed, _ = self.paths(fit, use)
            for number, run in enumerate(passed):
                assert isinstance(run, StateRun)
                u = self.records[use][number].u
                rms = max(float(np.sqrt(np.mean(u**2))) if u.size else 0.0, 1e-9)
                still = run.pushed(np.zeros_like(u))
                every = [direction.forces[use][number] for direction in found]
                many = sum(forces.shape[2] for forces in every) > EFFORT.pushes
                tried = (_convolution(run, still, u, part * rms) for part in (EFFORT.wide_push, EFFORT.push) if many)
                convolved = next((one for one in tried if one is not None), None)
                for direction, columns in zip(found, made, strict=True):
                    response = -direction.readings[use][number]
                    forces = direction.forces[use][number]
                    forces = 0.5 * (forces + np.concatenate([forces[1:], forces[-1:]]))
                    if convolved is not None:
                        columns[use].append(whitened(response - convolved(forces), run.s[..., None]))
                        continue
                    for k in range(forces.shape[2]):
                        largest = float(np.sqrt(np.mean(forces[..., k] ** 2)))
                        if largest > 0:
                            step = EFFORT.push * rms / largest
                            response[..., k] -= (run.pushed(step * forces[..., k]) - still) / step
                    columns[use].append(whitened(response, run.s[..., None]))
        return [
            Column(direction.placed, direction.given, direction.names,
                   np.concatenate(columns["estimation"]), np.concatenate(columns["validation"]), direction.kind)
            for direction, columns in zip(found, made, strict=True)
            if all(np.isfinite(part).all() for parts in columns.values() for part in parts)
        ]  # fmt: skip


def _convolution(
    run: StateRun, still: FloatArray, u: FloatArray, size: float
) -> Callable[[FloatArray], FloatArray] | None:
    """Return from pushes (K, nu, n) the responses (K, ny, n) of a run that answers alike whenever it is pushed.

    The response to a pulse at the first sample is convolved with them; None if that is not what a push at all times
    does, as where the model is not linear.

    - ``still`` (K, ny), ``u`` (K, nu): outputs without a push, inputs of the record
    - ``size``: of a push that is small, over the whole record
    """
    from scipy.signal import fftconvolve

    n, nu = u.shape
    pulses = np.zeros((n, still.shape[1], nu))
    for row in range(nu):
        pulse = np.zeros_like(u)
        pulse[0, row] = size * np.sqrt(n)
        pulses[..., row] = (run.pushed(pulse) - still) / pulse[0, row]

    def convolved(forces: FloatArray) -> FloatArray:
        answers = (fftconvolve(pulses[..., row, None], forces[:, None, row], axes=0)[:n] for row in range(nu))
        return np.asarray(sum(answers, np.zeros((n, still.shape[1], forces.shape[2]))))

    signs = np.random.default_rng(0).choice([-1.0, 1.0], (EFFORT.pushes, nu))
    everywhere = size * np.repeat(signs, n // EFFORT.pushes + 1, axis=0)[:n]
    told = run.pushed(everywhere) - still
    off = np.linalg.norm(told - convolved(everywhere[..., None])[..., 0], axis=0)
    return convolved if (off <= EFFORT.steady * np.linalg.norm(told, axis=0)).all() else None
