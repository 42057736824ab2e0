"""External forces on an arm: the forces that its motion needs minus the forces of its drives.

`compute_dynamic_external_forces` uses the complete model, `compute_static_external_forces` only gravity.
`solve_tip_force` converts the result to a force at the tip. `create_arm_balance` prepares an arm, and
`independent_axes` checks that its tip force can be estimated from its drives.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.control.arm_kinematics import arm_specification
from hydrotele.core.compiled import compile_without_allocation, compiled
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record, float64_view, int64_view, matrix_view
from hydrotele.estimate.reduced_model import model_space, place_mechanism, reduced_model, state_size
from hydrotele.hydraulics.actuator_layout import SLOT_COUNT, Slot
from hydrotele.hydraulics.circuit import actuator_friction
from hydrotele.kinematics.task_space import task_jacobian
from hydrotele.machine.machine import Machine
from hydrotele.multibody.reduced_dynamics import BIAS, DRIFT, RATE, ReducedMotion, compute_mass_and_bias
from hydrotele.multibody.reduced_mechanism import DAMPING, HOME, ReducedMechanism, coordinate_names

_AH, _AR = int(Slot.AREA_HEAD), int(Slot.AREA_ROD)
_VELOCITY_RANGE_RATIO = 8.0  # velocity range of a moving drive over sqrt(2 pi) times the noise
_MIN_PIVOT_RATIO = 1.0e-6  # pivot over largest entry, below which a Jacobian is singular


class BalanceModel(NamedTuple):
    """The attributes of `estimate.reduced_model.Model` that a force balance needs.

    The others are omitted, because passing an array from Python to compiled code takes 0.1 us.
    """

    mech: ReducedMechanism
    user: np.ndarray
    hydraulic: int
    gear: np.ndarray
    transmission: np.ndarray


class BalanceSpace(NamedTuple):
    """The attributes of `estimate.reduced_model.Space`, its work arrays, that a force balance needs."""

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
        joint: (m,) index of the independent coordinate of every joint, swing first.
        task: (9,) of `kinematics.task_space.arm_parameters`.
        gravity: (p,) parameters of the static gravity model, see `joint_gravity_torque` [N m].
        acceleration: (n,) accelerations of the independent coordinates [rad/s^2] or [m/s^2].
        rate_noise: (n,) noise standard deviations of the rates of the independent coordinates
            [rad/s] or [m/s].
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


_ARRAY_FIELDS = {
    "mech": ("tree", "shape", "joint", "independent", "dependent", "gravity", "drive"),
    "model": ("user", "gear", "transmission"),
    "motion": ("frame", "jacobian", "momentum", "bar", "mass", "joint", "basis", "loop", "normal"),
    "space": ("drive", "row"),
    "arm": ("z", "joint", "task", "gravity", "acceleration", "rate_noise", "angle", "table",
            "work"),
}  # fmt: skip
# fields of a record that hold the addresses of the arrays of ArmBalance and its parts
_ADDRESS_FIELDS = [f"{part}_{name}" for part, names in _ARRAY_FIELDS.items() for name in names]
_ARM_DTYPE = np.dtype(
    [(name, np.int64) for name in ("links", "bars", "hydraulic", "frames", "coordinates", "free")]
    + [(name, np.int64) for name in ("drives", "geared", "loops", "joints", "states", "users")]
    + [(name, np.int64) for name in ("shape_width", "frame_width", "bar_width", "terms")]
    + [(name, np.int64) for name in _ADDRESS_FIELDS],
    align=True,
)


def arm_record(arm: ArmBalance) -> np.ndarray:
    """Pack an ArmBalance into a record (1,) of sizes and array addresses, which is fast to pass to compiled code.

    The arrays must outlive the record. `read_arm_record` unpacks it.
    """
    mech, motion = arm.model.mech, arm.space.motion
    parts = {"mech": mech, "model": arm.model, "motion": motion, "space": arm.space, "arm": arm}
    arrays = {f"{p}_{n}": getattr(parts[p], n) for p, names in _ARRAY_FIELDS.items() for n in names}
    record = address_record(_ARM_DTYPE, arrays)
    for name, value in {
        "links": mech.link_count, "bars": mech.bar_count, "hydraulic": arm.model.hydraulic,
        "frames": len(mech.tree), "coordinates": mech.joint.shape[1], "free": len(mech.independent),
        "drives": len(mech.drive), "geared": len(arm.model.transmission),
        "loops": len(motion.loop), "joints": len(arm.joint), "states": len(arm.z),
        "users": len(arm.model.user), "shape_width": mech.shape.shape[1],
        "frame_width": motion.frame.shape[1], "bar_width": motion.bar.shape[1],
        "terms": len(arm.gravity),
    }.items():  # fmt: skip
        record[name] = value
    return record


@compiled
def read_arm_record(r):
    """Unpack a record of `arm_record` to an ArmBalance whose arrays share its memory."""
    f, c, n, m = r.frames, r.coordinates, r.free, r.joints
    mech = ReducedMechanism(
        int64_view(r.mech_tree, 4 * f).reshape((f, 4)), matrix_view(r.mech_shape, f, r.shape_width),
        r.links, r.bars, matrix_view(r.mech_joint, 2, c), int64_view(r.mech_independent, n),
        int64_view(r.mech_dependent, c - n), float64_view(r.mech_gravity, 3),
        int64_view(r.mech_drive, 2 * r.drives).reshape((r.drives, 2)),
    )  # fmt: skip
    motion = ReducedMotion(
        matrix_view(r.motion_frame, f, r.frame_width),
        float64_view(r.motion_jacobian, 6 * f * c).reshape((f, c, 6)),
        float64_view(r.motion_momentum, 6 * f * c).reshape((f, c, 6)),
        matrix_view(r.motion_bar, r.bars, r.bar_width), matrix_view(r.motion_mass, c, c),
        matrix_view(r.motion_joint, 4, c), matrix_view(r.motion_basis, c, n),
        matrix_view(r.motion_loop, r.loops, c + 2), matrix_view(r.motion_normal, c - n + 1, c - n),
    )  # fmt: skip
    return ArmBalance(
        BalanceModel(
            mech, float64_view(r.model_user, r.users), r.hydraulic, int64_view(r.model_gear, r.drives),
            matrix_view(r.model_transmission, r.geared, 4),
        ),
        BalanceSpace(
            motion, matrix_view(r.space_drive, 5, r.drives), matrix_view(r.space_row, r.drives, n)
        ),
        float64_view(r.arm_z, r.states), int64_view(r.arm_joint, m), float64_view(r.arm_task, 9),
        float64_view(r.arm_gravity, r.terms), float64_view(r.arm_acceleration, n),
        float64_view(r.arm_rate_noise, n), float64_view(r.arm_angle, m), matrix_view(r.arm_table, m, m),
        float64_view(r.arm_work, n),
    )  # fmt: skip


@compile_without_allocation
def compute_dynamic_external_forces(arm, external_force):
    """Compute external forces on an arm by the complete model: inertia, gravity, friction, closed chains.

    `tau = B' (M (B a + d) + h + D q') - sum r_i (F_i - f_i(v_i))` with the accelerations a of the
    independent coordinates, the basis B (all joint rates per independent rate), and the joint accelerations
    d at a = 0. M is the mass matrix, h the gravity and velocity forces, D the damping and q' the joint
    rates. r_i, F_i and f_i(v_i) are moment arm, force and friction of drive i at velocity v_i.

    Args:
        arm: ArmBalance; z and acceleration are read.
        external_force: (n,) written: external forces on the independent coordinates [N m] or [N].

    Returns:
        Nothing.

    Source: Zhu 1994, 6.2, with the projection of `estimate.reduced_model`.
    """
    model, m = arm.model, arm.space.motion
    n, nt = len(external_force), m.joint.shape[1]
    place_mechanism(model, arm.space, arm.z)
    compute_mass_and_bias(model.mech, m)
    for f in range(n):
        external_force[f] = 0.0
    for j in range(nt):
        need = m.joint[BIAS, j] + model.mech.joint[DAMPING, j] * m.joint[RATE, j]
        for k in range(nt):
            way = m.joint[DRIFT, k]
            for f in range(n):
                way += m.basis[k, f] * arm.acceleration[f]
            need += m.mass[j, k] * way
        for f in range(n):
            external_force[f] += m.basis[j, f] * need
    _subtract_drive_forces(arm, True, external_force)


@compile_without_allocation
def compute_static_external_forces(arm, external_force):
    """Compute external forces on an arm by the static model, which includes only gravity.

    `tau = Y(q) P - sum r_i F_i` with gravity torques Y(q) P, and moment arms r_i and forces F_i of
    the drives.

    Args:
        arm: ArmBalance; z and gravity are read.
        external_force: (n,) written: external forces on the independent coordinates [N m] or [N].
            Gravity torques are included for the joints of the arm only.

    Returns:
        Nothing.

    Source: Zhu 1994, 6.6.
    """
    place_mechanism(arm.model, arm.space, arm.z)
    for f in range(len(external_force)):
        external_force[f] = 0.0
    for i in range(len(arm.joint)):
        external_force[arm.joint[i]] = joint_gravity_torque(arm.z, arm.joint, arm.gravity, i)
    _subtract_drive_forces(arm, False, external_force)


@compile_without_allocation
def motion_probability(velocity, variance):
    """Return the probability that a drive moves, given its measured velocity.

    Rest and motion have equal prior probability. The velocity of a moving drive is uniform over a
    range of 8 sqrt(2 pi) standard deviations of the noise.

    Args:
        velocity: measured velocity, scalar [m/s] or [rad/s].
        variance: variance of its noise, scalar [m^2/s^2] or [rad^2/s^2]; 0 if exact.

    Returns:
        Probability, scalar [1].

    Source: Bayes' rule.

    >>> [round(motion_probability(v, 1.0), 3) for v in (0.0, 2.0, 4.0)]
    [0.111, 0.48, 0.997]
    """
    if not variance > 0.0:
        return 1.0
    return 1.0 / (1.0 + _VELOCITY_RANGE_RATIO * math.exp(-0.5 * velocity * velocity / variance))


@compile_without_allocation
def _subtract_drive_forces(arm, with_friction, external_force):
    """Subtract the forces of the hydraulic drives, times their moment arms, from the external forces (n,).

    With `with_friction`, the force of a drive is first reduced by its friction times the
    probability that it moves.
    """
    model, sp, n = arm.model, arm.space, len(external_force)
    for i in range(model.hydraulic):
        u, a = i * SLOT_COUNT, 2 * n + 4 * i
        give = model.user[u + _AH] * arm.z[a + 2] - model.user[u + _AR] * arm.z[a + 3]
        if with_friction:
            v, noise = 0.0, 0.0
            for f in range(n):
                v += sp.row[i, f] * arm.z[n + f]
                noise += (sp.row[i, f] * arm.rate_noise[f]) ** 2
            give -= motion_probability(v, noise) * actuator_friction(model.user, u, v)
        for f in range(n):
            external_force[f] -= sp.row[i, f] * give


@compile_without_allocation
def joint_gravity_torque(q, joint, gravity, i):
    """Return the gravity torque on a joint of the arm, by the static model.

    Each link from the boom outwards has two parameters, for the cosine and the sine of its
    attitude, which act on its own joint and on all joints before it. The seventh parameter belongs to the head of a
    feller-buncher.

    Args:
        q: (>= n,) positions of the independent coordinates [rad].
        joint: (m,) index of the independent coordinate of every joint, swing first.
        gravity: (2 (m - 1),) parameters of 3 or 4 joints, (7,) of 5: C2, S2, C23, S23, C234,
            S234 and C5 [N m], where C23 is the factor of cos(q2 + q3) and so on.
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


