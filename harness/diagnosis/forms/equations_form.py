"""The likelihood of a system given by its equations: compiled, with latent forces or by free runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from harness.diagnosis.directions.changed import changed_share
from harness.diagnosis.directions.coherence import answering, in_parts, incoherence, of_inputs, without
from harness.diagnosis.directions.damping import damping_along
from harness.diagnosis.directions.directions import Direction, directions, line_directions, test_functions
from harness.diagnosis.directions.jumps import jumps
from harness.diagnosis.directions.lightened import lightened
from harness.diagnosis.directions.trace import Trace
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.forms.fit_records import likelihood_detail
from harness.diagnosis.forms.innovations import answered
from harness.diagnosis.forms.likelihood_form import USES, FirstSteps, LikelihoodForm
from harness.diagnosis.forms.suspects import hidden
from harness.diagnosis.policy import POLICY
from harness.diagnosis.records.prepare import sizes_of
from harness.diagnosis.search.fit import Begun, Column, Fit, Jump, Suspect
from harness.diagnosis.systems import by_equations
from harness.effects.compose import FOLLOWED, compose, fastest_at_rest, moving, recommended_substeps
from harness.effects.effect import Placed
from harness.effects.parameter import Role
from harness.effects.places import port_of
from harness.physics.compiled.kalman_pass import Filtered, KalmanPass, Pass
from harness.physics.compiled.latent import with_latent_forces, without_latent_forces
from harness.physics.compiled.simulator import default_substeps
from harness.physics.compiled.smoother import SmoothedStates, smoothed
from harness.physics.compiled.system import System
from harness.physics.fitting.likelihood_fit import first_state, force_scale
from harness.physics.fitting.start import first_values
from harness.signals import FloatArray, Trajectory

WAVE_ROLES: tuple[Role, Role] = ("frequency", "phase")
_FAR = 2.0
"""Factor between typical forces, as declared and as fitted, beyond which a fit is made anew."""


class EquationsForm(LikelihoodForm[System]):
    """Fits a system with effects; see :class:`harness.diagnosis.forms.likelihood_form.LikelihoodForm`.

    Equations of motion have a latent force each. A process has none, so free runs are compared: a latent force on every
    rate, those of unmeasured levels among them, could do whatever a missing law does. What is estimated is then what
    makes the free run nearest, and intervals count that its error is coloured.
    """

    def judges(self, placed: Placed) -> bool:
        """Return True: every effect can be judged by its equations."""
        return True

    def has_latent_forces(self) -> bool:
        """Return False for output error."""
        return bool(self.nominal.coordinates)

    def force_scale(self, values: Mapping[str, float] | None = None) -> FloatArray:
        """Return the typical force on every coordinate, of declared parameters or others; none for output error."""
        if not self.latent:
            return np.zeros(0)
        return force_scale(self.nominal, self.records["estimation"], self.dataset.intersample, values)

    def composed(self, effects: Sequence[Placed]) -> System:
        """Return the nominal system with effects."""
        return compose(self.nominal, list(effects), sizes=self.sizes) if effects else self.nominal

    def substeps(self, system: System, values: Mapping[str, float]) -> int:
        """Return the steps of the solver within a sample; what is too fast for the readings need only be stable."""
        if self.unseen(system, values) > 1.0:  # refused, whatever its steps are
            return math.ceil(self._shown / FOLLOWED)
        return max(
            default_substeps(system, self.dt, system.vector(values), followed=np.pi),
            recommended_substeps(system, values, self.dt, x=moving(system, self.sizes)),
        )

    def unseen(self, system: System, values: Mapping[str, float]) -> float:
        """See :class:`harness.diagnosis.search.fit.Fit`."""
        return fastest_at_rest(system, values, self.dt) / self._shown

    @cached_property
    def _shown(self) -> float:
        """The fastest motion at rest that is told from one at once, of what the nominal model does not have itself."""
        return max(POLICY.shown, 2.0 * fastest_at_rest(self.nominal, None, self.dt))

    def passes(self, system: System, substeps: int) -> Pass:
        """Return the filter of a system."""
        disturbed = with_latent_forces(system) if self.latent else without_latent_forces(system)
        return KalmanPass(disturbed, self.dt, intersample=self.dataset.intersample, substeps=substeps)

    def first_state(self, system: System, record: Trajectory, p: FloatArray) -> FloatArray:
        """Return the initial state that a record tells, (nx,)."""
        return first_state(system, record, p, self.dataset.intersample)

    def smooth(self, passed: Filtered) -> SmoothedStates:
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
        changes = np.concatenate([np.gradient(motion.x, self.dt, axis=0) for motion in smooth])
        names = [channel.name for channel in self.nominal.states]
        for port in self.nominal.ports:
            if port.kind == "process":
                state = names.index(port.name)
                level, rate = (float(np.sqrt(np.mean(values[:, state] ** 2))) for values in (x, changes))
                sizes.setdefault(port.name, {}).update(x=level, F=rate)
        self.sizes = sizes
        if not self.latent:
            return False
        old, scale = self.noise_model.force_scale, self.force_scale(nominal.values)
        self.noise_model = replace(self.noise_model, force_scale=scale)
        return bool((np.maximum(scale / old, old / scale) > _FAR).any())

    # ---- what the score test needs -----------------------------------------------------------------------------------

    def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        traces = self._traces(fit, ("estimation",))
        return self._answered(fit, directions(traces, self.nominal, fit.values, candidates, self.sizes))

    def test_functions(self, fit: Fit) -> list[Column]:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        return self._answered(fit, test_functions(self._traces(fit, USES), self.nominal))

    def suspects(self, base: Fit, rival: Begun | None, candidates: Sequence[Placed]) -> list[Suspect]:
        """See :class:`harness.diagnosis.search.fit.Form`: hidden resonances and play besides."""
        noise = likelihood_detail(base).points["estimation"].noise
        if rival is not None:
            assert isinstance(rival.detail, FirstSteps)
            noise = rival.detail.tried[0].point.noise
        left = np.sqrt(noise.s**2 + noise.w**2) / self.noise_model.force_scale
        common = super().suspects(base, rival, candidates)
        if not left.max(initial=0.0) > EFFORT.negligible:
            return common
        lighter: dict[tuple[str, float], dict[str, float]] = {}
        return [
            *hidden(self.nominal, self.sizes, candidates,
                    lambda placed, start: self._lightened(base, placed, start, lighter)),
            *common,
        ]  # fmt: skip

    def _lightened(
        self, base: Fit, placed: Placed, start: Mapping[str, float], known: dict[tuple[str, float], dict[str, float]]
    ) -> dict[str, float]:
        """Return the nominal parameters that leave a motor's inertia out of what it drives; ``known`` is added to.

        The nominal fit holds both. Left as it is, the plant is too heavy by the motor, and a fit makes that small.
        """
        inertias = [
            start[placed.name(parameter.name)] for parameter in placed.effect.parameters if parameter.unit == "F/a"
        ]
        free = [name for name in base.free if name in self.nominal.parameter_names]
        if not inertias or not free:
            return {}
        key = placed.at, sum(inertias)
        if key not in known:
            traces = self._traces(base, USES[:1])[USES[0]]
            known[key] = lightened(traces, self.nominal, base.values, free, *key)
        return known[key]

    def change(self, fit: Fit, placed: Placed) -> float:
        """Return how much an effect changes of rates or readings along the estimation records, as a share of them."""
        whole = fit.model
        assert by_equations(whole)
        less = self.composed([other for other in fit.effects if str(other) != str(placed)])
        return changed_share(self._traces(fit, USES[:1])["estimation"], whole, less, self._moved(fit))

    def distance(self, fit: Fit, other: Fit) -> float:
        """Return how far another fit is from one along the estimation records, as a share of rates or readings."""
        whole, less = fit.model, other.model
        assert by_equations(whole)
        assert by_equations(less)
        mine, theirs = (self._traces(either, USES[:1])["estimation"] for either in (fit, other))
        return changed_share(mine, whole, less, self._moved(fit), theirs)

    def _moved(self, fit: Fit) -> list[str]:
        """Return the states that forces act on: what drives a motor acts on its speed, and on the joint only later."""
        names = [channel.name for channel in self.nominal.states]
        motors = [
            placed.name(name)
            for placed in fit.effects
            for name, unit in zip(placed.effect.states, placed.effect.state_units, strict=True)
            if unit == "v"
        ]
        return [*([names[coordinate.v] for coordinate in self.nominal.coordinates] or names), *motors]

    def jumps(self, fit: Fit) -> list[Jump]:
        """Return where the force that nobody measured changes faster than a disturbance does."""
        if not self.latent:
            return []
        return jumps(self._traces(fit, USES), self.noise_model.force_scale, POLICY)

    def damping(self, fit: Fit, at: str) -> tuple[FloatArray, FloatArray] | None:
        """Return places along the motion of a coordinate, and the damping of all that brakes it there."""
        row, system = self.nominal.coordinate(at), fit.model
        assert by_equations(system)
        x = np.concatenate([trace.x for trace in self._traces(fit, USES[:1])["estimation"]])
        return damping_along(system, fit.values, at, x[:, row.q], x[:, row.v])

    def line_rivals_of(self, fit: Fit, placed: Placed) -> tuple[float, ...]:
        """Return the evidence that a line changes along the records, and that it is a part of an answer to an input."""
        main, frequency, turn = placed.effect.main, *map(placed.effect.parameter_of, WAVE_ROLES)
        if main is None or frequency is None or turn is None:
            return ()
        size, omega, phase = (placed.name(parameter.name) for parameter in (main, frequency, turn))
        line = placed.with_values({frequency.name: fit.values[omega]})
        traces = self._traces(fit, USES)
        waves = line_directions(traces, self.nominal, fit.values, line, self.sizes)
        if not waves:
            return ()
        (wave,) = waves
        phases = {"estimation": fit.values[phase], "validation": fit.own[phase]}
        (column,) = self._answered(fit, [wave])
        linear = without(self.linearised(fit), (size, omega, phase), column, fit.values[size], phases)
        anew = POLICY.line_parts if any(np.any(force) for force in wave.forces["estimation"]) else ()
        whole, *cuts = (self._answered(fit, in_parts(wave, parts)) for parts in (1, *anew))  # no force, no narrow band
        records = {use: [trace.record for trace in parts] for use, parts in traces.items()}
        inputs = [self._answered(fit, [one]) for one in of_inputs(wave, records, fit.values[omega])]
        return incoherence(linear, whole, cuts), answering(linear, whole, inputs)

    def _traces(self, fit: Fit, uses: Sequence[str]) -> dict[str, list[Trace]]:
        """Return the smoothed motion of every record of some uses."""
        detail = likelihood_detail(fit)
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

    def _answered(self, fit: Fit, asked: Sequence[Direction]) -> list[Column]:
        """Return the columns of directions."""
        paths = {use: self.paths(fit, use)[0] for use in (asked[0].forces if asked else ())}
        return answered(asked, paths, self._held, None if self.latent else self.dt)


class OutputErrorForm(EquationsForm):
    """Compares free runs of a system although its equations of motion could have latent forces.

    Where such a force would do most of what moves a mass, it explains whatever the model does not, and what is called
    likely says nothing of the model (Ljung 1999, sec. 7.4: output error is the model without process noise).
    """

    def has_latent_forces(self) -> bool:
        """Return False."""
        return False
