"""Run n parallel episodes of a task on the reduced model instead of MuJoCo, on the CPU or on a CUDA device."""

from typing import Any

import mujoco
import numpy as np

from hydrotele.batch.batch import PARAMETERS, Batch
from hydrotele.batch.machine_step import Task as BatchTask
from hydrotele.core.errors import InputError
from hydrotele.envs.episode import STEP
from hydrotele.envs.episode_batch import MAX_THREADS, TaskCore, check_count, make_task_setup
from hydrotele.envs.reduced_step import TASK_FUNCTIONS, EpisodeArrays, make_step_functions
from hydrotele.envs.task import Options, Task
from hydrotele.envs.task_setup import TaskSetup
from hydrotele.envs.variants import sensor_channels
from hydrotele.estimate.reduced_model import (
    Model,
    model_space,
    place,
    reduced_model,
    set_activations,
    show_channels,
    state_size,
    store_activations,
)
from hydrotele.machine.machine import Machine
from hydrotele.multibody.reduced_mechanism import body_names, coordinate_names
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock
from hydrotele.simulate.batch import STATE_KIND

MAX_MACHINES = 1_000_000
"""Largest number of parallel episodes on the reduced model."""
_VARIED = ("shape", "joint", "gravity", "user", "gain", "delay", "transmission")
_MECHANISM = ("shape", "joint", "gravity")
_EPISODE_ARRAYS = ("episodes", "action", "observation", "final_observation", "reward", "terminated", "truncated",
                   "measures", "final_measures")  # fmt: skip
_SENSOR_PARAMETERS = ("scale", "offset", "drift")  # the environment applies them itself
assert set(_VARIED) | set(_SENSOR_PARAMETERS) == set(PARAMETERS)


def check_task(task: Task, setup: TaskSetup) -> None:
    """Raise InputError if a task or its options need what the reduced model does not have."""
    if task.kind not in TASK_FUNCTIONS or task.code or task.program is not None:
        message = "needs MuJoCo for contact or other code: leave out device. The reduced model runs"
        message += " TrackTrajectory, StraightLine and ReachFeller"
        raise InputError(f"task {task.name}", message)
    variants = setup.variants
    if variants.sensor_delays.any() or variants.lag_ratios.any():
        raise InputError("device", "the reduced model has no sensors with delay or lag: leave out device or the effect")


