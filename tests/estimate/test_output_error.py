"""Fits to free runs: what was planted comes out, tables never fall, linkages still close."""

from types import SimpleNamespace

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.estimate.hypothesis import Guess
from hydrotele.estimate.output_error import (
    TRAVEL,
    _covariance,
    _normal_equations,
    fit_free_runs,
    flow_table,
    free_run_windows,
    linkage,
    stretched,
    timing,
    uncertain_parameters,
)
from hydrotele.kinematics.drive_linkage import axis_linkage, joint_range_at_drive
from hydrotele.logs.dataset import RunData, load_dataset
from hydrotele.logs.log import Log, save_log
from hydrotele.machine.drives import FlowCurve, Metering
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario


@pytest.mark.parametrize("machine", ["cat215", "ec20", "emps"])
def test_nominal_numbers_change_nothing(machine):
    nominal = load_machine(machine)
    assert uncertain_parameters(nominal).machine(nominal) == nominal


def test_numbers_have_the_priors_that_the_machine_states():
    stated = {"delay": 0.02, "linkage.stick": 0.3}
    machine = load_machine("ec20").model_copy(update={"uncertainty": stated})
    found = {(h.name, h.location): h.parameters for h, _ in uncertain_parameters(machine).parts}
    assert found["timing", "boom"]["delay"].prior_std == 0.02
    assert found["linkage", "stick"]["base"].prior_std == 0.3
    assert found["linkage", "boom"]["base"].prior_std == 0.15


def test_a_stretched_table_keeps_its_shape_and_never_falls():
    present = Metering(curve=FlowCurve(travel=(0.0, 0.5, 1.0), opening=(0.0, 0.2, 1.0)))
    logs = np.array([-5.0, 2.5, -5.0, 0.0, 2.5])
    assert np.all(np.diff(stretched(present, logs).opening) > 0.0)
    same = stretched(present, np.zeros(len(TRAVEL) - 1))
    assert same.opening == pytest.approx(np.interp(TRAVEL, (0.0, 0.5, 1.0), (0.0, 0.2, 1.0)))
    twice = stretched(present, np.full(len(TRAVEL) - 1, np.log(2.0)))
    assert twice.opening == pytest.approx(2.0 * np.array(same.opening))


@pytest.mark.parametrize("axis", ["boom", "stick"])
def test_a_moved_linkage_keeps_the_joint_between_the_same_ends(axis):
    machine = load_machine("ec20")
    hypothesis = linkage(machine, axis)
    moved = hypothesis.change(machine, {"base": 0.1, "rod": 0.05, "angle": 0.05})
    before, after = joint_range_at_drive(machine, axis), joint_range_at_drive(moved, axis)
    old, new = machine.axes[axis].cylinder, moved.axes[axis].cylinder
    assert after[0] == pytest.approx(before[0], abs=1e-12)
    assert new.stroke - after[1] == pytest.approx(old.stroke - before[1], abs=1e-12)
    # an independent linkage: two bars about the joint, and the angle between them
    here, there = axis_linkage(machine, axis), axis_linkage(moved, axis)
    low, high = machine.joints[machine.axes[axis].joint].range
    rates = [k.rate(0.5 * (low + high)) for k in (here, there)]
    assert rates[1] != pytest.approx(rates[0], rel=0.02)
    type(moved).model_validate(moved.model_dump())


def made_run(reading, period=0.02):
    rows = len(reading)
    log = Log(time=period * np.arange(rows), columns={}, units={})
    known = np.ones(rows, bool)
    return RunData("made", 0.0, period, np.zeros((rows, 1)), known, reading, log)


def test_windows_leave_out_what_stands_still():
    reading = np.zeros((3000, 1))
    reading[1000:1500, 0] = np.linspace(0.0, 1.0, 500)
    reading[1500:] = 1.0
    windows = free_run_windows([made_run(reading)], 5.0)
    assert {w.first for w in windows} == {850, 1100, 1350}  # from 100 (2 s) every 250 rows
    assert len(free_run_windows([made_run(reading)], 5.0, most=2)) == 2
    with pytest.raises(InputError, match="contain no interval of 7 s with motion"):
        free_run_windows([made_run(reading[:300])], 5.0)


