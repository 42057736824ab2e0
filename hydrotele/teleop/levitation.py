"""A joystick that stands alone, simulated: sensing, control and flotor in one loop.

The flotor hovers, steps and wobbles without a hand; tests, the study and identification look at it
through what is sensed and which currents flow.
"""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from hydrotele.machine.joystick import Joystick
from hydrotele.simulate.joystick import Flotor
from hydrotele.teleop.compliance import turn_matrix
from hydrotele.teleop.levitate import (
    FROZEN,
    Levitation,
    coils_from_handle,
    levitation,
    levitation_step,
    nothing_remembered,
)
from hydrotele.teleop.optics import diode_readings, pose_of_readings

Reading = tuple[np.ndarray, np.ndarray]
_FINE = 2  # times the physics steps of a run; with Runge and Kutta they make no error to be seen
_TONES = 6


@dataclass(frozen=True)
class Flight:
    """What happened, one row per control period.

    Attributes:
        time: (n,) [s].
        pose: (n, 6) true displacement of the handle [m] and rotation vector [rad].
        place: (n, 3) sensed place of the coils' frame, from the handle's centre [m].
        quaternion: (n, 4) sensed orientation, scalar first.
        currents: (n, 6) from this reading until the next [A].
        limited: (n,) whether currents had to be made smaller.
        blind: (n,) whether the coils were off for want of a reading.
        warnings: of MuJoCo, all kinds together.
    """

    time: np.ndarray
    pose: np.ndarray
    place: np.ndarray
    quaternion: np.ndarray
    currents: np.ndarray
    limited: np.ndarray
    blind: np.ndarray
    warnings: int


class Eye:
    """Reads the flotor's pose as its sensors do.

    The simple reading rounds handle place and rotation vector to the stated resolution, as
    `teleop.master` does; through the diodes the three beams are followed instead.
    """

    def __init__(self, joystick: Joystick, *, noise: float, diodes: bool, seed: int) -> None:
        """Open it.

        Args:
            joystick: the joystick.
            noise: largest error before rounding, in steps of the resolution.
            diodes: whether to follow the beams.
            seed: of the noise.
        """
        self._noise, self._rng = noise, np.random.default_rng(seed)
        self._handle = np.array(joystick.flotor.handle)
        self._distance = joystick.diodes.distance if diodes else 0.0
        fine = joystick.sensing
        self._step = np.array([fine.translation] * 3 + [fine.rotation] * 3)
        if diodes:
            self._step = np.full(6, joystick.diodes.step)

    def read(self, qpos: np.ndarray) -> Reading:
        """Place of the coils' frame, from the handle's centre (3,) [m], and its quaternion (4,)."""
        if self._distance:
            turn = np.empty((3, 3))
            turn_matrix(qpos[3:7], turn)
            shift = qpos[:3] - turn @ self._handle + self._handle
            found, turned = pose_of_readings(
                self._rounded(diode_readings(shift, turn, self._distance)), self._distance
            )
            quaternion = np.empty(4)
            mujoco.mju_mat2Quat(quaternion, turned.ravel())
            return found - self._handle, quaternion
        pose = self._rounded(np.concatenate([qpos[:3], rotation_vector(qpos[3:7])]))
        quaternion = quaternion_of(pose[3:])
        return coils_from_handle(self._handle, pose[:3], quaternion), quaternion

    def _rounded(self, values: np.ndarray) -> np.ndarray:
        values = values + self._noise * self._step * self._rng.uniform(-1.0, 1.0, 6)
        fine = self._step > 0.0
        values[fine] = np.rint(values[fine] / self._step[fine]) * self._step[fine]
        return values


