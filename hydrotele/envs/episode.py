"""Episode state and task parameters as C-like records, and the random generator of an episode.

Compiled functions receive both records and read their fields by name. In Python, `state["joint"]`
is an (n, MAX_AXES) array. The random generator is SplitMix64, with one 64-bit state per episode.
"""

import numpy as np

from hydrotele.core.compiled import compiled

MAX_AXES = 8  # maximum number of axes of a machine
MAX_ARM_AXES = 5  # maximum number of arm axes among them
MAX_CHANNELS = 4 * MAX_AXES  # sensors: positions, head and rod pressures of valves, supply pressures
GOAL_SIZE = 96  # values that a task stores per episode for its goal and progress
MAX_PARAMETERS = 64  # maximum number of task parameters
MAX_MEASURES = 8  # maximum number of task measures per step, reported in `info`

VALVE, JOINT_RATE, RESOLVED_MOTION = range(3)  # values of `mode`: kind of actions
ACTIONS = ("valve", "joint_rate", "resolved_motion")
NEXT_STEP, SAME_STEP, DISABLED = range(3)  # values of `autoreset`
STEP, RESET = range(2)  # values of `call`: purpose of the native call

_F, _I, _U = np.float64, np.int64, np.uint64

EPISODE_STATE = np.dtype(
    [
        ("random", _U),  # state of the episode's random generator
        ("variant", _I),  # index of the machine and start of this episode
        ("episode", _I),  # number of episodes started
        ("step", _I),  # environment steps since the start
        ("tick", _I),  # control periods since the start
        ("over", _I),  # whether the episode has ended
        ("fault", _I),  # whether the simulation became unstable
        ("faults", _I),  # total number of faults
        ("last_variant", _I),  # variant of the previous episode
        ("last_fault", _I),  # fault of the previous episode
        ("warnings", _I),  # total number of MuJoCo warnings
        ("saturated", _I),  # total number of observations outside their bounds
        ("position", _F, MAX_AXES),  # true axis positions [rad], [m]
        ("tip", _F, 3),  # true tip position in the world frame [m]
        ("joint", _F, MAX_AXES),  # measured axis positions [rad], [m]
        ("rate", _F, MAX_AXES),  # difference quotients of the measured positions [rad/s], [m/s]
        ("head", _F, MAX_AXES),  # measured head-side pressures [Pa]
        ("rod", _F, MAX_AXES),  # measured rod-side pressures [Pa]
        ("supply", _F, MAX_AXES),  # measured pressures of the supplies [Pa]
        ("error", _F, MAX_CHANNELS),  # random errors of the current sample
        ("reference", _F, MAX_AXES),  # reference axis positions [rad], [m]
        ("reference_rate", _F, MAX_AXES),  # reference axis rates [rad/s], [m/s]
        ("sampled_reference", _F, MAX_AXES),  # references at the time of the last sensor sample
        (
            "pose",
            _F,
            MAX_ARM_AXES,
        ),  # pose of the references: r [m], theta, z [m], attitude, head [rad]
        ("pose_rate", _F, MAX_ARM_AXES),  # [m/s], [rad/s]
        ("blocked", _I),  # whether the arm is at the edge of its workspace
        ("load", _F, MAX_AXES),  # low-pass filtered drive forces [N], [N m]
        ("command", _F, MAX_AXES),  # valve and drive commands [1], or in the drive's unit
        ("drive", _F, (4, MAX_AXES)),  # reference drive velocity, moment arm, two chamber volumes
        ("work", _F),  # positive work of the hydraulic drives on the mechanism since the start [J]
        ("potential", _F),  # potential of the current state, 0 without shaping
        ("goal", _F, GOAL_SIZE),  # values of the task
    ],
    align=True,
)
"""State of one episode."""

