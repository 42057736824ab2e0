"""Command line: one function for each command, with its arguments, options and help text.

Each function parses its options and calls the module that does the work. Slow imports are inside
the functions, so that `--help` and completion stay fast.
"""

import io
import os
import signal
import sys
import warnings
from pathlib import Path
from typing import Annotated, Literal

import typer

from hydrotele.cli.calibrate_options import app as calibrate_app
from hydrotele.cli.epilogs import COMPARE_EPILOG, DRIVE_EPILOG, IMPORT_EPILOG, SWEEP_EPILOG
from hydrotele.cli.haptic_device_options import HAPTIC_EPILOG, haptic_device
from hydrotele.cli.identify_operator_command import IDENTIFY_OPERATOR_EPILOG, identify_operator
from hydrotele.cli.linearise_command import LINEARISE_EPILOG, linearise
from hydrotele.cli.new_command import app as new_app
from hydrotele.cli.number_options import MAX_PROCESSES, NumberCheckingGroup
from hydrotele.cli.option_values import (
    CommandGroup,
    QuietOption,
    machine_overrides,
    parse_overrides,
    parse_positive_numbers,
)
from hydrotele.cli.program_help import DESCRIPTION, format_program_help
from hydrotele.cli.serve_command import SERVE_EPILOG, serve
from hydrotele.cli.train_options import RECORD_EPILOG, TRAIN_EPILOG, record, train
from hydrotele.core.errors import InputError


def _load_effect_files(files: list[Path] | None) -> list[Path] | None:
    """Execute Python files that define custom effects and laws; return the list of files unchanged."""
    if files:
        from hydrotele.effects import load_effects

        for file in files:
            load_effects(file)
    return files


MAX_BANDS = 200  # samples in posterior.parquet

EffectFilesOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--effects",
        metavar="FILE.py",
        callback=_load_effect_files,
        help="Python file that defines custom effects or laws, which are added to those of the library. The file"
        " is run as Python code, so use only files that you trust. Can be given several times.",
    ),
]


ContactChoice = Annotated[
    Literal["mask", "ignore"],
    typer.Option(
        "--contact",
        help="Intervals in which cylinder pressures show contact or a load of the tool: mask (do not use)"
        " or ignore (use as other intervals).",
    ),
]


