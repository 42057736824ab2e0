"""Kinematics of serial-parallel robots: a carriage that carries a hexapod.

Six legs of variable length connect universal joints A_i on the carriage's last link, the connecting
platform, to spherical joints B_i on the moving platform. Frame 0 is that of the measurement, frame
n that of the connecting platform (4 for four joints). Frame 5 of Wang 2012, that of the moving
platform, is the end effector's.

The carriage of revolute and prismatic joints is a chain of constant transforms with a motion about
or along z between them: T(q) = C_0 M(q_1) C_1 M(q_2) ... C_n. D-H rows give C_0 = 1 and C_i =
Rz(theta) Tz(d) Tx(a) Rx(alpha). Axis lines with the frame F_i of each give C_0 = F_1, C_i = F_i^-1
F_{i+1}, C_n = F_n^-1, the product of exponentials exp(xi_1 q_1) ... exp(xi_n q_n). Both error
models (`hybrid_error_model`) therefore use the same computation.

Source: Wang 2012, sections 3.1.1 and 3.2.1, Eqs 6 to 11, sections 3.1.2 (Eqs 12 to 29) and 3.2;
Park and Okamura 1994 (exponentials); Mooring et al. 1991 (4R + 2P + T).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import yaml
from pydantic import Field, model_validator
from scipy.optimize import differential_evolution
from scipy.spatial.transform import Rotation

from hydrotele.core.compiled import compiled
from hydrotele.core.datafile import (
    Number,
    PositiveFloat,
    StrictModel,
    Vector,
    read_yaml,
    suggest_valid_name,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.core.output import atomic_file

LEG_COUNT = 6
PRISMATIC, REVOLUTE = 0, 1
_KIND_CODES = {"prismatic": PRISMATIC, "revolute": REVOLUTE}
SHIPPED_ROBOTS = ("iwr",)
_NEWTON_TOLERANCE = 1e-12  # m and rad, tolerance of a Newton step
_MAX_NEWTON_STEPS = 50


class UnreachableError(ValueError):
    """No pose of the platform has these leg lengths, or Newton's method does not find it."""


class DhRow(StrictModel):
    """A carriage joint given by its D-H row (Wang 2012, Table 1): lengths [m], angles [rad]."""

    joint: str
    kind: Literal["prismatic", "revolute"]
    alpha: Number
    a: Number
    d: Number
    theta: Number
    range: tuple[Number, Number]


class AxisRow(StrictModel):
    """A carriage joint given by the line of its axis in frame 0 with all joints at zero.

    `direction` is a vector along the axis, `point` [m] a point on it (unused for prismatic joints).
    """

    joint: str
    kind: Literal["prismatic", "revolute"]
    direction: Vector
    point: Vector = (0.0, 0.0, 0.0)
    range: tuple[Number, Number]

    @model_validator(mode="after")
    def _check_direction(self):
        if np.linalg.norm(self.direction) < 1e-9:
            raise ValueError("direction must not be zero")
        return self


class PlatformFrame(StrictModel):
    """Frame of the connecting platform with all joints at zero: origin [m] and rotation vector [rad] in frame 0."""

    position: Vector
    rotation: Vector


_SixVectors = Annotated[tuple[Vector, ...], Field(min_length=LEG_COUNT, max_length=LEG_COUNT)]


class HybridSpec(StrictModel):
    """Contents of the file of a hybrid robot.

    `carriage` holds D-H rows; the last frame is that of the connecting platform. Alternatively,
    `axes` holds axis lines, and `platform_at_zero` the connecting platform's frame with all joints
    at zero. The other fields correspond to the attributes of `HybridRobot`.
    """

    name: str
    carriage: tuple[DhRow, ...] = ()
    axes: tuple[AxisRow, ...] = ()
    platform_at_zero: PlatformFrame | None = None
    universal_joints: _SixVectors
    spherical_joints: _SixVectors
    leg_offsets: Annotated[tuple[Number, ...], Field(min_length=LEG_COUNT, max_length=LEG_COUNT)]
    leg_range: tuple[PositiveFloat, PositiveFloat]
    home: Vector
    model: str = ""

    @model_validator(mode="after")
    def _check_form(self):
        if bool(self.carriage) == bool(self.axes):
            raise ValueError("give either `carriage` (D-H rows) or `axes` (lines of the axes)")
        if bool(self.axes) != (self.platform_at_zero is not None):
            raise ValueError("`platform_at_zero` is required with `axes`, and only there")
        names = [row.joint for row in self.carriage or self.axes]
        if twice := {n for n in names if names.count(n) > 1}:
            raise ValueError(f"the joint {min(twice)!r} occurs twice")
        return self


