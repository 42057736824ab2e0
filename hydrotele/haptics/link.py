"""Connection from a simulated machine to a haptic device, with force reflection at device rate.

A compiled thread that does not hold Python's global lock answers every pose packet with a wrench.
It computes the wrench with the joystick's control law (`teleop.master`) from the machine's latest
packet. The machine simulation runs concurrently at its own rate; both exchange data through a
mailbox. The device's travel is scaled to that of the joystick; forces are not scaled.

Safety: if no pose arrives for `POSE_TIMEOUT`, the machine gets no command until the handle has returned
to its dead bands. If the machine sends nothing, first the reflection is switched off (`REFLECTION_TIMEOUT`),
then all force (`FORCE_TIMEOUT`). Forces return over `FORCE_RAMP_TIME`.
"""

import socket
import threading
import time as clock
from typing import Any, NamedTuple

import numpy as np
from numba import types

from hydrotele.core.compiled import compiled
from hydrotele.core.contiguous_state import flat_view, make_contiguous_state
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record, float64_view, int64_view, matrix_view
from hydrotele.haptics.device import HandlePose
from hydrotele.haptics.packets import (
    ANSWERED_POSE,
    BUTTONS,
    CAN_APPLY_FORCE,
    FORCES_ON,
    LAST_ACCEPTED,
    MAGIC,
    MAX_WRENCH,
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
from hydrotele.haptics.timing import request_realtime_priority, summarise_durations
from hydrotele.teleop.axis_table import COORDINATE, DEADBAND, HANDLE_RANGE
from hydrotele.teleop.master import (
    REFLECTION_KINDS,
    MasterParameters,
    MasterState,
    step_master,
    unpack_master_parameters,
    unpack_master_state,
)

POSE_TIMEOUT = 0.05  # s without a pose after which the machine gets no command
REFLECTION_TIMEOUT = 0.05  # s without machine data after which nothing is reflected
FORCE_TIMEOUT = 0.15  # s without machine data after which the force is zero
FORCE_RAMP_TIME = 0.3  # s over which forces return
# The other structures estimate the operator's force from the mass of the joystick's own flotor, or
# keep the state of the communication channel in the state of one master.
REFLECTIONS = ("none", "stiffness", "direct_force", "coordinating_force", "impedance")
_REQUEST_INTERVAL_NS = 100_000_000  # ns between two connection requests
_RECEIVE_TIMEOUT = 0.005  # s that the thread waits for a pose before it checks the stop flag
_MIN_DEADBAND_RATIO = 0.1  # dead band of an axis that has none, as a fraction of its range
_MAX_SAMPLES = 700_000  # number of times that are kept: 11 minutes at 1 kHz
_MAX_SENT_TIMES = 1024
_PRIORITY = 30

# indices into `LinkBuffers.count`
(STOP_FLAG, CURRENT_SESSION, LAST_POSE, NEXT_WRENCH, LAST_ACKNOWLEDGED, RECEIVED, LOST, LATE, MALFORMED,
SERVER_STARTS, REQUEST_TIME, POSE_SENT_TIME,
 ANSWERS, ROUNDS, INTERVALS, POSE_ARRIVAL_TIME) = range(16)  # fmt: skip


class LinkBuffers(NamedTuple):
    """Packets, counters and recorded times of the thread that answers the poses of the device.

    Attributes:
        pose: (21,) received pose packet as integers.
        pose_real: (21,) the same memory as reals.
        reply: (12,) wrench packet to send as integers.
        reply_real: (12,) the same memory as reals.
        count: (16,) counters [1] and times [ns]; the indices are STOP_FLAG .. POSE_ARRIVAL_TIME.
        force_gain: (1,) factor 0 to 1 on the forces, which rises after a pause.
        sent: (1024,) ring buffer of the send times of wrenches [ns]; the index is the sequence
            number modulo 1024.
        answers: (n,) ring buffer of times from the arrival of a pose to the sending of its answer
            [ns].
        round_trip_times: (n,) ring buffer of times from the sending of a wrench to the first pose
            that acknowledges it [ns].
        intervals: (n,) ring buffer of times between the arrivals of two successive poses [ns].
        reach: (2,) half range of the joystick's translation [m] and rotation [rad].
    """

    pose: np.ndarray
    pose_real: np.ndarray
    reply: np.ndarray
    reply_real: np.ndarray
    count: np.ndarray
    force_gain: np.ndarray
    sent: np.ndarray
    answers: np.ndarray
    round_trip_times: np.ndarray
    intervals: np.ndarray
    reach: np.ndarray


class Mailbox(NamedTuple):
    """Memory shared by the thread that answers the device and the machine simulation.

    Each part has one writer, who increments `turn` before and after writing. An odd value marks a part
    that is being written; the reader then tries again.

    Attributes:
        turn: (2,) version counters: of the handle's part (`handle`), which the thread writes, and
            of the machine's part (`packet`, `share`, `extra`), which the simulation writes.
        stamp: (2,) time at which each part was last written [ns]; 0 before the first time.
        handle: (8,) handle position scaled to the joystick's range [m], quaternion, buttons.
        packet: (rows, k) packet from the machine, see `teleop.master`.
        share: (1,) factor on the packet, 0 to 1.
        extra: (6,) additional force on the handle, such as tip-over protection [N], [N m].
        parameters: flat MasterParameters.
        state: flat MasterState of the thread.
    """

    turn: np.ndarray
    stamp: np.ndarray
    handle: np.ndarray
    packet: np.ndarray
    share: np.ndarray
    extra: np.ndarray
    parameters: np.ndarray
    state: np.ndarray


_HANDLE, _MACHINE = range(2)

_recv = types.ExternalFunction("recv", types.int64(types.int32, types.uintp, types.uint64, types.int32))
_send = types.ExternalFunction("send", types.int64(types.int32, types.uintp, types.uint64, types.int32))
_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.uintp))
_MONOTONIC = clock.CLOCK_MONOTONIC


