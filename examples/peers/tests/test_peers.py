"""Each adapter keeps the contract, and returns the numbers of its package."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sysid_peers.linear import NFourSid, PyDmd, Sippy
from sysid_peers.recursive import FilterPy
from sysid_peers.sparse import PySindy

from harness.conformance import check_identifier
from harness.scoring import simulation_error
from harness.signals import Channel, PlantSpec
from harness.testing import LinearSystem, simulate_linear

NEEDS = {PyDmd: "pydmd", Sippy: "sippy_unipi", NFourSid: "nfoursid", FilterPy: "filterpy", PySindy: "pysindy"}
STATE, OUTPUTS = ("linear, state measured",), ("linear",)


@pytest.mark.parametrize(
    ("peer", "kinds"), [(PyDmd, STATE), (PySindy, STATE), (Sippy, OUTPUTS), (NFourSid, OUTPUTS), (FilterPy, STATE)]
)
def test_contract(peer: Any, kinds: tuple[str, ...]) -> None:
    pytest.importorskip(NEEDS[peer], reason=f"{NEEDS[peer]} is not installed")
    results = check_identifier(peer, kinds=kinds, examples=1)
    assert [f"{one.name}: {one.reason}" for one in results if not one.passed] == []


@pytest.mark.parametrize("peer", [PyDmd(), PySindy(degree=1), Sippy(order=2), NFourSid(order=2), FilterPy(order=1)])
def test_a_linear_system_is_found(peer: Any) -> None:
    pytest.importorskip(NEEDS[type(peer)], reason=f"{NEEDS[type(peer)]} is not installed")
    outputs = (Channel("x0", "m"), Channel("x1", "m"))
    spec = PlantSpec((Channel("u", "V"),), outputs, 0.1)
    system = LinearSystem(np.array([[0.9, 0.3], [-0.2, 0.7]]), np.array([[0.1], [1.0]]), np.eye(2), spec)
    record, fresh = (simulate_linear(system, 600, rng=np.random.default_rng(seed), noise=1e-4) for seed in (0, 1))
    model = peer.fit([record.measured()], rng=np.random.default_rng(0))
    assert simulation_error(model, fresh.measured()).nrmse.max() < 0.02
