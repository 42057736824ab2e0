"""Batch of machines simulated by the reduced model, advanced by threads of the CPU or by a CUDA device."""

import hashlib
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from typing import Any

import numpy as np
from numba.extending import intrinsic

from hydrotele.batch import machine_step
from hydrotele.batch.machine_step import NO_TASK, Machines, Noise, Task, Timing, make_lanes, store_linkage
from hydrotele.batch.mechanism_code import PROGRAMS, MechanismCode, trace_mechanism
from hydrotele.core.compiled import compile_without_allocation
from hydrotele.core.device import rebuild_function
from hydrotele.core.errors import InputError
from hydrotele.core.tracing import make_program_function
from hydrotele.estimate.reduced_model import (
    Model,
    model_space,
    place,
    predicted_channels,
    reduced_model,
    state_names,
    state_size,
    store_activations,
)
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.machine.machine import Machine, find_channel_sensor
from hydrotele.machine.sensors import Sensor, SensorSet, make_channel_converter
from hydrotele.multibody.reduced_mechanism import coordinate_names
from hydrotele.simulate.plant import build_plant, rest_state

PARAMETERS = (
    "shape", "joint", "gravity", "user", "gain", "delay", "transmission", "scale", "offset", "drift",
)  # fmt: skip
"""Arrays of `Model` and its mechanism that can differ between the machines of a batch."""
_MECHANISM_PARAMETERS = ("shape", "joint", "gravity")


LANES = 8  # machines per block on the CPU: two vectors of four numbers


