"""What a controller is, the two that know nothing, and how one finds its columns.

Laws of one machine are applied to the rows of a batch. Valve commands that make axes follow
references are those of the joint servo with an integral, at env rate: feedforward of the drive's
velocity through the flow gain at the measured pressures, compensation of the dead band, position
feedback, dynamic pressure feedback (`control.servo`); the integral takes out what the nominal
machine does not know: leakage, other dead bands and flow gains.
"""

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from hydrotele.control.servo import (
    ComputedForce,
    DriveReference,
    Measured,
    drive_row,
    drive_tables,
    servo_parameters,
    servo_step,
)
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.envs.facts import TaskSetup
from hydrotele.kinematics.task import task_forward, task_inverse
from hydrotele.scenario.scenario import Servo


class Controller(Protocol):
    """Actions from observations, for n episodes side by side."""

    def begin(self, count: int) -> None:
        """Make room for `count` episodes and start them."""
        ...

    def reset(self, mask: np.ndarray) -> None:
        """Forget the episodes that are over.

        Args:
            mask: (n,) bool, which ones.
        """
        ...

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions of this step.

        Args:
            observation: (n, o).

        Returns:
            (n, a), full at +-1.
        """
        ...


class Zero:
    """Never acts: valves closed, or no rate."""

    def __init__(self, setup: TaskSetup) -> None:
        """Remember the number of actions."""
        self._actions = len(setup.axes)

    def begin(self, count: int) -> None:
        """Nothing to remember."""

    def reset(self, mask: np.ndarray) -> None:
        """Nothing to forget."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Zeros (n, a) for observations (n, o)."""
        return np.zeros((len(observation), self._actions), np.float32)


class Random:
    """Uniform actions, drawn anew in every step, as an agent that has learned nothing."""

    def __init__(self, setup: TaskSetup, seed: int = 0) -> None:
        """Remember the number of actions."""
        self._actions, self._seed = len(setup.axes), seed

    def begin(self, count: int) -> None:
        """Start the random numbers."""
        self._chance = np.random.default_rng(self._seed)

    def reset(self, mask: np.ndarray) -> None:
        """Random numbers go on."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Numbers (n, a) from -1 to 1 for observations (n, o)."""
        return self._chance.uniform(-1.0, 1.0, (len(observation), self._actions))


def step_time(setup: TaskSetup) -> float:
    """Time from one action to the next [s]."""
    return setup.clock.ticks * setup.clock.period


def columns(setup: TaskSetup, what: str, where: Iterable[str]) -> np.ndarray:
    """Columns of the observation with the fields `what.where`.

    Args:
        setup: the task as it was chosen.
        what: first part of the fields' names.
        where: second parts, in the order of the columns.

    Returns:
        (m,) integers, for `observation[:, columns]`.

    Raises:
        InputError: the observation lacks one of them.
    """
    places = {field.name: number for number, field in enumerate(setup.fields)}
    names = [f"{what}.{part}" if part else what for part in where]
    if missing := [name for name in names if name not in places]:
        raise InputError(f"observation {missing[0]!r}", f"the task has {', '.join(places)}")
    return np.array([places[name] for name in names], int)


def position_columns(setup: TaskSetup) -> np.ndarray:
    """Columns (k,) of the driven axes' measured positions."""
    return np.concatenate([
        columns(setup, setup.machine.position_kind(axis), [axis]) for axis in setup.axes
    ])  # fmt: skip


@compiled
def servo_commands(numbers, grid, table, reference, rate_ahead, measured, load, out):
    """Commands of n episodes by the joint servo.

    Args:
        numbers: (k, 14) of `control.servo.servo_parameters`.
        grid: (k, 2) of `control.servo.drive_tables`.
        table: (k, POINTS, 3) of the same.
        reference: (n, k) [rad] or [m].
        rate_ahead: (n, k) wanted rates, ahead by the spool's lag [rad/s] or [m/s].
        measured: Measured with (n, k) arrays, (n,) supply pressures.
        load: (n, k) slow means of the drive forces, updated [N] or [N m].
        out: (n, k) commands, written [1] or in the drive's unit.

    Returns:
        Nothing.

    Source: `control.servo.servo_step`.
    """
    k = len(numbers)
    closed, none = np.ones(k), np.zeros(k)
    velocity, arm, volume_head, volume_rod = np.empty(k), np.empty(k), np.empty(k), np.empty(k)
    for i in range(len(reference)):
        drive_row(
            grid, table, reference[i], rate_ahead[i], 1.0, velocity, arm, volume_head, volume_rod
        )
        drive = DriveReference(velocity, arm, volume_head, volume_rod)
        computed = ComputedForce(False, none, none)
        now = Measured(
            measured.joint[i], measured.rate[i], measured.head[i], measured.rod[i],
            measured.supply[i],
        )  # fmt: skip
        servo_step(numbers, closed, drive, reference[i], now, load[i], computed, out[i])


