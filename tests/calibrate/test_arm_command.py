"""`hydrotele calibrate arm` and `linkage` on logs of the MuJoCo closed chain."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.calibrate.calibration_loop import build_loop, closure_error
from hydrotele.cli.main import app
from hydrotele.effects.effect import with_value
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario

RUN = CliRunner()


@pytest.fixture(scope="module")
def runs():
    """Stick and boom measured, shortened to 40 s.

    Of what the fit of p_xy.stick is off, 8 mm are no noise, as of the whole 120 s; at 20 s 13 mm.
    """
    made = {}
    for link in ("stick", "boom"):
        changes = {"duration": "40", "pilot.period": "40"}
        made[link] = run_scenario(load_scenario(f"calibrate_{link}", changes))
    return made


@pytest.fixture(scope="module")
def folder(runs, tmp_path_factory):
    place = tmp_path_factory.mktemp("calibrator")
    for link, run in runs.items():
        save_log(run.measured, place / f"{link}.parquet")
    return place


@pytest.mark.nightly
def test_mujoco_and_kinematics_are_one_chain(runs):
    """The closed chain of MuJoCo closes in Denavit-Hartenberg form, to its pins' softness."""
    loop = build_loop(load_machine("calibrator"))
    for run in runs.values():
        theta = np.stack([run.truth[c] * s for c, s in zip(loop.channels, loop.signs, strict=True)], 1)
        gap, _ = closure_error(loop, theta + loop.values[:, 0])
        assert np.abs(gap).max() < 1e-5
        assert run.summary["max_pin_opening_mm"] < 0.01


def test_arm_command(folder, tmp_path):
    made = RUN.invoke(app, ["calibrate", "arm", "--data", str(folder), "--json",
                            "--out", str(tmp_path / "arm")])  # fmt: skip
    assert made.exit_code == 0, made.output
    said = json.loads(made.stdout)
    assert {s["link"] for s in said["stages"]} == {"stick", "boom"}
    assert set(said["links_without_log"]) == {"swing", "pitch"}
    for row in said["parameters"]:  # the model's own numbers are the truth; four of 1e5 lie outside
        assert abs(row["value"] - row["nominal"]) < 4.5 * row["standard_deviation"] + 5e-3, row
    calibrated = load_machine(tmp_path / "arm" / "machine.yaml")
    assert calibrated.links["grapple_link"].position[0] == pytest.approx(1.8, abs=0.05)
    assert (tmp_path / "arm" / "report.html").stat().st_size > 10_000


def test_linkage_command(folder):
    made = RUN.invoke(app, ["calibrate", "linkage", "--data", str(folder), "--json"])
    assert made.exit_code == 0, made.output
    for axis in json.loads(made.stdout)["axes"].values():
        assert axis["heldout"]["rms_m"] < 2e-3 and axis["heldout"]["vaf_percent"] > 99.9


@pytest.mark.nightly
def test_machine_command_calibrates_kinematics_before_dynamics(folder, tmp_path):
    """A machine file with a stick 30 mm too long and 10 % too heavy a boom gets both back."""
    machine = load_machine("calibrator")
    longer = with_value(machine, "links.grapple_link.position", (1.83, 0.0, 0.0))
    heavier = with_value(longer, "links.boom.mass", 1.1 * machine.links["boom"].mass)
    (tmp_path / "given").mkdir()
    save_machine(heavier, tmp_path / "given" / "machine.yaml")
    target = tmp_path / "all"
    made = RUN.invoke(app, [
        "calibrate", "machine", "--data", str(folder), "--machine", str(tmp_path / "given"),
        "--heldout", "boom", "--json", "--out", str(target),
    ])  # fmt: skip
    assert made.exit_code == 0, made.output
    said = json.loads(made.stdout)
    assert said["arm"]["heldout"]["rms_identified_mm"] < 0.6 * said["arm"]["heldout"]["rms_nominal_mm"]
    assert set(said["linkages"]) == {"boom", "stick"}
    force = said["dynamics"]["heldout"]["boom_rod"]
    assert force["rms"] < 0.5 * force["nominal_rms"]
    found = load_machine(target / "identified")
    tip = np.linalg.norm(found.links["grapple_link"].position)
    assert abs(tip - 1.8) < 0.01  # five standard deviations of 150 poses of 20 s
    summary = json.loads((target / "summary.json").read_text())
    assert summary["kind"] == "machine calibration"


def test_unusable_input_is_one_sentence(folder, tmp_path):
    lost = tmp_path / "lost"
    lost.mkdir()
    (lost / "stick.csv").write_text("time,angle.boom [rad]\n" + "\n".join(
        f"{0.02 * k},{0.01 * k}" for k in range(20)))  # fmt: skip
    for arguments, words in (
        (["arm", "--data", str(lost)], "angle.grapple"),
        (["arm", "--data", str(folder), "--machine", "cat215"], "has no sensed_joints"),
        (["arm", "--data", str(folder), "--method", "both"], "valid: joint, hierarchical"),
        (["arm", "--data", str(folder), "--heldout", "all"], "whole number"),
        (["linkage", "--data", str(lost)], "no cylinder turns its joint"),
    ):
        made = RUN.invoke(app, ["calibrate", *arguments])
        assert made.exit_code != 0
        assert isinstance(made.exception, SystemExit | Exception)
        assert words in made.output + str(made.exception), arguments
