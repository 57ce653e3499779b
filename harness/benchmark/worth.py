"""What a fitted model is worth for control, as an analysis: can it be controlled, and what does its regulator cost."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from harness.benchmark.control import for_control
from harness.errors import InputError
from harness.models.analysis import Findings, Takes
from harness.models.lifted import HORIZON, lifted_lqr, lifted_mpc, require_lifted
from harness.models.lqr import lqr_gain, reachable, spectral_radius, stabilisable, state_observable
from harness.options import check_options
from harness.parts.files import make_plant
from harness.scoring import control_score
from harness.scoring.control import LinearPlantModel, held
from harness.scoring.prediction import SAME_CLOCK
from harness.scoring.regulation import StateFeedback, regulation_steps
from harness.signals import FloatArray, PlantSpec

_HELD = 0.01  # Share of what a run costs, per sample, that its last tenth may cost where the plant is held.


@dataclass(frozen=True)
class ControlWorth:
    """Whether a fitted model is fit for control, and what its regulator costs on the plant beside the plant's own.

    Of the model, and of the plant linearised at a point: states, how many of them inputs reach and outputs show,
    whether all that does not die away by itself is reached (stabilisable) and shown (detectable). With a plant also the
    stationary cost of the LQG regulator designed on the model, in that of the plant's own
    (:func:`harness.scoring.control_score`). Models of ``edmdc`` count in their lifted coordinates.

    Parameters
    ----------
    plant : str, optional
        Id or file of the plant; without one the model alone is looked at.
    plant_options : mapping
        Of the plant; its sample time is the model's where nothing else is said.
    at : mapping
        State at which the plant is held, by name, 0 for the others; an equilibrium under some input.
    q, r : float or sequence, optional
        Weights of outputs and inputs, one number or one each; by default outputs in units of what an input pulse does
        to each, and 1.

    Examples
    --------
    >>> from harness.scoring.control import LinearPlantModel
    >>> one = np.ones((1, 1))
    >>> found = ControlWorth().of(LinearPlantModel(1.1 * one, one, one, 0 * one), rng=np.random.default_rng(0))
    >>> found.rows[0]["controllable"], found.words[0]
    (1, 'a regulator can be designed on it')
    """

    takes: ClassVar[Takes] = "process"
    plant: str | None = None
    plant_options: Mapping[str, Any] = field(default_factory=dict)
    at: Mapping[str, float] = field(default_factory=dict)
    q: float | Sequence[float] | None = None
    r: float | Sequence[float] | None = None

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the facts about model and plant, and the cost.

        Raises
        ------
        InputError
            If the model is linear in no coordinates, or the plant is another one or cannot be held at the point.
        """
        model = for_control(subject)
        if model is None:
            raise InputError(
                "control-worth",
                expected="a model that is linear, or in lifted coordinates",
                got=type(subject).__name__,
                remedy="fit arx, n4sid, least-squares, dmdc or edmdc; others by the scenario predictive-control",
            )
        rows = [_facts("model", model)]
        if self.plant is None:
            able = rows[0]["stabilisable"] and rows[0]["detectable"]
            said = "a regulator can be designed on it" if able else "no regulator of it holds what grows"
            return Findings("worth for control", rows, (said, "what it costs on a plant is told with option plant"))
        spec = subject.spec
        with _same_plant(subject, self.plant, self.plant_options, "control-worth") as plant:
            around, _, hold = held(plant, self.at)
        rows.append(_facts("plant", around))
        score = control_score(model, around, q=_weights(self.q, spec.ny, "q"), r=_weights(self.r, spec.nu, "r"))
        rows[0]["plant under its regulator"] = score.spectral_radius if score.status != "no design" else None
        rows[1]["plant under its regulator"] = control_score(around, around).spectral_radius
        said = {
            "ok": f"the regulator of the model costs {score.ratio:.10g} times that of the plant itself",
            "unstable": "the regulator of the model does not hold the plant",
            "no design": "no regulator can be designed on the model",
        }[score.status]
        words = [said]
        if np.any(hold):
            by = ", ".join(f"{one.name} = {value:.6g}" for one, value in zip(spec.inputs, hold, strict=True))
            words.append(f"what holds the plant at this point is {by}")
        return Findings("worth for control", rows, words, {"ratio": score.ratio, "status": score.status})