class PlatformPose(NamedTuple):
    """Poses of the moving platform in frame 0.

    Attributes:
        rotation: (..., 3, 3) rotation from the platform's frame to frame 0.
        position: (..., 3) position of the platform's origin [m].
    """

    rotation: np.ndarray
    position: np.ndarray


@dataclass(frozen=True)
class HybridRobot:
    """Kinematic model of a hybrid robot with n carriage joints.

    Attributes:
        name: name of the robot.
        joints: names of the carriage joints.
        kinds: (n,) PRISMATIC or REVOLUTE.
        constants: (n + 1, 4, 4) transforms C_0 to C_n.
        universal: (6, 3) joints A_i in the connecting platform's frame [m].
        spherical: (6, 3) joints B_i in the moving platform's frame [m].
        offsets: (6,) leg lengths minus leg readings [m].
        joint_range: (n, 2) joint ranges [m] or [rad].
        leg_range: minimum and maximum reading of a leg [m].
        home: (3,) home position of the moving platform in the connecting platform's frame [m].
        specification: contents of the file.
    """

    name: str
    joints: tuple[str, ...]
    kinds: np.ndarray
    constants: np.ndarray
    universal: np.ndarray
    spherical: np.ndarray
    offsets: np.ndarray
    joint_range: np.ndarray
    leg_range: tuple[float, float]
    home: np.ndarray
    specification: HybridSpec


def load_hybrid(name: str | Path) -> HybridRobot:
    """Read a hybrid robot (a serial carriage that carries a hexapod) by name or from a file.

    Args:
        name: a shipped robot, a file in the format of `models/iwr/iwr.yaml`, or a folder with
            `robot.yaml`, such as the output of a calibration.

    Raises:
        InputError: there is no such robot, or the file is invalid.

    >>> load_hybrid("iwr").joints
    ('d1', 'd2', 'theta3', 'theta4')
    """
    path = Path(name)
    if str(name) in SHIPPED_ROBOTS:
        path = models_folder() / str(name) / f"{name}.yaml"
    elif path.is_dir() and (path / "robot.yaml").is_file():
        path = path / "robot.yaml"
    elif not path.is_file():
        raise InputError(
            f"hybrid robot {str(name)!r}",
            f"{suggest_valid_name(name, SHIPPED_ROBOTS)}; or give a file or folder",
        )
    data, lines = read_yaml(path)
    return build_hybrid(validate_data(HybridSpec, data, str(path), lines))


def save_hybrid(robot: HybridRobot, path: str | Path, note: str = "") -> None:
    """Write a hybrid robot to a file in SI units with all digits; `load_hybrid` reads it.

    Args:
        robot: the robot.
        path: path of the file, `.yaml`.
        note: comment for its first line.

    Raises:
        InputError: the file cannot be written.
    """
    data = robot.specification.model_dump(mode="json", exclude_defaults=True)
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=110)
    with atomic_file(path, ".yaml") as part:
        part.write_text((f"# {note}\n" if note else "") + text, encoding="utf-8")


def build_hybrid(facts: HybridSpec) -> HybridRobot:
    """Build the kinematic model of a hybrid robot from the contents of its file."""
    rows = facts.carriage or facts.axes
    if facts.carriage:
        table = np.array([(r.theta, r.d, r.a, r.alpha) for r in facts.carriage])
        constants = np.concatenate([np.eye(4)[None], dh_transform(*table.T)])
    else:
        constants = carriage_constants_from_axes(axis_frames(facts.axes), _platform_at_zero(facts))
    return HybridRobot(
        facts.name, tuple(r.joint for r in rows), np.array([_KIND_CODES[r.kind] for r in rows]),
        constants, np.array(facts.universal_joints), np.array(facts.spherical_joints),
        np.array(facts.leg_offsets), np.array([r.range for r in rows]), facts.leg_range,
        np.array(facts.home), facts,
    )  # fmt: skip


