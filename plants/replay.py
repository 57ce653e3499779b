"""A recording as a plant: it plays the recorded outputs, as long as it gets the recorded inputs."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from harness.errors import InputError, PlantError, refuse_unknown
from harness.protocols import Ability
from harness.signals import FloatArray, PlantSpec, Trajectory
from plants.base import BasePlant
from plants.checking import checked_inputs, initial_values, refuse_option


class ReplayPlant(BasePlant):
    """Plays a recording sample by sample.

    A recording cannot answer what would have happened under other inputs: they are refused. After its last sample
    it ends with the status ``"terminated"``.

    Parameters
    ----------
    trajectory : Trajectory, optional
        The recording; or give ``file``.
    file : str or Path, optional
        A CSV or Parquet file as ``sysid simulate`` writes it, or a ``dataset.toml``.
    inputs : str or sequence of str, optional
        Names of the input columns of a CSV file (a string may list several, separated by commas); Parquet files, data
        sets and what ``sysid simulate`` wrote know theirs.
    run : int
        Which run of a data set.
    mismatch : {"refuse", "warn"}
        What to do when an input differs from the recorded one: an error, or one warning for each reset.
    tolerance : float
        Greatest difference that passes, as a fraction of the largest recorded value of the channel.

    Raises
    ------
    InputError
        If there is no recording, or two, or it cannot be read.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.1)
    >>> record = Trajectory(np.arange(3) * 0.1, np.ones((3, 1)), np.array([[0.0], [0.1], [0.3]]), spec)
    >>> plant = ReplayPlant(record)
    >>> plant.reset(rng=np.random.default_rng(0)).tolist(), plant.step(np.array([1.0])).tolist()
    ([0.0], [0.1])
    """

    def __init__(
        self,
        trajectory: Trajectory | None = None,
        *,
        file: str | Path | None = None,
        inputs: str | Sequence[str] | None = None,
        run: int = 0,
        mismatch: Literal["refuse", "warn"] = "refuse",
        tolerance: float = 1e-9,
    ) -> None:
        if (trajectory is None) == (file is None):
            raise InputError(
                "a replay needs one recording",
                expected="trajectory or file",
                got="neither" if file is None else "both",
                remedy="give file = the CSV, Parquet or dataset.toml file",
            )
        refuse_unknown("option mismatch", mismatch, ("refuse", "warn"), remedy="choose one of the two")
        refuse_option("tolerance", tolerance, bool(np.isfinite(tolerance) and tolerance >= 0), "a number >= 0")
        record = trajectory if file is None else _read(Path(file), inputs, run)
        assert record is not None
        self._record, self._mismatch, self._k = record, mismatch, 0
        largest = np.abs(record.u).max(axis=0, initial=0.0)
        self._allowed = tolerance * np.where(largest > 0, largest, 1.0)
        self._warned = False

    @property
    def spec(self) -> PlantSpec:
        """Channels and sample time of the recording."""
        return self._record.spec

    @property
    def abilities(self) -> frozenset[Ability]:
        """Snapshots and batch; truth and feedthrough where the recording has them."""
        found: set[Ability] = {"snapshots", "batch"}
        if self._record.x is not None and self._record.x.shape[1] == len(self.spec.states) > 0:
            found.add("truth")
        if self.spec.feedthrough:
            found.add("feedthrough")
        return frozenset(found)

    @property
    def trajectory(self) -> Trajectory:
        """The recording."""
        return self._record

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Go back to the first sample and return it (ny,). ``rng`` is not used; ``x0`` is refused."""
        initial_values(x0, (), ())
        self._k, self._warned = 0, False
        values: FloatArray = self._record.y[0].copy()
        return values

    def step(self, u: FloatArray) -> FloatArray:
        """Return the next recorded output (ny,).

        Raises
        ------
        InputError
            If ``u`` is not what was recorded.
        PlantError
            With status ``"terminated"`` at the end of the recording.
        """
        values: FloatArray = self.rollout(np.asarray(u, dtype=float)[None])[0]
        return values

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Return the next recorded outputs (N, ny) for inputs (N, nu); see :meth:`step`."""
        given = checked_inputs(inputs, self.spec)
        start, n = self._k, len(given)
        left = len(self._record) - 1 - start
        self._compare(given[: max(left, 0)], start)
        if n > left:
            self._k = len(self._record) - 1
            raise PlantError(
                f"the recording ends after {len(self._record)} samples ({self._record.duration:g} s)",
                status="terminated",
            )
        self._k = start + n
        values: FloatArray = self._record.y[start + 1 : self._k + 1].copy()
        return values

    def output(self, u: FloatArray) -> FloatArray:
        """Return the present recorded output (ny,), which ``u`` had fed through to."""
        self._compare(checked_inputs(np.asarray(u, dtype=float)[None], self.spec), self._k)
        values: FloatArray = self._record.y[self._k].copy()
        return values

    def truth(self) -> FloatArray:
        """Return the recorded true state (nx,).

        Raises
        ------
        PlantError
            If none was recorded.
        """
        if self._record.x is None:
            raise PlantError("the recording has no true states")
        values: FloatArray = self._record.x[self._k].copy()
        return values

    def get_state(self) -> Any:
        """Return the number of the present sample."""
        return self._k

    def set_state(self, state: Any) -> None:
        """Go back to a sample of this same plant object."""
        self._k = int(state)

    def _compare(self, given: FloatArray, start: int) -> None:
        """Refuse inputs (n, nu) that differ from those recorded from ``start`` on, or warn."""
        recorded = self._record.u[start : start + len(given)]
        wrong = np.abs(given - recorded) > self._allowed
        if not wrong.any():
            return
        row, column = (int(i) for i in np.argwhere(wrong)[0])
        channel = self.spec.inputs[column]
        problem = InputError(
            f"input {channel.name!r} differs from the recorded one at t = {self._record.t[start + row]:g} s",
            expected=f"{recorded[row, column]:.9g} {channel.unit}",
            got=f"{given[row, column]:.9g} {channel.unit}",
            remedy="drive the replay with scenario replay and the same file, or set mismatch = warn",
        )
        if self._mismatch == "refuse":
            raise problem
        if not self._warned:
            self._warned = True
            warnings.warn(f"{problem}; the recorded outputs are played all the same", stacklevel=4)


def _read(file: Path, inputs: str | Sequence[str] | None, run: int) -> Trajectory:
    """Return the recording in a file."""
    if not file.is_file():
        raise InputError("no such recording", expected="a file", got="no file", remedy="check the path", file=file)
    if file.suffix == ".toml":
        from harness.data import load_dataset

        runs = load_dataset(file).dataset.runs
        if not 0 <= run < len(runs):
            raise InputError(
                "no such run", expected=f"0..{len(runs) - 1}", got=str(run), remedy="correct run", file=file
            )
        return runs[run].trajectory
    from harness.data import read_trajectory

    names = [name.strip() for name in inputs.split(",")] if isinstance(inputs, str) else inputs
    return read_trajectory(file, inputs=names)
