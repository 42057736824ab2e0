"""Joint angles of a robot with its ball in sockets: files and simulated measurements.

A measurement is a folder with `PLACE/hole_0.csv`, `PLACE/hole_1.csv`, ...: one folder per place of
the tool that holds the sockets, one file per socket, one row per posture, one column per joint,
with or without a header line. Files in the folder itself are one place. Simulated measurements use
robots with random geometric errors.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text, resolve_path
from hydrotele.kinematics.serial_robot import (
    SerialRobot,
    apply_calibrated_parameters,
    compute_ball_poses,
    robot_chain,
    solve_joints_for_ball,
)

_FILE_PATTERN = re.compile(r"hole_?(\d+)\.(csv|txt)", re.IGNORECASE)
_SEPARATOR_PATTERN = re.compile(r"[,;\t ]\s*|\s+")
_POSTURE_TOLERANCE = 1e-6  # rad or m: postures that differ by less count as repeated
_MIN_POSTURES = 3  # postures, minimum for a mean and a scatter
_MAX_POSTURES = 2000  # postures per socket that are used: a log at 1 kHz contains no more information


@dataclass(frozen=True)
class Socket:
    """Postures of a robot with its ball in one socket of a tool that stands at one place.

    Attributes:
        place: name of the place of the tool that holds the sockets.
        hole: number of the socket in the tool.
        path: path of the file.
        joints: (n, k) joint angles [rad], or positions [m].
        lines: (n,) line numbers of the rows in the file, from 1.
    """

    place: str
    hole: int
    path: Path
    joints: np.ndarray
    lines: np.ndarray

    @property
    def name(self) -> str:
        """Name of the socket, `PLACE/hole_0`."""
        return f"{self.place}/hole_{self.hole}"


def load_sockets(folder: str | Path, degrees: bool = False) -> tuple[tuple[Socket, ...], list[str]]:
    """Read the postures (joint angles) of all sockets of a measurement folder.

    Args:
        folder: folder with one folder per place of the tool, or with the files of one place. Files
            are named `hole_0.csv`, `hole_1.csv`, ..., one per socket.
        degrees: whether the angles in the files are in degrees; they are converted to radians.

    Returns:
        The sockets, ordered by path, and notes on rows that were left out.

    Raises:
        InputError: a file is invalid; the message names file, row and column.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "is not a folder")
    paths = sorted(p for p in (*folder.glob("*"), *folder.glob("*/*")) if _FILE_PATTERN.fullmatch(p.name))
    if not paths:
        inside = ", ".join(sorted(p.name for p in folder.iterdir())[:6]) or "nothing"
        raise InputError(folder, f"contains no PLACE/hole_0.csv, PLACE/hole_1.csv, ... (it contains {inside})")
    sockets, notes = [], []
    for path in paths:
        found = _FILE_PATTERN.fullmatch(path.name)
        assert found is not None
        place = resolve_path(path.parent).name
        joints, lines = _read_joints(path)
        if degrees:
            joints = np.radians(joints)
        sockets.append(_remove_repeated(Socket(place, int(found[1]), path, joints, lines), notes))
    columns = {s.path: s.joints.shape[1] for s in sockets}
    usual = max(set(columns.values()), key=list(columns.values()).count)
    for path, count in columns.items():
        if count != usual:
            raise InputError(path, f"has {count} columns, but the other files have {usual}: one per joint")
    return tuple(sockets), notes


def place_names(sockets: Sequence[Socket]) -> tuple[str, ...]:
    """Return the names of the places at which the socket tool stood, without repetition, in order."""
    return tuple(dict.fromkeys(socket.place for socket in sockets))


def find_idle_joints(sockets: Sequence[Socket]) -> list[int]:
    """Return the column indices of joints that never move: one value in all postures of all sockets."""
    joints = np.vstack([socket.joints for socket in sockets])
    return [int(k) for k in np.flatnonzero(np.ptp(joints, axis=0) < _POSTURE_TOLERANCE)]


