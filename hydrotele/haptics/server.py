"""Server of a haptic device: reads the handle and applies a wrench once per period, over UDP.

It serves one machine at a time: the last one that asked while no other was connected. The safety
checks are here, next to the hardware. A wrench is limited to the device's maximum. A wrench that is
not finite, arrives out of order or answers an old pose is rejected. The force is switched off if no
wrench is accepted for `WATCHDOG`, or if the machine reports that it is not in control.
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
    ADDRESS,
    ForceDimension,
    HapticDevice,
    Haption,
    SimulatedDevice,
    within_limits,
)
from hydrotele.haptics.packets import (
    ABLE,
    ANSWERED,
    BUTTONS,
    MAGIC,
    MISSED,
    ON,
    PERIOD,
    PLACE,
    POSE_MAGIC,
    POSE_WORDS,
    QUATERNION,
    SENT,
    SEQUENCE,
    SESSION,
    TAKEN,
    TRAVEL,
    UNANSWERED,
    WRENCH,
    WRENCH_MAGIC,
    WRENCH_WORDS,
    packet,
)
from hydrotele.haptics.timing import SPIN, load_of_machine, steady, summary_of

PORT = 5610
WATCHDOG = 0.02  # s without a wrench after which the force is switched off
STALE = 0.02  # s: a wrench that answers an older pose is rejected
FORGET = 1.0  # s without packets after which another machine may connect
_PRIORITY = 40
_SAMPLES = 700_000  # number of times that are kept: 11 minutes at 1 kHz

_REFUSALS = ("malformed", "stranger", "session", "late", "stale")

Address = tuple[str, int]


class ServerSummary(NamedTuple):
    """Statistics of a server run.

    Attributes:
        periods: number of periods.
        missed: number of periods that were skipped or started more than a period late.
        unanswered: number of periods that started without the answer to the previous pose.
        refused: number of rejected packets, by reason.
        limp: number of times that the watchdog switched the force off.
        wake: delay of the start of a period, see `summary_of`.
        round_trip: time from sending a pose to receiving its answer, see `summary_of`.
        priority: whether real-time priority was granted.
        load: load averages of the computer, see `load_of_machine`.
    """

    periods: int
    missed: int
    unanswered: int
    refused: dict[str, int]
    limp: int
    wake: dict
    round_trip: dict
    priority: bool
    load: list[float] | None


class Exchange:
    """Protocol state between a device and a machine, independent of sockets and clocks.

    Attributes:
        pose: packet to send.
        wrench: (6,) wrench that the device must apply now [N], [N m].
        client: address of the connected machine, None without one.
        refused: number of rejected packets, by reason.
        limp: number of times that the watchdog switched the force off.
        unanswered: number of periods that started without the answer to the previous pose.
        missed: number of periods that the device has missed.
        answered: sequence number of the last answered pose.
    """

    def __init__(self, device: HapticDevice, period: float, session: int) -> None:
        """Start without a connected machine.

        Args:
            device: the device.
            period: period of the server [s].
            session: number that is unique to this start of the server.
        """
        self._device, self._a = device, device.abilities
        self.pose, self._answer = packet(POSE_WORDS), packet(WRENCH_WORDS)
        self.pose.whole[[MAGIC, SESSION]] = POSE_MAGIC, session
        self.pose.whole[[SEQUENCE, TAKEN]] = -1
        self.pose.real[TRAVEL : PERIOD + 1] = *self._a, period
        self.wrench = np.zeros(6)
        self.client: Address | None = None
        self.refused: dict[str, int] = {why: 0 for why in _REFUSALS}
        self.limp, self.unanswered, self.missed = 0, 0, 0
        self._last, self._heard, self._stale = -1, 0, max(1, round(STALE / period))
        self._on, self.answered = False, -1

    def next_pose(self, now: int) -> None:
        """Apply the wrench and read the handle into `pose`, which can then be sent.

        Args:
            now: current time [ns].

        A device that does not answer is reported as unable and gets a zero wrench until it answers.
        """
        whole, real = self.pose
        if self.client and whole[SEQUENCE] >= 0 and self.answered < whole[SEQUENCE]:
            self.unanswered += 1
        if self.client and now - self._heard > 1e9 * WATCHDOG and self._on:
            self._on = False
            self.limp += 1
            self.wrench[:] = 0.0
        if self.client and now - self._heard > 1e9 * FORGET:
            self.client = None
        try:
            self._device.write(self.wrench, self._on)
            place, quaternion, buttons = self._device.read()
            real[PLACE:QUATERNION], real[QUATERNION:TRAVEL] = place, quaternion
            whole[BUTTONS], real[ABLE] = buttons, 1.0
        except OSError:
            real[PLACE:TRAVEL], real[ABLE] = np.nan, 0.0
            self.wrench[:] = 0.0
        whole[SEQUENCE] += 1
        whole[TAKEN], whole[SENT] = self._last, now
        whole[MISSED], whole[UNANSWERED] = self.missed, self.unanswered

    def take(self, data: bytes | memoryview, sender: Address, now: int) -> bool:
        """Check a packet from a machine and accept it if it is valid.

        Args:
            data: bytes of the packet.
            sender: address of the sender.
            now: current time [ns].

        Returns:
            Whether the packet was accepted.
        """
        why = self._refusal(data, sender)
        if why:
            self.refused[why] += 1
            return False
        whole, real = self._answer
        if whole[SESSION] == 0:  # connection request
            self.client, self._last, self._heard = sender, -1, now
            self.answered, self._on = int(self.pose.whole[SEQUENCE]), False
            self.wrench[:] = 0.0
            return True
        self._last, self.answered = int(whole[SEQUENCE]), int(whole[ANSWERED])
        self._heard, self._on = now, whole[ON] == 1
        self.wrench[:] = within_limits(real[WRENCH:], self._a) if self._on else 0.0
        return True

    def _refusal(self, data, sender: Address) -> str:
        """Return the reason to reject a packet, or an empty string; parse it into `_answer`."""
        if len(data) != 8 * WRENCH_WORDS:
            return "malformed"
        self._answer.raw[:] = data
        whole, real = self._answer
        if whole[MAGIC] != WRENCH_MAGIC or not np.isfinite(real[WRENCH:]).all():
            return "malformed"
        if whole[SESSION] == 0 and self.client in (None, sender):
            return ""
        if sender != self.client:
            return "stranger"
        if whole[SESSION] != self.pose.whole[SESSION]:
            return "session"
        if whole[SEQUENCE] <= self._last:
            return "late"
        behind = self.pose.whole[SEQUENCE] - whole[ANSWERED]
        return "" if 0 <= behind <= self._stale else "stale"


def serve(
    device: HapticDevice, address: Address, period: float, over: Callable[[], bool],
    opened: Callable[[Address], None] = lambda where: None,
) -> ServerSummary:  # fmt: skip
    """Run the server of a device until `over` returns true.

    Args:
        device: the device; its force is off afterwards, and it stays open.
        address: address to listen on; port 0 selects a free port.
        period: period of the server [s].
        over: called once per period; returns whether to stop.
        opened: called with the address that the server listens on.

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
    exchange = Exchange(device, period, secrets.randbits(62) + 1)
    opened(line.getsockname())
    with line, steady(_PRIORITY) as priority:
        wake, trips, periods = _periods(line, exchange, period, over)
        device.write(np.zeros(6), False)
    return ServerSummary(
        periods, exchange.missed, exchange.unanswered, exchange.refused, exchange.limp,
        summary_of(wake), summary_of(trips), priority, load_of_machine(),
    )  # fmt: skip


