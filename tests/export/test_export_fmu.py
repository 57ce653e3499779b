"""Exported FMUs: valid, the same bits as our own roll-outs, every effect, by our client, by fmpy, and from source."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from fmpy import read_model_description, simulate_fmu
from fmpy.validation import validate_fmu

from harness import registry
from harness.effects import Placed, builtin, compose, place_all, recommended_substeps
from harness.errors import InputError, PlantError
from harness.export import write_fmu
from harness.fmi import build
from harness.physics.models import BUILT_IN
from harness.protocols import Experiment
from harness.rollout import perform

RNG = np.random.default_rng(0)
SYSTEMS = {name: BUILT_IN[name]().system() for name in ("pendulum", "cart-pole", "drive", "oscillator", "two-tanks")}
N = 150


def case(name, *placed):
    """A composed system, its simulator, a moving start and an input that stands still for three samples."""
    system = SYSTEMS[name]
    dt = 4.0 if system.process else 0.01
    sizes = {"": {"dt": dt, "T": N * dt, "u": 1.0, "q": 0.3, "v": 1.0, "y": 0.3, "x": 3.0, "F": 1.0, "a": 10.0}}
    composed = compose(system, placed, sizes=sizes) if placed else system
    t = np.arange(N)[:, None]
    u = 0.6 * np.sin(2 * np.pi * 5 * t / N + np.arange(system.nu)) + (3.0 if system.process else 0.4)
    simulator = composed.simulator(
        dt, backend="casadi", substeps=max(2, recommended_substeps(composed, None, dt) if placed else 2)
    )
    x = np.zeros(composed.nx)
    x[: composed.nx - composed.hidden_count] = 4.0 if system.process else 0.15
    if composed.hidden_count:
        x[composed.nx - composed.hidden_count :] = simulator.hidden_start(x, u[0], composed.vector())
    return simulator, x, u


def starts(simulator, x):
    """The visible states by name: hidden ones start where the effect says."""
    system = simulator.system
    return {c.name: v for c, v in list(zip(system.states, x, strict=True))[: system.nx - system.hidden_count]}


def ours(path, u, dt, x0=None, parameters=None):
    with registry.create("plants", "fmu", path=path, sample_time=dt, parameters=parameters) as plant:
        x0 = None if x0 is None else {f"state.{k}": v for k, v in x0.items()}
        return perform(plant, Experiment(u, x0=x0), rng=RNG).y


def settled(placed, dt):
    """Samples after which a delayed sensor no longer tells of the time before the record."""
    late = [one for one in placed if one.effect.name == "sensor_delay"]
    return 40 if late else 0


SINGLE = [(name, one) for name, system in SYSTEMS.items() for one in place_all(system)
          if name in ("pendulum", "two-tanks") or one.effect.kinds == ("base",)]  # fmt: skip


@pytest.mark.parametrize(("name", "one"), SINGLE, ids=[f"{name}-{one}" for name, one in SINGLE])
def test_every_effect_is_exported_and_repeats_our_rollout(name, one, tmp_path):
    simulator, x, u = case(name, one)
    path = write_fmu(simulator, simulator.system.values(), tmp_path / "m.fmu", x0=starts(simulator, x))
    y = simulator.rollout(simulator.system.vector(), x, u)
    skip = settled([one], simulator.dt)
    assert np.abs(ours(path, u, simulator.dt) - y)[skip:].max() <= 1e-9


def put(name, at, **values):
    return Placed(builtin()[name], at, values)


PAIRS = [
    ("pendulum", put("coulomb_friction", "theta", Fc=0.1), put("input_delay", "u", tau=0.033)),
    ("pendulum", put("sensor_quantisation", "theta", step=0.01), put("dead_zone", "u", width=0.1)),
    ("pendulum", put("actuator_lag", "u", tau=0.05), put("sensor_offset", "theta", offset=0.1)),
    ("cart-pole", put("coulomb_friction", "x", Fc=0.2), put("viscous_friction", "theta", b=0.02)),
    ("drive", put("input_delay", "u", tau=0.02), put("force_bias", "q", F0=0.3)),
    ("oscillator", put("cubic_spring", "q", k3=0.5), put("quadratic_drag", "q", c=0.1)),
]


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: "+".join(map(str, pair)))
def test_two_effects_at_once_by_fmpys_own_simulation(pair, version, tmp_path):
    simulator, x, u = case(pair[0], *pair[1:])
    path = write_fmu(simulator, simulator.system.values(), tmp_path / "m.fmu", version=version, x0=starts(simulator, x))
    assert validate_fmu(str(path)) == []
    y = simulator.rollout(simulator.system.vector(), x, u)
    dt, spec = simulator.dt, simulator.spec
    rows = [(k * dt, *u[k]) for k in range(N)]
    signals = np.array(rows, dtype=[("time", float), *((c.name, float) for c in spec.inputs)])
    names = [c.name for c in spec.outputs]
    result = simulate_fmu(
        str(path), stop_time=(N - 1) * dt, step_size=dt, output_interval=dt, input=signals, output=names
    )
    found = np.column_stack([result[name] for name in names])
    assert found.shape == y.shape
    assert np.abs(found - y).max() <= 1e-6


@pytest.mark.parametrize("name", sorted(SYSTEMS))
@pytest.mark.parametrize("version", [2, 3])
def test_every_builtin_model_is_valid_and_repeats(name, version, tmp_path):
    simulator, x, u = case(name)
    path = write_fmu(simulator, simulator.system.values(), tmp_path / "m.fmu", version=version)
    assert validate_fmu(str(path)) == []
    y = simulator.rollout(simulator.system.vector(), x, u)
    assert np.abs(ours(path, u, simulator.dt, x0=starts(simulator, x)) - y).max() <= 1e-9
    variables = {one.name: one for one in read_model_description(str(path)).modelVariables}
    for one in simulator.system.parameters:
        assert variables[one.name].variability == "tunable"
        assert variables[one.name].unit == one.unit


def test_parameters_are_tunable_and_bounded(tmp_path):
    simulator, x, u = case("pendulum", put("coulomb_friction", "theta", Fc=0.1))
    path = write_fmu(simulator, simulator.system.values(), tmp_path / "m.fmu", x0=starts(simulator, x))
    other = simulator.system.values({"J": 0.3, "coulomb_friction@theta.Fc": 0.25})
    y = simulator.rollout(simulator.system.vector(other), x, u)
    assert np.abs(ours(path, u, simulator.dt, parameters=other) - y).max() <= 1e-9
    first = simulator.rollout(simulator.system.vector(), x, u)
    assert np.abs(first - y).max() > 1e-3
    with pytest.raises((PlantError, InputError), match="below"):
        ours(path, u, simulator.dt, parameters={"J": -1.0})


def test_the_start_of_a_hidden_state_can_be_chosen(tmp_path):
    simulator, x, u = case("pendulum", put("actuator_lag", "u", tau=0.3))
    path = write_fmu(simulator, simulator.system.values(), tmp_path / "m.fmu", x0=starts(simulator, x))
    x[-1] = -2.0
    y = simulator.rollout(simulator.system.vector(), x, u)
    by_name = dict(zip([c.name for c in simulator.system.states], x, strict=True))
    assert np.abs(ours(path, u, simulator.dt, x0=by_name) - y).max() <= 1e-9
    again = write_fmu(simulator, simulator.system.values(), tmp_path / "n.fmu", x0=by_name)
    assert np.abs(ours(again, u, simulator.dt) - y).max() <= 1e-9


@pytest.mark.parametrize("version", [2, 3])
def test_the_sources_inside_compile_alone_to_the_same_bits(version, tmp_path):
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed")
    simulator, x, u = case("pendulum", put("hysteresis", "theta"), put("input_delay", "u"))
    path = write_fmu(simulator, simulator.system.values(), tmp_path / "m.fmu", version=version, x0=starts(simulator, x))
    place = tmp_path / "unpacked"
    with zipfile.ZipFile(path) as archive:
        archive.extractall(place)
    (binary,) = place.glob(f"binaries/{build.binary_folder(version)}/*.*")
    own = binary.read_bytes()
    binary.unlink()
    command = ["gcc", "-std=c11", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    command += ["-fvisibility=hidden", f"-DFMI={version}", str(place / "sources" / "fmi.c"), "-o", str(binary), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert binary.read_bytes() != own
    mine = tmp_path / "mine.fmu"
    with zipfile.ZipFile(mine, "w") as archive:
        for one in sorted(p for p in place.rglob("*") if p.is_file()):
            archive.write(one, one.relative_to(place).as_posix())
    assert np.array_equal(ours(mine, u, simulator.dt), ours(path, u, simulator.dt))


def test_equal_models_give_equal_files(tmp_path):
    if not sys.platform.startswith("linux"):
        pytest.skip("linkers of other systems write the date into the binary")
    simulator, _, _ = case("pendulum")
    one = write_fmu(simulator, simulator.system.values(), tmp_path / "a.fmu").read_bytes()
    assert one == write_fmu(simulator, simulator.system.values(), tmp_path / "b.fmu").read_bytes()


def test_a_smooth_input_is_refused_in_words(tmp_path):
    simulator = SYSTEMS["pendulum"].simulator(0.01, intersample="smooth")
    with pytest.raises(InputError, match="zoh"):
        write_fmu(simulator, {}, tmp_path / "m.fmu")
    assert list(tmp_path.iterdir()) == []


def test_an_input_that_moves_on_lines_is_held_in_an_fmu(tmp_path):
    """The equations are the same; how an input comes is the master's affair."""
    held, lines = (SYSTEMS["pendulum"].simulator(0.01, intersample=how) for how in ("zoh", "foh"))
    paths = [write_fmu(one, one.system.values(), tmp_path / f"{one.intersample}.fmu") for one in (held, lines)]
    u = np.sin(np.arange(200) * 0.1)[:, None]
    assert np.array_equal(ours(paths[0], u, 0.01), ours(paths[1], u, 0.01))


