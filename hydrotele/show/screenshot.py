"""A picture of a recording as the rerun viewer shows it, without a screen.

The viewer of the wheel draws off-screen (`rerun --headless`) through Vulkan; without a graphics
card Mesa's lavapipe draws on the processor. It is driven over its local port.
"""

import contextlib
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from hydrotele.core.errors import InputError
from hydrotele.core.output import replacing
from hydrotele.show.recording import TIMELINE
from hydrotele.show.viewer import Viewer, free_port, recording_file, running

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient, ViewerState

_POLL = 0.1  # s
_LAST_WORDS = 3.0  # s that a dying viewer takes to say why
_SETTLING = 3  # pictures that are drawn at least: layout and data take a few frames
_NO_DRIVER = ("render context", "graphics adapter")  # what the viewer says then
_DRIVER = (
    "needs Vulkan to draw: install a graphics driver or, without a graphics card, Mesa's"
    " (Debian: apt-get install mesa-vulkan-drivers)"
)


def take_screenshot(
    rrd: str | os.PathLike,
    png: str | os.PathLike,
    size: tuple[int, int] = (1600, 1000),
    at: float | None = None,
    timeout: float = 90.0,
) -> None:
    """Save what the viewer shows of a recording.

    Args:
        rrd: the recording.
        png: the picture to write, all or nothing.
        size: width and height [pixel].
        at: time on the timeline `time` [s]; default is the middle of the recording.
        timeout: the longest that all of it may take [s].

    Raises:
        InputError: the recording cannot be read, there is no Vulkan driver (says what to install),
            or time is up. Nothing is written and no process is left then.
    """
    deadline = time.monotonic() + timeout
    with replacing(png, ".png") as part, _viewing(rrd, size, deadline) as (client, state):
        _hide_top_panel(client)
        client.set_time(TIMELINE, duration=_moment(state, at, rrd), play_state="paused")
        part.write_bytes(_settled_picture(client, deadline))


def view_reports(rrd: str | os.PathLike, timeout: float = 90.0) -> list[str]:
    """Return the warnings and errors that the viewer has for a recording; none is good.

    Raises:
        InputError: as `take_screenshot`.
    """
    deadline = time.monotonic() + timeout
    with _viewing(rrd, (1600, 1000), deadline) as (client, _):
        _settled_picture(client, deadline)
        views = client.get_state().views
        shown = [f"{v.name}: {r.severity}: {r.summary}" for v in views for r in v.reports]
        entries = [e for e in client.get_logs() if e.level in ("WARN", "ERROR")]
        return shown + [e.message for e in entries if "rasterizer" not in e.message]


@contextlib.contextmanager
def _viewing(
    rrd: str | os.PathLike, size: tuple[int, int], deadline: float
) -> Iterator[tuple["ViewerClient", "ViewerState"]]:
    """A viewer that has loaded the recording."""
    rrd, port = recording_file(rrd), free_port()
    arguments = ["--headless", "--bind", "127.0.0.1", "--port", str(port)]
    arguments += ["--hide-welcome-screen", "--window-size", f"{size[0]}x{size[1]}", str(rrd)]
    with running(arguments, clean=True) as viewer:
        client = _connected(viewer, port, rrd, deadline)
        try:
            yield client, _loaded(viewer, client, rrd, deadline)
        except (RuntimeError, ConnectionError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                viewer.process.wait(_LAST_WORDS)
            _check(viewer, rrd, deadline)
            raise InputError(rrd, f"the viewer does not answer: {error}") from error


def _connected(viewer: Viewer, port: int, rrd: Path, deadline: float) -> "ViewerClient":
    from rerun.experimental import ViewerClient

    while True:
        _check(viewer, rrd, deadline)
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
            return client
        except (RuntimeError, ConnectionError):
            time.sleep(_POLL)


def _loaded(viewer: Viewer, client: "ViewerClient", rrd: Path, deadline: float) -> "ViewerState":
    while True:
        _check(viewer, rrd, deadline)
        state = client.get_state()
        if not state.loading and state.recordings and state.recordings[0].timelines:
            return state
        if failed := [entry.message for entry in client.get_logs() if entry.level == "ERROR"]:
            raise InputError(rrd, f"the viewer cannot show it: {' '.join(failed[0].split())}")
        time.sleep(_POLL)


def _check(viewer: Viewer, rrd: Path, deadline: float) -> None:
    """Explain a viewer that has ended, or one that takes too long."""
    if viewer.process.poll() is not None:
        said = viewer.said()
        if any(sign in said for sign in _NO_DRIVER):
            raise InputError("rerun viewer", _DRIVER)
        last = " ".join(said.split()[-40:])
        raise InputError(rrd, f"the viewer ended with {viewer.process.returncode}: {last}")
    if time.monotonic() > deadline:
        raise InputError(rrd, "the viewer does not show it in time: raise the timeout")


def _settled_picture(client: "ViewerClient", deadline: float) -> bytes:
    """The first picture that is like the one before: all data have arrived then."""
    previous, count = b"", 0
    while True:
        picture, count = client.take_screenshot(), count + 1
        if count >= _SETTLING and (picture == previous or time.monotonic() > deadline):
            return picture
        previous = picture
        time.sleep(_POLL)


def _moment(state: "ViewerState", at: float | None, rrd: str | os.PathLike) -> float:
    lines = {line.name: line for line in state.recordings[0].timelines}
    if TIMELINE not in lines:
        raise InputError(rrd, f"has no timeline {TIMELINE!r}; it has {', '.join(lines)}")
    start, end = (1e-9 * (t or 0) for t in (lines[TIMELINE].start, lines[TIMELINE].end))
    if at is not None and not start <= at <= end:
        raise InputError(rrd, f"holds {start:g} to {end:g} s, not {at:g} s")
    return 0.5 * (start + end) if at is None else at


def _hide_top_panel(client: "ViewerClient") -> None:
    """Leave out the menu and its warnings of slow drawing: in a picture they are of no use."""
    layout = client.get_blueprint(of="recording").blueprint
    layout["/top_panel"] = {"PanelBlueprint": {"state": "Hidden"}}
    client.set_blueprint(layout, of="recording")
