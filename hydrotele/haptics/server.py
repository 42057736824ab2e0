"""Server of a haptic device: reads the handle and writes a wrench once per period, over UDP.

One machine at a time is served, the one that asked last while none was there. Safety lies here,
next to the hardware: a wrench is cut to what the device may give; one that is no number, comes out
of order, or answers a pose of long ago is not taken; and if none is taken for `WATCHDOG`, or the
machine says that it is not in control, the device goes limp.
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
WATCHDOG = 0.02  # s without a wrench after which the device goes limp
STALE = 0.02  # s: a wrench that answers an older pose is not taken
FORGET = 1.0  # s of silence after which another machine may come
_PRIORITY = 40
_SAMPLES = 700_000  # times that are kept: 11 minutes of 1 kHz

_REFUSALS = ("malformed", "stranger", "session", "late", "stale")

Address = tuple[str, int]


class ServerSummary(NamedTuple):
    """What a server has seen.

    Attributes:
        periods: that it had to make.
        missed: periods that were skipped or began more than a period late.
        unanswered: periods that began without the answer to the pose before, while served.
        refused: packets that were not taken, by reason.
        limp: how often the watchdog took the force off.
        wake: how late periods began, see `summary_of`.
        round_trip: pose sent to its answer received, see `summary_of`.
        priority: whether the system gave it.
        load: of the computer, see `load_of_machine`.
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
    """What passes between a device and a machine; knows no socket and no clock.

    Attributes:
        pose: the packet to send.
        wrench: (6,) that the device shall give now [N], [N m].
        client: whom it serves, None for nobody.
        refused: packets that were not taken, by reason.
        limp: how often the watchdog took the force off.
        unanswered: periods that began without the answer to the pose before.
        missed: periods that the device has missed.
        answered: sequence number of the last pose that was answered.
    """

    def __init__(self, device: HapticDevice, period: float, session: int) -> None:
        """Nobody is served yet.

        Args:
            device: the device.
            period: of the server [s].
            session: a number that no other start of a server has.
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
        """Read the handle, give the wrench; `pose` is then ready to be sent.

        Args:
            now: the clock [ns].

        A device that does not answer is said to be unable, and gets no wrench until it does.
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
        """Take a packet of a machine, if it may be taken.

        Args:
            data: its bytes.
            sender: where it came from.
            now: the clock [ns].

        Returns:
            Whether it was taken.
        """
        why = self._refusal(data, sender)
        if why:
            self.refused[why] += 1
            return False
        whole, real = self._answer
        if whole[SESSION] == 0:  # asks to be served
            self.client, self._last, self._heard = sender, -1, now
            self.answered, self._on = int(self.pose.whole[SEQUENCE]), False
            self.wrench[:] = 0.0
            return True
        self._last, self.answered = int(whole[SEQUENCE]), int(whole[ANSWERED])
        self._heard, self._on = now, whole[ON] == 1
        self.wrench[:] = within_limits(real[WRENCH:], self._a) if self._on else 0.0
        return True

    def _refusal(self, data, sender: Address) -> str:
        """Why a packet is not taken; it is in `_answer` if it is."""
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
    """Serve a device until it is over.

    Args:
        device: the device; it is limp afterwards, and still open.
        address: to listen on; port 0 takes a free one.
        period: [s].
        over: asked once per period whether it is over.
        opened: told where it listens.

    Returns:
        What it has seen.

    Raises:
        InputError: the address cannot be used.
    """
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        line.bind(address)
    except OSError as error:
        line.close()
        where = f"--host {address[0]} --port {address[1]}"
        raise InputError(where, f"cannot be listened on ({error.strerror or error})") from None
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
    """One period after the other; how late they began and how long answers took [ns]."""
    wake, trips = np.zeros(_SAMPLES, np.int64), np.zeros(_SAMPLES, np.int64)
    step, spin, now = round(1e9 * period), round(1e9 * SPIN), clock.monotonic_ns
    count = answers = 0
    raw, data = exchange.pose.raw, bytearray(8 * WRENCH_WORDS + 1)
    view = memoryview(data)
    due = now() + step
    while not over():
        while True:  # until the period begins, answers are taken as they come
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
            with contextlib.suppress(OSError):  # nobody listens any more: the watchdog sees to it
                line.sendto(raw, exchange.client)
        skipped = max(0, (now() - due) // step)
        exchange.missed += skipped
        due += step * (1 + skipped)
    return wake[: min(count, _SAMPLES)], trips[:answers], count


def _receive(line: socket.socket, exchange: Exchange, view: memoryview, trip, now) -> int:
    """Take one packet if there is one; whether it answered the pose of this period."""
    try:
        size, sender = line.recvfrom_into(view)
    except OSError:  # nothing there, or the one before could not be delivered
        return 0
    came = now()
    if not exchange.take(view[:size], sender, came):
        return 0
    if not len(trip) or exchange.answered != exchange.pose.whole[SEQUENCE]:
        return 0
    trip[0] = came - exchange.pose.whole[SENT]
    return 1


def announce(where: Address) -> None:
    """Tell the process that waits for it, in one line of JSON, where a server listens."""
    sys.stdout.write(json.dumps({"host": where[0], "port": where[1]}) + "\n")
    sys.stdout.flush()


KINDS = ("simulated", "force-dimension", "haption")


def open_haptic(kind: str, period: float) -> HapticDevice:
    """Open a device for its server.

    Args:
        kind: one of KINDS; `haption:HOST#PORT` for a device elsewhere.
        period: of the server [s].

    Returns:
        The device.

    Raises:
        InputError: no such kind, what it needs is not installed, or it is not connected.
    """
    if kind == "simulated":
        return SimulatedDevice(period)
    if kind == "force-dimension":
        return ForceDimension()
    name, _, address = kind.partition(":")
    if name == "haption":
        return Haption(period, address or ADDRESS)
    raise InputError(f"--kind {kind}", f"is no haptic device; valid: {', '.join(KINDS)}")
