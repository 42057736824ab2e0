"""Compare frequency responses of linear models with those of the MuJoCo simulator; print a table.

    python tools/validation/linear_model.py cat215 --pose boom=0.45,stick=-1.6 --pose boom=0,stick=-1 \
        --pose boom=0.8,stick=-2.3

A command is a constant plus a small periodic multisine, held for 1 ms. After the settling time two
periods are transformed with a Hann window. The response is half the difference of two runs with opposite multisines,
which removes drift and even harmonics. The error is |simulator - linear| / |linear| at every
frequency, for the rate of the axis and for its chamber pressures.

Two operating points: all axes at `--speed` on the machine without dry friction and dead bands,
which holds the pose; and the swing at 0.2 rad/s on the complete machine, whose other axes hold the
load with closed valves. Their leakage moves the arm, so that the model is that of the mean pose.
"""

import argparse

import mujoco
import numpy as np

from hydrotele.cli.linearise_command import parse_assignments
from hydrotele.estimate.linear_model import LinearModel, linearise, remove_dry_friction
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.plant import build_plant, initial_state
from hydrotele.simulate.record import start_leapfrog

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("machine")
parser.add_argument("--tool")
parser.add_argument("--pose", action="append", default=[], help="joint=value,...; repeatable")
parser.add_argument("--speed", type=float, default=1e-6, help="[rad/s]")
parser.add_argument("--amplitude", type=float, default=1e-7, help="of every line of the multisine [1]")
parser.add_argument("--settle", type=float, default=30.0, help="[s]")
parser.add_argument("--period", type=float, default=5.0, help="of the multisine [s]")
parser.add_argument("--step", type=float, default=0.125e-3, help="physics step [s]")
arguments = parser.parse_args()

SWING_SPEED, SWING_SETTLE = 0.2, 5.0  # rad/s, s
MAX_FREQUENCY = 20.0  # Hz
PERIODS = 2  # of the multisine that are transformed; with a Hann window its lines do not mix
HOLD = 1.0e-3  # s
rng = np.random.default_rng(1)
lines = np.arange(1, int(MAX_FREQUENCY * arguments.period) + 1)
frequencies = lines / arguments.period
phases = rng.uniform(0.0, 2.0 * np.pi, len(lines))
time = HOLD * np.arange(round((arguments.settle + PERIODS * arguments.period) / HOLD))
multisine = arguments.amplitude * np.cos(2.0 * np.pi * np.outer(time, frequencies) + phases).sum(axis=1)
kept = round(PERIODS * arguments.period / HOLD)


def transform(values: np.ndarray) -> np.ndarray:
    """Return the Fourier coefficients of the last periods at the lines of the multisine."""
    return np.fft.rfft(np.hanning(kept + 1)[:-1] * values[-kept:])[PERIODS * lines]


def simulate(machine: Machine, model: LinearModel, axis: str, given: np.ndarray) -> tuple[dict, dict]:
    """Return rate and pressures of an axis, and the mean pose; `given` is added to the command of the axis."""
    plant = build_plant(machine, arguments.step, ground=False)
    z = dict(zip(model.states, model.operating_state, strict=True))
    kinds = ("spool", "spool_rate", "pressure_head", "pressure_rod")
    joints = [machine.axes[name].joint for name in plant.axes]
    state = {
        "order": plant.axes,
        "angle": [z[f"position.{joint}"] for joint in joints],
        "velocity": [z[f"rate.{joint}"] for joint in joints],
        "joints": {name[9:]: value for name, value in z.items() if name.startswith("position.")},
        **{kind: [z.get(f"{kind}.{name}", 0.0) for name in plant.axes] for kind in kinds},
    }
    data = initial_state(plant, state)
    start_leapfrog(plant.model, data)
    constant = model.operating_input[: len(plant.axes)]
    i = plant.axes.index(axis)
    rows, steps = len(given), round(HOLD / arguments.step)
    out = np.zeros((rows, 3))
    poses = np.zeros((rows, len(plant.axes)))
    for row in range(rows):
        data.ctrl[:] = constant
        data.ctrl[i] += given[row]
        out[row] = data.qvel[plant.dof[i]], *data.act[4 * i + 2 : 4 * i + 4]
        poses[row] = data.qpos[plant.qpos]
        mujoco.mj_step(plant.model, data, steps)
    mean_pose = dict(zip(joints, poses[-kept:].mean(axis=0), strict=True))
    return dict(
        zip((f"velocity.{axis}", f"pressure_head.{axis}", f"pressure_rod.{axis}"), out.T, strict=True)
    ), mean_pose


def compare(machine: Machine, model: LinearModel, axis: str, settle: float, where: str) -> None:
    """Print the errors of a linear model in the responses to the command of an axis."""
    shown = multisine[-kept - round(settle / HOLD) :]
    (first, mean_pose), (second, _) = (simulate(machine, model, axis, sign * shown) for sign in (1.0, -1.0))
    if any(model.speed[name] == 0.0 for name in machine.valve_axes):
        model = linearise(machine, {"swing": 0.0, **{k: v for k, v in mean_pose.items() if k != "swing"}}, model.speed)
    given = transform(multisine)
    w = 2.0 * np.pi * frequencies
    held = (1.0 - np.exp(-1j * w * HOLD)) / (1j * w * HOLD)  # the command is held for 1 ms
    for channel in first:
        simulated = transform(0.5 * (first[channel] - second[channel])) / given
        if channel.startswith("velocity"):  # MuJoCo's velocities are half a step later
            simulated *= np.exp(-1j * w * 0.5 * arguments.step)
        linear = model.frequency_response(frequencies, [f"command.{axis}"], [channel])[:, 0, 0] * held
        error = np.abs(simulated - linear) / np.abs(linear)
        worst = int(error.argmax())
        peak = int(np.abs(linear).argmax())
        print(
            f"| {where} | {axis} | {channel.split('.')[0]} | {100 * np.median(error):.3f} | {100 * error[worst]:.2f} |"
            f" {frequencies[worst]:.1f} | {frequencies[peak]:.1f} |",
            flush=True,
        )


machine = load_machine(arguments.machine, arguments.tool)
valves = list(machine.valve_axes)
smooth = remove_dry_friction(machine, list(machine.axes))
print("| pose | axis | output | median error [%] | largest error [%] | at [Hz] | peak at [Hz] |")
print("| --- | --- | --- | ---: | ---: | ---: | ---: |")
for text in arguments.pose or [""]:
    pose = parse_assignments("--pose", text) if text else {}
    held = linearise(smooth, pose, arguments.speed)
    for axis in valves:
        compare(smooth, held, axis, arguments.settle, text or "home")
    if "swing" in machine.axes:
        turning = linearise(machine, pose, {"swing": SWING_SPEED})
        compare(machine, turning, "swing", SWING_SETTLE, f"{text or 'home'}, swing {SWING_SPEED} rad/s")
