"""Torch or jax for the optional extra ``learned``: size on disk, seconds of import, seconds of a training.

Run ``OMP_NUM_THREADS=1 python benchmarks/bench_training_library.py``: the training is that of ``neural-network``, five
networks of two layers of 32 side by side, 1000 steps of Adam on batches of 256 rows, and free runs of 60 samples as of
``neural-state-space``, 200 steps. A library that is not installed has a line that says so. Every library in a process
of its own, compilation included, since a fit is run once.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import time
from importlib.metadata import distribution, requires
from pathlib import Path
from typing import Any

import numpy as np

MEMBERS, WIDTH, BATCH = 5, 32, 256
RATE = 3e-3


def data() -> tuple[np.ndarray, ...]:
    """Return rows, targets and weights of all members."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(4000, 6))
    targets = np.tanh(rows[:, :1] * rows[:, 1:2]) + 0.1 * rng.normal(size=(4000, 1))
    shapes = [(6, WIDTH), (1, WIDTH), (WIDTH, WIDTH), (1, WIDTH), (WIDTH, 1), (1, 1)]
    return rows, targets, *[rng.normal(size=(MEMBERS, *shape)) / np.sqrt(shape[0]) for shape in shapes]


def network(library: Any, tables: Any, rows: Any) -> Any:
    """Return the outputs of all members."""
    w1, b1, w2, b2, w3, b3 = tables
    return library.tanh(library.tanh(rows @ w1 + b1) @ w2 + b2) @ w3 + b3


def run(library: Any, tables: Any, x: Any, u: Any) -> Any:
    """Return the mean square of free runs whose state is three numbers long."""
    w1, b1, w2, b2 = (tables[i][0] for i in range(4))
    total = 0.0
    for k in range(u.shape[1]):
        total = total + ((x[:, :1] - u[:, k, :1]) ** 2).mean()
        x = 0.9 * x + 0.1 * (library.tanh(library.tanh(x @ w1[:3] + u[:, k] @ w1[3:] + b1) @ w2 + b2))[:, :3]
    return total


def with_torch() -> tuple[float, float]:
    """Return the seconds of both trainings."""
    import torch

    torch.set_num_threads(1)
    rows, targets, *start = data()
    x, y = torch.from_numpy(rows), torch.from_numpy(targets)
    seconds = []
    for steps, kind in ((1000, "one step"), (200, "free run")):
        tables = [torch.tensor(one, requires_grad=True) for one in start]
        adam = torch.optim.Adam(tables, lr=RATE)
        began = time.perf_counter()
        for step in range(steps):
            index = torch.from_numpy(np.random.default_rng(step).integers(len(rows), size=(MEMBERS, BATCH)))
            adam.zero_grad()
            if kind == "one step":
                loss = ((network(torch, tables, x[index]) - y[index]) ** 2).mean()
            else:
                window = x[index[0, :128, None] % 3000 + torch.arange(60)][..., :3]
                loss = run(torch, tables, window[:, 0], window)
            loss.backward()
            adam.step()
        seconds.append(time.perf_counter() - began)
    return seconds[0], seconds[1]


def with_jax() -> tuple[float, float]:
    """Return the seconds of both trainings, compilation included."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jnp = jax.numpy
    rows, targets, *start = data()
    x, y = jnp.asarray(rows), jnp.asarray(targets)
    seconds = []
    for steps, kind in ((1000, "one step"), (200, "free run")):

        def loss(tables: Any, index: Any, kind: str = kind) -> Any:
            if kind == "one step":
                return ((network(jnp, tables, x[index]) - y[index]) ** 2).mean()
            window = x[index[0, :128, None] % 3000 + jnp.arange(60)][..., :3]
            return run(jnp, tables, window[:, 0], window)

        @jax.jit
        def adam(tables: Any, first: Any, second: Any, step: Any, index: Any, loss: Any = loss) -> Any:
            slope = jax.grad(loss)(tables, index)
            first = [0.9 * m + 0.1 * g for m, g in zip(first, slope, strict=True)]
            second = [0.999 * v + 0.001 * g**2 for v, g in zip(second, slope, strict=True)]
            a, b = 1 - 0.9**step, 1 - 0.999**step
            moved = [
                w - RATE * (m / a) / (jnp.sqrt(v / b) + 1e-8) for w, m, v in zip(tables, first, second, strict=True)
            ]
            return moved, first, second

        tables = [jnp.asarray(one) for one in start]
        first, second = [0 * one for one in tables], [0 * one for one in tables]
        began = time.perf_counter()
        for step in range(steps):
            index = np.random.default_rng(step).integers(len(rows), size=(MEMBERS, BATCH))
            tables, first, second = adam(tables, first, second, step + 1.0, index)
        jax.block_until_ready(tables)
        seconds.append(time.perf_counter() - began)
    return seconds[0], seconds[1]


def size(name: str, seen: set[str]) -> float:
    """Return the MB on disk of a distribution and of what it needs, numpy and scipy apart, which the project has."""
    if name in seen or name in ("numpy", "scipy"):
        return 0.0
    seen.add(name)
    try:
        own = distribution(name)
    except ModuleNotFoundError:
        return 0.0
    total = sum(Path(str(f.locate())).stat().st_size for f in own.files or [] if Path(str(f.locate())).is_file()) / 1e6
    for text in requires(name) or []:
        if ";" not in text or "extra" not in text:
            total += size(text.split(";")[0].split("[")[0].split("<")[0].split(">")[0].split("=")[0].strip(), seen)
    return total


def main() -> None:
    """Print one line for each library."""
    for name, train in (("torch", "with_torch"), ("jax", "with_jax")):
        if importlib.util.find_spec(name) is None:
            print(f"{name}: not installed")
            continue
        importing = f"import time; t = time.perf_counter(); import {name}; print(time.perf_counter() - t)"
        shown = [subprocess.run([sys.executable, "-c", importing], capture_output=True, text=True) for _ in range(3)]
        seconds = min(float(one.stdout) for one in shown)
        work = f"import bench_training_library as b; print(*b.{train}())"
        here = Path(__file__).parent
        done = subprocess.run([sys.executable, "-c", work], capture_output=True, text=True, cwd=here, check=True)
        one_step, free_run = map(float, done.stdout.split())
        print(
            f"{name}: {size(name, set()):.0f} MB, import {seconds:.2f} s, one-step training {one_step:.2f} s, "
            f"free-run training {free_run:.2f} s"
        )


if __name__ == "__main__":
    main()
