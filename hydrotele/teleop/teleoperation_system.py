"""Closed-loop teleoperation system: operator, joystick, channel and machine, period by period.

In every control period the machine's sensors give the tip force. A delayed packet transmits it to
the master, and the joystick reflects it. The operator perceives and pushes. A second delayed packet
transmits the handle's motion to the machine, where it becomes joint references.
"""

import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from hydrotele.control.arm_kinematics import COORDINATES, arm_specification
from hydrotele.control.endpoint_force import EndpointForce
from hydrotele.control.plan import Plan
from hydrotele.control.servo import DriveReferences, tabulate_drive_geometry
from hydrotele.control.task_impedance import TaskImpedance
from hydrotele.core.contiguous_state import flat_view
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.joystick import load_joystick
from hydrotele.machine.machine import Machine, get_sensor_set
from hydrotele.machine.sensors import SensorSet
from hydrotele.scenario.scenario import Scenario, find_scenario_joystick
from hydrotele.scenario.teleoperation import Channel, SensorFault, TeleopPilot
from hydrotele.simulate.contact_forces import make_contact_addresses, mark_surrounding_geoms, sum_contact_forces
from hydrotele.simulate.joystick import SimulatedFlotor
from hydrotele.simulate.mujoco_c_api import field_offsets
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.sensor_models import Feedback
from hydrotele.teleop.axis_table import DEADBAND, HANDLE_RANGE
from hydrotele.teleop.hand_impedance import attach_operator_hand
from hydrotele.teleop.master import TASK_DAMPING, TASK_MASS, TASK_STIFFNESS, MasterParameters, MasterState, build_master
from hydrotele.teleop.operator_model import HandInput, OperatorModel
from hydrotele.teleop.packet_delays import compute_ages_on_arrival, delays_to_periods, load_packet_delays
from hydrotele.teleop.slave import (
    HELD_AT_EDGE,
    NO_PACKETS,
    VALVES_CLOSED,
    build_slave,
)
from hydrotele.teleop.teleoperation_log import TeleoperationLog
from hydrotele.teleop.teleoperation_step import PACKET_GAIN, STATION_DTYPE, TICKS_PER_CHECK, ChannelBuffers
from hydrotele.teleop.tip_over_protection import compute_tip_over_protection

DeviceExchange = Callable[[np.ndarray, np.ndarray, float, np.ndarray], None]
"""Function that connects a device, called once per control tick.

It writes the handle's pose (7,) [m] and quaternion, NaN without a device. It receives the machine's
packet (rows, k), the factor on it, and the additional force on the handle (6,) [N], [N m].
"""


_FADE_TIME = 0.2  # s, fade-out time of the reflected force when no packets arrive


