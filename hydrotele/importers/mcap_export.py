"""Write a log as an MCAP file of standard ROS 2 messages, which Foxglove, PlotJuggler and rerun open.

Joint positions and velocities are `sensor_msgs/msg/JointState` in the topic `/joint_states`, pressures
`sensor_msgs/msg/FluidPressure` in topics such as `/pressure_head/boom`, and all other channels
`std_msgs/msg/Float64` in topics such as `/command/boom`, each in SI units. Missing values and the
channels `truth.*` of a simulator are not written.
"""

import os
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hydrotele.core.output import atomic_file
from hydrotele.importers.bag_files import import_library
from hydrotele.logs.log import Log
from hydrotele.machine.log_channels import parse_channel

_RULE = "=" * 80 + "\n"
_HEADER = (
    f"{_RULE}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{_RULE}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
_DEFINITIONS = {
    "sensor_msgs/msg/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
    f"float64[] effort\n{_HEADER}",
    "sensor_msgs/msg/FluidPressure": f"std_msgs/Header header\nfloat64 fluid_pressure\nfloat64 variance\n{_HEADER}",
    "std_msgs/msg/Float64": "float64 data\n",
}
_CDR_HEAD = b"\0\1\0\0"  # little-endian


def topic_of(channel: str) -> str:
    """Return the topic of a channel that is no joint position or velocity.

    >>> topic_of("pressure_head.boom")
    '/pressure_head/boom'
    """
    return "/" + channel.replace(".", "/")


def write_mcap(log: Log, path: Path) -> int:
    """Write a log as an MCAP file, and return the number of messages.

    Raises:
        InputError: the file cannot be written, or the library is missing.
    """
    mcap, log = import_library("mcap.writer"), log.without_truth()
    stamps = np.rint((log.origin + log.time - min(log.origin + log.time[0], 0.0)) * 1e9).astype(np.int64)
    joints = _find_joints(log)
    others = [name for name in log.columns if name not in {c for names in joints.values() for c in names if c}]
    with atomic_file(path, ".mcap") as part, open(part, "xb") as file:
        writer = mcap.Writer(file)
        writer.start(profile="ros2", library="hydrotele")
        schemas = {n: writer.register_schema(n, "ros2msg", text.encode()) for n, text in _DEFINITIONS.items()}

        def add_channel(topic: str, kind: str, units: str) -> int:
            return writer.register_channel(topic, "cdr", schemas[kind], metadata={"units": units})

        channels = {}
        if joints:
            channels["/joint_states"] = add_channel("/joint_states", "sensor_msgs/msg/JointState", "rad, m")
        for name in others:
            is_pressure = log.units[name] == "Pa"
            kind = "sensor_msgs/msg/FluidPressure" if is_pressure else "std_msgs/msg/Float64"
            channels[name] = add_channel(topic_of(name), kind, log.units[name])
        metadata = {key: value for key, value in log.metadata.items() if key != "hydrotele"}
        writer.add_metadata("hydrotele", {**metadata, "source": Path(log.source).name})
        count = 0
        make_joint_state = _JointStateWriter(log, joints)
        for row, stamp in enumerate(stamps.tolist()):
            messages = []
            if joints:
                messages.append((channels["/joint_states"], make_joint_state(row, stamp)))
            for name in others:
                value = float(log.columns[name][row])
                if np.isfinite(value):
                    pressure = log.units[name] == "Pa"
                    data = _header(stamp) + struct.pack("<3xdd", value, 0.0) if pressure else struct.pack("<d", value)
                    messages.append((channels[name], _CDR_HEAD + data))
            for channel, data in messages:
                writer.add_message(channel, stamp, data, stamp, sequence=row)
            count += len(messages)
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
    return count


def _header(stamp: int) -> bytes:
    """Return a ROS header with an empty frame; 13 bytes, so that three bytes of padding precede a float64."""
    return struct.pack("<iIIx", stamp // 10**9, stamp % 10**9, 1)


def _find_joints(log: Log) -> dict[str, tuple[str, str]]:
    """Return joint -> (channel of its position, channel of its velocity or "") of the measured joints of a log."""
    joints: dict[str, tuple[str, str]] = {}
    for name in log.columns:
        channel = parse_channel(name)
        if channel.kind in ("angle", "position"):
            velocity = f"velocity.{channel.axis}"
            joints[channel.axis] = name, velocity if velocity in log.columns else ""
    return joints


class _JointStateWriter:
    """Makes the `JointState` messages of a log; their size and joint names are constant."""

    def __init__(self, log: Log, joints: dict[str, tuple[str, str]]) -> None:
        self.names = _encode_texts(list(joints), 13)
        self.position = np.array([log.columns[position] for position, _ in joints.values()])
        speeds = [log.columns[v] if v else np.full(len(log), np.nan) for _, v in joints.values()]
        has_velocity = any(velocity for _, velocity in joints.values())
        self.velocity = np.array(speeds if has_velocity else [])

    def __call__(self, row: int, stamp: int) -> bytes:
        data = _header(stamp) + self.names
        for values in (self.position, self.velocity, np.zeros(0)):
            data += bytes(-len(data) % 4) + struct.pack("<I", len(values))
            if len(values):
                data += bytes(-len(data) % 8) + values[:, row].astype("<f8").tobytes()
        return _CDR_HEAD + data


def _encode_texts(texts: Sequence[str], start: int) -> bytes:
    """Return an array of texts in CDR that begins `start` bytes behind the start of the message."""
    data = bytes(-start % 4) + struct.pack("<I", len(texts))
    for text in texts:
        content = text.encode() + b"\0"
        data += bytes(-(start + len(data)) % 4) + struct.pack("<I", len(content)) + content
    return data
