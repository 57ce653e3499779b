"""An FMU without a scenario: its own experiment, whatever it shows, and rows up to where it ends."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from harness import api
from harness.command import main
from harness.data import read_trajectory
from harness.errors import InputError
from plants.fmu.as_is import run_as_is
from plants.fmu.plant import FmuPlant, describe
from plants.mockups import mockup

RNG = np.random.default_rng(0)


def changed(source: Path, target: Path, pattern: str, text: str) -> Path:
    """Write an FMU again with a changed description."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "modelDescription.xml":
                before = content.decode()
                after = re.sub(pattern, text, before, flags=re.DOTALL)
                assert after != before
                content = after.encode()
            new.writestr(name, content)
    return target


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", ["pendulum", "mass_spring", "two_tanks"])
def test_it_runs_as_fmpy_runs_it(model: str, fmi: int) -> None:
    path = mockup(model, fmi)
    found = run_as_is(path, isolated=False, stop_time=1.0, sample_time=0.02)
    names = [channel.name for channel in found.trajectory.spec.outputs]
    peer = fmpy.simulate_fmu(
        str(path), start_time=0.0, stop_time=1.0, output_interval=0.02, output=names, fmi_type="CoSimulation"
    )
    assert found.ended is None
    assert found.trajectory.y == pytest.approx(np.column_stack([peer[name] for name in names]), abs=1e-12)
    assert len(found.trajectory) == 51


def test_model_exchange_with_events(odd_fmu: Callable[..., Path]) -> None:
    path = odd_fmu("ball")
    found = run_as_is(path, kind="me", stop_time=1.0, sample_time=0.01, tolerance=1e-8, isolated=False)
    peer = fmpy.simulate_fmu(
        str(path), stop_time=1.0, output_interval=0.01, relative_tolerance=1e-8, fmi_type="ModelExchange", output=["h"]
    )
    rows = np.searchsorted(peer["time"], 0.01 * np.arange(101) + 1e-8) - 1
    height = found.trajectory.y[:, [c.name for c in found.trajectory.spec.outputs].index("h")]
    assert np.quantile(np.abs(height - peer["h"][rows]), 0.95) < 1e-4
    assert height.min() > -1e-3


def test_the_command_needs_nothing_but_the_file(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    out = tmp_path / "run.csv"
    assert "51 samples" in sysid("simulate", mockup("mass_spring"), "--stop", "0.5", "--step", "0.01", "-o", out).out
    assert len(out.read_text().splitlines()) == 52
    record = api.simulate(str(mockup("mass_spring")), start=1.0, stop=2.0, step=0.1, tolerance=1e-6)
    assert len(record) == 11


def test_where_the_fmu_suggests_nothing_it_is_said(tmp_path: Path) -> None:
    path = changed(mockup("mass_spring"), tmp_path / "bare.fmu", r"<DefaultExperiment[^>]*/>", "")
    notes: list[str] = []
    record = api.simulate(str(path), note=notes.append)
    assert (len(record), record.spec.sample_time) == (501, 0.002)
    assert any("no end: 1 s are run (--stop)" in text for text in notes)
    assert any("no step: 0.002 s" in text for text in notes)
    with pytest.raises(InputError, match=r"--option sample_time"):
        FmuPlant(path)


def test_without_outputs_states_and_locals_are_recorded(tmp_path: Path) -> None:
    path = changed(
        mockup("pendulum"), tmp_path / "closed.fmu", r'causality="output"|<Outputs>.*?</Outputs>',
        lambda m: 'causality="local"' if "causality" in m.group() else "",  # type: ignore[arg-type,return-value]
    )  # fmt: skip
    found = run_as_is(path, stop_time=0.1, sample_time=0.01, isolated=False)
    assert {"theta", "omega"} <= {channel.name for channel in found.trajectory.spec.outputs}
    assert any("declares no outputs" in text for text in found.notes)


def test_rows_up_to_an_early_end_are_kept(odd_fmu: Callable[..., Path], tmp_path: Path, capsys) -> None:
    path = odd_fmu("hostile")
    for mode, status in ((8, "terminated"), (1, "crashed")):
        found = run_as_is(path, stop_time=0.1, sample_time=0.01, parameters={"mode": mode, "when": 0.05}, timeout=5.0)
        assert len(found.trajectory) == 6
        assert found.ended is not None
        assert found.ended.status == status
        assert any("the run ends at t = 0.05 s of 0.1 s (6 of 11 samples are kept)" in text for text in found.notes)
    out = tmp_path / "run.csv"
    arguments = ["simulate", str(path), "--stop", "0.1", "--step", "0.01", "-O", "parameters.mode=8"]
    with pytest.raises(SystemExit):
        main([*arguments, "-O", "parameters.when=0.05", "-o", str(out)])
    assert "6 of 11 samples are kept" in capsys.readouterr().err
    assert len(out.read_text().splitlines()) == 7


def test_a_tolerance_that_dominates_is_said(odd_fmu: Callable[..., Path], tmp_path: Path) -> None:
    rough = changed(odd_fmu("ball"), tmp_path / "rough.fmu", r"<ModelVariables>",
                    '<DefaultExperiment stopTime="1.0" tolerance="0.05"/><ModelVariables>')  # fmt: skip
    notes = run_as_is(rough, kind="me", sample_time=0.1, isolated=False).notes
    assert any("--tolerance" in text for text in notes), notes
    (said,) = (text for text in notes if "--tolerance" in text)
    assert re.search(r"moves (h|v|height_mm) by \d", said), said


def test_a_step_that_nobody_suggests_is_a_multiple_of_the_one_inside(tmp_path: Path) -> None:
    path = changed(mockup("pendulum", 3), tmp_path / "inner.fmu", r' stepSize="[^"]*"', "")
    path = changed(path, tmp_path / "fixed.fmu", "<CoSimulation ", '<CoSimulation fixedInternalStepSize="0.03" ')
    found = run_as_is(path, stop_time=0.3, isolated=False)
    assert found.trajectory.spec.sample_time == pytest.approx(0.03)
    assert any("a multiple of the step inside it, 0.03 s" in text for text in found.notes)
    assert run_as_is(path, stop_time=30.0, isolated=False).trajectory.spec.sample_time == pytest.approx(0.06)


def test_archives_of_windows_tools(tmp_path: Path) -> None:
    odd = tmp_path / "odd.fmu"
    with zipfile.ZipFile(mockup("mass_spring")) as old, zipfile.ZipFile(odd, "w") as new:
        for name in old.namelist():
            new.writestr(name.replace("/", "\\") if name.startswith("binaries") else name, old.read(name))
        new.writestr("binaries\\win64/model.dll", b"MZ")
        new.writestr("binaries/aarch64-linux/model.so", b"ELF")
        new.writestr("extra/notes.txt", b"the same")
        with pytest.warns(UserWarning, match="Duplicate name"):
            new.writestr("extra/notes.txt", b"the same")  # listed twice, and the same
    assert describe(odd)["platforms"][:2] == ["aarch64-linux", "linux64"]
    assert "win64" in describe(odd)["platforms"]
    assert len(run_as_is(odd, stop_time=0.1, sample_time=0.01).trajectory) == 11


def test_what_is_no_fmu_needs_a_scenario() -> None:
    with pytest.raises(InputError, match="only an FMU or a system of them runs without one"):
        api.simulate("pendulum-ode")
    with pytest.raises(InputError, match="none of them with a scenario"):
        api.simulate("pendulum-ode", scenario="multisine", stop=3.0)
    with pytest.raises(InputError, match=r"end of the run: expected after the start, 2 s"):
        api.simulate(str(mockup("pendulum")), start=2.0, stop=1.0)


def test_a_step_that_fails_half_way_keeps_its_rows_and_fails(
    odd_fmu: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for mode, status in ((1, 2), (8, 0)):  # an error, and a wish of the FMU to end
        out = tmp_path / f"{mode}.csv"
        options = ["-O", f"parameters.mode={mode}", "-O", "parameters.when=0.05", "-o", str(out)]
        with pytest.raises(SystemExit) as ended:
            main(["simulate", str(odd_fmu("hostile")), "--stop", "0.1", "--step", "0.01", *options])
        assert ended.value.code == status
        assert len(out.read_text().splitlines()) == 7
        assert "6 of 11 samples are kept" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (r'stopTime="10"', 'stopTime="INF"', "for ever"),
        (r'name="omega"', 'name="theta"', "'theta': the second is 'theta#3'"),
    ],
)
def test_what_fmpy_runs_is_run_and_said(tmp_path: Path, old: str, new: str, says: str) -> None:
    notes: list[str] = []
    record = api.simulate(str(changed(mockup("pendulum"), tmp_path / "x.fmu", old, new)), step=0.1, note=notes.append)
    assert record.spec.ny == 2
    assert any(says in text for text in notes)


