"""`hydrotele identify` and `hydrotele excite`, as a user calls them."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hydrotele.cli import main as cli
from hydrotele.core.errors import InputError
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario

KEYS = {"parameters", "condition", "heldout", "counts", "status", "seconds"}


def call(*arguments):
    return CliRunner().invoke(cli.app, [str(a) for a in arguments], catch_exceptions=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Two logs of the rig with its sensors."""
    folder = tmp_path_factory.mktemp("site")
    for seed in (1, 2):
        log = run_scenario(load_scenario("rig_steps", {"seed": str(seed)})).measured
        save_log(log, folder / f"run_{seed}.parquet")
    return folder


@pytest.fixture(scope="module")
def identified(site, tmp_path_factory):
    target = tmp_path_factory.mktemp("out") / "found"
    done = call("identify", "--data", site, "--out", target, "--json")
    assert done.exit_code == 0, done.output
    return target, json.loads(done.stdout)


def test_the_document_has_the_agreed_form(identified):
    target, document = identified
    assert document.keys() >= KEYS
    assert document == json.loads((target / "identify.json").read_text())
    for entry in document["parameters"]:
        assert entry.keys() >= {"name", "value", "std", "ci95", "status"}
        assert (entry["value"] is None) == (entry["std"] is None) == (entry["ci95"] is None)
    for judged in document["heldout"].values():
        assert judged.keys() >= {"rms", "unit", "noise_rms", "relative"}
        assert judged["rms"] < 2.0 * judged["noise_rms"]
    assert document["counts"].keys() >= {"unidentifiable", "combination", "full"}
    assert sum(document["counts"].values()) == len(document["parameters"])


def test_the_machine_and_the_report_stand_in_the_folder(identified):
    target, document = identified
    machine = load_machine(target / "identified")
    told = {p["name"]: p["value"] for p in document["parameters"] if p["value"] is not None}
    (axis,) = machine.axes.values()
    (viscous,) = (value for name, value in told.items() if name.startswith("viscous."))
    assert axis.cylinder.friction.viscous == pytest.approx(viscous, rel=0.05)
    page = (target / "report.html").read_text()
    assert "Force prediction errors on held-out data" in page and "data:image/png" in page
    assert document["friction"]
    for force in document["friction"]:
        assert f">{force['speed']:g} m/s<" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    summary = json.loads((target / "summary.json").read_text())
    assert summary["kind"] == "identify" and summary["heldout"] == "run_2"


def test_the_identified_machine_runs_and_replays(identified, site, tmp_path):
    target, _ = identified
    ran = call("run", "rig_steps", "--machine", target / "identified", "--out", tmp_path / "run",
               "--no-review")  # fmt: skip
    assert ran.exit_code == 0, ran.output
    replayed = call("replay", site / "run_2.parquet", "--machine", target / "identified", "--json")
    assert replayed.exit_code == 0, replayed.output
    assert "position.slide" in json.loads(replayed.stdout)["channels"]


@pytest.mark.nightly
def test_words_for_people(site, tmp_path):
    done = call("identify", "--data", site, "--out", tmp_path / "found", "--reduced")
    assert done.exit_code == 0, done.output
    assert "identified parameters" in done.output and "not fitted" in done.output


def test_a_foreign_folder_is_not_replaced(site, tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(InputError):
        call("identify", "--data", site, "--out", tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "keep"


def test_excite_writes_a_scenario_that_runs(tmp_path):
    file = tmp_path / "designed.yaml"
    done = call("excite", "rig", "--out", file, "--period", 6, "--harmonics", 2, "--starts", 1,
                "--cycles", 1, "--json")  # fmt: skip
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["max_limit_utilisation"] <= 1.0
    assert load_scenario(file).duration == pytest.approx(7.5)
    with pytest.raises(InputError, match="yaml"):
        call("excite", "rig", "--out", Path(tmp_path / "designed.txt"), "--starts", 1)


def test_excite_refuses_an_axis_with_its_own_pump(tmp_path):
    with pytest.raises(InputError, match="piston has a separate pump"):
        call("excite", "eha", "--out", tmp_path / "e.yaml", "--harmonics", 2, "--starts", 1)
