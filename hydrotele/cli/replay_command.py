"""Implement `hydrotele replay`: simulate a machine with the commands of a log and compare the result with the log."""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

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
from hydrotele.cli.input_logs import OpenedLogs, find_corrected_machine_folder, open_logs
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.gap.bands import MIN_SAMPLES, BandSummary, prediction_band, sample_machines, summarise_band
from hydrotele.gap.posterior import Posterior, read_posterior
from hydrotele.logs.dataset import make_complete_logs
from hydrotele.logs.log import Log, save_log
from hydrotele.logs.run_files import check_commands
from hydrotele.machine.machine import Machine
from hydrotele.run.replay import Replay, replay_log
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock
from hydrotele.simulate.record import SimulationFailed

_MIN_REPLAY_ROWS = 10  # minimum number of rows of a log
_DISPLAY_UNITS = {"rad": ("deg", 57.29577951308232), "m": ("mm", 1e3), "Pa": ("kPa", 1e-3)}


def replay_logs(
    paths: list[Path], machine: str | None, tool: str | None, timestep: float, target: Path | None,
    as_json: bool, force: bool = False, bands: int = 0,
) -> None:  # fmt: skip
    """Simulate a machine with the commands of logs; print the differences from the measurements.

    Args:
        paths: log files, folders of logs, run folders.
        machine: machine to simulate, or a result folder of `gap` or `identify`; None for the machine of each log.
        tool: tool of the machine, None for that of the log.
        timestep: simulation time step [s].
        target: folder for plots and recordings, default `runs/replay_<log>`, or none with
            `as_json`.
        as_json: print JSON: one object for one log, a list for several.
        force: accept logs whose metadata names another machine or tool.
        bands: number of machines sampled from the posterior of a result folder of `gap`, for prediction bands.

    Raises:
        InputError: a log or machine is not usable.
    """
    posterior, sampled = None, []
    if bands:
        if machine is None:
            raise InputError(f"--bands {bands}", "needs --machine with a result folder of `hydrotele gap`")
        posterior = read_posterior(machine)
        sampled = sample_machines(posterior, bands)
    machine = machine and find_corrected_machine_folder(machine)
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
            band = None
            if posterior and result.channels:
                with show_simulation_progress(f"bands of {log.name}", quiet=as_json) as progress:
                    band = compute_replay_band(result, posterior, sampled, timestep, progress)
            results.append((opened.machine, result, band))
            if log.metadata.get("command", "held") != "held":
                print_notes([
                    f"{log.source}: the commands changed faster than the log rate, so their"
                    " means are replayed; log with log_rate = control_rate for an exact replay"
                ])  # fmt: skip
            if not as_json:
                _print(log.source, result, band)
    if target:
        with atomic_folder(target, "replay") as folder:
            for number, (the_machine, result, band) in enumerate(results):
                prefix = f"{number}_" if len(results) > 1 else ""
                name = prefix + result.measured.name
                with announce_output(f"plot and recording of {result.measured.name}", None, quiet=as_json):
                    _write_replay_files(folder, name, the_machine, result, band)
            data = {"kind": "replay", "replays": [replay_to_dict(result, band) for _, result, band in results]}
            write_json(folder / "summary.json", data)
        stderr_console.print(f"written to {target}")
    if as_json:
        data = [replay_to_dict(result, band) for _, result, band in results]
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


class ReplayBand(NamedTuple):
    """Prediction band of a replay.

    Attributes:
        samples: number of sampled machines.
        summaries: channel -> band width and fraction of measured values inside, each (1,).
        limits: lower and upper limits, with measurement noise.
    """

    samples: int
    summaries: dict[str, BandSummary]
    limits: tuple[Log, Log]


