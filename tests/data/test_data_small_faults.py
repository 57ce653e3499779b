"""Small faults of reading data that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.data import load_dataset
from harness.data.conditioning.suspicion import _gain
from harness.data.tables.binary_files import _inside
from harness.data.tables.headers import stated_unit
from harness.data.tables.text_files import TextFile
from harness.errors import InputError

HEAD = 'name = "x"\nsample_time = 0.1\n[signals.u]\nrole = "input"\nunit = "N m"\n[signals.theta]\nrole = "output"\n'
HEAD += 'unit = "rad"\n'


def recorded(folder: Path, keys: str, rows: int = 60) -> Path:
    """Return the description of a record whose theta counts its rows."""
    table = np.column_stack([np.sin(0.7 * np.arange(rows)), np.arange(rows)])
    np.savetxt(folder / "a.csv", table, delimiter=",", header="u [N m],theta [rad]", comments="")
    file = folder / "dataset.toml"
    file.write_text(f'{HEAD}[[runs]]\nfile = "a.csv"\n{keys}')
    return file


@pytest.mark.parametrize(
    ("keys", "first", "last"),
    [("", 0, 59), ("rows = [10, 40]\n", 10, 39), ("rows = [10, 40]\ndiscard = 5\n", 15, 39), ("discard = 40\n", 40, 59),
     ("rows = [0, 60]\n", 0, 59)],
)  # fmt: skip
def test_rows_and_what_is_discarded_of_them(tmp_path: Path, keys: str, first: int, last: int) -> None:
    (run,) = load_dataset(recorded(tmp_path, keys)).dataset.estimation
    assert (run.y[0, 0], run.y[-1, 0], len(run)) == (first, last, last - first + 1)


@pytest.mark.parametrize(
    ("keys", "words"),
    [("rows = [10, 20]\ndiscard = 10\n", "nothing left of the run"), ("discard = 60\n", "nothing left of the run"),
     ("rows = [0, 61]\n", "rows beyond the end")],
)  # fmt: skip
def test_rows_that_are_not_there_are_refused(tmp_path: Path, keys: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_dataset(recorded(tmp_path, keys))


def test_the_past_of_a_signal_helps_to_foretell_what_it_drives_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    drive, other = rng.standard_normal((2, 4000))
    driven = np.zeros(4000)
    for k in range(1, 4000):
        driven[k] = 0.5 * driven[k - 1] + drive[k - 1] + 0.1 * rng.standard_normal()
    # alone it errs by the drive (1, and 0.1 of its own), with the drive by 0.1
    assert _gain(driven, drive) == pytest.approx(np.sqrt(1.01) / 0.1, rel=0.05)
    assert _gain(driven, other) == pytest.approx(1.0, abs=0.01)
    assert _gain(1e3 * driven + 5.0, 1e-3 * drive) == pytest.approx(_gain(driven, drive), rel=1e-6)


@pytest.mark.parametrize(
    ("title", "like", "found"),
    [("x_mm", "m", ("x", "mm")), ("x_in", "m", None), ("x_furlongy", "m", None), ("x_mm", "rad", None)],
)
def test_a_word_behind_a_name_is_its_unit_only_where_it_is_one_and_fits(
    title: str, like: str, found: tuple[str, str] | None
) -> None:
    assert stated_unit(title, like) == found


def test_no_row_of_a_text_is_lost(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    for text, titles in (("a,b\n1,2\n3,4\n", ["a", "b"]), ("1,2\n3,4\n", ["0", "1"])):
        file.write_text(text)
        read = TextFile(file)
        assert list(read.titles) == titles
        assert [read.values(title).tolist() for title in titles] == [[1.0, 3.0], [2.0, 4.0]]
    file.write_text("a,b\nm,s\n1,2\n3,4\n")
    read = TextFile(file)
    assert list(read.titles) == ["a [m]", "b [s]"]
    assert read.values("b [s]").tolist() == [2.0, 4.0]


def test_the_columns_of_a_matrix_are_named_along_its_longer_side() -> None:
    def itself(value: object) -> object:
        return value

    assert _inside("m", np.zeros((5, 2)), itself) == ["m[:,0]", "m[:,1]"]
    assert _inside("m", np.zeros((2, 5)), itself) == ["m[0]", "m[1]"]
    for whole in (np.zeros(5), np.zeros((5, 1)), np.zeros((1, 5)), np.zeros((5, 2), dtype="U3")):
        assert _inside("m", whole, itself) is None
    deep = np.zeros(3, dtype=[("a", float, (2,)), ("b", float)])
    assert _inside("m", deep, itself) == ["m.a[:,0]", "m.a[:,1]", "m.b"]
