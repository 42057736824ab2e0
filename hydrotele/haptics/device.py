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

_MOTION_DELAY = 1.0  # s from the start of control until the simulated operator moves
_SUBSTEPS = 4  # integration steps per period: the contact with a stop has a time scale of 6 ms


class DeviceLimits(NamedTuple):
    """Travel and output limits of a device.

    Attributes:
        half_travel: half range of the handle's translation along each axis, from its centre [m].
        max_rotation: half range of its rotation about each axis [rad]; 0 for a device that does not
            measure or drive rotations.
        max_force: maximum magnitude of the output force [N].
        max_torque: maximum magnitude of the output torque [N m].
    """

    half_travel: float
    max_rotation: float
    max_force: float
    max_torque: float


class HandlePose(NamedTuple):
    """Pose and buttons of a handle.

    Attributes:
        place: (3,) position from its centre [m]; x away from the user, y to the left, z up.
        quaternion: (4,) orientation of the handle in these axes, scalar first.
        buttons: bit mask, one bit per button, 1 while it is pressed.
    """

    place: np.ndarray
    quaternion: np.ndarray
    buttons: int


class HapticDevice(Protocol):
    """Interface of an open device with force output."""

    @property
    def limits(self) -> DeviceLimits:
        """Travel and output limits of the device."""
        ...

    def read(self) -> HandlePose:
        """Read the current pose of the handle.

        Raises:
            OSError: the device does not answer.
        """
        ...

    def write(self, wrench: np.ndarray, is_active: bool) -> None:
        """Apply a wrench to the handle until the next call.

        Args:
            wrench: (6,) force [N] and torque [N m] on the handle; zero while no machine is in
                control.
            is_active: whether a machine is in control of the wrench.

        Raises:
            OSError: the device does not answer.
        """
        ...

    def close(self) -> None:
        """Switch the force off and close the device."""
        ...


def limit_wrench(wrench: np.ndarray, limits: DeviceLimits) -> np.ndarray:
    """Limit a wrench to the maximum force and torque of a device, keeping both directions.

    Force and torque are scaled separately, each only if its magnitude exceeds its limit.

    Args:
        wrench: (6,) force [N] and torque [N m].
        limits: limits of the device.

    Returns:
        (6,) limited wrench; zero if an element of the wrench is not finite.

    >>> limit_wrench(np.array([30.0, 0, 40.0, 0, 0, 0.1]), DeviceLimits(0.05, 0.5, 5.0, 0.4)).tolist()
    [3.0, 0.0, 4.0, 0.0, 0.0, 0.1]
    """
    if not np.isfinite(wrench).all():
        return np.zeros(6)
    out = np.array(wrench, float)
    for part, most in ((out[:3], limits.max_force), (out[3:], limits.max_torque)):
        size = float(np.sqrt(part @ part))
        if size > most:
            part *= most / size
    return out


@dataclass(frozen=True)
class SimulatedDeviceParameters:
    """Parameters of a desktop device and the operator's arm; all values are assumed typical values.

    Attributes:
        limits: travel and output limits.
        mass: mass of the handle [kg] and its moment of inertia [kg m^2].
        friction: viscous friction of the handle [N s/m], [N m s/rad].
        arm_mass: mass and inertia of the arm [kg], [kg m^2].
        arm_damping: damping of the arm [N s/m], [N m s/rad].
        arm_stiffness: stiffness of the arm [N/m], [N m/rad].
        motion_amplitudes: amplitudes of the sines x, y, z, rx, ry, rz that the arm's reference pose
            follows, as fractions of the half range of each axis [1].
        motion_frequencies: frequencies of these sines [Hz], all different.
    """

    limits: DeviceLimits = DeviceLimits(0.06, 0.6, 12.0, 0.4)
    mass: tuple[float, float] = (0.3, 3e-4)
    friction: tuple[float, float] = (0.5, 1e-3)
    arm_mass: tuple[float, float] = (0.6, 1e-3)
    arm_damping: tuple[float, float] = (8.0, 0.05)
    arm_stiffness: tuple[float, float] = (250.0, 1.5)
    motion_amplitudes: tuple[float, float, float, float, float, float] = (
        0.7,
        0.5,
        0.5,
        0.1,
        0.3,
        0.1,
    )
    motion_frequencies: tuple[float, float, float, float, float, float] = (
        0.23,
        0.17,
        0.31,
        0.2,
        0.13,
        0.1,
    )