def compare(
    machine: Annotated[
        list[str],
        typer.Argument(
            help="Models to compare: shipped machines, folders with machine.yaml, result folders of gap or identify."
        ),
    ],
    data: Annotated[
        list[Path],
        typer.Option("--data", "-d", help="Log file, folder of logs, or run folder (output of `hydrotele run`)."),
    ],
    tool: Annotated[
        str | None, typer.Option("--tool", help="Name of the mounted tool, for machines with several tools.")
    ] = None,
    heldout: Annotated[
        str | None,
        typer.Option(
            help="Run that tests the result and is not fitted. Default: a run whose name begins with test, heldout or"
            " validation, else the last run; with a single run, its last quarter."
        ),
    ] = None,
    sensors: Annotated[
        str | None,
        typer.Option(
            help="Sensor set of the machine files, which states rate and accuracy. Default: that of the logs."
        ),
    ] = None,
    horizons: Annotated[
        str, typer.Option(help="Times over which the models predict [s]. The whole run is always added.")
    ] = "1,5,10,30",
    baseline: Annotated[
        list[str] | None,
        typer.Option("--baseline", help="Also fit and compare a black-box model: table, arx or mlp (explained below)."),
    ] = None,
    every: Annotated[
        bool, typer.Option("--all", help="Test the models on the fitted runs, too, not only on the held-out run.")
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for compare.json and a plot.")] = None,
    bands: Annotated[
        int | None,
        typer.Option(
            "--bands",
            min=0,
            max=MAX_BANDS,
            help="Number of machines that are sampled from the posterior of each result folder of gap, for"
            " prediction bands. Default: 20 if the folder has a posterior.",
        ),
    ] = None,
    effects: EffectFilesOption = None,
    contact: ContactChoice = "mask",
    force: Annotated[
        bool, typer.Option("--force", help="Accept logs whose metadata name another machine or tool.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")] = False,
) -> None:
    """Compare open-loop predictions of several models with logs: RMS error per channel."""
    from hydrotele.cli.compare_command import compare_models

    compare_models(
        machine, data, tool, heldout, sensors, parse_positive_numbers("--horizons", horizons), baseline or [],
        every, out, json, force, bands, contact,
    )  # fmt: skip


def drive(
    scenario: Annotated[
        str | None, typer.Argument(help="Scenario with a teleoperation pilot. Default: a scenario for the machine.")
    ] = None,
    machine: Annotated[str | None, typer.Option("--machine", "-m", help="Machine; default: cat215.")] = None,
    tool: Annotated[
        str | None, typer.Option("--tool", help="Name of the mounted tool, for machines with several tools.")
    ] = None,
    device: Annotated[
        str,
        typer.Option(
            "--device",
            "-d",
            help="Input device: keyboard, gamepad, spacemouse, haptic, haptic:HOST:PORT or scripted:FILE.",
        ),
    ] = "keyboard",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output folder; default: runs/SCENARIO.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Replace a value of the scenario: KEY=VALUE. Can be given several times."),
    ] = None,
    viewer: Annotated[bool, typer.Option(help="Open the MuJoCo viewer.")] = True,
    duration: Annotated[float | None, typer.Option(min=1e-3, help="Longest simulated time [s]. Default: 600.")] = None,
    speed: Annotated[
        float, typer.Option(min=0.0, help="Ratio of simulated to real time; 0 means as fast as possible.")
    ] = 1.0,
    review: Annotated[bool, typer.Option(help="Write review.rrd, a recording for `hydrotele review`.")] = True,
    effects: EffectFilesOption = None,
    latency: Annotated[
        bool, typer.Option("--latency", help="Measure and print delays of the force reflection and missed deadlines.")
    ] = False,
    web: Annotated[bool, typer.Option("--web", help="Drive in a browser; this computer needs no screen.")] = False,
    host: Annotated[
        str | None,
        typer.Option(
            "--host",
            help="Network address on which the page of --web is served. Default: 127.0.0.1 (this computer only).",
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option("--port", min=0, max=65535, help="Port of --web. Default: 8080; 0 means any free port."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")] = False,
) -> None:
    """Drive a machine in real time; write the same files as `run`."""
    from hydrotele.cli.drive_command import DriveOptions, drive_to_folder

    if not web and (host is not None or port is not None):
        raise InputError("--host" if host is not None else "--port", "needs --web")
    drive_to_folder(
        DriveOptions(
            scenario,
            parse_overrides(set_ or []) | machine_overrides(machine, tool),
            device,
            out,
            viewer,
            duration,
            speed,
            review,
            json,
            latency,
            (host or "127.0.0.1", 8080 if port is None else port) if web else None,
        )  # fmt: skip
    )


def sweep(
    file: Annotated[str, typer.Argument(help="Sweep file (.yaml), or name of a shipped sweep.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output folder; default: runs/NAME.")] = None,
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", "-j", min=1, max=MAX_PROCESSES, help="Number of processes; default: one per core."),
    ] = None,
    dask: Annotated[
        str | None, typer.Option(help="Run on a dask cluster: address of its scheduler, or scheduler file.")
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Delete earlier results in the output folder and start again.")
    ] = False,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Repeat runs that failed earlier.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with status 3 if any run failed.")] = False,
    effects: EffectFilesOption = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")] = False,
) -> None:
    """Run variations of a scenario (grid or random samples); collect the results in a table."""
    from hydrotele.cli.run_command import SweepOptions, sweep_to_folder

    sweep_to_folder(file, out, SweepOptions(jobs, dask, fresh, retry_failed, strict, json))


class OverviewGroup(NumberCheckingGroup):
    """Command group whose help is the text of `cli.program_help`."""

    def format_help(self, ctx, formatter) -> None:
        """Print the overview of all commands."""
        typer.echo(format_program_help())


app = CommandGroup(
    name="hydrotele",
    cls=OverviewGroup,
    help=DESCRIPTION,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

analyse_app = CommandGroup(help="Analyse a teleoperator by linear two-port theory.", no_args_is_help=True)
app.add_typer(analyse_app, name="analyse")
app.add_typer(calibrate_app, name="calibrate")
app.add_typer(new_app, name="new")

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")]
MachineOption = Annotated[
    str | None,
    typer.Option(
        "--machine",
        "-m",
        help="Name of a shipped machine, or folder with machine.yaml. Default: the machine next to the log,"
        " or that of its metadata.",
    ),
]
ToolOption = Annotated[
    str | None, typer.Option("--tool", help="Name of the mounted tool, for machines with several tools.")
]
LogsOption = Annotated[
    list[Path],
    typer.Option("--data", "-d", help="Log file, folder of logs, or run folder (output of `hydrotele run`)."),
]
MoreLogsArgument = Annotated[
    list[Path] | None, typer.Argument(help="More logs: --data A B C means --data A --data B --data C.")
]
HeldOutOption = Annotated[
    str | None,
    typer.Option(
        help="Run that tests the result and is not fitted. Default: a run whose name begins with test, heldout or"
        " validation, else the last run; with a single run, its last quarter."
    ),
]
SensorsOption = Annotated[
    str | None,
    typer.Option(help="Sensor set of the machine file, which states rate and accuracy. Default: that of the logs."),
]
ForceOption = Annotated[bool, typer.Option("--force", help="Accept logs whose metadata name another machine or tool.")]


@app.command(epilog="Examples:  hydrotele run zhu_up   |   hydrotele run my.yaml --out runs/a --set seed=7")
def run(
    scenario: Annotated[
        str, typer.Argument(help="Name of a shipped scenario (hydrotele list scenarios), or a YAML file.")
    ],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output folder; default: runs/SCENARIO.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Replace a value of the scenario: KEY=VALUE. Can be given several times."),
    ] = None,
    machine: Annotated[
        str | None,
        typer.Option(
            "--machine", "-m", help="Machine to simulate instead of that of the scenario, for example gap_logs/patched."
        ),
    ] = None,
    tool: ToolOption = None,
    review: Annotated[bool, typer.Option(help="Write review.rrd, a recording for `hydrotele review`.")] = True,
    policy: Annotated[
        str | None,
        typer.Option(
            "--policy",
            help="Controller that computes the commands instead of the pilot: a trained policy (.zip, .pt, .onnx),"
            " MODULE:FUNCTION, FILE.py:FUNCTION or the name of a plug-in. Its reference is the motion of"
            " the pilot. It is run as Python code, so use only files that you trust.",
        ),
    ] = None,
    task: Annotated[
        str | None, typer.Option("--task", help="With --policy: task whose observations and actions the policy uses.")
    ] = None,
    effects: EffectFilesOption = None,
    json: JsonOption = False,
) -> None:
    """Simulate a scenario; write logs, a rerun recording, a summary and the MJCF."""
    from hydrotele.cli.run_command import PolicyChoice, run_to_folder

    if task and not policy:
        raise InputError("--task", "needs --policy")
    overrides = parse_overrides(set_ or []) | machine_overrides(machine, tool)
    run_to_folder(scenario, out, overrides, review, json, PolicyChoice(policy, task) if policy else None)


app.command(epilog=DRIVE_EPILOG)(drive)
app.command("haptic-device", epilog=HAPTIC_EPILOG)(haptic_device)
app.command(epilog=SERVE_EPILOG)(serve)
app.command(epilog=TRAIN_EPILOG)(train)
app.command(epilog=RECORD_EPILOG)(record)
app.command(epilog=SWEEP_EPILOG)(sweep)
app.command(epilog=COMPARE_EPILOG)(compare)
app.command(epilog=LINEARISE_EPILOG)(linearise)
app.command("identify-operator", epilog=IDENTIFY_OPERATOR_EPILOG)(identify_operator)


@app.command(epilog="Example:  hydrotele replay measured/fit_1.parquet --machine cat215 --out overlay")
def replay(
    logs: Annotated[list[Path], typer.Argument(help="Log files (.parquet, .csv), folders of logs, or run folders.")],
    machine: MachineOption = None,
    tool: ToolOption = None,
    timestep: Annotated[float, typer.Option(min=1e-6, help="Simulation time step [s].")] = 1.0e-3,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for plots and recordings; default: runs/replay_LOG, none with --json.",
        ),
    ] = None,
    bands: Annotated[
        int,
        typer.Option(
            "--bands",
            min=0,
            max=MAX_BANDS,
            help="Number of machines that are sampled from the posterior, if --machine is a result folder"
            " of gap. They give a"
            " 95 % prediction band, which contains parameter uncertainty and measurement noise, but not"
            " missing effects: much more than 5 % of the readings outside point to such an effect.",
        ),
    ] = 0,
    effects: EffectFilesOption = None,
    json: JsonOption = False,
    force: ForceOption = False,
) -> None:
    """Simulate the model with the commands of a log; print the prediction errors."""
    from hydrotele.cli.replay_command import replay_logs

    replay_logs(logs, machine, tool, timestep, out, json, force, bands)


