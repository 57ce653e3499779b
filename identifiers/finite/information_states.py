"""Approximate information states from records of observation, action and reward: a few states that histories need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.models.analysis import Findings, Takes, as_dataset
from harness.options import check_options
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.finite.bisimulation import bisimulation_metric, information_gap, quotient
from identifiers.finite.decision import optimal_values

Labels = npt.NDArray[np.intp]

_ENOUGH = 0.05  # A policy that loses no more than this share of what states differ by counts as good enough.
_MOST = 40  # Windows of the past at most: the metric compares every two of them.


@dataclass(frozen=True, eq=False)
class HistoryWindows:
    """The last few actions and observations as the state of a decision process, counted from records."""

    memory: int
    keys: npt.NDArray[np.int64]
    """(W, 2 memory): Actions and observations of each window, ``[a[k-1], y[k], a[k-2], y[k-1], ...]``."""
    count: FloatArray  # (W, A): Visits
    transition: FloatArray  # (W, A, W)
    reward: FloatArray  # (W, A): Means
    heard: FloatArray  # (W, A, O): Distribution of the next observation
    missing: float  # Share of the steps that led to windows or left by actions too rare to keep

    def number(self, past: Sequence[int]) -> int:
        """Return the window of a past ``[a[k-1], y[k], ...]``; the most visited one where it was too rare."""
        same = (self.keys == np.asarray(past)[: self.keys.shape[1]]).all(axis=1)
        return int(np.argmax(same)) if same.any() else int(np.argmax(self.count.sum(axis=1)))


def windows_of(records: Sequence[Trajectory], memory: int, *, least: int = 10) -> HistoryWindows:
    """Count the windows of records; those where an action was taken fewer than ``least`` times are left out.

    Raises FitError if the channels are others, or no window was visited often enough with every action.

    - ``records``: one category input, one category and one real output (the reward of the step that led to it)
    - ``memory``: pairs of action and observation
    """
    actions, observations, seen, earned = _channels(records[0].spec)
    table, rewards = [], []
    for record in records:
        if len(record) <= memory + 1:
            continue
        y, u = record.y[:, seen].astype(np.int64), record.u[:, 0].astype(np.int64)
        n = len(y) - memory  # windows end at samples memory .. N - 1
        parts = [part for j in range(memory) for part in (u[memory - 1 - j :][:n], y[memory - j :][:n])]
        table.append(np.column_stack([*parts, u[memory:], np.full(n, -1)]))
        table[-1][:-1, -1] = np.arange(1, n)  # the row of the next window, within the record
        rewards.append(np.append(record.y[memory + 1 :, earned], np.nan))
    if not table:
        raise FitError("information-states: records too short", expected=f"> {memory + 1}", got="less", remedy="record")
    start = np.cumsum([0, *(len(part) for part in table[:-1])])
    for part, offset in zip(table, start, strict=True):
        part[:-1, -1] += offset
    rows, reward = np.concatenate(table), np.concatenate(rewards)
    keys, window = np.unique(rows[:, :-2], axis=0, return_inverse=True)
    window = window.ravel()
    go = np.flatnonzero(rows[:, -1] >= 0)
    count = np.zeros((len(keys), actions))
    np.add.at(count, (window[go], rows[go, -2]), 1.0)
    kept = np.flatnonzero(count.min(axis=1) >= least)
    if not kept.size:
        raise FitError(
            f"information-states: windows of {memory} pairs",
            expected=f"some with every action taken {least} times",
            got=f"none of {len(keys)}",
            remedy="record longer with actions at random, or lower memory",
        )
    place = np.full(len(keys), -1)
    place[kept] = np.arange(len(kept))
    here, there, action = place[window[go]], place[window[rows[go, -1]]], rows[go, -2]
    fine = (here >= 0) & (there >= 0)
    transition, total = np.zeros((len(kept), actions, len(kept))), np.zeros((len(kept), actions))
    heard = np.zeros((len(kept), actions, observations))
    np.add.at(transition, (here[fine], action[fine], there[fine]), 1.0)
    np.add.at(total, (here[here >= 0], action[here >= 0]), reward[go][here >= 0])
    np.add.at(heard, (here[here >= 0], action[here >= 0], rows[rows[go, -1], 1][here >= 0]), 1.0)
    lost = transition.sum(axis=2, keepdims=True)
    if (lost == 0).any():
        raise FitError(
            "information-states: a window always leads to ones that were too rare",
            expected="windows that lead to each other",
            got=f"{int((lost == 0).sum())} steps that do not",
            remedy="record longer with actions at random, or lower memory",
        )
    visits = count[kept]
    return HistoryWindows(
        memory,
        keys[kept],
        visits,
        transition / lost,
        total / visits,
        heard / heard.sum(axis=2, keepdims=True),
        float(1.0 - fine.mean()),
    )


@dataclass(frozen=True)
class InformationStates:
    """How few states stand for all that a history tells, from records of observation, action and reward.

    Histories are cut to their last pairs of action and observation and counted as a decision process; the bisimulation
    metric between them (Ferns, Panangaden & Precup 2004) says which predict the same, and those are joined one by one.
    Each row is an approximate information state (Subramanian et al. 2022, *JMLR* 23(12), definition 7) with its errors
    of reward (epsilon) and of prediction (delta), the bound on values that they give (theorem 9), what the values
    really differ by and what its policy really loses on the process of all windows.

    Parameters
    ----------
    memory : int
        Pairs of action and observation that are looked back on.
    discount : float
    least : int
        Visits that a window needs with every action.
    """

    takes: ClassVar[Takes] = "data"
    memory: int = 2
    discount: float = 0.9
    least: int = 10

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the ladder of states with bound and realised loss."""
        check_options(self, "information-states", memory=">= 1", discount=">= 0, < 1", least=">= 1")
        records = [record.measured() for record in as_dataset(subject, "information-states").estimation]
        windows = windows_of(records, self.memory, least=self.least)
        process, reward = windows.transition, windows.reward
        if len(reward) > _MOST:
            raise FitError(
                f"information-states: windows of {self.memory} pairs",
                expected=f"at most {_MOST}, since the metric compares every two",
                got=str(len(reward)),
                remedy="lower memory",
            )
        fine = 1e-3 * max(float(np.ptp(reward)), 1e-12)
        distance = bisimulation_metric(process, reward, self.discount, tolerance=fine)
        rows, ladder = [], _joined(distance)
        for labels in ladder:
            gap = information_gap(process, reward, labels, self.discount)
            rows.append(
                {
                    "states": int(labels.max()) + 1,
                    "epsilon": gap.epsilon,
                    "delta": gap.delta,
                    "bound": gap.bound,
                    "realised": gap.realised,
                    "loss of the policy": gap.loss,
                }
            )
        values, _ = optimal_values(process, reward, self.discount)
        enough = _ENOUGH * float(np.ptp(values)) + 1e-9
        few = max(i for i, row in enumerate(rows) if row["loss of the policy"] <= enough)
        labels = ladder[few]
        small, earned = quotient(process, reward, labels)
        policy = np.argmax(optimal_values(small, earned, self.discount)[1], axis=1)[labels]
        words = (
            f"{len(reward)} windows of {self.memory} pairs, visited {windows.count.min():.0f} to "
            f"{windows.count.max():.0f} times with each action ({windows.missing:.0%} of the steps left out)",
            f"{rows[few]['states']} states are enough to act on: their policy loses "
            f"{rows[few]['loss of the policy']:.3g}, the bound allows {2 * rows[few]['bound']:.3g}",
            _longer(records, windows, self.least),
        )
        details = {"keys": windows.keys, "labels": labels, "policy": policy, "values": values, "distance": distance}
        return Findings("information states", rows, words, details)


