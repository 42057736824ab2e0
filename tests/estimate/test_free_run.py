"""Free runs: known errors come out, histories of commands and sensors count, divergence is said."""

import dataclasses

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.effects import apply_effect
from hydrotele.estimate.free_run import (
    Runner,
    chained,
    following_levels,
    free_run_errors,
    machine_runner,
    window_starts,
)
from hydrotele.logs.dataset import RunData, load_dataset
from hydrotele.logs.log import Log, save_log
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario

PERIOD = 0.02


def made_run(reading, period=PERIOD):
    rows = len(reading)
    log = Log(time=period * np.arange(rows), columns={}, units={})
    known = np.ones(rows, bool)
    return RunData("made", 0.0, period, np.zeros((rows, 1)), known, reading, log)


def off_by(run, error):
    """A model whose error grows with the time since its start: error(seconds)."""

    def free(starts, count):
        late = error(run.period * np.arange(1, count + 1))
        return run.reading[starts[:, None] + np.arange(1, count + 1)] + late[None, :, None]

    return Runner(run.reading + 0.25, free)


def test_errors_that_grow_evenly_have_the_integrals_root():
    """Of an error 0.5 t the RMS over a window H is 0.5 H / sqrt(3), its last value 0.5 H.

    Rows instead of an integral add half a row, 1 % of the shortest window.
    """
    run = made_run(np.sin(0.02 * np.arange(1001))[:, None])
    errors = free_run_errors(off_by(run, lambda t: 0.5 * t), run, (1.0, 5.0, 30.0))
    assert list(errors.horizons) == ["1", "5", "end"]  # 30 s do not fit into 20 s
    assert errors.one_step == pytest.approx([0.25])
    for name, seconds, windows in (("1", 1.0, 19), ("5", 5.0, 6), ("end", 19.0, 1)):
        found = errors.horizons[name]
        assert (found.seconds, found.windows) == (pytest.approx(seconds), windows)
        assert found.rms == pytest.approx([0.5 * seconds / np.sqrt(3.0)], rel=0.02)
        assert found.median == pytest.approx(found.rms)
        assert found.final == pytest.approx([0.5 * seconds])


def test_missing_readings_do_not_count():
    reading = np.column_stack([np.ones(500), np.full(500, np.nan), np.ones(500)])
    reading[100:300, 2] = np.nan
    run = made_run(reading)
    full = dataclasses.replace(run, reading=np.ones((500, 3)))
    model = off_by(full, lambda t: t)
    errors = free_run_errors(model, run, (1.0,), to_end=False)
    whole = free_run_errors(model, full, (1.0,), to_end=False)
    assert errors.horizons["1"].diverged == 0
    for values in (errors.one_step, errors.horizons["1"].rms, errors.horizons["1"].median):
        assert np.isnan(values).tolist() == [False, True, False]
    assert errors.horizons["1"].rms[0] == whole.horizons["1"].rms[0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_a_model_that_leaves_the_range_counts_as_infinite(bad):
    run = made_run(np.sin(0.02 * np.arange(500))[:, None])
    errors = free_run_errors(off_by(run, lambda t: np.where(t > 4.0, bad, 0.1)), run, (1.0, 5.0))
    assert errors.horizons["1"].diverged == 0
    assert errors.horizons["1"].rms == pytest.approx([0.1])
    assert errors.horizons["5"].diverged == errors.horizons["5"].windows == 2
    assert np.isposinf(errors.horizons["5"].rms).all()
    assert np.isposinf(errors.horizons["5"].final).all()
    shown = chained(off_by(run, lambda t: np.where(t > 4.0, bad, 0.1)), run, 5.0)
    assert np.isnan(shown[:51]).all() and np.isfinite(shown[51:240]).all()


def test_a_horizon_below_a_row_is_refused():
    with pytest.raises(InputError, match="shorter than a log row"):
        window_starts(500, 0.1, 0.04)
    assert len(window_starts(40, 0.1, 5.0)) == 0


# At rest at first: before the first row a log's command is held, MuJoCo's is zero.
COMMANDS = {
    a: [0.1 + 0.5 * np.sin(0.03 * k * (3 + i) + i) if k >= 20 else 0.0 for k in range(400)]
    for i, a in enumerate(("swing", "boom", "stick"))
}


def simulated(folder, *effects):
    """Two runs of the CAT 215 by MuJoCo, with the sensors' noise and planted effects."""
    folder.mkdir()
    for seed, name in enumerate(("fit_1", "test_1")):
        pilot = {
            "kind": "table", "quantity": "command", "interpolate": "hold",
            "time": (PERIOD * np.arange(400)).tolist(), "columns": COMMANDS,
        }  # fmt: skip
        scenario = Scenario(
            name=name, machine="cat215", control_rate=50, log_rate=50, duration=8.0, ground=False,
            pilot=pilot, seed=seed, sensors="khoshzaban1992",
            effects=[dict(zip(("name", "location", "parameters"), e, strict=True))
                     for e in effects],
        )  # fmt: skip
        save_log(run_scenario(scenario).measured, folder / f"{name}.parquet")
    return folder


LATE = (
    ("command_delay", "boom", {"delay": 0.13}),
    ("angle_delay", "boom", {"delay": 0.07}),
)


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("late") / "logs", *LATE)


