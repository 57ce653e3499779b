"""Training of networks with torch, an optional extra: batches, the best state on held-out data, checkpoints."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.whole_files import whole_file
from harness.errors import InputError
from harness.options import check_options
from harness.signals import FloatArray

_LOOK = 50  # Steps between two looks at the held-out loss.


@dataclass(frozen=True, kw_only=True)
class Trained:
    """Options of an identifier that trains networks by Adam.

    Parameters
    ----------
    steps : int
        Of Adam.
    rate : float
        Learning rate at the start; it falls as a cosine.
    batch : int
        Rows or windows of a batch.
    checkpoint : path, optional
        File from which an interrupted fit goes on.
    progress : bool
        Show a bar on the error stream.

    Examples
    --------
    >>> try:
    ...     Trained(rate=0.0).check_numbers("a network")
    ... except InputError as error:
    ...     print(error)
    rate: option of a network: expected a number > 0, got 0.0; remedy: correct it
    """

    steps: int = 2000
    rate: float = 5e-3
    batch: int = 128
    checkpoint: str | None = None
    progress: bool = False

    def check_numbers(self, what: str, *names: str) -> None:
        """Refuse numbers below 1 (those named, and those of the training), and a rate that is not above 0."""
        check_options(self, what, **dict.fromkeys((*names, "steps", "batch"), ">= 1"), rate="> 0")


def need_torch(what: str) -> Any:
    """Return the torch module; its absence is refused in one line.

    Raises InputError if torch is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise InputError(
            f"{what} needs torch",
            expected="the optional extra 'learned'",
            got=f"{error}",
            remedy="pip install 'sysid-harness[learned]', or use gaussian-process, which needs nothing more",
        ) from error
    return torch