@app.command(
    epilog="Examples:  hydrotele gap --machine cat215 --data measured/site_a   |   "
    "hydrotele gap --data runs/a runs/b --heldout b   |   "
    "hydrotele gap --data logs --effects my_effects.py   |   "
    "hydrotele gap --mjcf robot.xml --columns columns.yaml --data logs"
)
def gap(
    data: LogsOption,
    more: MoreLogsArgument = None,
    machine: MachineOption = None,
    tool: ToolOption = None,
    mjcf: Annotated[
        Path | None, typer.Option("--mjcf", help="Mechanism without hydraulics, as MJCF (.xml), instead of a machine.")
    ] = None,
    columns: Annotated[
        Path | None,
        typer.Option("--columns", help="With --mjcf: file that assigns log columns to joints and drives (.yaml)."),
    ] = None,
    heldout: HeldOutOption = None,
    sensors: SensorsOption = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output folder; default: gap_DATA.")] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            help="Restrict the search to this effect of `hydrotele list effects`. Can be given several times.",
        ),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, max=MAX_PROCESSES, help="Number of parallel processes.")] = None,
    mask: Annotated[
        Path | None, typer.Option(help="CSV file with the columns run, begin and end [s]: intervals that are not used.")
    ] = None,
    contact: ContactChoice = "mask",
    force: ForceOption = False,
    recording: Annotated[bool, typer.Option(help="Write a recording for `hydrotele review`.")] = True,
    effects: EffectFilesOption = None,
    json: JsonOption = False,
) -> None:
    """Find differences between model and logs, identify their cause, correct the model.

    For a mechanism without hydraulics, give --mjcf or the name of a shipped model without
    machine.yaml, such as palida. The logs must contain positions and drive forces.
    """
    from hydrotele.cli.gap_command import find_mechanism_files, gap_mjcf_to_folder, gap_to_folder

    model, columns = find_mechanism_files(machine, mjcf, columns)
    if model is not None:
        of_machines = {"--tool": tool, "--sensors": sensors, "--jobs": jobs, "--mask": mask,
                       "--force": force, "--contact": contact != "mask"}  # fmt: skip
        if strange := [option for option, value in of_machines.items() if value]:
            raise InputError(strange[0], "applies to machines only: omit it for a mechanism")
        every = [*data, *(more or [])]
        gap_mjcf_to_folder(every, model, columns, heldout, out, json, effect or [])
        return
    gap_to_folder(
        [*data, *(more or [])], machine, tool, heldout, sensors, out, json, recording,
        effect or [], jobs, force, mask, contact,
    )  # fmt: skip