@compile_without_allocation
def solve_tip_force(arm, external_force, out):
    """Compute the force at the tip that is equivalent to external forces on the coordinates.

    Args:
        arm: ArmBalance; z is read, table and work are overwritten.
        external_force: (n,) external forces on the independent coordinates [N m] or [N].
        out: (m,) written: force along r [N], theta [N m], z [N], then attitude and head [N m]; unchanged if the
            Jacobian is singular.

    Returns:
        Whether `out` was written.

    Source: Zhu 1994, 6.6: `F = J^-T tau` with the Jacobian J of the tip.
    """
    m, most = len(out), 0.0
    for i in range(m):
        arm.angle[i] = arm.z[arm.joint[i]]
    task_jacobian(arm.task, arm.angle, arm.table)
    for i in range(m):
        arm.work[i] = external_force[arm.joint[i]]
        for j in range(i):
            arm.table[i, j], arm.table[j, i] = arm.table[j, i], arm.table[i, j]
        for j in range(m):
            most = max(most, abs(arm.table[i, j]))
    if not _solve_by_elimination(arm.table, arm.work, m, _MIN_PIVOT_RATIO * most):
        return False
    for i in range(m):
        out[i] = arm.work[i]
    return True


@compile_without_allocation
def _solve_by_elimination(table, right, m, min_pivot):
    """Solve m linear equations `table x = right` in place by Gaussian elimination with pivoting.

    The solution overwrites `right`; `table` is overwritten as well.

    Returns:
        True; False if the absolute value of a pivot is not above `min_pivot`, so that there is no
        solution.
    """
    for i in range(m):
        best = i
        for r in range(i + 1, m):
            if abs(table[r, i]) > abs(table[best, i]):
                best = r
        if not abs(table[best, i]) > min_pivot:
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
    """Return the names of the arm's joints from the swing joint outwards.

    Raises:
        InputError: the machine has no arm.
    """
    arm = machine.arm
    if arm is None:
        raise InputError(f"machine {machine.name}", "has no arm, so there is no tip force")
    return tuple(j for j in (arm.swing, arm.boom, arm.stick, arm.tool, arm.head) if j)


