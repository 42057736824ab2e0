"""Random numbers of an episode: splitmix64, whose state is one integer.

Source: Steele, Lea and Flood 2014, "Fast splittable pseudorandom number generators".
"""

import numpy as np

from hydrotele.core.compiled import compiled

_STEP = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_UNIT = 2.0**-53


@compiled
def mixed(z):
    """A 64-bit integer, scalar, of which every bit depends on every bit of `z`, scalar."""
    z = (z ^ (z >> _30)) * _FIRST
    z = (z ^ (z >> _27)) * _SECOND
    return z ^ (z >> _31)


@compiled
def draw(e):
    """A number of an episode, uniform in [0, 1), scalar; its `random` goes on.

    Args:
        e: its record of MEMORY.

    Returns:
        The number, scalar [1].

    Source: see the module.
    """
    e.random += _STEP
    return (mixed(e.random) >> _11) * _UNIT


@compiled
def between(e, low, high):
    """A number of an episode, uniform from `low` to `high`, scalars.

    Args:
        e: its record of MEMORY.
        low: scalar.
        high: scalar.

    Returns:
        The number, scalar.

    Source: see the module.
    """
    return low + (high - low) * draw(e)


def streams(seeds: np.ndarray) -> np.ndarray:
    """Where the streams of seeds begin.

    Args:
        seeds: (n,) integers >= 0.

    Returns:
        (n,) values of `random` in MEMORY; seeds that follow each other give unrelated streams.

    Raises:
        ValueError: a seed is no integer from 0 to 2^64 - 1.
    """
    seeds = np.asarray(seeds)
    if seeds.dtype.kind not in "iu" or (seeds < 0).any():
        raise ValueError("a seed must be an integer from 0 to 2^64 - 1")
    with np.errstate(over="ignore"):
        return mixed.py_func(np.asarray(seeds, np.uint64) * _STEP + _SECOND)
