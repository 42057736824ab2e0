"""The adapter for Force Dimension devices, against a stand-in of the vendor's binding."""

import sys

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.haptics.device import ForceDimension
from hydrotele.haptics.server import open_haptic_device


class Dhd:
    """What the adapter uses of `forcedimension_core.dhd`; names and codes as there."""

    def __init__(self, name="omega.7", connected=True):
        self.name, self.connected, self.calls = name, connected, []
        self.place, self.turn = (0.01, 0.02, 0.03), np.eye(3)

    def open(self):
        return 0 if self.connected else -1

    def errorGetLastStr(self):
        return "no device found"

    def getSystemName(self):
        return self.name

    def setGravityCompensation(self, enable):
        self.calls.append(("gravity", enable))
        return 0

    def enableForce(self, enable):
        self.calls.append(("force", enable))
        return 0

    def getPositionAndOrientationFrame(self, p_out, matrix_out):
        p_out[:] = self.place
        for row, values in zip(matrix_out, self.turn.tolist(), strict=True):
            row[:] = values
        return 0 if self.connected else -1

    def getButtonMask(self):
        return 2

    def setForceAndTorque(self, f, t):
        self.calls.append((f, t))
        return 0 if self.connected else -1

    def close(self):
        self.calls.append(("close",))
        return 0


def test_its_axes_are_turned_by_half_a_turn_about_z():
    dhd = Dhd()
    device = ForceDimension(dhd)
    pose = device.read()
    assert pose.place.tolist() == [-0.01, -0.02, 0.03] and pose.buttons == 2
    device.write(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]), True)
    assert dhd.calls[-1] == ([-1.0, -2.0, 3.0], [-0.1, -0.2, 0.3])


def test_a_turn_about_its_x_is_one_about_minus_x():
    dhd, c, s = Dhd(), np.cos(0.2), np.sin(0.2)
    dhd.turn = np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    assert ForceDimension(dhd).read().quaternion == pytest.approx([np.cos(0.1), -np.sin(0.1), 0.0, 0.0])


def test_forces_are_on_while_it_is_open():
    dhd = Dhd()
    ForceDimension(dhd).close()
    assert dhd.calls == [("gravity", True), ("force", True), ("force", False), ("close",)]


def test_abilities_are_those_of_the_model_and_small_for_an_unknown_one():
    assert ForceDimension(Dhd("sigma.7")).limits.max_rotation > 0.0
    assert ForceDimension(Dhd("omega.6")).limits.max_torque == 0.0
    assert ForceDimension(Dhd("brand new")).limits.max_force <= 8.0


def test_no_device_and_one_that_is_lost():
    with pytest.raises(InputError, match="cannot open a device .no device found.: connect it"):
        ForceDimension(Dhd(connected=False))
    dhd = Dhd()
    device = ForceDimension(dhd)
    dhd.connected = False
    with pytest.raises(OSError, match="no device found"):
        device.read()
    with pytest.raises(OSError, match="no device found"):
        device.write(np.zeros(6), True)


def test_without_the_package_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "forcedimension_core", None)
    with pytest.raises(InputError, match="pip install forcedimension-core"):
        open_haptic_device("force-dimension", 1e-3)


def test_no_such_kind():
    with pytest.raises(InputError, match="valid: simulated, force-dimension, haption"):
        open_haptic_device("phantom", 1e-3)
