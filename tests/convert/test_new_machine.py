"""Machines from URDF, xacro and MJCF: geometry, estimates, closed chains, and files that are not usable."""

import json
import math

import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.cli.main import app
from hydrotele.convert import shapes
from hydrotele.convert.new_machine import create_machine
from hydrotele.core.errors import InputError
from hydrotele.kinematics.drive_linkage import axis_linkage, check_strokes
from hydrotele.machine.estimate_marks import find_estimates
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.mechanism import assemble_mjcf, compile_mechanism, mjcf_document
from hydrotele.simulate.plant import build_plant, rest_state

LIMIT = '<limit lower="{}" upper="{}" effort="1" velocity="1"/>'


def joint(name, parent, child, origin, kind="revolute", axis="0 1 0", more="", rpy="0 0 0"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}" rpy="{rpy}"/><axis xyz="{axis}"/>{more}</joint>'
    )


def link(name, size="", centre="0 0 0", more=""):
    shape = f'<visual><origin xyz="{centre}"/><geometry><box size="{size}"/></geometry></visual>' if size else ""
    return f'<link name="{name}">{shape}{more}</link>'


PLACEHOLDER = '<inertial><mass value="0.03"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
GOOD_STICK = (
    '<inertial><origin xyz="1 0 0"/><mass value="450"/>'
    '<inertia ixx="8" iyy="170" izz="170" ixy="0" ixz="0" iyz="0"/></inertial>'
)
# Links are drawn along x. Robot angles are positive downwards, as usual with ROS, and boom and stick are at 30 and
# 60 deg if the robot angles are 0.
DIGGER = "".join([
    link("base_link", "3 2.4 1", "0 0 0.3"),
    joint("swing_joint", "base_link", "body_link", "0 0 0.8", "continuous", "0 0 1"),
    link("body_link", "3 2.5 1.4", "-0.5 0 0.7", PLACEHOLDER),
    joint("boom_joint", "body_link", "boom_link", "0.3 0 0.6", rpy=f"0 {-math.radians(30)} 0",
          more=LIMIT.format(-0.5, 1.0)),
    link("boom_link", "4.6 0.4 0.5", "2.3 0 0", PLACEHOLDER),
    joint("arm_joint", "boom_link", "arm_link", "4.6 0 0", rpy=f"0 {math.radians(60)} 0", more=LIMIT.format(-0.6, 1.4)),
    link("arm_link", "2.5 0.3 0.4", "1 0 0", GOOD_STICK),
    joint("bucket_joint", "arm_link", "bucket_link", "2.2 0 0", more=LIMIT.format(-0.5, 2.3)),
    link("bucket_link", "1 0.8 0.6", "0.5 0 0", PLACEHOLDER),
    joint("tip_joint", "bucket_link", "tip_link", "1.1 0 0"), link("tip_link"),
])  # fmt: skip


def make(folder, body, name="digger", file="robot.urdf", head='<robot name="r">'):
    (folder / file).write_text(f"{head}{body}</robot>")
    return create_machine(str(folder / name), folder / file)


@pytest.fixture(scope="module")
def digger(tmp_path_factory):
    return make(tmp_path_factory.mktemp("digger"), DIGGER)


def test_tip_is_where_the_robot_has_it(digger):
    """Forward kinematics of the URDF, by hand, at a pose that is given in robot angles."""
    machine = load_machine(digger.folder)
    boom, arm, bucket = -0.2, 0.4, 0.7  # robot angles, positive downwards
    offset = {made.source_joint: made for made in digger.design.tree.links.values()}
    home = {}
    for name, value in (("boom_joint", boom), ("arm_joint", arm), ("bucket_joint", bucket)):
        made = offset[name]
        home[made.joint] = made.sign * (value - made.offset)
    down = np.cumsum([boom - math.radians(30), arm + math.radians(60), bucket])
    lengths = np.array([4.6, 2.2, 1.1])
    x, z = 0.3 + lengths @ np.cos(down), 0.8 + 0.6 + 0.2 - lengths @ np.sin(down)  # base raised by 0.2 m to z = 0

    model = compile_mechanism(machine)
    data = mujoco.MjData(model)
    for name, value in home.items():
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    assert data.site("hydrotele_tip").xpos == pytest.approx([x, 0.0, z], abs=2e-4)  # 0.1 mm rounding of each position


