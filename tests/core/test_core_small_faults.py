"""Figures computed by hand where a factor, a sign, a window or an off-by-one would go unseen elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, timedelta
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.diagnosis.policy import POLICY
from harness.diagnosis.search.coloured import Before
from harness.diagnosis.search.leftover import Axis, Leftover, _Beside, _Explained
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.rounding import with_rounding
from harness.diagnosis.search.scores import Lead, ScoreTest, score_test
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.fleet.row import FleetRow, FoundEffect, fill
from harness.fleet.trends import new_effects, series_of, trends
from harness.protocols import Hindsight
from harness.scoring import errors, predict
from harness.scoring.regret import Regret, _curve, _first
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from harness.units import base_units, convert

# ---- units

SCALES = {
    "degC": ({"K": 1}, 1.0, 273.15),
    "degF": ({"K": 1}, 5 / 9, 459.67 * 5 / 9),
    "deg": ({"rad": 1}, np.pi / 180, 0.0),
    "mm": ({"m": 1}, 1e-3, 0.0),
    "bar": ({"kg": 1, "m": -1, "s": -2}, 1e5, 0.0),
    "rpm": ({"rad": 1, "s": -1}, np.pi / 30, 0.0),
    "kN": ({"kg": 1, "m": 1, "s": -2}, 1e3, 0.0),
    "h": ({"s": 1}, 3600.0, 0.0),
    "kg/m^3": ({"kg": 1, "m": -3}, 1.0, 0.0),
}


@pytest.mark.parametrize("unit", SCALES)
def test_a_unit_in_base_units_has_this_factor_and_offset(unit: str) -> None:
    powers, factor, offset = base_units(unit)
    wanted, scale, shift = SCALES[unit]
    assert powers == wanted
    assert (factor, offset) == pytest.approx((scale, shift), rel=1e-12, abs=1e-12)


@given(st.sampled_from(["degC", "degF"]), st.floats(-200.0, 500.0))
def test_factor_and_offset_do_what_the_conversion_does(unit: str, value: float) -> None:
    _, factor, offset = base_units(unit)
    assert convert(np.array([value]), unit, "K")[0] == pytest.approx(factor * value + offset, abs=1e-9)


@pytest.mark.parametrize(
    ("value", "unit", "target", "wanted"),
    [
        (1.0, "M", "1", 1e6),
        (1.0, "cm4", "m^4", 1e-8),
        (2.0, "1/degC", "1/K", 2.0),
        (9.0, "degF^2", "K^2", 25 / 9),
        (9.0, "J/degF", "J/K", 16.2),
        (1.0, "kgcm2", "kg m^2", 1e-4),
    ],
)
def test_a_conversion_by_hand(value: float, unit: str, target: str, wanted: float) -> None:
    assert convert(np.array([value]), unit, target)[0] == pytest.approx(wanted, rel=1e-12)


# ---- fleet


def found(name: str, size: float, half: float, ties: tuple[str, ...] = ()) -> FoundEffect:
    effect, _, at = name.partition("@")
    return FoundEffect(effect, at, "Fc", size, size - half, size + half, "N m", ties, ("Fc",), (size,), (size - half,),
                 (size + half,), ("N m",))  # fmt: skip


def on_day(day: int, *effects: FoundEffect) -> FleetRow:
    when = (date(2026, 1, 1) + timedelta(days=day)).isoformat()
    return FleetRow(job=str(day), record=str(day), file="", date=when, effects=effects)


def test_the_interval_of_a_slope_by_hand() -> None:
    """Exact sizes on days 0 to 4: deviation 0.01 / 1.96, spread of the days 10, Student's t of 3 degrees."""
    (trend,) = trends(series_of([on_day(d, found("friction@q", 0.1 + 0.02 * d, 0.01)) for d in range(5)]))
    half = 3.182446305284263 * 0.01 / 1.959963984540054 / np.sqrt(10.0)
    assert (trend.slope, trend.low, trend.high) == pytest.approx((0.02, 0.02 - half, 0.02 + half), rel=1e-7)
    assert trend.word == "grows"


def test_records_that_scatter_more_than_they_say_have_a_wider_slope() -> None:
    sizes = [0.1, 0.3, 0.1, 0.3, 0.1]  # no slope; misses 0.08 and 0.12 around the mean 0.18
    (trend,) = trends(series_of([on_day(d, found("friction@q", s, 0.01)) for d, s in enumerate(sizes)]))
    half = 3.182446305284263 * np.sqrt((3 * 0.08**2 + 2 * 0.12**2) / 3) / np.sqrt(10.0)
    assert (trend.slope, trend.high) == pytest.approx((0.0, half), rel=1e-6, abs=1e-12)


