"""Nothing of the folder that a command runs in is executed: it may hold somebody else's data."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HYDROTELE = Path(sys.executable).with_name("hydrotele")
MODULES = (
    "struct", "multiprocessing", "json", "random", "ctypes", "subprocess", "glfw", "yaml", "numpy",
    "mujoco", "sitecustomize", "usercustomize", "evil_backend",
)  # fmt: skip
SWEEP = """\
name: one
scenario: zhu_up
grid: {duration: [0.2]}
figures: [tracking.tip_r.rms]
"""


@pytest.fixture
def hostile(tmp_path):
    """A folder with modules that leave a mark when they are imported, and configurations."""
    folder = tmp_path / "hostile"
    folder.mkdir()
    for name in MODULES:
        mark = folder / f"EXECUTED_{name}"
        (folder / f"{name}.py").write_text(f"open({str(mark)!r}, 'w').close()\nraise SystemExit(9)")
    (folder / ".numba_config.yaml").write_text(f"cache_dir: {folder / 'EXECUTED_cache'}\n")
    (folder / "matplotlibrc").write_text("backend: module://evil_backend\n")
    (folder / "one.yaml").write_text(SWEEP)
    return folder


@pytest.mark.nightly
@pytest.mark.parametrize(
    "command",
    [
        ("sweep", "one.yaml", "--jobs", "1", "--out", "out"),  # simulates in a worker, draws
        ("export", "rig", "--picture", "rig.png"),
        pytest.param(
            ("run", "zhu_up", "--set", "duration=0.2", "--out", "out"), marks=pytest.mark.nightly
        ),
    ],
)  # fmt: skip
def test_nothing_of_the_working_folder_is_executed(hostile, command):
    keys = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "PYTHONSAFEPATH", "DISPLAY")
    environment = {k: v for k, v in os.environ.items() if k not in keys}
    done = subprocess.run(
        [HYDROTELE, *command], cwd=hostile, env=environment, capture_output=True, text=True,
        timeout=300,
    )  # fmt: skip
    assert list(hostile.glob("EXECUTED*")) == []
    assert done.returncode == 0 or "OpenGL" in done.stderr, done.stderr[-2000:]
