"""Does the model fit at all? If not, which likely mistake in the columns would explain it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from harness.diagnosis.policy import Policy
from harness.diagnosis.runs.compare import FreeRuns
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.likelihood_form import LikelihoodForm
from harness.signals import Dataset

__all__ = ["misfit_reasons", "mistakes"]

DEGREES = np.pi / 180


def misfit_reasons(
    form: LikelihoodForm, final: Fit, runs: FreeRuns, policy: Policy, doubts: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return why the model does not fit the data, and what probably is wrong; empty if it fits.

    Parameters
    ----------
    form : LikelihoodForm
    final : Fit
        With all effects that were accepted.
    runs : FreeRuns
    policy : Policy
    doubts : sequence of str
        What is probably wrong with the columns by the declared values: the model fits nothing that it was meant for.
    """
    reasons = []
    if not runs.left <= policy.misfit_nrmse**2:
        share = "diverges" if not np.isfinite(runs.left) else f"leaves {100 * np.sqrt(runs.left):.0f} % of the motion"
        reasons.append(f"the prediction of the validation data {share} over {_length(runs)}")
    noise = final.detail.points["estimation"].noise
    forces = np.sqrt(noise.s**2 + noise.w**2)
    for port, size, scale in zip(final.detail.passes.forces, forces, form.noise_model.force_scale,
                                 strict=True):  # fmt: skip
        if size > policy.misfit_force * scale:
            reasons.append(
                f"a force that nobody measured would have to be {100 * size / scale:.0f} % of what moves {port.port}"
            )
    bound = [name for name in final.on_bound if "@" not in name]
    if bound and reasons:
        reasons.append(f"{', '.join(bound)} ended on a bound")
    if doubts:
        reasons += doubts
    elif reasons:
        reasons += _likely(form, final, policy)
    return tuple(reasons)


def _length(runs: FreeRuns) -> str:
    return "whole records" if runs.horizon.seconds is None else f"windows of {runs.horizon.seconds:g} s"


def _likely(form: LikelihoodForm, final: Fit, policy: Policy) -> list[str]:
    """Return the mistake whose repair makes the nominal model much likelier, if there is one."""
    best, words = final.log_likelihood("estimation"), ""
    for text, dataset, scale in mistakes(form.dataset):
        other = form.on(dataset)
        found = other.fit((), other.first_starts(), None)
        if found is None:
            continue
        value = found.log_likelihood("estimation") + scale
        if value > best + policy.misfit_gain:
            best, words = value, text
    return [f"check {words}: with that repaired the model fits far better"] if words else []


def mistakes(dataset: Dataset) -> Iterator[tuple[str, Dataset, float]]:
    """Yield likely mistakes: words, the data without it, and the change of the log-density by the change of units."""
    spec = dataset.spec
    count = sum(len(run) for run in dataset.estimation)
    for kind, channels in (("u", spec.inputs), ("y", spec.outputs)):
        for k, channel in enumerate(channels):
            yield f"the sign of {channel.name}", _changed(dataset, kind, k, -1.0), 0.0
            if kind == "y" and channel.unit == "rad":
                scale = count * float(np.log(DEGREES))
                yield f"whether {channel.name} is in degrees", _changed(dataset, kind, k, DEGREES), scale
    for k in range(len(spec.inputs)):
        late = replace(dataset, runs=tuple(_late(run, k) for run in dataset.runs))
        yield f"whether {spec.inputs[k].name} is recorded late or early", late, 0.0


def _changed(dataset: Dataset, kind: str, column: int, factor: float) -> Dataset:
    """Return the data with one column scaled."""

    def one(run: Any) -> Any:
        values = getattr(run.trajectory, kind).copy()
        values[:, column] *= factor
        return replace(run, trajectory=replace(run.trajectory, **{kind: values}))

    return replace(dataset, runs=tuple(one(run) for run in dataset.runs))


def _late(run: Any, column: int) -> Any:
    """Return a run with an input five samples earlier."""
    u = run.trajectory.u.copy()
    u[:-5, column] = u[5:, column]
    return replace(run, trajectory=replace(run.trajectory, u=u))
