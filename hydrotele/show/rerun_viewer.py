"""Run the rerun viewer as a child process: native window, web viewer or screenshot.

The child process and its children end with the program. Screenshots use `rerun --headless`, which
renders by Vulkan; without a graphics card, Mesa's lavapipe renders on the processor. The headless
viewer is controlled through a local port.
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
from hydrotele.core.output import atomic_file
from hydrotele.show.rerun_stream import TIMELINE

_EXIT_TIMEOUT = 5.0  # s, timeout for the program to end after SIGTERM
_PR_SET_PDEATHSIG = 1  # option of Linux prctl: signal to the child when the parent dies


class Viewer(NamedTuple):
    """A running rerun program.

    Attributes:
        process: process, the leader of a separate process group.
        output: file with the output of the program.
    """

    process: subprocess.Popen
    output: Path

    def read_output(self) -> str:
        """Return the output of the program so far."""
        return self.output.read_text(errors="replace")


def find_rerun_program() -> Path:
    """Return the path of the rerun program: RERUN_CLI_PATH, or that of the rerun-sdk wheel.

    Raises:
        InputError: rerun-sdk is not installed or does not include the viewer.
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


def resolve_recording_path(path: str | os.PathLike) -> Path:
    """Return the absolute path of an existing recording.

    Raises:
        InputError: the file does not exist.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "is not a file: give the path of an .rrd recording")
    return path.resolve()


def find_free_port() -> int:
    """Return a free TCP port of this computer."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@contextlib.contextmanager
def run_rerun(arguments: Sequence[str], uses_temporary_home: bool = False) -> Iterator[Viewer]:
    """Run the rerun program with arguments during the context, then end it with all its child processes.

    Args:
        arguments: command-line arguments.
        uses_temporary_home: use a temporary home folder, so that settings of the user are not read
            or written.

    Yields:
        The running program.

    Raises:
        InputError: the rerun program is not installed.
    """
    program = find_rerun_program()
    with tempfile.TemporaryDirectory(prefix="hydrotele_", ignore_cleanup_errors=True) as folder:
        output = Path(folder, "output.txt")
        environment = {**os.environ, "RERUN_APP_ONLY": "true", "NO_COLOR": "1"}
        if uses_temporary_home:
            environment["RUST_LOG"] = "warn"  # notifications would cover part of the image
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
                preexec_fn=_parent_death_hook(),
            )
        try:
            yield Viewer(process, output)
        finally:
            _end_process_group(process)


def _parent_death_hook() -> Callable[[], object] | None:
    """Return a function for a new child process that makes it end when this program is killed.

    It exists on Linux only; on other systems the result is None.
    """
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    return lambda: prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _end_process_group(process: subprocess.Popen) -> None:
    _signal_process_group(process, signal.SIGTERM)
    try:
        process.wait(_EXIT_TIMEOUT)
    except subprocess.TimeoutExpired:
        pass
    _signal_process_group(process, getattr(signal, "SIGKILL", signal.SIGTERM))
    process.wait(_EXIT_TIMEOUT)


def _signal_process_group(process: subprocess.Popen, number: int) -> None:
    """Send a signal to the whole process group, which can outlive its leader."""
    if sys.platform == "win32":
        process.terminate()
        return
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)


_POLL = 0.1  # s


@contextlib.contextmanager
def serve_web_viewer(rrd: str | os.PathLike, port: int | None = None, timeout: float = 30.0) -> Iterator[str]:
    """Serve a recording and rerun's web viewer by HTTP on this computer during the context.

    Args:
        rrd: recording file.
        port: HTTP port on 127.0.0.1, default a free port.
        timeout: maximum time until the server answers [s].

    Yields:
        URL to open in a browser.

    Raises:
        InputError: the recording is missing, the port is in use, or the server does not start.
    """
    rrd = resolve_recording_path(rrd)
    data_port, port = find_free_port(), port or find_free_port()
    arguments = ["--serve-web", "--bind", "127.0.0.1", "--port", str(data_port)]
    arguments += ["--web-viewer-port", str(port), str(rrd)]
    with run_rerun(arguments, uses_temporary_home=True) as viewer:
        page, deadline = f"http://127.0.0.1:{port}", time.monotonic() + timeout
        while not _is_answering(page):
            if viewer.process.poll() is not None or time.monotonic() > deadline:
                last = " ".join(viewer.read_output().split()[-40:])
                raise InputError(rrd, f"the viewer cannot be served on port {port}: {last}")
            time.sleep(_POLL)
        source = f"rerun+http://127.0.0.1:{data_port}/proxy"
        yield f"{page}/?url={quote(source, safe='')}"


