"""Inverse dynamics of a closed chain: motion of all joints, drive forces, and regressor.

Compiled code processes all rows of a log. It closes the loops by Newton's method from the previous
row. Rates and accelerations follow from the Jacobian of the closures. The forces of passive joints
are projected on the drives by virtual work.

The drive forces are linear in the inertial and friction parameters, for any chain that
`multibody.chain` reads. Friction acts in joints and closures.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.polynomial.hermite_e import hermegauss

from hydrotele.core.compiled import compile_without_allocation, compiled
from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.closures import (
    close_loops_near,
    compute_closure_acceleration,
    describe_unclosed_loop,
    find_assemblies,
    find_start_pose,
    make_loop_workspace,
)
from hydrotele.multibody.tree_motion import (
    compute_frames,
    compute_unit_wrenches,
    dot,
    get_rotation,
    get_vector,
    point_jacobian_column,
    qr_factor,
    qr_solve,
    rotate_vector,
    subtract_vectors,
)

_MAX_GIVEN_STEP = 0.1  # rad or m, maximum step of the given joints, so that loops stay on their branch
_ERROR_CONTEXT = "closures"


class Projection(NamedTuple):
    """Motion and forces of a chain projected on its drives; n rows, v joints, b bodies, k drives.

    Attributes:
        position: (n, v) of all joints [rad] or [m].
        rate: (n, v) [rad/s] or [m/s].
        acceleration: (n, v) [rad/s^2] or [m/s^2].
        joint_projection: (n, k, v) force of drive k per unit force or torque in joint v.
        body_projection: (n, k, 10 b) force of drive k [N] or [N m] per unit of an inertial parameter.
        closure_rate: (n, c) relative rotation rate of the two bodies of a closure [rad/s].
        closure_projection: (n, k, c) force of drive k per unit of viscous friction in a closure.
    """

    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    joint_projection: np.ndarray
    body_projection: np.ndarray
    closure_rate: np.ndarray
    closure_projection: np.ndarray


def project_on_drives(
    chain: Chain, given: tuple[str, ...], position: np.ndarray, rate: np.ndarray,
    acceleration: np.ndarray, drives: tuple[str, ...] | None = None,
    start: np.ndarray | None = None,
    moment_free: Mapping[str, tuple[float, float, float]] | None = None,
) -> Projection:  # fmt: skip
    """Compute the motion of all joints and project the forces of a chain on its drives.

    Args:
        chain: the chain.
        given: the k joints with known motion; the closures must determine the others.
        position: (n, k) their positions [rad] or [m].
        rate: (n, k) their rates [rad/s] or [m/s].
        acceleration: (n, k) their accelerations [rad/s^2] or [m/s^2].
        drives: k joints whose forces are computed; the drives of the chain by default.
        start: (v,) initial positions before the first row; those of the chain by default.
        moment_free: body -> unit axis through the origin of its frame, in that frame, about which
            its neighbours transmit no moment. Its motion is not affected.

    Returns:
        The projection. The drive forces are `body_projection @ chain.inertia.ravel()` plus the friction
        forces.

    Raises:
        InputError: a shape is wrong, a value is missing, a body does not exist, the closures do not
            determine the other joints, or a row cannot be reached.

    Source: Newton-Euler about the body frames, D'Alembert; Abdellatif 2008, section 2; bodies
    without moment about an axis: Khoshzaban 1992, p. 92, Eq. 4.23.
    """
    drives = chain.drives if drives is None else drives
    columns = np.array([chain.index(name) for name in given], np.int64)
    moved = np.array([chain.index(name) for name in drives], np.int64)
    tables = [_check_table(values, len(given)) for values in (position, rate, acceleration)]
    if len({len(table) for table in tables}) > 1:
        raise InputError(_ERROR_CONTEXT, "positions, rates and accelerations must have the same rows")
    if len(moved) != len(columns):
        raise InputError(
            _ERROR_CONTEXT,
            f"{len(columns)} joints are given but {len(moved)} have a drive; inverse dynamics needs equal numbers",
        )
    n, v, k = len(tables[0]), len(chain.joints), len(columns)
    axes = np.zeros((len(chain.bodies) + 1, 3))
    for body, axis in (moment_free or {}).items():
        axes[_body_index(chain, body) + 1] = axis
    others = np.setdiff1d(np.arange(v), columns)
    q = find_start_pose(chain, given, tables[0], start)
    out = Projection(
        np.empty((n, v)), np.empty((n, v)), np.empty((n, v)), np.empty((n, k, v)),
        np.empty((n, k, 10 * len(chain.bodies))), np.empty((n, len(chain.tree.closure_bodies))),
        np.empty((n, k, len(chain.tree.closure_bodies))),
    )  # fmt: skip
    given_rows = _GivenMotion(columns, *tables)
    failed = _project_rows(chain.tree, given_rows, others, moved, axes, q, out)
    if failed >= 0:
        if len(chain.closures) and not len(find_assemblies(chain, given, tables[0][failed])):
            message = describe_unclosed_loop(chain, given, tables[0][failed], failed)
        else:
            message = (
                f"row {failed}: the loops of {chain.name} cannot be closed there without a jump to another"
                f" assembly, or the pose is singular for the drives {', '.join(drives)}"
            )
        raise InputError(chain.source or _ERROR_CONTEXT, message)
    return out


def _body_index(chain: Chain, body: str) -> int:
    if body not in chain.bodies:
        raise InputError(_ERROR_CONTEXT, f"{chain.name} has no body {body}: {', '.join(chain.bodies)}")
    return chain.bodies.index(body)


def _check_table(values: np.ndarray, width: int) -> np.ndarray:
    table = np.ascontiguousarray(values, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != width:
        raise InputError(_ERROR_CONTEXT, f"motion must be (n, {width}), one column per joint: {table.shape}")
    if not np.isfinite(table).all():
        row = int(np.argwhere(~np.isfinite(table))[0, 0])
        raise InputError(_ERROR_CONTEXT, f"row {row} has no motion: smooth the log over its gaps first")
    return table


class _GivenMotion(NamedTuple):
    """Indices (k,) of the given joints, and their motion, (n, k) each."""

    joints: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray


@compiled
def _project_rows(tree, given, others, drives, moment_free, q, out):
    """Compute motion and projected forces of a chain row by row, and write them to a `Projection`.

    Args:
        tree: Tree.
        given: _GivenMotion of k joints.
        others: (v - k,) indices of the other joints.
        drives: (k,) indices of the driven joints.
        moment_free: (b, 3) unit axis without moment of every body in its frame, or 0.
        q: (v,) closed positions before the first row, updated.
        out: Projection, written.

    Returns:
        Index of the first row where this fails, or -1.
    """
    b, v, k = len(tree.parent), len(tree.reference_position), len(given.joints)
    hidden, space = len(others), make_loop_workspace(tree, len(others), k)
    frames, part, ground = space.frames, space.solution, -tree.gravity
    moves = np.zeros((v, k))  # rates of all joints per unit rate of the given joints
    q_drive, r_drive, unit = np.empty((k, k)), np.empty((k, k)), np.eye(k)
    inverse, every = np.empty((k, k)), np.arange(k)
    forces, torques = np.empty((3, 10)), np.empty((3, 10))
    for i in range(k):
        moves[given.joints[i], i] = 1.0
    for row in range(len(given.position)):
        far = 0.0
        for i in range(k):
            far = max(far, abs(given.position[row, i] - q[given.joints[i]]))
        steps = max(1, int(math.ceil(far / _MAX_GIVEN_STEP))) if len(space.error) > 0 else 1
        for step in range(steps, 0, -1):
            for i in range(k):
                at = given.joints[i]
                q[at] += (given.position[row, i] - q[at]) / step
            if not close_loops_near(tree, q, others, space):
                return row
        for i in range(k if hidden else 0):
            qr_solve(space.q_factor, space.r_factor, hidden, space.error_jacobian, given.joints[i], part, i)
            for o in range(hidden):
                moves[others[o], i] = -part[o, i]
        rate, acceleration = out.rate[row], out.acceleration[row]
        for j in range(v):
            rate[j] = acceleration[j] = 0.0
            for i in range(k):
                rate[j] += moves[j, i] * given.rate[row, i]
        if hidden:
            compute_frames(tree, q, rate, space.zero_rates, space.zero_vector, frames)
            compute_closure_acceleration(tree, frames, space.error)
            qr_solve(space.q_factor, space.r_factor, hidden, space.error, 0, part, 0)
            for o in range(hidden):
                acceleration[others[o]] = -part[o, 0]
        for j in range(v):
            out.position[row, j] = q[j]
            for i in range(k):
                acceleration[j] += moves[j, i] * given.acceleration[row, i]
        compute_frames(tree, q, rate, acceleration, ground, frames)
        if not qr_factor(moves[drives].T.copy(), every, q_drive, r_drive):
            return row
        for i in range(k):
            qr_solve(q_drive, r_drive, k, unit, i, inverse, i)
        share = out.joint_projection[row]
        for i in range(k):
            for j in range(v):
                total = 0.0
                for m in range(k):
                    total += inverse[i, m] * moves[j, m]
                share[i, j] = total
        for body in range(1, b):
            compute_unit_wrenches(frames, body, forces, torques)
            _remove_moment(frames, body, get_vector(moment_free, body), torques)
            _project_wrench(tree, frames, body, forces, torques, share, out.body_projection[row])
        for m in range(len(tree.closure_bodies)):
            out.closure_rate[row, m] = _project_closure_friction(tree, frames, m, share, out.closure_projection[row])
    return -1


@compile_without_allocation
def _remove_moment(frames, body, axis, torques):
    """Remove the component along a unit axis of a body's frame from torques (3, 10) in the world frame.

    A zero axis has no effect.
    """
    way = rotate_vector(get_rotation(frames.rotation, body), axis)
    for m in range(10):
        along = way[0] * torques[0, m] + way[1] * torques[1, m] + way[2] * torques[2, m]
        for k in range(3):
            torques[k, m] -= along * way[k]


@compile_without_allocation
def _project_wrench(tree, frames, body, forces, torques, joint_projection, out):
    """Project the wrench of a body on the drives by virtual work, through the joints that move it.

    Args:
        tree: Tree.
        frames: Frames.
        body: index of the body.
        forces: (3, 10) force per unit of each inertial parameter, see `compute_unit_wrenches`.
        torques: (3, 10) torque, likewise.
        joint_projection: (k, v) force of drive k per unit force or torque in joint v.
        out: (k, 10 b) written in the columns of this body: drive forces.
    """
    first, point = 10 * (body - 1), get_vector(frames.origin, body)
    for i in range(len(joint_projection)):
        for m in range(10):
            out[i, first + m] = 0.0
    for j in range(joint_projection.shape[1]):
        if not tree.is_moved[body, j]:
            continue
        way, turn = point_jacobian_column(tree, frames, j, point), get_vector(frames.axis, j)
        for m in range(10):
            effort = way[0] * forces[0, m] + way[1] * forces[1, m] + way[2] * forces[2, m]
            if not tree.is_slide[j]:
                effort += turn[0] * torques[0, m] + turn[1] * torques[1, m] + turn[2] * torques[2, m]
            for i in range(len(joint_projection)):
                out[i, first + m] += joint_projection[i, j] * effort


@compile_without_allocation
def _project_closure_friction(tree, frames, closure, joint_projection, out):
    """Project viscous rotational friction in a closure on the drives, per unit of its coefficient.

    `joint_projection` (k, v) is the force of drive k per unit force in joint v; column `closure` of `out` (k, c) is
    written.

    Returns:
        Relative rotation rate of the two bodies of the closure [rad/s].
    """
    one, two = tree.closure_bodies[closure, 0], tree.closure_bodies[closure, 1]
    spin = subtract_vectors(get_vector(frames.angular_velocity, one), get_vector(frames.angular_velocity, two))
    for i in range(len(joint_projection)):
        out[i, closure] = 0.0
    for j in range(joint_projection.shape[1]):
        if tree.is_slide[j] or tree.is_moved[one, j] == tree.is_moved[two, j]:
            continue
        along = dot(get_vector(frames.axis, j), spin)
        along = along if tree.is_moved[one, j] else -along
        for i in range(len(joint_projection)):
            out[i, closure] += joint_projection[i, j] * along
    return math.sqrt(dot(spin, spin))


# Inertial parameters of a body in its frame: mass, first moments, inertia about the origin.
BODY_PARAMETERS = {
    "mass": "kg", "moment_x": "kg m", "moment_y": "kg m", "moment_z": "kg m",
    "inertia_xx": "kg m^2", "inertia_xy": "kg m^2", "inertia_xz": "kg m^2",
    "inertia_yy": "kg m^2", "inertia_yz": "kg m^2", "inertia_zz": "kg m^2",
}  # fmt: skip
_VISCOUS_TERMS = ("viscous", "viscous_asymmetry")
_REGRESSOR_CONTEXT = "regressor"
# error of the mean of tanh(v / v_0): 1e-5 for a standard deviation of v_0, 0.01 for 3 v_0
_NODES, _WEIGHTS = hermegauss(21)


@dataclass(frozen=True)
class FrictionTerm:
    """Friction of one joint or closure, linear in its parameters.

    With `way = tanh(v/v_0)`, the friction is `(coulomb + stribeck exp(-(v/v_s)^2)) way + viscous v
    + quadratic v^2 way`, plus asymmetry terms in which `way` is replaced by `way^2` and `v` by
    `v way`. Near zero speed the friction may deviate from this law by
    `low_speed_i exp(-(v/w_i)^2) way + reversal_i exp(-(v/w_i)^2) sign(dv/dt)`: the first is a
    function of the speed, the second differs before and after a reversal, as with elastic contacts.

    Attributes:
        location: name of a joint, or of a closure whose bodies rotate relative to each other.
        nominal: parameter -> value; each parameter has one column. See `FRICTION_TERMS`.
        smoothing: v_0 [rad/s] or [m/s]; 0 uses the sign of v.
        stribeck: v_s [rad/s] or [m/s].
        low_speeds: w_1, w_2, ... [rad/s] or [m/s].
        rest_speed: speed below which the joint is at rest [rad/s] or [m/s]. Its dry friction is then any
            force within the Coulomb friction, and 0 here.
    """

    location: str
    nominal: Mapping[str, float] = field(default_factory=lambda: {"coulomb": 0.0, "viscous": 0.0})
    smoothing: float = 0.0
    stribeck: float = 0.02
    low_speeds: tuple[float, ...] = ()
    rest_speed: float = 0.0

    def unit_forces(self, velocity: np.ndarray, acceleration: np.ndarray | float = 0.0) -> dict[str, np.ndarray]:
        """Return the friction force per unit of each parameter of this term at given velocities.

        Args:
            velocity: velocities of any shape [rad/s] or [m/s].
            acceleration: accelerations at these velocities; 0 averages motion away from and towards zero speed.

        Returns:
            Parameter -> friction per unit of the parameter, in the shape of `velocity`.
        """
        return {kind: _unit_friction(self, kind, velocity, acceleration) for kind in self.nominal}


FRICTION_TERMS = (
    "coulomb", "stribeck", "coulomb_asymmetry", "stribeck_asymmetry", "viscous",
    "viscous_asymmetry", "quadratic",
)  # fmt: skip
DEVIATION_TERMS = ("low_speed", "reversal")  # deviations near zero speed, with a number: `low_speed_1`


def is_friction_deviation(name: str) -> bool:
    """Return whether a parameter name, such as `low_speed_1.knee`, is a friction deviation near zero speed."""
    return name.partition(".")[0].rpartition("_")[0] in DEVIATION_TERMS


@dataclass(frozen=True)
class Regressor:
    """Drive forces of every row as a matrix times the parameters.

    Attributes:
        matrix: (n, k, m) force [N] or torque [N m] of drive k per unit of parameter m.
        drives: names of the k driven joints.
        names: names of the m parameters, such as `mass.boom`, `inertia_yy.boom_rod`,
            `viscous.swing`.
        units: (m,) SI units of the parameters.
        nominal: (m,) values of the parameters in the chain and in the friction terms.
    """

    matrix: np.ndarray
    drives: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray


def make_regressor(
    chain: Chain, projection: Projection, drives: Sequence[str] | None = None,
    bodies: Sequence[str] | None = None, friction: Sequence[FrictionTerm] = (),
    offsets: Mapping[str, float] | bool = True, drive_inertia: Sequence[str] = (),
    rate_std: np.ndarray | None = None,
) -> Regressor:  # fmt: skip
    """Assemble the matrix that gives the drive forces as a linear function of the parameters.

    The parameters are inertial parameters of bodies, friction, drive inertia and force offsets.

    Args:
        chain: the chain.
        projection: projection of the chain on the drives for every row.
        drives: names of the drives of the projection; those of the chain by default.
        bodies: bodies whose ten inertial parameters have columns; all by default.
        friction: friction terms.
        offsets: whether every drive has a constant force, such as a transducer offset; or nominal
            offsets by drive [N] or [N m].
        drive_inertia: joints whose drive has its own inertia.
        rate_std: (n, v) standard deviation of the joint rates [rad/s] or [m/s]. The friction of a
            joint is then its expected value over the distribution of the rate. This avoids a bias
            where noise makes the sign of the rate uncertain. Friction in closures is not averaged.

    Returns:
        The regressor.

    Raises:
        InputError: a body, joint or closure does not exist, or a parameter is not known.

    Source: Newton-Euler about the body frames; Khoshzaban 1992, chapter 4; regression calibration:
    Carroll et al. 2006, Measurement error in nonlinear models, chapter 4.
    """
    drives = tuple(chain.drives if drives is None else drives)
    columns, names, units, nominal = [], [], [], []

    def add_column(column: np.ndarray | None, name: str, unit: str, value: float) -> None:
        if column is not None:
            columns.append(column[:, :, None])
        names.append(name)
        units.append(unit)
        nominal.append(value)

    for body in chain.bodies if bodies is None else bodies:
        b = _body_index(chain, body)
        columns.append(projection.body_projection[:, :, 10 * b : 10 * (b + 1)])
        for p, (kind, unit) in enumerate(BODY_PARAMETERS.items()):
            add_column(None, f"{kind}.{body}", unit, chain.inertia[b, p])
    for joint in drive_inertia:
        j = chain.index(joint)
        unit = "kg" if chain.tree.is_slide[j] else "kg m^2"
        column = projection.joint_projection[:, :, j] * projection.acceleration[:, None, j]
        add_column(column, f"drive_inertia.{joint}", unit, chain.armature[j])
    for one in friction:
        for kind, (column, unit) in _friction_columns(chain, projection, one, rate_std).items():
            add_column(column, f"{kind}.{one.location}", unit, one.nominal[kind])
    given = offsets if isinstance(offsets, Mapping) else {}
    for i, drive in enumerate(drives if offsets is not False else ()):
        column = np.zeros(projection.joint_projection.shape[:2])
        column[:, i] = 1.0
        unit = "N" if chain.tree.is_slide[chain.index(drive)] else "N m"
        add_column(column, f"offset.{drive}", unit, given.get(drive, 0.0))
    empty = np.zeros((*projection.joint_projection.shape[:2], 0))
    matrix = np.concatenate([empty, *columns], axis=2)
    return Regressor(matrix, drives, tuple(names), tuple(units), np.array(nominal))


def friction_sign_std(
    chain: Chain, projection: Projection, drives: Sequence[str], friction: Sequence[FrictionTerm],
    rate_std: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return how uncertain the sign of dry friction in the drives is, because their rates are noisy.

    Args:
        chain: the chain.
        projection: its projection.
        drives: names of the k drives.
        friction: friction terms; only those of the drives are used.
        rate_std: (n, v) as in `make_regressor`.

    Returns:
        (n, k) standard deviation of the sign (-1 .. 1) of dry friction, 0 .. 1; 1 below the `rest_speed`.
    """
    out, weights = np.zeros((len(projection.rate), len(drives))), _WEIGHTS / _WEIGHTS.sum()
    for one in friction:
        if one.location not in drives:
            continue
        j = chain.index(one.location)
        way = _unit_friction(one, "coulomb", projection.rate[:, j, None] + rate_std[:, j, None] * _NODES)
        mean = way @ weights
        spread = np.sqrt(np.maximum(way**2 @ weights - mean**2, 0.0))
        spread[np.abs(projection.rate[:, j]) < one.rest_speed] = 1.0
        out[:, list(drives).index(one.location)] = spread
    return out


