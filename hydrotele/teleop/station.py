"""A teleoperated run: operator, joystick, line and resolved motion, one control period at a time.

Signals go once around: the machine's sensors tell the force at its tip; a packet with it comes to
the master, late; the joystick reflects it; the operator feels, sees and pushes; where the handle is
goes to the machine in another packet, late; there it becomes joint references.

What the operator's station saw and did, by control tick, and its channels for the logs.

One control period of teleoperation in two compiled halves, before and after the joystick moves, and
as a whole around the simulated joystick.

Delay lines are rings: what is written at a tick is read as many ticks later as the ring is long.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.control.endpoint_force import EndpointForce
from hydrotele.control.plan import Plan
from hydrotele.control.resolved_motion import COORDINATES, arm_facts
from hydrotele.control.servo import DriveReference, DriveReferences, drive_row, drive_tables
from hydrotele.control.task_impedance import TaskImpedance
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.kinematics.task import task_forward
from hydrotele.machine.joystick import AXES, load_joystick
from hydrotele.machine.machine import Machine
from hydrotele.machine.noise import sensor_set
from hydrotele.machine.sensors import SensorSet
from hydrotele.scenario.scenario import Scenario
from hydrotele.scenario.teleoperation import Channel, Fault, TeleopPilot
from hydrotele.simulate.feedback import Feedback
from hydrotele.simulate.joystick import SimulatedFlotor, flotor_step, shaken_flotor_step
from hydrotele.simulate.layout import address_record, floats, integers, rows_of
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import contact_record, sum_contact_forces, surrounding_geoms
from hydrotele.teleop.axis_table import DAMPING, DEADBAND, REACH, flat_view
from hydrotele.teleop.master import (
    CONTROLLED,
    SENT,
    TASK_DAMPING,
    TASK_MASS,
    TASK_STIFFNESS,
    WAVES,
    Master,
    MasterState,
    master,
    master_step,
    push_back,
    unpack_master,
    unpack_master_state,
)
from hydrotele.teleop.network import arrivals, in_periods, load_delays
from hydrotele.teleop.operator_model import Hand, OperatorModel, pull, unpack_muscles
from hydrotele.teleop.operator_parameters import held_joystick
from hydrotele.teleop.slave import (
    BLOCKED,
    HAND,
    HANDLE,
    HANDLE_SPEED,
    SILENT,
    TRIPPED,
    SlaveState,
    measure_task,
    report,
    slave,
    slave_step,
    unpack_slave,
    unpack_slave_state,
)

QUIET, SHARE, PERIOD, SILENCE, FADING = range(5)  # of `line`

Exchange = Callable[[np.ndarray, np.ndarray, float, np.ndarray], None]
"""What a device does once per control tick: writes where its handle is, (7,) as the flotor's [m]
and quaternion, not a number without one; and takes the machine's packet (rows, k), the share of it
that counts, and the further force on the handle (6,) [N], [N m]."""


class SlaveSide(NamedTuple):
    """The machine as teleoperation sees it; k joints of the arm among nu axes.

    Attributes:
        joint: (nu,) measured [rad] or [m].
        force: (k,) at the tip, task coordinates [N], [N m].
        columns: (k,) places of the arm's joints among the axes.
        slave: (23 + 14 k,) Slave.
        state: (102 + 3 k,) SlaveState, written.
    """

    joint: np.ndarray
    force: np.ndarray
    columns: np.ndarray
    slave: np.ndarray
    state: np.ndarray


class Line(NamedTuple):
    """The line between joystick and machine.

    Attributes:
        forward: (n, 3, 6) packets of the master on their way, written: displacement and rate of
            the handle, what is left of the hand's force beyond the joystick's own spring and
            damper; of a passive line the sum of waves or the place, and energy, in their place.
        back: (n, 8, k) packets of the machine on their way, written.
        packet: (8, k) the last one that the master got, written.
        age: (ticks, 2) age of the packet that arrives then, forward and back, in ticks; below 0
            where none arrives that is newer than the last.
        state: (5,) QUIET, SHARE, written, PERIOD, SILENCE, FADING [s].
    """

    forward: np.ndarray
    back: np.ndarray
    packet: np.ndarray
    age: np.ndarray
    state: np.ndarray


class MasterSide(NamedTuple):
    """Joystick and operator.

    Attributes:
        master: (168,) Master.
        state: (123,) MasterState, written.
        qpos: (7,) of the flotor: position [m] and quaternion.
        muscles: (80,) Muscles, written.
        past: (reflex + 1, 6) see `pull`.
        tremor: (n, 6) see `pull`.
    """

    master: np.ndarray
    state: np.ndarray
    qpos: np.ndarray
    muscles: np.ndarray
    past: np.ndarray
    tremor: np.ndarray


@compiled
def to_the_hand(tick, fresh, elapsed, tripped, machine, line, operator):
    """Report the machine to the master, reflect, pull: ends in coil currents and muscle forces.

    Args:
        tick: scalar.
        fresh: whether the sensors have a new sample, scalar.
        elapsed: since the last one, scalar [s].
        tripped: whether the machine has been stopped for good, scalar.
        machine: SlaveSide.
        line: Line.
        operator: MasterSide.

    Returns:
        Nothing.

    Source: `teleop.master`, `teleop.slave`, `teleop.operator_model`.
    """
    joint, force, columns, slave_flat, state_flat = machine
    forward, back, packet, age, state = line
    master_flat, master_state, qpos, hand_flat, past, tremor = operator
    k = len(columns)
    slave, s = unpack_slave(slave_flat, k), unpack_slave_state(state_flat, k)
    m, hand = unpack_master_state(master_state), unpack_muscles(hand_flat)
    period, rows = state[PERIOD], len(back)
    arm = np.empty(k)
    for i in range(k):
        arm[i] = joint[columns[i]]
    measure_task(slave, arm, fresh, elapsed, s)
    report(slave, force, s, back[tick % rows])
    late = age[tick % len(age), 1]
    if late < 0:
        state[QUIET] += period
    else:
        state[QUIET] = 0.0
        come = back[(tick - late) % rows]
        for row in range(len(come)):
            for i in range(k):  # a number that is none does not count
                if np.isfinite(come[row, i]):
                    packet[row, i] = come[row, i]
    goal = 0.0 if tripped or state[QUIET] > state[SILENCE] else 1.0
    state[SHARE] += (goal - state[SHARE]) * min(1.0, period / state[FADING])
    numbers = unpack_master(master_flat)
    master_step(numbers, qpos, packet, state[SHARE], period, tick == 0, m)
    pull(hand, past, tremor, m.handle, tick, period)
    ahead = forward[tick % len(forward)]
    for i in range(6):
        own = m.stiffness[i] * m.handle[i] + numbers.axis[i, DAMPING] * m.speed[i]
        ahead[HANDLE, i], ahead[HANDLE_SPEED, i] = m.handle[i], m.speed[i]
        ahead[HAND, i] = m.hand[i] - own
        if numbers.kind[0] == WAVES or numbers.kind[0] == CONTROLLED:
            ahead[HANDLE_SPEED, i], ahead[HAND, i] = m.line[i, SENT], m.line[i, SENT + 1]


@compiled
def to_the_machine(tick, machine, line, grid, table, scale, reference, rate, drive):
    """Take the packet that arrives, and write the references of joints and drives.

    Args:
        tick: scalar.
        machine: SlaveSide.
        line: Line.
        grid: (nu, 2) of `drive_tables`.
        table: (nu, POINTS, 3) of `drive_tables`.
        scale: of drive velocities, scalar.
        reference: (nu,) joint references, those of the arm written [rad] or [m].
        rate: (nu,) the same, their rates [rad/s] or [m/s].
        drive: DriveReference, written.

    Returns:
        Nothing.

    Source: `teleop.slave`, `control.servo`.
    """
    joint, force, columns, slave_flat, state_flat = machine
    forward, _, _, age, state = line
    velocity, arm, volume_head, volume_rod = drive
    k, rows = len(columns), len(forward)
    slave, s = unpack_slave(slave_flat, k), unpack_slave_state(state_flat, k)
    measured = np.empty(k)
    for i in range(k):
        measured[i] = joint[columns[i]]
    late = age[tick % len(age), 0]
    come = forward[(tick - max(late, 0)) % rows]
    slave_step(slave, come, late >= 0, force, measured, state[PERIOD], s)
    for i in range(k):
        reference[columns[i]], rate[columns[i]] = s.joint[i], s.joint_rate[i]
    drive_row(grid, table, reference, rate, scale, velocity, arm, volume_head, volume_rod)
    for i in range(k):
        velocity[columns[i]] = scale * arm[columns[i]] * s.ahead[i]


_STATION = np.dtype(
    [(name, np.int64) for name in ("axes", "joints", "ticks", "dofs", "swing", "simulated")]
    + [(name, np.int64) for name in ("forward_rows", "back_rows", "ages", "past_rows")]
    + [(name, np.int64) for name in ("tremor_rows", "points", "pose_columns")]
    + [(name, np.int64) for name in ("slave_size", "slave_state_size", "muscles_size")]
    + [(name, np.int64) for name in ("master_size", "master_state_size")]
    + [("scale", np.float64)]
    + [(name, np.int64) for name in ("joint", "force", "columns")]  # addresses from here on
    + [(name, np.int64) for name in ("slave", "slave_state", "master", "master_state")]
    + [(name, np.int64) for name in ("forward", "back", "packet", "age", "line_state")]
    + [(name, np.int64) for name in ("qpos", "muscles", "past", "tremor", "qvel", "qacc")]
    + [(name, np.int64) for name in ("grid", "table", "reference", "rate", "pose")]
    + [(name, np.int64) for name in ("velocity", "arm", "volume_head", "volume_rod")]
    + [(name, np.int64) for name in ("log_master", "log_slave", "log_force", "log_muscles")],
    align=True,
)


@compiled
def _sides(r):
    """SlaveSide, Line and MasterSide of a record."""
    k, rows, back = r.joints, r.forward_rows, r.back_rows
    machine = SlaveSide(
        floats(r.joint, r.axes), floats(r.force, k), integers(r.columns, k),
        floats(r.slave, r.slave_size), floats(r.slave_state, r.slave_state_size),
    )  # fmt: skip
    line = Line(
        floats(r.forward, rows * 18).reshape((rows, 3, 6)),
        floats(r.back, back * 8 * k).reshape((back, 8, k)), rows_of(r.packet, 8, k),
        integers(r.age, 2 * r.ages).reshape((r.ages, 2)), floats(r.line_state, FADING + 1),
    )  # fmt: skip
    operator = MasterSide(
        floats(r.master, r.master_size), floats(r.master_state, r.master_state_size),
        floats(r.qpos, 7), floats(r.muscles, r.muscles_size), rows_of(r.past, r.past_rows, 6),
        rows_of(r.tremor, r.tremor_rows, 6),
    )  # fmt: skip
    return machine, line, operator


@compiled
def round_trip(station, flotor, tick, fresh, elapsed, tripped):
    """Once around: to the hand, a period of the simulated joystick, to the machine, into the log.

    Args:
        station: record of a Station.
        flotor: `SimulatedFlotor.record`, written.
        tick: scalar.
        fresh: see `to_the_hand`, scalar.
        elapsed: see `to_the_hand`, scalar [s].
        tripped: see `to_the_hand`, scalar.

    Returns:
        Whether a flag of the slave's stands: held at the edge, line silent, valves closed.

    Source: `to_the_hand`, `simulate.joystick`, `to_the_machine`.
    """
    r = station[0]
    machine, line, operator = _sides(r)
    to_the_hand(tick, fresh, elapsed, tripped, machine, line, operator)
    s, m = unpack_slave_state(machine.state, r.joints), unpack_master_state(operator.state)
    force, n, nu = unpack_muscles(operator.muscles).force, r.ticks, r.axes
    if r.simulated:
        unpack_master(operator.master).most[0] = flotor[0].allowed
        if r.swing < 0:
            flotor_step(flotor[0], m.currents, force)
        else:
            spin, spin_rate = floats(r.qvel, r.dofs)[r.swing], floats(r.qacc, r.dofs)[r.swing]
            shaken_flotor_step(flotor[0], m.currents, force, spin, spin_rate)
    rows_of(r.log_master, n, r.master_state_size)[tick] = operator.state
    rows_of(r.log_slave, n, r.slave_state_size)[tick] = machine.state
    rows_of(r.log_force, n, r.joints)[tick] = machine.force
    rows_of(r.log_muscles, n, 6)[tick] = force
    drive = DriveReference(
        rows_of(r.velocity, n, nu)[tick], rows_of(r.arm, n, nu)[tick],
        rows_of(r.volume_head, n, nu)[tick], rows_of(r.volume_rod, n, nu)[tick],
    )  # fmt: skip
    to_the_machine(
        tick, machine, line, rows_of(r.grid, nu, 2),
        floats(r.table, nu * r.points * 3).reshape((nu, r.points, 3)), r.scale,
        rows_of(r.reference, n, nu)[tick], rows_of(r.rate, n, nu)[tick], drive,
    )  # fmt: skip
    rows_of(r.pose, n, r.pose_columns)[tick] = s.pose[: r.pose_columns]
    return s.flags[BLOCKED] != 0.0 or s.flags[SILENT] != 0.0 or s.flags[TRIPPED] != 0.0


_LENGTHS = ("m", "m", "m", "rad", "rad", "rad")
_FORCES = ("N", "N", "N", "N m", "N m", "N m")
_STIFFNESS = ("N/m", "N/m", "N/m", "N m/rad", "N m/rad", "N m/rad")
_TASK = {"r": ("m", "N"), "theta": ("rad", "N m"), "z": ("m", "N"), "attitude": ("rad", "N m"),
         "head": ("rad", "N m")}  # fmt: skip


class StationLog:
    """Arrays over the run, of n ticks.

    Attributes:
        coordinates: k task coordinates.
        force: (n, k) at the tip as it is felt, task coordinates [N], [N m].
        muscles: (n, 6) forces of the operator on the handle [N], [N m].
        touching: (n,) whether the machine touches something.
    """

    def __init__(
        self, ticks: int, coordinates: tuple[str, ...], m: MasterState, s: SlaveState
    ) -> None:
        """Make room.

        Args:
            ticks: number of control ticks.
            coordinates: task coordinates of the arm.
            m: the master's state, which is kept every tick.
            s: the slave's.
        """
        self.coordinates = coordinates
        self._m, self._s, self._one, self._two = m, s, flat_view(m), flat_view(s)
        self._master = np.zeros((ticks, len(self._one)))
        self._slave = np.zeros((ticks, len(self._two)))
        self.force, self.muscles = np.zeros((ticks, len(coordinates))), np.zeros((ticks, 6))
        self.touching = np.zeros(ticks, bool)

    def arrays(self) -> dict[str, np.ndarray]:
        """What `round_trip` writes a row of after the operator's half of a tick."""
        return {"log_master": self._master, "log_slave": self._slave, "log_force": self.force,
                "log_muscles": self.muscles}  # fmt: skip

    def cut(self, ticks: int) -> None:
        """Keep the first ticks only."""
        self._master, self._slave = self._master[:ticks], self._slave[:ticks]
        self.force, self.muscles = self.force[:ticks], self.muscles[:ticks]
        self.touching = self.touching[:ticks]

    def master(self, name: str) -> np.ndarray:
        """(n, ...) of a field of MasterState, as `handle`."""
        return _field(self._master, self._m, name)

    def slave(self, name: str) -> np.ndarray:
        """(n, ...) of a field of SlaveState, as `pose`."""
        return _field(self._slave, self._s, name)

    def channels(self, every: int, rows: int) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        """Channels of the measured log.

        Args:
            every: control ticks per row.
            rows: number of rows.

        Returns:
            (channel -> (rows,), channel -> unit).
        """
        values: dict[str, np.ndarray] = {}
        units: dict[str, str] = {}
        pick = slice(0, rows * every, every)

        def put(name: str, column: np.ndarray, unit: str) -> None:
            values[name], units[name] = column[pick].copy(), unit

        handle, hand, push = self.master("handle"), self.master("hand"), self.master("push")
        stiffness, current = self.master("stiffness"), self.master("currents")
        for i, axis in enumerate(AXES):
            put(f"handle.{axis}", handle[:, i], _LENGTHS[i])
            put(f"hand_force.{axis}", hand[:, i], _FORCES[i])
            put(f"handle_force.{axis}", push[:, i], _FORCES[i])
            put(f"handle_stiffness.{axis}", stiffness[:, i], _STIFFNESS[i])
            put(f"coil_current.coil_{i + 1}", current[:, i], "A")
        pose, seen = self.slave("pose"), self.slave("measured")
        for i, name in enumerate(self.coordinates):
            place, force = _TASK[name]
            put(f"tip_force.{name}", self.force[:, i], force)
            put(f"tip_reference.{name}", pose[:, i], place)
            put(f"tip_pose.{name}", seen[:, 0, i], place)
        return values, units


