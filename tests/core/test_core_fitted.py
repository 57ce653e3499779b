"""Fitted models in the hand: read back, simulated, predicted with, handed to control design."""

from __future__ import annotations

import re
from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from harness import api, fitted
from harness.errors import InputError
from harness.signals import Channel, PlantSpec, Trajectory

DT = 0.1
SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), DT)
B, A = [0.0, 0.4, 0.1], [1.0, -1.3, 0.6]


def record(seed: int = 0, n: int = 600, noise: float = 0.0) -> Trajectory:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=n)
    y = lfilter(B, A, u) + noise * rng.normal(size=n)
    return Trajectory(DT * np.arange(n, dtype=np.float64), u[:, None], y[:, None], SPEC)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> fitted.FittedModel:
    path = tmp_path_factory.mktemp("fitted") / "model.json"
    options = {"order": 2, "offset": False}
    api.identify(record(), identifier="arx", options=options, out=path)
    model = api.load_model(path)
    assert isinstance(model, fitted.FittedModel)
    return model


def test_a_stored_model_is_the_system(stored: fitted.FittedModel) -> None:
    data = record(1, 200)
    assert np.abs(stored.simulate(data.u) - data.y).max() < 1e-6
    assert np.abs(stored.simulate(data) - data.y).max() < 1e-6
    assert np.sort_complex(stored.poles)[-2:] == pytest.approx(np.sort_complex(np.roots(A)), abs=1e-6)
    table = {"time [s]": data.t, "u [mV]": 1e3 * data.u[:, 0], "y [cm]": 1e2 * data.y[:, 0]}
    for way in (stored.predict(data), stored.predict(data.u, data.y), stored.predict(table)):
        assert np.isnan(way[0]).all()
        assert np.abs(way[10:] - data.y[10:]).max() < 1e-6


@given(cut=st.integers(20, 150), ahead=st.integers(1, 40))
def test_a_forecast_goes_on_where_the_record_ends(stored: fitted.FittedModel, cut: int, ahead: int) -> None:
    data = record(2, 200)
    told = stored.forecast(data[:cut], data.u[cut : cut + ahead])
    assert np.abs(told - data.y[cut : cut + ahead]).max() < 1e-6
    assert np.array_equal(told, stored.simulate(data.u[cut : cut + ahead], start=data[:cut]))


def test_responses_are_those_of_python_control(stored: fitted.FittedModel) -> None:
    system = stored.to_control()
    theirs = control.step_response(system, T=np.arange(60) * DT)
    ours = stored.step_response(59 * DT)
    assert ours.y[:, 0, 0] == pytest.approx(np.asarray(theirs.outputs).ravel(), abs=1e-9)
    assert np.diff(ours.y[:, 0, 0]) == pytest.approx(stored.impulse_response(59 * DT).y[1:, 0, 0], abs=1e-12)
    own = stored.step_response()
    assert own.y[-1, 0, 0] == pytest.approx(float(np.real(control.dcgain(system))), rel=0.02)
    assert "svg" in own._repr_html_()


def test_offsets_are_no_part_of_a_transfer_function() -> None:
    shifted = record(3)
    shifted = Trajectory(shifted.t, shifted.u, shifted.y + 5.0, SPEC)
    found = api.identify(shifted, identifier="arx", options={"order": 2})
    with pytest.raises(InputError, match="deviations=True"):
        found.to_control()
    gain = float(np.real(control.dcgain(found.to_control(deviations=True))))
    assert gain == pytest.approx(sum(B) / sum(A), rel=1e-6)
    assert found.step_response().y[-1, 0, 0] == pytest.approx(gain, rel=0.02)


def test_standard_deviations_are_told_where_the_identifier_gives_them() -> None:
    found = api.identify(record(4, 2000, 0.1), identifier="prediction-error", options={"structure": "oe"})
    assert found.estimate is not None
    name = next(name for name in found.estimate.names if "f1" in name)
    deviation = found.estimate.deviation(name)
    assert deviation is not None
    assert abs(found.estimate.value(name) - A[1]) < 4 * deviation < 0.2


def test_what_is_not_linear_says_what_to_do_instead(tmp_path: Path) -> None:
    file = tmp_path / "hold.json"
    api.identify(record(), identifier="hold", out=file)
    model = api.load_model(file)
    for call in (model.step_response, model.to_control, lambda: model.poles, lambda: model.simulate(np.zeros(3))):
        with pytest.raises(InputError, match="simulate"):
            call()
    assert not hasattr(model, "poles")
    assert getattr(model, "poles", None) is None


@pytest.mark.parametrize("bad", [np.zeros((4, 2)), np.full(3, np.nan), np.zeros((2, 2, 2))])
def test_inputs_of_another_shape_are_refused(stored: fitted.FittedModel, bad: np.ndarray) -> None:
    with pytest.raises(InputError, match=re.escape("u [V]")):
        stored.simulate(bad)


def test_a_forecast_needs_its_inputs(stored: fitted.FittedModel) -> None:
    with pytest.raises(InputError, match="inputs of a forecast"):
        stored.forecast(record(), steps=3)


def test_every_command_is_a_python_call() -> None:
    from typer.main import get_command

    from harness.cli.app import app

    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        if command.hidden:  # says where a command went
            continue
        if name == "open":  # a page for a person stands above the calls
            from harness.app.server import serve

            assert callable(serve)
            continue
        called = {"list": "list_parts"}.get(name, name.replace("-", "_"))
        assert callable(getattr(api, called)), name


@pytest.mark.parametrize("moving", [True, False])
def test_a_forecast_follows_a_record_that_is_too_short_to_fit(stored: fitted.FittedModel, moving: bool) -> None:
    past, later = record(4, 8), record(4, 11)
    table = {"time": past.t, "u [V]": moving * past.u[:, 0], "y [m]": moving * past.y[:, 0]}
    expected = later.y[8:] if moving else stored.simulate(np.zeros(3))
    given = later.u[8:] if moving else np.zeros(3)
    np.testing.assert_allclose(stored.forecast(table, given), expected, atol=1e-9)
