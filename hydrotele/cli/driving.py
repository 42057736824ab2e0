"""Implement `hydrotele drive`: an operator drives a simulated machine in real time.

The operator uses a keyboard, gamepad, SpaceMouse or haptic device, or a script replaces the
operator. The results are written to a folder with the same files as those of `hydrotele run`.
"""

import contextlib
import os
import time as clock
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from hydrotele.cli.console import first_interrupt, notes, out, print_json
from hydrotele.cli.haptic import own_device, print_latency
from hydrotele.cli.running import print_summary, write_run
from hydrotele.core.errors import InputError
from hydrotele.core.output import check_target, whole_folder
from hydrotele.haptics.timing import (
    Deadlines,
    computer_alone,
    load_of_machine,
    stolen_time,
    summary_of,
)
from hydrotele.run.devices import Device, Keyboard, open_device
from hydrotele.run.live import (
    HAPTIC,
    RATE,
    HapticHandle,
    Pacer,
    Status,
    Watch,
    drive,
    further_axes,
    haptic_address,
)
from hydrotele.run.run import Run, Session, scenario_machine
from hydrotele.scenario.scenario import Scenario, load_scenario
from hydrotele.simulate.closure import following_joints
from hydrotele.simulate.native import stop_profiling_clock

LONGEST = 600.0  # s, duration of a drive without --duration
LATENCY = 60.0  # s, duration of a drive that only measures latency
_ALONE = (1.0, 20.0)  # s, min and max duration of the idle loop that precedes a latency test
_PRIORITY = 20  # real-time priority of the machine, below those of channel and device
_FRAMES, _LINES = 30.0, 5.0  # Hz, update rates of window and status line


class DriveOptions(NamedTuple):
    """Options of `hydrotele drive`, as `cli.main.drive` describes them."""

    scenario: str | None
    overrides: dict[str, str]
    device: str
    target: Path | None
    viewer: bool
    duration: float | None
    speed: float
    review: bool
    json: bool
    latency: bool = False


def drive_to_folder(wishes: DriveOptions) -> Path:
    """Drive a machine in real time, and write the results to a folder.

    The output folder is written completely or not at all.

    Returns:
        The output folder.

    Raises:
        InputError: scenario, device, screen or target are not usable.
        SimulationFailed: the state of the simulation is no longer finite.
    """
    stop_profiling_clock()
    if _is_haptic(wishes) and wishes.speed != 1.0:
        raise InputError("--speed", "must be 1 with a haptic device, which runs in real time")
    if not wishes.speed >= 0.0:
        raise InputError("--speed", "must be 0 (as fast as possible) or more; 1 is real time")
    if wishes.device == "keyboard" and not wishes.viewer and not wishes.latency:
        message = "needs the viewer window to read keys; omit --no-viewer or use another device"
        raise InputError("--device keyboard", message)
    if wishes.latency:
        return _measured_latency(wishes)
    return _driven(wishes)


def _driven(wishes: DriveOptions, alone: Mapping[str, Any] = MappingProxyType({})) -> Path:
    """Drive the machine once and write the results.

    Args:
        wishes: options of the command.
        alone: deadlines missed by an idle loop on this computer, from `computer_alone`.

    Returns:
        The output folder.
    """
    scenario = _scenario(wishes)
    target = wishes.target or Path("runs", scenario.name)
    check_target(target, "run")
    machine = scenario_machine(scenario)
    further = tuple(further_axes(machine))
    if _is_haptic(wishes):
        device = HapticHandle(*haptic_address(wishes.device), len(further))
        pacer = Deadlines(scenario.ticks, _PRIORITY)
    else:
        device, pacer = open_device(wishes.device, further), Pacer(wishes.speed)
    stolen, begun = stolen_time(), clock.monotonic()
    try:
        with first_interrupt() as interrupted, _watching(wishes, device, interrupted) as watch:
            result = drive(scenario, machine, device, pacer, watch, _say)
    finally:
        pacer.close()
        device.close()
    if isinstance(pacer, Deadlines):
        machine_side = {
            "control_rate": scenario.control_rate, "ticks": pacer.ticks, "missed": pacer.missed,
            "late": summary_of(pacer.lateness()), "priority": pacer.priority,
            "load": load_of_machine(),
        }  # fmt: skip
        result.summary["haptic"] = {
            "machine": machine_side, "line": result.summary["haptic"],
            "computer": {**alone, **_stolen(stolen, clock.monotonic() - begun)},
        }  # fmt: skip
    _write(result, target, wishes)
    return target


def _stolen(before: float | None, seconds: float) -> dict[str, float | None]:
    """Return the processor time taken by the host since `before` [s] and its fraction [1]."""
    after = stolen_time()
    if before is None or after is None:
        return {"stolen_seconds": None, "stolen_share": None}
    taken = after - before
    share = taken / (seconds * (os.cpu_count() or 1)) if seconds > 0.0 else 0.0
    return {"stolen_seconds": round(taken, 3), "stolen_share": round(share, 6)}


