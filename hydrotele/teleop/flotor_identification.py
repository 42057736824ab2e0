"""Identification of mass, centre of mass and inertia of a levitated flotor from its own motion.

The coils apply a known wrench and the sensors measure the pose. The Newton-Euler equations in the
coils' frame are linear in ten parameters. Both sides pass through the same filter.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from hydrotele.core.errors import InputError
from hydrotele.identify.linear_least_squares import estimate_linear_parameters
from hydrotele.teleop.coils import Coils
from hydrotele.teleop.compliance import GRAVITY, Flotor, quaternion_to_matrix, relative_quaternion

FLOTOR_PARAMETERS = (
    "mass",
    "com_x",
    "com_y",
    "com_z",
    "i_xx",
    "i_yy",
    "i_zz",
    "i_xy",
    "i_xz",
    "i_yz",
)
_WHERE = "flotor"
_CUTOFF = 12.0  # Hz, twice the fastest excitation tone; differentiation amplifies noise above it
_SETTLING_TIME = 0.5  # s that are discarded at both ends because of filter transients
_INERTIA_INDICES = ((0, 3, 4), (3, 1, 5), (4, 5, 2))  # indices of xx yy zz xy xz yz in a matrix
_MAX_RESIDUAL_RATIO = 0.2  # maximum residual relative to the wrench; above it the fit only follows noise
_CONFIDENCE_SIGMAS = 1.96
_DIFFERENCE_ERROR = 1e-3  # relative error of difference quotients at 6 Hz: (w dt)^2 / 36


@dataclass(frozen=True)
class FlotorFit:
    """Identified mass, centre of mass and inertia of the flotor, with their uncertainty.

    The coils' frame is used; `FLOTOR_PARAMETERS` gives names and order of the ten parameters.

    Attributes:
        value: (10,) mass [kg], centre of mass [m], inertia about it [kg m^2].
        interval_half_width: (10,) half widths of the 95 % confidence intervals.
        residual: (6,) root mean square residuals of force [N] and torque [N m].
        condition: condition number of the scaled equations.
        sample_count: number of samples in the fit.
    """

    value: np.ndarray
    interval_half_width: np.ndarray
    residual: np.ndarray
    condition: float
    sample_count: int

    def to_flotor(self) -> Flotor:
        """Convert the identified parameters to the flotor model that the control uses.

        Raises:
            InputError: the parameters are not physical.
        """
        return Flotor(float(self.value[0]), self.value[1:4].copy(), _inertia_matrix(self.value[4:]))


def identify_flotor_parameters(
    place: np.ndarray, quaternion: np.ndarray, currents: np.ndarray, period: float, coils: Coils,
    cutoff: float = _CUTOFF,
) -> FlotorFit:  # fmt: skip
    """Identify mass, centre of mass and inertia of the flotor by least squares.

    The recorded motion must excite all axes.

    Args:
        place: (n, 3) position of the coils' frame [m].
        quaternion: (n, 4) orientation of the frame, scalar first.
        currents: (n, 6) coil currents, held from each sample until the next [A].
        period: sampling period [s].
        coils: coils; their map and position define frame and wrench.
        cutoff: cutoff frequency of the low-pass filter of motion and wrench [Hz].

    Returns:
        The fit. Its confidence intervals include correlated noise and the error of difference
        quotients (1e-3 of the flotor's radius of gyration, 1e-6 of its mass). They do not include
        errors of the coils' map.

    Raises:
        InputError: the record is too short, has invalid samples, or its motion does not make all
            ten parameters identifiable.

    Source: Newton and Euler about a point of the body; Atkeson, An and Hollerbach 1986 (linear in
    ten parameters); Zhu 1994, 5.1.3 (the joystick was identified so).
    """
    ends = round(_SETTLING_TIME / period)
    if len(place) < 4 * ends:
        raise InputError(_WHERE, f"needs at least {4 * _SETTLING_TIME:g} s, got {len(place) * period:g} s")
    if not all(np.isfinite(part).all() for part in (place, quaternion, currents)):
        raise InputError(_WHERE, "poses and currents must be finite: remove faulty samples")
    matrix, wrench = build_flotor_regression(place, quaternion, currents, period, coils)
    low = butter(4, cutoff, fs=1.0 / period, output="sos")
    every = max(1, int(0.25 / (cutoff * period)))  # faster sampling adds no information
    kept = slice(ends, -ends, every)
    matrix, wrench = (sosfiltfilt(low, part, axis=0)[kept] for part in (matrix, wrench))
    moving = np.sqrt(np.sum(matrix**2, axis=(0, 1))).all()
    found = estimate_linear_parameters(matrix, wrench) if moving else None
    if found is None or (np.std(found.residual, axis=0) > _MAX_RESIDUAL_RATIO * np.std(wrench, axis=0)).any():
        raise InputError(_WHERE, "not all ten parameters are identifiable: rotate about every axis")
    value, slope = _move_to_centre_of_mass(found.value)
    noise = np.diag(slope @ found.covariance @ slope.T)
    interval = np.hypot(_CONFIDENCE_SIGMAS * np.sqrt(noise), _differentiation_errors(value))
    return FlotorFit(
        value, interval, np.sqrt(np.mean(found.residual**2, axis=0)),
        found.condition, len(wrench),
    )  # fmt: skip


def build_flotor_regression(
    place: np.ndarray, quaternion: np.ndarray, currents: np.ndarray, period: float, coils: Coils
) -> tuple[np.ndarray, np.ndarray]:
    """Build the linear equations of motion of the flotor, `regressor @ parameters = wrench`.

    The wrench is constant between samples. A second difference of positions is therefore the mean
    of the accelerations before and after a sample, and is paired with the mean of the two wrenches.

    Args:
        place: (n, 3) position of the coils' frame [m].
        quaternion: (n, 4) scalar first.
        currents: (n, 6) coil currents, held until the next sample [A].
        period: sampling period [s].
        coils: the coils.

    Returns:
        Regressor (n - 2, 6, 10) of mass [kg], first moments of mass [kg m] and inertia about the
        origin of the coils' frame [kg m^2] (xx, yy, zz, xy, xz, yz), and wrench (n - 2, 6) of the
        coils [N], [N m].

    Source: Newton and Euler; Atkeson, An and Hollerbach 1986 (linear in ten parameters).
    """
    pairs = zip(quaternion[:-1], quaternion[1:], strict=True)
    between = np.array([_relative_rotation(a, b) for a, b in pairs]) / period
    spin, swing = 0.5 * (between[1:] + between[:-1]), np.diff(between, axis=0) / period
    lift = (place[2:] - 2.0 * place[1:-1] + place[:-2]) / period**2 - np.array(GRAVITY)
    turn = np.empty((len(spin), 3, 3))
    for q, out in zip(quaternion[1:-1], turn, strict=True):
        quaternion_to_matrix(q, out)
    lift = np.einsum("nij,ni->nj", turn, lift)
    matrix = np.zeros((len(spin), 6, 10))
    matrix[:, :3, 0] = lift
    matrix[:, :3, 1:4] = _skew_matrices(swing) + _skew_matrices(spin) @ _skew_matrices(spin)
    matrix[:, 3:, 1:4] = -_skew_matrices(lift)
    matrix[:, 3:, 4:] = _inertia_regressor(swing) + _skew_matrices(spin) @ _inertia_regressor(spin)
    held = currents @ coils.wrench_map.T
    return matrix, 0.5 * (held[:-2] + held[1:-1])


def _differentiation_errors(value: np.ndarray) -> np.ndarray:
    """Return the absolute errors (10,) of the parameters due to the use of difference quotients.

    They hold for motions up to 6 Hz that are sampled at 200 Hz. `value` (10,) are the parameters:
    mass [kg], centre of mass [m] and inertia about the centre of mass [kg m^2].
    """
    moment = value[4:7].sum() / 2.0
    radius = float(np.sqrt(moment / value[0]))
    return _DIFFERENCE_ERROR * np.array([1e-3 * value[0], *[radius] * 3, *[moment] * 6])


def _relative_rotation(first: np.ndarray, then: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,) [rad] from the orientation `first` to `then`, in body axes.

    Both are quaternions (4,), scalar first; the rotation is by at most 180 degrees.
    """
    scalar, vector = relative_quaternion(first, then)
    size = float(np.linalg.norm(vector))
    return vector * (2.0 * np.arctan2(size, scalar) / size if size > 1e-12 else 2.0)


def _skew_matrices(v: np.ndarray) -> np.ndarray:
    """Return the skew-symmetric matrices (n, 3, 3) that multiply u to give `v x u`, for v (n, 3)."""
    out = np.zeros((len(v), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, k, j], out[:, j, k] = v[:, i], -v[:, i]
    return out


def _inertia_regressor(v: np.ndarray) -> np.ndarray:
    """Return the matrices (n, 3, 6) with which the product I v is linear in the inertia I.

    Each matrix times the elements xx, yy, zz, xy, xz, yz of I gives I v; `v` (n, 3) are the
    vectors.
    """
    out = np.zeros((len(v), 3, 6))
    for row, places in enumerate(_INERTIA_INDICES):
        for column, place in enumerate(places):
            out[:, row, place] = v[:, column]
    return out


def _inertia_matrix(six: np.ndarray) -> np.ndarray:
    return np.array([[six[k] for k in places] for places in _INERTIA_INDICES])


def _move_to_centre_of_mass(linear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert the ten linear parameters of the flotor to mass, centre of mass and inertia about it.

    `linear` (10,) are mass [kg], first moments of mass [kg m] and inertia about the origin of the
    coils' frame [kg m^2]. Return mass [kg], centre of mass [m] and inertia about the centre of mass
    [kg m^2] as (10,), and their Jacobian (10, 10) with respect to `linear`, by central differences.
    """

    def convert_parameters(p: np.ndarray) -> np.ndarray:
        centre = p[1:4] / p[0]
        parallel = p[0] * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        inertia = _inertia_matrix(p[4:]) - parallel
        upper = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        return np.concatenate([p[:1], centre, upper])

    steps = 1e-6 * np.diag(np.maximum(np.abs(linear), 1e-6))
    slope = [(convert_parameters(linear + d) - convert_parameters(linear - d)) / (2.0 * d.sum()) for d in steps]
    return convert_parameters(linear), np.column_stack(slope)
