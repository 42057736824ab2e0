"""One control period of one machine of a batch: commands, dynamics, sensors; compiled for CPU and CUDA.

The dynamics are `estimate.reduced_model.advance`. All arrays of a batch have one row per machine. Parameters
that are equal for all machines have one row.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.batch.random_numbers import normal_number, uniform_number
from hydrotele.core.compiled import compile_without_allocation
from hydrotele.estimate.reduced_model import Model, Space, add_sensor_drift, advance, read_channels
from hydrotele.multibody.reduced_dynamics import ACCELERATION, Q
from hydrotele.multibody.reduced_mechanism import HOME, ReducedMechanism
from hydrotele.simulate.sensor_models import quantise_reading

__all__ = ["Machines", "Model", "Noise", "Space", "Timing", "run_machine", "run_machines"]


class Machines(NamedTuple):
    """State of a batch of m machines with n states, c channels, nu drives, N joints and h command rows.

    Attributes:
        state: (m, n) states, see `reduced_model.state_names`.
        linkage: (m, s) joint positions (N) [rad] or [m], then the rates of the dependent per independent
            coordinates, with which the solution of the closed chains starts.
        history: (m, h, nu) commands of the last control periods after the rate limit, the newest last.
        command: (m, nu) commands of the next control period [1] or [V].
        reading: (m, c) readings of the sensors [channel's unit].
        error: (m, c) random errors of the last readings [channel's unit].
        period_count: (m,) number of control periods since the last reset.
        sample_count: (m,) number of samples of the sensors since the start, which selects their errors.
        seed: (m,) seeds of the random numbers.
        failed: (m,) 1 if the state of a machine is not finite, otherwise 0.
        start: (k, n) states from which machines start.
        start_linkage: (k, s) their rows of `linkage`.
    """

    state: np.ndarray
    linkage: np.ndarray
    history: np.ndarray
    command: np.ndarray
    reading: np.ndarray
    error: np.ndarray
    period_count: np.ndarray
    sample_count: np.ndarray
    seed: np.ndarray
    failed: np.ndarray
    start: np.ndarray
    start_linkage: np.ndarray


class Noise(NamedTuple):
    """Random errors and converters of c sensors.

    Attributes:
        accuracy: (c,) bounds of uniform errors [channel's unit], 0 for none.
        deviation: (c,) standard deviations of normal errors [channel's unit], 0 for none.
        correlation: (c,) correlation of successive normal errors [1].
        step: (c,) converter steps [channel's unit], 0 for none.
        low: (c,) lowest readings [channel's unit].
        high: (c,) highest readings [channel's unit].
    """

    accuracy: np.ndarray
    deviation: np.ndarray
    correlation: np.ndarray
    step: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Timing(NamedTuple):
    """Control period of a batch and limit of its commands.

    Attributes:
        period: control period [s].
        steps: time steps per control period.
        max_change: (nu,) largest change of a command per control period, infinite without limit [1] or [V].
    """

    period: float
    steps: int
    max_change: np.ndarray


@compile_without_allocation
def before_period(task, model, sp, z, machines, i):
    """Do nothing before a control period; a task replaces this function.

    Args:
        task: NamedTuple of arrays of the task.
        model: Model of machine i.
        sp: Space.
        z: (n,) state of machine i.
        machines: Machines; the function of a task writes row i of `command`.
        i: index of the machine.
    """


@compile_without_allocation
def after_period(task, model, sp, z, machines, i):
    """Do nothing after a control period; a task replaces this function.

    The arguments are those of `before_period`. The mechanism is placed at the state, and row i of `reading` has
    the new readings. The function of a task may call `restart_machine`.
    """


@compile_without_allocation
def restart_machine(model, sp, z, machines, i, start):
    """Set machine i to a start state, with closed valves, zero commands and exact readings at the next period.

    Args:
        model: Model of the machine.
        sp: Space.
        z: (n,) state, written.
        machines: Machines; row i is written.
        i: index of the machine.
        start: row of `machines.start`.
    """
    for k in range(len(z)):
        z[k] = machines.start[start, k]
    for k in range(machines.linkage.shape[1]):
        machines.linkage[i, k] = machines.start_linkage[start, k]
    for row in range(machines.history.shape[1]):
        for k in range(machines.history.shape[2]):
            machines.history[i, row, k] = 0.0
    for c in range(machines.error.shape[1]):
        machines.error[i, c] = 0.0
    machines.period_count[i], machines.failed[i] = 0, 0
    load_linkage(model, sp, machines.linkage[i])


@compile_without_allocation
def load_linkage(model, sp, linkage):
    """Copy the start of the closed chains' solution from a row of `Machines.linkage` to the work space."""
    joint, basis, mech = sp.motion.joint, sp.motion.basis, model.mech
    at = joint.shape[1]
    for k in range(at):
        joint[Q, k] = linkage[k]
    for b in range(len(mech.dependent)):
        for f in range(basis.shape[1]):
            basis[mech.dependent[b], f] = linkage[at]
            at += 1


@compile_without_allocation
def store_linkage(model, sp, linkage):
    """Copy the start of the closed chains' solution from the work space to a row of `Machines.linkage`."""
    joint, basis, mech = sp.motion.joint, sp.motion.basis, model.mech
    at = joint.shape[1]
    for k in range(at):
        linkage[k] = joint[Q, k]
    for b in range(len(mech.dependent)):
        for f in range(basis.shape[1]):
            linkage[at] = basis[mech.dependent[b], f]
            at += 1


@compile_without_allocation
def take_command(history, command, max_change):
    """Append a command, limited in its change, to the commands of the last control periods.

    Args:
        history: (h, nu) commands, the newest last; changed in place [1] or [V].
        command: (nu,) new command [1] or [V].
        max_change: (nu,) largest change of a command [1] or [V].
    """
    last = len(history) - 1
    for k in range(len(command)):
        before = history[last, k]
        for row in range(last):
            history[row, k] = history[row + 1, k]
        history[last, k] = min(before + max_change[k], max(before - max_change[k], command[k]))


@compile_without_allocation
def sample_readings(model, sp, z, machines, i, noise, time):
    """Write the readings of machine i: errors of its sensors, random error, converter.

    Args:
        model: Model of the machine.
        sp: Space; the mechanism is placed at the state.
        z: (n,) state.
        machines: Machines; row i is written.
        i: index of the machine.
        noise: Noise.
        time: since the start of the run, scalar [s].

    Source: models/cat215/README.md, "Sensors".
    """
    out, error = machines.reading[i], machines.error[i]
    read_channels(model, sp, z, 0, 1, 1.0, machines.reading[:0], out)
    add_sensor_drift(model, time, out)
    seed, sample = machines.seed[i], machines.sample_count[i]
    machines.sample_count[i] = sample + 1
    for c in range(len(out)):
        if noise.deviation[c] > 0.0:
            kept = noise.correlation[c] if machines.period_count[i] > 1 else 0.0
            new = noise.deviation[c] * normal_number(seed, sample, c)
            error[c] = kept * error[c] + math.sqrt(1.0 - kept * kept) * new
        elif noise.accuracy[c] > 0.0:
            error[c] = noise.accuracy[c] * (2.0 * uniform_number(seed, sample, c) - 1.0)
        out[c] = quantise_reading(out[c] + error[c], noise.step[c], noise.low[c], noise.high[c])


@compile_without_allocation
def advance_machine(model, sp, z, machines, i, noise, timing):
    """Advance machine i by one control period and sample its sensors.

    Args:
        model: Model of the machine.
        sp: Space after `load_linkage`.
        z: (n,) state, advanced in place.
        machines: Machines; row i is written, except for the state.
        i: index of the machine.
        noise: Noise.
        timing: Timing.
    """
    history = machines.history[i]
    take_command(history, machines.command[i], timing.max_change)
    row = len(history) - 1
    sp.time[1] = (machines.period_count[i] - row) * timing.period
    advance(model, sp, z, history, row, timing.period, timing.steps, machines.reading[:0])
    machines.period_count[i] += 1
    sample_readings(model, sp, z, machines, i, noise, machines.period_count[i] * timing.period)
    total = 0.0
    for k in range(len(z)):
        total += z[k] - z[k]  # not 0 if a state is not finite
    machines.failed[i] = 0 if total == 0.0 else 1


@compile_without_allocation
def prepare_space(model, sp):
    """Set the world's frame and the independent coordinates' rows of a zero work space."""
    frame, basis, mech = sp.motion.frame, sp.motion.basis, model.mech
    for r in range(3):
        frame[0, 4 * r] = 1.0
        frame[0, ACCELERATION + r] = -mech.gravity[r]
    for f in range(len(mech.independent)):
        basis[mech.independent[f], f] = 1.0
    for k in range(sp.motion.joint.shape[1]):
        sp.motion.joint[Q, k] = mech.joint[HOME, k]


@compile_without_allocation
def run_machine(model, sp, z, machines, i, noise, timing, task, periods):
    """Advance machine i by some control periods, with the functions of a task before and after each.

    Args:
        model: Model whose numbers have a leading dimension of 1 or the number of machines.
        sp: Space, whose arrays were zero before its first use.
        z: (n,) state of the machine, advanced in place.
        machines: Machines; row i is written, except for the state.
        i: index of the machine.
        noise: Noise.
        timing: Timing.
        task: NamedTuple of arrays of the task.
        periods: number of control periods.
    """
    mech = model.mech
    own = Model(
        ReducedMechanism(
            mech.tree, mech.shape[i if len(mech.shape) > 1 else 0], mech.link_count, mech.bar_count,
            mech.joint[i if len(mech.joint) > 1 else 0], mech.independent, mech.dependent,
            mech.gravity[i if len(mech.gravity) > 1 else 0], mech.drive,
        ),
        model.user[i if len(model.user) > 1 else 0], model.hydraulic,
        model.gain[i if len(model.gain) > 1 else 0], model.delay[i if len(model.delay) > 1 else 0],
        model.gear, model.transmission[i if len(model.transmission) > 1 else 0], model.kind, model.drive,
        model.scale[i if len(model.scale) > 1 else 0], model.offset[i if len(model.offset) > 1 else 0],
        model.lag, model.terms, model.time_constant, model.drift[i if len(model.drift) > 1 else 0], model.memory,
    )  # fmt: skip
    prepare_space(own, sp)
    load_linkage(own, sp, machines.linkage[i])
    for _ in range(periods):
        before_period(task, own, sp, z, machines, i)
        advance_machine(own, sp, z, machines, i, noise, timing)
        after_period(task, own, sp, z, machines, i)
    store_linkage(own, sp, machines.linkage[i])


@compile_without_allocation
def run_machines(model, sp, machines, noise, timing, task, periods, begin, end):
    """Call `run_machine` for the machines begin .. end - 1 of a batch on the CPU."""
    for i in range(begin, end):
        run_machine(model, sp, machines.state[i], machines, i, noise, timing, task, periods)
