"""What all tests share: hypothesis profiles, the folder of recordings, one thread for linear algebra."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import hypothesis
import pytest

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

hypothesis.settings.register_profile("ci", max_examples=20, deadline=None, derandomize=True, database=None)
hypothesis.settings.register_profile("dev", max_examples=100, deadline=None)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


@pytest.fixture(scope="session")
def recordings_folder() -> Path:
    """Return the folder of measured data: $SYSID_HARNESS_DATA, or shared/data beside the checkout."""
    given = os.environ.get("SYSID_HARNESS_DATA")
    folder = Path(given) if given else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not (folder / "emps").is_dir():
        pytest.skip(
            f"no recordings at {folder}: set SYSID_HARNESS_DATA to the folder that holds emps/, silverbox/, ..."
        )
    os.environ["SYSID_HARNESS_DATA"] = str(folder)
    return folder


@pytest.fixture(scope="session")
def script() -> Callable[[str], ModuleType]:
    """Return what loads a script of the checkout, named from its top, as a module."""

    def load(name: str) -> ModuleType:
        path = Path(__file__).resolve().parents[1] / name
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as slow what ``first_of_each(*arguments)`` leaves to the night: further options of the same identifier."""
    seen = set()
    for item in items:
        marker = item.get_closest_marker("first_of_each")
        if marker is None or not isinstance(item, pytest.Function) or item.get_closest_marker("slow"):
            continue
        values = (item.callspec.params[argument] for argument in marker.args)
        key = item.originalname, *(value[0] if isinstance(value, tuple) else value for value in values)
        if key in seen:
            item.add_marker("slow")
        seen.add(key)
