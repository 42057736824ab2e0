"""Machine data in SI units: links, joints, drives, supply, arm and sensor sets.

They come from `models/<machine>/machine.yaml` and its MJCF file. Position and inertia of a link are
in one of the two files, never in both.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    PositiveFloat,
    StrictModel,
    Vector,
    replace_at_path,
    suggest_valid_name,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import describe_excess
from hydrotele.machine.drives import Axis, EndStop, LoadCylinder, Pin
from hydrotele.machine.log_columns import LogColumnEntry
from hydrotele.machine.oil import Oil
from hydrotele.machine.sensors import Sensor, SensorError, SensorSet, make_channel_converter
from hydrotele.terms.term import Term


class Joint(StrictModel):
    """One degree of freedom: `range` [rad] or [m], `damping` [N m s/rad] or [N s/m].

    `bending` [rad/(N m)] is the compliance of the link of a hinge about both axes perpendicular to
    the hinge axis.
    """

    name: Name
    type: Literal["hinge", "slide"] = "hinge"
    axis: Vector = (0.0, 0.0, 1.0)
    range: tuple[float, float] | None = None
    damping: NonNegativeFloat = 0.0
    bending: NonNegativeFloat = 0.0

    @model_validator(mode="after")
    def _check(self):
        if self.bending and self.type != "hinge":
            raise ValueError("bending applies to a hinge only; remove it from the slide")
        if abs(np.linalg.norm(self.axis) - 1.0) > 1e-6:
            raise ValueError(f"axis {self.axis} must have unit length")
        if self.range and self.range[0] >= self.range[1]:
            raise ValueError(f"range {self.range} must be [low, high] with low < high")
        return self


class Link(StrictModel):
    """A rigid body: position in the parent frame [m], mass [kg], inertia about com [kg m^2]."""

    parent: Name = "world"
    position: Vector = (0.0, 0.0, 0.0)
    joint: Joint | None = None
    mass: PositiveFloat
    com: Vector = (0.0, 0.0, 0.0)
    inertia: tuple[PositiveFloat, PositiveFloat, PositiveFloat]

    @model_validator(mode="after")
    def _check(self):
        a, b, c = sorted(self.inertia)
        if a + b < c * (1 - 1e-9):
            raise ValueError(
                f"inertia {self.inertia} is impossible for a rigid body: the largest moment exceeds"
                " the sum of the other two"
            )
        return self


class Closure(StrictModel):
    """A pin joint that closes a kinematic loop: the two points coincide."""

    a: Pin
    b: Pin


UNLIMITED_FLOW = 1.0e3  # m^3/s, exceeds any demand: flow of a supply without a limit
_END_STOP_TRAVEL = 1.0e-3  # m: elongation of tube, gland and pins at the largest cylinder force
_END_STOP_ROTATION = 2.0e-3  # rad: deformation of a rotary drive at its largest torque
_END_STOP_TIME_CONSTANT = 5.0e-3  # s: damps a 75 rad/s oscillation of a boom within two periods


class Supply(StrictModel):
    """Pump and tank shared by all valves; pressures [Pa], flow [m^3/s], bulk modulus [Pa].

    `constant_flow`: the pump delivers `pump_flow`; the surplus flows through the relief valve.
    `load_sensing`: the pump maintains the highest load pressure plus `load_sensing_margin`, within
    `pump_flow` and `relief_pressure`. `constant_pressure`: the pump maintains `relief_pressure` at
    any flow. `pump_droop` [m^3/(s Pa)] is the decrease of pump flow with pressure.
    `relief_override` [Pa s/m^3] is the increase of the relief pressure with flow, above the opening
    pressure `relief_pressure`; only a `constant_flow` supply has one.
    With a `time_constant` [s] the pump displacement follows the demand with a first-order lag, like
    a swash plate; 0 means without lag. `dissolved_air` is the volume of air, at atmospheric
    pressure, per volume of oil that is released below atmospheric pressure (mineral oil: 0.07 ..
    0.10). `entrained_air` is the volume of bubbles, at atmospheric pressure, per volume of oil; it
    reduces the stiffness of the oil at low pressure.
    """

    kind: Literal["constant_flow", "load_sensing", "constant_pressure"] = "constant_flow"
    relief_pressure: PositiveFloat
    tank_pressure: NonNegativeFloat
    pump_flow: PositiveFloat = UNLIMITED_FLOW
    pump_droop: NonNegativeFloat = 0.0
    relief_override: NonNegativeFloat = 0.0
    load_sensing_margin: PositiveFloat = 2.0e6
    time_constant: NonNegativeFloat = 0.0
    bulk_modulus: Annotated[float, Field(ge=1.0e7, le=1.0e11)]
    dissolved_air: Annotated[float, Field(ge=0.001, le=0.5)] = 0.09
    entrained_air: Annotated[float, Field(ge=0.0, le=0.2)] = 0.0

    @property
    def max_pressure(self) -> float:
        """Maximum supply pressure [Pa]: that with the whole pump flow through the relief valve."""
        return self.relief_pressure + self.relief_override * self.pump_flow

    @model_validator(mode="after")
    def _check(self):
        if self.kind == "constant_pressure":
            if self.pump_flow != UNLIMITED_FLOW or self.pump_droop:
                raise ValueError(
                    "a constant_pressure supply has no pump_flow and no pump_droop: remove them,"
                    " or choose kind constant_flow or load_sensing"
                )
            if self.time_constant:
                raise ValueError(
                    "a constant_pressure supply has no lag: remove time_constant, or choose kind"
                    " constant_flow or load_sensing"
                )
        elif self.pump_flow >= UNLIMITED_FLOW:
            raise ValueError(f"pump_flow is missing; a {self.kind} supply needs it")
        if self.pump_droop * self.relief_pressure >= self.pump_flow:
            raise ValueError(
                f"pump_droop {self.pump_droop:g} m^3/(s Pa) reduces pump_flow"
                f" {self.pump_flow:g} m^3/s to 0 below relief_pressure {self.relief_pressure:g} Pa"
            )
        if self.relief_override and self.kind != "constant_flow":
            raise ValueError(
                f"a {self.kind} supply has no flow through its relief valve: remove"
                " relief_override, or choose kind constant_flow"
            )
        if self.tank_pressure >= self.relief_pressure:
            raise ValueError(
                f"tank_pressure {self.tank_pressure:g} Pa is not below relief_pressure"
                f" {self.relief_pressure:g} Pa; are both in Pa?"
            )
        return self


class PumpGroup(StrictModel):
    """One of several pumps and the axes that it feeds; a value that is None is that of `supply`.

    The axis `priority` keeps the rated pressure drop of its valve before the other axes receive
    flow. The other values are described in `Supply`.
    """

    axes: Annotated[tuple[Name, ...], Field(min_length=1)]
    priority: Name | None = None
    kind: Literal["constant_flow", "load_sensing", "constant_pressure"] | None = None
    relief_pressure: PositiveFloat | None = None
    pump_flow: PositiveFloat | None = None
    pump_droop: NonNegativeFloat | None = None
    relief_override: NonNegativeFloat | None = None
    load_sensing_margin: PositiveFloat | None = None
    time_constant: NonNegativeFloat | None = None

    @model_validator(mode="after")
    def _check(self):
        if self.priority is not None:
            _check_name_is_known(self.priority, self.axes, "priority")
        return self


class MergingValve(StrictModel):
    """A valve that moves a share of the flow of pump `from_supply` to the line of pump `to_supply`.

    The spool of the axis whose name is the key in `Machine.merging` shifts it, as one pilot pressure
    shifts both. `share` [1] is linear in the spool position `travel` [1] between 2 to 8 knots, and
    constant beyond them. A faulty valve moves `share_scale` times this share.
    """

    from_supply: Name
    to_supply: Name
    travel: Annotated[tuple[Annotated[float, Field(ge=-1.0, le=1.0)], ...], Field(min_length=2, max_length=8)]
    share: tuple[Annotated[float, Field(ge=0.0, le=1.0)], ...]
    share_scale: Annotated[float, Field(ge=0.0)] = 1.0

    @model_validator(mode="after")
    def _check(self):
        if len(self.share) != len(self.travel) or np.any(np.diff(self.travel) <= 0.0):
            raise ValueError("needs as many values of share as of travel, and travel must increase")
        if self.from_supply == self.to_supply:
            raise ValueError("from_supply and to_supply must be different pumps")
        return self


class Engine(StrictModel):
    """The engine that drives all pumps: `power` [W], and `efficiency` [1] from engine to oil.

    If the hydraulic power of all pumps exceeds `efficiency * power`, one common factor reduces the
    flows of all pumps.
    """

    power: PositiveFloat
    efficiency: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0


class Arm(StrictModel):
    """Names of the joints of an arm from swing over boom and stick to tool and head, and its tip.

    `tool` rotates in the plane of the arm, like a bucket or the tilt of a feller-buncher. `head`
    rotates on the tool about an axis in the plane of the arm, perpendicular to the tool.
    """

    swing: Name
    boom: Name
    stick: Name
    tool: Name | None = None
    head: Name | None = None
    tip: Pin

    @model_validator(mode="after")
    def _check(self):
        if self.head and not self.tool:
            raise ValueError("arm.head needs a tool joint: give arm.tool, for example the tilt")
        return self


class Machine(StrictModel):
    """Complete description of a machine with one tool, for simulation, control and identification.

    `mjcf` and `attached` files are relative to `folder`. `attached` maps the name of a body of
    `mjcf` to an MJCF file whose bodies are attached to it; `removed_bodies` are the bodies of
    unused tools. `supply` is the pump and the oil; with several pumps, `supplies` are the pumps by
    name, `merging` the merging valves by the axis that shifts them, and `supply` the oil and the
    values that the pumps share. `engine` limits the power of all pumps. `sensed_joints` are the
    joints with the angle sensors of a calibrator, starting at the machine. `home` are the joint
    positions at home [rad] or [m]. `loads` are the load cylinders of pump axes. `log_columns` maps
    columns of log files to channels. `uncertainty` are standard deviations of parameters by name.
    `terms` are additional force, flow and command laws.

    Examples:
        >>> import hydrotele as ht
        >>> rig = ht.load_machine("rig")
        >>> rig.position_kind("slide"), rig.joints["slide"].range
        ('position', (0.0, 0.5))

        A machine is frozen; `replace` returns a changed copy, and validates it.

        >>> heavy = rig.replace("links.carriage.mass", 400.0)
        >>> rig.links["carriage"].mass, heavy.links["carriage"].mass
        (200.0, 400.0)
        >>> try:
        ...     rig.replace("links.carriage.mass", -1.0)
        ... except ht.InputError as error:
        ...     print(error)
        links.carriage.mass: cannot be -1.0: Input should be greater than 0
    """

    name: Name
    description: str = ""
    source: str = ""
    mjcf: str | None = None
    attached: dict[Name, str] = {}
    folder: str = ""
    tool: Name = "none"
    tools: tuple[str, ...] = ("none",)
    gravity: Vector = (0.0, 0.0, -9.81)
    links: dict[Name, Link]
    axes: dict[Name, Axis]
    sensed_joints: tuple[Name, ...] = ()
    closures: dict[Name, Closure] = {}
    supply: Supply | None = None
    supplies: dict[Name, PumpGroup] = {}
    merging: dict[Name, MergingValve] = {}
    engine: Engine | None = None
    loads: dict[Name, LoadCylinder] = {}
    oil: Oil | None = None
    sensors: dict[Name, SensorSet] = {}
    sensor_errors: dict[str, SensorError] = {}
    home: dict[Name, float] = {}
    arm: Arm | None = None
    log_columns: dict[str, LogColumnEntry] = {}
    removed_bodies: tuple[str, ...] = ()
    uncertainty: dict[str, NonNegativeFloat] = {}
    terms: tuple[Term, ...] = ()

    def __repr__(self) -> str:
        """Return name, tool and axes; `model_dump()` returns all values."""
        return f"Machine({self.name!r}, tool={self.tool!r}, axes=[{', '.join(self.axes)}])"

    __str__ = __repr__

    def replace(self, path: str, value: Any, validate: bool = True) -> "Machine":
        """Return a copy of the machine with the value at a dotted path replaced.

        Args:
            path: such as `supply.pump_flow`, `axes.boom.valve.deadband` or `gravity.2`.
            value: the new value, in SI units.
            validate: check the new value and the whole machine. Without the check, a series of
                replacements may pass through machines that are not valid.

        Returns:
            The changed machine.

        Raises:
            InputError: the path does not exist (the message lists the valid ones), or the value is not valid.
        """
        return replace_at_path(self, path, value, validate)

    @property
    def joints(self) -> dict[str, Joint]:
        """Joints of the links by name, in tree order."""
        return {link.joint.name: link.joint for link in self.links.values() if link.joint}

    @property
    def hydraulic_axes(self) -> dict[str, Axis]:
        """Axes with a valve or an individual pump.

        With several pumps, the axes of a pump follow one another, that with priority first.
        """
        found = {name: axis for name, axis in self.axes.items() if axis.is_hydraulic}
        order = [n for g in self.supplies.values() for n in sorted(g.axes, key=lambda a: a != g.priority)]
        return {**{name: found[name] for name in order if name in found}, **found}

    @property
    def valve_axes(self) -> dict[str, Axis]:
        """Axes with a valve, in the order of `hydraulic_axes`."""
        return {name: axis for name, axis in self.hydraulic_axes.items() if axis.valve}

    @property
    def pumps(self) -> dict[str, Supply]:
        """Pumps that feed valves, by name; a single pump without a name is called `supply`."""
        if not self.supplies or self.supply is None:
            return {"supply": self.supply} if self.supply else {}
        own = {name: group.model_dump(exclude={"axes", "priority"}, exclude_none=True)
               for name, group in self.supplies.items()}  # fmt: skip
        return {name: self.supply.model_copy(update=values) for name, values in own.items()}

    @property
    def supply_channels(self) -> tuple[str, ...]:
        """Names of the channels of the pumps' pressures, in the order of `pumps`."""
        return tuple(f"pressure_supply.{name}" for name in self.supplies) or ("pressure_supply",)

    def pump_of(self, axis: str) -> str:
        """Return the name in `pumps` of the pump that feeds the valve of an axis."""
        return next((name for name, group in self.supplies.items() if axis in group.axes), "supply")

    def supply_channel(self, axis: str) -> str:
        """Return the name of the channel with the pressure of the pump that feeds an axis."""
        return f"pressure_supply.{self.pump_of(axis)}" if self.supplies else "pressure_supply"

    def axes_of_pump(self, pump: str) -> tuple[str, ...]:
        """Return the valve axes that a pump of `pumps` feeds, in the order of `hydraulic_axes`."""
        return tuple(name for name in self.valve_axes if self.pump_of(name) == pump)

    def max_feed_pressure(self, axis: str) -> float:
        """Return the maximum feed pressure of a hydraulic axis [Pa].

        It is the maximum pressure of the common supply, or the stall pressure of the axis' own
        pump.
        """
        pump = self.axes[axis].pump
        if pump:
            return pump.stall_pressure
        return self.pumps[self.pump_of(axis)].max_pressure

    def return_pressure(self, axis: str) -> float:
        """Return the pressure to which a hydraulic axis drains [Pa].

        It is the tank pressure of the common supply, or the accumulator pressure of the axis' own
        pump.
        """
        pump = self.axes[axis].pump
        if pump:
            return pump.accumulator.pressure
        assert self.supply
        return self.supply.tank_pressure

    def link_of(self, joint: str) -> str:
        """Return the name of the link that a joint moves."""
        return next(n for n, li in self.links.items() if li.joint and li.joint.name == joint)

    def position_kind(self, axis: str) -> str:
        """Return the kind of an axis's position channel: `angle` for a hinge, `position` for a slide."""
        return "angle" if self.joints[self.axes[axis].joint].type == "hinge" else "position"

    def end_stop(self, axis: str) -> EndStop | None:
        """Return the end stop of an axis, or None if its travel is unlimited.

        Without a cylinder and a joint range the travel is unlimited. An end stop of the machine
        file is returned as it is; otherwise it is estimated. The estimated stiffness is the largest
        drive force divided by 1 mm or 2 mrad, the typical deformation of tube, gland and pins of a
        heavy cylinder at that force. The estimated damping is 5 ms times the stiffness. For a force
        drive with gain 0 nothing is estimated.
        """
        facts = self.axes[axis]
        joint = self.joints[facts.joint]
        if facts.cylinder is None and joint.range is None:
            return None
        if facts.end_stop or (facts.force and not facts.force.gain):
            return facts.end_stop
        if facts.force:
            most = abs(facts.force.gain) * facts.force.command_limit
        else:
            most = self.pumps[self.pump_of(axis)].relief_pressure * facts.hydraulic_drive.effective_areas[0]
        turns = facts.cylinder is None and joint.type == "hinge"
        stiffness = most / (_END_STOP_ROTATION if turns else _END_STOP_TRAVEL)
        return EndStop(stiffness=stiffness, damping=_END_STOP_TIME_CONSTANT * stiffness)

    @property
    def undriven_sensed_joints(self) -> tuple[str, ...]:
        """Joints in `sensed_joints` without a drive; driven joints use the channel of their axis."""
        driven = {axis.joint for axis in self.axes.values()}
        return tuple(joint for joint in self.sensed_joints if joint not in driven)

    @property
    def sensed_channels(self) -> tuple[str, ...]:
        """Names of the position, length and pressure channels that sensors of this machine can measure."""
        names = [f"{self.position_kind(axis)}.{axis}" for axis in self.axes]
        names += [f"angle.{joint}" for joint in self.undriven_sensed_joints]
        names += [f"length.{name}" for name, axis in self.axes.items() if axis.cylinder]
        for side in ("head", "rod"):
            names += [f"pressure_{side}.{axis}" for axis in self.hydraulic_axes]
        return (*names, *self.supply_channels) if self.valve_axes else tuple(names)

    @model_validator(mode="after")
    def _check(self):
        if excess := describe_excess("LINKS", len(self.links)):
            raise ValueError(f"links: {excess}")
        _check_unique_joint_names(self.links)
        known = {"world", *self.links}
        for name, link in self.links.items():
            _check_name_is_known(link.parent, known - {name}, f"links.{name}.parent")
        _check_parent_cycles(self.links)
        joints = self.joints
        for name, axis in self.axes.items():
            _check_name_is_known(axis.joint, joints, f"axes.{name}.joint")
            if axis.cylinder:
                _check_name_is_known(axis.cylinder.base_pin.link, known, f"axes.{name}.cylinder.base_pin.link")
                _check_name_is_known(axis.cylinder.rod_pin.link, known, f"axes.{name}.cylinder.rod_pin.link")
            if axis.four_bar:
                _check_name_is_known(axis.four_bar.rocker, known, f"axes.{name}.four_bar.rocker")
                _check_name_is_known(axis.four_bar.coupler, known, f"axes.{name}.four_bar.coupler")
        for name, closure in self.closures.items():
            for end in (closure.a, closure.b):
                _check_name_is_known(end.link, known, f"closures.{name}")
        for joint in self.sensed_joints:
            _check_name_is_known(joint, joints, "sensed_joints")
            if joints[joint].type != "hinge":
                raise ValueError(f"sensed_joints: {joint} must be a hinge")
        if strange := [j for j in self.undriven_sensed_joints if j in self.axes]:
            message = f"{strange[0]} is also the name of an axis of another joint; rename one"
            raise ValueError(f"sensed_joints: {message}")
        for joint in self.home:
            _check_name_is_known(joint, joints, "home")
            low, high = joints[joint].range or (-np.inf, np.inf)
            if not low <= self.home[joint] <= high:
                raise ValueError(f"home.{joint}: {self.home[joint]:g} is outside its range {low:g} .. {high:g}")
        if self.arm:
            for part in ("swing", "boom", "stick", "tool", "head"):
                joint = getattr(self.arm, part)
                if joint is not None:
                    _check_name_is_known(joint, joints, f"arm.{part}")
            _check_name_is_known(self.arm.tip.link, known, "arm.tip.link")
        for channel, error in self.sensor_errors.items():
            _check_name_is_known(channel, self.sensed_channels, "sensor_errors")
            if error.has_misalignment_or_backlash:
                places = [f"angle.{joint}" for joint in self.undriven_sensed_joints]
                _check_name_is_known(channel, places, "sensor_errors (tilt, backlash)")
        _check_terms(self.terms, self.axes, self.pumps, self.pump_of)
        for name, sensors in self.sensors.items():
            for mounted, sensor in sensors.mounted.items():
                _check_name_is_known(sensor.link, known, f"sensors.{name}.mounted.{mounted}.link")
            for channel in sensors.channels:
                known = (*self.sensed_channels, *(f"velocity.{axis}" for axis in self.axes))
                _check_name_is_known(channel, known, f"sensors.{name}.channels")
        for name, axis in self.axes.items():
            if axis.pump and self.joints[axis.joint].type != "slide":
                raise ValueError(f"axes.{name}.pump: the axis must have a slide joint")
        for name in self.loads:
            _check_name_is_known(name, [n for n, a in self.axes.items() if a.pump], "loads")
        if self.valve_axes and self.supply is None:
            raise ValueError("valves need a supply: give supply.relief_pressure, pump_flow, ...")
        if len(self.hydraulic_axes) > 8:
            raise ValueError("a machine can have at most 8 valves and axes with their own pump")
        _check_pumps(self)
        return self


