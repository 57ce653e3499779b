"""Neural networks on past outputs and inputs, as ensembles: trained with torch, run with numpy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.distributions import NormalMixture
from harness.errors import InputError
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.specs import spec_from_dict, spec_to_dict
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
class EnsembleModel:
    """Several models of the same kind; the state is theirs side by side, so that each follows its own run.

    The output is their mean; the predicted distribution is the equal mixture of theirs (Lakshminarayanan, Pritzel and
    Blundell 2017, *NeurIPS*, sec. 2.4), wide where they disagree.

    Parameters
    ----------
    members : tuple of NetworkModel
    """

    spec: PlantSpec
    members: tuple[NetworkModel, ...]
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def burn_in(self) -> int:
        """Samples that the lags reach back."""
        return self.members[0].burn_in

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the states of all members at the first sample, side by side (nx,)."""
        same_language(self.spec, data)
        return np.concatenate([member.initial_state(data) for member in self.members])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the mean of the members' outputs (..., ny)."""
        return np.asarray(np.mean([m.output(part, u) for m, part in self._parts(x)], axis=0))

    def predictive(self, x: FloatArray, u: FloatArray) -> NormalMixture:
        """Return the equal mixture of the members' distributions (..., ny)."""
        each = [member.predictive(part, u) for member, part in self._parts(x)]
        means, stds = (np.concatenate([getattr(one, name) for one in each], axis=-2) for name in ("means", "stds"))
        return NormalMixture(means, stds, self.spec.outputs)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next states (..., nx)."""
        return np.concatenate([member.step(part, u) for member, part in self._parts(x)], axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the states with the present output as it was measured (..., nx)."""
        return np.concatenate([member.correct(part, u, y) for member, part in self._parts(x)], axis=-1)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        members = [member.to_dict() for member in self.members]
        return {"kind": "network-ensemble", "spec": spec_to_dict(self.spec), "members": members, "notes": self.notes}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> EnsembleModel:
        """Return the model of a description."""
        members = tuple(NetworkModel.from_dict(one) for one in content["members"])
        return cls(spec_from_dict(content["spec"]), members, dict(content.get("notes", {})))

    def _parts(self, x: FloatArray) -> list[tuple[NetworkModel, FloatArray]]:
        return list(zip(self.members, np.split(np.asarray(x, dtype=float), len(self.members), axis=-1), strict=True))


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
