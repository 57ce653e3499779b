"""Our FMUs with another model description."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

from plants.mockups import mockup


def redescribed(path: Path, change: Callable[[str], str], model: str = "pendulum") -> Path:
    """Write one of our FMUs with another model description, which differs from its own; return the path."""
    with zipfile.ZipFile(mockup(model)) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "modelDescription.xml":
                text = change(content.decode())
                assert text != content.decode()
                content = text.encode()
            new.writestr(entry, content)
    return path


def in_degrees(path: Path) -> Path:
    """Write the pendulum with angles in degrees: another description of the same numbers."""
    unit = '<UnitDefinitions><Unit name="deg"><BaseUnit rad="1" factor="0.017453292519943295"/></Unit>'
    return redescribed(path, lambda text: text.replace('unit="rad"', 'unit="deg"').replace("<UnitDefinitions>", unit))
