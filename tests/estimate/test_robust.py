"""Machines and logs of any size: small chambers, values outside a model's domain, filters that break down."""

import dataclasses
from contextlib import closing

import numpy as np
import pytest

from hydrotele.effects import Parameter, with_value
from hydrotele.estimate.evidence import Evidence, factor_information, flat, invert_information
from hydrotele.estimate.filter import mirror_lower_triangle, update_covariance
from hydrotele.estimate.free_run import free_run_errors, machine_runner
from hydrotele.estimate.hypothesis import DomainError, Guess, Hypothesis, hypotheses, limit_to_domain
from hydrotele.estimate.levels import (
    CannotFollowError,
    check_filter_follows,
    noise_prior,
    reading_resolution,
    rough_noise,
)
from hydrotele.estimate.output_error import fit_free_runs, flow_table
from hydrotele.estimate.reduced_model import state_names
from hydrotele.estimate.track import Levels, fine_enough, max_valve_drive_time_step, state_scales, track_run
from hydrotele.machine.machine_file import load_machine
from tests.small_machines import scale_machine, simulate_data

LENGTHS = ("length.boom", "length.stick", "angle.swing")
NOISE = {"length": 2e-5, "angle": 1e-3, "position": 5e-6, "pressure_head": 2e3, "pressure_rod": 2e3}


@pytest.fixture(scope="module")
def small():
    """The CAT 215 at 1:14, a radio-controlled excavator: chambers of 1 to 5 cm3, 20 bar, 1 N of friction."""
    machine = scale_machine(load_machine("cat215"), 1.0 / 14.0)
    return machine, simulate_data(machine, LENGTHS, NOISE)


@pytest.fixture(scope="module")
def rig():
    """The laboratory rig at 1:5, a cylinder of 8 x 100 mm at 28 bar."""
    machine = scale_machine(load_machine("rig"), 0.2)
    channels = ("position.slide", "pressure_head.slide", "pressure_rod.slide")
    return machine, simulate_data(machine, channels, NOISE, period=0.005)


def test_tables_of_states_hold_for_the_shipped_machines_and_shrink_for_small_ones(small):
    for name in ("cat215", "cat325", "rig", "ec20"):
        machine = load_machine(name)
        assert np.all(state_scales(machine, state_names(machine)) == 1.0)
        assert fine_enough(machine, 0.005) == 0.005, "their steps are as they were"
    machine, _ = small
    scales = dict(zip(state_names(machine), state_scales(machine, state_names(machine)), strict=True))
    assert scales["pressure_head.boom"] == pytest.approx(0.2)  # 2 of 10 MPa
    assert scales["rate.boom"] == 1.0
    # oil and mass ring 14 times as fast as those of the large machine
    assert max_valve_drive_time_step(machine) < 1e-3


@pytest.mark.nightly
def test_the_filter_starts_where_the_lengths_are(small):
    machine, data = small
    run = data.heldout
    moved = run.reading + np.array([5e-3, -8e-3, 0.0])  # not the home pose
    track = track_run(
        machine, data, dataclasses.replace(run, reading=moved), levels=Levels(np.array([2e-5, 2e-5, 1e-3]))
    )
    # the mean of the first readings: their noise, and the motion within 0.1 s
    assert track.predicted[0, :2] == pytest.approx(moved[0, :2], abs=3e-4)


def test_a_small_machine_is_followed_with_errors_of_the_size_of_its_noise(small):
    machine, data = small
    track = track_run(machine, data, data.heldout, levels=Levels(np.array([2e-5, 2e-5, 1e-3])))
    size = np.sqrt(np.mean(track.whitened[50:] ** 2, axis=0))
    assert np.all((size > 0.8) & (size < 1.2)), size  # 350 errors each: 4 standard deviations of the RMS


def test_a_small_rig_is_followed(rig):
    machine, data = rig
    track = track_run(machine, data, data.heldout, levels=Levels(np.array([5e-6, 2e3, 2e3])))
    size = np.sqrt(np.mean(track.whitened[50:] ** 2, axis=0))
    assert np.all((size > 0.7) & (size < 1.3)), size


@pytest.mark.nightly
def test_open_loop_predictions_start_from_lengths_without_stated_noise(small):
    machine, data = small
    runner = machine_runner(machine, data)(data.heldout)
    errors = free_run_errors(runner, data.heldout, (2.0,), to_end=False)
    assert runner.lost == ""
    # a drift of 1 mm in 2 s: the start rates are known to the noise over 0.1 s; the stroke is 75 mm
    assert np.all(errors.horizons["2"].rms[:2] < 1e-3)


