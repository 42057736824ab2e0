"""Simulated recordings that several tests read: each is computed once per session, for all workers.

Tests must not change the logs that they get here. `tests/conftest.py` makes the session's folder.
"""

import fcntl
import functools
import json
import os
from pathlib import Path
from typing import NamedTuple

from hydrotele.logs.log import Log, load_log, save_log
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario


class Recording(NamedTuple):
    """Both logs of a run.

    Attributes:
        measured: as the sensors read them.
        truth: simulated values.
    """

    measured: Log
    truth: Log


def record_scenario(name: str, **overrides: str | float) -> Recording:
    """Return the logs of a shipped scenario with overrides such as `duration=5.0`."""
    return _recording(name, json.dumps(overrides, sort_keys=True))


@functools.cache
def _recording(name: str, overrides: str) -> Recording:
    stem = "".join(c if c.isalnum() else "_" for c in f"{name} {overrides}")
    folder = Path(os.environ["HYDROTELE_TEST_RECORDINGS"])
    files = folder / f"{stem}.measured.parquet", folder / f"{stem}.truth.parquet"
    with (folder / f"{stem}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one worker simulates, the others wait
        if not all(file.exists() for file in files):
            words = {key: str(value) for key, value in json.loads(overrides).items()}
            run = run_scenario(load_scenario(name, words))
            for log, file in zip((run.measured, run.truth), files, strict=True):
                save_log(log, file)
    return Recording(*map(load_log, files))
