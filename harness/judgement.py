"""One judge of records for all identifiers: whether anything beside the controller moves the inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from harness.errors import FitError
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

__all__ = ["Feedback", "Law", "dependence_text", "feedback_of", "law_of", "refuse_law", "refuse_undetermined"]

# Samples that are looked at: at so many, what an excitation of 5 % of the input does to the outputs shows.
_ROWS = 10_000
# Samples before and after the window of a law that bear witness against it.
_REACH = 3
# Probability of calling a record of pure feedback excited, and of an open loop that is asked about laws at all.
_DOUBT = 1e-5
# A law that leaves less than this share of what an input's own past leaves is exact: nothing else moved the input. So
# is one of the same sample that leaves of the input itself but rounding, whatever the past foretells: then outputs and
# input of one sample are dependent columns of any model.
_EXACT, _ROUNDED = 1e-3, 1e-10
# Of an input: what its own past leaves when it follows from it, as a multisine or a free motion does.
_FORETOLD = 1e-6
# What a law leaves of its input at most: it explains half of it.
_HALF = 0.7
# A filter follows whatever is slow, an excitation too: its law has to leave less, twice a noise of a tenth.
_SLOW = 0.2
# An input's own past: so many times what outputs have to say, and at most so many samples.
_LONGER, _OWN = 4, 40
# Outputs beyond so many are seen through as many principal directions.
_MOST = 16
# Terms of a dependence that are named: those above this share of the largest.
_SHOWN = 1e-3
# What looks like a controller too: an output that holds the input itself.
_ANSWERS = "; if there is none, and an output answers within the sample, declare feedthrough = true"
# Inputs move nearly together if the others leave so little of one; its coefficient is chance if its standard deviation
# is half of what all inputs do, so that the interval holds nothing and twice as much. Samples of the outputs' past.
_NEARLY, _CHANCE, _SHORT = 0.1, 0.5, 4
# Probability, in a law without an integral or a filter, of one that is taken to have it.
_NEEDED = 0.05
# Estimates between two-stage least squares and limited-information maximum likelihood that are tried.
_TRIED = 21
# Windows of a motion that depend on others up to this share have that dimension in common.
_NOTHING = 1e-11
# Regressors and witnesses that depend on others up to these shares are left out.
_RANK, _THIN = 1e-6, 1e-8


@dataclass(frozen=True)
class Feedback:
    """How far past outputs foretell an input beyond its own past.

    Parameters
    ----------
    share : float
        Share of the input's unpredictable part that past outputs explain, of the input where it is most.
    probability : float
        Of a share at least so large in open loop.
    unforeseen : float
        What the input's own past leaves of it, relative to its standard deviation.
    """

    share: float
    probability: float
    unforeseen: float = 1.0

    @property
    def found(self) -> bool:
        """True if chance is no explanation (less than 1 in 1000) and the share is not negligible (1 %)."""
        return self.probability < 1e-3 and self.share > 0.01


@dataclass(frozen=True)
class Law:
    """A controller that explains an input.

    Parameters
    ----------
    column : int
        Of the input.
    text : str
        The law, as far as it is known: ``u = -0.5 v - 0.3 q``.
    departure : float
        What it leaves of the input, relative to the input's standard deviation.
    probability : float
        Of so much correlation of that departure with the other samples, were it only noise of the sensors.
    """

    column: int
    text: str
    departure: float
    probability: float


@dataclass(frozen=True)
class _Form:
    """Controllers of one form: an input, or its change, from the outputs of so many samples.

    Filtered ones also hold that input, or change, of the sample before: one real pole.
    """

    lags: int
    change: bool
    filtered: bool = False

    def coefficients(self, outputs: int) -> int:
        """Return how many numbers such a law has, its constant included."""
        return 1 + outputs * (self.lags + 1) + int(self.filtered)


# Proportional; with a derivative; with an integral; with both; and each behind a filter. A law of two free poles would
# follow a sine that moves the loop from outside as well, and is none of these.
_PLAIN = (_Form(0, False), _Form(1, False), _Form(1, True), _Form(2, True))
_FORMS = (*_PLAIN, *(replace(form, filtered=True) for form in _PLAIN))


def refuse_law(records: Sequence[Trajectory], what: str, least_excitation: float = 2.0) -> None:
    """Raise if an input is nothing but the answer of a controller to the measured outputs.

    For identifiers that learn what the inputs do. A model of known structure, whose parameters a motion under feedback
    can tell, need not ask.

    Parameters
    ----------
    records : sequence of Trajectory
    what : str
        Name of the identifier, for messages.
    least_excitation : float
        0 asks nothing.

    Raises
    ------
    FitError
        If :func:`law_of` finds a law, or inputs move together and the noise hides what each does.
    """
    if least_excitation > 0:
        _refuse_together(records, what)
    law = law_of(records) if least_excitation > 0 else None
    if law is None:
        return
    raise FitError(
        f"{what}: the data do not determine the model",
        expected="inputs that something beside the controller moves",
        got=f"{law.text} up to {law.departure:.1e} of full size, which noise of the sensors explains",
        remedy="add an excitation to what the controller commands" + ("" if records[0].spec.feedthrough else _ANSWERS),
    )


def refuse_undetermined(records: Sequence[Trajectory], what: str, least_excitation: float = 2.0) -> None:
    """Raise if inputs move together, or by a law alone: for identifiers with no decision on rank of their own.

    Parameters
    ----------
    records, what, least_excitation
        As of :func:`refuse_law`.

    Raises
    ------
    FitError
        If the inputs depend on one another but for a constant, or :func:`law_of` finds a law.
    """
    spec = records[0].spec
    if least_excitation > 0 and spec.nu > 1:
        u = np.concatenate([record.u for record in records])
        spread = u.std(axis=0)
        _, values, right = np.linalg.svd((u - u.mean(axis=0)) / np.where(spread > 0, spread, 1.0), full_matrices=False)
        if values[-1] <= _THIN * values[0]:
            size = np.where(spread > 0, spread, 1.0)
            law = dependence_text(right[-1] / size, size, [channel.name for channel in spec.inputs])
            raise FitError(
                f"{what}: the data do not determine the model",
                expected="inputs that do not move together",
                got=f"{law} but for a constant",
                remedy="excite every input by itself, or leave one out",
            )
    refuse_law(records, what, least_excitation)


def _refuse_together(records: Sequence[Trajectory], what: str) -> None:
    """Raise if inputs move so nearly together that, at the noise there is, what each does by itself is not known.

    The standard deviation of an input's coefficient, times the input's size, is ``s / sqrt(N (1 - R^2))`` with s the
    noise and R^2 the share of the input that the others explain (Belsley, Kuh & Welsch 1980, *Regression Diagnostics*,
    sec. 3.2). Where that is half of what all inputs do and R^2 is what makes it so, the coefficient is chance.
    """
    spec = records[0].spec
    if spec.nu < 2 or any(channel.kind == "category" for channel in (*spec.inputs, *spec.outputs)):
        return
    some = [record for record in _first(records) if len(record) > _SHORT]
    rows = sum(len(record) - _SHORT for record in some)
    if rows <= 2 * (_SHORT * spec.ny + spec.nu + 1):
        return
    u = np.concatenate([record.u[_SHORT - 1 : -1] for record in some])
    seen = np.concatenate(
        [np.hstack([record.y[_SHORT - j : len(record) - j] for j in range(1, _SHORT + 1)]) for record in some]
    )
    target = np.concatenate([record.y[_SHORT:] for record in some])
    u, seen, target = (part - part.mean(axis=0) for part in (u, seen, target))
    known = _unit(np.hstack([seen, u]))
    theta = np.linalg.lstsq(known, target, rcond=_THIN)[0]
    noise = (target - known @ theta).std(axis=0)
    effect = (known[:, -spec.nu :] @ theta[-spec.nu :]).std(axis=0)
    size = np.where(u.std(axis=0) > 0, u.std(axis=0), 1.0)
    for column in range(spec.nu):
        others = np.delete(u, column, axis=1) / np.delete(size, column)
        gains = np.linalg.lstsq(others, u[:, column] / size[column], rcond=_THIN)[0]
        left = float(np.std(u[:, column] / size[column] - others @ gains))
        if not 0.0 < left < _NEARLY or np.any(noise / (np.sqrt(rows) * left) < _CHANCE * effect):
            continue
        direction = np.insert(-gains, column, 1.0) / size
        law = dependence_text(direction, size, [channel.name for channel in spec.inputs])
        raise FitError(
            f"{what}: the data do not determine the model",
            expected="inputs that move apart by more than noise hides",
            got=f"{law} up to {left:.1e} of full size: what each does by itself is chance",
            remedy="excite every input by itself, or leave one out",
        )


def law_of(records: Sequence[Trajectory]) -> Law | None:
    """Return the law that an input follows with nothing beside it, None where something else moves every input.

    Asked only where outputs foretell an input beyond its own past (:func:`feedback_of`), or its own past foretells it
    wholly. A controller ``u = K x`` seen through sensors ``y = x + e`` leaves ``v = u - K y = -K e``: nothing that the
    plant ever felt. So v must be uncorrelated with the inputs of all samples, the present one too, and with the outputs
    of all samples that the law does not use, before and after. What truly moves the plant is not: the present input
    contains it, and later outputs answer it. The gains are found by the generalised method of moments with these
    samples as instruments, and Hansen's statistic (1982, Econometrica 50:1029, lemma 4.2) tests them all at once, for
    the proportional, derivative and integral controllers, each behind a filter of one pole too. The size of the noise
    decides nothing.

    An input that its own past foretells wholly is a sum of lines, or part of a motion from a start alone. Lines obey
    any law of as many coefficients as they have dimensions; a law of fewer that holds to rounding is a controller's.

    Parameters
    ----------
    records : sequence of Trajectory

    Returns
    -------
    Law or None

    Examples
    --------
    >>> spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    >>> u, y = np.zeros((500, 1)), np.zeros((500, 1))
    >>> for k in range(500):
    ...     u[k] = -0.5 * y[k]
    ...     y[k + 1 : k + 2] = 0.9 * y[k] + u[k] + rng.normal()
    >>> law_of([Trajectory(np.arange(500.0), u, y + 0.1 * rng.normal(size=y.shape), spec)]).text
    'u = -0.4964 y'
    """
    spec = records[0].spec
    if spec.nu == 0 or any(channel.kind == "category" for channel in (*spec.inputs, *spec.outputs)):
        return None
    some = _first(records)
    some = _seen_through_few(some)
    shares, chances, alone = _granger(some, 4)
    for column in range(spec.nu):
        if not np.ptp(np.concatenate([record.u[:, column] for record in some])) > 0:
            continue  # a constant is no answer
        found = _law_of_input(some, column, (shares[column], chances[column], alone[column]))
        if found is not None:
            return found
    return None


def _law_of_input(records: Sequence[Trajectory], column: int, told: tuple[float, float, float]) -> Law | None:
    """Return the law that one input follows; ``told`` is what outputs and its own past foretell of it."""
    (share, chance, alone), spec = told, records[0].spec
    sure = chance < _DOUBT and share > 0.01
    if not sure and alone > _FORETOLD:
        return None
    exact = _EXACT * alone
    for form in _FORMS:
        departure, probability, text = _tested(records, column, form)
        noise = probability > _DOUBT and departure < (_SLOW if form.filtered else _HALF)
        least = max(exact, _ROUNDED) if form == _PLAIN[0] else exact
        if (noise or departure < least) and (sure or form == _PLAIN[0]):
            return Law(column, text, departure, probability)
        if not sure and departure < _ROUNDED and form.coefficients(spec.ny) < _dimension(records):
            return Law(column, text, departure, probability)
    if not sure and (found := _weakly_told(records, column)) is not None:
        return found
    if sure and share > 1.0 - _EXACT**2 and _granger(_before(records), 4)[0][column] > 1.0 - _EXACT**2:
        left = float(alone * np.sqrt(max(1.0 - share, 0.0)))
        return Law(column, f"{spec.inputs[column].name} follows from the last 4 samples", left, 1.0)
    return None


def feedback_of(records: Sequence[Trajectory], lags: int = 4) -> Feedback:
    """Test whether outputs foretell the input beyond its own past: feedback (Granger 1969; Ljung 1999, sec. 13.4).

    The input's own past is as long as all samples of the outputs are many: a sum of sines follows from a past of twice
    their number, and outputs that only stand for an older past are no feedback.

    Parameters
    ----------
    records : sequence of Trajectory
    lags : int
        Samples of the outputs' past.

    Returns
    -------
    Feedback

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> rng = np.random.default_rng(0)
    >>> u, y = rng.normal(size=(500, 1)), np.zeros((500, 1))
    >>> for k in range(499):
    ...     y[k + 1] = 0.8 * y[k] + u[k] + 0.3 * rng.normal()
    >>> feedback_of([Trajectory(np.arange(500.0), u, y, spec)]).found
    False
    """
    if records[0].spec.nu == 0:
        return Feedback(0.0, 1.0)
    shares, chances, alone = _granger(records, lags)
    worst = int(np.argmax(shares))
    return Feedback(float(shares[worst]), min(1.0, float(chances[worst]) * shares.size), float(alone[worst]))


def dependence_text(direction: FloatArray, size: FloatArray, names: Sequence[str]) -> str:
    """Return ``u = -0.5 x - 0.1 v`` for coefficients of regressors whose sum stays zero.

    Parameters
    ----------
    direction : array (p,)
    size : array (p,)
        Sizes of the regressors: terms that move little are left out.
    names : sequence of str
        The last of those that count most stands on the left.

    Examples
    --------
    >>> dependence_text(np.array([0.5, 0.1, 1.0]), np.ones(3), ("x", "v", "u"))
    'u = -0.5 x - 0.1 v'
    """
    weight = np.abs(direction * size)
    counted = [j for j in range(direction.size) if weight[j] > _SHOWN * weight.max()]
    lead = max(j for j in counted if weight[j] >= 0.1 * weight.max())
    terms = sorted((j for j in counted if j != lead), key=lambda j: -weight[j])[:6]
    text = f"{names[lead]} ="
    for number, j in enumerate(terms):
        value = -direction[j] / direction[lead]
        sign = "-" if value < 0 else "+"
        text += (
            f" {sign} {abs(value):.4g} {names[j]}"
            if number
            else f" {'-' if value < 0 else ''}{abs(value):.4g} {names[j]}"
        )
    return text if terms else f"{text} 0"


def _granger(records: Sequence[Trajectory], lags: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return, of every input: share that outputs explain, its chance in open loop, and what the own past leaves."""
    from scipy.stats import f

    spec = records[0].spec
    nu, ny = spec.nu, spec.ny
    nothing = np.zeros(nu), np.ones(nu), np.ones(nu)
    rows = sum(map(len, records))
    past = min(lags + _LONGER * (lags + 1) * ny, _OWN)
    past = max(lags, min(past, (rows // 4 - (lags + 1) * ny) // max(nu, 1), min(map(len, records)) // 3))
    long = [record for record in records if len(record) > past + 1]
    rows = sum(len(record) - past for record in long)
    if rows <= 2 * (1 + past * nu + (lags + 1) * ny):
        return nothing
    own, others, target = [], [], []
    for record in long:
        stop = len(record)
        own.append(np.hstack([np.ones((stop - past, 1)), *(record.u[past - j : stop - j] for j in range(1, past + 1))]))
        # a controller acts on the output of the same sample, unless that depends on the input itself
        seen = [record.y[past - j : stop - j] for j in range(int(spec.feedthrough), lags + 1)]
        others.append(np.hstack(seen))
        target.append(record.u[past:])
    few, more, wanted = np.concatenate(own), np.concatenate(others), np.concatenate(target)
    # Norms of residuals are those of the triangle: it is small.
    triangle = np.asarray(np.linalg.qr(np.hstack([_unit(few), _unit(more), wanted]), mode="r"), dtype=np.float64)
    wanted, lost = triangle[:, -nu:], []
    for width in (few.shape[1], few.shape[1] + more.shape[1]):
        q, values, _ = np.linalg.svd(triangle[:, :width], full_matrices=False)
        q = q[:, values > 1e-10 * values[0]]
        lost.append((np.sum((wanted - q @ (q.T @ wanted)) ** 2, axis=0), q.shape[1]))
    (alone, fewer), (helped, many) = lost
    power = rows * np.concatenate([record.u for record in long]).var(axis=0)
    floor = _FORETOLD**2 * power  # an input that its own past foretells needs no feedback
    shares = np.where(alone > floor, 1.0 - helped / np.maximum(alone, 1e-300), 0.0)
    added, remaining = max(many - fewer, 1), max(rows - many, 1)
    ratio = (shares / added) / np.maximum((1.0 - shares) / remaining, 1e-300)
    return shares, f.sf(ratio, added, remaining), np.sqrt(alone / np.where(power > 0, power, 1.0))


def _tested(records: Sequence[Trajectory], column: int, form: _Form) -> tuple[float, float, str]:
    """Return what the best law of a form leaves of an input, Hansen's probability that it is noise, and the law."""
    from scipy.stats import chi2

    spec = records[0].spec
    lags, first = form.lags, int(spec.feedthrough)
    targets, laws, witnesses = [], [], []
    for record in records:
        k = np.arange(lags + _REACH + 1, len(record) - _REACH)
        if not k.size:
            continue
        one, u, y = np.ones((k.size, 1)), record.u, record.y
        own = np.diff(u[:, column], prepend=u[:1, column]) if form.change else u[:, column]
        targets.append(own[k])
        filtered = [own[k - 1, None]] if form.filtered else []
        laws.append(np.hstack([one, *(y[k - j] for j in range(first, lags + first + 1)), *filtered]))
        around = [u[k - j] for j in range(-_REACH, lags + _REACH + 1)]
        before = [y[k - j] for j in range(lags + first + 1, lags + _REACH + 1)]
        witnesses.append(np.hstack([one, *around, *before, *(y[k + j] for j in range(1, _REACH + 1))]))
    if not targets or sum(map(len, targets)) < 3 * witnesses[0].shape[1]:
        return 1.0, 0.0, ""
    target, law, lengths = np.concatenate(targets), np.concatenate(laws), [len(part) for part in targets]
    if not np.ptp(target) > 0:
        return 1.0, 0.0, ""  # a pulse before the rows that are tested: what rests is no answer
    size = float(np.concatenate([record.u[:, column] for record in records]).std())
    if _by_itself(target, law[:, [0, *range(1 + spec.ny * (lags + 1), law.shape[1])]]) < _ROUNDED * size:
        return 1.0, 0.0, ""  # a ramp, or one mode that dies away: no output has a part in it
    witness = _unit(np.concatenate(witnesses))
    gains, covariance, statistic, free = _moments(target, law, witness, lengths, lags)
    # Without an integral, or a filter, the law is that of the other forms, which bear sharper witness. The pole of a
    # filter lies between 0 and 1: a negative one is a controller that acts late, seen through the plant.
    if form.filtered and gains[-1] <= 0:
        return 1.0, 0.0, ""
    checks: list[FloatArray] = []
    if form.change:
        checks.append(np.hstack([np.zeros((spec.ny, 1)), np.tile(np.eye(spec.ny), lags + 1)]))
    if form.filtered:
        checks.append(np.eye(gains.size)[-1:])
    for part in checks:
        part = np.pad(part, ((0, 0), (0, gains.size - part.shape[1])))
        total, among = part @ gains, part @ covariance @ part.T
        if chi2.sf(float(total @ np.linalg.lstsq(among, total, rcond=1e-9)[0]), len(part)) > _NEEDED:
            return 1.0, 0.0, ""
    departure = float(np.std(target - law @ gains)) / (size if size > 0 else 1.0)
    text = _text(spec, column, form, -gains[1:], law.std(axis=0)[1:], float(target.std()))
    return departure, float(chi2.sf(statistic, free)), text


def _by_itself(target: FloatArray, own: FloatArray) -> float:
    """Return what a constant and the sample before leave of an input, or of its change."""
    scaled = _unit(own)
    return float(np.std(target - scaled @ np.linalg.lstsq(scaled, target, rcond=_THIN)[0]))


def _moments(
    target: FloatArray, law: FloatArray, witness: FloatArray, lengths: Sequence[int], lags: int
) -> tuple[FloatArray, FloatArray, float, int]:
    """Return gains, their covariance, Hansen's statistic and its freedom, by two steps of the method of moments."""
    rows, length = target.size, np.linalg.norm(law, axis=0)
    left, values, _ = np.linalg.svd(witness, full_matrices=False)
    z, law = left[:, values > _THIN * values[0]] * np.sqrt(rows), _unit(law) * np.sqrt(rows)
    moments, slopes = z.T @ target / rows, z.T @ law / rows
    gains = np.linalg.lstsq(slopes, moments, rcond=_RANK)[0]
    weight, turned = np.linalg.eigh(_spread(z, target - law @ gains, lengths, lags))
    if not weight[-1] > 0:  # nothing is left at all
        return np.sqrt(rows) * gains / np.where(length > 0, length, 1.0), np.eye(length.size), 0.0, 1
    root = (turned / np.sqrt(np.maximum(weight, 1e-10 * weight[-1]))).T
    gains, _, rank, _ = np.linalg.lstsq(root @ slopes, root @ moments, rcond=_RANK)
    wrong = root @ (moments - slopes @ gains)
    unit = np.sqrt(rows) / np.where(length > 0, length, 1.0)
    inverse = np.linalg.pinv(root @ slopes, rcond=_RANK)
    covariance = inverse @ inverse.T / rows * np.outer(unit, unit)
    return unit * gains, covariance, float(rows * (wrong @ wrong)), max(z.shape[1] - int(rank), 1)


def _dimension(records: Sequence[Trajectory]) -> int:
    """Return how many dimensions windows of inputs and outputs span, a constant included."""
    rows = []
    for record in records:
        both, last = np.hstack([record.u, record.y]), len(record) - _SHORT
        if last > 0:
            rows.append(np.hstack([both[j : last + j] for j in range(_SHORT)]))
    if not rows:
        return 0
    together = np.concatenate(rows)
    values = np.linalg.svd(_unit(np.hstack([np.ones((len(together), 1)), together])), compute_uv=False)
    return int(np.sum(values > _NOTHING * values[0]))


def _weakly_told(records: Sequence[Trajectory], column: int) -> Law | None:
    """Return the proportional law that a motion from a start shows although hardly more than one mode of it is seen.

    Two-stage estimates then lie anywhere along what the data do not tell, and their test rejects them. The least of
    ``v' P v / v' v`` over all laws, P the projection on the witnesses, is chi-square whatever is told (Anderson & Rubin
    1949, Ann. Math. Stat. 20:46, sec. 5): limited-information maximum likelihood. Of the estimates between both (those
    of the k-class: Theil 1958, *Economic Forecasts and Policy*, sec. 6.2) the first that the test bears out counts.
    """
    from scipy.linalg import eigh
    from scipy.stats import chi2

    spec, first = records[0].spec, int(records[0].spec.feedthrough)
    sides, witnesses = [], []
    for record in records:
        k = np.arange(_REACH + 1, len(record) - _REACH)
        u, y = record.u, record.y
        sides.append(np.hstack([u[k, column, None], y[k - first]]))
        around = [u[k - j] for j in range(-_REACH, _REACH + 1)]
        before = [y[k - j] for j in range(first + 1, _REACH + 1)]
        witnesses.append(np.hstack([*around, *before, *(y[k + j] for j in range(1, _REACH + 1))]))
    if sum(map(len, sides)) < 3 * witnesses[0].shape[1]:
        return None
    side, witness = np.concatenate(sides), np.concatenate(witnesses)
    side, witness = side - side.mean(axis=0), _unit(witness - witness.mean(axis=0))
    size = np.where(side.std(axis=0) > 0, side.std(axis=0), 1.0)
    left, values, _ = np.linalg.svd(witness, full_matrices=False)
    z = left[:, values > _THIN * values[0]]
    seen = z.T @ (side / size)
    rows, whole = len(side), (side / size).T @ (side / size)
    if np.linalg.eigvalsh(whole)[0] <= _THIN * rows:
        return None  # a law to rounding is found without
    explained = seen.T @ seen
    least = float(eigh(explained, whole, eigvals_only=True)[0])
    free, law, probability = max(z.shape[1] - spec.ny, 1), np.zeros(0), 0.0
    for part in np.linspace(0.0, 1.0, _TRIED):  # from two stages to limited information: the first that is borne out
        inner = explained - part * least * whole
        law = np.append(1.0, -np.linalg.lstsq(inner[1:, 1:], inner[1:, 0], rcond=1e-12)[0])
        share = float(law @ explained @ law) / float(law @ whole @ law)
        probability = float(chi2.sf(rows * share, free))
        if probability > _DOUBT:
            break
    law = law * size[0] / size
    own = float(np.concatenate([record.u[:, column] for record in records]).std())
    departure = float(np.std(side @ law)) / (own if own > 0 else 1.0)
    if probability <= _DOUBT or departure > _HALF:
        return None
    text = _text(spec, column, _PLAIN[0], law[1:], size[1:], float(size[0]))
    return Law(column, text, departure, probability)


def _text(spec: PlantSpec, column: int, form: _Form, gains: FloatArray, spread: FloatArray, own: float) -> str:
    """Return a law in words, without its constant; ``gains`` are those of ``u + gains y = 0``."""
    name = spec.inputs[column].name
    lags = range(int(spec.feedthrough), form.lags + int(spec.feedthrough) + 1)
    seen = [c.name if j == 0 else f"{c.name}[k-{j}]" for j in lags for c in spec.outputs]
    lead = f"the change of {name}" if form.change else name
    if form.filtered:
        seen.append(f"{lead}[k-1]" if not form.change else f"{lead} before")
    if not np.any(np.abs(gains * spread) >= _SHOWN * own):
        return f"{lead} = 0"
    # the input stands on the left, however large one of the outputs' terms may be
    direction, size = np.append(gains, 1.0), np.append(spread, max(own, float(np.abs(gains * spread).max())))
    return dependence_text(direction, size, [*seen, lead])


def _spread(z: FloatArray, departure: FloatArray, lengths: Sequence[int], lags: int) -> FloatArray:
    """Return the covariance of ``sqrt(N) mean(z v)`` for a v that is independent of z and remembers so many lags.

    Autocovariances under Bartlett's window of twice the memory, which keep the sum positive (Newey & West 1987).
    """
    rows = departure.size
    total = np.mean(departure**2) * np.eye(z.shape[1])
    edges = np.concatenate([[0], np.cumsum(lengths)])
    for j in range(1, 2 * lags + 1):
        own, crossed = 0.0, np.zeros((z.shape[1],) * 2)
        for start, stop in pairwise(edges):
            if stop - start > j:
                own += float(departure[start + j : stop] @ departure[start : stop - j])
                crossed += z[start + j : stop].T @ z[start : stop - j]
        total += (1.0 - j / (2 * lags + 1)) * own / rows * (crossed + crossed.T) / rows
    return np.asarray(total, dtype=np.float64)


def _first(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Return the records up to so many samples in all."""
    some, left = [], _ROWS
    for record in records:
        if left > 0:
            some.append(record[:left])
            left -= len(record)
    return some


def _before(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Return records of which only outputs before an input count: outputs that answer at once hold the input itself."""
    return [replace(record, spec=replace(record.spec, feedthrough=True)) for record in records]


def _seen_through_few(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Return records whose many outputs are replaced by their leading directions, each output counted by its size."""
    spec = records[0].spec
    if spec.ny <= _MOST:
        return list(records)
    together = np.concatenate([record.y for record in records])
    middle, size = together.mean(axis=0), together.std(axis=0)
    weight = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    turn = np.linalg.eigh(np.cov(((together - middle) * weight).T))[1][:, -_MOST:]
    outputs = tuple(Channel(f"direction {j + 1}") for j in range(_MOST))
    few = PlantSpec(spec.inputs, outputs, spec.sample_time, (), spec.feedthrough)
    return [Trajectory(record.t, record.u, (record.y - middle) * weight @ turn, few) for record in records]


def _unit(columns: FloatArray) -> FloatArray:
    """Return columns of length 1 (those of zeros stay)."""
    size = np.linalg.norm(columns, axis=0)
    return np.asarray(columns / np.where(size > 0, size, 1.0), dtype=np.float64)
