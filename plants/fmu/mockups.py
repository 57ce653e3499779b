"""Our own FMUs as plants: the independent engine, with effects written in C by hand.

The controllers and the sensor (``pi_controller``, ``state_feedback``, ``quantiser``) have no factory of their own:
``FmuPlant(mockup("quantiser"), sample_time=...)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from plants.fmu.plant import FmuPlant
from plants.mockups import mockup

__all__ = ["cart_pole_fmu", "drive_fmu", "mass_spring_fmu", "pendulum_fmu", "two_tanks_fmu"]


def pendulum_fmu(
    *,
    sample_time: float = 0.01,
    outputs: Sequence[str] = ("theta",),
    fmi: Literal[2, 3] = 2,
    substep: float = 1e-3,
    J: float = 0.05,
    b: float = 0.02,
    mgl: float = 1.0,
    Fc: float = 0.0,
    Fs: float = 0.0,
    vs: float = 0.1,
    c2: float = 0.0,
) -> FmuPlant:
    """Pendulum as an FMU: J theta'' + b theta' + mgl sin theta + friction = u, with true dry friction if wanted.

    Parameters
    ----------
    sample_time : float
        [s].
    outputs : sequence of str
        Among ``theta`` [rad], ``omega`` [rad/s], ``der(omega)`` [rad/s^2]; theta is 0 hanging down.
    fmi : {2, 3}
        Version of FMI.
    substep : float
        Largest step [s] of the Runge-Kutta method inside.
    J, b, mgl : float
        Inertia [kg m^2], viscous friction [N m s/rad], weight times lever [N m].
    Fc, Fs, vs : float
        Coulomb friction [N m], breakaway friction [N m] (counts where it exceeds Fc), Stribeck velocity [rad/s].
    c2 : float
        Quadratic drag [N m s^2/rad^2].

    Raises
    ------
    InputError
        If the FMU must be built and there is no C compiler.

    Examples
    --------
    >>> with pendulum_fmu(sample_time=0.02) as plant:
    ...     print(plant.spec)
    u [N m] -> theta [rad] every 0.02 s
    """
    values = {"J": J, "b": b, "mgl": mgl, "Fc": Fc, "Fs": Fs, "vs": vs, "c2": c2, "substep": substep}
    return FmuPlant(mockup("pendulum", fmi), sample_time=sample_time, outputs=outputs, parameters=values)


def cart_pole_fmu(
    *,
    sample_time: float = 0.01,
    outputs: Sequence[str] = ("x", "theta"),
    fmi: Literal[2, 3] = 2,
    substep: float = 1e-3,
    mc: float = 1.0,
    mp: float = 0.2,
    l: float = 0.5,  # noqa: E741 (the field's name of a length)
    g: float = 9.81,
    bx: float = 0.2,
    btheta: float = 0.005,
    Fx: float = 0.0,
    Ftheta: float = 0.0,
    width: float = 1e-3,
) -> FmuPlant:
    """Cart-pole as an FMU: force on the cart, theta = 0 hanging down, optional Coulomb friction of cart and hinge.

    Parameters
    ----------
    sample_time : float
        [s].
    outputs : sequence of str
        Among ``x`` [m], ``theta`` [rad], ``v`` [m/s], ``omega`` [rad/s] and their ``der(...)``.
    fmi : {2, 3}
        Version of FMI.
    substep : float
        Largest step [s] of the Runge-Kutta method inside.
    mc, mp, l, g : float
        Mass of cart and bob [kg], length [m], gravity [m/s^2].
    bx, btheta : float
        Viscous friction [N s/m], [N m s/rad].
    Fx, Ftheta, width : float
        Coulomb friction [N], [N m], and the velocity [m/s, rad/s] over which it reverses.

    Raises
    ------
    InputError
        If the FMU must be built and there is no C compiler.

    Examples
    --------
    >>> with cart_pole_fmu() as plant:
    ...     print(plant.spec)
    u [N] -> x [m], theta [rad] every 0.01 s
    """
    values = {"mc": mc, "mp": mp, "l": l, "g": g, "bx": bx, "btheta": btheta, "Fx": Fx, "Ftheta": Ftheta}
    values.update(width=width, substep=substep)
    return FmuPlant(mockup("cart_pole", fmi), sample_time=sample_time, outputs=outputs, parameters=values)


def mass_spring_fmu(
    *,
    sample_time: float = 0.01,
    outputs: Sequence[str] = ("q",),
    fmi: Literal[2, 3] = 2,
    substep: float = 1e-3,
    m: float = 1.0,
    c: float = 0.1,
    k: float = 1.0,
    k2: float = 0.0,
    k3: float = 0.0,
) -> FmuPlant:
    """Mass, spring and damper as an FMU: m q'' + c q' + k q + k2 q^2 + k3 q^3 = u.

    Parameters
    ----------
    sample_time : float
        [s].
    outputs : sequence of str
        Among ``q`` [m], ``v`` [m/s], ``der(v)`` [m/s^2].
    fmi : {2, 3}
        Version of FMI.
    substep : float
        Largest step [s] of the Runge-Kutta method inside.
    m, c, k, k2, k3 : float
        Mass [kg], damping [N s/m], stiffness [N/m], [N/m^2], [N/m^3].

    Raises
    ------
    InputError
        If the FMU must be built and there is no C compiler.

    Examples
    --------
    >>> with mass_spring_fmu() as plant:
    ...     print(plant.spec)
    u [N] -> q [m] every 0.01 s
    """
    values = {"m": m, "c": c, "k": k, "k2": k2, "k3": k3, "substep": substep}
    return FmuPlant(mockup("mass_spring", fmi), sample_time=sample_time, outputs=outputs, parameters=values)


def drive_fmu(
    *,
    sample_time: float = 1e-3,
    outputs: Sequence[str] = ("q",),
    fmi: Literal[2, 3] = 2,
    substep: float = 5e-4,
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
) -> FmuPlant:
    """Linear drive as an FMU: motor and load, viscous and Coulomb friction, offset, optional backlash between them.

    Parameters
    ----------
    sample_time : float
        [s].
    outputs : sequence of str
        Among ``q``, ``q_load`` [m], ``v``, ``v_load`` [m/s]; q is the motor side, where the encoder is.
    fmi : {2, 3}
        Version of FMI.
    substep : float
        Largest step [s] of the Runge-Kutta method inside.
    M, ML : float
        Mass of motor side and load [kg]; with ``gap=0`` they move as one body.
    Fv, FvL, Fc, offset, width : float
        Viscous friction of both sides [N s/m], Coulomb friction and constant force of the motor side [N], velocity
        [m/s] over which Coulomb friction reverses.
    gap, k, d : float
        Free play [m], stiffness [N/m] and damping [N s/m] of the contact.

    Raises
    ------
    InputError
        If the FMU must be built and there is no C compiler.

    Examples
    --------
    >>> with drive_fmu() as plant:
    ...     print(plant.spec)
    u [N] -> q [m] every 0.001 s
    """
    values = {"M": M, "ML": ML, "Fv": Fv, "FvL": FvL, "Fc": Fc, "offset": offset, "gap": gap, "k": k, "d": d}
    values.update(width=width, substep=substep)
    return FmuPlant(mockup("drive", fmi), sample_time=sample_time, outputs=outputs, parameters=values)


def two_tanks_fmu(
    *,
    sample_time: float = 1.0,
    outputs: Sequence[str] = ("y",),
    fmi: Literal[2, 3] = 2,
    substep: float = 0.1,
    k_pump: float = 0.04,
    k_upper: float = 0.06,
    k_lower: float = 0.06,
    overflow: bool = False,
    rim: float = 10.0,
    share: float = 0.5,
) -> FmuPlant:
    """Two tanks in cascade as an FMU: pump voltage to lower level, Torricelli outflow, optional overflow.

    Parameters
    ----------
    sample_time : float
        [s].
    outputs : sequence of str
        Among ``y``, ``upper``, ``lower`` [V of the level sensor].
    fmi : {2, 3}
        Version of FMI.
    substep : float
        Largest step [s] of the Runge-Kutta method inside.
    k_pump, k_upper, k_lower : float
        Inflow [1/s], outflows over the root of the level [V^0.5/s].
    overflow : bool
        Whether the tanks have a rim.
    rim, share : float
        Level of the rims [V]; part of the upper tank's overflow that falls into the lower one.

    Raises
    ------
    InputError
        If the FMU must be built and there is no C compiler.

    Examples
    --------
    >>> with two_tanks_fmu() as plant:
    ...     print(plant.spec)
    u [V] -> y [V] every 1 s
    """
    values = {"k_pump": k_pump, "k_upper": k_upper, "k_lower": k_lower, "overflow": overflow}
    values.update(rim=rim, share=share, substep=substep)
    return FmuPlant(mockup("two_tanks", fmi), sample_time=sample_time, outputs=outputs, parameters=values)
