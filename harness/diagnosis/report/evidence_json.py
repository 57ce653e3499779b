"""``report.json`` of the likelihood's diagnosis: stable and documented; unknown figures are null, never 0.

Keys of ``sysid-harness/close-loop/2``, the same for every kind of model; what does not apply is empty:

``verdict``
    ``model_does_not_fit`` (``misfit`` says why, and what to check); ``effects_found``; ``nothing_missing``;
    ``unexplained`` (no effect accepted, though a free force still predicts the validation records).
``adequacy``
    ``explained``, ``mostly_explained``, ``proxy_or_incomplete``, ``does_not_fit``; ``explained_share`` is the share of
    the motion of the validation outputs about a straight line through each window that the final model explains.
``stand_in``
    ``flagged``: the accepted effects imitate something that is not in the dictionary; ``reasons``.
``effects``, ``tie_sets``, ``separate_with``
    Accepted effects (``name``, ``at``, ``evidence``, ``validation_gain`` in units of log-likelihood, ``delta_bic``,
    ``parameters`` with ``value``, ``low``, ``high``, ``unit``, ``state``; ``may_be_part_of`` names the unknown force
    that is larger than what the effect explains, or is empty); all that these data cannot tell from each,
    itself first; the experiments that would. Empty where the model does not fit.
``searched``
    Where the model does not fit: what the search added all the same, entries like those of ``effects``. No finding, and
    everything "after" is then the nominal model.
``errors``
    ``before`` and ``after``: ``equation_error``, ``simulation_error`` (free runs over the horizon, by use and output),
    ``log_likelihood`` by use.
``recorded``
    By channel ``unit``, in which all figures here are, and ``recorded``, in which the data came and the summary, the
    tables and the pictures of the page are told, where it is another.
``parameters``
    ``before`` and ``after``: every parameter with its 95 % interval from the curvature of the likelihood; ``state`` is
    ``determined``, or where there are no limits ``fixed``, ``on_bound`` or ``not_determined``.
``ratios``
    Where nothing drives the model and no parameter fixes its scale (a free swing): what the data do tell of those that
    grow together, each over the first of them, with intervals.
``noise``
    ``before`` and ``after``: ``sensors`` (r by output) and ``forces`` (by port: s and tau of the latent force, its
    white part w; ``share``, both over what typically moves that coordinate; ``at_least`` where s lies on the upper
    bound of its search).
``candidates``
    Every refit with the reason it was rejected; then what the score test alone set aside. ``main``: by name value, low
    and high of the effect's size, limits null where ``parameters`` would have none.
``withdrawn``
    Effects that were accepted and taken back: something is left, and with them the model runs no nearer to the
    validation records, or further.
``left_over``
    What free forces over position, speed, input and time would gain beside the final model, axis by axis.
``policy``
    Every deciding number with its reason, source and what it was tuned on, by group: ``policy``, ``effort``, ``data``,
    ``run``, ``plan``, ``arm``, ``odd``.
``alarms``
    What must be known before anything else: a unit or a column that may be wrong, or why free runs judged the model
    where a likelihood would; among the ``warnings`` too.
``far_from_declared``
    Parameters that the data determine a factor of 100 and more from what the nominal model declares: ``name``,
    ``unit``, ``value``, ``declared``, ``ratio``. The ``summary`` ends with them.
``oddities``
    What is odd about the records (:mod:`harness.data.oddities`): ``kind``, ``run``, ``channel``, ``count`` and ``rows``
    (the first 1000), ``text``, ``fault`` (false for what is worth knowing only), ``used`` (kept out of the fits).
``tests``, ``isolability``, ``not_visible``, ``closed_loop``, ``closed_loop_bias``, ``horizon``
    The other evidence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.diagnosis.forms.fit_records import likelihood_detail
from harness.diagnosis.records.motion import motion_is_state
from harness.diagnosis.report.candidates import answer_of, candidate_rows
from harness.diagnosis.report.estimates import effect_data, estimate, known, ratios, scaled_together
from harness.diagnosis.report.experiments import Bench, separate_with, separating, undeclared_motion
from harness.diagnosis.report.keys import blank, numbers
from harness.diagnosis.report.refusals import refusal_text, refusals_text
from harness.diagnosis.report.words import as_recorded, brief, grown, named, recorded_units, standing_in
from harness.diagnosis.runs import residual_tests
from harness.diagnosis.runs.closed_loop_bias import closed_loop_bias
from harness.diagnosis.runs.equation_form import EquationForm
from harness.diagnosis.runs.errors import equation_error, figures, simulation_error
from harness.diagnosis.runs.fitted import Fitted
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.refusal import Kind, Refusal
from harness.diagnosis.systems import by_equations
from harness.effects.effect import Placed
from harness.signals import FloatArray
from harness.units import behind

if TYPE_CHECKING:
    from harness.diagnosis.diagnosis import Diagnosis

SELECTED = "validation used for selection: without a test run, the errors after the repair depend on that choice"
AROUND = (
    "an FMU shows no equations: only effects on its inputs and outputs and forces at its force inputs were tried, none "
    "that needs an acceleration (a payload) or the base (a tilt)"
)
FREE = "a free swing determines only ratios of inertia, damping and stiffness: to get the others, one must be known"
HELD = (
    "no parameter of the nominal model was fitted: each is fixed at its declared value (in a dataset.toml b = 0.1 "
    "fixes b, b = {{ start = 0.1 }} leaves it free): {0}"
)
UNTRIED = "the search reached its cost limit; not tried to the end, alone or together with what was found: {0}"


def evidence_data(found: Diagnosis, references: Sequence[Mapping[str, FloatArray]] = ()) -> dict[str, Any]:
    """Return the content of ``report.json``; ``references`` as :func:`harness.diagnosis.close_loop` takes them."""
    answer = answer_of(found)
    accepted = answer.accepted
    together = scaled_together(found.system, answer.fit, found.dataset)
    names, cosines = found.test.cosines([str(effect.placed) for effect in accepted])
    bench = Bench(found.system, answer.fit.model, answer.fit.values, found.dataset)
    bias = closed_loop_bias(
        found.runs.output, answer.runs, list(found.dataset.estimation), _used(found, references)
    ) if answer.runs is not None else None  # fmt: skip
    stand_in = () if found.misfit else found.stand_in
    far = answer.fit.far_off(found.system.parameters)
    errors, tests = _errors(found, found.nominal, found.runs.before), _tests(found, found.nominal)
    unchanged = answer.fit is found.nominal and answer.runs is found.runs.before
    data: dict[str, Any] = {
        **blank(),
        "dataset": found.dataset.name,
        "model": found.system.name,
        "verdict": found.verdict,
        "adequacy": found.grade,
        "explained_share": None if found.misfit else known(1.0 - found.runs.left),
        "misfit": list(found.misfit),
        "stand_in": {"flagged": bool(stand_in), "reasons": list(stand_in)},
        "effects": [effect_data(answer.fit, effect, together) for effect in accepted],
        "searched": [effect_data(found.final, added, together) for added in found.outcome.accepted if found.misfit],
        "tie_sets": [[_named(member) for member in effect.tie] for effect in accepted],
        "separating_experiments": [separating([p for member in effect.tie for p in member]) for effect in accepted],
        "separate_with": [separate_with(bench, effect.tie) for effect in accepted],
        "recorded": recorded_units(found.dataset),
        "errors": {
            "before": errors,
            "after": deepcopy(errors) if unchanged else _errors(found, answer.fit, answer.runs),
        },
        "parameters": {
            "before": _parameters(found.nominal, together),
            "after": _parameters(answer.fit, together),
        },
        "ratios": ratios(answer.fit, together),
        "noise": {"before": _noise(found, found.nominal), "after": _noise(found, answer.fit)},
        "candidates": candidate_rows(found, together),
        "withdrawn": [_named([effect.placed]) for effect in found.outcome.withdrawn],
        "left_over": [axis.to_dict() for axis in found.leftover.axes],
        "tests": {"before": tests, "after": deepcopy(tests) if unchanged else _tests(found, answer.fit)},
        "isolability": {"effects": list(names), "cosine": np.round(cosines, 4).tolist()},
        "not_visible": [
            {"name": hidden.placed.effect.name, "at": hidden.placed.at,
             "reason": "the nominal parameters and initial states can do the same"}
            for hidden in found.not_visible
        ],
        "closed_loop": _closed_loop(found, answer.fit),
        "closed_loop_bias": {**blank()["closed_loop_bias"], "text": "not tested: free runs diverge"}
        if bias is None
        else bias.to_dict({parameter.name: parameter.unit for parameter in answer.fit.system.parameters}),
        "horizon": {"seconds": found.runs.horizon.seconds, "reason": found.runs.horizon.reason},
        "form": "maximum likelihood" if found.form.latent else "maximum likelihood of free runs",
        "converged": {"nominal": found.nominal.converged, "final": answer.fit.converged},
        "intervals": {"hold": found.structure_fits, "meaning": _meaning_of_intervals(found)},
        "policy": numbers(found.policy),
        "dictionary": str(found.wanted),
        "alarms": list(found.alarms),
        "far_from_declared": [one.to_dict() for one in far],
        "warnings": _warnings(found, answer.fit, together),
        "seconds": round(found.seconds, 2),
    }  # fmt: skip
    sizes = ", ".join(f"{one.name} is {one.ratio:.2g} times its declared size" for one in far)
    data["summary"] = _head(found, data, sizes)
    return data


def _head(found: Diagnosis, data: dict[str, Any], sizes: str) -> str:
    """Return the verdict in one line, with what must be known beside it."""
    cause = _cause(found) if found.verdict == "unexplained" and found.lacking else ""
    advice = undeclared_motion(found.system) if cause else ""
    untried = _untried(found) if found.untried else ""
    summary = _summary(data, found.policy.least, cause, _lasting(found))
    return "; ".join(filter(None, (summary, advice, sizes, untried)))


def _warnings(found: Diagnosis, fit: Fit, together: Sequence[str]) -> list[str]:
    """Return what was odd on the way, and what the figures do not tell."""
    said = [*found.warnings, *_taken_back(found)]
    if not found.dataset.test:
        said.append(SELECTED)
    if found.untried:
        said.append(UNTRIED.format(", ".join(found.untried)))
    if not found.nominal.free and found.system.parameter_names:
        said.append(HELD.format(", ".join(found.system.parameter_names)))
    if found.wanted.items:
        said.append(f"the dictionary of this run: {found.wanted}")
    if given := [str(one.placed) for one in found.outcome.accepted if one.given]:
        said.append(f"{', '.join(given)}: given for this run, so no evidence was asked for")
    if together:
        said.append(FREE)
    if (found.stand_in or found.misfit) and (advice := undeclared_motion(found.system)):
        said.append(advice)
    if not by_equations(found.system):
        said.append(AROUND)
    if not fit.converged:
        said.append("the final fit did not converge: its figures are not those of a maximum")
    return list(dict.fromkeys(said))


def innovations(found: Diagnosis, fit: Fit, use: str) -> list[FloatArray]:
    """Return the innovations of a fit over their standard deviations, (N, ny) by record."""
    passed, _ = found.form.paths(fit, use)
    return [np.asarray(np.where(np.isfinite(filtered.e), filtered.e, 0.0) / np.sqrt(filtered.s)) for filtered in passed]


def _used(found: Diagnosis, references: Sequence[Mapping[str, FloatArray]]) -> list[Mapping[str, FloatArray]]:
    """Return the references of the estimation runs."""
    return [reference for reference, run in zip(references, found.dataset, strict=False) if run.use == "estimation"]


def _named(member: Sequence[Placed]) -> dict[str, Any]:
    """Return one member of a tie set."""
    return {
        "name": " + ".join(placed.effect.name for placed in member),
        "at": ", ".join(placed.at for placed in member),
    }


def _meaning_of_intervals(found: Diagnosis) -> str:
    """Return what the intervals count."""
    counted = "noise and the unmeasured force" if found.form.latent else "a coloured error of the free run"
    if found.structure_fits:
        return f"95 %, from the curvature of the likelihood, including {counted}"
    return (
        f"they include {counted}, but not that the model still lacks something predictable: "
        "true values may lie far outside"
    )


def _parameters(fit: Fit, together: Sequence[str]) -> dict[str, Any]:
    """Return every parameter with its interval."""
    return {parameter.name: estimate(fit, parameter.name, together) for parameter in fit.system.parameters}


def _noise(found: Diagnosis, fit: Fit) -> dict[str, Any]:
    """Return the noise of sensors and forces."""
    noise = likelihood_detail(fit).points["estimation"].noise
    return {
        "sensors": {
            channel.name: {"r": known(float(r)), "unit": channel.unit}
            for channel, r in zip(found.dataset.spec.outputs, found.sensor_noise(fit), strict=True)
        },
        "forces": {
            force.port: {
                "s": known(float(s)),
                "tau_s": known(float(tau)),
                "w": known(float(w)),
                "share": known(math.hypot(s, w) / scale),
                "unit": force.unit,
                "at_least": f"s@{force.port}" in fit.on_bound and bool(s > scale),
            }
            for force, s, tau, w, scale in zip(
                likelihood_detail(fit).passes.forces,
                noise.s,
                noise.tau,
                noise.w,
                found.form.noise_model.force_scale,
                strict=True,
            )
        },
    }


def _errors(found: Diagnosis, fit: Fit, fitted: Fitted | None) -> dict[str, Any]:
    """Return equation error, simulation error at several horizons, and log-likelihood."""
    likelihood = {use: known(fit.log_likelihood(use)) for use in ("estimation", "validation")}
    output = found.runs.output
    if fitted is None:
        nothing: dict[str, Any] = {use: {} for use in ("estimation", "validation", "test")}
        bare: dict[str, Any] = {
            "horizon_s": None,
            "whole_record": True,
            "initial_state": "estimated",
            "other_horizons": [],
        }
        meaning = {"meaning": "unknown: the simulation diverges"}
        return {"equation_error": {**nothing, **meaning}, "simulation_error": {**nothing, **bare},
                "one_step": {}, "log_likelihood": likelihood}  # fmt: skip
    strong = None
    after = answer_of(found).runs
    final = fitted if after is None else after  # before and after are the same quantity
    system = found.system
    hidden = output.nominal.ny and _sensors(final)
    if by_equations(system) and motion_is_state(system) and not hidden:
        strong = EquationForm(system, found.dataset, sizes=found.form.sizes)
    usable = strong is not None and all(map(strong.judges, (*fitted.effects, *final.effects)))
    return {
        "equation_error": equation_error(output, strong if usable else None, fitted, found.dataset, inverse=usable),
        "simulation_error": simulation_error(
            output, fitted, found.dataset, found.runs.horizon.seconds, _other_horizons(found)
        ),
        "one_step": {
            use: figures(
                [e * np.sqrt(passed.s) for e, passed in zip(innovations(found, fit, use),
                                                            found.form.paths(fit, use)[0], strict=True)],
                [run.y for run in found.form.records[use]],
                [(channel.name, channel.unit) for channel in found.dataset.spec.outputs],
            )
            for use in ("estimation", "validation")
        },
        "log_likelihood": likelihood,
    }  # fmt: skip


def _sensors(fitted: Fitted) -> bool:
    """Return True if a model has effects on its outputs: measured motion is not the true one then."""
    names = {channel.name for channel in fitted.system.outputs}
    return any(placed.at in names and "output" in placed.effect.kinds for placed in fitted.effects)


def _other_horizons(found: Diagnosis) -> list[float]:
    """Return other horizons worth reporting [s]: a tenth, and ten times, within the records."""
    dt = found.dataset.spec.sample_time
    shortest = min(len(run.trajectory) for run in found.dataset) * dt
    seconds = found.runs.horizon.seconds
    wanted = [0.02 * shortest, 0.2 * shortest] if seconds is None else [0.1 * seconds, 5 * seconds]
    return [float(f"{horizon:.2g}") for horizon in wanted if 20 * dt <= horizon < shortest]


def _tests(found: Diagnosis, fit: Fit) -> dict[str, Any]:
    """Return the tests of the innovations by output, on the longest validation record: white if the model is right."""
    result: dict[str, Any] = {}
    record = max(found.form.records["validation"], key=len)
    longest = max(innovations(found, fit, "validation"), key=len)
    for j, channel in enumerate(found.dataset.spec.outputs):
        r = longest[:, j]
        tests = [residual_tests.ljung_box(r)]
        for k, port in enumerate(found.dataset.spec.inputs):
            if np.ptp(record.u[:, k]) > 0:
                outcome = residual_tests.input_correlation(record.u[: r.size, k], r)
                tests.append(
                    residual_tests.TestOutcome(
                        f"{outcome.name} ({port.name})", outcome.statistic, outcome.dof, outcome.p
                    )
                )
        result[channel.name] = {
            "largest_autocorrelation": known(residual_tests.max_autocorrelation(r)),
            "tests": [test.to_dict() for test in tests],
        }
    return result


def _closed_loop(found: Diagnosis, fit: Fit) -> dict[str, Any]:
    """Test whether the innovations act back on the input, as under feedback (Ljung 1999, sec. 13.4)."""
    result: dict[str, Any] = {}
    run = found.form.records["estimation"][0]
    r = innovations(found, fit, "estimation")[0][:, 0]
    for k, channel in enumerate(found.dataset.spec.inputs):
        u = run.u[: len(r), k]
        if len(u) < 100 or np.ptp(u) == 0:
            continue
        backwards = residual_tests.input_correlation(u[::-1], r[::-1], lags=10)
        feedback = bool(backwards.p < 0.01)
        result[channel.name] = {
            "p": known(backwards.p),
            "statistic": known(backwards.statistic),
            "dof": backwards.dof,
            "feedback": feedback,
            "text": "the innovations are related to later inputs: data of a closed loop"
            if feedback
            else "no relation of the innovations to later inputs was found",
        }
    return result


def _summary(data: dict[str, Any], least: float, cause: str, lasting: Sequence[str] = ()) -> str:
    """Return the verdict in one line; unmeasured forces are told above the share ``least``.

    ``cause`` is what speaks for something that has no name, ``lasting`` what free runs leave that is no noise.
    """
    before, after = (
        {
            name: as_recorded(figure, name, data)
            for name, figure in data["errors"][when]["simulation_error"]["validation"].items()
        }
        for when in ("before", "after")
    )
    if data["verdict"] == "model_does_not_fit":
        return f"{data['model']} does not fit these data: {'; '.join(data['misfit'])}"
    change = ", ".join(
        f"{name} {brief(before[name]['rms'])} -> {brief(after[name]['rms'])}{behind(before[name]['unit'])}"
        for name in before
        if name in after
    )
    share = data["explained_share"]
    # four digits, rounded down: 100 % is what leaves nothing but noise
    words = (
        "no free run"
        if share is None
        else "a straight line comes closer to the validation motion than the model"
        if share < 0.0
        else f"{math.floor(1e4 * share) / 100:g} % of the validation motion is explained"
        if share < 1.0
        else "the validation motion is explained up to noise"
    )
    forces = [
        f"an unmeasured force at {port} ({brief(math.hypot(force['s'], force['w']))} {force['unit']}, "
        f"{brief(100 * force['share'])} % of what moves it)"
        for port, plain in data["noise"]["after"]["forces"].items()
        for force in [as_recorded(plain, port, data)]
        if force["share"] is not None and force["share"] > least
    ]
    beside = f" apart from {' and '.join([*forces, *lasting])}" if forces or lasting else ""
    if data["verdict"] == "effects_found":
        if data["stand_in"]["flagged"]:
            text = f"{standing_in(data, data['model'])}{_still_left(data['noise']['after']['forces'])}"
        elif all(effect["rounds"] for effect in data["effects"]):
            steps = " and ".join(
                f"{one['at']} is read in steps of {_step(as_recorded(one['parameters']['step'], one['at'], data))}"
                for one in data["effects"]
            )
            return (
                f"nothing is missing in {data['model']}{beside}, except that {steps}; "
                f"validation simulation error {change}; {words}"
            )
        else:
            text = f"{data['model']} lacks {named(data['effects'], data['tie_sets'])}"
        if worse := grown(before, after):
            return f"the validation simulation error grows ({worse}), although the likelihood rises: {text}; {words}"
        return f"{text}; validation simulation error {change}; {words}"
    plain = ", ".join(f"{name} {brief(figure['rms'])}{behind(figure['unit'])}" for name, figure in before.items())
    if data["verdict"] == "nothing_missing":
        return f"nothing is missing in {data['model']}{beside}: validation simulation error {plain}; {words}"
    return f"{_unnamed(data['model'], cause)} ({plain}; {words})"


def _unnamed(model: str, cause: str) -> str:
    """Return that something without a name is missing, or that nobody can tell whether something is."""
    if not cause:
        return f"it is not known whether something is missing in {model}"
    return f"something is missing in {model}, and no effect of the dictionary explains it: {cause}"


def _lasting(found: Diagnosis) -> list[str]:
    """Return in words what free runs leave of an output that is no noise, where no latent force takes it up."""
    if found.runs.worst is None or found.lasting <= found.policy.disturbed:
        return []
    output = found.dataset.spec.outputs[found.runs.worst].name
    return [f"a lasting error of free runs (of {output}, {brief(100 * found.lasting)} % of its motion)"]


def _step(step: Mapping[str, Any]) -> str:
    """Return the step in which a sensor rounds its readings."""
    return f"{brief(step['value'])}{behind(step['unit'])}"


def _cause(found: Diagnosis) -> str:
    """Return why something is said to be missing that has no name, in words; what speaks for it most clearly."""
    best = found.left
    if best is not None:
        return f"a free force at {best.name} predicts what is left"
    if found.outcome.withdrawn:
        names = " and ".join(_words(accepted.placed) for accepted in found.outcome.withdrawn)
        return f"the likeliest answer, {names}, does not bring free runs closer to the validation records"
    refused = found.promised
    if refused is not None and refused.comparison is not None:
        names = " and ".join(map(_words, refused.added))
        gain = f"{names} would bring {refused.comparison.evidence:.0f} in log-likelihood on the estimation records"
        if refused.comparison.validation < 0.0:
            return f"{gain}, but the validation records deny it: it changes between the records, or is another law"
        if refused.comparison.validation < refused.comparison.error:
            return f"{gain}, but the validation records show nothing of it; excite it in both"
        return f"{gain}, but {refusals_text(refused.refusals)}"
    if found.rival:
        return f"{found.rival.replace('_', ' ').replace('@', ' at ')} alone helps free runs more, but is not accepted"
    if found.apart is not None and found.disagree:
        return found.apart.which
    if found.shaken:
        return _happened(found)
    if found.astray:
        further = f"{found.runs.further:.2g} times as large on the validation records as on the others"
        return f"the error of free runs is {further}"
    if not found.form.latent:
        return f"{' and '.join(_lasting(found))} is left"
    if found.runs.left > found.policy.misfit_nrmse**2:
        return f"free runs leave {brief(100 * np.sqrt(found.runs.left))} % of what a straight line leaves"
    return "the unmeasured force is too large for a disturbance"


def _untried(found: Diagnosis) -> str:
    """Return how many effects the cost of the search left out."""
    count = len(found.untried)
    return f"{count} {'effects were' if count > 1 else 'effect was'} not tried to the end"


def _happened(found: Diagnosis) -> str:
    """Return when the unmeasured force jumps."""
    parts = []
    for use in ("estimation", "validation"):
        times = sorted({round(one.time, 2) for one in found.jumps if one.use == use})
        parts.append(f"{', '.join(f'{time:g}' for time in times)} s of the {use} records")
    return f"the unmeasured force jumps at {' and at '.join(parts)}: something happens there"


def _taken_back(found: Diagnosis) -> list[str]:
    """Return a warning about what was accepted and taken back."""
    names = ", ".join(str(accepted.placed) for accepted in found.outcome.withdrawn)
    worse = refusal_text(Refusal(Kind.WITHDRAWN))
    return [f"{names}: accepted by the likelihood, then taken back: {worse}"] if names else []


def _words(placed: Placed) -> str:
    """Return an effect and its place in words."""
    return f"{placed.effect.name.replace('_', ' ')} at {placed.at}"


def _still_left(forces: Mapping[str, Any]) -> str:
    """Return how large the unmeasured force is, where it is largest: a stand-in may leave little or much."""
    shares = {port: force["share"] for port, force in forces.items() if force["share"] is not None}
    if not shares:
        return ""
    port = max(shares, key=lambda name: shares[name])
    return f", and leaves a force of {brief(100 * shares[port])} % of what moves {port}"