@pytest.mark.parametrize("noise", [1e-30, 1e-12, 1.0])
def test_covariances_stay_positive_definite_whatever_the_noise(noise):
    """With noise below 1e-16 of the spread, `P - K H P` has negative variances by rounding."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(8, 8)) * np.logspace(-6, 6, 8)[:, None]  # states from micrometres to megapascal
    covariance, pull, gain = root @ root.T, np.zeros(8), np.zeros(8)
    for _ in range(40):
        slope = np.where(rng.random(8) < 0.4, rng.normal(size=8), 0.0)
        total = update_covariance(covariance, slope, noise, pull, gain)
        assert total > 0.0
        mirror_lower_triangle(covariance)
        sizes = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(sizes, sizes)
        assert np.linalg.eigvalsh(correlation)[0] > -1e-12  # rounding of the eigenvalues of a unit diagonal


def test_informations_of_any_condition_are_factorised_and_inverted():
    rng = np.random.default_rng(1)
    slopes = np.outer(rng.normal(size=50), np.logspace(0, 18, 6))  # one direction, 1e36 in the squares
    information = slopes.T @ slopes + np.eye(6)
    root = factor_information(information)
    np.testing.assert_allclose(root @ root.T, information, rtol=1e-9)  # the added ridge is 1e-12
    variances = np.diag(invert_information(information))
    assert np.all((variances > 0.0) & (variances <= 1.0 + 1e-9)), "no variance exceeds that of the prior"


def test_a_filter_that_breaks_down_has_no_likelihood_and_says_where(small):
    machine, data = small
    broken = with_value(machine, "links.boom.mass", -100.0)  # no mass matrix is positive definite
    track = track_run(broken, data, data.heldout)
    assert track.loss == np.inf
    assert np.all(np.abs(flat(track.whitened[-100:])) == 1e3)
    assert np.isnan(track.predicted[-1]).all() and np.isnan(track.states[-1]).all()
    with pytest.raises(CannotFollowError, match=r"cannot follow channel \S+: its one-step error is .* Likely reasons"):
        check_filter_follows((track,), data.channels)


def limited(limit):
    """A custom effect whose bounds leave the domain: more than `limit` of a dead band is refused."""

    def change(machine, values):
        if values["deadband"] > limit:
            raise ValueError("the spool has no more travel")
        return machine.replace("axes.boom.valve.deadband", values["deadband"])

    return Hypothesis("limited", "boom", {"deadband": Parameter("1", 0.04, 0.0, 5.0, 0.05, 0.01, (2.0,))}, change)


def test_values_outside_the_domain_have_zero_likelihood(small):
    machine, data = small
    truth = machine.replace("axes.boom.valve.deadband", 0.1)
    data = simulate_data(truth, LENGTHS, NOISE, model=machine, noise_stated=True)
    effect = limited(0.12)
    with pytest.raises(DomainError, match="limited at boom: deadband = 2.* the spool has no more travel"):
        effect.machine(machine, np.array([40.0]))
    with closing(Evidence(data, data.fit, 1)) as evidence:
        evidence.set_base(Guess())
        outside = Guess(((effect, np.array([40.0])),))
        assert np.all(np.abs(evidence.errors(outside)) == 1e3)
        assert evidence.judged(outside).loss == np.inf
        start = Guess(((effect, np.array([1.55])),))  # 0.1175; a step for the slope to 0.1185 is possible
        loss = float(np.sum(evidence.errors(start) ** 2))
        fit = evidence.fit(start, loss)
    (deviation,) = fit.guess.deviation
    # 0.1, by an interval of the fit: 20 s of noise of 0.02 mm tell a dead band to 0.001
    assert 0.04 + 0.05 * deviation == pytest.approx(0.1, abs=0.005)


def test_bounds_and_starts_are_moved_into_the_domain(small):
    machine, _ = small
    (effect,), errors = limit_to_domain([limited(0.12)], machine)
    assert not errors
    assert effect.parameters["deadband"].upper_bound == pytest.approx(0.12, abs=1e-4)
    assert effect.parameters["deadband"].start_values == pytest.approx((0.08,), abs=1e-4)  # half the way
    kept, (error,) = limit_to_domain([limited(-1.0)], machine)
    assert kept == [] and "no more travel" in str(error)


@pytest.mark.parametrize("name", ["ec20", "cat215", "rig", "emps"])
def test_every_effect_of_the_library_is_possible_up_to_its_bounds(name):
    """On a machine as shipped, and with flow tables that a calibration has bent to their ends."""
    machine = load_machine(name)
    for axis in machine.valve_axes:
        table = flow_table(machine, axis)
        machine = table.machine(machine, np.where(np.arange(table.size) % 2, table.low, 0.9 * table.high))
    kept, errors = limit_to_domain(hypotheses(machine), machine)
    assert not errors
    for hypothesis in kept:
        for ends in (hypothesis.low, hypothesis.high):
            for index in range(hypothesis.size):
                deviation = np.zeros(hypothesis.size)
                deviation[index] = ends[index]
                hypothesis.machine(machine, deviation)


def test_open_loop_fits_leave_out_values_outside_the_domain(small):
    machine, data = small
    truth = machine.replace("axes.boom.valve.deadband", 0.1)
    data = simulate_data(truth, LENGTHS, NOISE, model=machine)
    fit = fit_free_runs(data, Guess(((limited(0.07), np.zeros(1)),)), 2.0, most=3, max_iterations=2, jobs=1)
    value = 0.04 + 0.05 * fit.guess.deviation[0]
    assert 0.04 < value <= 0.07, "towards 0.1 as far as the domain goes"


def test_noise_is_bounded_by_the_resolution_of_the_readings(small):
    machine, data = small
    (run,) = data.fit
    step = np.array([1e-4, 1e-3, 1e-2])
    rounded = dataclasses.replace(run, reading=np.round(run.reading / step) * step)
    coarse = dataclasses.replace(data, fit=(rounded,))
    assert reading_resolution(coarse) == pytest.approx(step / np.sqrt(12.0), rel=1e-6)
    assert np.all(noise_prior(coarse).low >= step / np.sqrt(12.0) * (1 - 1e-9))
    still = dataclasses.replace(run, reading=np.zeros_like(run.reading))
    resolution = reading_resolution(dataclasses.replace(data, fit=(still,)))
    assert np.all(resolution > 1e-7)  # 2^-20 of a metre or a radian: never 1e-12 m
    reading = run.reading.copy()
    reading[np.arange(len(reading)) % 3 != 0, 0] = np.nan  # a sensor that is read at a third of the rate
    sparse = dataclasses.replace(data, fit=(dataclasses.replace(run, reading=reading),))
    # noise of 0.02 mm, made larger by the motion between its readings
    assert 1e-5 < rough_noise(sparse)[0] < 1e-4
