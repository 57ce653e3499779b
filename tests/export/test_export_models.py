"""What can be exported from where: stored models, linear models, python-control, and the command."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fmpy.validation import validate_fmu

from harness import registry
from harness.command import main
from harness.errors import InputError
from harness.export import export, to_control, write_linear_fmu
from harness.physics.models import pendulum
from harness.protocols import Experiment
from harness.rollout import perform
from harness.signals import Channel, PlantSpec
from identifiers.linear.least_squares import LinearModel
from identifiers.mechanics.grey_box import GreyBoxModel

RNG = np.random.default_rng(1)
SPEC = PlantSpec((Channel("u", "V"), Channel("w")), (Channel("y", "rad"),), 0.05)


def linear(direct=0.0, offset=0.0):
    a = np.array([[0.9, 0.2], [-0.3, 0.7]])
    b, c = np.array([[0.1, 0.0], [0.5, -0.2]]), np.array([[1.0, -2.0]])
    return LinearModel(
        SPEC, a, b, c, np.full((1, 2), direct), np.zeros((2, 1)), np.full(2, offset), np.full(1, 3 * offset)
    )


def run(path, u, dt, x0=None):
    with registry.create("plants", "fmu", path=path, sample_time=dt) as plant:
        return perform(plant, Experiment(u, x0=x0), rng=RNG).y


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(("direct", "offset"), [(0.0, 0.0), (0.7, 0.0), (0.0, 0.3)])
def test_a_linear_model_becomes_an_fmu(version, direct, offset, tmp_path):
    model, u = linear(direct, offset), RNG.normal(size=(80, 2))
    path = write_linear_fmu(model, tmp_path / "m.fmu", version=version)
    assert validate_fmu(str(path)) == []
    y = model.free_run(np.array([[0.4, -1.0]]), u[None])[0]
    assert np.abs(run(path, u, 0.05, {"state.x1": 0.4, "state.x2": -1.0}) - y).max() < 1e-12
    assert (
        np.abs(run(path, np.repeat(u, 5, axis=0), 0.01)[::5] - model.free_run(np.zeros((1, 2)), u[None])[0]).max()
        < 1e-12
    )


def test_a_linear_model_becomes_a_python_control_system():
    import control

    model, u = linear(0.7), RNG.normal(size=(60, 2))
    system = to_control(model)
    assert system.dt == 0.05
    assert (system.input_labels, system.output_labels) == (["u", "w"], ["y"])
    y = control.forced_response(system, np.arange(60) * 0.05, u.T, np.array([0.4, -1.0])).outputs
    assert np.abs(np.ravel(y) - model.free_run(np.array([[0.4, -1.0]]), u[None])[0, :, 0]).max() < 1e-12


def test_what_is_not_linear_or_has_offsets_is_refused():
    with pytest.raises(InputError, match="offset"):
        to_control(linear(offset=0.3))
    with pytest.raises(InputError, match="linear"):
        to_control(pendulum().system())


def grey(tmp_path, **changes):
    from identifiers.mechanics.physical import recipe_for

    system = pendulum().system()
    spec = PlantSpec(system.inputs, system.outputs, 0.02)
    recipe = recipe_for(spec, "test", model="pendulum", effects=("coulomb_friction@theta",))
    values = {"J": 0.05, "b": 0.02, "mgl": 1.3, "coulomb_friction@theta.Fc": 0.1}
    known = {one.name: one.value for one in recipe.system(spec).parameters}
    model = GreyBoxModel(spec, recipe, {**known, **values}, substeps=3, **changes)
    path = tmp_path / "model.json"
    path.write_text(json.dumps(model.to_dict()))
    return model, path


@pytest.mark.parametrize("as_folder", [False, True])
def test_a_stored_model_or_its_folder_is_exported_with_its_own_steps(as_folder, tmp_path):
    model, path = grey(tmp_path)
    files = export(tmp_path if as_folder else path, out=tmp_path / "m.fmu")
    assert [one.name for one in files] == ["m.fmu", "m-fmi3.fmu"]
    u = 0.4 * np.sin(0.1 * np.arange(120))[:, None]
    y = model.simulator.rollout(model.system().vector(model.parameters), np.array([0.3, 0.0]), u)
    for one in files:
        assert np.abs(run(one, u, 0.02, {"state.theta": 0.3}) - y).max() < 1e-9


def command(*arguments):
    with pytest.raises(SystemExit) as end:
        main([str(one) for one in arguments])
    return end.value.code


def test_the_command_writes_and_does_not_overwrite(tmp_path, capsys):
    out = tmp_path / "model.fmu"
    assert command("export", "pendulum", "-o", out) == 0
    assert "model-fmi3.fmu" in capsys.readouterr().out
    assert validate_fmu(str(out)) == []
    assert validate_fmu(str(tmp_path / "model-fmi3.fmu")) == []
    assert command("export", "pendulum", "-o", out) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "--force" in error
    assert command("export", "pendulum", "-o", out, "--force", "--fmi", "3") == 0
    from fmpy import read_model_description

    assert read_model_description(str(out)).fmiVersion == "3.0"


@pytest.mark.parametrize(
    ("source", "flags", "words"),
    [
        ("pendulum", ["--fmi", "1"], "2, 3, both"),
        ("no-such-model", [], "no-such-model"),
        ("missing/model.json", [], "no file"),
    ],
)
def test_the_command_refuses_in_one_line(source, flags, words, tmp_path, capsys):
    assert command("export", source, "-o", tmp_path / "m.fmu", *flags) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
    assert not (tmp_path / "m.fmu").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{}", "not a model"),
        ("no json", "not a model"),
        ('{"kind": "koopman"}', "koopman"),
        ('{"kind": "linear"}', "not a model"),
        ('{"kind": "grey-box"}', "grey-box"),
    ],
)
def test_other_files_are_refused_in_words(content, words, tmp_path):
    path = tmp_path / "model.json"
    path.write_text(content)
    with pytest.raises(InputError, match=words):
        export(path, out=tmp_path / "m.fmu")


def test_a_smooth_input_is_refused_and_so_is_another_ending(tmp_path):
    _, path = grey(tmp_path, intersample="smooth")
    with pytest.raises(InputError, match="held"):
        export(path, out=tmp_path / "m.fmu")
    with pytest.raises(InputError, match="ends in"):
        export("pendulum", out=tmp_path / "m.zip")


@pytest.mark.parametrize("dt", [0, 0.05])
def test_a_state_space_system_goes_in_and_out_with_one_call(dt, tmp_path):
    import control

    from harness.export import from_state_space
    from harness.scoring import simulation_error
    from harness.signals import Trajectory

    rng = np.random.default_rng(0)
    a = [[0.0, 1.0], [-4.0, -0.5]] if dt == 0 else [[0.9, 0.1], [-0.2, 0.8]]
    system = control.ss(a, [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]], dt, inputs=["force"], outputs=["place"])
    model = from_state_space(system, sample_time=0.05, units={"force": "N", "place": "m"})
    assert str(model.spec) == "force [N] -> place [m] every 0.05 s"
    t, u = 0.05 * np.arange(200), rng.normal(size=200)
    discrete = control.c2d(system, 0.05, "zoh") if dt == 0 else system
    y = control.forced_response(discrete, t, u).outputs
    record = Trajectory(t, u[:, None], np.reshape(y, (-1, 1)), model.spec)
    assert simulation_error(model, record).nrmse[0] < 1e-6
    back = to_control(model)
    assert back.input_labels == ["force"]
    assert np.allclose(back.A, discrete.A)
    write_linear_fmu(model, tmp_path / "m.fmu")


def test_systems_without_a_sample_time_or_with_another_are_refused():
    import control

    from harness.export import from_state_space

    system = control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)
    with pytest.raises(InputError, match=r"0.1 s, its own"):
        from_state_space(system, sample_time=0.2)
    assert from_state_space(control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 1)).spec.sample_time == 1.0
    with pytest.raises(InputError, match=r"give sample_time"):
        from_state_space(control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], True))
    with pytest.raises(InputError, match=r"give sample_time"):
        from_state_space(control.ss([[-0.5]], [[1.0]], [[1.0]], [[0.0]]))
    with pytest.raises(InputError, match=r"control.ss"):
        from_state_space(control.tf([1.0], [1.0, 1.0]))
    with pytest.raises(InputError, match="units: expected one of"):
        from_state_space(system, units={"force": "N"})


def test_a_loop_on_typed_equations_is_read_from_anywhere(tmp_path, monkeypatch):
    """Its model named the file as the command had seen it: another folder, and it was gone."""
    from harness import api

    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "fan.eqs").write_text(
        "input i [A]\nstate w [rad/s]\nJ = 2e-4 kg m^2\nb = 1e-4 N m s/rad\nmotion shaft: w, J\n"
        "w' = (0.05*i - b*w)/J\noutput w\n"
    )
    t = np.arange(400) * 0.01
    i = 0.5 + 0.3 * np.sign(np.sin(7 * t))
    w = np.zeros(400)
    for k in range(399):
        steady, decay = 0.05 * i[k] / 1e-4, np.exp(-0.01 * 1e-4 / 2e-4)
        w[k + 1] = steady + (w[k] - steady) * decay
    noise = 0.05 * np.random.default_rng(0).standard_normal((2, 400))
    for name, more in zip(("a.csv", "b.csv"), noise, strict=True):
        rows = np.column_stack([t, i, w + more])
        np.savetxt(tmp_path / name, rows, delimiter=",", header="time [s],i [A],w [rad/s]", comments="")
    monkeypatch.chdir(tmp_path / "there")
    api.close_loop(
        tmp_path / "a.csv",
        model="fan.eqs",
        validation=tmp_path / "b.csv",
        dictionary="quadratic_drag?",
        out=tmp_path / "r",
    )
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there" / "fan.eqs").unlink()
    (tmp_path / "r").rename(tmp_path / "moved")
    assert export(tmp_path / "moved", out=tmp_path / "fan.fmu")[0].exists()
    assert api.load_model(tmp_path / "moved").parameters["J"] == pytest.approx(2e-4, rel=0.05)
