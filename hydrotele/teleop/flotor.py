"""Mass, centre of gravity and inertia of a levitated flotor from its own motion and currents.

The coils push the flotor with a known wrench, the sensors tell where it is: Newton and Euler in the
coils' frame are linear in ten numbers. Both sides go through the same filter.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from hydrotele.core.errors import InputError
from hydrotele.identify.estimation import estimate
from hydrotele.teleop.coils import Coils
from hydrotele.teleop.compliance import GRAVITY, Flotor, rotation_between, turn_matrix

NAMES = ("mass", "com_x", "com_y", "com_z", "i_xx", "i_yy", "i_zz", "i_xy", "i_xz", "i_yz")
_WHERE = "flotor"
_CUTOFF = 12.0  # Hz, twice the fastest tone of an excitation; differences make noise above it
_SETTLE = 0.5  # s at either end, where the filter has no past or future
_FROM_LIST = ((0, 3, 4), (3, 1, 5), (4, 5, 2))  # xx yy zz xy xz yz as a matrix
_LEFT = 0.2  # of a force or torque: with more left over, noise was fitted
_SIGMAS = 1.96
_HELD = 1e-3  # what differences over held periods leave of accelerations at 6 Hz: (w dt)^2 / 36


@dataclass(frozen=True)
class FlotorFit:
    """The ten numbers that were found, in the coils' frame; order of NAMES.

    Attributes:
        value: (10,) mass [kg], centre of mass [m], inertia about it [kg m^2].
        interval: (10,) half widths of the 95 % intervals.
        residual: (6,) root mean squares of force [N] and torque [N m] that are left.
        condition: of the scaled equations.
        rows: number of instants.
    """

    value: np.ndarray
    interval: np.ndarray
    residual: np.ndarray
    condition: float
    rows: int

    def body(self) -> Flotor:
        """For the control.

        Raises:
            InputError: no body can have these numbers.
        """
        return Flotor(float(self.value[0]), self.value[1:4].copy(), _matrix(self.value[4:]))


def identify_flotor(
    place: np.ndarray, quaternion: np.ndarray, currents: np.ndarray, period: float, coils: Coils,
    cutoff: float = _CUTOFF,
) -> FlotorFit:  # fmt: skip
    """Least squares over a motion that turns and moves all axes.

    Args:
        place: (n, 3) of the coils' frame [m].
        quaternion: (n, 4) of its orientation, scalar first.
        currents: (n, 6) held from each reading until the next [A].
        period: of the readings [s].
        coils: their map and place define frame and wrench.
        cutoff: of the filter [Hz].

    Returns:
        The fit. Its intervals count noise, which follows itself in time, and what differences over
        held periods leave (1e-3 of the flotor's size, 1e-6 of its mass, which gravity tells); not a
        wrong map of the coils.

    Raises:
        InputError: too short, readings that are no numbers, or a motion that does not tell all ten.

    Source: Newton and Euler about a point of the body; Atkeson, An and Hollerbach 1986 (linear in
    ten parameters); Zhu 1994, 5.1.3 (the joystick was identified so).
    """
    ends = round(_SETTLE / period)
    if len(place) < 4 * ends:
        raise InputError(_WHERE, f"needs at least {4 * _SETTLE:g} s, got {len(place) * period:g} s")
    if not all(np.isfinite(part).all() for part in (place, quaternion, currents)):
        raise InputError(_WHERE, "readings and currents must be numbers: leave out faulty parts")
    matrix, wrench = flotor_equations(place, quaternion, currents, period, coils)
    low = butter(4, cutoff, fs=1.0 / period, output="sos")
    every = max(1, int(0.25 / (cutoff * period)))  # rows beyond twice the cutoff tell nothing new
    kept = slice(ends, -ends, every)
    matrix, wrench = (sosfiltfilt(low, part, axis=0)[kept] for part in (matrix, wrench))
    moving = np.sqrt(np.sum(matrix**2, axis=(0, 1))).all()
    found = estimate(matrix, wrench) if moving else None
    if found is None or (np.std(found.residual, axis=0) > _LEFT * np.std(wrench, axis=0)).any():
        raise InputError(_WHERE, "this motion does not tell all ten numbers: turn about every axis")
    value, slope = _about_centre(found.value)
    noise = np.diag(slope @ found.covariance @ slope.T)
    interval = np.hypot(_SIGMAS * np.sqrt(noise), _of_differences(value))
    return FlotorFit(
        value, interval, np.sqrt(np.mean(found.residual**2, axis=0)),
        found.condition, len(wrench),
    )  # fmt: skip


def flotor_equations(
    place: np.ndarray, quaternion: np.ndarray, currents: np.ndarray, period: float, coils: Coils
) -> tuple[np.ndarray, np.ndarray]:
    """Newton and Euler of a body that is pushed by held wrenches, at the inner readings.

    Between readings the wrench is constant; a second difference of places is then the mean of the
    two accelerations around a reading, and goes with the mean of the two wrenches.

    Args:
        place: (n, 3) of the coils' frame [m].
        quaternion: (n, 4) scalar first.
        currents: (n, 6) [A].
        period: [s].
        coils: the coils.

    Returns:
        Regressor (n - 2, 6, 10) of mass, first moments [kg m] and inertia about the coils' frame
        [kg m^2] (xx, yy, zz, xy, xz, yz), and wrench (n - 2, 6) [N], [N m].

    Source: see `identify_flotor`.
    """
    pairs = zip(quaternion[:-1], quaternion[1:], strict=True)
    between = np.array([_turning(a, b) for a, b in pairs]) / period
    spin, swing = 0.5 * (between[1:] + between[:-1]), np.diff(between, axis=0) / period
    lift = (place[2:] - 2.0 * place[1:-1] + place[:-2]) / period**2 - np.array(GRAVITY)
    turn = np.empty((len(spin), 3, 3))
    for q, out in zip(quaternion[1:-1], turn, strict=True):
        turn_matrix(q, out)
    lift = np.einsum("nij,ni->nj", turn, lift)
    matrix = np.zeros((len(spin), 6, 10))
    matrix[:, :3, 0] = lift
    matrix[:, :3, 1:4] = _cross(swing) + _cross(spin) @ _cross(spin)
    matrix[:, 3:, 1:4] = -_cross(lift)
    matrix[:, 3:, 4:] = _of_inertia(swing) + _cross(spin) @ _of_inertia(spin)
    held = currents @ coils.wrench_map.T
    return matrix, 0.5 * (held[:-2] + held[1:-1])


def _of_differences(value: np.ndarray) -> np.ndarray:
    """Errors (10,) of differences over held periods, for tones up to 6 Hz at 200 Hz."""
    moment = value[4:7].sum() / 2.0
    radius = float(np.sqrt(moment / value[0]))
    return _HELD * np.array([1e-3 * value[0], *[radius] * 3, *[moment] * 6])


def _turning(first: np.ndarray, then: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) between two orientations, in the body's axes [rad]."""
    scalar, vector = rotation_between(first, then)
    size = float(np.linalg.norm(vector))
    return vector * (2.0 * np.arctan2(size, scalar) / size if size > 1e-12 else 2.0)


def _cross(v: np.ndarray) -> np.ndarray:
    """(n, 3, 3) that make cross products with (n, 3)."""
    out = np.zeros((len(v), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, k, j], out[:, j, k] = v[:, i], -v[:, i]
    return out


def _of_inertia(v: np.ndarray) -> np.ndarray:
    """(n, 3, 6) so that it times xx, yy, zz, xy, xz, yz is the inertia times v (n, 3)."""
    out = np.zeros((len(v), 3, 6))
    for row, places in enumerate(_FROM_LIST):
        for column, place in enumerate(places):
            out[:, row, place] = v[:, column]
    return out


def _matrix(six: np.ndarray) -> np.ndarray:
    return np.array([[six[k] for k in places] for places in _FROM_LIST])


def _about_centre(linear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """From first moments and inertia about the coils to centre and inertia about it: value, slope.

    The slope (10, 10) is that of the value by the linear numbers, by central differences.
    """

    def moved(p: np.ndarray) -> np.ndarray:
        centre = p[1:4] / p[0]
        parallel = p[0] * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        inertia = _matrix(p[4:]) - parallel
        upper = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        return np.concatenate([p[:1], centre, upper])

    steps = 1e-6 * np.diag(np.maximum(np.abs(linear), 1e-6))
    slope = [(moved(linear + d) - moved(linear - d)) / (2.0 * d.sum()) for d in steps]
    return moved(linear), np.column_stack(slope)
