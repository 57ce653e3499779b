"""Gravity of an arm from postures at rest: what compensates it, how surely, and the friction that hides it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from harness.algebra import column_norms
from harness.errors import FitError
from harness.models.analysis import Findings, Takes
from harness.options import check_options
from harness.signals import Dataset, FloatArray, Trajectory
from identifiers.common.records import real_signals, usable
from identifiers.mechanics.arms.inertial import speaks

if TYPE_CHECKING:
    from harness.physics.arms.arm import ArmModel

TOLD = 1e-8  # Information of a direction, of the largest one's, below which no posture of the records tells it.
MOVED = 5.0
"""Standard deviations of a reading at rest by which a joint must have come from elsewhere: less is its noise."""
FEWEST = 5  # Samples of a rest at least: a slope of fewer is noise.


@dataclass(frozen=True, eq=False)
class _Rest:
    """A posture at rest: where (n,), the mean torques (n,), and from which side every joint came (n,), -1, 0 or 1."""

    q: FloatArray
    torque: FloatArray
    came: FloatArray


@dataclass(frozen=True)
class GravityAtRest:
    """Gravity of an arm from the torques that hold it at rest, and the static friction beside it.

    At rest the torques are linear in masses and first moments. Dry friction holds too, up to its level, against the
    side from which a joint came: where postures are approached from both sides its level is found beside. Errors are
    those of postures that were left out, one after the other (Allen 1974, *Technometrics* 16:125).

    Parameters
    ----------
    model : str
        A named arm, or a URDF or MJCF file.
    still : float
        Speed of every joint below which it rests [rad/s or m/s].
    dwell : float
        How long it must rest for a posture to count [s].
    friction : bool
        Fit the level of the static friction of every joint beside.

    Raises
    ------
    InputError
        If an option is wrong, or the file cannot be read.
    FitError
        If the records are not those of the arm, or hold too few postures.
    """

    takes: ClassVar[Takes] = "data"
    model: str = "iiwa"
    still: float = 0.01
    dwell: float = 0.2
    friction: bool = True

    def channels(self) -> tuple[list[str], list[str]]:
        """Return the columns that it needs of a bare table, and those that it takes where they are there."""
        return [channel.name for channel in self._arm().positions], []

    def inputs(self) -> list[str]:
        """Return the torques."""
        return [channel.name for channel in self._arm().inputs]

    def of(self, subject: Dataset, *, rng: np.random.Generator) -> Findings:
        """Return what gravity asks of every joint, and how well it is known."""
        del rng
        arm = self._arm()
        records, spec = usable([run.trajectory for run in subject.runs], samples=FEWEST, what="gravity at rest")
        real_signals(spec, "gravity at rest")
        speaks(arm, spec, "gravity at rest")
        rests = [rest for record in records for rest in self._rests(arm, record)]
        zero = np.zeros((len(rests), arm.n))
        if not rests:
            raise FitError(
                "gravity at rest",
                expected=f"postures at rest for {self.dwell:g} s (all joints below {self.still:g} rad/s)",
                got="none",
                remedy="record postures that are held, or change still and dwell",
            )
        q, torque, came = (np.stack(part) for part in zip(*((r.q, r.torque, r.came) for r in rests), strict=True))
        bodies = arm.arm.regressor(q, zero, zero).reshape(len(rests), arm.n, -1)
        stated = arm.torques(q, zero, zero)
        columns = [bodies, *([came[:, :, None] * np.eye(arm.n)] if self.friction else [])]
        rows = np.concatenate(columns, axis=2)
        target = torque - stated
        size = column_norms(rows.reshape(-1, rows.shape[2]))
        rows = rows / size
        weights = 1.0 / np.maximum(np.std(target, axis=0), 1e-12)
        for _ in range(2):  # the second time joints weigh by what the first left
            found, basis, left, apart = _fitted(rows, target, weights)
            weights = 1.0 / np.maximum(np.sqrt(np.mean(left**2, axis=0)), 1e-12)
        if 2 * basis.shape[1] > target.size:
            raise FitError(
                "gravity at rest",
                expected=f"twice as many torques as directions of gravity and friction ({basis.shape[1]})",
                got=f"{len(rests)} postures of {arm.n} joints",
                remedy="hold the arm in more postures" + (", or leave friction out" if self.friction else ""),
            )
        values = found / size
        spread = np.sqrt(np.sum(basis**2, axis=1)) / size
        count = bodies.shape[2]
        holds = stated + bodies @ values[:count]
        sides = [bool((came[:, k] > 0).any() and (came[:, k] < 0).any()) for k in range(arm.n)]
        table = [
            {
                "joint": channel.name,
                "gravity, rms": _rms(holds[:, k]),
                "the file errs, rms": _rms(target[:, k]),
                "left, rms": _rms(apart[:, k]),
                **({"static friction": float(values[count + k]) if sides[k] else None,
                    "+- (95 %)": float(1.96 * spread[count + k]) if sides[k] else None} if self.friction else {}),
                "unit": arm.inputs[k].unit,
            }
            for k, channel in enumerate(arm.positions)
        ]  # fmt: skip
        blind = [channel.name for channel, both in zip(arm.positions, sides, strict=True) if not both]
        words = [
            f"{len(rests)} postures tell {basis.shape[1]} directions of gravity"
            + (" and static friction" if self.friction else ""),
            "left: of each posture by a fit to the others",
            f"{', '.join(blind)} never came to rest from both sides: static friction there is taken for gravity"
            if self.friction and blind else "",
        ]  # fmt: skip
        details = {
            "postures": q,
            "torques": torque,
            "compensation": holds,
            "inertial": arm.arm.parameters + values[:count],
            "deviations": spread[:count],
        }
        return Findings(
            f"gravity of {arm.name}", table, [text for text in words if text], details,
            lambda: _drawn(arm, torque - (came * values[count:] if self.friction else 0.0), holds, stated),
        )  # fmt: skip

    def _arm(self) -> ArmModel:
        from harness.physics.arms.arm import load_arm

        check_options(self, "gravity-at-rest", still="> 0", dwell="> 0")
        return load_arm(self.model)

    def _rests(self, arm: ArmModel, record: Trajectory) -> list[_Rest]:
        """Return the postures of a record, each the mean over the whole time that it is held."""
        names = [channel.name for channel in record.spec.outputs]
        q = record.y[:, [names.index(channel.name) for channel in arm.positions]]
        length = max(round(self.dwell / record.spec.sample_time), FEWEST)
        if len(q) < length:
            return []
        steps = np.arange(length) - 0.5 * (length - 1)
        slopes = np.stack([np.correlate(column, steps) for column in q.T], axis=1)
        slopes /= float(steps @ steps) * record.spec.sample_time
        held = np.zeros(len(q), dtype=bool)
        for first in np.nonzero((np.abs(slopes) < self.still).all(axis=1))[0]:
            held[first : first + length] = True
        edges = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]]).astype(int)))
        found: list[_Rest] = []
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            inner = slice(first + length // 4, last - length // 4)  # where it begins and ends the arm may still settle
            here = q[inner].mean(axis=0)
            gone = here - q[max(first - length, 0)]
            came = np.where(np.abs(gone) > MOVED * q[inner].std(axis=0), np.sign(gone), 0.0)
            found.append(_Rest(here, record.u[inner].mean(axis=0), came))
        return found


def _fitted(rows: FloatArray, target: FloatArray, weights: FloatArray) -> tuple[FloatArray, ...]:
    """Return parameters, a square root of their covariance, what is left, and what is left of each posture left out."""
    count, n, k = rows.shape
    phi = (rows * weights[:, None]).reshape(-1, k)
    goal = (target * weights).ravel()
    left, singular, right = np.linalg.svd(phi, full_matrices=False)
    told = singular > np.sqrt(TOLD) * singular[0]
    left, singular, right = left[:, told], singular[told], right[told]
    found = right.T @ ((left.T @ goal) / singular)
    rest = (goal - phi @ found).reshape(count, n)
    hats = left.reshape(count, n, -1)
    without = np.stack(
        [np.linalg.lstsq(np.eye(n) - h @ h.T, r, rcond=None)[0] for h, r in zip(hats, rest, strict=True)]
    )
    level = np.sqrt(np.sum(rest**2) / max(rest.size - len(singular), 1))
    return found, level * right.T / singular, rest / weights, without / weights


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _drawn(arm: ArmModel, torque: FloatArray, holds: FloatArray, stated: FloatArray) -> Any:
    """Return a figure: what the file and the fit say, against the torques that held, at every joint."""
    from matplotlib.figure import Figure

    columns = min(arm.n, 4)
    lines = -(-arm.n // columns)
    figure = Figure(figsize=(3.0 * columns, 0.6 + 2.9 * lines), layout="constrained")
    every = figure.subplots(lines, columns, squeeze=False).ravel()
    for k, axes in enumerate(every):
        if k >= arm.n:
            axes.axis("off")
            continue
        for said, mark, label in ((stated, ".", "file"), (holds, "+", "fitted")):
            axes.plot(torque[:, k], said[:, k], mark, label=label if k == 0 else None)
        ends = [float(torque[:, k].min()), float(torque[:, k].max())]
        axes.plot(ends, ends, color="#999999", lw=0.8, zorder=0)
        axes.set_title(f"{arm.positions[k].name} [{arm.inputs[k].unit}]", fontsize=9)
    figure.supxlabel("torque that held the arm, without static friction")
    figure.supylabel("gravity")
    figure.legend(loc="outside lower right", frameon=False)
    return figure
