"""dataset.toml and bare files: what is read, what is refused, and in which words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness import api
from harness.data import load_dataset, parse_description
from harness.errors import InputError
from harness.trust import trusting
from plants.mockups import mockup

RNG = np.random.default_rng(0)
TIME = np.arange(90) * 0.01
FORCE = RNG.normal(size=90)
ANGLE = np.cumsum(np.cumsum(FORCE)) * 1e-3

BASE = """
name = "bench"
sample_time = 0.01
[nominal]
model = "pendulum"
[signals.u]
role = "input"
unit = "N m"
[signals.theta]
role = "output"
unit = "rad"
[[runs]]
file = "a.csv"
[[runs]]
file = "b.csv"
use = "validation"
"""


def table(path: Path, **columns: np.ndarray) -> None:
    """Write a CSV with these columns; `__` in a name starts the unit."""
    titles = [f"{n} [{u.replace('_', ' ')}]" if u else n for n, _, u in (name.partition("__") for name in columns)]
    rows = zip(*(c.tolist() for c in columns.values()), strict=True)
    path.write_text("\n".join([",".join(titles), *(",".join(map(repr, row)) for row in rows)]) + "\n")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    table(tmp_path / "a.csv", u=FORCE, theta=ANGLE)
    table(tmp_path / "b.csv", u=2 * FORCE, theta=2.1 * ANGLE)
    (tmp_path / "dataset.toml").write_text(BASE)
    return tmp_path


def rewritten(folder: Path, *changes: tuple[str, str]) -> Path:
    """Return the description with texts exchanged."""
    text = (folder / "dataset.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "dataset.toml").write_text(text)
    return folder / "dataset.toml"


def refusal(path: Path, **options: object) -> str:
    with pytest.raises(InputError) as caught:
        load_dataset(path, **options)  # type: ignore[arg-type]
    line = str(caught.value)
    assert "\n" not in line
    assert "remedy" in line
    return line


def test_values_arrive_unchanged_and_in_the_models_order(folder: Path) -> None:
    loaded = load_dataset(folder / "dataset.toml")
    data = loaded.dataset
    assert np.array_equal(data.estimation[0].u[:, 0], FORCE)
    assert np.array_equal(data.estimation[0].y[:, 0], ANGLE)
    assert [c.name for c in data.spec.inputs + data.spec.outputs] == ["u", "theta"]
    assert data.spec.outputs[0].period == pytest.approx(2 * np.pi)
    assert len(data.validation) == 1
    assert data.warnings == ()
    assert loaded.measured == (("theta", 0),)
    assert loaded.system().parameter_names == ("J", "b", "mgl")


def test_scale_and_offset_come_before_the_unit_and_noise_is_converted(folder: Path) -> None:
    signal = 'unit = "deg"\nscale = 2.0\noffset = 10.0\nnoise = 0.1\n'
    data = load_dataset(rewritten(folder, ('unit = "rad"', signal))).dataset
    assert data.estimation[0].y[:, 0] == pytest.approx(np.deg2rad(2 * ANGLE + 10), rel=1e-12)
    assert data.noise == {"theta": pytest.approx(np.deg2rad(0.1))}


def test_ports_rates_references_rows_discard_labels_and_columns(folder: Path) -> None:
    rate = np.gradient(ANGLE, 0.01)
    table(folder / "a.csv", torque=FORCE, phi=ANGLE, om=np.rad2deg(rate), want=ANGLE + 1)
    (folder / "dataset.toml").write_text(
        """