class SimulatedDevice:
    """Simulated handle that an operator's arm holds, used in place of hardware.

    Every call of `read` advances the simulation by one period.
    """

    def __init__(self, period: float, parameters: SimulatedDeviceParameters | None = None) -> None:
        """Start with the handle at rest in its centre.

        Args:
            period: time between two calls of `read` [s].
            parameters: parameters of device and arm.
        """
        f = parameters or SimulatedDeviceParameters()
        self.parameters, self._period = f, period
        both = [np.array([part] * 3 + [turn] * 3) for part, turn in
                (f.mass, f.friction, f.arm_mass, f.arm_damping, f.arm_stiffness)]  # fmt: skip
        a = f.limits
        self._stop = np.array([a.half_travel] * 3 + [a.max_rotation] * 3)
        self._parameter_array = np.array([*both, self._stop])
        self._amplitude = np.array(f.motion_amplitudes) * self._stop
        self._omega = 2.0 * np.pi * np.array(f.motion_frequencies)
        self._time, self._state, self._wrench = -_MOTION_DELAY, np.zeros((2, 6)), np.zeros(6)

    @property
    def limits(self) -> DeviceLimits:
        """Travel and output limits of the device."""
        return self.parameters.limits

    @property
    def wrench(self) -> np.ndarray:
        """Wrench (6,) that is currently applied to the handle [N], [N m]."""
        return self._wrench

    def read(self) -> HandlePose:
        """Advance the simulation by one period and return the handle's pose."""
        wanted = self._amplitude * np.sin(self._omega * max(0.0, self._time))
        _integrate_handle(self._parameter_array, wanted, self._wrench, self._period, self._state)
        x = self._state[0]
        angle = float(np.sqrt(x[3:] @ x[3:]))
        quaternion = np.array([np.cos(0.5 * angle), 0.0, 0.0, 0.0])
        quaternion[1:] = x[3:] * (np.sin(0.5 * angle) / angle if angle > 0.0 else 0.5)
        return HandlePose(x[:3].copy(), quaternion, 0)

    def write(self, wrench: np.ndarray, is_active: bool) -> None:
        """Set the wrench (6,) [N], [N m] on the handle and advance the operator's time by a period.

        The operator's arm starts its reference motion after 1 s of calls with `is_active` true. A
        call with `is_active` false holds the arm's reference at the centre and restarts this delay.
        """
        self._wrench[:] = wrench
        self._time = self._time + self._period if is_active else -_MOTION_DELAY

    def close(self) -> None:
        """Switch the force off."""
        self._wrench[:] = 0.0


@compiled
def _integrate_handle(parameters, reference, wrench, period, state):
    """Integrate the motion of handle and operator's arm over one period by semi-implicit Euler.

    The six axes are independent. A stiff, damped stop limits the travel of each axis.

    The rows of `parameters` (6, 6) are mass and friction of the handle, mass, damping and stiffness
    of the arm, and half range. `reference` (6,) is the arm's reference pose, `wrench` (6,) the
    device's output. `state` (2, 6) holds positions and rates and is updated.
    """
    mass, friction, hand_mass, hand_damping, hand_stiffness, stop = parameters
    step = period / _SUBSTEPS
    for _ in range(_SUBSTEPS):
        for i in range(6):
            x, v = state[0, i], state[1, i]
            force = wrench[i] - friction[i] * v
            force += hand_stiffness[i] * (reference[i] - x) - hand_damping[i] * v
            own = mass[i] + hand_mass[i]
            beyond = abs(x) - stop[i]
            if beyond > 0.0:  # stop: time scale of 6 ms, damped against rebound
                quick = 2.0 * np.pi / 6e-3
                force -= own * (quick * quick * (beyond if x > 0.0 else -beyond) + quick * v)
            v += step * force / own
            state[1, i] = v
            state[0, i] = x + step * v


