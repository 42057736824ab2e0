"""Controller protocol, zero and random controllers, and the joint servo for valve actions.

`find_observation_columns` finds the observation columns of named fields. `ValveServo` computes valve commands at the
environment rate with the joint servo of `control.servo`: velocity feedforward through the flow gain
at the measured pressures, dead-band compensation, position feedback and dynamic pressure feedback.
Its integral term compensates leakage and deviations of dead band and flow gain from those of
the machine without effects.
"""

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from hydrotele.control.servo import (
    ComputedForce,
    DriveReference,
    MeasuredState,
    interpolate_drive_reference,
    servo_parameters,
    servo_step,
    tabulate_drive_geometry,
)
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.envs.task_setup import TaskSetup
from hydrotele.kinematics.task_space import compute_tip_pose, solve_joint_angles
from hydrotele.scenario.scenario import Servo


class Controller(Protocol):
    """Interface of a controller, which computes actions from observations for n parallel episodes.

    Examples:
        A proportional controller of axis rates for `TrackTrajectory`:

        >>> import gymnasium
        >>> import hydrotele.envs
        >>> class RateController:
        ...     def __init__(self, setup):
        ...         names = [field.name for field in setup.fields]
        ...         axes = ("swing", "boom", "stick")
        ...         self.measured = [names.index(f"angle.{axis}") for axis in axes]
        ...         self.reference = [names.index(f"reference.{axis}") for axis in axes]
        ...
        ...     def begin(self, count):
        ...         pass  # it keeps no state
        ...
        ...     def reset(self, mask):
        ...         pass
        ...
        ...     def __call__(self, observation):
        ...         return 5.0 * (observation[:, self.reference] - observation[:, self.measured])
        >>> env = gymnasium.make("hydrotele/TrackTrajectory-v0", variants=1, duration=4.0, action="joint_rate")
        >>> controller = RateController(env.unwrapped.core.setup)
        >>> controller.begin(1)
        >>> (observation, info), over = env.reset(seed=1), False
        >>> while not over:
        ...     observation, reward, _, over, info = env.step(controller(observation[None])[0])
        >>> bool(info["tip_error"] < 0.5)  # m
        True
    """

    def begin(self, count: int) -> None:
        """Allocate and initialise the controller state for `count` parallel episodes."""
        ...

    def reset(self, mask: np.ndarray) -> None:
        """Reset the controller state of some episodes, because they are over and new ones start.

        Args:
            mask: (n,) bool, True for the episodes to reset.
        """
        ...

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions of this step.

        Args:
            observation: (n, o) observations of the n episodes.

        Returns:
            (n, a), in the range +-1.
        """
        ...


class ZeroController:
    """Controller that returns zero actions: closed valves, or zero rates."""

    def __init__(self, setup: TaskSetup) -> None:
        """Store the number of actions."""
        self._actions = len(setup.axes)

    def begin(self, count: int) -> None:
        """Do nothing: the controller has no state."""

    def reset(self, mask: np.ndarray) -> None:
        """Do nothing: the controller has no state."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return zeros (n, a) for observations (n, o)."""
        return np.zeros((len(observation), self._actions), np.float32)


class RandomController:
    """Controller that returns independent uniform random actions in every step."""

    def __init__(self, setup: TaskSetup, seed: int = 0) -> None:
        """Store the number of actions and the seed."""
        self._actions, self._seed = len(setup.axes), seed

    def begin(self, count: int) -> None:
        """Create the random generator from the stored seed; `count` is not used."""
        self._rng = np.random.default_rng(self._seed)

    def reset(self, mask: np.ndarray) -> None:
        """Do nothing: the random stream continues."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return random actions (n, a) from -1 to 1 for observations (n, o)."""
        return self._rng.uniform(-1.0, 1.0, (len(observation), self._actions))


def environment_step_time(setup: TaskSetup) -> float:
    """Return the time between environment steps [s]."""
    return setup.clock.ticks * setup.clock.period