def test_limits_signs_and_roles(digger):
    machine = load_machine(digger.folder)
    assert machine.joints["boom"].axis == pytest.approx((0, -1, 0))
    assert np.degrees(machine.joints["boom"].range) == pytest.approx(np.degrees([-1.0, 0.5]) + 30, abs=1e-3)
    assert np.degrees(machine.joints["arm"].range) == pytest.approx(np.degrees([-1.4, 0.6]) - 60, abs=1e-3)
    assert machine.joints["swing"].range is None
    assert machine.arm and (machine.arm.boom, machine.arm.stick, machine.arm.tool) == ("boom", "arm", "bucket")
    assert list(machine.axes) == ["swing", "boom", "arm", "bucket"]
    assert machine.axes["swing"].motor and machine.axes["bucket"].four_bar


def test_placeholder_masses_are_replaced_and_plausible_ones_kept(digger):
    machine = load_machine(digger.folder)
    assert machine.links["arm"].mass == 450
    assert machine.links["arm"].inertia == pytest.approx((8, 170, 170))
    assert 700 < machine.links["boom"].mass < 2000  # 4.6 m: a machine of 13 t
    assert sum("replaced by an estimate" in note for note in digger.design.notes) == 3
    text = (digger.folder / "machine.yaml").read_text()
    assert "# estimate: 0.03 kg in a hull of" in text and "mass: 450\n" in text


def test_cylinders_are_closed_chains_that_reach_both_ends(digger):
    machine = load_machine(digger.folder)
    check_strokes(machine)
    plant = build_plant(machine)
    rest_state(plant)
    assert plant.document.compile().neq == 4  # three rod pins and the pin of the coupler
    for name in ("boom", "arm", "bucket"):
        low, high = machine.joints[name].range
        lengths = [axis_linkage(machine, name).length(q) for q in np.linspace(low, high, 30)]
        assert abs(np.sign(np.diff(lengths)).sum()) == 29


def test_arm_is_held_with_part_of_the_relief_pressure(digger):
    """The gravity torque of the stretched boom, divided by lever and area."""
    machine = load_machine(digger.folder)
    arm = [machine.links[n] for n in ("boom", "arm", "bucket")]
    torque = 9.81 * sum(
        li.mass * (li.com[0] + sum(other.position[0] for other in arm[1 : k + 1])) for k, li in enumerate(arm)
    )
    cylinder = machine.axes["boom"].cylinder
    low, high = machine.joints["boom"].range
    pressure = torque * (high - low) / (cylinder.stroke * cylinder.area_head)
    assert pressure < 0.65 * machine.supply.relief_pressure  # 0.6 and the rounding of the bore to 5 mm


def test_scenario_of_the_folder_runs(digger, tmp_path):
    from hydrotele.run.run import run_scenario
    from hydrotele.scenario.scenario import load_scenario

    run = run_scenario(load_scenario(digger.folder / "moves.yaml", {"duration": "2"}))
    assert len(run.measured["angle.boom"]) == 100


def test_next_steps_are_listed_in_order(digger):
    groups = find_estimates(digger.folder / "machine.yaml")
    assert [group.title.split()[0] for group in groups[:4]] == ["pins", "bores,", "pump", "masses"]
    printed = CliRunner().invoke(app, ["validate", str(digger.folder), "--json"])
    listed = json.loads(printed.stdout)[0]["estimates"]
    assert "axes.boom.cylinder.bore_mm" in listed and "links.arm.mass" not in listed
    path = digger.folder / "machine.yaml"
    before = path.read_text()
    try:
        path.write_text(before.replace("# estimate", "# data sheet"))
        assert find_estimates(path) == []
    finally:
        path.write_text(before)


