"""Exported FMUs run by clients that are not fmpy: libcosimpy (FMILibrary, FMI 2.0) and fmuloader (FMI 3.0)."""

from __future__ import annotations

import numpy as np
import pytest
from fmpy import read_model_description

from harness.effects import Placed, builtin, compose
from harness.export import write_fmu
from harness.physics.models import cart_pole, pendulum

DT, N = 0.01, 300


def put(name, at, **values):
    return Placed(builtin()[name], at, values)


CASES = {
    "pendulum": (pendulum, []),
    "cart-pole": (cart_pole, []),
    "coulomb": (pendulum, [put("coulomb_friction", "theta")]),
    "delay": (pendulum, [put("input_delay", "u")]),
    "lag and offset": (pendulum, [put("actuator_lag", "u"), put("sensor_offset", "theta")]),
    "quantiser": (pendulum, [put("sensor_quantisation", "theta")]),
}


@pytest.fixture(params=sorted(CASES))
def model(request):
    make, placed = CASES[request.param]
    sizes = {"": {"dt": DT, "T": N * DT, "u": 1.0, "q": 0.3, "v": 1.0, "y": 0.3, "F": 1.0, "a": 10.0}}
    nominal = make().system()
    system = compose(nominal, placed, sizes=sizes) if placed else nominal
    simulator = system.simulator(DT, backend="casadi", substeps=4)
    u = 0.5 * np.cos(0.07 * np.arange(N))[:, None]
    x = np.zeros(system.nx)
    x[: nominal.nx] = 0.2
    x0 = dict(zip([c.name for c in nominal.states], x, strict=False))
    x[nominal.nx :] = simulator.hidden_start(x, u[0], system.vector())
    return simulator, u, x0, simulator.rollout(system.vector(), x, u)


def references(path, names):
    variables = {one.name: one.valueReference for one in read_model_description(str(path)).modelVariables}
    return [variables[name] for name in names]


def test_libcosimpy_repeats_our_rollout(model, tmp_path):
    pytest.importorskip("libcosimpy", reason="libcosimpy is not installed: pip install libcosimpy")
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
    from libcosimpy.CosimManipulator import CosimManipulator
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    simulator, u, x0, y = model
    path = write_fmu(simulator, simulator.system.values(), tmp_path / "m.fmu", version=2, x0=x0)
    inputs = references(path, [c.name for c in simulator.spec.inputs])
    outputs = references(path, [c.name for c in simulator.spec.outputs])
    log_output_level(CosimLogLevel.ERROR)
    execution = CosimExecution.from_step_size(step_size=round(DT * 1e9))  # nanoseconds
    local = CosimLocalSlave(fmu_path=str(path), instance_name="model")
    slave = execution.add_local_slave(local)
    manipulator, observer = CosimManipulator.create_override(), CosimObserver.create_last_value()
    assert execution.add_manipulator(manipulator=manipulator)
    assert execution.add_observer(observer=observer)
    rows = []
    for k in range(N - 1):
        assert manipulator.slave_real_values(slave_index=slave, variable_references=inputs, values=list(u[k]))
        assert execution.step()
        rows.append(list(observer.last_real_values(slave_index=slave, variable_references=outputs)))
    assert np.abs(np.array(rows) - y[1:]).max() <= 1e-6


def test_fmuloader_repeats_our_rollout(model, tmp_path):
    fmi3 = pytest.importorskip("fmuloader.fmi3", reason="fmuloader is not installed: pip install fmuloader")
    simulator, u, x0, y = model
    path = write_fmu(simulator, simulator.system.values(), tmp_path / "m.fmu", version=3, x0=x0)
    description = read_model_description(str(path))
    inputs = references(path, [c.name for c in simulator.spec.inputs])
    outputs = references(path, [c.name for c in simulator.spec.outputs])
    fmu = fmi3.Fmi3Slave(
        path, model_identifier=description.coSimulation.modelIdentifier, unpack_dir=tmp_path / "unpacked"
    )
    fmu.instantiate_co_simulation("model", instantiation_token=description.instantiationToken)
    fmu.enter_initialization_mode(start_time=0.0)
    fmu.exit_initialization_mode()
    rows = [fmu.get_float64(outputs)]
    for k in range(N - 1):
        fmu.set_float64(inputs, list(u[k]))
        result = fmu.do_step(k * DT, DT)
        assert not result.terminate_simulation
        rows.append(fmu.get_float64(outputs))
    fmu.terminate()
    fmu.free_instance()
    assert np.abs(np.array(rows) - y).max() <= 1e-6
