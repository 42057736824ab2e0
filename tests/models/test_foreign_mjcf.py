"""A user's own MJCF: angles in degrees, and parts that the machine file has to describe."""

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.plant import build_plant

MACHINE = """\
name: gate
mjcf: gate.xml
links:
  wing: {mass: 20, inertia: [1, 2, 2], joint: {range_deg: [-30, 60]}}
axes:
  wing: {joint: wing, force: {gain: 100}}
home: {wing: 0.5}
"""
MJCF = """\
<mujoco>%s<worldbody><body name="wing"><joint name="wing" axis="0 -1 0"/>
<geom name="leaf" type="capsule" size="0.1 0.5" euler="0 90 0"/>%s</body></worldbody>%s</mujoco>
"""


@pytest.fixture
def gate(tmp_path):
    def write(compiler="", inside="", after=""):
        (tmp_path / "machine.yaml").write_text(MACHINE)
        (tmp_path / "gate.xml").write_text(MJCF % (compiler, inside, after))
        return load_machine(tmp_path)

    return write


@pytest.mark.parametrize(
    ("compiler", "turn"),
    [("", 90.0), ('<compiler angle="degree"/>', 90.0), ('<compiler angle="radian"/>', 5156.6)],
)
def test_angles_mean_what_the_file_says(gate, compiler, turn):
    """MuJoCo's default is degrees; our own ranges are written in the file's unit."""
    for model in (
        build_plant(gate(compiler)).model,
        mujoco.MjModel.from_xml_string(build_plant(gate(compiler)).mjcf),
    ):
        half = np.radians(turn) / 2
        expected = np.array([np.cos(half), 0, np.sin(half), 0])
        quat = model.geom("leaf").quat
        # MuJoCo writes capsules as they are; signs of a quaternion are free. 5156.6 deg = 90 rad
        # to its last digit.
        assert abs(abs(quat @ expected) - 1.0) < 1e-6
        np.testing.assert_allclose(model.joint("wing").range, np.radians([-30, 60]), rtol=1e-12)


@pytest.mark.parametrize(
    ("part", "named"),
    [
        ({"after": '<actuator><motor name="own" joint="wing"/></actuator>'}, r"actuators \(own\)"),
        ({"after": '<keyframe><key name="home" qpos="0.1"/></keyframe>'}, r"keyframes \(home\)"),
        (
            {"inside": '<body name="b"><joint name="free_swing"/><geom size="1"/></body>'},
            r"not in machine.yaml \(free_swing\)",
        ),
        (
            {"after": '<equality><connect body1="wing" name="c" anchor="0 0 0"/></equality>'},
            r"equality constraints \(c\)",
        ),
    ],
)
def test_parts_that_no_log_would_show_are_refused(gate, part, named):
    with pytest.raises(InputError, match=f"gate.xml: has .*{named}.*describe them in machine.yaml"):
        build_plant(gate(**part))
