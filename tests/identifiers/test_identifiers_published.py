"""What papers claim of their own examples, where no figure of them can be read."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from harness.registry import create
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.online.along import along

SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)


@pytest.mark.slow
def test_more_order_than_the_system_has_helps_gradient_descent() -> None:
    """Hardt, Ma & Recht 2018 (*JMLR* 19(29)), their simulations; 1000 fresh records: ten seconds a model.

    State dimension 20, roots in conjugate pairs at random within radius 0.95, C and inputs standard normal, records of
    500 samples. With the projection it converges, and with more order than 20 it errs less.
    """
    rng = np.random.default_rng(0)
    roots = 0.95 * np.sqrt(rng.uniform(size=10)) * np.exp(1j * np.pi * rng.uniform(size=10))
    a, c = np.real(np.poly(np.concatenate([roots, roots.conj()]))), np.append(0.0, rng.normal(size=20))
    records = []
    for _ in range(1000):
        u = rng.normal(size=501)
        records.append(Trajectory(np.arange(501.0), u[:, None], lfilter(c, a, u)[:, None], SPEC))
    impulse = np.eye(1, 400)[0]
    response, error = lfilter(c, a, impulse)[1:], {}
    for order in (20, 40):
        online = create("identifiers", "gradient-descent", order=order, block=500, burn_in=200)
        model = online.model(along(online, online.init(SPEC, rng=rng), records), SPEC)
        kicked, quiet = (
            model.free_run(np.zeros((1, order + 1)), push[None, :, None])[0, 1:, 0] for push in (impulse, 0 * impulse)
        )
        error[order] = np.sum((kicked - quiet - response) ** 2) / np.sum(response**2)
    assert error[20] < 0.02
    assert error[40] < 0.1 * error[20]