def test_another_name_of_what_was_there_is_not_new() -> None:
    rows = [on_day(0, found("coulomb@q", 0.1, 0.01)), on_day(1, found("stribeck@q", 0.1, 0.01, ties=("coulomb@q",)))]
    assert new_effects(rows) == []
    assert [one.effect.name for one in new_effects([rows[0], on_day(1, found("stribeck@q", 0.1, 0.01))])] == [
        "stribeck@q"
    ]


def test_the_error_of_a_row_is_that_of_the_worst_output() -> None:
    row = on_day(0)
    after = {"a": {"nrmse": 0.2}, "b": {"nrmse": 0.5}, "c": {"nrmse": None}}
    errors_of = {when: {"simulation_error": {"validation": after}} for when in ("before", "after")}
    fill(row, {"verdict": "explained", "errors": errors_of, "effects": [], "tie_sets": []})
    assert (row.error_before, row.error_after) == (0.5, 0.5)


# ---- scoring

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)


def record(y: Any, u: Any = None, spec: PlantSpec = SPEC) -> Trajectory:
    y = np.asarray(y, dtype=float).reshape(-1, spec.ny)
    u = np.zeros((len(y), spec.nu)) if u is None else np.asarray(u, dtype=float).reshape(len(y), spec.nu)
    return Trajectory(np.arange(len(y)) * spec.sample_time, u, y, spec)


@dataclass(frozen=True)
class Through:
    """x+ = x, y = x + d u: an output that the input reaches at once."""

    d: float = 0.0
    spec: PlantSpec = SPEC
    burn_in: int = 0

    def initial_state(self, data: Trajectory) -> FloatArray:
        return np.array(data.y[0])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return x + self.d * u

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return x

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return np.array(y) - self.d * u

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "through"}


def test_a_window_has_as_many_samples_as_its_seconds_say() -> None:
    """0.3 s at 0.1 s are 3 samples, although 0.3 / 0.1 is a little less."""
    miss, _ = errors(Through(), record([1, 2, 3, 4, 5, 6, 7]), 0.3)
    assert miss[:, 0].tolist() == [0, 1, 2, 0, 1, 2, 0]


@pytest.mark.parametrize("horizon", [1, 2])
def test_a_prediction_sees_the_input_of_its_own_sample(horizon: int) -> None:
    u = [1.0, 5.0, 2.0, 7.0, 3.0]
    data = record(np.add(1.0, np.multiply(2.0, u)), u)
    ahead = predict(Through(d=2.0), data, horizon)
    assert np.isnan(ahead[:horizon]).all()
    np.testing.assert_allclose(ahead[horizon:], data.y[horizon:])


def test_the_first_samples_of_a_stream_go_over_its_seams() -> None:
    parts = _first([record([0, 1, 2]), record([3, 4, 5])], 3)
    assert [part.y[:, 0].tolist() for part in parts] == [[0, 1, 2], [3, 4]]
    assert [len(part) for part in _first([record([0, 1, 2]), record([3, 4, 5])], 2)] == [3]


def test_the_slope_of_a_regret_begins_with_its_burn_in() -> None:
    steps = np.array([1.0, 10.0, 100.0, 1000.0])
    curve = np.array([50.0, *(3.0 * np.log(steps[1:]))])
    regret = Regret(np.ones(1000), np.ones(1000), True, steps, curve)
    assert regret.slope(10) == pytest.approx(3.0)
    with pytest.raises(FitError):
        regret.slope(11)


def test_the_curve_of_a_regret_counts_the_losses_up_to_each_length() -> None:
    def hindsight(records: list[Trajectory]) -> Hindsight:
        return Hindsight(np.zeros(sum(len(one) - 1 for one in records)), True)

    online: Any = SimpleNamespace(hindsight=hindsight)
    steps, curve = _curve(online, [record([0, 0, 0]), record([0, 0, 0])], np.array([1.0, 2.0, 4.0, 8.0]), np.ones(1), 3)
    assert steps.tolist() == [1, 2, 4]
    assert curve.tolist() == [1, 3, 15]


# ---- search


def axis(evidence: float, validation: float, error: float, *, drifts: bool = False) -> Axis:
    return Axis("q", evidence, validation, error, (), np.zeros(0), drifts)


def test_a_drift_is_left_over_by_twice_the_evidence_of_an_effect_in_both_uses() -> None:
    enough = 2 * POLICY.evidence
    error = 0.5 * enough / POLICY.tie_z
    assert Leftover((axis(1.01 * enough, 1.01 * enough, error, drifts=True),)).best is not None
    assert Leftover((axis(0.99 * enough, 9 * enough, error, drifts=True),)).best is None
    assert Leftover((axis(9 * enough, 0.99 * enough, error, drifts=True),)).best is None
    assert Leftover((axis(9 * enough, 1.01 * enough, 2.03 * error, drifts=True),)).best is None


