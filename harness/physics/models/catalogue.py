"""The built-in nominal models, and how a model is found by name or in a user's file."""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import sympy as sp

from harness.errors import HarnessError, InputError, PluginError, did_you_mean, no_file, refuse_no_file
from harness.physics.arms.arm import is_arm
from harness.physics.arms.mechanism import arm_mechanism
from harness.physics.compiled.system import System
from harness.physics.definition.parameters import Parameter
from harness.physics.models.chain import mass_chain
from harness.physics.models.flight import perching_glider, planar_quadrotor
from harness.physics.models.tanks import two_tanks
from harness.physics.symbolic.mechanism import Mechanism
from harness.physics.symbolic.ode import Ode
from harness.physics.symbolic.typed import SUFFIX, typed_model


def pendulum() -> Mechanism:
    """Pendulum with viscous friction: ``J theta'' + b theta' + mgl sin(theta) = u``; 0 hangs down.

    Examples
    --------
    >>> print(pendulum().system())
    pendulum: u [N m] -> theta [rad]
    """
    m = Mechanism("pendulum", q="theta", u="u", p="J b mgl")
    (theta,), (rate,), (u,), (J, b, mgl) = m.q, m.v, m.u, m.p
    m.body(J, (sp.sin(theta), -sp.cos(theta)), weight=mgl)
    m.Q = [u - b * rate]
    m.parameters(J=("kg m^2", 0.1), b=("N m s/rad", 0.05), mgl=("N m", 1.0))
    return m


def cart_pole() -> Mechanism:
    """Cart with a hanging point-mass pole, force on the cart, viscous friction; theta is absolute, 0 hangs down.

    Examples
    --------
    >>> print(cart_pole().system())
    cart-pole: u [N] -> x [m], theta [rad]
    """
    m = Mechanism("cart-pole", q="x theta", u="u", p="mc mp l bx btheta")
    (x, theta), (x_rate, theta_rate), (u,), (mc, mp, length, bx, btheta) = m.q, m.v, m.u, m.p
    m.body(mc, (x, 0))
    m.body(mp, (x + length * sp.sin(theta), -length * sp.cos(theta)))
    m.Q = [u - bx * x_rate, -btheta * theta_rate]
    m.parameters(
        mc=("kg", 1.0),
        mp=("kg", 0.2),
        l=("m", 0.5),
        bx=("N s/m", 0.2),
        btheta=("N m s/rad", 0.005),
    )
    return m


def _two_links(name: str, inputs: str) -> Mechanism:
    """Return a double pendulum with compound links; theta2 is the angle of link 2 against link 1."""
    m = Mechanism(name, q="theta1 theta2", u=inputs, p="m1 m2 l1 lc1 lc2 I1 I2 b1 b2")
    (q1, q2), (v1, v2), (m1, m2, l1, lc1, lc2, I1, I2, b1, b2) = m.q, m.v, m.p
    m.body(m1, (lc1 * sp.sin(q1), -lc1 * sp.cos(q1)), I1, q1)
    elbow = (l1 * sp.sin(q1), -l1 * sp.cos(q1))
    m.body(m2, (elbow[0] + lc2 * sp.sin(q1 + q2), elbow[1] - lc2 * sp.cos(q1 + q2)), I2, q1 + q2)
    drive1 = m.u[0] if len(m.u) == 2 else 0
    m.Q = [drive1 - b1 * v1, m.u[-1] - b2 * v2]
    # With the torques known, four of the seven body parameters are identifiable; scale and ruler give the others.
    m.parameters(
        m1=Parameter("m1", "kg", 1.0, 0.0, fixed=True),
        m2=Parameter("m2", "kg", 1.0, 0.0, fixed=True),
        l1=Parameter("l1", "m", 1.0, 0.0, fixed=True),
        lc1=("m", 0.5),
        lc2=("m", 1.0),
        I1=("kg m^2", 0.083),
        I2=("kg m^2", 0.33),
        b1=("N m s/rad", 0.1),
        b2=("N m s/rad", 0.1),
    )
    return m


