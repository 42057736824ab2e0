"""Implement `hydrotele replay`: simulate a machine with the commands of a log and compare the result with the log."""

import dataclasses
from pathlib import Path

from hydrotele.cli.console import (
    announce_output,
    make_table,
    print_json,
    print_notes,
    show_simulation_progress,
    stderr_console,
    stdout_console,
    write_json,
)
from hydrotele.cli.input_logs import OpenedLogs, open_logs
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.logs.dataset import make_complete_logs
from hydrotele.logs.log import Log, save_log
from hydrotele.logs.run_files import check_commands
from hydrotele.run.replay import Replay, replay_log
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock

_MIN_REPLAY_ROWS = 10  # minimum number of rows of a log
_DISPLAY_UNITS = {"rad": ("deg", 57.29577951308232), "m": ("mm", 1e3), "Pa": ("kPa", 1e-3)}


def replay_logs(
    paths: list[Path], machine: str | None, tool: str | None, timestep: float, target: Path | None,
    as_json: bool, force: bool = False,
) -> None:  # fmt: skip
    """Simulate a machine with the commands of logs; print the differences from the measurements.

    Args:
        paths: log files, folders of logs, run folders.
        machine: machine to simulate, None for the machine of each log.
        tool: tool of the machine, None for that of the log.
        timestep: simulation time step [s].
        target: folder for plots and recordings, default `runs/replay_<log>`, or none with
            `as_json`.
        as_json: print JSON: one object for one log, a list for several.
        force: accept logs whose metadata names another machine or tool.

    Raises:
        InputError: a log or machine is not usable.
    """
    if target is None and not as_json:
        name = paths[0].resolve().name if paths[0].is_dir() else paths[0].stem
        target = Path("runs", f"replay_{name}" if len(paths) == 1 else "replay_logs")
    if target:
        check_output_folder(target, "replay")
    stop_profiling_clock()
    results = []
    for path in paths:
        opened = open_logs([path], machine, tool, force)
        print_notes(opened.notes)
        for log in _replayable_logs(opened):
            with show_simulation_progress(f"replay {log.name}", quiet=as_json) as progress:
                result = replay_log(log, opened.machine, timestep, progress)
            results.append((opened.machine, result))
            if log.metadata.get("command", "held") != "held":
                print_notes([
                    f"{log.source}: the commands changed faster than the log rate, so their"
                    " means are replayed; log with log_rate = control_rate for an exact replay"
                ])  # fmt: skip
            if not as_json:
                _print(log.source, result)
    if target:
        with atomic_folder(target, "replay") as folder:
            for number, (the_machine, result) in enumerate(results):
                prefix = f"{number}_" if len(results) > 1 else ""
                name = prefix + result.measured.name
                with announce_output(f"plot and recording of {result.measured.name}", None, quiet=as_json):
                    _write_replay_files(folder, name, the_machine, result)
            data = {"kind": "replay", "replays": [replay_to_dict(result) for _, result in results]}
            write_json(folder / "summary.json", data)
        stderr_console.print(f"written to {target}")
    if as_json:
        data = [replay_to_dict(result) for _, result in results]
        print_json(data[0] if len(data) == 1 else data)


def _replayable_logs(opened: OpenedLogs) -> list[Log]:
    """Return logs of the runs that have at least 10 rows, as one log per run or piece of an interrupted run.

    Shorter ones are omitted, with a note on stderr.

    Raises:
        InputError: a run has no command of an axis.
    """
    for run in opened.runs:
        check_commands(run, opened.machine)
    logs = make_complete_logs(opened.runs, opened.merged, opened.machine)
    for log in logs:
        if len(log) < _MIN_REPLAY_ROWS:
            print_notes([f"{log.name} has only {len(log)} rows; it is not replayed."])
    return [log for log in logs if len(log) >= _MIN_REPLAY_ROWS]


def replay_to_dict(result: Replay) -> dict:
    """Return a replay as JSON data: log, machine, prediction errors of each channel, real-time factor."""
    return {
        "log": result.measured.source,
        "machine": result.simulated.metadata["machine"],
        "channels": {n: dataclasses.asdict(c) for n, c in result.channels.items()},
        "realtime_factor": result.realtime_factor,
    }


def _print(source: str, result: Replay) -> None:
    title = f"{source}: prediction errors (lower is better), {result.realtime_factor:.0f} x real time"
    rows = make_table(title, "channel", "RMS", "max", "unit", "RMS / range", "RMS / noise")
    for name, c in result.channels.items():
        unit, factor = _DISPLAY_UNITS.get(c.unit, (c.unit, 1.0))
        share = f"{100 * c.rms / c.range:.3f} %" if c.range else "-"
        noise = f"{c.rms / c.noise_rms:.2f}" if c.noise_rms else "-"
        rows.add_row(name, f"{c.rms * factor:.4g}", f"{c.max * factor:.4g}", unit, share, noise)
    stdout_console.print(rows)


def _write_replay_files(folder: Path, name: str, machine, result: Replay) -> None:
    from hydrotele.show.log_plots import plot_overlay
    from hydrotele.show.recording import write_recording

    save_log(result.simulated, folder / f"{name}_simulated.parquet")
    run = result.measured.metadata.get("run", name)
    title = f"{machine.name}, {run}: measured and replayed"
    plot_overlay(result.measured, result.simulated, folder / f"{name}.png", title=title)
    entries = {
        "measured": (machine, result.measured.without_truth()),
        "simulated": (machine, result.simulated.without_truth()),
    }
    write_recording(folder / f"{name}.rrd", entries)
