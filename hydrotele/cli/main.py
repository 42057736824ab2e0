"""Command line: one thin function per command. Heavy imports stay inside the functions.

Options that several commands share.

What `hydrotele compare` takes on the command line.

What `hydrotele drive` takes on the command line.

What `hydrotele sweep` takes on the command line.

Words of the command line into overrides of a scenario.
"""

import os
import signal
import sys
import warnings
from pathlib import Path
from typing import Annotated

import typer
from typer.core import TyperGroup

from hydrotele.cli.calibrating import app as calibrate_app
from hydrotele.cli.operator_identifying import IDENTIFY_OPERATOR_EPILOG, identify_operator
from hydrotele.cli.option_values import chosen, numbers_of, overrides_of
from hydrotele.cli.overview import DESCRIPTION, format_overview
from hydrotele.cli.serving import HAPTIC_EPILOG, haptic_device
from hydrotele.core.errors import InputError


def _load(files: list[Path] | None) -> list[Path] | None:
    """Load the files before anything looks for an effect or a law."""
    if files:
        from hydrotele.effects import load_effects

        for file in files:
            load_effects(file)
    return files


EffectFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--effects",
        metavar="FILE.py",
        callback=_load,
        help="Python file with effects or laws of your own, which is run; may be repeated.",
    ),
]


COMPARE_EPILOG = """\b
Examples:  hydrotele compare cat215 gap_site_a --data measured/site_a
           hydrotele compare ec20 --data long.parquet --baseline table --baseline mlp --out compared
           hydrotele compare cat215 --data logs --heldout run_7 --horizons 2,20 --json

\b
Every model is started at many rows of a run that it was not fitted to, from its estimate of the
state there, runs freely on the commands, and is compared with the readings on its way. Beside that
stands its error from one row to the next. Horizons longer than a run are left out.

\b
Black boxes, fitted on the other runs (--baseline, may be repeated):
  table   delay and static table from command to speed, per axis
  arx     linear model of readings and past commands
  mlp     neural network of the same; needs pip install 'hydrotele[baselines]'
"""


def compare(
    machine: Annotated[
        list[str],
        typer.Argument(
            help="Shipped machines, folders with machine.yaml, folders of gap or identify."
        ),
    ],
    data: Annotated[
        list[Path], typer.Option("--data", "-d", help="Folder of logs, log file or run folder.")
    ],
    tool: Annotated[str | None, typer.Option("--tool", help="Tool of the machines.")] = None,
    heldout: Annotated[
        str | None, typer.Option(help="Run to judge on, not fitted; default test*, or the last.")
    ] = None,
    sensors: Annotated[str | None, typer.Option(help="Sensors of the machines.")] = None,
    horizons: Annotated[
        str, typer.Option(help="Seconds of the free runs; the run's end always counts.")
    ] = "1,5,10,30",
    baseline: Annotated[
        list[str] | None, typer.Option("--baseline", help="Black box: table, arx or mlp.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Judge on the fitted runs, too.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for compare.json and a picture.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Accept logs that name another machine or tool.")
    ] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")
    ] = False,
) -> None:
    """Compare models by free runs on measured commands: RMS error per channel."""
    from hydrotele.cli.comparing import compare_models

    pass

    compare_models(
        machine, data, tool, heldout, sensors, numbers_of("--horizons", horizons), baseline or [],
        every, out, json, force,
    )  # fmt: skip


DRIVE_EPILOG = """\b
Examples:  hydrotele drive   |   hydrotele drive fell_tree --device gamepad
           hydrotele drive --device scripted:moves.csv --no-viewer --speed 0
           hydrotele drive --device haptic:127.0.0.1:5610   |   hydrotele drive --latency

\b
Keyboard: every press moves an axis on by a quarter of its way, where it stays; space centres all.
  Up, Down: out, in        Left, Right: swing      Page Up, Page Down: raise, lower
  End, Home: curl in, out  Insert, Delete: head    7, 6 and 9, 8: further axes (grab, saw) up, down
  F10, closing the window or Ctrl-C: end and write the logs

\b
Gamepad: left stick out/in and swing, right stick raise/lower and tool, shoulders head, cross pad
further axes, B all off, Start ends. SpaceMouse: push the way the tip shall go; its buttons switch
the first two further axes, both together all off.

\b
haptic:HOST:PORT: a device with force output whose server (hydrotele haptic-device) runs there. The
reflection answers it at its own rate, 1 kHz, beside the machine. --latency shows delays and missed
deadlines; without --device it starts a simulated device in a process of its own, for 60 s.
"""


