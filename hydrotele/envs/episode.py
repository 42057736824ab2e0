"""State of an episode and parameters of a task as C-like records; random numbers of an episode.

Compiled functions get both records and read their fields by name; from Python, `state["joint"]` is
an (n, AXES) array.
"""

import numpy as np

from hydrotele.core.compiled import compiled

AXES = 8  # axes of a machine at most
ARM = 5  # of them those of the arm
CHANNELS = 3 * AXES + 1  # sensors: positions, then head and rod of every valve, then the supply
GOAL = 96  # numbers that a task keeps of its goal and its course
PARAMETERS = 64  # parameters of a task at most
MEASURES = 8  # figures of a step that a task tells in `info`

VALVE, JOINT_RATE, RESOLVED_MOTION = range(3)  # Facts.mode: what actions are
ACTIONS = ("valve", "joint_rate", "resolved_motion")
NEXT_STEP, SAME_STEP, DISABLED = range(3)  # Facts.autoreset
STEP, RESET = range(2)  # Facts.call: what the native function is called for

_F, _I, _U = np.float64, np.int64, np.uint64

EPISODE_STATE = np.dtype(
    [
        ("random", _U),  # state of the episode's own random numbers
        ("variant", _I),  # machine and start that this episode has
        ("episode", _I),  # number of episodes begun
        ("step", _I),  # environment steps since the start
        ("tick", _I),  # control periods since the start
        ("over", _I),  # whether the episode has ended
        ("fault", _I),  # whether the simulation became unstable
        ("faults", _I),  # how often it did, since the beginning
        ("last_variant", _I),  # of the episode before
        ("last_fault", _I),
        ("warnings", _I),  # of MuJoCo, since the beginning
        ("saturated", _I),  # observations that lay outside their bounds, since the beginning
        ("position", _F, AXES),  # true axis positions [rad], [m]
        ("tip", _F, 3),  # true place of the tip [m], world frame
        ("joint", _F, AXES),  # axis positions as read [rad], [m]
        ("rate", _F, AXES),  # difference quotients of the readings [rad/s], [m/s]
        ("head", _F, AXES),  # head-side pressures as read [Pa]
        ("rod", _F, AXES),  # rod-side pressures as read [Pa]
        ("supply", _F),  # supply pressure as read [Pa]
        ("error", _F, CHANNELS),  # random errors of this reading
        ("reference", _F, AXES),  # axis positions asked for [rad], [m]
        ("reference_rate", _F, AXES),  # their rates [rad/s], [m/s]
        ("sampled_reference", _F, AXES),  # references when the sensors read
        ("pose", _F, ARM),  # of the references: r [m], theta [rad], z [m], attitude, head [rad]
        ("pose_rate", _F, ARM),  # [m/s], [rad/s]
        ("blocked", _I),  # whether the arm stands at the edge of its workspace
        ("load", _F, AXES),  # slow mean of the drive forces [N], [N m]
        ("command", _F, AXES),  # to valves and drives [1], or in the drive's unit
        ("drive", _F, (4, AXES)),  # wanted drive velocity, moment arm, chamber volumes
        ("goal", _F, GOAL),  # the task's own
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
        ("hydraulic", _I),  # of them those with valves, which come first
        ("arm_axes", _I),  # of them those of the arm, which come first
        ("actions", _I),  # one for every driven axis, or for every coordinate of the arm and axis
        ("observations", _I),
        ("horizon", _I),  # steps of an episode
        ("ticks", _I),  # control periods per step
        ("substeps", _I),  # physics steps per control period
        ("every", _I),  # control periods per reading of the sensors
        ("noisy", _I),
        ("timestep", _F),  # of the physics [s]
        ("period", _F),  # of the control [s]
        ("acceleration", _F),  # of joint rates at most [rad/s^2], [m/s^2]
        ("axes_driven", _I),
        ("driven_axis", _I, AXES),  # axes that actions move; those of the arm come first
        ("locked", _I),  # action that does nothing, -1 without
        ("qpos", _I, AXES),  # place of every axis' joint
        ("dof", _I, AXES),
        ("nq", _I),
        ("nv", _I),
        ("na", _I),
        ("nbody", _I),
        ("neq", _I),  # equalities of the model
        ("eq_width", _I),  # numbers of each
        ("tip_site", _I),
        ("tip_body", _I),
        ("closed", _I, AXES),  # whether the servo drives the axis
        ("fastest", _F, AXES),  # rates at full action [rad/s], [m/s]
        ("fastest_pose", _F, ARM),  # the same of the pose [m/s], [rad/s]
        ("accelerations", _F, ARM),  # of the pose [m/s^2], [rad/s^2]
        ("limit", _F, AXES),  # commands at full action [1], or in the drive's unit
        ("arm", _F, 9),  # of kinematics.task.arm_parameters
        ("ranges", _F, (AXES, 2)),  # of the axes [rad], [m]
        ("servo", _F, (AXES, 14)),  # of control.servo.servo_parameters
        ("feedforward", _F),
        ("grid", _F, (AXES, 2)),  # of control.servo.drive_tables
        ("accuracy", _F, CHANNELS),
        ("converters", _F, (3, CHANNELS)),
        ("parameters", _F, PARAMETERS),  # of the task
        ("delayed_command", _I),  # control ticks in the ring of commands, 0 without delays
        ("delayed_sensor", _I),  # physics steps in the ring of sensed values, 0 where none is late
        ("variants", _I),
        ("states", _I),  # length of a state
        ("fields", _I),  # number of fields of the model that differ between variants
        ("width", _I),  # of the terrain of an episode, 0 without
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
        ("measures", _I),  # (n, MEASURES)
        ("final_measures", _I),  # (n, MEASURES) before an autoreset in the same step
        ("table", _I),  # (k, POINTS, 3) of control.servo.drive_tables
        ("starts", _I),  # (v, states)
        ("start_tips", _I),  # (v, 3)
        ("users", _I),  # (v, k SLOTS) numbers of the actuators
        ("scales", _I),  # (v, CHANNELS) of the sensors
        ("offsets", _I),
        ("lags", _I),  # (v, CHANNELS, 2) delays of the sensors: whole physics steps, rest of a step
        ("ratios", _I),  # (v, CHANNELS) a physics step over the time constant of a sensor's lag
        ("delays", _I),  # (v, AXES, 2) of the commands: whole physics steps, rest of a step
        ("commands", _I),  # (n, delayed_command, AXES) ring
        ("sensed", _I),  # (n, delayed_sensor, CHANNELS) ring
        ("sensed_before", _I),  # (n, CHANNELS) true values after the last physics step
        ("places", _I),  # (fields, 3): address for all variants, address for all n, floats in each
        ("terrain", _I),  # (n, width)
        ("eq_rows", _I),  # (n, neq eq_width) of every simulation, 0 where no task writes them
        ("task", _I),  # its native code, see `world`
        ("mj_step", _I),
        ("mj_set_state", _I),
        # where mjData and mjModel keep their members [byte]
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
    ],
    align=True,
)
"""What all episodes share."""


