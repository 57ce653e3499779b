"""One pass of the extended Kalman filter over a record: innovations, their variances, and their derivatives."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from harness.physics.compiled.compilation import Compilation
from harness.physics.compiled.filter_kernels import JOB, filter_kernels
from harness.physics.compiled.filter_machine import FilterMachine, PassRequest
from harness.physics.compiled.rollout_source import RUNGE_KUTTA, STAGE, shared_source
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.compiled.latent import Disturbed, LatentForce
    from harness.physics.compiled.rollout_code import Functions
    from harness.physics.compiled.simulator import Intersample


def filter_source(functions: Functions, delay_columns: tuple[int, ...]) -> str:
    """Return the C source of ``sysid_filter`` for a system whose last states are latent forces: held over a sample.

    - ``functions``: of a system made by :func:`harness.physics.compiled.latent.with_latent_forces`
    - ``delay_columns``: parameters through which the inputs depend on p
    - returns ``int sysid_filter(filter_job *in)``; :mod:`harness.physics.compiled.kalman_pass` calls it

    Notes
    -----
    The state is linearised where the filter predicts it (extended Kalman filter: Jazwinski 1970, sec. 8.3). The
    transition F of a sample is the derivative of the numerical solution itself: columns of unit start vectors are
    carried along the Runge-Kutta stages beside those of the parameters. Outputs are taken one after the other, which
    gives the joint density because their noises are independent. The derivatives of the innovations by parameters and
    initial states hold the gain fixed (Ljung 1999, sec. 10.3 without the derivative of K). The pass itself, which
    needs to know sizes only, is that of :mod:`harness.physics.compiled.filter_kernels`: it calls ``advance`` and
    ``outputs``,
    and takes the covariance over readings and samples, with its derivatives by the noise.

    Examples
    --------
    >>> from harness.physics.compiled.latent import with_latent_forces
    >>> from harness.physics.models import drive
    >>> from harness.physics.compiled.rollout_code import Functions
    >>> source = filter_source(Functions(with_latent_forces(drive().system()).system), ())
    >>> [line for line in source.splitlines() if line.startswith("int ")]
    ['int sysid_filter(filter_job *in) {']
    """
    parts = shared_source(functions, True, delay_columns, extra=functions.system.nx + 3)  # in blocks of their own
    readings = functions.readings(delay_columns)
    scatter = [f"  c[{row}*NX + {column}] = a[{k}];" for k, (row, column, _) in enumerate(readings.entries("by_x"))]
    rows = "\n".join(["static void output_rows(const double *a, double *c) {", "  (void)a; (void)c;", *scatter, "}"])
    return "\n\n".join([*parts, JOB, STAGE, rows, RUNGE_KUTTA, _FILTER]) + "\n"


_FILTER = """\
/* Over a row of the inputs in steps of h: the state, and all blocks of columns. */
static void advance(const sample *here, double time, double h, long many, double *x, block *z, int all, void *room) {
  tangent *at = room;
  double next[NX];
  long j, part;
  int i, c;
  for (j = 0; j < many; j++) {
    const double start = time + (double)j*h, of = (double)many;
    runge_kutta(here, x, next, start, h, (double)j/of, ((double)j + 0.5)/of, ((double)j + 1.0)/of, at);
    if (sysid_near_zero(x, next, here->p, h)) { /* a force changes its sign: finer steps */
      for (part = 0; part < FINE; part++) {
        const double q = ((double)j + (double)part/FINE)/of, w = ((double)j + ((double)part + 0.5)/FINE)/of;
        const double g = ((double)j + ((double)part + 1.0)/FINE)/of;
        runge_kutta(here, x, next, start + (double)part*(h/FINE), h/FINE, q, w, g, at);
        for (c = 0; c < all; c++) carry_block(at, z + c*NX, c, h/FINE);
        for (i = 0; i < NX; i++) x[i] = next[i];
      }
    } else {
      for (c = 0; c < all; c++) carry_block(at, z + c*NX, c, h);
      for (i = 0; i < NX; i++) x[i] = next[i];
    }
  }
}

