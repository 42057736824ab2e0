"""Implement `hydrotele drive`: an operator drives a simulated machine in real time.

The operator uses a keyboard, gamepad, SpaceMouse, haptic device or web page, or a script replaces
the operator. The results are written to a folder with the same files as those of `hydrotele run`.
"""

import contextlib
import os
import time as clock
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from hydrotele.cli.console import catch_first_interrupt, print_json, stderr_console, stdout_console
from hydrotele.cli.haptic_device_command import print_latency, run_simulated_device
from hydrotele.cli.run_command import print_summary, write_run
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.haptics.timing import (
    RealTimePacer,
    measure_missed_deadlines,
    read_load_averages,
    read_steal_time,
    summarise_durations,
)
from hydrotele.run.devices import Device, Keyboard, open_device
from hydrotele.run.interactive_run import (
    HAPTIC,
    HAPTIC_CONTROL_RATE,
    HapticHandle,
    Pacer,
    Status,
    TickCallback,
    axes_not_moved_by_joystick,
    drive_scenario,
    parse_haptic_address,
)
from hydrotele.run.run import Run, load_simulated_machine
from hydrotele.run.session import Session
from hydrotele.run.web_driver import WebDriver
from hydrotele.scenario.scenario import Scenario, load_scenario
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock
from hydrotele.simulate.closed_loops import dependent_joints

DEFAULT_DURATION = 600.0  # s, duration of a drive without --duration
LATENCY_TEST_DURATION = 60.0  # s, duration of a drive that only measures latency
_IDLE_TEST_LIMITS = (
    1.0,
    20.0,
)  # s, min and max duration of the idle loop that precedes a latency test
_MACHINE_PRIORITY = 20  # real-time priority of the machine, below those of channel and device
_WINDOW_RATE, _STATUS_LINE_RATE = 30.0, 5.0  # Hz, update rates of window and status line


class DriveOptions(NamedTuple):
    """Options of `hydrotele drive`.

    Attributes:
        scenario: teleoperated scenario, None for that of the machine.
        overrides: scenario overrides, {key path: YAML text}.
        device: input device, such as `keyboard` or `haptic:HOST:PORT`.
        target: output folder, None for `runs/<scenario>`.
        viewer: whether to open a window.
        duration: maximum simulated time [s], None for the default of 600 s (60 s with `latency` and
            a simulated device).
        speed: simulated time per real time [1], 0 for as fast as possible.
        review: whether to write the rerun recording.
        json: print JSON instead of text.
        latency: whether to measure and print latencies of a haptic device.
        web: (host, port) of a web page that replaces device and window; None without one.
    """

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
    web: tuple[str, int] | None = None


def drive_to_folder(options: DriveOptions) -> Path:
    """Let an operator drive a simulated machine in real time, and write the results to a folder.

    The output folder is written completely or not at all.

    Returns:
        The output folder.

    Raises:
        InputError: scenario, device, screen or target are not usable.
        SimulationFailed: the state of the simulation is no longer finite.
    """
    stop_profiling_clock()
    if options.web:
        return _drive_in_browser(options, *options.web)
    if _is_haptic_device(options) and options.speed != 1.0:
        raise InputError("--speed", "must be 1 with a haptic device, which runs in real time")
    if options.device == "keyboard" and not options.viewer and not options.latency:
        message = "needs the viewer window to read keys; omit --no-viewer or use another device"
        raise InputError("--device keyboard", message)
    if options.latency:
        return _drive_with_latency_test(options)
    return _drive_once(options)


def _drive_once(options: DriveOptions, idle_test: Mapping[str, Any] = MappingProxyType({})) -> Path:
    """Run one drive: load the scenario, open the device, simulate, and write the results.

    Args:
        options: options of the command.
        idle_test: deadlines missed by an idle loop on this computer, from `measure_missed_deadlines`.

    Returns:
        The output folder.
    """
    scenario = _load_drive_scenario(options)
    target = options.target or Path("runs", scenario.name)
    check_output_folder(target, "run")
    machine = load_simulated_machine(scenario)
    further = tuple(axes_not_moved_by_joystick(machine))
    if _is_haptic_device(options):
        device = HapticHandle(*parse_haptic_address(options.device), len(further))
        pacer = RealTimePacer(scenario.tick_count, _MACHINE_PRIORITY)
    else:
        device, pacer = open_device(options.device, further), Pacer(options.speed)
    stolen, begun = read_steal_time(), clock.monotonic()
    try:
        with (
            catch_first_interrupt() as interrupted,
            _show_progress(options, device, interrupted) as watch,
        ):
            result = drive_scenario(scenario, machine, device, pacer, watch, _print_message)
    finally:
        pacer.close()
        device.close()
    if isinstance(pacer, RealTimePacer):
        machine_side = {
            "control_rate": scenario.control_rate, "ticks": pacer.ticks, "missed": pacer.missed,
            "lateness": summarise_durations(pacer.delays()), "priority": pacer.priority,
            "load": read_load_averages(),
        }  # fmt: skip
        result.summary["haptic"] = {
            "machine": machine_side, "channel": result.summary["haptic"],
            "computer": {**idle_test, **_measure_stolen_time(stolen, clock.monotonic() - begun)},
        }  # fmt: skip
    _write(result, target, options)
    return target


