"""Sweeps: their rows are those of single runs, and no interruption changes them."""

import json
import multiprocessing
import os
import shutil
import signal
import threading
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from hydrotele.cli import main as cli
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder, scenarios_folder
from hydrotele.logs.log import save_log
from hydrotele.run import sweep_task as running
from hydrotele.run.run import run_scenario
from hydrotele.run.sweep import SweepSettings, open_sweep_folder, run_in_processes, run_sweep
from hydrotele.run.sweep_file import iterate_points, load_sweep, point_overrides
from hydrotele.run.sweep_journal import FAILED, OK, Journal, JournalEntry
from hydrotele.run.sweep_scenarios import check_points, make_point_scenario, read_base_scenario
from hydrotele.run.sweep_task import RunTask, execute_task, flatten_summary, possible_number_names
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.record import SimulationFailed
from tests.run.conftest import rows_of, write_sweep


def invoke(*words):
    result = CliRunner().invoke(cli.app, [str(w) for w in words])
    if isinstance(result.exception, InputError):
        return 2, result.stdout, str(result.exception)
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def copied(done: Path, folder: Path) -> tuple[Path, Path]:
    """Sweep file and folder of the finished sweep, somewhere else."""
    shutil.copytree(done, folder / "out")
    return Path(shutil.copy(done.parent / "tiny.yaml", folder)), folder / "out"


def test_rows_and_logs_are_those_of_single_runs(done, tmp_path):
    file = load_sweep(done.parent / "tiny.yaml")
    rows = rows_of(done)
    assert [row["run"] for row in rows] == list(range(1, 9))
    for point in list(iterate_points(file.sweep))[1::5]:
        words = point_overrides(file.sweep, point.values)
        seed = load_scenario("rig_steps", words).seed + point.repetition_number
        single = run_scenario(load_scenario("rig_steps", {**words, "seed": str(seed)}))
        row = rows[point.run - 1]
        assert row["status"] == OK and row["reason"] == "" and row["seed"] == seed
        assert {key: row[key] for key in point.values} == point.values
        numbers = {name: value for name, (value, _) in flatten_summary(single.summary).items()}
        assert {name: row[name] for name in numbers} == numbers
        assert "tracking.slide.rms" in numbers and "wall_seconds" not in row
        kept = done / "runs" / f"{point.run:04d}"
        for log in ("measured", "truth"):
            save_log(getattr(single, log), tmp_path / f"{log}.parquet")
            assert (kept / f"{log}.parquet").read_bytes() == (tmp_path / f"{log}.parquet").read_bytes()


def test_the_table_states_units(done):
    schema = pq.read_schema(done / "table.parquet")
    units = {field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in schema}
    assert units["servo.lead"] == "s" and units["tracking.slide.rms"] == "m"
    assert units["max_pin_opening_mm"] == "mm" and units["balance.flow_balance"] == "1"
    assert units["status"] == "" and str(schema.field("run").type) == "int64"


