"""Optical pose sensing of a levitated joystick: three light beams on three two-axis position-sensing diodes.

The beams leave the flotor's centre at 120 degrees in one plane. Each meets a diode on the stator,
which measures its lateral and vertical position. Six readings determine the six coordinates of a
pose.
"""

import numpy as np

from hydrotele.core.errors import InputError

_WHERE = "optical sensing"
_NEWTON_TOLERANCE, _MAX_NEWTON_STEPS = (
    1e-12,
    20,
)  # tolerance [m], [rad], maximum Newton steps; 4 suffice in the range
_BEAM_ANGLES = np.pi * np.array([1.0, 3.0, 5.0]) / 3.0  # halfway between the stations of the coils
_BEAM_DIRECTIONS = np.column_stack([np.cos(_BEAM_ANGLES), np.sin(_BEAM_ANGLES), np.zeros(3)])
_LATERAL_DIRECTIONS = np.column_stack([-np.sin(_BEAM_ANGLES), np.cos(_BEAM_ANGLES), np.zeros(3)])
_VERTICAL_DIRECTION = np.array([0.0, 0.0, 1.0])


def diode_readings(place: np.ndarray, turn: np.ndarray, distance: float) -> np.ndarray:
    """Return the positions at which the flotor's three light beams meet the diodes of the stator.

    Args:
        place: (3,) displacement of the flotor's centre from its nominal position [m].
        turn: (3, 3) rotation matrix, flotor to stator.
        distance: distance of the diodes from the centre [m].

    Returns:
        (6,) readings: lateral and vertical position on the first, second and third diode [m].

    Raises:
        InputError: a beam does not reach its diode's side.

    Source: Zhu 1994, 5.1.2 (coplanar radial beams at 120 degrees); geometry of a line and a plane.

    >>> import numpy as np
    >>> readings = diode_readings(np.array([0.0, 0.0, 1e-3]), np.eye(3), 0.0573)
    >>> readings[1::2].tolist()
    [0.001, 0.001, 0.001]
    """
    return _trace_beams(np.asarray(place, float), turn, distance)[0]


def solve_flotor_pose(readings: np.ndarray, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the flotor's pose from the six diode readings, by Newton's method from the centre.

    Args:
        readings: (6,) lateral and vertical position on each of the three diodes [m].
        distance: distance of the diodes from the centre [m].

    Returns:
        Position (3,) [m] and rotation matrix (3, 3), flotor to stator; NaN if a reading is not
        finite.

    Raises:
        InputError: no pose corresponds to these readings.

    Source: inverse of `diode_readings` by Newton's method.
    """
    place, turn = np.zeros(3), np.eye(3)
    if not np.isfinite(readings).all():
        return np.full(3, np.nan), np.full((3, 3), np.nan)
    for _ in range(_MAX_NEWTON_STEPS):
        now, slope = _trace_beams(place, turn, distance)
        step = np.linalg.solve(slope, readings - now)
        place, turn = place + step[:3], _rotation_vector_to_matrix(step[3:]) @ turn
        if np.abs(step).max() < _NEWTON_TOLERANCE:
            return place, turn
    raise InputError(_WHERE, f"no pose corresponds to the readings {readings}")


def pose_resolution(distance: float, reading_resolution: float) -> np.ndarray:
    """Return the standard deviations of a pose measured with diodes of finite resolution.

    They hold for a flotor at its centre.

    Args:
        distance: distance of the diodes from the centre [m].
        reading_resolution: resolution of their readings [m].

    Returns:
        (6,) standard deviations of position [m] and rotation [rad], for errors that are uniform
        over a step.

    Source: linear propagation through `diode_readings`.
    """
    _, slope = _trace_beams(np.zeros(3), np.eye(3), distance)
    inverse = np.linalg.inv(slope)
    return reading_resolution / np.sqrt(12.0) * np.sqrt(np.sum(inverse**2, axis=1))


def _trace_beams(place, turn, distance) -> tuple[np.ndarray, np.ndarray]:
    """Return the diode readings (6,) [m] of a pose, and their Jacobian (6, 6).

    `place` (3,) [m] and `turn` (3, 3) are displacement and rotation matrix of the flotor.
    `distance` is the distance of the diodes from the centre [m]. The Jacobian's columns are the
    derivatives by the position and by a small rotation about the stator's axes. Raise InputError if
    a beam misses its diode's side.
    """
    readings, slope = np.empty(6), np.empty((6, 6))
    for k, (out, aside) in enumerate(zip(_BEAM_DIRECTIONS, _LATERAL_DIRECTIONS, strict=True)):
        beam = turn @ out
        along = float(out @ beam)
        far = distance - float(out @ place)
        if not (along > 0.0 and far > 0.0):
            raise InputError(_WHERE, f"the beam of diode {k + 1} misses its side of the stator")
        length = far / along
        spot = place + length * beam
        for j, axis in enumerate((aside, _VERTICAL_DIRECTION)):
            row = 2 * k + j
            readings[row] = axis @ spot
            slope[row, :3] = axis - out * (axis @ beam) / along
            slope[row, 3:] = length * np.cross(beam, slope[row, :3])
    return readings, slope


def _rotation_vector_to_matrix(vector: np.ndarray) -> np.ndarray:
    """Convert a rotation vector (3,) [rad] to a rotation matrix (3, 3) by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle > 0.0 else vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