def _drive_in_browser(options: DriveOptions, host: str, port: int) -> Path:
    """Run one drive that a web page controls: serve the page, simulate, and write the results.

    Args:
        options: options of the command.
        host: address of the network interface of the page.
        port: port of the page, 0 for any free one.

    Returns:
        The output folder.

    Raises:
        InputError: another device or a latency test is requested, or the address cannot be used.
    """
    if options.device != "keyboard":
        message = "has no effect with --web, whose page reads keyboard and gamepad; omit one of them"
        raise InputError(f"--device {options.device}", message)
    if options.latency:
        raise InputError("--latency", "needs a haptic device; omit --web")
    if options.speed <= 0.0:
        raise InputError("--speed", "must be positive with --web")
    from hydrotele.show.drive_page import DrivePage, ResetRequested
    from hydrotele.show.web_server import LOOPBACK_NAMES

    scenario = _load_drive_scenario(options)
    target = options.target or Path("runs", scenario.name)
    check_output_folder(target, "run")
    machine = load_simulated_machine(scenario)
    driver, pacer = WebDriver(len(axes_not_moved_by_joystick(machine))), Pacer(options.speed)
    page = DrivePage(host, port, driver, scenario.name, target)
    stderr_console.print(f"open [bold]{page.url}[/] in a browser; Ctrl-C stops the drive and writes the logs")
    if host not in LOOPBACK_NAMES:
        stderr_console.print("[yellow]note[/] every computer that reaches this address can drive the machine")

    def say(sentence: str) -> None:
        page.show_message(sentence)
        _print_message(sentence)

    try:
        with (
            catch_first_interrupt() as interrupted,
            _show_progress(options._replace(viewer=False), driver, interrupted) as watch,
        ):

            def update(session: Session, status: Callable[[], Status], now: float) -> bool:
                page.update(session, status, pacer, interrupted)
                return watch(session, status, now)

            result = None
            while result is None:
                try:
                    result = drive_scenario(scenario, machine, driver, pacer, update, say)
                except ResetRequested:
                    pacer = Pacer(options.speed)
                    say("the machine is in its initial state")
    finally:
        page.close()
    _write(result, target, options)
    return target


def _measure_stolen_time(before: float | None, seconds: float) -> dict[str, float | None]:
    """Return the processor time that the host has taken from this virtual machine during a drive.

    Args:
        before: time taken until the start of the drive [s], None if the system does not report it.
        seconds: duration of the drive [s].

    Returns:
        Time taken [s] and its fraction of the time of all cores [1]; None if unknown.
    """
    after = read_steal_time()
    if before is None or after is None:
        return {"stolen_seconds": None, "stolen_share": None}
    taken = after - before
    share = taken / (seconds * (os.cpu_count() or 1)) if seconds > 0.0 else 0.0
    return {"stolen_seconds": round(taken, 3), "stolen_share": round(share, 6)}


def _drive_with_latency_test(options: DriveOptions) -> Path:
    """Drive with a haptic device and print latencies, after an idle loop that tests the computer.

    If no device is given (`keyboard` is the default), a simulated haptic device is started in a
    separate process.

    Raises:
        InputError: the given device has no force output.
    """
    if _is_haptic_device(options):
        return _drive_once(options, _run_idle_test(_load_drive_scenario(options).duration))
    if options.device != "keyboard":
        message = "has no force output: omit --device, or give --device haptic:HOST:PORT"
        raise InputError(f"--latency with --device {options.device}", message)
    duration = LATENCY_TEST_DURATION if options.duration is None else options.duration
    _load_drive_scenario(options)  # report errors of the scenario before the measurement starts
    alone = _run_idle_test(duration)  # before the device starts, because its start-up loads the computer
    with run_simulated_device() as (host, port):
        own = {"device": f"{HAPTIC}:{host}:{port}", "duration": duration}
        return _drive_once(options._replace(viewer=False, review=False, **own), alone)


