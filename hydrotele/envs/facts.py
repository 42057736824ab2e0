"""Build the parameter record of native code: clocks, machine, servo, sensors, MuJoCo layout.

`TASK_CODES` maps the kind of a task to its native code. Each kind is a separate module and compiles
separately.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.control.resolved_motion import arm_specification
from hydrotele.control.servo import servo_parameters, tabulate_drive_geometry
from hydrotele.core.compiled import Callback
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.envs import force, grade, line, place, reach, track
from hydrotele.envs.episode import ACTIONS, TASK_PARAMETERS, VALVE
from hydrotele.envs.task import REAL_SENSORS, Options, Task
from hydrotele.envs.variants import Variants, sensor_channels
from hydrotele.envs.world import ObservationField
from hydrotele.kinematics.from_machine import axis_linkage
from hydrotele.machine.machine import (
    Machine,
    SensorSet,
    find_channel_sensor,
    get_sensor_set,
    make_channel_converter,
)
from hydrotele.simulate.feedback import periods_per_sample
from hydrotele.simulate.layout import field_offsets, function_address, verify_struct_offsets
from hydrotele.simulate.mechanism import TIP_SITE

TASK_CODES: dict[str, Callback] = {
    "track": track.run_task_part, "line": line.run_task_part, "force": force.run_task_part,
    "reach": reach.run_task_part, "grade": grade.run_task_part, "place": place.run_task_part,
}  # fmt: skip
"""Kind of task -> its native code, see `world`."""


_MIN_CONTROL_RATE = 200.0  # Hz, minimum control rate of the servo
_FULL_RATE_FRACTION = 0.8  # fraction of the speed at rated or pump flow that a full action commands
_FORCE_DRIVE_RATE = 0.5  # rad/s or m/s, rate of a force drive at full action
MAX_ACCELERATION = 1.0  # rad/s^2 or m/s^2, limit of the joint references
MAX_POSE_ACCELERATIONS = (1.0, 0.5, 1.0, 1.0, 0.8)  # m/s^2, rad/s^2, limits of the pose reference


class Timing(NamedTuple):
    """Clocks of an environment.

    Attributes:
        ticks: control periods per environment step.
        substeps: physics steps per control period.
        period: control period [s].
        horizon: environment steps per episode.
    """

    ticks: int
    substeps: int
    period: float
    horizon: int


class TaskSetup(NamedTuple):
    """A task with its options.

    Attributes:
        task: the task.
        options: the user's options with all defaults filled in.
        clock: clocks of the environment.
        machine: the machine without added or randomised effects, as a controller knows it.
        axes: driven axes in the order of the actions (`valve`, `joint_rate`).
        arm_axes: number of arm axes, which come first in `axes`.
        variants: machines and starts of the episodes.
        fields: fields of the observation.
        drive_table: (k, TABLE_POINTS, 3) of `control.servo.tabulate_drive_geometry`.
    """

    task: Task
    options: Options
    clock: Timing
    machine: Machine
    axes: tuple[str, ...]
    arm_axes: int
    variants: Variants
    fields: list[ObservationField]
    drive_table: np.ndarray


def make_timing(options: Options) -> Timing:
    """Return the clocks for the given options.

    Raises:
        InputError: a rate is out of range, or the control period is not a whole number of physics
            steps.
    """
    rate, step = options.control_rate, options.timestep
    if not (0.0 < rate <= 1.0e4 and 1.0e-5 <= step <= 5.0e-3):
        message = (
            f"{rate:g} Hz with a physics step of {step:g} s is out of range: at most 10000 Hz, and"
            " a physics step from 1e-05 to 0.005 s"
        )
        raise InputError("control_rate", message)
    ticks = max(1, round(_MIN_CONTROL_RATE / rate))
    substeps = 1.0 / (rate * ticks * step)
    if substeps < 0.999 or abs(substeps - round(substeps)) > 1e-6:
        message = f"{rate:g} Hz needs a control period of whole physics steps of {step:g} s; use for example 50 or 200"
        raise InputError("control_rate", message)
    assert options.duration is not None
    horizon = round(options.duration * rate)
    if horizon < 1:
        raise InputError("duration", f"{options.duration:g} s is shorter than one step")
    return Timing(ticks, round(substeps), round(substeps) * step, horizon)


def make_task_parameters(setup: TaskSetup, count: int, autoreset: int) -> np.ndarray:
    """Return the TASK_PARAMETERS record of a task, without the addresses of arrays.

    Args:
        setup: the task with its options.
        count: number of environments.
        autoreset: NEXT_STEP, SAME_STEP or DISABLED.

    Returns:
        () record.

    Raises:
        InputError: the kind of actions or the sensors do not exist.
        RuntimeError: the memory layout of MuJoCo's structs is not the expected one.
    """
    facts = np.zeros((), TASK_PARAMETERS)
    task, options, plant = setup.task, setup.options, setup.variants.plant
    if options.action not in ACTIONS:
        raise InputError(f"action {options.action!r}", suggest_valid_name(options.action, ACTIONS))
    facts["task"], facts["mode"] = TASK_CODES[task.kind].address, ACTIONS.index(options.action)
    facts["autoreset"], facts["count"] = autoreset, count
    clock = setup.clock
    facts["ticks"], facts["substeps"], facts["period"], facts["horizon"] = clock[:2] + clock[2:]
    facts["timestep"], facts["acceleration"] = options.timestep, MAX_ACCELERATION
    facts["axes"], facts["hydraulic"] = len(plant.axes), plant.hydraulic
    facts["arm_axes"], facts["axes_driven"] = setup.arm_axes, len(setup.axes)
    facts["actions"], facts["observations"] = len(setup.axes), len(setup.fields)
    columns = [plant.axes.index(name) for name in setup.axes]
    if columns[: setup.arm_axes] != list(range(setup.arm_axes)):
        raise InputError(f"machine {task.machine}", "the axes of its arm must come first")
    facts["driven_axis"][: len(columns)] = columns
    k, model = len(plant.axes), plant.model
    facts["qpos"][:k], facts["dof"][:k] = plant.qpos, plant.dof
    facts["nq"], facts["nv"], facts["na"] = model.nq, model.nv, model.na
    facts["nbody"], facts["tip_site"] = model.nbody, model.site(TIP_SITE).id
    facts["tip_body"] = model.site(TIP_SITE).bodyid[0]
    theta = 1 if options.action == "resolved_motion" else 0  # index of the swing action
    facts["locked"] = theta if task.swing_locked else -1
    facts["neq"], facts["eq_width"] = model.eq_data.shape
    facts["variants"], facts["states"] = setup.variants.states.shape
    facts["width"] = task.terrain_size
    if task.parameters:
        numbers = task.parameters(setup.machine, model)
        facts["parameters"][: len(numbers)] = numbers
    _write_machine_parameters(facts, setup, columns)
    _write_sensor_parameters(facts, setup)
    _write_memory_layout(facts)
    return facts


def full_action_rate(machine: Machine, axis: str) -> float:
    """Return the rate of an axis at full action, which its drive reaches in its whole range.

    Args:
        machine: the machine.
        axis: name of the axis.

    Returns:
        The rate [rad/s] or [m/s]: 0.8 times the smaller of rated valve flow and pump flow, divided by the
        head-side area and the largest moment arm; 0.5 for an axis without a valve.
    """
    facts = machine.axes[axis]
    low, high = machine.joints[facts.joint].range or (-1.0, 1.0)
    if not (facts.valve and machine.supply):
        return _FORCE_DRIVE_RATE
    arm = np.abs(axis_linkage(machine, axis).rate(np.linspace(low, high, 101))).max()
    flow = min(facts.valve.rated_flow, machine.supply.pump_flow)
    return _FULL_RATE_FRACTION * flow / facts.hydraulic_drive.effective_areas[0] / float(arm)


def _write_machine_parameters(facts: np.ndarray, setup: TaskSetup, columns: list[int]) -> None:
    plant, machine = setup.variants.plant, setup.machine
    k, servo = len(plant.axes), setup.task.servo
    facts["limit"][:k] = [drive.command_limit if (drive := machine.axes[name].force) else 1.0 for name in plant.axes]
    facts["fastest"][:k] = [full_action_rate(machine, name) for name in plant.axes]
    facts["fastest_pose"] = setup.task.pose_rates
    facts["accelerations"] = MAX_POSE_ACCELERATIONS
    facts["closed"][columns] = int(facts["mode"]) != VALVE
    ranges = [machine.joints[machine.axes[name].joint].range for name in plant.axes]
    facts["ranges"][:k] = [limits or (-np.inf, np.inf) for limits in ranges]
    facts["arm"] = arm_specification(machine)[0]
    facts["servo"][:k] = servo_parameters(machine, plant.axes, servo, setup.clock.period)
    facts["feedforward"] = servo.feedforward
    facts["grid"][:k] = tabulate_drive_geometry(machine, plant.axes)[0]
    facts["table"] = setup.drive_table.ctypes.data


def _write_sensor_parameters(facts: np.ndarray, setup: TaskSetup) -> None:
    plant, machine, clock = setup.variants.plant, setup.machine, setup.clock
    sensors: SensorSet | None
    if setup.options.sensors == REAL_SENSORS:
        if not machine.sensors:
            raise InputError("sensors 'real'", f"machine {machine.name} has no set of sensors")
        sensors = next(iter(machine.sensors.values()))
    else:
        sensors = get_sensor_set(machine, setup.options.sensors)
    facts["every"], facts["noisy"] = (
        periods_per_sample(1.0 / clock.period, sensors),
        sensors is not None,
    )
    for c, name in enumerate(sensor_channels(plant)):
        kind = find_channel_sensor(machine, sensors, name)
        facts["accuracy"][c] = kind.accuracy or 3**0.5 * kind.standard_deviation  # of equal RMS
        facts["converters"][:, c] = make_channel_converter(kind, name)


def _write_memory_layout(facts: np.ndarray) -> None:
    """Write the byte offsets of members of mjData and mjModel and the addresses of MuJoCo functions."""
    verify_struct_offsets()
    facts["mj_step"] = function_address("mj_step")
    facts["mj_set_state"] = function_address("mj_setState")
    data, model = field_offsets("mjData"), field_offsets("mjModel")
    for name, member in (
        ("at_qpos", "qpos"), ("at_qvel", "qvel"), ("at_act", "act"), ("at_ctrl", "ctrl"),
        ("at_site", "site_xpos"), ("at_xfrc", "xfrc_applied"), ("at_xpos", "xpos"),
        ("at_xipos", "xipos"), ("at_xquat", "xquat"), ("at_xmat", "xmat"),
        ("at_warning", "warning"), ("at_eq_active", "eq_active"),
    ):  # fmt: skip
        facts[name] = data[member]
    for name, member in (
        ("at_eq_data", "eq_data"), ("at_stiffness", "jnt_stiffness"),
        ("at_damping", "dof_damping"),
    ):  # fmt: skip
        facts[name] = model[member]
