"""Run a scenario whose commands come from a client program over ZeroMQ with msgpack messages.

Every request and reply is one message with a msgpack map. A ROUTER socket takes requests of REQ and
DEALER clients; docs/live.md describes the protocol. In lockstep the machine moves only while a
client requests it. In real time it moves at the rate of the wall clock, and a request for a step is
answered after the next control tick.

One client drives: the first that requests a step. It is released by its request, or when it is
silent for longer than the timeout; all commands are then 0. Other clients can read the state.
A request that is not valid is answered with an error and changes nothing.
"""

import time as clock
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.haptics.timing import RealTimePacer, read_load_averages, summarise_durations
from hydrotele.run.run import Run, finish_run, start_session
from hydrotele.run.session import Session
from hydrotele.scenario.pilots import ConstantPilot, TablePilot
from hydrotele.scenario.scenario import Scenario
from hydrotele.simulate.record import SimulationFailed

DEFAULT_PORT = 5620
PROTOCOL_VERSION = 1
MAX_REQUEST_BYTES = 4096  # a longer request is answered with an error
MAX_FRAME_BYTES = 65536  # ZeroMQ closes the connection of a client that sends a longer frame
MAX_TICKS = 1000  # control ticks of one request in lockstep
_POLL_MS = 100  # ms between two checks for Ctrl-C while no message comes
_MAX_REQUESTS_AT_ONCE = 100  # that are answered before the next control tick
_PRIORITY = 20  # real-time priority in real time, where the system permits it
_GRACE_TIME = 0.5  # s after the end in which late requests get the last state
_LINGER_MS = 500  # ms to deliver the last replies
_REQUESTS = ("describe", "read", "step", "release", "stop")


class LiveOptions(NamedTuple):
    """Options of a live server.

    Attributes:
        is_realtime: whether time follows the wall clock; otherwise lockstep.
        timeout: silence after which the driving client is released [s].
        host: address to listen on.
        port: TCP port; 0 for any free port.
    """

    is_realtime: bool = False
    timeout: float = 1.0
    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT


def import_live_libraries() -> tuple[Any, Any]:
    """Return the modules zmq and msgpack.

    Raises:
        InputError: they are not installed.
    """
    try:
        import msgpack
        import zmq
    except ImportError:
        raise InputError("hydrotele serve", "needs pyzmq and msgpack: pip install 'hydrotele[serve]'") from None
    return zmq, msgpack


