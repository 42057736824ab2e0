"""Render one image in a child process of `show.machine_image`, using the OpenGL driver set by MUJOCO_GL.

Usage: `python render_process.py FOLDER`. The program reads `model.mjb` and `task.npz` in the folder and
writes `pixels.npy`.
"""

import sys
from pathlib import Path

import mujoco
import numpy as np


def render_task_folder(folder: Path) -> None:
    """Render the model in a folder with the pose, camera and size of `task.npz`; write `pixels.npy`."""
    model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))
    task = np.load(folder / "task.npz")
    width, height = (int(n) for n in task["size"])
    data = mujoco.MjData(model)
    data.qpos[:] = task["qpos"]
    mujoco.mj_fwdPosition(model, data)
    camera = mujoco.MjvCamera()
    if "fixed" in task:
        camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, int(task["fixed"])
    else:
        camera.lookat[:] = task["lookat"]
        camera.distance, camera.azimuth = float(task["distance"]), float(task["azimuth"])
        camera.elevation = float(task["elevation"])
    with mujoco.Renderer(model, height, width, max_geom=max(10000, 2 * model.ngeom)) as renderer:
        renderer.update_scene(data, camera)
        np.save(folder / "pixels.npy", renderer.render())


if __name__ == "__main__":
    render_task_folder(Path(sys.argv[1]))
