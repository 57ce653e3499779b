"""What rows come to: medians and quartiles of each plant x scenario x identifier, who leads, and the ranks."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.benchmark.row import Row
from harness.benchmark.statistics import MARGIN, Ranking, Standing, enough_pairs, ranking, replicates, standings

SCORES = (
    "equation_error",
    "simulation_error",
    "log_score",
    "coverage",
    "regret",
    "regret_over_theory",
    "log_regret",
    "control_score",
    "predictive_cost",
    "control_regret",
    "noise_floor",
    "fit_seconds",
    "memory_mib",
)
CONTROL = ("control score", "MPC cost", "control regret", "model for control")
"""Columns that stand there only where a suite asks for them (``score.control``)."""
OPTIONAL = {
    "log_score": "log score",
    "coverage": "90 % sets hold",
    "regret_over_theory": "regret's rise over theory's",
    "log_regret": "log regret",
}
"""Scores with a column only where a line has them, and its title: of predicted distributions, and of rates."""
BASELINES = ("true-model",)  # Identifiers that know the truth: they show what is possible and do not compete.


@dataclass(frozen=True)
class Quartiles:
    """Median and quartiles of a score over seeds."""

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{figure(self.median)} [{figure(self.low)}, {figure(self.high)}]"


@dataclass(frozen=True)
class Summary:
    """One line of the table: all seeds of one plant, scenario and identifier."""

    plant: str
    scenario: str
    identifier: str
    ok: int
    run: int
    equation_error: Quartiles | None
    simulation_error: Quartiles | None
    log_score: Quartiles | None
    coverage: Quartiles | None
    regret: Quartiles | None
    regret_over_theory: Quartiles | None
    log_regret: Quartiles | None
    control_score: Quartiles | None
    predictive_cost: Quartiles | None
    control_regret: Quartiles | None
    noise_floor: Quartiles | None
    best_possible: Quartiles | None
    """The least simulation error to be expected: the Cramer-Rao bound, or else the noise floor."""
    over_best: Quartiles | None  # Simulation error over the best possible of its own seed: 1 is as good as can be.
    least_equation_error: Quartiles | None  # The least equation error to be expected, where the plant is linear.
    bound: str  # What the best possible is: ``"Cramer-Rao"``, ``"noise"``, or nothing where there is none.
    fit_seconds: Quartiles | None
    memory_mib: Quartiles | None
    standing: Standing | None
    """How its simulation error stands against the least of its plant and scenario; None where it does not compete."""
    problems: tuple[tuple[str, str, int], ...]
    """(status, reason, count) of the rows that are not ok, the most frequent first."""
    control: str
    """What is said of the models for control: how many states are controllable and observable, or why no score."""

    @property
    def leading(self) -> bool:
        """True for the least simulation error of a plant and scenario and those that tie with it."""
        return self.standing is not None and self.standing.marked


def optional_scores(lines: Sequence[Summary]) -> dict[str, str]:
    """Return the scores that not every model has and some line does, with the title of their column."""
    return {name: title for name, title in OPTIONAL.items() if any(getattr(line, name) for line in lines)}


def figure(value: float | None, digits: int = 3) -> str:
    """Return a score with a few significant digits, as short as can be.

    Examples
    --------
    >>> figure(0.012345), figure(0.00012345), figure(12345.0), figure(1234.5), figure(1.0), figure(None)
    ('0.0123', '1.23e-4', '1.23e4', '1234', '1', '-')
    """
    if value is None:
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        text = f"{value:.{digits}g}"
        return text if "e" not in text else f"{value:.0f}"
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    return f"{mantissa}e{int(exponent)}"


def summarise(rows: Sequence[Row], cells: Sequence[tuple[str, str, str]] = ()) -> list[Summary]:
    """Return one summary for each plant x scenario x identifier, in the order of ``cells``, then of the rows.

    Medians are over the rows with status ``ok``; the noise floor is that of all rows.
    """
    grouped: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for cell in cells:
        grouped[cell] = []
    for row in rows:
        grouped[row.plant, row.scenario, row.identifier].append(row)
    result = []
    stands = _standings(grouped)
    for (plant, scenario, identifier), own in grouped.items():
        good = [row for row in own if row.status == "ok"]
        scores = {name: _quartiles([getattr(row, name) for row in good]) for name in SCORES}
        scores["noise_floor"] = _quartiles([row.noise_floor for row in own])
        scores["least_equation_error"] = _quartiles([row.least_equation_error for row in own])
        scores["best_possible"] = _quartiles([best_possible(row) for row in own])
        pairs = [(row.simulation_error, best_possible(row)) for row in good]
        scores["over_best"] = _quartiles([error / best for error, best in pairs if error and best])
        faults = Counter((row.status, row.reason) for row in own if row.status != "ok")
        problems = tuple((status, reason, n) for (status, reason), n in faults.most_common())
        result.append(
            Summary(
                plant,
                scenario,
                identifier,
                len(good),
                len(own),
                **scores,
                bound=_bound(own),
                standing=stands.get((plant, scenario, identifier)),
                problems=problems,
                control=_control_text(good),
            )
        )
    return result


def best_possible(row: Row) -> float | None:
    """Return the least simulation error to be expected: the Cramer-Rao bound where there is one, or the noise floor."""
    return row.noise_floor if row.least_simulation_error is None else row.least_simulation_error


def _bound(own: Sequence[Row]) -> str:
    """Return what the best possible of some rows is."""
    if any(row.least_simulation_error is not None for row in own):
        return "Cramer-Rao"
    return "noise" if any(row.noise_floor is not None for row in own) else ""


def _control_text(good: Sequence[Row]) -> str:
    """Return what most rows say of control."""
    texts: Counter[str] = Counter()
    for row in good:
        if row.model_order is None:
            texts[row.control_status] += 1
            continue
        text = f"{row.controllable} controllable and {row.observable} observable of {row.model_order}"
        text += "" if row.stabilisable else ", not stabilisable"
        text += "" if row.detectable else ", not detectable"
        texts[text if row.control_status == "ok" else f"{row.control_status}; {text}"] += 1
    return max(texts, key=texts.__getitem__, default="")


def _standings(
    grouped: Mapping[tuple[str, str, str], Sequence[Row]],
) -> dict[tuple[str, str, str], Standing]:
    """Return how lines stand in their plant and scenario, over the replicates that all of its identifiers have."""
    places: dict[tuple[str, str], dict[str, Sequence[Row]]] = defaultdict(dict)
    for (plant, scenario, identifier), rows in grouped.items():
        if identifier not in BASELINES and any(row.simulation_error is not None for row in rows):
            places[plant, scenario][identifier] = rows
    return {
        (plant, scenario, name): standing
        for (plant, scenario), own in places.items()
        for name, standing in standings(_paired(own)).items()
    }


def pairs_in_words(lines: Sequence[Summary]) -> str:
    """Return the test behind the marks of a table in words, with its number of pairs and its power.

    Examples
    --------
    >>> pairs_in_words([])
    'No line is marked: nothing is compared.'
    """
    compared = [line.standing for line in lines if line.standing is not None and line.standing.others]
    if not compared:
        return "No line is marked: nothing is compared."
    pairs = sorted({one.pairs for one in compared})
    span = str(pairs[0]) if len(pairs) == 1 else f"{pairs[0]} to {pairs[-1]}"
    short = sum(one.pairs < enough_pairs(one.others) for one in compared)
    text = (
        f"Marked: the least error of a plant and scenario, and those not told from it by a paired sign test over "
        f"{span} replicates (5 %, Holm over the group) whose 95 % interval of the median ratio stays below {MARGIN:g}."
    )
    if short:
        needed = max(enough_pairs(one.others) for one in compared)
        text += (
            f" {short} of {len(compared)} lines have too few replicates to be told from the best or tied with it (up "
            f"to {needed} needed)."
        )
    return text


def _paired(own: Mapping[str, Sequence[Row]]) -> dict[str, list[float | None]]:
    """Return the simulation errors by identifier over replicates that all have run; None where a cell is not ok."""
    by_seed = {
        name: {row.seed: row.simulation_error if row.status == "ok" else None for row in rows}
        for name, rows in own.items()
    }
    seeds = sorted(set.intersection(*(set(scores) for scores in by_seed.values())))
    return replicates({name: {seed: scores[seed] for seed in seeds} for name, scores in by_seed.items()})


def places_of(lines: Sequence[Summary]) -> list[tuple[str, str, list[Summary]]]:
    """Return the summaries grouped by plant and scenario."""
    grouped: dict[tuple[str, str], list[Summary]] = {}
    for line in lines:
        grouped.setdefault((line.plant, line.scenario), []).append(line)
    return [(plant, scenario, own) for (plant, scenario), own in grouped.items()]


def rankings(rows: Sequence[Row]) -> list[Ranking]:
    """Return a ranking for each set of identifiers that meet in the same plants and scenarios.

    Blocks are plant x scenario x replicate (seeds between which something differs). Identifiers without a simulation
    error anywhere (online ones) do not take part, nor does the true model.
    """
    places: dict[tuple[str, str], dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        if row.identifier not in BASELINES:
            places[row.plant, row.scenario][row.identifier].append(row)
    families: dict[frozenset[str], list[tuple[str, str]]] = defaultdict(list)
    for place, own in places.items():
        taking = frozenset(n for n, found in own.items() if any(row.simulation_error is not None for row in found))
        families[taking].append(place)
    result = []
    for names, where in families.items():
        blocks: list[dict[str, float | None]] = []
        for place in where:
            table = _paired({name: places[place][name] for name in names}) if names else {}
            blocks += [dict(zip(table, values, strict=True)) for values in zip(*table.values(), strict=True)]
        made = ranking(blocks, [f"{plant} x {scenario}" for plant, scenario in where])
        if made is not None:
            result.append(made)
    return result


def _quartiles(values: Sequence[float | None]) -> Quartiles | None:
    """Return median and quartiles of the values that exist, or None."""
    numbers = [value for value in values if value is not None]
    if not numbers:
        return None
    low, median, high = np.quantile(numbers, [0.25, 0.5, 0.75])
    return Quartiles(float(median), float(low), float(high))
