"""Whether the tests notice small faults anywhere in a room: faults are made by rule, and planted one at a time.

    python lab/mutations.py [--room ROOM ...] [--count N] [--seed S] [--out FILE]

A fault is another comparison, sign, product, junction or number (DeMillo, Lipton & Sayward 1978, *Computer* 11(4):34);
which of them are planted depends on the seed alone. Works in a temporary copy of the tree. The tests of a room run
once with a tracer, which knows the lines that each test reaches; a fault is then held against the tests that reach its
line, the quickest first, or, where none does in its own process, against the longest, in a fork of a process that has
imported what the tests import from elsewhere. A test that fails without the fault notices nothing. Results are JSON
lines (``--out``); a fault that was noticed and whose file is as it was is not planted again. ``lab/planted_faults.py``
plants faults in the diagnosis that somebody has thought of.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
from planted_faults import AIM, ROOT, copied, known_results, run_tests

COMMON = "tests/core/test_core_more_small_faults.py"
UNITS = ("tests/core/test_core_unit_texts.py", "tests/core/test_core_unit_faults.py")


def _of_the_loop(*names: str) -> tuple[str, ...]:
    """Return tests of the closed loop: those that take long reach its rooms no better."""
    return tuple(f"tests/diagnosis/test_diagnosis_{name}.py" for name in names)


ROOMS: Mapping[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "units": ("harness/units", (), (*UNITS, "tests/core/test_core_registry.py", COMMON)),
    "scoring": ("harness/scoring", (), ("tests/scoring", "tests/cli/test_cli_acceptance.py", COMMON)),
    "cosim": ("harness/cosim", (), ("tests/cosim", COMMON)),
    "fleet": ("harness/fleet", ("page.py",), ("tests/fleet", COMMON)),
    "data": ("harness/data", ("page.py",), ("tests/data", COMMON)),
    "benchmark": (
        "harness/benchmark",
        ("plots.py", "overlays.py", "report.py", "public"),
        ("tests/benchmark", COMMON, "--ignore-glob=*public*"),
    ),
    "search": ("harness/diagnosis/search", (), (*_of_the_loop(
        "acceptance", "coherence", "faint", "first_steps", "lasting_errors", "search", "search_moves", "search_starts",
        "stand_in",
    ), "tests/core/test_core_small_faults.py")),
    "forms": ("harness/diagnosis/forms", (), _of_the_loop(
        "another_day", "ends", "first_steps", "fmu_states", "intervals", "lost_noise", "predictive", "remembered",
        "simple_fits", "starts", "thinning", "trust", "verdict",
    )),
    "runs": ("harness/diagnosis/runs", (), _of_the_loop(
        "astray", "ends", "equation", "intervals", "reliability", "simple_fits", "statistics", "told", "trust",
        "unfold", "verdict", "wide_signs", "worse",
    )),
    "effects": ("harness/effects", (), ("tests/effects",)),
    "vetting": ("harness/vetting", (), ("tests/vetting",)),
}  # fmt: skip
"""By room its folder, what only has a look (or is being built) in it, and the tests that are to notice beside its own
examples, in pytest's words."""
FAILING = 4  # Tests of a room that must not fail unharmed; fewer are left out.
SECONDS = 30.0  # What the tests of one fault may take together, by the time that they took unharmed.
PATIENCE = 10.0
"""With a fault they may take this many times as long, and start in :data:`SECONDS`; what takes longer is noticed."""
ROUNDING = 1e-6  # Below it a number is there for rounding: another size of it is not to be met.
SWAPS: Mapping[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.And: ("and", "or"), ast.Or: ("or", "and"),
}  # fmt: skip
"""What stands between two operands, and what is planted instead."""
LEFT_ALONE = ("annotation", "returns", "decorator_list", "op", "ops")
"""Parts of the syntax tree that hold no faults of their own."""
TRACER = """
import json, sys, threading
ROOT, FILES, OUT = {root!r}, {files!r}, {out!r}
reached, lasted, failed, skipped = {{}}, {{}}, set(), set()

def tracer(lines):
    def local(frame, event, argument):
        if event == "line":
            lines.add((frame.f_code.co_filename, frame.f_lineno))
        return local
    return lambda frame, event, argument: local if frame.f_code.co_filename.startswith(FILES) else None

def pytest_runtest_setup(item):
    lines = tracer(reached.setdefault(item.nodeid, set()))
    threading.settrace(lines)
    sys.settrace(lines)

def pytest_runtest_call(item):
    pytest_runtest_setup(item)

def pytest_runtest_logreport(report):
    sys.settrace(None)
    lasted[report.nodeid] = lasted.get(report.nodeid, 0.0) + report.duration
    if not report.passed:
        (failed if report.failed else skipped).add(report.nodeid)

def pytest_sessionfinish():
    found = {{name: sorted({{(file[len(ROOT) + 1:], line) for file, line in reached[name]}})
             for name in reached if name not in failed | skipped}}
    others = [name for name, module in list(sys.modules.items())
              if getattr(module, "__spec__", None) and not str(getattr(module, "__file__", None)).startswith(ROOT)]
    json.dump({{"reached": found, "lasted": lasted, "failed": sorted(failed), "modules": others}}, open(OUT, "w"))
"""
"""A plug-in of pytest, made for one room; what sets up a test is the test's."""
SERVER = """
import atexit, gc, importlib, json, os, signal, sys, time, warnings
from importlib.metadata import entry_points
own = {one.module.partition(".")[0] for one in entry_points(group="pytest11")}
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    for name in json.load(open(sys.argv[1])):
        if name.partition(".")[0] not in own:
            try:
                importlib.import_module(name)
            except BaseException:
                pass
import pytest
gc.freeze()
for line in sys.stdin:
    arguments, limit = json.loads(line)
    child = os.fork()
    if not child:
        os.setsid()
        for place, flags in enumerate((os.O_RDONLY, os.O_WRONLY, os.O_WRONLY)):
            os.dup2(os.open(sys.argv[2] if place else os.devnull, flags | os.O_CREAT), place)
        os.truncate(sys.argv[2], 0)
        code = pytest.main(arguments)
        atexit._run_exitfuncs()
        sys.stdout.flush()
        os._exit(code)
    end, done = time.monotonic() + limit, 0
    while not done and time.monotonic() < end:
        time.sleep(0.02)
        done, status = os.waitpid(child, os.WNOHANG)
    try:
        os.killpg(child, signal.SIGKILL)
    except ProcessLookupError:
        pass
    if not done:
        os.waitpid(child, 0)
    print(json.dumps(os.waitstatus_to_exitcode(status) if done else None), flush=True)
os._exit(0)  # what was imported has nothing to say at the end
"""
"""A process that has imported what is not under test, and runs tests in a fork of itself."""


