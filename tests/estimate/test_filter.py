"""The filter: white errors of size 1 on clean data, missing readings, kept gains."""

import dataclasses

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.estimate.reduced_model import (
    model_space,
    predicted_channels,
    reduced_model,
    simulate_rows,
    state_names,
)
from hydrotele.estimate.track import steps_per_row, track_run
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.log import Log
from hydrotele.machine.machine_file import load_machine

PERIOD, ROWS = 0.02, 600


def machine_data(machine, truth, seed=0, twist=0.0):
    """Readings of `truth` with the sensors' noise, as a dataset of the model `machine`.

    `twist` is how far the drives of transmissions stand ahead of their loads at first.
    """
    channels = predicted_channels(machine)
    axes = tuple(actuator_order(machine))
    time = PERIOD * np.arange(ROWS)
    command = np.column_stack([0.4 * np.sin((1.1 + 0.4 * k) * time + k) for k in range(len(axes))])
    model = reduced_model(truth, channels)
    names = state_names(truth)
    state = np.zeros(len(names))
    for s, name in enumerate(names):
        kind, _, place = name.partition(".")
        if kind == "position":
            state[s] = machine.home.get(place, 0.0)
        elif kind.startswith("pressure"):
            state[s] = 6e6
        elif kind == "drive":
            state[s] = twist
    shown, states = np.empty((ROWS, len(channels))), np.empty((ROWS, len(names)))
    simulate_rows(model, model_space(model), state, command, PERIOD, 20, shown, states)
    sizes = {"angle": 1e-3, "position": 1e-3, "length": 1.2e-3}
    noise = np.array([sizes.get(c.partition(".")[0], 1e5) for c in channels])
    error = np.random.default_rng(seed).uniform(-1, 1, shown.shape) * np.sqrt(3) * noise
    log = Log(time=time, columns={}, units={})
    known = np.ones(ROWS, bool)
    run = RunData("made", 0.0, PERIOD, command, known, shown + error, log)
    return Dataset(machine, axes, channels, noise, (run,), run, ()), states


@pytest.fixture(scope="module")
def clean():
    machine = load_machine("cat215")
    return machine_data(machine, machine)


def test_clean_errors_are_white_and_of_size_one(clean):
    data, _ = clean
    w = track_run(data.machine, data, data.heldout).whitened[50:]
    # 550 uniform errors: the RMS scatters by sqrt(0.8/550)/2 = 0.02, the correlation by 0.043
    assert np.sqrt(np.mean(w**2, axis=0)) == pytest.approx(np.ones(w.shape[1]), abs=0.08)
    echo = np.mean(w[1:] * w[:-1], axis=0)
    assert np.all(np.abs(echo) < 4.5 * 0.043)


def test_states_are_nearer_to_the_truth_than_the_readings(clean):
    data, truth = clean
    found = track_run(data.machine, data, data.heldout).states
    names = state_names(data.machine)
    for s, name in enumerate(names):
        if name.startswith("pressure"):
            error = np.sqrt(np.mean((found[100:, s] - truth[100:, s]) ** 2))
            assert error < 0.6e5, name  # of the 1e5 Pa of a reading


def test_kept_gains_give_the_same_errors_again(clean):
    data, _ = clean
    first = track_run(data.machine, data, data.heldout)
    again = track_run(data.machine, data, data.heldout, first)
    np.testing.assert_allclose(again.whitened, first.whitened, atol=1e-9)  # rounding


def test_missing_readings_are_left_out(clean):
    data, _ = clean
    reading = data.heldout.reading.copy()
    gone = np.random.default_rng(1).random(reading.shape) < 0.3
    gone[:5] = False
    reading[gone] = np.nan
    run = dataclasses.replace(data.heldout, reading=reading)
    w = track_run(data.machine, data, run).whitened
    assert np.array_equal(np.isnan(w), gone)
    assert np.sqrt(np.nanmean(w[50:] ** 2)) == pytest.approx(1.0, abs=0.04)


@pytest.mark.daily("valve_deadband-boom-values0", "pressure_offset-stick.rod-values2")
@pytest.mark.parametrize(
    ("name", "place", "values"),
    [
        ("valve_deadband", "boom", {"deadband": 0.07}),
        ("payload", "tool", {"mass": 200.0}),
        ("pressure_offset", "stick.rod", {"offset": 2e5}),
        ("angle_offset", "boom", {"offset": 0.01}),
    ],
)
def test_the_true_machine_has_the_smallest_errors(clean, name, place, values):
    nominal = load_machine("cat215")
    truth = apply_effect(nominal, name, place, values)
    data, _ = machine_data(nominal, truth, seed=3)
    wrong = track_run(nominal, data, data.heldout)
    right = track_run(truth, data, data.heldout)
    assert right.loss < wrong.loss - 100.0  # twice the log likelihood: beyond any chance
    assert np.sqrt(np.mean(right.whitened[50:] ** 2)) == pytest.approx(1.0, abs=0.04)


