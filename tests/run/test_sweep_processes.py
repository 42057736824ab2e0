"""The real program, killed, interrupted and on a cluster."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import hydrotele
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder, scenarios_folder
from hydrotele.run import sweep as cluster
from hydrotele.run.sweep import SweepSettings, run_sweep
from hydrotele.run.sweep_file import load_sweep
from tests.run.conftest import rows_of, write_sweep

ROOT = Path(hydrotele.__file__).parents[1]
CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


def environment() -> dict[str, str]:
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths)), "COLUMNS": "200"}


def start(*words) -> subprocess.Popen:
    """`hydrotele sweep` in a group of its own, as a terminal's foreground job is."""
    return subprocess.Popen(
        [sys.executable, "-m", "hydrotele", "sweep", *map(str, words)], env=environment(),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=_heed_interrupts,
    )  # fmt: skip


def _heed_interrupts() -> None:
    """A shell's job in the background ignores them, and so do all programs that it starts."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def lines(journal: Path) -> int:
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


@pytest.mark.nightly
@pytest.mark.parametrize(
    "signals",
    [
        (signal.SIGINT,),
        pytest.param((signal.SIGINT, signal.SIGKILL), marks=pytest.mark.nightly),
    ],
)
def test_interrupted_sweep_ends_as_an_uninterrupted_one(signals, done, tmp_path):
    journal = tmp_path / "out" / "journal.jsonl"
    file, out = write_sweep(tmp_path, logs=True), tmp_path / "out"
    for number in signals:
        process, before = start(file, "--out", out, "--jobs", "1"), lines(journal)
        while lines(journal) < before + 2 and process.poll() is None:
            time.sleep(0.005)
        if number == signal.SIGINT:
            os.killpg(process.pid, number)  # as Ctrl-C does: the workers hear it, too
        else:
            process.kill()
        _, said = process.communicate(timeout=60)
        if number == signal.SIGINT:
            assert process.returncode == 130 and "Traceback" not in said
            assert f"{lines(journal)} of 8 runs are finished" in said and "to continue" in said
    # As if the power had failed while the journal and the table were written.
    kept = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(kept[:-1]) + kept[-1][:100])
    (out / ".table.0a.parquet").write_bytes(b"half")
    swept = run_sweep(load_sweep(file), out, SweepSettings(jobs=2))  # another number of processes
    assert swept.n_executed == 8 - len(kept[:-1])  # nothing is done twice
    assert (out / "table.parquet").read_bytes() == (done / "table.parquet").read_bytes()
    assert lines(journal) == 8 and not list(out.glob(".*"))


@pytest.mark.nightly
def test_a_cluster_gives_the_same_table(done, tmp_path):
    pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "mine").symlink_to(models_folder() / "rig")
    text = (scenarios_folder() / "rig_steps.yaml").read_text()
    (tmp_path / "there" / "s.yaml").write_text(text.replace("machine: rig", "machine: mine"))
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL, text=True, env=environment(), cwd=tmp_path,
    ) as started:  # fmt: skip
        assert started.stdout and started.stdin
        address = started.stdout.readline().strip()
        file = write_sweep(tmp_path / "there", scenario="s.yaml", logs=True)
        process = start(file, "--out", tmp_path / "out", "--dask", address)
        _, said = process.communicate(timeout=180)
        started.stdin.close()
    assert process.returncode == 0, said
    assert rows_of(tmp_path / "out") == rows_of(done)
    for name in ("measured.parquet", "truth.parquet"):
        there, here = (folder / "runs" / "0003" / name for folder in (tmp_path / "out", done))
        assert there.read_bytes() == here.read_bytes()


def test_a_cluster_that_is_not_there_is_said(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    monkeypatch.setattr(cluster, "_CLUSTER_TIMEOUT", 1)
    with pytest.raises(InputError, match="no scheduler responds at tcp://127.0.0.1:1"):
        run_sweep(
            load_sweep(write_sweep(tmp_path)),
            tmp_path / "o",
            SweepSettings(dask="tcp://127.0.0.1:1"),
        )
