"""Bilateral teleoperator as a linear two-port: control structures, transparency and passivity.

The operator's hand moves the master, and the slave acts on the environment (task). Both are masses,
`Z = M s`, with controllers `C = B + K/s`; four channels join them: velocity forward C1, force back C2,
force forward C3, velocity back C4. s is the complex frequency. The ports are the hand's
force and velocity and the environment's.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hydrotele.core.errors import InputError

Block = Callable[[np.ndarray], np.ndarray]  # transfer function of the complex frequency [rad/s]
RATE_STRUCTURES = ("rate_position", "rate_force", "four_channel_rate")
_POSITION_STRUCTURES = ("position_position", "position_force", "four_channel_position")
STRUCTURES = (*_POSITION_STRUCTURES, *RATE_STRUCTURES)
_WHERE = "two-port"


@dataclass(frozen=True)
class Impedance:
    """Force over velocity of a mass, a damper and a spring, `M s + B + K/s`.

    Attributes:
        mass: mass M [kg].
        damping: damping B [N s/m].
        stiffness: stiffness K [N/m].
    """

    mass: float = 0.0
    damping: float = 0.0
    stiffness: float = 0.0

    def __call__(self, s: np.ndarray) -> np.ndarray:
        """Return the complex impedance, force per velocity [N s/m], at complex frequencies s [rad/s]."""
        return self.mass * s + self.damping + self.stiffness / s


@dataclass(frozen=True)
class TwoPort:
    """Linear two-port of a teleoperator: both sides, their controllers, four channels and delays.

    Blocks are transfer functions of the complex frequency s [rad/s].

    Attributes:
        master: impedance of the master.
        slave: impedance of the slave.
        master_control: C_m, the master's controller on its own velocity [N s/m].
        slave_control: C_s, the slave's controller on its own velocity [N s/m].
        velocity_forward: C1, force on the slave per master velocity [N s/m].
        force_back: C2, force against the master per environment force [1].
        force_forward: C3, force on the slave per hand force [1].
        velocity_back: C4, force against the master per slave velocity [N s/m].
        delay_forward: delay from the master to the slave [s].
        delay_back: delay from the slave to the master [s].
    """

    master: Impedance
    slave: Impedance
    master_control: Block
    slave_control: Block
    velocity_forward: Block
    force_back: Block
    force_forward: Block
    velocity_back: Block
    delay_forward: float = 0.0
    delay_back: float = 0.0

    def channels(self, s: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the channels C1, C2, C3, C4 at complex frequencies s [rad/s], with their delays.

        C1 and C3 have the forward delay, C2 and C4 the return delay.
        """
        late, back = np.exp(-s * self.delay_forward), np.exp(-s * self.delay_back)
        return (
            self.velocity_forward(s) * late, self.force_back(s) * back,
            self.force_forward(s) * late, self.velocity_back(s) * back,
        )  # fmt: skip


@dataclass(frozen=True)
class StructureGains:
    """Gains of the channels between master and slave.

    Attributes:
        position: slave position per master position [1].
        velocity: slave velocity per master position, k_v [1/s].
        force: reflected force per environment force [1].
    """

    position: float = 1.0
    velocity: float = 1.0
    force: float = 1.0