@compiled
def _read_clock(timespec):
    """Return the time of `time.monotonic_ns` [ns]; `timespec` (2,) is work space.

    The system call also makes the compiler read shared memory again instead of using cached values.
    """
    _gettime(np.int32(_MONOTONIC), timespec.ctypes.data)
    return timespec[0] * 1_000_000_000 + timespec[1]


@compiled
def scale_pose(position, quaternion, scale, rotation_scale, out):
    """Scale the pose of a device's handle to the range of the joystick.

    The rotation keeps its axis; its angle is multiplied by a factor.

    Args:
        position: (3,) position of the handle from its centre [m].
        quaternion: (4,) orientation of the handle, scalar first.
        scale: factor on the position, scalar.
        rotation_scale: factor on the rotation angle, scalar.
        out: (>= 7,) written: position [m] and quaternion.

    Returns:
        Nothing.

    Source: rotation vector of a quaternion.
    """
    for i in range(3):
        out[i] = scale * position[i]
    w, size = quaternion[0], 0.0
    for i in range(1, 4):
        size += quaternion[i] * quaternion[i]
    size = np.sqrt(size)
    half = rotation_scale * np.arctan2(size, abs(w))
    out[3] = np.cos(half)
    share = np.sin(half) / size if size > 1e-12 else rotation_scale
    for i in range(3):
        out[4 + i] = share * (quaternion[1 + i] if w >= 0.0 else -quaternion[1 + i])


