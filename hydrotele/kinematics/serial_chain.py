"""Serial chains of elementary transforms: poses and derivatives for many joint positions at once.

A chain is a product of elementary transforms: translations along and rotations about x, y, z, each
by a constant, a joint coordinate or both, and fixed transforms between them. Denavit-Hartenberg
rows with Hayati's angle, the origins of a URDF and local products of exponentials are all written
in this form. The constants are the parameters of a calibration. The cost is linear in the number
of poses.

Source: Corke 2007, A simple and systematic approach to assigning Denavit-Hartenberg parameters
(elementary transforms); Haviland and Corke 2023, Manipulator differential kinematics; Hayati 1983.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

ElementKind = Literal["tx", "ty", "tz", "rx", "ry", "rz", "fixed"]
_AXIS_INDEX = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Element:
    """One elementary transform.

    Attributes:
        kind: translation `tx`, `ty`, `tz` [m], rotation `rx`, `ry`, `rz` [rad], or `fixed`.
        parameter: name of its constant if this is a parameter of the chain, otherwise "".
        value: nominal constant [m] or [rad].
        joint: index of the joint whose coordinate, times `ratio`, is added to the constant; or
            None.
        ratio: factor of the joint coordinate.
        matrix: (4, 4) homogeneous transform of a `fixed` element.
    """

    kind: ElementKind
    parameter: str = ""
    value: float = 0.0
    joint: int | None = None
    ratio: float = 1.0
    matrix: np.ndarray | None = None


class ChainPoses(NamedTuple):
    """Position (n, 3) [m] and rotation matrix (n, 3, 3) of the chain's end in the base frame, for n poses."""

    position: np.ndarray
    rotation: np.ndarray


class PosesAndRates(NamedTuple):
    """Poses of the chain's end, and their derivatives by p parameters and k joint coordinates; n poses.

    Attributes:
        position: (n, 3) position of the end in the base frame [m].
        rotation: (n, 3, 3) rotation of the end.
        position_by_parameter: (n, 3, p) derivative of the position by each parameter [m/m] or
            [m/rad].
        rotation_by_parameter: (n, 3, p) rotation vector in the base frame per unit of each
            parameter [rad/m] or [1].
        position_by_joint: (n, 3, k) derivative of the position by each joint coordinate [m/m] or
            [m/rad].
        rotation_by_joint: (n, 3, k) rotation vector in the base frame per unit of each joint
            coordinate [rad/m] or [1].
    """

    position: np.ndarray
    rotation: np.ndarray
    position_by_parameter: np.ndarray
    rotation_by_parameter: np.ndarray
    position_by_joint: np.ndarray
    rotation_by_joint: np.ndarray