def _field(table: np.ndarray, state, name: str) -> np.ndarray:
    first = 0
    for part, key in zip(state, state._fields, strict=True):
        if key == name:
            return table[:, first : first + part.size].reshape(len(table), *part.shape)
        first += part.size
    raise KeyError(name)


_FADE = 0.2  # s in which the reflected force dies out when the line is silent


class Station:
    """Operator's station of a run.

    Attributes:
        coordinates: task coordinates of the arm.
        log: what it saw and did, by control tick.
        notes: what the user should know: trips, silence, edges.
        tripped: whether the valves were closed for good.
    """

    def __init__(
        self, plant: Plant, data: mujoco.MjData, scenario: Scenario, plan: Plan,
        drives: DriveReferences, seen: Feedback, hand: Hand | None = None,
    ) -> None:  # fmt: skip
        """Put everything in place.

        Args:
            plant: the simulated machine.
            data: its state.
            scenario: with a teleoperated pilot.
            plan: references of the run, written tick by tick.
            drives: those of the drives, written tick by tick.
            seen: what the machine's sensors say, refreshed before every tick.
            hand: where a live operator wants the handle.

        Raises:
            InputError: joystick, gains or arm do not fit each other, a live operator without hand.
        """
        pilot = scenario.pilot
        assert isinstance(pilot, TeleopPilot)
        machine = plant.machine
        self._pilot, self._plan, self._data, self._seen = pilot, plan, data, seen
        self._period = 1.0 / scenario.control_rate
        joystick = load_joystick(_beside(scenario, pilot.joystick))
        joystick = held_joystick(joystick, pilot.perception, scenario.folder)
        _, axes, _ = arm_facts(machine)
        self.columns = np.array([plan.axes.index(a) for a in axes])
        self.coordinates = COORDINATES[: len(axes)]
        self._master, self._m = master(joystick, pilot, self.coordinates)
        start = plan.reference[0, self.columns]
        self._slave, self._s = slave(machine, pilot, self._master, start, scenario.servo.lead)
        self._line = _line(pilot, scenario, len(axes))
        self._flotor = SimulatedFlotor(joystick, period=self._period)
        self._qpos = self._flotor.data.qpos
        self._sensors = sensor_set(machine, scenario.sensors)
        self._feel = _estimator(machine, plan.axes, pilot, seen, self._period, self._sensors)
        self._task, self._pose = _task(pilot, seen, self._period, len(axes)), np.zeros(5)
        self._true = pilot.force == "true"
        self._force = self._feel.force if self._feel and not self._true else np.zeros(len(axes))
        self._owners = plant.model, surrounding_geoms(plant)  # whose memory the addresses are
        self._contacts = contact_record(plant.model, data, self._owners[1])
        self._elapsed = 0.0
        self.log = StationLog(scenario.ticks, self.coordinates, self._m, self._s)
        self.operator = OperatorModel(
            pilot, joystick, self._master, self.log, scenario.ticks, self._period, scenario.seed,
            hand, scenario.folder,
        )  # fmt: skip
        self.notes: list[str] = []
        self._said: set[str] = set()
        self.tripped = False
        self._faults = [_Fault(fault, plan.axes) for fault in pilot.faults]
        self._exchange: Exchange | None = None
        self._arrays = self._addressed(machine, drives)
        self._record = address_record(_STATION, self._arrays)
        swing = int(plant.dof[self.columns[0]]) if pilot.mount == "cab" else -1
        self._fill_record(swing, scenario.servo.feedforward)

    def _addressed(self, machine: Machine, drives: DriveReferences) -> dict[str, np.ndarray]:
        """Arrays of `round_trip`."""
        plan, data, line = self._plan, self._data, self._line
        grid, table = drive_tables(machine, plan.axes)
        assert plan.pose is not None
        return {
            "joint": self._seen.joint, "force": self._force, "columns": self.columns,
            "slave": flat_view(self._slave), "slave_state": flat_view(self._s),
            "master": flat_view(self._master), "master_state": flat_view(self._m),
            "forward": line.forward, "back": line.back, "packet": line.packet, "age": line.age,
            "line_state": line.state, "qpos": self._qpos,
            "muscles": flat_view(self.operator.muscles), "past": self.operator.past,
            "tremor": np.ascontiguousarray(self.operator.tremor), "qvel": data.qvel,
            "qacc": data.qacc, "grid": grid, "table": table, "reference": plan.reference,
            "rate": plan.rate, "pose": plan.pose, **drives._asdict(), **self.log.arrays(),
        }  # fmt: skip

    def _fill_record(self, swing: int, scale: float) -> None:
        """Sizes of the arrays, degree of freedom of the cab, scale of drive velocities."""
        sizes = {name: len(array) for name, array in self._arrays.items()}
        for name, value in {
            "axes": sizes["joint"], "joints": sizes["columns"], "ticks": sizes["reference"],
            "dofs": sizes["qvel"], "swing": swing, "simulated": 1, "ages": sizes["age"],
            "forward_rows": sizes["forward"], "back_rows": sizes["back"],
            "past_rows": sizes["past"], "tremor_rows": sizes["tremor"],
            "slave_size": sizes["slave"], "slave_state_size": sizes["slave_state"],
            "master_size": sizes["master"], "master_state_size": sizes["master_state"],
            "muscles_size": sizes["muscles"], "points": self._arrays["table"].shape[1],
            "pose_columns": self._arrays["pose"].shape[1], "scale": scale,
        }.items():  # fmt: skip
            self._record[name] = value

    def attach(self, exchange: Exchange) -> None:
        """Let a device in a person's hand take the place of the simulated joystick.

        Its own loop reflects what comes back; here the same law runs once more, for the logs.

        Args:
            exchange: called once per control tick, see `Exchange`.
        """
        self._exchange = exchange
        self._record["simulated"] = 0

    @property
    def numbers(self) -> Master:
        """Numbers of the master's control."""
        return self._master

    @property
    def master_state(self) -> MasterState:
        """State of the master's control, rewritten every tick."""
        return self._m

    @property
    def packet(self) -> np.ndarray:
        """(rows, k) the last packet that came from the machine, see `teleop.master`."""
        return self._line.packet

    @property
    def span(self) -> np.ndarray:
        """(2, 6) edge of the dead band and stop of every axis of the joystick [m], [rad]."""
        return self._master.axis[:, [DEADBAND, REACH]].T

    def tick(self, tick: int) -> bool:
        """Go once around; references and drive references of this tick are written.

        Args:
            tick: the control tick.

        Returns:
            Whether the valves are to be closed.
        """
        seen, operator, pilot = self._seen, self.operator, self._pilot
        for fault in self._faults:
            fault.freeze(tick * self._period, seen)
        fresh = tick % seen.every == 0
        if fresh or self._true:
            self._felt(fresh)
        if pilot.tip_over:
            push_back(
                pilot.tip_over, self._master, self._line.packet, self._slave.start,
                self._m.handle, self._m.speed, self._m.extra,
            )  # fmt: skip
        if self._exchange:
            share = float(self._line.state[SHARE])
            self._exchange(self._qpos, self._line.packet, share, self._m.extra)
        elif self._flotor.weakens:
            self._flotor.weaken_coils()
        if tick % operator.every == 0:
            operator.decide(tick)
        told = round_trip(
            self._record, self._flotor.record, tick, fresh, self._elapsed, self.tripped
        )
        self._elapsed = seen.period
        self.log.touching[tick] = self._data.ncon > 0
        if told or tick % 20 == 0:
            self._check(tick)
        return self.tripped

    def _felt(self, fresh: bool) -> None:
        """Force at the tip, and what the task is like if that is reflected."""
        seen = self._seen
        if self._feel and fresh:
            self._feel.update(seen.joint, seen.head, seen.rod)
        if self._true:
            self._true_force()
        if self._task and fresh:
            task_forward(self._slave.arm, seen.joint[self.columns], self._pose)
            self._task.update(self._force, self._pose[: len(self._force)])
            self._line.back[:, TASK_STIFFNESS] = self._task.stiffness
            self._line.back[:, TASK_DAMPING] = self._task.damping
            self._line.back[:, TASK_MASS] = self._task.mass

    def summary(self) -> dict[str, float | int | bool | None]:
        """Figures of the run: energy at the handle, currents, how far it was used, trips."""
        handle, energy = np.abs(self.log.master("handle")), self._m.energy
        return {
            "handle_energy_J": float(energy[0]),
            "handle_least_energy_J": float(energy[1]),
            "largest_handle_displacement_m": float(handle[:, :3].max()),
            "largest_handle_rotation_rad": float(handle[:, 3:].max()),
            "largest_coil_current_A": float(np.abs(self.log.master("currents")).max()),
            "largest_coil_heat": self._flotor.hottest,
            "periods_with_limited_currents": int((self.log.master("limited") < 1.0).sum()),
            "largest_tip_force_N": float(np.abs(self.log.force[:, [0, 2]]).max()),
            "tripped": self.tripped,
        }

    def _check(self, tick: int) -> None:
        """Close the valves where something is not as it must be; say why, once."""
        now, s = tick * self._period, self._s
        if s.flags[BLOCKED] and "edge" not in self._said:
            self._say("edge", f"resolved motion stood at the edge of the workspace at {now:.2f} s")
        if s.flags[SILENT] and "silent" not in self._said:
            self._say("silent", f"no packet came for a while at {now:.2f} s: rates went to zero")
        why = ""
        if s.flags[TRIPPED]:
            error = np.abs(self._seen.joint[self.columns] - s.joint)
            name = self._plan.axes[self.columns[int(np.argmax(np.nan_to_num(error, nan=np.inf)))]]
            why = f"{name} does not follow its reference"
        elif self._feel and self._sensors and tick % 20 == 0:
            frozen = self._feel.frozen(self._pilot.safety.frozen)
            why = f"the sensor {frozen[0]} always reads the same" if frozen else ""
        if why and not self.tripped:
            self.tripped = True
            self._say("trip", f"valves closed for good at {now:.2f} s: {why}")

    def _say(self, key: str, sentence: str) -> None:
        self._said.add(key)
        self.notes.append(sentence)

    def _true_force(self) -> None:
        """The simulator's own contact force in task coordinates, without moments of the tool."""
        self._force[:] = 0.0
        if not self._data.ncon:
            return
        total = np.zeros(3)
        sum_contact_forces(self._contacts, total)
        x, y, z = total
        r, theta = self._s.measured[0, :2]
        c, s = math.cos(theta), math.sin(theta)
        self._force[:3] = x * c + y * s, r * (y * c - x * s), z


