"""Build the record of parameters that native code reads: clocks, machine, servo, sensors, MuJoCo layout.

`TASK_CODES` maps the kind of a task to its native code. Each kind is a separate module and compiles
separately.
"""

import numpy as np

from hydrotele.control.arm_kinematics import arm_specification
from hydrotele.control.servo import servo_parameters, tabulate_drive_geometry
from hydrotele.core.compiled import Callback
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.envs import grade, hold_force, load_truck, place_log, reach_feller, straight_line, track_trajectory
from hydrotele.envs.episode import ACTIONS, TASK_PARAMETERS, VALVE
from hydrotele.envs.task import REAL_SENSORS
from hydrotele.envs.task_setup import MAX_ACCELERATION, MAX_POSE_ACCELERATIONS, TaskSetup, full_action_rate
from hydrotele.envs.variants import sensor_channels
from hydrotele.machine.machine import find_channel_sensor, get_sensor_set
from hydrotele.machine.sensors import SensorSet, make_channel_converter
from hydrotele.simulate.mechanism import TIP_SITE
from hydrotele.simulate.mujoco_c_api import field_offsets, function_address, verify_struct_offsets
from hydrotele.simulate.sensor_models import periods_per_sample

TASK_CODES: dict[str, Callback] = {
    "track": track_trajectory.run_task_part, "line": straight_line.run_task_part, "force": hold_force.run_task_part,
    "reach": reach_feller.run_task_part, "grade": grade.run_task_part, "place": place_log.run_task_part,
    "load": load_truck.run_task_part,
}  # fmt: skip
"""Kind of task -> its native code, see `task_interface.TASK_SIGNATURE`."""


def make_task_parameters(setup: TaskSetup, count: int, autoreset: int) -> np.ndarray:
    """Return the TASK_PARAMETERS record of a task, without the addresses of the arrays that `TaskCore` allocates.

    Args:
        setup: the task with its options.
        count: number of environments.
        autoreset: when an episode that ended is restarted: NEXT_STEP, SAME_STEP or DISABLED.

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
    if options.action != "valve" and (pumped := [name for name in setup.axes if setup.machine.axes[name].pump]):
        message = f"the servo does not control {pumped[0]}, which has its own pump; choose valve"
        raise InputError(f"action {options.action!r}", message)
    if options.action == "resolved_motion" and not setup.arm_axes:
        raise InputError("action 'resolved_motion'", f"{setup.machine.name} has no arm; choose valve or joint_rate")
    code = task.code or TASK_CODES[task.kind]
    facts["task"], facts["mode"] = code.address, ACTIONS.index(options.action)
    facts["autoreset"], facts["count"] = autoreset, count
    clock = setup.clock
    facts["ticks"], facts["substeps"], facts["period"], facts["horizon"] = clock[:2] + clock[2:]
    facts["timestep"], facts["acceleration"] = options.timestep, MAX_ACCELERATION
    facts["shaping"], facts["difficulty"] = options.shaping, options.difficulty
    facts["axes"], facts["hydraulic"] = len(plant.axes), plant.hydraulic
    facts["supplies"] = len(plant.machine.supply_channels)
    facts["arm_axes"], facts["axes_driven"] = setup.arm_axes, len(setup.axes)
    facts["actions"], facts["observations"] = len(setup.axes), len(setup.fields)
    facts["with_readings"] = task.with_readings
    columns = [plant.axes.index(name) for name in setup.axes]
    facts["driven_axis"][: len(columns)] = columns
    k, model = len(plant.axes), plant.model
    facts["qpos"][:k], facts["dof"][:k] = plant.qpos, plant.dof
    facts["nq"], facts["nv"], facts["na"] = model.nq, model.nv, model.na
    facts["nbody"], facts["tip_site"] = model.nbody, -1
    if setup.arm_axes:
        facts["tip_site"], facts["tip_body"] = model.site(TIP_SITE).id, model.site(TIP_SITE).bodyid[0]
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
    if setup.arm_axes:
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
    """Write the byte offsets of members of mjData and mjModel and the addresses of MuJoCo functions to `facts`.

    MuJoCo's memory layout is verified first.
    """
    verify_struct_offsets()
    facts["mj_step"] = function_address("mj_step")
    facts["mj_set_state"] = function_address("mj_setState")
    data, model = field_offsets("mjData"), field_offsets("mjModel")
    for name, member in (
        ("at_qpos", "qpos"), ("at_qvel", "qvel"), ("at_act", "act"), ("at_ctrl", "ctrl"),
        ("at_site", "site_xpos"), ("at_xfrc", "xfrc_applied"), ("at_xpos", "xpos"),
        ("at_xipos", "xipos"), ("at_xquat", "xquat"), ("at_xmat", "xmat"),
        ("at_warning", "warning"), ("at_eq_active", "eq_active"), ("at_sensordata", "sensordata"),
    ):  # fmt: skip
        facts[name] = data[member]
    for name, member in (
        ("at_eq_data", "eq_data"), ("at_stiffness", "jnt_stiffness"),
        ("at_damping", "dof_damping"),
    ):  # fmt: skip
        facts[name] = model[member]