def drive(
    scenario: Annotated[
        str | None, typer.Argument(help="Teleoperated scenario; default the machine's own.")
    ] = None,
    machine: Annotated[
        str | None, typer.Option("--machine", "-m", help="Machine; default cat215.")
    ] = None,
    tool: Annotated[str | None, typer.Option("--tool", help="Tool of the machine.")] = None,
    device: Annotated[
        str,
        typer.Option(
            "--device", "-d", help="keyboard, gamepad, spacemouse, haptic, scripted:FILE."
        ),
    ] = "keyboard",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write; default runs/SCENARIO.")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override key=value; may be repeated.")
    ] = None,
    viewer: Annotated[bool, typer.Option(help="Open MuJoCo's viewer.")] = True,
    duration: Annotated[
        float | None, typer.Option(help="Longest drive in seconds; default 600.")
    ] = None,
    speed: Annotated[
        float, typer.Option(help="Simulated per real time; 0: as fast as it goes.")
    ] = 1.0,
    review: Annotated[bool, typer.Option(help="Write the rerun recording review.rrd.")] = True,
    effects: EffectFiles = None,
    latency: Annotated[
        bool, typer.Option("--latency", help="Show latency, jitter and missed deadlines.")
    ] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")
    ] = False,
) -> None:
    """Drive a machine in real time; write a folder as `run` does."""
    from hydrotele.cli.driving import DriveOptions, drive_to_folder

    pass

    drive_to_folder(
        DriveOptions(
            scenario,
            overrides_of(set_ or []) | chosen(machine, tool),
            device,
            out,
            viewer,
            duration,
            speed,
            review,
            json,
            latency,
        )  # fmt: skip
    )


SWEEP_EPILOG = """\b
Examples:  hydrotele sweep servo_gains   |   hydrotele sweep my_sweep.yaml --jobs 8 --out runs/a
           hydrotele sweep my_sweep.yaml --dask tcp://10.0.0.5:8786

\b
A sweep file:
  scenario: zhu_up                                  # shipped, or a file beside this one
  set: {effects: [{name: payload, location: tool, parameters: {mass: 0}}]}
  grid: {servo.position_gain: [3, 4, 5]}            # keys of run --set; every combination
  sample:                                           # each of them with every sample
    count: 20
    seed: 1
    keys: {effects.0.parameters.mass: {uniform: [0, 1500]}}   # log_uniform, normal, choice
  repeat: 2                                         # with the scenario's seed counted up
  figures: [tracking.tip_z.rms, largest_pin_opening_mm]       # to draw; default: some
  logs: false                                       # keep every run's folder

\b
Stopped by Ctrl-C or killed: the same command goes on with the missing runs. Exit status 0 also
where some runs failed (they are listed, and stand in the table with their reason); 3 where all did.
"""


def sweep(
    file: Annotated[str, typer.Argument(help="Sweep file (.yaml), or a shipped sweep.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write; default runs/NAME.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", min=1, help="Processes; default one per core.")
    ] = None,
    dask: Annotated[
        str | None, typer.Option(help="Scheduler of a dask cluster (address or scheduler file).")
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Throw away what an earlier sweep left in the folder.")
    ] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Do failed runs again.")
    ] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Exit with status 3 where any run failed.")
    ] = False,
    effects: EffectFiles = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")
    ] = False,
) -> None:
    """Run variations of a scenario (grid or random samples) and collect one table."""
    from hydrotele.cli.running import SweepOptions, sweep_to_folder

    sweep_to_folder(file, out, SweepOptions(jobs, dask, fresh, retry_failed, strict, json))


class OverviewGroup(TyperGroup):
    """The program's commands, with the page of `cli.overview` as their help."""

    def format_help(self, ctx, formatter) -> None:
        """Print the page."""
        typer.echo(format_overview())


app = typer.Typer(
    name="hydrotele",
    cls=OverviewGroup,
    help=DESCRIPTION,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

analyse_app = typer.Typer(
    help="Analyse a teleoperator by linear two-port theory.", no_args_is_help=True
)
app.add_typer(analyse_app, name="analyse")
app.add_typer(calibrate_app, name="calibrate")

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]
MachineName = Annotated[
    str | None,
    typer.Option("--machine", "-m", help="Shipped machine, or a folder with machine.yaml."),
]
ToolName = Annotated[str | None, typer.Option("--tool", help="Tool of the machine.")]
Logs = Annotated[
    list[Path], typer.Option("--data", "-d", help="Folder of logs, log file or run folder.")
]
MoreLogs = Annotated[list[Path] | None, typer.Argument(help="More of them.")]
HeldOut = Annotated[
    str | None, typer.Option(help="Run to judge on, not fitted; default test*, or the last.")
]
Sensors = Annotated[str | None, typer.Option(help="Sensors of the machine.")]
Force = Annotated[
    bool, typer.Option("--force", help="Accept logs that name another machine or tool.")
]


