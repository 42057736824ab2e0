"""Reading and writing of measured poses of a hybrid robot.

A measurement is a folder with

- `poses.csv` or `poses.parquet`, one row per pose, units in the header (`leg.1 [mm]`) or in the
  Parquet field metadata (without one: m, rad): `joint.<name>` of every carriage joint, `leg.1` to
  `leg.6`, and the platform's pose in frame 0, either `pose.x`, `pose.y`, `pose.z`, `pose.rx`,
  `pose.ry`, `pose.rz` with R = Rz(rz) Ry(ry) Rx(rx), or the lengths `wire.1` to `wire.6`;
- optionally 21 columns `covariance.x.x`, `covariance.x.y` ... `covariance.rz.rz`, the upper
  triangle of each pose's covariance in SI, of position and rotation vector in frame 0;
- `measurement.yaml`: `robot` (its name), `wires` (anchors and points, for `wire.*`), `noise`
  (standard deviations `leg`, `slide`, `turn`, `wire`, `position`, `orientation`), all optional;
- optionally `heldout.csv` or `.parquet` of the same form, for validation, and `robot.yaml`, the
  nominal robot.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from hydrotele.core.datafile import (
    PositiveFloat,
    StrictModel,
    read_yaml,
    suggest_valid_name,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file
from hydrotele.core.units import si_unit_and_factor
from hydrotele.kinematics.hybrid_robot import (
    LEG_COUNT,
    REVOLUTE,
    HybridRobot,
    PlatformPose,
    UnreachableError,
    euler_to_rotation,
    forward_kinematics,
    leg_jacobian,
    leg_readings,
    rotation_to_euler,
)
from hydrotele.kinematics.wire_measurement import (
    NoIntersectionError,
    WireGeometry,
    pose_covariance,
    pose_from_wires,
)
from hydrotele.logs.table import Table, read_table

POSE_COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
COVARIANCE_COLUMNS = tuple(f"covariance.{a}.{b}" for a, b in combinations_with_replacement(POSE_COORDINATES, 2))
POSES_STEM, HELDOUT_STEM, MEASUREMENT_FILE = "poses", "heldout", "measurement.yaml"
_FILE_SUFFIXES = (".csv", ".parquet")
_RANGE_MARGIN = 0.2  # fraction of a joint's range by which a reading may exceed it
_MAX_LEG_DIFFERENCE = 0.05  # m: median leg difference from the nominal robot above which it is another robot
_DEFAULT_WIRE_DEVIATION = 1e-4  # m: default of a wire's deviation; only its ratio to the other errors matters
_MIN_NOISE, _MAX_NOISE = 1e-9, 1.0  # m: noise below rounding of the poses, and noise of the robot's size
_POSE_RESOLUTION = 1e-5  # m or rad: resolution at which poses count as repeated


class SensorNoise(StrictModel):
    """Standard deviations of the sensors; None if unknown.

    Attributes:
        leg: of a leg reading [m].
        prismatic: of a prismatic carriage joint [m].
        revolute: of a revolute carriage joint [rad].
        wire: of a wire length [m].
        position: of a measured pose's coordinates [m].
        orientation: of a measured pose's rotation vector [rad].
    """

    renamed = {"slide": "prismatic", "turn": "revolute"}

    leg: PositiveFloat | None = None
    prismatic: PositiveFloat | None = None
    revolute: PositiveFloat | None = None
    wire: PositiveFloat | None = None
    position: PositiveFloat | None = None
    orientation: PositiveFloat | None = None


class MeasurementSpec(StrictModel):
    """Contents of `measurement.yaml`.

    Attributes:
        robot: name of the measured robot; empty if not stated.
        wires: anchors and platform points of the six measuring wires; None without wires.
        noise: standard deviations of the sensors.
    """

    robot: str = ""
    wires: WireGeometry | None = None
    noise: SensorNoise = SensorNoise()


@dataclass(frozen=True)
class Measurement:
    """Measured poses, N of them.

    Attributes:
        source: the file.
        rows: (N,) row numbers in the table, from 0.
        joints: (N, n) carriage readings [m] or [rad].
        legs: (N, 6) leg readings [m].
        pose: measured pose of the moving platform in frame 0.
        covariance: (N, 6, 6) covariance of the leg readings minus those predicted from measured
            pose and carriage [m^2]; known up to a factor if `noise_is_known` is false.
        noise_is_known: whether the noise of the legs and of the measured poses (or wires) is stated;
            otherwise defaults are used.
    """

    source: str
    rows: np.ndarray
    joints: np.ndarray
    legs: np.ndarray
    pose: PlatformPose
    covariance: np.ndarray
    noise_is_known: bool

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.legs)

    def subset(self, index: np.ndarray) -> "Measurement":
        """Return the poses selected by an index array or mask."""
        return replace(
            self, rows=self.rows[index], joints=self.joints[index], legs=self.legs[index],
            pose=PlatformPose(self.pose.rotation[index], self.pose.position[index]),
            covariance=self.covariance[index],
        )  # fmt: skip

    @property
    def distinct_count(self) -> int:
        """Number of different poses: those whose joint and leg readings differ when rounded to 1e-5 m or rad."""
        whole = np.hstack([self.joints, self.legs])
        return len(np.unique(np.round(whole / _POSE_RESOLUTION), axis=0))


def measurement_from_wires(
    robot: HybridRobot, joints: np.ndarray, legs: np.ndarray, lengths: np.ndarray, wires: WireGeometry,
    noise: Mapping[str, float], source: str,
) -> Measurement:  # fmt: skip
    """Build a measurement whose platform poses are computed from six wire lengths per pose.

    Args:
        robot: nominal robot; its forward kinematics select the solution of the wire equations.
        joints: (N, n) carriage readings [m] or [rad].
        legs: (N, 6) leg readings [m].
        lengths: (N, 6) wire lengths [m].
        wires: geometry of the wires.
        noise: standard deviations by the names of `SensorNoise`, in SI; defaults if missing.
        source: name of the measurement, for messages.

    Raises:
        NoIntersectionError: the wires do not meet.
        UnreachableError: the legs do not fit this robot.
    """
    pose = pose_from_wires(wires, lengths, forward_kinematics(robot, joints, legs))
    stated = SensorNoise(**noise)
    of_pose = pose_covariance(wires, pose, stated.wire or _DEFAULT_WIRE_DEVIATION)
    whole = _leg_residual_covariance(robot, joints, pose, of_pose, stated)
    known = stated.wire is not None and stated.leg is not None
    return Measurement(source, np.arange(len(legs)), joints, legs, pose, whole, known)


def find_robot_file(folder: Path) -> Path | None:
    """Return the path of `robot.yaml`, the nominal robot, in a measurement folder; None without it."""
    path = folder / "robot.yaml"
    return path if path.is_file() else None


def read_measurement(folder: Path, robot: HybridRobot) -> tuple[Measurement, Measurement | None]:
    """Read the measured poses of a folder: those for calibration and, if present, for validation.

    Args:
        folder: folder with `poses.csv` or `.parquet`, and optionally `heldout` and `measurement.yaml`.
        robot: nominal robot.

    Returns:
        (poses for calibration, poses for validation or None).

    Raises:
        InputError: a file is invalid; the message names file, column, row and remedy.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, f"is not a folder: give one with {POSES_STEM}.csv or {POSES_STEM}.parquet")
    file = _find_table(folder, POSES_STEM)
    if file is None:
        raise InputError(folder, f"contains neither {POSES_STEM}.csv nor {POSES_STEM}.parquet")
    facts = MeasurementSpec()
    if (folder / MEASUREMENT_FILE).is_file():
        data, lines = read_yaml(folder / MEASUREMENT_FILE)
        facts = validate_data(MeasurementSpec, data, str(folder / MEASUREMENT_FILE), lines)
    if facts.robot and facts.robot != robot.name:
        raise InputError(
            folder / MEASUREMENT_FILE, f"is a measurement of the robot {facts.robot!r}, but the model is"
            f" {robot.name!r}: select that robot with --robot",
        )  # fmt: skip
    heldout = _find_table(folder, HELDOUT_STEM)
    return _read_poses(file, facts, robot), _read_poses(heldout, facts, robot) if heldout else None