class _Fault:
    """A sensor that freezes."""

    def __init__(self, fault: Fault, axes: tuple[str, ...]) -> None:
        kind, _, axis = fault.channel.partition(".")
        if axis not in axes:
            raise InputError("pilot.faults", f"{fault.channel!r}: axes are {', '.join(axes)}")
        kinds = {"angle": "joint", "pressure_head": "head", "pressure_rod": "rod"}
        if kind not in kinds:
            raise InputError("pilot.faults", f"{fault.channel!r}: kinds are {', '.join(kinds)}")
        self._at, self._name, self._column = fault.at, kinds[kind], axes.index(axis)
        self._value: float | None = None

    def freeze(self, time: float, seen: Feedback) -> None:
        """Put the frozen reading in the place of the live one."""
        readings = getattr(seen, self._name)
        if time < self._at:
            return
        if self._value is None:
            self._value = float(readings[self._column])
        readings[self._column] = self._value
        if self._name == "joint":
            seen.rate[self._column] = 0.0


def _estimator(
    machine: Machine,
    axes: tuple[str, ...],
    pilot: TeleopPilot,
    seen: Feedback,
    period: float,
    sensors: SensorSet | None,
) -> EndpointForce | None:
    """What tells the force at the tip, and that a sensor is frozen; none where neither is asked."""
    if pilot.force == "true" and sensors is None:
        return None
    kind = "static" if pilot.force == "true" else pilot.force
    return EndpointForce(
        machine, axes, kind, period * seen.every, sensors=sensors,
        bandwidth=_hertz(pilot), fast=2.0 * _hertz(pilot),
    )  # fmt: skip


