"""One control period of the machines of a batch: commands, dynamics, sensors; compiled for CPU and CUDA.

The equations and their order are those of `estimate.reduced_model.advance`, and the results are equal bit by
bit. A block of machines takes each step together: the straight-line code of the mechanism computes all of them with
vector instructions. Valves, chambers and friction, which branch, follow machine by machine. A thread of a CUDA
device has one machine.

All arrays of a batch have one row per machine. Parameters that are equal for all machines have one row.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from hydrotele.batch.mechanism_code import HALF_KICK, JOINT, SHAPE, STEP, MechanismCode, array_shapes
from hydrotele.batch.random_numbers import normal_number, uniform_number
from hydrotele.core.compiled import compile_without_allocation
from hydrotele.estimate.reduced_model import (
    Model,
    Space,
    add_drive_forces,
    add_sensor_drift,
    advance_oil,
    kick_rates,
    model_space,
    set_activations,
    show_channels,
    take_commands,
)
from hydrotele.multibody.reduced_dynamics import (
    CLOSURE_TOLERANCE,
    Q,
    ReducedMotion,
    factorise_cholesky,
    solve_cholesky,
)
from hydrotele.multibody.reduced_mechanism import ReducedMechanism
from hydrotele.simulate.sensor_models import quantise_reading

_MAX_CORRECTIONS = 20  # maximum number of Newton iterations, as in `reduced_dynamics.close_loops`
START, FIRST_KICK = range(2)  # stages of a control period, see `run_stage`


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


class Lanes(NamedTuple):
    """Work space of a block of L machines; the first dimension of most arrays is the machine.

    Attributes:
        z: (L, n) states.
        joint: (L, 4, N), `basis`, `frame`, `bar`: see `ReducedMotion`.
        basis: (L, N, n).
        frame: (L, l + 1, 18) rotation, origin, spin and velocity of the world and of the l links.
        bar: (L, bars, 3 + N).
        row: (L, nu, n), `mass`, `force`, `drive`, `act`, `act_dot`, `scratch`, `time`: see `Space`.
        mass: (L, n + t, n + t).
        force: (L, n + t).
        drive: (L, 5, nu).
        residual: (L, 1) largest closure residual [m].
        parameter: (p, L) geometry and masses that the traced code reads, see `MechanismCode.parameters`.
        step: (2, L) length of the step and half the length of the kick [s].
        act: (L, na).
        act_dot: (L, na).
        scratch: (L, s).
        time: (L, 2).
        source: (p, 3) `MechanismCode.parameters`.
        empty: (1, 1, 1), for arrays of `ReducedMotion` that traced code does not have.
        has_closures: whether the mechanism has dependent coordinates.
    """

    z: np.ndarray
    joint: np.ndarray
    basis: np.ndarray
    frame: np.ndarray
    bar: np.ndarray
    row: np.ndarray
    mass: np.ndarray
    force: np.ndarray
    drive: np.ndarray
    residual: np.ndarray
    parameter: np.ndarray
    step: np.ndarray
    act: np.ndarray
    act_dot: np.ndarray
    scratch: np.ndarray
    time: np.ndarray
    source: np.ndarray
    empty: np.ndarray
    has_closures: bool


def make_lanes(model: Model, code: MechanismCode, count: int) -> Lanes:
    """Allocate the work space of a block of `count` machines with a model of one machine."""
    space = model_space(model)
    shapes = array_shapes(model) | {name: getattr(space, name).shape for name in ("act", "act_dot", "scratch", "time")}
    lanes = Lanes(
        **{name: np.zeros((count, *shape)) for name, shape in shapes.items()},
        parameter=np.zeros((len(code.parameters), count)), step=np.zeros((2, count)), source=code.parameters,
        empty=np.zeros((1, 1, 1)), has_closures=code.has_closures,
    )  # fmt: skip
    lanes.basis[:] = space.motion.basis
    return lanes


@compile_without_allocation
def run_move(arrays):
    """Stand for the program `MechanismCode.move` of a machine; the argument is a tuple of the arrays `ARRAYS`."""


@compile_without_allocation
def run_correct(arrays):
    """Stand for the program `MechanismCode.correct` of a machine."""


@compile_without_allocation
def run_place(arrays):
    """Stand for the program `MechanismCode.place` of a machine."""


@compile_without_allocation
def run_pose(arrays):
    """Stand for the program `MechanismCode.pose` of a machine."""


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
    restart_history(machines, i, start)
    load_linkage(model.mech.dependent, sp.motion.joint, sp.motion.basis, machines.linkage[i])


@compile_without_allocation
def restart_history(machines, i, start):
    """Set all of machine i but its state to a start state; see `restart_machine`."""
    for k in range(machines.linkage.shape[1]):
        machines.linkage[i, k] = machines.start_linkage[start, k]
    for row in range(machines.history.shape[1]):
        for k in range(machines.history.shape[2]):
            machines.history[i, row, k] = 0.0
    for c in range(machines.error.shape[1]):
        machines.error[i, c] = 0.0
    machines.period_count[i], machines.failed[i] = 0, 0


@compile_without_allocation
def load_linkage(dependent, joint, basis, linkage):
    """Copy the start of the closed chains' solution from a row of `Machines.linkage` to the work space."""
    at = joint.shape[1]
    for k in range(at):
        joint[Q, k] = linkage[k]
    for b in range(len(dependent)):
        for f in range(basis.shape[1]):
            basis[dependent[b], f] = linkage[at]
            at += 1


