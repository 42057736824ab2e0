"""Conversion of calibrator logs to poses: moving link, valid rows and sensor accuracy."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.calibration_loop import CalibrationLoop
from hydrotele.calibrate.linkage_identification import AxisStrokes
from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log, missing_channels_message
from hydrotele.logs.resampling import merge_run
from hydrotele.logs.run_files import read_runs
from hydrotele.machine.machine import IDEAL_SENSORS, Machine, get_sensor_set, reading_noise_rms

MAX_POSES = 300
"""Maximum number of poses taken from a log, evenly spaced; Khoshzaban's figures show 300 to 400."""

_MAX_HELD_DRIFT = np.radians(1.0)  # maximum drift of a held link while another link moves
_TRANSDUCER_DEVIATION = 2.0e-3 / math.sqrt(3.0)  # m, of a linear transducer, K 2.5
_RESOLVER_DEVIATION = np.radians(0.1) / math.sqrt(3.0)  # default of a sensor without stated accuracy, K 2.5


def read_calibration_poses(
    path: Path,
    machine: Machine,
    loop: CalibrationLoop,
    max_poses: int = MAX_POSES,
    accuracy: float | None = None,
) -> list[Poses]:
    """Read the calibration logs of a folder, one per moving link, and convert them to poses.

    Args:
        path: folder of logs, run folder, or one log.
        machine: the machine with its calibrator, a passive arm with angle sensors from the tool to
            the chassis.
        loop: the closed chain of this machine and its calibrator.
        max_poses: maximum number of poses per log.
        accuracy: standard deviation of an angle reading [rad]. By default it is that of the sensor
            set named in the log, otherwise 0.1 deg / sqrt(3), for resolvers with uniformly
            distributed errors within 0.1 deg (Khoshzaban 1992).

    Returns:
        One set of poses per log, in the order of the files.

    Raises:
        InputError: a channel is missing, a log is of another machine, or the moving link cannot be
            found.
    """
    return [log_to_poses(log, machine, loop, max_poses, accuracy) for log in read_calibration_logs(path, machine)[0]]


def read_calibration_logs(path: Path, machine: Machine) -> tuple[tuple[Log, ...], tuple[str, ...]]:
    """Read the logs of a calibration, and check that they are of the machine and have a common clock.

    Args:
        path: folder of logs, run folder, or one log.
        machine: the machine, which defines column names and command ranges.

    Returns:
        (logs, notes on data that were repaired).

    Raises:
        InputError: a log is invalid, is from another machine, or its time stamps follow no clock.
    """
    logs: list[Log] = []
    notes: list[str] = []
    for run in read_runs([path], machine, machine.log_columns, force=True):
        axes, channels = tuple(machine.axes), [c for log in run.logs for c in log.columns if c != "valid"]
        notes += [note for log in run.logs for note in log.notes] + list(merge_run(run, axes, channels)[1])
        for log in run.logs:
            if (of := log.metadata.get("machine", machine.name)) != machine.name:
                message = f"is a log of machine {of}, not of {machine.name}: give --machine {of}"
                raise InputError(log.source, message)
            logs.append(log)
    return tuple(logs), tuple(notes)


def log_to_poses(
    log: Log,
    machine: Machine,
    loop: CalibrationLoop,
    max_poses: int = MAX_POSES,
    accuracy: float | None = None,
) -> Poses:
    """Convert a log, in which one link moves, to calibrator poses.

    Args:
        log: log of one moving link.
        machine: the machine with its calibrator, a passive arm with angle sensors from the tool to
            the chassis.
        loop: the closed chain of this machine.
        max_poses: maximum number of poses.
        accuracy: standard deviation of an angle reading [rad]. None for that of the sensor set
            named in the log, otherwise 0.1 deg / sqrt(3), for resolvers with uniformly distributed
            errors within 0.1 deg (Khoshzaban 1992).

    Returns:
        The poses, evenly spaced over the valid rows.

    Raises:
        InputError: a channel is missing, fewer than two rows are valid, or the moving link cannot
            be found.
    """
    sensed = loop.channels[loop.powered_count :]
    if lacking := [name for name in sensed if name not in log]:
        raise InputError(log.source, missing_channels_message(lacking, log.columns))
    powered = [name for name in loop.channels[: loop.powered_count] if name in log]
    usable = np.isfinite([log[name] for name in (*sensed, *powered)]).all(axis=0)
    if usable.sum() < 2:
        raise InputError(log.source, f"has no two rows with readings of {', '.join((*sensed, *powered))}")
    if "valid" in log:
        usable &= log["valid"] > 0.5
    rows = np.flatnonzero(usable)
    if len(rows) < 2:
        raise InputError(f"{log.source}, column valid", "leaves no rows: mark valid rows with 1")
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(max_poses, len(rows))).round().astype(int))]
    link = find_moving_link(log, loop)
    theta = np.stack([log[name][rows] for name in sensed], axis=1) * loop.signs[loop.powered_count :]
    own = {
        name: log[channel][rows] * sign
        for name, channel, sign in zip(loop.links, loop.channels, loop.signs, strict=True)
        if name in loop.links[: loop.powered_count] and channel in log
    }
    sigma = np.array([_angle_noise_std(log, machine, name, accuracy) for name in sensed])
    others = [_angle_noise_std(log, machine, f"angle.{name}", accuracy) for name in own]
    return Poses(link, theta, sigma, own, max(others, default=0.0), log.source, rows)


