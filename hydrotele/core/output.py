"""Atomic output: files and folders that are written completely or not at all.

Output goes to a hidden temporary name first and is renamed when it is complete.
"""

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
from hydrotele.core.files import read_json, resolve_path

OUTPUT_FILES = {
    "run": ("measured.parquet", "truth.parquet", "review.rrd", "scenario.yaml", "machine.*",
            "machine_assets/*"),
    "replay": ("*.png", "*.rrd", "*_simulated.parquet"),
    "gap": (
        "gap.json", "report.html", "recording.rrd", "next_experiment.yaml",
        "patched/machine.*", "patched/machine_assets/*", "patched/effects.yaml", "patched/*.py",
        "posterior.parquet", "posterior/machine.*", "posterior/machine_assets/*", "posterior/*.py",
    ),
    "interim gap": ("gap.json", "interim.json", "machine.*", "machine_assets/*", "*.py"),
    "compare": ("compare.json", "*.png"),
    "contact": ("contact.json", "mask.csv", "*.parquet"),
    "robot calibration": ("calibration.json", "report.html", "*.png", "calibrated.yaml",
                          "calibrated.urdf"),
    "arm calibration": ("calibration.json", "report.html", "machine.yaml"),
    "linkage calibration": ("calibration.json", "report.html", "machine.yaml"),
    "imu calibration": ("calibration.json", "machine.*", "machine_assets/*", "logs/*.parquet"),
    "calibrator design": ("calibration.json", "design.png"),
    "machine calibration": ("calibration.json", "identify.json", "report.html", "kinematics/*",
                            "identified/machine.*", "identified/machine_assets/*"),
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
"""Kind of output folder -> its files, in addition to `summary.json`, which states the kind."""


@contextlib.contextmanager
def atomic_folder(target: str | Path, kind: str) -> Iterator[Path]:
    """Create an output folder atomically: write to a hidden folder and rename it at the end.

    Args:
        target: folder to create; an existing folder of the same kind is replaced.
        kind: kind of output, such as `run`; a key of `OUTPUT_FILES`, which lists its files.

    Yields:
        The temporary folder to write to. A killed run leaves only `.NAME.*.part`, which the next
        run with the same target removes.

    Raises:
        InputError: as `check_output_folder`, or the folder cannot be created or written.
    """
    asked, target = target, resolve_path(target)
    check_output_folder(asked, kind)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        for stale in target.parent.glob(f".{glob.escape(target.name)}.*.part"):
            if _is_temporary_folder(stale) and not _is_process_running(stale):
                shutil.rmtree(stale, ignore_errors=True)
        prefix = f".{target.name}.{os.getpid()}."
        part = Path(tempfile.mkdtemp(prefix=prefix, suffix=".part", dir=target.parent))
    except OSError as error:
        raise InputError(asked, f"cannot be created: {error.strerror}") from None
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
            raise InputError(asked, f"cannot be written, output removed: {reason}") from error
        raise


def check_output_folder(target: str | Path, kind: str) -> None:
    """Check that a folder can be created or replaced without deleting files of the user.

    Args:
        target: the folder to be written.
        kind: kind of output, such as `run`; a key of `OUTPUT_FILES`, which lists its files.

    Raises:
        InputError: the target is a file, a folder of another kind, a folder with unknown files, or
            it cannot be created.
    """
    place = resolve_path(target)
    if not place.exists():
        above = next(p for p in (place, *place.parents) if os.path.lexists(p))  # a link in a loop exists, too
        if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
            raise InputError(target, f"cannot be created: {above} is not a writable folder")
        return
    if not place.is_dir():
        raise InputError(target, f"exists and was not written by a {kind}; choose another --out")
    if any(place.iterdir()) and _read_output_kind(place) != kind:
        raise InputError(target, f"exists and was not written by a {kind}; choose another --out")
    patterns = ("summary.json", *OUTPUT_FILES[kind])
    inside = sorted(path.relative_to(place).as_posix() for path in place.rglob("*"))
    strange = [name for name in inside if not any(_is_match(name, p) for p in patterns)]
    if strange:
        listed = ", ".join(strange[:3])
        message = f"contains {listed}, not written by a {kind}; choose another --out"
        raise InputError(target, message)


def _is_match(name: str, pattern: str) -> bool:
    """Return whether a relative path matches a pattern such as `runs/*/*`, or its first components.

    The second case accepts parent folders of matching files.
    """
    parts, wanted = name.split("/"), pattern.split("/")
    return len(parts) <= len(wanted) and all(map(fnmatch.fnmatch, parts, wanted))


def _read_output_kind(folder: Path) -> str | None:
    """Return the kind stated in a folder's `summary.json`; None if it cannot be read."""
    try:
        return read_json(folder / "summary.json").get("kind")
    except (InputError, AttributeError):
        return None


_TEMPORARY_NAME = re.compile(r"\.(\d+)\.[a-z0-9_]{8}(?:\.old)?\.part$")  # process id, mkdtemp


def _is_temporary_folder(part: Path) -> bool:
    """Return whether a path is a temporary folder that `atomic_folder` created."""
    return bool(_TEMPORARY_NAME.search(part.name)) and part.is_dir() and not part.is_symlink()


def _is_process_running(part: Path) -> bool:
    """Return whether the process that created a temporary folder is another running process."""
    try:
        pid = int(_TEMPORARY_NAME.findall(part.name)[0])
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return pid != os.getpid()


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike, suffix: str) -> Iterator[Path]:
    """Write a file atomically: yield a temporary path in the same folder and rename it at the end.

    Args:
        path: the file to write.
        suffix: required file extension, with the dot; "" for any.

    Yields:
        The temporary path to write to. A killed process leaves at most one hidden file.

    Raises:
        InputError: the extension is wrong, or the folder is not writable. No file is left behind.
    """
    path = Path(path)
    if suffix and path.suffix.lower() != suffix:
        raise InputError(path, f"must have a name that ends in {suffix}")
    if not path.parent.is_dir():
        raise InputError(path, f"cannot be written: {path.parent} is not a folder")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(path, f"cannot be written: {path.parent} is not writable")
    part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise InputError(path, f"cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):  # fails if the file system has become read-only
            part.unlink(missing_ok=True)
