"""Names of others are shown as text: no formula in a plot, no order to a terminal, no broken XML."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from harness.cli.terminal import fail, print_table, say
from harness.errors import printable
from harness.export.describe import xml_text
from harness.plots import plain_texts, plot_record

HOSTILE = ["$\\frac{", "a$b$c$", "\x1b[2J", "x\x00y", "right\u202eleft", "_{^", "\\u", "100 $"]


@given(st.text())
def test_printable_keeps_what_can_be_read_and_nothing_else(text: str) -> None:
    shown = printable(text)
    assert all(c.isprintable() or c.isspace() for c in shown)
    assert not {chr(27), chr(0), chr(155), "\r"} & set(shown)
    assert printable(shown) == shown
    if text.isprintable():
        assert shown == text


@pytest.mark.parametrize("name", HOSTILE)
def test_a_record_with_any_names_is_drawn(name: str) -> None:
    t = np.arange(20.0)
    figure = plot_record(t, (np.zeros((20, 1)), [name]), (np.ones((20, 1)), [name]))
    stream = io.BytesIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    ElementTree.fromstring(stream.getvalue())
    assert figure.axes[0].get_ylabel() == printable(name)


@pytest.mark.parametrize("name", HOSTILE)
def test_ticks_that_are_names_are_text_and_ticks_that_are_numbers_stay_formulas(name: str) -> None:
    figure = Figure()
    names, numbers = figure.subplots(1, 2)
    names.set_yticks([0, 1], [name, "sound"])
    numbers.semilogy([1, 2], [1e-3, 1e3])
    stream = io.BytesIO()
    plain_texts(figure).savefig(stream, format="svg", metadata={"Date": None})
    ElementTree.fromstring(stream.getvalue())
    assert [tick.get_text() for tick in names.get_yticklabels()] == [printable(name), "sound"]
    assert not any(tick.get_parse_math() for tick in names.get_yticklabels())
    assert all(tick.get_parse_math() for tick in numbers.get_yticklabels())


def test_the_terminal_gets_no_orders(capsys: pytest.CaptureFixture[str]) -> None:
    say("a \x1b[2J")
    fail("b \x1b[2J", 2)
    print_table(["c \x1b[2J", "d"], [["e \x1b[2J", "f"]])
    said = capsys.readouterr()
    assert "\x1b" not in said.out + said.err
    assert (said.out + said.err).count("\\x1b[2J") == 4


@pytest.mark.parametrize("name", HOSTILE)
def test_xml_is_read_back(name: str) -> None:
    read = ElementTree.fromstring(xml_text(ElementTree.Element("a", name=name)).split("?>", 1)[1])
    assert read.get("name") == printable(name)
