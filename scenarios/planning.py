"""Acting on a learned model: model-predictive path integral control, or the cross-entropy method, on any model."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal

import numpy as np

from harness.errors import InputError
from harness.options import check_options
from harness.protocols import Experiment, Model
from harness.rng import Streams
from harness.signals import FloatArray, PlantSpec, residual
from harness.trust import registered_only
from scenarios.conditions import Conditions
from scenarios.noise import PerChannel, per_channel

_ROUNDS = {"mppi": 1, "cem": 3}
"""Times that a plan is drawn and improved at every sample; the plan of the sample before is its start."""

_LOST = 1e9  # Cost of a plan whose prediction diverges.


def read_model(source: Any) -> Model:
    """Return the model itself, or the one that a JSON file describes.

    Raises InputError if the file is no description of a model, or no plug-in reads its kind.
    """
    if hasattr(source, "step") and hasattr(source, "output"):
        model: Model = source
        return model
    try:
        content = json.loads(Path(source).read_text(encoding="utf-8"))
        kind = content["kind"]
    except (OSError, TypeError, ValueError, KeyError) as error:
        raise InputError(
            "option model",
            expected="a model, or the file that `sysid identify -o FILE` wrote",
            got=f"{type(error).__name__}: {error}",
            remedy="identify a model first",
            file=str(source),
        ) from error
    registered_only(content, file=source)
    for entry in entry_points(group="sysid_harness.model_readers", name=str(kind)):
        reader = entry.load()
        read: Model = getattr(reader, "from_dict", reader)(content)
        return read
    raise InputError(
        "kind of the model", expected="one that a plug-in reads", got=repr(kind), remedy="install it", file=str(source)
    )


@dataclass(frozen=True, kw_only=True)
class PredictiveControl(Conditions):
    """Sampling-based predictive control: inputs are drawn, run on the model, and mixed by what they cost there.

    At every sample the state of the model is corrected by the measured output, ``plans`` input sequences are drawn
    about the plan of the sample before, and the model is run on all of them at once. ``"mppi"`` takes their mean with
    weights ``exp(-cost / temperature)`` (Williams et al. 2017, *ICRA*); ``"cem"`` draws three times, each time about
    the mean and spread of the cheapest tenth (Rubinstein 1999; Pinneri et al. 2020, *CoRL*, for its use in control).
    The cost is the squared distance of the outputs from ``target``, each over its ``scale``, plus ``effort`` times the
    squared inputs over their range, summed over the horizon.

    Parameters
    ----------
    model : Model, or path of a JSON file
        Any model with the plant's channels and sample time: a learned one, or a grey box.
    target : mapping
        Wanted value of each output that matters, by name.
    scale : float or mapping
        Distance of an output that costs 1.
    effort : float
        Cost of an input at its limit.
    terminal : float
        Weight of the last predicted output, in those of the others.
    horizon : int
        Samples ahead.
    plans : int
        Input sequences drawn at every sample.
    spread : float
        Standard deviation of the draws, relative to half the range of an input.
    hold : int
        Samples for which a drawn input is held.
    temperature : float
        Of the weights, relative to the spread of the costs.
    method : {"mppi", "cem"}
    """

    model: Any
    target: dict[str, float]
    scale: PerChannel = 1.0
    effort: float = 0.01
    terminal: float = 5.0
    horizon: int = 25
    plans: int = 200
    spread: float = 0.5
    hold: int = 3
    temperature: float = 0.03
    method: Literal["mppi", "cem"] = "mppi"

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role; raises InputError if model or target do not fit the plant."""
        model = read_model(self.model)
        ours, theirs = ([(c.name, c.unit) for c in (*s.inputs, *s.outputs)] for s in (model.spec, spec))
        if ours != theirs or abs(model.spec.sample_time - spec.sample_time) > 1e-9 * spec.sample_time:
            raise InputError(
                "model of predictive-control", expected=str(spec), got=str(model.spec), remedy="fit one to this plant"
            )
        unknown = set(self.target) - {channel.name for channel in spec.outputs}
        if unknown or not self.target:
            raise InputError(
                "option target",
                expected=f"values of outputs among {', '.join(c.name for c in spec.outputs)}",
                got=", ".join(sorted(unknown)) or "none",
                remedy="name an output",
            )
        limits = np.array([[channel.minimum, channel.maximum] for channel in spec.inputs])
        if spec.nu == 0 or any(c.kind != "real" for c in spec.inputs) or not np.isfinite(limits).all():
            raise InputError(
                "predictive-control does not fit the plant",
                expected="real inputs with limits",
                got=str(spec),
                remedy="give the plant's option u_limit",
            )
        check_options(self, "predictive-control", horizon=">= 1", plans=">= 1", hold=">= 1")
        n = self.length(spec)
        controller = _Planner(self, model, spec, limits, streams(f"{role}/plans"))
        excitation = np.zeros((n, spec.nu))
        return self.experiment(spec, excitation, streams=streams, role=role, controller=controller)