def _friction_columns(chain: Chain, projection: Projection, term: FrictionTerm, rate_std: np.ndarray | None):
    """Return the regressor columns of a friction term: parameter -> (column (n, k), unit).

    A column holds the forces of the k drives per unit of the parameter. With `rate_std` it is the
    expected value over the uncertain rate.
    """
    strange = [kind for kind in term.nominal if kind not in FRICTION_TERMS and not is_friction_deviation(kind)]
    if strange:
        message = f"friction has no {strange[0]}; valid: {', '.join(FRICTION_TERMS)}"
        raise InputError(_REGRESSOR_CONTEXT, message)
    if term.location in chain.closures:
        return _closure_friction_columns(chain.closures.index(term.location), projection, term)
    j = chain.index(term.location)
    velocity, acceleration = projection.rate[:, j], projection.acceleration[:, j]
    share = projection.joint_projection[:, :, j]
    if rate_std is None:
        shapes = term.unit_forces(velocity, acceleration)
    else:
        maybe = velocity[:, None] + rate_std[:, j, None] * _NODES
        weights = _WEIGHTS / _WEIGHTS.sum()
        shapes = {kind: unit @ weights for kind, unit in term.unit_forces(maybe, acceleration[:, None]).items()}
    dry, wet = ("N", "N s/m") if chain.tree.is_slide[j] else ("N m", "N m s/rad")
    units: dict[str, str] = {kind: wet if kind in _VISCOUS_TERMS else dry for kind in term.nominal}
    units["quadratic"] = "N s^2/m^2" if chain.tree.is_slide[j] else "N m s^2/rad^2"
    return {kind: (share * shapes[kind][:, None], units[kind]) for kind in term.nominal}


