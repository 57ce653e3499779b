"""The effects that are tried: a plug-in that works counts, one that is broken is named, and neither stops the other."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from harness import registry
from harness.diagnosis.dictionary import laws_of, placed
from harness.effects import builtin, place_all
from harness.errors import PluginError
from harness.physics import load_model

HEAD = "from harness.effects import effect, par\n"
EFFECT = '''
@effect("coordinate", [par("c", "F/v^3", scale="0.05 F/v^3", sign="+", main=True)], name="NAME",
        experiment="swing fast")
def EFFECT(f, s, p, q, v):
    """Drag that grows with the third power of the speed."""
    return FORMULA
'''
POINTS = {
    "broken": "odd_broken:it",
    "nowhere": "odd_missing:it",
    "nameless": "odd_good:absent",
    "number": "odd_good:number",
    "raises": "odd_good:raises",
    "double": "odd_good:double",
    "cubic_drag": "odd_good:cubic",
}


def law(name: str, formula: str, function: str) -> str:
    """Return the source of an effect."""
    return EFFECT.replace("NAME", name).replace("FORMULA", formula).replace("EFFECT", function)


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install a distribution with one good effect and six that are broken, each in its own way."""
    (tmp_path / "odd_broken.py").write_text("raise RuntimeError('broken wheel')\n")
    parts = [
        law("raises", "v.third_power()", "raises"),
        law("quadratic_drag", "-p.c * v**3", "double"),
        law("cubic_drag", "-p.c * v**3", "cubic"),
    ]
    (tmp_path / "odd_good.py").write_text(HEAD + "number = 3\n" + "".join(parts))
    info = tmp_path / "odd_effects-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: odd-effects\nVersion: 1.0\n")
    lines = [f"{name} = {target}" for name, target in POINTS.items()]
    (info / "entry_points.txt").write_text("\n".join(["[sysid_harness.effects]", *lines, ""]))
    monkeypatch.syspath_prepend(str(tmp_path))
    registry._all.cache_clear()
    yield
    registry._all.cache_clear()
    for name in ("odd_broken", "odd_good"):
        sys.modules.pop(name, None)


def test_every_broken_plugin_is_named_with_its_fault_and_the_others_count(plugins: None) -> None:
    system = load_model("pendulum")
    found, faults = placed(system, laws_of())
    assert {str(one) for one in found} == {*map(str, place_all(system)), "cubic_drag@theta"}
    told = {name: [one for one in faults if f"{name!r} of odd-effects ({target})" in one] for name, target in
            POINTS.items()}  # fmt: skip
    assert told.pop("cubic_drag") == []
    assert {name: len(texts) for name, texts in told.items()} == dict.fromkeys(told, 1)
    assert len(faults) == len(told)
    for name, fault in {
        "broken": "RuntimeError: broken wheel",
        "nowhere": "No module named 'odd_missing'",
        "nameless": "absent",
        "number": "it is a int, not an effect",
        "raises": "third_power",
        "double": "already has an effect named 'quadratic_drag'",
    }.items():
        assert fault in told[name][0], told[name]
        assert "\n" not in told[name][0]


def test_plugins_are_left_out_where_the_user_says_so(plugins: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SYSID_HARNESS_NO_PLUGINS", "1")
    registry._all.cache_clear()
    system = load_model("pendulum")
    found, faults = placed(system, laws_of())
    assert [str(one) for one in found] == [str(one) for one in place_all(system)]
    assert faults == []


def test_a_given_dictionary_is_taken_as_it_is(plugins: None) -> None:
    found, faults = placed(load_model("pendulum"), laws_of([builtin()["quadratic_drag"]]))
    assert ([str(one) for one in found], faults) == (["quadratic_drag@theta"], [])


def test_a_registry_that_cannot_be_read_is_said_and_our_own_effects_count(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(kind: str) -> tuple[registry.Entry, ...]:
        raise PluginError(f"no {kind} are registered")

    monkeypatch.setattr(registry, "entries", refuse)
    system = load_model("pendulum")
    found, faults = placed(system, laws_of())
    assert [str(one) for one in found] == [str(one) for one in place_all(system)]
    assert faults == ["effects of plug-ins could not be looked up: no effects are registered"]
