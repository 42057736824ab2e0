"""Error models of serial-parallel robots, with 54 parameters for joints P P R R and six legs.

The parameters are D-H rows (`dh`) or products of exponentials (`poe`): Wang 2012, sections 3.1.2
(Eqs 12 to 29) and 3.2; Park and Okamura 1994; Mooring et al. 1991.

`dh`: errors of the carriage's D-H rows and vector-chain errors of the hexapod. Each revolute joint
has four (theta, d, a, alpha), each prismatic joint two (theta, alpha); each leg has seven: the
coordinates of A_i and B_i and the offset of its length. Four joints P P R R and six legs have 54.

`poe`: product of exponentials. Each revolute axis has a rotation and a displacement error in two
directions perpendicular to it, each prismatic axis rotation errors only; the legs are as above.
These are also 54 parameters, but different ones: axes are lines in the frame of the measurement,
which may differ from the carriage's frame 0.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hydrotele.core.errors import InputError
from hydrotele.kinematics.hybrid_robot import (
    LEG_COUNT,
    REVOLUTE,
    HybridRobot,
    axis_frames,
    batch_readings,
    build_hybrid,
    carriage_constants_from_axes,
    convert_to_axes,
    dh_transform,
    frames_at_zero_joints,
    inverse_transform,
)

ErrorModelKind = Literal["dh", "poe"]
LENGTH_ERROR_SCALE, ANGLE_ERROR_SCALE = (
    1.0e-3,
    1.0e-3,
)  # m, rad: typical manufacturing errors, search scales
_DH_PARTS = ("theta", "d", "a", "alpha")
_DH_DESCRIPTIONS = {
    "theta": "joint angle offset", "d": "joint distance", "a": "link length", "alpha": "link twist"
}  # fmt: skip
_POE_PARTS = ("rx", "ry", "x", "y")
_POE_DESCRIPTIONS = {
    "rx": "tilt of the axis about its x", "ry": "tilt of the axis about its y",
    "x": "shift of the axis along its x", "y": "shift of the axis along its y",
}  # fmt: skip


class GeometryBatch(NamedTuple):
    """Geometries of W hybrid robots with different errors, in the arrays that `batch_readings` needs.

    Attributes:
        constants: (W, n + 1, 4, 4) constant transforms C_0 to C_n of the carriage.
        universal: (W, 6, 3) universal joints A_i in the connecting platform's frame [m].
        spherical: (W, 6, 3) spherical joints B_i in the moving platform's frame [m].
        offsets: (W, 6) leg lengths minus leg readings [m].
    """

    constants: np.ndarray
    universal: np.ndarray
    spherical: np.ndarray
    offsets: np.ndarray


@dataclass(frozen=True)
class ErrorModel:
    """Error model: which geometric errors of a nominal robot are parameters, with units and scales.

    Attributes:
        kind: `dh` or `poe`.
        nominal: the robot without errors; for `poe` given by its axes.
        names: the p parameters, such as theta4, a4, a1x, b6z, l3 for `dh`.
        descriptions: description of each parameter.
        units: `m` or `rad` for each parameter.
        scales: (p,) typical manufacturing errors [units].
    """

    kind: ErrorModelKind
    nominal: HybridRobot
    names: tuple[str, ...]
    descriptions: tuple[str, ...]
    units: tuple[str, ...]
    scales: np.ndarray

    def parameter_indices(self, names) -> np.ndarray:
        """Return the indices of parameters by their names.

        Raises:
            InputError: a name is unknown.
        """
        for name in names:
            if name not in self.names:
                raise InputError(f"parameter {name!r}", f"valid: {', '.join(self.names)}")
        return np.array([self.names.index(name) for name in names], int)

    @property
    def carriage_parameter_count(self) -> int:
        """Number of carriage parameters; the 42 parameters of the legs follow."""
        return len(self.names) - 7 * LEG_COUNT


def build_error_model(robot: HybridRobot, kind: ErrorModelKind) -> ErrorModel:
    """Build the error model of a hybrid robot, which lists the geometric errors that a calibration estimates.

    Args:
        robot: the nominal robot.
        kind: `dh` for errors of D-H rows, which the robot must have, or `poe` for errors of axis
            lines; both with errors of the legs.

    Returns:
        The model: names, descriptions, units and scales of the parameters, carriage first, then
        legs.

    Raises:
        InputError: the kind is unknown, or the robot has no D-H rows.

    >>> from hydrotele.kinematics.hybrid_robot import load_hybrid
    >>> [len(build_error_model(load_hybrid("iwr"), kind).names) for kind in ("dh", "poe")]
    [54, 54]
    """
    if kind not in ("dh", "poe"):
        raise InputError(f"error model {kind!r}", "valid: dh, poe")
    if kind == "dh" and not robot.specification.carriage:
        raise InputError(f"robot {robot.name}", "is given by `axes`: use the error model poe")
    names, words, units = [], [], []
    for number, (joint, turning) in enumerate(zip(robot.joints, robot.kinds == REVOLUTE, strict=True), 1):
        if kind == "dh":
            own = _DH_PARTS if turning else ("theta", "alpha")
            names += [f"{part}{number}" for part in own]
            words += [f"link {number}: {_DH_DESCRIPTIONS[part]}" for part in own]
            units += ["m" if part in "da" else "rad" for part in own]
        else:
            own = _POE_PARTS if turning else _POE_PARTS[:2]
            names += [f"{joint}.{part}" for part in own]
            words += [f"joint {joint}: {_POE_DESCRIPTIONS[part]}" for part in own]
            units += ["m" if part in "xy" else "rad" for part in own]
    for letter, what in (("a", "universal joint"), ("b", "spherical joint")):
        names += [f"{letter}{leg}{c}" for leg in range(1, LEG_COUNT + 1) for c in "xyz"]
        words += [f"leg {leg}: {c} of its {what}" for leg in range(1, LEG_COUNT + 1) for c in "xyz"]
    names += [f"l{leg}" for leg in range(1, LEG_COUNT + 1)]
    words += [f"leg {leg}: offset of its length" for leg in range(1, LEG_COUNT + 1)]
    units += ["m"] * (7 * LEG_COUNT)
    scales = np.where(np.array(units) == "m", LENGTH_ERROR_SCALE, ANGLE_ERROR_SCALE)
    nominal = robot if kind == "dh" or robot.specification.axes else convert_to_axes(robot)
    return ErrorModel(kind, nominal, tuple(names), tuple(words), tuple(units), scales)


def refined_model_parameters(model: ErrorModel) -> tuple[str, ...]:
    """Return the names of the 36 parameters of the refined error model of Wang 2012.

    They are all parameters except the 18 coordinates of the universal joints A_i: those of the
    carriage, of the spherical joints B_i and the leg offsets. The available text of Wang 2012 gives
    only their number and some of their names; this choice is inferred from figure captions.
    """
    legs = model.names[model.carriage_parameter_count :]
    return model.names[: model.carriage_parameter_count] + tuple(n for n in legs if n[0] != "a")


def add_errors_to_geometry(model: ErrorModel, errors: np.ndarray) -> GeometryBatch:
    """Add sets of errors to a robot's nominal geometry: carriage, leg joints and leg offsets.

    Args:
        model: the error model.
        errors: (W, p) errors [model.units].

    Returns:
        W geometries: transforms of the carriage, positions of A_i and B_i, and leg offsets.
    """
    errors = np.atleast_2d(errors)
    robot, count = model.nominal, model.carriage_parameter_count
    of_carriage = errors[:, :count]
    constants = _dh_constants if model.kind == "dh" else _poe_constants
    legs = errors[:, count:]
    points = legs[:, : 6 * LEG_COUNT].reshape(-1, 2, LEG_COUNT, 3)
    return GeometryBatch(
        np.ascontiguousarray(constants(robot, of_carriage)), robot.universal + points[:, 0],
        robot.spherical + points[:, 1], robot.offsets + legs[:, 6 * LEG_COUNT :],
    )  # fmt: skip


def predict_leg_readings(
    model: ErrorModel, errors: np.ndarray, joints: np.ndarray, rotation: np.ndarray,
    position: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Predict the leg readings at measured poses for sets of geometric errors (Wang 2012, Eq. 29).

    Args:
        model: the error model.
        errors: (W, p) or (p,) errors [model.units].
        joints: (N, n) carriage positions [m] or [rad].
        rotation: (N, 3, 3) measured rotations.
        position: (N, 3) measured positions [m].

    Returns:
        (W, N, 6) readings [m].
    """
    parts = add_errors_to_geometry(model, errors)
    return batch_readings(
        parts.constants, model.nominal.kinds, parts.universal, parts.spherical, parts.offsets,
        np.ascontiguousarray(joints), np.ascontiguousarray(rotation),
        np.ascontiguousarray(position),
    )  # fmt: skip


