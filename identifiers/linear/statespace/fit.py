"""From records to a state-space model: pieces, dead times, order and noise, and the form that all models have."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.models.arx_orders import input_delays
from harness.models.spread import Matrices
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.linear_model import LinearModel
from identifiers.common.neighbours import spread_of
from identifiers.common.observers import innovation_form
from identifiers.linear.statespace.ladder import ORDERS, Rung, finished, ladder
from identifiers.linear.statespace.model import Piece, StateSpace
from identifiers.linear.statespace.noise import MOST
from identifiers.linear.statespace.search import Freedom, steps_of

LONGEST = 8192  # Samples of a piece of a record, at most: transforms of that length stay in a processor's cache.
NUMBERS = 4_000_000  # Numbers of a piece's slopes, at most.
CHECKED, RECORDS = 5_000, 30  # Samples, and records, that all orders, dead times and noises are tried on, at most.
SHORT = 5  # Models that are judged again where there are more.
FINE = 1e-2  # Gain of the log-likelihood in a step that ends the search before that.
SPARE = 3  # Readings for each free number, at least.

Delays = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class ScaledStateSpace:
    """A state-space model of scaled records."""

    model: LinearModel  # With its spread; the states of plant, dead times and noise
    plant: LinearModel  # The plant without dead times and noise: the same gains, and the poles that have a name
    residuals: list[FloatArray]  # list of array (N, ny)
    ladder: dict[str, float]  # What Schwarz's rule says of each order, relative to the best
    notes: dict[str, Any]


def state_space_of(
    records: Sequence[Trajectory],
    what: str,
    *,
    order: int | None,
    delay: int | None,
    offset: bool,
    radius: float,
    loop: bool,
    innovations: bool = True,
    most: int = ORDERS,
) -> ScaledStateSpace:
    """Return the state-space model of largest likelihood; order, dead times and noise by Schwarz's rule.

    Raises FitError if the records are too short.

    - ``records``: scaled; what stands where a reading is missing decides nothing
    - ``what``: name of the identifier, for messages
    - ``order, delay``: those that the data prefer where none is given
    - ``radius``: largest modulus of a pole
    - ``loop``: outputs foretell the inputs: what the loop holds may be unstable
    - ``innovations``: try noise that moves the states too: the model in innovation form
    - ``most``: largest order that is tried
    """
    spec = records[0].spec
    free = Freedom(spec.nu * spec.feedthrough, offset, radius)
    orders = [order] if order else list(range(1, _largest(records, most) + 1))
    candidates = [_shifts(spec.feedthrough, delay, spec.nu)] if delay is not None else _dead_times(records)
    head = max(max(one, default=0) for one in candidates)
    least = SPARE * _count(orders[0], spec)
    width = spec.ny * (orders[-1] * (spec.nu + 2 * spec.ny) + spec.ny * (spec.nu + 1 + MOST))
    length = int(np.clip(NUMBERS // max(width, 1), 4 * head + 64, LONGEST))

    every = functools.partial(_all_of, records, head, length)
    corrects = innovations and not any(one.missing is not None for one in records)
    found: list[_Choice] = []
    for delays in candidates:
        some = list(_pieces(_some(records), delays, head, length))
        plain = [one for one in found if not one.corrected]  # of the others some may be refused below
        if some and sum(piece.y.size for piece in some) >= least:
            found += _tried(some, delays, free, orders, corrects=corrects, loop=loop, rival=_least(plain))
    if not loop:
        found = _that_stay(found, max(map(len, records)))
    if not found:
        raise FitError(
            f"{what}: records too short for a state-space model",
            expected=f"more than {least} readings",
            got=str(sum(record.y.size for record in records)),
            remedy="record longer, or give a lower order",
        )
    found = sorted(found, key=lambda one: one.rung.judged)
    if sum(map(len, records)) > CHECKED:  # more samples tell more: the best are judged again, on all
        found = _judged_again(found[:SHORT], every, free)
    chosen = found[0]
    pieces = every(chosen)
    end = finished(chosen.rung, pieces, free).end
    moves = steps_of(end, pieces, free)
    others = [] if moves is None else [end.model.moved(move) for move in moves]
    model, plant = _linear(end.model, others, records[0], chosen)
    lags = int(end.model.noise.shape[1])
    notes = {
        "order": chosen.order,
        "delays": [one + int(not spec.feedthrough) for one in chosen.delays],
        "noise": "innovations" if chosen.corrected else "autoregression" if lags else "white",
        "noise_order": lags,
        "residual_rms": end.rms.tolist(),
        "converged": end.arrived,
    }
    return ScaledStateSpace(model, plant, [one.innovations for one in end.errors], {} if order else _told(found), notes)


def _told(found: Sequence[_Choice]) -> dict[str, float]:
    """Return what Schwarz's rule says of the best model of each order, over the best of all."""
    best = found[0].rung.judged
    return {
        str(one.order): one.rung.judged - best for one in sorted(found, key=lambda one: (one.order, -one.rung.judged))
    }


