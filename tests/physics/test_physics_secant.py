"""What gradients tell of a curvature beyond Fisher's matrix."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from harness.physics.fitting.secant import Here, Secant


class Curved:
    """Sum of squares of errors (m,) that are quadratic in two entries: its curvature is known."""

    def __init__(self, seed: int, bend: float) -> None:
        rng = np.random.default_rng(seed)
        self.errors, self.slopes = 3.0 * rng.standard_normal(40), rng.standard_normal((40, 2))
        bends = rng.standard_normal((40, 2, 2))
        self.bends = bend * (bends + bends.transpose(0, 2, 1))

    def error(self, z: np.ndarray) -> np.ndarray:
        return np.asarray(self.errors + self.slopes @ z + 0.5 * np.einsum("mij,i,j->m", self.bends, z, z))

    def derivatives(self, z: np.ndarray) -> np.ndarray:
        return np.asarray((self.slopes + self.bends @ z).T)

    def curvature(self, z: np.ndarray) -> np.ndarray:
        by = self.derivatives(z)
        return np.asarray(by @ by.T + np.einsum("m,mij->ij", self.error(z), self.bends))

    def learned(self, secant: Secant, z: np.ndarray) -> np.ndarray:
        by, error = self.derivatives(z), self.error(z)
        here = Here(z, 0.5 * float(error @ error), by @ error, by @ by.T, (by, by))
        secant.learn(here, lambda derivatives: derivatives[0] @ error)
        return secant.added_to(here.matrix)


def test_gradients_along_steps_tell_the_curvature_that_first_derivatives_leave_out() -> None:
    shares = []
    for seed in range(40):
        problem, secant, z = Curved(seed, 0.15), Secant(2), np.zeros(2)
        for angle in np.linspace(0.0, 2 * np.pi, 9):
            z = z + 1e-4 * np.array([np.cos(angle), np.sin(angle)])
            matrix = problem.learned(secant, z)
        fisher, whole = problem.derivatives(z) @ problem.derivatives(z).T, problem.curvature(z)
        assert np.linalg.eigvalsh(whole)[0] > 0.2 * np.linalg.eigvalsh(fisher)[0], "or what is learned is cut"
        shares.append(np.abs(matrix - whole).max() / np.abs(fisher - whole).max())
    assert np.mean(np.array(shares) < 0.3) > 0.8, "where Fisher's matrix foretold the last step as well, it stays"


@given(seed=st.integers(0, 2**32 - 1), bend=st.floats(0.0, 3.0))
def test_every_step_leads_down(seed: int, bend: float) -> None:
    problem, secant, z = Curved(seed, bend), Secant(2), np.zeros(2)
    for number in range(6):
        matrix = problem.learned(secant, z)
        assert np.linalg.eigvalsh(matrix)[0] > 0.0
        z = z + 0.1 * np.array([np.cos(number), np.sin(number)])
