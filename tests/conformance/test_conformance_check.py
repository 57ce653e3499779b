"""check(NAME_OR_FILE): finds what a name means, and refuses what means nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.conformance import check, check_effect
from harness.errors import InputError

BROKEN = """
from dataclasses import dataclass
from identifiers.online.baselines import HoldLast

class Peeks(HoldLast):
    def fit(self, trajectories, *, rng):
        if any(t.x is not None for t in trajectories):
            raise RuntimeError("truth!")
        return super().fit(trajectories, rng=rng)

def configured():
    return HoldLast()

def needs(option):
    return HoldLast()

def odd():
    return 3
"""


@pytest.mark.parametrize("name", ["models/pendulum", "multisine", "pendulum-ode", "hold"])
def test_registered_parts_pass(name: str) -> None:
    results = check(name)
    assert results
    assert [r for r in results if not r.passed] == []


def test_a_file_is_checked(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(BROKEN)
    assert all(r.passed for r in check(f"{tmp_path / 'mine.py'}:configured"))
    failed = {r.name for r in check(f"{tmp_path / 'mine.py'}:Peeks") if not r.passed}
    assert failed == {"truth_never_read"}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("pendulum-od", "did you mean.*pendulum-ode"),
        ("scenarios/replay", "without options"),
        ("mine.py:needs", "without options"),
        ("mine.py:odd", "no known kind"),
        ("mine.py:nothing", "no 'nothing'"),
        ("mine.py", "FILE.py:NAME"),
        ("none.py:x", "no such file"),
        ("none.fmu", "no such FMU"),
        ("bad.py:x", "does not run"),
    ],
)
def test_what_cannot_be_checked_is_refused(
    name: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(BROKEN)
    (tmp_path / "bad.py").write_text("import nothing_of_this_name\n")
    with pytest.raises(InputError, match=words):
        check(name)


def test_effects_pass_and_a_wrong_one_fails() -> None:
    from harness.effects import effect
    from harness.effects.laws.friction import coulomb_friction

    assert all(r.passed for r in check_effect(lambda: coulomb_friction))

    @effect("coordinate", {"c": "F"}, formula="0 v", experiment="none")
    def idle(f, s, p, q, v):  # type: ignore[no-untyped-def]
        """Do nothing at all."""
        return 0.0 * v

    assert "acts" in {r.name for r in check_effect(lambda: idle) if not r.passed}
