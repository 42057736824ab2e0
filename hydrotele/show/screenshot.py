"""A picture of a recording as the rerun viewer shows it, without a screen.

The viewer of the wheel draws off-screen (`rerun --headless`) through Vulkan; without a graphics card
Mesa's lavapipe draws on the processor. It is driven over its local port.
"""

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from hydrotele.errors import InputError
from hydrotele.show.output import replacing
from hydrotele.show.recording import TIMELINE
from hydrotele.show.viewer import Viewer, free_port, running

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient, ViewerState

_POLL = 0.1  # s
_SETTLING = 3  # pictures that are drawn before one counts: layout and plots take a few frames
_DRIVER = (
    "needs Vulkan to draw: install a graphics driver or, without a graphics card, Mesa's"
    " (Debian: apt-get install mesa-vulkan-drivers)"
)


def take_screenshot(
    rrd: str | os.PathLike,
    png: str | os.PathLike,
    size: tuple[int, int] = (1600, 1000),
    at: float | None = None,
    timeout: float = 60.0,
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
    rrd = Path(rrd)
    if not rrd.is_file():
        raise InputError(rrd, "is not a file: give the path of an .rrd recording")
    deadline, port = time.monotonic() + timeout, free_port()
    arguments = ["--headless", "--bind", "127.0.0.1", "--port", str(port)]
    arguments += ["--hide-welcome-screen", "--window-size", f"{size[0]}x{size[1]}", str(rrd)]
    with replacing(png, ".png") as part, running(arguments, clean=True) as viewer:
        client = _connected(viewer, port, rrd, deadline)
        state = _loaded(viewer, client, rrd, deadline)
        _hide_top_panel(client)
        client.set_time(TIMELINE, duration=_moment(state, at, rrd), play_state="paused")
        for _ in range(_SETTLING):
            content = client.take_screenshot()
            time.sleep(_POLL)
        part.write_bytes(content)


def view_reports(rrd: str | os.PathLike, timeout: float = 60.0) -> list[str]:
    """Return the warnings and errors that the viewer's views report for a recording.

    Raises:
        InputError: as `take_screenshot`.
    """
    rrd, deadline, port = Path(rrd), time.monotonic() + timeout, free_port()
    arguments = ["--headless", "--bind", "127.0.0.1", "--port", str(port), str(rrd)]
    with running(arguments, clean=True) as viewer:
        client = _connected(viewer, port, rrd, deadline)
        _loaded(viewer, client, rrd, deadline)
        client.take_screenshot()
        state = client.get_state()
        reports = [(view.name, report) for view in state.views for report in view.reports]
        logged = [
            f"{entry.target}: {entry.message}"
            for entry in client.get_logs()
            if entry.level != "INFO" and "rasterizer" not in entry.message
        ]
        return [f"{name}: {r.severity}: {r.summary}" for name, r in reports] + logged


def _connected(viewer: Viewer, port: int, rrd: Path, deadline: float) -> "ViewerClient":
    from rerun.experimental import ViewerClient

    while True:
        _check(viewer, rrd, deadline)
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
            return client
        except (RuntimeError, ConnectionError, OSError):
            time.sleep(_POLL)


def _loaded(
    viewer: Viewer, client: "ViewerClient", rrd: Path, deadline: float
) -> "ViewerState":
    while True:
        _check(viewer, rrd, deadline)
        state = client.get_state()
        if not state.loading and state.recordings and state.recordings[0].timelines:
            return state
        failed = [e.message for e in client.get_logs() if e.level == "ERROR"]
        if failed:
            raise InputError(rrd, f"the viewer cannot show it: {failed[0]}")
        time.sleep(_POLL)


def _check(viewer: Viewer, rrd: Path, deadline: float) -> None:
    """Explain a viewer that has ended, or one that takes too long."""
    if viewer.process.poll() is not None:
        said = viewer.said()
        if "adapter" in said or "wgpu" in said.lower() or "vulkan" in said.lower():
            raise InputError("rerun viewer", _DRIVER)
        last = " ".join(said.split()[-40:])
        raise InputError(rrd, f"the viewer ended with {viewer.process.returncode}: {last}")
    if time.monotonic() > deadline:
        raise InputError(rrd, "the viewer does not show it in time: raise the timeout")


def _moment(state: "ViewerState", at: float | None, rrd: Path) -> float:
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
