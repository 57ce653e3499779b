"""Draw docs/mechanical.svg and docs/acrobot.svg: the textbook's cart-pole, and its Acrobot under joint offsets.

Run: python docs/mechanical_figures.py FOLDER     (the folder that holds cartpole_lumped_data_damped.npz)
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import sympy as sp
from scipy.interpolate import make_interp_spline

from harness import registry
from harness.errors import PlantError
from harness.physics import Mechanism
from harness.rng import Streams
from harness.rollout import run
from harness.signals import Channel, PlantSpec, Trajectory

TRUTH = {"mc + mp": 11.0, "l*mp": 0.5, "l**2*mp": 0.25}
OFFSETS = (0.0, 0.0025, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.025, 0.03, 0.035, 0.04, 0.045)
UNITS = {"": "m", "_rate": "m/s", "_acceleration": "m/s^2"}


def textbook_model() -> Mechanism:
    """Return the cart-pole of the textbook's example, theta from hanging."""
    m = Mechanism("cart-pole", q="x theta", u="u", p="mc mp l bx bt")
    (x, theta), (speed, rate), (u,), (mc, mp, length, bx, bt) = m.q, m.v, m.u, m.p
    m.body(mc, (x, 0))
    m.body(mp, (x + length * sp.sin(theta), -length * sp.cos(theta)))
    m.Q = [u - bx * speed, -bt * rate]
    return m


def record(t: np.ndarray, u: np.ndarray, columns: dict[str, np.ndarray], sample_time: float) -> Trajectory:
    """Return a record of coordinates and of derivatives that stand beside them, by name."""
    channels = []
    for name in columns:
        coordinate, mark, kind = name.partition("_")
        unit = UNITS[mark + kind]
        channels.append(Channel(name, unit if coordinate == "x" else unit.replace("m", "rad", 1)))
    spec = PlantSpec((Channel("u", "N"),), tuple(channels), sample_time)
    return Trajectory(t, u, np.column_stack(list(columns.values())), spec)


def chapter(folder: Path) -> list[Trajectory]:
    """Return the chapter's rows: states as they were, forward differences as recorded accelerations, 87 rows a run.

    The samples lie where an integrator stepped, 0.1 ms to 60 ms apart. The torque form needs no time once the
    accelerations are given, so the records carry the number of the sample instead of the time.
    """
    content = np.load(folder / "cartpole_lumped_data_damped.npz")
    few, records = len(content["t0"]) - 1, []
    for k in range(4):
        t, x, u = content[f"t{k}"], content[f"X{k}"], content[f"u{k}"].reshape(-1, 1)
        forward = (np.diff(x[2:], axis=1) / np.diff(t))[:, :few]
        names = ("x", "theta", "x_rate", "theta_rate", "x_acceleration", "theta_acceleration")
        columns = dict(zip(names, [*x[:, :few], *forward], strict=True))
        records.append(record(np.arange(few, dtype=float), u[:few], columns, 1.0))
    return records


def resampled(folder: Path, sample_time: float = 0.005) -> list[Trajectory]:
    """Return the same runs at even instants, by quintic splines through states and force."""
    content, records = np.load(folder / "cartpole_lumped_data_damped.npz"), []
    for k in range(4):
        t, x, u = content[f"t{k}"], content[f"X{k}"], content[f"u{k}"].reshape(-1, 1)
        even = t[0] + np.arange(int((t[-1] - t[0]) / sample_time)) * sample_time
        states = make_interp_spline(t, x.T, k=5)(even)
        columns = dict(zip(("x", "theta", "x_rate", "theta_rate"), states.T, strict=True))
        records.append(record(even, make_interp_spline(t, u, k=5)(even), columns, sample_time))
    return records


def fits(folder: Path) -> dict[str, dict[str, float]]:
    """Return the lumped parameters by method, each by an identifier from records."""
    common = {"model": f"{Path(__file__).resolve()}:textbook_model", "known": {"bx": 0.1, "bt": 0.1}}
    smooth = {**common, "intersample": "smooth"}
    exactly = {**smooth, "smoothing": "none", "estimator": "unweighted"}
    even = resampled(folder)
    methods = {
        "torque, forward differences": ("lumped-torque", exactly, chapter(folder)),
        "torque, spline": ("lumped-torque", smooth, even),
        "energy": ("lumped-energy", smooth, even),
        "momentum": ("lumped-momentum", smooth, even),
    }
    found = {}
    for name, (identifier, options, records) in methods.items():
        model = registry.create("identifiers", identifier, **options).fit(records, rng=np.random.default_rng(0))
        lumps = model.notes["lumped"]
        found[name] = dict(zip(lumps["names"], lumps["values"], strict=True))
    return found