def test_the_gain_of_a_free_force_and_its_error_over_blocks_by_hand() -> None:
    n = 4 * POLICY.blocks
    rng = np.random.default_rng(0)
    unit = np.ones(n) / np.sqrt(n)
    column: Any = SimpleNamespace(estimation=unit[:, None], validation=np.ones((n, 1)), names=("q", "k"), kind="linear")
    residual = {"estimation": -50.0 * unit, "validation": rng.standard_normal(n) - 4.0}
    linear: Any = SimpleNamespace(
        nuisance={use: np.zeros((n, 0)) for use in residual}, residual=residual, shared=0, moved=np.zeros(0),
        spread=np.zeros((0, 0)),
    )  # fmt: skip
    beside = _Beside.of(linear, np.zeros((n, 0)), residual["estimation"])
    got = _Explained.of(column, beside, linear, POLICY).axis
    force = float(got.values[0])
    assert 45.0 < force < 50.0  # shrunk a little
    after = residual["validation"] + force
    gains = (0.5 * (residual["validation"] ** 2 - after**2)).reshape(POLICY.blocks, -1).sum(axis=1)
    assert got.validation == pytest.approx(gains.sum())
    assert got.error == pytest.approx(
        np.sqrt(POLICY.blocks / (POLICY.blocks - 1) * ((gains - gains.mean()) ** 2).sum())
    )


def test_rows_behind_a_long_gap_are_forgotten_and_those_behind_a_short_one_are_not() -> None:
    for gap, known in ((1000, True), (2000, True), (2001, False)):  # rows
        counts = np.zeros(gap + 1)
        counts[[0, gap]] = 1.0
        before = Before.of(counts, 1)
        assert before.lags[before.kind[1], 0] == (gap if known else 0)


def lead(name: str, span: FloatArray, direction: FloatArray) -> Lead:
    return Lead(Placed(builtin()["viscous_friction"], name), 1.0, 1.0, 1.0, ({},), direction, span, direction)


def test_a_narrow_effect_is_mimicked_by_a_wide_one_and_not_the_other_way_round() -> None:
    e = np.eye(3)
    narrow = lead("a", e[:, :1], e[0])
    wide = lead("b", e[:, :2], (e[0] + e[1]) / np.sqrt(2))
    names, cosines = ScoreTest([narrow, wide], []).cosines()
    assert [name.rpartition("@")[2] for name in names] == ["a", "b"]
    np.testing.assert_allclose(cosines, [[1.0, 1.0], [np.sqrt(0.5), 1.0]])


def test_a_lead_pays_half_the_logarithm_of_the_samples_for_each_parameter() -> None:
    n = 400
    unit = np.eye(n)[:, 0]
    nothing = {use: np.zeros((n, 0)) for use in ("estimation", "validation")}
    linear = SimpleNamespace(
        residual={"estimation": -6.0 * unit, "validation": np.zeros(n)}, nuisance=nothing, names=(), states={}, shared=0
    )
    placed = Placed(builtin()["viscous_friction"], "q")
    column = SimpleNamespace(placed=placed, given={}, names=placed.effect.parameter_names[:1], estimation=unit[:, None],
                             validation=np.zeros((0, 1)), kind="linear")  # fmt: skip
    form: Any = SimpleNamespace(linearised=lambda fit: linear, columns=lambda fit, candidates: [column])
    fit: Any = SimpleNamespace(samples=n, values={})
    (only,) = score_test(form, fit, [placed]).leads
    free = sum(not parameter.fixed for parameter in placed.effect.parameters)
    assert only.gain == pytest.approx(18.0)
    assert only.penalised == pytest.approx(18.0 - 0.5 * free * np.log(n))


@pytest.mark.parametrize(("share", "named"), [(1.5, True), (0.6, False)])
def test_rounding_is_named_from_its_share_of_the_noise_on(share: float, named: bool) -> None:
    """A grid of 0.1 has the power 0.1^2 / 12; the readings lie on it in both uses, which is evidence for it."""
    readings = np.round(np.random.default_rng(0).standard_normal((400, 1)), 1)
    noise = np.sqrt(0.1**2 / 12 / (share * POLICY.rounding))
    (effect,) = (one for one in builtin().values() if one.sampled == "quantise")
    placed = Placed(effect, "y")
    run = SimpleNamespace(y=readings)
    dataset: Any = SimpleNamespace(spec=SPEC, estimation=[run], validation=[run])
    terms = {use: [readings[:, 0]] for use in ("estimation", "validation")}
    model = SimpleNamespace(effects=[], values={}, terms=terms)
    form: Any = SimpleNamespace(fit=lambda effects, starts, base: base)
    nothing: Any = model
    outcome = with_rounding(
        form, Outcome(form, nothing, nothing), dataset, [placed], noise_of=lambda fit: np.array([noise])
    )
    assert [one.placed for one in outcome.accepted] == [placed] * named
    for one in outcome.accepted:
        assert one.evidence == one.validation == pytest.approx(-400 * np.log(POLICY.chance))
