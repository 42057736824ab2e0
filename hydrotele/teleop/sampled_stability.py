"""Stability of a sampled teleoperator whose packets have variable delays.

Both sides, master and slave, run at the same period T: coils and servo hold their force over a period, rates are
backward differences, integrals are sums. Between samples, master with hand and slave with task are
masses, dampers and springs, so that one period is an exact map. In the z-domain a packet with an age of n periods
is the factor `q^n`, with the unit delay `q = 1/z`. With jitter the age changes from period to period; the mean channel
is `E(q) = sum of P(age = n) q^n`. All signals are polynomials of q, and so is the characteristic
function of the loop. Its zeros inside `|q| < exp(-sigma T)` are the motions that grow faster than
sigma. They are counted by the winding of the phase along that circle. The effect of jitter beyond
the mean is `jitter_gain`.

Two structures are added to those of `two_port`. Both use the slave's own controller and return its
force:

- `wave_variables`: `u = (b v + F) / sqrt(2 b)` is sent forward, `w = (b v - F) / sqrt(2 b)` is
  returned, which makes a constant delay lossless (Niemeyer and Slotine 1991).
- `passivity_control`: velocity is sent forward, force is returned. A controller at each end lets
  out no more energy than has entered at the other end (Hannaford and Ryu 2002; with delay Ryu,
  Artigas and Preusche 2010). It is nonlinear: it is predicted stable if the channel needs no
  control, or if the slave's end alone is stable.

The module also gives the maximum damping of a sampled joystick. The computer reads the handle once
per period, computes the speed from two readings, and holds the coils' force until the next reading.
Between readings the body moves freely, or with the spring and damper of a hand. The loop is linear,
so that its largest eigenvalue determines stability; `Zhu 1994, Tables 6.7 and 6.9` give the springs
and dampers.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from hydrotele.core.errors import InputError
from hydrotele.teleop.case_file import TeleoperatorAxis
from hydrotele.teleop.packet_delays import compute_packet_ages, delays_to_periods
from hydrotele.teleop.two_port import RATE_STRUCTURES, STRUCTURES, Impedance

WAVE_STRUCTURE, PASSIVITY_STRUCTURE = "wave_variables", "passivity_control"
SAMPLED_STRUCTURES = (*STRUCTURES, WAVE_STRUCTURE, PASSIVITY_STRUCTURE)
_WHERE = "sampled teleoperator"
_MAX_PHASE_STEP = 0.5  # rad, maximum phase change between neighbouring points of the circle
_INITIAL_POINTS = 400
_MOST = 400_000
_MIN_GROWTH_RATE = 1e-3  # 1/s: slower growth is drift, such as that of a free handle
_MAX_GROWTH_RATE = 2e3  # 1/s, maximum magnitude of a growth rate
# jitter gain above which single runs grow: their power grows with the mean of its logarithm, which
# for exponentially distributed power is the logarithm of the mean minus Euler's gamma
_MAX_JITTER_GAIN = math.exp(np.euler_gamma)
_RATE_TOLERANCE = 1e-3  # absolute [1/s] and relative tolerance of a growth rate


@dataclass(frozen=True)
class PacketAges:
    """Control period, and distribution of the ages of packets when they are used.

    Attributes:
        period: T of both sides [s].
        forward: (n,) fraction of the periods in which the packet from the master that the slave
            uses is 0 .. n - 1 periods old [1].
        back: (m,) the same for packets from the slave that the master uses.
    """

    period: float
    forward: np.ndarray
    back: np.ndarray

    def __post_init__(self) -> None:
        """Raise InputError unless the period is positive and the fractions of each side sum to 1."""
        if not self.period > 0.0:
            raise InputError(_WHERE, f"the period must be positive, got {self.period:g} s")
        for name in ("forward", "back"):
            share = getattr(self, name)
            if len(share) < 1 or np.any(share < 0.0) or abs(share.sum() - 1.0) > 1e-9:
                raise InputError(_WHERE, f"the fractions of ages {name} must sum to 1")

    @property
    def mean_ages(self) -> tuple[float, float]:
        """Mean age of the packets in use, of the forward and of the return channel [s]."""
        ages = (self.period * np.arange(len(p)) @ p for p in (self.forward, self.back))
        forward, back = map(float, ages)
        return forward, back


def constant_delay_ages(period: float, delay_forward: float, delay_back: float) -> PacketAges:
    """Create the packet ages of a channel with constant delays, rounded to periods.

    Args:
        period: T [s].
        delay_forward: delay from the master to the slave [s].
        delay_back: delay from the slave to the master [s].

    Returns:
        The packet ages.

    >>> constant_delay_ages(0.005, 0.01, 0.0).forward
    array([0., 0., 1.])
    """
    share = [np.eye(1 + round(d / period))[-1] for d in (delay_forward, delay_back)]
    return PacketAges(period, *share)


def measured_delay_ages(period: float, delays_forward: np.ndarray, delays_back: np.ndarray) -> PacketAges:
    """Create the packet ages of a channel from measured delays of successive packets, one per period.

    Args:
        period: control period T of both sides [s].
        delays_forward: (n,) delays of the packets from the master [s]; NaN for a lost packet.
        delays_back: (m,) the same for packets from the slave [s].

    Returns:
        The packet ages, for delays that are rounded to periods. Periods before the first arrival do
        not count.

    Raises:
        InputError: no packet arrives in one of the directions.
    """
    return PacketAges(
        period,
        *(_age_distribution(delays_to_periods(d, period)) for d in (delays_forward, delays_back)),
    )


def _age_distribution(delays: np.ndarray) -> np.ndarray:
    ages = compute_packet_ages(delays)
    started = np.flatnonzero(ages <= np.arange(len(ages)))
    if not len(started):
        raise InputError(_WHERE, "no packet arrives within the given delays")
    ages = ages[started[0] :]
    return np.bincount(ages) / len(ages)


@dataclass(frozen=True)
class _SampledSide:
    """Sampled response of a mass with damper and spring to a force that is held for one period.

    The transfer functions from force to position, speed and acceleration are given at points q of the
    unit delay, as numerators over the common `denominator`.
    """

    denominator: np.ndarray
    position: np.ndarray
    speed: np.ndarray  # true speed
    acceleration: np.ndarray  # acceleration just before a step of the force
    period: float
    q: np.ndarray

    @property
    def rate(self) -> np.ndarray:
        """Transfer function from force to the speed that a controller computes, times `denominator`.

        This speed is the backward difference of the position.
        """
        return self.position * (1.0 - self.q) / self.period

    def digital_controller_force(self, z: Impedance) -> np.ndarray:
        """Return the force of a digital controller, with mass, damping and stiffness z, on this side.

        It multiplies sampled position, its difference and the measured acceleration by z. The result is
        a transfer function from the force on this side, times `denominator`.
        """
        return z.mass * self.acceleration + z.damping * self.rate + z.stiffness * self.position

    def physical_force(self, z: Impedance) -> np.ndarray:
        """Return the force of a body with impedance z that moves with this side, as a sensor measures it.

        It follows from true speed and acceleration just before a step of the force. The result is a
        transfer function from the force on this side, times `denominator`.
        """
        return z.mass * self.acceleration + z.damping * self.speed + z.stiffness * self.position


def _make_sampled_side(own: Impedance, held: Impedance, period: float, q: np.ndarray) -> _SampledSide:
    mass, damping = own.mass + held.mass, own.damping + held.damping
    stiffness = own.stiffness + held.stiffness
    block = np.zeros((3, 3))
    block[0, 1], block[1] = 1.0, (-stiffness / mass, -damping / mass, 1.0 / mass)
    step = expm(block * period)
    a, b = step[:2, :2], step[:2, 2]
    left, det = np.eye(2) - a, float(np.linalg.det(a))
    e = 1.0 - q  # avoids cancellation for slow motions, where q is close to 1
    below = np.linalg.det(left) + e * (np.trace(a) - 2.0 * det) + det * e**2
    place = q * ((1.0 - q * a[1, 1]) * b[0] + q * a[0, 1] * b[1])
    speed = q * (q * a[1, 0] * b[0] + (1.0 - q * a[0, 0]) * b[1])
    change = (q * below - damping * speed - stiffness * place) / mass
    return _SampledSide(below, place, speed, change, period, q)


def wave_impedance(case: TeleoperatorAxis) -> float:
    """Return the impedance b of the wave variables of a case [N s/m].

    If the case gives none, it is the damping of the slave's controller, or 1 if that is 0 as well.
    """
    return case.wave or case.slave_control.damping or 1.0


def sampled_characteristic_function(
    case: TeleoperatorAxis, structure: str, line: PacketAges, q: np.ndarray, return_gain: float = 1.0
) -> np.ndarray:
    """Return the characteristic function of the sampled loop at points q of the unit delay.

    It is 0 at the loop's poles `z = 1/q`, and has no poles itself.

    Args:
        case: teleoperator with hand and task; its delays are replaced by those of the channel.
        structure: one of `SAMPLED_STRUCTURES`; for `passivity_control` the loop without the limits on
            energy.
        line: control period and distribution of the ages of packets.
        q: (...) complex points.
        return_gain: factor on the return channels [1].

    Returns:
        (...) complex values.

    Raises:
        InputError: the structure is not known.

    Source: this module's docstring; `two_port.make_two_port` for the control laws.
    """
    if structure not in SAMPLED_STRUCTURES:
        message = f"{structure!r} is not known: {', '.join(SAMPLED_STRUCTURES)}"
        raise InputError(_WHERE, message)
    q = np.asarray(q, complex)
    ahead, home = (
        _mean_channel_response(line.forward, q),
        return_gain * _mean_channel_response(line.back, q),
    )
    near = _make_sampled_side(case.master, case.hand, line.period, q)
    far = _make_sampled_side(case.slave, case.task, line.period, q)
    if structure in (WAVE_STRUCTURE, PASSIVITY_STRUCTURE):
        home = return_gain * _mean_return_response(line, q)
        return _series_characteristic(case, structure == WAVE_STRUCTURE, near, far, ahead, home)
    own, forward = _master_side_forces(case, structure, near)
    own_slave = far.digital_controller_force(case.slave_control)
    back = _slave_side_force(case, structure, far)
    free = near.denominator * ((1.0 - q) if structure in RATE_STRUCTURES else 1.0)
    return (free + own) * (far.denominator + own_slave) - ahead * home * forward * back


def _mean_channel_response(share: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Evaluate the mean response `E(q) = sum of share[n] q^n` of a channel, by Horner's rule.

    `share[n]` is the fraction of the periods in which the packet is n periods old, and q are points of
    the unit delay.
    """
    total = np.zeros_like(q)
    for part in share[::-1]:
        total = total * q + part
    return total