@dataclass(frozen=True)
class Mutation:
    """A place in a file, what stands there, and what is planted."""

    file: str
    first: int
    last: int
    start: int
    end: int
    old: str
    new: str
    inside: bool
    """False for a line that runs when the file is imported."""

    def __str__(self) -> str:
        return f"{self.file}:{self.first} {self.old} -> {self.new}"

    def rank(self, seed: int) -> str:
        """Return where it stands among the others: the first ones are planted."""
        return hashlib.sha256(f"{seed} {self.file} {self.start} {self.new}".encode()).hexdigest()

    def identity(self, text: str) -> str:
        """Return what decides the result but for the tests: the fault and its file as it is."""
        return hashlib.sha256(f"{self}{self.start}{text}".encode()).hexdigest()[:16]


def mutations_of(file: str, text: str) -> Iterator[Mutation]:
    r"""Yield what can be planted in a source file; messages, names and types are left alone.

    Examples
    --------
    >>> [str(one) for one in mutations_of("f.py", "def f(x):\n    return x < 2 and not x - 1e-9\n")]
    ['f.py:2 and -> or', 'f.py:2 < -> <=', 'f.py:2 2 -> 3', 'f.py:2 not  -> ']
    """
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    body = text.encode()

    def at(line: int, column: int) -> int:
        return starts[line - 1] + column

    def found(node: Any, start: int, end: int, new: str, inside: bool) -> Mutation:
        return Mutation(file, node.lineno, node.end_lineno, start, end, body[start:end].decode(), new, inside)

    def between(node: Any, left: Any, right: Any, operator: ast.AST, inside: bool) -> Iterator[Mutation]:
        if type(operator) in SWAPS:
            old, new = SWAPS[type(operator)]
            first, last = at(left.end_lineno, left.end_col_offset), at(right.lineno, right.col_offset)
            place = body.find(old.encode(), first, last)
            if place >= 0:
                yield found(node, place, place + len(old), new, inside)

    def walk(node: ast.AST, inside: bool) -> Iterator[Mutation]:
        if isinstance(node, ast.BoolOp):
            yield from between(node, node.values[0], node.values[1], node.op, inside)
        elif isinstance(node, ast.Compare):
            yield from between(node, node.left, node.comparators[0], node.ops[0], inside)
        elif isinstance(node, ast.BinOp) and (_slack(node.left) or _slack(node.right)):
            for side in (node.left, node.right):  # lets rounding pass: another sign or size of it is not to be met
                if not _slack(side):
                    yield from walk(side, inside)
            return
        elif isinstance(node, ast.BinOp) and not isinstance(node.left, ast.Constant | ast.JoinedStr | ast.List):
            yield from between(node, node.left, node.right, node.op, inside)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            start = at(node.lineno, node.col_offset)
            yield found(node, start, at(node.operand.lineno, node.operand.col_offset), "", inside)
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float) and not _slack(node):
            start, end = at(node.lineno, node.col_offset), at(node.end_lineno or 0, node.end_col_offset or 0)
            new = repr(node.value + 1) if isinstance(node.value, int) else repr(1.5 * node.value or 0.1)
            yield found(node, start, end, new, inside)
        if isinstance(node, ast.FunctionDef):  # a default is that of whoever enters
            for default in (*node.args.defaults, *filter(None, node.args.kw_defaults)):
                yield from (replace(one, first=node.lineno, last=node.end_lineno or 0) for one in walk(default, True))
        inside = inside or isinstance(node, ast.FunctionDef | ast.Lambda)
        for name, value in ast.iter_fields(node):
            if name in LEFT_ALONE or isinstance(node, ast.JoinedStr):
                continue
            if name == "args" and isinstance(node, ast.FunctionDef):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST) and not isinstance(child, ast.Raise | ast.Import | ast.ImportFrom):
                    yield from walk(child, inside)

    yield from walk(ast.parse(text), False)


