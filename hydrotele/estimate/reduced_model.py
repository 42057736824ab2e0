"""The reduced model of a Machine: its mechanism, drives, delays and sensors as flat arrays.

In time: kick, drift, kick, with the circuit of the MuJoCo plant between.

Also what its sensors show along a row of a log: late, or behind a first-order lag.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compile_without_allocation, compiled
from hydrotele.hydraulics.actuator import bristle_friction, bristle_rate
from hydrotele.hydraulics.actuator_layout import (
    SLOT_COUNT,
    Slot,
    actuator_order,
    actuator_parameters,
    extra_state_names,
    machine_terms_table,
)
from hydrotele.hydraulics.circuit import (
    FEED,
    NO_EXTRA_STATES,
    SCRATCH_SIZE,
    actuator_end_stop_force,
    add_command_terms,
    force_after_friction,
    make_drive_state,
    solve_state_supplies,
    step_circuit,
    write_term_state_rates,
)
from hydrotele.hydraulics.laws import pressure_with_released_air, pressure_without_released_air
from hydrotele.machine.log_channels import parse_channel
from hydrotele.machine.machine import Machine, rate_channels
from hydrotele.machine.sensors import SensorError, step_first_order_lag, warming_drift
from hydrotele.multibody.reduced_dynamics import (
    BIAS,
    DRIFT,
    LENGTH_ROW,
    RATE,
    Q,
    ReducedMotion,
    close_loops,
    compute_bar_frames,
    compute_bar_motion,
    compute_drift,
    compute_link_frames,
    compute_link_motion,
    compute_mass_and_bias,
    factorise_cholesky,
    make_reduced_motion,
    solve_cholesky,
)
from hydrotele.multibody.reduced_dynamics import LENGTH as BAR_LENGTH
from hydrotele.multibody.reduced_mechanism import (
    BAR,
    CLOSED_LENGTH,
    DAMPING,
    JOINT,
    ReducedMechanism,
    coordinate_names,
    make_reduced_mechanism,
)
from hydrotele.terms.drive_state import Drives
from hydrotele.terms.table import COMMAND as ON_COMMAND
from hydrotele.terms.table import FORCE as ON_FORCE
from hydrotele.terms.table import has_term, sum_terms_with_slope

POSITION, LENGTH, HEAD, ROD, SUPPLY, VELOCITY = range(6)
_KINDS = {
    "angle": POSITION, "position": POSITION, "length": LENGTH, "pressure_head": HEAD,
    "pressure_rod": ROD, "pressure_supply": SUPPLY, "velocity": VELOCITY,
}  # fmt: skip
GEAR_INERTIA, STIFFNESS, GEAR_DAMPING, BACKLASH = range(4)  # columns of `transmission`
X, V, COMMAND, GIVEN, INERTIA = range(5)  # rows of `Space.drive`


class Model(NamedTuple):
    """Numbers of the reduced model; n independent coordinates, t transmissions, h valves.

    A state is `(n positions, t drive positions, n rates, t drive rates, 4 h activations)` and what
    bristles, a slow pump and terms remember, see `parameters.extra_state_names`. Its pressures are
    those that the oil would have if it held its air (`laws.pressure_without_air`): any number is
    one, which a filter needs, and they are the felt ones wherever these are not below the
    atmosphere's.

    Attributes:
        mech: the mechanism.
        user: (nu * SLOTS,) actuator numbers.
        hydraulic: h, number of valves, which come first.
        gain: (nu,) force per command of the plain force drives, 0 for valves [N/V].
        delay: (nu,) command delays [s].
        gear: (nu,) transmission of every drive, -1 if rigid.
        transmission: (t, 4) GEAR_INERTIA, STIFFNESS, GEAR_DAMPING, BACKLASH in SI.
        kind: (c,) what every channel shows: POSITION, LENGTH, HEAD, ROD, SUPPLY or VELOCITY.
        drive: (c,) drive of every channel; of a supply the first that it feeds.
        scale: (c,) sensor scales [1].
        offset: (c,) sensor offsets [channel's unit].
        lag: (c,) sensor delays [s].
        terms: (k,) table of the machine's terms, see `terms.table`.
        time_constant: (c,) time constants of the sensors' first-order lags [s].
        drift: (c, 2) drifts of the sensors' offsets [channel's unit] and their time constants [s].
        memory: number of states that follow the activations; NO_MEMORY, and not 0, where there are
            none: what needs them is then left out.
    """

    mech: ReducedMechanism
    user: np.ndarray
    hydraulic: int
    gain: np.ndarray
    delay: np.ndarray
    gear: np.ndarray
    transmission: np.ndarray
    kind: np.ndarray
    drive: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    lag: np.ndarray
    terms: np.ndarray
    time_constant: np.ndarray
    drift: np.ndarray
    memory: int


class Space(NamedTuple):
    """Work space of the reduced model.

    Attributes:
        motion: work space of the mechanism.
        drive: (5, nu) of every drive: position X [m] or [rad], velocity V, COMMAND that arrived,
            that with its terms as GIVEN to the valve, and where it has bristles the INERTIA that it
            moves [kg] or [kg m^2], of which other drives at rest are part.
        row: (nu, n) d(load-side drive velocity) / d(independent rates).
        mass: (n + t, n + t) mass matrix, then its factor.
        force: (n + t,) forces, then acceleration.
        act: (4 h + memory,) activations and what is remembered, with the pressures that are felt.
        act_dot: (4 h + memory,) rates of `act`.
        scratch: (SCRATCH,) work space of the circuit.
        time: (2,) now, and of the run's first row; only terms see it [s].
    """

    motion: ReducedMotion
    drive: np.ndarray
    row: np.ndarray
    mass: np.ndarray
    force: np.ndarray
    act: np.ndarray
    act_dot: np.ndarray
    scratch: np.ndarray
    time: np.ndarray


def predicted_channels(machine: Machine) -> tuple[str, ...]:
    """Channels that the reduced model predicts: positions, lengths, pressures, supply, measured rates."""
    order = actuator_order(machine)
    valves = list(machine.hydraulic_axes)
    names = [f"{machine.position_kind(a)}.{a}" for a in order]
    names += [f"length.{a}" for a in order if machine.axes[a].cylinder]
    names += [f"pressure_{side}.{a}" for a in valves for side in ("head", "rod")]
    supplies = machine.supply_channels if machine.valve_axes else ()
    return (*names, *supplies, *rate_channels(machine))


def reduced_model(machine: Machine, channels: tuple[str, ...]) -> Model:
    """Reduced model of a machine for some of its channels.

    Args:
        machine: the machine.
        channels: names out of `predicted_channels(machine)`.

    Returns:
        The model.
    """
    order = actuator_order(machine)
    axes = [machine.axes[name] for name in order]
    gears = [axis.transmission for axis in axes if axis.transmission]
    parsed = [parse_channel(name) for name in channels]
    errors = [machine.sensor_errors.get(name, SensorError()) for name in channels]
    fed_first = {name: machine.axes_of_pump(name)[0] for name in machine.supplies}
    index, count = [], 0
    for axis in axes:
        index.append(count if axis.transmission else -1)
        count += axis.transmission is not None
    return Model(
        mech=make_reduced_mechanism(machine),
        user=np.concatenate(list(actuator_parameters(machine).values())),
        hydraulic=len(machine.hydraulic_axes),
        gain=np.array([axis.force.gain if axis.force else 0.0 for axis in axes]),
        delay=np.array([axis.command_delay for axis in axes], float),
        gear=np.array(index, int),
        transmission=np.array([(g.inertia, g.stiffness, g.damping, g.backlash) for g in gears], float).reshape(-1, 4),
        kind=np.array([_KINDS[c.kind] for c in parsed], int),
        drive=np.array([order.index(fed_first.get(c.axis, c.axis)) if c.axis else 0 for c in parsed], int),
        scale=np.array([e.scale for e in errors], float),
        offset=np.array([e.offset for e in errors], float),
        lag=np.array([e.delay for e in errors], float),
        terms=machine_terms_table(machine),
        time_constant=np.array([e.time_constant for e in errors], float),
        drift=np.array([(e.drift, e.drift_time_constant) for e in errors], float).reshape(-1, 2),
        memory=len(extra_state_names(machine)) or NO_EXTRA_STATES,
    )


def model_space(model: Model) -> Space:
    """Fresh work space for a model."""
    nu, n, acts = (
        len(model.gear),
        len(model.mech.independent),
        4 * model.hydraulic + max(model.memory, 0),
    )
    total = n + len(model.transmission)
    return Space(
        make_reduced_motion(model.mech), np.zeros((5, nu)), np.zeros((nu, n)), np.zeros((total, total)),
        np.zeros(total), np.zeros(acts), np.zeros(acts), np.zeros(SCRATCH_SIZE), np.zeros(2),
    )  # fmt: skip


def state_size(model: Model) -> int:
    """Number of states."""
    moving = 2 * (len(model.mech.independent) + len(model.transmission))
    return moving + 4 * model.hydraulic + max(model.memory, 0)


def state_names(machine: Machine) -> list[str]:
    """Names of the states of `reduced_model(machine, ...)`, such as `rate.boom`, `spool.boom`."""
    names, mech = coordinate_names(machine), make_reduced_mechanism(machine)
    free = [names[i] for i in mech.independent]
    gears = [n for n in actuator_order(machine) if machine.axes[n].transmission]
    out = [f"position.{n}" for n in free] + [f"drive.{n}" for n in gears]
    out += [f"rate.{n}" for n in free] + [f"drive_rate.{n}" for n in gears]
    for name, axis in machine.hydraulic_axes.items():
        kinds = ("speed", "pressure_load") if axis.pump else ("spool", "spool_rate")
        out += [f"{k}.{name}" for k in (*kinds, "pressure_head", "pressure_rod")]
    return out + extra_state_names(machine)


_AIR, _ONSET = int(Slot.AIR_RELEASE), int(Slot.AIR_ONSET)


@compile_without_allocation
def set_activations(model, sp, z):
    """Write the activations of a state with the pressures that are felt into `sp.act`.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state.

    Returns:
        Nothing.

    Source: `laws.pressure_with_air`.
    """
    first = 2 * (len(model.mech.independent) + len(model.transmission))
    for k in range(len(sp.act)):
        sp.act[k] = z[first + k]
    for i in range(model.hydraulic):
        release, onset = model.user[i * SLOT_COUNT + _AIR], model.user[i * SLOT_COUNT + _ONSET]
        for k in range(4 * i + 2, 4 * i + 4):
            sp.act[k] = pressure_with_released_air(sp.act[k], release, onset)


@compile_without_allocation
def store_activations(model, sp, z):
    """Write `sp.act` back into a state, the inverse of `set_activations`.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state, of which the activations are written.

    Returns:
        Nothing.

    Source: `laws.pressure_without_air`.
    """
    first = 2 * (len(model.mech.independent) + len(model.transmission))
    for k in range(len(sp.act)):
        z[first + k] = sp.act[k]
    for i in range(model.hydraulic):
        release, onset = model.user[i * SLOT_COUNT + _AIR], model.user[i * SLOT_COUNT + _ONSET]
        for k in range(4 * i + 2, 4 * i + 4):
            z[first + k] = pressure_without_released_air(sp.act[k], release, onset)


@compile_without_allocation
def supply_of(model, sp, z, i):
    """Return the pressure that feeds hydraulic drive i in a state, scalar [Pa].

    `sp.act` is written, see `set_activations`, and `sp.scratch` with the pressures of all drives.

    Source: nominal model, "Supply".
    """
    set_activations(model, sp, z)
    solve_state_supplies(model.user, 0, model.hydraulic, sp.act, sp.scratch)
    return sp.scratch[FEED + i]


@compile_without_allocation
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
    commanded = i >= count and has_term(model.terms, ON_COMMAND, i)
    if not (commanded or has_term(model.terms, ON_FORCE, i)):
        return 0.0, 0.0
    supply = supply_of(model, sp, z, min(i, count - 1)) if count > 0 else 0.0
    s = make_drive_state(
        model.user, i, count, sp.act, supply, sp.time[0], sp.drive[X, i], velocity,
        sp.drive[COMMAND, i], model.gain[i],
    )  # fmt: skip
    drives = Drives(count, sp.act, sp.drive[X], sp.drive[V], sp.drive[COMMAND])
    force, slope = sum_terms_with_slope(model.terms, ON_FORCE, i, s, drives)
    if commanded:
        more, steep = sum_terms_with_slope(model.terms, ON_COMMAND, i, s, drives)
        force += model.gain[i] * more
        slope += model.gain[i] * steep
    return force, slope


@compile_without_allocation
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
    drives = Drives(model.hydraulic, sp.act, drive[X], drive[V], drive[COMMAND])
    add_command_terms(model.user, model.terms, drives, h, sp.time[0], sp.scratch, drive[GIVEN])


@compile_without_allocation
def is_lagged(model, c):
    """Whether a channel shows the past: through a delay or a first-order lag.

    Args:
        model: Model.
        c: channel.

    Returns:
        bool.

    Source: nominal model, "Sensors".
    """
    return model.lag[c] > 0.0 or model.time_constant[c] > 0.0


@compile_without_allocation
def follow_channel(trail, c, ratio, shown):
    """Replace what an ideal sensor shows over a row by what one with a first-order lag shows.

    Args:
        trail: (k + 1, c) as `advance` writes it, of k steps; column c is replaced
            [channel's unit].
        c: channel.
        ratio: length of a step over the time constant, scalar [1].
        shown: what the sensor shows at the row's start, scalar [channel's unit].

    Returns:
        What it shows at the row's end, scalar [channel's unit].

    Source: `noise.first_order`, between steps straight.
    """
    before = trail[0, c]
    trail[0, c] = shown
    for k in range(1, len(trail)):
        now = trail[k, c]
        shown = step_first_order_lag(shown, before, now, ratio)
        trail[k, c] = shown
        before = now
    return shown


@compile_without_allocation
def follow_trail(model, trail, h, shown):
    """`follow_channel` for every channel with a first-order lag.

    Args:
        model: Model.
        trail: (k + 1, c) as `advance` writes it, of k steps; changed in place.
        h: step, scalar [s].
        shown: (c,) what the sensors show at the row's start, then at its end; changed in place.

    Returns:
        Nothing.

    Source: `follow_channel`.
    """
    for c in range(len(model.time_constant)):
        if model.time_constant[c] > 0.0:
            shown[c] = follow_channel(trail, c, h / model.time_constant[c], shown[c])


_AH, _AR, _OFFSET = int(Slot.AREA_HEAD), int(Slot.AREA_ROD), int(Slot.OFFSET)
_BRISTLE_STIFFNESS, _BRISTLE = int(Slot.BRISTLE_STIFFNESS), int(Slot.BRISTLE)


@compile_without_allocation
def place(model, sp, z):
    """Put mechanism and drives at a state: `place_mechanism`, and the pressures that are felt.

    Args:
        model: Model.
        sp: Space; what `place_mechanism` says and `act` are written.
        z: (nz,) state.

    Returns:
        Nothing.

    Source: `place_mechanism`, `set_activations`.
    """
    place_mechanism(model, sp, z)
    set_activations(model, sp, z)


@compile_without_allocation
def place_mechanism(model, sp, z):
    """Put the mechanism at a state: frames, drive positions and their Jacobian rows.

    Args:
        model: Model.
        sp: Space; `motion`, `row` and X of `drive` are written. X of a drive with a transmission
            is its own position, not the load's.
        z: (nz,) state.

    Returns:
        Nothing.

    Source: kinematics of the closed chains.
    """
    mech, m = model.mech, sp.motion
    n, t, nt = len(mech.independent), len(model.transmission), m.joint.shape[1]
    for f in range(n):
        m.joint[RATE, mech.independent[f]] = z[n + t + f]
    if nt > n:
        close_loops(mech, m, z)
    else:
        for f in range(n):
            m.joint[Q, f] = z[f]
        compute_link_frames(mech.tree, mech.shape, mech.link_count, m.joint, m.frame, m.jacobian)
    compute_motion(model, sp, z)


@compile_without_allocation
def compute_motion(model, sp, z):
    """Compute the motion of all frames, drive positions and their Jacobian rows, after the frames of the links.

    Args:
        model: Model.
        sp: Space; as `place_mechanism`.
        z: (nz,) state; the positions of drives with a transmission are read.
    """
    mech, m = model.mech, sp.motion
    n, nt = len(mech.independent), m.joint.shape[1]
    compute_link_motion(mech.tree, mech.link_count, m.joint, m.frame, m.jacobian)
    if nt > n:
        compute_drift(mech, m)
    compute_bar_frames(mech.tree, mech.shape, 1 + mech.link_count, m.frame, m.jacobian, m.bar)
    compute_bar_motion(mech.tree, 1 + mech.link_count, m.frame, m.bar)
    for i in range(len(model.gear)):
        bar, joint = mech.drive[i, BAR], mech.drive[i, JOINT]
        for f in range(n):
            if bar < 0:
                sp.row[i, f] = m.basis[joint, f]
            elif nt == n:
                sp.row[i, f] = m.bar[bar, LENGTH_ROW + f]
            else:
                total = 0.0
                for k in range(nt):
                    total += m.bar[bar, LENGTH_ROW + k] * m.basis[k, f]
                sp.row[i, f] = total
        gear = model.gear[i]
        sp.drive[X, i] = load_position(model, sp, i) if gear < 0 else z[n + gear]


@compile_without_allocation
def load_position(model, sp, i):
    """Position of a drive's load side, scalar [m] or [rad], at the state of the last `place`.

    Source: kinematics of the closed chains.
    """
    mech, bar = model.mech, model.mech.drive[i, BAR]
    if bar < 0:
        return sp.motion.joint[Q, mech.drive[i, JOINT]]
    return sp.motion.bar[bar, BAR_LENGTH] - mech.shape[1 + mech.link_count + 2 * bar, CLOSED_LENGTH]


@compile_without_allocation
def accelerate(model, sp, z, dt):
    """Linearly implicit acceleration over a kick; leaves the mechanism where `place` put it.

    `a = (M + dt/2 D + dt^2/4 K)^-1 (sum J' F - h)` with the slope D of friction and dampers and the
    stiffness K of end stops and of friction's bristles, which is of second order and stable however
    steep these are.

    Args:
        model: Model.
        sp: Space after `place`; `force` receives the (n + t,) acceleration.
        z: (nz,) state, whose rates act; pressures are those of `sp`.
        dt: length of the kick, scalar [s]; 0 gives the acceleration itself.

    Returns:
        Nothing.

    Source: linearly implicit midpoint rule.
    """
    project_mechanism(model, sp, 0.5 * dt)
    add_drive_forces(model, sp, z, dt)
    factorise_cholesky(sp.mass)
    solve_cholesky(sp.mass, sp.force)


@compile_without_allocation
def project_mechanism(model, sp, half):
    """Write mass matrix and forces of the mechanism with its dampers, in independent coordinates.

    Args:
        model: Model.
        sp: Space after `place`; `mass` and `force` are written.
        half: half the length of the kick, over which the dampers act, scalar [s].
    """
    mech, m = model.mech, sp.motion
    compute_mass_and_bias(mech, m)
    _project(mech.joint, m.mass, m.joint, m.basis, half, len(mech.independent), sp.mass, sp.force)


@compile_without_allocation
def add_drive_forces(model, sp, z, dt):
    """Add forces, damping and stiffness of drives, transmissions and end stops to `mass` and `force`.

    The arguments are those of `accelerate`.
    """
    user, first = model.user, len(model.mech.independent) + len(model.transmission)  # first of the rates
    n, half = len(model.mech.independent), 0.5 * dt
    if len(model.terms) > 0:
        for i in range(len(model.gear)):
            sp.drive[V, i] = _drive_velocity(model, sp, z, i)
    for i in range(len(model.gear)):
        u, gear = i * SLOT_COUNT, model.gear[i]
        if i < model.hydraulic:
            push = user[u + _AH] * sp.act[4 * i + 2] - user[u + _AR] * sp.act[4 * i + 3]
        else:
            push = model.gain[i] * sp.drive[COMMAND, i] - user[u + _OFFSET]
        v = 0.0
        for f in range(n):
            v += sp.row[i, f] * z[first + f]
        own = v if gear < 0 else z[first + n + gear]
        act, more, steep = sp.act[4 * i :], 0.0, 0.0
        if len(model.terms) > 0:
            more, steep = term_force(model, sp, z, i, own)
        slope, plain = 0.0, True
        if model.memory >= 0:
            if user[u + _BRISTLE_STIFFNESS] > 0.0:
                plain, moved = False, _inertia(model, sp, i)
                sp.drive[INERTIA, i] = moved
                share = sp.act[int(user[u + _BRISTLE])]
                rubbing, damping, stiff = bristle_friction(user, u, share, own, moved, dt)
                push += more - rubbing
                slope = half * (damping + half * stiff - steep)
        if plain:
            push, damping = force_after_friction(user, u, push, more, act, own, dt)
            push += more
            slope = half * (damping - steep)
        if gear >= 0:
            damping = model.transmission[gear, GEAR_DAMPING]
            free = 0.5 * model.transmission[gear, BACKLASH]
            twist = z[n + gear] - load_position(model, sp, i)
            twist -= min(free, max(-free, twist))
            spring = model.transmission[gear, STIFFNESS] * twist + damping * (own - v)
            sp.force[n + gear] += push - spring
            inertia = model.transmission[gear, GEAR_INERTIA]
            sp.mass[n + gear, n + gear] += inertia + slope + half * damping
            push, slope = spring, half * damping
            for f in range(n):
                sp.mass[n + gear, f] -= slope * sp.row[i, f]
        at = sp.drive[X, i] if gear < 0 else load_position(model, sp, i)
        stop, stiff, damped = actuator_end_stop_force(user, u, at, v)
        push += stop
        slope += half * (damped + half * stiff)
        for f in range(n):
            sp.force[f] += sp.row[i, f] * push
            for g in range(f + 1):
                sp.mass[f, g] += slope * sp.row[i, f] * sp.row[i, g]


@compile_without_allocation
def _drive_velocity(model, sp, z, i):
    """Velocity of a drive, its own where it has a transmission, scalar [m/s] or [rad/s]."""
    n, first = len(model.mech.independent), len(model.mech.independent) + len(model.transmission)
    if model.gear[i] >= 0:
        return z[first + n + model.gear[i]]
    v = 0.0
    for f in range(n):
        v += sp.row[i, f] * z[first + f]
    return v


@compile_without_allocation
def _inertia(model, sp, i):
    """Inertia that a drive moves while the others rest, scalar [kg] or [kg m^2]."""
    if model.gear[i] >= 0:
        return model.transmission[model.gear[i], GEAR_INERTIA]
    least = math.inf
    for f in range(len(model.mech.independent)):
        lever = sp.row[i, f]
        if lever != 0.0:
            least = min(least, sp.mass[f, f] / (lever * lever))
    return least


@compile_without_allocation
def _project(facts, tree_mass, joint, basis, half, n, mass, force):
    """Mass matrix and forces of the tree with its dampers, in independent coordinates."""
    nt = len(tree_mass)
    for f in range(len(force)):
        force[f] = 0.0
        for g in range(f + 1):
            mass[f, g] = 0.0
    for j in range(nt):
        tree_mass[j, j] += half * facts[DAMPING, j]
        joint[BIAS, j] += facts[DAMPING, j] * joint[RATE, j]
    if nt == n:
        for f in range(n):
            force[f] = -joint[BIAS, f]
            for g in range(f + 1):
                mass[f, g] = tree_mass[f, g]
        return
    for j in range(nt):
        bias = joint[BIAS, j]
        for k in range(nt):
            bias += tree_mass[j, k] * joint[DRIFT, k]
        for f in range(n):
            force[f] -= basis[j, f] * bias
        for g in range(n):
            total = 0.0
            for k in range(nt):
                total += tree_mass[j, k] * basis[k, g]
            for f in range(g, n):
                mass[f, g] += basis[j, f] * total


@compile_without_allocation
def arriving(command, row, begin, end, period, delay):
    """Mean of a held and delayed command over part of a row.

    Args:
        command: (n,) commands, each held for a period [1].
        row: index of the row.
        begin: start of the part within the row, scalar [s].
        end: end of the part, scalar [s].
        period: scalar [s].
        delay: scalar [s].

    Returns:
        Mean command, scalar [1]; before the first row the first command is held.

    Source: pure transport delay of a zero-order hold.

    >>> import numpy as np
    >>> arriving(np.array([0.0, 1.0]), 1, 0.0, 0.5, 1.0, 0.25)
    0.5
    """
    if delay == 0.0:
        return command[row]
    place = row + (begin - delay) / period
    stop = row + (end - delay) / period
    total, here = 0.0, place
    while here < stop - 1e-9:
        k = int(math.floor(here + 1e-9))  # CUDA's floor returns a float
        there = min(stop, k + 1.0)
        total += command[min(len(command) - 1, max(0, k))] * (there - here)
        here = there
    return total / (stop - place)


@compile_without_allocation
def advance(model, sp, z, command, row, period, steps, trail):
    """Advance a state over one row of a log.

    Positions and pressures stand at the whole steps, rates half-way between them; at both ends of
    the row all are brought to equal times.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state, advanced in place.
        command: (n, nu) commands, held from row to row.
        row: index of the row to cross.
        period: length of a row, scalar [s].
        steps: steps per row.
        trail: (>= steps + 1, c) written: what the late channels would show at every step of the
            row if they were not; (0, c) keeps nothing.

    Returns:
        Nothing.

    Source: velocity Verlet; circuit: `hydraulics.circuit.step_circuit`.
    """
    h = period / steps
    sp.time[0] = sp.time[1] + row * period
    take_commands(model, sp.drive, command, row, 0.0, h, period)
    place(model, sp, z)
    if len(trail) > 0:
        write_trail(model, sp, z, trail[0])
    accelerate(model, sp, z, 0.5 * h)
    kick_rates(model, sp, z, 0.5 * h)
    for step in range(steps):
        take_commands(model, sp.drive, command, row, step * h, (step + 1) * h, period)
        drift_positions(model, sp, z, h)
        place(model, sp, z)
        advance_oil(model, sp, z, h)
        sp.time[0] = sp.time[1] + row * period + (step + 1) * h
        kick = h if step < steps - 1 else 0.5 * h
        accelerate(model, sp, z, kick)
        kick_rates(model, sp, z, kick)
        if len(trail) > 0:
            write_trail(model, sp, z, trail[step + 1])


@compile_without_allocation
def drift_positions(model, sp, z, h):
    """Advance the positions of a state by a step h [s]; keep the drives' positions of before as velocities."""
    total = len(model.mech.independent) + len(model.transmission)
    for i in range(len(model.gear)):
        sp.drive[V, i] = sp.drive[X, i]
    for f in range(total):
        z[f] += h * z[total + f]


