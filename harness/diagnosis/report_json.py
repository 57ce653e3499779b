"""``report.json``: the diagnosis as data. Stable and documented; unknown figures are null, never 0.

Keys of ``sysid-harness/close-loop/1``:

``verdict``
    ``effects_found``; ``nothing_missing`` (no effect accepted, and the rest is not predictable); ``unexplained`` (no
    effect accepted, though the rest is predictable).
``adequacy``
    ``explained``, ``mostly_explained``, ``proxy_or_incomplete``: the predictable part of what is left, over the noise.
``stand_in``
    ``flagged``: the accepted effects imitate something that is not in the dictionary, their names are no diagnosis;
    ``reasons``.
``effects``
    Accepted effects: ``name``, ``at``, ``delta_bic``, and ``parameters`` with ``value``, ``low``, ``high`` (95 %) and
    ``unit``.
``tie_sets``
    One list for each accepted effect: all that these data cannot tell from it, itself first.
``separate_with``
    For each accepted effect the experiments that would break its ties: ``separates``, ``why``, ``scenario`` with its
    ``options`` computed from the fitted model and a ``command``; or an ``instruction`` where no input can do it.
``errors``
    ``before`` and ``after``: ``equation_error``, ``simulation_error`` (by use and output ``rms``, ``nrmse``, ``unit``;
    with ``horizon_s``, ``initial_state``, ``other_horizons``; where windows are used also ``from_measured_state``, the
    same windows started from the smoothed measurement), ``residual_to_noise``.
``parameters``
    ``before`` and ``after``: every parameter with its interval (null limits: fixed, or not determined).
``noise_floor``
    By output: ``value``, ``unit``, ``source`` (declared, repeated_periods, fourth_difference, black_box, null).
``disturbance``
    By output: what is left and cannot be predicted, where it exceeds the noise floor.
``candidates``
    Every refit, with the reason it was rejected; then what the screen alone set aside.
``closed_loop``, ``closed_loop_bias``
    By input, whether the residual is related to later inputs; and the Durbin-Wu-Hausman test of the bias that feedback
    puts on the parameters: ``statistic``, ``p``, ``parameters`` with the shift of each in its standard errors.
    ``biased`` is null, and ``text`` says why, where no signal from outside the loop was recorded.
``tests``, ``null``, ``isolability``, ``not_visible``, ``force_map``
    The evidence behind the verdict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.diagnosis import residual_tests
from harness.diagnosis.confirm import Candidate
from harness.diagnosis.experiments import Bench, separate_with
from harness.diagnosis.forms import Fitted, rms
from harness.diagnosis.isolability import separating
from harness.diagnosis.report_summary import summary
from harness.diagnosis.scores import equation_error, noise_ratios, simulation_error
from harness.diagnosis.screens import isolability, unseen
from harness.diagnosis.stand_in import stand_in
from harness.effects.effect import Placed
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.diagnosis.simulated import SimulatedDiagnosis

__all__ = ["FORMAT", "report_data"]

FORMAT = "sysid-harness/close-loop/1"
SELECTED = "validation used for selection: there is no test run, so the figures after are not independent of the choice"

AROUND = (
    "an FMU shows no equations: only effects on its inputs and outputs and forces at its force inputs were tried, none "
    "that needs an acceleration (a payload) or the base (a tilt)"
)


def report_data(found: SimulatedDiagnosis, references: Sequence[Mapping[str, FloatArray]] = ()) -> dict[str, Any]:
    """Return the content of ``report.json``; ``references`` as :func:`harness.diagnosis.close_loop` takes them."""
    others = _other_horizons(found)
    errors = {
        name: {
            "equation_error": equation_error(found.output, None, model, found.dataset, inverse=False),
            "simulation_error": simulation_error(found.output, model, found.dataset, found.horizon.seconds, others),
            "residual_to_noise": _noise_ratios(found, model),
        }
        for name, model in (("before", found.nominal), ("after", found.final))
    }
    warnings = [*found.warnings, *found.result.notes]
    if not found.dataset.test:
        warnings.append(SELECTED)
    if found.system.h is None:
        warnings.append(AROUND)
    names, cosines = isolability(found.first_screen, first=[str(one.placed) for one in found.result.accepted])
    reasons = list(stand_in(found))
    data: dict[str, Any] = {
        "format": FORMAT,
        "dataset": found.dataset.name,
        "model": found.system.name,
        "verdict": found.verdict,
        "adequacy": found.adequacy.grade,
        "stand_in": {"flagged": bool(reasons), "reasons": reasons},
        "summary": "",
        "effects": [_effect(found, one.placed, one.delta_bic) for one in found.result.accepted],
        "tie_sets": [[_named(member) for member in one.tie] for one in found.result.accepted],
        "separating_experiments": [
            separating([placed for member in one.tie for placed in member]) for one in found.result.accepted
        ],
        "separate_with": [
            separate_with(Bench(found.system, found.final.system, found.final.values, found.dataset), one.tie)
            for one in found.result.accepted
        ],
        "errors": errors,
        "parameters": {"before": _parameters(found.nominal), "after": _parameters(found.final)},
        "noise_floor": {one.output: one.to_dict() for one in found.floors},
        "disturbance": _disturbance(found),
        "candidates": _candidates(found),
        "rest": found.adequacy.to_dict(),
        "force_map": _force_map(found),
        "tests": {"before": _tests(found, found.nominal), "after": _tests(found, found.final)},
        "null": _null(found),
        "isolability": {"effects": list(names), "cosine": np.round(cosines, 4).tolist()},
        "not_visible": unseen(found.first_screen),
        "closed_loop": _closed_loop(found),
        "closed_loop_bias": _bias(found, references),
        "horizon": {"seconds": found.horizon.seconds, "reason": found.horizon.reason},
        "form": "simulation",
        "converged": {"nominal": found.nominal.converged, "same_minimum_twice": found.same_minimum},
        "warnings": list(dict.fromkeys(warnings)),
        "seconds": round(found.seconds, 2),
    }
    data["summary"] = summary(data)
    return data


def known(value: float | None) -> float | None:
    """Return a finite number, or None."""
    return None if value is None or not np.isfinite(value) else float(value)


def _named(member: Sequence[Placed]) -> dict[str, Any]:
    """Return one member of a tie set."""
    if len(member) == 1:
        return {"name": member[0].effect.name, "at": member[0].at}
    return {"name": " + ".join(one.effect.name for one in member), "at": ", ".join(one.at for one in member)}


def _effect(found: SimulatedDiagnosis, placed: Placed, delta_bic: float) -> dict[str, Any]:
    """Return one accepted effect with its parameters."""
    model = found.final
    intervals = model.intervals()
    parameters = {}
    for one in placed.effect.parameters:
        name = placed.name(one.name)
        unit = model.system.parameter(name).unit
        if name in intervals:
            parameters[one.name] = intervals[name].to_dict(unit)
        else:
            parameters[one.name] = {"value": known(model.values[name]), "low": None, "high": None, "unit": unit}
        parameters[one.name]["meaning"] = one.meaning
    return {
        "name": placed.effect.name,
        "at": placed.at,
        "parameters": parameters,
        "delta_bic": known(delta_bic),
        "formula": placed.effect.formula,
        "summary": placed.effect.summary,
    }


def _parameters(model: Fitted) -> dict[str, Any]:
    """Return every parameter with its interval."""
    intervals = model.intervals()
    result = {}
    for one in model.system.parameters:
        if one.name in intervals:
            result[one.name] = intervals[one.name].to_dict(one.unit)
        else:
            result[one.name] = {"value": known(model.values[one.name]), "low": None, "high": None, "unit": one.unit}
    return result


def _noise_ratios(found: SimulatedDiagnosis, model: Fitted) -> dict[str, float | None]:
    """Return residual over noise floor by use, in the form that judged."""
    return noise_ratios({"estimation": model.estimation, "validation": model.validation}, found.form.floors)


def _other_horizons(found: SimulatedDiagnosis) -> list[float]:
    """Return other horizons worth reporting [s]: a tenth, and ten times, within the records."""
    dt = found.dataset.spec.sample_time
    shortest = min(len(run.trajectory) for run in found.dataset) * dt
    if found.horizon.seconds is None:
        wanted = [0.02 * shortest, 0.2 * shortest]
    else:
        wanted = [0.1 * found.horizon.seconds, 5 * found.horizon.seconds]
    return [float(f"{one:.2g}") for one in wanted if 20 * dt <= one < shortest]


def _disturbance(found: SimulatedDiagnosis) -> dict[str, Any]:
    """Return, by output, the level and spectrum of a coloured rest that cannot be predicted."""
    from scipy import signal

    result: dict[str, Any] = {}
    model = found.final
    size = rms(model.validation) * found.form.weights
    dt = found.dataset.spec.sample_time
    for j, (name, unit) in enumerate(found.form.columns):
        floor = found.form.floors[j]
        ratio = None if not floor else float(size[j] / (floor * found.form.weights[j]))
        acf = max(residual_tests.max_autocorrelation(one[:, j]) for one in model.validation)
        n = min(len(one) for one in model.validation)
        if not residual_tests.detect(ratio, acf, n):
            continue
        longest = max(model.validation, key=len)[:, j]
        f, power = signal.welch(longest, 1 / dt, nperseg=min(len(longest), 512))
        share = np.cumsum(power) / max(power.sum(), 1e-300)
        result[name] = {
            "rms": known(float(size[j])),
            "unit": unit,
            "ratio_to_noise": known(ratio) if ratio is not None else None,
            "largest_autocorrelation": known(acf),
            "peak_hz": known(float(f[int(np.argmax(power))])),
            "band_hz": [known(float(f[int(np.searchsorted(share, part))])) for part in (0.05, 0.95)],
            "predictable": found.adequacy.predictable,
        }
    return result


def _candidates(found: SimulatedDiagnosis) -> list[dict[str, Any]]:
    """Return one row for each refit of each round, then what the screens set aside."""
    accepted = {str(one.placed) for one in found.result.accepted}
    tied = {str(p) for one in found.result.accepted for member in one.tie for p in member} - accepted
    rows = []
    for number, here in enumerate(found.result.rounds, start=1):
        for one in sorted(here.candidates, key=lambda c: -c.delta_bic):
            rows.append(_row(one, number, accepted, tied))
        refitted = {one.name for one in here.candidates}
        for probe in here.screen.probes:
            if str(probe.placed) in refitted:
                continue
            reason = "not among the leaders of the screens"
            if probe.left < 0.02 or not probe.rank:
                by = probe.absorbed_by
                reason = f"cannot be told from {by or 'the nominal parameters'}"
            rows.append(
                {
                    "name": probe.placed.effect.name,
                    "at": probe.placed.at,
                    "round": number,
                    "refitted": False,
                    "accepted": False,
                    "reason": reason,
                    "screen_r2": known(probe.r2),
                    "delta_bic": None,
                }
            )
        for name, reason in here.screen.failed.items():
            effect, _, at = name.partition("@")
            rows.append(
                {"name": effect, "at": at, "round": number, "refitted": False, "accepted": False,
                 "reason": reason, "screen_r2": None, "delta_bic": None}
            )  # fmt: skip
    return rows


def _row(one: Candidate, number: int, accepted: set[str], tied: set[str]) -> dict[str, Any]:
    """Return the row of one refitted candidate."""
    reason = "; ".join(one.judgement.reasons)
    if one.accepted and one.name not in accepted:
        reason = "tied with the answer, which is simpler" if one.name in tied else "another candidate explains more"
    fitted = one.fitted
    return {
        "name": " + ".join(p.effect.name for p in one.added),
        "at": ", ".join(p.at for p in one.added),
        "round": number,
        "refitted": True,
        "converged": bool(fitted.converged) if fitted is not None else False,
        "accepted": one.name in accepted and one.accepted,
        "passed": one.accepted,
        "reason": reason,
        "delta_bic": known(one.delta_bic),
        "validation_gain": known(one.comparison.gain),
        "bootstrap_p": known(one.comparison.p),
        "main": {name: [known(i.value), known(i.low), known(i.high)] for name, i in one.main.items()},
        "residual": known(float(rms(fitted.validation).max())) if fitted is not None and fitted.finite else None,
    }


def _tests(found: SimulatedDiagnosis, model: Fitted) -> dict[str, Any]:
    """Return the residual tests by output, on the longest validation record."""
    result: dict[str, Any] = {}
    for j, (name, _) in enumerate(found.form.columns):
        r = max(model.validation, key=len)[:, j]
        if not np.isfinite(r).all():
            continue
        tests = [residual_tests.ljung_box(r), residual_tests.cusum_of_squares(r)[2]]
        record = max(found.dataset.validation, key=len)
        y = record.y[: r.size, j]
        for k, channel in enumerate(found.dataset.spec.inputs):
            u = record.u[: r.size, k]
            if np.ptp(u) > 0:
                first = residual_tests.input_correlation(u, r)
                tests.append(residual_tests.Outcome(f"{first.name} ({channel.name})", *_three(first)))
                tests += list(residual_tests.higher_order(u, y, r))
        dt = found.dataset.spec.sample_time
        line = residual_tests.fisher_g(r, dt)
        result[name] = {
            "largest_autocorrelation": known(residual_tests.max_autocorrelation(r)),
            "tests": [one.to_dict() for one in tests],
            "line": {"omega": known(line.omega), "g": known(line.g), "p": known(line.p)},
        }
    return result


def _three(one: residual_tests.Outcome) -> tuple[float, int, float]:
    """Return statistic, degrees of freedom and p of an outcome."""
    return one.statistic, one.dof, one.p


def _null(found: SimulatedDiagnosis) -> dict[str, Any]:
    """Return the global null of the first round."""
    if not found.result.rounds:
        return {"p": None, "surrogates": 0, "observed": None, "reason": "nothing was detected, so nothing was tested"}
    here = found.result.rounds[0].surrogates
    return {
        "p": known(found.result.rounds[0].p),
        "surrogates": int(here.null.size),
        "observed": known(here.observed),
        "quantile_99": known(float(np.quantile(here.null, 0.99))),
    }


def _force_map(found: SimulatedDiagnosis) -> dict[str, Any] | None:
    """Return the non-physical fallback: a table of forces, valid only inside its hull; None where nothing is left."""
    best = found.adequacy.best
    if not found.adequacy.predictable or best is None:
        return None
    family = found.families[best.axes]
    return {
        "warning": "not physical: a table fitted to what is left; invalid outside its hull",
        "place": family.place,
        "axes": [
            {
                "name": axis.name,
                "unit": axis.unit,
                "knots": knots.tolist(),
                "hull": [known(v) for v in axis.hull],
            }
            for axis, knots in zip(family.axes, family.knots(), strict=True)
        ],
        "values": [known(v) for v in best.coefficients],
        "share": known(best.share),
        "p": known(best.p),
    }


def _bias(found: SimulatedDiagnosis, references: Sequence[Mapping[str, FloatArray]]) -> dict[str, Any]:
    """Return the test of the bias that feedback puts on the parameters of the final model."""
    from harness.diagnosis.closed_loop_bias import closed_loop_bias

    runs = list(found.dataset)
    used = [one for one, run in zip(references, runs, strict=False) if run.use == "estimation"]
    test = closed_loop_bias(found.form, found.final, list(found.dataset.estimation), used)
    return test.to_dict({one.name: one.unit for one in found.final.system.parameters})


def _closed_loop(found: SimulatedDiagnosis) -> dict[str, Any]:
    """Test whether the residual acts back on the input, which biases fits of data taken in closed loop.

    The residual of the final model is correlated with *later* inputs (Ljung, System Identification, section 13.4).
    """
    model, result = found.final, {}
    run = found.dataset.estimation[0]
    u, r = run.u, model.estimation[0][:, 0]
    n = min(len(u), len(r))
    for k, channel in enumerate(found.dataset.spec.inputs):
        if n < 100 or np.ptp(u[:n, k]) == 0 or not np.isfinite(r).all():
            continue
        backwards = residual_tests.input_correlation(u[:n, k][::-1], r[:n][::-1], lags=10)
        feedback = bool(backwards.p < 0.01)
        result[channel.name] = {
            "p": known(backwards.p),
            "statistic": known(backwards.statistic),
            "dof": backwards.dof,
            "feedback": feedback,
            "text": "the residual is related to later inputs: data of a closed loop, parameters may be biased"
            if feedback
            else "no relation of the residual to later inputs was found",
        }
    return result
