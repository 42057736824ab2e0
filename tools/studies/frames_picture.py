"""Draw the frames and signs of the CAT 215 as an SVG file, from the pins of its machine file.

python tools/studies/frames_picture.py docs/from_the_documents/frames.svg
"""

import sys
from pathlib import Path

import matplotlib
import mujoco
import numpy as np
from matplotlib import pyplot
from matplotlib.patches import Arc

import hydrotele as ht

POSE = {"boom": 0.5, "stick": -1.3, "bucket": -0.9}  # rad
LINK, OIL, SIGN = "#404040", "#0969b3", "#c2410c"

matplotlib.use("svg")
matplotlib.rcParams["svg.hashsalt"] = "frames"  # the same file in every run
plant = ht.build_plant(ht.load_machine("cat215", "bucket"))
data = ht.rest_state(plant, POSE)
mujoco.mj_forward(plant.model, data)


def place(body: str, offset=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the position (x, z) of a point of a body in the arm plane [m]."""
    return (data.body(body).xpos + data.body(body).xmat.reshape(3, 3) @ offset)[[0, 2]]


figure, axes = pyplot.subplots(figsize=(8.0, 5.2))
pins = [place(name) for name in ("boom", "stick", "bucket")] + [plant.tip(data)[0][[0, 2]]]
axes.plot(*np.array([place("swing"), pins[0], *pins[1:]]).T, color=LINK, lw=5, solid_capstyle="round")
axes.plot(*np.array(pins[:3]).T, "o", color="white", mec=LINK, ms=8, zorder=3)
axes.axhline(0.0, color="0.7", lw=1)
axes.plot([0.0, 0.0], [0.0, 3.6], color="0.6", ls="--", lw=1)
axes.text(-0.1, 3.3, "swing, positive\nabout +z", color=SIGN, ha="right", va="center")
for name in ("boom", "stick"):
    cylinder = plant.machine.axes[name].cylinder
    base, rod = (place(pin.link, pin.position) for pin in (cylinder.base_pin, cylinder.rod_pin))
    for pin, joints in (
        (base, pins[0:2] if name == "stick" else [place("swing"), pins[0]]),
        (rod, pins[0:2] if name == "boom" else pins[1:3]),
    ):
        axes.fill(*np.array([pin, *joints]).T, color=LINK, alpha=0.15, lw=0)
    axes.plot(*np.array([base, base + 0.6 * (rod - base)]).T, color=OIL, lw=6, alpha=0.45)
    axes.plot(*np.array([base, rod]).T, color=OIL, lw=2)
    middle = base + 0.3 * (rod - base)
    label = middle + (0.5, -0.75 if name == "boom" else 0.8)
    axes.annotate("head side", middle, label, color=OIL, arrowprops={"arrowstyle": "-", "color": OIL, "lw": 0.8})
    axes.annotate(
        "",
        rod + 0.6 * (rod - base) / np.linalg.norm(rod - base),
        rod,
        arrowprops={"arrowstyle": "->", "color": OIL, "lw": 2},
    )
start = 0.0
for name, pin in zip(POSE, pins, strict=False):
    along = np.array([np.cos(start), np.sin(start)])
    axes.plot(*np.array([pin, pin + 1.5 * along]).T, color=SIGN, lw=1, ls=":")
    angle = POSE[name]
    low, high = sorted((start, start + angle))
    axes.add_patch(Arc(pin, 2.2, 2.2, theta1=np.degrees(low), theta2=np.degrees(high), color=SIGN, lw=1.5))
    middle = pin + 1.3 * np.array([np.cos(start + angle / 2), np.sin(start + angle / 2)])
    axes.text(*middle, f"{name} {angle:+.1f} rad", color=SIGN, ha="left", va="center",
              bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1})  # fmt: skip
    start += angle
tip = pins[-1]
axes.plot(*tip, "s", color="black", ms=6)
for name, end, begin in (("r", (tip[0], -0.4), (0.0, -0.4)), ("z", (tip[0] + 0.4, tip[1]), (tip[0] + 0.4, 0.0))):
    axes.annotate("", end, begin, arrowprops={"arrowstyle": "->", "color": "black"})
    axes.text(*(np.add(end, begin) / 2 + (0.15, -0.15)), f"{name} of the tip", ha="left", va="top")
axes.text(tip[0] - 0.1, tip[1] - 0.1, "tip", ha="right", va="top")
for end, label in (((1.0, 0.0), "x"), ((0.0, 1.0), "z")):
    axes.annotate(
        "", (-1.9 + end[0], end[1]), (-1.9, 0.0), arrowprops={"arrowstyle": "->", "color": "black", "lw": 1.5}
    )
    axes.text(-1.9 + 1.1 * end[0], 1.1 * end[1], label, ha="center", va="center")
axes.text(-1.9, -0.15, "world; y points\ninto the page", va="top", fontsize=8)
axes.set(aspect="equal", xlim=(-2.2, 9.0), ylim=(-1.3, 5.6))
axes.set_axis_off()
figure.savefig(Path(sys.argv[1]), bbox_inches="tight", metadata={"Date": None})
