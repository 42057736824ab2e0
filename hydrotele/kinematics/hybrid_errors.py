"""Error models of a hybrid robot: what its geometry may differ by from the nominal one.

`dh`: errors of the carriage's D-H rows and vector-chain errors of the hexapod. Each revolute joint
has four (theta, d, a, alpha), each prismatic joint two (theta, alpha); each leg has seven: the
coordinates of A_i and B_i and the offset of its length. Four joints P P R R and six legs make 54.

`poe`: product of exponentials. Each revolute axis may turn about and shift along two directions
across itself, each prismatic one may only turn; the legs as above. This makes 54, too, and they are
others: axes are lines in the measurement's frame, so that it need not be the carriage's frame 0.

Errors enter exactly, not by their first order; `first_order` is the document's linear form.

Source: Wang 2012, sections 3.1.2 (Eqs 12 to 29) and 3.2; Mooring et al. 1991 (4R + 2P + T).
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hydrotele.core.errors import InputError
from hydrotele.kinematics.hybrid import (
    LEGS,
    REVOLUTE,
    Hybrid,
    axis_frames,
    batch_readings,
    constants_of_axes,
    dh_transform,
    hybrid_of,
    inverse_transform,
    with_axes,
    zero_frames,
)

Kind = Literal["dh", "poe"]
LENGTH_SIZE, ANGLE_SIZE = 1.0e-3, 1.0e-3  # m, rad: errors of manufacture, which scale the searches
_DH = ("theta", "d", "a", "alpha")
_DH_WORDS = {
    "theta": "joint angle offset", "d": "joint distance", "a": "link length", "alpha": "link twist"
}  # fmt: skip
_POE = ("rx", "ry", "x", "y")
_POE_WORDS = {
    "rx": "tilt of the axis about its x", "ry": "tilt of the axis about its y",
    "x": "shift of the axis along its x", "y": "shift of the axis along its y",
}  # fmt: skip


class Parts(NamedTuple):
    """W geometries with errors: constants (W, n + 1, 4, 4), A and B (W, 6, 3), offsets (W, 6)."""

    constants: np.ndarray
    universal: np.ndarray
    spherical: np.ndarray
    offsets: np.ndarray


@dataclass(frozen=True)
class ErrorModel:
    """The parameters of an error model about a nominal robot.

    Attributes:
        kind: `dh` or `poe`.
        nominal: the robot without errors; for `poe` stated by its axes.
        names: p parameters, such as theta4, a4, a1x, b6z, l3 for `dh`.
        words: each in words.
        units: `m` or `rad` each.
        scales: (p,) size of an error of manufacture [units].
    """

    kind: Kind
    nominal: Hybrid
    names: tuple[str, ...]
    words: tuple[str, ...]
    units: tuple[str, ...]
    scales: np.ndarray

    def index(self, names) -> np.ndarray:
        """Places of parameters by their names.

        Raises:
            InputError: there is none of a name.
        """
        for name in names:
            if name not in self.names:
                raise InputError(f"parameter {name!r}", f"valid: {', '.join(self.names)}")
        return np.array([self.names.index(name) for name in names], int)

    @property
    def carriage_count(self) -> int:
        """Number of the carriage's parameters; the legs' 42 follow."""
        return len(self.names) - 7 * LEGS


def error_model(robot: Hybrid, kind: Kind) -> ErrorModel:
    """The error model of a kind about a robot.

    Args:
        robot: the nominal robot.
        kind: `dh` needs a robot that is stated by D-H rows.

    Raises:
        InputError: it is not, or there is no such kind.

    >>> from hydrotele.kinematics.hybrid import load_hybrid
    >>> [len(error_model(load_hybrid("iwr"), kind).names) for kind in ("dh", "poe")]
    [54, 54]
    """
    if kind not in ("dh", "poe"):
        raise InputError(f"error model {kind!r}", "valid: dh, poe")
    if kind == "dh" and not robot.facts.carriage:
        raise InputError(f"robot {robot.name}", "is stated by `axes`: use the error model poe")
    names, words, units = [], [], []
    for number, (joint, turning) in enumerate(
        zip(robot.joints, robot.kinds == REVOLUTE, strict=True), 1
    ):
        if kind == "dh":
            own = _DH if turning else ("theta", "alpha")
            names += [f"{part}{number}" for part in own]
            words += [f"link {number}: {_DH_WORDS[part]}" for part in own]
            units += ["m" if part in "da" else "rad" for part in own]
        else:
            own = _POE if turning else _POE[:2]
            names += [f"{joint}.{part}" for part in own]
            words += [f"joint {joint}: {_POE_WORDS[part]}" for part in own]
            units += ["m" if part in "xy" else "rad" for part in own]
    for letter, what in (("a", "universal joint"), ("b", "spherical joint")):
        names += [f"{letter}{leg}{c}" for leg in range(1, LEGS + 1) for c in "xyz"]
        words += [f"leg {leg}: {c} of its {what}" for leg in range(1, LEGS + 1) for c in "xyz"]
    names += [f"l{leg}" for leg in range(1, LEGS + 1)]
    words += [f"leg {leg}: offset of its length" for leg in range(1, LEGS + 1)]
    units += ["m"] * (7 * LEGS)
    scales = np.where(np.array(units) == "m", LENGTH_SIZE, ANGLE_SIZE)
    nominal = robot if kind == "dh" or robot.facts.axes else with_axes(robot)
    return ErrorModel(kind, nominal, tuple(names), tuple(words), tuple(units), scales)


def document_parameters(model: ErrorModel) -> tuple[str, ...]:
    """The 36 of Wang's refined model: the carriage's 12, B_i and the legs' offsets, but no A_i.

    The chapter that lists them is not in the published text we have. 54 less 18 is what is left
    without A_i, the captions of Figs 12 to 17 correlate carriage parameters with coordinates of A_i
    only, and that of Fig. 18 (36 parameters) names a4, theta4, b1x, b6z.
    """
    legs = model.names[model.carriage_count :]
    return model.names[: model.carriage_count] + tuple(n for n in legs if n[0] != "a")


def parts_of(model: ErrorModel, errors: np.ndarray) -> Parts:
    """Geometries with errors.

    Args:
        model: the error model.
        errors: (W, p) [model.units].

    Returns:
        What `batch_readings` takes.
    """
    errors = np.atleast_2d(errors)
    robot, count = model.nominal, model.carriage_count
    of_carriage = errors[:, :count]
    constants = _dh_constants if model.kind == "dh" else _poe_constants
    legs = errors[:, count:]
    points = legs[:, : 6 * LEGS].reshape(-1, 2, LEGS, 3)
    return Parts(
        np.ascontiguousarray(constants(robot, of_carriage)), robot.universal + points[:, 0],
        robot.spherical + points[:, 1], robot.offsets + legs[:, 6 * LEGS :],
    )  # fmt: skip


def predicted_readings(
    model: ErrorModel, errors: np.ndarray, joints: np.ndarray, rotation: np.ndarray,
    position: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Leg readings at measured poses with errors (Wang Eq. 29).

    Args:
        model: the error model.
        errors: (W, p) or (p,) [model.units].
        joints: (N, n) carriage [m] or [rad].
        rotation: (N, 3, 3) measured.
        position: (N, 3) measured [m].

    Returns:
        (W, N, 6) [m].
    """
    parts = parts_of(model, errors)
    return batch_readings(
        parts.constants, model.nominal.kinds, parts.universal, parts.spherical, parts.offsets,
        np.ascontiguousarray(joints), np.ascontiguousarray(rotation),
        np.ascontiguousarray(position),
    )  # fmt: skip


