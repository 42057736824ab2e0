"""Open a recording: in the native viewer, or in a browser through a local port."""

import contextlib
import os
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from urllib.parse import quote

from hydrotele.core.errors import InputError
from hydrotele.show.viewer import free_port, recording_file, running

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
