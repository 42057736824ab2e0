"""The line between operator and machine: exact delays, lost packets, nonsense in packets."""

import numpy as np
import pytest

from hydrotele.control.arm_kinematics import arm_specification
from hydrotele.control.servo import DriveReference, tabulate_drive_geometry
from hydrotele.core.contiguous_state import copy_to_contiguous_state, flat_view
from hydrotele.machine.joystick import load_joystick
from hydrotele.machine.machine_file import load_machine
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.teleop.master import build_master
from hydrotele.teleop.neuromuscular_dynamics import NeuromuscularState
from hydrotele.teleop.slave import PACKET_AGE, build_slave
from hydrotele.teleop.teleoperation_step import (
    PACKET_GAIN,
    SILENT_TIME,
    ChannelBuffers,
    MasterSide,
    SlaveSide,
    step_master_side,
    step_slave_side,
)

CAT, STICK, PERIOD, FADE = load_machine("cat215", "bucket"), load_joystick(), 0.005, 0.2
AXES = tuple(CAT.axes)
COLUMNS = np.array([AXES.index(axis) for axis in arm_specification(CAT)[1]])
HOME = np.array([CAT.home.get(CAT.axes[a].joint, 0.0) for a in AXES])


class RoundTrip:
    """Both halves of the round trip, around a machine and a handle that stand still."""

    def __init__(self, forward=0, back=0, lost=(), ticks=400, **changed):
        pilot = TeleopPilot.model_validate(
            {"kind": "teleop", "operator": {"kind": "follow"}, "reflection": "direct_force"} | changed
        )
        self.m, self.ms = build_master(STICK, pilot, ("r", "theta", "z", "attitude"))
        self.s, self.ss = build_slave(CAT, pilot, self.m, HOME[COLUMNS])
        self.hand = copy_to_contiguous_state(NeuromuscularState(*(np.zeros(6) for _ in range(2)), np.full((3, 6), -1.0),
                                      *(np.zeros(6) for _ in range(3)), np.zeros(1),
                                      *(np.zeros(6) for _ in range(2)), np.zeros(1),
                                      *(np.zeros(6) for _ in range(3))))  # fmt: skip
        self.forward = np.zeros((1 + forward, 3, 6))
        self.back, self.packet = np.zeros((1 + back, 8, 4)), np.zeros((8, 4))
        self.age = np.tile([forward, back], (ticks, 1))
        self.age[list(lost)] = -1
        self.state = np.array([0.0, 1.0, PERIOD, pilot.safety.packet_timeout, FADE])
        self.qpos, self.force = np.array([0.0, 0, 0, 1, 0, 0, 0]), np.zeros(4)
        self.joint = HOME.copy()
        self.grid, self.table = tabulate_drive_geometry(CAT, AXES)
        self.tick = 0

    def step(self, tripped=False):
        flat, k = flat_view, len(AXES)
        machine = SlaveSide(self.joint, self.force, COLUMNS, flat(self.s), flat(self.ss))
        line = ChannelBuffers(self.forward, self.back, self.packet, self.age, self.state)
        operator = MasterSide(
            flat(self.m), flat(self.ms), self.qpos, flat(self.hand), np.zeros((2, 6)),
            np.zeros((8, 6)),
        )  # fmt: skip
        step_master_side(self.tick, True, PERIOD, tripped, machine, line, operator)
        reference, rate = np.zeros(k), np.zeros(k)
        drive = DriveReference(*(np.zeros(k) for _ in range(4)))
        step_slave_side(self.tick, machine, line, self.grid, self.table, 1.0, reference, rate, drive)
        self.tick += 1
        return self


@pytest.mark.parametrize("late", [0, 1, 7, 40])
def test_a_force_comes_to_the_hand_exactly_so_late(late):
    line = RoundTrip(back=late)
    seen = []
    for tick in range(60):
        line.force[2] = 1e4 if tick == 10 else 0.0
        seen.append(line.step().packet[0, 2])
    assert np.flatnonzero(seen).tolist() == [10 + late]


@pytest.mark.parametrize("late", [0, 1, 7, 40])
def test_a_displacement_comes_to_the_machine_exactly_so_late(late):
    line = RoundTrip(forward=late)
    seen = []
    for tick in range(60):
        line.qpos[2] = 3e-3 if tick == 10 else 0.0
        seen.append(line.step().ss.command[0, 2])
    assert np.flatnonzero(seen).tolist() == [10 + late]


@pytest.mark.parametrize("late", [0, 5])
def test_silence_fades_the_force_and_is_forgotten_when_packets_come(late):
    """The last packet counts until the silence is noticed, then e^-1 of it is left per fade.

    6 %: the fade is stepped, and begins a period sooner or later.
    """
    gone = range(100, 200)
    line = RoundTrip(back=late, forward=late, lost=gone)
    line.force[2] = 1e4
    silent = round(line.state[3] / PERIOD) - 1  # the sum of periods may round up
    for _ in range(100 + silent):
        line.step()
    assert line.packet[0, 2] == 1e4 and line.state[PACKET_GAIN] == pytest.approx(1.0)
    for _ in range(round(FADE / PERIOD)):
        line.step()
    assert line.state[PACKET_GAIN] == pytest.approx(np.exp(-1.0), rel=0.06)
    assert abs(line.ms.push[2]) < 0.45 * 1e4 * 2e-4
    while line.tick < 260:
        line.step()
    assert line.state[SILENT_TIME] == 0.0 and line.ss.flags[PACKET_AGE] == 0.0
    assert line.state[PACKET_GAIN] > 0.7


def test_a_machine_that_tripped_lets_the_hand_go():
    line = RoundTrip()
    line.force[2] = 1e4
    for _ in range(400):
        line.step(tripped=line.tick > 50)
    assert abs(line.ms.push[2]) < 0.01 * 1e4 * 2e-4


def test_nonsense_from_the_sensors_stays_out_of_the_hand():
    """The last good number of a channel counts; the machine trips, the joystick works on."""
    line = RoundTrip()
    line.force[2] = 1e4
    for _ in range(20):
        line.step()
    line.force[2], line.joint[:] = np.nan, np.nan
    for _ in range(20):
        line.step()
    assert line.packet[0, 2] == 1e4
    for state in (line.ms, line.ss):
        assert np.isfinite(flat_view(state)).all()
    assert line.ss.flags[2] == 1.0
