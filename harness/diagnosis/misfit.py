"""Does the model fit at all? If not, which likely mistake in the columns would explain it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.forms.fit_records import latent_shares, likelihood_detail, reading_noise
from harness.diagnosis.forms.form import WholeForm
from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.records.columns_check import DEGREE, SAMPLES
from harness.diagnosis.runs.compare import FreeRuns, told_noise
from harness.diagnosis.search.fit import Fit
from harness.signals import Dataset, FloatArray, Run, Trajectory

SHIFTS = (1, 2, 5, 10, 20)
"""Samples by which an input is tried late and early; then those between the best one and its neighbours."""
LATEST = SHIFTS[-1]


def misfit_reasons(
    form: WholeForm,
    nominal: Fit,
    final: Fit,
    runs: FreeRuns,
    policy: Policy,
    wrong: Sequence[str] = (),
    *,
    factor: int = 1,
) -> tuple[str, ...]:
    """Return why the model does not fit the data, and what probably is wrong; empty if it fits.

    - ``final``: with all effects that were accepted
    - ``wrong``: why nothing was looked for in the records: columns that are probably wrong, or noise
    - ``factor``: samples of the data for each that the form judges
    """
    if wrong:  # it says what is to be done
        return tuple(wrong)
    if form.left_out():  # one of these may be all that it lacks
        return ()
    reasons = []
    if not runs.beyond_start <= policy.misfit_nrmse**2 and not carried_away(form, final, runs, policy, factor):
        shares = runs.noise / np.maximum(runs.motion, 1e-300)
        if runs.worst is not None and shares[runs.worst] > policy.mostly:
            return (_noisy(form, shares),)  # a fit to noise is none, and says nothing about the model
        size = np.sqrt(runs.beyond_start)
        share = "diverges" if not np.isfinite(size) else f"leaves {100 * size:.0f} % of the motion"
        reasons.append(f"the prediction of the validation data {share} over {_length(runs)}")
        if policy.further < runs.further < np.inf:
            reasons.append(
                f"its error there is {runs.further:.2g} times that on the estimation records: another machine, another "
                "load, or something that changes between records"
            )
    for port, size in overwhelmed(form, final, policy).items():
        least = "at least " if f"s@{port}" in final.on_bound else ""
        reasons.append(f"an unmeasured force would have to be {least}{100 * size:.0f} % of what moves {port}")
    bound = [name for name in final.on_bound if name in final.values]
    if bound and reasons:
        reasons.append(f"{', '.join(bound)} ended on a bound")
    if reasons:
        reasons += likely_mistakes(form, nominal, final, policy, factor)
    return tuple(reasons)


def overwhelmed(form: WholeForm, final: Fit, policy: Policy) -> dict[str, float]:
    """Return the ports at which an unmeasured force does most of what moves them, with its share of that."""
    ports = [force.port for force in likelihood_detail(final).passes.forces]
    shares = zip(ports, latent_shares(final, form.noise_model.force_scale), strict=True)
    return {port: float(share) for port, share in shares if share > policy.misfit_force}


def carried_away(form: WholeForm, final: Fit, runs: FreeRuns, policy: Policy, factor: int = 1) -> bool:
    """Return True if a free run errs only where the model itself says that a small unknown force takes it away.

    Near its top a pendulum turns the smallest push into any error. What the forces of the fit add to the state goes on
    by the transitions of the filter's pass, from a known start of every window; from where that makes half of what is
    asked, at two standard errors, the free run is no evidence until the next window. The fit looks at one of ``factor``
    samples of the free run; where it looks at stretches of the records only, nothing tells.
    """
    small = latent_shares(final, form.noise_model.force_scale) <= policy.large
    if not form.latent or not small.all() or runs.after is None or not runs.after.finite:
        return False
    paths, _ = form.paths(final, "validation")
    size = np.sqrt(runs.motion)
    steps = (
        None
        if runs.horizon.seconds is None
        else max(round(runs.horizon.seconds / likelihood_detail(final).passes.dt), 1)
    )
    squares: list[FloatArray] = []
    errors = [error[::factor] for error in runs.after.validation]
    if list(map(len, errors)) != [len(passed.e) for passed in paths]:
        return False
    for passed, error in zip(paths, errors, strict=True):
        path = passed.path
        assert path is not None
        p, sure = np.zeros_like(path.p_after[0]), True
        for k in range(len(error)):
            if steps and k % steps == 0:
                p, sure = np.zeros_like(p), True
            spread = np.sqrt(np.einsum("oi,ij,oj->o", path.row[k], p, path.row[k]))
            sure = sure and bool((policy.tie_z * spread <= policy.misfit_nrmse * size).all())
            if not sure:
                continue
            squares.append((error[k] * runs.output.weights) ** 2)
            if k + 1 < len(error):
                f = path.transition[k]
                p = f @ (p - path.p_after[k]) @ f.T + path.p_before[k + 1]
    return bool((np.mean(squares, axis=0) <= (policy.misfit_nrmse * size) ** 2).all())


def mostly_noise(form: WholeForm, nominal: Fit, policy: Policy) -> list[str]:
    """Return why nothing can be told from records that are noise in every output; empty if one of them is not.

    They are where the motion is less than the share of what is read that a model which fits may leave.
    """
    deviation = reading_noise(nominal)
    shares = told_noise(deviation, form.records["estimation"]) / form.noise_model.output_scale**2
    noisy = shares.size > 0 and bool((1.0 - shares <= policy.misfit_nrmse**2).all())
    return [_noisy(form, shares)] if noisy else []


def _noisy(form: WholeForm, shares: FloatArray) -> str:
    """Return that readings are noise."""
    pairs = zip(form.dataset.spec.outputs, np.minimum(shares, 1.0), strict=True)
    outputs = {channel.name: float(share) for channel, share in pairs if share > POLICY.mostly}
    names = " and ".join(outputs)
    share = f"{100 * min(outputs.values()):.0f} % of the variance"
    return f"the readings of {names} are mostly noise ({share}), or far too coarse in time: they show nothing"


def _length(runs: FreeRuns) -> str:
    return "whole records" if runs.horizon.seconds is None else f"windows of {runs.horizon.seconds:g} s"


def likely_mistakes(form: WholeForm, nominal: Fit, final: Fit, policy: Policy, factor: int = 1) -> list[str]:
    """Return the mistakes whose repair makes the nominal model much likelier, all that do so about as well.

    Its first steps must already do better than the nominal model does with the data as they are. ``factor`` samples of
    the data stand behind each that the form judges.
    """
    least = final.log_likelihood("estimation") + policy.misfit_gain
    likelier = []
    for text, dataset, scale in [*mistakes(form.dataset), *_shifted(form, factor)]:
        other = form.on(dataset)
        begun = other.begin((), other.first_starts(), None, least - scale)
        if begun is None or begun.log_likelihood + scale <= nominal.log_likelihood("estimation"):
            continue
        fit = other.finish(begun, None, least=least - scale)
        if fit is not None and (value := fit.log_likelihood("estimation") + scale) > least:
            likelier.append((value, text))
    best = max((value for value, _ in likelier), default=0.0)
    words = " or ".join(text for value, text in likelier if value > best - policy.misfit_gain)
    return [f"check {words}: with that corrected the model fits far better"] if words else []


def mistakes(dataset: Dataset) -> Iterator[tuple[str, Dataset, float]]:
    """Yield likely mistakes: words, the data without it, and the change of the log-density by the change of units."""
    spec = dataset.spec
    count = sum(len(run) for run in dataset.estimation)
    for kind, channels in (("u", spec.inputs), ("y", spec.outputs)):
        for k, channel in enumerate(channels):
            yield f"the sign of {channel.name}", _changed(dataset, kind, [k], -1.0), 0.0
            if kind == "y" and channel.unit == "rad":
                scale = count * float(np.log(DEGREE))
                yield f"whether {channel.name} is in degrees", _changed(dataset, kind, [k], DEGREE), scale
        if len(channels) > 1:
            what = "inputs" if kind == "u" else "outputs"
            yield f"the signs of all {what}", _changed(dataset, kind, range(len(channels)), -1.0), 0.0


def _shifted(form: WholeForm, factor: int) -> Iterator[tuple[str, Dataset, float]]:
    """Yield the data with each input moved by as many samples as make a part of a record likeliest."""
    dataset = form.dataset
    longest = max(dataset.estimation, key=len)
    most = min(LATEST, len(longest) // 10)
    for k, channel in enumerate(dataset.spec.inputs):
        values: dict[int, float] = {}
        trial = [0, *(sign * size for size in SHIFTS for sign in (1, -1) if size <= most)]
        while trial:
            for shift in trial:
                values[shift] = _first_steps(form, _moved_part(longest, k, shift, most))
            best = max(values, key=lambda shift: values[shift])
            below = max((shift for shift in values if shift < best), default=best)
            above = min((shift for shift in values if shift > best), default=best)
            trial = [shift for shift in {(below + best) // 2, (best + above + 1) // 2} if shift not in values]
        if not best or not np.isfinite(values[best]):
            continue
        moved = replace(
            dataset, runs=tuple(replace(run, trajectory=_moved(run.trajectory, k, best)) for run in dataset.runs)
        )
        side, opposite = ("late", "early") if best > 0 else ("early", "late")
        size = abs(best) * factor
        many = f"{size} sample{'s' if size > 1 else ''}"
        yield f"whether {channel.name} is recorded about {many} {side}, or the outputs {opposite}", moved, 0.0


def _first_steps(form: WholeForm, record: Trajectory) -> float:
    """Return the log-likelihood of one record after the first steps of a fit of the nominal model to it."""
    other = form.on(replace(form.dataset, runs=(Run(record, "estimation"),)))
    begun = other.begin((), other.first_starts(), None)
    return -np.inf if begun is None else begun.log_likelihood


def _moved_part(record: Trajectory, column: int, shift: int, most: int) -> Trajectory:
    """Return the first samples of a record with an input moved, without the ends that some shift does not reach."""
    part = record[: min(len(record), SAMPLES)]
    return _moved(part, column, shift)[most : len(part) - most]


def _moved(record: Trajectory, column: int, shift: int) -> Trajectory:
    """Return a record with an input this many samples earlier (later if negative), its end (start) as it was."""
    u = record.u.copy()
    if shift > 0:
        u[:-shift, column] = record.u[shift:, column]
    elif shift < 0:
        u[-shift:, column] = record.u[:shift, column]
    return replace(record, u=u)


def _changed(dataset: Dataset, kind: str, columns: Sequence[int], factor: float) -> Dataset:
    """Return the data with some columns scaled."""

    def scaled(run: Run) -> Run:
        values = getattr(run.trajectory, kind).copy()
        values[:, list(columns)] *= factor
        return replace(run, trajectory=replace(run.trajectory, **{kind: values}))

    return replace(dataset, runs=tuple(scaled(run) for run in dataset.runs))
