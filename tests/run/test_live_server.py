"""The live server with real sockets: lockstep, real time, wrong requests, several clients."""

import re
import threading
from pathlib import Path
from socket import create_connection as connect

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.run.live_server import MAX_FRAME_BYTES, MAX_REQUEST_BYTES, LiveOptions, serve_scenario
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario

msgpack = pytest.importorskip("msgpack")
zmq = pytest.importorskip("zmq")

LOCKSTEP = LiveOptions(port=0)
PAGE = Path(__file__).parents[2] / "docs" / "live.md"


class Server:
    """A live server in a thread; `finish` returns its run."""

    def __init__(self, duration=1.0, options=LOCKSTEP):
        self._listens, self._result = threading.Event(), []
        changes = {"duration": repr(duration), "control_rate": "200", "tool": "none", "start": "{}"}
        self._plan = load_scenario("hold", changes)
        self._options, self.port, self.interrupted = options, 0, False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()
        assert self._listens.wait(60)

    def _serve(self):
        def say(text):
            self.port = int(text.rpartition(":")[2])
            self._listens.set()

        try:
            self._result.append(serve_scenario(self._plan, self._options, say, lambda: self.interrupted))
        except Exception as error:
            self._result.append(error)
            self._listens.set()

    def finish(self):
        self._thread.join(60)
        assert not self._thread.is_alive()
        return self._result[0]


class Client:
    def __init__(self, server, kind=zmq.REQ):
        self.context = zmq.Context()
        self.socket = self.context.socket(kind)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.RCVTIMEO, 10000)
        self.socket.connect(f"tcp://127.0.0.1:{server.port}")

    def send(self, content):
        self.socket.send(content)
        return msgpack.unpackb(self.socket.recv())

    def ask(self, **request):
        return self.send(msgpack.packb(request))

    def close(self):
        self.socket.close()
        self.context.term()


def test_a_run_in_lockstep_is_the_same_as_the_run_of_its_scenario():
    server = Server(0.5)
    client = Client(server)
    axes = client.ask(do="describe")["axes"]
    state, k = client.ask(do="read"), 0
    assert state["tick"] == 0 and not state["done"]
    while not state["done"]:
        state, k = client.ask(do="step", command={"boom": 0.3 * np.sin(0.1 * k)}, ticks=1 + k % 3), k + 1
    assert state["tick"] == 100
    assert client.ask(do="step") == state  # within the grace time
    run = server.finish()
    again = run_scenario(run.scenario)
    for name in run.measured.columns:
        assert np.array_equal(run.measured[name], again.measured[name]), name
    assert state["position"][axes.index("boom")] != run.measured["angle.boom"][0]
    assert run.summary["live"]["mode"] == "lockstep"
    client.close()


WRONG = [
    b"", b"\xc1", b"\xff" * 100, msgpack.packb(None), msgpack.packb([1, 2]), msgpack.packb({}), msgpack.packb(7),
    msgpack.packb({"do": 3}), msgpack.packb({"do": "jump"}), msgpack.packb({"do": ["step"]}),
    msgpack.packb({1: 2}), msgpack.packb({b"do": b"step"}), msgpack.packb({"do": "read", "ticks": 1}),
    msgpack.packb({"do": "step", "command": [0.1]}), msgpack.packb({"do": "step", "command": {"bom": 0.1}}),
    msgpack.packb({"do": "step", "command": {"boom": float("nan")}}),
    msgpack.packb({"do": "step", "command": {"boom": float("inf")}}),
    msgpack.packb({"do": "step", "command": {"boom": 1.01}}), msgpack.packb({"do": "step", "command": {"boom": True}}),
    msgpack.packb({"do": "step", "command": {"boom": "0.1"}}), msgpack.packb({"do": "step", "command": {"boom": None}}),
    msgpack.packb({"do": "step", "command": {"boom": {"boom": 0.1}}}), msgpack.packb({"do": "step", "command": {2: 1}}),
    msgpack.packb({"do": "step", "command": {"boom": 2**63}}), msgpack.packb({"do": "step", "ticks": 0}),
    msgpack.packb({"do": "step", "ticks": 10**9}), msgpack.packb({"do": "step", "ticks": 1.0}),
    msgpack.packb({"do": "step", "ticks": True}), msgpack.packb({"do": "step", "command": {"boom": 0.1}, "speed": 2}),
    msgpack.packb({"do": "read"}) + b"\x00", msgpack.packb({"do": "x" * MAX_REQUEST_BYTES}),
    b"\x81" * 4000, b"\x91" * 4000, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff",
    msgpack.packb({"do": "step", "command": {"boom": msgpack.ExtType(5, b"abc")}}), msgpack.packb(msgpack.Timestamp(1)),
    b"\xd6\xff\xff\xff\xff\xff", b"\xa2\xff\xfe", b"\x81\xa2do\xa2\xff\xfe",
]  # fmt: skip


