"""What to do when a step of an FMU ends in anything but plain success: go on, or say how it ended."""

from __future__ import annotations

from harness.errors import PlantError
from plants.fmu.engine import (
    FINE,
    GET_FAILED,
    INPUT_NOT_FINITE,
    OUTPUT_NOT_FINITE,
    SET_FAILED,
    STEP_FAILED,
    FmuEngine,
)
from plants.fmu.instance import LEVELS

OK, WARNING, DISCARD = 0, 1, 2
TERMINATED, LAST_SUCCESSFUL_TIME = 3, 2  # kinds of status (FMI 2.0.5 sec. 4.2.4)
ATTEMPTS = 10_000  # pieces of one step, before it counts as endless


def stopped(engine: FmuEngine) -> PlantError:
    """Return the error for the call that stopped the engine's loop."""
    loop = engine.loop
    if engine.error is not None:
        error, engine.error = engine.error, None
        return error
    t = loop.t0 + loop.k * loop.substeps * loop.h
    what = {
        SET_FAILED: "inputs cannot be set",
        STEP_FAILED: "the step failed",
        GET_FAILED: "outputs cannot be read",
        OUTPUT_NOT_FINITE: "an output is not finite",
        INPUT_NOT_FINITE: "the input is not finite",
    }.get(loop.what, "stopped")
    if loop.what in (OUTPUT_NOT_FINITE, INPUT_NOT_FINITE):
        return engine.instance.failure(f"{what} in the step from t = {t:g} s", status="diverged")
    level = LEVELS[loop.status] if 0 <= loop.status < len(LEVELS) else f"status {loop.status}"
    if level == "fatal":
        engine.instance.dead = True
    return engine.instance.failure(f"{what} in the step from t = {t:g} s ({level})")


def finish(engine: FmuEngine) -> None:
    """Bring an interrupted step to its end, so that ``engine.y`` and ``engine.loop.k`` are those of the next sample.

    Raises PlantError: ``terminated`` if the FMU ends the simulation, ``diverged`` for NaN, ``timeout`` for steps that
    are discarded without end, ``crashed`` for anything else.
    """
    loop = engine.loop
    if engine.error is not None or loop.what in (SET_FAILED, GET_FAILED, OUTPUT_NOT_FINITE, INPUT_NOT_FINITE):
        raise stopped(engine)
    status, sub, attempts, idle = int(loop.status), int(loop.sub), 0, 0
    t = loop.t0 + (loop.k * loop.substeps + sub) * loop.h
    end = t + loop.h
    while True:
        reached = _reached(engine, status, t, end)
        if reached >= end - 1e-9 * loop.h:
            sub += 1
            if sub == loop.substeps:
                break
            t = loop.t0 + (loop.k * loop.substeps + sub) * loop.h
            end = t + loop.h
        else:
            attempts += 1
            idle = idle + 1 if reached <= t else 0
            if attempts > ATTEMPTS or idle > 100:
                raise engine.instance.failure(f"the step from t = {t:g} s does not end", status="timeout")
            t = reached
        status = engine.step_once(t, end - t)
        loop.warnings += status == WARNING
    if engine.look() != FINE:
        raise stopped(engine)
    loop.k += 1


def _reached(engine: FmuEngine, status: int, t: float, end: float) -> float:
    """Return the time that a step over [t, end] has reached, or raise."""
    loop, instance = engine.loop, engine.instance
    if status > DISCARD or status < OK:
        loop.what, loop.status = STEP_FAILED, status
        raise stopped(engine)
    if loop.version == 3:
        if loop.terminate:
            raise instance.failure(f"the FMU ends the simulation at t = {loop.last:g} s", status="terminated")
        reached = end
        if status == DISCARD or loop.early:
            reached = float(loop.last)
            if status == DISCARD and not reached > t:
                raise instance.failure(f"the step from t = {t:g} s is discarded")
        if loop.event and instance.event_mode:
            instance.enter_events()
        return reached
    if status != DISCARD:
        return end
    if loop.version == 2 and _asked(engine, "getBooleanStatus", TERMINATED):
        last = _asked(engine, "getRealStatus", LAST_SUCCESSFUL_TIME)
        at = t if last is None else last
        raise instance.failure(f"the FMU ends the simulation at t = {at:g} s", status="terminated")
    last = _asked(engine, "getRealStatus", LAST_SUCCESSFUL_TIME)
    if last is None or not t < last <= end * (1 + 1e-12) + 1e-12:
        raise instance.failure(f"the step from t = {t:g} s is discarded")
    return last


def _asked(engine: FmuEngine, method: str, kind: int) -> float | None:
    """Return an answer of the FMU about its last step, or None if it gives none."""
    from fmpy.fmi1 import FMICallException

    try:
        value = getattr(engine.instance.fmu, method)(kind)
    except FMICallException:
        return None
    return float(getattr(value, "value", value))