TASK_PARAMETERS = np.dtype(
    [
        ("call", _I),
        ("count", _I),
        ("mode", _I),
        ("autoreset", _I),
        ("axes", _I),  # number of actuators k
        ("hydraulic", _I),  # number of actuators with valves, which come first
        ("supplies", _I),  # number of supplies with a measured pressure
        ("arm_axes", _I),  # number of arm axes, which come first
        ("actions", _I),  # number of actions, one per driven axis or tip coordinate
        ("observations", _I),
        ("with_readings", _I),  # whether the observation starts with the readings of the machine
        ("horizon", _I),  # steps per episode
        ("ticks", _I),  # control periods per step
        ("substeps", _I),  # physics steps per control period
        ("every", _I),  # control periods per sensor sample
        ("noisy", _I),  # whether the sensors have random errors
        ("timestep", _F),  # physics step [s]
        ("period", _F),  # control period [s]
        ("acceleration", _F),  # acceleration limit of joint references [rad/s^2], [m/s^2]
        ("axes_driven", _I),  # number of driven axes
        ("driven_axis", _I, MAX_AXES),  # indices of the driven axes; arm axes come first
        ("locked", _I),  # index of the action without effect, -1 for none
        ("qpos", _I, MAX_AXES),  # index of every axis in mjData.qpos
        ("dof", _I, MAX_AXES),  # index of every axis in mjData.qvel
        ("nq", _I),
        ("nv", _I),
        ("na", _I),
        ("nbody", _I),
        ("neq", _I),  # number of equality constraints
        ("eq_width", _I),  # number of data values per equality constraint
        ("tip_site", _I),
        ("tip_body", _I),
        ("closed", _I, MAX_AXES),  # whether the servo controls the axis
        ("fastest", _F, MAX_AXES),  # axis rates at full action [rad/s], [m/s]
        ("fastest_pose", _F, MAX_ARM_AXES),  # pose rates at full action [m/s], [rad/s]
        ("accelerations", _F, MAX_ARM_AXES),  # acceleration limits of the pose [m/s^2], [rad/s^2]
        ("limit", _F, MAX_AXES),  # commands at full action [1], or in the drive's unit
        ("arm", _F, 9),  # see kinematics.task_space.arm_parameters
        ("ranges", _F, (MAX_AXES, 2)),  # joint ranges of the axes [rad], [m]
        ("servo", _F, (MAX_AXES, 15)),  # see control.servo.servo_parameters
        ("feedforward", _F),
        ("grid", _F, (MAX_AXES, 2)),  # see control.servo.tabulate_drive_geometry
        ("accuracy", _F, MAX_CHANNELS),  # bound of the uniform random error of every sensor
        ("converters", _F, (3, MAX_CHANNELS)),  # see machine.sensors.make_channel_converter
        ("parameters", _F, MAX_PARAMETERS),  # task parameters
        ("shaping", _F),  # discount factor of the potential-based shaping, 0 without shaping
        ("difficulty", _F),  # size of the goals of new episodes, 1 for those of the task
        ("delayed_command", _I),  # control periods in the command ring buffer, 0 without delays
        ("delayed_sensor", _I),  # physics steps in the sensor ring buffer, 0 without delays
        ("variants", _I),
        ("states", _I),  # length of a state
        ("fields", _I),  # number of model fields that differ between variants
        ("width", _I),  # values of the terrain per episode, 0 without terrain
        # addresses
        ("episodes", _I),
        ("action", _I),  # (n, actions) float32
        ("observation", _I),  # (n, observations) float32
        ("final", _I),  # (n, observations) float32, before an autoreset in the same step
        ("low", _I),  # (observations,) float32
        ("high", _I),
        ("reward", _I),  # (n,)
        ("terminated", _I),  # (n,) uint8
        ("truncated", _I),
        ("measures", _I),  # (n, MAX_MEASURES)
        ("final_measures", _I),  # (n, MAX_MEASURES) before an autoreset in the same step
        ("table", _I),  # (k, TABLE_POINTS, 3) of control.servo.tabulate_drive_geometry
        ("starts", _I),  # (v, states)
        ("start_tips", _I),  # (v, 3)
        ("users", _I),  # (v, k SLOT_COUNT) actuator parameters
        ("scales", _I),  # (v, MAX_CHANNELS) sensor scale factors
        ("offsets", _I),  # (v, MAX_CHANNELS) sensor offsets
        ("lags", _I),  # (v, MAX_CHANNELS, 2) sensor delays: whole physics steps, fraction of a step
        ("ratios", _I),  # (v, MAX_CHANNELS) physics step divided by the sensor time constant
        ("delays", _I),  # (v, MAX_AXES, 2) command delays: whole physics steps, fraction of a step
        ("commands", _I),  # (n, delayed_command, MAX_AXES) ring buffer
        ("sensed", _I),  # (n, delayed_sensor, MAX_CHANNELS) ring buffer
        ("sensed_before", _I),  # (n, MAX_CHANNELS) true values after the last physics step
        ("places", _I),  # (fields, 3): address of all variants, address of all n, floats per row
        ("terrain", _I),  # (n, width)
        ("eq_rows", _I),  # (n, neq eq_width) equality data, 0 if no task writes them
        ("task", _I),  # address of the task's native code, see envs.task_parameters.TASK_CODES
        ("mj_step", _I),
        ("mj_set_state", _I),
        # offsets of members in mjData and mjModel [byte]
        ("at_qpos", _I),
        ("at_qvel", _I),
        ("at_act", _I),
        ("at_ctrl", _I),
        ("at_site", _I),
        ("at_xfrc", _I),
        ("at_xpos", _I),
        ("at_xipos", _I),
        ("at_xquat", _I),
        ("at_xmat", _I),
        ("at_warning", _I),
        ("at_eq_active", _I),
        ("at_eq_data", _I),
        ("at_stiffness", _I),
        ("at_damping", _I),
        ("at_sensordata", _I),
    ],
    align=True,
)
"""Parameters that all episodes of a task have in common."""


