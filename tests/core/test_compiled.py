"""Compiled functions: what those without counted references may do, and that they leak nothing."""

import sys

import numpy as np
import pytest
from numba.core.errors import TypingError

from hydrotele.core.compiled import lean


@lean
def _double(values):
    part = values[1:]
    for i in range(len(part)):
        part[i] *= 2.0
    return values[0]


@lean
def _creates(size):
    return np.zeros(size).sum()


@lean
def _returns_part(values):
    return values[1:]


def test_lean_functions_write_into_given_arrays_and_hold_none_of_them():
    values = np.ones(4)
    before = sys.getrefcount(values)
    for _ in range(10):
        assert _double(values) == 1.0
    assert values.tolist() == [1.0, 1024.0, 1024.0, 1024.0]
    assert sys.getrefcount(values) == before


def test_lean_functions_that_create_or_return_arrays_are_refused():
    with pytest.raises(TypingError):
        _creates(3)
    with pytest.raises(TypingError, match="array passed into"):
        _returns_part(np.ones(3))
