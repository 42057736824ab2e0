"""Joint servo on valve commands: velocity feedforward, position feedback, dead-band compensation.

The wanted piston velocity becomes the valve opening that, at the pressures measured now, keeps the
drive's force constant while the piston moves at that velocity. That holds through the compression
of the oil when the direction changes, where a steady flow gain would be wrong by centimetres. Since
it also takes away the damping that orifices give, the deviation of the force from what is expected
is fed back as a velocity. Expected is its slow mean, or, with computed forces, what inverse
dynamics asks for along the reference; then the oil that the change of that force compresses is fed
forward, too, and a plain drive gets the force itself.

References of the drives for one control period: moment arm and chamber volumes, from tables.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.control.plan import Plan
from hydrotele.core.compiled import compiled
from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.kinematics.from_machine import axis_linkage
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo

_FORCE, _MOTOR_OR_CYLINDER = 0.0, 1.0
_CENTRE = 0.005  # opening over which the dead-band jump is spread, or noise would chatter across it
_LEAST_PRESSURE = 0.02  # of the supply: a valve never counts as having less to drive its flow


def servo_parameters(
    machine: Machine, axes: tuple[str, ...], servo: Servo, dt: float
) -> np.ndarray:
    """Constants of the servo, one row per axis.

    Args:
        machine: the machine.
        axes: axis names in column order.
        servo: gains.
        dt: control period [s].

    Returns:
        (k, 14): hydraulic, area_head, area_rod, flow gain [m^3/(s sqrt(Pa))], dead band, tank [Pa],
        command limit, drive gain, position gain [1/s], velocity gain, dead-band compensation,
        load filter coefficient, bulk modulus [Pa], pressure feedback [1/s].

    Raises:
        InputError: a gain is given for an axis that there is not.
    """
    rows = []
    if strange := set(servo.axis_gains) - set(axes):
        message = f"{sorted(strange)[0]!r} is no axis of the machine; {suggest('', axes)}"
        raise InputError("servo.axis_gains", message)
    for name in axes:
        axis = machine.axes[name]
        filtered = 1.0 - math.exp(-dt / servo.load_time)
        position_gain = servo.axis_gains.get(name, servo.position_gain)
        gains = [position_gain, servo.velocity_gain, servo.deadband_compensation, filtered]
        gains += [machine.supply.bulk_modulus if machine.supply else 0.0, servo.pressure_feedback]
        if axis.valve and machine.supply:
            head, rod = axis.hydraulic_drive.areas
            flow_gain = axis.valve.rated_flow / math.sqrt(axis.valve.rated_pressure_drop)
            facts = [_MOTOR_OR_CYLINDER, head, rod, flow_gain, axis.valve.deadband]
            rows.append([*facts, machine.supply.tank_pressure, 1.0, 0.0, *gains])
        elif axis.pump:  # takes commands only, see `drive_references`
            rows.append([_FORCE, 0, 0, 0, 0, 0, 1.0, 1.0, *gains])
        else:
            assert axis.force
            rows.append([_FORCE, 0, 0, 0, 0, 0, axis.force.command_limit, axis.force.gain, *gains])
    return np.array(rows, dtype=float)


class DriveReferences(NamedTuple):
    """References of the drives, all (n, k).

    Attributes:
        velocity: wanted velocity, ahead of time by the servo's lead [m/s] or [rad/s].
        arm: d(drive)/d(joint) at the reference.
        volume_head: head chamber volume at the reference [m^3].
        volume_rod: rod chamber volume at the reference [m^3].
    """

    velocity: np.ndarray
    arm: np.ndarray
    volume_head: np.ndarray
    volume_rod: np.ndarray


def drive_references(machine: Machine, plan: Plan, servo: Servo) -> DriveReferences:
    """Wanted drive velocities, moment arms and chamber volumes along a plan.

    Args:
        machine: the machine.
        plan: joint references.
        servo: `lead` [s] makes up for the spool's lag, `feedforward` scales.

    Returns:
        The references.

    Raises:
        InputError: the plan moves an axis with a pump of its own.
    """
    velocity, arm = np.zeros_like(plan.reference), np.ones_like(plan.reference)
    head, rod = np.ones_like(plan.reference), np.ones_like(plan.reference)
    ahead = np.minimum(plan.time + servo.lead, plan.time[-1])
    for column, name in enumerate(plan.axes):
        if not plan.closed[column]:
            continue
        if machine.axes[name].pump:
            message = f"{name} has a pump of its own, which the servo does not move"
            raise InputError("pilot", f"{message}: give its commands (kind: table, of: command)")
        linkage = axis_linkage(machine, name)
        arm[:, column] = linkage.rate(plan.reference[:, column])
        speed = arm[:, column] * plan.rate[:, column]
        velocity[:, column] = servo.feedforward * np.interp(ahead, plan.time, speed)
        axis = machine.axes[name]
        if axis.hydraulic:
            x = np.asarray(linkage.length(plan.reference[:, column]))
            if axis.cylinder:
                x = np.clip(x - axis.cylinder.closed_length, 0.0, axis.cylinder.stroke)
            head[:, column], rod[:, column] = axis.hydraulic_drive.volumes(x)
    return DriveReferences(velocity, arm, head, rod)


@compiled
def feedforward_opening(
    velocity, head, rod, supply, tank, area_head, area_rod, volume_head, volume_rod, flow_gain
):
    """Valve opening at which a piston keeps a velocity without its force changing.

    `A_h p_A' = A_r p_B'` with the orifice flows at the present pressures gives
    `o = v (A_h^2/V_A + A_r^2/V_B) / (k (A_h/V_A sqrt(dp_in) + A_r/V_B sqrt(dp_out)))`.

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

    Source: chamber and orifice equations of the nominal model, solved for the opening.
    """
    if velocity > 0.0:
        drop_head, drop_rod = supply - head, rod - tank
    else:
        drop_head, drop_rod = head - tank, supply - rod
    floor = _LEAST_PRESSURE * supply
    stiff_head, stiff_rod = area_head / volume_head, area_rod / volume_rod
    flow = stiff_head * math.sqrt(max(drop_head, 0.0)) + stiff_rod * math.sqrt(max(drop_rod, 0.0))
    least = (stiff_head + stiff_rod) * math.sqrt(floor)
    swept = area_head * stiff_head + area_rod * stiff_rod
    return velocity * swept / (flow_gain * max(flow, least))


class DriveReference(NamedTuple):
    """References of k drives for one control period, as `drive_row` writes them.

    Attributes:
        velocity: (k,) reference velocity ahead [m/s] or [rad/s].
        arm: (k,) d(drive)/d(joint) at the reference.
        volume_head: (k,) [m^3].
        volume_rod: (k,) [m^3].
    """

    velocity: np.ndarray
    arm: np.ndarray
    volume_head: np.ndarray
    volume_rod: np.ndarray


class Measured(NamedTuple):
    """Sensor readings of k axes.

    Attributes:
        joint: (k,) joint positions [rad] or [m].
        rate: (k,) joint velocities [rad/s] or [m/s].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        supply: supply pressure [Pa], one number per row where there are many.
    """

    joint: np.ndarray
    rate: np.ndarray
    head: np.ndarray
    rod: np.ndarray
    supply: float | np.ndarray


class ComputedForce(NamedTuple):
    """Drive forces that inverse dynamics asks for.

    Attributes:
        known: whether they were computed; the arrays count only then.
        force: (k,) of now [N] or [N m].
        rate: (k,) rate of change, ahead as the velocity [N/s] or [N m/s].
    """

    known: bool
    force: np.ndarray
    rate: np.ndarray


class ForceReferences(NamedTuple):
    """Forces of the drives along a plan, (n, k) each.

    Attributes:
        known: whether they were computed.
        force: [N] or [N m]; 0 where not computed.
        rate: its rate of change, ahead of time by the servo's lead [N/s] or [N m/s].
    """

    known: bool
    force: np.ndarray
    rate: np.ndarray


@compiled
def servo_step(parameters, closed, drive, reference, measured, load, computed, out):
    """Commands of all axes for one control period.

    Args:
        parameters: (k, 14) of `servo_parameters`.
        closed: (k,) whether the axis is under feedback; the others keep `out`.
        drive: DriveReference.
        reference: (k,) joint reference when the joint was measured [rad] or [m].
        measured: Measured.
        load: (k,) slow mean of the drive force, updated [N] or [N m].
        computed: ComputedForce.
        out: (k,) commands, written where closed [1] or in the drive's unit.

    Returns:
        Nothing.

    Source: this module's docstring; dynamic pressure feedback after Merritt 1967, section 8.
    """
    velocity, arm, volume_head, volume_rod = drive
    joint, rate, head, rod, supply = measured
    for i in range(parameters.shape[0]):
        error = reference[i] - joint[i]
        gain, rate_gain = parameters[i, 8], parameters[i, 9]
        if parameters[i, 0] == _FORCE:
            if closed[i]:
                force = rate_gain * (gain * error + velocity[i] - rate[i])
                if computed.known:
                    force += computed.force[i]
                limit = parameters[i, 6]
                out[i] = min(limit, max(-limit, force / parameters[i, 7]))
            continue
        area_head, area_rod = parameters[i, 1], parameters[i, 2]
        force = area_head * head[i] - area_rod * rod[i]
        model = computed.force[i] if computed.known else 0.0
        load[i] += parameters[i, 11] * (force - model - load[i])
        if not closed[i]:
            continue
        stiffness = parameters[i, 12] * (
            area_head**2 / volume_head[i] + area_rod**2 / volume_rod[i]
        )
        wanted = velocity[i] + gain * arm[i] * error
        wanted -= parameters[i, 13] * (force - model - load[i]) / stiffness
        if computed.known:
            wanted += computed.rate[i] / stiffness
        opening = feedforward_opening(
            wanted, head[i], rod[i], supply, parameters[i, 5], area_head, area_rod, volume_head[i],
            volume_rod[i], parameters[i, 3],
        )  # fmt: skip
        deadband = parameters[i, 4] * parameters[i, 10]
        command = opening * (1.0 - deadband) + deadband * math.tanh(opening / _CENTRE)
        out[i] = min(1.0, max(-1.0, command))


POINTS = 4001  # over a joint's range: interpolation is good to some 1e-7 of a moment arm
_LOW, _STEP = range(2)
_WIDE = 1.0  # rad or m, of a joint without a range, whose drive is direct


def drive_tables(machine: Machine, axes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Moment arms and chamber volumes over the joints' ranges.

    Args:
        machine: the machine.
        axes: axis names in column order.

    Returns:
        (grid (k, 2): lowest joint position and step, table (k, POINTS, 3): d(drive)/d(joint), head
        and rod chamber volume [m^3]).
    """
    grid, table = np.zeros((len(axes), 2)), np.ones((len(axes), POINTS, 3))
    for i, name in enumerate(axes):
        axis = machine.axes[name]
        low, high = machine.joints[axis.joint].range or (-_WIDE, _WIDE)
        places = np.linspace(low, high, POINTS)
        grid[i] = low, places[1] - places[0]
        linkage = axis_linkage(machine, name)
        table[i, :, 0] = linkage.rate(places)
        if axis.hydraulic:
            x = np.asarray(linkage.length(places))
            if axis.cylinder:
                x = np.clip(x - axis.cylinder.closed_length, 0.0, axis.cylinder.stroke)
            table[i, :, 1], table[i, :, 2] = axis.hydraulic_drive.volumes(x)
    return grid, table


@compiled
def drive_row(grid, table, reference, rate, scale, velocity, arm, volume_head, volume_rod):
    """Drive references of one period.

    Args:
        grid: (k, 2) of `drive_tables`.
        table: (k, POINTS, 3) of `drive_tables`.
        reference: (k,) joint references [rad] or [m].
        rate: (k,) their rates [rad/s] or [m/s].
        scale: of the velocities, the servo's feedforward; scalar.
        velocity: (k,) written: wanted drive velocity [m/s] or [rad/s].
        arm: (k,) written: d(drive)/d(joint).
        volume_head: (k,) written [m^3].
        volume_rod: (k,) written [m^3].

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
