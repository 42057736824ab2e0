"""Drive forces of a closed chain as a linear function of its parameters.

The parameters are those of inertia and of friction in joints and closures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.hermite_e import hermegauss

from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.inverse_dynamics import Projection, find_body_index

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

    With the velocity v and `way = tanh(v/v_0)`, the friction is `(coulomb + stribeck
    exp(-(v/v_s)^2)) way + viscous v + quadratic v^2 way`. Asymmetry terms are added, in which `way`
    is replaced by `way^2` and `v` by `v way`. Near zero speed the friction may deviate from this
    law by `low_speed_i exp(-(v/w_i)^2) way + reversal_i exp(-(v/w_i)^2) sign(dv/dt)`. The first
    deviation is a function of the speed. The second differs before and after a reversal of the
    motion, as with elastic contacts.

    Attributes:
        location: name of a joint, or of a closure whose bodies rotate relative to each other.
        nominal: parameter -> nominal value; each parameter has one column of the regressor. Valid
            names are in `FRICTION_TERMS`, and `low_speed_1`, `reversal_1` and so on.
        smoothing: v_0 [rad/s] or [m/s]; 0 uses the sign of v.
        stribeck: v_s [rad/s] or [m/s].
        low_speeds: w_1, w_2, ... [rad/s] or [m/s].
        rest_speed: speed below which the joint is at rest [rad/s] or [m/s]. Its dry friction is
            then any force within the Coulomb friction, and 0 here.
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
            acceleration: accelerations at these velocities; their sign matters for the `reversal`
                parameters only. With 0, the friction of these parameters is 0.

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
    """Return whether a name is that of a friction deviation near zero speed, such as `low_speed_1.knee`."""
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
        offsets: whether every drive has a parameter for a constant force, such as a transducer
            offset. A mapping drive -> nominal offset [N] or [N m] also adds these parameters, 0 for
            other drives.
        drive_inertia: joints whose drive has a parameter for its own inertia.
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
        b = find_body_index(chain, body)
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
    """Return the standard deviation of the sign of dry friction in the drives, caused by noise of their rates.

    Args:
        chain: the chain.
        projection: its projection.
        drives: names of the k drives.
        friction: friction terms; only those of the drives are used.
        rate_std: (n, v) as in `make_regressor`.

    Returns:
        (n, k) standard deviation of the sign (-1 .. 1) of dry friction, 0 .. 1. It is 1 at rates
            below the term's `rest_speed`, and 0 for drives without a friction term.
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
