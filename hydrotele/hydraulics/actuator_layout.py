"""Actuator parameters of a Machine in the layout of MuJoCo's `actuator_user`.

`Slot` and `PumpSlot` define the index of every parameter; the native hydraulics read them there.
"""

import enum
import math

import numpy as np

from hydrotele.kinematics.drive_linkage import drive_travel
from hydrotele.machine.drives import Axis, Counterbalance, FlowCurve, LoadCylinder, Pump, Valve
from hydrotele.machine.machine import Machine, Supply
from hydrotele.terms.table import encode_terms_table, terms_with_hysteresis

CURVE_KNOTS = 8  # largest number of knots of a valve's flow curve in one direction


class Slot(enum.IntEnum):
    """Indices of an actuator's parameters in `actuator_user`, all in SI units.

    For optional effects, the value 0 disables the effect (for metering ratios, 1 does). BRISTLE,
    DELIVERY and ADDED_DELIVERY are indices of activations, counted from the first hydraulic axis.
    EXTRA_STATES is the number of additional activations after those of the hydraulic axes (see
    `extra_state_names`). The axes of a pump follow one another; the parameters of a pump are read
    at its first axis. There GROUP_SIZE is their number, and PRIORITY_DROP the pressure drop that
    the first axis keeps before the others are fed. MERGE_FROM and MERGE_TO are the first axes of
    two pumps, counted from the first hydraulic axis. MERGE_CURVE is the start of the curve of a
    merging valve: number of knots (0: no valve), CURVE_KNOTS spool positions, CURVE_KNOTS shares.
    CURVES, the last, is the start of two flow curves, for the positive and the negative direction.
    Each has the number of knots (0: linear), CURVE_KNOTS travels and CURVE_KNOTS openings.
    """

    @staticmethod
    def _generate_next_value_(name, start, count, last_values):
        return count

    MARKER = enum.auto()
    KIND = enum.auto()
    FIRST = enum.auto()
    COUNT = enum.auto()
    AREA_HEAD = enum.auto()
    AREA_ROD = enum.auto()
    VOLUME_HEAD = enum.auto()
    VOLUME_ROD = enum.auto()
    STROKE = enum.auto()
    LEAKAGE = enum.auto()
    BANDWIDTH = enum.auto()
    DAMPING = enum.auto()
    DEADBAND = enum.auto()
    FLOW_GAIN = enum.auto()
    ORIFICE_SMOOTHING = enum.auto()
    PORT_RELIEF = enum.auto()
    RELIEF_GAIN = enum.auto()
    MAKEUP_GAIN = enum.auto()
    BULK_MODULUS = enum.auto()
    TANK_PRESSURE = enum.auto()
    AIR_RELEASE = enum.auto()
    AIR_ONSET = enum.auto()
    ENTRAINED_AIR = enum.auto()
    RELIEF_PRESSURE = enum.auto()
    PUMP_FLOW = enum.auto()
    COULOMB = enum.auto()
    STRIBECK = enum.auto()
    STRIBECK_VELOCITY = enum.auto()
    VISCOUS = enum.auto()
    COULOMB_VELOCITY = enum.auto()
    OFFSET = enum.auto()
    COULOMB_ASYMMETRY = enum.auto()
    VISCOUS_ASYMMETRY = enum.auto()
    HOSE_COMPLIANCE = enum.auto()
    DRIVE_INERTIA = enum.auto()
    DEADBAND_NEGATIVE = enum.auto()
    SLEW_LIMIT = enum.auto()
    METERING_PA = enum.auto()
    METERING_BT = enum.auto()
    METERING_PB = enum.auto()
    METERING_AT = enum.auto()
    COMPENSATED_DROP = enum.auto()
    TANK_LEAKAGE = enum.auto()
    HOLDING_HEAD = enum.auto()
    HOLDING_HEAD_RATIO = enum.auto()
    HOLDING_HEAD_RANGE = enum.auto()
    HOLDING_ROD = enum.auto()
    HOLDING_ROD_RATIO = enum.auto()
    HOLDING_ROD_RANGE = enum.auto()
    LOAD_SENSING_MARGIN = enum.auto()
    PUMP_DROOP = enum.auto()
    RELIEF_OVERRIDE = enum.auto()
    STOP_LOW = enum.auto()
    STOP_HIGH = enum.auto()
    STOP_STIFFNESS = enum.auto()
    STOP_DAMPING = enum.auto()
    BRISTLE_STIFFNESS = enum.auto()
    BRISTLE_DAMPING = enum.auto()
    BRISTLE_INERTIA = enum.auto()
    BRISTLE = enum.auto()
    PUMP_TIME_CONSTANT = enum.auto()
    DELIVERY = enum.auto()
    ADDED_DELIVERY = enum.auto()
    EXTRA_STATES = enum.auto()
    GROUP_SIZE = enum.auto()
    PRIORITY_DROP = enum.auto()
    ENGINE_POWER = enum.auto()
    MERGE_FROM = enum.auto()
    MERGE_TO = enum.auto()
    MERGE_CURVE = enum.auto()
    CURVES = MERGE_CURVE + 1 + 2 * CURVE_KNOTS