@compile_without_allocation
def store_linkage(dependent, joint, basis, linkage):
    """Copy the start of the closed chains' solution from the work space to a row of `Machines.linkage`."""
    at = joint.shape[1]
    for k in range(at):
        linkage[k] = joint[Q, k]
    for b in range(len(dependent)):
        for f in range(basis.shape[1]):
            linkage[at] = basis[dependent[b], f]
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
    show_channels(model, sp, z, 0, 1, 1.0, machines.reading[:0], out)
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
def place_block(lanes, step, half_kick, as_pose):
    """Advance the positions of all machines of a block by a step and place their mechanisms.

    Args:
        lanes: Lanes.
        step: length of the step, scalar [s]; 0 to place only.
        half_kick: half the length of the kick that follows, scalar [s].
        as_pose: whether to compute the frames of the links instead of mass matrix and forces.
    """
    for lane in range(len(lanes.z)):
        lanes.step[STEP, lane], lanes.step[HALF_KICK, lane] = step, half_kick
    arrays = (
        lanes.z, lanes.joint, lanes.basis, lanes.frame, lanes.bar, lanes.row, lanes.mass, lanes.force, lanes.drive,
        lanes.residual, lanes.parameter, lanes.step,
    )  # fmt: skip
    run_move(arrays)
    for iteration in range(_MAX_CORRECTIONS):
        if iteration > 0 or (lanes.has_closures and step > 0.0):
            run_correct(arrays)
        if as_pose:
            run_pose(arrays)
        else:
            run_place(arrays)
        worst = 0.0
        for lane in range(len(lanes.z)):
            worst = max(worst, lanes.residual[lane, 0])
        if worst < CLOSURE_TOLERANCE:
            return


@compile_without_allocation
def do_stage(model, sp, z, machines, noise, timing, task, i, stage):
    """Do one stage of a control period of machine i with its Model, Space and state (n,); see `run_stage`."""
    history = machines.history[i]
    row, h = len(history) - 1, timing.period / timing.steps
    if stage == START:
        before_period(task, model, sp, z, machines, i)
        take_command(history, machines.command[i], timing.max_change)
        sp.time[1] = (machines.period_count[i] - row) * timing.period
        sp.time[0] = sp.time[1] + row * timing.period
        take_commands(model, sp.drive, history, row, 0.0, h, timing.period)
        return
    set_activations(model, sp, z)
    step = stage - FIRST_KICK
    if step <= timing.steps:
        kick = 0.5 * h
        if step > 0:
            take_commands(model, sp.drive, history, row, (step - 1) * h, step * h, timing.period)
            advance_oil(model, sp, z, h)
            sp.time[0] = sp.time[1] + row * timing.period + step * h
            if step < timing.steps:
                kick = h
        add_drive_forces(model, sp, z, kick)
        factorise_cholesky(sp.mass)
        solve_cholesky(sp.mass, sp.force)
        kick_rates(model, sp, z, kick)
    else:
        machines.period_count[i] += 1
        sample_readings(model, sp, z, machines, i, noise, machines.period_count[i] * timing.period)
        total = 0.0
        for k in range(len(z)):
            total += z[k] - z[k]  # not 0 if a state is not finite
        machines.failed[i] = 0 if total == 0.0 else 1
        after_period(task, model, sp, z, machines, i)


@compile_without_allocation
def do_before(model, sp, z, machines, noise, timing, task, i, stage):
    """Call `before_period` only; stands for `do_stage` in a separate kernel, see `run_task`."""
    before_period(task, model, sp, z, machines, i)


@compile_without_allocation
def do_after(model, sp, z, machines, noise, timing, task, i, stage):
    """Call `after_period` only; stands for `do_stage` in a separate kernel, see `run_task`."""
    after_period(task, model, sp, z, machines, i)