/* The outputs, their rows of derivatives by the state, and those by the parameters that are chosen. */
static void outputs(const sample *here, double time, const double *x, double *y, double *c, block *b) {
  double la[ROOM(LOOK_A)], lb[ROOM(NS*NY)], lf[ROOM(NY*NU)];
  look(x, here->u, here->p, &time, y, la, lb, lf);
  output_rows(la, c);
  if (here->sources) look_source(lb, lf, here->d, here->place + NS, (double *)b);
}

int sysid_filter(filter_job *in) {
  const block none = {0};
  const int chosen = (int)in->chosen;
  block z[(BLOCKS + 1)*NX], b[(BLOCKS + 1)*NY];
  tangent at[4];
  int place[ROOM(2*NS)], i, k;
  long sources = 0;
  for (i = 0; i < NS; i++) { place[i] = BLOCKS*NX*W; place[NS + i] = BLOCKS*NY*W; }
  for (i = 0; i < chosen; i++) {
    place[in->columns[i]] = (i/W)*NX*W + i%W;
    place[NS + in->columns[i]] = (i/W)*NY*W + i%W;
    sources = sources || in->columns[i] < NP;
  }
  for (k = 0; k < 4; k++) for (i = 0; i < (BLOCKS + 1)*NX; i++) at[k].b[i] = none;
  for (i = 0; i < (BLOCKS + 1)*NY; i++) b[i] = none;
  for (i = 0; i < (BLOCKS + 1)*NX; i++) z[i] = none;
  for (i = 0; i < NX; i++) ((double *)z)[place[NP + i] + W*i] = 1.0;
  for (i = 0; i < NX; i++) z[BLOCKS*NX + i] = none;
  {
    const sample first = {in->u, in->u, in->d, in->d, in->p, place, in->foh, sources};
    return in->run(in, first, NU, NW, advance, outputs, z, b, at);
  }
}"""

_LOG_2PI = float(np.log(2 * np.pi))
_COUNTS = ("n", "substeps", "every", "chosen", "foh")
_NUMBERS = ("dt", "t0")
_GIVEN = ("p", "x0", "p0", "u", "d", "columns", "measured", "r", "period", "a", "q", "w", "fade", "q_tau")
_MADE = ("e", "s", "j", "e_noise", "s_noise")
_STORES = ("x_before", "p_before", "x_after", "p_after", "transition", "gain", "row")


@dataclass(frozen=True)
class PassNoise:
    """What disturbs plant and sensors.

    Attributes
    ----------
    r : array (ny,)
        Standard deviation of the sensor noise, white, in the units of the outputs.
    s, tau : array (nl,)
        Standard deviation [force or rate units] and time constant [s] of every latent force, a Gauss-Markov process.
    w : array (nl,)
        Standard deviation of a white part of it, drawn anew for every sample: noise of the recorded input, say.
    """

    r: FloatArray
    s: FloatArray
    tau: FloatArray
    w: FloatArray


@dataclass(eq=False)
class FilterPath:
    """What a smoother needs of a pass: states before and after the outputs of each sample, transitions, gains.

    ``x_before``, ``x_after`` (K, nx); ``p_before``, ``p_after``, ``transition`` (K, nx, nx), from a sample to the next;
    ``gain``, ``row`` (K, ny, nx): outputs are taken one after the other.
    """

    x_before: FloatArray
    p_before: FloatArray
    x_after: FloatArray
    p_after: FloatArray
    transition: FloatArray
    gain: FloatArray
    row: FloatArray


@dataclass(eq=False)
class Filtered:
    """Result of a pass."""

    # (K, ny): Innovations and their variances, each output given those before it; NaN where nothing was measured
    e: FloatArray
    s: FloatArray
    j: FloatArray | None = None  # (K, ny, columns): Derivatives of the innovations, gains held fixed
    path: FilterPath | None = field(default=None, repr=False)
    # (K, ny, 3 nl + ny): Derivatives of the innovations, and of the logarithms of their variances, by the logarithms of
    # the noise: s, tau and w of every latent force, then r of every output. None where only difference quotients can
    # tell.
    e_noise: FloatArray | None = field(default=None, repr=False)
    s_noise: FloatArray | None = field(default=None, repr=False)

    @property
    def terms(self) -> FloatArray:
        """Minus the logarithm of the density of every sample (K,)."""
        with np.errstate(over="ignore"):  # of a run far off its data: the density is 0
            each = 0.5 * (_LOG_2PI + np.log(self.s) + self.e**2 / self.s)
            return np.asarray(np.where(np.isfinite(self.e), each, 0.0).sum(axis=1))

    @property
    def nll(self) -> float:
        """Minus the log-likelihood of the record."""
        with np.errstate(over="ignore"):
            each = self.e * self.e
            each /= self.s
            each += np.log(self.s)
            known = np.isfinite(self.e)
            if not known.all():
                each = each[known]
            return 0.5 * (float(each.sum()) + each.size * _LOG_2PI)


class Pass(Protocol):
    """What gives a record its innovations under a model; see :class:`KalmanPass` for the attributes."""

    forces: tuple[LatentForce, ...]
    state_names: tuple[str, ...]
    dt: float
    substeps: int
    nl: int
    ny: int
    start_size: int
    simulator: Any

    parameter_count: int

    def __call__(self, *given: Any, **how: Any) -> Filtered | None:
        """Return the innovations of a record, None if the state diverges; see :meth:`KalmanPass.__call__`."""
        ...


class _Job(ctypes.Structure):
    """The struct ``filter_job`` of the C source, field by field."""

    _fields_ = (
        *((name, ctypes.c_long) for name in _COUNTS),
        *((name, ctypes.c_double) for name in _NUMBERS),
        *((name, ctypes.c_void_p) for name in (*_GIVEN, *_MADE, *_STORES, "run")),
    )


def _address(array: Any) -> int:
    """Return where an array begins: by its buffer, as numpy takes four times as long to say so."""
    if array.size and array.flags.writeable:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))
    return int(array.ctypes.data)


def _addresses(arrays: Mapping[str, Any]) -> dict[str, int]:
    return {name: _address(array) for name, array in arrays.items()}


@dataclass(frozen=True, eq=False)
class _Arrays:
    """Arrays by their name in a job, and where they begin: a pass over a short record takes less than to ask that."""

    arrays: dict[str, FloatArray]
    addresses: dict[str, int]
    begins: float = 0.0
    """Time of the first sample of a record [s]."""

    @classmethod
    def of(cls, arrays: dict[str, FloatArray], begins: float = 0.0) -> _Arrays:
        """Return arrays with where they begin."""
        return cls(arrays, _addresses(arrays), begins)


class KalmanPass:
    """Filters records with a disturbed system.

    Parameters
    ----------
    disturbed : Disturbed
        See :func:`harness.physics.compiled.latent.with_latent_forces`.
    dt : float
        Sample time [s].
    intersample : {"zoh", "foh", "smooth"}
    substeps : int, optional
    compiled : bool
        False to work on CasADi's virtual machine, some times slower; also where there is no compiler.

    Attributes
    ----------
    nx, nl, ny, parameter_count : int
        States (latent forces included), latent forces, outputs, parameters.
    forces : tuple of LatentForce
    state_names : tuple of str
        States without the latent forces.
    start_size : int
        States without the latent forces: what an initial state has.

    Examples
    --------
    >>> from harness.physics.compiled.latent import with_latent_forces
    >>> from harness.physics.models import pendulum
    >>> from harness.signals import PlantSpec
    >>> system = pendulum().system()
    >>> spec = PlantSpec(system.inputs, system.outputs, 0.01)
    >>> record = Trajectory(np.arange(3) * 0.01, np.zeros((3, 1)), np.array([[0.5], [0.4998], [0.499]]), spec)
    >>> noise = PassNoise(np.array([0.01]), np.array([0.1]), np.array([0.1]), np.zeros(1))
    >>> filtered = KalmanPass(with_latent_forces(system), 0.01)(record, [0.1, 0.05, 1.0], [0.5, 0.0], noise)
    >>> (filtered.s[0] == 0.01**2).tolist(), filtered.e[:2].round(5).tolist()
    ([True], [[0.0], [4e-05]])
    """

    def __init__(
        self,
        disturbed: Disturbed,
        dt: float,
        *,
        intersample: Intersample = "zoh",
        substeps: int | None = None,
        compiled: bool = True,
    ) -> None:
        self.forces, self.dt, self.intersample = disturbed.forces, float(dt), intersample
        system = disturbed.system
        self.state_names = tuple(channel.name for channel in system.states[: system.nx - len(self.forces)])
        self.simulator = system.simulator(dt, intersample=intersample, substeps=substeps)
        self.substeps = self.simulator.substeps
        self.nx, self.ny, self.parameter_count, self.nl = system.nx, system.ny, system.np, len(self.forces)
        self.start_size = self.nx - self.nl
        self.parameter_names = system.parameter_names
        self._period = np.array([channel.period or 0.0 for channel in system.outputs])
        self.sampled = self.simulator.sampled
        self._compilation: Compilation | None = None
        if compiled:
            source = filter_source(self.simulator.functions, self.sampled.delay_columns)
            self._compilation = Compilation(source)
        self._seen: dict[int, tuple[Trajectory, tuple[float, ...], _Arrays]] = {}
        self._noise: tuple[PassNoise, _Arrays] | None = None

    def prepare(self) -> None:
        """Start the compiler in the background."""
        if self._compilation is not None:
            self._compilation.start()

    def __call__(
        self,
        record: Trajectory,
        p: Any,
        x0: Any,
        noise: PassNoise,
        *,
        columns: npt.NDArray[np.intp] | None = None,
        keep: bool = False,
        by_noise: bool = False,
    ) -> Filtered | None:
        """Filter a record.

        - ``record``: readings that are missing are passed over: they correct nothing and have no likelihood
        - ``p`` (np,)
        - ``x0`` (start_size,): known initial state; the latent forces start from their stationary distribution
        - ``columns`` array of int: which of (p, x0) the innovations are differentiated by
        - ``keep``: keep what a smoother needs
        - ``by_noise``: differentiate by the noise too
        - returns None if the state diverged
        """
        p, start = np.ascontiguousarray(p, dtype=float), np.zeros(self.nx)
        start[: self.start_size] = x0
        read = self._read(record, p)
        disturbing = self._disturbing(noise)
        samples, chosen = len(record), 0 if columns is None else len(columns)
        made = Filtered(np.empty((samples, self.ny)), np.empty((samples, self.ny)))
        given = {"p": p, "x0": start, "e": made.e, "s": made.s}
        if columns is not None:
            made.j = given["j"] = np.zeros((samples, self.ny, chosen))
            given["columns"] = np.ascontiguousarray(columns, dtype=np.intc)
        if by_noise:
            lanes = (samples, self.ny, 3 * self.nl + self.ny)
            made.e_noise, made.s_noise = given["e_noise"], given["s_noise"] = np.empty(lanes), np.empty(lanes)
        if keep:
            wide, square, tall = (samples, self.nx), (samples, self.nx, self.nx), (samples, self.ny, self.nx)
            made.path = FilterPath(*(np.empty(shape) for shape in (wide, square, wide, square, square, tall, tall)))
        library = None if self._compilation is None else self._compilation.library()
        steps = None if library is None else filter_kernels(self.nx, self.ny, self.nl)
        if library is None or steps is None:
            whole = {**given, **read.arrays, **disturbing.arrays, "e_noise": made.e_noise}
            return self._in_casadi(record, whole, made, columns)
        if made.path is not None:
            given |= {name: getattr(made.path, name) for name in _STORES}
        every = self.simulator.pieces
        job = _Job(
            n=len(read.arrays["u"]), substeps=1 if every > 1 else self.substeps, every=every, chosen=chosen,
            foh=int(self.intersample != "zoh"), dt=self.dt / every, t0=read.begins, run=steps.run,
            **read.addresses, **disturbing.addresses, **_addresses(given),
        )  # fmt: skip
        return None if library.sysid_filter(ctypes.byref(job)) else made

    def _disturbing(self, noise: PassNoise) -> _Arrays:
        """Return what the pass needs of a noise, made once for all records that are filtered with it."""
        if self._noise is None or self._noise[0] is not noise:
            variance = np.zeros((self.nx, self.nx))
            variance[range(self.start_size, self.nx), range(self.start_size, self.nx)] = noise.s**2
            fade = self.dt / self.simulator.pieces / noise.tau
            self._noise = noise, _Arrays.of(
                {
                    "p0": variance, "r": noise.r**2, "period": self._period, "a": np.exp(-fade),
                    "q": noise.s**2 * -np.expm1(-2 * fade), "w": noise.w**2, "fade": fade,
                    "q_tau": -2 * noise.s**2 * fade * np.exp(-2 * fade),
                }
            )  # fmt: skip
        return self._noise[1]

    def _read(self, record: Trajectory, p: FloatArray) -> _Arrays:
        """Return readings of a record and the inputs that the equations see, with their derivatives by the delays."""
        delays = tuple(p[k] for k in self.sampled.delay_columns)
        known = self._seen.get(id(record))
        if known is None or known[0] is not record or known[1] != delays:
            seen, input_jacobians = self.simulator.seen(record.u[None], p[None], True)
            arrays = {"u": np.ascontiguousarray(seen[0]), "measured": np.ascontiguousarray(record.readings)}
            if input_jacobians is not None:
                arrays["d"] = np.ascontiguousarray(input_jacobians[0])
            known = self._seen[id(record)] = record, delays, _Arrays.of(arrays, float(record.t[0]))
        return known[2]

    def _in_casadi(self, record: Trajectory, given: dict[str, Any], made: Filtered, columns: Any) -> Filtered | None:
        """Do the same on CasADi's virtual machine."""
        every = self.simulator.pieces
        known: dict[Any, FilterMachine] = self.simulator.functions.__dict__.setdefault("_filter_machines", {})
        key = (self.dt, self.substeps, every, self.intersample, self.nl)
        if key not in known:
            known[key] = FilterMachine(
                self.simulator.functions, self.dt / every, 1 if every > 1 else self.substeps, every,
                self.intersample != "zoh", self.sampled.delay_columns, self.nl, self._period,
            )  # fmt: skip
        wanted = PassRequest(columns is not None, made.e_noise is not None, made.path is not None)
        found = known[key](wanted, given, record.t[0] + np.arange(len(record)) * self.dt)
        measured = np.isfinite(record.readings)
        if not (np.isfinite(found["e"][measured]).all() and np.isfinite(found["s"]).all() and (found["s"] > 0).all()):
            return None
        made.e, made.s = found["e"], found["s"]
        if columns is not None:
            made.j = np.ascontiguousarray(found["j"].reshape(len(record), self.ny, -1)[:, :, columns])
        if made.e_noise is not None:
            made.e_noise, made.s_noise = (found[name].reshape(made.e_noise.shape) for name in ("e_noise", "s_noise"))
        if made.path is not None:
            for name in _STORES:
                getattr(made.path, name)[:] = found[name].reshape(getattr(made.path, name).shape)
            made.path.transition[-1] = np.eye(self.nx)  # nothing follows the last sample
        return made
