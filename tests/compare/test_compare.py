"""Models side by side, and what the data themselves show of a plant."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete, lfilter, tf2ss

from harness import api, registry
from harness.api.comparing import _names
from harness.comparison import compare, correlations, spectrum
from harness.comparison.uncertain import pole_rows, response_figure, transmission_zeros
from harness.errors import InputError
from harness.frequency import FrequencyResponse
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

DT = 0.05
SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), DT)
B, A = [0.0, 0.4, 0.1], [1.0, -1.3, 0.6]


def record(seed: int, n: int = 6000, noise: float = 0.05) -> Trajectory:
    """Return a record of a known second-order system."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=n)
    y = lfilter(B, A, u) + noise * rng.normal(size=n)
    return Trajectory(np.arange(n) * DT, u[:, None], y[:, None], SPEC)


def truth(frequency: np.ndarray) -> np.ndarray:
    z = np.exp(-2j * np.pi * frequency * DT)
    return np.polyval(B[::-1], z) / np.polyval(A[::-1], z)


def test_the_spectrum_is_that_of_the_system_within_its_band() -> None:
    found = spectrum([record(0), record(1)], segment=256)
    inside = slice(2, -1)
    exact = truth(found.frequency)
    off = np.abs(np.abs(found.response[:, 0, 0]) - np.abs(exact))[inside]
    band = found.deviation[inside, 0, 0] + 0.02 * np.abs(exact[inside])  # beside the leakage of a window
    assert np.mean(off < 2 * band) > 0.93
    assert found.coherence[inside].min() > 0.7
    assert found.etfe is not None
    assert np.median(np.abs(found.etfe[:, 0, 0] / truth(found.etfe_frequency))) == pytest.approx(1.0, abs=0.05)