@compiled
def answer_pose_packet(buffers, mailbox, now, timespec):
    """Check a received pose packet, count it, and compute the wrench packet that answers it.

    The wrench follows from the joystick's control law and the machine's latest packet. Its force
    and torque are limited to the maximum values that the pose packet states for the device.

    Args:
        buffers: LinkBuffers with the received packet in `pose`. The wrench packet is written to `reply`;
            the counters, and the factor 0 to 1 by which the force fades in after a pause, are updated.
        mailbox: Mailbox; the handle's pose and the state of the control law are written to it.
        now: arrival time, scalar [ns].
        timespec: (2,) work space of the clock.

    Returns:
        Whether `reply` must be sent; false for a malformed packet, or one whose sequence number is
        not above that of the last pose.

    Source: `teleop.master`; this module.
    """
    pose, real, count = buffers.pose, buffers.pose_real, buffers.count
    if pose[MAGIC] != POSE_MAGIC or not real[PERIOD] > 0.0:
        count[MALFORMED] += 1
        return False
    if pose[SESSION] != count[CURRENT_SESSION]:  # the server was restarted
        count[CURRENT_SESSION], count[LAST_POSE], count[NEXT_WRENCH], count[LAST_ACKNOWLEDGED] = (
            pose[SESSION],
            -1,
            0,
            -1,
        )
        count[SERVER_STARTS] += 1
        buffers.force_gain[0] = 0.0
    if pose[SEQUENCE] <= count[LAST_POSE]:
        count[LATE] += 1
        return False
    first = count[LAST_POSE] < 0
    if not first:
        count[LOST] += pose[SEQUENCE] - count[LAST_POSE] - 1
        buffers.intervals[count[INTERVALS] % len(buffers.intervals)] = now - count[POSE_ARRIVAL_TIME]
        count[INTERVALS] += 1
    nominal = real[PERIOD]
    period = 1e-9 * (pose[SENT] - count[POSE_SENT_TIME])
    period = nominal if first else min(20.0 * nominal, max(0.25 * nominal, period))
    count[LAST_POSE], count[POSE_SENT_TIME], count[POSE_ARRIVAL_TIME] = (
        pose[SEQUENCE],
        pose[SENT],
        now,
    )
    count[RECEIVED] += 1
    if pose[LAST_ACCEPTED] > count[LAST_ACKNOWLEDGED]:
        buffers.round_trip_times[count[ROUNDS] % len(buffers.round_trip_times)] = (
            now - buffers.sent[pose[LAST_ACCEPTED] % _MAX_SENT_TIMES]
        )
        count[ROUNDS] += 1
        count[LAST_ACKNOWLEDGED] = pose[LAST_ACCEPTED]
    _compute_reflected_force(buffers, mailbox, now, timespec, first, period)
    reply, out = buffers.reply, buffers.reply_real
    reply[MAGIC], reply[SESSION], reply[SEQUENCE] = WRENCH_MAGIC, pose[SESSION], count[NEXT_WRENCH]
    reply[ANSWERED_POSE] = pose[SEQUENCE]
    reply[FORCES_ON] = 1 if buffers.force_gain[0] > 0.0 else 0
    m = unpack_master_state(mailbox.state)
    for part in range(2):
        size = 0.0
        for i in range(3 * part, 3 * part + 3):
            out[WRENCH + i] = buffers.force_gain[0] * m.push[i]
            size += out[WRENCH + i] ** 2
        size, most = np.sqrt(size), real[MAX_WRENCH + part]
        share = most / size if size > most else 1.0
        for i in range(3 * part, 3 * part + 3):
            out[WRENCH + i] = share * out[WRENCH + i] if np.isfinite(size) else 0.0
    count[NEXT_WRENCH] += 1
    return True


@compiled
def _compute_reflected_force(line, box, now, two, first, period):
    """Write the handle's pose into the mailbox and compute the force on the handle by the control law.

    The force is stored in the state of the control law, `box.state`. The caller multiplies it by
    `line.force_gain[0]`. This factor is 0 if the machine's data are older than FORCE_TIMEOUT or
    the pose is not valid; otherwise it rises to 1 within FORCE_RAMP_TIME.

    `line` is LinkBuffers, `box` Mailbox, `now` the time [ns], `two` (2,) work space of the clock.
    `first` marks the first pose of a session, and `period` is the time since the previous pose [s].
    """
    real = line.pose_real
    scale = line.reach[0] / real[TRAVEL] if real[TRAVEL] > 0.0 else 0.0
    turns = line.reach[1] / real[TRAVEL + 1] if real[TRAVEL + 1] > 0.0 else 0.0
    box.turn[_HANDLE] += 1
    _read_clock(two)
    scale_pose(real[POSITION:QUATERNION], real[QUATERNION:TRAVEL], scale, turns, box.handle)
    box.handle[7] = line.pose[BUTTONS]
    if not (real[CAN_APPLY_FORCE] == 1.0 and np.isfinite(real[POSITION:TRAVEL]).all()):
        box.handle[:7] = np.nan
    _read_clock(two)
    box.stamp[_HANDLE] = now
    box.turn[_HANDLE] += 1
    packet, state = np.empty(box.packet.shape), unpack_master_state(box.state)
    share, when = 0.0, np.int64(0)
    for _ in range(8):  # retry: the machine writes for 1 us in every 1 ms
        turn = box.turn[_MACHINE]
        _read_clock(two)
        packet[:] = box.packet
        state.extra[:] = box.extra
        share, when = box.share[0], box.stamp[_MACHINE]
        _read_clock(two)
        if turn % 2 == 0 and turn == box.turn[_MACHINE]:
            break
    age = 1e-9 * (now - when)
    alive = when > 0 and age < FORCE_TIMEOUT
    able = np.isfinite(box.handle[0])
    line.force_gain[0] = min(1.0, line.force_gain[0] + period / FORCE_RAMP_TIME) if alive and able else 0.0
    fresh = share if age < REFLECTION_TIMEOUT else 0.0
    step_master(unpack_master_parameters(box.parameters), box.handle[:7], packet, fresh, period, first, state)


