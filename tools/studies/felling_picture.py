"""Render six moments of the felling of a tree into one picture.

    python tools/studies/felling_picture.py RUN_FOLDER PICTURE

Needs OpenGL without a screen: MUJOCO_GL=egl or osmesa.
"""

import sys
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from hydrotele.logs.log import load_log
from hydrotele.machine.machine_file import load_machine
from hydrotele.show.logged_poses import (
    compute_joint_positions,
    extract_joint_motion,
    logged_surroundings,
)
from hydrotele.simulate.mechanism import compile_mechanism

MOMENTS = (11.0, 29.0, 38.0, 60.0, 74.0, 85.5)  # s
SIZE = (560, 420)
COLUMNS = 3

folder, picture = Path(sys.argv[1]), Path(sys.argv[2])
machine, log = load_machine(folder / "machine.yaml"), load_log(folder / "truth.parquet")
model = compile_mechanism(machine, surroundings=logged_surroundings(log))
rows = np.searchsorted(log.time, MOMENTS)
positions = compute_joint_positions(machine, model, extract_joint_motion(machine, log), log)[rows]
data, camera = mujoco.MjData(model), mujoco.MjvCamera()
camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (4.0, 1.5, 3.2), 18, 125, -12
renderer = mujoco.Renderer(model, SIZE[1], SIZE[0])
whole = Image.new("RGB", (COLUMNS * SIZE[0], len(MOMENTS) // COLUMNS * SIZE[1]))
for number, qpos in enumerate(positions):
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    renderer.update_scene(data, camera)
    place = (number % COLUMNS * SIZE[0], number // COLUMNS * SIZE[1])
    whole.paste(Image.fromarray(renderer.render()), place)
renderer.close()
whole.quantize(96).save(picture, optimize=True)
