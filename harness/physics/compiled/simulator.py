"""Fixed-step simulation of a system with forward sensitivities, compiled to C or on CasADi's virtual machine."""

from __future__ import annotations

import ctypes
import functools
import math
from typing import Any, Literal

import casadi as ca
import numpy as np

from harness.errors import InputError
from harness.physics.compiled.ccode import FINE, without_signs
from harness.physics.compiled.compilation import Compilation, compiles
from harness.physics.compiled.rollout_call import Asked, Given, Sums, all_columns, call_rollout
from harness.physics.compiled.rollout_code import Functions
from harness.physics.compiled.rollout_source import rollout_source
from harness.physics.compiled.sampled import SampledBlocks
from harness.physics.definition.model_equations import Equations
from harness.signals import FloatArray, PlantSpec

Backend = Literal["auto", "c", "casadi"]
Intersample = Literal["zoh", "foh", "smooth"]

# "auto" starts the compiler in the background once the virtual machine has simulated so many samples.
_PATIENCE = 2000
_MAXIMUM_SUBSTEPS = 50
_OVER = 5.0  # Time constants in a sample after which nothing is left of a decay.
# A sample has at least so many pieces where inputs move within it: smooth ones straight, late held ones constant.
_PIECES = 4


def default_substeps(system: Equations, dt: float, p: FloatArray | None = None, *, followed: float = math.inf) -> int:
    """Return how many Runge-Kutta steps a sample needs, from the eigenvalues of the system at rest.

    The classical method's error per step is (lambda h)^5 / 120: 0.35 for an oscillation, 0.7 for a decay, and 1.4 for
    one that is over within the sample: of that one, all steps together leave as little as there is. Where a force takes
    the sign of a speed, steps near zero are divided by themselves (``Equations.switches``).

    ``followed`` is how far [rad] an oscillation turns within a sample at most if its phase is to be right; a faster one
    gets steps of 1.4, at which the method is stable. At pi, half of the sampling frequency, readings lose its phase.
    """
    n = system.nx
    if n == 0:
        return 1
    known: dict[str, Any] = system.__dict__  # a search asks for every set of parameters that it tries
    if "_state_jacobian" not in known:
        arguments = [system.x, system.u, system.p, system.t]
        known["_state_jacobian"] = ca.Function("A", arguments, [ca.jacobian(system.f, system.x)])
    jacobian = known["_state_jacobian"]
    values = np.array(system.vector() if p is None else p, dtype=float)

    def needed(parameters: FloatArray) -> float:
        a = jacobian(np.zeros(n), np.zeros(system.nu), parameters, 0.0).full()
        if not np.isfinite(a).all():
            return 1.0
        eigenvalues = dt * np.linalg.eigvals(a)
        decay = float(np.abs(eigenvalues.real).max())
        turn = float(np.abs(eigenvalues.imag).max())
        return max(min(decay, _OVER) / 0.7, decay / 1.4, min(turn, followed) / 0.35, turn / 1.4)

    need = needed(values)
    if system.switches:
        need = max(needed(without_signs(system, values)), need / FINE)
    return int(np.clip(np.ceil(need), 1, _MAXIMUM_SUBSTEPS))