def make_two_port(
    structure: str, master: Impedance, slave: Impedance, master_control: Impedance,
    slave_control: Impedance, gains: StructureGains | None = None, *, delay_forward: float = 0.0,
    delay_back: float = 0.0, jerk: bool = False,
) -> TwoPort:  # fmt: skip
    """Build the linear two-port of a teleoperator with a named control structure.

    Args:
        structure: `position_position` (coordinating force), `position_force` (direct force),
            `four_channel_position` (transparent), and the same under rate control:
            `rate_position`, `rate_force`, `four_channel_rate`.
        master: impedance (mass, damping and stiffness) of the master.
        slave: impedance of the slave.
        master_control: damper and spring of the master's controller.
        slave_control: damper and spring of the slave's controller.
        gains: gains of the channels; those that the structure does not have are ignored.
        delay_forward: delay from the master to the slave [s].
        delay_back: delay from the slave to the master [s].
        jerk: whether the four-channel structure under rate control uses the master's jerk, which
            makes it fully transparent and cannot be measured. Without jerk the channels contain no
            inertia of either side, and for equal sides the master's inertia is displayed as well.

    Returns:
        The two-port.

    Raises:
        InputError: the structure is not known, or a gain or a delay is invalid.

    Source: Lawrence 1992; Zhu 1994, 3.9-3.62.

    >>> heavy, firm = Impedance(1.0), Impedance(0.0, 40.0, 400.0)
    >>> clear = make_two_port("four_channel_position", heavy, heavy, firm, firm)
    >>> bool(np.allclose(hybrid_matrix(clear, 3j), [[0, 1], [-1, 0]]))
    True
    """
    gains = gains or StructureGains()
    if structure not in STRUCTURES:
        raise InputError(_WHERE, f"{structure!r} is not known: {', '.join(STRUCTURES)}")
    if min(delay_forward, delay_back) < 0.0:
        raise InputError(_WHERE, f"delays must not be negative: {delay_forward}, {delay_back} s")
    if structure in RATE_STRUCTURES and not gains.velocity > 0.0:
        raise InputError(_WHERE, f"the velocity gain must be positive, got {gains.velocity} 1/s")
    k = gains.velocity

    def zero_block(s: np.ndarray) -> np.ndarray:
        return np.zeros_like(s)

    def multiply_by_rate_gain(block: Block) -> Block:
        return lambda s: block(s) * k / s

    forward = _scale_block(slave_control, gains.position)
    own: Block = master_control
    back, ahead, feel = zero_block, zero_block, zero_block
    if structure in ("position_position", "rate_position"):
        feel = _scale_block(master_control, -1.0)
    if structure in ("position_force", "rate_force"):
        back = lambda s: gains.force * np.ones_like(s)  # noqa: E731 - a constant block
    if structure == "four_channel_position":
        forward = lambda s: slave(s) + slave_control(s)  # noqa: E731
        back, ahead = np.ones_like, np.ones_like
        feel = lambda s: -(master(s) + master_control(s))  # noqa: E731
    if structure in ("rate_position", "rate_force"):
        forward = multiply_by_rate_gain(slave_control)
    if structure in ("rate_position", "four_channel_rate"):
        own = multiply_by_rate_gain(master_control)
    if structure == "four_channel_rate":
        forward = multiply_by_rate_gain(lambda s: slave(s) * jerk + slave_control(s))
        back, ahead = (lambda s: s / k), (lambda s: k / s)
        feel = lambda s: -(master(s) * s / k * jerk + master_control(s))  # noqa: E731
    return TwoPort(master, slave, own, slave_control, forward, back, ahead, feel, delay_forward, delay_back)


def hybrid_matrix(port: TwoPort, s: np.ndarray | complex) -> np.ndarray:
    """Return the hybrid matrix H of a two-port, `[F_h, -V_e] = H [V_h, F_e]`.

    F_h and V_h are force and velocity of the hand, F_e and V_e those of the environment.

    Args:
        port: the two-port.
        s: (...) complex frequencies [rad/s].

    Returns:
        (..., 2, 2) complex matrices.

    Source: Zhu 1994, 3.10-3.11.
    """
    s = np.asarray(s, complex)
    c1, c2, c3, c4 = port.channels(s)
    a, b = port.master(s) + port.master_control(s), port.slave(s) + port.slave_control(s)
    rows = [[a * b + c1 * c4, c2 * b - c4], [-(c3 * a + c1), 1.0 - c2 * c3]]
    return np.moveaxis(np.array(rows) / (b - c3 * c4), (0, 1), (-2, -1))


