"""Draw docs/finite.svg and docs/learned.svg: three experiments with finite processes, three with learned functions.

Run ``python docs/learned_figures.py``; about half a minute of CPU.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from harness import registry
from harness.rng import Streams
from harness.rollout import run
from harness.scoring import predict
from harness.signals import Trajectory
from identifiers.common.lag_state import regression_data
from identifiers.finite.bisimulation import bisimulation, quotient
from identifiers.finite.decision import optimal_values
from identifiers.finite.hmm import HiddenMarkov
from identifiers.finite.mdp import MdpCounting, weissman_bound
from identifiers.hybrid.piecewise_affine import PiecewiseAffine
from identifiers.learned.gaussian_process import GaussianProcess
from identifiers.learned.recurrent import NeuralOutputError
from identifiers.linear.least_squares import Arx
from plants.finite.mdp import FiniteMdp
from plants.finite.pomdp import FinitePomdp

RNG = np.random.default_rng(0)


def record(plant: Any, scenario: str, role: str = "estimation/0", **options: Any) -> Trajectory:
    """Return a record of a plant."""
    return run(
        plant, registry.create("scenarios", scenario, **options), streams=Streams("figure", scenario, 0), role=role
    )


def counting(axes: Any) -> None:
    """Error of counted probabilities over the samples, below the Weissman bound."""
    table = RNG.dirichlet(np.ones(4), size=(4, 1))
    data = record(FiniteMdp(table), "random-policy", samples=40_000)
    sizes = np.unique(np.geomspace(100, len(data), 12).astype(int))
    worst, bound = [], []
    for n in sizes:
        model = MdpCounting().fit([data[:n]], rng=RNG)
        worst.append(np.abs(model.transition - table).sum(axis=2).max())
        bound.append(weissman_bound(model.visits, 4).max())
    axes.loglog(sizes, bound, "k--", label="Weissman bound, 95 %")
    axes.loglog(sizes, worst, "o-", label="worst row")
    axes.loglog(sizes, worst[0] * np.sqrt(sizes[0] / sizes), ":", label="$1/\\sqrt{n}$")
    axes.set(title="Counting", xlabel="samples", ylabel="l1 error of probabilities")
    axes.legend(fontsize=7)


def hidden(axes: Any) -> None:
    """Recovered against true probabilities of a POMDP."""
    transition = np.array([[[0.9, 0.1], [0.3, 0.7]], [[0.2, 0.8], [0.6, 0.4]]])
    emission = np.array([[0.9, 0.1, 0.0], [0.0, 0.2, 0.8]])
    plant = FinitePomdp(transition, emission)
    for samples, mark in ((400, "x"), (4000, "o")):
        data = record(plant, "random-policy", samples=samples).measured()
        model = HiddenMarkov(states=2).fit([data], rng=RNG).matched(emission)
        true = np.concatenate([transition.ravel(), emission.ravel()])
        found = np.concatenate([model.transition.ravel(), model.emission.ravel()])
        axes.plot(true, found, mark, label=f"N = {samples}")
    axes.plot([0, 1], [0, 1], "k:", lw=0.8)
    axes.set(title="Hidden Markov model with actions", xlabel="true probability", ylabel="found by Baum-Welch")
    axes.legend(fontsize=7)


def lumping(axes: Any) -> None:
    """Transition probabilities of 40 states before, and of the 8 classes that bisimulation finds after."""
    small, reward = RNG.dirichlet(np.full(8, 0.4), size=(8, 2)), RNG.random((8, 2))
    labels = RNG.permutation(np.repeat(np.arange(8), 5))
    table = np.zeros((40, 2, 40))
    for s, label in enumerate(labels):
        for a in range(2):
            for b in range(8):
                table[s, a, labels == b] = small[label, a, b] * RNG.dirichlet(np.ones(5))
    found = bisimulation(table, reward[labels])
    reduced, earned = quotient(table, reward[labels], found)
    gap = np.abs(optimal_values(table, reward[labels], 0.9)[0] - optimal_values(reduced, earned, 0.9)[0][found]).max()
    count = int(found.max()) + 1
    axes.imshow(table[:, 0], extent=(0, 40, 40, 0), cmap="Blues", vmax=0.3)
    axes.imshow(reduced[:, 0], extent=(48, 88, 40, 0), cmap="Blues", vmax=1.0)
    axes.annotate("", (47, 20), (41, 20), arrowprops={"arrowstyle": "->"})
    axes.set(xlim=(0, 88), xticks=[20, 68], yticks=[], xticklabels=["40 states, before", f"{count} classes, after"])
    axes.set(title=f"Exact bisimulation: values differ by {gap:.0e}")


def bands(axes: Any) -> None:
    """Bands of a Gaussian process of a pendulum's acceleration, inside and outside its data."""
    plant = registry.create("plants", "pendulum-ode", sample_time=0.1, outputs=[["theta", 0], ["theta", 1]])
    data = record(plant, "multisine", samples=150, amplitude=0.5, band=[0.05, 2.0], noise=0.01).measured()
    model = GaussianProcess().fit([data], rng=RNG)
    angles = np.linspace(-3.5, 3.5, 200)
    rows = np.column_stack([angles, np.zeros(200), np.zeros(200)])
    mean, variance = model.ahead(rows)
    change, std = mean[:, 1], np.sqrt(variance[:, 1])
    axes.fill_between(angles, change - 1.645 * std, change + 1.645 * std, alpha=0.3, label="90 % band")
    axes.plot(angles, change, label="Gaussian process")
    true = []
    for angle in angles:
        plant.reset(rng=RNG, x0={"theta": float(angle)})
        true.append(plant.step(np.zeros(1))[1])
    axes.plot(angles, true, "k--", lw=0.8, label="plant")
    axes.plot(data.y[:, 0], np.full(len(data), -1.9), "|", ms=4, label="data")
    axes.set(
        title="Bands in and out of the data", xlabel="theta [rad]", ylabel="rate after 0.1 s [rad/s]", ylim=(-2, 2)
    )
    axes.legend(fontsize=7)


