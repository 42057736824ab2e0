"""Serial robots: joint corrections, forward and inverse kinematics.

A robot is a chain of joints, each with an origin as in a URDF: joint i rotates about, or translates
along, its axis in a frame at its origin after joint i - 1. Joint positions may deviate from the
encoder readings: joints deflect under gravity, and an eccentric encoder has an error once per turn.

A joint can follow another one, as `mimic` of a URDF states: q_i = multiplier q_j + offset. The
parallel linkage of a palletiser is an example. Such a joint needs no separate reading.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_chain import (
    ChainPoses,
    SerialChain,
    chain_from_frames,
    chain_poses,
    chain_poses_and_derivatives,
    joint_axes,
)

GRAVITY = (0.0, 0.0, -9.81)
"""Gravity of an upright robot in its base frame [m/s^2]."""

_AXIS_TOLERANCE = 1e-12  # tolerance for an axis that is parallel to a coordinate axis
_MIN_TORQUE = 1e-5  # N m per kilogram: rounding


class Mimic(NamedTuple):
    """Coupling of a joint: its position is `multiplier` times that of `joint` plus `offset`.

    `offset` is in [rad] or [m] of the joint that follows.
    """

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class RobotJoint:
    """One joint of a robot.

    Attributes:
        name: name in the robot's file.
        kind: `revolute` or `prismatic`.
        origin: (4, 4) transform from the frame after the preceding joint to this joint's frame [m].
        axis: (3,) unit vector of the joint axis in this joint's frame.
        mimic: coupling to another joint of the robot that this joint follows, or None.
    """

    name: str
    kind: Literal["revolute", "prismatic"]
    origin: np.ndarray
    axis: np.ndarray
    mimic: Mimic | None = None


@dataclass(frozen=True)
class SerialRobot:
    """A serial robot with a ball at its end, whose position a calibration measures.

    Attributes:
        name: name of the robot.
        joints: joints, starting at the base.
        tool: (4, 4) frame of the ball after the last joint [m].
        gravity: (3,) gravity in the base frame [m/s^2].
        corrections: parameters of joint corrections by name, [rad s^2/m^2] or [rad], as defined in
            `correction_names`.
        source: file that it was read from.
    """

    name: str
    joints: tuple[RobotJoint, ...]
    tool: np.ndarray
    gravity: np.ndarray = field(default_factory=lambda: np.array(GRAVITY))
    corrections: Mapping[str, float] = field(default_factory=dict)
    source: str = ""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(joint.name for joint in self.joints)

    @property
    def independent_joint_names(self) -> tuple[str, ...]:
        """Names of the joints that follow no other joint."""
        return tuple(joint.name for joint in self.joints if joint.mimic is None)


class JointCoupling(NamedTuple):
    """Affine map from the k independent joints of a robot to all its n joints.

    `matrix` is (n, k); `offset` is (n,) in [rad] or [m].
    """

    matrix: np.ndarray
    offset: np.ndarray


def build_joint_coupling(robot: SerialRobot) -> JointCoupling:
    """Build the map from the independent joints of a robot to all joints, which may follow others.

    Raises:
        InputError: a joint follows a joint that the robot does not have, or follows itself.
    """
    joints = {joint.name: joint for joint in robot.joints}
    column = {name: k for k, name in enumerate(robot.independent_joint_names)}
    matrix, offset = np.zeros((len(joints), len(column))), np.zeros(len(joints))
    for i, joint in enumerate(robot.joints):
        at, factor = joint, 1.0
        followed: list[str] = []
        while at.mimic is not None:
            followed.append(at.name)
            source = joints.get(at.mimic.joint)
            if source is None:
                message = f"joint {at.name} mimics joint {at.mimic.joint!r}, which does not move the ball"
                raise InputError(robot.source or robot.name, f"{message}; name a moving joint between base and ball")
            if source.name in followed:
                raise InputError(robot.source or robot.name, f"joint {joint.name} mimics itself")
            offset[i] += factor * at.mimic.offset
            at, factor = source, factor * at.mimic.multiplier
        matrix[i, column[at.name]] = factor
    return JointCoupling(matrix, offset)


def expand_mimic_joints(robot: SerialRobot, readings: np.ndarray) -> np.ndarray:
    """Return the positions of all joints from readings, which may omit the joints that follow others.

    Args:
        robot: the robot.
        readings: (m, n) readings of all n joints, which are returned as they are, or (m, k) of the
            independent ones [rad] or [m].

    Returns:
        (m, n) positions.

    Raises:
        ValueError: the readings have neither n nor k columns.
    """
    count = readings.shape[1]
    if count == len(robot.joints):
        return readings
    if count != len(robot.independent_joint_names):
        raise ValueError(f"{count} columns, but {robot.name} has {len(robot.joints)} joints")
    coupling = build_joint_coupling(robot)
    return readings @ coupling.matrix.T + coupling.offset


def robot_chain(robot: SerialRobot) -> SerialChain:
    """Build a robot's kinematic chain for calibration.

    Its parameters are six small errors in front of every joint, and the position of the ball at the
    robot's end, which a calibration measures.

    Args:
        robot: robot with joints along any axes.

    Returns:
        The chain; every joint rotates about or translates along z of its frame, so that `rz.JOINT`
        is the offset of a revolute joint's angle. `x.tool`, `y.tool`, `z.tool` are the ball
        position.
    """
    frames, back = [], np.eye(4)
    for joint in robot.joints:
        turn = np.eye(4)
        turn[:3, :3] = _rotation_from_z(joint.axis)
        frames.append(back @ joint.origin @ turn)
        back = turn.T
    # The ball position is a parameter, so the last frame has no translation.
    end = back.copy()
    tool = robot.tool
    frames.append(end)
    kinds = ["rz" if joint.kind == "revolute" else "tz" for joint in robot.joints]
    return chain_from_frames(frames, kinds, robot.joint_names, tool[:3, 3])  # type: ignore[arg-type]


def apply_calibrated_parameters(
    robot: SerialRobot, values: Mapping[str, float], corrections: Mapping[str, float]
) -> SerialRobot:
    """Return a robot whose joint origins and ball position include calibrated parameters.

    Args:
        robot: the robot that was calibrated.
        values: parameters of `robot_chain` by name.
        corrections: joint corrections by name.

    Returns:
        The robot. Its own chain with zero errors has the same poses as the chain of `robot` with
        `values`.
    """
    joints = []
    for joint in robot.joints:
        turn = _rotation_from_z(joint.axis)
        shift = np.array([values[f"t{c}.{joint.name}"] for c in "xyz"])
        rotation = np.linalg.multi_dot([_axis_rotation(c, values[f"r{c}.{joint.name}"]) for c in "xyz"])
        error = np.eye(4)
        error[:3, :3] = turn @ rotation @ turn.T
        error[:3, 3] = turn @ shift
        joints.append(replace(joint, origin=joint.origin @ error))
    tool = robot.tool.copy()
    tool[:3, 3] = [values[f"{c}.tool"] for c in "xyz"]
    return replace(robot, joints=tuple(joints), tool=tool, corrections=dict(corrections))


def correction_names(robot: SerialRobot, gravity: bool, eccentricity: bool) -> tuple[str, ...]:
    """Return the names of a robot's joint corrections: deflection under gravity, encoder eccentricity.

    Args:
        robot: the robot.
        gravity: include deflections under gravity of each revolute joint. `sag.JOINT.PLACE` is the
            compliance of JOINT times a mass at PLACE [rad s^2/m^2]. PLACE is a joint farther out,
            or the ball (`tool`).
        eccentricity: include `sine.JOINT` and `cosine.JOINT`, the amplitudes of the encoder error
            once per turn of each revolute joint [rad].

    Returns:
        The names. If masses at several places cause the same torque on a joint, only the outermost
        is included. Places at which a mass causes no torque are not included.
    """
    names: list[str] = []
    if gravity:
        posed = np.random.default_rng(0).uniform(-1.0, 1.0, (5, len(robot.joints)))
        chain = robot_chain(robot)
        points, ways = joint_axes(chain, posed)
        places = np.concatenate([points, chain_poses(chain, posed).position[:, None]], axis=1)
        for i, joint in enumerate(robot.joints):
            if joint.kind != "revolute":
                continue
            seen: list[np.ndarray] = []
            for j in range(len(robot.joints), i, -1):
                weight = np.cross(places[:, j] - points[:, i], robot.gravity)
                torque = np.sum(ways[:, i] * weight, axis=1)
                if np.abs(torque).max() < _MIN_TORQUE or any(
                    np.abs(torque - other).max() < _MIN_TORQUE for other in seen
                ):
                    continue
                seen.append(torque)
                place = "tool" if j == len(robot.joints) else robot.joints[j].name
                names.append(f"sag.{joint.name}.{place}")
    if eccentricity:
        turning = [joint.name for joint in robot.joints if joint.kind == "revolute"]
        names += [f"{kind}.{name}" for name in turning for kind in ("sine", "cosine")]
    return tuple(names)


def correction_derivatives(robot: SerialRobot, joints: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Compute how far joints deviate from their encoder readings per unit of each joint correction.

    Under gravity g, a mass m at r rotates a joint of compliance c at o, with axis u, by
    c m u . (r - o) x g. An eccentric encoder errs by the sine and cosine of the reading.

    Args:
        robot: the robot; nominal geometry is sufficient.
        joints: (n, k) encoder readings [rad] or [m].
        names: names of the e parameters, as from `correction_names`.

    Returns:
        (n, k, e) derivatives of the joints' deviations.

    Raises:
        ValueError: a parameter name has an unknown joint or kind.
    """
    made = np.zeros((len(joints), len(robot.joints), len(names)))
    if not names:
        return made
    chain = robot_chain(robot)
    points, ways = joint_axes(chain, joints)
    places = np.concatenate([points, chain_poses(chain, joints).position[:, None]], axis=1)
    order = {name: k for k, name in enumerate((*robot.joint_names, "tool"))}
    for e, name in enumerate(names):
        kind, _, rest = name.partition(".")
        joint = next((n for n in robot.joint_names if rest == n or rest.startswith(f"{n}.")), None)
        if joint is None or kind not in ("sag", "sine", "cosine"):
            raise ValueError(f"{name!r} is not a joint correction of {robot.name}")
        i = order[joint]
        if kind == "sag":
            place = rest.removeprefix(f"{joint}.")
            if place not in order:
                raise ValueError(f"{name!r}: {robot.name} has no place {place!r}")
            weight = np.cross(places[:, order[place]] - points[:, i], robot.gravity)
            made[:, i, e] = np.sum(ways[:, i] * weight, axis=1)
        else:
            made[:, i, e] = (np.sin if kind == "sine" else np.cos)(joints[:, i])
    return made


