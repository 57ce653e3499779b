"""The loop closed around an FMU: what is hidden inside it, before it and behind it is named, and handed back.

No truth here is made by an effect block: friction and springs are the FMUs' own C code, the others plain NumPy.
"""

from __future__ import annotations

import json
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest
from fmu_files import in_degrees

from harness import api, registry
from harness.blackbox.effects import surround
from harness.blackbox.reader import fmu_system
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.cosim.structure import opened
from harness.diagnosis import close_loop, close_loop_file
from harness.diagnosis.fmu.passes import FreePass
from harness.diagnosis.fmu.prepare import FmuWindows, measured_states, nominal_fmu
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.errors import InputError
from harness.export.package import write_package
from harness.export.ssp_elements import SSP
from harness.parts.files import make_plant
from harness.physics.compiled.kalman_pass import PassNoise
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from harness.specs import spec_to_dict
from harness.trust import trusting
from plants.mockups import mockup

DT, N = 0.01, 1000
EFFECTS = builtin()
PENDULUM = {"J": 0.06, "b": 0.04, "mgl": 1.1}
SPRING = {"m": 1.2, "c": 0.2, "k": 1.5}


def records(
    model="pendulum", parameters=PENDULUM, *, size=0.25, noise=1e-3, n=N, before=lambda u: u, behind=lambda y: y
):
    """Records of an FMU, its position measured; ``before`` and ``behind`` are what the nominal model lacks."""
    output = "theta" if model == "pendulum" else "q"
    runs = []
    for seed, use in ((0, "estimation"), (1, "validation")):
        rng = np.random.default_rng(seed)
        t = np.arange(n) * DT
        u = sum(size * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.13, 0.31, 0.53, 0.92))[:, None]
        options = {"sample_time": DT, "outputs": [output], "parameters": dict(parameters)}
        with registry.create("plants", "fmu", path=mockup(model), **options) as plant:
            y = np.vstack([plant.reset(rng=rng, x0={output: 0.4}), plant.rollout(before(u)[:-1])])
        y = behind(y) + rng.normal(0, noise, y.shape)
        spec = PlantSpec(plant.spec.inputs, plant.spec.outputs, DT)
        runs.append(Run(Trajectory(t, u, y, spec), use, use))
    return Dataset(runs=tuple(runs), name="mockup", noise={output: noise})


def closed(data, names, *, model="pendulum", **options):
    """Close the loop with a part of the dictionary."""
    return close_loop(data, mockup(model), dictionary=[EFFECTS[name] for name in names], **options)


def late(u, samples):
    """Delay by whole samples."""
    return np.vstack([np.repeat(u[:1], samples, axis=0), u[:-samples]])


def dead(u, width):
    """A dead zone."""
    return np.sign(u) * np.maximum(np.abs(u) - width, 0)


def simulator(effects, model="pendulum", parameters=None):
    """Return the simulator of an FMU with effects around it."""
    data = records(model)
    system = fmu_system(mockup(model), data.spec, parameters)
    around = surround(system, [Placed(EFFECTS[name], at, values) for name, at, values in effects])
    return FmuSimulator(around, Runner(system, DT)), data.estimation[0]


def test_a_force_around_the_fmu_is_the_force_inside_it():
    outside, run = simulator([("viscous_friction", "theta", {"b": 0.05}), ("quadratic_drag", "theta", {"c": 0.02})])
    inside = FmuSimulator(outside.system.nominal, outside.runner)
    values = inside.system.values()
    x0 = np.array([0.4, 0.0])
    y = outside.run(outside.system.vector(), x0, run.u)[1]
    same = inside.run(inside.system.vector({"b": values["b"] + 0.05, "c2": 0.02}), x0, run.u)[1]
    without = inside.run(inside.system.vector(), x0, run.u)[1]
    assert np.abs(y - same).max() < 2e-3 * np.abs(without - same).max()