def _mean_return_response(line: PacketAges, q: np.ndarray) -> np.ndarray:
    """Evaluate the mean return channel E(q) of a slave that acts after the master in every period.

    The master can then use the slave's packet in the next period at the earliest: a packet of age 0
    counts as one of age 1. E(q) is the mean of q^age over the periods.
    """
    return _mean_channel_response(line.back, q) - line.back[0] * (1.0 - q)


def _master_side_forces(case: TeleoperatorAxis, structure: str, near: _SampledSide) -> tuple[np.ndarray, np.ndarray]:
    """Return the two forces that a control structure computes from the master's motion.

    They are the force of the master's own controller, and the force on the slave before the forward
    channel. Both are transfer functions from the force on the master, times its denominator, and under
    rate control times `1 - q`.
    """
    firm, own, gains = case.slave_control, case.master_control, case.gains
    if structure not in RATE_STRUCTURES:
        forward = gains.position * near.digital_controller_force(firm)
        if structure == "four_channel_position":
            forward = (
                near.digital_controller_force(firm)
                + near.digital_controller_force(case.slave)
                - near.physical_force(case.hand)
            )
        return near.digital_controller_force(own), forward
    step = 1.0 - near.q

    def rate_force(z: Impedance) -> np.ndarray:
        return gains.velocity * near.position * (z.damping * step + z.stiffness * near.period)

    forward = rate_force(firm)
    if structure == "rate_force":
        return step * near.digital_controller_force(own), forward
    if structure == "four_channel_rate":
        forward = forward - gains.velocity * near.period * near.physical_force(case.hand)
    return rate_force(own), forward


