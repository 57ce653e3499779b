"""A fitted linear model as the sources of a co-simulation FMU, and as a python-control system."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.export.describe import FmuVariable, describe, xml_text
from harness.models.determined import bands_of, bands_words
from harness.models.transforms import Hold, discrete
from harness.models.transforms import continuous as to_continuous
from harness.protocols import Model
from harness.signals import Channel, FloatArray, PlantSpec

if TYPE_CHECKING:
    import control


class Linear(Protocol):
    """``x+ = A x + B u + a``, ``y = C x + D u + c``: what identifiers of linear models return."""

    @property
    def spec(self) -> PlantSpec:
        """Inputs, outputs, sample time."""
        ...

    a_matrix: FloatArray
    b_matrix: FloatArray
    c_matrix: FloatArray
    d_matrix: FloatArray
    state_offset: FloatArray
    output_offset: FloatArray


def to_control(model: Any, *, continuous: Hold | None = None) -> control.StateSpace:
    """Return a linear model as a state-space system of python-control, in discrete time unless asked otherwise.

    Parameters
    ----------
    model : LinearModel
        ``x+ = A x + B u + a``, ``y = C x + D u + c`` at its sample time.
    continuous : {"zoh", "foh", "tustin", "matched"}, optional
        In continuous time, by this view of the inputs between samples (:mod:`harness.models.transforms`).

    Returns
    -------
    control.StateSpace
        With the names of inputs and outputs, and the sample time as ``dt``.

    Raises
    ------
    InputError
        If the model is not linear, or has constant offsets, which a StateSpace cannot hold.

    Examples
    --------
    >>> from identifiers.linear.least_squares import LinearModel
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    >>> one, zero = np.ones((1, 1)), np.zeros(1)
    >>> model = LinearModel(spec, 0.5 * one, one, 2 * one, 0 * one, 0 * one, zero, zero)
    >>> system = to_control(model)
    >>> float(system.dcgain().real), system.dt, system.input_labels
    (4.0, 0.1, ['u'])
    """
    if not all(hasattr(model, name) for name in ("a_matrix", "b_matrix", "c_matrix", "d_matrix")):
        raise InputError(
            "export to python-control",
            expected="a linear model (A, B, C, D)",
            got=type(model).__name__,
            remedy="fit one, for example with the identifier arx, least-squares, dmdc or ho-kalman",
        )
    if np.any(model.state_offset) or np.any(model.output_offset):
        raise InputError(
            "export to python-control",
            expected="a linear model without constant offsets",
            got="offsets that are not zero",
            remedy="fit with offset=false, take load_model(...).to_control(deviations=True), or export an FMU, which "
            "keeps them",
        )
    import control

    matrices = (model.a_matrix, model.b_matrix, model.c_matrix, model.d_matrix)
    step = model.spec.sample_time
    if continuous is not None:
        matrices, step = to_continuous(matrices, step, continuous), 0.0
    return control.StateSpace(
        *matrices,
        step,
        inputs=[channel.name for channel in model.spec.inputs],
        outputs=[channel.name for channel in model.spec.outputs],
    )


def from_state_space(
    system: control.StateSpace,
    *,
    sample_time: float | None = None,
    units: Mapping[str, str] | None = None,
    method: Hold = "zoh",
) -> Model:
    """Return a state-space system of python-control as a model that can be scored, compared and exported.

    Parameters
    ----------
    system : control.StateSpace
        In continuous time it is sampled; its labels become names of channels.
    sample_time : float, optional
        [s]; needed in continuous time, and where ``dt`` is True (discrete, of no stated step).
    units : mapping, optional
        Units by name of input or output; ``"1"`` otherwise.

    method : {"zoh", "foh", "tustin", "matched"}
        How a system in continuous time is sampled (:mod:`harness.models.transforms`).

    Returns
    -------
    LinearModel
        Its free runs are those of the system; nothing corrects its state (``filter_gain`` 0).

    Raises
    ------
    InputError
        If it is no state-space system, the sample time is missing or another one, or a unit is given for no channel.

    Examples
    --------
    >>> import control
    >>> model = from_state_space(control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), sample_time=0.1, units={"u[0]": "V"})
    >>> print(model.spec), model.a_matrix.round(4).tolist()
    u[0] [V] -> y[0] [1] every 0.1 s
    (None, [[0.9048]])
    """
    import control

    from harness import registry

    if not isinstance(system, control.StateSpace):
        raise InputError(
            "a system of python-control",
            expected="a StateSpace",
            got=type(system).__name__,
            remedy="convert it with control.ss(system)",
        )
    continuous = system.dt is None or (system.dt is not True and system.dt == 0)  # a dt of 1 s equals True
    stated = None if continuous or system.dt is True else float(system.dt)
    if (sample_time is None and stated is None) or (None not in (sample_time, stated) and sample_time != stated):
        raise InputError(
            "sample time of a system",
            expected="a number of seconds" if stated is None else f"{stated:g} s, its own, or none",
            got="none" if sample_time is None else f"{sample_time:g} s",
            remedy="give sample_time",
        )
    dt = float(stated or sample_time or 0.0)
    own = (np.asarray(system.A), np.asarray(system.B), np.asarray(system.C), np.asarray(system.D))
    a, b, c, d = discrete(own, dt, method) if continuous else own
    refuse_unknown("units", units or (), (*system.input_labels, *system.output_labels))
    named = [tuple(Channel(name, (units or {}).get(name, "1")) for name in labels)
             for labels in (system.input_labels, system.output_labels)]  # fmt: skip
    d = np.asarray(d, dtype=float)
    spec = PlantSpec(named[0], named[1], dt, (), bool(np.any(d)))
    nx, ny = len(np.asarray(a)), len(named[1])
    make: Any = registry.load("model_readers", "linear")
    matrices = [np.asarray(matrix, dtype=float) for matrix in (a, b, c)]
    model: Model = make(spec, *matrices, d, np.zeros((nx, ny)), np.zeros(nx), np.zeros(ny))
    return model


def linear_source(model: Linear) -> str:
    """Return model.c for the glue in harness.fmi.

    The model lives on its samples: inputs are taken at the start of a sample and the state moves at its end, so that
    shorter communication steps see outputs that are held.
    """
    nx, nu, ny = model.a_matrix.shape[0], model.spec.nu, model.spec.ny
    by_state = np.hstack([model.a_matrix, model.b_matrix, model.state_offset[:, None]])
    by_output = np.hstack([model.c_matrix, model.d_matrix, model.output_offset[:, None]])
    lines = [
        "/* A linear model in discrete time: written by sysid-harness. */",
        f"enum {{ NX = {nx}, NU = {nu}, NY = {ny}, U = 1, Y = U + NU, X = Y + NY }};",
        "enum { PHASE = VARIABLES, READY, NEXT, MEMORY = 2 + NX };",
        f"static const double SAMPLE = {model.spec.sample_time!r};",
        "/* [A B a] and [C D c], row by row */",
        _array("MOVE", by_state),
        _array("READ", by_output),
        _BODY,
    ]
    return "\n".join(lines)


def linear_description(model: Linear, x0: Mapping[str, float] | None = None) -> str:
    """Return modelDescription.xml for FMI 2.0.

    Raises InputError if a state is unknown.

    - ``x0``: start values of the states ``x1``, ``x2``, ...; 0 where not given
    """
    spec = model.spec
    starts = dict.fromkeys((f"x{k + 1}" for k in range(model.a_matrix.shape[0])), 0.0)
    refuse_unknown("initial state", x0 or (), starts)
    for key, value in (x0 or {}).items():
        starts[key] = float(value)
    variables = [FmuVariable(c.name, "input", c.unit, 0.0) for c in spec.inputs]
    variables += [FmuVariable(c.name, "output", c.unit) for c in spec.outputs]
    variables += [FmuVariable(f"state.{key}", "state", "1", value) for key, value in starts.items()]
    token = hashlib.sha256(f"{linear_source(model)}{starts}".encode()).hexdigest()[:32]
    direct: Sequence[int] = [int(k) for k in np.flatnonzero(np.any(model.d_matrix != 0, axis=0))]
    bands = bands_of(model)
    told = f", determined by its data: {bands_words(bands)}" if bands else ""
    root = describe(
        "linear",
        f"linear model of order {len(starts)}{told}",
        token,
        variables,
        sample_time=spec.sample_time,
        direct=direct,
    )
    return xml_text(root)


def _array(name: str, matrix: FloatArray) -> str:
    """Return a constant C array of the elements row by row; one zero where there are none."""
    numbers = ", ".join(repr(float(entry)) for entry in matrix.ravel()) or "0"
    return f"static const double {name}[] = {{ {numbers} }};"


_BODY = """
static double line(const double *row, const double *x, const double *u)
{
    double sum = 0;
    for (int i = 0; i < NX; i++) sum += row[i] * x[i];
    for (int i = 0; i < NU; i++) sum += row[NX + i] * u[i];
    return sum + row[NX + NU];
}

static const char *check(const double *v) { (void)v; return NULL; }

static void prepare(double *v) { v[PHASE] = v[READY] = 0; }

static double internal_step(const double *v) { (void)v; return SAMPLE; }

static void look_ahead(double *v)
{
    for (int i = 0; i < NX; i++) v[NEXT + i] = line(MOVE + i * (NX + NU + 1), v + X, v + U);
    v[READY] = 1;
}

static void advance(double *v, double h)
{
    if (v[READY] == 0) look_ahead(v);
    v[PHASE] += h;
    if (v[PHASE] < SAMPLE * (1 - 1e-9)) return;
    for (int i = 0; i < NX; i++) v[X + i] = v[NEXT + i];
    v[READY] = 0;
    v[PHASE] -= SAMPLE;
    if (v[PHASE] > SAMPLE * 1e-9) look_ahead(v); /* the sample began inside this step */
    else v[PHASE] = 0;
}

static void evaluate(double *v)
{
    for (int i = 0; i < NY; i++) v[Y + i] = line(READ + i * (NX + NU + 1), v + X, v + U);
}
"""
