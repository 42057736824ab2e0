"""The SCARA of Wang 2012, section 1.1: planted lengths, offsets by prediction, bad input."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.calibrate.scara_calibration import (
    MEASURED_FILE,
    MeasuredPositions,
    ScaraSpec,
    calibrate_scara,
    fit_scara,
    scara_chain,
    select_scara_poses,
    simulate_scara,
)
from hydrotele.cli.main import app
from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_chain import chain_poses

ARM = ScaraSpec(length_a=0.4, length_b=0.3)


def test_chain_is_equation_1():
    theta, phi = 0.3, 1.1
    end = chain_poses(scara_chain(ARM), np.array([[theta, phi]])).position[0]
    u = 0.4 * np.cos(theta) + 0.3 * np.cos(theta + phi)
    v = 0.4 * np.sin(theta) + 0.3 * np.sin(theta + phi)
    np.testing.assert_allclose(end, [u, v, 0.0], atol=1e-15)


def test_planted_lengths_come_back_without_noise():
    found = calibrate_scara(ARM, simulate_scara(ARM, (0, 1e-3, 0, -2e-3), 8, 0.0, 0))
    assert found.fit.value("length.a") == pytest.approx(0.401, abs=1e-12)
    assert found.fit.value("length.b") == pytest.approx(0.298, abs=1e-12)


@pytest.mark.parametrize("offset", [0.0, 3e-3])
def test_offsets_are_fitted_where_they_predict_better(offset):
    measured = simulate_scara(ARM, (offset, 1e-3, -offset, -2e-3), 30, 5e-5, 4)
    found = calibrate_scara(ARM, measured, heldout=range(20, 30))
    assert found.has_offsets == (offset > 0.0)
    # Ten unseen poses: noise of 0.05 mm in two coordinates is 0.071 mm, known to a tenth.
    assert found.heldout_rms == pytest.approx(0.071e-3, rel=0.35)


@pytest.mark.nightly
def test_intervals_cover_planted_lengths():
    inside = 0
    for seed in range(200):
        measured = simulate_scara(ARM, (0, 1e-3, 0, -2e-3), 15, 5e-5, seed)
        fit = fit_scara(scara_chain(ARM), measured, range(15), offsets=False)
        low, high = fit.intervals[list(fit.names).index("length.a")]
        inside += low <= 0.401 <= high
    # 95 % of 200 with a standard deviation of 1.5 %, three of them.
    assert 0.905 <= inside / 200 <= 0.995


def test_one_arm_posture_tells_lengths_only_together():
    joints = np.column_stack([np.linspace(-1, 1, 6), np.zeros(6)])
    ends = chain_poses(scara_chain(ARM), joints).position[:, :2] * 1.001
    found = calibrate_scara(ARM, MeasuredPositions(joints, ends))
    assert "length.a + length.b" in [
        found.fit.identifiability.format_combination(k) for k in range(len(found.fit.identifiability.base))
    ]


def test_poses_that_tell_most_differ():
    measured = simulate_scara(ARM, (0, 0, 0, 0), 40, 0.0, 2)
    chosen = select_scara_poses(ARM, measured, 6)
    elbow = measured.joints[list(chosen.chosen), 1]
    assert np.ptp(elbow) > 1.0


def run(*words, catch=True):
    return CliRunner().invoke(app, ["calibrate", "scara", *map(str, words)], catch_exceptions=catch)


def test_tutorial_commands(tmp_path):
    folder = tmp_path / "measured"
    assert run("--simulate", folder).exit_code == 0
    found = run("--data", folder, "--choose", 6, "--json", "--out", tmp_path / "out")
    document = json.loads(found.output)
    assert document["heldout"]["rms_mm"] < 0.15 < document["heldout"]["nominal_rms_mm"]
    values = {p["name"]: (p["low"], p["high"]) for p in document["parameters"]}
    assert values["length.a"][0] < 0.4008 < values["length.a"][1]
    assert len(document["best_poses"]) == 6


@pytest.mark.parametrize(
    ("row", "said"),
    [("nan,0,0,0", "row 3, column theta"), ("0,0,0", "row 3"), ("90,45,0.3,0.3", "rad"),
     ("0,0,700,0", "in mm"), (None, "0 poses")],
)  # fmt: skip
def test_bad_measurements_are_refused(tmp_path, row, said):
    folder = tmp_path / "measured"
    run("--simulate", folder)
    lines = (folder / MEASURED_FILE).read_text().splitlines()
    lines = lines[:1] if row is None else [*lines[:2], row, *lines[3:]]
    (folder / MEASURED_FILE).write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=said):
        run("--data", folder, catch=False)
