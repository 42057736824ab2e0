"""`Machine.replace`: one value by its path, checked; a wrong path names the valid ones."""

import pytest

from hydrotele.core.errors import InputError
from hydrotele.effects import with_value
from hydrotele.machine.machine_file import load_machine


@pytest.fixture(scope="module")
def machine():
    return load_machine("cat215", "bucket")


def test_value_is_replaced_in_a_copy(machine):
    changed = machine.replace("axes.boom.valve.deadband", 0.1)
    assert changed.axes["boom"].valve.deadband == 0.1 != machine.axes["boom"].valve.deadband
    assert changed.axes["stick"] == machine.axes["stick"]
    assert machine.replace("gravity.2", -9.0).gravity == (0.0, 0.0, -9.0)
    assert machine.replace("axes.boom.valve.deadband", machine.axes["boom"].valve.deadband) == machine


def test_key_with_dots(machine):
    changed = machine.replace("sensor_errors", {"angle.boom": {"offset": 0.01}})
    assert changed.replace("sensor_errors.angle.boom.offset", 0.02).sensor_errors["angle.boom"].offset == 0.02


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("supply.pump_flw", 1.0, "supply.pump_flw: does not exist; did you mean 'supply.pump_flow'? valid: "),
        ("axes.bom.valve", 1.0, "axes.bom: does not exist; did you mean 'axes.boom'? "
         "valid: axes.boom, axes.bucket, axes.stick, axes.swing"),
        ("gravity.3", 0.0, "gravity.3: does not exist; did you mean 'gravity.2'? valid: gravity.0, gravity.1"),
        ("", 0.0, ": does not exist; valid: arm, attached, axes,"),
        ("axes.boom.motor.x", 0.0, "axes.boom.motor.x: axes.boom.motor is None and has no parts: "),
        ("links.boom.mass", -1.0, "links.boom.mass: cannot be -1.0: Input should be greater than 0"),
        ("axes.boom.joint", "bom", "axes.boom.joint: cannot be 'bom': axes.boom.joint: 'bom' is not known"),
        ("supply.tank_pressure", 1e9, "supply.tank_pressure: cannot be 1000000000.0: tank_pressure 1e+09 Pa is"),
    ],
)  # fmt: skip
def test_wrong_path_or_value(machine, path, value, message):
    with pytest.raises(InputError) as error:
        machine.replace(path, value)
    assert str(error.value).startswith(message)


def test_effects_replace_by_the_same_rule(machine):
    assert with_value(machine, "supply.pump_flow", 0.004) == machine.replace("supply.pump_flow", 0.004)
    assert with_value(machine, "links.boom.mass", -1.0).links["boom"].mass == -1.0  # not checked
    with pytest.raises(InputError, match="valid: axes.boom"):
        with_value(machine, "axes.bom.valve.deadband", 0.1)


def test_repr_is_short(machine):
    assert repr(machine) == str(machine) == "Machine('cat215', tool='bucket', axes=[swing, boom, stick, bucket])"