CURVE_SIZE = 1 + 2 * CURVE_KNOTS  # number of parameters of one flow curve


class PumpSlot(enum.IntEnum):
    """Indices of a pump drive's parameters, counted from PUMP_OFFSET after its first parameter; SI units."""

    DISPLACEMENT = 0
    LEAKAGE = 1
    RATED_SPEED = 2
    BULK_MODULUS = 3
    COMPLIANCE_HEAD = 4
    COMPLIANCE_ROD = 5
    AIR_HEAD = 6
    AIR_ROD = 7
    ACCUMULATOR_PRESSURE = 8
    GAS_VOLUME = 9
    LINE_EXTENDING = 10
    LINE_RETRACTING = 11
    VOLTAGE = 12
    RESISTANCE = 13
    EMF = 14
    INERTIA = 15
    DRAG = 16
    BREAKAWAY = 17
    BREAKAWAY_SPEED = 18
    VISCOUS_DRAG = 19
    TORQUE_LOSS = 20
    MOVING_MASS = 21
    LOAD_AREA = 22
    LOAD_RELIEF = 23
    LOAD_OVERRIDE = 24
    LOAD_STIFFNESS = 25
    LOAD_VOID = 26
    LOAD_VOID_PRESSURE = 27
    LOAD_FRICTION = 28
    LOAD_RETURN = 29


PUMP_OFFSET = Slot.CURVES + 2 * CURVE_SIZE  # index of the pump drive's block
SLOT_COUNT = PUMP_OFFSET + len(PumpSlot)


class ActuatorKind(enum.IntEnum):
    """Kinds of actuators: cylinder, rotary motor, force drive with friction, or pump drive.

    PUMP_DRIVE is a cylinder with its own pump instead of a valve.
    """

    CYLINDER = 1
    MOTOR = 2
    FORCE = 3
    PUMP_DRIVE = 4


DELIVERY_STATE = "delivery"
ADDED_DELIVERY_STATE = "added_delivery"
ACTUATOR_MARKER = 215325.0  # arbitrary value of actuator_user[0] that marks hydrotele's actuators


def actuator_order(machine: Machine) -> list[str]:
    """Return the axis names in actuator order: hydraulic axes first, as they share the supply."""
    return [*machine.hydraulic_axes, *(n for n, a in machine.axes.items() if not a.is_hydraulic)]


def extra_state_names(machine: Machine) -> list[str]:
    """Return the names of the additional states after the activations of the hydraulic axes.

    In this order: `bristle.<axis>` for every hydraulic axis with presliding friction,
    `delivery.<pump>` for every pump with a time constant, `added_delivery.<pump>` if terms add to
    its flow, `memory.term_<k>` for every term with hysteresis, and `bristle.<axis>` for the force
    drives. Most machines have none.
    """
    rubbing = [n for n in actuator_order(machine) if machine.axes[n].drive.friction.has_presliding]
    names = [f"bristle.{n}" for n in rubbing if machine.axes[n].is_hydraulic]
    if machine.valve_axes:
        names += [f"{DELIVERY_STATE}.{name}" for name, pump in machine.pumps.items() if pump.time_constant]
    added_to = {machine.pump_of(term.axis) for term in machine.terms if term.balance == "flow_supply"}
    names += [f"{ADDED_DELIVERY_STATE}.{name}" for name in machine.pumps if name in added_to]
    names += [f"memory.term_{k + 1}" for k in range(len(terms_with_hysteresis(machine.terms)))]
    return names + [f"bristle.{n}" for n in rubbing if not machine.axes[n].is_hydraulic]


