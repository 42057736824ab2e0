"""The machine's end of the line to a haptic device: the joystick's reflection at the device's rate.

A thread of compiled code, without Python's lock, answers every pose that comes with a wrench: the
law of the joystick (`teleop.master`) with what the machine has sent last. The machine's simulation
goes on beside it at its own rate; the two meet in a mailbox. The device's travel is scaled to that
of the joystick, forces are not.

Safety: a device that is silent for `SILENT` leaves the machine without a command until its handle
has been in its dead bands again. A machine that is silent fades what it reflects, then gives no
force at all; forces come back over `RAMP`.
"""

import socket
import threading
import time as clock
from typing import Any, NamedTuple

import numpy as np
from numba import types

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record, floats, integers, rows_of
from hydrotele.haptics.device import HandlePose
from hydrotele.haptics.packets import (
    ABLE,
    ANSWERED,
    BUTTONS,
    MAGIC,
    MISSED,
    MOST,
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
from hydrotele.haptics.timing import ask_for_priority, summary_of
from hydrotele.teleop.axis_table import COORDINATE, DEADBAND, REACH, flat_state, flat_view
from hydrotele.teleop.master import (
    KINDS,
    Master,
    MasterState,
    master_step,
    unpack_master,
    unpack_master_state,
)

SILENT = 0.05  # s without a pose after which the machine gets no command
FADED = 0.05  # s without the machine after which nothing of it is reflected
OFF = 0.15  # s without the machine after which there is no force
RAMP = 0.3  # s over which forces come back
# Others estimate the hand's force from the mass of the joystick's own flotor, or keep what is on
# the line in the state of one master.
REFLECTIONS = ("none", "stiffness", "direct_force", "coordinating_force", "impedance")
_ASK = 100_000_000  # ns between two requests to be served
_WAIT = 0.005  # s that the thread waits for a pose before it looks whether it is over
_CENTRED = 0.1  # of its reach: where an axis without a dead band counts as centred
_SAMPLES = 700_000  # times that are kept: 11 minutes of 1 kHz
_SENT_KEPT = 1024
_PRIORITY = 30

# places in `Line.count`
(STOP, SESSION_OF, LAST, NEXT, TAKEN_LAST, RECEIVED, LOST, LATE, MALFORMED, STARTS, ASKED, SENT_AT,
 ANSWERS, ROUNDS, INTERVALS, CAME_AT) = range(16)  # fmt: skip
# places in `Line.ramp`
GAIN, SCALE, TURN_SCALE = range(3)


class Line(NamedTuple):
    """What the thread works with.

    Attributes:
        pose: (21,) the packet that came, as integers; pose_real: as reals.
        pose_real: see above.
        reply: (12,) the packet to send; reply_real: as reals.
        reply_real: see above.
        count: (16,) numbers of the line, see the places above [1], [ns].
        ramp: (3,) share of the forces that is given, scale of places and of turns.
        sent: (1024,) when a wrench was sent, by its sequence number [ns].
        answers: (n,) time from a pose's arrival until its answer was sent [ns].
        rounds: (n,) time from a wrench's sending until a pose said that it was taken [ns].
        intervals: (n,) time between two poses [ns].
        reach: (2,) of the joystick [m], [rad].
    """

    pose: np.ndarray
    pose_real: np.ndarray
    reply: np.ndarray
    reply_real: np.ndarray
    count: np.ndarray
    ramp: np.ndarray
    sent: np.ndarray
    answers: np.ndarray
    rounds: np.ndarray
    intervals: np.ndarray
    reach: np.ndarray


class Mailbox(NamedTuple):
    """Where thread and simulation meet; an odd turn says that its part is being written.

    Attributes:
        turn: (2,) of the handle's part and of the machine's.
        stamp: (2,) when a part was written [ns]; 0 before.
        handle: (8,) pose of the handle on the joystick's scale [m], quaternion, and its buttons.
        packet: (rows, k) what came from the machine, see `teleop.master`.
        share: (1,) of the packet that counts.
        extra: (6,) further force on the handle [N], [N m].
        numbers: flat Master.
        state: flat MasterState, the thread's own.
    """

    turn: np.ndarray
    stamp: np.ndarray
    handle: np.ndarray
    packet: np.ndarray
    share: np.ndarray
    extra: np.ndarray
    numbers: np.ndarray
    state: np.ndarray


_HANDLE, _MACHINE = range(2)

_recv = types.ExternalFunction(
    "recv", types.int64(types.int32, types.uintp, types.uint64, types.int32)
)
_send = types.ExternalFunction(
    "send", types.int64(types.int32, types.uintp, types.uint64, types.int32)
)
_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.uintp))
_MONOTONIC = clock.CLOCK_MONOTONIC


