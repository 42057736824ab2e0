"""Logs short and long, slow and fast, masked and wandering; commands in any unit; accuracies."""

import dataclasses

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.logs.clock import fit_clock
from hydrotele.logs.dataset import Dataset, load_dataset, make_dataset
from hydrotele.logs.faulty_readings import find_readings_without_update, readings_per_update
from hydrotele.logs.log import Log, save_log
from hydrotele.logs.masked_intervals import MaskedInterval, read_mask
from hydrotele.logs.resampling import RunRows, average_rows
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.machine.sensors import Sensor, SensorSet

RIG = load_machine("rig")
STATED = {"machine": "rig", "sensors": "laboratory"}


def stroke(seconds=4.0, rate=100.0, seed=0, sensors=True) -> Log:
    """A rig that goes to and fro once a second; no physics in it."""
    time, random = np.arange(round(seconds * rate)) / rate, np.random.default_rng(seed)
    wave = np.sin(2.0 * np.pi * time + 0.3 * seed)
    columns = {
        "command.slide": 0.5 * np.cos(2.0 * np.pi * time + 0.3 * seed),
        "position.slide": 0.25 + 0.1 * wave + 5e-5 * random.uniform(-1, 1, len(time)),
        "pressure_head.slide": 5e6 + 1e6 * wave + 5e4 * random.uniform(-1, 1, len(time)),
    }
    units = {"command.slide": "1", "position.slide": "m", "pressure_head.slide": "Pa"}
    return Log(time, columns, units, STATED if sensors else {"machine": "rig"}, f"stroke {seed}")


def dataset(*logs: Log, machine=RIG, masks=()) -> Dataset:
    files = [RunFiles(name, (log,)) for name, log in zip("abcdef", logs, strict=False)]
    return make_dataset(files, machine, masks=masks)


def with_column(log: Log, name: str, values, unit="1") -> Log:
    return dataclasses.replace(log, columns={**log.columns, name: values}, units={**log.units, name: unit})


def csv(path, header, rows):
    path.write_text("\n".join([header, *(",".join(f"{v:.9g}" for v in row) for row in rows)]))
    return path


# Lengths and rates


@pytest.mark.parametrize(("seconds", "rate"), [(0.5, 1000.0), (0.6, 200.0), (5.0, 10.0)])
def test_a_stroke_is_a_run(seconds, rate):
    data = dataset(stroke(seconds, rate, 1), stroke(seconds, rate, 2))
    assert [len(r.reading) for r in (*data.fit, data.heldout)] == [round(seconds * rate)] * 2
    assert ("to within one row only" in " ".join(data.notes)) == (rate == 10.0)


def test_a_single_run_of_four_strokes_is_split():
    data = dataset(stroke(4.0, 100.0))
    assert [r.name for r in data.fit] == ["a_1"] and data.heldout.name == "a_heldout"
    assert [len(r.reading) for r in (*data.fit, data.heldout)] == [300, 100]


def test_one_row_and_constant_channels():
    log = stroke()
    flat = {c: np.full(len(log), v[0]) for c, v in log.columns.items()}
    still = dataclasses.replace(log, columns=flat)
    data = dataset(still, stroke(seed=1))
    assert any("a: nothing moves" in note or "frozen" in note for note in data.notes)
    one = dataclasses.replace(log, time=log.time[:2], columns={c: v[:2] for c, v in log.columns.items()})
    with pytest.raises(InputError, match="2 rows.*record a longer run, or remove this one"):
        dataset(one, log)


def test_ten_kilohertz_is_averaged_without_shift_and_said():
    """Readings of a straight motion stay on it: 1 kHz rows at their own times, noise / sqrt(10)."""
    log = stroke(3.0, 10_000.0)
    ramp = 0.1 + 0.05 * log.time
    noise = np.random.default_rng(0).normal(0.0, 1e-4, len(log))
    log = with_column(log, "position.slide", ramp + noise, "m")
    data = dataset(log, stroke(3.0, 100.0, 1))
    (run,), spot = data.fit, data.channels.index("position.slide")
    assert (run.period, len(run.reading)) == (1e-3, 3000)
    error = run.reading[1:-1, spot] - (0.1 + 0.05 * 1e-3 * np.arange(1, 2999))
    assert abs(error.mean()) < 4 * 1e-4 / 30_000**0.5  # a row's shift would be 5e-5, 20 times this
    assert error.std() == pytest.approx(1e-4 / 10**0.5, rel=0.06)  # 2998 samples, adjacent share 1
    wanted = log["command.slide"].reshape(3000, 10).mean(axis=1)
    np.testing.assert_allclose(run.command[:, 0], wanted, atol=1e-15)
    assert "10 rows each were averaged, giving 1000 Hz" in " ".join(data.notes)
    assert data.noise_of(run) == pytest.approx(data.noise / 10**0.5, rel=0.03)
    assert np.array_equal(data.noise_of(data.heldout), data.noise)
    assert len(run.log) == 3000 and np.array_equal(run.log["position.slide"], run.reading[:, spot])


