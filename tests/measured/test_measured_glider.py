"""The perching glider exercise on the textbook's data: as written, with consistent signs, and its second question."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def glider(script):
    return script("docs/glider_figures.py")


@pytest.fixture(scope="module")
def data(recordings_folder):
    path = recordings_folder / "textbook" / "glider_sim_data.npz"
    if not path.is_file():
        pytest.skip(f"no textbook data at {path}")
    return dict(np.load(path))


def test_the_exercise_as_written_scores_63831(data, glider):
    assert int(glider.score_of_six(data, nose_down=False)) == 63831


def test_with_consistent_signs_three_functions_leave_less_than_2_6(data, glider):
    score, functions = glider.score_of_best(data, 3, nose_down=True)
    assert score <= 2.6
    assert functions == [[5, 15, 24], [1, 26, 30], [15, 26, 30]]
    assert glider.score_of_best(data, 3, nose_down=False)[0] > 1e4


def test_more_functions_fit_the_run_better_and_other_runs_worse(data, glider):
    inside, outside = glider.held_out(data, 0.3, range(1, 9), draws=15)
    assert (np.diff(inside) < 0).all()
    assert int(np.argmin(outside)) + 1 in (2, 3)
    assert outside[-1] > 2 * outside.min()
