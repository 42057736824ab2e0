"""The adapter for Haption devices, against a library of the vendor's functions."""

import ctypes

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.haptics.device import LIBRARY_VARIABLE, Haption
from hydrotele.haptics.server import open_haptic_device

CONTEXT, INT, FLOAT = ctypes.c_void_p, ctypes.c_int, ctypes.c_float
FLOATS, INTS = ctypes.POINTER(FLOAT), ctypes.POINTER(INT)


class VirtuoseAPI:
    """Functions with C's calling convention that record what came; 0 is success."""

    def __init__(self, connected=True):
        self.connected, self.code, self.calls = connected, 0, []
        self.place, self.turn, self.pressed = [0.5, 0.1, 0.3], [0.0, 0.0, 0.0, 1.0], {1: 0, 2: 1}
        self.virtOpen = self._function(CONTEXT, self._open, ctypes.c_char_p)
        self.virtGetErrorCode = self._function(INT, lambda context: 7, CONTEXT)
        self.virtGetErrorMessage = self._function(CONTEXT, lambda code: ctypes.cast(self._message, CONTEXT).value, INT)
        self._message = ctypes.c_char_p(b"cable is out")
        for name in ("IndexingMode", "CommandType", "PowerOn"):
            setattr(self, f"virtSet{name}", self._setter(name, INT))
        for name in ("ForceFactor", "SpeedFactor", "TimeStep"):
            setattr(self, f"virtSet{name}", self._setter(name, FLOAT))
        for name, many in (("BaseFrame", 7), ("ObservationFrame", 7), ("Force", 6)):
            setattr(self, f"virtSet{name}", self._setter(name, FLOATS, many))
        self.virtClose = self._function(INT, lambda context: self._note("Close", context), CONTEXT)
        self.virtGetPosition = self._function(INT, self._position, CONTEXT, FLOATS)
        self.virtGetButton = self._function(INT, self._button, CONTEXT, INT, INTS)

    @staticmethod
    def _function(result, does, *arguments):
        return ctypes.CFUNCTYPE(result, *arguments)(does)

    def _setter(self, name, kind, many=0):
        def does(context, value):
            return self._note(name, [value[k] for k in range(many)] if many else value)

        return self._function(INT, does, CONTEXT, kind)

    def _note(self, name, value):
        self.calls.append((name, value))
        return self.code

    def _open(self, address):
        self.calls.append(("Open", address))
        return 42 if self.connected else None

    def _position(self, context, out):
        for k, value in enumerate([*self.place, *self.turn]):
            out[k] = value
        return self.code

    def _button(self, context, number, out):
        out[0] = self.pressed[number]
        return self.code


def test_it_is_set_to_forces_and_let_go_without_one():
    api = VirtuoseAPI()
    device = Haption(1e-3, "lab#5000", api)
    said = dict(api.calls)
    assert said["Open"] == b"lab#5000" and said["PowerOn"] == 1
    assert said["CommandType"] == 3 and said["IndexingMode"] == 2  # impedance, no indexing
    assert said["TimeStep"] == pytest.approx(1e-3) and said["BaseFrame"] == [0] * 6 + [1.0]
    assert api.calls[-1] == ("PowerOn", 1)  # after everything else is set
    device.close()
    assert api.calls[-3:] == [("Force", [0.0] * 6), ("PowerOn", 0), ("Close", 42)]


def test_places_count_from_where_it_was_opened_and_axes_are_turned():
    api = VirtuoseAPI()
    api.turn = [0.0, 0.0, np.sin(0.3), np.cos(0.3)]
    device = Haption(1e-3, library=api)
    assert device.read().place.tolist() == [0.0, 0.0, 0.0]
    assert device.read().quaternion == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-6)
    api.place = [0.51, 0.12, 0.33]  # towards the user, to the right, up
    api.turn = [0.0, 0.0, np.sin(0.4), np.cos(0.4)]  # 0.2 rad more about z
    pose = device.read()
    assert pose.place == pytest.approx([-0.01, -0.02, 0.03], abs=1e-7)  # float32 of the library
    assert pose.quaternion == pytest.approx([np.cos(0.1), 0.0, 0.0, np.sin(0.1)], abs=1e-6)
    assert pose.buttons == 2
    device.write(np.array([1.0, 2.0, 3.0, 0.5, 0.25, 0.125]), True)
    assert api.calls[-1] == ("Force", [-1.0, -2.0, 3.0, -0.5, -0.25, 0.125])


def test_a_turn_about_its_x_is_one_about_minus_x():
    api = VirtuoseAPI()
    device = Haption(1e-3, library=api)
    api.turn = [np.sin(0.1), 0.0, 0.0, np.cos(0.1)]
    assert device.read().quaternion == pytest.approx([np.cos(0.1), -np.sin(0.1), 0, 0], abs=1e-6)


def test_no_device_one_that_is_lost_and_no_library(monkeypatch, tmp_path):
    with pytest.raises(InputError, match="no device answers at .*cable is out.*HOST#PORT"):
        Haption(1e-3, library=VirtuoseAPI(connected=False))
    api = VirtuoseAPI()
    device = Haption(1e-3, library=api)
    api.code = 1
    for act in (device.read, lambda: device.write(np.zeros(6), True)):
        with pytest.raises(OSError, match="cable is out"):
            act()
    with pytest.raises(InputError, match="the device rejects its settings .cable is out"):
        Haption(1e-3, library=api)
    assert api.calls[-1] == ("Close", 42)
    monkeypatch.delenv(LIBRARY_VARIABLE, raising=False)
    with pytest.raises(InputError, match="needs the vendor's libVirtuoseAPI"):
        open_haptic_device("haption", 1e-3)
    monkeypatch.setenv(LIBRARY_VARIABLE, str(tmp_path / "none.so"))
    with pytest.raises(InputError, match="cannot load the vendor's library"):
        open_haptic_device("haption:lab#5000", 1e-3)
    with pytest.raises(InputError, match="has no virtOpen: is it VirtuoseAPI"):
        Haption(1e-3, library=object())