def _read_joints(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the joint readings (n, k) of a text file of n postures, and their line numbers (n,)."""
    rows, lines = [], []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        line = line.strip().lstrip("\ufeff")
        if not line or line.startswith("#"):
            continue
        words = _SEPARATOR_PATTERN.split(line)
        values = [_parse_number(word) for word in words]
        if not rows and all(value is None for value in values):
            continue  # header line
        for column, (word, value) in enumerate(zip(words, values, strict=True), start=1):
            if value is None or not math.isfinite(value):
                raise InputError(f"{path}: row {number}, column {column}", f"{word!r} is not a finite number")
        if rows and len(values) != len(rows[0]):
            raise InputError(
                f"{path}: row {number}",
                f"has {len(values)} columns, but the rows before have {len(rows[0])}",
            )
        rows.append(values)
        lines.append(number)
    if len(rows) < _MIN_POSTURES:
        raise InputError(
            path,
            f"has {len(rows)} rows; record at least {_MIN_POSTURES} different postures, preferably 20",
        )
    return np.array(rows, float), np.array(lines)


def _parse_number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def _remove_repeated(socket: Socket, notes: list[str]) -> Socket:
    """Return a socket without repeated postures, thinned evenly to at most 2000; append notes on removed rows.

    Raises:
        InputError: there are fewer than three different postures.
    """
    cells = np.round(socket.joints / _POSTURE_TOLERANCE)
    kept = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    if len(kept) < _MIN_POSTURES:
        raise InputError(
            socket.path,
            f"repeats one posture: {len(socket.joints)} rows contain {len(kept)} different ones;"
            f" record at least {_MIN_POSTURES}, preferably 20",
        )
    if len(kept) < len(socket.joints):
        gone = sorted(set(range(len(socket.joints))) - set(kept))
        rows = ", ".join(str(socket.lines[row]) for row in gone[:8])
        more = " ..." if len(gone) > 8 else ""
        notes.append(f"{socket.path}: rows {rows}{more} repeat earlier ones and are left out")
    if len(kept) > _MAX_POSTURES:
        notes.append(f"{socket.path}: {_MAX_POSTURES} of {len(kept)} rows are used, evenly spaced")
        kept = kept[np.linspace(0, len(kept) - 1, _MAX_POSTURES).astype(int)]
    return replace(socket, joints=socket.joints[kept], lines=socket.lines[kept])


_MAX_TRIES = 200
_MAX_BALL_ERROR = 1e-9  # m
_IDLE_ANGLE = 0.3  # rad


@dataclass(frozen=True)
class RobotErrors:
    """Standard deviations of a simulated robot's geometric errors and of its measurement.

    Attributes:
        length: displacements of joint frames [m].
        tilt: rotations of joint frames across the joint's axis [rad].
        offset: joint offsets [rad].
        ball: position of the ball in the last link [m].
        encoder: noise of a joint's reading [rad] or [m].
        play: play of the ball in its socket, each coordinate [m].
    """

    length: float = 3.0e-4
    tilt: float = 1.0e-3
    offset: float = 3.0e-3
    ball: float = 2.0e-3
    encoder: float = 0.0
    play: float = 1.0e-4


def add_random_errors(
    robot: SerialRobot, errors: RobotErrors, rng: np.random.Generator,
    corrections: Mapping[str, float] | None = None,
) -> tuple[SerialRobot, dict[str, float]]:  # fmt: skip
    """Return a copy of a robot with random, normally distributed geometric errors.

    Args:
        robot: nominal robot.
        errors: standard deviations of the errors.
        rng: random generator.
        corrections: joint corrections (deflection, eccentricity) with names as from `correction_names`.

    Returns:
        The robot and its true parameters, named as those of `robot_chain`.
    """
    chain = robot_chain(robot)
    values = {}
    for name, nominal in zip(chain.parameters, chain.nominal_values, strict=True):
        kind, _, joint = name.partition(".")
        size = errors.length if kind[0] == "t" else errors.offset if kind == "rz" else errors.tilt
        if joint == "tool":
            size = errors.ball
        values[name] = float(nominal + size * rng.standard_normal())
    return apply_calibrated_parameters(robot, values, corrections or {}), values


def simulate_sockets(
    robot: SerialRobot, places: Mapping[str, Sequence[float]], rows: int, errors: RobotErrors,
    rng: np.random.Generator, distance: float = 0.050, limit: float = 2.8,
    idle: int | None = None,
) -> tuple[Socket, ...]:  # fmt: skip
    """Simulate postures of a robot with its ball in two sockets of a tool, at every place of the tool.

    Args:
        robot: true robot, with errors.
        places: (3,) position of the first socket in the base frame [m] by name of the place; the
            second socket is displaced in y.
        rows: postures per socket.
        errors: noise of the encoders and play of the ball.
        rng: random generator.
        distance: distance of the two sockets [m].
        limit: maximum absolute joint angle [rad].
        idle: column of a joint that stays at 0.3 rad, or None.

    Returns:
        The sockets.

    Raises:
        InputError: too few postures reach a place.

    Examples:
        A robot holds a ball in two sockets at three places, in 12 postures each. Its links and zero angles have errors,
        and the ball has 0.1 mm of play. The calibrated robot is tried at a fourth place.

        >>> import numpy as np
        >>> from hydrotele.calibrate.socket_calibration import SocketOptions, calibrate_sockets, evaluate_robot
        >>> from hydrotele.kinematics.serial_robot_files import load_robot
        >>> rng, nominal, errors = np.random.default_rng(3), load_robot("panda"), RobotErrors()
        >>> true, _ = add_random_errors(nominal, errors, rng)
        >>> places = {"left": (0.4, 0.3, 0.1), "right": (0.45, -0.3, 0.1), "front": (0.55, 0.0, 0.1)}
        >>> sockets = simulate_sockets(true, places, 12, errors, rng)
        >>> found = calibrate_sockets(nominal, sockets, SocketOptions(model="rigid"))
        >>> unseen = simulate_sockets(true, {"unseen": (0.5, 0.1, 0.25)}, 20, RobotErrors(play=0.0), rng)
        >>> for robot in nominal, found.robot:
        ...     print(f"{1e3 * evaluate_robot(robot, unseen).rms:.2f} mm")
        2.99 mm
        0.06 mm
    """
    made = []
    for place, first in places.items():
        for hole in (0, 1):
            middle = np.asarray(first, float) + [0.0, hole * distance, 0.0]
            joints = _solve_postures(robot, middle, rows, errors, rng, limit, place, idle)
            joints = joints + errors.encoder * rng.standard_normal(joints.shape)
            if idle is not None:
                joints[:, idle] = _IDLE_ANGLE
            path = Path(place) / f"hole_{hole}.csv"
            made.append(Socket(place, hole, path, joints, np.arange(1, rows + 1)))
    return tuple(made)


def save_sockets(sockets: Sequence[Socket], folder: Path) -> None:
    """Write each socket's postures to `PLACE/hole_N.csv` in a folder: rows of joint angles [rad] or positions [m]."""
    for socket in sockets:
        path = folder / socket.place / f"hole_{socket.hole}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(path, socket.joints, delimiter=",", fmt="%.9f")


def _solve_postures(
    robot: SerialRobot, middle: np.ndarray, rows: int, errors: RobotErrors, rng: np.random.Generator,
    limit: float, place: str, idle: int | None,
) -> np.ndarray:  # fmt: skip
    """Find random postures that put the ball into a socket at `middle` (3,) [m].

    Returns:
        (rows, k) encoder readings [rad] or [m], without noise. Each posture puts the ball at `middle`
        plus random play.

    Raises:
        InputError: too few postures are found.
    """
    found: list[np.ndarray] = []
    for _ in range(_MAX_TRIES):
        start = rng.uniform(-limit, limit, (4 * rows, len(robot.joints)))
        if idle is not None:
            start[:, idle] = _IDLE_ANGLE
        near = np.linalg.norm(compute_ball_poses(robot, start).position - middle, axis=1)
        start = start[np.argsort(near)[: 2 * rows]]
        targets = middle + errors.play * rng.standard_normal((len(start), 3))
        reached = solve_joints_for_ball(robot, targets, start, idle=idle)
        good = (reached.remaining_distance < _MAX_BALL_ERROR) & (np.abs(reached.joints).max(axis=1) < limit)
        found += list(reached.joints[good])
        if len(found) >= rows:
            return np.array(found[:rows])
    raise InputError(f"place {place}", f"{robot.name} does not reach {middle.round(3).tolist()} m")
