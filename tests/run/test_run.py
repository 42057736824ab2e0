"""The loop: same scenario, same bits; what is measured is not what is true; the books close."""

import dataclasses
import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

import hydrotele
from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log, load_log, save_log
from hydrotele.run.run import (
    finish_run,
    load_simulated_machine,
    prepare_run,
    run_scenario,
    start_session,
)
from hydrotele.scenario.scenario import Scenario, load_scenario, save_scenario
from hydrotele.simulate.conservation_checks import compute_balance_errors, full_physics_state
from hydrotele.simulate.record import SimulationFailed, start_leapfrog

DATA = Path(__file__).parents[1] / "data"

OPEN = {"duration": "3.2", "sensors": "khoshzaban1992"}  # of `steps`: the swing's first step


def same(a: Log, b: Log) -> bool:
    """Whether two logs agree in every bit of every column."""
    equal = a.time.tobytes() == b.time.tobytes() and a.columns.keys() == b.columns.keys()
    return equal and all(a[c].tobytes() == b[c].tobytes() for c in a.columns)


@pytest.mark.parametrize("name", ["steps", "zhu_in"])
def test_same_seed_same_bits(name):
    first = run_scenario(load_scenario(name, {"duration": "2"}))
    again = run_scenario(load_scenario(name, {"duration": "2"}))
    assert same(first.measured, again.measured) and same(first.truth, again.truth)


def test_other_seed_changes_what_is_measured_and_open_loop_only_that():
    first = run_scenario(load_scenario("steps", OPEN))
    other = run_scenario(load_scenario("steps", OPEN | {"seed": "12"}))
    assert same(first.truth, other.truth)
    for channel in first.measured.columns:
        changed = first.measured[channel].tobytes() != other.measured[channel].tobytes()
        assert changed != channel.startswith("command.")


def test_closed_loop_feels_its_sensors():
    first = run_scenario(load_scenario("zhu_in", {"duration": "1"}))
    other = run_scenario(load_scenario("zhu_in", {"duration": "1", "seed": "1"}))
    assert not same(first.truth, other.truth)


def test_progress_and_timing_do_not_change_the_run():
    seen = []
    watched = run_scenario(load_scenario("zhu_in", {"duration": "2"}), lambda *a: seen.append(a))
    assert same(watched.truth, run_scenario(load_scenario("zhu_in", {"duration": "2"})).truth)
    assert seen[-1] == (2.0, 2.0) and all(0 <= done <= total for done, total in seen)


@pytest.mark.daily("asked0", "asked3")
@pytest.mark.parametrize("asked", [
    ("zhu_in", {"duration": "2"}),
    ("press_stiffness", {"duration": "3", "pilot.channel.loss_probability": "0.3"}),
    ("press_stiffness", {"duration": "1", "pilot.safety.following_error": "1e-3"}),
    ("fell_tree", {"duration": "1"}),
])  # fmt: skip
def test_ticks_one_by_one_are_those_of_a_run(asked):
    """What native code does by itself is what it does tick by tick, also where valves close."""
    scenario = load_scenario(*asked)
    session = start_session(scenario)
    while session.tick < scenario.tick_count:
        session.advance()
    one, run = finish_run(session, scenario), run_scenario(scenario)
    assert same(one.truth, run.truth) and same(one.measured, run.measured)
    assert one.summary["notes"] == run.summary["notes"]
    if "pilot.safety.following_error" in asked[1]:
        assert any("closed permanently" in note for note in run.summary["notes"])


def test_measured_keeps_the_truth_apart():
    """No hidden channel and no exact state leave with the measured log."""
    run = run_scenario(load_scenario("steps", OPEN))
    assert not any(c.startswith("truth.") for c in run.measured.columns)
    assert "initial_state" not in run.measured.metadata
    assert "initial_state" in run.truth.metadata
    assert run.measured.metadata["sensors"] == "khoshzaban1992"
    hidden = [c for c in run.truth.columns if c.startswith("truth.")]
    assert set(run.truth.columns) - set(hidden) == set(run.measured.columns)
    for channel in run.measured.columns:
        exact = np.array_equal(run.measured[channel], run.truth[channel])
        assert exact == channel.startswith("command.")