def _measured_latency(wishes: DriveOptions) -> Path:
    """Drive with a haptic device and print latencies; start a simulated device if none is given."""
    if _is_haptic(wishes):
        return _driven(wishes, _alone(_scenario(wishes).duration))
    if wishes.device != "keyboard":
        message = "has no force output: omit --device, or give --device haptic:HOST:PORT"
        raise InputError(f"--latency with --device {wishes.device}", message)
    duration = LATENCY if wishes.duration is None else wishes.duration
    _scenario(wishes)  # report errors of the scenario before the measurement starts
    alone = _alone(duration)  # before the device starts, because its start-up loads the computer
    with own_device() as (host, port):
        own = {"device": f"{HAPTIC}:{host}:{port}", "duration": duration}
        return _driven(wishes._replace(viewer=False, review=False, **own), alone)


def _alone(duration: float) -> dict[str, Any]:
    """Measure the deadlines that an idle loop misses on this computer.

    Args:
        duration: duration of the drive [s]; the loop runs for a third of it, within `_ALONE`.
    """
    seconds = min(_ALONE[1], max(_ALONE[0], duration / 3.0))
    notes.print(f"running an idle loop for {seconds:.0f} s before the drive", style="dim")
    return computer_alone(seconds, RATE, _PRIORITY)


def _is_haptic(wishes: DriveOptions) -> bool:
    return wishes.device.split(":")[0] == HAPTIC


def _write(result: Run, target: Path, wishes: DriveOptions) -> None:
    with whole_folder(target, "run") as folder:
        write_run(result, folder, wishes.review)
    if wishes.json:
        print_json({**result.summary, "folder": str(target)})
        return
    print_summary(result.summary)
    if "haptic" in result.summary:
        print_latency(result.summary["haptic"])
    if result.summary["pauses"]:
        said = f"{result.summary['late_seconds']:.2f} s late in {result.summary['pauses']} pauses"
        out.print(f"[yellow]note[/] the simulation was slower than real time: {said}")
    alike = "a similar run" if "haptic" in result.summary else "this run"
    out.print(f"written to [bold]{target}[/]; hydrotele run with its scenario.yaml repeats {alike}")


def _scenario(wishes: DriveOptions) -> Scenario:
    """Load the given scenario, or the default scenario of the machine."""
    overrides, name = dict(wishes.overrides), wishes.scenario
    duration = LONGEST if wishes.duration is None else wishes.duration
    if name is None:
        own = _usual(overrides.get("machine", "cat215").strip('"'))
        name = str(own or _usual("cat215"))
        if own is None:  # a custom machine: drop the settings that are specific to cat215
            overrides = {"tool": "null", "sensors": "ideal", "servo": "{}"} | overrides
    overrides["duration"] = repr(duration)
    if _is_haptic(wishes):
        overrides = {"control_rate": repr(RATE)} | overrides
    scenario = load_scenario(name, overrides)
    if wishes.scenario is None and "pilot.force" not in overrides and _loose(scenario):
        overrides |= {"pilot.force": '"true"', "sensors": "ideal"}
        scenario = load_scenario(name, overrides)
    return scenario


def _loose(scenario: Scenario) -> list[str]:
    """Return the passive joints without a drive or a closure.

    With such joints, the force at the tip cannot be computed from the pressures.
    """
    machine = scenario_machine(scenario)
    known = {axis.joint for axis in machine.axes.values()} | set(following_joints(machine))
    return [joint for joint in machine.joints if joint not in known]


def _usual(machine: str) -> Path | None:
    path = Path(__file__).with_name(f"drive_{machine}.yaml")
    return path if "/" not in machine and path.is_file() else None


def _say(sentence: str) -> None:
    if notes.is_terminal:
        notes.file.write("\r\x1b[K")  # clear the status line
    notes.print(f"[yellow]{sentence}[/]", soft_wrap=True)


@contextlib.contextmanager
def _watching(
    wishes: DriveOptions, device: Device, interrupted: Callable[[], bool]
) -> Iterator[Watch]:
    """Show viewer window and status line during a drive.

    Yields:
        The callback of the drive; it returns False when the drive must stop.
    """
    from hydrotele.show.window import Window, check_screen

    if wishes.viewer:
        check_screen()
    lines = notes.is_terminal and not wishes.json
    window: list[Window] = []
    due = [0.0, 0.0]

    def watch(session: Session, status: Callable[[], Status], now: float) -> bool:
        if interrupted():
            return False
        if wishes.viewer and now >= due[0]:
            due[0] = now + 1.0 / _FRAMES
            if not window:
                pressed = device.press if isinstance(device, Keyboard) else None
                window.append(Window(session.plant, pressed))
            if not window[0].show(session.data.qpos, status().rows()):
                return False
        if lines and now >= due[1]:
            due[1] = now + 1.0 / _LINES
            notes.print(_line(status()), end="\r", overflow="crop", no_wrap=True, style="dim")
        return True

    try:
        yield watch
    finally:
        for opened in window:
            opened.close()


def _line(status: Status) -> str:
    return "  ".join(f"{name} {value}" for name, value in status.rows())
