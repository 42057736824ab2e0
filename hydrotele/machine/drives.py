"""Parameters of the drives of a machine, in SI units.

Each `Axis` has one cylinder, motor or force drive, with its valve or pump, friction, load-holding
valves, transmission and end stops. The classes are pydantic models of the machine file.
"""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from hydrotele.core.datafile import Name, NonNegativeFloat, PositiveFloat, StrictModel, Vector


class Pin(StrictModel):
    """A point [m] fixed to a link or to the world."""

    link: Name
    position: Vector


class Friction(StrictModel):
    """Friction parameters of a drive: forces [N] or [N m], velocities [m/s] or [rad/s].

    Dry friction is `coulomb` plus `stribeck_extra` at rest; the latter decays with the velocity
    (`stribeck_velocity`). `viscous` [N s/m] or [N m s/rad] is proportional to the velocity.
    `smoothing_velocity` smooths the sign of dry friction. An asymmetry a multiplies the dry or the
    viscous friction by 1 + a in the positive direction and by 1 - a in the negative one. With a
    `presliding_stiffness` [N/m] or [N m/rad], dry friction is a spring below breakaway
    (`hydraulics.actuator`) with a damper `presliding_damping` [N s/m] or [N m s/rad]; dry friction
    then has no smoothed sign.
    """

    coulomb: NonNegativeFloat = 0.0
    stribeck_extra: NonNegativeFloat = 0.0
    stribeck_velocity: PositiveFloat = 0.02
    viscous: NonNegativeFloat = 0.0
    smoothing_velocity: PositiveFloat = 0.005
    coulomb_asymmetry: Annotated[float, Field(gt=-1, lt=1)] = 0.0
    viscous_asymmetry: Annotated[float, Field(gt=-1, lt=1)] = 0.0
    presliding_stiffness: NonNegativeFloat = 0.0
    presliding_damping: NonNegativeFloat = 0.0

    @model_validator(mode="after")
    def _check(self):
        if self.presliding_damping and not self.presliding_stiffness:
            raise ValueError("presliding_damping needs a presliding_stiffness")
        return self

    @property
    def has_presliding(self) -> bool:
        """Whether friction has presliding: its presliding stiffness and dry friction are above 0."""
        return self.presliding_stiffness > 0.0 and self.coulomb + self.stribeck_extra > 0.0


class CylinderPart(StrictModel):
    """Tube or rod of a cylinder: mass [kg], distance `com` of its centre of mass from its pin [m].

    The pin is the base pin for a tube and the rod pin for a rod. `inertia` [kg m^2] are the
    principal moments about the centre of mass; the first is about the cylinder's axis.
    """

    mass: PositiveFloat
    com: float
    inertia: tuple[PositiveFloat, PositiveFloat, PositiveFloat]


