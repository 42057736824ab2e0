"""Logs in and out: real files, round trip, every refusal, and damage."""

import json
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log, load_log, load_logs, save_log
from tests.measured import MEASURED, REAL, needs_real

ROOT = Path(__file__).resolve().parents[2]
EMPS = {
    "position": "position.slide",
    "reference": "reference.slide",
    "drive_voltage": "command.slide",
    "force": "force.slide",
}
# No deadline: the first read imports pyarrow. The shared tmp_path is safe: each example overwrites
# its file.
DAMAGE = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def make_log(rows: int = 20) -> Log:
    time = 0.02 * np.arange(rows)
    columns = {
        "command.boom": 0.5 * np.sin(time),
        "angle.boom": 0.3 + 0.1 * np.cos(time),
        "pressure_head.boom": 1.2e7 + 1e5 * time,
        "truth.flow_supply": 1e-3 * np.ones(rows),
    }
    units = ("1", "rad", "Pa", "m^3/s")
    metadata = {"machine": "cat215", "initial_state": json.dumps({"angle": [0.1, 1 / 3]})}
    return Log(time, columns, dict(zip(columns, units, strict=True)), metadata, "made/run_7")


def write(path: Path, columns: dict, units: dict | None = None, **kwargs) -> Path:
    """Write any table; a unit of None leaves it out."""
    given_units = {
        "time": "s",
        "command.boom": "1",
        "angle.boom": "rad",
        "pressure_head.boom": "Pa",
    }
    given_units.update(units or {})
    arrays = [pa.array(values) for values in columns.values()]
    fields = []
    for name, array in zip(columns, arrays, strict=True):
        unit = given_units.get(name)
        fields.append(pa.field(name, array.type, metadata={"unit": unit} if unit else None))
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields, **kwargs)), path)
    return path


def good(**changes) -> dict:
    """Return columns that load; `angle__boom=values` replaces or adds `angle.boom`."""
    log = make_log().without_truth()
    columns = {"time": log.time.copy(), **{k: v.copy() for k, v in log.columns.items()}}
    return {**columns, **{k.replace("__", "."): v for k, v in changes.items()}}


def changed(name: str, row: int, value: float) -> dict:
    columns = good()
    columns[name][row] = value
    return columns


def refusal(path: Path, **kwargs) -> str:
    with pytest.raises(InputError) as caught:
        load_log(path, **kwargs)
    assert str(path) in caught.value.where
    assert "\n" not in str(caught.value)
    return str(caught.value)


# Real files


@pytest.mark.parametrize("folder", ["nominal_truth", "open_01", "open_10"])
def test_measured_folders_load(folder):
    logs = load_logs(MEASURED / folder, required=["pressure_supply"])
    assert [log.name for log in logs] == ["fit_1", "fit_2", "fit_3", "test_1"]
    for log in logs:
        assert len(log) == 2000
        assert log.rate == pytest.approx(50.0, rel=1e-9)  # time is rounded to 1e-15 of 40 s
        assert log.axes == ("swing", "boom", "stick")
        assert log.metadata["machine"] == "cat215"
        assert len(log.gaps) == 0
        assert len(log.without_truth().columns) == 15
    if folder == "nominal_truth":
        assert json.loads(logs[0].metadata["initial_state"])["order"] == ["swing", "boom", "stick"]
        assert logs[0].units["truth.force.swing"] == "N m"


@needs_real
def test_emps_loads_through_aliases():
    path = REAL / "emps" / "main.parquet"
    log = load_log(path, aliases=EMPS)
    assert log.units == {
        "position.slide": "m",
        "reference.slide": "m",
        "command.slide": "V",
        "force.slide": "N",
    }
    assert log["force.slide"].dtype == np.float64
    assert log.rate == pytest.approx(1000.0, rel=1e-4)  # the published clock is 16 ppm fast
    assert "such as position.boom" in refusal(path)


@needs_real
def test_volvo_loads_though_its_joystick_passes_one():
    log = load_log(REAL / "volvo_ec20" / "long.parquet")
    assert log.axes == ("boom", "stick")
    assert 1.0 < np.abs(log["command.boom"]).max() < 1.001


