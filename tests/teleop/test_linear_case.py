"""The linear case of a scenario: its blocks, and its numbers against the machine's own."""

import dataclasses
import math

import numpy as np
import pytest

from hydrotele.control.state_filter import butterworth_response, filter_signal, filter_step_matrix
from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import load_joystick
from hydrotele.machine.machine_file import load_machine
from hydrotele.scenario.scenario import find_scenario_joystick, load_scenario
from hydrotele.teleop.linear_case import (
    DEFAULT_TASK,
    build_scenario_case,
    tip_controller_impedance,
    tip_tracking_response,
)
from hydrotele.teleop.scenario_analysis import analyse_scenario_case, analyse_scenario_loop
from hydrotele.teleop.two_port import Impedance

SLOW = 1e-4j  # rad/s, far below every corner


def made(name="press_direct", coordinate=None, **overrides):
    pairs = {key.replace("__", "."): value for key, value in overrides.items()}
    scenario = load_scenario(name, pairs)
    machine = load_machine(scenario.machine, scenario.tool)
    return build_scenario_case(scenario, machine, load_joystick(find_scenario_joystick(scenario)), coordinate)


@pytest.fixture(scope="module")
def case():
    return made()[0]


def test_tip_weighs_as_much_as_a_boom_that_turns(case):
    """916 kg: 1.5 t of arm beyond the boom's pin, their distances from it, and its tool."""
    assert case.tip.coordinate == "z"
    assert 500.0 < case.tip.mass < 1500.0  # kg; the arm with its tool weighs 3.3 t
    assert case.tip.rate_fractions.sum() == pytest.approx(1.0, abs=1e-12)  # rounding
    boom = case.tip.compliance[1] / case.tip.compliance.sum()
    assert boom > 0.9  # at 6 m up and down is the boom's affair


def test_drive_keeps_its_reference_and_yields_to_nothing_for_long(case):
    s = np.array([SLOW])
    arguments = (case.tip, case.servo, case.periods, s)
    assert tip_tracking_response(*arguments)[0] == pytest.approx(1.0, abs=1e-3)  # first order of SLOW
    # K (s + g) / s^2 / (1 + p T): the position loop integrates through the oil
    slow = case.tip.stiffness * 8.0 / (SLOW**2 * (1.0 + 6.0 * 0.2))
    assert tip_controller_impedance(*arguments)[0] == pytest.approx(slow, rel=1e-3)


def test_drive_is_oil_and_mass_when_fast(case):
    s = np.array([1e4j])
    oil = case.tip.stiffness / s
    assert tip_controller_impedance(case.tip, case.servo, case.periods, s) == pytest.approx(oil, rel=0.01)


def test_filter_is_what_the_estimator_does():
    """A sine through the sampled filter has the transfer function's size and phase."""
    period, frequency, bandwidth = 0.02, 1.0, 1.5
    time = period * np.arange(2000)
    out = filter_signal(filter_step_matrix(bandwidth, period), np.sin(2.0 * np.pi * frequency * time))[:, 0]
    late = slice(1000, None)  # 20 whole periods
    wave = np.exp(-2j * np.pi * frequency * time[late])
    seen = 2j * np.mean(out[late] * wave)
    expected = butterworth_response(bandwidth, np.array([2j * np.pi * frequency]))[0]
    assert seen == pytest.approx(expected, abs=2e-3)  # chords of a sine are (w T)^2 / 12 too low


def test_task_is_the_plate_or_said_to_be_the_default():
    case, contact = made()
    assert contact.task == Impedance(300.0, 3.0e4, 1.0e6) and "plate" in contact.source
    case, contact = made(coordinate="r")
    assert case.task == DEFAULT_TASK and "default" in contact.source
    case, contact = made(coordinate="theta")
    assert case.task.stiffness == pytest.approx(36.0e6) and "6 m" in contact.source  # K r^2


@pytest.mark.nightly
def test_limit_falls_with_speed_stiffness_delay_and_lag():
    """What makes the loop faster or later leaves less reflection; by speed, in proportion."""
    ratio = analyse_scenario_loop(made()[0], "rate_force").max_ratio
    assert 2e-5 < ratio < 4e-5  # as simulated: smooth at 4e-5 only for its dead band
    for changed in (
        {"surroundings__0__stiffness": "2.0e+6"},
        {"pilot__channel__delay_back": "0.1"}, {"pilot__bandwidth_hz": "0.75"},
    ):  # fmt: skip
        assert analyse_scenario_loop(made(**changed)[0], "rate_force").max_ratio < 0.9 * ratio
    # Twice the speed.
    double = analyse_scenario_loop(made(pilot__coordinates__z__speed="0.6")[0], "rate_force")
    assert double.max_ratio == pytest.approx(0.5 * ratio, rel=2e-3)  # two margins' rounding