def test_averaging_damps_what_would_alias():
    """4.9 kHz, bare decimation shows it whole at 100 Hz; a mean over a row leaves 3 %."""
    time = np.arange(20_000) / 10_000.0
    ripple = np.sin(2 * np.pi * 4900.0 * time)[:, None]
    n = len(time)
    rows = RunRows(0.0, 1e-4, np.zeros((n, 1)), np.ones(n, bool), ripple, np.ones(n, bool))
    slow, behind, count = average_rows(rows)
    assert count == 10 and behind[0] == pytest.approx(10.0, rel=0.1)
    assert np.abs(slow.reading[1:-1]).max() < 0.03 < np.abs(ripple[::10]).max()


@pytest.mark.parametrize(("rate", "count"), [(1000.0, 1), (1040.0, 1), (2000.0, 2), (5000.0, 5)])
def test_rates_about_one_kilohertz(rate, count):
    run = dataset(stroke(2.0, rate), stroke(2.0, 50.0, 1)).fit[0]
    assert run.period == pytest.approx(count / rate, rel=1e-6)
    assert (run.readings_per_mean is None) == (count == 1)


@pytest.mark.parametrize(("rate", "held"), [(1000.0, 20), (10_000.0, 10), (100.0, 25)])
def test_a_channel_that_is_refreshed_slowly_counts_once(rate, held):
    """Positions at every row, pressures from a bus; nothing is refreshed but its own rows."""
    log = stroke(12.0, rate)
    place = np.arange(len(log)) // held * held
    slow = with_column(log, "pressure_head.slide", log["pressure_head.slide"][place], "Pa")
    data = dataset(slow, stroke(seed=1))
    run, spot = data.fit[0], data.channels.index("pressure_head.slide")
    read = np.isfinite(run.reading[:, spot]).sum()
    assert read == pytest.approx(len(log) / held, rel=0.01)
    assert np.isfinite(run.reading[:, 1 - spot]).all()
    assert f"updated only every {1e3 * held / rate:.3g} ms" in " ".join(data.notes)
    assert "frozen" not in " ".join(data.notes)
    assert data.noise_of(run)[spot] == pytest.approx(data.noise[spot])


def test_a_clock_that_runs_apart_refreshes_after_two_or_three_rows():
    """20 Hz in a log of 50 Hz; at rest the same value is refreshed as often."""
    value = np.random.default_rng(0).normal(size=400)
    value[200:300] = value[200]
    held = value[(np.arange(1000) * 0.4 + 0.1).astype(int)]
    every = readings_per_update(held)
    assert every == pytest.approx(2.5, abs=0.02)
    fresh = ~find_readings_without_update(held, every)
    assert fresh.sum() == pytest.approx(400, abs=2)
    assert np.array_equal(fresh[1:500], np.diff(held[:500]) != 0.0)
    assert fresh[500:750].sum() == pytest.approx(100, abs=2)


def test_a_quiet_coarse_sensor_is_not_taken_for_a_slow_one():
    """Without noise it repeats between the steps of its converter, as long as the speed has it."""
    for rate in (100.0, 1000.0):
        log = stroke(8.0, rate, sensors=False)
        coarse = np.rint((0.25 + 0.1 * np.sin(2 * np.pi * log.time)) / 5e-3) * 5e-3
        data = dataset(with_column(log, "position.slide", coarse, "m"), stroke(seed=1))
        assert "updated" not in " ".join(data.notes)


def test_a_log_without_any_reading_is_refused():
    log = stroke()
    empty = dataclasses.replace(log, columns={
        c: v if c.startswith("command") else np.full(len(log), np.nan)
        for c, v in log.columns.items()})  # fmt: skip
    with pytest.raises(InputError, match="no channel has a usable reading"):
        dataset(empty, empty)


# Masks


