"""Every ``sysid`` command of README.md and docs/*.md is understood, and those that take seconds run, each alone."""

from __future__ import annotations

import importlib
import itertools
import json
import re
import shlex
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.core import TyperGroup
from typer.main import get_command

from harness import api
from harness.command import main
from harness.data import load_dataset
from harness.diagnosis import close_loop
from harness.effects import builtin
from harness.fleet import close_fleet
from plants.mockups import mockup

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += sorted((ROOT / "examples").glob("*/README.md"))
FENCE = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<code>.*?)^```\s*$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(sysid(?:-lab)? [^`]+)`")
PROGRAMS = {"sysid": "harness.cli.app", "sysid-lab": "sysid_lab.cli"}


def commands(text: str) -> list[str]:
    """Return every command in the blocks of a page, continuation lines joined."""
    blocks = [match["code"] for match in FENCE.finditer(text) if match["info"].strip() in ("", "sh")]
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [line for line in lines if line.partition(" ")[0] in PROGRAMS]


def mentions(text: str) -> list[str]:
    """Return every command in the sentences of a page."""
    return list(dict.fromkeys(INLINE.findall(FENCE.sub("", text))))


def by_page(find: Callable[[str], list[str]]) -> list[tuple[str, str]]:
    """Return the name of a page beside every command that is found on it."""
    return [(page.name, line) for page in PAGES for line in find(page.read_text(encoding="utf-8"))]


COMMANDS, MENTIONS = by_page(commands), by_page(mentions)


def words(line: str) -> list[str]:
    """Return the arguments of a command as a shell passes them."""
    return shlex.split(line, comments=True)[1:]


def test_commands_are_found_whatever_stands_around_them() -> None:
    text = "a `sysid list plants`\n```python\nx = 1\n```\nb\n```\nsysid list \\\n  --json\n```\n"
    text += "```sh\nsysid check a # b\n```\n"
    assert commands(text) == ["sysid list    --json", "sysid check a # b"]
    assert mentions(text) == ["sysid list plants"]
    assert len(COMMANDS) > 50
    assert len(MENTIONS) > 25


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_a_command_is_understood(page: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name, *rest = words(line)
    monkeypatch.chdir(tmp_path)
    for word, trusted in itertools.pairwise(rest):
        if word == "--trust":  # which must be there
            Path(trusted).touch()
    command = group(line).commands[name]
    command.make_context(name, rest)  # raises for an unknown option, a missing or a superfluous argument


@pytest.mark.parametrize(("page", "line"), MENTIONS)
def test_a_command_in_a_sentence_has_its_options(page: str, line: str) -> None:
    name, *rest = words(line)
    command = group(line).commands[name]
    known = {flag for one in command.params for flag in (*one.opts, *one.secondary_opts)}
    assert {word for word in rest if re.match(r"--?[a-z]", word)} <= known


def group(line: str) -> TyperGroup:
    """Return the commands of the program that a line runs."""
    found = get_command(importlib.import_module(PROGRAMS[line.partition(" ")[0]]).app)
    assert isinstance(found, TyperGroup)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name + "-" + page.name)
def test_what_make_and_python_run_is_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"`make ([a-z]+)", text)) <= set(targets)
    for script in re.findall(r"`python ([^` ]+\.py)", text):
        assert (ROOT / script).is_file(), script


# ---- those that run --------------------------------------------------------------------------------------------------

