"""Fitted models in the hand: read from a file, simulated, predicted with, turned into what control design wants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from harness.errors import InputError, NotLinearError
from harness.models.determined import bands_of
from harness.models.estimate import Estimate, estimate_of
from harness.models.spread import Matrices, gain_and_phase_deviation, gains, pole_covariance, response_covariance
from harness.models.transforms import Hold, continuous, discrete, reduction
from harness.protocols import Model
from harness.signals import FloatArray, PlantSpec, Trajectory

if TYPE_CHECKING:
    import control

    from harness.comparison.responses import Response
    from harness.models.forecasting import Forecast
    from harness.models.regulators import Regulator


class Usable:
    """What can be done with a fitted model, whoever fitted it; ``model`` is the model itself.

    A model's own ``step(x, u)`` moves its state by one sample (:class:`harness.protocols.Model`); the answer of its
    outputs to a unit step is :meth:`step_response`.
    """

    model: Model

    @property
    def spec(self) -> PlantSpec:
        """Inputs, outputs and sample time."""
        return self.model.spec

    @property
    def estimate(self) -> Estimate | None:
        """Parameters with units, covariance and intervals, as far as the identifier gives them; else None.

        ``estimate.deviation(name)`` is the standard deviation of one.
        """
        return estimate_of(self.model)

    def simulate(self, u: Any, *, start: Any = None) -> FloatArray:
        """Return the outputs (N, ny) of a free run: no measured output is used on the way.

        Parameters
        ----------
        u : array (N, nu) or (N,), or a record
            Inputs at the model's sample time and in its units. Of a record (a Trajectory, a table, a file) the inputs
            are used, and the initial state that fits its outputs best.
        start : array (nx,) or a record, optional
            State at the first sample; or what was measured before it, up to one sample before. By default a linear
            model of inputs that came as an array starts at rest, in the state 0.

        Raises
        ------
        InputError
            If the inputs have another number of channels, or a model that is not linear has no start.
        """
        from harness.scoring import predict

        if not _is_array(u):
            record = self._record(u)
            state = None if start is None else self._state(start)
            return predict(self.model, record, None, initial=state)
        inputs = self._inputs(u)
        if start is None:
            return self._run(self._rest(), inputs)
        return self._run(self._state(start), inputs)

    def predict(self, data: Any, y: Any = None, *, horizon: int | None = 1) -> FloatArray:
        """Return predictions (N, ny) of the outputs of a record; see :func:`harness.predict`.

        Parameters
        ----------
        data : record, or array (N, nu) or (N,)
            A Trajectory, a table or a file whose columns carry the model's names; or inputs, beside ``y``.
        y : array (N, ny) or (N,), optional
        horizon : int or None
            Steps ahead: ``y[k]`` is predicted from outputs up to ``y[k - horizon]``. None is the free run.

        Returns
        -------
        array (N, ny)
            NaN in the first ``horizon`` rows.
        """
        from harness.scoring import predict

        return predict(self.model, self._record(data, y), horizon)

    def forecast(self, past: Any, u: Any = None, *, steps: int | None = None) -> FloatArray:
        """Return the outputs (M, ny) that follow a record, the first one sample after its end.

        Parameters
        ----------
        past : record
            What was measured: a Trajectory, a table or a file. The state is filtered through it.
        u : array (M, nu) or (M,), optional
            Inputs from then on. A model without inputs takes ``steps`` instead.
        steps : int, optional

        Raises
        ------
        InputError
            If inputs are missing.
        """
        if u is None and (self.spec.nu or steps is None):
            raise InputError(
                "inputs of a forecast",
                expected=f"an array (M, {self.spec.nu})" if self.spec.nu else "steps = M",
                got="none",
                remedy="give what the inputs will be" if self.spec.nu else "say how many samples",
            )
        inputs = np.zeros((int(steps or 0), 0)) if u is None else self._inputs(u)
        return self._run(self._state(self._record(past)), inputs)

    def forecast_bands(self, past: Any, u: Any = None, *, steps: int | None = None, level: float = 0.95) -> Forecast:
        """Return the forecast of a record, as :meth:`forecast`, with the bands that its noise leaves open.

        The bands are those of the innovations of the record: they grow as the model carries past disturbances on. What
        is uncertain about the model itself is not in them (:meth:`step_response` shows that).

        Parameters
        ----------
        past, u, steps
            As of :meth:`forecast`.
        level : float
            Probability with which a band holds an output.

        Raises
        ------
        InputError
            If the model is not linear, or the record too short to tell its noise.
        """
        from harness.models.forecasting import forecast_bands

        linear, record = self._linear("forecast_bands()"), self._record(past)
        y = self.forecast(record, u, steps=steps)
        return forecast_bands(linear, record, np.asarray(self.predict(record)), y, level)

    @property
    def determined(self) -> dict[str, list[list[float]]] | None:
        """Frequencies [Hz] that the data of a linear model determine, by ``"output per input"``; None if unknown."""
        return bands_of(self.model)

    def frequency_response(
        self, frequency: Any, *, deviation: bool = False
    ) -> npt.NDArray[np.complex128] | tuple[npt.NDArray[np.complex128], FloatArray, FloatArray]:
        """Return the response (F, ny, nu) of a linear model at frequencies [Hz].

        Parameters
        ----------
        frequency : array (F,)
        deviation : bool
            With the standard deviations of gain and phase [rad], (F, ny, nu) each.

        Raises
        ------
        InputError
            If the model has no frequency response, or deviations are asked of one that knows none.
        """
        model = self._lifted("frequency_response()")
        f = np.atleast_1d(np.asarray(frequency, dtype=np.float64))
        found = gains(model.matrices, f, self.spec.sample_time)
        if not deviation:
            return found
        self._spread(model)
        return found, *gain_and_phase_deviation(found, response_covariance(model, f))

    def pole_deviation(self) -> tuple[npt.NDArray[np.complex128], FloatArray]:
        """Return the poles, by falling modulus, and the standard deviation of the modulus of each (nx,)."""
        model = self._lifted("pole_deviation()")
        self._spread(model)
        poles, covariance = pole_covariance(model)
        return poles, gain_and_phase_deviation(poles, covariance)[0]

    def resampled(self, sample_time: float, method: Hold = "zoh") -> FittedModel:
        """Return a linear model at another sample time, by way of continuous time; its intervals go along.

        Parameters
        ----------
        sample_time : float
            [s]
        method : {"zoh", "foh", "tustin", "matched"}
            What the inputs do between samples (:mod:`harness.models.transforms`).

        Raises
        ------
        InputError
            If the model is not linear, or has poles that belong to no system in continuous time.
        """
        model, old = self._linear("resampled()").centred(), self.spec.sample_time
        if not (np.isfinite(sample_time) and sample_time > 0):
            raise InputError("sample time", expected="seconds, above 0", got=repr(sample_time), remedy="correct it")

        def moved(matrices: Matrices) -> Matrices:
            return discrete(continuous(matrices, old, method), sample_time, method)

        spec = replace(self.spec, sample_time=float(sample_time))
        if bool(np.any(moved(model.matrices)[3])):
            spec = replace(spec, feedthrough=True)
        return FittedModel(_with_matrices(model, moved, spec, self._level(model)))

    def reduced(self, order: int, method: Literal["balanced", "modal"] = "balanced") -> FittedModel:
        """Return a stable linear model with fewer states; ``notes["reduction"]`` and its print say how far off it is.

        Parameters
        ----------
        order : int
        method : {"balanced", "modal"}
            Keep the directions of the largest Hankel singular values, or the modes that do most.

        Raises
        ------
        InputError
            If the model is not linear and stable, or has no more states than that.
        """
        linear = self._linear("reduced()")
        found = reduction(linear.matrices, order, method)
        made = _with_matrices(linear.centred(), found.of, self.spec, self._level(linear))
        notes = {**made.notes, "order": order, "reduction": {"words": str(found), "bound": found.bound,
                                                            "error": found.error}}  # fmt: skip
        gain = found.left @ np.asarray(linear.filter_gain)
        return FittedModel(replace(made, filter_gain=gain, notes=notes))

    def regulator(self, q: Any = None, r: Any = None) -> Regulator:
        """Return the LQR of a linear model, and where it relies on frequencies that the data do not determine.

        Parameters
        ----------
        q : array (ny, ny), optional
            Weight of the outputs; the identity by default.
        r : array (nu, nu), optional
            Weight of the inputs; the identity by default.
        """
        from harness.models.regulators import regulator

        return regulator(self._linear("regulator()"), q, r)

    def to_control(self, *, deviations: bool = False, continuous: Hold | None = None) -> control.StateSpace:
        """Return a linear model as a state-space system of python-control, in discrete time unless asked otherwise.

        Parameters
        ----------
        deviations : bool
            Leave out the constant offsets: the system then speaks of deviations from the equilibrium.
        continuous : {"zoh", "foh", "tustin", "matched"}, optional
            In continuous time, by this view of the inputs between samples.

        Raises
        ------
        InputError
            If the model is not linear, or has offsets and ``deviations`` is False.
        """
        from harness.export.linear import to_control

        linear = self._linear("to_control()")
        return to_control(linear.centred() if deviations else linear, continuous=continuous)

    @property
    def poles(self) -> npt.NDArray[np.complex128]:
        """Poles of a linear model in the z plane, eigenvalues of A (nx,), by falling modulus; stable inside 1.

        Raises
        ------
        InputError
            If the model is not linear.
        """
        values = np.linalg.eigvals(np.asarray(self._linear("poles").a_matrix)).astype(np.complex128)
        return values[np.argsort(-np.abs(values), kind="stable")]

    def step_response(self, duration: float | None = None) -> Response:
        """Return the answer of a linear model's outputs to a unit step of each input, from rest.

        Parameters
        ----------
        duration : float, optional
            [s]; by default until the slowest pole has died away.

        Raises
        ------
        InputError
            If the model is not linear: simulate a step of the size that you mean, ``simulate(u, start=...)``.
        """
        from harness.comparison.responses import response

        return response(self._linear("step_response()"), "step", duration)

    def impulse_response(self, duration: float | None = None) -> Response:
        """Return the answer of a linear model to a unit pulse of one sample at each input (its Markov parameters).

        Parameters
        ----------
        duration : float, optional
            As for :meth:`step_response`.
        """
        from harness.comparison.responses import response

        return response(self._linear("impulse_response()"), "impulse", duration)

    def _linear(self, what: str) -> Any:
        """Return the model if it is linear."""
        names = ("a_matrix", "b_matrix", "c_matrix", "d_matrix", "centred")
        if not all(hasattr(self.model, name) for name in names):
            raise NotLinearError(
                f"{what} of a model that is not linear",
                expected="a linear model (A, B, C, D)",
                got=type(self.model).__name__,
                remedy="use simulate(u, start=...), or fit a linear one (arx, n4sid, prediction-error)",
            )
        return self.model

    def _lifted(self, what: str) -> Any:
        """Return the model if its free runs are linear in its inputs."""
        return self.model if hasattr(self.model, "matrices") else self._linear(what)

    def _spread(self, model: Any) -> None:
        """Refuse a model that does not know how sure it is."""
        if getattr(model, "spread", None) is None:
            raise InputError(
                "standard deviations of a model",
                expected="a fit that keeps its spread",
                got="none: too few rows, too many states, or the model was moved (stable = true)",
                remedy="record longer, or give a lower order",
            )

    def _level(self, linear: Any) -> FloatArray:
        """Return the outputs (ny,) at rest under no input, which stay when states change; none of an integrator."""
        a, c = np.asarray(linear.a_matrix), np.asarray(linear.c_matrix)
        if not np.any(linear.state_offset):
            return np.asarray(linear.output_offset, dtype=np.float64)
        rest = np.linalg.lstsq(np.eye(len(a)) - a, np.asarray(linear.state_offset), rcond=None)[0]
        return np.asarray(c @ rest + linear.output_offset, dtype=np.float64)

    def _record(self, data: Any, y: Any = None) -> Trajectory:
        """Return data as one record in the model's language."""
        if y is not None:
            u, outputs = self._inputs(data), np.asarray(y, dtype=float)
            outputs = outputs.reshape(len(outputs), -1)
            return Trajectory(self.spec.sample_time * np.arange(len(u), dtype=np.float64), u, outputs, self.spec)
        if isinstance(data, Trajectory):
            return data
        from harness.data.recipe.load import load_record

        return load_record(data, self.spec)

    def _inputs(self, u: Any) -> FloatArray:
        """Return inputs as (N, nu)."""
        array = np.asarray(u, dtype=np.float64)
        if array.ndim == 1 and self.spec.nu == 1:
            array = array[:, None]
        if array.ndim != 2 or array.shape[1] != self.spec.nu or not np.isfinite(array).all():
            names = ", ".join(map(str, self.spec.inputs)) or "none"
            raise InputError(
                "inputs",
                expected=f"finite numbers (N, {self.spec.nu}): {names}, one row each {self.spec.sample_time:g} s",
                got=f"shape {np.shape(u)}" + ("" if np.isfinite(array).all() else ", with values that are not finite"),
                remedy="put time on the first axis and one channel in each column, and a number in every cell",
            )
        return array

    def _rest(self) -> FloatArray:
        """Return the state 0 of a linear model."""
        if not hasattr(self.model, "a_matrix"):
            raise InputError(
                f"a start of {type(self.model).__name__}",
                expected="start = the state (nx,), or a record of what was measured before",
                got="none",
                remedy="give start=..., or simulate a record, whose outputs tell its initial state",
            )
        return np.zeros(len(self.model.a_matrix))

    def _state(self, start: Any) -> FloatArray:
        """Return the state that is given, or the one that follows a record."""
        if _is_array(start):
            return np.asarray(start, dtype=np.float64)
        from harness.scoring.prediction import filtered

        record = self._record(start)
        seen = filtered(self.model, self.model.initial_state(record.measured()), record)[-1]
        return self.model.step(seen, record.u[-1])

    def _run(self, x: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return the outputs of a free run from a state."""
        from harness.scoring import free_run

        return free_run(self.model, x, inputs)


class FittedModel(Usable):
    """A model that ``identify`` or ``close_loop`` stored: itself a :class:`harness.protocols.Model`, and usable.

    Parameters
    ----------
    model : Model

    Examples
    --------
    >>> from harness import api
    >>> u = np.sign(np.sin(np.arange(300.0)))
    >>> y = np.zeros(300)
    >>> for k in range(299):
    ...     y[k + 1] = 0.9 * y[k] + 0.2 * u[k]
    >>> model = FittedModel(api.identify(u, y, sample_time=0.1, options={"order": 1}).model)
    >>> model.poles.real.round(3), model.simulate(np.ones(3)).ravel().round(3) + 0.0
    (array([0.9]), array([0.  , 0.2 , 0.38]))
    """

    def __init__(self, model: Model) -> None:
        self.model = model

    @property
    def burn_in(self) -> int:
        """Samples of a record that the memory of the model reaches back."""
        return self.model.burn_in

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx,) at the first sample of a record."""
        return self.model.initial_state(data)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""
        return self.model.output(x, u)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx): one sample; the answer to a unit step is :meth:`step_response`."""
        return self.model.step(x, u)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state (..., nx) after an output was seen."""
        return self.model.correct(x, u, y)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return self.model.to_dict()

    def __getattr__(self, name: str) -> Any:
        """Return what the model has beside (``parameters``, ``a_matrix``, ``free_run``, ...)."""
        if name.startswith("__") or name == "model":
            raise AttributeError(name)
        if isinstance(own := getattr(type(self), name, None), property):
            return own.__get__(self)  # it was refused, and is again, in its own words
        return getattr(self.model, name)

    def __repr__(self) -> str:
        found = self.estimate
        return f"<{type(self.model).__name__}: {self.spec}{'' if found is None else f'; {found}'}>"

    def _repr_html_(self) -> str:
        from harness.display import page, table

        found = self.estimate
        rows = []
        for name, unit, value in () if found is None else zip(found.names, found.units, found.values, strict=True):
            spread = found.deviation(name) if found is not None else None
            rows.append((name, f"{value:.6g}", "" if spread is None else f"{spread:.2g}", unit))
        shown = [table(["parameter", "value", "standard deviation", "unit"], rows)] if rows else []
        return page(f"{type(self.model).__name__}: {self.spec}", *shown)


