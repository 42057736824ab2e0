"""Optical sensing of a levitated flotor: three light beams on three two-axis diodes give its pose.

Beams leave the flotor's centre at 120 degrees in one plane; each meets a position-sensing diode on
the stator, which tells where: sideways and up. Six readings make the six numbers of a pose.
"""

import numpy as np

from hydrotele.core.errors import InputError

_WHERE = "optical sensing"
_ENOUGH, _MOST = 1e-12, 20  # m and rad of a Newton step; 4 steps do within the stops
_ANGLES = np.pi * np.array([1.0, 3.0, 5.0]) / 3.0  # between the three stations of the coils
_OUT = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(3)])
_ASIDE = np.column_stack([-np.sin(_ANGLES), np.cos(_ANGLES), np.zeros(3)])
_UP = np.array([0.0, 0.0, 1.0])


def diode_readings(place: np.ndarray, turn: np.ndarray, distance: float) -> np.ndarray:
    """Where the beams meet the diodes.

    Args:
        place: (3,) of the flotor's centre from its nominal place [m].
        turn: (3, 3) rotation matrix, flotor to stator.
        distance: of the diodes from the centre [m].

    Returns:
        (6,) readings, sideways and up of one diode after the other [m].

    Raises:
        InputError: a beam leaves its diode's side.

    Source: Zhu 1994, 5.1.2 (coplanar radial beams at 120 degrees); geometry of a line and a plane.

    >>> import numpy as np
    >>> readings = diode_readings(np.array([0.0, 0.0, 1e-3]), np.eye(3), 0.0573)
    >>> readings[1::2].tolist()
    [0.001, 0.001, 0.001]
    """
    return _meet(np.asarray(place, float), turn, distance)[0]


def pose_of_readings(readings: np.ndarray, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the flotor from the six readings, by Newton's method from the centre.

    Args:
        readings: (6,) as of `diode_readings` [m].
        distance: of the diodes from the centre [m].

    Returns:
        Place (3,) [m] and rotation matrix (3, 3), flotor to stator; NaN where a reading is no
        number.

    Raises:
        InputError: no pose makes these readings.

    Source: `diode_readings`; Newton.
    """
    place, turn = np.zeros(3), np.eye(3)
    if not np.isfinite(readings).all():
        return np.full(3, np.nan), np.full((3, 3), np.nan)
    for _ in range(_MOST):
        now, slope = _meet(place, turn, distance)
        step = np.linalg.solve(slope, readings - now)
        place, turn = place + step[:3], _rotation(step[3:]) @ turn
        if np.abs(step).max() < _ENOUGH:
            return place, turn
    raise InputError(_WHERE, f"no pose makes the readings {readings}")


def sensed_spread(distance: float, step: float) -> np.ndarray:
    """What a step of the diodes leaves unknown of the pose at the centre.

    Args:
        distance: of the diodes from the centre [m].
        step: of their readings [m].

    Returns:
        (6,) standard deviations of place [m] and rotation [rad], for errors even over a step.

    Source: linear propagation through `diode_readings`.
    """
    _, slope = _meet(np.zeros(3), np.eye(3), distance)
    inverse = np.linalg.inv(slope)
    return step / np.sqrt(12.0) * np.sqrt(np.sum(inverse**2, axis=1))


def _meet(place, turn, distance) -> tuple[np.ndarray, np.ndarray]:
    """Readings (6,) and their derivatives (6, 6) by place and by a small turn of the stator's."""
    readings, slope = np.empty(6), np.empty((6, 6))
    for k, (out, aside) in enumerate(zip(_OUT, _ASIDE, strict=True)):
        beam = turn @ out
        along = float(out @ beam)
        far = distance - float(out @ place)
        if not (along > 0.0 and far > 0.0):
            raise InputError(_WHERE, f"the beam of diode {k + 1} misses its side of the stator")
        length = far / along
        spot = place + length * beam
        for j, axis in enumerate((aside, _UP)):
            row = 2 * k + j
            readings[row] = axis @ spot
            slope[row, :3] = axis - out * (axis @ beam) / along
            slope[row, 3:] = length * np.cross(beam, slope[row, :3])
    return readings, slope


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle > 0.0 else vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
