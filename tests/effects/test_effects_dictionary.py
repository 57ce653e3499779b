"""The dictionary: complete, documented, registered, readable units; a third party's effect in six lines."""

from __future__ import annotations

import pickle
import sys
import types

import numpy as np
import pytest

from harness import registry
from harness.effects import (
    Dictionary,
    Effect,
    EffectParameter,
    Placed,
    builtin,
    compose,
    effect,
    find,
    par,
    place_all,
    port_of,
)
from harness.errors import InputError
from harness.physics.models import BUILT_IN, pendulum
from harness.physics.symbolic.typed import read_equations
from harness.units import fits as unit_fits

NAMES = """viscous_friction coulomb_friction stribeck_friction sublinear_friction asymmetric_friction quadratic_drag
load_dependent_friction hysteresis position_dependent_friction linear_spring quadratic_spring cubic_spring gravity_tilt
eccentric_load payload_step mass_step end_stop dead_zone saturation rate_limit input_delay actuator_lag input_gain
force_bias force_step
backlash elastic_load elasticity cogging sensor_offset sensor_gain sensor_cyclic_error sensor_delay sensor_rectification
sensor_saturation sensor_quantisation sensor_nonlinearity position_dependent_damping maxwell_element input_compression
periodic_disturbance overflow level_saturation leak yield_friction
lugre_friction lugre_coulomb_friction lugre_asymmetric_friction lugre_load_dependent_friction
lugre_position_dependent_friction lugre_sublinear_friction lugre_yield_friction
parallel_hysteresis hardening_elasticity unilateral_backlash drifting_damping drifting_gain
sensor_drift gear_loss torque_ripple supply_sag propeller_thrust counterbalance wobbling_base unbalanced_load radiation
sensor_lag sensor_filter sensor_hum
thermal_damping thermal_friction thermal_gain degressive_friction gear_friction
gear_stribeck_friction asymmetric_damping one_sided_stop""".split()


LAWS = Dictionary.builtin()


def test_every_name_of_the_dictionary_is_there_and_registered():
    assert sorted(builtin()) == sorted(NAMES)
    registered = {entry.id for entry in registry.entries("effects") if entry.distribution == "sysid-harness"}
    assert registered == set(NAMES)
    for name in NAMES:
        assert registry.load("effects", name) is builtin()[name]


@pytest.mark.parametrize("name", NAMES)
def test_every_effect_says_what_a_reader_needs(name):
    one = builtin()[name]
    assert one.summary.endswith(".")
    assert one.formula
    assert one.experiment
    assert one.family
    assert sum(parameter.main for parameter in one.parameters) == (1 if one.parameters else 0)
    mentioned = {*one.family, *one.nests, *one.same_as, *one.limits} - {"parameter"}
    for other in mentioned:
        for part in other.split(" + "):
            assert part in builtin(), f"{name} speaks of {part}, which there is not"
    for parameter in one.parameters:
        assert parameter.meaning, f"{name}.{parameter.name} is not explained"
        assert parameter.minimum < parameter.maximum
        if parameter.neutral is not None:
            assert parameter.minimum <= parameter.neutral <= parameter.maximum
        if parameter.main and parameter.sign != "any" and np.isfinite(parameter.minimum):
            assert parameter.minimum >= 0  # an answer of the wrong sign must be possible or excluded, never half so


@pytest.mark.parametrize("model", sorted(BUILT_IN))
def test_units_on_every_port_can_be_read(model):
    system = BUILT_IN[model]().system()
    for placed in place_all(system):
        composed = compose(system, [placed])
        for parameter in composed.parameters[system.np :]:
            assert unit_fits(parameter.unit, parameter.unit), parameter
        for state in composed.states[system.nx :]:
            assert unit_fits(state.unit, state.unit), state


def test_units_are_what_physics_says():
    system = pendulum().system()
    units = {
        ("viscous_friction", "theta", "b"): "N m s/rad",
        ("coulomb_friction", "theta", "Fc"): "N m",
        ("cubic_spring", "theta", "k3"): "N m/rad^3",
        ("dead_zone", "u", "width"): "N m",
        ("rate_limit", "u", "R"): "N m/s",
        ("elasticity", "theta", "Jm"): "N m s^2/rad",
        ("sensor_offset", "theta", "offset"): "rad",
    }
    for (name, at, parameter), unit in units.items():
        placed = Placed(builtin()[name], at)
        assert unit_fits(compose(system, [placed]).parameter(placed.name(parameter)).unit, unit)


