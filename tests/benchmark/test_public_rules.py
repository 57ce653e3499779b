"""The rules of public sets: which samples are read for what, and what a figure is."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from harness import registry
from harness.benchmark.public.choices import read_choices
from harness.benchmark.public.published import published
from harness.benchmark.public.reading import READERS, PublicSplit, downloaded, found_in, read
from harness.benchmark.public.rules import OFFICIAL, RULES
from harness.benchmark.public.scores import figure, horizon_errors, simulated, window_rmse
from harness.benchmark.public.tables import cited
from harness.errors import InputError
from harness.signals import Channel, PlantSpec, Trajectory

SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)


def counted(length: int, start: float = 0.0) -> np.ndarray:
    """Return numbers that tell the row they came from."""
    return start + np.arange(length, dtype=float)


def of(tmp_path: Path, id: str) -> PublicSplit:
    """Return a set from the folder that a test has filled."""
    place = found_in(RULES[id], tmp_path)
    assert place is not None
    return read(RULES[id], place)


def ends(record: Trajectory) -> tuple[float, float]:
    """Return the first and last output."""
    return float(record.y[0, 0]), float(record.y[-1, 0])


@pytest.fixture
def folder(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    (tmp_path / RULES[request.param].folder).mkdir()
    return tmp_path


def test_windows_and_units_are_those_of_the_official_loader_of_june_2026() -> None:
    found = {id: (rule.window, rule.unit, rule.scale) for id, rule in RULES.items() if rule.rules_of == OFFICIAL}
    assert found == {
        "silverbox": (50, "mV", 1e3),
        "wiener-hammerstein": (50, "mV", 1e3),
        "cascaded-tanks": (50, "V", 1.0),
        "coupled-drives": (10, "ticks/s", 1.0),
        "emps": (20, "mm", 1e3),
        "parallel-wiener-hammerstein": (50, "mV", 1e3),
        "f16": (50, "m/s^2", 1.0),
        "fine-steering-mirror": (100, "um", 1e6),
        "nano-drone": (1, "m, m/s, rad, rad/s", 1.0),
    }
    assert {id: rule.old_window for id, rule in RULES.items() if rule.old_window} == {
        "cascaded-tanks": 5,
        "coupled-drives": 4,
    }
    assert all(rule.download.startswith("https://") and rule.citation for rule in RULES.values())
    assert set(READERS) >= {id for id, rule in RULES.items() if rule.rules_of == OFFICIAL}


@pytest.mark.parametrize("folder", ["silverbox"], indirect=True)
def test_silverbox_is_cut_as_the_loader_cuts_it(folder: Path) -> None:
    rows = counted(131072)[None]
    savemat(folder / "silverbox" / "SNLS80mV.mat", {"V1": -rows, "V2": rows})
    split = of(folder, "silverbox")
    assert [ends(one) for one in split.train] == [(40650, 105711)]
    assert [ends(group[0]) for group in split.tests] == [(105712, 127399), (100, 40574), (100, 32099)]
    assert float(split.train[0].u[0, 0]) == -40650


@pytest.mark.parametrize("folder", ["wiener-hammerstein"], indirect=True)
def test_wiener_hammerstein_is_cut_as_the_loader_cuts_it(folder: Path) -> None:
    rows = counted(188000)[:, None]
    savemat(folder / "wiener_hammerstein" / "WienerHammerBenchMark.mat", {"uBenchMark": -rows, "yBenchMark": rows})
    split = of(folder, "wiener-hammerstein")
    assert ends(split.train[0]) == (5200, 105199)
    assert ends(split.tests[0][0]) == (105200, 183999)


@pytest.mark.parametrize("folder", ["cascaded-tanks"], indirect=True)
def test_tanks_learn_from_the_whole_first_part(folder: Path) -> None:
    table = np.column_stack([counted(8, 100.0 * k) for k in range(4)])
    np.savetxt(folder / "cascaded_tanks" / "dataBenchmark.csv", table, delimiter=",", header="uEst,uVal,yEst,yVal,Ts",
               comments="")  # fmt: skip
    split = of(folder, "cascaded-tanks")
    assert (ends(split.train[0]), ends(split.tests[0][0])) == ((200, 207), (300, 307))
    assert float(split.tests[0][0].u[0, 0]) == 100
    assert split.origin == "files in cascaded_tanks"
    (folder / "cascaded_tanks" / "origin.txt").write_text("a copy\nby somebody\n")
    assert of(folder, "cascaded-tanks").origin == "a copy by somebody"


@pytest.mark.parametrize("folder", ["coupled-drives"], indirect=True)
def test_drives_learn_from_400_samples_of_both_uniform_records(folder: Path) -> None:
    names = ("u11", "u12", "z11", "z12")
    savemat(
        folder / "coupled_drives" / "DATAUNIF.MAT", {n: counted(500, 1e3 * k)[:, None] for k, n in enumerate(names)}
    )
    split = of(folder, "coupled-drives")
    assert [ends(one) for one in split.train] == [(2000, 2399), (3000, 3399)]
    assert [ends(group[0]) for group in split.tests] == [(2400, 2499), (3400, 3499)]


@pytest.mark.parametrize("folder", ["emps"], indirect=True)
def test_emps_is_tested_on_the_force_pulses(folder: Path) -> None:
    for k, name in enumerate(("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat")):
        savemat(folder / "emps" / name, {n: counted(30, 100.0 * k)[:, None] for n in ("vir", "qm", "qg", "t")})
    split = of(folder, "emps")
    assert (ends(split.train[0]), ends(split.tests[0][0])) == ((0, 29), (100, 129))


@pytest.mark.parametrize("folder", ["parallel-wiener-hammerstein"], indirect=True)
def test_periods_follow_each_other(folder: Path) -> None:
    def data(realisations: int) -> np.ndarray:
        n, p, r, a = np.meshgrid(np.arange(6), np.arange(2), np.arange(realisations), np.arange(5), indexing="ij")
        return 1000.0 * a + 100.0 * r + 10.0 * p + n

    whole = {"uEst": data(3), "yEst": data(3), "uVal": data(1), "yVal": data(1)}
    savemat(folder / "parallel_wiener_hammerstein" / "ParWHData.mat", whole)
    split = of(folder, "parallel-wiener-hammerstein")
    assert len(split.train) == 15
    assert split.train[1].y[:, 0].tolist() == [1000, 1001, 1002, 1003, 1004, 1005, 1010, 1011, 1012, 1013, 1014, 1015]
    assert [ends(group[0]) for group in split.tests] == [(1000.0 * a, 1000.0 * a + 15) for a in range(5)]


@pytest.mark.parametrize("folder", ["f16"], indirect=True)
def test_f16_is_tested_on_its_validation_files(folder: Path) -> None:
    place = folder / "f16" / "BenchmarkData"
    place.mkdir()
    names = [f"F16Data_FullMSine_Level{k}" for k in (1, 3)] + [f"F16Data_{k}_Validation" for k in range(6)]
    for k, name in enumerate([*names, "F16Data_SpecialOddMSine_Level1"]):
        rows = counted(9, 100.0 * k)
        savemat(place / f"{name}.mat", {"Force": rows[None], "Acceleration": np.stack([rows, -rows, 2 * rows])})
    split = of(folder, "f16")
    assert [ends(one) for one in split.train] == [(0, 8), (100, 108)]
    assert [ends(group[0]) for group in split.tests] == [(100.0 * k, 100.0 * k + 8) for k in range(2, 8)]


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("folder", ["fine-steering-mirror"], indirect=True)
def test_the_mirror_has_a_record_for_each_realisation_and_period(folder: Path, packed: bool) -> None:
    def data(level: int, realisations: int) -> np.ndarray:
        n, c, r, p = np.meshgrid(np.arange(4), np.arange(3), np.arange(realisations), np.arange(2), indexing="ij")
        return 1.0 * level + 10.0 * r + 5.0 * p + 0.5 * c + 0.1 * n

    place = folder / "fine_steering_mirror"
    arrays = {
        f"{channel}_{level}mV_{use}": data(level, count)
        for channel in "uy"
        for level in (100, 200, 300)
        for use, count in (("train", 6), ("test", 3))
    }
    if packed:
        np.savez(place / "combined_data.npz", **arrays)
    else:
        for name, array in arrays.items():
            np.save(place / f"{name}.npy", array)
    split = of(folder, "fine-steering-mirror")
    assert (len(split.train), [len(group) for group in split.tests]) == (36, [6, 6, 6])
    # realisations last, so that a validation part of whole records holds every amplitude
    assert {int(one.y[0, 0]) // 100 for one in split.train[-6:]} == {1, 2, 3}
    assert [float(one.y[0, 2]) for one in split.tests[1]] == [201.0, 206.0, 211.0, 216.0, 221.0, 226.0]


@pytest.mark.parametrize("folder", ["nano-drone"], indirect=True)
def test_the_drone_is_tested_on_its_melon_flights(folder: Path) -> None:
    outputs = [channel.name for channel in RULES["nano-drone"].spec.outputs]
    header = ",".join(["t", *(channel.name for channel in RULES["nano-drone"].spec.inputs), *outputs])
    for use, motions, runs in (("train", ("square", "random", "chirp"), 4), ("test", ("melon",), 3)):
        (folder / "nano_drone" / use).mkdir()
        for motion in motions:
            for run in range(1, runs + 1):
                path = folder / "nano_drone" / use / f"{motion}_20251017_run{run}.csv"
                np.savetxt(path, run + np.zeros((5, 18)), delimiter=",", header=header, comments="")
    split = of(folder, "nano-drone")
    assert (len(split.train), [len(group) for group in split.tests]) == (12, [3, 3, 3, 3])
    assert split.tests[0][2].y[0, 12] == 3


@pytest.mark.parametrize("kind", ["mat", "csv"])
@pytest.mark.parametrize("folder", ["noisy-wiener-hammerstein"], indirect=True)
def test_every_realisation_with_process_noise_is_a_record_and_the_combined_ones_come_last(
    folder: Path, kind: str
) -> None:
    place = folder / "noisy_wiener_hammerstein"
    counts = {"WH_CombinedZeroMultisineSinesweep": 1, "WH_SineInput_meas": 3, "WH_TestDataset": 2}
    for k, (name, count) in enumerate(counts.items()):
        parts = [counted(5)[:, None] + 100.0 * k + 10.0 * np.arange(count) + 1000.0 * part for part in range(3)]
        if kind == "mat":
            fields = [(field, "O") for field in ("r", "u", "y", "fs")]
            whole = np.array([[(*parts, np.array([[78125.0]]))]], dtype=fields)
            savemat(place / f"{name}.mat", {"dataMeas": whole})
        else:
            empty = "," * count
            rows = [",".join(f"{value:g}" for value in row) + ",," for row in np.hstack(parts)]
            title = f'"r"{empty}"u"{empty}"y"{empty}"fs",'
            (place / f"{name}.csv").write_text("\n".join([title, *rows]) + "\n")
    split = of(folder, "noisy-wiener-hammerstein")
    assert [ends(one) for one in split.train] == [(2100, 2104), (2110, 2114), (2120, 2124), (2000, 2004)]
    assert [[ends(one) for one in group] for group in split.tests] == [[(2200, 2204), (2210, 2214)]]
    assert float(split.train[1].u[0, 0]) == 1110


def test_a_file_of_another_kind_is_refused_with_what_to_get(tmp_path: Path) -> None:
    (tmp_path / "silverbox").mkdir()
    savemat(tmp_path / "silverbox" / "SNLS80mV.mat", {"V1": np.zeros((1, 5))})
    with pytest.raises(InputError, match=r"KeyError.*nonlinearbenchmark.org"):
        of(tmp_path, "silverbox")
    savemat(tmp_path / "silverbox" / "SNLS80mV.mat", {"V1": np.zeros((1, 5)), "V2": np.zeros((1, 5))})
    with pytest.raises(InputError, match="files of Silverbox"):
        of(tmp_path, "silverbox")
    assert found_in(RULES["emps"], tmp_path) is None


def fake_loader(monkeypatch: pytest.MonkeyPatch, window: int, **functions: Any) -> None:
    """Put a package in the place of nonlinear_benchmarks."""

    def record(u: np.ndarray, y: np.ndarray) -> SimpleNamespace:
        return SimpleNamespace(u=u, y=y, state_initialization_window_length=window)

    def loader(pair: tuple[np.ndarray, np.ndarray]) -> Any:
        return lambda always_return_tuples_of_datasets: ([record(*pair)], [record(*pair)])

    made = {name: loader(pair) for name, pair in functions.items()}
    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", SimpleNamespace(**made))


def test_the_official_loader_is_taken_at_its_word_and_its_window_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_loader(monkeypatch, 50, Cascaded_Tanks=(counted(60), counted(60, 5.0)))
    split = downloaded(RULES["cascaded-tanks"])
    assert ends(split.tests[0][0]) == (5, 64)
    assert split.origin == "nonlinear_benchmarks.Cascaded_Tanks"
    alone = SimpleNamespace(u=counted(60), y=counted(60), state_initialization_window_length=50)
    package = SimpleNamespace(Silverbox=lambda **_: (alone, [alone] * 3))  # its record to learn from comes bare
    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", package)
    assert len(downloaded(RULES["silverbox"]).train) == 1
    flights = [SimpleNamespace(u=np.zeros((9, 4)), y=np.zeros((9, 13)), state_initialization_window_length=50)] * 3
    package = SimpleNamespace(NanoDrone=lambda **_: (flights, flights))
    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", package)
    assert [len(group) for group in downloaded(RULES["nano-drone"]).tests] == [3, 3, 3, 3]
    fake_loader(monkeypatch, 5, Cascaded_Tanks=(counted(60), counted(60)))
    with pytest.raises(InputError, match=r"expected 50.*install the newest"):
        downloaded(RULES["cascaded-tanks"])
    with pytest.raises(InputError, match=r"put DATA_EMPS\.mat"):
        downloaded(RULES["emps"])
    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", None)
    with pytest.raises(InputError, match=r"sysid-harness\[download\]"):
        downloaded(RULES["emps"])


@given(st.integers(1, 20), st.integers(0, 2**32 - 1))
def test_only_what_lies_behind_the_window_counts(window: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    measured, modelled = rng.normal(size=(2, window + 30, 2))
    found = window_rmse(measured, modelled, window)
    assert found == pytest.approx(np.linalg.norm((modelled - measured)[window:], axis=0) / np.sqrt(30))
    modelled[:window] = 1e9
    assert window_rmse(measured, modelled, window) == pytest.approx(found)
    modelled[-1, 1] = 1e9  # the model grows, which tells nothing of the plant
    assert window_rmse(measured, modelled, window)[1] == np.inf
    modelled[-1, 0] = np.nan
    assert window_rmse(measured, modelled, window)[0] == np.inf
    with pytest.raises(InputError, match="the same shape"):
        window_rmse(measured[:window], modelled[:window], window)


@given(st.integers(0, 2**32 - 1))
def test_a_free_run_is_shown_no_output_behind_the_window(seed: int) -> None:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(200, 1))
    y = np.zeros((200, 1))
    for k in range(199):
        y[k + 1] = 0.8 * y[k] + u[k]
    record = Trajectory(np.arange(200.0), u, y + 0.01 * rng.normal(size=y.shape), SPEC)
    model = registry.create("identifiers", "arx", order=2).fit([record], rng=rng)
    first = simulated(model, record, 10)
    hidden = record.y.copy()
    hidden[10:] = rng.normal(size=(190, 1))
    assert np.array_equal(first, simulated(model, Trajectory(record.t, u, hidden, SPEC), 10))
    assert not np.array_equal(first, simulated(model, Trajectory(record.t, u, hidden, SPEC), None))


def test_a_figure_is_the_mean_over_records_and_outputs_in_the_unit_of_the_set() -> None:
    rule = RULES["fine-steering-mirror"]
    moved = np.random.default_rng(0).normal(size=(110, 3))
    assert figure(rule, [moved, moved], [moved + np.array([1e-6, 2e-6, 3e-6]), moved]) == pytest.approx(1.0)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_errors_over_horizons_are_those_of_one_flight_after_another(seed: int, horizon: int) -> None:
    rng = np.random.default_rng(seed)
    measured, predicted = rng.normal(size=(9, 13)), rng.normal(size=(9 - horizon, horizon, 13))
    for array in (measured, predicted):
        array[..., 6:10] /= np.linalg.norm(array[..., 6:10], axis=-1, keepdims=True)
    expected = np.zeros(4)
    for h in range(1, horizon + 1):
        errors = []
        for k in range(9 - horizon):
            true, ours = measured[k + h], predicted[k, h - 1]
            least = (Rotation.from_quat(true[6:10]).inv() * Rotation.from_quat(ours[6:10])).magnitude()
            angle = least if true[6:10] @ ours[6:10] >= 0.0 else 2.0 * np.pi - least
            parts = [np.linalg.norm((true - ours)[at]) for at in (slice(0, 3), slice(3, 6), slice(10, 13))]
            errors.append([parts[0], parts[1], angle, parts[2]])
        expected += np.mean(errors, axis=0)
    assert horizon_errors(measured, predicted) == pytest.approx(expected)
    predicted[..., 6:10] *= -1.0  # the same rotations, which the official function takes for others
    assert horizon_errors(measured, predicted)[2] == pytest.approx(2.0 * np.pi * horizon - expected[2])
    with pytest.raises(InputError, match="predictions of a flight"):
        horizon_errors(measured, predicted[:-1])


def test_every_published_figure_names_its_test_its_source_and_who_read_it() -> None:
    for id, figures in published().items():
        for one in figures:
            assert set(one.figures) <= set(RULES[id].tests), one.method
            assert all(0.0 < value < 100.0 for value in one.figures.values())
            assert one.source
            assert one.read_by
            assert 2000 < one.year < 2030
            assert one.rule != "new" or one.n in (None, RULES[id].window), one.method
            assert one.rule != "old" or one.n != RULES[id].window, one.method


def test_how_often_a_published_figure_was_read_is_said_beside_it() -> None:
    mirror = published()["fine-steering-mirror"][0]
    assert cited(mirror).startswith("one NL-LFR with a network (2026), source read twice: M. Floren")
    assert published()["silverbox"][0].read == "from a list"
    assert {one.read for one in published()["nano-drone"]} == {"source read once"}


def test_everything_that_is_entered_can_be_made() -> None:
    entered = read_choices()
    assert {"silverbox", "cascaded-tanks", "coupled-drives", "emps"} <= set(entered)
    for choice in entered.values():
        for candidate in choice.black.candidates if choice.black else ():
            for options in candidate.variants():
                registry.create("identifiers", candidate.id, **options)
        if choice.grey is not None and choice.grey.recording:
            registry.entry("recordings", choice.grey.recording)


def test_choices_that_cannot_be_meant_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    for text in ("[tanks]\n", "[emps.blakc]\n", "[emps.black]\nvalidation = 1.5\ncandidates = []\n", "[emps"):
        path.write_text(text)
        with pytest.raises(InputError, match="choices of the public table"):
            read_choices(path)