@dataclass(frozen=True)
class SerialChain:
    """A chain from its base to its end.

    Attributes:
        joints: names of the joints, in the order of the columns of joint coordinates.
        elements: elementary transforms from base to end.
    """

    joints: tuple[str, ...]
    elements: tuple[Element, ...]

    def __post_init__(self) -> None:
        """Raise ValueError for repeated parameter names, or a joint that moves no element."""
        names = self.parameters
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"parameter names must be unique: {', '.join(twice)}")
        used = {element.joint for element in self.elements} - {None}
        if used != set(range(len(self.joints))):
            raise ValueError(f"each of the {len(self.joints)} joints must move an element")

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the p parameters (named constants), in the order of the elements."""
        return tuple(e.parameter for e in self.elements if e.parameter)

    @property
    def nominal_values(self) -> np.ndarray:
        """Nominal values (p,) of the parameters [m] or [rad]."""
        return np.array([e.value for e in self.elements if e.parameter])

    @property
    def is_angle(self) -> np.ndarray:
        """Whether each parameter (p,) is an angle [rad] rather than a length [m]."""
        return np.array([e.kind[0] == "r" for e in self.elements if e.parameter], bool)


def chain_poses(chain: SerialChain, joints: np.ndarray, parameters: np.ndarray | None = None) -> ChainPoses:
    """Compute the poses of the chain's end; accepts complex arguments for complex-step derivatives.

    Args:
        chain: chain with k joints and p parameters.
        joints: (n, k) joint coordinates [rad] or [m].
        parameters: (p,) constants; None for the nominal ones.

    Returns:
        n poses.

    >>> arm = SerialChain(("a", "b"), (Element("rz", joint=0), Element("tx", "length_a", 0.4),
    ...                                Element("rz", joint=1), Element("tx", "length_b", 0.3)))
    >>> chain_poses(arm, np.array([[0.0, np.pi / 2]])).position.round(6).tolist()
    [[0.4, 0.3, 0.0]]
    """
    constants = chain.nominal_values if parameters is None else np.asarray(parameters)
    joints = _check_joints(chain, joints, constants)
    kind = np.result_type(joints, constants, float)
    position = np.zeros((len(joints), 3), kind)
    rotation = np.broadcast_to(np.eye(3, dtype=kind), (len(joints), 3, 3)).copy()
    for element, amount in _element_coordinates(chain, joints, constants):
        position, rotation = _apply_element(element, amount, position, rotation)
    return ChainPoses(position, rotation)


def chain_poses_and_derivatives(
    chain: SerialChain, joints: np.ndarray, parameters: np.ndarray | None = None
) -> PosesAndRates:
    """Compute poses of the chain's end, and their derivatives by constants and joint coordinates.

    An element rotates or translates everything beyond it about or along its axis u through its
    origin o. Per radian, a rotation moves the end at position p by u x (p - o) and rotates it by u; per
    metre, a translation moves it by u.

    Args:
        chain: chain with k joints and p parameters.
        joints: (n, k) joint coordinates [rad] or [m].
        parameters: (p,) constants; None for the nominal ones.

    Returns:
        n poses and their derivatives.

    >>> arm = SerialChain(("a",), (Element("rz", "zero", joint=0), Element("tx", "length", 0.5)))
    >>> chain_poses_and_derivatives(arm, np.zeros((1, 1))).position_by_parameter[0].tolist()
    [[0.0, 1.0], [0.5, 0.0], [0.0, 0.0]]
    """
    constants = chain.nominal_values if parameters is None else np.asarray(parameters, float)
    joints = _check_joints(chain, joints, constants)
    n = len(joints)
    position, rotation = np.zeros((n, 3)), np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
    axes, origins = [], []
    for element, amount in _element_coordinates(chain, joints, constants):
        if element.kind != "fixed":
            axes.append(rotation[:, :, _AXIS_INDEX[element.kind[1]]])
            origins.append(position)
        position, rotation = _apply_element(element, amount, position, rotation)
    p = len(constants)
    shift, turn = np.zeros((p, n, 3)), np.zeros((p, n, 3))
    joint_shift, joint_turn = (np.zeros((len(chain.joints), n, 3)) for _ in range(2))
    place = 0
    moving = [element for element in chain.elements if element.kind != "fixed"]
    for element, axis, origin in zip(moving, axes, origins, strict=True):
        turns = element.kind[0] == "r"
        moves = _cross(axis, position - origin) if turns else axis
        if element.parameter:
            shift[place] = moves
            if turns:
                turn[place] = axis
            place += 1
        if element.joint is not None:
            joint_shift[element.joint] += element.ratio * moves
            if turns:
                joint_turn[element.joint] += element.ratio * axis
    return PosesAndRates(position, rotation, *(np.moveaxis(a, 0, 2) for a in (shift, turn, joint_shift, joint_turn)))


def joint_axes(
    chain: SerialChain, joints: np.ndarray, parameters: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the positions and directions of the joint axes.

    Args:
        chain: chain of k joints, each with one element.
        joints: (n, k) joint coordinates [rad] or [m].
        parameters: (p,) constants; None for the nominal ones.

    Returns:
        (n, k, 3) points on the axes [m] and (n, k, 3) their directions, in the base frame.
    """
    constants = chain.nominal_values if parameters is None else np.asarray(parameters, float)
    joints = _check_joints(chain, joints, constants)
    points, ways = np.zeros((2, len(joints), len(chain.joints), 3))
    position = np.zeros((len(joints), 3))
    rotation = np.broadcast_to(np.eye(3), (len(joints), 3, 3)).copy()
    for element, amount in _element_coordinates(chain, joints, constants):
        if element.joint is not None:
            points[:, element.joint] = position
            ways[:, element.joint] = rotation[:, :, _AXIS_INDEX[element.kind[1]]]
        position, rotation = _apply_element(element, amount, position, rotation)
    return points, ways


@dataclass(frozen=True)
class DhRow:
    """Denavit-Hartenberg constants of one joint, Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta).

    Attributes:
        theta: offset of the joint angle [rad].
        d: distance along the joint's axis [m].
        a: distance between the axes [m].
        alpha: angle from this axis to the next [rad].
        beta: Hayati's angle [rad] if the next axis is parallel, so that d is not a parameter; None
            otherwise.
        prismatic: whether the joint coordinate is added to d.
    """

    theta: float = 0.0
    d: float = 0.0
    a: float = 0.0
    alpha: float = 0.0
    beta: float | None = None
    prismatic: bool = False


