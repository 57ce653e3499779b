"""Checks of scenarios: the same stream gives the same experiment, roles differ, everything fits the plant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from harness.conformance.results import Broken, Check, CheckResult, NotApplicable, demand, run_checks
from harness.conformance.running import globals_untouched
from harness.errors import HarnessError
from harness.protocols import Experiment, Scenario
from harness.rng import Streams
from harness.signals import Channel, FloatArray, PlantSpec

Factory = Callable[[], Any]


def check_scenario(
    factory: Factory,
    *,
    specs: Sequence[PlantSpec] = (),
    expected_failures: Mapping[str, str] | None = None,
) -> list[CheckResult]:
    """Hold a scenario to its contract.

    Parameters
    ----------
    factory : callable
        Returns a fresh scenario each time; a class will do.
    specs : sequence of PlantSpec, optional
        Plants that it is made for, beside those that every scenario is tried on.
    expected_failures : mapping, optional
        Name of a check to the reason why it is known to fail; strict.
    """
    return run_checks(scenario_checks(specs), factory, expected_failures=expected_failures)


def scenario_checks(specs: Sequence[PlantSpec] = ()) -> list[Check]:
    """Return the checks of a scenario, for ``pytest.mark.parametrize``.

    Examples
    --------
    >>> [check.name for check in scenario_checks()][:5]
    ['interface', 'fits_the_plant', 'deterministic', 'roles_differ', 'noise_is_new']
    """
    # the factory is kept with what was found, so that its id stays its own
    cache: dict[int, tuple[Factory, list[PlantSpec]]] = {}

    def fitting(factory: Factory) -> list[PlantSpec]:
        if id(factory) not in cache:
            found, reasons = [], []
            for spec in (*specs, *_SPECS, *(() if specs else _registered_specs())):
                try:
                    _prepare(factory, spec)
                    found.append(spec)
                except HarnessError as error:
                    reasons.append(f"{spec}: {error}")
                if len(found) >= 4:
                    break
            demand(found, f"it refuses every plant ({'; '.join(reasons[:3])})")
            cache[id(factory)] = factory, found
        return cache[id(factory)][1]

    def on_all(body: Callable[[Factory, PlantSpec], None]) -> Callable[[Factory], None]:
        def hold(factory: Factory) -> None:
            idle: list[NotApplicable] = []
            for spec in fitting(factory):
                try:
                    body(factory, spec)
                except NotApplicable as error:
                    idle.append(error)
                except Broken as error:
                    raise Broken(f"{error} (plant: {spec})") from error
            if len(idle) == len(fitting(factory)):
                raise idle[0]

        return hold

    return [
        Check("interface", "prepare(spec, *, streams, role)", _interface),
        Check("fits_the_plant", "finite excitation and disturbance of shape (N, nu)", on_all(_fits)),
        Check("deterministic", "the same streams and role give the same run, in any order", on_all(_deterministic)),
        Check("roles_differ", "another role or seed gives another experiment", on_all(_roles)),
        Check("noise_is_new", "another role or seed has other sensor noise", on_all(_noise_is_new)),
        Check(
            "measures",
            "finite numbers of the right shape; the plant's output is left alone",
            on_all(_measures),
        ),
        Check("controls", "a controller answers with finite inputs and is fresh for each run", on_all(_controls)),
        Check("limits_kept", "open-loop excitation stays within the declared range", on_all(_limits)),
    ]


def _spec(inputs: Sequence[Channel], outputs: Sequence[Channel], dt: float = 0.01) -> PlantSpec:
    return PlantSpec(tuple(inputs), tuple(outputs), dt)


_SPECS = (
    _spec([Channel("u", "N m", -2.0, 2.0)], [Channel("theta", "rad")]),
    _spec([Channel("u0", "V"), Channel("u1", "V")], [Channel("y0", "m"), Channel("y1", "m")], 0.05),
    _spec([Channel("u", "N", -20.0, 20.0)], [Channel("x", "m"), Channel("theta", "rad")]),
    _spec([], [Channel("theta", "rad")]),
    _spec(
        [Channel("action", "1", 0.0, 2.0, kind="category")],
        [Channel("state", "1", 0.0, 4.0, kind="category")],
        1.0,
    ),
)


def _registered_specs() -> list[PlantSpec]:
    """Return the specs of the registered plants that need no options, for scenarios that fit only one kind of plant."""
    from harness import registry

    found = []
    for entry in registry.entries("plants"):
        try:
            with registry.create("plants", entry.id) as plant:
                found.append(plant.spec)
        except HarnessError:
            continue
    return found


def _prepare(factory: Factory, spec: PlantSpec, role: str = "estimation/0", seed: int = 0) -> Experiment:
    """Return an experiment; anything but a named refusal breaks the contract."""
    try:
        made: Experiment = factory().prepare(spec, streams=Streams("check", "scenario", seed), role=role)
    except HarnessError:
        raise
    except Exception as error:
        raise Broken(f"prepare raised {type(error).__name__}: {error}; only HarnessErrors may leave it") from error
    return made


def _outputs(experiment: Experiment, spec: PlantSpec) -> tuple[FloatArray, FloatArray]:
    """Return true outputs and what the experiment measures of them."""
    n = len(experiment.excitation)
    steps = np.arange(min(n, 50), dtype=float)[:, None]
    y = np.sin(0.1 * steps + np.arange(spec.ny))
    for i, channel in enumerate(spec.outputs):
        if channel.kind == "category":
            y[:, i] = steps[:, 0] % channel.categories
    return y, np.array([experiment.measure(k, row.copy()) for k, row in enumerate(y)])


def _interface(factory: Factory) -> None:
    scenario = factory()
    demand(isinstance(scenario, Scenario), f"{type(scenario).__name__} has no prepare(spec, *, streams, role)")


def _fits(factory: Factory, spec: PlantSpec) -> None:
    experiment = _prepare(factory, spec)
    demand(isinstance(experiment, Experiment), f"prepare returns a {type(experiment).__name__}, expected an Experiment")
    for name in ("excitation", "disturbance"):
        values = getattr(experiment, name)
        if values is None and name == "disturbance":
            continue
        values = np.asarray(values)
        demand(
            values.ndim == 2 and values.shape[1] == spec.nu and values.shape[0] >= 2,
            f"{name} has shape {values.shape}, expected (N >= 2, {spec.nu})",
        )
        demand(np.isfinite(values).all(), f"{name} is not finite")
    disturbance = experiment.disturbance
    demand(disturbance is None or len(disturbance) == len(experiment.excitation), "the disturbance has another length")


def _same(first: Experiment, second: Experiment, spec: PlantSpec) -> bool:
    """Return True if two experiments are the same in everything that can be seen."""
    if not np.array_equal(first.excitation, second.excitation):
        return False
    if (first.disturbance is None) != (second.disturbance is None):
        return False
    if first.disturbance is not None and second.disturbance is not None:
        if not np.array_equal(first.disturbance, second.disturbance):
            return False
    if dict(first.x0 or {}) != dict(second.x0 or {}):
        return False
    if not np.array_equal(_outputs(first, spec)[1], _outputs(second, spec)[1]):
        return False
    return bool(np.array_equal(_answers(first, spec), _answers(second, spec)))


def _answers(experiment: Experiment, spec: PlantSpec) -> FloatArray:
    """Return what the controller of an experiment answers (10, nu) near its initial state; it is used up by this."""
    if experiment.controller is None:
        return np.zeros((0, spec.nu))
    start = dict(experiment.x0 or {})
    y = np.array([start.get(channel.name, 0.0) + 0.01 for channel in spec.outputs])
    return np.array([np.asarray(experiment.controller(k * spec.sample_time, y)) for k in range(10)])


def _deterministic(factory: Factory, spec: PlantSpec) -> None:
    with globals_untouched():
        first = _prepare(factory, spec)
        scenario, streams = factory(), Streams("check", "scenario", 0)
        scenario.prepare(spec, streams=streams, role="validation/0")
        second = scenario.prepare(spec, streams=streams, role="estimation/0")
        same = _same(first, second, spec)
    demand(same, "the same streams and role give another experiment after another role was asked")


def _roles(factory: Factory, spec: PlantSpec) -> None:
    if not spec.nu:
        return
    base = _prepare(factory, spec)
    for other, what in ((_prepare(factory, spec, "validation/0"), "role"), (_prepare(factory, spec, seed=1), "seed")):
        demand(not _same(base, other, spec), f"another {what} gives the same run: held-out data would not be new")


def _noise_is_new(factory: Factory, spec: PlantSpec) -> None:
    """Demand that what is random in the measurement differs between roles and seeds."""
    base = _sensor(_prepare(factory, spec), spec)
    if not base.std(axis=0).any():
        raise NotApplicable("a plant at rest is measured without noise")
    for other, what in ((_prepare(factory, spec, "validation/0"), "role"), (_prepare(factory, spec, seed=1), "seed")):
        demand(
            not np.array_equal(base, _sensor(other, spec)[: len(base)]),
            f"another {what} has the same sensor noise: what is learned from one record is told about the other",
        )


def _sensor(experiment: Experiment, spec: PlantSpec) -> FloatArray:
    """Return what is measured (N, ny) of a plant that stands at 0."""
    count = min(len(experiment.excitation), 50)
    return np.array([np.asarray(experiment.measure(k, np.zeros(spec.ny)), dtype=float) for k in range(count)])


def _measures(factory: Factory, spec: PlantSpec) -> None:
    experiment = _prepare(factory, spec)
    y = np.zeros(spec.ny)
    kept = y.copy()
    measured = np.asarray(experiment.measure(0, y))
    demand(measured.shape == (spec.ny,), f"measure returns shape {measured.shape}, expected ({spec.ny},)")
    demand(np.array_equal(y, kept), "measure changes the plant's output in place")
    demand(np.isfinite(_outputs(experiment, spec)[1]).all(), "a measured value is not finite")


def _controls(factory: Factory, spec: PlantSpec) -> None:
    if _prepare(factory, spec).controller is None:
        return

    first, second = _answers(_prepare(factory, spec), spec), _answers(_prepare(factory, spec), spec)
    demand(first.shape == (10, spec.nu), f"the controller returns shape {first.shape[1:]}, expected ({spec.nu},)")
    demand(np.isfinite(first).all(), "the controller's answer is not finite")
    demand(np.array_equal(first, second), "the controller of a second run remembers the first")


def _limits(factory: Factory, spec: PlantSpec) -> None:
    experiment = _prepare(factory, spec)
    if experiment.controller is not None:
        return
    for i, channel in enumerate(spec.inputs):
        low, high = experiment.excitation[:, i].min(), experiment.excitation[:, i].max()
        demand(
            channel.minimum <= low and high <= channel.maximum,
            f"the excitation of {channel.name} reaches [{low:g}, {high:g}], its range is "
            f"[{channel.minimum:g}, {channel.maximum:g}]",
        )
