"""The blind trials: planting and hiding; a small series with a stub for the workflow."""

import contextlib
import io
import json
import os
import shlex
import signal
import stat
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest

from hydrotele.effects import EFFECTS
from hydrotele.machine.machine_file import load_machine
from tools.validation import blind_trials
from tools.validation.blind.draw import (
    SMALLEST,
    Planted,
    draw_double,
    draw_effect,
    draw_outside,
    with_effects,
)
from tools.validation.blind.generate import make_trial
from tools.validation.blind.motions import motions
from tools.validation.blind.outside import OUTSIDE
from tools.validation.blind.plant import record
from tools.validation.blind.trials import Place, Series
from tools.validation.blind.visibility import visibility

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "tools" / "validation" / "blind_trials.py"
MACHINE = load_machine("cat215", tool="none")


def test_drawn_sizes_are_plausible_and_never_tiny():
    rng = np.random.default_rng(1)
    signs, names = set(), set()
    for _ in range(900):
        planted = draw_effect(MACHINE, rng)
        names.add(planted.name)
        known = EFFECTS[planted.name].parameters(MACHINE, planted.location)
        assert planted.parameters.keys() == {key for key, p in known.items() if not p.optional}
        for name, value in planted.parameters.items():
            p = known[name]
            assert p.lower_bound <= value <= p.upper_bound
            assert abs(value - p.nominal) >= 0.999 * SMALLEST * p.min_relevant_change
            signs.add((planted.name, np.sign(value - p.nominal)))
    assert {("angle_offset", -1.0), ("angle_offset", 1.0)} <= signs
    here = [effect for effect in EFFECTS.values() if effect.locations(MACHINE)]
    assert len(names) > 0.9 * len(here)


def test_doubles_do_not_overwrite_each_other():
    rng = np.random.default_rng(2)
    for _ in range(50):
        one, two = draw_double(MACHINE, rng)
        both = with_effects(MACHINE, [one, two])
        assert both == with_effects(MACHINE, [two, one])
        assert both != with_effects(MACHINE, [one]) and both != with_effects(MACHINE, [two])


def test_motions_differ_from_trial_to_trial_and_are_of_four_kinds():
    one, two, again = (motions(MACHINE, np.random.default_rng(s)) for s in (1, 2, 1))
    assert one == again
    assert [s.name for s in one] == ["fit_1", "fit_2", "fit_3", "test_1"]
    assert all(a.pilot != b.pilot and a.seed != b.seed for a, b in zip(one, two, strict=True))
    speeds = [np.std(np.diff(s.pilot.columns["stick"])) for s in one]
    assert speeds[0] < speeds[1] < speeds[2]


SHORT = 10.0  # s, enough for every effect to act


@pytest.fixture(scope="module")
def fast_run():
    return motions(MACHINE, np.random.default_rng(4), SHORT)[2]


def seen(scenario, planted):
    runs = {scenario.name: record(MACHINE, scenario, planted)}
    others = [p for p in planted if p.name not in OUTSIDE][1:]
    return visibility(with_effects(MACHINE, others), runs)["total_fit_runs"]


def test_an_unchanged_machine_shows_nothing(fast_run):
    # Below one sigma in 6000 readings: states at equal times are of second order in the step.
    assert seen(fast_run, []) < 1.0


@pytest.mark.nightly
@pytest.mark.parametrize("turn", range(len(OUTSIDE)))
def test_every_effect_outside_the_library_shows(fast_run, turn):
    planted = draw_outside(MACHINE, turn, np.random.default_rng([3, turn]))
    assert planted.name not in EFFECTS
    assert seen(fast_run, [planted]) > 5.0  # what a test that knows it could tell from noise
    assert mujoco.get_mjcb_control() is None


@pytest.mark.nightly
def test_a_scored_bore_rubs_at_its_place_only(fast_run):
    plain = record(MACHINE, fast_run, []).truth
    passed = plain["length.stick"]

    def change(centre):
        parameters = {"force": 9000.0, "width": 0.05, "centre": centre}
        run = record(MACHINE, fast_run, [Planted("bore_friction", "stick", parameters)]).truth
        return np.abs(run["pressure_head.stick"] - plain["pressure_head.stick"]).max()

    assert change(passed.mean()) > 1e5  # Pa: 9 kN on 0.015 m^2 is 6e5 Pa
    assert change(passed.max() + 0.5) < 1.0  # ten widths away the bell is 2e-22 of 9 kN