@app.command(
    epilog="Examples:  hydrotele identify --machine cat215 --data logs   |   "
    "hydrotele identify --machine emps --data main.parquet --asymmetry"
)
def identify(
    data: LogsOption,
    more: MoreLogsArgument = None,
    machine: MachineOption = None,
    tool: ToolOption = None,
    mjcf: Annotated[
        Path | None, typer.Option("--mjcf", help="Mechanism without hydraulics, as MJCF (.xml), instead of a machine.")
    ] = None,
    columns: Annotated[
        Path | None,
        typer.Option("--columns", help="With --mjcf: file that assigns log columns to joints and drives (.yaml)."),
    ] = None,
    heldout: HeldOutOption = None,
    sensors: SensorsOption = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output folder; default: identify_DATA.")] = None,
    reduced: Annotated[
        bool, typer.Option("--reduced", help="Model only the links, without the masses of cylinder tubes and rods.")
    ] = False,
    pins: Annotated[
        bool, typer.Option("--pins", help="Also identify friction in joints without drive and in pins.")
    ] = False,
    asymmetry: Annotated[
        bool, typer.Option("--asymmetry", help="Allow viscous friction that differs between the directions.")
    ] = False,
    hydraulics: Annotated[
        bool, typer.Option("--hydraulics", help="Also identify valves, oil, leakage and pump.")
    ] = False,
    processing: Annotated[
        str,
        typer.Option(
            help="How positions are filtered and differentiated: zero_phase (low-pass without delay), optimal, periodic"
            " (Fourier series, needs --period) or raw (no filter)."
        ),
    ] = "zero_phase",
    band: Annotated[float | None, typer.Option(min=1e-6, help="Fit the forces below this frequency only [Hz].")] = None,
    period: Annotated[float | None, typer.Option(min=1e-6, help="Period of the motion, if it is repeated [s].")] = None,
    harmonics: Annotated[
        int, typer.Option(min=0, max=10_000, help="Number of harmonics of --period that are kept; 0 means automatic.")
    ] = 0,
    estimator: Annotated[
        str,
        typer.Option(
            help="Estimator: weighted, gauss_markov, least_squares or instruments (instrumental variables,"
            " needs --period)."
        ),
    ] = "weighted",
    keep_bias: Annotated[
        bool, typer.Option("--keep-bias", help="Do not correct the bias that noise of the positions causes.")
    ] = False,
    ridge: Annotated[
        float,
        typer.Option(
            min=0.0, max=1.0, help="Ridge regularisation, as a fraction of the largest singular value; 0 means none."
        ),
    ] = 0.0,
    truncate: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1.0,
            help="Ignore directions with singular values below this fraction of the largest; 0 means none.",
        ),
    ] = 0.0,
    contact: ContactChoice = "mask",
    force: ForceOption = False,
    effects: EffectFilesOption = None,
    json: JsonOption = False,
) -> None:
    """Identify masses, friction and hydraulics from logs; write the identified machine.

    With --mjcf, any mechanism with hinge, slide and ball joints can be identified. Its kinematic
    loops must be closed by connect or weld constraints. The exit status is 1 if the identified model predicts no
    force of the held-out run better than zero force does.
    """
    from hydrotele.cli.identify_command import (
        IdentificationOptions,
        identify_mjcf_to_folder,
        identify_to_folder,
    )
    from hydrotele.identify.estimation import Estimator
    from hydrotele.identify.joint_motion import Processing

    choices = IdentificationOptions(
        model="reduced" if reduced else "complete", pins=pins, asymmetry=asymmetry,
        processing=Processing(processing, band, period, harmonics),  # pyright: ignore - checks itself
        estimator=Estimator(
            estimator, ridge, truncate, **({"noise_pairs": 0} if keep_bias else {})  # pyright: ignore
        ),
        hydraulics=hydraulics,
    )  # fmt: skip
    if mjcf is not None:
        given = {
            "--machine": machine, "--tool": tool, "--sensors": sensors, "--reduced": reduced,
            "--pins": pins, "--asymmetry": asymmetry, "--hydraulics": hydraulics,
            "--contact": contact != "mask",
        }  # fmt: skip
        if strange := [option for option, value in given.items() if value]:
            raise InputError(strange[0], "applies to machines only: omit it with --mjcf")
        identify_mjcf_to_folder(
            [*data, *(more or [])], mjcf, columns, heldout, out, json, choices.processing,
            choices.estimator,
        )  # fmt: skip
        return
    if columns is not None:
        raise InputError("--columns", "is used only together with --mjcf: give both")
    identify_to_folder([*data, *(more or [])], machine, tool, heldout, sensors, out, json, choices, force, contact)


