"""Plants whose state jumps: instants, guard and reset against the truth, of engines that are not the identifier's."""

from __future__ import annotations

import functools
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import FitError, InputError, PlantError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.scoring import equation_error, simulation_error
from harness.scoring.regret import regret
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.hybrid.automaton import HybridAutomaton, HybridModel, grouped
from identifiers.hybrid.jumps import find_jumps
from identifiers.hybrid.piecewise_affine import PiecewiseAffine, PiecewiseAffineModel
from identifiers.online.leader import FollowTheLeader
from plants.pymunk.bouncing_mass import PymunkBouncingMass
from plants.pymunk.compass_gait import PymunkCompassGait

SWAPS = (("stance", "swing"),)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@functools.cache
def bounces(noise: float) -> tuple[Trajectory, Trajectory]:
    push = create("scenarios", "multisine", duration=20.0, amplitude=6.0, band=[0.1, 3.0], noise=noise)
    plant, streams = create("plants", "bouncing-mass-pymunk"), Streams("bouncing-mass", "multisine", 0)
    first, second = (run(plant, push, streams=streams, role=f"{role}/0") for role in ("estimation", "validation"))
    return first, second


@functools.cache
def walks(count: int, seed: int, pushed: float = 0.6) -> list[Trajectory]:
    """Return walks from states near the limit cycle, those that do not fall."""
    plant, draw, found = PymunkCompassGait(substeps=50), rng(seed), []
    names = [channel.name for channel in plant.spec.states]
    start = np.array([0.2187, -0.3234, -1.0918, -0.3772])
    while len(found) < count:
        spread = draw.normal(size=4) * np.array([0.02, 0.02, 0.06, 0.06]) * (pushed > 0)
        first = plant.reset(rng=draw, x0=dict(zip(names, start + spread, strict=True)))
        u = np.repeat(draw.uniform(-pushed, pushed, size=35), 10)[:, None]
        try:
            rows = np.vstack([first, plant.rollout(u[:-1])])
        except PlantError:  # the walker fell over
            continue
        found.append(Trajectory(0.01 * np.arange(350), u, rows, plant.spec))
    return found


def struck(x: FloatArray) -> FloatArray:
    """Return the state after a strike: momentum about the new foot and of the other leg about the hip is kept.

    Goswami et al. 1998, appendix, for legs of 5 kg half-way along 1 m and a hip of 10 kg.
    """
    c = math.cos(x[1] - x[0])
    before = np.array([[-1.25, -1.25 + 15.0 * c], [0.0, -1.25]])
    after = np.array([[2.5 * (0.5 - c), 5.0 * (1.0 - 0.5 * c) + 11.25], [1.25, -2.5 * c]])
    swing_rate, stance_rate = np.linalg.solve(after, before @ np.array([x[3], x[2]]))
    return np.array([x[1], x[0], stance_rate, swing_rate])


def test_the_engine_walks_as_was_published():
    """Goswami et al. 1998: steps of 0.734 s at 3 degrees, and impacts that keep angular momentum."""
    with pytest.raises(InputError, match="restitution"):
        PymunkBouncingMass(restitution=1.2)
    walker = PymunkCompassGait(sample_time=5e-4, substeps=5)
    x = np.vstack([walker.reset(rng=rng()), walker.rollout(np.zeros((3100, 1)))])
    strikes = np.flatnonzero(np.abs(np.diff(x[:, 0])) > 0.3)
    assert np.diff(strikes) * 5e-4 == pytest.approx(0.734, abs=0.002)
    for k in strikes:  # within the 0.5 ms between the two rows
        assert x[k + 1] == pytest.approx(struck(x[k]), abs=6e-3)
        assert x[k, 0] + x[k, 1] == pytest.approx(-2 * walker.slope, abs=2e-3)