@compiled
def _now(two):
    """The clock of `time.monotonic_ns` [ns]; the call keeps other memory from being cached."""
    _gettime(np.int32(_MONOTONIC), two.ctypes.data)
    return two[0] * 1_000_000_000 + two[1]


@compiled
def scaled_pose(place, quaternion, scale, turn_scale, out):
    """Pose of a device's handle on the joystick's scale.

    Args:
        place: (3,) [m].
        quaternion: (4,) scalar first.
        scale: of places, scalar.
        turn_scale: of the angle of turning, scalar.
        out: (>= 7,) written: place [m] and quaternion.

    Returns:
        Nothing.

    Source: rotation vector of a quaternion.
    """
    for i in range(3):
        out[i] = scale * place[i]
    w, size = quaternion[0], 0.0
    for i in range(1, 4):
        size += quaternion[i] * quaternion[i]
    size = np.sqrt(size)
    half = turn_scale * np.arctan2(size, abs(w))
    out[3] = np.cos(half)
    share = np.sin(half) / size if size > 1e-12 else turn_scale
    for i in range(3):
        out[4 + i] = share * (quaternion[1 + i] if w >= 0.0 else -quaternion[1 + i])


@compiled
def answer_pose(line, box, now, two):
    """Answer a pose: the joystick's law at the device's rate.

    Args:
        line: Line; `pose` has come. `reply`, `count` and `ramp` are written.
        box: Mailbox; the handle's part and `state` are written.
        now: when it came, scalar [ns].
        two: (2,) work space of the clock.

    Returns:
        Whether `reply` is to be sent.

    Source: `teleop.master`; this module.
    """
    pose, real, count = line.pose, line.pose_real, line.count
    if pose[MAGIC] != POSE_MAGIC or not real[PERIOD] > 0.0:
        count[MALFORMED] += 1
        return False
    if pose[SESSION] != count[SESSION_OF]:  # a server that has just started
        count[SESSION_OF], count[LAST], count[NEXT], count[TAKEN_LAST] = pose[SESSION], -1, 0, -1
        count[STARTS] += 1
        line.ramp[GAIN] = 0.0
    if pose[SEQUENCE] <= count[LAST]:
        count[LATE] += 1
        return False
    first = count[LAST] < 0
    if not first:
        count[LOST] += pose[SEQUENCE] - count[LAST] - 1
        line.intervals[count[INTERVALS] % len(line.intervals)] = now - count[CAME_AT]
        count[INTERVALS] += 1
    nominal = real[PERIOD]
    period = 1e-9 * (pose[SENT] - count[SENT_AT])
    period = nominal if first else min(20.0 * nominal, max(0.25 * nominal, period))
    count[LAST], count[SENT_AT], count[CAME_AT] = pose[SEQUENCE], pose[SENT], now
    count[RECEIVED] += 1
    if pose[TAKEN] > count[TAKEN_LAST]:
        line.rounds[count[ROUNDS] % len(line.rounds)] = now - line.sent[pose[TAKEN] % _SENT_KEPT]
        count[ROUNDS] += 1
        count[TAKEN_LAST] = pose[TAKEN]
    _reflected(line, box, now, two, first, period)
    reply, out = line.reply, line.reply_real
    reply[MAGIC], reply[SESSION], reply[SEQUENCE] = WRENCH_MAGIC, pose[SESSION], count[NEXT]
    reply[ANSWERED] = pose[SEQUENCE]
    reply[ON] = 1 if line.ramp[GAIN] > 0.0 else 0
    m = unpack_master_state(box.state)
    for part in range(2):
        size = 0.0
        for i in range(3 * part, 3 * part + 3):
            out[WRENCH + i] = line.ramp[GAIN] * m.push[i]
            size += out[WRENCH + i] ** 2
        size, most = np.sqrt(size), real[MOST + part]
        share = most / size if size > most else 1.0
        for i in range(3 * part, 3 * part + 3):
            out[WRENCH + i] = share * out[WRENCH + i] if np.isfinite(size) else 0.0
    count[NEXT] += 1
    return True


