"""Server of a haptic device: reads the handle and applies a wrench once per period, over UDP.

It serves one machine at a time: the last one that asked while no other was connected. The safety
checks are here, next to the hardware. A wrench is limited to the device's maximum. A wrench that is
not finite, arrives out of order or answers an old pose is rejected. The force is switched off if no
wrench is accepted for `WATCHDOG_TIMEOUT`, or if the machine reports that it is not in control. If the
device does not answer, the force is off until the machine answers a pose that was read after that.
"""

import contextlib
import json
import secrets
import select
import socket
import sys
import time as clock
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.haptics.device import (
    DEFAULT_HAPTION_ADDRESS,
    ForceDimension,
    HapticDevice,
    Haption,
    SimulatedDevice,
    limit_wrench,
)
from hydrotele.haptics.packets import (
    ANSWERED_POSE,
    BUTTONS,
    CAN_APPLY_FORCE,
    FORCES_ON,
    LAST_ACCEPTED,
    MAGIC,
    MISSED,
    PERIOD,
    POSE_MAGIC,
    POSE_WORDS,
    POSITION,
    QUATERNION,
    SENT,
    SEQUENCE,
    SESSION,
    TRAVEL,
    UNANSWERED,
    WRENCH,
    WRENCH_MAGIC,
    WRENCH_WORDS,
    make_packet,
)
from hydrotele.haptics.timing import (
    BUSY_WAIT_TIME,
    read_load_averages,
    reduce_timing_jitter,
    summarise_durations,
)

DEFAULT_PORT = 5610
WATCHDOG_TIMEOUT = 0.02  # s without a wrench after which the force is switched off
MAX_POSE_AGE = 0.02  # s: a wrench that answers an older pose is rejected
CLIENT_TIMEOUT = 1.0  # s without packets after which another machine may connect
_PRIORITY = 40
_MAX_SAMPLES = 700_000  # number of times that are kept: 11 minutes at 1 kHz

_REJECTION_REASONS = ("malformed", "other_client", "session", "late", "stale")

Address = tuple[str, int]


class ServerSummary(NamedTuple):
    """Statistics of a server run.

    Attributes:
        periods: number of periods.
        missed: number of periods that were skipped, because the previous one lasted beyond their
            start.
        unanswered: number of periods that started without the answer to the previous pose.
        rejected: number of rejected packets, by reason.
        watchdog_trips: number of times that the force was switched off because no wrench was
            accepted for WATCHDOG_TIMEOUT.
        wake_delay: delay of the start of a period after its deadline, see `summarise_durations`.
        round_trip: time from sending a pose to receiving its answer, see `summarise_durations`.
        priority: whether real-time priority was granted.
        load: load averages of the computer, see `read_load_averages`.
    """

    periods: int
    missed: int
    unanswered: int
    rejected: dict[str, int]
    watchdog_trips: int
    wake_delay: dict
    round_trip: dict
    priority: bool
    load: list[float] | None


