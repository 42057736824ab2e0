"""Inverse dynamics of a closed chain: motion of all its joints, forces of its drives, regressor.

All rows of a log at once, compiled. Loops are closed by Newton's method from the row before; rates
and accelerations follow from the closures' Jacobian; forces of passive joints are carried to the
drives by virtual work.

Drive forces are linear in inertial and friction parameters, for any tree that `multibody.chain`
reads; friction is that of joints and closures.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.polynomial.hermite_e import hermegauss

from hydrotele.core.compiled import allocation_free, compiled
from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.closures import (
    CLOSED,
    check_determined,
    close_from,
    close_near,
    closure_acceleration,
    loop_space,
)
from hydrotele.multibody.tree_motion import (
    dot,
    move_tree,
    point_column,
    qr_factor,
    qr_solve,
    rotated,
    rotation,
    subtract,
    vector,
    wrenches,
)

_STRIDE = 0.1  # rad or m, to which the given joints move at once, lest a loop change its branch
_WHERE = "closures"


class Projection(NamedTuple):
    """n rows, v joints, b bodies, k drives.

    Attributes:
        position: (n, v) of all joints [rad] or [m].
        rate: (n, v) [rad/s] or [m/s].
        acceleration: (n, v) [rad/s^2] or [m/s^2].
        share: (n, k, v) force of drive k per unit of force or torque in joint v.
        bodies: (n, k, 10 b) force of drive k [N] or [N m] per unit of a body's inertial parameter.
        twist: (n, c) rate at which the two bodies of a closure turn against each other [rad/s].
        pins: (n, k, c) force of drive k per unit of viscous friction in a closure.
    """

    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    share: np.ndarray
    bodies: np.ndarray
    twist: np.ndarray
    pins: np.ndarray


def project(
    chain: Chain, given: tuple[str, ...], position: np.ndarray, rate: np.ndarray,
    acceleration: np.ndarray, drives: tuple[str, ...] | None = None,
    start: np.ndarray | None = None,
    moment_free: Mapping[str, tuple[float, float, float]] | None = None,
) -> Projection:  # fmt: skip
    """Project a chain on its drives.

    Args:
        chain: the chain.
        given: the k joints whose motion is known; the closures must determine the others.
        position: (n, k) [rad] or [m].
        rate: (n, k) [rad/s] or [m/s].
        acceleration: (n, k) [rad/s^2] or [m/s^2].
        drives: k joints whose forces are asked for; the chain's own by default.
        start: (v,) positions from which to go to the first row; the chain's by default.
        moment_free: body -> unit axis through the origin of its frame, in that frame, about which
            it takes no moment from its neighbours. Its motion is that of the chain all the same.

    Returns:
        The projection. `bodies @ inertia.ravel()`, plus what friction asks for, are the drives'
        forces.

    Raises:
        InputError: shapes do not fit, a value is missing, a body is not there, the closures do not
            determine the other joints, or a row cannot be reached.

    Source: Newton-Euler about the body frames, D'Alembert; Abdellatif 2008, section 2; bodies
    without moment about an axis: Khoshzaban 1992, p. 92, Eq. 4.23.
    """
    drives = chain.drives if drives is None else drives
    columns = np.array([chain.index(name) for name in given], np.int64)
    moved = np.array([chain.index(name) for name in drives], np.int64)
    tables = [_table(values, len(given)) for values in (position, rate, acceleration)]
    if len({len(table) for table in tables}) > 1:
        raise InputError(_WHERE, "positions, rates and accelerations must have the same rows")
    if len(moved) != len(columns):
        raise InputError(
            _WHERE,
            f"{len(columns)} joints are given but {len(moved)} have a drive; forces follow only"
            " where there are as many",
        )
    n, v, k = len(tables[0]), len(chain.joints), len(columns)
    axes = np.zeros((len(chain.bodies) + 1, 3))
    for body, axis in (moment_free or {}).items():
        axes[_body_place(chain, body) + 1] = axis
    others = np.setdiff1d(np.arange(v), columns)
    q = np.array(chain.start if start is None else start, float)
    if not close_from(chain.tree, q, np.arange(v), CLOSED, np.inf) < CLOSED:
        raise InputError(
            _WHERE, f"the loops of {chain.name} cannot be closed from where they start"
        )
    check_determined(chain, q, columns)
    out = Projection(
        np.empty((n, v)), np.empty((n, v)), np.empty((n, v)), np.empty((n, k, v)),
        np.empty((n, k, 10 * len(chain.bodies))), np.empty((n, len(chain.tree.ends))),
        np.empty((n, k, len(chain.tree.ends))),
    )  # fmt: skip
    given_rows = _Given(columns, *tables)
    failed = _project(chain.tree, given_rows, others, moved, axes, q, out)
    if failed >= 0:
        raise InputError(
            _WHERE,
            f"row {failed}: the loops of {chain.name} cannot be closed there, or the pose is"
            f" singular for the drives {', '.join(drives)}",
        )
    return out


def _body_place(chain: Chain, body: str) -> int:
    if body not in chain.bodies:
        raise InputError(_WHERE, f"{chain.name} has no body {body}: {', '.join(chain.bodies)}")
    return chain.bodies.index(body)


def _table(values: np.ndarray, width: int) -> np.ndarray:
    table = np.ascontiguousarray(values, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != width:
        raise InputError(
            _WHERE, f"motion must be (n, {width}), one column per joint: {table.shape}"
        )
    if not np.isfinite(table).all():
        row = int(np.argwhere(~np.isfinite(table))[0, 0])
        raise InputError(_WHERE, f"row {row} has no motion: smooth the log over its gaps first")
    return table


class _Given(NamedTuple):
    """Places (k,) of the given joints, and their motion, (n, k) each."""

    joints: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray


@compiled
def _project(tree, given, others, drives, moment_free, q, out):
    """Fill a `Projection` row by row; the row that failed, or -1."""
    b, v, k = len(tree.parent), len(tree.zero), len(given.joints)
    hidden, space = len(others), loop_space(tree, len(others), k)
    frames, part, ground = space.frames, space.part, -tree.gravity
    moves = np.zeros((v, k))  # of all joints per unit of the given ones
    q_drive, r_drive, unit = np.empty((k, k)), np.empty((k, k)), np.eye(k)
    inverse, every = np.empty((k, k)), np.arange(k)
    forces, torques = np.empty((3, 10)), np.empty((3, 10))
    for i in range(k):
        moves[given.joints[i], i] = 1.0
    for row in range(len(given.position)):
        far = 0.0
        for i in range(k):
            far = max(far, abs(given.position[row, i] - q[given.joints[i]]))
        steps = max(1, int(math.ceil(far / _STRIDE))) if len(space.error) > 0 else 1
        for step in range(steps, 0, -1):
            for i in range(k):
                at = given.joints[i]
                q[at] += (given.position[row, i] - q[at]) / step
            if not close_near(tree, q, others, space):
                return row
        for i in range(k if hidden else 0):
            qr_solve(space.q_factor, space.r_factor, hidden, space.slope, given.joints[i], part, i)
            for o in range(hidden):
                moves[others[o], i] = -part[o, i]
        rate, acceleration = out.rate[row], out.acceleration[row]
        for j in range(v):
            rate[j] = acceleration[j] = 0.0
            for i in range(k):
                rate[j] += moves[j, i] * given.rate[row, i]
        if hidden:
            move_tree(tree, q, rate, space.still, space.none, frames)
            closure_acceleration(tree, frames, space.error)
            qr_solve(space.q_factor, space.r_factor, hidden, space.error, 0, part, 0)
            for o in range(hidden):
                acceleration[others[o]] = -part[o, 0]
        for j in range(v):
            out.position[row, j] = q[j]
            for i in range(k):
                acceleration[j] += moves[j, i] * given.acceleration[row, i]
        move_tree(tree, q, rate, acceleration, ground, frames)
        if not qr_factor(moves[drives].T.copy(), every, q_drive, r_drive):
            return row
        for i in range(k):
            qr_solve(q_drive, r_drive, k, unit, i, inverse, i)
        share = out.share[row]
        for i in range(k):
            for j in range(v):
                total = 0.0
                for m in range(k):
                    total += inverse[i, m] * moves[j, m]
                share[i, j] = total
        for body in range(1, b):
            wrenches(frames, body, forces, torques)
            _drop_moment(frames, body, vector(moment_free, body), torques)
            _load(tree, frames, body, forces, torques, share, out.bodies[row])
        for m in range(len(tree.ends)):
            out.twist[row, m] = _rub(tree, frames, m, share, out.pins[row])
    return -1


@allocation_free
def _drop_moment(frames, body, axis, torques):
    """Take the part about a body's unit axis from torques (3, 10); a zero axis changes nothing."""
    way = rotated(rotation(frames.turn, body), axis)
    for m in range(10):
        along = way[0] * torques[0, m] + way[1] * torques[1, m] + way[2] * torques[2, m]
        for k in range(3):
            torques[k, m] -= along * way[k]