@pytest.mark.slow
def test_beyond_the_published_bifurcation_short_and_long_steps_alternate():
    """Goswami et al. 1998, fig. 8: beyond 4.37 degrees a period doubles (40 s of an engine: slow)."""
    openings = {}
    for degrees in (3.0, 4.8):
        walker = PymunkCompassGait(slope=math.radians(degrees), substeps=50)
        x = np.vstack([walker.reset(rng=rng()), walker.rollout(np.zeros((2000, 1)))])
        strikes = np.flatnonzero(np.abs(np.diff(x[:, 0])) > 0.3)[-8:]
        openings[degrees] = x[strikes + 1, 0] - x[strikes + 1, 1]
    assert np.ptp(openings[3.0]) < 0.01
    assert np.abs(np.diff(openings[4.8])).min() > 0.05
    assert np.abs(openings[4.8][2:] - openings[4.8][:-2]).max() < 0.02


@pytest.mark.parametrize(("noise", "within"), [(0.0, 1e-3), (1e-3, 5e-3)])
def test_a_bouncing_mass_of_another_engine(noise, within):
    data, held = bounces(noise)
    model = HybridAutomaton().fit([data.measured()], rng=rng())
    assert model.resets[0, 1, 1] == pytest.approx(-0.8, abs=within)
    assert model.guards[0, 0] == 1.0
    assert -model.guards[0, 2] == pytest.approx(0.0, abs=within)
    truth = (held.x[:-1, 1] < 0) & (held.x[1:, 1] > 0) & (held.x[:-1, 0] < 0.05)
    found = model.jumps(np.hstack([held.x[:-1], held.u[:-1]]))
    assert truth.sum() > 20
    assert (truth & found).sum() / (truth | found).sum() > 0.9
    assert "warning" not in model.notes
    again = HybridModel.from_dict(model.to_dict())
    assert again.resets.tolist() == model.resets.tolist()
    if noise == 0.0:
        pieces = PiecewiseAffine(starts=1).fit([data.measured()], rng=rng())
        assert (equation_error(model, held).rms < 0.95 * equation_error(pieces, held).rms).all()
        assert (simulation_error(model, held[:200]).nrmse < 0.2).all()


@pytest.mark.slow
def test_floor_and_ceiling_of_another_engine_are_two_guards_with_a_reset_each():
    push = create("scenarios", "multisine", duration=20.0, amplitude=18.0, band=[0.1, 3.0], noise=5e-4)
    plant = create("plants", "bouncing-mass-pymunk", ceiling=0.5, u_limit=20.0, substeps=30)
    data = run(plant, push, streams=Streams("between", "multisine", 0)).measured()
    model = HybridAutomaton(starts=1).fit([data], rng=rng())
    assert len(model.guards) == 2
    floor, ceiling = sorted(range(2), key=lambda g: -model.guards[g, 0])
    assert model.guards[floor] == pytest.approx([1.0, 0.0, 0.0], abs=3e-3)
    assert model.guards[ceiling] == pytest.approx([-1.0, 0.0, 0.5], abs=3e-3)
    assert [model.resets[g, 1, 1] for g in (floor, ceiling)] == pytest.approx([-0.8, -0.5], abs=0.02)
    assert model.notes["jumps told by the guards"] > 0.8
    assert HybridModel.from_dict(model.to_dict()).findings == model.findings
    assert sum("falls through 0" in line for line in model.findings) == 2
    assert len(HybridAutomaton(starts=1, guards=1).fit([data], rng=rng()).guards) == 1


def test_several_walls_in_one_sample_and_a_corner_of_two_lines():
    """A point between two walls without loss, 0.1 m apart at 25 m/s: five jumps in 0.02 s, known in closed form."""
    flow = _flight()
    turn = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    model = HybridModel(
        flow.spec, 1, flow.scaling, flow, np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.1]]),
        np.tile([0.0, 0.0, 1.0], (2, 1)), np.stack([turn, turn]), np.zeros(2),
    )  # fmt: skip
    assert model.ahead(np.array([[0.05, 25.0]]))[0][0] == pytest.approx([0.05, -25.0], abs=1e-6)
    draw = rng(3)
    along, wall = draw.uniform(0, 1, size=80), np.repeat([-1.0, 1.0], 40)
    corner = np.stack([wall * along, along], axis=1) + 1e-3 * draw.normal(size=(80, 2))
    of = grouped(corner, None, least=6, reset=20, rng=rng())
    assert np.mean((of == of[0]) == (wall < 0)) > 0.97, "a valley has two sides"