class Cylinder(StrictModel):
    """A hydraulic cylinder between two pins.

    The piston displacement is x = pin-to-pin length - closed_length, 0 .. stroke [m]. The areas
    [m^2] are those of the piston on both sides. `dead_volume` [m^3] is the volume of each chamber
    with the piston at its end, and `leakage` [m^3/(s Pa)] the laminar leakage past the piston.
    `hose_compliance` [m^3/Pa] is the volume increase of the hose of each chamber with pressure.
    """

    base_pin: Pin
    rod_pin: Pin
    closed_length: PositiveFloat
    stroke: PositiveFloat
    area_head: PositiveFloat
    area_rod: PositiveFloat
    dead_volume: PositiveFloat
    leakage: NonNegativeFloat
    hose_compliance: NonNegativeFloat = 0.0
    friction: Friction = Friction()
    tube: CylinderPart
    rod: CylinderPart

    @model_validator(mode="after")
    def _check(self):
        if self.area_rod > self.area_head:
            raise ValueError(f"area_rod {self.area_rod:g} exceeds area_head {self.area_head:g}")
        if self.stroke >= self.closed_length:
            raise ValueError(
                f"a stroke of {self.stroke:g} m does not fit into a closed_length of {self.closed_length:g} m"
            )
        return self

    @property
    def effective_areas(self) -> tuple[float, float]:
        """Head-side and rod-side piston area [m^2]."""
        return self.area_head, self.area_rod

    def chamber_volumes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return head and rod chamber volumes [m^3] at piston displacements x [m], any shape.

        Beyond an end of the stroke, the volumes are those at the end.
        """
        inside = np.clip(x, 0.0, self.stroke)
        left = self.stroke - inside
        return self.dead_volume + self.area_head * inside, self.dead_volume + self.area_rod * left


class Motor(StrictModel):
    """A hydraulic motor on a joint: displacement [m^3/rad], constant volume of each chamber [m^3].

    `leakage` [m^3/(s Pa)] is the laminar leakage between the ports, and `hose_compliance` [m^3/Pa]
    that of the hose of each port.
    """

    displacement: PositiveFloat
    dead_volume: PositiveFloat
    leakage: NonNegativeFloat
    hose_compliance: NonNegativeFloat = 0.0
    friction: Friction = Friction()

    @property
    def effective_areas(self) -> tuple[float, float]:
        """Displacements of port A and port B [m^3/rad], the equivalent of piston areas."""
        return self.displacement, self.displacement

    def chamber_volumes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the constant chamber volumes [m^3], in the shape of the motor angles x [rad]."""
        constant = np.full_like(x, self.dead_volume)
        return constant, constant


class ForceDrive(StrictModel):
    """A drive whose force or torque on the load is `gain * command - friction - offset` [N] or [N m].

    `command_limit` is the largest magnitude of the command [command_unit].
    """

    gain: float
    command_unit: Literal["1", "V", "N"] = "1"
    command_limit: PositiveFloat = 1.0
    friction: Friction = Friction()
    offset: float = 0.0

    @model_validator(mode="after")
    def _check(self):
        if self.gain == 0.0:
            raise ValueError("gain: with 0 no command moves the drive; remove the axis instead")
        return self


class FlowCurve(StrictModel):
    """Valve opening [1] over spool travel beyond the dead band [1], linear between 2 to 8 knots.

    Travel increases from 0 to 1. Opening starts at 0, never decreases, and is 1 at the rated flow.
    """

    travel: tuple[float, ...]
    opening: tuple[float, ...]

    @model_validator(mode="after")
    def _check(self):
        travel, opening = self.travel, self.opening
        if not 2 <= len(travel) <= 8 or len(opening) != len(travel):
            raise ValueError(
                f"needs 2 to 8 knots of travel and as many of opening; has {len(travel)} and {len(opening)}"
            )
        if travel[0] != 0.0 or travel[-1] != 1.0 or np.any(np.diff(travel) <= 0.0):
            raise ValueError(f"travel {travel} must increase from 0 to 1")
        if opening[0] != 0.0 or np.any(np.diff(opening) < 0.0) or opening[-1] == 0.0:
            raise ValueError(f"opening {opening} must start at 0, never decrease, and end above 0")
        return self


class Metering(StrictModel):
    """One direction of spool travel: dead band [1], gains of the two metering edges, flow curve.

    `inlet` and `outlet` [1] scale the flow gain from the pump into one chamber (P-A or P-B) and
    from the other chamber to tank (B-T or A-T). The default dead band is that of the valve.
    """

    deadband: Annotated[float, Field(ge=0, lt=1)] | None = None
    inlet: PositiveFloat = 1.0
    outlet: PositiveFloat = 1.0
    curve: FlowCurve | None = None