@allocation_free
def _load(tree, frames, body, forces, torques, share, out):
    """Carry a body's wrench through the joints that move it to the drives."""
    first, point = 10 * (body - 1), vector(frames.place, body)
    for i in range(len(share)):
        for m in range(10):
            out[i, first + m] = 0.0
    for j in range(share.shape[1]):
        if not tree.above[body, j]:
            continue
        way, turn = point_column(tree, frames, j, point), vector(frames.axis, j)
        for m in range(10):
            effort = way[0] * forces[0, m] + way[1] * forces[1, m] + way[2] * forces[2, m]
            if not tree.slides[j]:
                effort += (
                    turn[0] * torques[0, m] + turn[1] * torques[1, m] + turn[2] * torques[2, m]
                )
            for i in range(len(share)):
                out[i, first + m] += share[i, j] * effort


@allocation_free
def _rub(tree, frames, closure, share, out):
    """Carry viscous friction in a closure to the drives; return the rate of its turning."""
    one, two = tree.ends[closure, 0], tree.ends[closure, 1]
    spin = subtract(vector(frames.spin, one), vector(frames.spin, two))
    for i in range(len(share)):
        out[i, closure] = 0.0
    for j in range(share.shape[1]):
        if tree.slides[j] or tree.above[one, j] == tree.above[two, j]:
            continue
        along = dot(vector(frames.axis, j), spin)
        along = along if tree.above[one, j] else -along
        for i in range(len(share)):
            out[i, closure] += share[i, j] * along
    return math.sqrt(dot(spin, spin))


