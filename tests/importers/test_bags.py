"""Bags of all formats give the same log; damaged ones give what can be read."""

import dataclasses
import json
import shutil
import sqlite3
import sys
from pathlib import Path

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.importers.bag_files import Topic
from hydrotele.importers.conversion import import_log
from hydrotele.importers.message_layout import make_decoder
from hydrotele.machine.log_columns import LogColumn, parse_log_column

sys.path.insert(0, str(Path(__file__).parent))
from bags import JOINTS, MAPPING, START, BagWriter, angles, write_bag  # noqa: E402

KINDS = {"ros1": "run.bag", "sqlite": "sqlite", "mcap": "mcap"}
COLUMNS = {name: parse_log_column(entry) for name, entry in MAPPING.items()}
TIME = np.arange(400) / 100


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    return {kind: write_bag(folder / name, kind) for kind, name in KINDS.items()}


def load(path, columns=COLUMNS, **options):
    return import_log([path], columns, **options)


def storage(path):
    """The file of messages of a bag."""
    return path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")


@pytest.mark.parametrize("kind", KINDS)
def test_values_times_and_ignored_topics(bags, kind):
    """Angles are exact; the pump pressure, at half the rate, fills every second row."""
    log, report = load(bags[kind])
    assert np.array_equal(log.time, TIME)
    for k, joint in enumerate(JOINTS):
        assert np.array_equal(log[f"angle.{joint}"], angles(TIME)[:, k])
    pressure = log["pressure_supply"]
    assert np.isfinite(pressure).mean() == pytest.approx(0.5, abs=0.01)
    assert np.nanmin(pressure) >= 200e5 and np.nanmax(pressure) <= 204e5
    assert report.ignored == {"/camera": 8}
    assert any("2023-11-14T22:13:20" in note for note in report.notes)


def test_a_file_of_a_bag_without_its_folder(bags, tmp_path):
    file = tmp_path / "part.mcap"
    shutil.copy(storage(bags["mcap"]), file)
    assert np.array_equal(load(file)[0]["angle.boom"], load(bags["sqlite"])[0]["angle.boom"])


@pytest.mark.parametrize("path", ["/joint_states.position[boom]", "/joint_states/boom/position",
                                  "/joint_states.position[1]", "/joint_states/position[1]"])  # fmt: skip
def test_notations_of_a_path(bags, path):
    log, _ = load(bags["mcap"], {path: LogColumn(channel="angle.boom")})
    assert np.array_equal(log["angle.boom"], angles(TIME)[:, 1])