class Batch:
    """Machines simulated by the reduced model of the estimator, with the laws of the MuJoCo plant.

    The reduced model has exact closed chains, the hydraulic circuit, friction, end stops, transmissions,
    command delays, additional laws (terms) and sensors, but no contact with the ground or with objects.
    Machines with the same seed and commands have the same states, bit by bit, on the same device and with any
    number of threads.

    Attributes:
        machine: the machine, or the first of the variants.
        count: number of machines m.
        device: "cpu" or "cuda".
        channels: names of the c channels of `readings`.
        axes: names of the nu drives in the order of the commands.
        state_names: names of the n states.
        machines: state of all machines; arrays of the device.
        model: Model with one row of parameters, or one per machine; arrays of the device.
        task: the task.
        task_arrays: arrays of the task; arrays of the device.
    """

    def __init__(
        self, machine: Machine | Sequence[Machine], count: int, *, device: str = "cpu", period: float = 0.02,
        timestep: float = 0.001, sensors: SensorSet | None = None, seed: int = 0, rate_limit: float = np.inf,
        task: Task = NO_TASK, **options: Any,
    ) -> None:  # fmt: skip
        """Create the machines at rest, with closed valves, at their home positions.

        Args:
            machine: the machine, or variants of it with the same drives and sensors; machine i is variant
                i modulo their number.
            count: number of machines.
            device: "cpu", or "cuda" with the extra `gpu`.
            period: control period, for which commands are held [s].
            timestep: time step of the simulation [s]; the control period is a multiple of it.
            sensors: sensor set with noise and converters; None for ideal sensors.
            seed: seed of the sensors' random errors; machine i has its own random numbers.
            rate_limit: largest rate of all commands [1/s] or [V/s].
            task: functions and arrays that run in the step of each machine.
            options: `threads`, number of threads of the CPU (one per processor by default); `channels`, names
                of the channels that are read (all by default); `start`, (k, n) states from which machines
                start (at rest by default); `precision`, "double", or "mixed" to compute mass matrix and forces of
                the mechanism in float32 (by default "double" on the CPU and "mixed" on a CUDA device).

        Raises:
            InputError: the machine has a sensor with a delay or a lag, variants have different structures, an
                option is unknown, or there is no CUDA device.
        """
        known = ("channels", "precision", "start", "threads")
        if unknown := set(options) - set(known):
            raise InputError("batch", f"has no option {', '.join(sorted(unknown))}: {', '.join(known)}")
        if device not in ("cpu", "cuda"):
            raise InputError("batch", f"device must be cpu or cuda, not {device!r}")
        precision = options.get("precision", "double" if device == "cpu" else "mixed")
        if precision not in ("double", "mixed"):
            raise InputError("batch", f"precision must be double or mixed, not {precision!r}")
        variants = [machine] if isinstance(machine, Machine) else list(machine)
        self.machine, self.count, self.device = variants[0], count, device
        self.channels = tuple(options.get("channels", predicted_channels(self.machine)))
        self.axes, self.state_names = tuple(actuator_order(self.machine)), state_names(self.machine)
        models = [reduced_model(variant, self.channels) for variant in variants]
        _require_equal_structure(models, self.channels)
        self._single, self.task = models[0], task
        self.model: Any = _stack_models(models, count)
        self._timing = _make_timing(self._single, period, timestep, rate_limit)
        self._noise = _make_noise(self.machine, sensors, self.channels, period)
        start = options.get("start")
        if start is None:
            start = np.array([rest_machine_state(v, m) for v, m in zip(variants, models, strict=True)])
        self._start_of_machine = np.arange(count) % len(start)
        self.machines = _make_machines(models, np.ascontiguousarray(start, float), count, self._timing, seed)
        code = trace_mechanism(self._single, self.model, precision)
        if device == "cuda":
            from hydrotele.batch.cuda_kernel import CudaRunner

            self._runner: Any = CudaRunner(self._single, code, task, self.machine.terms)
        else:
            self._runner = _ThreadRunner(self._single, code, task, options.get("threads", 0))
        self.machines, self.model, self._noise, self._timing, self.task_arrays = map(
            self._runner.upload, (self.machines, self.model, self._noise, self._timing, task.arrays)
        )

    @property
    def state(self) -> Any:
        """States (m, n) of the machines, in the order of `state_names`; an array of the device."""
        return self.machines.state

    @property
    def readings(self) -> Any:
        """Readings (m, c) of the sensors after the last step, in the order of `channels`; an array of the device."""
        return self.machines.reading

    def step(self, commands: Any, periods: int = 1) -> Any:
        """Advance all machines by some control periods with held commands; return the readings.

        Args:
            commands: (nu,) or (m, nu) commands of the drives [1] or [V], or None if the task writes them.
                With device "cuda" also an array of the device, which is copied on the device.
            periods: number of control periods.

        Returns:
            (m, c) readings, an array of the device that the next step overwrites.
        """
        if commands is not None:
            self.assign(self.machines.command, commands)
        self._runner.run(self.model, self.machines, self._noise, self._timing, self.task_arrays, periods)
        return self.machines.reading

    def reset(self, mask: np.ndarray | None = None, start: np.ndarray | None = None) -> None:
        """Restart machines at rest, with zero commands; their random numbers continue.

        Args:
            mask: (m,) bool, which machines restart; None for all.
            start: (m,) rows of the start states; None for the machine's own.
        """
        chosen = np.arange(self.count) if mask is None else np.flatnonzero(np.asarray(mask))
        rows = (self._start_of_machine if start is None else np.asarray(start))[chosen]
        m, write = self.machines, self._runner.assign_rows
        write(m.state, chosen, self._runner.read(m.start)[rows])
        write(m.linkage, chosen, self._runner.read(m.start_linkage)[rows])
        for array in (m.history, m.error, m.command):
            write(array, chosen, 0.0)
        for array in (m.period_count, m.failed):
            write(array, chosen, 0)

    def launch(self, function: Any, *arguments: Any) -> None:
        """Run a compiled function on the CUDA device for each element k of its last array: `function(*arguments, k)`.

        Args:
            function: compiled function of a task.
            arguments: arrays of the CPU, which are copied to the device, and NamedTuples of arrays of the device.
        """
        self._runner.launch(function, *arguments)

    def assign(self, array: Any, values: Any) -> None:
        """Copy values into an array of the device: those of one row to all rows, or a matrix.

        Args:
            array: matrix of the device.
            values: array of the CPU, or of the device; the latter are copied on the device.
        """
        self._runner.assign(array, values)

    def synchronise(self) -> None:
        """Wait until the device has done all steps; `step` does not wait on a CUDA device."""
        self._runner.synchronise()

    def to_host(self, array: Any) -> np.ndarray:
        """Return an array of the batch in the memory of the CPU, a copy if the device has its own memory."""
        return self._runner.read(array)

    def expand_parameters(self, name: str) -> Any:
        """Let numbers of the model differ between the machines, and return them.

        Args:
            name: one of `PARAMETERS`.

        Returns:
            (m, ...) array of the device. Changes take effect with the next step. `user` has the parameters of
            the actuators, see `actuator_layout.Slot`; `shape` the geometry and masses, see `ReducedMechanism`.
        """
        if name not in PARAMETERS:
            raise InputError("batch", f"has no parameter {name!r}: {', '.join(PARAMETERS)}")
        inside = name in _MECHANISM_PARAMETERS
        owner = self.model.mech if inside else self.model
        values = getattr(owner, name)
        if len(values) != self.count:
            values = self._runner.repeat(values, self.count)
            owner = owner._replace(**{name: values})
            self.model = self.model._replace(mech=owner) if inside else owner
        return values