@app.command(
    epilog="Examples:  hydrotele contact --machine cat215 --data logs --out contact_logs   |   "
    "hydrotele review contact_logs/dig_1.parquet --plot dig_1.png"
)
def contact(
    data: LogsOption,
    more: MoreLogsArgument = None,
    machine: MachineOption = None,
    tool: ToolOption = None,
    sensors: SensorsOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Folder for the CSV file of the intervals and for logs with the estimated tip force."
        ),
    ] = None,
    force: ForceOption = False,
    effects: EffectFilesOption = None,
    json: JsonOption = False,
) -> None:
    """Find intervals in which the tool touches the ground or carries a load, from cylinder pressures."""
    from hydrotele.cli.contact_command import report_contact

    report_contact([*data, *(more or [])], machine, tool, sensors, out, json, force)


@app.command(epilog="Example:  hydrotele excite cat215 --out my_excitation.yaml")
def excite(
    machine: Annotated[str, typer.Argument(help="Name of a shipped machine, or folder with machine.yaml.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Scenario file that is written (.yaml).")],
    tool: ToolOption = None,
    sensors: Annotated[
        str | None,
        typer.Option(help="Sensor set of the machine file, which states the noise. Default: its first."),
    ] = None,
    period: Annotated[float, typer.Option(min=1.0, help="Period of the trajectory [s].")] = 20.0,
    harmonics: Annotated[int, typer.Option(min=1, max=30, help="Number of harmonics of the trajectory.")] = 8,
    starts: Annotated[
        int,
        typer.Option(
            min=1, max=1000, help="Number of searches, each from a random trajectory; the best result is written."
        ),
    ] = 2,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the searches.")] = 0,
    cycles: Annotated[float, typer.Option(min=1.0, max=1e6, help="Number of periods in the scenario.")] = 3.0,
    effects: EffectFilesOption = None,
    json: JsonOption = False,
) -> None:
    """Design the motion from which a machine's parameters can be identified best, within its limits."""
    from hydrotele.cli.identify_command import design_excitation_file

    design_excitation_file(machine, tool, sensors, out, period, harmonics, starts, seed, cycles, json)


