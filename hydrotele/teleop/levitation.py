"""Simulation of a stand-alone levitated joystick: sensing, control and flotor in one loop.

The flotor is the moving part with handle and coils. It hovers, follows steps and excitation paths
without a hand. Tests and identification use the sensed poses and the coil currents.

The control converts a sensed pose to coil currents once per period. Every axis is a designed
second-order system about a remote centre of compliance at the handle. With a hand on the handle,
`teleop.master` applies springs at the handle instead.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.machine.joystick import Joystick
from hydrotele.simulate.joystick import SimulatedFlotor
from hydrotele.teleop.coils import Coils, make_three_station_coils
from hydrotele.teleop.compliance import (
    AxisDynamics,
    Flotor,
    FlotorMotion,
    compliance_wrench,
    quaternion_to_matrix,
    relative_quaternion,
)
from hydrotele.teleop.optical_sensing import diode_readings, solve_flotor_pose

MAX_FROZEN_TIME = 0.1  # s: a reading with noise is never constant for twenty periods
_ZERO_CURRENTS = np.zeros(6)


@dataclass(frozen=True)
class LevitationControl:
    """Parameters of the controller that levitates the flotor.

    Attributes:
        flotor_model: model of the flotor in the control, in the coils' frame.
        axes: designed second-order responses of the six axes.
        coils: the coils.
        handle: (3,) centre of compliance in the coils' frame [m].
        period: control period [s].
        max_frozen_time: maximum time for which a reading may be exactly constant [s].
    """

    flotor_model: Flotor
    axes: AxisDynamics
    coils: Coils
    handle: np.ndarray
    period: float
    max_frozen_time: float = MAX_FROZEN_TIME


class ControllerState(NamedTuple):
    """State that the levitation controller keeps from one period to the next.

    Attributes:
        place: (3,) last measured position of the coils' frame [m]; NaN if there was none.
        quaternion: (4,) last measured orientation, scalar first.
        unchanged_time: time for which the reading has not changed [s].
    """

    place: np.ndarray
    quaternion: np.ndarray
    unchanged_time: float


class CoilOutput(NamedTuple):
    """Output of the levitation controller in one period.

    Attributes:
        currents: (6,) coil currents [A].
        is_limited: whether the currents were scaled down, or are off.
        is_blind: whether the coils are off because the reading is not finite or is frozen.
    """

    currents: np.ndarray
    is_limited: bool
    is_blind: bool


def make_levitation_control(
    joystick: Joystick, body: Flotor | None = None, max_frozen_time: float = MAX_FROZEN_TIME
) -> LevitationControl:
    """Build the parameters of the levitation controller from a joystick's file.

    Args:
        joystick: the joystick.
        body: model of the flotor that the control uses; by default the flotor of the joystick's
            file, which the simulation uses as well.
        max_frozen_time: maximum time for which a reading may be exactly constant [s].

    Returns:
        Parameters of the control.

    Raises:
        InputError: the parameters are not physical.
    """
    f, c, alone = joystick.flotor, joystick.coils, joystick.closed_loop
    own = Flotor(f.mass, np.array(f.com), np.diag(f.inertia))
    return LevitationControl(
        flotor_model=body or own,
        axes=AxisDynamics(np.array(alone.frequency), np.array(alone.ratio)),
        coils=make_three_station_coils(c.radius, c.force_per_ampere, c.max_current),
        handle=np.array(f.handle),
        period=1.0 / joystick.control_rate,
        max_frozen_time=max_frozen_time,
    )


def initial_controller_state() -> ControllerState:
    """Return the state of the levitation controller before its first reading.

    The pose is NaN, and the time for which the reading has not changed is 0.
    """
    return ControllerState(np.full(3, np.nan), np.full(4, np.nan), 0.0)


def step_levitation(
    control: LevitationControl, before: ControllerState, place: np.ndarray, quaternion: np.ndarray,
    target: np.ndarray, target_rotation: np.ndarray,
) -> tuple[ControllerState, CoilOutput]:  # fmt: skip
    """Run one period of the levitation controller: convert a measured pose to coil currents.

    Velocities are differences of successive poses.

    A reading that is not finite, or is constant for longer than noise permits, switches the coils
    off, so that an unmeasured pose causes no force. The flotor then sinks onto its stops. With
    valid readings it rises again from rest.

    Args:
        control: parameters of the control.
        before: state after the previous period.
        place: (3,) measured position of the coils' frame, from the handle's centre [m].
        quaternion: (4,) measured orientation, scalar first.
        target: (3,) reference position of the handle, from its centre [m].
        target_rotation: (4,) reference orientation of the flotor, scalar first.

    Returns:
        The new state, and the currents.

    Source: Zhu 1994, 5.1.3.
    """
    if not (np.isfinite(place).all() and np.isfinite(quaternion).all()):
        return initial_controller_state(), CoilOutput(_ZERO_CURRENTS, True, True)
    same = np.array_equal(place, before.place) and np.array_equal(quaternion, before.quaternion)
    after = ControllerState(place, quaternion, before.unchanged_time + control.period if same else 0.0)
    if after.unchanged_time > control.max_frozen_time:
        return after, CoilOutput(_ZERO_CURRENTS, True, True)
    velocity, rate = np.zeros(3), np.zeros(3)
    if np.isfinite(before.place).all():
        velocity = (place - before.place) / control.period
        rate = 2.0 * relative_quaternion(before.quaternion, quaternion)[1] / control.period
    motion = FlotorMotion(place, quaternion, velocity, rate)
    wrench = compliance_wrench(control.flotor_model, control.axes, control.handle, motion, target, target_rotation)
    found = control.coils.compute_currents(wrench)
    return after, CoilOutput(found.value, found.is_limited, False)


def coil_frame_position(handle: np.ndarray, place: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return the position (3,) of the coils' frame (its origin) [m], world axes, for a handle pose.

    Args:
        handle: (3,) the handle's point in the coils' frame [m].
        place: (3,) position of the handle, world axes [m].
        quaternion: (4,) orientation of the flotor, scalar first.
    """
    turn = np.empty((3, 3))
    quaternion_to_matrix(quaternion, turn)
    return place - turn @ handle


