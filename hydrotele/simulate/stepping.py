"""Native stepping of a plant with command delays, and values of sensors with delay and lag.

Scenario runs, replays and environments use the functions of this module. MuJoCo's actuator delay is
not used: the native hydraulics read `ctrl` directly, and MuJoCo rounds a delay to whole steps. Here
a command that changes within a step acts with its mean over the step, which is of second order. A
model that is stepped with `mj_step` alone has no delays.
"""
# pyright: reportCallIssue=false
# numba's intrinsics are called without their typing context.

from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.memory import address_record, float64_view, int64_view, matrix_view
from hydrotele.hydraulics.circuit import FEED, SCRATCH_SIZE, SLOT_COUNT, group_size, solve_state_supplies
from hydrotele.machine.machine import Machine
from hydrotele.machine.sensors import SensorError, step_first_order_lag
from hydrotele.simulate.mujoco_c_api import call_mj_step, function_address
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import sensed_channels, split_delay


class CommandDelayLine(NamedTuple):
    """Delay line of the commands to k valves and drives.

    Attributes:
        ring: (length, k or more) commands of the last control ticks [1], or in the drives' units;
            of length 0 without delays.
        delay: (k or more, 2) whole physics steps of every delay, and the remaining fraction of a
            step [1].
    """

    ring: np.ndarray
    delay: np.ndarray


class SensorHistory(NamedTuple):
    """Past values of c sensors after each of the last physics steps, before their delays.

    Attributes:
        ring: (length, c) values after the sensors' first-order lags [channel's unit]; of length 0
            if no sensor has a delay or lag.
        before: (c,) true values after the last step [channel's unit].
        delay: (c, 2) whole physics steps of every delay, and the remaining fraction of a step [1].
        ratio: (c,) step divided by the time constant of the lag [1]; 0 without lag.
    """

    ring: np.ndarray
    before: np.ndarray
    delay: np.ndarray
    ratio: np.ndarray


class Simulation(NamedTuple):
    """Data of a plant for compiled code; k axes, of which the h hydraulic ones come first.

    Attributes:
        mj_step: address of MuJoCo's `mj_step`.
        model: address of mjModel.
        data: address of mjData.
        qpos: (nq,) positions; staggered, see `simulate.record`.
        qvel: (nv,) velocities.
        act: (na,) activations.
        ctrl: (nu,) commands after their delays.
        timestep: physics step [s].
        axes: number of axes k.
        hydraulic: number of hydraulic axes h.
        joint_qpos: (k or more,) index of every axis' joint in `qpos`.
        joint_dof: (k or more,) the same in `qvel`.
        rod_qpos: (l,) indices in `qpos` of the cylinders with a length sensor.
        rod_dof: (l,) the same in `qvel`.
        user: (k SLOT_COUNT,) parameters of the actuators.
        command_line: delay line of the commands.
        sensor_history: past values of the sensors.
    """

    mj_step: int
    model: int
    data: int
    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    timestep: float
    axes: int
    hydraulic: int
    joint_qpos: np.ndarray
    joint_dof: np.ndarray
    rod_qpos: np.ndarray
    rod_dof: np.ndarray
    user: np.ndarray
    command_line: CommandDelayLine
    sensor_history: SensorHistory


_I = np.int64
SIMULATION_DTYPE = np.dtype(
    [(name, _I) for name in ("mj_step", "model", "data", "nq", "nv", "na", "nu")]
    + [("timestep", np.float64)]
    + [(name, _I) for name in ("axes", "hydraulic", "rods", "channels", "ticks", "back")]
    + [(name, _I) for name in ("qpos", "qvel", "act", "ctrl", "user")]  # addresses from here on
    + [(name, _I) for name in ("joint_qpos", "joint_dof", "rod_qpos", "rod_dof")]
    + [(name, _I) for name in ("line_ring", "line_delay")]
    + [(name, _I) for name in ("past_ring", "past_before", "past_delay", "past_ratio")],
    align=True,
)
"""Record type of a Simulation."""