class TeleoperationSystem:
    """Teleoperation loop of one run: operator, joystick, channel and references of the machine.

    Attributes:
        coordinates: task coordinates of the arm.
        log: recorded signals by control tick.
        notes: messages for the user: valves closed after a fault, missing packets, motion held at
            the workspace edge.
        valves_closed: whether the valves were closed permanently.
    """

    def __init__(
        self, plant: Plant, data: mujoco.MjData, scenario: Scenario, plan: Plan,
        drives: DriveReferences, feedback: Feedback, hand_input: HandInput | None = None,
    ) -> None:  # fmt: skip
        """Build the teleoperation loop for a run of a scenario.

        Args:
            plant: the simulated machine.
            data: state of the simulation.
            scenario: scenario with a teleoperated pilot.
            plan: references of the run, written tick by tick.
            drives: references of the drives, written tick by tick.
            feedback: sensor readings of the machine, refreshed before every tick.
            hand_input: function that returns the handle reference of a live operator; None for a
                simulated one.

        Raises:
            InputError: joystick, gains and arm are not compatible, or a live operator has no input.
        """
        pilot = scenario.pilot
        assert isinstance(pilot, TeleopPilot)
        machine = plant.machine
        self._pilot, self._plan, self._data, self._feedback = pilot, plan, data, feedback
        self._period = 1.0 / scenario.control_rate
        joystick = load_joystick(find_scenario_joystick(scenario))
        joystick = attach_operator_hand(joystick, pilot.perception, scenario.folder)
        _, axes, _ = arm_specification(machine)
        self.columns = np.array([plan.axes.index(a) for a in axes])
        self.coordinates = COORDINATES[: len(axes)]
        self._master, self._m = build_master(joystick, pilot, self.coordinates)
        start = plan.reference[0, self.columns]
        self._slave, self._s = build_slave(machine, pilot, self._master, start, scenario.servo.lead)
        self._line = _make_channel_buffers(pilot, scenario, len(axes))
        self._flotor = SimulatedFlotor(joystick, period=self._period)
        self._qpos = self._flotor.data.qpos
        self._sensors = get_sensor_set(machine, scenario.sensors)
        self._force_estimator = _make_force_estimator(machine, plan.axes, pilot, feedback, self._period, self._sensors)
        self._task_estimator, self._pose = (
            _make_task_estimator(pilot, feedback, self._period, len(axes)),
            np.zeros(5),
        )
        self._uses_true_force = pilot.force == "true"
        self._force = (
            self._force_estimator.force if self._force_estimator and not self._uses_true_force else np.zeros(len(axes))
        )
        self._owners = plant.model, mark_surrounding_geoms(plant)  # keep the memory of addresses alive
        self._contacts = make_contact_addresses(plant.model, data, self._owners[1])
        self.log = TeleoperationLog(scenario.tick_count, self.coordinates, self._m, self._s)
        self.operator = OperatorModel(
            pilot, joystick, self._master, self.log, scenario.tick_count, self._period, scenario.seed,
            hand_input, scenario.folder,
        )  # fmt: skip
        self.notes: list[str] = []
        self._noted_keys: set[str] = set()
        self.valves_closed = False
        self._faults = [_FrozenSensor(fault, plan.axes) for fault in pilot.faults]
        self._every_tick = bool(self._faults or self._uses_true_force or pilot.tip_over or self._flotor.has_edge_loss)
        self._exchange: DeviceExchange | None = None
        self._arrays = self._collect_arrays(machine, drives)
        self._record = address_record(STATION_DTYPE, self._arrays)
        swing = int(plant.dof[self.columns[0]]) if pilot.mount == "cab" else -1
        self._fill_record(swing, scenario.servo.feedforward)

    def _collect_arrays(self, machine: Machine, drives: DriveReferences) -> dict[str, np.ndarray]:
        """Return name -> array whose memory address the compiled loop (`step_teleoperation`) uses."""
        plan, data, line = self._plan, self._data, self._line
        grid, table = tabulate_drive_geometry(machine, plan.axes)
        assert plan.pose is not None
        return {
            "joint": self._feedback.joint, "force": self._force, "columns": self.columns,
            "slave": flat_view(self._slave), "slave_state": flat_view(self._s),
            "master": flat_view(self._master), "master_state": flat_view(self._m),
            "forward": line.forward, "back": line.back, "packet": line.packet, "age": line.age,
            "line_state": line.state, "qpos": self._qpos,
            "muscles": flat_view(self.operator.muscles), "past": self.operator.displacement_history,
            "tremor": np.ascontiguousarray(self.operator.tremor), "qvel": data.qvel,
            "qacc": data.qacc, "grid": grid, "table": table, "reference": plan.reference,
            "rate": plan.rate, "pose": plan.pose, **drives._asdict(), **self.log.tick_arrays(),
        }  # fmt: skip

    def _fill_record(self, swing: int, scale: float) -> None:
        """Write the sizes of all arrays and the settings of the run to the record of the compiled loop.

        `swing` is the degree of freedom that moves the cab with the joystick, -1 for a fixed joystick;
        `scale` is the servo's feedforward, a factor on the reference velocities of the drives.
        """
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
            "sampled": self._feedback.ticks_per_sample, "sample_period": self._feedback.period,
            "contacts": self._data._address + field_offsets("mjData")["ncon"],
        }.items():  # fmt: skip
            self._record[name] = value

    def attach_device(self, exchange: DeviceExchange) -> None:
        """Replace the simulated joystick by a real haptic device.

        The device's own loop computes its force; here the same control law runs again, for the logs.

        Args:
            exchange: called once per control tick, see `DeviceExchange`.
        """
        self._exchange = exchange
        self._record["simulated"] = 0

    @property
    def master_parameters(self) -> MasterParameters:
        """Parameters of the master's control."""
        return self._master

    @property
    def master_state(self) -> MasterState:
        """State of the master's control, updated every tick."""
        return self._m

    @property
    def packet(self) -> np.ndarray:
        """Last packet (8, k) from the machine that the master received, rows as in `teleop.master`."""
        return self._line.packet

    @property
    def deadbands_and_stops(self) -> np.ndarray:
        """Dead-band edges (row 0) and stops (row 1) of the six joystick axes, (2, 6) [m], [rad]."""
        return self._master.axis[:, [DEADBAND, HANDLE_RANGE]].T

    def prepare_tick(self, tick: int) -> None:
        """Run the Python part of a control tick, before the compiled part (`step_teleoperation`).

        It applies sensor faults, updates the force estimate and the tip-over protection, exchanges
        data with a real device, and lets the simulated operator decide.

        Args:
            tick: number of the control tick.
        """
        seen, operator, pilot = self._feedback, self.operator, self._pilot
        for fault in self._faults:
            fault.freeze(tick * self._period, seen)
        fresh = tick % seen.ticks_per_sample == 0
        if fresh or self._uses_true_force:
            self._update_forces(fresh)
        if pilot.tip_over:
            compute_tip_over_protection(
                pilot.tip_over, self._master, self._line.packet, self._slave.start,
                self._m.handle, self._m.speed, self._m.extra,
            )  # fmt: skip
        if self._exchange:
            share = float(self._line.state[PACKET_GAIN])
            self._exchange(self._qpos, self._line.packet, share, self._m.extra)
        elif self._flotor.has_edge_loss:
            self._flotor.update_coil_force_constants()
        if tick % operator.ticks_per_decision == 0:
            operator.decide_handle_reference(tick)

    def next_prepared_tick(self, tick: int) -> int:
        """Return the next control tick after `tick` that needs `prepare_tick`.

        These are the ticks with a decision of the operator or a sensor sample. Every tick needs it
        with a real device, sensor faults, exact contact force, tip-over protection, or coils whose
        force falls towards the end of their gap.
        """
        if self._exchange or self._every_tick:
            return tick + 1
        every = math.gcd(self.operator.ticks_per_decision, self._feedback.ticks_per_sample)
        return tick - tick % every + every

    def run_safety_checks(self, tick: int) -> bool:
        """Run the safety checks before the machine moves; return whether to close the valves.

        The valves close permanently if a joint does not follow its reference or a sensor's reading
        is constant. Messages for the user are added to `notes`.

        Args:
            tick: control tick for which `step_teleoperation` returned true, or a multiple of
                `TICKS_PER_CHECK`.
        """
        self._close_valves_on_fault(tick)
        return self.valves_closed

    @property
    def memory_records(self) -> tuple[np.ndarray, np.ndarray]:
        """Memory records of this loop and of the simulated joystick for `step_teleoperation`."""
        return self._record, self._flotor.record

    def _update_forces(self, fresh: bool) -> None:
        """Update the estimated or exact tip force, and the estimated task impedance if reflected.

        `fresh` is true if the sensors have a new sample.
        """
        seen = self._feedback
        if self._force_estimator and fresh:
            self._force_estimator.update(seen.joint, seen.head, seen.rod)
        if self._uses_true_force:
            self._update_true_force()
        if self._task_estimator and fresh:
            compute_tip_pose(self._slave.arm, seen.joint[self.columns], self._pose)
            self._task_estimator.update(self._force, self._pose[: len(self._force)])
            self._line.back[:, TASK_STIFFNESS] = self._task_estimator.stiffness
            self._line.back[:, TASK_DAMPING] = self._task_estimator.damping
            self._line.back[:, TASK_MASS] = self._task_estimator.mass

    def summary(self) -> dict[str, float | int | bool | None]:
        """Return name -> statistic of the run.

        Statistics are the energy from the hand into the handle and its minimum [J], the largest
        displacement [m] and rotation [rad] of the handle, the largest coil current [A] and relative
        coil heat [1]. Others are the number of periods with limited currents, the largest radial or
        vertical tip force [N], and whether the valves were closed permanently (`tripped`).
        """
        handle, energy = np.abs(self.log.master("handle")), self._m.energy
        return {
            "handle_energy_J": float(energy[0]),
            "min_handle_energy_J": float(energy[1]),
            "max_handle_displacement_m": float(handle[:, :3].max()),
            "max_handle_rotation_rad": float(handle[:, 3:].max()),
            "max_coil_current_A": float(np.abs(self.log.master("currents")).max()),
            "max_coil_heat": self._flotor.max_relative_temperature_rise,
            "periods_with_limited_currents": int((self.log.master("limited") < 1.0).sum()),
            "max_tip_force_N": float(np.abs(self.log.force[:, [0, 2]]).max()),
            "tripped": self.valves_closed,
        }

    def _close_valves_on_fault(self, tick: int) -> None:
        """Set `valves_closed` if a joint does not follow its reference or a sensor is constant.

        The reason is added to `notes`, and also a message about missing packets and one about
        motion held at the workspace edge, each once.
        """
        now, s = tick * self._period, self._s
        if s.flags[HELD_AT_EDGE] and "edge" not in self._noted_keys:
            self._add_note("edge", f"resolved motion held at the edge of the workspace at {now:.2f} s")
        if s.flags[NO_PACKETS] and "silent" not in self._noted_keys:
            self._add_note("silent", f"packets are missing at {now:.2f} s: rates set to zero")
        why = ""
        if s.flags[VALVES_CLOSED]:
            error = np.abs(self._feedback.joint[self.columns] - s.joint)
            name = self._plan.axes[self.columns[int(np.argmax(np.nan_to_num(error, nan=np.inf)))]]
            why = f"{name} does not follow its reference"
        elif self._force_estimator and self._sensors and tick % TICKS_PER_CHECK == 0:
            frozen = self._force_estimator.find_constant_channels(self._pilot.safety.frozen_time)
            why = f"the readings of sensor {frozen[0]} are constant" if frozen else ""
        if why and not self.valves_closed:
            self.valves_closed = True
            self._add_note("trip", f"valves closed permanently at {now:.2f} s: {why}")

    def _add_note(self, key: str, sentence: str) -> None:
        self._noted_keys.add(key)
        self.notes.append(sentence)

    def _update_true_force(self) -> None:
        """Set the tip force to the simulator's exact contact force, in task coordinates.

        The elements are radial force [N], moment about the swing axis [N m] and vertical force [N];
        moments of the tool stay 0.
        """
        self._force[:] = 0.0
        if not self._data.ncon:
            return
        total = np.zeros(3)
        sum_contact_forces(self._contacts, total)
        x, y, z = total
        r, theta = self._s.measured[0, :2]
        c, s = math.cos(theta), math.sin(theta)
        self._force[:3] = x * c + y * s, r * (y * c - x * s), z


