"""The recording can be read again and holds what was logged, where it was logged."""

import dataclasses
import errno
import os
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from hydrotele.core.errors import InputError
from hydrotele.show.logged_poses import body_poses, extract_joint_motion
from hydrotele.show.recording import write_recording
from hydrotele.show.rerun_stream import open_recording
from hydrotele.simulate.mechanism import compile_mechanism


@pytest.fixture(scope="module")
def chunks(tmp_path_factory, machine, log):
    """Chunks of a recording of a log and its copy, by (entity path, is static)."""
    path = tmp_path_factory.mktemp("recording") / "two.rrd"
    write_recording(path, {"measured": (machine, log), "simulated": (machine, log)})
    assert [file.name for file in path.parent.iterdir()] == ["two.rrd"]
    return _read(path)


def _read(path):
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        columns = {name: batch.column(name) for name in batch.schema.names}
        found.setdefault((chunk.entity_path, chunk.is_static), {}).update(columns)
    return found


def _floats(column) -> np.ndarray:
    while hasattr(column, "flatten") and hasattr(column.type, "value_type"):
        column = column.flatten()
    return np.asarray(column, dtype=float)


@pytest.mark.nightly
def test_channels_come_back_in_shown_units(chunks, log):
    chunk = chunks["/measured/pressure_head/boom", False]
    assert np.asarray(chunk["time"]).astype(np.int64).tolist() == [20_000_000 * row for row in range(len(log))]
    values = _floats(chunk["Scalars:scalars"])
    assert values == pytest.approx(1e-6 * log["pressure_head.boom"], rel=1e-12)
    style = chunks["/measured/pressure_head/boom", True]
    assert style["SeriesLines:names"].to_pylist() == [["measured boom [MPa]"]]


def test_all_channels_are_there(chunks, log):
    for name in log.columns:
        assert (f"/measured/{name.replace('.', '/')}", False) in chunks


def test_bodies_move_as_in_mujoco(chunks, machine, log):
    model = compile_mechanism(machine)
    poses = body_poses(machine, model, extract_joint_motion(machine, log))
    for body in ("boom", "stick_rod", "bucket_coupler"):
        index = model.body(body).id
        chunk = chunks[f"/measured/machine/{body}", False]
        position = _floats(chunk["Transform3D:translation"]).reshape(-1, 3)
        xyzw = _floats(chunk["Transform3D:quaternion"]).reshape(-1, 4)
        # rerun keeps poses in single precision: 6e-8 of 10 m
        assert position == pytest.approx(poses.position[:, index], abs=1e-6)
        assert xyzw[:, [3, 0, 1, 2]] == pytest.approx(poses.quaternion[:, index], abs=1e-6)


def test_what_stands_still_is_logged_once(chunks):
    assert ("/measured/machine/chassis", True) in chunks
    assert ("/measured/machine/chassis", False) not in chunks


def test_shapes_have_the_colours_of_the_materials(chunks):
    solid = chunks["/measured/machine/boom/shape", True]
    packed = np.asarray(solid["Mesh3D:vertex_colors"].flatten()).astype(np.uint32)
    red, green, blue = (packed >> 24) & 255, (packed >> 16) & 255, (packed >> 8) & 255
    yellow = (red > 200) & (green > 140) & (blue < 60)
    assert yellow.mean() > 0.2  # a CAT is yellow
    assert "Mesh3D:albedo_factor" not in solid
    assert "Mesh3D:albedo_factor" in chunks["/simulated/machine/boom/shape", True]  # glass
    assert ("/simulated/machine/chassis/shape", True) not in chunks


def test_identical_logs_do_not_differ(chunks, log):
    for name in log.columns:
        chunk = chunks[f"/difference/simulated/{name.replace('.', '/')}", False]
        assert not _floats(chunk["Scalars:scalars"]).any()


def test_the_layout_is_in_the_file(tmp_path, machine, log):
    from rerun.chunk import RrdReader

    path = tmp_path / "one.rrd"
    write_recording(path, {"measured": (machine, log)})
    (blueprint,) = RrdReader(path).blueprints()
    (recording,) = RrdReader(path).recordings()
    assert blueprint.application_id == recording.application_id
    assert len(recording.application_id) <= 180 and recording.application_id.isascii()
    # 50 rows are nearly all geometry; a run of 2000 rows adds some 2 MB
    assert path.stat().st_size < 3e6


@pytest.mark.nightly
def test_a_machine_of_another_tool_can_stand_beside(tmp_path, machine, log):
    from hydrotele.machine.machine_file import load_machine

    bare = load_machine("cat215", tool="none")
    kept = {k: v for k, v in log.columns.items() if "bucket" not in k}
    other = dataclasses.replace(log, columns=kept, units={k: log.units[k] for k in kept})
    write_recording(tmp_path / "x.rrd", {"first": (machine, log), "second": (bare, other)})
    found = _read(tmp_path / "x.rrd")
    assert ("/second/machine/stick", False) in found
    assert ("/second/machine/bucket", False) not in found


@pytest.mark.parametrize("name", ["Measured", "a/b", "", "difference", "ground"])
def test_bad_names_are_refused(tmp_path, machine, log, name):
    with pytest.raises(InputError, match="recording entry"):
        write_recording(tmp_path / "x.rrd", {name: (machine, log)})


def test_nothing_is_left_of_a_recording_that_fails(tmp_path, machine, stuck, log):
    wild = dataclasses.replace(log, columns={**log.columns, "angle.bucket": 50 * log.time})
    with pytest.raises(InputError, match="do not close"):
        write_recording(tmp_path / "x.rrd", {"a": (stuck, wild)})
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match=r"ends in \.rrd"):
        write_recording(tmp_path / "x.txt", {"a": (machine, log)})
    with pytest.raises(InputError, match="not a folder"):
        write_recording(tmp_path / "no" / "x.rrd", {"a": (machine, log)})


def test_importing_the_room_does_not_import_rerun():
    import subprocess
    import sys

    code = (
        "import sys, hydrotele.show.recording, hydrotele.show.log_plots, hydrotele.show.rerun_viewer;"
        "assert not {'rerun', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)


def test_a_full_disk_is_one_sentence_at_once_and_leaves_nothing(tmp_path, monkeypatch):
    """As a file system without space does: the write fails, whoever does it."""
    monkeypatch.setattr(Path, "write_bytes", _no_space)
    with (
        pytest.raises(InputError, match=r"review\.rrd: cannot be written: No space left"),
        open_recording(tmp_path / "review.rrd", "full") as out,
    ):
        for _ in range(300):
            out.log("points", rr.Points3D(np.zeros((2000, 3))))
    assert list(tmp_path.iterdir()) == []


def _no_space(path, content):
    with path.open("wb") as file:
        file.write(content[:100])
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
