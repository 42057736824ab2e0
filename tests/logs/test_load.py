"""Whole, damaged and unusable logs as data sets: what is mended, what is said, what is refused."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hydrotele.core.errors import InputError
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.logs.clock import estimate_clock_offset, fit_clock
from hydrotele.logs.dataset import Dataset, load_dataset, make_dataset
from hydrotele.logs.log import Log, load_log, save_log
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.log_channels import default_channel_unit
from hydrotele.machine.machine import IDEAL_SENSORS, reading_noise_rms
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.sensor_models import simulate_readings
from tests.measured import MEASURED, REAL, needs_real

CAT = load_machine("cat215")
SENSORS = CAT.sensors["khoshzaban1992"]
AXES = ("swing", "boom", "stick")
RUNS = ("fit_1", "fit_2", "test_1")


def made_up(seed: int = 0, seconds: float = 20.0, rate: float = 50.0, sensors=SENSORS) -> Log:
    """A run whose channels move as a machine's might, with the sensors' noise.

    There are no physics in it but the linkages; what is tested here asks for none.
    """
    random = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate

    def wave(middle, size):
        parts = (random.uniform(0.3, 1) * np.sin(w * time + random.uniform(0, 6))
                 for w in (0.4, 0.9, 1.7))  # fmt: skip
        return middle + size * sum(parts) / 3

    truth = {f"angle.{a}": wave(CAT.home[a], 0.25) for a in AXES}
    for axis in AXES[1:]:
        cylinder = CAT.axes[axis].cylinder
        length = axis_linkage(CAT, axis).length(truth[f"angle.{axis}"])
        truth[f"length.{axis}"] = length - cylinder.closed_length
    for axis in AXES:
        truth |= {f"pressure_{side}.{axis}": wave(8e6, 3e6) for side in ("head", "rod")}
    truth["pressure_supply"] = np.full_like(time, 28e6)
    columns = {f"command.{a}": np.rint(2048 * wave(0.0, 0.8)) / 2048 for a in AXES}
    columns |= simulate_readings(CAT, sensors, seed, truth)
    stated = {"machine": "cat215", "tool": "none", "sensors": "khoshzaban1992"}
    return Log(time, columns, {c: default_channel_unit(c) for c in columns}, stated, "made up")


def changed(log: Log, **channels) -> Log:
    """The log with channels replaced (`angle_boom=...`), or left away where None."""
    columns = dict(log.columns)
    for name, values in channels.items():
        kind, _, axis = name.rpartition("_")
        columns[f"{kind}.{axis}"] = values
    columns = {c: v for c, v in columns.items() if v is not None}
    return dataclasses.replace(log, columns=columns, units={c: log.units[c] for c in columns})


def rows(log: Log, keep) -> Log:
    """The log with some of its rows."""
    columns = {c: v[keep] for c, v in log.columns.items()}
    return dataclasses.replace(log, time=log.time[keep], columns=columns)


def write(folder: Path, logs: dict[str, Log]) -> Path:
    for name, log in logs.items():
        save_log(log, folder / f"{name}.parquet")
    return folder


def dataset(machine=CAT, **logs) -> Dataset:
    files = [RunFiles(name, log if isinstance(log, tuple) else (log,)) for name, log in
             sorted(logs.items())]  # fmt: skip
    return make_dataset(files, machine)


def runs_of(data: Dataset):
    return (*data.fit, data.heldout)


def column(data: Dataset, run: str, channel: str) -> np.ndarray:
    found = next(r for r in runs_of(data) if r.name == run)
    return found.reading[:, data.channels.index(channel)]


# Clean data


@pytest.mark.parametrize("case", [f"open_{k:02d}" for k in range(1, 11)])
def test_clean_measured_logs_pass_unchanged(case):
    data = load_dataset(MEASURED / case, CAT)
    assert data.notes == () and [r.name for r in data.fit] == ["fit_1", "fit_2", "fit_3"]
    assert data.heldout.name == "test_1" and data.axes == AXES and len(data.channels) == 12
    for run in runs_of(data):
        log = load_log(MEASURED / case / f"{run.name}.parquet")
        read = np.column_stack([log[c] for c in data.channels])
        command = np.column_stack([log[f"command.{a}"] for a in AXES])
        assert (run.start, run.period) == (0.0, 0.02) and run.command_known.all()
        assert np.array_equal(run.command, command)
        kept = np.isfinite(run.reading)
        assert np.array_equal(run.reading[kept], read[kept])
        # Only a starved chamber, whose pressure the converter cuts off at 0, is left out, and
        # with it what lies within its noise of 0: +-172 kPa twice and a step of 8 kPa.
        left_out = [data.channels[c] for c in np.flatnonzero(~kept.all(axis=0))]
        assert all(name.startswith("pressure_") for name in left_out)
        assert (read[~kept] < 353.2e3).all() and (~kept).mean() < 1e-3
        assert (read[kept] > 0.0).sum() == kept.sum() - (read[kept] <= 0.0).sum()
        assert not (read[:, 5:][kept[:, 5:]] == 0.0).any()


@pytest.mark.nightly
@pytest.mark.parametrize("draws", [10, pytest.param(100, marks=pytest.mark.nightly)])
def test_draws_of_noise_have_no_stuck_sensor(draws):
    truths = [load_log(MEASURED / "nominal_truth" / f"{run}.parquet").without_truth()
              for run in ("fit_1", "test_1")]  # fmt: skip
    for seed in range(draws):
        runs = {}
        for number, truth in enumerate(truths):
            true = {c: v for c, v in truth.columns.items() if not c.startswith("command")}
            read = simulate_readings(CAT, SENSORS, 2 * seed + number, true)
            log = changed(truth, **{c.replace(".", "_"): v for c, v in read.items() if "." in c})
            log.columns["pressure_supply"] = read["pressure_supply"]  # type: ignore[index]
            runs[f"run_{number}"] = dataclasses.replace(log, metadata={"sensors": "khoshzaban1992"})
        assert dataset(**runs).notes == ()


def test_true_values_have_unknown_noise_and_no_stuck_sensor():
    logs = {name: made_up(k, sensors=None) for k, name in enumerate(RUNS)}
    logs = {n: dataclasses.replace(v, metadata={"sensors": IDEAL_SENSORS}) for n, v in logs.items()}
    data = dataset(**logs)
    assert np.isnan(data.noise).all() and len(data.notes) == 1 and "noise" in data.notes[0]
    assert all(np.isfinite(run.reading).all() for run in runs_of(data))


def test_noise_is_that_of_the_sensors():
    data = dataset(a=made_up(1), b=made_up(2))
    assert data.noise == pytest.approx([reading_noise_rms(CAT, SENSORS, c) for c in data.channels])
    better = make_dataset([RunFiles("a", (made_up(1),)), RunFiles("b", (made_up(2),))], CAT,
                          "khoshzaban1992_improved")  # fmt: skip
    assert better.noise[-1] < 0.25 * data.noise[-1]


# Missing rows, other clocks


@given(
    seed=st.integers(0, 2**16),
    start=st.sampled_from([0.0, -3.0, 12.5, 1.7e9]),
    rate=st.sampled_from([20.0, 50.0, 60.0, 1000 / 7, 200.0]),
    dropped=st.floats(0.0, 0.05),
)
@settings(max_examples=25)
def test_rows_come_back_at_their_own_tick(seed, start, rate, dropped):
    log = made_up(seed % 7, 12.0, rate)
    keep = np.random.default_rng(seed).uniform(size=len(log)) >= dropped
    keep[[0, 1, -1]] = True
    damaged = dataclasses.replace(rows(log, keep), time=start + log.time[keep])
    run = dataset(a=damaged, b=made_up(8)).fit[0]
    assert run.period == pytest.approx(1 / rate, rel=1e-6) and len(run.reading) == len(log)
    # A float at 1.7e9 s resolves 0.24 us.
    assert run.start == pytest.approx(start, abs=1e-6)
    assert np.array_equal(run.command_known, keep)
    assert np.isnan(run.reading[~keep]).all()
    assert np.isfinite(run.reading[keep]).mean() > 0.999
    latest = np.maximum.accumulate(np.where(keep, np.arange(len(keep)), 0))
    commands = np.column_stack([log[f"command.{a}"] for a in AXES])
    assert np.array_equal(run.command, commands[latest])


def test_one_percent_dropped_rows(tmp_path):
    logs = {name: made_up(k) for k, name in enumerate(RUNS)}
    keep = np.random.default_rng(1).uniform(size=1000) >= 0.01
    data = load_dataset(write(tmp_path, logs | {"fit_2": rows(logs["fit_2"], keep)}), CAT)
    assert len(data.notes) == 1 and f"fit_2: {(~keep).sum()} rows" in data.notes[0]
    assert np.isfinite(data.fit[0].reading).all()
    assert np.isnan(data.fit[1].reading).all(axis=1).sum() == (~keep).sum()


def test_jittering_stamps_are_snapped_and_said():
    log = made_up(1)
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(log)) * 0.02
    data = dataset(a=dataclasses.replace(log, time=log.time + jitter), b=made_up(2))
    # Two hundred ticks of start-up settle the phase to a tenth of the jitter.
    assert data.fit[0].period == pytest.approx(0.02, rel=1e-4)
    assert np.array_equal(data.fit[0].reading, dataset(a=log, b=made_up(2)).fit[0].reading)
    assert len(data.notes) == 1 and "a jitter of 17 %" in data.notes[0]


def test_stamps_without_a_clock_are_refused():
    log = made_up(1)
    time = np.sort(np.random.default_rng(0).uniform(0, 20, len(log)))
    with pytest.raises(InputError, match="follow no clock.*fixed rate"):
        dataset(a=dataclasses.replace(log, time=time), b=made_up(2))


def test_clock_that_runs_fast_keeps_every_row():
    clock, notes = fit_clock(np.arange(5000) * 0.02 * (1 + 3e-4), "log")
    assert np.array_equal(clock.tick, np.arange(5000)) and notes == ()
    assert clock.period == pytest.approx(0.02 * (1 + 3e-4), rel=1e-9)


def test_long_pause_cuts_the_run():
    log = made_up(1, 40.0)
    damaged = rows(log, (log.time < 15) | (log.time >= 18))
    data = dataset(a=damaged, b=made_up(2))
    assert [r.name for r in data.fit] == ["a_part1", "a_part2"]
    assert data.fit[1].start == pytest.approx(18.0)
    assert "3.02 s" in data.notes[0] and "split" in data.notes[0]
    assert len(data.fit[0].log) + len(data.fit[1].log) == len(damaged)


def test_too_many_missing_rows_are_refused():
    log = made_up(1)
    keep = np.random.default_rng(0).uniform(size=len(log)) > 0.4
    keep[:3] = True
    with pytest.raises(InputError, match="log every row"):
        dataset(a=rows(log, keep), b=made_up(2))


def test_runs_of_different_rates():
    data = dataset(a=made_up(1, 20, 50), b=made_up(2, 20, 100), c=made_up(3, 20, 25))
    assert [r.period for r in runs_of(data)] == [0.02, 0.01, 0.04] and data.notes == ()


# Several files of one run, and their clocks


def parts_of(log: Log, shift: float = 0.0) -> tuple[Log, Log]:
    """Positions and pressures of a run in two files, the second with a shifted clock."""
    pressures = [c for c in log.columns if c.startswith("pressure")]
    first = changed(log, **{c.replace(".", "_"): None for c in pressures if "." in c})
    del first.columns["pressure_supply"], first.units["pressure_supply"]  # type: ignore[misc]
    kept = {c: v for c, v in log.columns.items() if c in pressures or c.startswith("command")}
    second = Log(log.time + shift, kept, {c: log.units[c] for c in kept}, log.metadata, "second")
    return first, second


@pytest.mark.parametrize("shift", [0.0, 3.0, -1.234, 100.007, 1e5])
def test_offset_between_files_with_the_same_rows_is_exact(tmp_path, shift):
    log = made_up(1)
    angles, pressures = parts_of(log, shift)
    write(tmp_path, {"a.angles": angles, "a.pressures": pressures, "b": made_up(2)})
    data = load_dataset(tmp_path, CAT)
    (run,) = data.fit
    assert run.name == "a" and run.period == pytest.approx(0.02)
    assert np.array_equal(run.reading, np.column_stack([log[c] for c in data.channels]))
    if shift:
        assert len(data.notes) == 1 and f"{-shift:+.6g} s" in data.notes[0]
    else:
        assert data.notes == ()


def test_offset_between_files_that_sampled_the_commands_apart():
    log = made_up(1)
    angles, pressures = parts_of(log, 7.0)
    later = pressures.time + 0.008
    columns = {c: np.interp(later, pressures.time, v) for c, v in pressures.columns.items()}
    other = Log(later, columns, pressures.units, {}, "other")
    (mine, _), (theirs, _) = fit_clock(angles.time, "a"), fit_clock(other.time, "b")
    names = [f"command.{a}" for a in AXES]
    found = estimate_clock_offset(mine, np.column_stack([angles[c] for c in names]),
                         theirs, np.column_stack([other[c] for c in names]))  # fmt: skip
    # The commands change slowly and are rounded to 1/2048: a tenth of a row is what they tell.
    assert found == pytest.approx(-7.0, abs=2e-3)
    data = dataset(a=(angles, other), b=made_up(2))
    (run,) = data.fit
    assert run.period < 0.02 and run.command_known.all()  # rows fall between rows
    pressure = run.reading[:, data.channels.index("pressure_supply")]
    assert np.isfinite(pressure).sum() == pytest.approx(len(log), abs=2)


def test_file_without_commands_is_believed_and_said():
    angles, pressures = parts_of(made_up(1), 0.5)
    for axis in AXES:
        pressures = changed(pressures, **{f"command_{axis}": None})
    data = dataset(a=(angles, pressures), b=made_up(2))
    assert len(data.notes) == 2 and "0 is assumed" in data.notes[0] and "delay" in data.notes[0]
    assert "25 rows" in data.notes[1]  # half a second in which only one file has rows
    assert np.isnan(column(data, "a", "pressure_supply")[:25]).all()


def test_file_of_another_rate_keeps_its_own_times():
    log = made_up(1, 20, 100)
    angles, pressures = parts_of(log)
    half = rows(angles, slice(None, None, 2))
    data = dataset(a=(half, pressures), b=made_up(2))
    assert data.fit[0].period == pytest.approx(0.01) and data.notes == ()
    assert np.array_equal(column(data, "a", "pressure_supply"), log["pressure_supply"])
    seen = column(data, "a", "angle.boom")
    assert np.array_equal(seen[::2], log["angle.boom"][::2]) and np.isnan(seen[1::2]).all()


def test_repeated_runs_of_one_name_are_not_one_run(tmp_path):
    logs = {n: dataclasses.replace(made_up(k), metadata={"run": "dig"})
            for k, n in enumerate(("x.1", "x.2", "y"))}  # fmt: skip
    data = load_dataset(write(tmp_path, logs), CAT)
    assert [r.name for r in runs_of(data)] == ["x.1", "x.2", "y"]


def test_files_joined_by_metadata(tmp_path):
    angles, pressures = (dataclasses.replace(p, metadata={"run": "a"}) for p in
                         parts_of(made_up(1)))  # fmt: skip
    data = load_dataset(write(tmp_path, {"p": angles, "q": pressures, "z": made_up(2)}), CAT)
    assert [r.name for r in runs_of(data)] == ["a", "z"] and len(data.channels) == 12


# Which run judges


def test_held_out_run(tmp_path):
    logs = {name: made_up(k) for k, name in enumerate(("a", "b", "test_1", "test_2"))}
    folder = write(tmp_path, logs)
    data = load_dataset(folder, CAT)
    assert data.heldout.name == "test_1" and [r.name for r in data.fit] == ["a", "b"]
    assert "test_2" in data.notes[0]
    assert load_dataset(folder, CAT, heldout="a").heldout.name == "a"
    named = [folder / f"{n}.parquet" for n in ("b", "a")]
    assert load_dataset(named, CAT).heldout.name == "b"
    with pytest.raises(InputError, match="does not exist; .*valid: a, b, test_1, test_2"):
        load_dataset(folder, CAT, heldout="c")


def test_a_pipe_is_no_data(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(InputError, match="neither a file nor a folder"):
        load_dataset([tmp_path / "pipe.csv"], CAT)


@given(seconds=st.floats(20.0, 90.0), start=st.sampled_from([0.0, 50.0]))
@settings(max_examples=15)
def test_single_run_is_split_without_overlap(seconds, start):
    log = made_up(1, seconds)
    log = dataclasses.replace(log, time=log.time + start)
    data = dataset(only=log)
    parts = runs_of(data)
    assert np.array_equal(np.concatenate([p.reading for p in parts]),
                          np.column_stack([log[c] for c in data.channels]))  # fmt: skip
    ends = [p.start + p.period * len(p.reading) for p in parts]
    assert [p.start for p in parts[1:]] == pytest.approx(ends[:-1])
    assert len(data.heldout.reading) == pytest.approx(0.25 * len(log), abs=1)
    assert len(data.fit) == min(3, max(1, int(0.75 * len(log) * 0.02 // 10)))
    assert sum(len(p.log) for p in parts) == len(log)


@pytest.mark.parametrize(
    ("logs", "message"),
    [
        ({"only": made_up(1, 3.0)}, "only run and 3 s long.*at least 4 s"),
        ({"only": made_up(1, 1.8, 1000.0)}, "only run and 1.8 s long.*at least 2 s"),
        ({"a": made_up(1), "b": made_up(2, 0.8)}, r"0.8 s long \(40 rows\); 0.5 s and 50 rows"),
        ({"a": made_up(1), "b": made_up(2, 0.4, 1000.0)}, "0.4 s long .400 rows.; 0.5 s and"),
    ],
)
def test_too_short_runs_are_refused(logs, message):
    with pytest.raises(InputError, match=message):
        dataset(**logs)


# Sensors that lie


def test_missing_rod_pressures_are_no_channels():
    without = {f"pressure_rod_{a}": None for a in AXES}
    data = dataset(a=changed(made_up(1), **without), b=changed(made_up(2), **without))
    assert len(data.channels) == 9 and data.notes == ()
    half = dataset(a=made_up(1), b=changed(made_up(2), **without))
    assert len(half.channels) == 12 and half.notes == ()
    assert np.isnan(column(half, "b", "pressure_rod.boom")).all()


@pytest.mark.parametrize("channel", ["angle_boom", "length_stick", "pressure_head_swing", "pressure_rod_boom"])
def test_stuck_sensor_is_found_by_its_noise(channel):
    log = made_up(1)
    kind, _, axis = channel.rpartition("_")
    name = f"{kind}.{axis}"
    stuck = log[name].copy()
    stuck[400:600] = stuck[400]
    data = dataset(a=changed(log, **{channel: stuck}), b=made_up(2))
    gone = np.isnan(column(data, "a", name))
    # A genuine reading beside the freeze may happen to be equal to it.
    assert gone[400:600].all() and gone.sum() <= 202
    assert np.isfinite(np.delete(data.fit[0].reading, data.channels.index(name), axis=1)).all()
    assert len(data.notes) == 1
    assert data.notes[0].startswith(f"a: {name} is frozen") and "8 to 12 s" in data.notes[0]


@pytest.mark.parametrize("channel", ["angle_swing", "pressure_rod_stick"])
def test_sensor_stuck_for_ever_is_dropped(channel):
    kind, _, axis = channel.rpartition("_")
    logs = {n: changed(log, **{channel: np.full(len(log), log[f"{kind}.{axis}"][0])})
            for n, log in (("a", made_up(1)), ("b", made_up(2)))}  # fmt: skip
    data = dataset(**logs)
    assert f"{kind}.{axis}" not in data.channels and len(data.channels) == len(data.noise) == 11
    assert any("removed" in note and f"{kind}.{axis}" in note for note in data.notes)


def quiet(seed: int, moves: bool = True) -> Log:
    """A log of sensors without noise but a step, at rest for the second half."""
    log = made_up(seed, sensors=None)
    columns = {
        c: np.rint(v / 1e-4) * 1e-4 if c.startswith(("angle", "length")) else v.copy() for c, v in log.columns.items()
    }
    for values in columns.values():
        values[500:] = values[500]
    return dataclasses.replace(log, columns=columns, metadata={"sensors": IDEAL_SENSORS})


def test_quiet_sensors_may_rest():
    data = dataset(a=quiet(1), b=quiet(2))
    assert all(np.isfinite(run.reading).all() for run in runs_of(data))


def test_quiet_stuck_sensor_is_found_by_the_other_sensor_of_its_axis():
    log = quiet(1)
    stuck = log["angle.boom"].copy()
    stuck[200:400] = stuck[200]
    data = dataset(a=changed(log, angle_boom=stuck), b=quiet(2))
    gone = np.isnan(column(data, "a", "angle.boom"))
    assert gone[200:400].all() and gone.sum() < 205 and np.isfinite(
        column(data, "a", "length.boom")).all()  # fmt: skip


def test_quieter_sensors_than_stated_may_rest():
    # Real transducers are often ten times better than their data sheet, and repeat at rest.
    logs = {"a": quiet(1), "b": quiet(2)}
    logs = {n: dataclasses.replace(v, metadata={"sensors": "khoshzaban1992"})
            for n, v in logs.items()}  # fmt: skip
    assert not [note for note in dataset(**logs).notes if "frozen" in note]


def test_rows_written_twice_count_as_missing():
    log = made_up(1)
    twice = np.array([100, 345, 346, 800])
    columns = {c: v.copy() for c, v in log.columns.items()}
    for values in columns.values():
        for row in twice:
            values[row] = values[row - 1]
    data = dataset(a=dataclasses.replace(log, columns=columns), b=made_up(2))
    assert np.array_equal(np.flatnonzero(np.isnan(data.fit[0].reading).all(axis=1)), twice)
    assert np.array_equal(np.flatnonzero(~data.fit[0].command_known), twice)
    assert "4 rows are duplicates" in data.notes[0]


def test_sensor_at_its_end_is_left_out():
    log = made_up(1)
    pressure = log["pressure_head.boom"].copy()
    true = np.where(np.arange(1000) // 100 == 3, 0.0, 5e6)  # two seconds at exactly 0
    noise = np.random.default_rng(0).uniform(-172e3, 172e3, 1000)
    pressure = np.clip(np.rint((true + noise) / 8416.5) * 8416.5, 0.0, None)
    data = dataset(a=changed(log, pressure_head_boom=pressure), b=made_up(2))
    gone = np.isnan(column(data, "a", "pressure_head.boom"))
    # What the noise pushed inwards goes too, or the mean of the rest would be 86 kPa off; at the
    # edges of the stretch one or two readings may have no cut one within 5 rows.
    assert gone[302:398].all() and not gone[:298].any() and not gone[402:].any()
    assert "limit of the sensor" in data.notes[0]


def test_spikes_are_left_out_and_jumps_stay():
    log = made_up(1)
    angle, pressure = log["angle.stick"].copy(), log["pressure_rod.boom"].copy()
    angle[[50, 700]] += [1.2, -0.6]
    angle[900:] += 0.05  # a tooth skipped stays
    pressure[300] = 3e9
    pressure[500:501] += 10e6  # a water hammer stays
    data = dataset(a=changed(log, angle_stick=angle, pressure_rod_boom=pressure), b=made_up(2))
    assert np.flatnonzero(np.isnan(column(data, "a", "angle.stick"))).tolist() == [50, 700]
    assert np.flatnonzero(np.isnan(column(data, "a", "pressure_rod.boom"))).tolist() == [300]
    assert len(data.notes) == 2


def test_infinite_and_missing_readings_in_memory():
    log = made_up(1)
    angle = log["angle.boom"].copy()
    angle[10:13], angle[20] = np.nan, np.inf
    data = dataset(a=changed(log, angle_boom=angle), b=made_up(2))
    assert np.flatnonzero(np.isnan(column(data, "a", "angle.boom"))).tolist() == [10, 11, 12, 20]
    assert "3 of angle.boom are NaN" in data.notes[0] and "1 infinite" in data.notes[1]


def test_a_run_at_rest_is_said():
    log = made_up(1)
    still = {c.replace(".", "_"): np.full(len(log), np.median(log[c]))
             + reading_noise_rms(CAT, SENSORS, c) * np.random.default_rng(k).uniform(-1.7, 1.7, len(log))
             for k, c in enumerate(log.columns) if c.startswith(("angle", "length"))}  # fmt: skip
    data = dataset(a=changed(log, **still), b=made_up(2))
    assert data.notes == ("a: nothing moves; friction, inertia and delays are not identifiable.",)


# What is refused, and how


def csv(log: Log, path: Path, spoil=lambda text: text) -> Path:
    names = ["time", *log.columns]
    table = np.column_stack([log[name] for name in names])
    lines = [",".join(names), *(",".join(f"{v:.9g}" for v in row) for row in table)]
    path.write_text(spoil("\n".join(lines) + "\n"))
    return path


def test_cells_without_a_number_count_as_missing_and_are_said(tmp_path):
    log = made_up(1)
    angle, command = log["angle.boom"].copy(), log["command.stick"].copy()
    angle[7:9], command[20] = np.nan, np.nan
    damaged = changed(log, angle_boom=angle, command_stick=command)
    for spoil in (lambda text: text, lambda text: text.replace("nan", "")):
        path = csv(damaged, tmp_path / "a.csv", spoil)
        data = load_dataset([path, write(tmp_path, {"b": made_up(2)}) / "b.parquet"], CAT)
        run = data.fit[0]
        assert np.flatnonzero(np.isnan(column(data, "a", "angle.boom"))).tolist() == [7, 8]
        assert np.flatnonzero(~run.command_known).tolist() == [20]
        assert run.command[20, 2] == run.command[19, 2]
        assert "1 of command.stick, 2 of angle.boom are NaN or empty" in data.notes[0]


def test_nan_in_the_time_is_refused_with_its_line(tmp_path):
    log = made_up(1)

    def spoil(text):
        lines = text.split("\n")
        lines[8] = "," + lines[8].partition(",")[2]
        return "\n".join(lines)

    path = csv(log, tmp_path / "a.csv", spoil)
    with pytest.raises(InputError) as caught:
        load_dataset(path, CAT)
    for word in (str(path), "'time'", "row 7", "line 9", "remove the row or enter a value"):
        assert word in str(caught.value)


def test_csv_and_parquet_are_the_same(tmp_path):
    path = csv(made_up(1), tmp_path / "a.csv")
    save_log(made_up(2), tmp_path / "b.parquet")
    data = load_dataset([path, tmp_path / "b.parquet"], CAT, "khoshzaban1992")
    assert data.notes == () and data.fit[0].reading == pytest.approx(
        dataset(a=made_up(1), b=made_up(2)).fit[0].reading, rel=1e-8)  # fmt: skip


@pytest.mark.parametrize(
    ("channel", "factor", "words"),
    [
        ("angle_boom", 180 / np.pi, ("angle.boom", "degrees")),
        ("length_stick", 1e3, ("length.stick", "millimetres")),
        ("pressure_head_boom", 1e-5, ("pressure_head.boom", "bar")),
        ("command_boom", 100.0, ("command.boom", "percent")),
    ],
)
def test_wrong_units_name_file_channel_and_cure(tmp_path, channel, factor, words):
    kind, _, axis = channel.rpartition("_")
    wrong = changed(made_up(1), **{channel: made_up(1)[f"{kind}.{axis}"] * factor})
    path = csv(wrong, tmp_path / "a.csv")
    with pytest.raises(InputError) as caught:
        load_dataset(path, CAT)
    assert all(word in str(caught.value) for word in (str(path), *words))


def test_degrees_that_are_stated_as_radians_are_seen_by_the_joint_range(tmp_path):
    log = made_up(1)
    wrong = changed(log, angle_boom=np.degrees(log["angle.boom"]))
    write(tmp_path, {"a": wrong, "b": made_up(2)})
    with pytest.raises(InputError, match=r"a\.parquet, column 'angle.boom'.*degrees, convert"):
        load_dataset(tmp_path, CAT)


def test_missing_command_teaches(tmp_path):
    write(tmp_path, {"a": changed(made_up(1), command_boom=None), "b": made_up(2)})
    with pytest.raises(InputError, match=r"a\.parquet: needs the column command\.boom.*use 0 in all rows"):
        load_dataset(tmp_path, CAT)


def test_other_machine_and_tool_are_refused_unless_forced(tmp_path):
    for key, value in (("machine", "cat325"), ("tool", "bucket")):
        log = made_up(1)
        wrong = dataclasses.replace(log, metadata={**log.metadata, key: value})
        write(tmp_path, {"a": wrong, "b": made_up(2)})
        with pytest.raises(InputError, match=value):
            load_dataset(tmp_path, CAT)
        assert load_dataset(tmp_path, CAT, force=True).notes == ()


def test_unknown_channels_are_said_and_empty_folders_refused(tmp_path):
    with pytest.raises(InputError, match="contains no log"):
        load_dataset(tmp_path, CAT)
    log = made_up(1)
    extra = Log(log.time, {**log.columns, "angle.bom": log["angle.boom"]},
                {**log.units, "angle.bom": "rad"}, log.metadata)  # fmt: skip
    data = dataset(a=extra, b=made_up(2))
    assert len(data.notes) == 1 and "did you mean 'angle.boom'" in data.notes[0]


def test_run_folders_are_read_and_truth_is_not(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        save_log(made_up(len(name) + ord(name[0])), tmp_path / name / "measured.parquet")
        (tmp_path / name / "truth.parquet").write_bytes(b"never opened")
    data = load_dataset([tmp_path / "one", tmp_path / "two"], CAT)
    assert [r.name for r in runs_of(data)] == ["one", "two"]
    assert [r.name for r in runs_of(load_dataset(tmp_path, CAT))] == ["one", "two"]


def test_truth_is_stripped():
    data = load_dataset(MEASURED / "nominal_truth", CAT)
    for run in runs_of(data):
        assert not [c for c in run.log.columns if c.startswith("truth.")]
        assert "initial_state" not in run.log.metadata


# Real machines


@needs_real
def test_emps():
    data = load_dataset(REAL / "emps" / "main.parquet", load_machine("emps"))
    assert data.channels == ("position.slide",) and data.axes == ("slide",)
    assert [len(r.reading) for r in runs_of(data)] == [18631, 6210]
    assert all(r.period == 1e-3 and np.isfinite(r.reading).all() for r in runs_of(data))
    assert np.isnan(data.noise).all() and data.notes == ()


@needs_real
def test_ec20():
    data = load_dataset(REAL / "volvo_ec20", load_machine("ec20"))
    assert data.channels == ("angle.boom", "angle.stick") and len(data.fit) == 3
    log = load_log(REAL / "volvo_ec20" / "long.parquet")
    commands = np.concatenate([r.command for r in runs_of(data)])
    assert np.array_equal(commands[:, 0], -log["command.boom"])  # the joystick's other way round
    # A converter's step without an accuracy is no floor of the noise.
    assert np.isnan(data.noise).all() and len(data.notes) == 2
    # The record is resampled to 50 Hz, its angles change every second or third row only: 20 Hz.
    assert all("is updated only every 49.9 ms" in note for note in data.notes)
    read = np.concatenate([np.isfinite(r.reading) for r in runs_of(data)])
    assert read.mean(axis=0) == pytest.approx([0.4, 0.4], abs=0.002)
