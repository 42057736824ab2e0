"""Machines with meshes, textures and height fields of their own."""

import struct
import zlib

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.simulate.plant import build_plant
from tests.models.test_foreign_mjcf import MACHINE

MJCF = """\
<mujoco><compiler meshdir="parts/meshes" texturedir="parts"/>
<asset><mesh file="leaf.stl"/><mesh name="other" file="more/leaf.stl"/>
<texture name="rust" type="2d" file="rust.png"/><material name="rust" texture="rust"/>
<hfield name="hill" file="hill.png" size="2 2 0.1 0.1"/></asset>
<worldbody><geom name="hill" type="hfield" hfield="hill"/>
<body name="wing" pos="0 0 3"><joint name="wing" axis="0 -1 0"/>
<geom name="ground" type="mesh" mesh="leaf" material="rust"/>
<geom name="sun" type="mesh" mesh="other" contype="0" conaffinity="0"/>
<site name="tip"/></body></worldbody></mujoco>
"""


def _stl(size: float) -> bytes:
    corners = size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4")
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    parts = [struct.pack("<3f", 0, 0, 0) + corners[list(f)].tobytes() + b"\0\0" for f in faces]
    return b"\0" * 80 + struct.pack("<I", len(faces)) + b"".join(parts)


def _png(colour: int) -> bytes:
    rows = b"".join(b"\0" + bytes([colour, y, x]) * 4 for y in range(4) for x in [y])

    def chunk(kind: bytes, content: bytes) -> bytes:
        checked = kind + content
        return struct.pack(">I", len(content)) + checked + struct.pack(">I", zlib.crc32(checked))

    head = struct.pack(">IIBBBBB", 4, 4, 8, 2, 0, 0, 0)
    chunks = (b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*pair) for pair in chunks)


@pytest.fixture
def gate(tmp_path):
    """A folder with a machine whose names are also ours, and two files of one name."""
    folder = tmp_path / "gate"
    (folder / "parts/meshes/more").mkdir(parents=True)
    (folder / "machine.yaml").write_text(MACHINE)
    (folder / "gate.xml").write_text(MJCF)
    (folder / "parts/meshes/leaf.stl").write_bytes(_stl(1.0))
    (folder / "parts/meshes/more/leaf.stl").write_bytes(_stl(2.0))
    (folder / "parts/meshes/hill.png").write_bytes(_png(10))
    (folder / "parts/rust.png").write_bytes(_png(200))
    return folder


def test_the_complete_mjcf_opens_in_plain_mujoco_wherever_it_is_moved(gate, tmp_path):
    plant = build_plant(load_machine(gate))
    written = tmp_path / "somewhere" / "scene.xml"
    written.parent.mkdir()
    plant.document.save(written)
    moved = written.parent.rename(tmp_path / "elsewhere")
    model = mujoco.MjModel.from_xml_path(str(moved / "scene.xml"))
    assert (model.nmesh, model.nhfield) == (2, 1)
    assert model.geom("ground").bodyid == model.body("wing").id
    assert model.geom("hydrotele_ground").bodyid == 0
    assert str(tmp_path) not in (moved / "scene.xml").read_text()


def test_a_saved_machine_takes_its_files_along(gate, tmp_path):
    machine = load_machine(gate)
    (tmp_path / "handed_on").mkdir()
    save_machine(machine, tmp_path / "handed_on/machine.yaml")
    gate.rename(tmp_path / "gone")
    again = build_plant(load_machine(tmp_path / "handed_on"))
    expected = build_plant(load_machine(tmp_path / "gone"))
    for model in (again.document.compile(), again.model):
        reference = expected.model if model is again.model else expected.document.compile()
        np.testing.assert_array_equal(model.mesh_vert, reference.mesh_vert)
        np.testing.assert_array_equal(model.hfield_data, reference.hfield_data)
        np.testing.assert_array_equal(model.tex_data, reference.tex_data)


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("parts/meshes/more/leaf.stl", None, r"mesh file='more/leaf.stl'.*No such file"),
        ("parts/rust.png", None, r"texture file='rust.png'.*No such file"),
        ("parts/meshes/leaf.stl", b"not a mesh", r"machine gate: .*"),
        ("gate.xml", "<mujoco>" * 300 + "</mujoco>" * 300, r"300 nested levels"),
        ("gate.xml", MJCF.replace('mesh="other"', 'mesh="none"'), r"machine gate: .*none"),
        ("gate.xml", MJCF.replace('name="other"', 'name="leaf"'), r"gate.xml.*leaf"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_file_is_one_sentence(gate, file, content, said):
    if content is None:
        (gate / file).unlink()
    elif isinstance(content, bytes):
        (gate / file).write_bytes(content)
    else:
        (gate / file).write_text(content)
    with pytest.raises(InputError, match=said):
        build_plant(load_machine(gate)).document.compile()


def test_an_asset_is_no_pipe_and_not_too_large(gate, monkeypatch):
    monkeypatch.setenv("HYDROTELE_MAX_ASSET_BYTES", "100")
    with pytest.raises(InputError, match=r"leaf.stl.*HYDROTELE_MAX_ASSET_BYTES=284"):
        build_plant(load_machine(gate))
