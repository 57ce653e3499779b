"""Files that name Python code do not run it by themselves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from harness import api
from harness.command import main
from harness.errors import InputError


def test_a_stored_model_runs_python_only_where_it_is_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(
        "from harness.physics.models import pendulum\nopen('ran', 'w').close()\ndef swing():\n    return pendulum()\n"
    )
    rows = "".join(f"{0.01 * k},{(-1) ** (k // 7)},{0.001 * k * (60 - k)}\n" for k in range(60))
    (tmp_path / "run.csv").write_text("time [s],u [N m],theta [rad]\n" + rows)
    fitted = api.identify("run.csv", model="pendulum", identifier="output-error", options={"model": "pendulum"})
    content = {**fitted.model.to_dict(), "model": "mine.py:swing"}
    (tmp_path / "model.json").write_text(json.dumps(content))
    for source in ("model.json", "."):
        with pytest.raises(InputError, match=r"model: a stored model that runs Python code.*--trust"):
            api.export(source, out="model.fmu")
    assert not (tmp_path / "ran").exists()
    with pytest.raises(SystemExit) as ended:
        main(["export", "model.json", "-o", "model.fmu", "--fmi", "2", "--trust"])
    assert ended.value.code == 0
    assert (tmp_path / "ran").exists()
    assert "wrote model.fmu" in capsys.readouterr().out
