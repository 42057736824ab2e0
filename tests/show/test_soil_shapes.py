"""The drawn soil is that of the simulation: volume of the trench, level and area of the load."""

import sys
import types

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.scenario.surrounding_objects import read_soil_from_log
from hydrotele.show.logged_poses import body_poses, extract_joint_motion, logged_surroundings
from hydrotele.show.soil_shapes import make_bucket_load_mesh, make_ground_around_trench, soil_history, trench_mesh
from hydrotele.show.video import write_video
from hydrotele.simulate.mechanism import compile_mechanism
from hydrotele.soil.parameters import CARRIED_VOLUME, INNER_WIDTH


@pytest.fixture(scope="module")
def dug():
    return run_scenario(load_scenario("dig"))


@pytest.fixture(scope="module")
def history(dug):
    machine, log = dug.plant.machine, dug.truth
    model = compile_mechanism(machine, surroundings=logged_surroundings(log))
    poses = body_poses(machine, model, extract_joint_motion(machine, log), log)
    return soil_history(machine, read_soil_from_log(log)[0], log, poses)


def polygon_area(corners):
    x, z = corners.T
    return 0.5 * abs(x @ np.roll(z, -1) - z @ np.roll(x, -1))


@pytest.mark.nightly
def test_soil_computed_from_the_log_is_that_of_the_run(dug, history):
    """The log has a quarter of the control ticks: 5 % for the mass, a cell's slope for the depth."""
    assert history.bed.carried_mass == pytest.approx(dug.summary["soil"]["carried_mass_kg"], rel=0.05)
    assert -history.bed.surface.min() == pytest.approx(dug.summary["soil"]["trench_depth_m"], abs=0.02)
    assert history.shapes[0].surface.min() == 0.0 and not len(history.shapes[0].load)


def test_load_has_the_volume_that_the_bucket_carries(history):
    area = history.bed.state[CARRIED_VOLUME] / history.bed.parameters[INNER_WIDTH]
    assert polygon_area(history.shapes[-1].load) == pytest.approx(area, rel=0.1)  # the heap is a triangle
    vertices = make_bucket_load_mesh(history, len(history.shapes) - 1).vertices
    width = np.ptp(vertices @ history.axes[1])
    assert width == pytest.approx(history.bed.bucket.inner_width)
    assert make_bucket_load_mesh(history, 0) is None


def test_trench_is_drawn_and_the_ground_has_a_gap_for_it(history):
    mesh, colours = trench_mesh(history.bed, history.shapes[-1])
    assert mesh.vertices[:, 2].min() == pytest.approx(history.bed.surface.min(), abs=0.02)
    assert len(colours) == len(mesh.vertices)
    ground, _ = make_ground_around_trench(history.bed, 20.0, 2.0)
    middles = ground.vertices.reshape(-1, 3, 3).mean(axis=1)
    areas = np.linalg.norm(np.cross(*np.diff(ground.vertices.reshape(-1, 3, 3), axis=1).swapaxes(0, 1)), axis=1) / 2
    assert areas.sum() == pytest.approx(40.0**2 - 10.0 * history.bed.bucket.width)
    assert not np.any((np.abs(middles[:, 1]) < 0.5) & (middles[:, 0] > 1.5) & (middles[:, 0] < 10.5))


@pytest.fixture
def recorded_frames(monkeypatch):
    """Frames given to a stand-in for imageio-ffmpeg, which writes their number into the file."""
    frames = []

    def write_frames(path, size, **_):
        try:
            while True:
                frame = yield
                frames.append(np.array(frame))
        finally:
            with open(path, "wb") as file:
                file.write(str(len(frames)).encode())

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", types.SimpleNamespace(write_frames=write_frames))
    return frames


def test_video_shows_the_digging_in_real_time(dug, recorded_frames, tmp_path, monkeypatch):
    monkeypatch.setattr("hydrotele.show.video._FRAME_RATE", 0.2)
    done = []
    write_video(dug.plant.machine, dug.truth, tmp_path / "a.mp4", (320, 192), lambda now, total: done.append(now))
    times = np.arange(dug.truth.time[0], dug.truth.time[-1], 5.0)
    assert len(recorded_frames) == len(times) == len(done)
    assert recorded_frames[0].shape == (192, 320, 3)
    assert not np.array_equal(recorded_frames[0], recorded_frames[-1])
    assert (tmp_path / "a.mp4").read_bytes() == str(len(times)).encode()


def test_video_without_the_package_names_the_extra(dug, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r"needs the package imageio-ffmpeg: pip install 'hydrotele\[video\]'"):
        write_video(dug.plant.machine, dug.truth, tmp_path / "a.mp4")
