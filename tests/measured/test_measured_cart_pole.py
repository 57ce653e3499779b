"""The chapter's cart-pole through records and identifiers: its own figures digit for digit, then better methods."""

import pytest

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def figures(script):
    return script("docs/mechanical_figures.py")


@pytest.fixture(scope="module")
def found(recordings_folder, figures):
    folder = recordings_folder / "textbook"
    if not (folder / "cartpole_lumped_data_damped.npz").is_file():
        pytest.skip(f"no textbook data at {folder}")
    return figures.fits(folder)


def test_the_chapters_figures_digit_for_digit(found):
    chapter = found["torque, forward differences"]
    assert round(chapter["mc + mp"], 8) == 10.90542535
    assert round(chapter["l*mp"], 8) == 0.59457971
    assert round(chapter["l**2*mp"], 8) == 0.30291575


@pytest.mark.parametrize(("method", "worst"), [("energy", 3e-5), ("momentum", 3e-5), ("torque, spline", 1e-5)])
def test_the_same_data_with_better_methods(found, figures, method, worst):
    for name, true in figures.TRUTH.items():
        assert found[method][name] == pytest.approx(true, rel=worst)
