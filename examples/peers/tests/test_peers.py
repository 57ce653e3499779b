"""Each adapter keeps the contract, and returns the numbers of its package."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sysid_peers.linear import Control, JaxSysId, NFourSid, PyDmd, Sippy
from sysid_peers.narx import NarxModel, SysIdentPy
from sysid_peers.recursive import FilterPy
from sysid_peers.sparse import PySindy

from harness.benchmark.public.scores import simulated
from harness.conformance import check_identifier
from harness.errors import FitError
from harness.scoring import simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from harness.testing import LinearSystem, simulate_linear

NEEDS = {
    PyDmd: "pydmd",
    Sippy: "sippy_unipi",
    NFourSid: "nfoursid",
    FilterPy: "filterpy",
    PySindy: "pysindy",
    Control: "control",
    JaxSysId: "jax_sysid",
}
STATE, OUTPUTS = ("linear, state measured",), ("linear",)


@pytest.mark.parametrize(
    ("peer", "kinds"),
    [
        (PyDmd, STATE),
        (PySindy, STATE),
        (Sippy, OUTPUTS),
        (NFourSid, OUTPUTS),
        (FilterPy, STATE),
        (Control, OUTPUTS),
        (JaxSysId, OUTPUTS),
    ],
)
def test_contract(peer: Any, kinds: tuple[str, ...]) -> None:
    pytest.importorskip(NEEDS[peer], reason=f"{NEEDS[peer]} is not installed")
    results = check_identifier(peer, kinds=kinds, examples=1)
    assert [f"{one.name}: {one.reason}" for one in results if not one.passed] == []


@pytest.mark.parametrize(
    "peer",
    [
        PyDmd(),
        PySindy(degree=1),
        Sippy(order=2),
        NFourSid(order=2),
        FilterPy(order=1),
        Control(order=2),
        JaxSysId(order=2),
    ],
)
def test_a_linear_system_is_found(peer: Any) -> None:
    pytest.importorskip(NEEDS[type(peer)], reason=f"{NEEDS[type(peer)]} is not installed")
    outputs = (Channel("x0", "m"), Channel("x1", "m"))
    spec = PlantSpec((Channel("u", "V"),), outputs, 0.1)
    system = LinearSystem(np.array([[0.9, 0.3], [-0.2, 0.7]]), np.array([[0.1], [1.0]]), np.eye(2), spec)
    record, fresh = (simulate_linear(system, 600, rng=np.random.default_rng(seed), noise=1e-4) for seed in (0, 1))
    model = peer.fit([record.measured()], rng=np.random.default_rng(0))
    assert simulation_error(model, fresh.measured()).nrmse.max() < 0.02


def test_a_polynomial_narx_is_found_and_kept() -> None:
    pytest.importorskip("sysidentpy", reason="sysidentpy is not installed")
    spec = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1.0, 1.0, (1000, 1)), np.zeros((1000, 1))
    for k in range(2, 1000):
        y[k] = 0.5 * y[k - 1] - 0.2 * y[k - 2] + u[k - 1] + 0.3 * y[k - 1] * u[k - 2]
    record = Trajectory(np.arange(1000) * 0.1, u, y, spec)
    model = SysIdentPy(lags=2, degree=2, terms=8).fit([record[:700]], rng=rng)
    again = NarxModel.from_dict(model.to_dict())
    assert np.allclose(simulated(again, record[700:], 10), record.y[700:], atol=1e-9)
    two = PlantSpec((Channel("u"), Channel("v")), spec.outputs, 0.1)
    both = Trajectory(record.t, np.hstack([u, u]), y, two)
    with pytest.raises(FitError, match="one input, one output"):
        SysIdentPy().fit([both], rng=rng)
