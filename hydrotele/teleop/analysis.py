"""A teleoperator's two-port with hand and task: what is felt, passivity, stability and margins."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hydrotele.teleop.case import Case
from hydrotele.teleop.stability import OnTheAxis, stable, unstable_poles
from hydrotele.teleop.two_port import (
    Block,
    Impedance,
    TwoPort,
    hybrid,
    scattering_norm,
    transmitted,
)

# rad/s, from slow motions to a flotor's bandwidth; not round, as poles without damping may be
FREQUENCIES = 2.0 * np.pi * np.geomspace(0.016, 160.0, 1601)
_FREE = Impedance()
_PASSIVE = 1.0 + 1e-6  # rounding in the inverse of a lossless port's matrix stays below
_STEPS = 61  # tried before a margin is refined
_REFINED = 1e-3  # of a margin
_REACH = 1e3  # factors on the loop's gain that are tried, up and down
_DELAYS = (1e-4, 10.0)  # s each way


class Loop(Protocol):
    """A teleoperator with hand and task whose stability can be asked for, such as a `Case`."""

    @property
    def task(self) -> Block:
        """Impedance of the task."""
        ...

    @property
    def hand(self) -> Block:
        """Impedance of the hand."""
        ...

    def with_delay(self, delay: float) -> "Loop":
        """The same with a delay [s] each way."""
        ...

    def port(self, structure: str, reflected: float = 1.0) -> TwoPort:
        """The two-port of a structure; `reflected` is a factor on what comes back."""
        ...


@dataclass(frozen=True)
class Analysis:
    """What a structure does with a case.

    Attributes:
        structure: its name.
        frequencies: (n,) [rad/s].
        hybrid: (n, 2, 2) of `[F_h, -V_e] = H [V_h, F_e]`.
        transmitted: (n,) impedance that the operator feels [N s/m].
        task: (n,) impedance of the task [N s/m].
        scattering: (n,) largest singular value of the scattering matrix [1].
        loop: (n,) gain of the loop through hand and task [1].
        loop_free: (n,) the same without a task [1].
        unstable_poles: with the task; None where poles lie on the axis.
        unstable_free: the same without a task.
        gain_margin: factor on what comes back up to which the loop stays stable; below 1 where the
            case is unstable, 0 where no factor helps, infinite where none was found that hurts.
        largest_delay: each way, up to which it stays stable [s]; 0 where it is unstable without.
        passive: whether the two-port is, so that no passive hand and task make it unstable.
    """

    structure: str
    frequencies: np.ndarray
    hybrid: np.ndarray
    transmitted: np.ndarray
    task: np.ndarray
    scattering: np.ndarray
    loop: np.ndarray
    loop_free: np.ndarray
    unstable_poles: int | None
    unstable_free: int | None
    gain_margin: float
    largest_delay: float
    passive: bool

    @property
    def stable(self) -> bool:
        """Whether it is stable with the task and without."""
        return self.unstable_poles == 0 and self.unstable_free == 0


def analyse(case: Case, structure: str, frequencies: np.ndarray = FREQUENCIES) -> Analysis:
    """Analyse a structure.

    Args:
        case: the teleoperator with hand and task.
        structure: its name, one of `STRUCTURES`.
        frequencies: (n,) [rad/s].

    Returns:
        The analysis.

    Raises:
        InputError: the structure is not known, or neither side has a mass.

    Source: Zhu 1994, chapter 3.
    """
    port, s = case.port(structure), 1j * np.asarray(frequencies, float)
    unit = reference(case)
    return Analysis(
        structure, frequencies, hybrid(port, s), transmitted(port, s, case.task), case.task(s),
        scattering_norm(port, s, unit), loop_gain(port, s, case.hand, case.task),
        loop_gain(port, s, case.hand, _FREE), _counted(port, case.hand, case.task),
        _counted(port, case.hand, _FREE), gain_margin(case, structure),
        largest_delay(case, structure), is_passive(port, unit),
    )  # fmt: skip


def loop_gain(
    port: TwoPort, s: np.ndarray | complex, hand: Block, environment: Block
) -> np.ndarray:
    """Gain of the loop from the master to the slave and back, of which -1 must not be encircled.

    Args:
        port: the two-port.
        s: (...) complex frequencies [rad/s].
        hand: impedance of the operator's hand.
        environment: impedance of the task; without one this is Zhu's LG1.

    Returns:
        (...) `(C2 Z_e + C4)(C1 - C3 Z_h) / ((Z_m + C_m + Z_h)(Z_s + C_s + Z_e))` [1].

    Source: Zhu 1994, 3.13.
    """
    s = np.asarray(s, complex)
    c1, c2, c3, c4 = port.channels(s)
    near = port.master(s) + port.master_control(s) + hand(s)
    far = port.slave(s) + port.slave_control(s) + environment(s)
    return (c2 * environment(s) + c4) * (c1 - c3 * hand(s)) / (near * far)


def reference(case: Case) -> float:
    """Impedance of the hand where its mass and spring cancel or would [N s/m], 1 without them."""
    hand = case.hand
    return math.hypot(hand.damping, math.sqrt(hand.mass * hand.stiffness)) or 1.0


def is_passive(port: TwoPort, unit: float = 1.0) -> bool:
    """Whether a two-port gives no energy, whatever passive hand and task it is joined to.

    Args:
        port: the two-port.
        unit: impedance that terminates it in the scattering matrix [N s/m].

    Returns:
        True if the scattering matrix has no pole right of the axis, and no norm above 1 on it.

    Source: Anderson and Spong 1989; Zhu 1994, 3.7.
    """
    s = 2j * np.pi * np.geomspace(1e-3, 2e3, 3000)
    if scattering_norm(port, s, unit).max() > _PASSIVE:
        return False
    wall = Impedance(damping=unit)
    try:
        return unstable_poles(port, wall, wall, masses=1) == 0
    except OnTheAxis:
        return False


def holds(port: TwoPort, hand: Block, environment: Block) -> bool:
    """Whether a loop is stable; a pole on the axis does not count as such."""
    try:
        return stable(port, hand, environment)
    except OnTheAxis:
        return False


def _counted(port: TwoPort, hand: Block, environment: Block) -> int | None:
    try:
        return unstable_poles(port, hand, environment)
    except OnTheAxis:
        return None


def gain_margin(case: Loop, structure: str) -> float:
    """Factor on what comes back at which the loop's stability changes; see `Analysis`."""

    def right(factor: float) -> bool:
        return holds(case.port(structure, factor), case.hand, case.task)

    if right(1.0):
        found = _change(right, np.geomspace(1.0, _REACH, _STEPS))
        return math.inf if found is None else found
    found = _change(right, np.geomspace(1.0, 1.0 / _REACH, _STEPS))
    return 0.0 if found is None else found