def serve_recording(
    rrd: str | os.PathLike, port: int | None = None, report_url: Callable[[str], object] = print
) -> None:
    """Serve a recording and rerun's web viewer by HTTP until the program is interrupted by Ctrl-C.

    Args:
        rrd: recording file.
        port: HTTP port on 127.0.0.1, default a free port.
        report_url: function that is called once with the URL to open in a browser.

    Raises:
        InputError: the recording is missing, the port is in use, or the server does not start.
    """
    with serve_web_viewer(rrd, port) as url, contextlib.suppress(KeyboardInterrupt):
        report_url(url)
        while True:
            time.sleep(1.0)


def open_viewer(rrd: str | os.PathLike) -> int:
    """Show a recording in a window of the rerun viewer until the user closes it.

    Returns:
        Exit status of the viewer.

    Raises:
        InputError: the recording is missing or there is no viewer.
    """
    with run_rerun([str(resolve_recording_path(rrd))]) as viewer:
        return viewer.process.wait()


def _is_answering(page: str) -> bool:
    try:
        with urllib.request.urlopen(page, timeout=2.0) as answer:
            return answer.status == 200
    except (urllib.error.URLError, OSError):
        return False


if TYPE_CHECKING:
    from rerun.experimental import ViewerClient, ViewerState

_ERROR_TIMEOUT = 3.0  # s, timeout for the error message of a failing viewer
_TOO_SLOW = "the viewer does not show it in time: close other programs and try again"
_MIN_FRAMES = 3  # minimum number of frames, because layout and data need a few frames
_NO_DRIVER_SIGNS = ("render context", "graphics adapter")  # in the output if Vulkan is missing
_DRIVER_ADVICE = (
    "needs Vulkan to render: install a graphics driver or, without a graphics card, that of Mesa"
    " (Debian: apt-get install mesa-vulkan-drivers)"
)


def take_screenshot(
    rrd: str | os.PathLike,
    png: str | os.PathLike,
    size: tuple[int, int] = (1600, 1000),
    displayed_time: float | None = None,
    timeout: float = 90.0,
) -> tuple[str, ...]:
    """Save a screenshot of the rerun viewer with a recording, without opening a window.

    Args:
        rrd: recording file.
        png: PNG file, written completely or not at all.
        size: width and height [pixel].
        displayed_time: time on the timeline `time` [s], default the middle of the recording.
        timeout: maximum total duration [s].

    Returns:
        Warnings and errors that the viewer reports for the recording.

    Raises:
        InputError: the recording cannot be read, there is no Vulkan driver (the message names the
            package to install), or the timeout expires. No process is left running.
    """
    deadline = time.monotonic() + timeout
    with (
        atomic_file(png, ".png") as part,
        _run_headless_viewer(rrd, size, deadline) as (client, state),
    ):
        _hide_top_panel(client)
        client.set_time(TIMELINE, duration=_screenshot_time(state, displayed_time, rrd), play_state="paused")
        part.write_bytes(_take_settled_screenshot(client, rrd, deadline))
        return _viewer_reports(client, rrd, deadline)


def _viewer_reports(client: "ViewerClient", rrd: str | os.PathLike, deadline: float) -> tuple[str, ...]:
    """Return the warnings and errors that the viewer reports for its views and in its log.

    Log messages about images that could not be rendered are omitted, because these are taken again.

    Args:
        client: connection to the viewer.
        rrd: recording file, for error messages.
        deadline: value of `time.monotonic` after which an error is raised [s].
    """
    views = _read_state(client, rrd, deadline).views
    shown = [f"{v.name}: {r.severity}: {r.summary}" for v in views for r in v.reports]
    entries = [e.message for e in client.get_logs() if e.level in ("WARN", "ERROR")]
    return (*shown, *(e for e in entries if "rasterizer" not in e and "Failed to render screenshot" not in e))


def _read_state(client: "ViewerClient", rrd: str | os.PathLike, deadline: float) -> "ViewerState":
    """Return the state of the viewer; repeat the request after timeouts, until a deadline.

    A busy computer without a graphics card may need several attempts.

    Args:
        client: connection to the viewer.
        rrd: recording file, for error messages.
        deadline: value of `time.monotonic` after which a timeout is an error [s].

    Raises:
        InputError: the viewer does not answer before the deadline.
    """
    while True:
        try:
            return client.get_state()
        except TimeoutError:
            if time.monotonic() > deadline:
                raise InputError(rrd, _TOO_SLOW) from None