def actuator_parameters(machine: Machine) -> dict[str, np.ndarray]:
    """Return the `actuator_user` parameters of every axis, in actuator order.

    Args:
        machine: the machine.

    Returns:
        Axis name -> (SLOT_COUNT,) parameters in SI, with the indices of `Slot`.
    """
    count = len(machine.hydraulic_axes)
    memory = {name: 4 * count + k for k, name in enumerate(extra_state_names(machine))}
    rubbing = [f"bristle.{n}" for n, axis in machine.axes.items() if not axis.is_hydraulic]
    shared = sum(name not in rubbing for name in memory)
    table = {}
    for name in actuator_order(machine):
        numbers = np.zeros(SLOT_COUNT)
        axis = machine.axes[name]
        numbers[Slot.MARKER] = ACTUATOR_MARKER
        numbers[Slot.COUNT] = count if axis.is_hydraulic else 0
        numbers[Slot.EXTRA_STATES] = shared if axis.is_hydraulic else 0
        if f"bristle.{name}" in memory:
            numbers[Slot.BRISTLE_STIFFNESS] = axis.drive.friction.presliding_stiffness
            numbers[Slot.BRISTLE_DAMPING] = axis.drive.friction.presliding_damping
            numbers[Slot.BRISTLE] = memory[f"bristle.{name}"]
        numbers[Slot.GROUP_SIZE] = count if axis.is_hydraulic else 0
        if axis.valve:
            _write_pump_group(numbers, machine, name, memory)
        _write_friction(numbers, axis)
        _write_end_stop(numbers, machine, name)
        if axis.transmission:
            numbers[Slot.DRIVE_INERTIA] = axis.transmission.inertia
        if axis.pump:
            _write_pump_drive(numbers, machine, name)
        elif axis.is_hydraulic and machine.supply:
            _write_valve_axis(numbers, axis, machine.pumps[machine.pump_of(name)])
        else:
            numbers[Slot.KIND] = ActuatorKind.FORCE
            numbers[Slot.OFFSET] = axis.force.offset if axis.force else 0.0
        table[name] = numbers
    return table


def machine_terms_table(machine: Machine) -> np.ndarray:
    """Encode the terms (additional force, flow and command laws) of a machine for compiled code.

    See `terms.table.encode_terms_table` for the layout of the array (n,), which is empty without
    terms.
    """
    names, first = extra_state_names(machine), 4 * len(machine.hydraulic_axes)
    own = [k for k, name in enumerate(names) if name.startswith("memory.")]
    areas = {name: machine.axes[name].hydraulic_drive.effective_areas for name in machine.hydraulic_axes}
    at = first + own[0] if own else 0
    return encode_terms_table(machine.terms, actuator_order(machine), at, areas)