def _flight() -> PiecewiseAffineModel:
    """Return the step of a free point over 0.02 s, from flights with exact rows."""
    spec = PlantSpec((), (Channel("z", "m"), Channel("z_rate", "m/s")), 0.02)
    t = 0.02 * np.arange(41)
    flights = [
        Trajectory(t, np.zeros((41, 0)), np.stack([z + v * t, np.full(41, v)], axis=1), spec)
        for z, v in ((1.0, -0.7), (0.0, 25.0), (0.3, 0.2))
    ]
    return PiecewiseAffine(modes=1, least_excitation=0.0).fit(flights, rng=rng())


def test_a_compass_gait_its_guard_and_its_impact():
    recorded, plant = walks(8, 1), PymunkCompassGait()
    model = HybridAutomaton(swaps=SWAPS, starts=1).fit([one.measured() for one in recorded], rng=rng())
    assert model.guards[0] / model.guards[0, 0] == pytest.approx([1.0, 1.0, 0.0, 0.0, 2 * plant.slope], abs=5e-3)
    strikes = [(one.y[k], one.y[k + 1]) for one in walks(2, 2) for k in np.flatnonzero(abs(np.diff(one.y[:, 0])) > 0.2)]
    before = np.array([first for first, _ in strikes])
    right = np.array([struck(x) for x in before])
    given = np.hstack([before, np.ones((len(before), 1))]) @ model.resets[0].T
    assert np.abs(given - right)[:, :2].max() == 0.0, "the legs change names"
    assert np.sqrt(np.mean((given - right)[:, 2:] ** 2, axis=0)) == pytest.approx([0.0, 0.0], abs=0.05)
    for one in walks(2, 2):
        truth = np.abs(np.diff(one.y[:, 0])) > 0.2
        assert (model.jumps(np.hstack([one.y[:-1], one.u[:-1]])) == truth).all()


def test_it_says_when_the_records_do_not_suffice():
    noisy = [Trajectory(w.t, w.u, w.y + 1e-3 * rng().normal(size=w.y.shape), w.spec) for w in walks(2, 3, pushed=0.0)]
    with pytest.raises(FitError, match="all alike"):  # the limit cycle strikes at one place only
        HybridAutomaton(swaps=SWAPS, least_excitation=0.0).fit(noisy, rng=rng())
    data, _ = bounces(0.0)
    with pytest.raises(FitError, match="too few jumps"):
        HybridAutomaton().fit([data.measured()[:200]], rng=rng())
    assert "flow alone" in HybridAutomaton().fit([data.measured()[:34]], rng=rng()).notes["warning"]
    blind = PlantSpec(data.spec.inputs, data.spec.outputs[:1], data.spec.sample_time)
    with pytest.raises(FitError, match="rate"):
        HybridAutomaton().fit([Trajectory(data.t, data.u, data.y[:, :1], blind)], rng=rng())
    with pytest.raises(InputError, match="swaps"):
        HybridAutomaton(swaps=(("z", "w"),)).fit([data.measured()], rng=rng())
    with pytest.raises(FitError, match="50 guards"):
        HybridAutomaton(guards=50).fit([bounces(0.0)[0]], rng=rng())