def as_dlpack(array: Any) -> Any:
    """Return a view of an array of a batch with the DLPack protocol, for `from_dlpack` of PyTorch, JAX or CuPy.

    Nothing is copied. The kernels run in the default stream of the device, which PyTorch and CuPy use, too.

    Args:
        array: array of the CPU, returned as it is, or of a CUDA device.
    """
    if isinstance(array, np.ndarray):
        return array
    return import_module("cuda.core.utils").StridedMemoryView.from_cuda_array_interface(array, stream_ptr=-1)


def rest_machine_state(machine: Machine, model: Model, joints: dict[str, float] | None = None) -> np.ndarray:
    """Return the state (n,) of the reduced model at rest, with pressures that carry the load.

    Args:
        machine: the machine.
        model: its reduced model.
        joints: joint name -> angle [rad] or position [m]; others at home.

    Source: `simulate.plant.rest_state`.
    """
    plant = build_plant(machine)
    data, names, sp = rest_state(plant, joints), coordinate_names(machine), model_space(model)
    state, n = np.zeros(state_size(model)), len(model.mech.independent)
    for f, k in enumerate(model.mech.independent):
        state[f] = data.qpos[plant.model.joint(names[k]).qposadr[0]]
    for i, gear in enumerate(model.gear):
        if gear >= 0:
            state[n + gear] = data.qpos[plant.drive_qpos[i]]
    sp.act[:] = data.act[: len(sp.act)]
    store_activations(model, sp, state)
    return state


def _require_equal_structure(models: list[Model], channels: tuple[str, ...]) -> None:
    """Raise InputError for delayed sensors, or if models differ in more than the arrays in `PARAMETERS`."""
    for model in models:
        late = [c for c, lag, slow in zip(channels, model.lag, model.time_constant, strict=True) if lag or slow]
        if late:
            raise InputError("batch", f"cannot simulate the delay of sensors {', '.join(late)}; omit these channels")
        for one, other in ((models[0], model), (models[0].mech, model.mech)):
            for name, value, second in zip(one._fields, one, other, strict=True):
                if name not in (*PARAMETERS, "mech") and not np.array_equal(np.asarray(value), np.asarray(second)):
                    raise InputError("batch", f"variants of the machine must have the same {name}")


def _stack_models(models: list[Model], count: int) -> Model:
    """Return a model whose parameters have a leading dimension: 1, or m where the variants differ."""
    places = np.arange(count) % len(models)

    def stack(values: list[np.ndarray]) -> np.ndarray:
        if all(np.array_equal(v, values[0]) for v in values):
            return np.array(values[:1])
        return np.array(values)[places]

    names = [n for n in PARAMETERS if n not in _MECHANISM_PARAMETERS]
    mech = models[0].mech._replace(**{n: stack([getattr(m.mech, n) for m in models]) for n in _MECHANISM_PARAMETERS})
    return models[0]._replace(mech=mech, **{n: stack([getattr(m, n) for m in models]) for n in names})


def _make_timing(model: Model, period: float, timestep: float, rate_limit: float) -> Timing:
    steps = round(period / timestep)
    if steps < 1 or abs(steps * timestep - period) > 1e-9 * period:
        raise InputError("batch", f"period {period:g} s must be a multiple of the time step {timestep:g} s")
    return Timing(period, steps, np.full(len(model.gear), rate_limit * period))


def _make_noise(machine: Machine, sensors: SensorSet | None, channels: tuple[str, ...], period: float) -> Noise:
    kinds: list[Sensor] = [find_channel_sensor(machine, sensors, channel) for channel in channels]
    converters = [make_channel_converter(kind, channel) for kind, channel in zip(kinds, channels, strict=True)]
    kept = [np.exp(-period / kind.correlation_time) if kind.correlation_time else 0.0 for kind in kinds]
    return Noise(
        np.array([kind.accuracy for kind in kinds], float),
        np.array([kind.standard_deviation for kind in kinds], float),
        np.array(kept, float),
        *np.array(converters, float).reshape(-1, 3).T.copy(),
    )


