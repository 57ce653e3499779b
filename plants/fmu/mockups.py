"""Our own FMUs as plants: the independent engine, with effects written in C by hand.

All take ``sample_time`` [s], ``outputs``, ``fmi`` (2 or 3) and ``substep``, the largest step [s] of the Runge-Kutta
method inside; without a C compiler they raise ``InputError`` where they have to be built first.

The controllers and the sensor (``pi_controller``, ``state_feedback``, ``quantiser``) have no factory of their own:
``FmuPlant(mockup("quantiser"), sample_time=...)``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from harness.options import options_of
from plants.fmu.plant import FmuPlant
from plants.mockups import mockup


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


@options_of(_made, "model", "values")
def pendulum_fmu(
    *,
    outputs: Sequence[str] = ("theta",),
    J: float = 0.05,
    b: float = 0.02,
    mgl: float = 1.0,
    Fc: float = 0.0,
    Fs: float = 0.0,
    vs: float = 0.1,
    c2: float = 0.0,
    **options: Any,
) -> FmuPlant:
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
    values = {"J": J, "b": b, "mgl": mgl, "Fc": Fc, "Fs": Fs, "vs": vs, "c2": c2}
    return _made("pendulum", values, outputs=outputs, **options)


@options_of(_made, "model", "values")
def cart_pole_fmu(
    *,
    outputs: Sequence[str] = ("x", "theta"),
    mc: float = 1.0,
    mp: float = 0.2,
    l: float = 0.5,  # noqa: E741 (the field's name of a length)
    g: float = 9.81,
    bx: float = 0.2,
    btheta: float = 0.005,
    Fx: float = 0.0,
    Ftheta: float = 0.0,
    width: float = 1e-3,
    **options: Any,
) -> FmuPlant:
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
    values = {"mc": mc, "mp": mp, "l": l, "g": g, "bx": bx}
    values |= {"btheta": btheta, "Fx": Fx, "Ftheta": Ftheta, "width": width}
    return _made("cart_pole", values, outputs=outputs, **options)


@options_of(_made, "model", "values")
def mass_spring_fmu(
    *,
    outputs: Sequence[str] = ("q",),
    m: float = 1.0,
    c: float = 0.1,
    k: float = 1.0,
    k2: float = 0.0,
    k3: float = 0.0,
    **options: Any,
) -> FmuPlant:
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
    values = {"m": m, "c": c, "k": k, "k2": k2, "k3": k3}
    return _made("mass_spring", values, outputs=outputs, **options)


@options_of(_made, "model", "values")
def drive_fmu(
    *,
    sample_time: float = 1e-3,
    substep: float = 5e-4,
    outputs: Sequence[str] = ("q",),
    M: float = 40.0,
    ML: float = 55.0,
    Fv: float = 200.0,
    FvL: float = 0.0,
    Fc: float = 0.0,
    offset: float = 0.0,
    gap: float = 0.0,
    k: float = 2e6,
    d: float = 2e3,
    width: float = 1e-3,
    **options: Any,
) -> FmuPlant:
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
    values = {"M": M, "ML": ML, "Fv": Fv, "FvL": FvL, "Fc": Fc}
    values |= {"offset": offset, "gap": gap, "k": k, "d": d, "width": width}
    return _made("drive", values, outputs=outputs, sample_time=sample_time, substep=substep, **options)


@options_of(_made, "model", "values")
def two_tanks_fmu(
    *,
    sample_time: float = 1.0,
    substep: float = 0.1,
    outputs: Sequence[str] = ("y",),
    k_pump: float = 0.04,
    k_upper: float = 0.06,
    k_lower: float = 0.06,
    overflow: bool = False,
    rim: float = 10.0,
    share: float = 0.5,
    **options: Any,
) -> FmuPlant:
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
    values = {"k_pump": k_pump, "k_upper": k_upper, "k_lower": k_lower}
    values |= {"overflow": overflow, "rim": rim, "share": share}
    return _made("two_tanks", values, outputs=outputs, sample_time=sample_time, substep=substep, **options)
