"""A teleoperator's two-port with hand and task: what is felt, passivity, stability and margins.

What a teleoperator is analysed with: its two sides, hand, task, gains and delays.

A teleoperator's parameters as a YAML file: `hydrotele analyse teleop` reads it.

`hydrotele/teleop/cat215_axis.yaml` is the one that is shipped, with the source of every number.
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
    """One axis of a teleoperator, with hand and task, in one scale of lengths and forces.

    Attributes:
        master: what the hand moves.
        slave: what the task feels.
        master_control: damper and spring of the master's controller.
        slave_control: of the slave's.
        hand: the operator's.
        task: impedance of the environment.
        gains: of the channels.
        delay_forward: from the master to the slave [s].
        delay_back: from the slave to the master [s].
        wave: impedance b of wave variables [N s/m]; 0 for the slave controller's damping.
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
        """Refuse controllers that hold a mass: they would need accelerations."""
        if self.master_control.mass or self.slave_control.mass:
            raise InputError("teleoperator", "controllers are dampers and springs, without mass")

    @property
    def delay(self) -> float:
        """Mean of both delays [s]; stability depends on their sum only."""
        return 0.5 * (self.delay_forward + self.delay_back)

    def with_delay(self, delay: float) -> "Case":
        """The same with a delay [s] each way."""
        return replace(self, delay_forward=delay, delay_back=delay)

    def port(self, structure: str, reflected: float = 1.0) -> TwoPort:
        """The two-port of a structure.

        Args:
            structure: as of `two_port`.
            reflected: factor on both channels that come back, C2 and C4, which is the gain of the
                loop through hand and task [1].

        Returns:
            The two-port.

        Raises:
            InputError: as of `two_port`.
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
    """A body, the hand or the task: mass [kg], damping [N s/m], stiffness [N/m]."""

    mass: NonNegative = 0.0
    damping: NonNegative = 0.0
    stiffness: NonNegative = 0.0

    def impedance(self) -> Impedance:
        """The same as a function of frequency."""
        return Impedance(self.mass, self.damping, self.stiffness)


class RigidBody(Facts):
    """Master or slave, which have a mass [kg], and perhaps damping [N s/m], stiffness [N/m]."""

    mass: Positive
    damping: NonNegative = 0.0
    stiffness: NonNegative = 0.0

    def impedance(self) -> Impedance:
        """The same as a function of frequency."""
        return Impedance(self.mass, self.damping, self.stiffness)


class Controller(Facts):
    """Damping [N s/m] and stiffness [N/m] of a controller."""

    damping: NonNegative = 0.0
    stiffness: NonNegative = 0.0

    def impedance(self) -> Impedance:
        """The same as a function of frequency."""
        return Impedance(0.0, self.damping, self.stiffness)


class ChannelGains(Facts):
    """Gains of the channels, as of `two_port.Gains`; velocity in 1/s."""

    position: Positive = 1.0
    velocity: Positive = 1.0
    force: NonNegative = 1.0


class Delays(Facts):
    """Delays [s] from the master to the slave and back."""

    forward: Delay = 0.0
    back: Delay = 0.0


class VaryingSpring(Facts):
    """A joystick axis with stiffness feedback, without the hand, which is added to it."""

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
        """The same for the theorem."""
        return Spring(self.mass, self.damping, self.nominal, self.least, self.most)


class MapRange(Facts):
    """Range of the map of stability: delay each way [s], factor on what comes back [1]."""

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
    """Impedances that are drawn, every number log-uniform between least and most."""

    least: Side
    most: Side

    @model_validator(mode="after")
    def _ordered(self):
        for name in ("mass", "damping", "stiffness"):
            if not getattr(self.least, name) <= getattr(self.most, name):
                raise ValueError(f"{name}: least must not be above most")
        return self


class TeleopCase(Facts):
    """Everything that an analysis needs; one axis, all in one scale of lengths and forces."""

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
        """The same for the two-port."""
        gains = Gains(self.gains.position, self.gains.velocity, self.gains.force)
        return Case(
            self.master.impedance(), self.slave.impedance(), self.master_control.impedance(),
            self.slave_control.impedance(), self.hand.impedance(), self.task.impedance(), gains,
            self.delays.forward, self.delays.back, self.wave,
        )  # fmt: skip


def known_structures(
    names: tuple[str, ...], known: tuple[str, ...] = STRUCTURES
) -> tuple[str, ...]:
    """The same names, once each.

    Raises:
        ValueError: one is not known.
    """
    for name in names:
        if name not in known:
            raise ValueError(f"no structure {name!r}; {suggest(name, known)}")
    return tuple(dict.fromkeys(names))


def load_teleop_case(path: str | Path | None = None) -> TeleopCase:
    """Read a case.

    Args:
        path: YAML file, None for the shipped one.

    Returns:
        The case.

    Raises:
        InputError: names file, line, key and what is allowed.
    """
    path = SHIPPED if path is None else path
    data, lines = read_yaml(path)
    return parse(TeleopCase, data, str(path), lines)


# rad/s, from slow motions to a flotor's bandwidth; not round, as poles without damping may be
FREQUENCIES = 2.0 * np.pi * np.geomspace(0.016, 160.0, 1601)
_FREE = Impedance()
_PASSIVE = 1.0 + 1e-6  # rounding in the inverse of a lossless port's matrix stays below
_STEPS = 61  # tried before a margin is refined
_REFINED = 1e-3  # of a margin
LONGEST_TRIED = 10.0  # s each way
MOST_TRIED = 1e3  # factor on the loop's gain
_DELAYS = (1e-4, LONGEST_TRIED)


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
        unstable_let_go: with the task and no hand on the handle.
        unstable_let_go_free: with neither.
        gain_margin: factor on what comes back up to which the loop stays stable; below 1 where the
            case is unstable, 0 where no factor helps, infinite where none was found that hurts.
        largest_delay: each way, up to which it stays stable [s]; 0 where it is unstable without,
            infinite where it is stable with 10 s, the longest that is tried.
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
    unstable_let_go: int | None
    unstable_let_go_free: int | None
    gain_margin: float
    largest_delay: float
    passive: bool

    @property
    def stable(self) -> bool:
        """Whether it is stable with the task and without, a hand on the handle."""
        return self.unstable_poles == 0 and self.unstable_free == 0

    @property
    def stable_let_go(self) -> bool:
        """Whether it is stable with the task and without, the handle let go."""
        return self.unstable_let_go == 0 and self.unstable_let_go_free == 0


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
        _counted(port, case.hand, _FREE), _counted(port, _FREE, case.task),
        _counted(port, _FREE, _FREE), gain_margin(case, structure),
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
        found = first_change(right, np.geomspace(1.0, MOST_TRIED, _STEPS))
        return math.inf if found is None else found
    found = first_change(right, np.geomspace(1.0, 1.0 / MOST_TRIED, _STEPS))
    return 0.0 if found is None else found


def largest_delay(case: Loop, structure: str) -> float:
    """Delay each way up to which the loop is stable [s]; see `Analysis`."""

    def right(delay: float) -> bool:
        return holds(case.with_delay(delay).port(structure), case.hand, case.task)

    if not right(0.0):
        return 0.0
    if not right(_DELAYS[0]):
        return 0.0
    found = first_change(right, np.geomspace(*_DELAYS, _STEPS))
    return math.inf if found is None else found


def first_change(right: Callable[[float], bool], points: np.ndarray) -> float | None:
    """Where an answer first differs from that at the first point; None if it never does.

    Args:
        right: the question.
        points: (n,) positive ones, in order, which are tried before the place is refined.

    Returns:
        The last place where the answer is yes, refined to 0.1 %.
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
