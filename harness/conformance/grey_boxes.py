"""Checks of nominal models and of effects: they compose, they roll out, they vanish where they say so."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from harness.conformance.results import Check, CheckResult, NotApplicable, demand, run_checks
from harness.errors import HarnessError
from harness.signals import FloatArray
from harness.units import fits

Factory = Callable[[], Any]
HOSTS = ("pendulum", "cart-pole", "drive", "oscillator", "two-tanks")
N, DT = 200, 0.01


def check_model(factory: Factory, *, expected_failures: Mapping[str, str] | None = None) -> list[CheckResult]:
    """Hold a nominal model to its contract.

    Parameters
    ----------
    factory : callable
        Returns a Mechanism, an Ode or a System.
    expected_failures : mapping, optional
        Name of a check to the reason why it is known to fail; strict.
    """
    return run_checks(model_checks(), factory, expected_failures=expected_failures)


def check_effect(factory: Factory, *, expected_failures: Mapping[str, str] | None = None) -> list[CheckResult]:
    """Hold an effect to its contract.

    Parameters
    ----------
    factory : callable
        Returns the effect.
    expected_failures : mapping, optional
        Name of a check to the reason why it is known to fail; strict.
    """
    return run_checks(effect_checks(), factory, expected_failures=expected_failures)


def model_checks() -> list[Check]:
    """Return the checks of a nominal model, for ``pytest.mark.parametrize``.

    Examples
    --------
    >>> [check.name for check in model_checks()]
    ['builds', 'ports_and_units', 'rolls_out', 'sensitivities', 'pickles']
    """
    return [
        Check("builds", "a Mechanism, an Ode or a System comes of it", _builds),
        Check("ports_and_units", "known units, parameters within their bounds", _ports),
        Check("rolls_out", "a finite rollout at the nominal parameters", _rolls_out),
        Check("sensitivities", "equal to finite differences", _sensitivities),
        Check("pickles", "the model travels to another process", _pickles),
    ]


def effect_checks() -> list[Check]:
    """Return the checks of an effect, for ``pytest.mark.parametrize``.

    Examples
    --------
    >>> [check.name for check in effect_checks()]
    ['described', 'fits_a_port', 'composes', 'acts', 'vanishes', 'sensitivities', 'pickles']
    """
    return [
        Check("described", "summary, formula, separating experiment, parameters with units and bounds", _described),
        Check("fits_a_port", "it can be placed in a built-in model", _fits_a_port),
        Check("composes", "the composed model rolls out to finite outputs", _composes),
        Check("acts", "it changes the outputs at its usual size", _acts),
        Check("vanishes", "at its neutral values it changes nothing", _vanishes),
        Check("sensitivities", "equal to finite differences where the effect is smooth", _effect_sensitivities),
        Check("pickles", "the effect travels to another process", _effect_pickles),
    ]


def _system(made: Any) -> Any:
    """Return the System of a Mechanism or an Ode."""
    return made.system() if hasattr(made, "system") else made


def _demand_system(factory: Factory) -> Any:
    from harness.physics import System

    system = _system(factory())
    demand(isinstance(system, System), f"it gives a {type(system).__name__}, expected a Mechanism, an Ode or a System")
    return system


def _builds(factory: Factory) -> None:
    _demand_system(factory)


def _ports(factory: Factory) -> None:
    system = _demand_system(factory)
    for channel in (*system.inputs, *system.outputs, *system.states):
        fits(channel.unit, "1")
    names = list(system.parameter_names)
    demand(len(set(names)) == len(names), f"parameters share a name: {names}")
    for parameter in system.parameters:
        fits(parameter.unit, "1")
    demand(system.outputs, "there is no output")


def _inputs(system: Any, samples: int = N, scale: float = 1.0) -> FloatArray:
    rng = np.random.default_rng(3)
    return scale * np.repeat(rng.uniform(0.2, 1.0, size=(samples // 10, system.nu)), 10, axis=0)


def _start(system: Any, scale: float = 1.0) -> FloatArray:
    """Return an initial state off the rest position; hidden states at 0."""
    x0 = np.zeros(system.nx)
    visible = system.nx - system.hidden_count
    x0[:visible] = scale * (0.3 + 0.1 * np.arange(visible))
    return x0


def _rollout(
    system: Any, values: Mapping[str, float] | None = None, samples: int = N, scale: float = 1.0
) -> FloatArray:
    simulator = system.simulator(DT, backend="casadi")
    start, inputs = _start(system, scale), _inputs(system, samples, scale)
    return np.asarray(simulator.rollout(system.vector(values), start, inputs), dtype=float)


def _rolls_out(factory: Factory) -> None:
    system = _demand_system(factory)
    y = _rollout(system)
    demand(y.shape == (N, system.ny), f"the rollout has shape {y.shape}, expected ({N}, {system.ny})")
    demand(np.isfinite(y).all(), "the rollout at the nominal parameters is not finite")


def _compare_sensitivities(system: Any, tolerance: float) -> None:
    simulator = system.simulator(DT, backend="casadi")
    p, x0, u = system.vector(), _start(system), _inputs(system)
    y, by_p, _ = simulator.sensitivities(p, x0, u)
    scale = np.abs(np.asarray(y) - np.asarray(y)[0]).max() or 1.0
    for i, name in enumerate(system.parameter_names):
        step = 1e-5 * max(abs(p[i]), 1e-2)
        high, low = p.copy(), p.copy()
        high[i] += step
        low[i] -= step
        expected = (simulator.rollout(high, x0, u) - simulator.rollout(low, x0, u)) / (2 * step)
        off = np.abs(np.asarray(by_p)[..., i] - expected).max()
        limit = tolerance * (np.abs(expected).max() + 1e-6 * scale / step)
        demand(
            off <= limit,
            f"the sensitivity to {name} is {off:.3g} off finite differences (allowed {limit:.3g})",
        )


def _sensitivities(factory: Factory) -> None:
    _compare_sensitivities(_demand_system(factory), 1e-3)


def _pickles(factory: Factory) -> None:
    system = _demand_system(factory)
    copy = pickle.loads(pickle.dumps(system))
    demand(np.array_equal(_rollout(system), _rollout(copy)), "a pickled model rolls out differently")


def _effect(factory: Factory) -> Any:
    from harness.effects import Effect

    made = factory()
    if callable(made) and not isinstance(made, Effect):
        made = made()
    demand(isinstance(made, Effect), f"a {type(made).__name__} comes of it, expected an Effect (write it with @effect)")
    return made


def _described(factory: Factory) -> None:
    made = _effect(factory)
    for what in ("summary", "formula", "experiment"):
        demand(getattr(made, what), f"{what} is empty: the report needs it")
    demand(made.name.isidentifier(), f"the name {made.name!r} is no identifier")
    for parameter in made.parameters:
        demand(parameter.minimum <= parameter.maximum, f"empty bounds of {parameter.name}")
        value = parameter.start({})
        demand(
            np.isfinite(value) and parameter.minimum <= value <= parameter.maximum,
            f"{parameter.name} starts at {value}, outside its bounds",
        )


def _hosts(factory: Factory) -> list[tuple[Any, Any]]:
    """Return (system, placed) for every place in a built-in model."""
    from harness.effects import place_all
    from harness.physics import load_model

    made, found = _effect(factory), []
    for system in (*map(load_model, HOSTS), _with_a_temperature()):
        found += [(system, placed) for placed in place_all(system, [made])]
    demand(found, f"it fits no port of {', '.join(HOSTS)}, nor of an oscillator whose temperature is measured")
    return found


def _with_a_temperature() -> Any:
    """Return an oscillator whose temperature is measured: the host of laws that depend on one."""
    from harness.physics.symbolic.mechanism import Mechanism

    m = Mechanism("warm oscillator", q="q", u="u temperature", p="m c k", units={"u": "N", "temperature": "K"})
    m.body(m.p[0], (m.q[0], 0), weight=0)
    m.V = m.p[2] * m.q[0] ** 2 / 2
    m.Q = [m.u[0] - m.p[1] * m.v[0]]
    m.parameters(m=("kg", 1.0), c=("N s/m", 0.1), k=("N/m", 1.0))
    return m.system()


def _fits_a_port(factory: Factory) -> None:
    _hosts(factory)


def _composed(factory: Factory) -> list[tuple[Any, Any, Any]]:
    from harness.effects import compose

    return [(system, placed, compose(system, [placed])) for system, placed in _hosts(factory)[:4]]


def _composes(factory: Factory) -> None:
    for system, placed, whole in _composed(factory):
        y = _rollout(whole)
        demand(np.isfinite(y).all(), f"{system.name} with {placed} does not roll out to finite outputs")


def _acts(factory: Factory) -> None:
    # small and short first; a payload that comes late, or a limit far out, needs more
    for samples, scale in ((N, 1.0), (1200, 1.0), (N, 30.0), (1200, 30.0)):
        for system, _, whole in _composed(factory):
            without, with_it = (_rollout(shown, None, samples, scale) for shown in (system, whole))
            if not np.array_equal(without, with_it, equal_nan=True):
                return
    demand(False, "it changes no output of any built-in model at its usual size")


def _vanishes(factory: Factory) -> None:
    from harness.effects import compose

    made = _effect(factory)
    neutral = made.neutral()
    if neutral is None:
        raise NotApplicable("it has no neutral values")
    for system, placed in _hosts(factory)[:4]:
        try:
            whole = compose(system, [placed.with_values(neutral)])
            off = np.abs(_rollout(whole) - _rollout(system)).max()
        except HarnessError as error:
            raise NotApplicable(f"the neutral values cannot be set: {error}") from error
        demand(
            off <= 1e-6 * (1 + np.abs(_rollout(system)).max()), f"at {neutral} it changes {system.name} by {off:.3g}"
        )


def _effect_sensitivities(factory: Factory) -> None:
    made = _effect(factory)
    if made.sampled or not made.linearises:
        raise NotApplicable("it acts on samples, or has a hidden resonance")
    _, _, whole = _composed(factory)[0]
    _compare_sensitivities(whole, 5e-2)


def _effect_pickles(factory: Factory) -> None:
    made = _effect(factory)
    copy = pickle.loads(pickle.dumps(made))
    demand(copy.name == made.name and copy.parameters == made.parameters, "a pickled effect is another one")