def _slave_side_force(case: TeleoperatorAxis, structure: str, far: _SampledSide) -> np.ndarray:
    """Return the force on the master that a structure computes from the slave's motion.

    The return channel follows. The result is a transfer function from the force on the slave, times the
    slave's denominator.
    """
    if structure in ("position_force", "rate_force"):
        return -case.gains.force * far.physical_force(case.task)
    back = far.digital_controller_force(case.master_control)
    if structure == "four_channel_position":
        back = back + far.digital_controller_force(case.master) - far.physical_force(case.task)
    if structure == "four_channel_rate":
        change = far.physical_force(case.task) * (1.0 - far.q) / far.period
        back = back - change / case.gains.velocity
    return back


def _series_characteristic(
    case: TeleoperatorAxis,
    waves: bool,
    near: _SampledSide,
    far: _SampledSide,
    ahead: np.ndarray,
    home: np.ndarray,
) -> np.ndarray:
    """Return the characteristic function of a sampled loop with wave variables or passivity control.

    In both structures only the slave has a controller, whose force is returned to the master. With
    `waves` the channel carries wave variables, otherwise velocity and force, without the limits of
    passivity control. `ahead` and `home` are the mean responses of the forward and the return channel.
    """
    step, firm = 1.0 - near.q, case.slave_control
    held = firm.damping * step + firm.stiffness * near.period  # C = held / step
    if not waves:
        alone = step * far.denominator + held * far.rate
        return near.denominator * alone + ahead * home * held * near.rate * far.denominator
    b = wave_impedance(case)
    share = b * step + held  # F_s = b held / share (sqrt(2 / b) U - v_s)
    slave = share * far.denominator + b * held * far.rate
    master = near.denominator + b * near.rate
    # determinant of [master, -a home, 2 home D], [-a ahead n, 1 + ahead home, -c ahead home D],
    # [0, -b c held, slave] with a = sqrt(2 b), c = sqrt(2 / b)
    first = (1.0 + ahead * home) * slave - ahead * home * 2.0 * held * far.denominator
    second = 2.0 * b * near.rate * ahead * home * (slave - 2.0 * held * far.denominator)
    return master * first - second


