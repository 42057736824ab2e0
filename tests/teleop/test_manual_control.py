"""Crossover model: measured from simulated tracking, learnt gains, remnant, and drawn operators."""

import dataclasses
import math

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import find_principal_values, load_joystick
from hydrotele.scenario.teleoperation import OperatorSettings, TeleopPilot
from hydrotele.teleop.hand_impedance import arm_impedance, attach_operator_hand
from hydrotele.teleop.manual_control import (
    DOUBLE_INTEGRATOR,
    ESTIMATED_GAIN,
    FORMS,
    GAIN,
    INTEGRATOR,
    decide_hand_reference,
    discretise_neuromuscular_lag,
    find_crossover,
    make_sum_of_sines,
    make_visual_loop,
    measure_describing_functions,
    operator_response,
    simulate_tracking,
)
from hydrotele.teleop.operator_model import read_recorded_hand
from hydrotele.teleop.operator_parameters import load_operator_file, make_operator, make_scenario_operator

HIM = make_operator(load_operator_file(), None)
TIME = np.arange(0.0, 150.0, 0.01)


def measured(form, records=4, him=HIM):
    done = []
    for seed in range(records):
        target, frequencies = make_sum_of_sines(TIME, 2.5, 120.0, seed)
        done.append(simulate_tracking(him, form, 2.0, target, seed=seed))
    return find_crossover(frequencies, measure_describing_functions(done, frequencies, 30.0)[0])


@pytest.mark.parametrize(
    ("form", "frequency", "margin"),
    [(GAIN, (2.5, 6.0), (25, 70)), (INTEGRATOR, (2.5, 5.5), (20, 60)),
     (DOUBLE_INTEGRATOR, (1.8, 4.0), (15, 50))],
    ids=FORMS,
)  # fmt: skip
def test_the_open_loop_falls_by_20_db_per_decade_around_a_published_crossover(form, frequency, margin):
    """Ranges: McRuer and Jex 1967, and side sticks; 5 dB for the neuromuscular peak above."""
    found = measured(form)
    assert frequency[0] < found.frequency < frequency[1]
    assert margin[0] < math.degrees(found.margin) < margin[1]
    assert found.slope == pytest.approx(-20.0, abs=5.0)


def test_a_turn_between_two_sines_does_not_count_as_margin():
    """1 e^(-0.3 s) / s, margin 90 - 17 degrees; far above, sines are more than a turn apart."""
    w = np.array([0.3, 0.6, 0.9, 1.2, 2.0, 40.0])
    for turn in (0.0, 2.0 * np.pi):
        loop = np.exp(-1j * (0.3 * w + turn)) / (1j * w)
        assert find_crossover(w, loop).margin == pytest.approx(0.5 * np.pi - 0.3, abs=0.01)
    assert abs(find_crossover(w[::5], np.exp(-0.3j * w[::5]) / (1j * w[::5])).margin) < np.pi


@pytest.mark.nightly
def test_an_operator_with_twice_the_delay_crosses_over_at_a_lower_frequency():
    slow = make_operator(load_operator_file(), None, visual_delay=0.32)
    assert measured(INTEGRATOR, him=slow).frequency < 0.8 * measured(INTEGRATOR).frequency


@pytest.mark.parametrize("form", [GAIN, INTEGRATOR, DOUBLE_INTEGRATOR])
def test_he_learns_a_gain_that_he_did_not_expect(form):
    """A tenth: he weighs what he expected, and the rest of his own noise."""
    rng, step, gain = np.random.default_rng(5), 0.02, 7.0
    loop = make_visual_loop(HIM, step, 1.0, rng, form=form)
    output = rate = hand = 0.0
    assert loop.state[ESTIMATED_GAIN] < 0.5 * gain
    for tick in range(2000):
        target = math.sin(0.8 * tick * step) + 0.5 * math.sin(2.1 * tick * step)
        hand += 0.2 * (decide_hand_reference(loop, tick, target, output, hand) - hand)
        if form == GAIN:
            output = gain * hand
        elif form == INTEGRATOR:
            output += step * gain * hand
        else:
            rate += step * gain * hand
            output += step * rate
    assert loop.state[ESTIMATED_GAIN] == pytest.approx(gain, rel=0.1)


