"""Remote centre of compliance: a levitated handle as six independent springs about a chosen point.

The chosen point T follows its target in translation, and the flotor its target in rotation, each
axis as a second-order system of its own, whatever the flotor's inertia couples.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.errors import InputError

_WHERE = "compliance"
GRAVITY = (0.0, 0.0, -9.81)


@dataclass(frozen=True)
class Flotor:
    """The moving part, in the coils' frame, which is fixed to it.

    Attributes:
        mass: [kg].
        centre_of_mass: (3,) [m].
        inertia: (3, 3) about the centre of mass [kg m^2].
    """

    mass: float
    centre_of_mass: np.ndarray
    inertia: np.ndarray

    def __post_init__(self) -> None:
        """Refuse bodies that cannot exist."""
        values = np.linalg.eigvalsh(self.inertia)
        if not (self.mass > 0.0 and values[0] > 0.0 and values[2] <= values[0] + values[1] + 1e-12):
            raise InputError(_WHERE, f"no body has the mass {self.mass} kg and moments {values}")


@dataclass(frozen=True)
class Axes:
    """Second-order systems of the three translations and the three rotations.

    Attributes:
        frequency: (6,) natural frequencies [rad/s].
        ratio: (6,) damping ratios [1].
    """

    frequency: np.ndarray
    ratio: np.ndarray

    def __post_init__(self) -> None:
        """Refuse what is no spring and damper."""
        for name in ("frequency", "ratio"):
            values = np.asarray(getattr(self, name), float)
            if values.shape != (6,) or not np.all(values > 0.0):
                raise InputError(_WHERE, f"{name} needs six positive numbers, got {values}")


@dataclass(frozen=True)
class Motion:
    """Pose and velocity of the flotor.

    Attributes:
        position: (3,) of the coils' frame [m].
        quaternion: (4,) of its orientation, scalar first.
        velocity: (3,) of its origin [m/s].
        rate: (3,) of its turning, in its own axes [rad/s].
    """

    position: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    rate: np.ndarray


def compliance_wrench(
    flotor: Flotor, axes: Axes, centre: np.ndarray, motion: Motion, target: np.ndarray,
    turned: np.ndarray, gravity: Sequence[float] = GRAVITY,
) -> np.ndarray:  # fmt: skip
    """Wrench that makes the handle behave so.

    Args:
        flotor: the moving part.
        axes: the six second-order systems.
        centre: T in the coils' frame (3,) [m].
        motion: of the flotor.
        target: where T should be (3,) [m].
        turned: quaternion (4,) of the orientation that it should have, scalar first.
        gravity: (3,) [m/s^2].

    Returns:
        (6,) force [N] and torque about the coils' frame [N m], in that frame's axes.

    Source: Zhu 1994, 5.1.3 (Euler quaternions, forces moved from T over the centre of mass to F).
    """
    spring, damper = axes.frequency**2, 2.0 * axes.ratio * axes.frequency
    turn, w = _matrix(motion.quaternion), motion.rate
    place = motion.position + turn @ centre
    speed = motion.velocity + turn @ np.cross(w, centre)
    wanted = spring[:3] * (target - place) - damper[:3] * speed
    scalar, vector = _apart(turned, motion.quaternion)
    vector_rate = 0.5 * (scalar * w + np.cross(vector, w))
    scalar_rate = -0.5 * vector @ w
    swing = -spring[3:] * vector - damper[3:] * vector_rate
    swing -= 0.5 * (scalar_rate * w + np.cross(vector_rate, w))
    about = np.linalg.solve(0.5 * (scalar * np.eye(3) + _cross(vector)), swing)
    arm = flotor.centre_of_mass - centre
    drawn = wanted + turn @ (np.cross(about, arm) + np.cross(w, np.cross(w, arm)))
    force = turn.T @ (flotor.mass * (drawn - np.asarray(gravity)))
    torque = flotor.inertia @ about + np.cross(w, flotor.inertia @ w)
    return np.concatenate([force, torque + np.cross(flotor.centre_of_mass, force)])


def _matrix(q: np.ndarray) -> np.ndarray:
    w, v = q[0], np.asarray(q[1:])
    return np.eye(3) + 2.0 * (w * _cross(v) + _cross(v) @ _cross(v))


def _cross(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _apart(target: np.ndarray, now: np.ndarray) -> tuple[float, np.ndarray]:
    """Scalar and vector part of the rotation from the target to now, the shorter way."""
    a, b = np.asarray(target, float), np.asarray(now, float)
    scalar = float(a @ b)
    vector = a[0] * b[1:] - b[0] * a[1:] - np.cross(a[1:], b[1:])
    return (scalar, vector) if scalar >= 0.0 else (-scalar, -vector)
