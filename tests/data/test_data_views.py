"""Records for other libraries, and their results as records."""

from __future__ import annotations

import numpy as np
import pytest

from harness.data import from_control, from_fmpy, to_pandas, to_polars, to_xarray
from harness.errors import InputError
from harness.signals import Channel, PlantSpec, Trajectory

SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.5)
RECORD = Trajectory(np.arange(4) * 0.5, np.arange(4.0)[:, None], np.arange(4.0)[:, None] ** 2, SPEC)


def test_pandas() -> None:
    pytest.importorskip("pandas", reason="pandas is not installed")
    frame = to_pandas(RECORD)
    assert list(frame.columns) == ["u [N m]", "theta [rad]"]
    assert frame.loc[1.5, "theta [rad]"] == 9.0


def test_polars() -> None:
    pytest.importorskip("polars", reason="polars is not installed")
    assert to_polars(RECORD)["theta [rad]"].to_list() == [0.0, 1.0, 4.0, 9.0]


def test_xarray() -> None:
    pytest.importorskip("xarray", reason="xarray is not installed")
    data = to_xarray(RECORD)
    assert data["theta"].attrs["units"] == "rad"
    assert float(data["theta"].sel(time=1.5)) == 9.0


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(InputError, match="polars"):
        to_polars(RECORD)


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning", "ignore::DeprecationWarning")
def test_a_response_of_python_control() -> None:
    import control

    system = control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)
    t = np.arange(20) * 0.1
    u = np.sin(t)
    record = from_control(control.forced_response(system, t, u), units={"y[0]": "m"})
    assert record.u[:, 0] == pytest.approx(u)
    assert record.y[1:, 0] == pytest.approx(0.5 * record.y[:-1, 0] + u[:-1])
    assert record.x is not None
    assert str(record.spec.outputs[0]) == "y[0] [m]"


def test_a_result_of_fmpy_has_its_inputs_moved_to_where_they_acted() -> None:
    t, u = np.arange(5) * 0.1, np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    result = np.zeros(5, dtype=[("time", float), ("u", float), ("y", float)])
    result["time"] = t
    result["u"] = np.concatenate([u[:1], u[:-1]])  # as simulate_fmu records it
    result["y"] = np.cumsum(np.concatenate([[0.0], u[:-1]])) * 0.1
    record = from_fmpy(result, inputs=("u",), units={"y": "m"})
    assert record.u[:-1, 0].tolist() == u[:-1].tolist()
    assert record.y[1:, 0] == pytest.approx(record.y[:-1, 0] + 0.1 * record.u[:-1, 0])
    with pytest.raises(InputError, match="missing column"):
        from_fmpy(result, inputs=("v",))
