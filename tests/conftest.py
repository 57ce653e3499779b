"""What all tests share: hypothesis profiles, the folder of recordings, one thread for linear algebra."""

from __future__ import annotations

import gc
import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import hypothesis
import pytest

sys.path.insert(0, str(Path(__file__).parent))  # what tests of several folders share is a module beside them
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


@pytest.fixture(scope="session")
def odd_fmu(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Return a builder of FMUs that misbehave: name of a folder in a fmus/, FMI version -> path of the FMU."""
    from harness.fmi import build

    if build.compiler() is None:
        pytest.skip("no C compiler: install gcc")
    folder = tmp_path_factory.mktemp("fmus")

    def built(name: str, version: int = 2) -> Path:
        target = folder / f"{name}-{version}.fmu"
        if not target.is_file():
            (source,) = Path(__file__).parent.glob(f"*/fmus/{name}")
            build.build_fmu(source, version, target)
        return target

    return built


@pytest.fixture
def sysid(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Return what runs ``sysid ARGUMENTS``, asks for its exit status, and returns what was printed (out, err)."""
    from harness.command import main

    def call(*arguments: object, status: int = 0) -> Any:
        with pytest.raises(SystemExit) as ended:
            main([str(one) for one in arguments])
        said = capsys.readouterr()
        assert (ended.value.code or 0) == status, said.err
        return said

    return call


def pytest_sessionstart() -> None:
    """Nothing is thrown away while tests are collected, so nothing is looked through for garbage."""
    gc.disable()


def pytest_collection_finish() -> None:
    """What was collected stays to the end: the collector leaves it out for good."""
    gc.freeze()
    gc.enable()


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