def _check_name_is_known(name: str, valid, where: str) -> None:
    if name not in valid:
        raise ValueError(f"{where}: {name!r} is not known; {suggest_valid_name(name, valid)}")


def _check_pumps(machine: Machine) -> None:
    """Raise ValueError if the pumps, merging valves and engine of a machine do not fit its axes."""
    fed = [name for group in machine.supplies.values() for name in group.axes]
    for name, group in machine.supplies.items():
        if name == "supply" or name in machine.axes:
            raise ValueError(f"supplies.{name}: choose a name that is neither `supply` nor an axis")
        for axis in group.axes:
            _check_name_is_known(axis, machine.valve_axes, f"supplies.{name}.axes")
    if fed and (len(set(fed)) < len(fed) or set(fed) != set(machine.valve_axes)):
        message = "every axis with a valve must belong to exactly one pump"
        raise ValueError(f"supplies: {message}: {', '.join(machine.valve_axes)}")
    if fed:
        for name, pump in machine.pumps.items():
            try:
                Supply.model_validate(pump.model_dump())
            except ValueError as error:
                raise ValueError(f"supplies.{name}: {error}") from None
    for axis, valve in machine.merging.items():
        _check_name_is_known(axis, machine.valve_axes, "merging")
        for end in (valve.from_supply, valve.to_supply):
            _check_name_is_known(end, machine.supplies, f"merging.{axis}")
    unlimited = [name for name, pump in machine.pumps.items() if pump.kind == "constant_pressure"]
    if unlimited and (machine.engine or machine.merging or any(g.priority for g in machine.supplies.values())):
        message = "has no limited flow to merge, to limit by an engine or to divide by priority"
        raise ValueError(f"{unlimited[0]}: a constant_pressure supply {message}")