def _slack(node: ast.AST) -> bool:
    """Return True for a number that only stands for rounding, or one more by it."""
    if isinstance(node, ast.BinOp) and isinstance(node.left, ast.Constant):
        return node.left.value in (1, 1.0) and _slack(node.right)
    return isinstance(node, ast.Constant) and isinstance(node.value, float) and 0 < node.value < ROUNDING


def chosen_of(room: str, count: int, seed: int) -> list[Mutation]:
    """Return the faults of a room that a seed plants."""
    folder, left_out, _ = ROOMS[room]
    every: list[Mutation] = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        if not set(path.relative_to(ROOT / folder).parts) & set(left_out):
            every += mutations_of(str(path.relative_to(ROOT)), path.read_text(encoding="utf-8"))
    return sorted(every, key=lambda one: one.rank(seed))[:count]


@dataclass(frozen=True)
class Room:
    """The tests of a room in a copy of the tree, and the process that runs them."""

    folder: Path
    reached: dict[str, set[tuple[str, int]]]
    lasted: Mapping[str, float]
    server: subprocess.Popen[str]
    sound: dict[str, bool] = field(default_factory=dict)
    """Which tests pass unharmed beside what was imported before them, as far as it was asked."""

    def run(self, tests: Sequence[str]) -> tuple[int | None, list[str]]:
        """Return the exit code of pytest (None: it took too long) and the tests that failed: one, where any did."""
        arguments = [*tests, "--maxfail=1", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", "not slow", "-rfE"]
        arguments += ["--no-header", "--tb", "no", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
        limit = SECONDS + PATIENCE * sum(self.lasted[name] for name in tests)
        assert self.server.stdin is not None
        assert self.server.stdout is not None
        print(json.dumps([arguments, limit]), file=self.server.stdin, flush=True)
        code = json.loads(self.server.stdout.readline())
        said = (self.folder / "said").read_text(encoding="utf-8", errors="replace").splitlines()
        told = [line.split(" ", 1)[1] for line in said if line.startswith(("FAILED ", "ERROR "))]
        return code, [name for name in tests if any(line == name or line.startswith(f"{name} - ") for line in told)]

    def tried(self, one: Mutation) -> dict[str, str]:
        """Plant a fault, run the tests that reach it, and take it out again."""
        lines = {(one.file, line) for line in range(one.first, one.last + 1)}
        near = [name for name, own in self.reached.items() if own & lines]
        if not near and not one.inside:  # it runs when the file is imported
            near = [name for name, own in self.reached.items() if any(file == one.file for file, _ in own)]
        slow = not near  # perhaps a worker process of one of the longer tests reaches it, which nothing traces
        near = near or [name for name in self.reached if name.startswith("tests/")]
        picked: list[str] = []
        time = 0.0
        for name in sorted(near, key=lambda name: -self.lasted[name] if slow else self.lasted[name]):
            time += self.lasted[name]
            if picked and time > SECONDS:
                break
            picked.append(name)
        path = self.folder / one.file
        sound = path.read_bytes()
        while picked:
            path.write_bytes(sound[: one.start] + one.new.encode() + sound[one.end :])
            try:
                code, failed = self.run(picked)
            finally:
                path.write_bytes(sound)
            if code == 0:
                break
            for name in failed:
                if name not in self.sound:
                    self.sound[name] = self.run([name])[0] == 0
            if all(self.sound[name] for name in failed):
                return {"result": "noticed", "by": failed[0] if failed else f"pytest ended with {code}"}
            for name in failed:
                picked.remove(name)
                del self.reached[name]
        return {"result": "not reached" if slow else "unnoticed", "by": f"{len(picked)} tests"}


@contextlib.contextmanager
def opened(room: str) -> Iterator[Room]:
    """Copy the tree, find the lines that each test of a room reaches and how long it takes, and start the server."""
    with tempfile.TemporaryDirectory(prefix="mutations-") as scratch:
        folder = Path(scratch)
        copied(folder)
        out = folder / "reached.json"
        place, _, tests = ROOMS[room]
        text = TRACER.format(root=str(folder), files=str(folder / place), out=str(out))
        (folder / "reached.py").write_text(text, encoding="utf-8")
        code, line = run_tests(folder, [place, *tests, "-p", "reached"], most=FAILING)
        told = json.loads(out.read_text(encoding="utf-8")) if out.is_file() else {"reached": {}, "failed": []}
        if code is None or not told["reached"] or len(told["failed"]) >= FAILING:
            raise SystemExit(f"{room}: its tests do not pass unharmed: {code} {line}")
        if told["failed"]:  # one that interrupts something at its time may fail beneath the tracer
            print(f"{room}: left out, as they fail unharmed: {', '.join(told['failed'])}", flush=True)
        modules = folder / "modules.json"
        modules.write_text(json.dumps(told["modules"]), encoding="utf-8")
        environment = dict(os.environ, PYTHONPATH=str(folder), OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        command = [sys.executable, "-c", SERVER, str(modules), str(folder / "said")]
        with subprocess.Popen(
            command, cwd=folder, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as server:
            reached = {name: set(map(tuple, lines)) for name, lines in told["reached"].items()}
            yield Room(folder, reached, told["lasted"], server)


def main(arguments: Sequence[str] | None = None) -> int:
    """Plant the faults and print those that nothing noticed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "mutations.jsonl")
    parser.add_argument("--room", nargs="+", default=list(ROOMS), choices=list(ROOMS))
    parser.add_argument("--count", type=int, default=20, help="faults of each room")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--strict", action="store_true", help=f"exit status 1 below {AIM:.0%}% noticed")
    asked = parser.parse_args(arguments)
    known, met = known_results(asked.out), True
    for room in asked.room:
        faults = chosen_of(room, asked.count, asked.seed)
        identities = {one: one.identity((ROOT / one.file).read_text(encoding="utf-8")) for one in faults}
        left = [one for one in faults if known.get(identities[one], {}).get("result") != "noticed"]
        with opened(room) if left else contextlib.nullcontext() as tests:
            for one in left:
                assert tests is not None
                row = {"identity": identities[one], "room": room, "fault": str(one), **tests.tried(one)}
                known[identities[one]] = row
                with asked.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
                print(f"{row['fault']}: {row['result']} {row['by']}", flush=True)
        rows = [known[identities[one]] for one in faults]
        noticed = sum(row["result"] == "noticed" for row in rows)
        met = met and noticed >= AIM * len(rows)
        print(f"{room}: noticed {noticed} of {len(rows)}; not: "
              + "; ".join(row["fault"] for row in rows if row["result"] != "noticed"), flush=True)  # fmt: skip
    return 0 if met or not asked.strict else 1


if __name__ == "__main__":
    sys.exit(main())