class _Planner:
    """The feedback law: the model's state, and the plan so far."""

    def __init__(
        self,
        options: PredictiveControl,
        model: Model,
        spec: PlantSpec,
        limits: FloatArray,
        rng: np.random.Generator,
    ) -> None:
        self._options, self._model, self._spec, self._rng = options, model, spec, rng
        self._middle, self._half = limits.mean(axis=1), 0.5 * np.ptp(limits, axis=1)
        names = [channel.name for channel in spec.outputs]
        self._columns = [names.index(name) for name in options.target]
        self._target = np.array(list(options.target.values()), dtype=float)
        self._scale = np.array(per_channel(options.scale, spec.outputs, "scale"))[self._columns]
        # Plans are relative: 0 is the middle of an input's range, -1 and 1 its limits.
        self._plan = np.zeros((options.horizon, spec.nu))
        self._x: FloatArray | None = None
        self._u = np.zeros(spec.nu)

    def __call__(self, t: float, y: FloatArray) -> FloatArray:
        """Return the input (nu,) from the time [s] and the measured output (ny,)."""
        if self._x is None:
            from harness.signals import Trajectory

            first = Trajectory(np.zeros(1), np.zeros((1, self._spec.nu)), y[None], self._model.spec)
            self._x = self._model.initial_state(first)
        else:
            self._x = self._model.step(self._x, self._u)
        x = self._model.correct(self._x, self._u, y)
        self._x = x if np.isfinite(x).all() else self._x
        self._improve()
        self._u = self._middle + self._half * np.clip(self._plan[0], -1.0, 1.0)
        self._plan = np.concatenate([self._plan[1:], self._plan[-1:]])
        return self._u

    def _improve(self) -> None:
        """Draw plans about the present one and move it."""
        options = self._options
        spread = np.full_like(self._plan, options.spread)
        for _ in range(_ROUNDS[options.method]):
            count = -(-options.horizon // options.hold)
            draws = self._rng.normal(size=(options.plans, count, self._spec.nu)).repeat(options.hold, axis=1)
            draws[0] = 0.0  # the plan as it is competes
            plans = np.clip(self._plan + spread * draws[:, : options.horizon], -1.0, 1.0)
            costs = self._costs(plans)
            if options.method == "mppi":
                above = costs - costs.min()
                size = options.temperature * max(float(np.std(np.sort(costs)[: max(2, options.plans // 2)])), 1e-12)
                weights = np.exp(-above / size)
                self._plan = np.einsum("m,mku->ku", weights / weights.sum(), plans)
            else:
                best = plans[np.argsort(costs, kind="stable")[: max(2, options.plans // 10)]]
                self._plan, spread = best.mean(axis=0), best.std(axis=0) + 0.05 * options.spread

    def _costs(self, plans: FloatArray) -> FloatArray:
        """Return what plans (m, horizon, nu) cost on the model (m,)."""
        options = self._options
        assert self._x is not None
        x = np.broadcast_to(self._x, (len(plans), *self._x.shape))
        inputs = self._middle + self._half * plans
        costs = options.effort * np.sum(plans**2, axis=(1, 2))
        channels = [self._spec.outputs[i] for i in self._columns]
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(options.horizon):
                x = self._model.step(x, inputs[:, k])
                y = self._model.output(x, inputs[:, min(k + 1, options.horizon - 1)])[:, self._columns]
                miss = residual(channels, y, np.broadcast_to(self._target, y.shape)) / self._scale
                weight = options.terminal if k + 1 == options.horizon else 1.0
                costs = costs + weight * np.sum(miss**2, axis=1)
        return np.asarray(np.where(np.isfinite(costs), np.minimum(costs, _LOST), _LOST))