@needs_real
def test_panda_lacks_samples_and_says_so():
    log = load_log(REAL / "panda" / "exciting_1.parquet")
    assert len(log.axes) == 7
    assert len(log.gaps) > 0


@needs_real
def test_a_csv_that_is_no_log_is_told_about_the_header():
    path = REAL / "mukca_panda_3" / "backcenter" / "hole_0.csv"
    assert "header" in refusal(path)


# Round trip


def test_round_trip_is_bit_exact(tmp_path):
    log = make_log()
    values = log["angle.boom"].copy()
    values[:4] = -0.0, 5e-324, 1 / 3, np.nextafter(1.0, 2.0)
    log = replace(log, columns={**log.columns, "angle.boom": values})
    path = tmp_path / "run.parquet"
    save_log(log, path)
    again = load_log(path)
    assert again.time.tobytes() == log.time.tobytes()
    assert list(again.columns) == list(log.columns)
    assert all(again[name].tobytes() == log[name].tobytes() for name in log.columns)
    assert (again.units, again.metadata) == (log.units, log.metadata)
    assert again.source == str(path)
    assert pq.read_schema(path).field("angle.boom").metadata == {b"unit": b"rad"}
    assert os.listdir(tmp_path) == ["run.parquet"]


def test_round_trip_of_a_measured_file(tmp_path):
    log = load_log(MEASURED / "nominal_truth" / "fit_1.parquet")
    save_log(log, tmp_path / "fit_1.parquet")
    again = load_log(tmp_path / "fit_1.parquet")
    assert all(np.array_equal(again[name], log[name]) for name in log.columns)
    assert again.metadata == log.metadata


def test_a_log_is_frozen_copied_and_can_be_sent_to_another_process():
    source = np.zeros(20)
    log = replace(make_log(), columns={"angle.boom": source}, units={"angle.boom": "rad"})
    source[0] = 1.0
    assert log["angle.boom"][0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        log["angle.boom"][0] = 1.0
    assert np.array_equal(pickle.loads(pickle.dumps(log)).time, log.time)
    assert "time" in log
    assert "angle.stick" not in log
    with pytest.raises(InputError, match="angle.stick.*it has angle.boom"):
        log["angle.stick"]


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"columns": {"angle.boom": np.zeros(3)}, "units": {"angle.boom": "rad"}}, ValueError),
        ({"columns": {"angle.boom": np.zeros(20)}, "units": {"angle.boom": "deg"}}, ValueError),
        ({"columns": {"angel.boom": np.zeros(20)}, "units": {"angel.boom": "rad"}}, ValueError),
        ({"units": {}}, ValueError),
        ({"metadata": {"initial_state": {"angle": 1}}}, TypeError),
    ],
)
def test_a_log_cannot_be_made_wrong(change, error):
    with pytest.raises(error):
        replace(make_log(), **change)


# Writing is all or nothing


def test_nothing_is_written_on_refusal(tmp_path):
    values = make_log()["angle.boom"].copy()
    values[7] = np.nan
    log = replace(make_log(), columns={**make_log().columns, "angle.boom": values})
    with pytest.raises(InputError, match=r"angle\.boom', row 7"):
        save_log(log, tmp_path / "run.parquet")
    with pytest.raises(InputError, match=r"\.parquet"):
        save_log(make_log(), tmp_path / "run.csv")
    with pytest.raises(InputError, match="cannot be written"):
        save_log(make_log(), tmp_path / "absent" / "run.parquet")
    (tmp_path / "folder.parquet").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        save_log(make_log(), tmp_path / "folder.parquet")
    assert os.listdir(tmp_path) == ["folder.parquet"]