_INCREMENT = np.uint64(0x9E3779B97F4A7C15)
_MULTIPLIER_1 = np.uint64(0xBF58476D1CE4E5B9)
_MULTIPLIER_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31, _SHIFT_11 = (
    np.uint64(30),
    np.uint64(27),
    np.uint64(31),
    np.uint64(11),
)
_UNIT_SCALE = 2.0**-53


@compiled
def mix64(z):
    """Return a 64-bit integer, scalar, with its bits mixed by the SplitMix64 finaliser."""
    z = (z ^ (z >> _SHIFT_30)) * _MULTIPLIER_1
    z = (z ^ (z >> _SHIFT_27)) * _MULTIPLIER_2
    return z ^ (z >> _SHIFT_31)


@compiled
def arm_values(f, values, out):
    """Return the values (k,) of the axes of the arm.

    Args:
        f: record of TASK_PARAMETERS.
        values: (>= axes,) of all axes.
        out: (k,) written.

    Returns:
        `out`: values of the axes of the arm, from the swing outwards.

    Source: the order of axes follows the pumps, see `actuator_layout.actuator_order`.
    """
    for a in range(f.arm_axes):
        out[a] = values[f.driven_axis[a]]
    return out


@compiled
def draw_uniform(e):
    """Draw a random number, uniform in [0, 1), from the generator of an episode.

    Args:
        e: record of EPISODE_STATE; `random` is advanced.

    Returns:
        The number, scalar [1].

    Source: SplitMix64.

    Examples:
        The same seed gives the same numbers, in Python and in compiled code.

        >>> import numpy as np
        >>> import hydrotele as ht
        >>> def draw(seed, count):
        ...     episode = np.zeros(1, EPISODE_STATE)
        ...     episode["random"] = make_seed_states(np.array([seed]))
        ...     generator = episode[0].view(np.recarray)
        ...     return np.array([ht.draw_uniform(generator) for _ in range(count)])
        >>> numbers = draw(7, 1000)
        >>> float(numbers.mean().round(2)), float(numbers.std().round(2))  # 1 / 2 and 1 / sqrt(12)
        (0.51, 0.29)
        >>> bool((draw(7, 1000) == numbers).all())
        True
    """
    e.random += _INCREMENT
    return (mix64(e.random) >> _SHIFT_11) * _UNIT_SCALE


@compiled
def draw_uniform_between(e, low, high):
    """Draw a random number, uniform from `low` to `high`, from the generator of an episode.

    Args:
        e: record of EPISODE_STATE; `random` is advanced.
        low: scalar.
        high: scalar.

    Returns:
        The number, scalar.

    Source: SplitMix64.

    Examples:
        >>> import numpy as np
        >>> import hydrotele as ht
        >>> generator = np.zeros(1, EPISODE_STATE)[0].view(np.recarray)
        >>> goals = [ht.draw_uniform_between(generator, 0.05, 0.45) for _ in range(1000)]
        >>> round(min(goals), 3), round(float(np.mean(goals)), 2), round(max(goals), 3)
        (0.05, 0.25, 0.449)
    """
    return low + (high - low) * draw_uniform(e)


def make_seed_states(seeds: np.ndarray) -> np.ndarray:
    """Return the initial generator states of a list of seeds.

    Args:
        seeds: (n,) integers from 0 to 2^64 - 1.

    Returns:
        (n,) values of `random` in EPISODE_STATE; consecutive seeds give unrelated streams.

    Raises:
        ValueError: a seed is not an integer from 0 to 2^64 - 1.
    """
    seeds = np.asarray(seeds)
    if seeds.dtype.kind not in "iu" or (seeds < 0).any():
        raise ValueError("a seed must be an integer from 0 to 2^64 - 1")
    with np.errstate(over="ignore"):
        return mix64.py_func(np.asarray(seeds, np.uint64) * _INCREMENT + _MULTIPLIER_2)