@app.command(
    epilog="Examples:  hydrotele run zhu_up   |   hydrotele run my.yaml --out runs/a --set seed=7"
)
def run(
    scenario: Annotated[str, typer.Argument(help="Shipped scenario, or a YAML file.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write; default runs/SCENARIO.")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override key=value; may be repeated.")
    ] = None,
    machine: Annotated[
        str | None,
        typer.Option(
            "--machine", "-m", help="Machine instead of the scenario's, such as patched/."
        ),
    ] = None,
    tool: ToolName = None,
    review: Annotated[bool, typer.Option(help="Write the rerun recording review.rrd.")] = True,
    effects: EffectFiles = None,
    json: Json = False,
) -> None:
    """Simulate a scenario; write logs, a rerun recording, a summary and the MJCF."""
    from hydrotele.cli.running import run_to_folder

    run_to_folder(scenario, out, overrides_of(set_ or []) | chosen(machine, tool), review, json)


app.command(epilog=DRIVE_EPILOG)(drive)
app.command("haptic-device", epilog=HAPTIC_EPILOG)(haptic_device)
app.command(epilog=SWEEP_EPILOG)(sweep)
app.command(epilog=COMPARE_EPILOG)(compare)
app.command("identify-operator", epilog=IDENTIFY_OPERATOR_EPILOG)(identify_operator)


@app.command(
    epilog="Example:  hydrotele replay measured/fit_1.parquet --machine cat215 --out overlay"
)
def replay(
    logs: Annotated[list[Path], typer.Argument(help="Log files (.parquet, .csv) or run folders.")],
    machine: MachineName = None,
    tool: ToolName = None,
    timestep: Annotated[float, typer.Option(help="Physics step in seconds.")] = 1.0e-3,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for plots and recordings; default runs/replay_LOG, with --json none.",
        ),
    ] = None,
    effects: EffectFiles = None,
    json: Json = False,
) -> None:
    """Drive the model with the commands of a log; print the prediction errors."""
    from hydrotele.cli.reviewing import replay_logs

    replay_logs(logs, machine, tool, timestep, out, json)


@app.command(
    epilog="Examples:  hydrotele gap --machine cat215 --data measured/site_a   |   "
    "hydrotele gap --data runs/a runs/b --heldout b   |   "
    "hydrotele gap --data logs --effects my_effects.py   |   "
    "hydrotele gap --mjcf robot.xml --columns columns.yaml --data logs"
)
def gap(
    data: Logs,
    more: MoreLogs = None,
    machine: MachineName = None,
    tool: ToolName = None,
    mjcf: Annotated[
        Path | None, typer.Option("--mjcf", help="Any mechanism (.xml) instead of a machine.")
    ] = None,
    columns: Annotated[
        Path | None,
        typer.Option("--columns", help="With --mjcf: which column is which (.yaml)."),
    ] = None,
    heldout: HeldOut = None,
    sensors: Sensors = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write; default gap_DATA.")
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option("--effect", help="Try only the effect of this name; may be repeated."),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes to use.")] = None,
    mask: Annotated[Path | None, typer.Option(help="CSV run,begin,end [s] not to use.")] = None,
    force: Force = False,
    recording: Annotated[bool, typer.Option(help="Write the rerun recording.")] = True,
    effects: EffectFiles = None,
    json: Json = False,
) -> None:
    """Find where the model and measured logs disagree, name the effect, patch the model.

    With --mjcf, or the name of a model without machine.yaml such as palida: any mechanism without
    hydraulics, from measured positions and drive forces.
    """
    from hydrotele.cli.gapping import gap_mjcf_to_folder, gap_to_folder, mechanism_named

    model, columns = mechanism_named(machine, mjcf, columns)
    if model is not None:
        of_machines = {"--tool": tool, "--sensors": sensors, "--jobs": jobs, "--mask": mask,
                       "--force": force}  # fmt: skip
        if strange := [option for option, value in of_machines.items() if value]:
            raise InputError(strange[0], "belongs to a machine: leave it out for a mechanism")
        every = [*data, *(more or [])]
        gap_mjcf_to_folder(every, model, columns, heldout, out, json, effect or [])
        return
    gap_to_folder(
        [*data, *(more or [])], machine, tool, heldout, sensors, out, json, recording,
        effect or [], jobs, force, mask,
    )  # fmt: skip