@compiled
def _run_answer_loop(socket_fd, buffers, mailbox):
    """Receive pose packets from a socket and answer each with a wrench until `count[STOP_FLAG]` is set.

    While no pose arrives, a connection request is sent to the server every 100 ms.
    """
    two, count = np.zeros(2, np.int64), buffers.count
    size, answer = np.uint64(8 * POSE_WORDS), np.uint64(8 * WRENCH_WORDS)
    while count[STOP_FLAG] == 0:
        got = _recv(np.int32(socket_fd), buffers.pose.ctypes.data, size, np.int32(0))
        now = _read_clock(two)
        if (
            now - max(count[REQUEST_TIME], count[POSE_ARRIVAL_TIME]) > _REQUEST_INTERVAL_NS
        ):  # no server, or client dropped
            buffers.reply[:] = 0
            buffers.reply[MAGIC], buffers.reply[SENT] = WRENCH_MAGIC, now
            count[REQUEST_TIME] = now
            _send(np.int32(socket_fd), buffers.reply.ctypes.data, answer, np.int32(0))
        if got < 0:
            continue
        if got != 8 * POSE_WORDS:
            count[MALFORMED] += 1
        elif answer_pose_packet(buffers, mailbox, now, two):
            buffers.reply[SENT] = _read_clock(two)
            buffers.sent[buffers.reply[SEQUENCE] % _MAX_SENT_TIMES] = buffers.reply[SENT]
            _send(np.int32(socket_fd), buffers.reply.ctypes.data, answer, np.int32(0))
            buffers.answers[count[ANSWERS] % len(buffers.answers)] = _read_clock(two) - now
            count[ANSWERS] += 1


_MAILBOX_DTYPE = np.dtype(
    [(name, np.int64) for name in ("rows", "columns")]
    + [(name, np.int64) for name in ("turn", "stamp", "handle")]  # addresses from here on
    + [(name, np.int64) for name in ("packet", "share", "extra", "dead")],
    align=True,
)


@compiled
def read_pose_from_mailbox(mail, now, pose):
    """Read the handle's pose from the mailbox.

    Args:
        mail: (1,) record with the addresses of the mailbox arrays and of the dead bands.
        now: current time, scalar [ns].
        pose: (8,) written: position in joystick scale [m], quaternion, buttons.

    Returns:
        Whether the pose is finite and not older than `POSE_TIMEOUT`.

    Source: this module.
    """
    r, two, when = mail[0], np.empty(2, np.int64), np.int64(0)
    turn, stamp, handle = int64_view(r.turn, 2), int64_view(r.stamp, 2), float64_view(r.handle, 8)
    for _ in range(8):
        before = turn[_HANDLE]
        _read_clock(two)
        pose[:] = handle
        when = stamp[_HANDLE]
        _read_clock(two)
        if before % 2 == 0 and before == turn[_HANDLE]:
            return now - when <= 1e9 * POSE_TIMEOUT and np.isfinite(pose).all()
    return False


