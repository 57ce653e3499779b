"""Draw docs/mechanical.svg: the textbook's cart-pole, digit for digit, and the same data with better methods.

Run: python docs/mechanical_figures.py FOLDER     (the folder that holds cartpole_lumped_data_damped.npz)
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import sympy as sp
from scipy.interpolate import make_interp_spline

from harness.physics import Mechanism, lumped

TRUTH = {"mc + mp": 11.0, "l*mp": 0.5, "l**2*mp": 0.25}


def textbook_model() -> Mechanism:
    """Return the cart-pole of the textbook's example, theta from hanging."""
    m = Mechanism("cart-pole", q="x theta", u="u", p="mc mp l bx bt")
    (x, theta), (speed, rate), (u,), (mc, mp, length, bx, bt) = m.q, m.v, m.u, m.p
    m.body(mc, (x, 0))
    m.body(mp, (x + length * sp.sin(theta), -length * sp.cos(theta)))
    m.Q = [u - bx * speed, -bt * rate]
    return m


def fits(folder: Path) -> dict[str, dict[str, float]]:
    """Return the lumped parameters by method."""
    content = np.load(folder / "cartpole_lumped_data_damped.npz")
    runs = [(content[f"t{k}"], content[f"X{k}"].T, content[f"u{k}"].reshape(-1, 1)) for k in range(4)]
    model = lumped(textbook_model(), known={"bx": 0.1, "bt": 0.1})
    few = len(runs[0][0]) - 1
    rows: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for t, x, u in runs:
        q, v = x[:, :2], x[:, 2:]
        forward = (np.diff(v, axis=0) / np.diff(t)[:, None])[:few]
        smooth = make_interp_spline(t, v, k=5).derivative()(t)
        plain = model.torque_rows(t[:few], q[:few], v[:few], forward, u[:few])
        rows.setdefault("torque, forward differences", []).append(plain)
        rows.setdefault("torque, spline", []).append(model.torque_rows(t, q, v, smooth, u))
        rows.setdefault("energy", []).append(model.energy_rows(t, q, v, u, intersample="smooth"))
        rows.setdefault("momentum", []).append(model.momentum_rows(t, q, v, u, samples=1, intersample="smooth"))
    found = {}
    for name, parts in rows.items():
        W, target = np.concatenate([one[0] for one in parts]), np.concatenate([one[1] for one in parts])
        found[name] = model.solve(W, target).values
    return found


def main() -> None:
    """Print the figures and draw the plot."""
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
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(Path(__file__).with_suffix("").with_name("mechanical.svg"), metadata={"Date": None})


if __name__ == "__main__":
    main()