PoseReading = tuple[np.ndarray, np.ndarray]
_PHYSICS_SUBSTEPS = 2  # factor on the physics steps of a run, with a negligible Runge-Kutta error
_TONES_PER_AXIS = 6


@dataclass(frozen=True)
class LevitationRun:
    """Time histories of a simulated run of the levitated joystick, one row per control period.

    Attributes:
        time: (n,) [s].
        pose: (n, 6) true displacement of the handle [m] and rotation vector [rad].
        place: (n, 3) measured position of the coils' frame, from the handle's centre [m].
        quaternion: (n, 4) measured orientation, scalar first.
        currents: (n, 6) held from this reading until the next [A].
        limited: (n,) whether the currents were scaled down, or off.
        blind: (n,) whether the coils were off because the reading was not finite or was frozen.
        warnings: number of MuJoCo warnings of all kinds.
    """

    time: np.ndarray
    pose: np.ndarray
    place: np.ndarray
    quaternion: np.ndarray
    currents: np.ndarray
    limited: np.ndarray
    blind: np.ndarray
    warnings: int


class PoseSensor:
    """Simulated sensor of the flotor's pose, with resolution and noise.

    By default noise is added to the position of the handle and the rotation vector, and both are
    rounded to the resolution. With diodes, noise and rounding apply to the six readings of the
    three light beams instead, and the pose is computed from the readings.
    """

    def __init__(self, joystick: Joystick, *, noise: float, diodes: bool, seed: int) -> None:
        """Create the sensor.

        Args:
            joystick: the joystick.
            noise: maximum error before rounding, in steps of the resolution.
            diodes: whether to simulate the diodes instead of rounding the pose.
            seed: seed of the noise.
        """
        self._noise, self._rng = noise, np.random.default_rng(seed)
        self._handle = np.array(joystick.flotor.handle)
        self._distance = joystick.diodes.distance if diodes else 0.0
        fine = joystick.sensing
        self._step = np.array([fine.translation] * 3 + [fine.rotation] * 3)
        if diodes:
            self._step = np.full(6, joystick.diodes.step)

    def read(self, qpos: np.ndarray) -> PoseReading:
        """Measure the pose of the coils' frame.

        Args:
            qpos: (7,) true position of the handle [m] and orientation quaternion, scalar first.

        Returns:
            Measured position (3,) of the coils' frame, from the handle's centre [m], and quaternion
            (4,), scalar first.
        """
        if self._distance:
            turn = np.empty((3, 3))
            quaternion_to_matrix(qpos[3:7], turn)
            shift = qpos[:3] - turn @ self._handle + self._handle
            found, turned = solve_flotor_pose(
                self._add_noise_and_round(diode_readings(shift, turn, self._distance)),
                self._distance,
            )
            quaternion = np.empty(4)
            mujoco.mju_mat2Quat(quaternion, turned.ravel())
            return found - self._handle, quaternion
        pose = self._add_noise_and_round(np.concatenate([qpos[:3], quaternion_to_rotation_vector(qpos[3:7])]))
        quaternion = rotation_vector_to_quaternion(pose[3:])
        return coil_frame_position(self._handle, pose[:3], quaternion), quaternion

    def _add_noise_and_round(self, values: np.ndarray) -> np.ndarray:
        values = values + self._noise * self._step * self._rng.uniform(-1.0, 1.0, 6)
        fine = self._step > 0.0
        values[fine] = np.rint(values[fine] / self._step[fine]) * self._step[fine]
        return values