@dataclass(frozen=True)
class LiftedControl:
    """LQR and predictive control in lifted coordinates on the plant itself, beside the linearised plant's LQR.

    Every controller is run from every start: cost ``sum (y - y*)' q (y - y*) + (u - u*)' r (u - u*)``, u* what holds
    the plant at the point; ``over local``: in that of the LQR of the plant linearised at the point; ``regret``: beyond
    the least of them from the same start, added up; ``held``: starts after which the last tenth of the run costs less
    than a hundredth of its share. The model is lifted anew from the outputs of every sample (Korda & Mezic 2018,
    *Automatica* 93:149, sec. 5); inputs stay within the ranges that the plant declares, which predictive control
    knows. Plants are run without noise of sensors.

    Parameters
    ----------
    plant : str, optional
        Id or file of the plant; needed.
    plant_options : mapping
        Of the plant; its sample time is the model's where nothing else is said.
    at : mapping
        State at which the plant is to be held, by name, 0 for the others; an equilibrium under some input.
    starts : sequence of mapping
        Initial states, by name; needed.
    steps : int
        Samples of a run.
    horizon : int
        Samples that predictive control looks ahead.
    q, r : float or sequence
        Weights of outputs and inputs: one number, or one each.
    """

    takes: ClassVar[Takes] = "process"
    plant: str | None = None
    plant_options: Mapping[str, Any] = field(default_factory=dict)
    at: Mapping[str, float] = field(default_factory=dict)
    starts: Sequence[Mapping[str, float]] = ()
    steps: int = 200
    horizon: int = HORIZON
    q: float | Sequence[float] = 1.0
    r: float | Sequence[float] = 0.1

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return what every controller costs.

        Raises
        ------
        InputError
            If the model is not linear in lifted coordinates, or the plant is another one or cannot be held there.
        """
        check_options(self, "lifted-control", steps=">= 10", horizon=">= 1", r="> 0")
        require_lifted(subject)
        if self.plant is None or not self.starts:
            raise InputError(
                "lifted-control",
                expected="a plant, and states from which it starts",
                got=f"plant={self.plant}, starts={list(self.starts)}",
                remedy="say both, such as -O plant=pendulum-ode -O 'at={theta=3.14159265}' -O 'starts=[{theta=2.5}]'",
            )
        spec = subject.spec
        q, r = _weights(self.q, spec.ny, "q"), _weights(self.r, spec.nu, "r")
        with _same_plant(subject, self.plant, self.plant_options, "lifted-control") as plant:
            around, target, hold = held(plant, self.at)
            point = {"q": q, "r": r, "target": target, "hold": hold}
            made: dict[str, Any] = {
                "local LQR": _local(plant.spec, around, **point),
                "lifted LQR": lifted_lqr(subject, **point),
                "lifted MPC": lifted_mpc(subject, horizon=self.horizon, **point),
            }
            for one in (made["lifted LQR"], made["lifted MPC"]):
                if one is not None:  # a table of records declares no ranges: those of the plant count
                    one.low, one.high = (
                        np.array([getattr(channel, side) for channel in plant.spec.inputs])
                        for side in ("minimum", "maximum")
                    )
            runs = {
                name: None
                if one is None
                else np.array([
                    regulation_steps(plant, one, start, steps=self.steps, **point) for start in self.starts
                ])
                for name, one in made.items()
            }  # fmt: skip
        rows = _rows(runs)
        costs = {name: run.sum(axis=1) for name, run in runs.items() if run is not None}
        return Findings("control in lifted coordinates", rows, tuple(_said(rows)), costs)


def _rows(runs: Mapping[str, FloatArray | None]) -> list[dict[str, Any]]:
    """Return a row for each controller from what every sample cost from every start (M, steps); the first is local."""
    costs = {name: run.sum(axis=1) for name, run in runs.items() if run is not None}
    least = np.min([*costs.values()], axis=0) if costs else np.zeros(0)
    local, rows = float(np.sum(costs.get(next(iter(runs)), np.nan))), []
    for name, run in runs.items():
        row: dict[str, Any] = {"controller": name, "cost": None, "over local": None, "regret": None, "held": None}
        if run is not None:
            cost, late = float(costs[name].sum()), run.shape[1] // 10
            stays = np.isfinite(costs[name]) & (run[:, -late:].mean(axis=1) <= _HELD * run.mean(axis=1))
            row["held"] = f"{int(stays.sum())} of {len(stays)}"
            if np.isfinite(cost):
                row["cost"], row["regret"] = cost, float((costs[name] - least).sum())
                row["over local"] = cost / local if np.isfinite(local) and local > 0 else None
        rows.append(row)
    return rows


def _said(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield what the table means."""
    for row in rows:
        name = row["controller"]
        if row["held"] is None:
            why = (
                "the outputs are not the states"
                if name == "local LQR"
                else "its Riccati equation has no stabilising solution"
            )
            yield f"{name}: no design ({why})"
        elif row["cost"] is None:
            yield f"{name}: from some start the plant ends, or leaves every bound"
        elif len({*row["held"].split(" of ")}) > 1:
            yield f"{name} has come to the point from {row['held']} starts: its cost is that of the time that was run"


