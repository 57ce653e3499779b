"""Gymnasium: an environment as a plant, and any plant as an environment (optional extra ``gym``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from harness.errors import InputError, PlantError, PluginError
from harness.protocols import Ability, Plant
from harness.signals import Channel, FloatArray, PlantSpec
from plants.base import BasePlant
from plants.checking import initial_values, positive, refuse_input

NEEDS = ("gymnasium",)


class GymPlant(BasePlant):
    """A Gymnasium environment behind the stepping interface: actions in, observations out, rewards left out.

    Parameters
    ----------
    env : str or gymnasium.Env
        Id (``"Pendulum-v1"``) or a made environment with one-dimensional Box or Discrete spaces.
    sample_time : float, optional
        Seconds between steps; default the environment's own ``dt`` or ``tau``.
    output_names, input_names : sequence of str, optional
        Names of the channels; default ``o1``, ... and ``a1``, ...

    Raises
    ------
    InputError
        If a space is of another kind, or the sample time is unknown.
    PluginError
        If gymnasium is not installed.
    """

    def __init__(
        self,
        env: Any,
        *,
        sample_time: float | None = None,
        output_names: list[str] | None = None,
        input_names: list[str] | None = None,
    ) -> None:
        gym = _gymnasium()
        self._own = isinstance(env, str)
        if self._own:
            try:
                self._env = gym.make(env)
            except gym.error.Error as error:
                raise InputError(
                    "environment", expected="a registered id", got=repr(env), remedy=" ".join(str(error).split())
                ) from error
        else:
            self._env = env
        inside = self._env.unwrapped
        found = sample_time or getattr(inside, "dt", None) or getattr(inside, "tau", None)
        if found is None:
            raise InputError(
                "the environment does not say its sample time", expected="dt", got="none", remedy="give sample_time"
            )
        self._discrete = isinstance(self._env.action_space, gym.spaces.Discrete)
        self._spec = PlantSpec(
            _channels(gym, self._env.action_space, "a", input_names),
            _channels(gym, self._env.observation_space, "o", output_names),
            positive("sample_time", float(found)),
        )
        self._open = self._running = True

    @property
    def abilities(self) -> frozenset[Ability]:
        """None: an environment hides its state."""
        return frozenset()

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start a new episode, seeded from ``rng``; returns ``y[0]`` (ny,). ``x0`` is refused."""
        if not self._open:
            raise PlantError("the plant is closed: make a new one", status="terminated")
        initial_values(x0, (), ())
        seen, _ = self._env.reset(seed=int(rng.integers(2**31)))
        self._running = True
        return self._flat(seen)

    def step(self, u: FloatArray) -> FloatArray:
        """Act and return the next observation (ny,).

        Raises
        ------
        PlantError
            With status ``"terminated"`` in the step after the episode's end.
        """
        values = np.asarray(u, dtype=float)
        if values.shape != (self.spec.nu,) or not np.isfinite(values).all():
            refuse_input(values, self.spec)
        if not (self._open and self._running):
            raise PlantError("the episode has ended: reset the plant", status="terminated")
        space = self._env.action_space
        if self._discrete:
            action: Any = round(values[0]) + int(space.start)
            if values[0] != round(values[0]) or not space.contains(action):
                raise InputError(
                    "action", expected=f"an integer in 0..{int(space.n) - 1}", got=str(values[0]), remedy="correct it"
                )
        else:
            action = values.astype(space.dtype)
        seen, _, terminated, truncated, _ = self._env.step(action)
        self._running = not (terminated or truncated)
        return self._flat(seen)

    def close(self) -> None:
        """Close the environment; may be called twice."""
        if self._open:
            self._env.close()
        self._open = False

    def _flat(self, seen: Any) -> FloatArray:
        """Return an observation as float64 (ny,)."""
        space = self._env.observation_space
        return np.atleast_1d(np.asarray(seen, dtype=np.float64)) - float(getattr(space, "start", 0))


