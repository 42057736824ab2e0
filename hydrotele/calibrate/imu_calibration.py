"""Calibrate the mounting of IMUs from logs, and derive joint positions from their readings.

A joint position, gyro and accelerometer determine each other along the chain of links: gyros give
rates, specific forces give inclinations after the accelerations of the moving links are subtracted.
The following is not identifiable from IMUs alone and comes from the machine file or from known poses:

- the rotation of an IMU about a joint axis that is horizontal equals an offset of this joint; only
  accelerations of the lever arms, which are small, separate the two;
- the position of a joint whose axis is vertical (slew), apart from its changes, and its mean rate,
  apart from intervals without a command of this axis.

The smoother uses the readings up to 4 Hz. The relation between angular accelerations and sampled
rates is not accurate enough above, and vibrations would falsify the lever-arm accelerations. The
gyros add the faster part of the joint motion afterwards.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from hydrotele.calibrate.imu_model import ImuChain, build_imu_chain, predict_imu_readings, rotation_from_parameters
from hydrotele.calibrate.imu_smoother import ImuParameters, ImuRun, SmoothedImus, SmoothedRun, smooth_imus
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS
from hydrotele.logs.log import Log
from hydrotele.logs.run_files import read_runs
from hydrotele.machine.machine import IDEAL_SENSORS, Machine, find_channel_sensor, get_sensor_set
from hydrotele.machine.sensors import Sensor, SensorSet

_GYRO_NOISE = 0.005  # [rad/s], assumed where the machine file states none
_ACCELEROMETER_NOISE = 0.05  # [m/s^2], assumed where the machine file states none
_JOINT_NOISE = 2e-3  # [rad] or [m], assumed for a joint sensor without a stated accuracy
_REST_TIME = 1.0  # [s] without a command after which a slew drive is at rest
_REST_RATE_SD = 2e-3  # [rad/s], oscillation of a slew drive with closed valves after this time
_START_SD = 1e-4  # [rad], of the arbitrary initial position of a vertical axis
_VERTICAL_COSINE = 0.94  # cosine of the angle (20 deg) to gravity below which gravity determines a joint
_GRAVITY_TIME = 4.0  # [s], time over which gravity corrects the initial positions, longer than accelerations last
_RELATIVE_ERROR = 0.02  # of accelerations of links: scale and cross-axis error of MEMS accelerometers, flexible links
_MOTION_TIME = 1.0  # [s], correlation time of these errors: that of motions of a heavy machine
_MOTION_BANDWIDTH = 4.0  # [Hz], above that of hydraulic drives and below the vibrations of their oil columns and links
_POSE = re.compile(r"(?:(?P<run>[^@\s]+)@)?(?P<time>[-+.\deE]+)\s+(?P<values>.+)")
MAX_SD_RATIO = 0.7  # a parameter with a larger ratio of posterior to prior standard deviation is not identifiable


class KnownPose(NamedTuple):
    """Known joint positions [rad] or [m] at a time [s] of a run; `run` is "" if there is only one."""

    run: str
    time: float
    positions: Mapping[str, float]
    standard_deviation: float


class ImuCalibration(NamedTuple):
    """Result of a calibration.

    Attributes:
        machine: machine with the calibrated mounting, and the noise of the derived positions.
        sensors: name of its sensor set.
        chain: links and IMUs, with the values before the calibration.
        smoothed: parameters and joint motions.
        prior_sd: prior standard deviations of the parameters.
        logs: the logs with the derived positions and rates of the axes added.
        notes: assumptions and missing information, one sentence each.
    """

    machine: Machine
    sensors: str
    chain: ImuChain
    smoothed: SmoothedImus
    prior_sd: ImuParameters
    logs: tuple[Log, ...]
    notes: tuple[str, ...]


def parse_pose(text: str, standard_deviation: float) -> KnownPose:
    """Parse a known pose: `[RUN@]TIME AXIS=VALUE[deg] ...`.

    >>> parse_pose("dig@2.5 boom=0.45 stick=-90deg", 0.002).positions["boom"]
    0.45

    Raises:
        InputError: the text has another form.
    """
    try:
        match = _POSE.fullmatch(text.strip())
        assert match
        positions = {}
        for part in match["values"].replace(",", " ").split():
            name, value = part.split("=")
            factor = np.pi / 180.0 if value.endswith("deg") else 1.0
            positions[name] = factor * float(value.removesuffix("deg").removesuffix("rad"))
        return KnownPose(match["run"] or "", float(match["time"]), positions, standard_deviation)
    except (AssertionError, ValueError):
        message = f"{text!r} must be [RUN@]TIME AXIS=VALUE ..., such as '2.5 boom=30deg stick=-90deg'"
        raise InputError("--pose", message) from None


def find_imu_sensor_set(machine: Machine, name: str | None, logs: Sequence[Log]) -> str:
    """Return the name of the sensor set with IMUs: `name`, that of the logs' metadata, or the first one with IMUs.

    Raises:
        InputError: the set does not exist, or no set has an IMU.
    """
    if name is not None:
        get_sensor_set(machine, name)
        return name
    having = [n for n, s in machine.sensors.items() if any(m.type == "imu" for m in s.mounted.values())]
    stated = {log.metadata.get("sensors", IDEAL_SENSORS) for log in logs}
    if not having:
        message = "has no IMU: add sensors.SET.mounted entries of type imu with link, position and rotation"
        raise InputError(f"machine {machine.name}", message)
    return next((n for n in having if n in stated), having[0])


def calibrate_imus(
    paths: Sequence[Path], machine: Machine, sensors: str | None, poses: Sequence[KnownPose], slope_sd: float
) -> ImuCalibration:
    """Calibrate the IMUs of a machine from logs, and derive the joint positions.

    Args:
        paths: logs with the readings of the IMUs.
        machine: the machine with its sensor sets.
        sensors: name of the sensor set; None for that of the logs.
        poses: known joint positions.
        slope_sd: standard deviation of the slope under the machine [rad]; 0 for level ground.

    Raises:
        InputError: logs, machine and poses do not belong together.

    Examples:
        An IMU on the boom of an excavator, mounted with a rotation of 3 deg that the machine file does not know:

        >>> import math
        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> from hydrotele.machine.sensors import MountedSensor, SensorSet
        >>> def with_imu(rotation):
        ...     imu = MountedSensor(
        ...         link="boom", position=(2.5, 0.0, 0.9), rotation=rotation, gyro_noise=0.001, accelerometer_noise=0.02
        ...     )
        ...     sensors = {"imu": SensorSet(absent=("length",), mounted={"boom_imu": imu})}
        ...     return ht.load_machine("cat215").replace("sensors", sensors)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ht.save_machine(with_imu((0.0, math.radians(3.0), 0.0)), Path(folder, "true.yaml"))
        ...     overrides = {"machine": str(Path(folder, "true.yaml")), "sensors": "imu", "duration": "20"}
        ...     run = ht.run_scenario(ht.load_scenario("excitation_boom", overrides))
        ...     ht.save_log(run.measured, Path(folder, "run.parquet"))
        ...     found = calibrate_imus([Path(folder, "run.parquet")], with_imu((0.0, 0.0, 0.0)), None, [], 0.0)
        >>> [round(math.degrees(angle), 2) for angle in found.machine.sensors["imu"].mounted["boom_imu"].rotation]
        [-0.01, 2.98, -0.01]
    """
    logs = [log for run in read_runs(paths, machine, machine.log_columns, False) for log in run.logs]
    logs = [log for log in logs if any(c.startswith("gyro_") for c in log.columns)]
    if not logs:
        raise InputError(", ".join(map(str, paths)), "has no channels gyro_x.IMU, gyro_y.IMU, ... of an IMU")
    chosen = find_imu_sensor_set(machine, sensors, logs)
    facts = machine.sensors[chosen]
    present = {n: s for n, s in facts.mounted.items() if s.type == "imu" and any(f"gyro_x.{n}" in log for log in logs)}
    measured = [a for a in machine.axes if all(f"{machine.position_kind(a)}.{a}" in log for log in logs)]
    chain = build_imu_chain(machine, present, measured)
    _check_poses(poses, chain, logs)
    notes = [f"axis {name} has no IMU; its position is not estimated." for name in machine.axes
             if name not in chain.axes and name not in measured]  # fmt: skip
    runs, starts = [], []
    for log in logs:
        run = _make_run(log, machine, facts, chain, poses, len(logs))
        start = _estimate_start(chain, run)
        vertical = _find_vertical_axes(chain, start)
        notes += _add_rest(run, log, machine, chain, vertical, start)
        runs.append(run)
        starts.append(start)
    slow = [_filter_run(chain, run, start) for run, start in zip(runs, starts, strict=True)]
    mean, prior_sd, noise = _make_prior(chain, len(runs), slope_sd)
    smoothed = smooth_imus(chain, slow, starts, mean, prior_sd, noise, _relative_bandwidth(logs[0].time))
    complete = (_add_vibration(chain, run, motion, smoothed.parameters, k)
                for k, (run, motion) in enumerate(zip(runs, smoothed.runs, strict=True)))  # fmt: skip
    smoothed = smoothed._replace(runs=tuple(complete))
    calibrated = _write_parameters(machine, chosen, chain, smoothed, noise[:, 0], measured)
    rates = (_measured_rates(chain, run, smoothed.parameters, k) for k, run in enumerate(runs))
    derived = tuple(_add_positions(log, machine, chain, run.motion, rate, measured)
                    for log, run, rate in zip(logs, smoothed.runs, rates, strict=True))  # fmt: skip
    return ImuCalibration(calibrated, chosen, chain, smoothed, prior_sd, derived, tuple(dict.fromkeys(notes)))


def _check_poses(poses: Sequence[KnownPose], chain: ImuChain, logs: Sequence[Log]) -> None:
    names = [log.metadata.get("run", log.name) for log in logs]
    for pose in poses:
        if pose.run not in names and (pose.run or len(logs) > 1):
            raise InputError("--pose", f"run {pose.run!r} is not known; {suggest_valid_name(pose.run, names)}")
        for axis in pose.positions:
            if axis not in chain.axes:
                raise InputError("--pose", f"axis {axis!r} moves no IMU; {suggest_valid_name(axis, chain.axes)}")


def _make_run(
    log: Log, machine: Machine, sensors: SensorSet, chain: ImuChain, poses: Sequence[KnownPose], logs: int
) -> ImuRun:
    """Return the readings of a log and its known joint positions."""
    count, axes = len(log), len(chain.axes)
    empty = np.full(count, np.nan)
    kinds = [f"{kind}_{c}" for kind in ("gyro", "accelerometer") for c in "xyz"]
    readings = [[log[f"{k}.{n}"] if f"{k}.{n}" in log else empty for k in kinds] for n in chain.imus]
    position, deviation = np.full((axes, count), np.nan), np.full((axes, count), 1.0)
    for a, axis in enumerate(chain.axes):
        channel = f"{machine.position_kind(axis)}.{axis}"
        if channel in log:
            position[a] = log[channel]
            deviation[a] = find_channel_sensor(machine, sensors, channel).error_rms or _JOINT_NOISE
    name = log.metadata.get("run", log.name)
    for pose in poses:
        if pose.run == name or logs == 1:
            if not log.time[0] <= pose.time <= log.time[-1]:
                raise InputError("--pose", f"{pose.time:g} s is not in run {name}")
            row = int(np.argmin(np.abs(log.time - pose.time)))
            for axis, value in pose.positions.items():
                position[chain.axes.index(axis), row] = value
                deviation[chain.axes.index(axis), row] = pose.standard_deviation
    still, exact = np.full((axes, count), np.inf), np.zeros((len(readings), count))
    return ImuRun(name, log.time, np.array(readings), position, deviation, still, exact)


def _estimate_start(chain: ImuChain, run: ImuRun) -> np.ndarray:
    """Return initial joint positions (a, n): integrated rates, corrected slowly by the direction of gravity.

    Known positions, as of joint sensors and poses, are used where they exist.
    """
    start = np.zeros(run.position.shape)
    window = max(1, round(_GRAVITY_TIME / float(np.median(np.diff(run.time)))))
    for index, link in enumerate(chain.links):
        if link.axis < 0 or link.joint is None:
            continue
        known = np.isfinite(run.position[link.axis])
        if known.mean() > 0.5:
            start[link.axis] = np.interp(run.time, run.time[known], run.position[link.axis][known])
            continue
        imu = _imu_on_link(chain, index)
        assert imu is not None
        axis = np.array(link.joint.axis)
        frame = Rotation.from_rotvec(chain.sensors[imu].rotation).as_matrix()
        turned = _integrate_joint_rate(
            chain, run, index, np.zeros((len(chain.imus), 9)), np.zeros((len(chain.imus), 3))
        )
        up = _up_in_link(chain, link.parent, start)
        along = axis @ up
        if np.mean(np.abs(along)) > _VERTICAL_COSINE * np.linalg.norm(chain.gravity):
            offset = run.position[link.axis][known][0] - turned[known][0] if known.any() else 0.0
        else:
            force = frame @ run.readings[imu, 3:]
            sine = axis @ np.cross(force.T, up.T).T
            cosine = np.sum(force * up, axis=0) - (axis @ force) * along
            angle = np.arctan2(sine, cosine) - turned
            parts = np.array([_fill_gaps(run.time, part) for part in (np.cos(angle), np.sin(angle))])
            smooth = uniform_filter1d(parts, window, axis=1, mode="nearest")
            offset = np.unwrap(np.arctan2(smooth[1], smooth[0]))
        start[link.axis] = turned + offset
        if known.any():
            difference = run.position[link.axis][known][0] - start[link.axis][known][0]
            start[link.axis] += 2.0 * np.pi * np.round(difference / (2.0 * np.pi))
    return start


def _integrate_joint_rate(
    chain: ImuChain, run: ImuRun, index: int, mounting: np.ndarray, bias: np.ndarray
) -> np.ndarray:
    """Return the integral (n,) of the rate of the joint of a link."""
    relative = _fill_gaps(run.time, _joint_rate(chain, run, index, mounting, bias))
    return np.concatenate([[0.0], np.cumsum(0.5 * (relative[1:] + relative[:-1]) * np.diff(run.time))])


def _joint_rate(chain: ImuChain, run: ImuRun, index: int, mounting: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Return the rate (n,) of the joint of a link, from the gyros of the link and its parent.

    The component of an angular rate along the joint axis is the same in the axes of both links.
    """
    rates = []
    for imu in _imus_of_joint(chain, index):
        frame = Rotation.from_rotvec(chain.sensors[imu].rotation).as_matrix() @ rotation_from_parameters(
            mounting[imu, :3]
        )
        joint = chain.links[index].joint
        assert joint
        rates.append(np.array(joint.axis) @ frame @ (run.readings[imu, :3] - bias[imu][:, None]))
    return rates[0] - rates[1] if len(rates) == 2 else rates[0]