@pytest.mark.daily("backlash-swing-values0")
@pytest.mark.parametrize(
    ("name", "place", "values"),
    [
        ("backlash", "swing", {"gap": 0.01}),
        ("joint_flexibility", "boom", {"compliance": 2e-8}),
    ],
)
def test_a_transmission_adds_states_that_gains_without_it_can_carry(clean, name, place, values):
    data, _ = clean
    rigid = track_run(data.machine, data, data.heldout)
    soft = apply_effect(data.machine, name, place, values)
    other = track_run(soft, data, data.heldout, rigid)
    assert np.isfinite(other.whitened).all()
    assert np.sum(other.whitened**2) > np.sum(rigid.whitened**2) + 30.0
    back = track_run(data.machine, data, data.heldout, track_run(soft, data, data.heldout))
    assert np.isfinite(back.whitened).all()


@pytest.mark.daily("pressure_delay-boom-0.034-0.00023")
@pytest.mark.parametrize(
    ("name", "place", "delay", "sd"),
    [
        ("pressure_delay", "boom", 0.0149, 0.23e-3),
        ("pressure_delay", "boom", 0.0340, 0.23e-3),
        ("angle_delay", "stick", 0.0270, 0.19e-3),
    ],
)
def test_the_delay_of_late_readings_is_found_without_bias(name, place, delay, sd):
    """The likelihood is a parabola over the delay; `sd` is its width for these 12 s."""
    nominal = load_machine("cat215")
    late = [apply_effect(nominal, name, place, {"delay": delay + d}) for d in (-1e-3, 0.0, 1e-3)]
    data, _ = machine_data(nominal, late[1])
    below, there, above = (track_run(m, data, data.heldout) for m in late)
    curvature = (above.loss + below.loss - 2.0 * there.loss) / 1e-3**2
    lowest = -(above.loss - below.loss) / (2.0 * 1e-3) / curvature
    assert 1.0 / np.sqrt(0.5 * curvature) == pytest.approx(sd, rel=0.3)
    assert abs(lowest) < 3.0 * sd
    assert np.sqrt(np.mean(there.whitened[50:] ** 2)) == pytest.approx(1.0, abs=0.04)


@pytest.mark.daily("1.0")
@pytest.mark.parametrize("rest", [pytest.param(-1.0, marks=pytest.mark.nightly), -0.45, 1.0])
def test_a_drive_may_rest_anywhere_in_its_backlash(rest):
    gap = 0.012
    machine = apply_effect(load_machine("cat215"), "backlash", "swing", {"gap": gap})
    data, _ = machine_data(machine, machine, seed=5, twist=0.5 * rest * gap)
    track = track_run(machine, data, data.heldout)
    # 1 mrad of noise over the 5 rows of the start is 0.07 of half the gap
    assert track.rest == pytest.approx([rest], abs=0.2)
    w = track.whitened[20:]
    assert np.sqrt(np.mean(w**2)) == pytest.approx(1.0, abs=0.04)
    assert np.abs(w).max() < 6.0  # no reading is a surprise; from a wrong rest some are 20


def lagging(machine):
    """Transducers with a first-order lag, one of them behind a delay of more than a row."""
    for name, place, values in (
        ("pressure_lag", "boom", {"time_constant": 0.012}),
        ("pressure_delay", "boom", {"delay": 0.0335}),
        ("angle_lag", "stick", {"time_constant": 0.03}),
    ):
        machine = apply_effect(machine, name, place, values)
    return machine


@pytest.mark.parametrize("first", [0, 200])
def test_errors_of_lagging_transducers_are_white_and_of_size_one(first):
    """From rest and from the middle of a motion; limits as of the clean machine."""
    machine = lagging(load_machine("cat215"))
    data, _ = machine_data(machine, machine, seed=7)
    run = dataclasses.replace(
        data.heldout, command=data.heldout.command[first:], reading=data.heldout.reading[first:],
        command_known=data.heldout.command_known[first:],
    )  # fmt: skip
    w = track_run(machine, data, run).whitened[50:]
    n = len(w)
    assert np.sqrt(np.mean(w**2, axis=0)) == pytest.approx(np.ones(w.shape[1]), abs=1.9 / n**0.5)
    assert np.all(np.abs(np.mean(w[1:] * w[:-1], axis=0)) < 4.5 / n**0.5)


