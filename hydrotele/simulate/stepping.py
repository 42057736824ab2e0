"""A plant stepped natively under held commands that may arrive late, and what late sensors show.

Scenario runs, replays and environments step by the functions of this module. MuJoCo's own actuator
delay does not reach the native hydraulics, which read `ctrl` itself, and would round a delay to its
step; here a command that changes inside a step acts as its mean over the step, which is of second
order. Whoever steps a model bare steps it without delays.
"""
# pyright: reportCallIssue=false
# numba's intrinsics are called without their typing context.

from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.memory import address_record, floats, integers, rows_of
from hydrotele.hydraulics.circuit import SCRATCH, SLOTS
from hydrotele.machine.machine import Machine, SensorError, first_order
from hydrotele.simulate.layout import call_step, function_address
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import sensed_channels, split_delay, state_supply


class CommandLine(NamedTuple):
    """Commands on their way to k valves and drives.

    Attributes:
        ring: (length, k or more) commands of the last control ticks [1], or in the drives' units;
            of length 0 where nothing is late.
        delay: (k or more, 2) whole physics steps of every delay, and the rest of a step [1].
    """

    ring: np.ndarray
    delay: np.ndarray


class SensorPast(NamedTuple):
    """What c sensors would show after each of the last physics steps, but for their delays.

    Attributes:
        ring: (length, c) values behind the sensors' first-order lags [channel's unit]; of length 0
            where no sensor is late.
        before: (c,) true values after the last step [channel's unit].
        delay: (c, 2) whole physics steps of every delay, and the rest of a step [1].
        ratio: (c,) a step over the time constant of the lag [1]; 0 without lag.
    """

    ring: np.ndarray
    before: np.ndarray
    delay: np.ndarray
    ratio: np.ndarray


