"""Files all or nothing: a path holds the old content or the whole new one, never a part."""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from hydrotele.errors import InputError


@contextlib.contextmanager
def replacing(path: str | os.PathLike, suffix: str) -> Iterator[Path]:
    """Give a path beside `path` to write to; it takes the place of `path` at the end.

    Args:
        path: the file to write.
        suffix: the ending that its name must have, with the dot.

    Raises:
        InputError: the name ends otherwise, or the folder cannot be written. Nothing is left then.
    """
    path = Path(path)
    if path.suffix.lower() != suffix:
        raise InputError(path, f"give it a name that ends in {suffix}")
    if not path.parent.is_dir():
        raise InputError(path, f"cannot be written: {path.parent} is not a folder")
    part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{suffix}")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise InputError(path, f"cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