@compiled
def _reflected(line, box, now, two, first, period):
    """Put the pose into the mailbox, and the law's push into the thread's state."""
    real = line.pose_real
    scale = line.reach[0] / real[TRAVEL] if real[TRAVEL] > 0.0 else 0.0
    turns = line.reach[1] / real[TRAVEL + 1] if real[TRAVEL + 1] > 0.0 else 0.0
    box.turn[_HANDLE] += 1
    _now(two)
    scaled_pose(real[PLACE:QUATERNION], real[QUATERNION:TRAVEL], scale, turns, box.handle)
    box.handle[7] = line.pose[BUTTONS]
    if not (real[ABLE] == 1.0 and np.isfinite(real[PLACE:TRAVEL]).all()):
        box.handle[:7] = np.nan
    _now(two)
    box.stamp[_HANDLE] = now
    box.turn[_HANDLE] += 1
    packet, state = np.empty(box.packet.shape), unpack_master_state(box.state)
    share, when = 0.0, np.int64(0)
    for _ in range(8):  # the machine writes for a microsecond once in a millisecond
        turn = box.turn[_MACHINE]
        _now(two)
        packet[:] = box.packet
        state.extra[:] = box.extra
        share, when = box.share[0], box.stamp[_MACHINE]
        _now(two)
        if turn % 2 == 0 and turn == box.turn[_MACHINE]:
            break
    age = 1e-9 * (now - when)
    alive = when > 0 and age < OFF
    able = np.isfinite(box.handle[0])
    line.ramp[GAIN] = min(1.0, line.ramp[GAIN] + period / RAMP) if alive and able else 0.0
    fresh = share if age < FADED else 0.0
    master_step(unpack_master(box.numbers), box.handle[:7], packet, fresh, period, first, state)


@compiled
def _answer_all(handle, line, box):
    """Answer poses until `count[STOP]` is set."""
    two, count = np.zeros(2, np.int64), line.count
    size, answer = np.uint64(8 * POSE_WORDS), np.uint64(8 * WRENCH_WORDS)
    while count[STOP] == 0:
        got = _recv(np.int32(handle), line.pose.ctypes.data, size, np.int32(0))
        now = _now(two)
        if now - max(count[ASKED], count[CAME_AT]) > _ASK:  # nobody is there, or has forgotten us
            line.reply[:] = 0
            line.reply[MAGIC], line.reply[SENT] = WRENCH_MAGIC, now
            count[ASKED] = now
            _send(np.int32(handle), line.reply.ctypes.data, answer, np.int32(0))
        if got < 0:
            continue
        if got != 8 * POSE_WORDS:
            count[MALFORMED] += 1
        elif answer_pose(line, box, now, two):
            line.reply[SENT] = _now(two)
            line.sent[line.reply[SEQUENCE] % _SENT_KEPT] = line.reply[SENT]
            _send(np.int32(handle), line.reply.ctypes.data, answer, np.int32(0))
            line.answers[count[ANSWERS] % len(line.answers)] = _now(two) - now
            count[ANSWERS] += 1


_MACHINE_MAIL = np.dtype(
    [(name, np.int64) for name in ("rows", "columns")]
    + [(name, np.int64) for name in ("turn", "stamp", "handle")]  # addresses from here on
    + [(name, np.int64) for name in ("packet", "share", "extra", "dead")],
    align=True,
)


