"""Predict the readings of IMUs on the links of an open kinematic chain from its joint motion.

All functions accept complex arguments, so that derivatives follow from complex steps.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Joint, Machine, find_dependent_joints
from hydrotele.machine.sensors import MountedSensor


class ChainLink(NamedTuple):
    """A link of the chain: its parent (-1 for the fixed frame), position in it [m], and its joint.

    `axis` is the index of the machine axis that moves the joint, -1 for a fixed link.
    """

    parent: int
    position: np.ndarray
    joint: Joint | None
    axis: int


class ImuChain(NamedTuple):
    """Links between the fixed frame and the IMUs of a machine; parents come first.

    Attributes:
        axes: names of the machine axes whose joints move the IMUs.
        links: the links.
        imus: names of the IMUs.
        sensors: IMUs in the order of the names.
        imu_links: index of the link of each IMU in `links`, -1 for the fixed frame.
        gravity: (3,) gravity in the fixed frame [m/s^2].
    """

    axes: tuple[str, ...]
    links: tuple[ChainLink, ...]
    imus: tuple[str, ...]
    sensors: tuple[MountedSensor, ...]
    imu_links: tuple[int, ...]
    gravity: np.ndarray


def build_imu_chain(machine: Machine, sensors: Mapping[str, MountedSensor], measured: Sequence[str]) -> ImuChain:
    """Return the chain of links that carry the IMUs of a machine.

    Args:
        machine: the machine.
        sensors: mounted sensors by name; those other than IMUs are ignored.
        measured: axes whose joint position the logs contain.

    Raises:
        InputError: there is no IMU, an IMU is behind a joint without a drive, or the motion of an
            axis between two IMUs is not observable, because its link has neither an IMU nor a joint sensor.
    """
    imus = {name: sensor for name, sensor in sensors.items() if sensor.type == "imu"}
    if not imus:
        raise InputError(
            f"machine {machine.name}", "has no IMU: add sensors.SET.mounted entries of type imu with link and position"
        )
    names: list[str] = []
    for sensor in imus.values():
        path = []
        link = sensor.link
        while link != "world":
            path.append(link)
            link = machine.links[link].parent
        names += [name for name in reversed(path) if name not in names]
    axis_of = {axis.joint: name for name, axis in machine.axes.items()}
    dependent = find_dependent_joints(machine)
    axes: list[str] = []
    links = []
    for name in names:
        facts = machine.links[name]
        if facts.joint and facts.joint.name not in axis_of:
            reason = "a closed loop moves it" if facts.joint.name in dependent else "its joint has no drive"
            carried = next(n for n, s in imus.items() if name == s.link or facts.joint)
            message = f"IMU {carried} is on link {name} or beyond; {reason}. Mount it on a link that an axis moves"
            raise InputError(f"machine {machine.name}", message)
        place = -1
        if facts.joint:
            place = len(axes)
            axes.append(axis_of[facts.joint.name])
        parent = -1 if facts.parent == "world" else names.index(facts.parent)
        links.append(ChainLink(parent, np.array(facts.position), facts.joint, place))
    for name, link in zip(names, links, strict=True):
        if link.axis >= 0 and axes[link.axis] not in measured:
            rigid = {name} | {n for n, other in zip(names, links, strict=True)
                              if other.joint is None and other.parent >= 0 and names[other.parent] == name}  # fmt: skip
            if not any(sensor.link in rigid for sensor in imus.values()):
                message = f"axis {axes[link.axis]} has neither an IMU on link {name} nor a joint sensor in the logs"
                raise InputError(f"machine {machine.name}", f"{message}: its angle is not observable")
    return ImuChain(
        tuple(axes), tuple(links), tuple(imus), tuple(imus.values()),
        tuple(-1 if s.link == "world" else names.index(s.link) for s in imus.values()), np.array(machine.gravity),
    )  # fmt: skip


def predict_imu_readings(chain: ImuChain, motion: np.ndarray, mounting: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Predict the readings of the IMUs without gyro bias.

    Args:
        chain: the chain with a axes and s IMUs.
        motion: (3, a, n) joint positions [rad] or [m], velocities and accelerations.
        mounting: (s, 9) rotation of each IMU relative to its stated rotation, as modified Rodrigues
            parameters times 4 (a rotation vector [rad] if small), accelerometer bias [m/s^2], and
            position relative to the stated one [m].
        tilt: (2,) rotation of the machine about the world's x and y axes [rad]; 0 if it is level.

    Returns:
        (s, 6, n) angular rates [rad/s] and specific forces [m/s^2] in the axes of the IMUs.

    Source: kinematics of a rigid body in a rotating frame, e.g. Featherstone 2008, Rigid Body Dynamics Algorithms.
    """
    count = motion.shape[2]
    zero = np.zeros((3, count), dtype=motion.dtype)
    up = rotation_from_parameters(np.array([tilt[0], tilt[1], 0.0 * tilt[0]])).T @ -chain.gravity
    still = (zero, zero, zero + up[:, None])
    states = []
    for link in chain.links:
        rate, acceleration, force = states[link.parent] if link.parent >= 0 else still
        position = link.position[:, None] + zero
        joint = link.joint
        if joint and link.axis >= 0 and joint.type == "slide":
            position = position + np.array(joint.axis)[:, None] * motion[0, link.axis]
        force = force + _cross(acceleration, position) + _cross(rate, _cross(rate, position))
        if joint and link.axis >= 0:
            axis = np.array(joint.axis)[:, None]
            q, speed, change = motion[:, link.axis]
            if joint.type == "slide":
                force = force + axis * change + 2.0 * _cross(rate, axis * speed)
            else:
                rate, acceleration, force = (_rotate_back(axis, q, v) for v in (rate, acceleration, force))
                acceleration = acceleration + axis * change + _cross(rate, axis * speed)
                rate = rate + axis * speed
        states.append((rate, acceleration, force))
    readings = []
    for sensor, place, values in zip(chain.sensors, chain.imu_links, mounting, strict=True):
        rate, acceleration, force = states[place] if place >= 0 else still
        arm = (np.array(sensor.position) + values[6:])[:, None]
        force = force + _cross(acceleration, arm) + _cross(rate, _cross(rate, arm))
        axes = (Rotation.from_rotvec(sensor.rotation).as_matrix() @ rotation_from_parameters(values[:3])).T
        readings.append(np.concatenate([axes @ rate, axes @ force + values[3:6, None]]))
    return np.array(readings)


def rotation_from_parameters(values: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of modified Rodrigues parameters times 4: 4 tan(angle / 4) along the axis.

    For small angles they are the rotation vector [rad]. Complex values are allowed.

    Source: Shuster 1993, A Survey of Attitude Representations, J. Astronaut. Sci. 41(4), Eq. 253.

    >>> bool(np.allclose(rotation_from_parameters(np.array([0.0, 0.0, 4 * np.tan(np.pi / 8)])),
    ...                  [[0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    True
    """
    x, y, z = 0.25 * values
    square = x * x + y * y + z * z
    cross = np.array([[0.0 * x, -z, y], [z, 0.0 * x, -x], [-y, x, 0.0 * x]])
    return np.eye(3) + (8.0 * cross @ cross + 4.0 * (1.0 - square) * cross) / (1.0 + square) ** 2


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product of vectors (3, n), which may be broadcast."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _rotate_back(axis: np.ndarray, angle: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return vectors (3, n) of the parent frame in the frame rotated by angles (n,) about an axis (3, 1)."""
    along = axis * np.sum(axis * vectors, axis=0)
    return along + np.cos(angle) * (vectors - along) - np.sin(angle) * _cross(axis, vectors)