@compile_without_allocation
def kick_rates(model, sp, z, dt):
    """Advance the rates of a state by the acceleration in `sp.force` over dt [s]."""
    total = len(model.mech.independent) + len(model.transmission)
    for f in range(total):
        z[total + f] += dt * sp.force[f]


@compile_without_allocation
def advance_oil(model, sp, z, h):
    """Advance the activations of a state by a step, over which the drives' velocities are constant.

    Args:
        model: Model.
        sp: Space after `drift_positions` and `place`, with the commands and the time at the step's start.
        z: (nz,) state, whose activations are advanced.
        h: step, scalar [s].
    """
    act, drive, count, given = sp.act, sp.drive, model.hydraulic, COMMAND
    for i in range(len(model.gear)):
        drive[V, i] = (drive[X, i] - drive[V, i]) / h
    if model.memory >= 0:
        _bend(model.user, act, drive, h, sp.act_dot)
    if count > 0:
        if len(model.terms) > 0:
            add_commands(model, sp, h)
            given = GIVEN
        first = np.int64(0)  # numba compiles a function anew for a written number
        drives = Drives(count, act, drive[X], drive[V], drive[given])
        step_circuit(
            model.user, first, drives, h, sp.act_dot, sp.scratch, model.terms, sp.time[0],
            model.memory,
        )  # fmt: skip
        if model.memory >= 0 and len(model.terms) > 0:
            drives = Drives(count, act, drive[X], drive[V], drive[COMMAND])
            write_term_state_rates(model.user, model.terms, drives, sp.act_dot, h, sp.time[0], sp.scratch[FEED:])
        for k in range(4 * count):
            act[k] += h * sp.act_dot[k]
    if model.memory >= 0:
        for k in range(4 * count, len(sp.act_dot)):
            act[k] += h * sp.act_dot[k]
    store_activations(model, sp, z)


