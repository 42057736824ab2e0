"""Linear analysis of a teleoperator: transparency, passivity, stability and stability margins.

The module describes one axis of a teleoperator (master, slave, controllers, operator's hand, task,
gains, delays) and analyses its two-port network. The parameters come from a YAML file that
`hydrotele analyse teleop` reads. `hydrotele/teleop/cat215_axis.yaml` is the default file; it gives
the source of every parameter.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Protocol

import numpy as np
from pydantic import Field, field_validator, model_validator

from hydrotele.core.datafile import Facts, Name, NonNegative, Positive, parse, read_yaml, suggest
from hydrotele.core.errors import InputError
from hydrotele.teleop.switching import Spring
from hydrotele.teleop.two_port import (
    STRUCTURES,
    Block,
    Gains,
    Impedance,
    OnTheAxis,
    TwoPort,
    hybrid,
    scattering_norm,
    stable,
    transmitted,
    two_port,
    unstable_poles,
)


@dataclass(frozen=True)
class Case:
    """One axis of a teleoperator with hand and task, all in one scale of lengths and forces.

    Attributes:
        master: impedance of the master, which the hand moves.
        slave: impedance of the slave, which acts on the task.
        master_control: damper and spring of the master's controller.
        slave_control: damper and spring of the slave's controller.
        hand: impedance of the operator's hand.
        task: impedance of the environment.
        gains: gains of the channels.
        delay_forward: delay from the master to the slave [s].
        delay_back: delay from the slave to the master [s].
        wave: impedance b of wave variables [N s/m]; 0 selects the slave controller's damping.
    """

    master: Impedance
    slave: Impedance
    master_control: Impedance
    slave_control: Impedance
    hand: Impedance
    task: Impedance
    gains: Gains = field(default_factory=Gains)
    delay_forward: float = 0.0
    delay_back: float = 0.0
    wave: float = 0.0

    def __post_init__(self) -> None:
        """Raise InputError if a controller has a mass, since it would need accelerations."""
        if self.master_control.mass or self.slave_control.mass:
            raise InputError("teleoperator", "controllers are dampers and springs, without mass")

    @property
    def delay(self) -> float:
        """Mean of both delays [s]; stability depends only on their sum."""
        return 0.5 * (self.delay_forward + self.delay_back)

    def with_delay(self, delay: float) -> "Case":
        """Return the case with a delay [s] in each direction."""
        return replace(self, delay_forward=delay, delay_back=delay)

    def port(self, structure: str, reflected: float = 1.0) -> TwoPort:
        """Return the two-port of a structure.

        Args:
            structure: see `two_port`.
            reflected: factor on both return channels C2 and C4, which is the gain of the loop
                through hand and task [1].

        Returns:
            The two-port.

        Raises:
            InputError: see `two_port`.
        """
        made = two_port(
            structure, self.master, self.slave, self.master_control, self.slave_control,
            self.gains, delay_forward=self.delay_forward, delay_back=self.delay_back,
        )  # fmt: skip
        if reflected == 1.0:
            return made
        return replace(
            made,
            force_back=_scaled(made.force_back, reflected),
            velocity_back=_scaled(made.velocity_back, reflected),
        )


def _scaled(block: Block, factor: float) -> Block:
    def scaled(s: np.ndarray) -> np.ndarray:
        return factor * block(s)

    return scaled


SHIPPED = Path(__file__).resolve().with_name("cat215_axis.yaml")


LONGEST = 10.0  # s
Delay = Annotated[float, Field(ge=0, le=LONGEST)]


class Side(Facts):
    """Mass [kg], damping [N s/m] and stiffness [N/m] of a body, the hand or the task."""

    mass: NonNegative = 0.0
    damping: NonNegative = 0.0
    stiffness: NonNegative = 0.0

    def impedance(self) -> Impedance:
        """Return the impedance as a function of frequency."""
        return Impedance(self.mass, self.damping, self.stiffness)


class RigidBody(Facts):
    """Mass [kg], damping [N s/m] and stiffness [N/m] of the master or the slave."""

    mass: Positive
    damping: NonNegative = 0.0
    stiffness: NonNegative = 0.0

    def impedance(self) -> Impedance:
        """Return the impedance as a function of frequency."""
        return Impedance(self.mass, self.damping, self.stiffness)


class Controller(Facts):
    """Damping [N s/m] and stiffness [N/m] of a controller."""

    damping: NonNegative = 0.0
    stiffness: NonNegative = 0.0

    def impedance(self) -> Impedance:
        """Return the impedance as a function of frequency."""
        return Impedance(0.0, self.damping, self.stiffness)


class ChannelGains(Facts):
    """Gains of the channels, see `two_port.Gains`; velocity in 1/s."""

    position: Positive = 1.0
    velocity: Positive = 1.0
    force: NonNegative = 1.0


class Delays(Facts):
    """Delays [s] from the master to the slave and from the slave to the master."""

    forward: Delay = 0.0
    back: Delay = 0.0


class VaryingSpring(Facts):
    """Joystick axis with stiffness feedback, without the hand, which is added to it."""

    nominal: NonNegative
    least: NonNegative
    most: Positive
    damping: NonNegative
    mass: Positive

    @model_validator(mode="after")
    def _ordered(self):
        if not self.least <= self.nominal <= self.most:
            raise ValueError(
                "must be ordered, least <= nominal <= most:"
                f" {self.least:g}, {self.nominal:g}, {self.most:g}"
            )
        return self

    def spring(self) -> Spring:
        """Return the axis as input of the stability theorem."""
        return Spring(self.mass, self.damping, self.nominal, self.least, self.most)


class MapRange(Facts):
    """Range of the stability map: delay in each direction [s], factor on the return channels."""

    longest_delay: Annotated[float, Field(gt=0, le=LONGEST)] = 0.5
    least_factor: Positive = 0.01
    most_factor: Positive = 100.0
    points: Annotated[int, Field(ge=3, le=200)] = 25

    @model_validator(mode="after")
    def _ordered(self):
        if not self.least_factor < self.most_factor:
            raise ValueError("least_factor must be below most_factor")
        return self


class SideRange(Facts):
    """Range of impedances for random sampling, log-uniform between least and most."""

    least: Side
    most: Side

    @model_validator(mode="after")
    def _ordered(self):
        for name in ("mass", "damping", "stiffness"):
            if not getattr(self.least, name) <= getattr(self.most, name):
                raise ValueError(f"{name}: least must not be above most")
        return self


class TeleopCase(Facts):
    """Complete input of an analysis: one axis, all in one scale of lengths and forces."""

    name: Name
    master: RigidBody
    slave: RigidBody
    master_control: Controller
    slave_control: Controller
    hand: Side
    task: Side
    gains: ChannelGains = Field(default_factory=ChannelGains)
    delays: Delays = Field(default_factory=Delays)
    structures: Annotated[tuple[str, ...], Field(min_length=1)] = STRUCTURES
    stiffness: VaryingSpring | None = None
    wave: NonNegative = 0.0
    hands: SideRange | None = None
    tasks: SideRange | None = None
    map: MapRange = Field(default_factory=MapRange)

    @field_validator("structures")
    @classmethod
    def _known(cls, names):
        return known_structures(names)

    def case(self) -> Case:
        """Convert the input file to a `Case` for the two-port."""
        gains = Gains(self.gains.position, self.gains.velocity, self.gains.force)
        return Case(
            self.master.impedance(), self.slave.impedance(), self.master_control.impedance(),
            self.slave_control.impedance(), self.hand.impedance(), self.task.impedance(), gains,
            self.delays.forward, self.delays.back, self.wave,
        )  # fmt: skip


def known_structures(
    names: tuple[str, ...], known: tuple[str, ...] = STRUCTURES
) -> tuple[str, ...]:
    """Return the names without duplicates.

    Raises:
        ValueError: a name is not known.
    """
    for name in names:
        if name not in known:
            raise ValueError(f"no structure {name!r}; {suggest(name, known)}")
    return tuple(dict.fromkeys(names))


def load_teleop_case(path: str | Path | None = None) -> TeleopCase:
    """Read a case from a YAML file.

    Args:
        path: YAML file, None for the default file.

    Returns:
        The case.

    Raises:
        InputError: the file is invalid; the message gives file, line, key and the allowed values.
    """
    path = SHIPPED if path is None else path
    data, lines = read_yaml(path)
    return parse(TeleopCase, data, str(path), lines)


# rad/s, from slow motions to a flotor's bandwidth; round values could hit undamped poles
FREQUENCIES = 2.0 * np.pi * np.geomspace(0.016, 160.0, 1601)
_FREE = Impedance()
_PASSIVE = 1.0 + 1e-6  # allows for rounding in the inverse of a lossless port's matrix
_STEPS = 61  # number of points that are tested before a margin is refined
_REFINED = 1e-3  # relative tolerance of a margin
LONGEST_TRIED = 10.0  # s in each direction
MOST_TRIED = 1e3  # factor on the loop gain
_DELAYS = (1e-4, LONGEST_TRIED)


class Loop(Protocol):
    """Interface of a teleoperator with hand and task for stability tests, such as a `Case`."""

    @property
    def task(self) -> Block:
        """Impedance of the task."""
        ...

    @property
    def hand(self) -> Block:
        """Impedance of the hand."""
        ...

    def with_delay(self, delay: float) -> "Loop":
        """Return the loop with a delay [s] in each direction."""
        ...

    def port(self, structure: str, reflected: float = 1.0) -> TwoPort:
        """Return the two-port of a structure; `reflected` is a factor on the return channels."""
        ...


@dataclass(frozen=True)
class Analysis:
    """Results of the analysis of one structure.

    Attributes:
        structure: name of the structure.
        frequencies: (n,) [rad/s].
        hybrid: (n, 2, 2) hybrid matrix H of `[F_h, -V_e] = H [V_h, F_e]`.
        transmitted: (n,) impedance transmitted to the operator [N s/m].
        task: (n,) impedance of the task [N s/m].
        scattering: (n,) largest singular value of the scattering matrix [1].
        loop: (n,) gain of the loop through hand and task [1].
        loop_free: (n,) loop gain without a task [1].
        unstable_poles: number of unstable poles with the task; None if poles lie on the imaginary
            axis.
        unstable_free: number of unstable poles without a task.
        unstable_let_go: number of unstable poles with the task, with the handle released.
        unstable_let_go_free: number of unstable poles without a task, with the handle released.
        gain_margin: factor on the return channels up to which the loop stays stable. It is below 1
            if the case is unstable, 0 if no factor stabilises it, and infinite if no tested factor
            makes it unstable.
        largest_delay: delay in each direction up to which the loop stays stable [s]; 0 if it is
            unstable without delay, infinite if it is stable with the largest tested delay of 10 s.
        passive: whether the two-port is passive, so that no passive hand and task destabilise it.
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
    unstable_let_go: int | None
    unstable_let_go_free: int | None
    gain_margin: float
    largest_delay: float
    passive: bool

    @property
    def stable(self) -> bool:
        """Whether the loop is stable with and without the task, while a hand holds the handle."""
        return self.unstable_poles == 0 and self.unstable_free == 0

    @property
    def stable_let_go(self) -> bool:
        """Whether the loop is stable with and without the task, while the handle is released."""
        return self.unstable_let_go == 0 and self.unstable_let_go_free == 0


