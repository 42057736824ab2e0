"""A person at the joystick: the same station as in a run, in real time, the hand led by a device.

What the device asked for is written down, so that the run's own scenario repeats it bit for bit.
A haptic device takes the joystick's place: what it asks for, and what its line has seen.
"""

import math
import time as clock
from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol

import numpy as np

from hydrotele.control.resolved_motion import arm_axes
from hydrotele.core.errors import InputError
from hydrotele.haptics.link import Link
from hydrotele.haptics.server import PORT
from hydrotele.machine.joystick import AXES
from hydrotele.machine.machine import Machine
from hydrotele.run.devices import Device, Reading, Switches
from hydrotele.run.run import Run, Session, begin, finished
from hydrotele.scenario.scenario import Scenario
from hydrotele.scenario.teleoperation import Button, Follow, Live, TeleopPilot
from hydrotele.simulate.record import contact_force, surrounding_bodies

HAPTIC = "haptic"
_ENGAGED = "the haptic device moves the machine"
LOCAL = "127.0.0.1"
RATE = 1000.0  # Hz of the machine's control beside a device; one physics step per tick


def haptic_address(device: str) -> tuple[str, int]:
    """Host and port of `haptic`, `haptic:HOST` or `haptic:HOST:PORT`.

    Args:
        device: as the command line has it.

    Returns:
        Host and port; this computer and the usual port where they are left out.

    Raises:
        InputError: it is none of these.

    >>> haptic_address("haptic:10.0.0.7")
    ('10.0.0.7', 5610)
    """
    parts = device.split(":")
    host = parts[1] if len(parts) > 1 else LOCAL
    port = parts[2] if len(parts) > 2 else str(PORT)
    right = parts[0] == HAPTIC and len(parts) <= 3 and host and port.isdecimal()
    if not right or not 0 < int(port) < 65536:
        raise InputError(f"--device {device}", "must be haptic, haptic:HOST or haptic:HOST:PORT")
    return host, int(port)


class HapticHandle:
    """The handle of a haptic device whose server runs elsewhere.

    Its buttons switch the axes that the joystick does not move, as those of a SpaceMouse do.

    Attributes:
        link: the line to the server.
    """

    def __init__(self, host: str, port: int, further: int) -> None:
        """Open the line.

        Args:
            host: of the server.
            port: of the server.
            further: number of axes that the joystick does not move.

        Raises:
            InputError: there is no such host.
        """
        self.link, self._switches = Link(host, port), Switches(further)
        self._count, self._held, self._state = further, 0, "new"

    def attach(self, session: Session) -> None:
        """Take the place of the simulated joystick of a session."""
        assert session.station
        station = session.station
        self.link.start(station.numbers, station.master_state, station.packet.shape)
        station.attach(self.link.exchange)

    def read(self, time: float) -> Reading:
        """What the buttons ask for, and whether the device has come or gone."""
        pose = self.link.pose()
        said = self._news(pose is not None, self.link.engaged)
        if pose:
            pressed, self._held = pose.buttons & ~self._held, pose.buttons
            for number in range(self._count):
                if pressed >> number & 1:
                    self._switches.turn(number)
        return Reading(commands=tuple(self._switches.commands), said=said)

    def _news(self, there: bool, engaged: bool) -> str:
        """What has changed, in a sentence; nothing where nothing has."""
        before, self._state = self._state, "gone" if not there else "moves" if engaged else "waits"
        if self._state == before:
            return ""
        if there:
            return _ENGAGED if engaged else "a haptic device is there: centre its handle to begin"
        if before == "new":
            return "no haptic device answers yet: start hydrotele haptic-device"
        self._switches.off()
        return "the haptic device is silent: the machine has no command"

    def close(self) -> None:
        """Close the line; the device then goes limp."""
        self.link.close()


PATIENCE = 0.25  # s that simulated time may be late before it is stopped
_TELL = 2.0  # s between two sentences that it cannot keep up
_LED = 5  # decimals of a handle's place that is written down
_SLOW_CLOCK = 0.002  # s: shorter sleeps cost more than they give


class TimeKeeper(Protocol):
    """Keeps simulated time to the wall clock: a `Pacer`, or the deadlines of a haptic device."""

    pauses: int
    late: float

    def now(self) -> float:
        """The clock [s]."""
        ...

    def wait(self, simulated: float) -> float:
        """Wait until it is time; by how much simulated time was just set back [s]."""
        ...

    def close(self) -> None:
        """No time is kept any more."""
        ...


