"""Import 2 million joint states as ROS 2 bag, MCAP, CSV and MATLAB file, and compare the Parquet files.

The bags also contain camera messages, so that each has 1 GB. The files are written into a temporary folder
(about 3 GB), and each is imported by `hydrotele import` in a process of its own, whose processor time and
largest memory are printed.

    python tools/validation/import_logs.py [--messages 2000000] [--gigabytes 1]
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

RATE = 1000  # [Hz]
JOINTS = ("swing", "boom", "stick")
FIELDS = ("position", "velocity", "effort")
BLOCK = 10_000  # messages that are made at once
IMAGE_BYTES = 640 * 480 * 3
START = 1_750_000_000 * 10**9  # [ns] calendar time of the first message


def joint_values(first: int, count: int) -> np.ndarray:
    """Position [rad], velocity [rad/s] and effort [N m] (count, 3, 3) of the rows first .. first + count - 1."""
    t = (first + np.arange(count))[:, None] / RATE
    phase = np.arange(3) + 0.3 * t
    return np.stack([0.5 * np.sin(phase) - 1.0, 0.15 * np.cos(phase), 1e4 * np.sin(2.0 * phase)], axis=1)


class MessageMaker:
    """Makes serialised messages: rosbags serialises one, and the numbers of the others are put in its place."""

    def __init__(self, store) -> None:
        types = store.types
        self.state = types["sensor_msgs/msg/JointState"].__msgtype__
        self.image = types["sensor_msgs/msg/Image"].__msgtype__
        header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](11, 12), frame_id="base_link")
        marks = np.arange(9.0).reshape(3, 3) + 1234.5
        message = types[self.state](header, list(JOINTS), *(row.copy() for row in marks))
        self.template = np.frombuffer(bytes(store.serialize_cdr(message, self.state)), np.uint8)
        content = self.template.tobytes()
        self.places = [content.index(np.float64(mark).tobytes()) for mark in marks.ravel()]
        pixels = np.random.default_rng(1).integers(0, 256, IMAGE_BYTES, dtype=np.uint8)
        picture = types["sensor_msgs/msg/Image"](header, 480, 640, "rgb8", 0, 1920, pixels)
        self.picture = bytes(store.serialize_cdr(picture, self.image))

    def make(self, first: int, count: int, stamps: np.ndarray) -> list[bytes]:
        """Return the joint states of the rows first .. first + count - 1 with stamps (count,) [ns]."""
        block = np.tile(self.template, (count, 1))
        block[:, 4:8] = (stamps // 10**9).astype("<i4")[:, None].view(np.uint8)
        block[:, 8:12] = (stamps % 10**9).astype("<u4")[:, None].view(np.uint8)
        for place, column in zip(self.places, joint_values(first, count).reshape(count, 9).T, strict=True):
            block[:, place : place + 8] = np.ascontiguousarray(column)[:, None].view(np.uint8)
        size, data = block.shape[1], block.tobytes()
        return [data[k : k + size] for k in range(0, len(data), size)]


def write_bag(path: Path, kind, messages: int, gigabytes: float) -> None:
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    maker = MessageMaker(store)
    images = max(round((1e9 * gigabytes - messages * len(maker.template)) / len(maker.picture)), 1)
    every = max(messages // images, 1)
    with Writer(path, version=9, storage_plugin=kind) as writer:
        states = writer.add_connection("/joint_states", maker.state, typestore=store)
        camera = writer.add_connection("/camera/image_raw", maker.image, typestore=store)
        for first in range(0, messages, BLOCK):
            count = min(BLOCK, messages - first)
            stamps = START + (first + np.arange(count)) * (10**9 // RATE)
            for row, data in enumerate(maker.make(first, count, stamps)):
                received = int(stamps[row]) + 800_000 + 40_000 * (row % 7)
                writer.write(states, received, data)
                if (first + row) % every == 0:
                    writer.write(camera, received, maker.picture)


def write_csv(path: Path, messages: int) -> None:
    names = [f"{joint}_{field}" for field in FIELDS for joint in JOINTS]
    with open(path, "w", encoding="utf-8") as file:
        file.write(";".join(["t", *names]) + "\n")
        for first in range(0, messages, BLOCK):
            values = joint_values(first, min(BLOCK, messages - first)).reshape(-1, 9).tolist()
            for row, numbers in enumerate(values, start=first):
                file.write(f"{row / RATE!r};" + ";".join(map(repr, numbers)) + "\n")


def matlab_content(messages: int) -> dict[str, np.ndarray]:
    values = joint_values(0, messages).reshape(messages, 9)
    names = [f"{joint}_{field}" for field in FIELDS for joint in JOINTS]
    return {"t": np.arange(messages) / RATE, **{name: values[:, k] for k, name in enumerate(names)}}


def write_matlab5(path: Path, messages: int) -> None:
    from scipy.io import savemat

    savemat(path, matlab_content(messages))


def write_matlab7(path: Path, messages: int) -> None:
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, column in matlab_content(messages).items():
            file[name] = column[None, :]
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def write_mapping(path: Path, source: str) -> Path:
    """Write the mapping of positions and velocities; `source` is a pattern of {field} and {joint}."""
    lines = ["log_columns:", *(["  t: time"] if source.startswith("{joint}") else [])]
    for field, kind in (("position", "angle"), ("velocity", "velocity")):
        lines += [f'  "{source.format(field=field, joint=joint)}": {kind}.{joint}' for joint in JOINTS]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


# A process started by another one inherits its largest memory in `getrusage`, but not in /proc.
PROGRAM = """
import atexit, pathlib, re, resource, sys
def write_usage():
    used = resource.getrusage(resource.RUSAGE_SELF)
    memory = re.search(r"VmHWM:\\s+(\\d+) kB", pathlib.Path("/proc/self/status").read_text())[1]
    pathlib.Path(target).write_text(f"{used.ru_utime + used.ru_stime} {int(memory) / 1024}")
