"""report.json keeps to its public schema, for every way in which data are judged."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest

from harness import api
from harness.schemas import report_schema
from plants.mockups import mockup


def checked(content: object) -> list[str]:
    """Return where a report leaves its schema."""
    validator = jsonschema.Draft202012Validator(report_schema())
    return [f"{'/'.join(map(str, one.absolute_path))}: {one.message[:200]}" for one in validator.iter_errors(content)]


def test_the_schema_is_one_and_explains_every_key() -> None:
    schema = report_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    assert set(schema["required"]) <= set(schema["properties"])
    assert [name for name, one in schema["properties"].items() if not one.get("description")] == []


@pytest.mark.slow
@pytest.mark.parametrize("model", ["pendulum", "pendulum.fmu"])
def test_a_real_report_keeps_to_it(model: str, tmp_path: Path) -> None:
    for role in ("estimation", "validation"):
        api.simulate("pendulum-fmu", scenario="multisine", role=f"{role}/0", out=tmp_path / f"{role}.csv",
                     scenario_options={"duration": 6.0, "noise": 1e-3})  # fmt: skip
    if model.endswith(".fmu"):
        (tmp_path / model).write_bytes(mockup("pendulum").read_bytes())
        model = str(tmp_path / model)
    api.close_loop(tmp_path / "estimation.csv", validation=tmp_path / "validation.csv", model=model,
                   out=tmp_path / "report")  # fmt: skip
    content = json.loads((tmp_path / "report" / "report.json").read_text(encoding="utf-8"))
    assert checked(content) == []
    broken = {key: value for key, value in content.items() if key != "verdict"} | {"seconds": "long"}
    assert len(checked(broken)) == 2


@pytest.mark.slow
def test_the_report_of_an_arm_keeps_to_it(tmp_path: Path) -> None:
    pytest.importorskip("pybullet", reason="pybullet has wheels for CPython 3.10 and 3.11 only")
    for role in ("estimation", "validation"):
        api.simulate("iiwa-bullet", scenario="arm-computed-torque", role=f"{role}/0", out=tmp_path / f"{role}.csv",
                     options={"outputs": ["q"]},
                     scenario_options={"duration": 8.0, "amplitude": 0.4, "noise": 1e-4})  # fmt: skip
    api.close_loop(tmp_path / "estimation.csv", validation=tmp_path / "validation.csv", model="iiwa",
                   out=tmp_path / "report")  # fmt: skip
    content = json.loads((tmp_path / "report" / "report.json").read_text(encoding="utf-8"))
    assert checked(content) == []
    assert [one["joint"] for one in content["joints"]] == [f"q{k}" for k in range(1, 8)]
    # every kind of model has the same keys
    assert set(content) == set(report_schema()["properties"])
