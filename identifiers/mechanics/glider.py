"""The perching glider's accelerations from few of twenty functions: the exercise of the textbook's chapter."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any, ClassVar

import numpy as np

from harness.errors import FitError, InputError
from harness.models.analysis import Findings, Takes
from harness.physics.fitting.smoothing import smooth
from harness.signals import Dataset, FloatArray, Trajectory

TAIL = 0.27 + 0.022  # From the centre of mass to the elevator [m].

GRAVITY = 9.81

_POSITIONS = ("x", "z", "theta", "phi")

_ACCELERATIONS = ("along the wing [m/s^2]", "across the wing [m/s^2]", "of the pitch [rad/s^2]")

_MARGIN = 5  # Samples at both ends of a record that are left out: a local cubic has no neighbours on one side there.
_SLOW = 1e-6  # Sizes of a function, relative to the largest, below which it does not move in these data.


def glider_functions(q: FloatArray, u: FloatArray, *, nose_down: bool) -> dict[int, FloatArray]:
    """Return the twenty functions of the exercise (Hoburg & Tedrake 2009, appendix) by their number, each (N,).

    - ``q`` (N, 7): x, z [m], pitch, elevator [rad], and the rates of the first three
    - ``u`` (N,): rate of the elevator [rad/s]
    - ``nose_down``: pitch counts positive nose down, as in the textbook's data; the exercise takes angle of attack and
      speed of the elevator as if it counted nose up

    Examples
    --------
    >>> level = np.array([[0.0, 0.0, 0.1, 0.0, 7.0, 0.0, 0.0]])
    >>> round(float(glider_functions(level, np.zeros(1), nose_down=True)[1][0]), 3)  # speed^2 sin(attack)
    4.892
    """
    _, _, pitch, elevator, vx, vz, rate = q.T
    sign = 1.0 if nose_down else -1.0
    speed, attack = np.hypot(vx, vz), pitch + sign * np.arctan2(vz, vx)
    tail_x, tail_z = vx + TAIL * rate * np.sin(pitch), vz + sign * TAIL * rate * np.cos(pitch)
    tail_speed, tail_attack = np.hypot(tail_x, tail_z), pitch + elevator + sign * np.arctan2(tail_z, tail_x)
    sin, cos, tail_sin, tail_cos = np.sin(attack), np.cos(attack), np.sin(tail_attack), np.cos(tail_attack)
    turn = rate + u
    return {
        1: speed**2 * sin,
        3: speed**2 * sin * cos**2,
        5: speed**2 * sin**3,
        6: speed**2 * cos**3,
        7: speed**3 * cos,
        9: speed * rate * cos,
        11: rate,
        13: np.sin(elevator),
        15: speed * u * np.sin(elevator),
        18: speed * turn * np.sin(elevator) * np.cos(elevator),
        20: tail_speed**2 * tail_sin,
        24: tail_speed**2 * tail_sin * np.sin(elevator),
        26: tail_speed * u * tail_cos,
        29: speed**2 * sin * cos,
        30: tail_speed**2 * tail_sin * tail_cos * np.cos(elevator),
        32: rate * np.abs(rate),
        35: rate * np.abs(rate) * cos,
        38: tail_speed * turn,
        39: tail_speed * turn * tail_sin,
        41: tail_speed * turn * tail_sin * tail_cos,
    }


def along_the_wing(q: FloatArray, accelerations: FloatArray, *, nose_down: bool) -> FloatArray:
    """Return the accelerations (N, 3) along and across the wing, without gravity, and of the pitch.

    - ``q`` (N, 7): as of :func:`glider_functions`
    - ``accelerations`` (N, 3): of x, z [m/s^2] and the pitch [rad/s^2]
    """
    sin, cos = np.sin(q[:, 2]), np.cos(q[:, 2])
    sign = -1.0 if nose_down else 1.0
    x, z = accelerations[:, 0], accelerations[:, 1] + GRAVITY
    return np.column_stack([cos * x + sign * sin * z, -sign * sin * x + cos * z, accelerations[:, 2]])


@dataclass(frozen=True)
class GliderFunctions:
    """The perching glider's accelerations from few of twenty functions, with signs as written and consistent.

    The exercise of Tedrake 2024, *Underactuated Robotics*, chapter on system identification (functions of Hoburg &
    Tedrake 2009, *AIAA Guidance, Navigation and Control*): of every number of functions the subset that leaves least of
    each acceleration, by trying all. Positions are smoothed by local cubics. As written the exercise counts pitch
    positive nose up, while its data, and the plant ``glider-ode``, count it the other way.

    Parameters
    ----------
    most : int
        Functions of each acceleration at most; up to 3, as all subsets are tried.
    elevator : str
        Column of the elevator's rate [rad/s].
    """

    takes: ClassVar[Takes] = "data"
    most: int = 3
    elevator: str = "phidot"

    def channels(self) -> tuple[list[str], list[str]]:
        """Return the columns that it needs of a bare table, and those that it takes where they are there."""
        return [*_POSITIONS, self.elevator], []

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return what the best subsets leave of the accelerations, by their number and by the sign of the pitch.

        Raises
        ------
        InputError
            If the subject is no data set, lacks a column, or ``most`` is not 1, 2 or 3.
        FitError
            If the records are too short.
        """
        del rng
        if not isinstance(subject, Dataset) or self.most not in (1, 2, 3):
            raise InputError(
                "glider functions",
                expected="a data set, and most = 1, 2 or 3",
                got=f"{type(subject).__name__}, most = {self.most}",
                remedy="give records of a glider",
            )
        parts = [self._motion(record.measured()) for record in subject.estimation]
        q, u, accelerations = (np.concatenate(column) for column in zip(*parts, strict=True))
        rows, least = [], {}
        for nose_down, name in ((False, "as written"), (True, "consistent")):
            table = glider_functions(q, u, nose_down=nose_down)
            wide, numbers = np.column_stack(list(table.values())), list(table)
            target = along_the_wing(q, accelerations, nose_down=nose_down)
            for count in range(1, self.most + 1):
                found = [_best(wide, target[:, k], count) for k in range(3)]
                left = sum(value for value, _ in found)
                least[name, count] = left
                chosen = {
                    label: ", ".join(str(numbers[k]) for k in which)
                    for label, (_, which) in zip(_ACCELERATIONS, found, strict=True)
                }
                rows.append({"signs": name, "functions": count, "sum of squares": left, **chosen})
        words = (
            f"{len(q)} samples; best {self.most} of each: {least['as written', self.most]:.4g} with the signs as "
            f"written, {least['consistent', self.most]:.4g} with consistent ones",
        )
        return Findings("functions of a glider", rows, words, {})

    def _motion(self, record: Trajectory) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return q (n, 7), the elevator's rate (n,) and the accelerations (n, 3) of a record."""
        columns = {
            channel.name: table[:, k]
            for table, channels in ((record.u, record.spec.inputs), (record.y, record.spec.outputs))
            for k, channel in enumerate(channels)
        }
        missing = [name for name in (*_POSITIONS, self.elevator) if name not in columns]
        if missing:
            raise InputError(
                "glider functions",
                expected=f"columns {', '.join((*_POSITIONS, self.elevator))}",
                got=f"none called {', '.join(missing)}",
                remedy="record positions, pitch theta, elevator phi and its rate",
            )
        if len(record) < 4 * _MARGIN:
            raise FitError(
                "glider functions", expected=f"{4 * _MARGIN} samples", got=str(len(record)), remedy="record longer"
            )
        told = [smooth(columns[name], record.spec.sample_time) for name in _POSITIONS]
        kept = slice(_MARGIN, -_MARGIN)
        q = np.column_stack([*(one.value for one in told), *(one.rate for one in told[:3])])
        accelerations = np.column_stack([one.acceleration for one in told[:3]])
        return q[kept], np.asarray(columns[self.elevator], dtype=float)[kept], accelerations[kept]


def _best(wide: FloatArray, target: FloatArray, count: int) -> tuple[float, tuple[int, ...]]:
    """Return the least sum of squares that so many columns leave, and the columns: all subsets are tried."""
    size = np.sqrt(np.mean(wide**2, axis=0))
    alive = np.flatnonzero(size > _SLOW * size.max())
    scaled = wide[:, alive] / size[alive]
    gram, right, square = scaled.T @ scaled, scaled.T @ target, float(target @ target)
    best: tuple[float, tuple[int, ...]] = (np.inf, ())
    for subset in combinations(range(len(alive)), min(count, len(alive))):
        index = np.array(subset)
        own = np.linalg.lstsq(gram[np.ix_(index, index)], right[index], rcond=1e-12)[0]
        left = max(square - float(right[index] @ own), 0.0)
        if left < best[0]:
            best = (left, tuple(int(k) for k in alive[index]))
    return best
