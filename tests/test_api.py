"""The public names: what `import hydrotele` offers, how fast, and what it is documented to be."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

import hydrotele

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("module", ["hydrotele.envs.gymnasium_env", "hydrotele.cli.run_command"])
def test_environments_and_runs_start_without_scipy_signal_and_rerun(module):
    """Together they would take as long to import as all other modules."""
    code = f"import sys, {module}; print([m for m in ('scipy.signal', 'scipy.optimize', 'rerun') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_every_public_name_is_there_and_has_a_docstring():
    for name in hydrotele.__all__:
        assert getattr(hydrotele, name).__doc__, name
    assert set(hydrotele.__all__) <= set(dir(hydrotele))
    with pytest.raises(AttributeError, match="no attribute 'load_machin'"):
        getattr(hydrotele, "load_machin")  # noqa: B009


def test_type_checkers_are_told_of_the_same_names_in_the_same_places():
    tree = ast.parse((ROOT / "hydrotele" / "__init__.pyi").read_text())
    told = {
        alias.name: node.module for node in tree.body if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }  # fmt: skip
    assert told == vars(hydrotele)["_MODULE"]


def test_the_page_lists_all_of_them():
    page = (ROOT / "docs" / "api.md").read_text()
    assert set(hydrotele.__all__) <= set(re.findall(r"\w+", page))


def test_nothing_heavy_is_imported_before_it_is_used():
    code = "import sys, hydrotele; print(*{'numpy', 'numba', 'mujoco'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_pressures_spools_and_tip_are_those_that_the_log_has():
    plant = hydrotele.build_plant(hydrotele.load_machine("cat215", "bucket"))
    data = hydrotele.rest_state(plant)
    data.ctrl[:] = [0.1, 0.5, -0.4, 0.3]
    mujoco.mj_step(plant.model, data, nstep=200)
    assert np.array_equal(np.sign(plant.spools(data)), np.sign(data.ctrl))
    areas = np.array([plant.machine.axes[a].hydraulic_drive.effective_areas for a in plant.axes])
    force = areas[:, 0] * plant.pressures(data)[:, 0] - areas[:, 1] * plant.pressures(data)[:, 1]
    friction = np.array([plant.machine.axes[a].drive.friction.coulomb for a in plant.axes])
    mujoco.mj_forward(plant.model, data)
    # The actuator's force is that of the pressures less friction; none adds more than breakaway.
    assert np.all(np.abs(data.actuator_force - force) < 3.0 * friction + 0.1 * np.abs(force))
    place, rotation = plant.tip(data)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)  # rounding
    assert np.allclose(place, data.body("bucket").xpos, atol=2.0)  # m: no bucket is longer
    with pytest.raises(hydrotele.InputError, match="no arm"):
        rig = hydrotele.build_plant(hydrotele.load_machine("rig"))
        rig.tip(hydrotele.rest_state(rig))


def test_a_log_is_read_from_a_run_folder_and_given_as_an_arrow_table(tmp_path):
    time = np.arange(20) / 50.0
    log = hydrotele.Log(
        time, {"angle.boom": 0.1 * time}, {"angle.boom": "rad"}, {"machine": "cat215", "hydrotele": "0"}
    )
    hydrotele.save_log(log, tmp_path / "measured.parquet")
    read = hydrotele.load_log(tmp_path)
    assert read.source == str(tmp_path / "measured.parquet")
    table = read.to_arrow()
    assert table.column_names == ["time", "angle.boom"]
    assert np.array_equal(table["angle.boom"].to_numpy(), 0.1 * time)
    assert [table.schema.field(name).metadata for name in table.column_names] == [{b"unit": b"s"}, {b"unit": b"rad"}]
    assert table.schema.metadata[b"machine"] == b"cat215"
    assert repr(read) == f"Log({read.source!r}, 20 rows at 50 Hz, channels=[angle.boom])"
    (tmp_path / "empty").mkdir()
    with pytest.raises(hydrotele.InputError, match="empty: is not a file and holds no measured.parquet; give a log"):
        hydrotele.load_log(tmp_path / "empty")


def test_repr_of_a_replay_names_the_channel_with_the_largest_error():
    from hydrotele.run.replay import ChannelDifference, Replay

    log = hydrotele.Log(np.arange(3) / 50.0, {}, {}, source="a.parquet")
    channels = {
        "angle.boom": ChannelDifference(0.01, 0.02, "rad", 1.0, 0.0),
        "pressure_head.boom": ChannelDifference(5.0e5, 9.0e5, "Pa", 1.0e7, 0.0),
    }
    text = "Replay('a.parquet', 2 channels, largest error relative to the range: pressure_head.boom RMS 5e+05 Pa)"
    assert repr(Replay(log, log, channels, 10.0)) == text
