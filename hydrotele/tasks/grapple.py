"""A grapple that hangs freely: when its jaw takes a log, and what is read of its two free joints.

Angle sensors of the machine's kind sit on both free joints: same rate, error and resolution.
"""

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.machine.machine import Machine
from hydrotele.scenario.surroundings import LogOnGround
from hydrotele.simulate.holding import CENTRE, GRIP, ROW, TAKEN, grip_step
from hydrotele.simulate.sensors import convert
from hydrotele.simulate.surroundings import log_grip
from hydrotele.tasks.chance import draw

HAND, LOG, WELD, JAW, PLACE, RADIUS, HALF_LENGTH = range(GRIP, GRIP + 7)  # in Facts.numbers
_FREE = GRIP + 7  # place in qpos and qvel of pitch, then of roll
FREE_JOINTS = ("grapple_pitch", "grapple_roll")
READ = 0  # first of the readings in the goal: pitch, roll, their rates
READINGS = 4


def grapple_numbers(machine: Machine, model: mujoco.MjModel, log: LogOnGround) -> np.ndarray:
    """Numbers of a task with a grapple and one log.

    Args:
        machine: the machine.
        model: its MuJoCo model with the log as `log_0`.
        log: the log.

    Returns:
        (GRIP + 11,): those of `holding.grip_step`, then numbers of the grapple's body, the log's
        body and weld, places in `qpos` of jaw and log, the log's radius and half its length [m],
        places of the free joints.
    """
    hand = machine.links[machine.link_of(machine.axes[log.grab].joint)].parent
    places = [
        model.body(hand).id, model.body("log_0").id, model.equality("log_0_held").id,
        model.joint(machine.axes[log.grab].joint).qposadr[0], model.joint("log_0").qposadr[0],
        log.diameter / 2.0, log.length / 2.0,
    ]  # fmt: skip
    for name in FREE_JOINTS:
        places += [model.joint(name).qposadr[0], model.joint(name).dofadr[0]]
    return np.concatenate([log_grip(model, log), np.array(places, float)])


@compiled
def is_held(f, w):
    """Whether the grapple holds the log.

    Args:
        f: record of FACTS.
        w: World.

    Returns:
        bool.

    Source: this module.
    """
    return w.eq_active[int(f.numbers[WELD])] != 0


@compiled
def _number(values, count, at):
    """`count` numbers of body number `at`."""
    return values[count * at : count * at + count]


@compiled
def _take_or_let_go(f, w):
    hand, log, weld = int(f.numbers[HAND]), int(f.numbers[LOG]), int(f.numbers[WELD])
    first = weld * f.eq_width
    change = grip_step(
        f.numbers[:GRIP], _number(w.xpos, 3, hand), _number(w.xquat, 4, hand),
        _number(w.xpos, 3, log), _number(w.xquat, 4, log), w.qpos[int(f.numbers[JAW])],
        w.eq_active[weld] != 0, w.eq_rows[first : first + ROW],
    )  # fmt: skip
    if change == 0:
        return
    w.eq_active[weld] = 1 if change == TAKEN else 0
    for c in range(first, first + ROW):  # now, and from the next call on
        w.eq_data[c] = w.eq_rows[c]


@compiled
def read_free_joints(f, e, w):
    """Read the angles of the free joints and difference quotients, if a reading is due.

    Args:
        f: record of FACTS.
        e: record of MEMORY; `goal` is written from READ on.
        w: World, staggered as `simulate.record` says.

    Returns:
        Nothing.

    Source: as `sense.sense`, with the error and resolution of the first axis' sensor.
    """
    if e.tick % f.every != 0:
        return
    for j in range(2):
        place, dof = int(f.numbers[_FREE + 2 * j]), int(f.numbers[_FREE + 2 * j + 1])
        value = w.qpos[place] - f.timestep * w.qvel[dof]
        if f.noisy:
            value += f.accuracy[0] * (2.0 * draw(e) - 1.0)
            value = convert(value, f.converters[0, 0], f.converters[1, 0], f.converters[2, 0])
        past = e.goal[READ + j]
        e.goal[READ + 2 + j] = (value - past) / (f.every * f.period) if e.tick > 0 else 0.0
        e.goal[READ + j] = value


@compiled
def tick_grapple(f, e, w):
    """Take the log or let it go, and read the free joints.

    Args:
        f: record of FACTS; its numbers are those of `grapple_numbers`.
        e: record of MEMORY; `goal` is written.
        w: World after a physics step; the weld is written.

    Returns:
        Nothing.

    Source: `simulate.holding.grip_step`.
    """
    _take_or_let_go(f, w)
    read_free_joints(f, e, w)


@compiled
def grip_distance(f, w):
    """How far the pocket between the jaws is from the log.

    Args:
        f: record of FACTS.
        w: World after a physics step.

    Returns:
        (distance of the pocket's middle from the part of the log's axis that can be held [m],
        angle between the pocket's line and that axis [rad]), scalars.

    Source: this module.
    """
    hand, log, reach = int(f.numbers[HAND]), int(f.numbers[LOG]), f.numbers[GRIP - 1]
    turn, own = _number(w.xmat, 9, hand), _number(w.xmat, 9, log)
    along, across, square = 0.0, 0.0, 0.0
    way = np.empty(3)
    for c in range(3):
        way[c] = w.xpos[3 * hand + c] - w.xpos[3 * log + c]
        for k in range(3):
            way[c] += turn[3 * c + k] * f.numbers[CENTRE + k]
        along += way[c] * own[3 * c]
        across += turn[3 * c + 1] * own[3 * c]
    along = min(reach, max(-reach, along))
    for c in range(3):
        square += (way[c] - along * own[3 * c]) ** 2
    return np.sqrt(square), np.arccos(min(1.0, abs(across)))


@compiled
def lean(f, w):
    """Angle between the grapple and plumb, scalar [rad].

    Args:
        f: record of FACTS.
        w: World after a physics step.

    Returns:
        The angle.

    Source: its x points down.
    """
    down = -w.xmat[9 * int(f.numbers[HAND]) + 6]
    return np.arccos(min(1.0, max(-1.0, down)))