@app.command(
    epilog="Examples:  hydrotele identify --machine cat215 --data logs   |   "
    "hydrotele identify --machine emps --data main.parquet --asymmetry"
)
def identify(
    data: Logs,
    more: MoreLogs = None,
    machine: MachineName = None,
    tool: ToolName = None,
    mjcf: Annotated[
        Path | None, typer.Option("--mjcf", help="Any mechanism (.xml) instead of a machine.")
    ] = None,
    columns: Annotated[
        Path | None,
        typer.Option("--columns", help="With --mjcf: which column is which (.yaml)."),
    ] = None,
    heldout: HeldOut = None,
    sensors: Sensors = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write; default identify_DATA.")
    ] = None,
    reduced: Annotated[
        bool, typer.Option("--reduced", help="Links only, without tubes and rods.")
    ] = False,
    pins: Annotated[
        bool, typer.Option("--pins", help="Friction in joints and pins without drive, too.")
    ] = False,
    asymmetry: Annotated[
        bool, typer.Option("--asymmetry", help="Viscous friction that depends on the direction.")
    ] = False,
    hydraulics: Annotated[
        bool, typer.Option("--hydraulics", help="Identify valves, oil, leakage and supply, too.")
    ] = False,
    processing: Annotated[
        str, typer.Option(help="zero_phase, optimal, periodic (needs the period) or raw.")
    ] = "zero_phase",
    band: Annotated[
        float | None, typer.Option(help="Compare forces below this frequency [Hz].")
    ] = None,
    period: Annotated[
        float | None, typer.Option(help="Period of a repeated motion, in seconds.")
    ] = None,
    harmonics: Annotated[int, typer.Option(help="Harmonics of it to keep; 0: enough.")] = 0,
    estimator: Annotated[
        str,
        typer.Option(
            help="weighted, gauss_markov, least_squares or instruments (needs the period)."
        ),
    ] = "weighted",
    keep_bias: Annotated[
        bool, typer.Option("--keep-bias", help="Leave in what the positions' noise does to it.")
    ] = False,
    ridge: Annotated[float, typer.Option(help="Ridge, share of the largest singular value.")] = 0.0,
    truncate: Annotated[float, typer.Option(help="Leave out smaller singular values.")] = 0.0,
    force: Force = False,
    effects: EffectFiles = None,
    json: Json = False,
) -> None:
    """Identify masses, friction and hydraulics from measured logs; write the machine.

    With --mjcf: any mechanism of hinges, slides and balls, its loops closed by connect and weld.
    """
    from hydrotele.cli.identifying import Choices, identify_mjcf_to_folder, identify_to_folder
    from hydrotele.identify.estimation import Estimator
    from hydrotele.identify.motion import Processing

    choices = Choices(
        model="reduced" if reduced else "complete", pins=pins, asymmetry=asymmetry,
        processing=Processing(processing, band, period, harmonics),  # pyright: ignore - checks itself
        estimator=Estimator(
            estimator, ridge, truncate, **({"pairs": 0} if keep_bias else {})  # pyright: ignore
        ),
        hydraulics=hydraulics,
    )  # fmt: skip
    if mjcf is not None:
        given = {
            "--machine": machine, "--tool": tool, "--sensors": sensors, "--reduced": reduced,
            "--pins": pins, "--asymmetry": asymmetry, "--hydraulics": hydraulics,
        }  # fmt: skip
        if strange := [option for option, value in given.items() if value]:
            raise InputError(strange[0], "belongs to a machine: leave it out with --mjcf")
        identify_mjcf_to_folder(
            [*data, *(more or [])], mjcf, columns, heldout, out, json, choices.processing,
            choices.estimator,
        )  # fmt: skip
        return
    if columns is not None:
        raise InputError("--columns", "says which column is which of --mjcf: name that, too")
    identify_to_folder(
        [*data, *(more or [])], machine, tool, heldout, sensors, out, json, choices, force
    )


