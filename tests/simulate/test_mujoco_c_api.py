"""Field offsets are MuJoCo's own, and a wrong one is found before native code reads through it."""

import mujoco
import numpy as np
import pytest

from hydrotele.simulate import mujoco_c_api


@pytest.fixture
def fresh():
    """Run the checks anew, before and after the test."""
    caches = (mujoco_c_api.field_offsets, mujoco_c_api.option_offset, mujoco_c_api.verify_struct_offsets)
    for cached in caches:
        cached.cache_clear()
    yield
    for cached in caches:
        cached.cache_clear()


def test_layout_is_that_of_the_installed_mujoco(fresh):
    mujoco_c_api.verify_struct_offsets()


@pytest.mark.parametrize(
    "field",
    ["actuator_user", "actuator_actadr", "nuser_actuator", "nu", "nnumeric", "numeric_data"],
)
def test_model_fields_lie_where_the_bindings_show_them(field):
    model = mujoco.MjModel.from_xml_string(mujoco_c_api._PROBE_MODEL)
    address = model._address + mujoco_c_api.field_offsets("mjModel")[field]
    value = mujoco_c_api._read_number(address, np.int64)
    shown = getattr(model, field)
    assert value == (shown if np.isscalar(shown) else shown.ctypes.data)


@pytest.mark.parametrize(
    ("struct", "field", "shift"),
    [
        ("mjModel", "actuator_user", 8),
        ("mjModel", "actuator_actadr", 8),
        ("mjModel", "nu", -8),
        ("mjModel", "nuser_actuator", 8),
        ("mjModel", "nnumeric", 8),
        ("mjModel", "numeric_adr", 8),
        ("mjModel", "numeric_size", 8),
        ("mjModel", "numeric_data", 8),
        ("mjData", "ctrl", 8),
        ("mjData", "act", 8),
        ("mjData", "act_dot", 8),
        ("mjData", "actuator_length", 8),
        ("mjData", "actuator_velocity", 8),
        ("mjData", "ncon", 4),
        ("mjData", "contact", 8),
        ("mjData", "warning", 4),
        ("mjContact", "frame", 8),
        ("mjContact", "geom", 4),
    ],
)
def test_a_moved_field_is_detected(fresh, monkeypatch, struct, field, shift):
    true = mujoco_c_api.field_offsets

    def forged(name):
        return {k: v + shift * (name == struct and k == field) for k, v in true(name).items()}

    monkeypatch.setattr(mujoco_c_api, "field_offsets", forged)
    with pytest.raises(RuntimeError, match=rf"stores .*{field}.* at other offsets"):
        mujoco_c_api.verify_struct_offsets()


def test_a_moved_option_is_detected(fresh, monkeypatch):
    true = mujoco_c_api.option_offset("timestep")
    monkeypatch.setattr(mujoco_c_api, "option_offset", lambda name: true + 8)
    with pytest.raises(RuntimeError, match="opt.timestep"):
        mujoco_c_api.verify_struct_offsets()


def test_an_unknown_type_is_refused():
    class Strange:
        name = "quaternion_of_the_future"

    with pytest.raises(RuntimeError, match="unknown C type"):
        mujoco_c_api._size_and_alignment(Strange())
