"""Haptic devices: the interface that a server needs, and three implementations of it.

The simulated device is a handle with six axes, a mass, viscous friction and stops at the ends of
its travel. A simulated operator's arm holds it: a mass that a spring and a damper pull to a
reference pose.

Force Dimension devices (omega, delta, sigma, lambda) are driven through the DHD library.
The Python package `forcedimension-core` binds the vendor's SDK, which the vendor gives to owners of
a device. Both are optional. The adapter has not been run with hardware: it is tested against a
stand-in of the package that records the calls.

Haption devices (Virtuose) are driven through the vendor's VirtuoseAPI, bound by ctypes.
The library `libVirtuoseAPI` comes from the vendor with a device and is optional. The adapter has
not been run with hardware: it is tested against a library with the same functions that records the
calls. Functions, arguments and codes follow the vendor's header as public programs use it; axes and
limits also come from secondary sources. Poses are measured from the handle's pose at the start, so
that this pose is the centre.

Device axes of both vendors: x towards the user, y to the right, z up.
"""

import ctypes
import ctypes.util
import os
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError

_HESITATION = 1.0  # s from the start of control until the simulated operator moves
_FINE = 4  # integration steps per period: the contact with a stop has a time scale of 6 ms


class Abilities(NamedTuple):
    """Travel and output limits of a device.

    Attributes:
        travel: half range from the centre [m].
        rotation: half range [rad]; 0 for a device that does not measure or drive rotations.
        force: maximum force [N].
        torque: maximum torque [N m].
    """

    travel: float
    rotation: float
    force: float
    torque: float


class HandlePose(NamedTuple):
    """Pose and buttons of a handle.

    Attributes:
        place: (3,) position from its centre [m]; x away from the user, y to the left, z up.
        quaternion: (4,) scalar first.
        buttons: bit mask, one bit per button.
    """

    place: np.ndarray
    quaternion: np.ndarray
    buttons: int


class HapticDevice(Protocol):
    """Interface of an open device with force output."""

    @property
    def abilities(self) -> Abilities:
        """Travel and output limits of the device."""
        ...

    def read(self) -> HandlePose:
        """Read the current pose of the handle.

        Raises:
            OSError: the device does not answer.
        """
        ...

    def write(self, wrench: np.ndarray, on: bool) -> None:
        """Apply a wrench (6,) [N], [N m] to the handle until the next call.

        Args:
            wrench: zero while no machine is in control.
            on: whether a machine is in control.

        Raises:
            OSError: the device does not answer.
        """
        ...

    def close(self) -> None:
        """Switch the force off and close the device."""
        ...


def within_limits(wrench: np.ndarray, abilities: Abilities) -> np.ndarray:
    """Limit a wrench to the maximum force and torque of a device, keeping both directions.

    Args:
        wrench: (6,) [N], [N m].
        abilities: limits of the device.

    Returns:
        (6,), zero if an element of the wrench is not finite.

    >>> within_limits(np.array([30.0, 0, 40.0, 0, 0, 0.1]), Abilities(0.05, 0.5, 5.0, 0.4)).tolist()
    [3.0, 0.0, 4.0, 0.0, 0.0, 0.1]
    """
    if not np.isfinite(wrench).all():
        return np.zeros(6)
    out = np.array(wrench, float)
    for part, most in ((out[:3], abilities.force), (out[3:], abilities.torque)):
        size = float(np.sqrt(part @ part))
        if size > most:
            part *= most / size
    return out


@dataclass(frozen=True)
class SimulatedFacts:
    """Parameters of a desktop device and the operator's arm; all values are assumed typical values.

    Attributes:
        abilities: travel and output limits.
        mass: mass of the handle [kg] and its moment of inertia [kg m^2].
        friction: viscous friction of the handle [N s/m], [N m s/rad].
        hand_mass: mass and inertia of the arm [kg], [kg m^2].
        hand_damping: damping of the arm [N s/m], [N m s/rad].
        hand_stiffness: stiffness of the arm [N/m], [N m/rad].
        motion: amplitudes of the reference motion, as fractions of the travel [1].
        frequency: frequencies of the reference motion for x, y, z, rx, ry, rz [Hz], all different.
    """

    abilities: Abilities = Abilities(0.06, 0.6, 12.0, 0.4)
    mass: tuple[float, float] = (0.3, 3e-4)
    friction: tuple[float, float] = (0.5, 1e-3)
    hand_mass: tuple[float, float] = (0.6, 1e-3)
    hand_damping: tuple[float, float] = (8.0, 0.05)
    hand_stiffness: tuple[float, float] = (250.0, 1.5)
    motion: tuple[float, float, float, float, float, float] = (0.7, 0.5, 0.5, 0.1, 0.3, 0.1)
    frequency: tuple[float, float, float, float, float, float] = (0.23, 0.17, 0.31, 0.2, 0.13, 0.1)


