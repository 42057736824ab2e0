"""Retrofitted sensors: MuJoCo's motion agrees with the chain model, and angles follow gravity."""

import numpy as np
import pytest

from hydrotele.calibrate.imu_model import build_imu_chain, predict_imu_readings
from hydrotele.logs.dataset import make_dataset
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.machine.oil import Oil, kinematic_viscosity
from hydrotele.machine.oil_temperature import with_oil_temperature
from hydrotele.machine.sensors import MountedSensor, Sensor, SensorSet
from hydrotele.run.run import run_scenario
from hydrotele.scenario.pilots import ConstantPilot
from hydrotele.scenario.scenario import Scenario
from hydrotele.simulate.plant import build_plant
from hydrotele.simulate.record import Record
from hydrotele.simulate.retrofit_sensors import compute_link_motion, mounted_sensor_values
from hydrotele.simulate.sensor_models import sample_sensor_errors


def test_imu_readings_of_mujoco_agree_with_the_chain_model():
    rng = np.random.default_rng(1)
    sensors = {
        link: MountedSensor(link=link, position=tuple(rng.normal(0, 1, 3)), rotation=tuple(rng.normal(0, 1, 3)))
        for link in ("swing", "boom", "stick")
    }
    machine = load_machine("cat215")
    plant = build_plant(machine)
    chain, rows = build_imu_chain(machine, sensors, []), 20
    motion = rng.normal(0.0, 1.0, (3, 3, rows))
    states = {"qpos": np.zeros((rows, plant.model.nq)), "qvel": np.zeros((rows, plant.model.nv))}
    states["qacc"] = np.zeros((rows, plant.model.nv))
    for a, axis in enumerate(chain.axes):
        joint = plant.model.joint(machine.axes[axis].joint)
        for key, values in zip(states, motion[:, a], strict=True):
            states[key][:, joint.qposadr[0] if key == "qpos" else joint.dofadr[0]] = values
    empty = np.zeros((rows, 0))
    record = Record(np.arange(rows) * 0.02, **states, act=empty, command=empty, contact=empty, load=np.zeros(rows),
                    contact_of={}, tip=empty,
                    delayed_readings=empty)  # fmt: skip
    found = compute_link_motion(plant.model, record, [plant.model.body(name).id for name in sensors])
    expected = predict_imu_readings(chain, motion, np.zeros((3, 9)), np.zeros(2))
    for k, sensor in enumerate(chain.sensors):
        values = mounted_sensor_values(sensor, found.rate[:, k], found.acceleration[:, k], found.force[:, k], 0.02)
        kinds = [f"{kind}_{c}" for kind in ("gyro", "accelerometer") for c in "xyz"]
        np.testing.assert_allclose([values[kind] for kind in kinds], expected[k], atol=1e-9)


def test_inclination_is_the_sum_of_the_joint_angles_at_rest():
    machine = load_machine("cat215")
    chain = build_imu_chain(machine, {"s": MountedSensor(link="stick"), "b": MountedSensor(link="boom"),
                                      "w": MountedSensor(link="swing")}, [])  # fmt: skip
    motion = np.zeros((3, 3, 1))
    motion[0, :, 0] = 0.3, 0.4, -1.0
    force = predict_imu_readings(chain, motion, np.zeros((3, 9)), np.zeros(2))[0, 3:].T
    still = np.zeros((1, 3))
    values = mounted_sensor_values(MountedSensor(type="inclination", link="stick"), still, still, force, 0.02)
    assert values["inclination"][0] == pytest.approx(0.4 - 1.0)
    assert values["pitch"][0] == pytest.approx(0.6)
    assert values["roll"][0] == pytest.approx(0.0, abs=1e-12)


MACHINE = """
name: cat215
extends: {machine: cat215, tool: none}
oil: {temperature: 40}
sensors:
  site:
    rate: 50
    absent: [angle, length]
    mounted:
      boom_imu: {link: boom, gyro_noise: 0.001}
      chassis: {type: tilt, link: world, rotation_deg: [2, 0, 0]}
      slew: {type: gyro, link: swing, rate: 10, gyro_noise: 0.001}
    flow: {standard_deviation_l_min: 0.5}
    pressure_ls: {}
    pilot_pressure: {span_bar: 30}
    oil_temperature: {standard_deviation: 0.5}
"""