def apply_geometry_errors(model: ErrorModel, errors: np.ndarray) -> HybridRobot:
    """Return a robot with given errors: a calibrated robot, or the true robot of a simulation.

    Args:
        model: the error model.
        errors: (p,) errors [model.units].

    Returns:
        A robot of the same form, D-H rows for `dh`, axes for `poe`.
    """
    errors = np.asarray(errors, float)
    robot, parts = model.nominal, add_errors_to_geometry(model, errors)
    changes: dict = {
        "universal_joints": _to_point_tuples(parts.universal[0]),
        "spherical_joints": _to_point_tuples(parts.spherical[0]),
        "leg_offsets": tuple(parts.offsets[0].tolist()),
    }
    if model.kind == "dh":
        table = _dh_error_table(robot, errors[None, : model.carriage_parameter_count])[0]
        changes["carriage"] = tuple(
            row.model_copy(update={part: getattr(row, part) + float(e)
                                   for part, e in zip(_DH_PARTS, extra, strict=True)})
            for row, extra in zip(robot.specification.carriage, table, strict=True)
        )  # fmt: skip
    else:
        frames = _poe_frames(robot, errors[None, : model.carriage_parameter_count])[0]
        changes["axes"] = tuple(
            row.model_copy(update={"direction": tuple(frame[:3, 2].tolist()),
                                   "point": tuple(frame[:3, 3].tolist())})
            for row, frame in zip(robot.specification.axes, frames, strict=True)
        )  # fmt: skip
    return build_hybrid(robot.specification.model_copy(update=changes))


