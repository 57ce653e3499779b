"""Hidden processes from records of observation, action and reward, and where processes spend their time."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import api
from harness.errors import FitError, InputError
from harness.models.analysis import Findings
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.signals import Dataset, Run, Trajectory
from identifiers.finite.information_states import InformationStates, windows_of
from identifiers.finite.occupation import Occupation, discounted_occupation, stationary, ulam
from plants.finite.tiger import TigerPomdp

DISCOUNT = 0.75


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@functools.cache
def heard(samples: int = 20_000) -> Trajectory:
    act = create("scenarios", "random-policy", samples=samples)
    return run(create("plants", "tiger-pomdp"), act, streams=Streams("tiger", "random-policy", 0))


@functools.cache
def found() -> Findings:
    data = Dataset("tiger", (Run(heard().measured()),))
    return InformationStates(memory=2, discount=DISCOUNT).of(data, rng=rng())


def tiger_values(discount: float, hearing: float = 0.85, points: int = 401) -> np.ndarray:
    """Return the optimal values on a fine grid of beliefs, from the equations of the process alone."""
    belief = np.linspace(0.0, 1.0, points)
    value = np.zeros(points)
    for _ in range(4000):
        left = belief * hearing + (1 - belief) * (1 - hearing)
        after = [belief * hearing / left, belief * (1 - hearing) / (1 - left)]
        listen = -1.0 + discount * sum(
            p * np.interp(b, belief, value) for p, b in zip((left, 1 - left), after, strict=True)
        )
        middle = discount * np.interp(0.5, belief, value)
        new = np.maximum.reduce(
            [listen, -100 * belief + 10 * (1 - belief) + middle, 10 * belief - 100 * (1 - belief) + middle]
        )
        if np.abs(new - value).max() < 1e-9:
            break
        value = new
    return value


def test_the_plant_is_the_published_process():
    with pytest.raises(InputError, match="hearing"):
        TigerPomdp(hearing=0.3)
    record = heard()
    right = record.x[1:, 0] == record.y[1:, 0]
    assert right[record.u[:-1, 0] == 0].mean() == pytest.approx(0.85, abs=0.01)
    assert right[record.u[:-1, 0] != 0].mean() == pytest.approx(0.5, abs=0.015)
    assert set(record.y[1:, 1]) == {-1.0, -100.0, 10.0}


def test_the_policy_learned_from_records_is_near_the_optimum_of_the_true_process():
    """The optimal value at even odds with discount 0.75 is 1.93 (Cassandra's solution of this process)."""
    best = tiger_values(DISCOUNT)[200]
    assert best == pytest.approx(1.93, abs=0.01)
    details = found().details
    windows = windows_of([heard().measured()], 2)
    plant, draw, returns = TigerPomdp(), rng(1), []
    for _ in range(400):
        y, past, total = plant.reset(rng=draw), [0, 0, 1, 0], 0.0
        past[1] = int(y[0])
        for k in range(16):
            # A history that begins: an opened door tells nothing of what is heard before it.
            action = int(details["policy"][windows.number(past)]) if k >= 2 else 0
            y = plant.step(np.array([float(action)]))
            past = [action, int(y[0]), *past[:2]]
            total += DISCOUNT**k * y[1]
        returns.append(total)
    realised = float(np.mean(returns))
    assert realised > best - 2.5, "the policy waits for two that agree, as the optimal one does"
    assert found().rows[-1]["loss of the policy"] > 3.0, "without states it could not"


def test_no_bound_is_broken_and_few_states_do():
    rows = found().rows
    assert [row["states"] for row in rows] == list(range(36, 0, -1))
    assert all(row["realised"] <= row["bound"] + 1e-9 for row in rows)
    assert all(row["loss of the policy"] <= 2 * row["bound"] + 1e-9 for row in rows)
    enough = int(found().words[1].split()[0])
    assert 3 <= enough <= 12


def test_it_says_when_the_history_tells_more_or_the_records_too_little():
    short = InformationStates(memory=1, discount=DISCOUNT).of(Dataset("tiger", (Run(heard().measured()),)), rng=rng())
    assert "tells more" in short.words[2]
    with pytest.raises(FitError, match="every action"):
        windows_of([heard(60).measured()], 2)
    with pytest.raises(FitError, match="at most 40"):
        InformationStates(memory=3).of(Dataset("tiger", (Run(heard().measured()),)), rng=rng())
    grid = run(create("plants", "grid-pomdp"), create("scenarios", "random-policy"), streams=Streams("g", "r", 0))
    with pytest.raises(FitError, match="reward"):
        windows_of([grid.measured()], 1)


@settings(max_examples=15, deadline=None)
@given(st.integers(2, 7), st.integers(0, 10_000), st.floats(0.0, 0.9))
def test_occupations_solve_their_equations(states, seed, discount):
    chain = rng(seed).dirichlet(np.ones(states), size=states)
    share = stationary(chain)
    assert share @ chain == pytest.approx(share, abs=1e-9)
    first = rng(seed + 1).dirichlet(np.ones(states))
    series, now = np.zeros(states), first.copy()
    for k in range(250):
        series += (1 - discount) * discount**k * now
        now = now @ chain
    assert discounted_occupation(chain, first, discount) == pytest.approx(series, abs=1e-6)
    assert discounted_occupation(chain, first, 1 - 1e-9) == pytest.approx(share, abs=1e-5)


def test_the_density_of_a_sampled_process_is_the_known_one():
    """An autoregression's stationary density is normal; the boxes' mass is that of its distribution function."""
    from scipy.stats import norm

    draw, x = rng(), np.zeros(60_001)
    for k in range(60_000):
        x[k + 1] = 0.7 * x[k] + draw.normal()
    edge = np.linspace(-4, 4, 33)
    chain, kept = ulam(x[:-1, None], x[1:, None], [edge])
    size = 1.0 / np.sqrt(1 - 0.49)
    assert 0.5 * np.abs(stationary(chain) - np.diff(norm.cdf(edge / size))[kept]).sum() < 0.02


def test_a_discount_of_a_sampled_plant_restarts_it_and_a_plant_that_runs_away_is_refused():
    """Of y+ = a y + u from 0 the discounted second moment is ``d s^2 / (1 - d a^2)``, of an unstable plant too."""
    for pole, discount in ((0.9, 0.9), (1.02, 0.8)):
        plant = create("plants", "linear", A=[[pole]], B=[[1.0]])
        details = Occupation(discount=discount, boxes=60).of(plant, rng=rng()).details
        middle = np.mean([details["edges"][0][1:], details["edges"][0][:-1]], axis=0)
        told = 0.3**2 * discount / (1 - discount * pole**2)
        assert details["share"] @ middle**2 == pytest.approx(told, rel=0.12)
    for away in (plant, create("plants", "linear", A=[[1.2]], B=[[1.0]])):  # the second beyond what a number holds
        with pytest.raises(FitError, match="does not stay"):
            Occupation().of(away, rng=rng())
    with pytest.raises(InputError, match="no policy"):
        Occupation(policy=[0]).of(plant, rng=rng())


def test_the_command_draws_finite_and_continuous_processes(tmp_path):
    cells = api.analyse("occupation", "corridors-mdp", subject_options={"length": 3}, out=tmp_path / "finite.png")
    assert sum(row["share"] for row in cells.rows) == pytest.approx(1.0)
    goal = api.analyse("occupation", "corridors-mdp", subject_options={"length": 3}, options={"policy": [0] * 7})
    assert goal.details["share"][6] == pytest.approx(0.25, abs=1e-9), "three cells, then the goal"
    swing = {"sample_time": 0.05, "outputs": [["theta", 0], ["theta", 1]]}
    options = {"samples": 6000, "boxes": 8}
    drawn = api.analyse("occupation", "pendulum-ode", subject_options=swing, options=options, out=tmp_path / "two.png")
    assert drawn.details["apart"] < 0.25
    assert (tmp_path / "two.png").stat().st_size > 5000
    with pytest.raises(InputError, match="recurrent"):
        stationary(np.eye(2))
    with pytest.raises(InputError, match="policy"):
        Occupation(policy=[0, 9]).of(create("plants", "corridors-mdp", length=3), rng=rng())
    assert list(itertools.chain(*drawn.details["edges"]))
