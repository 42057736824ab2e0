"""A small version of tools/validation/random_commands.py (10^8 steps in full, 10^7 nightly)."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "tools" / "validation" / "random_commands.py"


def run(*arguments):
    return subprocess.run(
        [sys.executable, str(SCRIPT), *arguments],
        capture_output=True, text=True, cwd=ROOT, timeout=300, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip


@pytest.mark.nightly
def test_random_commands_make_no_nan_and_no_warning():
    result = run("--steps", "6e4", "--simulations", "12", "--states", "12", "--reset", "1000")
    assert result.returncode == 0, result.stdout + result.stderr
    lines = result.stdout.splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:-2]]
    assert {row[1] for row in rows} == {"none", "bucket", "grapple", "grapple_claw", "grapple_log"}
    for _, _, _, nan, warnings, gap, _, pressures, beyond in rows:
        assert (nan, warnings) == ("0", "0")
        assert 0 < float(gap) < 0.1, "pins open by less than 0.1 mm"
        assert 0.0 < float(pressures.split()[0]) < 0.1013, "chambers are drawn empty"
        assert float(beyond) <= 0.0
    assert int(lines[-1].split()[2]) >= 60_000


@pytest.mark.nightly
def test_a_step_that_cannot_work_is_noticed():
    # 50 ms is a whole period of the stick's 20 Hz
    result = run(
        "--tools",
        "none",
        "--steps",
        "4e3",
        "--states",
        "8",
        "--simulations",
        "8",
        "--timestep",
        "0.05",
    )
    assert result.returncode == 1
    assert "mjWARN_BADQACC" in result.stdout, result.stdout + result.stderr
