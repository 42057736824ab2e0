"""`hydrotele review`: a recording of one or two logs, opened, served or photographed."""

import tempfile
from pathlib import Path

from hydrotele.commands.console import notes, out
from hydrotele.commands.opening import open_log
from hydrotele.errors import InputError


def review_logs(
    first: Path, second: Path | None, machine: str | None, tool: str | None, target: Path | None,
    serve: bool, port: int, screenshot: Path | None, plot: Path | None,
) -> None:  # fmt: skip
    """Make a recording and show it.

    Args:
        first: run folder or log file.
        second: another one on the same clock, or None.
        machine: machine of both logs, None to find them.
        tool: its tool.
        target: recording to write; default is review.rrd in the run folder or a temporary file.
        serve: serve the web viewer until interrupted.
        port: of the web viewer.
        screenshot: PNG of the viewer to write, headless.
        plot: PNG of the channels to write instead: of both logs with their difference, or of all
            channels of one.

    Raises:
        InputError: a log, machine or viewer is not usable.
    """
    if screenshot and screenshot.suffix.lower() != ".png":
        raise InputError(screenshot, "give it a name that ends in .png")
    if plot:
        _plot(first, second, machine, tool, plot)
        out.print(f"written to [bold]{plot}[/]")
        return
    recording = _recording(first, second, machine, tool, target)
    if screenshot:
        from hydrotele.show.screenshot import take_screenshot

        notes.print("taking a screenshot ...", style="dim")
        take_screenshot(recording, screenshot)
        out.print(f"written to [bold]{screenshot}[/]")
    elif serve:
        from hydrotele.show.serve import serve_recording

        serve_recording(recording, port)
    elif target is None:
        from hydrotele.show.serve import open_viewer

        if open_viewer(recording):
            message = "no viewer could be opened here; try --serve or --screenshot PNG"
            raise InputError(recording, message)


def _plot(first, second, machine, tool, path: Path) -> None:
    from hydrotele.show.overlay import plot_log, plot_overlay

    _, log = open_log(first, machine, tool)
    if second is None:
        plot_log(log, path, title=log.metadata.get("run", log.name))
    else:
        plot_overlay(log, open_log(second, machine, tool)[1], path, names=("first", "second"))


def _recording(first, second, machine, tool, target) -> Path:
    from hydrotele.show.recording import write_recording

    made = first / "review.rrd"
    if made.is_file() and not any((second, target, machine, tool)):
        return made
    which = "truth" if second is None and (first / "truth.parquet").is_file() else "measured"
    entries = {which: open_log(first, machine, tool, which)}
    if second is not None:
        other = open_log(second, machine, tool, "measured")
        entries = {"first": entries[which], "second": other}
    path = target or Path(tempfile.mkdtemp(prefix="hydrotele_"), "review.rrd")
    write_recording(path, entries)
    out.print(f"recording: [bold]{path}[/]")
    return path
