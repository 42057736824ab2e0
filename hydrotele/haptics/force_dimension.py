"""Force Dimension devices (omega, delta, sigma, lambda) through the DHD library.

The Python package `forcedimension-core` binds the vendor's SDK, which the vendor gives to owners of
a device; neither is needed unless such a device is asked for. Not tried with hardware here: the
adapter is tested against a stand-in of the package that records the calls.

Device axes: x towards the user, y to the right, z up.
"""

from typing import Any

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.haptics.device import Abilities, HandlePose

_WHERE = "--kind force-dimension"
_FROM_DEVICE = np.diag([-1.0, -1.0, 1.0])  # half a turn about z
# DHD's name of a device contains: travel [m], rotation [rad], force [N], torque [N m]. Forces and
# torques of omega.7 and sigma.7 are those in CHAI3D's driver for them, the rest are assumptions;
# none was checked against the vendor's data sheets.
_KNOWN = {
    "omega.3": Abilities(0.055, 0.0, 12.0, 0.0),
    "omega.6": Abilities(0.055, 0.0, 12.0, 0.0),  # its wrist gives no torque
    "omega.7": Abilities(0.055, 0.0, 12.0, 0.0),
    "delta.3": Abilities(0.13, 0.0, 20.0, 0.0),
    "sigma.7": Abilities(0.065, 0.6, 12.0, 0.2),
    "lambda.7": Abilities(0.085, 0.6, 20.0, 0.4),
}
_LEAST = Abilities(0.05, 0.0, 8.0, 0.0)  # of a device that is none of these


class ForceDimension:
    """The first Force Dimension device that is connected."""

    def __init__(self, dhd: Any = None) -> None:
        """Open it, with its gravity compensation and forces on.

        Args:
            dhd: the binding's module `dhd`; imported by default.

        Raises:
            InputError: package or SDK are missing, or no device is connected.
        """
        self._dhd = dhd = dhd or _library()
        if dhd.open() < 0:
            why = dhd.errorGetLastStr()
            raise InputError(_WHERE, f"no device can be opened ({why}): connect it, switch it on")
        name = str(dhd.getSystemName() or "").lower()
        known = [a for key, a in _KNOWN.items() if key in name]
        self.abilities = known[0] if known else _LEAST
        dhd.setGravityCompensation(True)
        dhd.enableForce(True)
        self._place, self._turn = [0.0] * 3, [[0.0] * 3 for _ in range(3)]

    def read(self) -> HandlePose:
        """Where the handle is now.

        Raises:
            OSError: the device does not answer.
        """
        # 0 or a positive code is success (the device tells that nothing is new), -1 is failure
        if self._dhd.getPositionAndOrientationFrame(self._place, self._turn) < 0:
            raise OSError(self._dhd.errorGetLastStr())
        turn = _FROM_DEVICE @ np.array(self._turn) @ _FROM_DEVICE.T
        buttons = int(self._dhd.getButtonMask())
        return HandlePose(_FROM_DEVICE @ np.array(self._place), _quaternion(turn), buttons)

    def write(self, wrench: np.ndarray, on: bool) -> None:
        """Put a wrench on the handle.

        Raises:
            OSError: the device does not answer.
        """
        force, torque = _FROM_DEVICE.T @ wrench[:3], _FROM_DEVICE.T @ wrench[3:]
        if self._dhd.setForceAndTorque(force.tolist(), torque.tolist()) < 0:
            raise OSError(self._dhd.errorGetLastStr())

    def close(self) -> None:
        """Take the force off and let go of it."""
        self._dhd.enableForce(False)
        self._dhd.close()


def _library() -> Any:
    """The module `dhd` of the binding."""
    try:
        from forcedimension_core import dhd  # pyright: ignore[reportMissingImports] - optional
    except ImportError as error:
        message = (
            "needs the Force Dimension SDK and its Python package: install the SDK, set FDSDK to"
            f" its folder, then pip install forcedimension-core ({error})"
        )
        raise InputError(_WHERE, message) from None
    return dhd


def _quaternion(turn: np.ndarray) -> np.ndarray:
    """(4,), scalar first, of a rotation matrix."""
    import mujoco

    out = np.empty(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(turn).ravel())
    return out