def compute_max_growth_rate(
    case: TeleoperatorAxis, structure: str, line: PacketAges, return_gain: float = 1.0
) -> float:
    """Return the growth rate of the fastest growing motion of the sampled loop.

    It is negative if all motions decay; constant positions of a free handle do not count.

    Args:
        case: teleoperator with hand and task; its delays are replaced by those of the channel.
        structure: one of `SAMPLED_STRUCTURES`; for `passivity_control` the loop without the limits on
            energy.
        line: control period and distribution of the ages of packets.
        return_gain: factor on the return channels [1].

    Returns:
        Rate sigma of the motion `exp(sigma t)` [1/s], between -2000 and 2000.

    Raises:
        InputError: the structure is not known, or a pole lies on the circle in
            which poles are counted.
    """
    return _find_growth_rate(lambda q: sampled_characteristic_function(case, structure, line, q, return_gain), line)


def _find_growth_rate(function, line: PacketAges) -> float:
    still = _count_zeros_inside(function, 0.5 * _MIN_GROWTH_RATE * line.period, centre=1.0)

    def has_faster_growth(rate: float) -> bool:
        many = _count_zeros_inside(function, math.exp(-rate * line.period))
        return many > (still if rate < 0.0 else 0)

    least, most = (0.0, _MAX_GROWTH_RATE) if has_faster_growth(_MIN_GROWTH_RATE) else (-_MAX_GROWTH_RATE, 0.0)
    least, most = (_MIN_GROWTH_RATE, most) if most else (least, -_MIN_GROWTH_RATE)
    if has_faster_growth(most):
        return most
    while most - least > _RATE_TOLERANCE * (1.0 + abs(most)):
        middle = 0.5 * (least + most)
        least, most = (middle, most) if has_faster_growth(middle) else (least, middle)
    return 0.5 * (least + most)