def _check_terms(terms: tuple[Term, ...], axes: dict[str, Axis], pumps: dict[str, Supply], pump_of) -> None:
    seen = set()
    for k, term in enumerate(terms):
        _check_name_is_known(term.axis, axes, f"terms.{k}.axis")
        if term.balance.startswith("flow") and not axes[term.axis].is_hydraulic:
            raise ValueError(f"terms.{k}: axis {term.axis} has no chambers for a {term.balance}")
        pump = pumps.get(pump_of(term.axis)) if axes[term.axis].valve else None
        if term.balance == "flow_supply" and (pump is None or pump.kind == "constant_pressure"):
            raise ValueError(
                f"terms.{k}: flow_supply adds to the flow of a shared pump: it needs an axis with a"
                " valve and a supply of kind constant_flow or load_sensing"
            )
        for variable, axis in term.variables_from.items():
            _check_name_is_known(axis, axes, f"terms.{k}.variables_from.{variable}")
            if variable not in ("position", "velocity", "command") and not axes[axis].is_hydraulic:
                raise ValueError(f"terms.{k}.variables_from: axis {axis} has no {variable}")
        memory = term.play or term.switch
        if memory and not any(axis.is_hydraulic for axis in axes.values()):
            raise ValueError(f"terms.{k}: play or switch needs a machine with hydraulic axes")
        pushed = axes[term.variables_from.get("force", term.axis)]
        if memory and memory.variable == "force" and not pushed.is_hydraulic:
            raise ValueError(f"terms.{k}: play or switch of the force needs a hydraulic axis")
        key = (term.name, term.axis, term.balance)
        if key in seen:
            raise ValueError(
                f"terms.{k}: {term.name} already adds to {term.balance} of {term.axis}; rename the second term"
            )
        seen.add(key)


