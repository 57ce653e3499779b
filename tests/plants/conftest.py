"""What the plants' tests share: golden records."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.signals import FloatArray


@pytest.fixture
def temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Send temporary files to a folder of this test's own, so that it can see that none is left behind."""
    import tempfile

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def pendulum_reference(arm: Any, inputs: FloatArray, theta: float, dry: float = 0.0) -> FloatArray:
    """Return theta (N,) of J theta'' + b theta' + mgl sin(theta) + Fc sign(theta') = u by an accurate solver."""
    from scipy.integrate import solve_ivp

    p = arm.true_parameters
    z, out = np.array([theta, 0.0]), [theta]

    def rate(_: float, z: FloatArray, u: float) -> list[float]:
        force = u - p["b"] * z[1] - dry * np.tanh(z[1] / 1e-3) - p["mgl"] * np.sin(z[0])
        return [z[1], force / p["J"]]

    for (u,) in inputs[:-1]:
        solution = solve_ivp(partial(rate, u=u), (0, arm.spec.sample_time), z, rtol=1e-9, atol=1e-11, method="LSODA")
        z = solution.y[:, -1]
        out.append(z[0])
    return np.array(out)