@dataclass(frozen=True, eq=False)
class _Choice:
    """A model of some order and dead times, of an output's noise by itself or corrected by the innovations."""

    delays: Delays
    corrected: bool
    order: int
    rung: Rung

    @property
    def plant(self) -> StateSpace:
        """Without what corrects it."""
        return _uncorrected(self.rung.end.model)[0] if self.corrected else self.rung.end.model


def _least(found: Sequence[_Choice]) -> float:
    """Return what Schwarz's rule says of the best of some models."""
    return min((one.rung.judged for one in found), default=np.inf)


def _that_stay(found: Sequence[_Choice], samples: int) -> list[_Choice]:
    """Return the models that do not grow by themselves: what a loop holds may, what was seen without one did not."""
    return [one for one in found if not one.corrected or one.plant.radius <= 1.0 + 1.0 / samples]


def _all_of(records: Sequence[Trajectory], head: int, length: int, one: _Choice) -> list[Piece]:
    """Return the pieces of records as a model looks at them."""
    whole = list(_pieces(records, one.delays, head, length))
    return list(map(_with_outputs, whole)) if one.corrected else whole


def _judged_again(found: Sequence[_Choice], every: Callable[[_Choice], list[Piece]], free: Freedom) -> list[_Choice]:
    """Return models as all samples judge them, the best first."""
    again: list[_Choice] = []
    for one in found:
        again.append(replace(one, rung=finished(one.rung, every(one), free, gain=FINE, rival=_least(again))))
    return sorted(again, key=lambda one: one.rung.judged)


def _tried(
    pieces: list[Piece],
    delays: Delays,
    free: Freedom,
    orders: Sequence[int],
    *,
    corrects: bool,
    loop: bool,
    rival: float,
) -> list[_Choice]:
    """Return the models of all orders behind some dead times; those in innovation form where noise is coloured."""
    rungs = ladder(pieces, free, orders, rival=rival)
    found = [_Choice(delays, False, n, rung) for n, rung in rungs.items()]
    if not corrects or (rungs and not loop and _white(rungs)):
        return found
    rival = min(rival, _least(found))
    rungs = ladder(list(map(_with_outputs, pieces)), free, orders, noise=0, seen=pieces, rival=rival)
    return [*found, *(_Choice(delays, True, n, rung) for n, rung in rungs.items())]


def _with_outputs(piece: Piece) -> Piece:
    """Return the piece with its outputs as further inputs: ``x+ = (A - K C) x + (B - K D) u + K y``."""
    return Piece(np.hstack([piece.u, piece.y]), piece.y)


def _uncorrected(own: StateSpace) -> tuple[StateSpace, FloatArray]:
    """Return the plant of a predictor whose last inputs are the outputs, and K (n, ny)."""
    nu = own.b.shape[1] - len(own.c)
    k, d = own.b[:, nu:], own.d[:, :nu]
    return replace(own, a=own.a + k @ own.c, b=own.b[:, :nu] + k @ d, d=d), k


def _white(rungs: Mapping[int, Rung]) -> bool:
    """Return True where the best of some models leaves white noise: nothing that moved the states shows."""
    return not min(rungs.values(), key=lambda one: one.judged).end.model.noise.shape[1]


def _count(order: int, spec: PlantSpec) -> int:
    """Return the free numbers of a model, its start among them."""
    return order * (spec.nu + spec.ny + 1) + spec.ny


