"""The machine's end of the line: which poses count, what is answered, and both ends together."""

import threading
import time

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.haptics import packets
from hydrotele.haptics.device import DeviceLimits, SimulatedDevice, SimulatedDeviceParameters
from hydrotele.haptics.link import (
    FORCE_RAMP_TIME,
    FORCE_TIMEOUT,
    LAST_POSE,
    LATE,
    LOST,
    MALFORMED,
    SERVER_STARTS,
    HapticLink,
    answer_pose_packet,
    scale_pose,
)
from hydrotele.haptics.packets import (
    ANSWERED_POSE,
    CAN_APPLY_FORCE,
    FORCES_ON,
    MAX_WRENCH,
    PERIOD,
    POSE_MAGIC,
    POSITION,
    QUATERNION,
    TRAVEL,
    WRENCH,
)
from hydrotele.haptics.server import run_device_server
from hydrotele.machine.joystick import load_joystick
from hydrotele.scenario.scenario import load_scenario
from hydrotele.teleop.axis_table import HANDLE_RANGE, NOMINAL_STIFFNESS
from hydrotele.teleop.master import build_master

STEP = 1e-3
MS = 1_000_000
PACKET = (8, 4)
COORDINATES = ("r", "theta", "z", "attitude")


@pytest.fixture(scope="module")
def numbers():
    pilot = load_scenario("press_stiffness").pilot
    return build_master(load_joystick(), pilot, COORDINATES)


@pytest.fixture
def link(numbers, monkeypatch):
    """A link whose thread answers nobody, so that the test moves its clock."""
    made = HapticLink("127.0.0.1", 9)
    monkeypatch.setattr("threading.Thread.start", lambda self: None)
    monkeypatch.setattr("threading.Thread.join", lambda self, timeout=None: None)
    made.start(*numbers, PACKET)
    yield made
    made.close()