@settings(max_examples=15, deadline=None)
@given(st.floats(0.3, 0.95), st.floats(5.0, 15.0), st.integers(0, 100))
def test_a_ball_is_timed_exactly_whatever_its_bounce(restitution, gravity, seed):
    """Ballistic flight in closed form: parabolas continue it exactly, so instants and both sides are exact."""
    fall = rng(seed).uniform(0.31, 0.49)
    v = gravity * fall
    t = 0.01 * np.arange(80)
    late = t > fall
    z = np.where(late, restitution * v * (t - fall) - 0.5 * gravity * (t - fall) ** 2, 0.5 * gravity * (fall**2 - t**2))
    rate = np.where(late, restitution * v - gravity * (t - fall), -gravity * t)
    spec = PlantSpec((), (Channel("z", "m"), Channel("z_rate", "m/s")), 0.01)
    record = Trajectory(t, np.zeros((80, 0)), np.stack([z, rate], axis=1), spec)
    jumps = find_jumps([record], np.array([0]), np.array([0, 1]))
    assert len(jumps) == 1
    assert 0.01 * (jumps[0].sample + jumps[0].instant) == pytest.approx(fall, abs=1e-7)
    assert jumps[0].after[1] / jumps[0].before[1] == pytest.approx(-restitution, abs=1e-6)


def three_modes(samples: int, seed: int, noise: float = 0.02) -> tuple[Trajectory, np.ndarray]:
    """Return the example of Bako, Boukharouba & Lecoeuche's kind: three affine modes in strips of the output."""
    draw, y = rng(seed), np.zeros(samples)
    u, modes = draw.uniform(-2, 2, samples), np.zeros(samples, dtype=int)
    for k in range(samples - 1):
        modes[k] = int(y[k] > -0.5) + int(y[k] > 0.5)
        a, b, c = ((-0.6, 0.8, -0.9), (0.9, 0.6, 0.0), (-0.4, 0.3, 0.7))[modes[k]]
        y[k + 1] = a * y[k] + b * u[k] + c + noise * draw.normal()
    spec = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
    return Trajectory(0.1 * np.arange(samples), u[:, None], y[:, None], spec), modes[:-1]


@pytest.mark.parametrize("choose", ["held-out", "bic"])
def test_the_number_of_modes_is_found(choose):
    data, _ = three_modes(1500, 0)
    model = PiecewiseAffine(modes=None, choose=choose, starts=3).fit([data], rng=rng())
    assert len(model.coefficients) == 3
    assert [row["modes"] for row in model.notes["criteria"]] == [1, 2, 3, 4, 5]
    y = np.zeros_like(data.u)
    for k in range(len(y) - 1):
        y[k + 1] = 0.6 * y[k] + data.u[k] + 0.1 * rng(k).normal()
    straight = Trajectory(data.t, data.u, y, data.spec)
    assert len(PiecewiseAffine(modes=None, choose=choose, starts=1).fit([straight], rng=rng()).coefficients) == 1


def test_a_tree_tells_the_modes_too_and_travels():
    data, _ = three_modes(1500, 0)
    held, modes = three_modes(800, 1)
    tree = PiecewiseAffine(modes=3, guards="tree", starts=3).fit([data], rng=rng())
    rows = np.hstack([held.y[:-1], held.u[:-1]])
    assert (tree.mode(rows) == modes).mean() > 0.97
    again = PiecewiseAffineModel.from_dict(tree.to_dict())
    assert (again.mode(rows) == tree.mode(rows)).all()
    with pytest.raises(InputError, match="guards"):
        PiecewiseAffine(guards="forest").fit([data], rng=rng())  # type: ignore[arg-type]


def test_online_its_average_regret_falls():
    data, _ = three_modes(900, 2, noise=0.1)
    online = FollowTheLeader("piecewise-affine", {"modes": 3, "starts": 2}, burn_in=60, growth=1.6)
    early, late = (regret(online, [data[:n]], rng=rng(), points=0).average for n in (150, 900))
    assert late < 0.5 * early


def test_guard_and_reset_are_said_as_equations():
    learn, _ = bounces(0.0005)
    found = HybridAutomaton().fit([learn.measured()], rng=rng()).findings
    assert found[0].startswith("jumps where z ")
    assert found[0].endswith("falls through 0")
    assert found[1] == "after a jump z = z"
    assert re.search(r"- 0\.(79|80)\d* z_rate", found[2])
    assert "told by the guard" in found[3]
