"""Linear analysis of one axis of a teleoperator: transparency, passivity, stability and stability margins.

The axis (`teleop.case_file`) is analysed as a two-port network.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hydrotele.teleop.case_file import TeleoperatorAxis
from hydrotele.teleop.nyquist_criterion import PoleOnAxisError, count_unstable_poles, is_stable
from hydrotele.teleop.two_port import (
    Block,
    Impedance,
    TwoPort,
    hybrid_matrix,
    scattering_norm,
    transmitted_impedance,
)

# rad/s, from slow motions to a flotor's bandwidth; round values could hit undamped poles
FREQUENCIES = 2.0 * np.pi * np.geomspace(0.016, 160.0, 1601)
_ZERO_IMPEDANCE = Impedance()
_MAX_SCATTERING_NORM = 1.0 + 1e-6  # allows for rounding in the inverse of a lossless port's matrix
_MARGIN_POINTS = 61  # number of points that are tested before a margin is refined
_MARGIN_TOLERANCE = 1e-3  # relative tolerance of a margin
MAX_TESTED_DELAY = 10.0  # s in each direction
MAX_TESTED_FACTOR = 1e3  # factor on the loop gain
_TESTED_DELAY_RANGE = (1e-4, MAX_TESTED_DELAY)


class StabilityLoop(Protocol):
    """Interface that the stability tests need: hand, task, delays and two-port of a teleoperator.

    `TeleoperatorAxis` and `LinearCase` provide it.
    """

    @property
    def task(self) -> Block:
        """Impedance of the task."""
        ...

    @property
    def hand(self) -> Block:
        """Impedance of the hand."""
        ...

    def with_delay(self, delay: float) -> "StabilityLoop":
        """Return a copy of the loop with the same delay [s] in each direction."""
        ...

    def make_port(self, structure: str, return_gain: float = 1.0) -> TwoPort:
        """Return the linear two-port with a control structure.

        `return_gain` is a factor on the channels from the slave to the master [1].
        """
        ...


@dataclass(frozen=True)
class StructureAnalysis:
    """Results of the linear analysis of one control structure.

    Attributes:
        structure: name of the structure.
        frequencies: (n,) frequencies of the arrays below [rad/s].
        hybrid_matrices: (n, 2, 2) hybrid matrix H of `[F_h, -V_e] = H [V_h, F_e]`: force and
            velocity at hand (h) and environment (e).
        transmitted_impedance: (n,) impedance transmitted to the operator [N s/m].
        task_impedance: (n,) impedance of the task [N s/m].
        scattering_norms: (n,) largest singular value of the scattering matrix [1]; a passive
            two-port has none above 1.
        loop_gains: (n,) gain of the loop through hand and task [1].
        loop_free: (n,) loop gain without a task [1].
        unstable_poles: number of unstable poles with the task; None if poles lie on the imaginary
            axis.
        unstable_poles_free: number of unstable poles without a task.
        unstable_poles_released: number of unstable poles with the task, with the handle released.
        unstable_poles_released_free: number of unstable poles without a task, with the handle released.
        gain_margin: factor on the return channels (from slave to master) up to which the loop stays
            stable; infinite if no tested factor makes it unstable. For an unstable case it is the
            largest factor below 1 that stabilises it, 0 if none does.
        max_delay: delay in each direction up to which the loop stays stable [s]; 0 if it is
            unstable without delay, infinite if it is stable with the largest tested delay of 10 s.
        has_passive_port: whether the two-port is passive, so that no passive hand and task destabilise it.
    """

    structure: str
    frequencies: np.ndarray
    hybrid_matrices: np.ndarray
    transmitted_impedance: np.ndarray
    task_impedance: np.ndarray
    scattering_norms: np.ndarray
    loop_gains: np.ndarray
    loop_free: np.ndarray
    unstable_poles: int | None
    unstable_poles_free: int | None
    unstable_poles_released: int | None
    unstable_poles_released_free: int | None
    gain_margin: float
    max_delay: float
    has_passive_port: bool

    @property
    def is_stable_held(self) -> bool:
        """Whether the loop is stable with and without the task, while a hand holds the handle."""
        return self.unstable_poles == 0 and self.unstable_poles_free == 0

    @property
    def is_stable_released(self) -> bool:
        """Whether the loop is stable with and without the task, while the handle is released."""
        return self.unstable_poles_released == 0 and self.unstable_poles_released_free == 0


def analyse_structure(
    case: TeleoperatorAxis, structure: str, frequencies: np.ndarray = FREQUENCIES
) -> StructureAnalysis:
    """Analyse stability, passivity and transparency of a teleoperator with one control structure.

    Args:
        case: teleoperator with hand and task.
        structure: name, one of `STRUCTURES`.
        frequencies: (n,) [rad/s].

    Returns:
        Results of the analysis.

    Raises:
        InputError: the structure is not known, or neither master nor slave has a mass.

    Source: Zhu 1994, chapter 3.
    """
    port, s = case.make_port(structure), 1j * np.asarray(frequencies, float)
    unit = scattering_reference_impedance(case)
    return StructureAnalysis(
        structure, frequencies, hybrid_matrix(port, s), transmitted_impedance(port, s, case.task), case.task(s),
        scattering_norm(port, s, unit), loop_gain(port, s, case.hand, case.task),
        loop_gain(port, s, case.hand, _ZERO_IMPEDANCE), _count_poles_or_none(port, case.hand, case.task),
        _count_poles_or_none(port, case.hand, _ZERO_IMPEDANCE), _count_poles_or_none(port, _ZERO_IMPEDANCE, case.task),
        _count_poles_or_none(port, _ZERO_IMPEDANCE, _ZERO_IMPEDANCE), find_gain_margin(case, structure),
        find_max_delay(case, structure), is_passive(port, unit),
    )  # fmt: skip


def loop_gain(port: TwoPort, s: np.ndarray | complex, hand: Block, environment: Block) -> np.ndarray:
    """Return the gain of the loop through master and slave; Nyquist's critical point is -1.

    Args:
        port: the two-port.
        s: (...) complex frequencies [rad/s].
        hand: impedance of the operator's hand.
        environment: impedance of the task.

    Returns:
        (...) `(C2 Z_e + C4)(C1 - C3 Z_h) / ((Z_m + C_m + Z_h)(Z_s + C_s + Z_e))` [1], with channels
        C1 .. C4 as in `TwoPort`, impedances Z and controllers C_m, C_s; indices m master, s slave,
        h hand, e environment.

    Source: Zhu 1994, 3.13.
    """
    s = np.asarray(s, complex)
    c1, c2, c3, c4 = port.channels(s)
    near = port.master(s) + port.master_control(s) + hand(s)
    far = port.slave(s) + port.slave_control(s) + environment(s)
    return (c2 * environment(s) + c4) * (c1 - c3 * hand(s)) / (near * far)


def scattering_reference_impedance(case: TeleoperatorAxis) -> float:
    """Return a reference impedance for scattering matrices: `sqrt(B^2 + M K)` of the hand [N s/m].

    M, B and K are the hand's mass, damping and stiffness. The result is 1 if this is zero.
    """
    hand = case.hand
    return math.hypot(hand.damping, math.sqrt(hand.mass * hand.stiffness)) or 1.0


def is_passive(port: TwoPort, unit: float = 1.0) -> bool:
    """Return whether a two-port is passive, so that no passive hand and task destabilise it.

    Args:
        port: the two-port.
        unit: reference impedance of the scattering matrix [N s/m].

    Returns:
        True if the scattering matrix has no pole in the right half-plane, and no norm above 1 on
        the imaginary axis.

    Source: Anderson and Spong 1989; Zhu 1994, 3.7.
    """
    s = 2j * np.pi * np.geomspace(1e-3, 2e3, 3000)
    if scattering_norm(port, s, unit).max() > _MAX_SCATTERING_NORM:
        return False
    wall = Impedance(damping=unit)
    try:
        return count_unstable_poles(port, wall, wall, masses=1) == 0
    except PoleOnAxisError:
        return False


def is_strictly_stable(port: TwoPort, hand: Block, environment: Block) -> bool:
    """Return whether hand, teleoperator and task have only poles in the left half-plane.

    The result is also false if a pole lies on the imaginary axis.
    """
    try:
        return is_stable(port, hand, environment)
    except PoleOnAxisError:
        return False


def _count_poles_or_none(port: TwoPort, hand: Block, environment: Block) -> int | None:
    try:
        return count_unstable_poles(port, hand, environment)
    except PoleOnAxisError:
        return None


def find_gain_margin(case: StabilityLoop, structure: str) -> float:
    """Return the factor on the return channels (slave to master) at which stability changes [1].

    For a stable case it is the largest stable factor, infinite if all factors up to 1000 are
    stable. For an unstable case it is the largest factor below 1 with which the loop is stable, and
    0 if no factor down to 0.001 stabilises it.
    """

    def is_stable_with(factor: float) -> bool:
        return is_strictly_stable(case.make_port(structure, factor), case.hand, case.task)

    if is_stable_with(1.0):
        found = find_first_change(is_stable_with, np.geomspace(1.0, MAX_TESTED_FACTOR, _MARGIN_POINTS))
        return math.inf if found is None else found
    found = find_first_change(is_stable_with, np.geomspace(1.0, 1.0 / MAX_TESTED_FACTOR, _MARGIN_POINTS))
    return 0.0 if found is None else found


def find_max_delay(case: StabilityLoop, structure: str) -> float:
    """Return the delay in each direction up to which the loop is stable [s].

    It is 0 if the loop is unstable without delay or with 0.1 ms, and infinite if it is stable up to
    10 s. Both directions have the same delay.
    """

    def is_stable_with(delay: float) -> bool:
        return is_strictly_stable(case.with_delay(delay).make_port(structure), case.hand, case.task)

    if not is_stable_with(0.0):
        return 0.0
    if not is_stable_with(_TESTED_DELAY_RANGE[0]):
        return 0.0
    found = find_first_change(is_stable_with, np.geomspace(*_TESTED_DELAY_RANGE, _MARGIN_POINTS))
    return math.inf if found is None else found


def find_first_change(condition: Callable[[float], bool], points: np.ndarray) -> float | None:
    """Return where a condition first differs from its value at the first point, None if nowhere.

    Args:
        condition: function of one positive number.
        points: (n,) positive values in rising or falling order. They are tested in this order; the
            interval of the first change is then bisected.

    Returns:
        The value next to the change at which the condition is true, to 0.1 %.
    """
    first, last = condition(float(points[0])), float(points[0])
    for point in map(float, points[1:]):
        if condition(point) != first:
            break
        last = point
    else:
        return None
    while abs(point / last - 1.0) > _MARGIN_TOLERANCE:
        middle = math.sqrt(last * point)
        last, point = (middle, point) if condition(middle) == first else (last, middle)
    return last if first else point


def stability_map(case: StabilityLoop, structure: str, delays: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Test the stability of a control structure on a grid of delays and gains.

    The gains are factors on the return channels, which carry force or motion from slave to master.

    Args:
        case: teleoperator with hand and task.
        structure: name of the structure.
        delays: (n,) delays in each direction [s].
        factors: (m,) factors on the return channels [1].

    Returns:
        (m, n), true where stable.
    """
    return np.array([
        [is_strictly_stable(case.with_delay(t).make_port(structure, k), case.hand, case.task) for t in delays]
        for k in map(float, factors)
    ])  # fmt: skip