def test_a_guess_without_parameters_is_refused(planted):
    with pytest.raises(InputError, match="no parameters to fit"):
        fit_free_runs(planted, Guess())


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    """Three runs of the MuJoCo plant of an EC20 with a late, slow valve that opens at 30 %."""
    folder = tmp_path_factory.mktemp("planted")
    effects = [
        {"name": "command_delay", "location": "boom", "parameters": {"delay": 0.12}},
        {"name": "valve_deadband", "location": "boom", "parameters": {"deadband": 0.30}},
    ]
    time = np.arange(0.0, 20.0, 0.1)
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        held = np.repeat(rng.uniform(-0.8, 0.8, (1 + len(time) // 8, 2)), 8, axis=0)[: len(time)]
        scenario = Scenario(
            name=f"run{seed}", machine="ec20", control_rate=50, log_rate=50, duration=20.0,
            ground=False, seed=seed, sensors="record", effects=effects,
            pilot={
                "kind": "table", "quantity": "command", "interpolate": "hold", "time": time.tolist(),
                "columns": {"boom": held[:, 0].tolist(), "stick": held[:, 1].tolist()},
            },
        )  # fmt: skip
        save_log(run_scenario(scenario).measured, folder / f"run{seed}.parquet")
    return load_dataset(folder, load_machine("ec20"))


@pytest.mark.nightly
def test_a_planted_delay_and_dead_band_come_out_of_angles_alone(planted):
    """The plant is MuJoCo's, the fit the reduced model's; no accuracy is stated.

    The delay to 20 ms, the refresh of the log. The table is to close what the dead band closes:
    at 20 % command less than a tenth of the machine's own opening is left.
    """
    machine = planted.machine
    parts = (timing(machine, "boom"), flow_table(machine, "boom"))
    guess = Guess(tuple((part, np.zeros(part.size)) for part in parts))
    fit = fit_free_runs(planted, guess, most=12, max_iterations=30)
    assert fit.converged and np.all(fit.deviation_sd < 1.0 + 1e-9)
    boom = fit.machine.axes["boom"]
    assert boom.command_delay == pytest.approx(0.12, abs=0.02)
    for way, deadband in zip(("positive", "negative"), boom.valve.deadbands, strict=True):
        curve, travel = getattr(boom.valve, way).curve, (0.2 - deadband) / (1.0 - deadband)
        assert np.interp(travel, curve.travel, curve.opening) < 0.015
    assert fit.after[0] < 0.3 * fit.before[0]


def test_windows_that_contradict_each_other_widen_intervals():
    """The least squares' own scatter over 400 sets of windows, each pulled its own way."""
    rng, windows = np.random.default_rng(5), [SimpleNamespace(count=50)] * 40
    weights, scale = np.ones((2000, 1)), np.ones(1)
    columns = np.repeat(rng.normal(size=40), 50)[:, None, None] + rng.normal(size=(2000, 1, 1))
    pulls = rng.normal(scale=0.3, size=(400, 40))
    covariance, found = [], []
    for pull in pulls:
        error = columns[:, :, 0] * np.repeat(pull, 50)[:, None]
        guess = SimpleNamespace(deviation=np.zeros(1))
        slope, curvature = _normal_equations(SimpleNamespace(errors=error, guess=guess), columns, weights, scale)
        guess.deviation = -np.linalg.solve(curvature, slope)
        left = error + columns @ guess.deviation
        point = SimpleNamespace(errors=left, guess=guess)
        covariance.append(_covariance(point, columns, weights, scale, windows)[0, 0])
        found.append(guess.deviation[0])
    assert np.mean(covariance) == pytest.approx(np.var(found), rel=0.25)
    assert np.linalg.inv(curvature)[0, 0] < 0.3 * np.var(found)  # by curvature alone
