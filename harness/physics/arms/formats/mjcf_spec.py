"""A robot's file as MuJoCo reads it (MJCF, or URDF): what it may open is held to the file rule before it is opened."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from harness.errors import InputError
from harness.trust import registered_only

FILES = ("file", "filename", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
"""Attributes of an MJCF or a URDF that name a file which MuJoCo opens (its XML reference)."""
FOLDERS = {"mesh": ("meshdir", "assetdir"), "texture": ("texturedir", "assetdir")}
"""Attributes of ``<compiler>`` that stand before the files of an element; ``meshdir`` for all but textures."""
SCHEME = re.compile(r"(?!package:)[A-Za-z][A-Za-z0-9+.-]+:")
"""A name that is opened by something registered for it, and not as a file of the folder."""
DEEPEST = 32  # files that include each other


def mujoco() -> Any:
    """Return the module ``mujoco``, which no longer prints or leaves a log in the working folder.

    Its warnings remain countable (``data.warning``); a handler that somebody else has set stays.

    Raises
    ------
    InputError
        If it is not installed.
    """
    from harness.extras import optional

    engine = optional("mujoco", "a robot in MuJoCo", "'sysid-harness[mujoco]'")
    if engine.get_mju_user_warning() is None:
        engine.set_mju_user_warning(_unheard)
    return engine


def _unheard(text: str) -> None:
    """Leave a warning to the counters; without a handler MuJoCo writes it into ``MUJOCO_LOG.TXT``."""


def parsed(source: str | Path) -> tuple[ElementTree.Element, Path | None]:
    """Return the root of an MJCF or a URDF and its path, None for a text.

    Raises InputError if there is no such file, or it is neither.

    Examples
    --------
    >>> parsed("<mujoco model='empty'/>")[0].get("model")
    'empty'
    """
    text, file = str(source), None
    if not text.lstrip().startswith("<"):
        file = Path(source)
        if not file.is_file():
            raise InputError("no such robot", expected="an MJCF or URDF", got="no file", remedy="check the path",
                             file=file)  # fmt: skip
        text = file.read_text(encoding="utf-8", errors="replace")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(
            "not XML", expected="an MJCF or URDF", got=str(error), remedy="repair it", file=file
        ) from error
    if root.tag not in ("mujoco", "robot"):
        raise InputError(
            "no robot",
            expected="<mujoco> (MJCF) or <robot> (URDF)",
            got=f"<{root.tag}>",
            remedy="check the file",
            file=file,
        )
    return root, file


def read_spec(source: str | Path, *, shapes: bool = True) -> Any:
    """Return a robot as an ``MjSpec`` that can be changed before it is compiled.

    Raises InputError if it cannot be read, or names files outside its folder that nobody trusts.

    - ``source``: an MJCF or a URDF, or the text of one
    - ``shapes``: False leaves out the shapes of every body whose mass and inertia are stated, with the meshes that
      nothing else needs: such a robot touches nothing, and its meshes need not be there
    """
    root, file = parsed(source)
    base = Path() if file is None else file
    named = list(_named(root, base if file is None else file.parent, 0))
    for place, text in named:
        if SCHEME.match(text):
            raise InputError(
                "a file that is fetched",
                expected="files of the robot's own folder",
                got=repr(text),
                remedy="bring it into the folder",
                file=file,
                place=place,
            )
    registered_only(
        dict((f"{place} {number}", text) for number, (place, text) in enumerate(named)),
        file=Path("text") if file is None else file,
        options=True,
    )
    engine = mujoco()
    try:
        spec = engine.MjSpec.from_string(str(source)) if file is None else engine.MjSpec.from_file(str(file))
    except ValueError as error:
        raise _refused(error, file) from error
    return spec if shapes else without_shapes(spec)


def compiled(spec: Any, file: Path | None = None) -> Any:
    """Return the model of a spec.

    Raises
    ------
    InputError
        If MuJoCo refuses it: an inertia that no body has, a joint that moves no mass, a file that is missing.
    """
    try:
        return spec.compile()
    except (ValueError, mujoco().FatalError) as error:
        raise _refused(error, file) from error


def without_shapes(spec: Any) -> Any:
    """Return a spec without the shapes of bodies whose inertia is stated, and without what only they need."""
    for geom in list(_weightless(spec)):
        spec.delete(geom)
    meshes = {geom.meshname for geom in spec.geoms}
    heights = {geom.hfieldname for geom in spec.geoms}
    read = {texture.name: texture for texture in spec.textures if texture.file or any(texture.cubefiles)}
    for material in spec.materials:
        material.textures = ["" if name in read else name for name in material.textures]
    for unused in (
        *spec.skins,  # they are seen and weigh nothing, as textures are
        *(mesh for mesh in spec.meshes if mesh.name not in meshes),
        *(height for height in spec.hfields if height.name not in heights),
        *read.values(),
    ):
        spec.delete(unused)
    return spec


def _weightless(spec: Any) -> Iterator[Any]:
    """Yield the shapes of bodies whose inertia is stated, but for those that contacts, sensors or tendons name."""
    always = spec.compiler.inertiafromgeom == mujoco().mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    needed = {pair.geomname1 for pair in spec.pairs} | {pair.geomname2 for pair in spec.pairs}
    needed |= {sensor.objname for sensor in spec.sensors} | {sensor.refname for sensor in spec.sensors}
    needed |= {part for tendon in spec.tendons for part in wrapped(tendon)}
    for body in spec.bodies:
        if body.parent is None or body.name == "world" or (body.explicitinertial and not always):
            yield from (geom for geom in body.geoms if not geom.name or geom.name not in needed)


def wrapped(tendon: Any) -> Iterator[str]:
    """Yield the names of what a tendon of a spec passes: joints, sites, geoms."""
    for part in tendon.path:
        yield getattr(part.target, "name", "")


def _named(root: ElementTree.Element, folder: Path, depth: int) -> Iterator[tuple[str, str]]:
    """Yield the place and the path of every file that a robot's file names, files that it includes among them."""
    compilers = [element for element in root.iter("compiler")]
    folders = {
        kind: next((c.get(key) for key in keys for c in compilers if c.get(key)), "") for kind, keys in FOLDERS.items()
    }
    for element in root.iter():
        for key in FILES:
            text = element.get(key)
            if text is None:
                continue
            nested = element.tag in ("include", "model")
            before = "" if nested else folders.get(element.tag, folders["mesh"]) or ""
            path = text if SCHEME.match(text) else str(PurePosixPath(before) / text.removeprefix("package://"))
            yield element.tag, path
            inside = folder / path
            if nested and depth < DEEPEST and inside.is_file():
                yield from _included(inside, depth + 1)
        if element.tag == "config" and element.get("value"):
            yield "plugin", str(element.get("value"))


def _included(path: Path, depth: int) -> Iterator[tuple[str, str]]:
    """Yield what an included file names; what cannot be parsed MuJoCo refuses in its own words."""
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError):
        return
    yield from _named(root, path.parent, depth)


def _refused(error: Exception, file: Path | None) -> InputError:
    """Return MuJoCo's refusal on one line."""
    said = " ".join(str(error).split()).removeprefix("Error: ").removeprefix("XML Error: ")
    missing = "opening file" in said or "resource" in said
    return InputError(
        "MuJoCo refuses the robot",
        expected="a model that it compiles",
        got=said[:300],
        remedy="put the file there, or leave out the shapes (shapes = false)" if missing else "correct it there",
        file=file,
    )
