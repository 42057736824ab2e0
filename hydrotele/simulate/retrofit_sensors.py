"""Readings of retrofitted sensors: IMUs, inclination, pilot pressures, measured flow, load pressure.

MuJoCo computes angular rates and accelerations of the links from the recorded states.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from hydrotele.machine.machine import find_channel_sensor, rate_channels
from hydrotele.machine.sensors import MountedSensor, Sensor, SensorSet, make_channel_converter
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import Record
from hydrotele.simulate.sensor_models import quantise_readings, sample_sensor_errors


class LinkMotion(NamedTuple):
    """Motion of links in n states, in the axes of each link; b links.

    Attributes:
        rate: (n, b, 3) angular rate [rad/s].
        acceleration: (n, b, 3) angular acceleration [rad/s^2].
        force: (n, b, 3) specific force at the origin of the link frame [m/s^2].
    """

    rate: np.ndarray
    acceleration: np.ndarray
    force: np.ndarray


def compute_link_motion(model: mujoco.MjModel, record: Record, bodies: list[int]) -> LinkMotion:
    """Compute the motion of bodies from recorded positions, velocities and accelerations.

    The specific force is the acceleration minus gravity, as an accelerometer measures it.
    """
    data = mujoco.MjData(model)
    velocity, acceleration = np.empty(6), np.empty(6)
    motion = LinkMotion(*np.empty((3, len(record.time), len(bodies), 3)))
    kind = mujoco.mjtObj.mjOBJ_XBODY
    for row in range(len(record.time)):
        data.qpos[:], data.qvel[:] = record.qpos[row], record.qvel[row]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        data.qacc[:] = record.qacc[row]
        mujoco.mj_rnePostConstraint(model, data)
        for k, body in enumerate(bodies):
            mujoco.mj_objectVelocity(model, data, kind, body, velocity, 1)
            mujoco.mj_objectAcceleration(model, data, kind, body, acceleration, 1)
            motion.rate[row, k], motion.acceleration[row, k] = velocity[:3], acceleration[:3]
            fixed = model.body_weldid[body] == 0  # MuJoCo returns 0 for these bodies
            motion.force[row, k] = data.xmat[body].reshape(3, 3).T @ -model.opt.gravity if fixed else acceleration[3:]
    return motion


def simulate_retrofit_readings(
    plant: Plant, sensors: SensorSet, record: Record, truth: dict[str, np.ndarray], seed: int
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Simulate the readings of the retrofitted sensors of a sensor set.

    Args:
        plant: the simulated plant.
        sensors: the sensor set.
        record: recorded states of the run, at uniform times.
        truth: channel -> (n,) true values (`true_channels`).
        seed: the scenario's seed.

    Returns:
        (channel -> (n,) readings in SI, channel -> unit).
    """
    period = float(record.time[1] - record.time[0]) if len(record.time) > 1 else 0.0
    readings, units = _simulate_scalar_readings(plant, sensors, truth, len(record.time), seed, period)
    names = list(dict.fromkeys(sensor.link for sensor in sensors.mounted.values()))
    if names:
        motion = compute_link_motion(plant.model, record, [plant.model.body(name).id for name in names])
    for name, sensor in sensors.mounted.items():
        k = names.index(sensor.link)
        values = mounted_sensor_values(sensor, motion.rate[:, k], motion.acceleration[:, k], motion.force[:, k], period)
        for channel in sensor.channels(name):
            noise = Sensor(standard_deviation=sensor.noise(channel))
            values_of = _add_random_error(noise, channel, values[channel.partition(".")[0]], seed, period)
            readings[channel] = _hold_readings(values_of, sensor.rate, period)
            units[channel] = "rad/s" if channel.startswith("gyro") else "rad"
            if channel.startswith("accelerometer"):
                units[channel] = "m/s^2"
    return readings, units


