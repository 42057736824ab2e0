"""Tasks in plain Python: `observe(state)`, `reward(state, action)`, `reset(rng)` and `terminated(state)`.

A task is a subclass of `PythonTask`. It runs in a single environment and in a batch, and gives the
same bits in both:

    class LevelTip(PythonTask):
        machine, tool, action = "cat215", "bucket", "joint_rate"
        observation = (ObservationField("height_error", "m", -5.0, 5.0),)
        measures = (("height_error", "m"),)

        def reset(self, rng):
            return [rng.uniform(1.0, 3.0)]  # becomes state.goal[0]

        def observe(self, state):
            return [state.goal[0] - state.tip_pose[2]]

        def reward(self, state, action):
            state.measures[0] = abs(state.goal[0] - state.true_tip[2])
            return -state.measures[0]

    env = gymnasium.make("hydrotele/Custom-v0", task=LevelTip)

The simulation with control and sensors is native code in any case. The functions of a plain task are
called once per environment and step. A task whose functions are compiled (`hydrotele.compiled`) is
called by the native code, on all threads:

    @compiled
    def observe(state):
        return np.array([state.goal[0] - state.tip_pose[2]])

    class LevelTip(PythonTask):
        observe = staticmethod(observe)
        ...
"""

# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's carray is its documented API.

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import carray
from numba.core.dispatcher import Dispatcher

from hydrotele.core.compiled import Callback, callback, compiled
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_to_pointer
from hydrotele.envs.episode import (
    DISABLED,
    GOAL_SIZE,
    MAX_ARM_AXES,
    MAX_MEASURES,
    SAME_STEP,
    arm_values,
    draw_uniform,
)
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.observation import ObservationField
from hydrotele.envs.task import ActionKind, Options, Task
from hydrotele.envs.task_interface import (
    BEGIN,
    OBSERVE,
    REWARD,
    TASK_SIGNATURE,
    episode_states_view,
    observation_view,
    simulation_view,
    store_episode_end,
    task_parameters_view,
)
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo
from hydrotele.scenario.surrounding_objects import SurroundingObject


class TaskState(NamedTuple):
    """State of an episode that the functions of a task receive, with k driven axes.

    The driven axes are those of the arm from the swing outwards and then the further ones
    (`core.setup.axes`). Readings are those of the chosen sensors, as a controller has them. True values
    are without sensor errors; use them for rewards.

    Attributes:
        time: time since the start of the episode, scalar [s].
        position: (k,) readings of the axis positions [rad] or [m].
        rate: (k,) difference quotients of these readings [rad/s] or [m/s].
        pressure_head: (k,) readings of the head-side pressures [Pa]; 0 for an axis without a valve.
        pressure_rod: (k,) readings of the rod-side pressures [Pa]; 0 for an axis without a valve.
        pressure_supply: (s,) readings of the pump pressures [Pa].
        tip_pose: (5,) pose of the tip from the readings: r [m], theta [rad], z [m], attitude [rad], head [rad];
            0 for a machine without an arm, and for angles that the arm does not have.
        command: (k,) commands of valves [1], or of drives in their units.
        reference: (k,) references of the joint servo [rad] or [m]; used by the actions `joint_rate` and
            `resolved_motion`.
        true_position: (k,) true axis positions [rad] or [m].
        true_tip: (3,) true position of the tip in the world frame [m]; 0 for a machine without an arm.
        work: positive work of the hydraulic drives since the start of the episode, scalar [J].
        goal: (96,) values that the task keeps for this episode: first those that `reset` returned, then 0. The
            functions of the task may change them. A task must keep nothing elsewhere, since one object serves
            all episodes, and `get_state` saves these values only.
        measures: (8,) task measures of the step, which `reward` may write; they appear in `info`.

    Examples:
        A reward that uses the true position and the work of the drives:

        >>> import numpy as np
        >>> import hydrotele as ht
        >>> def reward(state, action):
        ...     error = abs(state.goal[0] - state.true_position[0])
        ...     return -error - 1e-5 * state.work
        >>> zero, goal = np.zeros(1), np.zeros(96)
        >>> goal[0] = 0.30
        >>> state = ht.TaskState(
        ...     time=1.0, position=np.array([0.281]), rate=zero, pressure_head=zero, pressure_rod=zero,
        ...     pressure_supply=zero, tip_pose=np.zeros(5), command=zero, reference=zero,
        ...     true_position=np.array([0.28]), true_tip=np.zeros(3), work=400.0, goal=goal, measures=np.zeros(8),
        ... )
        >>> round(float(reward(state, zero)), 4)  # 20 mm from the goal, and 400 J
        -0.024
    """

    time: float
    position: np.ndarray
    rate: np.ndarray
    pressure_head: np.ndarray
    pressure_rod: np.ndarray
    pressure_supply: np.ndarray
    tip_pose: np.ndarray
    command: np.ndarray
    reference: np.ndarray
    true_position: np.ndarray
    true_tip: np.ndarray
    work: float
    goal: np.ndarray
    measures: np.ndarray