# Of one body, in its own frame: mass, mass times centre of mass, inertia about the frame's origin.
BODY_PARAMETERS = {
    "mass": "kg", "moment_x": "kg m", "moment_y": "kg m", "moment_z": "kg m",
    "inertia_xx": "kg m^2", "inertia_xy": "kg m^2", "inertia_xz": "kg m^2",
    "inertia_yy": "kg m^2", "inertia_yz": "kg m^2", "inertia_zz": "kg m^2",
}  # fmt: skip
_SLOPES = ("viscous", "viscous_asymmetry")
_REGRESSOR = "regressor"
_NODES, _WEIGHTS = hermegauss(21)  # a sign that is blurred tenfold is then averaged to 1e-3


@dataclass(frozen=True)
class FrictionTerm:
    """Friction at one place, linear in its parameters.

    `(coulomb + stribeck exp(-(v/v_s)^2)) way + viscous v`, plus a part of each in which `way` or
    `v` is replaced by `way^2` or `v way` (asymmetry), plus `quadratic v^2 way`, with
    `way = tanh(v/v_0)`.

    Attributes:
        place: a joint, or a closure, whose bodies turn against each other.
        nominal: parameter -> its value; the columns that there are. See `FRICTION_TERMS`.
        smoothing: v_0 [rad/s] or [m/s]; 0 is the sign of v.
        stribeck: v_s [rad/s] or [m/s].
    """

    place: str
    nominal: Mapping[str, float] = field(default_factory=lambda: {"coulomb": 0.0, "viscous": 0.0})
    smoothing: float = 0.0
    stribeck: float = 0.02


FRICTION_TERMS = (
    "coulomb", "stribeck", "coulomb_asymmetry", "stribeck_asymmetry", "viscous",
    "viscous_asymmetry", "quadratic",
)  # fmt: skip


