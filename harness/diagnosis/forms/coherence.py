"""Whether a force that is called periodic keeps its amplitude and phase along the records.

The latent force of the model has no line in its spectrum, so noise in a narrow band (at a resonance, of a wheel whose
speed drifts) looks periodic beside it. What repeats keeps amplitude and phase; noise in a band of B hertz loses both
within some 1/B seconds.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.forms.directions import Direction
from harness.diagnosis.search.fit import Column, Linearised
from harness.diagnosis.search.leftover import largest_evidence
from harness.signals import FloatArray

__all__ = ["in_parts", "wandering"]

_SINGULAR = 1e-5
"""Singular values of unit columns below which nothing is divided by them."""


def in_parts(whole: Direction, parts: int) -> list[Direction]:
    """Return a direction in parts of every record of both uses: each is 0 outside its own part.

    Parameters
    ----------
    whole : Direction
    parts : int
        Of every record.
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


def wandering(linear: Linearised, columns: Sequence[Column]) -> float:
    """Return the logarithm of the evidence for a line that changes from part to part, against one that does not.

    The changes of its two amplitudes are normal with a variance that is chosen by the evidence; both uses together.

    Parameters
    ----------
    linear : Linearised
        Of the fit that has the line: its amplitude and phase are among what is free.
    columns : sequence of Column
        Of :func:`in_parts`.
    """
    total = 0.0
    for use, own in (("estimation", linear.nuisance["estimation"]), ("validation", _free_outside(linear, columns))):
        made = np.concatenate([getattr(column, use) for column in columns], axis=1)
        made = made[:, np.linalg.norm(made, axis=0) > 0]
        basis = _orthonormal(own)
        unit = made / np.linalg.norm(made, axis=0)
        u, s, _ = np.linalg.svd(unit - basis @ (basis.T @ unit), full_matrices=False)
        keep = s > _SINGULAR
        total += largest_evidence(u[:, keep].T @ linear.residual[use], s[keep])[0]
    return total


def _free_outside(linear: Linearised, columns: Sequence[Column]) -> FloatArray:
    """Return what is free on the validation records: initial states, parameters within their spread, and the line."""
    nuisance = linear.nuisance["validation"]
    line: FloatArray = np.sum([column.validation for column in columns], axis=0)
    return np.concatenate([nuisance[:, linear.shared :], nuisance[:, : linear.shared] @ linear.spread, line], axis=1)


def _orthonormal(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of columns (n, p)."""
    size = np.linalg.norm(columns, axis=0)
    basis, _ = np.linalg.qr(columns[:, size > 0] / size[size > 0])
    return np.asarray(basis)
