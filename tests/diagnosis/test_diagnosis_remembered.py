"""What is kept of an interrupted diagnosis is known by its content: another law of the same name is another."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from made_fits import a_fit

from harness import registry
from harness.diagnosis.forms.fit_records import (
    LikelihoodDetail,
    latent_shares,
    point_from_record,
    point_record,
    reading_noise,
)
from harness.diagnosis.forms.remembered import Remembered
from harness.diagnosis.search.fit import Begun
from harness.effects.effect import Placed
from harness.fingerprint import files_named, fingerprint
from harness.physics import Mechanism
from harness.physics.compiled.kalman_pass import PassNoise
from harness.physics.compiled.system import System
from harness.physics.fitting.maximum import Point
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory


def mine(power: int) -> System:
    """Return a slider under friction of a power of its speed, always by one name."""
    m = Mechanism("mine", q="x", u="f", p="m b")
    (x,), (v,), (f,), (mass, b) = m.q, m.v, m.u, m.p
    m.body(mass, (x, 0))
    m.Q = [f - b * v**power]
    return m.system()


def dataset(shift: float = 0.0) -> Dataset:
    spec = PlantSpec((Channel("f", "N"),), (Channel("x", "m"),), 0.01)
    t = np.arange(50) * 0.01
    records = [Trajectory(t, np.sin(t)[:, None] + shift, np.cos(t)[:, None], spec) for _ in range(2)]
    return Dataset("slider", (Run(records[0], "estimation"), Run(records[1], "validation")))


@dataclass
class Counted:
    """A form that counts what it finishes and tells what it restores."""

    dataset: Dataset
    finished: list[str] = field(default_factory=list)
    nominal: Any = None
    laws: Any = None

    def finish(self, begun: Begun, base: Any, rival: Any = None, least: float = -np.inf) -> Any:
        self.finished.append(f"{begun.system} {begun.values}")
        return SimpleNamespace(kept=begun.values)

    def record(self, fit: Any) -> dict[str, Any]:
        return {"kept": fit.kept}

    def restored(self, effects: Sequence[Placed], record: dict[str, Any]) -> Any:
        return SimpleNamespace(kept=record["kept"])


def begun(system: System, b: float) -> Begun:
    return Begun((), -10.0, {"m": 1.0, "b": b}, None, system=system)


def test_a_corrected_law_is_not_answered_with_the_fits_of_the_old_one(tmp_path: Path) -> None:
    form = Counted(dataset())
    Remembered(form, tmp_path).finish(begun(mine(3), 0.1), None)  # type: ignore[arg-type]
    Remembered(form, tmp_path).finish(begun(mine(3), 0.1), None)  # type: ignore[arg-type]
    assert len(form.finished) == 1, "the same again is read back"
    Remembered(form, tmp_path).finish(begun(mine(1), 0.1), None)  # type: ignore[arg-type]
    assert len(form.finished) == 2, "the law was corrected, and its fit is another"


def test_the_order_in_which_fits_are_asked_for_decides_nothing(tmp_path: Path) -> None:
    form = Counted(dataset())
    first, again = Remembered(form, tmp_path), Remembered(form, tmp_path)  # type: ignore[arg-type]
    asked = [begun(mine(1), b) for b in (0.1, 0.2, 0.3)]
    for one in asked:
        first.finish(one, None)
    for one in reversed(asked):
        restored: Any = again.finish(one, None)
        assert restored.kept == one.values
    assert len(form.finished) == 3


def test_other_data_and_another_bar_are_other_fits(tmp_path: Path) -> None:
    form, other = Counted(dataset()), Counted(dataset(1e-9))
    Remembered(form, tmp_path).finish(begun(mine(1), 0.1), None)  # type: ignore[arg-type]
    Remembered(other, tmp_path).finish(begun(mine(1), 0.1), None)  # type: ignore[arg-type]
    Remembered(form, tmp_path).finish(begun(mine(1), 0.1), None, least=-5.0)  # type: ignore[arg-type]
    assert (len(form.finished), len(other.finished)) == (2, 1)


def test_nothing_is_kept_without_a_folder(tmp_path: Path) -> None:
    form = Counted(dataset())
    remembered = Remembered(form, None)  # type: ignore[arg-type]
    for _ in range(2):
        remembered.finish(begun(mine(1), 0.1), None)
    assert len(form.finished) == 2


def test_a_model_that_is_begun_anew_twice_is_fitted_once_and_is_its_own_maximum(tmp_path: Path) -> None:
    """The last steps of a diagnosis asked for one fit to all readings three times."""
    form = Counted(dataset())
    remembered, asked = Remembered(form, None), []  # type: ignore[arg-type]

    def fit(effects: Any, starts: Any, base: Any, rival: Any = None) -> Any:
        asked.append(starts)
        return a_fit(values={"m": 1.5, "b": 0.25})

    remembered.fit = fit  # type: ignore[method-assign]
    found = remembered.anew(a_fit(values={"m": 1.0, "b": 0.2}))
    assert found is not None
    assert remembered.anew(a_fit(values={"b": 0.2, "m": 1.0})) is found
    assert remembered.anew(found) is found
    assert asked == [[{"m": 1.0, "b": 0.2}]]
    remembered.anew(a_fit(values={"m": 1.1, "b": 0.2}))
    assert len(asked) == 2


def test_a_model_is_its_equations_and_parameters() -> None:
    assert mine(1).fingerprint == mine(1).fingerprint
    assert mine(1).fingerprint != mine(3).fingerprint


def test_a_fingerprint_is_of_content(tmp_path: Path) -> None:
    file = tmp_path / "law.py"
    file.write_text("b * w**3")
    before = fingerprint(files_named({"model": f"{file}:mine"}))
    file.write_text("b * w")
    assert fingerprint(files_named({"model": f"{file}:mine"})) != before
    assert files_named(["law.py:mine", "nothing here"], tmp_path) == [file]
    assert fingerprint(1) != fingerprint("1") != fingerprint(1.0)
    assert fingerprint(["ab", "c"]) != fingerprint(["a", "bc"])
    with pytest.raises(TypeError, match="function"):
        fingerprint(lambda: 0)


def test_a_plug_in_is_the_code_in_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A benchmark kept the rows of a plug-in whose file had been corrected."""
    monkeypatch.syspath_prepend(str(tmp_path))
    point = EntryPoint("mine", "fingerprinted_part:Mine", "sysid_harness.identifiers")
    theirs = registry.Entry("identifiers", "mine", point.value, "another-distribution", point)
    codes = []
    for text in ("gain = 1", "gain = 2"):
        (tmp_path / "fingerprinted_part.py").write_text(text)
        codes.append(theirs.code)
    assert codes[0] != codes[1] != ""
    assert registry.code_of("identifiers", "arx") == "", "ours is told by the version of the project"
    assert registry.code_of("identifiers", "no such thing") == ""


def test_forces_that_nobody_measured_are_told_as_shares_of_the_typical_ones() -> None:
    """What lasts and what is new with every sample together, each port over its own typical force."""
    noise = PassNoise(np.array([0.1]), np.array([3.0, 0.0]), np.array([1.0, 1.0]), np.array([4.0, 2.0]))
    point, nothing = Point(np.array([1.0, 2.0]), [np.array([0.5, -0.5])], noise), cast(Any, None)
    fit = a_fit(detail=LikelihoodDetail({"estimation": point}, nothing, nothing, nothing))
    assert latent_shares(fit, np.array([10.0, 4.0])).tolist() == [0.5, 0.5]
    assert reading_noise(fit).tolist() == [0.1]
    again = point_from_record(json.loads(json.dumps(point_record(point))))
    assert (again.p.tolist(), again.x0[0].tolist()) == ([1.0, 2.0], [0.5, -0.5])
    assert [getattr(again.noise, name).tolist() for name in "rsw"] == [[0.1], [3.0, 0.0], [4.0, 2.0]]