@compiled
def take_pose(mail, now, pose):
    """Take the handle's pose out of the mailbox.

    Args:
        mail: (1,) record of a Mailbox and of the dead bands.
        now: scalar [ns].
        pose: (8,) written: place on the joystick's scale [m], quaternion, buttons.

    Returns:
        Whether there is one, not older than `SILENT`.

    Source: this module.
    """
    r, two, when = mail[0], np.empty(2, np.int64), np.int64(0)
    turn, stamp, handle = integers(r.turn, 2), integers(r.stamp, 2), floats(r.handle, 8)
    for _ in range(8):
        before = turn[_HANDLE]
        _now(two)
        pose[:] = handle
        when = stamp[_HANDLE]
        _now(two)
        if before % 2 == 0 and before == turn[_HANDLE]:
            return now - when <= 1e9 * SILENT and np.isfinite(pose).all()
    return False


@compiled
def meet(mail, qpos, packet, share, extra, engaged, now):
    """The machine's turn at the mailbox: leave what is to be reflected, take the pose.

    Args:
        mail: see `take_pose`.
        qpos: (7,) written, see `Link.exchange`.
        packet: (rows, k) see `Link.exchange`.
        share: of it that counts, scalar.
        extra: (6,) further force on the handle [N], [N m].
        engaged: whether the handle has been in its dead bands, scalar.
        now: scalar [ns].

    Returns:
        Whether it is or has been there.

    Source: this module.
    """
    r, two, pose = mail[0], np.empty(2, np.int64), np.empty(8)
    turn = integers(r.turn, 2)
    turn[_MACHINE] += 1
    _now(two)
    rows_of(r.packet, r.rows, r.columns)[:] = packet
    floats(r.extra, 6)[:] = extra
    floats(r.share, 1)[0], integers(r.stamp, 2)[_MACHINE] = share, now
    _now(two)
    turn[_MACHINE] += 1
    there = take_pose(mail, now, pose)
    engaged = there and (engaged or _centred(pose, floats(r.dead, 6)))
    for i in range(7):
        qpos[i] = pose[i] if engaged else np.nan
    return engaged


@compiled
def _centred(pose, dead):
    """Whether no axis of the joystick would command anything."""
    for i in range(3):
        if not (abs(pose[i]) <= dead[i] and 2.0 * abs(pose[4 + i]) <= dead[3 + i]):
            return False
    return True


