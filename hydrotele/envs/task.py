"""Definition of a task, the options of a user, and helpers that several tasks use.

`sample_start_positions` draws a start pose that lies well inside the workspace.
`compute_path_effort` computes how much a straight path of the tip demands of the drives, and
whether it stays in the workspace.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from hydrotele.control.arm_kinematics import arm_specification
from hydrotele.core.compiled import Callback, compiled
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.envs.episode import ACTIONS, MAX_ARM_AXES, arm_values
from hydrotele.envs.observation import ObservationField, max_reach
from hydrotele.kinematics.task_space import REACHED, compute_joint_rates, compute_tip_pose, solve_joint_angles
from hydrotele.machine.machine import Arm, Machine
from hydrotele.machine.machine_file import load_machine
from hydrotele.scenario.scenario import Servo
from hydrotele.scenario.surrounding_objects import SurroundingObject

ActionKind = Literal["valve", "joint_rate", "resolved_motion"]
REAL_SENSORS = "real"


@dataclasses.dataclass(frozen=True)
class Task:
    """A control task.

    Attributes:
        name: as in `hydrotele/<Name>-v0`.
        kind: name of its native code in `envs.task_parameters.TASK_CODES`; not used with `code`.
        description: description of the task.
        reward: description of the reward and the termination.
        machine: name of the machine, if the user names none.
        tool: name of the tool, None for the first tool of the machine.
        needs: what another machine must have: joints of its arm (`swing`, `boom`, `stick`, `tool`, `head`), or
            names of joints.
        extra_axes: driven axes in addition to those of the arm; without an arm, those of a task without
            `extra_axes` are all axes of the machine.
        action: default kind of actions.
        duration: duration of an episode [s].
        start: function (machine, random generator) -> {axis or joint name: position at the start}.
        fields: function (machine, driven axes) -> fields that `write_<kind>_observation` writes.
        measures: name and unit of every task measure in `info`.
        surroundings: function (machine, random generator, start) -> objects around the machine.
        ground: whether there is a hard ground.
        parameters: function (machine, MuJoCo model) -> up to MAX_PARAMETERS values for the native
            code.
        terrain_size: number of terrain values per episode, 0 without terrain.
        swing_locked: whether the action of the swing has no effect.
        written_fields: model fields that the native code writes; they are restored for every episode.
        pose_rates: tip rates at full action: r [m/s], theta [rad/s], z [m/s], attitude, head
            [rad/s].
        servo: gains of the joint servo (`joint_rate`, `resolved_motion`).
        with_readings: whether the observation starts with the readings of the machine.
        code: native code of a task outside this package, None for an entry of TASK_CODES.
        program: the task in plain Python that `code` does not compute, see `envs.python_task`; None without one.
        phases: name -> the task for one phase only, for the option `phase`.
    """

    name: str
    kind: str
    description: str
    reward: str
    machine: str
    tool: str | None
    start: Callable[[Machine, np.random.Generator], dict[str, float]]
    fields: Callable[[Machine, tuple[str, ...]], list[ObservationField]]
    measures: tuple[tuple[str, str], ...]
    needs: tuple[str, ...] = ("swing", "boom", "stick")
    extra_axes: tuple[str, ...] = ()
    action: ActionKind = "valve"
    duration: float = 20.0
    surroundings: Callable[[Machine, np.random.Generator, dict[str, float]], tuple[SurroundingObject, ...]] = (
        lambda *_: ()
    )
    ground: bool = False
    parameters: Callable[[Machine, mujoco.MjModel], Sequence[float] | np.ndarray] | None = None
    terrain_size: int = 0
    swing_locked: bool = False
    written_fields: tuple[str, ...] = ()
    pose_rates: tuple[float, ...] = (0.5, 0.3, 0.5, 0.4, 0.25)
    servo: Servo = Servo()
    with_readings: bool = True
    code: Callback | None = None
    program: Any = None
    phases: Mapping[str, "Task"] = dataclasses.field(default_factory=dict)

    def choose_phase(self, phase: str | None) -> "Task":
        """Return the task for one of its phases, or the task itself for None.

        Raises:
            InputError: the task has no such phase.
        """
        if phase is None:
            return self
        if phase not in self.phases:
            known = suggest_valid_name(phase, self.phases) if self.phases else f"{self.name} has no phases"
            raise InputError(f"phase {phase!r}", known)
        return self.phases[phase]


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of an environment; None selects the default of the task.

    Attributes:
        machine: name of a shipped machine, a machine folder or file, or a `Machine` with a tool.
        tool: tool of the machine. The default for another machine is the tool of the task if the machine has it,
            or else the first tool of the machine.
        action: `valve` (valve commands), `joint_rate` (axis rates, tracked by the joint servo) or
            `resolved_motion` (tip rates, converted to axis rates).
        sensors: `ideal`, `real` (the first set of sensors of the machine) or the name of a set.
        control_rate: environment steps per second [Hz]; the servo runs at the multiple of this rate
            nearest to 200 Hz, or at this rate if it is higher.
        duration: duration of an episode [s].
        effects: effects added to the machine in every episode: mappings with `name`, `location`, `parameters`.
        randomise: effects with a range [low, high] for each parameter, from which every variant gets a random value;
            or the result folder of `hydrotele gap`, of whose posterior every variant is one sample; or a list of both.
        variants: number of variants, which are drawn once. A variant is a start position and, with `randomise`, a
            random machine. The seed of `reset` selects one for each episode.
        variant_seed: random seed of the variants; another value gives other variants.
        timestep: physics step [s].
        servo: settings of the joint servo that differ from those of the task, as in scenarios, such as
            `{"axis_gains": {"swing": 1.0}}` for the heavy upper structure of another machine.
        phase: phase of the task that an episode consists of, for a curriculum; only for tasks with phases
            (`LoadTruck`: `dig`, `haul`, `dump`, `return`, `cycle`).
        shaping: discount factor gamma of the learner, at most 1. The reward of every step from state s to s'
            then has the additional term gamma Phi(s') - Phi(s), with the task's potential Phi. It does
            not change which policies are optimal for this gamma. 0: no additional term.
        difficulty: size of the goals, at most 1 (full size), for a curriculum. It multiplies rates of references,
            length and speed of lines and distance of poses; tolerances of poses are divided by it. In `PlaceLog` it
            multiplies the distances from grapple to log and from log to goal, the latter by at least 0.25.
        start: positions of axes at the start of every episode [rad] or [m]; those of other axes are random.
    """

    machine: str | Path | Machine | None = None
    tool: str | None = None
    action: ActionKind | None = None
    sensors: str = "ideal"
    control_rate: float = 50.0
    duration: float | None = None
    effects: tuple[dict[str, Any], ...] = ()
    randomise: tuple[dict[str, Any] | str | Path, ...] | str | Path = ()
    variants: int = 64
    variant_seed: int = 0
    timestep: float = 1.0e-3
    servo: dict[str, Any] = dataclasses.field(default_factory=dict)
    phase: str | None = None
    shaping: float = 0.0
    difficulty: float = 1.0
    start: dict[str, float] | None = None


