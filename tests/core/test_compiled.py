"""Compiled functions: what those without counted references may do, their caches, what is said."""

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numba.core.errors import TypingError

import hydrotele
from hydrotele.core.compile_progress import format_bar
from hydrotele.core.compiled import compile_without_allocation, compiled


@compile_without_allocation
def _double(values):
    part = values[1:]
    for i in range(len(part)):
        part[i] *= 2.0
    return values[0]


@compile_without_allocation
def _creates(size):
    return np.zeros(size).sum()


@compile_without_allocation
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


class _SixArrays(NamedTuple):
    """More native arguments than a named tuple that is passed by value."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    e: np.ndarray
    f: np.ndarray


@compiled
def _sum_of_ends(arrays):
    return arrays.a[0] + arrays.f.copy()[0]


@compile_without_allocation
def _sum_of_ends_without_allocation(arrays):
    return arrays.a[0] + arrays.f[0]


@pytest.mark.parametrize("function", [_sum_of_ends, _sum_of_ends_without_allocation])
def test_arrays_of_large_named_tuples_are_released_after_a_call(function):
    arrays = _SixArrays(*np.ones((6, 3)))
    before = [sys.getrefcount(values) for values in arrays]
    for _ in range(10):
        assert function(arrays) == 2.0
    assert [sys.getrefcount(values) for values in arrays] == before


PACKAGE = Path(hydrotele.__file__).parent
ROOT = PACKAGE.parent


def _run(root, cache, code):
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": str(root), "XDG_CACHE_HOME": str(cache)},
    )  # fmt: skip
    return done.stdout.split(), done.stderr


def test_a_changed_module_drops_the_caches_of_those_that_use_it_and_no_others(tmp_path):
    cache = tmp_path / "cache"
    package = tmp_path / "hydrotele"
    shutil.copytree(PACKAGE / "core", package / "core")
    (package / "__init__.py").write_text("")
    (package / "constant.py").write_text("HALF = 0.5\n")
    head = "from hydrotele.core.compiled import compiled\n"
    law = "@compiled\ndef law(x):\n    return {} * x\n"
    (package / "made.py").write_text(head + "from hydrotele.constant import HALF\n\n" + law.format("HALF"))
    (package / "other.py").write_text(head + "\n" + law.format("3.0"))
    code = "from hydrotele.made import law; from hydrotele.other import law as other\n"
    code += "print(law(4.0), other(4.0), len(law.stats.cache_hits), len(other.stats.cache_hits))"
    assert _run(tmp_path, cache, code)[0] == ["2.0", "12.0", "0", "0"]
    assert _run(tmp_path, cache, code)[0] == ["2.0", "12.0", "1", "1"]
    (package / "constant.py").write_text("HALF = 0.25\n")
    assert _run(tmp_path, cache, code)[0] == ["1.0", "12.0", "0", "1"]
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(package, elsewhere / "hydrotele")
    assert _run(elsewhere, cache, code)[0] == ["1.0", "12.0", "1", "1"]


@pytest.mark.nightly
def test_another_form_of_the_cache_is_never_read(tmp_path):
    """Also for a function whose module imports nothing of the package, such as a law."""
    package = tmp_path / "hydrotele"
    shutil.copytree(PACKAGE / "core", package / "core")
    (package / "__init__.py").write_text("")
    (package / "law.py").write_text("def law(x):\n    return 5.0 * x\n")
    code = "from hydrotele.core.compiled import compiled; from hydrotele.law import law\n"
    code += "called = compiled(law); print(called(2.0), len(called.stats.cache_hits))"
    assert _run(tmp_path, tmp_path, code)[0] == ["10.0", "0"]
    assert _run(tmp_path, tmp_path, code)[0] == ["10.0", "1"]
    with (package / "core" / "linking.py").open("a") as file:
        file.write("# another form\n")
    assert _run(tmp_path, tmp_path, code)[0] == ["10.0", "0"]


CACHE_FAULTS = """
from hydrotele.core.compiled import callback, compiled


