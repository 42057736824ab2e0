"""Closed kinematic chain of a manipulator and a calibrator, in Khoshzaban's D-H convention.

The chain runs from the chassis through the manipulator's powered joints and the calibrator's sensed
joints to a ball joint on the chassis. Link k is `A_k = Tz(d) Rz(theta) Tx(a) Rx(alpha)
Ry(beta)` (K Eq. 3.8); the origin of the last frame is the ball. Signs are those of K: each z axis
points along the dominant positive direction of the machine's frame, so that boom and stick angles
are the negatives of the machine's.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_chain import (
    Element,
    SerialChain,
    chain_poses,
    chain_poses_and_derivatives,
)
from hydrotele.machine.machine import Machine

PARAMETER_KINDS = ("offset", "alpha", "a", "d", "beta")
"""Kinds of link parameters; `offset` is theta at the zero of the joint's sensor."""

_MAX_PARALLEL_ANGLE = 0.05  # rad, maximum angle between nominally parallel neighbouring axes
_KIND_COLUMNS = {kind: k for k, kind in enumerate(PARAMETER_KINDS)}


@dataclass(frozen=True)
class CalibrationLoop:
    """Closed chain of N links: a manipulator and a calibrator, which ends at a ball joint on the chassis.

    Parameters and signs are those of Khoshzaban's (K) D-H convention.

    Attributes:
        joints: (N,) names of the joints, from the chassis outwards.
        channels: (N,) log channel of each joint's sensor.
        links: (N,) name of each link: the axis name of a driven joint, otherwise the joint name.
        signs: (N,) factors from the machine's joint angles to K's.
        powered_count: number n of powered manipulator joints; the others belong to the calibrator.
        values: (N, 5) offset [rad], alpha [rad], a [m], d [m], beta [rad] of each link.
        ball: (3,) position of the ball in frame 0, whose x axis points to it at zero swing [m].
        base: (3,) origin of frame 0 in the machine's frame [m].
        parallel: (N,) whether a link's axis is nominally parallel to the next one.
        home: (N,) angles with offsets at the machine's home position [rad].
        machine: name of the machine.
    """

    joints: tuple[str, ...]
    channels: tuple[str, ...]
    links: tuple[str, ...]
    signs: np.ndarray
    powered_count: int
    values: np.ndarray
    ball: np.ndarray
    base: np.ndarray
    parallel: np.ndarray
    home: np.ndarray
    machine: str = ""

    def __len__(self) -> int:
        """Return the number of links N."""
        return len(self.joints)

    def parameter_index(self, name: str) -> tuple[int, int]:
        """Return row and column in `values` of a parameter such as `a.boom`.

        Raises:
            KeyError: the kind of parameter is unknown.
            ValueError: the link is unknown.
        """
        kind, _, link = name.partition(".")
        return self.links.index(link), _KIND_COLUMNS[kind]

    def value(self, name: str) -> float:
        """Return the value of a link parameter by name, such as `a.boom` [rad] or [m]."""
        return float(self.values[self.parameter_index(name)])

    def with_values(self, parameters: dict[str, float]) -> "CalibrationLoop":
        """Return the chain with some link parameters, given by name, replaced."""
        values = self.values.copy()
        for name, number in parameters.items():
            values[self.parameter_index(name)] = number
        return replace(self, values=values)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of all link parameters, such as `a.boom`, link by link."""
        return tuple(f"{kind}.{link}" for link in self.links for kind in PARAMETER_KINDS)


def unit_of(name: str) -> str:
    """Return the unit of a parameter such as `a.boom`: `m` for a, d, p_xy and p_z, otherwise `rad`."""
    return "m" if name.partition(".")[0] in ("a", "d", "p_xy", "p_z") else "rad"


def link_chain(values: np.ndarray) -> SerialChain:
    """Build the serial chain of consecutive links; its joint coordinates are sensor angles plus offsets.

    Args:
        values: (k, 5) rows of `CalibrationLoop.values`; the offsets are not used, because they are part
            of the joint coordinates.

    Returns:
        A chain of k joints with 5 parameters per link: offset (0, only for derivatives), d, a, alpha,
        beta.
    """
    return _build_chain(len(values), values.tobytes())


@functools.lru_cache(maxsize=64)
def _build_chain(count: int, value_bytes: bytes) -> SerialChain:
    elements = []
    for k, (_, alpha, a, d, beta) in enumerate(np.frombuffer(value_bytes).reshape(count, 5)):
        elements += [
            Element("rz", f"offset.{k}", 0.0, k), Element("tz", f"d.{k}", float(d)),
            Element("tx", f"a.{k}", float(a)), Element("rx", f"alpha.{k}", float(alpha)),
            Element("ry", f"beta.{k}", float(beta)),
        ]  # fmt: skip
    return SerialChain(tuple(map(str, range(count))), tuple(elements))


_CHAIN_TO_KINDS = [
    0,
    3,
    2,
    1,
    4,
]  # from chain order (offset, d, a, alpha, beta) to the order of KINDS


def frame_after_links(loop: CalibrationLoop, count: int, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the frame at the end of the first `count` links for M poses.

    Args:
        loop: the chain.
        count: number of links.
        theta: (M, N) angles with offsets [rad].

    Returns:
        (origins (M, 3) [m], rotations (M, 3, 3)) in frame 0.
    """
    return chain_poses(link_chain(loop.values[:count]), theta[:, :count])