def switching(axes: Any) -> None:
    """Draw a free run of the cart at the wall."""
    plant = registry.create("plants", "cart-wall-pymunk", outputs=["x", "x_rate"])
    options = dict(duration=30.0, amplitude=4.0, band=[0.05, 4.0], noise=1e-4)
    learn, held = (record(plant, "multisine", f"{role}/0", **options) for role in ("estimation", "validation"))
    model = PiecewiseAffine(starts=1).fit([learn.measured()], rng=RNG)
    affine = Arx(order=1).fit([learn.measured()], rng=RNG)
    part = held[:500]
    touching = np.append(model.mode(regression_data([part], 1)[0]) == 1, False)
    axes.axhline(plant.wall, color="0.7", lw=6, alpha=0.4, label="wall")
    axes.plot(part.t, part.y[:, 0], "k", label="pymunk")
    axes.plot(part.t, predict(affine, part, None)[:, 0], ":", label="one affine model")
    axes.plot(part.t, predict(model, part, None)[:, 0], "--", label="piecewise affine")
    axes.plot(part.t[touching], part.y[touching, 0], "r.", ms=3, label="found: in contact")
    axes.set(title="Cart and soft wall, free run", xlabel="time [s]", ylabel="x [m]")
    axes.legend(fontsize=7)


def ensemble(axes: Any) -> None:
    """Bands of an ensemble of networks along a free run that leaves the inputs which it learned from."""
    plant = registry.create("plants", "pendulum-ode", sample_time=0.1)
    learn = record(plant, "multisine", samples=600, amplitude=0.4, band=[0.05, 2.0], noise=0.005).measured()
    calm = record(plant, "multisine", "v/0", samples=120, amplitude=0.4, band=[0.05, 2.0], noise=0.005).measured()
    wild = record(plant, "multisine", "v/1", samples=120, amplitude=0.8, band=[0.05, 2.0], noise=0.005).measured()
    model = NeuralOutputError(order=2, starts=16, members=5, ridge=0.1).fit([learn], rng=RNG)
    for part, late, name in ((calm, 0.0, "as learned from"), (wild, 13.0, "wilder")):
        x, mean, low, high = model.initial_state(part), [], [], []
        for k in range(len(part)):
            said = model.predictive(x, part.u[k])
            ends = said.interval(0.9)
            mean.append(said.mean[0])
            low.append(ends[0][0])
            high.append(ends[1][0])
            x = model.step(x, part.u[k])
        t, y, middle = part.t + late, part.y[:, 0], np.array(mean)
        inside = np.mean((y >= low) & (y <= high))
        label = f"90 %, {name}: holds {100 * inside:.0f} %"
        axes.fill_between(t, low - middle, high - middle, alpha=0.4, label=label)
        axes.plot(t, y - middle, "k.", ms=3)
    axes.set(title="Ensemble of networks, free run", xlabel="time [s]", ylabel="theta error [rad]", ylim=(-3, 3))
    axes.set_yscale("symlog", linthresh=0.1)
    axes.legend(fontsize=7, loc="lower left")


def main() -> None:
    """Draw the figures."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "learned", "font.size": 8})
    from matplotlib import pyplot as plt

    for name, drawn in (("finite", (counting, hidden, lumping)), ("learned", (switching, bands, ensemble))):
        figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
        for draw, place in zip(drawn, axes, strict=True):
            draw(place)
        figure.savefig(Path(__file__).with_name(f"{name}.svg"), metadata={"Date": None})


if __name__ == "__main__":
    main()