def _periods(
    line: socket.socket, exchange: Exchange, period: float, over: Callable[[], bool]
) -> tuple[np.ndarray, np.ndarray, int]:
    """Run one period after the other; return start delays [ns], answer times [ns], period count."""
    wake, trips = np.zeros(_SAMPLES, np.int64), np.zeros(_SAMPLES, np.int64)
    step, spin, now = round(1e9 * period), round(1e9 * SPIN), clock.monotonic_ns
    count = answers = 0
    raw, data = exchange.pose.raw, bytearray(8 * WRENCH_WORDS + 1)
    view = memoryview(data)
    due = now() + step
    while not over():
        while True:  # receive answers until the period starts
            left = due - now()
            if left <= 0:
                break
            if left > spin:
                select.select([line], [], [], 1e-9 * (left - spin))
            answers += _receive(line, exchange, view, trips[answers : answers + 1], now)
        began = now()
        wake[count % _SAMPLES] = began - due
        exchange.next_pose(began)
        count += 1
        if exchange.client:
            with contextlib.suppress(OSError):  # no listener: the watchdog handles it
                line.sendto(raw, exchange.client)
        skipped = max(0, (now() - due) // step)
        exchange.missed += skipped
        due += step * (1 + skipped)
    return wake[: min(count, _SAMPLES)], trips[:answers], count


def _receive(line: socket.socket, exchange: Exchange, view: memoryview, trip, now) -> int:
    """Receive one packet, if any, and return whether it answered the pose of this period."""
    try:
        size, sender = line.recvfrom_into(view)
    except OSError:  # no packet, or the previous one could not be delivered
        return 0
    came = now()
    if not exchange.take(view[:size], sender, came):
        return 0
    if not len(trip) or exchange.answered != exchange.pose.whole[SEQUENCE]:
        return 0
    trip[0] = came - exchange.pose.whole[SENT]
    return 1


def announce(where: Address) -> None:
    """Print the address of a server as one line of JSON, for the process that waits for it."""
    sys.stdout.write(json.dumps({"host": where[0], "port": where[1]}) + "\n")
    sys.stdout.flush()


KINDS = ("simulated", "force-dimension", "haption")


def open_haptic(kind: str, period: float) -> HapticDevice:
    """Open a device for its server.

    Args:
        kind: one of KINDS; `haption:HOST#PORT` for a device at another address.
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
        return Haption(period, address or ADDRESS)
    raise InputError(f"--kind {kind}", f"is not a haptic device; valid: {', '.join(KINDS)}")
