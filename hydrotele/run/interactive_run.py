"""Interactive driving: run a teleoperated scenario in real time with an input device.

The input device gives the reference position of the simulated operator's hand. The input is
recorded, and the scenario of the run repeats it bit for bit. A haptic device replaces the simulated
joystick; its handle motion is recorded, but a repetition is not bit-identical.
"""

import math
import time as clock
from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol

import numpy as np

from hydrotele.control.arm_kinematics import arm_axes
from hydrotele.core.errors import InputError
from hydrotele.haptics.link import HapticLink
from hydrotele.haptics.server import DEFAULT_PORT
from hydrotele.machine.joystick import AXES
from hydrotele.machine.machine import Machine
from hydrotele.run.devices import Device, Reading, SwitchedCommands
from hydrotele.run.run import Run, finish_run, start_session
from hydrotele.run.session import Session
from hydrotele.scenario.scenario import Scenario
from hydrotele.scenario.teleoperation import ButtonCommand, FollowPath, LiveOperator, TeleopPilot
from hydrotele.simulate.contact_forces import mark_surrounding_bodies, total_contact_force

HAPTIC = "haptic"
_ENGAGED_MESSAGE = "the haptic device moves the machine"
LOCAL_HOST = "127.0.0.1"
HAPTIC_CONTROL_RATE = 1000.0  # Hz, control rate with a haptic device; one physics step per tick


def parse_haptic_address(device: str) -> tuple[str, int]:
    """Return host and port of a haptic device from `haptic`, `haptic:HOST` or `haptic:HOST:PORT`.

    Args:
        device: value of the command-line option `--device`.

    Returns:
        Host and port; the defaults are this computer and the standard port.

    Raises:
        InputError: the value has another form.

    >>> parse_haptic_address("haptic:10.0.0.7")
    ('10.0.0.7', 5610)
    """
    parts = device.split(":")
    host = parts[1] if len(parts) > 1 else LOCAL_HOST
    port = parts[2] if len(parts) > 2 else str(DEFAULT_PORT)
    right = parts[0] == HAPTIC and len(parts) <= 3 and host and port.isdecimal()
    if not right or not 0 < int(port) < 65536:
        raise InputError(f"--device {device}", "must be haptic, haptic:HOST or haptic:HOST:PORT")
    return host, int(port)


class HapticHandle:
    """The handle of a haptic device, connected to its server through the network.

    Its buttons switch the axes that the joystick does not move, like those of a SpaceMouse.

    Attributes:
        link: connection to the server.
    """

    def __init__(self, host: str, port: int, further: int) -> None:
        """Open the connection.

        Args:
            host: host name or address of the server.
            port: port of the server.
            further: number of axes that the joystick does not move.

        Raises:
            InputError: the host is unknown.
        """
        self.link, self._switches = HapticLink(host, port), SwitchedCommands(further)
        self._count, self._pressed_buttons, self._state = further, 0, "new"

    def replace_simulated_joystick(self, session: Session) -> None:
        """Replace the simulated joystick of a session by this haptic device.

        From then on, the session sends its forces to the device and uses the measured handle motion.
        """
        assert session.station
        station = session.station
        self.link.start(station.master_parameters, station.master_state, station.packet.shape)
        station.attach_device(self.link.exchange)

    def read(self, time: float) -> Reading:
        """Return the commands switched by the buttons, and a message when the connection changes.

        The handle axes of the reading are 0, because the device itself replaces the joystick.
        """
        pose = self.link.pose()
        said = self._connection_message(pose is not None, self.link.engaged)
        if pose:
            pressed, self._pressed_buttons = pose.buttons & ~self._pressed_buttons, pose.buttons
            for number in range(self._count):
                if pressed >> number & 1:
                    self._switches.cycle_command(number)
        return Reading(commands=tuple(self._switches.commands), user_message=said)

    def _connection_message(self, is_connected: bool, engaged: bool) -> str:
        """Return a message if the state of the connection has changed, otherwise an empty text.

        If the device no longer answers, all commands of the buttons are set to 0.

        Args:
            is_connected: whether the device has answered recently.
            engaged: whether the handle of the device moves the machine.
        """
        before, self._state = (
            self._state,
            "gone" if not is_connected else "moves" if engaged else "waits",
        )
        if self._state == before:
            return ""
        if is_connected:
            return _ENGAGED_MESSAGE if engaged else "a haptic device is connected: centre its handle"
        if before == "new":
            return "no haptic device responds yet: start hydrotele haptic-device"
        self._switches.zero_all_commands()
        return "the haptic device does not respond: the machine gets no command"

    def close(self) -> None:
        """Close the connection; the device then applies no force."""
        self.link.close()


