"""Open-loop scenarios: levels, limits, streams, and refusals."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import registry
from harness.errors import InputError
from harness.protocols import Scenario
from harness.rng import Streams
from harness.signals import Channel, PlantSpec

LIMITED = PlantSpec((Channel("u", "V", -2.0, 6.0), Channel("w", "V", -1.0, 1.0)), (Channel("y", "m"),), 0.01)
FREE = PlantSpec((Channel("u", "N"),), (Channel("y", "m"),), 0.01)
FINITE = PlantSpec((Channel("a", minimum=0, maximum=3, kind="category"),), (Channel("s"),), 1.0)
REAL = ("multisine", "prbs", "chirp", "steps", "filtered-noise")


def excite(id: str, spec: PlantSpec = LIMITED, role: str = "estimation/0", seed: int = 0, **options: Any) -> Any:
    scenario = registry.create("scenarios", id, **options)
    assert isinstance(scenario, Scenario)
    return scenario.prepare(spec, streams=Streams("plant", id, seed), role=role)


@pytest.mark.parametrize("id", REAL)
def test_limits_are_kept_and_used_by_default(id: str) -> None:
    u = excite(id, samples=2000).excitation
    assert u.shape == (2000, 2)
    assert u[:, 0].min() >= -2
    assert u[:, 0].max() <= 6
    reach = np.abs(u[:, 0] - 2).max()
    assert 1.0 < reach <= 4.0
    assert u.std(axis=0).min() > 0.1


@pytest.mark.parametrize("id", REAL)
def test_an_input_without_limits_gets_one_unit_unless_told(id: str) -> None:
    assert 0.5 < np.abs(excite(id, FREE, samples=500).excitation).max() < 5
    with pytest.raises(InputError, match="give amplitude in N instead"):
        excite(id, FREE, relative_amplitude=0.5)
    assert np.abs(excite(id, FREE, amplitude={"u": 3.0}, samples=500).excitation).max() > 1


@pytest.mark.parametrize("id", REAL)
def test_runs_and_seeds_have_their_own_streams(id: str) -> None:
    base = excite(id, samples=300).excitation
    np.testing.assert_array_equal(base, excite(id, samples=300).excitation)
    for other in (excite(id, samples=300, role="validation/0"), excite(id, samples=300, seed=1)):
        assert not np.array_equal(base, other.excitation)


@pytest.mark.parametrize("id", [*REAL, "free-swing"])
def test_scenarios_travel_and_compare(id: str) -> None:
    scenario = registry.create("scenarios", id, samples=50)
    assert pickle.loads(pickle.dumps(scenario)) == scenario


@pytest.mark.parametrize("id", REAL)
def test_categories_are_refused(id: str) -> None:
    with pytest.raises(InputError, match="random-policy"):
        excite(id, FINITE)


def test_amplitude_beyond_the_limits_is_refused_not_clipped() -> None:
    with pytest.raises(InputError, match="within \\[-1, 1\\] V"):
        excite("multisine", amplitude={"w": 1.5})
    with pytest.raises(InputError, match="got both"):
        excite("multisine", amplitude=1.0, relative_amplitude=0.5)
    with pytest.raises(InputError, match="one of u, w"):
        excite("prbs", amplitude={"v": 1.0})


def test_a_mapping_leaves_the_other_inputs_at_rest() -> None:
    u = excite("prbs", amplitude={"u": 1.0}, offset={"u": 0.0}, samples=100).excitation
    assert set(u[:, 0]) == {-1.0, 1.0}
    assert not u[:, 1].any()


def test_zippered_multisine_is_orthogonal() -> None:
    u = excite("multisine", zippered=True, samples=1000).excitation
    u = u - u.mean(axis=0)
    assert abs(u[:, 0] @ u[:, 1]) < 1e-9 * np.linalg.norm(u[:, 0]) * np.linalg.norm(u[:, 1])


@pytest.mark.parametrize("id", ["prbs", "chirp", "filtered-noise", "steps"])
def test_several_inputs_are_not_alike(id: str) -> None:
    u = excite(id, samples=5000).excitation
    assert abs(np.corrcoef(u.T)[0, 1]) < 0.35


def test_periods_must_divide_the_run() -> None:
    with pytest.raises(InputError, match="3 periods in 100 samples"):
        excite("multisine", samples=100, periods=3)
    u = excite("multisine", samples=600, periods=3).excitation
    np.testing.assert_array_equal(u[:200], u[200:400])


@pytest.mark.parametrize("options", [{"samples": 1}, {"duration": 0.0}, {"samples": 10, "duration": 1.0}])
def test_length_is_checked(options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="length of a run"):
        excite("multisine", **options)


def test_free_swing_draws_a_new_start_for_each_run() -> None:
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.01, (Channel("theta", "rad"),))
    one, two = (excite("free-swing", spec, role=f"estimation/{i}") for i in range(2))
    assert not one.excitation.any()
    assert 0 < abs(one.x0["theta"]) <= 0.5
    assert one.x0 != two.x0
    assert excite("free-swing", spec, x0={"theta": [1.0, 2.0]}).x0["theta"] >= 1.0
    with pytest.raises(InputError, match="give x0"):
        excite("free-swing", FREE)


def test_random_policy_covers_the_actions() -> None:
    u = excite("random-policy", FINITE).excitation
    assert u.shape == (2000, 1)
    assert np.bincount(u[:, 0].astype(int)).min() > 400
    with pytest.raises(InputError, match="does not fit"):
        excite("random-policy", FREE)


def test_replayed_input(tmp_path: Path) -> None:
    path = tmp_path / "u.csv"
    path.write_text("time [s],u [N]\n0,1\n0.01,2\n0.02,3\n")
    assert excite("replay", FREE, file=str(path)).excitation.ravel().tolist() == [1, 2, 3]
    assert excite("replay", FREE, file=str(path), samples=2).excitation.ravel().tolist() == [1, 2]
    for text, says in (
        ("time,u [V]\n0,1\n", "column of input"),
        ("v\n1\n", "column of input"),
        ("u\nlots\n", "number"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=says):
            excite("replay", FREE, file=str(path))
    with pytest.raises(InputError, match="no such file"):
        excite("replay", FREE, file=str(tmp_path / "none.csv"))


def test_noise_process_noise_and_start_reach_the_experiment() -> None:
    made = excite("prbs", LIMITED, samples=400, noise=0.1, process_noise_ratio=0.1, x0={"q": 0.2})
    assert made.disturbance.std() > 0.02
    assert made.measure(0, np.zeros(1))[0] != 0
    assert made.x0 == {"q": 0.2}