def compute_replay_band(
    result: Replay, posterior: Posterior, machines: Sequence[Machine], timestep: float, progress: Callable | None
) -> ReplayBand:
    """Replay a log with sampled machines and compute the 95 % band of the compared channels.

    Args:
        result: replay of the log with the corrected machine.
        posterior: the samples, for the noise of the readings.
        machines: the s sampled machines.
        timestep: largest physics step [s].
        progress: callback (simulated seconds, total seconds).

    Raises:
        InputError: the log cannot be replayed with a sampled machine.
        SimulationFailed: the simulations of all sampled machines but one diverged.
    """
    log, columns = result.measured, []
    span = float(log.time[-1] - log.time[0])
    names = list(result.channels)
    for number, machine in enumerate(machines):
        with contextlib.suppress(SimulationFailed):
            simulated = replay_log(log, machine, timestep).simulated
            columns.append(np.column_stack([simulated[name] for name in names]))
        if progress:
            progress(span * (number + 1) / len(machines), span)
    diverged = len(machines) - len(columns)
    if len(columns) < MIN_SAMPLES:
        raise SimulationFailed(f"{diverged} of {len(machines)} sampled machines diverged: no band can be computed")
    if diverged:
        print_notes([f"{diverged} of {len(machines)} sampled machines diverged; the band is that of the others."])
    exact = any(name.startswith("truth.") for name in log.columns)  # true values have no noise
    noise = [0.0 if exact else posterior.noise.get(name, c.noise_rms) for name, c in result.channels.items()]
    band = prediction_band(np.array(columns), np.array(noise))
    measured = np.column_stack([log[name] for name in names])
    whole = summarise_band([band], [measured], diverged)
    each = {n: BandSummary(whole.width[k : k + 1], whole.inside[k : k + 1]) for k, n in enumerate(names)}
    units = {name: result.simulated.units[name] for name in names}
    low, high = (
        dataclasses.replace(result.simulated, columns=dict(zip(names, side.T, strict=True)), units=units)
        for side in (band.low, band.high)
    )
    return ReplayBand(len(columns), each, (low, high))


def replay_to_dict(result: Replay, band: ReplayBand | None = None) -> dict:
    """Return a replay as JSON data: log, machine, prediction errors and band of each channel, real-time factor."""
    channels = {n: dataclasses.asdict(c) for n, c in result.channels.items()}
    if band:
        for name, b in band.summaries.items():
            own = {"width": float(b.width[0]), "inside": float(b.inside[0]), "samples": band.samples}
            channels[name]["band"] = own
    return {
        "log": result.measured.source,
        "machine": result.simulated.metadata["machine"],
        "channels": channels,
        "realtime_factor": result.realtime_factor,
    }


def _print(source: str, result: Replay, band: ReplayBand | None = None) -> None:
    title = f"{source}: prediction errors (lower is better), {result.realtime_factor:.0f} x real time"
    more = ()
    if band:
        title += f"; 95 % band of {band.samples} sampled machines: parameter uncertainty and noise, no missing laws"
        more = ("band width, RMS", "inside band")
    rows = make_table(title, "channel", "RMS", "max", "unit", "RMS / range", "RMS / noise", *more)
    for name, c in result.channels.items():
        unit, factor = _DISPLAY_UNITS.get(c.unit, (c.unit, 1.0))
        share = f"{100 * c.rms / c.range:.3f} %" if c.range else "-"
        noise = f"{c.rms / c.noise_rms:.2f}" if c.noise_rms else "-"
        b = band.summaries[name] if band else None
        cells = (f"{b.width[0] * factor:.4g}", f"{100 * b.inside[0]:.1f} %") if b else ()
        rows.add_row(name, f"{c.rms * factor:.4g}", f"{c.max * factor:.4g}", unit, share, noise, *cells)
    stdout_console.print(rows)


def _write_replay_files(folder: Path, name: str, machine, result: Replay, band: ReplayBand | None) -> None:
    from hydrotele.show.log_plots import plot_overlay
    from hydrotele.show.recording import write_recording

    save_log(result.simulated, folder / f"{name}_simulated.parquet")
    run = result.measured.metadata.get("run", name)
    title = f"{machine.name}, {run}: measured and replayed"
    limits = band.limits if band else None
    plot_overlay(result.measured, result.simulated, folder / f"{name}.png", title=title, band=limits)
    entries = {
        "measured": (machine, result.measured.without_truth()),
        "simulated": (machine, result.simulated.without_truth()),
    }
    write_recording(folder / f"{name}.rrd", entries)