def _count_zeros_inside(function, radius: float, centre: float = 0.0) -> int:
    """Count the zeros of a function inside a circle with a real centre, by the argument principle.

    The function has no poles in the circle, and conjugate values at conjugate points. Raise InputError
    if a zero lies on the circle.
    """
    angle = np.concatenate([[0.0], np.geomspace(1e-7, math.pi, _INITIAL_POINTS)])
    values = function(centre + radius * np.exp(1j * angle))
    while True:
        wide = np.flatnonzero(np.abs(np.angle(values[1:] / values[:-1])) > _MAX_PHASE_STEP)
        if not len(wide):
            break
        between = 0.5 * (angle[wide] + angle[wide + 1])
        if len(angle) + len(wide) > _MOST or np.any(between == angle[wide]):
            raise InputError(_WHERE, "the phase is not resolved: a pole lies on the circle")
        angle = np.insert(angle, wide + 1, between)
        values = np.insert(values, wide + 1, function(centre + radius * np.exp(1j * between)))
    return round(float(np.angle(values[1:] / values[:-1]).sum()) / math.pi)


def _unit_circle_points() -> np.ndarray:
    """Return 4000 points q of the unit circle, up to half the sampling frequency."""
    return np.exp(-1j * np.geomspace(1e-6, math.pi, 4000))


def is_slave_end_passive(case: TeleoperatorAxis, line: PacketAges) -> bool:
    """Return whether the slave's end of the channel is passive, with sampling taken into account.

    The response of the slave's end from reference velocity to force is `C / (1 + C v_s)`, with the
    controller C and the speed v_s of slave and task per force. It must have no negative real part up to
    half the sampling rate, and be stable. A passive channel then cannot make the loop unstable.

    Args:
        case: teleoperator with its task.
        line: packet ages, of which only the period is used.

    Returns:
        Whether the slave's end is passive.

    Source: Colgate and Schenkel 1997 (passivity of sampled walls); passivity theorem.
    """
    q = _unit_circle_points()
    far, firm = _make_sampled_side(case.slave, case.task, line.period, q), case.slave_control
    held = firm.damping * (1.0 - q) + firm.stiffness * line.period
    port = held * far.denominator / ((1.0 - q) * far.denominator + held * far.rate)
    grows = _count_zeros_inside(
        lambda p: slave_characteristic_function(case, line, p), math.exp(_MIN_GROWTH_RATE * line.period)
    )
    return bool(np.all(port.real > -1e-6 * np.abs(port))) and not grows


def _side_responses(case: TeleoperatorAxis, structure: str, line: PacketAges, q: np.ndarray, reflected: float):
    """Return two transfer functions, of the master and of the slave, from received to sent signal.

    The signals are those of the channel between them: forces, or waves for wave variables. q are
    points of the unit delay. `reflected` is a factor on the returned force; it is not applied to
    waves.
    """
    near = _make_sampled_side(case.master, case.hand, line.period, q)
    far = _make_sampled_side(case.slave, case.task, line.period, q)
    if structure == WAVE_STRUCTURE:
        b, firm = wave_impedance(case), case.slave_control
        held = firm.damping * (1.0 - q) + firm.stiffness * line.period
        master = (b * near.rate - near.denominator) / (b * near.rate + near.denominator)
        share = b * (1.0 - q) + held
        return master, 1.0 - 2.0 * held * far.denominator / (share * far.denominator + b * held * far.rate)
    own, forward = _master_side_forces(case, structure, near)
    free = near.denominator * ((1.0 - q) if structure in RATE_STRUCTURES else 1.0)
    back = reflected * _slave_side_force(case, structure, far)
    return forward / (free + own), back / (far.denominator + far.digital_controller_force(case.slave_control))


