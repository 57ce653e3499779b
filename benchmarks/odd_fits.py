"""Odd records and excited loops of plants that nobody has seen: which fits are wrong and say nothing.

    python benchmarks/odd_fits.py {loops,records} [--base SEED] [--plants N] [--only WORD ...] [--kinds KIND ...]

Plants are drawn: one to four states, one or two inputs and outputs, at times a dead time, simulated in plain NumPy. A
*loop* is moved by a load, a controller and a reference or dither beside it; a *record* has one of the faults or odd
excitations of ``KINDS``. A fit is refused; warned of; right (under fresh inputs, without noise, its one-step error is
below half of what the output changes in a step, or that of its free run below half of the output); wrong outside the
*bands* that it calls determined, and right in them; wrong and *noted*, for readings that are none; or *silent*.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from feedback_judge import IDENTIFIERS as JUDGED

from harness import registry
from harness.errors import HarnessError
from harness.models.determined import bands_of, gaps_words
from harness.models.spread import gains
from harness.scoring import predict
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

BASE = 10_000  # First seed: those below may be used while tuning.
RIGHT = 0.5  # Error up to which a fit is right.
WORDS = ("refused", "warned wrong", "warned right", "right", "bands", "noted", "silent")
IDENTIFIERS = (
    *JUDGED,
    ("prediction-error", {}),
    ("prediction-error", {"order": 2, "structure": "armax"}),
    ("transfer-function", {}),
    ("impulse-response", {}),
    ("volterra", {}),
)


@dataclass(frozen=True)
class Plant:
    """``x[k+1] = A x + B u[k - delay]``, ``y = C x``."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    delay: int

    @property
    def spec(self) -> PlantSpec:
        """Its channels."""
        inputs = tuple(Channel(f"u{j + 1}") for j in range(self.b.shape[1]))
        return PlantSpec(inputs, tuple(Channel(f"y{i + 1}") for i in range(len(self.c))), 0.1)