@analyse_app.command(
    "teleop",
    epilog="Examples:  hydrotele analyse teleop   |   "
    "hydrotele analyse teleop my_case.yaml --structure rate_force --delay 0.1 --confirm   |   "
    "hydrotele analyse teleop press_direct --set pilot.ratio=2.0e-5",
)
def analyse_teleop(
    file: Annotated[
        Path | None, typer.Argument(help="Case file (.yaml) or scenario. Default: a case of the CAT 215.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Output folder; default: runs/analyse_NAME, none with --json."),
    ] = None,
    structure: Annotated[
        list[str] | None,
        typer.Option(
            "--structure",
            help="Structure to analyse: position_position, position_force, four_channel_position, rate_position, "
            "rate_force or four_channel_rate; with --robust also wave_variables and "
            "passivity_control. Can be given several times. Default: those of the case, and with --robust"
            " also these two.",
        ),
    ] = None,
    delay: Annotated[
        float | None, typer.Option(min=0.0, help="Delay in each direction [s]. Default: that of the case.")
    ] = None,
    confirm: Annotated[
        bool,
        typer.Option("--confirm", help="Verify the result by simulations: sine sweeps and the stability map."),
    ] = False,
    robust: Annotated[
        bool,
        typer.Option(
            "--robust",
            help="Also analyse sampling, varying delays, random operators and the Z-width (range of"
            " displayable impedances).",
        ),
    ] = False,
    period: Annotated[float, typer.Option(min=1e-6, help="With --robust: sampling period [s].")] = 0.005,
    delays: Annotated[
        Path | None,
        typer.Option(help="With --robust: CSV file of measured delays [s] with the columns forward and back."),
    ] = None,
    operators: Annotated[
        int, typer.Option(min=1, help="With --robust: number of sampled pairs of operator and task.")
    ] = 20,
    coordinate: Annotated[
        str | None, typer.Option(help="For a scenario: task coordinate that is analysed: r, theta, z, ...")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Replace a value of the scenario: KEY=VALUE. Can be given several times."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Analyse a teleoperator as a two-port: transparency, passivity, stability, delay margins."""
    from hydrotele.cli.analyse_command import RobustnessOptions, analyse_case_or_scenario_to_folder

    pairs = parse_overrides(set_ or [])
    how = RobustnessOptions(period, delays, operators) if robust or delays else None
    analyse_case_or_scenario_to_folder(file, out, structure, delay, confirm, coordinate, pairs, json, how)


@app.command(
    epilog="Examples:  hydrotele review runs/zhu_up   |   hydrotele review a.parquet b.parquet   |   "
    "hydrotele review runs/dig --screenshot dig.png --at 8   |   hydrotele review runs/dig --video dig.mp4"
)
def review(
    log: Annotated[Path, typer.Argument(help="Log file, run folder, result folder of gap, or recording (.rrd).")],
    log2: Annotated[Path | None, typer.Argument(help="Second log with the same times, for comparison.")] = None,
    machine: MachineOption = None,
    tool: ToolOption = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Recording that is written (.rrd).")] = None,
    serve: Annotated[bool, typer.Option("--serve", help="Show the run in a browser instead of a window.")] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of --serve.")] = 9090,
    screenshot: Annotated[
        Path | None,
        typer.Option("--screenshot", help="Write a PNG image of the viewer; no window is opened."),
    ] = None,
    at: Annotated[
        float | None,
        typer.Option("--at", help="With --screenshot: displayed time [s]. Default: the middle of the log."),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", help="Write a PNG image of all signals; with two logs, also of their difference."),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option("--video", help="Write a video of the machine (.mp4); needs pip install 'hydrotele[video]'."),
    ] = None,
    force: ForceOption = False,
    effects: EffectFilesOption = None,
) -> None:
    """Show a run in the rerun viewer: 3D machine, joints, pressures, flows and forces.

    If a folder contains a recording, as those of run and gap do, the recording is shown. Each of
    --out, --screenshot, --plot and --video writes a file. If one of them is given, no window is
    opened; several can be given together.
    """
    from hydrotele.cli.review_command import ReviewOutputs, review_logs

    outputs = ReviewOutputs(out, screenshot, at, plot, video, port if serve else None)
    review_logs(log, log2, machine, tool, outputs, force)


@app.command("list", epilog="Example:  hydrotele list scenarios --json")
def list_(
    what: Annotated[
        str | None,
        typer.Argument(
            help="Kind of items to list with descriptions: machines, joysticks, scenarios, sweeps, effects,"
            " environments, plugins or all. Without it, the names of all items are listed, without descriptions."
        ),
    ] = None,
    effects: EffectFilesOption = None,
    json: JsonOption = False,
) -> None:
    """List the available machines, scenarios, sweeps, effects and environments."""
    from hydrotele.cli.list_command import list_items

    list_items(what, json)


@app.command(epilog="Example:  hydrotele validate my_machine/machine.yaml")
def validate(
    files: Annotated[
        list[Path], typer.Argument(help="Files or folders of machines, joysticks, scenarios, sweeps or logs.")
    ],
    machine: MachineOption = None,
    tool: ToolOption = None,
    force: ForceOption = False,
    effects: EffectFilesOption = None,
    json: JsonOption = False,
) -> None:
    """Check a machine, joystick, scenario, sweep or log; report errors with file and line.

    Values of a machine file on lines with the comment "# estimate" are listed in the order in which they
    should be replaced: geometry and areas first, which determine forces and speeds. Logs are checked
    against the column names and ranges of the machine, as gap does.
    """
    from hydrotele.cli.validate_command import LogMachine, validate_files

    validate_files(files, json, LogMachine(machine, tool, force))


@app.command(epilog="Example:  hydrotele export cat215 --tool bucket --out scene.xml")
def export(
    machine: Annotated[str, typer.Argument(help="Name of a shipped machine or joystick, or its folder.")],
    tool: ToolOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="MJCF file that is written. Default: standard output; nothing with --picture."
        ),
    ] = None,
    picture: Annotated[Path | None, typer.Option("--picture", help="Write a PNG image of the machine.")] = None,
    camera: Annotated[str, typer.Option(help="Camera of the image.")] = "overview",
    effects: EffectFilesOption = None,
) -> None:
    """Write the complete MJCF of a machine or joystick, or an image of it."""
    from hydrotele.cli.export_command import export_machine

    export_machine(machine, tool, out, picture, camera)


