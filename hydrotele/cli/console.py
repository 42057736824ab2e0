"""Print results, notes, tables, JSON and progress on the terminal.

Results go to standard output; notes and progress go to standard error.
"""

import contextlib
import json
import re
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.errors import MarkupError
from rich.table import Table
from rich.text import Text

Progress = Callable[[float, float], None]
StageReport = Callable[[str, float], None]
_STATUS_PERIOD = 15.0  # s between progress lines if standard error is not a terminal
_FIRST_STATUS_TIME = 2.0  # s after which the first progress line is printed

_STYLES = "bold|dim|red|green|yellow|blue|magenta"
_UNKNOWN_TAG = re.compile(rf"(?<!\\)\[(?!/\]|(?:{_STYLES})(?: (?:{_STYLES}))*\])")


class _Console(Console):
    """Console that interprets only known style tags, such as [bold]; other brackets are printed as text."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text in which known style tags are applied; unknown or unmatched tags remain as text."""
        try:
            return super().render_str(_UNKNOWN_TAG.sub(r"\[", text), **options)
        except MarkupError:
            return super().render_str(text, **{**options, "markup": False})


stdout_console = _Console(highlight=False, emoji=False)
stderr_console = _Console(stderr=True, highlight=False, emoji=False)


def print_json(data: Any) -> None:
    """Print data as JSON; NaN and infinity become null."""
    print(json.dumps(to_json_types(data), indent=2))


def write_json(path: Path, data: Any) -> None:
    """Write data as JSON into a file; NaN and infinity become null."""
    text = json.dumps(to_json_types(data), indent=2, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def print_result(document: Any, as_json: bool, show: Callable[[], None], target: Path | None) -> None:
    """Print the result of a command as JSON, or as text followed by the path of its report.

    Args:
        document: JSON data of the result.
        as_json: whether to print JSON.
        show: function that prints the result as text.
        target: output folder that contains report.html, None if nothing was written.
    """
    if as_json:
        print_json(document)
        return
    show()
    if target:
        stdout_console.print(f"written to [bold]{target}[/]; open {target}/report.html")


def to_json_types(data: Any) -> Any:
    """Convert nested data with NumPy arrays and numbers to JSON types; NaN and infinity become None."""
    if isinstance(data, dict):
        return {str(key): to_json_types(value) for key, value in data.items()}
    if isinstance(data, (list, tuple, np.ndarray)):
        return [to_json_types(value) for value in data]
    if isinstance(data, (float, np.floating)):
        return float(data) if np.isfinite(data) else None
    if isinstance(data, np.integer):
        return int(data)
    return data


def print_notes(notes: Iterable[str]) -> None:
    """Print notes on the data to standard error."""
    for note in notes:
        stderr_console.print(f"[yellow]note[/] {note}", soft_wrap=True)


def make_table(title: str, *columns: str) -> Table:
    """Return an empty table in which all columns but the first are right-aligned."""
    made = Table(title=title, title_justify="left", header_style="bold")
    for place, column in enumerate(columns):
        made.add_column(column, justify="left" if place == 0 else "right")
    return made


@contextlib.contextmanager
def print_status_regularly(label: str) -> Iterator[Callable[[str], None]]:
    """Print the latest status text and the elapsed time on stderr after 2 s, then every 15 s.

    Yields:
        A function that sets the status text.
    """
    begin, last, over = time.perf_counter(), ["starts"], threading.Event()

    def print_status_lines() -> None:
        pause = min(_FIRST_STATUS_TIME, _STATUS_PERIOD)
        while not over.wait(pause):
            pause = _STATUS_PERIOD
            line = f"{label}: {last[0]}, {time.perf_counter() - begin:.0f} s"
            stderr_console.print(line, markup=False, soft_wrap=True)

    def set_status(text: str) -> None:
        last[0] = text

    thread = threading.Thread(target=print_status_lines, daemon=True)
    thread.start()
    try:
        yield set_status
    finally:
        over.set()
        thread.join()


@contextlib.contextmanager
def show_simulation_progress(label: str, quiet: bool = False) -> Iterator[Progress | None]:
    """Show simulated time and real-time factor on stderr while a simulation runs.

    On a terminal this is a progress bar, otherwise a line every 15 s.

    Yields:
        A function of simulated and total time [s] that updates the display, None if `quiet`.
    """
    if quiet:
        yield None
        return
    if not stderr_console.is_terminal:
        with print_status_regularly(label) as tell:
            yield lambda done, total: tell(f"{done:.1f} of {total:.1f} s simulated")
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    text = TextColumn("{task.completed:6.1f} / {task.total:.1f} s  {task.fields[factor]}")
    bar = Progress(
        TextColumn(label),
        BarColumn(),
        text,
        TimeRemainingColumn(),
        console=stderr_console,
        transient=True,
    )
    with bar:
        task = bar.add_task(label, total=1.0, factor="")
        begin = time.perf_counter()

        def update(done: float, total: float) -> None:
            factor = done / max(time.perf_counter() - begin, 1e-6)
            bar.update(task, completed=done, total=total, factor=f"{factor:.0f} x real time")

        yield update


@contextlib.contextmanager
def show_stages(label: str, quiet: bool) -> Iterator[StageReport | None]:
    """Show the current stage of a computation on stderr: a bar on a terminal, else a line every 15 s.

    Yields:
        A function of stage name and completed fraction that updates the display, None if `quiet`.
    """
    if quiet:
        yield None
        return
    if not stderr_console.is_terminal:
        with print_status_regularly(label) as tell:
            yield lambda said, fraction: tell(f"{100.0 * fraction:.0f} %, {said}")
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = TextColumn(label), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
    stage = TextColumn("{task.description}")
    with Progress(*columns, stage, console=stderr_console, transient=True) as bar:
        task = bar.add_task("", total=1.0)

        def update(said: str, fraction: float) -> None:
            bar.update(task, completed=fraction, description=said)

        yield update


def ignore_stage(stage: str, fraction: float) -> None:
    """Do nothing; default for computations that report the name of a stage and the completed fraction."""


@contextlib.contextmanager
def announce_output(what: str, path: Path | None, quiet: bool = False) -> Iterator[None]:
    """Enclose the creation of an output: print a line before it on stderr, and its path after it on stdout.

    Args:
        what: name of the output, such as `plot`.
        path: file of the output; None prints no path.
        quiet: whether to print nothing.
    """
    if not quiet:
        stderr_console.print(f"making the {what} ...", style="dim")
    yield
    if path and not quiet:
        stdout_console.print(f"written to [bold]{path}[/]", soft_wrap=True)


@contextlib.contextmanager
def catch_first_interrupt() -> Iterator[Callable[[], bool]]:
    """Handle the first Ctrl-C as a request to stop; the second one raises KeyboardInterrupt.

    Outside the main thread, Ctrl-C is not handled.

    Yields:
        A function that returns whether Ctrl-C was pressed.
    """
    seen: list[bool] = []

    def handle_interrupt(number, frame) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(True)

    try:
        before = signal.signal(signal.SIGINT, handle_interrupt)
    except ValueError:  # only the main thread can set signal handlers
        yield lambda: False
        return
    try:
        yield lambda: bool(seen)
    finally:
        signal.signal(signal.SIGINT, before)
