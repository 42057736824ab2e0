"""Haption devices (Virtuose) through the vendor's VirtuoseAPI, bound by ctypes.

The library `libVirtuoseAPI` comes from the vendor with a device and is not needed unless such a
device is asked for. Not tried with hardware here: the adapter is tested against a library of the
same functions that records the calls. Functions, their arguments and codes are those of the
vendor's header as public programs use it; axes and limits come at second hand, too.

The device's place is counted from its foot, so that the centre of the handle is where it is when
the server starts. Device axes: x towards the user, y to the right, z up.
"""

import ctypes
import ctypes.util
import os
from typing import Any

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.haptics.device import Abilities, HandlePose

_WHERE = "--kind haption"
LIBRARY = "VIRTUOSE_API"  # environment variable with the library's file
ADDRESS = "127.0.0.1#53210"  # where the vendor's service listens on the same computer
_IMPEDANCE, _NO_INDEXING = 3, 2  # COMMAND_TYPE_IMPEDANCE, INDEXING_NONE
_BUTTONS = (1, 2)
_FROM_DEVICE = np.array([-1.0, -1.0, 1.0])  # half a turn about z
# CHAI3D's driver has 30 N, 3 N m and 0.45 m for a Virtuose 6D. A third of it is what is given here
# for hours: an assumption, not checked against a data sheet, as is the turning.
_ABILITIES = Abilities(travel=0.15, rotation=0.6, force=10.0, torque=1.0)
_ARGUMENTS = {
    "virtOpen": (ctypes.c_char_p,), "virtClose": (ctypes.c_void_p,),
    "virtGetErrorCode": (ctypes.c_void_p,), "virtGetErrorMessage": (ctypes.c_int,),
    "virtSetIndexingMode": (ctypes.c_void_p, ctypes.c_int),
    "virtSetForceFactor": (ctypes.c_void_p, ctypes.c_float),
    "virtSetSpeedFactor": (ctypes.c_void_p, ctypes.c_float),
    "virtSetTimeStep": (ctypes.c_void_p, ctypes.c_float),
    "virtSetBaseFrame": (ctypes.c_void_p, ctypes.POINTER(ctypes.c_float)),
    "virtSetObservationFrame": (ctypes.c_void_p, ctypes.POINTER(ctypes.c_float)),
    "virtSetCommandType": (ctypes.c_void_p, ctypes.c_int),
    "virtSetPowerOn": (ctypes.c_void_p, ctypes.c_int),
    "virtGetPosition": (ctypes.c_void_p, ctypes.POINTER(ctypes.c_float)),
    "virtGetButton": (ctypes.c_void_p, ctypes.c_int, ctypes.POINTER(ctypes.c_int)),
    "virtSetForce": (ctypes.c_void_p, ctypes.POINTER(ctypes.c_float)),
}  # fmt: skip


class Haption:
    """A Haption device at an address."""

    abilities = _ABILITIES

    def __init__(self, period: float, address: str = ADDRESS, library: Any = None) -> None:
        """Open it, with its forces on.

        Args:
            period: of the server [s].
            address: of the vendor's service or of the device, `HOST#PORT`.
            library: the vendor's library; the one that VIRTUOSE_API names by default.

        Raises:
            InputError: the library is missing, or no device answers there.
        """
        self._api = api = _bound(library or _library())
        self._device = api.virtOpen(address.encode())
        if not self._device:
            message = f"no device answers at {address} ({self._why(None)}): start its service"
            raise InputError(_WHERE, f"{message}, or name it with --kind haption:HOST#PORT")
        self._seven, self._six = (ctypes.c_float * 7)(), (ctypes.c_float * 6)()
        self._pressed = ctypes.c_int()
        frame = (ctypes.c_float * 7)(0, 0, 0, 0, 0, 0, 1)
        try:
            for name, value in (
                ("IndexingMode", _NO_INDEXING), ("ForceFactor", 1.0), ("SpeedFactor", 1.0),
                ("TimeStep", period), ("BaseFrame", frame), ("ObservationFrame", frame),
                ("CommandType", _IMPEDANCE), ("PowerOn", 1),
            ):  # fmt: skip
                self._done(getattr(api, f"virtSet{name}")(self._device, value))
            self._centre, self._turned = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
            begun = self.read()
        except OSError as error:
            api.virtClose(self._device)
            raise InputError(_WHERE, f"does not take its settings ({error})") from None
        self._centre, self._turned = begun.place, begun.quaternion * [1.0, -1.0, -1.0, -1.0]

    def read(self) -> HandlePose:
        """Where the handle is now.

        Raises:
            OSError: the device does not answer.
        """
        api, device = self._api, self._device
        self._done(api.virtGetPosition(device, self._seven))
        seven, buttons = np.array(self._seven), 0
        for bit, number in enumerate(_BUTTONS):
            self._done(api.virtGetButton(device, number, ctypes.byref(self._pressed)))
            buttons |= (self._pressed.value != 0) << bit
        x, y, z, w = seven[3:]  # the vendor's order: scalar last
        turn = np.array([w, *(_FROM_DEVICE * (x, y, z))])
        return HandlePose(
            _FROM_DEVICE * seven[:3] - self._centre, _product(turn, self._turned), buttons
        )

    def write(self, wrench: np.ndarray, on: bool) -> None:
        """Put a wrench on the handle.

        Raises:
            OSError: the device does not answer.
        """
        self._six[:3], self._six[3:] = _FROM_DEVICE * wrench[:3], _FROM_DEVICE * wrench[3:]
        self._done(self._api.virtSetForce(self._device, self._six))

    def close(self) -> None:
        """Take the force off and let go of it."""
        self._six[:] = [0.0] * 6
        self._api.virtSetForce(self._device, self._six)
        self._api.virtSetPowerOn(self._device, 0)
        self._api.virtClose(self._device)

    def _done(self, code: int) -> None:
        if code != 0:
            raise OSError(self._why(self._device))

    def _why(self, device: int | None) -> str:
        message = self._api.virtGetErrorMessage(self._api.virtGetErrorCode(device))
        return message.decode(errors="replace") if message else "no reason given"


def _library() -> Any:
    """The vendor's library."""
    name = os.environ.get(LIBRARY) or ctypes.util.find_library("VirtuoseAPI")
    if not name:
        message = f"needs the vendor's libVirtuoseAPI: install it, or set {LIBRARY} to its file"
        raise InputError(_WHERE, message)
    try:
        return ctypes.CDLL(name)
    except OSError as error:
        raise InputError(_WHERE, f"cannot load the vendor's library ({error})") from None


def _bound(library: Any) -> Any:
    """The library with the types of what is used."""
    for name, arguments in _ARGUMENTS.items():
        try:
            function = getattr(library, name)
        except AttributeError:
            raise InputError(_WHERE, f"the library has no {name}: is it VirtuoseAPI?") from None
        function.argtypes = list(arguments)
        function.restype = {
            "virtOpen": ctypes.c_void_p,
            "virtGetErrorMessage": ctypes.c_char_p,
        }.get(name, ctypes.c_int)
    return library


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product (4,) of two quaternions, scalar first."""
    import mujoco

    out = np.empty(4)
    mujoco.mju_mulQuat(out, np.asarray(a, float), np.asarray(b, float))
    return out