def test_a_short_mask_takes_readings_out_and_a_long_one_cuts():
    log = stroke(6.0)
    valid = np.ones(len(log))
    valid[100:110], valid[300:380] = 0.0, 0.0
    data = dataset(with_column(log, "valid", valid), stroke(6.0, seed=1))
    first, second = data.fit
    assert (first.name, second.name) == ("a_part1", "a_part2")
    assert (len(first.reading), len(second.reading)) == (300, 220)
    assert second.start == pytest.approx(3.8)
    assert np.isnan(first.reading[100:110]).all() and np.isfinite(first.reading[:100]).all()
    assert np.array_equal(first.valid, valid[:300] == 1.0)
    assert not first.command_known[100:110].any() and second.command_known.all()
    assert np.array_equal(first.command[:, 0], log["command.slide"][:300]), "commands are known"
    assert np.isnan(first.log["position.slide"][100:110]).all()
    assert "a: 0.9 s are masked" in " ".join(data.notes)
    assert data.heldout.valid.all() and data.heldout.log is not None


def test_a_part_of_a_run():
    run = dataset(with_column(stroke(), "valid", np.ones(400)), stroke(seed=1)).fit[0]
    part = run.select_rows(100, 150)
    assert part.start == pytest.approx(1.0) and len(part.valid) == len(part.command) == 50
    assert np.array_equal(part.reading, run.reading[100:150])


def test_a_column_mask_is_the_other_way_round(tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    log, mask = stroke(3.0), np.zeros(300, bool)
    mask[50:60] = True
    table = pa.table({"time": log.time, **log.columns, "mask": mask})
    pq.write_table(table, tmp_path / "a.parquet")
    save_log(stroke(3.0, seed=1), tmp_path / "b.parquet")
    run = load_dataset(tmp_path, RIG).fit[0]
    assert np.array_equal(run.valid, ~mask)


def test_a_mask_file(tmp_path):
    for seed, name in enumerate("ab"):
        save_log(stroke(5.0, seed=seed), tmp_path / f"{name}.parquet")
    mask = tmp_path / "mask.csv"
    mask.write_text("# bucket in the soil\nrun,begin,end\na,1.0,1.1\n,4.5,\n")
    assert read_mask(mask) == (MaskedInterval("a", 1.0, 1.1), MaskedInterval("", 4.5, np.inf))
    data = load_dataset(
        [tmp_path / "a.parquet", tmp_path / "b.parquet"], RIG, mask=mask
    )  # fmt: skip
    assert np.flatnonzero(~data.fit[0].valid).tolist() == list(range(100, 110))
    assert [len(r.reading) for r in (*data.fit, data.heldout)] == [450, 450]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,1,2\n", "must be the header run,begin,end"),
        ("run,begin,end\n", "has no interval"),
        ("run,begin,end\na,1\n", "mask.csv:2.*is 'a,1': write run,begin,end"),
        ("run,begin,end\na,2,1\n", "ends at 1 s, before its start"),
        ("run,begin,end\nc,1,2\n", "mask of run 'c'.*valid: a, b"),
        (
            "run,begin,end\n,,9e9\n",
            "no run has 0.5 s and 50 rows without a gap or a masked interval",
        ),
    ],
)
def test_masks_that_are_refused(tmp_path, text, message):
    for seed, name in enumerate("ab"):
        save_log(stroke(seed=seed), tmp_path / f"{name}.parquet")
    (tmp_path / "mask.csv").write_text(text)
    logs = [tmp_path / "a.parquet", tmp_path / "b.parquet"]
    with pytest.raises(InputError, match=message):
        load_dataset(logs, RIG, mask=tmp_path / "mask.csv")


def test_a_valid_column_that_is_none(tmp_path):
    log = with_column(stroke(), "valid", np.full(400, 2.0))
    save_log(log, tmp_path / "a.parquet")
    with pytest.raises(InputError, match="'valid', row 0.*write 1 for usable rows"):
        load_dataset(tmp_path, RIG)


# Clocks