def simulation_record(sim: Simulation) -> np.ndarray:
    """Pack a Simulation into a (1,) record of sizes and array addresses, which is fast to pass.

    The arrays must outlive the record. `unpack_simulation_record` unpacks it.
    """
    line, past = sim.command_line, sim.sensor_history
    record = address_record(
        SIMULATION_DTYPE,
        {
            "qpos": sim.qpos, "qvel": sim.qvel, "act": sim.act, "ctrl": sim.ctrl, "user": sim.user,
            "joint_qpos": sim.joint_qpos, "joint_dof": sim.joint_dof, "rod_qpos": sim.rod_qpos,
            "rod_dof": sim.rod_dof, "line_ring": line.ring, "line_delay": line.delay,
            "past_ring": past.ring, "past_before": past.before, "past_delay": past.delay,
            "past_ratio": past.ratio,
        },
    )  # fmt: skip
    for name, value in {
        "mj_step": sim.mj_step, "model": sim.model, "data": sim.data, "nq": len(sim.qpos),
        "nv": len(sim.qvel), "na": len(sim.act), "nu": len(sim.ctrl), "timestep": sim.timestep,
        "axes": sim.axes, "hydraulic": sim.hydraulic, "rods": len(sim.rod_qpos),
        "channels": len(past.before), "ticks": len(line.ring), "back": len(past.ring),
    }.items():  # fmt: skip
        record[name] = value
    return record


@compiled
def unpack_simulation_record(r):
    """Unpack a record of `simulation_record` to a Simulation whose arrays share its memory."""
    k, c = r.axes, r.channels
    line = CommandDelayLine(matrix_view(r.line_ring, r.ticks, k), matrix_view(r.line_delay, k, 2))
    past = SensorHistory(
        matrix_view(r.past_ring, r.back, c), float64_view(r.past_before, c), matrix_view(r.past_delay, c, 2),
        float64_view(r.past_ratio, c),
    )  # fmt: skip
    return Simulation(
        r.mj_step, r.model, r.data, float64_view(r.qpos, r.nq), float64_view(r.qvel, r.nv),
        float64_view(r.act, r.na), float64_view(r.ctrl, r.nu), r.timestep, k, r.hydraulic,
        int64_view(r.joint_qpos, k), int64_view(r.joint_dof, k), int64_view(r.rod_qpos, r.rods),
        int64_view(r.rod_dof, r.rods), float64_view(r.user, k * SLOT_COUNT), line, past,
    )  # fmt: skip


@compiled
def true_sensor_values(sim, out):
    """Compute the true values of the sensed channels, all at the time of the present chamber pressures.

    MuJoCo's positions are one step later than its activations (pressures); they are moved back by
    one step.

    Args:
        sim: Simulation.
        out: (c,) written: k joint positions [rad], [m], head and rod pressure of every hydraulic
            axis, pressure of every supply [Pa], l cylinder lengths [m].

    Returns:
        Nothing.

    Source: `simulate.record.align_staggered_positions` and `solve_state_supplies`.
    """
    k, h = sim.axes, sim.hydraulic
    for i in range(k):
        out[i] = sim.qpos[sim.joint_qpos[i]] - sim.timestep * sim.qvel[sim.joint_dof[i]]
    for i in range(h):
        out[k + 2 * i], out[k + 2 * i + 1] = sim.act[4 * i + 2], sim.act[4 * i + 3]
    at = k + 2 * h
    if h > 0:
        scratch, i = np.empty(SCRATCH_SIZE), 0
        solve_state_supplies(sim.user, 0, h, sim.act, scratch)
        while i < h:
            out[at] = scratch[FEED + i]
            i += group_size(sim.user, 0, h, i)
            at += 1
    for i in range(len(sim.rod_qpos)):
        out[at + i] = sim.qpos[sim.rod_qpos[i]] - sim.timestep * sim.qvel[sim.rod_dof[i]]


@compiled
def initialise_history(sim, command):
    """Fill the delay line of the commands and the history of the sensors with the current values.

    Args:
        sim: Simulation; its `command_line` and `sensor_history` are written.
        command: (nu,) commands before the first tick.

    Returns:
        Nothing.
    """
    for n in range(len(sim.command_line.ring)):
        for i in range(sim.axes):
            sim.command_line.ring[n, i] = command[i]
    if len(sim.sensor_history.ring) > 0:
        true_sensor_values(sim, sim.sensor_history.before)
        for n in range(len(sim.sensor_history.ring)):
            for c in range(len(sim.sensor_history.before)):
                sim.sensor_history.ring[n, c] = sim.sensor_history.before[c]