target = sys.argv.pop(1)
atexit.register(write_usage)
from hydrotele.cli.start import main
main()
"""


def run_import(log: Path, mapping: Path, out: Path) -> tuple[float, float, float]:
    """Import a log in a process; return its processor time [s], elapsed time [s] and largest memory [MB]."""
    usage = out.with_suffix(".usage")
    options = ["import", str(log), "--mapping", str(mapping), "--out", str(out)]
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(usage), *options], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"hydrotele {' '.join(options)} failed:\n{done.stdout}{done.stderr}")
    seconds, memory = map(float, usage.read_text().split())
    return seconds, time.perf_counter() - begin, memory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=2_000_000)
    parser.add_argument("--gigabytes", type=float, default=1.0, help="size of each bag")
    options = parser.parse_args()
    from rosbags.rosbag2 import StoragePlugin

    count = options.messages
    with tempfile.TemporaryDirectory(prefix="import_logs_") as name:
        folder = Path(name)
        topics = write_mapping(folder / "topics.yaml", "/joint_states.{field}[{joint}]")
        columns = write_mapping(folder / "columns.yaml", "{joint}_{field}")
        cases = {
            "rosbag2, SQLite": (folder / "bag_sqlite", topics,
                                lambda p: write_bag(p, StoragePlugin.SQLITE3, count, options.gigabytes)),
            "rosbag2, MCAP": (folder / "bag_mcap", topics,
                              lambda p: write_bag(p, StoragePlugin.MCAP, count, options.gigabytes)),
            "CSV": (folder / "log.csv", columns, lambda p: write_csv(p, count)),
            "MATLAB 5": (folder / "log5.mat", columns, lambda p: write_matlab5(p, count)),
            "MATLAB 7.3": (folder / "log73.mat", columns, lambda p: write_matlab7(p, count)),
        }  # fmt: skip
        print("| format | size [MB] | processor time [s] | elapsed [s] | memory [MB] | Parquet |")
        print("| --- | ---: | ---: | ---: | ---: | --- |")
        first: bytes | None = None
        truth = joint_values(0, count)
        for label, (path, mapping, write) in cases.items():
            write(path)
            size = sum(f.stat().st_size for f in ([path] if path.is_file() else path.iterdir())) / 1e6
            out = folder / f"{path.stem}.parquet"
            seconds, elapsed, memory = run_import(path, mapping, out)
            content = out.read_bytes()
            first = first or content
            table = pq.read_table(out)
            exact = all(
                np.array_equal(table[f"{kind}.{joint}"].to_numpy(), truth[:, field, k])
                for field, kind in enumerate(("angle", "velocity")) for k, joint in enumerate(JOINTS)
            ) and np.array_equal(table["time"].to_numpy(), np.arange(count) / RATE)  # fmt: skip
            same = "same bytes" if content == first else "DIFFERENT"
            same += ", exact values" if exact else ", WRONG VALUES"
            print(f"| {label} | {size:.0f} | {seconds:.1f} | {elapsed:.1f} | {memory:.0f} | {same} |", flush=True)
            if path.is_file():
                path.unlink()
            else:
                for file in path.iterdir():
                    file.unlink()


if __name__ == "__main__":
    main()