def drawn(rng: np.random.Generator, slow: float = 0.0) -> Plant:
    """Return a stable plant whose outputs are about as large as its inputs, slower by 10^slow."""
    order, at = int(rng.integers(1, 5)), 0
    a = np.zeros((order, order))
    while at < order:
        radius, turn = float(rng.uniform(0.6, 0.97)) ** (10.0**-slow), float(rng.uniform(0.05, 0.9)) * 10.0**-slow
        if order - at >= 2 and rng.random() < 0.5:
            pole = radius * np.exp(1j * turn)
            a[at : at + 2, at : at + 2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
            at += 2
        else:
            a[at, at] = radius
            at += 1
    nu, ny = (1, 1) if rng.random() < 0.7 else (int(rng.integers(1, 3)), int(rng.integers(1, 3)))
    b, c = rng.normal(size=(order, nu)), rng.normal(size=(ny, order))
    c *= np.sign(c) * np.maximum(np.abs(c), 0.3) / c
    delay = int(rng.integers(1, 5)) if rng.random() < 0.25 else 0
    h = np.array([c @ np.linalg.matrix_power(a, k) @ b for k in range(300)])
    c = c / np.sqrt(np.sum(h**2, axis=(0, 2)))[:, None]
    return Plant(a, b, c, delay)


def run(plant: Plant, u: FloatArray) -> FloatArray:
    """Return the outputs (N, ny) from rest under inputs (N, nu)."""
    n, nu = u.shape
    given, x = np.vstack([np.zeros((plant.delay, nu)), u]), np.zeros(len(plant.a))
    y = np.zeros((n, len(plant.c)))
    for k in range(n):
        y[k] = plant.c @ x
        x = plant.a @ x + plant.b @ given[k]
    return y


def response(plant: Plant, frequency: FloatArray) -> Any:
    """Return the frequency response (F, ny, nu) at frequencies [Hz]."""
    turn = np.exp(2j * np.pi * frequency * 0.1)
    inner = np.linalg.solve(turn[:, None, None] * np.eye(len(plant.a)) - plant.a, plant.b.astype(complex)[None])
    return plant.c @ inner * turn[:, None, None] ** -plant.delay


def rich(n: int, nu: int, rng: np.random.Generator, kind: str = "") -> FloatArray:
    """Return a good excitation (n, nu)."""
    kind = kind or str(rng.choice(["prbs", "noise", "multisine", "steps"]))
    if kind == "prbs":
        return np.repeat(rng.choice([-1.0, 1.0], (n // 4 + 1, nu)), 4, axis=0)[:n]
    if kind == "steps":
        return np.repeat(rng.uniform(-1.5, 1.5, (n // 15 + 1, nu)), 15, axis=0)[:n]
    if kind == "multisine":
        f = rng.uniform(0.003, 0.3, (nu, 20))
        k = np.arange(n)[:, None, None]
        return np.asarray(np.sin(2 * np.pi * k * f + rng.uniform(0, 6.28, (nu, 20))).sum(axis=2) / np.sqrt(10))
    white = rng.normal(size=(n, nu))
    if kind == "slow":
        for k in range(1, n):
            white[k] = 0.95 * white[k - 1] + 0.3 * white[k]
    return white


def record(u: FloatArray, y: FloatArray, plant: Plant) -> Trajectory:
    return Trajectory(np.arange(len(u)) * 0.1, u, y, plant.spec)


def load(n: int, ny: int, rng: np.random.Generator, slow: float) -> FloatArray:
    """Return a load on the outputs of size 1."""
    e = rng.normal(size=(n, ny))
    for k in range(1, n):
        e[k] = slow * e[k - 1] + np.sqrt(1 - slow**2) * e[k]
    return e


def _at(y: FloatArray, rows: Any, value: Any) -> FloatArray:
    y = y.copy()
    y[rows, 0] = value
    return y


Made = tuple[list[Trajectory], list[Plant]]  # what is logged, and the plants any of which a fit may tell


def _clean(
    plant: Plant, rng: np.random.Generator, n: int, noise: float, kind: str = ""
) -> tuple[FloatArray, FloatArray]:
    u = rich(n, plant.b.shape[1], rng, kind)
    y = run(plant, u)
    return u, y + noise * y.std(axis=0) * rng.normal(size=y.shape)


def _late(plant: Plant) -> Plant:
    return replace(plant, delay=plant.delay + 1)


def _made(kind: str, plant: Plant, rng: np.random.Generator, n: int, noise: float) -> Made:
    nu, ny = plant.b.shape[1], len(plant.c)
    u, y = _clean(plant, rng, n, noise)
    s, rows = float(y[:, 0].std()), rng.choice(np.arange(20, n - 20), n // 60, replace=False)
    whole = [plant]
    if kind == "spikes":
        y = _at(y, rows, y[rows, 0] + 6 * s * rng.choice([-1.0, 1.0], len(rows)))
    elif kind == "few small spikes":
        y = _at(y, rows[:4], y[rows[:4], 0] + 2 * s)
    elif kind == "9999":
        y = _at(y, rows[:4], 9999.0)
    elif kind == "zeros":
        y = _at(y, rows, 0.0)
    elif kind == "u zeros":
        u = _at(u, rows, 0.0)
    elif kind == "stuck":
        start = int(rng.integers(n // 4, n // 2))
        y = _at(y, slice(start, start + n // 6), y[start, 0])
    elif kind == "repeats":
        every = int(rng.integers(2, 6))
        y = y[np.arange(n) // every * every]
    elif kind == "clip":
        y = np.clip(y, *np.quantile(y, [0.15, 0.85], axis=0))
    elif kind == "saturated input":
        felt = np.clip(u, -0.4 * u.std(), 0.4 * u.std())
        y = run(plant, felt) + noise * s * rng.normal(size=y.shape)
        whole = [plant, replace(plant, b=plant.b * np.sum(felt * u) / np.sum(u**2))]
    elif kind == "y late":
        y, whole = np.vstack([y[:1], y[:-1]]), [plant, _late(plant)]
    elif kind == "u late":
        u = np.vstack([u[:1], u[:-1]])
    elif kind == "drift":
        y = y + np.linspace(0, float(rng.uniform(2, 10)), n)[:, None] * s
    elif kind == "slow load":
        y = y + 3 * s * load(n, ny, rng, 0.998)
    elif kind == "hum":
        y = y + float(rng.uniform(0.5, 2)) * s * np.sin(2 * np.pi * rng.uniform(0.2, 0.45) * np.arange(n))[:, None]
    elif kind == "step of the sensor":
        y = y + np.where(np.arange(n) > n // 2, 3 * s, 0.0)[:, None]
    elif kind == "operating point":
        u, y = u + 5.0, y + float(rng.uniform(3, 30)) * s
    elif kind == "too slow":  # every tenth row
        step = 10
        held = np.repeat(rich(n, nu, rng), step, axis=0)
        y = run(plant, held)[::step]
        y = y + noise * y.std(axis=0) * rng.normal(size=y.shape)
        return [record(held[::step], y, plant)], [Plant(*_slower(plant, step), 0)]
    elif kind == "too fast":
        plant = drawn(rng, slow=2.0)
        u = rich(n, plant.b.shape[1], rng, "slow")
        y = run(plant, u)
        y = y + max(noise, 1e-3) * y.std(axis=0) * rng.normal(size=y.shape)
        whole = [plant]
    elif kind == "two loads":
        other = replace(plant, b=plant.b * float(rng.choice([0.3, 3.0])), a=plant.a * 0.95)
        u2 = rich(n, nu, rng)
        y2 = run(other, u2)
        y2 = y2 + noise * y2.std(axis=0) * rng.normal(size=y2.shape)
        return [record(u, y, plant), record(u2, y2, plant)], [plant, other]
    elif kind == "dead time before row 0":
        plant = replace(plant, delay=int(rng.integers(3, 9)))
        u, y = _clean(plant, rng, n + 50, noise)
        u, y, whole = u[50:], y[50:], [plant]
    elif kind in ("step", "impulse", "ramp", "two lines", "on-off", "constant", "five levels"):
        k = np.arange(n)[:, None] * np.ones(nu)
        shift = np.arange(nu) * 17
        u = {
            "step": np.where(k > n // 10 + shift, 1.0, 0.0),
            "impulse": np.where(k == n // 10 + shift, 10.0, 0.0),
            "ramp": k / n * (1 + 0.0 * shift) + np.where(k > n // 2 + shift, k / n - 0.5, 0.0),
            "two lines": np.sin(0.07 * k + shift) + np.sin(0.31 * k + 2 * shift),
            "on-off": np.sign(np.sin(0.1 * k * (1 + 0.13 * shift) + 0.3)),
            "constant": np.ones((n, nu)),
            "five levels": np.repeat(rng.choice(np.linspace(-1, 1, 5), (n // 60 + 1, nu)), 60, axis=0)[:n],
        }[kind]
        y = run(plant, u)
        y = y + max(noise, 1e-3) * y.std(axis=0) * rng.normal(size=y.shape)
    elif kind == "collinear" and nu == 2:
        u[:, 1] = -0.7 * u[:, 0] + 0.01 * rng.normal(size=n)
        y = run(plant, u)
        y = y + max(noise, 1e-2) * y.std(axis=0) * rng.normal(size=y.shape)
    elif kind == "short":
        u, y = u[:30], y[:30]
    elif kind == "noise alone":
        y = load(n, ny, rng, float(rng.choice([0.0, 0.9])))
    elif kind == "coarse":
        y = np.round(y / (0.7 * s)) * 0.7 * s
    elif kind == "smoothed":
        kernel = np.ones(9) / 9
        y = np.stack([np.convolve(y[:, i], kernel, "same") for i in range(ny)], axis=1)
    elif kind == "crosstalk":
        y = y + 0.5 * s * u[:, :1]
    return [record(u, y, plant)], whole


def _slower(plant: Plant, step: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the plant over so many samples of a held input, the dead time within them (less than a step)."""
    n, nu = plant.b.shape
    power, late = np.linalg.matrix_power, plant.delay
    a = power(plant.a, step)
    now = sum((power(plant.a, j) @ plant.b for j in range(step - late)), np.zeros_like(plant.b))
    before = sum((power(plant.a, j) @ plant.b for j in range(step - late, step)), np.zeros_like(plant.b))
    if not late:
        return a, now, plant.c
    whole = np.block([[a, before], [np.zeros((nu, n)), np.zeros((nu, nu))]])
    return whole, np.vstack([now, np.eye(nu)]), np.hstack([plant.c, np.zeros((len(plant.c), nu))])


KINDS = (
    "spikes", "few small spikes", "9999", "zeros", "u zeros", "stuck", "repeats", "clip", "saturated input", "y late",
    "u late", "drift", "slow load", "hum", "step of the sensor", "operating point", "too slow", "too fast", "two loads",
    "dead time before row 0", "step", "impulse", "ramp", "two lines", "on-off", "constant", "five levels", "collinear",
    "short", "noise alone", "coarse", "smoothed", "crosstalk", "clean",
)  # fmt: skip


def loop(plant: Plant, rng: np.random.Generator, n: int) -> tuple[list[Trajectory], str]:
    """Return a record of an excited loop, and what it was."""
    nu, ny = plant.b.shape[1], len(plant.c)
    spread, size = np.ones(ny), np.ones(nu)
    law = str(rng.choice(["P", "PI", "PD", "filtered", "late"]))
    moved = str(rng.choice(["dither", "reference", "steps"]))
    share = float(rng.choice([0.3, 1.0, 3.0]))
    size_of_load = float(rng.choice([0.1, 0.3, 1.0]))
    noise = float(rng.choice([1e-4, 1e-2, 0.05]))
    slow = float(rng.choice([0.0, 0.6, 0.95]))
    dc = np.real(response(plant, np.zeros(1))[0])
    gain = 0.3 * np.linalg.pinv(dc) if np.linalg.norm(dc) > 0.1 else 0.1 * np.ones((nu, ny))
    peak = float(np.abs(response(plant, np.linspace(0.02, 4.9, 60)) @ gain).max())
    gain = gain * min(1.0, 0.6 / peak)
    seed = int(rng.integers(1 << 30))
    for turn in range(2):
        r = np.random.default_rng(seed)
        e = size_of_load * load(n, ny, r, slow)
        w = rich(n, nu, r, {"dither": "noise", "reference": "slow", "steps": "steps"}[moved])
        x, total, last, filt = np.zeros(len(plant.a)), np.zeros(nu), np.zeros(nu), np.zeros(nu)
        u, y, given = np.zeros((n, nu)), np.zeros((n, ny)), np.zeros((n + plant.delay, nu))
        for k in range(n):
            y[k] = plant.c @ x + e[k] + noise * spread * r.normal(size=ny)
            now = -gain @ y[k]
            total, filt = total + 0.05 * now, 0.6 * filt + 0.4 * now
            command = {"P": now, "PI": now + total, "PD": now + 0.5 * (now - last), "filtered": filt, "late": last}[law]
            last = now
            u[k] = command + share * turn * size * w[k]
            given[k + plant.delay] = u[k]
            x = plant.a @ x + plant.b @ given[k]
        size, spread = u.std(axis=0), y.std(axis=0)
        if not np.isfinite(y).all() or spread.max() > 50:
            return loop(plant, rng, n)
    return [record(u, y, plant)], f"{law} {moved} {share} noise {noise} load {size_of_load} of pole {slow}"


def right(model: Any, plants: list[Plant], seed: int) -> float:
    """Return the one-step error under fresh inputs over the change in a step, of the plant that it fits best."""
    found = []
    for plant in plants:
        rng = np.random.default_rng([seed, 5])
        u = 0.7 * (rich(400, plant.b.shape[1], rng, "noise") + rich(400, plant.b.shape[1], rng, "slow"))
        y = run(plant, u)
        fresh = Trajectory(np.arange(400) * 0.1, u, y, model.spec)
        skip = max(int(model.burn_in) + 2, 60)
        sizes = np.mean(np.diff(y, axis=0)[skip:] ** 2, axis=0), np.var(y[skip:], axis=0)
        shares = []
        for horizon, size in zip((1, None), sizes, strict=True):
            try:
                with np.errstate(all="ignore"):
                    shares.append(np.var((y - predict(model, fresh, horizon))[skip:], axis=0) / size)
            except HarnessError:
                continue
        found.append(float(np.sqrt(np.nan_to_num(np.min(shares, axis=0), nan=np.inf)).max()) if shares else np.inf)
    return min(found)


def inside(model: Any, plants: list[Plant]) -> float | None:
    """Return the error of the response, over the response, inside the frequencies that a model calls determined.

    0 where it calls none so, None where it calls all so or says nothing.
    """
    bands = bands_of(model)
    if bands is None or getattr(model, "matrices", None) is None or not gaps_words(bands, 0.1):
        return None
    f = np.linspace(0.005, 4.995, 1000)
    own = gains(model.matrices, f, 0.1)
    found = []
    for plant in plants:
        true = response(plant, f)
        worst = 0.0
        for i, y in enumerate(model.spec.outputs):
            for j, u in enumerate(model.spec.inputs):
                told = np.zeros(len(f), dtype=bool)
                for low, high in bands[f"{y.name} per {u.name}"]:
                    told |= (f >= low) & (f <= high)
                if told.any():
                    apart, size = abs(own - true)[told, i, j], abs(true[told, i, j])
                    worst = max(worst, float(np.sqrt(np.sum(apart**2) / np.sum(size**2))))
        found.append(worst)
    return min(found)


def outcome(
    name: str, options: dict[str, Any], records: list[Trajectory], plants: list[Plant], seed: int
) -> tuple[str, float, str]:
    """Return refused, warned, right, bands, noted or silent, the error, and what was said."""
    try:
        model: Any = registry.create("identifiers", name, **options).fit(records, rng=np.random.default_rng(0))
    except HarnessError as error:
        return "refused", np.nan, str(error)
    notes = getattr(model, "notes", {})
    error = right(model, plants, seed)
    said = str(notes.get("warning") or notes.get("warnings") or "")
    good = error < RIGHT
    if said:
        return "warned right" if good else "warned wrong", error, said
    if good:
        return "right", error, ""
    wrong = inside(model, plants)
    if wrong is not None and wrong < RIGHT:
        return "bands", error, f"{wrong:.2g} inside"
    if noted := str(notes.get("odd_readings", "")):
        return "noted", error, noted
    return "silent", error, f"{wrong} inside"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("loops", "records"))
    parser.add_argument("--base", type=int, default=BASE)
    parser.add_argument("--plants", type=int, default=2, help="of each kind, or loops")
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--kinds", nargs="*", default=[])
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    counts: Counter[str] = Counter()
    by: dict[str, Counter[str]] = {}
    kinds = [k for k in KINDS if not given.kinds or k in given.kinds] if given.what == "records" else ["loop"]
    for number, kind in enumerate(kinds if given.what == "loops" else KINDS):
        if kind not in kinds:
            continue
        for turn in range(given.plants):
            seed = given.base + 100 * number + turn
            rng = np.random.default_rng(seed)
            plant = drawn(rng)
            if kind == "loop":
                records, title = loop(plant, rng, 1000)
                plants = [plant]
            else:
                noise = float(rng.choice([1e-3, 1e-2, 5e-2]))
                records, plants = _made(kind, plant, rng, 600, noise)
                title = f"{kind} noise {noise}"
            title += f" | n {len(plant.a)} {plant.b.shape[1]}x{len(plant.c)} late {plant.delay} | {seed}"
            for name, options in IDENTIFIERS:
                label = f"{name} {options or ''}"
                if given.only and not any(word in label for word in given.only):
                    continue
                began = time.process_time()
                found, error, said = outcome(name, options, records, plants, seed)
                took = time.process_time() - began
                counts[found] += 1
                for key in (label, kind):
                    by.setdefault(key, Counter())[found] += 1
                if given.verbose or found == "silent":
                    print(f"{found:12} {label:45} {error:8.3g} {took:5.1f} s | {title} | {said[:150]}", flush=True)
    print(dict(counts))
    for key, one in by.items():
        print(f"{key:50} " + "  ".join(f"{word} {one[word]}" for word in WORDS))


if __name__ == "__main__":
    main()
