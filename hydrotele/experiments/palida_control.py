"""Path tracking of PaLiDA in MuJoCo: circles and squares, drive controllers with feedforward, and tracking errors."""

from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.core.files import models_folder
from hydrotele.experiments.palida import HOME_POSE, LENGTH_NOISE, SAMPLE_RATE, load_robot
from hydrotele.multibody.chain import cardan_angles
from hydrotele.multibody.closed_chain_kinematics import solve_joint_positions

# Control: one PID controller per drive, and feedforward of a model's forces along the reference.
DRIVE_MASS, BANDWIDTH, DAMPING_RATIO = 4.0, 12.0, 0.8  # mean mass per drive [kg], [Hz], [1]
INTEGRAL_RATE = 3.0  # integral over proportional gain [1/s]
_ACCELERATION_TIME = 1.0  # time to reach full speed on a circle [s]


def compute_control_gains() -> tuple[float, float]:
    """Return the proportional gain [N/m] and the damping gain [N s/m], equal for the controllers of all drives."""
    turn = 2.0 * np.pi * BANDWIDTH
    return DRIVE_MASS * turn**2, 2.0 * DAMPING_RATIO * DRIVE_MASS * turn


def plan_circle(speed: float, radius: float = 0.10, laps: float = 2.0) -> np.ndarray:
    """Plan a horizontal circle about the home pose, starting from rest.

    Args:
        speed: tool speed [m/s].
        radius: radius [m].
        laps: number of laps at full speed.

    Returns:
        (3, n, 6) poses, rates and accelerations of the platform at 1 kHz. The tool reaches full speed
        after 1 s.
    """
    turn = speed / radius
    time = np.arange(0.0, _ACCELERATION_TIME + laps * 2.0 * np.pi / turn, 1.0 / SAMPLE_RATE)
    r = np.clip(time / _ACCELERATION_TIME, 0.0, 1.0)  # the speed rises as 10 r^3 - 15 r^4 + 6 r^5
    faded = _ACCELERATION_TIME * (2.5 * r**4 - 3.0 * r**5 + r**6)
    angle = turn * (faded + np.maximum(time - _ACCELERATION_TIME, 0.0))
    return _build_planar_motion(radius * np.cos(angle), radius * np.sin(angle))


def plan_square(speed: float, side: float = 0.16, laps: float = 2.0) -> np.ndarray:
    """Plan a horizontal square about the home pose, with a stop at each corner.

    The path along a side is a quintic polynomial of time, whose largest speed is 15/8 of the mean.

    Args:
        speed: tool speed in the middle of a side [m/s].
        side: side length [m].
        laps: number of laps.

    Returns:
        (3, n, 6) poses, rates and accelerations of the platform at 1 kHz.
    """
    span = 15.0 / 8.0 * side / speed
    time = np.arange(0.0, 4.0 * laps * span, 1.0 / SAMPLE_RATE)
    place = time / span
    corner = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * 0.5 * side
    at = place.astype(int)
    s = place - at
    share = (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5)[:, None]
    path = corner[at % 4] + share * (corner[(at + 1) % 4] - corner[at % 4])
    return _build_planar_motion(path[:, 0], path[:, 1])


def _build_planar_motion(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    pose = np.tile(HOME_POSE, (len(x), 1))
    pose[:, 0] += x
    pose[:, 1] += y
    rate = np.gradient(pose, 1.0 / SAMPLE_RATE, axis=0)
    return np.stack([pose, rate, np.gradient(rate, 1.0 / SAMPLE_RATE, axis=0)])


class TrackingErrors(NamedTuple):
    """Tracking errors of PaLiDA along a path, in n rows at 1 kHz.

    Attributes:
        time: (n,) time [s].
        error: (n, 6) reference minus true leg length [m].
        pose_error: (n, 6) reference minus true pose of the platform [m], [rad].
        warnings: number of MuJoCo warnings during the simulation.
    """

    time: np.ndarray
    error: np.ndarray
    pose_error: np.ndarray
    warnings: int


def track_path(motion: np.ndarray, feedforward: np.ndarray | None, seed: int = 0) -> TrackingErrors:
    """Simulate how PaLiDA tracks a path, in MuJoCo with closed chains, friction and encoder noise.

    Each drive has a PID controller of its leg length. The feedforward model adds the drive forces along
    the reference.

    Args:
        motion: (3, n, 6) poses, rates and accelerations of the reference.
        feedforward: (24,) parameters of the feedforward model; None for no feedforward.
        seed: seed of the encoder noise.

    Returns:
        Tracking errors of legs and pose.

    Source: Abdellatif 2008, section 5.4.
    """
    own, rng = load_robot(), np.random.default_rng(seed)
    chain = own.setup.chain
    model = mujoco.MjModel.from_xml_path(str(models_folder() / "palida" / "palida.xml"))
    data = mujoco.MjData(model)
    q = solve_joint_positions(chain, own.setup.given_joints, motion[0])
    drives = [chain.index(name) for name in chain.drives]
    reference = q[:, drives]
    rate = np.gradient(reference, 1.0 / SAMPLE_RATE, axis=0)
    model_force = np.zeros_like(reference)
    if feedforward is not None:
        model_force = own.matrix(motion) @ feedforward
    here = chain.qpos_indices >= 0
    data.qpos[chain.qpos_indices[here]] = q[0, here]
    place = model.joint("platform").qposadr[0]
    data.qpos[place : place + 3] = motion[0, 0, :3]
    data.qpos[place + 3 : place + 7] = _convert_cardan_to_quaternion(motion[0, 0, 3:])
    stiff, damp = compute_control_gains()
    held = own.matrix(np.stack([motion[0, :1], 0 * motion[1, :1], 0 * motion[2, :1]]))[0] @ own.truth
    if feedforward is not None:
        held = held - model_force[0]  # the integral part holds the robot where it starts
    slides = chain.qpos_indices[drives]
    steps = round(1.0 / SAMPLE_RATE / model.opt.timestep)
    error, pose_error = np.empty_like(reference), np.empty_like(reference)
    last, speed = None, np.zeros(6)
    for row in range(len(reference)):
        true = data.qpos[slides]
        error[row] = reference[row] - true
        pose_error[row] = motion[0, row] - _convert_qpos_to_pose(data.qpos[place : place + 7])
        reading = true + LENGTH_NOISE * rng.standard_normal(6)
        if last is not None:  # first-order low-pass at 100 Hz of the differences
            speed += (1.0 - np.exp(-2.0 * np.pi * 100.0 / SAMPLE_RATE)) * (
                (reading - last) * SAMPLE_RATE - speed)  # fmt: skip
        last = reading
        away = reference[row] - reading
        held = held + stiff * INTEGRAL_RATE * away / SAMPLE_RATE
        data.ctrl[:] = stiff * away + damp * (rate[row] - speed) + held + model_force[row]
        mujoco.mj_step(model, data, steps)
    time = np.arange(len(reference)) / SAMPLE_RATE
    return TrackingErrors(time, error, pose_error, int(sum(w.number for w in data.warning)))


def _convert_cardan_to_quaternion(angles: np.ndarray) -> np.ndarray:
    out, one = np.array([1.0, 0.0, 0.0, 0.0]), np.empty(4)
    for axis, angle in zip(np.eye(3), angles, strict=True):
        mujoco.mju_axisAngle2Quat(one, axis, angle)
        mujoco.mju_mulQuat(out, out.copy(), one)
    return out


def _convert_qpos_to_pose(qpos: np.ndarray) -> np.ndarray:
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, qpos[3:])
    return np.concatenate([qpos[:3], cardan_angles(turn.reshape(3, 3))])