class ReducedCore(TaskCore):
    """n parallel episodes of a task on the reduced model.

    Observations, rewards, episodes and random numbers are those of `TaskCore`; only the motion of the machines
    comes from another model. Each episode uses one of the variants, whose parameters are copied to its machine.

    Attributes:
        batch: the machines; at least as many as variants with different parameters.
    """

    def __init__(
        self, task: Task, options: Options, count: int = 1, threads: int = 1, autoreset: int = 0, device: str = "cpu",
        precision: str | None = None,
    ) -> None:  # fmt: skip
        """Make the machines and allocate the arrays.

        Args:
            task: the task.
            options: the user's options.
            count: number of parallel episodes.
            threads: number of threads; 0 for one per core.
            autoreset: when an episode that ended is restarted: NEXT_STEP, SAME_STEP or DISABLED.
            device: "cpu" or "cuda".
            precision: option of `Batch`; None for the default of the device.

        Raises:
            InputError: the task needs contact, an option is not valid, or there is no CUDA device.
        """
        stop_profiling_clock()
        check_count("num_envs", count, 1, MAX_MACHINES)
        check_count("threads", threads, 0, MAX_THREADS)
        self.setup = make_task_setup(task, options)
        check_task(self.setup.task, self.setup)
        machines = [m.model_copy(update={"sensor_errors": {}}) for m in self.setup.variants.machines]
        if all(machine == machines[0] for machine in machines):
            machines = machines[:1]
        rows = max(int(count), len(machines))  # the code of the mechanism is made for all variants
        self._allocate_arrays(rows, autoreset)
        self.episodes["over"][count:] = 1
        self._functions, channels = (
            make_step_functions(self.setup.task.kind),
            sensor_channels(self.setup.variants.plant),
        )
        models = [reduced_model(machine, channels) for machine in machines]
        starts, *measured = make_start_states(self.setup, machines, models)
        arrays = self._make_episode_arrays(machines, models, *measured)
        chosen: dict[str, Any] = {} if precision is None else {"precision": precision}
        self.batch = Batch(
            machines, rows, device=device, period=self.setup.clock.period, timestep=options.timestep, threads=threads,
            task=BatchTask(self._functions.before, self._functions.after, arrays), channels=channels, start=starts,
            **chosen,
        )  # fmt: skip
        self._varied = [name for name in _VARIED if len(getattr(arrays, name)) > 1]
        self.count, self._is_started = int(count), np.zeros(count, bool)
        for name in _EPISODE_ARRAYS:
            whole = getattr(self.batch.task_arrays, name)
            setattr(self, name, whole if rows == count else whole[:count])

    def _make_episode_arrays(
        self, machines: list[Machine], models: list[Model], readings: np.ndarray, commands: np.ndarray
    ) -> EpisodeArrays:
        tables = {name: [getattr(m.mech if name in _MECHANISM else m, name) for m in models] for name in _VARIED}
        tips, link = [machine.arm.tip.position for machine in machines if machine.arm], ""
        if machines[0].arm:
            link = machines[0].arm.tip.link
        return EpisodeArrays(
            parameters=self.parameters.reshape(1), episodes=self.episodes, action=self.action,
            observation=self.observation, final_observation=self.final_observation, low=self.observation_low,
            high=self.observation_high, reward=self.reward, terminated=self.terminated, truncated=self.truncated,
            measures=self.measures, final_measures=self.final_measures,
            tip_frame=body_names(machines[0]).index(link), tip=np.resize(tips, (len(readings), 3)),
            start_tip=self.setup.variants.start_tips, start_reading=readings, start_command=commands,
            scale=self.setup.variants.sensor_scales, offset=self.setup.variants.sensor_offsets,
            table=np.ascontiguousarray(self.setup.drive_table),
            **{name: np.array(v[:1] if all(np.array_equal(v[0], x) for x in v) else v) for name, v in tables.items()},
        )  # fmt: skip

    def _run_call(self, call: int, chosen: np.ndarray | None) -> None:
        self.parameters["call"] = call
        if call == STEP:
            self.batch.step(None, self.setup.clock.ticks)
            return
        numbers = np.arange(self.count) if chosen is None else np.asarray(chosen, np.int64)
        batch = self.batch
        self._functions.begin(batch.task_arrays, batch.model, batch.machines, np.zeros(0, np.uint64), numbers)

    @property
    def simulations(self) -> Any:
        """Raise InputError: there are no simulations in MuJoCo, which rendering needs."""
        raise InputError("device", "an environment on the reduced model has no images: leave out device")

    @property
    def bytes_per_environment(self) -> int:
        """Memory per environment: states, episode record and results [byte]."""
        return sum(array.nbytes // len(array) for array in self._state_arrays().values())

    def _state_arrays(self) -> dict[str, np.ndarray]:
        found = {name: getattr(self, name) for name in _EPISODE_ARRAYS if name != "action"}
        found |= {"is_started": self._is_started}
        machines = self.batch.machines._asdict()
        found |= {f"machines.{n}": a[: self.count] for n, a in machines.items() if not n.startswith("start")}
        rows = {name: self.batch.expand_parameters(name)[: self.count] for name in self._varied}
        return found | {f"model.{name}": values for name, values in rows.items()}

    def copy_model_and_data(self, number: int = 0) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Raise InputError: there are no simulations in MuJoCo."""
        return self.simulations

    def close(self) -> None:
        """Do nothing: memory is freed with the object."""


def make_start_states(
    setup: TaskSetup, machines: list[Machine], models: list[Model]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the start states of the reduced model at rest, the true values of its sensors and its commands.

    Args:
        setup: the task with its options, whose variants have start states of MuJoCo.
        machines: one machine per variant, or one for all.
        models: their reduced models.

    Returns:
        (states (v, n), readings (v, c), commands (v, nu) [1] or [V]).
    """
    plant, variants = setup.variants.plant, setup.variants
    data, names = mujoco.MjData(plant.model), coordinate_names(machines[0])
    states = np.zeros((len(variants.states), state_size(models[0])))
    readings, commands = np.zeros((len(states), len(models[0].kind))), np.zeros((len(states), plant.model.nu))
    for v, state in enumerate(states):
        model = models[v % len(models)]
        mujoco.mj_setState(plant.model, data, variants.states[v], STATE_KIND)
        commands[v] = data.ctrl
        positions = data.qpos - plant.model.opt.timestep * data.qvel if plant.model.nq == plant.model.nv else data.qpos
        n, space = len(model.mech.independent), model_space(model)
        for f, k in enumerate(model.mech.independent):
            state[f] = positions[plant.model.joint(names[k]).qposadr[0]]
        for i, gear in enumerate(model.gear):
            if gear >= 0:
                state[n + gear] = positions[plant.drive_qpos[i]]
        space.act[:] = data.act[: len(space.act)]
        store_activations(model, space, state)
        place(model, space, state)
        set_activations(model, space, state)
        show_channels(model, space, state, 0, 1, 1.0, readings[:0], readings[v])
    return states, readings, commands