@given(frequency=st.floats(0.6, 1.5), damping=st.floats(0.08, 0.3), held=st.integers(1, 6), seed=st.integers(0, 10**6))
@settings(max_examples=6)
def test_a_resonance_keeps_its_height_whatever_the_excitation(
    frequency: float, damping: float, held: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    n, pole = 4000, 2 * np.pi * frequency
    discrete = cont2discrete(([pole**2], [1.0, 2 * damping * pole, pole**2]), DT)
    b, a = np.atleast_1d(np.squeeze(discrete[0])), discrete[1]
    u = np.repeat(rng.choice([-1.0, 1.0], n // held + 1), held)[:n]
    y = lfilter(b, a, u)
    y = y + 0.02 * y.std() * rng.standard_normal(n)
    found = spectrum([Trajectory(DT * np.arange(n), u[:, None], y[:, None], SPEC)])
    f = found.frequency[1:]
    z = np.exp(2j * np.pi * f * DT)
    exact = np.polyval(b, z) / np.polyval(a, z)
    off = np.abs(found.response[1:, 0, 0] - exact) / (np.sqrt(2) * found.deviation[1:, 0, 0])
    at = int(np.argmax(np.abs(exact)))
    assert off[at] < 4.5
    assert np.quantile(off[f < 2 * frequency], 0.9) < 3.0  # of complex errors 1.5 by chance, beside the bias
    assert abs(abs(found.response[1 + at, 0, 0]) / abs(exact[at]) - 1) < 0.15


def test_bands_are_as_wide_as_estimates_scatter() -> None:
    many = [spectrum([record(seed, 3000, 1.0)], segment=128) for seed in range(40)]
    sizes = np.array([np.abs(one.response[:, 0, 0]) for one in many])
    told = np.mean([one.deviation[:, 0, 0] for one in many], axis=0)
    ratio = (sizes.std(axis=0) / told)[3:-3]
    assert 0.8 < np.median(ratio) < 1.25


def test_several_inputs_share_the_coherence_and_seams_are_not_crossed() -> None:
    rng = np.random.default_rng(2)
    spec = PlantSpec((Channel("a"), Channel("b")), (Channel("y"),), DT)
    pieces = []
    for jump in (0.0, 1000.0):  # a step between two records would fill every bin
        u = rng.normal(size=(4000, 2))
        y = 2.0 * u[:, 0] - 3.0 * u[:, 1] + jump
        pieces.append(Trajectory(np.arange(4000) * DT, u, y[:, None], spec))
    found = spectrum(pieces, segment=128)
    assert np.abs(found.response[:, 0] - [2.0, -3.0]).max() < 1e-6
    assert found.coherence.min() > 1 - 1e-9


@pytest.mark.parametrize("segment", [None, 256])
@pytest.mark.parametrize(("digits", "noise"), [(None, 0.0), (None, 0.01), (3, 1e-3)])
@pytest.mark.parametrize("whole", [True, False], ids=["whole periods", "leaking"])
def test_beyond_the_lines_of_a_multisine_nothing_is_told_whatever_leaks_or_is_rounded(
    segment: int | None, digits: int | None, noise: float, whole: bool
) -> None:
    rng, n = np.random.default_rng(4), 4000
    lines = np.arange(8, n // 40, 8) / n + (0.0 if whole else 0.4 / n)
    u = np.cos(2 * np.pi * lines * np.arange(n)[:, None] + rng.uniform(0, 2 * np.pi, len(lines))).sum(axis=1)
    y = lfilter(B, A, u)
    y += noise * y.std() * rng.normal(size=n)
    if digits is not None:
        u, y = np.round(u, digits), np.round(y, digits)
    found = spectrum([Trajectory(DT * np.arange(n), u[:, None], y[:, None], SPEC)], segment=segment)
    apart = np.abs(found.frequency[1:, None] - lines / DT).min(axis=1) * (segment or n) * DT  # in lines
    f, g, spread = found.frequency[1:], found.response[1:, 0, 0], np.sqrt(2) * found.deviation[1:, 0, 0]
    dark = (f > lines.max() / DT) & (apart > (3.0 if segment else 8.0))  # a lobe; half the narrowest window
    assert dark.sum() > 50
    assert np.isnan(g[dark]).all()
    assert np.isinf(spread[dark]).all()
    assert (found.coherence[1:, 0][dark] == 0).all()
    near = apart < 0.51
    assert np.isfinite(spread[near]).all()
    assert (np.abs(g - truth(f)) < 3 * spread + 0.05 * np.abs(truth(f)))[near].all()
    assert f"u has no power at {np.isnan(g).sum()} of {len(f)} frequencies" in found.unexcited()
    phase = found.plot().axes[1].lines[0].get_ydata()
    assert np.array_equal(np.isnan(phase), np.isnan(g))
    assert not np.isin(found.etfe_frequency, f[dark]).any() or segment
    assert len(FrequencyResponse.of_spectrum(found).frequency) == np.isfinite(g).sum()


@pytest.mark.parametrize("segment", [None, 256])
@pytest.mark.parametrize("held", [10, 200])
def test_a_staircase_on_a_grid_of_levels_excites_all_but_the_zeros_of_its_hold(segment: int | None, held: int) -> None:
    rng, n = np.random.default_rng(5), 4000
    u = np.repeat(rng.integers(-3, 4, n // held) * 1.0, held)
    y = lfilter(B, A, u)
    y += 1e-3 * y.std() * rng.normal(size=n)
    found = spectrum([Trajectory(DT * np.arange(n), u[:, None], y[:, None], SPEC)], segment=segment)
    dark = found.frequency[np.isnan(found.response[:, 0, 0])] * DT * held
    assert len(dark) < 0.2 * len(found.frequency)
    assert (np.abs(dark - dark.round()) < 0.03 * min(held, 10)).all()
    inside = np.isfinite(found.response[:, 0, 0]) & (found.frequency > found.frequency[2])
    exact = truth(found.frequency[inside])
    off, spread = np.abs(found.response[inside, 0, 0] - exact), np.sqrt(2) * found.deviation[inside, 0, 0]
    assert np.mean(off < 3 * spread + 0.02 * np.abs(exact)) > 0.95


def test_a_band_that_holds_zero_ends_near_the_smallest_size_and_data_may_be_grey() -> None:
    found = spectrum([record(0, 3000, 1.0)])
    axis = found.plot("#777777").axes[0]
    assert {line.get_color() for line in axis.lines} == {"#777777"}
    assert axis.get_legend().get_texts()[0].get_text() == f"{SPEC.outputs[0]} / {SPEC.inputs[0]}"
    lowest = axis.collections[0].get_paths()[0].vertices[:, 1].min()
    smallest = np.abs(found.response[1:, 0, 0]).min()
    assert 0.29 * smallest < lowest <= smallest


def test_what_cannot_be_a_spectrum_is_refused() -> None:
    with pytest.raises(InputError, match="too short"):
        spectrum([record(0, 100)], segment=64)
    still = record(0)
    with pytest.raises(InputError, match="never moves"):
        spectrum([Trajectory(still.t, 0 * still.u, still.y, SPEC)])
    with pytest.raises(InputError, match="a record with an input"):
        spectrum([Trajectory(still.t, still.u[:, :0], still.y, PlantSpec((), SPEC.outputs, DT))])


def test_white_residuals_are_called_so_as_often_as_they_should() -> None:
    rng = np.random.default_rng(3)
    found = [
        correlations(rng.normal(size=800), lfilter([1], [1, -0.9], rng.normal(size=(800, 1)), axis=0))
        for _ in range(200)
    ]
    assert np.mean([one.white for one in found]) > 0.9
    assert np.mean([one.independent for one in found]) > 0.85
    coloured = correlations(lfilter([1], [1, -0.5], rng.normal(size=800)), rng.normal(size=(800, 1)))
    assert not coloured.white


@pytest.mark.parametrize("pole", [0.0, 0.5])
def test_a_fit_and_a_comparison_on_its_record_agree_on_white_residuals(pole: float) -> None:
    rng = np.random.default_rng(4)
    told = []
    for _ in range(5):
        u, noise = rng.normal(size=600), lfilter([1.0], [1.0, -pole], rng.normal(size=600))
        y = lfilter([0.0, 0.5], [1.0, -0.8], u) + 0.3 * noise
        own = Trajectory(np.arange(600) * DT, u[:, None], y[:, None], SPEC)
        model = registry.create("identifiers", "prediction-error", structure="oe", order=1).fit([own], rng=rng)
        row = compare({"oe": model}, Dataset("own", (Run(own),))).rows()[0]
        told.append((row["white"], "correlated" not in model.notes["estimate"]["method"]))
    assert all(one == other for one, other in told)
    assert sum(one for one, _ in told) == (5 if pole == 0.0 else 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with data and two stored models, one of them too small."""
    where = tmp_path_factory.mktemp("compared")
    one = record(4, 2000)
    rows = zip(one.t.tolist(), one.u[:, 0].tolist(), one.y[:, 0].tolist(), strict=True)
    (where / "run.csv").write_text("time [s],u [V],y [m]\n" + "".join(f"{t!r},{u!r},{y!r}\n" for t, u, y in rows))
    (where / "dataset.toml").write_text(
        'name = "second order"\n[signals.u]\nrole = "input"\n[signals.y]\nrole = "output"\n'
        '[[runs]]\nfile = "run.csv"\nrows = [0, 1500]\n'
        '[[runs]]\nfile = "run.csv"\nrows = [1500, 2000]\nuse = "validation"\n'
    )
    for order in (1, 2):
        api.identify(where / "dataset.toml", identifier="arx", options={"order": order}, out=where / f"arx{order}.json")
    return where


def test_the_better_model_is_seen(folder: Path, sysid: Callable[..., Any]) -> None:
    page = folder / "page.html"
    files = [str(folder / name) for name in ("arx1.json", "arx2.json", "dataset.toml")]
    said = sysid("compare", *files, "-o", page, "--json").out
    rows = {(row["model"], row["use"]): row for row in json.loads(said.rpartition("]")[0] + "]")}
    assert rows["arx2", "validation"]["fit_free_run"] > 90 > rows["arx1", "validation"]["fit_free_run"]
    assert not rows["arx1", "validation"]["independent"]
    assert rows["arx2", "validation"]["independent"]
    text = page.read_text()
    assert text.count("data:image/svg+xml") == 6  # motion over time, residuals, Bode, step and impulse responses, poles
    assert "is determined by its data: " in text
    assert "modulus of the pole" in text
    assert "\N{PLUS-MINUS SIGN}" in text
    assert "<title>arx1, arx2</title>" in text


def test_models_are_called_by_what_tells_their_paths_apart_or_by_name(folder: Path) -> None:
    assert _names(["/a/monday/fit/model.json", "/a/tuesday/fit/model.json"]) == ["monday", "tuesday"]
    assert _names(["mon/model.json", "mon/b.json", "tue/model.json"]) == ["mon/model", "b", "tue/model"]
    assert _names(["fits/arx.json"]) == ["arx"]
    assert _names(["a.json", "a.json"]) == ["a.json", "a.json"]
    fitted, data = api.load_model(folder / "arx1.json"), folder / "dataset.toml"
    assert _names([fitted, "a.json"]) == ["model 1", "a"]
    named = api.compare({"first": fitted, "second": folder / "arx2.json"}, data).rows()
    assert {row["model"] for row in named} == {"first", "second"}
    for nothing, got in (([], "none"), ([3], "int")):
        with pytest.raises(InputError, match=got):
            api.compare(nothing, data)


def test_poles_have_the_digits_that_their_interval_leaves(folder: Path) -> None:
    model = api.load_model(folder / "arx2.json").model
    for _, modulus, _, _ in pole_rows("arx2", model):
        value, half = modulus.split(" \N{PLUS-MINUS SIGN} ")
        assert float(half) > 0
        assert 0.0099 < 10 ** -len(value.partition(".")[2]) / float(half) < 0.101


def test_a_model_of_other_signals_or_of_python_is_refused(folder: Path, sysid: Callable[..., Any]) -> None:
    stored = json.loads((folder / "arx1.json").read_text())
    (folder / "odd.json").write_text(json.dumps({**stored, "model": "mine.py:evil"}))
    with pytest.raises(InputError, match="a file that runs code"):
        api.compare([folder / "odd.json"], folder / "dataset.toml")
    (folder / "none.json").write_text("{}")
    with pytest.raises(InputError, match="not a model"):
        api.compare([folder / "none.json"], folder / "dataset.toml")
    assert "MODEL... DATASET" in sysid("compare", folder / "arx1.json", status=2).err


def test_spectrum_on_the_command_line(folder: Path, sysid: Callable[..., Any]) -> None:
    assert "coherence" in sysid("spectrum", folder / "dataset.toml", "--segment", "64", "-o", folder / "bode.svg").out
    assert (folder / "bode.svg").read_text().startswith("<?xml")


def test_the_command_line_says_where_an_input_has_no_power(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    n = 2000
    u = np.sin(2 * np.pi * 0.01 * np.arange(n)) + np.sin(2 * np.pi * 0.0201 * np.arange(n))
    rows = np.column_stack([DT * np.arange(n), u, lfilter(B, A, u)])
    np.savetxt(tmp_path / "log.csv", rows, fmt="%.6g", delimiter=",", header="time [s],u [V],y [m]", comments="")
    asked = ("spectrum", tmp_path / "log.csv", "--input", "u", "--output", "y")
    assert "u has no power at" in sysid(*asked).out
    told = json.loads(sysid(*asked, "--json").out)
    assert told[-1]["magnitude"] is None
    assert told[-1]["deviation"] is None
    assert told[-1]["coherence"] == 0


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-0.9, 0.9), min_size=1, max_size=4), st.lists(st.floats(-0.9, 0.9), min_size=4, max_size=4))
def test_zeros_of_a_model_are_the_roots_of_its_numerator(zeros: list[float], poles: list[float]) -> None:
    apart = {round(value, 2) for value in (*zeros, *poles)}
    if len(apart) < len(zeros) + len(poles):
        return  # what cancels, or lies twice, is found only roughly
    numerator, denominator = np.poly(np.round(zeros, 2)), np.poly(np.round(poles, 2))
    model = tf2ss(numerator, denominator)
    found = transmission_zeros(*model)
    assert len(found) == len(zeros)
    assert np.allclose(np.sort_complex(found), np.sort_complex(np.round(zeros, 2) + 0j), atol=2e-3)


def test_the_page_shows_every_model_over_time_with_what_it_may_miss_by() -> None:
    data = Dataset("two", (Run(record(1), "estimation"), Run(record(2), "validation")))
    model = registry.create("identifiers", "arx", order=2).fit(data.estimation, rng=np.random.default_rng(0))
    page = compare({"arx": model}, data).html()
    assert all(f'alt="{what}"' in page or what in page for what in ("measured and simulated", "poles and zeros"))


def test_pulses_are_drawn_as_the_model_answers_them_in_the_units_of_the_data() -> None:
    model = registry.create("identifiers", "arx", order=2).fit([record(1)], rng=np.random.default_rng(0))
    (axis,) = response_figure({"arx": model}, {"y": "mm"}, "impulse").axes
    drawn = axis.lines[0].get_ydata()
    assert np.allclose(drawn, 1e3 * model.impulse_response(len(drawn))[:, 0, 0])
    assert "after a unit pulse of u" in axis.get_title()
    assert len(axis.collections) == 1, "the band"
    assert 'alt="frequency response"' in spectrum([record(1)])._repr_html_(), "a notebook shows it"


def test_a_spectrum_is_told_in_the_units_of_the_log(tmp_path: Path) -> None:
    u = np.random.default_rng(5).normal(size=2000)
    table = {"time [s]": DT * np.arange(2000), "u [mV]": 1e3 * u, "y [deg]": np.degrees(0.3 * u)}
    found = api.spectrum(table, input="u", output="y", out=tmp_path / "bode.svg")
    assert np.abs(found.response).max() == pytest.approx(0.3, rel=1e-3)  # rad/V, as models have it
    told = [float(row["magnitude"]) for row in found.rows()]
    assert told == pytest.approx([np.degrees(0.3) / 1e3] * len(told), rel=1e-3)
    assert found.gains() == "y [deg] / u [mV]"
    assert found.as_recorded(found.recorded).etfe == pytest.approx(found.etfe * np.degrees(1.0) / 1e3)