def dh_transform(theta, d, a, alpha) -> np.ndarray:
    """Return D-H transforms Rz(theta) Tz(d) Tx(a) Rx(alpha) (Wang 2012, Eq. 6).

    Args:
        theta: (...) joint angle [rad].
        d: (...) joint distance [m].
        a: (...) link length [m].
        alpha: (...) link twist [rad].

    Returns:
        (..., 4, 4) homogeneous transforms.

    >>> dh_transform(0.0, 0.3, 0.5, 0.0)[:3, 3].tolist()
    [0.5, 0.0, 0.3]
    """
    theta, d, a, alpha = np.broadcast_arrays(theta, d, a, alpha)
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    zero, one = np.zeros_like(ct), np.ones_like(ct)
    rows = [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st],
            [zero, sa, ca, d + zero], [zero, zero, zero, one]]  # fmt: skip
    return np.moveaxis(np.array(rows, float), (0, 1), (-2, -1))


def axis_frames(axes: Sequence[AxisRow]) -> np.ndarray:
    """Build a frame for each joint axis, with z along the axis and its origin on the axis.

    Returns:
        (n, 4, 4) frames relative to frame 0, with all joints at zero.
    """
    frames = np.tile(np.eye(4), (len(axes), 1, 1))
    for frame, row in zip(frames, axes, strict=True):
        z = np.array(row.direction) / np.linalg.norm(row.direction)
        x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
        x /= np.linalg.norm(x)
        frame[:3, :3] = np.column_stack([x, np.cross(z, x), z])
        frame[:3, 3] = row.point
    return frames


def _platform_at_zero(facts: HybridSpec) -> np.ndarray:
    """Return the connecting platform's frame (4, 4) in frame 0 with all joints at zero."""
    assert facts.platform_at_zero is not None
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_rotvec(facts.platform_at_zero.rotation).as_matrix()
    frame[:3, 3] = facts.platform_at_zero.position
    return frame


def carriage_constants_from_axes(frames: np.ndarray, at_zero: np.ndarray) -> np.ndarray:
    """Compute the constant transforms between the joints of a carriage that is given by its axes.

    With these C_0 to C_n the pose is C_0 M(q_1) C_1 ... C_n, with motions M about or along z.

    Args:
        frames: (..., n, 4, 4) axis frames F_i.
        at_zero: (4, 4) frame of the connecting platform with joints at zero.

    Returns:
        (..., n + 1, 4, 4): F_1, F_i^-1 F_{i+1}, F_n^-1 times the platform's frame.
    """
    inverse = inverse_transform(frames)
    between = inverse[..., :-1, :, :] @ frames[..., 1:, :, :]
    last = inverse[..., -1:, :, :] @ at_zero
    return np.concatenate([frames[..., :1, :, :], between, last], axis=-3)


def inverse_transform(transform: np.ndarray) -> np.ndarray:
    """Return the inverse of homogeneous transforms (..., 4, 4)."""
    turned = np.swapaxes(transform[..., :3, :3], -1, -2)
    result = np.zeros_like(transform)
    result[..., :3, :3], result[..., 3, 3] = turned, 1.0
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", turned, transform[..., :3, 3])
    return result


def frames_at_zero_joints(robot: HybridRobot) -> tuple[np.ndarray, np.ndarray]:
    """Compute the frames of joint axes and connecting platform in frame 0 with all joints at zero.

    Returns:
        ((n, 4, 4) frames with each joint's axis along z, (4, 4) frame of the connecting platform).
    """
    frame, frames = np.eye(4), []
    for constant in robot.constants[:-1]:
        frame = frame @ constant
        frames.append(frame)
    return np.array(frames), frame @ robot.constants[-1]


def convert_to_axes(robot: HybridRobot) -> HybridRobot:
    """Return the same robot, given by axis lines instead of D-H rows.

    >>> same = convert_to_axes(load_hybrid("iwr"))
    >>> q = np.array([0.3, 0.1, 0.4, -0.2])
    >>> place = PlatformPose(np.eye(3), np.array([1.2, -0.1, 1.4]))
    >>> change = leg_readings(same, q, place) - leg_readings(load_hybrid("iwr"), q, place)
    >>> bool(abs(change).max() < 1e-12)
    True
    """
    frames, last = frames_at_zero_joints(robot)
    rows = [
        AxisRow(joint=name, kind="prismatic" if kind == PRISMATIC else "revolute",
                direction=tuple(frame[:3, 2]), point=tuple(frame[:3, 3]), range=tuple(limits))
        for name, kind, frame, limits in zip(
            robot.joints, robot.kinds, frames, robot.joint_range.tolist(), strict=True)
    ]  # fmt: skip
    vector = Rotation.from_matrix(last[:3, :3]).as_rotvec()
    seat = PlatformFrame(position=tuple(last[:3, 3]), rotation=tuple(vector))
    changes = {"carriage": (), "axes": tuple(rows), "platform_at_zero": seat}
    return build_hybrid(robot.specification.model_copy(update=changes))


