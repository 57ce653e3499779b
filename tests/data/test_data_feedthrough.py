"""A data set declares that its outputs answer the input of the same sample."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harness.data import load_dataset
from harness.registry import create


def test_feedthrough_is_declared_and_reaches_the_fit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    u = rng.normal(size=600)
    y = 2.0 * u + 0.01 * rng.normal(size=600)
    table = np.column_stack([np.arange(600) * 0.1, u, y])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="time [s],u [V],y [m]", comments="", fmt="%.17g")
    text = 'name = "strain"\n{}[signals.u]\nrole = "input"\n[signals.y]\nrole = "output"\n[[runs]]\nfile = "run.csv"\n'
    found = {}
    for declared in ("", "feedthrough = true\n"):
        (tmp_path / "dataset.toml").write_text(text.format(declared))
        found[declared] = load_dataset(tmp_path / "dataset.toml").dataset
    assert not found[""].spec.feedthrough
    data = found["feedthrough = true\n"]
    assert data.spec.feedthrough
    fit = create("identifiers", "prediction-error", order=1, nk="auto").fit(data.estimation, rng=rng)  # type: ignore[union-attr]
    assert fit.notes["delays"]["y from u"]["samples"] == 0
    assert abs(fit.impulse_response(1)[0, 0, 0] - 2.0) < 0.01
