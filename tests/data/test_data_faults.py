"""Faults of real records, each as files on disk: noticed and said; handled where a remedy is declared, else refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from harness.data import load_dataset
from harness.diagnosis import close_loop_file
from harness.errors import InputError

DT, N = 0.02, 500
Table = dict[str, np.ndarray]
Change = Callable[[Table], Table]
PENDULUM = {"u": ("input", "N m"), "theta": ("output", "rad")}
CART = {"u": ("input", "N"), "x": ("output", "m"), "theta": ("output", "rad")}


def pendulum(role: int) -> Table:
    """Return a record of J = 0.1, b = 0.05, mgl = 1 by the semi-implicit Euler method."""
    rng, t = np.random.default_rng([3, role]), np.arange(N) * DT
    u = sum(0.1 * np.cos(2 * np.pi * f * t + rng.uniform(0, 6)) for f in np.arange(0.1, 1.5, 0.1))
    q, v, y = 0.1, 0.0, np.empty(N)
    for k in range(N):
        y[k] = q
        for _ in range(10):
            v += DT / 10 * (u[k] - 0.05 * v - np.sin(q)) / 0.1
            q += DT / 10 * v
    return {"time": t, "u": u, "theta": y + 1e-3 * rng.standard_normal(N)}


def cart(role: int) -> Table:
    """Return a record of a hanging cart-pole: masses 1 and 0.2, length 0.5."""
    rng, t = np.random.default_rng([4, role]), np.arange(N) * DT
    u = sum(0.8 * np.cos(2 * np.pi * f * t + rng.uniform(0, 6)) for f in np.arange(0.1, 1.5, 0.1))
    z, y = np.array([0.0, 0.1, 0.0, 0.0]), np.empty((N, 2))
    for k in range(N):
        y[k] = z[:2]
        for _ in range(10):
            _, q, w, v = z
            mass = np.array([[1.2, 0.1 * np.cos(q)], [0.1 * np.cos(q), 0.05]])
            force = np.array([u[k] - 0.2 * w + 0.1 * v * v * np.sin(q), -0.981 * np.sin(q) - 0.005 * v])
            z[2:] += DT / 10 * np.linalg.solve(mass, force)
            z[:2] += DT / 10 * z[2:]
    y += 1e-3 * rng.standard_normal((N, 2))
    return {"time": t, "u": u, "x": y[:, 0], "theta": y[:, 1]}


def written(
    folder: Path,
    tables: tuple[Table, Table],
    *,
    model: str = "pendulum",
    signals: dict[str, tuple[str, str]] | None = None,
    more: str = "",
) -> Path:
    """Write two runs and their description."""
    for use, table in zip(("estimation", "validation"), tables, strict=True):
        rows = zip(
            *[[("" if np.isnan(x) else repr(x)) for x in map(float, col)] for col in table.values()], strict=True
        )
        text = "\n".join([",".join(table), *(",".join(row) for row in rows)])
        (folder / f"{use}.csv").write_text(text + "\n")
    chosen = PENDULUM if signals is None else signals
    lines = ['name = "bench"', more, f'[nominal]\nmodel = "{model}"']
    lines += [f'[signals.{name}]\nrole = "{role}"\nunit = "{unit}"' for name, (role, unit) in chosen.items()]
    lines += [f'[[runs]]\nfile = "{use}.csv"\nuse = "{use}"' for use in ("estimation", "validation")]
    (folder / "dataset.toml").write_text("\n".join(lines) + "\n")
    return folder / "dataset.toml"


def both(make: Callable[[int], Table], change: Change) -> tuple[Table, Table]:
    return change(make(0)), change(make(1))


def holes(table: Table) -> Table:
    y = table["theta"].copy()
    y[200:206] = np.nan
    return {**table, "theta": y}


def gap(table: Table) -> Table:
    keep = np.r_[0:200, 220:N]
    return {name: column[keep] for name, column in table.items()}


def jitter(table: Table) -> Table:
    return {**table, "time": table["time"] + 0.3 * DT * np.random.default_rng(0).uniform(-1, 1, N)}


def stretched(table: Table) -> Table:
    return {**table, "time": np.cumsum(np.r_[0.0, np.where(np.arange(N - 1) % 10 < 5, DT, 1.3 * DT)])}


@pytest.mark.parametrize("change", [holes, gap, jitter, stretched])
def test_time_and_drop_outs_are_refused_until_a_remedy_is_declared(change: Change, tmp_path: Path) -> None:
    tables = both(pendulum, change)
    with pytest.raises(InputError, match='gaps = "split"' if change is gap else "resample") as refused:
        close_loop_file(written(tmp_path, tables), out=tmp_path / "out")
    assert "estimation.csv" in str(refused.value)
    assert not (tmp_path / "out" / "report.json").exists()
    remedy = 'gaps = "split"\nintersample = "zoh"\n[resample]\nsample_time = 0.02\nmax_gap = 0.15'
    mended = load_dataset(written(tmp_path, tables, more=remedy))
    assert any("resample" in note for note in mended.dataset.warnings)
    assert all(np.isfinite(run.trajectory.y).all() for run in mended.dataset.runs)
    assert len(mended.dataset.using("estimation")) == (2 if change is gap else 1)


@pytest.mark.parametrize("change", [holes, gap])
def test_a_split_keeps_the_pieces_apart_and_says_what_is_lost(change: Change, tmp_path: Path) -> None:
    found = load_dataset(written(tmp_path, both(pendulum, change), more='gaps = "split"'))
    assert len(found.dataset.using("estimation")) == 2
    assert any("split into 2 pieces" in note for note in found.dataset.warnings)


def changed(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda table: {**table, name: change(table[name])}


def stuck(y: np.ndarray) -> np.ndarray:
    y = y.copy()
    y[300:360] = y[300]
    return y


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed("theta", stuck), "output theta stands still"),
        (changed("theta", lambda y: np.minimum(y, np.quantile(y, 0.9))), "output theta rests at its largest value"),
        (changed("u", lambda u: np.full_like(u, 0.3)), "input u is constant"),
    ],
)
def test_what_may_be_meant_is_said_with_its_column(change: Change, words: str, tmp_path: Path) -> None:
    notes = load_dataset(written(tmp_path, both(pendulum, change))).dataset.warnings
    assert sum(words in note for note in notes) == 2, notes
    assert all("estimation.csv" in note or "validation.csv" in note for note in notes if words in note)


@pytest.mark.parametrize(
    ("make", "change", "words"),
    [
        (pendulum, changed("theta", lambda y: 1000 * y), "theta"),
        (pendulum, changed("theta", lambda y: np.full_like(y, 0.2)), "outputs never move"),
    ],
)
def test_columns_that_no_model_can_mean_are_refused_by_name(
    make: Callable[[int], Table], change: Change, words: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=words) as refused:
        close_loop_file(written(tmp_path, both(make, change)), out=tmp_path / "out")
    assert "remedy" in str(refused.value)
    assert not (tmp_path / "out" / "report.json").exists()


@pytest.mark.parametrize(
    ("make", "change", "words"),
    [
        (pendulum, lambda t: {**t, "u": t["theta"], "theta": t["u"]}, "u and theta are swapped"),
        (cart, lambda t: {**t, "x": t["theta"], "theta": t["x"]}, "x and theta are swapped"),
    ],
)
def test_swapped_columns_are_a_model_that_does_not_fit(
    make: Callable[[int], Table], change: Change, words: str, tmp_path: Path
) -> None:
    model, signals = ("pendulum", PENDULUM) if make is pendulum else ("cart-pole", CART)
    data = written(tmp_path, both(make, change), model=model, signals=signals)
    report = close_loop_file(data, out=tmp_path / "out")
    assert report.verdict == "model_does_not_fit", report.data["summary"]
    assert words in report.data["misfit"][-1]
    assert (tmp_path / "out" / "report.json").exists()


def test_one_run_in_another_unit_is_said(tmp_path: Path) -> None:
    tables = pendulum(0), changed("u", lambda u: 1000 * u)(pendulum(1))
    notes = load_dataset(written(tmp_path, tables)).dataset.warnings
    assert any("input u moves" in note and "wrong by 1000" in note for note in notes)


def test_validation_that_is_the_estimation_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the validation data are the estimation data"):
        close_loop_file(written(tmp_path, (pendulum(0), pendulum(0))), out=tmp_path / "out")


def test_good_records_pass_the_column_check() -> None:
    from harness.diagnosis.records.columns_check import doubts
    from harness.physics import load_model
    from harness.signals import PlantSpec, Trajectory

    for make, name, columns in ((pendulum, "pendulum", ["theta"]), (cart, "cart-pole", ["x", "theta"])):
        system, table = load_model(name), make(0)

        spec = PlantSpec(system.inputs, system.outputs, DT)
        y = np.column_stack([table[one] for one in columns])
        assert doubts(system, Trajectory(table["time"], table["u"][:, None], y, spec)) == []
