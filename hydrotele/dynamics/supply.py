"""What drives share in the reduced model: the supply's pressure, and the laws that terms add."""

from hydrotele.compiled import lean
from hydrotele.dynamics.model import COMMAND, GIVEN, V, X
from hydrotele.hydraulics.circuit import circuit_supply, delivered_share, open_ports
from hydrotele.hydraulics.drive_terms import add_to_commands, drive_state
from hydrotele.terms.table import COMMAND as ON_COMMAND
from hydrotele.terms.table import FORCE as ON_FORCE
from hydrotele.terms.table import added_with_slope


@lean
def supply_of(model, sp, z):
    """Supply pressure in a state, scalar [Pa].

    Source: nominal model, "Supply".
    """
    user, count = model.user, model.hydraulic
    act = z[2 * (len(model.mech.free) + len(model.transmission)) :]
    open_ports(user, act, act, sp.scratch, 0, count, 0.0, act)
    if model.memory is None:
        return circuit_supply(user, 0, count, sp.scratch)
    return circuit_supply(user, 0, count, sp.scratch, delivered_share(user, 0, act))


@lean
def term_force(model, sp, z, i, velocity):
    """Force that the terms add to a drive, and its slope with respect to the drive's velocity.

    Args:
        model: Model.
        sp: Space after `place`; its time, positions and commands.
        z: (nz,) state, whose pressures act.
        i: index of the drive.
        velocity: of the drive, scalar [m/s] or [rad/s].

    Returns:
        (force [N] or [N m], d force / d velocity); of a force drive with the terms of its command.
    """
    count = model.hydraulic
    act = z[2 * (len(model.mech.free) + len(model.transmission)) :]
    supply = supply_of(model, sp, z) if count > 0 else 0.0
    s = drive_state(
        model.user, i, count, act, supply, sp.time[0], sp.drive[X, i], velocity,
        sp.drive[COMMAND, i], model.gain[i],
    )  # fmt: skip
    force, slope = added_with_slope(model.terms, ON_FORCE, i, s)
    if i >= count:
        more, steep = added_with_slope(model.terms, ON_COMMAND, i, s)
        force += model.gain[i] * more
        slope += model.gain[i] * steep
    return force, slope


@lean
def add_commands(model, sp, act, h):
    """Write the commands that the valves are given: what arrives and what the terms add.

    Args:
        model: Model.
        sp: Space with positions at the end of the step, velocities over it, time at its start.
        act: (>= 4 h,) activations at the start of the step.
        h: step, scalar [s].

    Returns:
        Nothing.
    """
    drive = sp.drive
    add_to_commands(
        model.user, model.terms, model.hydraulic, act, drive[COMMAND], drive[X], drive[V], h,
        sp.time[0], sp.scratch, drive[GIVEN],
    )  # fmt: skip
