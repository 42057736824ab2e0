"""CSV dialects, time stamps and units that loggers and spreadsheets write: values, notes and reasons."""

import datetime

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hydrotele.core.errors import InputError
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.log import load_log
from hydrotele.logs.masked_intervals import MaskedInterval
from hydrotele.logs.resampling import merge_run
from hydrotele.logs.run_files import RunFiles, read_runs
from hydrotele.machine.machine_file import load_machine

RIG = load_machine("rig")
TIME = np.round(0.02 * np.arange(120), 6)
ANGLE = np.round(0.3 + 0.1 * np.sin(TIME), 6)


def table(separator=",", time=TIME, form="{:.10g}", header="time,command.boom,angle.boom", end=""):
    """Return a CSV text of TIME, 0.5 and ANGLE; `form` formats each number."""
    rows = [[time[k] if isinstance(time[k], str) else form.format(time[k]), form.format(0.5), form.format(ANGLE[k])]
            for k in range(len(TIME))]  # fmt: skip
    return "\n".join(separator.join(row) + end for row in [header.split(","), *rows]) + "\n"


def load(tmp_path, text, **options):
    (tmp_path / "run.csv").write_text(text)
    return load_log(tmp_path / "run.csv", **options)


def refuse(tmp_path, text, **options) -> str:
    with pytest.raises(InputError) as caught:
        load(tmp_path, text, **options)
    return str(caught.value).replace(str(tmp_path / "run.csv"), "FILE")


def comma(text):
    return text.replace(".", ",").replace("command,boom", "command.boom").replace("angle,boom", "angle.boom")


DIALECTS = {
    "points": table(),
    "quoted points": table(form='"{:.10g}"'),
    "quoted decimal commas": comma(table(form='"{:.10g}"')),
    "quoted decimal commas and blanks": comma(table(", ", form='"{:.10g}"')),
    "decimal commas between semicolons": comma(table(";")),
    "decimal commas between tabs": comma(table("\t")),
    "trailing separator": table(";", end=";"),
    "trailing separators of the rows only": table().replace("angle.boom", "angle.boom").replace("\n", ",\n").replace(
        "boom,\n", "boom\n", 1),
    "rows of separators only": table() + ",,\n,,\n",
    "separator line": "sep=;\n" + comma(table(";")),
    "separator line of a bar": "sep=|\n" + table("|"),
    "semicolon comments": "; CSV, made by a logger\n; Sample count: 120\n" + table(),
    "semicolon comment above semicolons": "; made; by a logger\n" + table(";"),
    "percent comments": "% made by a logger\n" + table() + "% end\n",
    "slash comments": "// made by a logger\n" + table(),
    "quoted comments": '"# made by a logger"\n' + table(),
}  # fmt: skip


@pytest.mark.parametrize("case", DIALECTS)
def test_dialects(tmp_path, case):
    log = load(tmp_path, DIALECTS[case])
    assert list(log.columns) == ["command.boom", "angle.boom"] and log.notes == ()
    assert np.array_equal(log.time, TIME) and np.array_equal(log["angle.boom"], ANGLE)


def test_a_header_that_begins_with_a_separator_is_no_comment(tmp_path):
    rows = "\n".join(f"{k};{0.02 * k:.4f};0.3" for k in range(20))
    log = load(tmp_path, ";time;angle.boom\n" + rows, aliases={"": "none"})
    assert np.allclose(log.time, 0.02 * np.arange(20), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (table(";").replace("0.02;0.5", "0.02;0,5", 1),
         "FILE, column 'command.boom', row 1 (line 3): has a decimal comma, but FILE, column 'command.boom', row 0"
         " (line 2) has a decimal point: write one of them"),
        ("time;angle.boom\n" + "".join(f"{k};1,{k + 100}\n" for k in range(20)),
         "FILE, column 'angle.boom', row 0 (line 2): the commas may be decimal signs or separate thousands: write"
         " the numbers with a decimal point and without separators of thousands"),
        (table().replace("0.02,0.5", '0.02,"1,234.5"', 1),
         "FILE, column 'command.boom', row 1 (line 3): '1,234.5' separates thousands: write numbers without such"
         " separators"),
        (comma(table()),
         "FILE, column 'angle.boom', row 0 (line 2): the row has 5 cells, the header has 3: the line is incomplete or"
         " a separator (',') is missing or superfluous; numbers with a decimal comma need quotation marks, or"
         " semicolons between the columns"),
        (table(header="Timestamp,command.boom,angle.boom"),
         "FILE, column 'Timestamp': unknown channel 'Timestamp'; did you mean time?"),
        (table(header="index,command.boom,Time Stamp").replace("Time Stamp", "velocity.boom"),
         "FILE, column 'index': unknown channel 'index'"),
        (table(header="time,command.boom,angle.boom [kPa]"),
         "FILE, column 'angle.boom': has the unit 'kPa'; a log needs rad"),
        ("time," + ",".join(f"angle.a{k}" for k in range(59_999)) + "\n",
         "FILE: has 60000 columns of a log, at most 10000; HYDROTELE_MAX_LOG_COLUMNS=60000 allows them"),
        ("time," + ",".join(f"a_very_long_name.of_a_channel_{k}" for k in range(59_999)) + "\n",
         "columns of a log, at most 10000; HYDROTELE_MAX_LOG_COLUMNS="),
        (table().replace("0.02,0.5", "0.02," + "5" * 1_000_000, 1),
         "FILE, line 3: has more than 1000000 characters, 100 for each of the 10000 columns that"
         " HYDROTELE_MAX_LOG_COLUMNS allows"),
    ],
)  # fmt: skip
def test_the_reason_is_the_real_one(tmp_path, text, message):
    assert message in refuse(tmp_path, text)


