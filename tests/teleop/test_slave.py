"""The slave's side: continuous references in every mode, silence, edges, packets of nonsense."""

import numpy as np
import pytest

from hydrotele.control.arm_kinematics import arm_specification, pose_to_joints
from hydrotele.core.contiguous_state import flat_view
from hydrotele.machine.joystick import load_joystick
from hydrotele.machine.machine_file import load_machine
from hydrotele.scenario.pilots import Pose
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.teleop.master import build_master
from hydrotele.teleop.slave import (
    HELD_AT_EDGE,
    NO_PACKETS,
    VALVES_CLOSED,
    build_slave,
    measure_tip,
    step_slave,
    unpack_slave_parameters,
    unpack_slave_state,
)

CAT, STICK, PERIOD = load_machine("cat215", "bucket"), load_joystick(), 0.005
NAMES = ("r", "theta", "z", "attitude")
STRUCTURES = [("rate", "stiffness"), ("position", "none"), ("position", "four_channel"),
              ("rate", "four_channel")]  # fmt: skip
SPEED, ACCELERATION = 0.5, 1.0
ROUNDING = 1e-9


class Side:
    """A slave that follows perfectly, and what it did, tick by tick."""

    def __init__(self, mode="rate", reflection="stiffness", start=None):
        pilot = TeleopPilot.model_validate({
            "kind": "teleop", "operator": {"kind": "follow"}, "mode": mode,
            "reflection": reflection, "acceleration": ACCELERATION,
            "coordinates": {"z": {"speed": SPEED}},
        })  # fmt: skip
        here = {axis: CAT.home.get(CAT.axes[axis].joint, 0.0) for axis in CAT.axes}
        there = pose_to_joints(CAT, start or Pose(r=6.0, z=1.4, attitude=-1.745), here)
        joints = np.array([there[axis] for axis in arm_specification(CAT)[1]])
        self.master = build_master(STICK, pilot, NAMES)[0]
        self.numbers, self.s = build_slave(CAT, pilot, self.master, joints)
        self.packet, self.force = np.zeros((3, 6)), np.zeros(4)
        self.pose, self.rate, self.joint, self.held = [], [], [], []

    def go(self, seconds, arrived=True):
        for _ in range(round(seconds / PERIOD)):
            s = self.s
            step_slave(self.numbers, self.packet, arrived, self.force, s.joint, PERIOD, s)
            self.pose.append(s.pose.copy())
            self.rate.append(s.rate.copy())
            self.joint.append(s.joint.copy())
            self.held.append(s.flags[HELD_AT_EDGE] > 0.0)
        return self

    def check_continuous(self):
        """No step is longer than the speed allows, no change of rate than the acceleration.

        Only at the edge of the workspace it stops at once.
        """
        pose, rate = np.array(self.pose), np.array(self.rate)
        assert np.isfinite(pose).all() and np.isfinite(self.joint).all()
        assert np.abs(np.diff(pose[:, 2])).max() <= SPEED * PERIOD + ROUNDING
        change = np.abs(np.diff(rate[:, 2]))[~np.array(self.held)[1:]]
        assert change.max() <= ACCELERATION * PERIOD + ROUNDING
        assert np.abs(np.diff(pose[:, 2]) - PERIOD * rate[1:, 2]).max() < ROUNDING

    def ask_z(self, x):
        self.packet[0, 2] = x
        return self


def test_rate_beyond_the_dead_band():
    """The stop asks for the speed, the dead band for nothing, each reached at the acceleration."""
    side = Side().ask_z(1.4e-3).go(0.5)
    assert np.all(np.array(side.rate)[:, 2] == 0.0)
    side.ask_z(5e-3).go(1.0)
    assert side.s.rate[2] == pytest.approx(SPEED)
    side.ask_z(-(1.5e-3 + 1.75e-3)).go(2.0)
    assert side.s.rate[2] == pytest.approx(-SPEED / 2)
    side.check_continuous()


def test_place_under_position_control():
    """It comes to scale times the handle, within its bounds; 1 % overshoot is what a filter may."""
    side = Side("position", "none").ask_z(5e-3).go(3.0)
    pose = np.array(side.pose)[:, 2] - side.numbers.start[2]
    assert pose[-1] == pytest.approx(0.5, abs=1e-4)
    assert pose.max() < 0.505
    side.check_continuous()