def test_the_neuromuscular_step_is_exact():
    """A held input for one second, in one step and in a hundred."""
    one = discretise_neuromuscular_lag(12.0, 0.3, 1.0)
    many = discretise_neuromuscular_lag(12.0, 0.3, 0.01)
    place, rate = 0.0, 0.0
    for _ in range(100):
        place, rate = (
            many[0] * place + many[1] * rate + many[2], many[3] * place + many[4] * rate + many[5]
        )  # fmt: skip
    assert (place, rate) == pytest.approx((one[2], one[5]), abs=1e-12)
    assert discretise_neuromuscular_lag(0.0, 0.3, 0.01).tolist() == [0, 0, 1, 0, 0, 0]


def test_the_same_number_draws_the_same_operator_within_the_spread():
    file = load_operator_file()
    for number in range(5):
        one = make_operator(file, number)
        assert one == make_operator(file, number) != make_operator(file, number + 1)
        for name, p in file.parameters.items():
            assert p.low <= getattr(one, name) <= p.high, name


def test_every_number_has_a_source():
    for name, p in load_operator_file().parameters.items():
        assert len(p.source) > 20, name


def test_an_own_file_changes_what_it_names(tmp_path):
    (tmp_path / "me.yaml").write_text(
        "name: me\nparameters:\n  tremor: {value: 0.2, low: 0.1, high: 0.3, unit: N,"
        " basis: identified, source: a record of mine}\n"
    )
    him = make_scenario_operator(OperatorSettings(file="me.yaml", haptic_delay=0.2), str(tmp_path))
    assert (him.tremor, him.haptic_delay, him.remnant) == (0.2, 0.2, HIM.remnant)
    (tmp_path / "bad.yaml").write_text("name: me\nparameters: {tremors: {value: 1}}\n")
    with pytest.raises(InputError, match="bad.yaml"):
        make_scenario_operator(OperatorSettings(file="bad.yaml"), str(tmp_path))
    (tmp_path / "old.yaml").write_text(
        "name: me\nparameters:\n  touch: {value: 0.2, low: 0.1, high: 0.3, basis: identified, source: a record}\n"
    )
    with pytest.raises(InputError, match="old.yaml:1: .*unknown key 'touch': it is now called 'haptic_delay'"):
        make_scenario_operator(OperatorSettings(file="old.yaml"), str(tmp_path))


@pytest.mark.parametrize("form", range(3))
def test_operator_is_as_late_as_his_parameters_say(form):
    """Without remnant, by the phase of his describing function from 1 to 9 rad/s.

    2 ms at 9 rad/s: he decides every 20 ms, between which what he saw is interpolated.
    """
    him, time = dataclasses.replace(HIM, remnant=0.0), np.arange(0.0, 150.0, 0.01)
    target, w = make_sum_of_sines(time, 2.5, 120.0, 3)
    record = simulate_tracking(him, form, 2.0, target, seed=3, has_gain_error=False)
    found = measure_describing_functions([record], w, 30.0)[1] / operator_response(him, form, w)
    told = (w > 1.0) & (w < 9.0)
    delay = -np.angle(found[told]) / w[told]
    assert np.abs(delay).max() < 4e-3 and abs(delay[-1]) < 2e-3, delay


