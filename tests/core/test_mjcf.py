"""MJCF of users: every named file is resolved, checked and limited before MuJoCo reads it."""

import os
import shutil
import struct

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.core.mjcf import copy_mjcf, load_model
from hydrotele.gap.patched import Patch, patched_mjcf
from hydrotele.kinematics.serial_robot_files import load_robot
from hydrotele.machine.joystick import load_joystick
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.chain import load_chain
from hydrotele.simulate.joystick import SimulatedFlotor
from hydrotele.simulate.plant import build_plant

BODY = '<worldbody><body name="b"><joint name="j"/><geom size="0.1"/></body></worldbody>'
MODEL = '<asset><model name="s" file="n.xml"/></asset>'
ATTACH = '<worldbody><attach model="s" body="b" prefix="p_"/></worldbody>'


def _stl(size: float) -> bytes:
    corners = size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4")
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    parts = [struct.pack("<3f", 0, 0, 0) + corners[list(f)].tobytes() + b"\0\0" for f in faces]
    return b"\0" * 80 + struct.pack("<I", len(faces)) + b"".join(parts)


def elements(amount: str, asked: str) -> str:
    return (
        f"has {amount} elements of an MJCF with all copies by replicate, flexcomp, composite, attach and nkey,"
        f" at most 10000; HYDROTELE_MAX_MJCF_ELEMENTS={asked} allows them"
    )


def values(amount: str) -> str:
    return (
        f"has {amount} pixels, height field points and user values of an MJCF, at most 1e8;"
        f" HYDROTELE_MAX_MJCF_VALUES={amount} allows them"
    )


PIPE = "is not a regular file but a pipe or device"
REFUSED = {
    "model of itself": (
        '<asset><model name="s" file="m.xml"/></asset>', {},
        "m.xml:1: <model file='m.xml'>: m.xml is a model inside itself",
    ),
    "models of each other": (
        MODEL, {"n.xml": '<asset><model name="s" file="m.xml"/></asset>'},
        "m.xml:1: <model file='n.xml'>: n.xml:1: <model file='m.xml'>: m.xml is a model inside itself",
    ),
    "include of itself": (
        '<include file="n.xml"/>', {"n.xml": '<include file="m.xml"/>'},
        "n.xml:1: <include file='m.xml'>: m.xml is already included; a document can be included once,"
        " and not in itself",
    ),
    "pipe as include": ('<include file="pipe"/>', {}, f"m.xml:1: <include file='pipe'>: pipe: {PIPE}"),
    "pipe as model": ('<asset><model file="pipe"/></asset>', {}, f"m.xml:1: <model file='pipe'>: pipe: {PIPE}"),
    "device in an include": (
        '<include file="n.xml"/>', {"n.xml": '<asset><mesh name="z" file="/dev/zero"/></asset>'},
        f"n.xml:1: <mesh file='/dev/zero'>: /dev/zero: {PIPE}",
    ),
    "pipe in a model": (
        MODEL, {"n.xml": '<worldbody><body name="b"><flexcomp name="f" type="mesh" file="pipe"/></body></worldbody>'},
        f"m.xml:1: <model file='n.xml'>: n.xml:1: <flexcomp file='pipe'>: pipe: {PIPE}",
    ),
    "pipe as skin": ('<deformable><skin file="pipe"/></deformable>', {}, f"m.xml:1: <skin file='pipe'>: pipe: {PIPE}"),
    "replicate": (
        '<worldbody><replicate count="10000"><replicate count="10000"><site/></replicate></replicate></worldbody>', {},
        f"m.xml:1: <site>: {elements('1e8', '1e8')}",
    ),
    "attached copies": (
        MODEL + '<worldbody><replicate count="5000"><attach model="s" body="b"/></replicate></worldbody>',
        {"n.xml": BODY}, f"m.xml:1: <attach>: {elements('30010', '30010')}",
    ),
    "flexcomp": (
        '<worldbody><body name="f"><flexcomp name="f" type="grid" count="500 500 500"/></body></worldbody>', {},
        f"m.xml:1: <flexcomp>: {elements('1.25e8', '1.25e8')}",
    ),
    "nkey": ('<size nkey="2000000000"/>', {}, f"m.xml:1: <size>: {elements('2e9', '2e9')}"),
    "nuser": ('<size nuser_body="2000000000"/>', {}, f"m.xml:1: <size>: {values('4e9')}"),
    "hfield": ('<asset><hfield name="h" nrow="60000" ncol="60000" size="1 1 1 1"/></asset>', {},
               f"m.xml:1: <hfield>: {values('3.6e9')}"),
    "builtin mesh": ('<asset><mesh name="h" builtin="plate" params="3e4 3e4"/></asset>', {},
                     f"m.xml:1: <mesh>: {values('9e+10')}"),
    "image": ('<asset><texture file="big.png"/></asset>', {}, f"m.xml:1: <mujoco>: {values('3.6e9')}"),
    "user sensor": ('<sensor><user name="u" dim="x"/></sensor>', {}, "m.xml:1: <user dim='x'>: must be a number"),
    "unknown attribute": (
        '<include file="n.xml"/>', {"n.xml": '\n<worldbody>\n<geom foo="1"/></worldbody>'},
        "n.xml:3: MuJoCo cannot read it: Schema violation: unrecognized attribute: 'foo' (element <geom>)",
    ),
    "unknown material": (
        MODEL + ATTACH, {"n.xml": '\n\n<worldbody><body name="b">\n<geom size="1" material="x"/></body></worldbody>'},
        "m.xml:1: MuJoCo cannot read it: material 'p_x' not found in geom 0",
    ),
    "document type": (None, {}, "m.xml: declares a document type, which MuJoCo does not read; remove <!DOCTYPE ...>"),
}  # fmt: skip


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    (tmp_path / "big.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", 60000, 60000))
    return tmp_path


