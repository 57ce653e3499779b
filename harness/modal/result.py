"""What is known of the modes of a structure: a table, words for what the records do not determine, pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from harness.display import STYLE, page, table
from harness.errors import InputError
from harness.modal.pictures import shapes_and_coordinates, shapes_over_places, space_and_time, stabilisation_diagram
from harness.modal.poles import ComplexArray, Mode, Pole
from harness.modal.stabilisation import Criteria, Track
from harness.plots import inlined
from harness.signals import FloatArray, PlantSpec

LEVEL = 0.95
"""Probability of every interval."""
VAGUE = 0.05
"""Half width of the interval over the frequency from which a mode counts as not determined: neighbours overlap."""
STRONG = 0.01
"""Share of the motion from which a mode is listed although its damping cannot be told from 0: it is no noise."""
STANDING = 10.0
"""Phase [deg] within which a part of a shape counts as in step or in opposition, for words only."""

Reason = Literal["frequency", "damping", "growing", "double"]
REASONS: Mapping[Reason, str] = {
    "frequency": f"the frequency is known no better than within {100 * VAGUE:.0f} % (95 %)",
    "damping": f"the damping cannot be told from 0, and less than {100 * STRONG:.0f} % of the motion is in it: noise "
    "looks like it",
    "growing": "the motion grows: an unstable system, or a trend in the records",
    "double": "it cannot be told apart from a mode beside it that is known better",
}
"""Why something is not determined, in words."""


@dataclass(frozen=True, eq=False)
class Undetermined:
    """Something that looks like a mode in some fits, and why the data do not determine it.

    Parameters
    ----------
    band : (float, float)
        Where it was found [Hz].
    reason : {"frequency", "damping", "growing", "double"}
        What is not known; :data:`REASONS` says it in words.
    """

    band: tuple[float, float]
    reason: Reason


@dataclass(frozen=True, eq=False)
class Modes:
    """What :func:`harness.modal.identify_modes` returns.

    Parameters
    ----------
    name : str
        Of the data set.
    spec : PlantSpec
    method : str
        Id of the identifier, or ``ssi``.
    modes : tuple of Mode
        By frequency.
    undetermined : tuple of Undetermined
    notes : tuple of str
        What the data cannot tell, in sentences.
    criteria : Criteria
    ladder : mapping
        Poles by order, all of them.
    tracks : tuple of Track
        The poles sorted into modes.
    time : array (K,)
        [s], of the first record.
    coordinates : array (K, M)
        Complex coordinate of each mode: ``2 Re(shape q)`` is its part of the outputs.
    scaled : bool
        True where the outputs have several units: shapes are then over the standard deviation of each.
    """

    name: str
    spec: PlantSpec
    method: str
    modes: tuple[Mode, ...]
    undetermined: tuple[Undetermined, ...]
    notes: tuple[str, ...]
    criteria: Criteria
    ladder: Mapping[int, Sequence[Pole]]
    tracks: tuple[Track, ...]
    time: FloatArray
    coordinates: ComplexArray
    scaled: bool

    @property
    def frequencies(self) -> FloatArray:
        """Natural frequencies (M,) [Hz]."""
        return np.array([mode.frequency for mode in self.modes])

    @property
    def damping(self) -> FloatArray:
        """Damping ratios (M,); NaN where the data do not determine one."""
        return np.array([mode.damping if mode.damping_determined else np.nan for mode in self.modes])

    @property
    def shapes(self) -> ComplexArray:
        """Mode shapes (M, ny), each of length 1."""
        return np.array([mode.shape for mode in self.modes]).reshape(len(self.modes), self.spec.ny)

    def rows(self) -> list[dict[str, Any]]:
        """Return one row for each mode, for a table; what is not determined is said in words."""
        return [
            {
                "mode": number,
                "frequency [Hz]": f"{mode.frequency:.6g}",
                "95 % [Hz]": _interval(mode.frequency_interval, 1.0),
                "damping [%]": f"{100 * mode.damping:.3g}" if mode.damping_determined else "not determined",
                "95 % [%]": _interval(mode.damping_interval, 100.0)
                if mode.damping_determined
                else f"below {100 * mode.damping_interval[1]:.2g}",
                "share": f"{100 * mode.share:.2g} %",
                "orders": f"{mode.orders[0]}..{mode.orders[-1]} ({len(mode.orders)})",
                "shape": self.shape_text(mode),
            }
            for number, mode in enumerate(self.modes, start=1)
        ]

    def shape_text(self, mode: Mode) -> str:
        """Return a shape in words: size and phase of each output that sees the mode."""
        said = []
        for k, channel in enumerate(self.spec.outputs):
            size, turn = abs(mode.shape[k]), float(np.degrees(np.angle(mode.shape[k])))
            if not mode.seen[k]:
                said.append(f"{channel.name} not seen (below {mode.bound[k]:.2g})")
            elif abs(turn) < STANDING or abs(abs(turn) - 180.0) < STANDING:
                said.append(f"{channel.name} {'-' if abs(turn) > 90 else '+'}{size:.3f}")
            else:
                said.append(f"{channel.name} {size:.3f} at {turn:.0f} deg")
        return ", ".join(said)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description; numbers that the data do not determine are None."""
        return {
            "name": self.name,
            "method": self.method,
            "driven": bool(self.spec.nu),
            "level": LEVEL,
            "criteria": vars(self.criteria),
            "orders": list(self.ladder),
            "modes": [mode.to_dict(self._names) for mode in self.modes],
            "undetermined": [{"band": list(one.band), "reason": REASONS[one.reason]} for one in self.undetermined],
            "notes": list(self.notes),
            "poles": [
                {"order": pole.order, "frequency": pole.frequency, "damping": pole.damping, "stable": kept}
                for track in self.tracks
                for pole, kept in zip(track.poles, track.stable, strict=True)
            ],
        }

    def __repr__(self) -> str:
        told = ", ".join(f"{mode.frequency:.4g}" for mode in self.modes)
        return f"<Modes of {self.name}: {f'{told} Hz' if told else 'none determined'}>"

    def _repr_html_(self) -> str:
        rows = self.rows()
        shown = table(list(rows[0]), [tuple(row.values()) for row in rows]) if rows else "<p>no mode determined</p>"
        return shown + "".join(f"<p>{text}</p>" for text in self.words())

    def words(self) -> list[str]:
        """Return the frequencies that the data do not determine, with the reasons, in sentences."""
        said = []
        for reason, text in REASONS.items():
            near = [f"{sum(one.band) / 2:.3g}" for one in self.undetermined if one.reason == reason]
            if near:
                said.append(f"not determined near {', '.join(near)} Hz: {text}")
        return [*said, *self.notes]

    def html(self) -> str:
        """Return a page of the table and all pictures, which needs no other file."""
        figures = [
            (self.plot(), "stabilisation diagram"),
            (self.plot_shapes(), "modes in space and time"),
        ]
        if self.modes:
            figures.append((self.plot_motion(), "space-time pictures"))
        shown = page(f"Modes of {self.name}", self._repr_html_(), *(inlined(*figure) for figure in figures))
        head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><style>{STYLE}</style>'
        return f'<!DOCTYPE html><html lang="en"><head>{head}<title>Modes</title></head><body>{shown}</body></html>'

    def plot(self) -> Any:
        """Draw the stabilisation diagram; returns the matplotlib figure."""
        return stabilisation_diagram(self.modes, self.tracks, self.criteria, self.spec.sample_time)

    def plot_shapes(self) -> Any:
        """Draw the modes in space (shapes, with intervals) and in time (coordinates); returns the figure."""
        return shapes_and_coordinates(self.modes, self._names, self.time, self.coordinates)

    def plot_places(self, places: Mapping[str, Sequence[float]]) -> Any:
        """Draw the shapes over the plane in which the outputs stand (x: not seen); returns the figure.

        Parameters
        ----------
        places : mapping of str to (x, y)
            Of every output [m].

        Raises
        ------
        InputError
            If an output has no place, or all stand on one line.
        """
        lacking = [name for name in self._names if name not in places]
        if lacking:
            raise InputError(
                "places of the outputs",
                expected=f"one of each of {', '.join(self._names)}",
                got=f"none of {', '.join(lacking)}",
                remedy="give [x, y] in metres for every output",
            )
        return shapes_over_places(self.modes, np.array([places[name] for name in self._names], dtype=float))

    def plot_motion(self) -> Any:
        """Draw what each mode does at every output over some of its periods; returns the figure."""
        return space_and_time(self.modes, self._names, self.time, self.coordinates)

    @property
    def _names(self) -> tuple[str, ...]:
        return tuple(channel.name for channel in self.spec.outputs)


def _interval(ends: tuple[float, float], scale: float) -> str:
    """Return an interval in words."""
    if not np.isfinite(ends[0]):
        return "none"
    low, high = scale * ends[0], scale * ends[1]
    digits = max(2, int(np.ceil(np.log10(max(abs(low), abs(high), 1e-300) / max(high - low, 1e-300)))) + 2)
    return f"{low:.{digits}g} .. {high:.{digits}g}"