def _find_table(folder: Path, stem: str) -> Path | None:
    return next((folder / f"{stem}{k}" for k in _FILE_SUFFIXES if (folder / f"{stem}{k}").is_file()), None)


def _read_poses(file: Path, facts: MeasurementSpec, robot: HybridRobot) -> Measurement:
    table = read_table(file)
    columns = _read_columns(table, robot, facts)
    if not len(table.values) or not len(table.values[0]):
        raise InputError(file, "contains no pose: write one line per pose")
    joints = np.column_stack([columns[f"joint.{name}"] for name in robot.joints])
    legs = np.column_stack([columns[f"leg.{k}"] for k in range(1, LEG_COUNT + 1)])
    _check_ranges(table, robot, joints, legs)
    noise = facts.noise
    if "wire.1" in columns:
        pose = _pose_from_wires(table, columns, facts, robot, joints, legs)
        assert facts.wires is not None
        of_pose = pose_covariance(facts.wires, pose, noise.wire or _DEFAULT_WIRE_DEVIATION)
        known = noise.wire is not None
    else:
        place = np.column_stack([columns[f"pose.{c}"] for c in POSE_COORDINATES])
        pose = PlatformPose(euler_to_rotation(place[:, 3:]), place[:, :3])
        of_pose, known = _pose_covariance(table, columns, noise, len(legs))
    _check_robot(table, robot, joints, legs, pose)
    whole = _leg_residual_covariance(robot, joints, pose, of_pose, noise)
    _check_covariance(file, whole)
    return Measurement(
        str(file), np.arange(len(legs)), joints, legs, pose, whole,
        known and noise.leg is not None,
    )  # fmt: skip