class _FrozenSensor:
    """Simulated sensor fault: a sensor repeats its reading from a given time on."""

    def __init__(self, fault: SensorFault, axes: tuple[str, ...]) -> None:
        kind, _, axis = fault.channel.partition(".")
        if axis not in axes:
            raise InputError("pilot.faults", f"{fault.channel!r}: axes are {', '.join(axes)}")
        kinds = {"angle": "joint", "pressure_head": "head", "pressure_rod": "rod"}
        if kind not in kinds:
            raise InputError("pilot.faults", f"{fault.channel!r}: kinds are {', '.join(kinds)}")
        self._start_time, self._name, self._column = fault.start, kinds[kind], axes.index(axis)
        self._value: float | None = None

    def freeze(self, time: float, seen: Feedback) -> None:
        """Hold the reading in `seen` at its value in the first call at or after the start of the fault.

        Before that, `seen` is unchanged. `time` is the present time [s]. While a joint sensor is held,
        the measured joint rate is 0.
        """
        readings = getattr(seen, self._name)
        if time < self._start_time:
            return
        if self._value is None:
            self._value = float(readings[self._column])
        readings[self._column] = self._value
        if self._name == "joint":
            seen.rate[self._column] = 0.0


def _make_force_estimator(
    machine: Machine,
    axes: tuple[str, ...],
    pilot: TeleopPilot,
    seen: Feedback,
    period: float,
    sensors: SensorSet | None,
) -> EndpointForce | None:
    """Create the estimator of the tip force from the drive pressures.

    Return None if the exact force is used and the machine has no sensors. If the exact force is
    used with sensors, the estimator serves only to find constant readings.
    """
    if pilot.force == "true" and sensors is None:
        return None
    kind = "static" if pilot.force == "true" else pilot.force
    return EndpointForce(
        machine, axes, kind, period * seen.ticks_per_sample, sensors=sensors,
        bandwidth=_force_bandwidth_hz(pilot), motion_bandwidth=2.0 * _force_bandwidth_hz(pilot),
    )  # fmt: skip


