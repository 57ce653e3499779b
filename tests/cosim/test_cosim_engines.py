"""Coupled engines: snapshots and rollback of FMUs bit for bit, order of convergence, the loop of four engines."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from harness.cosim import Connection, Coupled
from plants.fmu.mockups import pendulum_fmu
from plants.fmu.plant import FmuPlant
from plants.mockups import mockup

ROOT = Path(__file__).parents[2]
RNG = np.random.default_rng(0)
Script = Callable[[str], ModuleType]
KP, KI, WISH = 0.5, 0.2, 0.4
ARM = {"J": 0.05, "b": 0.1, "mgl": 1.0}


def loop(h: float, *, fmi: Any = 2, delay: int = 0, ratio: int = 1, **options: Any) -> Coupled:
    """Return a pendulum FMU under a PI controller FMU that steps every ``ratio`` samples."""
    law = FmuPlant(mockup("pi_controller", fmi), sample_time=h * ratio, parameters={"Kp": KP, "Ki": KI})
    return Coupled(
        {"arm": pendulum_fmu(sample_time=h, fmi=fmi, substep=1e-3, **ARM), "law": law},
        [
            Connection("wish", "law.r"),
            Connection("arm.theta", "law.y", delay=delay),
            Connection("law.u", "arm.u", gain_unit="N m"),
        ],
        inputs={"wish": "law.r"},
        outputs=["arm.theta", "law.u"],
        **options,
    )


def motion(plant: Coupled, n: int) -> np.ndarray:
    return np.array([plant.step(np.array([WISH])) for _ in range(n)])


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("order", ["jacobi", "gauss-seidel"])
@pytest.mark.parametrize(("delay", "ratio"), [(0, 1), (2, 1), (1, 3)])
def test_coupled_fmus_go_back_bit_for_bit(fmi: int, order: str, delay: int, ratio: int) -> None:
    with (
        loop(0.01, fmi=fmi, order=order, delay=delay, ratio=ratio) as plant,
        loop(0.01, fmi=fmi, order=order, delay=delay, ratio=ratio) as undisturbed,
    ):
        assert "snapshots" in plant.abilities
        assert not hasattr(plant, "snapshot_tolerance")
        start = {"arm.theta": 0.7, "law.integral": 0.1}
        for one in (plant, undisturbed):
            one.reset(rng=RNG, x0=start)
            motion(one, 20)
        state = plant.get_state()
        truth = plant.truth()
        first = motion(plant, 25)
        other = np.array([plant.step(np.array([-2.0])) for _ in range(13)])  # another future in between
        assert not np.array_equal(other, first[:13])
        plant.set_state(state)
        assert np.array_equal(plant.truth(), truth)
        assert np.array_equal(motion(plant, 25), first)
        plant.set_state(state)  # a state may be used again
        assert np.array_equal(motion(plant, 25), first)
        assert np.array_equal(motion(undisturbed, 25), first)  # and taking one disturbs nothing


def test_strong_coupling_of_fmus_rolls_back_to_the_implicit_step() -> None:
    with loop(0.05, iterations=60, tolerance=1e-13) as strong, loop(0.05) as weak:
        for one in (strong, weak):
            one.reset(rng=RNG, x0={"arm.theta": 0.7})
        state = strong.get_state()
        y = strong.step(np.array([WISH]))
        strong.set_state(state)
        assert np.array_equal(strong.step(np.array([WISH])), y)
        with pendulum_fmu(sample_time=0.05, **ARM) as arm:  # the torque of the step is the one that the step leads to
            arm.reset(rng=RNG, x0={"theta": 0.7})
            integral = KI * 0.05 * (WISH - y[0])
            torque = KP * (WISH - y[0]) + integral
            held = KP * (WISH - y[0])  # what the controller shows at the end of the step it held y in
            low = arm.step(np.array([torque]))[0]
        assert held != torque
        assert abs(low - y[0]) < 2e-5
        assert abs(weak.step(np.array([WISH]))[0] - y[0]) > 1e-4


def test_a_pymunk_part_passes_its_tolerance_on() -> None:
    from plants.pymunk.cart_pole import PymunkCartPole

    plant = Coupled({"cart": PymunkCartPole()}, [("f", "cart.u")], inputs={"f": "cart.u"}, outputs=["cart.x"])
    assert plant.snapshot_tolerance == 1e-9


def reference(times: np.ndarray) -> np.ndarray:
    """Return theta of the loop in continuous time."""

    def rates(_t: float, s: np.ndarray) -> list[float]:
        theta, omega, integral = s
        torque = KP * (WISH - theta) + integral
        return [omega, (torque - ARM["b"] * omega - ARM["mgl"] * np.sin(theta)) / ARM["J"], KI * (WISH - theta)]

    return np.asarray(solve_ivp(rates, (0, 2), [0.7, 0, 0], t_eval=times, rtol=1e-11, atol=1e-12).y[0])


@pytest.mark.parametrize("order", ["jacobi", "gauss-seidel"])
def test_the_coupling_error_falls_with_the_first_power_of_the_communication_step(order: str) -> None:
    steps = [0.1, 0.05, 0.025, 0.0125, 0.00625]
    errors = []
    for h in steps:
        with loop(h, order=order) as plant:
            plant.reset(rng=RNG, x0={"arm.theta": 0.7})
            n = round(2 / h)
            errors.append(float(np.abs(motion(plant, n)[:, 0] - reference(h * np.arange(1, n + 1))).max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    print(order, [f"{e:.2e}" for e in errors], orders.round(2))
    assert orders[-1] == pytest.approx(1.0, abs=0.08)
    assert errors[-1] < 0.01


def test_four_engines_in_a_loop_come_to_the_one_ode(script: Script) -> None:
    example = script("examples/coupled_cart_pole.py")
    truth = example.monolith(2.0)
    errors = []
    for substeps, count in ((2, 1e-3), (20, 1e-4), (200, 1e-6)):
        with example.coupled(substeps, count) as plant:
            got = example.run(plant, 2.0)
        errors.append(float(np.abs(got - truth)[:, 1].max()))
    print([f"{e:.2e}" for e in errors])
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    assert errors[2] < 2e-5


def test_the_example_prints_the_order_in_the_communication_step(script: Script) -> None:
    example = script("examples/coupled_cart_pole.py")
    steps, errors, orders = np.array(example.convergence(1.0)).T
    assert errors[-1] < 2e-3
    assert orders[1:] == pytest.approx(np.log2(errors[:-1] / errors[1:]))
    assert orders[-1] == pytest.approx(1.0, abs=0.1)
    assert np.all(np.diff(steps) < 0)


def test_a_coupled_plant_keeps_the_contract_of_plants() -> None:
    from harness.conformance import check_plant

    for result in check_plant(lambda: loop(0.01)):
        assert result.passed, result


def test_the_engines_agree_as_their_steps_fall(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, script: Script) -> None:
    page = script("docs/engines_agree.py")
    monkeypatch.setattr(page, "SUBSTEPS", (2, 4, 8))
    found = page.measured()
    for engines in found.values():
        for name, errors in engines.items():
            assert page.order(errors) == pytest.approx(1.0 if name in ("pymunk", "Bullet") else 4.0, abs=0.1), name
    page.draw(found, tmp_path / "plot.svg")
    assert "order 4.0" in (tmp_path / "plot.svg").read_text()


def test_the_page_on_couplings_says_what_is_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from harness import api

    text = (ROOT / "docs" / "co-simulation.md").read_text()
    python, toml = (text.split(f"```{kind}\n")[1].split("```")[0] for kind in ("python", "toml"))
    names: dict[str, Any] = {}
    exec(compile(python, "co-simulation.md", "exec"), names)
    shown = capsys.readouterr().out.strip()
    assert f"# {shown}\n" in text
    (tmp_path / "loop.toml").write_text(toml)
    record = api.simulate(str(tmp_path / "loop.toml"), scenario="multisine", options={"order": "jacobi"})
    assert str(record.spec) == shown
    assert record.y[0, 0] == 0.3
    names["loop"].close()
