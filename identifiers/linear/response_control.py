"""Control straight from an impulse response: feedback of the disturbance that the response leaves unexplained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from harness.errors import FitError, InputError
from harness.judgement import feedback_of
from harness.models.analysis import Findings, Takes, as_dataset
from harness.models.lqr import kalman_gain, lqr_gain, stabilisable
from harness.signals import FloatArray, Trajectory
from identifiers.common.judge.own_past import PAST, own_past, without_past
from identifiers.common.records import real_signals, usable
from identifiers.linear.bounds.responses import LagsKnown
from identifiers.linear.ho_kalman import HoKalman
from identifiers.linear.markov import markov_parameters, normal_equations

_TAIL = 0.05  # The response has died out where its last tenth holds less than this share of its size.
_SURE = 3.0  # Standard errors by which a Markov parameter is told from none.
_LUCK = 1e-3  # Probability of so large a gain of late Markov parameters, were it none, below which it is no chance.
_GROWS = 3.0  # Powers of e in a record by which that grows, from which on the plant is unstable: no walk does.
_FREQUENCIES = 128  # Points of the half circle on which gains are taken.


@dataclass(frozen=True, eq=False)
class UncertainResponse:
    """Markov parameters with what they may be wrong by.

    Parameters
    ----------
    markov : array (L, ny, nu)
        ``y[k] = sum_i markov[i] u[k-i]`` + what no input explains; ``markov[0]`` is 0.
    bound : float
        On the largest gain over all frequencies of what the estimate is wrong by, with the confidence asked for.
    natural : tuple of array (N, ny)
        Outputs of the records as they would have been without inputs ("nature's y").
    centre : array (ny,), array (nu,)
        Means of outputs and inputs, which are taken off.
    """

    markov: FloatArray
    bound: float
    natural: tuple[FloatArray, ...]
    centre: tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class ResponseController:
    """``u[k] = sum_j taps[j] n[k-j]`` with ``n[k] = y[k] - sum_i markov[i] u[k-i]``; taps (m, nu, ny)."""

    taps: FloatArray
    markov: FloatArray

    def closed(self, natural: FloatArray, plant: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return outputs (N, ny) and inputs (N, nu) on a plant of this response (L', ny, nu), from rest."""
        (m, nu, ny), n = self.taps.shape, len(natural)
        u, y, rest = np.zeros((n, nu)), np.zeros((n, ny)), np.zeros((n, ny))
        for k in range(n):
            y[k] = natural[k] + _convolved_at(plant, u, k)
            rest[k] = y[k] - _convolved_at(self.markov, u, k)
            for j in range(min(m, k + 1)):
                u[k] += self.taps[j] @ rest[k - j]
        return y, u

    @property
    def gain(self) -> float:
        """Largest gain over all frequencies from n to u."""
        return _largest_gain(self.taps)


@dataclass(frozen=True, eq=False)
class StateController:
    """``x+ = (A - B F - K C) x + K y, u = -F x``: the regulator of a realised model (LQG)."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    feedback: FloatArray
    filter: FloatArray

    def closed(self, natural: FloatArray, plant: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return outputs (N, ny) and inputs (N, nu) on a plant of this response (L', ny, nu), from rest."""
        n, x = len(natural), np.zeros(len(self.a))
        u, y = np.zeros((n, self.b.shape[1])), np.zeros_like(natural)
        for k in range(n):
            y[k] = natural[k] + _convolved_at(plant, u, k)
            # The filter's estimate of now, with y[k] in it, as the disturbance feedback has it too.
            u[k] = -self.feedback @ (x + self.filter @ (y[k] - self.c @ x))
            x = self.a @ (x + self.filter @ (y[k] - self.c @ x)) + self.b @ u[k]
        return y, u


