"""One model fitted: to records, to a frequency response, or the parameters of an FMU."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, Unpack, cast

from harness import registry
from harness.api.identified import Identified
from harness.api.records import load_dataset, named_columns
from harness.api.written import refuse_overwrite
from harness.data.whole_files import write_json
from harness.errors import HarnessError, InputError, PluginError
from harness.options import as_options
from harness.parts.files import is_system
from harness.protocols import Identifier, Model, Predictive
from harness.rng import stream
from harness.signals import Dataset, PlantSpec, Trajectory, Use
from harness.trust import names_fmu

if TYPE_CHECKING:
    from harness.calibration import Calibration
    from harness.data import Nominal
    from harness.data.recipe.chosen import Records
    from harness.frequency.identified import IdentifiedResponse
    from harness.models.analysis import Findings
    from harness.physics.definition.parameters import FarOff

T = TypeVar("T")

DEFAULT_IDENTIFIER = "prediction-error"
"""Where none is asked for: the state-space model of largest likelihood; order, dead times and noise by the data."""

UNDRIVEN_IDENTIFIER = "arx"
"""Where nothing drives the outputs either: least squares without start values, its order chosen on data held out."""


def default_identifier(spec: PlantSpec) -> str:
    """Return the id of the identifier that records of such channels get where none is asked for.

    Categories are counted: the transitions of one state, or of several that may depend on each other.

    Examples
    --------
    >>> from harness import Channel, PlantSpec
    >>> default_identifier(PlantSpec((Channel("u", "V"),), (Channel("y", "V"),), 0.1))
    'prediction-error'
    """
    if {channel.kind for channel in (*spec.inputs, *spec.outputs)} == {"category"}:
        return "mdp-counting" if spec.ny == 1 and spec.nu < 2 else "factored-counting"
    return DEFAULT_IDENTIFIER if spec.nu else UNDRIVEN_IDENTIFIER


def identify(
    dataset: Any,
    y: Any = None,
    *,
    identifier: str | None = None,
    options: Mapping[str, Any] | None = None,
    model: str | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    bounds: bool = False,
    force: bool = False,
    **records: Unpack[Records],
) -> Identified:
    """Fit one model to a data set, or to an input and an output, and score it on every use of the data.

    Parameters
    ----------
    dataset : path, table, records, or the input
        ``dataset.toml``, a table (CSV, Parquet, ..., or a DataFrame, an xarray Dataset, a mapping of arrays), a
        :class:`Trajectory` or several, a :class:`Dataset`; or, beside ``y``, the input alone.
    y : array (N,) or (N, ny), Series or DataFrame, optional
        Output, where the first argument is the input u, (N,) or (N, nu): ``u[k]`` is held on ``[t[k], t[k+1])``. Give
        ``sample_time`` [s] (an index of times that both share is read). Numbers count as they are.
    identifier : str, optional
        Id of a registered identifier; without a physical model :func:`default_identifier`.
    options : mapping, optional
        Its options.
    model : str, optional
        Nominal model that names the ports (needed for a bare CSV or Parquet file). An identifier that fits a physical
        model fits this one, or the one that the data set names, unless ``options`` say otherwise.
    out : path, optional
        JSON file for the model.
    seed : int
        For identifiers that draw random numbers.
    bounds : bool
        Put bounds for finite samples beside what was measured; of linear models (the analysis ``finite-sample``).
    force : bool
        Overwrite ``out`` if it exists.
    **records : Records
        ``validation``, ``undriven``, ``input``, ``output``, ``column``, ``unit``, ``sample_time``, ``gaps``, ``run``:
        as for :func:`harness.load_dataset`.

    Raises
    ------
    InputError
        If the data or the options cannot be used (``FitError`` if no model can be learned from them).

    Examples
    --------
    >>> import numpy as np
    >>> u = np.random.default_rng(0).standard_normal(400)
    >>> y = np.zeros(400)
    >>> for k in range(399):
    ...     y[k + 1] = 0.8 * y[k] + 0.5 * u[k]
    >>> identify(u, y, sample_time=0.1, options={"order": 1}).poles.round(3)
    array([0.8+0.j])
    """
    refuse_overwrite(out, force=force)
    from harness.scoring import Torques, equation_error, simulation_error
    from harness.scoring.predictive import probability_score

    if y is not None:
        dataset, records = _table_of(dataset, y, records)
    if identifier is None and model is not None:
        raise InputError(
            "no identifier for a physical model",
            expected="identifier = ... (sysid: --identifier), such as output-error",
            got=f"the model {model} alone",
            remedy="choose one (sysid list identifiers); of an FMU or an SSP name what is free: --free NAME,NAME",
        )
    if (
        identifier is not None
        and model is None
        and records.get("output") is None
        and hasattr(registry.load("identifiers", identifier), "channels")
    ):
        unfitted = registry.create("identifiers", identifier, **as_options(options))
        records = {**records, **named_columns(unfitted, dataset)}
    loaded = load_dataset(dataset, model=model, **records)
    data = loaded.dataset
    identifier = default_identifier(data.spec) if identifier is None else identifier
    made = registry.create("identifiers", identifier, **_with_model(identifier, as_options(options), loaded.nominal))
    if not isinstance(made, Identifier):
        raise InputError(
            f"identifier {identifier!r} cannot be fitted to a record",
            expected="an identifier with fit()",
            got=type(made).__name__,
            remedy="use it online in a benchmark suite, or choose another (sysid list identifiers)",
        )
    measured = [trajectory.measured() for trajectory in data.estimation]
    try:
        fitted = made.fit(measured, rng=stream("identify", identifier, seed))
    except HarnessError:
        raise
    except Exception as error:
        raise PluginError(f"identifier {identifier!r} raised {type(error).__name__}: {error}") from error
    if out is not None:
        write_json(Path(out), fitted.to_dict())
    return Identified(
        fitted,
        _by_use(data, functools.partial(equation_error, fitted)),
        _by_use(data, functools.partial(simulation_error, fitted)),
        (*_said(fitted), *data.warnings),
        _by_use(data, functools.partial(probability_score, fitted)) if isinstance(fitted, Predictive) else {},
        next(iter((*data.validation, *data.estimation)), None),
        _bounds_beside(fitted, measured, identifier, seed) if bounds else None,
        _by_use(data, fitted.torque_errors) if isinstance(fitted, Torques) else {},
        data.recorded,
        _far_off(fitted),
    )


def _by_use(data: Dataset, scored: Callable[[Trajectory], T]) -> dict[Use, list[T]]:
    """Return what every run of a data set scores, by use."""
    uses: tuple[Use, ...] = ("estimation", "validation", "test")
    return {use: [scored(one) for one in data.using(use)] for use in uses}


def identify_response(
    data: Any,
    *,
    identifier: str = "transfer-function",
    options: Mapping[str, Any] | None = None,
    units: Mapping[str, str] | None = None,
    sample_time: float | None = None,
    low: float = 0.0,
    high: float = float("inf"),
    out: str | Path | None = None,
    force: bool = False,
) -> IdentifiedResponse:
    """Fit a transfer function to a measured frequency response.

    Parameters
    ----------
    data : path, FrequencyResponse or Spectrum
        A CSV file (:func:`harness.frequency.read_response`), or what :func:`spectrum` found.
    identifier : str
        One that fits frequency responses: ``"transfer-function"``.
    options : mapping, optional
        Its options.
    units : mapping, optional
        Units of inputs and outputs of a file, by name.
    sample_time : float, optional
        [s]; the model that is stored is then that between samples, for records of this sample time.
    low, high : float
        [Hz]; the rest is left out.
    out : path, optional
        JSON file for the model.
    force : bool
        Overwrite ``out`` if it exists.

    Raises
    ------
    InputError
        If the file or the options cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> from harness.frequency import FrequencyResponse
    >>> f = np.geomspace(0.01, 10, 30)
    >>> found = identify_response(FrequencyResponse(f, 3 / (2j * np.pi * f + 2)), options={"order": 1, "delay": 0.0})
    >>> print(found.model)
    y per u: 3 / (s + 2)
    """
    from harness.frequency import FrequencyResponse, read_response
    from harness.frequency.identified import IdentifiedResponse

    refuse_overwrite(out, force=force)
    if hasattr(data, "coherence"):
        data = FrequencyResponse.of_spectrum(data)
    elif not isinstance(data, FrequencyResponse):
        data = read_response(data, units=units)
    if low > 0 or high < float("inf"):
        data = data.between(low, high)
    made = registry.create("identifiers", identifier, **as_options(options))
    if not hasattr(made, "fit_response"):
        raise InputError(
            f"identifier {identifier!r} fits records, not frequency responses",
            expected="transfer-function",
            got=identifier,
            remedy="use transfer-function",
        )
    model = made.fit_response(data)
    found = IdentifiedResponse(data, model)
    if out is not None:
        stored = model if sample_time is None else model.sampled(sample_time, getattr(made, "hold", "zoh"))
        write_json(Path(out), stored.to_dict())
    return found


def calibrate(
    dataset: Any,
    *,
    model: str | Path,
    free: Sequence[str],
    bounds: Mapping[str, tuple[float, float]] | None = None,
    start: Mapping[str, float] | None = None,
    starts: int = 3,
    initial: str = "estimated",
    slopes: str = "differences",
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    ssv: str | Path | None = None,
    model_out: str | Path | None = None,
    force: bool = False,
    progress: Callable[[float, str], None] | None = None,
    **records: Unpack[Records],
) -> Calibration:
    """Fit parameters of an FMU or a system of FMUs to data (``sysid identify DATA --model X.fmu --free p1,p2``).

    Parameters
    ----------
    dataset
        As for :func:`identify`; columns are named after the model's inputs and outputs.
    model : path
        ``.fmu``, ``.ssp``, ``.ssd`` or an OSP structure. It runs in a process of its own.
    free : sequence of str
        Parameters to fit; of a system ``component.parameter``.
    bounds, start, starts, initial, slopes, seed, options
        See :func:`harness.calibration.calibrate`.
    out : path, optional
        JSON file with all that was found.
    ssv : path, optional
        SSV file for the calibrated values.
    model_out : path, optional
        Copy of the FMU or the SSP that starts from the calibrated values.
    force : bool
        Overwrite what exists.
    progress : callable, optional
        Called as ``progress(share, what)``.
    **records : Records
        As for :func:`identify`.

    Raises
    ------
    InputError
        If a name, a bound, the data or a file cannot be used (``FitError`` if the data tell nothing).
    PlantError
        If the model breaks at its own start values.

    Examples
    --------
    >>> import numpy as np
    >>> from harness import Trajectory, registry
    >>> from plants.mockups import mockup
    >>> with registry.create("plants", "mass-spring-fmu", sample_time=0.05, m=1.5, k=4.0) as plant:
    ...     u = np.repeat(np.random.default_rng(0).normal(size=(20, 1)), 10, axis=0)
    ...     y = np.vstack([plant.reset(rng=np.random.default_rng(0)), plant.rollout(u[:-1])])
    ...     record = Trajectory(np.arange(200) * 0.05, u, y, plant.spec)
    >>> found = calibrate(record, model=mockup("mass_spring"), free=["m", "k"], starts=1)
    >>> {name: round(value, 3) for name, value in found.parameters.items()}
    {'m': 1.5, 'k': 4.0}
    """
    from harness import calibration

    refuse_overwrite(out, ssv, model_out, force=force)
    name, system = str(model), is_system(str(model))
    if not (system or names_fmu(name)):
        raise InputError(
            "model to calibrate",
            expected="an FMU or a system of them (.fmu, .ssp, .ssd, OspSystemStructure.xml)",
            got=repr(name),
            remedy="a model of equations is fitted by --identifier output-error",
        )
    loaded = load_dataset(
        dataset, model=None if system else name, ports=calibration.ports_of_system(name) if system else None, **records
    )
    rates = [channel for channel, (_, times) in zip(loaded.dataset.spec.outputs, loaded.measured, strict=True) if times]
    if rates:
        raise InputError(
            "a derivative as an output",
            expected="variables of the model",
            got=", ".join(map(str, rates)),
            remedy="name the column after the model's own variable for it",
        )
    found = calibration.calibrate(
        name,
        loaded.dataset,
        free=free,
        bounds=bounds,
        start=start,
        starts=starts,
        initial=initial,
        slopes=slopes,
        seed=seed,
        options=options,
        progress=progress,
    )
    if out is not None:
        write_json(Path(out), found.to_dict())
    if ssv is not None:
        found.write_ssv(ssv)
    if model_out is not None:
        found.write_model(model_out)
    return found


def _table_of(u: Any, y: Any, records: Records) -> tuple[Any, Records]:
    """Return inputs and outputs that were given apart as a table, and what is said of its columns."""
    from harness.data.tables.memory import input_and_output

    table, names, others = input_and_output(u, y)
    if "input" in records or "output" in records:
        raise InputError(
            "input and output", expected="arrays u and y, or a table with input= and output=", got="both",
            remedy="leave out one",
        )  # fmt: skip
    return table, {**records, "input": names, "output": others}


def _bounds_beside(model: Model, records: Sequence[Trajectory], identifier: str, seed: int) -> Findings:
    """Return bounds for finite samples beside a model that was fitted to records."""
    made: Any = registry.create("analyses", "finite-sample", identifier=identifier)
    return cast("Findings", made.beside(model, records, rng=stream("bounds", identifier, seed)))


def _said(model: Model) -> tuple[str, ...]:
    """Return what the fit of a model warns of."""
    notes = getattr(model, "notes", None)
    warning = notes.get("warning") if isinstance(notes, Mapping) else None
    return (str(warning),) if warning else ()


def _far_off(model: Model) -> tuple[FarOff, ...]:
    """Return the parameters of a fitted physical model that lie far from what was declared; of another none."""
    from harness.models.estimate import estimate_of
    from harness.physics.definition.parameters import far_off

    system, found = getattr(model, "system", None), estimate_of(model)
    intervals = {} if found is None else {name: found.interval(name) or (0.0, 0.0) for name in found.names}
    return far_off(system().parameters, getattr(model, "parameters", {}), intervals) if callable(system) else ()


def _with_model(identifier: str, options: dict[str, Any], nominal: Nominal | None) -> dict[str, Any]:
    """Return the options of an identifier, with the nominal model of the data where it fits a model and names none."""
    if nominal is None or names_fmu(nominal.model):
        return options
    known = registry.named_options("identifiers", identifier)
    if "model" not in known or options.get("model") is not None:
        return options
    options["model"] = nominal.model
    if "options" in known and nominal.options:
        options.setdefault("options", dict(nominal.options))
    return options
