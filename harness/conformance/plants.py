"""Checks of plants: they repeat, step in the declared shapes, and have the abilities that they declare."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.conformance.excitation import inputs_for
from harness.conformance.results import Broken, Check, CheckResult, NotApplicable, demand, run_checks
from harness.conformance.running import globals_untouched, seeded
from harness.errors import HarnessError, PlantError
from harness.protocols import Batch, BatchTruth, Feedthrough, Plant, Snapshots, Truth
from harness.signals import Channel, FloatArray, PlantSpec
from harness.units import fits

if TYPE_CHECKING:
    from collections.abc import Iterator

Factory = Callable[[], Any]


def check_plant(factory: Factory, *, expected_failures: Mapping[str, str] | None = None) -> list[CheckResult]:
    """Hold a plant to its contract.

    Parameters
    ----------
    factory : callable
        Returns a fresh plant each time; a class will do. Every plant is closed after its check.
    expected_failures : mapping, optional
        Name of a check to the reason why it is known to fail; strict.
    """
    return run_checks(plant_checks(), factory, expected_failures=expected_failures)


def plant_checks() -> list[Check]:
    """Return the checks of a plant, for ``pytest.mark.parametrize``.

    Examples
    --------
    >>> "snapshot_equals_replay" in [check.name for check in plant_checks()]
    True
    """
    return [
        Check("interface", "spec, abilities, reset, step, close, context manager; known units", _interface),
        Check("abilities", "what is declared is there, and feedthrough agrees with the spec", _abilities),
        Check("step_shapes", "float64 outputs of shape (ny,), finite, not overwritten later", _shapes),
        Check("inputs_matter", "every input changes an output, in time", _inputs_matter),
        Check("instances_apart", "two plants do not move each other", _apart),
        Check("reset_repeats", "the same rng gives the same run, on the same plant and on a fresh one", _repeats),
        Check("arguments_left_alone", "inputs are neither changed nor kept", _arguments),
        Check("bad_input_refused", "a wrong shape or NaN is refused by name", _bad_input),
        Check("unknown_x0_refused", "an unknown initial state is refused by name", _bad_x0),
        Check("x0_taken", "a named initial state is where the run begins", _x0_taken),
        Check("snapshot_equals_replay", "a restored state continues as it did", _snapshot),
        Check("batch_equals_stepping", "rollout gives what step gives", _batch),
        Check("batch_truth_equals_stepping", "rollout_truth gives what step and truth give", _batch_truth),
        Check("feedthrough_output_pure", "output(u) lets no time pass", _feedthrough),
        Check("truth", "the true state has its declared shape and lets no time pass", _truth),
        Check("closes_twice", "close may be called again, and with closes", _closes),
    ]


@contextmanager
def _made(factory: Factory, ability: str = "") -> Iterator[Any]:
    """Return a fresh plant and close it; what asks for an ability says nothing of a plant without it."""
    plant = factory()
    try:
        if ability and ability not in plant.abilities:
            raise NotApplicable(f"the ability {ability!r} is not declared")
        yield plant
    finally:
        close = getattr(plant, "close", None)
        if callable(close):
            close()


def _run(plant: Any, inputs: FloatArray, seed: int = 0) -> FloatArray:
    """Return the outputs (N, ny) of a run from reset."""
    rows = [np.array(plant.reset(rng=seeded(seed)), dtype=float)]
    rows += [np.array(plant.step(u), dtype=float) for u in inputs[:-1]]
    return np.array(rows)


def _interface(factory: Factory) -> None:
    with _made(factory) as plant:
        demand(isinstance(plant, Plant), f"{type(plant).__name__} lacks a member of the Plant protocol")
        demand(isinstance(plant.spec, PlantSpec), "spec is no PlantSpec")
        for channel in (*plant.spec.inputs, *plant.spec.outputs, *plant.spec.states):
            fits(channel.unit, "1")  # refuses a unit that is none
        demand(plant.spec == plant.spec, "spec changes while one looks")


def _abilities(factory: Factory) -> None:
    protocols = {
        "snapshots": Snapshots,
        "feedthrough": Feedthrough,
        "batch": Batch,
        "truth": Truth,
        "batch-truth": BatchTruth,
    }
    with _made(factory) as plant:
        declared = plant.abilities
        demand(isinstance(declared, frozenset), f"abilities is a {type(declared).__name__}, expected a frozenset")
        unknown = sorted(set(declared) - set(protocols))
        demand(not unknown, f"unknown abilities {unknown}, expected among {sorted(protocols)}")
        for name in declared:
            demand(
                isinstance(plant, protocols[name]),
                f"declares {name!r} without the methods of {protocols[name].__name__}",
            )
        demand(
            ("feedthrough" in declared) == plant.spec.feedthrough,
            f"spec.feedthrough is {plant.spec.feedthrough}, and the ability is {'feedthrough' in declared}",
        )
        demand("truth" not in declared or plant.spec.states, "declares 'truth' and names no states")
        demand(
            "batch-truth" not in declared or {"batch", "truth"} <= declared,
            "declares 'batch-truth' without both 'batch' and 'truth'",
        )


def _shapes(factory: Factory) -> None:
    with _made(factory) as plant:
        ny = plant.spec.ny
        inputs = inputs_for(plant.spec)
        outputs = [plant.reset(rng=seeded())]
        copies = [np.array(outputs[0])]
        for u in inputs[:20]:
            outputs.append(plant.step(u))
            copies.append(np.array(outputs[-1]))
        for k, (y, was) in enumerate(zip(outputs, copies, strict=True)):
            demand(isinstance(y, np.ndarray) and y.dtype == np.float64, f"output {k} is no float64 array")
            demand(y.shape == (ny,), f"output {k} has shape {y.shape}, expected ({ny},)")
            demand(np.isfinite(was).all(), f"output {k} is not finite")
            demand(np.array_equal(y, was), f"output {k} was overwritten by a later step")


def _repeats(factory: Factory) -> None:
    with _made(factory) as plant:
        inputs = inputs_for(plant.spec)
        with globals_untouched():
            first, second = _run(plant, inputs), _run(plant, inputs)
        demand(np.array_equal(first, second), f"a second run differs by {np.abs(first - second).max():.3g}")
    with _made(factory) as plant:
        third = _run(plant, inputs)
        demand(np.array_equal(first, third), f"a fresh plant differs by {np.abs(first - third).max():.3g}")


def _inputs_matter(factory: Factory) -> None:
    with _made(factory) as plant:
        if not plant.spec.nu:
            raise NotApplicable("it has no inputs")
        base = inputs_for(plant.spec)
        other = inputs_for(plant.spec, seed=2)
        reference = _run(plant, base)
        for column, channel in enumerate(plant.spec.inputs):
            changed = base.copy()
            changed[:, column] = other[:, column]
            if np.array_equal(changed, base):
                continue
            off, scale = np.abs(_run(plant, changed) - reference).max(), np.abs(reference).max() or 1.0
            demand(off > 1e-12 * scale, f"input {channel.name} changes no output")


def _apart(factory: Factory) -> None:
    with _made(factory) as first, _made(factory) as second:
        inputs, others = inputs_for(first.spec, 20), inputs_for(first.spec, 20, seed=2)
        reference = _run(first, inputs)
        first.reset(rng=seeded())
        second.reset(rng=seeded(1))
        rows = []
        for u, v in zip(inputs[:-1], others[:-1], strict=True):
            rows.append(np.array(first.step(u)))
            second.step(v)
        demand(np.array_equal(np.array(rows), reference[1:]), "a second plant of this kind moves the first")


def _arguments(factory: Factory) -> None:
    with _made(factory) as plant:
        inputs = inputs_for(plant.spec, 20)
        reference = _run(plant, inputs)
        plant.reset(rng=seeded())
        rows = []
        for u in inputs[:-1]:
            mine = u.copy()
            rows.append(np.array(plant.step(mine)))
            demand(np.array_equal(mine, u), "step changes the input it was given")
            mine[:] = 1e3
        demand(np.array_equal(np.array(rows), reference[1:]), "step keeps the input array and reads it later")


def _bad_input(factory: Factory) -> None:
    with _made(factory) as plant:
        good = inputs_for(plant.spec, 2)[0]
        bad: list[tuple[str, Any]] = [("one value too many", np.append(good, 0.0))]
        if plant.spec.nu:
            bad += [
                ("NaN", np.full_like(good, np.nan)),
                ("infinity", np.full_like(good, np.inf)),
                ("no values", good[:0]),
            ]
        for what, u in bad:
            plant.reset(rng=seeded())
            try:
                plant.step(u)
            except HarnessError:
                continue
            except Exception as error:
                raise Broken(f"{what} raises {type(error).__name__}: {error}; expected an InputError") from error
            raise Broken(f"{what} is accepted as input; expected an InputError")
        plant.reset(rng=seeded())
        plant.step(good)


def _bad_x0(factory: Factory) -> None:
    with _made(factory) as plant:
        for what, x0 in (("an unknown initial state", {"no such state": 1.0}),):
            try:
                plant.reset(rng=seeded(), x0=x0)
            except HarnessError:
                continue
            except Exception as error:
                raise Broken(f"{what} raises {type(error).__name__}: {error}; expected an InputError") from error
            raise Broken(f"{what} is accepted; expected an InputError")


def _x0_taken(factory: Factory) -> None:
    """Each true state that may be set is set: the truth says so, or else the outputs differ.

    States that a constraint binds to each other may need to be set together.
    """
    with _made(factory) as plant:
        names = [channel.name for channel in plant.spec.states]
        if not names:
            raise NotApplicable("it names no states")
        tells = "truth" in plant.abilities
        taken, refused = [], []
        inputs = inputs_for(plant.spec, 20)
        reference = _run(plant, inputs)
        for i, channel in enumerate(plant.spec.states):
            plant.reset(rng=seeded())
            value = _elsewhere(channel, float(plant.truth()[i]) if tells else 0.0)
            try:
                start = np.array(plant.reset(rng=seeded(), x0={channel.name: value}))
            except HarnessError:
                refused.append(channel.name)
                continue
            if tells:
                got = float(plant.truth()[i])
                demand(
                    _near(got, value) or _bound(plant),
                    f"x0 sets {channel.name} = {value:g}, and the run begins at {got:g}",
                )
            rows = np.array([start, *(np.array(plant.step(u)) for u in inputs[:-1])])
            if not np.array_equal(rows, reference):
                taken.append(channel.name)
        if len(refused) == len(names):
            raise NotApplicable("none of its states can be set")
        demand(taken, "setting the initial state changes no output of a run")


def _near(got: float, wanted: float) -> bool:
    return abs(got - wanted) <= 1e-6 * max(1.0, abs(wanted))


def _bound(plant: Any) -> bool:
    """Return True if all states are taken when all are moved by the same amount; the plant is left as it was."""
    kept = {channel.name: float(x) for channel, x in zip(plant.spec.states, plant.truth(), strict=True)}
    moved = {name: x + 0.05 for name, x in kept.items()}
    plant.reset(rng=seeded(), x0=moved)
    taken = all(_near(float(x), moved[c.name]) for c, x in zip(plant.spec.states, plant.truth(), strict=True))
    plant.reset(rng=seeded(), x0=kept)
    return taken


def _elsewhere(channel: Channel, now: float) -> float:
    """Return another value that a state can have, near the present one."""
    if channel.kind == "category":
        return float((int(now) + 1) % channel.categories)
    low, high = channel.minimum, channel.maximum
    step = 0.05 if not (np.isfinite(low) and np.isfinite(high)) else 0.05 * (high - low)
    return now + step if now + step <= high else now - step


def _snapshot(factory: Factory) -> None:
    with _made(factory, "snapshots") as plant:
        tolerance = float(getattr(plant, "snapshot_tolerance", 0.0))
        inputs = inputs_for(plant.spec)
        reference = _run(plant, inputs)
        plant.reset(rng=seeded())
        for u in inputs[:20]:
            plant.step(u)
        state = plant.get_state()
        for repeat in range(3):
            rows = np.array([plant.step(u) for u in inputs[20:-1]])
            off = np.abs(rows - reference[21:]).max()
            demand(
                off <= tolerance,
                f"continuation {repeat} differs from an uninterrupted run by {off:.3g}, "
                + (
                    f"beyond its snapshot_tolerance {tolerance:g}"
                    if tolerance
                    else "and no snapshot_tolerance is declared"
                ),
            )
            plant.set_state(state)
        plant.reset(rng=seeded())
        plant.set_state(state)
        off = np.abs(np.array([plant.step(u) for u in inputs[20:-1]]) - reference[21:]).max()
        demand(off <= tolerance, f"a state set after a reset continues {off:.3g} off")


def _batch(factory: Factory) -> None:
    with _made(factory, "batch") as plant:
        inputs = inputs_for(plant.spec)
        reference = _run(plant, inputs)
        plant.reset(rng=seeded())
        first = np.array(plant.rollout(inputs[:25]))
        remaining = np.array(plant.rollout(inputs[25:-1]))
        demand(
            first.shape == (25, plant.spec.ny), f"rollout returns shape {first.shape}, expected (25, {plant.spec.ny})"
        )
        off = np.abs(np.vstack([first, remaining]) - reference[1:]).max()
        demand(off == 0.0, f"rollout differs from stepping by {off:.3g}")


def _batch_truth(factory: Factory) -> None:
    with _made(factory, "batch-truth") as plant:
        inputs = inputs_for(plant.spec)[:-1]
        plant.reset(rng=seeded())
        pairs = [(np.array(plant.step(u)), np.array(plant.truth())) for u in inputs]
        plant.reset(rng=seeded())
        parts = [plant.rollout_truth(inputs[:25]), plant.rollout_truth(inputs[25:])]
        for what, row, size in (("outputs", 0, plant.spec.ny), ("true states", 1, len(plant.spec.states))):
            shape = np.shape(parts[0][row])
            demand(shape == (25, size), f"rollout_truth returns {what} of shape {shape}, expected (25, {size})")
            off = np.abs(np.vstack([part[row] for part in parts]) - np.array([pair[row] for pair in pairs])).max()
            demand(off == 0.0, f"{what} of rollout_truth differ from stepping by {off:.3g}")


def _feedthrough(factory: Factory) -> None:
    with _made(factory, "feedthrough") as plant:
        inputs = inputs_for(plant.spec)
        reference = _run(plant, inputs)
        plant.reset(rng=seeded())
        for k, u in enumerate(inputs[:-1]):
            first, second = np.array(plant.output(u)), np.array(plant.output(u))
            plant.output(inputs[-1])
            demand(np.array_equal(first, second), "output(u) answers differently the second time")
            demand(first.shape == (plant.spec.ny,), f"output has shape {first.shape}, expected ({plant.spec.ny},)")
            demand(np.array_equal(plant.step(u), reference[k + 1]), "output(u) changes what follows: time passed")


def _truth(factory: Factory) -> None:
    with _made(factory, "truth") as plant:
        inputs = inputs_for(plant.spec)
        reference = _run(plant, inputs)
        plant.reset(rng=seeded())
        for k, u in enumerate(inputs[:20]):
            x = np.array(plant.truth())
            demand(
                x.shape == (len(plant.spec.states),), f"truth has shape {x.shape}, expected ({len(plant.spec.states)},)"
            )
            demand(np.isfinite(x).all(), "the true state is not finite")
            demand(np.array_equal(x, plant.truth()), "the truth changes while one looks")
            demand(np.array_equal(plant.step(u), reference[k + 1]), "asking for the truth changes what follows")


def _closes(factory: Factory) -> None:
    plant = factory()
    with plant as entered:
        demand(entered is plant, "__enter__ returns something else than the plant")
        plant.reset(rng=seeded())
    plant.close()
    plant.close()
    try:
        plant.reset(rng=seeded())
        plant.close()
    except (HarnessError, PlantError):
        return
    except Exception as error:
        raise Broken(
            f"reset after close raises {type(error).__name__}: {error}; expected a HarnessError or a run"
        ) from error