class Valve(StrictModel):
    """A spool valve: rated_flow [m^3/s] at rated_pressure_drop [Pa], bandwidth [rad/s].

    `slew_limit` [1/s] is the maximum speed of the spool. With `compensation: pressure` the drop
    over the inlet edge never exceeds `compensated_drop` [Pa] (by default the rated drop). The flow
    is then independent of the load, as long as the supply pressure suffices. `tank_leakage`
    [m^3/(s Pa)] is the laminar leakage from each work port to tank, through the radial clearance of
    the spool (`hydraulics.valve.chamber_flows`). `positive` and `negative` describe the two
    directions of travel; a positive command feeds the head side. `deadband` [1] applies to
    directions without their own. `port_relief` [Pa] is the setting of the relief valve at each work
    port. It and the make-up valve from tank pass `port_relief_gain` and `makeup_gain` [m^3/(s Pa)].
    Below the pressure drop `smoothing` [Pa] the root law of the orifices is smoothed.
    """

    rated_flow: PositiveFloat
    rated_pressure_drop: PositiveFloat = 7.0e6
    deadband: Annotated[float, Field(ge=0, lt=1)] = 0.0
    bandwidth: PositiveFloat
    damping: PositiveFloat = 0.9
    slew_limit: PositiveFloat | None = None
    compensation: Literal["none", "pressure"] = "none"
    compensated_drop: PositiveFloat | None = None
    positive: Metering = Metering()
    negative: Metering = Metering()
    port_relief: PositiveFloat = 32.0e6
    smoothing: PositiveFloat = 5.0e4
    port_relief_gain: NonNegativeFloat = 1.0e-9
    makeup_gain: NonNegativeFloat = 5.0e-9
    tank_leakage: NonNegativeFloat = 0.0

    @property
    def deadbands(self) -> tuple[float, float]:
        """Dead bands in the positive and the negative direction, as fractions of the spool travel [1]."""
        own = (self.positive.deadband, self.negative.deadband)
        forward, backward = (self.deadband if d is None else d for d in own)
        return forward, backward

    @property
    def compensator_pressure_drop(self) -> float:
        """Pressure drop that the compensator maintains at the inlet edge [Pa], 0 without one."""
        if self.compensation == "none":
            return 0.0
        return self.compensated_drop or self.rated_pressure_drop


class ElectricMotor(StrictModel):
    """A brushed DC motor on an H-bridge, with the drag torques of motor and pump.

    `voltage` [V] of the bridge at full duty, `resistance` [ohm], `torque_constant`
    [N m/A], equal to the constant of the back-EMF [V s/rad], `inertia` [kg m^2] of rotor and pump.
    Drag torques: constant `drag` [N m], additional `breakaway` [N m] at rest, which decays with
    `breakaway_speed` [rad/s], and `viscous` [N m s/rad].
    """

    renamed = {"emf": "torque_constant"}

    voltage: PositiveFloat
    resistance: PositiveFloat
    torque_constant: PositiveFloat
    inertia: PositiveFloat
    drag: NonNegativeFloat = 0.0
    breakaway: NonNegativeFloat = 0.0
    breakaway_speed: PositiveFloat = 10.0
    viscous: NonNegativeFloat = 0.0


_DEFAULT_STALL_PRESSURE = 2.0e7  # Pa, pressure limit of a pump circuit that no motor limits


class Accumulator(StrictModel):
    """A gas accumulator in place of a tank; values for the fully retracted cylinder.

    `pressure` [Pa] relative to the atmosphere, `gas_volume` [m^3] at that pressure, and line
    resistances [Pa s/m^3] for the extending and the retracting cylinder.
    """

    pressure: PositiveFloat
    gas_volume: PositiveFloat
    line_extending: PositiveFloat
    line_retracting: PositiveFloat


