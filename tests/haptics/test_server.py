"""A device's server: what it takes of a machine, what it refuses, and when it goes limp."""

import numpy as np
import pytest

from hydrotele.haptics import packets
from hydrotele.haptics.device import (
    DeviceLimits,
    SimulatedDevice,
    SimulatedDeviceParameters,
    limit_wrench,
)
from hydrotele.haptics.packets import (
    ANSWERED_POSE,
    CAN_APPLY_FORCE,
    FORCES_ON,
    LAST_ACCEPTED,
    MAGIC,
    MISSED,
    POSITION,
    SEQUENCE,
    SESSION,
    UNANSWERED,
    WRENCH,
    WRENCH_MAGIC,
    WRENCH_WORDS,
    make_packet,
)
from hydrotele.haptics.server import CLIENT_TIMEOUT, MAX_POSE_AGE, WATCHDOG_TIMEOUT, DeviceSession

PERIOD, SESSION_NUMBER = 1e-3, 77
HERE, ELSEWHERE = ("127.0.0.1", 4000), ("127.0.0.1", 4001)
MS = 1_000_000


class Stand:
    """An exchange with a machine at the other end, on a clock that the test moves."""

    def __init__(self, device=None):
        self.device = device or SimulatedDevice(PERIOD)
        self.exchange = DeviceSession(self.device, PERIOD, SESSION_NUMBER)
        self.now, self.sequence = 10**12, 0

    def period(self):
        self.now += MS
        self.exchange.apply_wrench_and_read_pose(self.now)
        return self.exchange.pose

    def send(self, force=(0.0,) * 6, sender=HERE, **changes):
        whole, real = make_packet(WRENCH_WORDS)
        whole[[MAGIC, SESSION, SEQUENCE, FORCES_ON]] = (
            WRENCH_MAGIC,
            SESSION_NUMBER,
            self.sequence,
            1,
        )
        whole[ANSWERED_POSE] = self.exchange.pose.integers[SEQUENCE]
        real[WRENCH:] = force
        for name, value in changes.items():
            whole[getattr(packets, name)] = value
        self.sequence += 1
        return self.exchange.accept_packet(whole.tobytes(), sender, self.now)

    def open(self):
        self.period()
        assert self.send(SESSION=0)
        self.period()


@pytest.fixture
def stand():
    made = Stand()
    made.open()
    return made


def test_a_wrench_is_given_from_the_next_period_on(stand):
    assert stand.send((1.0, 2.0, 3.0, 0.1, 0.0, 0.0))
    stand.period()
    assert stand.device.wrench.tolist() == [1.0, 2.0, 3.0, 0.1, 0.0, 0.0]
    assert stand.exchange.pose.integers[LAST_ACCEPTED] == 1


def test_nobody_who_has_not_asked_moves_the_device():
    stand = Stand()
    stand.period()
    assert not stand.send((1.0,) * 6)
    assert stand.exchange.rejected_packets["other_client"] == 1 and not stand.exchange.wrench.any()


def test_a_second_machine_is_refused_until_the_first_is_silent(stand):
    stand.send()
    assert not stand.send(sender=ELSEWHERE, SESSION=0)
    assert not stand.send((5.0,) * 6, sender=ELSEWHERE)
    assert stand.exchange.rejected_packets["other_client"] == 2
    for _ in range(round(CLIENT_TIMEOUT / PERIOD) + 2):
        stand.period()
    assert stand.exchange.client is None
    assert stand.send(sender=ELSEWHERE, SESSION=0)


def test_packets_out_of_order_again_or_from_another_session_are_refused(stand):
    stand.send((1.0,) * 6)
    stand.sequence = 1
    assert not stand.send((9.0,) * 6)  # the same number again
    stand.sequence = 5
    assert stand.send((2.0,) * 6)
    stand.sequence = 3
    assert not stand.send((9.0,) * 6)
    assert not stand.send((9.0,) * 6, SESSION=SESSION_NUMBER + 1)
    refused = stand.exchange.rejected_packets
    assert (refused["late"], refused["session"]) == (2, 1)
    assert np.linalg.norm(stand.exchange.wrench[:3]) == pytest.approx(2.0 * 3**0.5)


def test_an_answer_to_a_pose_of_long_ago_is_stale(stand):
    old = int(stand.exchange.pose.integers[SEQUENCE])
    for _ in range(round(MAX_POSE_AGE / PERIOD)):
        stand.period()
        stand.send()
    assert stand.send(ANSWERED_POSE=old)
    stand.period()
    assert not stand.send(ANSWERED_POSE=old)
    assert not stand.send(ANSWERED_POSE=old + 10_000)  # a pose that was never sent
    assert stand.exchange.rejected_packets["stale"] == 2


