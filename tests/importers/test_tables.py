"""Import of CSV dialects and MATLAB files, proposed mappings, and export to MCAP."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from scipy.io import savemat
from typer.testing import CliRunner

from hydrotele.cli.main import app
from hydrotele.core.errors import InputError
from hydrotele.importers.conversion import import_log
from hydrotele.importers.mcap_export import write_mcap
from hydrotele.importers.proposal import format_mapping, propose_mapping
from hydrotele.logs.log import Log, load_log, save_log
from hydrotele.machine.log_columns import parse_log_column, read_log_columns
from hydrotele.machine.machine_file import load_machine

TIME = np.round(0.01 * np.arange(500), 6)
BOOM = np.round(0.3 * np.sin(TIME), 6)
PUMP = np.round(200.0 + 10.0 * BOOM, 4)


def convert(path, **columns):
    return import_log([path], {name: parse_log_column(entry) for name, entry in columns.items()})[0]


# CSV dialects of loggers


def rows(form="{:.6f};{:.6f};{:.4f}", end="\n", time=TIME):
    return "".join(form.format(*values) + end for values in zip(time, BOOM, PUMP, strict=True))


LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t,\nDate\t2024/05/01\n"
    "***End_of_Header***\t\n\nChannels\t2\t\nSamples\t500\t500\nY_Unit_Label\tVolts\tVolts\nX0\t0,0\t0,0\n"
    "***End_of_Header***\t\t\nX_Value\tBoom\tPump\tComment\n"
)
DIALECTS = {
    "LabVIEW": LABVIEW + rows("{:.6f}\t{:.6f}\t{:.4f}\t").replace(".", ","),
    "preamble and units": "Test;digger\nDate;2024-05-01\n\nTime;Boom;Pump\ns;rad;bar\n" + rows(),
    "units in brackets": "Time,Boom,Pump\n[s],[rad],[bar]\n" + rows("{:.6f},{:.6f},{:.4f}"),
    "units in parentheses": "Time (s);Boom (rad);Pump (bar)\n" + rows(),
    "dates with the day in front": "Zeit;Boom;Pump\n"
    + "".join(f"01.05.2024 12:00:{t:09.6f};{b:.6f};{p:.4f}\n" for t, b, p in zip(TIME, BOOM, PUMP, strict=True)),
    "dates with AM and PM": "Timestamp,Boom,Pump\n"
    + "".join(f"5/1/2024 12:00:{t:09.6f} PM,{b:.6f},{p:.4f}\n" for t, b, p in zip(TIME, BOOM, PUMP, strict=True)),
    "times with a decimal comma": "Time;Boom;Pump\n"
    + "".join(f"12:00:{t:09.6f};{b:.6f};{p:.4f}\n".replace(".", ",") for t, b, p in zip(TIME, BOOM, PUMP, strict=True)),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_dialects(name, tmp_path):
    (tmp_path / "a.csv").write_text(DIALECTS[name])
    columns = {"Boom": "angle.boom", "Pump": "pressure_supply [bar]", "Comment": "none"}
    log = convert(tmp_path / "a.csv", **columns)
    assert log.time - log.time[0] == pytest.approx(TIME, abs=1e-9)
    assert np.array_equal(log["angle.boom"], BOOM) and np.allclose(log["pressure_supply"], 1e5 * PUMP, rtol=1e-14)
    plain = load_log(tmp_path / "a.csv", aliases={**columns, "Time": "time", "Zeit": "time", "Timestamp": "time",
                                                  "X_Value": "time"})  # fmt: skip
    assert np.array_equal(plain["angle.boom"], BOOM)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_encodings(encoding, tmp_path):
    text = "Zeit;Löffel\ns;°\n" + "".join(f"{t:.6f};{b:.6f}\n" for t, b in zip(TIME, BOOM, strict=True))
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    log = convert(tmp_path / "a.csv", **{"Löffel": "angle.bucket"})
    assert np.allclose(log["angle.bucket"], np.radians(BOOM), rtol=1e-14)


def test_a_row_of_the_wrong_length_is_still_named(tmp_path):
    (tmp_path / "a.csv").write_text("time,angle.boom,angle.stick\n0.0,1.0\n0.1,1.0,2.0\n")
    with pytest.raises(InputError, match=r"row 0 \(line 2\): the row has 2 cells, the header has 3"):
        load_log(tmp_path / "a.csv")


def test_columns_that_alternate_have_times_of_their_own(tmp_path):
    """CAN loggers write one row per message, with empty cells for the signals of other messages."""
    lines = ["timestamp,Boom,Pump"]
    for t, b in zip(TIME, BOOM, strict=True):
        lines += [f"{t:.6f},{b:.6f},", f"{t + 0.004:.6f},,{200.0 + t:.4f}"]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    log = convert(tmp_path / "a.csv", Boom="angle.boom", Pump="pressure_supply [bar]")
    assert np.array_equal(log.time, TIME) and np.array_equal(log["angle.boom"], BOOM)
    assert np.isnan(log["pressure_supply"][0])  # before the first value
    assert np.allclose(log["pressure_supply"][1:], 1e5 * (200.0 + TIME[1:] - 0.004), rtol=1e-9)


def test_nan_cells_duplicate_stamps_and_text(tmp_path):
    lines = ["time,Boom,Mode", *(f"{t:.6f},{b:.6f},auto" for t, b in zip(TIME, BOOM, strict=True))]
    lines[50] = lines[50].replace(f"{BOOM[49]:.6f}", "")
    lines.insert(101, lines[100])
    (tmp_path / "a.csv").write_text("\n".join(lines))
    log = convert(tmp_path / "a.csv", Boom="angle.boom")
    assert np.array_equal(log.time, TIME) and np.flatnonzero(np.isnan(log["angle.boom"])).tolist() == [49]
    with pytest.raises(InputError, match="'auto' is not a number"):
        convert(tmp_path / "a.csv", Mode="angle.boom")


def test_wrong_units_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text(
        "time;Boom\n" + "".join(f"{t};{100 * b}\n" for t, b in zip(TIME, BOOM, strict=True))
    )
    with pytest.raises(InputError, match="looks like degrees"):
        convert(tmp_path / "a.csv", Boom="angle.boom")
    with pytest.raises(InputError, match="has the unit 'bar'"):
        convert(tmp_path / "a.csv", Boom="angle.boom [bar]")


# Mapping


def test_conversion_of_a_column(tmp_path):
    """Value = sign * scale * (column - minus) + offset, after jumps of `wrap` were removed."""
    counts = np.round(4096 / (2 * np.pi) * (20.0 * TIME)) % 4096
    text = "time,Enc,Up,Down\n" + "".join(
        f"{t:.6f},{c:.0f},{max(b, 0):.6f},{max(-b, 0):.6f}\n" for t, c, b in zip(TIME, counts, BOOM, strict=True)
    )
    (tmp_path / "a.csv").write_text(text)
    (tmp_path / "log_columns.yaml").write_text(
        "log_columns:\n"
        f"  Enc: {{channel: angle.swing, wrap: 4096, scale: {360 / 4096}, unit: deg, sign: -1, offset: 10}}\n"
        '  Up: {channel: command.boom, minus: Down, scale: 2, unit: "1"}\n'
    )
    for log in (load_log(tmp_path / "a.csv"), convert(tmp_path / "a.csv",
                                                      **read_log_columns(tmp_path / "log_columns.yaml"))):  # fmt: skip
        assert log["angle.swing"] == pytest.approx(np.radians(10.0) - 20.0 * TIME, abs=np.pi / 4096 + 1e-9)
        assert log["command.boom"] == pytest.approx(2.0 * BOOM, abs=1e-12)
        assert set(log.columns) == {"angle.swing", "command.boom"}


@pytest.mark.parametrize(("entry", "message"), [
    ("{channel: angle.boom, factor: 2}", r"a.yaml:2: log_columns.A.mapping: unknown key 'factor'"),
    ("{channel: angle.boom, sign: 2}", "Input should be 1 or -1"),
    ("{unit: deg}", "channel: Field required"),
    ("{channel: angle.boom, wrap: -1}", "wrap: Input should be greater than 0"),
    ("3", "log_columns.A"),
])  # fmt: skip
def test_wrong_entries_are_named(entry, message, tmp_path):
    (tmp_path / "a.yaml").write_text(f"log_columns:\n  A: {entry}\n")
    with pytest.raises(InputError, match=message):
        read_log_columns(tmp_path / "a.yaml")


def test_a_missing_column_to_subtract_is_named(tmp_path):
    (tmp_path / "a.csv").write_text("time,Up\n" + "".join(f"{t},0.5\n" for t in TIME))
    aliases = {"Up": parse_log_column("command.boom").model_copy(update={"minus": "Down"})}
    with pytest.raises(InputError, match="has no column 'Down', which log_columns subtracts"):
        load_log(tmp_path / "a.csv", aliases=aliases)


# MATLAB


def write_hdf5(path, content):
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in content.items():
            file[name] = values
        file["#refs#/name"] = np.array([[ord(c)] for c in "Boom Angle"], np.uint16)
        file["#refs#/name"].attrs["MATLAB_class"] = np.bytes_("char")
        file["#refs#/data"] = BOOM[None, :]
        reference = h5py.ref_dtype
        file.create_dataset("capture/Y/Data", data=np.array([[file["#refs#/data"].ref]], dtype=reference))
        file.create_dataset("capture/Y/Name", data=np.array([[file["#refs#/name"].ref]], dtype=reference))
        file["capture/X/Data"] = TIME[None, :]
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_matlab(version, tmp_path):
    """Vectors with a time vector, a structure with its own slower time and a matrix, and a dSPACE capture."""
    path = tmp_path / "a.mat"
    if version == "7.3":
        pump = {"pump/time": TIME[None, ::2], "pump/values": np.stack([PUMP, PUMP])[:, ::2]}
        write_hdf5(path, {"t": TIME[None, :], "boom": BOOM[None, :], "picture": np.zeros((3, 3)), **pump})
    else:
        signals = [{"Name": "Boom Angle", "Data": BOOM}, {"Name": "Other", "Data": -BOOM}]
        capture = {"X": {"Name": "t", "Data": TIME}, "Y": np.array(signals, dtype=object)}
        pump = {"time": TIME[::2, None], "values": np.column_stack([PUMP, PUMP])[::2]}
        savemat(path, {"t": TIME, "boom": BOOM, "picture": np.zeros((3, 3)), "pump": pump, "capture": capture})
    log = convert(path, **{"boom": "-angle.boom", "pump.values[1]": "pressure_supply [bar]",
                           "capture.Y[Boom Angle].Data": "angle.stick"})  # fmt: skip
    assert np.array_equal(log.time, TIME) and np.array_equal(log["angle.boom"], -BOOM)
    assert np.array_equal(log["angle.stick"], BOOM)
    assert np.allclose(log["pressure_supply"][::2], 1e5 * PUMP[::2], rtol=1e-14)
    assert np.isnan(log["pressure_supply"][1::2]).all()


def test_matlab_time_of_another_name_and_unit(tmp_path):
    savemat(tmp_path / "a.mat", {"clock": 1e3 * TIME, "boom": BOOM})
    log = convert(tmp_path / "a.mat", clock="time [ms]", boom="angle.boom")
    assert log.time == pytest.approx(TIME, abs=1e-12)
    with pytest.raises(InputError, match=r"contains none of the columns|no vector"):
        convert(tmp_path / "a.mat", boom="angle.boom")


# Proposals


def test_a_proposal_can_be_imported(tmp_path):
    names = "Time;Boom angle [deg];Arm pos;P_head boom (bar);Druck Pumpe [bar];Pilot boom up;Pilot boom down;Cabin temp"
    values = [TIME, np.degrees(BOOM), 100 * BOOM, PUMP, PUMP, *np.maximum([BOOM, -BOOM], 0.0), TIME]
    lines = [names, *(";".join(f"{v:.6f}" for v in row) for row in zip(*values, strict=True))]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    proposals = {p.column: p for p in propose_mapping(tmp_path / "a.csv", load_machine("cat215"))}
    found = {name: p.channel for name, p in proposals.items()}
    assert found == {
        "Boom angle": "angle.boom", "Arm pos": "angle.stick", "P_head boom": "pressure_head.boom",
        "Druck Pumpe": "pressure_supply", "Pilot boom up": "command.boom", "Cabin temp": None,
    }  # fmt: skip
    assert proposals["Pilot boom up"].minus == "Pilot boom down" and proposals["Arm pos"].unit == "deg"
    assert proposals["Boom angle"].confidence == 1.0 > proposals["Arm pos"].confidence > proposals[
        "Pilot boom up"].confidence  # fmt: skip
    text = format_mapping(list(proposals.values()), "a.csv")
    columns = {k: parse_log_column(v) if isinstance(v, str) else parse_log_column(v["channel"]).model_copy(update=v)
               for k, v in yaml.safe_load(text)["log_columns"].items()}  # fmt: skip
    log, report = import_log([tmp_path / "a.csv"], columns)
    assert len(log.columns) == 5 and list(report.ignored) == ["Cabin temp"]


# Export


def make_log(gap=True):
    pressure = 1e5 * PUMP
    pressure[1::2] = np.nan if gap else pressure[1::2]
    columns = {"angle.boom": BOOM, "position.slide": TIME, "velocity.boom": np.cos(TIME), "command.boom": BOOM,
               "pressure_head.boom": pressure}  # fmt: skip
    units = {"angle.boom": "rad", "position.slide": "m", "velocity.boom": "rad/s", "command.boom": "1",
             "pressure_head.boom": "Pa"}  # fmt: skip
    return Log(TIME, columns, units, {"hydrotele": "0", "machine": "digger"})


def test_export_and_import_return_the_same_log(tmp_path):
    log = make_log()
    truth = {"columns": {**log.columns, "truth.angle.boom": BOOM}, "units": {**log.units, "truth.angle.boom": "rad"}}
    assert write_mcap(dataclasses.replace(log, **truth), tmp_path / "a.mcap") == 500 + 500 + 250  # without the truth
    columns = {p.column: parse_log_column(f"{p.channel}") for p in propose_mapping(tmp_path / "a.mcap")
               if p.channel and p.confidence}  # fmt: skip
    columns["/joint_states.position[slide]"] = parse_log_column("position.slide")
    found = import_log([tmp_path / "a.mcap"], columns)[0]
    assert set(found.columns) == set(log.columns) and np.array_equal(found.time, log.time)
    for name, values in log.columns.items():
        assert np.array_equal(found[name], values, equal_nan=True), name


def run_rerun(*words):
    command = [sys.executable, "-m", "rerun", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_exported_messages_are_those_of_ros(tmp_path):
    """Read by rosbags with its own definitions, and by the loader of the rerun viewer."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    log = make_log()
    write_mcap(log, tmp_path / "a.mcap")
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        last = {c.topic: (t, store.deserialize_cdr(data, c.msgtype)) for c, t, data in reader.messages()}
    stamp, state = last["/joint_states"]
    assert stamp == 4_990_000_000 and (state.header.stamp.sec, state.header.stamp.nanosec) == (4, 990_000_000)
    assert state.name == ["boom", "slide"] and state.position.tolist() == [BOOM[-1], TIME[-1]]
    assert state.velocity[0] == np.cos(TIME[-1]) and np.isnan(state.velocity[1]) and not len(state.effort)
    assert last["/command/boom"][1].data == BOOM[-1]
    assert last["/pressure_head/boom"][1].fluid_pressure == 1e5 * PUMP[-2]
    command = [
        sys.executable,
        "-m",
        "rerun",
        "mcap",
        "convert",
        str(tmp_path / "a.mcap"),
        "-o",
        str(tmp_path / "a.rrd"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    command = [sys.executable, "-m", "rerun", "rrd", "print", "-v", str(tmp_path / "a.rrd")]
    said = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
    assert "500 rows" in said and "/joint_states/position@Scalars:scalars" in said and "Measurements:values" in said


# Commands


def test_commands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    head = "# sensors: khoshzaban1992\nTime;Boom angle [deg]\n"
    Path("a.csv").write_text(head + "".join(f"{t};{b}\n" for t, b in zip(TIME, BOOM, strict=True)))
    run = CliRunner()
    assert run.invoke(app, ["import", "a.csv", "--write-mapping", "m.yaml"]).exit_code == 0
    assert isinstance(run.invoke(app, ["import", "a.csv", "--write-mapping", "m.yaml"]).exception, InputError)
    done = run.invoke(app, ["import", "a.csv", "--mapping", "m.yaml", "--machine", "cat215", "--json"])
    assert done.exit_code == 0 and '"channel": "angle.boom"' in done.stdout
    known = pq.read_schema("a.parquet").metadata
    assert known[b"machine"] == b"cat215" and known[b"sensors"] == b"khoshzaban1992"
    assert np.allclose(load_log("a.parquet")["angle.boom"], np.radians(BOOM))
    assert run.invoke(app, ["export-log", "a.parquet", "--mcap", "a.mcap"]).exit_code == 0
    before = Path("a.parquet").read_bytes()
    Path("bad.csv").write_text("Time;Boom angle [deg]\n0;1\n1;x\n")
    done = run.invoke(app, ["import", "bad.csv", "--mapping", "m.yaml", "--out", "a.parquet"])
    assert isinstance(done.exception, InputError) and Path("a.parquet").read_bytes() == before
    done = run.invoke(app, ["import", "a.csv", "a.mcap", "--out", "b.parquet"])
    assert "--merge for one run" in str(done.exception)


def test_missing_values_are_saved_only_if_allowed(tmp_path):
    with pytest.raises(InputError, match="is nan"):
        save_log(make_log(), tmp_path / "a.parquet")
    save_log(make_log(), tmp_path / "a.parquet", missing=True)
    assert np.isnan(load_log(tmp_path / "a.parquet")["pressure_head.boom"]).sum() == 250


def test_columns_match_axes_with_names_of_joints(tmp_path):
    machine = load_machine("cat215", "bucket")
    renamed = machine.model_copy(update={"axes": {f"{name}_hinge": axis for name, axis in machine.axes.items()}})
    names = ["Time [ms]", "JS_boom [%]", "Enc_arm [deg]", "P_ARM_bottom [bar]", "P_slew_b [bar]"]
    table = np.column_stack([np.arange(50.0), *(np.linspace(20.0, 80.0, 50) for _ in names[1:])])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(names), comments="")
    found = {p.column: p.channel for p in propose_mapping(tmp_path / "log.csv", renamed)}
    assert found == {"JS_boom": "command.boom_hinge", "Enc_arm": "angle.stick_hinge",
                     "P_ARM_bottom": "pressure_head.stick_hinge", "P_slew_b": "pressure_rod.swing_hinge"}  # fmt: skip
