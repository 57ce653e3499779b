"""An object that is pushed over a table and turns: inertia, support friction and friction cone from contact data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.models.analysis import Findings, Takes, as_dataset
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.mechanics.pushed import column_of

_STILL = 5e-3
"""Speed [m/s] below which friction falls to nothing, so that a run can be computed: far below that of a push."""

_HORIZON = 0.3  # Windows of the fit [s]: a push or two; longer ones end in stops at which a run forgets what it was.
_SHORTER = (0.1,)  # Windows with which the fit begins [s]: near the minimum, and too short for stops.
_TOUCHING = 5e-4  # Distance of tip and side [m] that counts as contact: a few times the noise of places.
_PRESSED = 0.1  # Share of the usual contact force below which directions of a force say nothing.

_SLIPPING = 0.02
"""Speed [m/s] of the tip along the side from which on it slips: above what noise and rotation within a sample make."""

_SMOOTH = 0.05
"""Time [s] over which that speed is averaged: differences of places of 0.1 mm over it are known to 3 mm/s."""

_ONSET = 0.05  # Share of the usual contact force from which on there is contact.

_LEAP = 1.0
"""Change of the contact force from sample to sample, in usual ones, that is an impact: when in the sample it came is
not known, and with it how far the object got by its end."""

_EDGE = 0.99  # Quantile of the force that stands for a push, however short the pushes of a record are.
_STIRRED = 0.02  # Way of the object in a stretch, in halves of its side, below which nothing is told but noise.
_ITERATIONS = 150  # Of the fit at most: stretches that end in stops bend its valley.
_SHORTEST = 12  # Samples of a stretch between impacts at least.
_SCALED = 2.0  # By what forces are multiplied to show what follows them.
_SLIDING = 0.05  # Speed [m/s] above which friction has its full level.
_FEW = 20  # Samples of a slipping contact at least, for a coefficient of friction.

_MOVED = 0.05
"""Turning [rad] of the object, from its least to its largest angle, below which nothing is said of its inertia."""


@dataclass(frozen=True, eq=False)
class Contact:
    """Where a round tip meets a square object, over the samples k to k + 1 of a record."""

    arm: FloatArray  # (N - 1, 2): From the middle of the object to the contact [m], mean over the sample
    normal: FloatArray  # (N - 1, 2): Unit vector out of the object
    touching: npt.NDArray[np.bool_]  # array of bool (N - 1,): In contact at both ends of the sample
    slip: FloatArray  # (N - 1,): Speed [m/s] of the tip along the side, against the object, averaged over 0.05 s


def contacts(places: FloatArray, angle: FloatArray, tips: FloatArray, half: float, tip: float, dt: float) -> Contact:
    """Return the contacts of a record.

    Parameters
    ----------
    places, tips : array (N, 2)
        Middle of the object and of the tip [m].
    angle : array (N,)
        Of the object [rad].
    half, tip : float
        Half the side of the object, and the radius of the tip [m].
    dt : float
        [s].

    Examples
    --------
    >>> at = np.zeros((2, 2))
    >>> met = contacts(at, np.zeros(2), at + [-0.06, 0.02], 0.05, 0.01, 0.01)
    >>> met.normal[0].tolist(), met.arm[0].round(3).tolist(), bool(met.touching[0])
    ([-1.0, 0.0], [-0.05, 0.02], True)
    """
    c, s = np.cos(angle), np.sin(angle)
    away = tips - places
    local = np.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]], axis=1)
    nearest = np.clip(local, -half, half)
    gap = np.hypot(*(local - nearest).T)
    normal = (local - nearest) / np.maximum(gap, 1e-12)[:, None]

    def turned(v: FloatArray) -> FloatArray:
        return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]], axis=1)

    outward, arm = turned(normal), turned(nearest)
    middle = 0.5 * (outward[1:] + outward[:-1])
    middle = middle / np.maximum(np.hypot(*middle.T), 1e-12)[:, None]
    near = np.abs(gap - tip) < _TOUCHING
    # against the object: its middle moves, and it turns under the contact
    mean_arm = 0.5 * (arm[1:] + arm[:-1])
    spin = np.diff(np.unwrap(angle)) / dt
    own = np.diff(places, axis=0) / dt + spin[:, None] * np.stack([-mean_arm[:, 1], mean_arm[:, 0]], axis=1)
    relative = np.diff(tips, axis=0) / dt - own
    along = relative[:, 1] * middle[:, 0] - relative[:, 0] * middle[:, 1]
    width = max(1, round(_SMOOTH / dt))
    slip = np.convolve(along, np.full(width, 1.0 / width), mode="same") if len(along) >= width else along
    return Contact(mean_arm, middle, np.asarray(near[1:] & near[:-1]), np.asarray(slip))


def cone(contact: Contact, force: FloatArray) -> dict[str, Any]:
    """Return what forces (N - 1, 2) [N] on the object say of the friction between tip and side.

    Within the cone ``|ft| <= mu fn`` the tip sticks, on its edge it slips (Coulomb). Where it slips long enough their
    ratio is the coefficient; else the largest ratio of a sticking contact is what it is at least.

    Returns
    -------
    dict
        ``mu_tip`` (None where it never slipped long enough), ``at least``, ``slipping`` samples, ``sticking`` samples,
        and the quartiles of the ratio where it slips.
    """
    normal, tangent = contact.normal, np.stack([-contact.normal[:, 1], contact.normal[:, 0]], axis=1)
    pressed, along = -np.sum(force * normal, axis=1), np.sum(force * tangent, axis=1)
    usual = np.median(pressed[contact.touching]) if contact.touching.any() else 0.0
    # within a contact: where it begins or ends within the sample the normal is not that of the force
    held = contact.touching & np.append(False, contact.touching[:-1]) & np.append(contact.touching[1:], False)
    on = held & (pressed > max(_PRESSED * float(usual), 1e-9))
    ratio = np.where(on, along / np.where(on, pressed, 1.0), 0.0)
    slipping = on & (np.abs(contact.slip) > _SLIPPING)
    sticking = on & ~slipping
    # friction acts on the object the way the tip slips
    with_slip = (ratio * np.sign(contact.slip))[slipping]
    known = len(with_slip) >= _FEW
    return {
        "mu_tip": float(np.median(with_slip)) if known else None,
        "quartiles": [float(value) for value in np.quantile(with_slip, [0.25, 0.75])] if known else None,
        "at least": float(np.quantile(np.abs(ratio[sticking]), 0.9)) if sticking.any() else 0.0,
        "slipping": int(slipping.sum()),
        "sticking": int(sticking.sum()),
    }


Feet = Sequence[Sequence[float]] | None


def calm(force: FloatArray) -> list[tuple[int, int]]:
    """Return the stretches of a contact force (N, 2) between impacts: first and last sample and one.

    Examples
    --------
    >>> force = np.zeros((60, 2))
    >>> force[30:] = [5.0, 0.0]
    >>> calm(force)
    [(0, 29), (32, 60)]
    """
    size = np.hypot(*force.T)
    pressed = size[size > _ONSET * np.quantile(size, _EDGE)]
    usual = float(np.median(pressed)) if len(pressed) else 1.0
    on = size > _ONSET * usual
    struck = np.flatnonzero((on[1:] & ~on[:-1]) | (np.abs(np.diff(size)) > _LEAP * usual)) + 1
    lost = np.zeros(len(force), dtype=bool)
    for shift in (-1, 0, 1):
        lost[np.clip(struck + shift, 0, len(force) - 1)] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[True], lost, [True]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= _SHORTEST]


def object_in_plane(gravity: float = 9.81, feet: Feet = None) -> Any:
    """Return the mechanism of a rigid object on a table under a force and a torque at its middle.

    - ``gravity``: [m/s^2]
    - ``feet``: places of three feet from the middle, along the sides [m]: Coulomb friction under each, with the load
      that statics gives it. By default the support is unknown: its friction is an ellipsoid of force and torque, ``-mu
      m g (v, r^2 w) / sqrt(v^2 + r^2 w^2)`` with the velocity v and the rate w of the centre of mass (Lee and Cutkosky
      1991, *J. Eng. Ind.* 113:320), where r says how far out it rubs, on the mean.

    Examples
    --------
    >>> print(object_in_plane().system())
    pushed-object: fx [N], fy [N], torque [N m] -> x [m], y [m], theta [rad]
    """
    import sympy as sp

    from harness.physics.symbolic.mechanism import Mechanism

    m = Mechanism(
        "pushed-object", q="x y theta", u="fx fy torque", p="m J mu com_x com_y" + (" r" if feet is None else "")
    )
    (x, y, theta), (vx, vy, rate), (fx, fy, torque), (mass, J, mu, com_x, com_y, *more) = m.q, m.v, m.u, m.p

    def turned(along: Any, across: Any) -> tuple[Any, Any]:
        return along * sp.cos(theta) - across * sp.sin(theta), along * sp.sin(theta) + across * sp.cos(theta)

    def drag(at: tuple[Any, Any], level: Any, spread: Any = 0) -> tuple[Any, Any, Any]:
        """Return force and torque about the middle of friction of a level [N] at a place."""
        v = (vx - rate * at[1], vy + rate * at[0])
        slope = -level / sp.sqrt(v[0] ** 2 + v[1] ** 2 + (spread * rate) ** 2 + _STILL**2)
        return slope * v[0], slope * v[1], slope * (spread**2 * rate + at[0] * v[1] - at[1] * v[0])

    com = turned(com_x, com_y)
    m.body(mass, (x + com[0], y + com[1]), J, theta, weight=0)
    if feet is None:
        parts = [drag(com, mu * mass * gravity, more[0])]
    else:
        # loads: shares with which the feet's places make the centre of mass
        table = sp.Matrix([[1, 1, 1], [place[0] for place in feet], [place[1] for place in feet]])
        shares = table.inv() * sp.Matrix([1, com_x, com_y])
        parts = [drag(turned(*place), mu * mass * gravity * share) for place, share in zip(feet, shares, strict=True)]
    m.Q = [push + sum(part[k] for part in parts) for k, push in enumerate((fx, fy, torque))]
    m.units.update(x="m", y="m", fx="N", fy="N", torque="N m")
    m.parameters(
        m=("kg", 1.0),
        J=("kg m^2", 1e-3),
        mu=("1", 0.3),
        com_x=("m", 0.0, -np.inf),
        com_y=("m", 0.0, -np.inf),
    )
    if feet is None:
        m.parameters(r=("m", 0.03))
    return m


def fitted_in_plane(
    poses: Sequence[FloatArray],
    wrenches: Sequence[FloatArray],
    dt: float,
    *,
    gravity: float,
    half: float,
    feet: Feet = None,
    start: Mapping[str, float] | None = None,
) -> Any:
    """Return the fit of the object's parameters, and the record of the estimate.

    Raises FitError if the object never turns: its inertia, and where its centre of mass is, are not in the data.

    - ``poses`` sequence of array (N, 3): x, y [m] and angle [rad] of the middle
    - ``wrenches`` sequence of array (N, 3): force [N] and torque about the middle [N m], held over each sample
    - ``half``: half the side [m]: sizes of the start values
    - ``feet``: as of :func:`object_in_plane`
    - ``start``: where parameters start
    """
    from harness.physics import fit_output_error
    from harness.physics.fitting.output_error_estimate import output_error_estimate

    turned = max(float(np.ptp(pose[:, 2])) for pose in poses)
    if turned < _MOVED:
        raise FitError(
            "pushed object: it hardly turns",
            expected=f"{_MOVED:g} rad from its least to its largest angle",
            got=f"{turned:.2g} rad",
            remedy="push beside its middle, or leave the angle out: along one line mass and friction can be told",
        )
    system = object_in_plane(gravity, feet).system()
    spec = PlantSpec(system.inputs, system.outputs, dt)
    records = [
        Trajectory(dt * np.arange(float(len(pose))), wrench, pose, spec)
        for pose, wrench in zip(poses, wrenches, strict=True)
    ]
    mass, mu = _first(poses, wrenches, dt, gravity)
    guess = {"m": mass, "J": mass * half**2 / 1.5, "mu": mu, "com_x": 0.0, "com_y": 0.0}
    guess |= {"r": 0.7 * half} if feet is None else {}
    fit = fit_output_error(
        system,
        records,
        start=guess | dict(start or {}),
        horizon=_HORIZON,
        continuation=_SHORTER,
        max_iterations=_ITERATIONS,
    )
    return fit, output_error_estimate(system, fit)


def _first(
    poses: Sequence[FloatArray], wrenches: Sequence[FloatArray], dt: float, gravity: float
) -> tuple[float, float]:
    """Return mass and friction of the middle of the object where it slides, by least squares: where a fit begins."""
    n = max(1, round(0.5 * _SMOOTH / dt))
    rows, right = [], []
    for pose, wrench in zip(poses, wrenches, strict=True):
        if len(pose) <= 2 * n:
            continue
        place = pose[:, :2]
        v = (place[2 * n :] - place[: -2 * n]) / (2 * n * dt)
        a = (place[2 * n :] - 2 * place[n:-n] + place[: -2 * n]) / (n * dt) ** 2
        # what a second difference weighs: the forces around its middle most
        triangle = np.concatenate([np.arange(1.0, n + 1), np.arange(n - 1.0, 0, -1)]) / n**2
        weight = 0.5 * (np.append(triangle, 0.0) + np.append(0.0, triangle))
        force = np.stack([np.convolve(wrench[:-1, k], weight, mode="valid") for k in range(2)], axis=1)
        speed = np.hypot(*v.T)
        keep = speed > _SLIDING
        rows.append(np.stack([a[keep].ravel(), (gravity * v[keep] / speed[keep, None]).ravel()], axis=1))
        right.append(force[keep].ravel())
    table = np.concatenate(rows) if rows else np.zeros((0, 2))
    if len(table) < _FEW:
        return 1.0, 0.3
    mass, level = np.linalg.lstsq(table, np.concatenate(right), rcond=None)[0]
    return (float(mass), float(level / mass)) if mass > 0 and level > 0 else (1.0, 0.3)


@dataclass(frozen=True)
class PushedInPlane:
    """Inertia, centre of mass and frictions of an object that a fingertip pushes over a table and turns.

    The object moves by the contact alone, ``m (v' ) = f + friction`` and ``J w' = (contact - centre of mass) x f +
    friction``: from its pose and from force and place of the contact follow mass, moment of inertia, centre of mass and
    the friction of its support, by free runs between impacts (:func:`object_in_plane`); and from the directions of the
    forces the friction cone between tip and side (Fazeli, Kolbert, Tedrake and Rodriguez 2017, *Int. J. Robotics Res.*
    36(13-14):1437). With all forces multiplied by 2 mass and moment of inertia double, and nothing else changes:
    without a calibrated force only frictions, centre of mass and J / m can be told. Where the tip never slips its
    friction is only known to be at least the largest ratio of forces; where the object hardly turns the answer is
    refused.

    Parameters
    ----------
    pose : sequence of str
        Columns of the middle of the object and its angle: x, y [m] and theta [rad].
    tip : sequence of str
        Columns of the middle of the round tip [m].
    force : sequence of str
        Columns of the mean contact force on the object over the sample that has passed [N].
    half, radius : float
        Half the side of the square object, and the radius of the tip [m].
    feet : three pairs of float, optional
        As of :func:`object_in_plane`.
    gravity : float
        [m/s^2].

    Examples
    --------
    >>> PushedInPlane().channels()
    (['x', 'y', 'theta', 'x_pusher', 'y_pusher', 'fx', 'fy'], [])
    """

    takes: ClassVar[Takes] = "data"
    pose: Sequence[str] = ("x", "y", "theta")
    tip: Sequence[str] = ("x_pusher", "y_pusher")
    force: Sequence[str] = ("fx", "fy")
    half: float = 0.05
    radius: float = 0.01
    feet: Feet = None
    gravity: float = 9.81

    def channels(self) -> tuple[list[str], list[str]]:
        """Return the columns that it needs of a bare table, and those that it takes where they are there."""
        return [*self.pose, *self.tip, *self.force], []

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the parameters with the force as it is and twice as large, and the friction cone.

        Raises
        ------
        FitError
            If there is hardly any contact, the object hardly turns, or the fit does not converge.
        """
        poses, wrenches, met, forces = [], [], [], []
        runs = as_dataset(subject, "pushed object").estimation
        dt = runs[0].spec.sample_time
        for record in (run.measured() for run in runs):
            table = np.stack([column_of(record, name) for name in self.channels()[0]], axis=1)
            table[:, 2] = np.unwrap(table[:, 2])
            contact = contacts(table[:, :2], table[:, 2], table[:, 3:5], self.half, self.radius, dt)
            force = table[1:, 5:]
            torque = contact.arm[:, 0] * force[:, 1] - contact.arm[:, 1] * force[:, 0]
            met.append(contact)
            forces.append(force)
            for begin, end in calm(force):
                pose = table[begin : end + 1, :3]
                if np.hypot(*np.ptp(pose[:, :2], axis=0)) + self.half * np.ptp(pose[:, 2]) < _STIRRED * self.half:
                    continue
                poses.append(pose)
                wrenches.append(np.vstack([np.column_stack([force, torque])[begin:end], np.zeros((1, 3))]))
        whole = Contact(*(np.concatenate([getattr(one, name) for one in met]) for name in _PARTS))
        touching = int(whole.touching.sum())
        if touching < _FEW or not poses:
            raise FitError(
                "pushed object: hardly any contact",
                expected=f"{_FEW} samples in contact",
                got=f"{touching} (half side {self.half:g} m, tip {self.radius:g} m)",
                remedy="push longer, or correct half and radius",
            )
        rows: list[dict[str, Any]] = []
        before: dict[str, float] = {}
        for factor in (1.0, _SCALED):
            fit, estimate = fitted_in_plane(
                poses, [factor * wrench for wrench in wrenches], dt, gravity=self.gravity, half=self.half,
                feet=self.feet, start=before,
            )  # fmt: skip
            if not fit.converged:
                raise FitError(
                    "pushed object: the fit does not converge", expected="a minimum", got=fit.message,
                    remedy="push longer and beside the middle",
                )  # fmt: skip
            before = dict(fit.parameters)
            rows += [
                {
                    "force": "as measured" if factor == 1.0 else f"times {factor:g}",
                    "parameter": name,
                    "value": fit.parameters[name],
                    "95 %": _told(estimate.interval(name)),
                    "rms [m, m, rad]": " ".join(f"{value:.2g}" for value in fit.rms),
                }
                for name in fit.names
            ]
        edge = cone(whole, np.concatenate(forces))
        rows.append({
            "force": "as measured", "parameter": "mu_tip", "value": edge["mu_tip"],
            "95 %": "none" if edge["mu_tip"] is None else "half of all within {:.3g} .. {:.3g}".format(
                *edge["quartiles"]), "rms [m, m, rad]": "",
        })  # fmt: skip
        names = len(fit.names)
        first, second = ({row["parameter"]: row["value"] for row in part} for part in (rows[:names], rows[names:-1]))
        words: tuple[str, ...] = (
            f"m {first['m']:.4g} kg, J {first['J']:.3g} kg m^2, mu {first['mu']:.3g}, centre of mass "
            f"{1e3 * first['com_x']:.3g}, {1e3 * first['com_y']:.3g} mm from the middle",
            f"tip: mu_tip {edge['mu_tip']:.3g}, from {edge['slipping']} samples in which it slips"
            if edge["mu_tip"] is not None
            else f"tip: it slips in {edge['slipping']} samples only: mu_tip is at least {edge['at least']:.2g}",
            f"with {_SCALED:g} times the force m is {second['m'] / first['m']:.3g} and J "
            f"{second['J'] / first['J']:.3g} times as large, mu {second['mu'] / first['mu']:.3g} times: motion alone "
            "tells no mass",
        )
        if self.feet is None:
            words = (
                *words,
                "the intervals count the noise alone: an ellipsoid stands for what the support can carry, so inertia "
                "and centre of mass may lie outside; say feet where their places are known",
            )
        return Findings("an object that is pushed and turns", rows, words, {"parameters": first, "cone": edge})


_PARTS = ("arm", "normal", "touching", "slip")


def _told(interval: tuple[float, float] | None) -> str:
    return "none" if interval is None else f"{interval[0]:.4g} .. {interval[1]:.4g}"
