"""Implement `hydrotele haptic-device` and print the latencies of `hydrotele drive --latency`."""

import contextlib
import json
import subprocess
import sys
import threading
import time as clock
from collections.abc import Iterator
from typing import NamedTuple

from hydrotele.cli.console import (
    catch_first_interrupt,
    make_table,
    print_json,
    stderr_console,
    stdout_console,
)
from hydrotele.core.errors import InputError
from hydrotele.haptics.server import open_haptic_device, print_address, run_device_server

MAX_MISSED_FRACTION = 1e-3  # maximum fraction of missed deadlines [1]
_START_TIMEOUT = 60.0  # s, timeout for the start of the simulated device
_TIME_LABELS = {
    "answer": "from pose received to wrench sent",
    "loop": "from wrench sent to the pose that acknowledges it",
    "interval": "between two poses",
}


class HapticOptions(NamedTuple):
    """Options of `hydrotele haptic-device`.

    Attributes:
        kind: kind of device, such as `simulated` or `force-dimension`.
        host: address to listen on.
        port: UDP port, 0 for any free port.
        rate: sampling rate [Hz].
        duration: duration [s], None to run until Ctrl-C.
        until_eof: print the address as JSON, and stop when standard input is closed.
        json: print the result as JSON.
    """

    kind: str
    host: str
    port: int
    rate: float
    duration: float | None
    until_eof: bool
    json: bool


def serve_device(options: HapticOptions) -> None:
    """Serve a haptic device by UDP until Ctrl-C or the end of the duration.

    With `until_eof`, the end of standard input stops the server, too. Counts of missed deadlines
    and rejected packets are printed at the end.

    Raises:
        InputError: there is no such device, or the address cannot be used.
    """
    period = 1.0 / options.rate
    device = open_haptic_device(options.kind, period)
    ended = threading.Event()
    if options.until_eof:
        threading.Thread(target=_wait_for_stdin_close, args=(ended,), daemon=True).start()
    end = clock.monotonic() + (float("inf") if options.duration is None else options.duration)

    def announce_address(where: tuple[str, int]) -> None:
        if options.until_eof:
            print_address(where)
        else:
            stderr_console.print(f"{options.kind} device at {where[0]}:{where[1]}; Ctrl-C stops", style="dim")

    try:
        with catch_first_interrupt() as interrupted:
            seen = run_device_server(
                device, (options.host, options.port), period,
                lambda: interrupted() or ended.is_set() or clock.monotonic() > end, announce_address,
            )  # fmt: skip
    finally:
        device.close()
    if options.json or options.until_eof:
        print_json(seen._asdict())
        return
    refused = ", ".join(f"{count} {why}" for why, count in seen.rejected.items() if count)
    stdout_console.print(
        f"{seen.periods} periods: {seen.missed} deadlines missed, {seen.unanswered} without an"
        f" answer in time, force switched off {seen.watchdog_trips} times; rejected packets:"
        f" {refused or 'none'}"
    )


def _wait_for_stdin_close(ended: threading.Event) -> None:
    sys.stdin.read()
    ended.set()


@contextlib.contextmanager
def run_simulated_device() -> Iterator[tuple[str, int]]:
    """Run a simulated haptic device in a separate process during the context.

    Yields:
        Host and port of the device.

    Raises:
        InputError: the device does not start.
    """
    command = [sys.executable, "-m", "hydrotele", "haptic-device", "--port", "0", "--until-eof"]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )  # new session, so that Ctrl-C at the terminal stops only the drive
    assert process.stdin and process.stdout
    timer = threading.Timer(_START_TIMEOUT, process.kill)
    timer.start()
    try:
        line = process.stdout.readline()
        timer.cancel()
        if not line:
            raise InputError("--latency", "the simulated device did not start: see above")
        where = json.loads(line)
        yield where["host"], where["port"]
    finally:
        timer.cancel()
        process.stdin.close()
        process.stdout.read()
        process.stdout.close()
        process.wait()


