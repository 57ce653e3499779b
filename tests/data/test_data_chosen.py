"""Columns that the caller names: a linear model from any table, without a file that describes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness import api
from harness.command import main
from harness.data import load_dataset, write_trajectory
from harness.errors import InputError
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

DT = 0.05


def signals(n: int = 400, pole: float = 0.8) -> tuple[np.ndarray, np.ndarray]:
    """Return input and output of y+ = pole y + 0.5 u."""
    u = np.random.default_rng(3).standard_normal(n)
    y = np.zeros(n)
    for k in range(n - 1):
        y[k + 1] = pole * y[k] + 0.5 * u[k]
    return u, y


U, Y = signals()
TIME = DT * np.arange(len(U), dtype=np.float64)


def write(path: Path, columns: dict[str, np.ndarray], separator: str = ",") -> Path:
    rows = [separator.join(columns), *(separator.join(map(repr, map(float, row))) for row in zip(*columns.values()))]  # noqa: B905
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def run(arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as caught:
        main([str(argument) for argument in arguments])
    said = capsys.readouterr()
    return int(caught.value.code or 0), said.out, said.err


@given(
    names=st.lists(
        st.sampled_from(["Kraft", "q_1", "arm.x2", "pos", "Drehmoment M1", "v2"]), min_size=2, max_size=2, unique=True
    ),
    units=st.tuples(st.sampled_from(["N", "mN", "V"]), st.sampled_from(["mm", "deg", "m/s"])),
    swapped=st.booleans(),
    where=st.sampled_from(["title", "option", "nowhere"]),
)
def test_a_table_is_read_by_the_names_that_the_caller_gives(
    names: list[str], units: tuple[str, str], swapped: bool, where: str
) -> None:
    titles = [f"{name} [{unit}]" if where == "title" else name for name, unit in zip(names, units, strict=True)]
    columns = {"time [s]": TIME, titles[0]: U, titles[1]: Y}
    if swapped:
        columns = dict(reversed(columns.items()))
    given_units = dict(zip(names, units, strict=True)) if where == "option" else None
    found = load_dataset(columns, input=names[0], output=names[1], unit=given_units).dataset
    factor = {"nowhere": 1.0}.get(where, {"N": 1.0, "mN": 1e-3, "V": 1.0}[units[0]])
    read = np.concatenate([run.trajectory.u[:, 0] for run in found.runs])
    assert np.allclose(read, U * factor, rtol=1e-12)
    assert [c.name for c in (*found.spec.inputs, *found.spec.outputs)] == names
    assert any("count as they are" in text for text in found.warnings) == (where == "nowhere")


def test_every_way_to_give_the_same_signals_gives_the_same_model(tmp_path: Path) -> None:
    spec = PlantSpec((Channel("u"),), (Channel("y"),), DT)
    record = Trajectory(TIME, U[:, None], Y[:, None], spec)
    table = {"time": TIME, "u": U, "y": Y}
    file = write(tmp_path / "log.csv", table)
    other = write(tmp_path / "other.csv", {"Zeit": TIME * 1e3, "Kraft": U, "Weg": Y}, ";")
    parquet = write_trajectory(record, tmp_path / "log.parquet")
    np.savez(tmp_path / "log.npz", u=U, y=Y)
    options = {"order": 1}
    named: dict[str, Any] = {"input": "u", "output": "y"}
    ways: list[Any] = [
        api.identify(U, Y, sample_time=DT, options=options),
        api.identify(U[:, None], Y.tolist(), sample_time=DT, options=options),
        api.identify(pd.DataFrame({"u": U}), pd.Series(Y, name="y"), sample_time=DT, options=options),
        api.identify(table, options=options, **named),
        api.identify(pd.DataFrame(table), options=options, **named),
        api.identify(record, options=options),
        api.identify([record], options=options),
        api.identify(Dataset("d", (Run(record),)), options=options),
        api.identify(file, options=options, **named),
        api.identify(
            other, options=options, column={"u": "Kraft", "y": "Weg", "time": "Zeit"}, unit={"time": "ms"}, **named
        ),
        api.identify(parquet, options=options),
        api.identify(tmp_path / "log.npz", options=options, sample_time=DT, **named),
    ]
    for found in ways:
        assert found.poles == pytest.approx([0.8], abs=1e-6)
        assert found.spec.sample_time == pytest.approx(DT)


def test_one_command_from_a_table_of_two_columns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path / "log.csv", {"u": U, "y": Y})
    own = ["--input", "u", "--output", "y", "--sample-time", DT]
    model = tmp_path / "m.json"
    status, out, _ = run(["identify", file, *own, "--identifier", "arx", "-O", "order=1", "-o", model], capsys)
    assert status == 0
    assert "arx" in out
    assert run(["order", file, *own, "--identifier", "arx", "--orders", "1..2"], capsys)[0] == 0
    assert run(["spectrum", file, *own], capsys)[0] == 0
    # the model knows its channels: its columns need no names again
    status, out, _ = run(["compare", model, file, "--sample-time", DT, "--json"], capsys)
    assert status == 0
    assert '"output": "y"' in out


def test_a_model_of_plain_numbers_is_compared_with_the_table_that_it_was_fitted_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "log.csv", {"u": U, "y": Y})
    chosen = ["--input", "u", "--output", "y", "--sample-time", str(DT)]
    fitted = ["identify", path, *chosen, "--identifier", "arx", "-o", tmp_path / "m.json"]
    assert run(fitted, capsys)[0] == 0
    code, out, said = run(["compare", tmp_path / "m.json", path, *chosen], capsys)
    assert (code, "m " in out) == (0, True), said


def test_columns_are_never_guessed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path / "log.csv", {"time": TIME, "u": U, "y": Y})
    for command in ("identify", "order", "spectrum"):
        for given_, missing in ([], "--input NAME and --output NAME"), (["--output", "y"], "--input NAME"):
            status, _, error = run([command, file, *given_], capsys)
            assert status == 2
            assert missing in error
            assert "'time', 'u', 'y'" in error
            assert len(error.strip().splitlines()) == 1


def test_further_records_and_their_use(tmp_path: Path) -> None:
    first, second, third = (
        write(tmp_path / f"{name}.csv", {"time": TIME, "u": U, "y": Y + number}) for number, name in enumerate("abc")
    )
    named: dict[str, Any] = {"input": "u", "output": "y"}
    both = load_dataset(first, run=[str(second), f"validation={third}"], **named).dataset
    assert [(run.use, len(run.trajectory)) for run in both.runs] == [
        ("estimation", len(U)),
        ("estimation", len(U)),
        ("validation", len(U)),
    ]
    alone = load_dataset(first, run=("test", second), **named).dataset
    assert [run.use for run in alone.runs] == ["estimation", "validation", "test"]


def test_a_column_of_another_name_serves_a_port_of_a_model() -> None:
    table = {"t": TIME, "Moment [N m]": U, "Winkel": np.degrees(Y), "theta [V]": Y}
    loaded = load_dataset(
        table, model="pendulum", column={"u": "Moment [N m]", "theta": "Winkel"}, unit={"theta": "deg"}
    )
    found = np.concatenate([run.trajectory.y[:, 0] for run in loaded.dataset.runs])
    assert np.allclose(found, Y)
    assert loaded.measured == (("theta", 0),)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"input": "u", "output": "u"}, "u is chosen twice"),
        ({"input": "q", "output": "y"}, "no column 'q'"),
        ({"input": "u", "output": "y", "column": {"z": "u"}}, "column of an unknown signal"),
        ({"input": "u", "output": "y", "unit": {"z": "m"}}, "unit of an unknown signal"),
        ({"input": "u", "output": "y", "sample_time": 0.0}, "more than 0"),
        ({"inputs": "u"}, "unknown argument"),
        ({"input": "u", "output": "y", "run": ("all", "b.csv")}, "use of a record"),
        ({"input": ["u", "y"], "output": ["y2"], "column": {"y2": "y"}}, "two signals from one column"),
    ],
)
def test_words_that_cannot_be_meant(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_dataset({"time": TIME, "u": U, "y": Y}, **wrong)


@pytest.mark.parametrize(
    ("titles", "said", "names"),
    [
        (("Time", "DAC", "ADC"), {"input": "DAC", "output": "ADC", "unit": {"Time": "ms"}}, ("DAC", "ADC")),
        (("Zeit", "u", "y"), {"input": "u", "output": "y", "unit": {"Zeit": "ms"}}, ("u", "y")),
        (("t", "a", "b"), {"column": {"u": "a", "theta": "b"}, "unit": {"t": "ms", "b": "deg", "a": "N m"}}, None),
        (
            ("k", "a", "b"),
            {"column": {"u": "a", "theta": "b", "time": "k"}, "unit": {"k": "ms", "b": "deg", "u": "N m"}},
            None,
        ),
    ],
)
def test_the_title_of_a_column_is_as_good_as_the_name_of_its_signal(
    titles: tuple[str, ...], said: dict[str, Any], names: tuple[str, ...] | None
) -> None:
    table = dict(zip(titles, (1000.0 * TIME, U, Y), strict=True))
    loaded = load_dataset(table, **({"model": "pendulum"} if names is None else {}), **said)
    record = loaded.dataset.runs[0].trajectory
    assert record.spec.sample_time == pytest.approx(DT)
    scale = 1.0 if names else np.pi / 180
    np.testing.assert_allclose(record.y[:, 0], scale * Y[: len(record)])


def test_two_units_of_one_signal_are_refused_by_either_name() -> None:
    with pytest.raises(InputError, match="two units of time"):
        load_dataset({"Time": TIME, "u": U, "y": Y}, input="u", output="y", unit={"Time": "s", "time": "ms"})


@pytest.mark.parametrize("bad", [(U, Y[:-1]), (U + 1j, Y), (np.zeros((3, 3, 3)), Y), (["a"], Y)])
def test_arrays_that_cannot_be_meant(bad: tuple[Any, Any]) -> None:
    with pytest.raises(InputError, match="input"):
        api.identify(*bad, sample_time=DT)


@pytest.mark.parametrize(
    ("plant", "scenario", "length"),
    [
        ("cart-pole-pymunk", "prbs", {"duration": 2.0}),
        ("cart-pole-ode", "cart-pole-lqr", {"duration": 2.0}),
        ("linear-ode", "multisine", {"duration": 10.0}),
        ("grid-mdp", "random-policy", {"duration": 60.0}),
        ("mass-spring-fmu", "prbs", {"duration": 2.0}),
        ("iiwa-bullet", "arm-pd", {"duration": 2.0}),
    ],
)
def test_what_simulate_writes_is_read_as_it_is(
    tmp_path: Path, plant: str, scenario: str, length: dict[str, float]
) -> None:
    for name in ("run.csv", "run.parquet"):
        record = api.simulate(plant, scenario=scenario, scenario_options=length, out=tmp_path / name)
        names: dict[str, Any] = {
            "input": [c.name for c in record.spec.inputs],
            "output": [c.name for c in record.spec.outputs],
        }
        found = load_dataset(tmp_path / name, **(names if name.endswith("csv") else {})).dataset
        read = np.concatenate([run.trajectory.y for run in found.runs])
        assert np.array_equal(read, record.y)


@pytest.mark.parametrize(
    ("titles", "said"),
    [
        (("Zeit (ms)", "u_Nm", "theta_deg"), {}),
        (("Zeit (ms)", "M", "theta (deg)"), {"column": {"u": "M"}, "unit": {"u": "N m"}}),
        (("stamp", "u / Nm", "Winkel, Grad"), {"column": {"theta": "Winkel, Grad", "time": "stamp"},
                                              "unit": {"theta": "deg", "time": "ms"}}),
    ],
)  # fmt: skip
def test_titles_and_words_say_the_same(titles: tuple[str, str, str], said: dict[str, Any]) -> None:
    angle = np.degrees(0.01 * np.cumsum(U))
    table = dict(zip(titles, (1e3 * TIME, U, angle), strict=True))
    found = load_dataset(table, model="pendulum", **said).dataset
    record = found.runs[0].trajectory
    assert [str(channel) for channel in (*found.spec.inputs, *found.spec.outputs)] == ["u [N m]", "theta [rad]"]
    assert found.spec.sample_time == pytest.approx(DT)
    np.testing.assert_allclose(record.y[:, 0], np.radians(angle[: len(record)]), rtol=1e-12)


def test_a_unit_of_a_port_counts_however_its_column_is_spelled() -> None:
    table = {"time": TIME, "u1": U, "u_2": 2 * U, "theta_1": np.cumsum(U), "theta2": np.cumsum(np.sin(U))}
    given = {"u1": "N m", "u2": "mN m", "theta1": "deg", "theta2": "rad"}
    record = load_dataset(table, model="double-pendulum", unit=given).dataset.runs[0].trajectory
    np.testing.assert_allclose(record.u[:, 1], 2e-3 * record.u[:, 0], rtol=1e-12)
    np.testing.assert_allclose(record.y[:, 0], np.radians(np.cumsum(U))[: len(record)], rtol=1e-12)


@pytest.mark.parametrize(
    "said",
    [
        {"model": "pendulum", "column": {"u": "a", "theta": "a"}, "unit": {"u": "N m", "theta": "rad"}},
        {"input": "u", "output": "y", "column": {"u": "a", "y": "a"}},
        {"input": "a", "output": "y", "column": {"y": "a"}},
    ],
)
def test_one_column_is_one_signal(said: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="two signals from one column"):
        load_dataset({"time": TIME, "a": U, "b": Y}, **said)


def test_records_in_memory_are_examined_as_files_are() -> None:
    y = np.sin(0.05 * np.arange(400.0)) + 0.01 * U
    y[200] = 9999.0
    spec = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), DT)
    record = Trajectory(TIME, U[:, None], y[:, None], spec)
    for data in ([record], Dataset("x", (Run(record),))):
        found = load_dataset(data).dataset
        assert np.isnan(found.runs[0].trajectory.readings[200, 0])
        assert any("9999" in text for text in found.warnings)


def test_holes_of_a_bare_table_are_split_where_that_is_said(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    time = np.delete(np.arange(400) * 0.01, [1, 2, 3, 180])  # a logger that begins late, and a lost row
    file = tmp_path / "log.csv"
    u, y = rng.normal(size=(2, time.size))
    write(file, {"time [s]": time, "u [V]": u, "y [rad]": y})
    with pytest.raises(InputError, match="of a bare table: --gaps split"):
        load_dataset(file, input="u", output="y")
    found = load_dataset(file, input="u", output="y", gaps="split").dataset
    assert sum(len(run.trajectory) for run in found.runs) == 395  # the first row stands alone: no piece of a record
    assert {run.use for run in found.runs} == {"estimation", "validation"}
    with pytest.raises(InputError, match="--gaps: gaps: expected one of refuse, split"):
        load_dataset(file, input="u", output="y", gaps="bridge")  # type: ignore[arg-type]