def postures(offset: float, lean: float = 0.0, duration: float = 25.0) -> tuple[np.ndarray, float]:
    """Return the mean joint angles (2,) of the last 5 s from upright, and the largest rate then; NaN after a fall."""
    outputs = [["theta1", 0], ["theta2", 0], ["theta1", 1], ["theta2", 1]]
    scenario = registry.create(
        "scenarios", "acrobot-lqr", offset=(offset, offset), duration=duration, lean=lean, tilt=0.0
    )
    with registry.create("plants", "ode", model="acrobot", sample_time=0.005, outputs=outputs) as plant:
        try:
            held = run(plant, scenario, streams=Streams("acrobot", "offset", 0), role="estimation/0").y[-1000:]
        except PlantError:
            return np.full(2, np.nan), np.inf
    return held[:, :2].mean(axis=0) - [np.pi, 0.0], float(np.abs(held[:, 2:]).max())


def largest_lean(offset: float, precision: float = 1e-3) -> float:
    """Return the largest lean of the first joint [rad] from which the Acrobot is caught; 0 if it falls upright too."""
    if not np.isfinite(postures(offset)[1]):
        return 0.0
    low, high = 0.0, 0.2
    while high - low > precision:
        middle = (low + high) / 2
        low, high = (middle, high) if np.isfinite(postures(offset, middle, 15.0)[1]) else (low, middle)
    return low


def draw_acrobot(folder: Path) -> None:
    """Draw the steady error of the Acrobot against the offset of its joints, and the lean from which it is caught."""
    import matplotlib.pyplot as plt

    gains = registry.create("scenarios", "acrobot-lqr").steady_gains()
    found = [(offset, *postures(offset)) for offset in OFFSETS]
    leans = [largest_lean(offset) for offset in OFFSETS]
    figure, (axes, right) = plt.subplots(1, 2, figsize=(10, 3.2))
    for joint, colour in ((0, "tab:blue"), (1, "tab:red")):
        still = [(offset, posture[joint]) for offset, posture, rate in found if rate < 0.05]
        moving = [(offset, posture[joint]) for offset, posture, rate in found if 0.05 <= rate < np.inf]
        axes.plot(*zip(*still, strict=True), "o-", ms=4, color=colour, label=f"theta{joint + 1}")
        axes.plot(
            OFFSETS[:5], gains[joint] * np.array(OFFSETS[:5]), ":", color=colour, label=f"linear, {gains[joint]:.1f}"
        )
        if moving:
            axes.plot(*zip(*moving, strict=True), "x", color=colour, label="mean of a swing that goes on")
    axes.set_ylabel("steady error [rad]")
    axes.set_ylim(-1.9, 0.7)
    axes.legend(fontsize=6, ncol=2, loc="lower left")
    right.fill_between(OFFSETS, leans, color="tab:green", alpha=0.3, lw=0, label="caught")
    right.fill_between(OFFSETS, leans, 0.16, color="tab:red", alpha=0.3, lw=0, label="falls")
    right.plot(OFFSETS, leans, "k.-", lw=1)
    right.set_ylabel("lean of joint 1 at the start [rad]")
    right.set_ylim(0, 0.16)
    right.legend(fontsize=7, loc="upper right")
    for ax in (axes, right):
        ax.set_xlabel("offset of both joint sensors [rad]")
        ax.set_xlim(0, OFFSETS[-1])
    figure.tight_layout()
    figure.savefig(folder / "acrobot.svg", metadata={"Date": None})
    for (offset, posture, rate), lean in zip(found, leans, strict=True):
        print(
            f"offset {offset}: {posture.round(3).tolist()} rad, rates up to {rate:.2g} rad/s, caught to {lean:.3f} rad"
        )


def main() -> None:
    """Print the figures and draw the plots."""
    import matplotlib.pyplot as plt

    found = fits(Path(sys.argv[1]))
    figure, axes = plt.subplots(figsize=(7, 3))
    for place, (method, values) in enumerate(found.items()):
        errors = [100 * abs(values[name] / truth - 1) for name, truth in TRUTH.items()]
        print(method, {name: round(values[name], 8) for name in TRUTH}, f"worst {max(errors):.2g} %")
        axes.bar(np.arange(3) + 0.2 * (place - 1.5), errors, 0.2, label=method)
    axes.set_xticks(range(3), ["mc + mp", "l mp", "l² mp"])
    axes.set_yscale("log")
    axes.set_ylabel("error [%]")
    axes.set_ylim(top=3e3)
    axes.legend(fontsize=8, ncol=2, loc="upper left")
    figure.tight_layout()
    figure.savefig(Path(__file__).with_name("mechanical.svg"), metadata={"Date": None})
    draw_acrobot(Path(__file__).parent)


if __name__ == "__main__":
    main()