@compiled
def exchange_with_mailbox(mail, qpos, packet, packet_gain, extra, engaged, now):
    """Write the machine's data into the mailbox and read the handle's pose.

    Args:
        mail: (1,) record with the addresses of the mailbox arrays and of the dead bands.
        qpos: (7,) written: handle position in joystick scale [m] and quaternion; NaN if the result is
            false.
        packet: (rows, k) packet from the machine: forces and motion of its tip.
        packet_gain: factor 0 to 1 on the reflected force, scalar.
        extra: (6,) additional force on the handle [N], [N m].
        engaged: whether the handle has been in the dead bands of all axes since its pose became valid,
            scalar.
        now: current time, scalar [ns].

    Returns:
        The new value of `engaged`: whether the pose is finite and not older than POSE_TIMEOUT, and
        the handle is, or has been since then, in the dead bands of all axes.

    Source: this module.
    """
    r, two, pose = mail[0], np.empty(2, np.int64), np.empty(8)
    turn = int64_view(r.turn, 2)
    turn[_MACHINE] += 1
    _read_clock(two)
    matrix_view(r.packet, r.rows, r.columns)[:] = packet
    float64_view(r.extra, 6)[:] = extra
    float64_view(r.share, 1)[0], int64_view(r.stamp, 2)[_MACHINE] = packet_gain, now
    _read_clock(two)
    turn[_MACHINE] += 1
    there = read_pose_from_mailbox(mail, now, pose)
    engaged = there and (engaged or _is_handle_centred(pose, float64_view(r.dead, 6)))
    for i in range(7):
        qpos[i] = pose[i] if engaged else np.nan
    return engaged


@compiled
def _is_handle_centred(pose, dead):
    """Return whether a handle pose (8,) is in the dead bands `dead` (6,) [m], [rad] of all axes.

    Rotation angles are approximated by twice the vector part of the quaternion.
    """
    for i in range(3):
        if not (abs(pose[i]) <= dead[i] and 2.0 * abs(pose[4 + i]) <= dead[3 + i]):
            return False
    return True