def test_two_one_sided_columns_make_one_command(bags):
    entry = LogColumn(channel="command.boom", minus="/hydraulics.pilot[1]", scale=0.02, sign=-1)
    log, _ = load(bags["sqlite"], {"/hydraulics.pilot[0]": entry})
    rows = np.arange(0, 400, 2)
    assert log["command.boom"] == pytest.approx(-0.02 * (rows % 30), abs=1e-15)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_truncated_bag_keeps_what_can_be_read(bags, kind, share, tmp_path):
    whole = storage(bags[kind])
    part = tmp_path / f"part{whole.suffix}"
    content = whole.read_bytes()
    part.write_bytes(content[: int(share * len(content))])
    try:
        log, report = load(part)
    except InputError as error:  # the only chunk of a small MCAP or ROS 1 bag is cut
        assert kind != "sqlite" and "copy it again" in str(error)
        return
    assert any("truncated" in note or "damaged" in note for note in report.notes)
    assert np.array_equal(log["angle.boom"], angles(log.time)[:, 1]) and 10 < len(log) <= 400


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_chunks_before_the_damage_are_kept(kind, tmp_path):
    """Writers begin a new chunk after about 1 MB."""
    bag = BagWriter(tmp_path / KINDS[kind], kind)
    kind_of_image = "sensor_msgs/msg/Image"
    with bag.writer:
        for row in range(600):
            stamp = START + row * 10_000_000
            bag.joints(stamp, stamp, angles(np.array([row / 100]))[0])
            content = bag.header(stamp), 100, 100, "mono8", 0, 100, np.zeros(10_000, np.uint8)
            bag.write("/camera", kind_of_image, stamp, *content)
    file = storage(tmp_path / KINDS[kind])
    content = bytearray(file.read_bytes())
    file.write_bytes(content[: len(content) // 2])
    log, report = load(file, {"/joint_states.position[boom]": LogColumn(channel="angle.boom")})
    assert 100 < len(log) < 500 and any("before the damage were read" in note for note in report.notes)
    assert np.array_equal(log["angle.boom"], angles(np.arange(len(log)) / 100)[:, 1])


def test_wrong_files_are_refused(tmp_path):
    for name in ("a.bag", "a.mcap", "a.db3", "a.mat"):
        for content in (b"", b"hello" * 100, bytes(1000)):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(InputError, match="copy it again"):
                load(tmp_path / name)
    with pytest.raises(InputError, match="does not exist"):
        load(tmp_path / "none.bag")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="can be imported"):
        load(tmp_path / "empty")


@pytest.mark.parametrize("kind", KINDS)
def test_an_empty_bag_and_unknown_topics(kind, bags, tmp_path):
    bag = BagWriter(tmp_path / KINDS[kind], kind)
    with bag.writer:
        pass
    with pytest.raises(InputError):
        load(tmp_path / KINDS[kind])
    with pytest.raises(InputError, match=r"contains none of the columns.*/joint_states"):
        load(bags[kind], {"/other.data": LogColumn(channel="angle.boom")})
    _, report = load(bags[kind], COLUMNS | {"/joint_states.position[tilt]": LogColumn(channel="angle.tilt")})
    assert report.unused == ["/joint_states.position[tilt]"]


def test_an_unfinished_bag_with_a_write_ahead_log(bags, tmp_path):
    """A recorder that was killed leaves messages in the file `-wal`."""
    shutil.copytree(bags["sqlite"], tmp_path / "bag")
    file = storage(tmp_path / "bag")
    connection = sqlite3.connect(file)
    last = connection.execute("SELECT max(id) FROM messages WHERE topic_id = 1").fetchone()
    row = connection.execute("SELECT topic_id, timestamp, data FROM messages WHERE id = ?", last).fetchone()
    connection.execute("DELETE FROM messages WHERE id = ?", last)
    connection.commit()
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    connection.commit()
    shutil.copytree(tmp_path / "bag", tmp_path / "copy")
    connection.close()
    log, _ = load(tmp_path / "copy")
    assert np.array_equal(log["angle.boom"], angles(TIME)[:, 1])


def test_clocks_of_two_computers(tmp_path):
    """Stamps that are 3 s ahead of the other topic's are shifted back; 3 ms are not."""
    plain = load(write_bag(tmp_path / "a", "mcap"))[0]["pressure_supply"]
    log, report = load(write_bag(tmp_path / "b", "mcap", pump_clock=3_000_000_000))
    assert np.array_equal(np.isfinite(log["pressure_supply"]), np.isfinite(plain))
    assert np.nanmax(np.abs(log["pressure_supply"] - plain)) < 1e-6 * 2e7
    assert any("shifted by -3 s" in note for note in report.notes)


def test_stamps_of_zero_and_of_a_clock_set_back(tmp_path):
    for name, stamp in (("zero", lambda row: 0), ("back", lambda row: START - 10**10 * (row > 200) + row * 10**7)):
        bag = BagWriter(tmp_path / name, "mcap")
        with bag.writer:
            for row in range(400):
                bag.joints(stamp(row), START + row * 10**7, [0.0, row / 1000, 0.0])
        log, report = load(tmp_path / name)
        assert np.array_equal(log.time, TIME) and np.array_equal(log["angle.boom"], np.arange(400) / 1000)
        assert any("time of reception is used" in note for note in report.notes)


def test_a_hole_is_masked(tmp_path):
    log, report = load(write_bag(tmp_path / "bag", "mcap", drop=range(100, 200)))
    assert np.isnan(log["pressure_supply"][103:199]).all() and np.isfinite(log["angle.boom"]).all()
    assert report.channels[-1].missing == pytest.approx(0.625, abs=0.01)


def test_a_channel_logged_twice_gives_the_offset(tmp_path):
    """A second source of the same angle, 37 ms late on its own clock, and the pressure of the same file."""
    time = np.arange(2000) / 100
    signal = np.sin(1.3 * time) + 0.5 * np.sin(3.1 * time)
    bag = BagWriter(tmp_path / "bag", "mcap")
    with bag.writer:
        for row in range(2000):
            bag.joints(START + row * 10**7, START + row * 10**7, [0.0, signal[row], 0.0])
    late = np.sin(1.3 * (time - 0.037)) + 0.5 * np.sin(3.1 * (time - 0.037))
    rows = [f"{t!r},{a!r},{2e7 + 1e5 * a!r}" for t, a in zip(time.tolist(), late.tolist(), strict=True)]
    (tmp_path / "b.csv").write_text("\n".join(["time,Boom,pressure_supply", *rows]))
    columns = {"/joint_states.position[boom]": "angle.boom", "Boom": "angle.boom"}
    log, report = import_log(
        [tmp_path / "bag", tmp_path / "b.csv"], {k: parse_log_column(v) for k, v in columns.items()}
    )
    assert any("shifted by -0.037" in note for note in report.notes)
    assert list(log.columns) == ["angle.boom", "pressure_supply"]
    known = np.isfinite(log["pressure_supply"])
    # Linear interpolation at 100 Hz of motions below 3.1 rad/s errs by less than (0.0155)^2 / 2 of 1e5 Pa.
    assert known.mean() > 0.99
    assert np.abs(log["pressure_supply"] - (2e7 + 1e5 * log["angle.boom"]))[known].max() < 50.0


def test_layouts_agree_with_rosbags(tmp_path):
    """Numbers of standard messages of both ROS versions at all paths, against the deserialisation of rosbags."""
    from rosbags.typesys import Stores, get_typestore

    generator = np.random.default_rng(0)
    for ros1, name in ((False, Stores.LATEST), (True, Stores.ROS1_NOETIC)):
        store = get_typestore(name)
        for kind in ("sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseArray",
                     "diagnostic_msgs/msg/DiagnosticArray", "trajectory_msgs/msg/JointTrajectory",
                     "sensor_msgs/msg/BatteryState", "nav_msgs/msg/Odometry"):  # fmt: skip
            messages = [_random_message(store, kind, generator) for _ in range(5)]
            serialise = store.serialize_ros1 if ros1 else store.serialize_cdr
            data = [bytes(serialise(message, kind)) for message in messages]
            definition = store.generate_msgdef(kind, ros_version=1 if ros1 else 2)[0].encode()
            topic = Topic("/t", kind, "ros1" if ros1 else "cdr", definition, "ros1msg" if ros1 else "ros2msg")
            decoder = make_decoder(topic)
            for message, content in zip(messages, data, strict=True):
                expected = _numbers_of(message)
                paths = decoder.list_paths(content)
                assert len(paths) == len(expected)
                found = decoder.decode([*data, content], paths)[-1]
                assert np.array_equal(found, np.array(expected, dtype=float), equal_nan=True), (kind, ros1)


def _random_message(store, kind, generator):
    values = []
    for _, (node, content) in store.fielddefs[kind][1]:
        values.append(_random_field(store, node.name, content, generator))
    return store.types[kind](*values)


def _random_field(store, node, content, generator):
    if node == "NAME":
        return _random_message(store, content, generator)
    if node == "BASE":
        if content[0] == "string":
            return "x" * int(generator.integers(0, 5))
        if "float" in content[0]:
            return np.dtype(content[0]).type(generator.normal()).item()
        return bool(generator.integers(2)) if content[0] == "bool" else generator.integers(0, 100).item()
    (element, inner), count = content
    count = count if node == "ARRAY" else int(generator.integers(0, 4))
    if element.name == "BASE" and inner[0] != "string":
        dtype = {"bool": "bool", "byte": "uint8", "char": "uint8"}.get(inner[0], inner[0])
        return (100 * generator.random(count)).astype(dtype)
    return [_random_field(store, element.name, inner, generator) for _ in range(count)]


def _numbers_of(value):
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list):
        return [number for item in value for number in _numbers_of(item)]
    if isinstance(value, bool | int | float):
        return [value]
    if isinstance(value, str):
        return []
    fields = [field for field in dataclasses.fields(value) if not field.name.isupper()]  # no constants
    return [number for field in fields for number in _numbers_of(getattr(value, field.name))]


