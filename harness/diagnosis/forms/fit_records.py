"""What a likelihood keeps of a fit, and fits as plain numbers: an interrupted diagnosis goes on with the same bits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.diagnosis.forms.predictive import PredictiveDensity
from harness.diagnosis.search.fit import Fit
from harness.physics.compiled.kalman_pass import Filtered, Pass, PassNoise
from harness.physics.compiled.smoother import SmoothedStates
from harness.physics.fitting.likelihood import Likelihood
from harness.physics.fitting.maximum import LikelihoodFit, Point
from harness.signals import FloatArray


@dataclass(eq=False)
class LikelihoodDetail:
    """Points and passes by use, the filter that made them, what the parameters' spread costs, and phases by halves."""

    points: dict[str, Point]
    passes: Pass
    best: LikelihoodFit
    predictive: PredictiveDensity
    told: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    paths: dict[str, list[Filtered]] = field(default_factory=dict)
    smooth: dict[str, list[SmoothedStates]] = field(default_factory=dict)


def likelihood_detail(fit: Fit) -> LikelihoodDetail:
    """Return what the likelihood keeps of a fit of its own."""
    assert isinstance(fit.detail, LikelihoodDetail)
    return fit.detail


def latent_shares(fit: Fit, scale: FloatArray) -> FloatArray:
    """Return the sizes of the forces that nobody measured (nl,), each over the typical force of its port."""
    noise = likelihood_detail(fit).points["estimation"].noise
    return np.asarray(np.sqrt(noise.s**2 + noise.w**2) / scale)


def reading_noise(fit: Fit) -> FloatArray:
    """Return the standard deviation of the noise of the readings that were judged (ny,)."""
    return np.asarray(likelihood_detail(fit).points["estimation"].noise.r, dtype=float)


def point_record(point: Point) -> dict[str, Any]:
    """Return a point as plain numbers."""
    noise = point.noise
    return {
        "p": point.p.tolist(),
        "x0": [state.tolist() for state in point.x0],
        "noise": [values.tolist() for values in (noise.r, noise.s, noise.tau, noise.w)],
    }


def point_from_record(record: dict[str, Any]) -> Point:
    """Return the point of a record."""
    noise = PassNoise(*(np.array(values, dtype=float) for values in record["noise"]))
    return Point(np.array(record["p"], dtype=float), [np.array(state, dtype=float) for state in record["x0"]], noise)


def fit_record(fit: LikelihoodFit) -> dict[str, Any]:
    """Return a fit as plain numbers."""
    return {
        "point": point_record(fit.point),
        "names": list(fit.names),
        "covariance": fit.covariance.tolist(),
        "logarithmic": fit.logarithmic.tolist(),
        "converged": fit.converged,
        "on_bound": list(fit.on_bound),
        "iterations": fit.iterations,
        "message": fit.message,
        "beyond": fit.beyond,
        "undetermined": list(fit.undetermined),
    }


def fit_from_record(record: dict[str, Any], likelihood: Likelihood) -> LikelihoodFit | None:
    """Return the fit of a record, filtered once more; None if that diverges."""
    point = point_from_record(record["point"])
    filtered: list[Filtered] | None = likelihood.filtered(point)
    if filtered is None:
        return None
    names = tuple(record["names"])
    return LikelihoodFit(
        likelihood.system,
        point,
        float(sum(passed.nll for passed in filtered)),
        [passed.terms for passed in filtered],
        names,
        np.array(record["covariance"], dtype=float).reshape(len(names), len(names)),
        np.array(record["logarithmic"], dtype=bool),
        bool(record["converged"]),
        tuple(record["on_bound"]),
        int(record["iterations"]),
        str(record["message"]),
        filtered,
        bool(record["beyond"]),
        undetermined=tuple(record["undetermined"]),
    )