def test_a_finished_sweep_is_reported_without_running_anything(done, tmp_path, monkeypatch):
    file, out = copied(done, tmp_path)
    monkeypatch.setattr("hydrotele.run.sweep._Worker", None)  # must not be started
    code, said, _ = invoke("sweep", file, "--out", out, "--json")
    facts = json.loads(said)
    assert code == 0 and facts["runs"] == 8 and facts["runs_done"] == facts["failed"] == 0
    assert facts["figures"]["tracking.slide.rms"]["unit"] == "m"
    page = (out / "report.html").read_text()
    assert "servo.position_gain" in page and page.count("data:image/png") == 1
    assert (out / "main_effects.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "table.parquet").read_bytes() == (done / "table.parquet").read_bytes()
    file.write_text(file.read_text() + "figures: [max_pin_opening_mm]\n")  # changes no run
    code, said, _ = invoke("sweep", file, "--out", out)
    assert code == 0 and "max_pin_opening_mm" in said and "tracking" not in said
    file.write_text(file.read_text().replace("opening_mm]", "opening]"))
    code, _, said = invoke("sweep", file, "--out", out)
    assert code == 2 and "did you mean 'max_pin_opening_mm'" in said


@pytest.mark.nightly
def test_a_two_key_grid_gets_a_map_and_failed_runs_are_listed(tmp_path):
    grid = {"servo.lead": [0.0, 0.1], "start.joints.slide": [0.1, 9.0]}
    file = write_sweep(tmp_path, "some", grid=grid, sample=None, repeat=None)
    code, said, _ = invoke("sweep", file, "--out", tmp_path / "out", "--jobs", "1")
    rows = rows_of(tmp_path / "out")
    assert code == 0 and "2 of 4 runs failed" in said and "outside its range" in said
    assert [row["status"] for row in rows] == [OK, FAILED, OK, FAILED]
    assert "slide 9 is outside its range" in rows[1]["reason"]
    assert rows[1]["tracking.slide.rms"] is None and rows[2]["tracking.slide.rms"] > 0
    assert (tmp_path / "out" / "heat_map.png").is_file()
    assert "outside its range" in (tmp_path / "out" / "report.html").read_text()
    before = (tmp_path / "out" / "table.parquet").read_bytes()
    words = ["sweep", file, "--out", tmp_path / "out", "--jobs", "1", "--json"]
    code, said, _ = invoke(*words, "--retry-failed", "--strict")
    assert code == 3 and json.loads(said)["runs_done"] == json.loads(said)["failed"] == 2
    assert (tmp_path / "out" / "table.parquet").read_bytes() == before


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (SimulationFailed("it went wild\nq 1 2"), "simulation failed: it went wild"),
        (InputError("start", "is too deep"), "start: is too deep"),
        (ZeroDivisionError("of ours"), "ZeroDivisionError: of ours"),
    ],
)
def test_a_failed_run_says_why(error, reason, monkeypatch, tmp_path):
    def fail(*_):
        raise error

    monkeypatch.setattr(running, "run_scenario", fail)
    base = read_base_scenario(load_sweep(write_sweep(tmp_path)))
    scenario = make_point_scenario(base, next(iterate_points(base.file.sweep)))
    outcome = execute_task(RunTask(7, scenario, str(tmp_path), {}, None, str(tmp_path)))
    assert outcome.entry == JournalEntry(7, FAILED, reason)


def test_a_journal_survives_being_cut_anywhere(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda _: None)  # hundreds of them take seconds
    path = tmp_path / "journal.jsonl"
    entries = [
        JournalEntry(1, OK, "", {"a": (0.1, "m")}, "x", 1.0),
        JournalEntry(2, FAILED, "é: no"),
        JournalEntry(3, OK),
    ]
    journal = Journal(path)
    for entry in entries:
        journal.add(entry)
    journal.close()
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        journal = Journal(path)
        expected = entries[: whole[:length].count(b"\n")]
        assert list(journal.entries.values()) == expected
        journal.add(entries[2])
        journal.close()
        again = Journal(path)  # what is appended is not joined to the half line
        assert again.entries == {e.run: e for e in [*expected, entries[2]]}
        again.close()
    path.write_bytes(b"\0" * 40 + b"\n" + whole + b"[1]\n{}\n")
    journal = Journal(path)
    assert list(journal.entries.values()) == entries
    journal.close()
    assert path.read_bytes() == whole


def test_another_sweep_is_refused_with_what_differs(done, tmp_path):
    file, out = copied(done, tmp_path)
    file.write_text(file.read_text().replace("0.05", "0.06"))
    with pytest.raises(InputError, match=r"grid.servo.lead was \[0.0, 0.05\], is \[0.0, 0.06\]"):
        run_sweep(load_sweep(file), out)
    assert (out / "table.parquet").read_bytes() == (done / "table.parquet").read_bytes()
    base = read_base_scenario(load_sweep(file))
    with open_sweep_folder(out, base, check_points(base), fresh=True):
        assert sorted(p.name for p in out.iterdir()) == [".scratch", "summary.json", "sweep.yaml"]
        with pytest.raises(InputError, match="in use by another hydrotele sweep"):
            run_sweep(load_sweep(file), out)