def _check_unique_joint_names(links: dict[str, Link]) -> None:
    if "world" in links:
        raise ValueError("links.world: world is the fixed frame; choose another name")
    owner: dict[str, str] = {}
    for name, link in links.items():
        if link.joint and (first := owner.setdefault(link.joint.name, name)) != name:
            raise ValueError(f"links.{name}.joint: {link.joint.name!r} is already the joint of link {first!r}")


def _check_parent_cycles(links: dict[str, Link]) -> None:
    for start in links:
        seen, link = {start}, links[start].parent
        while link != "world":
            if link in seen:
                raise ValueError(f"links.{start}: its parents form a cycle ({', '.join(seen)})")
            seen.add(link)
            link = links[link].parent


def find_dependent_joints(machine: Machine) -> tuple[str, ...]:
    """Return the names of the undriven joints in closed kinematic loops; the loops determine their positions."""
    driven = {axis.joint for axis in machine.axes.values()}
    names: list[str] = []
    for closure in machine.closures.values():
        for link in find_links_between(machine, closure.a.link, closure.b.link):
            joint = machine.links[link].joint
            if joint and joint.name not in driven and joint.name not in names:
                names.append(joint.name)
    return tuple(names)


def find_links_between(machine: Machine, a: str, b: str) -> list[str]:
    """Return the links on the path between two links of the kinematic tree, without their common ancestors."""
    chains = []
    for link in (a, b):
        chain = []
        while link != "world":
            chain.append(link)
            link = machine.links[link].parent
        chains.append(chain)
    return [x for x in chains[0] + chains[1] if not (x in chains[0] and x in chains[1])]