def test_a_failing_disk_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "run.parquet"
    save_log(make_log(), path)
    before = path.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left"):
        save_log(make_log(30), path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["run.parquet"]


def test_a_kill_in_the_middle_leaves_no_file_of_that_name(tmp_path):
    code = (
        "import os, signal, sys; sys.path[:0] = sys.argv[2:]\n"
        "from test_log import make_log\n"
        "from hydrotele.logs.log import save_log\n"
        "os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)\n"
        "save_log(make_log(), sys.argv[1])\n"
    )
    path = tmp_path / "run.parquet"
    paths = [str(ROOT), str(Path(__file__).parent)]
    done = subprocess.run([sys.executable, "-c", code, str(path), *paths], capture_output=True)
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    assert not path.exists()
    assert [name for name in os.listdir(tmp_path) if not name.startswith(".")] == []
    with pytest.raises(InputError, match="contains no log"):
        load_logs(tmp_path)


# Refusals of Parquet


REFUSED = {
    "infinity": (changed("command.boom", 0, np.inf), {}, ["'command.boom', row 0", "inf"]),
    "text": (good(angle__boom=["a"] * 20), {}, ["'angle.boom'", "string", "float64"]),
    "truth value": (good(angle__boom=[True] * 20), {}, ["'angle.boom'", "bool"]),
    "milliseconds": (good(time=20.0 * np.arange(20)), {}, ["'time'", "milliseconds"]),
    "unknown kind": (
        good(angel__boom=np.zeros(20)),
        {},
        ["'angel.boom'", "did you mean angle.boom", "pressure_supply"],
    ),
    "wrong dimension": (good(), {"angle.boom": "m"}, ["'angle.boom'", "'m'", "rad", "correct"]),
    "unknown unit": (good(), {"angle.boom": "furlong"}, ["'furlong'", "rad"]),
    "degrees": (changed("angle.boom", 11, 10100.0), {}, ["'angle.boom', row 11", "degrees"]),
    "unstated degrees": (
        changed("angle.boom", 11, 45.0),
        {"angle.boom": None},
        ["'angle.boom', row 11", "degrees", "state the unit"],
    ),
    "bar": (
        good(pressure_head__boom=np.linspace(100.0, 280.0, 20)),
        {},
        ["'pressure_head.boom', row 19", "280", "bar"],
    ),
    "unstated kPa": (
        good(pressure_head__boom=np.linspace(100.0, 28000.0, 20)),
        {"pressure_head.boom": None},
        ["'pressure_head.boom', row 19", "kPa", "state the unit"],
    ),
    "millimetres": (
        good(length__boom=np.linspace(40.0, 900.0, 20)),
        {"length.boom": "m"},
        ["'length.boom', row 1", "millimetres"],
    ),
    "percent": (changed("command.boom", 2, -1.5), {}, ["'command.boom', row 2", "[-1, 1]"]),
    "too short": ({k: v[:9] for k, v in good().items()}, {}, ["too short", "9 rows", "10"]),
    "no rows": ({k: v[:0] for k, v in good().items()}, {}, ["too short", "0 rows"]),
    "no columns": ({}, {}, ["too short", "0 rows"]),
    "no time": (
        {k: v for k, v in good().items() if k != "time"},
        {},
        ["column time", "it has command.boom, angle.boom"],
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_parquet_is_refused_with_place_and_remedy(case, tmp_path):
    columns, units, expected = REFUSED[case]
    message = refusal(write(tmp_path / "run.parquet", columns, units))
    assert [part for part in expected if part not in message] == [], message


def test_refusals_of_what_is_no_log_file(tmp_path):
    assert "does not exist" in refusal(tmp_path / "absent.parquet")
    assert "is not a file" in refusal(tmp_path)
    for name, content in {
        "empty.parquet": b"",
        "corrupt.parquet": b"PAR1 nothing PAR1",
        "empty.csv": b"",
        "binary.csv": b"\xff\xfe\x00\x01",
        "run.mat": b"MATLAB",
    }.items():
        (tmp_path / name).write_bytes(content)
        assert refusal(tmp_path / name)


def test_duplicate_columns_are_refused(tmp_path):
    time = 0.02 * np.arange(20)
    fields = ["time", "angle.boom", "angle.boom"]
    table = pa.Table.from_arrays([pa.array(time)] * 3, names=fields)
    pq.write_table(table, tmp_path / "run.parquet")
    assert "'angle.boom': occurs 2 times" in refusal(tmp_path / "run.parquet")
    path = write(tmp_path / "alias.parquet", good(q=time))
    assert "'angle.boom': occurs 2 times" in refusal(path, aliases={"q": "angle.boom"})


def test_missing_required_columns_list_what_is_there(tmp_path):
    path = write(tmp_path / "run.parquet", good())
    message = refusal(path, required=["angle.boom", "angle.stick", "pressure_supply"])
    assert "angle.stick, pressure_supply; it has time, command.boom, angle.boom" in message


def test_missing_rows_are_listed_as_gaps(tmp_path):
    time = np.delete(0.02 * np.arange(400), [100, 200, 201])
    log = load_log(write(tmp_path / "run.parquet", {"time": time}))
    assert (log.gaps.tolist(), log.notes) == ([100, 199], ())


def test_integers_float32_missing_units_and_pandas_keys_are_read(tmp_path):
    columns = good(angle__boom=np.linspace(0, 1, 20, dtype=np.float32))
    columns["command.boom"] = np.zeros(20, dtype=np.int8)
    columns["__index_level_0__"] = np.arange(20)
    metadata = {"pandas": '{"index_columns": ["__index_level_0__"]}', "machine": "cat215"}
    no_units = dict.fromkeys(("time", "command.boom", "angle.boom", "pressure_head.boom"))
    log = load_log(write(tmp_path / "run.parquet", columns, no_units, metadata=metadata))
    assert log.metadata == {"machine": "cat215"}
    assert log.units == {"command.boom": "1", "angle.boom": "rad", "pressure_head.boom": "Pa"}
    assert all(values.dtype == np.float64 for values in log.columns.values())
    assert np.array_equal(log["angle.boom"], columns["angle.boom"].astype(np.float64))


def test_a_dead_pressure_sensor_is_not_taken_for_a_wrong_unit(tmp_path):
    path = write(tmp_path / "run.parquet", good(pressure_head__boom=np.zeros(20)))
    assert not load_log(path)["pressure_head.boom"].any()


def test_a_folder_is_read_whole_or_not_at_all(tmp_path):
    with pytest.raises(InputError, match="contains no log"):
        load_logs(tmp_path)
    save_log(make_log(), tmp_path / "b.parquet")
    (tmp_path / "a.csv").write_text(csv_text())
    (tmp_path / "notes.txt").write_text("not a log")
    assert [log.name for log in load_logs(tmp_path)] == ["a", "b"]
    assert [log.name for log in load_logs(tmp_path / "b.parquet")] == ["b"]
    (tmp_path / "a.csv").rename(tmp_path / "b.csv")
    with pytest.raises(InputError, match="'b' exists 2 times"):
        load_logs(tmp_path)


# CSV


def csv_text(separator: str = ",", end: str = "\n") -> str:
    rows = [f"{20 * k}{separator}{k}{separator}{100 + k}" for k in range(20)]
    header = separator.join(["time [ms]", '"angle.boom [deg]"', "pressure_head.boom[bar]"])
    return end.join(["# machine: cat215", "# a remark", header, "", *rows]) + end


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_csv_is_converted_to_si(tmp_path, separator, end, mark):
    path = tmp_path / "run.CSV"
    path.write_bytes((mark + csv_text(separator, end)).encode())
    log = load_log(path)
    assert log.metadata == {"machine": "cat215"}
    assert log.units == {"angle.boom": "rad", "pressure_head.boom": "Pa"}
    assert np.allclose(log.time, 0.02 * np.arange(20), rtol=1e-15)  # one product's rounding
    assert np.allclose(log["angle.boom"], np.radians(np.arange(20)), rtol=1e-15)
    assert np.allclose(log["pressure_head.boom"], 1e5 * (100 + np.arange(20)), rtol=1e-15)


def test_csv_without_units_is_si_bit_by_bit(tmp_path):
    time = 0.02 * np.arange(20)
    rows = "\n".join(f"{t!r},{t / 3!r}" for t in time.tolist())
    (tmp_path / "run.csv").write_text("time,angle.boom\n" + rows)
    log = load_log(tmp_path / "run.csv")
    assert log["angle.boom"].tobytes() == (time / 3).tobytes()


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("\n80,4,104", "\n,4,104", ["'time', row 4 (line 9)", "is nan"]),
        ("\n80,4,104", "\n80,four,104", ["'angle.boom', row 4 (line 9)", "'four'", "not a number"]),
        ("\n80,4,104", "\n80,1_0,104", ["'angle.boom', row 4 (line 9)", "'1_0'"]),
        ("\n80,4,104", "\n80,4", ["row 4 (line 9)", "2 cells", "3"]),
        ("\n80,4,104", "\n80,4,1,04", ["row 4 (line 9)", "4 cells"]),
        ("[deg]", "[kPa]", ["'angle.boom'", "'kPa'", "rad"]),
        ("[deg]", "[deg/s]", ["'angle.boom'", "'deg/s'", "rad"]),
        ("[deg]", "[parsec]", ["'angle.boom'", "'parsec'"]),
        (" [deg]", "", ["'angle.boom', row 13 (line 18)", "degrees", "state the unit"]),
        ("angle.boom", "angle_boom", ["'angle_boom'", "angle.boom"]),
        ('"angle.boom [deg]"', "time", ["'time': occurs 2 times"]),
        ("time [ms]", "length.boom [mm]", ["column time", "length.boom"]),
        ("\n0,0,100", "\n0;0;100", ["row 0 (line 5)", "1 cells"]),
    ],
)
def test_csv_is_refused_with_line(tmp_path, old, new, expected):
    path = tmp_path / "run.csv"
    assert old in csv_text()
    path.write_text(csv_text().replace(old, new, 1))
    message = refusal(path)
    assert [part for part in expected if part not in message] == [], message


# Damage: whatever the bytes, a Log or an InputError


def load_or_refuse(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    try:
        log = load_log(path)
    except InputError as error:
        assert str(path) in str(error)
    else:
        assert not any(np.isinf(log[name]).any() for name in log.columns)
        assert (np.diff(log.time) > 0).all()


def damaged(content: bytes, cuts: list[tuple[float, bytes]], keep: float) -> bytes:
    """Overwrite pieces at relative positions, then keep the first part."""
    data = bytearray(content)
    for place, piece in cuts:
        start = int(place * len(data))
        data[start : start + len(piece)] = piece
    return bytes(data[: int(keep * len(data)) + 1])


CUTS = st.lists(st.tuples(st.floats(0, 1), st.binary(min_size=1, max_size=6)), max_size=6)
KEEP = st.one_of(st.just(1.0), st.floats(0, 1))


@DAMAGE
@given(CUTS, KEEP)
def test_damaged_parquet(tmp_path, cuts, keep):
    save_log(make_log(), tmp_path / "good.parquet")
    content = (tmp_path / "good.parquet").read_bytes()
    load_or_refuse(tmp_path / "bad.parquet", damaged(content, cuts, keep))


@DAMAGE
@given(CUTS, KEEP)
def test_damaged_csv(tmp_path, cuts, keep):
    load_or_refuse(tmp_path / "bad.csv", damaged(csv_text().encode(), cuts, keep))


@DAMAGE
@given(st.text(alphabet='time,;\t[]#:."ab0189-+e_ \n\r', max_size=200))
def test_any_csv_text(tmp_path, text):
    load_or_refuse(tmp_path / "any.csv", ("time,angle.boom\n" + text).encode())


@DAMAGE
@given(st.binary(max_size=300), st.sampled_from(["any.csv", "any.parquet"]))
def test_any_bytes(tmp_path, content, name):
    load_or_refuse(tmp_path / name, content)


def test_a_flipped_bit_in_the_values_is_found(tmp_path):
    path = tmp_path / "run.parquet"
    save_log(make_log(), path)
    content = bytearray(path.read_bytes())
    page = pq.ParquetFile(path).metadata.row_group(0).column(2)
    content[page.data_page_offset + page.total_compressed_size - 9] ^= 1
    path.write_bytes(content)
    assert "Parquet" in refusal(path)


def test_pyarrow_is_imported_only_where_it_is_used():
    code = "import sys, hydrotele.logs.log; sys.exit('pyarrow' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0
