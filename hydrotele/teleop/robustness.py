"""Robustness of a teleoperator against passive hands, sampled operators, stiff tasks and release.

Passivity requires that a two-port generates no energy. Absolute stability (Llewellyn) requires
less: that no passive hand and no passive task destabilise it. Operators sampled from an impedance
range lie between both criteria and the single operator of a case. The Z-width gives the range of
impedances that can be displayed, and the maximum stable stiffness of the task.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.teleop.case_file import TeleopCaseFile, TeleoperatorAxis
from hydrotele.teleop.linear_analysis import find_first_change, is_strictly_stable
from hydrotele.teleop.nyquist_criterion import PoleOnAxisError, count_unstable_poles_held
from hydrotele.teleop.sampled_stability import (
    SAMPLED_STRUCTURES,
    PacketAges,
    StabilityPrediction,
    compute_max_growth_rate,
    predict_stability,
)
from hydrotele.teleop.two_port import RATE_STRUCTURES, STRUCTURES, Impedance, TwoPort, hybrid_matrix

_ZERO_IMPEDANCE = Impedance()
_SEARCH_FREQUENCIES = 2.0 * np.pi * np.geomspace(1e-3, 500.0, 3000)  # rad/s
_HAND_FREQUENCIES = 2.0 * np.pi * np.geomspace(0.1, 5.0, 200)  # rad/s, frequency range of hand motion
_ROUNDING = 1e-6
_STIFFNESS_FACTORS = np.geomspace(1e-3, 1e4, 57)  # tested factors on the task's stiffness


def compute_llewellyn_parameter(port: TwoPort, s: np.ndarray | complex) -> np.ndarray:
    """Return Llewellyn's stability parameter of a two-port at frequencies.

    The two-port is absolutely stable (stable with every passive hand and task) if the parameter is
    nowhere below 1 and the two-port itself has no unstable pole.

    Args:
        port: the two-port.
        s: (...) points on the imaginary axis [rad/s].

    Returns:
        (...) `(2 Re h11 Re h22 - Re h12 h21) / |h12 h21|` of the hybrid matrix h [1]; minus infinity where `Re h11` or
        `Re h22` is negative, infinity where one direction transmits nothing.

    Source: Llewellyn 1952; Haykin 1970, Active network theory; with `[F_h, -V_e] = H [V_h, F_e]`.

    >>> from hydrotele.teleop.two_port import make_two_port
    >>> body, firm = Impedance(1.0), Impedance(0.0, 40.0, 400.0)
    >>> float(compute_llewellyn_parameter(make_two_port("four_channel_position", body, body, firm, firm), 3j).round(6))
    1.0
    """
    h = hybrid_matrix(port, np.asarray(s, complex))
    across = h[..., 0, 1] * h[..., 1, 0]
    first, second = np.real(h[..., 0, 0]), np.real(h[..., 1, 1])
    slack = _ROUNDING * np.abs(h)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (2.0 * first * second - np.real(across)) / np.abs(across)
    found = np.where(np.abs(across) > 0.0, found, np.inf)
    return np.where((first < -slack[..., 0, 0]) | (second < -slack[..., 1, 1]), -np.inf, found)


def is_absolutely_stable(port: TwoPort) -> bool:
    """Return whether a two-port is stable with every passive hand and task (absolute stability).

    Args:
        port: the two-port.

    Returns:
        True if its hybrid matrix has no pole in the right half-plane and Llewellyn's parameter is
        nowhere below 1.
    """
    if np.any(compute_llewellyn_parameter(port, 1j * _SEARCH_FREQUENCIES) < 1.0 - _ROUNDING):
        return False
    try:
        return count_unstable_poles_held(port, _ZERO_IMPEDANCE) == 0
    except PoleOnAxisError:
        return False


@dataclass(frozen=True)
class ZWidth:
    """Z-width: range of impedances that a teleoperator displays, and maximum stable task stiffness.

    Attributes:
        frequencies: (n,) [rad/s].
        free_impedance: (n,) transmitted impedance without a task [N s/m].
        clamped_impedance: (n,) transmitted impedance with a clamped slave [N s/m].
        max_stiffness_held: maximum stable task stiffness with the hand on the handle [N/m]; infinite if
            all tested values are stable, 0 if the softest is unstable.
        max_stiffness_released: maximum stable task stiffness with the handle released [N/m];
            infinite or 0 likewise.
        max_tested_stiffness: largest tested stiffness [N/m].
    """

    frequencies: np.ndarray
    free_impedance: np.ndarray
    clamped_impedance: np.ndarray
    max_stiffness_held: float
    max_stiffness_released: float
    max_tested_stiffness: float

    @property
    def mean_width_decades(self) -> float:
        """Width of the displayed impedance range in decades, averaged over the frequencies.

        It is the mean of `log10(|Z_clamped| / |Z_free|)` of the two displayed impedances [1].
        """
        return float(np.mean(np.log10(np.abs(self.clamped_impedance) / np.abs(self.free_impedance))))


def compute_z_width(case: TeleoperatorAxis, structure: str, frequencies: np.ndarray = _HAND_FREQUENCIES) -> ZWidth:
    """Compute the Z-width of a control structure: impedance range and maximum stable task stiffness.

    Args:
        case: the teleoperator; the task's stiffness is varied, its mass and damping are kept.
        structure: one of `two_port.STRUCTURES`.
        frequencies: (n,) [rad/s].

    Returns:
        Impedances with free and clamped slave, and maximum stable stiffness of the task.

    Raises:
        InputError: the structure is not known.

    Source: Colgate and Brown 1994 (Z-width); Zhu 1994, 3.4 for the transmitted impedance.
    """
    port = case.make_port(structure)
    h = hybrid_matrix(port, 1j * frequencies)
    clamped = h[:, 0, 0] - h[:, 0, 1] * h[:, 1, 0] / h[:, 1, 1]
    unit = case.task.stiffness or case.slave_control.stiffness or 1.0

    def find_max_stiffness(hand: Impedance) -> float:
        def is_stable_with(factor: float) -> bool:
            task = replace(case.task, stiffness=factor * unit)
            return is_strictly_stable(port_with_task(case, structure, task), hand, task)

        if not is_stable_with(float(_STIFFNESS_FACTORS[0])):
            return 0.0
        found = find_first_change(is_stable_with, _STIFFNESS_FACTORS)
        return math.inf if found is None else found * unit

    most = float(_STIFFNESS_FACTORS[-1]) * unit
    return ZWidth(
        frequencies,
        h[:, 0, 0],
        clamped,
        find_max_stiffness(case.hand),
        find_max_stiffness(_ZERO_IMPEDANCE),
        most,
    )


def port_with_task(case: TeleoperatorAxis, structure: str, task: Impedance) -> TwoPort:
    """Return the linear two-port of a control structure for a copy of the case with `task`."""
    return replace(case, task=task).make_port(structure)


@dataclass(frozen=True)
class MasterPolynomial:
    """Characteristic polynomial of the master without the slave, and its unstable zeros.

    Attributes:
        coefficients: coefficients of falling powers of the complex frequency s.
        unstable_zeros: number of zeros in the right half-plane.
    """

    coefficients: np.ndarray
    unstable_zeros: int


def compute_master_polynomial(
    case: TeleoperatorAxis, structure: str, hand: Impedance = _ZERO_IMPEDANCE
) -> MasterPolynomial:
    """Compute the characteristic polynomial of the master alone, without signals from the slave.

    M, B and K are mass, damping and stiffness of master and hand together; the master's controller has
    damping B_c and stiffness K_c. Under position control, and in `rate_force`, the polynomial is
    `M s^2 + (B + B_c) s + K + K_c`. In the other structures under rate control the controller acts on
    the integral of the position times the velocity gain k. The polynomial is then
    `M s^3 / k + B s^2 / k + (K / k + B_c) s + K_c`, which is unstable for B = 0.

    Args:
        case: the teleoperator.
        structure: one of `two_port.STRUCTURES`.
        hand: impedance of the hand on the handle; zero by default.

    Returns:
        The polynomial.

    Raises:
        InputError: the structure is not known.

    Source: Zhu 1994, 3.70-3.72.
    """
    if structure not in STRUCTURES:
        raise InputError("structure", f"{structure!r}; known: {', '.join(STRUCTURES)}")
    own, control = case.master, case.master_control
    mass, damping = own.mass + hand.mass, own.damping + hand.damping
    stiffness = own.stiffness + hand.stiffness
    if structure in RATE_STRUCTURES and structure != "rate_force":
        kv = 1.0 / case.gains.velocity
        found = [kv * mass, kv * damping, kv * stiffness + control.damping, control.stiffness]
    else:
        found = [mass, damping + control.damping, stiffness + control.stiffness]
    roots = np.roots(found)
    slack = 1e-9 * np.abs(roots).max()
    return MasterPolynomial(np.array(found), int(np.sum(roots.real > slack)))


@dataclass(frozen=True)
class ImpedanceRanges:
    """Ranges of hand and task impedances for random sampling, log-uniform between two impedances.

    Attributes:
        hand: impedances with minimum and with maximum mass [kg], damping [N s/m] and stiffness
            [N/m] of the hand.
        task: the same for the task.
    """

    hand: tuple[Impedance, Impedance]
    task: tuple[Impedance, Impedance]

    def sample(self, rng: np.random.Generator) -> tuple[Impedance, Impedance]:
        """Sample the impedances of a hand and a task, in this order.

        Mass, damping and stiffness are log-uniform, or uniform if the minimum is 0.
        """
        hand, task = (_sample_impedance(least, most, rng) for least, most in (self.hand, self.task))
        return hand, task


# loosely and firmly holding hand, near and far; orders of magnitude after Mussa-Ivaldi, Hogan and
# Bizzi 1985 and Tsuji et al. 1995, the values are assumptions
DEFAULT_HAND_RANGE = (Impedance(0.4, 4.0, 80.0), Impedance(0.8, 17.0, 780.0))
_TASK_RANGE_FACTOR = 3.0  # factor between the case's task and the softest and stiffest sampled task


def case_impedance_ranges(facts: TeleopCaseFile) -> ImpedanceRanges:
    """Return the ranges of hand and task impedances of a case file, for random sampling.

    Without ranges in the file, hands are sampled from DEFAULT_HAND_RANGE, and tasks have between a
    third and three times the damping and stiffness of the case's task.

    Args:
        facts: contents of the case file.

    Returns:
        The ranges.
    """
    task = facts.task.impedance()
    hands, tasks = (
        DEFAULT_HAND_RANGE,
        tuple(
            Impedance(task.mass, k * task.damping, k * task.stiffness)
            for k in (1.0 / _TASK_RANGE_FACTOR, _TASK_RANGE_FACTOR)
        ),
    )
    if facts.hands:
        hands = facts.hands.min.impedance(), facts.hands.max.impedance()
    if facts.tasks:
        tasks = facts.tasks.min.impedance(), facts.tasks.max.impedance()
    return ImpedanceRanges(hands, (tasks[0], tasks[1]))


def _sample_impedance(least: Impedance, most: Impedance, rng: np.random.Generator) -> Impedance:
    found = []
    for name in ("mass", "damping", "stiffness"):
        low, high = getattr(least, name), getattr(most, name)
        if low > 0.0:
            found.append(low * (high / low) ** rng.random())
        else:
            found.append(low + (high - low) * rng.random())
    return Impedance(*found)


@dataclass(frozen=True)
class SampledStability:
    """Stability of a control structure with randomly sampled hands and tasks.

    Attributes:
        pair_count: number of sampled pairs of hand and task.
        unstable_count: number of unstable pairs with the hand on the handle.
        unstable_released_count: number of pairs whose task is unstable with the handle released.
        worst_growth_rate: largest growth rate of all pairs with the hand on the handle, negative if
            all motions decay [1/s].
        worst_hand: hand of the pair with this growth rate.
        worst_task: task of this pair.
    """

    pair_count: int
    unstable_count: int
    unstable_released_count: int
    worst_growth_rate: float
    worst_hand: Impedance
    worst_task: Impedance


def evaluate_random_hands_and_tasks(
    case: TeleoperatorAxis,
    structure: str,
    line: PacketAges,
    spread: ImpedanceRanges,
    pairs: int,
    seed: int = 0,
) -> SampledStability:
    """Evaluate the stability of a structure with randomly sampled hands and tasks.

    Every pair is tested with the hand on the handle and with the handle released. The test includes
    time sampling and the variable delays of the channel. The worst pair has the largest growth
    rate.

    Args:
        case: the teleoperator; its hand and task are replaced.
        structure: one of `sampled_stability.SAMPLED_STRUCTURES`.
        line: control period, and distribution of the ages of received packets.
        spread: ranges of hands and tasks.
        pairs: number of sampled pairs; the same seed gives the same pairs for every structure.
        seed: seed of the random generator.

    Returns:
        Numbers of unstable pairs, and the worst pair with its growth rate.

    Raises:
        InputError: the structure is not known.
    """
    rng = np.random.default_rng([seed, 21])
    unstable, free, worst = 0, 0, (-math.inf, _ZERO_IMPEDANCE, _ZERO_IMPEDANCE)
    for _ in range(pairs):
        hand, task = spread.sample(rng)
        one = replace(case, hand=hand, task=task)
        unstable += not predict_stability(one, structure, line).is_stable
        free += not predict_stability(replace(one, hand=_ZERO_IMPEDANCE), structure, line).is_stable
        rate = compute_max_growth_rate(one, structure, line)
        if rate > worst[0]:
            worst = rate, hand, task
    return SampledStability(pairs, unstable, free, *worst)


@dataclass(frozen=True)
class Robustness:
    """Robustness of one control structure by several criteria.

    Attributes:
        structure: name of the structure.
        has_absolute_stability: whether it is stable with every passive hand and task, by Llewellyn's
            criterion; None without a linear two-port.
        llewellyn: minimum of Llewellyn's parameter over frequency [1]; NaN without a linear two-port.
        z_width_result: Z-width, None without a linear two-port.
        released_polynomial: polynomial of the released master without the slave; None for wave
            variables and passivity control.
        sampled: stability with time sampling, for four pairs: hand and task, hand and no task, no hand
            and task, neither.
        sampled_pairs: stability with randomly sampled hands and tasks.
    """

    structure: str
    has_absolute_stability: bool | None
    llewellyn: float
    z_width_result: ZWidth | None
    released_polynomial: MasterPolynomial | None
    sampled: tuple[StabilityPrediction, StabilityPrediction, StabilityPrediction, StabilityPrediction]
    sampled_pairs: SampledStability


def evaluate_robustness(
    case: TeleoperatorAxis,
    structure: str,
    line: PacketAges,
    spread: ImpedanceRanges,
    pairs: int = 20,
) -> Robustness:
    """Evaluate the robustness of a control structure against other hands and tasks, and release.

    Args:
        case: the teleoperator.
        structure: one of `sampled_stability.SAMPLED_STRUCTURES`.
        line: control period, and distribution of the ages of received packets.
        spread: ranges of hands and tasks.
        pairs: number of sampled pairs of hand and task.

    Returns:
        Results of all criteria: absolute stability, Z-width, release, and sampled hands and tasks.

    Raises:
        InputError: the structure is not known.
    """
    if structure not in SAMPLED_STRUCTURES:
        raise InputError("structure", f"{structure!r}; known: {', '.join(SAMPLED_STRUCTURES)}")
    linear = structure in STRUCTURES
    port = case.make_port(structure) if linear else None
    four = [
        predict_stability(replace(case, hand=hand, task=task), structure, line)
        for hand in (case.hand, _ZERO_IMPEDANCE) for task in (case.task, _ZERO_IMPEDANCE)
    ]  # fmt: skip
    return Robustness(
        structure,
        is_absolutely_stable(port) if port else None,
        float(compute_llewellyn_parameter(port, 1j * _SEARCH_FREQUENCIES).min()) if port else math.nan,
        compute_z_width(case, structure) if linear else None,
        compute_master_polynomial(case, structure) if linear else None,
        (four[0], four[1], four[2], four[3]),
        evaluate_random_hands_and_tasks(case, structure, line, spread, pairs),
    )