class Simulator:
    """Simulates a system at a fixed sample time (classical Runge-Kutta method of order 4, with substeps).

    Parameters
    ----------
    system : Equations
    dt : float
        Sample time [s].
    intersample : {"zoh", "foh", "smooth"}
        Input held; moving on a straight line to the next sample (held after the last); or on the quintic spline through
        the samples, for an input that was measured behind an anti-aliasing filter and not held by a converter.
    substeps : int, optional
        Runge-Kutta steps in a sample; by default from the eigenvalues of the system at its nominal parameters.
    backend : {"auto", "c", "casadi"}
        ``"c"`` compiles first; ``"casadi"`` never does; ``"auto"`` works on CasADi's virtual machine and changes to
        compiled code, made meanwhile in the background, once the work is large. All three give the same bits.

    Attributes
    ----------
    spec : PlantSpec
    nx, np : int
    parameter_names : tuple of str
    substeps : int

    Notes
    -----
    All methods take one record, x0 (nx,), U (N, nu), or a batch of M windows of equal length, x0 (M, nx), U (M, N, nu),
    with t0 a number or (M,), and p (np,) or (M, np); the results have the same leading axis. A system without inputs
    takes U of shape (N, 0). ``y[k] = h(x[k], u[k])`` where x[0] = x0. A rollout that diverges is NaN from there on.
    Delays and quantisers of the system act on the samples; before the record the input is held at u[0].

    Raises
    ------
    InputError
        If a shape does not fit, or ``backend="c"`` and there is no compiler.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> simulator = pendulum().system().simulator(0.01, backend="casadi")
    >>> y = simulator.rollout([0.1, 0.05, 1.0], [0.5, 0.0], np.zeros((3, 1)))
    >>> y.round(5).tolist()
    [[0.5], [0.49976], [0.49904]]
    """

    def __init__(
        self,
        system: Equations,
        dt: float,
        *,
        intersample: Intersample = "zoh",
        substeps: int | None = None,
        backend: Backend = "auto",
    ) -> None:
        if backend not in ("auto", "c", "casadi") or intersample not in ("zoh", "foh", "smooth"):
            raise InputError(
                "option of a simulator",
                expected="backend auto, c or casadi; intersample zoh, foh or smooth",
                got=f"backend {backend!r}, intersample {intersample!r}",
                remedy="use one of these",
            )
        if substeps is not None and substeps < 1:
            raise InputError("substeps", expected="at least 1", got=str(substeps), remedy="raise it")
        self.system = system
        self.spec = PlantSpec(system.inputs, system.outputs, dt, system.states, system.feedthrough)
        self.nx, self.np, self.parameter_names = system.nx, system.np, system.parameter_names
        self.dt, self.intersample = float(dt), intersample
        self.substeps = default_substeps(system, dt) if substeps is None else int(substeps)
        self.functions, self.sampled = Functions(system), SampledBlocks(system, self.dt, held=intersample == "zoh")
        fine = intersample == "smooth" or (intersample == "zoh" and bool(self.sampled.input_delays))
        self.substeps = max(self.substeps, _PIECES) if fine else self.substeps
        self.pieces = self.substeps if fine else 1
        self.backend = backend
        self._finer: list[tuple[FloatArray, FloatArray]] = []
        self._between = SampledBlocks(system, self.dt / self.pieces)
        self._compilation: dict[bool, Compilation] = {}
        self._work = 0
        self._compiles = compiles()
        if backend == "c" and not self._compiles:
            remedy = 'install one, or use backend "casadi"'
            raise InputError("no C compiler", expected="gcc or cc", got="none", remedy=remedy)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what it was made of; functions and compiled code are made again."""
        return _rebuilt, (self.system, self.dt, self.intersample, self.substeps, self.backend)

    # ---- public --------------------------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Start compiling the sensitivities in the background, whatever the backend's patience."""
        if self.backend != "casadi":
            self._compiled(True).start()

    def library(self, *, sensitivities: bool = False) -> ctypes.CDLL | None:
        """Return the compiled rollout, compiling it if needed; None where that is impossible."""
        return None if self.backend == "casadi" else self._compiled(sensitivities).library()

    def rollout(self, p: Any, x0: Any, U: Any, *, t0: Any = 0.0) -> FloatArray:
        """Return the outputs Y (N, ny), or (M, N, ny)."""
        _, y, _ = self._run(p, x0, U, t0, sensitivities=False)
        return y

    def states(self, p: Any, x0: Any, U: Any, *, t0: Any = 0.0) -> FloatArray:
        """Return the states X (N, nx), or (M, N, nx); X[0] = x0."""
        x, _, _ = self._run(p, x0, U, t0, sensitivities=False)
        return x

    def sensitivities(self, p: Any, x0: Any, U: Any, *, t0: Any = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return Y (N, ny), dY/dp (N, ny, np) and dY/dx0 (N, ny, nx), with the axis M in front for a batch."""
        _, y, s = self._run(p, x0, U, t0, sensitivities=True)
        assert s is not None
        return y, s[..., : self.np], s[..., self.np :]

    def step(self, x: Any, u: Any, p: Any, t: float = 0.0) -> FloatArray:
        """Return the state one sample later, u held; delays and quantisers are not in it."""
        found: FloatArray = self.functions.step(self.dt / self.substeps, self.substeps)(x, u, p, t).full()[:, 0]
        return found

    def output(self, x: Any, u: Any, p: Any, t: float = 0.0) -> FloatArray:
        """Return the output (ny,); delays and quantisers are not in it."""
        found: FloatArray = self.functions.output(x, u, p, t).full()[:, 0]
        return found

    def derivative(self, x: Any, u: Any, p: Any, t: float = 0.0) -> FloatArray:
        """Return dx/dt (nx,)."""
        found: FloatArray = self.functions.derivative(x, u, p, t).full()[:, 0]
        return found

    def hidden_start(self, x: Any, u: Any, p: Any) -> FloatArray:
        """Return where the hidden states of effects start (hidden_count,), x being a whole state."""
        return self.functions.initial(x, u, p).full()[:, 0] if self.system.hidden_count else np.zeros(0)

    # ---- the work ------------------------------------------------------------------------------------------------

    def _run(
        self, p: Any, x0: Any, U: Any, t0: Any, *, sensitivities: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Check shapes, delay the inputs, simulate, delay the outputs."""
        inputs = np.asarray(U, dtype=float)
        batch = inputs.ndim == 3
        if not batch:
            inputs = inputs[None] if inputs.ndim == 2 else inputs
        nu = self.spec.nu
        if inputs.ndim != 3 or inputs.shape[2] != nu:
            raise InputError(
                f"inputs of {self.system.name}",
                expected=f"shape (N, {nu}), or (M, N, {nu}) for a batch",
                got=str(np.shape(U)),
                remedy="put time before the inputs; use np.zeros((N, 0)) if there are none",
            )
        m = inputs.shape[0]
        start = self._fit(x0, "initial state", m, self.nx, batch)
        values = self._fit(p, "parameters", m, self.np, np.ndim(p) == 2)
        times = np.ascontiguousarray(np.broadcast_to(np.asarray(t0, dtype=float), (m,)))
        seen, input_jacobian = self.seen(inputs, values, sensitivities)
        x, y, s = self.windows(values, start, seen, input_jacobian, times, sensitivities=sensitivities)
        return (x, y, s) if batch else (x[0], y[0], None if s is None else s[0])

    def windows(
        self,
        p: FloatArray,
        x0: FloatArray,
        u: FloatArray,
        input_jacobian: FloatArray | None,
        t0: FloatArray,
        *,
        sensitivities: bool = True,
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Return states, outputs and sensitivities of windows whose inputs are as the equations see them.

        Parameters
        ----------
        p : array (M, np)
        x0 : array (M, nx)
        u : array (M, rows, nu)
            See :meth:`seen`.
        input_jacobian : array (M, rows, nu, delays) or None
            Derivatives of u by the delays.
        t0 : array (M,)
        sensitivities : bool

        Returns
        -------
        X (M, N, nx), Y (M, N, ny), S (M, N, ny, np + nx) or None
            All contiguous; shapes are not checked.
        """
        seen, pieces = np.ascontiguousarray(u), self.pieces
        input_jacobian = None if input_jacobian is None else np.ascontiguousarray(input_jacobian)
        library = self._library(sensitivities, seen.shape[0] * self.samples(seen.shape[1]))
        run = self._in_casadi if library is None else functools.partial(self._in_c, library)
        given = Given(p, x0, seen, input_jacobian, t0)
        x, y, s = run(given, sensitivities, self.dt / pieces, 1 if pieces > 1 else self.substeps)
        if pieces > 1:
            x, y = np.ascontiguousarray(x[:, ::pieces]), np.ascontiguousarray(y[:, ::pieces])
            s = None if s is None else np.ascontiguousarray(s[:, ::pieces])
        y, s = self.sampled.outputs(y, s, p)
        return x, y, s

    def sums(self, given: Given, asked: Asked) -> Sums | None:
        """Simulate windows as :meth:`windows` does and sum up the normal equations on the way.

        Returns
        -------
        Sums or None
            None if that is not possible: no compiled code, or sensors that act on the samples.
        """
        p, x0, u, input_jacobian, t0 = given
        (measured, sigma, period), columns, limits, budget, keep, sensitivities = asked
        possible = self.backend != "casadi" and self._compiles and not self.sampled.output_blocks
        if not possible or (library := self._compiled(True).library()) is None:
            return None
        m, n, ny, ns = u.shape[0], self.samples(u.shape[1]), self.spec.ny, self.np + self.nx
        substeps, every = (1, self.pieces) if self.pieces > 1 else (self.substeps, 1)
        found = Sums(np.zeros(m), np.zeros(ny), np.zeros((m, ns, ns)), np.zeros((m, ns)), budget, None, None, None)
        if keep:
            found.states, found.residuals = np.empty((m, n, self.nx)), np.empty((m, n, ny))
        if sensitivities:
            columns, found.sensitivities = None, np.empty((m, n, ny, ns))
        chosen = all_columns(ns) if columns is None else np.ascontiguousarray(columns, dtype=np.intc)
        arrays = {"p": p, "x0": x0, "u": u, "d": input_jacobian, "t0": t0, "columns": chosen, "limit": limits}
        arrays |= {"measured": measured, "sigma": sigma, "period": period}
        arrays |= {"x": found.states, "y": found.residuals, "s": found.sensitivities}
        arrays |= {"cost": found.costs, "squares": found.squares, "gram": found.gram, "gradient": found.gradient}
        foh = self.intersample != "zoh"
        found.budget = call_rollout(library, self.dt / every, substeps, foh, every, budget, **arrays)
        return found

    def _fit(self, given: Any, what: str, m: int, size: int, batch: bool) -> FloatArray:
        """Return an array (m, size), or refuse the shape."""
        array = np.asarray(given, dtype=float)
        wanted = (m, size) if batch else (size,)
        if array.shape != wanted and not (batch and array.shape == (size,)):
            raise InputError(
                f"{what} of {self.system.name}",
                expected=f"shape {wanted}" + (f" ({', '.join(self.parameter_names)})" if what == "parameters" else ""),
                got=str(array.shape),
                remedy="give one number for each",
            )
        if array.ndim == 1:
            array = np.broadcast_to(array, (m, size))
        return np.ascontiguousarray(array)

    def samples(self, rows: int) -> int:
        """Return the samples that so many rows of inputs belong to."""
        return (rows - 1) // self.pieces + 1

    def seen(self, u: FloatArray, p: FloatArray, jacobian: bool) -> tuple[FloatArray, FloatArray | None]:
        """Return the inputs that the equations see, delayed, and if wanted their Jacobian by the delays.

        A held input that arrives within a sample is not its mean over the sample: a mass that it pushes at once ends
        elsewhere. So each sample has several rows then, as it has where inputs move between samples.

        Parameters
        ----------
        u : array (M, N, nu)
        p : array (M, np)
        jacobian : bool

        Returns
        -------
        array (M, (N - 1) pieces + 1, nu), array (M, (N - 1) pieces + 1, nu, delays) or None
        """
        if self.pieces > 1 and self.intersample == "zoh":
            held = np.repeat(u, self.pieces, axis=1)[:, : (u.shape[1] - 1) * self.pieces + 1]
            return self._between.inputs(np.ascontiguousarray(held), p, jacobian)
        seen, by_delays = self.sampled.inputs(np.ascontiguousarray(u), p, jacobian)
        if self.pieces > 1:
            return self.refined(seen), None if by_delays is None else self.refined(by_delays)
        return seen, by_delays

    def refined(self, signal: FloatArray) -> FloatArray:
        """Return a signal (M, N, ...) on the finer grid of its quintic spline, ((N - 1) substeps + 1) samples.

        The solver joins them by straight lines, whose means miss a twelfth of the curvature: it is taken off before,
        but not where an output shows the input itself. So an input at a third of the sampling frequency keeps its size
        within 1.2 %; on straight lines between the values of a cubic spline, in 4 pieces, it would lose 8 %.
        A fit asks for the same windows again and again: the last few answers are kept.
        """
        from scipy.interpolate import make_interp_spline

        for known, answer in self._finer:
            if known is signal:
                return answer
        n, pieces = signal.shape[1], self.substeps
        grid = np.arange((n - 1) * pieces + 1) / pieces
        if n < 4 or signal.size == 0:
            held = np.minimum(np.round(grid).astype(int), n - 1)
            finer = np.ascontiguousarray(signal[:, held])
        else:
            spline = make_interp_spline(np.arange(n), signal, k=5 if n > 5 else 3, axis=1)
            bent = 0.0 if self.spec.feedthrough else spline.derivative(2)(grid) / (12 * pieces**2)
            finer = np.ascontiguousarray(spline(grid) - bent)
        self._finer = [*self._finer[-7:], (signal, finer)]
        return finer

    def _compiled(self, sensitivities: bool) -> Compilation:
        if sensitivities not in self._compilation:
            source = rollout_source(self.functions, sensitivities, self.sampled.delay_columns)
            self._compilation[sensitivities] = Compilation(source)
        return self._compilation[sensitivities]

    def _library(self, sensitivities: bool, samples: int) -> ctypes.CDLL | None:
        """Return the compiled rollout if it is there, or worth waiting for."""
        if self.backend == "casadi" or not self._compiles:
            return None
        compilation = self._compiled(sensitivities)
        if self.backend == "c":
            return compilation.library()
        if compilation.failed:
            return None
        if compilation.ready():
            return compilation.library()
        self._work += samples * self.substeps * (8 if sensitivities else 1)
        if self._work > _PATIENCE:
            compilation.start()
        # Compiling takes 0.1 to 0.3 s and lasts, the virtual machine about 5 us per unit of work: waiting is shorter.
        if samples * self.substeps * (8 if sensitivities else 1) > 30_000:
            return compilation.library()
        return None

    def _in_c(
        self, library: ctypes.CDLL, given: Given, sensitivities: bool, dt: float, substeps: int
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        p, x0, u, input_jacobian, t0 = given
        m, n = u.shape[:2]
        ny, ns = self.spec.ny, self.np + self.nx
        x, y = np.empty((m, n, self.nx)), np.empty((m, n, ny))
        s = np.empty((m, n, ny, ns)) if sensitivities else None
        columns = all_columns(ns) if sensitivities else None
        foh = self.intersample != "zoh"
        arrays = {"p": p, "x0": x0, "u": u, "d": input_jacobian, "t0": t0, "columns": columns, "x": x, "y": y, "s": s}
        call_rollout(library, dt, substeps, foh, 1, np.inf, **arrays)
        return x, y, s

    def _in_casadi(
        self, given: Given, sensitivities: bool, dt: float, substeps: int
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        how = dt, substeps, self.intersample != "zoh", sensitivities, self.sampled.delay_columns
        return self.functions.windows(given, how)


def _rebuilt(system: Equations, dt: float, intersample: Intersample, substeps: int, backend: Backend) -> Simulator:
    """Make a simulator again where a pickle of it is opened."""
    return Simulator(system, dt, intersample=intersample, substeps=substeps, backend=backend)