@app.command(epilog="Example:  hydrotele excite cat215 --out my_excitation.yaml")
def excite(
    machine: Annotated[str, typer.Argument(help="Shipped machine, or a folder.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Scenario to write (.yaml).")],
    tool: ToolName = None,
    sensors: Sensors = None,
    period: Annotated[float, typer.Option(min=1.0, help="Of the motion, in seconds.")] = 20.0,
    harmonics: Annotated[int, typer.Option(min=1, max=30, help="Of the motion.")] = 8,
    starts: Annotated[int, typer.Option(min=1, help="Searches from random motions.")] = 2,
    seed: Annotated[int, typer.Option(help="Of these.")] = 0,
    cycles: Annotated[float, typer.Option(min=1.0, help="Periods to run.")] = 3.0,
    effects: EffectFiles = None,
    json: Json = False,
) -> None:
    """Design the most informative trajectory within a machine's limits."""
    from hydrotele.cli.identifying import excite_to_file

    excite_to_file(machine, tool, sensors, out, period, harmonics, starts, seed, cycles, json)


@analyse_app.command(
    "teleop",
    epilog="Examples:  hydrotele analyse teleop   |   "
    "hydrotele analyse teleop my_case.yaml --structure rate_force --delay 0.1 --confirm   |   "
    "hydrotele analyse teleop press_direct --set pilot.ratio=2.0e-5",
)
def analyse_teleop(
    file: Annotated[
        Path | None, typer.Argument(help="Case (.yaml), scenario; default one of the CAT 215.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Folder to write; default runs/analyse_NAME, with --json none."
        ),
    ] = None,
    structure: Annotated[
        list[str] | None,
        typer.Option(
            "--structure",
            help="position_position, position_force, four_channel_position, rate_position, "
            "rate_force, four_channel_rate, with --robust also wave_variables and "
            "passivity_control; may be repeated; default the case's.",
        ),
    ] = None,
    delay: Annotated[
        float | None, typer.Option(help="Delay each way in seconds, instead of the case's.")
    ] = None,
    confirm: Annotated[
        bool,
        typer.Option("--confirm", help="Simulate sine sweeps and every cell of the map, too."),
    ] = False,
    robust: Annotated[
        bool, typer.Option("--robust", help="Sampling, jitter, drawn operators, Z-width, too.")
    ] = False,
    period: Annotated[float, typer.Option(help="With --robust: sampling period, s.")] = 0.005,
    delays: Annotated[
        Path | None,
        typer.Option(help="With --robust: CSV of measured delays, columns forward and back, s."),
    ] = None,
    operators: Annotated[int, typer.Option(help="With --robust: hands and tasks drawn.")] = 20,
    coordinate: Annotated[str | None, typer.Option(help="Of a scenario: r, theta, z ...")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="Of a scenario.")] = None,
    json: Json = False,
) -> None:
    """Two-port of a teleoperator: what is felt, passivity, stability with delay, margins."""
    from hydrotele.cli.analysing import Robustly, analyse_any_to_folder

    pairs = overrides_of(set_ or [])
    how = Robustly(period, delays, operators) if robust or delays else None
    analyse_any_to_folder(file, out, structure, delay, confirm, coordinate, pairs, json, how)


@app.command(
    epilog="Examples:  hydrotele review runs/zhu_up   |   hydrotele review a.parquet b.parquet"
)
def review(
    log: Annotated[Path, typer.Argument(help="Run folder or log file.")],
    log2: Annotated[Path | None, typer.Argument(help="Second one, on the same clock.")] = None,
    machine: MachineName = None,
    tool: ToolName = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Recording to write.")] = None,
    serve: Annotated[bool, typer.Option("--serve", help="Serve the web viewer.")] = False,
    port: Annotated[int, typer.Option(help="Port of the web viewer.")] = 9090,
    screenshot: Annotated[
        Path | None, typer.Option("--screenshot", help="Write a PNG of the viewer, headless.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", help="Write a PNG of all channels instead.")
    ] = None,
    effects: EffectFiles = None,
) -> None:
    """Show a run in rerun: the machine in 3D, joints, pressures, flows and forces."""
    from hydrotele.cli.reviewing import review_logs

    review_logs(log, log2, machine, tool, out, serve, port, screenshot, plot)


@app.command("list", epilog="Example:  hydrotele list scenarios --json")
def list_(
    what: Annotated[
        str,
        typer.Argument(help="machines, joysticks, scenarios, sweeps, effects, environments; all."),
    ] = "all",
    effects: EffectFiles = None,
    json: Json = False,
) -> None:
    """List what is shipped: machines, scenarios, sweeps, effects, environments."""
    from hydrotele.cli.catalogue import list_things

    list_things(what, json)


