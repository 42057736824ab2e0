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
RATE = 1000.0  # Hz, control rate with a haptic device; one physics step per tick


def haptic_address(device: str) -> tuple[str, int]:
    """Parse `haptic`, `haptic:HOST` or `haptic:HOST:PORT`.

    Args:
        device: value of the command-line option `--device`.

    Returns:
        Host and port; the defaults are this computer and the standard port.

    Raises:
        InputError: the value has another form.

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
        self.link, self._switches = Link(host, port), Switches(further)
        self._count, self._held, self._state = further, 0, "new"

    def attach(self, session: Session) -> None:
        """Replace the simulated joystick of a session."""
        assert session.station
        station = session.station
        self.link.start(station.numbers, station.master_state, station.packet.shape)
        station.attach(self.link.exchange)

    def read(self, time: float) -> Reading:
        """Return the commands of the buttons, and a message when the connection changes."""
        pose = self.link.pose()
        said = self._news(pose is not None, self.link.engaged)
        if pose:
            pressed, self._held = pose.buttons & ~self._held, pose.buttons
            for number in range(self._count):
                if pressed >> number & 1:
                    self._switches.turn(number)
        return Reading(commands=tuple(self._switches.commands), said=said)

    def _news(self, there: bool, engaged: bool) -> str:
        """Return a message if the state of the connection has changed, otherwise an empty text."""
        before, self._state = self._state, "gone" if not there else "moves" if engaged else "waits"
        if self._state == before:
            return ""
        if there:
            return _ENGAGED if engaged else "a haptic device is connected: centre its handle"
        if before == "new":
            return "no haptic device responds yet: start hydrotele haptic-device"
        self._switches.off()
        return "the haptic device does not respond: the machine gets no command"

    def close(self) -> None:
        """Close the connection; the device then applies no force."""
        self.link.close()


PATIENCE = 0.25  # s by which the simulation may lag behind real time before it pauses
_TELL = 2.0  # s, shortest time between two messages about lost real time
_LED = 5  # decimals of a recorded handle position
_SLOW_CLOCK = 0.002  # s: shorter waits are skipped, because a sleep is not that accurate


class TimeKeeper(Protocol):
    """Synchronises simulated time with the wall clock.

    Attributes:
        pauses: number of times that simulated time was paused.
        late: total duration of the pauses [s].
    """

    pauses: int
    late: float

    def now(self) -> float:
        """Return the wall-clock time [s]."""
        ...

    def wait(self, simulated: float) -> float:
        """Wait until a simulated time is due; return the pause just inserted [s]."""
        ...

    def close(self) -> None:
        """Release the timer."""
        ...


class Pacer:
    """Synchronises simulated time with the wall clock; pauses it if the computer is too slow.

    Attributes:
        pauses: number of pauses.
        late: total duration of the pauses [s].
    """

    def __init__(
        self, speed: float = 1.0, now: Callable[[], float] = clock.perf_counter,
        sleep: Callable[[float], None] = clock.sleep,
    ) -> None:  # fmt: skip
        """Prepare the timer; it starts with the first call of `wait`.

        Args:
            speed: simulated time per real time [1]; 0 means as fast as possible.
            now: function that returns the wall-clock time [s].
            sleep: function that waits for a time [s].
        """
        self.speed, self.now, self._sleep = speed, now, sleep
        self._begin: float | None = None
        self.pauses, self.late = 0, 0.0

    def wait(self, simulated: float) -> float:
        """Wait until a simulated time is due.

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
        if early > _SLOW_CLOCK:
            self._sleep(early)
        if early >= -PATIENCE:
            return 0.0
        self._begin -= early
        self.pauses += 1
        self.late -= early
        return -early

    def close(self) -> None:
        """Do nothing; a `Pacer` holds no resources."""