def max_pump_drive_time_step(machine: Machine, name: str) -> float:
    """Return the longest time step that resolves the piston motion of an axis with its own pump.

    `k h^2 <= m + b h`: at most one radian of the piston's oscillation on its oil per step, or the
    corresponding decay if it is damped. k is the largest stiffness of the oil, without air, plus
    that of the load cylinder. Steps are powers of two, so that small parameter changes seldom
    change the step.

    Args:
        machine: the machine.
        name: name of the axis.

    Returns:
        Time step [s], a power of two times 1 ms.

    Source: stability limit of Verlet's method, h < 2 / omega, halved.

    >>> from hydrotele.machine.machine_file import load_machine
    >>> max_pump_drive_time_step(load_machine("eha", "load_30_bar"), "piston")
    0.002
    """
    numbers = actuator_parameters(machine)[name]
    block, stroke = numbers[PUMP_OFFSET:], numbers[Slot.STROKE]
    stiffness = np.zeros(2)  # at both ends of the stroke
    for area, volume, soft, travel in (
        (Slot.AREA_HEAD, Slot.VOLUME_HEAD, PumpSlot.COMPLIANCE_HEAD, np.array([0.0, stroke])),
        (Slot.AREA_ROD, Slot.VOLUME_ROD, PumpSlot.COMPLIANCE_ROD, np.array([stroke, 0.0])),
    ):
        oil = (numbers[volume] + numbers[area] * travel) / block[PumpSlot.BULK_MODULUS]
        stiffness += numbers[area] ** 2 / (oil + block[soft])
    k = float(stiffness.max())
    k += block[PumpSlot.LOAD_STIFFNESS] if block[PumpSlot.LOAD_AREA] > 0.0 else 0.0
    mass, damping = block[PumpSlot.MOVING_MASS], numbers[Slot.VISCOUS]
    longest = (damping + math.sqrt(damping**2 + 4.0 * k * mass)) / (2.0 * k)
    return 1.0e-3 * 2.0 ** math.floor(math.log2(longest / 1.0e-3))


def _write_friction(numbers: np.ndarray, axis: Axis) -> None:
    friction = axis.drive.friction
    numbers[Slot.COULOMB] = friction.coulomb
    numbers[Slot.STRIBECK] = friction.stribeck_extra
    numbers[Slot.STRIBECK_VELOCITY] = friction.stribeck_velocity
    numbers[Slot.VISCOUS] = friction.viscous
    numbers[Slot.COULOMB_VELOCITY] = friction.smoothing_velocity
    numbers[Slot.COULOMB_ASYMMETRY] = friction.coulomb_asymmetry
    numbers[Slot.VISCOUS_ASYMMETRY] = friction.viscous_asymmetry


def _write_end_stop(numbers: np.ndarray, machine: Machine, name: str) -> None:
    stop, travel = machine.end_stop(name), drive_travel(machine, name)
    if stop and travel:
        numbers[Slot.STOP_LOW], numbers[Slot.STOP_HIGH] = travel
        numbers[Slot.STOP_STIFFNESS], numbers[Slot.STOP_DAMPING] = stop.stiffness, stop.damping


def _write_valve_axis(numbers: np.ndarray, axis: Axis, supply: Supply) -> None:
    """Write areas, volumes, valve and supply of an axis with a valve to its parameters (SLOT_COUNT,)."""
    valve = axis.valve
    assert valve is not None
    drive = axis.hydraulic_drive
    numbers[Slot.KIND] = ActuatorKind.CYLINDER if axis.cylinder else ActuatorKind.MOTOR
    numbers[Slot.STROKE] = axis.cylinder.stroke if axis.cylinder else 0.0
    numbers[Slot.AREA_HEAD], numbers[Slot.AREA_ROD] = drive.effective_areas
    numbers[Slot.VOLUME_HEAD] = numbers[Slot.VOLUME_ROD] = drive.dead_volume
    numbers[Slot.LEAKAGE] = drive.leakage
    numbers[Slot.HOSE_COMPLIANCE] = drive.hose_compliance
    _write_valve(numbers, valve)
    _write_counterbalance(numbers, Slot.HOLDING_HEAD, axis.load_holding.head)
    _write_counterbalance(numbers, Slot.HOLDING_ROD, axis.load_holding.rod)
    numbers[Slot.BULK_MODULUS] = supply.bulk_modulus
    numbers[Slot.AIR_RELEASE] = supply.dissolved_air * supply.bulk_modulus
    numbers[Slot.ENTRAINED_AIR] = supply.entrained_air
    numbers[Slot.TANK_PRESSURE] = supply.tank_pressure
    numbers[Slot.RELIEF_PRESSURE] = supply.relief_pressure
    numbers[Slot.PUMP_FLOW] = supply.pump_flow
    numbers[Slot.PUMP_DROOP] = supply.pump_droop
    numbers[Slot.RELIEF_OVERRIDE] = supply.relief_override
    if supply.kind == "load_sensing":
        numbers[Slot.LOAD_SENSING_MARGIN] = supply.load_sensing_margin


