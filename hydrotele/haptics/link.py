"""Connection from a simulated machine to a haptic device, with force reflection at device rate.

A compiled thread that does not hold Python's global lock answers every pose packet with a wrench.
It computes the wrench with the joystick's control law (`teleop.master`) from the machine's latest
packet. The machine simulation runs concurrently at its own rate; both exchange data through a
mailbox. The device's travel is scaled to that of the joystick; forces are not scaled.

Safety: if no pose arrives for `SILENT`, the machine gets no command until the handle has returned
to its dead bands. If the machine sends nothing, first the reflection is switched off (`FADED`),
then all force (`OFF`). Forces return over `RAMP`.
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
FADED = 0.05  # s without machine data after which nothing is reflected
OFF = 0.15  # s without machine data after which the force is zero
RAMP = 0.3  # s over which forces return
# The other structures estimate the operator's force from the mass of the joystick's own flotor, or
# keep the state of the communication channel in the state of one master.
REFLECTIONS = ("none", "stiffness", "direct_force", "coordinating_force", "impedance")
_ASK = 100_000_000  # ns between two connection requests
_WAIT = 0.005  # s that the thread waits for a pose before it checks the stop flag
_CENTRED = 0.1  # dead band of an axis that has none, as a fraction of its range
_SAMPLES = 700_000  # number of times that are kept: 11 minutes at 1 kHz
_SENT_KEPT = 1024
_PRIORITY = 30

# indices into `Line.count`
(STOP, SESSION_OF, LAST, NEXT, TAKEN_LAST, RECEIVED, LOST, LATE, MALFORMED, STARTS, ASKED, SENT_AT,
 ANSWERS, ROUNDS, INTERVALS, CAME_AT) = range(16)  # fmt: skip
# indices into `Line.ramp`
GAIN, SCALE, TURN_SCALE = range(3)


class Line(NamedTuple):
    """Buffers, counters and recorded times of the thread.

    Attributes:
        pose: (21,) received packet as integers.
        pose_real: (21,) the same memory as reals.
        reply: (12,) packet to send as integers.
        reply_real: (12,) the same memory as reals.
        count: (16,) counters and times, see the indices above [1], [ns].
        ramp: (3,) factor on the forces, scale of positions, scale of rotations.
        sent: (1024,) send time of a wrench, by its sequence number [ns].
        answers: (n,) time from the arrival of a pose to the sending of its answer [ns].
        rounds: (n,) time from the sending of a wrench to the first pose that acknowledges it [ns].
        intervals: (n,) time between two poses [ns].
        reach: (2,) range of the joystick [m], [rad].
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
    """Memory shared by thread and simulation; an odd `turn` marks a part that is being written.

    Attributes:
        turn: (2,) version counters of the handle's part and of the machine's.
        stamp: (2,) time at which a part was written [ns]; 0 before the first time.
        handle: (8,) position in joystick scale [m], quaternion, buttons.
        packet: (rows, k) packet from the machine, see `teleop.master`.
        share: (1,) factor on the packet.
        extra: (6,) additional force on the handle [N], [N m].
        numbers: flat Master.
        state: flat MasterState of the thread.
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
    """Return the time of `time.monotonic_ns` [ns] and prevent caching of the shared memory."""
    _gettime(np.int32(_MONOTONIC), two.ctypes.data)
    return two[0] * 1_000_000_000 + two[1]


@compiled
def scaled_pose(place, quaternion, scale, turn_scale, out):
    """Scale the pose of a device's handle to the range of the joystick.

    Args:
        place: (3,) position [m].
        quaternion: (4,) scalar first.
        scale: factor on the position, scalar.
        turn_scale: factor on the rotation angle, scalar.
        out: (>= 7,) written: position [m] and quaternion.

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
    """Compute the wrench that answers a pose, with the joystick's control law.

    Args:
        line: Line with the received `pose`. `reply`, `count` and `ramp` are written.
        box: Mailbox; the handle's part and `state` are written.
        now: arrival time, scalar [ns].
        two: (2,) work space of the clock.

    Returns:
        Whether `reply` must be sent.

    Source: `teleop.master`; this module.
    """
    pose, real, count = line.pose, line.pose_real, line.count
    if pose[MAGIC] != POSE_MAGIC or not real[PERIOD] > 0.0:
        count[MALFORMED] += 1
        return False
    if pose[SESSION] != count[SESSION_OF]:  # the server was restarted
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
    """Write the pose into the mailbox and compute the handle's force in the thread's state."""
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
    for _ in range(8):  # retry: the machine writes for 1 us in every 1 ms
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
        if now - max(count[ASKED], count[CAME_AT]) > _ASK:  # no server, or client dropped
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
    """Read the handle's pose from the mailbox.

    Args:
        mail: (1,) record of a Mailbox and of the dead bands.
        now: current time, scalar [ns].
        pose: (8,) written: position in joystick scale [m], quaternion, buttons.

    Returns:
        Whether the pose is finite and not older than `SILENT`.

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
    """Write the machine's data into the mailbox and read the handle's pose.

    Args:
        mail: see `take_pose`.
        qpos: (7,) written, see `Link.exchange`.
        packet: (rows, k) see `Link.exchange`.
        share: factor on the packet, scalar.
        extra: (6,) additional force on the handle [N], [N m].
        engaged: whether the handle has been in its dead bands, scalar.
        now: current time, scalar [ns].

    Returns:
        Whether the pose is valid and the handle is or has been in its dead bands.

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
    """Return whether all axes of the joystick are in their dead bands."""
    for i in range(3):
        if not (abs(pose[i]) <= dead[i] and 2.0 * abs(pose[4 + i]) <= dead[3 + i]):
            return False
    return True