def test_ideal_sensors_measure_the_truth():
    run = run_scenario(load_scenario("steps", OPEN | {"sensors": "ideal"}))
    assert all(np.array_equal(v, run.truth[c]) for c, v in run.measured.columns.items())


def test_controller_reads_what_the_log_shows():
    """The servo of a run at control_rate == log_rate, fed with the log, gives the log's commands.

    A pure position loop of the EMPS without rate feedback: u = gain_v gain_p (ref - y) / drive.
    """
    pilot = {"kind": "table", "quantity": "joint", "time": [0.0], "columns": {"slide": [0.01]}}
    servo = {"position_gain": 5.0, "velocity_gain": 500.0, "lead": 0.0}
    facts = {"machine": "emps", "control_rate": 500, "log_rate": 500, "pilot": pilot}
    run = run_scenario(Scenario(name="t", duration=0.5, servo=servo, **facts))
    y, drive = run.measured["position.slide"], run.plant.machine.axes["slide"].force
    rate = np.diff(y, prepend=y[0]) * 500
    wanted = 500.0 * (5.0 * (0.01 - y) - rate) / drive.gain
    # 1e-9 V: rounding of rates that are differences of positions over 2 ms.
    np.testing.assert_allclose(run.measured["command.slide"], wanted, atol=1e-9)


@pytest.mark.parametrize("duration", [0.2, 0.517, 0.519, 1.0])
def test_rows_are_whole(duration):
    """The log holds as many whole rows as the control ticks give, 0.02 s apart."""
    facts = {"duration": duration, "ground": False, "pilot": {"kind": "constant"}}
    run = run_scenario(Scenario(name="t", **facts))
    assert len(run.truth) == run.scenario.tick_count // 4 == run.scenario.row_count
    np.testing.assert_allclose(run.truth.time, 0.02 * np.arange(len(run.truth)), atol=1e-12)


def test_command_of_a_row_is_the_mean_over_it():
    """At 200 Hz control and 50 Hz log, four commands make a row."""
    times = np.arange(0, 0.5, 0.005)
    values = np.sin(20 * times)
    pilot = {"kind": "table", "time": times.tolist(), "columns": {"boom": values.tolist()}}
    run = run_scenario(Scenario(name="t", duration=0.5, ground=False, pilot=pilot))
    assert run.measured.metadata["command"] == "mean over the row"
    expected = values.reshape(-1, 4).mean(axis=1)
    np.testing.assert_array_equal(run.measured["command.boom"], expected)


def table_of(path, folder, **facts):
    """A scenario file whose pilot is a table in another file."""
    pilot = {"kind": "table", "file": str(path)} | facts.pop("pilot", {})
    usual = {"name": "table", "duration": 3.2, "control_rate": 50, "ground": False, "tool": "none"}
    start = {"joints": {"boom": 0.35, "stick": -1.5}}
    facts = usual | {"start": start, "pilot": pilot} | facts
    (folder / "s.yaml").write_text(json.dumps(facts))  # JSON is YAML
    return folder / "s.yaml"


def test_measured_commands_repeat_their_run_bit_for_bit(tmp_path):
    """Through a file, and through the scenario that this run writes."""
    first = run_scenario(load_scenario("steps", OPEN))
    save_log(first.measured, tmp_path / "measured.parquet")
    scenario = load_scenario(table_of("measured.parquet", tmp_path))  # beside the scenario
    assert scenario.pilot.file is None and len(scenario.pilot.time) == len(first.measured)
    again = run_scenario(scenario)
    assert same(first.truth, again.truth)
    (tmp_path / "elsewhere").mkdir()
    save_scenario(scenario, tmp_path / "elsewhere" / "scenario.yaml")
    (tmp_path / "measured.parquet").unlink()
    third = run_scenario(load_scenario(tmp_path / "elsewhere" / "scenario.yaml"))
    assert same(first.truth, third.truth)


