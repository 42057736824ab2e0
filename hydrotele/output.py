"""Files and folders that appear whole or not at all."""

import contextlib
import glob
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from hydrotele.errors import InputError


@contextlib.contextmanager
def whole_folder(target: str | Path) -> Iterator[Path]:
    """Write into a hidden folder beside the target and rename it when everything is there.

    Args:
        target: folder to make; an older one of that name is replaced, if it is one of ours.

    Yields:
        The folder to write into. A killed run leaves only `.NAME.*.part`, which the next run of the
        same name removes.

    Raises:
        InputError: the target is a file, a folder that was not written by a run, or cannot be
            written.
    """
    asked, target = target, Path(target).resolve()
    check_target(asked)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        for stale in target.parent.glob(f".{glob.escape(target.name)}.*.part"):
            if not _alive(stale):
                shutil.rmtree(stale, ignore_errors=True)
        prefix = f".{target.name}.{os.getpid()}."
        part = Path(tempfile.mkdtemp(prefix=prefix, suffix=".part", dir=target.parent))
    except OSError as error:
        raise InputError(asked, f"cannot be made: {error.strerror}") from None
    old = part.with_suffix(".old.part")
    try:
        part.chmod(0o755)
        yield part
        if target.exists():
            target.rename(old)
        part.rename(target)
        shutil.rmtree(old, ignore_errors=True)
    except BaseException as error:
        if old.exists() and not target.exists():
            old.rename(target)
        shutil.rmtree(part, ignore_errors=True)
        if isinstance(error, OSError):
            reason = error.strerror or str(error)
            raise InputError(asked, f"cannot be written, nothing is left: {reason}") from error
        raise


def check_target(target: str | Path) -> None:
    """Refuse to replace what is not ours, or to write where one cannot.

    Raises:
        InputError: the target is a file, or a folder with something in it but no summary.json, or
            lies where no folder can be made.
    """
    place = Path(target).resolve()
    if not place.exists():
        above = next(p for p in place.parents if p.exists())
        if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
            raise InputError(target, f"cannot be made: {above} is no folder that can be written to")
        return
    if (place / "summary.json").is_file():
        return
    if not place.is_dir() or next(place.iterdir(), None) is not None:
        raise InputError(target, "exists and was not written by a run; choose another --out")


def _alive(part: Path) -> bool:
    try:
        pid = int(part.name.split(".")[-3])
        os.kill(pid, 0)
    except (ValueError, IndexError, ProcessLookupError):
        return False
    except PermissionError:
        return True
    return pid != os.getpid()


@contextlib.contextmanager
def replacing(path: str | os.PathLike, suffix: str) -> Iterator[Path]:
    """Give a path beside `path` to write to; it takes the place of `path` at the end.

    Args:
        path: the file to write.
        suffix: the ending that its name must have, with the dot; "" for any.

    Yields:
        The path to write to. A killed process leaves at most a hidden file of another name.

    Raises:
        InputError: the name ends otherwise, or the folder cannot be written. Nothing is left then.
    """
    path = Path(path)
    if suffix and path.suffix.lower() != suffix:
        raise InputError(path, f"give it a name that ends in {suffix}")
    if not path.parent.is_dir():
        raise InputError(path, f"cannot be written: {path.parent} is not a folder")
    part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise InputError(path, f"cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
