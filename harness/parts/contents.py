"""What is inside a file: of data, a robot, equations, or a stored model; nothing of it is run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.errors import InputError, as_written

if TYPE_CHECKING:
    pass

__all__ = ["describe_file"]


def describe_file(path: str | Path) -> dict[str, Any]:
    """Return what is inside a file (``sysid list FILE``): of data, a robot, or a stored model. Nothing of it is run.

    Parameters
    ----------
    path : path
        Data in any format that is read, a URDF, an MJCF, equations (``.eqs``), or a ``model.json``.

    Returns
    -------
    dict
        ``facts``, lines for a person; ``tables``, rows by name; ``content``, all of it.

    Raises
    ------
    InputError
        If the file is missing or cannot be read.
    """
    from harness.data.recipe.contents import contents_of

    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in (".urdf", ".xml", ".mjcf"):
        from harness.physics.arms.formats.robot_files import robot_contents

        robot = robot_contents(path)
        facts = [f"{path.name}: {robot['format']} {robot['name']!r}, {robot['bodies']} bodies, "
                 f"{len(robot['joints'])} joints, {len(robot['actuators'])} actuators"]  # fmt: skip
        return {
            "facts": facts,
            "tables": {name: robot[name] for name in ("joints", "actuators", "sensors")},
            "content": robot,
        }
    if suffix == ".json":
        return _described_model(path)
    if suffix == ".eqs":
        return _described_equations(path)
    found = contents_of(path)
    numbers = ("minimum", "maximum", "mean", "deviation")
    sizes = [{key: getattr(channel, key) for key in numbers} for channel in found.channels]
    rows = [
        {
            "column": channel.column,
            "unit": channel.unit or "-",
            **{key: "" if value is None else f"{value:.4g}" for key, value in size.items()},
            "rows": str(channel.rows),
            "every [s]": "" if channel.every is None else f"{channel.every:.4g}",
            "empty": str(channel.empty),
            "note": channel.note,
        }
        for channel, size in zip(found.channels, sizes, strict=True)
    ]
    return {"facts": found.facts(), "tables": {"channels": rows}, "content": found.to_dict()}


def _described_equations(path: Path) -> dict[str, Any]:
    """Return the equations of a file of text, its inputs, outputs and parameters."""
    from harness.physics import load_model
    from harness.physics.symbolic.equation_text import equations

    system = load_model(str(path))
    groups = {"inputs": system.inputs, "outputs": system.outputs, "states": system.states}
    tables = {name: [{name[:-1]: one.name, "unit": one.unit} for one in channels] for name, channels in groups.items()}
    tables["parameters"] = [
        {"parameter": one.name, "unit": one.unit, "start": f"{one.value:g}"} for one in system.parameters
    ]
    facts = [f"{path.name}: {system}", *equations(system.mechanism)]
    return {"facts": facts, "tables": tables, "content": {"equations": facts[1:], **tables}}


def _described_model(path: Path) -> dict[str, Any]:
    """Return what a model.json states, without making the model."""
    import json

    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            "a model.json", expected="JSON that sysid wrote", got=str(error)[:120], remedy="check the file", file=path
        ) from error
    if not isinstance(content, dict) or "kind" not in content:
        raise InputError(
            "a model.json",
            expected="an object with a kind",
            got=type(content).__name__,
            remedy="check the file",
            file=path,
        )
    with as_written(path, "model.json"):
        spec = content.get("spec") or {}
        ports = [
            {"port": port.get("name", ""), "role": role[:-1], "unit": port.get("unit", "1")}
            for role in ("inputs", "outputs", "states")
            for port in spec.get(role, [])
        ]
        parameters = [
            {"parameter": name, "value": f"{value:.6g}" if isinstance(value, int | float) else str(value)}
            for name, value in (content.get("parameters") or {}).items()
        ]
        facts = [f"{path.name}: model of kind {content['kind']!r}"]
        facts += [f"built on {content['model']}"] if content.get("model") else []
        facts += [f"sample time {spec['sample_time']} s"] if spec.get("sample_time") else []
        effects = content.get("effects") or []
        facts += [f"effects: {', '.join('@'.join(map(str, one)) for one in effects)}"] if effects else []
        return {"facts": facts, "tables": {"ports": ports, "parameters": parameters}, "content": content}