@pytest.mark.nightly
def test_a_key_tells_all_and_the_logs_nothing(tmp_path):
    series = Series(seed=5, counts={"single": 0, "double": 1, "clean": 0, "outside": 0}, duration=4)
    (tmp_path / "a" / "keys").mkdir(parents=True)
    (tmp_path / "b" / "keys").mkdir(parents=True)
    one, two = Place(tmp_path / "a", "0000"), Place(tmp_path / "b", "0000")
    for place in (one, two):
        make_trial(place, series)
    sealed = json.loads(one.key.read_text())
    assert len(sealed["effects"]) == 2
    assert stat.S_IMODE(one.key.stat().st_mode) == 0o600
    assert all(e["visibility"]["total_fit_runs"] > 0 for e in sealed["effects"])
    assert sorted(p.name for p in one.folder.iterdir()) == ["data", "seal.txt"]
    logs = sorted(one.data.iterdir())
    assert [p.name for p in logs] == [f"{n}.parquet" for n in ("fit_1", "fit_2", "fit_3", "test_1")]
    for log in logs:
        assert log.read_bytes() == (two.data / log.name).read_bytes()
        schema = pq.read_schema(log)
        told = {k.decode() for k in schema.metadata if k != b"ARROW:schema"}
        assert told == {"machine", "tool", "sample_rate_hz", "sensors", "run"}
        assert not [name for name in schema.names if name.startswith("truth")]


STUB = """
import json, os, sys, time
from pathlib import Path
here = Path(__file__).parent
data = Path(sys.argv[1])
seen = {"arguments": sys.argv[1:], "environment": dict(os.environ), "folder": os.getcwd(),
        "files": sorted(p.name for p in data.iterdir()),
        "writable": [p.name for p in data.iterdir() if p.stat().st_mode & 0o222],
        "beside": sorted(os.listdir(data.parent))}
(here / f"seen_{time.time_ns()}.json").write_text(json.dumps(seen))
print(json.dumps({"verdict": "no_gap", "effects": [], "unknown": None, "seconds": 0.1,
                  "gap": {"metric": "", "before": 1.0, "after": 1.0, "noise_floor": 1.0}}))
"""


class SmallSeries:
    """A series of short trials with a stub for the workflow."""

    def __init__(self, folder: Path) -> None:
        self.out, self.stub = folder / "series", folder / "stub" / "stub.py"
        self.stub.parent.mkdir()
        self.stub.write_text(STUB)
        scratch = folder / "scratch"
        scratch.mkdir()
        self.environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(scratch)}

    def command(self, *more: str) -> list[str]:
        workflow = shlex.join([sys.executable, str(self.stub), "{data}", "{machine}"])
        return [sys.executable, str(SCRIPT), "--out", str(self.out), "--workflow", workflow, *more]

    def run(self, *more: str) -> subprocess.CompletedProcess:
        """The same in this process: what matters here is what it starts."""
        told, asked = (io.StringIO(), io.StringIO()), self.command(*more)[1:]
        with (
            pytest.MonkeyPatch.context() as patched,
            contextlib.redirect_stdout(told[0]), contextlib.redirect_stderr(told[1]),
        ):  # fmt: skip
            patched.setattr(sys, "argv", asked)
            for name in ("PYTHONPATH", "TMPDIR"):
                patched.setenv(name, self.environment[name])
            patched.setattr(tempfile, "tempdir", self.environment["TMPDIR"])
            try:
                status = blind_trials.main()
            except SystemExit as ended:
                status = ended.code
        return subprocess.CompletedProcess(asked, status, *(t.getvalue() for t in told))

    def results(self) -> dict[str, tuple[int, str]]:
        found = sorted(self.out.glob("trials/*/result.json"))
        return {p.parent.name: (p.stat().st_mtime_ns, p.read_text()) for p in found}