class PythonTask:
    """Base class of tasks in plain Python; see the example in `hydrotele.envs.python_task`.

    A subclass sets the attributes that differ from the defaults, and defines `observe` and `reward`.

    Attributes:
        description: one sentence about the task.
        machine: name or path of the machine, unless the environment gets the option `machine`.
        tool: name of the tool, None for the first tool of the machine.
        needs: what another machine must have: joints of its arm (`swing`, `boom`, `stick`, `tool`, `head`), or
            names of joints.
        axes: driven axes in addition to those of the arm; without an arm, () stands for all axes.
        action: default kind of actions, `valve`, `joint_rate` or `resolved_motion`.
        duration: duration of an episode [s].
        observation: name, unit and bounds of every value that `observe` returns.
        with_readings: whether the readings of the machine precede these values in the observation: positions,
            rates, pressures, tip pose and commands.
        measures: name and unit of every task measure; `info` contains them.
        ground: whether there is a hard ground.
        servo: gains of the joint servo.
        pose_rates: tip rates at full action: r [m/s], theta [rad/s], z [m/s], attitude, head [rad/s].

    Examples:
        >>> import gymnasium
        >>> import numpy as np
        >>> import hydrotele as ht
        >>> import hydrotele.envs
        >>> class MoveSlide(ht.PythonTask):
        ...     machine, action, duration = "rig", "valve", 2.0
        ...     observation = (ht.ObservationField("position_error", "m", -1.0, 1.0),)
        ...     measures = (("position_error", "m"),)
        ...
        ...     def reset(self, rng):
        ...         return [rng.uniform(0.05, 0.45)]  # state.goal[0] of the episode
        ...
        ...     def observe(self, state):
        ...         return [state.goal[0] - state.position[0]]
        ...
        ...     def reward(self, state, action):
        ...         state.measures[0] = abs(state.goal[0] - state.true_position[0])
        ...         return -state.measures[0]
        >>> env = gymnasium.make("hydrotele/Custom-v0", task=MoveSlide, variants=1)
        >>> observation, info = env.reset(seed=1)
        >>> done = False
        >>> while not done:
        ...     action = np.clip(20.0 * observation[-1:], -1.0, 1.0)  # proportional to the position error
        ...     observation, reward, terminated, truncated, info = env.step(action)
        ...     done = terminated or truncated
        >>> bool(info["position_error"] < 0.005)  # m
        True
    """

    description: str = ""
    machine: str = "cat215"
    tool: str | None = None
    needs: tuple[str, ...] = ()
    axes: tuple[str, ...] = ()
    action: ActionKind = "valve"
    duration: float = 20.0
    observation: tuple[ObservationField, ...] = ()
    with_readings: bool = True
    measures: tuple[tuple[str, str], ...] = ()
    ground: bool = False
    servo: Servo = Servo()
    pose_rates: tuple[float, ...] = (0.5, 0.3, 0.5, 0.4, 0.25)

    @property
    def name(self) -> str:
        """Name of the task: that of the class."""
        return type(self).__name__

    def list_observation(self, machine: Machine, axes: tuple[str, ...]) -> Sequence[ObservationField]:
        """Return name, unit and bounds of the values of `observe`, by default `observation`.

        `machine` is the machine without effects and `axes` are the driven axes, for a task whose
        observation depends on them.
        """
        return self.observation

    def start(self, machine: Machine, rng: np.random.Generator) -> Mapping[str, float]:
        """Return the start positions of a variant, axis or joint name -> [rad] or [m]; others are those of `home`.

        It is called for every variant before the first episode (option `variants`).
        """
        return {}

    def surroundings(
        self, machine: Machine, rng: np.random.Generator, start: Mapping[str, float]
    ) -> tuple[SurroundingObject, ...]:
        """Return the objects around the machine of a variant; none by default."""
        return ()

    def reset(self, rng: np.random.Generator) -> Sequence[float] | np.ndarray:
        """Return up to 96 values for `state.goal` of a new episode.

        The generator has a new seed for every episode, which follows from the seed of the environment. A compiled
        `reset` passes `rng` to `hydrotele.envs.episode.draw_uniform` or `draw_uniform_between` instead.
        """
        return ()

    def observe(self, state: TaskState) -> Sequence[float] | np.ndarray:
        """Return the values that `observation` names."""
        raise NotImplementedError

    def reward(self, state: TaskState, action: np.ndarray) -> float:
        """Return the reward of a step that led to a state with an action (k,) from -1 to 1."""
        raise NotImplementedError

    def terminated(self, state: TaskState) -> bool:
        """Return whether the episode ends in this state; it is called after `reward`."""
        return False

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes without the converted task, which cannot be copied, for `copy` and `pickle`."""
        return {name: value for name, value in vars(self).items() if name != "_task"}

    def __repr__(self) -> str:
        """Return the name."""
        return f"PythonTask {self.name}"


@compiled
def make_task_state(f, e, measures):
    """Collect the values of an episode for the functions of a task.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        measures: (MAX_MEASURES,) task measures of the episode.

    Returns:
        TaskState; `goal` and `measures` share the memory of the episode, the other arrays are copies.

    Source: `TaskState`.
    """
    k = f.axes_driven
    position, rate, head, rod = np.empty(k), np.empty(k), np.zeros(k), np.zeros(k)
    command, reference, true_position = np.empty(k), np.empty(k), np.empty(k)
    supply, tip_pose, tip = np.zeros(f.supplies), np.zeros(MAX_ARM_AXES), np.zeros(3)
    for a in range(k):
        i = f.driven_axis[a]
        position[a], rate[a], true_position[a] = e.joint[i], e.rate[i], e.position[i]
        command[a], reference[a] = e.command[i], e.reference[i]
        if i < f.hydraulic:
            head[a], rod[a] = e.head[i], e.rod[i]
    for i in range(f.supplies):
        supply[i] = e.supply[i]
    if f.arm_axes > 0:
        compute_tip_pose(f.arm, arm_values(f, e.joint, np.empty(MAX_ARM_AXES)[: f.arm_axes]), tip_pose)
        for c in range(3):
            tip[c] = e.tip[c]
    return TaskState(
        e.tick * f.period, position, rate, head, rod, supply, tip_pose, command, reference, true_position, tip,
        e.work, e.goal, measures,
    )  # fmt: skip


@callback(TASK_SIGNATURE)
def run_empty_task_part(part, m, d, number, argument, out):
    """Do nothing, for a task in plain Python, whose functions `PythonTaskCore` calls after the native code."""
    return 0.0


@compiled
def _keep_no_goal(rng):
    return np.zeros(0)


@compiled
def _never_terminate(state):
    return False


_FUNCTIONS = ("reset", "observe", "reward", "terminated")


def _compiled_functions(program: PythonTask) -> dict[str, Any]:
    """Return the functions of a compiled task by name, with defaults for `reset` and `terminated`; {} for a plain one.

    Raises InputError if only some of the functions are compiled.
    """
    found: dict[str, Any] = {}
    for name in _FUNCTIONS:
        function = getattr(program, name)
        if isinstance(function, Dispatcher):
            found[name] = function
        elif getattr(type(program), name) is not getattr(PythonTask, name):
            found[name] = None
    plain = [name for name, function in found.items() if function is None]
    if len(plain) == len(found):
        return {}
    if plain:
        message = f"{', '.join(plain)} must be compiled, too, as `{plain[0]} = staticmethod(function)`"
        raise InputError(f"task {program.name}", message)
    return {"reset": _keep_no_goal, "terminated": _never_terminate, **found}


def _make_native_code(functions: Mapping[str, Any], size: int) -> Callback:
    """Return the native code of a task whose functions are compiled and whose `observe` returns `size` values."""
    reset, observe, reward, terminated = (functions[name] for name in _FUNCTIONS)

    def run_task_part(part, m, d, number, argument, out):
        f = task_parameters_view(argument)[0]
        e, w = episode_states_view(f)[number], simulation_view(f, m, d, number, argument)
        if part == BEGIN:
            e.goal[:] = 0.0
            drawn = reset(e)
            for i in range(min(len(drawn), GOAL_SIZE)):
                e.goal[i] = drawn[i]
        elif part == OBSERVE:
            values, target = observe(make_task_state(f, e, w.measures)), observation_view(f, out)
            for i in range(size):
                target[i] = values[i] if i < len(values) else np.nan
        elif part == REWARD:
            action = carray(address_to_pointer(f.action + 4 * number * f.actions), (f.actions,), np.float32)
            state = make_task_state(f, e, w.measures)
            value = reward(state, action)
            return store_episode_end(e, (value, terminated(state)))
        return 0.0

    return Callback(run_task_part, TASK_SIGNATURE)


def _check_observation_size(program: PythonTask, observe: Any, fields: int, axes: int) -> None:
    """Raise InputError if a compiled `observe` does not return one value per field."""
    k = np.zeros(axes)
    state = TaskState(
        0.0, k, k, k, k, np.zeros(1), np.zeros(MAX_ARM_AXES), k, k, k, np.zeros(3), 0.0, np.zeros(GOAL_SIZE),
        np.zeros(MAX_MEASURES),
    )  # fmt: skip
    count = len(observe.py_func(state))
    if count != fields:
        raise _make_size_error(program.name, count, fields)


def _make_size_error(name: str, count: int, fields: int) -> InputError:
    message = f"observe returns {count} values, but `observation` names {fields}: one ObservationField per value"
    return InputError(f"task {name}", message)


@functools.cache
def _find_task_of_class(kind: type[PythonTask]) -> Task:
    try:
        program = kind()
    except TypeError as error:
        message = f"cannot be made without arguments ({error}); pass an object instead of the class"
        raise InputError(f"task {kind.__name__}", message) from None
    return make_python_task(program)


def find_python_task(program: Any) -> Task:
    """Return the `Task` of a subclass of `PythonTask`, or of an object of one; always the same for the same object.

    Raises:
        InputError: `program` is neither, or its attributes are not valid.
    """
    if isinstance(program, type) and issubclass(program, PythonTask):
        return _find_task_of_class(program)
    if not isinstance(program, PythonTask):
        raise InputError("task", f"{program!r} is neither the name of a task, a PythonTask nor a Task")
    if "_task" not in vars(program):
        vars(program)["_task"] = make_python_task(program)
    return vars(program)["_task"]


def make_python_task(program: PythonTask) -> Task:
    """Convert a task in plain Python to a `Task`.

    Raises:
        InputError: a function is missing, only some functions are compiled, or an attribute is not valid.
    """
    for name in ("observe", "reward"):
        if getattr(type(program), name) is getattr(PythonTask, name):
            raise InputError(f"task {program.name}", f"does not define {name}(); see hydrotele.envs.python_task")
    if len(program.measures) > MAX_MEASURES:
        raise InputError(f"task {program.name}", f"has {len(program.measures)} measures; at most {MAX_MEASURES}")
    functions, size = _compiled_functions(program), len(program.observation)

    def list_fields(machine: Machine, axes: tuple[str, ...]) -> list[ObservationField]:
        fields = [ObservationField(*field) for field in program.list_observation(machine, axes)]
        if not fields and not program.with_readings:
            raise InputError(f"task {program.name}", "has no observation: set `observation` or `with_readings`")
        if functions:
            if len(fields) != size:
                raise InputError(f"task {program.name}", "a compiled task needs a fixed `observation`")
            _check_observation_size(program, functions["observe"], size, len(axes))
        return fields

    return Task(
        name=program.name, kind="python", description=program.description, reward="", machine=program.machine,
        tool=program.tool, start=lambda machine, rng: dict(program.start(machine, rng)), fields=list_fields,
        measures=tuple(program.measures), needs=tuple(program.needs), extra_axes=tuple(program.axes),
        action=program.action, duration=program.duration, surroundings=program.surroundings, ground=program.ground,
        pose_rates=tuple(program.pose_rates), servo=program.servo, with_readings=program.with_readings,
        code=_make_native_code(functions, size) if functions else run_empty_task_part,
        program=None if functions else program,
    )  # fmt: skip


class PythonTaskCore(TaskCore):
    """n parallel episodes of a task in plain Python.

    The native code steps the simulations. Then the functions of the task are called for one episode after
    the other.
    """

    def __init__(self, task: Task, options: Options, count: int, threads: int, autoreset: int) -> None:
        """Compile the machines and allocate the arrays; the arguments are those of `TaskCore`."""
        native = DISABLED if autoreset == SAME_STEP else autoreset  # the task ends episodes after the native code
        super().__init__(task, options, count, threads, native)
        self._program: PythonTask = task.program
        self._resets_in_step = autoreset == SAME_STEP
        self._first = len(self.setup.fields) - len(task.fields(self.setup.machine, self.setup.axes))

    def reset(self, seeds: np.ndarray | None = None, chosen: np.ndarray | None = None) -> None:
        """Start new episodes in all simulations or in the chosen ones, like `TaskCore.reset`."""
        super().reset(seeds, chosen)
        for number in range(self.count) if chosen is None else chosen.tolist():
            self._begin_episode(number)

    def step(self, action: np.ndarray) -> None:
        """Advance all episodes by one environment step, like `TaskCore.step`."""
        was_over = self.episodes["over"] != 0
        super().step(action)
        restarted = was_over & (self.episodes["step"] == 0)
        for number in range(self.count):
            if restarted[number]:
                self._begin_episode(number)
            elif not was_over[number]:
                self._finish_step(number)
        over = np.flatnonzero(self.episodes["over"])
        if self._resets_in_step and len(over):
            self.final_observation[over], self.final_measures[over] = self.observation[over], self.measures[over]
            ends = [array[over] for array in (self.reward, self.terminated, self.truncated)]
            self.reset(None, over)
            for array, values in zip((self.reward, self.terminated, self.truncated), ends, strict=True):
                array[over] = values

    def _begin_episode(self, number: int) -> None:
        """Draw the goal of a new episode and write the task's part of its observation."""
        seed = int(draw_uniform(self.episodes[number]) * 2**53)
        drawn = np.asarray(self._program.reset(np.random.default_rng(seed)), float).ravel()
        if len(drawn) > GOAL_SIZE:
            raise InputError(f"task {self._program.name}", f"reset returns {len(drawn)} values; at most {GOAL_SIZE}")
        goal = self.episodes["goal"][number]
        goal[:] = 0.0
        goal[: len(drawn)] = drawn
        self._observe(number, make_task_state(self.parameters[()], self.episodes[number], self.measures[number]))

    def _finish_step(self, number: int) -> None:
        """Compute reward, termination and the task's part of the observation after the native code."""
        episode = self.episodes[number]
        state = make_task_state(self.parameters[()], episode, self.measures[number])
        if not episode["fault"]:
            self.reward[number] = self._program.reward(state, self.action[number])
            if self._program.terminated(state):
                self.terminated[number], self.truncated[number], episode["over"] = 1, 0, 1
        self._observe(number, state)

    def _observe(self, number: int, state: TaskState) -> None:
        values = np.array(self._program.observe(state), float).ravel()
        low, high = self.observation_low[self._first :], self.observation_high[self._first :]
        if len(values) != len(low):
            raise _make_size_error(self._program.name, len(values), len(low))
        if not np.isfinite(values).all():
            if not self.episodes["fault"][number]:
                names = [field.name for field in self.setup.fields[self._first :]]
                message = (
                    f"observe returns {values[~np.isfinite(values)][0]} for {names[np.argmin(np.isfinite(values))]}"
                )
                raise InputError(f"task {self._program.name}", message)
            values = np.where(np.isfinite(values), values, low)
        inside = np.clip(values, low, high)
        self.episodes["saturated"][number] += int((inside != values).sum())
        self.observation[number, self._first :] = inside