def test_start_values_follow_the_sizes_of_the_data():
    coulomb = builtin()["coulomb_friction"]
    assert coulomb.parameter("Fc").start({"F": 4.0}) == pytest.approx(0.2)  # 5 % of the rms force
    assert builtin()["actuator_lag"].main.start({"dt": 0.01}) == pytest.approx(0.02)  # two samples
    assert coulomb.parameter("Fc").start({"F": 0.0}) == pytest.approx(0.05)  # nothing moved: no division, no zero
    assert len(builtin()["backlash"].main.starts({"q": 1.0})) > 2  # gaps have local minima


def test_nested_members_and_confusions():
    assert [one.name for one in LAWS.nested(builtin()["backlash"])] == ["elasticity"]
    assert {one.name for one in LAWS.nested(builtin()["asymmetric_friction"])} == {"coulomb_friction", "force_bias"}
    tilt = LAWS.family(builtin()["gravity_tilt"])
    assert {"sensor_offset", "eccentric_load"} <= set(tilt.exact)
    assert "actuator_lag" in LAWS.family(builtin()["input_delay"]).limit
    assert "stribeck_friction" in LAWS.family(builtin()["coulomb_friction"]).limit
    assert "parameter" in LAWS.family(builtin()["input_gain"]).exact


def test_a_law_of_others_is_related_to_ours_as_they_are_among_each_other():
    """A plug-in's law that nests Coulomb friction was unknown to it, and no more general than it."""

    @effect("coordinate", [par("Fc", "F", neutral=0.0), par("w", "v", nuisance=True), par("r", "1")],
            nests=("coulomb_friction",), family=("hysteresis",), whole="dry friction")  # fmt: skip
    def my_rich(f, s, p, q, v):
        return -p.Fc * (1 + p.r * v) * v

    laws = Dictionary([*builtin().values(), my_rich])
    coulomb = laws["coulomb_friction"]
    assert [law.name for law in laws.nested(my_rich)] == ["coulomb_friction"]
    assert "my_rich" in laws.family(coulomb).near
    assert laws.refines(Placed(my_rich, "x"), Placed(coulomb, "x"))
    assert not laws.refines(Placed(my_rich, "x"), Placed(coulomb, "theta"))
    assert "coulomb_friction@x" in laws.contained([Placed(my_rich, "x")])
    with pytest.raises(InputError, match="two effects named 'my_rich'"):
        Dictionary([my_rich, effect("coordinate", {"b": "F/v"}, name="my_rich")(lambda f, s, p, q, v: 0.0 * v)])


def test_an_effect_names_kinds_of_experiments_that_there_are():
    with pytest.raises(InputError, match="told_by"):
        effect("coordinate", told_by=("a good look",))


def test_effects_travel_between_processes():
    for one in builtin().values():
        assert pickle.loads(pickle.dumps(one)) is one
    placed = pickle.loads(pickle.dumps(Placed(builtin()["backlash"], "theta", {"gap": 0.1})))
    assert placed == Placed(builtin()["backlash"], "theta", {"gap": 0.1})


def test_a_third_party_writes_an_effect_in_six_lines():
    source = """
from harness.effects import effect
from harness.effects.functions import tanh
@effect("coordinate", dict(T0="F", r="v"), states=dict(heat="1"))
def warming_friction(f, s, p, q, v):
    return -p.T0 / (1 + s.heat) * tanh(v / p.r), [abs(v)]
"""
    module = types.ModuleType("warm_plugin")
    sys.modules["warm_plugin"] = module
    exec(compile(source, "warm_plugin.py", "exec"), module.__dict__)
    mine = module.warming_friction
    assert isinstance(mine, Effect)
    assert mine.main.name == "T0"
    system = compose(pendulum().system(), [Placed(mine, "theta", {"T0": 0.1, "r": 0.05})])
    assert [state.name for state in system.states] == ["theta", "theta_rate", "warming_friction@theta.heat"]
    y = system.simulator(0.01, backend="casadi").rollout(system.vector(), [1.0, 0.0, 0.0], np.zeros((300, 1)))
    free = pendulum().system()
    y0 = free.simulator(0.01, backend="casadi").rollout(free.vector(), [1.0, 0.0], np.zeros((300, 1)))
    assert np.abs(y[-100:]).max() < np.abs(y0[-100:]).max()
    assert "warming_friction@theta" in [str(one) for one in place_all(free, [mine])]
    assert pickle.loads(pickle.dumps(mine)) is mine
    del sys.modules["warm_plugin"]