def simulate_levitation(
    joystick: Joystick, target: np.ndarray, *, control: LevitationControl | None = None,
    start: np.ndarray | None = None, noise: float = 1.0, diodes: bool = False, seed: int = 0,
    cab_motion: tuple[np.ndarray, np.ndarray] | None = None, handle_wrench: np.ndarray | None = None,
    sensor_fault: Callable[[int, PoseReading], PoseReading] | None = None,
) -> LevitationRun:  # fmt: skip
    """Simulate a levitated joystick that follows a reference path, with sensing and control.

    Args:
        joystick: the joystick.
        target: (n, 6) reference position of the handle [m] and rotation vector [rad] in every control
            period.
        control: the control; the joystick's own by default.
        start: (6,) initial pose at rest [m], [rad]; the centre by default.
        noise: maximum error of a reading before rounding, in steps of the resolution.
        diodes: whether the three diodes measure the pose, instead of rounding it.
        seed: seed of the noise.
        cab_motion: (n,) angular velocity [rad/s] and (n,) angular acceleration [rad/s^2] of the cab
            about its swing axis; a fixed mount if omitted.
        handle_wrench: (n, 6) forces [N] and torques [N m] on the handle.
        sensor_fault: function of the number of the period and the pose reading, which returns the
            faulty reading.

    Returns:
        Time histories of the run.
    """
    control = control or make_levitation_control(joystick, max_frozen_time=MAX_FROZEN_TIME if noise > 0.0 else np.inf)
    flotor = SimulatedFlotor(
        joystick, hand=False, period=control.period, refinement=_PHYSICS_SUBSTEPS, runge_kutta=True
    )
    eye = PoseSensor(joystick, noise=noise, diodes=diodes, seed=seed)
    flotor.set_pose(np.zeros(6) if start is None else start)
    n, memory, mount = len(target), initial_controller_state(), np.array(joystick.mount)
    handle_wrench = np.zeros((n, 6)) if handle_wrench is None else handle_wrench
    pose, place, quaternion = np.empty((n, 6)), np.empty((n, 3)), np.empty((n, 4))
    currents, limited, blind = np.empty((n, 6)), np.empty(n, bool), np.empty(n, bool)
    for k, goal in enumerate(target):
        qpos = flotor.data.qpos
        pose[k, :3], pose[k, 3:] = qpos[:3], quaternion_to_rotation_vector(qpos[3:7])
        seen = eye.read(qpos)
        place[k], quaternion[k] = sensor_fault(k, seen) if sensor_fault else seen
        memory, (currents[k], limited[k], blind[k]) = step_levitation(
            control, memory, place[k].copy(), quaternion[k].copy(), goal[:3],
            rotation_vector_to_quaternion(goal[3:]),
        )  # fmt: skip
        if cab_motion:
            flotor.step_in_cab(
                currents[k],
                handle_wrench[k],
                mount,
                float(cab_motion[0][k]),
                float(cab_motion[1][k]),
            )
        else:
            flotor.step(currents[k], handle_wrench[k])
    time = control.period * np.arange(n)
    warnings = int(np.sum(flotor.data.warning.number))
    return LevitationRun(time, pose, place, quaternion, currents, limited, blind, warnings)


