"""Plug-ins are found lazily, and a bad one is a named error."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from harness import registry, units
from harness.errors import InputError, PluginError


def test_an_unknown_id_lists_near_ones() -> None:
    with pytest.raises(InputError, match=r"did you mean.*pendulum-ode"):
        registry.entry("plants", "pendulum-od")
    with pytest.raises(InputError, match="unknown kind"):
        registry.entries("gadgets")


def test_listing_imports_none_of_the_parts() -> None:
    code = (
        "import sys; from harness import api; rows = api.list_parts();"
        "assert any(r['id'] == 'iiwa-bullet' for r in rows['plants']);"
        "heavy = {'control','filterpy','casadi','sympy','pybullet','pymunk','fmpy','pyarrow','scipy','matplotlib'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_registered_part_has_a_summary_and_loads() -> None:
    for kind in ("plants", "identifiers", "scenarios", "effects", "models"):
        for entry in registry.entries(kind):
            assert entry.summary, f"{kind} {entry.id} has no first line of docstring"
            registry.load(kind, entry.id)


def write_plugin(folder: Path, source: str) -> None:
    """Write an installed distribution by hand: a module and its dist-info."""
    (folder / "odd_plugin.py").write_text(source)
    info = folder / "odd_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: odd-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[sysid_harness.identifiers]\nodd = odd_plugin:make\nhold = odd_plugin:make\n"
    )


def test_a_plugin_that_raises_is_named_and_ours_win(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_plugin(tmp_path, "raise RuntimeError('broken wheel')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    registry._all.cache_clear()
    try:
        with pytest.raises(PluginError, match=r"'odd' of odd-plugin.*RuntimeError: broken wheel.*uninstall"):
            registry.load("identifiers", "odd")
        assert registry.entry("identifiers", "hold").distribution == "sysid-harness"
        monkeypatch.setenv("SYSID_HARNESS_NO_PLUGINS", "1")
        registry._all.cache_clear()
        assert "odd" not in [entry.id for entry in registry.entries("identifiers")]
    finally:
        registry._all.cache_clear()


def test_options_are_checked_by_name() -> None:
    with pytest.raises(InputError, match="remove spelling"):
        registry.create("identifiers", "hold", spelling=1)


@pytest.mark.parametrize(("unit", "target", "factor"), [("deg", "rad", 0.017453292519943295), ("mm", "m", 1e-3)])
def test_units_convert_once(unit: str, target: str, factor: float) -> None:
    import numpy as np

    assert units.convert(np.array([2.0]), unit, target)[0] == pytest.approx(2 * factor)


def test_units_that_do_not_fit_are_refused() -> None:
    import numpy as np

    with pytest.raises(InputError, match=r"converts to 'rad'.*'V'"):
        units.convert(np.array([1.0]), "V", "rad")
    with pytest.raises(InputError, match="unknown unit"):
        units.convert(np.array([1.0]), "furlongs per", "m")


@pytest.mark.parametrize(("kind", "former"), sorted(registry.FORMER))
def test_a_former_id_is_answered_with_what_took_its_place(kind: str, former: str) -> None:
    now = registry.FORMER[kind, former]
    assert registry.entry(kind, now).id == now
    assert former not in [one.id for one in registry.entries(kind)]
    with pytest.raises(InputError, match=f"{former}.*say {now}, which took its place"):
        registry.create(kind, former)