def carriage_pose(robot: HybridRobot, joints: np.ndarray) -> np.ndarray:
    """Compute the poses of the carriage's last link, the connecting platform, from its joints.

    Args:
        robot: the robot.
        joints: (..., n) joint positions [m] or [rad].

    Returns:
        (..., 4, 4) poses in frame 0.
    """
    joints = np.asarray(joints, float)
    result = np.broadcast_to(robot.constants[0], (*joints.shape[:-1], 4, 4))
    for i, kind in enumerate(robot.kinds):
        motion = np.zeros((*joints.shape[:-1], 4, 4))
        motion[..., range(4), range(4)] = 1.0
        if kind == REVOLUTE:
            c, s = np.cos(joints[..., i]), np.sin(joints[..., i])
            motion[..., 0, 0], motion[..., 0, 1] = c, -s
            motion[..., 1, 0], motion[..., 1, 1] = s, c
        else:
            motion[..., 2, 3] = joints[..., i]
        result = result @ motion @ robot.constants[i + 1]
    return result


def leg_vectors(robot: HybridRobot, joints: np.ndarray, pose: PlatformPose) -> np.ndarray:
    """Compute the vectors along the six legs, from universal joint A_i to spherical joint B_i.

    They are in the connecting platform's frame (Wang 2012, Eqs 8 and 10).

    Args:
        robot: the robot.
        joints: (..., n) positions of the carriage joints [m] or [rad].
        pose: (...) poses of the moving platform.

    Returns:
        (..., 6, 3) vectors [m].
    """
    carriage = carriage_pose(robot, joints)
    ends = np.einsum("...ij,kj->...ki", pose.rotation, robot.spherical)
    ends = ends + (pose.position - carriage[..., :3, 3])[..., None, :]
    return np.einsum("...ji,...kj->...ki", carriage[..., :3, :3], ends) - robot.universal


def leg_readings(robot: HybridRobot, joints: np.ndarray, pose: PlatformPose) -> np.ndarray:
    """Compute the readings of the leg sensors at a pose (Wang 2012, Eq. 11).

    Args:
        robot: the robot.
        joints: (..., n) positions of the carriage joints [m] or [rad].
        pose: (...) poses of the moving platform.

    Returns:
        (..., 6) distance of A_i and B_i minus the leg's offset [m].
    """
    return np.linalg.norm(leg_vectors(robot, joints, pose), axis=-1) - robot.offsets


def inverse_kinematics(robot: HybridRobot, pose: PlatformPose, joints: np.ndarray) -> np.ndarray:
    """Compute leg readings for a pose with given carriage positions; raise if they are out of the legs' range.

    The robot is redundant: ten joints for six coordinates. The carriage positions are chosen first
    and determine the leg readings.

    Args:
        robot: the robot.
        pose: (...) poses of the moving platform.
        joints: (..., n) positions of the carriage joints [m] or [rad].

    Returns:
        (..., 6) readings [m].

    Raises:
        UnreachableError: a leg reading is out of range.
    """
    readings = leg_readings(robot, joints, pose)
    low, high = robot.leg_range
    if not ((readings >= low) & (readings <= high)).all():
        worst = readings.flat[np.argmax(np.maximum(low - readings, readings - high))]
        raise UnreachableError(f"a leg would read {worst:.4f} m, its range is {low:g} to {high:g} m")
    return readings


def home_pose(robot: HybridRobot, joints: np.ndarray) -> PlatformPose:
    """Return the pose of the moving platform at its home position on the carriage.

    Args:
        robot: the robot.
        joints: (..., n) positions of the carriage joints [m] or [rad].

    Returns:
        (...) poses in frame 0, with the orientation of the connecting platform.
    """
    carriage = carriage_pose(robot, joints)
    place = np.einsum("...ij,j->...i", carriage[..., :3, :3], robot.home)
    return PlatformPose(carriage[..., :3, :3], place + carriage[..., :3, 3])