def largest_delay(case: Loop, structure: str) -> float:
    """Delay each way up to which the loop is stable [s]; see `Analysis`."""

    def right(delay: float) -> bool:
        return holds(case.with_delay(delay).port(structure), case.hand, case.task)

    if not right(0.0):
        return 0.0
    if not right(_DELAYS[0]):
        return 0.0
    found = _change(right, np.geomspace(*_DELAYS, _STEPS))
    return math.inf if found is None else found


def _change(right: Callable[[float], bool], points: np.ndarray) -> float | None:
    """Where an answer first differs from that at the first point; None if it never does."""
    first, last = right(float(points[0])), float(points[0])
    for point in map(float, points[1:]):
        if right(point) != first:
            break
        last = point
    else:
        return None
    while abs(point / last - 1.0) > _REFINED:
        middle = math.sqrt(last * point)
        last, point = (middle, point) if right(middle) == first else (last, middle)
    return last if first else point


def stability_map(
    case: Loop, structure: str, delays: np.ndarray, factors: np.ndarray
) -> np.ndarray:
    """Where a structure is stable.

    Args:
        case: the teleoperator with hand and task.
        structure: its name.
        delays: (n,) each way [s].
        factors: (m,) on what comes back [1].

    Returns:
        (m, n), true where stable.
    """
    return np.array([
        [holds(case.with_delay(t).port(structure, k), case.hand, case.task) for t in delays]
        for k in map(float, factors)
    ])  # fmt: skip
