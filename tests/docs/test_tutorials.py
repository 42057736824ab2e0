"""The tutorials: small versions daily, all of them in full size nightly."""

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.run_notebook import COMMAND, read_cells

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = {path.stem: path for path in sorted((ROOT / "docs" / "tutorials").glob("*.md")) if path.stem != "index"}
SMALL = {  # values of the parameters
    "simulate_and_review": {"DURATION": 2.0},
    "bring_your_machine": {},
    "bring_your_log": {"DURATION": 11},
    "train_a_controller": {"ENVIRONMENTS": 2, "CANDIDATES": 2, "STEPS": 0},
    "write_your_own": {},
}
NEEDS = {"bring_your_machine": "trimesh", "train_a_controller": "stable_baselines3"}


def run(name: str, folder: Path, *options: str) -> None:
    command = [sys.executable, str(Path(__file__).with_name("run_notebook.py")), str(TUTORIALS[name]), *options]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


@pytest.mark.parametrize("name", SMALL)
def test_small_version_runs(name, tmp_path):
    if name == "bring_your_machine":
        pytest.importorskip(NEEDS[name], reason="the extra urdf is not installed")
    run(name, tmp_path, "--small", json.dumps(SMALL[name]))


@pytest.mark.nightly
@pytest.mark.parametrize("name", TUTORIALS)
def test_full_version_runs(name, tmp_path):
    if (module := NEEDS.get(name)) and not importlib.util.find_spec(module):
        pytest.skip(f"{module} is not installed")
    run(name, tmp_path)


@pytest.mark.parametrize("name", TUTORIALS)
def test_cells_are_valid_and_have_a_parameters_cell_if_the_test_changes_sizes(name):
    cells = read_cells(TUTORIALS[name])
    for cell in cells:
        if not cell.code.startswith("%%writefile"):
            ast.parse(COMMAND.sub(r"\1pass", cell.code))
    tagged = [cell for cell in cells if "parameters" in cell.tags]
    assigned = set(re.findall(r"^(\w+) =", "".join(cell.code for cell in tagged), re.M))
    assert assigned == set(SMALL.get(name, assigned))