def analyse(case: Case, structure: str, frequencies: np.ndarray = FREQUENCIES) -> Analysis:
    """Analyse the stability, passivity and transparency of a structure.

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
    port, s = case.port(structure), 1j * np.asarray(frequencies, float)
    unit = reference(case)
    return Analysis(
        structure, frequencies, hybrid(port, s), transmitted(port, s, case.task), case.task(s),
        scattering_norm(port, s, unit), loop_gain(port, s, case.hand, case.task),
        loop_gain(port, s, case.hand, _FREE), _counted(port, case.hand, case.task),
        _counted(port, case.hand, _FREE), _counted(port, _FREE, case.task),
        _counted(port, _FREE, _FREE), gain_margin(case, structure),
        largest_delay(case, structure), is_passive(port, unit),
    )  # fmt: skip


def loop_gain(
    port: TwoPort, s: np.ndarray | complex, hand: Block, environment: Block
) -> np.ndarray:
    """Return the gain of the loop through master and slave; Nyquist's critical point is -1.

    Args:
        port: the two-port.
        s: (...) complex frequencies [rad/s].
        hand: impedance of the operator's hand.
        environment: impedance of the task; with a zero impedance the result is Zhu's LG1.

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
    """Return the reference impedance `sqrt(B^2 + M K)` of the hand [N s/m], 1 if it is zero."""
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
    if scattering_norm(port, s, unit).max() > _PASSIVE:
        return False
    wall = Impedance(damping=unit)
    try:
        return unstable_poles(port, wall, wall, masses=1) == 0
    except OnTheAxis:
        return False


