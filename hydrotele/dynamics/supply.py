"""What drives share in the reduced model: supply, pressures that are felt, laws that terms add."""

from hydrotele.core.compiled import lean
from hydrotele.dynamics.model import COMMAND, GIVEN, V, X
from hydrotele.hydraulics.circuit import circuit_supply, delivered_share, open_ports
from hydrotele.hydraulics.drive import add_to_commands, drive_state
from hydrotele.hydraulics.laws import pressure_with_air, pressure_without_air
from hydrotele.hydraulics.slots import SLOTS, Slot
from hydrotele.terms.law import Drives
from hydrotele.terms.table import COMMAND as ON_COMMAND
from hydrotele.terms.table import FORCE as ON_FORCE
from hydrotele.terms.table import added_with_slope

_AIR, _ONSET = int(Slot.AIR_RELEASE), int(Slot.AIR_ONSET)


@lean
def feel(model, sp, z):
    """Write the activations of a state with the pressures that are felt into `sp.act`.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state.

    Returns:
        Nothing.

    Source: `laws.pressure_with_air`.
    """
    first = 2 * (len(model.mech.free) + len(model.transmission))
    for k in range(len(sp.act)):
        sp.act[k] = z[first + k]
    for i in range(model.hydraulic):
        release, onset = model.user[i * SLOTS + _AIR], model.user[i * SLOTS + _ONSET]
        for k in range(4 * i + 2, 4 * i + 4):
            sp.act[k] = pressure_with_air(sp.act[k], release, onset)


@lean
def keep(model, sp, z):
    """Write `sp.act` back into a state, the inverse of `feel`.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state, of which the activations are written.

    Returns:
        Nothing.

    Source: `laws.pressure_without_air`.
    """
    first = 2 * (len(model.mech.free) + len(model.transmission))
    for k in range(len(sp.act)):
        z[first + k] = sp.act[k]
    for i in range(model.hydraulic):
        release, onset = model.user[i * SLOTS + _AIR], model.user[i * SLOTS + _ONSET]
        for k in range(4 * i + 2, 4 * i + 4):
            z[first + k] = pressure_without_air(sp.act[k], release, onset)


@lean
def supply_of(model, sp, z):
    """Supply pressure in a state, scalar [Pa]; `sp.act` is written, see `feel`.

    Source: nominal model, "Supply".
    """
    user, count, act = model.user, model.hydraulic, sp.act
    feel(model, sp, z)
    open_ports(user, act, act, sp.scratch, 0, count, 0.0, act)
    if model.memory is None:
        return circuit_supply(user, 0, count, sp.scratch)
    return circuit_supply(user, 0, count, sp.scratch, delivered_share(user, 0, act))


@lean
def term_force(model, sp, z, i, velocity):
    """Force that the terms add to a drive, and its slope with respect to the drive's velocity.

    Args:
        model: Model.
        sp: Space after `place`; its time, positions, pressures and commands.
        z: (nz,) state.
        i: index of the drive.
        velocity: of the drive, scalar [m/s] or [rad/s].

    Returns:
        (force [N] or [N m], d force / d velocity); of a force drive with the terms of its command.
    """
    count = model.hydraulic
    supply = supply_of(model, sp, z) if count > 0 else 0.0
    s = drive_state(
        model.user, i, count, sp.act, supply, sp.time[0], sp.drive[X, i], velocity,
        sp.drive[COMMAND, i], model.gain[i],
    )  # fmt: skip
    drives = Drives(count, sp.act, sp.drive[X], sp.drive[V], sp.drive[COMMAND])
    force, slope = added_with_slope(model.terms, ON_FORCE, i, s, drives)
    if i >= count:
        more, steep = added_with_slope(model.terms, ON_COMMAND, i, s, drives)
        force += model.gain[i] * more
        slope += model.gain[i] * steep
    return force, slope


@lean
def add_commands(model, sp, h):
    """Write the commands that the valves are given: what arrives and what the terms add.

    Args:
        model: Model.
        sp: Space with positions at the end of the step, velocities over it, time and activations
            at its start.
        h: step, scalar [s].

    Returns:
        Nothing.
    """
    drive = sp.drive
    add_to_commands(
        model.user, model.terms, model.hydraulic, sp.act, drive[COMMAND], drive[X], drive[V], h,
        sp.time[0], sp.scratch, drive[GIVEN],
    )  # fmt: skip