def _hertz(pilot: TeleopPilot) -> float:
    return pilot.bandwidth / (2.0 * math.pi)


def _task(pilot: TeleopPilot, seen: Feedback, period: float, k: int) -> TaskImpedance | None:
    """What identifies the task where that is reflected."""
    if pilot.reflection != "impedance":
        return None
    bands = (2.0 * _hertz(pilot), _hertz(pilot))
    return TaskImpedance(k, period * seen.every, bands, late=pilot.force != "true")


def _beside(scenario: Scenario, name: str) -> str:
    """A joystick's file, counted from the scenario's."""
    path = Path(scenario.folder, name)
    return str(path) if name != "joystick" and path.is_file() else name


def _line(pilot: TeleopPilot, scenario: Scenario, k: int) -> Line:
    """Empty delay lines, and the packets that will be lost."""
    channel, period = pilot.channel, 1.0 / scenario.control_rate
    for name in ("delay_forward", "delay_back"):
        if (delay := getattr(channel, name)) >= scenario.duration:
            message = f"{delay:g} s is as long as the run ({scenario.duration:g} s)"
            raise InputError(f"pilot.channel.{name}", message)
    delays = _delays(scenario, channel, period)
    rng = np.random.default_rng([scenario.seed, 404])
    lost = rng.random((scenario.ticks, 2)) < channel.lost
    lost[: round(channel.lost_from / period)] = False
    age = np.stack([arrivals(delays[:, side]) for side in range(2)], axis=1)
    age[lost] = -1
    age = np.ascontiguousarray(age, np.int64)
    longest = np.maximum(delays.max(axis=0), 0)
    return Line(
        np.zeros((1 + longest[0], 3, 6)), np.zeros((1 + longest[1], 8, k)), np.zeros((8, k)), age,
        np.array([0.0, 1.0, period, pilot.safety.silence, _FADE]),
    )  # fmt: skip


def _delays(scenario: Scenario, channel: Channel, period: float) -> np.ndarray:
    """Delays of all packets in ticks (ticks, 2), forward and back; -1 for those that get lost."""
    ticks = scenario.ticks
    if channel.trace:
        path = Path(scenario.folder, channel.trace)
        measured = np.stack(load_delays(path), axis=1)
        found = in_periods(measured, period)
        if np.any(found.max(axis=0) < 0):
            raise InputError(path, "all packets of one way are lost; nothing can be steered so")
        return np.resize(found, (ticks, 2))
    steady = np.array([channel.delay_forward, channel.delay_back])
    if not channel.jitter:
        return np.broadcast_to(np.round(steady / period).astype(int), (ticks, 2))
    rng = np.random.default_rng([scenario.seed, 405])
    return in_periods(steady + rng.exponential(channel.jitter, (ticks, 2)), period)