MAX_LATENESS = 0.25  # s by which the simulation may lag behind real time before it pauses
_MESSAGE_INTERVAL = 2.0  # s, shortest time between two messages about lost real time
_HANDLE_DECIMALS = 5  # decimals of a recorded handle position
_MIN_SLEEP = 0.002  # s: shorter waits are skipped, because a sleep is not that accurate


class TimeKeeper(Protocol):
    """Interface of a timer that synchronises simulated time with the wall clock.

    Attributes:
        pauses: number of times that simulated time was paused.
        total_delay: total duration of the pauses [s].
    """

    pauses: int
    total_delay: float

    def now(self) -> float:
        """Return the wall-clock time [s]."""
        ...

    def wait_for_tick(self, simulated: float) -> float:
        """Wait until the wall clock reaches a simulated time [s].

        Returns:
            The time by which the simulation was delayed because the computer is too slow [s].
        """
        ...

    def close(self) -> None:
        """Release the timer."""
        ...


class Pacer:
    """Timer that synchronises simulated time with the wall clock, and pauses it if the computer is too slow.

    Attributes:
        pauses: number of pauses.
        total_delay: total duration of the pauses [s].
    """

    def __init__(
        self, speed: float = 1.0, now: Callable[[], float] = clock.perf_counter,
        sleep: Callable[[float], None] = clock.sleep,
    ) -> None:  # fmt: skip
        """Prepare the timer; it starts with the first call of `wait_for_tick`.

        Args:
            speed: simulated time per real time [1]; 0 means as fast as possible.
            now: function that returns the wall-clock time [s].
            sleep: function that waits for a time [s].
        """
        self.speed, self.now, self._sleep = speed, now, sleep
        self._begin: float | None = None
        self.pauses, self.total_delay = 0, 0.0

    def wait_for_tick(self, simulated: float) -> float:
        """Wait until the wall clock reaches a simulated time.

        If the simulation is more than 0.25 s late, this lateness counts as a pause of simulated
        time. The simulation then continues at normal speed instead of catching up.

        Args:
            simulated: simulated time so far [s].

        Returns:
            The pause just inserted because the simulation was late [s]; 0 if it keeps up.
        """
        if self.speed <= 0.0:
            return 0.0
        due, now = simulated / self.speed, self.now()
        if self._begin is None:
            self._begin = now - due
        early = self._begin + due - now
        if early > _MIN_SLEEP:
            self._sleep(early)
        if early >= -MAX_LATENESS:
            return 0.0
        self._begin -= early
        self.pauses += 1
        self.total_delay -= early
        return -early

    def restart(self) -> None:
        """Let simulated time continue at the next call of `wait_for_tick`, after a stop that is no pause."""
        self._begin = None

    def close(self) -> None:
        """Do nothing; a `Pacer` holds no resources."""