def test_closed_loop_run_is_repeated_by_its_commands(tmp_path):
    """The commands that a servo gave, taken as a table, drive the machine through the same bits."""
    changes = {"duration": "3", "control_rate": "50"}
    first = run_scenario(load_scenario("zhu_in", changes))
    save_log(first.measured, tmp_path / "m.parquet")
    start = first.scenario.start.model_dump(mode="json")
    facts = {"duration": 3, "tool": "bucket", "start": start, "ground": True}
    again = run_scenario(load_scenario(table_of("m.parquet", tmp_path, **facts)))
    assert same(first.truth, again.truth)


def test_table_from_csv_drives_joints(tmp_path):
    """References in degrees from a spreadsheet; `reference` comes before `angle`."""
    rows = [f"{t / 10:.1f},{20 + t},0,{-86 - t}" for t in range(11)]
    header = "time,reference.boom [deg],angle.boom [deg],angle.stick [deg]"
    (tmp_path / "r.csv").write_text("\n".join([header, *rows]))
    pilot = {"quantity": "joint", "interpolate": "linear"}
    scenario = load_scenario(table_of("r.csv", tmp_path, pilot=pilot, duration=1.0))
    plan = prepare_run(scenario).plan
    boom = plan.reference[:, plan.axes.index("boom")]
    np.testing.assert_allclose(boom, np.radians(20 + 10 * plan.time), atol=1e-12)
    assert plan.reference[0, plan.axes.index("stick")] == pytest.approx(np.radians(-86))


def test_table_of_a_log_that_starts_late_starts_at_once(tmp_path):
    rows = [f"{7 + t / 10:.1f},{0.01 * t}" for t in range(20)]
    (tmp_path / "c.csv").write_text("\n".join(["time,command.boom", *rows]))
    pilot = load_scenario(table_of("c.csv", tmp_path)).pilot
    assert pilot.time[0] == 0.0 and pilot.time[-1] == pytest.approx(1.9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,angle.boom\n0,0\n0.1,0\n0.2,0\n", r"t\.csv has no command\.<axis>; it has angle"),
        ("time,command.boom\n0,0\n0.1,nan\n0.2,0\n", "t.csv, column 'command.boom', row 1"),
        ("time,command.boom\n0,0\n0.1,5\n0.2,0\n", "percent"),
        ("time,command.bom\n0,0\n0.1,0\n0.2,0\n", "'bom' is not an axis.*'boom'"),
        ("time,command.boom\n0,0\n", "too short"),
        ("", "is empty"),
    ],
)
def test_bad_table_files(text, message, tmp_path):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        prepare_run(load_scenario(table_of("t.csv", tmp_path)))