@compile_without_allocation
def _bend(user, act, drive, h, act_dot):
    """Rates of all bristles over a step in which the drives' velocities are held."""
    for i in range(drive.shape[1]):
        u = i * SLOT_COUNT
        if user[u + _BRISTLE_STIFFNESS] > 0.0:
            at = int(user[u + _BRISTLE])
            act_dot[at] = bristle_rate(user, u, act[at], drive[V, i], drive[INERTIA, i], h)


@compile_without_allocation
def take_commands(model, drive, command, row, begin, end, period):
    """Commands that arrive over part of a row."""
    for i in range(len(model.delay)):
        if model.delay[i] == 0.0:
            drive[COMMAND, i] = command[row, i]
        else:
            drive[COMMAND, i] = arriving(command[:, i], row, begin, end, period, model.delay[i])


@compile_without_allocation
def write_trail(model, sp, z, out):
    """Keep what the late channels would show in a state if they were not, after `place`.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state.
        out: (c,) written where a channel is late [channel's unit].

    Returns:
        Nothing.

    Source: nominal model, "Sensors".
    """
    for c in range(len(model.kind)):
        if is_lagged(model, c):
            out[c] = _shown(model, sp, z, c)


@compile_without_allocation
def _shown(model, sp, z, c):
    """What an ideal sensor of a channel shows, after `place`."""
    kind, i = model.kind[c], model.drive[c]
    if kind == POSITION:
        return sp.motion.joint[Q, model.mech.drive[i, JOINT]]
    if kind == VELOCITY:
        return sp.motion.joint[RATE, model.mech.drive[i, JOINT]]
    if kind == LENGTH:
        return sp.drive[X, i]
    if kind == SUPPLY:
        return supply_of(model, sp, z, i)
    return sp.act[4 * i + kind]