@pytest.mark.parametrize(
    "effects",
    [
        [("coulomb_friction", "theta", {"Fc": 0.05}), ("sensor_gain", "theta", {"gain": 1.1})],
        [("backlash", "theta", {}), ("actuator_lag", "u", {"tau": 0.05})],
    ],
    ids=["friction and gain", "hidden states"],
)
def test_the_compiled_coupling_is_that_of_python(effects, monkeypatch):
    fast, run = simulator(effects)
    slow = FmuSimulator(fast.system, fast.runner)
    monkeypatch.setattr(slow, "_built", lambda: None)
    p, u = fast.system.vector(), run.u[:200]
    x0 = np.array([0.4, 0.1])
    x0 = np.concatenate([x0, fast.hidden_start(np.concatenate([x0, np.zeros(fast.system.hidden_count)]), u[0], p)])
    for a, b in zip(fast.run(p, x0, u), slow.run(p, x0, u), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


def counted(simulator, monkeypatch):
    """Return the list that grows by one with every run of the FMU."""
    runs, begin = [], simulator.runner.start
    monkeypatch.setattr(simulator.runner, "start", lambda *given: runs.append(given) or begin(*given))
    return runs


def test_a_step_of_a_fit_runs_the_fmu_once_and_for_the_derivatives_that_it_asks_for(monkeypatch):
    around, run = simulator([("coulomb_friction", "theta", {"Fc": 0.05})])
    runs, passes = counted(around, monkeypatch), FreePass(around)
    noise = PassNoise(np.array([1e-3]), *[np.zeros(0)] * 3)
    p, x0 = around.system.vector(), np.array([0.4, 0.0])
    plain = passes(run, p, x0, noise)
    wanted = [around.system.parameter_names.index("mgl"), around.np + 1]
    slopes = passes(run, p, x0, noise, columns=np.array(wanted))
    assert len(runs) == 1 + 2 + 1, "two by the parameter, one by the state; no run is made again"
    assert np.array_equal(plain.e, slopes.e)
    every = passes(run, p, x0, noise, columns=np.arange(around.np + around.nx))
    np.testing.assert_array_equal(slopes.j, every.j[..., wanted])


def test_a_window_that_is_done_is_not_simulated_again(monkeypatch):
    around, run = simulator([])
    windows = FmuWindows(around, [run], 1.0, np.array([1e-3]))
    starts = windows.starts_from([measured_states(around.system, around, run, around.system.vector())[0]])
    runs, limits = counted(around, monkeypatch), np.full(len(windows), np.inf)
    limits[3:] = -1.0
    columns = np.array(around.state_columns)
    found = windows.trial(around.system.vector(), starts, columns=columns, limits=limits)
    assert len(runs) == 3 * (1 + around.nx)
    whole = windows.trial(around.system.vector(), starts, columns=columns)
    np.testing.assert_array_equal(found.costs[:3], whole.costs[:3])
    np.testing.assert_array_equal(found.gram[:3], whole.gram[:3])
    assert np.isinf(found.costs[3:]).all()


@pytest.fixture(scope="module")
def dry(tmp_path_factory):
    """The loop on the pendulum with friction inside the FMU that the nominal has switched off."""
    folder = tmp_path_factory.mktemp("dry") / "report"
    data = records(parameters={**PENDULUM, "Fc": 0.05})
    report = closed(data, ("coulomb_friction", "viscous_friction", "dead_zone", "sensor_offset"), out=folder)
    return report, folder, data


def test_friction_inside_the_fmu_is_found_from_the_angle_alone(dry):
    report, folder, _ = dry
    assert report.verdict == "effects_found"
    assert [(one["name"], one["at"]) for one in report.data["effects"]] == [("coulomb_friction", "theta")]
    found = report.data["effects"][0]["parameters"]["Fc"]
    assert found["value"] == pytest.approx(0.05, rel=0.05)
    after = report.data["parameters"]["after"]
    for name, value in PENDULUM.items():
        assert after[name]["value"] == pytest.approx(value, rel=0.05)
    errors = [report.data["errors"][k]["simulation_error"]["validation"]["theta"]["rms"] for k in ("before", "after")]
    assert errors[0] > 8 * errors[1]
    assert errors[1] < 2e-3
    page = (folder / "report.html").read_text()
    assert "Residual of the free run" in page
    assert "The unmeasured force" not in page, "an FMU has no latent force"
    assert json.loads((folder / "report.json").read_text())["verdict"] == "effects_found"


@pytest.mark.slow
def test_the_repaired_fmu_is_one_package_that_repeats_the_report(dry, tmp_path):
    report, folder, data = dry
    target = tmp_path / "repaired.ssp"
    with pytest.raises(InputError, match=r"--trust nominal\.fmu"):
        api.export(folder, out=target)
    with trusting(folder):
        assert api.export(folder, out=target) == [target]
    run, system = data.validation[0], report.model
    x0 = np.array([0.4, 0.1])
    with pytest.raises(InputError, match=r"repaired\.ssp"):
        with trusting(folder):
            api.export(folder, out=tmp_path / "repaired.fmu")
    own = FmuSimulator(system, Runner(system.nominal, DT)).run(system.vector(), x0, run.u)[1]
    with make_plant(str(target), {}) as plant:
        y = [plant.reset(rng=np.random.default_rng(0), x0={"nominal.theta": 0.4, "nominal.omega": 0.1})]
        parts = system.exchanges
        assert plant.spec.sample_time == pytest.approx(DT / parts)
        y += [plant.step(one) for one in np.repeat(run.u[:-1], parts, axis=0)]
    np.testing.assert_allclose(np.array(y)[::parts], own, rtol=0, atol=1e-6)
    recorded = api.simulate(str(target), scenario="multisine", out=tmp_path / "again.csv")
    assert [channel.name for channel in recorded.spec.outputs] == ["theta"]


def test_the_package_states_its_units(dry, tmp_path):
    from fmpy.ssp.ssd import read_ssd  # held against the schema of SSP 1.0

    target = tmp_path / "repaired.ssp"
    with trusting(dry[1]):
        api.export(dry[1], out=target)
    described = read_ssd(str(target))
    units = {one.name: one for one in described.units}
    torque = units["N m"]
    assert (torque.kg, torque.m, torque.s, torque.rad) == (1, 2, -2, 0)
    assert (units["rad/s"].rad, units["rad/s"].s) == (1, -1)
    with opened(target) as package:
        found = {part.name: part.connectors for part in package.description.system.elements}
    for name, (kind, unit) in {"u": ("input", "N m"), "theta": ("output", "rad")}.items():
        assert (found["nominal"][name].kind, found["nominal"][name].unit.si) == (kind, unit)
    assert found["effects"]["rate.theta"].unit.si == "rad/s"
    assert all(one.unit is not None for connectors in found.values() for one in connectors.values())
    nominal = next(one for one in described.system.elements if one.name == "nominal")
    values = nominal.parameterBindings[0].parameterValues[0].parameters
    assert {one.name: one.unit for one in values}.items() >= {"J": "kg m^2", "mgl": "N m"}.items()


def test_a_package_around_an_fmu_in_degrees_leaves_the_conversion_to_the_units(tmp_path):
    turned = in_degrees(tmp_path / "degrees.fmu")
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)
    system = surround(fmu_system(turned, spec, {"J": 0.06}), [Placed(EFFECTS["force_bias"], "theta", {"F0": 0.1})])
    content = {
        "kind": "fmu",
        "spec": spec_to_dict(spec),
        "model": turned.name,
        "sha256": system.digest,
        "parameters": system.values(),
        "effects": [["force_bias", "theta"]],
    }
    package = write_package(content, tmp_path, tmp_path / "degrees.ssp")
    with zipfile.ZipFile(package) as archive:
        root = ElementTree.fromstring(archive.read("SystemStructure.ssd"))
    space = {"ssd": f"{SSP}SystemStructureDescription", "ssc": f"{SSP}SystemStructureCommon"}
    stated = {
        (part.get("name"), one.get("name")): one.find("ssc:Real", space).get("unit")
        for part in root.iterfind("ssd:System/ssd:Elements/ssd:Component", space)
        for one in part.iterfind("ssd:Connectors/ssd:Connector", space)
    }
    assert stated["nominal", "theta"] == "deg"
    assert stated["effects", "raw.theta"] == "rad"
    with zipfile.ZipFile(package) as archive:
        free = ElementTree.fromstring(archive.read("OpenEnds.ssd"))
    wires = free.findall("ssd:System/ssd:Connections/ssd:Connection", space)
    change = next(one for one in wires if one.get("endConnector") == "raw.theta").find(
        "ssc:LinearTransformation", space
    )
    assert float(change.get("factor")) == pytest.approx(np.pi / 180), "the FMU's degrees become the effects' radians"
    assert all(one.get("startElement") and one.get("endElement") for one in wires), "none is to the system itself"
    degree = root.find("ssd:Units/ssc:Unit[@name='deg']/ssc:BaseUnit", space)
    assert (degree.get("rad"), float(degree.get("factor"))) == ("1", pytest.approx(np.pi / 180))


