"""Whether a force that is called periodic keeps its amplitude and phase along the records.

The latent force of the model has no line in its spectrum, so noise in a narrow band (at a resonance, of a wheel whose
speed drifts) looks periodic beside it. What repeats keeps amplitude and phase; noise in a band of B hertz loses both
within some 1/B seconds, and is likelier as a line that is drawn anew in every part of a record than as one that is
drawn once.
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
from harness.signals import FloatArray


def in_parts(whole: Direction, parts: int) -> list[Direction]:
    """Return a direction in parts of every record of both uses: each is 0 outside its own part.

    - ``parts``: of every record
    """
    pieces = []
    for use, records in whole.forces.items():
        for number, force in enumerate(records):
            edges = np.linspace(0, len(force), parts + 1).astype(int)
            for first, last in itertools.pairwise(edges):
                forces = {name: [np.zeros_like(record) for record in every] for name, every in whole.forces.items()}
                forces[use][number][first:last] = force[first:last]
                pieces.append(replace(whole, forces=forces))
    return pieces


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
    free = {"estimation": linear.nuisance["estimation"], "validation": _free_outside(linear)}
    bases = {use: _orthonormal(own) for use, own in free.items()}
    return max(_evidence(linear, bases, columns) for columns in cuts) - _evidence(linear, bases, whole)


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