name = "named otherwise"
sample_time = 0.01
intersample = "foh"
[nominal]
model = "pendulum"
[nominal.parameters]
J = 0.25
b = {start = 0.3, minimum = 0.1, maximum = 2.0}
[signals.speed]
role = "output"
port = "theta"
derivative = 1
unit = "deg/s"
column = "om"
[signals.angle]
role = "output"
port = "theta"
unit = "rad"
column = "phi"
[signals.torque]
role = "input"
port = "u"
unit = "N mm"
[signals.want]
role = "reference"
unit = "rad"
[[runs]]
file = "a.csv"
rows = [0, 60]
discard = 4
label = "first"
[[runs]]
file = "a.csv"
rows = [60, 90]
use = "test"
columns = {torque = "want"}
""".replace("columns = {torque", "# columns = {torque")
    )
    loaded = load_dataset(folder / "dataset.toml")
    run = loaded.dataset.runs[0]
    assert (len(run.trajectory), run.label, loaded.dataset.intersample) == (56, "first", "foh")
    assert [str(c) for c in loaded.dataset.spec.outputs] == ["theta [rad]", "theta_rate [rad/s]"]
    assert run.trajectory.y == pytest.approx(np.column_stack([ANGLE, rate])[4:60])
    assert run.trajectory.u[:, 0] == pytest.approx(1e-3 * FORCE[4:60])
    assert loaded.references[0]["want"] == pytest.approx(ANGLE[4:60] + 1)
    assert loaded.references[1]["want"] == pytest.approx(ANGLE[60:] + 1)
    assert any("no validation run" in note for note in loaded.dataset.warnings)
    system = loaded.system()
    assert system.parameter("J").fixed
    assert system.parameter("J").value == 0.25
    assert (system.parameter("b").value, system.parameter("b").minimum) == (0.3, 0.1)
    assert [c.name for c in system.outputs] == ["theta", "theta_rate"]


def test_a_run_may_override_columns(folder: Path) -> None:
    table(folder / "a.csv", u=FORCE, theta=ANGLE, u2=FORCE[::-1], theta2=ANGLE[::-1])
    last = 'file = "a.csv"\nuse = "validation"\ncolumns = {u = "u2", theta = "theta2"}'
    data = load_dataset(rewritten(folder, ('file = "b.csv"\nuse = "validation"', last))).dataset
    assert np.array_equal(data.validation[0].y[:, 0], ANGLE[::-1])


def test_a_free_swing_has_no_input_and_fits_its_model(folder: Path) -> None:
    changes = (('[signals.u]\nrole = "input"\nunit = "N m"\n', ""), ("sample_time", 'undriven = ["u"]\nsample_time'))
    loaded = load_dataset(rewritten(folder, *changes))
    assert loaded.dataset.spec.nu == 0
    assert any("input u is declared as undriven: 0" in note for note in loaded.dataset.warnings)
    full = loaded.for_system(loaded.system())
    assert [c.name for c in full.spec.inputs] == ["u"]
    assert not full.estimation[0].u.any()
    assert np.array_equal(full.estimation[0].y, loaded.dataset.estimation[0].y)


def test_an_input_that_no_column_gives_is_refused(folder: Path) -> None:
    path = rewritten(folder, ('[signals.u]\nrole = "input"\nunit = "N m"\n', ""))
    table(folder / "a.csv", torque__N_m=FORCE, theta=ANGLE, heat__K=ANGLE)
    with pytest.raises(
        InputError, match=r"no column gives the input u \[N m\] of pendulum.*torque.*undriven"
    ) as caught:
        load_dataset(path)
    assert "serve nothing: torque [N m], heat [K]" in str(caught.value)
    assert load_dataset(path, undriven=["u"]).dataset.spec.nu == 0
    with pytest.raises(InputError, match=r"undriven input: expected .*\(u\), got 'v'"):
        load_dataset(path, undriven=["v"])


def test_a_recorded_input_is_not_undriven(folder: Path) -> None:
    with pytest.raises(InputError, match="got 'u', which a signal gives"):
        load_dataset(folder / "dataset.toml", undriven=["u"])


def test_a_bare_file_without_the_input_is_refused_by_every_command(folder: Path, tmp_path: Path) -> None:
    table(folder / "bare.csv", time__s=TIME, torqe__N_m=FORCE, theta__rad=ANGLE)
    bare = folder / "bare.csv"
    for call in (
        lambda: api.close_loop(bare, model="pendulum", out=tmp_path / "out"),
        lambda: api.identify(bare, model="pendulum", identifier="hold"),
        lambda: api.close_loop(bare, model=str(mockup("pendulum")), out=tmp_path / "out"),
    ):
        with pytest.raises(InputError, match=r"no column gives the input u \[N m\].*serve nothing: torqe"):
            call()
    fitted = api.identify(bare, model="pendulum", identifier="hold", undriven=["u"])
    assert fitted.model.spec.nu == 0


def test_a_linear_model_takes_any_ports_and_units(folder: Path) -> None:
    changes = (
        ('model = "pendulum"', 'model = "linear"\noptions = {order = 3}'),
        ("[signals.theta]", "[signals.heat]"),
        ('unit = "rad"', 'unit = "degC"\ncolumn = "theta"'),
        ('unit = "N m"', 'unit = "mV"'),
    )
    loaded = load_dataset(rewritten(folder, *changes))
    assert [str(c) for c in loaded.dataset.spec.outputs] == ["heat [K]"]
    assert [str(c) for c in loaded.system().inputs] == ["u [V]"]
    assert loaded.system().nx == 3


def test_an_analogy_keeps_the_units_of_the_data(folder: Path) -> None:
    changes = (
        ('model = "pendulum"', 'model = "oscillator"\nanalogy = true'),
        ("[signals.theta]", "[signals.q]"),
        ('unit = "rad"', 'unit = "V"\ncolumn = "theta"'),
    )
    loaded = load_dataset(rewritten(folder, *changes))
    assert [str(c) for c in loaded.system().outputs] == ["q [V]"]


def test_a_users_model_runs_only_where_the_caller_names_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = (
        "from harness.physics.models import pendulum\nopen('ran', 'w').close()\ndef swing():\n    return pendulum()\n"
    )
    (folder / "mine.py").write_text(source)
    monkeypatch.chdir(folder)
    known = ("[signals.u]", "[nominal.parameters]\nJ = 0.3\n[signals.u]")
    path = rewritten(folder, ('"pendulum"', '"mine.py:swing"'), known)
    with pytest.raises(InputError, match=r"nominal.model: a file that runs code.*--trust mine.py"):
        load_dataset(path)
    assert not (folder / "ran").exists()
    with trusting("mine.py"):
        assert load_dataset(path).system().parameter("J").value == 0.3
    loaded = load_dataset(path, model="mine.py:swing")
    assert loaded.system().parameter("J").value == 0.3
    assert loaded.system().parameter_names == ("J", "b", "mgl")


def test_the_data_folder_is_searched(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = tmp_path / "store"
    store.mkdir()
    (folder / "a.csv").rename(store / "a.csv")
    assert "a.csv" in refusal(folder / "dataset.toml")
    monkeypatch.setenv("SYSID_HARNESS_DATA", str(store))
    assert len(load_dataset(folder / "dataset.toml").dataset.runs) == 2


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('unit = "rad"', 'unit = "V"', ["dataset.toml", "signals.theta.unit", "rad", "V"]),
        ('unit = "rad"', 'unit = "gnats"', ["signals.theta.unit", "gnats"]),
        ('unit = "rad"', "", ["signals.theta.unit", "no unit"]),
        ('role = "output"', 'roll = "output"', ["dataset.toml", "signals.theta.roll", "did you mean role"]),
        ('role = "output"', 'role = "sensor"', ["dataset.toml", "signals", "sensor"]),
        ('role = "output"', 'role = "input"', ["output"]),
        ("sample_time = 0.01", "sample_time = -1.0", ["sample_time", "-1"]),
        ("sample_time = 0.01", 'sample_time = "fast"', ["sample_time"]),
        ("sample_time = 0.01", "", ["sample_time", "no time"]),
        ('model = "pendulum"', 'model = "pendulm"', ["nominal.model", "pendulm", "pendulum"]),
        ('model = "pendulum"', 'model = "pendulum"\nparameters = {M = 1.0}', []),
        ("[signals.theta]", '[signals.theta]\nport = "u"', ["two signals on one port"]),
        ("[signals.theta]", '[signals.theta]\nport = "thet"', ["thet", "did you mean theta"]),
        ("[signals.theta]", '[signals.theta]\ncolumn = "thta"', ["a.csv", "thta", "did you mean 'theta'"]),
        ("[signals.theta]", '[signals.theta]\ncolumn = "u"', ["two signals from one column"]),
        ("[signals.theta]", "[signals.theta]\nscale = 0.0", ["signals.theta", "scale"]),
        ("[signals.u]", "[signals.u]\nderivative = 1", ["signals.u.derivative"]),
        ('file = "b.csv"', 'file = "c.csv"', ["c.csv", "no such file", "near it"]),
        ('file = "b.csv"', 'file = "b.csv"\nrows = [10, 500]', ["b.csv", "rows"]),
        ('file = "b.csv"', 'file = "b.csv"\nrows = [10, 5]', ["runs[1].rows"]),
        ('file = "b.csv"', 'file = "b.csv"\nrows = [10, 11]', ["b.csv", "at least 20 rows"]),
        ('file = "b.csv"', 'file = "b.csv"\ndiscard = 90', ["b.csv", "nothing left"]),
        ('file = "b.csv"', 'file = "b.csv"\ncolumns = {thta = "x"}', ["runs[1].columns.thta", "did you mean theta"]),
        ('file = "b.csv"', 'file = "a.csv"\nrows = [40, 90]', ["overlap", "runs[1].rows"]),
        ('file = "b.csv"', 'file = "a.csv"', ["the validation data are the estimation data", "runs[1]"]),
        ("[nominal]", "[nominal", ["dataset.toml", "TOML"]),
        ('file = "a.csv"', 'file = "a.csv"\nuse = "validation"', ["estimation"]),
        ('name = "bench"', "", ["name"]),
    ],
)
def test_what_cannot_be_meant_is_refused(folder: Path, old: str, new: str, words: list[str]) -> None:
    path = rewritten(folder, (old, new))
    if not words:
        with pytest.raises(InputError, match=r"dataset.toml.*nominal.parameters.M.*unknown parameter"):
            load_dataset(path).system()
        return
    line = refusal(path)
    for word in words:
        assert word in line, line


def test_validation_data_equal_to_estimation_data_are_refused(folder: Path) -> None:
    table(folder / "b.csv", u=FORCE, theta=ANGLE)
    assert "the validation data are the estimation data" in refusal(folder / "dataset.toml")


def test_a_declared_unit_counts_where_the_title_states_another(folder: Path) -> None:
    table(folder / "a.csv", u__N_m=FORCE, theta__deg=ANGLE)
    data = load_dataset(folder / "dataset.toml").dataset
    assert np.array_equal(data.estimation[0].y[:, 0], ANGLE)  # rad, as declared
    assert any("signals.theta: the title says 'deg'; 'rad'" in note for note in data.warnings)
    table(folder / "a.csv", u__N_m=FORCE, theta__rad=ANGLE)
    assert np.array_equal(load_dataset(folder / "dataset.toml").dataset.estimation[0].y[:, 0], ANGLE)


def test_a_bare_file_takes_ports_and_units_from_its_titles(folder: Path) -> None:
    table(folder / "a.csv", time__ms=TIME * 1000, u__mN_m=FORCE * 1000, theta__deg=np.rad2deg(ANGLE), junk=FORCE)
    loaded = load_dataset(folder / "a.csv", model="pendulum")
    data = loaded.dataset
    assert data.spec.sample_time == pytest.approx(0.01)
    assert [len(t) for t in (*data.estimation, *data.validation)] == [60, 30]
    assert data.estimation[0].y[:, 0] == pytest.approx(ANGLE[:60])
    assert data.estimation[0].u[:, 0] == pytest.approx(FORCE[:60])
    assert any("last third" in note for note in data.warnings)
    assert any("junk" in note for note in data.warnings)
    table(folder / "b.csv", time__s=TIME, u__N_m=2 * FORCE, theta__rad=2 * ANGLE)
    both = load_dataset(folder / "a.csv", model="pendulum", validation=folder / "b.csv").dataset
    assert [len(t) for t in (*both.estimation, *both.validation)] == [90, 90]
    assert both.validation[0].y[:, 0] == pytest.approx(2 * ANGLE)


def test_a_bare_file_is_refused_in_words(folder: Path) -> None:
    assert "--model" in refusal(folder / "a.csv")
    table(folder / "a.csv", u__N_m=FORCE, theta__rad=ANGLE)
    assert "no time" in refusal(folder / "a.csv", model="pendulum")
    assert "theta" in refusal(folder / "a.csv", model="drive")
    assert "did you mean" in refusal(folder / "a.csv", model="pendulm") or "pendulum" in refusal(
        folder / "a.csv", model="pendulm"
    )
    table(folder / "a.csv", time=TIME, u__N_m=FORCE, theta=ANGLE)
    assert "no unit" in refusal(folder / "a.csv", model="pendulum")
    assert "no such file" in refusal(folder / "none.csv", model="pendulum")


def test_the_caller_may_bring_the_ports() -> None:
    read = parse_description(BASE)
    assert read.signals["theta"].role == "output"
    assert read.runs[1].use == "validation"