@pytest.mark.slow
def test_with_nothing_hidden_nothing_is_missing():
    report = closed(records(), ("coulomb_friction", "input_delay", "sensor_offset"))
    assert report.verdict == "nothing_missing"
    assert report.data["effects"] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("around", "rivals", "name", "parameter", "value"),
    [
        (
            {"before": lambda u: late(u, 6)},
            ("input_delay", "viscous_friction", "dead_zone"),
            "input_delay",
            "tau",
            0.06,
        ),
        (
            {"before": lambda u: dead(u, 0.1)},
            ("input_delay", "coulomb_friction", "dead_zone"),
            "dead_zone",
            "width",
            0.1,
        ),
        (
            {"behind": lambda y: y + 0.05},
            ("sensor_offset", "linear_spring", "dead_zone"),
            "sensor_offset",
            "offset",
            0.05,
        ),
        (
            {"behind": lambda y: np.clip(y, -0.35, 0.35)},
            ("sensor_saturation", "coulomb_friction", "sensor_offset"),
            "sensor_saturation",
            "limit",
            0.35,
        ),
    ],
    ids=["delay", "dead zone", "offset", "saturation"],
)
def test_what_lies_before_and_behind_the_fmu_is_named(around, rivals, name, parameter, value):
    report = closed(records(n=600, **around), rivals)
    assert name in [one["name"] for one in report.data["effects"]], report.data["summary"]
    found = next(one for one in report.data["effects"] if one["name"] == name)["parameters"][parameter]["value"]
    assert found == pytest.approx(value, rel=0.1)