def corrected(model: ErrorModel, errors: np.ndarray) -> Hybrid:
    """The robot with errors built in: the calibrated robot, or a true one in simulation.

    Args:
        model: the error model.
        errors: (p,) [model.units].

    Returns:
        A robot of the same form, D-H rows for `dh`, axes for `poe`.
    """
    errors = np.asarray(errors, float)
    robot, parts = model.nominal, parts_of(model, errors)
    changes: dict = {
        "universal_joints": _points(parts.universal[0]),
        "spherical_joints": _points(parts.spherical[0]),
        "leg_offsets": tuple(parts.offsets[0].tolist()),
    }
    if model.kind == "dh":
        table = _dh_errors(robot, errors[None, : model.carriage_count])[0]
        changes["carriage"] = tuple(
            row.model_copy(update={part: getattr(row, part) + float(e)
                                   for part, e in zip(_DH, extra, strict=True)})
            for row, extra in zip(robot.facts.carriage, table, strict=True)
        )  # fmt: skip
    else:
        frames = _poe_frames(robot, errors[None, : model.carriage_count])[0]
        changes["axes"] = tuple(
            row.model_copy(update={"direction": tuple(frame[:3, 2].tolist()),
                                   "point": tuple(frame[:3, 3].tolist())})
            for row, frame in zip(robot.facts.axes, frames, strict=True)
        )  # fmt: skip
    return hybrid_of(robot.facts.model_copy(update=changes))