def compute_ball_poses(robot: SerialRobot, joints: np.ndarray) -> ChainPoses:
    """Compute the poses of the ball at the robot's end from encoder readings, with joint corrections.

    The corrections are the joint deflection under gravity and the encoder eccentricity of the
    robot.

    Args:
        robot: nominal or calibrated robot.
        joints: (n, k) encoder readings [rad] or [m].

    Returns:
        n poses of the ball in the base frame.
    """
    return chain_poses(robot_chain(robot), _apply_corrections(robot, np.asarray(joints, float)))


class PositionSolution(NamedTuple):
    """Encoder readings (n, k) that bring the ball to n positions, and the remaining distances (n,) [m]."""

    joints: np.ndarray
    remaining_distance: np.ndarray


def solve_joints_for_ball(
    robot: SerialRobot, ball_positions: np.ndarray, start: np.ndarray, iterations: int = 50,
    idle: int | None = None,
) -> PositionSolution:  # fmt: skip
    """Compute encoder readings that bring the ball at the robot's end to given positions.

    The method is damped least squares: every step is a damped minimum-norm step with the robot's
    Jacobian, and the damping vanishes with the remaining distance.

    Args:
        robot: nominal or calibrated robot.
        ball_positions: (n, 3) ball positions in the base frame [m].
        start: (n, k) joint positions at which the iteration starts [rad] or [m]. Joints that follow
            others are computed from these others.
        iterations: maximum number of steps; convergence is not checked.
        idle: column of a joint that keeps its start position, or None.

    Returns:
        (n, k) encoder readings [rad] or [m], and (n,) remaining distances to the ball positions
        [m].

    Source: Wampler 1986 (damped least squares).
    """
    chain, coupling = robot_chain(robot), build_joint_coupling(robot)
    independent = [joint.mimic is None for joint in robot.joints]
    joints = expand_mimic_joints(robot, np.asarray(start, float)[:, independent])
    motion = coupling.matrix
    if idle is not None:
        motion = motion * (motion[idle] == 0.0)
    gap = np.zeros_like(ball_positions)
    for _ in range(iterations + 1):
        found = chain_poses_and_derivatives(chain, _apply_corrections(robot, joints))
        gap = ball_positions - found.position
        size = np.sum(gap**2, axis=1)
        if size.max(initial=0.0) < 1e-24:
            break
        rates = found.position_by_joint @ motion
        square = rates @ np.swapaxes(rates, 1, 2) + (1e-3 * size)[:, None, None] * np.eye(3)
        step = np.swapaxes(rates, 1, 2) @ np.linalg.solve(square, gap[:, :, None])
        joints = joints + step[:, :, 0] @ motion.T
    return PositionSolution(joints, np.linalg.norm(gap, axis=1))