class HapticLink:
    """Connection to the server of a haptic device; a thread answers its poses from `start` until `close`."""

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
        pose, reply = make_packet(POSE_WORDS), make_packet(WRENCH_WORDS)
        self.buffers = LinkBuffers(
            *pose, *reply, np.zeros(16, np.int64), np.zeros(1), np.zeros(_MAX_SENT_TIMES, np.int64),
            np.zeros(_MAX_SAMPLES, np.int64), np.zeros(_MAX_SAMPLES, np.int64),
            np.zeros(_MAX_SAMPLES, np.int64), np.zeros(2),
        )  # fmt: skip
        self.buffers.count[[LAST_POSE, LAST_ACKNOWLEDGED]] = -1
        self.mailbox: Mailbox | None = None
        self._thread: threading.Thread | None = None
        self.priority, self.engaged = False, False
        self._counters_at_restart = np.zeros(2, np.int64)

    def start(self, parameters: MasterParameters, template: MasterState, packet_shape: tuple[int, ...]) -> None:
        """Create the mailbox and start the thread that answers the device's poses.

        Args:
            parameters: parameters of the master's control law.
            template: a master state; the state that the thread uses gets the same array shapes.
            packet_shape: shape (rows, k) of the machine's packets.

        Raises:
            InputError: the kind of force reflection does not support haptic devices.
        """
        kind = REFLECTION_KINDS[int(parameters.kind[0])]
        if kind not in REFLECTIONS:
            message = f"{kind!r} does not support haptic devices; valid: {', '.join(REFLECTIONS)}"
            raise InputError("pilot.reflection", message)
        state = make_contiguous_state(MasterState, [part.shape for part in template])
        state.limited[:] = 1.0
        self.mailbox = Mailbox(
            np.zeros(2, np.int64), np.zeros(2, np.int64), np.full(8, np.nan), np.zeros(packet_shape),
            np.zeros(1), np.zeros(6), flat_view(parameters), flat_view(state),
        )  # fmt: skip
        self._axis = parameters.axis
        self.buffers.reach[:] = (
            parameters.axis[:3, HANDLE_RANGE].max(),
            parameters.axis[3:, HANDLE_RANGE].max(),
        )
        self._deadbands = np.where(
            parameters.axis[:, DEADBAND] > 0.0, parameters.axis[:, DEADBAND],
            _MIN_DEADBAND_RATIO * parameters.axis[:, HANDLE_RANGE],
        )  # fmt: skip
        self._deadbands[parameters.axis[:, COORDINATE] < 0.0] = np.inf  # axes without a command
        shared = ("turn", "stamp", "handle", "packet", "share", "extra")
        arrays = {name: getattr(self.mailbox, name) for name in shared}
        self._mailbox_record = address_record(_MAILBOX_DTYPE, {**arrays, "dead": self._deadbands})
        self._mailbox_record["rows"], self._mailbox_record["columns"] = packet_shape
        self.buffers.count[STOP_FLAG] = 1
        _run_answer_loop(self._socket.fileno(), self.buffers, self.mailbox)  # triggers compilation
        self.buffers.count[STOP_FLAG] = 0
        seconds = int(_RECEIVE_TIMEOUT), round(1e6 * (_RECEIVE_TIMEOUT % 1.0))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _pack_timeval(*seconds))
        self._thread = threading.Thread(target=self._run, name="haptic link", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        self.priority = request_realtime_priority(_PRIORITY)
        _run_answer_loop(self._socket.fileno(), self.buffers, self.mailbox)

    def exchange(self, qpos: np.ndarray, packet: np.ndarray, packet_gain: float, extra: np.ndarray) -> None:
        """Exchange data with the device once per tick: read the pose, send the machine's packet.

        Args:
            qpos: (7,) written: handle position in joystick scale [m], quaternion; NaN while no
                device is connected, or until the handle has returned to its dead bands.
            packet: packet from the machine: forces and motion of its tip.
            packet_gain: factor 0 to 1 on the reflected force.
            extra: (6,) additional force on the handle [N], [N m].
        """
        now = clock.monotonic_ns()
        self.engaged = exchange_with_mailbox(self._mailbox_record, qpos, packet, packet_gain, extra, self.engaged, now)

    def pose(self) -> HandlePose | None:
        """Return the handle's latest pose, scaled to the joystick's range.

        It is None if the latest pose is not finite or is older than `POSE_TIMEOUT`.
        """
        values = np.empty(8)
        if not read_pose_from_mailbox(self._mailbox_record, clock.monotonic_ns(), values):
            return None
        return HandlePose(values[:3], values[3:7], int(values[7]))

    def reset_statistics(self) -> None:
        """Reset the counts and recorded times of `statistics`, except the number of server starts.

        The device's own counters cannot be reset; their present values are subtracted from now on.
        """
        line = self.buffers
        line.count[[ANSWERS, ROUNDS, INTERVALS, RECEIVED, LOST, LATE, MALFORMED]] = 0
        self._counters_at_restart = line.pose[[MISSED, UNANSWERED]]

    def statistics(self) -> dict[str, Any]:
        """Return statistics of the connection since its start or since `reset_statistics`.

        Counted are received (`poses`), lost, late and malformed poses, starts of the device's
        server, and periods that the device missed or began without an answer. `priority` is whether
        the thread has real-time priority. The times for an answer, a round trip (`loop`) and
        between two poses (`interval`) are given as percentiles and histogram.
        """
        line, count = self.buffers, self.buffers.count
        return {
            "poses": int(count[RECEIVED]),
            "lost": int(count[LOST]),
            "late": int(count[LATE]),
            "malformed": int(count[MALFORMED]),
            "device_starts": int(count[SERVER_STARTS]),
            "device_missed": int(line.pose[MISSED] - self._counters_at_restart[0]),
            "device_unanswered": int(line.pose[UNANSWERED] - self._counters_at_restart[1]),
            "priority": self.priority,
            "answer": summarise_durations(line.answers[: count[ANSWERS]]),
            "loop": summarise_durations(line.round_trip_times[: count[ROUNDS]]),
            "interval": summarise_durations(line.intervals[: count[INTERVALS]]),
        }

    def close(self) -> None:
        """Stop the thread and close the socket, after which the device switches its force off."""
        self.buffers.count[STOP_FLAG] = 1
        if self._thread:
            self._thread.join()
            self._thread = None
        self._socket.close()


def _pack_timeval(seconds: int, microseconds: int) -> bytes:
    """Pack a time as a C `struct timeval`, for the receive timeout of a socket."""
    import struct

    return struct.pack("@ll", seconds, microseconds)
