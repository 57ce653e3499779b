"""The order that held-out data ask for, by call and on the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from harness import api
from harness.comparison import order_selection
from harness.comparison.orders import OrderError, OrderSelection
from harness.errors import InputError
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)


def data(order: int, noise: float, seed: int, scale: float = 1.0) -> Dataset:
    """Return records of a system of a known order whose poles all count, disturbed as an ARX model has it."""
    rng = np.random.default_rng(seed)
    poles = 0.85 * np.exp(1j * np.linspace(0.5, 2.2, order // 2))
    a = np.real(np.poly(np.concatenate([poles, poles.conj(), [0.7] * (order % 2)])))
    runs = []
    for use, n in (("estimation", 3000), ("validation", 1500)):
        u = rng.normal(size=n)
        y = lfilter([0.0, 1.0], a, u) + lfilter([noise], a, rng.normal(size=n))
        runs.append(Run(Trajectory(np.arange(n) * 0.1, u[:, None], scale * y[:, None], SPEC), use))
    return Dataset("known order", tuple(runs))


@settings(max_examples=2, deadline=None)
@given(order=st.integers(2, 5), noise=st.sampled_from([0.01, 0.1]), seed=st.integers(0, 10_000))
def test_a_known_order_is_suggested_and_no_unit_changes_it(order: int, noise: float, seed: int) -> None:
    found = order_selection(data(order, noise, seed), identifiers=("arx", "n4sid"), orders=range(1, 8))
    assert found.suggested() == {"arx": order, "n4sid": order}
    values = found.singular_values["n4sid"]
    # the canonical correlations fall by more behind the order than before it
    ratios = values[:-1] / values[1:]
    assert int(np.argmax(ratios[:7])) + 1 == order
    beside = range(order - 1, order + 2)
    scaled = order_selection(data(order, noise, seed, 1e3), identifiers=("arx", "n4sid"), orders=beside)
    assert scaled.suggested() == found.suggested()
    same = [one.one_step for one in found.tried if one.order in beside]
    assert [one.one_step for one in scaled.tried] == pytest.approx(same, rel=1e-3)


def test_without_validation_the_last_third_judges_and_what_cannot_be_fitted_says_why() -> None:
    short = Dataset("short", (Run(data(2, 0.1, 0).runs[0].trajectory[:180]),))
    found = order_selection(short, identifiers=("arx", "n4sid"), orders=(2, 20))
    assert found.judged.startswith("the last third")
    refused = {(one.identifier, one.order) for one in found.tried if one.refused}
    assert ("n4sid", 20) in refused
    (note,) = [row["note"] for row in found.rows() if row["identifier"] == "n4sid" and row["order"] == 20]
    assert "expected" in note


def test_orders_that_one_reason_refuses_are_one_row_to_read() -> None:
    refusal: Any = {"one_step": np.nan, "free_run": np.nan, "blocks": {}}
    tried = [OrderError("era", k, refused="no excitation", **refusal) for k in (1, 2, 3)]
    tried += [OrderError("era", 4, refused="too few rows", **refusal)]
    tried += [OrderError("arx", 2, refused="no excitation", **refusal)]
    found = OrderSelection("x", "validation", tuple(tried), {})
    shown = [(row["identifier"], row["order"], row["note"]) for row in found.printed()]
    assert shown == [("era", "1 to 3", "no excitation"), ("era", 4, "too few rows"), ("arx", 2, "no excitation")]
    assert len(found.rows()) == 5


def test_what_has_no_order_is_refused() -> None:
    with pytest.raises(InputError, match="has no order"):
        order_selection(data(2, 0.1, 0), identifiers=("hold",))
    with pytest.raises(InputError, match="from 1 on"):
        order_selection(data(2, 0.1, 0), orders=(0, 1))


def test_on_the_command_line(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    one = data(3, 0.05, 1).runs[0].trajectory
    table = np.column_stack([one.t, one.u, one.y])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="time [s],u [V],y [m]", comments="", fmt="%.17g")
    (tmp_path / "dataset.toml").write_text(
        'name = "third order"\n[signals.u]\nrole = "input"\n[signals.y]\nrole = "output"\n[[runs]]\nfile = "run.csv"\n'
    )
    arguments = ["order", str(tmp_path / "dataset.toml"), "--identifier", "arx", "--orders", "1..4"]
    rows = json.loads(sysid(*arguments, "-o", tmp_path / "order.svg", "--json").out.rpartition("}")[0] + "}")["orders"]
    assert [row["order"] for row in rows if "one step" in row["note"]] == [3]
    assert (tmp_path / "order.svg").read_text().startswith("<?xml")
    assert "--orders" in sysid(*arguments[:-1], "4..1", status=2).err
    with pytest.raises(InputError, match=r"ends in \.svg"):
        api.order(tmp_path / "dataset.toml", out=tmp_path / "order.txt")


def test_a_grid_of_arx_orders_on_the_command_line_and_from_python(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    rng, y = np.random.default_rng(1), np.zeros(900)
    u = rng.normal(size=900)
    for k in range(4, 900):
        y[k] = 1.3 * y[k - 1] - 0.6 * y[k - 2] + u[k - 3] + 0.4 * u[k - 4] + 0.2 * rng.normal()
    table = np.column_stack([np.arange(900) * 0.1, u, y])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="time [s],u [V],y [m]", comments="", fmt="%.17g")
    files = [str(tmp_path / "run.csv"), "--input", "u", "--output", "y"]
    arguments = ["order", *files, "--na", "0..4", "--nb", "1..4", "--nk", "1..5"]
    rows = json.loads(sysid(*arguments, "-o", tmp_path / "grid.svg", "--json").out.rpartition("}")[0] + "}")["orders"]
    (best,) = [row for row in rows if "best by bic" in row["note"]]
    assert (best["na"], best["nb"], best["nk"]) == (2, 2, 3)
    assert (tmp_path / "grid.svg").read_text().startswith("<?xml")
    found = api.arx_orders(tmp_path / "run.csv", range(5), range(1, 5), range(1, 6), input="u", output="y")
    assert found.best("bic") == {"na": 2, "nb": 2, "nk": 3}
    near = found.values("held-out")
    assert near[2, 1, 2] <= 1.02 * np.nanmin(near)
    assert "both --na and --nb" in sysid(*arguments[:-4], status=2).err
    with pytest.raises(InputError, match="from 0 on"):
        api.arx_orders(tmp_path / "run.csv", [-1], [1], input="u", output="y")