def leg_jacobian(robot: HybridRobot, joints: np.ndarray, pose: PlatformPose) -> np.ndarray:
    """Compute the derivatives of leg readings by the platform's position [m] and rotation vector [rad].

    The rotation vector w changes the platform's rotation R to exp(w) R, in frame 0.

    Args:
        robot: the robot.
        joints: (..., n) positions of the carriage joints [m] or [rad].
        pose: (...) poses of the moving platform.

    Returns:
        (..., 6, 6): row k is (u_k, (R b_k) x u_k), with the direction u_k of leg k in frame 0. R is the
        platform's rotation, b_k the position of joint B_k in the platform's frame.
    """
    carriage = carriage_pose(robot, joints)
    legs = leg_vectors(robot, joints, pose)
    unit = legs / np.linalg.norm(legs, axis=-1, keepdims=True)
    unit = np.einsum("...ij,...kj->...ki", carriage[..., :3, :3], unit)
    arms = np.einsum("...ij,kj->...ki", pose.rotation, robot.spherical)
    return np.concatenate([unit, np.cross(arms, unit)], axis=-1)


def forward_kinematics(
    robot: HybridRobot, joints: np.ndarray, readings: np.ndarray, start: PlatformPose | None = None
) -> PlatformPose:
    """Compute the platform's pose from leg readings and carriage joints by Newton's method.

    Up to 40 poses have the same lengths; the result is the one that the iteration reaches from the
    start pose.

    Args:
        robot: the robot.
        joints: (N, n) or (n,) positions of the carriage joints [m] or [rad].
        readings: (N, 6) or (6,) leg readings [m].
        start: start poses; the home poses by default.

    Returns:
        The poses, (N,) or a single one.

    Raises:
        UnreachableError: Newton's method does not converge.
    """
    joints, readings = np.asarray(joints, float), np.asarray(readings, float)
    rotation, position = home_pose(robot, joints) if start is None else start
    rotation, position = np.array(rotation), np.array(position)
    size = np.inf
    for _ in range(_MAX_NEWTON_STEPS):
        pose = PlatformPose(rotation, position)
        error = leg_readings(robot, joints, pose) - readings
        jacobian = leg_jacobian(robot, joints, pose)
        try:
            step = -np.linalg.solve(jacobian, error[..., None])[..., 0]
        except np.linalg.LinAlgError:
            raise UnreachableError("the hexapod is in a singular pose") from None
        turn = np.linalg.norm(step[..., 3:], axis=-1, keepdims=True)
        step = step * np.minimum(1.0, 0.5 / np.maximum(turn, 1e-300))  # rad: same branch
        position = position + step[..., :3]
        turned = Rotation.from_rotvec(step[..., 3:].reshape(-1, 3)).as_matrix()
        rotation = turned.reshape(*step.shape[:-1], 3, 3) @ rotation
        size = np.max(np.abs(step), initial=0.0)
        if not np.isfinite(size) or size < _NEWTON_TOLERANCE:
            break
    pose = PlatformPose(rotation, position)
    left = np.max(np.abs(leg_readings(robot, joints, pose) - readings), initial=0.0)
    if not left < 1e-9:  # m: far below any sensor, far above rounding
        raise UnreachableError("no pose of the platform has these leg lengths near the start")
    return pose


def forward_kinematics_by_evolution(
    robot: HybridRobot, joints: np.ndarray, readings: np.ndarray, seed: int = 0,
    reach: float = 0.35, turn: float = 0.6, polish: bool = False,
) -> PlatformPose:  # fmt: skip
    """Compute the platform's pose from leg readings by differential evolution, without a start pose.

    The sum of squared errors of the leg lengths is minimised over position and rotation vector in
    a box about the home pose.

    Args:
        robot: the robot.
        joints: (n,) positions of the carriage joints [m] or [rad].
        readings: (6,) leg readings [m].
        seed: seed of the random generator.
        reach: half the box's edge in position [m].
        turn: half the box's edge in the rotation vector [rad].
        polish: whether to end with a gradient search.

    Returns:
        The pose.

    Source: Wang 2012, sections 2.2 and 3.3 (forward kinematics by DE); Storn and Price 1997.
    """
    home = home_pose(robot, np.asarray(joints, float))

    def pose_from_vector(x: np.ndarray) -> PlatformPose:  # (6, S) as SciPy passes a population
        turned = Rotation.from_rotvec(x[3:].T).as_matrix() @ home.rotation
        return PlatformPose(turned, home.position + x[:3].T)

    def squared_errors(x: np.ndarray) -> np.ndarray:
        x = x if x.ndim == 2 else x[:, None]
        place = np.broadcast_to(joints, (x.shape[1], len(robot.joints)))
        away = leg_readings(robot, place, pose_from_vector(x)) - readings
        return np.sum((1e3 * away) ** 2, axis=-1)

    found = differential_evolution(
        squared_errors, [(-reach, reach)] * 3 + [(-turn, turn)] * 3, rng=np.random.default_rng(seed),
        popsize=10, maxiter=2000, tol=1e-16, polish=polish, vectorized=True,
        updating="deferred",
    )  # fmt: skip
    pose = pose_from_vector(found.x[:, None])
    return PlatformPose(pose.rotation[0], pose.position[0])