IDEAL_SENSORS = "ideal"

_SENSOR_KIND_OF_CHANNEL = {
    "angle": "angle",
    "position": "position",
    "length": "length",
    "pressure_head": "pressure",
    "pressure_rod": "pressure",
    "pressure_supply": "pressure",
    "velocity": "velocity",
}


def get_sensor_set(machine: Machine, name: str) -> SensorSet | None:
    """Return a sensor set of a machine by name, and None for the name `ideal` (true values, no set).

    Raises:
        InputError: the machine has no such sensor set; the message lists the valid names.
    """
    if name == IDEAL_SENSORS:
        return None
    if name not in machine.sensors:
        raise InputError(
            f"sensors {name!r}",
            f"machine {machine.name} does not have them; {suggest_valid_name(name, [IDEAL_SENSORS, *machine.sensors])}",
        )
    return machine.sensors[name]


def find_channel_sensor(machine: Machine, sensors: SensorSet | None, channel: str) -> Sensor:
    """Return the sensor that measures a channel according to a sensor set; an ideal sensor for None.

    The channel's own entry in the set replaces the sensor of its kind. The default span of a length
    sensor with a converter is the cylinder's stroke.
    """
    if sensors is None:
        return Sensor()
    kind, _, axis = channel.partition(".")
    of_kind: Sensor = getattr(sensors, _SENSOR_KIND_OF_CHANNEL[kind]) or Sensor()
    sensor = sensors.channels.get(channel, of_kind)
    if kind == "length" and sensor.bits and sensor.span is None:
        cylinder = machine.axes[axis].cylinder
        assert cylinder
        return sensor.model_copy(update={"span": cylinder.stroke})
    return sensor


def rate_channels(machine: Machine) -> tuple[str, ...]:
    """Return the channels `velocity.AXIS` that a sensor set of a machine measures, in the order of its axes.

    Rates that no sensor measures, such as differences of positions, contain no additional information.
    """
    channels = (f"velocity.{axis}" for axis in machine.axes)
    return tuple(c for c in channels if any(s.velocity or c in s.channels for s in machine.sensors.values()))


def reading_noise_rms(machine: Machine, sensors: SensorSet | None, channel: str) -> float:
    """Return the standard deviation of a reading [channel's unit]: random error and rounding."""
    sensor = find_channel_sensor(machine, sensors, channel)
    return math.sqrt(sensor.error_rms**2 + make_channel_converter(sensor, channel).step ** 2 / 12.0)
