"""The command line: help, exit codes, output for scripts, folders that survive being killed."""

import errno
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import hydrotele
from hydrotele.cli import main as cli
from hydrotele.cli.list_command import format_items, format_name_lists
from hydrotele.cli.program_help import COMMANDS as SUMMARIES
from hydrotele.cli.program_help import format_program_help
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder, scenarios_folder

ROOT = Path(hydrotele.__file__).parents[1]
COMMANDS = [c.name or c.callback.__name__.strip("_") for c in cli.app.registered_commands]
HEAVY = ("numpy", "mujoco", "numba", "rerun", "scipy", "matplotlib", "dm_control", "pyarrow",
         "pydantic", "yaml", "rich", "typer")  # fmt: skip
QUICK = ["--set", "duration=0.5", "--no-review"]


def hydrotele_process(*words, **facts) -> subprocess.Popen:
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths)), "COLUMNS": "200"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | facts
    return subprocess.Popen(
        [sys.executable, "-m", "hydrotele", *map(str, words)], env=env, **pipes,
        preexec_fn=_heed_interrupts,
    )  # fmt: skip


def _heed_interrupts() -> None:
    """A shell's job in the background ignores them, and so do all programs that it starts."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def wait_for_work(process: subprocess.Popen, seconds: float) -> None:
    """Wait until a process has computed for some seconds, however busy the machine is."""
    stat, begin = Path(f"/proc/{process.pid}/stat"), time.monotonic()
    while stat.exists() and time.monotonic() < begin + 60.0:
        fields = stat.read_text().rpartition(")")[2].split()
        if sum(map(int, fields[11:13])) >= seconds * os.sysconf("SC_CLK_TCK"):
            return
        time.sleep(0.1)
    if not stat.exists():  # no such file system: by the clock
        time.sleep(seconds)


def hydrotele_run(*words, **facts) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of the real program."""
    process = hydrotele_process(*words, **facts)
    out, err = process.communicate(timeout=120)
    return process.returncode, out, err


def child_seconds() -> float:
    """Processor time of all ended processes that this one started."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def invoke(*words):
    """The same in this process, without the start-up time; `main` turns InputError into 2."""
    result = CliRunner().invoke(cli.app, [str(w) for w in words])
    if isinstance(result.exception, InputError):
        return 2, result.stdout, str(result.exception)
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory):
    """A run folder, the program's output and its processor time [s], made once by the program."""
    folder = tmp_path_factory.mktemp("runs") / "zhu_up"
    before = child_seconds()
    code, out, err = hydrotele_run("run", "zhu_up", "--set", "duration=0.5", "--json", "--out", folder)
    assert code == 0, err
    return folder, out, child_seconds() - before


@pytest.fixture
def finished(finished_run):
    return finished_run[0]


def test_overview_lists_every_command_with_the_first_paragraph_of_its_help():
    commands = typer.main.get_command(cli.app).commands
    assert set(SUMMARIES) == set(commands)
    for name, command in commands.items():
        assert " ".join(command.help.partition("\n\n")[0].split()) == SUMMARIES[name]


@pytest.mark.parametrize("width", [50, 80, 200])
def test_overview_fits_the_terminal(width):
    lines = format_program_help(width).splitlines()
    assert max(map(len, lines)) <= width
    assert all(any(line.startswith(f"  {name} ") for line in lines) for name in SUMMARIES)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_has_an_example(command):
    code, out, _ = invoke(command, "--help")
    assert code == 0 and "Example" in out and f"hydrotele {command}" in " ".join(out.split())


def test_overview_imports_nothing_but_the_standard_library():
    """`--help` is fast because neither typer nor what the commands need is imported."""
    script = f"""if True:
        import sys
        from hydrotele.cli.start import main
        sys.argv = ["hydrotele", "--help"]
        main()
        print([m for m in {HEAVY} if m in sys.modules], file=sys.stderr)
    """
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True)
    assert found.stderr.strip() == "[]" and found.stdout == f"{format_program_help(80)}\n"


