"""Run n parallel episodes of a task, stepped by one native call.

The `gymnasium` and `dm_env` environments, single and batched, are wrappers around `TaskCore`.
"""

import copy
import dataclasses
import functools
import hashlib

import mujoco
import numpy as np

from hydrotele.control.arm_kinematics import arm_axes
from hydrotele.control.servo import tabulate_drive_geometry
from hydrotele.core.datafile import suggest_valid_name, validate_data
from hydrotele.core.errors import InputError
from hydrotele.envs.environment_step import step_or_reset_simulation
from hydrotele.envs.episode import (
    EPISODE_STATE,
    MAX_AXES,
    MAX_CHANNELS,
    MAX_MEASURES,
    NEXT_STEP,
    RESET,
    STEP,
    make_seed_states,
)
from hydrotele.envs.observation import list_machine_observation_fields
from hydrotele.envs.saved_state import SavedState, restore_state, save_state
from hydrotele.envs.task import Options, Task, load_task_machine
from hydrotele.envs.task_parameters import make_task_parameters
from hydrotele.envs.task_setup import TaskSetup, make_timing
from hydrotele.envs.variants import make_variants
from hydrotele.scenario.scenario import Servo
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock
from hydrotele.simulate.batch import SimulationBatch
from hydrotele.simulate.stepping import delay_line_length, sensor_history_length

MAX_ENVIRONMENTS = 100_000
"""Largest number of parallel episodes; each needs about 100 kB of memory."""
MAX_VARIANTS = 10_000
"""Largest number of variants; each takes some milliseconds to prepare."""
MAX_THREADS = 1024
"""Largest number of threads that step the episodes."""
_MIN_DIFFICULTY = 0.01  # smallest size of the goals: the rates of a reference of size 0 would be 0 / 0


