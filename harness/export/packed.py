"""An FMU from its C source and its description: built in a scratch folder, there whole or not at all."""

from __future__ import annotations

import tempfile
from pathlib import Path

from harness.data.whole_files import whole_file
from harness.errors import InputError
from harness.export.describe import RIGHTS


def packed(source: str, text: str, target: Path, version: int) -> Path:
    """Build an FMU and return its path.

    Raises InputError if there is no C compiler.

    - ``source``: model.c
    - ``text``: modelDescription.xml
    - ``target``: the FMU; an existing file is replaced
    - ``version`` {2, 3}: of FMI
    """
    from harness.fmi import build

    with tempfile.TemporaryDirectory(prefix="sysid-export-") as scratch:
        folder = Path(scratch)
        (folder / "model.c").write_text(source, encoding="utf-8")
        (folder / "modelDescription.xml").write_text(text, encoding="utf-8")
        try:
            with whole_file(target) as part:
                build.build_fmu(folder, version, part, others=True, note=RIGHTS)
        except build.BuildError as error:
            raise InputError(
                "the FMU cannot be built", expected="a C compiler", got=str(error), remedy="install gcc, or set CC"
            ) from error
    return target