def _read_columns(table: Table, robot: HybridRobot, facts: MeasurementSpec) -> dict[str, np.ndarray]:
    """Return the columns of a pose table by name in SI units; raise InputError for invalid ones."""
    joints = dict(zip((f"joint.{n}" for n in robot.joints), robot.kinds, strict=True))
    legs, wires = ([f"{what}.{k}" for k in range(1, LEG_COUNT + 1)] for what in ("leg", "wire"))
    poses = [f"pose.{c}" for c in POSE_COORDINATES]
    angles = {*poses[3:], *(name for name, kind in joints.items() if kind == REVOLUTE)}
    known = [*joints, *legs, *poses, *wires, *COVARIANCE_COLUMNS]
    columns: dict[str, np.ndarray] = {}
    for name, values, unit in zip(table.names, table.values, table.units, strict=True):
        if name not in known:
            raise InputError(table.location(name), f"is not a column of {robot.name}: "
                             f"{suggest_valid_name(name, known[:-21])}, covariance.x.x ...")  # fmt: skip
        if name in columns:
            raise InputError(table.location(name), "occurs twice")
        wrong = np.flatnonzero(~np.isfinite(values))
        if len(wrong):
            said = f"is {values[wrong[0]]}: remove the row or measure the pose again"
            raise InputError(table.location(name, int(wrong[0])), said)
        needed = "rad" if name in angles else "m"
        si, factor = si_unit_and_factor(unit) if unit else (needed, 1.0)
        if si != needed and name not in COVARIANCE_COLUMNS:
            like = "rad, deg or mrad" if needed == "rad" else "m or mm"
            raise InputError(table.location(name), f"has the unit {unit!r}, but needs {like}")
        columns[name] = np.asarray(values, float) * (1.0 if name in COVARIANCE_COLUMNS else factor)
    for group in ((*joints, *legs), wires if "wire.1" in columns else poses):
        missing = [name for name in group if name not in columns]
        if missing:
            either = " (or wire.1 to wire.6)" if group is poses else ""
            raise InputError(table.source, f"has no column {', '.join(missing)}{either}")
    if "wire.1" in columns and facts.wires is None:
        raise InputError(Path(table.source).with_name(MEASUREMENT_FILE), "must state `wires`: anchors and points")
    return columns