def double_pendulum() -> Mechanism:
    """Double pendulum with a torque and viscous friction at both joints; theta2 is relative to link 1.

    Examples
    --------
    >>> print(double_pendulum().system())
    double-pendulum: u1 [N m], u2 [N m] -> theta1 [rad], theta2 [rad]
    """
    return _two_links("double-pendulum", "u1 u2")


def acrobot() -> Mechanism:
    """Double pendulum with a torque at the second joint only; theta2 is relative to link 1, 0 hangs down.

    Examples
    --------
    >>> print(acrobot().system())
    acrobot: u [N m] -> theta1 [rad], theta2 [rad]
    """
    return _two_links("acrobot", "u")


def drive() -> Mechanism:
    """Linear drive: ``M q'' + Fv q' + offset = u``.

    Examples
    --------
    >>> print(drive().system())
    drive: u [N] -> q [m]
    """
    m = Mechanism("drive", q="q", u="u", p="M Fv offset")
    (q,), (rate,), (u,), (M, Fv, offset) = m.q, m.v, m.u, m.p
    m.body(M, (q, 0))
    m.Q = [u - Fv * rate - offset]
    m.parameters(M=("kg", 1.0), Fv=("N s/m", 1.0), offset=Parameter("offset", "N", 0.0))
    return m


def oscillator() -> Mechanism:
    """Mass, spring and damper: ``m q'' + c q' + k q = u``.

    Examples
    --------
    >>> print(oscillator().system())
    oscillator: u [N] -> q [m]
    """
    m = Mechanism("oscillator", q="q", u="u", p="m c k")
    (q,), (rate,), (u,), (mass, c, k) = m.q, m.v, m.u, m.p
    m.body(mass, (q, 0), weight=0)
    m.V = k * q**2 / 2
    m.Q = [u - c * rate]
    m.parameters(m=("kg", 1.0), c=("N s/m", 0.1), k=("N/m", 1.0))
    return m


