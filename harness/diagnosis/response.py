"""What an unknown force would do to the outputs: spline functions sent through the model linearised along its run.

A force phi(q, v, u, t) on a coordinate moves the simulated state by dx[k+1] = A[k] dx[k] + G[k] phi[k]. All functions
of a family go through together. What free parameters and initial states could do instead is taken out, so that the
answer of the adequacy test does not depend on how the nominal parameters were fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.adequacy import hat_basis, joint_basis, rough
from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.forms import Fitted, stacked
from harness.diagnosis.motion import Motion
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.surrogates import orthonormal
from harness.signals import FloatArray

__all__ = ["Axis", "Family", "equation_families", "families_at", "force_along", "output_families", "responses_of"]

KNOTS = 9
JOINT_KNOTS = (9, 6)
FOLDED = " (folded)"


@dataclass(frozen=True, eq=False)
class Axis:
    """One axis of a family: name, unit, values on every record of each use."""

    name: str
    unit: str
    values: Mapping[str, Sequence[FloatArray]]

    def knots(self, count: int) -> FloatArray:
        """Return knots at quantiles of the estimation values."""
        joined = np.concatenate(list(self.values["estimation"]))
        return np.unique(np.quantile(joined, np.linspace(0.005, 0.995, count)))

    @property
    def hull(self) -> tuple[float, float]:
        """Range of the estimation values: a map is not valid beyond."""
        joined = np.concatenate(list(self.values["estimation"]))
        return float(joined.min()), float(joined.max())


@dataclass(frozen=True, eq=False)
class Family:
    """Functions of one or two axes, acting at one place (a coordinate, a state, an output)."""

    place: str
    axes: tuple[Axis, ...]

    @property
    def name(self) -> str:
        """Such as ``"force on theta of theta, theta'"``."""
        return f"{self.place} of {', '.join(axis.name for axis in self.axes)}"

    def knots(self) -> list[FloatArray]:
        """Return the knots of each axis."""
        counts = (KNOTS,) if len(self.axes) == 1 else JOINT_KNOTS
        return [axis.knots(count) for axis, count in zip(self.axes, counts, strict=True)]

    def roughness(self) -> FloatArray:
        """Return the matrix that penalises rough functions of the family."""
        sizes = [len(one) for one in self.knots()]
        if len(sizes) == 1:
            return rough(sizes[0])
        return np.asarray(np.kron(rough(sizes[0]), np.eye(sizes[1])) + np.kron(np.eye(sizes[0]), rough(sizes[1])))

    def basis(self, use: str) -> list[FloatArray]:
        """Return the functions (N_i, K) on every record of a use."""
        count = len(self.axes[0].values[use])
        return [self.functions([axis.values[use][number] for axis in self.axes]) for number in range(count)]

    def functions(self, values: Sequence[FloatArray]) -> FloatArray:
        """Return the functions (N, K) at values (N,) of each axis."""
        parts = [hat_basis(x, knots) for x, knots in zip(values, self.knots(), strict=True)]
        return parts[0] if len(parts) == 1 else joint_basis(parts[0], parts[1])


Responses = dict[str, tuple[list[FloatArray], list[FloatArray]]]


def responses_of(form: Any, fitted: Fitted) -> tuple[Responses, dict[str, Family], list[FloatArray]]:
    """Return for every family its responses, the families by name, and the validation residual.

    From responses and residual of the validation runs, too, all is taken out that other nominal parameters would do:
    an error of a parameter is no missing effect, however large it grows where the motion is sensitive.
    """
    if isinstance(form, EquationForm):
        families = equation_families(form)
        raw = {use: _on_equations(form, families, use) for use in ("estimation", "validation")}
        outside = _equation_jacobian(form, fitted)
    else:
        families, raw = _simulated_families(form, fitted)
        outside = _output_jacobian(form, fitted)
    inside = list(fitted.jacobian)
    if isinstance(form, EquationForm):
        # all parameters and all inputs scaled together leave no residual at all: that is no prediction
        inside = [np.concatenate(pair, axis=2) for pair in zip(inside, _pushes(form, "estimation"), strict=True)]
        outside = [np.concatenate(pair, axis=2) for pair in zip(outside, _pushes(form, "validation"), strict=True)]
    known = inside[0].shape[2] > 0
    result: Responses = {}
    flat, other = stacked(inside), stacked(outside)
    left = orthonormal(other, tolerance=1e-9) if known else np.zeros((other.shape[0], 0))
    for family in families:
        phi, psi = raw["estimation"][family.name], raw["validation"][family.name]
        if known:
            share = np.linalg.lstsq(flat, stacked(phi), rcond=1e-10)[0]
            phi = [one - j @ share for one, j in zip(phi, inside, strict=True)]
            psi = _without(left, psi)
        result[family.name] = (phi, psi)
    rest = [one[:, :, 0] for one in _without(left, [one[:, :, None] for one in fitted.validation])]
    return result, {family.name: family for family in families}, rest


def _simulated_families(
    form: OutputForm, fitted: Fitted
) -> tuple[list[Family], dict[str, dict[str, list[FloatArray]]]]:
    """Return the families of a simulation form: linearised equations, or an FMU that is pushed."""
    from harness.diagnosis.fmu_form import FmuForm

    if isinstance(form, FmuForm):
        from harness.diagnosis.fmu_responses import fmu_families

        return fmu_families(form, fitted)
    return output_families(form, fitted)


def _without(left: FloatArray, parts: Sequence[FloatArray]) -> list[FloatArray]:
    """Return columns (N_i, ny, k) with an orthonormal basis of all rows taken out."""
    flat = stacked(parts)
    flat = flat - left @ (left.T @ flat)
    cuts = np.cumsum([one.shape[0] * one.shape[1] for one in parts])[:-1]
    return [piece.reshape(one.shape) for piece, one in zip(np.split(flat, cuts), parts, strict=True)]


# ---- equations -----------------------------------------------------------------------------------------------------


def equation_families(form: EquationForm) -> list[Family]:
    """Return the families of force functions on measured motion.

    In the whitened balance there are none of an input: all parameters and all inputs scaled together leave no residual,
    and a function of an input nearly does that.
    """
    uses = ("estimation", "validation")
    families = []
    for row, one in enumerate(form.nominal.coordinates):

        def axis(name: str, unit: str, pick: Any) -> Axis:
            return Axis(name, unit, {use: [pick(motion) for motion in form.motions[use]] for use in uses})

        q = axis(one.name, one.unit, lambda m, row=row: m.q[:, row])
        v = axis(f"{one.name}'", f"{one.unit}/s", lambda m, row=row: m.v[:, row])
        t = axis("time", "s", lambda m: m.t - m.t[0])
        channels = list(enumerate(form.nominal.inputs))
        inputs = [axis(channel.name, channel.unit, lambda m, k=k: m.u[:, k]) for k, channel in channels]
        families += families_at(f"force on {one.name}", q, v, t, inputs)
    return families


def _on_equations(form: EquationForm, families: Sequence[Family], use: str) -> dict[str, list[FloatArray]]:
    """Return the functions as they would appear in the force residual."""
    result = {}
    names = [one.name for one in form.nominal.coordinates]
    for family in families:
        row = names.index(family.place.removeprefix("force on "))
        parts = []
        for motion, phi in zip(form.motions[use], family.basis(use), strict=True):
            full = np.zeros((len(phi), len(names), phi.shape[1]))
            full[:, row] = phi / form.weights[row]
            parts.append(form.averaged(full, motion))
        result[family.name] = parts
    return result


def _pushes(form: EquationForm, use: str) -> list[FloatArray]:
    """Return the force of each input on each coordinate, as it appears in the residual."""
    equations = form.equations(())
    p = equations.system.vector()
    parts = []
    for motion in form.motions[use]:
        columns = np.zeros((*motion.q.shape, motion.u.shape[1]))
        for k in range(motion.u.shape[1]):
            alone = np.zeros_like(motion.u)
            alone[:, k] = motion.u[:, k]
            columns[:, :, k] = equations.force_of(motion, alone, p) / form.weights
        parts.append(form.averaged(columns, motion))
    return parts


def _equation_jacobian(form: EquationForm, fitted: Fitted) -> list[FloatArray]:
    """Return the Jacobian on validation."""
    equations = form.equations(fitted.effects)
    p = equations.system.vector(fitted.values)
    index = [equations.system.parameter_names.index(name) for name in fitted.free]
    return [
        equations.residual(motion, p, form.shape, index)[1] / form.weights[:, None]
        for motion in form.motions["validation"]
    ]


# ---- outputs -------------------------------------------------------------------------------------------------------


def output_families(form: OutputForm, fitted: Fitted) -> tuple[list[Family], dict[str, dict[str, list[FloatArray]]]]:
    """Return the families and what they do to the outputs, initial states taken out."""
    uses = ("estimation", "validation")
    system = fitted.system
    runs = {use: _Linearised(form, fitted, use) for use in uses}

    def axis(name: str, unit: str, pick: Any) -> Axis:
        return Axis(name, unit, {use: [pick(one) for one in runs[use].records] for use in uses})

    t = axis("time", "s", lambda r: r["t"] - r["t"][0])
    inputs = [axis(c.name, c.unit, lambda r, k=k: r["u"][:, k]) for k, c in enumerate(system.inputs)]
    families: list[Family] = []
    for one in system.coordinates:
        q = axis(one.name, one.unit, lambda r, k=one.q: r["x"][:, k])
        v = axis(f"{one.name}'", f"{one.unit}/s", lambda r, k=one.v: r["x"][:, k])
        families += families_at(f"force on {one.name}", q, v, t, inputs)
    if not system.coordinates:
        for k, channel in enumerate(system.states):
            x = axis(channel.name, channel.unit, lambda r, k=k: r["x"][:, k])
            families += families_at(f"rate of {channel.name}", x, None, t, inputs)
    for k, channel in enumerate(system.outputs):
        y = axis(channel.name, channel.unit, lambda r, k=k: r["y"][:, k])
        families.append(Family(f"reading of {channel.name}", (y,)))
    made: dict[str, dict[str, list[FloatArray]]] = {}
    for use in uses:
        made[use] = {}
        for family in families:
            parts = runs[use].respond(family.place, family.basis(use))
            made[use][family.name] = list(form.without_states(fitted, parts, use))
    return families, made


def _turning(axis: Axis) -> Axis:
    """Return an angle folded into one turn, where it makes more than one."""
    low, high = axis.hull
    if axis.unit != "rad" or high - low <= 2.2 * np.pi:
        return axis
    folded = {use: [_fold(x) for x in parts] for use, parts in axis.values.items()}
    return Axis(f"{axis.name}{FOLDED}", axis.unit, folded)


def _fold(angle: FloatArray) -> FloatArray:
    """Return angles [rad] between -pi and pi."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def force_along(family: Family, coefficients: FloatArray, system: Any, motion: Motion) -> FloatArray:
    """Return the force (N, n) of a family of functions of a force on a coordinate, along a measured motion."""
    known = {"time": motion.t - motion.t[0]}
    for row, one in enumerate(system.coordinates):
        known |= {one.name: motion.q[:, row], f"{one.name}'": motion.v[:, row]}
        known[f"{one.name}{FOLDED}"] = _fold(motion.q[:, row])
    known |= {channel.name: motion.u[:, k] for k, channel in enumerate(system.inputs)}
    force = np.zeros(motion.q.shape)
    row = [one.name for one in system.coordinates].index(family.place.removeprefix("force on "))
    force[:, row] = family.functions([known[axis.name] for axis in family.axes]) @ coefficients
    return force


