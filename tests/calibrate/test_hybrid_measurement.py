"""Folders of measurements: what is read, what is refused and how, and the command on them."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from hydrotele.calibrate.hybrid_measurement import COVARIANCE_COLUMNS, read_measurement, save_measurement
from hydrotele.cli.main import app
from hydrotele.core.errors import InputError
from hydrotele.kinematics.hybrid_robot import forward_kinematics, load_hybrid, pose_difference
from hydrotele.kinematics.wire_measurement import pose_covariance
from hydrotele.simulate.pose_measurements import default_wires

IWR = load_hybrid("iwr")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("hybrid") / "measured"
    run = CliRunner().invoke(app, ["calibrate", "hybrid", "--simulate", str(path), "--poses", "20", "--seed", "3"])
    assert run.exit_code == 0, run.output
    shutil.rmtree(path / "truth")  # nothing reads it
    return path


@pytest.fixture
def copied(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "measured")


def edited(copied, change):
    lines = (copied / "poses.csv").read_text().splitlines()
    (copied / "poses.csv").write_text("\n".join(change(lines)) + "\n")


def cell(row, column, value):
    def change(lines):
        at = [h.split(" ")[0] for h in lines[0].split(",")].index(column)
        cells = lines[row + 1].split(",")
        cells[at] = value
        return [*lines[: row + 1], ",".join(cells), *lines[row + 2 :]]

    return change


def test_wires_and_poses_tell_the_same(folder, copied):
    measured, heldout = read_measurement(folder, IWR)
    assert (len(measured), len(heldout), measured.noise_is_known) == (20, 25, True)
    (copied / "poses.csv").unlink()
    save_measurement(copied, "poses", IWR, measured.joints, measured.legs, pose=measured.pose)
    again, _ = read_measurement(copied, IWR)
    # nine decimals of a millimetre and of a degree
    assert np.abs(pose_difference(again.pose, measured.pose)).max() < 1e-10


def test_parquet_with_units_in_the_metadata_and_covariances(folder, copied):
    measured, _ = read_measurement(folder, IWR)
    table = {f"joint.{n}": (v, "m" if n[0] == "d" else "rad")
             for n, v in zip(IWR.joints, measured.joints.T, strict=True)}  # fmt: skip
    table |= {f"leg.{k}": (1e3 * v, "mm") for k, v in enumerate(measured.legs.T, 1)}
    from hydrotele.kinematics.hybrid_robot import rotation_to_euler

    angles = rotation_to_euler(measured.pose.rotation)
    table |= {f"pose.{c}": (v, None) for c, v in zip("xyz", measured.pose.position.T, strict=True)}
    table |= {f"pose.r{c}": (v, None) for c, v in zip("xyz", angles.T, strict=True)}
    upper = pose_covariance(default_wires(), measured.pose, 2e-5)[(slice(None), *np.triu_indices(6))]
    table |= {name: (v, None) for name, v in zip(COVARIANCE_COLUMNS, upper.T, strict=True)}
    fields = [pa.field(n, pa.float64(), metadata={"unit": u} if u else None)
              for n, (_, u) in table.items()]  # fmt: skip
    (copied / "poses.csv").unlink()
    pq.write_table(pa.table([v for v, _ in table.values()], pa.schema(fields)),
                   copied / "poses.parquet")  # fmt: skip
    again, _ = read_measurement(copied, IWR)
    assert again.noise_is_known
    assert np.allclose(again.covariance, measured.covariance, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (cell(3, "leg.2", "nan"), r"poses.csv, column 'leg.2', row 3 \(line 5\), is nan|row 3"),
        (cell(3, "leg.2", "word"), "leg.2"),
        (lambda t: [t[0].replace("leg.1 [mm]", "leg.1"), *t[1:]], r"column 'leg.1', row 0.*\[mm\]"),
        (lambda t: [t[0].replace("theta3 [deg]", "theta3"), *t[1:]], r"joint.theta3.*\[deg\]"),
        (lambda t: [t[0].replace("leg.1 [mm]", "leg.1 [deg]"), *t[1:]], "but needs m or mm"),
        (lambda t: [t[0].replace("leg.1 [mm]", "leg_1 [mm]"), *t[1:]], "did you mean 'leg.1'"),
        (lambda t: [x.split(",", 1)[1] for x in t], "has no column joint.d1"),
        (lambda t: t[:1], "contains no pose"),
        (cell(2, "wire.4", "100"), "the wires do not meet at pose 3"),
    ],
)
def test_a_wrong_table_is_refused_by_file_column_row(copied, change, message):
    edited(copied, change)
    with pytest.raises(InputError, match=message):
        read_measurement(copied, IWR)


def test_files_of_another_robot_are_refused(copied, tmp_path):
    text = (copied / "measurement.yaml").read_text()
    (copied / "measurement.yaml").write_text(text.replace("robot: iwr", "robot: hexa"))
    with pytest.raises(InputError, match="of the robot 'hexa', but the model is 'iwr'"):
        read_measurement(copied, IWR)
    (copied / "measurement.yaml").write_text(text.replace("robot: iwr\n", ""))
    measured, _ = read_measurement(copied, IWR)
    (copied / "poses.csv").unlink()
    legs = measured.legs[:, [3, 4, 5, 0, 1, 2]]
    save_measurement(copied, "poses", IWR, measured.joints, legs, pose=measured.pose)
    joints = measured.joints.copy()
    joints[:, 3] *= -1.0
    save_measurement(copied, "poses", IWR, joints, measured.legs, pose=measured.pose)
    with pytest.raises(InputError, match="it is of another robot, in other units"):
        read_measurement(copied, IWR)
    with pytest.raises(InputError, match="is not a folder"):
        read_measurement(tmp_path / "nowhere", IWR)
    with pytest.raises(InputError, match=r"contains neither poses.csv nor poses.parquet"):
        read_measurement(tmp_path, IWR)


def test_the_command_calibrates_and_its_robot_is_used_again(folder, tmp_path):
    out = tmp_path / "calibrated"
    run = CliRunner().invoke(app, ["calibrate", "hybrid", "--data", str(folder), "--out", str(out), "--json"])
    assert run.exit_code == 0, run.output
    found = json.loads(run.stdout)
    assert found["heldout"]["rms_mm"] < 0.15 < 1.0 < found["heldout"]["before_rms_mm"]
    assert found["redundancy"]["rank"] == 50 and len(found["not_identifiable"]) == 4
    assert json.loads((out / "calibration.json").read_text()) == found
    assert {p.name for p in out.iterdir()} == {
        "calibration.json", "errors.png", "robot.yaml", "summary.json"
    }  # fmt: skip
    calibrated, (measured, _) = load_hybrid(out), read_measurement(folder, IWR)
    errors = pose_difference(forward_kinematics(calibrated, measured.joints, measured.legs), measured.pose)
    rms = 1e3 * np.sqrt(np.mean(np.sum(errors[:, :3] ** 2, axis=1)))
    assert rms == pytest.approx(found["errors"]["after"]["position_rms_mm"], rel=1e-9)


def test_simulated_measurements_repeat_by_their_seed(folder, tmp_path):
    for name, seed in (("same", "3"), ("other", "4")):
        CliRunner().invoke(app, ["calibrate", "hybrid", "--simulate", str(tmp_path / name),
                                 "--poses", "20", "--seed", seed])  # fmt: skip
    text = [(p / "poses.csv").read_text() for p in (folder, tmp_path / "same", tmp_path / "other")]
    assert text[0] == text[1] != text[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give either --data FOLDER or --simulate FOLDER"),
        (["--data", "nowhere"], "is not a folder"),
        (["--data", "{}", "--model", "mdh"], "valid: auto, dh, poe"),
        (["--data", "{}", "--parameters", "a9x"], "parameter 'a9x'"),
        (["--data", "{}", "--robot", "iwrr"], "valid: iwr"),
    ],
)
def test_wrong_arguments_are_told(folder, arguments, message):
    done = CliRunner().invoke(app, ["calibrate", "hybrid", *(a.replace("{}", str(folder)) for a in arguments)])
    assert isinstance(done.exception, InputError)
    assert message in str(done.exception)


def test_the_command_draws_a_posterior(folder, tmp_path):
    arguments = ["--model", "dh", "--parameters", "a3,b1x,l4", "--posterior", "600"]
    run = CliRunner().invoke(
        app,
        ["calibrate", "hybrid", "--data", str(folder), *arguments, "--out", str(tmp_path / "out"),
         "--json"],
    )  # fmt: skip
    assert run.exit_code == 0, run.output
    found = json.loads(run.stdout)
    drawn, fitted = found["posterior"]["parameters"], found["parameters"]
    for one, other in zip(drawn, fitted, strict=True):
        assert one["name"] == other["name"]
        # 600 steps of 12 walkers with correlations of some 30: means within 0.3 deviations
        assert abs(one["mean"] - other["value"]) < 0.5 * other["standard_deviation"]
    # three parameters do not describe a robot with errors in 54
    assert "the error model (or its selected parameters) does not describe" in found["warnings"][-1]
    assert (tmp_path / "out" / "posterior.png").stat().st_size > 10000
