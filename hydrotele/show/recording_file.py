"""A rerun recording that becomes a file whole or not at all, also where the disk is full."""

import contextlib
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

from hydrotele.core.output import replacing

if TYPE_CHECKING:
    import rerun as rr

_LONGEST_ID = 180  # characters that rerun takes as an application id


@contextlib.contextmanager
def recording_file(path: str | os.PathLike, application: str) -> Iterator["rr.RecordingStream"]:
    """Record into memory and write the file at the end.

    Rerun's own writer is a thread that nobody hears of when the disk is full.

    Args:
        path: the file to write, ending in `.rrd`.
        application: its id; rerun keeps a user's layout per id.

    Yields:
        The recording to log to.

    Raises:
        InputError: the name ends otherwise, or the file cannot be written. Nothing is left then.
    """
    import rerun as rr

    name = application.encode("ascii", "replace").decode()[:_LONGEST_ID]
    with replacing(path, ".rrd") as part, rr.RecordingStream(name) as stream:
        memory = stream.binary_stream()
        yield stream
        part.write_bytes(memory.read(flush=True) or b"")