def test_rows_that_wander_off_any_clock_stand_at_their_own_times():
    """A loop that sleeps 10 ms and works a little: its steps add up to no common clock."""
    step = 0.01 + np.random.default_rng(0).uniform(0.0, 0.001, 3000)
    step[1500] += 0.05  # and five rows are lost
    time = np.cumsum(step)
    clock, notes = fit_clock(time, "a log")
    stand = clock.start + clock.period * clock.tick
    assert len(clock.row) == 3000 and np.abs(stand - time).max() <= 0.1 * 0.0106
    assert len(notes) == 1 and "have no common clock" in notes[0]
    base = stroke(30.0)
    columns = {c: np.interp(time, base.time, v) for c, v in base.columns.items()}
    data = dataset(dataclasses.replace(base, time=time[:2800], columns={
        c: v[:2800] for c, v in columns.items()}), stroke(seed=1))  # fmt: skip
    run = data.fit[0]
    read = np.isfinite(run.reading).any(axis=1)
    assert read.sum() == 2800 and (~run.command_known).mean() < 0.01
    wanted = np.interp(run.start + run.period * np.flatnonzero(read), time, columns["position.slide"])
    error = run.reading[read, data.channels.index("position.slide")] - wanted
    # a tenth of a step at 0.63 m/s is 0.66 mm at most, 0.37 mm RMS; half a step would be 3 mm
    assert np.abs(error).max() < 0.9e-3


def test_a_log_of_two_rates_keeps_its_times():
    time = np.concatenate([np.arange(2000) * 0.013, 26.0 + np.arange(1000) * 0.01])
    clock, notes = fit_clock(time, "a log")
    assert len(clock.row) == 3000 and "have no common clock" in notes[0]
    assert np.abs(clock.start + clock.period * clock.tick - time).max() <= 0.1 * 0.013


def test_the_piece_that_judges_is_no_scrap():
    log = stroke(20.0)
    valid = np.ones(len(log))
    valid[700:760], valid[1300:1360], valid[1900:1930] = 0.0, 0.0, 0.0
    data = dataset(with_column(log, "valid", valid))
    assert data.heldout.name == "a_part3" and len(data.heldout.reading) == 540
    assert [r.name for r in data.fit] == ["a_part1", "a_part2", "a_part4"]


# Commands in the unit of the log


def ranged(unit, low, high):
    axis = RIG.axes["slide"].model_copy(update={"command_unit": unit, "command_range": (low, high)})
    return type(RIG).model_validate(
        RIG.model_copy(update={"axes": {"slide": axis}}).model_dump()
    )  # fmt: skip


def written(tmp_path, factor, offset, header="command.slide"):
    for seed, name in enumerate("ab"):
        log = stroke(seed=seed)
        values = {**log.columns, "command.slide": factor * log["command.slide"] + offset}
        names = ["time", *(header if c == "command.slide" else c for c in values)]
        csv(tmp_path / f"{name}.csv", ",".join(names), np.column_stack([log.time, *values.values()]))
    return tmp_path


@pytest.mark.parametrize(
    ("unit", "low", "high", "header", "factor", "offset"),
    [
        ("V", -10.0, 10.0, "command.slide", 10.0, 0.0),
        ("V", -10.0, 10.0, "command.slide [V]", 10.0, 0.0),
        ("V", -10.0, 10.0, "command.slide [mV]", 10_000.0, 0.0),
        ("V", 10.0, -10.0, "command.slide", -10.0, 0.0),
        ("mA", 4.0, 20.0, "command.slide", 8.0, 12.0),
        ("mA", 4.0, 20.0, "command.slide [mA]", 8.0, 12.0),
        ("%", -100.0, 100.0, "command.slide", 100.0, 0.0),
        ("counts", 0.0, 4095.0, "command.slide", 2047.5, 2047.5),
        ("V", -10.0, 10.0, "command.slide [%]", 100.0, 0.0),
        ("1", -1.0, 1.0, "command.slide [%]", 100.0, 0.0),
    ],
)
def test_commands_in_any_unit(tmp_path, unit, low, high, header, factor, offset):
    data = load_dataset(written(tmp_path, factor, offset, header), ranged(unit, low, high))
    np.testing.assert_allclose(data.fit[0].command[:, 0], stroke()["command.slide"], atol=1e-8)
    assert not [note for note in data.notes if "command" in note]


def test_a_log_of_hydrotele_has_fractions_already(tmp_path):
    for seed, name in enumerate("ab"):
        log = stroke(seed=seed)
        save_log(dataclasses.replace(log, metadata={**log.metadata, "hydrotele": "1"}),
                 tmp_path / f"{name}.parquet")  # fmt: skip
    run = load_dataset(tmp_path, ranged("V", -10.0, 10.0)).fit[0]
    assert np.array_equal(run.command[:, 0], stroke()["command.slide"])