ACTUATED = ("slew", "lift", "jib", "extension", "rotator")
CRANE = "".join([
    link("base", "0.8 0.8 0.8", "0 0 0.4"),
    joint("slew", "base", "column", "0 0 0.8", axis="0 0 1", more=LIMIT.format(-3, 3)),
    link("column", "0.3 0.3 1.6", "0 0 0.8"),
    joint("lift", "column", "boom", "0 0 1.6", axis="0 -1 0", more=LIMIT.format(-0.1, 1.0)),
    link("boom", "3 0.2 0.25", "1.5 0 0"),
    joint("lift_cylinder", "column", "lift_tube", "0.3 0 1.0", axis="0 -1 0", rpy="0 -0.588 0", kind="continuous"),
    link("lift_tube", "0.7 0.12 0.12", "0.35 0 0"),
    joint("lift_piston", "lift_tube", "lift_rod", "0.7 0 0", "prismatic", "1 0 0", LIMIT.format(-0.3, 0.4)),
    link("lift_rod", "0.78 0.06 0.06", "0 0 0"),
    joint("jib", "boom", "jib", "3 0 0", axis="0 -1 0", more=LIMIT.format(-2.4, -0.2)),
    link("jib", "2.2 0.15 0.2", "1.1 0 0"),
    joint("extension", "jib", "extension", "2.2 0 0", "prismatic", "1 0 0", LIMIT.format(0, 1.5)),
    link("extension", "1.6 0.1 0.1", "-0.8 0 0"),
    joint("pendulum", "extension", "pendulum", "0 0 0", "continuous"), link("pendulum", "0.1 0.1 0.3", "0 0 -0.15"),
    joint("rotator", "pendulum", "grapple", "0 0 -0.3", "continuous", "0 0 1"),
    link("grapple", "0.8 0.3 0.6", "0 0 -0.3"),
    *(f'<transmission name="{n}"><joint name="{n}"/></transmission>' for n in ACTUATED),
])  # fmt: skip


def test_crane_with_a_stated_cylinder_telescope_and_pendulum(tmp_path):
    made = make(tmp_path, CRANE, "crane")
    machine = load_machine(made.folder)
    check_strokes(machine)
    rest_state(build_plant(machine))
    cylinder = machine.axes["lift"].cylinder
    # The rod's eye is 1.09 m from the base pin at robot angle 0, less half its thickness and diagonal.
    assert made.design.drives["lift"].cylinder.source == "stated"
    assert cylinder.base_pin.position == pytest.approx((0.3, 0.0, 1.0))
    way = np.array([math.cos(0.588), 0, math.sin(0.588)])
    eye = np.array([0.3, 0.0, -0.6]) + 1.07 * way
    assert cylinder.rod_pin.position == pytest.approx(eye, abs=0.03)
    assert "pendulum" not in machine.axes and machine.joints["pendulum"].range is None
    assert machine.axes["extension"].cylinder and machine.axes["rotator"].motor and machine.arm is None
    # a free pendulum hangs plumb at home
    links = [made.design.home[n] for n in ("lift", "jib")]
    assert made.design.home["pendulum"] == pytest.approx(sum(links), abs=1e-3)  # its axis is +y


def test_cylinders_of_an_mjcf_are_read_from_its_closures(tmp_path):
    shipped = load_machine("cat215")
    document = mjcf_document(assemble_mjcf(shipped))
    document.save(tmp_path / "scene.xml")
    machine = load_machine(create_machine(str(tmp_path / "cat"), tmp_path / "scene.xml").folder)
    for axis in ("boom", "stick"):
        old, new = shipped.axes[axis].cylinder, machine.axes[axis].cylinder
        assert new.base_pin.position == pytest.approx(old.base_pin.position, abs=1e-4)
        assert new.rod_pin.position == pytest.approx(old.rod_pin.position, abs=1e-4)
    for name in ("boom", "stick"):
        assert machine.links[name].mass == shipped.links[name].mass
        assert machine.joints[name].range == pytest.approx(shipped.joints[name].range, abs=1e-6)