class Link:
    """Connect to a device; the thread answers poses from `start` until `close`."""

    def __init__(self, host: str, port: int) -> None:
        """Open a socket; the server is contacted later.

        Args:
            host: name or address of the device's server.
            port: port of the server.

        Raises:
            InputError: the host does not exist.
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
        """Start the thread that answers poses.

        Args:
            numbers: parameters of the master's control law.
            like: a master state; the thread's own state gets the same shapes.
            rows: shape of the machine's packets.

        Raises:
            InputError: the structure needs more data than a pose and the machine's packet.
        """
        kind = KINDS[int(numbers.kind[0])]
        if kind not in REFLECTIONS:
            message = f"{kind!r} does not support haptic devices; valid: {', '.join(REFLECTIONS)}"
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
        self._dead[numbers.axis[:, COORDINATE] < 0.0] = np.inf  # axes without a command
        shared = ("turn", "stamp", "handle", "packet", "share", "extra")
        arrays = {name: getattr(self.box, name) for name in shared}
        self._mail = address_record(_MACHINE_MAIL, {**arrays, "dead": self._dead})
        self._mail["rows"], self._mail["columns"] = rows
        self.line.count[STOP] = 1
        _answer_all(self._socket.fileno(), self.line, self.box)  # triggers compilation
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
        """Exchange data with the device once per tick: read the pose, send the machine's packet.

        Args:
            qpos: (7,) written: handle position in joystick scale [m], quaternion; NaN while no
                device is connected, or until the handle has returned to its dead bands.
            packet: packet from the machine.
            share: factor on the packet.
            extra: (6,) additional force on the handle [N], [N m].
        """
        now = clock.monotonic_ns()
        self.engaged = meet(self._mail, qpos, packet, share, extra, self.engaged, now)

    def pose(self) -> HandlePose | None:
        """Return the handle's pose in joystick scale, None while no pose arrives."""
        values = np.empty(8)
        if not take_pose(self._mail, clock.monotonic_ns(), values):
            return None
        return HandlePose(values[:3], values[3:7], int(values[7]))

    def restart_figures(self) -> None:
        """Reset the statistics, for example after the device has waited for the machine."""
        line = self.line
        line.count[[ANSWERS, ROUNDS, INTERVALS, RECEIVED, LOST, LATE, MALFORMED]] = 0
        self._before = line.pose[[MISSED, UNANSWERED]]

    def figures(self) -> dict[str, Any]:
        """Return the statistics: counts, and times as from `timing.summary_of`."""
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
        """Stop the thread; the device then switches its force off."""
        self.line.count[STOP] = 1
        if self._thread:
            self._thread.join()
            self._thread = None
        self._socket.close()


def _timeval(seconds: int, microseconds: int) -> bytes:
    """Pack a C `struct timeval`."""
    import struct

    return struct.pack("@ll", seconds, microseconds)
