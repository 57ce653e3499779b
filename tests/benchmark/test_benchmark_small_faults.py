"""Small faults of benchmarks that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from harness.benchmark.control import _regret
from harness.benchmark.page.tables import _shown
from harness.benchmark.records import _recorded
from harness.benchmark.running import _seed_list
from harness.benchmark.summary import Quartiles
from harness.benchmark.work import _pooled
from harness.errors import InputError
from harness.scoring import Score
from harness.scoring.control import LinearPlantModel
from harness.signals import FloatArray
from identifiers.linear.least_squares import StateLeastSquares


def plant(a: list[list[float]]) -> LinearPlantModel:
    """Return a plant whose states are measured."""
    return LinearPlantModel(np.array(a), np.array([[0.0], [1.0]]), np.eye(2), np.zeros((2, 1)))


def cost(truth: LinearPlantModel, model: object, size: FloatArray | None = None) -> float | None:
    """Return the regret of learning to control a plant, its states and inputs of one size unless given."""
    return _regret(StateLeastSquares(), model, truth, np.ones(3) if size is None else size, np.random.default_rng(0))


@pytest.mark.parametrize("a", [[[0.9, 0.1], [0.0, 0.8]], [[1.1, 0.1], [0.0, 0.8]]])
def test_whoever_learns_pays_the_same_in_any_unit_whether_the_plant_is_stable_or_not(a: list[list[float]]) -> None:
    truth = plant(a)
    paid = cost(truth, truth)
    assert paid is not None
    assert paid > 0.0
    # the unit of a state is none of the learner's business
    size, change = np.array([10.0, 0.1, 5.0]), np.array([10.0, 0.1])
    scaled = LinearPlantModel(
        truth.a_matrix * change[:, None] / change, truth.b_matrix * change[:, None] / 5.0, np.eye(2), np.zeros((2, 1))
    )
    assert cost(scaled, scaled, size) == pytest.approx(paid, rel=1e-6)


def test_where_states_are_not_measured_there_is_no_regret() -> None:
    truth = plant([[0.9, 0.1], [0.0, 0.8]])
    seen = LinearPlantModel(truth.a_matrix, truth.b_matrix, np.eye(2)[:1], np.zeros((1, 1)))
    assert cost(truth, seen) is None
    smaller = SimpleNamespace(
        a_matrix=np.eye(1), b_matrix=np.ones((1, 1)), c_matrix=np.eye(1), d_matrix=np.zeros((1, 1))
    )
    assert cost(truth, smaller) is None


def test_a_narrow_column_shows_quartiles_with_two_digits_where_they_differ() -> None:
    assert _shown(None) == ""
    assert _shown(Quartiles(0.2, 0.1234, 0.5678)) == "0.2 [.12 .57]"
    assert _shown(Quartiles(0.2, 0.2001, 0.2002)) == "0.2"


def score(rms: list[float], nrmse: list[float], samples: int) -> Score:
    return Score(np.array(rms), np.array(nrmse), None, 0, "", samples)


def test_scores_are_pooled_in_the_mean_square_without_outputs_that_stand_still() -> None:
    one, other = score([0.3, 0.1], [0.6, np.inf], 100), score([0.1, 0.1], [0.2, np.inf], 300)
    total, each = _pooled([one, other])
    assert total == pytest.approx(np.sqrt((100 * 0.36 + 300 * 0.04) / 400))
    assert each == pytest.approx((np.sqrt((100 * 0.09 + 300 * 0.01) / 400), 0.1))
    with pytest.raises(InputError, match="an output that moves"):
        _pooled([score([0.1], [np.inf], 10)])


def test_seeds_are_a_range_or_a_list() -> None:
    assert _seed_list(None) is None
    assert (_seed_list((2, 4)), _seed_list([2, 4, 2]), _seed_list((3, 3))) == ([2, 3, 4], [2, 4], [3])
    assert (_seed_list([0]), _seed_list([2, 4]), _seed_list((7, 2, 4))) == ([0], [2, 4], [7, 2, 4])
    for wrong in ((4, 2), [], [-1], (-1, 1)):
        with pytest.raises(InputError, match="first <= last"):
            _seed_list(wrong)


def test_the_floor_of_a_recording_is_the_noise_that_it_declares(tmp_path: Path) -> None:
    t = np.arange(400) * 0.01
    for name, size in (("a", 1.0), ("b", 0.5)):
        rows = np.column_stack([np.sin(3 * t), size * np.sin(5 * t)])
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header="u [N m],theta [rad]", comments="")
    text = (
        'name = "x"\nsample_time = 0.01\n[signals.u]\nrole = "input"\nunit = "N m"\n[signals.theta]\nrole = "output"\n'
        'unit = "rad"\nnoise = 0.05\n[[runs]]\nfile = "a.csv"\n[[runs]]\nfile = "b.csv"\nuse = "validation"\n'
    )
    file = tmp_path / "dataset.toml"
    file.write_text(text)
    floor = _recorded(str(file)).floor
    assert floor == pytest.approx(0.05 / np.std(0.5 * np.sin(5 * t)), rel=1e-6)
    file.write_text(text.replace("noise = 0.05\n", ""))
    assert _recorded(str(file)).floor is None
