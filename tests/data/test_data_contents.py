"""What is inside a file is shown, and a description drafted from it asks for what nobody stated."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from harness import api
from harness.cli.app import app
from harness.data import load_dataset
from harness.data.recipe.contents import contents_of
from harness.errors import InputError

N, DT = 60, 0.01
T = np.arange(N) * DT
U = np.sin(9 * T)
Y = 0.1 * np.cos(9 * T)
MJCF = """<mujoco model="cart"><worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
<body name="pole"><joint name="hinge" type="hinge" frictionloss="0.02"/></body></body></worldbody>
<actuator><motor name="drive" joint="slide" gear="10"/></actuator></mujoco>"""


def table(path: Path, titles: str, *columns: np.ndarray) -> Path:
    rows = zip(*columns, strict=True)
    path.write_text("\n".join([titles, *(",".join(map(repr, map(float, row))) for row in rows)]) + "\n")
    return path


def test_a_log_with_common_units_is_shown_without_the_library_of_units(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(
        "time [s],u [N m],theta [rad]\n" + "".join(f"{k / 8},{k},{k}\n" for k in range(40))
    )
    code = "import sys; from harness.data.recipe.contents import contents_of; "
    code += "print([one.unit for one in contents_of('log.csv').channels], 'pint' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['N m', 'rad'] False"


def test_channels_units_rate_length_and_holes(tmp_path: Path) -> None:
    keep = np.r_[0:20, 25:N]
    log = table(tmp_path / "a.csv", "Zeit (ms),u [Nm],theta_deg,raw", 1e3 * T[keep], U[keep], Y[keep], Y[keep])
    found = contents_of(log)
    assert (found.clock, found.clock_stated, found.holes, found.rows) == ("Zeit (ms)", True, 1, N - 5)
    assert found.sample_time == pytest.approx(DT)
    assert found.length == pytest.approx(T[-1])
    assert [(one.name, one.unit) for one in found.channels] == [("u", "Nm"), ("theta_deg", ""), ("raw", "")]
    assert found.channels[0].maximum == pytest.approx(U[keep].max())
    shown = CliRunner().invoke(app, ["list", str(log)])
    assert shown.exit_code == 0
    assert all(text in shown.output for text in ("100 Hz", "1 holes", "u [Nm]", "theta_deg"))


def test_what_binary_files_hold(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'sysid-harness[data]'")
    from scipy.io import savemat

    savemat(tmp_path / "a.mat", {"time": T, "Y": np.column_stack([U, Y, Y]), "log": {"u": U}})
    names = [channel.column for channel in contents_of(tmp_path / "a.mat").channels]
    assert names == ["Y[:,0]", "Y[:,1]", "Y[:,2]", "log.u"]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["run/time"] = T
        file["run/V"] = U  # the last step of a path is a name, be it also a unit
        file["run/V"].attrs["unit"] = "mV"
        file["run/theta_deg"] = Y
    found = {channel.column: channel for channel in contents_of(tmp_path / "a.h5").channels}
    assert found["run/V"].unit == "mV"
    assert found["run/theta_deg"].unit == ""


def test_robots_and_models(tmp_path: Path) -> None:
    (tmp_path / "cart.xml").write_text(MJCF)
    found = api.describe_file(tmp_path / "cart.xml")
    assert [joint["joint"] for joint in found["tables"]["joints"]] == ["slide", "hinge"]
    assert found["tables"]["actuators"][0]["gear"] == "10"
    (tmp_path / "model.json").write_text('{"kind": "grey-box", "model": "evil.py:run", "parameters": {"J": 0.5}}')
    assert "evil.py:run" in " ".join(api.describe_file(tmp_path / "model.json")["facts"])  # shown, never run
    (tmp_path / "bad.urdf").write_text("<html/>")
    with pytest.raises(InputError, match="no robot"):
        api.describe_file(tmp_path / "bad.urdf")


def test_data_sets_and_reports_are_listed_and_a_model_holds_no_data(tmp_path: Path) -> None:
    (tmp_path / "dataset.toml").write_text(
        'name = "rig"\nsample_time = 0.1\n[signals.u]\nrole = "input"\nunit = "V"\n[signals.y]\nrole = "output"\n'
        'column = "pos"\n[[runs]]\nfile = "a.csv"\nrows = [3, 90]\n'
    )
    found = api.describe_file(tmp_path / "dataset.toml")
    assert found["tables"]["signals"][1] == {
        "signal": "y", "role": "output", "column": "pos", "unit": "as its title says"
    }  # fmt: skip
    assert found["tables"]["runs"] == [{"file": "a.csv", "use": "estimation", "rows": "3 to 90"}]
    effect = {"name": "cogging", "at": "theta", "summary": "Force of the teeth."}
    report = {"summary": "pendulum lacks cogging", "dataset": "rig", "model": "pendulum", "effects": [effect],
              "verdict": "effects_found"}  # fmt: skip
    (tmp_path / "report.json").write_text(json.dumps(report))
    for path in (tmp_path, tmp_path / "report.json"):
        assert "pendulum lacks cogging" in api.describe_file(path)["facts"][0]
    shown = CliRunner().invoke(app, ["list", str(tmp_path)])
    assert shown.exit_code == 0
    assert "Force of the teeth." in shown.output
    del report["effects"]
    (tmp_path / "report.json").write_text(json.dumps(report))
    with pytest.raises(InputError, match=r"report\.json of sysid close-loop"):
        api.describe_file(tmp_path)
    for name in ("arm.urdf", "model.json", "plant.fmu"):
        (tmp_path / name).write_text("{}")
        with pytest.raises(InputError, match="a model where data are expected"):
            api.identify(tmp_path / name)


def test_a_draft_under_a_model_is_complete(tmp_path: Path) -> None:
    log = table(tmp_path / "a.csv", "Zeit (ms),u [Nm],theta_deg", 1e3 * T, U, np.degrees(Y))
    other = table(tmp_path / "b.csv", "Zeit (ms),u [Nm],theta_deg", 1e3 * T, -U, np.degrees(-Y))
    ran = CliRunner().invoke(
        app, ["new", "dataset", str(log), str(other), "--model", "pendulum", "--folder", str(tmp_path)]
    )
    assert ran.exit_code == 0, ran.output
    data = load_dataset(tmp_path / "dataset.toml").dataset
    assert [run.use for run in data.runs] == ["estimation", "validation"]
    assert data.spec.sample_time == pytest.approx(DT)
    assert data.estimation[0].y[:, 0] == pytest.approx(Y)
    with pytest.raises(InputError, match="--force"):
        api.new_dataset([log], out=tmp_path / "dataset.toml")


def test_a_draft_asks_and_nothing_is_taken_before_it_is_answered(tmp_path: Path) -> None:
    log = table(tmp_path / "a.csv", "stamp,torque [Nm],winkel", T, U, Y)
    out = api.new_dataset([log], out=tmp_path / "dataset.toml")
    text = out.read_text()
    assert 'role = "?"  # "input", "output" or "reference"?' in text
    with pytest.raises(InputError, match=r"signals\.torque\.role"):
        load_dataset(out)
    text = text.replace('role = "?"', 'role = "input"', 1).replace('role = "?"', 'role = "output"')
    out.write_text(text)
    with pytest.raises(InputError, match=r"'\?'"):  # the unit of winkel
        load_dataset(out)
    out.write_text(text.replace('unit = "?"', 'unit = "rad"'))
    found = load_dataset(out).dataset  # one record: its last third validates
    assert [(run.use, len(run.trajectory)) for run in found] == [("estimation", 40), ("validation", 20)]
    assert np.concatenate([run.trajectory.y[:, 0] for run in found]) == pytest.approx(Y)


def test_sheets_by_their_name(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not installed: pip install 'sysid-harness[data]'")
    book = openpyxl.Workbook()
    for name, sign in (("first", 1.0), ("second", -1.0)):
        sheet = book.create_sheet(name)
        sheet.append(["time [s]", "u [Nm]", "theta [rad]"])
        for row in zip(T, sign * U, sign * Y, strict=True):
            sheet.append([float(value) for value in row])
    book.remove(book["Sheet"])
    book.save(tmp_path / "a.xlsx")
    text = 'name = "a"\n[signals.u]\nrole = "input"\n[signals.theta]\nrole = "output"\n'
    for name, use in (("first", "estimation"), ("second", "validation")):
        text += f'[[runs]]\nfile = "a.xlsx"\nsheet = "{name}"\nuse = "{use}"\n'
    (tmp_path / "a.toml").write_text(text)
    data = load_dataset(tmp_path / "a.toml").dataset
    assert data.estimation[0].y[:, 0] == pytest.approx(Y)
    assert data.runs[1].trajectory.y[:, 0] == pytest.approx(-Y)
    (tmp_path / "b.toml").write_text(text.replace('"second"', '"third"'))
    with pytest.raises(InputError, match=r"no sheet 'third'.*'first', 'second'"):
        load_dataset(tmp_path / "b.toml")


@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_codings(coding: str, tmp_path: Path) -> None:
    rows = "\n".join(
        f"{t!r},{u!r},{y!r}" for t, u, y in zip(T.tolist(), U.tolist(), np.degrees(Y).tolist(), strict=True)
    )
    (tmp_path / "a.csv").write_bytes(f"time [s],u [Nm],theta [°]\n{rows}\n".encode(coding))
    data = load_dataset(tmp_path / "a.csv", model="pendulum").dataset
    assert data.estimation[0].y[:, 0] == pytest.approx(Y[:40])
    assert any("cp1252" in note for note in data.warnings) == (coding == "cp1252")


def test_a_draft_takes_roles_from_the_caller(tmp_path: Path) -> None:
    rows = "".join(f"{k / 10},{k % 7},{k % 5},{k % 3}\n" for k in range(60))
    (tmp_path / "a.csv").write_text("time [s],u [V],y [mm],flag\n" + rows)
    command = ["new", "dataset", str(tmp_path / "a.csv"), "--folder", str(tmp_path)]
    shown = CliRunner().invoke(app, [*command, "--input", "u", "--output", "y [mm]"])
    assert shown.exit_code == 0, shown.output
    data = api.load_dataset(tmp_path / "dataset.toml").dataset
    assert [str(one) for one in (*data.spec.inputs, *data.spec.outputs)] == ["u [V]", "y [m]"]
    assert "# flag: not used" in (tmp_path / "dataset.toml").read_text()
    shown = CliRunner().invoke(app, [*command, "--input", "u", "--output", "y", "-o", str(tmp_path / "b.toml")])
    assert "now: sysid identify" in shown.output, "nothing is open"
    assert (tmp_path / "b.toml").read_text() == (tmp_path / "dataset.toml").read_text()
    assert CliRunner().invoke(app, ["new", "plant", "x", "-o", str(tmp_path / "x")]).exit_code
    shown = CliRunner().invoke(app, [*command, "--input", "w", "--force"])
    assert isinstance(shown.exception, InputError)
    assert "no column 'w'" in str(shown.exception)


def test_a_draft_under_a_model_keeps_what_the_caller_says(tmp_path: Path) -> None:
    titles = "time [s],motor1 [N m],motor2 [N m],arm1 [rad],arm2 [rad/s],heat [degC]"
    log = table(tmp_path / "log.csv", titles, T, U, U, Y, Y, Y)
    said = {"input": ["motor1", "motor2"], "output": ["arm1", "arm2 [rad/s]"]}
    out = api.new_dataset([log], model="double-pendulum", out=tmp_path / "dataset.toml", **said)
    draft = out.read_text()
    assert [draft.count(f'role = "{role}"') for role in ("input", "output", "?")] == [2, 2, 0]
    assert draft.count('port = "?"  # which input of double-pendulum? unit fits: u1 [N m], u2 [N m]') == 2
    assert "theta1 with derivative = 1, theta2 with derivative = 1" in draft
    assert "an input of double-pendulum? If it was zero" not in draft
    with pytest.raises(InputError, match=r"signals\.motor1\.port: an open question"):
        load_dataset(out)
    for port in ("u1", "u2", "theta1"):
        draft = draft.replace('port = "?"', f'port = "{port}"', 1)
    out.write_text(draft.replace('port = "?"', 'port = "theta2"\nderivative = 1'))
    assert load_dataset(out).measured == (("theta1", 0), ("theta2", 1))
    only = api.new_dataset([log], model="double-pendulum", out=out, input="motor1", output=["arm1"], force=True)
    assert "an input of double-pendulum? If it was zero" in only.read_text()
    with pytest.raises(InputError, match="--output: 'u' as an output: expected input, as the model has it"):
        api.new_dataset([table(log, "time [s],u [N m],theta [rad]", T, U, Y)], model="pendulum", out=out, output="u",
                        force=True)  # fmt: skip
