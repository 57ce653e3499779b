"""FMUs of others as nominal models: parameters that hold from the initialisation on, and a report that comes back."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fmu_files import redescribed

from harness import registry
from harness.blackbox.effects import surround
from harness.blackbox.reader import fmu_system
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.command import main
from harness.comparison.reports import compare_reports
from harness.diagnosis.close import Figures
from harness.diagnosis.fmu.prepare import measured_states, nominal_fmu
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.errors import InputError
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Run, Trajectory
from plants.mockups import mockup

DT = 0.01
SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)


@pytest.fixture(scope="module")
def fixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pendulum as other tools export it: no parameter is tunable."""
    path = tmp_path_factory.mktemp("foreign") / "pendulum.fmu"
    return redescribed(path, lambda text: text.replace('variability="tunable"', 'variability="fixed"'))


def swung(path: Path, values: dict[str, float]) -> FloatArray:
    """Return the angle of a free run of 100 samples."""
    runner = Runner(fmu_system(path, SPEC, dict(values)), DT)
    first = runner.start(values, {"theta": 0.4})
    return np.concatenate([[first[0]], runner.plant.rollout(np.zeros((99, 1)))[:, 0]])


def test_parameters_that_are_fixed_from_the_initialisation_on_are_calibrated_by_name(fixed: Path) -> None:
    assert [one.name for one in fmu_system(fixed, SPEC).parameters] == [], "unasked, what an FMU fixes is left alone"
    named = fmu_system(fixed, SPEC, {"J": 0.06, "mgl": {"value": 1.1, "fixed": True}})
    assert [(one.name, one.value, one.fixed) for one in named.parameters] == [("J", 0.06, False), ("mgl", 1.1, True)]
    for values in ({"J": 0.06, "mgl": 1.1}, {"J": 0.09, "mgl": 0.7}):
        assert swung(fixed, values) == pytest.approx(swung(mockup("pendulum"), values), abs=1e-12)
    assert np.ptp(swung(fixed, {"J": 0.06}) - swung(fixed, {"J": 0.09})) > 0.1
    with pytest.raises(InputError, match=r"a real parameter of the FMU \(tunable are none\), got 'mass'"):
        fmu_system(fixed, SPEC, {"mass": 1.0})


SPEED = PlantSpec((Channel("u", "N m"),), (Channel("omega", "rad/s"),), DT)


def rewritten(path: Path, *changes: tuple[bytes, bytes]) -> Path:
    """Write the pendulum with these changes of its description."""

    def changed(text: str) -> str:
        for before, after in changes:
            assert before.decode() in text
            text = text.replace(before.decode(), after.decode())
        return text

    return redescribed(path, changed)


def test_a_measured_speed_tells_of_the_position_that_no_output_shows(tmp_path: Path) -> None:
    """As with tools that show what a sensor measures, and keep the states inside."""
    inside = (
        b'name="theta" valueReference="2" causality="output"',
        b'name="theta" valueReference="2" causality="local"',
    )
    listed = (b'<Unknown index="2" dependencies="" />', b"")
    found = fmu_system(rewritten(tmp_path / "inside.fmu", inside, listed), SPEED)
    assert [(one.name, one.position, one.rate, one.force_unit) for one in found.coordinates] == [
        ("theta", "theta", "omega", "N m")
    ]
    # an angle that does not move as the integral of the speed is not taken for it
    other = (b'valueReference="2" causality="local"', b'valueReference="3" causality="local"')
    assert fmu_system(rewritten(tmp_path / "other.fmu", inside, listed, other), SPEED).coordinates == ()


def test_an_output_that_shows_a_named_state_tells_where_it_begins(tmp_path: Path) -> None:
    path = rewritten(
        tmp_path / "alias.fmu",
        (b'valueReference="3" causality="output"', b'valueReference="3" causality="local"'),
        (b'<Unknown index="3" dependencies="" />', b'<Unknown index="14" dependencies="" />'),
        (
            b"</ModelVariables>",
            b'<ScalarVariable name="speed" valueReference="3" causality="output" variability="continuous">'
            b'<Real unit="rad/s" /></ScalarVariable></ModelVariables>',
        ),
    )
    system = fmu_system(path, PlantSpec((Channel("u", "N m"),), (Channel("speed", "rad/s"),), DT))
    assert (system.shown, [state.name for state in system.inner_states]) == ({"speed": "omega"}, ["theta", "omega"])
    t = np.linspace(0.0, 1.99, 200)
    record = Trajectory(t, np.zeros((200, 1)), np.cos(3 * t)[:, None], replace(SPEED, outputs=system.outputs))
    x, known = measured_states(system, FmuSimulator(system, Runner(system, DT)), record, system.vector())
    assert known == [False, True]
    assert x[0] == pytest.approx([0.0, 1.0], abs=0.02)