@compile_without_allocation
def read_channels(model, sp, z, row, steps, h, trail, out):
    """What the sensors show in a state, without noise and drift.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state.
        row: index of the row, for late channels.
        steps: steps per row.
        h: step, scalar [s].
        trail: as `advance` writes it and `follow_trail` changes it, of all rows so far; (0, c)
            shows late channels as if they were not.
        out: (c,) written [channel's unit].

    Returns:
        Nothing.

    Source: nominal model, "Sensors".
    """
    place(model, sp, z)
    show_channels(model, sp, z, row, steps, h, trail, out)


@compile_without_allocation
def show_channels(model, sp, z, row, steps, h, trail, out):
    """Write what the sensors show after `place`; the arguments are those of `read_channels`."""
    for c in range(len(model.kind)):
        if len(trail) > 0 and is_lagged(model, c):
            back = max(0.0, row * steps - model.lag[c] / h)
            low = int(math.floor(back))
            part = back - low
            value = trail[low, c]
            if part > 0.0:
                value += part * (trail[low + 1, c] - value)
        else:
            value = _shown(model, sp, z, c)
        out[c] = model.scale[c] * value + model.offset[c]


@compile_without_allocation
def add_sensor_drift(model, time, out):
    """Add to what the sensors show by how much their offsets have drifted.

    Args:
        model: Model.
        time: since the run's beginning, scalar [s].
        out: (c,) readings, changed in place [channel's unit].

    Returns:
        Nothing.

    Source: `machine.warming_drift`.
    """
    for c in range(len(model.drift)):
        if model.drift[c, 0] != 0.0:
            out[c] += warming_drift(time, model.drift[c, 0], model.drift[c, 1])


@compiled
def simulate_rows(model, sp, z, command, period, steps, out, states):
    """Free run from a state over all rows of a log.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state at the first row, advanced in place to the last.
        command: (n, nu) commands.
        period: scalar [s].
        steps: steps per row.
        out: (n, c) written: what the sensors show [channel's unit].
        states: (n, nz) written.

    Returns:
        Nothing.

    Source: `advance`.
    """
    rows = len(command)
    trail = np.zeros((rows * steps + 1, len(model.kind)))
    place(model, sp, z)
    write_trail(model, sp, z, trail[0])
    shown = trail[0].copy()
    for row in range(rows):
        read_channels(model, sp, z, row, steps, period / steps, trail, out[row])
        add_sensor_drift(model, sp.time[1] + row * period, out[row])
        for s in range(len(z)):
            states[row, s] = z[s]
        if row < rows - 1:
            ahead = trail[row * steps : (row + 1) * steps + 1]
            advance(model, sp, z, command, row, period, steps, ahead)
            follow_trail(model, ahead, period / steps, shown)