ONLY_PARSED = {
    r"sysid-lab (confusion|generate)": "minutes on all cores, or hours",
    r"close-loop records/": "a study's whole fleet",
    r"bench examples/peers": "needs the peer packages, which are installed apart",
    r"(check|list|identify) .*(soft_friction|peer-sippy|neighbours)": "needs a plug-in installed by pip",
    r"export learned": "needs a force that lowers the error: tests/learned has one",
    r"dask://": "needs a cluster",
    r"^sysid open": "serves a page until somebody ends it: tests/app has it",
    r"rig\.ssp": "needs a system: tests/calibration has one",
    r"--model iiwa --out|--model (robot|arm)\.(urdf|xml)": "an arm takes half a minute: tests/diagnosis has them",
    r"--download": "needs the network",
}
"""Commands that no test runs, and why: what is not here runs."""
SHORTENED = {"bench quick": "bench quick --dry-run", "bench public": "bench public --choices small.toml"}
"""Commands that take minutes, and what runs of them: the plan of the cells, one cell."""
SENTENCES = re.compile(
    r"list (plants|effects|model)|isolability|simulate (pendulum|loop)|sysid-lab (score|answer) docs"
)
"""Commands in sentences that are whole."""


def reason(line: str) -> str:
    """Return why a command is only parsed; empty for one that runs."""
    return next((text for pattern, text in ONLY_PARSED.items() if re.search(pattern, line.partition("#")[0])), "")


WHOLE = [*COMMANDS, *((page, line) for page, line in MENTIONS if SENTENCES.search(line))]
RUNNING = {shlex.join(words(line)): (page, line) for page, line in WHOLE if not reason(line)}


def test_every_reason_has_its_command() -> None:
    for pattern in ONLY_PARSED:
        assert any(re.search(pattern, line.partition("#")[0]) for _, line in COMMANDS), pattern
    assert len(RUNNING) > 40


def sysid(line: str) -> None:
    """Run a command as typed."""
    with pytest.raises(SystemExit) as ended:
        main(words(line), cli=PROGRAMS[line.partition(" ")[0]])
    assert ended.value.code == 0, line


PARTS = {"arm": ("pendulum", "u", "theta"), "controller": ("pi_controller", "r y", "u")}
"""Of a system: the FMUs by the name of their part, their inputs and outputs."""
WIRES = {"set": "controller.r", "arm.theta": "controller.y", "controller.u": "arm.u"}
SSP = "http://ssp-standard.org/SSP1/SystemStructure"
OSP = "http://opensimulationplatform.com/MSMI/OSPSystemStructure"


def systems() -> None:
    """Write one loop as ``system.ssp``, and the part of it that is no input as ``folder/OspSystemStructure.xml``."""

    def connectors(kind: str, names: str) -> str:
        return "".join(f'<ssd:Connector name="{n}" kind="{kind}"><ssc:Real/></ssd:Connector>' for n in names.split())

    def end(which: str, place: str) -> str:
        part, _, name = place.rpartition(".")
        return (f'{which}Element="{part}" ' if part else "") + f'{which}Connector="{name}"'

    def variable(place: str) -> str:
        part, _, name = place.partition(".")
        return f'<Variable simulator="{part}" name="{name}"/>'

    elements = "".join(
        f'<ssd:Component name="{name}" source="resources/{fmu}.fmu"><ssd:Connectors>{connectors("input", inputs)}'
        f"{connectors('output', outputs)}</ssd:Connectors></ssd:Component>"
        for name, (fmu, inputs, outputs) in PARTS.items()
    )
    wires = "".join(
        f"<ssd:Connection {end('start', a)} {end('end', b)}/>" for a, b in [*WIRES.items(), ("arm.theta", "angle")]
    )
    with zipfile.ZipFile("system.ssp", "w") as archive:
        archive.writestr(
            "SystemStructure.ssd",
            f'<ssd:SystemStructureDescription xmlns:ssd="{SSP}Description" xmlns:ssc="{SSP}Common" version="1.0" '
            f'name="loop"><ssd:System name="loop"><ssd:Connectors>{connectors("input", "set")}'
            f"{connectors('output', 'angle')}</ssd:Connectors><ssd:Elements>{elements}</ssd:Elements>"
            f"<ssd:Connections>{wires}</ssd:Connections></ssd:System>"
            '<ssd:DefaultExperiment startTime="0" stopTime="2"/></ssd:SystemStructureDescription>',
        )
        for fmu, _, _ in PARTS.values():
            archive.write(mockup(fmu), f"resources/{fmu}.fmu")
    Path("folder").mkdir()
    for fmu, _, _ in PARTS.values():
        shutil.copy(mockup(fmu), f"folder/{fmu}.fmu")
    simulators = "".join(f'<Simulator name="{name}" source="{fmu}.fmu"/>' for name, (fmu, _, _) in PARTS.items())
    joined = "".join(
        f"<VariableConnection>{variable(a)}{variable(b)}</VariableConnection>" for a, b in WIRES.items() if "." in a
    )
    Path("folder", "OspSystemStructure.xml").write_text(
        f'<OspSystemStructure xmlns="{OSP}" version="0.1"><BaseStepSize>0.01</BaseStepSize>'
        f"<Simulators>{simulators}</Simulators><Connections>{joined}</Connections></OspSystemStructure>"
    )


