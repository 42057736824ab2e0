"""Printing for people and for scripts."""

import contextlib
import json
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.errors import MarkupError
from rich.table import Table
from rich.text import Text

Progress = Callable[[float, float], None]
_BEAT = 15.0  # s between lines that say how far a command is, where there is no terminal

_STYLES = "bold|dim|red|green|yellow|blue|magenta"
_NO_TAG = re.compile(rf"(?<!\\)\[(?!/\]|(?:{_STYLES})(?: (?:{_STYLES}))*\])")


class _Console(Console):
    """A console that takes our own styles in brackets only; names and paths may hold any text."""

    def render_str(self, text: str, **options: Any) -> Text:
        """The text with its styles; what looks like another tag, or is never opened, is text."""
        try:
            return super().render_str(_NO_TAG.sub(r"\[", text), **options)
        except MarkupError:
            return super().render_str(text, **{**options, "markup": False})


out = _Console(highlight=False, emoji=False)
notes = _Console(stderr=True, highlight=False, emoji=False)


def print_json(data: Any) -> None:
    """Print data as JSON; numbers that are not finite become null."""
    print(json.dumps(plain(data), indent=2))


def write_json(path: Path, data: Any) -> None:
    """Write data as JSON into a file; numbers that are not finite become null."""
    text = json.dumps(plain(data), indent=2, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def print_result(
    document: Any, as_json: bool, show: Callable[[], None], target: Path | None
) -> None:
    """Print what a command found: as JSON, or in words with the place of its report.

    Args:
        document: what the JSON holds.
        as_json: whether to print that.
        show: prints the words.
        target: folder that was written, with a report.html; None where none was.
    """
    if as_json:
        print_json(document)
        return
    show()
    if target:
        out.print(f"written to [bold]{target}[/]; open {target}/report.html")


def plain(data: Any) -> Any:
    """Data with Python numbers only, NaN and infinity as None."""
    if isinstance(data, dict):
        return {str(key): plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple, np.ndarray)):
        return [plain(value) for value in data]
    if isinstance(data, (float, np.floating)):
        return float(data) if np.isfinite(data) else None
    if isinstance(data, np.integer):
        return int(data)
    return data


def table(title: str, *columns: str) -> Table:
    """A table whose columns after the first are right-aligned."""
    made = Table(title=title, title_justify="left", header_style="bold")
    for place, column in enumerate(columns):
        made.add_column(column, justify="left" if place == 0 else "right")
    return made


@contextlib.contextmanager
def _heartbeat(label: str) -> Iterator[Callable[[str], None]]:
    """A line on stderr every `_BEAT` seconds, with what was told last and the time that it took."""
    begin, last, over = time.perf_counter(), ["begins"], threading.Event()

    def beat() -> None:
        while not over.wait(_BEAT):
            line = f"{label}: {last[0]}, {time.perf_counter() - begin:.0f} s"
            notes.print(line, markup=False, soft_wrap=True)

    def tell(text: str) -> None:
        last[0] = text

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield tell
    finally:
        over.set()
        thread.join()


@contextlib.contextmanager
def progress_bar(label: str, quiet: bool = False) -> Iterator[Progress | None]:
    """A bar with simulated time and real-time factor on stderr, or now and then a line.

    The line is for what is no terminal, such as the log of a job; None where all is to be quiet.
    """
    if quiet:
        yield None
        return
    if not notes.is_terminal:
        with _heartbeat(label) as tell:
            yield lambda done, total: tell(f"{done:.1f} of {total:.1f} s simulated")
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    text = TextColumn("{task.completed:6.1f} / {task.total:.1f} s  {task.fields[factor]}")
    bar = Progress(
        TextColumn(label), BarColumn(), text, TimeRemainingColumn(), console=notes, transient=True
    )
    with bar:
        task = bar.add_task(label, total=1.0, factor="")
        begin = time.perf_counter()

        def update(done: float, total: float) -> None:
            factor = done / max(time.perf_counter() - begin, 1e-6)
            bar.update(task, completed=done, total=total, factor=f"{factor:.0f} x real time")

        yield update


@contextlib.contextmanager
def stages(label: str, quiet: bool) -> Iterator[Callable[[str, float], None] | None]:
    """A bar with the stage of the search on stderr, or now and then a line; None if quiet."""
    if quiet:
        yield None
        return
    if not notes.is_terminal:
        with _heartbeat(label) as tell:
            yield lambda said, fraction: tell(f"{100.0 * fraction:.0f} %, {said}")
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = TextColumn(label), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
    stage = TextColumn("{task.description}")
    with Progress(*columns, stage, console=notes, transient=True) as bar:
        task = bar.add_task("", total=1.0)

        def update(said: str, fraction: float) -> None:
            bar.update(task, completed=fraction, description=said)

        yield update


@contextlib.contextmanager
def first_interrupt() -> Iterator[Callable[[], bool]]:
    """The first Ctrl-C only sets what this yields; the second one interrupts as usual."""
    seen: list[bool] = []

    def note(number, frame) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(True)

    try:
        before = signal.signal(signal.SIGINT, note)
    except ValueError:  # not in the main thread, where no signals come
        yield lambda: False
        return
    try:
        yield lambda: bool(seen)
    finally:
        signal.signal(signal.SIGINT, before)
