"""Laws are typeset where they read as mathematics, and no word of them is lost."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from types import ModuleType
from xml.etree import ElementTree

import pytest

from harness.effects import builtin


@pytest.fixture(scope="module")
def formulas(script: Callable[[str], ModuleType]) -> ModuleType:
    return script("docs/formulas.py")


def letters(text: str, formulas: ModuleType) -> str:
    """Return what is left of a text without signs and spaces, Greek letters written out."""
    for name, sign in formulas.GREEK.items():
        text = text.replace(sign, name)
    return re.sub(r"[^A-Za-z0-9]", "", text.replace(formulas.DIFFERENCE, "d"))


@pytest.mark.parametrize("name", sorted(builtin()))
def test_every_law_keeps_its_words_and_is_sound_markup(name: str, formulas: ModuleType) -> None:
    law = " ".join(builtin()[name].formula.split())
    made = formulas.typeset(law)
    tree = ElementTree.fromstring(f"<p>{made}</p>")
    plain = "".join(tree.itertext())
    assert sorted(letters(plain, formulas)) == sorted(letters(law, formulas))
    assert "<math" in made
    assert html.unescape(plain).count("=") == law.count("=") - law.count(">=") - law.count("<=")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("F = -k (q - q0)^2", ["mfrac", 0, "msup", 1, "msub", 1]),
        ("z' = v - |v| z/xs", ["mfrac", 1, "msup", 0, "msub", 1]),
        ("F = Fr |v|^a, 0 < a < 1", ["mfrac", 0, "msup", 1, "msub", 1]),
        ("m a mass of 3 rad/s", ["mfrac", 0, "msup", 0, "msub", 0]),
        ("F = (a + b", ["mfrac", 0, "msup", 0, "msub", 0]),
        ("|x", ["mfrac", 0, "msup", 0, "msub", 0]),
    ],
)
def test_fractions_powers_and_indices(text: str, shown: list[str | int], formulas: ModuleType) -> None:
    made = formulas.typeset(text)
    ElementTree.fromstring(f"<p>{made}</p>")
    assert [made.count(f"<{tag}>") for tag in shown[::2]] == shown[1::2]