@compiled
def compute_delayed_step_commands(line, axes, tick, step, steps, out):
    """Compute the delayed commands that act in one physics step.

    Args:
        line: CommandDelayLine that contains the command of this tick.
        axes: number of axes, scalar.
        tick: control tick, scalar.
        step: index of the physics step within the tick, scalar.
        steps: physics steps per tick, scalar.
        out: (nu,) written: the commands [1], or in the drives' units.

    Returns:
        Nothing.

    Source: transport delay of a zero-order hold, averaged over the step.
    """
    for i in range(axes):
        at, part = tick * steps + step - int(line.delay[i, 0]), line.delay[i, 1]
        value = line.ring[_ring_row(at, steps, tick, len(line.ring)), i]
        if part > 0.0:
            before = line.ring[_ring_row(at - 1, steps, tick, len(line.ring)), i]
            value += part * (before - value)
        out[i] = value


@compiled
def _ring_row(step, steps, tick, length):
    """Return the row of the delay line's ring buffer that holds the command of a physics step.

    `step` counts from the start of the run. `steps` is the number of physics steps per tick, `tick`
    the present control tick and `length` the number of rows. Steps before the start of the run map
    to row 0.
    """
    return (min(max(step // steps, -1), tick) + 1) % length


@compiled
def step_physics(sim, tick, steps, command):
    """Advance the simulation by one control tick with a constant command.

    Args:
        sim: Simulation.
        tick: control tick, from 0, scalar.
        steps: physics steps of the tick, scalar.
        command: (nu,) commands [1], or in the drives' units.

    Returns:
        Nothing.

    Source: MuJoCo manual, `mj_step`.
    """
    line, past = sim.command_line, sim.sensor_history
    if len(line.ring) == 0:
        for i in range(sim.axes):
            sim.ctrl[i] = command[i]
    else:
        for i in range(sim.axes):
            line.ring[(tick + 1) % len(line.ring), i] = command[i]
    for step in range(steps):
        if len(line.ring) > 0:
            compute_delayed_step_commands(line, sim.axes, tick, step, steps, sim.ctrl)
        call_mj_step(sim.mj_step, sim.model, sim.data)
        if len(past.ring) > 0:
            _store_sensor_values(sim, tick * steps + step + 1)


@compiled
def _store_sensor_values(sim, number):
    """Store the sensor values after physics step `number` in the history, after their first-order lags.

    The true values before the lags are stored in `before` of the history.
    """
    past, size = sim.sensor_history, len(sim.sensor_history.before)
    now, last = number % len(past.ring), (number - 1) % len(past.ring)
    values = np.empty(size)
    true_sensor_values(sim, values)
    for c in range(size):
        shown = values[c]
        if past.ratio[c] > 0.0:
            shown = step_first_order_lag(past.ring[last, c], past.before[c], values[c], past.ratio[c])
        past.ring[now, c] = shown
        past.before[c] = values[c]


@compiled
def apply_sensor_delays(past, number, values):
    """Replace true sensor values by delayed values, interpolated linearly between physics steps.

    Args:
        past: SensorHistory.
        number: number of physics steps since the start of the run, scalar.
        values: (c,) true values; replaced for sensors with delay or lag [channel's unit].

    Returns:
        Nothing.

    Source: models/cat215/README.md, "Sensors".
    """
    length = len(past.ring)
    if length == 0:
        return
    for c in range(len(past.before)):
        whole, part = int(past.delay[c, 0]), past.delay[c, 1]
        if whole > 0 or part > 0.0 or past.ratio[c] > 0.0:
            new, old = past.ring[(number - whole) % length, c], 0.0
            if part > 0.0:
                old = past.ring[(number - whole - 1) % length, c]
                new += part * (old - new)
            values[c] = new


def command_delays(machine: Machine, axes: tuple[str, ...], timestep: float) -> np.ndarray:
    """Return the command delays (k, 2) of k axes: whole physics steps, and the remaining fraction of a step."""
    return np.array([split_delay(machine.axes[n].command_delay, timestep) for n in axes], float)


def sensor_delays(machine: Machine, channels: tuple[str, ...], timestep: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the delays and first-order lags of c sensors.

    Args:
        machine: the machine.
        channels: names of the c channels.
        timestep: physics step [s].

    Returns:
        (c, 2) delays as whole physics steps and fraction of a step [1], and (c,) step divided by
        the time constant of the lag, 0 without lag [1].
    """
    errors = [machine.sensor_errors.get(name, SensorError()) for name in channels]
    delay = np.array([split_delay(e.delay, timestep) for e in errors], float).reshape(-1, 2)
    ratio = [timestep / e.time_constant if e.time_constant else 0.0 for e in errors]
    return delay, np.array(ratio)


def delay_line_length(delays: np.ndarray, steps: int) -> int:
    """Return the number of control ticks that a CommandDelayLine must store; 0 without delays.

    `delays` (..., 2) are whole physics steps and fractions; `steps` are the physics steps per tick.
    """
    if not delays.any():
        return 0
    return int(np.ceil((delays[..., 0].max() + 1) / steps)) + 2


def sensor_history_length(delays: np.ndarray, ratios: np.ndarray) -> int:
    """Return the number of physics steps that a SensorHistory must store; 0 without delay or lag.

    `delays` and `ratios` are those of `sensor_delays`.
    """
    return int(delays[..., 0].max()) + 2 if delays.any() or ratios.any() else 0


def delayed_commands(plant: Plant, before: np.ndarray, held: np.ndarray, steps: int) -> np.ndarray:
    """Compute the delayed commands that act in every physics step of a run.

    Args:
        plant: the plant, with the `command_delay` of its axes.
        before: (nu,) commands before the first tick.
        held: (ticks, nu) commands, each constant over a tick.
        steps: physics steps per tick.

    Returns:
        (ticks * steps, nu) commands [1], or in the drives' units.
    """
    delay = command_delays(plant.machine, plant.axes, plant.model.opt.timestep)
    out = np.repeat(np.asarray(held, float), steps, axis=0)
    if length := delay_line_length(delay, steps):
        line = CommandDelayLine(np.tile(np.asarray(before, float), (length, 1)), delay)
        for tick, command in enumerate(held):
            line.ring[(tick + 1) % length] = command
            for step in range(steps):
                compute_delayed_step_commands(line, len(plant.axes), tick, step, steps, out[tick * steps + step])
    return out


@compiled
def _step_simulation_record(record, tick, steps, command):
    step_physics(unpack_simulation_record(record[0]), tick, steps, command)


class Stepper:
    """Simulation of a plant that advances tick by tick, with a constant command in each control tick.

    Args:
        plant: the plant.
        data: staggered state at the start, after `record.start_leapfrog`; its `ctrl` contains the
            commands before the start.
        steps: physics steps per tick.

    Attributes:
        sim: data of the plant for compiled code.
        record: (1,) the same data as a record.
        steps: physics steps per tick.
        tick: number of the next tick.
        has_delayed_sensors: whether any sensor has a delay or lag.
    """

    def __init__(self, plant: Plant, data: mujoco.MjData, steps: int) -> None:
        """Initialise the delay line of the commands and the past of the sensors."""
        channels, h = sensed_channels(plant), plant.model.opt.timestep
        delay = command_delays(plant.machine, plant.axes, h)
        lag, ratio = sensor_delays(plant.machine, channels, h)
        rods = np.flatnonzero(plant.rod_qpos >= 0)
        past = SensorHistory(
            np.zeros((sensor_history_length(lag, ratio), len(channels))),
            np.zeros(len(channels)),
            lag,
            ratio,
        )
        self.sim = Simulation(
            mj_step=function_address("mj_step"),
            model=plant.model._address,
            data=data._address,
            qpos=data.qpos,
            qvel=data.qvel,
            act=data.act,
            ctrl=data.ctrl,
            timestep=h,
            axes=len(plant.axes),
            hydraulic=plant.hydraulic,
            joint_qpos=plant.qpos,
            joint_dof=plant.dof,
            rod_qpos=plant.rod_qpos[rods],
            rod_dof=plant.drive_dof[rods],
            user=plant.model.actuator_user.ravel(),
            command_line=CommandDelayLine(np.zeros((delay_line_length(delay, steps), len(plant.axes))), delay),
            sensor_history=past,
        )
        self._owners = plant.model, data  # keeps the memory behind the addresses alive
        self.steps, self.tick, self.has_delayed_sensors = steps, 0, len(past.ring) > 0
        self.record = simulation_record(self.sim)
        initialise_history(self.sim, np.array(data.ctrl))

    def advance(self, command: np.ndarray) -> None:
        """Advance the simulation by one control tick with a constant command (nu,) [1] or in drive units."""
        _step_simulation_record(self.record, self.tick, self.steps, np.asarray(command, float))
        self.tick += 1

    def sensor_values(self) -> np.ndarray:
        """Return the present sensor values (c,), with delay and lag but no other errors.

        The order is that of `record.sensed_channels`.
        """
        values = np.empty(len(self.sim.sensor_history.before))
        true_sensor_values(self.sim, values)
        apply_sensor_delays(self.sim.sensor_history, self.tick * self.steps, values)
        return values