def euler_to_rotation(angles: np.ndarray) -> np.ndarray:
    """Return the rotation Rz(gamma) Ry(beta) Rx(alpha) of Z-Y-X Euler angles (Wang 2012, Eq. 9).

    Args:
        angles: (..., 3) about x, y, z: alpha, beta, gamma [rad].

    Returns:
        (..., 3, 3) rotations.
    """
    angles = np.asarray(angles, float)
    turned = Rotation.from_euler("ZYX", angles.reshape(-1, 3)[:, ::-1]).as_matrix()
    return turned.reshape(*angles.shape[:-1], 3, 3)


def rotation_to_euler(rotation: np.ndarray) -> np.ndarray:
    """Return Z-Y-X Euler angles (..., 3) about x, y, z [rad] of rotations (..., 3, 3).

    >>> rotation_to_euler(euler_to_rotation([0.1, -0.2, 0.3])).round(12).tolist()
    [0.1, -0.2, 0.3]
    """
    rotation = np.asarray(rotation, float)
    angles = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_euler("ZYX")[:, ::-1]
    return angles.reshape(*rotation.shape[:-2], 3)


def pose_difference(found: PlatformPose, true: PlatformPose) -> np.ndarray:
    """Return the difference (..., 6) of poses in frame 0: position `found` minus `true` [m], rotation vector [rad].

    The rotation vector rotates the orientation of `true` to that of `found`.
    """
    turned = found.rotation @ np.swapaxes(true.rotation, -1, -2)
    vector = Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_rotvec()
    return np.concatenate([found.position - true.position, vector.reshape(found.position.shape)], axis=-1)


@compiled
def batch_readings(constants, kinds, universal, spherical, offsets, joints, rotation, position):
    """Compute the leg readings of W robots with different geometry at N platform poses each.

    Args:
        constants: (W, n + 1, 4, 4) transforms of each robot's carriage.
        kinds: (n,) PRISMATIC or REVOLUTE.
        universal: (W, 6, 3) universal joints A_i [m].
        spherical: (W, 6, 3) spherical joints B_i [m].
        offsets: (W, 6) leg offsets [m].
        joints: (N, n) carriage positions [m] or [rad].
        rotation: (N, 3, 3) rotations of the moving platform.
        position: (N, 3) positions of the moving platform [m].

    Returns:
        (W, N, 6) readings [m]: distance of A_i and B_i minus the leg's offset.

    Source: Wang 2012, Eqs 10, 11 and 29.
    """
    robots, poses, n = len(constants), len(joints), len(kinds)
    result = np.empty((robots, poses, 6))
    t, m = np.empty((3, 4)), np.empty((3, 4))
    for w in range(robots):
        for k in range(poses):
            for i in range(3):
                for j in range(4):
                    t[i, j] = constants[w, 0, i, j]
            for joint in range(n):
                value = joints[k, joint]
                if kinds[joint] == 1:
                    c, s = np.cos(value), np.sin(value)
                    for i in range(3):
                        x, y = t[i, 0], t[i, 1]
                        t[i, 0], t[i, 1] = c * x + s * y, c * y - s * x
                else:
                    for i in range(3):
                        t[i, 3] += t[i, 2] * value
                for i in range(3):
                    for j in range(4):
                        total = t[i, 3] if j == 3 else 0.0
                        for v in range(3):
                            total += t[i, v] * constants[w, joint + 1, v, j]
                        m[i, j] = total
                for i in range(3):
                    for j in range(4):
                        t[i, j] = m[i, j]
            for leg in range(6):
                square = 0.0
                bx, by, bz = spherical[w, leg, 0], spherical[w, leg, 1], spherical[w, leg, 2]
                ax, ay, az = universal[w, leg, 0], universal[w, leg, 1], universal[w, leg, 2]
                for i in range(3):  # length in frame 0, which needs no transposed product
                    away = position[k, i] - t[i, 3]
                    away += rotation[k, i, 0] * bx + rotation[k, i, 1] * by + rotation[k, i, 2] * bz
                    away -= t[i, 0] * ax + t[i, 1] * ay + t[i, 2] * az
                    square += away * away
                result[w, k, leg] = np.sqrt(square) - offsets[w, leg]
    return result