ARM = """<mujoco><worldbody>
<body><joint name="shoulder" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/>
<body pos="0 0 -0.4"><joint name="elbow" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/></body>
</body></worldbody></mujoco>
"""
MOTOR = """input u [N m]
state theta [rad], w [rad/s]
motion theta: w, J
J = 0.1 kg m^2      >= 0
b = 0.05 N m s/rad  >= 0
mgl = 1 N m         >= 0
theta' = w
w' = (u - b*w - mgl*sin(theta))/J
output theta
"""
SMALL = '[cascaded-tanks.black]\nvalidation = 0.25\ncandidates = [{ id = "arx", options = { order = 2 } }]\n'


def given(page: str, pattern: str) -> str:
    """Return what a page tells its reader to write into a file."""
    found = re.search(pattern, (ROOT / "docs" / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert found is not None, (page, pattern)
    return found[1]


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what the commands of the pages expect to find: records, FMUs, models, finished work."""
    folder = tmp_path_factory.mktemp("prepared")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name in ("FILE.fmu", "model.fmu", "theirs.fmu", "pendulum.fmu"):
            (folder / name).write_bytes(mockup("pendulum").read_bytes())
        runs = ("run.csv", "estimation.csv", "validation.csv")
        for role, name in zip(("estimation/0", "estimation/1", "validation/0"), runs, strict=True):
            options = f"-S duration=10 -S noise=1e-3 --role {role} -o {name}"
            sysid(f"sysid simulate pendulum-fmu --scenario multisine {options}")
        sysid("sysid simulate theirs.fmu --stop 1 --step 0.01 -o theirs_ref.csv")
        (folder / "dataset.toml").write_text(
            'name = "swing"\nsignals.u = { role = "input" }\nsignals.theta = { role = "output" }\n'
            'nominal.model = "pendulum"\n'
            '[[runs]]\nfile = "run.csv"\n[[runs]]\nfile = "validation.csv"\nuse = "validation"\n'
        )
        for name, identifier in (("other.json", "arx"), ("MODEL.json", "arx"), ("OTHER.json", "dmdc -O delays=4")):
            sysid(f"sysid identify dataset.toml --identifier {identifier} -o {name}")
        shutil.copy("other.json", "arx.json")
        some = [builtin()[name] for name in ("coulomb_friction", "quadratic_drag")]
        for model, out in (("pendulum", "report"), (folder / "pendulum.fmu", "box")):
            close_loop(load_dataset("dataset.toml").dataset, model, out=out, dictionary=some)
        shutil.copytree("report", "unexplained")
        found = json.loads((folder / "unexplained" / "report.json").read_text())
        found |= {"verdict": "unexplained", "adequacy": "does_not_fit"}
        (folder / "unexplained" / "report.json").write_text(json.dumps(found))
        (folder / "fleet.csv").write_text("file,machine,date\nrun.csv,A,2026-01-01\nestimation.csv,A,2026-02-01\n")
        close_fleet("fleet.csv", out="fleet", model="pendulum", workers=1)
        shutil.copytree("fleet", "run")
        (folder / "suite.toml").write_text(
            'name = "quick"\nseeds = [0]\n[[groups]]\nplants = [{ id = "linear-ode" }]\n'
            'scenarios = [{ id = "prbs", options = { samples = 300 } }]\nidentifiers = [{ id = "arx" }]\n'
        )
        api.bench("suite.toml", out="results/quick", workers=1)
        kept = ROOT / "docs" / "studies" / "leaderboard"
        for place in (folder, folder / "truth"):
            place.mkdir(exist_ok=True)
            shutil.copy(kept / "truth.csv", place)
        for name, source in (("theirs", "always-nothing-missing"), ("ours", "sysid-harness")):
            shutil.copy(kept / "answers" / f"{source}.csv", folder / f"{name}.csv")
        (folder / "docs").symlink_to(ROOT / "docs")
        (folder / "examples").symlink_to(ROOT / "examples")
        systems()
        for run, name in (("run.csv", "run7.csv"), ("estimation.csv", "run8.csv")):
            shutil.copy(run, name)
        shutil.copytree("box", "report2")
        rng = np.random.default_rng(0)
        u, y = rng.standard_normal(400), np.zeros(400)
        for k in range(399):
            y[k + 1] = 0.8 * y[k] + 0.5 * u[k] + 1e-3 * rng.standard_normal()
        (folder / "log.csv").write_text("u,y\n" + "".join(f"{a},{b}\n" for a, b in zip(u, y, strict=True)))
        for name, text in (
            ("loop.toml", given("co-simulation.md", r"```toml\n(.*?)^```")),
            ("cart-pole.urdf", given("mechanical.md", r'Path\("cart-pole\.urdf"\)\.write_text\("""(.*?)"""')),
            ("motor.eqs", MOTOR),
            ("arm.xml", ARM),
            ("small.toml", SMALL),
        ):
            (folder / name).write_text(text)
        sysid("sysid bench public --choices small.toml")
    return folder


def arrange(folder: Path, line: str) -> None:
    """Put what one command needs beside the rest, and take away what it is to write."""
    given = words(line)
    if given[0] == "learn-residual":
        shutil.rmtree(folder / "report")
        (folder / "unexplained").rename(folder / "report")
    if given[:2] == ["new", "dataset"]:
        (folder / "dataset.toml").unlink()
    if given[:2] == ["bench", "public"] and "--resume" not in given:
        shutil.rmtree(folder / "results" / "public")
    if any(word in ("iiwa", "model=iiwa") for word in given):
        (folder / "run.csv").unlink()
        sysid("sysid simulate iiwa-bullet --scenario arm-designed -S duration=5 -S noise=1e-4 -o run.csv")
    for flag, target in itertools.pairwise(given):
        if flag in ("-o", "--out") and "--resume" not in given:
            path = folder / target
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def make_before(page: str, line: str) -> None:
    """Run the earlier commands of a page that write the files that one reads and nobody else has prepared."""
    for name in words(line):
        wanted = re.compile(rf"(?:-o|--out) {re.escape(name)}(?:\s|$)")
        if "." not in name or Path(name).exists() or wanted.search(line):
            continue
        maker = next((one for where, one in COMMANDS if where == page and wanted.search(one)), None)
        if maker is not None:
            make_before(page, maker)
            sysid(maker)


@pytest.mark.slow
@pytest.mark.parametrize(("page", "line"), RUNNING.values())
def test_a_command_runs(
    page: str,
    line: str,
    prepared: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    if " emps " in line:
        request.getfixturevalue("recordings_folder")
    shutil.copytree(prepared, tmp_path / "here", symlinks=True)
    monkeypatch.chdir(tmp_path / "here")
    make_before(page, line)
    arrange(tmp_path / "here", line)
    for long, short in SHORTENED.items():
        line = line.replace(long, short)
    if "*" in line:
        line = shlex.join(
            [line.split()[0], *(str(one) for word in words(line) for one in sorted(Path().glob(word)) or [word])]
        )
    sysid(line)
