"""`hydrotele calibrate arm` and `linkage` on logs of the MuJoCo closed chain."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.calibrate.loop import closure, loop_of
from hydrotele.cli.main import app
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import load_machine
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


def test_mujoco_and_kinematics_are_one_chain(runs):
    """The closed chain of MuJoCo closes in Denavit-Hartenberg form, to its pins' softness."""
    loop = loop_of(load_machine("calibrator"))
    for run in runs.values():
        theta = np.stack(
            [run.truth[c] * s for c, s in zip(loop.channels, loop.signs, strict=True)], 1
        )
        gap, _ = closure(loop, theta + loop.values[:, 0])
        assert np.abs(gap).max() < 1e-5
        assert run.summary["largest_pin_opening_mm"] < 0.01


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
        (["linkage", "--data", str(lost)], "no cylinder moves"),
    ):
        made = RUN.invoke(app, ["calibrate", *arguments])
        assert made.exit_code != 0
        assert isinstance(made.exception, SystemExit | Exception)
        assert words in made.output + str(made.exception), arguments