def chain_from_dh(rows: Sequence[DhRow], names: Sequence[str], tool: Sequence[float] | None = None) -> SerialChain:
    """Build a chain whose parameters are Denavit-Hartenberg constants.

    Args:
        rows: one row per joint.
        names: names of the joints; parameters are called `theta.NAME`, `d.NAME` and so on.
        tool: (3,) point in the last frame [m], whose coordinates `x.tool`, `y.tool`, `z.tool` are
            also parameters; None for the last frame itself.

    Returns:
        The chain.

    Source: Denavit and Hartenberg 1955; Hayati 1983 (beta for parallel axes).

    >>> scara = chain_from_dh([DhRow(a=0.4, beta=0.0), DhRow(a=0.3)], ["a", "b"])
    >>> scara.parameters
    ('theta.a', 'a.a', 'alpha.a', 'beta.a', 'theta.b', 'd.b', 'a.b', 'alpha.b')
    """
    elements = []
    for k, (row, name) in enumerate(zip(rows, names, strict=True)):
        turning, sliding = (None, k) if row.prismatic else (k, None)
        parallel = row.beta is not None
        elements += [
            Element("rz", f"theta.{name}", row.theta, turning),
            Element("tz", "" if parallel else f"d.{name}", row.d, sliding),
            Element("tx", f"a.{name}", row.a),
            Element("rx", f"alpha.{name}", row.alpha),
        ]
        if parallel:
            elements.append(Element("ry", f"beta.{name}", row.beta or 0.0))
    elements += _tool_elements(tool)
    return SerialChain(tuple(names), tuple(elements))


def chain_from_frames(
    frames: Sequence[np.ndarray], axes: Sequence[ElementKind], names: Sequence[str],
    tool: Sequence[float] | None = None,
) -> SerialChain:  # fmt: skip
    """Build a chain with six small errors in front of every joint (local product of exponentials).

    Joint i rotates about or translates along `axes[i]` of a frame at `frames[i]` in the frame after
    joint i - 1. Its errors are `tx.NAME`, `ty.NAME`, `tz.NAME` [m] and `rx.NAME`, `ry.NAME`,
    `rz.NAME` [rad] in that frame, nominally zero. The form is complete and continuous for any
    geometry, parallel axes included, and redundant: two of the six errors of a revolute joint are
    identifiable only in combinations.

    Args:
        frames: one (4, 4) per joint, and one more for the tool frame.
        axes: `rx` to `rz` for revolute, `tx` to `tz` for prismatic joints.
        names: names of the joints.
        tool: (3,) nominal point in the tool frame [m], whose coordinates are parameters `x.tool`,
            `y.tool`, `z.tool`; None for the tool frame without errors.

    Returns:
        The chain.

    Source: Chen, Yang, Tan and Yeo 2001, Local POE model for robot kinematic calibration.
    """
    if len(frames) != len(names) + 1 or len(axes) != len(names):
        raise ValueError(f"{len(names)} joints need as many axes and one more frame")
    kinds: tuple[ElementKind, ...] = ("tx", "ty", "tz", "rx", "ry", "rz")
    elements = []
    for k, (frame, axis, name) in enumerate(zip(frames[:-1], axes, names, strict=True)):
        elements.append(Element("fixed", matrix=np.asarray(frame, float)))
        elements += [Element(kind, f"{kind}.{name}") for kind in kinds]
        elements.append(Element(axis, joint=k))
    elements.append(Element("fixed", matrix=np.asarray(frames[-1], float)))
    elements += _tool_elements(tool)
    return SerialChain(tuple(names), tuple(elements))


