"""The pendulum FMU behind the stepping interface: right numbers, repeatable, fast path equal to slow path."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.errors import InputError, PlantError
from harness.fmi import build
from harness.signals import FloatArray
from plants.fmu import engine as fmu_engine
from plants.fmu.mockups import pendulum_fmu
from plants.fmu.plant import FmuPlant, describe
from plants.mockups import FOLDER, mockup, models

RNG = np.random.default_rng(0)


def excitation(n: int) -> FloatArray:
    """A two-tone torque that swings the pendulum through large angles."""
    t = 0.01 * np.arange(n)
    return (0.6 * np.sin(3.0 * t) + 0.3 * np.sin(11.0 * t + 1.0)).reshape(-1, 1)


@pytest.fixture(params=[2, 3], ids=["fmi2", "fmi3"])
def pendulum(request: pytest.FixtureRequest) -> Iterator[FmuPlant]:
    with pendulum_fmu(fmi=request.param, outputs=("theta", "omega")) as plant:
        yield plant


def reference(u: FloatArray, x0: tuple[float, float], dt: float, J: float, b: float, mgl: float) -> FloatArray:
    """Integrate the pendulum equation hold by hold, to 1e-12."""
    from scipy.integrate import solve_ivp

    x = np.array(x0)
    rows = [x]
    for (torque,) in u:
        done = solve_ivp(
            lambda _t, s, torque=torque: [s[1], (torque - b * s[1] - mgl * np.sin(s[0])) / J],
            (0.0, dt),
            x,
            rtol=1e-12,
            atol=1e-12,
            method="DOP853",
        )
        x = done.y[:, -1]
        rows.append(x)
    return np.array(rows)


def test_agrees_with_an_adaptive_solver(pendulum: FmuPlant) -> None:
    u = excitation(300)
    first = pendulum.reset(rng=RNG, x0={"theta": 0.5, "omega": -1.0})
    got = np.vstack([first, pendulum.rollout(u)])
    expected = reference(u, (0.5, -1.0), 0.01, 0.05, 0.02, 1.0)
    assert np.abs(got - expected).max() < 1e-9


def test_order_of_convergence_is_four() -> None:
    u = excitation(100)
    expected = reference(u, (1.0, 0.0), 0.01, 0.05, 0.02, 1.0)[-1, 0]
    misses = []
    for substep in (0.01, 0.005, 0.0025):
        with pendulum_fmu(substep=substep) as plant:
            plant.reset(rng=RNG, x0={"theta": 1.0})
            misses.append(abs(plant.rollout(u)[-1, 0] - expected))
    orders = np.log2(np.array(misses[:-1]) / np.array(misses[1:]))
    assert np.all((orders > 3.5) & (orders < 4.7)), orders


def test_energy_is_conserved_without_friction() -> None:
    with pendulum_fmu(b=0.0, outputs=("theta", "omega")) as plant:
        y = np.vstack([plant.reset(rng=RNG, x0={"theta": 2.5}), plant.rollout(np.zeros((5000, 1)))])
    energy = 0.5 * 0.05 * y[:, 1] ** 2 - np.cos(y[:, 0])
    assert np.ptp(energy) < 1e-8


def test_dry_friction_loses_energy_linearly_and_holds() -> None:
    # small swings under Coulomb friction alone lose 4 Fc / mgl of amplitude a period, and stop inside the dead band
    with pendulum_fmu(b=0.0, Fc=0.002, outputs=("theta", "omega")) as plant:
        y = np.vstack([plant.reset(rng=RNG, x0={"theta": 0.1}), plant.rollout(np.zeros((4000, 1)))])
    peaks = y[1:-1, 0][(y[1:-1, 0] > y[:-2, 0]) & (y[1:-1, 0] > y[2:, 0]) & (y[1:-1, 0] > 0.01)]
    assert np.allclose(-np.diff(peaks), 4 * 0.002, rtol=0.02)
    assert np.all(y[-100:, 1] == 0.0)
    assert np.ptp(y[-100:, 0]) == 0.0
    assert abs(np.sin(y[-1, 0])) <= 0.002


def test_stiction_needs_the_breakaway_torque() -> None:
    with pendulum_fmu(Fc=0.1, Fs=0.2) as plant:
        plant.reset(rng=RNG)
        assert np.all(plant.rollout(np.full((50, 1), 0.199)) == 0.0)
        assert plant.rollout(np.full((5, 1), 0.201))[-1, 0] > 0.0


def test_both_versions_of_fmi_and_both_loops_agree_bit_for_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    u = excitation(200)
    results = []
    for library in (fmu_engine.native_library, lambda: None):
        monkeypatch.setattr(fmu_engine, "native_library", library)
        for version in (2, 3):
            with pendulum_fmu(fmi=version) as plant:
                plant.reset(rng=RNG, x0={"theta": 1.0})
                half = plant.rollout(u[:100])
                results.append(np.vstack([half, [plant.step(row) for row in u[100:]]]))
    for other in results[1:]:
        assert np.array_equal(results[0], other)


def test_reset_repeats_bit_for_bit_and_fresh_plants_too(pendulum: FmuPlant) -> None:
    u = excitation(50)
    runs = []
    for _ in range(2):
        first = pendulum.reset(rng=RNG, x0={"theta": 0.3})
        runs.append(np.vstack([first, pendulum.rollout(u)]))
    with pickle.loads(pickle.dumps(pendulum)) as fresh:
        first = fresh.reset(rng=RNG, x0={"theta": 0.3})
        runs.append(np.vstack([first, fresh.rollout(u)]))
    assert np.array_equal(runs[0], runs[1])
    assert np.array_equal(runs[0], runs[2])


def test_truth_is_the_state_and_the_start_shows_in_it() -> None:
    with pendulum_fmu(outputs=("der(omega)",)) as plant:
        assert [str(c) for c in plant.spec.states] == ["theta [rad]", "omega [rad/s]"]
        assert [str(c) for c in plant.spec.outputs] == ["der(omega) [rad/s^2]"]
        acceleration = plant.reset(rng=RNG, x0={"theta": 0.2, "omega": 0.5})
        assert np.array_equal(plant.truth(), [0.2, 0.5])
        assert acceleration[0] == pytest.approx((-0.02 * 0.5 - np.sin(0.2)) / 0.05)


def test_parameters_reach_the_model() -> None:
    with pendulum_fmu(J=0.1, b=0.0, mgl=0.0) as plant:
        plant.reset(rng=RNG)
        y = plant.rollout(np.ones((100, 1)))
    assert y[-1, 0] == pytest.approx(0.5 * 1.0 / 0.1 * 1.0**2)


def test_tunable_parameter_moves_while_running_and_fixed_ones_do_not() -> None:
    with pendulum_fmu(b=0.0, mgl=0.0) as plant:
        plant.set_parameter("J", 0.2)
        plant.reset(rng=RNG)
        plant.step(np.ones(1))
        assert plant.truth()[1] == pytest.approx(0.01 / 0.2)
        plant.set_parameter("J", 0.1)
        plant.step(np.ones(1))
        assert plant.truth()[1] == pytest.approx(0.01 / 0.2 + 0.01 / 0.1)
        with pytest.raises(InputError, match="fixed parameter"):
            plant.set_parameter("substep", 0.01)


def test_communication_step_divides_the_sample_time() -> None:
    u = excitation(50)
    with FmuPlant(mockup("pendulum"), sample_time=0.01, step=0.001, parameters={"substep": 1.0}) as plant:
        plant.reset(rng=RNG, x0={"theta": 1.0})
        fine = plant.rollout(u)
    with FmuPlant(mockup("pendulum"), sample_time=0.01) as plant:
        plant.reset(rng=RNG, x0={"theta": 1.0})
        assert np.allclose(plant.rollout(u), fine, rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="divisor of the sample time"):
        FmuPlant(mockup("pendulum"), sample_time=0.01, step=0.003)


def test_agrees_with_fmpy() -> None:
    import fmpy

    n = 300
    u = excitation(n)
    path = mockup("pendulum")
    signal = np.zeros(n, dtype=[("time", float), ("u", float)])
    signal["time"], signal["u"] = 0.01 * np.arange(n), u[:, 0]
    theirs = fmpy.simulate_fmu(
        str(path), stop_time=0.01 * (n - 1), output_interval=0.01, input=signal, start_values={"theta": 1.0}
    )
    with FmuPlant(path, sample_time=0.01) as plant:
        ours = np.vstack([plant.reset(rng=RNG, x0={"theta": 1.0}), plant.rollout(u[:-1])])
    assert np.allclose(theirs["theta"], ours[:, 0], rtol=0, atol=1e-9)


@given(
    n=st.integers(1, 60),
    cut=st.floats(0, 1),
    theta=st.floats(-3, 3),
    omega=st.floats(-5, 5),
    friction=st.sampled_from([0.0, 0.05]),
    seed=st.integers(0, 2**31),
)
def test_any_split_of_a_run_is_the_same_run(
    n: int, cut: float, theta: float, omega: float, friction: float, seed: int
) -> None:
    u = np.random.default_rng(seed).normal(size=(n, 1))
    k = int(cut * n)
    with pendulum_fmu(Fc=friction) as plant:
        plant.reset(rng=RNG, x0={"theta": theta, "omega": omega})
        whole = plant.rollout(u)
        plant.reset(rng=RNG, x0={"theta": theta, "omega": omega})
        head = plant.rollout(u[:k])
        state = plant.get_state()
        plant.rollout(u[::-1].copy())
        plant.set_state(state)
        assert np.array_equal(np.vstack([head, plant.rollout(u[k:])]), whole)


def test_twin_builds_against_the_headers_of_the_standard(tmp_path: Path) -> None:
    import fmpy

    headers = Path(fmpy.__file__).parent / "c-code"
    for model in ("pendulum", "quantiser"):
        for version in (2, 3):
            build.build_fmu(FOLDER / model, version, tmp_path / "x.fmu", "-DFMI_HEADERS", f"-I{headers}", "-Werror")


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("model", models())
def test_mockups_pass_fmpys_validation_and_start_as_described(model: str, version: int) -> None:
    from fmpy.validation import validate_fmu

    path = mockup(model, version)
    assert validate_fmu(str(path)) == []
    rows = [row for row in describe(path)["variables"] if row["start"] is not None]
    with FmuPlant(path, sample_time=0.01, outputs=[row["name"] for row in rows]) as plant:
        start = [float({"true": "1", "false": "0"}.get(row["start"], row["start"])) for row in rows]
        states = {c.name for c in plant.spec.states}
        y = plant.reset(rng=RNG)
        assert np.array_equal(y, start)
        assert plant.warnings == ()
        assert states <= {row["name"] for row in rows}


def test_builds_once_for_many_processes(tmp_path: Path) -> None:
    import subprocess
    import sys

    environment = {**os.environ, "SYSID_HARNESS_CACHE": str(tmp_path)}
    code = "from plants.mockups import mockup; print(mockup('pendulum').stat().st_size > 1000)"
    jobs = [
        subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    assert [job.communicate()[0].strip() for job in jobs] == ["True"] * 3
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert [path.name for path in files] == ["pendulum-fmi2.fmu"]


def test_leaves_nothing_behind(temporary_folder: Path) -> None:
    before = os.getcwd()
    with pendulum_fmu() as plant:
        plant.reset(rng=RNG)
        state = plant.get_state()
        assert len(list(temporary_folder.iterdir())) == 1
    plant.close()
    del state
    assert list(temporary_folder.iterdir()) == []
    assert os.getcwd() == before
    unreferenced = pendulum_fmu()
    del unreferenced
    assert list(temporary_folder.iterdir()) == []


REFUSED: dict[str, tuple[Callable[[FmuPlant], Any], str]] = {
    "shape": (lambda plant: plant.step(np.zeros(2)), r"expected \(1,\)"),
    "nan": (lambda plant: plant.step(np.array([np.nan])), "finite"),
    "rollout shape": (lambda plant: plant.rollout(np.zeros(5)), r"\(N, 1\)"),
    "rollout nan": (lambda plant: plant.rollout(np.full((3, 1), np.inf)), "finite"),
    "unknown state": (lambda plant: plant.reset(rng=RNG, x0={"thata": 0.0}), "did you mean theta"),
    "parameter as state": (lambda plant: plant.reset(rng=RNG, x0={"J": 1.0}), "unknown name in x0"),
    "calculated": (lambda plant: plant.reset(rng=RNG, x0={"der(omega)": 1.0}), "unknown name in x0"),
    "not a number": (lambda plant: plant.reset(rng=RNG, x0={"theta": float("nan")}), "finite"),
    "unknown parameter": (lambda plant: plant.set_parameter("mass", 1.0), "unknown name in parameters"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_calls_are_refused_in_one_line(pendulum: FmuPlant, name: str) -> None:
    call, words = REFUSED[name]
    pendulum.reset(rng=RNG)
    with pytest.raises(InputError, match=words) as caught:
        call(pendulum)
    assert "\n" not in str(caught.value)
    pendulum.reset(rng=RNG)
    pendulum.step(np.zeros(1))


def test_a_step_before_reset_and_after_close_is_refused() -> None:
    plant = pendulum_fmu()
    with pytest.raises(InputError, match="reset"):
        plant.step(np.zeros(1))
    with pytest.raises(InputError, match="reset"):
        plant.rollout(np.zeros((2, 1)))
    plant.reset(rng=RNG)
    state = plant.get_state()
    plant.close()
    for call in (lambda: plant.step(np.zeros(1)), lambda: plant.reset(rng=RNG), lambda: plant.set_state(state)):
        with pytest.raises(InputError, match="closed"):
            call()


def test_impossible_parameters_are_the_fmus_to_refuse() -> None:
    with pendulum_fmu(J=-1.0) as plant:
        with pytest.raises(PlantError, match="J must be positive") as caught:
            plant.reset(rng=RNG)
        assert caught.value.status == "crashed"


def test_start_values_are_set_in_one_call_and_the_refused_one_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from fmpy.fmi2 import FMU2Slave

    calls: list[list[float]] = []
    put = FMU2Slave.setReal

    def spied(self: FMU2Slave, vr: list[int], value: list[float]) -> None:
        calls.append(list(value))
        if any(one == 0.77 for one in value):
            raise ValueError("no such value")
        put(self, vr, value)

    monkeypatch.setattr(FMU2Slave, "setReal", spied)
    values = {"J": 0.06, "b": 0.04, "mgl": 1.1}
    with FmuPlant(mockup("pendulum"), sample_time=0.01, outputs=["theta"], parameters=values) as plant:
        plant.reset(rng=np.random.default_rng(0), x0={"theta": 0.1, "omega": 0.2})
    assert [0.06, 0.04, 1.1, 0.1, 0.2] in calls
    with (
        FmuPlant(mockup("pendulum"), sample_time=0.01, parameters={**values, "b": 0.77}) as plant,
        pytest.raises(PlantError, match=r"'b' cannot be set to 0\.77: no such value"),
    ):
        plant.reset(rng=np.random.default_rng(0))


def test_options_that_do_not_fit_are_refused() -> None:
    path = mockup("pendulum")
    for options, words in (
        ({"inputs": ["torque"]}, "inputs"),
        ({"inputs": ["theta"]}, "inputs"),
        ({"outputs": ["thet"]}, "did you mean theta"),
        ({"outputs": ["theta", "theta"]}, "chosen twice"),
        ({"kind": "me"}, "kind"),
        ({"parameters": {"J": "heavy"}}, "a number"),
        ({"parameters": {"theta": 1.0}}, "unknown name in parameters"),
        ({"start": {"nothing": 1.0}}, "unknown name in start"),
        ({"sample_time": -1.0}, "sample time"),
    ):
        with pytest.raises(InputError, match=words):
            FmuPlant(path, **options)  # type: ignore[arg-type]