def test_a_missing_file_does_not_exist(tmp_path):
    with pytest.raises(InputError, match=r"run\.csv: does not exist"):
        load_log(tmp_path / "run.csv")
    with pytest.raises(InputError, match=r"logs: does not exist"):
        read_runs([tmp_path / "logs"], RIG, {}, False)


def test_columns_of_text_can_be_skipped(tmp_path):
    rows = "".join(f"{0.02 * k:.2f},0.3,{'auto' if k else 'hand'}\n" for k in range(20))
    text = "time,angle.boom,mode\n" + rows
    assert "'hand' is not a number" in refuse(tmp_path, text, aliases={"mode": "current.boom"})
    assert list(load(tmp_path, text, aliases={"mode": "none"}).columns) == ["angle.boom"]


# Units


@pytest.mark.parametrize("alias", ["-angle.boom [deg]", "-angle.boom"])
@pytest.mark.parametrize("header", ["Boom", "Boom [deg]"])
def test_units_in_log_columns(tmp_path, alias, header):
    """Either place may state the unit; without one, 0.3 is radians."""
    text = table(header=f"Timestamp,command.boom,{header}")
    log = load(tmp_path, text, aliases={"Timestamp": "time [s]", "Boom": alias})
    factor = np.pi / 180 if "deg" in header + alias else 1.0
    assert np.allclose(log["angle.boom"], -factor * ANGLE, rtol=1e-14)


def test_units_of_parquet_and_contradictions(tmp_path):
    path = tmp_path / "run.parquet"
    pq.write_table(pa.table({"ms": np.arange(0, 2400, 20), "Boom": np.degrees(ANGLE)}), path)
    log = load_log(path, aliases={"ms": "time [ms]", "Boom": "angle.boom [deg]"})
    assert np.allclose(log.time, TIME, rtol=1e-14) and np.allclose(log["angle.boom"], ANGLE, rtol=1e-14)
    message = refuse(tmp_path, table(header="time,command.boom,Boom [mrad]"), aliases={"Boom": "angle.boom [deg]"})
    assert message == ("FILE, column 'Boom': has the unit 'mrad', but log_columns states 'deg': remove the wrong unit")


# Time


EPOCH = 1_700_000_000.0
START = datetime.datetime(2024, 5, 1, 23, 59, 59)
ISO = [(START + datetime.timedelta(seconds=float(t))).isoformat(timespec="milliseconds") for t in TIME]


@pytest.mark.parametrize(
    ("time", "header", "origin"),
    [
        (EPOCH + TIME, "time", EPOCH),
        (1e3 * (EPOCH + TIME), "time [ms]", EPOCH),
        (ISO, "time", 0.0),
        ([stamp.replace("T", " ") + "Z" for stamp in ISO], "time", 0.0),
    ],
)
def test_calendar_time_begins_at_zero(tmp_path, time, header, origin):
    log = load(tmp_path, table(time=time, form="{:.16g}", header=f"{header},command.boom,angle.boom"))
    assert np.abs(log.time - TIME).max() < 3e-7  # float64 resolves 2.4e-7 s at 1.7e9 s
    assert log.origin == origin
    stated = f"{tmp_path / 'run.csv'}: the time stamps begin at 1700000000 s; time is counted from there."
    assert log.notes == ((stated,) if origin else ())