def ball_position_from_axis(loop: CalibrationLoop, first: int, theta: np.ndarray) -> np.ndarray:
    """Compute the chain's end (the ball) in the frame of joint axis `first`, with that joint's angle set to 0.

    Args:
        loop: the chain.
        first: index of the joint's link in the chain, from 0.
        theta: (M, N - first - 1) angles of the joints beyond it, with their offsets [rad].

    Returns:
        (M, 3) positions [m], z along the axis, including the length d of the joint's own link.
    """
    angles = np.concatenate([np.zeros((len(theta), 1)), theta], axis=1)
    return chain_poses(link_chain(loop.values[first:]), angles).position


def ball_position_and_derivatives(
    loop: CalibrationLoop, first: int, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the chain's end (the ball) in the frame of a joint axis, and its derivatives by link parameters.

    The joint's own angle is taken as 0.

    `s = Tx(a_i) Rx(alpha_i) Ry(beta_i) A_(i+1) ... A_N [0 0 0 1]'` (Khoshzaban 1992, Eqs 3.23 and
    3.24), with `d_i` added to its z.

    Args:
        loop: the chain.
        first: index of link i in the chain, from 0.
        theta: (M, N - first - 1) angles of the joints beyond it, with their offsets [rad].

    Returns:
        (s (M, 3) [m], ds (M, 3, N - first, 5) derivatives by offset, alpha, a, d, beta of links
        i .. N; the derivative by the offset of link i is that by a rotation of joint i.)
    """
    angles = np.concatenate([np.zeros((len(theta), 1)), theta], axis=1)
    found = chain_poses_and_derivatives(link_chain(loop.values[first:]), angles)
    by = found.position_by_parameter.reshape(len(theta), 3, len(loop) - first, 5)
    return found.position, by[..., _CHAIN_TO_KINDS]


def closure_error(loop: CalibrationLoop, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the vector from the ball joint to the end of the chain, and its derivatives by the joint angles.

    Args:
        loop: the chain.
        theta: (M, N) joint angles with their offsets [rad], with the signs of Khoshzaban 1992.

    Returns:
        (end of chain minus ball (M, 3) in frame 0 [m], derivatives (M, 3, N) [m/rad]).
    """
    place, by = ball_position_and_derivatives(loop, 0, theta[:, 1:])
    ct, st = np.cos(theta[:, 0]), np.sin(theta[:, 0])
    turn = np.zeros((len(theta), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = ct, -st, st, ct, 1.0
    by = turn @ by[..., 0]
    return np.einsum("mij,mj->mi", turn, place) - loop.ball, by


def solve_closing_angles(
    loop: CalibrationLoop, theta: np.ndarray, free: Sequence[int], start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find the angles of three joints that close the chain, by Newton's method.

    Args:
        loop: the chain.
        theta: (M, N) angles with offsets [rad]; those of `free` are not used.
        free: indices of the three joints.
        start: (3,) start angles of the first pose, or (M, 3) of all poses, near the solution [rad].
            With (3,), each further pose starts from the last pose that closes.

    Returns:
        (theta (M, N) closed to 1e-9 m, reached (M,) whether each pose closes).
    """
    theta, free = theta.copy(), list(free)
    if np.ndim(start) == 2:
        theta[:, free] = start
        reached = _close_by_newton(loop, theta, free)
        return theta, reached
    reached = np.zeros(len(theta), dtype=bool)
    last = np.asarray(start, float)
    for row in range(len(theta)):
        one = theta[row : row + 1]
        one[:, free] = last
        reached[row] = _close_by_newton(loop, one, free)[0]
        if reached[row]:
            last = one[0, free]
    return theta, reached


def _close_by_newton(loop: CalibrationLoop, theta: np.ndarray, free: list[int]) -> np.ndarray:
    """Change the three angles `free` of theta (M, N) in place so that the chain ends at the ball.

    Returns:
        (M,) whether each row closes to 1e-9 m.
    """
    for _ in range(40):
        gap, by = closure_error(loop, theta)
        if np.abs(gap).max() < 1.0e-12:
            break
        slope = by[:, :, free]
        damped = slope.transpose(0, 2, 1) @ slope + 1.0e-14 * np.eye(3)
        step = -np.linalg.solve(damped, slope.transpose(0, 2, 1) @ gap[..., None])[..., 0]
        largest = np.abs(step).max(axis=1, keepdims=True)
        theta[:, free] += step * np.minimum(1.0, 0.3 / np.maximum(largest, 1.0e-300))
    gap, _ = closure_error(loop, theta)
    return np.abs(gap).max(axis=1) < 1.0e-9


def build_loop(machine: Machine) -> CalibrationLoop:
    """Build the closed chain of a machine with a calibrator from its links and joints.

    Args:
        machine: machine with `sensed_joints` and a closure between calibrator and chassis.

    Returns:
        The chain with the machine's nominal parameters.

    Raises:
        InputError: the machine has no such chain.
    """
    where = f"machine {machine.name}"
    if not machine.sensed_joints:
        message = "has no sensed_joints: use a machine with a calibrator, such as calibrator"
        raise InputError(where, message)
    last = machine.link_of(machine.sensed_joints[-1])
    ends = [
        (one, other) for c in machine.closures.values() for one, other in ((c.a, c.b), (c.b, c.a))
        if one.link == last
    ]  # fmt: skip
    if len(ends) != 1 or machine.links.get(ends[0][1].link) is not None:
        raise InputError(where, f"needs one closure between {last} and the world, the ball joint")
    end, ball = ends[0]
    chain, origin = [], {}
    for name in _ancestors(machine, last):
        link = machine.links[name]
        origin[name] = origin.get(link.parent, np.zeros(3)) + np.array(link.position)
        if link.joint:
            chain.append(name)
    joints = tuple(machine.links[name].joint.name for name in chain)  # pyright: ignore
    axes = {axis.joint: name for name, axis in machine.axes.items()}
    links = tuple(axes.get(joint, joint) for joint in joints)
    moved = joints.index(machine.sensed_joints[0])
    if joints[moved:] != machine.sensed_joints:
        raise InputError(where, "sensed_joints must be the last joints of the chain, in its order")
    if stray := [j for j in joints[:moved] if j not in axes]:
        raise InputError(where, f"{stray[0]} in the chain is neither driven nor sensed: lock it")
    ways = np.array([machine.joints[joint].axis for joint in joints])
    signs = np.sign(ways[np.arange(len(ways)), np.abs(ways).argmax(axis=1)])
    ways = ways * signs[:, None]
    points = np.array([origin[name] for name in chain])
    tip = origin[last] + np.array(end.position)
    angle = ways @ np.roll(ways, -1, axis=0).T
    parallel = np.array([np.arccos(min(1.0, abs(angle[k, k]))) < _MAX_PARALLEL_ANGLE
                         for k in range(len(ways) - 1)] + [False])  # fmt: skip
    values, base = _denavit_hartenberg(ways, points, tip, parallel)
    home = np.array([machine.home.get(joint, 0.0) for joint in joints]) * signs + values[:, 0]
    return CalibrationLoop(
        joints, tuple(f"angle.{link}" for link in links), links, signs, moved, values,
        np.array(ball.position) - base, base, parallel, home, machine.name,
    )  # fmt: skip


def _ancestors(machine: Machine, link: str) -> list[str]:
    chain = []
    while link != "world":
        chain.append(link)
        link = machine.links[link].parent
    return chain[::-1]


def _denavit_hartenberg(
    directions: np.ndarray, points: np.ndarray, tip: np.ndarray, parallel: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the D-H parameters (N, 5) of N joint axes, and the origin of frame 0 (3,) [m].

    The columns are offset, alpha, a, d, beta [rad] or [m].

    Args:
        directions: (N, 3) unit vectors of the axes in the machine's frame.
        points: (N, 3) points on the axes [m].
        tip: (3,) end of the chain, the ball [m].
        parallel: (N,) whether an axis is nominally parallel to the next one; then beta is used.
    """
    count = len(directions)
    values = np.zeros((count, 5))
    foot, _ = _common_normal_feet(points[0], directions[0], points[1], directions[1])
    base = foot
    frame = np.column_stack([*_perpendicular_axes(directions[0]), directions[0]])
    for k in range(count):
        z = directions[k]
        if k == count - 1:
            centre, along = tip, None
        elif parallel[k]:
            height = z @ (points[k + 1] - foot)  # as K: d keeps its nominal value
            nearby, along = points[k + 1], directions[k + 1]
            centre = nearby + along * ((foot + z * height - nearby) @ z) / (along @ z)
        else:
            on_this, centre = _common_normal_feet(points[k], z, points[k + 1], directions[k + 1])
            along = directions[k + 1]
        d = z @ (centre - foot)
        if along is not None and not parallel[k]:
            d = z @ (on_this - foot)
            x = np.cross(z, along)
            x /= np.linalg.norm(x)
            x *= np.sign(x[np.abs(x).argmax()])
            a = float(x @ (centre - on_this))
        else:
            x = centre - foot - z * d
            a = float(np.linalg.norm(x))
            x = x / a if a > 1.0e-12 else frame[:, 0]
        theta = np.arctan2(frame[:, 1] @ x, frame[:, 0] @ x)
        alpha = beta = 0.0
        middle = np.column_stack([x, np.cross(z, x), z])
        if along is not None:
            u = middle.T @ along  # = (sin b, -sin al cos b, cos al cos b)
            beta = float(np.arcsin(np.clip(u[0], -1.0, 1.0))) if parallel[k] else 0.0
            alpha = float(np.arctan2(-u[1], u[2]))
        values[k] = theta, alpha, a, d, beta
        rotation = chain_poses(link_chain(np.array([[0.0, alpha, 0.0, 0.0, beta]])), np.zeros((1, 1)))
        frame, foot = middle @ rotation.rotation[0], centre
    return values, base


def _perpendicular_axes(way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors perpendicular to a direction `way` and to each other.

    The first is the machine's x axis, projected on the plane perpendicular to `way` and normalised.
    If `way` is near the x axis, the z axis is projected instead.
    """
    x = np.array([1.0, 0.0, 0.0]) if abs(way[0]) < 0.9 else np.array([0.0, 0.0, 1.0])
    x = x - way * (way @ x)
    x /= np.linalg.norm(x)
    return x, np.cross(way, x)


def _common_normal_feet(p, u, q, v) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of the lines p + s u and q + t v that are closest to each other."""
    between, cosine = q - p, u @ v
    square = 1.0 - cosine**2
    s = (between @ u - cosine * (between @ v)) / square
    t = (cosine * (between @ u) - between @ v) / square
    return p + s * u, q + t * v


def solve_calibrator_angles(loop: CalibrationLoop, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the calibrator's three joint angles that put the chain's end at the ball.

    Newton's method solves the chain. It starts from the closed-form solution for a yoke, twist and
    elbow with axes that intersect at right angles, with an elbow angle within 90 deg of zero.

    Args:
        loop: the chain; its last three links are yoke, twist and elbow.
        theta: (M, N) angles with offsets; those of the last three joints are not used [rad].

    Returns:
        (theta (M, N) closed to 1e-9 m, reached (M,) whether each pose closes; the other rows of theta
        hold no solution).
    """
    theta = theta.copy()
    first = len(loop) - 3
    place, turn = frame_after_links(loop, first, theta)
    x, y, z = np.einsum("mji,mj->im", turn, loop.ball - place)
    upper, lower, aside = loop.values[-2, 3], loop.values[-1, 2], loop.values[-1, 3]
    sine = (x**2 + y**2 + z**2 - upper**2 - lower**2 - aside**2) / (2.0 * upper * lower)
    elbow = np.arcsin(np.clip(sine, -1.0, 1.0))
    across = lower * np.cos(elbow)
    phase, reach = np.arctan2(-aside, across), np.hypot(across, aside)
    possible = (np.abs(sine) <= 1.0) & (np.abs(z) <= reach)
    twist = np.arcsin(np.clip(-z / np.maximum(reach, 1.0e-12), -1.0, 1.0)) - phase
    along = across * np.cos(twist) + aside * np.sin(twist)
    yoke = np.arctan2(y, x) - np.arctan2(upper + lower * np.sin(elbow), along)
    theta[:, first:] = np.stack([(yoke + np.pi) % (2 * np.pi) - np.pi, twist, elbow], axis=1)
    closed = theta[possible]
    reached = possible.copy()
    if len(closed):
        reached[possible] = _close_by_newton(loop, closed, [first, first + 1, first + 2])
        theta[possible] = closed
    return theta, reached
