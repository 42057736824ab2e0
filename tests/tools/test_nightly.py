"""The table of long checks."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NIGHTLY = ROOT / "tools" / "nightly"


def nightly(*words):
    command = [sys.executable, NIGHTLY, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_every_check_is_a_command_of_this_repository():
    listed = nightly("--list").stdout.splitlines()
    assert len(listed) > 5
    for line in listed:
        script = line.split()[1]
        assert script == "-m" or (ROOT / script).is_file()


@pytest.mark.nightly
def test_a_check_needs_its_data_and_its_failure_is_told(tmp_path):
    refused = nightly("--only", "open_cases")
    assert refused.returncode == 2 and "--data is needed by open_cases" in refused.stderr
    failed = nightly("--only", "open_cases", "--data", tmp_path, "--out", tmp_path / "out")
    assert failed.returncode == 1
    (row,) = json.loads((tmp_path / "out" / "nightly.json").read_text()).values()
    assert row["status"] != 0 and "| open_cases |" in failed.stdout
