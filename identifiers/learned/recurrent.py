"""Small recurrent networks fitted by the simulation error of whole records, as an ensemble; nothing more is needed."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path

import numpy as np

from harness.data.whole_files import whole_file
from harness.errors import FitError
from harness.options import check_options
from harness.signals import Trajectory
from identifiers.common.bands import refuse_share
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.learned.recurrent_fit import FittedStart, Problem, descend
from identifiers.learned.recurrent_model import RecurrentEnsemble, RecurrentModel, vouched
from identifiers.learned.recurrent_pass import Integrating, RecurrentLayout
from identifiers.learned.training import bar

__all__ = ["NeuralOutputError", "RecurrentEnsemble", "RecurrentModel"]


@dataclass(frozen=True)
class NeuralOutputError(Excited):
    """Ensemble of small neural state-space models, each fitted by the simulation error of whole records.

    What output-error methods do for linear models (Ljung 1999, *System Identification*, sec. 7.2), for a network: the
    free run over each whole record is compared with the data, initial states are unknowns like the weights, and
    Levenberg and Marquardt's method uses the exact derivatives of the run, which compiled code carries along. States
    have no meaning and outputs have a network of their own, so levels that nobody measured, saturating tanks and
    sensors can be learned. The last fifth of every record is held out, simulated on from what came before: every start
    ends at its best state there, and the ``members`` best of the ``starts`` make the ensemble. A free run that leaves
    three times the range of the states in the data is held at its edge, so that it stays finite. For records of up to
    some ten thousands of samples, of plants whose free run stays near the truth; for unstable ones use
    ``neural-state-space``.

    Parameters
    ----------
    order : int
        States.
    hidden, outside : int
        Units of the network of the state, and of that of the output (0: outputs are linear in the states).
    ridge : float
        Cost of the squares of the weights, in those of scaled output errors; a tenth of it for the linear part.
    starts : int
        Random starts: every second one from cascades of lags with random time constants, the others from a subspace
        model.
    members : int
        Networks of the ensemble.
    iterations : int
        At most, for each start.
    direct : bool
        Let y[k] depend on u[k]; always so for a plant with feedthrough.
    checkpoint : path, optional
        File in which finished starts are kept, and from which an interrupted fit goes on.
    progress : bool
        Show a bar on the error stream.
    held_out : float
        Share of every record, its end, that is not learned from and tells how wide the bands are.
    integrated : bool
        Outputs are sums of what the networks say, which does not depend on them: positions under forces, levels that
        nothing drains. A ridge below 1 suits long runs, whose errors are small shares of the outputs.
    """

    order: int = 3
    hidden: int = 6
    outside: int = 4
    ridge: float = 1.0
    starts: int = 60
    members: int = 5
    iterations: int = 150
    direct: bool = False
    checkpoint: str | None = None
    progress: bool = False
    held_out: float = 0.2
    integrated: bool = False

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> RecurrentEnsemble:
        """Return the ensemble; the held-out errors of its members stand in its notes."""
        what = "neural-output-error"
        numbers = dict.fromkeys(("order", "hidden", "members", "iterations"), ">= 1")
        check_options(self, what, **numbers, starts=f">= {self.members}", outside=">= 0", ridge="> 0")
        refuse_share(self.held_out, what)
        records, spec = self.asked(trajectories, samples=ceil((self.order + 4) / self.held_out), what=what)
        problems = Problem.scaled(records, self.held_out)
        network = RecurrentLayout(self.order, spec.nu, spec.ny, self.hidden, self.outside)
        layout = Integrating(network, _increments(problems)) if self.integrated else network
        direct = self.direct or spec.feedthrough
        seed = int(rng.integers(2**62))
        path = None if self.checkpoint is None else Path(self.checkpoint)
        key = self._key(problems, seed)
        done = _kept(path, key)
        with bar(what, self.starts, self.progress) as move:
            for number in range(len(done), self.starts):
                draw = np.random.default_rng([seed, number])
                done.append(
                    descend(layout, problems, draw, self.ridge, self.iterations, direct=direct, lags=number % 2 == 0)
                )
                _keep(path, key, done)
                move(number + 1)
        order = sorted(range(self.starts), key=lambda number: (done[number].held_out, number))
        best = [done[number] for number in order[: self.members] if np.isfinite(done[number].held_out)]
        if not best:
            raise FitError(
                f"{what}: every free run diverges",
                expected="a plant whose free run stays near the data",
                got=f"{self.starts} starts, all lost",
                remedy="use neural-state-space, which is trained on short windows",
            )
        found = vouched(spec, layout, best, problems, records, what, bounded=True)
        found.notes["starts"] = self.starts
        return found

    def _key(self, problems: Sequence[Problem], seed: int) -> str:
        """Return a hash of all that the starts depend on."""
        text = hashlib.sha256(
            repr(
                (
                    self.order,
                    self.hidden,
                    self.outside,
                    self.ridge,
                    self.iterations,
                    self.direct,
                    self.held_out,
                    self.integrated,
                    seed,
                )
            ).encode()
        )
        for problem in problems:
            text.update(problem.u.tobytes())
            text.update(problem.y.tobytes())
        return text.hexdigest()


def _increments(problems: Sequence[Problem]) -> tuple[float, ...]:
    """Return the size of the increments of each scaled output in a sample."""
    steps = np.concatenate([np.diff(one.scaled_y, axis=0) for one in problems])
    return tuple(float(size) for size in np.maximum(np.sqrt(np.mean(steps**2, axis=0)), 1e-12))


def _kept(path: Path | None, key: str) -> list[FittedStart]:
    """Return the finished starts of a file, if it belongs to this fit."""
    if path is None or not path.is_file():
        return []
    with np.load(path, allow_pickle=False) as content:
        if str(content["key"]) != key:
            return []
        rows = zip(content["theta"], content["starts"], content["errors"], strict=True)
        return [FittedStart(theta, starts, float(e[0]), float(e[1])) for theta, starts, e in rows]


def _keep(path: Path | None, key: str, done: Sequence[FittedStart]) -> None:
    """Write the finished starts, whole or not at all."""
    if path is None:
        return
    with whole_file(path) as scratch, scratch.open("wb") as file:
        np.savez(
            file,
            key=np.array(key),
            theta=np.array([fitted.theta for fitted in done]),
            starts=np.array([fitted.starts for fitted in done]),
            errors=np.array([[fitted.held_out, fitted.error] for fitted in done]),
        )