def twist_exponential(twist: np.ndarray) -> np.ndarray:
    """Compute the exponential of twists: the transforms of screw motions.

    Args:
        twist: (..., 6) translation part v [m], then rotation vector w [rad], real or complex.

    Returns:
        (..., 4, 4) homogeneous transforms.

    Source: Park and Okamura 1994, Kinematic calibration and the product of exponentials formula.

    >>> twist_exponential(np.array([0.0, 0.0, 0.1, 0.0, 0.0, np.pi / 2])).round(6)[:3].tolist()
    [[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.1]]
    """
    twist = np.asarray(twist)
    v, w = twist[..., :3], twist[..., 3:]
    square = np.sum(w * w, axis=-1)
    small = np.abs(square) < 1e-8
    safe = np.where(small, 1.0, square)
    angle = np.sqrt(safe)
    sine = np.where(small, 1.0 - square / 6.0, np.sin(angle) / angle)
    cosine = np.where(small, 0.5 - square / 24.0, (1.0 - np.cos(angle)) / safe)
    third = np.where(small, 1.0 / 6.0 - square / 120.0, (angle - np.sin(angle)) / (safe * angle))
    skew = _skew(w)
    power = skew @ skew
    one = np.eye(3)
    made = np.zeros((*square.shape, 4, 4), np.result_type(twist, float))
    made[..., :3, :3] = one + sine[..., None, None] * skew + cosine[..., None, None] * power
    left = one + cosine[..., None, None] * skew + third[..., None, None] * power
    made[..., :3, 3] = (left @ v[..., None])[..., 0]
    made[..., 3, 3] = 1.0
    return made


def product_of_exponentials(twists: np.ndarray, home: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Compute the poses exp(t1 q1) ... exp(tk qk) home of a serial robot with joint twists t1 ... tk.

    Args:
        twists: (k, 6) v, w of each joint's unit twist in the base frame.
        home: (4, 4) pose at joint coordinates zero.
        joints: (n, k) joint coordinates [rad] or [m], real or complex.

    Returns:
        (n, 4, 4) poses.

    Source: Brockett 1984; Park and Okamura 1994.
    """
    joints = np.atleast_2d(joints)
    pose = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    for k, twist in enumerate(np.asarray(twists)):
        pose = pose @ twist_exponential(joints[:, k, None] * twist)
    return pose @ home


def _tool_elements(tool: Sequence[float] | None) -> list[Element]:
    if tool is None:
        return []
    kinds: tuple[ElementKind, ...] = ("tx", "ty", "tz")
    return [Element(kind, f"{kind[1]}.tool", float(value)) for kind, value in zip(kinds, tool, strict=True)]


def _check_joints(chain: SerialChain, joints: np.ndarray, constants: np.ndarray) -> np.ndarray:
    joints = np.atleast_2d(np.asarray(joints))
    if joints.ndim != 2 or joints.shape[1] != len(chain.joints):
        raise ValueError(f"joints must be (n, {len(chain.joints)}), got {joints.shape}")
    if constants.shape != (len(chain.parameters),):
        raise ValueError(f"parameters must be ({len(chain.parameters)},), got {constants.shape}")
    return joints


def _element_coordinates(chain: SerialChain, joints: np.ndarray, constants: np.ndarray):
    """Yield each element of a chain with its angle [rad] or displacement [m], scalar or (n,).

    The angle or displacement is the constant plus `ratio` times the joint coordinate.
    """
    place = 0
    for element in chain.elements:
        amount = element.value
        if element.parameter:
            amount = constants[place]
            place += 1
        if element.joint is not None:
            amount = amount + element.ratio * joints[:, element.joint]
        yield element, amount


def _apply_element(element: Element, amount, position: np.ndarray, rotation: np.ndarray):
    """Return position (n, 3) and rotation (n, 3, 3) of n frames after one more elementary transform.

    `amount` is the element's angle [rad] or displacement [m], scalar or (n,).
    """
    if element.kind == "fixed":
        assert element.matrix is not None
        return position + rotation @ element.matrix[:3, 3], rotation @ element.matrix[:3, :3]
    axis = _AXIS_INDEX[element.kind[1]]
    if element.kind[0] == "t":
        return position + rotation[:, :, axis] * np.reshape(amount, (-1, 1)), rotation
    first, second = (axis + 1) % 3, (axis + 2) % 3
    cosine, sine = (np.reshape(f(amount), (-1, 1)) for f in (np.cos, np.sin))
    turned = rotation.copy()
    turned[:, :, first] = cosine * rotation[:, :, first] + sine * rotation[:, :, second]
    turned[:, :, second] = cosine * rotation[:, :, second] - sine * rotation[:, :, first]
    return position, turned


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products (n, 3) of the rows of a and b; faster than `np.cross`."""
    return np.stack(
        [a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1], a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
         a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]], axis=1,
    )  # fmt: skip


def _skew(w: np.ndarray) -> np.ndarray:
    zero = np.zeros_like(w[..., 0])
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    rows = [np.stack(r, -1) for r in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack(rows, -2)
