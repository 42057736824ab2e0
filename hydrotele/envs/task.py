"""What a task is, as facts in Python, and what a user may choose of it.

An arm starts at poses drawn from ranges until one lies well inside the workspace, from which it can
go straight to its goal without asking too much of its drives.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal

import mujoco
import numpy as np

from hydrotele.control.resolved_motion import arm_facts
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.envs.episode import ACTIONS, ARM
from hydrotele.envs.world import Field
from hydrotele.kinematics.task import REACHED, task_forward, task_inverse, task_rates
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo, SurroundingObject

ActionKind = Literal["valve", "joint_rate", "resolved_motion"]
REAL = "real"


@dataclasses.dataclass(frozen=True)
class Task:
    """A control task.

    Attributes:
        name: as in `hydrotele/<Name>-v0`.
        kind: its name in native code, of `kinds.KINDS`.
        sentence: what is asked, one sentence.
        reward: what it pays and when an episode ends, in words.
        machine: name of the machine.
        tool: its tool, None for the machine's first one.
        more_axes: axes that are driven beside those of the arm.
        action: kind of actions where the user names none.
        duration: of an episode [s].
        start: (machine, random generator) -> axis or joint name -> position at the start.
        fields: (machine, driven axes) -> what `observe_<kind>` writes.
        measures: name and unit of every figure in `info`.
        surroundings: (machine, random generator, start) -> what stands around.
        ground: whether there is a hard ground.
        parameters: (machine, MuJoCo model) -> up to PARAMETERS that the task's native code reads.
        terrain: floats that an episode keeps of its ground, 0 without.
        swing_locked: whether the swing's action does nothing.
        writes: fields of the model that its native code writes; a new episode has them anew.
        pose_rates: of the tip at full action: r [m/s], theta [rad/s], z [m/s], attitude, head.
        servo: gains of the joint servo (`joint_rate`, `resolved_motion`).
    """

    name: str
    kind: str
    sentence: str
    reward: str
    machine: str
    tool: str | None
    start: Callable[[Machine, np.random.Generator], dict[str, float]]
    fields: Callable[[Machine, tuple[str, ...]], list[Field]]
    measures: tuple[tuple[str, str], ...]
    more_axes: tuple[str, ...] = ()
    action: ActionKind = "valve"
    duration: float = 20.0
    surroundings: Callable[
        [Machine, np.random.Generator, dict[str, float]], tuple[SurroundingObject, ...]
    ] = lambda *_: ()
    ground: bool = False
    parameters: Callable[[Machine, mujoco.MjModel], Sequence[float] | np.ndarray] | None = None
    terrain: int = 0
    swing_locked: bool = False
    writes: tuple[str, ...] = ()
    pose_rates: tuple[float, ...] = (0.5, 0.3, 0.5, 0.4, 0.25)
    servo: Servo = Servo()


@dataclasses.dataclass(frozen=True)
class Options:
    """What a user chooses; None is the task's own.

    Attributes:
        action: `valve` (commands of valves), `joint_rate` (rates of the axes, followed by the joint
            servo) or `resolved_motion` (rates of the tip, by resolved motion).
        sensors: `ideal`, `real` (the machine's first set of sensors) or the name of a set.
        control_rate: environment steps per second [Hz]; the servo runs at 200 Hz or faster.
        duration: of an episode [s].
        effects: planted in every episode: mappings with `name`, `location`, `parameters`.
        randomise: the same with a range [low, high] for every parameter: drawn for every variant.
        variants: machines and starts that are drawn; every episode has one of them.
        variant_seed: from which they are drawn.
        timestep: of the physics [s].
    """

    action: ActionKind | None = None
    sensors: str = "ideal"
    control_rate: float = 50.0
    duration: float | None = None
    effects: tuple[dict[str, Any], ...] = ()
    randomise: tuple[dict[str, Any], ...] = ()
    variants: int = 64
    variant_seed: int = 0
    timestep: float = 1.0e-3


assert set(ACTIONS) == set(ActionKind.__args__)


_DRAWS = 1000
_ROOM = 0.08  # rad to the ends of the joints' ranges


def draw_start(
    machine: Machine, rng: np.random.Generator, low: tuple[float, ...], high: tuple[float, ...]
) -> dict[str, float]:
    """Positions of an arm's axes for a pose between two.

    Args:
        machine: the machine.
        rng: random generator.
        low: (5,) or, without a head, (4,) least r [m], theta [rad], z [m], attitude, head [rad].
        high: the same, at most.

    Returns:
        Axis -> position [rad].

    Raises:
        InputError: next to none of these poses can be reached.
    """
    numbers, axes, ranges = arm_facts(machine)
    pose, joints = np.zeros(5), np.zeros(len(axes))
    for _ in range(_DRAWS):
        pose[: len(low)] = rng.uniform(low, high)
        if (
            task_inverse(numbers, pose, pose[1], joints) == REACHED
            and ((ranges[:, 0] + _ROOM <= joints) & (joints <= ranges[:, 1] - _ROOM)).all()
        ):
            return dict(zip(axes, joints.tolist(), strict=True))
    raise InputError(f"start of {machine.name}", f"no pose from {low} to {high} can be reached")


_PLACES = 16  # at which a path is looked at
_ROOM_WORKSPACE = 0.03  # rad that stay free to the ends of the joints' ranges


@compiled
def path_effort(f, start, change):
    """Most that a straight path of the pose asks of the drives, for one that takes a second.

    Args:
        f: record of TASK_PARAMETERS.
        start: (ARM,) pose where it begins: r [m], theta [rad], z [m], attitude, head [rad].
        change: (ARM,) from there to its end, the same units.

    Returns:
        Sum of the axes' rates, each as a share of its rate at full action, at the worst place of
        the path, scalar [s]; infinite where it leaves the workspace. Drives share a pump, so that
        it is the sum that counts.

    Source: `kinematics.task`.
    """
    k = f.arm_axes
    pose, q, rates = np.empty(ARM), np.empty(k), np.empty(k)
    worst = 0.0
    for n in range(_PLACES + 1):
        for c in range(ARM):
            pose[c] = start[c] + change[c] * n / _PLACES
        if task_inverse(f.arm, pose, pose[1], q) != 0:
            return np.inf
        for i in range(k):
            if not f.ranges[i, 0] + _ROOM_WORKSPACE <= q[i] <= f.ranges[i, 1] - _ROOM_WORKSPACE:
                return np.inf
        if task_rates(f.arm, q, pose, change, rates) != 0:
            return np.inf
        effort = 0.0
        for i in range(k):
            effort += abs(rates[i]) / f.fastest[i]
        worst = max(worst, effort)
    return worst


@compiled
def pose_read(f, e, pose):
    """Pose of the tip by the readings of the joints.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        pose: (ARM,) written.

    Returns:
        Nothing.

    Source: `kinematics.task.task_forward`.
    """
    task_forward(f.arm, e.joint[: f.arm_axes], pose)


@compiled
def turned(angle):
    """The angle from -pi to pi that points the same way, scalar [rad]."""
    return angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi))
