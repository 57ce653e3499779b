"""What all adapters ask of the records, and how a foreign failure becomes a named refusal."""

from __future__ import annotations

import contextlib
import importlib
import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from harness.errors import FitError, HarnessError, InputError
from harness.signals import PlantSpec, Trajectory

__all__ = ["NO_JUDGE", "ONE_RECORD", "called", "longest", "package", "real_records"]

NO_JUDGE: Mapping[str, str] = {"feedback_told": "the package does not look for feedback"}
"""Checks of the contract that no package keeps."""
ONE_RECORD: Mapping[str, str] = {**NO_JUDGE, "all_records_used": "the package takes one record: the longest"}
"""Those that packages of one record do not keep."""


def package(name: str, distribution: str) -> Any:
    """Return a package, or say how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"peer {distribution}",
            expected=f"the package {distribution}",
            got="it is not installed",
            remedy=f"pip install {distribution}",
        ) from error


def real_records(trajectories: Sequence[Trajectory], samples: int, what: str) -> tuple[list[Trajectory], PlantSpec]:
    """Return the records long enough, and their spec without states; refuses what no adapter takes."""
    if not trajectories or any(one.spec != trajectories[0].spec for one in trajectories):
        raise FitError(
            f"{what}: records", expected="records of one plant", got="none or others", remedy="separate them"
        )
    spec = trajectories[0].spec
    if any(channel.kind != "real" for channel in (*spec.inputs, *spec.outputs)) or not spec.nu:
        raise FitError(f"{what}: signals", expected="real inputs and outputs", got=str(spec), remedy="choose another")
    records = [one.measured() for one in trajectories if len(one) >= samples]
    if not records or not any(np.ptp(one.u) > 0 for one in records):
        raise FitError(
            f"{what}: records", expected=f"an excited record of {samples} samples", got="none", remedy="record longer"
        )
    return records, replace(spec, states=())


def longest(records: Sequence[Trajectory]) -> Trajectory:
    """Return the longest record; of several, the one with the largest input, so that their order does not matter."""
    return max(records, key=lambda one: (len(one), float(np.abs(one.u).sum())))


@contextlib.contextmanager
def called(what: str) -> Iterator[None]:
    """Silence a foreign call, and turn whatever it raises (exits included) into a refusal."""
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    except HarnessError:
        raise
    except (Exception, SystemExit) as error:
        raise FitError(
            what,
            expected="a model",
            got=f"{type(error).__name__}: {error}",
            remedy="record more, or change its options",
        ) from error
