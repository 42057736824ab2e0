"""Files and folders that appear whole or not at all."""

import contextlib
import fnmatch
import glob
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from hydrotele.core.errors import InputError
from hydrotele.core.files import read_json

OURS = {
    "run": ("measured.parquet", "truth.parquet", "review.rrd", "scenario.yaml", "machine.*",
            "machine_assets/*"),
    "replay": ("*.png", "*.rrd", "*_simulated.parquet"),
    "gap": (
        "gap.json", "report.html", "recording.rrd", "next_experiment.yaml",
        "patched/machine.*", "patched/machine_assets/*", "patched/effects.yaml",
    ),
    "compare": ("compare.json", "*.png"),
    "robot calibration": ("calibration.json", "report.html", "*.png", "calibrated.yaml",
                          "calibrated.urdf"),
    "arm calibration": ("calibration.json", "report.html", "machine.yaml", "*.png"),
    "identify": ("identify.json", "report.html", "identified/machine.*",
                 "identified/machine_assets/*"),
    "experiments": ("experiments.json", "table.md", "report.html", "figures/*"),
    "hybrid calibration": ("calibration.json", "robot.yaml", "*.png"),
    "hybrid measurement": ("*.csv", "*.yaml", "truth/*"),
    "two-port analysis": ("analysis.json", "report.html", "stability.png"),
    "sweep": (
        "sweep.yaml", "journal.jsonl", "table.parquet", "timings.csv", "report.html", "*.png",
        "inputs/*/*", "inputs/*/*/*", "runs/*/*", ".*", ".scratch/*/*", ".scratch/*/run/*",
        "runs/.*.part/*",
    ),
}  # fmt: skip
"""Kind of folder -> files that it holds beside `summary.json`, which states the kind."""


@contextlib.contextmanager
def whole_folder(target: str | Path, kind: str) -> Iterator[Path]:
    """Write into a hidden folder beside the target and rename it when everything is there.

    Args:
        target: folder to make; an older one of that name and kind is replaced.
        kind: a key of `OURS`.

    Yields:
        The folder to write into. A killed run leaves only `.NAME.*.part`, which the next run of the
        same name removes.

    Raises:
        InputError: as `check_target`.
    """
    asked, target = target, Path(target).resolve()
    check_target(asked, kind)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        for stale in target.parent.glob(f".{glob.escape(target.name)}.*.part"):
            if _ours(stale) and not _alive(stale):
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
        if isinstance(error, InputError) and str(part) in error.where:
            raise InputError(error.where.replace(str(part), str(asked)), error.message) from error
        if isinstance(error, OSError):
            reason = error.strerror or str(error)
            raise InputError(asked, f"cannot be written, nothing is left: {reason}") from error
        raise


def check_target(target: str | Path, kind: str) -> None:
    """Refuse to replace what is not ours, or to write where one cannot.

    Args:
        target: the folder to be written.
        kind: a key of `OURS`.

    Raises:
        InputError: the target is a file, a folder of another kind or with other files in it, or
            lies where no folder can be made.
    """
    place = Path(target).resolve()
    if not place.exists():
        above = next(p for p in place.parents if p.exists())
        if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
            raise InputError(target, f"cannot be made: {above} is no folder that can be written to")
        return
    if not place.is_dir():
        raise InputError(target, f"exists and was not written by a {kind}; choose another --out")
    inside = sorted(path.relative_to(place).as_posix() for path in place.rglob("*"))
    if inside and _kind(place) != kind:
        raise InputError(target, f"exists and was not written by a {kind}; choose another --out")
    patterns = ("summary.json", *OURS[kind])
    strange = [name for name in inside if not any(_matches(name, p) for p in patterns)]
    if strange:
        message = f"holds {', '.join(strange[:3])}, which no {kind} wrote; choose another --out"
        raise InputError(target, message)


def _matches(name: str, pattern: str) -> bool:
    """Whether a path is of a pattern, or is a folder on the way to it."""
    parts, wanted = name.split("/"), pattern.split("/")
    return len(parts) <= len(wanted) and all(map(fnmatch.fnmatch, parts, wanted))


def _kind(folder: Path) -> str | None:
    try:
        return read_json(folder / "summary.json").get("kind")
    except (InputError, AttributeError):
        return None


_PART = re.compile(r"\.(\d+)\.[a-z0-9_]{8}(?:\.old)?\.part$")  # process, letters of mkdtemp


def _ours(part: Path) -> bool:
    """Whether a killed run left this folder: a user's own is never removed."""
    return bool(_PART.search(part.name)) and part.is_dir() and not part.is_symlink()


def _alive(part: Path) -> bool:
    try:
        pid = int(_PART.findall(part.name)[0])
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
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
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(path, f"cannot be written: {path.parent} cannot be written to")
    part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise InputError(path, f"cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):  # a file system that became read-only keeps it
            part.unlink(missing_ok=True)