def test_missing_table_file_names_scenario_line_and_file(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text("name: t\nduration: 1\npilot:\n  kind: table\n  file: none.csv\n")
    with pytest.raises(InputError, match=rf"{path}:5: pilot\.file: {tmp_path}/none\.csv"):
        load_scenario(path)


def test_summary_names_what_ran():
    run = run_scenario(load_scenario("steps", OPEN))
    summary = run.summary
    assert re.fullmatch(r"[0-9a-f]{40}\+?", summary["git_commit"] or "0" * 40)
    assert summary["versions"]["mujoco"] == mujoco.__version__
    assert summary["versions"]["hydrotele"] == hydrotele.__version__
    assert summary["seed"] == 11 and summary["simulated_seconds"] == 3.2
    assert summary["physics_steps"] == 3200
    assert summary["realtime_factor"] > 0
    assert json.loads(json.dumps(summary, allow_nan=False, default=float))["tool"] == "none"


@pytest.mark.parametrize("name", ["excitation", "zhu_up", "hold", "grapple_log", "ec20_steps"])
def test_books_close(name):
    """Five seconds at 1 ms: 1e-4 of what went through.

    The step is 1 % of the fastest period, of which the square counts but where valves and friction
    switch.
    """
    changes = {"duration": "5", "ground": "false"}
    balance = run_scenario(load_scenario(name, changes)).summary["balance"]
    assert balance["seconds"] == pytest.approx(5.0)
    assert 0.0 <= balance["flow_balance"] < 1e-4
    assert 0.0 <= balance["energy_balance"] < 1e-4


def test_books_close_better_with_smaller_steps():
    found = [
        run_scenario(load_scenario("excitation", {"duration": "5", "timestep": step})) for step in ("1.0e-3", "2.5e-4")
    ]
    coarse, fine = (run.summary["balance"] for run in found)
    for book in ("flow_balance", "energy_balance"):
        assert fine[book] < 0.5 * coarse[book]  # a quarter of the step, at least first order


def test_books_of_a_run_with_contact_claim_nothing():
    """The ground takes energy that the books do not hold."""
    balance = run_scenario(load_scenario(DATA / "press_ground.yaml", {"duration": "4"})).summary["balance"]
    assert balance["energy_balance"] is None
    assert balance["flow_balance"] < 1e-3  # oil is not lost to the ground; hits are short


def _books(change=None, swap=None):
    """The audit of two seconds of motion, after forging the model or the machine."""
    plant, data, *_ = prepare_run(load_scenario("excitation", {"duration": "2"}))
    start_leapfrog(plant.model, data)
    start = full_physics_state(plant.model, data)
    window = np.zeros((2000, plant.model.nu))
    window[:] = 0.3, 0.2, -0.3
    if change:
        change(plant.model)
    return compute_balance_errors(swap(plant) if swap else plant, start, window)


def test_audit_accepts_honest_books():
    honest = _books()
    assert honest["flow_balance"] < 1e-3 and honest["energy_balance"] < 1e-3


def test_audit_finds_lost_oil():
    """The machine says another bulk modulus or area than the simulated one has: oil is missing."""

    def stiffer(plant):
        supply = plant.machine.supply.model_copy(update={"bulk_modulus": 0.45e9})
        machine = plant.machine.model_copy(update={"supply": supply})
        return dataclasses.replace(plant, machine=machine)

    assert _books(swap=stiffer)["flow_balance"] > 3 * _books()["flow_balance"]

    def narrower(plant):
        axis = plant.machine.axes["boom"]
        cylinder = axis.cylinder.model_copy(update={"area_head": 0.99 * axis.cylinder.area_head})
        axes = plant.machine.axes | {"boom": axis.model_copy(update={"cylinder": cylinder})}
        machine = plant.machine.model_copy(update={"axes": axes})
        return dataclasses.replace(plant, machine=machine)

    assert _books(swap=narrower)["flow_balance"] > 3e-3  # 1 % of the area, half of all motion


def test_audit_finds_energy_from_nowhere():
    """A gale that the books do not know."""

    def wind(model):
        model.opt.wind[:] = 0, 0, 30.0
        model.opt.density = 1.2

    assert _books(change=wind)["energy_balance"] > 10 * _books()["energy_balance"]


def test_failed_simulation_tells_its_last_states():
    """Teranewtons on a hundred kilograms leave MuJoCo's numbers within a step."""
    scenario = Scenario(name="t", machine="emps", duration=1.0, pilot={"kind": "constant", "commands": {"slide": 9}})
    machine = load_simulated_machine(scenario)
    axis = machine.axes["slide"]
    force = axis.force.model_copy(update={"gain": 1e12})
    axes = {"slide": axis.model_copy(update={"force": force})}
    wild = machine.model_copy(update={"axes": axes})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hydrotele.run.run.add_scenario_effects", lambda *_: wild)
        with pytest.raises(SimulationFailed, match=r"(?s)unstable at 0\.\d+ s.*qpos=") as failure:
            run_scenario(scenario)
    assert "t=0." in str(failure.value)


def test_logs_of_a_run_are_good_logs(tmp_path):
    for name in ("zhu_up", "grapple_log", "rig_steps", "emps_track", "ec20_steps"):
        run = run_scenario(load_scenario(name, {"duration": "0.5"}))
        for log in (run.measured, run.truth):
            save_log(log, tmp_path / "log.parquet")
            assert same(load_log(tmp_path / "log.parquet"), log)