def test_version():
    assert invoke("--version") == (0, f"{hydrotele.__version__}\n", "")


@pytest.mark.parametrize("words", [["nonsense"], ["run"], ["run", "zhu_up", "--colour"], []])
def test_wrong_usage_exits_with_two(words):
    code, out, err = invoke(*words)
    assert code == 2 and "Usage" in out + err


@pytest.mark.nightly
def test_errors_of_the_user_exit_with_two_and_no_traceback(tmp_path):
    code, out, err = hydrotele_run("run", "zhu_upp", cwd=tmp_path)
    assert code == 2 and out == "" and "did you mean 'zhu_up'" in err and "Traceback" not in err
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "zhu_up", "--set", "seed"], "must be key=value"),
        (["run", "zhu_up", "--set", "=1"], "must be key=value"),
        (["run", "zhu_up", "--set", "sed=1"], "unknown key 'sed'; did you mean 'seed'"),
        (["run", "zhu_up", "--set", "duration=-1"], "duration"),
        (["replay", "no.parquet"], "no.parquet: does not exist"),
        (["replay", "."], "contains no log"),
        (["list", "machine"], "did you mean 'machines'"),
        (["validate", "zhu_upp"], "did you mean 'zhu_up'"),
        (["export", "cat216"], "did you mean 'cat215'"),
        (["export", "cat215", "--tool", "spoon"], "no tool 'spoon'; .*bucket"),
        (["review", "no.parquet"], "no.parquet: does not exist"),
        (["validate", "no.csv"], "no.csv: does not exist"),
        (["review", "no.rrd"], "no.rrd: does not exist"),
    ],
)
def test_errors_of_the_user(words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = invoke(*words)
    assert code == 2 and re.search(message, err) and out == "" and names(tmp_path) == []


def test_failed_simulation_exits_with_three(monkeypatch, capsys, tmp_path):
    from hydrotele.simulate.record import SimulationFailed

    def fail(*_):
        raise SimulationFailed("it went wild at 0.1 s")

    monkeypatch.setattr("hydrotele.cli.run_command.run_scenario", fail)
    monkeypatch.setattr(sys, "argv", ["hydrotele", "run", "zhu_up", "--out", str(tmp_path / "a")])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 3
    assert "simulation failed: it went wild at 0.1 s" in capsys.readouterr().err
    assert names(tmp_path) == []


def test_other_runtime_errors_are_not_hidden(monkeypatch):
    def fail(*_):
        raise RuntimeError("a mistake of ours")

    monkeypatch.setattr("hydrotele.cli.list_command.list_items", fail)
    monkeypatch.setattr(sys, "argv", ["hydrotele", "list"])
    with pytest.raises(RuntimeError, match="a mistake of ours"):
        cli.main()


def test_run_writes_everything_that_is_promised(finished_run):
    folder, out, _ = finished_run
    summary = json.loads(out)  # and nothing else on stdout
    assert summary["scenario"] == "zhu_up" and summary["folder"] == str(folder)
    assert names(folder) == [
        "machine.xml", "machine.yaml", "measured.parquet", "review.rrd", "scenario.yaml",
        "summary.json", "truth.parquet",
    ]  # fmt: skip
    kept = json.loads((folder / "summary.json").read_text())
    assert {**kept, "folder": summary["folder"]} == summary
    assert {"versions", "seed", "git_commit", "realtime_factor", "max_pin_opening_mm",
            "balance"} <= kept.keys()  # fmt: skip


def test_default_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert invoke("run", "hold", *QUICK)[0] == 0
    assert names(tmp_path) == ["runs"] and names(tmp_path / "runs") == ["hold"]


def test_run_from_its_own_folder_gives_the_same_logs(finished, tmp_path):
    """The resolved scenario that a run writes is complete."""
    assert invoke("run", finished / "scenario.yaml", "--no-review", "--out", tmp_path / "b")[0] == 0
    for name in ("measured.parquet", "truth.parquet"):
        assert (finished / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_exported_mjcf_is_the_machine_of_the_run(finished):
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(finished / "machine.xml"))
    assert model.nu == 4 and model.key("home").id == 0


def test_run_replaces_its_own_folder_and_refuses_others(finished, tmp_path):
    target = tmp_path / "a"
    for seed in ("1", "2"):
        words = ["run", "zhu_up", *QUICK, "--set", f"seed={seed}", "--out", target]
        assert invoke(*words)[0] == 0
    assert json.loads((target / "summary.json").read_text())["seed"] == 2
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years")
    for foreign in (tmp_path / "mine", tmp_path / "mine" / "thesis.txt"):
        code, _, err = invoke("run", "zhu_up", *QUICK, "--out", foreign)
        assert code == 2 and "not written by a run" in err
    assert names(tmp_path) == ["a", "mine"] and names(tmp_path / "mine") == ["thesis.txt"]


def test_run_that_cannot_write_says_so_before_it_simulates(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("hydrotele.cli.run_command.run_scenario", None)  # must not be reached
    code, _, err = invoke("run", "zhu_up", "--out", tmp_path / "file" / "run")
    assert code == 2 and "cannot be created" in err
    monkeypatch.setattr(os, "access", lambda *_: False)
    code, _, err = invoke("run", "zhu_up", "--out", tmp_path / "run")
    assert code == 2 and "is not a writable folder" in err


@pytest.mark.parametrize("broken", ["save_scenario", "save_machine", "save_log"])
def test_full_disk_leaves_nothing(broken, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(f"hydrotele.cli.run_command.{broken}", full)
    code, _, err = invoke("run", "zhu_up", *QUICK, "--out", tmp_path / "run")
    assert code == 2 and "No space left on device" in err and names(tmp_path) == []


@pytest.mark.nightly
@pytest.mark.parametrize("attempts", [2, pytest.param(10, marks=pytest.mark.nightly)])
def test_killed_runs_leave_no_folder_of_the_final_name(attempts, tmp_path):
    """SIGKILL at seeded times, every second time while writing; the next run removes the rest."""
    rng = random.Random(4)
    words = ["run", "zhu_up", "--set", "duration=0.5", "--out", tmp_path / "run"]
    seen_part = False
    for attempt in range(attempts):
        process = hydrotele_process(*words)
        if attempt % 2:  # kill it in the middle of writing
            while process.poll() is None and not list(tmp_path.glob(".run.*.part")):
                time.sleep(0.002)
            time.sleep(rng.uniform(0.0, 0.05) if attempt > 1 else 0.0)
        else:
            time.sleep(rng.uniform(0.1, 1.0))
        process.kill()
        process.communicate()
        left = names(tmp_path)
        if process.returncode != -signal.SIGKILL:  # it was faster
            assert left == ["run"]
            continue
        seen_part |= any(n.endswith(".part") for n in left)
        assert "run" not in left or len(names(tmp_path / "run")) == 7
    assert seen_part
    assert invoke(*words, "--no-review")[0] == 0
    assert names(tmp_path) == ["run"]


@pytest.mark.nightly
def test_interrupt_exits_with_130_and_leaves_nothing(finished_run, tmp_path):
    process = hydrotele_process("run", "hold", "--set", "duration=3000", "--no-review", "--out", tmp_path / "run")
    # A whole short run takes longer than the start of this one, whose simulation takes 30 s.
    wait_for_work(process, finished_run[2])
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in err and names(tmp_path) == []


@pytest.mark.nightly
@pytest.mark.parametrize(
    "words",
    [
        ["list"],
        ["export", "rig"],
        pytest.param(["export", "cat215"], marks=pytest.mark.nightly),
        pytest.param(["list", "--json"], marks=pytest.mark.nightly),
    ],
)
def test_closed_output_is_no_traceback(words):
    process = hydrotele_process(*words)
    process.stdout.close()  # as `| head -1` does
    err = process.stderr.read()
    process.wait(timeout=60)
    process.stderr.close()
    assert "Traceback" not in err and "Exception ignored" not in err


def test_replay_json_is_what_scripts_were_promised(finished):
    code, out, err = invoke("replay", finished, "--json")
    found = json.loads(out)
    assert code == 0 and {"channels", "realtime_factor"} <= found.keys()
    assert set(found) <= {"channels", "realtime_factor", "log", "machine"}
    assert found["realtime_factor"] > 0 and "angle.boom" in found["channels"]
    for channel, facts in found["channels"].items():
        assert set(facts) == {"rms", "max", "unit", "range", "noise_rms"}, channel
        assert all(isinstance(facts[k], float) for k in ("rms", "max", "range", "noise_rms"))
        assert 0 <= facts["rms"] <= facts["max"] and facts["unit"] in ("rad", "m", "Pa")
        assert facts["noise_rms"] > 0


def test_replay_of_several_logs_is_a_list(finished):
    code, out, _ = invoke("replay", finished, finished / "truth.parquet", "--json")
    logs = [entry["log"] for entry in json.loads(out)]
    assert code == 0
    assert logs == [str(finished / "measured.parquet"), str(finished / "truth.parquet")]


def test_replay_with_another_machine_of_the_same_axes(finished, tmp_path):
    from hydrotele.effects import apply_effect
    from hydrotele.machine.machine_file import load_machine, save_machine

    patched = apply_effect(load_machine("cat215", "bucket"), "payload", "tool", {"mass": 2000.0})
    save_machine(patched, tmp_path / "machine.yaml")
    code, out, _ = invoke("replay", finished, "--machine", tmp_path / "machine.yaml", "--json")
    assert code == 0 and json.loads(out)["machine"] == "cat215"
    plain = json.loads(invoke("replay", finished, "--json")[1])["channels"]["angle.boom"]["rms"]
    assert json.loads(out)["channels"]["angle.boom"]["rms"] > 2 * plain


def test_replay_with_a_named_machine_keeps_the_logs_tool(finished):
    """A log of the bucket machine is not replayed without its bucket."""
    own = json.loads(invoke("replay", finished, "--json")[1])["channels"]
    named = json.loads(invoke("replay", finished, "--machine", "cat215", "--json")[1])["channels"]
    assert named == own and "angle.bucket" in named


def test_replay_prints_a_table_and_writes_into_runs_by_default(finished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = invoke("replay", finished / "measured.parquet")
    assert code == 0 and "angle.boom" in out and "deg" in out
    made = names(tmp_path / "runs" / "replay_measured")
    assert any(n.endswith(".png") for n in made) and any(n.endswith(".rrd") for n in made)
    assert json.loads((tmp_path / "runs/replay_measured/summary.json").read_text())["kind"] == ("replay")
    assert (finished / "measured.parquet").is_file()


def test_replay_does_not_replace_the_run_that_it_reads(finished):
    before = names(finished)
    code, _, err = invoke("replay", finished, "--out", finished)
    assert code == 2 and "was not written by a replay" in err and names(finished) == before


def test_planted_effects_stay_out_of_the_runs_model(tmp_path):
    """What was planted is truth: a replay of the run folder shows the gap."""
    effect = "effects=[{name: payload, location: tool, parameters: {mass: 2000}}]"
    words = ["run", "zhu_up", *QUICK, "--set", effect, "--out", tmp_path / "heavy", "--json"]
    code, out, _ = invoke(*words)
    assert code == 0 and json.loads(out)["effects"][0]["name"] == "payload"
    assert "payload" not in (tmp_path / "heavy" / "machine.yaml").read_text()
    channel = json.loads(invoke("replay", tmp_path / "heavy", "--json")[1])["channels"]
    assert channel["pressure_head.boom"]["rms"] > 5 * channel["pressure_head.boom"]["noise_rms"]


def test_a_run_of_ones_own_machine_can_be_handed_on(tmp_path):
    """The run folder works where the machine's folder does not exist."""
    shutil.copytree(models_folder() / "rig", tmp_path / "mine")
    text = (scenarios_folder() / "rig_steps.yaml").read_text()
    (tmp_path / "s.yaml").write_text(text.replace("machine: rig", "machine: mine"))
    assert invoke("run", tmp_path / "s.yaml", *QUICK, "--out", tmp_path / "run")[0] == 0
    shutil.rmtree(tmp_path / "mine")
    code, out, _ = invoke("replay", tmp_path / "run", "--json")
    assert code == 0 and "position.slide" in json.loads(out)["channels"]


def test_review_refuses_a_log_of_another_machine(finished):
    code, _, err = invoke("review", finished, "--machine", "rig", "--plot", "x.png")
    assert code == 2 and "is a log of the machine 'cat215', the model is 'rig'" in err


def test_validate_reports_every_file(tmp_path):
    (tmp_path / "bad.yaml").write_text("name: x\npilot: 3\n")
    code, out, err = invoke("validate", tmp_path / "bad.yaml", "zhu_up", "--json")
    found = json.loads(out)
    assert code == 2 and [entry["valid"] for entry in found] == [False, True] and "bad.yaml" in err


LISTS = ["machines", "joysticks", "scenarios", "sweeps", "effects", "environments"]


@pytest.fixture(scope="module")
def whole_list():
    return json.loads(invoke("list", "--json")[1])


@pytest.mark.parametrize("what", LISTS)
def test_list(what, whole_list):
    code, out, _ = invoke("list", what, "--json")
    rows = json.loads(out)
    assert code == 0 and len(rows) >= (1 if what in ("joysticks", "sweeps", "environments") else 4)
    assert whole_list[what] == rows and list(whole_list) == LISTS
    code, text, _ = invoke("list", what)
    assert code == 0 and all(re.search(rf"^  {row['name']}(  |$)", text, re.MULTILINE) for row in rows)


@pytest.mark.parametrize("width", [40, 80, 200])
def test_summary_of_the_list_is_short_and_has_whole_names(width, whole_list):
    every = {kind: [row["name"] for row in rows] for kind, rows in whole_list.items()}
    lines = format_name_lists(every, width).splitlines()
    assert len(lines) <= 31
    shown = set(" ".join(lines).replace(",", " ").split())
    known = {name for some in every.values() for name in some}
    for kind, some in every.items():
        count = sum(name in shown for name in some)
        left = re.search(rf"and (\d+) more \(hydrotele list {kind}\)", " ".join(" ".join(lines).split()))
        assert count + int(left[1] if left else 0) == len(some)
    if width >= 80:
        assert known <= shown


def test_list_without_a_kind_is_the_summary(whole_list, monkeypatch):
    monkeypatch.setattr("hydrotele.cli.list_command.stdout_console.width", 80)
    code, out, _ = invoke("list")
    assert code == 0 and len(out.splitlines()) <= 31
    assert all(row["name"] in out for rows in whole_list.values() for row in rows)


def test_long_name_is_not_broken():
    name = "hydrotele/" + "a" * 60 + "-v0"
    text = format_items("environments", [{"name": name, "what": "a task", "reward": "x " * 30}], 50)
    assert text.splitlines()[1] == f"  {name}" and "reward: x" in text


@pytest.mark.nightly
def test_quiet_prints_the_result_only(finished, tmp_path):
    code, out, err = invoke("--quiet", "review", finished, "--plot", tmp_path / "a.png")
    assert (code, err) == (0, "") and "written to" in out
    _, out, err = invoke("review", finished, "--plot", tmp_path / "a.png")
    assert "making the plot" in err and "written to" in out
    _, out, err = invoke("review", finished, "--plot", tmp_path / "b.png", "--quiet")
    assert err == "" and "written to" in out
    _, _, err = invoke("review", finished, "--plot", tmp_path / "c.png")
    assert "making the plot" in err  # the next call is not quiet


def test_review_writes_every_file_that_is_named(finished, tmp_path, monkeypatch):
    shots = []

    def take(recording, png, displayed_time):
        shots.append((recording, displayed_time))
        png.write_bytes(b"")
        return ()

    monkeypatch.setattr("hydrotele.show.rerun_viewer.take_screenshot", take)
    files = [tmp_path / name for name in ("a.png", "b.png", "c.rrd")]
    options = ["--plot", files[0], "--screenshot", files[1], "--at", 0.25, "--out", files[2]]
    code, out, _ = invoke("review", finished, *options)
    assert code == 0 and all(file.is_file() for file in files) and out.count("written to") == 3
    assert shots == [(files[2], 0.25)]
    code, _, err = invoke("review", finished, "--at", 0.25)
    assert code == 2 and err == "--at: sets the time of the screenshot: give --screenshot FILE.png as well"
    code, _, err = invoke("review", finished, "--video", tmp_path / "a.avi")
    assert code == 2 and err.endswith("a.avi: the name must end in .mp4")


def test_help_prints_units_in_brackets():
    assert "displayed time [s]" in " ".join(invoke("review", "--help")[1].split())


def test_a_joystick_is_validated_and_exported(tmp_path):
    import mujoco

    from hydrotele.core.files import models_folder

    for name in ("joystick.yaml", "joystick.xml"):
        shutil.copy(models_folder() / "joystick" / name, tmp_path / name)
    own = tmp_path / "joystick.yaml"
    code, out, _ = invoke("validate", "joystick", tmp_path, own)
    assert code == 0 and out.count("valid joystick") == 3 and "levitates with 0.35 of 4 A" in out
    own.write_text(own.read_text().replace("mass: 0.85", "mass: 85.0"))
    code, _, err = invoke("validate", own)
    assert code == 2 and "does not levitate stably" in err
    code, out, _ = invoke("export", "joystick")
    assert code == 0 and mujoco.MjModel.from_xml_string(out).nu == 6
    assert invoke("export", "joystick", "--tool", "bucket")[0] == 2
    code, _, err = invoke("validate", "joystik")
    assert code == 2 and "did you mean 'joystick'" in err


def test_validate_takes_everything(finished, tmp_path):
    (tmp_path / "log.csv").write_text("\n".join(["time,angle.boom", *(f"{k / 50},0.{k}" for k in range(10, 40))]))
    files = ["cat215", "zhu_up", finished, finished / "scenario.yaml", finished / "machine.yaml",
             finished / "truth.parquet", tmp_path / "log.csv"]  # fmt: skip
    code, out, _ = invoke("validate", *files, "--json")
    kinds = [entry["kind"] for entry in json.loads(out)]
    assert code == 0
    assert kinds == ["machine", "scenario", "log", "scenario", "machine", "log", "log"]
    assert all(entry["valid"] for entry in json.loads(out))
    code, out, _ = invoke("validate", "rig", "dig")
    assert code == 0 and out.count("valid") == 2


def test_validate_refuses_what_does_not_run(tmp_path):
    (tmp_path / "s.yaml").write_text("name: s\nduration: 1\npilot: {kind: constant, commands: {bom: 1}}\n")
    code, out, err = invoke("validate", tmp_path / "s.yaml")
    assert code == 2 and "did you mean 'boom'" in err
    (tmp_path / "machine.yaml").write_text("name: m\nlinks: {}\naxes: {}\n")
    (tmp_path / "x.yaml").write_text("pilot: 3\n")
    for name in ("x.yaml", "none.yaml"):
        assert invoke("validate", tmp_path / name)[0] == 2


def test_export_is_mjcf(tmp_path):
    import mujoco

    code, out, _ = invoke("export", "rig")
    assert code == 0 and mujoco.MjModel.from_xml_string(out).nu == 1
    assert invoke("export", "rig", "--out", tmp_path / "rig.xml")[0] == 0
    assert (tmp_path / "rig.xml").read_text().strip() == out.strip() and names(tmp_path) == ["rig.xml"]


def test_a_library_that_makes_another_error_of_sigterm_changes_no_exit_status():
    """As dm_control's parser does with whatever is raised while it reads an element."""
    code = """if True:
        import os, signal, time
        from hydrotele.cli import main as cli
        def app():
            try:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(5.0)
            except BaseException as error:
                raise type(error)(f"Line 3: {error}")
        cli.app = app
        cli.main()
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stderr) == (143, "")
