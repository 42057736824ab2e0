"""Axis of a teleoperator (masses, controllers, channels, delays; SI units) and the YAML case file that describes it.

A teleoperator couples a master, which the operator's hand moves, with a slave, which acts on the
task. `hydrotele analyse teleop` reads the case file. `hydrotele/teleop/cat215_axis.yaml` is the
default file; it gives the source of every parameter.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator, model_validator

from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    PositiveFloat,
    StrictModel,
    read_yaml,
    suggest_valid_name,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.teleop.stiffness_switching import StiffnessAxis
from hydrotele.teleop.two_port import STRUCTURES, Block, Impedance, StructureGains, TwoPort, make_two_port


@dataclass(frozen=True)
class TeleoperatorAxis:
    """One axis of a teleoperator with hand and task.

    Slave and task are scaled to the lengths and forces of the master.

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
        wave: wave impedance b, for the structure with wave variables [N s/m]; 0 selects the slave
            controller's damping.
    """

    master: Impedance
    slave: Impedance
    master_control: Impedance
    slave_control: Impedance
    hand: Impedance
    task: Impedance
    gains: StructureGains = field(default_factory=StructureGains)
    delay_forward: float = 0.0
    delay_back: float = 0.0
    wave: float = 0.0

    def __post_init__(self) -> None:
        """Raise InputError if a controller has a mass, since it would need accelerations."""
        if self.master_control.mass or self.slave_control.mass:
            raise InputError("teleoperator", "controllers are dampers and springs, without mass")

    @property
    def delay(self) -> float:
        """Mean of the forward and the return delay [s]; stability depends only on their sum."""
        return 0.5 * (self.delay_forward + self.delay_back)

    def with_delay(self, delay: float) -> "TeleoperatorAxis":
        """Return a copy of the axis with the same delay [s] in each direction."""
        return replace(self, delay_forward=delay, delay_back=delay)

    def make_port(self, structure: str, return_gain: float = 1.0) -> TwoPort:
        """Return the linear two-port of this axis with a given control structure.

        Args:
            structure: name, one of `STRUCTURES`, such as `position_force`.
            return_gain: factor on the force and the velocity that are returned from the slave to the
                master [1]; it scales the gain of the loop through hand and task.

        Returns:
            The two-port.

        Raises:
            InputError: the structure is not known, or a gain or a delay is invalid.
        """
        made = make_two_port(
            structure, self.master, self.slave, self.master_control, self.slave_control,
            self.gains, delay_forward=self.delay_forward, delay_back=self.delay_back,
        )  # fmt: skip
        if return_gain == 1.0:
            return made
        return replace(
            made,
            force_back=_scale_block(made.force_back, return_gain),
            velocity_back=_scale_block(made.velocity_back, return_gain),
        )


def _scale_block(block: Block, factor: float) -> Block:
    def evaluate_scaled(s: np.ndarray) -> np.ndarray:
        return factor * block(s)

    return evaluate_scaled


DEFAULT_CASE_FILE = Path(__file__).resolve().with_name("cat215_axis.yaml")
MAX_DELAY = 10.0  # s
Delay = Annotated[float, Field(ge=0, le=MAX_DELAY)]


class ImpedanceParameters(StrictModel):
    """Mass [kg], damping [N s/m] and stiffness [N/m] of the hand or the task."""

    mass: NonNegativeFloat = 0.0
    damping: NonNegativeFloat = 0.0
    stiffness: NonNegativeFloat = 0.0

    def impedance(self) -> Impedance:
        """Convert the data of the file to an `Impedance`, a function of complex frequency."""
        return Impedance(self.mass, self.damping, self.stiffness)


class BodyParameters(StrictModel):
    """Mass [kg], damping [N s/m] and stiffness [N/m] of the master or the slave, without control."""

    mass: PositiveFloat
    damping: NonNegativeFloat = 0.0
    stiffness: NonNegativeFloat = 0.0

    def impedance(self) -> Impedance:
        """Convert the data of the file to an `Impedance`, a function of complex frequency."""
        return Impedance(self.mass, self.damping, self.stiffness)


class ControllerParameters(StrictModel):
    """Damping [N s/m] and stiffness [N/m] of the controller of master or slave."""

    damping: NonNegativeFloat = 0.0
    stiffness: NonNegativeFloat = 0.0

    def impedance(self) -> Impedance:
        """Convert the data of the file to an `Impedance`, a function of complex frequency."""
        return Impedance(0.0, self.damping, self.stiffness)


class ChannelGains(StrictModel):
    """Gains of the channels between master and slave.

    `position` is the slave's position per master position [1], `velocity` the slave's velocity per
    master position under rate control [1/s], `force` the reflected per environment force [1].
    """

    position: PositiveFloat = 1.0
    velocity: PositiveFloat = 1.0
    force: NonNegativeFloat = 1.0


class Delays(StrictModel):
    """Delays [s] from the master to the slave and from the slave to the master."""

    forward: Delay = 0.0
    back: Delay = 0.0


class StiffnessFeedbackAxis(StrictModel):
    """Joystick axis whose stiffness follows the machine's force, without the operator's hand.

    Stiffnesses [N/m], `damping` [N s/m] and `mass` [kg]; the analysis adds the hand.
    """

    renamed = {"nominal": "nominal_stiffness", "least": "min_stiffness", "most": "max_stiffness"}

    nominal_stiffness: NonNegativeFloat
    min_stiffness: NonNegativeFloat
    max_stiffness: PositiveFloat
    damping: NonNegativeFloat
    mass: PositiveFloat

    @model_validator(mode="after")
    def _check_order(self):
        if not self.min_stiffness <= self.nominal_stiffness <= self.max_stiffness:
            raise ValueError(
                "must be ordered, min_stiffness <= nominal_stiffness <= max_stiffness:"
                f" {self.min_stiffness:g}, {self.nominal_stiffness:g}, {self.max_stiffness:g}"
            )
        return self

    def to_stiffness_axis(self) -> StiffnessAxis:
        """Convert the data of the file to a `StiffnessAxis`, whose properties test stability."""
        return StiffnessAxis(self.mass, self.damping, self.nominal_stiffness, self.min_stiffness, self.max_stiffness)


class MapRange(StrictModel):
    """Range of the stability map, a grid of delay and return gain with `points` values of each.

    `max_delay` is the largest delay in each direction [s]; the factors multiply the return channels.
    """

    renamed = {
        "longest_delay": "max_delay", "least_factor": "min_factor", "most_factor": "max_factor",
    }  # fmt: skip

    max_delay: Annotated[float, Field(gt=0, le=MAX_DELAY)] = 0.5
    min_factor: PositiveFloat = 0.01
    max_factor: PositiveFloat = 100.0
    points: Annotated[int, Field(ge=3, le=200)] = 25

    @model_validator(mode="after")
    def _check_order(self):
        if not self.min_factor < self.max_factor:
            raise ValueError("min_factor must be below max_factor")
        return self


class ImpedanceRange(StrictModel):
    """Range of mass, damping and stiffness for random sampling, log-uniform from `min` to `max`."""

    renamed = {"least": "min", "most": "max"}

    min: ImpedanceParameters
    max: ImpedanceParameters

    @model_validator(mode="after")
    def _check_order(self):
        for name in ("mass", "damping", "stiffness"):
            if not getattr(self.min, name) <= getattr(self.max, name):
                raise ValueError(f"{name}: min must not be above max")
        return self


class TeleopCaseFile(StrictModel):
    """Contents of a YAML file for `hydrotele analyse teleop`: one axis, and what to analyse.

    Slave and task are scaled to the lengths and forces of the master. `structures` are the control
    structures to compare, `stiffness` an optional joystick axis with stiffness feedback. `hands` and
    `tasks` are ranges for random sampling, `map` is the range of the stability map.
    `wave_impedance` [N s/m] belongs to the structure with wave variables; 0 selects the slave
    controller's damping.
    """

    renamed = {"wave": "wave_impedance"}

    name: Name
    master: BodyParameters
    slave: BodyParameters
    master_control: ControllerParameters
    slave_control: ControllerParameters
    hand: ImpedanceParameters
    task: ImpedanceParameters
    gains: ChannelGains = Field(default_factory=ChannelGains)
    delays: Delays = Field(default_factory=Delays)
    structures: Annotated[tuple[str, ...], Field(min_length=1)] = STRUCTURES
    stiffness: StiffnessFeedbackAxis | None = None
    wave_impedance: NonNegativeFloat = 0.0
    hands: ImpedanceRange | None = None
    tasks: ImpedanceRange | None = None
    map: MapRange = Field(default_factory=MapRange)

    @field_validator("structures")
    @classmethod
    def _check_structures(cls, names):
        return check_structures(names)

    def to_axis(self) -> TeleoperatorAxis:
        """Convert the input file to a `TeleoperatorAxis` for the two-port."""
        gains = StructureGains(self.gains.position, self.gains.velocity, self.gains.force)
        return TeleoperatorAxis(
            self.master.impedance(), self.slave.impedance(), self.master_control.impedance(),
            self.slave_control.impedance(), self.hand.impedance(), self.task.impedance(), gains,
            self.delays.forward, self.delays.back, self.wave_impedance,
        )  # fmt: skip


def check_structures(names: tuple[str, ...], known: tuple[str, ...] = STRUCTURES) -> tuple[str, ...]:
    """Check names of control structures and return them without duplicates.

    Raises:
        ValueError: a name is not in `known`.
    """
    for name in names:
        if name not in known:
            raise ValueError(f"no structure {name!r}; {suggest_valid_name(name, known)}")
    return tuple(dict.fromkeys(names))


def load_teleop_case(path: str | Path | None = None) -> TeleopCaseFile:
    """Read and validate the YAML file that describes a teleoperator axis for the linear analysis.

    Args:
        path: YAML file, None for the default file.

    Returns:
        The validated contents.

    Raises:
        InputError: the file is invalid; the message gives file, line, key and the allowed values.
    """
    path = DEFAULT_CASE_FILE if path is None else path
    data, lines = read_yaml(path)
    return validate_data(TeleopCaseFile, data, str(path), lines)
