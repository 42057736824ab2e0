"""Compute the poses of all bodies from a log, for 3D views."""

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
from pydantic import TypeAdapter

from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine
from hydrotele.scenario.surrounding_objects import SurroundingObject, read_soil_from_log
from hydrotele.simulate.closed_loops import close_along_motion, dependent_joints
from hydrotele.simulate.surroundings import object_joints

_OBJECTS_ADAPTER = TypeAdapter(list[SurroundingObject])


class Poses(NamedTuple):
    """World poses of all bodies at n times.

    Attributes:
        bodies: names of the nbody bodies; the world is the first.
        position: (n, nbody, 3) [m].
        quaternion: (n, nbody, 4), w x y z.
    """

    bodies: tuple[str, ...]
    position: np.ndarray
    quaternion: np.ndarray


def extract_joint_motion(machine: Machine, log: Log) -> dict[str, np.ndarray]:
    """Return the logged motion of the joints of a machine that no closed loop determines.

    Measured channels are preferred. True channels are used for joints without a sensor, such as a
    hanging grapple. Missing values are replaced by the last known value. Joints that are not logged
    are omitted.

    Args:
        machine: the machine.
        log: log of the machine.

    Returns:
        {joint name: (n,) angle [rad] or position [m]}.
    """
    following = dependent_joints(machine)
    axis_of = {axis.joint: name for name, axis in machine.axes.items()}
    found = {}
    for joint in machine.joints:
        if joint in following:
            continue
        names = [n for n in (axis_of.get(joint), joint) if n]
        candidates = [
            f"{truth}{kind}.{name}" for truth in ("", "truth.") for name in names for kind in ("angle", "position")
        ]
        if column := next((c for c in candidates if c in log), None):
            found[joint] = _repeat_last_known_value(log[column])
    return found


def _repeat_last_known_value(values: np.ndarray) -> np.ndarray:
    """Return values with missing ones (NaN) replaced by the last known value before them.

    At the start they are replaced by the first known value; if none is known, by 0.
    """
    known = np.flatnonzero(np.isfinite(values))
    if len(known) in (0, len(values)):
        return values if len(known) else np.zeros(len(values))
    latest = np.searchsorted(known, np.arange(len(values)), side="right") - 1
    return values[known[np.maximum(latest, 0)]]


def logged_surroundings(log: Log) -> tuple[SurroundingObject, ...]:
    """Return the objects around the machine from the metadata of a log.

    A log of true states contains plates, trees, tree logs and soil, other logs only the soil.
    """
    if "surroundings" in log.metadata:
        return tuple(_OBJECTS_ADAPTER.validate_json(log.metadata["surroundings"]))
    return read_soil_from_log(log)


def _write_object_positions(model: mujoco.MjModel, log: Log, rows: np.ndarray) -> None:
    """Copy the logged motion of objects around the machine into joint positions `rows` (n, nq).

    Args:
        model: model with these objects.
        log: log of true states with n rows.
        rows: (n, nq) joint positions, changed in place.
    """
    for joint, place in object_joints(model):
        name, kind = model.joint(joint).name, model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            for k, letter in enumerate("xyz"):
                rows[:, place + k] = log[f"truth.position.{name}_{letter}"]
            _write_object_quaternions(log, name, rows[:, place + 3 : place + 7])
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            _write_object_quaternions(log, name.removesuffix("_turn"), rows[:, place : place + 4])
        else:
            rows[:, place] = log[f"truth.position.{name}"]


def _write_object_quaternions(log: Log, name: str, quaternions: np.ndarray) -> None:
    turns = np.column_stack([log[f"truth.angle.{name}_r{c}"] for c in "xyz"])
    for quaternion, turn in zip(quaternions, turns, strict=True):
        quaternion[:] = (1.0, 0.0, 0.0, 0.0)
        mujoco.mju_quatIntegrate(quaternion, turn, 1.0)


def compute_joint_positions(
    machine: Machine, model: mujoco.MjModel, joints: Mapping[str, np.ndarray],
    log: Log | None = None,
) -> np.ndarray:  # fmt: skip
    """Compute the positions of all joints from those of the independent joints, by closing all loops.

    Args:
        machine: the machine.
        model: model of the machine from `compile_mechanism`.
        joints: {joint name: (n,) angles [rad] or positions [m]}; others are in the home pose.
        log: log of true states; required if the model contains surrounding objects.

    Returns:
        (n, nq) joint positions of the model.

    Raises:
        InputError: a linkage cannot be closed in at least one row.
    """
    rows = close_along_motion(machine, model, mujoco.MjData(model), joints)
    if log is not None:
        _write_object_positions(model, log, rows)
    return rows


def body_poses(
    machine: Machine, model: mujoco.MjModel, joints: Mapping[str, np.ndarray],
    log: Log | None = None,
) -> Poses:  # fmt: skip
    """Compute the world poses of all bodies along a motion, including those in closed loops.

    Args:
        machine: the machine.
        model: model of the machine from `compile_mechanism`.
        joints: {joint name: (n,) angles [rad] or positions [m]}; others are in the home pose.
        log: log of true states; required if the model contains surrounding objects.

    Returns:
        Poses with n rows; one row if no joint is given.

    Raises:
        InputError: a linkage cannot be closed in at least one row.
    """
    return poses_at_positions(model, compute_joint_positions(machine, model, joints, log))


def poses_at_positions(model: mujoco.MjModel, rows: np.ndarray) -> Poses:
    """Compute the world poses of all bodies of a model at n joint positions (n, nq)."""
    data = mujoco.MjData(model)
    position = np.empty((len(rows), model.nbody, 3))
    quaternion = np.empty((len(rows), model.nbody, 4))
    for row, qpos in enumerate(rows):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        position[row], quaternion[row] = data.xpos, data.xquat
    return Poses(body_names(model), position, quaternion)


def body_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the names of the bodies of a model; the world is the first."""
    return tuple(model.body(i).name or f"body_{i}" for i in range(model.nbody))


def point_trajectory(poses: Poses, body: str, point: tuple[float, float, float] | np.ndarray) -> np.ndarray:
    """Return the trajectory of a point that is fixed to a body.

    Args:
        poses: n poses.
        body: name of the body.
        point: (3,) position in the body frame [m].

    Returns:
        (n, 3) positions in the world frame [m].
    """
    index = poses.bodies.index(body)
    w, axis = poses.quaternion[:, index, :1], poses.quaternion[:, index, 1:]
    turned = 2.0 * np.cross(axis, point)
    return poses.position[:, index] + point + w * turned + np.cross(axis, turned)