def first_order(robot: Hybrid, errors: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Carriage pose by the document's linear error model (Wang Eqs 12 to 26).

    dT = sum_i (0T_{i-1}) (d Ai) (iT4), with d Ai = A_i delta_i and delta_i = D_theta dtheta + D_d
    dd + D_a da + D_alpha dalpha (Eq. 18).

    Args:
        robot: stated by D-H rows.
        errors: (carriage parameters,) of the `dh` model.
        joints: (N, n) [m] or [rad].

    Returns:
        (N, 4, 4) nominal pose plus its first-order change.
    """
    table = _dh_errors(robot, np.asarray(errors, float)[None])[0]
    matrices = []
    for row, kind, value in zip(robot.facts.carriage, robot.kinds, joints.T, strict=True):
        turning = kind == REVOLUTE
        matrices.append(dh_transform(row.theta + turning * value, row.d + (not turning) * value,
                                     row.a, row.alpha))  # fmt: skip
    total = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    for matrix in matrices:
        total = total @ matrix
    change = np.zeros_like(total)
    before = np.broadcast_to(np.eye(4), total.shape)
    for row, matrix, (dtheta, dd, da, dalpha) in zip(
        robot.facts.carriage, matrices, table, strict=True
    ):
        c, s = np.cos(row.alpha), np.sin(row.alpha)
        d_theta = np.array([[0, -c, s, 0], [c, 0, 0, row.a * c], [-s, 0, 0, -row.a * s], [0] * 4])
        d_d = np.array([[0, 0, 0, 0], [0, 0, 0, s], [0, 0, 0, c], [0] * 4])
        d_a = np.array([[0, 0, 0, 1], [0] * 4, [0] * 4, [0] * 4])
        d_alpha = np.array([[0] * 4, [0, 0, -1, 0], [0, 1, 0, 0], [0] * 4])
        delta = dtheta * d_theta + dd * d_d + da * d_a + dalpha * d_alpha
        through = before @ matrix
        change = change + through @ delta @ inverse_transform(through) @ total
        before = through
    return total + change


def _points(points: np.ndarray) -> tuple:
    return tuple(map(tuple, points.tolist()))


def _dh_errors(robot: Hybrid, errors: np.ndarray) -> np.ndarray:
    """(W, n, 4) errors of theta, d, a, alpha of every row; those that are none are zero."""
    table, at = np.zeros((len(errors), len(robot.kinds), 4)), 0
    for i, kind in enumerate(robot.kinds):
        columns = [0, 1, 2, 3] if kind == REVOLUTE else [0, 3]
        table[:, i, columns] = errors[:, at : at + len(columns)]
        at += len(columns)
    return table


def _dh_constants(robot: Hybrid, errors: np.ndarray) -> np.ndarray:
    nominal = np.array([(r.theta, r.d, r.a, r.alpha) for r in robot.facts.carriage])
    rows = nominal + _dh_errors(robot, errors)
    links = dh_transform(*np.moveaxis(rows, -1, 0))
    base = np.broadcast_to(np.eye(4), (len(errors), 1, 4, 4))
    return np.concatenate([base, links], axis=1)


def _poe_frames(robot: Hybrid, errors: np.ndarray) -> np.ndarray:
    """(W, n, 4, 4) frames of the axes with errors, at zero."""
    nominal = axis_frames(robot.facts.axes)
    motion, at = np.zeros((len(errors), len(nominal), 4, 4)), 0
    motion[..., 3, 3] = 1.0
    for i, kind in enumerate(robot.kinds):
        turn = np.zeros((len(errors), 3))
        turn[:, :2] = errors[:, at : at + 2]
        motion[:, i, :3, :3] = Rotation.from_rotvec(turn).as_matrix()
        at += 2
        if kind == REVOLUTE:
            motion[:, i, :2, 3] = errors[:, at : at + 2]
            at += 2
    return nominal @ motion


def _poe_constants(robot: Hybrid, errors: np.ndarray) -> np.ndarray:
    at_zero = zero_frames(robot)[1]
    return constants_of_axes(_poe_frames(robot, errors), at_zero)
