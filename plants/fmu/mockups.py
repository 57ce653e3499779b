"""Our own FMUs as plants: the independent engine, with effects written in C by hand.

All take ``sample_time`` [s], ``outputs``, ``fmi`` (2 or 3) and ``substep``, the largest step [s] of the Runge-Kutta
method inside; without a C compiler they raise ``InputError`` where they have to be built first.

The controllers and the sensor (``pi_controller``, ``state_feedback``, ``quantiser``) have no factory of their own:
``FmuPlant(mockup("quantiser"), sample_time=...)``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from inspect import Parameter, signature
from typing import Any, Literal
from xml.etree import ElementTree

from plants.fmu.plant import FmuPlant
from plants.mockups import FOLDER, mockup


def _made(
    model: str,
    values: Mapping[str, float],
    *,
    outputs: Sequence[str],
    sample_time: float = 0.01,
    fmi: Literal[2, 3] = 2,
    substep: float = 1e-3,
) -> FmuPlant:
    """Return one of our own FMUs as a plant.

    Parameters
    ----------
    model : str
    values : mapping
        Of its parameters.
    outputs : sequence of str
        Variables that are seen.
    sample_time : float
        [s].
    fmi : {2, 3}
        Version of FMI.
    substep : float
        Largest step [s] of the Runge-Kutta method inside.

    Raises
    ------
    InputError
        If the FMU must be built and there is no C compiler.
    """
    parameters = {**values, "substep": substep}
    return FmuPlant(mockup(model, fmi), sample_time=sample_time, outputs=outputs, parameters=parameters)


def _described(
    model: str, *, outputs: Sequence[str], sample_time: float = 0.01
) -> Callable[[Callable[..., Any]], Callable[..., FmuPlant]]:
    """Make of a function that only tells what a mockup is one that makes it: its options are those of its FMU."""
    variables = ElementTree.parse(FOLDER / model / "modelDescription.xml").iter("ScalarVariable")
    kinds = {one.attrib["name"]: one[0] for one in variables if one.get("causality") == "parameter"}
    values: dict[str, float] = {
        name: kind.attrib["start"] == "true" if kind.tag == "Boolean" else float(kind.attrib["start"])
        for name, kind in kinds.items()
    }
    usual: dict[str, Any] = {"outputs": outputs, "sample_time": sample_time, "substep": values.pop("substep")}
    own = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=value, annotation=type(value)) for name, value in values.items()
    ]

    def told(text: Callable[..., Any]) -> Callable[..., FmuPlant]:
        @wraps(text)
        def made(**options: Any) -> FmuPlant:
            given = {name: options.pop(name, value) for name, value in values.items()}
            return _made(model, given, **(usual | options))

        whole = signature(_made)
        rest = [one.replace(default=usual.get(name, one.default)) for name, one in whole.parameters.items()][2:]
        vars(made).update(
            __signature__=whole.replace(parameters=[rest[0], *own, *rest[1:]], return_annotation=FmuPlant),
            __options_of__=_made,
        )
        return made

    return told


@_described("pendulum", outputs=("theta",))
def pendulum_fmu(**options: Any) -> Any:
    """Pendulum as an FMU: J theta'' + b theta' + mgl sin theta + friction = u, with true dry friction if wanted.

    Parameters
    ----------
    outputs : sequence of str
        Among ``theta`` [rad], ``omega`` [rad/s], ``der(omega)`` [rad/s^2]; theta is 0 hanging down.
    J, b, mgl : float
        Inertia [kg m^2], viscous friction [N m s/rad], weight times lever [N m].
    Fc, Fs, vs : float
        Coulomb friction [N m], breakaway friction [N m] (counts where it exceeds Fc), Stribeck velocity [rad/s].
    c2 : float
        Quadratic drag [N m s^2/rad^2].

    Examples
    --------
    >>> with pendulum_fmu(sample_time=0.02) as plant:
    ...     print(plant.spec)
    u [N m] -> theta [rad] every 0.02 s
    """


@_described("cart_pole", outputs=("x", "theta"))
def cart_pole_fmu(**options: Any) -> Any:
    """Cart-pole as an FMU: force on the cart, theta = 0 hanging down, optional Coulomb friction of cart and hinge.

    Parameters
    ----------
    outputs : sequence of str
        Among ``x`` [m], ``theta`` [rad], ``v`` [m/s], ``omega`` [rad/s] and their ``der(...)``.
    mc, mp, l, g : float
        Mass of cart and bob [kg], length [m], gravity [m/s^2].
    bx, btheta : float
        Viscous friction [N s/m], [N m s/rad].
    Fx, Ftheta, width : float
        Coulomb friction [N], [N m], and the velocity [m/s, rad/s] over which it reverses.

    Examples
    --------
    >>> with cart_pole_fmu() as plant:
    ...     print(plant.spec)
    u [N] -> x [m], theta [rad] every 0.01 s
    """


@_described("mass_spring", outputs=("q",))
def mass_spring_fmu(**options: Any) -> Any:
    """Mass, spring and damper as an FMU: m q'' + c q' + k q + k2 q^2 + k3 q^3 = u.

    Parameters
    ----------
    outputs : sequence of str
        Among ``q`` [m], ``v`` [m/s], ``der(v)`` [m/s^2].
    m, c, k, k2, k3 : float
        Mass [kg], damping [N s/m], stiffness [N/m], [N/m^2], [N/m^3].

    Examples
    --------
    >>> with mass_spring_fmu() as plant:
    ...     print(plant.spec)
    u [N] -> q [m] every 0.01 s
    """


@_described("drive", outputs=("q",), sample_time=1e-3)
def drive_fmu(**options: Any) -> Any:
    """Linear drive as an FMU: motor and load, viscous and Coulomb friction, offset, optional backlash between them.

    Parameters
    ----------
    outputs : sequence of str
        Among ``q``, ``q_load`` [m], ``v``, ``v_load`` [m/s]; q is the motor side, where the encoder is.
    M, ML : float
        Mass of motor side and load [kg]; with ``gap=0`` they move as one body.
    Fv, FvL, Fc, offset, width : float
        Viscous friction of both sides [N s/m], Coulomb friction and constant force of the motor side [N], velocity
        [m/s] over which Coulomb friction reverses.
    gap, k, d : float
        Free play [m], stiffness [N/m] and damping [N s/m] of the contact.

    Examples
    --------
    >>> with drive_fmu() as plant:
    ...     print(plant.spec)
    u [N] -> q [m] every 0.001 s
    """


@_described("two_tanks", outputs=("y",), sample_time=1.0)
def two_tanks_fmu(**options: Any) -> Any:
    """Two tanks in cascade as an FMU: pump voltage to lower level, Torricelli outflow, optional overflow.

    Parameters
    ----------
    outputs : sequence of str
        Among ``y``, ``upper``, ``lower`` [V of the level sensor].
    k_pump, k_upper, k_lower : float
        Inflow [1/s], outflows over the root of the level [V^0.5/s].
    overflow : bool
        Whether the tanks have a rim.
    rim, share : float
        Level of the rims [V]; part of the upper tank's overflow that falls into the lower one.

    Examples
    --------
    >>> with two_tanks_fmu() as plant:
    ...     print(plant.spec)
    u [V] -> y [V] every 1 s
    """