def _largest(records: Sequence[Trajectory], most: int) -> int:
    """Return the largest order that so many readings bear."""
    spec = records[0].spec
    each, readings = spec.nu + spec.ny + len(records), sum(record.y.size for record in records)
    return int(np.clip((readings // SPARE - spec.ny) // max(each, 1), 1, most))


def _shifts(direct: bool, delay: int, nu: int) -> Delays:
    """Return how many samples every input is moved: without a direct term one is the model's own."""
    return (max(delay - int(not direct), 0),) * nu


def _dead_times(records: Sequence[Trajectory]) -> list[Delays]:
    """Return the shifts of the inputs that are compared: none, and the least that a long regression tells."""
    spec = records[0].spec
    none = (0,) * spec.nu
    try:
        each = [input_delays(records, output) for output in range(spec.ny)]
    except FitError:  # too short to tell
        return [none]
    own = int(not spec.feedthrough)
    least = tuple(min(row[j].samples for row in each) - own for j in range(spec.nu))
    least = tuple(max(one, 0) for one in least)
    shortest = min(map(len, records))
    return [none, least] if any(least) and 4 * max(least) < shortest else [none]


def _some(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Return so many records at most, spread over all of them, up to so many samples in all."""
    some, left = [], CHECKED
    for number in np.unique(np.linspace(0, len(records) - 1, min(len(records), RECORDS)).astype(int)):
        if left > 0:
            some.append(records[number][:left])
            left -= len(some[-1])
    return some


def _pieces(records: Sequence[Trajectory], delays: Delays, head: int, length: int) -> Iterator[Piece]:
    """Yield pieces of records with inputs moved by their dead times; before the record they are not known."""
    for record in records:
        n = len(record) - head
        if n < 2:
            continue
        u = np.column_stack([record.u[head - late : len(record) - late, j] for j, late in enumerate(delays)])
        cuts = np.linspace(0, n, -(-n // length) + 1).astype(int)
        for low, high in pairwise(cuts):
            rows = slice(head + low, head + high)
            read = None
            if record.missing is not None and record.missing[rows].any():
                read = ~record.missing[rows]
            yield Piece(u[low:high], record.y[rows], read)


def _linear(
    own: StateSpace, others: Sequence[StateSpace], record: Trajectory, chosen: _Choice
) -> tuple[LinearModel, LinearModel]:
    """Return the model in innovation form, and that of the plant alone, each with its spread."""
    spec, delays = record.spec, chosen.delays
    correction = np.zeros((own.order, spec.ny))
    if chosen.corrected:
        own, correction = _uncorrected(own)
        others = [_uncorrected(other)[0] for other in others]
    a, b, c, d, k = _whole(own, correction, delays)
    shift = np.zeros(len(a))
    shift[: own.order] = correction @ own.level
    model = innovation_form(spec, a, b, c, d, k, shift, own.level)
    none = np.zeros((own.order, spec.ny))
    plant = LinearModel(spec, own.a, own.b, own.c, own.d, none, shift[: own.order], own.level)
    if not others:
        return model, plant
    more = len(model.a_matrix) - len(a)  # states that hold the last innovation, which no input reaches
    near: list[Matrices] = []
    for other in others:
        aa, bb, cc, dd, _ = _whole(other, correction, delays)
        near.append((np.pad(aa, (0, more)), np.pad(bb, ((0, more), (0, 0))), np.pad(cc, ((0, 0), (0, more))), dd))
    return (
        replace(model, spread=spread_of(near)),
        replace(plant, spread=spread_of([(other.a, other.b, other.c, other.d) for other in others])),
    )


def _whole(
    own: StateSpace, correction: FloatArray, delays: Delays
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D, K with the states ``[plant, inputs on their way, noise of every output]``."""
    (n, nu), ny, lags = own.b.shape, len(own.c), own.noise.shape[1]
    total, first = n + sum(delays) + ny * lags, n + sum(delays)
    a, b, k = np.zeros((total, total)), np.zeros((total, nu)), np.zeros((total, ny))
    c, d = np.zeros((ny, total)), np.zeros((ny, nu))
    a[:n, :n], c[:, :n], k[:n] = own.a, own.c, correction
    place = n
    for j, late in enumerate(delays):
        if not late:
            b[:n, j], d[:, j] = own.b[:, j], own.d[:, j]
            continue
        b[place, j] = 1.0
        a[place + 1 : place + late, place : place + late - 1] = np.eye(late - 1)
        a[:n, place + late - 1], c[:, place + late - 1] = own.b[:, j], own.d[:, j]
        place += late
    for i in range(ny if lags else 0):
        low = first + i * lags
        c[i, low : low + lags] = a[low, low : low + lags] = -own.noise[i]
        a[low + 1 : low + lags, low : low + lags - 1] = np.eye(lags - 1)
        k[low, i] = 1.0
    return a, b, c, d, k