@pytest.mark.daily("angle_lag-boom-0.03")
@pytest.mark.parametrize(
    ("name", "place", "constant"),
    [
        ("pressure_lag", "boom", 0.012),
        ("pressure_lag", "swing", 0.004),
        ("angle_lag", "boom", 0.03),
    ],
)
def test_a_time_constant_is_found_without_bias(name, place, constant):
    """The likelihood is a parabola over the time constant; three of its widths are allowed."""
    nominal = load_machine("cat215")
    slow = [apply_effect(nominal, name, place, {"time_constant": constant + d}) for d in (-1e-3, 0.0, 1e-3)]
    data, _ = machine_data(nominal, slow[1], seed=2)
    below, there, above = (track_run(m, data, data.heldout) for m in slow)
    curvature = (above.loss + below.loss - 2.0 * there.loss) / 1e-3**2
    lowest = -(above.loss - below.loss) / (2.0 * 1e-3) / curvature
    assert curvature > 0.0 and 1.0 / np.sqrt(0.5 * curvature) < 1e-3  # it is seen to 1 ms
    assert abs(lowest) < 3.0 / np.sqrt(0.5 * curvature)


def test_a_vanishing_time_constant_is_none():
    """1 us against none: what a step of 1 ms changes in it is beyond any noise."""
    nominal = load_machine("cat215")
    data, _ = machine_data(nominal, nominal)
    quick = apply_effect(nominal, "pressure_lag", "boom", {"time_constant": 1e-6})
    none, some = (track_run(m, data, data.heldout) for m in (nominal, quick))
    assert some.loss == pytest.approx(none.loss, abs=0.5)


def test_gains_carry_a_lag_that_only_one_of_two_machines_has(clean):
    data, _ = clean
    prompt, slow = data.machine, lagging(data.machine)
    for first, second in ((prompt, slow), (slow, prompt)):
        other = track_run(second, data, data.heldout, track_run(first, data, data.heldout))
        assert np.isfinite(other.whitened).all()


def test_what_bristles_and_a_slow_pump_remember_is_estimated():
    """States behind the activations: estimated, linearised, and carried by gains without them."""
    plain = load_machine("rig")
    machine = apply_effect(plain, "presliding", "slide", {"compliance": 4e-7})
    machine = apply_effect(machine, "pump_lag", "supply", {"time_constant": 0.1})
    data, truth = machine_data(machine, machine)
    track = track_run(machine, data, data.heldout, linearise=True)
    assert np.isfinite(track.loss)
    assert np.isfinite(track.flow[:-1]).all()  # the last row goes nowhere
    # 600 readings of five channels; where the piston turns round the filter is not quite linear
    assert np.sqrt(np.nanmean(track.whitened[50:] ** 2)) == pytest.approx(1.0, abs=0.08)
    names = state_names(machine)
    assert names[-2:] == ["bristle.slide", "delivery.supply"]
    error = np.abs(track.states[50:, -2:] - truth[50:, -2:])
    assert np.median(error[:, 0]) < 0.2 and np.median(error[:, 1]) < 0.02
    assert track.states[:, -2].max() <= 1.0 and track.states[:, -1].min() >= 0.0
    given = track_run(plain, data, data.heldout)
    assert np.isfinite(track_run(machine, data, data.heldout, given).whitened).all()
    assert np.isfinite(track_run(plain, data, data.heldout, track).whitened).all()
    assert given.loss > track.loss + 30.0


def test_a_drive_that_rests_in_the_middle_of_its_backlash_is_not_looked_for_again(monkeypatch):
    """A track remembers where it rested, the middle (0) as well; NaN says that nobody looked."""
    machine = apply_effect(load_machine("cat215"), "backlash", "swing", {"gap": 0.01})
    data, _ = machine_data(machine, machine)
    run, searches = data.heldout.select_rows(0, 5), []

    def find(loss, free):
        searches.append(free)
        return np.zeros(len(free))

    monkeypatch.setattr("hydrotele.estimate.track.find_rest", find)
    first = track_run(machine, data, run)
    assert len(searches) == 1
    assert track_run(machine, data, run, rest=first.rest).rest == 0.0
    assert len(searches) == 1
    track_run(machine, data, run, rest=np.full(1, np.nan))
    assert len(searches) == 2


def test_steps_resolve_a_drive_on_its_spring_and_oil_and_are_no_finer_than_needed():
    """The drive of the swing's teeth rings at 44 Hz on steel and oil: a step is 0.94 rad of it."""
    machine = load_machine("cat215")
    teeth = apply_effect(machine, "backlash", "swing", {"gap": 0.01})
    swing, supply = teeth.axes["swing"], teeth.supply
    assert swing.motor and swing.transmission and supply
    oil = 2.0 * supply.bulk_modulus * swing.motor.displacement**2 / swing.motor.dead_volume
    rate = np.sqrt((swing.transmission.stiffness + oil) / swing.transmission.inertia)
    assert rate == pytest.approx(2.0 * np.pi * 43.7, rel=1e-2)
    assert steps_per_row(teeth, 0.02, 1e-3) == 20, "what is asked for is finer"
    assert steps_per_row(teeth, 0.02, 5e-3) == np.ceil(0.02 * rate / 0.94) == 6
    assert steps_per_row(machine, 0.02, 5e-3) == 4, "nothing rings"
