"""`hydrotele review`: a recording of one or two logs, opened, served or photographed."""

import contextlib
import re
import tempfile
from pathlib import Path

from hydrotele.cli.console import notes, out
from hydrotele.cli.opening import open_log
from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine


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
    with contextlib.ExitStack() as stack:
        made = first / "review.rrd"
        if not (made.is_file() and not any((second, target, machine, tool))):
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="hydrotele_"))
            made = target or Path(folder, "review.rrd")
            _record(first, second, machine, tool, made)
        _show(made, serve, port, screenshot, quiet=target is not None)


def _show(recording: Path, serve: bool, port: int, screenshot: Path | None, quiet: bool) -> None:
    if screenshot:
        from hydrotele.show.viewer import take_screenshot

        notes.print("taking a screenshot ...", style="dim")
        for complaint in take_screenshot(recording, screenshot):
            notes.print(f"[yellow]viewer[/] {complaint}", soft_wrap=True)
        out.print(f"written to [bold]{screenshot}[/]")
    elif serve:
        from hydrotele.show.viewer import serve_recording

        tell = "open {} in a browser on this machine; Ctrl-C stops serving"
        serve_recording(recording, port, lambda url: out.print(tell.format(url), soft_wrap=True))
    elif quiet:
        out.print(f"written to [bold]{recording}[/]")
    else:
        from hydrotele.show.viewer import open_viewer

        if open_viewer(recording):
            message = "no viewer could be opened here; try --serve or --screenshot PNG"
            raise InputError("review", message)


def _plot(first, second, machine, tool, path: Path) -> None:
    from hydrotele.show.overlay import plot_log, plot_overlay

    if second is None:
        _, log = open_log(first, machine, tool)
        plot_log(log, path, title=log.metadata.get("run", log.name))
    else:
        (a, (_, one)), (b, (_, two)) = _pair(first, second, machine, tool, "measured").items()
        plot_overlay(one, two, path, names=(a, b), title=f"{a} and {b}")


def _record(first, second, machine, tool, path: Path) -> None:
    from hydrotele.show.recording import write_recording

    if second is None:
        which = "truth" if (first / "truth.parquet").is_file() else "measured"
        entries = {which: open_log(first, machine, tool, which)}
    else:
        entries = _pair(first, second, machine, tool, "measured")
    write_recording(path, entries)


def _pair(first, second, machine, tool, which: str) -> dict[str, tuple[Machine, Log]]:
    """Two logs of one kind of machine under names that tell them apart."""
    logs = [open_log(path, machine, tool, which) for path in (first, second)]
    kinds = [found.name for found, _ in logs]
    if kinds[0] != kinds[1]:
        raise InputError(second, f"is of a {kinds[1]}, {first} of a {kinds[0]}: nothing to compare")
    names = [re.sub(r"[^a-z0-9_]+", "_", path.stem.lower()) for path in (first, second)]
    usable = names[0] != names[1] and all(re.match(r"[a-z]", n) for n in names)
    if not usable or {"about", "difference", "ground"} & set(names):
        names = ["first", "second"]
    return dict(zip(names, logs, strict=True))
