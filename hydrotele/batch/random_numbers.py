"""Random numbers from a seed and a counter, without state: the same on every processor and in every order."""

import math

import numpy as np

from hydrotele.core.compiled import compile_without_allocation

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MULTIPLIERS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_SHIFTS = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_ONE = np.uint64(1)
_TO_UNIT = 2.0**-53


@compile_without_allocation
def mix_bits(value):
    """Return a 64-bit hash of a 64-bit integer.

    Args:
        value: uint64.

    Source: Steele, Lea and Flood 2014, Fast splittable pseudorandom number generators, OOPSLA (mix64variant13).

    >>> hex(mix_bits(np.uint64(0x9E3779B97F4A7C15)))
    '0xe220a8397b1dcdaf'
    """
    value = (value ^ (value >> _SHIFTS[0])) * _MULTIPLIERS[0]
    value = (value ^ (value >> _SHIFTS[1])) * _MULTIPLIERS[1]
    return value ^ (value >> _SHIFTS[2])


@compile_without_allocation
def hash_counters(seed, first, second):
    """Return a 64-bit hash of a seed (uint64) and two integers, uint64."""
    value = mix_bits(seed + _GAMMA)
    value = mix_bits(value + _GAMMA * (np.uint64(first) + _ONE))
    return mix_bits(value + _GAMMA * (np.uint64(second) + _ONE))


@compile_without_allocation
def uniform_number(seed, first, second):
    """Return a random number that is uniform in [0, 1), from a seed (uint64) and two integers."""
    return float(hash_counters(seed, first, second) >> _SHIFTS[3]) * _TO_UNIT


@compile_without_allocation
def normal_number(seed, first, second):
    """Return a random number with mean 0 and variance 1, from a seed (uint64) and two integers.

    Source: Box and Muller 1958, Ann. Math. Statist. 29(2).
    """
    bits = hash_counters(seed, first, second)
    radius = 1.0 - float(bits >> _SHIFTS[3]) * _TO_UNIT  # in (0, 1]
    angle = float(mix_bits(bits + _GAMMA) >> _SHIFTS[3]) * _TO_UNIT
    return math.sqrt(-2.0 * math.log(radius)) * math.cos(2.0 * math.pi * angle)