def _write_pump_group(numbers: np.ndarray, machine: Machine, name: str, states: dict[str, int]) -> None:
    """Write states, axes, priority and merging valve of an axis' pump to its parameters (SLOT_COUNT,).

    `states` are the indices of the additional states by name.
    """
    pump = machine.pump_of(name)
    if f"{DELIVERY_STATE}.{pump}" in states:
        numbers[Slot.PUMP_TIME_CONSTANT] = machine.pumps[pump].time_constant
        numbers[Slot.DELIVERY] = states[f"{DELIVERY_STATE}.{pump}"]
    if f"{ADDED_DELIVERY_STATE}.{pump}" in states:
        numbers[Slot.ADDED_DELIVERY] = states[f"{ADDED_DELIVERY_STATE}.{pump}"]
    if machine.engine:
        numbers[Slot.ENGINE_POWER] = machine.engine.power * machine.engine.efficiency
    if not machine.supplies:
        return
    group, order = machine.supplies[pump], list(machine.hydraulic_axes)
    pumped = len(order) - len(machine.valve_axes) if pump == list(machine.supplies)[-1] else 0
    numbers[Slot.GROUP_SIZE] = len(group.axes) + pumped  # axes with their own pump follow the last group
    if group.priority:
        valve = machine.axes[group.priority].valve
        assert valve
        numbers[Slot.PRIORITY_DROP] = valve.compensator_pressure_drop or valve.rated_pressure_drop
    if name in machine.merging:
        valve = machine.merging[name]
        ends = [order.index(machine.axes_of_pump(end)[0]) for end in (valve.from_supply, valve.to_supply)]
        numbers[Slot.MERGE_FROM], numbers[Slot.MERGE_TO] = ends
        first, count = int(Slot.MERGE_CURVE), len(valve.travel)
        numbers[first] = count
        numbers[first + 1 : first + 1 + count] = valve.travel
        share = np.clip(valve.share_scale * np.array(valve.share), 0.0, 1.0)
        numbers[first + 1 + CURVE_KNOTS : first + 1 + CURVE_KNOTS + count] = share


def _write_pump_drive(numbers: np.ndarray, machine: Machine, name: str) -> None:
    """Write cylinder, pump and load cylinder of an axis with its own pump to its parameters (SLOT_COUNT,)."""
    axis = machine.axes[name]
    cylinder, pump = axis.cylinder, axis.pump
    assert cylinder and pump
    numbers[Slot.KIND] = ActuatorKind.PUMP_DRIVE
    numbers[Slot.STROKE] = cylinder.stroke
    numbers[Slot.AREA_HEAD], numbers[Slot.AREA_ROD] = cylinder.effective_areas
    numbers[Slot.VOLUME_HEAD] = numbers[Slot.VOLUME_ROD] = cylinder.dead_volume
    numbers[Slot.LEAKAGE] = cylinder.leakage
    numbers[Slot.ORIFICE_SMOOTHING] = Valve.model_fields["smoothing"].default
    moved = machine.links[machine.link_of(axis.joint)].mass + cylinder.rod.mass
    _write_pump(numbers[PUMP_OFFSET:], pump, moved)
    if name in machine.loads:
        _write_load_cylinder(numbers[PUMP_OFFSET:], machine.loads[name])