def test_wrong_requests_are_answered_with_an_error_and_change_nothing():
    server = Server(0.5)
    client = Client(server)
    before = client.ask(do="step", command={"boom": 0.1})
    for content in WRONG:
        reply = client.send(content)
        assert set(reply) == {"error"}, content[:40]
        assert len(reply["error"]) < 2000
    assert client.ask(do="read") == before
    rng = np.random.default_rng(0)
    for _ in range(300):
        assert "error" in client.send(rng.bytes(int(rng.integers(1, 60))))
    assert client.ask(do="read") == before
    client.ask(do="step", command={"boom": 0.1}, ticks=1000)
    assert server.finish().summary["live"]["errors"] == len(WRONG) + 300
    client.close()


def test_more_frames_and_huge_frames_do_not_stop_the_server():
    server = Server(0.5)
    several, huge, client = Client(server, zmq.DEALER), Client(server, zmq.DEALER), Client(server)
    several.socket.send_multipart([b"", b"a", b"b"])
    assert b"one frame" in several.socket.recv_multipart()[-1]
    several.socket.send_multipart([b"x"] * 50)
    assert b"one frame" in several.socket.recv_multipart()[-1]
    huge.socket.send(b"\x00" * (MAX_FRAME_BYTES + 1))  # the connection is closed without a reply
    huge.socket.setsockopt(zmq.RCVTIMEO, 300)
    with pytest.raises(zmq.Again):
        huge.socket.recv()
    with connect(("127.0.0.1", server.port)) as stranger:  # not ZeroMQ
        stranger.sendall(np.random.default_rng(0).bytes(10000))
    assert client.ask(do="step", ticks=100)["done"]
    server.finish()
    for each in (several, huge, client):
        each.close()


def test_one_client_drives_and_another_takes_over_when_it_is_gone():
    server = Server(1.0, LiveOptions(port=0, timeout=0.3))
    first, second = Client(server), Client(server)
    assert first.ask(do="step", command={"boom": 0.5})["command"][1] == 0.5
    for request in ({"do": "step"}, {"do": "stop"}, {"do": "release"}):
        assert "another client drives" in second.ask(**request)["error"]
    assert second.ask(do="read")["command"][1] == 0.5
    first.close()  # it disappears
    deadline = 100
    while "error" in (state := second.ask(do="step", command={"stick": 0.1})) and deadline:
        deadline -= 1
        threading.Event().wait(0.02)
    assert state["command"] == [0.0, 0.0, 0.1]  # the boom's command is 0 since the first was released
    second.ask(do="release")
    third = Client(server)
    assert not third.ask(do="step", ticks=150)["done"]
    assert third.ask(do="stop")["done"]
    run = server.finish()
    assert run.scenario.duration == pytest.approx(0.76)  # whole log rows
    second.close()
    third.close()


def test_in_real_time_a_silent_client_is_replaced_by_zero_commands():
    server = Server(2.0, LiveOptions(is_realtime=True, port=0, timeout=0.5))
    client = Client(server)
    assert "one control tick" in client.ask(do="step", ticks=2)["error"]
    state = client.ask(do="read")
    assert state["tick"] == 0  # the run has not started
    ticks = []
    for _ in range(20):
        state = client.ask(do="step", command={"boom": 0.5})
        ticks.append(state["tick"])
    assert ticks[0] == 1 and np.diff(ticks).min() >= 1
    run = server.finish()  # it goes on without the client
    assert len(run.truth.time) == 100
    assert run.truth["command.boom"].max() == 0.5 and run.truth["command.boom"][-1] == 0.0
    assert run.summary["live"]["ticks"] == 400
    client.close()


def test_a_flood_of_requests_does_not_stop_time():
    server = Server(0.4, LiveOptions(is_realtime=True, port=0))
    driver, flood = Client(server), Client(server, zmq.DEALER)
    driver.ask(do="step")
    for _ in range(5000):
        flood.socket.send(b"\xc1")
    assert len(server.finish().truth.time) == 20
    driver.close()
    flood.close()


def test_a_run_that_is_too_short_and_a_port_in_use_are_errors():
    server = Server(0.5)
    taken = Server(0.5, LiveOptions(port=server.port))
    assert isinstance(error := taken.finish(), InputError) and "cannot listen" in str(error)
    client = Client(server)
    client.ask(do="step")
    client.ask(do="stop")
    assert isinstance(error := server.finish(), InputError) and "too short" in str(error)
    client.close()


def test_ctrl_c_ends_a_server_that_nobody_uses():
    server = Server(0.5)
    server.interrupted = True
    assert "too short" in str(server.finish())


@pytest.mark.parametrize("is_realtime", [False, True])
def test_the_client_of_the_page_lifts_the_boom(is_realtime):
    (program,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len([line for line in program.splitlines() if line.strip()]) <= 20
    server = Server(2.0, LiveOptions(is_realtime=is_realtime, port=0))
    values = {}
    exec(program.replace("5620", str(server.port)), values)
    run = server.finish()
    # The valve's dead band of 0.04 leaves an error of 0.04 / 3 rad; the pump and the spool need 1 s.
    assert run.measured["angle.boom"][-1] - run.measured["angle.boom"][0] == pytest.approx(0.2, abs=0.03)
    values["socket"].close()
    values["socket"].context.term()