def estimated_response(
    trajectories: Sequence[Trajectory], length: int, *, confidence: float = 0.95, what: str = "response-control"
) -> UncertainResponse:
    """Return the Markov parameters of records in open loop, and a bound on their error.

    The bound is that of :class:`identifiers.linear.bounds.responses.LagsKnown`, given these inputs. What lies beyond
    the length is added as if it fell on as the last tenth does. Raises FitError if past outputs predict the inputs,
    the inputs do not excite so many lags, outputs answer them within the same sample, or the response has not died out.

    - ``length``: L, long enough for the response to die out
    """
    records, spec = usable(trajectories, samples=length + 2, what=what)
    real_signals(spec, what)
    if spec.nu == 0 or length < 4:
        raise FitError(f"{what}: inputs", expected="inputs, and length >= 4", got=f"{spec.nu}, {length}", remedy="both")
    # By samples before this one: an output of this one that foretells the input may answer it.
    if feedback_of([replace(record, spec=replace(spec, feedthrough=True)) for record in records]).found:
        raise FitError(
            f"{what}: feedback",
            expected="inputs that do not depend on outputs",
            got="past outputs predict the inputs",
            remedy="record in open loop, or identify with n4sid, which allows for a loop, and design on its model",
        )
    y_mean = np.concatenate([record.y for record in records]).mean(axis=0)
    u_mean = np.concatenate([record.u for record in records]).mean(axis=0)
    markov = np.array(markov_parameters(records, length)[0])
    sums = normal_equations(records, length, offset=True)
    known = LagsKnown.of(sums, length, spec.nu)
    if known is None:
        raise FitError(
            f"{what}: inputs", expected=f"inputs that excite {length} lags", got="a smoother one",
            remedy="a richer input, or fewer Markov parameters",
        )  # fmt: skip
    direct = markov[0].copy()
    markov[0] = 0.0
    natural = tuple(_unexplained(markov, record.y - y_mean, record.u - u_mean)[length:] for record in records)
    density = max(known.density(part, len(records)) for part in natural)
    noise = np.mean(np.concatenate(natural) ** 2)
    spread = np.sqrt(noise * spec.ny * np.einsum("lala->l", known.inverse))  # of the norm of each Markov parameter
    size = max(float(np.linalg.norm(markov)), 1e-300)
    if (share := _lasting(records, natural, length)) > _TAIL:
        raise FitError(
            f"{what}: the response has not died out",
            expected=f"Markov parameters that end with less than {_TAIL:g} of its gain",
            got=f"{share:.2g} of it {length} samples after the input and later",
            remedy="raise length, or stabilise the plant first (a plant that does not forget has no such controller)",
        )
    if np.linalg.norm(direct) > max(_TAIL * size, _SURE * spread[0]):
        raise FitError(
            f"{what}: outputs answer the inputs within the same sample",
            expected="an input that moves the outputs of later samples only",
            got=f"{np.abs(direct).max():.2g} at once, of at most {np.abs(markov).max():.2g} later",
            remedy="if a row holds the input before its output, move the inputs on by a sample",
        )
    late = markov[-max(length // 10, 1) :]
    share = float(np.linalg.norm(late) / size / np.sqrt(len(late) / length))
    beyond = float(np.linalg.norm(late, axis=(1, 2)).sum()) if share > _TAIL else 0.0
    return UncertainResponse(markov, known.gain_bound(density, spec.ny, confidence) + beyond, natural, (y_mean, u_mean))


def _lasting(records: Sequence[Trajectory], natural: Sequence[FloatArray], length: int) -> float:
    """Return the gain of Markov parameters from about ``length`` on beside that of all, where it is no chance.

    What the past of nature's y tells of it is taken off outputs and inputs alike, which leaves the response as it is
    (Cochrane & Orcutt 1949, J. Am. Stat. Assoc. 44:32): else what a plant never forgets looks like noise that wanders.
    Twice as many lags are asked for, or as many as the inputs excite.
    """
    from scipy.stats import f

    spread = np.maximum(np.concatenate(natural).std(axis=0), 1e-300)
    own = own_past([column for part in natural for column in (part / spread).T])
    if np.abs(np.roots([1.0, *-own])).max(initial=0.0) > 1.0 + _GROWS / max(map(len, natural)):
        return float("inf")
    y_mean, u_mean = (np.concatenate([getattr(one, name) for one in records]).mean(axis=0) for name in ("y", "u"))
    white = [replace(one, y=without_past(one.y - y_mean, own), u=without_past(one.u - u_mean, own)) for one in records]
    spec = records[0].spec
    for reach in (2 * length, length):
        asked = [one[PAST:] for one in white if len(one) > 2 * reach + PAST]
        sums = normal_equations(asked, reach, offset=True) if asked else None
        free = 0 if sums is None else sums.rows - reach * spec.nu - 1 - PAST
        known = LagsKnown.of(sums, reach, spec.nu) if sums is not None and free > reach * spec.nu else None
        if sums is None or known is None:
            continue
        markov, _, rms = markov_parameters(asked, reach)
        late = np.array(markov[length - max(length // 10, 1) :])
        rounded = 1e-12 * np.concatenate([one.y for one in asked]).std(axis=0)
        noise = np.maximum(np.maximum(rms * np.sqrt(sums.rows / free), rounded), 1e-300)
        waves = np.exp(-1j * np.outer(np.linspace(0.0, np.pi, _FREQUENCIES), np.arange(len(late))))
        inverse = known.inverse[-len(late) :, :, -len(late) :]
        through = np.linalg.inv(np.einsum("fl,lamb,fm->fab", waves.conj(), inverse, waves, optimize=True))
        gain = np.einsum("fl,lya->fya", waves, late)
        sure = np.einsum("fya,fab,fyb->f", gain / noise[:, None], through, gain.conj() / noise[:, None]).real
        count = spec.ny * spec.nu
        lasts = _FREQUENCIES * f.sf(sure / count, 2 * count, 2 * free) < _LUCK
        found = np.linalg.norm(gain, 2, axis=(1, 2))[lasts].max(initial=0.0)
        return float(found / max(_largest_gain(markov[:length]), 1e-300))
    return 0.0


def response_controller(response: UncertainResponse, q: FloatArray, r: FloatArray, taps: int) -> ResponseController:
    """Return the disturbance feedback that minimises ``sum y' q y + u' r u`` on the records' own nature's y.

    With inputs linear in nature's y, outputs are linear in the controller: least squares (Simchowitz, Singh & Hazan
    2020, *COLT*, "Improper learning for non-stochastic control", sec. 2; after Youla).

    - ``q, r`` (ny, ny), (nu, nu)
    - ``taps``: m
    """
    from scipy.linalg import sqrtm
    from scipy.signal import fftconvolve

    length, ny, nu = response.markov.shape
    p = taps * nu * ny
    gram, right = np.zeros((p, p)), np.zeros(p)
    root_q, root_r = np.real(sqrtm(q)), np.real(sqrtm(r))
    for natural in response.natural:
        n = len(natural)
        # What one tap from output a to input b does to all outputs: the response filters nature's y.
        through = np.empty((n, ny, nu, ny))
        for b in range(nu):
            for a in range(ny):
                through[:, :, b, a] = fftconvolve(natural[:, a : a + 1], response.markov[:, :, b], axes=0)[:n]
        through = np.einsum("cd,ndba->ncba", root_q, through)
        acted = np.einsum("cb,na->ncba", root_r, natural)
        both = np.concatenate([through, acted], axis=1)
        target = -np.hstack([natural @ root_q.T, np.zeros((n, nu))])
        columns = np.zeros((n, ny + nu, taps, nu, ny))
        for j in range(taps):
            columns[j:, :, j] = both[: n - j]
        late = slice(length + taps, None)
        table = columns[late].reshape(-1, p)
        gram += table.T @ table
        right += table.T @ target[late].ravel()
    ridge = 1e-9 * float(np.trace(gram)) / p
    found = np.linalg.solve(gram + ridge * np.eye(p), right)
    return ResponseController(found.reshape(taps, nu, ny), response.markov)


@dataclass(frozen=True)
class ResponseControl:
    """A regulator straight from records, without a state: what it costs beside LQG, and whether the data vouch for it.

    The response is estimated from the estimation records (in open loop, of any rich input), the controller acts on
    what it leaves unexplained. If the response is wrong by Delta, the loop around controller M is M Delta: it is stable
    for every plant within the bound where ``bound * |M| < 1``, and inputs grow by at most ``1 / (1 - bound |M|)``. The
    second controller weighs the inputs more, as little as that needs (no input at all where nothing less does).

    Parameters
    ----------
    length : int
        Markov parameters.
    taps : int
        Of the controller.
    effort : float
        Weight of an input's square beside an output's, both relative to their variance in the records.
    confidence : float
    """

    takes: ClassVar[Takes] = "data"
    length: int = 40
    taps: int = 10
    effort: float = 0.1
    confidence: float = 0.95

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return what each controller costs on the validation records' nature's y, with its certificate."""
        if self.taps < 1 or not self.effort > 0 or not 0 < self.confidence < 1:
            raise InputError(
                "options of response-control",
                expected="taps >= 1, effort > 0, 0 < confidence < 1",
                got=f"{self.taps}, {self.effort}, {self.confidence}",
                remedy="correct them",
            )
        data = as_dataset(subject, "response-control")
        records = [record.measured() for record in data.estimation]
        response = estimated_response(records, self.length, confidence=self.confidence)
        held = [record.measured() for record in data.validation] or records
        y, u = (np.concatenate([getattr(record, name) for record in records]) for name in ("y", "u"))
        q, r = np.diag(1.0 / np.maximum(y.var(axis=0), 1e-300)), np.diag(self.effort / u.var(axis=0))
        nominal = response_controller(response, q, r, self.taps)
        vouched = _vouched(response, q, r, self.taps)
        state, order = _lqg(records, self.length, q, r, rng)
        tested = [
            _unexplained(response.markov, one.y - response.centre[0], one.u - response.centre[1])[self.length :]
            for one in held
        ]
        rows = []
        for name, made in (("none", None), ("response", nominal), ("response, vouched for", vouched), ("LQG", state)):
            cost = _cost(made, tested, response.markov, q, r)
            margin = response.bound * made.gain if isinstance(made, ResponseController) else None
            rows.append({"controller": name, "cost": cost, "bound x gain": margin})
        safe = response.bound * nominal.gain < 1.0
        words = (
            f"the response is known within a gain of {response.bound:.3g} ({self.confidence:.0%}); the gain of the "
            f"controller itself is {nominal.gain:.3g}",
            "the data vouch for the controller: every plant within the bound is stable under it"
            if safe
            else "the data do not suffice to vouch for the controller: record "
            f"{(response.bound * nominal.gain) ** 2 / 0.81:.0f} times as long, or use the one that is vouched for",
            f"LQG acts on a realised model of {order} states; costs are on held-out records, for each sample, with the "
            "response as estimated",
        )
        details = {"markov": response.markov, "taps": nominal.taps, "vouched": vouched.taps, "bound": response.bound}
        return Findings("control from a response", rows, words, details)


def _vouched(response: UncertainResponse, q: FloatArray, r: FloatArray, taps: int) -> ResponseController:
    """Return the controller with as little more weight on inputs as the bound needs; none at all where none does."""
    for power in range(13):
        made = response_controller(response, q, r * 4.0**power, taps)
        if response.bound * made.gain < 0.9:
            return made
    return ResponseController(np.zeros_like(made.taps), response.markov)


def _lqg(
    records: Sequence[Trajectory], length: int, q: FloatArray, r: FloatArray, rng: np.random.Generator
) -> tuple[StateController | None, int]:
    """Return the LQG regulator of the realised response, its filter from the records' own residuals."""
    model = HoKalman(markov=length).fit(list(records), rng=rng)
    a, b, c = model.a_matrix, model.b_matrix, model.c_matrix
    feedback = lqr_gain(a, b, c.T @ q @ c, r)
    if feedback is None or not stabilisable(a, b):
        return None, len(a)
    own: FloatArray = model.filter_gain
    if not np.any(own):
        found = kalman_gain(a, c, b @ b.T, 1e-2 * np.diag(np.diag(c @ b @ b.T @ c.T)) + 1e-12 * np.eye(len(c)))
        own = np.zeros(c.T.shape) if found is None else np.asarray(np.linalg.lstsq(a, found, rcond=None)[0])
    return StateController(a, b, c, feedback, own), len(a)


def _cost(
    made: ResponseController | StateController | None,
    natural: Sequence[FloatArray],
    plant: FloatArray,
    q: FloatArray,
    r: FloatArray,
) -> float:
    """Return the mean cost of a sample; without a controller, that of nature's y."""
    total, count = 0.0, 0
    for part in natural:
        y, u = (part, np.zeros((len(part), len(r)))) if made is None else made.closed(part, plant)
        total += float(np.einsum("ki,ij,kj->", y, q, y) + np.einsum("ki,ij,kj->", u, r, u))
        count += len(part)
    return total / count


def _convolved_at(markov: FloatArray, u: FloatArray, k: int) -> FloatArray:
    """Return ``sum_{i >= 1} markov[i] u[k-i]`` (ny,)."""
    reach = min(len(markov) - 1, k)
    past = u[k - reach : k][::-1]
    return np.asarray(np.einsum("iyu,iu->y", markov[1 : reach + 1], past))


def _unexplained(markov: FloatArray, y: FloatArray, u: FloatArray) -> FloatArray:
    """Return outputs less what the inputs of the record explain (N, ny)."""
    from scipy.signal import fftconvolve

    rest = np.array(y)
    for b in range(u.shape[1]):
        rest -= fftconvolve(u[:, b : b + 1], markov[:, :, b], axes=0)[: len(y)]
    return rest


def _largest_gain(taps: FloatArray) -> float:
    """Return the largest singular value over all frequencies of a finite response (m, n_out, n_in)."""
    waves = np.exp(-1j * np.outer(np.linspace(0.0, np.pi, _FREQUENCIES), np.arange(len(taps))))
    return float(np.linalg.norm(np.einsum("fm,moi->foi", waves, taps), ord=2, axis=(1, 2)).max())