def find_observation_columns(setup: TaskSetup, what: str, where: Iterable[str]) -> np.ndarray:
    """Return the columns of the observation that hold the fields named `<what>.<where>`.

    Args:
        setup: the task with its options.
        what: first part of the field names.
        where: second parts, in the order of the columns; `""` for a field name without a dot.

    Returns:
        (m,) integers, for `observation[:, columns]`.

    Raises:
        InputError: the observation has no such field.
    """
    places = {field.name: number for number, field in enumerate(setup.fields)}
    names = [f"{what}.{part}" if part else what for part in where]
    if missing := [name for name in names if name not in places]:
        raise InputError(f"observation {missing[0]!r}", f"the task observes {', '.join(places)}")
    return np.array([places[name] for name in names], int)


def find_position_columns(setup: TaskSetup) -> np.ndarray:
    """Return the observation columns (k,) of the measured positions of the driven axes."""
    return np.concatenate([
        find_observation_columns(setup, setup.machine.position_kind(axis), [axis]) for axis in setup.axes
    ])  # fmt: skip


@compiled
def compute_servo_commands(servo_parameters, grid, table, reference, rate_ahead, measured, load, out):
    """Compute the valve or drive commands of the joint servo for n episodes.

    Args:
        servo_parameters: (k, 15) gains and drive parameters from `control.servo.servo_parameters`.
        grid: (k, 2) lowest joint position and step of `table`.
        table: (k, TABLE_POINTS, 3) moment arms and chamber volumes from
            `control.servo.tabulate_drive_geometry`.
        reference: (n, k) reference positions now [rad] or [m].
        rate_ahead: (n, k) reference rates [rad/s] or [m/s] at a time ahead of now by the lag of the
            valve spool.
        measured: MeasuredState with (n, k) arrays, (n, s) supply pressures.
        load: (n, k) low-pass filtered drive forces, updated [N] or [N m].
        out: (n, k) commands, written [1] or in the drive's unit.

    Returns:
        Nothing.

    Source: `control.servo.servo_step`.
    """
    k = len(servo_parameters)
    closed, none = np.ones(k), np.zeros(k)
    velocity, arm, volume_head, volume_rod = np.empty(k), np.empty(k), np.empty(k), np.empty(k)
    for i in range(len(reference)):
        interpolate_drive_reference(
            grid, table, reference[i], rate_ahead[i], 1.0, velocity, arm, volume_head, volume_rod
        )
        drive = DriveReference(velocity, arm, volume_head, volume_rod)
        computed = ComputedForce(False, none, none)
        now = MeasuredState(
            measured.joint[i], measured.rate[i], measured.head[i], measured.rod[i],
            measured.supply[i],
        )  # fmt: skip
        servo_step(servo_parameters, closed, drive, reference[i], now, load[i], computed, out[i])


@compiled
def compute_tip_poses(arm, q, pose):
    """Compute the tip poses of n episodes from their joint angles.

    Args:
        arm: (9,) dimensions of the arm from `kinematics.task_space.arm_parameters`.
        q: (n, k) joint angles [rad].
        pose: (n, 5) written: r [m], theta [rad], z [m], attitude [rad], head [rad].

    Returns:
        Nothing.

    Source: `kinematics.task_space.compute_tip_pose`.
    """
    for i in range(len(q)):
        compute_tip_pose(arm, q[i], pose[i])


@compiled
def compute_joint_angles(arm, ranges, pose, q):
    """Compute the joint angles of n episodes from tip poses (inverse kinematics).

    If a pose is out of reach or its joint angles are outside `ranges`, the row of `q` is not
    changed.

    Args:
        arm: (9,) dimensions of the arm from `kinematics.task_space.arm_parameters`.
        ranges: (k, 2) joint ranges [rad].
        pose: (n, 5) r [m], theta [rad], z [m], attitude [rad], head [rad].
        q: (n, k) joint angles, updated [rad]; the new swing angle is within half a turn of the
            previous one.

    Returns:
        Nothing.

    Source: `kinematics.task_space.solve_joint_angles`.
    """
    k = q.shape[1]
    found = np.empty(k)
    for i in range(len(q)):
        good = solve_joint_angles(arm, pose[i], q[i, 0], found) == 0
        for j in range(k):
            good = good and ranges[j, 0] <= found[j] <= ranges[j, 1]
        if good:
            q[i] = found


