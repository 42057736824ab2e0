"""The folder of a sweep: begun whole, gone on with by the same sweep, by one process at a time."""

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml

import hydrotele
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_json
from hydrotele.core.output import check_target, replacing, whole_folder
from hydrotele.sweep.checking import Base, Checked
from hydrotele.sweep.inputs import unpack

KIND = "sweep"
SCRATCH = ".scratch"
_FREE = ("name", "description", "figures", "scenario")  # change no run; its content counts
_MAKERS = ("mujoco", "dm-control", "numpy", "scipy", "numba")  # what the numbers depend on


def versions() -> dict[str, str]:
    """Versions of what a run's numbers depend on."""
    return {"hydrotele": hydrotele.__version__, **{name: version(name) for name in _MAKERS}}


def identity(base: Base, checked: Checked) -> dict[str, Any]:
    """What must be the same for two sweeps to share their runs."""
    facts = base.file.sweep.model_dump(mode="json", exclude=set(_FREE))
    return {"sweep": facts, "scenarios": checked.digest, "versions": versions()}


@contextlib.contextmanager
def sweep_folder(target: Path, base: Base, checked: Checked, fresh: bool) -> Iterator[None]:
    """Begin the folder of a sweep or go on with it, with nobody else in it.

    Args:
        target: the folder.
        base: the sweep.
        checked: its points.
        fresh: whether to throw away what an earlier sweep left there.

    Raises:
        InputError: the folder holds something else or another sweep, or is in use.
    """
    check_target(target, KIND)
    asked = identity(base, checked)
    if fresh and target.is_dir():
        with _alone(target):
            pass
    if fresh or not (target / "summary.json").is_file():
        with whole_folder(target, KIND) as folder:
            unpack(base.inputs.files(), folder)
            write_summary(folder, base, {"identity": asked})
    if not os.access(target, os.W_OK | os.X_OK):
        raise InputError(target, "cannot be written to; choose another --out")
    with _alone(target):
        there = read_json(target / "summary.json").get("identity", {})
        if found := list(_differences(there, asked)):
            more = f", and {len(found) - 4} more" if len(found) > 4 else ""
            message = "; ".join(found[:4]) + more + "; --fresh starts anew, or choose another --out"
            raise InputError(target, f"holds another sweep: {message}")
        for left in target.glob(".*"):
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink()
        (target / SCRATCH).mkdir()
        with replacing(target / "sweep.yaml", ".yaml") as part:
            part.write_text(_resolved(base))
        try:
            yield
        finally:
            shutil.rmtree(target / SCRATCH, ignore_errors=True)


def write_summary(folder: Path, base: Base, facts: dict[str, Any]) -> None:
    """Write `summary.json`, which says what the folder is."""
    summary = {"kind": KIND, "name": base.file.name, "runs": base.file.sweep.runs, **facts}
    with replacing(folder / "summary.json", ".json") as part:
        part.write_text(json.dumps(summary, indent=2) + "\n")


def _resolved(base: Base) -> str:
    """The sweep with every default, readable by `load_sweep` from any folder."""
    scenario = base.file.scenario()
    named = scenario == base.file.sweep.scenario and not Path(scenario).suffix
    facts = base.file.sweep.model_dump(mode="json", exclude_none=True)
    facts |= {"name": base.file.name}
    facts |= {"scenario": scenario if named else str(Path(scenario).resolve())}
    return yaml.safe_dump(facts, sort_keys=False, allow_unicode=True)


@contextlib.contextmanager
def _alone(target: Path) -> Iterator[None]:
    """Hold the folder; the lock goes with the process, however that ends."""
    handle = os.open(target, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise InputError(target, "another hydrotele sweep works in it; wait for it") from None
    try:
        yield
    finally:
        os.close(handle)


def _differences(old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    """Sentences on what differs between two identities; the digest only where nothing else does."""
    before, after = (_flat({k: i.get(k) for k in ("sweep", "versions")}) for i in (old, new))
    found = False
    for key in dict.fromkeys([*before, *after]):
        if before.get(key) != after.get(key):
            found = True
            was, now = (json.dumps(d[key]) if key in d else "nothing" for d in (before, after))
            yield f"{key.partition('.')[2]} was {was}, is {now}"
    if not found and old.get("scenarios") != new.get("scenarios"):
        yield "the base scenario, a file that it names, or the order of the keys has changed"


def _flat(data: dict[str, Any], above: str = "") -> dict[str, Any]:
    result = {}
    for key, value in data.items():
        if isinstance(value, dict):
            result |= _flat(value, f"{above}{key}.")
        elif value is not None:
            result[f"{above}{key}"] = value
    return result
