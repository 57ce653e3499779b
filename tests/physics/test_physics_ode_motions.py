"""States of an Ode that are declared speeds: the same equations, and the effects of a joint can act on them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.effects import builtin
from harness.effects.along import Signals, along, residual_function
from harness.effects.columns import column_blocks
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.errors import InputError
from harness.physics import Mechanism, Ode
from harness.physics.compiled.latent import with_latent_forces

UNITS = {"i": "A", "w": "rad/s", "v": "V"}
VALUES = {"R": 1.5, "L": 2e-3, "K": 0.06, "J": 1.5e-4, "b": 2e-5}
DT = 1e-3


def motor(**declared: object) -> Ode:
    ode = Ode("motor", x="i w", u="v", p="R L K J b", units=UNITS, parameters=VALUES, **declared)  # type: ignore[arg-type]
    (i, w), (v,), (r, inductance, k, inertia, b) = ode.x, ode.u, ode.p
    ode.rhs = [(v - r * i - k * w) / inductance, (k * i - b * w) / inertia]
    return ode


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(0.3, 3.0), min_size=5, max_size=5), st.integers(0, 10**6))
def test_a_declaration_changes_no_motion(scales: list[float], seed: int) -> None:
    """Whatever the parameters: the same outputs from the same start."""
    u = 5.0 * np.random.default_rng(seed).standard_normal((30, 1))
    plain, declared = motor().system(), motor(motions={"shaft": ("w", "J")}).system()
    p = np.array(list(VALUES.values())) * scales
    one = plain.simulator(DT, backend="casadi", substeps=8).rollout(p, [0.2, -3.0], u)
    two = declared.simulator(DT, backend="casadi", substeps=8).rollout(p, [1.0, -3.0, 0.2], u)
    assert [channel.name for channel in declared.states] == ["shaft", "w", "i"]
    assert np.allclose(one, two, rtol=1e-9, atol=1e-12)


def test_a_joint_of_an_ode_is_a_joint_of_a_mechanism() -> None:
    """Without inductance there is one coordinate only: every effect adds the same force."""
    ode = Ode("shaft", x="w", u="v", p="J b k", units=UNITS, motions={"phi": ("w", "J")},
              parameters={"J": 1e-4, "b": 1e-5, "k": 0.025})  # fmt: skip
    (w,), (v,), (inertia, b, k) = ode.x, ode.u, ode.p
    ode.rhs = [(k * v - b * w) / inertia]
    same = Mechanism("shaft", q="phi", u="v", p="J b k", units={"v": "V", "phi": "rad"},
                     parameters={"J": 1e-4, "b": 1e-5, "k": 0.025})  # fmt: skip
    (_,), (speed,), (volt,), (inertia, b, k) = same.q, same.v, same.u, same.p
    same.T, same.Q, same.outputs = inertia * speed**2 / 2, [k * volt - b * speed], {"w": (speed, "rad/s")}
    u = np.sin(np.arange(200) * 0.05)[:, None]
    sizes = {"phi": {"v": 10.0, "q": 1.0, "F": 0.01}}
    for name in ("coulomb_friction", "quadratic_drag", "cogging", "end_stop"):
        found = []
        for system in (ode.system(), same.system()):
            made = compose(system, [Placed(builtin()[name], "phi")], sizes=sizes)
            made = made.with_parameters({made.parameter_names[3]: 0.004})
            found.append(made.simulator(DT, backend="casadi").rollout(made.vector(), np.zeros(made.nx), u))
        assert np.allclose(*found, rtol=1e-9, atol=1e-12), name


def test_dry_friction_shows_along_a_motion_whose_current_is_not_measured() -> None:
    """The current is simulated along the motion; what is left over is the friction that was put in, and no more."""
    dry = Placed(builtin()["coulomb_friction"], "shaft", {"Fc": 0.01, "w": 0.5})
    nominal = motor(motions={"shaft": ("w", "J")}).system()
    true = compose(nominal, [dry])
    u = np.repeat(np.random.default_rng(0).uniform(-12.0, 12.0, 20), 50)[:, None]
    states = np.array(true.simulator(DT, backend="casadi", substeps=8).states(true.vector(), np.zeros(3), u))
    a = np.gradient(states[:, 1], DT)
    signals = Signals(np.arange(len(u)) * DT, u, states[:, :1], states[:, 1:2], a[:, None], others=states[0, 2:])
    left = along(residual_function(nominal), nominal, signals, nominal.vector(), None, signals.a)[:, 0]
    (block,) = [one for one in column_blocks(nominal, dry, signals) if one.columns.shape[-1] == 1]
    settled = np.abs(np.gradient(a, DT)) < np.quantile(np.abs(np.gradient(a, DT)), 0.8)  # not at the jumps of the input
    size = float(np.linalg.lstsq(block.columns[settled, 0], left[settled], rcond=None)[0][0])
    assert abs(size) == pytest.approx(0.01, rel=0.1)


def test_latent_forces_act_on_the_shaft_alone() -> None:
    disturbed = with_latent_forces(motor(motions={"shaft": ("w", "J")}).system())
    assert [str(channel) for channel in disturbed.system.states[3:]] == ["latent@shaft [N m]"]


@pytest.mark.parametrize(
    ("motions", "words"),
    [
        ({"shaft": ("omega", "J")}, "expected \\(speed, inertia\\)"),
        ({"shaft": ("i", "J")}, "rad/s or m/s"),
        ({"shaft": ("w", "M")}, "inertia of 'shaft'"),
        ({"w": ("w", "J")}, "motion 'w'.*the name of its speed"),
        ({"v": ("w", "J")}, "v"),
    ],
)
def test_what_cannot_be_a_motion_is_refused(motions: dict[str, tuple[str, str]], words: str) -> None:
    with pytest.raises(InputError, match=words):
        motor(motions=motions)


def test_a_coordinate_that_is_a_state_moves_at_its_speed() -> None:
    ode = Ode("cart", x="s c", u="F", p="m", units={"c": "m/s", "s": "m"}, motions={"s": ("c", "m")})
    (s, c), (force,), (m,) = ode.x, ode.u, ode.p
    ode.rhs = [c, (force - s) / m]
    assert [str(channel) for channel in ode.system().states] == ["s [m]", "c [m/s]"]
    ode.rhs = [2 * c, (force - s) / m]
    with pytest.raises(InputError, match="rate of 's'"):
        ode.system()


def test_one_motion_is_not_integrated_twice() -> None:
    """An angle beside the coordinate would be a second one that no effect of the joint knows."""
    ode = Ode("servo", x="angle w", u="v", p="J b", units={**UNITS, "angle": "rad"}, motions={"shaft": ("w", "J")},
              parameters={"J": 1e-4, "b": 1e-5})  # fmt: skip
    (_, w), (v,), (inertia, b) = ode.x, ode.u, ode.p
    ode.rhs = [w, (v - b * w) / inertia]
    with pytest.raises(InputError, match=r"state 'angle'.*the same motion twice.*name the coordinate 'angle'"):
        ode.system()