def families_at(place: str, q: Axis, v: Axis | None, t: Axis, inputs: Sequence[Axis]) -> list[Family]:
    """Return the families at one place: each axis alone, position with speed, speed with the first input."""
    q = _turning(q)
    single = [q, *([v] if v is not None else []), *inputs[:2], t]
    moving = [axis for axis in single if axis.hull[1] > axis.hull[0]]
    families = [Family(place, (axis,)) for axis in moving]
    pairs = [(q, v)] if v is not None else []
    pairs += [(v if v is not None else q, one) for one in inputs[:1]]
    for a, b in pairs:
        if a in moving and b in moving:
            families.append(Family(place, (a, b)))
    return families


class _Linearised:
    """The model linearised along the fitted free runs of one use."""

    def __init__(self, form: OutputForm, fitted: Fitted, use: str) -> None:
        import casadi as ca

        system = fitted.system
        p = system.vector({**fitted.values, **(fitted.refitted if use != "estimation" else {})})
        windows = form._windows(system, p, use)
        key = "x0" if use == "estimation" else "x0_validation"
        x0 = np.array(fitted.record[key], dtype=float).reshape(len(windows), system.nx)
        states = windows.evaluate(p, x0, keep=True).states
        self.form, self.system, self.places = form, system, windows.places
        simulator = windows.simulator
        step = simulator.functions.step(simulator.dt / simulator.substeps, simulator.substeps)
        arguments = [system.x, system.u, system.p, system.t]
        upright = ca.DM([0.0, -1.0])
        out = ca.Function("h", arguments, [ca.substitute(system.h, system.gravity, upright)])
        slope = ca.Function("c", arguments, [ca.jacobian(ca.substitute(system.h, system.gravity, upright), system.x)])
        mass = ca.Function("m", arguments, [ca.substitute(system.mass_matrix, system.gravity, upright)])
        self.records: list[dict[str, FloatArray]] = [{} for _ in form.records[use]]
        self._a: list[FloatArray] = []
        self._c: list[FloatArray] = []
        self._g: list[FloatArray] = []
        joined = windows.together(states)
        for number, record in enumerate(form.records[use]):
            n = len(record)
            many = np.repeat(p[:, None], n, axis=1)
            y = np.array(out(joined[number].T, record.u.T, many, record.t[None])).T
            self.records[number] = {"t": record.t, "u": record.u, "x": joined[number], "y": y}
        nx, n = system.nx, len(system.coordinates)
        for (number, first, last), x in zip(windows.places, states, strict=True):
            record = form.records[use][number]
            u, t = record.u[first:last], record.t[first:last][None]
            many = np.repeat(p[:, None], last - first, axis=1)

            def stepped(z: FloatArray, u: FloatArray = u, many: FloatArray = many, t: FloatArray = t) -> FloatArray:
                return np.array(step(z.T, u.T, many, t), dtype=float).T

            a = np.empty((last - first, nx, nx))
            for i in range(nx):
                d = np.zeros(nx)
                d[i] = 1e-6 * max(float(np.abs(x[:, i]).max()), 1e-3)
                a[:, :, i] = (stepped(x + d) - stepped(x - d)) / (2 * d[i])
            c = np.array(slope(x.T, u.T, many, t), dtype=float)
            self._a.append(a)
            self._c.append(c.reshape(system.ny, last - first, nx).transpose(1, 0, 2))
            g = np.zeros((last - first, nx, max(n, nx if not n else n)))
            dt = simulator.dt
            if n:
                m = np.array(mass(x.T, u.T, many, t), dtype=float).reshape(n, last - first, n).transpose(1, 0, 2)
                inverse = np.linalg.inv(m)
                for row, one in enumerate(system.coordinates):
                    for column in range(n):
                        g[:, one.v, column] = dt * inverse[:, row, column]
                        g[:, one.q, column] = 0.5 * dt**2 * inverse[:, row, column]
            else:
                for i in range(nx):
                    g[:, i, i] = dt
            self._g.append(g)

    def respond(self, place: str, basis: Sequence[FloatArray]) -> list[FloatArray]:
        """Return what functions (N_i, K) at a place do to the weighted outputs (N_i, ny, K)."""
        weights = self.form.weights[:, None]
        result = [np.zeros((len(one), len(self.form.weights), one.shape[1])) for one in basis]
        kind, _, name = place.partition(" of ") if " of " in place else place.partition(" on ")
        if kind == "reading":
            row = [channel.name for channel in self.system.outputs].index(name)
            for one, phi in zip(result, basis, strict=True):
                one[:, row] = phi / self.form.weights[row]
            return result
        names = [one.name for one in self.system.coordinates] or [channel.name for channel in self.system.states]
        column = names.index(name)
        for (number, first, last), a, c, g in zip(self.places, self._a, self._c, self._g, strict=True):
            phi = basis[number][first:last]
            pushed = g[:, :, column, None] * phi[:, None, :]
            x = np.zeros((last - first, a.shape[1], phi.shape[1]))
            for k in range(last - first - 1):
                x[k + 1] = a[k] @ x[k] + pushed[k]
            result[number][first:last] = (c @ x) / weights
        return result


def _output_jacobian(form: OutputForm, fitted: Fitted) -> list[FloatArray]:
    """Return the Jacobian on validation, initial states taken out."""
    system = fitted.system
    p = system.vector({**fitted.values, **fitted.refitted})
    windows = form._windows(system, p, "validation")
    x0 = np.array(fitted.record["x0_validation"], dtype=float).reshape(len(windows), system.nx)
    index = [system.parameter_names.index(name) for name in fitted.free]
    jacobian = windows.jacobian(p, x0)[:, index]
    cuts = np.cumsum([len(one) for one in form.records["validation"]])[:-1]
    return list(np.split(jacobian.reshape(len(jacobian) // len(form.weights), len(form.weights), len(index)), cuts))
