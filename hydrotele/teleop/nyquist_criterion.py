"""Number of unstable poles of a teleoperator with hand, task and delays, by the Nyquist criterion."""

import math

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.teleop.two_port import Block, TwoPort, characteristic_function

_MAX_POLES_AT_ORIGIN = 4  # maximum number of poles at 0 of blocks with springs and integrators
_MAX_PHASE_STEP = 0.3  # rad, maximum phase change between neighbouring frequencies
_INITIAL_FREQUENCIES = 4000  # initial number of frequencies
_MAX_FREQUENCIES = 4_000_000
_CONTOUR_OFFSET = 1e-4  # distance of the contour from poles at 0, relative to the lowest frequency
_WHERE_STABILITY = "stability"


class PoleOnAxisError(InputError):
    """Error that is raised if a pole on the imaginary axis prevents counting the unstable poles."""


def count_unstable_poles(
    port: TwoPort, hand: Block, environment: Block, *, lowest: float = 1e-3, highest: float = 1e4,
    masses: int = 2,
) -> int:  # fmt: skip
    """Return the number of poles of hand, teleoperator and task in the right half-plane.

    The characteristic function has poles only at 0, so that the winding of its phase along the
    imaginary axis counts its zeros. Poles at 0, such as the drift of a free slave, do not count.

    Args:
        port: the two-port.
        hand: impedance of the operator's hand.
        environment: impedance of the task.
        lowest: frequency below which no poles are expected [rad/s].
        highest: frequency above which the masses dominate [rad/s].
        masses: minimum number of masses in the loop: the power of the frequency with which the
            characteristic function grows.

    Returns:
        The number; for a loop whose delayed part is as strong as its masses, such as a four-channel
        structure with delay, the number below the highest frequency.

    Raises:
        InputError: a side has no mass, or the phase is not resolved.

    Source: argument principle; Zhu 1994, 3.13 (loop transfer functions LG1 and LG2).
    """
    return _count_unstable_zeros(lambda s: characteristic_function(port, s, hand, environment), lowest, highest, masses)


def count_unstable_poles_held(port: TwoPort, environment: Block, *, lowest: float = 1e-3, highest: float = 1e4) -> int:
    """Return the number of unstable poles of slave and task while the master's motion is imposed.

    Args:
        port: the two-port.
        environment: impedance of the task.
        lowest: frequency below which no poles are expected [rad/s].
        highest: frequency above which the masses dominate [rad/s].

    Returns:
        The number of zeros of `Z_s + C_s + Z_e - C3 (C2 Z_e + C4)` in the right half-plane.

    Raises:
        InputError: the slave has no mass, or the phase is not resolved.
    """

    def loop_function(s: np.ndarray) -> np.ndarray:
        _, c2, c3, c4 = port.channels(s)
        task = environment(s)
        return port.slave(s) + port.slave_control(s) + task - c3 * (c2 * task + c4)

    return _count_unstable_zeros(loop_function, lowest, highest, 1)


def is_stable(port: TwoPort, hand: Block, environment: Block) -> bool:
    """Return whether hand, teleoperator and task have no pole in the right half-plane.

    Raises:
        InputError: a side has no mass, or a pole lies on the imaginary axis.
    """
    return count_unstable_poles(port, hand, environment) == 0


def _count_unstable_zeros(function: Block, lowest: float, highest: float, least_order: int) -> int:
    """Count the zeros in the right half-plane of a function that has poles only at 0.

    The winding of the phase along the imaginary axis gives the number (argument principle).
    `lowest` is the frequency below which no zeros are expected, `highest` the end of the path
    [rad/s]. `least_order` is the minimum power of s with which the function grows; a lower one
    raises InputError. Raise PoleOnAxisError if the phase is not resolved.
    """
    shift = _CONTOUR_OFFSET * lowest
    order = _growth_order(function, highest, least_order)

    def normalised_function(frequency: np.ndarray) -> np.ndarray:
        s = shift + 1j * frequency
        whole = function(s) * (s / (s + lowest)) ** _MAX_POLES_AT_ORIGIN
        return whole / (s + lowest) ** order

    frequency = np.concatenate([[0.0], np.geomspace(1e-2 * shift, highest, _INITIAL_FREQUENCIES)])
    values = normalised_function(frequency)
    while True:
        turns = np.abs(np.angle(values[1:] / values[:-1]))
        wide = np.flatnonzero(turns > _MAX_PHASE_STEP)
        if not len(wide):
            break
        if len(frequency) + len(wide) > _MAX_FREQUENCIES:
            raise PoleOnAxisError(_WHERE_STABILITY, "the phase is not resolved: a pole lies on the imaginary axis")
        between = 0.5 * (frequency[wide] + frequency[wide + 1])
        if np.any(between == frequency[wide]):
            raise PoleOnAxisError(_WHERE_STABILITY, "the phase is not resolved: a pole lies on the imaginary axis")
        frequency = np.insert(frequency, wide + 1, between)
        values = np.insert(values, wide + 1, normalised_function(between))
    phase = np.unwrap(np.angle(values))
    return round(-(phase[-1] - phase[0]) / math.pi)


def _growth_order(function: Block, highest: float, least: int) -> int:
    """Return the power of s with which a function grows for large real s, without delayed terms.

    It is evaluated from 100 to 1000 times the frequency `highest` [rad/s]. Raise InputError if it
    is below `least`.
    """
    far = highest * np.array([1e2, 1e3], complex)
    sizes = np.abs(function(far))
    order = round(float(np.log10(sizes[1] / sizes[0])))
    if order < least:
        raise InputError(_WHERE_STABILITY, "master and slave need masses, a transparent one also hand or task")
    return order