def test_the_true_machine_follows_mujoco_and_one_without_its_delays_does_not(late):
    """The angles' noise is 0.058 deg; the start's estimate and 2 s may leave as much again."""
    machine = load_machine("cat215")
    for name, place, parameters in LATE:
        machine = apply_effect(machine, name, place, parameters)
    errors = {}
    for label, model in (("true", machine), ("prompt", load_machine("cat215"))):
        data = load_dataset(late, model)
        found = free_run_errors(machine_runner(model, data)(data.heldout), data.heldout, (2.0,))
        assert found.horizons["2"].diverged == found.horizons["end"].diverged == 0
        boom = data.channels.index("angle.boom")
        errors[label] = np.rad2deg([found.horizons[h].rms[boom] for h in ("2", "end")])
    assert errors["true"][0] < 0.12 and errors["true"][1] < 0.5
    assert errors["prompt"][0] > 5.0 * errors["true"][0]


def test_a_window_knows_the_commands_and_readings_on_their_way(late):
    """The first rows of a window repeat what was commanded and read before its start."""
    machine = load_machine("cat215")
    for name, place, parameters in LATE:
        machine = apply_effect(machine, name, place, parameters)
    data = load_dataset(late, machine)
    runner = machine_runner(machine, data)(data.heldout)
    boom, starts = data.channels.index("angle.boom"), np.arange(60, 340, 10)
    first = runner.run(starts, 3)[:, :, boom]
    error = first - data.heldout.reading[starts[:, None] + np.arange(1, 4), boom]
    assert np.rad2deg(np.sqrt(np.mean(error**2))) < 0.08  # noise 0.058 deg, and the estimate's
    changed = dataclasses.replace(data.heldout, command=data.heldout.command.copy())
    changed.command[200:, data.axes.index("boom")] = 1.0
    other = machine_runner(machine, data)(changed).run(np.array([199]), 10)[0, :, boom]
    # rows 200 .. 202 read the state of 199 - 3.5 .. 202 - 3.5, the command arrives 6.5 rows late
    np.testing.assert_array_equal(other[:9], runner.run(np.array([199]), 10)[0, :9, boom])


LAGGING = (("angle_lag", "boom", {"time_constant": 0.12}),)


@pytest.mark.nightly
def test_sensors_with_a_first_order_lag_are_followed_from_any_row(tmp_path):
    """A lag of 0.12 s that is forgotten at a window's start is off by rate times lag, 0.3 deg."""
    machine = load_machine("cat215")
    for name, place, parameters in LAGGING:
        machine = apply_effect(machine, name, place, parameters)
    data = load_dataset(simulated(tmp_path / "logs", *LAGGING), machine)
    boom, starts = data.channels.index("angle.boom"), np.arange(60, 340, 10)
    first = machine_runner(machine, data)(data.heldout).run(starts, 5)[:, :, boom]
    error = first - data.heldout.reading[starts[:, None] + np.arange(1, 6), boom]
    prompt = machine_runner(data.machine.model_copy(update={"sensor_errors": {}}), data)
    other = prompt(data.heldout).run(starts, 5)[:, :, boom] - (first - error)
    rms = np.rad2deg([np.sqrt(np.mean(e**2)) for e in (error, other)])
    assert rms[0] < 0.08  # noise 0.058 deg, and the estimate's
    assert rms[1] > 2.0 * rms[0]


def test_levels_without_stated_accuracy_let_the_state_follow(late):
    """Noise found from the roughness of the readings: 0.058 deg, white, within a third."""
    data = load_dataset(late, load_machine("cat215"))
    bare = dataclasses.replace(data, noise=np.full(len(data.noise), np.nan), sensors=None)
    found = following_levels(bare)
    assert np.array_equal(following_levels(data).noise, data.noise)
    swing = data.channels.index("angle.swing")
    assert found.noise[swing] == pytest.approx(data.noise[swing], rel=0.33)
    assert np.isfinite(found.noise).all()
    run = bare.heldout
    errors = free_run_errors(machine_runner(bare.machine, bare)(run), run, (1.0,))
    assert np.isfinite(errors.one_step).all()
    # a model that lacks 0.2 s of delay is off by more, but its starts are at the readings
    assert np.rad2deg(errors.one_step[data.channels.index("angle.boom")]) < 0.5