def test_unknown_names_and_a_missing_compiler_are_refused(tmp_path, monkeypatch):
    simulator, _, _ = case("pendulum")
    with pytest.raises(InputError, match="nonsense"):
        write_fmu(simulator, {}, tmp_path / "m.fmu", x0={"nonsense": 1.0})
    with pytest.raises(InputError, match="nonsense"):
        write_fmu(simulator, {"nonsense": 1.0}, tmp_path / "m.fmu")
    monkeypatch.setenv("SYSID_HARNESS_NO_COMPILER", "1")
    with pytest.raises(InputError, match="compiler"):
        write_fmu(simulator, {}, tmp_path / "m.fmu")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("version", [2, 3])
def test_the_licence_and_the_sources_are_inside_and_named(version, tmp_path):
    simulator, _, _ = case("pendulum")
    path = write_fmu(simulator, simulator.system.values(), tmp_path / "a.fmu", version=version)
    with zipfile.ZipFile(path) as archive:
        licence = archive.read("documentation/licenses/license.txt").decode()
        names = archive.namelist()
        text = archive.read("modelDescription.xml").decode()
    assert "belong to whoever made it" in licence
    assert (Path(__file__).parents[2] / "LICENSE").read_text() in licence
    assert {"sources/fmi.c", "sources/model.c"} <= set(names)
    assert 'license="see documentation/licenses/license.txt"' in text
    assert version == 3 or '<File name="fmi.c"' in text
    assert validate_fmu(path) == []