def jitter_gain(case: TeleoperatorAxis, structure: str, line: PacketAges, return_gain: float = 1.0) -> float:
    """Return the mean-square loop gain of the noise that jitter causes.

    A channel whose packets have random ages transmits the fraction `E(q)` of a signal. It adds noise
    with the fraction `1 - |E(q)|^2` of the signal's power, which is white if the ages of successive
    packets are independent. The noise passes the closed loop's transfer functions from either end and
    causes new noise. The result is the spectral radius of this map of powers.

    Args:
        case: teleoperator with hand and task.
        structure: one of `SAMPLED_STRUCTURES` except `passivity_control`.
        line: control period and distribution of the ages of packets.
        return_gain: factor on the return channels [1].

    Returns:
        The spectral radius [1], valid only if the mean loop is stable. Below 1 the mean square
        decays; single runs decay up to `exp(0.577)`, about 1.78.

    Source: mean-square small gain, Elia 2005 (Remote stabilization over fading channels).
    """
    angle = np.geomspace(1e-4, math.pi, 6000)
    q = np.exp(-1j * angle)
    master, slave = _side_responses(case, structure, line, q, return_gain)
    ahead = _mean_channel_response(line.forward, q)
    home = _mean_return_response(line, q) if structure == WAVE_STRUCTURE else _mean_channel_response(line.back, q)
    left = 1.0 - master * slave * ahead * home
    powers = np.array([
        [master * home * slave / left, master / left],
        [slave / left, slave * ahead * master / left],
    ])  # fmt: skip
    share = 1.0 - np.abs(np.array([ahead, home])[:, None]) ** 2
    table = np.trapezoid(np.abs(powers) ** 2 * share, angle, axis=-1) / math.pi
    return float(np.abs(np.linalg.eigvals(table)).max())


def slave_characteristic_function(case: TeleoperatorAxis, line: PacketAges, q: np.ndarray) -> np.ndarray:
    """Return the characteristic function of the slave alone, with a constant reference.

    It contains slave, its sampled controller and task, and is 0 at the poles `z = 1/q`.

    Args:
        case: teleoperator with its task.
        line: packet ages, of which only the period is used.
        q: (...) complex points of the unit delay.

    Returns:
        (...) complex values.
    """
    far = _make_sampled_side(case.slave, case.task, line.period, np.asarray(q, complex))
    return far.denominator + far.digital_controller_force(case.slave_control)


@dataclass(frozen=True)
class StabilityPrediction:
    """Predicted stability of a teleoperator with sampling and variable delays, and the reason.

    Attributes:
        is_stable: whether a disturbance decays; under passivity control, whether it stays bounded.
        reason: criterion that decided. `poles`: poles of the loop, stable or not. `jitter`:
            unstable, since noise caused by jitter grows, though the mean motion does not. Under
            passivity control `slave alone`: unstable, since the slave with its controller and task
            is. Stable under passivity control are `no control needed` (all poles are stable without
            it), `passive ends`, and `bounded` (the slave's end is stable but not passive).
    """

    is_stable: bool
    reason: str