class LiveHand:
    """Reference position of the handle from an input device, with the recorded input.

    Attributes:
        span: (2, 6) dead-band edge and end of travel of every axis [m], [rad]; the range of a
            device axis is mapped to the interval between them.
    """

    def __init__(self, further: dict[str, float]) -> None:
        """Start at the centre.

        Args:
            further: axis that the joystick does not move -> command limit.
        """
        self.span = np.zeros((2, 6))
        self._further, self._wanted = further, np.zeros(6)
        self._before = Reading(commands=(0.0,) * len(further))
        self._time, self._path = [0.0], [(0.0,) * 6]
        self._buttons = [Button(at=0.0, axis=name, command=0.0) for name in further]

    def __call__(self) -> np.ndarray:
        """Return the current reference position of the handle, (6,) [m], [rad]."""
        return self._wanted

    def take(self, reading: Reading, session: Session) -> None:
        """Apply a device reading from the next tick of the session on, and record it."""
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
        """Record the handle position (6,) [m], [rad] of a haptic device at a run time [s].

        A repetition uses it as the reference of the simulated hand. The arm dynamics of that hand
        make the repetition similar, but not bit-identical.
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
        """Return the scenario that repeats the recorded input, with a duration [s]."""
        columns = zip(AXES, zip(*self._path, strict=True), strict=True)
        path = {name: list(values) for name, values in columns if any(values)}
        operator = Follow.model_validate(
            {"kind": "follow", "time": self._time, "path": path, "interpolate": "hold"}
        )
        pilot = scenario.pilot.model_copy(update={"operator": operator, "buttons": self._buttons})
        return scenario.model_copy(update={"pilot": pilot, "duration": duration})


class Status(NamedTuple):
    """Values displayed to the operator, updated several times per second.

    Attributes:
        time: simulated time [s].
        handle: (6,) displacement of the handle [m], [rad].
        hand: (6,) force of the hand, as estimated by the joystick [N], [N m].
        tip: task coordinate -> reflected tip force [N], [N m].
        contact: (3,) total contact force in the world frame [N].
        commands: additional axis -> command.
    """

    time: float
    handle: np.ndarray
    hand: np.ndarray
    tip: dict[str, float]
    contact: np.ndarray
    commands: dict[str, float]

    def rows(self) -> list[tuple[str, str]]:
        """Return (name, formatted value) pairs for display."""
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
"""Callback after every tick: session, status function, wall-clock time [s]; False stops the run."""


def further_axes(machine: Machine) -> dict[str, float]:
    """Return the axes that the joystick does not move, with their command limits."""
    moved = arm_axes(machine)
    return {
        name: axis.force.command_limit if axis.force else 1.0
        for name, axis in machine.axes.items()
        if name not in moved
    }


def live(scenario: Scenario, further: Iterable[str]) -> Scenario:
    """Replace the operator of a teleoperated scenario by a live one.

    Args:
        scenario: a scenario with `pilot.kind: teleop`.
        further: axes that are commanded with buttons.

    Raises:
        InputError: the scenario has no joystick.
    """
    pilot = scenario.pilot
    if not isinstance(pilot, TeleopPilot):
        message = f"pilot kind {pilot.kind} has no joystick; use a scenario with `kind: teleop`"
        raise InputError(f"scenario {scenario.name}", message)
    buttons = [Button(at=0.0, axis=name, command=0.0) for name in further]
    update = {"operator": Live(kind="live"), "buttons": buttons}
    return scenario.model_copy(update={"pilot": pilot.model_copy(update=update)})


def drive(
    scenario: Scenario, machine: Machine, device: Device, pacer: TimeKeeper,
    watch: Watch, say: Callable[[str], None],
) -> Run:  # fmt: skip
    """Run a teleoperated scenario with an input device.

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
    # with a haptic device, read it in ticks without a force estimate and a log row
    phase = every // 2 if haptic else 0
    while session.tick < session.scenario.ticks:
        if session.tick % every == phase or not session.tick:  # tick 0 compiles, timing is free
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
        if pacer.wait(session.time):  # starts after the first tick, which compiles code
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
    """Passes on each note and event of a session once."""

    def __init__(self, session: Session, say: Callable[[str], None]) -> None:
        assert session.station
        self._notes, self._events = session.station.notes, session.events
        self._say, self._count = say, [0, 0]
        self._due = -math.inf

    def late(self, pacer: TimeKeeper) -> None:
        """Report pauses of simulated time, at most once every `_TELL` seconds."""
        if pacer.now() >= self._due:
            self._due = pacer.now() + _TELL
            self._say(f"computer too slow for real time: paused, {pacer.late:.2f} s in total")

    def news(self) -> None:
        """Report new notes and events."""
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
