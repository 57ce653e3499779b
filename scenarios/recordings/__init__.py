"""Recipes for public recordings: which signals, which split, which model, where to download.

Each name below is the path of a recipe (a dataset.toml with a ``[source]`` section). The recordings themselves are
not shipped: they are looked for under ``$SYSID_HARNESS_DATA``.
"""

from __future__ import annotations

from pathlib import Path

from harness.data import LoadedDataset, load_dataset
from harness.errors import refuse_unknown

__all__ = [
    "RECORDINGS",
    "cascaded_tanks",
    "coupled_drives",
    "coupled_drives_1",
    "coupled_drives_2",
    "coupled_drives_3",
    "emps",
    "hair_dryer",
    "load_recording",
    "multi_arm_pendulum",
    "silverbox",
]

_HERE = Path(__file__).resolve().parent

emps = _HERE / "emps.toml"
"""EMPS: friction of a linear drive in closed loop."""

silverbox = _HERE / "silverbox.toml"
"""Silverbox: an electronic oscillator with a hardening spring."""

cascaded_tanks = _HERE / "cascaded-tanks.toml"
"""Cascaded tanks: two tanks with overflow."""

coupled_drives = _HERE / "coupled-drives.toml"
"""Coupled electric drives: a belt drive whose sensor reads the absolute speed, three recordings by one model."""

coupled_drives_1 = _HERE / "coupled-drives-1.toml"
"""Coupled electric drives, the recording with 1 V."""

coupled_drives_2 = _HERE / "coupled-drives-2.toml"
"""Coupled electric drives, the recording with 1.5 V."""

coupled_drives_3 = _HERE / "coupled-drives-3.toml"
"""Coupled electric drives, the recording with 0.5 V."""

multi_arm_pendulum = _HERE / "multi-arm-pendulum.toml"
"""One arm of a multi-arm pendulum: free swing with dry friction and drag."""

hair_dryer = _HERE / "hair-dryer.toml"
"""Hair dryer: close to linear, nothing missing."""

RECORDINGS = {
    path.stem: path
    for path in (
        emps,
        silverbox,
        cascaded_tanks,
        coupled_drives,
        coupled_drives_1,
        coupled_drives_2,
        coupled_drives_3,
        multi_arm_pendulum,
        hair_dryer,
    )
}
"""Paths of the recipes by name."""


def load_recording(name: str) -> LoadedDataset:
    """Return a public recording.

    Parameters
    ----------
    name : str
        One of :data:`RECORDINGS`.

    Raises
    ------
    InputError
        If the name is unknown, or a file is missing; the message says where to download it.
    """
    refuse_unknown("unknown recording", name, RECORDINGS)
    return load_dataset(RECORDINGS[name])