def print_latency(figures: dict) -> None:
    """Print missed deadlines, and percentiles and histograms of latencies, of a drive with a haptic device.

    Args:
        figures: item `haptic` of the summary of a drive.
    """
    machine, line, computer = figures["machine"], figures["channel"], figures.get("computer", {})
    title = "Missed deadlines (lower is better)"
    missed = make_table(title, "deadline", "total", "missed", "fraction")
    rows: list[tuple[str, int, int]] = []
    if "missed" in computer:
        alone = f"computer alone, idle loop of {computer['seconds']:g} s"
        rows.append((alone, computer["missed"], computer["ticks"]))
    for name, count, of in (
        *rows,
        (f"machine, {machine['control_rate']:g} Hz", machine["missed"], machine["ticks"]),
        ("device, sampling period", line["device_missed"], line["poses"] + line["lost"]),
        (
            "device, wrench in time",
            line["device_unanswered"],
            line["poses"] + line["lost"],
        ),
        ("channel, poses lost", line["lost"], line["poses"] + line["lost"]),
    ):
        missed.add_row(name, str(of), str(count), f"{100.0 * count / max(of, 1):.3f} %")
    stdout_console.print(missed)
    spans = {said: line[key] for key, said in _TIME_LABELS.items()}
    spans["lateness of the machine"] = machine["lateness"]
    if "lateness" in computer:
        spans["lateness of the idle loop"] = computer["lateness"]
    names = ("p50", "p90", "p99", "p99.9", "max")
    times = make_table("Percentiles of times [us] (lower is better)", "time", *names)
    for said, found in spans.items():
        times.add_row(said, *(f"{found['percentiles_us'].get(n, 0.0):g}" for n in names))
    stdout_console.print(times)
    edges = line["answer"]["histogram"]["edges_us"]
    title = "Histogram: number of samples up to [us]"
    histogram = make_table(title, "time", *(f"{e}" for e in edges), "more")
    for said, found in spans.items():
        histogram.add_row(said, *map(str, found["histogram"]["count"]))
    stdout_console.print(histogram)
    load = machine["load"]
    stdout_console.print(
        f"real-time priority: machine {machine['priority']}, channel {line['priority']}; load"
        f" average of the computer: {load[0] if load else 'unknown'}"
    )
    for sentence in describe_computer_timing(machine, computer):
        stdout_console.print(sentence)


def describe_computer_timing(machine: dict, computer: dict) -> list[str]:
    """Describe the processor time taken by the host, and whether computer or program missed deadlines.

    More than 0.1 % missed deadlines of the idle loop are attributed to the computer. Otherwise,
    more than 0.1 % missed deadlines of the machine are attributed to the simulation or to other
    programs.

    Args:
        machine: item `haptic.machine` of the summary of a drive.
        computer: item `haptic.computer` of the same summary, with the results of the idle loop, if
            any.

    Returns:
        Sentences to print.
    """
    said = []
    if (stolen := computer.get("stolen_seconds")) is not None:
        share = 100.0 * computer["stolen_share"]
        said.append(f"processor time taken by the host: {stolen:g} s, {share:.2g} % of all cores")
    if "missed" not in computer:
        return said
    alone, own = (x["missed"] / max(x["ticks"], 1) for x in (computer, machine))
    largest = computer["lateness"]["percentiles_us"].get("max", 0.0)
    if alone > MAX_MISSED_FRACTION:
        said.append(
            f"[yellow]note[/] the computer alone missed {100.0 * alone:.2g} % of its deadlines in"
            f" an idle loop, by up to {1e-3 * largest:.2g} ms: no program on it can stay below the"
            f" limit of {100.0 * MAX_MISSED_FRACTION:g} %"
        )
    elif own > MAX_MISSED_FRACTION:
        said.append(
            f"[yellow]note[/] the computer alone missed {100.0 * alone:.2g} % of its deadlines: the"
            f" remainder of the {100.0 * own:.2g} % is caused by the simulation or other programs"
        )
    return said