def _unit_friction(
    term: FrictionTerm, kind: str, velocity: np.ndarray, acceleration: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return the friction per unit of one parameter of a term, such as `coulomb`, at velocities of any shape."""
    if kind == "viscous":
        return velocity
    way = np.tanh(velocity / term.smoothing) if term.smoothing else np.sign(velocity)
    if term.rest_speed:
        way = np.where(np.abs(velocity) < term.rest_speed, 0.0, way)
    if kind == "viscous_asymmetry":
        return velocity * way
    if kind == "quadratic":
        return velocity**2 * way
    if is_friction_deviation(kind):
        shape, _, number = kind.rpartition("_")
        near = np.exp(-((velocity / term.low_speeds[int(number) - 1]) ** 2))
        return near * (way if shape == "low_speed" else np.abs(np.sign(way)) * np.sign(acceleration))
    side = way**2 if kind.endswith("_asymmetry") else way
    if kind.startswith("stribeck"):
        return np.exp(-((velocity / term.stribeck) ** 2)) * side
    return side


def _closure_friction_columns(closure: int, projection: Projection, term: FrictionTerm):
    """Return the regressor columns of friction in a closure: parameter -> (column (n, k), unit).

    The friction opposes the relative rotation of the two bodies of the closure.
    """
    twist, share = projection.closure_rate[:, closure], projection.closure_projection[:, :, closure]
    floor = term.smoothing or np.finfo(float).tiny
    slow = np.exp(-((twist / term.stribeck) ** 2))
    way = np.tanh(twist / floor) / np.maximum(twist, np.finfo(float).tiny)
    shapes = {"coulomb": way, "stribeck": slow * way, "viscous": np.ones(len(twist))}
    for kind in term.nominal:
        if kind not in shapes:
            message = f"{term.location} is a closure, which has no sides for {kind}; valid: {', '.join(shapes)}"
            raise InputError(_REGRESSOR_CONTEXT, message)
    return {
        kind: (share * shapes[kind][:, None], "N m s/rad" if kind in _VISCOUS_TERMS else "N m") for kind in term.nominal
    }


def passive_friction_terms(chain: Chain) -> list[FrictionTerm]:
    """Create Coulomb friction terms for all hinges without drive and for all closures of a chain.

    Args:
        chain: the chain.

    Returns:
        One term per hinge without actuator and per closure; none for ball and free joints.

    Source: Khoshzaban 1992, 4.3: joint and pin friction of the complete model.
    """
    slides = chain.tree.is_slide
    hinges = [
        j for k, j in enumerate(chain.joints) if not slides[k] and chain.qpos_indices[k] >= 0 and j not in chain.drives
    ]
    return [FrictionTerm(place, {"coulomb": 0.0}) for place in (*hinges, *chain.closures)]
