"""Compiled code that is shipped with the package, and the processor that it is compiled for."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import llvmlite.binding
import numba
import numpy as np
import pytest

import hydrotele
from hydrotele.core.compiled import compiled
from hydrotele.core.target_processor import choose_processor, processor_name

PACKAGE = Path(hydrotele.__file__).parent

MODULE = """
from hydrotele.core import linking
linking.MAX_INLINED_BYTECODE = 20
from hydrotele.core.compiled import callback, compiled

@compiled
def double(x):
    return 2.0 * x

@compiled
def large(x):
    return double(x) + double(x + 1.0) + 1.0 + x * x * x

@callback("float64(float64)")
def for_c(x):
    return large(x)
"""
CALL = """
from numba import njit
from hydrotele.module import double, for_c, large

@njit
def other_package(x):
    return large(x) + double(x)

@njit
def used_by_law(x):
    return x + 0.5

from hydrotele.core.compiled import compiled
user_law = compiled(lambda x: used_by_law(large(x)))
print(large(1.0), for_c.ctypes(1.0), other_package(1.0), user_law(1.0))
print(len(large.stats.cache_hits), for_c._compiled._cache_hits)
"""


def test_shipped_code_is_used_first_and_compiled_again_where_it_is_damaged(tmp_path):
    """Functions of a user and of other packages link to it; an empty user's cache stays without these functions."""
    package = tmp_path / "hydrotele"
    shutil.copytree(PACKAGE / "core", package / "core")
    (package / "__init__.py").write_text("")
    (package / "module.py").write_text(MODULE)

    def run(home):
        done = subprocess.run(
            [sys.executable, "-c", CALL], cwd=tmp_path, capture_output=True, text=True, check=True,
            env=os.environ | {"PYTHONPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / home)},
        )  # fmt: skip
        return done.stdout.split(), sorted((tmp_path / home).rglob("*.code"))

    results = ["8.0", "8.0", "10.0", "8.5"]
    answer, files = run("first")
    assert answer == [*results, "0", "0"] and files
    shutil.copytree(tmp_path / "first/hydrotele/compiled", package / "compiled_code")
    assert run("second") == ([*results, "1", "1"], [])
    for file in (package / "compiled_code").rglob("large-*.code"):
        file.write_bytes(file.read_bytes()[:-1])
    answer, files = run("third")
    assert answer[:4] == results
    assert {file.name.split("-")[0] for file in files} >= {"large", "for_c"}  # for_c refers to large's old symbol
    assert run("third")[0] == [*results, "1", "1"]


@compiled
def _triple(x):
    return 3.0 * x


def test_other_packages_keep_their_processor():
    theirs = numba.njit(lambda x: x + 1.0)
    assert theirs(1.0) == 2.0 and _triple(1.0) == 3.0
    processors = [code.library.codegen.magic_tuple()[1] for f in (theirs, _triple) for code in f.overloads.values()]
    assert processors == [numba.config.CPU_NAME or llvmlite.binding.get_host_cpu_name(), processor_name()]


@pytest.mark.parametrize(
    "missing, level", [((), "x86-64-v3"), (("avx2",), "x86-64-v2"), (("avx2", "ssse3"), None)]
)  # fmt: skip
def test_an_older_processor_gets_code_of_an_older_level(missing, level):
    names = "cx16 sahf popcnt sse3 ssse3 sse4.1 sse4.2 avx avx2 bmi bmi2 f16c fma lzcnt movbe xsave".split()
    assert choose_processor({name: name not in missing for name in names}) == level


LEVELS = """
import sys
from llvmlite import binding
features = binding.get_host_cpu_features()
features["avx2"] = features["avx2"] and sys.argv[1] == "x86-64-v3"
binding.get_host_cpu_features = lambda: features
import numpy as np
from hydrotele.core.target_processor import processor_name
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
run = run_scenario(load_scenario("dig", {"duration": "1"}))
np.save(sys.argv[2], np.array([run.truth[name] for name in run.truth.columns], float))
print(processor_name())
"""


@pytest.mark.nightly
@pytest.mark.skipif(processor_name() != "x86-64-v3", reason="the processor is older or of another architecture")
def test_the_older_level_gives_the_same_run(tmp_path):
    """x86-64-v2 has no fused multiply-add, so that results differ by rounding."""
    for level in ("x86-64-v3", "x86-64-v2"):
        done = subprocess.run(
            [sys.executable, "-c", LEVELS, level, tmp_path / f"{level}.npy"],
            capture_output=True, text=True, check=True,
            env=os.environ | {"PYTHONPATH": str(PACKAGE.parent), "XDG_CACHE_HOME": str(tmp_path)},
        )  # fmt: skip
        assert done.stdout.split() == [level]
    new, old = (np.load(tmp_path / f"{level}.npy") for level in ("x86-64-v3", "x86-64-v2"))
    scale = np.nanmax(np.abs(new), axis=1, keepdims=True)
    error = np.abs(new - old) / np.where(scale > 0.0, scale, 1.0)
    print(np.nanmax(error), new.shape)