@compile_without_allocation
def run_stage(model, lanes, machines, noise, timing, task, i, lane, stage):
    """Do one stage of a control period of a machine.

    Args:
        model: Model whose parameters have a leading dimension of 1 or the number of machines.
        lanes: Lanes.
        machines: Machines.
        noise: Noise.
        timing: Timing.
        task: NamedTuple of arrays of the task.
        i: index of the machine.
        lane: its place in the block.
        stage: START, command of the period; FIRST_KICK, half a kick at the start of the period; then oil and
            kick of each time step after its positions; after the steps, readings.
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
    sp = Space(
        ReducedMotion(
            lanes.frame[lane], lanes.empty, lanes.empty, lanes.bar[lane], lanes.empty[0], lanes.joint[lane],
            lanes.basis[lane], lanes.empty[0], lanes.empty[0],
        ),
        lanes.drive[lane], lanes.row[lane], lanes.mass[lane], lanes.force[lane], lanes.act[lane],
        lanes.act_dot[lane], lanes.scratch[lane], lanes.time[lane],
    )  # fmt: skip
    do_stage(own, sp, lanes.z[lane], machines, noise, timing, task, i, stage)


@compile_without_allocation
def load_parameters(model, lanes, i, lane):
    """Copy geometry and masses of machine i to the parameters of the traced code."""
    mech = model.mech
    for p in range(len(lanes.source)):
        kind, r, c = lanes.source[p, 0], lanes.source[p, 1], lanes.source[p, 2]
        if kind == SHAPE:
            lanes.parameter[p, lane] = mech.shape[i if len(mech.shape) > 1 else 0, r, c]
        elif kind == JOINT:
            lanes.parameter[p, lane] = mech.joint[i if len(mech.joint) > 1 else 0, r, c]
        else:
            lanes.parameter[p, lane] = mech.gravity[i if len(mech.gravity) > 1 else 0, c]


@compile_without_allocation
def load_machine(model, lanes, machines, i, lane):
    """Copy state, parameters and start of the closed chains' solution of machine i to the work space."""
    for k in range(lanes.z.shape[1]):
        lanes.z[lane, k] = machines.state[i, k]
    load_parameters(model, lanes, i, lane)
    load_linkage(model.mech.dependent, lanes.joint[lane], lanes.basis[lane], machines.linkage[i])


@compile_without_allocation
def store_machine(model, lanes, machines, i, lane):
    """Copy state and start of the closed chains' solution from the work space to machine i."""
    store_linkage(model.mech.dependent, lanes.joint[lane], lanes.basis[lane], machines.linkage[i])
    for k in range(lanes.z.shape[1]):
        machines.state[i, k] = lanes.z[lane, k]


@compile_without_allocation
def run_task(model, lanes, machines, noise, timing, task, i):
    """Run a function of the task, which stands for `do_stage`, for machine i with its mechanism placed at the state.

    A CUDA device runs the functions of a task in separate kernels: these compile in a fraction of the time of
    one kernel with the dynamics, and the kernel with the dynamics is that of all tasks.
    """
    load_machine(model, lanes, machines, i, 0)
    place_block(lanes, 0.0, 0.0, True)
    run_stage(model, lanes, machines, noise, timing, task, i, 0, START)
    store_machine(model, lanes, machines, i, 0)


@compile_without_allocation
def run_block(model, lanes, machines, noise, timing, task, periods, first, count):
    """Advance a block of machines by some control periods, with the functions of a task before and after each.

    Args:
        model: Model whose parameters have a leading dimension of 1 or the number of machines.
        lanes: Lanes.
        machines: Machines.
        noise: Noise.
        timing: Timing.
        task: NamedTuple of arrays of the task.
        periods: number of control periods.
        first: index of the first machine.
        count: number of machines, at most that of the lanes; unused lanes compute copies of the last machine.
    """
    h = timing.period / timing.steps
    for lane in range(len(lanes.z)):
        load_machine(model, lanes, machines, first + min(lane, count - 1), lane)
    last = FIRST_KICK + timing.steps
    for _ in range(periods):
        for stage in range(last + 2):
            if stage >= FIRST_KICK:
                moves, half = FIRST_KICK < stage <= last, 0.5 if FIRST_KICK < stage < last else 0.25
                place_block(lanes, h if moves else 0.0, half * h, stage > last)
            for lane in range(count):
                run_stage(model, lanes, machines, noise, timing, task, first + lane, lane, stage)
    for lane in range(count):
        store_machine(model, lanes, machines, first + lane, lane)


@compile_without_allocation
def run_machines(model, lanes, machines, noise, timing, task, periods, begin, end):
    """Call `run_block` for the machines begin .. end - 1 of a batch on the CPU."""
    for first in range(begin, end, len(lanes.z)):
        count = min(len(lanes.z), end - first)
        run_block(model, lanes, machines, noise, timing, task, periods, first, count)


class Task(NamedTuple):
    """Functions that run in the step of each machine, in the same compiled code, and their arrays.

    Attributes:
        before: compiled function with the arguments of `before_period`.
        after: compiled function with the arguments of `after_period`.
        arrays: NamedTuple of arrays, the first argument of both; their first dimension is 1 or the number of
            machines.
    """

    before: Any
    after: Any
    arrays: Any


class NoTask(NamedTuple):
    """Arrays of a batch without a task."""

    unused: np.ndarray


NO_TASK = Task(before_period, after_period, NoTask(np.zeros(1)))