def _apply_corrections(robot: SerialRobot, joints: np.ndarray) -> np.ndarray:
    names = tuple(robot.corrections)
    if not names:
        return joints
    return joints + correction_derivatives(robot, joints, names) @ np.array(list(robot.corrections.values()))


def frame_from_rpy(position: Sequence[float], rpy: Sequence[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Build the transform (4, 4) with a position [m] and roll, pitch and yaw angles [rad].

    The rotation is Rz(yaw) Ry(pitch) Rx(roll).
    """
    made = np.eye(4)
    made[:3, :3] = _axis_rotation("z", rpy[2]) @ _axis_rotation("y", rpy[1]) @ _axis_rotation("x", rpy[0])
    made[:3, 3] = position
    return made


def rotation_to_rpy(rotation: np.ndarray) -> np.ndarray:
    """Convert a rotation (3, 3) to roll, pitch and yaw angles [rad]; yaw is 0 if the pitch is +-pi/2."""
    sine = -rotation[2, 0]
    cosine = math.hypot(rotation[2, 1], rotation[2, 2])
    pitch = math.atan2(sine, cosine)
    if cosine > _AXIS_TOLERANCE:
        roll = math.atan2(rotation[2, 1], rotation[2, 2])
        return np.array([roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])])
    return np.array([math.copysign(1.0, sine) * math.atan2(rotation[0, 1], rotation[1, 1]),
                     pitch, 0.0])  # fmt: skip


def _axis_rotation(axis: str, angle: float) -> np.ndarray:
    cosine, sine = math.cos(angle), math.sin(angle)
    made = np.eye(3)
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    made[[first, second], [first, second]] = cosine
    made[second, first], made[first, second] = sine, -sine
    return made


def _rotation_from_z(axis: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) that takes z to a unit vector `axis`; half a turn about x for -z."""
    x, y, z = axis
    if z < -1.0 + _AXIS_TOLERANCE:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.eye(3) + skew + skew @ skew / (1.0 + z)
