"""Whether a force that is called periodic keeps its amplitude and phase along the records, and owes nothing to inputs.

The latent force of the model has no line in its spectrum, so noise in a narrow band (at a resonance, of a wheel whose
speed drifts) looks periodic beside it. What repeats keeps amplitude and phase; noise in a band of B hertz loses both
within some 1/B seconds, and is likelier as a line that is drawn anew in every part of a record than as one that is
drawn once.

What a model lacks of the plant's answer to an input stands out where the input does: at a line of a multisine, say. It
looks periodic too, but it goes with the input in every record, so that two numbers tell it where a line that the input
has nothing to do with needs two for each record.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.directions.directions import Direction
from harness.diagnosis.search.fit import Column, Linearised
from harness.diagnosis.search.leftover import largest_evidence
from harness.diagnosis.search.scores import SINGULAR
from harness.signals import FloatArray, Trajectory


def in_parts(whole: Direction, parts: int) -> list[Direction]:
    """Return a direction in parts of every record of both uses: each is 0 outside its own part.

    - ``parts``: of every record
    """
    pieces = []
    for use, records in whole.forces.items():
        for number, force in enumerate(records):
            edges = np.linspace(0, len(force), parts + 1).astype(int)
            for first, last in itertools.pairwise(edges):
                forces, readings = (_only(side, use, number, first, last) for side in (whole.forces, whole.readings))
                pieces.append(replace(whole, forces=forces, readings=readings))
    return pieces


def _only(
    sides: Mapping[str, Sequence[FloatArray]], use: str, number: int, first: int, last: int
) -> dict[str, list[FloatArray]]:
    """Return a side of a direction that is 0 outside some rows of one record."""
    kept = {name: [np.zeros_like(record) for record in every] for name, every in sides.items()}
    if use in kept:
        kept[use][number][first:last] = sides[use][number][first:last]
    return kept


def of_inputs(whole: Direction, records: Mapping[str, Sequence[Trajectory]], omega: float) -> list[Direction]:
    """Return for each input its line at a frequency, and that a quarter of a period later, where a line acts.

    - ``omega`` [rad/s]
    """
    found = []
    for column in range(len(next(iter(records.values()))[0].spec.inputs)):
        parts = {use: [_about(record, column, omega) for record in every] for use, every in records.items()}
        found.append(replace(whole, forces=_moved(whole.forces, parts), readings=_moved(whole.readings, parts)))
    return found


def _about(record: Trajectory, column: int, omega: float) -> FloatArray:
    """Return the line of an input at a frequency and its quadrature (K, 2)."""
    u, turning, window = record.u[:, column], np.exp(1j * omega * record.t), np.hanning(len(record))
    line = np.sum(window * (u - u.mean()) * turning.conj()) / np.sum(window) * turning
    return np.stack([line.real, line.imag], axis=1)


def _moved(
    lines: Mapping[str, Sequence[FloatArray]], parts: Mapping[str, Sequence[FloatArray]]
) -> dict[str, list[FloatArray]]:
    """Return parts (K, 2) by use and record instead of sine and cosine, wherever a line (K, width, 2) acts."""
    return {
        use: [
            np.any(line != 0, axis=(0, 2))[None, :, None] * part[:, None, :]
            for line, part in zip(every, parts[use], strict=True)
        ]
        for use, every in lines.items()
    }


def without(
    linear: Linearised, names: Collection[str], line: Column, size: float, phases: Mapping[str, float]
) -> Linearised:
    """Return a fit as it would be without its line, whose amplitude, frequency and phase are free no more.

    - ``linear``: of the fit that has the line
    - ``names``: parameters of the line
    - ``line``: sine and cosine of the line along both uses
    - ``size``: amplitude of the line
    - ``phases``: by use
    """
    keep = np.array([name not in names for name in linear.names], dtype=bool)
    residual, nuisance = {}, {}
    for use, phase in phases.items():
        share = size * np.array([np.cos(phase), np.sin(phase)])  # sin(a + phi) = cos(phi) sin(a) + sin(phi) cos(a)
        residual[use] = linear.residual[use] - getattr(line, use) @ share
        every = linear.nuisance[use]
        nuisance[use] = np.concatenate([every[:, : linear.shared][:, keep], every[:, linear.shared :]], axis=1)
    left = tuple(name for name in linear.names if name not in names)
    return replace(linear, residual=residual, nuisance=nuisance, names=left, spread=linear.spread[keep])


def incoherence(linear: Linearised, whole: Sequence[Column], cuts: Sequence[Sequence[Column]]) -> float:
    """Return the logarithm of the evidence for a line drawn anew in every part, against one drawn once a record.

    The two amplitudes of every part are normal with a variance that is chosen by the evidence; both uses together.

    - ``linear``: of :func:`without`
    - ``whole``: of :func:`in_parts`, in one part each
    - ``cuts``: the same, in more: the likeliest counts
    """
    bases = _bases(linear)
    return max((_evidence(linear, bases, columns) for columns in cuts), default=-np.inf) - _evidence(
        linear, bases, whole
    )


def answering(linear: Linearised, whole: Sequence[Column], inputs: Sequence[Sequence[Column]]) -> float:
    """Return the logarithm of the evidence for a part of the answer to an input, against a line drawn once a record.

    - ``inputs``: of :func:`of_inputs`, a list for each input; the likeliest counts
    """
    bases = _bases(linear)
    return max((_shared(linear, bases, columns) for columns in inputs), default=-np.inf) - _evidence(
        linear, bases, whole
    )


def _bases(linear: Linearised) -> dict[str, FloatArray]:
    """Return an orthonormal basis of what else is free, by use."""
    free = {"estimation": linear.nuisance["estimation"], "validation": _free_outside(linear)}
    return {use: _orthonormal(own) for use, own in free.items()}


def _shared(linear: Linearised, bases: Mapping[str, FloatArray], columns: Sequence[Column]) -> float:
    """Return the logarithm of the evidence of columns with the same coefficients in both uses."""
    made = {use: np.concatenate([getattr(column, use) for column in columns], axis=1) for use in bases}
    size = np.sqrt(sum(np.sum(every**2, axis=0) for every in made.values()))
    free = [made[use] - basis @ (basis.T @ made[use]) for use, basis in bases.items()]
    stacked = np.concatenate(free)[:, size > 0] / size[size > 0]
    u, s, _ = np.linalg.svd(stacked, full_matrices=False)
    keep = s > SINGULAR
    return largest_evidence(u[:, keep].T @ np.concatenate([linear.residual[use] for use in bases]), s[keep])[0]


def _evidence(linear: Linearised, bases: Mapping[str, FloatArray], columns: Sequence[Column]) -> float:
    """Return the logarithm of the evidence of columns against none, what else is free projected out."""
    total = 0.0
    for use, basis in bases.items():
        made = np.concatenate([getattr(column, use) for column in columns], axis=1)
        made = made[:, np.linalg.norm(made, axis=0) > 0]
        unit = made / np.linalg.norm(made, axis=0)
        u, s, _ = np.linalg.svd(unit - basis @ (basis.T @ unit), full_matrices=False)
        keep = s > SINGULAR
        total += largest_evidence(u[:, keep].T @ linear.residual[use], s[keep])[0]
    return total


def _free_outside(linear: Linearised) -> FloatArray:
    """Return what is free on the validation records: initial states, and parameters within their spread."""
    nuisance = linear.nuisance["validation"]
    return np.concatenate([nuisance[:, linear.shared :], nuisance[:, : linear.shared] @ linear.spread], axis=1)


def _orthonormal(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of columns (n, p)."""
    size = np.linalg.norm(columns, axis=0)
    basis, _ = np.linalg.qr(columns[:, size > 0] / size[size > 0])
    return np.asarray(basis)
