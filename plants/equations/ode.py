"""ODE plants by name: pendulum, cart-pole, chain of masses, linear systems; any other model as :class:`OdePlant`."""

from __future__ import annotations

from typing import Any

import numpy as np

from plants.checking import checked_options, positive, whole
from plants.equations.ode_plant import OdePlant

__all__ = ["OdePlant", "cart_pole_ode", "chain_ode", "linear_ode", "named", "pendulum_ode"]


def pendulum_ode(**options: Any) -> OdePlant:
    """Pendulum with viscous friction as an ODE: ``J theta'' + b theta' + mgl sin(theta) = u``.

    Parameters
    ----------
    **options
        Of :class:`OdePlant`.

    Examples
    --------
    >>> print(pendulum_ode().spec)
    u [N m] -> theta [rad] every 0.01 s
    """
    return named("pendulum-ode", {"model": "pendulum", "u_limit": 2.0}, options)


def cart_pole_ode(**options: Any) -> OdePlant:
    """Cart-pole with a point-mass pole and viscous friction as an ODE; theta is absolute, 0 hangs down.

    Parameters
    ----------
    **options
        Of :class:`OdePlant`.

    Examples
    --------
    >>> print(cart_pole_ode().spec)
    u [N] -> x [m], theta [rad] every 0.01 s
    """
    return named("cart-pole-ode", {"model": "cart-pole", "u_limit": 10.0}, options)


def chain_ode(
    *,
    masses: int = 3,
    mass: float = 1.0,
    stiffness: float = 40.0,
    damping: float = 0.08,
    coupling: float = 1.0,
    **options: Any,
) -> OdePlant:
    """Chain of masses between two walls as an ODE, a force on each: a structure whose modes are known exactly.

    With ``process_noise`` a random force acts on every mass: what wind and traffic do to a structure.

    Parameters
    ----------
    masses, mass, stiffness, damping, coupling
        Of the model ``mass-chain``; :func:`harness.physics.models.chain.chain_modes` has its modes.
    **options
        Of :class:`OdePlant`.

    Examples
    --------
    >>> print(chain_ode(masses=2).spec)
    u1 [N], u2 [N] -> q1 [m], q2 [m] every 0.1 s
    """
    from harness.physics.models.chain import mass_chain

    model = mass_chain(masses, mass, stiffness, damping, coupling)
    return named("chain-ode", {"model": model, "sample_time": 0.1, "u_limit": 10.0}, options)


def linear_ode(
    *,
    order: int = 4,
    inputs: int = 1,
    outputs: int = 1,
    seed: int = 0,
    sample_time: float = 0.1,
    process_noise: float = 0.0,
    u_limit: float = 1.0,
) -> OdePlant:
    """Stable random linear system without feedthrough, drawn from a seed.

    Modes have time constants of 2 to 20 samples, half of them oscillate; every state can be excited and seen.

    Parameters
    ----------
    order : int
        Number of states.
    inputs, outputs : int
        Number of inputs u1, u2, ... and outputs y1, y2, ... (u and y if there is one).
    seed : int
        Which system.
    sample_time, process_noise, u_limit
        Of :class:`OdePlant`.

    Raises
    ------
    InputError
        If an option is out of range.

    Examples
    --------
    >>> a, b, c = linear_ode(order=3, seed=1).discrete()
    >>> bool(np.abs(np.linalg.eigvals(a)).max() < 1), a.shape, b.shape, c.shape
    (True, (3, 3), (3, 1), (1, 3))
    """
    import sympy as sp

    from harness.physics import Ode
    from harness.rng import stream

    n, inputs, outputs = whole("order", order), whole("inputs", inputs), whole("outputs", outputs)
    dt = positive("sample_time", sample_time)
    rng = stream("linear-ode", n, inputs, outputs, int(seed))
    a = np.zeros((n, n))
    row = 0
    while row < n:
        decay = 1.0 / (dt * np.exp(rng.uniform(np.log(2.0), np.log(20.0))))
        if row + 1 < n and rng.random() < 0.5:
            swing = decay * np.exp(rng.uniform(np.log(0.5), np.log(3.0)))
            a[row : row + 2, row : row + 2] = [[-decay, swing], [-swing, -decay]]
            row += 2
        else:
            a[row, row] = -decay
            row += 1
    turn, _ = np.linalg.qr(rng.normal(size=(n, n)))
    a = turn @ a @ turn.T
    b = rng.normal(size=(n, inputs)) * np.abs(np.diag(a)).mean()
    c = rng.normal(size=(outputs, n))
    names_u = ["u"] if inputs == 1 else [f"u{k + 1}" for k in range(inputs)]
    names_y = ["y"] if outputs == 1 else [f"y{k + 1}" for k in range(outputs)]
    model = Ode(f"linear-{n}", x=" ".join(f"x{k + 1}" for k in range(n)), u=" ".join(names_u))
    model.rhs = list(sp.Matrix(a.tolist()) * sp.Matrix(model.x) + sp.Matrix(b.tolist()) * sp.Matrix(model.u))
    measured = sp.Matrix(c.tolist()) * sp.Matrix(model.x)
    model.outputs = {name: measured[k] for k, name in enumerate(names_y)}
    return OdePlant(model=model, sample_time=dt, process_noise=process_noise, u_limit=u_limit)


def named(factory: str, defaults: dict[str, Any], options: dict[str, Any]) -> OdePlant:
    """Return an ODE plant with the defaults of a factory, overwritten by its options.

    Raises
    ------
    InputError
        If an option is unknown or out of range.

    Examples
    --------
    >>> named("fast-pendulum", {"model": "pendulum"}, {"sample_time": 0.001}).spec.sample_time
    0.001
    """
    return OdePlant(**checked_options(factory, OdePlant, defaults, options))
