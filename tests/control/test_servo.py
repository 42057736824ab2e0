"""Servo: the opening that keeps a piston's force, dead band, limits, closed loops that follow."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hydrotele.control.servo import (
    ComputedForce,
    DriveReference,
    MeasuredState,
    compute_valve_opening,
    servo_parameters,
    servo_step,
)
from hydrotele.hydraulics.actuator_layout import actuator_parameters
from hydrotele.hydraulics.circuit import Slot, chamber_flows
from hydrotele.hydraulics.laws import valve_opening
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario, Servo

CAT = load_machine("cat215", "bucket")
AXES = ("swing", "boom", "stick", "bucket")
SUPPLY, TANK = 28.0e6, 0.3e6


@given(
    axis=st.sampled_from(AXES),
    velocity=st.floats(1e-3, 0.3) | st.floats(-0.3, -1e-3),
    head=st.floats(2e6, 20e6),
    rod=st.floats(2e6, 20e6),
    place=st.floats(0.0, 1.0),
)
def test_opening_keeps_the_force(axis, velocity, head, rod, place):
    """`A_h p_A' = A_r p_B'` with the simulator's own orifices at that opening.

    1e-9 of either term: orifices are smoothed over d = 50 kPa in the machine, over 1 Pa here.
    """
    user = actuator_parameters(CAT)[axis]
    user[Slot.ORIFICE_SMOOTHING] = 1.0
    area_head, area_rod = user[Slot.AREA_HEAD], user[Slot.AREA_ROD]
    volume_head = user[Slot.VOLUME_HEAD] + area_head * place * user[Slot.STROKE]
    volume_rod = user[Slot.VOLUME_ROD] + area_rod * (1 - place) * user[Slot.STROKE]
    opening = compute_valve_opening(
        velocity, head, rod, SUPPLY, TANK, area_head, area_rod, volume_head, volume_rod,
        user[Slot.FLOW_GAIN],
    )  # fmt: skip
    assert math.copysign(1, opening) == math.copysign(1, velocity)
    into_head, into_rod, _, _ = chamber_flows(user, 0, opening, SUPPLY, head, rod)
    push = area_head / volume_head * (into_head - area_head * velocity)
    hold = area_rod / volume_rod * (into_rod + area_rod * velocity)
    size = area_head / volume_head * (abs(into_head) + area_head * abs(velocity))
    assert push == pytest.approx(hold, abs=1e-9 * size)


def test_opening_is_bounded_where_the_valve_has_nothing_to_drive():
    """Both chambers at the supply pressure: finite, and monotone in the wanted velocity."""
    opening = [
        compute_valve_opening(v, SUPPLY, TANK, SUPPLY, TANK, 0.02, 0.013, 0.01, 0.01, 2e-6)
        for v in np.linspace(-0.2, 0.2, 41)
    ]
    assert np.all(np.isfinite(opening)) and np.all(np.diff(opening) > 0)


def one_step(axis, servo=None, error=0.0, velocity=0.0, arm=1.0, rate=0.0, load=None):
    """Command of one axis in one control period of 5 ms, at rest but for what is given."""
    numbers = servo_parameters(CAT, AXES, servo or Servo(), 0.005)
    k = AXES.index(axis)
    full = lambda value: np.full(4, float(value))  # noqa: E731 - a name for a long expression
    head, rod = full(5e6), full(4e6)
    forces = numbers[:, 1] * head - numbers[:, 2] * rod
    out, reference = np.full(4, 0.123), full(0.0)
    reference[k] = error
    servo_step(
        numbers, np.arange(4) == k,
        DriveReference(full(velocity), full(arm), full(0.02), full(0.02)), reference,
        MeasuredState(full(0.0), full(rate), head, rod, np.array([SUPPLY])),
        forces if load is None else load * forces, ComputedForce(False, full(0.0), full(0.0)), out,
    )  # fmt: skip
    assert np.all(np.delete(out, k) == 0.123)  # what is not under feedback keeps its command
    return out[k]


@pytest.mark.parametrize("axis", AXES)
def test_dead_band_compensation_is_monotone_and_continuous(axis):
    """Over small errors the command crosses the dead band without a jump, beyond it exactly.

    Largest slope: db / 0.005 of the blended jump plus that of the opening itself.
    """
    errors = np.linspace(-0.02, 0.02, 1001)
    command = np.array([one_step(axis, error=e) for e in errors])
    assert np.all(np.diff(command) > 0.0) and one_step(axis) == 0.0
    gain = (one_step(axis, error=0.02) - one_step(axis, error=0.01)) / 0.01
    deadband = CAT.axes[axis].valve.deadband
    steepest = gain / (1 - deadband) * (1 + deadband / 0.005)
    assert np.diff(command).max() < 1.2 * steepest * 4e-5
    # Beyond three widths of the blend, tanh(3) = 0.995: the valve opens as without a dead band.
    plain = np.array([one_step(axis, Servo(deadband_compensation=0.0), error=e) for e in errors])
    opened = np.array([valve_opening(c, deadband) for c in command])
    large = np.abs(plain) > 0.015
    assert large.any()
    np.testing.assert_allclose(opened[large], plain[large], atol=0.005 * deadband / 0.96 + 1e-9)


@pytest.mark.parametrize("axis", AXES)
def test_saturation(axis):
    for error in (1e3, -1e3, 1e300):
        assert one_step(axis, error=error) == math.copysign(1.0, error)


def test_sign_of_the_feedback():
    """A joint short of its reference is driven towards it, whichever way its piston acts."""
    for arm in (0.5, -0.5):
        assert math.copysign(1, one_step("stick", error=0.01, arm=arm)) == math.copysign(1, arm)
    assert one_step("boom", velocity=0.1) > one_step("boom", velocity=0.05) > 0
    assert one_step("boom", load=0.9) < 0.0  # more force than on average: give way
    assert one_step("boom", load=1.1) > 0.0
    assert one_step("boom", Servo(pressure_feedback=0.0), load=0.9) == 0.0


@pytest.mark.parametrize("tool", ["none", "bucket", "grapple"])
def test_every_axis_goes_where_it_is_told(tool):
    """Small joint steps of both signs: 90 % done after a second; no axis runs away.

    The boom rings at 2.5 Hz, so that the mean over one of its periods counts.
    """
    machine = load_machine("cat215", tool)
    for sign in (1, -1):
        goal = {a: machine.home.get(x.joint, 0.0) + 0.05 * sign for a, x in machine.axes.items()}
        table = {"quantity": "joint", "time": [0.0], "columns": {a: [q] for a, q in goal.items()}}
        run = run_scenario(
            Scenario(name="t", tool=tool, duration=1.5, ground=False,
                     pilot={"kind": "table", **table})
        )  # fmt: skip
        for axis, target in goal.items():
            way = target - run.truth[f"angle.{axis}"]
            last = run.truth.time > run.truth.time[-1] - 0.4
            assert abs(way[last].mean()) < 0.1 * abs(way[0]), axis
            assert np.abs(way).max() < 1.5 * abs(way[0])


def test_force_drive_follows():
    """EMPS benchmark axis: a cascade of 20 1/s and 4000 N s/m over 0.2 m in 2 s.

    The velocity error it leaves is friction over velocity gain, (20 + 204 v + 3) N / 4000 N s/m,
    and that over the position gain: 0.7 mm at 0.19 m/s, and acceleration as much again.
    """
    points = [{"duration": 2.0, "pause": 0.5, "joints": {"slide": 0.2}}]
    run = run_scenario(
        Scenario(
            name="t", machine="emps", duration=3.0, control_rate=1000, log_rate=1000,
            pilot={"kind": "waypoints", "settle": 0.1, "points": points},
            servo={"position_gain": 20, "velocity_gain": 4000, "lead": 0},
        )
    )  # fmt: skip
    assert run.summary["tracking"]["slide"]["max"] < 1.5e-3
    assert run.truth["position.slide"][-1] == pytest.approx(0.2, abs=1e-3)
    assert np.abs(run.truth["command.slide"]).max() < 10.0  # inside the drive's volts


def test_force_drive_stays_within_its_volts():
    pilot = {"kind": "table", "quantity": "joint", "time": [0.0], "columns": {"slide": [0.25]}}
    servo = {"position_gain": 100, "velocity_gain": 1e5}
    run = run_scenario(Scenario(name="t", machine="emps", duration=0.3, servo=servo, pilot=pilot, log_rate=200))
    assert np.abs(run.truth["command.slide"]).max() == 10.0