TETRAHEDRON = (
    np.array([[0, 0, 0], [1000.0, 0, 0], [0, 1000, 0], [0, 0, 1000]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)


def test_xacro_with_meshes_of_a_package_in_millimetres(tmp_path):
    pytest.importorskip("trimesh")
    pytest.importorskip("xacro")
    package = tmp_path / "ws" / "src" / "digger_description"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    (package / "package.xml").write_text("<package><name>digger_description</name></package>")
    shapes.write_stl(package / "meshes" / "boom.stl", *TETRAHEDRON)
    (package / "urdf" / "scale.xacro").write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:property name="mm" value="0.001"/></robot>'
    )
    mesh = '<mesh filename="package://digger_description/meshes/boom.stl" scale="${mm} ${mm} ${mm}"/>'
    body = DIGGER.replace('<box size="4.6 0.4 0.5"/>', mesh)
    head = (
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        '<xacro:include filename="$(find digger_description)/urdf/scale.xacro"/>'
    )
    made = make(package / "urdf", body, str(tmp_path / "digger"), "robot.xacro", head)
    shape = made.design.tree.links["boom"].visuals[0]
    assert np.ptp(shape.points(), axis=0).max() == pytest.approx(1.0, rel=0.5)
    assert (made.folder / "meshes" / "boom_0.stl").is_file()
    load_machine(made.folder)


def test_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    shapes.write_stl(tmp_path / "boom.stl", *TETRAHEDRON)
    body = DIGGER.replace('<box size="4.6 0.4 0.5"/>', '<mesh filename="boom.stl"/>')
    with pytest.raises(InputError, match=r"pip install 'hydrotele\[urdf\]'"):
        make(tmp_path, body)


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (lambda b: b.replace('<box size="4.6 0.4 0.5"/>', '<mesh filename="package://a/b.dae"/>'),
         "meshes not found or empty"),
        (lambda b: b + link("other"), "several root links"),
        (lambda b: b + link("wheel", "1 1 1") + joint("wheel", "base_link", "wheel", "1 1 0", "continuous"),
         "not part of the arm and locked at 0: wheel"),
        (lambda b: b + link("jaw", "1 1 1") + joint("jaw", "bucket_link", "jaw", "1 0 0", more=LIMIT.format(0, 1)
                                                    + '<mimic joint="bucket_joint"/>'), "jaw follows bucket_joint"),
        (lambda b: link("map") + joint("float", "map", "base_link", "0 0 0", "floating") + b, "float is floating"),
        (lambda b: b.replace("boom_link", "Boom-Link (1)"), "class: longest arm link 4.6"),
        (lambda b: b.replace(PLACEHOLDER, ""), "boom replaced by an estimate"),
    ],
)  # fmt: skip
def test_unusual_descriptions_make_a_machine_with_a_note(tmp_path, change, note):
    made = make(tmp_path, change(DIGGER))
    assert any(note in said for said in made.design.notes), made.design.notes
    rest_state(build_plant(load_machine(made.folder)))


