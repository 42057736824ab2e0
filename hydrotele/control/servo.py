"""Joint servo on valve commands: velocity feedforward, position feedback, deadband compensation.

The target piston velocity is converted to the valve opening that keeps the drive force constant at
the measured pressures. This remains accurate during oil compression at reversals, where a
steady-state flow gain causes errors of centimetres. It also removes the damping by the orifices, so
the deviation of the force from its expected value is fed back as a velocity.

The expected force is the drive force, low-pass filtered with the time constant `Servo.load_time`.
With computed forces it is the force by inverse dynamics along the reference, plus the low-pass
filtered difference of drive force and computed force. The compression flow due to the rate of the
computed force is then fed forward as well, and a force drive receives the computed force itself.

`compute_drive_references` and `interpolate_drive_reference` compute moment arms and chamber volumes
along the reference.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.control.plan import Plan
from hydrotele.core.compiled import compiled
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo

_FORCE_DRIVE, _HYDRAULIC_DRIVE = 0.0, 1.0
_DEADBAND_SMOOTHING = 0.005  # opening over which the deadband jump is smoothed, to avoid chatter from noise
_MIN_PRESSURE_DROP_RATIO = 0.02  # of the supply: smallest assumed pressure drop of a valve


def servo_parameters(machine: Machine, axes: tuple[str, ...], servo: Servo, dt: float) -> np.ndarray:
    """Return gains and drive parameters of the joint servo as a table, one row per axis.

    Args:
        machine: the machine.
        axes: axis names in column order.
        servo: gains of the servo.
        dt: control period [s].

    Returns:
        (k, 15), with the columns: kind (1 hydraulic with valve, 0 otherwise), head and rod area
        [m^2], flow gain [m^3/(s sqrt(Pa))], deadband [1], tank pressure [Pa], command limit, force
        per command, position gain [1/s], velocity gain of force drives [N s/m] or [N m s/rad],
        fraction of the deadband that is compensated [1], weight of a new drive force in its
        low-pass filter (1 - exp(-dt / `load_time`)) [1], bulk modulus [Pa], and
        `pressure_feedback`, the gain from the deviation of the drive force from its expected value
        to a velocity [1/s], index of the supply in `Machine.pumps`.

    Raises:
        InputError: a gain is given for an unknown axis.
    """
    rows = []
    if strange := set(servo.axis_gains) - set(axes):
        message = f"{sorted(strange)[0]!r} is not an axis of the machine; {suggest_valid_name('', axes)}"
        raise InputError("servo.axis_gains", message)
    for name in axes:
        axis = machine.axes[name]
        filtered = 1.0 - math.exp(-dt / servo.load_time)
        position_gain = servo.axis_gains.get(name, servo.position_gain)
        gains = [position_gain, servo.velocity_gain, servo.deadband_compensation, filtered]
        gains += [machine.supply.bulk_modulus if machine.supply else 0.0, servo.pressure_feedback]
        gains.append(list(machine.pumps).index(machine.pump_of(name)) if axis.valve else 0)
        if axis.valve and machine.supply:
            head, rod = axis.hydraulic_drive.effective_areas
            flow_gain = axis.valve.rated_flow / math.sqrt(axis.valve.rated_pressure_drop)
            facts = [_HYDRAULIC_DRIVE, head, rod, flow_gain, axis.valve.deadband]
            rows.append([*facts, machine.supply.tank_pressure, 1.0, 0.0, *gains])
        elif axis.pump:  # accepts commands only, see `compute_drive_references`
            rows.append([_FORCE_DRIVE, 0, 0, 0, 0, 0, 1.0, 1.0, *gains])
        else:
            assert axis.force
            rows.append([_FORCE_DRIVE, 0, 0, 0, 0, 0, axis.force.command_limit, axis.force.gain, *gains])
    return np.array(rows, dtype=float)


class DriveReferences(NamedTuple):
    """References of k drives at n control ticks of a plan, all (n, k).

    Attributes:
        velocity: reference velocity of the drive, `Servo.lead` later than the tick, times
            `Servo.feedforward` [m/s] or [rad/s].
        arm: moment arm d(drive)/d(joint) at the joint reference of the tick.
        volume_head: head chamber volume at this joint reference [m^3].
        volume_rod: rod chamber volume at this joint reference [m^3].
    """

    velocity: np.ndarray
    arm: np.ndarray
    volume_head: np.ndarray
    volume_rod: np.ndarray


def compute_drive_references(machine: Machine, plan: Plan, servo: Servo) -> DriveReferences:
    """Compute drive velocities, moment arms and chamber volumes along the joint references of a plan.

    Args:
        machine: the machine.
        plan: joint references.
        servo: the velocity at a tick is that of the plan `lead` [s] later, which compensates the
            spool's lag, times `feedforward` [1].

    Returns:
        The references. For axes without feedback, velocities are 0, moment arms and volumes 1.

    Raises:
        InputError: the plan has a reference for an axis with its own pump.
    """
    velocity, arm = np.zeros_like(plan.reference), np.ones_like(plan.reference)
    head, rod = np.ones_like(plan.reference), np.ones_like(plan.reference)
    ahead = np.minimum(plan.time + servo.lead, plan.time[-1])
    for column, name in enumerate(plan.axes):
        if not plan.closed_loop[column]:
            continue
        if machine.axes[name].pump:
            message = f"{name} has its own pump, which the servo does not control"
            raise InputError("pilot", f"{message}: give its commands (kind: table, quantity: command)")
        linkage = axis_linkage(machine, name)
        arm[:, column] = linkage.rate(plan.reference[:, column])
        speed = arm[:, column] * plan.rate[:, column]
        velocity[:, column] = servo.feedforward * np.interp(ahead, plan.time, speed)
        axis = machine.axes[name]
        if axis.is_hydraulic:
            x = np.asarray(linkage.length(plan.reference[:, column]))
            if axis.cylinder:
                x = np.clip(x - axis.cylinder.closed_length, 0.0, axis.cylinder.stroke)
            head[:, column], rod[:, column] = axis.hydraulic_drive.chamber_volumes(x)
    return DriveReferences(velocity, arm, head, rod)


@compiled
def compute_valve_opening(velocity, head, rod, supply, tank, area_head, area_rod, volume_head, volume_rod, flow_gain):
    """Compute the valve opening at which a piston moves at a velocity with constant force.

    `A_h p_A' = A_r p_B'`, where ' is d/dt, with the orifice flows at the given pressures gives `o =
    v (A_h^2/V_A + A_r^2/V_B) / (k (A_h/V_A sqrt(dp_A) + A_r/V_B sqrt(dp_B)))` with the pressure
    drops dp_A and dp_B of the valve edges at the two chambers. The denominator is at least that
    with drops of 2 % of the supply pressure.

    Args:
        velocity: v, scalar [m/s] or [rad/s], positive extends.
        head: p_A, scalar [Pa].
        rod: p_B, scalar [Pa].
        supply: p_s, scalar [Pa].
        tank: p_t, scalar [Pa].
        area_head: A_h, scalar [m^2] or [m^3/rad].
        area_rod: A_r, scalar [m^2] or [m^3/rad].
        volume_head: V_A, scalar [m^3].
        volume_rod: V_B, scalar [m^3].
        flow_gain: k, scalar [m^3/(s sqrt(Pa))].

    Returns:
        Opening o, scalar [1], not limited.

    Source: "Chambers" and "Orifice" of models/cat215/README.md, solved for the opening.
    """
    if velocity > 0.0:
        drop_head, drop_rod = supply - head, rod - tank
    else:
        drop_head, drop_rod = head - tank, supply - rod
    floor = _MIN_PRESSURE_DROP_RATIO * supply
    stiff_head, stiff_rod = area_head / volume_head, area_rod / volume_rod
    flow = stiff_head * math.sqrt(max(drop_head, 0.0)) + stiff_rod * math.sqrt(max(drop_rod, 0.0))
    least = (stiff_head + stiff_rod) * math.sqrt(floor)
    swept = area_head * stiff_head + area_rod * stiff_rod
    return velocity * swept / (flow_gain * max(flow, least))


class DriveReference(NamedTuple):
    """References of k drives for one control period: a row of `DriveReferences`.

    Attributes:
        velocity: (k,) reference velocity of the drive [m/s] or [rad/s].
        arm: (k,) moment arm d(drive)/d(joint) at the joint reference.
        volume_head: (k,) head chamber volume at the joint reference [m^3].
        volume_rod: (k,) rod chamber volume at the joint reference [m^3].
    """

    velocity: np.ndarray
    arm: np.ndarray
    volume_head: np.ndarray
    volume_rod: np.ndarray


class MeasuredState(NamedTuple):
    """Sensor readings of k axes.

    Attributes:
        joint: (k,) joint positions [rad] or [m].
        rate: (k,) joint velocities [rad/s] or [m/s].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        supply: (s,) pressures of the supplies [Pa].
    """

    joint: np.ndarray
    rate: np.ndarray
    head: np.ndarray
    rod: np.ndarray
    supply: np.ndarray


class ComputedForce(NamedTuple):
    """Drive forces by inverse dynamics at one control tick.

    Attributes:
        is_computed: whether the forces were computed; otherwise the arrays are not used.
        force: (k,) forces at this tick [N] or [N m].
        rate: (k,) time derivatives of the forces, `Servo.lead` later than the tick [N/s] or [N
            m/s].
    """

    is_computed: bool
    force: np.ndarray
    rate: np.ndarray


class ForceReferences(NamedTuple):
    """Drive forces by inverse dynamics along a plan, (n, k) each.

    Attributes:
        is_computed: whether the forces were computed.
        force: forces at each tick [N] or [N m]; 0 if not computed.
        rate: time derivatives of the forces, `Servo.lead` later than each tick [N/s] or [N m/s].
    """

    is_computed: bool
    force: np.ndarray
    rate: np.ndarray


@compiled
def servo_step(parameters, closed, drive, reference, measured, load, computed, out):
    """Compute the servo commands of all axes for one control period.

    The command of a valve follows from the reference velocity, the position error, and the
    deviation of the drive force from its expected value; `compute_valve_opening` converts the sum
    of these velocities. The command of a force drive follows from position and velocity error, and
    the computed force.

    Args:
        parameters: (k, 15) of `servo_parameters`.
        closed: (k,) whether the axis is under feedback; the commands of the others are not changed.
        drive: DriveReference.
        reference: (k,) joint reference at the time of the joint measurement [rad] or [m].
        measured: MeasuredState.
        load: (k,) low-pass filtered drive force minus computed force (0 if not computed), updated
            for hydraulic drives [N] or [N m].
        computed: ComputedForce.
        out: (k,) commands, written where `closed` [1] or in the drive's unit.

    Returns:
        Nothing.

    Source: this module's docstring; dynamic pressure feedback after Merritt 1967, section 8.
    """
    velocity, arm, volume_head, volume_rod = drive
    joint, rate, head, rod, supply = measured
    for i in range(parameters.shape[0]):
        error = reference[i] - joint[i]
        gain, rate_gain = parameters[i, 8], parameters[i, 9]
        if parameters[i, 0] == _FORCE_DRIVE:
            if closed[i]:
                force = rate_gain * (gain * error + velocity[i] - rate[i])
                if computed.is_computed:
                    force += computed.force[i]
                limit = parameters[i, 6]
                out[i] = min(limit, max(-limit, force / parameters[i, 7]))
            continue
        area_head, area_rod = parameters[i, 1], parameters[i, 2]
        force = area_head * head[i] - area_rod * rod[i]
        model = computed.force[i] if computed.is_computed else 0.0
        load[i] += parameters[i, 11] * (force - model - load[i])
        if not closed[i]:
            continue
        stiffness = parameters[i, 12] * (area_head**2 / volume_head[i] + area_rod**2 / volume_rod[i])
        wanted = velocity[i] + gain * arm[i] * error
        wanted -= parameters[i, 13] * (force - model - load[i]) / stiffness
        if computed.is_computed:
            wanted += computed.rate[i] / stiffness
        opening = compute_valve_opening(
            wanted, head[i], rod[i], supply[int(parameters[i, 14])], parameters[i, 5], area_head, area_rod,
            volume_head[i], volume_rod[i], parameters[i, 3],
        )  # fmt: skip
        deadband = parameters[i, 4] * parameters[i, 10]
        command = opening * (1.0 - deadband) + deadband * math.tanh(opening / _DEADBAND_SMOOTHING)
        out[i] = min(1.0, max(-1.0, command))


TABLE_POINTS = 4001  # over a joint's range: interpolation is accurate to about 1e-7 of a moment arm
_LOW, _STEP = range(2)
_DEFAULT_HALF_RANGE = 1.0  # rad or m, half range for a joint without a range; its drive is direct


def tabulate_drive_geometry(machine: Machine, axes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Tabulate the moment arms and chamber volumes of all drives over their joints' ranges.

    Args:
        machine: the machine.
        axes: axis names in column order.

    Returns:
        (grid (k, 2): lowest joint position and step [rad] or [m]; table (k, TABLE_POINTS, 3):
        moment arm d(drive)/d(joint), head and rod chamber volume [m^3]).
    """
    grid, table = np.zeros((len(axes), 2)), np.ones((len(axes), TABLE_POINTS, 3))
    for i, name in enumerate(axes):
        axis = machine.axes[name]
        low, high = machine.joints[axis.joint].range or (-_DEFAULT_HALF_RANGE, _DEFAULT_HALF_RANGE)
        places = np.linspace(low, high, TABLE_POINTS)
        grid[i] = low, places[1] - places[0]
        linkage = axis_linkage(machine, name)
        table[i, :, 0] = linkage.rate(places)
        if axis.is_hydraulic:
            x = np.asarray(linkage.length(places))
            if axis.cylinder:
                x = np.clip(x - axis.cylinder.closed_length, 0.0, axis.cylinder.stroke)
            table[i, :, 1], table[i, :, 2] = axis.hydraulic_drive.chamber_volumes(x)
    return grid, table


@compiled
def interpolate_drive_reference(grid, table, reference, rate, scale, velocity, arm, volume_head, volume_rod):
    """Interpolate moment arms and chamber volumes in tables and compute drive velocities for one tick.

    Args:
        grid: (k, 2) of `tabulate_drive_geometry`.
        table: (k, TABLE_POINTS, 3) of `tabulate_drive_geometry`.
        reference: (k,) joint references [rad] or [m].
        rate: (k,) rates of the references [rad/s] or [m/s].
        scale: factor of the velocities, the servo's feedforward; scalar.
        velocity: (k,) written: reference drive velocity [m/s] or [rad/s].
        arm: (k,) written: moment arm d(drive)/d(joint).
        volume_head: (k,) written: head chamber volume [m^3].
        volume_rod: (k,) written: rod chamber volume [m^3].

    Returns:
        Nothing.

    Source: linkages of the machine, interpolated linearly.
    """
    last = table.shape[1] - 1
    for i in range(len(reference)):
        place = (reference[i] - grid[i, 0]) / grid[i, 1]
        place = min(last - 1e-6, max(0.0, place))
        row = int(place)
        part = place - row
        arm[i] = table[i, row, 0] + part * (table[i, row + 1, 0] - table[i, row, 0])
        volume_head[i] = table[i, row, 1] + part * (table[i, row + 1, 1] - table[i, row, 1])
        volume_rod[i] = table[i, row, 2] + part * (table[i, row + 1, 2] - table[i, row, 2])
        velocity[i] = scale * arm[i] * rate[i]