def test_json_and_protobuf_of_plain_mcap(tmp_path):
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.duration_pb2 import DESCRIPTOR, Duration
    from mcap.writer import Writer

    files = FileDescriptorSet()
    DESCRIPTOR.CopyToProto(files.file.add())
    with open(tmp_path / "a.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        plain = writer.register_channel("/joints", "json", 0)
        schema = writer.register_schema("google.protobuf.Duration", "protobuf", files.SerializeToString())
        other = writer.register_channel("/duration", "protobuf", schema)
        strange = writer.register_channel("/strange", "flatbuffer", 0)
        for row in range(100):
            stamp = START + row * 10**7
            time = {"sec": stamp // 10**9, "nsec": stamp % 10**9}
            content = {"timestamp": time, "joints": [{"name": "boom", "position": row / 100}, {"name": "b"}]}
            for channel, data in ((plain, json.dumps(content).encode()), (strange, b"abc"),
                                  (other, Duration(seconds=row, nanos=0).SerializeToString())):  # fmt: skip
                writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    columns = {"/joints.joints[boom].position": LogColumn(channel="angle.boom"),
               "/duration.seconds": LogColumn(channel="pressure_supply", unit="MPa"),
               "/strange.x": LogColumn(channel="angle.stick")}  # fmt: skip
    log, report = load(tmp_path / "a.mcap", columns)
    assert np.array_equal(log["angle.boom"], np.arange(100) / 100)
    assert np.array_equal(log["pressure_supply"], 1e6 * np.arange(100))
    assert any("/strange cannot be decoded: the encoding 'flatbuffer'" in note for note in report.notes)


def test_a_missing_library_is_named(bags, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(InputError, match=r"needs the library rosbags: pip install 'hydrotele\[import\]'"):
        load(bags["mcap"])


def test_compressed_files_and_messages(tmp_path):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    for mode in (CompressionMode.FILE, CompressionMode.MESSAGE):
        bag = BagWriter(tmp_path / mode.name, "sqlite")
        bag.writer.set_compression(mode, CompressionFormat.ZSTD)
        with bag.writer:
            for row in range(100):
                stamp = START + row * 10**7
                bag.joints(stamp, stamp, angles(np.array([row / 100]))[0])
        log, _ = load(tmp_path / mode.name)
        assert np.array_equal(log["angle.boom"], angles(np.arange(100) / 100)[:, 1])


def test_definitions_of_old_bags_are_those_of_ros(bags, tmp_path):
    """SQLite bags before ROS 2 Iron contain no definitions."""
    shutil.copytree(bags["sqlite"], tmp_path / "bag")
    connection = sqlite3.connect(storage(tmp_path / "bag"))
    connection.execute("DROP TABLE message_definitions")
    connection.commit()
    connection.close()
    log, report = load(tmp_path / "bag")
    assert np.array_equal(log["angle.boom"], angles(TIME)[:, 1])
    assert any("/hydraulics cannot be decoded: the file contains no definition" in note for note in report.notes)


def test_the_limit_of_values_holds(bags, monkeypatch):
    monkeypatch.setenv("HYDROTELE_MAX_LOG_VALUES", "100")
    with pytest.raises(InputError, match="HYDROTELE_MAX_LOG_VALUES"):
        load(bags["mcap"])
