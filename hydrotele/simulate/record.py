"""States at equal times out of MuJoCo's staggered ones, and their record over a run.

MuJoCo's semi-implicit Euler step with hydraulics that use the piston velocity of the step's start
and give the force of the step's end is a leapfrog: while the activations stand at t, the velocities
stand at t + h/2 and the positions at t + h. Read as if they all stood at t, positions come a step
early, which looks like half a millisecond less delay; read as here, the error is of second order
but for friction.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Protocol

import mujoco
import numpy as np

from hydrotele.machine.machine import Machine
from hydrotele.simulate.document import TIP_SITE
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.surroundings import is_thing

Lag = tuple[float, float]  # delay and time constant of a sensor [s]

_WHOLE = 1.0e-9  # of a step, by which a delay may miss a whole number of steps through rounding


class SimulationFailed(RuntimeError):
    """The simulation left the finite numbers; the message holds the last states."""


@dataclasses.dataclass(frozen=True)
class Record:
    """States of a run at the log's rows, all at the row's time.

    Attributes:
        time: (n,) [s].
        qpos: (n, nq).
        qvel: (n, nv).
        qacc: (n, nv).
        act: (n, na).
        command: (n, nu) mean command over the row's interval.
        contact: (n, 3) sum of the forces on the machine of ground and things, world frame [N].
        tip: (n, 3) position of the arm's tip [m]; empty (n, 0) without an arm.
        late: delay and time constant of a sensor [s] -> (qpos (n, nq), act (n, na), supply
            pressure (n,)) as such a sensor shows them, see `past.Past.at`.
    """

    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    qacc: np.ndarray
    act: np.ndarray
    command: np.ndarray
    contact: np.ndarray
    tip: np.ndarray
    late: Mapping[Lag, tuple[np.ndarray, np.ndarray, np.ndarray]] = dataclasses.field(
        default_factory=dict
    )


def begin_leapfrog(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Take a state whose parts all stand at t to the staggered one that stepping goes on from.

    Args:
        model: the model.
        data: `qvel` moves on by half a step, `qpos` by a whole one; accelerations, site positions
            and contacts are those of time t.
    """
    mujoco.mj_forward(model, data)
    half = 0.5 * model.opt.timestep
    data.qvel[:] += half * data.qacc
    mujoco.mj_integratePos(model, data.qpos, data.qvel, model.opt.timestep)