@pytest.mark.parametrize(
    ("machine", "header", "message"),
    [
        (RIG, "command.slide", r"percent, counts or volts.*command_range: \[-10, 10\]"),
        (
            RIG,
            "command.slide [V]",
            "is in 'V', the drive needs '1'.*command_unit and command_range",
        ),
        (ranged("V", -4.0, 4.0), "command.slide", r"is 5 V, beyond .*command_range -4 \.\. 4 V"),
        (ranged("mA", -20.0, 20.0), "command.slide [V]", "is in 'V'.* in 'mA': correct axes.slide"),
    ],
)
def test_commands_that_are_refused(tmp_path, machine, header, message):
    with pytest.raises(InputError, match=message):
        load_dataset(written(tmp_path, 10.0, 0.0, header), machine)


def test_ranges_stand_in_the_machine_file(tmp_path):
    save_machine(ranged("mA", 4.0, 20.0), tmp_path / "machine.yaml")
    axis = load_machine(tmp_path / "machine.yaml").axes["slide"]
    assert (axis.command_unit, axis.command_range) == ("mA", (4.0, 20.0))
    for update, message in (
        ({"command_range": (3.0, 3.0)}, r"must be \[low, high\]"),
        ({"command_unit": "V"}, "needs the command_range"),
    ):
        facts = RIG.axes["slide"].model_dump() | update
        with pytest.raises(ValueError, match=message):
            type(RIG.axes["slide"]).model_validate(facts)


def test_columns_that_are_no_channels_can_be_left_out(tmp_path):
    for seed, name in enumerate("ab"):
        log = stroke(seed=seed)
        table = np.column_stack([log.time, *log.columns.values(), log.time])
        csv(tmp_path / f"{name}.csv", ",".join(["time", *log.columns, "Marker 1"]), table)
    with pytest.raises(InputError, match="Marker 1.*none skips a column"):
        load_dataset(tmp_path, RIG)
    data = load_dataset(tmp_path, RIG.model_copy(update={"log_columns": {"Marker 1": "none"}}))
    assert len(data.channels) == 2 and data.notes == ()


# Stated accuracies


def test_accuracies_per_channel():
    """A channel's own entry counts; what nobody states is NaN for that channel alone."""
    own = SensorSet(
        rate=1000, position=Sensor(standard_deviation=2e-5), pressure=Sensor(accuracy=5e4),
        channels={"pressure_head.slide": Sensor()},
    )  # fmt: skip
    machine = RIG.model_copy(update={"sensors": {"laboratory": own}})
    logs = [with_column(stroke(seed=k), "pressure_rod.slide", stroke(seed=k + 5)[
        "pressure_head.slide"], "Pa") for k in (0, 1)]  # fmt: skip
    data = dataset(*logs, machine=machine)
    noise = dict(zip(data.channels, data.noise, strict=True))
    assert noise["position.slide"] == 2e-5 and np.isnan(noise["pressure_head.slide"])
    assert noise["pressure_rod.slide"] == pytest.approx(5e4 / 3**0.5)
    assert np.isfinite(data.fit[0].reading).all() and data.sensors == "laboratory"


def test_accuracies_that_are_refused(tmp_path):
    with pytest.raises(ValueError, match="accuracy .* or standard_deviation, not both"):
        Sensor(accuracy=1.0, standard_deviation=1.0)
    with pytest.raises(ValueError, match="pressure_rod.slide: 12 bits need a span"):
        SensorSet(channels={"pressure_rod.slide": Sensor(bits=12)})
    path = tmp_path / "machine.yaml"
    save_machine(RIG, path)
    own = "    rate: 1000.0\n    channels: {pressure_hed.slide: {accuracy_bar: 1}}\n"
    path.write_text(path.read_text().replace("    rate: 1000.0\n", own))
    with pytest.raises(InputError, match="channels.*did you mean 'pressure_head.slide'"):
        load_machine(path)


def test_a_coarse_fast_encoder_has_no_spikes():
    """One step of its converter for one row is no impossible acceleration."""
    log = stroke(2.0, 5000.0, sensors=False)
    clean = 0.25 + 0.1 * np.sin(2 * np.pi * log.time)
    noisy = clean + np.random.default_rng(3).normal(0.0, 2e-6, len(log))
    log = with_column(log, "position.slide", np.rint(noisy / 1e-5) * 1e-5, "m")
    data = make_dataset([RunFiles("a", (log,)), RunFiles("b", (stroke(seed=1),))], RIG, "ideal")
    assert not [note for note in data.notes if "physically impossible" in note]
