"""Folders that appear whole or not at all."""

import contextlib
import os
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
        InputError: the target is a file, or a folder that was not written by a run.
    """
    target = Path(target)
    check_target(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    for stale in target.parent.glob(f".{target.name}.*.part"):
        if not _alive(stale):
            shutil.rmtree(stale, ignore_errors=True)
    prefix = f".{target.name}.{os.getpid()}."
    part = Path(tempfile.mkdtemp(prefix=prefix, suffix=".part", dir=target.parent))
    part.chmod(0o755)
    try:
        yield part
        old = None
        if target.exists():
            old = part.with_suffix(".old.part")
            target.rename(old)
        part.rename(target)
        if old:
            shutil.rmtree(old, ignore_errors=True)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def check_target(target: Path) -> None:
    """Refuse to replace what is not ours.

    Raises:
        InputError: the target is a file, or a folder with something in it but no summary.json.
    """
    if not target.exists() or (target / "summary.json").is_file():
        return
    if target.is_file() or next(target.iterdir(), None) is not None:
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


def write_text(path: Path, text: str) -> None:
    """Write a file so that it appears whole or not at all."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_text(text)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