class LiveServer:
    """Server of a running session; requests of clients set its commands and, in lockstep, advance it.

    Attributes:
        session: the session.
        port: TCP port.
        requests: number of requests so far.
        errors: number of requests that were answered with an error.
        is_stopped: whether a client has stopped the run.
        has_started: whether a client has requested a step.
    """

    def __init__(self, session: Session, options: LiveOptions) -> None:
        """Open the socket.

        Raises:
            InputError: the libraries are missing, or the address is not usable.
        """
        self._zmq, self._msgpack = import_live_libraries()
        self.session, self._options = session, options
        self._context = self._zmq.Context()
        self._socket = self._context.socket(self._zmq.ROUTER)
        self._socket.setsockopt(self._zmq.MAXMSGSIZE, MAX_FRAME_BYTES)
        self._socket.setsockopt(self._zmq.LINGER, _LINGER_MS)
        try:
            self._socket.bind(f"tcp://{options.host}:{options.port or '*'}")
        except self._zmq.ZMQError as error:
            self.close()
            raise InputError(f"{options.host}:{options.port}", f"cannot listen there: {error}") from None
        self.port = int(self._socket.getsockopt_string(self._zmq.LAST_ENDPOINT).rpartition(":")[2])
        self.requests, self.errors, self.is_stopped, self.has_started = 0, 0, False, False
        self._driver: bytes | None = None
        self._last_request = 0.0
        self._waiting: list[list[bytes]] = []
        axes = [session.plant.machine.axes[name] for name in session.plant.axes]
        self._limits = [axis.force.command_limit if axis.force else 1.0 for axis in axes]
        self.commands = np.zeros(len(axes))

    def close(self) -> None:
        """Close the socket, after the last replies are delivered."""
        self._socket.close()
        self._context.term()

    def serve_for(self, seconds: float) -> None:
        """Answer requests for a duration, and release a silent driver [s]."""
        end = clock.perf_counter() + seconds
        while (left := end - clock.perf_counter()) > 0.0:
            if self._socket.poll(int(1e3 * left)):
                self.answer_pending_requests()
            elif left < 1e-3:
                clock.sleep(left)
        self.answer_pending_requests()

    def answer_pending_requests(self) -> None:
        """Answer the requests that have arrived, and release a silent driver."""
        for _ in range(_MAX_REQUESTS_AT_ONCE):
            if not self._socket.poll(0):
                break
            frames = self._socket.recv_multipart(copy=True)
            self.requests += 1
            envelope = frames[: 2 if len(frames) == 3 and not frames[1] else 1]
            try:
                reply = self._answer(envelope, frames[len(envelope) :])
            except InputError as error:
                self.errors += 1
                reply = {"error": error.message}
            if reply is not None:
                self._send(envelope, reply)
        if self._driver and clock.perf_counter() - self._last_request > self._options.timeout and not self._waiting:
            self._release()

    def send_waiting_replies(self, error: str | None = None) -> None:
        """Answer the clients that wait for the end of a control tick, with the state or an error."""
        if self._waiting:
            self._last_request = clock.perf_counter()  # silence starts with the reply
        for envelope in self._waiting:
            self._send(envelope, {"error": error} if error else self._state())
        self._waiting = []

    def _send(self, envelope: list[bytes], reply: dict[str, Any]) -> None:
        self._socket.send_multipart([*envelope, self._msgpack.packb(reply)])

    def _answer(self, envelope: list[bytes], content: list[bytes]) -> dict[str, Any] | None:
        """Return the reply to a request; None if it follows after the next control tick.

        Raises:
            InputError: the request is not valid.
        """
        request = self._unpack(content)
        action = request.pop("do", None)
        if not isinstance(action, str) or action not in _REQUESTS:
            raise InputError("do", f"do must be one of {', '.join(_REQUESTS)}")
        allowed = {"step": {"command", "ticks"}}.get(action, set())
        if unknown := [key for key in request if key not in allowed]:
            raise InputError(
                action, f"{unknown[0]!r} is not a key of {action}; valid: do, {', '.join(sorted(allowed))}"
            )
        if action == "describe":
            return self._describe()
        if action == "read":
            return self._state()
        client = envelope[0]
        if self._driver not in (None, client):
            raise InputError(action, "another client drives; you can only describe and read")
        if action == "stop":
            self.is_stopped = True
            return self._state()
        if action == "release":
            self._release()
            return self._state()
        commands, ticks = self._check_step(request)
        if self._is_done():
            return self._state()
        if self._waiting:
            raise InputError("step", "the step before is not finished yet: wait for its reply")
        self._driver, self._last_request, self.has_started = client, clock.perf_counter(), True
        self.commands = commands
        if self._options.is_realtime:
            self._waiting.append(envelope)
            return None
        self.advance(ticks)
        self._last_request = clock.perf_counter()
        return self._state()

    def advance(self, ticks: int) -> None:
        """Advance the session by control ticks with the present commands, at most to its end."""
        ticks = min(ticks, self.session.scenario.tick_count - self.session.tick)
        self.session.set_commands(self.commands, ticks)
        self.session.advance(ticks)

    def _unpack(self, content: list[bytes]) -> dict[str, Any]:
        """Return the map of a request.

        Raises:
            InputError: the request is too long, or not a msgpack map.
        """
        if len(content) != 1:
            raise InputError("request", "a request is one frame")
        if len(content[0]) > MAX_REQUEST_BYTES:
            raise InputError("request", f"{len(content[0])} bytes; a request has at most {MAX_REQUEST_BYTES}")
        try:
            request = self._msgpack.unpackb(content[0])
        except ValueError:
            raise InputError("request", "is not msgpack") from None
        if not isinstance(request, dict):
            raise InputError("request", "a request is a map with the key do")
        return request

    def _check_step(self, request: dict[str, Any]) -> tuple[np.ndarray, int]:
        """Return the commands of all axes and the number of ticks of a request for a step.

        Raises:
            InputError: unknown axis, or a value of the wrong type or out of range.
        """
        given, ticks = request.get("command", {}), request.get("ticks", 1)
        if not isinstance(given, dict):
            raise InputError("command", "command must be a map from axis names to numbers")
        commands = self.commands.copy()
        for name, value in given.items():
            if name not in self.session.plant.axes:
                message = suggest_valid_name(str(name), self.session.plant.axes)
                raise InputError("command", f"{name!r} is not an axis; {message}")
            i = self.session.plant.axes.index(name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= self._limits[i]:
                limit = self._limits[i]
                raise InputError("command", f"command of {name}: {value!r} must be a number, -{limit:g} .. {limit:g}")
            commands[i] = value
        if isinstance(ticks, bool) or not isinstance(ticks, int) or not 1 <= ticks <= MAX_TICKS:
            raise InputError("ticks", f"ticks: {ticks!r} must be an integer, 1 .. {MAX_TICKS}")
        if self._options.is_realtime and ticks != 1:
            raise InputError("ticks", "in real time a step is one control tick")
        return commands, ticks

    def _release(self) -> None:
        """Release the driving client and set all commands to 0."""
        self._driver = None
        self.commands = np.zeros(len(self.commands))

    def _is_done(self) -> bool:
        return self.is_stopped or self.session.tick >= self.session.scenario.tick_count

    def _describe(self) -> dict[str, Any]:
        """Return machine, axes, limits, units and rates."""
        session = self.session
        machine, scenario = session.plant.machine, session.scenario
        return {
            "protocol": PROTOCOL_VERSION,
            "mode": "realtime" if self._options.is_realtime else "lockstep",
            "scenario": scenario.name,
            "machine": machine.name,
            "tool": machine.tool,
            "axes": list(session.plant.axes),
            "command_limits": self._limits,
            "hydraulic_axes": session.plant.hydraulic,
            "supplies": list(machine.pumps) if machine.valve_axes else [],
            "control_rate": scenario.control_rate,
            "duration": scenario.duration,
            "timeout": self._options.timeout,
        }

    def _state(self) -> dict[str, Any]:
        """Return time, sensor readings and commands."""
        seen, count = self.session.sensor_feedback, self.session.plant.hydraulic
        return {
            "time": self.session.time,
            "tick": self.session.tick,
            "position": seen.joint.tolist(),
            "velocity": seen.rate.tolist(),
            "pressure_head": seen.head[:count].tolist(),
            "pressure_rod": seen.rod[:count].tolist(),
            "pressure_supply": seen.supply.tolist() if count else [],
            "command": self.commands.tolist(),
            "done": self._is_done(),
        }


def serve_scenario(
    scenario: Scenario, options: LiveOptions, say: Callable[[str], None],
    is_interrupted: Callable[[], bool] = lambda: False,
) -> Run:  # fmt: skip
    """Run a scenario with the commands of clients, until its end, a request to stop, or an interrupt.

    The pilot of the scenario is not used. The run starts with the first step that a client requests.

    Args:
        scenario: the scenario; its duration is the maximum duration of the run.
        options: mode, timeout and address.
        say: callback for the message that the server listens.
        is_interrupted: function that returns whether to stop.

    Returns:
        The run; its scenario contains the commands and repeats it bit for bit.

    Raises:
        InputError: the scenario does not fit the machine, the address is not usable, or the run is
            too short for a log.
        SimulationFailed: states became infinite or not a number.
    """
    import_live_libraries()
    scenario = scenario.model_copy(update={"pilot": ConstantPilot(kind="constant")})
    session = start_session(scenario)
    server = LiveServer(session, options)
    pacer = RealTimePacer(scenario.tick_count, _PRIORITY, sleep=server.serve_for)
    mode = "real time" if options.is_realtime else "lockstep"
    say(f"{scenario.name}, {mode}, listens on tcp://{options.host}:{server.port}")
    try:
        while not (is_interrupted() or server.is_stopped or session.tick >= scenario.tick_count):
            if not (options.is_realtime and server.has_started):
                server.serve_for(1e-3 * _POLL_MS)
                continue
            server.advance(1)
            server.send_waiting_replies()
            pacer.wait_for_tick(session.time)  # starts after the first tick, which loads compiled code
        server.serve_for(_GRACE_TIME)
        while session.tick % session.ticks_per_row:  # the logs hold whole rows
            server.advance(1)
    except SimulationFailed:
        server.send_waiting_replies("the simulation is unstable; the run has ended")
        raise
    finally:
        pacer.close()
        server.send_waiting_replies()
        server.close()
    run = finish_run(session, _recorded_scenario(scenario, session))
    run.summary["live"] = {"mode": mode, "requests": server.requests, "errors": server.errors}
    if options.is_realtime:
        run.summary["live"] |= {
            "ticks": pacer.ticks, "missed": pacer.missed, "lateness": summarise_durations(pacer.delays()),
            "pauses": pacer.pauses, "paused_seconds": round(pacer.total_delay, 3), "priority": pacer.priority,
            "load": read_load_averages(),
        }  # fmt: skip
    return run


def _recorded_scenario(scenario: Scenario, session: Session) -> Scenario:
    """Return a copy of a scenario whose pilot repeats the commands of a session."""
    given = np.array([session.commands_at(tick) for tick in range(max(1, session.tick))])
    changed = np.ones(len(given), bool)
    changed[1:] = (given[1:] != given[:-1]).any(axis=1)
    rows = np.flatnonzero(changed)
    pilot = TablePilot(
        kind="table",
        time=(rows / scenario.control_rate).tolist(),
        columns={name: given[rows, i].tolist() for i, name in enumerate(session.plant.axes)},
    )
    return scenario.model_copy(update={"pilot": pilot, "duration": max(session.time, 1.0 / scenario.control_rate)})
