"""Implement `hydrotele serve`: a client program drives a simulated machine over ZeroMQ."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hydrotele.cli.option_values import machine_overrides, parse_overrides

if TYPE_CHECKING:
    from hydrotele.run.live_server import LiveOptions

SERVE_EPILOG = """\b
Examples:  hydrotele serve hold --duration 60
           hydrotele serve hold --realtime --set sensors=khoshzaban1992 --out runs/mine

\b
Clients send msgpack maps over ZeroMQ; docs/live.md describes the protocol and has a client in
Python. In lockstep (the default) the machine moves only while a client requests it. The run starts
with the first step, and ends with its duration, a client's stop, or Ctrl-C. There is no
authentication: listen on addresses other than 127.0.0.1 only in a private network.
"""


def serve(
    scenario: Annotated[str, typer.Argument(help="Name of a shipped scenario, or a YAML file. Its pilot is not used.")],
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime",
            help="Simulate in real time, with the last commands, also while the client computes. Default: wait for the"
            " client (lockstep).",
        ),
    ] = False,
    duration: Annotated[
        float | None, typer.Option(min=0.1, help="Longest duration [s]. Default: that of the scenario.")
    ] = None,
    host: Annotated[str, typer.Option(help="Network address on which the server listens.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 means any free port.")] = 5620,
    timeout: Annotated[
        float, typer.Option(min=0.01, help="Time without messages after which the driving client loses control [s].")
    ] = 1.0,
    machine: Annotated[
        str | None, typer.Option("--machine", help="Machine to simulate instead of that of the scenario.")
    ] = None,
    tool: Annotated[
        str | None, typer.Option("--tool", help="Name of the mounted tool, for machines with several tools.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output folder; default: runs/SCENARIO.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Replace a value of the scenario: KEY=VALUE. Can be given several times."),
    ] = None,
    review: Annotated[
        bool, typer.Option("--review/--no-review", help="Write a recording for `hydrotele review`.")
    ] = True,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON, and nothing else.")] = False,
) -> None:
    """Let a client program drive a simulated machine over ZeroMQ; write the same files as `run`."""
    from hydrotele.run.live_server import LiveOptions

    overrides = machine_overrides(machine, tool) | parse_overrides(set_ or [])
    if duration is not None:
        overrides["duration"] = repr(duration)
    serve_to_folder(scenario, overrides, LiveOptions(realtime, timeout, host, port), out, review, json)


def serve_to_folder(
    name: str, overrides: dict[str, str], options: "LiveOptions", target: Path | None, review: bool, as_json: bool
) -> Path:
    """Run a scenario with the commands of clients, and write the results to a folder.

    The output folder is written completely or not at all.

    Returns:
        The output folder.

    Raises:
        InputError: scenario, address or target are not usable, or the run is too short for a log.
        SimulationFailed: the state of the simulation is no longer finite.
    """
    from hydrotele.cli.console import catch_first_interrupt, stderr_console
    from hydrotele.cli.run_command import write_and_print_run
    from hydrotele.core.output import check_output_folder
    from hydrotele.run.live_server import serve_scenario
    from hydrotele.scenario.scenario import load_scenario
    from hydrotele.simulate.actuator_callbacks import stop_profiling_clock

    stop_profiling_clock()
    scenario = load_scenario(name, overrides)
    target = target or Path("runs", scenario.name)
    check_output_folder(target, "run")
    with catch_first_interrupt() as interrupted:
        result = serve_scenario(scenario, options, lambda text: stderr_console.print(text, soft_wrap=True), interrupted)
    return write_and_print_run(
        result, target, review, as_json, "; hydrotele run with its scenario.yaml repeats this run"
    )