class DeviceSession:
    """Protocol state between a device and a machine, independent of sockets and clocks.

    Attributes:
        pose: pose packet to send to the machine.
        wrench: (6,) wrench that the device must apply now [N], [N m].
        client: address of the connected machine, None without one.
        rejected_packets: number of rejected packets, by reason.
        watchdog_trips: number of times that the force was switched off because no wrench was
            accepted for WATCHDOG_TIMEOUT.
        unanswered: number of periods that started without the answer to the previous pose.
        missed: number of skipped periods, which the caller counts.
        answered: sequence number of the pose that the last accepted packet answers.
    """

    def __init__(self, device: HapticDevice, period: float, session: int) -> None:
        """Start without a connected machine.

        Args:
            device: the device.
            period: period of the server [s].
            session: number that is unique to this start of the server.
        """
        self._device, self._limits = device, device.limits
        self.pose, self._answer = make_packet(POSE_WORDS), make_packet(WRENCH_WORDS)
        self.pose.integers[[MAGIC, SESSION]] = POSE_MAGIC, session
        self.pose.integers[[SEQUENCE, LAST_ACCEPTED]] = -1
        self.pose.reals[TRAVEL : PERIOD + 1] = *self._limits, period
        self.wrench = np.zeros(6)
        self.client: Address | None = None
        self.rejected_packets: dict[str, int] = {why: 0 for why in _REJECTION_REASONS}
        self.watchdog_trips, self.unanswered, self.missed = 0, 0, 0
        self._last_wrench, self._last_packet_time, self._max_pose_lag = (
            -1,
            0,
            max(1, round(MAX_POSE_AGE / period)),
        )
        self._forces_on, self.answered = False, -1
        self._last_failed_pose = -1

    def apply_wrench_and_read_pose(self, now: int) -> None:
        """Run one period: check the timeouts, apply the wrench, write the handle's pose to `pose`.

        Without an accepted packet the force is switched off after WATCHDOG_TIMEOUT, and the machine
        is disconnected after CLIENT_TIMEOUT. If the device does not answer, the packet states that
        it cannot apply forces and its pose is NaN. The force is switched off until a packet answers a
        later, valid pose: wrenches computed before the failure could push a handle that has moved.

        Args:
            now: current time [ns].
        """
        whole, real = self.pose
        if self.client and whole[SEQUENCE] >= 0 and self.answered < whole[SEQUENCE]:
            self.unanswered += 1
        if self.client and now - self._last_packet_time > 1e9 * WATCHDOG_TIMEOUT and self._forces_on:
            self._forces_on = False
            self.watchdog_trips += 1
            self.wrench[:] = 0.0
        if self.client and now - self._last_packet_time > 1e9 * CLIENT_TIMEOUT:
            self.client = None
        try:
            self._device.write(self.wrench, self._forces_on)
            place, quaternion, buttons = self._device.read()
            real[POSITION:QUATERNION], real[QUATERNION:TRAVEL] = place, quaternion
            whole[BUTTONS], real[CAN_APPLY_FORCE] = buttons, 1.0
        except OSError:
            real[POSITION:TRAVEL], real[CAN_APPLY_FORCE] = np.nan, 0.0
            self.wrench[:], self._forces_on = 0.0, False
            self._last_failed_pose = int(whole[SEQUENCE]) + 1
        whole[SEQUENCE] += 1
        whole[LAST_ACCEPTED], whole[SENT] = self._last_wrench, now
        whole[MISSED], whole[UNANSWERED] = self.missed, self.unanswered

    def accept_packet(self, data: bytes | memoryview, sender: Address, now: int) -> bool:
        """Check a packet from a machine, and use it if it is valid.

        A valid wrench packet replaces `wrench`, limited to the device's maximum. It sets zero if the
        machine is not in control, or if it answers a pose of before the device's last failure. A
        valid connection request makes its sender the connected machine. A rejected packet is only
        counted, by its reason.

        Args:
            data: bytes of the packet.
            sender: address of the sender.
            now: current time [ns].

        Returns:
            Whether the packet was accepted.
        """
        why = self._rejection_reason(data, sender)
        if why:
            self.rejected_packets[why] += 1
            return False
        whole, real = self._answer
        if whole[SESSION] == 0:  # connection request
            self.client, self._last_wrench, self._last_packet_time = sender, -1, now
            self.answered, self._forces_on = int(self.pose.integers[SEQUENCE]), False
            self.wrench[:] = 0.0
            return True
        self._last_wrench, self.answered = int(whole[SEQUENCE]), int(whole[ANSWERED_POSE])
        self._last_packet_time = now
        self._forces_on = whole[FORCES_ON] == 1 and self.answered > self._last_failed_pose
        self.wrench[:] = limit_wrench(real[WRENCH:], self._limits) if self._forces_on else 0.0
        return True

    def _rejection_reason(self, data, sender: Address) -> str:
        """Return the reason to reject a packet, or an empty string; copy the packet to `_answer`.

        Reasons: `malformed` (length, first word, or a value that is not finite), `other_client`,
        `session`, `late` (sequence number not above the last one), `stale` (answers an old pose).
        """
        if len(data) != 8 * WRENCH_WORDS:
            return "malformed"
        self._answer.byte_view[:] = data
        whole, real = self._answer
        if whole[MAGIC] != WRENCH_MAGIC or not np.isfinite(real[WRENCH:]).all():
            return "malformed"
        if whole[SESSION] == 0 and self.client in (None, sender):
            return ""
        if sender != self.client:
            return "other_client"
        if whole[SESSION] != self.pose.integers[SESSION]:
            return "session"
        if whole[SEQUENCE] <= self._last_wrench:
            return "late"
        behind = self.pose.integers[SEQUENCE] - whole[ANSWERED_POSE]
        return "" if 0 <= behind <= self._max_pose_lag else "stale"


