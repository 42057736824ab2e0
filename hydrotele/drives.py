"""Facts of the drives: cylinders, motors, force drives, their valves, friction and transmission."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from hydrotele.datafile import Facts, Name, NonNegative, Positive, Vector


class Pin(Facts):
    """A point [m] fixed to a link (or to the world)."""

    link: Name
    position: Vector


class Friction(Facts):
    """Friction numbers of `hydraulics.friction`: [N] or [N m], velocities [m/s] or [rad/s].

    An asymmetry a makes the dry or the viscous part (1 + a) times as large in the positive
    direction and (1 - a) times in the negative one.
    """

    coulomb: NonNegative = 0.0
    stribeck_extra: NonNegative = 0.0
    stribeck_velocity: Positive = 0.02
    viscous: NonNegative = 0.0
    smoothing_velocity: Positive = 0.005
    coulomb_asymmetry: Annotated[float, Field(gt=-1, lt=1)] = 0.0
    viscous_asymmetry: Annotated[float, Field(gt=-1, lt=1)] = 0.0


class Bar(Facts):
    """Tube or rod of a cylinder: com is its distance [m] from its own pin."""

    mass: Positive
    com: float
    inertia: tuple[Positive, Positive, Positive]


class Cylinder(Facts):
    """A hydraulic cylinder between two pins; x = pin-to-pin length - closed_length, 0 .. stroke.

    `hose_compliance` [m^3/Pa] is the swelling of the hose at each chamber.
    """

    base_pin: Pin
    rod_pin: Pin
    closed_length: Positive
    stroke: Positive
    area_head: Positive
    area_rod: Positive
    dead_volume: Positive
    leakage: NonNegative
    hose_compliance: NonNegative = 0.0
    friction: Friction = Friction()
    tube: Bar
    rod: Bar

    @model_validator(mode="after")
    def _check(self):
        if self.area_rod > self.area_head:
            raise ValueError(f"area_rod {self.area_rod:g} exceeds area_head {self.area_head:g}")
        if self.stroke >= self.closed_length:
            raise ValueError(
                f"a stroke of {self.stroke:g} m does not fit into a closed_length of"
                f" {self.closed_length:g} m"
            )
        return self

    @property
    def areas(self) -> tuple[float, float]:
        """Head-side and rod-side piston area [m^2]."""
        return self.area_head, self.area_rod

    def volumes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Head and rod chamber volumes [m^3] at piston displacements x [m], any shape."""
        left = self.stroke - x
        return self.dead_volume + self.area_head * x, self.dead_volume + self.area_rod * left


class Motor(Facts):
    """A hydraulic motor on a joint: displacement [m^3/rad], constant chamber volumes [m^3]."""

    displacement: Positive
    dead_volume: Positive
    leakage: NonNegative
    hose_compliance: NonNegative = 0.0
    friction: Friction = Friction()

    @property
    def areas(self) -> tuple[float, float]:
        """Displacement of port A and of port B [m^3/rad], in the place of piston areas."""
        return self.displacement, self.displacement

    def volumes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Constant chamber volumes [m^3], in the shape of the motor angles x [rad]."""
        constant = np.full_like(x, self.dead_volume)
        return constant, constant


class ForceDrive(Facts):
    """A plain force or torque drive: `gain command = load + friction + offset` [N] or [N m]."""

    gain: float
    command_unit: Literal["1", "V", "N"] = "1"
    command_limit: Positive = 1.0
    friction: Friction = Friction()
    offset: float = 0.0


class Valve(Facts):
    """A spool valve: rated_flow [m^3/s] at rated_pressure_drop [Pa], bandwidth [rad/s]."""

    rated_flow: Positive
    rated_pressure_drop: Positive = 7.0e6
    deadband: Annotated[float, Field(ge=0, lt=1)] = 0.0
    bandwidth: Positive
    damping: Positive = 0.9
    port_relief: Positive = 32.0e6
    smoothing: Positive = 5.0e4
    port_relief_gain: NonNegative = 1.0e-9
    makeup_gain: NonNegative = 5.0e-9


class FourBar(Facts):
    """Names of the links between cylinder and joint of a four-bar linkage."""

    rocker: Name
    coupler: Name


class Transmission(Facts):
    """What gives between drive and load: a spring with a gap, and the drive's own inertia.

    The drive acts on its own inertia [kg] or [kg m^2]; spring [N/m] or [N m/rad] and damper
    [N s/m] or [N m s/rad] carry the force on to the load; inside the gap, `backlash` [m] or [rad]
    wide from end to end, only the damper does. Friction and oil act on the drive side, and a
    cylinder's length sensor reads it; the joint's own sensor reads the load.
    """

    inertia: Positive
    stiffness: Positive
    damping: NonNegative = 0.0
    backlash: NonNegative = 0.0


class Axis(Facts):
    """One driven joint with exactly one of cylinder, motor or force.

    `command_delay` [s] passes before a command reaches the valve or the drive. A valve's commands
    are fractions in [-1, 1]; where logs have them in another unit, `command_range: [low, high]`
    [command_unit] says which values stand for -1 and 1, such as [-10, 10] V or [4, 20] mA.
    """

    joint: Name
    cylinder: Cylinder | None = None
    motor: Motor | None = None
    force: ForceDrive | None = None
    valve: Valve | None = None
    four_bar: FourBar | None = None
    command_delay: NonNegative = 0.0
    command_unit: str = "1"
    command_range: tuple[float, float] = (-1.0, 1.0)
    transmission: Transmission | None = None

    @model_validator(mode="after")
    def _check(self):
        drives = [d for d in ("cylinder", "motor", "force") if getattr(self, d) is not None]
        if len(drives) != 1:
            raise ValueError(f"needs exactly one of cylinder, motor, force; has {drives or 'none'}")
        if (self.force is None) == (self.valve is None):
            raise ValueError("a cylinder or motor needs a valve; a plain force drive has none")
        if self.command_range[0] == self.command_range[1]:
            raise ValueError("command_range must be [low, high], the commands of -1 and 1")
        stated = self.command_unit != "1" or self.command_range != (-1.0, 1.0)
        if stated and self.force:
            raise ValueError(
                "command_unit and command_range are those of a valve; a plain force drive has"
                " force.command_unit and force.command_limit"
            )
        if self.command_unit != "1" and self.command_range == (-1.0, 1.0):
            raise ValueError(
                f"command_unit {self.command_unit!r} needs the command_range [low, high] of its"
                " values, such as [-10, 10]"
            )
        if self.four_bar and not self.cylinder:
            raise ValueError("a four_bar linkage is moved by a cylinder")
        return self

    @property
    def hydraulic(self) -> bool:
        """Whether the axis has a valve and chambers."""
        return self.valve is not None

    @property
    def hydraulic_drive(self) -> Cylinder | Motor:
        """The cylinder or the motor of a hydraulic axis."""
        drive = self.cylinder or self.motor
        assert drive is not None
        return drive

    @property
    def drive(self) -> Cylinder | Motor | ForceDrive:
        """The cylinder, the motor or the force drive."""
        drive = self.cylinder or self.motor or self.force
        assert drive is not None
        return drive
