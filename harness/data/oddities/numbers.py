"""Every number that decides whether something about a record is odd: its value, the reason, and where it is from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


def _number(value: Any, reason: str, source: str, tuned_on: str = "nothing") -> Any:
    return field(default=value, metadata={"reason": reason, "source": source, "tuned_on": tuned_on})


@dataclass(frozen=True)
class OddNumbers:
    """The deciding numbers of :mod:`harness.data.oddities`."""

    rate: float = _number(
        1e-6,
        "chance that a channel of a record with Gaussian noise gets a false spike; the bound of a row follows from it",
        "Bonferroni over the rows",
    )
    heavy: float = _number(
        1.5,
        "factor on that bound: what a local linear prediction misses of a nonlinear plant has heavier tails",
        "clean records of benchmarks/odd_records.py",
        "the same",
    )
    fewest: int = _number(100, "rows below which nothing but stillness is judged", "a prediction has some 20 numbers")
    order: int = _number(8, "rows from which the next one is foretold", "two resonances and two lags")
    local: int = _number(101, "rows over which the scale of the errors is taken", "a tenth of a short record")
    together: int = _number(5, "odd readings near each other that are told apart", "more are a stretch, not spikes")
    unexplained: float = _number(
        0.1,
        "share of the errors about a spike that may be left once its readings are taken as missing, beside the noise",
        "Chen & Liu 1993, J. Am. Stat. Assoc. 88:284, sec. 2: an additive outlier leaves a pattern of its own",
    )
    rival: float = _number(
        0.5,
        "and over what as many kicks of the plant would leave: kicks are mechanics and stay",
        "additive against innovational outlier, Chen & Liu 1993, sec. 3",
    )
    by_chance: float = _number(
        0.01,
        "chance that odd readings share some value that ordinary ones take as well: below it the value is a word",
        "binomial, over all values of the channel",
    )
    smallest: float = _number(1e-3, "spike over the spread of its channel below which it is no matter", "a thousandth")
    beyond: float = _number(1e100, "size beyond which a number is no reading", "squares of it overflow in averages")
    most: float = _number(0.05, "share of rows beyond which they are no exceptions: none is left out", "one in twenty")
    felt: float = _number(
        14.0,
        "log-likelihood of the output that tells a glitch of the logged input from one that the plant felt",
        "one in a million",
    )
    lost: int = _number(3, "rows that a log may lose at a place and that are counted", "more are a leap of positions")
    repeats: float = _number(
        0.01, "share of readings equal to the one before that are worth a look", "one in a hundred"
    )
    changes: int = _number(20, "changes of a value from which a rhythm can be told", "a rhythm of 2 by chance: 1e-6")
    phase: float = _number(
        0.98, "share of the changes that fall on one phase of the rhythm", "a sensor may miss a beat"
    )
    slowest: int = _number(50, "rows between two readings of the slowest sensor that is looked for", "cost")
    catch_up: float = _number(
        0.3,
        "jump after a held reading over what the signal moves meanwhile: a sensor that was held catches up, a plant "
        "that stood still starts slowly",
        "1 for a held reading, 0 for a plant that sticks",
    )
    above_step: float = _number(3.0, "and over the step of the readings: an encoder repeats too", "noise adds a step")
    coarse: float = _number(2.0, "step of the readings over their noise from which it is worth a word", "r hides less")
    still: int = _number(20, "equal readings in a row from which a sensor may be stuck", "as before")
    brief: int = _number(
        10,
        "and where the signal was on its way before them and went on at once",
        "ten times the length of one reading; 1 in 1000 equal to the next makes ten in a row by chance once in 1e24",
    )
    turns: float = _number(
        0.33,
        "share of the rows in which a signal turns back from which its sensor's noise moves it",
        "2 in 3 of white noise, next to none of a motion that is sampled well",
    )
    on_its_way: float = _number(
        0.2, "move that a signal at a rail was about to make, over its usual one", "0 for one that settles or sticks"
    )
    null: float = _number(
        1.2,
        "decades by which a null of a filter lies below what is usual to both sides of it",
        "0.79 once in 1e3 records of 1000 rows of white noise, 0.13 more for each power of ten: once in 1e6",
    )
    trend: float = _number(0.5, "share of a signal that its straight line may be before it is called a trend", "half")
    slow: float = _number(
        0.5,
        "share of half the sampling frequency that holds nearly all of the motion above which sampling is too slow",
        "Ljung 1999, sec. 13.7: ten samples over the rise; four in a period of the fastest motion are the least",
    )
    fast: float = _number(
        2e-3, "and below which neighbouring rows say the same", "500 rows in half a period of the fastest motion"
    )
    power: float = _number(0.99, "share of the motion that is meant", "a hundredth is left")
    mismatch: float = _number(
        1e-6, "level of the test that two records of one use follow one linear model", "Chow 1960, Econometrica 28:591"
    )
    worse: float = _number(
        1.3, "prediction error with the other record's model over the own one's, at least", "nobody would miss less"
    )
    shift: float = _number(
        15.0,
        "log-likelihood by which the equations of motion must prefer an input that is read a row earlier, to the "
        "record as it is and to half a row",
        "one in a million, twice",
    )


ODD = OddNumbers()


def described() -> dict[str, dict[str, Any]]:
    """Return every number with its reason and source.

    Examples
    --------
    >>> described()["rate"]["value"]
    1e-06
    """
    fields = OddNumbers.__dataclass_fields__
    return {name: {"value": getattr(ODD, name), **made.metadata} for name, made in fields.items()}