_FORCE_DIMENSION_OPTION = "--kind force-dimension"
_DHD_TO_DEVICE_AXES = np.diag([-1.0, -1.0, 1.0])  # rotation by 180 degrees about z
# Limits by a part of the device's DHD name: travel [m], rotation [rad], force [N], torque [N m].
# Forces and torques of omega.7 and sigma.7 are those of their CHAI3D driver, all others are
# assumed. None was checked against the vendor's data sheets.
_DHD_LIMITS = {
    "omega.3": DeviceLimits(0.055, 0.0, 12.0, 0.0),
    "omega.6": DeviceLimits(0.055, 0.0, 12.0, 0.0),  # its wrist has no torque output
    "omega.7": DeviceLimits(0.055, 0.0, 12.0, 0.0),
    "delta.3": DeviceLimits(0.13, 0.0, 20.0, 0.0),
    "sigma.7": DeviceLimits(0.065, 0.6, 12.0, 0.2),
    "lambda.7": DeviceLimits(0.085, 0.6, 20.0, 0.4),
}
_DHD_DEFAULT_LIMITS = DeviceLimits(0.05, 0.0, 8.0, 0.0)  # for a device that is not listed


class ForceDimension:
    """Driver of the first connected Force Dimension device."""

    def __init__(self, dhd: Any = None) -> None:
        """Open the device and switch on its gravity compensation and forces.

        Args:
            dhd: module `dhd` of the binding; imported by default.

        Raises:
            InputError: the package or the SDK is missing, or no device is connected.
        """
        self._dhd = dhd = dhd or _import_dhd()
        if dhd.open() < 0:
            why = dhd.errorGetLastStr()
            raise InputError(_FORCE_DIMENSION_OPTION, f"cannot open a device ({why}): connect it, switch it on")
        name = str(dhd.getSystemName() or "").lower()
        known = [a for key, a in _DHD_LIMITS.items() if key in name]
        self.limits = known[0] if known else _DHD_DEFAULT_LIMITS
        dhd.setGravityCompensation(True)
        dhd.enableForce(True)
        self._place, self._rotation = [0.0] * 3, [[0.0] * 3 for _ in range(3)]

    def read(self) -> HandlePose:
        """Read the current pose of the handle.

        Raises:
            OSError: the device does not answer.
        """
        # 0 or a positive code is success (positive: no new data), -1 is failure
        if self._dhd.getPositionAndOrientationFrame(self._place, self._rotation) < 0:
            raise OSError(self._dhd.errorGetLastStr())
        turn = _DHD_TO_DEVICE_AXES @ np.array(self._rotation) @ _DHD_TO_DEVICE_AXES.T
        buttons = int(self._dhd.getButtonMask())
        return HandlePose(_DHD_TO_DEVICE_AXES @ np.array(self._place), _matrix_to_quaternion(turn), buttons)

    def write(self, wrench: np.ndarray, is_active: bool) -> None:
        """Apply a wrench (6,) [N], [N m] in the axes of `HandlePose` to the handle.

        `is_active` is not used.

        Raises:
            OSError: the device does not answer.
        """
        force, torque = _DHD_TO_DEVICE_AXES.T @ wrench[:3], _DHD_TO_DEVICE_AXES.T @ wrench[3:]
        if self._dhd.setForceAndTorque(force.tolist(), torque.tolist()) < 0:
            raise OSError(self._dhd.errorGetLastStr())

    def close(self) -> None:
        """Switch the force off and close the device."""
        self._dhd.enableForce(False)
        self._dhd.close()


