"""FMUs of others as nominal models: parameters that hold from the initialisation on, and a report that comes back."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from harness import registry
from harness.blackbox.reader import fmu_system
from harness.blackbox.runner import Runner
from harness.command import main
from harness.comparison.reports import compare_reports
from harness.diagnosis.close import Figures
from harness.errors import InputError
from harness.signals import Channel, FloatArray, PlantSpec
from plants.mockups import mockup

DT = 0.01
SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)


@pytest.fixture(scope="module")
def fixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pendulum as other tools export it: no parameter is tunable."""
    path = tmp_path_factory.mktemp("foreign") / "pendulum.fmu"
    with zipfile.ZipFile(mockup("pendulum")) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            text = old.read(entry)
            if entry.filename == "modelDescription.xml":
                assert b'variability="tunable"' in text
                text = text.replace(b'variability="tunable"', b'variability="fixed"')
            new.writestr(entry, text)
    return path


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