def test_dates_of_parquet_and_times_of_day(tmp_path):
    path = tmp_path / "run.parquet"
    stamps = np.datetime64("2024-05-01T12:00:00", "ns") + np.round(1e9 * TIME).astype("timedelta64[ns]")
    pq.write_table(pa.table({"time": stamps, "angle.boom": ANGLE}), path)
    assert np.allclose(load_log(path).time, TIME, atol=1e-12)
    log = load(tmp_path, table(time=[stamp.partition("T")[2] for stamp in ISO]))
    assert "is set back by 8.64e+04 s" in log.notes[0], "midnight"
    assert np.allclose(np.diff(log.time)[:49], 0.02) and np.diff(log.time)[49] == pytest.approx(2.0)


def test_a_date_that_is_not_the_time_is_refused(tmp_path):
    rows = "".join(f"{0.02 * k:.2f},{ISO[k]}\n" for k in range(20))
    message = refuse(tmp_path, "time,angle.boom\n" + rows)
    assert message == "FILE, column 'angle.boom': contains dates, not numbers: only time may be a date"


def test_a_clock_set_back_cuts_the_run(tmp_path):
    """Sorted rows would mix two moments: stamps are moved, no reading is."""
    time = np.where(np.arange(120) < 60, TIME, TIME - 0.1)
    log = load(tmp_path, table(time=time))
    assert log.notes == (
        f"{tmp_path / 'run.csv'}, column 'time', row 60 (line 62): the clock is set back by 0.1 s; the run is cut"
        " there, and the later rows follow after a pause of 2 s.",
    )
    assert np.array_equal(log["angle.boom"], ANGLE)
    assert np.allclose(log.time, np.where(np.arange(120) < 60, TIME, TIME + 1.98), atol=1e-12)
    parts, notes = merge_run(RunFiles("run", (log,)), ["boom"], ["angle.boom"])
    assert [rows.reading[:, 0].tolist() for rows in parts] == [ANGLE[:60].tolist(), ANGLE[60:].tolist()]
    assert notes == ("run: the time stamps have pauses of 2 s; the run was split there.",)


@pytest.mark.parametrize("shift", [-0.093, -0.1, -2.0, -EPOCH, EPOCH])
def test_a_clock_set_by_any_amount(tmp_path, shift):
    time = np.where(np.arange(120) < 60, TIME, TIME + shift) + max(0.0, -shift) * (abs(shift) == EPOCH)
    log = load(tmp_path, table(time=time, form="{:.16g}"))
    assert np.array_equal(log["angle.boom"], ANGLE), "the order of the file"
    assert np.abs(np.diff(log.time)[:59] - 0.02).max() < 5e-7
    assert 2.0 - 1e-6 <= np.diff(log.time)[59] <= 2.02 + 1e-6, "a whole number of steps, from 2 s on"
    assert f"is set {'back' if shift < 0 else 'forward'} by" in log.notes[0]


@pytest.mark.parametrize("order", [[*range(10), 11, 10, *range(12, 120)], [*range(119, -1, -1)]])
def test_rows_out_of_order_are_sorted(tmp_path, order):
    lines = table().splitlines()
    text = "\n".join([lines[0], *(lines[1 + k] for k in order)])
    log = load(tmp_path, text)
    assert np.array_equal(log.time, TIME) and np.array_equal(log["angle.boom"], ANGLE)
    assert log.notes[0].endswith(" rows are not in the order of time; they were sorted.")


def test_a_single_wrong_stamp_is_not_sorted_in(tmp_path):
    time = TIME.copy()
    time[70] = time[10] + 0.01
    log = load(tmp_path, table(time=time))
    assert np.array_equal(log["angle.boom"], ANGLE) and "row 70 (line 72): the clock is set back" in log.notes[0]


def test_rows_with_the_same_stamp_become_one(tmp_path):
    """As of ROS: messages of two topics with one stamp, each with its own columns, and repeated messages."""
    rows = "".join(f"{t:.2f},0.5,\n{t:.2f},,{a:.6f}\n{t:.2f},,{a:.6f}\n" for t, a in zip(TIME, ANGLE, strict=True))
    log = load(tmp_path, "time,command.boom,angle.boom\n" + rows)
    assert np.array_equal(log.time, TIME) and np.array_equal(log["angle.boom"], ANGLE)
    assert (log["command.boom"] == 0.5).all()
    assert log.notes == (
        f"{tmp_path / 'run.csv'}, column 'time', row 1 (line 3): 240 rows repeat the time stamp of the row before; of"
        " rows with the same stamp the last value of each column is used.",
    )


