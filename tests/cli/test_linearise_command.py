"""`hydrotele linearise`: table, JSON file and plot; wrong poses and speeds are named."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.cli import main as cli
from hydrotele.cli.linearise_command import parse_assignments
from hydrotele.core.errors import InputError
from hydrotele.estimate.linear_model import linearise
from hydrotele.machine.machine_file import load_machine


def test_two_poses_give_a_table_a_file_and_a_plot(tmp_path):
    words = [
        "linearise",
        "cat215",
        "--pose",
        "boom=0.45,stick=-1.6",
        "--pose",
        "boom=0,stick=-1",
        "--speed",
        "boom=0.1",
    ]
    words += ["--out", str(tmp_path / "m.json"), "--plot", str(tmp_path / "m.png")]
    result = CliRunner().invoke(cli.app, words, catch_exceptions=False, terminal_width=200)
    assert result.exit_code == 0 and "pose 2: stick=-1" in result.stdout
    first, second = json.loads((tmp_path / "m.json").read_text(encoding="utf-8"))["models"]
    expected = linearise(load_machine("cat215"), {"boom": 0.45, "stick": -1.6}, {"boom": 0.1})
    assert np.allclose(first["a"], expected.a, rtol=1e-9, atol=1e-9)
    assert first["states"] == list(expected.states) and second["pose"]["stick"] == -1.0
    assert (tmp_path / "m.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("text", ["boom", "boom=", "boom=a", "boom=1,boom=2", "=1", "boom=1;stick=2"])
def test_a_pose_of_another_form_is_refused(text):
    with pytest.raises(InputError, match="--pose"):
        parse_assignments("--pose", text)
