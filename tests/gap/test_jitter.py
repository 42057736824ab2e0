"""Instants that jitter: found where they do, and only there, whatever the model lacks."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from hydrotele.effects import apply_effect
from hydrotele.effects.effect import with_value
from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess
from hydrotele.estimate.levels import with_jitter
from hydrotele.gap.find import find_gap
from hydrotele.gap.result import gap_document
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.log import Log, save_log
from hydrotele.machine.machine import get_sensor_set, reading_noise_rms
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.sensor_models import simulate_readings

SITE, JITTER = "khoshzaban1992", 0.003


@pytest.fixture(scope="module")
def truth():
    """12 s of the CAT 215 without sensors."""
    return run_scenario(load_scenario("excitation").model_copy(update={"duration": 12.0})).truth


def dataset(truth, machine, folder, jitter: float):
    """The same run read three times, by a spline at instants that are off, with normal noise."""
    for number in range(3):
        rng = np.random.default_rng(number)
        at = truth.time + jitter * rng.normal(size=len(truth))
        columns = {}
        for name in truth.columns:
            if name.startswith("truth."):
                continue
            columns[name] = truth[name]
            if not name.startswith("command."):
                sigma = reading_noise_rms(machine, get_sensor_set(machine, SITE), name)
                shown = CubicSpline(truth.time, truth[name])(at)
                columns[name] = shown + sigma * rng.normal(size=len(at))
        units = {name: truth.units[name] for name in columns}
        metadata = {**truth.metadata, "sensors": SITE}
        save_log(Log(truth.time, columns, units, metadata), folder / f"fit_{number}.parquet")
    return load_dataset(folder, machine, sensors=SITE)


def levels(data):
    """Levels of the given machine."""
    evidence = Evidence(data, data.fit, 2, lacking=True)
    try:
        tracks = evidence.set_base(Guess()).tracks
        again = with_jitter(evidence.data, data.machine, tracks)
        assert again[0].levels.jitter == pytest.approx(tracks[0].levels.jitter, rel=0.05)
        return tracks[0].levels
    finally:
        evidence.close()


def test_jitter_and_noise_are_told_apart(truth, tmp_path):
    data = dataset(truth, load_machine("cat215"), tmp_path, JITTER)
    found = levels(data)
    # 600 rows of two runs and a dozen channels tell it to 2 %; five times that
    assert found.jitter == pytest.approx(JITTER, rel=0.1)
    np.testing.assert_allclose(found.noise, data.noise, rtol=0.15)  # 3.3 standard deviations


@pytest.mark.nightly
@pytest.mark.parametrize("stated", [0.0, 0.002])
def test_a_steady_clock_is_left_alone(truth, tmp_path, stated):
    machine = with_value(load_machine("cat215"), f"sensors.{SITE}.jitter", stated)
    assert levels(dataset(truth, machine, tmp_path, 0.0)).jitter == 0.0


@pytest.mark.nightly
@pytest.mark.parametrize("name, place, values", [
    ("bulk_modulus", "all", {"bulk_modulus": 1.4e9}),
    ("angle_delay", "boom", {"delay": 0.02}),
])  # fmt: skip
def test_what_a_model_lacks_is_not_taken_for_jitter(truth, tmp_path, name, place, values):
    """Its errors grow with the rates as well, but the channels ask for different times."""
    wrong = apply_effect(load_machine("cat215"), name, place, values)
    assert levels(dataset(truth, wrong, tmp_path, 0.0)).jitter == 0.0


@pytest.mark.nightly
@pytest.mark.xfail(
    strict=True, reason="jitter is estimated once, with the given machine (docs/gap_method.md, section 8)"
)
def test_jitter_that_another_lack_hides_is_found_with_it(truth, tmp_path):
    """An angle delay of 150 ms, which the given machine has, hides the jitter."""
    wrong = apply_effect(load_machine("cat215"), "angle_delay", "boom", {"delay": 0.15})
    data = dataset(truth, wrong, tmp_path, JITTER)
    assert levels(data).jitter == 0.0
    gap = find_gap(data, effects=("angle_delay", "valve_gain"))
    assert [(e.name, e.location) for e in gap.effects] == [("angle_delay", "boom")]
    late = gap.effects[0].parameters["delay"]
    assert late.value < 3.0 * (late.high - late.low) / (2.0 * 1.96)  # it is read at once
    found = gap_document(gap)["jitter"]
    assert found["stated"] == 0.0 and found["found"] == pytest.approx(JITTER, rel=0.1)
    assert gap.patched.sensors[SITE].jitter == found["found"]
    assert any("jitter" in note for note in gap.notes)


def test_a_logger_that_jitters_reads_all_channels_at_its_own_instants():
    machine = load_machine("cat215")
    sensors = get_sensor_set(machine, SITE)
    assert sensors
    plain = type(sensors)(jitter=0.004)
    ramp = np.linspace(0.0, 2.0, 201)  # 1 unit/s
    truth = {"angle.boom": ramp, "angle.stick": 3.0 * ramp}
    read = simulate_readings(machine, plain, 5, truth, period=0.01)
    late = read["angle.boom"] - ramp
    np.testing.assert_allclose(read["angle.stick"] - 3.0 * ramp, 3.0 * late, atol=1e-12)
    # 201 draws: the spread of a standard deviation is 5 %; four times that
    assert np.std(late[1:-1]) == pytest.approx(0.004, rel=0.2)
    assert np.array_equal(simulate_readings(machine, plain, 5, truth)["angle.boom"], ramp)  # no clock
