"""Start of the motion of a closed chain: open or singular reference poses, and what a message names."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import load_chain
from hydrotele.multibody.closed_chain_kinematics import solve_joint_positions
from hydrotele.multibody.closures import find_undetermined_joints

FOUR_BAR = """<mujoco model="fourbar"><compiler angle="radian"/><worldbody>
  <body name="crank"><joint name="crank" axis="0 1 0"/><geom size="0.01"/>
    <body name="coupler" pos="0.2 0 0"><joint name="knee" axis="0 1 0"{knee}/><geom size="0.01"/>
      <site name="c_end" pos="0.55 0 0"/></body></body>
  <body name="rocker" pos="0.6 0 0"><joint name="rocker" axis="0 1 0"/><geom size="0.01"/>
    <site name="r_end" pos="0.4 0 0"/></body></worldbody>
<equality>{closure}</equality><actuator><motor joint="crank"/></actuator>{key}</mujoco>"""
SITES = '<connect name="pin" site1="c_end" site2="r_end"/>'
POINTS = '<connect name="pin" body1="coupler" body2="rocker" anchor="0.55 0 0"/>'
KEY = '<keyframe><key qpos="1.74821 -2.69308 -2.47031"/></keyframe>'
FIRST = np.array([[1.9834298], [1.99]])


def load(tmp_path, closure, key=""):
    path = tmp_path / "bar.xml"
    path.write_text(FOUR_BAR.format(closure=closure, key=key, knee=""))
    return load_chain(path)


def test_a_keyframe_selects_the_assembly_of_an_open_reference_pose(tmp_path):
    q = solve_joint_positions(load(tmp_path, SITES, KEY), ("crank",), FIRST)
    # Triangle of 0.2, 0.55 and 0.4 m on a base of 0.6 m, solved by hand in the plane.
    np.testing.assert_allclose(q[0], [1.9834298, -2.84836266, -2.51249902], atol=1e-7)


def test_an_open_reference_pose_names_file_closure_opening_and_the_assemblies(tmp_path):
    with pytest.raises(InputError) as found:
        solve_joint_positions(load(tmp_path, SITES), ("crank",), FIRST)
    assert str(found.value) == (
        f"{tmp_path / 'bar.xml'}: at the start pose of fourbar pin is 250 mm open, and its loops can be closed in"
        " 2 ways at the first row: crank 1.983, knee -1.645, rocker 1.986; or crank 1.983, knee -2.848, rocker -2.512."
        ' Add the correct one as <keyframe><key qpos="..."/></keyframe>'
    )


def test_a_row_out_of_reach_names_closure_and_opening_although_the_reference_is_singular(tmp_path):
    chain = load(tmp_path, POINTS)
    assert find_undetermined_joints(chain, chain.start, np.array([0])) == ("knee", "rocker")
    # The anchor fixes the rocker at 0.15 m: the ends stay sqrt(0.680^2 + 0.183^2) - 0.70 m apart.
    with pytest.raises(InputError, match=r"bar.xml: row 0: .* at crank 1.983 rad: pin stays 4.45 mm open.*keyframe"):
        solve_joint_positions(chain, ("crank",), FIRST)
    # Within reach, the singular reference pose does not decide between the two assemblies.
    with pytest.raises(InputError, match="the pose is singular, and its loops can be closed in 2 ways"):
        solve_joint_positions(chain, ("crank",), np.array([[0.3]]))


def test_a_singular_start_is_left_if_one_assembly_remains(tmp_path):
    path = tmp_path / "slider.xml"
    path.write_text("""<mujoco model="slider"><compiler angle="radian"/><worldbody>
      <body name="arm"><joint name="arm" axis="0 1 0"/><geom size="0.01"/><site name="a" pos="1 0 0"/></body>
      <body name="x"><joint name="x" type="slide" axis="1 0 0"/><geom size="0.01"/>
        <body name="z"><joint name="z" type="slide" axis="0 0 1"/><geom size="0.01"/><site name="b"/></body></body>
      </worldbody><equality><connect site1="a" site2="b"/></equality><actuator><motor joint="arm"/></actuator>
      <keyframe><key qpos="0 3 2"/></keyframe></mujoco>""")
    q = solve_joint_positions(load_chain(path), ("arm",), np.array([[0.5]]))
    np.testing.assert_allclose(q[0], [0.5, np.cos(0.5), -np.sin(0.5)], atol=1e-9)
