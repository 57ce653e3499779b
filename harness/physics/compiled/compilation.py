"""Generated C, compiled into a cache that concurrent processes may share."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from harness.fmi.build import compiler, small_compiler, tell_without_compiler
from harness.fmi.compiled import cache_folder


def compiles() -> bool:
    """Return True where generated C can be compiled: by the system's compiler, or by the small one."""
    return compiler() is not None or small_compiler() is not None


# No fused multiply-add: the compiled code repeats CasADi's virtual machine bit for bit. The vectors are written out, so
# -O1 gives as fast a roll-out as -O2, compiled a third sooner.
FLAGS = ("-fPIC", "-shared", "-ffp-contract=off", "-fno-math-errno", "-std=c99")

# Passes of gcc's -O1 that straight-line code gains little from: without them it takes a quarter less time, the bits are
# the same, roll-outs up to 5 % slower (benchmarks/bench_compilation.py).
LEFT_OUT = ("-fira-region=one", "-fno-tree-loop-optimize", "-fno-tree-ccp", "-fno-move-loop-invariants",
            "-fno-guess-branch-probability", "-fno-tree-pta", "-fno-forward-propagate")  # fmt: skip


def _shortened(level: str) -> tuple[str, ...]:
    """Return the passes to leave out at a level of optimisation; other compilers than gcc may not know them."""
    return LEFT_OUT if level == "-O1" and "gcc" in Path((compiler() or ("",))[0]).name else ()


@functools.cache
def _machine_flags() -> tuple[str, ...]:
    """Return the flags for four doubles in a register, where the processor has them; the same bits, sooner.

    The second one has gcc clear the upper halves of the registers before calls: with them in use, some processors run
    the tanh and log1p of the mathematical library up to eight times as long (``benchmarks/bench_compilation.py``).
    """
    try:
        known = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ()
    wide = re.search(r"^flags\s*:.*\bavx2\b", known, re.MULTILINE)
    return ("-mavx2", "-fexpensive-optimizations") if wide else ()


def _command(level: str) -> tuple[str, ...] | None:
    """Return the command that makes a library of what it reads, without its name; None if there is no compiler."""
    program = compiler()
    if program is not None:
        return (*program, level, *FLAGS, *_shortened(level), *_machine_flags())
    small = small_compiler()
    return None if small is None else (*small, "-shared")


def _loaded(path: Path) -> ctypes.CDLL:
    """Load a library; what the small compiler made finds the functions of the mathematical library in the process."""
    if compiler() is None and sys.platform == "linux":
        ctypes.CDLL("libm.so.6", mode=ctypes.RTLD_GLOBAL)
    return ctypes.CDLL(str(path))


class Compilation:
    """A shared library in the making: ``start`` does not wait, ``library`` does.

    - ``source``: C source; its hash (with flags, compiler and machine) names the file, so that equal sources compile
      once
    - ``level``: of optimisation
    """

    def __init__(self, source: str, *, level: str = "-O1") -> None:
        self.source = source
        self._command = _command(level)
        key = "\x1f".join((source, str(self._command), platform.machine(), platform.system()))
        self.path = cache_folder() / f"rollout-{hashlib.sha256(key.encode()).hexdigest()[:32]}.so"
        self._process: subprocess.Popen[bytes] | None = None
        self._draft: Path | None = None
        self._library: ctypes.CDLL | None = None
        self._owner = os.getpid()
        self.failed = self._command is None
        if compiler() is None:
            tell_without_compiler()

    def _disown(self) -> None:
        """Leave a compiler that was started before a fork to the process that started it."""
        if self._owner != os.getpid():
            self._process, self._draft, self._owner = None, None, os.getpid()

    def start(self) -> None:
        """Begin to compile unless it is done, under way or impossible."""
        self._disown()
        if (
            self._command is None
            or self.failed
            or self._process is not None
            or self._library is not None
            or self.path.exists()
        ):
            return
        handle, draft = tempfile.mkstemp(suffix=".so", prefix=self.path.stem + "-", dir=self.path.parent)
        os.close(handle)
        self._draft = Path(draft)
        try:
            self._process = subprocess.Popen(
                [*self._command, "-x", "c", "-o", draft, "-"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            assert self._process.stdin is not None
            self._process.stdin.write(self.source.encode())
            self._process.stdin.close()
        except OSError:
            self.failed = True
            self._discard()

    def ready(self) -> bool:
        """Return True if the library can be had without waiting."""
        self._disown()
        if self._library is not None or self.path.exists():
            return True
        return self._process is not None and self._process.poll() is not None and self.library() is not None

    def library(self) -> ctypes.CDLL | None:
        """Return the loaded library, compiling first if needed; None if there is no working compiler."""
        if self._library is not None:
            return self._library
        self.start()
        if self._process is not None:
            status = self._process.wait()
            self._process = None
            if status == 0 and self._draft is not None:
                # Another process may have put the same file there: replacing it by an equal one is atomic.
                self._draft.replace(self.path)
                self._draft = None
            else:
                self.failed = True
                self._discard()
        if self.failed:
            return None
        try:
            self._library = _loaded(self.path)
        except OSError:
            self.failed = True
        return self._library

    def _discard(self) -> None:
        """Remove the unfinished file."""
        if self._draft is not None:
            self._draft.unlink(missing_ok=True)
            self._draft = None

    def __del__(self) -> None:
        if getattr(self, "_owner", None) != os.getpid():
            return
        process = getattr(self, "_process", None)
        if process is not None:
            process.kill()
            process.wait()
        if getattr(self, "_draft", None) is not None:
            self._discard()