FOREIGN = """#!/bin/sh
for given; do shift; case "$given" in -Wl,*) ;; *) set -- "$@" "$given" ;; esac; done
exec gcc "$@"
"""
"""Stands in for a compiler for Windows: without the option that only its linker knows."""


@pytest.mark.skipif(sys.platform != "linux", reason="stands in for compilers of other systems by a shell script")
@pytest.mark.parametrize("version", [2, 3])
def test_every_cross_compiler_at_hand_adds_a_platform_and_a_broken_one_is_said(version, tmp_path, monkeypatch, caplog):

    tools = tmp_path / "tools"
    tools.mkdir()
    for name, (program, _folder, _suffix, _options) in build.CROSS.items():
        tool = tools / program
        tool.write_text("#!/bin/sh\necho no headers >&2\nexit 1\n" if "aarch64" in name else FOREIGN)
        tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:/usr/bin:/bin")
    simulator, x, u = case("pendulum")
    path = write_fmu(simulator, simulator.system.values(), tmp_path / "a.fmu", version=version)
    with zipfile.ZipFile(path) as archive:
        found = {name for name in archive.namelist() if name.startswith("binaries/")}
    own = build.binary_folder(version)
    wanted = {"win64/pendulum.dll"} if version == 2 else {"x86_64-windows/pendulum.dll", "x86_64-linux/pendulum.so"}
    assert found == {f"binaries/{name}" for name in (wanted | {f"{own}/pendulum.so"})}
    # FMI 2.0 has no folder for 64-bit ARM; that of FMI 3.0 was tried and its compiler's words are kept
    assert [r.message for r in caplog.records if "no headers" in r.message] == (
        []
        if version == 2
        else [f"the FMU gets no binary for aarch64-linux: {tools}/aarch64-linux-gnu-gcc failed: no headers"]
    )
    assert np.isfinite(ours(path, u, simulator.dt, starts(simulator, x))).all()
