"""Build hook: a wheel carries our FMUs and the stepping loop built, and is tagged for the system they run on."""

from __future__ import annotations

import importlib.util
import sysconfig
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class MockupHook(BuildHookInterface[Any]):
    """Compile plants/mockups into the wheel; an editable install builds at first use instead."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the built files, or leave a pure wheel that builds at first use where there is no C compiler."""
        self._scratch = tempfile.TemporaryDirectory(prefix="sysid-wheel-")
        if version == "editable":
            return
        build = _load(Path(self.root) / "harness" / "fmi" / "build.py")
        folder = Path(self._scratch.name)
        try:
            library = folder / f"fmu_loop{build.library_suffix()}"
            build.compile_library([Path(self.root) / "plants" / "fmu" / "fmu_loop.c"], library)
            for model in sorted((Path(self.root) / "plants" / "mockups").glob("*/modelDescription.xml")):
                for fmi in (2, 3):
                    build.build_fmu(model.parent, fmi, folder / f"{model.parent.name}-fmi{fmi}.fmu")
        except build.BuildError as error:
            self.app.display_warning(f"the wheel carries no built FMUs, they are built at first use: {error}")
            return
        for file in folder.iterdir():
            build_data["force_include"][str(file)] = f"plants/mockups/built/{file.name}"
        build_data["pure_python"] = False
        # the binaries need this system, but no particular Python
        system = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{system}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the scratch folder once its files are in the wheel."""
        self._scratch.cleanup()


def _load(path: Path) -> ModuleType:
    """Import the build script by its path: the project itself is not installed yet."""
    spec = importlib.util.spec_from_file_location("mockup_build", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