class SimulatedDevice:
    """Simulate a device without hardware; every call of `read` advances it by one period."""

    def __init__(self, period: float, facts: SimulatedFacts | None = None) -> None:
        """Start with the handle at rest in its centre.

        Args:
            period: time between two calls of `read` [s].
            facts: parameters of device and arm.
        """
        f = facts or SimulatedFacts()
        self.facts, self._period = f, period
        both = [np.array([part] * 3 + [turn] * 3) for part, turn in
                (f.mass, f.friction, f.hand_mass, f.hand_damping, f.hand_stiffness)]  # fmt: skip
        a = f.abilities
        self._stop = np.array([a.travel] * 3 + [a.rotation] * 3)
        self._numbers = np.array([*both, self._stop])
        self._amplitude = np.array(f.motion) * self._stop
        self._omega = 2.0 * np.pi * np.array(f.frequency)
        self._time, self._state, self._wrench = -_HESITATION, np.zeros((2, 6)), np.zeros(6)

    @property
    def abilities(self) -> Abilities:
        """Travel and output limits of the device."""
        return self.facts.abilities

    @property
    def wrench(self) -> np.ndarray:
        """Wrench (6,) that is currently applied to the handle [N], [N m]."""
        return self._wrench

    def read(self) -> HandlePose:
        """Advance the simulation by one period and return the handle's pose."""
        wanted = self._amplitude * np.sin(self._omega * max(0.0, self._time))
        _move(self._numbers, wanted, self._wrench, self._period, self._state)
        x = self._state[0]
        angle = float(np.sqrt(x[3:] @ x[3:]))
        quaternion = np.array([np.cos(0.5 * angle), 0.0, 0.0, 0.0])
        quaternion[1:] = x[3:] * (np.sin(0.5 * angle) / angle if angle > 0.0 else 0.5)
        return HandlePose(x[:3].copy(), quaternion, 0)

    def write(self, wrench: np.ndarray, on: bool) -> None:
        """Apply a wrench; the simulated operator moves 1 s after a machine takes control."""
        self._wrench[:] = wrench
        self._time = self._time + self._period if on else -_HESITATION

    def close(self) -> None:
        """Switch the force off."""
        self._wrench[:] = 0.0


@compiled
def _move(numbers, wanted, wrench, period, state):
    """Integrate handle and arm over one period, axis by axis, with semi-implicit Euler steps."""
    mass, friction, hand_mass, hand_damping, hand_stiffness, stop = numbers
    step = period / _FINE
    for _ in range(_FINE):
        for i in range(6):
            x, v = state[0, i], state[1, i]
            force = wrench[i] - friction[i] * v
            force += hand_stiffness[i] * (wanted[i] - x) - hand_damping[i] * v
            own = mass[i] + hand_mass[i]
            beyond = abs(x) - stop[i]
            if beyond > 0.0:  # stop: time scale of 6 ms, damped against rebound
                quick = 2.0 * np.pi / 6e-3
                force -= own * (quick * quick * (beyond if x > 0.0 else -beyond) + quick * v)
            v += step * force / own
            state[1, i] = v
            state[0, i] = x + step * v


_FORCE_DIMENSION = "--kind force-dimension"
_FROM_DHD = np.diag([-1.0, -1.0, 1.0])  # rotation by 180 degrees about z
# Limits by a part of the device's DHD name: travel [m], rotation [rad], force [N], torque [N m].
# Forces and torques of omega.7 and sigma.7 are those of their CHAI3D driver, all others are
# assumed. None was checked against the vendor's data sheets.
_DHD_DEVICES = {
    "omega.3": Abilities(0.055, 0.0, 12.0, 0.0),
    "omega.6": Abilities(0.055, 0.0, 12.0, 0.0),  # its wrist has no torque output
    "omega.7": Abilities(0.055, 0.0, 12.0, 0.0),
    "delta.3": Abilities(0.13, 0.0, 20.0, 0.0),
    "sigma.7": Abilities(0.065, 0.6, 12.0, 0.2),
    "lambda.7": Abilities(0.085, 0.6, 20.0, 0.4),
}
_DHD_LEAST = Abilities(0.05, 0.0, 8.0, 0.0)  # for a device that is not listed


class ForceDimension:
    """Drive the first connected Force Dimension device."""

    def __init__(self, dhd: Any = None) -> None:
        """Open the device and switch on its gravity compensation and forces.

        Args:
            dhd: module `dhd` of the binding; imported by default.

        Raises:
            InputError: the package or the SDK is missing, or no device is connected.
        """
        self._dhd = dhd = dhd or _dhd_module()
        if dhd.open() < 0:
            why = dhd.errorGetLastStr()
            raise InputError(
                _FORCE_DIMENSION, f"cannot open a device ({why}): connect it, switch it on"
            )
        name = str(dhd.getSystemName() or "").lower()
        known = [a for key, a in _DHD_DEVICES.items() if key in name]
        self.abilities = known[0] if known else _DHD_LEAST
        dhd.setGravityCompensation(True)
        dhd.enableForce(True)
        self._place, self._turn = [0.0] * 3, [[0.0] * 3 for _ in range(3)]

    def read(self) -> HandlePose:
        """Read the current pose of the handle.

        Raises:
            OSError: the device does not answer.
        """
        # 0 or a positive code is success (positive: no new data), -1 is failure
        if self._dhd.getPositionAndOrientationFrame(self._place, self._turn) < 0:
            raise OSError(self._dhd.errorGetLastStr())
        turn = _FROM_DHD @ np.array(self._turn) @ _FROM_DHD.T
        buttons = int(self._dhd.getButtonMask())
        return HandlePose(_FROM_DHD @ np.array(self._place), _quaternion(turn), buttons)

    def write(self, wrench: np.ndarray, on: bool) -> None:
        """Apply a wrench to the handle.

        Raises:
            OSError: the device does not answer.
        """
        force, torque = _FROM_DHD.T @ wrench[:3], _FROM_DHD.T @ wrench[3:]
        if self._dhd.setForceAndTorque(force.tolist(), torque.tolist()) < 0:
            raise OSError(self._dhd.errorGetLastStr())

    def close(self) -> None:
        """Switch the force off and close the device."""
        self._dhd.enableForce(False)
        self._dhd.close()