def _local(
    spec: PlantSpec, around: LinearPlantModel, q: FloatArray, r: FloatArray, target: FloatArray, hold: FloatArray
) -> StateFeedback | None:
    """Return the LQR of the linearised plant, where its outputs tell its states; else none."""
    c = around.c_matrix
    if c.shape[0] != c.shape[1] or np.linalg.matrix_rank(c) < len(c) or spec.feedthrough:
        return None
    gain = lqr_gain(around.a_matrix, around.b_matrix, c.T @ q @ c, r)
    return None if gain is None else StateFeedback(spec, gain @ np.linalg.inv(c), target, hold)


@contextmanager
def _same_plant(model: Any, id: str, options: Mapping[str, Any], what: str) -> Iterator[Any]:
    """Give the plant of a model, and refuse one with other outputs or another sample time."""
    spec = model.spec
    with make_plant(id, {"sample_time": spec.sample_time, **options}) as plant:
        names = [[one.name for one in side.outputs] for side in (spec, plant.spec)]
        if names[0] != names[1] or abs(plant.spec.sample_time / spec.sample_time - 1.0) > SAME_CLOCK:
            raise InputError(
                f"{what}: model and plant",
                expected=f"outputs {', '.join(names[0])} every {spec.sample_time:g} s",
                got=f"{', '.join(names[1])} every {plant.spec.sample_time:g} s",
                remedy="give the plant of this model, with the same outputs (option plant_options)",
            )
        yield plant


def _weights(given: float | Sequence[float] | None, count: int, name: str) -> Any:
    """Return the diagonal matrix (count, count) of weights; none where none are given."""
    if given is None:
        return None
    found = np.asarray(given, dtype=float)
    if found.shape not in ((), (count,)) or np.any(found < 0):
        raise InputError(
            f"weights {name}", expected=f"one number from 0 on, or {count} of them", got=str(given),
            remedy="give one for each output (q) or input (r)",
        )  # fmt: skip
    return np.diag(np.broadcast_to(found, (count,)))


def _facts(name: str, model: Any) -> dict[str, Any]:
    """Return what control design asks of a state-space model."""
    a, b, c = (np.asarray(getattr(model, f"{letter}_matrix"), dtype=float) for letter in "abc")
    return {
        "of": name, "states": len(a), "controllable": reachable(a, b), "observable": state_observable(a, c),
        "stabilisable": stabilisable(a, b), "detectable": stabilisable(a.T, c.T), "spectral radius": spectral_radius(a),
    }  # fmt: skip
