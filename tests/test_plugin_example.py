"""The example package tools/plugin_example: installed by pip, its plug-ins used by the commands."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hydrotele.logs.log import load_log

ROOT = Path(__file__).resolve().parent.parent
EXAMPLE = ROOT / "tools" / "plugin_example"
EFFECT = "effects=[{name: gas_spring, location: slide, parameters: {force: 400}}]"

pytest.importorskip("hatchling", reason="the test extra is not installed")

EPISODES = """
import gymnasium, numpy as np
import hydrotele.envs

for name in ("MoveSlide", "MoveSlideCompiled"):
    one = gymnasium.make(f"hydrotele/{name}-v0", variants=4)
    many = gymnasium.make_vec(f"hydrotele/{name}-v0", 3, "vector_entry_point", variants=4)
    seen, rows = one.reset(seed=1)[0], many.reset(seed=0)[0]
    ended = False
    while not ended:
        assert np.array_equal(rows[1], seen)
        seen, reward, ended, late, info = one.step(np.clip(20.0 * seen[-1:], -1.0, 1.0))
        rows, rewards, *_ = many.step(np.clip(20.0 * rows[:, -1:], -1.0, 1.0))
        assert rewards[1] == reward and not late
    print(name, info["position_error"])
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory) -> dict[str, str]:
    """Environment variables with which Python finds the package, as after `pip install`."""
    target = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "--no-input", "install", "--quiet", "--no-index", "--no-deps"]
    call([*pip, "--no-build-isolation", "--target", str(target), str(EXAMPLE)], dict(os.environ))
    paths = [str(ROOT), str(target), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}


def call(command: list[str], environment: dict[str, str], cwd: Path | None = None) -> str:
    done = subprocess.run(command, env=environment, cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def hydrotele(environment: dict[str, str], cwd: Path, *arguments: str) -> str:
    return call([sys.executable, "-m", "hydrotele", *arguments], environment, cwd)


def test_all_plugins_are_listed(environment, tmp_path):
    rows = json.loads(hydrotele(environment, tmp_path, "list", "plugins", "--json"))
    groups = {(row["group"].partition(".")[2], row["name"]) for row in rows if row["package"] == "rig-plugins"}
    assert groups == {
        ("effects", "gas_spring"), ("tasks", "MoveSlide"), ("tasks", "MoveSlideCompiled"),
        ("pilots", "slide_controller"), ("importers", "bench"),
    }  # fmt: skip
    names = [row["name"] for row in json.loads(hydrotele(environment, tmp_path, "list", "environments", "--json"))]
    assert "hydrotele/MoveSlide-v0" in names


def test_the_tasks_run_single_and_batched(environment, tmp_path):
    printed = call([sys.executable, "-c", EPISODES], environment, tmp_path).split()
    assert printed[::2] == ["MoveSlide", "MoveSlideCompiled"]
    assert all(float(error) < 0.005 for error in printed[1::2])


def test_the_pilot_drives_a_run_and_the_effect_acts_on_it(environment, tmp_path):
    scenario = str(EXAMPLE / "rig_move.yaml")
    errors = []
    for name, more in (("plain", ()), ("spring", ("--set", EFFECT))):
        said = hydrotele(environment, tmp_path, "run", scenario, "--out", name, "--no-review", "--json", *more)
        errors.append(json.loads(said)["tracking"]["slide"]["rms"])
        assert (tmp_path / name / "measured.parquet").is_file()
    assert errors[0] < 0.005 and errors[1] != errors[0]
    said = hydrotele(environment, tmp_path, "run", "rig_steps", "--policy", "slide_controller", "--out", "c", "--json",
                     "--no-review", "--set", "duration=2")  # fmt: skip
    assert json.loads(said)["scenario"] == "rig_steps"


def test_the_importer_reads_its_format(environment, tmp_path):
    rows = "\n".join(f"{10 * i};{i},0;{100 + i},5;20,0;30,0;140,0" for i in range(30))
    text = f"BENCH 1\nt [ms];valve [%];stroke [mm];pA [bar];pB [bar];pP [bar]\n{rows}\n"
    (tmp_path / "bench_1.bench").write_text(text, encoding="utf-8")
    columns = {"valve": "command.slide", "stroke": "length.slide", "pA": "pressure_head.slide"}
    (tmp_path / "map.yaml").write_text(json.dumps({"log_columns": columns}))
    hydrotele(environment, tmp_path, "import", "bench_1.bench", "--machine", "rig", "--mapping", "map.yaml")
    log = load_log(tmp_path / "bench_1.parquet")
    assert log.time[1] == pytest.approx(0.01) and log["pressure_head.slide"][0] == pytest.approx(20.0e5)
    assert log["length.slide"][0] == pytest.approx(0.1005) and log["command.slide"][10] == pytest.approx(0.1)


@pytest.mark.nightly
def test_gap_finds_the_effect(environment, tmp_path):
    """As in docs/effects.md, but without --effects: the package provides the effect."""
    for seed in ("1", "2"):
        hydrotele(environment, tmp_path, "run", "rig_steps", "--out", f"logs/run_{seed}", "--no-review", "--set",
                  f"seed={seed}", "--set", "control_rate=200", "--set", "log_rate=200", "--set", EFFECT)  # fmt: skip
    hydrotele(environment, tmp_path, "gap", "--data", "logs", "--out", "gap")
    document = json.loads((tmp_path / "gap" / "gap.json").read_text())
    assert [(effect["name"], effect["location"]) for effect in document["effects"]] == [("gas_spring", "slide")]