class Pump(StrictModel):
    """An individual pump of one axis with one direction of rotation; a valve selects the side.

    The command is the motor duty with the sign of the side, or, without a `motor`, the speed
    divided by `rated_speed` [rad/s]. `displacement` [m^3/rad], `leakage` [m^3/(s Pa)] to the
    suction line, `torque_loss` [1] as a fraction of displacement times pressure. For the oil
    between pump and piston: `bulk_modulus` [Pa] without air, `compliance_head` and `compliance_rod`
    [m^3/Pa] of hoses and walls, `air_head` and `air_rod` [m^3] at atmospheric pressure.
    """

    displacement: PositiveFloat
    leakage: NonNegativeFloat = 0.0
    torque_loss: NonNegativeFloat = 0.0
    rated_speed: PositiveFloat
    bulk_modulus: Annotated[float, Field(ge=1.0e7, le=1.0e11)]
    compliance_head: NonNegativeFloat = 0.0
    compliance_rod: NonNegativeFloat = 0.0
    air_head: NonNegativeFloat = 0.0
    air_rod: NonNegativeFloat = 0.0
    accumulator: Accumulator
    motor: ElectricMotor | None = None

    @property
    def rated_flow(self) -> float:
        """Flow at the rated speed [m^3/s]."""
        return self.displacement * self.rated_speed

    @property
    def stall_pressure(self) -> float:
        """Pressure difference that stalls the motor at full duty [Pa]; 20 MPa without a motor.

        It is `(k U / R - drag) / (D (1 + loss))` with the motor's torque constant k, voltage U,
        resistance R and drag torque. D is the pump's displacement, loss its fraction of lost torque.
        Common gear pumps are rated for 20 MPa.
        """
        motor = self.motor
        if motor is None:
            return _DEFAULT_STALL_PRESSURE
        torque = motor.torque_constant * motor.voltage / motor.resistance - motor.drag
        return max(torque, 0.0) / (self.displacement * (1.0 + self.torque_loss))


class LoadCylinder(StrictModel):
    """A cylinder that resists extension because its oil leaves through a relief valve.

    `area` [m^2]; `relief_pressure` [Pa] and its increase with the flow, `relief_override`
    [Pa s/m^3]; `stiffness` [N/m] of the oil; `unfilled_travel` [m], in which oil does not yet fill
    the chamber, with air at `air_pressure` [Pa]. Seal `friction` [1] is a fraction of the force;
    `return_force` [N] is an additional resistance while the cylinder returns.
    """

    renamed = {
        "override": "relief_override", "void": "unfilled_travel", "void_pressure": "air_pressure",
    }  # fmt: skip

    area: PositiveFloat
    relief_pressure: NonNegativeFloat
    relief_override: NonNegativeFloat = 0.0
    stiffness: PositiveFloat
    unfilled_travel: NonNegativeFloat = 0.0
    air_pressure: PositiveFloat = 2.0e4
    friction: NonNegativeFloat = 0.0
    return_force: NonNegativeFloat = 0.0


class Counterbalance(StrictModel):
    """A load-holding valve of a chamber: oil leaves only if p + pilot_ratio p_pilot > setting.

    `setting` [Pa]; p_pilot is the pressure of the other chamber. The valve is fully open at the
    setting times 1 + `override` [1]. Oil enters freely through a check valve.
    """

    setting: PositiveFloat
    pilot_ratio: NonNegativeFloat = 3.0
    override: PositiveFloat = 0.2


class LoadHolding(StrictModel):
    """Counterbalance valves of the head and the rod side of a drive."""

    head: Counterbalance | None = None
    rod: Counterbalance | None = None


class EndStop(StrictModel):
    """Spring [N/m] or [N m/rad] and damper [N s/m] or [N m s/rad] at both ends of travel.

    The damper acts only while the spring is compressed, and the total force never pulls.
    """

    stiffness: PositiveFloat
    damping: NonNegativeFloat


class FourBar(StrictModel):
    """Names of the links through which a cylinder moves the driven link: rocker and coupler.

    The cylinder's rod, the rocker and the coupler meet in one pin. A closure of the machine joins
    the coupler to the driven link.
    """

    rocker: Name
    coupler: Name


class Transmission(StrictModel):
    """Flexible transmission between drive and load: drive inertia, spring, damper and backlash.

    The drive acts on its own inertia [kg] or [kg m^2]. Spring [N/m] or [N m/rad] and damper
    [N s/m] or [N m s/rad] transmit the force to the load; within the backlash, of total width
    `backlash` [m] or [rad], only the damper acts. Friction and oil act on the drive side, which a
    cylinder's length sensor measures; the joint sensor measures the load side.
    """

    inertia: PositiveFloat
    stiffness: PositiveFloat
    damping: NonNegativeFloat = 0.0
    backlash: NonNegativeFloat = 0.0