def test_run_writes_the_sensors_of_the_set(tmp_path):
    (tmp_path / "machine.yaml").write_text(MACHINE)
    run = run_scenario(Scenario(
        name="site", machine=str(tmp_path), sensors="site", duration=2.0, control_rate=50.0, ground=False,
        oil_temperature=60.0, pilot=ConstantPilot(kind="constant", commands={"boom": -0.4, "swing": 0.3})))  # fmt: skip
    log, truth = run.measured, run.truth
    assert not any(c.startswith(("angle", "length")) for c in log.columns)
    assert "angle.boom" in truth
    np.testing.assert_allclose(log["roll.chassis"], np.radians(2.0), atol=1e-9)
    np.testing.assert_allclose(log["pilot_pressure_b.boom"], 1.2e6)
    np.testing.assert_array_equal(log["pilot_pressure_a.boom"], 0.0)
    assert np.std(log["flow.boom"] - truth["truth.flow_head.boom"]) == pytest.approx(0.5e-3 / 60, rel=0.3)
    assert log["oil_temperature"].mean() == pytest.approx(60.0, abs=0.3)
    assert np.max(log["pressure_ls"]) > 1e6
    held = log["gyro_z.slew"].reshape(-1, 5)  # 10 Hz in rows of 50 Hz
    assert np.all(held == held[:, :1])
    viscous = {m.axes["boom"].hydraulic_drive.friction.viscous for m in (run.plant.machine, load_machine("cat215"))}
    assert min(viscous) / max(viscous) == pytest.approx(kinematic_viscosity(Oil(), 60.0) / 46e-6)


def test_viscosity_follows_walther_and_is_reversible():
    oil = Oil()
    assert kinematic_viscosity(oil, 100.0) == pytest.approx(6.8e-6)
    machine = load_machine("cat215").replace("oil", oil)
    warm = with_oil_temperature(machine, 60.0)
    ratio = kinematic_viscosity(oil, 60.0) / kinematic_viscosity(oil, 40.0)
    assert warm.axes["boom"].hydraulic_drive.friction.viscous == pytest.approx(ratio * 6000.0)
    assert warm.axes["boom"].hydraulic_drive.leakage == pytest.approx(2e-12 / ratio)
    back = with_oil_temperature(warm, 40.0)
    assert back.axes["boom"].hydraulic_drive.friction.viscous == pytest.approx(6000.0)


def test_joint_rates_and_correlated_errors_are_logged_and_used(tmp_path):
    sensors = {"velocity": {"standard_deviation": 2e-3}, "absent": ["length"], "pressure": {"accuracy_bar": 1.0},
               "angle": {"standard_deviation": 1e-3, "correlation_time": 0.5}}  # fmt: skip
    machine = load_machine("cat215").replace("sensors", {"site": SensorSet.model_validate(sensors)})
    save_machine(machine, tmp_path / "machine.yaml")
    pilot = {"kind": "constant", "commands": {"boom": 0.4}}
    scenario = {"name": "lift", "machine": str(tmp_path), "duration": 8.0, "control_rate": 50.0, "pilot": pilot}
    logs = []
    for seed in (1, 2):
        run = run_scenario(Scenario.model_validate({**scenario, "seed": seed, "sensors": "site"}))
        logs.append(RunFiles(f"lift_{seed}", (run.measured,)))
        error = run.measured["velocity.boom"] - run.truth["truth.velocity.boom"]
        assert np.std(error) == pytest.approx(2e-3, rel=0.15)  # 400 readings: 3.5 % is one standard deviation
    data = make_dataset(logs, machine)
    count = np.isfinite(data.fit[0].reading).sum(axis=0)
    assert "velocity.boom" in data.channels and count[data.channels.index("velocity.boom")] == len(data.fit[0].reading)
    assert count[data.channels.index("angle.boom")] == pytest.approx(8.0 / 0.5, abs=1)


def test_correlated_errors_have_the_stated_correlation():
    sensor = Sensor(standard_deviation=2.0, correlation_time=0.4)
    errors = sample_sensor_errors(sensor, 3, "angle.boom", 200_000, 0.02)
    assert np.std(errors) == pytest.approx(2.0, rel=0.03)  # 5 000 independent errors: 1 % is one standard deviation
    later = np.mean(errors[20:] * errors[:-20]) / np.var(errors)
    assert later == pytest.approx(np.exp(-1.0), abs=0.04)