_STEP = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_UNIT = 2.0**-53


@compiled
def mix64(z):
    """A 64-bit integer, scalar, of which every bit depends on every bit of `z`, scalar."""
    z = (z ^ (z >> _30)) * _FIRST
    z = (z ^ (z >> _27)) * _SECOND
    return z ^ (z >> _31)


@compiled
def uniform(e):
    """A number of an episode, uniform in [0, 1), scalar; its `random` goes on.

    Args:
        e: its record of EPISODE_STATE.

    Returns:
        The number, scalar [1].

    Source: see the module.
    """
    e.random += _STEP
    return (mix64(e.random) >> _11) * _UNIT


@compiled
def uniform_between(e, low, high):
    """A number of an episode, uniform from `low` to `high`, scalars.

    Args:
        e: its record of EPISODE_STATE.
        low: scalar.
        high: scalar.

    Returns:
        The number, scalar.

    Source: see the module.
    """
    return low + (high - low) * uniform(e)


def seed_streams(seeds: np.ndarray) -> np.ndarray:
    """Where the streams of seeds begin.

    Args:
        seeds: (n,) integers >= 0.

    Returns:
        (n,) values of `random`; seeds that follow each other give unrelated streams.

    Raises:
        ValueError: a seed is no integer from 0 to 2^64 - 1.
    """
    seeds = np.asarray(seeds)
    if seeds.dtype.kind not in "iu" or (seeds < 0).any():
        raise ValueError("a seed must be an integer from 0 to 2^64 - 1")
    with np.errstate(over="ignore"):
        return mix64.py_func(np.asarray(seeds, np.uint64) * _STEP + _SECOND)