@pytest.fixture(scope="module")
def killed_and_resumed(tmp_path_factory):
    """A series that was killed after its first trial and then started again."""
    series = SmallSeries(tmp_path_factory.mktemp("blind"))
    asked = ("--single", "1", "--clean", "1", "--seed", "7", "--duration", "4")
    with subprocess.Popen(
        series.command(*asked, "--jobs", "1"), env=series.environment,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    ) as process:  # fmt: skip
        deadline = time.monotonic() + 120
        while not series.results() and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGKILL)
    early = series.results()
    assert len(early) == 1
    return series, early, series.run("--jobs", "2")


@pytest.mark.nightly
def test_a_killed_series_goes_on_where_it_was(killed_and_resumed):
    series, early, again = killed_and_resumed
    assert again.returncode == 0, again.stderr
    assert "2 trials, 1 to run" in again.stdout
    assert series.results().keys() == {"0000", "0001"}
    assert early.items() <= series.results().items()
    for name in ("summary.json", "summary.md", "confusion.png", "reliability.png", "closure.png"):
        assert (series.out / name).stat().st_size > 0
    summary = json.loads((series.out / "summary.json").read_text())
    assert summary["classes"]["clean"]["right"]["share"] == 1.0
    assert summary["classes"]["single"]["right"]["share"] == 0.0
    assert "with the keys swapped" in again.stdout


@pytest.mark.nightly
def test_the_workflow_sees_nothing_but_logs(killed_and_resumed):
    series, _, _ = killed_and_resumed
    folders = list(series.stub.parent.glob("seen_*.json"))
    assert len(folders) >= 2
    for path in folders:
        text = path.read_text()
        assert str(series.out) not in text and "keys" not in text
        found = json.loads(text)
        assert found["files"] == [f"{n}.parquet" for n in ("fit_1", "fit_2", "fit_3", "test_1")]
        assert found["writable"] == [] and found["beside"] == ["data"]
        assert found["arguments"][1] == "cat215"


@pytest.mark.nightly
def test_one_trial_runs_anew_with_the_same_data(killed_and_resumed):
    series, _, _ = killed_and_resumed
    before, data = series.results(), (series.out / "trials/0001/data/fit_1.parquet").read_bytes()
    done = series.run("--only", "0001", "--no-score")
    assert done.returncode == 0, done.stderr
    after = series.results()
    assert after["0001"][0] > before["0001"][0] and after["0000"] == before["0000"]
    assert (series.out / "trials/0001/data/fit_1.parquet").read_bytes() == data
    wrong = series.run("--only", "0009")
    assert wrong.returncode == 2 and "0000 .. 0001" in wrong.stderr


@pytest.mark.nightly
def test_a_series_is_not_mixed_with_another(killed_and_resumed):
    series, _, _ = killed_and_resumed
    done = series.run("--single", "5", "--seed", "7")
    assert done.returncode == 2 and "holds another series" in done.stderr


@pytest.mark.nightly
def test_a_changed_key_is_found_out(killed_and_resumed):
    series, _, _ = killed_and_resumed
    path = series.out / "keys" / "0000.json"
    sealed = path.read_bytes()
    try:
        path.write_bytes(sealed.replace(b'"class"', b'"Class"'))
        done = series.run("--score-only")
        assert done.returncode == 2 and "sealed" in done.stderr
    finally:
        path.write_bytes(sealed)


CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.mark.nightly
def test_a_cluster_runs_the_trials(tmp_path):
    pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    series = SmallSeries(tmp_path)
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL, text=True, env=series.environment, cwd=tmp_path,
    ) as cluster:  # fmt: skip
        assert cluster.stdout and cluster.stdin
        address = cluster.stdout.readline().strip()
        done = series.run("--clean", "1", "--single", "1", "--duration", "4", "--dask", address)
        cluster.stdin.close()
    assert done.returncode == 0, done.stderr
    assert len(series.results()) == 2
    assert "single: 0.0 % of 1" in done.stdout


@pytest.mark.nightly
def test_the_workflow_itself_answers_a_planted_trial(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    asked = ["--out", str(tmp_path / "o"), "--single", "1", "--clean", "0", "--seed", "8"]
    asked += ["--duration", "20"]  # s, half of a real series' runs
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *asked], env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert summary["failed"] == []
    assert [row["right"] for row in summary["answers"]] == [True], summary["answers"]
