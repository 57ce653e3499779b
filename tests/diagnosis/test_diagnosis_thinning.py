"""Records at the rate that their motion needs: nothing that matters is lost."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_form import placed
from made_fits import FORM, a_fit

from harness import api
from harness.diagnosis import close_loop
from harness.diagnosis.dictionary import laws_of
from harness.diagnosis.forms.remembered import Remembered
from harness.diagnosis.kinds import EquationsKind
from harness.diagnosis.policy import POLICY
from harness.diagnosis.records.thinning import hat_projection, local_cubics, thinned_by, thinned_dataset
from harness.diagnosis.report.refusals import refusals_text
from harness.diagnosis.runs.residual_tests import max_autocorrelation
from harness.diagnosis.search.compare import Judged
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.scores import ScoreTest
from harness.diagnosis.search.table import Accepted, Round
from harness.diagnosis.steps import all_readings, asked_by_all_readings, at_full_rate, form_of
from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.parts.files import make_plant
from harness.physics import Parameter
from harness.physics.compiled.sampled import delayed_between
from harness.physics.models import cart_pole
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.001)


def swing(noise: float, *, moving: bool = False) -> Dataset:
    runs = []
    for role, use in enumerate(("estimation", "validation")):
        t = np.arange(12000) * 0.001
        rng = np.random.default_rng(role)
        y = np.exp(-0.1 * t) * np.cos(8 * t) + noise * rng.standard_normal(t.size)
        u = rng.standard_normal((t.size, 1)) if moving else np.zeros((t.size, 1))
        runs.append(Run(Trajectory(t, u, y[:, None], SPEC), use))  # type: ignore[arg-type]
    return Dataset("swing", tuple(runs), noise={"theta": noise} if noise else {})


def test_a_free_swing_keeps_its_shape_and_says_what_was_done() -> None:
    thin = thinned_dataset(swing(0.0)).dataset
    run = thin.estimation[0]
    assert 0.005 <= thin.spec.sample_time <= 0.03
    np.testing.assert_allclose(run.y[:, 0], np.exp(-0.1 * run.t) * np.cos(8 * run.t), atol=2e-4)
    assert any("1000 Hz" in text for text in thin.warnings)


@pytest.mark.slow  # a whole loop
def test_the_repaired_model_of_a_thinned_record_runs_at_the_rate_of_the_record(tmp_path: Path) -> None:
    data = swing(1e-3)
    known = {"J": Parameter("J", "kg m^2", 0.1, fixed=True), "mgl": 6.4}
    drag = [builtin()["quadratic_drag"]]
    report = close_loop(data, "pendulum", parameters=known, dictionary=drag, out=tmp_path / "out")
    assert any("instead of 1000 Hz" in text for text in report.data["warnings"])
    assert json.loads((tmp_path / "out" / "model.json").read_text())["spec"]["sample_time"] == 0.001
    target = api.export(tmp_path / "out", out=tmp_path / "repaired.fmu")[0]
    system, n = report.model, 3000
    own = system.simulator(0.001).rollout(system.vector(), np.array([0.9, 0.0]), np.zeros((n, 1)))
    with make_plant(str(target), {}) as plant:
        assert plant.spec.sample_time == 0.001
        y = [plant.reset(rng=np.random.default_rng(0), x0={"state.theta": 0.9})]
        y += [plant.step(np.zeros(1)) for _ in range(n - 1)]
    np.testing.assert_allclose(np.array(y), own, rtol=0, atol=1e-9)


def test_the_noise_of_a_kept_reading_is_told_and_hardly_coloured() -> None:
    thin = thinned_dataset(swing(0.01))
    run = thin.dataset.estimation[0]
    rest = run.y[:, 0] - np.exp(-0.1 * run.t) * np.cos(8 * run.t)
    assert np.std(rest) == pytest.approx(thin.dataset.noise["theta"], rel=0.08)
    assert thin.noise[0] == pytest.approx(thin.dataset.noise["theta"] / 0.01)
    assert thin.noise[0] ** 2 < 0.5  # of what the rate told
    assert max_autocorrelation(rest) < 0.05 + 4 / np.sqrt(rest.size)


def test_an_input_that_no_line_between_kept_instants_follows_keeps_the_rate() -> None:
    assert thinned_dataset(swing(0.01, moving=True)).factor == 1


@given(seed=st.integers(0, 10_000), factor=st.integers(2, 12), jumps=st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_mass_is_at_every_kept_instant_where_the_input_as_it_was_takes_it(
    seed: int, factor: int, jumps: bool
) -> None:
    rng, h = np.random.default_rng(seed), 0.01
    n = factor * 40 + int(rng.integers(0, factor)) + 1
    u = np.repeat(rng.choice([-1.0, 1.0], n // 7 + 1), 7)[:n] if jumps else rng.standard_normal(n)
    speed = np.concatenate([[0.0], np.cumsum(u[:-1]) * h])
    place = np.concatenate([[0.0], np.cumsum(speed[:-1] * h + u[:-1] * h**2 / 2)])
    nodes, step = hat_projection(u[:, None], factor)[:, 0], factor * h
    a, b = nodes[:-1], nodes[1:]
    speeds = np.concatenate([[0.0], np.cumsum(step * (a + b) / 2)])
    places = np.concatenate([[0.0], np.cumsum(step * speeds[:-1] + step**2 * (a / 3 + b / 6))])
    np.testing.assert_allclose(places, place[::factor], rtol=0, atol=1e-12)


@given(seed=st.integers(0, 10_000), ripple=st.floats(0.0, 0.03))
@settings(max_examples=15, deadline=None)
def test_a_log_of_a_servo_is_thinned_as_far_as_its_exact_encoder_does_not_feel_it(seed: int, ripple: float) -> None:
    rng, h, decay, noise = np.random.default_rng(seed), 0.001, 2.0, 1e-7
    n = 12_000
    t = np.arange(n) * h
    swings = sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6.0)) for f in (0.3, 0.5, 0.8, 1.1))
    u = np.round(swings, 2) + ripple * rng.standard_normal(n)  # held from row to row, steps of a converter
    fade, reach = np.exp(-decay * h), -np.expm1(-decay * h) / decay
    speed, place = np.zeros(n), np.zeros(n)
    for k in range(n - 1):  # exact: a mass with a damper
        speed[k + 1] = fade * speed[k] + reach * u[k]
        place[k + 1] = place[k] + reach * speed[k] + (h - reach) / decay * u[k]
    y = place + noise * rng.standard_normal(n)
    spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), h)
    thin = thinned_dataset(Dataset("servo", (Run(Trajectory(t, u[:, None], y[:, None], spec)),)))
    assert thin.factor >= 15
    nodes, step = thin.dataset.estimation[0].u[:, 0], thin.factor * h
    fade, reach = np.exp(-decay * step), -np.expm1(-decay * step) / decay
    first, second = (step - reach) / decay, (step**2 / 2 - (step - reach) / decay) / decay / step
    run = [(0.0, 0.0)]
    for here, there in itertools.pairwise(nodes):
        v, q = run[-1]
        ramp = (there - here) / step
        run.append(
            (
                fade * v + reach * here + ramp * (step - reach) / decay,
                q + reach * v + first * here + second * step * ramp,
            )
        )
    missed = np.array(run)[:, 1] - place[:: thin.factor]
    assert np.std(missed) <= 0.15 * noise


@given(factor=st.integers(2, 8), period=st.sampled_from([None, 2 * np.pi]))
@settings(max_examples=20, deadline=None)
def test_a_reading_at_an_impact_is_kept_as_it_was(factor: int, period: float | None) -> None:
    t = np.arange(60 * factor) * 0.01
    rng = np.random.default_rng(factor)
    swings = 0.2 * np.abs(np.sin(2.0 * (t - 0.3))) + 1e-5 * rng.standard_normal(t.size)  # a ball under a ceiling
    found = local_cubics(swings, factor, factor, period)
    exact = 0.2 * np.abs(np.sin(2.0 * (t - 0.3)))[::factor]
    assert np.abs(found - exact).max() < 6e-5
    assert np.abs(found - exact).std() < 1e-5


def test_readings_are_averaged_only_so_far_as_no_corner_of_dry_friction_is_rounded() -> None:
    t = np.arange(10_000) * 0.002
    corners = 0.5 * np.cumsum(np.cumsum(np.sign(np.sin(3 * t)))) * 0.002**2
    spec = PlantSpec((), (Channel("q", "m"),), 0.002)
    shares = {}
    for noise in (1e-7, 1e-3):
        y = corners + noise * np.random.default_rng(3).standard_normal(t.size)
        data = Dataset("corners", (Run(Trajectory(t, np.zeros((t.size, 0)), y[:, None], spec)),))
        thin = thinned_by(data, 6)
        shares[noise] = thin.noise[0]
        rest = thin.dataset.estimation[0].y[:, 0] - corners[::6]
        assert np.std(rest) == pytest.approx(noise * thin.noise[0], rel=0.1)
    assert shares[1e-7] == 1.0
    assert shares[1e-3] < 0.5


def test_an_angle_that_goes_round_is_not_averaged_over_its_jump() -> None:
    t = np.arange(400) * 0.01
    turned = np.mod(3.0 * t + np.pi, 2 * np.pi) - np.pi
    spec = PlantSpec((), (Channel("theta", "rad", period=2 * np.pi),), 0.01)
    thin = thinned_by(Dataset("turns", (Run(Trajectory(t, np.zeros((400, 0)), turned[:, None], spec)),)), 5).dataset
    np.testing.assert_allclose(thin.estimation[0].y[:, 0], turned[::5], atol=1e-9)


def test_missing_readings_stay_missing_and_spoil_no_other() -> None:
    t = np.arange(200) * 0.01
    y = np.sin(3 * t)
    missing = np.zeros((200, 1), bool)
    missing[50], y[50] = True, 1e3
    spec = PlantSpec((), (Channel("q", "m"),), 0.01)
    record = Trajectory(t, np.zeros((200, 0)), y[:, None], spec, missing=missing)
    thin = thinned_by(Dataset("hole", (Run(record),)), 5).dataset.estimation[0]
    assert np.flatnonzero(np.isnan(thin.readings[:, 0])).tolist() == [10]
    kept = np.arange(40) != 10
    np.testing.assert_allclose(thin.y[kept, 0], np.sin(3 * thin.t[kept]), atol=1e-4)


@given(part=st.floats(0.0, 3.0), per_period=st.integers(20, 80))
@settings(max_examples=40, deadline=None)
def test_an_input_that_is_linear_between_samples_is_delayed_without_being_smoothed(
    part: float, per_period: int
) -> None:
    """A line between two samples would take (w dt)^2 / 8 of a sine, and look like a lag of the drive."""
    dt, omega = 0.1, 2 * np.pi / per_period / 0.1
    t = np.arange(200) * dt
    late, change = delayed_between(np.sin(omega * t), part * dt, dt)
    inside = slice(6, -2)
    np.testing.assert_allclose(late[inside], np.sin(omega * (t - part * dt))[inside], atol=0.03 * (omega * dt) ** 4)
    slope = -omega * np.cos(omega * (t - part * dt))
    np.testing.assert_allclose(change[inside], slope[inside], atol=0.1 * omega * (omega * dt) ** 2)


def test_all_readings_of_a_spinning_pole_tell_the_law_that_the_fewer_told() -> None:
    # nothing is left unexplained: states of the fewer, a row late, would be taken for the end of that law
    system, dt, n = cart_pole().system(), 0.004, 5000
    wave, rng = Placed(builtin()["periodic_disturbance"], "x"), np.random.default_rng(3)
    size = {wave.name("A"): 0.6, wave.name("omega"): 9.0, wave.name("phi"): 0.5}
    t = np.arange(n) * dt
    lines = 2 * np.pi * np.array([0.3, 0.7, 1.1, 1.9])
    u = [20 * np.sin(np.outer(t, lines) + rng.uniform(0, 6, 4)).sum(axis=1) for _ in range(2)]
    spec, kind, laws = PlantSpec((Channel("u", "N"),), system.outputs, dt), EquationsKind(), laws_of(None).dictionary

    def dataset(y: list[np.ndarray]) -> Dataset:
        pairs = zip(u, y, ("estimation", "validation"), strict=True)
        return Dataset("wave", tuple(Run(Trajectory(t, one[:, None], read, spec), use) for one, read, use in pairs))

    form, _ = form_of(kind, system, dataset([np.sin(np.outer(t, [3.0, 5.0])) for _ in u]), POLICY, laws)
    true = form.composed([wave])
    values = {**true.values(), **size}
    paths = [true.simulator(dt).rollout(true.vector(values), np.zeros(4), one[:, None]) for one in u]
    data = dataset([path + 1e-3 * rng.standard_normal(path.shape) for path in paths])
    thinned = kind.thinned(data)
    assert thinned.factor > 1
    form, _ = form_of(kind, system, thinned.dataset, POLICY, laws)
    fit = Remembered(form, None).fit([wave], [values], None)
    assert fit is not None
    told = at_full_rate(all_readings(kind, form, thinned, data, POLICY, None), Outcome(form, fit, fit)).model
    assert told is not fit
    for name, true_value in size.items():
        assert told.values[name] == pytest.approx(true_value, rel=5e-3)
        assert told.deviations[name] <= 1.02 * fit.deviations[name]


def test_a_value_on_a_bound_that_all_readings_set_is_one_of_the_repaired_model() -> None:
    """The width of a dry friction came out 0.2 % below the bound of the fewer readings: the report was refused."""
    dry = Placed(builtin()["coulomb_friction"], "x")
    width = dry.name("w")
    fewer, every = (compose(cart_pole().system(), [dry], sizes={"x": {"v": v}}) for v in (1.002, 1.0))
    assert every.parameter(width).minimum < fewer.parameter(width).minimum
    fit, found = (
        Fit((), system, system.values(), (), 0, {}, {}, frozenset(), converged=True, on_bound=())
        for system in (fewer, every.with_parameters({width: every.parameter(width).minimum}))
    )
    whole: Any = SimpleNamespace(anew=lambda model: found)
    told = at_full_rate(whole, Outcome(whole, fit, fit)).model
    assert told.model.with_parameters(told.values).values() == told.values


class Fitted:
    """Stands for a likelihood whose fits are known by the effects in them."""

    def __init__(self, gains: dict[tuple[str, ...], float], *, latent: bool) -> None:
        self.gains, self.form = gains, SimpleNamespace(latent=latent, damping=lambda fit, at: None)
        self.damping = self.form.damping

    def anew(self, fit: Fit) -> Fit | None:
        """Return the fit of the effects of another one."""
        return self.fit(fit.effects, [], None)

    def fit(self, effects: Sequence[Placed], starts: object, base: object) -> Fit | None:
        """Return the fit of some effects, none of those that are not known."""
        gain = self.gains.get(tuple(sorted(one.effect.name for one in effects)))
        return None if gain is None else a_fit(gains=(np.full(400, gain / 400), np.zeros(400)), effects=effects)


@pytest.mark.parametrize(
    ("gain", "latent", "kept"),
    [(40.0, False, True), (2.0, False, False), (-30.0, False, False), (2.0, True, True)],
)
def test_what_only_the_lower_rate_asks_for_is_dropped(gain: float, latent: bool, kept: bool) -> None:
    """A second effect stays where all readings ask for it, and where a thinned input takes a mass where it was."""
    drag, spring = placed("quadratic_drag"), placed("cubic_spring")
    thin = Fitted({("quadratic_drag",): 100.0, ("cubic_spring", "quadratic_drag"): 200.0}, latent=latent)
    whole = Fitted({("quadratic_drag",): 100.0, ("cubic_spring", "quadratic_drag"): 100.0 + gain}, latent=latent)
    model = thin.fit([drag, spring], [], None)
    assert model is not None
    accepted = tuple(Accepted(one, ((one,),), 100.0, 0.0) for one in (drag, spring))
    rounds = tuple(Round(model, ScoreTest([], []), (Judged((one,), model, None, ()),)) for one in (drag, spring))
    before = Outcome(FORM, a_fit(), model, accepted, rounds)
    found = asked_by_all_readings(thin, whole, before, POLICY)  # type: ignore[arg-type]
    assert [str(one.placed) for one in found.accepted] == [str(drag), *[str(spring)] * kept]
    assert len(found.model.effects) == 1 + kept
    refused = [row for past in found.rounds for row in past.candidates if row.refusals]
    assert [row.name for row in refused] == [str(spring)] * (not kept)
    assert not refused or f"of all readings it gains {gain:.1f}" in refusals_text(refused[0].refusals)
