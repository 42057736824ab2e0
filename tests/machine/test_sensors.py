"""Sensors: bounds, distribution, converter and independence of channels."""

import math

import numpy as np
import pytest
from scipy import stats

from hydrotele.core.errors import InputError
from hydrotele.machine.machine import find_channel_sensor, get_sensor_set, reading_noise_rms
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.sensors import Sensor, make_channel_converter
from hydrotele.run.run import prepare_run, run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.sensor_models import (
    create_feedback,
    quantise_readings,
    sample_sensor_errors,
    simulate_readings,
)
from hydrotele.simulate.stepping import Stepper


@pytest.fixture(scope="module")
def run():
    """40 s with all sensors."""
    return run_scenario(load_scenario("excitation"))


def sensor_of(run, channel):
    machine = run.plant.machine
    return find_channel_sensor(machine, get_sensor_set(machine, run.scenario.sensors), channel)


def measurable(run):
    return [c for c in run.measured.columns if not c.startswith("command.")]


def test_readings_stay_inside_bound_and_half_a_step(run):
    """Uniform error first, then rounding; nothing here reaches the end of a converter."""
    assert len(measurable(run)) == 12  # 3 angles, 2 lengths, 6 chambers, supply
    for channel in measurable(run):
        sensor, error = sensor_of(run, channel), run.measured[channel] - run.truth[channel]
        bound = sensor.accuracy + 0.5 * sensor.span / 2**sensor.bits
        assert np.abs(error).max() <= bound * (1 + 1e-9)
        assert np.abs(error).max() > 0.95 * bound  # 2000 samples come that close to the edge


def test_readings_are_on_the_converters_grid(run):
    for channel in measurable(run):
        sensor = sensor_of(run, channel)
        counts = run.measured[channel] / (sensor.span / 2**sensor.bits)
        # 1e-6: one reading is count * step, rounded once, of at most 2^14 counts.
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)


def test_scatter_is_that_of_the_specification(run):
    """README of the measured logs: 1.01 mrad, 1.16 mm, 99.5 kPa; 5 %: 2000 samples."""
    for channel in measurable(run):
        error = run.measured[channel] - run.truth[channel]
        kind = channel.split(".")[0].split("_")[0]
        expected = {"angle": 1.01e-3, "length": 1.16e-3, "pressure": 99.5e3}[kind]
        assert error.std() == pytest.approx(expected, rel=0.05)
        assert abs(error.mean()) < 4 * expected / math.sqrt(len(error))
        machine = run.plant.machine
        stated = reading_noise_rms(machine, get_sensor_set(machine, "khoshzaban1992"), channel)
        assert stated == pytest.approx(expected, rel=0.005)  # three digits are given


def test_errors_are_uniform():
    """Kolmogorov-Smirnov at p > 0.01 for one fixed seed; a normal distribution fails it."""
    sensor = Sensor(accuracy=2.0)
    errors = sample_sensor_errors(sensor, 7, "angle.boom", 20000)
    assert stats.kstest(errors, stats.uniform(-2.0, 4.0).cdf).pvalue > 0.01
    normal = np.random.default_rng(7).normal(0, 2.0 / math.sqrt(3), 20000)
    assert stats.kstest(normal, stats.uniform(-2.0, 4.0).cdf).pvalue < 1e-6


def test_errors_are_white_and_independent():
    """Correlations of 20000 samples stay below 4 / sqrt(n)."""
    sensor, n = Sensor(accuracy=1.0), 20000
    boom, stick = (sample_sensor_errors(sensor, 7, f"angle.{a}", n) for a in ("boom", "stick"))
    assert abs(np.corrcoef(boom, stick)[0, 1]) < 4 / math.sqrt(n)
    assert abs(np.corrcoef(boom[1:], boom[:-1])[0, 1]) < 4 / math.sqrt(n)
    other = sample_sensor_errors(sensor, 8, "angle.boom", n)
    assert abs(np.corrcoef(boom, other)[0, 1]) < 4 / math.sqrt(n)


def test_leaving_out_channels_changes_no_other():
    machine = load_machine("cat215")
    sensors = get_sensor_set(machine, "khoshzaban1992")
    names = ["angle.boom", "length.boom", "pressure_head.boom", "pressure_supply"]
    truth = {name: np.full(50, 0.5) for name in names}
    whole = simulate_readings(machine, sensors, 3, truth)
    for name in names:
        assert np.array_equal(simulate_readings(machine, sensors, 3, {name: truth[name]})[name], whole[name])


def test_longer_run_begins_like_the_shorter_one():
    sensor = Sensor(accuracy=1.0)
    longer = sample_sensor_errors(sensor, 3, "angle.boom", 100)
    assert np.array_equal(longer[:40], sample_sensor_errors(sensor, 3, "angle.boom", 40))