def first_order_carriage_pose(robot: HybridRobot, errors: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Compute the carriage pose with errors by the publication's linear model (Wang 2012, Eqs 12 to 26).

    The change of the pose is the sum over all joints. Each summand is the product of all joint
    transforms, in which that of one joint is replaced by its first-order change due to its errors.

    Args:
        robot: robot given by D-H rows.
        errors: (carriage parameters,) errors of the `dh` model.
        joints: (N, n) carriage positions [m] or [rad].

    Returns:
        (N, 4, 4) nominal pose plus its first-order change.
    """
    table = _dh_error_table(robot, np.asarray(errors, float)[None])[0]
    matrices = []
    for row, kind, value in zip(robot.specification.carriage, robot.kinds, joints.T, strict=True):
        turning = kind == REVOLUTE
        matrices.append(dh_transform(row.theta + turning * value, row.d + (not turning) * value,
                                     row.a, row.alpha))  # fmt: skip
    total = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    for matrix in matrices:
        total = total @ matrix
    change = np.zeros_like(total)
    before = np.broadcast_to(np.eye(4), total.shape)
    for row, matrix, (dtheta, dd, da, dalpha) in zip(robot.specification.carriage, matrices, table, strict=True):
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


def _to_point_tuples(points: np.ndarray) -> tuple:
    return tuple(map(tuple, points.tolist()))


def _dh_error_table(robot: HybridRobot, errors: np.ndarray) -> np.ndarray:
    """Arrange carriage errors (W, parameters) as errors (W, n, 4) of theta, d, a, alpha per D-H row.

    Entries that are no parameters are zero.
    """
    table, at = np.zeros((len(errors), len(robot.kinds), 4)), 0
    for i, kind in enumerate(robot.kinds):
        columns = [0, 1, 2, 3] if kind == REVOLUTE else [0, 3]
        table[:, i, columns] = errors[:, at : at + len(columns)]
        at += len(columns)
    return table


def _dh_constants(robot: HybridRobot, errors: np.ndarray) -> np.ndarray:
    nominal = np.array([(r.theta, r.d, r.a, r.alpha) for r in robot.specification.carriage])
    rows = nominal + _dh_error_table(robot, errors)
    links = dh_transform(*np.moveaxis(rows, -1, 0))
    base = np.broadcast_to(np.eye(4), (len(errors), 1, 4, 4))
    return np.concatenate([base, links], axis=1)


def _poe_frames(robot: HybridRobot, errors: np.ndarray) -> np.ndarray:
    """Compute the joint axis frames (W, n, 4, 4) displaced by W sets of errors, with joints at zero."""
    nominal = axis_frames(robot.specification.axes)
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


def _poe_constants(robot: HybridRobot, errors: np.ndarray) -> np.ndarray:
    at_zero = frames_at_zero_joints(robot)[1]
    return carriage_constants_from_axes(_poe_frames(robot, errors), at_zero)