def _angle_noise_std(log: Log, machine: Machine, channel: str, accuracy: float | None) -> float:
    """Return the noise of an angle channel's readings, a standard deviation [rad].

    It is `accuracy` if given, otherwise that of the sensor set named in the log. If the log names
    none, it is 0.1 deg / sqrt(3), for a resolver with uniformly distributed errors within 0.1 deg.
    """
    if accuracy is not None:
        return accuracy
    name = log.metadata.get("sensors", "")
    if name in machine.sensors and name != IDEAL_SENSORS:
        known = reading_noise_rms(machine, get_sensor_set(machine, name), channel)
        return known or _RESOLVER_DEVIATION
    return _RESOLVER_DEVIATION


def find_moving_link(log: Log, loop: CalibrationLoop) -> str:
    """Find the name of the powered link that moves in a log while the others are held.

    A link moves if its joint angle changes by more than 1 deg. If no angle shows a motion, the link
    with the largest change of cylinder length (over 0.02 m) is taken, or else of command (over 0.1).
    If channels of one kind are logged for all links and none moves, no link moves. Otherwise the
    file name must contain the link.

    Args:
        log: the log.
        loop: the chain.

    Returns:
        The name of the link.

    Raises:
        InputError: no link moves, the angles of more than one link move, or neither channels nor
            file name determine the link.

    >>> from hydrotele.machine.machine_file import load_machine
    >>> from hydrotele.calibrate.calibration_loop import build_loop
    >>> log = Log(np.arange(3.0), {"angle.boom": np.array([0.1, 0.3, 0.6])}, {"angle.boom": "rad"})
    >>> find_moving_link(log, build_loop(load_machine("calibrator")))
    'boom'
    """
    links = loop.links[: loop.powered_count]
    for kind, still in (("angle", _MAX_HELD_DRIFT), ("length", 0.02), ("command", 0.1)):
        channels = {n: log[f"{kind}.{n}"] for n in links if f"{kind}.{n}" in log}
        span = {n: float(np.ptp(v[np.isfinite(v)])) for n, v in channels.items() if np.isfinite(v).any()}
        moving = [name for name, size in span.items() if size > still]
        if len(moving) > 1 and kind == "angle":
            sizes = ", ".join(f"{n} by {np.degrees(span[n]):.1f} deg" for n in moving)
            message = f"moves more than one link ({sizes}): move one and hold the others"
            raise InputError(log.source, message)
        if moving:
            return max(moving, key=lambda name: span[name])
        if len(span) == len(links):
            message = f"moves none of {', '.join(links)}: move one link through its range"
            raise InputError(log.source, message)
    named = [name for name in links if name in Path(log.source).stem.split("_")]
    if len(named) == 1:
        return named[0]
    example = f"calibrate_{links[-1]}.parquet"
    message = f"does not say which link moves: log angles or commands, or name the file {example}"
    raise InputError(log.source, message)


def split_poses(stages: Sequence[Poses], every: int = 5) -> tuple[list[Poses], list[Poses]]:
    """Split the poses of each stage (one moving link) into a fitting set and a validation set.

    Args:
        stages: all poses, one item per moving link.
        every: n; every n-th pose of a stage is used for validation; 0 or 1 for no validation set.

    Returns:
        (stages for fitting, stages for validation).
    """
    if every <= 1:
        return list(stages), []
    judged = [np.arange(len(p)) % every == every // 2 for p in stages]
    return ([p.select(~j) for p, j in zip(stages, judged, strict=True)],
            [p.select(j) for p, j in zip(stages, judged, strict=True)])  # fmt: skip


def extract_strokes(log: Log, machine: Machine, axes: Sequence[str], max_samples: int = 0) -> list[AxisStrokes]:
    """Extract joint angles and cylinder displacements of the axes that move in a log.

    Args:
        log: log with channels `angle.AXIS` and `length.AXIS`.
        machine: the machine.
        axes: names of the axes to search.
        max_samples: maximum number of samples per axis, evenly spaced; 0 for all.

    Returns:
        One item per axis that moves by at least 5 deg.
    """
    found = []
    valid = log["valid"] > 0.5 if "valid" in log else np.ones(len(log), dtype=bool)
    for axis in axes:
        channels = f"angle.{axis}", f"length.{axis}"
        if not all(c in log for c in channels):
            continue
        rows = np.flatnonzero(valid & np.isfinite([log[c] for c in channels]).all(axis=0))
        if max_samples and len(rows) > max_samples:
            rows = rows[np.linspace(0, len(rows) - 1, max_samples).round().astype(int)]
        if not len(rows) or np.ptp(log[channels[0]][rows]) < np.radians(5.0):
            continue
        angle, length = (log[c][rows] for c in channels)
        sigma = _angle_noise_std(log, machine, channels[0], None)
        found.append(AxisStrokes(
            axis, angle, length, sigma, _length_noise_std(log, machine, channels[1]), "measured",
            log.source,
        ))  # fmt: skip
    return found


def _length_noise_std(log: Log, machine: Machine, channel: str) -> float:
    """Return the noise of a displacement channel's readings, a standard deviation [m].

    It is that of the sensor set named in the log. If the log names none, it is 2 mm / sqrt(3), for a
    transducer with uniformly distributed errors within 2 mm.
    """
    name = log.metadata.get("sensors", "")
    if name in machine.sensors and name != IDEAL_SENSORS:
        return reading_noise_rms(machine, get_sensor_set(machine, name), channel) or _TRANSDUCER_DEVIATION
    return _TRANSDUCER_DEVIATION