@dataclass(frozen=True)
class Regressor:
    """Forces of all drives at every row as matrix times parameters.

    Attributes:
        matrix: (n, k, m) force [N] or torque [N m] of drive k per unit of parameter m.
        drives: the k joints whose forces these are.
        names: the m parameters, such as `mass.boom`, `inertia_yy.boom_rod`, `viscous.swing`.
        units: (m,) their SI units.
        nominal: (m,) their values in the chain and in the friction that was asked for.
    """

    matrix: np.ndarray
    drives: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray


def regressor(
    chain: Chain, found: Projection, drives: Sequence[str] | None = None,
    bodies: Sequence[str] | None = None, rubbing: Sequence[FrictionTerm] = (),
    offsets: Mapping[str, float] | bool = True, drive_inertia: Sequence[str] = (),
    rate_std: np.ndarray | None = None,
) -> Regressor:  # fmt: skip
    """Columns of inertial parameters, friction, drive inertia and offsets.

    Args:
        chain: the chain.
        found: its projection on the drives for every row.
        drives: names of the drives that it was projected on; the chain's own by default.
        bodies: bodies whose ten inertial parameters get columns; all by default.
        rubbing: friction, place by place.
        offsets: whether every drive gets a constant force, such as that of a transducer's offset;
            or the given ones, drive by drive [N] or [N m].
        drive_inertia: joints whose drive has an inertia of its own.
        rate_std: (n, v) standard deviation of the joints' rates [rad/s] or [m/s]. Friction of a
            joint is then its mean over what the rate may be, lest it be underrated wherever noise
            hides on which side of zero the rate is. Pins of closures are taken as they are.

    Returns:
        The regressor.

    Raises:
        InputError: a body, joint or closure is not there, or a parameter is not known.

    Source: Newton-Euler about the body frames; Khoshzaban 1992, chapter 4; regression calibration:
    Carroll et al. 2006, Measurement error in nonlinear models, chapter 4.
    """
    drives = tuple(chain.drives if drives is None else drives)
    columns, names, units, nominal = [], [], [], []

    def add(column: np.ndarray | None, name: str, unit: str, value: float) -> None:
        if column is not None:
            columns.append(column[:, :, None])
        names.append(name)
        units.append(unit)
        nominal.append(value)

    for body in chain.bodies if bodies is None else bodies:
        b = _body_place(chain, body)
        columns.append(found.bodies[:, :, 10 * b : 10 * (b + 1)])
        for p, (kind, unit) in enumerate(BODY_PARAMETERS.items()):
            add(None, f"{kind}.{body}", unit, chain.inertia[b, p])
    for joint in drive_inertia:
        j = chain.index(joint)
        unit = "kg" if chain.tree.slides[j] else "kg m^2"
        column = found.share[:, :, j] * found.acceleration[:, None, j]
        add(column, f"drive_inertia.{joint}", unit, chain.armature[j])
    for one in rubbing:
        for kind, (column, unit) in _friction_terms(chain, found, one, rate_std).items():
            add(column, f"{kind}.{one.place}", unit, one.nominal[kind])
    given = offsets if isinstance(offsets, Mapping) else {}
    for i, drive in enumerate(drives if offsets is not False else ()):
        column = np.zeros(found.share.shape[:2])
        column[:, i] = 1.0
        unit = "N" if chain.tree.slides[chain.index(drive)] else "N m"
        add(column, f"offset.{drive}", unit, given.get(drive, 0.0))
    empty = np.zeros((*found.share.shape[:2], 0))
    matrix = np.concatenate([empty, *columns], axis=2)
    return Regressor(matrix, drives, tuple(names), tuple(units), np.array(nominal))


