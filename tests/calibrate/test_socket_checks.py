"""A socket calibration is tested against its metric constraint, plausible sizes and held-out data."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hydrotele.calibrate.socket_calibration import (
    SocketOptions,
    calibrate_sockets,
    check_robot_fits_sockets,
    choose_robot,
    evaluate_robot,
    move_far_frames_near,
    predict_held_out_place,
)
from hydrotele.calibrate.socket_measurement import Socket, load_sockets
from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_robot_files import load_robot

DATA = Path(__file__).parents[1] / "data/mukca"
UR, FACTORY = DATA / "ur_factory/measured", DATA / "ur_factory/factory.urdf"
PALLETIZER, FREE = DATA / "palletizer", DATA / "palletizer/free.urdf"


@pytest.mark.parametrize(("folder", "robot"), [(UR, FACTORY), (UR, "ur5"), (PALLETIZER, FREE)])
def test_radians_read_as_degrees_are_refused_with_a_hint(folder, robot):
    sockets, _ = load_sockets(folder, degrees=True)
    with pytest.raises(InputError, match=r"% of its free travel \(at most 5 %\).*read as radians.*: give --unit rad$"):
        check_robot_fits_sockets(load_robot(robot), sockets)


def test_degrees_read_as_radians_are_refused_with_a_hint():
    sockets = [replace(s, joints=np.degrees(s.joints)) for s in load_sockets(UR)[0]]
    with pytest.raises(InputError, match="read as degrees, the ball of ur5 .*: give --unit deg$"):
        check_robot_fits_sockets(load_robot("ur5"), sockets)
    with pytest.raises(InputError, match="no shipped robot fits .*: give --unit deg$"):
        choose_robot(sockets)


@pytest.mark.parametrize("fault", ["sign", "order", "constant"])
def test_other_faults_are_refused_without_a_hint_to_a_unit(fault):
    sockets = load_sockets(UR)[0]
    change = {
        "sign": lambda q: q * [1, 1, -1, 1, 1, 1],
        "order": lambda q: q[:, [0, 2, 1, 3, 4, 5]],
        "constant": lambda q: q.mean(axis=0) + 1e-5 * (q - q.mean(axis=0))[:, ::-1],
    }[fault]
    changed = [replace(s, joints=change(s.joints)) for s in sockets]
    with pytest.raises(InputError, match="another order, sign or unit") as found:
        check_robot_fits_sockets(load_robot("ur5"), changed)
    assert "--unit" not in str(found.value)


def test_a_wrong_socket_distance_is_refused_before_the_fit():
    sockets, robot = load_sockets(UR)[0], load_robot("ur5")
    check_robot_fits_sockets(robot, sockets, SocketOptions())
    message = r"hole_1.csv: with robot ur5 this socket is 50.12 mm from place0/hole_0, not 45 mm: correct --distance"
    with pytest.raises(InputError, match=message):
        check_robot_fits_sockets(robot, sockets, SocketOptions(distance=0.045))


@pytest.mark.nightly
def test_a_fit_with_implausible_lengths_is_not_accepted():
    # The distance is not known, so that only the sizes show that a UR10 is not a UR5.
    with pytest.raises(InputError, match="the fit needs an error of .* of robot ur10, beyond .*: it is not accepted"):
        calibrate_sockets(load_robot("ur10"), load_sockets(UR)[0], SocketOptions(distance=None, model="rigid"))


def test_far_frames_are_moved_along_their_axes():
    sockets, far = load_sockets(UR)[0], load_robot(FACTORY)
    near = move_far_frames_near(far, sockets)
    assert max(np.abs(joint.origin[:3, 3]).max() for joint in far.joints) > 100.0
    assert max(np.abs(joint.origin[:3, 3]).max() for joint in near.joints) < 1.0
    # The same robot: rounding at 278 m is 3e-14 m, times some ten products.
    assert evaluate_robot(near, sockets).rms == pytest.approx(evaluate_robot(far, sockets).rms, abs=1e-11)


@pytest.mark.nightly
def test_the_cross_validated_error_is_that_of_the_held_out_place():
    sockets = load_sockets(UR)[0]
    held, found = predict_held_out_place(load_robot(FACTORY), sockets, "place0", SocketOptions(model="rigid"))
    assert held.calibrated_errors.socket_distances["place0"] == pytest.approx(0.05, abs=1e-4)
    # The play is 0.01 mm per coordinate; no honest prediction is better than 0.9 of it for 40 rows.
    for error in found.model_errors.values():
        assert error == pytest.approx(held.calibrated_errors.rms / np.sqrt(3.0), rel=0.3)
        assert error > 0.9e-5


@pytest.mark.nightly
def test_long_recordings_are_read_in_linear_time(tmp_path):
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (20_000, 6))
    rows[10_000:] = rows[:10_000]  # every posture twice
    (tmp_path / "hole_0.csv").write_text("\n".join(",".join(f"{v:.4f}" for v in row) for row in rows))
    (socket,), notes = load_sockets(tmp_path)
    assert isinstance(socket, Socket)
    assert len(socket.joints) == 2000
    assert socket.lines[0] == 1
    assert socket.lines[-1] == 10_000
    assert any("2000 of 10000 rows are used, evenly spaced" in note for note in notes)
