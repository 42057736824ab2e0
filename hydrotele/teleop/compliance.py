"""Remote centre of compliance: a levitated handle that acts as six independent springs.

A chosen point T follows its target in translation and the flotor follows its target in rotation.
Each axis is a separate second-order system, independent of the coupling by the flotor's inertia.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError

_WHERE = "compliance"
GRAVITY = (0.0, 0.0, -9.81)


@dataclass(frozen=True)
class Flotor:
    """Inertial parameters of the flotor, the moving part of a levitated joystick.

    They are expressed in the coils' frame, which is fixed to the flotor.

    Attributes:
        mass: mass [kg].
        centre_of_mass: (3,) position of the centre of mass [m].
        inertia: (3, 3) about the centre of mass [kg m^2].
    """

    mass: float
    centre_of_mass: np.ndarray
    inertia: np.ndarray

    def __post_init__(self) -> None:
        """Raise InputError if mass and moments of inertia are not physical."""
        values = np.linalg.eigvalsh(self.inertia)
        if not (self.mass > 0.0 and values[0] > 0.0 and values[2] <= values[0] + values[1] + 1e-12):
            raise InputError(_WHERE, f"mass {self.mass} kg and moments {values} are not physical")


@dataclass(frozen=True)
class AxisDynamics:
    """Designed second-order responses of the handle's three translations and three rotations.

    Attributes:
        frequency: (6,) natural frequencies [rad/s].
        damping_ratio: (6,) damping ratios [1].
    """

    frequency: np.ndarray
    damping_ratio: np.ndarray

    def __post_init__(self) -> None:
        """Raise InputError unless all frequencies and damping ratios are positive."""
        for name in ("frequency", "damping_ratio"):
            values = np.asarray(getattr(self, name), float)
            if values.shape != (6,) or not np.all(values > 0.0):
                raise InputError(_WHERE, f"{name} needs six positive values, got {values}")


@dataclass(frozen=True)
class FlotorMotion:
    """Pose and velocity of the flotor.

    Attributes:
        position: (3,) position of the coils' frame (its origin), world axes [m].
        quaternion: (4,) orientation, coils' frame to world, scalar first.
        velocity: (3,) velocity of that origin, world axes [m/s].
        angular_velocity: (3,) angular velocity, in the axes of the coils' frame [rad/s].
    """

    position: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray


@compiled
def quaternion_to_matrix(q, out):
    """Convert a unit quaternion to a rotation matrix, body to world axes.

    Args:
        q: (4,) orientation of the body, scalar first.
        out: (3, 3) rotation matrix, written.

    Returns:
        Nothing.

    Source: definition of the unit quaternion.
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0, 0], out[0, 1], out[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@compiled
def free_flotor_wrench(
    mass,
    arm,
    inertia,
    centre_of_mass,
    acceleration,
    angular_acceleration,
    rotation,
    rate,
    gravity,
    out,
):
    """Compute the coil wrench that gives a free flotor the specified accelerations (inverse dynamics).

    Args:
        mass: mass of the flotor, scalar [kg].
        arm: (3,) centre of mass relative to the handle's point, flotor axes [m].
        inertia: (3, 3) about the centre of mass [kg m^2].
        centre_of_mass: (3,) centre of mass relative to the coils' frame, flotor axes [m].
        acceleration: (3,) acceleration of the handle's point, world axes [m/s^2].
        angular_acceleration: (3,) angular acceleration, flotor axes [rad/s^2].
        rotation: (3, 3) rotation matrix, flotor to world.
        rate: (3,) angular velocity, flotor axes [rad/s].
        gravity: (3,) acceleration of gravity, world axes [m/s^2].
        out: (6,) written: force [N] and torque about the origin of the coils' frame [N m], flotor
            axes.

    Returns:
        Nothing.

    Source: Newton and Euler; Zhu 1994, 5.1.3 (moved from the handle over the centre of mass).
    """
    w0, w1, w2 = rate[0], rate[1], rate[2]
    # centripetal and tangential acceleration of the centre of mass relative to the handle's point
    s0, s1, s2 = w1 * arm[2] - w2 * arm[1], w2 * arm[0] - w0 * arm[2], w0 * arm[1] - w1 * arm[0]
    d0 = angular_acceleration[1] * arm[2] - angular_acceleration[2] * arm[1] + w1 * s2 - w2 * s1
    d1 = angular_acceleration[2] * arm[0] - angular_acceleration[0] * arm[2] + w2 * s0 - w0 * s2
    d2 = angular_acceleration[0] * arm[1] - angular_acceleration[1] * arm[0] + w0 * s1 - w1 * s0
    for i in range(3):
        own = d0 if i == 0 else (d1 if i == 1 else d2)
        drawn = 0.0
        for j in range(3):
            drawn += rotation[j, i] * (acceleration[j] - gravity[j])
        out[i] = mass * (drawn + own)
    m0 = inertia[0, 0] * w0 + inertia[0, 1] * w1 + inertia[0, 2] * w2
    m1 = inertia[1, 0] * w0 + inertia[1, 1] * w1 + inertia[1, 2] * w2
    m2 = inertia[2, 0] * w0 + inertia[2, 1] * w1 + inertia[2, 2] * w2
    for i in range(3):
        out[3 + i] = 0.0
        for j in range(3):
            out[3 + i] += inertia[i, j] * angular_acceleration[j]
    out[3] += w1 * m2 - w2 * m1 + centre_of_mass[1] * out[2] - centre_of_mass[2] * out[1]
    out[4] += w2 * m0 - w0 * m2 + centre_of_mass[2] * out[0] - centre_of_mass[0] * out[2]
    out[5] += w0 * m1 - w1 * m0 + centre_of_mass[0] * out[1] - centre_of_mass[1] * out[0]


@compiled
def held_flotor_wrench(mass, centre_of_mass, handle, push, rotation, gravity, out):
    """Compute the coil wrench that applies a force at the handle and carries the flotor's weight.

    Use it while a hand holds the handle: a spring made this way does not rotate the flotor when the
    hand pushes straight. A wrench for a free flotor (`free_flotor_wrench`) acts through the centre of
    mass.

    Args:
        mass: mass of the flotor, scalar [kg].
        centre_of_mass: (3,) centre of mass relative to the coils' frame, flotor axes [m].
        handle: (3,) handle's point relative to the coils' frame, flotor axes [m].
        push: (6,) force at the handle, world axes [N], and torque, flotor axes [N m].
        rotation: (3, 3) rotation matrix, flotor to world.
        gravity: (3,) acceleration of gravity, world axes [m/s^2].
        out: (6,) written: force [N] and torque about the origin of the coils' frame [N m], flotor
            axes.

    Returns:
        Nothing.

    Source: statics; Zhu 1994, 5.1.3 (forces moved to the coils' frame).
    """
    lift, own = np.empty(3), np.empty(3)
    for i in range(3):
        lift[i], own[i] = 0.0, 0.0
        for j in range(3):
            lift[i] -= mass * rotation[j, i] * gravity[j]
            own[i] += rotation[j, i] * push[j]
        out[i] = lift[i] + own[i]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[3 + i] = push[3 + i] + centre_of_mass[j] * lift[k] - centre_of_mass[k] * lift[j]
        out[3 + i] += handle[j] * own[k] - handle[k] * own[j]


def compliance_wrench(
    flotor: Flotor, axes: AxisDynamics, centre: np.ndarray, motion: FlotorMotion, target: np.ndarray,
    target_rotation: np.ndarray, gravity: Sequence[float] = GRAVITY,
) -> np.ndarray:  # fmt: skip
    """Compute the coil wrench with which the handle moves to its target like six decoupled springs.

    The position of a point T of the flotor and the orientation of the flotor approach their targets
    as six independent second-order systems.

    Args:
        flotor: inertial parameters of the moving part.
        axes: natural frequencies and damping ratios of the six systems.
        centre: (3,) point T in the coils' frame [m].
        motion: pose and velocity of the flotor.
        target: (3,) reference position of T, world axes [m].
        target_rotation: (4,) reference orientation of the flotor, quaternion, scalar first.
        gravity: (3,) acceleration of gravity, world axes [m/s^2].

    Returns:
        (6,) force [N] and torque about the origin of the coils' frame [N m], in that frame's axes.

    Source: Zhu 1994, 5.1.3 (Euler quaternions; forces moved from T over the centre of mass to the
    coils' frame).
    """
    spring, damper = axes.frequency**2, 2.0 * axes.damping_ratio * axes.frequency
    turn, w, out = np.empty((3, 3)), motion.angular_velocity, np.empty(6)
    quaternion_to_matrix(motion.quaternion, turn)
    place = motion.position + turn @ centre
    speed = motion.velocity + turn @ np.cross(w, centre)
    wanted = spring[:3] * (target - place) - damper[:3] * speed
    scalar, vector = relative_quaternion(target_rotation, motion.quaternion)
    vector_rate = 0.5 * (scalar * w + np.cross(vector, w))
    scalar_rate = -0.5 * vector @ w
    swing = -spring[3:] * vector - damper[3:] * vector_rate
    swing -= 0.5 * (scalar_rate * w + np.cross(vector_rate, w))
    about = np.linalg.solve(0.5 * (scalar * np.eye(3) + _skew_matrix(vector)), swing)
    below = np.asarray(flotor.centre_of_mass, float)
    free_flotor_wrench(
        flotor.mass, below - centre, np.asarray(flotor.inertia, float), below, wanted, about, turn,
        w, np.asarray(gravity, float), out,
    )  # fmt: skip
    return out


def _skew_matrix(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def relative_quaternion(first: np.ndarray, then: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the quaternion of the rotation from one orientation to another, by at most 180 degrees.

    Args:
        first: (4,) initial orientation, quaternion, scalar first.
        then: (4,) final orientation, quaternion, scalar first.

    Returns:
        Scalar part, at least 0, and (3,) vector part of the quaternion. The vector has the same
        components in the axes of both orientations.

    Source: Zhu 1994, 5.1.3 (Euler quaternions).
    """
    a, b = np.asarray(first, float), np.asarray(then, float)
    scalar = float(a @ b)
    vector = a[0] * b[1:] - b[0] * a[1:] - np.cross(a[1:], b[1:])
    return (scalar, vector) if scalar >= 0.0 else (-scalar, -vector)