def _run_idle_test(duration: float) -> dict[str, Any]:
    """Count the deadlines that a loop without work misses on this computer, as a baseline for a drive.

    Args:
        duration: duration of the drive [s]; the loop runs for a third of it, but 1 to 20 s.

    Returns:
        Result of `measure_missed_deadlines` at the control rate of a drive with a haptic device.
    """
    seconds = min(_IDLE_TEST_LIMITS[1], max(_IDLE_TEST_LIMITS[0], duration / 3.0))
    stderr_console.print(f"running an idle loop for {seconds:.0f} s before the drive", style="dim")
    return measure_missed_deadlines(seconds, HAPTIC_CONTROL_RATE, _MACHINE_PRIORITY)


def _is_haptic_device(options: DriveOptions) -> bool:
    return options.device.split(":")[0] == HAPTIC


def _write(result: Run, target: Path, options: DriveOptions) -> None:
    with atomic_folder(target, "run") as folder:
        write_run(result, folder, options.review)
    if options.json:
        print_json({**result.summary, "folder": str(target)})
        return
    print_summary(result.summary)
    if "haptic" in result.summary:
        print_latency(result.summary["haptic"])
    if result.summary["pauses"]:
        said = f"{result.summary['paused_seconds']:.2f} s late in {result.summary['pauses']} pauses"
        stdout_console.print(f"[yellow]note[/] the simulation was slower than real time: {said}")
    alike = "a similar run" if "haptic" in result.summary else "this run"
    stdout_console.print(f"written to [bold]{target}[/]; hydrotele run with its scenario.yaml repeats {alike}")


def _load_drive_scenario(options: DriveOptions) -> Scenario:
    """Load the given scenario, or the default scenario of the machine, with all overrides applied.

    Duration and, for a haptic device, the control rate are set from the options. In a default
    scenario of a machine with undetermined joints (`_find_undetermined_joints`), the true tip force
    is reflected instead of an estimate from the pressures, and the sensors are ideal.
    """
    overrides, name = dict(options.overrides), options.scenario
    duration = DEFAULT_DURATION if options.duration is None else options.duration
    if name is None:
        own = _default_scenario_path(overrides.get("machine", "cat215").strip('"'))
        name = str(own or _default_scenario_path("cat215"))
        if own is None:  # a custom machine: drop the settings that are specific to cat215
            overrides = {"tool": "null", "sensors": "ideal", "servo": "{}"} | overrides
    overrides["duration"] = repr(duration)
    if _is_haptic_device(options):
        overrides = {"control_rate": repr(HAPTIC_CONTROL_RATE)} | overrides
    scenario = load_scenario(name, overrides)
    if options.scenario is None and "pilot.force" not in overrides and _find_undetermined_joints(scenario):
        overrides |= {"pilot.force": '"true"', "sensors": "ideal"}
        scenario = load_scenario(name, overrides)
    return scenario


def _find_undetermined_joints(scenario: Scenario) -> list[str]:
    """Return the joints that neither a drive nor a closed kinematic loop determines.

    With such joints, the force at the tip cannot be computed from the pressures.
    """
    machine = load_simulated_machine(scenario)
    known = {axis.joint for axis in machine.axes.values()} | set(dependent_joints(machine))
    return [joint for joint in machine.joints if joint not in known]


def _default_scenario_path(machine: str) -> Path | None:
    path = Path(__file__).parent / f"drive_{machine}.yaml"  # no such file if the machine is a path
    return path if path.is_file() else None


def _print_message(sentence: str) -> None:
    if stderr_console.is_terminal:
        stderr_console.file.write("\r\x1b[K")  # clear the status line
    stderr_console.print(f"[yellow]{sentence}[/]", soft_wrap=True)


@contextlib.contextmanager
def _show_progress(options: DriveOptions, device: Device, interrupted: Callable[[], bool]) -> Iterator[TickCallback]:
    """Show the viewer window and a status line during a drive.

    Yields:
        Function to call at each control tick; it returns False when the drive must stop, after
        Ctrl-C or when the user closes the window.
    """
    from hydrotele.show.live_window import Window, check_screen

    if options.viewer:
        check_screen()
    lines = stderr_console.is_terminal and not options.json
    window: list[Window] = []
    due = [0.0, 0.0]

    def update_display(session: Session, status: Callable[[], Status], now: float) -> bool:
        if interrupted():
            return False
        if options.viewer and now >= due[0]:
            due[0] = now + 1.0 / _WINDOW_RATE
            if not window:
                pressed = device.press if isinstance(device, Keyboard) else None
                window.append(Window(session.plant, pressed))
            if not window[0].show(session.data.qpos, status().rows()):
                return False
        if lines and now >= due[1]:
            due[1] = now + 1.0 / _STATUS_LINE_RATE
            stderr_console.print(_format_status_line(status()), end="\r", overflow="crop", no_wrap=True, style="dim")
        return True

    try:
        yield update_display
    finally:
        for opened in window:
            opened.close()


def _format_status_line(status: Status) -> str:
    return "  ".join(f"{name} {value}" for name, value in status.rows())
