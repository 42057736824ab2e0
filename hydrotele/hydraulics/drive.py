"""What the terms of a machine see and add: the state of a drive, and commands with their terms.

Friction on a drive side so light that an explicit step would throw it through rest and back.
"""

from hydrotele.core.compiled import lean
from hydrotele.hydraulics.circuit import (
    actuator_friction,
    actuator_friction_slope,
    circuit_supply,
    delivered_share,
    open_ports,
)
from hydrotele.hydraulics.slots import SLOTS, Slot
from hydrotele.terms.law import Drives, DriveState
from hydrotele.terms.table import COMMAND, added

_STEPS = 60  # bisections alone reach rounding in that many
_ROUNDING = 1.0e-13


@lean
def settled_friction(user, u, velocity, push, inertia, dt):
    """Friction at the end of a step of a body that nothing else holds.

    Solves `v' = v + dt / J (F - F_f(v'))` by Newton's method inside a bracket.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        velocity: v at the start of the step, scalar [m/s] or [rad/s].
        push: F, all other force, scalar [N] or [N m].
        inertia: J, scalar [kg] or [kg m^2], > 0.
        dt: step, scalar [s], > 0.

    Returns:
        F_f(v'), scalar [N] or [N m].

    Source: implicit Euler rule.
    """
    per_force = dt / inertia
    free = velocity + per_force * push  # friction pulls towards rest from here
    low, high = min(0.0, free), max(0.0, free)
    v = free
    for _ in range(_STEPS):
        resisting = actuator_friction(user, u, v)
        excess = v - free + per_force * resisting
        if excess > 0.0:
            high = v
        else:
            low = v
        if high - low <= _ROUNDING * abs(free):
            break
        slope = 1.0 + per_force * actuator_friction_slope(user, u, v)
        guess = v - excess / slope if slope > 0.0 else high
        if slope > 0.0 and abs(guess - v) <= _ROUNDING * abs(free):
            break
        v = guess if low < guess < high else 0.5 * (low + high)
    return actuator_friction(user, u, v)


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
