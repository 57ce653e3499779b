"""Two tanks in cascade, a pump above: the nominal model of level control."""

from __future__ import annotations

from typing import Any

import sympy as sp

from harness.errors import refuse_unknown
from harness.physics.symbolic.ode import Ode


def two_tanks(pump_offset: bool = False, upper_outlet: str = "orifice", sensor_zero: bool = False) -> Ode:
    """Two tanks in cascade; levels in the unit of the level sensor; y is the lower level.

    ``upper' = k_pump u - q``, ``lower' = q - k_lower sqrt(lower)`` with ``q = k_upper sqrt(upper)`` (Torricelli). The
    unit of the unmeasured upper level is chosen so that what leaves it raises the lower level as much.

    Parameters
    ----------
    pump_offset : bool
        The pump delivers ``k_pump (u + u_0)``: its flow is not 0 at 0 V.
    upper_outlet : {"orifice", "linear"}
        ``"linear"``: ``q = k_upper upper``, the flow through a long narrow pipe, or through an orifice about an
        operating point; what stands below that point is part of ``u_0``.
    sensor_zero : bool
        The sensor reads ``y_0``, not 0, at an empty lower tank; a sensor of 0 to 10 V cannot read less than 0.

    Raises
    ------
    InputError
        If the outlet is neither.

    Examples
    --------
    >>> print(two_tanks().system())
    two-tanks: u [V] -> y [V]
    >>> two_tanks(pump_offset=True).system().parameter_names
    ('k_pump', 'k_upper', 'k_lower', 'u_0')
    """
    refuse_unknown("outlet of the upper tank", upper_outlet, ("orifice", "linear"), remedy="choose one of them")
    linear = upper_outlet == "linear"
    known: dict[str, Any] = {
        "k_pump": ("1/s", 0.02, 0.0),
        "k_upper": ("1/s", 0.02, 0.0) if linear else ("V^0.5/s", 0.03, 0.0),
        "k_lower": ("V^0.5/s", 0.03, 0.0),
    }
    if pump_offset:
        known["u_0"] = ("V", 0.0)
    if sensor_zero:
        # A hair below 0: a bound of 0 would make the fit work on the logarithm, which never comes back from there.
        known["y_0"] = ("V", 0.0, -1e-6, 10.0)
    o = Ode(
        "two-tanks",
        x="upper lower",
        u="u",
        p=" ".join(known),
        units={"upper": "V", "lower": "V", "u": "V"},
        parameters=known,
        process="upper lower",
    )
    (upper, lower), (u,), (k_pump, k_upper, k_lower) = o.x, o.u, o.p[:3]
    named = {str(symbol): symbol for symbol in o.p}

    def root(level: Any) -> Any:
        # Rounded off below 1e-4 V: the derivative of the square root at an empty tank is infinite.
        return sp.sqrt(sp.Max(level, 0) + 1e-4) - 1e-2

    q = k_upper * (sp.Max(upper, 0) if linear else root(upper))
    o.rhs = [k_pump * (u + named.get("u_0", 0)) - q, q - k_lower * root(lower)]
    o.outputs = {"y": (lower + named.get("y_0", 0), "V")}
    return o