def _channels(spec: PlantSpec) -> tuple[int, int, int, int]:
    """Return the numbers of actions and observations, and which outputs are observation and reward."""
    category = [i for i, channel in enumerate(spec.outputs) if channel.kind == "category"]
    real = [i for i, channel in enumerate(spec.outputs) if channel.kind == "real"]
    if len(category) != 1 or len(real) != 1 or spec.nu != 1 or spec.inputs[0].kind != "category":
        raise FitError(
            "information-states",
            expected="a category input (the action), a category output (the observation), a real one (the reward)",
            got=str(spec),
            remedy="declare categories in dataset.toml, and measure the reward",
        )
    return spec.inputs[0].categories, spec.outputs[category[0]].categories, category[0], real[0]


def _joined(distance: FloatArray) -> list[Labels]:
    """Return partitions from all apart to all together, the nearest two groups joined each time (farthest members)."""
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial.distance import squareform

    count = len(distance)
    if count == 1:
        return [np.zeros(1, dtype=np.intp)]
    tree = linkage(squareform(distance, checks=False), "complete")
    found: list[Labels] = []
    for groups in range(count, 0, -1):
        labels = fcluster(tree, groups, "maxclust") - 1
        if not found or labels.max() < found[-1].max():
            found.append(np.asarray(labels, dtype=np.intp))
    return found


def _longer(records: Sequence[Trajectory], windows: HistoryWindows, least: int) -> str:
    """Return whether one pair more in the window predicts otherwise, beyond what its counts explain."""
    try:
        longer = windows_of(records, windows.memory + 1, least=least)
    except FitError:
        return "the records are too short to tell whether a longer memory would predict more"
    shared = 2 * windows.memory
    parent = [windows.number(key[:shared]) for key in longer.keys]
    apart = longer.heard - windows.heard[parent]
    expected = np.maximum(windows.heard[parent], 1e-9)
    statistic = float((longer.count[:, :, None] * apart**2 / expected).sum())
    free = longer.count.size * (longer.heard.shape[2] - 1)
    from scipy.stats import chi2

    chance = float(chi2.sf(statistic, free))
    if chance < 0.01:
        return f"a memory of {windows.memory + 1} predicts more (p = {chance:.2g}): the history tells more than these"
    return f"a memory of {windows.memory + 1} predicts no more than chance (p = {chance:.2g})"
