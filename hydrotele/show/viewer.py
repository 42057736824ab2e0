"""The rerun program as a child process: started with its own settings, ended without orphans.

Open a recording: in the native viewer, or in a browser through a local port.

A picture of a recording as the rerun viewer shows it, without a screen.

The viewer of the wheel draws off-screen (`rerun --headless`) through Vulkan; without a graphics
card Mesa's lavapipe draws on the processor. It is driven over its local port.
"""

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

from hydrotele.core.errors import InputError
from hydrotele.core.output import replacing
from hydrotele.show.recording import TIMELINE

_PATIENCE = 5.0  # s that the program has to end by itself
_PR_SET_PDEATHSIG = 1  # of Linux's prctl: a signal when the parent dies


class Viewer(NamedTuple):
    """A running rerun program.

    Attributes:
        process: the process; it leads its own process group.
        output: file that holds what it prints.
    """

    process: subprocess.Popen
    output: Path

    def said(self) -> str:
        """Return what it has printed."""
        return self.output.read_text(errors="replace")


def rerun_program() -> Path:
    """Path of the rerun program of the wheel, or that of RERUN_CLI_PATH.

    Raises:
        InputError: rerun-sdk is not installed, or without its viewer.
    """
    if override := os.environ.get("RERUN_CLI_PATH"):
        return Path(override)
    try:
        import rerun_cli
    except ImportError:
        raise InputError("rerun", "is not installed: pip install rerun-sdk") from None
    program = Path(rerun_cli.__file__).with_name("rerun.exe" if os.name == "nt" else "rerun")
    if not program.is_file():
        raise InputError("rerun", f"this rerun-sdk has no viewer at {program}: install a wheel")
    return program


def recording_file(path: str | os.PathLike) -> Path:
    """Absolute path of a recording that is there.

    Raises:
        InputError: it is not.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "is not a file: give the path of an .rrd recording")
    return path.resolve()


def free_port() -> int:
    """Return a TCP port of this machine that nobody listens to."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@contextlib.contextmanager
def running(arguments: Sequence[str], clean: bool = False) -> Iterator[Viewer]:
    """Run the rerun program while the context lasts, then end it with all its children.

    Args:
        arguments: its command line.
        clean: whether it has a home of its own, so that no user's settings are read or written.

    Raises:
        InputError: there is no such program.
    """
    program = rerun_program()
    with tempfile.TemporaryDirectory(prefix="hydrotele_", ignore_cleanup_errors=True) as folder:
        output = Path(folder, "output.txt")
        environment = {**os.environ, "RERUN_APP_ONLY": "true", "NO_COLOR": "1"}
        if clean:
            environment["RUST_LOG"] = "warn"  # news would cover a part of the picture
            homes = ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME")
            environment |= dict.fromkeys((*homes, "XDG_RUNTIME_DIR"), folder)
        with open(output, "wb") as file:
            process = subprocess.Popen(
                [str(program), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
                preexec_fn=_die_with_parent(),
            )
        try:
            yield Viewer(process, output)
        finally:
            _end(process)


def _die_with_parent() -> Callable[[], object] | None:
    """What a child on Linux does first, so that it ends even when this program is killed."""
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    return lambda: prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _end(process: subprocess.Popen) -> None:
    _signal(process, signal.SIGTERM)
    try:
        process.wait(_PATIENCE)
    except subprocess.TimeoutExpired:
        pass
    _signal(process, getattr(signal, "SIGKILL", signal.SIGTERM))
    process.wait(_PATIENCE)


def _signal(process: subprocess.Popen, number: int) -> None:
    """Signal the whole process group, which outlives its leader while it has members."""
    if sys.platform == "win32":
        process.terminate()
        return
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)


_POLL = 0.1  # s


@contextlib.contextmanager
def web_viewer(
    rrd: str | os.PathLike, port: int | None = None, timeout: float = 30.0
) -> Iterator[str]:
    """Serve a recording and the viewer for a browser on this machine while the context lasts.

    Args:
        rrd: the recording.
        port: HTTP port on 127.0.0.1; default is a free one.
        timeout: the longest that the server may take to answer [s].

    Yields:
        The URL to open in a browser.

    Raises:
        InputError: the recording is missing, the port is taken, or the server does not come up.
    """
    rrd = recording_file(rrd)
    data_port, port = free_port(), port or free_port()
    arguments = ["--serve-web", "--bind", "127.0.0.1", "--port", str(data_port)]
    arguments += ["--web-viewer-port", str(port), str(rrd)]
    with running(arguments, clean=True) as viewer:
        page, deadline = f"http://127.0.0.1:{port}", time.monotonic() + timeout
        while not _answers(page):
            if viewer.process.poll() is not None or time.monotonic() > deadline:
                last = " ".join(viewer.said().split()[-40:])
                raise InputError(rrd, f"the viewer cannot be served on port {port}: {last}")
            time.sleep(_POLL)
        source = f"rerun+http://127.0.0.1:{data_port}/proxy"
        yield f"{page}/?url={quote(source, safe='')}"


def serve_recording(
    rrd: str | os.PathLike, port: int | None = None, tell: Callable[[str], object] = print
) -> None:
    """Serve a recording until the program is interrupted.

    Args:
        rrd: the recording.
        port: HTTP port on 127.0.0.1; default is a free one.
        tell: is called once with the URL to open in a browser.

    Raises:
        InputError: as `web_viewer`.
    """
    with web_viewer(rrd, port) as url, contextlib.suppress(KeyboardInterrupt):
        tell(url)
        while True:
            time.sleep(1.0)


def open_viewer(rrd: str | os.PathLike) -> int:
    """Show a recording in the native viewer until it is closed.

    Returns:
        The viewer's exit status.

    Raises:
        InputError: the recording is missing or there is no viewer.
    """
    with running([str(recording_file(rrd))]) as viewer:
        return viewer.process.wait()


def _answers(page: str) -> bool:
    try:
        with urllib.request.urlopen(page, timeout=2.0) as answer:
            return answer.status == 200
    except (urllib.error.URLError, OSError):
        return False


if TYPE_CHECKING:
    from rerun.experimental import ViewerClient, ViewerState

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
) -> tuple[str, ...]:
    """Save what the viewer shows of a recording.

    Args:
        rrd: the recording.
        png: the picture to write, all or nothing.
        size: width and height [pixel].
        at: time on the timeline `time` [s]; default is the middle of the recording.
        timeout: the longest that all of it may take [s].

    Returns:
        Warnings and errors that the viewer has for the recording.

    Raises:
        InputError: the recording cannot be read, there is no Vulkan driver (says what to install),
            or time is up. Nothing is written and no process is left then.
    """
    deadline = time.monotonic() + timeout
    with replacing(png, ".png") as part, _viewing(rrd, size, deadline) as (client, state):
        _hide_top_panel(client)
        client.set_time(TIMELINE, duration=_moment(state, at, rrd), play_state="paused")
        part.write_bytes(_settled_picture(client, deadline))
        return _complaints(client)


def _complaints(client: "ViewerClient") -> tuple[str, ...]:
    """Warnings and errors that the viewer has for what it shows."""
    views = client.get_state().views
    shown = [f"{v.name}: {r.severity}: {r.summary}" for v in views for r in v.reports]
    entries = [e for e in client.get_logs() if e.level in ("WARN", "ERROR")]
    return (*shown, *(e.message for e in entries if "rasterizer" not in e.message))


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
