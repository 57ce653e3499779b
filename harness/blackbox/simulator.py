"""Simulating an FMU with effects around it over windows of records, with derivatives by finite differences.

It offers what :class:`harness.physics.compiled.windows.Windows` asks of a simulator, so that fits of an FMU and of
equations
share one minimiser.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from harness.blackbox.recent import Recent
from harness.blackbox.runner import KEPT, Runner
from harness.blackbox.sums import summed
from harness.blackbox.system import FmuSystem
from harness.effects.places import port_of
from harness.errors import HarnessError
from harness.physics.compiled.rollout_call import Asked, Given, Sums
from harness.physics.compiled.sampled import BySample, SampledBlocks
from harness.signals import FloatArray, PlantSpec

STEP = 1e-3  # Relative step of differences: where the motion reverses, a smaller one sees the steps of the integration.
BEND = 0.02  # Part of a difference between two sides that may be a bend: the derivative errs by about its square.
SHORTEST = 1e-3  # Part of a step that the next one has at least: beyond that a bend is no parabola's.
STILL = 1e-6  # Of an output's spread: what a start moves less, by its whole size, moves the solver's own error.
NEAR = 0.3  # Of a parameter, and of the spread of an output: how far a run may be off one that lends its derivatives.


class Loan(NamedTuple):
    """Derivatives (N, ny) of a record's outputs by what is an FMU's own, taken once for first steps about there."""

    values: FloatArray  # Of the FMU's parameters
    y: FloatArray  # (N, ny)
    slopes: Mapping[str, FloatArray]  # By parameters and initial states

    def holds(self, values: FloatArray, y: FloatArray) -> bool:
        """Return whether a run is like that one: its parameters, and what it shows."""
        near = np.abs(values - self.values) <= NEAR * np.abs(self.values)
        return bool(near.all() and (np.std(y - self.y, axis=0) <= NEAR * np.std(self.y, axis=0)).all())


class _Run(NamedTuple):
    """A run of FMU and effects together: what is filled in row by row, then what it begins and goes on with."""

    table: FloatArray
    hidden: FloatArray
    rates: FloatArray
    past: FloatArray
    z: FloatArray
    p: FloatArray
    u: FloatArray
    extra: FloatArray | None
    t0: float
    plant: Any
    h: float


class FmuSimulator(BySample):
    """Free runs of an FMU with effects, and their derivatives."""

    def __init__(self, system: FmuSystem, runner: Runner) -> None:
        self.system, self.runner = system, runner
        self.dt, self.substeps, self.intersample = runner.sample_time, 1, "zoh"
        self.spec = PlantSpec(system.inputs, system.outputs, self.dt, system.states)
        self.nx, self.np = system.nx, system.np
        self.sampled = SampledBlocks(cast(Any, system), self.dt)
        columns = list(system.variables)
        self._columns = columns
        self._states = [columns.index(state.name) for state in system.inner_states]
        self._q = np.array([columns.index(coordinate.position) for coordinate in system.coordinates], dtype=np.int64)
        self._v = np.array(
            [columns.index(coordinate.rate) if coordinate.rate is not None else 0 for coordinate in system.coordinates],
            dtype=np.int64,
        )
        self._free = [k for k, parameter in enumerate(system.parameters) if not parameter.fixed]
        self._compilation: Any = None
        self._library: Any = None
        self._memory: Recent[bytes, tuple[FloatArray, FloatArray, FloatArray]] = Recent(KEPT)
        self._runs: Recent[bytes, tuple[FloatArray, FloatArray]] = Recent(KEPT)
        self.wanted: frozenset[int] | None = None
        """Columns of (p, x0) by which derivatives are computed, None for all; the others are 0."""
        self._lent: list[Loan] | None = None
        self.one_sided = False
        """Whether differences by parameters are taken from one side, at half the runs, where a fit is a rough one."""
        blocks = {parameter for _, _, parameter in self.sampled.output_blocks}
        self._unknowns = [*(k for k in self._free if k not in blocks), *self.state_columns]
        self._names = [*system.parameter_names, *(state.name for state in system.states)]
        ports = [(placed, port_of(cast(Any, system), placed).kind) for placed in system.effects]
        before = [placed for placed, kind in ports if kind != "output"]
        self._still: set[str] = set()  # States whose start moves no output
        self._looks = any(kind != "input" for _, kind in ports)  # Effects may read positions that no output tells
        self._drivers = repr([str(placed) for placed in before]).encode()
        self._driving = [] if system.around is None else system.around.driving

    @contextmanager
    def deriving(self, columns: Iterable[int], lent: list[Loan] | None = None) -> Iterator[None]:
        """Compute derivatives by these columns of (p, x0) only: each of them costs a run, unless it is lent."""
        before = self.wanted, self._lent
        self.wanted, self._lent = frozenset(int(k) for k in columns), lent
        try:
            yield
        finally:
            self.wanted, self._lent = before

    def forget(self) -> None:
        """Forget the derivatives that were taken: those of first steps are rough."""
        self._memory.clear()

    @property
    def state_columns(self) -> range:
        """The columns of (p, x0) that are initial states."""
        return range(self.np, self.np + self.nx)

    def hidden_start(self, x: Any, u: Any, p: Any) -> FloatArray:
        """Return where the hidden states of effects start (hidden_count,), x being a whole state."""
        found: FloatArray = self.hidden_starts(np.asarray(x)[None], np.asarray(u)[None], p)[0]
        return found

    def hidden_starts(self, x: FloatArray, u: FloatArray, p: FloatArray) -> FloatArray:
        """Return the same (N, hidden_count) for states (N, nx) and inputs (N, nu)."""
        system, n = self.system, x.shape[0]
        if not system.hidden_count or system.around is None:
            return np.zeros((n, 0))
        names = [state.name for state in system.inner_states]

        def state(name: str | None) -> FloatArray:
            return x[:, names.index(name)] if name in names else np.zeros(n)

        q, v = (
            np.array([state(name) for name in which]).reshape(len(which), n)
            for which in (
                [coordinate.position for coordinate in system.coordinates],
                [coordinate.rate for coordinate in system.coordinates],
            )
        )
        many = np.repeat(np.asarray(p, dtype=float)[system.inner_count :, None], n, axis=1)
        found = system.around.functions["starts"](u.T, q, v, many)
        return np.asarray(found.full().T.reshape(n, system.hidden_count), dtype=float)

    def sensitivities(
        self, p: FloatArray, x0: FloatArray, U: FloatArray, *, t0: float = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return states (N, nx), outputs (N, ny) and derivatives of the outputs by the initial states (N, ny, nx)."""
        seen, gradient = self.sampled.inputs(U[None], p[None], True)
        x, y, s = self.windows(p[None], x0[None], seen, gradient, np.array([t0]))
        assert s is not None
        return x[0], y[0], s[0][..., self.np :]

    def windows(
        self,
        p: FloatArray,
        x0: FloatArray,
        u: FloatArray,
        slope: FloatArray | None,
        t0: FloatArray,
        *,
        sensitivities: bool = True,
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Return states (M, N, nx), outputs (M, N, ny), derivatives (M, N, ny, np + nx) by (p, x0); see Simulator."""
        m, n = u.shape[:2]
        x, y = np.empty((m, n, self.nx)), np.empty((m, n, self.system.ny))
        s = np.zeros((m, n, self.system.ny, self.np + self.nx)) if sensitivities else None
        for k in range(m):
            if s is None:
                x[k], y[k] = self.run(p[k], x0[k], u[k], t0[k])
            else:
                late = None if slope is None else slope[k]
                x[k], y[k], s[k] = self._differences(p[k], x0[k], u[k], late, float(t0[k]))
        y, s = self.sampled.outputs(y, s, p)
        return x, y, s

    def sums(self, given: Given, asked: Asked) -> Sums:
        """Return the normal equations of windows of one length; see :func:`harness.blackbox.sums.summed`."""
        p, x0, u, input_jacobian, t0 = given

        def run(k: int) -> tuple[FloatArray, FloatArray]:
            x, y = self.kept_run(p[k], x0[k], u[k], float(t0[k]))
            return x, self.sampled.outputs(y[None], None, p[k : k + 1])[0][0]

        def slopes(k: int, chosen: npt.NDArray[np.intp] | None) -> FloatArray:
            late = None if input_jacobian is None else input_jacobian[k]
            with self.deriving(range(self.np + self.nx) if chosen is None else chosen.tolist()):
                _, y, s = self._differences(p[k], x0[k], u[k], late, float(t0[k]))
            found = self.sampled.outputs(y[None], s[None].copy(), p[k : k + 1])[1]
            assert found is not None
            return np.asarray(found[0])

        return summed(run, slopes, asked, nx=self.nx, unknowns=self.np + self.nx)

    def run(
        self, p: FloatArray, x0: FloatArray, u: FloatArray, t0: float = 0.0, extra: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return states (N, nx) and outputs (N, ny) of one free run; NaN from where the FMU fails.

        ``extra`` (N, nu) is added to what the effects make of the input ``u`` (N, nu).
        """
        table, hidden, _, y = self._simulated(p, x0, u, t0, extra)
        return np.concatenate([table[:, self._states], hidden], axis=1), y

    def kept_run(self, p: FloatArray, x0: FloatArray, u: FloatArray, t0: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Return what :meth:`run` does; the last few are kept, for the derivatives at a step that a fit takes."""
        key = _key(p, x0, u, t0)
        if key not in self._runs:
            self._runs[key] = self.run(p, x0, u, t0)
        return self._runs[key]

    def motion(
        self, p: FloatArray, x0: FloatArray, u: FloatArray, t0: float = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return positions (N, n), rates (N, n) and outputs (N, ny) of one free run."""
        table, _, rates, y = self._simulated(p, x0, u, t0, None)
        q = table[:, self._q]
        if self.system.around is None:
            v = np.gradient(q, self.dt, axis=0) if q.size else q
            told = [coordinate.rate is not None for coordinate in self.system.coordinates]
            rates = np.where(told, table[:, self._v], v)
        return q, rates, y

    def _simulated(
        self, p: FloatArray, x0: FloatArray, u: FloatArray, t0: float, extra: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the FMU's variables, hidden states, rates of the coordinates and readings of one free run.

        Where only the sensors change, the FMU is not run again.
        """
        system = self.system
        u = self.sampled.begun(u, p, x0)
        own = np.array(p[system.inner_count :], dtype=float)
        asked = _key(np.concatenate([p[: system.inner_count], own[self._driving]]), x0, u, t0) + self._drivers
        kept = self.runner.tables.get(asked) if extra is None else None
        if kept is None:
            kept = self._stepped(p, x0, u, t0, extra)
            if extra is None:
                self.runner.tables[asked] = kept
        table, hidden, rates = kept
        y = table[:, : system.ny].copy()
        if system.around is not None and system.around.reads and np.isfinite(table).all():
            y = self._readings(table, rates, own, t0)
        return table, hidden, rates, y

    def _stepped(
        self, p: FloatArray, x0: FloatArray, u: FloatArray, t0: float, extra: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the FMU's variables, hidden states and rates of the coordinates of one run of the FMU."""
        system = self.system
        parts = 1 if system.around is None else system.exchanges
        n = (u.shape[0] - 1) * parts + 1
        if parts > 1:
            u, extra = np.repeat(u, parts, axis=0)[:n], None if extra is None else np.repeat(extra, parts, axis=0)[:n]
        inner, runner = system.inner_count, self.runner.finer(parts)
        values = {parameter.name: float(value) for parameter, value in zip(system.parameters[:inner], p, strict=False)}
        start = {state.name: float(value) for state, value in zip(system.inner_states, x0, strict=False)}
        table = np.full((n, len(self._columns)), np.nan)
        hidden = np.full((n, system.hidden_count), np.nan)
        rates = np.zeros((n, len(system.coordinates)))
        past = np.zeros(1 + 2 * len(system.coordinates))
        z = np.array(x0[len(system.inner_states) :], dtype=float)
        own = np.array(p[inner:], dtype=float)

        def work() -> None:
            table[0] = runner.start(values, start)
            if system.around is None:
                pushed = u if extra is None else u + extra
                table[1:] = runner.plant.rollout(np.ascontiguousarray(pushed[:-1]))
            else:
                self._coupled(_Run(table, hidden, rates, past, z, own, u, extra, t0, runner.plant, self.dt / parts))

        try:
            if not np.isfinite(x0).all():
                raise ArithmeticError("a start that is not finite")
            runner.run(work, n)
        except (HarnessError, ArithmeticError):
            table = table.copy()  # who does not come back may still write into the other
            table[1:] = np.nan
        return tuple(np.ascontiguousarray(one[::parts]) for one in (table, hidden, rates))  # type: ignore[return-value]

    # ---- the work ------------------------------------------------------------------------------------------------

    def _differences(
        self, p: FloatArray, x0: FloatArray, u: FloatArray, gradient: FloatArray | None, t0: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return states, outputs and derivatives of one window; the last few are remembered."""
        wanted = frozenset(range(self.np + self.nx)) if self.wanted is None else self.wanted
        key = repr((sorted(wanted), self._lent is None)).encode() + _key(p, x0, u, t0)
        if key in self._memory:
            x, y, s = self._memory[key]
            return x, y, s
        x, y = self.kept_run(p, x0, u, t0)
        s = np.zeros((*y.shape, self.np + self.nx))
        if np.isfinite(y).all():
            lent, slopes = self._borrowed(p, y), {}
            without = self.sampled.delay_columns if gradient is None else ()
            for k in sorted(wanted.intersection(self._unknowns).difference(without)):
                if (name := self._names[k]) in lent:
                    s[..., k] = lent[name]
                    continue
                if k < self.np:
                    s[..., k] = self._by_parameter(k, p, x0, u, gradient, y, t0)
                elif name not in self._still:
                    s[..., k] = self._by_start(k - self.np, p, x0, u, x, y, t0)
                if k < self.system.inner_count or 0 <= k - self.np < len(self._states):
                    slopes[name] = s[..., k]
            if self._lent is not None and not lent and np.isfinite(s).all():
                self._lent.append(Loan(p[: self.system.inner_count].copy(), y, slopes))
        self._memory[key] = (x, y, s)
        return x, y, s

    def _borrowed(self, p: FloatArray, y: FloatArray) -> Mapping[str, FloatArray]:
        """Return derivatives that are lent to a run with these outputs (N, ny), by name; none where none holds."""
        inner = p[: self.system.inner_count]
        return next((loan.slopes for loan in self._lent or () if loan.holds(inner, y)), {})

    def _by_start(
        self, row: int, p: FloatArray, x0: FloatArray, u: FloatArray, x: FloatArray, y: FloatArray, t0: float
    ) -> FloatArray:
        """Return the derivative of the outputs by the start of a state (N, ny); 0 of one that moves none of them.

        A fit would drive that anywhere, as an angle of which only the speed is measured: what it moves are the
        solver's last digits. Where no effect looks at a motion it is not asked for again.
        """
        size, begun = self._size(row, x, u), x0.copy()
        begun[row] += STEP * size
        found = (self.run(p, begun, u, t0)[1] - y) / (STEP * size)
        still = bool((size * np.sqrt(np.mean(found**2, axis=0)) <= STILL * np.std(y, axis=0)).all())
        if still and not self._looks:
            self._still.add(self.system.states[row].name)
        return np.zeros_like(y) if still else np.asarray(found)

    def _size(self, row: int, x: FloatArray, u: FloatArray) -> float:
        """Return the size of a state along a run; of what went in before the record, that of the input."""
        column = next((column for column, _, state in self.sampled.before if state == row), None)
        size = float(np.sqrt(np.mean((x[:, row] if column is None else u[:, column]) ** 2)))
        return size if np.isfinite(size) and size > 0 else 0.01

    def _by_parameter(
        self,
        k: int,
        p: FloatArray,
        x0: FloatArray,
        u: FloatArray,
        gradient: FloatArray | None,
        y: FloatArray,
        t0: float,
    ) -> FloatArray:
        """Return the derivative of the outputs by a parameter (N, ny); one-sided in rough fits and first steps."""
        moved = p.copy()
        if k in self.sampled.delay_columns:
            assert gradient is not None
            h = 0.01 * self.dt
            moved[k] += h
            u = u + h * gradient[..., self.sampled.delay_columns.index(k)]
            return np.asarray((self.run(moved, x0, u, t0)[1] - y) / h)
        if self.one_sided or (self._lent is not None and k >= self.system.inner_count):
            parameter = self.system.parameters[k]
            h = STEP * max(abs(p[k]), 0.1 * abs(parameter.value), 1e-6)
            moved[k] += h if moved[k] + h < parameter.maximum else -h
            there = self.run(moved, x0, u, t0)[1]
            if np.isfinite(there).all():
                return np.asarray((there - y) / (moved[k] - p[k]))
        return self._derivative(k, p, x0, u, y, t0)

    def _derivative(self, k: int, p: FloatArray, x0: FloatArray, u: FloatArray, y: FloatArray, t0: float) -> FloatArray:
        """Return the derivative of the outputs ``y`` by a parameter (N, ny); NaN if the FMU fails on every side.

        From both sides, and over a step along which the outputs hardly bend: a spring and a mass both move the phase of
        a long swing, and what they do together is the small difference of that. A bound itself may be refused, as a
        mass of 0 is, and the common step be too long for a parameter that fell far below its declared value, as for
        damping on next to no inertia: then the difference is one-sided, or shorter.
        """
        parameter, known = self.system.parameters[k], self.runner.steps
        size, which = max(abs(p[k]), 0.1 * abs(parameter.value), 1e-6), (parameter.name, len(y))

        def beside(step: float) -> FloatArray:
            moved = p.copy()
            moved[k] += step
            inside = parameter.minimum < moved[k] < parameter.maximum
            return self.run(moved, x0, u, t0)[1] if inside else np.full_like(y, np.nan)

        h, least, slope = size * known.get(which, STEP), np.inf, None
        while True:
            above, below = beside(h), beside(-h)
            if not (np.isfinite(above).all() and np.isfinite(below).all()):
                break
            curved, apart = (float(np.linalg.norm(one)) for one in (above - 2 * y + below, above - below))
            bend = curved / apart if apart > 0.0 else (np.inf if curved > 0.0 else 0.0)
            if bend >= least:  # what is seen is the solver's own error
                break
            slope, least = (above - below) / (2 * h), bend
            wanted = h * max(0.5 * BEND / bend, SHORTEST) if bend > 0.0 else np.inf
            known[which] = min(wanted / size, STEP)  # where the motion bends less, later steps are long again
            if bend <= BEND:
                break
            h = wanted
        if slope is not None:
            return np.asarray(slope)
        for step in (h, 1e-3 * h, 1e-6 * h):
            for side in (step, -step):
                there = beside(side)
                if np.isfinite(there).all():
                    return np.asarray((there - y) / side)
        return np.full_like(y, np.nan)

    def _coupled(self, run: _Run) -> None:
        """Step FMU and effects together, in C where there is a compiler and the FMU lets us."""
        table, hidden, rates, past, z, p, u, extra, t0, plant, h = run
        step = plant.native_step()
        library = None if step is None else self._built()
        if library is None or step is None:
            self._in_python(run)
            return
        u = np.ascontiguousarray(u, dtype=float)
        added = None if extra is None else np.ascontiguousarray(extra, dtype=float)
        n, first = u.shape[0], 0
        while first < n - 1:
            first = library.coupled(
                step.call,
                step.loop,
                step.u.ctypes.data,
                step.y.ctypes.data,
                table.shape[1],
                self._q.ctypes.data,
                self._v.ctypes.data,
                u.ctypes.data,
                None if added is None else added.ctypes.data,
                n,
                first,
                t0,
                h,
                p.ctypes.data,
                z.ctypes.data,
                past.ctypes.data,
                table.ctypes.data,
                rates.ctypes.data,
                hidden.ctypes.data,
            )
            if first < n - 1:  # the step was not brought to its end in C
                if not np.isfinite(step.u).all():
                    raise ArithmeticError("a command that is not finite")
                plant.finish_step()
                first += 1
                table[first] = step.y

    def _in_python(self, run: _Run) -> None:
        """Do the same step by step: slower, for systems without a compiler and FMUs that are stepped from Python."""
        table, hidden, rates, past, z, p, u, extra, t0, plant, h = run
        around = self.system.around
        assert around is not None
        told = np.array(around.rates, dtype=bool)
        for k in range(u.shape[0]):
            hidden[k] = z
            q, v = table[k, self._q], table[k, self._v]
            a, b = past[1::2], past[2::2]
            first, second = past[0] < 1, past[0] < 2
            difference = np.zeros_like(q) if first else (q - a) / h if second else (3 * q - 4 * a + b) / (2 * h)
            bend = np.zeros_like(q) if second else (q - 2 * a + b) / h**2
            rates[k] = np.where(told, v, difference)
            acceleration = np.where(told, 0.0 if first else (v - a) / h, bend)
            if k == u.shape[0] - 1:
                return
            mean = np.zeros(self.system.nu)
            part = h / around.points
            for s in range(around.points):
                passed = (s + 0.5) * part
                moved = (
                    q + passed * (rates[k] + 0.5 * passed * acceleration),
                    rates[k] + passed * acceleration,
                    t0 + k * h + passed,
                )

                def at(name: str, state: FloatArray, row: int = k, moved: Any = moved) -> FloatArray:
                    return np.array(around.functions[name](u[row], *moved, state, p), dtype=float).reshape(-1)

                middle = z
                if z.size:
                    k1 = at("derivatives", z)
                    k2 = at("derivatives", z + 0.5 * part * k1)
                    middle = z + 0.5 * part * k2
                    k3 = at("derivatives", middle)
                    k4 = at("derivatives", z + part * k3)
                    z = z + part / 6 * (k1 + 2 * (k2 + k3) + k4)
                mean += at("command", middle) / around.points
            past[2::2], past[1::2] = a.copy(), np.where(told, v, q)
            past[0] += 1
            if extra is not None:
                mean += extra[k]
            if not np.isfinite(mean).all():
                raise ArithmeticError("a command that is not finite")
            table[k + 1] = plant.step(mean)

    def _readings(self, table: FloatArray, rates: FloatArray, p: FloatArray, t0: float) -> FloatArray:
        """Return what the sensors tell (N, ny)."""
        around = self.system.around
        assert around is not None
        n = table.shape[0]
        t = t0 + self.dt * np.arange(n)
        many = np.repeat(p[:, None], n, axis=1)
        found = around.functions["reading"](table[:, : self.system.ny].T, table[:, self._q].T, rates.T, t[None], many)
        return np.asarray(found.full().T.reshape(n, self.system.ny), dtype=float)

    def _built(self) -> Any:
        """Return the compiled coupling, None where there is no compiler."""
        if self._library is None:
            if self._compilation is None:
                from harness.physics.compiled.compilation import Compilation

                assert self.system.around is not None
                self._compilation = Compilation(self.system.around.source + _LOOP)
            library = self._compilation.library()
            if library is None:
                return None
            pointer, count, number = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
            library.coupled.argtypes = [
                *[pointer] * 4, count, *[pointer] * 4, count, count, number, number, *[pointer] * 6
            ]  # fmt: skip
            library.coupled.restype = count
            self._library = library
        return self._library


def _key(p: FloatArray, x0: FloatArray, u: FloatArray, t0: float) -> bytes:
    """Return what tells a free run from another."""
    return b"".join([p.tobytes(), x0.tobytes(), np.float64(t0).tobytes(), u.tobytes()])


_LOOP = """
#include <stdint.h>
#include <string.h>
typedef int Call(void *loop);

/* Couple from row `first` on; returns the row at which the box's step broke off, or n - 1. */
__attribute__((visibility("default")))
int64_t coupled(Call *call, void *loop, double *input, const double *output, int64_t width, const int64_t *at_q,
                const int64_t *at_v, const double *u, const double *extra, int64_t n, int64_t first, double t0,
                double h, const double *p, double *z, double *past, double *table, double *rates, double *hidden)
{
  double q[NC + 1], v[NC + 1], acceleration[NC + 1];
  for (int64_t k = first;; k++) {
    const double *row = table + k * width;
    double *rate = rates + k * NC;
    for (int i = 0; i < NZ; i++) hidden[k * NZ + i] = z[i];
    for (int i = 0; i < NC; i++) q[i] = row[at_q[i]], v[i] = row[at_v[i]];
    motion(past, q, v, h, rate, acceleration);
    if (k == n - 1) return k;
    ahead(u + k * NU, q, rate, acceleration, t0 + (double)k * h, h, p, z, input);
    remember(past, q, v);
    if (extra)
      for (int i = 0; i < NU; i++) input[i] += extra[k * NU + i];
    for (int i = 0; i < NU; i++)
      if (!isfinite(input[i])) return k;
    if (call(loop)) return k;
    memcpy(table + (k + 1) * width, output, (size_t)width * sizeof(double));
  }
}
"""
