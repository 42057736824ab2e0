"""`hydrotele haptic-device` serves a device; what `hydrotele drive --latency` prints."""

import contextlib
import json
import subprocess
import sys
import threading
import time as clock
from collections.abc import Iterator
from typing import NamedTuple

from hydrotele.cli.console import first_interrupt, notes, out, print_json, table
from hydrotele.core.errors import InputError
from hydrotele.haptics.server import announce, open_haptic, serve

HELD = 1e-3  # share of deadlines that may be missed
_PATIENCE = 60.0  # s until a device server of our own must listen
_ROWS = {
    "answer": "pose received to wrench sent",
    "loop": "wrench sent to pose that knows of it",
    "interval": "pose to pose",
}


class HapticOptions(NamedTuple):
    """What the command line asks for."""

    kind: str
    host: str
    port: int
    rate: float
    duration: float | None
    until_eof: bool
    json: bool


def serve_device(wishes: HapticOptions) -> None:
    """Serve a device until Ctrl-C, the end of its duration or of the input.

    Raises:
        InputError: there is no such device, or the address cannot be used.
    """
    period = 1.0 / wishes.rate
    device = open_haptic(wishes.kind, period)
    ended = threading.Event()
    if wishes.until_eof:
        threading.Thread(target=_wait_for_the_end, args=(ended,), daemon=True).start()
    end = clock.monotonic() + (wishes.duration or float("inf"))

    def opened(where: tuple[str, int]) -> None:
        if wishes.until_eof:
            announce(where)
        else:
            notes.print(f"{wishes.kind} device at {where[0]}:{where[1]}; Ctrl-C ends", style="dim")

    try:
        with first_interrupt() as interrupted:
            seen = serve(
                device, (wishes.host, wishes.port), period,
                lambda: interrupted() or ended.is_set() or clock.monotonic() > end, opened,
            )  # fmt: skip
    finally:
        device.close()
    if wishes.json or wishes.until_eof:
        print_json(seen._asdict())
        return
    refused = ", ".join(f"{count} {why}" for why, count in seen.refused.items() if count)
    out.print(
        f"{seen.periods} periods, {seen.missed} missed, {seen.unanswered} without an answer in"
        f" time, {seen.limp} times limp; refused: {refused or 'none'}"
    )


def _wait_for_the_end(ended: threading.Event) -> None:
    sys.stdin.read()
    ended.set()


@contextlib.contextmanager
def own_device() -> Iterator[tuple[str, int]]:
    """A simulated device in a process of its own, for as long as it is needed.

    Yields:
        Host and port.

    Raises:
        InputError: it does not begin to listen.
    """
    command = [sys.executable, "-m", "hydrotele", "haptic-device", "--port", "0", "--until-eof"]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )  # a Ctrl-C at the terminal is for the drive
    assert process.stdin and process.stdout
    timer = threading.Timer(_PATIENCE, process.kill)
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
    """Tables of missed deadlines, percentiles and histograms.

    Args:
        figures: `haptic` of a drive's summary.
    """
    machine, line, computer = figures["machine"], figures["line"], figures.get("computer", {})
    missed = table("Missed deadlines", "", "of", "missed", "share")
    rows: list[tuple[str, int, int]] = []
    if "missed" in computer:
        alone = f"computer alone, no work for {computer['seconds']:g} s"
        rows.append((alone, computer["missed"], computer["ticks"]))
    for name, count, of in (
        *rows,
        (f"machine, {machine['control_rate']:g} Hz", machine["missed"], machine["ticks"]),
        ("device, its own periods", line["device_missed"], line["poses"] + line["lost"]),
        ("device, wrench in time", line["device_unanswered"], line["poses"] + line["lost"]),
        ("poses lost on the line", line["lost"], line["poses"] + line["lost"]),
    ):
        missed.add_row(name, str(of), str(count), f"{100.0 * count / max(of, 1):.3f} %")
    out.print(missed)
    spans = {**{said: line[key] for key, said in _ROWS.items()}, "machine late": machine["late"]}
    if "late" in computer:
        spans["computer alone late"] = computer["late"]
    names = ("p50", "p90", "p99", "p99.9", "largest")
    times = table("Times [us]", "", *names)
    for said, found in spans.items():
        times.add_row(said, *(f"{found['percentiles_us'].get(n, 0.0):g}" for n in names))
    out.print(times)
    edges = line["answer"]["histogram"]["edges_us"]
    histogram = table("Number of times up to [us]", "", *(f"{e}" for e in edges), "more")
    for said, found in spans.items():
        histogram.add_row(said, *map(str, found["histogram"]["count"]))
    out.print(histogram)
    load = machine["load"]
    out.print(
        f"priority: machine {machine['priority']}, line {line['priority']}; load of the computer:"
        f" {load[0] if load else 'unknown'}"
    )
    for sentence in computer_sentences(machine, computer):
        out.print(sentence)


def computer_sentences(machine: dict, computer: dict) -> list[str]:
    """What the computer alone could hold, and what its host took, in words.

    Args:
        machine: `haptic.machine` of a drive's summary.
        computer: `haptic.computer` of it.

    Returns:
        Sentences.
    """
    said = []
    if (stolen := computer.get("stolen_seconds")) is not None:
        share = 100.0 * computer["stolen_share"]
        said.append(f"time stolen by the host meanwhile: {stolen:g} s, {share:.2g} % of all cores")
    if "missed" not in computer:
        return said
    alone, own = (x["missed"] / max(x["ticks"], 1) for x in (computer, machine))
    largest = computer["late"]["percentiles_us"].get("largest", 0.0)
    if alone > HELD:
        said.append(
            f"[yellow]note[/] the computer alone missed {100.0 * alone:.2g} % of its deadlines, by"
            f" up to {1e-3 * largest:.2g} ms, without any work: it cannot hold"
            f" {100.0 * HELD:g} %, whatever runs on it"
        )
    elif own > HELD:
        said.append(
            f"[yellow]note[/] the computer alone missed {100.0 * alone:.2g} %: the rest of the"
            f" {100.0 * own:.2g} % is the machine's, or of what ran beside it"
        )
    return said