def _measured_rates(chain: ImuChain, run: ImuRun, found: ImuParameters, place: int) -> dict[int, np.ndarray]:
    """Return axis index -> joint rate (n,) that gyros measure with white noise, for hinges with an IMU."""
    return {
        link.axis: _joint_rate(chain, run, k, found.mounting, found.gyro_bias[place])
        for k, link in enumerate(chain.links) if _is_rate_measured(chain, k)
    }  # fmt: skip


def _imus_of_joint(chain: ImuChain, index: int) -> list[int]:
    """Return the IMUs on a link and on its parent, as far as there are any."""
    imus = (_imu_on_link(chain, place) for place in (index, chain.links[index].parent))
    return [imu for imu in imus if imu is not None]


def _is_rate_measured(chain: ImuChain, index: int) -> bool:
    """Return whether gyros measure the rate of a link's hinge: on the link, and on its parent or a fixed parent."""
    link = chain.links[index]
    if link.axis < 0 or link.joint is None or link.joint.type != "hinge" or _imu_on_link(chain, index) is None:
        return False
    return _imu_on_link(chain, link.parent) is not None or _is_fixed_to(chain, link.parent, -1)


def _imu_on_link(chain: ImuChain, index: int) -> int | None:
    """Return the index of an IMU on a link or fixed to it, or None; -1 is the fixed frame."""
    if index < 0:
        return None
    return next((k for k, place in enumerate(chain.imu_links) if _is_fixed_to(chain, place, index)), None)