@pytest.mark.parametrize("force", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_refused(stand, force):
    assert not stand.send((force, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert stand.exchange.rejected_packets["malformed"] == 1 and not stand.exchange.wrench.any()


def test_packets_of_another_size_or_kind_are_refused(stand):
    for data in (b"", b"x" * 8, b"x" * 8 * WRENCH_WORDS, b"x" * 8 * (WRENCH_WORDS + 1)):
        assert not stand.exchange.accept_packet(data, HERE, stand.now)
    assert stand.exchange.rejected_packets["malformed"] == 4


def test_random_packets_never_move_the_device(stand):
    rng = np.random.default_rng(1)
    for _ in range(500):
        data = rng.bytes(8 * WRENCH_WORDS)
        assert not stand.exchange.accept_packet(data, HERE, stand.now)
    assert not stand.exchange.wrench.any()


def test_limits_keep_the_direction(stand):
    most = stand.device.limits
    stand.send((300.0, 400.0, 0.0, 0.0, 0.0, -9.0))
    assert stand.exchange.wrench[:3] == pytest.approx([0.6 * most.max_force, 0.8 * most.max_force, 0.0])
    assert stand.exchange.wrench[5] == pytest.approx(-most.max_torque)
    assert not limit_wrench(np.full(6, np.nan), most).any()


def test_the_watchdog_takes_the_force_off_and_a_wrench_brings_it_back(stand):
    stand.send((1.0,) * 6)
    for _ in range(round(WATCHDOG_TIMEOUT / PERIOD)):
        stand.period()
        assert stand.device.wrench.any()
    stand.period()
    assert not stand.device.wrench.any() and stand.exchange.watchdog_trips == 1
    stand.send((1.0,) * 6)
    stand.period()
    assert stand.device.wrench.any()


def test_a_machine_that_is_not_in_control_makes_the_device_limp(stand):
    stand.send((1.0,) * 6)
    stand.send((1.0,) * 6, FORCES_ON=0)
    stand.period()
    assert not stand.device.wrench.any()


def test_periods_without_an_answer_are_counted_and_told(stand):
    for _ in range(3):
        stand.send()
        stand.period()
    before = stand.exchange.unanswered
    stand.period()
    stand.exchange.missed = 4
    pose = stand.period()
    assert stand.exchange.unanswered == before + 2
    assert (pose.integers[UNANSWERED], pose.integers[MISSED]) == (before + 2, 4)


class Unplugged(SimulatedDevice):
    """A device whose cable can be pulled."""

    pulled = False

    def read(self):
        if self.pulled:
            raise OSError("no answer")
        return super().read()


def test_a_device_that_does_not_answer_is_told_to_be_unable():
    stand = Stand(Unplugged(PERIOD))
    stand.open()
    stand.send((1.0,) * 6)
    stand.device.pulled = True
    pose = stand.period()
    assert pose.reals[CAN_APPLY_FORCE] == 0.0 and np.isnan(pose.reals[POSITION]) and not stand.exchange.wrench.any()
    stand.device.pulled = False
    assert stand.period().reals[CAN_APPLY_FORCE] == 1.0


def test_force_returns_only_with_the_answer_to_a_pose_read_after_a_failure():
    stand = Stand(Unplugged(PERIOD))
    stand.open()
    before = int(stand.exchange.pose.integers[SEQUENCE])
    stand.device.pulled = True
    failed = int(stand.period().integers[SEQUENCE])
    for pose in (before, failed):  # computed before the failure, or by a machine that ignores it
        assert stand.send((1.0,) * 6, ANSWERED_POSE=pose)
        assert not stand.exchange.wrench.any()
    stand.device.pulled = False
    stand.period()
    assert not stand.device.wrench.any()
    assert stand.send((1.0,) * 6)
    stand.period()
    assert stand.device.wrench.any()


def test_the_simulated_handle_rests_where_hand_and_force_balance():
    facts = SimulatedDeviceParameters(motion_amplitudes=(0.0,) * 6)
    device = SimulatedDevice(PERIOD, facts)
    wrench = np.array([2.0, 0.0, -1.0, 0.0, 0.1, 0.0])
    for _ in range(6000):
        device.write(wrench, True)
        pose = device.read()
    k, kr = facts.arm_stiffness
    # 6 s are 27 time constants 2 m / b of 0.9 kg and 8 N s/m: 1e-9 m is beyond what is left
    assert pose.place == pytest.approx([2.0 / k, 0.0, -1.0 / k], abs=1e-9)
    turn = 2.0 * np.arctan2(pose.quaternion[2], pose.quaternion[0])
    assert turn == pytest.approx(0.1 / kr, abs=1e-9)


def test_the_simulated_handle_stays_within_its_stops():
    facts = SimulatedDeviceParameters(limits=DeviceLimits(0.01, 0.1, 50.0, 1.0), motion_amplitudes=(0.0,) * 6)
    device = SimulatedDevice(PERIOD, facts)
    for _ in range(2000):
        device.write(np.array([50.0, 0, 0, 0, 0, 0]), True)
        pose = device.read()
    # the stop's spring is that of 0.9 kg which turns over in 6 ms: 1 MN/m
    assert 0.01 < pose.place[0] < 0.01 + 1e-4