def test_hand_is_that_of_the_scenarios_operator(case):
    """Grip and co-contraction of the scenario are in the loop, as the station simulates them."""
    usual = load_joystick().hand
    assert case.hand_impedance == Impedance(usual.mass, usual.damping, usual.stiffness)
    firm = made(pilot__perception="{grip: firm, cocontraction: 0.4}")[0]
    assert firm.hand_impedance.mass == pytest.approx(0.8)  # operator.yaml: firm
    assert firm.hand_impedance.stiffness == pytest.approx(600.0 * 1.8)  # factor 3: 1 + 2 x 0.4
    far = made(pilot__perception="{grip: normal, posture: far}", coordinate="r")[0]
    assert far.hand_impedance.stiffness > 2.0 * 250.0  # towards the shoulder
    ratios = [analyse_scenario_loop(c, "rate_force").max_ratio for c in (case, firm)]
    assert ratios[1] != pytest.approx(ratios[0], rel=0.02)
    with pytest.raises(InputError, match="pilot.perception.grip"):
        made(pilot__perception="{grip: frm}")


def test_pole_lies_on_the_axis_at_the_limit(case):
    found = analyse_scenario_loop(case, "rate_force")
    assert found.unstable_poles == 2 and not found.is_stable
    assert found.pole.real > 0.0 and found.max_delay == 0.0
    row = case.axis_parameters.copy()
    row[13] = found.max_ratio
    at = analyse_scenario_loop(dataclasses.replace(case, axis_parameters=row), "rate_force")
    assert at.gain_margin == pytest.approx(1.0, abs=3e-3)  # the margin is refined to 1e-3
    assert abs(at.pole.real) < 0.01 * abs(at.pole.imag)
    assert at.pole.imag / (2.0 * math.pi) == pytest.approx(found.frequency, rel=0.02)


def test_theorem_counts_the_hand_and_its_damping():
    scenario_gains = analyse_scenario_case("a", *made("press_stiffness")[:1], "")
    assert scenario_gains.held_spring.stability_theorem_margin == pytest.approx(68.0**2 - 4.0 * 1.45 * 4250.0)
    assert not scenario_gains.loop.is_scenario_structure
    damped = analyse_scenario_case("a", made("press_stiffness", pilot__stiffness="{z: {damping: 150.0}}")[0], "")
    assert damped.held_spring.stability_theorem_margin > 0.0
    # K_r x: 3400 N/m over 50 kN, 1.5 mm
    assert damped.deadband_edge_ratio == pytest.approx(3400.0 / 5e4 * 1.5e-3)


@pytest.mark.daily("position-direct_force", "rate-coordinating_force")
@pytest.mark.parametrize("reflection", ["direct_force", "coordinating_force"])
@pytest.mark.parametrize("mode", ["rate", "position"])
def test_every_structure_has_a_margin(reflection, mode):
    case = made(pilot__reflection=reflection, pilot__mode=mode)[0]
    found = analyse_scenario_case("a", case, "").loop
    assert found.is_scenario_structure and found.gain_margin > 0.0


@pytest.mark.parametrize(
    ("reflection", "mode", "message"),
    [
        ("four_channel", "rate", "observed hand force.*--structure four_channel_rate"),
        ("wave_variables", "position", "as received energy.*--structure wave_variables --robust"),
        ("passivity_control", "position", "--structure passivity_control --robust"),
        ("impedance", "rate", "identified online and changes; .*direct_force"),
    ],
)
def test_structures_without_a_linear_case_say_why_and_what_to_do(reflection, mode, message):
    case = made()[0]
    pilot = case.pilot.model_copy(update={"reflection": reflection, "mode": mode})
    with pytest.raises(InputError, match=message):
        analyse_scenario_case("a", dataclasses.replace(case, pilot=pilot), "")


@pytest.mark.parametrize(
    ("overrides", "coordinate", "message"),
    [
        ({}, "head", "no 'head'; the arm has r, theta, z, attitude"),
        ({"pilot__ratio": "0"}, None, "no force is reflected"),
    ],
)
def test_what_cannot_be_analysed(overrides, coordinate, message):
    with pytest.raises(InputError, match=message):
        made(coordinate=coordinate, **overrides)
