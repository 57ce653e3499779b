"""Neural networks on past outputs and inputs, as ensembles: trained with torch, run with numpy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from harness.signals import FloatArray, Trajectory
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.learned.ensemble import Ensemble
from identifiers.learned.lag_training import LagNetwork, lag_task
from identifiers.learned.training import Trained, draw_layers

NEEDS = ("torch",)

Layers = tuple[tuple[FloatArray, FloatArray], ...]


@dataclass(frozen=True, eq=False)
class NetworkModel(LagNetwork):
    """The change of the output is an affine function of lagged outputs and inputs plus a tanh network of them.

    Parameters
    ----------
    layers : tuple of (array (in, out), array (out,))
        Of the network; the last one is linear.
    """

    layers: Layers
    kind = "network"

    def change(self, x: FloatArray) -> FloatArray:
        """Return the scaled addition (..., ny) of the network at scaled rows (..., p)."""
        for weight, bias in self.layers[:-1]:
            x = np.tanh(x @ weight + bias)
        weight, bias = self.layers[-1]
        return np.asarray(x @ weight + bias)


@dataclass(frozen=True, eq=False)
class EnsembleModel(Ensemble):
    """Networks that predict the next output from past outputs and inputs, as one model."""

    kind = "network-ensemble"
    member = NetworkModel


@dataclass(frozen=True)
class NeuralNetwork(Excited, Trained):
    """Ensemble of networks that predict the next output from past outputs and inputs.

    An affine fit comes first, the network learns what it leaves; so a network that learns nothing is an ARX model. The
    last fifth of every record is held out: each member ends at its best state there, and bands are
    made to hold there. Several steps ahead they are scaled to hold there too
    (:class:`identifiers.common.bands.Bands`). Outside the data they widen with the distance
    (:class:`identifiers.common.reach.Reach`). Needs torch for the fit (extra ``learned``); the model runs with numpy.

    Parameters
    ----------
    order : int
        Past outputs and inputs; 1 where the state is measured.
    hidden : tuple of int
        Units of the hidden layers.
    members : int
        Networks; 1 gives a single model.
    """

    order: int = 1
    hidden: tuple[int, ...] = (32, 32)
    members: int = 5
    _: KW_ONLY
    batch: int = 256

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> EnsembleModel:
        """Return the ensemble; held-out losses stand in its notes."""
        what = "neural-network"
        self.check_numbers(what, "order", "members", "hidden")
        task = lag_task(trajectories, self.order, what, self)
        spec, scaling, size = task.spec, task.scaling, task.size
        layers = draw_layers((task.x.shape[1], *self.hidden, spec.ny), rng, self.members)
        layers[-1] = (0.1 * layers[-1][0], layers[-1][1])
        found, history = task.train([part for layer in layers for part in layer], _network, self, rng=rng, what=what)
        members = []
        for i in range(self.members):
            parts = [(found[j][i], found[j + 1][i, 0]) for j in range(0, len(found), 2)]
            parts[-1] = (parts[-1][0] * size, parts[-1][1] * size)
            members.append(
                NetworkModel(spec, self.order, scaling, task.affine, np.ones(spec.ny), None, layers=tuple(parts))
            )
        notes = {"held-out loss": history[-1], "samples": len(task.x), "held out": len(task.kept)}
        return task.far(EnsembleModel(spec, task.banded(members), notes), what)


def _network(torch: Any, tables: Sequence[Any], rows: Any) -> Any:
    """Return the outputs of tanh layers of all members."""
    for number in range(0, len(tables) - 2, 2):
        rows = torch.tanh(rows @ tables[number] + tables[number + 1])
    return rows @ tables[-2] + tables[-1]