class Pacer:
    """Keeps simulated time to the wall clock; where it falls behind, simulated time stands still.

    Attributes:
        pauses: how often it was late.
        late: seconds in all.
    """

    def __init__(
        self, speed: float = 1.0, now: Callable[[], float] = clock.perf_counter,
        sleep: Callable[[float], None] = clock.sleep,
    ) -> None:  # fmt: skip
        """Begin when `wait` is called first.

        Args:
            speed: simulated per real time; 0 is as fast as it goes.
            now: a clock [s].
            sleep: waits for a time [s].
        """
        self.speed, self.now, self._sleep = speed, now, sleep
        self._begin: float | None = None
        self.pauses, self.late = 0, 0.0

    def wait(self, simulated: float) -> float:
        """Wait until it is time.

        Args:
            simulated: time that has been simulated [s].

        Returns:
            By how much simulated time was just set back [s]; 0 if it keeps up.
        """
        if self.speed <= 0.0:
            return 0.0
        due, now = simulated / self.speed, self.now()
        if self._begin is None:
            self._begin = now - due
        early = self._begin + due - now
        if early > _SLOW_CLOCK:
            self._sleep(early)
        if early >= -PATIENCE:
            return 0.0
        self._begin -= early
        self.pauses += 1
        self.late -= early
        return -early

    def close(self) -> None:
        """Nothing was taken that has to be given back."""


class LiveHand:
    """Where the device wants the handle, and what it has asked for so far.

    Attributes:
        span: (2, 6) edge of the dead band and stop of every axis [m], [rad]; a device's axis goes
            from the one to the other.
    """

    def __init__(self, further: dict[str, float]) -> None:
        """Begin at the centre.

        Args:
            further: axes that the joystick does not move, with their largest commands.
        """
        self.span = np.zeros((2, 6))
        self._further, self._wanted = further, np.zeros(6)
        self._before = Reading(commands=(0.0,) * len(further))
        self._time, self._path = [0.0], [(0.0,) * 6]
        self._buttons = [Button(at=0.0, axis=name, command=0.0) for name in further]

    def __call__(self) -> np.ndarray:
        """Where the handle is wanted now, (6,) [m], [rad]."""
        return self._wanted

    def take(self, reading: Reading, session: Session) -> None:
        """Follow a reading from the session's next tick on."""
        if reading.axes != self._before.axes:
            part, (dead, stop) = np.array(reading.axes), self.span
            dead = np.where(dead < stop, dead, 0.0)
            self._wanted = np.sign(part) * dead + part * (stop - dead)
            self._note(session.time, self._wanted)
        news = zip(self._further.items(), self._before.commands, reading.commands, strict=True)
        for (name, most), old, new in news:
            if new != old:
                session.set_command(name, most * new)
                self._buttons.append(Button(at=session.time, axis=name, command=most * new))
        self._before = reading

    def led(self, handle: np.ndarray, time: float) -> None:
        """Write down where a device's handle was, (6,) [m], [rad], at a time of the run [s].

        What is written down is where a simulated hand is to hold the joystick. It follows with its
        own arm, so that a repetition is alike, not the same bit for bit.
        """
        wanted = [round(value, _LED) for value in handle.tolist()]
        if wanted != self._wanted.tolist():
            self._wanted = np.array(wanted)
            self._note(time, self._wanted)

    def _note(self, time: float, wanted: np.ndarray) -> None:
        if time == self._time[-1]:
            self._path[-1] = tuple(wanted.tolist())
            return
        self._time.append(time)
        self._path.append(tuple(wanted.tolist()))

    def written_down(self, scenario: Scenario, duration: float) -> Scenario:
        """The scenario that repeats what was done, of a duration [s]."""
        columns = zip(AXES, zip(*self._path, strict=True), strict=True)
        path = {name: list(values) for name, values in columns if any(values)}
        operator = Follow.model_validate(
            {"kind": "follow", "time": self._time, "path": path, "interpolate": "hold"}
        )
        pilot = scenario.pilot.model_copy(update={"operator": operator, "buttons": self._buttons})
        return scenario.model_copy(update={"pilot": pilot, "duration": duration})


class Status(NamedTuple):
    """What the operator is told, refreshed a few times a second.

    Attributes:
        time: simulated [s].
        handle: (6,) displacement [m], [rad].
        hand: (6,) force of the hand, as the joystick feels it [N], [N m].
        tip: task coordinate -> force at the tip, as it is reflected [N], [N m].
        contact: (3,) force of all that is touched, world frame [N].
        commands: further axis -> command.
    """

    time: float
    handle: np.ndarray
    hand: np.ndarray
    tip: dict[str, float]
    contact: np.ndarray
    commands: dict[str, float]

    def rows(self) -> list[tuple[str, str]]:
        """Names and values, for a line or a table."""
        x, y, z = (1e3 * self.handle[:3]).tolist()
        push = " ".join(f"{v:+.1f}" for v in self.hand[:3])
        forces = [f"{n} {f / 1e3:+.1f}" for n, f in self.tip.items() if n in ("r", "z")]
        named = [(name, f"{value:+g}") for name, value in self.commands.items()]
        return [
            ("time", f"{self.time:.1f} s"),
            ("handle", f"x {x:+.1f} y {y:+.1f} z {z:+.1f} mm ry {self.handle[4]:+.3f} rad"),
            ("hand", f"{push} N"),
            ("tip", f"{' '.join(forces)} kN"),
            ("contact", f"{np.linalg.norm(self.contact) / 1e3:.1f} kN"),
            *named,
        ]