def environment(
    plant: Plant,
    *,
    reward: Callable[[FloatArray, FloatArray], float] | None = None,
    samples: int = 1000,
    x0: Mapping[str, float] | None = None,
) -> Any:
    """Return a plant as a Gymnasium environment.

    Parameters
    ----------
    plant : Plant
        Inputs become the action, outputs the observation. Real channels become a Box with the declared limits (an
        input needs finite ones), a single category channel becomes Discrete.
    reward : callable, optional
        ``reward(y, u)`` of the new output and the action; default 0: the harness scores models, not policies.
    samples : int
        An episode is truncated after so many steps. It terminates where the plant breaks or its outputs are not
        finite.
    x0 : mapping, optional
        Named initial states; ``reset(options={"x0": ...})`` overrides them.

    Returns
    -------
    gymnasium.Env
        It closes the plant.

    Raises
    ------
    InputError
        If an input has no finite limits.
    PluginError
        If gymnasium is not installed.
    """
    gym = _gymnasium()

    class PlantEnv(gym.Env):  # type: ignore[misc, name-defined]
        """A plant as a Gymnasium environment."""

        metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own declaration
        render_mode = None

        def __init__(self) -> None:
            self.action_space = _space(gym, plant.spec.inputs, bounded=True)
            self.observation_space = _space(gym, plant.spec.outputs, bounded=False)
            self._k = 0
            self._seen = np.zeros(plant.spec.ny)

        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[Any, dict[str, Any]]:
            super().reset(seed=seed)
            self._k = 0
            start = (options or {}).get("x0", x0)
            # A generator of its own, so that the plant's draws do not depend on what else draws from np_random.
            self._seen = plant.reset(rng=np.random.default_rng(self.np_random.integers(2**63)), x0=start)
            return self._shown(), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            u = np.atleast_1d(np.asarray(action, dtype=np.float64))
            self._k += 1
            info: dict[str, Any] = {}
            try:
                y = plant.step(u)
                broken = not np.isfinite(y).all()
            except PlantError as error:
                broken, info = True, {"status": error.status, "reason": str(error)}
            if not broken:
                self._seen = y
            gained = 0.0 if reward is None else float(reward(self._seen, u))
            return self._shown(), gained, broken, not broken and self._k >= samples, info

        def close(self) -> None:
            plant.close()

        def _shown(self) -> Any:
            if isinstance(self.observation_space, gym.spaces.Discrete):
                return int(self._seen[0])
            return self._seen.copy()

    return PlantEnv()


def _gymnasium() -> Any:
    """Return the package."""
    try:
        import gymnasium
    except ImportError as error:
        raise PluginError(
            "this plant needs gymnasium: expected the package, got none; remedy: pip install 'sysid-harness[gym]'"
        ) from error
    return gymnasium


def _channels(gym: Any, space: Any, letter: str, names: list[str] | None) -> tuple[Channel, ...]:
    """Return the channels of a Gymnasium space."""
    if isinstance(space, gym.spaces.Discrete):
        return (Channel((names or [f"{letter}1"])[0], "1", 0, int(space.n) - 1, kind="category"),)
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise InputError(
            "space of the environment",
            expected="Box with one axis, or Discrete",
            got=str(space),
            remedy="wrap the environment (gymnasium.wrappers.FlattenObservation)",
        )
    called = names or [f"{letter}{i + 1}" for i in range(space.shape[0])]
    if len(called) != space.shape[0]:
        raise InputError("names of channels", expected=f"{space.shape[0]} names", got=str(called), remedy="correct it")
    return tuple(
        Channel(name, "1", float(low), float(high))
        for name, low, high in zip(called, space.low, space.high, strict=True)
    )


def _space(gym: Any, channels: tuple[Channel, ...], *, bounded: bool) -> Any:
    """Return the Gymnasium space of channels."""
    if len(channels) == 1 and channels[0].kind == "category":
        return gym.spaces.Discrete(channels[0].categories)
    low = np.array([channel.minimum for channel in channels])
    high = np.array([channel.maximum for channel in channels])
    if bounded and not (np.isfinite(low).all() and np.isfinite(high).all()):
        names = [c.name for c in channels if not np.isfinite([c.minimum, c.maximum]).all()]
        raise InputError(
            f"range of input {names[0]!r}",
            expected="finite limits, of which Gymnasium draws its actions",
            got="none",
            remedy="give the plant its limits (input_limit, u_limit)",
        )
    return gym.spaces.Box(low, high, dtype=np.float64)