def _filter_run(chain: ImuChain, run: ImuRun, start: np.ndarray) -> ImuRun:
    """Return a run with low-pass filtered readings, and the errors of the accelerometers in motion.

    The error is proportional to the accelerations of the links, which follow from the initial joint positions (a, n).
    It lasts as long as a motion, and the rows of one motion are no independent readings of it: as white noise, which
    the smoother assumes, it is larger by the root of the number of these rows.
    """
    slow = [_low_pass(run.time, q) for q in start]
    rates = [np.gradient(q, run.time) for q in slow]
    motion = np.array([slow, rates, [np.gradient(v, run.time) for v in rates]])
    still = motion * np.array([1.0, 0.0, 0.0])[:, None, None]
    stated = np.zeros((len(chain.imus), 9)), np.zeros(2)
    moving = predict_imu_readings(chain, motion, *stated) - predict_imu_readings(chain, still, *stated)
    rows = max(1.0, _MOTION_TIME / float(np.median(np.diff(run.time))))
    error = np.sqrt(rows) * _RELATIVE_ERROR * np.linalg.norm(moving[:, 3:], axis=1)
    readings = np.array([[_low_pass(run.time, v) for v in imu] for imu in run.readings])
    return run._replace(readings=readings, accelerometer_error=error)


def _relative_bandwidth(time: np.ndarray) -> float:
    """Return the bandwidth of the smoother relative to half the row rate, at most 1."""
    return min(1.0, 2.0 * _MOTION_BANDWIDTH * float(np.median(np.diff(time))))


