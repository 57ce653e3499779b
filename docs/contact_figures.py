"""Draw docs/adaptive.svg, docs/contact.svg and docs/masses.svg: a controller that learns, a block, masses of an arm.

Run: python docs/contact_figures.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from harness import api, registry
from harness.rng import Streams
from harness.rollout import perform, run
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

GRAVITY = 9.81


ANGLES = {"pendulum": ("theta",), "double-pendulum": ("theta1", "theta2")}
ADAPTATION = {"pendulum": 100.0, "double-pendulum": 1000.0}


def adaptive(model: str, method: str, *, rich: bool, duration: float) -> dict[str, Any]:
    """Return a run of a mechanism whose controller believes in a fifth of every parameter.

    Parameters
    ----------
    model : {"pendulum", "double-pendulum"}
    method : {"slotine-li", "identifier"}
    rich : bool
        A reference of six sines at each joint, else a set point 1 rad away.
    duration : float
        [s].
    """
    angles = ANGLES[model]
    outputs = [*angles, *((name, 1) for name in angles)]
    plant = registry.create("plants", "ode", model=model, outputs=outputs, sample_time=0.005)
    scenario = registry.create(
        "scenarios", "adaptive-control", mechanism=model, method=method, duration=duration,
        move={} if rich else dict.fromkeys(angles, 1.0), amplitude=1.0 if rich else 0.0, band=(0.1, 1.0), lines=6,
        adaptation=ADAPTATION[model],
    )  # fmt: skip
    streams = Streams("ode", "adaptive-control", seed=0)
    experiment = scenario.prepare(plant.spec, streams=streams, role="estimation/0")
    record = perform(plant, experiment, rng=streams("estimation/0/plant"))
    learned: Any = experiment.controller
    reference = np.column_stack(list(learned.references.values()))
    truth = learned.tracking.law.regression.values(plant.system.values())
    return {
        "t": record.t,
        "error": np.abs(record.y[:, : len(angles)] - reference).max(axis=1),
        "parameters": np.abs(learned.estimates / truth - 1).max(axis=1),
    }


def pushed(noise: float = 1e-4, seed: int = 0, duration: float = 15.0) -> Trajectory:
    """Return a record of the pushed block under pushes and retreats."""
    streams = Streams("pushed-block-pymunk", "steps", seed=seed)
    scenario = registry.create(
        "scenarios", "steps", duration=duration, amplitude=20.0, offset=6.0, dwell=0.4, noise={"x": noise, "f": 0.05}
    )
    with registry.create("plants", "pushed-block-pymunk") as plant:
        return run(plant, scenario, streams=streams, role="estimation/0").measured()


def block_alone(record: Trajectory, force: FloatArray) -> Trajectory:
    """Return the block as a record of its own, driven by a force (N,) [N] held over each sample."""
    spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), record.spec.sample_time)
    return Trajectory(record.t, force[:, None], record.y[:, :1], spec)


def mass_and_friction(record: Trajectory) -> tuple[float, float]:
    """Return m [kg] and mu of a block from its own record: output error, Coulomb friction in the model."""
    identifier = registry.create(
        "identifiers", "output-error", model="drive", effects=("coulomb_friction@q",), horizon=0.5,
        start={"M": 1.0, "Fv": 0.0, "coulomb_friction@q.Fc": 3.0}, fixed=("Fv", "offset", "coulomb_friction@q.w"),
    )  # fmt: skip
    model = identifier.fit([record], rng=np.random.default_rng(0))
    mass = model.parameters["M"]
    return mass, model.parameters["coulomb_friction@q.Fc"] / (mass * GRAVITY)


def contact(record: Trajectory) -> dict[str, tuple[float, float]]:
    """Return m and mu with the contact force measured, and with the pusher's drive taken for it."""
    felt = np.append(record.y[1:, 2], 0.0)  # the mean force over the sample that follows
    return {
        "contact force measured": mass_and_friction(block_alone(record, felt)),
        "drive of the pusher taken for it": mass_and_friction(block_alone(record, record.u[:, 0])),
    }


def masses(path: Path) -> None:
    """Draw the intervals of the masses of the record of docs/arms.md."""
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "run.csv"
        api.simulate(
            "iiwa-bullet", scenario="arm-designed", scenario_options={"duration": 20.0, "noise": 1e-4}, out=record
        )
        print(api.analyse("mass-intervals", record, out=path, force=True).words)


def main() -> None:
    """Print the figures and draw the plots."""
    import matplotlib.pyplot as plt

    figure, grid = plt.subplots(2, 2, figsize=(8, 5), sharex="col", squeeze=False)
    for axes, model in zip(grid, ANGLES, strict=True):
        for method, colour in (("slotine-li", "tab:blue"), ("identifier", "tab:red")):
            still = adaptive(model, method, rich=False, duration=20.0)
            rich = adaptive(model, method, rich=True, duration=60.0)
            axes[0].semilogy(still["t"], still["error"] + 1e-16, color=colour, label=method)
            axes[1].semilogy(rich["t"], rich["parameters"], color=colour, label=method)
            print(f"{model}, {method}: {still['error'][-1]:.1e} rad at the set point, parameters "
                  f"{rich['parameters'][-1]:.2g}, tracking {rich['error'][-2000:].max():.2g} rad")  # fmt: skip
        axes[0].set_title(model.replace("-", " "), fontsize=9)
        axes[0].set_ylabel("error at the set point [rad]")
        axes[1].set_ylabel("worst relative parameter error")
    for ax in grid.ravel():
        ax.legend(fontsize=8)
    for ax in grid[1]:
        ax.set_xlabel("t [s]")
    figure.tight_layout()
    figure.savefig(Path(__file__).with_name("adaptive.svg"), metadata={"Date": None})

    record = pushed()
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(7, 4), sharex=True)
    top.plot(record.t, record.y[:, 1], label="pusher")
    top.plot(record.t, record.y[:, 0], label="block")
    top.set_ylabel("face [m]")
    bottom.plot(record.t, record.u[:, 0], lw=0.8, label="drive of the pusher")
    bottom.plot(record.t, record.y[:, 2], lw=0.8, label="contact force")
    bottom.set_ylabel("force [N]")
    bottom.set_xlabel("t [s]")
    for ax in (top, bottom):
        ax.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(Path(__file__).with_name("contact.svg"), metadata={"Date": None})
    for name, (mass, mu) in contact(record).items():
        print(f"{name}: m {mass:.3f} kg (2), mu {mu:.3f} (0.4)")
    masses(Path(__file__).with_name("masses.svg"))


if __name__ == "__main__":
    main()
