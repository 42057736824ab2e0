"""Results that explain nothing, wild readings, friction near reversals and at rest."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.cli.main import app
from hydrotele.identify.identification import identify_with_friction_shapes
from hydrotele.identify.mechanism import load_mechanism
from hydrotele.identify.record import IdentificationRecord
from hydrotele.identify.result import HeldOutError
from hydrotele.identify.verdict import assess_identification
from hydrotele.identify.wild_readings import find_wild_readings
from tools.studies.friction_coverage import compare_friction, load_arm, record_run

DATA = Path(__file__).parent.parent / "data" / "torque_not_explained"
COULOMB, VISCOUS, GRAVITY = 2.0, 0.3, 9.81
PENDULUM = """\
<mujoco model="pendulum"><compiler angle="radian"/>
<worldbody><body name="arm"><joint name="hinge" axis="0 1 0" damping="0.3" frictionloss="2"/>
<inertial pos="0.3 0 0" mass="2" diaginertia="0.01 0.05 0.05"/></body></worldbody>
<actuator><motor joint="hinge"/></actuator></mujoco>
"""


def identify_file(folder, name):
    words = ["identify", "--mjcf", DATA / "robot.xml", "--data", DATA / name, "--out", folder / "out"]
    return CliRunner().invoke(app, list(map(str, words)), catch_exceptions=False), folder / "out" / "identify.json"


def test_pure_noise_explains_nothing_and_says_so(tmp_path):
    result, file = identify_file(tmp_path, "noise")
    document = json.loads(file.read_text())
    assert result.exit_code == 1
    assert document["status"] == (
        "on the held-out run the model predicts crank no better than zero force: the parameters explain nothing;"
        " check the columns of force and position"
    )
    assert document["heldout"]["crank"]["explained"] is False
    (negative,) = document["notes"]
    assert negative.startswith("viscous.crank is negative, -0.28")
    assert negative.endswith("which is physically impossible: check sign, unit and column of the force.")
    assert "nan" not in result.output


def test_wild_force_readings_cost_no_parameter(tmp_path):
    result, file = identify_file(tmp_path, "spikes")
    document = json.loads(file.read_text())
    numbers = {p["name"]: p for p in document["parameters"] if p["value"] is not None}
    assert result.exit_code == 0 and document["status"] == "ok"
    assert len(numbers) == 8  # as many as without wild readings; with them, three
    for name, truth in (("coulomb.crank", 0.8), ("viscous.crank", 0.3)):
        assert numbers[name]["value"] == pytest.approx(truth, abs=4.0 * numbers[name]["std"])
    assert (
        "first: 10 of 1000 readings of the force of crank lie far outside their neighbours, the first at 2.26 s;"
        " left out."
    ) in document["notes"]


def test_steps_peaks_and_quantised_readings_are_not_wild():
    time = np.arange(0.0, 10.0, 0.02)
    noise = 0.02 * np.random.default_rng(0).standard_normal(len(time))
    step = np.sign(np.sin(2.0 * time + 0.5)) + noise
    sine = np.sin(2.0 * np.pi * 4.0 * time)  # 12 samples per period
    for signal in (step, sine, np.round(sine, 1), np.zeros(len(time))):
        assert not find_wild_readings(signal).any()
    wild = np.array([20, 21, 300, 499])
    step[wild] += 30.0
    assert np.flatnonzero(find_wild_readings(step)).tolist() == wild.tolist()


def record_pendulum(name, angle, rate, acceleration, dry, rng, sign=1.0):
    torque = 0.23 * acceleration - 2 * 0.3 * GRAVITY * np.cos(angle) + VISCOUS * rate + dry
    unknown = np.full(1, np.nan)
    position = angle + 1e-5 * rng.standard_normal(len(angle))
    force = sign * (torque + 0.02 * rng.standard_normal(len(angle)))
    return IdentificationRecord(name, 0.01, ("hinge",), position[:, None], unknown, force[:, None], unknown)


def moving_pendulum(name, rng, sign=1.0):
    time, angle, rate, acceleration = np.arange(0.0, 20.0, 0.01), 0.0, 0.0, 0.0
    for k in range(1, 6):
        w, phase = 2.0 * np.pi * 0.15 * k, rng.uniform(0.0, 2.0 * np.pi)
        angle = angle + 0.8 / k * np.sin(w * time + phase)
        rate = rate + 0.8 / k * w * np.cos(w * time + phase)
        acceleration = acceleration - 0.8 / k * w**2 * np.sin(w * time + phase)
    return record_pendulum(name, angle, rate, acceleration, COULOMB * np.sign(rate), rng, sign)


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    file = tmp_path_factory.mktemp("pendulum") / "pendulum.xml"
    file.write_text(PENDULUM)
    return load_mechanism(file).setup


def test_at_rest_friction_is_an_interval(pendulum):
    """Static poses whose dry friction is anywhere within the Coulomb friction do not contradict the model."""
    rng = np.random.default_rng(1)
    pose = np.repeat(rng.uniform(-1.0, 1.0, 10), 200)
    held = np.repeat(rng.uniform(-COULOMB, COULOMB, 10), 200)
    still = record_pendulum("still", pose, 0.0 * pose, 0.0 * pose, held, rng)
    found = identify_with_friction_shapes([moving_pendulum("a", rng), moving_pendulum("b", rng)], still, pendulum)
    judged = found.heldout["hinge"]
    assert judged.rest_fraction > 0.8
    assert judged.rest_friction == pytest.approx(COULOMB, rel=0.02)
    # gravity is predicted; friction is not known, and the jumps between the poses have accelerations
    assert judged.rms < 1.2 * np.sqrt(np.mean(held**2))
    assert judged.excess_rms < 0.3 * judged.rms
    (note,) = (note for note in found.notes if "at rest" in note)
    assert note.startswith("hinge is at rest in ")
    assert "there its dry friction is any force within +-" in note and "and the prediction has none" in note


def test_a_reversed_torque_is_reported(pendulum):
    rng = np.random.default_rng(2)
    fit, heldout = moving_pendulum("a", rng, -1.0), moving_pendulum("b", rng, -1.0)
    found = identify_with_friction_shapes([fit], heldout, pendulum)
    assert found.status.startswith("hinge: the measured force is -")
    assert found.status.endswith(" times that of the given model: check the sign and unit of its column")
    assert any(note.startswith("coulomb.hinge is negative, -2") for note in found.notes)


def heldout_error(**changes):
    facts = {"rms": 1.0, "unit": "N", "noise_rms": np.nan, "relative_error": 0.1, "nominal_rms": 2.0,
             "is_explained": True, "rest_fraction": 0.0, "rest_friction": 0.0, "excess_rms": 1.0}  # fmt: skip
    return {"hinge": HeldOutError(**(facts | changes))}


@pytest.mark.parametrize(
    ("changes", "fitted", "status"),
    [
        ({}, 0.5, "ok"),
        ({"relative_error": 1.2}, 0.9, "on the held-out run the model predicts hinge worse than zero force: are columns"
         " swapped, or is a sign or unit wrong?"),
        ({"relative_error": 0.8}, 0.9, "on the held-out run the model explains only 36 % of hinge (squared force): the"
         " force depends mostly on something else, or is noise; search for missing effects with `hydrotele gap`"),
        ({}, 0.1, "overfitted: the force error on the held-out run is 10.0 times for hinge as large as on the fitted"
         " runs: their motion is not informative enough; fit runs like the held-out run as well"),
    ],
)  # fmt: skip
def test_the_verdict_names_the_problem(pendulum, changes, fitted, status):
    assert assess_identification(heldout_error(**changes), {"hinge": fitted}, np.array([False]), pendulum) == status


def test_friction_of_a_smooth_law_is_not_underestimated():
    """MuJoCo's `frictionloss` is smooth near zero speed: a sharp law gives 1.44 instead of 1.5 N m."""
    rng = np.random.default_rng(3)
    fit, heldout = (record_run("frictionloss", name, rng, seconds=8.0) for name in ("fit", "heldout"))
    found = identify_with_friction_shapes([fit], heldout, load_arm().setup)
    rows = compare_friction("frictionloss", found)
    assert [row[0] for row in rows] == [0.3, 1.0, 0.3, 1.0]
    for speed, _, error, reach in rows:
        assert abs(error) < 2.0 * reach and reach < 0.05, speed  # two half widths: four standard deviations
