"""IMUs: mounting, biases and joint angles from readings that are computed from known joint motion."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from hydrotele.calibrate.imu_calibration import calibrate_imus, parse_pose
from hydrotele.calibrate.imu_model import build_imu_chain, predict_imu_readings, rotation_from_parameters
from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log, save_log
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.sensors import MountedSensor, SensorSet

POSITIONS = {"swing": (0.5, 0.3, 0.4), "boom": (2.5, 0.0, 0.9), "stick": (0.9, 0.1, 0.2)}
NOISE = {"gyro_noise": 0.001, "accelerometer_noise": 0.02}


def machine_with_imus(rng=None):
    """Return a CAT 215 with an IMU on each link; with a generator, mounted with errors."""
    sensors = {}
    for link, position in POSITIONS.items():
        errors: dict[str, Any] = {} if rng is None else {
            "rotation": tuple(rng.normal(0.0, 0.05, 3)), "gyro_bias": tuple(rng.normal(0.0, 0.005, 3)),
            "accelerometer_bias": tuple(rng.normal(0.0, 0.03, 3)),
        }  # fmt: skip
        sensors[f"{link}_imu"] = MountedSensor(link=link, position=position, **{**NOISE, **errors})
    return load_machine("cat215").replace("sensors", {"imu": SensorSet(absent=("angle", "length"), mounted=sensors)})


def joint_motion(time):
    """Return smooth joint motion (3, 3, n) of swing, boom and stick that rests for 5 s at both ends."""
    clock = np.clip((time - 5.0) / (time[-1] - 10.0), 0.0, 1.0)
    fade = np.where((clock > 0) & (clock < 1), np.sin(np.pi * clock) ** 4, 0.0)
    rows = [middle + half * np.sin(rate * time) * fade
            for middle, half, rate in ((0.2, 0.6, 0.5), (0.4, 0.3, 0.7), (-1.5, 0.5, 0.9))]  # fmt: skip
    q = np.array(rows)
    v = np.gradient(q, time, axis=1)
    return np.array([q, v, np.gradient(v, time, axis=1)])


def simulated_log(machine, rng, path):
    """Write a log of IMU readings; return the true joint positions."""
    time = np.arange(0.0, 40.0, 0.02)
    motion = joint_motion(time)
    sensors = machine.sensors["imu"].mounted
    chain = build_imu_chain(machine, sensors, [])
    mounting = np.array([[0.0, 0.0, 0.0, *s.accelerometer_bias, 0.0, 0.0, 0.0] for s in chain.sensors])
    readings = predict_imu_readings(chain, motion, mounting, np.zeros(2))
    columns, units = {}, {}
    for axis in chain.axes:
        columns[f"command.{axis}"], units[f"command.{axis}"] = np.where(np.abs(motion[1, 0]) > 1e-4, 0.3, 0.0), "1"
    for imu, sensor, values in zip(chain.imus, chain.sensors, readings, strict=True):
        for k, letter in enumerate("xyz"):
            noise = rng.normal(0.0, (NOISE["gyro_noise"], NOISE["accelerometer_noise"]), (len(time), 2))
            columns[f"gyro_{letter}.{imu}"] = values[k] + sensor.gyro_bias[k] + noise[:, 0]
            columns[f"accelerometer_{letter}.{imu}"] = values[3 + k] + noise[:, 1]
            units |= {f"gyro_{letter}.{imu}": "rad/s", f"accelerometer_{letter}.{imu}": "m/s^2"}
    log = Log(time, columns, units, {"machine": machine.name, "tool": "none", "sensors": "imu"}, str(path))
    save_log(log, path)
    return motion[0]


def test_joint_angles_and_mounting_are_recovered(tmp_path):
    rng = np.random.default_rng(5)
    truth = simulated_log(machine_with_imus(rng), rng, tmp_path / "motion.parquet")
    start = " ".join(f"{a}={q[0]}" for a, q in zip(POSITIONS, truth, strict=True))
    result = calibrate_imus([tmp_path], machine_with_imus(), None, [parse_pose(f"0 {start}", 1e-3)], 0.0)
    run = result.smoothed.runs[0]
    error = run.motion[0] - truth
    assert np.degrees(np.sqrt(np.mean(error**2, axis=1))).max() < 0.3  # the accuracy that the documentation states
    assert np.all(np.abs(error).max(axis=1) < 5.0 * np.hypot(run.noise, run.offset))
    assert np.all(run.residual_rms < 1.1)  # the motion is smooth, so that only noise remains
    assert set(result.logs[0].columns) > {"angle.swing", "angle.boom", "velocity.stick"}
    time, rates = result.logs[0].time, np.array([result.logs[0][f"velocity.{a}"] for a in POSITIONS])
    sensors = result.machine.sensors["imu"].channels
    stated = [sensors[f"velocity.{a}"].standard_deviation for a in POSITIONS]
    np.testing.assert_allclose(np.std(rates - joint_motion(time)[1], axis=1), stated, rtol=0.1)  # 2000 readings
    assert all(sensors[f"angle.{a}"].correlation_time > 1.0 for a in POSITIONS)  # smoothed over seconds


def test_offset_of_a_joint_needs_a_pose(tmp_path):
    rng = np.random.default_rng(6)
    truth = simulated_log(machine_with_imus(rng), rng, tmp_path / "motion.parquet")
    free = calibrate_imus([tmp_path], machine_with_imus(), None, [], 0.0)
    known = calibrate_imus([tmp_path], machine_with_imus(), None, [parse_pose(f"0 stick={truth[2, 0]}", 1e-3)], 0.0)
    assert free.smoothed.runs[0].offset[2] > 3.0 * known.smoothed.runs[0].offset[2]  # of 1 mrad
    assert any("swing is vertical" in note for note in free.notes)


def test_slope_of_the_ground_is_found_when_the_machine_swings(tmp_path):
    rng = np.random.default_rng(7)
    machine = machine_with_imus()
    tilt = rotation_from_parameters(np.array([0.03, -0.02, 0.0])).T
    sloping = machine.model_copy(update={"gravity": tuple(tilt @ np.array(machine.gravity))})
    truth = simulated_log(sloping, rng, tmp_path / "motion.parquet")
    start = " ".join(f"{a}={q[0]}" for a, q in zip(POSITIONS, truth, strict=True))
    result = calibrate_imus([tmp_path], machine, None, [parse_pose(f"0 {start}", 1e-3)], 0.05)
    error = result.smoothed.parameters.tilt - [0.03, -0.02]
    assert np.all(np.abs(error) < 4.0 * result.smoothed.standard_deviations.tilt)
    assert result.smoothed.standard_deviations.tilt.max() < 0.01  # a fifth of the prior
    np.testing.assert_allclose(result.machine.gravity, sloping.gravity, atol=0.2)


def test_missing_imu_of_a_link_is_an_error(tmp_path):
    rng = np.random.default_rng(8)
    simulated_log(machine_with_imus(rng), rng, tmp_path / "motion.parquet")
    machine = machine_with_imus()
    mounted = {n: s for n, s in machine.sensors["imu"].mounted.items() if n != "boom_imu"}
    sensors = machine.sensors["imu"].model_copy(update={"mounted": mounted})
    with pytest.raises(InputError, match="boom has neither an IMU"):
        calibrate_imus([tmp_path], machine.model_copy(update={"sensors": {"imu": sensors}}), None, [], 0.0)


def test_joint_sensor_replaces_an_imu(tmp_path):
    rng = np.random.default_rng(9)
    truth = simulated_log(machine_with_imus(rng), rng, tmp_path / "a.parquet")
    from hydrotele.logs.log import load_log

    log = load_log(tmp_path / "a.parquet")
    columns = {**log.columns, "angle.swing": truth[0]}
    save_log(
        dataclasses.replace(log, columns=columns, units={**log.units, "angle.swing": "rad"}), tmp_path / "a.parquet"
    )
    result = calibrate_imus([tmp_path], machine_with_imus(), None, [], 0.0)
    assert not any("vertical" in note for note in result.notes)
    assert np.degrees(np.abs(result.smoothed.runs[0].motion[0, 0] - truth[0]).max()) < 0.1  # noise of 2 mrad, smoothed


@pytest.mark.parametrize("text", ["boom=1", "1.0 boom", "x@ boom=1", "1 boom=abc"])
def test_invalid_pose_is_refused(text):
    with pytest.raises(InputError, match="--pose"):
        parse_pose(text, 1e-3)