def _force_bandwidth_hz(pilot: TeleopPilot) -> float:
    return pilot.bandwidth / (2.0 * math.pi)


def _make_task_estimator(pilot: TeleopPilot, seen: Feedback, period: float, k: int) -> TaskImpedance | None:
    """Create the estimator of the task's mass, damping and stiffness for `reflection: impedance`.

    Return None for other reflections; k is the number of task coordinates.
    """
    if pilot.reflection != "impedance":
        return None
    bands = (2.0 * _force_bandwidth_hz(pilot), _force_bandwidth_hz(pilot))
    return TaskImpedance(k, period * seen.ticks_per_sample, bands, force_is_filtered=pilot.force != "true")


def _make_channel_buffers(pilot: TeleopPilot, scenario: Scenario, k: int) -> ChannelBuffers:
    """Create the channel's buffers and ages of arriving packets, from delays, jitter and losses.

    `k` is the number of task coordinates. Raise InputError for a delay that is not shorter than the
    run.
    """
    channel, period = pilot.channel, 1.0 / scenario.control_rate
    for name in ("delay_forward", "delay_back"):
        if (delay := getattr(channel, name)) >= scenario.duration:
            message = f"{delay:g} s is not shorter than the run ({scenario.duration:g} s)"
            raise InputError(f"pilot.channel.{name}", message)
    delays = _packet_delays(scenario, channel, period)
    rng = np.random.default_rng([scenario.seed, 404])
    lost = rng.random((scenario.tick_count, 2)) < channel.loss_probability
    lost[: round(channel.loss_start / period)] = False
    age = np.stack([compute_ages_on_arrival(delays[:, side]) for side in range(2)], axis=1)
    age[lost] = -1
    age = np.ascontiguousarray(age, np.int64)
    longest = np.maximum(delays.max(axis=0), 0)
    return ChannelBuffers(
        np.zeros((1 + longest[0], 3, 6)), np.zeros((1 + longest[1], 8, k)), np.zeros((8, k)), age,
        np.array([0.0, 1.0, period, pilot.safety.packet_timeout, _FADE_TIME]),
    )  # fmt: skip


def _packet_delays(scenario: Scenario, channel: Channel, period: float) -> np.ndarray:
    """Return the delays (ticks, 2) of all packets of a run, forward and back, in control ticks.

    They are constant, or a constant plus an exponentially distributed jitter, or from a trace file,
    which is repeated as often as necessary. Lost packets of a trace are -1.
    """
    ticks = scenario.tick_count
    if channel.trace:
        path = Path(scenario.folder, channel.trace)
        measured = np.stack(load_packet_delays(path), axis=1)
        found = delays_to_periods(measured, period)
        if np.any(found.max(axis=0) < 0):
            raise InputError(path, "all packets of one direction are lost; steering is impossible")
        return np.resize(found, (ticks, 2))
    steady = np.array([channel.delay_forward, channel.delay_back])
    if not channel.jitter:
        return np.broadcast_to(np.round(steady / period).astype(int), (ticks, 2))
    rng = np.random.default_rng([scenario.seed, 405])
    return delays_to_periods(steady + rng.exponential(channel.jitter, (ticks, 2)), period)
