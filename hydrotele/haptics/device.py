"""What a haptic device is to its server: read the handle, write a wrench. One of them is simulated.

The simulated device is a handle of six axes with a mass and a light friction, stops at the ends of
its travel, and a hand on it: a mass that a spring and a damper pull to where the person wants it.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from hydrotele.core.compiled import compiled

_HESITATION = 1.0  # s from when a machine is in control until the simulated person moves
_FINE = 4  # steps of the simulated handle per period: its stops turn over in 6 ms


class Abilities(NamedTuple):
    """What a device can do.

    Attributes:
        travel: either way from the centre [m].
        rotation: either way [rad]; 0 for a device that does not tell or make rotations.
        force: largest [N].
        torque: largest [N m].
    """

    travel: float
    rotation: float
    force: float
    torque: float


class HandlePose(NamedTuple):
    """Where a handle is.

    Attributes:
        place: (3,) from its centre [m]; x away from the user, y to the left, z up.
        quaternion: (4,) scalar first.
        buttons: one per bit.
    """

    place: np.ndarray
    quaternion: np.ndarray
    buttons: int


class HapticDevice(Protocol):
    """A device with force output that is open."""

    @property
    def abilities(self) -> Abilities:
        """Travel and limits."""
        ...

    def read(self) -> HandlePose:
        """Where the handle is now.

        Raises:
            OSError: the device does not answer.
        """
        ...

    def write(self, wrench: np.ndarray, on: bool) -> None:
        """Put a wrench (6,) on the handle [N], [N m] until the next one.

        Args:
            wrench: zero while no machine is in control.
            on: whether one is.

        Raises:
            OSError: the device does not answer.
        """
        ...

    def close(self) -> None:
        """Take the force off and let go of it."""
        ...


def within_limits(wrench: np.ndarray, abilities: Abilities) -> np.ndarray:
    """A wrench no larger than a device may give; force and torque keep their directions.

    Args:
        wrench: (6,) [N], [N m].
        abilities: of the device.

    Returns:
        (6,), zero where the wrench is not finite.

    >>> within_limits(np.array([30.0, 0, 40.0, 0, 0, 0.1]), Abilities(0.05, 0.5, 5.0, 0.4)).tolist()
    [3.0, 0.0, 4.0, 0.0, 0.0, 0.1]
    """
    if not np.isfinite(wrench).all():
        return np.zeros(6)
    out = np.array(wrench, float)
    for part, most in ((out[:3], abilities.force), (out[3:], abilities.torque)):
        size = float(np.sqrt(part @ part))
        if size > most:
            part *= most / size
    return out


@dataclass(frozen=True)
class SimulatedFacts:
    """A desktop device and the hand on it; every number an assumption of a usual size.

    Attributes:
        abilities: travel and limits.
        mass: of the handle [kg], and its moment of inertia [kg m^2].
        friction: viscous [N s/m], [N m s/rad].
        hand_mass: [kg], [kg m^2].
        hand_damping: [N s/m], [N m s/rad].
        hand_stiffness: [N/m], [N m/rad].
        motion: amplitudes of where the person wants the handle, as shares of the travel [1].
        frequency: of x, y, z, rx, ry, rz [Hz]; no two alike.
    """

    abilities: Abilities = Abilities(0.06, 0.6, 12.0, 0.4)
    mass: tuple[float, float] = (0.3, 3e-4)
    friction: tuple[float, float] = (0.5, 1e-3)
    hand_mass: tuple[float, float] = (0.6, 1e-3)
    hand_damping: tuple[float, float] = (8.0, 0.05)
    hand_stiffness: tuple[float, float] = (250.0, 1.5)
    motion: tuple[float, float, float, float, float, float] = (0.7, 0.5, 0.5, 0.1, 0.3, 0.1)
    frequency: tuple[float, float, float, float, float, float] = (0.23, 0.17, 0.31, 0.2, 0.13, 0.1)


class SimulatedDevice:
    """A device without hardware; one period passes with every `read`."""

    def __init__(self, period: float, facts: SimulatedFacts | None = None) -> None:
        """The handle is at rest in its centre.

        Args:
            period: [s].
            facts: of device and hand.
        """
        f = facts or SimulatedFacts()
        self.facts, self._period = f, period
        both = [np.array([part] * 3 + [turn] * 3) for part, turn in
                (f.mass, f.friction, f.hand_mass, f.hand_damping, f.hand_stiffness)]  # fmt: skip
        a = f.abilities
        self._stop = np.array([a.travel] * 3 + [a.rotation] * 3)
        self._numbers = np.array([*both, self._stop])
        self._amplitude = np.array(f.motion) * self._stop
        self._omega = 2.0 * np.pi * np.array(f.frequency)
        self._time, self._state, self._wrench = -_HESITATION, np.zeros((2, 6)), np.zeros(6)

    @property
    def abilities(self) -> Abilities:
        """Travel and limits."""
        return self.facts.abilities

    @property
    def wrench(self) -> np.ndarray:
        """(6,) that is put on the handle now [N], [N m]."""
        return self._wrench

    def read(self) -> HandlePose:
        """Where the handle is after one period more."""
        wanted = self._amplitude * np.sin(self._omega * max(0.0, self._time))
        _move(self._numbers, wanted, self._wrench, self._period, self._state)
        x = self._state[0]
        angle = float(np.sqrt(x[3:] @ x[3:]))
        quaternion = np.array([np.cos(0.5 * angle), 0.0, 0.0, 0.0])
        quaternion[1:] = x[3:] * (np.sin(0.5 * angle) / angle if angle > 0.0 else 0.5)
        return HandlePose(x[:3].copy(), quaternion, 0)

    def write(self, wrench: np.ndarray, on: bool) -> None:
        """Put a wrench on the handle; a second after a machine is there, the person moves it."""
        self._wrench[:] = wrench
        self._time = self._time + self._period if on else -_HESITATION

    def close(self) -> None:
        """Take the force off."""
        self._wrench[:] = 0.0


@compiled
def _move(numbers, wanted, wrench, period, state):
    """One period of handle and hand, axis by axis, by semi-implicit Euler steps."""
    mass, friction, hand_mass, hand_damping, hand_stiffness, stop = numbers
    step = period / _FINE
    for _ in range(_FINE):
        for i in range(6):
            x, v = state[0, i], state[1, i]
            force = wrench[i] - friction[i] * v
            force += hand_stiffness[i] * (wanted[i] - x) - hand_damping[i] * v
            own = mass[i] + hand_mass[i]
            beyond = abs(x) - stop[i]
            if beyond > 0.0:  # a stop turns over in 6 ms and takes the rebound away
                quick = 2.0 * np.pi / 6e-3
                force -= own * (quick * quick * (beyond if x > 0.0 else -beyond) + quick * v)
            v += step * force / own
            state[1, i] = v
            state[0, i] = x + step * v