def _check_ranges(table: Table, robot: HybridRobot, joints: np.ndarray, legs: np.ndarray) -> None:
    named = [(f"joint.{n}", v, r) for n, v, r in
             zip(robot.joints, joints.T, robot.joint_range, strict=True)]  # fmt: skip
    named += [(f"leg.{k}", v, robot.leg_range) for k, v in enumerate(legs.T, 1)]
    for name, values, (low, high) in named:
        room = _RANGE_MARGIN * (high - low)
        wrong = np.flatnonzero((values < low - room) | (values > high + room))
        if len(wrong):
            row = int(wrong[0])
            angle = name in {f"joint.{n}" for n, k in zip(robot.joints, robot.kinds, strict=True)
                             if k == REVOLUTE}  # fmt: skip
            unit, other = ("rad", "deg") if angle else ("m", "mm")
            raise InputError(
                table.location(name, row), f"is {values[row]:.6g} {unit}, but robot {robot.name}"
                f" has the range {low:.6g} to {high:.6g}: correct the value, state the unit in the"
                f" header ('{name} [{other}]') or select the correct robot",
            )  # fmt: skip


def _pose_from_wires(table, columns, facts, robot, joints, legs) -> PlatformPose:
    lengths = np.column_stack([columns[f"wire.{k}"] for k in range(1, LEG_COUNT + 1)])
    try:
        near = forward_kinematics(robot, joints, legs)
        return pose_from_wires(facts.wires, lengths, near)
    except (UnreachableError, NoIntersectionError) as error:
        raise InputError(
            table.source,
            f"{error}: check the order and units of the wires in it and in {MEASUREMENT_FILE}",
        ) from None


def _pose_covariance(table, columns, noise, count) -> tuple[np.ndarray, bool]:
    present = [name for name in COVARIANCE_COLUMNS if name in columns]
    if present:
        if len(present) < len(COVARIANCE_COLUMNS):
            missing = [name for name in COVARIANCE_COLUMNS if name not in columns]
            raise InputError(table.source, f"has no {', '.join(missing[:6])}: give all 21 or none")
        result, at = np.empty((count, 6, 6)), np.triu_indices(6)
        result[:, at[0], at[1]] = np.column_stack([columns[name] for name in COVARIANCE_COLUMNS])
        result[:, at[1], at[0]] = result[:, at[0], at[1]]
        for row, matrix in enumerate(result):
            if np.linalg.eigvalsh(matrix)[0] < 0.0:
                said = "the covariance of this pose is not positive semidefinite"
                raise InputError(table.location("covariance.x.x", row), said)
        return result, True
    position, orientation = noise.position or 5e-5, noise.orientation or 1e-4
    known = noise.position is not None and noise.orientation is not None
    return np.broadcast_to(np.diag([position**2] * 3 + [orientation**2] * 3), (count, 6, 6)), known


def _leg_residual_covariance(robot: HybridRobot, joints, pose: PlatformPose, of_pose: np.ndarray, noise: SensorNoise):
    """Return the covariance (N, 6, 6) of measured minus predicted leg readings [m^2].

    It adds the noise of the legs, of the carriage joints, and of the measured pose with covariance
    `of_pose` (N, 6, 6).
    """
    by_pose = leg_jacobian(robot, joints, pose)
    by_joint = np.empty((len(joints), LEG_COUNT, len(robot.joints)))
    for k in range(len(robot.joints)):
        step = np.zeros(len(robot.joints))
        step[k] = 1e-6
        change = leg_readings(robot, joints + step, pose) - leg_readings(robot, joints - step, pose)
        by_joint[..., k] = change / 2e-6
    sizes = np.where(robot.kinds == REVOLUTE, noise.revolute or 0.0, noise.prismatic or 0.0)
    by_joint = by_joint * sizes
    return (
        (noise.leg or 1e-5) ** 2 * np.eye(LEG_COUNT)
        + by_pose @ of_pose @ np.swapaxes(by_pose, 1, 2)
        + by_joint @ np.swapaxes(by_joint, 1, 2)
    )


