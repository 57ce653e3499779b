"""Which horizon judges: long runs where only sensors are noisy, short windows where something disturbs the plant."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from harness.diagnosis import diagnose
from harness.diagnosis.descent import Bar, GivenUp, excess, promise
from harness.diagnosis.surrogates import phase_randomised, surrogate_test, window_shuffled
from harness.effects import builtin
from harness.physics import load_model
from harness.study.plan import Task
from harness.study.records import make_records

TASK = Task("confusion", "cart-pole", "laws", ("elasticity@x",), "nominal", "low", 0.02, 0, 0)
SMALL = ("elasticity", "coulomb_friction", "input_delay", "force_bias")


def _diagnosed(task: Task, names: tuple[str, ...] = SMALL):
    records = make_records(task)
    some = [builtin()[name] for name in names]
    return diagnose(records.dataset, load_model("cart-pole"), seed=task.seed, dictionary=some, workers=1)


def test_under_a_disturbance_short_windows_name_what_long_runs_miss() -> None:
    found = _diagnosed(TASK)
    assert [str(one.placed) for one in found.result.accepted] == ["elasticity@x"]
    assert found.horizon.seconds == pytest.approx(0.5)
    assert "disturbs" in found.horizon.reason
    assert found.form.horizon == found.horizon.seconds


def test_without_a_disturbance_the_long_horizon_judges() -> None:
    found = _diagnosed(replace(TASK, effects=("coulomb_friction@x",), disturbance=0.0), SMALL[1:])
    assert [str(one.placed) for one in found.result.accepted] == ["coulomb_friction@x"]
    assert found.horizon.seconds == pytest.approx(5.0)
    assert "disturbs" not in found.horizon.reason


def test_a_disturbance_alone_is_no_effect() -> None:
    found = _diagnosed(replace(TASK, effects=(), level="", study="none", noise="drawn"))
    assert found.verdict == "nothing_missing"
    assert not found.result.accepted


# ---- surrogates of windows -------------------------------------------------------------------------------------------

WINDOWS = [(0, 20 * k, 20 * k + 20) for k in range(40)]


def _growing(rng: np.random.Generator) -> np.ndarray:
    """Return errors (800, 1) that start at 0 in every window and grow, without any cause."""
    return np.concatenate([np.cumsum(np.cumsum(rng.standard_normal((20, 1)), axis=0), axis=0) for _ in WINDOWS])


def _regressors(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return responses to slow forces, which grow in the same way."""
    columns = {f"effect {k}": _growing(rng) for k in range(10)}
    return {name: one / np.linalg.norm(one) for name, one in columns.items()}


def test_window_surrogates_hold_their_level_where_phases_do_not() -> None:
    found = {"windows": 0, "phases": 0}
    for trial in range(60):
        rng = np.random.default_rng([11, trial])
        bases, residual = _regressors(rng), [_growing(rng)]
        for name, windows in (("windows", WINDOWS), ("phases", [])):
            p = surrogate_test(residual, bases, np.zeros((800, 0)), rng=rng, count=99, windows=windows).p
            found[name] += p <= 0.05
    assert found["windows"] <= 8  # binomial(60, 0.05): more than 8 has probability 0.4 %
    assert found["phases"] > found["windows"]


def test_window_surrogates_see_what_is_there() -> None:
    rng = np.random.default_rng(5)
    bases = _regressors(rng)
    residual = [_growing(rng) + 1.0 * np.linalg.norm(_growing(rng)) * bases["effect 3"]]
    found = surrogate_test(residual, bases, np.zeros((800, 0)), rng=rng, count=199, windows=WINDOWS)
    assert found.p <= 0.01
    assert max(found.by_effect, key=found.by_effect.__getitem__) == "effect 3"


def test_shuffled_windows_keep_the_growth_and_stay_where_they_are_cut() -> None:
    rng = np.random.default_rng(2)
    residual = [_growing(rng)[:400], _growing(rng)[:410]]
    cut = [(0, 20 * k, 20 * k + 20) for k in range(20)] + [(1, 20 * k, 20 * k + 20) for k in range(20)]
    drawn = window_shuffled(residual, [*cut, (1, 400, 410)], 50, rng=rng)
    assert drawn.shape == (50, 810, 1)
    profile = np.concatenate([residual[0], residual[1][:400]]).reshape(40, 20)
    for one in drawn:
        blocks = one[:800, 0].reshape(40, 20)
        assert np.allclose(np.sort((blocks**2).sum(axis=1)), np.sort((profile**2).sum(axis=1)))
    assert np.allclose(np.abs(drawn[:, 800:, 0]), np.abs(residual[1][400:, 0]))  # the only one of its length
    assert not np.allclose(phase_randomised(residual, 1, rng=rng)[0, ::20], 0.0, atol=1e-3)


# ---- giving up -------------------------------------------------------------------------------------------------------


class _Form:
    """Only what :func:`promise` asks of a form: 1000 samples of noise 1, the model before leaves as much again."""

    floors: tuple[float | None, ...] = (1.0,)

    def __init__(self, steps: int = 1) -> None:
        self.steps = steps
        y = np.zeros((1000, 1))
        self.records = {"estimation": [_Record(y)]}

    def cost_of(self, bar: Bar, horizon: float | None):
        return _solution(2.0)

    def system(self, effects: object) -> str:
        return "before"

    def simulator(self, system: str, p: object):
        return SimpleNamespace(substeps=1 if system == "before" else self.steps)


class _Record:
    def __init__(self, y: np.ndarray) -> None:
        self.y = y

    def __len__(self) -> int:
        return len(self.y)


def _solution(power: float):
    """Return a solution whose mean square is ``power`` noise variances."""
    cost = 0.5 * 1000 * power
    return SimpleNamespace(evaluation=SimpleNamespace(cost=cost), x0=np.zeros((1, 0)), p=np.zeros(1))


def test_the_error_beyond_the_noise_is_what_counts() -> None:
    form = _Form()
    assert excess(form, 1000.0, 1, 0) == pytest.approx(500.0)
    assert excess(form, 400.0, 1, 0) == 0.0


@pytest.mark.parametrize(
    ("steps", "gain", "power", "ends"),
    [
        (1, 0.0, 1.999, False),  # an ordinary candidate is never given up
        (16, 0.0, 1.99, True),  # a stiff one that takes away 1 %
        (16, 0.0, 1.80, False),  # a stiff one that takes away 20 %
        (1, 0.25, 1.80, True),  # a pair that takes away 20 %
        (1, 0.25, 1.50, False),  # a pair that takes away half
    ],
)
def test_what_is_given_up(steps: int, gain: float, power: float, ends: bool) -> None:
    bar = Bar((), {}, gain)
    if not ends:
        promise(_Form(steps), bar, "after", _solution(power), 0.5)
        return
    with pytest.raises(GivenUp, match=r"given up: over windows of 0\.5 s it takes away"):
        promise(_Form(steps), bar, "after", _solution(power), 0.5)