def gravity_parameter_count(joints: int) -> int:
    """Return the number of parameters of the static gravity model of an arm with a number of joints."""
    return 7 if joints == 5 else 2 * (joints - 1)


def independent_axes(machine: Machine, context: str) -> tuple[str, ...]:
    """Return the axes that drive the independent coordinates, and check that the tip force can be estimated.

    Args:
        machine: the machine.
        context: name of the caller, for messages.

    Returns:
        Axis names in the order of the coordinates.

    Raises:
        InputError: a coordinate is not driven, or a joint of the arm is not driven by a valve.
    """
    names, driver = coordinate_names(machine), {a.joint: n for n, a in machine.axes.items()}
    free = [names[i] for i in reduced_model(machine, ()).mech.independent]
    if loose := [joint for joint in free if joint not in driver]:
        raise InputError(context, f"{', '.join(loose)} has no drive: its motion is not measured")
    joints = arm_joints(machine)
    if plain := [joint for joint in joints if driver[joint] not in machine.hydraulic_axes]:
        raise InputError(context, f"{', '.join(plain)} has no valve: its torque is not measured")
    return tuple(driver[joint] for joint in free)


def create_arm_balance(machine: Machine, context: str) -> ArmBalance:
    """Create the force balance model of an arm, with transmissions assumed rigid and massless.

    Args:
        machine: the machine.
        context: name of the caller, for messages.

    Returns:
        The model at its home position with zero pressures.

    Raises:
        InputError: a coordinate is not driven, or a joint of the arm is not driven by a valve.
    """
    free = independent_axes(machine, context)
    rigid = {n: a.model_copy(update={"transmission": None}) for n, a in machine.axes.items()}
    model = reduced_model(machine.model_copy(update={"axes": rigid}), ())
    space, z, (task, axes, _) = (
        model_space(model),
        np.zeros(state_size(model)),
        arm_specification(machine),
    )
    n, m = len(free), len(axes)
    z[:n] = model.mech.joint[HOME][model.mech.independent]
    return ArmBalance(
        model=BalanceModel(model.mech, model.user, model.hydraulic, model.gear, model.transmission),
        space=BalanceSpace(space.motion, space.drive, space.row),
        z=z,
        joint=np.array([free.index(name) for name in axes]),
        task=task,
        gravity=np.zeros(gravity_parameter_count(m)),
        acceleration=np.zeros(n),
        rate_noise=np.zeros(n),
        angle=np.zeros(m),
        table=np.zeros((m, m)),
        work=np.zeros(n),
    )