@compiled
def law(x):
    return 2.0 * x


@callback("float64(float64)")
def twice(x):
    return 2.0 * x


print(law(1.0), law(1), twice.ctypes(2.0), sum(law.stats.cache_hits.values()), twice._compiled._cache_hits)
"""


@pytest.fixture
def cached_module(tmp_path):
    """Return a function that runs a module with cached functions, and the files of its cache."""
    package = tmp_path / "hydrotele"
    shutil.copytree(PACKAGE / "core", package / "core")
    (package / "__init__.py").write_text("")
    (package / "made.py").write_text(CACHE_FAULTS)

    def run(before=""):
        answers, notes = _run(tmp_path, tmp_path, f"{before}\nimport hydrotele.made")
        return answers, [line for line in notes.splitlines() if not line.startswith("compiling")]

    assert run() == (["2.0", "2.0", "4.0", "0", "0"], [])
    files = sorted((tmp_path / "hydrotele/compiled").rglob("*.code"))
    assert len(files) == 3  # two signatures of `law`, one of `twice`
    return run, files


@pytest.mark.nightly
def test_damaged_cache_files_are_compiled_again_with_one_line_of_notice(cached_module):
    run, files = cached_module
    content = [file.read_bytes() for file in files]
    damaged = b"", content[1][:900], bytes([*content[2][:2000], content[2][2000] ^ 1, *content[2][2001:]])
    for file, bad in zip(files, damaged, strict=True):
        file.write_bytes(bad)
    answers, notes = run()
    assert answers == ["2.0", "2.0", "4.0", "0", "0"]
    (note,) = notes
    assert re.fullmatch(
        "damaged compiled code is compiled again: "
        rf"{files[0].parent}/(law|twice)-\d+\.\w+\.code: its checksum is wrong", note,
    )  # fmt: skip
    content = [file.read_bytes() for file in files]
    files[0].write_bytes(content[1])  # intact, but of another signature
    files[1].write_bytes(content[0])
    assert run() == (["2.0", "2.0", "4.0", "0", "1"], [])


FULL_DISK = """
import errno, os
from hydrotele.core import code_cache
def fail(*_): raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
code_cache._write_atomically = os.open = fail
"""


@pytest.mark.nightly
def test_a_full_disk_keeps_compiled_code_in_memory(cached_module):
    run, files = cached_module
    for file in files:
        file.unlink()
    where = f"{files[0].parent} cannot be written, No space left on device"
    note = f"compiled functions are kept in memory only: {where}"
    assert run(FULL_DISK) == (["2.0", "2.0", "4.0", "0", "0"], [note])


@pytest.mark.nightly
def test_an_unusable_cache_folder_keeps_compiled_code_in_memory(cached_module, tmp_path):
    run, _ = cached_module
    shutil.rmtree(tmp_path / "hydrotele/compiled")
    (tmp_path / "hydrotele/compiled").write_text("")  # a file where the folder has to be
    why = "no cache folder is writable by you alone; set XDG_CACHE_HOME to such a folder"
    note = f"compiled functions are kept in memory only: {why}"
    assert run() == (["2.0", "2.0", "4.0", "0", "0"], [note])


@pytest.mark.nightly
def test_two_processes_compile_a_function_once(tmp_path):
    package = tmp_path / "hydrotele"
    shutil.copytree(PACKAGE / "core", package / "core")
    (package / "__init__.py").write_text("")
    (package / "made.py").write_text(
        "import time\nfrom numba.core import event\n"
        "from hydrotele.core.compiled import callback, compiled\n\n"
        "class Slow(event.Listener):\n"  # so slow that both processes ask for it at once
        "    def on_start(self, event):\n        time.sleep(1.0)\n"
        "    def on_end(self, event):\n        pass\n\n"
        "event.register('numba:compile', Slow())\n\n"
        "@compiled\ndef law(x):\n    return 2.0 * x\n\n"
        "@callback('float64(float64)')\ndef twice(x):\n    return 2.0 * x\n"
    )
    code = (
        "from hydrotele.made import law, twice\n"
        "assert twice.ctypes(2.0) == 4.0\n"
        "law(1.0); print(len(law.stats.cache_hits), twice._compiled._cache_hits)"
    )
    both = [
        subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE,
                         env={**os.environ, "PYTHONPATH": str(tmp_path),
                              "XDG_CACHE_HOME": str(tmp_path / "cache")})
        for _ in range(2)
    ]  # fmt: skip
    hits = [one.communicate()[0].split() for one in both]
    assert sorted(laws for laws, _ in hits) == [b"0", b"1"]
    assert sorted(callbacks for _, callbacks in hits) == [b"0", b"1"]


PROGRESS = """
from hydrotele.core import compile_progress, compiled
compile_progress.SECONDS_BEFORE_BAR = compile_progress.SECONDS_BETWEEN_LINES = 0.0
compile_progress._REDRAW_INTERVAL = 0.01
inner = compiled.compiled(lambda x: 2.0 * x)
@compiled.compiled
def law(x):
    return inner(x) + 1.0