def load_model(name: str | Path, **options: Any) -> Any:
    """Return a fitted model from its file, or a physical model by its name.

    Parameters
    ----------
    name : str or path
        ``model.json`` that ``identify`` wrote, or the folder of ``close_loop``: a :class:`FittedModel`. Anything else
        names a definition (``pendulum``, ``FILE.urdf``, ``FILE.py:NAME``): a :class:`harness.physics.System`.
    **options
        Of a definition.

    Raises
    ------
    InputError
        If there is no such model, a file is none, or names code that is not trusted (:func:`harness.trusting`).

    Examples
    --------
    >>> load_model("pendulum").name
    'pendulum'
    """
    path = Path(name)
    if path.suffix == ".json" or path.is_dir():
        from harness.parts.stored import read_model

        return FittedModel(read_model(path))
    from harness.physics import load_model as definition

    return definition(str(name), **options)


def _with_matrices(model: Any, moved: Callable[[Matrices], Matrices], spec: PlantSpec, level: FloatArray) -> Any:
    """Return a linear model with other matrices, its neighbours moved as it is; nothing corrects its state."""
    a, b, c, d = moved(model.matrices)
    near = []
    for one in [] if model.spread is None else model.spread.models:
        try:
            near.append(moved(one))
        except InputError:  # a neighbour that cannot be moved: no interval is known
            near = []
            break
    spread = None
    if near and all(one[0].shape == a.shape for one in near):
        stacks = [np.array([one[k] for one in near]) for k in range(4)]
        spread = replace(model.spread, a=stacks[0], b=stacks[1], c=stacks[2], d=stacks[3])
    nx, ny = len(a), spec.ny
    return replace(
        model, spec=spec, a_matrix=a, b_matrix=b, c_matrix=c, d_matrix=d, filter_gain=np.zeros((nx, ny)),
        state_offset=np.zeros(nx), output_offset=level, burn_in=0, spread=spread,
        notes={key: value for key, value in model.notes.items() if key != "estimate"},
    )  # fmt: skip


def _is_array(data: Any) -> bool:
    """Return True for plain numbers, False for a record."""
    return isinstance(data, list | tuple) or (isinstance(data, np.ndarray) and data.dtype.names is None)