def aligned_positions(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Positions (nq,) at the time of the activations.

    The ball joint of a tree or the free joint of a log and what comes after it stay as they are.
    """
    return align_positions(model, data.qpos, data.qvel)


def align_positions(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Staggered positions (..., nq) a step back along velocities (..., nv); see `Record`."""
    if model.nq == model.nv:
        return qpos - model.opt.timestep * qvel
    turning = (mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_FREE)
    plain = int(np.argmax(np.isin(model.jnt_type, turning)))
    positions = qpos.copy()
    positions[..., :plain] -= model.opt.timestep * qvel[..., :plain]
    return positions


def sensor_lags(machine: Machine) -> tuple[Lag, ...]:
    """Delays and time constants of the machine's late sensors, each pair once, sorted."""
    errors = machine.sensor_errors.values()
    return tuple(sorted({(e.delay, e.time_constant) for e in errors if e.late}))


def split_delay(delay: float, timestep: float) -> tuple[int, float]:
    """Whole steps of a delay [s] and the fraction of a step [s] that is left, in [0, 1)."""
    steps = math.floor(delay / timestep + _WHOLE)
    rest = delay / timestep - steps
    return steps, rest if rest > _WHOLE else 0.0


class Sight(Protocol):
    """What tells what late sensors show, such as `past.Past`."""

    def at(self, lag: Lag) -> tuple[np.ndarray, np.ndarray, float]:
        """Positions (nq,), activations (na,) and supply pressure [Pa] that such a sensor shows."""
        ...


class Recorder:
    """Arrays that a run fills, one row per log sample.

    Args:
        plant: the plant that runs.
        rows: number of rows.
    """

    def __init__(self, plant: Plant, rows: int) -> None:
        """Make room for all rows."""
        model = plant.model
        self.model = model
        self.tip_site = model.site(TIP_SITE).id if plant.machine.arm else -1
        self.around = surrounding_bodies(plant)
        self.time = np.zeros(rows)
        self.qpos, self.qvel = np.zeros((rows, model.nq)), np.zeros((rows, model.nv))
        self.qacc, self.act = np.zeros((rows, model.nv)), np.zeros((rows, model.na))
        self.command, self.contact = np.zeros((rows, model.nu)), np.zeros((rows, 3))
        self.tip = np.zeros((rows, 3 if self.tip_site >= 0 else 0))
        self.late = {
            lag: (np.zeros((rows, model.nq)), np.zeros((rows, model.na)), np.zeros(rows))
            for lag in sensor_lags(plant.machine)
        }

    def take(self, row: int, time: float, data: mujoco.MjData, past: Sight) -> None:
        """Keep the present state, before the next step is made.

        Args:
            row: which row.
            time: its time [s].
            data: staggered state, as `begin_leapfrog` or a step left it.
            past: the states before, for sensors that read late.

        Raises:
            SimulationFailed: the state is not finite, or MuJoCo warns.
        """
        h = self.model.opt.timestep
        self.time[row] = time
        self.qpos[row] = aligned_positions(self.model, data)
        self.qvel[row] = data.qvel - 0.5 * h * data.qacc
        self.qacc[row] = data.qacc
        self.act[row] = data.act
        for lag, (qpos, act, supply) in self.late.items():
            qpos[row], act[row], supply[row] = past.at(lag)
        if self.tip_site >= 0:
            self.tip[row] = data.site_xpos[self.tip_site]
        if data.ncon:
            self.contact[row] = contact_force(self.model, data, self.around)
        if not np.isfinite(self.qacc[row]).all() or data.warning.number.any():
            raise SimulationFailed(self._story(row))

    def _story(self, row: int) -> str:
        lines = [f"the simulation became unstable at {self.time[row]:.3f} s; the last states:"]
        for r in range(max(0, row - 3), row + 1):
            qpos, act = (np.array2string(a[r], precision=4) for a in (self.qpos, self.act))
            lines += [f"  t={self.time[r]:.3f} qpos={qpos}", f"    spools and pressures={act}"]
        return "\n".join(lines)

    def record(self, rows: int | None = None) -> Record:
        """All rows as a Record, or the first ones."""
        late = {lag: (q[:rows], a[:rows], p[:rows]) for lag, (q, a, p) in self.late.items()}
        return Record(
            self.time[:rows], self.qpos[:rows], self.qvel[:rows], self.qacc[:rows],
            self.act[:rows], self.command[:rows], self.contact[:rows], self.tip[:rows], late,
        )  # fmt: skip


def surrounding_bodies(plant: Plant) -> np.ndarray:
    """Whether each body (nbody,) is the ground, fixed to it or one of the things around."""
    model = plant.model
    named = [is_thing(model.body(b).name) for b in range(model.nbody)]
    return (model.body_weldid == 0) | (np.array(named) & bool(plant.surroundings))


def contact_force(model: mujoco.MjModel, data: mujoco.MjData, around: np.ndarray) -> np.ndarray:
    """Sum of all contact forces on the machine, (3,) [N] in the world frame.

    Args:
        model: the model.
        data: with contacts and their forces.
        around: (nbody,) of `surrounding_bodies`.
    """
    total, wrench = np.zeros(3), np.zeros(6)
    for k in range(data.ncon):
        contact = data.contact[k]
        mujoco.mj_contactForce(model, data, k, wrench)
        force = contact.frame.reshape(3, 3).T @ wrench[:3]
        grounded = around[model.geom_bodyid[contact.geom]]
        if grounded[0] != grounded[1]:  # the machine touching itself is no ground force
            total += force if grounded[0] else -force
    return total