class LiveHandReference:
    """Reference position of the joystick handle from an input device, with a record of the input.

    Attributes:
        travel_range: (2, 6) edge of the dead band and end of travel of every handle axis [m], [rad]. The
            range of a device axis is mapped to the interval between them.
    """

    def __init__(self, further: dict[str, float]) -> None:
        """Start with a centred handle and with all commands 0.

        Args:
            further: axis that the joystick does not move -> command limit.
        """
        self.travel_range = np.zeros((2, 6))
        self._further, self._reference = further, np.zeros(6)
        self._before = Reading(commands=(0.0,) * len(further))
        self._time, self._path = [0.0], [(0.0,) * 6]
        self._buttons = [ButtonCommand(start=0.0, axis=name, command=0.0) for name in further]

    def __call__(self) -> np.ndarray:
        """Return the current reference position of the handle, (6,) [m], [rad]."""
        return self._reference

    def apply_reading(self, reading: Reading, session: Session) -> None:
        """Set handle reference and commands of a session from a device reading, and record their changes.

        A device axis of -1 .. 1 is mapped to `travel_range`, and a command to its limit. Both apply
        from the next control tick on.
        """
        if reading.axes != self._before.axes:
            part, (dead, stop) = np.array(reading.axes), self.travel_range
            dead = np.where(dead < stop, dead, 0.0)
            self._reference = np.sign(part) * dead + part * (stop - dead)
            self._record_reference(session.time, self._reference)
        news = zip(self._further.items(), self._before.commands, reading.commands, strict=True)
        for (name, most), old, new in news:
            if new != old:
                session.set_command(name, most * new)
                self._buttons.append(ButtonCommand(start=session.time, axis=name, command=most * new))
        self._before = reading

    def record_handle(self, handle: np.ndarray, time: float) -> None:
        """Record the measured handle position (6,) [m], [rad] of a haptic device at a time of the run [s].

        The position is rounded to 5 decimals. When the recorded scenario is simulated again, a
        simulated hand follows it. The dynamics of its arm make the new run similar, but not
        bit-identical.
        """
        wanted = [round(value, _HANDLE_DECIMALS) for value in handle.tolist()]
        if wanted != self._reference.tolist():
            self._reference = np.array(wanted)
            self._record_reference(time, self._reference)

    def _record_reference(self, time: float, wanted: np.ndarray) -> None:
        if time == self._time[-1]:
            self._path[-1] = tuple(wanted.tolist())
            return
        self._time.append(time)
        self._path.append(tuple(wanted.tolist()))

    def recorded_scenario(self, scenario: Scenario, duration: float) -> Scenario:
        """Return a copy of a scenario whose operator repeats the recorded input.

        Args:
            scenario: the scenario that was driven.
            duration: duration of the copy [s].
        """
        columns = zip(AXES, zip(*self._path, strict=True), strict=True)
        path = {name: list(values) for name, values in columns if any(values)}
        operator = FollowPath.model_validate(
            {"kind": "follow", "time": self._time, "path": path, "interpolate": "hold"}
        )
        pilot = scenario.pilot.model_copy(update={"operator": operator, "buttons": self._buttons})
        return scenario.model_copy(update={"pilot": pilot, "duration": duration})


class Status(NamedTuple):
    """Values displayed to the operator, updated several times per second.

    Attributes:
        time: simulated time [s].
        handle: (6,) displacement of the handle [m], [rad].
        hand_force: (6,) force of the hand on the handle, as estimated by the joystick [N], [N m].
        tip_force: task coordinate, such as `r` or `z` -> estimated force at the tip [N], [N m].
        total_contact_force: (3,) sum of the contact forces of ground and objects on the machine,
            world frame [N].
        commands: axis that the joystick does not move -> command.
    """

    time: float
    handle: np.ndarray
    hand_force: np.ndarray
    tip_force: dict[str, float]
    total_contact_force: np.ndarray
    commands: dict[str, float]

    def rows(self) -> list[tuple[str, str]]:
        """Return (name, formatted value) pairs for display."""
        x, y, z = (1e3 * self.handle[:3]).tolist()
        push = " ".join(f"{v:+.1f}" for v in self.hand_force[:3])
        forces = [f"{n} {f / 1e3:+.1f}" for n, f in self.tip_force.items() if n in ("r", "z")]
        named = [(name, f"{value:+g}") for name, value in self.commands.items()]
        return [
            ("time", f"{self.time:.1f} s"),
            ("handle", f"x {x:+.1f} y {y:+.1f} z {z:+.1f} mm ry {self.handle[4]:+.3f} rad"),
            ("hand", f"{push} N"),
            ("tip", f"{' '.join(forces)} kN"),
            ("contact", f"{np.linalg.norm(self.total_contact_force) / 1e3:.1f} kN"),
            *named,
        ]


TickCallback = Callable[[Session, Callable[[], Status], float], bool]
"""Callback after every tick: session, status function, wall-clock time [s]; False stops the run."""


def axes_not_moved_by_joystick(machine: Machine) -> dict[str, float]:
    """Return axis name -> command limit, for the machine axes that the joystick does not move.

    The limit is 1 for valves and in the unit of the drive for others.
    """
    moved = arm_axes(machine)
    return {
        name: axis.force.command_limit if axis.force else 1.0
        for name, axis in machine.axes.items()
        if name not in moved
    }


def with_live_operator(scenario: Scenario, button_axes: Iterable[str]) -> Scenario:
    """Return a copy of a teleoperated scenario whose operator is a live user.

    Args:
        scenario: a scenario with `pilot.kind: teleop`.
        button_axes: axes that the user commands with buttons, because the joystick does not move them.

    Raises:
        InputError: the scenario has no joystick.
    """
    pilot = scenario.pilot
    if not isinstance(pilot, TeleopPilot):
        message = f"pilot kind {pilot.kind} has no joystick; use a scenario with `kind: teleop`"
        raise InputError(f"scenario {scenario.name}", message)
    buttons = [ButtonCommand(start=0.0, axis=name, command=0.0) for name in button_axes]
    update = {"operator": LiveOperator(kind="live"), "buttons": buttons}
    return scenario.model_copy(update={"pilot": pilot.model_copy(update=update)})