law(1.0)
print([f.py_func is inner.py_func for f in compile_progress.called_dispatchers(law.py_func)])
"""


def test_progress_names_the_function_and_the_time_left(tmp_path):
    out, lines = _run(ROOT, tmp_path, PROGRESS)
    assert out == ["[True]"]
    assert "compiling law" in lines and "(once, then cached)" in lines
    assert re.search(r"about \d+ s left", lines)


def test_bar_shows_the_fraction():
    assert "[" + "#" * 15 + "-" * 15 + "], about 8 s left" in format_bar("law", 0.5, 8.2)
    assert "[" + "-" * 30 + "] (once" in format_bar("law", 0.0, None)


ELSEWHERE = """
import numpy as np
from hydrotele.core import compiled
from hydrotele.simulate.closed_loops import max_pin_opening
code = "import numpy as np; from hydrotele.simulate.closed_loops import max_pin_opening as f"
code += "; f(np.zeros((2, 3)), np.zeros(1, int), np.ones(1, int))"
for _ in range(2):
    compiled.compile_in_background(max_pin_opening, code)
for process in compiled._background_processes.values():
    assert process.wait() == 0
max_pin_opening(np.zeros((2, 3)), np.zeros(1, int), np.ones(1, int))
print(len(compiled._background_processes), sum(max_pin_opening.stats.cache_hits.values()))
"""


@pytest.mark.nightly
def test_what_a_process_beside_has_compiled_is_loaded_and_is_not_compiled_again(tmp_path):
    assert _run(ROOT, tmp_path, ELSEWHERE)[0] == ["1", "1"]
    assert _run(ROOT, tmp_path, ELSEWHERE)[0] == ["0", "1"]


@pytest.mark.nightly
def test_a_teleoperated_run_finds_what_was_compiled_ahead(tmp_path):
    """Its arguments are of the types that `compile_tick_loop` compiles: nothing is compiled again."""
    code = """
from hydrotele.run import run
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
run.compile_tick_loop()
run_scenario(load_scenario("press_stiffness", {"duration": "0.2"}))
print(len(run.run_teleoperated_ticks.signatures))
"""
    assert _run(ROOT, os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"), code)[0] == ["1"]


def test_code_for_other_processes_imports_what_exists():
    """Such code is a string, and a failure of its process would go unnoticed."""
    imports = [
        (path, *found)
        for path in sorted((ROOT / "hydrotele").rglob("*.py"))
        for found in re.findall(r'"from (hydrotele[\w.]*) import (\w+)(?: as \w+)?; ', path.read_text())
    ]
    assert imports
    missing = [one for one in imports if not hasattr(importlib.import_module(one[1]), one[2])]
    assert not missing
