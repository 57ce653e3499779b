"""Checks of a fitted model: pure steps, batch axes, no look ahead, a description that can be stored and read."""

from __future__ import annotations

import json
import pickle
from typing import Any

import numpy as np

from harness.conformance.results import Broken, NotApplicable, demand
from harness.conformance.running import alike, one_step
from harness.errors import HarnessError
from harness.signals import Channel, PlantSpec, Trajectory


def burn_in(model: Any, data: Trajectory) -> None:
    """Demand a whole number of samples that leaves at least half of a record to be scored."""
    count = model.burn_in
    demand(isinstance(count, int | np.integer) and count >= 0, f"burn_in is {count!r}, expected 0, 1, 2, ...")
    demand(
        count <= len(data) / 2,
        f"a burn-in of {count} samples leaves too little to score of the record of {len(data)} that the model was "
        "fitted to the like of",
    )


def free_run_equals_steps(model: Any, data: Trajectory) -> None:
    """Demand that ``free_run`` gives what output and step give, for several starts at once."""
    if not callable(getattr(model, "free_run", None)):
        raise NotApplicable("the model has no free_run")
    u = np.stack([data.u[:20], data.u[10:30]])
    x = np.asarray(model.initial_state(data), dtype=float)
    starts = np.stack([x, np.asarray(model.step(model.correct(x, data.u[0], data.y[0]), data.u[0]), dtype=float)])
    with np.errstate(all="ignore"):
        together = np.asarray(model.free_run(starts, u))
        expected = np.empty((2, 20, data.spec.ny))
        for row, start in enumerate(starts):
            state = start
            for k in range(20):
                expected[row, k] = model.output(state, u[row, k])
                state = model.step(state, u[row, k])
    demand(together.shape == expected.shape, f"free_run returns shape {together.shape}, expected {expected.shape}")
    scale = 1.0 + float(np.nanmax(np.abs(data.y)))
    finite = np.isfinite(expected) & (np.abs(expected) < 1e3 * scale)  # beyond, rounding errors have grown too
    off = np.abs(together - expected)[finite]
    worst = float(np.nan_to_num(off, nan=np.inf).max(initial=0.0))
    demand(worst <= 1e-6 * scale, f"free_run differs from output and step by {worst:.3g}")


