"""Closed-loop scenarios: a stabilising controller plus excitation. The controller sees only what is measured."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness.errors import InputError, PlantError
from harness.protocols import Experiment
from harness.rng import Streams
from harness.signals import FloatArray, PlantSpec
from scenarios import signals
from scenarios.arm_models import arm_model_of
from scenarios.conditions import Conditions
from scenarios.noise import PerChannel, not_negative, per_channel

InverseDynamics = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, kw_only=True)
class ArmTracking(Conditions):
    """Options that the arm scenarios share; see :class:`scenarios.conditions.Conditions` for the others.

    The reference of each joint is a sum of ``lines`` sines of the band with random phases and shares, new for each
    run, about the posture that the arm has at the start; it fades in smoothly. Positions are the measured outputs in
    rad (or m) in order, rates those in rad/s (or m/s); where no rate is measured it is a filtered difference.

    Parameters
    ----------
    amplitude : float or mapping
        Peak of the reference about the starting posture [rad], by output name.
    band : (low, high)
        Hz.
    lines : int
        Sines of each joint.
    fade : float
        Time over which the reference fades in [s].
    urdf : path, optional
        Model of the arm for the controller, a URDF or MJCF, with the rotors that it states; without it, for a plant
        with seven inputs, the KUKA iiwa of PyBullet.
    inverse_dynamics : callable, optional
        ``(q, v, a) -> torque`` instead of a URDF.
    natural_frequency, damping_ratio : float
        Of the error dynamics [rad/s].
    cutoff : float
        Corner of the difference filter [Hz].
    torque_excitation : float or mapping, optional
        Peak of a random-phase multisine (the band times ten) added to the torque [N m], by input name.
    """

    amplitude: PerChannel = 0.3
    band: tuple[float, float] = (0.1, 0.8)
    lines: int = 5
    fade: float = 1.0
    urdf: str | Path | None = None
    inverse_dynamics: InverseDynamics | None = None
    natural_frequency: float = 15.0
    damping_ratio: float = 1.0
    cutoff: float = 30.0
    torque_excitation: PerChannel | None = None

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role; raises InputError if the scenario does not fit the plant."""
        positions, rates = _outputs_in(spec, ("rad",)), _outputs_in(spec, ("rad/s",))
        if len(positions) != spec.nu:  # an arm with sliding joints
            positions, rates = _outputs_in(spec, ("rad", "m")), _outputs_in(spec, ("rad/s", "m/s"))
        if spec.nu == 0 or len(positions) != spec.nu:
            raise InputError(
                f"{type(self).__name__} does not fit the plant",
                expected="as many measured joint positions [rad] as inputs",
                got=f"{len(positions)} positions and {spec.nu} inputs",
                remedy="use an arm, or an open-loop scenario",
            )
        n = self.length(spec)
        reference, posture = self._planned(n, spec, positions, rng=streams(f"{role}/excitation"))
        law = self.law(spec)
        controller = _Tracking(spec, positions, rates if len(rates) == spec.nu else [], reference, law, self.cutoff)
        excitation = np.zeros((n, spec.nu))
        if self.torque_excitation is not None:
            given = per_channel(self.torque_excitation, spec.inputs, "torque_excitation")
            peaks = not_negative(given, spec.inputs, "torque_excitation", real=False)
            band = (10 * self.band[0], 10 * self.band[1])
            lines = signals.lines_of_band(n, spec.sample_time, band)
            rng = streams(f"{role}/torque")
            for i, peak in enumerate(peaks):
                excitation[:, i] = peak * signals.multisine(n, n, lines, rng=rng)
        states = {channel.name for channel in spec.states}
        names = [spec.outputs[i].name for i in positions]
        start = {} if posture is None else dict(zip(names, posture.tolist(), strict=True))
        start = {name: value for name, value in start.items() if name in states}
        return self.experiment(spec, excitation, streams=streams, role=role, controller=controller, x0=start)

    def law(self, spec: PlantSpec) -> _Law:
        """Return the feedback law for this plant."""
        raise InputError(
            "control law", expected="arm-pd or arm-computed-torque", got=type(self).__name__, remedy="use one of these"
        )

    def model(self, spec: PlantSpec) -> InverseDynamics:
        """Return the inverse dynamics that the controller uses."""
        if self.inverse_dynamics is not None:
            return self.inverse_dynamics
        model = arm_model_of(self.urdf, spec)
        return lambda q, v, a: model.arm.inverse_dynamics(q, v, a) + model.motor_inertia * a

    def _planned(
        self, n: int, spec: PlantSpec, positions: list[int], *, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the reference about the start, (3, n, joints), and the posture to start from if one is wanted."""
        return self._reference(n, spec, positions, rng=rng), None

    def _reference(self, n: int, spec: PlantSpec, positions: list[int], *, rng: np.random.Generator) -> FloatArray:
        """Return position, rate and acceleration about the start, shape (3, n, joints)."""
        channels = tuple(spec.outputs[i] for i in positions)
        peaks = not_negative(per_channel(self.amplitude, channels, "amplitude"), channels, "amplitude", real=False)
        if not 0 < self.band[0] <= self.band[1] or self.lines < 1 or self.fade <= 0:
            raise InputError(
                "reference of the arm",
                expected="0 < low <= high, lines >= 1, fade > 0",
                got=f"band {self.band}, lines {self.lines}, fade {self.fade}",
                remedy="correct the options",
            )
        t: FloatArray = np.arange(n, dtype=np.float64) * spec.sample_time
        omega = 2 * np.pi * np.linspace(self.band[0], self.band[1], self.lines)
        moves = np.zeros((3, n, len(positions)))
        for joint, peak in enumerate(peaks):
            shares = rng.uniform(0.3, 1.0, self.lines)
            shares *= peak / shares.sum()
            angle = np.outer(t, omega) + rng.uniform(0, 2 * np.pi, self.lines)
            moves[0, :, joint] = np.sin(angle) @ shares
            moves[1, :, joint] = np.cos(angle) @ (shares * omega)
            moves[2, :, joint] = -np.sin(angle) @ (shares * omega**2)
        return self.faded(t, moves)

    def faded(self, t: FloatArray, moves: FloatArray) -> FloatArray:
        """Return position, rate and acceleration (3, N, joints) about the start, faded in smoothly."""
        s = np.clip(t / self.fade, 0, 1)[:, None]
        fade = s**3 * (10 - 15 * s + 6 * s**2)
        slope = 30 * s**2 * (1 - s) ** 2 / self.fade
        curve = 60 * s * (1 - s) * (1 - 2 * s) / self.fade**2
        q, v, a = moves
        return np.stack([fade * q, fade * v + slope * q, fade * a + 2 * slope * v + curve * q])


@dataclass(frozen=True, kw_only=True)
class ArmComputedTorque(ArmTracking):
    """Arm that follows a random smooth reference under computed torque.

    ``torque = ID(q, v, a_ref + 2 zeta w (v_ref - v) + w^2 (q_ref - q))``, with the inverse dynamics ID of a model,
    not of the plant. Options: ``ArmTracking``.
    """

    def law(self, spec: PlantSpec) -> _Law:
        """Return the feedback law for this plant."""
        model = self.model(spec)
        stiffness, damping = self.natural_frequency**2, 2 * self.damping_ratio * self.natural_frequency

        def torque(q: FloatArray, v: FloatArray, wanted: FloatArray) -> FloatArray:
            return model(q, v, wanted[2] + damping * (wanted[1] - v) + stiffness * (wanted[0] - q))

        return torque


@dataclass(frozen=True, kw_only=True)
class ArmPd(ArmTracking):
    """Arm that follows a random smooth reference under PD control of each joint.

    ``torque = kp (q_ref - q) + kd (v_ref - v) + gravity(q)``. Gains that are not given follow from the natural
    frequency and the inertia that each joint of the model feels at the starting posture while the others are free.
    Other options: ``ArmTracking``.

    Parameters
    ----------
    kp, kd : float or mapping, optional
        Gains [N m/rad] and [N m s/rad] by input name.
    gravity_compensation : bool
        Add the gravity torque of the model; with False and both gains no model is needed.
    """

    kp: PerChannel | None = None
    kd: PerChannel | None = None
    gravity_compensation: bool = True

    def law(self, spec: PlantSpec) -> _Law:
        """Return the feedback law for this plant."""
        needs_model = self.gravity_compensation or self.kp is None or self.kd is None
        model = self.model(spec) if needs_model else None
        still = np.zeros(spec.nu)
        gains: list[FloatArray] = []

        def torque(q: FloatArray, v: FloatArray, wanted: FloatArray) -> FloatArray:
            if not gains:
                gains.extend(self._gains(spec, q, model))
            result = gains[0] * (wanted[0] - q) + gains[1] * (wanted[1] - v)
            if self.gravity_compensation and model is not None:
                result = result + model(q, still, still)
            return np.asarray(result, dtype=float)

        return torque

    def _gains(self, spec: PlantSpec, q: FloatArray, model: InverseDynamics | None) -> tuple[FloatArray, FloatArray]:
        """Return the gains, those that are not given scaled by the inertia seen at each joint."""
        inertia = np.ones(spec.nu)
        if model is not None:
            still = np.zeros(spec.nu)
            weight = model(q, still, still)
            mass = np.column_stack([model(q, still, unit) - weight for unit in np.eye(spec.nu)])
            inertia = 1 / np.diag(np.linalg.inv(mass))  # what a joint feels while the others are free: coupled
            # joints that turn about nearly one axis would be driven unstable by gains scaled to the diagonal
        w = self.natural_frequency
        kp = inertia * w**2 if self.kp is None else per_channel(self.kp, spec.inputs, "kp")
        kd = inertia * 2 * self.damping_ratio * w if self.kd is None else per_channel(self.kd, spec.inputs, "kd")
        return kp, kd


_Law = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]


class _Tracking:
    """The controller of one run: measures the start, estimates rates, keeps torques within the plant's limits.

    ``references`` holds the joints' references about the start, by title.
    """

    def __init__(
        self,
        spec: PlantSpec,
        positions: list[int],
        rates: list[int],
        reference: FloatArray,
        law: _Law,
        cutoff: float,
    ) -> None:
        self.spec, self.positions, self.rates, self.reference, self.law = spec, positions, rates, reference, law
        self.references = {str(spec.outputs[i]): reference[0, :, joint] for joint, i in enumerate(positions)}
        self.low = np.array([channel.minimum for channel in spec.inputs])
        self.high = np.array([channel.maximum for channel in spec.inputs])
        self.share = 1 - math.exp(-2 * math.pi * cutoff * spec.sample_time)
        self.start: FloatArray | None = None
        self.last = np.zeros(spec.nu)
        self.rate = np.zeros(spec.nu)

    def __call__(self, t: float, y: FloatArray) -> FloatArray:
        """Return the torque (nu,)."""
        q = y[self.positions]
        if self.start is None:
            self.start = self.last = q.copy()
            self._check_reach(q)
        if self.rates:
            v = y[self.rates]
        else:
            self.rate = self.rate + self.share * ((q - self.last) / self.spec.sample_time - self.rate)
            self.last, v = q.copy(), self.rate
        k = min(round(t / self.spec.sample_time), self.reference.shape[1] - 1)
        wanted = self.reference[:, k].copy()
        wanted[0] += self.start
        return np.clip(self.law(q, v, wanted), self.low, self.high)

    def _check_reach(self, q: FloatArray) -> None:
        """Refuse a reference that leaves the range of a joint."""
        for joint, index in enumerate(self.positions):
            channel, moves = self.spec.outputs[index], self.reference[0, :, joint]
            if q[joint] + moves.min() < channel.minimum or q[joint] + moves.max() > channel.maximum:
                raise InputError(
                    f"reference of joint {channel.name!r}",
                    expected=f"values within [{channel.minimum:g}, {channel.maximum:g}] {channel.unit}",
                    got=f"{q[joint] + moves.min():.3g} to {q[joint] + moves.max():.3g}",
                    remedy="lower the amplitude of this joint",
                    place="amplitude",
                )


@dataclass(frozen=True, kw_only=True)
class CartPoleLqr(Conditions):
    """Cart-pole balanced upright by LQR on a Kalman filter, with a multisine force added.

    The controller knows a cart-pole with the parameters given here and measures ``x`` and ``theta`` (0 hangs down,
    absolute); rates come from the filter. The run starts near upright and ends with the status ``terminated`` if the
    pole falls. Other options: ``Conditions``.

    Parameters
    ----------
    amplitude : float
        Peak of the multisine [N].
    band : (low, high), optional
        Of the multisine [Hz]; by default all of it, from 0.1 Hz to half the sampling frequency: under feedback a narrow
        band leaves the input almost a function of past outputs, and no model can be learned.
    tilt : float
        The pole starts at a random angle within -+ ``tilt`` of upright [rad].
    fall : float
        Angle from upright at which the pole counts as fallen [rad].
    mc, mp, l, bx, btheta, g : float
        Model of the controller: masses [kg], length [m], frictions [N s/m] and [N m s/rad], gravity [m/s^2].
    weights : (x, theta, x rate, theta rate)
        Diagonal of Q; R is 1.
    sensor : (x, theta)
        Standard deviations that the filter assumes [m] and [rad].
    force_noise : float
        Standard deviation of the unknown force that the filter assumes [N].
    """

    amplitude: float = 5.0
    band: tuple[float, float] | None = None
    tilt: float = 0.05
    fall: float = 0.8
    mc: float = 1.0
    mp: float = 0.2
    l: float = 0.5  # noqa: E741 (the name of the built-in model's parameter)
    bx: float = 0.2
    btheta: float = 0.005
    g: float = 9.81
    weights: tuple[float, float, float, float] = (10.0, 50.0, 1.0, 1.0)
    sensor: tuple[float, float] = (1e-3, 1e-3)
    force_noise: float = 1.0

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role; raises InputError if the plant is no cart-pole."""
        names = [channel.name for channel in spec.outputs]
        if spec.nu != 1 or not {"x", "theta"} <= set(names):
            raise InputError(
                "cart-pole-lqr does not fit the plant",
                expected="one input and the outputs x and theta",
                got=str(spec),
                remedy="use a cart-pole",
            )
        n = self.length(spec)
        band = (0.1, 0.5 / spec.sample_time) if self.band is None else self.band
        lines = signals.lines_of_band(n, spec.sample_time, band)
        wave = signals.multisine(n, n, lines, rng=streams(f"{role}/excitation"))
        limits = spec.inputs[0]
        not_negative(np.array([self.amplitude]), spec.inputs, "amplitude", real=False)
        excitation = np.clip(self.amplitude * wave, limits.minimum, limits.maximum)
        start = {"theta": math.pi + float(streams(f"{role}/tilt").uniform(-self.tilt, self.tilt))}
        controller = _Balance(self, spec, names.index("x"), names.index("theta"), excitation)
        return self.experiment(spec, excitation[:, None], streams=streams, role=role, controller=controller, x0=start)

    def upright(self) -> tuple[FloatArray, FloatArray]:
        """Return A (4, 4) and B (4, 1) of the cart-pole about upright; states x, angle from upright, rates.

        From (mc + mp) x'' - mp l f'' = u - bx x' and mp l^2 f'' - mp l x'' = mp g l f - btheta f', f = theta - pi.

        Examples
        --------
        >>> A, B = CartPoleLqr().upright()
        >>> bool(np.linalg.eigvals(A).real.max() > 0), B.shape
        (True, (4, 1))
        """
        mass = np.array([[self.mc + self.mp, -self.mp * self.l], [-self.mp * self.l, self.mp * self.l**2]])
        forces = np.array([[0, 0, -self.bx, 0], [0, self.mp * self.g * self.l, 0, -self.btheta]])
        A, B = np.zeros((4, 4)), np.zeros((4, 1))
        A[:2, 2:] = np.eye(2)
        A[2:] = np.linalg.solve(mass, forces)
        B[2:, 0] = np.linalg.solve(mass, np.array([1.0, 0.0]))
        return A, B


class _Balance:
    """LQR on a stationary Kalman filter, both for the sampled model."""

    def __init__(self, scenario: CartPoleLqr, spec: PlantSpec, x: int, theta: int, excitation: FloatArray) -> None:
        from control import dlqe, dlqr
        from scipy.linalg import expm

        A, B = scenario.upright()
        dt = spec.sample_time
        both = expm(np.block([[A, B], [np.zeros((1, 5))]]) * dt)
        self.A, self.B = both[:4, :4], both[:4, 4:]
        self.C = np.eye(2, 4)
        self.gain = np.asarray(dlqr(self.A, self.B, np.diag(scenario.weights) * dt, np.eye(1) * dt)[0], dtype=float)
        filtered = dlqe(self.A, self.B, self.C, [[scenario.force_noise**2]], np.diag(np.square(scenario.sensor)))
        self.correction = np.asarray(filtered[0], dtype=float)
        self.state: FloatArray | None = None
        self.columns, self.excitation, self.fall, self.dt = [x, theta], excitation, scenario.fall, dt
        self.low, self.high = spec.inputs[0].minimum, spec.inputs[0].maximum

    def __call__(self, t: float, y: FloatArray) -> FloatArray:
        """Return the force (1,) that is added to the excitation."""
        seen = y[self.columns].astype(float)
        seen[1] = (seen[1] % (2 * math.pi)) - math.pi
        if abs(seen[1]) > self.fall:
            raise PlantError(f"the pole fell at t = {t:g} s", status="terminated")
        if self.state is None:
            self.state = np.array([seen[0], seen[1], 0.0, 0.0])
        self.state = self.state + self.correction @ (seen - self.C @ self.state)
        added = self.excitation[min(round(t / self.dt), self.excitation.size - 1)]
        total = float(np.clip(added - float((self.gain @ self.state)[0]), self.low, self.high))
        self.state = self.A @ self.state + self.B[:, 0] * total
        return np.array([total - added])


def _outputs_in(spec: PlantSpec, units: tuple[str, ...]) -> list[int]:
    """Return the indices of the outputs with one of these units."""
    return [i for i, channel in enumerate(spec.outputs) if channel.unit in units]
