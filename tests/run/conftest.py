"""A sweep of half a second on the rig, and ways to do it."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

MOVE = {"kind": "waypoints", "settle": 0.0, "points": [{"duration": 0.4, "joints": {"slide": 0.3}}]}
TINY = {
    "scenario": "rig_steps",
    "set": {"duration": 0.5, "pilot": MOVE},
    "grid": {"servo.lead": [0.0, 0.05]},
    "sample": {"count": 2, "seed": 3, "keys": {"servo.position_gain": {"uniform": [1, 6]}}},
    "repeat": 2,
}


def write_sweep(folder: Path, name: str = "tiny", **changes) -> Path:
    """A sweep file: `TINY` with changes, without what is None."""
    facts = {key: value for key, value in {**TINY, **changes}.items() if value is not None}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(facts, sort_keys=False))
    return path


def rows_of(folder: Path) -> list[dict]:
    return pq.read_table(folder / "table.parquet").to_pylist()


@pytest.fixture(scope="session")
def done(tmp_path_factory) -> Path:
    """The folder of the tiny sweep, done once without interruption, with logs."""
    from hydrotele.cli.run_command import write_run
    from hydrotele.run.sweep import SweepSettings, run_sweep
    from hydrotele.run.sweep_file import load_sweep

    folder = tmp_path_factory.mktemp("sweep")
    file = load_sweep(write_sweep(folder, logs=True))
    run_sweep(file, folder / "out", SweepSettings(jobs=1, write_run_files=write_run))
    assert json.loads((folder / "out" / "summary.json").read_text())["failed"] == 0
    return folder / "out"
