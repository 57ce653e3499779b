"""Beyond stepping: batches with the truth, serialised states, directional derivatives, folders gone at SIGTERM."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from harness.errors import InputError
from plants.fmu.mockups import cart_pole_fmu, pendulum_fmu
from plants.fmu.plant import FmuPlant
from plants.isolation.isolated import isolated

RNG = np.random.default_rng(0)
BOTH = pytest.mark.parametrize("version", [2, 3])


def waves(n: int) -> np.ndarray:
    return 0.5 * np.sin(0.3 * np.arange(n)).reshape(-1, 1)


def test_an_isolated_plant_brings_the_truth_too() -> None:
    u = waves(1500)
    with pendulum_fmu() as direct:
        direct.reset(rng=RNG, x0={"theta": 1.0})
        y, x = direct.rollout_truth(u)
    for name in ("pendulum-fmu", "cart-pole-pymunk"):  # the second knows no batch with the truth of its own
        with isolated(name) as plant:
            plant.reset(rng=RNG, x0={"theta": 1.0})
            got = plant.rollout_truth(u)
            assert got[0].shape == (1500, plant.spec.ny)
            assert np.array_equal(got[1][-1], plant.truth())
            if name == "pendulum-fmu":
                assert np.array_equal(got[0], y)
                assert np.array_equal(got[1], x)


def test_model_exchange_does_not_claim_a_batch_with_the_truth(odd_fmu: Callable[..., Path]) -> None:
    with FmuPlant(odd_fmu("ball", 2), sample_time=0.05) as plant:
        plant.reset(rng=RNG)
        with pytest.raises(InputError, match="truth"):
            plant.rollout_truth(np.zeros((3, 1)))


@BOTH
def test_a_serialised_state_continues_in_another_plant(version: int) -> None:
    u = waves(40)
    with pendulum_fmu(fmi=version) as one, pendulum_fmu(fmi=version) as other:  # type: ignore[arg-type]
        one.reset(rng=RNG, x0={"theta": 0.7})
        one.rollout(u[:20])
        kept = pickle.loads(pickle.dumps(one.serialize_state()))
        rest = one.rollout(u[20:])
        other.reset(rng=RNG)
        other.deserialize_state(kept)
        assert np.array_equal(other.rollout(u[20:]), rest)
        one.deserialize_state(kept)
        assert np.array_equal(one.rollout(u[20:]), rest)


def test_serialised_states_of_others_are_refused(odd_fmu: Callable[..., Path]) -> None:
    with pendulum_fmu() as plant, cart_pole_fmu() as other, FmuPlant(odd_fmu("zoo", 3), sample_time=0.1) as plain:
        for one in (plant, other):
            one.reset(rng=RNG)
        with pytest.raises(InputError, match="another FMU"):
            plant.deserialize_state(other.serialize_state())
        with pytest.raises(InputError, match="other bytes"):
            plant.deserialize_state(b"nonsense")
        if not plain.file.interface("cs").canSerializeFMUstate:
            plain.reset(rng=RNG)
            with pytest.raises(InputError, match="serialised state"):
                plain.serialize_state()


@BOTH
def test_directional_derivatives_are_those_of_the_fmu_in_si(odd_fmu: Callable[..., Path], version: int) -> None:
    with FmuPlant(odd_fmu("ball", version), sample_time=0.05) as plant:
        plant.reset(rng=RNG)
        matrix = plant.directional_derivative(["der(h)", "der(v)", "height_mm"], ["h", "v", "u"])
        assert np.array_equal(matrix, [[0, 1, 0], [0, 0, 1], [1, 0, 0]])  # 1000 mm/m is 1 in SI
        along = plant.directional_derivative(["der(v)", "der(h)"], ["u", "v"], np.array([2.0, -3.0]))
        assert along.tolist() == [2.0, -3.0]
        with pytest.raises(InputError, match="unknown name"):
            plant.directional_derivative(["der(w)"], ["u"])
        with pytest.raises(InputError, match="seed"):
            plant.directional_derivative(["der(v)"], ["u"], np.zeros(2))


@BOTH
def test_an_fmu_without_derivatives_says_so(version: int) -> None:
    with pendulum_fmu(fmi=version) as plant:  # type: ignore[arg-type]
        plant.reset(rng=RNG)
        with pytest.raises(InputError, match="providesDirectionalDerivative"):
            plant.directional_derivative(["der(omega)"], ["u"])


@BOTH
def test_a_serialised_state_of_model_exchange(odd_fmu: Callable[..., Path], version: int) -> None:
    with FmuPlant(odd_fmu("ball", version), sample_time=0.05) as plant:
        plant.reset(rng=RNG)
        plant.rollout(np.zeros((5, 1)))
        kept = plant.serialize_state()
        rest = plant.rollout(np.ones((10, 1)))
        plant.reset(rng=RNG)
        plant.deserialize_state(kept)
        assert np.array_equal(plant.rollout(np.ones((10, 1))), rest)


SCRIPT = """
import numpy as np, sys, time
from plants.fmu.mockups import pendulum_fmu
from plants.isolation.isolated import isolated
plant, apart = pendulum_fmu(), isolated("pendulum-fmu")
plant.reset(rng=np.random.default_rng(0))
print("ready", flush=True)
time.sleep(60)
"""


def test_sigterm_leaves_no_folder_behind(tmp_path: Path) -> None:
    import os
    import time

    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, env=environment, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        assert len(list(tmp_path.glob("sysid-*"))) == 2
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == -signal.SIGTERM, "the signal still ends the process, and says so"
    deadline = time.monotonic() + 10
    while list(tmp_path.glob("sysid-*")) and time.monotonic() < deadline:
        time.sleep(0.1)  # the child notices within half a second that its parent is gone
    assert list(tmp_path.glob("sysid-*")) == []


def test_a_handler_of_the_user_is_left_alone() -> None:
    code = (
        "import signal\nhandler = lambda *_: None\nsignal.signal(signal.SIGTERM, handler)\n"
        "from plants.temporary import temporary_folder, release\nrelease(temporary_folder('sysid-t-'))\n"
        "print(signal.getsignal(signal.SIGTERM) is handler)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "True\n"