_MAX_INTEGRAL = 0.05  # rad/s or m/s, limit of the integral term


class ValveServo:
    """Joint servo with integral term that converts axis references to actions of kind `valve`.

    The actions command valves, or drives without a valve.
    """

    def __init__(self, setup: TaskSetup, servo: Servo, integral_gain: float = 0.0) -> None:
        """Read the parameters of the servo from `setup.machine`, the machine without added effects.

        The observation columns that the servo uses are found, too.

        Args:
            setup: the task with its options, with `valve` actions.
            servo: gains of the joint servo.
            integral_gain: gain of the integral of the position error [1/s^2]; the result is added
                to the reference rate, with at most 0.05 rad/s or m/s.
        """
        machine, self._dt = setup.machine, environment_step_time(setup)
        self._axes, self._integral_gain = setup.axes, integral_gain
        self._parameters = servo_parameters(machine, setup.axes, servo, self._dt)
        self._grid, self._table = tabulate_drive_geometry(machine, setup.axes)
        valves = [i for i, name in enumerate(setup.axes) if machine.axes[name].is_hydraulic]
        names = [setup.axes[i] for i in valves]
        pumps = machine.supplies or [""]
        self._valves = np.array(valves, int)
        self._joint = find_position_columns(setup)
        self._rate = find_observation_columns(setup, "rate", setup.axes)
        self._head = find_observation_columns(setup, "pressure_head", names)
        self._rod = find_observation_columns(setup, "pressure_rod", names)
        self._supply = find_observation_columns(setup, "pressure_supply", list(pumps) if names else [])

    def begin(self, count: int) -> None:
        """Allocate the controller state for `count` parallel episodes."""
        shape = (count, len(self._axes))
        self._load, self._integral, self._commands = (np.zeros(shape) for _ in range(3))
        self._is_new = np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Mark the episodes of the boolean mask (n,) as new; the next call initialises their controller state."""
        self._is_new |= mask

    def __call__(self, observation: np.ndarray, reference: np.ndarray, rate_ahead: np.ndarray) -> np.ndarray:
        """Return the actions of this step.

        Args:
            observation: (n, o).
            reference: (n, k) reference positions now [rad] or [m].
            rate_ahead: (n, k) reference rates [rad/s] or [m/s] at a time ahead of now by the lag of
                the valve spool.

        Returns:
            (n, k) actions: commands divided by the command limit of each drive.
        """
        seen, joint = observation.astype(float), observation[:, self._joint].astype(float)
        head, rod = np.zeros_like(joint), np.zeros_like(joint)
        head[:, self._valves], rod[:, self._valves] = seen[:, self._head], seen[:, self._rod]
        supply = seen[:, self._supply]
        force = self._parameters[:, 1] * head - self._parameters[:, 2] * rod
        self._load[self._is_new], self._integral[self._is_new] = force[self._is_new], 0.0
        self._commands[self._is_new], self._is_new[:] = 0.0, False
        limit = self._parameters[:, 6]
        free = np.abs(self._commands) < limit  # anti-windup for a saturated drive
        self._integral += self._integral_gain * self._dt * free * (reference - joint)
        np.clip(self._integral, -_MAX_INTEGRAL, _MAX_INTEGRAL, out=self._integral)
        compute_servo_commands(
            self._parameters, self._grid, self._table, np.ascontiguousarray(reference, float),
            np.ascontiguousarray(rate_ahead + self._integral),
            MeasuredState(joint, seen[:, self._rate], head, rod, supply), self._load, self._commands,
        )  # fmt: skip
        return self._commands / limit
