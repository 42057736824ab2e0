"""The rerun program as a child process: started with its own settings, ended without orphans."""

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from hydrotele.core.errors import InputError

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
