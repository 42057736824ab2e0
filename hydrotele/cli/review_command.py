"""Implement `hydrotele review`: show one or two logs in the rerun viewer or draw their channels."""

import contextlib
import re
import tempfile
from pathlib import Path
from typing import NamedTuple

from hydrotele.cli.console import (
    announce_output,
    print_notes,
    show_simulation_progress,
    stderr_console,
    stdout_console,
)
from hydrotele.cli.input_logs import find_recording, find_run_log, open_single_log
from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log, find_log_in_folder
from hydrotele.logs.run_files import align_time_origins
from hydrotele.machine.machine import Machine


class ReviewOutputs(NamedTuple):
    """Files and views that `hydrotele review` makes; None for those that are not requested.

    Attributes:
        recording: rerun recording.
        screenshot: PNG of the viewer, without opening a window.
        displayed_time: time in the screenshot [s], None for the middle of the log.
        plot: PNG of all channels of one log, or of both logs and their difference.
        video: MP4 of the machine.
        port: port of the web viewer, which is served until the user interrupts it.
    """

    recording: Path | None = None
    screenshot: Path | None = None
    displayed_time: float | None = None
    plot: Path | None = None
    video: Path | None = None
    port: int | None = None


def review_logs(
    first: Path, second: Path | None, machine: str | None, tool: str | None, outputs: ReviewOutputs,
    force: bool = False,
) -> None:  # fmt: skip
    """Show one or two logs, or an existing recording, in the rerun viewer, or write the requested files.

    Args:
        first: log file, folder with one log, run folder, recording, or result folder with a recording.
        second: second log with the same time base, or None.
        machine: machine of both logs, None to find it by the logs.
        tool: tool of the machine.
        outputs: files to write; without any, the viewer is opened.
        force: accept logs whose metadata names another machine or tool.

    Raises:
        InputError: a log, machine or viewer is not usable.
    """
    recording, screenshot, time, plot, video, port = outputs
    for path, suffix in ((recording, ".rrd"), (screenshot, ".png"), (plot, ".png"), (video, ".mp4")):
        if path and path.suffix.lower() != suffix:
            raise InputError(path, f"the name must end in {suffix}")
    if time is not None and not screenshot:
        raise InputError("--at", "sets the time of the screenshot: give --screenshot FILE.png as well")
    if plot:
        with announce_output("plot", plot):
            _plot(first, second, machine, tool, plot, force)
    if video:
        _write_video_of_log(first, second, machine, tool, video, force)
    if (plot or video) and not (recording or screenshot or port is not None):
        return
    with contextlib.ExitStack() as stack:
        made = None if any((second, recording, machine, tool)) else find_recording(first)
        if made is None:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="hydrotele_"))
            made = recording or Path(folder, "review.rrd")
            with announce_output("recording", recording):
                _record(first, second, machine, tool, made, force)
        _show(made, outputs)


def _show(made: Path, outputs: ReviewOutputs) -> None:
    """Take the requested screenshot of a recording, and serve the recording if a port is given.

    If neither a file nor a port was requested, the viewer is opened.

    Args:
        made: recording file.
        outputs: requested files and views.

    Raises:
        InputError: the viewer cannot be run.
    """
    if outputs.screenshot:
        from hydrotele.show.rerun_viewer import take_screenshot

        with announce_output("screenshot", outputs.screenshot):
            complaints = take_screenshot(made, outputs.screenshot, displayed_time=outputs.displayed_time)
        for complaint in complaints:
            stderr_console.print(f"[yellow]viewer[/] {complaint}", soft_wrap=True)
    if outputs.port is not None:
        from hydrotele.show.rerun_viewer import serve_recording

        tell = "open {} in a browser on this computer; Ctrl-C stops the server"
        serve_recording(made, outputs.port, lambda url: stdout_console.print(tell.format(url), soft_wrap=True))
    elif not (outputs.recording or outputs.screenshot):
        from hydrotele.show.rerun_viewer import open_viewer

        if open_viewer(made):
            message = "no viewer can be opened on this computer; try --serve or --screenshot PNG"
            raise InputError("review", message)


def _write_video_of_log(first, second, machine, tool, path: Path, force: bool) -> None:
    from hydrotele.show.video import write_video

    if second is not None:
        raise InputError("--video", "shows one log: omit the second log")
    found, log = _open_log(find_run_log(first, _choose_log_name(first)), machine, tool, force)
    with show_simulation_progress(f"video {path.name}") as progress:
        write_video(found, log, path, progress=progress)
    stdout_console.print(f"written to [bold]{path}[/]", soft_wrap=True)


def _choose_log_name(path: Path) -> str:
    """Return `truth` if the run folder has a log of true states, with all joints and objects; else `measured`."""
    return "truth" if find_log_in_folder(path, "truth") else "measured"


def _plot(first, second, machine, tool, path: Path, force: bool) -> None:
    from hydrotele.show.log_plots import plot_log, plot_overlay

    if second is None:
        _, log = _open_log(first, machine, tool, force)
        plot_log(log, path, title=log.metadata.get("run", log.name))
    else:
        (a, (_, one)), (b, (_, two)) = _open_log_pair(first, second, machine, tool, force).items()
        plot_overlay(one, two, path, names=(a, b), title=f"{a} and {b}")


def _record(first, second, machine, tool, path: Path, force: bool) -> None:
    from hydrotele.show.recording import write_recording

    if second is None:
        which = _choose_log_name(first)
        entries = {which: _open_log(find_run_log(first, which), machine, tool, force)}
    else:
        entries = _open_log_pair(first, second, machine, tool, force)
    write_recording(path, entries)


def _open_log(path: Path, machine: str | None, tool: str | None, force: bool) -> tuple[Machine, Log]:
    """Load the only log of a path, without resampling, and its machine; print notes on the log.

    Raises:
        InputError: the log is not usable or has no position of the machine.
    """
    if path.suffix.lower() == ".rrd":
        message = "is a recording, not a log: give it alone, without --plot, --video, --out, --machine and --tool"
        raise InputError(path, message)
    opened = open_single_log(path, machine, tool, force)
    print_notes(opened.notes)
    (log,) = opened.logs
    positions = [f"{opened.machine.position_kind(axis)}.{axis}" for axis in opened.machine.axes]
    if not any(name in log for name in positions):
        message = f"is not a log of {opened.machine.name}: it has none of {', '.join(positions)}"
        raise InputError(log.source, message)
    return opened.machine, log


def _open_log_pair(first, second, machine, tool, force: bool) -> dict[str, tuple[Machine, Log]]:
    """Load two logs of the same machine, on one time origin.

    Returns:
        {name derived from the path, else `first` and `second`: (machine, log)}.

    Raises:
        InputError: the logs belong to different machines.
    """
    logs = [_open_log(path, machine, tool, force) for path in (first, second)]
    aligned = align_time_origins([log for _, log in logs])
    logs = [(found, log) for (found, _), log in zip(logs, aligned, strict=True)]
    kinds = [found.name for found, _ in logs]
    if kinds[0] != kinds[1]:
        message = f"is a log of machine {kinds[1]}, but {first} is a log of machine {kinds[0]}"
        raise InputError(second, message)
    names = [re.sub(r"[^a-z0-9_]+", "_", path.stem.lower()) for path in (first, second)]
    usable = names[0] != names[1] and all(re.match(r"[a-z]", n) for n in names)
    if not usable or {"about", "difference", "ground"} & set(names):
        names = ["first", "second"]
    return dict(zip(names, logs, strict=True))