@contextmanager
def one_thread(torch: Any) -> Iterator[None]:
    """Keep torch to one thread, so that a fit repeats bit for bit, and put back what was set."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def draw_layers(sizes: Sequence[int], rng: np.random.Generator, members: int) -> list[tuple[FloatArray, FloatArray]]:
    """Return weights (members, in, out) and biases (members, 1, out) of tanh layers (Glorot, Bengio 2010, eq. 16)."""
    layers = []
    for inside, outside in itertools.pairwise(sizes):
        limit = np.sqrt(6.0 / (inside + outside))
        layers.append((rng.uniform(-limit, limit, (members, inside, outside)), np.zeros((members, 1, outside))))
    return layers


def train(
    torch: Any,
    parameters: Sequence[Any],
    loss: Callable[[Any], Any],
    held_out: Callable[[], Any],
    count: int,
    how: Trained,
    *,
    rng: np.random.Generator,
    title: str,
    members: int = 1,
) -> list[list[float]]:
    """Minimise a loss by Adam (Kingma and Ba 2015) with a rate that falls as a cosine; ends at the best held-out state.

    - ``parameters``: changed in place. The first axis goes over the members, each of which ends at its own best state.
    - ``loss``: ``loss(index (members, batch))`` returns the sum over the members
    - ``held_out``: returns the held-out loss of each member (members,)
    - ``count``: rows or windows that batches are drawn from
    - ``how``: its ``checkpoint`` is written now and then, and continued from if it belongs to the same training
    - ``title``: of the bar
    - returns the held-out loss of each member at every look
    """
    steps, rate = how.steps, how.rate
    size = min(how.batch, count)
    seed = int(rng.integers(2**62))
    adam = torch.optim.Adam(parameters, lr=rate)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(adam, T_max=max(steps, 1), eta_min=0.01 * rate)
    best = [parameter.detach().clone() for parameter in parameters]
    least = np.full(members, np.inf)
    history: list[list[float]] = []
    key = _key(parameters, how, count, seed)
    first = 0
    path = None if how.checkpoint is None else Path(how.checkpoint)
    if path is not None and path.is_file():
        saved = torch.load(path, weights_only=True)
        if saved["key"] == key:
            with torch.no_grad():
                for parameter, kept in zip(parameters, saved["parameters"], strict=True):
                    parameter.copy_(kept)
            adam.load_state_dict(saved["adam"])
            falling.load_state_dict(saved["falling"])
            best, least, first = saved["best"], np.array(saved["least"]), int(saved["step"])
            history = saved["history"]

    def look() -> None:
        nonlocal least
        with torch.no_grad():
            now = np.asarray(held_out().detach().numpy(), dtype=float).reshape(members)
            history.append(now.tolist())
            better = np.isfinite(now) & (now < least)
            least = np.where(better, now, least)
            for kept, parameter in zip(best, parameters, strict=True):
                for member in np.flatnonzero(better):
                    kept[member] = parameter[member]

    with bar(title, steps, how.progress) as move:
        for step in range(first, steps):
            # One stream for each step, so that a training that is continued draws the same batches.
            draw = np.random.default_rng([seed, step])
            index = torch.from_numpy(draw.integers(count, size=(members, size)))
            adam.zero_grad()
            total = loss(index)
            total.backward()
            torch.nn.utils.clip_grad_norm_(parameters, 10.0 * members)
            adam.step()
            falling.step()
            move(step + 1)
            if (step + 1) % _LOOK == 0 or step + 1 == steps:
                look()
                if path is not None:
                    content = {
                        "key": key,
                        "parameters": [parameter.detach() for parameter in parameters],
                        "adam": adam.state_dict(),
                        "falling": falling.state_dict(),
                        "best": best,
                        "least": least.tolist(),
                        "history": history,
                        "step": step + 1,
                    }
                    with whole_file(path) as scratch:
                        torch.save(content, scratch)
    with torch.no_grad():
        for parameter, kept in zip(parameters, best, strict=True):
            parameter.copy_(kept)
    return history


def _key(parameters: Sequence[Any], how: Trained, count: int, seed: int) -> str:
    """Return a hash of where a training begins: another one is not continued."""
    text = hashlib.sha256(repr(((how.steps, how.rate, how.batch), count, seed)).encode())
    for parameter in parameters:
        text.update(parameter.detach().numpy().tobytes())
    return text.hexdigest()


@contextmanager
def bar(title: str, steps: int, shown: bool) -> Iterator[Callable[[int], None]]:
    """Give a function that moves a progress bar, or does nothing."""
    if not shown:
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=steps)
        yield lambda done: bar.update(task, completed=done)


def train_tables(
    what: str,
    start: Mapping[str, FloatArray],
    miss: Callable[..., Any],
    learn: Sequence[FloatArray],
    held: Sequence[FloatArray],
    how: Trained,
    *,
    rng: np.random.Generator,
    fixed: Sequence[str] = (),
) -> tuple[dict[str, FloatArray], list[float]]:
    """Return the trained tables of one network, and its last three held-out losses.

    Raises InputError if torch is not installed.

    - ``what``: name of the identifier
    - ``start``: tables by name where the training begins
    - ``miss``: ``miss(torch, tables, *parts)`` returns the loss of windows
    - ``learn, held`` sequence of array (w, ...): windows to learn from, and held-out ones
    - ``fixed``: tables that stay what they are
    """
    torch = need_torch(what)
    with one_thread(torch):
        tensors = {name: torch.tensor(table[None], requires_grad=name not in fixed) for name, table in start.items()}
        inside, outside = ([torch.from_numpy(part) for part in parts] for parts in (learn, held))

        def loss(parts: Sequence[Any]) -> Any:
            return miss(torch, {name: tensor[0] for name, tensor in tensors.items()}, *parts)

        history = train(
            torch,
            [tensor for name, tensor in tensors.items() if name not in fixed],
            lambda index: loss([part[index[0]] for part in inside]),
            lambda: loss(outside)[None],
            len(learn[0]),
            how,
            rng=rng,
            title=what,
        )
        tables = {name: np.array(tensor[0].detach().numpy()) for name, tensor in tensors.items()}
    return tables, [losses[0] for losses in history[-3:]]