def _dhd_module() -> Any:
    """Import the module `dhd` of the binding."""
    try:
        from forcedimension_core import dhd  # pyright: ignore[reportMissingImports] - optional
    except ImportError as error:
        message = (
            "needs the Force Dimension SDK and its Python package: install the SDK, set FDSDK to"
            f" its folder, then run pip install forcedimension-core ({error})"
        )
        raise InputError(_FORCE_DIMENSION, message) from None
    return dhd


def _quaternion(turn: np.ndarray) -> np.ndarray:
    """Convert a rotation matrix to a quaternion (4,), scalar first."""
    import mujoco

    out = np.empty(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(turn).ravel())
    return out


_HAPTION = "--kind haption"
LIBRARY = "VIRTUOSE_API"  # environment variable with the path of the library
ADDRESS = "127.0.0.1#53210"  # address of the vendor's service on the same computer
_IMPEDANCE, _NO_INDEXING = 3, 2  # COMMAND_TYPE_IMPEDANCE, INDEXING_NONE
_BUTTONS = (1, 2)
_FROM_VIRTUOSE = np.array([-1.0, -1.0, 1.0])  # rotation by 180 degrees about z
# CHAI3D's driver has 30 N, 3 N m and 0.45 m for a Virtuose 6D. A third of each is assumed for
# continuous use. Neither this nor the rotation was checked against a data sheet.
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
    """Drive a Haption device at a network address."""

    abilities = _ABILITIES

    def __init__(self, period: float, address: str = ADDRESS, library: Any = None) -> None:
        """Open the device and switch on its forces.

        Args:
            period: period of the server [s].
            address: address of the vendor's service or of the device, `HOST#PORT`.
            library: the vendor's library; by default the one that VIRTUOSE_API names.

        Raises:
            InputError: the library is missing, or no device answers at the address.
        """
        self._api = api = _bound(library or _virtuose())
        self._device = api.virtOpen(address.encode())
        if not self._device:
            message = f"no device answers at {address} ({self._why(None)}): start its service"
            raise InputError(_HAPTION, f"{message}, or give its address: --kind haption:HOST#PORT")
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
            raise InputError(_HAPTION, f"the device rejects its settings ({error})") from None
        self._centre, self._turned = begun.place, begun.quaternion * [1.0, -1.0, -1.0, -1.0]

    def read(self) -> HandlePose:
        """Read the current pose of the handle.

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
        turn = np.array([w, *(_FROM_VIRTUOSE * (x, y, z))])
        return HandlePose(
            _FROM_VIRTUOSE * seven[:3] - self._centre, _product(turn, self._turned), buttons
        )

    def write(self, wrench: np.ndarray, on: bool) -> None:
        """Apply a wrench to the handle.

        Raises:
            OSError: the device does not answer.
        """
        self._six[:3], self._six[3:] = _FROM_VIRTUOSE * wrench[:3], _FROM_VIRTUOSE * wrench[3:]
        self._done(self._api.virtSetForce(self._device, self._six))

    def close(self) -> None:
        """Switch the force off and close the device."""
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


def _virtuose() -> Any:
    """Load the vendor's library."""
    name = os.environ.get(LIBRARY) or ctypes.util.find_library("VirtuoseAPI")
    if not name:
        message = f"needs the vendor's libVirtuoseAPI: install it, or set {LIBRARY} to its path"
        raise InputError(_HAPTION, message)
    try:
        return ctypes.CDLL(name)
    except OSError as error:
        raise InputError(_HAPTION, f"cannot load the vendor's library ({error})") from None


def _bound(library: Any) -> Any:
    """Declare the argument and return types of the library functions that are called."""
    for name, arguments in _ARGUMENTS.items():
        try:
            function = getattr(library, name)
        except AttributeError:
            raise InputError(_HAPTION, f"the library has no {name}: is it VirtuoseAPI?") from None
        function.argtypes = list(arguments)
        function.restype = {
            "virtOpen": ctypes.c_void_p,
            "virtGetErrorMessage": ctypes.c_char_p,
        }.get(name, ctypes.c_int)
    return library


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Multiply two quaternions (4,), scalar first."""
    import mujoco

    out = np.empty(4)
    mujoco.mju_mulQuat(out, np.asarray(a, float), np.asarray(b, float))
    return out