def linear(
    order: int = 2,
    inputs: str | Sequence[str] = "u",
    outputs: str | Sequence[str] = "y",
    time_scale: float = 1.0,
    offsets: bool = True,
) -> Ode:
    """Linear system of order n with any ports, without feedthrough.

    The observable canonical form in which the states are outputs and their scaled derivatives in free motion: each
    output i has a chain ``T x_ij' = x_i,j+1 + T b_ij u``, the last of a chain ``T x_i' = -sum a x + T b u``; the
    chains are as equal in length as possible. It has ``n (ny + nu)`` parameters, all identifiable
    (Ljung, *System Identification*, 2nd ed., section 4A), and one offset for each output.

    Parameters
    ----------
    order : int
        Number of states, at least the number of outputs.
    inputs, outputs : str or sequence of str
        Names of the ports.
    time_scale : float
        T [s]: about the slowest time constant; only conditions the numbers.
    offsets : bool
        With an offset for each output: the operating point.

    Raises
    ------
    InputError
        If there are more outputs than states, or no output.

    Examples
    --------
    >>> linear(3).system().parameter_names
    ('a1_1', 'a1_2', 'a1_3', 'b1_1', 'b2_1', 'b3_1', 'offset_1')
    """
    from harness.physics.models.linear_start import start_of

    input_names = inputs.split() if isinstance(inputs, str) else list(inputs)
    output_names = outputs.split() if isinstance(outputs, str) else list(outputs)
    ny, nu = len(output_names), len(input_names)
    if not 1 <= ny <= int(order) or not time_scale > 0:
        raise InputError(
            "linear model",
            expected="at least one output, an order not below the number of outputs, time_scale > 0",
            got=f"order {order}, {ny} outputs, time_scale {time_scale}",
            remedy="raise the order",
        )
    n = int(order)
    lengths = [n // ny + (1 if row < n % ny else 0) for row in range(ny)]
    heads = [sum(lengths[:row]) for row in range(ny)]
    states = [f"x{row + 1}" for row in range(n)]
    start = {
        f"a{row + 1}_{column + 1}": _of_equal_poles(column - heads[row], lengths[row])
        for row in range(ny)
        for column in range(n)
    }
    start |= {f"b{row + 1}_{column + 1}": 0.0 if column else 1.0 for row in range(n) for column in range(nu)}
    start |= {f"offset_{row + 1}": 0.0 for row in range(ny) if offsets}
    o = Ode(
        "linear",
        x=" ".join(states),
        u=" ".join(input_names),
        p=" ".join(start),
        parameters={name: Parameter(name, value=value, declared=False) for name, value in start.items()},
    )
    symbols = {str(symbol): symbol for symbol in o.p}
    T = sp.Float(time_scale)
    rhs: list[Any] = []
    for row, (head, length) in enumerate(zip(heads, lengths, strict=True)):
        for index in range(head, head + length):
            if index + 1 < head + length:
                free = o.x[index + 1]
            else:
                free = -sum(symbols[f"a{row + 1}_{column + 1}"] * o.x[column] for column in range(n))
            rhs.append((free + sum(symbols[f"b{index + 1}_{c + 1}"] * o.u[c] for c in range(nu))) / T)
    o.rhs = rhs
    o.outputs = {
        name: o.x[heads[row]] + (symbols[f"offset_{row + 1}"] if offsets else 0)
        for row, name in enumerate(output_names)
    }
    o.starts = start_of(n, nu, lengths, time_scale, offsets)
    return o


def _of_equal_poles(place: int, length: int) -> float:
    """Return a coefficient of ``(s + 1)^length``, where a chain of states starts; 0 for states of other chains."""
    return float(sp.binomial(length, length - place)) if 0 <= place < length else 0.0


BUILT_IN = {
    "pendulum": pendulum,
    "cart-pole": cart_pole,
    "double-pendulum": double_pendulum,
    "acrobot": acrobot,
    "drive": drive,
    "oscillator": oscillator,
    "mass-chain": mass_chain,
    "planar-quadrotor": planar_quadrotor,
    "perching-glider": perching_glider,
    "two-tanks": two_tanks,
    "linear": linear,
}


def load_model(name: str, **options: Any) -> System:
    """Return a model by name.

    Parameters
    ----------
    name : str
        A built-in model (``"pendulum"``), an arm (``"iiwa"``, ``"FILE.urdf"``), one that another distribution
        registers, equations typed as text (``FILE.eqs``: :func:`harness.physics.symbolic.typed.read_equations`), or
        ``FILE.py:FUNCTION`` where the function returns a :class:`Mechanism`, an :class:`Ode` or a :class:`System`.
    **options
        Passed to the model's function (``order=4`` of ``linear``, ``passive=["pole"]`` of an arm).

    Raises
    ------
    InputError
        If there is no such model or file or function, if the function raises, or if it returns something else.

    Examples
    --------
    >>> print(load_model("oscillator"))
    oscillator: u [N] -> q [m]
    """
    maker: Any
    where: Path | None
    if ".py:" in name or name.endswith(".py"):
        path, _, attribute = name.rpartition(":") if ".py:" in name else (name, "", "")
        maker, where = from_file(Path(path), attribute)
    elif name.endswith(SUFFIX):
        maker, where = functools.partial(typed_model, Path(name)), Path(name)
    elif is_arm(name):
        maker, where = functools.partial(arm_mechanism, name), None
    elif name in BUILT_IN:
        maker, where = BUILT_IN[name], None
    elif (found := model_of(name)) is not None:
        maker, where = found, None
    else:
        known = dict.fromkeys((*BUILT_IN, *model_names()))
        expected = f"one of {', '.join(known)}, or FILE.py:FUNCTION"
        refuse_no_file(name, expected)
        raise InputError(
            "unknown model",
            expected=expected,
            got=repr(name),
            remedy=did_you_mean(name, known, "correct the name, or write the model in a file", most=2),
        )
    try:
        made = maker(**options) if callable(maker) and not isinstance(maker, System) else maker
        system = made.system() if isinstance(made, Mechanism | Ode) else made
    except HarnessError as error:
        if not isinstance(error, InputError):
            raise
        raise error.located(file=where, place=None if str(error.file or where) == name else name) from error
    except Exception as error:
        raise InputError(
            f"model {name} raised {type(error).__name__}: {error}",
            expected="a function that returns a Mechanism, an Ode or a System",
            got=type(error).__name__,
            remedy="run it in Python and repair it",
            file=where,
        ) from error
    if not isinstance(system, System):
        raise InputError(
            f"model {name}",
            expected="a function that returns a Mechanism, an Ode or a System",
            got=type(made).__name__,
            remedy="return the mechanism",
            file=where,
        )
    return system


def from_file(path: Path, attribute: str) -> tuple[Any, Path]:
    """Return what a user's file calls by a name, and the file: its only public function where no name is given.

    Raises InputError if there is no such file, it cannot be imported, or has nothing of that name.
    """
    if not path.is_file():
        raise InputError("no such file", expected="FILE.py:NAME", got=no_file(path), remedy="check the path", file=path)
    module_name = f"sysid_harness_user_{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise InputError("not Python", expected="a .py file", got=path.name, remedy="rename it", file=path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module  # so that its classes pickle
    try:
        spec.loader.exec_module(module)
    except HarnessError:
        raise
    except Exception as error:
        raise InputError(
            "the file does not run",
            expected="Python that can be imported",
            got=f"{type(error).__name__}: {error}",
            remedy="run it with python and repair it",
            file=path,
        ) from error
    public = [
        name
        for name, value in vars(module).items()
        if callable(value) and not name.startswith("_") and getattr(value, "__module__", "") == module_name
    ]
    if not attribute and len(public) == 1:
        attribute = public[0]
    if not attribute or not hasattr(module, attribute):
        raise InputError(
            f"the file has no {attribute!r}" if attribute else "no name in the file",
            expected=f"FILE.py:NAME with one of {', '.join(public[:12]) or '(nothing public)'}",
            got=repr(attribute),
            remedy=did_you_mean(attribute, public, "write the function's name after a colon", most=2),
            file=path,
        )
    return getattr(module, attribute), path


@functools.cache
def _points() -> dict[str, importlib.metadata.EntryPoint]:
    """Return the entry points by name, of two with one name the first distribution's; the registry lies above this."""
    if os.environ.get("SYSID_HARNESS_NO_PLUGINS", "") not in ("", "0"):
        return {}
    found = [
        (point.dist.name if point.dist is not None else "?", point)
        for point in importlib.metadata.entry_points(group="sysid_harness.models")
    ]
    result: dict[str, importlib.metadata.EntryPoint] = {}
    for _, point in sorted(found, key=lambda pair: pair[0]):
        result.setdefault(point.name, point)
    return result


def model_names() -> tuple[str, ...]:
    """Return the names of all registered models, the built-in ones included.

    Examples
    --------
    >>> "pendulum" in model_names()
    True
    """
    return tuple(sorted(_points()))


def model_of(name: str) -> Callable[..., Any] | None:
    """Return the function that makes a registered model; None if there is none of this name.

    Raises PluginError if the plug-in raises while it is imported.
    """
    point = _points().get(name)
    if point is None:
        return None
    try:
        maker: Callable[..., Any] = point.load()
    except HarnessError:
        raise
    except Exception as error:
        raise PluginError(
            f"model {name!r} ({point.value}) does not load: {type(error).__name__}: {error}; "
            "remedy: repair or uninstall its distribution"
        ) from error
    return maker
