"""Runs held against references: where the tube lies, which violation comes first, which files are read."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from harness import agreement, api
from harness.cli.app import app
from harness.errors import InputError
from harness.vetting import Tube
from plants.mockups import mockup


def table(path: Path, t: np.ndarray, title: str = "time", **columns: np.ndarray) -> Path:
    head = ",".join([title, *(name.replace("__", " ") for name in columns)])
    np.savetxt(path, np.column_stack([t, *columns.values()]), delimiter=",", header=head, comments="", fmt="%.17g")
    return path


@pytest.mark.parametrize(
    ("text", "tube"),
    [
        ("0.01", Tube(0.01)),
        ("1e-3", Tube(1e-3)),
        ("2%", Tube(0.0, 0.02)),
        ("0.01 + 2%", Tube(0.01, 0.02)),
        ("1e+1@0.5", Tube(10.0, 0.0, 0.5)),
        ("@0.1", Tube(0.0, 0.0, 0.1)),
        ("0", Tube()),
    ],
)
def test_tubes_are_read(text: str, tube: Tube) -> None:
    assert Tube.read(text) == tube


@pytest.mark.parametrize("text", ["", "-1", "1%%", "a", "1@2%", "1@", "1+", "nan", "1@-2", "5 %x"])
def test_what_is_no_tube(text: str) -> None:
    with pytest.raises(InputError, match="tube"):
        Tube.read(text)


def test_a_tube_in_time_holds_a_jump_and_a_ramp() -> None:
    t, y = np.array([0.0, 1.0, 1.0, 2.0]), np.array([0.0, 0.0, 1.0, 1.0])  # a jump at 1 s
    at = np.array([0.5, 0.9, 0.94, 1.0, 1.06, 1.1, 1.5])
    low, high = Tube(0.1, 0.0, 0.06).limits(t, y, at)
    assert high.tolist() == pytest.approx([0.1, 0.1, 1.1, 1.1, 1.1, 1.1, 1.1])
    assert low.tolist() == pytest.approx([-0.1, -0.1, -0.1, -0.1, -0.1, 0.9, 0.9])
    low, high = Tube(0.1).limits(t, y, np.array([1.0]))  # without a width in time both values hold at the jump
    assert (low[0], high[0]) == pytest.approx((-0.1, 1.1))
    ramp = np.linspace(0.0, 2.0, 3)
    low, high = Tube(0.0, 0.0, 0.25).limits(ramp, 2 * ramp, np.array([1.0, 0.1]))
    assert (low[0], high[0]) == pytest.approx((1.5, 2.5))
    assert (low[1], high[1]) == pytest.approx((0.0, 0.7))


@settings(max_examples=40, deadline=None)
@given(
    y=st.lists(st.floats(-10, 10), min_size=2, max_size=12),
    width=st.floats(0.01, 5.0),
    late=st.floats(0.0, 3.0),
    share=st.floats(0.0, 1.0),
)
def test_a_run_within_the_stated_width_and_delay_stays_inside(
    y: list[float], width: float, late: float, share: float
) -> None:
    """Any run that is the reference, moved by less than the tube in value and in time, is inside; more is not."""
    t = np.arange(len(y), dtype=float)
    values = np.array(y)
    at = np.linspace(0.0, t[-1], 57)
    moved = np.interp(at - (2 * share - 1) * late, t, values)
    low, high = Tube(width, 0.0, late).limits(t, values, at)
    for off in (-0.999 * width, 0.0, 0.999 * width):
        assert np.all((moved + off >= low - 1e-9) & (moved + off <= high + 1e-9))
    assert np.all(values.max() + width >= high - 1e-9)
    assert np.all(values.min() - width <= low + 1e-9)


def test_the_first_violation_is_named(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 101)
    ref = table(tmp_path / "ref.csv", t, y=np.sin(t), z=np.cos(t))
    run = table(tmp_path / "run.csv", t, z=np.cos(t) + 0.02 * (t > 0.405), y=np.sin(t) + 0.05 * (t > 0.705))
    found = agreement(run, ref, tubes={"*": "0.01"})
    assert not found.passed
    assert found.first is not None
    assert found.first.name == "z"
    content = found.to_dict()
    assert content["first_violation"]["time"] == pytest.approx(0.41)
    assert "z leaves its tube at t = 0.41 s" in found.checks()[0].text
    assert "(59 of 101 samples outside)" not in found.checks()[0].text
    assert [row["passed"] for row in found.rows()] == [False, False]
    assert agreement(run, ref, tubes={"z": "0.021", "y": "0.051"}).passed
    assert "data:image/svg" in found.html()
    with pytest.raises(InputError, match=r"tube: expected one of .*y, z"):
        agreement(run, ref, tubes={"x": "0.01"})


def test_a_run_that_ends_early_lacks_a_channel_or_is_no_number(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 101)
    ref = table(tmp_path / "ref.csv", t, y=t, z=t)
    short = agreement(table(tmp_path / "short.csv", t[:50], y=t[:50], z=t[:50]), ref)
    assert [one.passed for one in short.channels] == [False, False]
    assert "covers 0 to 0.49 s" in short.channels[0].text
    lacking = agreement(table(tmp_path / "one.csv", t, y=t), ref)
    assert not lacking.passed
    assert lacking.lacking == {"z": "z: the run has no such channel"}
    broken = np.where(t > 0.5, np.nan, t)
    holes = agreement(table(tmp_path / "holes.csv", t, y=broken, z=t), ref)
    assert holes.first is not None
    assert holes.first.t[holes.first.first or 0] == pytest.approx(0.51)


def test_an_fmu_beside_its_own_run_and_beside_another(tmp_path: Path) -> None:
    run = api.simulate(str(mockup("pendulum")), stop=1.0, step=0.01, options={"start": {"theta": 0.5}})
    ref = table(tmp_path / "p_ref.csv", run.t, theta=run.y[:, 0], omega=run.y[:, 1])
    same = {"options": {"start": {"theta": 0.5}}}
    assert agreement(mockup("pendulum"), ref, tubes={"*": "0"}, **same).passed
    off = agreement(mockup("pendulum"), ref, options={"start": {"theta": 0.5}, "parameters": {"b": 0.1}})
    assert not off.passed
    # rows of the reference between the samples of the run, and a step from the option file beside it
    (tmp_path / "p_ref.opt").write_text("StartTime, 0.0\nStopTime, 1.0\nStepSize, 0.02\nRelTol, 1e-6\n")
    coarse = agreement(mockup("pendulum"), ref, **same)
    assert coarse.passed
    assert len(coarse.channels[0].t) == 51
    assert not coarse.notes


def test_inputs_of_cross_check_and_units_of_the_fmu(tmp_path: Path) -> None:
    t = np.linspace(0.0, 2.0, 41)
    push = 0.3 * np.sin(3 * t)
    table(tmp_path / "p_in.csv", t, u=push)
    fine = 1e-3 * np.arange(2001)
    from harness import registry

    with registry.create("plants", "fmu", path=mockup("pendulum"), sample_time=1e-3, outputs=["theta"]) as plant:
        u = np.interp(fine[:-1] + 5e-4, t, push)[:, None]
        y = np.vstack([plant.reset(rng=np.random.default_rng(0)), plant.rollout(u)])[:, 0]
    ref = table(tmp_path / "p_ref.csv", fine[::20], theta=y[::20])
    driven = agreement(mockup("pendulum"), ref, tubes={"theta": "0.5%"})  # finds p_in.csv beside it
    assert driven.passed, str(driven)
    (tmp_path / "p_in.csv").rename(tmp_path / "elsewhere.csv")
    assert not agreement(mockup("pendulum"), ref, tubes={"theta": "0.5%"}).passed
    assert agreement(mockup("pendulum"), ref, tubes={"theta": "0.5%"}, inputs=tmp_path / "elsewhere.csv").passed


def test_a_record_of_ours_brings_its_inputs_along(tmp_path: Path) -> None:
    record = tmp_path / "run.csv"
    api.simulate("pendulum-fmu", scenario="multisine", scenario_options={"duration": 2.0}, out=record)
    found = agreement(mockup("pendulum"), record, tubes={"*": "1e-9"})
    assert [one.name for one in found.channels if one.name in ("theta", "u")] == ["theta"]  # u drives
    assert next(one for one in found.channels if one.name == "theta").passed
    assert np.ptp(found.channels[0].y) > 0.01


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "two of numbers"),
        ("time,y\n0,1\n", "two of numbers"),
        ("time,y\n0,1\n1,2,3\n", "as many numbers"),
        ("time,y,y\n0,1,1\n1,2,2\n", "a name of its own"),
        ("time,y\n1,1\n0,2\n", "does not fall"),
        ("time,y\n0,1\n1,x\n", "as many numbers"),
    ],
)
def test_tables_that_cannot_be_read(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "ref.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        agreement(path, path)


def test_semicolons_truth_values_units_and_texts(tmp_path: Path) -> None:
    path = tmp_path / "ref.csv"
    path.write_text('time;"on, or off";theta [rad];word\n0;true;1.5;a\n1;false;2.5;b\n', encoding="utf-8-sig")
    found = agreement(path, path)
    assert [one.name for one in found.channels] == ["on, or off", "theta"]
    assert found.passed


def test_the_command(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 101)
    ref = table(tmp_path / "ref.csv", t, y=np.sin(t))
    run = table(tmp_path / "run.csv", t, y=np.sin(t) + 0.02 * (t > 0.405))
    page, junit = tmp_path / "page.html", tmp_path / "found.xml"
    asked = ["check", str(run), "--reference", str(ref), "--tube", "y=0.01"]
    done = CliRunner().invoke(app, [*asked, "-o", str(page), "--junit", str(junit)])
    assert done.exit_code == 1
    assert "leaves its tube at t = 0.41 s" in " ".join(done.output.split())
    case = next(ElementTree.parse(junit).iter("testcase"))
    assert case.get("name") == "tube y"
    assert "0.41 s" in (case.find("failure") or case[0]).get("message", "")
    assert page.is_file()
    done = CliRunner().invoke(app, [*asked[:-1], "y=0.03", "--json"])
    assert done.exit_code == 0
    assert json.loads(done.output[done.output.index("{") :])["passed"] is True
    refused = CliRunner().invoke(app, ["check", str(run), "--tube", "y=0.01"])
    assert isinstance(refused.exception, InputError)