class Stand:
    """A device at the other end, on a clock that the test moves."""

    def __init__(self, link):
        self.link, self.now, self.sequence = link, 10**12, 0
        self.two = np.zeros(2, np.int64)

    def machine(self, share=1.0):
        """The machine has just written."""
        self.link.mailbox.stamp[1], self.link.mailbox.share[0] = self.now, share

    def pose(self, x=0.0, **changes):
        line = self.link.buffers
        whole, real = line.pose, line.pose_real
        whole[:8] = POSE_MAGIC, 5, self.sequence, self.now, 0, -1, 0, 0
        real[POSITION:QUATERNION], real[QUATERNION:TRAVEL] = (x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
        real[TRAVEL : PERIOD + 1], real[CAN_APPLY_FORCE] = (0.05, 0.5, 12.0, 0.4, STEP), 1.0
        for name, value in changes.items():
            (real if name in ("CAN_APPLY_FORCE", "PLACE") else whole)[getattr(packets, name)] = value
        answered = answer_pose_packet(line, self.link.mailbox, self.now, self.two)
        self.now, self.sequence = self.now + MS, self.sequence + 1
        return answered

    @property
    def force(self):
        return self.link.buffers.reply_real[WRENCH:]


@pytest.fixture
def stand(link):
    return Stand(link)


def test_the_spring_of_the_joystick_acts_on_the_scale_of_the_device(stand, numbers):
    for _ in range(2000):
        stand.machine()
        assert stand.pose(x=0.01)
    axis, line = numbers[0].axis[0], stand.link.buffers
    expected = -axis[NOMINAL_STIFFNESS] * 0.01 * axis[HANDLE_RANGE] / 0.05
    assert stand.force == pytest.approx([expected, 0, 0, 0, 0, 0], abs=1e-9)
    assert line.reply[FORCES_ON] == 1 and line.reply[ANSWERED_POSE] == stand.sequence - 1


def test_forces_come_in_slowly_and_go_at_once_when_the_machine_is_silent(stand):
    stand.machine()
    sizes = []
    for _ in range(400):
        stand.machine()
        stand.pose(x=0.01)
        sizes.append(abs(stand.force[0]))
    # From rest the damper does not act, so the force is the ramp's share of the spring's.
    assert np.all(np.diff(sizes[1:]) >= -1e-12) and sizes[1] == pytest.approx(2 * STEP / FORCE_RAMP_TIME * sizes[-1])
    for _ in range(round(FORCE_TIMEOUT / STEP) + 1):
        stand.pose(x=0.01)
    assert stand.link.buffers.reply[FORCES_ON] == 0 and not stand.force.any()


def test_old_repeated_lost_and_foreign_packets(stand):
    count = stand.link.buffers.count
    assert stand.pose() and stand.pose()
    assert not stand.pose(SEQUENCE=1) and not stand.pose(SEQUENCE=0)
    assert stand.pose(SEQUENCE=9)
    assert (count[LATE], count[LOST], count[LAST_POSE]) == (2, 7, 9)
    assert not stand.pose(MAGIC=1)
    assert count[MALFORMED] == 1


def test_a_server_that_starts_anew_begins_again(stand):
    for _ in range(500):
        stand.machine()
        stand.pose(x=0.01)
    assert stand.link.buffers.force_gain[0] == 1.0
    stand.machine()
    assert stand.pose(x=0.01, SESSION=6, SEQUENCE=0)
    assert stand.link.buffers.count[SERVER_STARTS] == 2 and stand.link.buffers.force_gain[0] < 0.01


def test_a_device_that_is_unable_gets_no_force_and_gives_no_pose(stand):
    stand.machine()
    stand.pose(x=0.01)
    stand.pose(x=0.01, CAN_APPLY_FORCE=0.0)
    assert not stand.force.any() and np.isnan(stand.link.mailbox.handle[0])


def test_a_wrench_stays_within_what_the_device_may_give(stand):
    for _ in range(500):
        stand.machine()
        stand.link.mailbox.packet[0] = 1e7
        stand.link.mailbox.extra[:] = 1e4
        stand.pose(x=0.05)
    assert np.linalg.norm(stand.force[:3]) == pytest.approx(12.0)
    assert np.linalg.norm(stand.force[3:]) == pytest.approx(0.4)
    assert stand.link.buffers.pose_real[MAX_WRENCH] == 12.0


def test_how_long_it_takes_until_a_wrench_is_known_to_be_taken(stand):
    line = stand.link.buffers
    stand.pose()
    line.sent[0] = stand.now
    stand.now += 3 * MS
    stand.pose(LAST_ACCEPTED=0)
    found = stand.link.statistics()["loop"]
    assert found["count"] == 1 and found["percentiles_us"]["max"] == pytest.approx(3000.0)


def test_scaled_pose_turns_by_a_share_of_the_angle():
    out, half = np.zeros(7), 0.5 * 0.6
    q = np.array([np.cos(half), 0.0, np.sin(half), 0.0])
    scale_pose(np.array([0.01, 0.0, -0.02]), -q, 0.1, 0.25, out)  # -q is the same orientation
    assert out[:3] == pytest.approx([1e-3, 0.0, -2e-3])
    assert out[3:] == pytest.approx([np.cos(0.25 * half), 0.0, np.sin(0.25 * half), 0.0])
    scale_pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), 0.1, 0.25, out)
    assert out.tolist() == [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


def test_the_machine_has_no_command_until_the_handle_was_centred(link, monkeypatch):
    qpos, now = np.zeros(7), time.monotonic_ns()
    monkeypatch.setattr("hydrotele.haptics.link.clock.monotonic_ns", lambda: now)

    def exchange(x, age=0):
        link.mailbox.handle[:] = x, 0, 0, 1, 0, 0, 0, 0
        link.mailbox.stamp[0] = now - age
        link.exchange(qpos, np.zeros(PACKET), 1.0, np.zeros(6))
        return qpos[0]

    assert np.isnan(exchange(0.004))  # out of the dead band of 1.5 mm when it comes
    assert exchange(0.001) == 0.001 and exchange(0.004) == 0.004
    assert np.isnan(exchange(0.004, age=10**8))  # silent
    assert np.isnan(exchange(0.004))
    assert exchange(0.0) == 0.0 and exchange(0.004) == 0.004


def test_a_structure_that_needs_more_than_a_packet_is_refused():
    pilot = load_scenario("press_stiffness", {"pilot.reflection": "four_channel"}).pilot
    made = HapticLink("127.0.0.1", 9)
    with pytest.raises(InputError, match="'four_channel' does not support haptic devices; valid"):
        made.start(*build_master(load_joystick(), pilot, COORDINATES), PACKET)
    made.close()


def test_no_such_host():
    with pytest.raises(InputError, match=r"haptic:no\.such\.host\.invalid:1"):
        HapticLink("no.such.host.invalid", 1)


def until(happened, most=20.0):
    """Wait for something that other threads do; generous, since no time is judged."""
    end = time.monotonic() + most
    while not happened():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


def test_device_and_machine_on_the_loopback(numbers):
    """A hand of 250 N/m that wants 30 mm of 50 is held by a spring of 4 kN/m on a tenth of it."""
    facts = SimulatedDeviceParameters(
        limits=DeviceLimits(0.05, 0.5, 20.0, 0.4),
        motion_amplitudes=(0.6, 0, 0, 0, 0, 0),
        motion_frequencies=(0.25,) * 6,
    )
    device, over, where = SimulatedDevice(STEP, facts), threading.Event(), []
    server = threading.Thread(
        target=run_device_server, args=(device, ("127.0.0.1", 0), STEP, over.is_set, where.append)
    )
    server.start()
    until(lambda: where)
    link, qpos = HapticLink(*where[0]), np.zeros(7)
    try:
        link.start(*numbers, PACKET)
        seen = []

        def moved():
            link.exchange(qpos, np.zeros(PACKET), 1.0, np.zeros(6))
            seen.append((qpos[0], device.wrench[0]))
            return qpos[0] > 1e-3  # 10 mm of the device

        until(moved)
        assert seen[-1][1] < -0.5  # the spring pushes back
        assert link.engaged and link.statistics()["device_starts"] == 1
        link.buffers.count[0] = 1  # the machine's thread dies: nobody answers
        until(lambda: not device.wrench.any())
        over.set()  # and the device's server, too
        server.join(20.0)
        until(lambda: link.pose() is None)
        link.exchange(qpos, np.zeros(PACKET), 1.0, np.zeros(6))
        assert np.isnan(qpos).all() and not link.engaged
    finally:
        over.set()
        link.close()
