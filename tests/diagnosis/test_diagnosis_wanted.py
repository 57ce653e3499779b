"""The dictionary of one run as text: what is given stays, what is tried is all that is, what is left out is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness import api
from harness.diagnosis.dictionary import laws_of, placed, with_effects_of
from harness.diagnosis.wanted import Wanted
from harness.effects import builtin, compose
from harness.effects.effect import Placed
from harness.errors import InputError
from harness.physics import load_model

CANDIDATES, _ = placed(load_model("cart-pole"), laws_of())
FRICTION, SPRING = Placed(builtin()["coulomb_friction"], "theta"), Placed(builtin()["cubic_spring"], "theta")

LAW = """
from harness.effects import effect, par

@effect("coordinate", [par("c", "F s^3/q^3", main=True, linear=True, neutral=0.0, sign="+", meaning="of the cube",
                           scale="0.1 F/v^3")], formula="Q = -c v^3")
def cubic_drag(F, s, p, q, v):
    return -p.c * v**3
"""


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two records of a pendulum with dry friction and a spring that hardens."""
    folder = tmp_path_factory.mktemp("records")
    plant, t = compose(load_model("pendulum"), [FRICTION, SPRING]), np.arange(900) * 0.02
    law = {f"{FRICTION}.Fc": 0.1, f"{FRICTION}.w": 0.02, f"{SPRING}.k3": 0.3}
    p = plant.vector({"J": 0.1, "b": 0.05, "mgl": 1.0, **law})
    for seed, name in enumerate(("estimation", "validation")):
        rng = np.random.default_rng(seed)
        u = np.sum([0.4 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.2, 0.5, 0.9, 1.4)], axis=0)[:, None]
        y = plant.simulator(0.02, substeps=16).rollout(p, np.zeros(plant.nx), u) + 1e-3 * rng.normal(size=(900, 1))
        table = np.column_stack([t, u, y])
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header="time [s],u [N m],theta [rad]", comments="")
    return folder


@pytest.mark.parametrize(
    ("text", "found"),
    [
        pytest.param("coulomb_friction(theta)", {str(FRICTION), str(SPRING)}, marks=pytest.mark.slow),
        pytest.param("cubic_spring@theta; coulomb_friction?", {str(FRICTION), str(SPRING)}, marks=pytest.mark.slow),
        pytest.param("elasticity(theta); *_spring?", {"elasticity@theta", str(SPRING)}, marks=pytest.mark.slow),
        ("*_spring?", {str(SPRING)}),
    ],
)
def test_what_is_given_stays_and_what_is_tried_is_all(
    records: Path, tmp_path: Path, text: str, found: set[str]
) -> None:
    report = api.close_loop(
        records / "estimation.csv",
        validation=records / "validation.csv",
        model="pendulum",
        out=tmp_path,
        dictionary=text,
    )
    assert {f"{one['name']}@{one['at']}" for one in report.data["effects"]} == found
    given = {f"{one['name']}@{one['at']}" for one in report.data["effects"] if one["given"]}
    wanted = Wanted.read(text)
    assert given == {str(one) for one in wanted.chosen([*placed(load_model("pendulum"), laws_of())[0]])[0]}
    assert report.data["dictionary"] == str(wanted)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("no evidence was asked for, and it was not compared with others") == len(given)
    for one in report.data["effects"]:
        if (one["name"], one["at"]) == ("coulomb_friction", "theta"):
            assert one["parameters"]["Fc"]["value"] == pytest.approx(0.1, rel=0.1)


def test_a_law_of_ones_own_file_is_tried_for_a_run(records: Path, tmp_path: Path) -> None:
    law = tmp_path / "mine.py"
    law.write_text(LAW)
    report = api.close_loop(
        records / "estimation.csv", validation=records / "validation.csv", model="pendulum", out=tmp_path / "out",
        effects=[f"{law}:cubic_drag"], dictionary="cubic_drag; coulomb_friction?; cubic_spring?",
    )  # fmt: skip
    assert {one["name"] for one in report.data["effects"]} == {"cubic_drag", "coulomb_friction", "cubic_spring"}
    law.write_text("cubic_drag = 3\n")
    with pytest.raises(InputError, match=r"is no effect: expected a law made with @effect"):
        with_effects_of([f"{law}:cubic_drag"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("friction", "did you mean"),
        ("coulomb_friction", r"name one: coulomb_friction\(x\), coulomb_friction\(theta\)"),
        ("coulomb_friction(u)", "it may stand at theta, x"),
        ("!coulomb_friction?", "is tried"),
        ("coulomb friction", "is given"),
    ],
)
def test_an_entry_that_means_nothing_here_is_refused_with_the_remedy(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Wanted.read(text).chosen(CANDIDATES)


@given(st.lists(st.sampled_from(CANDIDATES), min_size=1, max_size=6, unique_by=str), st.data())
def test_entries_divide_the_dictionary(chosen: list[Placed], data: st.DataObject) -> None:
    """Whatever the order of its entries: given, tried and left out have nothing in common and read back as written."""
    uses = [data.draw(st.sampled_from(("{}", "{}?", "!{}"))) for _ in chosen]
    entries = [use.format(f"{one.effect.name}({one.at})") for use, one in zip(uses, chosen, strict=True)]
    wanted = Wanted.read("; ".join(data.draw(st.permutations(entries))))
    assert Wanted.read(str(wanted)) == wanted
    given, tried = (set(map(str, part)) for part in wanted.chosen(CANDIDATES))
    by_use = {use: {str(one) for each, one in zip(uses, chosen, strict=True) if each == use} for use in set(uses)}
    assert given == by_use.get("{}", set())
    assert not tried & (given | by_use.get("!{}", set()))
    rest = {str(one) for one in CANDIDATES} - given - by_use.get("!{}", set())
    assert tried == (by_use["{}?"] if "{}?" in by_use else rest)