def transmitted_impedance(port: TwoPort, s: np.ndarray | complex, environment: Block) -> np.ndarray:
    """Return the impedance that the operator feels at the master, with the slave on a task.

    Args:
        port: the two-port.
        s: (...) complex frequencies [rad/s].
        environment: impedance of the task.

    Returns:
        (...) complex hand force per hand velocity [N s/m].

    Source: Zhu 1994, 3.12.
    """
    s = np.asarray(s, complex)
    h, task = hybrid_matrix(port, s), environment(s)
    return h[..., 0, 0] - h[..., 0, 1] * h[..., 1, 0] * task / (1.0 + h[..., 1, 1] * task)


def scattering_norm(port: TwoPort, s: np.ndarray | complex, unit: float = 1.0) -> np.ndarray:
    """Return the largest singular value of the scattering matrix, at most 1 for a passive port.

    Args:
        port: the two-port.
        s: (...) points on the imaginary axis [rad/s].
        unit: reference impedance that scales forces to velocities [N s/m]; passivity does not
            depend on it.

    Returns:
        (...) norms [1].

    Source: Anderson and Spong 1989; Zhu 1994, chapter 3.
    """
    return hybrid_scattering_norm(hybrid_matrix(port, s), unit)


def hybrid_scattering_norm(matrix: np.ndarray, unit: float = 1.0) -> np.ndarray:
    """Return the largest singular value of the scattering matrix that belongs to a hybrid matrix.

    `matrix` (..., 2, 2) are hybrid matrices and `unit` the reference impedance [N s/m]. The norms (...)
    are at most 1 for a passive port.
    """
    h = matrix * np.array([[1.0 / unit, 1.0], [1.0, unit]])
    one = np.eye(2)
    scatter = np.diag([1.0, -1.0]) @ (h - one) @ np.linalg.inv(h + one)
    return np.linalg.svd(scatter, compute_uv=False)[..., 0]


def characteristic_function(port: TwoPort, s: np.ndarray | complex, hand: Block, environment: Block) -> np.ndarray:
    """Return the characteristic function of hand, teleoperator and task: 0 at the closed loop's poles.

    Args:
        port: the two-port.
        s: (...) complex frequencies [rad/s].
        hand: impedance of the operator's hand.
        environment: impedance of the task.

    Returns:
        (...) `(Z_m + C_m + Z_h)(Z_s + C_s + Z_e) + (C2 Z_e + C4)(C1 - C3 Z_h)` [(N s/m)^2]. Z
        are impedances, C_m and C_s controllers, C1 .. C4 the channels of `TwoPort`; indices m master, s
        slave, h hand, e environment.

    Source: Zhu 1994, 3.13.
    """
    s = np.asarray(s, complex)
    c1, c2, c3, c4 = port.channels(s)
    near = port.master(s) + port.master_control(s) + hand(s)
    far = port.slave(s) + port.slave_control(s) + environment(s)
    return near * far + (c2 * environment(s) + c4) * (c1 - c3 * hand(s))


def stability_theorem_margin(mass: float, damping: float, stiffest: float) -> float:
    """Return the margin of the stability theorem of stiffness feedback, `B^2 - 4 M K_max`.

    `M x'' + B x' + K(t) x = 0` with a stiffness between `K_min > 0` and K_max is uniformly
    asymptotically stable if the margin and B are positive. This holds for any rate of change of the
    stiffness, and for any delay or task that causes it. The theorem does not cover `K_min = 0`.

    Args:
        mass: mass of joystick and hand, M [kg] or [kg m^2].
        damping: damping of both, B [N s/m] or [N m s/rad].
        stiffest: upper bound of the stiffness of both, K_max [N/m] or [N m/rad].

    Returns:
        The margin [(N s/m)^2] or [(N m s/rad)^2].

    Source: Zhu 1994, theorem 4-2, 4.11-4.14.

    >>> stability_theorem_margin(1.0, 30.0, 200.0)
    100.0
    """
    return damping**2 - 4.0 * mass * stiffest


def _scale_block(block: Block, factor: float) -> Block:
    return lambda s: factor * block(s)
