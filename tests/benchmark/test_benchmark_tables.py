"""A benchmark's table on terminals of every width: no figure is cut, and what is left out is named."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from harness.benchmark import BenchResult, rich_table
from harness.benchmark.row import Row
from harness.benchmark.summary import Quartiles, figure
from harness.cli.results import print_bench

PLACES = [("pendulum-fmu (state)", "multisine"), ("cart-pole-pymunk", "cart-pole-lqr")]
SCALES = {"maximum-likelihood": 1.23456e-4, "lumped-momentum": 0.0123456, "neural-output-error": 1234.56}


def result(*, control: bool = False, distributions: bool = False) -> BenchResult:
    """Return a benchmark of three identifiers on two plants, and one identifier that never fits."""
    rows = [
        Row(
            job=f"{plant}{name}{seed}",
            plant=plant,
            scenario=scenario,
            identifier=name,
            seed=seed,
            equation_error=scale * (1 + seed),
            simulation_error=2.7 * scale * (1 + seed),
            regret=0.3 * scale * (1 + seed),
            noise_floor=1e-4,
            log_score=0.9 * scale * (1 + seed) if distributions else None,
            coverage=0.9 if distributions else None,
            control_score=1.1 * scale * (1 + seed) if control else None,
            control_regret=1.3 * scale * (1 + seed) if control else None,
            control_status="not a linear model" if control else "",
        )
        for plant, scenario in PLACES
        for name, scale in SCALES.items()
        for seed in range(3)
    ]
    reason = f"expected at least 1e-4 of the input's {'variance and ' * 20}got 0.000123456789"
    rows += [
        Row(job=f"{p}x{k}", plant=p, scenario=s, identifier="mdp-counting", seed=k, status="unfit", reason=reason)
        for p, s in PLACES
        for k in range(3)
    ]
    return BenchResult("narrow", tuple(rows), len(rows), None, {}, ())


def shown(found: BenchResult, width: int) -> str:
    """Return the table as a terminal of some width shows it."""
    stream = io.StringIO()
    Console(file=stream, width=width, highlight=False).print(rich_table(found))
    return stream.getvalue()


def numbers(text: str) -> set[str]:
    """Return the words that are figures."""
    return {word.strip("[],;()") for word in text.split() if re.match(r"^\[?-?\.?\d", word)}


WIDTHS = [24, 30, 40, 60, 72, 80, 100, 120, 140, 200]


@pytest.mark.parametrize("control", [False, True])
@pytest.mark.parametrize("width", WIDTHS)
def test_no_figure_is_cut_at_any_width(width: int, control: bool) -> None:
    found = result(control=control, distributions=True)
    text = shown(found, width)
    assert max(map(len, text.splitlines())) <= width
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    whole = numbers(shown(found, 1000))
    assert numbers(text) <= whole | {"90"}  # the title "90 % sets hold" may begin a line of its own
    for line in found.summary():
        assert line.identifier in text
        for name in ("equation_error", "simulation_error", "over_best", "regret", "log_score"):
            score: Quartiles | None = getattr(line, name)
            assert score is None or figure(score.median) in text.split(), (name, width)
    assert "unfit" in text
    assert "6 unfit" in text


def test_columns_leave_in_the_stated_order() -> None:
    found = result(control=True)
    forms = [shown(found, width) for width in (240, 190, 150, 90, 40)]
    left = [re.findall(r"left out for want of width: (.*?) \('", " ".join(text.split())) for text in forms]
    some = "control regret, model for control"
    assert left == [[], [], [some], [f"{some}, quartiles"], []]
    assert ["plant, scenario" in text for text in forms] == [True, False, False, False, False]
    assert "median over seeds" in forms[3]
    for text in (forms[0], forms[4]):
        assert "median [quartiles] over" in " ".join(text.split())
    blocks = [line.rstrip() for line in forms[4].splitlines()]
    at = blocks.index("lumped-momentum 3/3")
    assert blocks[at + 1] == "  equation error: 0.0247 [.019 .031]"
    assert blocks[at + 4] == "  regret: 0.00741 [.0056 .0093]"
    assert "  model for control: not a linear model" in blocks
    assert blocks.count("mdp-counting 0/3 unfit") == 2
    assert " ".join(forms[4].split()).count("pendulum-fmu (state), multisine, best 1.00e-4") == 1


def test_a_pipe_gets_the_whole_table(capsys: pytest.CaptureFixture[str]) -> None:
    print_bench(result(control=True, distributions=True), as_json=False)
    text = capsys.readouterr().out
    assert "left out" not in text
    assert "model for control" in text
    assert "0.0247 [.019 .031]" in text
    assert "6 unfit: mdp-counting on pendulum-fmu (state) x multisine and 1 more" in text
    reason = next(line for line in text.splitlines() if line.startswith("6 unfit"))
    assert re.search(r"variance( and)? \.\.\.$", reason)
