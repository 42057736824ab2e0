"""Ball in sockets: planted errors, measured data, models of the joints, outliers, bad input."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.calibrate.socket_calibration import (
    SocketOptions,
    calibrate_sockets,
    choose_robot,
    evaluate_robot,
    predict_held_out_places,
)
from hydrotele.calibrate.socket_measurement import (
    RobotErrors,
    add_random_errors,
    load_sockets,
    save_sockets,
    simulate_sockets,
)
from hydrotele.cli.main import app
from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_robot import correction_names
from hydrotele.kinematics.serial_robot_files import load_robot
from tests.measured import REAL, needs_real

PLACES = {"left": (0.4, 0.3, 0.1), "right": (0.45, -0.3, 0.1), "front": (0.55, 0.0, 0.1)}
UNSEEN = {"unseen": (0.5, 0.1, 0.25)}
MEASURED = REAL / "mukca_panda_3"


def simulated(robot="panda", rows=20, errors=None, seed=3, corrections=None):
    errors = errors or RobotErrors()
    rng = np.random.default_rng(seed)
    nominal = load_robot(robot)
    true, values = add_random_errors(nominal, errors, rng, corrections)
    return nominal, true, values, simulate_sockets(true, PLACES, rows, errors, rng)


@pytest.fixture(scope="module")
def noisy():
    return simulated()


@pytest.mark.nightly
def test_without_noise_unseen_places_are_exact():
    exact = RobotErrors(play=0.0)
    nominal, true, _, sockets = simulated(errors=exact, rows=12)
    found = calibrate_sockets(nominal, sockets, SocketOptions(model="rigid", accuracy=1e-9))
    unseen = simulate_sockets(true, UNSEEN, 10, exact, np.random.default_rng(0))
    # The prior's pull vanishes with the noise; what is left is the solver's tolerance.
    assert evaluate_robot(found.robot, unseen).rms < 1e-7
    assert evaluate_robot(nominal, unseen).rms > 1e-3


@pytest.mark.nightly
@pytest.mark.parametrize("robot", ["panda", "ur5e"])
def test_noise_leaves_less_than_it_is_itself(robot):
    nominal, true, _, sockets = simulated(robot)
    chosen, _ = choose_robot(sockets)
    assert chosen.name == robot
    found = calibrate_sockets(nominal, sockets)
    unseen = simulate_sockets(true, UNSEEN, 20, RobotErrors(play=0.0), np.random.default_rng(0))
    judged = evaluate_robot(found.robot, unseen)
    # Play of 0.1 mm per coordinate is 0.17 mm; 120 rows for some 30 parameters leave half of it.
    assert judged.rms < 0.087e-3
    assert judged.socket_distances["unseen"] == pytest.approx(0.05, abs=1e-4)
    assert found.noise == pytest.approx(1e-4, rel=0.15)


@pytest.mark.nightly
def test_base_frame_and_what_no_posture_tells_is_named(noisy):
    nominal, _, _, sockets = noisy
    told = calibrate_sockets(nominal, sockets, SocketOptions(model="rigid")).fit.identifiability
    status = dict(zip(told.names, told.status, strict=True))
    # The base frame may lie anywhere: its sockets are not known.
    for kind in ("tx", "ty", "tz", "rx", "ry", "rz"):
        assert status[f"{kind}.joint1"] in ("weak", "unidentifiable")
    assert status["x.tool"] in ("full", "combination")
    # Of a 7R chain 4 constants per joint but the first and the last's length remain, and the ball.
    assert 20 <= len(told.base) <= 27


@pytest.mark.nightly
def test_intervals_cover_most_of_what_was_planted(noisy):
    nominal, _, values, sockets = noisy
    fit = calibrate_sockets(nominal, sockets, SocketOptions(model="rigid")).fit
    error = fit.values - np.array([values[name] for name in fit.names])
    order = [fit.names.index(name) for name in fit.identifiability.names]
    weights = fit.identifiability.combination
    covariance = fit.covariance[np.ix_(order, order)]
    z = (weights @ error[order]) / np.sqrt(np.einsum("ij,jk,ik->i", weights, covariance, weights))
    # Of some 22 combinations 95 % are inside; fewer than 17 has a chance below 1 %.
    assert np.sum(np.abs(z) < 1.96) >= 17


@pytest.mark.nightly
def test_joints_that_yield_are_found():
    nominal = load_robot("panda")
    names = correction_names(nominal, True, False)
    planted = {name: 3e-4 for name in names if name.endswith(".tool")}
    _, true, _, sockets = simulated(corrections=planted, errors=RobotErrors(play=5e-5))
    found = calibrate_sockets(nominal, sockets)
    assert found.model == "gravity"
    unseen = simulate_sockets(true, UNSEEN, 20, RobotErrors(play=0.0), np.random.default_rng(0))
    rigid = calibrate_sockets(nominal, sockets, SocketOptions(model="rigid"))
    assert evaluate_robot(found.robot, unseen).rms < 0.7 * evaluate_robot(rigid.robot, unseen).rms


@pytest.mark.nightly
def test_rows_with_the_ball_elsewhere_are_named_and_left_out(noisy):
    nominal, true, _, sockets = noisy
    wrong = [s.joints.copy() for s in sockets]
    wrong[1][4] += 0.02
    wrong[3][7, 0] -= 0.01
    changed = tuple(type(s)(s.place, s.hole, s.path, q, s.lines) for s, q in zip(sockets, wrong, strict=True))
    found = calibrate_sockets(nominal, changed, SocketOptions(model="rigid"))
    assert {(o.socket, o.line) for o in found.outliers} == {("left/hole_1", 5), ("right/hole_1", 8)}
    unseen = simulate_sockets(true, UNSEEN, 20, RobotErrors(play=0.0), np.random.default_rng(0))
    assert evaluate_robot(found.robot, unseen).rms < 0.087e-3


@pytest.mark.nightly
@needs_real
def test_measured_panda_reaches_the_published_accuracy():
    sockets, _ = load_sockets(MEASURED)
    robot, _ = choose_robot(sockets)
    assert robot.name == "panda"
    (one,) = predict_held_out_places(robot, sockets, ["backleft"])
    # The data's authors: 0.2 to 0.3 mm; asked for: 0.25 mm, and 0.1 mm of the sockets' distance.
    assert one.calibrated_errors.rms < 0.25e-3
    assert one.given_errors.rms > 3e-3
    assert one.calibrated_errors.socket_distances["backleft"] == pytest.approx(0.05, abs=1e-4)


@pytest.fixture
def folder(tmp_path, noisy):
    save_sockets(noisy[3], tmp_path / "set")
    return tmp_path / "set"


def run(*words):
    return CliRunner().invoke(app, ["calibrate", "mukca", *map(str, words)])


def test_command_prints_json_and_writes_a_robot_that_is_read_again(folder, tmp_path, noisy):
    found = run("--data", folder, "--heldout", "front", "--model", "rigid", "--json",
                "--out", tmp_path / "out")  # fmt: skip
    assert found.exit_code == 0, found.output
    document = json.loads(found.output)
    assert document["heldout"]["rms_mm"] < 0.25
    assert document["heldout"]["nominal_rms_mm"] > 1.0
    assert set(document["heldout"]["parts"]) == {"front"}
    again = load_robot(tmp_path / "out/calibrated.yaml")
    front = [s for s in load_sockets(folder)[0] if s.place == "front"]
    # Written with all digits: the file predicts what the command reported.
    assert 1e3 * evaluate_robot(again, front).rms == pytest.approx(document["heldout"]["rms_mm"], rel=1e-6)
    assert (tmp_path / "out/report.html").is_file()


@pytest.mark.parametrize("damage", ["nan", "text", "columns", "few", "repeated", "degrees", "file"])
def test_bad_files_are_refused_with_their_place(folder, damage):
    path = folder / "left/hole_1.csv"
    lines = path.read_text().splitlines()
    said = {"nan": "row 3, column 2", "text": "row 3, column 2", "columns": "row 6",
            "few": "2 rows", "repeated": "repeats one posture", "degrees": "degrees",
            "file": "another robot"}  # fmt: skip
    if damage in ("nan", "text"):
        words = lines[2].split(",")
        words[1] = "nan" if damage == "nan" else "x"
        lines[2] = ",".join(words)
    elif damage == "columns":
        lines[5] = lines[5] + ",0.1"
    elif damage == "few":
        lines = lines[:2]
    elif damage == "repeated":
        lines = [lines[0]] * 20
    elif damage == "file":
        other = simulate_sockets(load_robot("iiwa14"), UNSEEN, 20, RobotErrors(),
                                  np.random.default_rng(1))  # fmt: skip
        lines = [",".join(map(str, row)) for row in other[0].joints]
    path.write_text("\n".join(lines) + "\n")
    if damage == "degrees":
        for each in folder.glob("*/*.csv"):
            np.savetxt(each, np.degrees(np.loadtxt(each, delimiter=",")), delimiter=",")
    with pytest.raises(InputError, match=said[damage]):
        CliRunner().invoke(app, ["calibrate", "mukca", "--data", str(folder)], catch_exceptions=False)


def test_degrees_are_read_where_they_are_said(folder):
    sockets, _ = load_sockets(folder)
    for each in folder.glob("*/*.csv"):
        np.savetxt(each, np.degrees(np.loadtxt(each, delimiter=",")), delimiter=",")
    again, _ = load_sockets(folder, degrees=True)
    np.testing.assert_allclose(again[0].joints, sockets[0].joints, atol=1e-12)


@pytest.mark.nightly
def test_a_joint_that_never_moves_stays_unknown_by_name():
    nominal = load_robot("panda")
    rng = np.random.default_rng(5)
    true, _ = add_random_errors(nominal, RobotErrors(), rng)
    sockets = simulate_sockets(true, PLACES, 20, RobotErrors(), rng, idle=2)
    assert all(np.ptp(s.joints[:, 2]) == 0.0 for s in sockets)
    told = calibrate_sockets(nominal, sockets, SocketOptions(model="rigid")).fit.identifiability
    alone = {n for n, s in zip(told.names, told.status, strict=True) if s == "full"}
    assert "rz.joint3" not in alone


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--heldout", "nowhere"], "not a place of the data"),
        (["--robot", "pandas"], "did you mean 'panda'"),
        (["--robot", "ur5e"], "6 moving joints up to the ball .*, but the data have 7"),
        (["--robot", "iiwa14"], "another robot"),
        (["--unit", "turns"], "rad or deg"),
        (["--model", "soft"], "not known"),
    ],
)
def test_bad_options_are_refused(folder, words, said):
    with pytest.raises(InputError, match=said):
        CliRunner().invoke(app, ["calibrate", "mukca", "--data", str(folder), *words], catch_exceptions=False)


def test_a_head_line_and_other_separators_are_read(folder):
    plain, _ = load_sockets(folder)
    path = folder / "left/hole_0.csv"
    rows = path.read_text().replace(",", "; ")
    path.write_text("q1; q2; q3; q4; q5; q6; q7\n" + rows)
    again, _ = load_sockets(folder)
    np.testing.assert_array_equal(again[2].joints, plain[2].joints)
