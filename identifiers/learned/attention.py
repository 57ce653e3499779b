"""Autoregressive network with attention over past samples: trained with torch, run with numpy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray, Trajectory
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.learned.ensemble import Ensemble
from identifiers.learned.lag_training import LagNetwork, lag_task
from identifiers.learned.training import Trained

NEEDS = ("torch",)

_TABLES = ("embed", "place", "query", "key", "value", "mix", "inner", "bias", "outer", "read")
"""Of every member, in the order in which they are trained."""


@dataclass(frozen=True, eq=False)
class AttentionModel(LagNetwork):
    """The change of the output is affine in the lags, plus what attention finds in them.

    Every past sample ``[y, u]`` is a token. The newest asks, all of them answer: scaled dot-product attention with
    several heads and learned places (Vaswani et al. 2017, *NeurIPS*, eq. 1 and sec. 3.2.2), then a tanh layer, each
    added to what was there. With one output to predict only the newest token needs to ask.

    Parameters
    ----------
    tables : dict of array
        embed (ny + nu, d), place (L, d), query, key, value (d, d), mix (d, d), inner (d, h), bias (1, h), outer
        (h, d), read (d, ny).
    heads : int
    """

    tables: dict[str, FloatArray]
    heads: int
    kind = "attention"

    def change(self, x: FloatArray) -> FloatArray:
        """Return the scaled addition (..., ny) of the network at scaled rows (..., p)."""
        found = _attend(np, [self.tables[name] for name in _TABLES], x.reshape(-1, x.shape[-1]), self.heads)
        return np.asarray(found.reshape(*x.shape[:-1], self.spec.ny))

    def attention(self, rows: FloatArray) -> FloatArray:
        """Return the weights (n, heads, L) of the past samples, newest first, at regressors (n, p)."""
        tables = [self.tables[name] for name in _TABLES]
        return np.asarray(_weights(np, tables, _tokens(tables, self.scaling.rows(rows)), self.heads))


@dataclass(frozen=True, eq=False)
class AttentionEnsemble(Ensemble):
    """Attention networks as one model."""

    kind = "attention-ensemble"
    member = AttentionModel


@dataclass(frozen=True)
class AttentionNetwork(Excited, Trained):
    """Ensemble of networks that look back over many samples by attention, for plants whose past matters late.

    As ``neural-network`` an affine fit comes first and the network learns what it leaves; the last fifth of every
    record is held out. Attention costs as much with 50 lags as with 5, and finds which of them matter. Needs torch for
    the fit (extra ``learned``); the model runs with numpy.

    Parameters
    ----------
    order : int
        Past outputs and inputs.
    width : int
        Numbers that a sample is turned into; a multiple of ``heads``.
    heads : int
        Questions asked at the same time.
    hidden : int
        Units of the tanh layer.
    members : int
        Networks.
    """

    order: int = 20
    width: int = 16
    heads: int = 4
    hidden: int = 32
    members: int = 3
    _: KW_ONLY
    steps: int = 1500

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> AttentionEnsemble:
        """Return the ensemble; held-out losses stand in its notes."""
        what = "attention-network"
        self.check_numbers(what, "order", "width", "heads", "hidden", "members")
        if self.width % self.heads:
            raise InputError(
                f"width of {what}",
                expected="a multiple of heads",
                got=f"{self.width}, heads {self.heads}",
                remedy="correct one of them",
            )
        task = lag_task(trajectories, self.order, what, self)
        spec, d = task.spec, self.width
        shapes = {
            "embed": (spec.ny + spec.nu, d),
            "place": (self.order, d),
            **{name: (d, d) for name in ("query", "key", "value", "mix")},
            "inner": (d, self.hidden),
            "bias": (1, self.hidden),
            "outer": (self.hidden, d),
            "read": (d, spec.ny),
        }
        tables = [rng.normal(size=(self.members, *shapes[name])) / np.sqrt(shapes[name][0]) for name in _TABLES]
        tables[_TABLES.index("place")] *= np.sqrt(self.order)
        tables[_TABLES.index("bias")] *= 0.0
        tables[_TABLES.index("read")] *= 0.1
        found, history = task.train(
            tables,
            lambda torch, tensors, rows: _attend(torch, tensors, rows, self.heads),
            self,
            rng=rng,
            what=what,
        )
        members = []
        for number in range(self.members):
            own = {name: table[number] for name, table in zip(_TABLES, found, strict=True)}
            own["read"] = own["read"] * task.size
            shared = (spec, self.order, task.scaling, task.affine, np.ones(spec.ny), None)
            members.append(AttentionModel(*shared, tables=own, heads=self.heads))
        notes = {"held-out loss": history[-1], "samples": len(task.x), "held out": len(task.kept)}
        return task.far(AttentionEnsemble(spec, task.banded(members), notes), what)


# ---- one definition for numpy, which runs, and torch, which trains ---------------------------------------------------


def _tokens(tables: Sequence[Any], rows: Any) -> Any:
    """Return the embedded samples (..., n, L, d) of rows (..., n, L (ny + nu)), newest first."""
    embed, place = tables[0], tables[1]
    lags, signals = place.shape[-2], embed.shape[-2]
    outputs = tables[_TABLES.index("read")].shape[-1]
    y = rows[..., : lags * outputs].reshape(*rows.shape[:-1], lags, outputs)
    u = rows[..., lags * outputs :].reshape(*rows.shape[:-1], lags, signals - outputs)
    return y @ embed[..., None, :outputs, :] + u @ embed[..., None, outputs:, :] + place[..., None, :, :]


def _weights(library: Any, tables: Sequence[Any], tokens: Any, heads: int) -> Any:
    """Return the attention of the newest token (..., n, heads, L)."""
    query, key = tables[2], tables[3]
    *lead, lags, d = tokens.shape
    asked = (tokens[..., 0, :] @ query).reshape(*lead, heads, 1, d // heads)
    keys = (tokens @ key[..., None, :, :]).reshape(*lead, lags, heads, d // heads).swapaxes(-3, -2)
    scores = (asked * keys).sum(-1) / (d // heads) ** 0.5
    powers = library.exp(scores - library.amax(scores, -1)[..., None])
    return powers / powers.sum(-1)[..., None]


def _attend(library: Any, tables: Sequence[Any], rows: Any, heads: int) -> Any:
    """Return the outputs (..., n, ny) of rows (..., n, p); tables may have a leading axis of members."""
    _, _, _, _, value, mix, inner, bias, outer, read = tables
    tokens = _tokens(tables, rows)
    *lead, lags, d = tokens.shape
    share = _weights(library, tables, tokens, heads)
    values = (tokens @ value[..., None, :, :]).reshape(*lead, lags, heads, d // heads).swapaxes(-3, -2)
    answer = (share[..., None] * values).sum(-2).reshape(*lead, d)
    x = tokens[..., 0, :] + answer @ mix
    x = x + library.tanh(x @ inner + bias) @ outer
    return x @ read
