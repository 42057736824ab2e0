"""Write a video of a machine from its log, without a screen."""

import math
import os
from collections.abc import Callable, Iterable, Iterator

import mujoco
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine
from hydrotele.scenario.surrounding_objects import SoilGround
from hydrotele.show.logged_poses import (
    compute_joint_positions,
    extract_joint_motion,
    logged_surroundings,
    poses_at_positions,
)
from hydrotele.show.offscreen_renderer import Canvas
from hydrotele.show.rerun_scene import compute_machine_camera, compute_tip_path
from hydrotele.show.soil_shapes import soil_history, soil_markers
from hydrotele.simulate.mechanism import GROUND_NAME, compile_mechanism

_FRAME_RATE = 25.0  # 1/s, so that the video runs in real time


def write_video(
    machine: Machine, log: Log, path: str | os.PathLike, size: tuple[int, int] = (1280, 720),
    progress: Callable[[float, float], None] | None = None,
) -> None:  # fmt: skip
    """Render a video of the machine that moves as in a log, with 25 frames per second in real time.

    Args:
        machine: machine of the log.
        log: log of the machine; one of true states shows the objects around it as well.
        path: MP4 file, written completely or not at all.
        size: width and height [pixel], multiples of 16.
        progress: called after each frame with (seconds of the log, total seconds).

    Raises:
        InputError: imageio-ffmpeg is not installed, a linkage cannot be closed, OpenGL does not work,
            or the file cannot be written.
    """
    things = logged_surroundings(log)
    model = compile_mechanism(machine, surroundings=things)
    rows = compute_joint_positions(machine, model, extract_joint_motion(machine, log), log)
    poses = poses_at_positions(model, rows)
    soil = None
    if grounds := [thing for thing in things if isinstance(thing, SoilGround)]:
        soil = soil_history(machine, grounds[0], log, poses)
        model.geom(GROUND_NAME).rgba[3] = 0.0  # the plane would cover the trench
    camera, data = _make_camera(model, compute_tip_path(machine, log, poses)), mujoco.MjData(model)
    begin, end = float(log.time[0]), float(log.time[-1])
    times = np.arange(begin, end, 1.0 / _FRAME_RATE)
    canvas = Canvas(model, *size)

    def draw_frames() -> Iterator[np.ndarray]:
        for time in times:
            row = min(int(np.searchsorted(log.time, time)), len(log) - 1)
            data.qpos[:] = rows[min(row, len(rows) - 1)]
            mujoco.mj_fwdPosition(model, data)
            yield canvas.draw(model, data, camera, soil_markers(soil, row, poses, machine) if soil else ())
            if progress:
                progress(float(time) - begin, end - begin)

    try:
        write_frames(path, size, _FRAME_RATE, draw_frames())
    finally:
        canvas.close()


def write_frames(path: str | os.PathLike, size: tuple[int, int], rate: float, images: Iterable[np.ndarray]) -> None:
    """Encode images as a video.

    Args:
        path: MP4 file, written completely or not at all.
        size: width and height [pixel], multiples of 16.
        rate: images per second [Hz].
        images: (height, width, 3) uint8 each.

    Raises:
        InputError: imageio-ffmpeg is not installed, or the file cannot be written.
    """
    try:
        import imageio_ffmpeg  # pyright: ignore[reportMissingImports]
    except ImportError:
        message = "needs the package imageio-ffmpeg: pip install 'hydrotele[video]'"
        raise InputError("the video", message) from None
    with atomic_file(path, ".mp4") as part:
        frames = imageio_ffmpeg.write_frames(str(part), size, fps=rate, quality=7)
        frames.send(None)
        try:
            for image in images:
                frames.send(np.ascontiguousarray(image))
        finally:
            frames.close()


def _make_camera(model: mujoco.MjModel, tip: np.ndarray | None) -> mujoco.MjvCamera:
    """Return a camera that shows the machine and the whole path of its tip."""
    eye, target = compute_machine_camera(model, tip)
    ahead = target - eye
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance = target, float(np.linalg.norm(ahead))
    camera.azimuth = math.degrees(math.atan2(ahead[1], ahead[0]))
    camera.elevation = math.degrees(math.asin(ahead[2] / camera.distance))
    return camera