def sign_uncertainty(
    chain: Chain, found: Projection, drives: Sequence[str], rubbing: Sequence[FrictionTerm],
    rate_std: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """How uncertain it is on which side of zero the rates of the drives are.

    Args:
        chain: the chain.
        found: its projection.
        drives: names of the k drives.
        rubbing: friction, place by place; that of the drives counts.
        rate_std: (n, v) as of `regressor`.

    Returns:
        (n, k) standard deviation of the sign that dry friction has, 0 .. 1.
    """
    out, weights = np.zeros((len(found.rate), len(drives))), _WEIGHTS / _WEIGHTS.sum()
    for one in rubbing:
        if one.place not in drives:
            continue
        j = chain.index(one.place)
        way = _shape(one, "coulomb", found.rate[:, j, None] + rate_std[:, j, None] * _NODES)
        mean = way @ weights
        spread = np.sqrt(np.maximum(way**2 @ weights - mean**2, 0.0))
        out[:, list(drives).index(one.place)] = spread
    return out


def _friction_terms(
    chain: Chain, found: Projection, one: FrictionTerm, rate_std: np.ndarray | None
):
    """Parameter -> (column (n, k), unit)."""
    strange = [kind for kind in one.nominal if kind not in FRICTION_TERMS]
    if strange:
        raise InputError(_REGRESSOR, f"friction has no {strange[0]}: {', '.join(FRICTION_TERMS)}")
    if one.place in chain.closures:
        return _pin(chain.closures.index(one.place), found, one)
    j = chain.index(one.place)
    velocity, share = found.rate[:, j], found.share[:, :, j]
    if rate_std is None:
        shapes = {kind: _shape(one, kind, velocity) for kind in one.nominal}
    else:
        maybe = velocity[:, None] + rate_std[:, j, None] * _NODES
        weights = _WEIGHTS / _WEIGHTS.sum()
        shapes = {kind: _shape(one, kind, maybe) @ weights for kind in one.nominal}
    dry, wet = ("N", "N s/m") if chain.tree.slides[j] else ("N m", "N m s/rad")
    units: dict[str, str] = {kind: wet if kind in _SLOPES else dry for kind in FRICTION_TERMS}
    units["quadratic"] = "N s^2/m^2" if chain.tree.slides[j] else "N m s^2/rad^2"
    return {kind: (share * shapes[kind][:, None], units[kind]) for kind in one.nominal}


def _shape(one: FrictionTerm, kind: str, velocity: np.ndarray) -> np.ndarray:
    """Friction per unit of a parameter at velocities of any shape."""
    if kind == "viscous":
        return velocity
    way = np.tanh(velocity / one.smoothing) if one.smoothing else np.sign(velocity)
    if kind == "viscous_asymmetry":
        return velocity * way
    if kind == "quadratic":
        return velocity**2 * way
    side = way**2 if kind.endswith("_asymmetry") else way
    if kind.startswith("stribeck"):
        return np.exp(-((velocity / one.stribeck) ** 2)) * side
    return side


def _pin(closure: int, found: Projection, one: FrictionTerm):
    """Friction between the bodies of a closure, against the axis about which they turn."""
    twist, share = found.twist[:, closure], found.pins[:, :, closure]
    floor = one.smoothing or np.finfo(float).tiny
    slow = np.exp(-((twist / one.stribeck) ** 2))
    way = np.tanh(twist / floor) / np.maximum(twist, np.finfo(float).tiny)
    shapes = {"coulomb": way, "stribeck": slow * way, "viscous": np.ones(len(twist))}
    for kind in one.nominal:
        if kind not in shapes:
            raise InputError(_REGRESSOR, f"{one.place} is a closure, which has no sides for {kind}")
    return {
        kind: (share * shapes[kind][:, None], "N m s/rad" if kind in _SLOPES else "N m")
        for kind in one.nominal
    }


def pin_friction(chain: Chain) -> list[FrictionTerm]:
    """Coulomb friction of all passive hinges and closures.

    Args:
        chain: the chain.

    Returns:
        One per hinge that no actuator moves, and per closure; none for ball and free joints.

    Source: Khoshzaban 1992, 4.3: joint and pin friction of the complete model.
    """
    slides = chain.tree.slides
    hinges = [
        j
        for k, j in enumerate(chain.joints)
        if not slides[k] and chain.places[k] >= 0 and j not in chain.drives
    ]
    return [FrictionTerm(place, {"coulomb": 0.0}) for place in (*hinges, *chain.closures)]
