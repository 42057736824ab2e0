"""Render every environment into one picture.

    python tools/studies/envs_picture.py PICTURE [TASK ...]

Each is driven by the reference controller of its task, where it has one. Needs OpenGL without a
screen.
"""

import sys
from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import hydrotele.envs
from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.catalogue import make_controller

SECONDS = {"TrackTrajectory": 4.0, "StraightLine": 2.0, "ReachFeller": 1.5, "PlaceLog": 12.0, "LoadTruck": 12.8}
SHOWN = 6.0  # s, of the others
SEEDS = {"TrackTrajectory": 3, "ReachFeller": 2}
SEED = 1  # of the others
SIZE = (560, 400)
COLOURS = 256

picture, tasks = Path(sys.argv[1]), sys.argv[2:] or hydrotele.envs.TASK_NAMES
columns = 2 if len(tasks) in (2, 4) else min(4 if len(tasks) > 6 else 3, len(tasks))
rows = -(-len(tasks) // columns)
whole = Image.new("RGB", (columns * SIZE[0], rows * SIZE[1]), (255, 255, 255))
font = ImageFont.load_default(24)
for number, task in enumerate(tasks):
    env = gymnasium.make(f"hydrotele/{task}-v0", render_mode="rgb_array", width=SIZE[0], height=SIZE[1])
    setup = env.unwrapped.core.setup
    try:
        controller = make_controller("reference", setup)
    except InputError as error:
        print(error)
        controller = make_controller("zero", setup)
    controller.begin(1)
    seen, _ = env.reset(seed=SEEDS.get(task, SEED))
    for _ in range(round(SECONDS.get(task, SHOWN) * setup.options.control_rate)):
        seen, reward, terminated, _, info = env.step(controller(seen[np.newaxis])[0])
        if terminated:
            break
    panel = Image.fromarray(env.render())
    draw = ImageDraw.Draw(panel)
    draw.text((14, 10), task, (20, 24, 30), font=font, stroke_width=2, stroke_fill=(235, 240, 245))
    whole.paste(panel, (number % columns * SIZE[0], number // columns * SIZE[1]))
    print(task, f"reward {reward:.2f}", {k: round(float(v), 3) for k, v in info.items()})
    env.close()
# markers are few pixels of colours that nothing else has
whole.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(picture, optimize=True)
