"""What a fitted model is worth for control, as an analysis: can it be controlled, and what does its regulator cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from harness.benchmark.control import for_control
from harness.errors import InputError
from harness.models.analysis import Findings, Takes
from harness.models.lqr import reachable, spectral_radius, stabilisable, state_observable
from harness.parts.files import make_plant
from harness.scoring import control_score, linearise
from harness.scoring.prediction import SAME_CLOCK
from harness.signals import FloatArray


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
        State at which the plant is held, by name, 0 for the others; an equilibrium.
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
        with make_plant(self.plant, {"sample_time": spec.sample_time, **self.plant_options}) as plant:
            names = [[one.name for one in side.outputs] for side in (spec, plant.spec)]
            if names[0] != names[1] or abs(plant.spec.sample_time / spec.sample_time - 1.0) > SAME_CLOCK:
                raise InputError(
                    "control-worth: model and plant",
                    expected=f"outputs {', '.join(names[0])} every {spec.sample_time:g} s",
                    got=f"{', '.join(names[1])} every {plant.spec.sample_time:g} s",
                    remedy="give the plant of this model, with the same outputs (option plant_options)",
                )
            around = linearise(plant, x0=self.at)
        rows.append(_facts("plant", around))
        score = control_score(model, around, q=_weights(self.q, spec.ny), r=_weights(self.r, spec.nu))
        rows[0]["plant under its regulator"] = score.spectral_radius if score.status != "no design" else None
        rows[1]["plant under its regulator"] = control_score(around, around).spectral_radius
        said = {
            "ok": f"the regulator of the model costs {score.ratio:.10g} times that of the plant itself",
            "unstable": "the regulator of the model does not hold the plant",
            "no design": "no regulator can be designed on the model",
        }[score.status]
        return Findings("worth for control", rows, (said,), {"ratio": score.ratio, "status": score.status})


def _weights(given: float | Sequence[float] | None, count: int) -> FloatArray | None:
    return None if given is None else np.diag(np.broadcast_to(np.asarray(given, dtype=float), (count,)))


def _facts(name: str, model: Any) -> dict[str, Any]:
    """Return what control design asks of a state-space model."""
    a, b, c = (np.asarray(getattr(model, f"{letter}_matrix"), dtype=float) for letter in "abc")
    return {
        "of": name, "states": len(a), "controllable": reachable(a, b), "observable": state_observable(a, c),
        "stabilisable": stabilisable(a, b), "detectable": stabilisable(a.T, c.T), "spectral radius": spectral_radius(a),
    }  # fmt: skip
