"""Neural networks on past outputs and inputs, as ensembles: trained with torch, run with numpy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray, Trajectory
from harness.specs import spec_from_dict
from identifiers.ensemble import Ensemble
from identifiers.lag_state import LagModel, Scaling, regression_data
from identifiers.records import moving, real_signals, usable
from identifiers.training import draw_layers, need_torch, one_thread, train

__all__ = ["EnsembleModel", "NetworkModel", "NeuralNetwork"]

Layers = tuple[tuple[FloatArray, FloatArray], ...]


@dataclass(frozen=True, eq=False)
class NetworkModel(LagModel):
    """The change of the output is an affine function of lagged outputs and inputs plus a tanh network of them.

    Parameters
    ----------
    layers : tuple of (array (in, out), array (out,))
        Of the network; the last one is linear.
    affine : array (p + 1, ny)
        In scaled numbers.
    variance : array (ny,)
        Of the one-step error on held-out samples.
    """

    layers: Layers
    affine: FloatArray
    variance: FloatArray

    def ahead(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance (..., ny) of the next output."""
        x = self.scaling.rows(rows)
        hidden = x
        for weight, bias in self.layers[:-1]:
            hidden = np.tanh(hidden @ weight + bias)
        weight, bias = self.layers[-1]
        change = hidden @ weight + bias + x @ self.affine[:-1] + self.affine[-1]
        mean = rows[..., : self.spec.ny] + self.scaling.y_mean + change * self.scaling.y_std
        return mean, np.broadcast_to(self.variance, mean.shape)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            **self.head("network"),
            "layers": [[weight.tolist(), bias.tolist()] for weight, bias in self.layers],
            "affine": self.affine.tolist(),
            "variance": self.variance.tolist(),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> NetworkModel:
        """Return the model of a description."""
        return cls(
            spec_from_dict(content["spec"]),
            int(content["lags"]),
            Scaling.from_dict(content["scaling"]),
            tuple((np.array(weight, dtype=float), np.array(bias, dtype=float)) for weight, bias in content["layers"]),
            np.array(content["affine"], dtype=float),
            np.array(content["variance"], dtype=float),
            notes=dict(content.get("notes", {})),
        )


@dataclass(frozen=True, eq=False)
class EnsembleModel(Ensemble):
    """Networks that predict the next output from past outputs and inputs, as one model."""

    kind = "network-ensemble"
    member = NetworkModel


@dataclass(frozen=True)
class NeuralNetwork:
    """Ensemble of networks that predict the next output from past outputs and inputs.

    An affine fit comes first, the network learns what it leaves; so a network that learns nothing is an ARX model. The
    last fifth of every record is held out: each member ends at its best state there, and its variance is its mean
    square error there. Far outside the data members may agree and be wrong: the affine part is theirs in common; where
    that matters use a Gaussian process. Needs torch for the fit (extra ``learned``); the model runs with numpy.

    Parameters
    ----------
    order : int
        Past outputs and inputs; 1 where the state is measured.
    hidden : tuple of int
        Units of the hidden layers.
    members : int
        Networks; 1 gives a single model.
    steps : int
        Of Adam.
    rate : float
        Learning rate at the start; it falls as a cosine.
    batch : int
        Rows of a batch.
    checkpoint : path, optional
        File from which an interrupted fit goes on.
    progress : bool
        Show a bar on the error stream.
    """

    order: int = 1
    hidden: tuple[int, ...] = (32, 32)
    members: int = 5
    steps: int = 2000
    rate: float = 5e-3
    batch: int = 256
    checkpoint: str | None = None
    progress: bool = False

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> EnsembleModel:
        """Return the ensemble; held-out losses stand in its notes."""
        what = "neural-network"
        numbers = (self.order, self.members, self.steps, self.batch, *self.hidden)
        if min(numbers) < 1 or not self.rate > 0:
            raise InputError(
                f"options of {what}", expected="numbers of at least 1 and a rate > 0", got=str(numbers), remedy="raise"
            )
        records, spec = usable(trajectories, samples=max(10, 2 * self.order + 6), what=what)
        real_signals(spec, what)
        moving(records, what, inputs=False)
        # Batches are drawn by row: in whatever order records come, they make the same model.
        records.sort(key=lambda one: (len(one), one.y.tobytes()))
        torch = need_torch(what)
        cuts = [len(one) - max(len(one) // 5, self.order + 2) for one in records]
        rows, later = regression_data([one[:cut] for one, cut in zip(records, cuts, strict=True)], self.order)
        kept, kept_later = regression_data([one[cut:] for one, cut in zip(records, cuts, strict=True)], self.order)
        scaling = Scaling.of(rows, later - rows[:, : spec.ny])
        x, y = scaling.rows(rows), scaling.targets(later - rows[:, : spec.ny])
        held_x, held_y = scaling.rows(kept), scaling.targets(kept_later - kept[:, : spec.ny])
        one = np.ones((len(x), 1))
        design = np.hstack([x, one])
        gram = design.T @ design + 1e-8 * len(x) * np.eye(design.shape[1])
        affine = np.asarray(np.linalg.solve(gram, design.T @ y), dtype=float)
        left, held_left = y - design @ affine, held_y - held_x @ affine[:-1] - affine[-1]
        size = np.maximum(left.std(axis=0), 1e-12)
        layers = draw_layers((x.shape[1], *self.hidden, spec.ny), rng, self.members)
        layers[-1] = (0.1 * layers[-1][0], layers[-1][1])
        with one_thread(torch):
            tensors = [torch.tensor(part, requires_grad=True) for layer in layers for part in layer]
            inside, wanted = torch.from_numpy(x), torch.from_numpy(left / size)
            held_inside = torch.from_numpy(held_x)[None].expand(self.members, -1, -1)
            held_wanted = torch.from_numpy(held_left / size)[None]

            def network(batch: Any) -> Any:
                for number in range(0, len(tensors) - 2, 2):
                    batch = torch.tanh(batch @ tensors[number] + tensors[number + 1])
                return batch @ tensors[-2] + tensors[-1]

            def loss(index: Any) -> Any:
                return ((network(inside[index]) - wanted[index]) ** 2).mean(dim=(1, 2)).sum()

            def held_out() -> Any:
                return ((network(held_inside) - held_wanted) ** 2).mean(dim=(1, 2))

            history = train(
                torch,
                tensors,
                loss,
                held_out,
                len(x),
                (self.steps, self.rate, self.batch),
                rng=rng,
                members=self.members,
                checkpoint=self.checkpoint,
                progress=self.progress,
                title=what,
            )
            found = [tensor.detach().numpy() for tensor in tensors]
        members = []
        for i in range(self.members):
            parts = [(found[j][i], found[j + 1][i, 0]) for j in range(0, len(found), 2)]
            parts[-1] = (parts[-1][0] * size, parts[-1][1] * size)
            draft = NetworkModel(spec, self.order, scaling, tuple(parts), affine, np.ones(spec.ny))
            variance = np.mean((kept_later - draft.ahead(kept)[0]) ** 2, axis=0)
            variance = np.maximum(variance, (1e-9 * draft.y_size) ** 2)
            members.append(NetworkModel(spec, self.order, scaling, tuple(parts), affine, variance))
        notes = {"held-out loss": history[-1], "samples": len(x), "held out": len(kept)}
        return EnsembleModel(spec, tuple(members), notes)
