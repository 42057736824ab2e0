"""Serial robots: joints with origins and axes, kinematic errors, poses, inverse kinematics.

A robot is a chain of joints with an origin each, as in a URDF: joint i turns about, or slides
along, its axis in a frame that lies at its origin behind joint i - 1. Joints may deviate from what
their encoders say: they yield under gravity, and an encoder that is not centred errs once per turn.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from hydrotele.kinematics.serial_chain import (
    Poses,
    SerialChain,
    chain_from_frames,
    forward,
    forward_and_rates,
    joint_axes,
)

GRAVITY = (0.0, 0.0, -9.81)
"""Of a robot that stands upright [m/s^2]."""

_SAME = 1e-12  # by which an axis may miss a coordinate axis
_SILENT = 1e-5  # N m of a kilogram: rounding


@dataclass(frozen=True)
class RobotJoint:
    """One joint.

    Attributes:
        name: as in the robot's file.
        kind: `revolute` or `prismatic`.
        origin: (4, 4) its frame in the frame behind the joint before [m].
        axis: (3,) unit vector in that frame.
    """

    name: str
    kind: Literal["revolute", "prismatic"]
    origin: np.ndarray
    axis: np.ndarray


@dataclass(frozen=True)
class Robot:
    """A serial robot with a ball at its end.

    Attributes:
        name: of the robot.
        joints: from the base on.
        tool: (4, 4) frame of the ball behind the last joint [m].
        gravity: (3,) in the base frame [m/s^2].
        corrections: parameters of joint corrections, name -> value [rad/m] or [rad], which
            `hydrotele.calibrate.joint_corrections` explains.
        source: file it came from.
    """

    name: str
    joints: tuple[RobotJoint, ...]
    tool: np.ndarray
    gravity: np.ndarray = field(default_factory=lambda: np.array(GRAVITY))
    corrections: Mapping[str, float] = field(default_factory=dict)
    source: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(joint.name for joint in self.joints)


def robot_chain(robot: Robot) -> SerialChain:
    """The chain of a robot with six errors in front of every joint and the ball's coordinates.

    Args:
        robot: with joints along any axes.

    Returns:
        The chain; every joint turns about or slides along z of its frame, so that `rz.JOINT` is the
        offset of a revolute joint's angle, and `x.tool`, `y.tool`, `z.tool` place the ball.
    """
    frames, back = [], np.eye(4)
    for joint in robot.joints:
        turn = np.eye(4)
        turn[:3, :3] = _from_z(joint.axis)
        frames.append(back @ joint.origin @ turn)
        back = turn.T
    # The ball's place is a parameter, so the last frame only turns.
    end = back.copy()
    tool = robot.tool
    frames.append(end)
    kinds = ["rz" if joint.kind == "revolute" else "tz" for joint in robot.joints]
    return chain_from_frames(frames, kinds, robot.names, tool[:3, 3])  # type: ignore[arg-type]


def corrected_robot(
    robot: Robot, values: Mapping[str, float], corrections: Mapping[str, float]
) -> Robot:
    """A robot whose origins and ball contain calibrated parameters.

    Args:
        robot: that was calibrated.
        values: parameters of `robot_chain`, name -> value.
        corrections: of its joints, name -> value.

    Returns:
        The robot; `robot_chain` of it gives the poses of the calibrated chain without errors.
    """
    joints = []
    for joint in robot.joints:
        turn = _from_z(joint.axis)
        shift = np.array([values[f"t{c}.{joint.name}"] for c in "xyz"])
        rotation = np.linalg.multi_dot([_about(c, values[f"r{c}.{joint.name}"]) for c in "xyz"])
        error = np.eye(4)
        error[:3, :3] = turn @ rotation @ turn.T
        error[:3, 3] = turn @ shift
        joints.append(replace(joint, origin=joint.origin @ error))
    tool = robot.tool.copy()
    tool[:3, 3] = [values[f"{c}.tool"] for c in "xyz"]
    return replace(robot, joints=tuple(joints), tool=tool, corrections=dict(corrections))


def deflection_names(robot: Robot, gravity: bool, eccentricity: bool) -> tuple[str, ...]:
    """Parameters by which a robot's joints may deviate from their encoders.

    Args:
        robot: the robot.
        gravity: joints that yield: `sag.JOINT.PLACE` for a mass at a joint beyond, or at the ball
            (`tool`), whose weight turns the joint: compliance times mass [rad s^2/m^2].
        eccentricity: `sine.JOINT` and `cosine.JOINT`, errors once per turn [rad].

    Returns:
        The names. Masses that turn a joint alike count once, those that never turn it not at all.
    """
    names: list[str] = []
    if gravity:
        posed = np.random.default_rng(0).uniform(-1.0, 1.0, (5, len(robot.joints)))
        chain = robot_chain(robot)
        points, ways = joint_axes(chain, posed)
        places = np.concatenate([points, forward(chain, posed).position[:, None]], axis=1)
        for i, joint in enumerate(robot.joints):
            if joint.kind != "revolute":
                continue
            seen: list[np.ndarray] = []
            for j in range(len(robot.joints), i, -1):
                weight = np.cross(places[:, j] - points[:, i], robot.gravity)
                torque = np.sum(ways[:, i] * weight, axis=1)
                if np.abs(torque).max() < _SILENT or any(
                    np.abs(torque - other).max() < _SILENT for other in seen
                ):
                    continue
                seen.append(torque)
                place = "tool" if j == len(robot.joints) else robot.joints[j].name
                names.append(f"sag.{joint.name}.{place}")
    if eccentricity:
        turning = [joint.name for joint in robot.joints if joint.kind == "revolute"]
        names += [f"{kind}.{name}" for name in turning for kind in ("sine", "cosine")]
    return tuple(names)


def deflections(robot: Robot, joints: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """How much joints deviate from their encoders per unit of parameters.

    A mass m at r turns a joint at o with axis u by c m u . (r - o) x g.

    Args:
        robot: the robot; its geometry need not be calibrated for that.
        joints: (n, k) encoder readings [rad] or [m].
        names: of the e parameters, as from `deflection_names`.

    Returns:
        (n, k, e) derivatives of the joints' deviations.

    Raises:
        ValueError: a parameter names a joint or a kind that there is not.
    """
    made = np.zeros((len(joints), len(robot.joints), len(names)))
    if not names:
        return made
    chain = robot_chain(robot)
    points, ways = joint_axes(chain, joints)
    places = np.concatenate([points, forward(chain, joints).position[:, None]], axis=1)
    order = {name: k for k, name in enumerate((*robot.names, "tool"))}
    for e, name in enumerate(names):
        kind, _, rest = name.partition(".")
        joint = next((n for n in robot.names if rest == n or rest.startswith(f"{n}.")), None)
        if joint is None or kind not in ("sag", "sine", "cosine"):
            raise ValueError(f"{name!r} is no correction of a joint of {robot.name}")
        i = order[joint]
        if kind == "sag":
            place = rest.removeprefix(f"{joint}.")
            if place not in order:
                raise ValueError(f"{name!r}: there is no place {place!r} in {robot.name}")
            weight = np.cross(places[:, order[place]] - points[:, i], robot.gravity)
            made[:, i, e] = np.sum(ways[:, i] * weight, axis=1)
        else:
            made[:, i, e] = (np.sin if kind == "sine" else np.cos)(joints[:, i])
    return made


def robot_poses(robot: Robot, joints: np.ndarray) -> Poses:
    """Poses of the ball with all corrections of a robot.

    Args:
        robot: nominal or calibrated.
        joints: (n, k) encoder readings [rad] or [m].

    Returns:
        n poses in the base frame.
    """
    return forward(robot_chain(robot), _deviated(robot, np.asarray(joints, float)))


class Reached(NamedTuple):
    """Joint coordinates for places; `missed` is what is left [m]."""

    joints: np.ndarray
    missed: np.ndarray


def joints_for_places(
    robot: Robot, places: np.ndarray, start: np.ndarray, iterations: int = 50,
    idle: int | None = None,
) -> Reached:  # fmt: skip
    """Encoder readings that bring the ball to places: resolved motion to the end.

    Every step is the one of least norm that closes the gap, by the robot's Jacobian with a damping
    that vanishes with the gap.

    Args:
        robot: nominal or calibrated.
        places: (n, 3) in the base frame [m].
        start: (n, k) where the joints are.
        iterations: most steps.
        idle: column of a joint that does not move; None for none.

    Returns:
        (n, k) readings and (n,) distances that are left.

    Source: Wampler 1986 (damped least squares).
    """
    chain = robot_chain(robot)
    joints = np.array(start, float)
    gap = np.zeros_like(places)
    for _ in range(iterations + 1):
        found = forward_and_rates(chain, _deviated(robot, joints))
        gap = places - found.position
        size = np.sum(gap**2, axis=1)
        if size.max(initial=0.0) < 1e-24:
            break
        rates = found.position_by_joint.copy()
        if idle is not None:
            rates[:, :, idle] = 0.0
        square = rates @ np.swapaxes(rates, 1, 2) + (1e-3 * size)[:, None, None] * np.eye(3)
        step = np.swapaxes(rates, 1, 2) @ np.linalg.solve(square, gap[:, :, None])
        joints += step[:, :, 0]
    return Reached(joints, np.linalg.norm(gap, axis=1))


def _deviated(robot: Robot, joints: np.ndarray) -> np.ndarray:
    names = tuple(robot.corrections)
    if not names:
        return joints
    return joints + deflections(robot, joints, names) @ np.array(list(robot.corrections.values()))


def frame(position: Sequence[float], rpy: Sequence[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """(4, 4) transform of a place [m] and roll, pitch, yaw [rad]: Rz(yaw) Ry(pitch) Rx(roll)."""
    made = np.eye(4)
    made[:3, :3] = _about("z", rpy[2]) @ _about("y", rpy[1]) @ _about("x", rpy[0])
    made[:3, 3] = position
    return made


def rpy_of(rotation: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw [rad] of a rotation (3, 3); yaw is 0 where the pitch is a right angle."""
    sine = -rotation[2, 0]
    cosine = math.hypot(rotation[2, 1], rotation[2, 2])
    pitch = math.atan2(sine, cosine)
    if cosine > _SAME:
        roll = math.atan2(rotation[2, 1], rotation[2, 2])
        return np.array([roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])])
    return np.array([math.copysign(1.0, sine) * math.atan2(rotation[0, 1], rotation[1, 1]),
                     pitch, 0.0])  # fmt: skip


def _about(axis: str, angle: float) -> np.ndarray:
    cosine, sine = math.cos(angle), math.sin(angle)
    made = np.eye(3)
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    made[[first, second], [first, second]] = cosine
    made[second, first], made[first, second] = sine, -sine
    return made


def _from_z(axis: np.ndarray) -> np.ndarray:
    """The smallest rotation that turns z to an axis; half a turn about x for -z."""
    x, y, z = axis
    if z < -1.0 + _SAME:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.eye(3) + skew + skew @ skew / (1.0 + z)