@compiled
def forward_poses(arm, q, pose):
    """Poses of the tip of n episodes.

    Args:
        arm: (9,) of `kinematics.task.arm_parameters`.
        q: (n, k) joint angles [rad].
        pose: (n, 5) written: r [m], theta [rad], z [m], attitude [rad], head [rad].

    Returns:
        Nothing.

    Source: `kinematics.task.task_forward`.
    """
    for i in range(len(q)):
        task_forward(arm, q[i], pose[i])


@compiled
def inverse_joints(arm, ranges, pose, q):
    """Joint angles of n episodes for poses of the tip; those out of reach keep their angles.

    Args:
        arm: (9,) of `kinematics.task.arm_parameters`.
        ranges: (k, 2) of the joints [rad].
        pose: (n, 5) r [m], theta [rad], z [m], attitude [rad], head [rad].
        q: (n, k) joint angles, updated [rad].

    Returns:
        Nothing.

    Source: `kinematics.task.task_inverse`.
    """
    k = q.shape[1]
    found = np.empty(k)
    for i in range(len(q)):
        good = task_inverse(arm, pose[i], q[i, 0], found) == 0
        for j in range(k):
            good = good and ranges[j, 0] <= found[j] <= ranges[j, 1]
        if good:
            q[i] = found


_MOST = 0.05  # rad/s or m/s that the integral may ask for


class ValveLaw:
    """Actions of valves (and of drives without any) from references of the axes."""

    def __init__(self, setup: TaskSetup, servo: Servo, integral_gain: float = 0.0) -> None:
        """Look up the nominal machine.

        Args:
            setup: the task as it was chosen, with `valve` actions.
            servo: gains.
            integral_gain: [1/s^2].
        """
        machine, self._dt = setup.machine, step_time(setup)
        self._axes, self._integral_gain = setup.axes, integral_gain
        self._numbers = servo_parameters(machine, setup.axes, servo, self._dt)
        self._grid, self._table = drive_tables(machine, setup.axes)
        valves = [i for i, name in enumerate(setup.axes) if machine.axes[name].hydraulic]
        names = [setup.axes[i] for i in valves]
        self._valves = np.array(valves, int)
        self._joint = position_columns(setup)
        self._rate = columns(setup, "rate", setup.axes)
        self._head = columns(setup, "pressure_head", names)
        self._rod = columns(setup, "pressure_rod", names)
        self._supply = columns(setup, "pressure_supply", [""] if names else [])

    def begin(self, count: int) -> None:
        """Start `count` episodes."""
        shape = (count, len(self._axes))
        self._load, self._integral, self._out = (np.zeros(shape) for _ in range(3))
        self._fresh = np.ones(count, bool)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the episodes of mask (n,)."""
        self._fresh |= mask

    def __call__(
        self, observation: np.ndarray, reference: np.ndarray, rate_ahead: np.ndarray
    ) -> np.ndarray:
        """Actions of this step.

        Args:
            observation: (n, o).
            reference: (n, k) positions asked for now [rad] or [m].
            rate_ahead: (n, k) rates asked for, ahead by the spool's lag [rad/s] or [m/s].

        Returns:
            (n, k).
        """
        seen, joint = observation.astype(float), observation[:, self._joint].astype(float)
        head, rod = np.zeros_like(joint), np.zeros_like(joint)
        head[:, self._valves], rod[:, self._valves] = seen[:, self._head], seen[:, self._rod]
        supply = seen[:, self._supply[0]] if len(self._supply) else np.zeros(len(seen))
        force = self._numbers[:, 1] * head - self._numbers[:, 2] * rod
        self._load[self._fresh], self._integral[self._fresh] = force[self._fresh], 0.0
        self._out[self._fresh], self._fresh[:] = 0.0, False
        limit = self._numbers[:, 6]
        free = np.abs(self._out) < limit  # a drive at its limit winds nothing up
        self._integral += self._integral_gain * self._dt * free * (reference - joint)
        np.clip(self._integral, -_MOST, _MOST, out=self._integral)
        servo_commands(
            self._numbers, self._grid, self._table, np.ascontiguousarray(reference, float),
            np.ascontiguousarray(rate_ahead + self._integral),
            Measured(joint, seen[:, self._rate], head, rod, supply), self._load, self._out,
        )  # fmt: skip
        return self._out / limit
