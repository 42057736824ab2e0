"""The shipped joystick: Zhu's numbers in SI, its MJCF, what a user's own file may say."""

import shutil

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.machine.joystick import AXES, load_joystick, shipped_joysticks
from hydrotele.simulate.joystick import joystick_spec

JOYSTICK = load_joystick()
# Zhu 1994, Tables 6.7, 6.9 and 6.11 as printed: N/mm, N/(mm/s), 100 N m/rad, mm, 1e-4 rad
EXCAVATOR = {
    **dict.fromkeys(("x", "y", "z"), (4.0, 0.6, 0.3, 0.06, 1.5)),
    "rx": (0.1, 0.06, 0.01, 0.03, 2000.0),
    "ry": (0.1, 0.06, 0.01, 0.03, 50.0),
    "rz": (0.1, 0.06, 0.01, 0.03, 2000.0),
}
FELLER = {
    "x": (8.0, 4.0, 3.0, 0.06, 1.5),
    "y": (4.0, 3.0, 2.0, 0.06, 1.5),
    "z": (9.0, 4.0, 3.0, 0.06, 1.5),
    "rx": (0.8, 0.45, 0.30, 0.04, 350.0),
    "ry": (0.8, 0.45, 0.30, 0.04, 350.0),
    "rz": (0.26, 0.25, 0.24, 0.04, 2000.0),
}
DETENT = {"x": (2.0, 0.3), "y": (2.0, 0.3), "z": (2.0, 0.4), "rx": (0.8, 0.03), "ry": (0.8, 0.03)}


@pytest.mark.parametrize("name, table", [("excavator", EXCAVATOR), ("feller", FELLER)])
def test_gains_are_those_of_the_tables(name, table):
    for number, axis in enumerate(AXES):
        found, (most, nominal, least, damping, band) = JOYSTICK.gains[name][axis], table[axis]
        turns = number >= 3
        unit = 100.0 if turns else 1e3
        assert (found.max_stiffness, found.nominal_stiffness, found.min_stiffness) == pytest.approx(
            (unit * most, unit * nominal, unit * least)
        )
        assert found.deadband == pytest.approx(band * (1e-4 if turns else 1e-3))
        # rotational damping is ours: the printed one shakes this flotor at 200 Hz (see README)
        assert found.damping == pytest.approx(0.25 if turns else 1e3 * damping)
        if name == "feller" and axis in DETENT:
            drop, outside = DETENT[axis]
            assert (found.detent.drop, found.detent.slope) == pytest.approx((drop, unit * outside))


def test_the_mjcf_alone_has_the_numbers_of_the_yaml():
    """It can be opened without this package; what is written over it changes nothing."""
    folder = models_folder() / "joystick"
    alone = mujoco.MjModel.from_xml_path(str(folder / "joystick.xml"))
    made = joystick_spec(JOYSTICK).compile()
    for name in ("body_mass", "body_ipos", "jnt_range", "geom_pos", "actuator_gear", "site_pos"):
        np.testing.assert_allclose(getattr(alone, name), getattr(made, name), atol=1e-9, err_msg=name)
    turn = np.empty(9)
    for model in (alone, made):
        body = model.body("flotor")
        mujoco.mju_quat2Mat(turn, body.iquat)
        inertia = turn.reshape(3, 3) @ np.diag(body.inertia) @ turn.reshape(3, 3).T
        np.testing.assert_allclose(inertia, np.diag(JOYSTICK.flotor.inertia), atol=1e-12)
    assert alone.nu == 6 and (alone.actuator_ctrlrange == [-4.0, 4.0]).all()


def test_nothing_of_its_looks_has_mass_or_touches():
    model = joystick_spec(JOYSTICK, hand=False).compile()
    stops = [name for name in map(lambda g: model.geom(g).name, range(model.ngeom)) if name]
    assert sorted(stops) == ["gap", *(f"gap_{a}_{s}" for a in "xyz" for s in ("high", "low"))]
    for g in range(model.ngeom):
        touches = model.geom_contype[g] or model.geom_conaffinity[g]
        assert bool(touches) == bool(model.geom(g).name)
    assert model.body_mass.sum() == pytest.approx(JOYSTICK.flotor.mass)


def test_the_handle_turns_about_itself_until_the_coils_are_at_the_end_of_their_gap():
    """Zhu 1994, 5.1.2: the workspace is limited by the magnetic gap, +-5 mm and +-7 deg."""
    reach = JOYSTICK.handle_travel
    assert reach[:3] == (5e-3,) * 3 and reach[5] == pytest.approx(np.deg2rad(7.0))
    assert reach[3] == reach[4] == pytest.approx(2.0 * np.arcsin(2.5e-3 / 0.12))  # 2.39 deg
    # The published dead band of the feller-buncher's rotations, 0.035 rad, has to be left: a
    # handle higher than 143 mm above the coils could not.
    assert max(JOYSTICK.gains["feller"][axis].deadband for axis in ("rx", "ry")) < reach[4]
    assert 5e-3 / 0.035 == pytest.approx(0.143, abs=1e-3)


def test_a_joystick_without_the_stops_at_its_coils_is_refused(tmp_path):
    for name in ("joystick.yaml", "joystick.xml"):
        shutil.copy(models_folder() / "joystick" / name, tmp_path / name)
    text = (tmp_path / "joystick.xml").read_text()
    lines = [line for line in text.splitlines() if 'name="gap_x_low"' not in line]
    (tmp_path / "joystick.xml").write_text("\n".join(lines))
    with pytest.raises(InputError, match="has no geoms gap_x_low, which are the end stops"):
        joystick_spec(load_joystick(tmp_path))


def test_a_users_joystick_is_a_file_or_a_folder(tmp_path):
    for name in ("joystick.yaml", "joystick.xml"):
        shutil.copy(models_folder() / "joystick" / name, tmp_path / name)
    assert load_joystick(tmp_path) == load_joystick(tmp_path / "joystick.yaml")
    assert load_joystick(tmp_path).flotor == JOYSTICK.flotor
    own = tmp_path / "joystick.yaml"
    own.write_text(own.read_text().replace("mass: 0.85", "mass: -1"))
    with pytest.raises(InputError, match="joystick.yaml.*mass"):
        load_joystick(own)
    with pytest.raises(InputError, match="valid: joystick"):
        load_joystick("gamepad")
    assert shipped_joysticks() == ["joystick"]


@pytest.mark.parametrize("rate", ["1.0e-320", "1.0e9"])
def test_a_control_rate_that_leaves_no_period_is_refused(tmp_path, rate):
    """Found by tools/validation/fuzz.py: its period was infinite."""
    shutil.copytree(models_folder() / "joystick", tmp_path / "own")
    file = tmp_path / "own" / "joystick.yaml"
    text = file.read_text()
    line = next(line for line in text.splitlines() if line.startswith("control_rate"))
    file.write_text(text.replace(line, f"control_rate: {rate}"))
    with pytest.raises(InputError, match="control_rate"):
        load_joystick(tmp_path / "own")