@pytest.mark.parametrize(
    ("time", "message"),
    [
        (np.floor(TIME), "FILE, column 'time', row 1 (line 3): 120 rows share 3 time stamps: the stamps are coarser"
         " than the rows. Log time with more digits"),
        (-(TIME // 0.1) + TIME % 0.1, "the clock is set back or forward 23 times"),
        (3e6 * (TIME // 0.1) + TIME % 0.1, "FILE, column 'time', row 5 (line 7): the clock is set back or forward 23"
         " times"),
        (1e3 * (EPOCH + TIME), "FILE, column 'time', row 1 (line 3): increases by 20 per row: looks like milliseconds"
         " or less, write seconds, or state the unit, as in 'time [ms]'"),
    ],
)  # fmt: skip
def test_stamps_that_are_refused(tmp_path, time, message):
    assert message in refuse(tmp_path, table(time=time, form="{:.16g}"))


def test_a_table_of_commands_is_not_repaired(tmp_path):
    time = np.where(np.arange(120) < 60, TIME, TIME - 0.1)
    assert "row 60 (line 62): goes back from 1.18 to 1.1 s" in refuse(tmp_path, table(time=time), complete=True)


def rig_csv(path, origin, columns="cpr", seconds=3.0):
    time = 0.01 * np.arange(round(100 * seconds))
    wave = np.sin(2.0 * np.pi * time)
    have = {"c": ("command.slide", 0.5 * wave), "p": ("position.slide", 0.25 + 0.1 * wave),
            "r": ("pressure_head.slide", 5e6 + 1e6 * wave)}  # fmt: skip
    names, values = zip(*(have[c] for c in columns), strict=True)
    np.savetxt(path, np.column_stack([origin + time, *values]), "%.16g", ",", comments="",
               header=",".join(["time", *names]))  # fmt: skip
    return path


def test_epoch_stamps_of_several_files_and_masks(tmp_path):
    """Files of one run keep their common clock; a mask has the stamps of the file."""
    rig_csv(tmp_path / "a.csv", EPOCH, "cp")
    rig_csv(tmp_path / "b.x.csv", EPOCH + 1.0, "c")
    rig_csv(tmp_path / "b.y.csv", EPOCH, "p")
    (tmp_path / "mask").mkdir()
    mask = tmp_path / "mask" / "mask.csv"
    mask.write_text(f"run,begin,end\na,{EPOCH + 1.0},{EPOCH + 1.1}\n")
    runs = read_runs([tmp_path], RIG, {}, False)
    assert [[log.time[0] for log in run.logs] for run in runs] == [[0.0], [1.0, 0.0]]
    data = load_dataset([tmp_path / "a.csv", rig_csv(tmp_path / "c.csv", 0.0, "cp")], RIG, mask=mask)
    assert np.flatnonzero(~data.fit[0].valid).tolist() == list(range(100, 110))
    rows = merge_run(runs[0], ["slide"], ["position.slide"], [MaskedInterval("a", EPOCH, EPOCH + 0.1)])[0][0]
    assert len(rows.command) == 300 and (~rows.valid).sum() == 10


def test_a_channel_that_is_dropped_is_listed_with_the_reason(tmp_path):
    """Pressures beyond the span of the sensor, a frozen and an empty column."""
    for name in "ab":
        path = rig_csv(tmp_path / f"{name}.csv", 0.0)
        lines = path.read_text().splitlines()
        path.write_text("\n".join([lines[0] + ",pressure_rod.slide", *(line + "," for line in lines[1:])]))
    sensors = RIG.sensors["laboratory"]
    small = sensors.pressure.model_copy(update={"bits": 12, "span": 2e6})
    machine = RIG.model_copy(update={"sensors": {"laboratory": sensors.model_copy(update={"pressure": small})}})
    data = load_dataset(tmp_path, machine)
    assert data.channels == ("position.slide",)
    assert data.unused_channels == (
        "pressure_rod.slide is not used in a, b: its column is empty.",
        "pressure_head.slide is not used: 100 % of its readings are at the limit of the sensor, which the machine file"
        " states as its span.",
    )