def test_converter_ends_and_goes_round():
    """Lengths and pressures end at 0 and the span; an angle goes on."""
    sensor, values = Sensor(bits=4, span=1.6), np.array([-0.3, 0.04, 0.06, 0.149, 9.0])
    clipped = quantise_readings(values, *make_channel_converter(sensor, "pressure_rod.boom"))
    np.testing.assert_allclose(clipped, [0, 0, 0.1, 0.1, 1.6], atol=1e-15)
    free = quantise_readings(values, *make_channel_converter(sensor, "angle.boom"))
    np.testing.assert_allclose(free, [-0.3, 0, 0.1, 0.1, 9], atol=1e-15)
    assert np.array_equal(quantise_readings(values, *make_channel_converter(Sensor(), "length.boom")), values)
    machine = load_machine("cat215")
    readings = simulate_readings(
        machine, get_sensor_set(machine, "khoshzaban1992"), 1,
        {"length.boom": np.array([-1.0, 5.0]), "pressure_head.boom": np.array([-1e6, 1e9]),
         "angle.swing": np.array([50.0, -50.0])},
    )  # fmt: skip
    assert readings["length.boom"].tolist() == [0.0, 1.05]
    assert readings["pressure_head.boom"].tolist() == [0.0, 5000 * 6894.757293168361]
    assert np.abs(readings["angle.swing"]).min() > 49


def test_length_spans_its_own_stroke():
    machine = load_machine("cat215", "bucket")
    sensors = get_sensor_set(machine, "khoshzaban1992")
    for axis in ("boom", "stick", "bucket"):
        stroke = machine.axes[axis].cylinder.stroke
        assert find_channel_sensor(machine, sensors, f"length.{axis}").span == stroke


def test_ideal_and_unknown_sensors():
    machine = load_machine("cat215")
    assert get_sensor_set(machine, "ideal") is None
    assert reading_noise_rms(machine, None, "angle.boom") == 0.0
    with pytest.raises(InputError, match="did you mean 'khoshzaban1992'"):
        get_sensor_set(machine, "khoshzaban92")


def test_slow_sensors_are_held_for_the_controller():
    """50 Hz sensors under a 200 Hz controller: four ticks see one reading, then a new one."""
    plant, data, _, seen, *_ = prepare_run(load_scenario("zhu_up"))
    assert seen.ticks_per_sample == 4 and seen.period == pytest.approx(0.02)
    readings, stepper = [], Stepper(plant, data, 5)
    for tick in range(9):
        data.qpos[plant.qpos] += 0.01
        seen.update(tick, stepper)
        readings.append(seen.joint.copy())
    assert np.ptp(readings[:4], axis=0).max() == 0.0 and np.ptp(readings[4:8], axis=0).max() == 0.0
    assert np.all(np.abs(readings[4] - readings[0] - 0.04) < 2 * np.radians(0.1) + 4e-4)
    np.testing.assert_allclose(seen.rate, (readings[8] - readings[4]) / 0.02, rtol=1e-12)


def test_the_log_shows_what_the_controller_saw():
    """Feedback and log share sampling, errors and converter, clipped pressures included."""
    scenario = load_scenario("steps", {"duration": "3.0"})
    plant, data, _, seen, *_ = prepare_run(scenario)
    seen.update(0, Stepper(plant, data, 5))
    log = run_scenario(scenario).measured
    for i, axis in enumerate(plant.axes):
        assert log[f"pressure_head.{axis}"][0] == seen.head[i]
        assert log[f"pressure_rod.{axis}"][0] == seen.rod[i]
        # the run's first row stands at the same instant, but after half a leapfrog step
        assert log[f"angle.{axis}"][0] == pytest.approx(seen.joint[i], abs=4e-4)


def test_a_log_faster_than_its_sensors_is_refused():
    with pytest.raises(InputError, match="sample rate 50 Hz must be a multiple of log_rate 200 Hz"):
        prepare_run(load_scenario("zhu_up", {"log_rate": "200"}))
    with pytest.raises(InputError, match="the sampling rate of 50 Hz must divide 125 Hz"):
        prepare_run(load_scenario("zhu_up", {"control_rate": "125", "log_rate": "25"}))


def test_a_drifting_sensor_warms_up_in_logs_and_in_what_the_controller_sees():
    """`e (1 - exp(-t / T))` on top of the true angle, of ideal sensors, to rounding."""
    given = {"drift": 0.02, "time_constant": 2.0}
    planted = [{"name": "angle_drift", "location": "boom", "parameters": given}]
    asked = load_scenario("hold", {"duration": "5", "sensors": "ideal"})
    run = run_scenario(type(asked).model_validate(asked.model_dump() | {"effects": planted}))
    time = run.truth.time
    more = run.measured["angle.boom"] - run.truth["angle.boom"]
    np.testing.assert_allclose(more, 0.02 * (1.0 - np.exp(-time / 2.0)), atol=1e-15)
    np.testing.assert_array_equal(run.measured["angle.stick"], run.truth["angle.stick"])
    seen = create_feedback(run.plant, None, 1, 250, 50.0).table
    boom = run.plant.axes.index("boom")
    shown = seen.sensors.offset[boom] + seen.errors[:250, boom]
    np.testing.assert_allclose(shown, 0.02 * (1.0 - np.exp(-np.arange(250) / 100.0)), atol=1e-15)