def mounted_sensor_values(
    sensor: MountedSensor, rate: np.ndarray, acceleration: np.ndarray, force: np.ndarray, period: float
) -> dict[str, np.ndarray]:
    """Return the values of a mounted sensor without random errors, by kind of channel.

    Args:
        sensor: the sensor; its biases are added.
        rate: (n, 3) angular rate of the link [rad/s].
        acceleration: (n, 3) angular acceleration of the link [rad/s^2].
        force: (n, 3) specific force at the origin of the link frame [m/s^2].
        period: time between rows [s], for the low-pass filter of angles.
    """
    arm = np.array(sensor.position)
    moved = force + np.cross(acceleration, arm) + np.cross(rate, np.cross(rate, arm))
    axes = Rotation.from_rotvec(sensor.rotation).as_matrix()
    gyro, specific = rate @ axes + sensor.gyro_bias, moved @ axes + sensor.accelerometer_bias
    x, y, z = specific.T
    angles = {
        "inclination": np.unwrap(np.arctan2(x, z)),
        "roll": np.unwrap(np.arctan2(y, z)),
        "pitch": np.arctan2(-x, np.hypot(y, z)),
    }
    if sensor.time_constant and period:
        from scipy.signal import lfilter  # starts slowly

        kept = np.exp(-period / sensor.time_constant)
        angles = {n: lfilter([1 - kept], [1, -kept], v, zi=[kept * v[0]])[0] for n, v in angles.items()}
    values = {name: angle + sensor.angle_bias for name, angle in angles.items()}
    for k, letter in enumerate("xyz"):
        values[f"gyro_{letter}"], values[f"accelerometer_{letter}"] = gyro[:, k], specific[:, k]
    return values


def _simulate_scalar_readings(
    plant: Plant, sensors: SensorSet, truth: dict[str, np.ndarray], rows: int, seed: int, period: float
):
    """Return the readings of joint rates, flows, load-sensing pressure and pilot pressures, and their units."""
    valves, values = plant.machine.valve_axes, {}
    for channel in rate_channels(plant.machine):
        if sensors.velocity or channel in sensors.channels:
            sensor, axis = find_channel_sensor(plant.machine, sensors, channel), channel.partition(".")[2]
            unit = "rad/s" if plant.machine.position_kind(axis) == "angle" else "m/s"
            values[channel] = sensor, truth[f"truth.{channel}"], unit
    if sensors.flow:
        for axis in valves:
            values[f"flow.{axis}"] = sensors.flow, truth[f"truth.flow_head.{axis}"], "m^3/s"
    if sensors.pressure_ls and valves:
        fed = [
            np.where(truth[f"truth.spool.{a}"] > 0.0, truth[f"pressure_head.{a}"], truth[f"pressure_rod.{a}"])
            * (np.abs(truth[f"command.{a}"]) > axis.valve.deadband)
            for a, axis in valves.items()
            if axis.valve
        ]
        values["pressure_ls"] = sensors.pressure_ls, np.max(fed, axis=0), "Pa"
    if sensors.pilot_pressure:
        span = sensors.pilot_pressure.span or 0.0
        for axis in valves:
            for side, sign in (("a", 1.0), ("b", -1.0)):
                pressure = span * np.clip(sign * truth[f"command.{axis}"], 0.0, 1.0)
                values[f"pilot_pressure_{side}.{axis}"] = sensors.pilot_pressure, pressure, "Pa"
    if sensors.oil_temperature and plant.machine.oil:
        temperature = np.full(rows, plant.machine.oil.temperature)
        values["oil_temperature"] = sensors.oil_temperature, temperature, "degC"
    readings = {channel: _add_random_error(s, channel, v, seed, period) for channel, (s, v, _) in values.items()}
    return readings, {channel: unit for channel, (_, _, unit) in values.items()}


def _add_random_error(sensor: Sensor, channel: str, values: np.ndarray, seed: int, period: float) -> np.ndarray:
    if not (sensor.error_rms or sensor.bits):
        return values
    errors = sample_sensor_errors(sensor, seed, channel, len(values), period)
    return quantise_readings(values + errors, *make_channel_converter(sensor, channel))


def _hold_readings(values: np.ndarray, rate: float | None, period: float) -> np.ndarray:
    """Return values (n,) that change only when a sensor of this rate [Hz] has a new reading."""
    if rate is None or rate * period >= 1.0:
        return values
    rows = np.arange(len(values))
    last = np.floor(np.floor(rows * period * rate + 1e-9) / (rate * period) + 1e-9).astype(int)
    return values[last]