@pytest.mark.parametrize(("mode", "kind"), STRUCTURES)
def test_wild_handle_and_force_make_continuous_references(mode, kind):
    side, rng = Side(mode, kind), np.random.default_rng(3)
    for _ in range(40):
        side.packet[:] = rng.uniform(-1, 1, (3, 6)) * np.array([[5e-3], [0.5], [30.0]])
        side.force[:] = rng.uniform(-1, 1, 4) * 2e5
        side.go(0.1)
    side.check_continuous()


@pytest.mark.parametrize(("mode", "kind"), STRUCTURES)
def test_silence_stops_it_and_packets_bring_it_back_without_a_jump(mode, kind):
    """Rates are zero within the silence and what the acceleration takes for the speed.

    After that, it stands; back on the line, it ends where it would have stood without the silence
    under position control.
    """
    side = Side(mode, kind).ask_z(3e-3).go(0.4)
    assert abs(side.s.rate[2]) > 0.05
    silence = side.numbers.limits[0]
    side.go(silence + SPEED / ACCELERATION + 2 * PERIOD, arrived=False)
    assert side.s.flags[NO_PACKETS] == 1.0 and np.all(side.s.rate == 0.0)
    stood = side.s.pose.copy()
    side.go(2.0, arrived=False)
    np.testing.assert_array_equal(side.s.pose, stood)
    side.go(3.0)
    assert side.s.flags[NO_PACKETS] == 0.0
    if (mode, kind) == ("position", "none"):
        assert side.s.pose[2] - side.numbers.start[2] == pytest.approx(0.3, abs=1e-4)
    side.check_continuous()


@pytest.mark.parametrize(("mode", "kind"), STRUCTURES)
@pytest.mark.parametrize("nonsense", [np.nan, np.inf])
def test_numbers_that_are_none_count_as_zero(mode, kind, nonsense):
    side = Side(mode, kind).ask_z(2e-3).go(0.2)
    side.packet[:], side.force[:] = nonsense, nonsense
    side.go(1.0)
    side.packet[:], side.force[:] = 0.0, 0.0
    side.go(1.0)
    assert np.isfinite(flat_view(side.s)).all()
    side.check_continuous()


@pytest.mark.parametrize("mode", ["rate", "position"])
def test_out_of_reach_it_stands_at_the_edge_and_comes_back(mode):
    """The reference stays where it was within one step and says so; no joint jumps either way.

    0.03 rad in 5 ms is more than joints move at 0.5 m/s a hand's breadth from the full reach.
    """
    side = Side(mode, "none", Pose(r=7.5, z=1.4, attitude=-1.2))
    side.packet[0, 0] = 5e-3
    side.go(8.0)
    edge = side.s.pose.copy()
    assert side.s.flags[HELD_AT_EDGE] == 1.0 and np.all(side.s.joint_rate == 0.0)
    side.go(1.0)
    np.testing.assert_allclose(side.s.pose, edge, atol=SPEED * PERIOD)
    side.packet[0, 0] = -5e-3
    side.go(2.0)
    assert side.s.flags[HELD_AT_EDGE] == 0.0 and side.s.pose[0] < edge[0] - 0.3
    assert np.abs(np.diff(side.joint, axis=0)).max() < 0.03


@pytest.mark.parametrize("wrong", [0.3, np.nan])
def test_a_joint_that_does_not_follow_trips(wrong):
    side = Side()
    joint = side.s.joint.copy()
    joint[1] += wrong
    step_slave(side.numbers, side.packet, True, side.force, joint, PERIOD, side.s)
    assert side.s.flags[VALVES_CLOSED] == 1.0
    step_slave(side.numbers, side.packet, True, side.force, side.s.joint, PERIOD, side.s)
    assert side.s.flags[VALVES_CLOSED] == 1.0  # for good


def test_a_reading_that_is_none_leaves_the_measured_pose():
    side = Side()
    before = side.s.measured.copy()
    measure_tip(side.numbers, np.full(4, np.nan), True, PERIOD, side.s)
    np.testing.assert_array_equal(side.s.measured, before)


def test_flat_arrays_show_the_parts():
    side, rng = Side(), np.random.default_rng(0)
    for parts, unpack in ((side.numbers, unpack_slave_parameters), (side.s, unpack_slave_state)):
        whole = flat_view(parts)
        whole[:] = rng.standard_normal(len(whole))
        for shown, part in zip(unpack(whole, 4), parts, strict=True):
            np.testing.assert_array_equal(shown, part)
            assert np.shares_memory(shown, part)
