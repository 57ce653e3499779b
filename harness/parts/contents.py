"""What is inside a file: of data, a robot, equations, or a stored model; nothing of it is run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.errors import UNREADABLE, InputError, as_written

if TYPE_CHECKING:
    pass


def describe_file(path: str | Path, sheet: str | None = None) -> dict[str, Any]:
    """Return what is inside a file (``sysid list FILE``): of data, a robot, or a stored model. Nothing of it is run.

    Parameters
    ----------
    path : path
        Data in any format that is read, a ``dataset.toml``, a URDF, an MJCF, equations (``.eqs``), a ``model.json``, or
        a report of the closed loop, be it its folder.
    sheet : str, optional
        Of an Excel workbook.

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
    path = path / "report.json" if (path / "report.json").is_file() else path
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
    if suffix == ".json" and (stored := _described_model(path)) is not None:
        return stored
    if suffix == ".eqs":
        return _described_equations(path)
    if suffix == ".toml":
        return _described_dataset(path)
    found = contents_of(path, sheet)
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


def _described_dataset(path: Path) -> dict[str, Any]:
    """Return the signals and runs that a dataset.toml declares; the files are not read."""
    import msgspec

    from harness.data.recipe.description import read_description

    found = read_description(path)
    signals = [
        {"signal": name, "role": one.role, "column": str(name if one.column is None else one.column),
         "unit": one.unit or "as its title says"}
        for name, one in found.signals.items()
    ]  # fmt: skip
    runs = [{"file": one.file, "use": one.use, "rows": "all" if one.rows is None else f"{one.rows[0]} to {one.rows[1]}"}
            for one in found.runs]  # fmt: skip
    facts = [f"{path.name}: data set {found.name!r}, {len(signals)} signals, {len(runs)} runs"]
    facts += [] if found.nominal is None or found.nominal.model is None else [f"nominal model {found.nominal.model}"]
    content: dict[str, Any] = msgspec.to_builtins(found)
    return {"facts": facts, "tables": {"signals": signals, "runs": runs}, "content": content}


def _described_report(path: Path, content: dict[str, Any]) -> dict[str, Any]:
    """Return what a report of the closed loop says."""
    with as_written(path, "report.json of sysid close-loop"):
        facts = [f"{path.name}: {content['summary']}", f"data set {content['dataset']}, model {content['model']}"]
        effects = [{"effect": one["name"], "at": one["at"], "what it is": one["summary"]} for one in content["effects"]]
    return {"facts": facts, "tables": {"effects": effects}, "content": content}


def _described_model(path: Path) -> dict[str, Any] | None:
    """Return what a model.json states, without making the model, or a report; None for other JSON, data perhaps."""
    import json

    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except UNREADABLE as error:
        raise InputError(
            "no model", expected="JSON that sysid wrote", got=str(error)[:120], remedy="check the file", file=path
        ) from error
    if isinstance(content, dict) and "verdict" in content:
        return _described_report(path, content)
    if not isinstance(content, dict) or "kind" not in content:
        return None
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
