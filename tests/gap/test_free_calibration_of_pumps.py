"""A pump drive whose data sheet is wrong in several places, calibrated by its free runs."""

import numpy as np
import pytest

from hydrotele.effects.effect import with_value
from hydrotele.estimate.free_run import free_run_errors, machine_runner
from hydrotele.estimate.hypothesis import numbers
from hydrotele.gap.calibrating import calibrate_freely
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.log import Log
from hydrotele.machine.machine_file import load_machine
from tests.estimate.test_pump_drive import CHANNELS, NOISE, PERIOD, simulated

DUTY = np.repeat([0.0, 0.7, 0.0, -0.5, 0.0, 0.5, 0.8, -0.6, 0.0], [220, 150, 50, 100, 50, 80, 60, 150, 40])
WRONG = {  # path -> factor: what the data sheet says over what is right
    "axes.piston.cylinder.area_rod": 1.12, "axes.piston.pump.motor.torque_constant": 1.2,
    "axes.piston.pump.motor.inertia": 2.0,
}  # fmt: skip


def dataset(machine, truth):
    shown, _ = simulated(truth, 10, DUTY[:, None])
    reading = shown + np.random.default_rng(8).normal(size=shown.shape) * NOISE
    run = RunData("made", 0.0, PERIOD, DUTY[:, None], np.ones(len(DUTY), bool), reading,
                  Log(time=PERIOD * np.arange(len(DUTY)), columns={}, units={}))  # fmt: skip
    return Dataset(machine, ("piston",), CHANNELS, NOISE, (run,), run, ())


def value(machine, path):
    for part in path.split("."):
        machine = machine[part] if isinstance(machine, dict) else getattr(machine, part)
    return machine


def _median_errors(machine, data):
    """Errors of open-loop predictions of the held-out run over 2.5 s, by channel."""
    errors = free_run_errors(machine_runner(machine, data)(data.heldout), data.heldout, (2.5,), to_end=False)
    return errors.horizons["2.5"].median


@pytest.mark.nightly
def test_wrong_figures_of_a_data_sheet_are_found():
    """Each within a third of what it was off by, of 9 s of motion; the rest stays uncertain."""
    truth = with_value(load_machine("eha", "load_30_bar"), "sensor_errors", {})
    sheet = truth
    for path, factor in WRONG.items():
        sheet = with_value(sheet, path, factor * value(truth, path))
    share = {"area.piston.area_rod": 0.1, "motor_constant": 0.2, "motor_inertia": 0.5}
    sheet = with_value(sheet, "uncertainty", share)
    data = dataset(sheet, truth)
    found = calibrate_freely(data, 1)
    assert found
    for path in WRONG:
        right, stated = value(truth, path), value(sheet, path)
        assert abs(value(found.machine, path) - right) < 0.34 * abs(stated - right), path
    # what is left uncertain is what the interval says, and the search begins with that
    before, after = numbers(sheet), numbers(found.machine)
    for key, told in found.numbers.items():
        scale, reach = after[key].parameter.prior_std, 1.96 * before[key].parameter.prior_std
        wide = told.high - told.low
        assert wide <= 2.0 * 1.96 * scale * (1.0 + 1e-6) and 1.96 * scale <= reach * (1.0 + 1e-6)
    assert after["area.piston.area_rod"].parameter.prior_std < 0.3 * (
        before["area.piston.area_rod"].parameter.prior_std
    )
    given, calibrated = (_median_errors(machine, data) for machine in (sheet, found.machine))
    assert np.mean(np.log(calibrated / given)) < np.log(0.5)  # on the held-out run
    assert calibrate_freely(dataset(with_value(sheet, "uncertainty", {}), truth), 1) is None


def test_runs_that_are_too_short_are_left_to_the_search():
    truth = load_machine("eha", "load_30_bar")
    short = dataset(truth, truth)
    part = short.fit[0].select_rows(0, 400)
    assert calibrate_freely(Dataset(truth, ("piston",), CHANNELS, NOISE, (part,), part, ()), 1) is (None)