Watch = Callable[[Session, Callable[[], Status], float], bool]
"""Called after every tick with session, status and wall clock [s]; False ends the drive."""


def further_axes(machine: Machine) -> dict[str, float]:
    """Axes of a machine that the joystick does not move -> largest command."""
    moved = arm_axes(machine)
    return {
        name: axis.force.command_limit if axis.force else 1.0
        for name, axis in machine.axes.items()
        if name not in moved
    }


def live(scenario: Scenario, further: Iterable[str]) -> Scenario:
    """The scenario with a live operator instead of its own.

    Args:
        scenario: a teleoperated one.
        further: axes that get buttons.

    Raises:
        InputError: it has no joystick.
    """
    pilot = scenario.pilot
    if not isinstance(pilot, TeleopPilot):
        message = f"its pilot is {pilot.kind}, which has no joystick; `kind: teleop` has one"
        raise InputError(f"scenario {scenario.name}", message)
    buttons = [Button(at=0.0, axis=name, command=0.0) for name in further]
    update = {"operator": Live(kind="live"), "buttons": buttons}
    return scenario.model_copy(update={"pilot": pilot.model_copy(update=update)})


def drive(
    scenario: Scenario, machine: Machine, device: Device, pacer: TimeKeeper,
    watch: Watch, say: Callable[[str], None],
) -> Run:  # fmt: skip
    """Let a person drive a scenario.

    Args:
        scenario: of the longest duration; `live` gives it its operator.
        machine: the scenario's.
        device: what the person drives with.
        pacer: keeps time.
        watch: shows what happens.
        say: told what the operator should know at once.

    Returns:
        The run as far as it went; its scenario repeats it.

    Raises:
        InputError: the scenario asks for what the machine has not, or it was too short for a log.
        SimulationFailed: states became infinite or not a number.
    """
    further = further_axes(machine)
    hand = LiveHand(further)
    session = begin(live(scenario, further), hand)
    station = session.station
    assert station
    hand.span = station.span
    haptic = device if isinstance(device, HapticHandle) else None
    if haptic:
        haptic.attach(session)
    handle = station.log.master("handle")
    status, told = _status_of(session, further), _Told(session, say)
    every = station.operator.every
    # beside a haptic device not in the ticks in which estimate of force and log row are due, too
    phase = every // 2 if haptic else 0
    while session.tick < session.scenario.ticks:
        if session.tick % every == phase or not session.tick:  # what it compiles is in no hurry
            reading = device.read(session.time)
            if reading.said:
                say(reading.said)
            if reading.quit:
                break
            hand.take(reading, session)
            if haptic:
                hand.led(handle[max(0, session.tick - 1)], session.time)
        session.advance()
        told.news()
        if not watch(session, status, pacer.now()):
            break
        if haptic and session.tick == 1:
            haptic.link.restart_figures()
        if pacer.wait(session.time):  # begins after the first tick has compiled and shown
            told.late(pacer)
    seen = haptic.link.figures() if haptic else {}
    while session.tick % session.every:  # the logs hold whole rows
        session.advance()
    run = finished(session, hand.written_down(session.scenario, session.time))
    run.summary.update(late_seconds=round(pacer.late, 3), pauses=pacer.pauses)
    if haptic:
        run.summary["haptic"] = seen
    return run


class _Told:
    """Notes and events, each told once."""

    def __init__(self, session: Session, say: Callable[[str], None]) -> None:
        assert session.station
        self._notes, self._events = session.station.notes, session.events
        self._say, self._count = say, [0, 0]
        self._due = -math.inf

    def late(self, pacer: TimeKeeper) -> None:
        """Tell that simulated time was stopped, now and then."""
        if pacer.now() >= self._due:
            self._due = pacer.now() + _TELL
            self._say(f"cannot keep up: paused, {pacer.late:.2f} s in all")

    def news(self) -> None:
        """Tell what is new."""
        notes, events = self._notes, self._events
        if self._count == [len(notes), len(events)]:
            return
        for note in notes[self._count[0] :]:
            self._say(note)
        for time, said in events[self._count[1] :]:
            self._say(f"{said} at {time:.1f} s")
        self._count = [len(notes), len(events)]


def _status_of(session: Session, further: Iterable[str]) -> Callable[[], Status]:
    plant, station = session.plant, session.station
    assert station
    around = surrounding_bodies(plant)
    handle, hand = station.log.master("handle"), station.log.master("hand")
    places = [plant.axes.index(name) for name in further]

    def status() -> Status:
        last = max(0, session.tick - 1)
        contact = contact_force(plant.model, session.data, around)
        commands = session.command_of(last)[places].tolist()
        tip: dict[str, float] = dict(
            zip(station.coordinates, station.log.force[last].tolist(), strict=True)
        )
        return Status(
            session.time, handle[last], hand[last], tip, contact,
            dict(zip(further, commands, strict=True)),
        )  # fmt: skip

    return status