class Simulation(NamedTuple):
    """A plant as native code sees it; k axes, of which h hydraulic ones come first.

    Attributes:
        mj_step: address of that function.
        model: address of mjModel.
        data: address of mjData.
        qpos: (nq,) positions; staggered, see `simulate.record`.
        qvel: (nv,) velocities.
        act: (na,) activations.
        ctrl: (nu,) commands that act.
        timestep: of the physics [s].
        axes: k.
        hydraulic: h.
        joint_qpos: (k or more,) place of every axis' joint in `qpos`.
        joint_dof: (k or more,) the same in `qvel`.
        rod_qpos: (l,) places in `qpos` of the cylinders whose lengths are sensed.
        rod_dof: (l,) the same in `qvel`.
        user: (k SLOTS,) parameters of the actuators.
        line: commands on their way.
        past: of the sensors.
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
    line: CommandLine
    past: SensorPast


_I = np.int64
SIMULATION = np.dtype(
    [(name, _I) for name in ("mj_step", "model", "data", "nq", "nv", "na", "nu")]
    + [("timestep", np.float64)]
    + [(name, _I) for name in ("axes", "hydraulic", "rods", "channels", "ticks", "back")]
    + [(name, _I) for name in ("qpos", "qvel", "act", "ctrl", "user")]  # addresses from here on
    + [(name, _I) for name in ("joint_qpos", "joint_dof", "rod_qpos", "rod_dof")]
    + [(name, _I) for name in ("line_ring", "line_delay")]
    + [(name, _I) for name in ("past_ring", "past_before", "past_delay", "past_ratio")],
    align=True,
)
"""Record of a Simulation."""


def simulation_record(sim: Simulation) -> np.ndarray:
    """(1,) record of a Simulation whose arrays must outlive it; `simulation` reads it."""
    line, past = sim.line, sim.past
    record = address_record(
        SIMULATION,
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
def simulation(r):
    """The Simulation of a record of `simulation_record`."""
    k, c = r.axes, r.channels
    line = CommandLine(rows_of(r.line_ring, r.ticks, k), rows_of(r.line_delay, k, 2))
    past = SensorPast(
        rows_of(r.past_ring, r.back, c), floats(r.past_before, c), rows_of(r.past_delay, c, 2),
        floats(r.past_ratio, c),
    )  # fmt: skip
    return Simulation(
        r.mj_step, r.model, r.data, floats(r.qpos, r.nq), floats(r.qvel, r.nv),
        floats(r.act, r.na), floats(r.ctrl, r.nu), r.timestep, k, r.hydraulic,
        integers(r.joint_qpos, k), integers(r.joint_dof, k), integers(r.rod_qpos, r.rods),
        integers(r.rod_dof, r.rods), floats(r.user, k * SLOTS), line, past,
    )  # fmt: skip


@compiled
def true_values(sim, out):
    """What stands before the sensors, at the time of the activations.

    Args:
        sim: Simulation.
        out: (c,) written: k joint positions [rad], [m], head and rod pressure of every hydraulic
            axis, supply pressure where there is one [Pa], l cylinder lengths [m].

    Returns:
        Nothing.

    Source: `simulate.record.aligned_positions` and `state_supply`.
    """
    k, h = sim.axes, sim.hydraulic
    for i in range(k):
        out[i] = sim.qpos[sim.joint_qpos[i]] - sim.timestep * sim.qvel[sim.joint_dof[i]]
    for i in range(h):
        out[k + 2 * i], out[k + 2 * i + 1] = sim.act[4 * i + 2], sim.act[4 * i + 3]
    at = k + 2 * h
    if h > 0:
        out[at] = state_supply(sim.user, h, sim.act, np.empty(SCRATCH))
        at += 1
    for i in range(len(sim.rod_qpos)):
        out[at + i] = sim.qpos[sim.rod_qpos[i]] - sim.timestep * sim.qvel[sim.rod_dof[i]]


@compiled
def begin_past(sim, command):
    """Let everything have stood as it stands now for all times before.

    Args:
        sim: Simulation; its line and its past are written.
        command: (nu,) in force before the first tick.

    Returns:
        Nothing.
    """
    for n in range(len(sim.line.ring)):
        for i in range(sim.axes):
            sim.line.ring[n, i] = command[i]
    if len(sim.past.ring) > 0:
        true_values(sim, sim.past.before)
        for n in range(len(sim.past.ring)):
            for c in range(len(sim.past.before)):
                sim.past.ring[n, c] = sim.past.before[c]


@compiled
def arriving_commands(line, axes, tick, step, steps, out):
    """Commands that act in one physics step.

    Args:
        line: CommandLine, with the command of this tick in it.
        axes: number of axes, scalar.
        tick: control tick, scalar.
        step: physics step of the tick, scalar.
        steps: physics steps per tick, scalar.
        out: (nu,) written [1], or in the drives' units.

    Returns:
        Nothing.

    Source: transport delay of a zero-order hold, averaged over the step.
    """
    for i in range(axes):
        at, part = tick * steps + step - int(line.delay[i, 0]), line.delay[i, 1]
        value = line.ring[_place(at, steps, tick, len(line.ring)), i]
        if part > 0.0:
            before = line.ring[_place(at - 1, steps, tick, len(line.ring)), i]
            value += part * (before - value)
        out[i] = value


@compiled
def _place(step, steps, tick, length):
    """Row of the ring with the command that was given for a physics step; -1 is before all."""
    return (min(max(step // steps, -1), tick) + 1) % length


@compiled
def step_physics(sim, tick, steps, command):
    """Step through one control tick during which a command is held.

    Args:
        sim: Simulation.
        tick: control tick, from 0, scalar.
        steps: physics steps of the tick, scalar.
        command: (nu,) commands [1], or in the drives' units.

    Returns:
        Nothing.

    Source: MuJoCo manual, `mj_step`.
    """
    line, past = sim.line, sim.past
    if len(line.ring) == 0:
        for i in range(sim.axes):
            sim.ctrl[i] = command[i]
    else:
        for i in range(sim.axes):
            line.ring[(tick + 1) % len(line.ring), i] = command[i]
    for step in range(steps):
        if len(line.ring) > 0:
            arriving_commands(line, sim.axes, tick, step, steps, sim.ctrl)
        call_step(sim.mj_step, sim.model, sim.data)
        if len(past.ring) > 0:
            _keep(sim, tick * steps + step + 1)


@compiled
def _keep(sim, number):
    """Put what the sensors show after physics step `number` into the ring."""
    past, size = sim.past, len(sim.past.before)
    now, last = number % len(past.ring), (number - 1) % len(past.ring)
    values = np.empty(size)
    true_values(sim, values)
    for c in range(size):
        shown = values[c]
        if past.ratio[c] > 0.0:
            shown = first_order(past.ring[last, c], past.before[c], values[c], past.ratio[c])
        past.ring[now, c] = shown
        past.before[c] = values[c]


@compiled
def delayed_values(past, number, values):
    """Replace true values by what late sensors show, linear between two physics steps.

    Args:
        past: SensorPast.
        number: physics steps made, scalar.
        values: (c,) true values, changed where a sensor is late [channel's unit].

    Returns:
        Nothing.

    Source: nominal model, "Sensors".
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
    """(k, 2) whole physics steps [s] and rest of a step of the command delays of some axes [1]."""
    return np.array([split_delay(machine.axes[n].command_delay, timestep) for n in axes], float)


def sensor_delays(
    machine: Machine, channels: tuple[str, ...], timestep: float
) -> tuple[np.ndarray, np.ndarray]:
    """Delays and first-order lags of some sensors.

    Args:
        machine: the machine.
        channels: c channels.
        timestep: of the physics [s].

    Returns:
        (c, 2) delays as whole physics steps and rest, (c,) a step over the time constant of the
        lag, 0 without [1].
    """
    errors = [machine.sensor_errors.get(name, SensorError()) for name in channels]
    delay = np.array([split_delay(e.delay, timestep) for e in errors], float).reshape(-1, 2)
    ratio = [timestep / e.time_constant if e.time_constant else 0.0 for e in errors]
    return delay, np.array(ratio)


def line_length(delays: np.ndarray, steps: int) -> int:
    """Ticks that a CommandLine keeps for delays (..., 2), 0 without any."""
    if not delays.any():
        return 0
    return int(np.ceil((delays[..., 0].max() + 1) / steps)) + 2


def past_length(delays: np.ndarray, ratios: np.ndarray) -> int:
    """Physics steps that a SensorPast keeps for delays (..., 2) and lags, 0 without any."""
    return int(delays[..., 0].max()) + 2 if delays.any() or ratios.any() else 0


def delayed_commands(plant: Plant, before: np.ndarray, held: np.ndarray, steps: int) -> np.ndarray:
    """Commands that act in every physics step of a run.

    Args:
        plant: the plant, with the `command_delay` of its axes.
        before: (nu,) commands in force before the first tick.
        held: (ticks, nu) commands, held over a tick each.
        steps: physics steps per tick.

    Returns:
        (ticks * steps, nu).
    """
    delay = command_delays(plant.machine, plant.axes, plant.model.opt.timestep)
    out = np.repeat(np.asarray(held, float), steps, axis=0)
    if length := line_length(delay, steps):
        line = CommandLine(np.tile(np.asarray(before, float), (length, 1)), delay)
        for tick, command in enumerate(held):
            line.ring[(tick + 1) % length] = command
            for step in range(steps):
                arriving_commands(
                    line, len(plant.axes), tick, step, steps, out[tick * steps + step]
                )
    return out


@compiled
def _step(record, tick, steps, command):
    step_physics(simulation(record[0]), tick, steps, command)


class Stepper:
    """Advances a plant by ticks of held commands.

    Args:
        plant: the plant.
        data: staggered state at the start, as `begin_leapfrog` left it; its `ctrl` holds the
            commands in force before.
        steps: physics steps per tick.

    Attributes:
        sim: the plant as native code sees it.
        record: (1,) the same as a record.
        steps: physics steps per tick.
        tick: number of the next tick.
        late: whether a sensor shows the past.
    """

    def __init__(self, plant: Plant, data: mujoco.MjData, steps: int) -> None:
        """Fill the line of commands and the past of the sensors."""
        channels, h = sensed_channels(plant), plant.model.opt.timestep
        delay = command_delays(plant.machine, plant.axes, h)
        lag, ratio = sensor_delays(plant.machine, channels, h)
        rods = np.flatnonzero(plant.rod_qpos >= 0)
        past = SensorPast(
            np.zeros((past_length(lag, ratio), len(channels))), np.zeros(len(channels)), lag, ratio
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
            line=CommandLine(np.zeros((line_length(delay, steps), len(plant.axes))), delay),
            past=past,
        )
        self._owners = plant.model, data  # whose memory the addresses are
        self.steps, self.tick, self.late = steps, 0, len(past.ring) > 0
        self.record = simulation_record(self.sim)
        begin_past(self.sim, np.array(data.ctrl))

    def advance(self, command: np.ndarray) -> None:
        """Step through one tick during which a command (nu,) is held."""
        _step(self.record, self.tick, self.steps, np.asarray(command, float))
        self.tick += 1

    def shown(self) -> np.ndarray:
        """(c,) what sensors without error show now, in the order of `sensed_channels`."""
        values = np.empty(len(self.sim.past.before))
        true_values(self.sim, values)
        delayed_values(self.sim.past, self.tick * self.steps, values)
        return values