def make_excitation_path(
    joystick: Joystick, seconds: float, seed: int = 0, workspace_fraction: float = 0.5
) -> np.ndarray:
    """Generate a path that excites all six axes, for the identification of the flotor.

    Every axis is a sum of tones, different for each axis, between 0.4 and 6 Hz.

    Args:
        joystick: the joystick.
        seconds: duration [s].
        seed: seed of the phases.
        workspace_fraction: fraction of the workspace that the targets may use [1].

    Returns:
        (n, 6) targets for `simulate_levitation` [m], [rad].
    """
    rng, time = np.random.default_rng(seed), np.arange(0.0, seconds, 1.0 / joystick.control_rate)
    tones = 0.4 * 15.0 ** ((np.arange(6 * _TONES_PER_AXIS) + 0.5) / (6 * _TONES_PER_AXIS))  # all tones differ
    path = np.empty((len(time), 6))
    for axis in range(6):
        angles = 2.0 * np.pi * np.outer(time, tones[axis::6]) + rng.uniform(0, 2 * np.pi, _TONES_PER_AXIS)
        path[:, axis] = np.sin(angles).sum(axis=1)
    path *= np.clip(time, 0.0, 1.0)[:, None]  # starts from rest within 1 s
    for rows, far in ((slice(0, 3), min(joystick.handle_travel[:3])),
                      (slice(3, 6), min(joystick.handle_travel[3:]))):  # fmt: skip
        path[:, rows] *= workspace_fraction * far / np.linalg.norm(path[:, rows], axis=1).max()
    return path


def second_order_step_response(time: np.ndarray, frequency: float, ratio: float) -> np.ndarray:
    """Return the unit step response of an underdamped second-order system.

    Args:
        time: (n,) [s].
        frequency: natural frequency [rad/s].
        ratio: damping ratio, below 1.

    Returns:
        (n,) response, which rises from 0 and settles at 1.

    >>> import numpy as np
    >>> second_order_step_response(np.array([0.0, 10.0]), 25.0, 0.8).round(6).tolist()
    [0.0, 1.0]
    """
    damped = frequency * np.sqrt(1.0 - ratio**2)
    wave = np.cos(damped * time) + ratio * frequency / damped * np.sin(damped * time)
    return 1.0 - np.exp(-ratio * frequency * time) * wave


def quaternion_to_rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """Convert a quaternion (4,), scalar first, to a rotation vector (3,) [rad]."""
    out = np.zeros(3)
    mujoco.mju_quat2Vel(out, quaternion, 1.0)
    return out


def rotation_vector_to_quaternion(vector: np.ndarray) -> np.ndarray:
    """Convert a rotation vector (3,) [rad] to a quaternion (4,), scalar first."""
    angle = float(np.linalg.norm(vector))
    out = np.zeros(4)
    mujoco.mju_axisAngle2Quat(out, vector / angle if angle > 0.0 else np.array([0, 0, 1.0]), angle)
    return out