def _low_pass(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (n,) without the content above the bandwidth of the joint motion; NaN remains NaN."""
    if (bandwidth := _relative_bandwidth(time)) == 1.0:
        return values
    sections = butter(4, bandwidth, output="sos")
    return np.where(np.isfinite(values), sosfiltfilt(sections, _fill_gaps(time, values)), np.nan)


def _add_vibration(
    chain: ImuChain, run: ImuRun, smoothed: SmoothedRun, found: ImuParameters, place: int
) -> SmoothedRun:
    """Return the motion of a run with the content above the bandwidth of the smoother, from the gyros."""
    motion = smoothed.motion.copy()
    for index, link in enumerate(chain.links):
        if link.axis < 0 or np.isfinite(run.position[link.axis]).mean() > 0.5:
            continue
        angle = _integrate_joint_rate(chain, run, index, found.mounting, found.gyro_bias[place])
        fast = angle - _low_pass(run.time, angle)
        motion[0, link.axis] += fast
        motion[1, link.axis] += np.gradient(fast, run.time)
    return smoothed._replace(motion=motion)


def _fill_gaps(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values)
    return np.interp(time, time[known], values[known]) if known.any() else np.zeros_like(values)


def _is_fixed_to(chain: ImuChain, place: int, index: int) -> bool:
    """Return whether a link is `index` itself, or is connected to it by links without joints."""
    while place >= 0 and place != index and chain.links[place].joint is None:
        place = chain.links[place].parent
    return place == index


def _up_in_link(chain: ImuChain, link: int, positions: np.ndarray) -> np.ndarray:
    """Return the specific force (3, n) at rest in the axes of a link, at joint positions (a, n)."""
    path = []
    while link >= 0:
        path.append(chain.links[link])
        link = path[-1].parent
    up = np.repeat(-chain.gravity[:, None], positions.shape[1], axis=1)
    for part in reversed(path):
        if part.joint and part.joint.type == "hinge":
            turns = Rotation.from_rotvec(np.outer(positions[part.axis], part.joint.axis))
            up = turns.inv().apply(up.T).T
    return up


def _find_vertical_axes(chain: ImuChain, start: np.ndarray) -> list[int]:
    """Return the indices of the axes along gravity, whose positions the specific forces do not determine."""
    return [
        link.axis for link in chain.links
        if link.joint and link.joint.type == "hinge" and np.mean(np.abs(np.array(link.joint.axis)
        @ _up_in_link(chain, link.parent, start))) > _VERTICAL_COSINE * np.linalg.norm(chain.gravity)
    ]  # fmt: skip


def _add_rest(
    run: ImuRun, log: Log, machine: Machine, chain: ImuChain, vertical: list[int], start: np.ndarray
) -> list[str]:
    """Add intervals at rest and the initial position of vertical axes to a run, in place; return notes."""
    notes = []
    for a in vertical:
        axis, known = chain.axes[a], np.isfinite(run.position[a])
        if not known.any():
            home = machine.home.get(machine.axes[axis].joint, 0.0)
            run.position[a, 0], run.position_sd[a, 0] = home, _START_SD
            start[a] += home - start[a, 0]
            notes.append(f"the axis of {axis} is vertical: its position is relative to {home:g} rad at the start"
                         " of each run; give it in --pose if it is known.")  # fmt: skip
        if known.mean() > 0.5:
            continue
        command = f"command.{axis}"
        if command not in log:
            notes.append(
                f"{log.name} has no {command}: the drift of {axis} is limited by the prior of the gyro bias only."
            )
            continue
        valve = machine.axes[axis].valve
        driven = np.abs(log[command]) > (valve.deadband if valve else 0.0)
        last = np.maximum.accumulate(np.where(driven, log.time, -np.inf))
        run.rest_rate_sd[a, log.time - last > _REST_TIME] = _REST_RATE_SD
        if np.isinf(run.rest_rate_sd[a]).all():
            notes.append(f"{log.name}: {axis} has no interval of more than {_REST_TIME:g} s without a command;"
                         " its drift is limited by the prior of the gyro bias only.")  # fmt: skip
    return notes


def _make_prior(chain: ImuChain, runs: int, slope_sd: float) -> tuple[ImuParameters, ImuParameters, np.ndarray]:
    """Return prior mean and standard deviations of the parameters, and the noise (s, 2) of the readings."""
    sensors = chain.sensors
    count = len(sensors)
    mean = ImuParameters(
        np.array([[0.0, 0.0, 0.0, *s.accelerometer_bias, 0.0, 0.0, 0.0] for s in sensors]), np.zeros(2),
        np.array([[s.gyro_bias for s in sensors]] * runs),
    )  # fmt: skip
    deviation = ImuParameters(
        np.array([3 * [s.rotation_sd] + 3 * [s.accelerometer_bias_sd] + 3 * [s.position_sd] for s in sensors]),
        np.full(2, slope_sd), np.array([[3 * [s.gyro_bias_sd] for s in sensors]] * runs),
    )  # fmt: skip
    noise = [(s.gyro_noise or _GYRO_NOISE, s.accelerometer_noise or _ACCELEROMETER_NOISE) for s in sensors]
    return mean, deviation, np.array(noise).reshape(count, 2)


def _write_parameters(
    machine: Machine, name: str, chain: ImuChain, smoothed: SmoothedImus, gyro_noise: np.ndarray,
    measured: Sequence[str],
) -> Machine:  # fmt: skip
    """Return the machine with calibrated mountings, biases, their uncertainties, and the noise of positions and rates.

    The errors of the derived positions are those of the sensors that the machine then has for the other axes than
    `measured`: noise with a correlation time, and an uncertain offset. Their rates are measured by gyros.
    """
    found, deviation = smoothed.parameters, smoothed.standard_deviations
    sensors = machine.sensors[name]
    mounted = dict(sensors.mounted)
    for k, imu in enumerate(chain.imus):
        stated = mounted[imu]
        rotation = Rotation.from_rotvec(stated.rotation) * Rotation.from_matrix(
            rotation_from_parameters(found.mounting[k, :3])
        )
        mounted[imu] = stated.model_copy(update={
            "rotation": tuple(map(float, rotation.as_rotvec())),
            "position": tuple(map(float, np.array(stated.position) + found.mounting[k, 6:])),
            "position_sd": float(deviation.mounting[k, 6:].max()),
            "accelerometer_bias": tuple(map(float, found.mounting[k, 3:6])),
            "gyro_bias": tuple(map(float, found.gyro_bias[:, k].mean(axis=0))),
            "rotation_sd": float(deviation.mounting[k, :3].max()),
            "accelerometer_bias_sd": float(deviation.mounting[k, 3:6].max()),
        })  # fmt: skip
    channels, uncertainty = dict(sensors.channels), dict(machine.uncertainty)
    for a, axis in enumerate(chain.axes):
        if axis in measured:
            continue
        noise, offset, time = (
            float(max(getattr(run, kind)[a] for run in smoothed.runs))
            for kind in ("noise", "offset", "correlation_time")
        )
        channels[f"{machine.position_kind(axis)}.{axis}"] = Sensor(standard_deviation=noise, correlation_time=time)
        prior = EFFECTS["angle_offset"].parameters(machine, axis)["offset"].prior_std
        uncertainty[f"angle_offset.{axis}"] = offset / prior
    for index, link in enumerate(chain.links):
        if _is_rate_measured(chain, index) and chain.axes[link.axis] not in measured:
            noise = float(np.linalg.norm(gyro_noise[_imus_of_joint(chain, index)]))
            channels[f"velocity.{chain.axes[link.axis]}"] = Sensor(standard_deviation=noise)
    made = sensors.model_copy(update={"mounted": mounted, "channels": channels})
    tilt = rotation_from_parameters(np.append(found.tilt, 0.0)).T
    gravity = tuple(map(float, tilt @ np.array(machine.gravity))) if found.tilt.any() else machine.gravity
    return machine.model_copy(
        update={"sensors": {**machine.sensors, name: made}, "gravity": gravity, "uncertainty": uncertainty}
    )


def _add_positions(
    log: Log, machine: Machine, chain: ImuChain, motion: np.ndarray, rates: Mapping[int, np.ndarray],
    measured: Sequence[str],
) -> Log:  # fmt: skip
    """Return a log with the derived positions and rates of the axes without a joint sensor.

    The rates are those of the gyros where there are any: unlike the smoothed ones, their errors are independent.
    """
    columns, units = dict(log.columns), dict(log.units)
    for a, axis in enumerate(chain.axes):
        kind = machine.position_kind(axis)
        unit = "rad" if kind == "angle" else "m"
        if axis not in measured:
            columns[f"{kind}.{axis}"], units[f"{kind}.{axis}"] = motion[0, a], unit
        columns[f"velocity.{axis}"], units[f"velocity.{axis}"] = rates.get(a, motion[1, a]), f"{unit}/s"
    return dataclasses.replace(log, columns=columns, units=units)