def test_what_a_sweep_did_not_write_is_left_alone(tmp_path, monkeypatch):
    file = load_sweep(write_sweep(tmp_path))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years")
    for target in (tmp_path / "mine", tmp_path / "mine" / "thesis.txt"):
        for fresh in (False, True):
            with pytest.raises(InputError, match="was not written by a sweep"):
                run_sweep(file, target, SweepSettings(fresh=fresh))
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years"
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(InputError, match="is not a writable folder"):
        run_sweep(file, tmp_path / "new")


@pytest.fixture
def own(tmp_path) -> Path:
    """A sweep over a machine of one's own beside it, and the shipped one."""
    shutil.copytree(models_folder() / "rig", tmp_path / "mine")
    text = (scenarios_folder() / "rig_steps.yaml").read_text()
    (tmp_path / "s.yaml").write_text(text.replace("machine: rig", "machine: mine"))
    changes = {"scenario": "s.yaml", "grid": {"machine": ["mine", "rig"]}, "sample": None}
    return write_sweep(tmp_path, "own", **changes, repeat=None)


def test_a_machine_of_ones_own_travels_as_content(own, tmp_path):
    base = read_base_scenario(load_sweep(own))
    checked = check_points(base)
    mine, shipped = (make_point_scenario(base, point) for point in iterate_points(base.file.sweep))
    files = base.machine_copies.files_of(mine)
    assert sorted(Path(name).name for name in files) == ["machine.yaml", "rig.xml"]
    assert base.machine_copies.files_of(shipped) == {}
    shutil.rmtree(tmp_path / "mine")
    found = [
        execute_task(RunTask(k, scenario, None, files, None, str(tmp_path))).entry
        for k, scenario in enumerate((mine, shipped))
    ]
    assert found[0].status == OK and found[0].numbers == found[1].numbers
    (tmp_path / "mine").mkdir()
    for name, content in files.items():
        changed = content.replace(b"name: rig", b"name: rag")
        (tmp_path / "mine" / Path(name).name).write_bytes(changed)
    assert check_points(read_base_scenario(load_sweep(own))).digest != checked.digest


def test_a_machine_with_further_files_is_refused_on_a_cluster(own, tmp_path):
    model = tmp_path / "mine" / "rig.xml"
    text = model.read_text()
    model.write_text(text.replace("<worldbody>", '<!-- mesh file="a.stl" --><worldbody>', 1))
    with pytest.raises(InputError, match="needs files in addition to its MJCF, which cannot be sent"):
        run_sweep(load_sweep(own), tmp_path / "out", SweepSettings(dask="tcp://127.0.0.1:1"))
    assert not (tmp_path / "out").exists()


def test_all_numbers_that_runs_have_are_known_beforehand():
    teleoperated = run_scenario(load_scenario("joystick_up", {"duration": "0.5"}))
    possible = possible_number_names(teleoperated.plant.axes, True)
    names = set(flatten_summary(teleoperated.summary))
    assert names <= set(possible) and "teleoperation.handle_energy_J" in names


@pytest.mark.nightly
def test_a_killed_process_costs_its_run_alone(tmp_path):
    base = read_base_scenario(load_sweep(write_sweep(tmp_path)))
    quick = [make_point_scenario(base, point) for point in list(iterate_points(base.file.sweep))[:2]]
    endless = quick[0].model_copy(update={"duration": 3600.0, "control_rate": 1000.0})
    scenarios = [quick[0], endless, quick[1]]
    tasks = [RunTask(k, s, str(tmp_path), {}, None, str(tmp_path)) for k, s in enumerate(scenarios)]
    found = run_in_processes(iter(tasks), 1)
    assert next(found).entry.status == OK
    (process,) = multiprocessing.active_children()
    threading.Timer(0.3, os.kill, (process.pid, signal.SIGKILL)).start()
    lost, last = (outcome.entry for outcome in found)
    assert (lost.run, lost.status) == (1, FAILED) and "was killed (SIGKILL)" in lost.reason
    assert (last.run, last.status) == (2, OK)
    assert multiprocessing.active_children() == []