def fly(
    joystick: Joystick, target: np.ndarray, *, control: Levitation | None = None,
    start: np.ndarray | None = None, noise: float = 1.0, diodes: bool = False, seed: int = 0,
    cab: tuple[np.ndarray, np.ndarray] | None = None, push: np.ndarray | None = None,
    spoil: Callable[[int, Reading], Reading] | None = None,
) -> Flight:  # fmt: skip
    """Levitate the flotor along a path.

    Args:
        joystick: the joystick.
        target: (n, 6) where the handle should be [m], rotation vector [rad], per control period.
        control: the control; the joystick's own by default.
        start: (6,) pose at rest [m], [rad]; the centre by default.
        noise: largest error of a reading before rounding, in steps of the resolution.
        diodes: whether the pose is sensed by the three diodes, rather than rounded.
        seed: of the noise.
        cab: (n,) turning [rad/s] and (n,) its rate [rad/s^2] of the cab that it stands in.
        push: (n, 6) forces [N] and torques [N m] on the handle.
        spoil: what a fault makes of the reading of a period.

    Returns:
        What happened.
    """
    control = control or levitation(joystick, frozen=FROZEN if noise > 0.0 else np.inf)
    flotor = Flotor(joystick, hand=False, period=control.period, fine=_FINE)
    flotor.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    eye = Eye(joystick, noise=noise, diodes=diodes, seed=seed)
    flotor.place(np.zeros(6) if start is None else start)
    n, memory, mount = len(target), nothing_remembered(), np.array(joystick.mount)
    push = np.zeros((n, 6)) if push is None else push
    pose, place, quaternion = np.empty((n, 6)), np.empty((n, 3)), np.empty((n, 4))
    currents, limited, blind = np.empty((n, 6)), np.empty(n, bool), np.empty(n, bool)
    for k, goal in enumerate(target):
        qpos = flotor.data.qpos
        pose[k, :3], pose[k, 3:] = qpos[:3], rotation_vector(qpos[3:7])
        seen = eye.read(qpos)
        place[k], quaternion[k] = spoil(k, seen) if spoil else seen
        memory, (currents[k], limited[k], blind[k]) = levitation_step(
            control, memory, place[k].copy(), quaternion[k].copy(), goal[:3],
            quaternion_of(goal[3:]),
        )  # fmt: skip
        if cab:
            flotor.shaken_step(currents[k], push[k], mount, float(cab[0][k]), float(cab[1][k]))
        else:
            flotor.step(currents[k], push[k])
    time = control.period * np.arange(n)
    warnings = int(np.sum(flotor.data.warning.number))
    return Flight(time, pose, place, quaternion, currents, limited, blind, warnings)


def wobble(joystick: Joystick, seconds: float, seed: int = 0, share: float = 0.5) -> np.ndarray:
    """A path that tells the flotor's numbers: every axis in its own tones between 0.4 and 6 Hz.

    Args:
        joystick: the joystick.
        seconds: how long [s].
        seed: of the phases.
        share: of the workspace that the targets may use [1].

    Returns:
        (n, 6) targets for `fly` [m], [rad].
    """
    rng, time = np.random.default_rng(seed), np.arange(0.0, seconds, 1.0 / joystick.control_rate)
    tones = 0.4 * 15.0 ** ((np.arange(6 * _TONES) + 0.5) / (6 * _TONES))  # no tone twice
    path = np.empty((len(time), 6))
    for axis in range(6):
        angles = 2.0 * np.pi * np.outer(time, tones[axis::6]) + rng.uniform(0, 2 * np.pi, _TONES)
        path[:, axis] = np.sin(angles).sum(axis=1)
    path *= np.clip(time, 0.0, 1.0)[:, None]  # rises from rest in a second
    for rows, far in ((slice(0, 3), joystick.workspace.translation),
                      (slice(3, 6), joystick.workspace.rotation)):  # fmt: skip
        path[:, rows] *= share * far / np.linalg.norm(path[:, rows], axis=1).max()
    return path


def designed_step(time: np.ndarray, frequency: float, ratio: float) -> np.ndarray:
    """Unit step response of an underdamped second-order system.

    Args:
        time: (n,) [s].
        frequency: natural [rad/s].
        ratio: of damping, below 1.

    Returns:
        (n,) from 0 to 1.

    >>> import numpy as np
    >>> designed_step(np.array([0.0, 10.0]), 25.0, 0.8).round(6).tolist()
    [0.0, 1.0]
    """
    damped = frequency * np.sqrt(1.0 - ratio**2)
    wave = np.cos(damped * time) + ratio * frequency / damped * np.sin(damped * time)
    return 1.0 - np.exp(-ratio * frequency * time) * wave


def rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) [rad] of a quaternion (4,), scalar first."""
    out = np.zeros(3)
    mujoco.mju_quat2Vel(out, quaternion, 1.0)
    return out


def quaternion_of(vector: np.ndarray) -> np.ndarray:
    """Quaternion (4,), scalar first, of a rotation vector (3,) [rad]."""
    angle = float(np.linalg.norm(vector))
    out = np.zeros(4)
    mujoco.mju_axisAngle2Quat(out, vector / angle if angle > 0.0 else np.array([0, 0, 1.0]), angle)
    return out