def test_what_a_third_party_gets_wrong_is_said():
    with pytest.raises(InputError, match=r"\(signal, s, p, q, v\)"):
        effect("input", {"k": "u"})(lambda u, p: p.k * u)
    with pytest.raises(InputError, match="kind of an effect"):
        effect("motor", {"k": "u"})
    lost = effect("input", {"k": "s"}, states="z")(lambda u, s, p, q, v: (s.z, []))
    with pytest.raises(InputError, match="one for each of z"):
        compose(pendulum().system(), [Placed(lost, "u")])
    curved = effect("coordinate", {"k": "1"})(lambda f, s, p, q, v, a: p.k * a**2)
    with pytest.raises(InputError, match="linear in the acceleration"):
        compose(pendulum().system(), [Placed(curved, "theta")])


def test_unknown_names_and_ports_are_refused_with_what_fits():
    with pytest.raises(InputError, match="did you mean coulomb_friction"):
        find("coulom_friction")
    system = pendulum().system()
    with pytest.raises(InputError, match="expected one of theta, got 'u'"):
        port_of(system, Placed(builtin()["coulomb_friction"], "u"))
    with pytest.raises(InputError, match="placed twice"):
        compose(system, [Placed(builtin()["coulomb_friction"], "theta")] * 2)
    with pytest.raises(InputError, match="parameter of effect dead_zone"):
        compose(system, [Placed(builtin()["dead_zone"], "u", {"gap": 1.0})])
    with pytest.raises(InputError, match=r"expected a number in \[0, inf\]"):
        compose(system, [Placed(builtin()["dead_zone"], "u", {"width": -1.0})])


def test_parameters_in_a_list_keep_their_main_one():
    two = effect("coordinate", [par("a", "F"), EffectParameter("b", "F", main=True)])(lambda f, s, p, q, v: p.a + p.b)
    assert two.main.name == "b"


def test_a_drive_that_clips_the_peaks_of_a_sine_has_a_start_that_does():
    """Where no start clips a little, the likelihood is flat above and far worse below, and nothing leads there."""
    limits = builtin()["saturation"].parameter("limit").starts({"u": np.sqrt(0.5)})
    assert any(0.87 < limit < 0.97 for limit in limits), limits


def test_a_supply_sags_at_its_start_by_no_more_than_a_command_could_make_it() -> None:
    """Of a record that its start told nothing it was 1e33 V, and hid the rows that the sag did not follow."""
    start = next(one for one in LAWS["supply_sag"].parameters if one.name == "z0")
    assert start.highest({"u": 2.0}, start.start({"u": 2.0})) == 6.0  # three times the rms command


@pytest.mark.parametrize("read", ["place", "speed"])
def test_a_law_about_a_place_needs_a_plant_that_knows_where_it_stands(read: str) -> None:
    """A car that is read by its speed begins anywhere: a bent spring from there took what its dry friction explains."""
    place = "state x [m]\nx' = v\noutput x\n" if read == "place" else "output v\n"
    at = "x" if read == "place" else "car"
    text = f"state v [m/s]\nmotion {at}: v, m\nm = 76 kg fixed\nb = 0.5 N s/m >= 0\nv' = -b*v/m\n{place}"
    system = read_equations(text).system()
    about = {"quadratic_spring", "cubic_spring", "end_stop", "one_sided_stop", "position_dependent_damping"}
    tried = {one.effect.name for one in place_all(system)}
    assert tried >= {"linear_spring", "coulomb_friction", "quadratic_drag"}
    assert tried & about == (about if read == "place" else set())
    assert port_of(system, Placed(builtin()["cubic_spring"], at)).name == at, "who asks for it may have it"