def test_dry_friction_is_told_more_often_than_the_data_are() -> None:
    """A force that jumps and is held for a sample of 50 ms is wrong by its own size where the motion turns."""
    parts, dt, x0 = 50, 0.05, np.array([0.4, 0.0])
    nominal = fmu_system(mockup("pendulum"), replace(SPEC, sample_time=dt))
    t = np.arange(200) * dt
    u = (0.6 * np.sin(2 * t) + 0.4 * np.sin(5.1 * t))[:, None]
    finely = np.repeat(u, parts, axis=0)[: (len(u) - 1) * parts + 1]
    inside = FmuSimulator(nominal, Runner(nominal, dt / parts)).run(nominal.vector({"Fc": 0.1}), x0, finely)[1][::parts]
    off = []
    for exchanges in (1, 8):
        friction = [Placed(builtin()["coulomb_friction"], "theta", {"Fc": 0.1})]
        made = surround(replace(nominal, exchanges=exchanges), friction, {"theta": {"v": 1.0, "F": 0.5}})
        y = FmuSimulator(made, Runner(made, dt)).run(made.vector(), x0, u)[1]
        off.append(float(np.abs(y - inside).max()))
    assert off[0] > 0.02
    assert off[1] < 0.15 * off[0]
    smooth = surround(replace(nominal, exchanges=8), [Placed(builtin()["viscous_friction"], "theta")])
    assert smooth.exchanges == 1, "what does not jump costs no more runs"


@pytest.mark.parametrize(("noise", "least", "most"), [(1e-1, 1, 1), (1e-3, 2, 16)])
def test_how_often_is_told_by_what_a_push_does_within_a_sample(noise: float, least: int, most: int) -> None:
    rng = np.random.default_rng(0)
    dt = 0.05
    spec = replace(SPEC, sample_time=dt)
    t = np.linspace(0.0, 199 * dt, 200)
    runs = []
    for use in ("estimation", "validation"):
        u = np.sum([0.3 * np.sin(f * t + rng.uniform(0, 6)) for f in (1.0, 2.3, 5.1)], axis=0)[:, None]
        with registry.create("plants", "fmu", path=mockup("pendulum"), sample_time=dt, outputs=["theta"]) as plant:
            y = np.vstack([plant.reset(rng=rng, x0={"theta": 0.4}), plant.rollout(u[:-1])])
        runs.append(Run(Trajectory(t, u, y + rng.normal(0, noise, y.shape), spec), use, use))
    data = Dataset(runs=tuple(runs), name="push", noise={"theta": noise})
    assert least <= nominal_fmu(mockup("pendulum"), data).exchanges <= most


def test_a_parameter_is_set_anew_for_every_run(fixed: Path) -> None:
    runner = Runner(fmu_system(fixed, SPEC, {"J": 0.06}), DT)
    ends = []
    for inertia in (0.06, 0.09, 0.06):
        runner.start({"J": inertia}, {"theta": 0.4})
        ends.append(float(runner.plant.rollout(np.zeros((40, 1)))[-1, 0]))
    assert ends[0] == ends[2] != ends[1]


def test_pictures_leave_a_process_as_pictures() -> None:
    drawn: list[int] = []

    def draw() -> dict[str, str]:
        drawn.append(1)
        return {"errors": "<svg/>"}

    figures = Figures(draw)  # a local function: nothing that it is drawn from can be sent
    assert pickle.loads(pickle.dumps(figures))() == figures() == {"errors": "<svg/>"}
    assert drawn == [1], "they are drawn once, when they are asked for"


@pytest.mark.slow
def test_the_loop_around_an_fmu_ends_with_its_report_from_the_command_line(
    fixed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a process of its own, whose report has to come back."""
    rng = np.random.default_rng(0)
    for name in ("est", "val"):
        t = np.arange(800) * DT
        u = sum(0.25 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.13, 0.31, 0.92))[:, None]
        options = {"sample_time": DT, "outputs": ["theta"], "parameters": {"J": 0.06}}
        with registry.create("plants", "fmu", path=fixed, **options) as plant:
            y = np.vstack([plant.reset(rng=rng, x0={"theta": 0.4}), plant.rollout(u[:-1])]) + rng.normal(
                0, 1e-3, (800, 1)
            )
        rows = "\n".join(f"{a:.2f},{b:.9g},{c:.9g}" for a, b, c in zip(t, u[:, 0], y[:, 0], strict=True))
        (tmp_path / f"{name}.csv").write_text(f"time [s],u [N m],theta [rad]\n{rows}\n")
    (tmp_path / "dataset.toml").write_text(
        f'name = "x"\n[nominal]\nmodel = "{fixed}"\n[nominal.parameters]\nJ = {{start = 0.1}}\n'
        '[signals.u]\nrole = "input"\n[signals.theta]\nrole = "output"\n'
        '[[runs]]\nfile = "est.csv"\n[[runs]]\nfile = "val.csv"\nuse = "validation"\n'
    )
    out = tmp_path / "report"
    with pytest.raises(SystemExit) as left:
        main(["close-loop", str(tmp_path / "dataset.toml"), "--model", str(fixed), "--out", str(out)])
    assert left.value.code == 0, capsys.readouterr().err
    assert compare_reports(out, out).differences == ()


def test_an_fmu_whose_symbols_were_asked_for_goes_to_another_process() -> None:
    """A report that names an FMU is made in a process of its own, and comes back from there."""
    system = fmu_system(mockup("pendulum"), SPEC)
    law = Placed(builtin()["load_dependent_friction"], "theta")
    before = surround(system, [law])  # it asks for the force of the inputs
    assert system.input_forces.shape == (1, 1)
    for one in (system, before):
        again = pickle.loads(pickle.dumps(one))
        assert (str(again), again.fingerprint) == (str(one), one.fingerprint)
        assert again.u.shape == (1, 1)