@app.command("import", epilog=IMPORT_EPILOG)
def import_(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs that other programs have written.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Parquet file that is written, or folder for several logs. Default: the current folder."
        ),
    ] = None,
    machine: Annotated[
        str | None,
        typer.Option("--machine", "-m", help="Machine whose file maps the columns: shipped machine, or folder."),
    ] = None,
    tool: ToolOption = None,
    mapping: Annotated[
        Path | None,
        typer.Option("--mapping", help="YAML file that maps columns or topics to channels (key log_columns)."),
    ] = None,
    write_mapping: Annotated[
        Path | None,
        typer.Option(
            "--write-mapping",
            metavar="FILE.yaml",
            help="Write a proposed mapping of the first log to this file, and convert nothing.",
        ),
    ] = None,
    merge: Annotated[
        bool, typer.Option("--merge", help="Merge all logs into one, because they belong to one run.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Convert ROS bags, MCAP, MATLAB and CSV files to logs that all commands read."""
    from hydrotele.cli import import_command

    if write_mapping:
        import_command.write_mapping(logs[0], write_mapping, machine, tool)
        return
    import_command.import_logs(logs, out, machine, tool, mapping, merge, json)


@app.command("export-log", epilog="Example:  hydrotele export-log runs/zhu_up --mcap zhu_up.mcap")
def export_log(
    log: Annotated[Path, typer.Argument(help="Log file, folder with one log, or run folder.")],
    mcap: Annotated[Path, typer.Option("--mcap", help="MCAP file that is written.")],
    machine: MachineOption = None,
    tool: ToolOption = None,
    force: ForceOption = False,
) -> None:
    """Write a log as an MCAP file of standard messages for Foxglove, PlotJuggler and rerun."""
    from hydrotele.cli import import_command

    import_command.export_log(log, mcap, machine, tool, force)


@app.command(epilog="Example:  hydrotele experiments zhu1994 --json")
def experiments(
    name: Annotated[
        str,
        typer.Argument(help="Publication: abdellatif2008, khoshzaban1992, wang2012 or zhu1994."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Output folder; default: runs/NAME, none with --json."),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of repetitions with other random numbers. Default: 20, or 100 for experiments that"
            " count trials.",
        ),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, max=MAX_PROCESSES, help="Number of parallel processes.")] = None,
    json: JsonOption = False,
) -> None:
    """Repeat the experiments of a publication; compare its tables and figures with simulation.

    Each row states the published value, the simulated one with its 95 % interval, the accepted range with its
    source, and a verdict. The verdict is agrees if the interval is inside the accepted range, differs if it is
    outside, undecided if it is partly inside, or cannot be computed. The reason of a difference is stated in the
    row. The exit status is 1 if a result of the publication differs; other rows (model inputs, additional results
    that are not in the publication) do not change it.
    """
    from hydrotele.cli.experiments_command import experiments_to_folder

    rows = experiments_to_folder(name, out, seeds, jobs, json)
    if any(row.verdict == "differs" and row.kind == "document" for row in rows):
        raise typer.Exit(1)


@app.command(
    epilog="Examples:  hydrotele bench --save a.json   |   hydrotele bench --compare a.json   |   "
    "hydrotele bench --device cpu"
)
def bench(
    save: Annotated[Path | None, typer.Option("--save", help="Write the results to this file (.json).")] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            "--compare", help="Print the results of an earlier --save next to the new ones, with their ratio."
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Use fewer repetitions; less accurate.")] = False,
    device: Annotated[
        str | None,
        typer.Option(
            "--device",
            help="Measure only many simultaneous simulations of the reduced model (hydrotele.batch), on cpu or cuda.",
        ),
    ] = None,
    machine: Annotated[str, typer.Option("--machine", help="With --device: machine to measure.")] = "cat215",
    tool: Annotated[str | None, typer.Option("--tool", help="With --device: tool of this machine.")] = None,
    json: JsonOption = False,
) -> None:
    """Measure the speed of the simulation: mechanism, hydraulics, scenarios, batches, start-up."""
    from hydrotele.cli.bench_command import run_batch_benchmarks, run_benchmarks

    if device is not None:
        run_batch_benchmarks(device, machine, tool, quick, json)
        return
    run_benchmarks(save, compare, quick, json)


@app.command("compile", epilog="Example:  hydrotele compile --jobs 4")
def compile_functions(
    jobs: Annotated[
        int | None, typer.Option(min=1, max=MAX_PROCESSES, help="Number of processes; default: one per core.")
    ] = None,
) -> None:
    """Compile all numerical functions now, so that later commands start without delay."""
    from hydrotele.cli.compile_command import compile_all

    compile_all(jobs)


@app.command(epilog="Example:  hydrotele demo --out demo")
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Output folder.")] = Path("demo"),
) -> None:
    """Simulate an excavator, replay its log and draw the results."""
    from hydrotele.cli.run_command import run_demo

    run_demo(out)


