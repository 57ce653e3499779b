"""Options as a command line gives them: nothing, one name, lists of lists; and what cannot be meant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import pytest
from typer.testing import CliRunner

from harness import registry
from harness.cli.app import app
from harness.cli.words import option_pairs, seed_range
from harness.errors import InputError
from harness.options import meant_options
from harness.physics.definition.parameters import Parameter, far_off
from harness.physics.models import linear
from harness.rng import Streams


def made(
    names: Sequence[str] = (),
    pairs: tuple[tuple[str, int], ...] = (),
    order: int | None = 2,
    text: str | None = None,
    mode: Literal["none", "linear"] = "none",
    either: str | Sequence[str] = "",
    sizes: float | Mapping[str, float] = 1.0,
    numbers: list[float] | None = None,
    band: tuple[float, float] | None = None,
) -> None:
    """Take options of every shape."""


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("names=theta", {"names": ["theta"]}),
        ('names=["a", "b"]', {"names": ["a", "b"]}),
        ('pairs=[["theta", 1]]', {"pairs": [["theta", 1]]}),
        ("order=None", {"order": None}),
        ("order=none", {"order": None}),
        ("text=None", {"text": None}),
        ("text=none", {"text": "none"}),
        ("mode=none", {"mode": "none"}),
        ("either=theta", {"either": "theta"}),
        ("numbers=null", {"numbers": None}),
        ("band=[0.1, 2.0]", {"band": [0.1, 2.0]}),
        ("sizes.u=2.0", {"sizes": {"u": 2.0}}),
    ],
)
def test_what_a_command_line_means(given: str, meant: dict[str, Any]) -> None:
    assert meant_options("made", made, option_pairs([given], "--option")) == meant


@pytest.mark.parametrize(
    "given",
    ["names=3", "names=[1, 2]", 'names=[["a"]]', 'pairs=["theta", 1]', 'pairs=[["theta", 1, 2]]', "order=[1]",
     "order=high", "mode=None", "sizes=[1.0]", "sizes=None", 'numbers=["a"]', "numbers=[[1.0]]", "band=[1.0]",
     "band=0.1", "names.a=1"],
)  # fmt: skip
def test_what_it_cannot_mean_is_refused_with_the_option(given: str) -> None:
    with pytest.raises(InputError, match=r"option of made: expected .*remedy: give ") as refused:
        meant_options("made", made, option_pairs([given], "--option"))
    assert refused.value.place == given.split("=")[0].split(".")[0]


def test_a_name_is_not_its_letters_and_none_is_nothing_for_a_real_part() -> None:
    plant: Any = registry.create("identifiers", "output-error", model="pendulum", fixed="mgl")
    assert list(plant.fixed) == ["mgl"]
    assert registry.create("identifiers", "arx", order="None").order is None


@pytest.mark.parametrize("option", ["amplitude=-1", "relative_amplitude=-0.1", "amplitude.u=-0.5"])
def test_a_negative_amplitude_is_said(option: str) -> None:
    ran = CliRunner().invoke(
        app, ["simulate", "pendulum-ode", "--scenario", "multisine", "--scenario-option", option, "-o", "never.csv"]
    )
    assert isinstance(ran.exception, InputError)
    assert "zero or a positive number" in str(ran.exception)


def test_one_seed_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert seed_range("5") == (5, 5)
    assert "seed 5 alone; --seeds 0..4 are 5 seeds" in capsys.readouterr().err
    assert seed_range("0..4") == (0, 4)
    assert capsys.readouterr().err == ""


def test_sizes_are_held_against_both_sides_of_every_declaration() -> None:
    declared = [Parameter("J", "kg m^2", 0.1), Parameter("b", "1", 0.05), Parameter("g", "1", 9.81, fixed=True),
                Parameter("free", "1", 0.0)]  # fmt: skip
    usual = {"J": 0.9, "b": 0.006, "g": 9.81, "free": 1e9}
    assert not far_off(declared, usual)
    (large,) = far_off(declared, {**usual, "J": 5e4})
    assert (large.name, large.ratio) == ("J", pytest.approx(5e5))
    small = {**usual, "J": 1e-4, "b": 1e-7}
    told = far_off(declared, small, {"J": (0.9e-4, 1.1e-4), "b": (-1e-3, 1e-3)})
    assert [str(one) for one in told] == [
        "J = 0.0001 kg m^2 is 0.001 times the declared 0.1"
    ]  # b may be 0: no friction


def test_a_place_to_start_from_declares_no_size() -> None:
    """The coefficients of a black box at 1 kHz are 1e5 times the 1 that its fit starts from: no unit is wrong."""
    black_box = linear(2).system()
    values = dict.fromkeys(black_box.parameter_names, 1e6)
    assert not far_off(black_box.parameters, values)
    given = black_box.with_parameters({"a1_1": 2.0})
    assert [one.name for one in far_off(given.parameters, values)] == ["a1_1"]


def test_values_of_a_table_are_what_it_holds() -> None:
    assert meant_options("made", made, option_pairs(["sizes.u=2.0", "sizes.v=3"], "--option")) == {
        "sizes": {"u": 2.0, "v": 3}
    }
    with pytest.raises(InputError, match=r"each a number, got \{'u': 'none'\}"):
        meant_options("made", made, option_pairs(["sizes.u=none"], "--option"))


@pytest.mark.parametrize("seed", ["-1", "-300"])
def test_seeds_count_from_nought(seed: str) -> None:
    ran = CliRunner().invoke(
        app, ["simulate", "pendulum-ode", "--scenario", "multisine", "--seed", seed, "-o", "x.csv"]
    )
    assert "greater than or equal to 0" in f"{ran.output} {ran.exception}"
    with pytest.raises(InputError, match="seed: expected a whole number from 0"):
        Streams("pendulum-ode", "multisine", int(seed))("estimation/0")
