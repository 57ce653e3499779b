"""Sums over records that Baum-Welch needs: compiled, or in numpy where there is no C compiler."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray
from identifiers.common.native import declared, pointers

Record = tuple[npt.NDArray[np.intc], npt.NDArray[np.intc]]
"""Observations (N,) and actions (N,) of a record; the last action leads nowhere."""


@dataclass(frozen=True, eq=False)
class Counts:
    """Expected counts under a model."""

    log_likelihood: float  # Of all records
    transition: FloatArray  # (S, A, S)
    emission: FloatArray  # (S, O)
    first: FloatArray  # (S,)


@functools.cache
def native_library() -> Any:
    """Return the compiled recursions, or None where there is no C compiler."""
    whole, address = ctypes.c_long, ctypes.c_void_p
    return declared(
        "hmm_loop",
        sysid_hmm_pass=(ctypes.c_double, [whole, whole, *[address] * 7, ctypes.c_int, *[address] * 4]),
        sysid_hmm_counts=(ctypes.c_double, [whole, address, whole, *[address] * 11]),
    )


def expected_counts(
    records: Sequence[Record], initial: FloatArray, transition: FloatArray, emission: FloatArray, *, native: bool = True
) -> Counts:
    """Return the expected counts of all records under a model (Rabiner 1989, *Proc. IEEE* 77, eq. 40 and 109).

    - ``records`` sequence of (observations, actions)
    - ``initial, transition, emission`` (S,), (S, A, S), (S, O)
    - ``native``: False computes in numpy even where the compiled recursions are there
    """
    states, actions, _ = transition.shape
    turned = np.ascontiguousarray(transition.transpose(1, 0, 2))
    spread = np.ascontiguousarray(emission.T)
    start = np.ascontiguousarray(initial)
    pairs, emitted, first = np.zeros((actions, states, states)), np.zeros(emission.T.shape), np.zeros(states)
    given, sums = (start, turned, spread), (pairs, emitted, first)
    if native and native_library() is not None:
        total = _native(records, *given, *sums)
    else:
        total = sum(_plain(*record, *given, *sums) for record in records)
    return Counts(total, (pairs * turned).transpose(1, 0, 2), emitted.T, first)


def filtered_beliefs(
    record: Record, initial: FloatArray, transition: FloatArray, emission: FloatArray
) -> tuple[FloatArray, float]:
    """Return the beliefs (N, S) after each observation, and the log likelihood."""
    seen, action = record
    turned, spread = np.ascontiguousarray(transition.transpose(1, 0, 2)), np.ascontiguousarray(emission.T)
    beliefs, scale = np.zeros((len(seen), len(initial))), np.zeros(len(seen))
    if (compiled := native_library()) is not None:
        start = np.ascontiguousarray(initial)
        total = compiled.sysid_hmm_pass(
            len(seen), len(initial), *pointers(seen, action, start, turned, spread, beliefs, scale), 0, *[None] * 4
        )
    else:
        total = _forward(seen, action, initial, turned, spread, beliefs, scale)
    return beliefs, float(total)


def _native(records: Sequence[Record], start: FloatArray, *tables: FloatArray) -> float:
    """Add the sums of all records, in C."""
    lengths = np.array([len(seen) for seen, _ in records], dtype=ctypes.c_long)
    seen, action = (np.concatenate(column) for column in zip(*records, strict=True))
    longest, states = int(lengths.max()), len(start)
    turned, spread, *sums = tables
    beliefs, scale, work = np.empty((longest, states)), np.empty(longest), np.empty(2 * states)
    given = pointers(seen, action, start, turned, spread, beliefs, scale, *sums, work)
    return float(native_library().sysid_hmm_counts(len(records), *pointers(lengths), states, *given))


def _forward(
    seen: Any, action: Any, start: FloatArray, turned: FloatArray, spread: FloatArray, beliefs: Any, scale: Any
) -> float:
    """Fill in the scaled forward variables; returns the log likelihood."""
    now = start
    for k in range(len(seen)):
        joint = (now if k == 0 else beliefs[k - 1] @ turned[action[k - 1]]) * spread[seen[k]]
        total = joint.sum()
        if not total > 0:
            return -np.inf
        scale[k] = 1.0 / total
        beliefs[k] = joint * scale[k]
    return float(-np.log(scale).sum())


def _plain(
    seen: Any,
    action: Any,
    start: FloatArray,
    turned: FloatArray,
    spread: FloatArray,
    pairs: FloatArray,
    emitted: FloatArray,
    first: FloatArray,
) -> float:
    """Add the sums of one record, in numpy."""
    beliefs, scale = np.zeros((len(seen), len(start))), np.zeros(len(seen))
    total = _forward(seen, action, start, turned, spread, beliefs, scale)
    if not np.isfinite(total):
        return total
    beta = np.ones(len(start))
    for k in range(len(seen) - 1, -1, -1):
        emitted[seen[k]] += beliefs[k] * beta
        if k == 0:
            first += beliefs[0] * beta
            break
        ahead = spread[seen[k]] * beta * scale[k]
        pairs[action[k - 1]] += np.outer(beliefs[k - 1], ahead)
        beta = turned[action[k - 1]] @ ahead
    return total