def run_device_server(
    device: HapticDevice, address: Address, period: float, should_stop: Callable[[], bool],
    on_open: Callable[[Address], None] = lambda where: None,
) -> ServerSummary:  # fmt: skip
    """Run the UDP server of a device until `should_stop` returns true.

    Once per period the wrench is applied, the handle is read, and its pose is sent to the machine.

    Args:
        device: the device; its force is off afterwards, and it stays open.
        address: address to listen on; port 0 selects a free port.
        period: period of the server [s].
        should_stop: called once per period; returns whether to stop.
        on_open: called with the address that the server listens on.

    Returns:
        Statistics of the run.

    Raises:
        InputError: the address cannot be used.
    """
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        line.bind(address)
    except OSError as error:
        line.close()
        where = f"--host {address[0]} --port {address[1]}"
        raise InputError(where, f"cannot be used as address ({error.strerror or error})") from None
    line.setblocking(False)
    exchange = DeviceSession(device, period, secrets.randbits(62) + 1)
    on_open(line.getsockname())
    with line, reduce_timing_jitter(_PRIORITY) as priority:
        try:
            wake, trips, periods = _run_server_periods(line, exchange, period, should_stop)
        finally:
            with contextlib.suppress(OSError):  # a device that no longer answers applies no force either
                device.write(np.zeros(6), False)
    return ServerSummary(
        periods, exchange.missed, exchange.unanswered, exchange.rejected_packets, exchange.watchdog_trips,
        summarise_durations(wake), summarise_durations(trips), priority, read_load_averages(),
    )  # fmt: skip


def _run_server_periods(
    line: socket.socket, exchange: DeviceSession, period: float, over: Callable[[], bool]
) -> tuple[np.ndarray, np.ndarray, int]:
    """Run the server's periods one after the other until `over()` is true.

    `line` is the UDP socket, `exchange` the session. Return the delays of the starts of the periods
    [ns], the times from sending a pose to receiving its answer [ns], and the number of periods.
    """
    wake, trips = np.zeros(_MAX_SAMPLES, np.int64), np.zeros(_MAX_SAMPLES, np.int64)
    step, spin, now = round(1e9 * period), round(1e9 * BUSY_WAIT_TIME), clock.monotonic_ns
    count = answers = 0
    raw, data = exchange.pose.byte_view, bytearray(8 * WRENCH_WORDS + 1)
    view = memoryview(data)
    due = now() + step
    while not over():
        while True:  # receive answers until the period starts
            left = due - now()
            if left <= 0:
                break
            if left > spin:
                select.select([line], [], [], 1e-9 * (left - spin))
            answers += _receive_packet(line, exchange, view, trips[answers : answers + 1], now)
        began = now()
        wake[count % _MAX_SAMPLES] = began - due
        exchange.apply_wrench_and_read_pose(began)
        count += 1
        if exchange.client:
            with contextlib.suppress(OSError):  # no listener: the watchdog handles it
                line.sendto(raw, exchange.client)
        skipped = max(0, (now() - due) // step)
        exchange.missed += skipped
        due += step * (1 + skipped)
    return wake[: min(count, _MAX_SAMPLES)], trips[:answers], count


def _receive_packet(line: socket.socket, exchange: DeviceSession, view: memoryview, trip, now) -> int:
    """Receive at most one packet and pass it to the session `exchange`.

    `view` is the receive buffer and `now` returns the time [ns]. Return 1 if the packet is accepted
    and answers the pose of this period, and write the time since that pose was sent [ns] to
    `trip[0]`. Otherwise, or if `trip` is empty, return 0.
    """
    try:
        size, sender = line.recvfrom_into(view)
    except OSError:  # no packet, or the previous one could not be delivered
        return 0
    came = now()
    if not exchange.accept_packet(view[:size], sender, came):
        return 0
    if not len(trip) or exchange.answered != exchange.pose.integers[SEQUENCE]:
        return 0
    trip[0] = came - exchange.pose.integers[SENT]
    return 1


def print_address(address: Address) -> None:
    """Print the address of a server as one line of JSON, for the process that waits for it."""
    sys.stdout.write(json.dumps({"host": address[0], "port": address[1]}) + "\n")
    sys.stdout.flush()


DEVICE_KINDS = ("simulated", "force-dimension", "haption")


def open_haptic_device(kind: str, period: float) -> HapticDevice:
    """Open a device for its server.

    Args:
        kind: one of DEVICE_KINDS; `haption:HOST#PORT` for a device at another address.
        period: period of the server [s].

    Returns:
        The open device.

    Raises:
        InputError: the kind is not known, its software is missing, or no device is connected.
    """
    if kind == "simulated":
        return SimulatedDevice(period)
    if kind == "force-dimension":
        return ForceDimension()
    name, _, address = kind.partition(":")
    if name == "haption":
        return Haption(period, address or DEFAULT_HAPTION_ADDRESS)
    raise InputError(f"--kind {kind}", f"is not a haptic device; valid: {', '.join(DEVICE_KINDS)}")