class Axis(StrictModel):
    """A driven joint with exactly one cylinder, motor or force drive.

    A command reaches the valve or the drive after `command_delay` [s]. Valve commands are fractions
    in [-1, 1]. If logs have another unit, `command_range: [low, high]` [command_unit] gives the
    values of -1 and 1, such as [-10, 10] V or [4, 20] mA. Without an `end_stop`, `Machine.end_stop`
    estimates one.
    """

    joint: Name
    cylinder: Cylinder | None = None
    motor: Motor | None = None
    force: ForceDrive | None = None
    valve: Valve | None = None
    pump: Pump | None = None
    four_bar: FourBar | None = None
    command_delay: NonNegativeFloat = 0.0
    command_unit: str = "1"
    command_range: tuple[float, float] = (-1.0, 1.0)
    transmission: Transmission | None = None
    load_holding: LoadHolding = LoadHolding()
    end_stop: EndStop | None = None

    @model_validator(mode="after")
    def _check(self):
        drives = [d for d in ("cylinder", "motor", "force") if getattr(self, d) is not None]
        if len(drives) != 1:
            raise ValueError(f"needs exactly one of cylinder, motor, force; has {drives or 'none'}")
        fed = (self.valve is not None) + (self.pump is not None)
        if fed != (self.force is None):
            raise ValueError("a cylinder or motor needs either a valve or a pump; a force drive must have neither")
        if self.pump:
            self._check_pump_axis()
        if self.force and self.load_holding != LoadHolding():
            raise ValueError("a force drive has no oil and cannot have load_holding valves")
        if self.command_range[0] == self.command_range[1]:
            raise ValueError("command_range must be [low, high], the values for -1 and 1")
        stated = self.command_unit != "1" or self.command_range != (-1.0, 1.0)
        if stated and self.force:
            raise ValueError(
                "command_unit and command_range apply to a valve; for a force drive give"
                " force.command_unit and force.command_limit"
            )
        if self.command_unit != "1" and self.command_range == (-1.0, 1.0):
            raise ValueError(
                f"command_unit {self.command_unit!r} needs the command_range [low, high] of its"
                " values, such as [-10, 10]"
            )
        if self.four_bar and not self.cylinder:
            raise ValueError("a four_bar linkage needs a cylinder")
        return self

    def _check_pump_axis(self) -> None:
        if self.cylinder is None or self.four_bar or self.transmission:
            raise ValueError("a pump can only drive a cylinder without four_bar and transmission")
        if self.load_holding != LoadHolding():
            raise ValueError("load_holding valves need a valve; an axis with a pump has none")
        if self.cylinder.hose_compliance:
            raise ValueError("give pump.compliance_head and pump.compliance_rod instead of cylinder.hose_compliance")
        if self.cylinder.friction.presliding_stiffness:
            raise ValueError(
                "an axis with a pump has friction without presliding: remove cylinder.friction.presliding_stiffness"
            )
        if self.end_stop is None:
            raise ValueError("an axis with a pump needs an end_stop: it cannot be estimated without a relief pressure")

    @property
    def is_hydraulic(self) -> bool:
        """Whether the axis is hydraulic: it has a valve or an individual pump."""
        return self.valve is not None or self.pump is not None

    @property
    def rated_flow(self) -> float:
        """Flow of the valve at its rated drop, or of the individual pump at its rated speed [m^3/s]."""
        source = self.valve or self.pump
        assert source is not None
        return source.rated_flow

    @property
    def hydraulic_drive(self) -> Cylinder | Motor:
        """Cylinder or motor of the axis, which must be hydraulic."""
        drive = self.cylinder or self.motor
        assert drive is not None
        return drive

    @property
    def drive(self) -> Cylinder | Motor | ForceDrive:
        """Cylinder, motor or force drive of the axis."""
        drive = self.cylinder or self.motor or self.force
        assert drive is not None
        return drive