class Link:
    """The line to a device, open from the beginning; the thread runs from `start` to `close`."""

    def __init__(self, host: str, port: int) -> None:
        """Open a socket; whether somebody is there is told later.

        Args:
            host: name or address of the device's server.
            port: its port.

        Raises:
            InputError: there is no such host.
        """
        where = f"--device haptic:{host}:{port}"
        try:
            address = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4]
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.connect(address)
        except OSError as error:
            raise InputError(where, f"cannot be reached ({error.strerror or error})") from None
        pose, reply = packet(POSE_WORDS), packet(WRENCH_WORDS)
        self.line = Line(
            *pose, *reply, np.zeros(16, np.int64), np.zeros(3), np.zeros(_SENT_KEPT, np.int64),
            np.zeros(_SAMPLES, np.int64), np.zeros(_SAMPLES, np.int64),
            np.zeros(_SAMPLES, np.int64), np.zeros(2),
        )  # fmt: skip
        self.line.count[[LAST, TAKEN_LAST]] = -1
        self.box: Mailbox | None = None
        self._thread: threading.Thread | None = None
        self.priority, self.engaged = False, False
        self._before = np.zeros(2, np.int64)

    def start(self, numbers: Master, like: MasterState, rows: tuple[int, ...]) -> None:
        """Begin to answer poses.

        Args:
            numbers: of the master's control.
            like: a state of it, which the thread's own is like.
            rows: shape of the machine's packets.

        Raises:
            InputError: the structure needs more than a pose and the machine's packet.
        """
        kind = KINDS[int(numbers.kind[0])]
        if kind not in REFLECTIONS:
            message = f"{kind!r} does not go with a haptic device; valid: {', '.join(REFLECTIONS)}"
            raise InputError("pilot.reflection", message)
        state = flat_state(MasterState, [part.shape for part in like])
        state.limited[:] = 1.0
        self.box = Mailbox(
            np.zeros(2, np.int64), np.zeros(2, np.int64), np.full(8, np.nan), np.zeros(rows),
            np.zeros(1), np.zeros(6), flat_view(numbers), flat_view(state),
        )  # fmt: skip
        self._axis = numbers.axis
        self.line.reach[:] = numbers.axis[:3, REACH].max(), numbers.axis[3:, REACH].max()
        self._dead = np.where(
            numbers.axis[:, DEADBAND] > 0.0, numbers.axis[:, DEADBAND],
            _CENTRED * numbers.axis[:, REACH],
        )  # fmt: skip
        self._dead[numbers.axis[:, COORDINATE] < 0.0] = np.inf  # moves nothing
        shared = ("turn", "stamp", "handle", "packet", "share", "extra")
        arrays = {name: getattr(self.box, name) for name in shared}
        self._mail = address_record(_MACHINE_MAIL, {**arrays, "dead": self._dead})
        self._mail["rows"], self._mail["columns"] = rows
        self.line.count[STOP] = 1
        _answer_all(self._socket.fileno(), self.line, self.box)  # compiles
        self.line.count[STOP] = 0
        seconds = int(_WAIT), round(1e6 * (_WAIT % 1.0))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _timeval(*seconds))
        self._thread = threading.Thread(target=self._run, name="haptic link", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        self.priority = ask_for_priority(_PRIORITY)
        _answer_all(self._socket.fileno(), self.line, self.box)

    def exchange(
        self, qpos: np.ndarray, packet: np.ndarray, share: float, extra: np.ndarray
    ) -> None:
        """What the machine does once per tick: take the pose, leave what is to be reflected.

        Args:
            qpos: (7,) written: the handle on the joystick's scale [m], quaternion; not a number
                while nobody is there, or until the handle has been in its dead bands again.
            packet: what came from the machine.
            share: of it that counts.
            extra: (6,) further force on the handle [N], [N m].
        """
        now = clock.monotonic_ns()
        self.engaged = meet(self._mail, qpos, packet, share, extra, self.engaged, now)

    def pose(self) -> HandlePose | None:
        """The handle on the joystick's scale; None while no pose comes."""
        values = np.empty(8)
        if not take_pose(self._mail, clock.monotonic_ns(), values):
            return None
        return HandlePose(values[:3], values[3:7], int(values[7]))

    def restart_figures(self) -> None:
        """Forget what the line has seen so far, such as a device that waited for the machine."""
        line = self.line
        line.count[[ANSWERS, ROUNDS, INTERVALS, RECEIVED, LOST, LATE, MALFORMED]] = 0
        self._before = line.pose[[MISSED, UNANSWERED]]

    def figures(self) -> dict[str, Any]:
        """What the line has seen: counts, and times as of `timing.summary_of`."""
        line, count = self.line, self.line.count
        return {
            "poses": int(count[RECEIVED]),
            "lost": int(count[LOST]),
            "late": int(count[LATE]),
            "malformed": int(count[MALFORMED]),
            "device_starts": int(count[STARTS]),
            "device_missed": int(line.pose[MISSED] - self._before[0]),
            "device_unanswered": int(line.pose[UNANSWERED] - self._before[1]),
            "priority": self.priority,
            "answer": summary_of(line.answers[: count[ANSWERS]]),
            "loop": summary_of(line.rounds[: count[ROUNDS]]),
            "interval": summary_of(line.intervals[: count[INTERVALS]]),
        }

    def close(self) -> None:
        """End the thread; the device then goes limp."""
        self.line.count[STOP] = 1
        if self._thread:
            self._thread.join()
            self._thread = None
        self._socket.close()


def _timeval(seconds: int, microseconds: int) -> bytes:
    """A `struct timeval` of C."""
    import struct

    return struct.pack("@ll", seconds, microseconds)
