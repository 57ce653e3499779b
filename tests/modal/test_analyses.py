"""`sysid analyse`: what was a function inside a module has an id, a command and a call."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import api
from harness.errors import InputError
from harness.models.analysis import Analysis
from harness.registry import create, entries
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from identifiers.finite.mdp import MdpModel
from identifiers.finite.smaller import Bisimulation


def test_every_analysis_is_listed_and_keeps_the_contract() -> None:
    listed = {row["id"]: row["summary"] for row in api.list_parts("analyses")["analyses"]}
    assert set(listed) == {
        "bisimulation",
        "belief-compression",
        "information-states",
        "occupation",
        "response-control",
        "iterative-learning",
        "base-parameters",
        "mass-extents",
        "mass-intervals",
        "eigenfunctions",
        "floating-inertial",
        "contacts",
        "calibration-poses",
        "gravity-at-rest",
        "parameter-trajectory",
        "pushed-in-plane",
        "pushed-object",
        "glider-functions",
        "redesign",
        "learned-motion",
        "adaptive-balance",
        "adaptive-tracking",
        "control-worth",
        "lifted-control",
        "offset-bound",
        "record-length",
        "finite-sample",
        "regret",
    }
    assert all(listed.values())
    for entry in entries("analyses"):
        assert isinstance(create("analyses", entry.id), Analysis)
        with pytest.raises(InputError) as refused:
            api.analyse(entry.id, object() if create("analyses", entry.id).takes != "data" else "nowhere.csv")
        assert "\n" not in str(refused.value)


@settings(max_examples=20, deadline=None)
@given(copies=st.integers(1, 4), states=st.integers(2, 4), seed=st.integers(0, 10_000))
def test_copies_of_states_fall_into_one_class(copies: int, states: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    small, reward = rng.dirichlet(np.ones(states), size=(states, 2)), np.arange(states, dtype=float)
    owner = np.repeat(np.arange(states), copies)
    split = rng.dirichlet(np.ones(copies), size=(states * copies, 2, states))
    table = (small[owner][..., None] * split).reshape(states * copies, 2, states * copies)
    spec = PlantSpec((Channel("a", "1", 0, 1, "category"),), (Channel("s", "1", 0, len(owner) - 1, "category"),), 1.0)
    found = Bisimulation(reward=reward[owner].tolist(), tolerance=1e-9).of(
        MdpModel(spec, table, np.ones(table.shape[:2])), rng=np.random.default_rng(0)
    )
    assert found.details["labels"].tolist() == owner.tolist()
    assert found.details["transition"] == pytest.approx(small, abs=1e-9)
    assert sum(row["size"] for row in found.rows) == len(owner)


def test_a_process_counted_from_data_and_a_wrong_reward(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    spec = PlantSpec((Channel("a", "1", 0, 1, "category"),), (Channel("s", "1", 0, 2, "category"),), 1.0)
    table = np.array([[[0, 0.5, 0.5]] * 2, [[1, 0, 0]] * 2, [[1, 0, 0]] * 2], dtype=float)
    (tmp_path / "model.json").write_text(
        json.dumps(MdpModel(spec, table, np.full((3, 2), 40.0)).to_dict()), encoding="utf-8"
    )
    asked = ["analyse", "bisimulation", str(tmp_path / "model.json")]
    assert json.loads(sysid(*asked, "-O", "reward=[0, 1, 1]", "--json").out)["labels"] == [0, 1, 1]
    assert "expected shape (3, 2) or (3,)" in sysid(*asked, "-O", "reward=[0, 1]", status=2).err
    assert "-O reward=" in sysid(*asked, status=2).err
    assert "did you mean bisimulation" in sysid("analyse", "bisimulations", "corridors-mdp", status=2).err


def test_a_counted_process_has_the_classes_that_its_counts_tell_apart() -> None:
    """Six states of which three times two are the same: noise of counting would make six classes of them."""
    rng, owner = np.random.default_rng(1), np.repeat([0, 1, 2], 2)
    small = np.array([[0.7, 0.2, 0.1], [0.2, 0.5, 0.3], [0.5, 0.2, 0.3]])
    split = rng.dirichlet(np.ones(2), size=(6, 3)).reshape(6, 6)
    table = small[owner][:, owner] * split
    spec = PlantSpec((), (Channel("s", "1", 0, 5, "category"),), 1.0)
    reward, found = [1.0, 1.0, 0.0, 0.0, 0.0, 0.0], {}
    for tried in (10, 1000):
        counts = np.array([rng.multinomial(tried, row) for row in table])[:, None, :]
        counted = MdpModel(spec, counts / tried, np.full((6, 1), float(tried)))
        found[tried] = Bisimulation(reward=reward).of(counted, rng=rng)
        assert Bisimulation(reward=reward, tolerance=1e-9).of(counted, rng=rng).details["labels"].max() == 5
    assert found[10].details["labels"].tolist() == [0, 0, 1, 1, 1, 1], "ten visits do not tell .2, .5 from .5, .2"
    assert found[1000].details["labels"].tolist() == owner.tolist()
    assert found[1000].details["transition"][:, 0] == pytest.approx(small, abs=0.05)
    assert "6000 counted transitions" in found[1000].words[0]
    rare = MdpModel(spec, counts / tried, np.array([[0.0]] + [[9.0]] * 5))
    with pytest.raises(InputError, match=r"1 of 6 pairs never tried, such as \(0, 0\)"):
        Bisimulation(reward=reward).of(rare, rng=rng)


def test_corridors_that_are_alike_are_one(sysid: Callable[..., Any]) -> None:
    assert "9 states in 5 classes" in sysid("analyse", "bisimulation", "corridors-mdp", "-P", "length=4").out
    slippery = api.analyse("bisimulation", "corridors-mdp", subject_options={"length": 4, "slip": 0.2})
    assert len(slippery.rows) == 9


def test_beliefs_of_two_hidden_states_are_mixtures_of_two() -> None:
    rng = np.random.default_rng(0)
    stay, right = 0.95, 0.85
    state, seen = 0, []
    for _ in range(3000):
        state = state if rng.random() < stay else 1 - state
        seen.append(state if rng.random() < right else 1 - state)
    spec = PlantSpec((), (Channel("o", "1", 0, 1, "category"),), 1.0)
    record = Trajectory(np.arange(3000.0), np.zeros((3000, 0)), np.array(seen, dtype=float)[:, None], spec)
    found = api.analyse("belief-compression", Dataset("hidden", (Run(record),)), options={"states": 2})
    one, two = (row["divergence [nats]"] for row in found.rows)
    assert two < 0.01 < one
    assert found.details["enough"] == 2
    assert found.details["basis"].sum(axis=1) == pytest.approx(1.0)


def test_a_motion_is_learned_although_the_model_is_wrong() -> None:
    found = api.analyse(
        "iterative-learning",
        "pendulum-ode",
        subject_options={"sample_time": 0.1},
        options={"believed": {"parameters": {"mgl": 0.8, "b": 0.1}}, "repetitions": 6},
    )
    errors = [row["error rms"] for row in found.rows]
    assert errors[0] > 0.05
    assert min(errors) < 0.02 * errors[0]
    assert found.details["input"].shape == (40, 1)
    with pytest.raises(InputError, match="believed"):
        api.analyse("iterative-learning", "pendulum-ode")


def test_base_parameters_say_what_is_tied_and_what_no_motion_shows() -> None:
    found = api.analyse("base-parameters", "cart-pole")
    assert [row["combination"] for row in found.rows] == ["mc + mp", "l**2*mp", "l*mp", "bx", "btheta"]
    assert any("seen in combinations only: l, mc, mp" in text for text in found.words)
    known = api.analyse("base-parameters", "cart-pole", options={"known": {"l": 0.5}})
    assert len(known.rows) == 4
    with pytest.raises(InputError, match="known parameters"):
        api.analyse("base-parameters", "cart-pole", options={"known": {"mass": 1.0}})
    assert "<table>" in found._repr_html_()


def test_shapes_bound_a_mass_that_consistency_leaves_open() -> None:
    (row,) = api.analyse("mass-extents", "iiwa", options={"bodies": ["lbr_iiwa_joint_3"]}).rows
    mass = row["mass of the URDF [kg]"]
    assert row["least, consistent [kg]"] < 0.01 * mass
    assert row["most, consistent [kg]"] == "no bound"
    assert 0.01 * mass < row["least, within its shape [kg]"] < mass < row["most, within its shape [kg]"] < 20 * mass
    with pytest.raises(InputError, match="bodies of an arm"):
        api.analyse("mass-extents", "iiwa", options={"bodies": ["elbow"]})
    with pytest.raises(InputError, match="mass extents of pendulum"):
        api.analyse("mass-extents", "pendulum")