@pytest.mark.parametrize("name", ["startTime", "stopTime", "stepSize", "tolerance"])
def test_a_word_where_a_number_belongs_is_left_aside_and_said(tmp_path: Path, name: str) -> None:
    words = f'<DefaultExperiment {name}="soon" />'
    path = changed(mockup("pendulum"), tmp_path / "soon.fmu", r"<DefaultExperiment [^>]*/>", words)
    found = run_as_is(path, isolated=False, stop_time=0.1, sample_time=0.02)
    assert len(found.trajectory) == 6
    assert f"{name} of DefaultExperiment is no number and is left aside: 'soon'" in found.notes


def test_a_library_may_be_named_with_a_hyphen(tmp_path: Path) -> None:
    path = changed(mockup("pendulum"), tmp_path / "x.fmu", 'modelIdentifier="Pendulum"', 'modelIdentifier="Pen-dulum"')
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(tmp_path / "y.fmu", "w") as new:
        for name in old.namelist():
            new.writestr(name.replace("Pendulum.", "Pen-dulum."), old.read(name))
    assert len(api.simulate(str(tmp_path / "y.fmu"), stop=0.5, step=0.1)) == 6


def test_names_with_commas_and_quotes_are_quoted(tmp_path: Path) -> None:
    odd = changed(mockup("pendulum"), tmp_path / "odd.fmu", 'name="omega"', 'name="om,e&quot;ga"')
    record = api.simulate(str(odd), stop=0.1, step=0.05, out=tmp_path / "run.csv")
    assert read_trajectory(tmp_path / "run.csv", inputs=["u"]).spec.outputs[1].name == record.spec.outputs[1].name


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"start": "x"}, "start: option of the FMU pendulum.*values by name"),
        ({"timeout": "x"}, "timeout: option of the FMU pendulum.*expected a number"),
        ({"isolated": "x"}, "isolated: option of the FMU pendulum.*true or false"),
        ({"sample_time": "x"}, "sample_time: option of the FMU pendulum.*expected a number"),
        ({"start_time": []}, "start_time: option of the FMU pendulum.*expected a number"),
        ({"outputs": 1}, "outputs: option of the FMU pendulum.*a list of names"),
        ({"path": "other.fmu"}, "none of the name path"),
    ],
)
def test_options_of_another_type_are_refused_in_words(options: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        api.simulate(str(mockup("pendulum")), options=options)