@app.command(epilog="Example:  hydrotele validate my_machine/machine.yaml")
def validate(
    files: Annotated[list[Path], typer.Argument(help="Machines, scenarios, sweeps, logs ...")],
    effects: EffectFiles = None,
    json: Json = False,
) -> None:
    """Check a machine, joystick, scenario, sweep or log; report errors and their place."""
    from hydrotele.cli.catalogue import validate_files

    validate_files(files, json)


@app.command(epilog="Example:  hydrotele export cat215 --tool bucket --out scene.xml")
def export(
    machine: Annotated[str, typer.Argument(help="Shipped machine or joystick, or a folder.")],
    tool: ToolName = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="MJCF file; default stdout.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Write a PNG of it instead.")
    ] = None,
    camera: Annotated[str, typer.Option(help="Camera of the picture.")] = "overview",
    effects: EffectFiles = None,
) -> None:
    """Write the complete MJCF of a machine or joystick, or a picture of it."""
    from hydrotele.cli.catalogue import export_machine

    export_machine(machine, tool, out, picture, camera)


@app.command(epilog="Example:  hydrotele experiments zhu1994 --json")
def experiments(
    name: Annotated[
        str,
        typer.Argument(help="abdellatif2008, khoshzaban1992, wang2012 or zhu1994."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder to write; default runs/NAME, with --json none."),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(min=1, help="Repetitions: operators, noise seeds, trials; 20, or 100 trials."),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes to use.")] = None,
    json: Json = False,
) -> None:
    """Repeat a published document's experiments; compare every table and figure.

    Each row states the published value, the simulated one with its 95 % interval, and a verdict:
    agrees, differs (with the measured reason), undecided, or cannot be computed.
    The exit status is 1 if a published result differs.
    """
    from hydrotele.cli.experimenting import experiments_to_folder

    rows = experiments_to_folder(name, out, seeds, jobs, json)
    if any(row.verdict == "differs" and row.kind == "document" for row in rows):
        raise typer.Exit(1)


@app.command(
    epilog="Examples:  hydrotele bench --save a.json   |   hydrotele bench --compare a.json"
)
def bench(
    save: Annotated[Path | None, typer.Option("--save", help="Write the figures.")] = None,
    compare: Annotated[Path | None, typer.Option("--compare", help="Compare with these.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer repetitions.")] = False,
    json: Json = False,
) -> None:
    """Measure speed: mechanism, hydraulics, a whole scenario, batches, start-up."""
    from hydrotele.cli.bench import run_benchmarks

    run_benchmarks(save, compare, quick, json)


@app.command("compile", epilog="Example:  hydrotele compile --jobs 4")
def compile_functions(
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes to use; default one per core.")
    ] = None,
) -> None:
    """Compile all numerical functions now, so that no later command waits for it."""
    from hydrotele.cli.compiling import compile_all

    compile_all(jobs)


@app.command(epilog="Example:  hydrotele demo --out demo")
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")] = Path("demo"),
) -> None:
    """Run an excavator, replay its log, draw the pictures."""
    from hydrotele.cli.running import run_demo

    run_demo(out)


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    if version:
        import hydrotele

        typer.echo(hydrotele.__version__)
        raise typer.Exit


def main() -> None:
    """Entry point; exits with 2 for users' errors, 3 for failed runs, 130 or 143 for signals."""
    os.environ["PYTHONSAFEPATH"] = "1"  # children import nothing from the working folder
    ended: list[int] = []

    def end(number: int, _: object) -> None:
        ended.append(128 + number)
        sys.exit(ended[0])  # so that everything is cleaned up

    signal.signal(signal.SIGTERM, end)
    warnings.showwarning = lambda message, *_, **__: typer.echo(f"warning {message}", err=True)
    try:
        _run()
    finally:
        if ended:  # a library on the way may have made another error of it
            sys.exit(ended[0])


def _run() -> None:
    try:
        app()
    except (InputError, OSError) as error:
        if isinstance(error, OSError):  # a name that is too long, a disk that fails
            error = InputError(error.filename or "the system", error.strerror or str(error))
        typer.secho("error ", fg="red", bold=True, err=True, nl=False)
        typer.echo(str(error), err=True)
        sys.exit(2)
    except RuntimeError as error:
        if type(error).__name__ != "SimulationFailed":
            raise
        typer.echo(f"simulation failed: {error}", err=True)
        sys.exit(3)