assert set(ACTIONS) == set(ActionKind.__args__)


_MAX_DRAWS = 1000  # maximum number of draws of a start pose
_START_MARGIN = 0.08  # rad, minimum distance to the limits of the joint ranges


def sample_start_positions(
    machine: Machine, rng: np.random.Generator, low: tuple[float, ...], high: tuple[float, ...]
) -> dict[str, float]:
    """Draw a random pose of the tip within bounds and return the positions of the arm axes.

    The pose is drawn again until the arm can reach it at least 0.08 rad from all joint limits.

    Args:
        machine: the machine.
        rng: random generator.
        low: (5,) or, without a head, (4,) lower bounds of r [m], theta [rad], z [m], attitude, head
            [rad]; missing elements are 0 in the pose.
        high: upper bounds, likewise.

    Returns:
        Axis -> position [rad].

    Raises:
        InputError: none of 1000 random poses is reachable.
    """
    numbers, axes, ranges = arm_specification(machine)
    pose, joints = np.zeros(5), np.zeros(len(axes))
    for _ in range(_MAX_DRAWS):
        pose[: len(low)] = rng.uniform(low, high)
        if (
            solve_joint_angles(numbers, pose, pose[1], joints) == REACHED
            and ((ranges[:, 0] + _START_MARGIN <= joints) & (joints <= ranges[:, 1] - _START_MARGIN)).all()
        ):
            return dict(zip(axes, joints.tolist(), strict=True))
    message = (
        f"no pose from {low} to {high} (r, theta, z, attitude, head) can be reached; choose another machine or tool"
    )
    raise InputError(f"start of {machine.name} with tool {machine.tool}", message)


def size_ratio(machine: Machine, name: str, tool: str) -> float:
    """Return the maximum reach of a machine divided by that of a shipped machine `name` with a tool [1]."""
    return max_reach(machine) / _shipped_reach(name, tool)


@functools.cache
def _shipped_reach(name: str, tool: str) -> float:
    return max_reach(load_machine(name, tool))


def load_task_machine(task: Task, options: Options) -> Machine:
    """Load the machine of a task, or the one that the user chose, with its tool.

    Raises:
        InputError: the machine or tool does not exist, or the machine has no such arm or axes as the task requires.
    """
    chosen = options.machine
    if isinstance(chosen, Machine):
        if options.tool not in (None, chosen.tool):
            raise InputError(
                f"tool {options.tool!r}", f"the machine is loaded with the tool {chosen.tool!r}; leave out tool"
            )
        machine = chosen
    elif chosen is None:
        machine = load_machine(task.machine, options.tool or task.tool)
    else:
        machine = load_machine(chosen, options.tool)
        if options.tool is None and task.tool in machine.tools:
            machine = load_machine(chosen, task.tool)
    check_task_machine(task, machine)
    return machine


