"""Learning of a residual force: by free runs of the system with the force in it, judged on the validation records."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.errors import FitError, InputError, refuse_unknown
from harness.physics.compiled.windows import data_states
from harness.physics.fitting.output_error import fit_output_error, simulate_error
from harness.physics.fitting.residual_force import Hull, ResidualForce, argument_columns
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

SIZES = (6, 12, 24)
"""Numbers of basis functions that are tried: a smooth curve, one with corners, a surface. The validation records
choose. Curves (one argument) are not tried with more than 12: their basis functions would be closer than what data with
noise tell apart."""

_MOST_ON_A_LINE = 12

_WIDTH = 1.5
"""Width of a basis function in distances to its nearest neighbour: less leaves gaps, more makes weights large and of
opposite signs."""

_BLOCKS = 20
"""Stretches of the validation records whose gains are compared: long against the correlation of free-run errors."""

_RISK = 0.01
"""Chance that a force which helps nothing is called a help: of the t-test of the blocks, over all forces tried."""


@dataclass(frozen=True, eq=False)
class LearnedForce:
    """What came of learning: the force, and the errors without and with it."""

    force: ResidualForce
    system: System  # With the force built in; ``system.simulator(dt)`` and its values export like any other
    # (ny,): Rms of free runs on the validation records, in the units of the outputs
    before: FloatArray
    after: FloatArray
    outside: float  # Share of the validation samples outside the hull: of them nothing is claimed
    # Share of the mean squared validation error that the force takes away, outputs weighed by their error before, and
    # its standard error over stretches of the records
    gain: float
    gain_error: float
    tried: int = 1  # Forces among which this one was the best

    @property
    def helps(self) -> bool:
        """True if the validation error fell by more than the best of so many tries would by chance."""
        from scipy.stats import t

        return bool(self.gain > t.isf(_RISK / max(self.tried, 1), _BLOCKS - 1) * self.gain_error)

    def __str__(self) -> str:
        pairs = ", ".join(f"{a:.4g} -> {b:.4g}" for a, b in zip(self.before, self.after, strict=True))
        return f"{self.force}; validation rms {pairs}; {100 * self.outside:.1f} % of validation outside the hull"


def learn_residual_force(
    system: System,
    values: Mapping[str, float],
    estimation: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    *,
    coordinate: str | None = None,
    arguments: Sequence[str] | None = None,
    horizon: float | None = None,
    intersample: Literal["zoh", "foh", "smooth"] = "zoh",
    sizes: Sequence[int] = SIZES,
    refit: bool = False,
    rng: np.random.Generator,
    progress: Callable[[float, str], None] | None = None,
) -> LearnedForce:
    """Learn the force that a system lacks, by free runs of the system with the force in it.

    The named parameters stay what they are, unless ``refit`` lets them move too: an effect that they have already
    taken up in part (dry friction as viscous) is otherwise not the force's to find. Radial basis functions lie where
    the data lie (k-means); their weights are fitted by output error; their number, and coordinate and arguments unless
    given, are those with the least error on the validation records. For a loop that ends ``unexplained``: ``system``
    and ``values`` are those of its final model.

    Parameters
    ----------
    system : System
        With coordinates; its outputs are those of the records, in order.
    values : mapping
        Its parameters by name.
    estimation, validation : sequence of Trajectory
    coordinate : str, optional
        By default the one that helps most.
    arguments : sequence of str, optional
        States and inputs that the force depends on; by default the rate, the coordinate, or both, whichever helps most.
    horizon : float, optional
        Length of the windows of free runs [s]; whole records if None.
    intersample : {"zoh", "foh", "smooth"}
    sizes : sequence of int
        Numbers of basis functions that are tried.
    refit : bool
        Fit the named parameters beside the force.
    rng : numpy.random.Generator
        For the centres of the basis functions.
    progress : callable, optional
        Called as ``progress(fraction_done, what)`` before every fit.

    Returns
    -------
    LearnedForce
        Also where it helps nothing: see ``helps``.

    Raises
    ------
    InputError
        If the system has no coordinates, or a name is unknown.
    FitError
        If no fit succeeds.
    """
    if not system.coordinates or not validation:
        raise InputError(
            "residual force",
            expected="a system with coordinates, and validation records that choose its size",
            got=f"{len(system.coordinates)} coordinates, {len(validation)} validation records",
            remedy="give a mechanical model and a validation run",
        )
    names = [candidate.name for candidate in system.coordinates]
    refuse_unknown("coordinate of a residual force", [] if coordinate is None else [coordinate], names)
    known = {parameter.name: float(values.get(parameter.name, parameter.value)) for parameter in system.parameters}
    base = _at(system, known)
    how: dict[str, Any] = {"horizon": horizon, "intersample": intersample}
    missed = np.concatenate(simulate_error(base, known, validation, **how))
    drafts = _drafts(base, known, estimation, coordinate, arguments, sizes, rng)
    best: LearnedForce | None = None
    problems: list[str] = []
    for number, draft in enumerate(drafts):
        what = f"{draft.coordinate} by {', '.join(draft.arguments)}, {len(draft.centres)} basis functions"
        if progress is not None:
            progress(number / len(drafts), what)
        try:
            fit = fit_output_error(
                draft.attach(base), estimation, start=known, fixed=() if refit else list(known), **how
            )
            force = draft.with_weights(fit.parameters)
            whole = force.attach(_at(base, fit.parameters))
            left = np.concatenate(simulate_error(whole, {}, validation, **how))
        except FitError as error:
            problems.append(f"{what}: {error.what}")
            continue
        outside = float(np.mean(~draft.hull.contains(_arguments(base, known, validation, draft.arguments))))
        trial = LearnedForce(force, whole, _rms(missed), _rms(left), outside, *_gain(missed, left), len(drafts))
        if best is None or trial.gain > best.gain:
            best = trial
    if best is None:
        raise FitError(
            "residual force", expected="at least one fit", got="; ".join(problems), remedy="shorten the horizon"
        )
    return best


def _drafts(
    base: System,
    known: Mapping[str, float],
    estimation: Sequence[Trajectory],
    coordinate: str | None,
    arguments: Sequence[str] | None,
    sizes: Sequence[int],
    rng: np.random.Generator,
) -> list[ResidualForce]:
    """Return the forces that are tried, their basis functions placed where the data lie, their weights 0."""
    drafts = []
    for candidate in base.coordinates:
        if coordinate not in (None, candidate.name):
            continue
        place, speed = base.states[candidate.q].name, base.states[candidate.v].name
        choices = [tuple(arguments)] if arguments is not None else [(speed,), (place,), (place, speed)]
        for wanted in choices:
            shown = _arguments(base, known, estimation, wanted)
            hull = Hull.of(shown)
            for size in sorted({min(size, _MOST_ON_A_LINE) if len(wanted) == 1 else size for size in sizes}):
                centres, width = _basis(shown, min(size, len(shown) // 5), rng)
                drafts.append(
                    ResidualForce(
                        candidate.name,
                        candidate.force_unit,
                        wanted,
                        centres,
                        width,
                        np.zeros(len(centres)),
                        hull,
                        len(shown),
                    )
                )
    return drafts


def _at(system: System, values: Mapping[str, float]) -> System:
    """Return the system with its parameters at values by name."""
    names = [parameter.name for parameter in system.parameters]
    return system.with_parameters({name: replace(system.parameter(name), value=values[name]) for name in names})


def _arguments(
    system: System, values: Mapping[str, float], records: Sequence[Trajectory], arguments: Sequence[str]
) -> FloatArray:
    """Return the arguments (n, d) along records, states as smoothed measurements tell them."""
    p = system.vector(values)
    columns = argument_columns(system, arguments)
    parts = []
    for record in records:
        x, _ = data_states(system.simulator(record.spec.sample_time), record, p)
        parts.append(np.hstack([x, record.u])[:, columns])
    return np.concatenate(parts)


def _basis(rows: FloatArray, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return centres (M, d) where the rows lie, and the width (d,) of the basis functions."""
    from scipy.cluster.vq import kmeans2
    from scipy.spatial.distance import cdist

    size = np.where(rows.std(axis=0) > 0, rows.std(axis=0), 1.0)
    centres, label = kmeans2(rows / size, max(count, 1), minit="++", rng=rng, missing="warn")
    centres = np.asarray(centres)[np.unique(label)]
    apart = cdist(centres, centres) + np.where(np.eye(len(centres)) > 0, np.inf, 0.0)
    near = float(np.median(apart.min(axis=1))) if len(centres) > 1 else 1.0
    return centres * size, _WIDTH * near * size


def _rms(errors: FloatArray) -> FloatArray:
    """Return the rms (ny,) of errors (n, ny); infinite where a run diverges."""
    square = errors**2
    return np.asarray(np.where(np.isfinite(square).all(axis=0), np.sqrt(square.mean(axis=0)), np.inf))


def _gain(before: FloatArray, after: FloatArray) -> tuple[float, float]:
    """Return the share of the mean square (errors (n, ny)) that is taken away, and its standard error over blocks."""
    size = np.maximum(_rms(before), 1e-300)
    won = np.mean((before / size) ** 2 - (after / size) ** 2, axis=1)
    if not np.isfinite(won).all():
        return -np.inf, 0.0
    blocks = [block.mean() for block in np.array_split(won, min(_BLOCKS, len(won)))]
    return float(won.mean()), float(np.std(blocks, ddof=1) / np.sqrt(len(blocks))) if len(blocks) > 1 else np.inf
