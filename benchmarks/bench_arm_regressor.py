"""Regressor of the iiwa for 1e5 samples: a loop over Pinocchio's, and ours; then the inertial semidefinite program.

Run: python benchmarks/bench_arm_regressor.py     (needs pin, a development extra, and PyBullet's data)
Both fill the same block of memory, 2000 samples at a time, in alternating rounds; the least of the rounds counts.
"""

from __future__ import annotations

import time

import numpy as np
import pinocchio as pin
from timing import least_times

from harness.physics.arms.arm import load_arm
from harness.physics.arms.inertial_fit import Bodies, InertialProblem, by_log_cholesky, by_semidefinite_program
from harness.physics.arms.regressor import ArmRegressor

SAMPLES, BLOCK, ROUNDS = 100_000, 2000, 3


def main() -> None:
    arm = load_arm("iiwa")
    model = pin.buildModelFromUrdf(str(arm.path))
    data = model.createData()
    q, v, a = np.random.default_rng(0).normal(size=(3, SAMPLES, arm.n))
    block = np.empty((BLOCK, arm.n, 70))
    start = time.perf_counter()
    regressor = ArmRegressor(arm.arm.joints)
    regressor(q[:4], v[:4], a[:4])
    print(f"ours, made and compiled (kept on disk): {time.perf_counter() - start:.2f} s")

    def theirs() -> None:
        for first in range(0, SAMPLES, BLOCK):
            for k in range(BLOCK):
                row = first + k
                block[k] = pin.computeJointTorqueRegressor(model, data, q[row], v[row], a[row])

    def ours() -> None:
        for first in range(0, SAMPLES, BLOCK):
            part = slice(first, first + BLOCK)
            block[:] = regressor(q[part], v[part], a[part]).reshape(block.shape)

    (loop, own), _ = least_times(theirs, ours, rounds=ROUNDS)
    print(f"regressor of {SAMPLES} samples: Pinocchio loop {loop:.3f} s, ours {own:.3f} s, ratio {loop / own:.1f}")

    truth = arm.arm.parameters
    noise = np.random.default_rng(1).normal(size=(2000, arm.n))
    rows = regressor(q[:2000], v[:2000], a[:2000])
    gram = rows.T @ rows
    side = rows.T @ (rows @ truth + noise.ravel())
    problem = InertialProblem(gram, side, Bodies(truth), 0.3, np.zeros(0, dtype=bool))
    for solve in (by_semidefinite_program, by_log_cholesky):
        (spent,), (answer,) = least_times(lambda solve=solve: solve(problem), rounds=1)
        print(f"{solve.__name__}: {spent:.2f} s of CPU, cost {problem.cost(answer):.6f}")


if __name__ == "__main__":
    main()
