"""The simulated operator: he sees late, stays within his strength, and is the same every time."""

import numpy as np
import pytest

from hydrotele.machine.joystick import load_joystick
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.teleop.axis_table import HANDLE_RANGE, NOMINAL_STIFFNESS
from hydrotele.teleop.master import build_master
from hydrotele.teleop.neuromuscular_dynamics import compute_muscle_forces
from hydrotele.teleop.operator_model import OperatorModel

STICK, PERIOD, TICKS = load_joystick(), 0.005, 400
CARRIED = 9.81 * STICK.hand.mass
STEER = {"kind": "steer", "time": [0.0], "points": {"z": [1.0]}}
FOLLOW = {"kind": "follow", "time": [0.0, 0.5, 1.0], "path": {"z": [0.0, 0.004, 0.002]}}


class Views:
    """What there is to see: arrays that a test writes."""

    def __init__(self):
        self.touching = np.zeros(TICKS, bool)
        self.force = np.zeros((TICKS, 4))
        self.values = {"handle": np.zeros((TICKS, 6)), "hand": np.zeros((TICKS, 6)),
                       "measured": np.zeros((TICKS, 2, 5))}  # fmt: skip

    def master(self, name):
        return self.values[name]

    slave = master


def person(operator, seed=1, views=None, **changed):
    pilot = TeleopPilot.model_validate({"kind": "teleop", "operator": operator, **changed})
    numbers = build_master(STICK, pilot, ("r", "theta", "z", "attitude"))[0]
    return OperatorModel(pilot, STICK, numbers, views or Views(), TICKS, PERIOD, seed), numbers


@pytest.mark.parametrize("mode", ["rate", "position"])
def test_he_acts_on_what_he_saw_a_reaction_time_ago(mode):
    """The tip jumps at tick 200; his hand knows after 0.25 s and at the next decision.

    The hold of a decision is half a step late by itself, which his delay includes. Under position
    control he integrates, over the middle of a step: half a step more until something has come.
    """
    wanted, calm = [], {"visual_delay": 0.25, "remnant": 0.0}
    for jump in (0.0, 0.5):
        views = Views()
        views.values["measured"][:, 0, 2] = 0.6
        views.values["measured"][200:, 0, 2] += jump
        him, _ = person(STEER, views=views, mode=mode, perception=calm)
        wanted.append([])
        for tick in range(0, TICKS, him.ticks_per_decision):
            him.decide_handle_reference(tick)
            wanted[-1].append(him.muscles.reference[2])
    same = np.equal(*wanted)
    first = np.flatnonzero(~same)[0] * him.ticks_per_decision
    late = him.ticks_per_decision / 2 if mode == "position" else 0
    assert 250 - him.ticks_per_decision / 2 <= first - late <= 250 + him.ticks_per_decision


def test_his_hand_stays_within_the_way_of_the_handle():
    views = Views()
    views.values["measured"][:, 0, 2] = -50.0
    him, numbers = person(STEER, views=views, mode="position", perception={"max_crossover_frequency": 50.0})
    for tick in range(0, TICKS, him.ticks_per_decision):
        him.decide_handle_reference(tick)
        assert abs(him.muscles.reference[2]) <= numbers.axis[2, HANDLE_RANGE]


def test_he_follows_a_path():
    him, _ = person(FOLLOW)
    for tick, place in ((0, 0.0), (52, 0.00208), (100, 0.004), (200, 0.002), (300, 0.002)):
        him.decide_handle_reference(tick)
        assert him.muscles.reference[2] == pytest.approx(place)


def test_muscles_hold_a_spring_and_do_not_exceed_their_strength():
    """What the spring asks for plus tremor, five times its 0.05 N; never more than the largest."""
    him, numbers = person(FOLLOW)
    him.muscles.reference[2] = 0.004
    handle = np.array([0.0, 0, 0.004, 0, 0, 0])
    for tick in range(60):
        him.displacement_history[:] = handle
        compute_muscle_forces(him.muscles, him.displacement_history, him.tremor, handle, tick, PERIOD)
    spring = numbers.axis[2, NOMINAL_STIFFNESS] + STICK.hand.stiffness
    assert him.muscles.force[2] - CARRIED == pytest.approx(spring * 0.004, abs=0.25)
    him.muscles.reference[:] = 100.0
    for tick in range(400):
        compute_muscle_forces(him.muscles, him.displacement_history, him.tremor, handle, tick, PERIOD)
    assert np.all(np.abs(him.muscles.force - him.muscles.weight) <= him.muscles.max_force + 1e-12)


def test_same_seed_same_person():
    one, two, other = (person(STEER, seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.tremor, two.tremor)
    assert not np.array_equal(one.tremor, other.tremor)