def test_posture_makes_ellipses_of_the_hand():
    """Mussa-Ivaldi et al. 1985: long axis to the shoulder, longer and turning with the hand.

    Mass stays positive, its ellipse along the forearm; the usual posture keeps the grip's size.
    """
    stick, file = load_joystick(), load_operator_file()
    hands = {p: attach_operator_hand(stick, OperatorSettings(grip="normal", posture=p)).hand
             for p in ("near", "mid", "far")}  # fmt: skip
    long = [find_principal_values(h.stiffness_shape) for h in hands.values()]
    ratio = [p.max_value / p.min_value for p in long]
    assert ratio[0] < 2.0 < ratio[1] < 3.0 < ratio[2]
    assert abs(long[1].angle) < np.deg2rad(5.0) and abs(long[2].angle) < np.deg2rad(5.0)
    mid = find_principal_values(hands["mid"].stiffness_shape)
    assert mid.min_value * mid.max_value == pytest.approx(1.0)  # its geometric mean is the grip's
    assert hands["mid"].stiffness == file.grips["normal"].stiffness
    assert hands["far"].axis_impedance(0)[2] > 1.4 * hands["mid"].axis_impedance(0)[2] > 1.4 * 250.0
    assert hands["far"].axis_impedance(1)[2] < 0.7 * hands["mid"].axis_impedance(1)[2] < 0.7 * 250.0
    assert hands["far"].axis_impedance(2)[2] == 250.0
    assert file.arm
    turned = [arm_impedance(file.arm, (0.4 * math.cos(a), 0.4 * math.sin(a))) for a in (0.0, 0.5)]
    c, s = math.cos(0.5), math.sin(0.5)
    turn = np.array([[c, -s], [s, c]])
    for here, there in zip(*turned, strict=True):
        np.testing.assert_allclose(turn @ here @ turn.T, there, rtol=1e-9)
    with pytest.raises(InputError, match="out of reach"):
        arm_impedance(file.arm, (0.7, 0.0))


def test_grip_posture_and_cocontraction_make_the_hand():
    """Full co-contraction: stiffness times `cocontraction_stiffness_factor`, the damping ratio stays."""
    stick = load_joystick()
    assert attach_operator_hand(stick, OperatorSettings()).hand == stick.hand
    firm = attach_operator_hand(stick, OperatorSettings(grip="firm")).hand
    assert firm.stiffness > stick.hand.stiffness
    tense = attach_operator_hand(stick, OperatorSettings(cocontraction=1.0)).hand
    assert tense.stiffness == pytest.approx(HIM.cocontraction_stiffness_factor * stick.hand.stiffness)
    ratio = [h.damping / math.sqrt(h.mass * h.stiffness) for h in (tense, stick.hand)]
    assert ratio[0] == pytest.approx(ratio[1])
    with pytest.raises(InputError, match="did you mean 'firm'"):
        attach_operator_hand(stick, OperatorSettings(grip="frm"))


def test_a_recorded_hand_replaces_the_model(tmp_path):
    path = tmp_path / "hand.csv"
    path.write_text("time,handle.z [mm]\n10.0,0\n10.5,2\n11.5,-1\n")
    made = read_recorded_hand(path, np.array([0.0, 0.25, 1.0, 5.0]))
    assert made[:, 2] == pytest.approx([0.0, 0.001, 0.0005, -0.001])
    assert not made[:, [0, 1, 3, 4, 5]].any()
    path.write_text("time,z,button\n0,0.001,1\n1,0.002,0\n")
    assert read_recorded_hand(path, np.array([0.5]))[0, 2] == pytest.approx(0.0015)
    path.write_text("time,elbow\n0,1\n1,2\n")
    with pytest.raises(InputError, match="handle.x"):
        read_recorded_hand(path, np.zeros(2))
    path.write_text("time,x,y,z\n")
    with pytest.raises(InputError, match="hand.csv: has no rows: give at least one position of the handle"):
        read_recorded_hand(path, np.zeros(2))
    path.write_text("time,x\n0,0.1\n1,nan\n")
    with pytest.raises(InputError, match=r"hand.csv.*x.*: is not a finite number"):
        read_recorded_hand(path, np.zeros(2))
    pilot = TeleopPilot.model_validate({"kind": "teleop", "operator": {"recorded": "hand.csv"}})
    assert pilot.operator.kind == "recorded"
    with pytest.raises(ValueError, match="recorded: FILE"):
        TeleopPilot.model_validate({"kind": "teleop", "operator": {"kind": "steers"}})
