"""Render an image of a machine with MuJoCo, without a screen.

A child process renders the image, because a process can select its OpenGL driver only once, and a
faulty driver can crash the process.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file
from hydrotele.machine.machine import Machine
from hydrotele.show.visual_geometry import visible_bounds
from hydrotele.simulate.closed_loops import close_loops
from hydrotele.simulate.mechanism import compile_mechanism

_BACKENDS = ("egl", "osmesa")
_PACKAGES = "libegl1 and libgl1-mesa-dri, or libosmesa6"
_OVERVIEW, _FREE = "overview", "free"
_FIELD_OF_VIEW = 45.0  # deg, field of view of MuJoCo's free camera
_TIMEOUT = 120.0  # s, for one image


def render_machine(
    machine: Machine,
    path: str | os.PathLike,
    joints: Mapping[str, float] | None = None,
    camera: str = _OVERVIEW,
    size: tuple[int, int] = (1600, 1000),
) -> None:
    """Render an image of a machine and write it as PNG.

    Args:
        machine: the machine.
        path: PNG file, written completely or not at all.
        joints: {joint name: angle [rad] or position [m]}; other joints are in the home pose.
        camera: name of a camera of the machine, or `free` for a view of the whole machine.
            `overview` is replaced by `free` if the machine has no such camera.
        size: width and height [pixel].

    Raises:
        InputError: the linkages cannot be closed, there is no such camera, OpenGL cannot render
            without a screen (the message names the packages to install), or the file cannot be
            written.
    """
    model = compile_mechanism(machine)
    data = mujoco.MjData(model)
    close_loops(machine, model, data, dict(joints or {}))
    render_model(model, data, path, camera, size)


def render_model(
    model: mujoco.MjModel, data: mujoco.MjData, path: str | os.PathLike, camera: str = _OVERVIEW,
    size: tuple[int, int] = (1600, 1000),
) -> None:  # fmt: skip
    """Render the current state of a model and write it as PNG.

    Args:
        model: compiled model.
        data: state of the model.
        path: PNG file, written completely or not at all.
        camera: name of a camera of the model, or `free` for a view of the whole model. `overview` is
            replaced by `free` if the model has no such camera.
        size: width and height [pixel].

    Raises:
        InputError: there is no such camera, OpenGL cannot render without a screen (the message
            names the packages to install), or the file cannot be written.
    """
    mujoco.mj_fwdPosition(model, data)
    cameras = [model.camera(i).name for i in range(model.ncam)]
    if camera == _OVERVIEW and _OVERVIEW not in cameras:
        camera = _FREE
    if camera not in (*cameras, _FREE):
        raise InputError(f"camera {camera!r}", f"choose one of {', '.join((*cameras, _FREE))}")
    view = _compute_free_camera(model, data, size) if camera == _FREE else {"fixed": cameras.index(camera)}
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    model.vis.quality.offsamples = 8
    model.vis.quality.shadowsize = 8192
    with atomic_file(path, ".png") as part:
        save_png(part, _render_in_child(model, data.qpos, view, size))


def save_png(path: Path, pixels: np.ndarray) -> None:
    """Write pixels (height, width, 3), uint8, as PNG."""
    from PIL import Image

    Image.fromarray(pixels).save(path, format="PNG")


def _compute_free_camera(model: mujoco.MjModel, data: mujoco.MjData, size: tuple[int, int]) -> dict:
    """Return settings of a free camera, obliquely from above, that shows the whole model.

    Returns:
        lookat (3,) and distance [m], azimuth and elevation [deg].
    """
    low, high = visible_bounds(model, data)
    radius = 0.5 * float(np.linalg.norm(high - low))
    narrow = np.radians(0.5 * _FIELD_OF_VIEW) * min(1.0, size[0] / size[1])
    distance = 0.65 * radius / np.sin(narrow)
    return {
        "lookat": 0.5 * (low + high), "distance": distance, "azimuth": 222.0, "elevation": -16.0,
    }  # fmt: skip


def _render_in_child(model: mujoco.MjModel, qpos: np.ndarray, view: dict, size: tuple[int, int]) -> np.ndarray:
    """Render an image in a child process with the first OpenGL driver that works.

    Args:
        model: compiled model.
        qpos: (nq,) joint positions.
        view: camera: `fixed` (its index), or lookat, distance, azimuth and elevation.
        size: width and height [pixel].

    Returns:
        Pixels (height, width, 3), uint8.

    Raises:
        InputError: no driver works.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    backends = dict.fromkeys((*((wanted,) if wanted in _BACKENDS else ()), *_BACKENDS))
    reasons = []
    with tempfile.TemporaryDirectory(prefix="hydrotele_") as folder:
        task, result = Path(folder, "task.npz"), Path(folder, "pixels.npy")
        mujoco.mj_saveModel(model, str(Path(folder, "model.mjb")))
        np.savez(task, qpos=qpos, size=size, **view)
        for backend in backends:
            environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
            worker = [sys.executable, str(Path(__file__).with_name("render_process.py")), folder]
            try:
                done = subprocess.run(worker, env=environment, capture_output=True, text=True, timeout=_TIMEOUT)
            except subprocess.TimeoutExpired:
                reasons.append(f"{backend}: no image within {_TIMEOUT:.0f} s")
                continue
            if done.returncode == 0 and result.is_file():
                return np.load(result)
            said = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
            reasons.append(f"{backend}: {said[-1]}")
    raise InputError(
        "picture",
        "OpenGL cannot render without a screen; install its software drivers"
        f" (Debian: {_PACKAGES}). {'; '.join(reasons)}",
    )