def predict_stability(
    case: TeleoperatorAxis, structure: str, line: PacketAges, return_gain: float = 1.0
) -> StabilityPrediction:
    """Predict whether a teleoperator is stable with sampling and variable packet delays.

    Poles and jitter noise determine the stability of linear structures; `passivity_control` needs a
    stable slave only.

    Args:
        case: teleoperator with hand and task.
        structure: one of `SAMPLED_STRUCTURES`.
        line: control period and distribution of the ages of packets.
        return_gain: factor on the return channels [1].

    Returns:
        Whether it is stable, and the criterion that decided.

    Raises:
        InputError: the structure is not known, or a pole lies on the circle in
            which poles are counted.
    """

    def loop_function(q: np.ndarray) -> np.ndarray:
        return sampled_characteristic_function(case, structure, line, q, return_gain)

    def slave_function(q: np.ndarray) -> np.ndarray:
        return slave_characteristic_function(case, line, q)

    slowest = math.exp(-_MIN_GROWTH_RATE * line.period)
    steady = _count_zeros_inside(loop_function, slowest) == 0
    if structure != PASSIVITY_STRUCTURE:
        if not steady:
            return StabilityPrediction(False, "poles")
        if jitter_gain(case, structure, line, return_gain) >= _MAX_JITTER_GAIN:
            return StabilityPrediction(False, "jitter")
        return StabilityPrediction(True, "poles")
    if steady:
        return StabilityPrediction(True, "no control needed")
    if _count_zeros_inside(slave_function, slowest):
        return StabilityPrediction(False, "slave alone")
    return StabilityPrediction(True, "passive ends" if is_slave_end_passive(case, line) else "bounded")


_MAX_INERTIA = 1e6  # larger values of damping or inertia count as unbounded
_BISECTION_TOLERANCE = 1e-9  # relative tolerance of the bisection


class HandleBody(NamedTuple):
    """Linear model of a handle and the hand that holds it, in n coordinates.

    Attributes:
        mass: (n, n) mass matrix of handle and hand [kg], [kg m], [kg m^2].
        stiffness: (n, n) of the hand [N/m], [N m/rad].
        damping: (n, n) of the hand [N s/m], [N m s/rad].
    """

    mass: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray


def make_tilting_body(mass: float, arm: float, inertia: float, hand: tuple[float, ...] = (0.0,) * 5) -> HandleBody:
    """Create the model of a handle that translates along x and tilts about y (ry), with a hand.

    Args:
        mass: mass of the flotor [kg].
        arm: height of the centre of mass above the handle's point, negative below [m].
        inertia: moment of inertia of the flotor about its centre of mass [kg m^2].
        hand: the hand's mass at the handle's point [kg], damping [N s/m], stiffness [N/m],
            rotational damping [N m s/rad] and rotational stiffness [N m/rad].

    Returns:
        The body; its two coordinates are displacement [m] and rotation [rad] of the handle's point.
    """
    m, b, k, rub, spring = hand
    own = np.array([[mass + m, mass * arm], [mass * arm, inertia + mass * arm * arm]])
    return HandleBody(own, np.diag([k, spring]), np.diag([b, rub]))


def make_spinning_body(inertia: float, damping: float = 0.0, stiffness: float = 0.0) -> HandleBody:
    """Create the model of a handle that only rotates about its own axis.

    Args:
        inertia: moment of inertia of handle and hand [kg m^2].
        damping: damping of the hand [N m s/rad].
        stiffness: stiffness of the hand [N m/rad].

    Returns:
        The body.
    """
    return HandleBody(np.array([[inertia]]), np.array([[stiffness]]), np.array([[damping]]))