def holds(port: TwoPort, hand: Block, environment: Block) -> bool:
    """Return whether a loop is stable; a pole on the imaginary axis counts as unstable."""
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
    """Return the factor on the return channels at which stability changes; see `Analysis`."""

    def right(factor: float) -> bool:
        return holds(case.port(structure, factor), case.hand, case.task)

    if right(1.0):
        found = first_change(right, np.geomspace(1.0, MOST_TRIED, _STEPS))
        return math.inf if found is None else found
    found = first_change(right, np.geomspace(1.0, 1.0 / MOST_TRIED, _STEPS))
    return 0.0 if found is None else found


def largest_delay(case: Loop, structure: str) -> float:
    """Return the delay in each direction up to which the loop is stable [s]; see `Analysis`."""

    def right(delay: float) -> bool:
        return holds(case.with_delay(delay).port(structure), case.hand, case.task)

    if not right(0.0):
        return 0.0
    if not right(_DELAYS[0]):
        return 0.0
    found = first_change(right, np.geomspace(*_DELAYS, _STEPS))
    return math.inf if found is None else found


def first_change(right: Callable[[float], bool], points: np.ndarray) -> float | None:
    """Return where a condition first differs from its value at the first point, None if nowhere.

    Args:
        right: the condition.
        points: (n,) positive ordered values that are tested before the result is refined.

    Returns:
        The last value at which the condition is true, refined to 0.1 %.
    """
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
    """Return where a structure is stable on a grid of delays and return gains.

    Args:
        case: teleoperator with hand and task.
        structure: name of the structure.
        delays: (n,) delays in each direction [s].
        factors: (m,) factors on the return channels [1].

    Returns:
        (m, n), true where stable.
    """
    return np.array([
        [holds(case.with_delay(t).port(structure, k), case.hand, case.task) for t in delays]
        for k in map(float, factors)
    ])  # fmt: skip
