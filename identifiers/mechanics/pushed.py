"""Mass and friction of an object that is only touched: what a contact force tells, and what is lost without."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from harness.errors import FitError, InputError
from harness.models.analysis import Findings, Takes, as_dataset
from harness.models.estimate import estimate_of
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.mechanics.grey_box import OutputError

_FRICTION = "coulomb_friction@q.Fc"  # Level of the dry friction in the model of the object.

_HORIZON = 0.5
"""Windows of the fit [s]: some pushes and pauses; over a whole record a position forgets nothing of an early error."""

_START = 3.0  # Friction where the fit begins [N]; the mass begins at 1 kg.
_SCALED = 2.0  # By what a force is multiplied to show that mass and friction follow it and the fit stays what it is.
_SAME = 0.01  # Relative difference of two fits that counts as none: far below what two wrong laws differ by.


def column_of(record: Trajectory, name: str) -> FloatArray:
    """Return an input or an output of a record (N,) by its name.

    Raises InputError if there is none of that name.
    """
    for table, channels in ((record.u, record.spec.inputs), (record.y, record.spec.outputs)):
        for k, channel in enumerate(channels):
            if channel.name == name:
                return np.asarray(table[:, k], dtype=float)
    raise InputError(
        "pushed object",
        expected=f"a column {name}",
        got=", ".join(channel.name for channel in (*record.spec.inputs, *record.spec.outputs)),
        remedy="name the columns that are meant (sysid list analyses shows the options)",
    )


@dataclass(frozen=True)
class PushedObject:
    """Mass and friction of an object that slides over a table and is moved by a contact alone.

    ``m x'' = f - mu m g sgn(x')``: nothing drives the object but the contact force f, so it is no robot's torque but a
    part of the record (Fazeli, Kolbert, Tedrake & Rodriguez 2017, *Int. J. Robotics Res.* 36(13-14):1437). Fits by free
    runs (``output-error``) are shown: with the contact force that was measured; with the same force multiplied by
    2, which multiplies the mass by 2 and changes neither mu nor the fit, so that without a calibrated force only mu can
    be told; and, where the drive of the pusher was recorded, with that taken for the force.

    Along one line and without turning: the moment of inertia and the place of the contact do not enter.

    Parameters
    ----------
    position, force : str
        Columns of the object's position [m], and of the mean contact force over the sample that has passed [N].
    drive : str, optional
        Column of the force on the pusher [N].
    gravity : float
        [m/s^2].

    Examples
    --------
    >>> PushedObject().channels()
    (['x', 'f'], ['u'])
    """

    takes: ClassVar[Takes] = "data"
    position: str = "x"
    force: str = "f"
    drive: str | None = "u"
    gravity: float = 9.81

    def channels(self) -> tuple[list[str], list[str]]:
        """Return the columns that it needs of a bare table, and those that it takes where they are there."""
        return [self.position, self.force], [self.drive] if self.drive else []

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return mass and friction by what is taken for the contact force.

        Raises
        ------
        FitError
            If the object hardly moves.
        """
        records = [record.measured() for record in as_dataset(subject, "pushed object").estimation]
        felt = [_after(column_of(record, self.force)) for record in records]
        cases = {
            "contact force measured": felt,
            f"contact force times {_SCALED:g}": [_SCALED * force for force in felt],
        }
        if self.drive and all(_has(record, self.drive) for record in records):
            cases["drive of the pusher taken for it"] = [column_of(record, self.drive) for record in records]
        rows = [self._row(name, records, forces, rng) for name, forces in cases.items()]
        first, scaled = rows[0], rows[1]
        alike = abs(scaled["rms [m]"] / first["rms [m]"] - 1) < _SAME
        words = [
            f"m {first['m [kg]']:.4g} kg and mu {first['mu']:.4g} with the contact force",
            f"with {_SCALED:g} times the force the mass is {scaled['m [kg]'] / first['m [kg]']:.3g} times as large and "
            f"mu {scaled['mu'] / first['mu']:.3g} times, and the fit is "
            + ("the same: motion alone tells mu, and no mass" if alike else "another one: the law does not fit"),
        ]
        if len(rows) > 2:
            words.append(
                "the drive of the pusher taken for the contact force errs by "
                f"{rows[2]['rms [m]'] / first['rms [m]']:.3g} times as much"
            )
        return Findings("an object that is pushed", rows, tuple(words), {})

    def _row(
        self, name: str, records: list[Trajectory], forces: list[FloatArray], rng: np.random.Generator
    ) -> dict[str, Any]:
        """Return mass, friction and their intervals with forces (N,) taken for what moves the object."""
        alone = []
        for record, force in zip(records, forces, strict=True):
            spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), record.spec.sample_time)
            alone.append(Trajectory(record.t, force[:, None], column_of(record, self.position)[:, None], spec))
        model = OutputError(
            model="drive",
            effects=("coulomb_friction@q",),
            horizon=_HORIZON,
            start={"M": 1.0, "Fv": 0.0, _FRICTION: _START},
            fixed=("Fv", "offset", "coulomb_friction@q.w"),
        ).fit(alone, rng=rng)
        mass, level = model.parameters["M"], model.parameters[_FRICTION]
        if not mass > 0:
            raise FitError("pushed object", expected="a mass above 0", got=f"{mass:.3g} kg", remedy="push harder")
        estimate = estimate_of(model)
        interval = None if estimate is None else estimate.interval("M")
        return {
            "force": name,
            "m [kg]": mass,
            "95 %": "none" if interval is None else f"{interval[0]:.4g} .. {interval[1]:.4g}",
            "mu": level / (mass * self.gravity),
            "rms [m]": float(model.notes["rms"][0]),
        }


def _after(force: FloatArray) -> FloatArray:
    """Return the mean force over the sample that follows, of that over the one before."""
    return np.append(force[1:], 0.0)


def _has(record: Trajectory, name: str) -> bool:
    return any(channel.name == name for channel in (*record.spec.inputs, *record.spec.outputs))
