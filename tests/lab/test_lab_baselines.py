"""Baselines of the leaderboard: what others would answer to the same records."""

from __future__ import annotations

from pathlib import Path

import pytest
from sysid_lab.baselines import METHODS, answer_all, answered
from sysid_lab.leaderboard import read_answers

from harness import api
from harness.command import main
from harness.data.trajectories import write_trajectory
from harness.errors import InputError
from harness.physics import load_model
from harness.signals import Dataset, Run

DRAG = ("quadratic_drag", "theta", {"c": 0.05})


def records(hidden: tuple[str, str, dict[str, float]] | None) -> Dataset:
    """Return two records of a pendulum."""
    runs = []
    for use in ("estimation", "validation"):
        record = api.simulate(
            "pendulum-ode",
            scenario="multisine",
            seed=1,
            options={"sample_time": 0.01},
            scenario_options={"noise": 1e-4, "duration": 10.0, "amplitude": 0.6},
            hide=[hidden] if hidden else (),
            role=f"{use}/0",
        )
        runs.append(Run(record.measured(), use))
    return Dataset("hidden", tuple(runs))


@pytest.mark.parametrize("method", ["best-subset", "output-error"])
def test_a_drag_is_named_and_nothing_where_nothing_is_missing(method: str) -> None:
    model = load_model("pendulum")
    assert answered(method, records(DRAG), model).accepted == ("quadratic_drag@theta",)
    assert answered(method, records(None), model).verdict == "nothing_missing"


def test_a_baseline_writes_an_answer_file_and_goes_on_with_it(tmp_path: Path) -> None:
    folder, out = tmp_path / "one", tmp_path / "answers.csv"
    folder.mkdir()
    lines = ['name = "one"\n[nominal]\nmodel = "pendulum"\n[signals.u]\nrole = "input"\nunit = "N m"\n']
    lines += ['[signals.theta]\nrole = "output"\nunit = "rad"\n']
    for run in records(DRAG):
        write_trajectory(run.trajectory.measured(), folder / f"{run.use}.csv")
        lines.append(f'[[runs]]\nfile = "{run.use}.csv"\nuse = "{run.use}"\n')
    (folder / "dataset.toml").write_text("".join(lines), encoding="utf-8")
    table = tmp_path / "records.csv"
    table.write_text("file,machine\none/dataset.toml,pendulum\n", encoding="utf-8")
    assert answer_all("best-subset", table, out) == {}
    assert read_answers(out)["one"].accepted == ("quadratic_drag@theta",)
    with pytest.raises(InputError, match="--resume"):
        answer_all("best-subset", table, out)
    with pytest.raises(SystemExit) as ended:
        main(["baseline", "best-subset", str(table), "-o", str(out), "--resume"], cli="sysid_lab.cli")
    assert ended.value.code == 0
    with pytest.raises(InputError, match=", ".join(METHODS)):
        answered("guess", records(None), load_model("pendulum"))