def _check_covariance(file: Path, covariance: np.ndarray) -> None:
    """Raise InputError if the smallest standard deviation of a leg residual is outside 1e-9 to 1 m."""
    finite = np.isfinite(covariance).all()
    smallest = float(np.linalg.eigvalsh(covariance)[:, 0].min()) if finite else np.inf
    if not _MIN_NOISE**2 <= smallest <= _MAX_NOISE**2:
        size = np.sqrt(max(smallest, 0.0))
        raise InputError(
            file.with_name(MEASUREMENT_FILE), f"the stated noise gives the legs a standard deviation of"
            f" {1e3 * size:.3g} mm: state noise from {1e3 * _MIN_NOISE:.0e} mm to {1e3 * _MAX_NOISE:.0f} mm,"
            " or leave it out to estimate it",
        )  # fmt: skip


def _check_robot(table: Table, robot: HybridRobot, joints, legs, pose: PlatformPose) -> None:
    """Raise InputError if the leg readings differ too much from the nominal robot's at the measured poses.

    The limit is 0.05 m for the median absolute difference over all poses and legs. Larger
    differences mean that the data are of another robot, unit or frame.
    """
    away = np.abs(leg_readings(robot, joints, pose) - legs)
    if np.median(away) > _MAX_LEG_DIFFERENCE:
        row = int(np.argmax(away.max(axis=1)))
        raise InputError(
            table.source, f"legs differ from those of the robot {robot.name} at the measured poses"
            f" by {np.median(away):.3g} m in the median (row {row}: {away[row].max():.3g} m): it is"
            " of another robot, in other units, or its poses are not in frame 0 as Z-Y-X angles",
        )  # fmt: skip


def save_measurement(
    folder: Path, stem: str, robot: HybridRobot, joints: np.ndarray, legs: np.ndarray,
    pose: PlatformPose | None = None, wires: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Write measured poses as a CSV table in mm and degrees, which `read_measurement` reads.

    Args:
        folder: existing folder.
        stem: name of the file without suffix, `poses` or `heldout`.
        robot: robot that has these joints.
        joints: (N, n) carriage readings [m] or [rad].
        legs: (N, 6) leg readings [m].
        pose: measured platform poses; None to write none.
        wires: (N, 6) wire lengths [m]; None to write none.
    """
    columns: dict[str, np.ndarray] = {}
    for name, kind, values in zip(robot.joints, robot.kinds, joints.T, strict=True):
        unit, factor = ("deg", 180.0 / np.pi) if kind == REVOLUTE else ("mm", 1e3)
        columns[f"joint.{name} [{unit}]"] = factor * values
    columns |= {f"leg.{k} [mm]": 1e3 * v for k, v in enumerate(legs.T, 1)}
    if wires is not None:
        columns |= {f"wire.{k} [mm]": 1e3 * v for k, v in enumerate(wires.T, 1)}
    if pose is not None:
        angles = np.degrees(rotation_to_euler(pose.rotation))
        columns |= {f"pose.{c} [mm]": 1e3 * v
                    for c, v in zip(POSE_COORDINATES, pose.position.T, strict=False)}  # fmt: skip
        columns |= {f"pose.{c} [deg]": v for c, v in zip(POSE_COORDINATES[3:], angles.T, strict=True)}
    lines = [",".join(columns)]
    lines += [",".join(f"{v:.9f}" for v in row) for row in np.column_stack([*columns.values()])]
    with atomic_file(folder / f"{stem}.csv", ".csv") as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def format_measurement_yaml(robot: str, wires: WireGeometry | None, noise: Mapping[str, float]) -> str:
    """Return the YAML text of `measurement.yaml`: robot, wires and noise, converted to mm and degrees.

    Args:
        robot: name of the robot.
        wires: geometry of the wires.
        noise: standard deviations by the names of `SensorNoise`, in SI.
    """
    import yaml

    angles = ("revolute", "orientation")
    data: dict = {"robot": robot}
    if wires is not None:
        data["wires"] = {f"{key}_mm": [[round(1e3 * c, 6) for c in p] for p in getattr(wires, key)]
                         for key in ("anchors", "points")}  # fmt: skip
    data["noise"] = {
        f"{k}_deg" if k in angles else f"{k}_mm":
        float(f"{np.degrees(v) if k in angles else 1e3 * v:.9g}") for k, v in noise.items()
    }  # fmt: skip
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None)
