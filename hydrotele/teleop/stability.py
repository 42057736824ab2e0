"""Whether a teleoperator with hand, task and delays is stable: unstable poles by Nyquist."""

import math

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.teleop.two_port import Block, TwoPort, characteristic

_ORIGIN = 4  # poles at 0 that blocks with springs and integrators can have together
_TURN = 0.3  # rad by which the phase may turn from one frequency to the next
_FIRST = 4000  # frequencies to begin with
_MOST = 4_000_000
_ASIDE = 1e-4  # of the lowest frequency, by which the contour keeps right of poles at 0
_WHERE = "stability"


class OnTheAxis(InputError):
    """A pole lies on the imaginary axis, so that turns cannot be counted."""


def unstable_poles(
    port: TwoPort, hand: Block, environment: Block, *, lowest: float = 1e-3, highest: float = 1e4,
    masses: int = 2,
) -> int:  # fmt: skip
    """Number of poles right of the imaginary axis.

    The characteristic function has no poles but those at 0, so that the turns of its phase along
    the axis count its zeros. Poles at 0, such as the drift of a free slave, do not count.

    Args:
        port: the two-port.
        hand: impedance of the operator's hand.
        environment: impedance of the task.
        lowest: frequency below which nothing is expected [rad/s].
        highest: frequency above which masses rule [rad/s].
        masses: that the loop must have, as the power of the frequency with which it grows.

    Returns:
        The number; for a loop whose delayed part is as strong as its masses, such as a four-channel
        structure with delay, the number below the highest frequency.

    Raises:
        InputError: neither side has a mass, or the phase turns too fast to be followed.

    Source: argument principle; Zhu 1994, 3.13 (loop transfer functions LG1 and LG2).
    """
    return _zeros(lambda s: characteristic(port, s, hand, environment), lowest, highest, masses)


def unstable_held(
    port: TwoPort, environment: Block, *, lowest: float = 1e-3, highest: float = 1e4
) -> int:
    """The same with the master's motion imposed, as by a hand of infinite impedance.

    Args:
        port: the two-port.
        environment: impedance of the task.
        lowest: as of `unstable_poles`.
        highest: as of `unstable_poles`.

    Returns:
        The number of zeros of `Z_s + C_s + Z_e - C3 (C2 Z_e + C4)` right of the axis.

    Raises:
        InputError: as of `unstable_poles`.
    """

    def whole(s: np.ndarray) -> np.ndarray:
        _, c2, c3, c4 = port.channels(s)
        task = environment(s)
        return port.slave(s) + port.slave_control(s) + task - c3 * (c2 * task + c4)

    return _zeros(whole, lowest, highest, 1)


def stable(port: TwoPort, hand: Block, environment: Block) -> bool:
    """Whether no pole lies right of the imaginary axis; see `unstable_poles`."""
    return unstable_poles(port, hand, environment) == 0


def _zeros(function: Block, lowest: float, highest: float, least_order: int) -> int:
    """Zeros right of the axis of a function that has no poles but at 0."""
    shift = _ASIDE * lowest
    order = _order(function, highest, least_order)

    def turned(frequency: np.ndarray) -> np.ndarray:
        s = shift + 1j * frequency
        whole = function(s) * (s / (s + lowest)) ** _ORIGIN
        return whole / (s + lowest) ** order

    frequency = np.concatenate([[0.0], np.geomspace(1e-2 * shift, highest, _FIRST)])
    values = turned(frequency)
    while True:
        turns = np.abs(np.angle(values[1:] / values[:-1]))
        wide = np.flatnonzero(turns > _TURN)
        if not len(wide):
            break
        if len(frequency) + len(wide) > _MOST:
            raise OnTheAxis(_WHERE, "the phase cannot be followed: a pole lies on the axis")
        between = 0.5 * (frequency[wide] + frequency[wide + 1])
        if np.any(between == frequency[wide]):
            raise OnTheAxis(_WHERE, "the phase cannot be followed: a pole lies on the axis")
        frequency = np.insert(frequency, wide + 1, between)
        values = np.insert(values, wide + 1, turned(between))
    phase = np.unwrap(np.angle(values))
    return round(-(phase[-1] - phase[0]) / math.pi)


def _order(function: Block, highest: float, least: int) -> int:
    """Power of s with which the function grows; delays have died out far right."""
    far = highest * np.array([1e2, 1e3], complex)
    sizes = np.abs(function(far))
    order = round(float(np.log10(sizes[1] / sizes[0])))
    if order < least:
        raise InputError(
            _WHERE, "master and slave need masses, a transparent one hand or task, too"
        )
    return order
