"""A recorded motion, and a system's expressions evaluated along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.algebra import advanced
from harness.effects.compose import recommended_substeps
from harness.errors import InputError
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.arms.vectorised import OnRecords
    from harness.physics.compiled.system import System

_WRITTEN_OUT = 16
"""Steps of hidden states in one call of CasADi's virtual machine: alone, half of a step's time is the call."""


@dataclass(frozen=True, eq=False)
class Signals:
    """A recorded motion: what a regression works on.

    Parameters
    ----------
    t : array (N,)
        Time [s], uniform.
    u : array (N, nu)
        Inputs of the system, in its order.
    q, v, a : array (N, n)
        Coordinates, rates and accelerations, in the order of ``system.coordinates`` (smoothed, from the sensor).
    ramps : bool
        Inputs run straight from instant to instant, as means of both sides of a jump do; else each is held.
    others : array (K,), optional
        Where the states of the nominal model that are no coordinates begin (a current, a temperature), in its order; 0
        where it is not known. They are simulated along the motion, as hidden states of effects are.

    Raises
    ------
    InputError
        If the lengths differ or there are fewer than two samples.
    """

    t: FloatArray
    u: FloatArray
    q: FloatArray
    v: FloatArray
    a: FloatArray
    ramps: bool = False
    others: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(self.t)
        for name in ("u", "q", "v", "a"):
            array = np.asarray(getattr(self, name), dtype=float)
            if array.ndim != 2 or array.shape[0] != n or n < 2:
                raise InputError(
                    f"signal {name} of a motion",
                    expected=f"shape ({n}, channels) with at least two rows",
                    got=str(array.shape),
                    remedy="give time on the first axis and one channel in each column",
                )
            object.__setattr__(self, name, array)

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return float(self.t[1] - self.t[0])


def arguments(system: System) -> list[Any]:
    """Return the symbols of a function along a motion."""
    return [system.x, system.u, system.p, system.t]


def down(system: System, expression: Any) -> Any:
    """Return an expression with gravity pointing down."""
    import casadi as ca

    return ca.substitute(expression, system.gravity, ca.DM([0.0, -1.0]))


def residual_function(system: System) -> OnRecords:
    """Return the function ``r(x, u, p, t, a) = M a - Q`` on whole records, made once for a system."""
    import casadi as ca

    from harness.physics.arms.vectorised import OnRecords

    known: OnRecords | None = system.__dict__.get("_residual_function")
    if known is None:
        a = ca.SX.sym("a", len(system.coordinates))
        expression = down(system, ca.mtimes(system.mass_matrix, a) - system.generalized_forces)
        known = OnRecords(ca.Function("r", [*arguments(system), a], [expression]))
        system.__dict__["_residual_function"] = known
    return known


def _states(system: System, signals: Signals, hidden: FloatArray | None) -> FloatArray:
    """Return the states along a motion, (nx, N)."""
    z = np.zeros((len(signals.t), system.nx - 2 * len(system.coordinates))) if hidden is None else hidden
    return np.hstack([signals.q, signals.v, z]).T


def along(
    function: Any, system: System, signals: Signals, p: FloatArray, hidden: FloatArray | None, *more: FloatArray
) -> FloatArray:
    """Return the values of a function of (x, u, p, t, ...) along a motion, (N, size).

    The function has one output, a column; it is CasADi's, or made for whole records already. States of the nominal
    model beside its coordinates are simulated, if ``hidden`` does not hold them.
    """
    from harness.physics.arms.vectorised import OnRecords

    if hidden is None and system.nx - system.hidden_count > 2 * len(system.coordinates):
        hidden = hidden_states(system, signals, p)
    whole = function if isinstance(function, OnRecords) else OnRecords(function)
    x = _states(system, signals, hidden)
    return whole(x.T, signals.u, p, signals.t[:, None], *more)[0]


def hidden_states(system: System, signals: Signals, p: FloatArray, *, substeps: int | None = None) -> FloatArray | None:
    """Return the states besides coordinates along a motion, by Runge-Kutta steps with the motion interpolated.

    So many steps in a sample as the system needs at rest, if ``substeps`` does not say how many; what slips within a
    short length does so the faster the faster the joint turns, and may need more.
    """
    n = len(system.coordinates)
    count = system.nx - 2 * n
    if count == 0:
        return None
    if substeps is None:
        substeps = recommended_substeps(system, dict(zip(system.parameter_names, p, strict=True)), signals.dt)
    known: dict[tuple[float, int], tuple[Any, Any]] = system.__dict__.setdefault("_hidden_steps", {})
    key = (signals.dt, substeps)
    if key not in known:
        known[key] = _hidden_piece(system, signals.dt, substeps)
    piece, initial = known[key]
    many = piece.size2_in("t")
    steps = len(signals.t) - 1
    pieces = -(-steps // many)
    whole: dict[tuple[float, int, int], Any] = system.__dict__.setdefault("_hidden_runs", {})
    if (*key, pieces) not in whole:
        whole[*key, pieces] = piece.mapaccum("pieces", pieces, 1)
    motion = np.hstack([signals.q, signals.v])
    x0 = np.concatenate([motion[0], np.zeros(count)])
    own = count - system.hidden_count  # states of the nominal model itself
    if own and signals.others is not None:
        x0[2 * n : 2 * n + own] = signals.others
    first = np.concatenate([x0[2 * n : 2 * n + own], np.array(initial(x0, signals.u[0], p, signals.t[0])).ravel()])

    def padded(rows: FloatArray) -> FloatArray:
        return np.pad(rows, ((0, pieces * many - steps), (0, 0)), mode="edge").T

    last = padded(signals.u[1:] if signals.ramps else signals.u[:-1])
    _, states = whole[*key, pieces](
        first,
        padded(motion[:-1]),
        padded(motion[1:]),
        padded(signals.u[:-1]),
        last,
        np.tile(p[:, None], (1, pieces)),
        padded(signals.t[:-1, None]),
    )
    return np.vstack([first, np.array(states).T[:steps]])


def _hidden_piece(system: System, dt: float, substeps: int) -> tuple[Any, Any]:
    """Return the functions of several samples of the hidden states, and of where they start."""
    import casadi as ca

    step, initial = _hidden_step(system, dt, substeps)
    many = max(1, _WRITTEN_OUT // substeps)
    sizes = zip(step.name_in(), (step.size1_in(row) for row in range(step.n_in())), strict=True)
    symbols = {name: ca.SX.sym(name, size, 1 if name in ("z", "p") else many) for name, size in sizes}
    states = [symbols["z"]]
    for k in range(many):
        now = {name: symbol if name == "p" else symbol[:, k] for name, symbol in symbols.items() if name != "z"}
        states.append(step(z=states[-1], **now)["after"])
    outputs = [states[-1], ca.horzcat(*states[1:])]
    return ca.Function("piece", [*symbols.values()], outputs, [*symbols], ["after", "states"]), initial


def _hidden_step(system: System, dt: float, substeps: int) -> tuple[Any, Any]:
    """Return the functions of one sample of the hidden states, and of where they start."""
    import casadi as ca

    n = len(system.coordinates)
    count = system.nx - 2 * n
    rates = ca.Function("g", arguments(system), [down(system, system.rates)])
    z, u, t = ca.SX.sym("z", count), ca.SX.sym("u", system.nu), ca.SX.sym("t")
    end = ca.SX.sym("end", system.nu)
    here, there = ca.SX.sym("here", 2 * n), ca.SX.sym("there", 2 * n)
    parameters = ca.SX.sym("p", system.np)

    def derivative(state: Any, share: float) -> Any:
        x = (1.0 - share) * here + share * there
        return rates(ca.vertcat(x, state), (1.0 - share) * u + share * end, parameters, t + share * dt)

    state = advanced(derivative, z, dt, substeps)
    symbols = [z, here, there, u, end, parameters, t]
    step_function = ca.Function("step", symbols, [state], ["z", "here", "there", "u", "end", "p", "t"], ["after"])
    start = ca.SX(0, 1) if system.initial is None else system.initial
    return step_function, ca.Function("z0", arguments(system), [start])


def rms(values: FloatArray) -> FloatArray:
    """Return the root mean square of each column."""
    return np.asarray(np.sqrt(np.mean(np.asarray(values) ** 2, axis=0)))