def _write_pump(block: np.ndarray, pump: Pump, moved: float) -> None:
    gas, motor = pump.accumulator, pump.motor
    block[PumpSlot.DISPLACEMENT], block[PumpSlot.LEAKAGE] = pump.displacement, pump.leakage
    block[PumpSlot.RATED_SPEED], block[PumpSlot.TORQUE_LOSS] = pump.rated_speed, pump.torque_loss
    block[PumpSlot.BULK_MODULUS], block[PumpSlot.MOVING_MASS] = pump.bulk_modulus, moved
    block[PumpSlot.COMPLIANCE_HEAD] = pump.compliance_head
    block[PumpSlot.COMPLIANCE_ROD] = pump.compliance_rod
    block[PumpSlot.AIR_HEAD], block[PumpSlot.AIR_ROD] = pump.air_head, pump.air_rod
    block[PumpSlot.ACCUMULATOR_PRESSURE], block[PumpSlot.GAS_VOLUME] = gas.pressure, gas.gas_volume
    block[PumpSlot.LINE_EXTENDING] = gas.line_extending
    block[PumpSlot.LINE_RETRACTING] = gas.line_retracting
    if motor is None:
        return
    block[PumpSlot.VOLTAGE], block[PumpSlot.RESISTANCE] = motor.voltage, motor.resistance
    block[PumpSlot.EMF], block[PumpSlot.INERTIA] = motor.torque_constant, motor.inertia
    block[PumpSlot.DRAG], block[PumpSlot.BREAKAWAY] = motor.drag, motor.breakaway
    block[PumpSlot.BREAKAWAY_SPEED] = motor.breakaway_speed
    block[PumpSlot.VISCOUS_DRAG] = motor.viscous


def _write_load_cylinder(block: np.ndarray, load: LoadCylinder) -> None:
    block[PumpSlot.LOAD_AREA], block[PumpSlot.LOAD_RELIEF] = load.area, load.relief_pressure
    block[PumpSlot.LOAD_OVERRIDE], block[PumpSlot.LOAD_STIFFNESS] = load.relief_override, load.stiffness
    block[PumpSlot.LOAD_VOID], block[PumpSlot.LOAD_VOID_PRESSURE] = load.unfilled_travel, load.air_pressure
    block[PumpSlot.LOAD_FRICTION], block[PumpSlot.LOAD_RETURN] = load.friction, load.return_force


def _write_valve(numbers: np.ndarray, valve: Valve) -> None:
    numbers[Slot.BANDWIDTH], numbers[Slot.DAMPING] = valve.bandwidth, valve.damping
    numbers[Slot.SLEW_LIMIT] = valve.slew_limit or 0.0
    numbers[Slot.DEADBAND], numbers[Slot.DEADBAND_NEGATIVE] = valve.deadbands
    numbers[Slot.FLOW_GAIN] = valve.rated_flow / math.sqrt(valve.rated_pressure_drop)
    numbers[Slot.METERING_PA], numbers[Slot.METERING_BT] = (
        valve.positive.inlet, valve.positive.outlet
    )  # fmt: skip
    numbers[Slot.METERING_PB], numbers[Slot.METERING_AT] = (
        valve.negative.inlet, valve.negative.outlet
    )  # fmt: skip
    numbers[Slot.COMPENSATED_DROP] = valve.compensator_pressure_drop
    numbers[Slot.TANK_LEAKAGE] = valve.tank_leakage
    numbers[Slot.ORIFICE_SMOOTHING] = valve.smoothing
    numbers[Slot.PORT_RELIEF] = valve.port_relief
    numbers[Slot.RELIEF_GAIN] = valve.port_relief_gain
    numbers[Slot.MAKEUP_GAIN] = valve.makeup_gain
    _write_curve(numbers, int(Slot.CURVES), valve.positive.curve)
    _write_curve(numbers, Slot.CURVES + CURVE_SIZE, valve.negative.curve)


def _write_curve(numbers: np.ndarray, first: int, curve: FlowCurve | None) -> None:
    if curve is None:
        return
    count = len(curve.travel)
    numbers[first] = count
    numbers[first + 1 : first + 1 + count] = curve.travel
    numbers[first + 1 + CURVE_KNOTS : first + 1 + CURVE_KNOTS + count] = curve.opening


def _write_counterbalance(numbers: np.ndarray, first: int, valve: Counterbalance | None) -> None:
    """Write setting, pilot ratio and override pressure of a counterbalance valve to three slots.

    `first` is the index of the first of these slots. Without a valve nothing is written.
    """
    if valve:
        override = valve.override * valve.setting
        numbers[first : first + 3] = valve.setting, valve.pilot_ratio, override