@contextlib.contextmanager
def _run_headless_viewer(
    rrd: str | os.PathLike, size: tuple[int, int], deadline: float
) -> Iterator[tuple["ViewerClient", "ViewerState"]]:
    """Run the rerun viewer without a window, and wait until it has loaded the recording.

    Args:
        rrd: recording file.
        size: width and height of the image [pixel].
        deadline: value of `time.monotonic` at which waiting ends with an error [s].

    Yields:
        Client and state of the viewer.
    """
    rrd, port = resolve_recording_path(rrd), find_free_port()
    arguments = ["--headless", "--bind", "127.0.0.1", "--port", str(port)]
    arguments += ["--hide-welcome-screen", "--window-size", f"{size[0]}x{size[1]}", str(rrd)]
    with run_rerun(arguments, uses_temporary_home=True) as viewer:
        client = _connect_client(viewer, port, rrd, deadline)
        try:
            yield client, _wait_until_loaded(viewer, client, rrd, deadline)
        except (RuntimeError, ConnectionError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                viewer.process.wait(_ERROR_TIMEOUT)
            _check_viewer_alive(viewer, rrd, deadline)
            raise InputError(rrd, f"the viewer does not answer: {error}") from error


def _connect_client(viewer: Viewer, port: int, rrd: Path, deadline: float) -> "ViewerClient":
    from rerun.experimental import ViewerClient

    while True:
        _check_viewer_alive(viewer, rrd, deadline)
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
            return client
        except (RuntimeError, ConnectionError, TimeoutError):
            time.sleep(_POLL)


def _wait_until_loaded(viewer: Viewer, client: "ViewerClient", rrd: Path, deadline: float) -> "ViewerState":
    while True:
        _check_viewer_alive(viewer, rrd, deadline)
        state = _read_state(client, rrd, deadline)
        if not state.loading and state.recordings and state.recordings[0].timelines:
            return state
        if failed := [entry.message for entry in client.get_logs() if entry.level == "ERROR"]:
            raise InputError(rrd, f"the viewer cannot show it: {' '.join(failed[0].split())}")
        time.sleep(_POLL)


def _check_viewer_alive(viewer: Viewer, rrd: Path, deadline: float) -> None:
    """Raise InputError if the viewer has ended or the deadline has passed."""
    if viewer.process.poll() is not None:
        said = viewer.read_output()
        if any(sign in said for sign in _NO_DRIVER_SIGNS):
            raise InputError("rerun viewer", _DRIVER_ADVICE)
        last = " ".join(said.split()[-40:])
        message = f"the viewer ended with exit status {viewer.process.returncode}: {last}"
        raise InputError(rrd, message)
    if time.monotonic() > deadline:
        raise InputError(rrd, _TOO_SLOW)


def _take_settled_screenshot(client: "ViewerClient", rrd: str | os.PathLike, deadline: float) -> bytes:
    """Take at least three screenshots, until two successive ones are equal; return the last one as PNG.

    Equal images show that all data are displayed. After the deadline (a value of `time.monotonic`
    [s]), the latest image is returned.

    Raises:
        InputError: there is no image before the deadline.
    """
    previous, count = b"", 0
    while True:
        try:
            picture, count = client.take_screenshot(), count + 1
        except TimeoutError:  # of one image; a busy computer without a graphics card can be slow
            if time.monotonic() > deadline:
                raise InputError(rrd, _TOO_SLOW) from None
            continue
        if count >= _MIN_FRAMES and (picture == previous or time.monotonic() > deadline):
            return picture
        previous = picture
        time.sleep(_POLL)


def _screenshot_time(state: "ViewerState", at: float | None, rrd: str | os.PathLike) -> float:
    lines = {line.name: line for line in state.recordings[0].timelines}
    if TIMELINE not in lines:
        raise InputError(rrd, f"has no timeline {TIMELINE!r}; it has {', '.join(lines)}")
    start, end = (1e-9 * (t or 0) for t in (lines[TIMELINE].start, lines[TIMELINE].end))
    if at is not None and not start <= at <= end:
        raise InputError(rrd, f"contains {start:g} to {end:g} s, not {at:g} s")
    return 0.5 * (start + end) if at is None else at


def _hide_top_panel(client: "ViewerClient") -> None:
    """Hide the menu bar, which also warns of slow rendering."""
    layout = client.get_blueprint(of="recording").blueprint
    layout["/top_panel"] = {"PanelBlueprint": {"state": "Hidden"}}
    client.set_blueprint(layout, of="recording")