@pytest.mark.slow
def test_a_cubic_spring_inside_the_fmu_is_found():
    data = records("mass_spring", {**SPRING, "k3": 0.8}, size=0.5)
    report = closed(data, ("cubic_spring", "quadratic_spring", "coulomb_friction", "input_delay"), model="mass_spring")
    assert [(one["name"], one["at"]) for one in report.data["effects"]] == [("cubic_spring", "q")]
    assert report.data["effects"][0]["parameters"]["k3"]["value"] == pytest.approx(0.8, rel=0.05)


def test_the_parameters_that_are_named_are_the_ones_that_are_fitted():
    data = records()
    assert [p.name for p in nominal_fmu(mockup("pendulum"), data).parameters if not p.fixed] == ["J", "b", "mgl"]
    some = nominal_fmu(mockup("pendulum"), data, {"b": 0.03, "Fc": {"value": 0.01, "fixed": True}})
    assert [(p.name, p.value) for p in some.parameters if not p.fixed] == [("b", 0.03)]
    assert some.parameter("Fc").value == 0.01
    with pytest.raises(InputError, match="a real parameter of the FMU"):
        nominal_fmu(mockup("pendulum"), data, {"theta": 1e-3})
    with pytest.raises(InputError, match="positive"):
        nominal_fmu(mockup("pendulum"), data, {"Fc": 0.0})


def test_a_data_set_file_names_the_fmu_and_what_is_known_of_it(tmp_path, monkeypatch):
    from harness.data import write_trajectory

    for run in records(n=100).runs:
        write_trajectory(run.trajectory, tmp_path / f"{run.use}.csv")
    (tmp_path / "box.fmu").write_bytes(mockup("pendulum").read_bytes())
    head = "name = 'swing'\n[nominal]\nmodel = 'box.fmu'\n[nominal.parameters]\nb = { start = 0.03 }\nFc = 0.01\n"
    signals = "".join(
        f"[signals.{name}]\nrole = '{role}'\ncolumn = '{name} [{unit}]'\nunit = '{unit}'\n"
        for name, role, unit in (("u", "input", "N m"), ("theta", "output", "rad"))
    )
    runs = "".join(f"[[runs]]\nfile = '{use}.csv'\nuse = '{use}'\n" for use in ("estimation", "validation"))
    (tmp_path / "dataset.toml").write_text(head + "[time]\ncolumn = 'time [s]'\n" + signals + runs)
    seen = []
    monkeypatch.setattr("harness.diagnosis.close.close_loop", lambda *given, **options: seen.append(given))
    with pytest.raises(InputError, match=r"--trust box\.fmu"):
        api.close_loop(tmp_path / "dataset.toml", out=tmp_path / "report")
    with trusting(tmp_path / "box.fmu"):
        close_loop_file(tmp_path / "dataset.toml", out=tmp_path / "report")
    data, system = seen[0]
    assert [len(run) for run in data.estimation] == [100]
    assert [(one.name, one.value) for one in system.parameters if not one.fixed] == [("b", 0.03)]
    assert system.parameter("Fc").value == 0.01
    assert system.coordinates[0].position == "theta"
