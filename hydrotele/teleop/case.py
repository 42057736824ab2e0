"""What a teleoperator is analysed with: its two sides, hand, task, gains and delays.

A teleoperator's parameters as a YAML file: `hydrotele analyse teleop` reads it.

`hydrotele/teleop/cat215_axis.yaml` is the one that is shipped, with the source of every number.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator, model_validator

from hydrotele.core.datafile import Facts, Name, NonNegative, Positive, parse, read_yaml, suggest
from hydrotele.core.errors import InputError
from hydrotele.teleop.switching import Spring
from hydrotele.teleop.two_port import STRUCTURES, Block, Gains, Impedance, TwoPort, two_port


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


class Body(Facts):
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


class TeleopCase(Facts):
    """Everything that an analysis needs; one axis, all in one scale of lengths and forces."""

    name: Name
    master: Body
    slave: Body
    master_control: Controller
    slave_control: Controller
    hand: Side
    task: Side
    gains: ChannelGains = Field(default_factory=ChannelGains)
    delays: Delays = Field(default_factory=Delays)
    structures: Annotated[tuple[str, ...], Field(min_length=1)] = STRUCTURES
    stiffness: VaryingSpring | None = None
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
            self.delays.forward, self.delays.back,
        )  # fmt: skip


def known_structures(names: tuple[str, ...]) -> tuple[str, ...]:
    """The same names, once each.

    Raises:
        ValueError: one is not known.
    """
    for name in names:
        if name not in STRUCTURES:
            raise ValueError(f"no structure {name!r}; {suggest(name, STRUCTURES)}")
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
