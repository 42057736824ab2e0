"""Stream of a rerun recording with its timeline `time` [s] and entity paths.

The file is written completely or not at all.
"""

import contextlib
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from hydrotele.core.output import atomic_file

if TYPE_CHECKING:
    import rerun as rr

_MAX_ID_LENGTH = 180  # maximum number of characters of an application id in rerun


@contextlib.contextmanager
def open_recording(path: str | os.PathLike, application: str) -> Iterator["rr.RecordingStream"]:
    """Open a rerun recording stream that is kept in memory and written to a file at the end.

    The writer of rerun is not used, because its thread does not report a full disk.

    Args:
        path: file to write, with the suffix `.rrd`.
        application: application id; rerun stores the layout of a user per id.

    Yields:
        The recording stream.

    Raises:
        InputError: the suffix is wrong, or the file cannot be written; no file is left.
    """
    import rerun as rr

    name = application.encode("ascii", "replace").decode()[:_MAX_ID_LENGTH]
    with atomic_file(path, ".rrd") as part, rr.RecordingStream(name) as stream:
        memory = stream.binary_stream()
        yield stream
        part.write_bytes(memory.read(flush=True) or b"")


TIMELINE = "time"


def time_column(time: np.ndarray) -> "rr.TimeColumn":
    """Convert times (n,) [s] to rerun's column of the timeline `time`, rounded to nanoseconds."""
    import rerun as rr

    nanoseconds = np.round(np.asarray(time) * 1e9).astype("timedelta64[ns]")
    return rr.TimeColumn(TIMELINE, duration=nanoseconds)


def entity_path(root: str, channel: str) -> str:
    """Return the path of a log channel in the tree of a rerun recording.

    >>> entity_path("measured", "truth.flow_head.boom")
    '/measured/truth/flow_head/boom'
    """
    return "/".join(["", root, *channel.split(".")])
