"""Force regressor of a closed chain: drive forces, linear in inertial and friction parameters.

For any tree that `multibody.chain` reads; friction is that of joints and closures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.hermite_e import hermegauss

from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.inverse_dynamics import Projection

# Of one body, in its own frame: mass, mass times centre of mass, inertia about the frame's origin.
BODY_PARAMETERS = {
    "mass": "kg", "moment_x": "kg m", "moment_y": "kg m", "moment_z": "kg m",
    "inertia_xx": "kg m^2", "inertia_xy": "kg m^2", "inertia_xz": "kg m^2",
    "inertia_yy": "kg m^2", "inertia_yz": "kg m^2", "inertia_zz": "kg m^2",
}  # fmt: skip
_SLOPES = ("viscous", "viscous_asymmetry")
_WHERE = "regressor"
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
        if body not in chain.bodies:
            raise InputError(_WHERE, f"{chain.name} has no body {body}: {', '.join(chain.bodies)}")
        b = chain.bodies.index(body)
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
        raise InputError(_WHERE, f"friction has no {strange[0]}: {', '.join(FRICTION_TERMS)}")
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
            raise InputError(_WHERE, f"{one.place} is a closure, which has no sides for {kind}")
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
