"""Any MJCF or URDF in MuJoCo as a plant."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import hypot, isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from harness.errors import InputError, PlantError, refuse_unknown
from harness.physics.arms.formats.mjcf_spec import mujoco
from harness.signals import FloatArray, PlantSpec
from plants.base import BasePlant
from plants.checking import checked_inputs, initial_values, refuse_input, with_fields
from plants.mujoco.settings import MujocoSettings, built, times
from plants.mujoco.signals import Inputs, Outputs, inputs_of, outputs_of, states_of

BLOCK = 4000  # Engine steps that a roll-out takes at once: their states are held in memory.


class MujocoPlant(BasePlant):
    """A robot in MuJoCo: an MJCF, or a URDF, by its path.

    The file says everything that no option says: timestep, integrator, solver, friction, actuators with their gears
    and delays, tendons, equality constraints, contact. Euler and the implicit integrators are of first order, ``rk4``
    of fourth order where nothing sticks or touches. Where a run diverges MuJoCo would begin anew in silence: here it
    ends with an error. Sensors are read after the step (MuJoCo's own are one step late).

    A URDF is read as MuJoCo reads it (``<mimic>`` becomes a soft equality constraint, floating and planar joints are
    joints), and with the rotors that a ``<transmission>`` states; its shapes are left out unless ``shapes`` is true.

    Parameters
    ----------
    model : str or Path
        A file, or the text of one. It may name files of its own folder only, or what is trusted.
    sample_time, timestep : float, optional
        Seconds between samples (default: ``substeps`` engine steps), and the engine's step (default: the file's, or the
        next smaller one that divides ``sample_time``; with ``sample_time`` and ``substeps``, their ratio).
    substeps : int, optional
        Engine steps for each sample.
    outputs : sequence of str
        Among ``q``, ``qd`` (all positions and rates), ``sensors`` (all of the file), names of sensors, names of states.
    actuators : sequence of str, optional
        Actuators that are inputs, by name; default all. The others hold their control of ``keyframe``, or 0.
    forces : sequence of str, optional
        Joints on which a torque [N m] or a force [N] is a further input; by default all of a model without actuators.
    joint_names, input_names : sequence of str, optional
        Names of the positions of joints that turn or slide (default ``q1``, ...; rates are called ``q1_rate``) and of
        the inputs (``tau1`` for a motor without gear, ``target1`` and ``rate1`` for servos, else the actuator's name).
    input_limit : float or sequence, optional
        Declared range of the inputs; by default the range of the control, to which MuJoCo clamps it.
    keyframe : str, optional
        Name of the keyframe from which runs start; default the reference position. None with ``locked``: a keyframe
        is of all joints.
    integrator : {"euler", "rk4", "implicit", "implicitfast"}, optional
    solver : {"pgs", "cg", "newton"}, optional
    cone : {"pyramidal", "elliptic"}, optional
    iterations : int, optional
        Most iterations of the solver of constraints.
    tolerance : float, optional
        At which it stops.
    gravity : float or (x, y, z), optional
        Along -z, or as a vector [m/s^2].
    contact, joint_limits : bool
        False turns them off.
    joint_damping, joint_friction, armature : float or sequence, optional
        Viscous [N m s/rad], dry [N m] and rotor inertia [kg m^2] of the joints that turn or slide.
    friction_time : float, optional
        Time constant [s] with which dry friction takes hold of a joint (MuJoCo's ``solreffriction``, 0.02 s unless the
        file says otherwise): a joint that should stick creeps, the less the shorter; at least two engine steps.
    locked : sequence of str
        Names of joints that are made rigid.
    shapes : bool, optional
        False leaves out the shapes of bodies whose inertia is stated, and meshes with them. Default: true for an MJCF,
        false for a URDF.

    Raises
    ------
    InputError
        If the file cannot be used, an option does not fit it, or ``mujoco`` is not installed.

    Examples
    --------
    >>> import importlib.util
    >>> if importlib.util.find_spec("mujoco"):
    ...     text = '''<mujoco><worldbody><body name="rod"><joint name="hinge" axis="0 1 0"/>
    ...         <inertial pos="0 0 -0.5" mass="1" diaginertia="0.1 0.1 0.1"/></body></worldbody>
    ...         <actuator><motor joint="hinge"/></actuator></mujoco>'''
    ...     with MujocoPlant(text, outputs=["q"], sample_time=0.01) as plant:
    ...         assert str(plant.spec) == "tau1 [N m] -> q1 [rad] every 0.01 s"
    """

    __signature__ = with_fields(MujocoSettings, "model")

    def __init__(self, model: str | Path, **options: Any) -> None:
        engine, given = mujoco(), MujocoSettings(**options)
        sampled, step, self._substeps = times(model, given.sample_time, given.timestep, given.substeps)
        given = replace(given, timestep=step)
        self._model = built(model, given)
        self._data = engine.MjData(self._model)
        self._key = _keyframe(self._model, given.keyframe)
        states = states_of(self._model, given.joint_names)
        if not states.positions:
            raise InputError("a model without joints", expected="a joint", got="none", remedy="give another file")
        every = inputs_of(self._model, states, given)
        measured = outputs_of(self._model, states, given.outputs)
        accelerations = measured.stage >= int(engine.mjtStage.mjSTAGE_ACC)
        self._spec = PlantSpec(every.channels, measured.channels, sampled, states.channels, feedthrough=accelerations)
        self._shape = (len(every.channels),)
        self._kept = int(engine.mjtState.mjSTATE_INTEGRATION)
        self._size = engine.mj_stateSize(self._model, self._kept)
        self._inputs, self._outputs = every, measured
        self._columns = [states.channels.index(channel) for channel in measured.channels] if not measured.stage else []
        self._block = max(1, BLOCK // self._substeps)
        self._step: Callable[[FloatArray], FloatArray]
        self._bind()
        self.true_parameters: dict[str, float] = {}

    @property
    def declared(self) -> dict[str, Any]:
        """What is simulated, by name: the settings of the engine, and what acts at the joints."""
        engine, option, model = mujoco(), self._model.opt, self._model
        off = int(option.disableflags)
        return {
            "timestep": float(option.timestep),
            "substeps": self._substeps,
            "integrator": engine.mjtIntegrator(int(option.integrator)).name.removeprefix("mjINT_").lower(),
            "solver": engine.mjtSolver(int(option.solver)).name.removeprefix("mjSOL_").lower(),
            "cone": engine.mjtCone(int(option.cone)).name.removeprefix("mjCONE_").lower(),
            "iterations": int(option.iterations),
            "tolerance": float(option.tolerance),
            "gravity": tuple(option.gravity.tolist()),
            "contact": not off & int(engine.mjtDisableBit.mjDSBL_CONTACT),
            "joint_limits": not off & int(engine.mjtDisableBit.mjDSBL_LIMIT),
            "joint_damping": tuple(model.dof_damping.tolist()),
            "joint_friction": tuple(model.dof_frictionloss.tolist()),
            "armature": tuple(model.dof_armature.tolist()),
            "friction_time": tuple(model.dof_solref[:, 0].tolist()),
            "mujoco": engine.__version__,
        }

    @property
    def warnings(self) -> dict[str, int]:
        """How often MuJoCo warned in this run, by its name of the warning."""
        kinds = mujoco().mjtWarning
        named = {name: int(value) for name, value in kinds.__members__.items() if name.startswith("mjWARN_")}
        counts = {name: int(self._data.warning[number].number) for name, number in named.items()}
        return {name.removeprefix("mjWARN_").lower(): count for name, count in counts.items() if count}

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start anew from the keyframe or reference position, or from named states; returns ``y[0]`` (ny,).

        ``rng`` is not used: MuJoCo draws nothing.
        """
        self._need_open()
        engine, model, data = mujoco(), self._model, self._data
        if self._key is None:
            engine.mj_resetData(model, data)
        else:
            engine.mj_resetDataKeyframe(model, data, self._key)
        start = initial_values(x0, self.spec.states, [*data.qpos, *data.qvel, *data.act])
        data.qpos[:], data.qvel[:] = start[: model.nq], start[model.nq : model.nq + model.nv]
        data.act[:] = start[model.nq + model.nv :]
        if self._outputs.stage:
            engine.mj_forward(model, data)
        return self._read()

    def step(self, u: FloatArray) -> FloatArray:
        """Hold ``u`` (nu,) for one sample time; returns the next output (ny,). It raises what a plant may."""
        return self._step(u)

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, nu) from the present state; row k of the result (N, ny) is what ``step`` returned."""
        return self._rolled(inputs)[0]

    def rollout_truth(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, ny) of ``rollout``, and the true states (N, nx) at the same instants."""
        return self._rolled(inputs)

    def output(self, u: FloatArray) -> FloatArray:
        """Return the output (ny,) with ``u`` applied, while no time passes."""
        self._need_open()
        if not (isinstance(u, ndarray) and u.shape == self._shape and isfinite(hypot(*u.tolist()))):
            refuse_input(u, self._spec)
        before = self.get_state()
        self._put(u)
        mujoco().mj_forward(self._model, self._data)
        y = self._read()
        self.set_state(before)
        return y

    def truth(self) -> FloatArray:
        """Return positions, rates and activations (nx,)."""
        self._need_open()
        return self._state()

    def get_state(self) -> FloatArray:
        """Return the engine's whole state: time, positions, rates, activations, delays, warm start of the solver."""
        self._need_open()
        state = np.empty(self._size)
        mujoco().mj_getState(self._model, self._data, state, self._kept)
        return state

    def set_state(self, state: FloatArray) -> None:
        """Go back to a state of this same plant object; the continuation repeats bit for bit."""
        self._need_open()
        mujoco().mj_setState(self._model, self._data, state, self._kept)

    def close(self) -> None:
        """Release the engine; may be called twice."""
        if not self._closed:
            self._closed = True
            del self._read, self._advance, self._put
            self._step = self._refused
            self._data = self._model = None

    def _bind(self) -> None:
        """Keep at hand the functions that set the inputs, move on and read: a step costs little more than they do."""
        engine, model, data, count = mujoco(), self._model, self._data, self._substeps
        controls, forces = _places(self._inputs.controls), _places(self._inputs.forces)
        first, nu = len(self._inputs.controls), len(self._inputs.channels)
        ctrl, pushed, step = data.ctrl, data.qfrc_applied, engine.mj_step

        def put(u: FloatArray) -> None:
            if first:
                ctrl[controls] = u[:first]
            if first < nu:
                pushed[forces] = u[first:]

        whole = self._inputs.controls == tuple(range(model.nu)) and first == nu
        forward = engine.mj_forward if self._outputs.stage else None

        def advance(u: FloatArray) -> None:
            put(u)
            step(model, data, count)
            if forward is not None:
                forward(model, data)

        self._put = put
        self._advance: Callable[[FloatArray], None] = advance
        self._read = _reader(data, self._outputs)
        read, shape = self._read, self._shape
        plain = None if forward is not None else ctrl if whole else pushed if _every_dof(self._inputs, model) else None
        go = self._advance

        def stepped(u: FloatArray) -> FloatArray:
            if not (isinstance(u, ndarray) and u.shape == shape and isfinite(hypot(*u.tolist()))):
                refuse_input(u, self._spec)
            if plain is None:
                go(u)
            else:
                plain[:] = u
                step(model, data, count)
            y = read()
            if not isfinite(hypot(*y.tolist())):  # hypot scales: it overflows only where a value is near to
                self._diverged()
            return y

        self._step = stepped

    def _refused(self, u: FloatArray) -> FloatArray:
        """Refuse a step of a closed plant."""
        self._need_open()
        return u

    def _rolled(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return outputs and states after each row of inputs: in MuJoCo's own loop unless a sensor is read."""
        self._need_open()
        rows = checked_inputs(inputs, self.spec)
        outputs, states = np.empty((len(rows), self.spec.ny)), np.empty((len(rows), len(self.spec.states)))
        if not self._outputs.stage:
            for first in range(0, len(rows), self._block):
                block = slice(first, first + self._block)
                states[block] = self._block_of(rows[block])
            outputs = states[:, self._columns]
        else:
            for k, row in enumerate(rows):
                self._advance(row)
                outputs[k] = self._read()
                states[k] = self._state()
        if not (np.isfinite(outputs).all() and np.isfinite(states).all()) or self._lost():
            self._diverged()
        return outputs, states

    def _block_of(self, rows: FloatArray) -> FloatArray:
        """Return the states (n, nx) after each of some rows of inputs (n, nu), not after the steps between."""
        engine, model, data = mujoco(), self._model, self._data
        kinds, first = engine.mjtState, len(self._inputs.controls)
        held = np.tile(np.concatenate([data.ctrl, data.qfrc_applied]), (len(rows), 1))
        held[:, list(self._inputs.controls)] = rows[:, :first]
        held[:, [model.nu + dof for dof in self._inputs.forces]] = rows[:, first:]
        whole = int(kinds.mjSTATE_FULLPHYSICS)
        start = np.empty(engine.mj_stateSize(model, whole))
        engine.mj_getState(model, data, start, whole)
        found, _ = importlib.import_module("mujoco.rollout").rollout(
            model,
            data,
            start[None],
            np.repeat(held, self._substeps, axis=0)[None],
            control_spec=int(kinds.mjSTATE_CTRL) | int(kinds.mjSTATE_QFRC_APPLIED),
            initial_warmstart=np.array(data.qacc_warmstart)[None],
        )
        size = model.nq + model.nv + model.na
        return np.asarray(found[0, self._substeps - 1 :: self._substeps, 1 : 1 + size])  # the time stands first

    def _lost(self) -> bool:
        """Return whether MuJoCo gave up a run: its own loop then repeats the last state."""
        return any(name in self.warnings for name in ("badqpos", "badqvel", "badqacc"))

    def _state(self) -> FloatArray:
        data = self._data
        return np.concatenate([data.qpos, data.qvel, data.act])

    def _diverged(self) -> None:
        """Say when a run diverged, and what helps."""
        warned = ", ".join(self.warnings) or "an output"
        raise PlantError(
            f"MuJoCo diverged before t = {self._data.time:g} s ({warned} not finite): use a smaller timestep (more "
            "substeps), or integrator = implicitfast",
            status="diverged",
        )


def _every_dof(inputs: Inputs, model: Any) -> bool:
    """Return whether the inputs are forces on all degrees of freedom, in MuJoCo's order, and nothing else."""
    return not inputs.controls and inputs.forces == tuple(range(model.nv))


def _keyframe(model: Any, name: str | None) -> int | None:
    """Return the number of a keyframe."""
    if name is None:
        return None
    names = [model.key(k).name for k in range(model.nkey)]
    refuse_unknown("option keyframe", name, names)
    return names.index(name)


def _places(numbers: Sequence[int]) -> Any:
    """Return consecutive places as a slice, which is faster, others as an array."""
    first = numbers[0] if numbers else 0
    consecutive = tuple(numbers) == tuple(range(first, first + len(numbers)))
    return slice(first, first + len(numbers)) if consecutive else np.array(numbers, dtype=int)


def _reader(data: Any, outputs: Outputs) -> Callable[[], FloatArray]:
    """Return a function that reads the outputs (ny,)."""
    parts = [(getattr(data, name), _places(places)) for name, places in outputs.parts]
    if len(parts) == 1 and isinstance(parts[0][1], slice):
        copy: Callable[[], FloatArray] = parts[0][0][parts[0][1]].copy
        return copy
    row, first = np.empty(len(outputs.channels)), 0
    pairs = []
    for (source, places), (_, numbers) in zip(parts, outputs.parts, strict=True):
        pairs.append((row[first : first + len(numbers)], source, places))
        first += len(numbers)
    if len(pairs) == 2 and all(isinstance(places, slice) for *_, places in pairs):
        (head, source, at), (tail, other, where) = pairs
        one, two, whole = source[at], other[where], row.copy

        def both() -> FloatArray:
            head[:] = one
            tail[:] = two
            return whole()

        return both

    def every() -> FloatArray:
        for into, source, places in pairs:
            into[:] = source[places]
        return row.copy()

    return every
