"""Hypothesis strategies for users' own tests: systems to identify, and what surrounds them in an experiment.

Systems: :func:`linear_systems` and :func:`tempered_systems` (unstable, stiff, lightly damped, non-minimal),
:func:`finite_processes`, :func:`mechanisms`, :func:`arms`, :func:`placed_effects`. Around them: :func:`excitations`,
:func:`noises`, :func:`defective_recordings`, :func:`trajectories` of any finite numbers.

A user tests an estimator of her own with them::

    @given(tempered_systems(tempers=("stiff", "lightly damped")), noises(most=0.01), st.integers(0, 2**32 - 1))
    def test_free_runs_stay_close(system, noise, seed):
        records = [simulate_linear(system, 500, rng=np.random.default_rng(seed + k)) for k in (0, 1)]
        model = Mine().fit([noise(records[0])], rng=np.random.default_rng(0))
        assert simulation_error(model, records[1]).nrmse.max() < 0.2
"""

from __future__ import annotations

from harness.testing.arms import arms, random_motion, random_rotation
from harness.testing.records import (
    DEFECTS,
    EXCITATIONS,
    NOISES,
    Defective,
    Noise,
    defective_recordings,
    excitations,
    mechanisms,
    noises,
    placed_effects,
)
from harness.testing.systems import (
    TEMPERS,
    FiniteProcess,
    LinearSystem,
    channels,
    finite_processes,
    linear_systems,
    plant_specs,
    simulate_finite,
    simulate_linear,
    tempered_systems,
    trajectories,
)

__all__ = [
    "DEFECTS",
    "EXCITATIONS",
    "NOISES",
    "TEMPERS",
    "Defective",
    "FiniteProcess",
    "LinearSystem",
    "Noise",
    "arms",
    "channels",
    "defective_recordings",
    "excitations",
    "finite_processes",
    "linear_systems",
    "mechanisms",
    "noises",
    "placed_effects",
    "plant_specs",
    "random_motion",
    "random_rotation",
    "simulate_finite",
    "simulate_linear",
    "tempered_systems",
    "trajectories",
]