def check_task_machine(task: Task, machine: Machine) -> None:
    """Raise InputError unless a machine has all joints and axes of `Task.needs` and `Task.extra_axes`."""
    names = machine.joints.keys() | machine.axes.keys()
    missing = [name for name in task.needs if not getattr(machine.arm, name, None) and name not in names]
    missing += [name for name in task.extra_axes if name not in machine.axes]
    if machine.arm is None:
        missing = [name for name in task.needs if name in Arm.model_fields] or missing
    if not missing:
        return
    needed = ", ".join(dict.fromkeys((*task.needs, *task.extra_axes)))
    tools = f"; it has the tools {', '.join(machine.tools)}" if len(machine.tools) > 1 else ""
    arm = " (its machine file has no `arm`)" if machine.arm is None else ""
    lacking = f"{machine.name} with the tool {machine.tool} lacks {', '.join(missing)}"
    raise InputError(f"task {task.name}", f"needs a machine with {needed}; {lacking}{arm}{tools}")


_PATH_SEGMENTS = 16  # number of path segments whose ends are checked
_PATH_MARGIN = 0.03  # rad, minimum distance of a path to the limits of the joint ranges


@compiled
def compute_path_effort(f, start, change):
    """Return the maximum drive effort along a path of the tip that takes 1 s, if it stays in the workspace.

    The path is straight in the coordinates of the pose and is evaluated at 17 points. The effort is
    the sum over all arm axes of the axis rate divided by the rate at full action. The sum matters
    because all drives use the same pump.

    Args:
        f: record of TASK_PARAMETERS.
        start: (MAX_ARM_AXES,) start pose: r [m], theta [rad], z [m], attitude, head [rad].
        change: (MAX_ARM_AXES,) difference between end pose and start pose, same units.

    Returns:
        The maximum effort, scalar [s]; divide it by the duration of the path. It is infinite if a
        point is out of reach or closer than 0.03 rad to a joint limit.

    Source: `kinematics.task_space`.
    """
    k = f.arm_axes
    pose, q, rates = np.empty(MAX_ARM_AXES), np.empty(MAX_ARM_AXES)[:k], np.empty(MAX_ARM_AXES)[:k]
    worst = 0.0
    for n in range(_PATH_SEGMENTS + 1):
        for c in range(MAX_ARM_AXES):
            pose[c] = start[c] + change[c] * n / _PATH_SEGMENTS
        if solve_joint_angles(f.arm, pose, pose[1], q) != 0:
            return np.inf
        for a in range(k):
            i = f.driven_axis[a]
            if not f.ranges[i, 0] + _PATH_MARGIN <= q[a] <= f.ranges[i, 1] - _PATH_MARGIN:
                return np.inf
        if compute_joint_rates(f.arm, q, pose, change, rates) != 0:
            return np.inf
        effort = 0.0
        for a in range(k):
            effort += abs(rates[a]) / f.fastest[f.driven_axis[a]]
        worst = max(worst, effort)
    return worst


@compiled
def compute_measured_pose(f, e, pose):
    """Compute the pose of the tip from the measured joint positions.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        pose: (MAX_ARM_AXES,) written: r [m], theta [rad], z [m], attitude [rad], head [rad].

    Returns:
        Nothing.

    Source: `kinematics.task_space.compute_tip_pose`.
    """
    compute_tip_pose(f.arm, arm_values(f, e.joint, np.empty(MAX_ARM_AXES)[: f.arm_axes]), pose)


RECOVERY_SPEED = 0.5  # m/s, speed at which potentials assume that an error decreases
MAX_STEP_LOSS = 2.0  # difference of the largest and the smallest reward of a step in a tracking task


@compiled
def count_recovery_steps(f, error):
    """Return the environment steps, scalar, in which an error [m] vanishes at RECOVERY_SPEED; 1 rad counts as 1 m.

    `f` is the record of TASK_PARAMETERS.
    """
    return error / (RECOVERY_SPEED * f.ticks * f.period)


@compiled
def compute_tracking_potential(f, error):
    """Return the potential of a tracking error: minus the discounted reward that is lost until it has vanished.

    Args:
        f: record of TASK_PARAMETERS.
        error: position error, scalar [m]; 1 rad counts as 1 m.

    Returns:
        The potential, scalar: -2 (1 - gamma^n) / (1 - gamma) for n steps until the error has vanished.

    Source: sum of a geometric series; rewards of `TrackTrajectory` and `StraightLine`.
    """
    steps = count_recovery_steps(f, error)
    if f.shaping >= 1.0:
        return -MAX_STEP_LOSS * steps
    return -MAX_STEP_LOSS * (1.0 - f.shaping**steps) / (1.0 - f.shaping)


@compiled
def wrap_angle(angle):
    """Return the equivalent angle from -pi to pi, scalar [rad]."""
    return angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi))