def pure_steps(model: Any, data: Trajectory) -> None:
    """Demand that output, step and correct change nothing and answer the same twice."""
    data = data.measured()
    x = np.asarray(model.initial_state(data), dtype=float)
    u, y = data.u[0].copy(), data.y[0].copy()
    copies = (x.copy(), u.copy(), y.copy())
    first = [np.array(v) for v in (model.output(x, u), model.step(x, u), model.correct(x, u, y))]
    model.initial_state(data[: max(len(data) // 2, 1)])
    model.step(model.correct(x, u, y), u)
    second = [np.array(v) for v in (model.output(x, u), model.step(x, u), model.correct(x, u, y))]
    for name, a, b in zip(("output", "step", "correct"), first, second, strict=True):
        demand(np.array_equal(a, b, equal_nan=True), f"{name} of a model answers differently the second time")
    demand(
        all(np.array_equal(a, b, equal_nan=True) for a, b in zip((x, u, y), copies, strict=True)),
        "a step of the model changes its arguments",
    )
    _remembers_nothing(model, data)
    demand(first[0].shape == (data.spec.ny,), f"output has shape {first[0].shape}, expected ({data.spec.ny},)")
    demand(first[1].shape == x.shape, f"step returns shape {first[1].shape}, expected that of the state {x.shape}")


def _remembers_nothing(model: Any, data: Trajectory) -> None:
    """Demand that the state carries everything: what the model was shown since makes no difference to it."""
    other = Trajectory(data.t, data.u[::-1], data.y[::-1], data.spec)
    x = np.asarray(model.initial_state(data), dtype=float)
    runs = []
    for shown in (data, other):
        model.initial_state(shown)
        state, rows = x.copy(), []
        for k in range(min(30, len(data))):
            rows.append(np.array(model.output(state, data.u[k])))
            state = model.step(state, data.u[k])
        runs.append(np.array(rows))
    demand(
        np.array_equal(runs[0], runs[1], equal_nan=True),
        "a simulation from one state depends on the record that the model was shown last: the future leaks",
    )


def batch_axes(model: Any, data: Trajectory) -> None:
    """Demand that leading axes work and give what single calls give."""
    data = data.measured()
    x = np.asarray(model.initial_state(data), dtype=float)
    states = [x]
    for k in range(min(5, len(data) - 1)):
        states.append(np.asarray(model.step(model.correct(states[-1], data.u[k], data.y[k]), data.u[k]), dtype=float))
    X, U, Y = np.array(states), data.u[: len(states)], data.y[: len(states)]
    for name, together, single in (
        ("output", model.output(X, U), [model.output(x, u) for x, u in zip(X, U, strict=True)]),
        ("step", model.step(X, U), [model.step(x, u) for x, u in zip(X, U, strict=True)]),
        ("correct", model.correct(X, U, Y), [model.correct(x, u, y) for x, u, y in zip(X, U, Y, strict=True)]),
    ):
        expected = np.array(single)
        demand(
            np.shape(together) == expected.shape,
            f"{name} of a batch has shape {np.shape(together)}, expected {expected.shape}",
        )
        limit = 1e-9 * (1 + float(np.nanmax(np.abs(expected), initial=0.0)))
        demand(
            np.allclose(together, expected, rtol=1e-9, atol=limit, equal_nan=True),
            f"{name} of a batch differs from single calls",
        )


def no_look_ahead(model: Any, data: Trajectory) -> None:
    """Demand that a prediction does not depend on the output it predicts, nor on any later one."""
    data = data.measured()
    half = len(data) // 2
    y = data.y.copy()
    y[half:] = y[half:][::-1] if not np.array_equal(y[half:], y[half:][::-1]) else y[half:] + 1.0
    changed = Trajectory(data.t, data.u, y, data.spec)
    prefix = min(max(int(model.burn_in), 1), half)
    # first over both whole records, so that a model that remembers what it was shown gives itself away
    model.initial_state(data)
    before = one_step(model, data, prefix=prefix)
    model.initial_state(changed)
    after = one_step(model, changed, prefix=prefix)
    demand(
        np.array_equal(before[: half + 1], after[: half + 1], equal_nan=True),
        "a prediction depends on an output that was not yet seen",
    )
    if len(data) - half > 10 and data.spec.outputs[0].kind == "real":
        exact = np.array_equal(before[half + 1 :], data.y[half + 1 :]) and np.array_equal(
            after[half + 1 :], changed.y[half + 1 :]
        )
        demand(not exact, "one-step predictions repeat the outputs that they should predict, whatever these are")


def stored_and_read(model: Any, data: Trajectory) -> None:
    """Demand that the model pickles, and that to_dict is JSON with a kind that a registered reader understands."""
    copy = pickle.loads(pickle.dumps(model))
    demand(alike(model, copy, data), "a pickled model predicts something else")
    content = model.to_dict()
    try:
        text = json.dumps(content, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise Broken(f"to_dict is not JSON: {error}") from error
    kind = content.get("kind") if isinstance(content, dict) else None
    demand(isinstance(kind, str) and kind, "to_dict has no 'kind'")
    from harness import registry

    known = {entry.id for entry in registry.entries("model_readers")}
    if kind not in known and not hasattr(type(model), "from_dict"):
        raise NotApplicable(
            f"no reader for models of kind {kind!r} is registered (sysid_harness.model_readers), so they can be stored "
            "and not read back"
        )
    reader = registry.load("model_readers", str(kind)) if kind in known else type(model)
    read = getattr(reader, "from_dict", reader)(json.loads(text))
    demand(alike(model, read, data, tolerance=1e-9), "a model read back from its JSON predicts something else")


def other_data_refused(model: Any, data: Trajectory) -> None:
    """Demand that data of another sample time or of other channels are refused, by the model or by its spec."""
    from harness.scoring import predict

    spec = data.spec
    demand(model.spec.sample_time == spec.sample_time, "the model's sample time is not that of its data")
    slower = PlantSpec(spec.inputs, spec.outputs, 2 * spec.sample_time, (), spec.feedthrough)
    foreign = PlantSpec(spec.inputs, (*spec.outputs, Channel("one more")), spec.sample_time, (), spec.feedthrough)
    wider = np.column_stack([data.y, data.y[:, :1]])
    for what, other in (
        ("another sample time", Trajectory(data.t * 2, data.u, data.y, slower)),
        ("other channels", Trajectory(data.t, data.u, wider, foreign)),
    ):
        try:
            predict(model, other)
        except HarnessError:
            continue
        raise Broken(f"data of {what} are accepted; expected an InputError")
