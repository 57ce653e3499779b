"""Random streams keyed by what they are for, never by the order in which they are asked for."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from harness.errors import InputError


def stream(*keys: str | int) -> np.random.Generator:
    """Return the generator that belongs to these keys.

    The same keys give the same stream in any process, in any order, on any number of workers.

    Parameters
    ----------
    *keys : str or int
        What the numbers are for, from the general to the particular.

    Returns
    -------
    numpy.random.Generator
        A PCG64 generator seeded with the SHA-256 digest of the keys.

    Raises
    ------
    InputError
        If a number is negative: seeds count from 0.

    Examples
    --------
    >>> float(stream("pendulum", 3).random()) == float(stream("pendulum", 3).random())
    True
    >>> float(stream("pendulum", 3).random()) == float(stream("pendulum", 4).random())
    False
    """
    for key in keys:
        if isinstance(key, int) and key < 0:
            raise InputError("seed", expected="a whole number from 0", got=str(key), remedy="give one", place="seed")
    text = "\x1f".join(f"{type(key).__name__}:{key}" for key in keys)
    digest = hashlib.sha256(text.encode()).digest()
    return np.random.default_rng(np.random.SeedSequence(np.frombuffer(digest, dtype=np.uint32).tolist()))


@dataclass(frozen=True)
class Streams:
    """The streams of one experiment, keyed (plant, scenario, seed, role).

    The identifier is no part of the key: changing it never changes the data, so comparisons are paired.

    Examples
    --------
    >>> streams = Streams("pendulum-ode", "multisine", 0)
    >>> float(streams("noise").random()) == float(streams("noise").random())
    True
    """

    plant: str
    scenario: str
    seed: int

    def __call__(self, role: str) -> np.random.Generator:
        """Return the generator of one role, e.g. ``"estimation/0/noise"``."""
        return stream(self.plant, self.scenario, self.seed, role)
