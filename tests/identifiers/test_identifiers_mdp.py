"""Counting: exact frequencies, the rate of its error, the bound it promises, honest about what it never saw."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.command import main
from harness.errors import FitError
from harness.scoring import predict, regret
from harness.signals import Channel, PlantSpec, Trajectory
from harness.testing import FiniteProcess, simulate_finite
from identifiers.finite.mdp import (
    MdpCounting,
    MdpModel,
    OnlineCounting,
    count_transitions,
    ergodic,
    finite_sizes,
    weissman_bound,
)

RNG = np.random.default_rng(0)


def finite(states: int, actions: int = 0) -> PlantSpec:
    inputs = (Channel("a", kind="category", minimum=0, maximum=actions - 1),) if actions else ()
    return PlantSpec(inputs, (Channel("s", kind="category", minimum=0, maximum=states - 1),), 1.0)


def record(y, u=None, states: int = 3, actions: int = 0) -> Trajectory:
    y = np.asarray(y, dtype=float)[:, None]
    u = np.zeros((len(y), 0)) if u is None else np.asarray(u, dtype=float)[:, None]
    return Trajectory(np.arange(len(y)) * 1.0, u, y, finite(states, actions))


def process(states: int = 6, actions: int = 3) -> FiniteProcess:
    P = np.random.default_rng(0).dirichlet(np.ones(states), size=(states, actions)) * 0.9 + 0.1 / states
    return FiniteProcess(P, finite(states, actions))


def test_counts_by_hand_and_never_across_a_seam():
    records = [record([0, 1, 1, 0], [1, 0, 1, 0], actions=2), record([2, 1], [1, 1], actions=2)]
    counts = count_transitions(records)
    assert counts.sum() == 4
    assert counts[0, 1, 1] == counts[1, 0, 1] == counts[1, 1, 0] == counts[2, 1, 1] == 1


def test_unvisited_pairs_are_uniform_and_flagged():
    model = MdpCounting().fit([record([0, 1, 0, 1], [0, 0, 0, 0], actions=2)], rng=RNG)
    assert (2, 0) in model.unvisited
    assert (0, 1) in model.unvisited
    assert (0, 0) not in model.unvisited
    assert model.transition[2, 0] == pytest.approx(np.full(3, 1 / 3))
    assert np.isinf(model.bound[2, 0])
    assert [2, 0] in model.notes["unvisited"]


def test_a_record_with_more_than_a_process_says_which_signals_to_choose():
    action, seen = (Channel(name, "1", 0, 1, "category") for name in ("action", "heard"))
    told = PlantSpec((action,), (Channel("reward"), seen), 1.0)
    with pytest.raises(FitError, match="such as --input action --output heard"):
        finite_sizes(told, "hidden-markov")
    with pytest.raises(FitError, match="say that the numbers are names"):
        finite_sizes(PlantSpec((action,), (Channel("reward"),), 1.0), "hidden-markov")


def test_pseudo_counts():
    model = MdpCounting(prior=1.0).fit([record([0, 1, 0, 1])], rng=RNG)
    assert model.transition[0, 0] == pytest.approx([1 / 5, 3 / 5, 1 / 5])


def test_the_bound_against_its_formula():
    assert weissman_bound(np.array(50.0), 3, 0.9) == pytest.approx(np.sqrt(2 * np.log((2**3 - 2) / 0.1) / 50))
    assert np.isfinite(weissman_bound(np.array(50.0), 2000)), "2^S would overflow"


def test_counting_error_falls_with_the_root_of_the_samples_below_its_bound():
    one = process(4, 2)
    scaled = []
    for n in (2000, 8000, 32000):
        errors = []
        for seed in range(3):
            model = MdpCounting().fit([simulate_finite(one, n, rng=np.random.default_rng(seed))], rng=RNG)
            miss = np.abs(model.transition - one.P).sum(axis=2)
            assert (miss <= model.bound).all()
            errors.append(np.sqrt(np.mean(miss**2)))
        scaled.append(np.mean(errors) * np.sqrt(n))
    assert max(scaled) / min(scaled) < 1.35, scaled


@pytest.mark.parametrize(
    ("P", "expected"),
    [
        ([[0.5, 0.5], [0.5, 0.5]], True),
        ([[0.0, 1.0], [1.0, 0.0]], False),  # a cycle
        ([[1.0, 0.0], [0.5, 0.5]], False),  # absorbing
        ([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0]], True),  # cycles of length 2 and 3
    ],
)
def test_ergodicity(P, expected):
    assert ergodic(np.array(P) > 0) is expected


@pytest.mark.parametrize("identifier", [MdpCounting(), MdpCounting(prior=0.5), OnlineCounting()])
def test_what_was_never_tried_makes_no_process_ergodic(identifier):
    """A cycle of four states, the last of which is never left, among six: no count shows what is assumed of others."""
    model = identifier.fit([record(range(4), states=6)], rng=np.random.default_rng(0))
    assert model.notes["ergodic"] is False
    assert "3 of 6 pairs were never tried" in model.findings[1]
    assert "at most 2 (l1" in model.findings[0]
    around = identifier.fit([record([0, 1, 2, 3] * 3, states=4)], rng=np.random.default_rng(0))
    assert around.notes["ergodic"] is False


def test_predictions_of_every_horizon_are_powers_of_the_matrix():
    true = process(4, 2)
    model = MdpModel(true.spec, true.P, np.ones((4, 2)))
    data = simulate_finite(true, 60, rng=np.random.default_rng(1))
    found = predict(model, data, 3)[3:, 0]
    for k, named in enumerate(found):
        s, a = data.y[:, 0].astype(int), data.u[:, 0].astype(int)
        ahead = true.P[s[k], a[k]] @ true.P[:, a[k + 1]] @ true.P[:, a[k + 2]]
        assert named == np.argmax(ahead)


def test_many_steps_of_a_large_process_stay_in_memory():
    states = 300
    model = MdpModel(finite(states, 2), np.full((states, 2, states), 1 / states), np.ones((states, 2)))
    x = np.eye(states)[np.arange(20_000) % states]
    u = (np.arange(20_000) % 2).astype(float)[:, None]
    assert model.step(x, u).sum(axis=1) == pytest.approx(np.ones(20_000))


def test_online_counting_pays_only_for_what_it_had_to_learn():
    cycle = record([0, 1, 2] * 40)
    found = regret(OnlineCounting(), [cycle], rng=RNG)
    assert found.total == 3.0, "each transition is new once"
    assert found.hindsight.sum() == 0.0


def test_the_average_regret_of_counting_goes_to_zero_and_its_rival_is_the_best_table():
    one = process(4, 2)
    data = simulate_finite(one, 4000, rng=np.random.default_rng(0))
    found = regret(OnlineCounting(), [data], rng=RNG)
    assert found.exact
    assert 0.0 <= found.average < 0.05
    assert found.average < found.cumulative[199] / 200
    rng = np.random.default_rng(1)
    s, a, after = (data.y[:-1, 0].astype(int), data.u[:-1, 0].astype(int), data.y[1:, 0].astype(int))
    best = found.hindsight.sum()
    for _ in range(50):
        table = rng.integers(4, size=(4, 2))
        assert best <= np.sum(table[s, a] != after)


@pytest.mark.parametrize(
    "spec",
    [
        PlantSpec((), (Channel("y"),), 1.0),
        PlantSpec((Channel("u"),), finite(3).outputs, 1.0),
        PlantSpec((), (*finite(3).outputs, Channel("y")), 1.0),
    ],
)
def test_signals_that_are_no_categories_are_refused(spec):
    data = Trajectory(np.arange(9.0), np.zeros((9, spec.nu)), np.zeros((9, spec.ny)), spec)
    with pytest.raises(FitError, match="finite process"):
        MdpCounting().fit([data], rng=RNG)


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 5), st.integers(0, 10_000))
def test_more_data_never_widens_the_sets_and_they_cover(states, seed):
    rng = np.random.default_rng(seed)
    table = rng.dirichlet(np.ones(states), size=(states, 1))
    walk = [0]
    for _ in range(1500):
        walk.append(int(rng.choice(states, p=table[walk[-1], 0])))
    spec = PlantSpec((), (Channel("s", kind="category", minimum=0, maximum=states - 1),), 1.0)
    y = np.array(walk, dtype=float)[:, None]
    data = Trajectory(np.arange(float(len(y))), np.zeros((len(y), 0)), y, spec)
    bounds = []
    for n in (100, 400, 1500):
        model = MdpCounting().fit([data[:n]], rng=rng)
        bounds.append(model.bound)
        assert model.transition.sum(axis=2) == pytest.approx(1.0)
    assert (np.diff(bounds, axis=0) <= 1e-12).all()
    assert (np.abs(model.transition - table).sum(axis=2) <= model.bound).mean() >= 0.5  # each holds with 95 %


def test_the_command_says_what_was_counted_and_what_was_never_tried(tmp_path, capsys):
    """A log of categories needs a dataset.toml that says so; the refusal of the log alone names it."""
    log = tmp_path / "log.csv"
    a, s = np.tile([0, 0, 0, 1, 0], 40), np.tile([0, 1, 2, 0, 1], 40)
    table = np.column_stack([np.arange(200.0), a, s])
    np.savetxt(log, table, delimiter=",", header="t [s],action [1],state [1]", comments="")
    columns = ["--input", "action", "--output", "state", "--identifier", "mdp-counting"]
    with pytest.raises(SystemExit):
        main(["identify", str(log), *columns])
    assert "categories = N" in capsys.readouterr().err
    said = "\n".join(
        f'[signals."{name}"]\nrole = "{role}"\ncolumn = "{name} [1]"\ncategories = {count}'
        for name, role, count in (("action", "input", 2), ("state", "output", 3))
    )
    whole = tmp_path / "dataset.toml"
    runs = '[[runs]]\nfile = "log.csv"\nuse = "estimation"\n'
    whole.write_text(f'name = "log"\n[time]\ncolumn = "t [s]"\n{said}\n{runs}')
    with pytest.raises(SystemExit):
        main(["identify", str(whole), "--identifier", "mdp-counting"])
    told = capsys.readouterr().out
    assert "4 pairs of state and action, tried 40 to 79 times" in told
    assert "2 of 6 pairs were never tried, of which nothing is known: (1, 1), (2, 1)" in told