def test_machine_without_shapes_has_visible_links_and_stands_above_ground(tmp_path):
    import re

    made = make(tmp_path, re.sub(r"<visual>.*?</visual>", "", DIGGER))
    machine = load_machine(made.folder)
    model = compile_mechanism(machine)
    for name in ("body", "boom", "arm", "bucket", "boom_tube", "boom_rod"):
        body = model.body(name).id
        assert any(model.geom_bodyid[g] == body and model.geom_group[g] == 2 for g in range(model.ngeom)), name
    assert machine.links["body"].position[2] > 0.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "is not an XML file"),
        ("<sdf/>", "root element <sdf>"),
        ("<robot/>", "has no link"),
        (f"<robot>{link('a')}{link('a')}</robot>", "given twice"),
        (f"<robot>{link('a', '1 1 1')}</robot>", "has no joint that moves"),
        (f"<robot>{link('a')}{joint('j', 'a', 'b', '0 0 0')}</robot>", "unknown link 'b'"),
        (f"<robot>{link('a')}{link('b')}{joint('j', 'a', 'b', '0 x 0')}</robot>", "must be 3 numbers"),
        (f"<robot>{link('a')}{link('b')}{joint('j', 'a', 'b', '0 0 0', 'ball')}</robot>", "unknown type 'ball'"),
        (f"<robot>{link('a')}{link('b')}{joint('j', 'a', 'b', '0 0 0')}{joint('k', 'b', 'a', '0 0 0')}</robot>",
         "form a cycle"),
        ("<robot>" + link("a", "1 1 1") + "".join(
            joint(f"j{k}", "ab"[k], "bc"[k], "0 0 1", "revolute", more=LIMIT.format(-3, 3)) + link("bc"[k], "1 1 1")
            for k in range(2)) + "</robot>", "without hydraulics use `hydrotele identify --mjcf`"),
    ],
)  # fmt: skip
def test_files_that_are_no_hydraulic_machine_are_refused(tmp_path, text, message):
    (tmp_path / "robot.urdf").write_text(text)
    with pytest.raises(InputError, match=message.replace("(", r"\(")):
        create_machine(str(tmp_path / "new"), tmp_path / "robot.urdf")
    assert not (tmp_path / "new").exists()


def test_mesh_in_millimetres_without_scale_is_refused(tmp_path):
    pytest.importorskip("trimesh")
    shapes.write_stl(tmp_path / "boom.stl", *TETRAHEDRON)
    body = DIGGER.replace('<box size="4.6 0.4 0.5"/>', '<mesh filename="boom.stl"/>')
    with pytest.raises(InputError, match="scale="):
        make(tmp_path, body)


def test_large_meshes_are_simplified(monkeypatch):
    monkeypatch.setattr(shapes, "MAX_FACES", 500)
    angles = np.linspace(0, 2 * np.pi, 60)
    grid = np.array([[np.cos(a), np.sin(a), z] for z in np.linspace(0, 3, 60) for a in angles])
    faces = [[60 * r + c, 60 * r + c + 1, 60 * r + c + 60] for r in range(59) for c in range(59)]
    vertices, kept = shapes.simplify_mesh(grid, np.array(faces))
    assert 50 < len(kept) <= 500
    assert np.ptp(vertices, axis=0) == pytest.approx([2, 2, 3], abs=0.3)  # a grid cell of 3 m / 12


def test_solid_of_a_box():
    """Volume a b c, centre, and inertia (b^2 + c^2) a b c / 12."""
    solid = shapes.convex_solid(shapes.Shape("box", (1.0, 0.5, 0.25), position=np.array([1.0, 2.0, 3.0])).points())
    assert solid.volume == pytest.approx(1.0)
    assert solid.centre == pytest.approx([1, 2, 3])
    assert np.diag(solid.inertia) == pytest.approx([(1 + 0.25) / 12, (4 + 0.25) / 12, (4 + 1) / 12])


def test_command_prints_the_next_commands(tmp_path):
    (tmp_path / "robot.urdf").write_text(f'<robot name="r">{DIGGER}</robot>')
    arguments = ["new", "machine", str(tmp_path / "d"), "--from", str(tmp_path / "robot.urdf"), "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    made = json.loads(result.stdout)
    assert made["axes"] == {"swing": "motor", "boom": "cylinder", "arm": "cylinder", "bucket": "cylinder"}
    assert made["next"][0].startswith("hydrotele validate")
    with pytest.raises(InputError, match="exists already"):
        create_machine(str(tmp_path / "d"), tmp_path / "robot.urdf")
    with pytest.raises(InputError, match="lower-case letters"):
        create_machine(str(tmp_path / "Bad Name"), tmp_path / "robot.urdf")
