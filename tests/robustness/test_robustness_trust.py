"""A file names registered things only: nothing that a file says runs code, or leads out of its folder, by itself."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness import api, registry, trusting
from harness.command import main
from harness.errors import HarnessError, InputError
from harness.trust import registered_only
from plants.mockups import mockup

SEEN: list[str] | None = None
EVENTS = ("import", "open", "os.system", "subprocess.Popen", "os.posix_spawn", "os.exec", "ctypes.dlopen")


def _hook(event: str, arguments: Any) -> None:
    if SEEN is not None and event in EVENTS:
        SEEN.append(f"{event} {arguments[0]}")


sys.addaudithook(_hook)  # it cannot be taken away, and does nothing while SEEN is None

CODE = ("evil.py:arm", "evil.py", "./evil.py:arm", "lib.fmu", "innocent.csv", "unpacked", "library")
"""Files beside the file that names them: Python, an FMU, an FMU by another name, unpacked, a library without ending."""
IMPORTS = ("subprocess:run", "os:system", "evil:Env-v0", "os.path:join")
OUTSIDE = ("../outside.csv", "link.csv", "sub/../../outside.csv")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    top = tmp_path_factory.mktemp("trust")
    inside = top / "inside"
    inside.mkdir()
    (inside / "evil.py").write_text(
        f"from harness.physics.models import pendulum\nopen({str(top / 'ran')!r}, 'w').close()\n"
        "def arm():\n    return pendulum()\n"
    )
    rows = "".join(f"{0.01 * k},{(-1) ** (k // 7)},{0.001 * k * (60 - k)}\n" for k in range(60))
    for place in (top / "outside.csv", inside / "run.csv"):
        place.write_text("time [s],u [N m],theta [rad]\n" + rows)
    (inside / "link.csv").symlink_to(top / "outside.csv")
    shutil.copy(mockup("pendulum"), inside / "lib.fmu")
    shutil.copy(mockup("pendulum"), inside / "innocent.csv")
    shutil.unpack_archive(inside / "lib.fmu", inside / "unpacked", "zip")
    (inside / "library").write_bytes(b"\x7fELF" + b"\0" * 60)
    fitted = api.identify(inside / "run.csv", model="pendulum", identifier="output-error", options={"horizon": 0.2})
    (inside / "model.json").write_text(json.dumps(fitted.model.to_dict()))
    before = Path.cwd()
    os.chdir(inside)
    try:
        yield inside
    finally:
        os.chdir(before)


@pytest.fixture
def watched(folder: Path) -> Iterator[list[str]]:
    """What happened to files of the folder, and which processes began."""
    global SEEN
    if importlib.util.find_spec("mujoco") is not None:  # its viewer asks for a version in a process, as it is imported
        importlib.import_module("mujoco")
    SEEN = []
    try:
        yield SEEN
    finally:
        SEEN = None


OURS = ("/ldconfig", "/sysid-harness/", "/site-packages/")
"""Of what our own parts start and load: a look for a library, kernels that were compiled before, wheels."""


def _harmless(seen: list[str], folder: Path) -> None:
    """Assert that nothing of the folder ran or was opened through a name, and that no process began."""
    assert not (folder.parent / "ran").exists()
    assert not (folder / "ran").exists()
    wrong = [line for line in seen if line == "import evil" or "outside.csv" in line or "evil.py" in line]
    wrong += [line for line in seen
              if not line.startswith(("import ", "open ")) and not any(sign in line for sign in OURS)]  # fmt: skip
    assert not wrong, wrong


def _nested(text: str, depth: int, by_key: bool) -> Any:
    content: Any = {text: 1.0} if by_key else text
    for level in range(depth):
        content = [1.0, content] if level % 2 else {"a": 2.0, "b": content}
    return content


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60)
@given(text=st.sampled_from(CODE + IMPORTS + OUTSIDE), depth=st.integers(0, 4), by_key=st.booleans())
def test_no_depth_hides_code(folder: Path, text: str, depth: int, by_key: bool) -> None:
    with pytest.raises(InputError, match="--trust"):
        registered_only(_nested(text, depth, by_key), file=folder / "any.toml", options=True)


@settings(deadline=None, max_examples=60)
@given(st.recursive(st.floats() | st.text(max_size=8) | st.sampled_from(["rad/s", "N m", "a:b", "1.5", "x.csv"]),
                    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
                    max_leaves=6))  # fmt: skip
def test_words_numbers_and_units_are_no_code(content: Any) -> None:
    text = json.dumps(content)
    if not any(sign in text for sign in (".py", "..", '"/', "\\\\")):
        registered_only(content, file="any.toml", options=True)


def _options() -> list[tuple[str, str, str]]:
    """Return every named option of every part that a suite or a coupling may name."""
    return [
        (kind, entry.id, option)
        for kind in ("plants", "scenarios", "identifiers")
        for entry in registry.entries(kind)
        for option in registry.named_options(kind, entry.id)
    ]


def test_no_option_of_any_part_runs_what_a_suite_or_a_coupling_names(folder: Path, watched: list[str]) -> None:
    usual = {"plants": "pendulum-ode", "scenarios": "prbs", "identifiers": "hold"}
    options = _options()
    assert len(options) > 300
    texts = CODE + IMPORTS + OUTSIDE
    for number, (kind, id, option) in enumerate(options):
        text = texts[number % len(texts)]
        named = f"{{ id = {json.dumps(id)}, options = {{ {option} = [{json.dumps(text)}] }} }}"
        lines = [f"{one} = [{named if one == kind else json.dumps({'id': usual[one]}).replace(':', ' =', 1)}]"
                 for one in usual]  # fmt: skip
        (folder / "suite.toml").write_text('name = "s"\n[[groups]]\n' + "\n".join(lines).replace('"id"', "id"))
        if kind != "plants" or number % 2:
            with pytest.raises(InputError, match=rf"{kind}\[0\]\.options\.{option}\[0\].*--trust"):
                api.bench("suite.toml", workers=1)
        else:
            (folder / "pair.toml").write_text(
                f'outputs = ["a.y"]\n[parts.a]\nplant = {json.dumps(id)}\noptions = {{ {option} = {json.dumps(text)} }}'
            )
            with pytest.raises(InputError, match=rf"parts\.a\.options\.{option}: .*--trust"):
                api.simulate("pair.toml", scenario="prbs")
    _harmless(watched, folder)


EXPRESSION = "__import__('os').system('touch ran') or __import__('subprocess').run('touch ran', shell=True)"


def test_no_option_is_evaluated(folder: Path, watched: list[str]) -> None:
    heavy = ("checkpoint",)  # only written to
    for kind, id, option in [*_options(), *(("models", e.id, o) for e in registry.entries("models")
                                            for o in registry.named_options("models", e.id))]:  # fmt: skip
        if option in heavy:
            continue
        try:
            made = registry.create(kind, id, **{option: EXPRESSION})
        except HarnessError:
            continue
        getattr(made, "close", lambda: None)()
    _harmless([line for line in watched if "dlopen" not in line], folder)


SIGNALS = '[signals.u]\nrole = "input"\n[signals.theta]\nrole = "output"\n[[runs]]\nfile = "run.csv"\n'


@pytest.mark.parametrize("text", ["evil.py:arm", "lib.fmu", "innocent.csv"])
def test_a_data_set_does_not_run_its_model(folder: Path, watched: list[str], text: str) -> None:
    (folder / "set").mkdir(exist_ok=True)
    data = folder / "data.toml"
    data.write_text(f'name = "d"\n{SIGNALS}[nominal]\nmodel = "{text}"\n')
    fleet = folder / "fleet.csv"
    fleet.write_text("file\ndata.toml\n")
    for command in (
        lambda: api.identify(data, identifier="arx"),
        lambda: api.close_loop(data, out=folder / "r"),
        lambda: api.spectrum(data),
        lambda: api.order(data),
        lambda: api.compare(["model.json"], data),
    ):
        with pytest.raises(InputError, match=r"nominal\.model: a file that runs code.*--trust"):
            command()
    _harmless(watched, folder)


@pytest.mark.parametrize("content", [
    {"model": "evil.py:arm"}, {"model": ["evil.py:arm"]}, {"options": {"path": "lib.fmu"}},
    {"kind": "fmu", "model": "lib.fmu"}, {"kind": "fmu", "model": "innocent.csv"}, {"evil.py:arm": 1},
])  # fmt: skip
def test_a_stored_model_runs_nothing(folder: Path, watched: list[str], content: dict[str, Any]) -> None:
    stored = json.loads((folder / "model.json").read_text()) | content
    (folder / "evil.json").write_text(json.dumps(stored))
    commands = [
        lambda: api.export("evil.json", out=folder / ("model.ssp" if content.get("kind") == "fmu" else "model.fmu")),
        lambda: api.compare(["evil.json"], "run.csv", model="pendulum"),
        lambda: api.learn_residual("evil.json", "run.csv", out=folder / "l"),
        lambda: api.simulate("pendulum-ode", scenario="predictive-control",
                             scenario_options={"model": "evil.json", "target": {"theta": 1.0}}),
    ]  # fmt: skip
    for command in commands:
        with pytest.raises(InputError, match="--trust"):
            command()
    _harmless(watched, folder)


def test_an_isolated_plant_of_a_file_is_a_registered_one() -> None:
    for inner in ("subprocess:run", "evil.py:arm", "os:system"):
        with pytest.raises(InputError, match="unknown plant"):
            registry.create("plants", "isolated", plant=inner)
    with registry.create("plants", "isolated", plant="pendulum-ode", sample_time=0.02) as plant:
        assert plant.spec.sample_time == 0.02


def test_what_is_trusted_runs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "evil.json").write_text(
        json.dumps(json.loads((folder / "model.json").read_text()) | {"model": "evil.py:arm"})
    )
    (folder / "pair.toml").write_text(
        'sample_time = 0.02\ninputs = { u = "a.u" }\noutputs = ["a.theta"]\n[parts.a]\nfmu = "lib.fmu"\n'
        '[[connections]]\nfrom = "u"\nto = "a.u"\n'
    )
    try:
        for trust in ("evil.py", "evil.json", "."):
            with pytest.raises(SystemExit) as ended:
                main(["export", "evil.json", "-o", "model.fmu", "--fmi", "2", "--force", "--trust", trust])
            assert ended.value.code == 0, capsys.readouterr().err
        with pytest.raises(InputError, match="--trust"):
            api.export("evil.json", out="model.fmu", force=True)
        with trusting("lib.fmu"):
            assert api.simulate("pair.toml", scenario="prbs", scenario_options={"samples": 20}).t.size > 10
        with pytest.raises(InputError, match="no such file to trust"), trusting("nowhere.py"):
            pass
    finally:
        (folder.parent / "ran").unlink(missing_ok=True)