def _make_machines(models: list[Model], start: np.ndarray, count: int, timing: Timing, seed: int) -> Machines:
    """Allocate the state of all machines; machine i has start state i modulo their number."""
    channels, drives = len(models[0].kind), len(models[0].gear)
    linkage = []
    for k, state in enumerate(start):
        own = models[k % len(models)]
        sp = model_space(own)
        place(own, sp, state)
        linkage.append(np.zeros(sp.motion.joint.shape[1] + len(own.mech.dependent) * sp.motion.basis.shape[1]))
        store_linkage(own.mech.dependent, sp.motion.joint, sp.motion.basis, linkage[-1])
    rows, places = np.array(linkage), np.arange(count) % len(start)
    delay = max(own.delay.max(initial=0.0) for own in models)
    history = 1 + int(np.ceil(delay / timing.period - 1e-9))
    return Machines(
        state=start[places], linkage=rows[places], history=np.zeros((count, history, drives)),
        command=np.zeros((count, drives)), reading=np.zeros((count, channels)), error=np.zeros((count, channels)),
        period_count=np.zeros(count, np.int64), sample_count=np.zeros(count, np.int64),
        seed=np.random.SeedSequence(seed).generate_state(count, np.uint64), failed=np.zeros(count, np.uint8),
        start=start, start_linkage=rows,
    )  # fmt: skip


class _ThreadRunner:
    """Runs `machine_step.run_machines` by threads, each with its own work space."""

    def __init__(self, model: Model, code: MechanismCode, task: Task, threads: int) -> None:
        self._threads = threads or len(os.sched_getaffinity(0))
        self._lanes = [make_lanes(model, code, LANES) for _ in range(self._threads)]
        self._pool = ThreadPoolExecutor(self._threads) if self._threads > 1 else None
        self._function = make_batch_function(code, task)

    def run(self, model: Model, machines: Machines, noise: Noise, timing: Timing, arrays: Any, periods: int) -> None:
        """Advance all machines by some control periods."""
        ends = np.linspace(0, len(machines.state), self._threads + 1).astype(int)
        jobs = [
            (model, lanes, machines, noise, timing, arrays, periods, int(begin), int(end))
            for lanes, begin, end in zip(self._lanes, ends[:-1], ends[1:], strict=True)
        ]
        if self._pool is None:
            self._function(*jobs[0])
            return
        for done in [self._pool.submit(self._function, *job) for job in jobs]:
            done.result()

    def upload(self, record: Any) -> Any:
        """Return the arrays themselves."""
        return record

    def synchronise(self) -> None:
        """Return at once: `run` waits for its threads."""

    def assign(self, array: np.ndarray, values: Any) -> None:
        """Copy values into an array."""
        array[...] = values

    def assign_rows(self, array: np.ndarray, rows: np.ndarray, values: Any) -> None:
        """Copy values into some rows of an array."""
        array[rows] = values

    def read(self, array: np.ndarray) -> np.ndarray:
        """Return an array in the memory of the CPU."""
        return array

    def repeat(self, values: np.ndarray, count: int) -> np.ndarray:
        """Return an array with one row, repeated."""
        return np.repeat(values[:1], count, axis=0)


def make_batch_function(code: MechanismCode, task: Task) -> Any:
    """Return `machine_step.run_machines` with the code of a mechanism and the functions of a task."""
    swapped = {
        getattr(machine_step, f"run_{name}"): make_program_function(
            getattr(code, name), LANES, compile_without_allocation, intrinsic
        )
        for name in PROGRAMS
    }
    swapped |= {machine_step.before_period: task.before, machine_step.after_period: task.after}
    names = repr([(f.py_func.__module__, f.py_func.__qualname__) for f in swapped.values()])
    digest = hashlib.sha256(names.encode()).hexdigest()[:16]

    def wrap(function: Any) -> Any:
        function.__module__ = task.after.py_func.__module__  # its cache depends on the task's source
        function.__qualname__ += f"_{digest}"
        return compile_without_allocation(function)

    return rebuild_function(machine_step.run_machines, wrap, swapped, copy_all=False)
