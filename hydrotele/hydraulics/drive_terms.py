"""What the terms of a machine see and add: the state of a drive, and commands with their terms."""

from hydrotele.core.compiled import lean
from hydrotele.hydraulics.circuit import SLOTS, Slot, circuit_supply, delivered_share, open_ports
from hydrotele.terms.law import Drives, DriveState
from hydrotele.terms.table import COMMAND, added

_AH, _AR, _OFFSET = int(Slot.AREA_HEAD), int(Slot.AREA_ROD), int(Slot.OFFSET)


@lean
def drive_state(user, i, count, act, supply, time, x, v, command, gain):
    """State of one drive, as laws of terms see it.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        i: index of the actuator.
        count: number of hydraulic axes, which come first.
        act: (>= 4 count,) activations.
        supply: supply pressure, scalar [Pa].
        time: scalar [s].
        x: position of the drive, scalar [m] or [rad].
        v: its velocity, scalar [m/s] or [rad/s].
        command: as it arrives, scalar [1] or [V].
        gain: force per command of a force drive, scalar [N/V] or [N m/V].

    Returns:
        DriveState.
    """
    u, a = i * SLOTS, 4 * i
    if i >= count:
        force = gain * command - user[u + _OFFSET]
        return DriveState(time, x, v, 0.0, 0.0, 0.0, 0.0, supply, command, force)
    force = user[u + _AH] * act[a + 2] - user[u + _AR] * act[a + 3]
    return DriveState(
        time, x, v, act[a], act[a + 1], act[a + 2], act[a + 3], supply, command, force
    )


@lean
def add_to_commands(user, terms, count, act, command, length, velocity, dt, time, scratch, out):
    """Commands of the valves with their terms, at the middle of a step.

    Positions and time are those of the middle; spools and pressures those of the start, before the
    spool's lag, so that what they make of a command is off by half a step.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        terms: (n,) table of terms.
        count: number of hydraulic axes, which come first.
        act: (>= 4 count,) activations at the start of the step.
        command: (>= count,) commands that arrive [1].
        length: (>= count,) drive positions at the end of the step [m] or [rad].
        velocity: (>= count,) drive velocities [m/s] or [rad/s].
        dt: step, scalar [s].
        time: at the start of the step, scalar [s].
        scratch: (SCRATCH,) work space.
        out: (>= count,) written [1].

    Returns:
        Nothing.
    """
    open_ports(user, act, act, scratch, 0, count, 0.0, act)
    supply = circuit_supply(user, 0, count, scratch, delivered_share(user, 0, act))
    middle = time + 0.5 * dt
    drives = Drives(count, act, length, velocity, command)
    for i in range(count):
        x = length[i] - 0.5 * dt * velocity[i]
        s = drive_state(user, i, count, act, supply, middle, x, velocity[i], command[i], 0.0)
        out[i] = command[i] + added(terms, COMMAND, i, s, drives)
