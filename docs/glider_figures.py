"""Draw docs/glider.svg: the perching glider's forces from basis functions, and held-out error against their number.

Run: python docs/glider_figures.py FOLDER     (the folder that holds glider_sim_data.npz)
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from harness.signals import FloatArray
from identifiers.common.normal import NormalEquations
from identifiers.mechanics.glider import along_the_wing, glider_functions
from identifiers.sparse.selection import best_subset

SIX = ((7, 24), (1, 6, 9), (29, 30))
"""The sixth configuration of the exercise: numbers of the functions of the three accelerations."""


def chosen(table: FloatArray, target: FloatArray, most: int) -> FloatArray:
    """Return the coefficients (20,) of the best subset of up to so many functions."""
    equations = NormalEquations.of([(table.T, target[None])], table.shape[1], 1)
    return np.asarray(best_subset(equations, most)[0][:, 0])


def rows(data: dict[str, FloatArray], runs: slice, *, nose_down: bool) -> tuple[dict[int, FloatArray], FloatArray]:
    """Return the functions and the three accelerations of some runs."""
    q, u = data["states"][runs, :-1].reshape(-1, 7), data["u"][runs].ravel()
    accelerations = data["accels"][runs].reshape(-1, 7)
    table = glider_functions(q, u, nose_down=nose_down)
    return table, along_the_wing(q, accelerations[:, 4:7], nose_down=nose_down)


def score_of_six(data: dict[str, FloatArray], *, nose_down: bool) -> float:
    """Return the sum of squares that the sixth configuration leaves on runs 1 to 14."""
    table, target = rows(data, slice(1, None), nose_down=nose_down)
    total = 0.0
    for column, numbers in enumerate(SIX):
        part = np.column_stack([table[number] for number in numbers])
        rest = target[:, column] - part @ np.linalg.lstsq(part, target[:, column], rcond=None)[0]
        total += float(rest @ rest)
    return total


def score_of_best(data: dict[str, FloatArray], most: int, *, nose_down: bool) -> tuple[float, list[list[int]]]:
    """Return the sum of squares that the best subsets leave on runs 1 to 14, and the numbers of their functions."""
    table, target = rows(data, slice(1, None), nose_down=nose_down)
    wide, names, total, found = np.column_stack(list(table.values())), list(table), 0.0, []
    for column in range(3):
        own = chosen(wide, target[:, column], most)
        total += float(np.sum((target[:, column] - wide @ own) ** 2))
        found.append([names[k] for k in np.flatnonzero(own)])
    return total, found


def held_out(data: dict[str, FloatArray], noise: float, counts: range, draws: int = 20) -> FloatArray:
    """Return the rms error of the pitch acceleration, fitted on one noisy run, (2, counts): on that run, and on others.

    Parameters
    ----------
    data : mapping
    noise : float
        Standard deviation on the accelerations, relative to theirs: the experiment differentiated positions twice.
    counts : range
        Numbers of functions, always that many: the subset that fits the noisy run best.
    draws : int
    """
    rng = np.random.default_rng(0)
    errors = np.zeros((2, len(counts)))
    for draw in range(draws):
        run = draw % len(data["states"])
        table, target = rows(data, slice(run, run + 1), nose_down=True)
        rest, truth = rows(data, slice(None), nose_down=True)
        wide, others = np.column_stack(list(table.values())), np.column_stack(list(rest.values()))
        seen = target[:, 2] + noise * target[:, 2].std() * rng.normal(size=len(target))
        keep: list[int] = []
        for place, count in enumerate(counts):
            while len(keep) < count:  # forward, always the function that helps the noisy run most
                free = [k for k in range(wide.shape[1]) if k not in keep]
                keep.append(min(free, key=lambda k: _left(wide[:, [*keep, k]], seen)))
            own = np.linalg.lstsq(wide[:, keep], seen, rcond=None)[0]
            for row, (part, aim) in enumerate(((wide, seen), (others, truth[:, 2]))):
                errors[row, place] += float(np.mean((aim - part[:, keep] @ own) ** 2)) / draws
    return np.sqrt(errors)


def _left(part: FloatArray, target: FloatArray) -> float:
    """Return the sum of squares that a fit leaves."""
    return float(np.sum((target - part @ np.linalg.lstsq(part, target, rcond=None)[0]) ** 2))


def main() -> None:
    """Print the figures and draw the plot."""
    import matplotlib.pyplot as plt

    data = dict(np.load(Path(sys.argv[1]) / "glider_sim_data.npz"))
    print(f"sixth configuration as written: {score_of_six(data, nose_down=False):.2f}")
    print(f"the same with consistent signs: {score_of_six(data, nose_down=True):.2f}")
    for most in (1, 2, 3):
        written, consistent = (score_of_best(data, most, nose_down=sign) for sign in (False, True))
        print(f"best {most}: as written {written[0]:.1f}, with consistent signs {consistent[0]:.4f} {consistent[1]}")
    counts = range(1, 13)
    figure, axes = plt.subplots(figsize=(6, 3.2))
    for noise, colour in ((0.1, "tab:blue"), (0.3, "tab:red")):
        inside, outside = held_out(data, noise, counts)
        best = counts[int(np.argmin(outside))]
        print(f"noise {noise:.0%}: held out least with {best} functions; on the run {inside.round(2).tolist()}, "
              f"held out {outside.round(2).tolist()}")  # fmt: skip
        axes.plot(counts, inside, "--", color=colour, label=f"run that was fitted, noise {noise:.0%}")
        axes.plot(counts, outside, "o-", ms=3, color=colour, label=f"all runs without noise, noise {noise:.0%}")
    axes.set_xlabel("functions of the pitch acceleration")
    axes.set_ylabel("rms error [rad/s²]")
    axes.set_yscale("log")
    axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(Path(__file__).with_name("glider.svg"), metadata={"Date": None})


if __name__ == "__main__":
    main()