def drive_scenario(
    scenario: Scenario, machine: Machine, device: Device, pacer: TimeKeeper,
    watch: TickCallback, say: Callable[[str], None],
) -> Run:  # fmt: skip
    """Run a teleoperated scenario in which a user moves the machine with an input device.

    Args:
        scenario: the scenario; its duration is the maximum duration of the run.
        machine: machine of the scenario.
        device: input device of the operator.
        pacer: synchronises simulated time with the wall clock.
        watch: callback after every tick, for display; it can stop the run.
        say: callback for messages to the operator.

    Returns:
        The run up to the stop; its scenario repeats it.

    Raises:
        InputError: the scenario does not fit the machine, or the run is too short for a log.
        SimulationFailed: states became infinite or not a number.
    """
    further = axes_not_moved_by_joystick(machine)
    hand = LiveHandReference(further)
    session = start_session(with_live_operator(scenario, further), hand)
    station = session.station
    assert station
    hand.travel_range = station.deadbands_and_stops
    haptic = device if isinstance(device, HapticHandle) else None
    if haptic:
        haptic.replace_simulated_joystick(session)
    handle = station.log.master("handle")
    status, told = _make_status_function(session, further), _MessageReporter(session, say)
    every = station.operator.ticks_per_decision
    # with a haptic device, read it in ticks without a force estimate and a log row
    phase = every // 2 if haptic else 0
    while session.tick < session.scenario.tick_count:
        if session.tick % every == phase or not session.tick:  # tick 0 compiles, timing is free
            reading = device.read(session.time)
            if reading.user_message:
                say(reading.user_message)
            if reading.quit:
                break
            hand.apply_reading(reading, session)
            if haptic:
                hand.record_handle(handle[max(0, session.tick - 1)], session.time)
        session.advance()
        told.report_new_messages()
        if not watch(session, status, pacer.now()):
            break
        if haptic and session.tick == 1:
            haptic.link.reset_statistics()
        if pacer.wait_for_tick(session.time):  # starts after the first tick, which compiles code
            told.report_pauses(pacer)
    seen = haptic.link.statistics() if haptic else {}
    while session.tick % session.ticks_per_row:  # the logs hold whole rows
        session.advance()
    run = finish_run(session, hand.recorded_scenario(session.scenario, session.time))
    run.summary.update(paused_seconds=round(pacer.total_delay, 3), pauses=pacer.pauses)
    if haptic:
        run.summary["haptic"] = seen
    return run


class _MessageReporter:
    """Reporter that passes each new note and event of a session to the user once, and reports pauses."""

    def __init__(self, session: Session, say: Callable[[str], None]) -> None:
        assert session.station
        self._notes, self._events = session.station.notes, session.events
        self._say, self._count = say, [0, 0]
        self._due = -math.inf

    def report_pauses(self, pacer: TimeKeeper) -> None:
        """Report pauses of simulated time, at most once every `_MESSAGE_INTERVAL` seconds."""
        if pacer.now() >= self._due:
            self._due = pacer.now() + _MESSAGE_INTERVAL
            self._say(f"computer too slow for real time: paused, {pacer.total_delay:.2f} s in total")

    def report_new_messages(self) -> None:
        """Pass on the notes and events of the session since the last call."""
        notes, events = self._notes, self._events
        if self._count == [len(notes), len(events)]:
            return
        for note in notes[self._count[0] :]:
            self._say(note)
        for time, said in events[self._count[1] :]:
            self._say(f"{said} at {time:.1f} s")
        self._count = [len(notes), len(events)]


def _make_status_function(session: Session, further: Iterable[str]) -> Callable[[], Status]:
    plant, station = session.plant, session.station
    assert station
    around = mark_surrounding_bodies(plant)
    handle, hand = station.log.master("handle"), station.log.master("hand")
    places = [plant.axes.index(name) for name in further]

    def status() -> Status:
        last = max(0, session.tick - 1)
        contact = total_contact_force(plant.model, session.data, around)
        commands = session.commands_at(last)[places].tolist()
        tip: dict[str, float] = dict(zip(station.coordinates, station.log.force[last].tolist(), strict=True))
        return Status(
            session.time, handle[last], hand[last], tip, contact,
            dict(zip(further, commands, strict=True)),
        )  # fmt: skip

    return status