def check_count(name: str, count: int, least: int, most: int) -> None:
    """Raise an error unless a count is an integer from `least` to `most`.

    Raises:
        InputError: the count is not an integer, or out of range; the message begins with `name`.
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or not least <= count <= most:
        raise InputError(name, f"must be a whole number from {least} to {most}, not {count!r}")


def make_task_setup(task: Task, options: Options) -> TaskSetup:
    """Combine a task with the user's options: clocks, nominal machine, its variants and observation fields.

    Args:
        task: the task.
        options: the user's options; action and duration None are replaced by the defaults of the
            task.

    Returns:
        The setup.

    Raises:
        InputError: an option is not valid for the task.
    """
    task = task.choose_phase(options.phase)
    options = dataclasses.replace(
        options, action=options.action or task.action,
        duration=task.duration if options.duration is None else options.duration,
    )  # fmt: skip
    check_count("variants", options.variants, 1, MAX_VARIANTS)
    for name, low in (("shaping", 0.0), ("difficulty", _MIN_DIFFICULTY)):
        if not low <= (value := getattr(options, name)) <= 1.0:
            raise InputError(name, f"must be from {low:g} to 1, not {value:g}")
    machine, clock = load_task_machine(task, options), make_timing(options)
    arm = arm_axes(machine) if machine.arm else ()
    driven = (*arm, *task.extra_axes)
    for name in options.start or {}:
        if name not in driven:
            raise InputError(f"start.{name}", suggest_valid_name(name, driven))
    variants = make_variants(task, options, machine)
    axes = driven or variants.plant.axes
    readings = list_machine_observation_fields(machine, axes, len(arm)) if task.with_readings else []
    fields = [*readings, *task.fields(machine, axes)]
    table = tabulate_drive_geometry(machine, variants.plant.axes)[1]
    if options.servo:
        settings = task.servo.model_dump(exclude_unset=True) | options.servo
        task = dataclasses.replace(task, servo=validate_data(Servo, settings, "environment option 'servo'", {}))
    return TaskSetup(task, options, clock, machine, axes, len(arm), variants, fields, table)


class TaskCore:
    """n parallel episodes of a task.

    Native code updates the arrays in place.

    Attributes:
        setup: the task with its options.
        count: number of episodes n.
        simulations: the batch of simulation states.
        episodes: (n,) records of EPISODE_STATE.
        observation: (n, o) float32.
        final_observation: (n, o) float32 observations before an autoreset in the same step.
        reward: (n,) rewards of the last step.
        terminated: (n,) uint8, whether the last step ended the episode by a condition of the task,
            or because the simulation became unstable.
        truncated: (n,) uint8, whether the last step ended the episode because its duration is over.
        measures: (n, MAX_MEASURES) task measures of the step, reported in `info`.
        final_measures: (n, MAX_MEASURES) the same before an autoreset in the same step.
        is_on_device: whether these arrays are in the memory of a CUDA device.
    """

    is_on_device = False

    def __init__(
        self, task: Task, options: Options, count: int = 1, threads: int = 1,
        autoreset: int = NEXT_STEP,
    ) -> None:  # fmt: skip
        """Compile the machines and allocate the arrays.

        Args:
            task: the task.
            options: the user's options.
            count: number of parallel episodes.
            threads: number of threads that step the episodes; 0 for one per core.
            autoreset: when an episode that ended is restarted: NEXT_STEP, SAME_STEP or DISABLED.

        Raises:
            InputError: an option is not valid for the task.
        """
        stop_profiling_clock()
        check_count("num_envs", count, 1, MAX_ENVIRONMENTS)
        check_count("threads", threads, 0, MAX_THREADS)
        self.count, self.setup = int(count), make_task_setup(task, options)
        self._allocate_arrays(self.count, autoreset)
        self.simulations = SimulationBatch(self.setup.variants.plant.model, count, threads)
        self._allocate_histories()
        self._is_started = np.zeros(count, bool)

    def _allocate_arrays(self, n: int, autoreset: int) -> None:
        """Allocate the arrays of n episodes and make the record of parameters with their addresses."""
        o, v = len(self.setup.fields), self.setup.variants
        self.episodes = np.zeros(n, EPISODE_STATE)
        self.action = np.zeros((n, len(self.setup.axes)), np.float32)
        self.observation, self.final_observation = (np.zeros((n, o), np.float32) for _ in range(2))
        self.observation_low = np.array([field.low for field in self.setup.fields], np.float32)
        self.observation_high = np.array([field.high for field in self.setup.fields], np.float32)
        self.reward = np.zeros(n)
        self.measures, self.final_measures = (np.zeros((n, MAX_MEASURES)) for _ in range(2))
        self.terminated, self.truncated = (np.zeros(n, np.uint8) for _ in range(2))
        self.terrain = np.zeros((n, self.setup.task.terrain_size))
        self.parameters = make_task_parameters(self.setup, n, autoreset)
        self._store_addresses(
            episodes=self.episodes, action=self.action, observation=self.observation, final=self.final_observation,
            low=self.observation_low, high=self.observation_high, reward=self.reward, terminated=self.terminated,
            truncated=self.truncated, measures=self.measures, final_measures=self.final_measures,
            start_tips=v.start_tips, scales=v.sensor_scales, offsets=v.sensor_offsets, terrain=self.terrain,
        )  # fmt: skip

    def _allocate_histories(self) -> None:
        """Allocate delay lines, sensor histories and model fields of the variants for the simulations in MuJoCo."""
        n, v = self.count, self.setup.variants
        self._commands = np.zeros((n, delay_line_length(v.command_delays, self.setup.clock.substeps), MAX_AXES))
        self._sensed = np.zeros((n, sensor_history_length(v.sensor_delays, v.lag_ratios), MAX_CHANNELS))
        self._sensed_before = np.zeros((n, MAX_CHANNELS))
        self._expanded_fields = {name: self.simulations.expand_field_per_simulation(name) for name in v.fields}
        for name, live in self._expanded_fields.items():
            if live.shape[1] != v.fields[name].shape[1]:  # native code copies one into the other
                message = f"variants cannot differ in {name}: the model has colliding meshes"
                raise InputError("randomise", message)
        same = np.tile(v.plant.model.actuator_user.ravel(), (len(v.states), 1))
        self._actuator_parameters = np.ascontiguousarray(v.fields.get("actuator_user", same))

        f = self.parameters
        f["delayed_command"], f["delayed_sensor"] = self._commands.shape[1], self._sensed.shape[1]
        rows = [(v.fields[n].ctypes.data, live.ctypes.data, v.fields[n].shape[1])
                for n, live in self._expanded_fields.items()]  # fmt: skip
        self._field_addresses = np.array(rows, np.int64).reshape(-1, 3)
        f["fields"] = len(rows)
        self._store_addresses(
            starts=v.states, users=self._actuator_parameters, lags=v.sensor_delays, ratios=v.lag_ratios,
            delays=v.command_delays, commands=self._commands, sensed=self._sensed, sensed_before=self._sensed_before,
            places=self._field_addresses,
        )  # fmt: skip
        if "eq_data" in self._expanded_fields:
            f["eq_rows"] = self._expanded_fields["eq_data"].ctypes.data

    def _store_addresses(self, **arrays: np.ndarray) -> None:
        """Store the addresses of arrays in the record that native code reads."""
        for name, array in arrays.items():
            self.parameters[name] = array.ctypes.data

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the actions: driven axes, or tip coordinates and the driven axes that do not belong to the arm."""
        setup = self.setup
        if setup.options.action != "resolved_motion":
            return setup.axes
        names = ("r", "theta", "z", "attitude", "head")[: setup.arm_axes]
        return (*names, *setup.axes[setup.arm_axes :])

    def set_difficulty(self, difficulty: float) -> None:
        """Set the size of the goals of new episodes, see `difficulty` of `envs.task.Options`."""
        self.parameters["difficulty"] = difficulty

    @property
    def bytes_per_environment(self) -> int:
        """Memory per environment: simulation state, episode record and results [byte]."""
        arrays = (
            self.episodes, self.action, self.observation, self.final_observation, self.reward, self.terminated,
            self.truncated, self.measures, self.final_measures, self.terrain, self._commands,
            self._sensed, self._sensed_before, self.simulations.state, *self._expanded_fields.values(),
        )  # fmt: skip
        return sum(array.nbytes for array in arrays) // self.count

    def reset(self, seeds: np.ndarray | None = None, chosen: np.ndarray | None = None) -> None:
        """Start new episodes in all simulations or in the chosen ones.

        Args:
            seeds: (m,) integers, one per simulation to reset; None continues the random stream of
                each episode.
            chosen: (m,) indices of simulations, None for all.

        Raises:
            RuntimeError: no seeds have ever been given, or the first reset does not include all
                episodes.
            ValueError: a seed is negative or exceeds 64 bits.
        """
        place = slice(None) if chosen is None else chosen
        begun = self._is_started.copy()
        begun[place] = True
        if not begun.all():
            raise RuntimeError("the first reset must begin all episodes: give it no mask")
        if seeds is not None:
            self.episodes["random"][place] = make_seed_states(seeds)
        elif not self._is_started.all():
            raise RuntimeError("the first reset needs seeds")
        self._is_started = begun
        self._run_call(RESET, chosen)

    def step(self, action: np.ndarray) -> None:
        """Advance all episodes by one environment step.

        Args:
            action: (n, a), or (a,) for all episodes; values outside +-1 are clipped.

        Raises:
            ValueError: the shape is wrong, or an action is not a finite real number.
            RuntimeError: the episodes have not been reset, or the simulations were closed.
        """
        if not self._is_started.all():
            raise RuntimeError("reset before the first step")
        values, wanted = np.asarray(action), self.action.shape
        if values.shape not in (wanted, wanted[1:]):
            raise ValueError(f"the action must have shape {wanted}, not {values.shape}")
        if values.dtype.kind not in "fiub":
            raise ValueError(f"the action must consist of real numbers, not of {values.dtype}")
        if not np.isfinite(values).all():
            raise ValueError("all actions must be finite numbers")
        np.clip(values, -1.0, 1.0, out=self.action, casting="unsafe")  # large float64 numbers exceed float32
        self._run_call(STEP, None)

    def _run_call(self, call: int, chosen: np.ndarray | None) -> None:
        """Step or reset the simulations `chosen` (None: all) by native code; `call` is STEP or RESET."""
        self.parameters["call"] = call
        ids = None if chosen is None else np.ascontiguousarray(chosen, np.int32)
        self.simulations.apply(step_or_reset_simulation.address, self.parameters.ctypes.data, ids)

    def step_single(self, action: np.ndarray) -> None:
        """Advance all episodes, normally a single one, like `step`; the action must have shape (a,)."""
        wanted = self.action.shape[1:]
        if np.shape(action) != wanted:
            raise ValueError(f"the action must have shape {wanted}, not {np.shape(action)}")
        self.step(action)

    @functools.cached_property
    def _environment(self) -> str:
        """Description of task, machine and options, one per line: the same for environments that share states."""
        setup = self.setup
        options = dataclasses.asdict(setup.options)
        del options["machine"]
        machine = hashlib.sha256(repr(setup.machine).encode()).hexdigest()[:12]
        lines = [f"task {setup.task.name}", f"machine {setup.machine.name} with tool {setup.machine.tool} ({machine})"]
        lines += [f"observation {', '.join(field.name for field in setup.fields)}"]
        return "\n".join([*lines, *(f"{name}={value!r}" for name, value in options.items())])

    def _state_arrays(self) -> dict[str, np.ndarray]:
        """Return the live arrays (n, ...) that make up the state of the episodes."""
        self.simulations.require_open()
        named = {
            "physics": self.simulations.state, "episodes": self.episodes, "observation": self.observation,
            "final_observation": self.final_observation, "reward": self.reward, "terminated": self.terminated,
            "truncated": self.truncated, "measures": self.measures, "final_measures": self.final_measures,
            "terrain": self.terrain, "commands": self._commands, "sensed": self._sensed,
            "sensed_before": self._sensed_before, "is_started": self._is_started,
        }  # fmt: skip
        return named | {f"model.{name}": live for name, live in self._expanded_fields.items()}

    def get_state(self, index: np.ndarray | int | None = None) -> SavedState:
        """Return a copy of the complete state of the episodes.

        Args:
            index: indices of the episodes, None for all.
        """
        return save_state(self._environment, self._state_arrays(), index)

    def set_state(self, state: SavedState, index: np.ndarray | int | None = None) -> None:
        """Continue from a saved state: the next steps give the same bits as they did after `get_state`.

        Args:
            state: result of `get_state` of an environment with the same task, machine and options, single or
                batched; a state of one episode is written to all.
            index: indices of the episodes to set, None for all.

        Raises:
            InputError: the state belongs to another environment, or has another number of episodes.
        """
        restore_state(self._environment, self._state_arrays(), state, index)

    def copy_model_and_data(self, number: int = 0) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return copies of the MuJoCo model and data of the simulation `number`, after `mj_forward`."""
        model = copy.copy(self.setup.variants.plant.model)
        data = mujoco.MjData(model)
        self.simulations.copy_model_into(number, model)
        self.simulations.copy_data_into(number, data)
        mujoco.mj_forward(model, data)
        return model, data

    def close(self) -> None:
        """Free the memory of the simulations."""
        self._expanded_fields = {}
        self.simulations.close()

    def __reduce__(self):
        """Raise TypeError: the simulations can be neither copied nor pickled."""
        return self.simulations.__reduce__()