@app.callback(invoke_without_command=True)
def _handle_global_options(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
    quiet: QuietOption = False,
) -> None:
    if version:
        import hydrotele

        typer.echo(hydrotele.__version__)
        raise typer.Exit


def main() -> None:
    """Run the command given by the arguments of the program, and end with its exit status.

    The exit status is 2 for errors in the input, 3 for failed simulations, 130 or 143 for signals.
    """
    os.environ["PYTHONSAFEPATH"] = "1"  # child processes import nothing from the working folder
    ended: list[int] = []

    def exit_on_sigterm(number: int, _: object) -> None:
        ended.append(128 + number)
        sys.exit(ended[0])  # SystemExit runs the cleanup code

    signal.signal(signal.SIGTERM, exit_on_sigterm)
    for stream in (sys.stdout, sys.stderr):  # file names may be no valid text
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")
    warnings.showwarning = lambda message, *_, **__: typer.echo(f"warning {message}", err=True)
    try:
        _run_app_and_report_errors()
    finally:
        if ended:  # a library may have replaced SystemExit by another exception
            sys.exit(ended[0])


def _run_app_and_report_errors() -> None:
    try:
        _check_utf8_arguments(sys.argv[1:])
        app()
    except (Exception, SystemExit) as error:
        if type(error).__name__ == "SimulationFailed":
            typer.echo(f"simulation failed: {error}", err=True)
            sys.exit(3)
        if not (said := _find_input_error(error)):
            raise
        typer.secho("error ", fg="red", bold=True, err=True, nl=False)
        typer.echo(str(said), err=True)
        sys.exit(2)


def _find_input_error(error: BaseException) -> InputError | None:
    """Convert an exception caused by the user's input or files to an InputError; None for any other."""
    if isinstance(error, InputError):
        return error
    effects = sys.modules.get("hydrotele.effects")
    if own := effects and effects.locate_error_in_effect_file(error):
        return own
    if isinstance(error, OSError):  # for example a file name that is too long
        return InputError(error.filename or "the system", error.strerror or str(error))
    return None


def _check_utf8_arguments(words: list[str]) -> None:
    """Raise InputError for arguments that are not valid UTF-8, whose bytes Python keeps as surrogates."""
    for word in words:
        if any("\ud800" <= character <= "\udfff" for character in word):
            raise InputError(word, "is not valid UTF-8: rename the file or folder")
