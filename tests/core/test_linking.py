"""Compiled functions that call each other by symbol, and get large named tuples by address."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numba.core.errors import TypingError

import hydrotele
from hydrotele.core.compiled import compile_without_allocation, compiled
from hydrotele.core.tuple_references import MAX_ARGUMENTS_BY_VALUE, Reference

PACKAGE = Path(hydrotele.__file__).parent

CHAIN = """
from hydrotele.core import linking
linking.MAX_INLINED_BYTECODE = 0
from hydrotele.core.compiled import callback, compiled

@compiled
def inner(x):
    return 2.0 * x

@compiled
def middle(x):
    return inner(x) + 1.0

@compiled
def outer(x):
    return middle(x) + middle(2.0 * x)

@callback("float64(float64)")
def for_c(x):
    return middle(x)
"""


def test_cached_code_is_loaded_with_what_it_calls(tmp_path):
    """Also where a function that it calls was compiled again and has another symbol since.

    Called from Python, a function that compiled code calls as well is not compiled again: its code
    refers to the symbol.
    """
    package = tmp_path / "hydrotele"
    shutil.copytree(PACKAGE / "core", package / "core")
    (package / "__init__.py").write_text("")
    (package / "chain.py").write_text(CHAIN)
    code = """if True:
        from hydrotele.chain import for_c, middle, outer
        from hydrotele.core.linking import external_callees
        print(outer(3.0), for_c.ctypes(3.0), middle(3.0))
        if not middle.stats.cache_hits:
            print(*[place[1] for code in middle.overloads.values() for place, _ in external_callees(code).values()])
        print(len(outer.stats.cache_hits), for_c._compiled._cache_hits)
    """

    def results():
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True,
            env=os.environ | {"PYTHONPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)},
        )  # fmt: skip
        return done.stdout.split()

    assert results() == ["20.0", "7.0", "7.0", "middle", "0", "0"]
    assert results() == ["20.0", "7.0", "7.0", "1", "1"]
    before = "from numba import njit; f = njit(lambda x: x + 1.0); f(1.0); f(1)\n        "
    code = code.replace("from hydrotele", before + "from hydrotele", 1)  # shifts numba's symbols
    for path in tmp_path.rglob("*middle-*"):
        path.unlink()
    assert results() == ["20.0", "7.0", "7.0", "middle", "0", "0"]
    assert results() == ["20.0", "7.0", "7.0", "1", "1"]


class Inner(NamedTuple):
    """A named tuple within another."""

    values: np.ndarray
    count: int


class Outer(NamedTuple):
    """A named tuple that is handed on by address."""

    inner: Inner
    matrix: np.ndarray
    cube: np.ndarray
    numbers: np.ndarray
    more: np.ndarray
    factor: float
    active: bool


def outer(factor: float) -> Outer:
    """Make one."""
    return Outer(
        Inner(np.arange(4.0), 4), np.eye(2), np.ones((2, 2, 2)), np.zeros(3), np.zeros(2), factor,
        True,
    )  # fmt: skip


@compile_without_allocation
def _scale(inner, factor):
    for i in range(inner.count):
        inner.values[i] *= factor


@compile_without_allocation
def _work(o, k):
    _scale(o.inner, o.factor)
    inner, matrix, _, numbers, _, factor, active = o
    numbers[0] += matrix[0, 0] + o.cube[1, 1, 1] + inner.count
    return factor + k if active else 0.0


@compiled
def _repeat(o, factors):
    total = 0.0
    for k in range(len(factors)):
        other = Outer(o.inner, o.matrix, o.cube, o.numbers, o.more, factors[k], k % 2 == 0)
        total += _work(other, k)
    return total, o.numbers


@compiled
def _give_back(o):
    return o


@compiled
def _pass_on(o):
    return _give_back(o).factor


def test_a_large_named_tuple_is_read_where_it_lies():
    o = outer(2.0)
    assert _work(o, 1) == 3.0
    (signature,) = _work.signatures
    assert isinstance(signature[0], Reference)
    assert o.inner.values.tolist() == [0.0, 2.0, 4.0, 6.0] and o.numbers[0] == 6.0
    assert _work(o._replace(active=False), 1) == 0.0


def test_a_named_tuple_of_each_pass_of_a_loop_is_its_own():
    o = outer(1.0)
    total, numbers = _repeat(o, np.array([2.0, 3.0, 5.0]))
    assert total == 2.0 + (5.0 + 2.0)  # of the passes that are active
    assert o.inner.values.tolist() == [0.0, 30.0, 60.0, 90.0]
    del o
    assert numbers.tolist() == [18.0, 0.0, 0.0]  # still there without the tuple


def test_small_named_tuples_are_handed_on_by_value():
    inner = Inner(np.ones(2), 2)
    _scale(inner, 3.0)
    assert inner.values.tolist() == [3.0, 3.0]
    assert not any(isinstance(s[0], Reference) for s in _scale.signatures)
    assert MAX_ARGUMENTS_BY_VALUE > 8  # what `Inner` takes


def test_an_address_is_not_returned():
    with pytest.raises(TypingError, match="returns a large named tuple"):
        _pass_on(outer(1.0))
