"""Progress bar on stderr while numba compiles functions: function name and estimated time left.

The remaining work is estimated from the call graph: each function of this package that has to be
compiled and is not in the cache is weighted by the length of its bytecode. In a terminal the bar is
drawn on one line; elsewhere a line is written every two seconds. Nothing is printed if the level of
the logger `hydrotele` is above `WARNING`.
"""

import gc
import logging
import sys
import threading
import time
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

from numba.core import event

SECONDS_BEFORE_BAR = 1.0
"""Time spent compiling, in seconds, before the bar appears."""
SECONDS_BETWEEN_LINES = 2.0
"""Time between two lines if stderr is not a terminal, in seconds."""
_REDRAW_INTERVAL = 0.2  # s between two updates in a terminal
_FUNCTION_OVERHEAD_BYTES = 100  # bytes of bytecode that cost as much to compile as an empty function
_BAR_WIDTH = 30  # characters of the bar
_LOG = logging.getLogger("hydrotele")


def format_bar(name: str, fraction: float, seconds_left: float | None) -> str:
    """Return the text of the progress bar.

    Args:
        name: name of the function that is compiled.
        fraction: completed fraction of the work, 0 to 1.
        seconds_left: estimated time left [s]; None if unknown.

    Returns:
        The line, without a line break.
    """
    filled = round(_BAR_WIDTH * min(max(fraction, 0.0), 1.0))
    rest = "" if seconds_left is None else f", about {seconds_left:.0f} s left"
    return f"compiling {name} [{'#' * filled}{'-' * (_BAR_WIDTH - filled)}]{rest} (once, then cached)"


class ProgressLine:
    """A status line on stderr: redrawn in place in a terminal, printed repeatedly elsewhere."""

    def __init__(self) -> None:
        self._print_time, self._width = 0.0, 0

    def show(self, text: str) -> None:
        """Show a text on stderr: redraw the line in a terminal; elsewhere print a line at most every 2 s.

        Nothing is shown if the level of the logger `hydrotele` is above WARNING.
        """
        if not _LOG.isEnabledFor(logging.WARNING):
            return
        if sys.stderr.isatty():
            sys.stderr.write("\r" + text.ljust(self._width))
            self._width = len(text)
        elif time.monotonic() - self._print_time >= SECONDS_BETWEEN_LINES:
            sys.stderr.write(text + "\n")
            self._print_time = time.monotonic()
        sys.stderr.flush()

    def clear(self) -> None:
        """Erase the line if it was drawn in a terminal; printed lines stay."""
        if self._width:
            sys.stderr.write("\r" + " " * self._width + "\r")
            sys.stderr.flush()
            self._width = 0


class CompileProgress(event.Listener):
    """Listener for numba's compile events that draws a progress bar on stderr from a background thread.

    Python's garbage collection is disabled while numba compiles.

    Args:
        is_cached: predicate that returns whether a function has code in the cache.
    """

    def __init__(self, is_cached: Callable[[Any], bool]) -> None:
        self._is_cached = is_cached
        self._line, self._lock = ProgressLine(), threading.Lock()
        self._names: list[str] = []
        self._start_time = self._elapsed_time = 0.0
        self._pending: dict[FunctionType, int] = {}
        self._total = self._done = self._done_before = 0
        self._gc_was_enabled = False
        self._thread: threading.Thread | None = None

    def on_start(self, event: event.Event) -> None:
        """Record that numba has started to compile a function, possibly as a callee of another function.

        For the outermost function, disable garbage collection and estimate the total work. The
        first call also starts the thread that draws the bar.
        """
        dispatcher = (event.data or {})["dispatcher"]
        if not self._names:
            # The compiler creates millions of objects that all live until it ends.
            self._gc_was_enabled = gc.isenabled()
            gc.disable()
            self._pending = self._find_uncompiled_functions(dispatcher)
            self._total, self._done = sum(self._pending.values()), 0
            self._start_time = time.monotonic()
            if self._thread is None:
                self._thread = threading.Thread(target=self._redraw_periodically, daemon=True)
                self._thread.start()
        self._names.append(dispatcher.py_func.__name__.strip("_"))

    def on_end(self, event: event.Event) -> None:
        """Record that numba has compiled a function, and count its estimated work as completed.

        After the outermost function, garbage collection is restored and the bar is erased.
        """
        function = (event.data or {})["dispatcher"].py_func
        self._names.pop()
        weight = self._pending.pop(function, 0)
        self._done, self._done_before = self._done + weight, self._done_before + weight
        if not self._names:
            self._elapsed_time += time.monotonic() - self._start_time
            if self._gc_was_enabled:
                gc.enable()
            with self._lock:
                self._line.clear()

    def _find_uncompiled_functions(self, dispatcher: Any) -> dict[FunctionType, int]:
        """Return the functions that have to be compiled for numba's dispatcher of a function.

        They are the function and all uncached functions that it calls, directly or indirectly. The values
        are their estimated work, in bytes of bytecode.
        """
        found, left = dict[FunctionType, int](), [dispatcher]
        while left:
            function = left.pop().py_func
            if function in found:
                continue
            found[function] = _FUNCTION_OVERHEAD_BYTES + len(function.__code__.co_code)
            left += [d for d in called_dispatchers(function) if not self._is_cached(d.py_func)]
        return found

    def _redraw_periodically(self) -> None:
        """Redraw the progress bar every 0.2 s in an endless loop; runs in the background thread.

        The bar is drawn only while a function is compiled, once 1 s in total was spent compiling.
        """
        while True:
            time.sleep(_REDRAW_INTERVAL)
            names = self._names[:1] + self._names[-1:]
            spent = self._elapsed_time + time.monotonic() - self._start_time
            if not names or spent < SECONDS_BEFORE_BAR:
                continue
            left = None
            if self._done_before:
                left = spent / self._done_before * max(self._total - self._done, 0)
            name = names[0] if names[0] == names[-1] else f"{names[0]}: {names[-1]}"
            with self._lock:
                if self._names:
                    self._line.show(format_bar(name, self._done / max(self._total, 1), left))


def called_dispatchers(function: FunctionType) -> list[Any]:
    """Return numba's dispatchers (the compiled functions) that a Python function refers to.

    They are found among its global names and closure variables, and as attributes of modules that
    it refers to.
    """
    names = function.__code__.co_names
    scope = function.__globals__ | {
        name: cell.cell_contents
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    }
    found = [scope.get(name) for name in (*names, *function.__code__.co_freevars)]
    for module in [m for m in found if isinstance(m, ModuleType)]:
        found += [getattr(module, name, None) for name in names]
    return [one for one in found if hasattr(one, "py_func")]