@pytest.mark.parametrize("kind", REFUSED)
def test_a_document_is_refused_before_mujoco_opens_or_allocates(folder, kind):
    text, others, message = REFUSED[kind]
    content = '<!DOCTYPE mujoco [<!ENTITY a "b">]><mujoco/>' if text is None else f"<mujoco>{text}</mujoco>"
    (folder / "m.xml").write_text(content)
    for name, inner in others.items():
        (folder / name).write_text(f"<mujoco>{inner}</mujoco>")
    with pytest.raises(InputError) as refused:
        load_model("m.xml")
    assert str(refused.value).replace(f"{folder}/", "") == message


def write_nested(folder):
    """Write an MJCF with an include in a subfolder, a nested model and two meshes of one name."""
    (folder / "sub/meshes").mkdir(parents=True)
    (folder / "meshes").mkdir()
    (folder / "main.xml").write_text("""<mujoco><compiler meshdir="meshes"/><include file="sub/assets.xml"/>
        <worldbody><attach model="s" body="b" prefix="p_"/><geom type="mesh" mesh="leaf"/></worldbody></mujoco>""")
    (folder / "sub/assets.xml").write_text("""<mujoco><asset><mesh file="leaf.stl"/>
        <model name="s" file="n.xml"/></asset><include file="bodies.xml"/></mujoco>""")
    (folder / "sub/bodies.xml").write_text('<x><worldbody><body pos="1 2 3"><geom size="1"/></body></worldbody></x>')
    (folder / "sub/n.xml").write_text("""<mujoco><compiler meshdir="meshes"/><asset><mesh file="leaf.stl"/></asset>
        <worldbody><body name="b"><geom type="mesh" mesh="leaf"/></body></worldbody></mujoco>""")
    (folder / "meshes/leaf.stl").write_bytes(_stl(1.0))
    (folder / "sub/meshes/leaf.stl").write_bytes(_stl(2.0))
    return folder / "main.xml"


def test_the_resolved_document_is_the_model_that_mujoco_reads_from_the_files(tmp_path):
    path = write_nested(tmp_path / "own")
    expected, found = mujoco.MjModel.from_xml_path(str(path)), load_model(path)
    assert (found.nbody, found.nmesh) == (3, 2)
    for name in ("body_pos", "geom_size", "mesh_vert", "names"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    copy_mjcf(path, tmp_path / "copy.xml", "parts")
    shutil.rmtree(tmp_path / "own")
    copied = mujoco.MjModel.from_xml_path(str(tmp_path / "copy.xml"))
    np.testing.assert_array_equal(copied.mesh_vert, expected.mesh_vert)
    assert str(tmp_path) not in (tmp_path / "copy.xml").read_text()


def test_a_urdf_is_read_with_its_meshes(tmp_path):
    inertia = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    shape = '<geometry><mesh filename="package://own/leaf.stl"/></geometry>'
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
    text = (
        f'<robot name="r"><link name="a"/><link name="b">{inertia}<collision>{shape}</collision></link>{joint}</robot>'
    )
    (tmp_path / "r.urdf").write_text(text)
    (tmp_path / "leaf.stl").write_bytes(_stl(1.0))
    assert (load_model(tmp_path / "r.urdf").nmesh, load_chain(tmp_path / "r.urdf").joints) == (1, ("j",))


def _read_machine(path):
    folder = path.with_name("rig")
    shutil.copytree(models_folder() / "rig", folder)
    text = (folder / "rig.xml").read_text()
    (folder / "rig.xml").write_text(text.replace("<worldbody>", f'<include file="{path}"/><worldbody>', 1))
    build_plant(load_machine(folder))


def _read_attached(path):
    folder = path.with_name("rig")
    shutil.copytree(models_folder() / "rig", folder)
    machine = load_machine(folder)
    build_plant(machine.model_copy(update={"attached": {"carriage": str(path)}}))


def _read_joystick(path):
    folder = path.with_name("joystick")
    shutil.copytree(models_folder() / "joystick", folder)
    text = (folder / "joystick.xml").read_text()
    (folder / "joystick.xml").write_text(text.replace("<worldbody>", f'<include file="{path}"/><worldbody>', 1))
    SimulatedFlotor(load_joystick(str(folder)))


@pytest.mark.parametrize(
    "read",
    [
        _read_machine, _read_attached, _read_joystick, load_chain, load_robot,
        lambda path: patched_mjcf(path, Patch()),
        lambda path: copy_mjcf(path, path.with_name("copy.xml"), "parts"),
    ],
    ids=["machine", "attached", "joystick", "chain", "robot", "patch", "copy"],
)  # fmt: skip
def test_every_reader_uses_the_loader(tmp_path, read):
    path = tmp_path / "two.xml"
    path.write_text(f'<mujoco><asset><model name="s" file="two.xml"/></asset>{BODY}</mujoco>')
    with pytest.raises(InputError, match=r"two.xml:1: <model file='two.xml'>: .*two.xml is a model inside itself"):
        read(path)
