"""External forces on an arm: the forces that its motion needs minus the forces of its drives.

`dynamic_balance` uses the complete model, `static_balance` only gravity. `tip_force` converts the
result to a force at the tip. `arm_tables` prepares an arm, and `free_axes` checks that its tip
force can be estimated from its drives.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.control.resolved_motion import arm_facts
from hydrotele.core.compiled import allocation_free, compiled
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record, floats, integers, rows_of
from hydrotele.estimate.reduced_model import model_space, place_mechanism, reduced_model, state_size
from hydrotele.hydraulics.circuit import actuator_friction
from hydrotele.hydraulics.parameters import SLOTS, Slot
from hydrotele.kinematics.task import task_jacobian
from hydrotele.machine.machine import Machine
from hydrotele.multibody.reduced_mechanism import (
    BIAS,
    DAMPING,
    DRIFT,
    HOME,
    RATE,
    ReducedMechanism,
    ReducedMotion,
    coordinate_names,
    gather_forces,
)

_AH, _AR = int(Slot.AREA_HEAD), int(Slot.AREA_ROD)
_ODDS = 8.0  # velocity range of a moving drive over sqrt(2 pi) times the noise
_SINGULAR = 1.0e-6  # pivot over largest entry, below which a Jacobian is singular


class BalanceModel(NamedTuple):
    """Required attributes of `estimate.reduced_model.Model`.

    Passing an array from Python takes a tenth of a microsecond.
    """

    mech: ReducedMechanism
    user: np.ndarray
    hydraulic: int
    gear: np.ndarray
    transmission: np.ndarray


class BalanceSpace(NamedTuple):
    """Required attributes of `estimate.reduced_model.Space`."""

    motion: ReducedMotion
    drive: np.ndarray
    row: np.ndarray


class ArmBalance(NamedTuple):
    """Model and state of an arm without transmissions: m joints, n independent coordinates.

    Attributes:
        model: model of the machine.
        space: work arrays of the model.
        z: (2 n + 4 h,) state of the model: positions, rates, and four values per valve, of which
            the last two are its pressures [Pa].
        joint: (m,) independent coordinate of every joint, swing first.
        task: (9,) of `kinematics.task.arm_parameters`.
        gravity: (p,) parameters of the static model [N m].
        acceleration: (n,) accelerations of the independent coordinates [rad/s^2] or [m/s^2].
        rate_noise: (n,) standard deviations of their rates [rad/s] or [m/s].
        angle: (m,) work array.
        table: (m, m) work array.
        work: (n,) work array.
    """

    model: BalanceModel
    space: BalanceSpace
    z: np.ndarray
    joint: np.ndarray
    task: np.ndarray
    gravity: np.ndarray
    acceleration: np.ndarray
    rate_noise: np.ndarray
    angle: np.ndarray
    table: np.ndarray
    work: np.ndarray


_ARRAYS = {
    "mech": ("tree", "shape", "joint", "free", "bound", "gravity", "drive"),
    "model": ("user", "gear", "transmission"),
    "motion": ("frame", "jacobian", "momentum", "bar", "mass", "joint", "basis", "loop", "normal"),
    "space": ("drive", "row"),
    "arm": ("z", "joint", "task", "gravity", "acceleration", "rate_noise", "angle", "table",
            "work"),
}  # fmt: skip
# fields of a record that hold the addresses of the arrays of ArmBalance and its parts
_ADDRESSES = [f"{part}_{name}" for part, names in _ARRAYS.items() for name in names]
_ARM = np.dtype(
    [(name, np.int64) for name in ("links", "bars", "hydraulic", "frames", "coordinates", "free")]
    + [(name, np.int64) for name in ("drives", "geared", "loops", "joints", "states", "users")]
    + [(name, np.int64) for name in ("shape_width", "frame_width", "bar_width", "terms")]
    + [(name, np.int64) for name in _ADDRESSES],
    align=True,
)


def arm_record(arm: ArmBalance) -> np.ndarray:
    """Return a record (1,) of an ArmBalance for `arm_of`; the arrays must outlive it."""
    mech, motion = arm.model.mech, arm.space.motion
    parts = {"mech": mech, "model": arm.model, "motion": motion, "space": arm.space, "arm": arm}
    arrays = {f"{p}_{n}": getattr(parts[p], n) for p, names in _ARRAYS.items() for n in names}
    record = address_record(_ARM, arrays)
    for name, value in {
        "links": mech.links, "bars": mech.bars, "hydraulic": arm.model.hydraulic,
        "frames": len(mech.tree), "coordinates": mech.joint.shape[1], "free": len(mech.free),
        "drives": len(mech.drive), "geared": len(arm.model.transmission),
        "loops": len(motion.loop), "joints": len(arm.joint), "states": len(arm.z),
        "users": len(arm.model.user), "shape_width": mech.shape.shape[1],
        "frame_width": motion.frame.shape[1], "bar_width": motion.bar.shape[1],
        "terms": len(arm.gravity),
    }.items():  # fmt: skip
        record[name] = value
    return record


@compiled
def arm_of(r):
    """Return the ArmBalance of a record of `arm_record`."""
    f, c, n, m = r.frames, r.coordinates, r.free, r.joints
    mech = ReducedMechanism(
        integers(r.mech_tree, 4 * f).reshape((f, 4)), rows_of(r.mech_shape, f, r.shape_width),
        r.links, r.bars, rows_of(r.mech_joint, 2, c), integers(r.mech_free, n),
        integers(r.mech_bound, c - n), floats(r.mech_gravity, 3),
        integers(r.mech_drive, 2 * r.drives).reshape((r.drives, 2)),
    )  # fmt: skip
    motion = ReducedMotion(
        rows_of(r.motion_frame, f, r.frame_width),
        floats(r.motion_jacobian, 6 * f * c).reshape((f, c, 6)),
        floats(r.motion_momentum, 6 * f * c).reshape((f, c, 6)),
        rows_of(r.motion_bar, r.bars, r.bar_width), rows_of(r.motion_mass, c, c),
        rows_of(r.motion_joint, 4, c), rows_of(r.motion_basis, c, n),
        rows_of(r.motion_loop, r.loops, c + 2), rows_of(r.motion_normal, c - n + 1, c - n),
    )  # fmt: skip
    return ArmBalance(
        BalanceModel(
            mech, floats(r.model_user, r.users), r.hydraulic, integers(r.model_gear, r.drives),
            rows_of(r.model_transmission, r.geared, 4),
        ),
        BalanceSpace(
            motion, rows_of(r.space_drive, 5, r.drives), rows_of(r.space_row, r.drives, n)
        ),
        floats(r.arm_z, r.states), integers(r.arm_joint, m), floats(r.arm_task, 9),
        floats(r.arm_gravity, r.terms), floats(r.arm_acceleration, n),
        floats(r.arm_rate_noise, n), floats(r.arm_angle, m), rows_of(r.arm_table, m, m),
        floats(r.arm_work, n),
    )  # fmt: skip


@allocation_free
def dynamic_balance(arm, outside):
    """Compute external forces by the complete model: inertia, gravity, friction, closed chains.

    `tau = B' (M (B q'' + d) + h + D q') - sum r_i (F_i - f_i(v_i))`

    Args:
        arm: ArmBalance; z and acceleration are read.
        outside: (n,) written: external forces on the independent coordinates [N m] or [N].

    Returns:
        Nothing.

    Source: Zhu 1994, 6.2, with the projection of `estimate.reduced_model`.
    """
    model, m = arm.model, arm.space.motion
    n, nt = len(outside), m.joint.shape[1]
    place_mechanism(model, arm.space, arm.z)
    gather_forces(model.mech, m)
    for f in range(n):
        outside[f] = 0.0
    for j in range(nt):
        need = m.joint[BIAS, j] + model.mech.joint[DAMPING, j] * m.joint[RATE, j]
        for k in range(nt):
            way = m.joint[DRIFT, k]
            for f in range(n):
                way += m.basis[k, f] * arm.acceleration[f]
            need += m.mass[j, k] * way
        for f in range(n):
            outside[f] += m.basis[j, f] * need
    _subtract_drives(arm, True, outside)


@allocation_free
def static_balance(arm, outside):
    """Compute external forces by the static model, which includes only gravity.

    `tau = Y(q) P - sum r_i F_i`

    Args:
        arm: ArmBalance; z and gravity are read.
        outside: (n,) written: external forces on the independent coordinates [N m]; without gravity
            for joints that do not belong to the arm.

    Returns:
        Nothing.

    Source: Zhu 1994, 6.6.
    """
    place_mechanism(arm.model, arm.space, arm.z)
    for f in range(len(outside)):
        outside[f] = 0.0
    for i in range(len(arm.joint)):
        outside[arm.joint[i]] = static_torque(arm.z, arm.joint, arm.gravity, i)
    _subtract_drives(arm, False, outside)


@allocation_free
def moving(velocity, variance):
    """Return the probability that a drive moves, given its measured velocity.

    Rest and motion have equal prior probability. The velocity of a moving drive is uniform over a
    range of _ODDS sqrt(2 pi) times the noise.

    Args:
        velocity: measured velocity, scalar [m/s] or [rad/s].
        variance: variance of its noise, scalar [m^2/s^2] or [rad^2/s^2]; 0 if exact.

    Returns:
        Probability, scalar [1].

    Source: Bayes' rule.

    >>> [round(moving(v, 1.0), 3) for v in (0.0, 2.0, 4.0)]
    [0.111, 0.48, 0.997]
    """
    if not variance > 0.0:
        return 1.0
    return 1.0 / (1.0 + _ODDS * math.exp(-0.5 * velocity * velocity / variance))


@allocation_free
def _subtract_drives(arm, rubbing, outside):
    """Subtract the drive forces from the external forces."""
    model, sp, n = arm.model, arm.space, len(outside)
    for i in range(model.hydraulic):
        u, a = i * SLOTS, 2 * n + 4 * i
        give = model.user[u + _AH] * arm.z[a + 2] - model.user[u + _AR] * arm.z[a + 3]
        if rubbing:
            v, noise = 0.0, 0.0
            for f in range(n):
                v += sp.row[i, f] * arm.z[n + f]
                noise += (sp.row[i, f] * arm.rate_noise[f]) ** 2
            give -= moving(v, noise) * actuator_friction(model.user, u, v)
        for f in range(n):
            outside[f] -= sp.row[i, f] * give


@allocation_free
def static_torque(q, joint, gravity, i):
    """Return the gravity torque of a joint of the arm.

    Each link from the boom outwards has two parameters, for the cosine and the sine of its
    attitude, which act on all joints before it. The seventh parameter belongs to the head of a
    feller-buncher.

    Args:
        q: (>= n,) positions of the independent coordinates [rad].
        joint: (m,) independent coordinate of every joint, swing first.
        gravity: (2 (m - 1),) parameters of 3 or 4 joints, (7,) of 5: C2, S2, C23, S23, C234,
            S234 and C5 [N m].
        i: index of the joint.

    Returns:
        Torque, scalar [N m].

    Source: Zhu 1994, 6.8 and 6.9.
    """
    if i == 0:
        return 0.0
    bending, angle, total = min(4, len(joint)), 0.0, 0.0
    for k in range(1, bending):
        angle += q[joint[k]]
        if k >= i:
            total += gravity[2 * k - 2] * math.cos(angle) + gravity[2 * k - 1] * math.sin(angle)
    if len(joint) < 5:
        return total
    head = q[joint[4]]
    if i == 4:
        return -gravity[6] * math.sin(head) * math.sin(angle)
    return total + gravity[6] * math.cos(head) * math.cos(angle)


@allocation_free
def tip_force(arm, outside, out):
    """Compute the force at the tip from external forces on the coordinates.

    Args:
        arm: ArmBalance; z is read, table and work are overwritten.
        outside: (n,) external forces on the independent coordinates [N m] or [N].
        out: (m,) written: r [N], theta [N m], z [N], then attitude and head [N m]; unchanged if the
            Jacobian is singular.

    Returns:
        Whether `out` was written.

    Source: Zhu 1994, 6.6: `F = J^-T tau`.
    """
    m, most = len(out), 0.0
    for i in range(m):
        arm.angle[i] = arm.z[arm.joint[i]]
    task_jacobian(arm.task, arm.angle, arm.table)
    for i in range(m):
        arm.work[i] = outside[arm.joint[i]]
        for j in range(i):
            arm.table[i, j], arm.table[j, i] = arm.table[j, i], arm.table[i, j]
        for j in range(m):
            most = max(most, abs(arm.table[i, j]))
    if not _eliminated(arm.table, arm.work, m, _SINGULAR * most):
        return False
    for i in range(m):
        out[i] = arm.work[i]
    return True


@allocation_free
def _eliminated(table, right, m, least):
    """Solve linear equations in place by elimination; return False if a pivot is below `least`."""
    for i in range(m):
        best = i
        for r in range(i + 1, m):
            if abs(table[r, i]) > abs(table[best, i]):
                best = r
        if not abs(table[best, i]) > least:
            return False
        for j in range(m):
            table[i, j], table[best, j] = table[best, j], table[i, j]
        right[i], right[best] = right[best], right[i]
        for r in range(i + 1, m):
            part = table[r, i] / table[i, i]
            right[r] -= part * right[i]
            for j in range(i, m):
                table[r, j] -= part * table[i, j]
    for i in range(m - 1, -1, -1):
        for j in range(i + 1, m):
            right[i] -= table[i, j] * right[j]
        right[i] /= table[i, i]
    return True


def arm_joints(machine: Machine) -> tuple[str, ...]:
    """Return the joints of the arm from swing outwards.

    Raises:
        InputError: the machine has no arm.
    """
    arm = machine.arm
    if arm is None:
        raise InputError(f"machine {machine.name}", "has no arm, so there is no tip force")
    return tuple(j for j in (arm.swing, arm.boom, arm.stick, arm.tool, arm.head) if j)


def gravity_size(joints: int) -> int:
    """Return the number of parameters of the static model of an arm with that many joints."""
    return 7 if joints == 5 else 2 * (joints - 1)


def free_axes(machine: Machine, where: str) -> tuple[str, ...]:
    """Return the axes of the independent coordinates.

    Args:
        machine: the machine.
        where: name of the caller, for messages.

    Returns:
        Axis names in the order of the coordinates.

    Raises:
        InputError: a coordinate is not driven, or a joint of the arm is not driven by a valve.
    """
    names, driver = coordinate_names(machine), {a.joint: n for n, a in machine.axes.items()}
    free = [names[i] for i in reduced_model(machine, ()).mech.free]
    if loose := [joint for joint in free if joint not in driver]:
        raise InputError(where, f"{', '.join(loose)} has no drive: its motion is not measured")
    joints = arm_joints(machine)
    if plain := [joint for joint in joints if driver[joint] not in machine.hydraulic_axes]:
        raise InputError(where, f"{', '.join(plain)} has no valve: its torque is not measured")
    return tuple(driver[joint] for joint in free)


def arm_tables(machine: Machine, where: str) -> ArmBalance:
    """Create the model of an arm, with transmissions assumed rigid and massless.

    Args:
        machine: the machine.
        where: name of the caller, for messages.

    Returns:
        The model at its home position with zero pressures.

    Raises:
        InputError: a coordinate is not driven, or a joint of the arm is not driven by a valve.
    """
    free = free_axes(machine, where)
    rigid = {n: a.model_copy(update={"transmission": None}) for n, a in machine.axes.items()}
    model = reduced_model(machine.model_copy(update={"axes": rigid}), ())
    space, z, (task, axes, _) = model_space(model), np.zeros(state_size(model)), arm_facts(machine)
    n, m = len(free), len(axes)
    z[:n] = model.mech.joint[HOME][model.mech.free]
    return ArmBalance(
        model=BalanceModel(model.mech, model.user, model.hydraulic, model.gear, model.transmission),
        space=BalanceSpace(space.motion, space.drive, space.row),
        z=z,
        joint=np.array([free.index(name) for name in axes]),
        task=task,
        gravity=np.zeros(gravity_size(m)),
        acceleration=np.zeros(n),
        rate_noise=np.zeros(n),
        angle=np.zeros(m),
        table=np.zeros((m, m)),
        work=np.zeros(n),
    )
