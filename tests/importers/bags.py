"""Small bags for tests, written by rosbags."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START = 1_700_000_000 * 10**9  # [ns]
JOINTS = ("swing", "boom", "stick")
PUMPS = "std_msgs/Header header\nfloat32[2] pilot\nuint16 pump_bar\nstring note\n"
MAPPING = {
    **{f"/joint_states.position[{joint}]": f"angle.{joint}" for joint in JOINTS},
    "/hydraulics.pump_bar": "pressure_supply [bar]",
}


def angles(time):
    """Return the joint angles (n, 3) [rad] at times (n,) [s]."""
    return np.stack([0.3 * np.sin(time + k) for k in range(3)], axis=1)


class BagWriter:
    """Writes joint states at 100 Hz, hydraulics of a custom type at 50 Hz, and images."""

    def __init__(self, path: Path, kind: str) -> None:
        self.ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.LATEST)
        self.store.register(get_types_from_msg(PUMPS, "my_msgs/msg/Pumps"))
        self.types = self.store.types
        if self.ros1:
            self.writer = Ros1Writer(path)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer(path, version=9, storage_plugin=plugin)
        self.connections = {}

    def header(self, stamp: int):
        time = self.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        more = {"seq": 0} if self.ros1 else {}
        return self.types["std_msgs/msg/Header"](stamp=time, frame_id="base", **more)

    def write(self, topic: str, kind: str, received: int, *content) -> None:
        message = self.types[kind](*content)
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialise = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], received, serialise(message, kind))

    def joints(self, stamp: int, received: int, values, topic="/joint_states") -> None:
        values = np.array(values, dtype=float)
        kind = "sensor_msgs/msg/JointState"
        self.write(topic, kind, received, self.header(stamp), list(JOINTS), values, np.zeros(0), np.zeros(0))

    def pumps(self, stamp: int, received: int, pilot, pressure: int, note="") -> None:
        numbers = np.array(pilot, dtype=np.float32)
        self.write("/hydraulics", "my_msgs/msg/Pumps", received, self.header(stamp), numbers, pressure, note)

    def image(self, received: int) -> None:
        content = self.header(received), 4, 25, "mono8", 0, 25, np.zeros(100, np.uint8)
        self.write("/camera", "sensor_msgs/msg/Image", received, *content)


def write_bag(path: Path, kind: str, rows: int = 400, pump_clock: int = 0, drop=()) -> Path:
    """Write a bag; the clock of the hydraulics is ahead by `pump_clock` [ns], and the pump rows `drop` are lost."""
    bag = BagWriter(path, kind)
    with bag.writer:
        for row in range(rows):
            stamp = START + row * 10_000_000
            bag.joints(stamp, stamp + 2_000_000, angles(np.array([row / 100]))[0])
            if row % 2 == 0 and row not in drop:
                later = stamp + 1_000_000
                bag.pumps(later + pump_clock, later + 2_000_000, (row % 30, 0), 200 + row % 5, "x" * (row % 7))
            if row % 50 == 0:
                bag.image(stamp)
    return path