def _import_dhd() -> Any:
    """Import and return the Python binding of Force Dimension's DHD library.

    Raise InputError if it is not installed.
    """
    try:
        from forcedimension_core import dhd  # pyright: ignore[reportMissingImports] - optional
    except ImportError as error:
        message = (
            "needs the Force Dimension SDK and its Python package: install the SDK, set FDSDK to"
            f" its folder, then run pip install forcedimension-core ({error})"
        )
        raise InputError(_FORCE_DIMENSION_OPTION, message) from None
    return dhd


def _matrix_to_quaternion(turn: np.ndarray) -> np.ndarray:
    """Convert a rotation matrix to a quaternion (4,), scalar first."""
    import mujoco

    out = np.empty(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(turn).ravel())
    return out


_HAPTION_OPTION = "--kind haption"
LIBRARY_VARIABLE = "VIRTUOSE_API"  # environment variable with the path of the library
DEFAULT_HAPTION_ADDRESS = "127.0.0.1#53210"  # address of the vendor's service on the same computer
_IMPEDANCE, _NO_INDEXING = 3, 2  # COMMAND_TYPE_IMPEDANCE, INDEXING_NONE
_BUTTON_NUMBERS = (1, 2)
_VIRTUOSE_AXIS_SIGNS = np.array([-1.0, -1.0, 1.0])  # rotation by 180 degrees about z
# CHAI3D's driver has 30 N, 3 N m and 0.45 m for a Virtuose 6D. A third of each is assumed for
# continuous use. Neither this nor the rotation was checked against a data sheet.
_VIRTUOSE_LIMITS = DeviceLimits(half_travel=0.15, max_rotation=0.6, max_force=10.0, max_torque=1.0)
_VIRTUOSE_SIGNATURES = {
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
    """Driver of a Haption device (Virtuose) at a network address."""

    limits = _VIRTUOSE_LIMITS

    def __init__(self, period: float, address: str = DEFAULT_HAPTION_ADDRESS, library: Any = None) -> None:
        """Open the device, switch on its forces, and take the present handle pose as centre.

        Args:
            period: period of the server [s], which the device uses as its time step.
            address: address of the vendor's service or of the device, `HOST#PORT`.
            library: the vendor's library; by default the one that the environment variable
                VIRTUOSE_API names, or else an installed one.

        Raises:
            InputError: the library is missing, no device answers at the address, or the device
                rejects its settings.
        """
        self._api = api = _declare_signatures(library or _load_virtuose_library())
        self._device = api.virtOpen(address.encode())
        if not self._device:
            message = f"no device answers at {address} ({self._error_message(None)}): start its service"
            raise InputError(_HAPTION_OPTION, f"{message}, or give its address: --kind haption:HOST#PORT")
        self._pose_buffer, self._wrench_buffer = (ctypes.c_float * 7)(), (ctypes.c_float * 6)()
        self._pressed = ctypes.c_int()
        frame = (ctypes.c_float * 7)(0, 0, 0, 0, 0, 0, 1)
        try:
            for name, value in (
                ("IndexingMode", _NO_INDEXING), ("ForceFactor", 1.0), ("SpeedFactor", 1.0),
                ("TimeStep", period), ("BaseFrame", frame), ("ObservationFrame", frame),
                ("CommandType", _IMPEDANCE), ("PowerOn", 1),
            ):  # fmt: skip
                self._check_return_code(getattr(api, f"virtSet{name}")(self._device, value))
            self._centre, self._inverse_start_rotation = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
            begun = self.read()
        except OSError as error:
            api.virtClose(self._device)
            raise InputError(_HAPTION_OPTION, f"the device rejects its settings ({error})") from None
        self._centre, self._inverse_start_rotation = (
            begun.place,
            begun.quaternion * [1.0, -1.0, -1.0, -1.0],
        )

    def read(self) -> HandlePose:
        """Read the current pose of the handle, relative to its pose when the device was opened.

        Raises:
            OSError: the device does not answer.
        """
        api, device = self._api, self._device
        self._check_return_code(api.virtGetPosition(device, self._pose_buffer))
        seven, buttons = np.array(self._pose_buffer), 0
        for bit, number in enumerate(_BUTTON_NUMBERS):
            self._check_return_code(api.virtGetButton(device, number, ctypes.byref(self._pressed)))
            buttons |= (self._pressed.value != 0) << bit
        x, y, z, w = seven[3:]  # the vendor's order: scalar last
        turn = np.array([w, *(_VIRTUOSE_AXIS_SIGNS * (x, y, z))])
        return HandlePose(
            _VIRTUOSE_AXIS_SIGNS * seven[:3] - self._centre,
            _multiply_quaternions(turn, self._inverse_start_rotation),
            buttons,
        )

    def write(self, wrench: np.ndarray, is_active: bool) -> None:
        """Apply a wrench (6,) [N], [N m] in the axes of `HandlePose` to the handle.

        `is_active` is not used.

        Raises:
            OSError: the device does not answer.
        """
        self._wrench_buffer[:3], self._wrench_buffer[3:] = (
            _VIRTUOSE_AXIS_SIGNS * wrench[:3],
            _VIRTUOSE_AXIS_SIGNS * wrench[3:],
        )
        self._check_return_code(self._api.virtSetForce(self._device, self._wrench_buffer))

    def close(self) -> None:
        """Apply a zero wrench, switch off the device's power and close it."""
        self._wrench_buffer[:] = [0.0] * 6
        self._api.virtSetForce(self._device, self._wrench_buffer)
        self._api.virtSetPowerOn(self._device, 0)
        self._api.virtClose(self._device)

    def _check_return_code(self, code: int) -> None:
        if code != 0:
            raise OSError(self._error_message(self._device))

    def _error_message(self, device: int | None) -> str:
        message = self._api.virtGetErrorMessage(self._api.virtGetErrorCode(device))
        return message.decode(errors="replace") if message else "no reason given"


def _load_virtuose_library() -> Any:
    """Load and return Haption's library VirtuoseAPI.

    The path is that of the environment variable VIRTUOSE_API, or else of an installed library.
    Raise InputError if the library is missing or cannot be loaded.
    """
    name = os.environ.get(LIBRARY_VARIABLE) or ctypes.util.find_library("VirtuoseAPI")
    if not name:
        message = f"needs the vendor's libVirtuoseAPI: install it, or set {LIBRARY_VARIABLE} to its path"
        raise InputError(_HAPTION_OPTION, message)
    try:
        return ctypes.CDLL(name)
    except OSError as error:
        raise InputError(_HAPTION_OPTION, f"cannot load the vendor's library ({error})") from None


def _declare_signatures(library: Any) -> Any:
    """Declare the argument and return types of the VirtuoseAPI functions; return the library.

    Raise InputError if the library does not have one of these functions.
    """
    for name, arguments in _VIRTUOSE_SIGNATURES.items():
        try:
            function = getattr(library, name)
        except AttributeError:
            raise InputError(_HAPTION_OPTION, f"the library has no {name}: is it VirtuoseAPI?") from None
        function.argtypes = list(arguments)
        function.restype = {
            "virtOpen": ctypes.c_void_p,
            "virtGetErrorMessage": ctypes.c_char_p,
        }.get(name, ctypes.c_int)
    return library


def _multiply_quaternions(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the product `a b` of two quaternions (4,), scalar first: rotate by b, then by a."""
    import mujoco

    out = np.empty(4)
    mujoco.mju_mulQuat(out, np.asarray(a, float), np.asarray(b, float))
    return out
