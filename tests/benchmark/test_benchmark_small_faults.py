"""Small faults of benchmarks that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_rows import row

from harness.benchmark.control import _regret
from harness.benchmark.page.tables import _shown
from harness.benchmark.records import _recorded, noise_floor
from harness.benchmark.running import _seed_list
from harness.benchmark.summary import Quartiles
from harness.benchmark.work import _pooled, _score_regret
from harness.errors import InputError, PlantError
from harness.protocols import Growth, Hindsight
from harness.scoring import Score
from harness.scoring.control import LinearPlantModel
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.linear.least_squares import StateLeastSquares


def test_where_states_are_not_measured_there_is_no_regret() -> None:
    a, b = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [1.0]])
    truth = LinearPlantModel(a, b, np.eye(2), np.zeros((2, 1)))
    one_output = LinearPlantModel(a, b, np.eye(2)[:1], np.zeros((1, 1)))
    smaller = LinearPlantModel(np.eye(1), np.ones((1, 1)), np.eye(1), np.zeros((1, 1)))
    for model in (one_output, smaller):
        assert _regret(StateLeastSquares(), model, truth, np.ones(3), np.random.default_rng(0)) is None


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


class Learner:
    """Foretells ``gain`` times the last output; the best in hindsight foretells half of it."""

    def __init__(self, gain: float) -> None:
        self.gain = gain

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> FloatArray:
        return np.zeros(1)

    def start(self, state: FloatArray, y: FloatArray) -> FloatArray:
        return y

    def predict(self, state: FloatArray, u: FloatArray) -> FloatArray:
        return self.gain * state

    def update(self, state: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return y

    def hindsight(self, records: list[Trajectory]) -> Hindsight:
        losses = np.concatenate([np.sum((one.y[1:] - 0.5 * one.y[:-1]) ** 2, axis=1) for one in records])
        return Hindsight(losses, False, growth=Growth("log", 2.0))


def test_a_learner_is_scored_over_all_its_records_and_one_that_overflows_has_diverged() -> None:
    spec, rng = PlantSpec((), (Channel("y"),), 1.0), np.random.default_rng(0)
    shown = [Trajectory(np.arange(float(n)), np.zeros((n, 0)), rng.normal(size=(n, 1)), spec) for n in (40, 25)]
    found = row()
    _score_regret(Learner(0.8), shown, found, rng, 9)
    variance = np.var(np.concatenate([one.y for one in shown]))
    each = np.concatenate([(o.y[1:] - 0.8 * o.y[:-1]) ** 2 - (o.y[1:] - 0.5 * o.y[:-1]) ** 2 for o in shown])[:, 0]
    assert found.regret == pytest.approx(each.sum() / variance)
    assert found.average_regret == pytest.approx(each.mean() / variance)
    assert (found.regret_exact, found.regret_law, found.curve_steps[0], found.curve_steps[-1]) == (False, "log", 1, 63)
    assert found.curve_regret == pytest.approx([each[:n].sum() / variance for n in found.curve_steps])
    assert len(found.curve_theory) == len(found.curve_steps) <= 9
    assert found.regret_over_theory is not None
    with np.errstate(over="ignore"), pytest.raises(PlantError, match="not finite") as told:
        _score_regret(Learner(1e200), shown, row(), rng, 9)
    assert told.value.status == "diverged"


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


def test_the_floor_of_several_outputs_is_the_mean_of_their_own() -> None:
    rng = np.random.default_rng(0)
    t = np.asarray(np.arange(500) * 0.01, dtype=np.float64)
    clean = np.column_stack([3.0 * np.sin(3 * t), 0.01 * np.cos(5 * t)])
    noise = rng.normal(0.0, [0.3, 0.002], clean.shape)
    spec = PlantSpec((), (Channel("x", "m"), Channel("theta", "rad")), 0.01)
    made = Trajectory(t, np.zeros((500, 0)), clean + noise, spec)
    wanted = np.sqrt(np.mean(np.mean(noise**2, axis=0) / np.var(made.y, axis=0)))
    assert noise_floor([(made, dict(enumerate(clean)))]) == pytest.approx(wanted)