def max_sampled_handle_eigenvalue(body: HandleBody, stiffness: np.ndarray, damping: np.ndarray, period: float) -> float:
    """Return the largest eigenvalue magnitude of a handle under sampled spring and damper control.

    Below 1 the handle comes to rest; the map is that of one control period.

    Args:
        body: handle and hand.
        stiffness: (n,) stiffness of the joystick's springs [N/m], [N m/rad].
        damping: (n,) damping of the joystick's control [N s/m], [N m s/rad].
        period: control period [s].

    Returns:
        Magnitude of the largest eigenvalue over one period [1].

    Raises:
        InputError: the mass matrix is not positive definite.

    Source: zero-order hold by the matrix exponential; speed as the difference of two readings.

    >>> held = max_sampled_handle_eigenvalue(make_spinning_body(1.5e-3), np.array([6.0]), np.array([0.25]), 5e-3)
    >>> shaken = max_sampled_handle_eigenvalue(make_spinning_body(1.5e-3), np.array([6.0]), np.array([3.0]), 5e-3)
    >>> held < 1.0 < shaken
    True
    """
    n = len(body.mass)
    if not (np.linalg.eigvalsh(body.mass) > 0.0).all():
        raise InputError("sampled handle", "its mass must be positive in every direction")
    inverse, none = np.linalg.inv(body.mass), np.zeros((n, n))
    free = np.block([[none, np.eye(n)], [-inverse @ body.stiffness, -inverse @ body.damping]])
    pushed = np.vstack([none, inverse])
    moved = expm(period * np.block([[free, pushed], [np.zeros((n, 3 * n))]]))
    spring, damper = np.diag(stiffness), np.diag(damping) / period
    law = np.hstack([-(spring + damper), none, damper])  # of position, speed, previous position
    loop = np.zeros((3 * n, 3 * n))
    loop[: 2 * n, : 2 * n], loop[2 * n :, :n] = moved[: 2 * n, : 2 * n], np.eye(n)
    loop[: 2 * n] += moved[: 2 * n, 2 * n :] @ law
    return float(np.abs(np.linalg.eigvals(loop)).max())


def max_stable_handle_damping(inertia: float, stiffness: float, period: float) -> float:
    """Return the maximum sampled damping with which a handle that spins about its axis is stable.

    Stable means that no eigenvalue over one control period has a magnitude above 1. No hand holds
    the handle.

    Args:
        inertia: moment of inertia of the handle [kg m^2].
        stiffness: stiffness of the joystick's spring [N m/rad].
        period: control period [s].

    Returns:
        Damping [N m s/rad]; 0 if no damping stabilises this spring.

    Source: `max_sampled_handle_eigenvalue`; without a spring it is 2 inertia / period.

    >>> round(max_stable_handle_damping(1.5e-3, 0.0, 5e-3), 6)
    0.6
    """
    body = make_spinning_body(inertia)

    def is_stable(damping: float) -> bool:
        decay = max_sampled_handle_eigenvalue(body, np.array([stiffness]), np.array([damping]), period)
        return decay < 1.0 + 1e-12

    tried = np.geomspace(1e-3, 1.0, 400) * 2.0 * inertia / period
    good = [d for d in tried if is_stable(d)]
    if not good:
        return 0.0
    low, high = good[-1], good[-1] * 1.05
    while high - low > _BISECTION_TOLERANCE * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return float(low)


def min_stable_handle_inertia(damping: float, stiffness: float, period: float) -> float:
    """Return the minimum inertia with which a spinning handle is stable at a given sampled damping.

    Stable means that no eigenvalue over one control period has a magnitude above 1. No hand holds
    the handle.

    Args:
        damping: damping of the joystick's control [N m s/rad].
        stiffness: stiffness of the joystick's spring [N m/rad].
        period: control period [s].

    Returns:
        Moment of inertia [kg m^2]; infinite if there is none below 1e6.

    Source: `max_sampled_handle_eigenvalue`; without a spring it is damping period / 2.

    >>> round(min_stable_handle_inertia(3.0, 0.0, 5e-3), 6)
    0.0075
    """

    def is_stable(inertia: float) -> bool:
        body = make_spinning_body(inertia)
        decay = max_sampled_handle_eigenvalue(body, np.array([stiffness]), np.array([damping]), period)
        return decay < 1.0 + 1e-12

    low = high = 0.5 * damping * period
    while not is_stable(high):
        low, high = high, 2.0 * high
        if high > _MAX_INERTIA:
            return float("inf")
    low = low if high > low else 0.5 * low
    while high - low > _BISECTION_TOLERANCE * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if is_stable(middle) else (middle, high)
    return float(high)
