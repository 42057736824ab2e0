"""Measure the jitter of a client loop at 200 Hz with `hydrotele serve --realtime`; print a table.

    python tools/validation/serve_jitter.py --seconds 60
    python tools/validation/serve_jitter.py --seconds 60 --priority 20    # both processes with real-time priority

The server is another process on the same computer. The client is a loop in Python that computes a
proportional command. The first row is the deviation of the time between two replies from the
period, the second the duration of a `read` request while the machine waits for its first step.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import msgpack
import numpy as np
import zmq

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seconds", type=float, default=60.0)
parser.add_argument("--rate", type=float, default=200.0, help="[Hz]")
parser.add_argument("--priority", type=int, default=0, help="real-time priority of both processes, 0 for none")
arguments = parser.parse_args()
PERCENTILES = (50, 90, 99, 99.9, 100)


def print_row(name: str, seconds: np.ndarray) -> None:
    """Print percentiles of durations [ms]."""
    print(f"| {name} | {' | '.join(f'{1e3 * v:.3f}' for v in np.percentile(seconds, PERCENTILES))} |")


if arguments.priority:  # inherited by the server and by all threads
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(arguments.priority))
folder = Path(tempfile.mkdtemp()) / "run"
changes = {"control_rate": arguments.rate, "tool": "none", "start": "{}", "duration": arguments.seconds}
command = [sys.executable, "-m", "hydrotele", "serve", "hold", "--realtime", "--port", "0", "--no-review", "--json"]
command += ["--out", str(folder), *(f"--set={name}={value}" for name, value in changes.items())]
server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
assert server.stdout and server.stderr
port = server.stderr.readline().strip().rpartition(":")[2]
socket = zmq.Context().socket(zmq.REQ)
socket.setsockopt(zmq.RCVTIMEO, 60000)
socket.connect(f"tcp://127.0.0.1:{port}")


def ask(**request):
    """Send a request and return the reply."""
    socket.send(msgpack.packb(request))  # pyright: ignore[reportCallIssue, reportArgumentType]
    return msgpack.unpackb(socket.recv())


round_trips = []
for _ in range(1000):
    begin = time.perf_counter()
    state = ask(do="read")
    round_trips.append(time.perf_counter() - begin)
boom = ask(do="describe")["axes"].index("boom")
target, replies, ticks = state["position"][boom] + 0.2, [], []
while not state["done"]:
    error = target - state["position"][boom]
    state = ask(do="step", command={"boom": max(-1.0, min(1.0, 3.0 * error))})
    replies.append(time.perf_counter())
    ticks.append(state["tick"])
live = json.loads(server.communicate(timeout=120)[0])["live"]

period, warm = 1.0 / arguments.rate, 20  # the first ticks load compiled code
intervals, steps = np.diff(replies)[warm:], np.diff(ticks)[warm:]
print(
    f"{len(intervals)} control ticks at {arguments.rate:g} Hz, load average {live['load'][0]} on {os.cpu_count()} cores"
)
print(f"| [ms] | {' | '.join(f'{p:g} %' if p < 100 else 'largest' for p in PERCENTILES)} |")
print(f"| --- |{' ---: |' * len(PERCENTILES)}")
print_row("deviation of the time between two replies from the period", np.abs(intervals - period * steps))
print_row("duration of a `read` request", np.array(round_trips))
late, count = int((steps - 1).sum()), int(steps.sum())
print(f"commands that came too late for their tick: {late} of {count} ({100 * late / count:.2f} %)")
worst = live["lateness"]["percentiles_us"].get("max", 0.0) / 1e3
print(f"ticks that the server started late: {live['missed']} of {live['ticks']}, at most {worst:.1f} ms")
