"""Command line of `hydrotele calibrate`: one function for each type of calibration."""

from pathlib import Path
from typing import Annotated

import typer

from hydrotele.cli.option_values import CommandGroup
from hydrotele.core.errors import InputError

app = CommandGroup(
    help="Calibrate the kinematics of a mechanism from measured poses.",
    no_args_is_help=True,
)  # fmt: skip

DataOption = Annotated[Path, typer.Option("--data", "-d", help="Folder with the measurements.")]
HeldOutOption = Annotated[
    str | None,
    typer.Option(help="Part of the data that tests the result and is not fitted; see the description of the command."),
]
OutOption = Annotated[Path | None, typer.Option("--out", "-o", help="Output folder. Default: nothing is written.")]
MachineOption = Annotated[
    str, typer.Option("--machine", "-m", help="Machine with a calibrator: name of a shipped machine, or its folder.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")]


@app.command(epilog="Example:  hydrotele calibrate arm --data logs --json --out calibrated")
def arm(
    data: DataOption, heldout: HeldOutOption = None, out: OutOption = None, json: JsonOption = False,
    machine: MachineOption = "calibrator",
    method: Annotated[str, typer.Option(help="Identify all links together (joint) or one after another"
    " (hierarchical).")] = "joint",
    poses: Annotated[int, typer.Option(min=10, help="Number of poses that are used from each log.")] = 300,
    accuracy_deg: Annotated[
        float | None, typer.Option(help="Standard deviation of the angle sensors [deg]. Default: that of the logs.")
    ] = None,
    bad_data: Annotated[bool, typer.Option(help="Detect and exclude corrupted samples.")] = True,
    drift: Annotated[
        bool, typer.Option(help="Correct slow motion of the links that should not move, by the arm's own sensors.")
    ] = True,
    flexibility: Annotated[
        bool, typer.Option(help="Estimate the bending of the calibrator's joints under load.")
    ] = True,
) -> None:  # fmt: skip
    """Calibrate the links of an arm from logs of an external calibrator (Khoshzaban 1992).

    The folder --data contains one log for each link; in each log, only that link moves. With
    --heldout N, every N-th pose tests the result and is not fitted. Default: 5.
    """
    from hydrotele.cli.calibrate_arm_command import ArmChoices, calibrate_arm

    choices = ArmChoices(method, poses, accuracy_deg, bad_data, drift, heldout, flexibility)
    calibrate_arm(data, machine, choices, out, json)


@app.command(epilog="Example:  hydrotele calibrate linkage --data logs --json")
def linkage(
    data: DataOption, heldout: HeldOutOption = None, out: OutOption = None, json: JsonOption = False,
    machine: MachineOption = "calibrator",
    angles: Annotated[
        str, typer.Option(help="Source of the joint angles: measured (the arm's sensors) or identified"
        " (from the calibrator).")
    ] = "measured",
) -> None:  # fmt: skip
    """Calibrate the cylinder linkages of an arm from joint angles and cylinder lengths.

    Every fifth sample tests the result and is not fitted; --heldout is refused here.
    """
    from hydrotele.cli.calibrate_linkage_command import calibrate_linkage

    if heldout is not None:
        raise InputError("--heldout", "is not used here: every fifth sample is held out")
    calibrate_linkage(data, machine, angles, out, json)


@app.command(epilog="Example:  hydrotele calibrate machine --data poses --dynamics motions --out calibrated")
def machine(
    data: DataOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Output folder.")],
    dynamics: Annotated[
        list[Path] | None,
        typer.Option(
            help="Logs from which masses and friction are identified. Default: those of --data. Can be"
            " given several times."
        ),
    ] = None,
    heldout: Annotated[
        str | None, typer.Option(help="Run of the logs of --dynamics that tests the result and is not fitted.")
    ] = None,
    json: JsonOption = False,
    machine: MachineOption = "calibrator",
) -> None:
    """Calibrate arm, cylinder linkages, masses and friction in sequence (Khoshzaban 1992, p. 125).

    The folder --data contains one log for each link; in each log, only that link moves, measured
    by the calibrator. The dynamic step uses the calibrated kinematics. Its logs must contain
    pressures of the same machine.
    """
    from hydrotele.cli.calibrate_machine_command import calibrate_machine

    calibrate_machine(data, dynamics or [], machine, heldout, out, json)


@app.command(
    epilog="Examples:  hydrotele calibrate imu --data logs --machine excavator --pose '2.0 boom=25deg stick=-90deg'"
    " --out calibrated   |   hydrotele gap --data calibrated/logs --machine calibrated/machine.yaml"
)
def imu(
    data: Annotated[
        list[Path],
        typer.Option("--data", "-d", help="Log with IMU channels, or folder of logs. Can be given several times."),
    ],
    machine: Annotated[
        str, typer.Option("--machine", "-m", help="Machine with IMUs: name of a shipped machine, or its folder.")
    ],
    tool: Annotated[
        str | None, typer.Option("--tool", "-t", help="Name of the mounted tool, for machines with several tools.")
    ] = None,
    sensors: Annotated[
        str | None,
        typer.Option(
            "--sensors", "-s", help="Sensor set of the machine file that contains the IMUs. Default: that of the logs."
        ),
    ] = None,
    pose: Annotated[
        list[str] | None,
        typer.Option(
            help="Known joint positions at a time: '[RUN@]SECONDS AXIS=VALUE[deg] ...'. Can be given several times."
        ),
    ] = None,
    pose_sd_deg: Annotated[
        float, typer.Option(min=1e-4, help="Standard deviation of the positions of --pose [deg].")
    ] = 0.1,
    slope_sd_deg: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=45.0,
            help="Standard deviation of the slope of the ground [deg]; 0 means that the ground is level.",
        ),
    ] = 0.0,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Calibrate IMUs on the links from logs, and derive the joint positions from their readings.

    Mounting rotations, biases and the joint motion are estimated together. A constant offset of a
    joint equals a rotation of its IMU about the joint axis, so give known positions with --pose, or
    a small rotation_sd in the machine file. The folder --out contains the calibrated machine and
    the logs with joint positions, which gap, identify, compare and replay accept.
    """
    from hydrotele.cli.calibrate_imu_command import calibrate_imu_logs

    calibrate_imu_logs(data, machine, tool, sensors, pose or [], pose_sd_deg, slope_sd_deg, out, json)


@app.command(epilog="Example:  hydrotele calibrate design --out design")
def design(
    out: OutOption = None, json: JsonOption = False, machine: MachineOption = "calibrator",
    accuracy_deg: Annotated[float, typer.Option(help="Largest error of the angle sensors [deg].")] = 0.1,
) -> None:  # fmt: skip
    """Design a calibrator: arm lengths and ball-joint position for the smallest tip error."""
    from hydrotele.cli.calibrate_arm_command import design_calibrator

    design_calibrator(machine, accuracy_deg, out, json)


@app.command(
    epilog="Examples:  hydrotele calibrate hybrid --data measured --out calibrated   |   "
    "hydrotele calibrate hybrid --simulate measured --poses 25 --seed 1   |   "
    "hydrotele calibrate hybrid --data measured --evolution --posterior 8000 --json"
)
def hybrid(
    data: Annotated[
        Path | None, typer.Option("--data", "-d", help="Folder with the measured poses, poses.csv or poses.parquet.")
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(help="File of the nominal robot. Default: robot.yaml in the folder, else the shipped robot iwr."),
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            help="Error model of the serial part: dh (Denavit-Hartenberg), poe (product of exponentials),"
            " or auto (the better one)."
        ),
    ] = "auto",
    parameters: Annotated[
        str,
        typer.Option(help="Parameters to estimate: all, document (the 36 of Wang 2012), or names separated by commas."),
    ] = "all",
    evolution: Annotated[
        bool, typer.Option("--evolution", help="Also search globally, by differential evolution.")
    ] = False,
    posterior: Annotated[
        int,
        typer.Option(
            min=0,
            metavar="STEPS",
            help="Also sample the posterior by MCMC with this number of steps, 40 or more; 0 means no.",
        ),
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    simulate: Annotated[
        Path | None, typer.Option(help="Simulate a measurement and write it to this folder, instead of a calibration.")
    ] = None,
    poses: Annotated[int, typer.Option(min=1, help="With --simulate: number of poses.")] = 25,
    heldout: Annotated[
        int,
        typer.Option(
            min=0, help="With --simulate: number of additional poses that test the result and are not fitted."
        ),
    ] = 25,
    choose: Annotated[
        str,
        typer.Option(
            help="With --simulate: random poses, or the most informative of 200 by the criterion D, O1, O2,"
            " O3, O4 or O5."
        ),
    ] = "random",
    noise: Annotated[float, typer.Option(min=0.0, help="With --simulate: factor on the sensor noise.")] = 1.0,
    errors: Annotated[
        float, typer.Option(min=0.0, help="With --simulate: factor on the geometric errors of 1 mm and 1 mrad.")
    ] = 1.0,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Calibrate a serial-parallel robot from measured poses (Wang 2012)."""
    from hydrotele.cli.calibrate_hybrid_command import calibrate_hybrid, simulate_hybrid_to_folder

    if (data is None) == (simulate is None):
        raise InputError("calibrate hybrid", "give either --data FOLDER or --simulate FOLDER")
    if simulate is not None:
        simulate_hybrid_to_folder(simulate, robot, poses, heldout, seed, noise, errors, parameters, model, choose)
    elif data is not None:
        calibrate_hybrid(data, robot, model, parameters, evolution, posterior, seed, out, json)


@app.command(
    epilog="Examples:  hydrotele calibrate scara --simulate measured --poses 20   |   "
    "hydrotele calibrate scara --data measured --out calibrated"
)
def scara(
    data: Annotated[
        Path | None, typer.Option("--data", "-d", help="Folder with nominal.yaml and measured.csv.")
    ] = None,
    heldout: Annotated[
        str | None,
        typer.Option(
            help="Numbers of the poses that test the result, such as 3,7; the first pose is 1. Default:"
            " each pose in turn."
        ),
    ] = None,
    simulate: Annotated[Path | None, typer.Option(help="Simulate measurements and write them to this folder.")] = None,
    poses: Annotated[int, typer.Option(min=4, help="With --simulate: number of poses.")] = 20,
    noise: Annotated[
        float,
        typer.Option(min=0.0, help="With --simulate: standard deviation of the measured positions [mm]."),
    ] = 0.05,
    seed: Annotated[int, typer.Option(help="With --simulate: seed of the random numbers, 0 or more.")] = 1,
    choose: Annotated[
        int | None, typer.Option(min=2, help="Also list the most informative poses; the value is their number.")
    ] = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Calibrate the link lengths of a SCARA from measured positions (Wang 2012, section 1.1)."""
    from hydrotele.cli.calibrate_scara_command import calibrate_scara_to_folder, simulate_scara_to_folder

    if simulate is not None:
        simulate_scara_to_folder(simulate, poses, 1e-3 * noise, seed)
    if data is not None:
        calibrate_scara_to_folder(data, heldout, choose, out, json)
    elif simulate is None:
        message = "give --data FOLDER, or --simulate FOLDER to create a data set"
        raise InputError("calibrate scara", message)


@app.command(
    epilog="Examples:  hydrotele calibrate mukca --data my_panda --out calibrated   |   "
    "hydrotele calibrate mukca --data sets --robot arm.urdf --heldout left --json"
)
def mukca(
    data: Annotated[
        Path,
        typer.Option(
            "--data",
            "-d",
            help="Folder with one folder for each place of the tool, which contains hole_0.csv, hole_1.csv,"
            " ... (one for each socket).",
        ),
    ],
    robot: Annotated[
        str | None,
        typer.Option(
            help="Name of a shipped robot, or a YAML, URDF or MJCF file. Default: the file in the data"
            " folder, else the shipped robot that fits best."
        ),
    ] = None,
    heldout: Annotated[
        str | None,
        typer.Option(help="Name of the place that tests the result and is not fitted. Default: every place in turn."),
    ] = None,
    distance: Annotated[
        float,
        typer.Option(min=0.0, help="Distance of neighbouring sockets [mm]; 0 means unknown."),
    ] = 50.0,
    accuracy: Annotated[float, typer.Option(min=1e-6, help="Standard deviation of that distance [mm].")] = 0.05,
    unit: Annotated[str, typer.Option(help="Unit of the joint angles: rad or deg.")] = "rad",
    model: Annotated[
        str | None,
        typer.Option(
            help="Model of the joints: rigid, gravity (elastic under weight), eccentricity (of the"
            " encoders) or both. Default: the one with the most accurate prediction."
        ),
    ] = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Calibrate a serial robot from joint angles, with its ball tool held in fixed sockets."""
    from hydrotele.cli.calibrate_mukca_command import SocketChoices, calibrate_mukca

    choices = SocketChoices(robot, heldout, 1e-3 * distance, 1e-3 * accuracy, unit, model)
    calibrate_mukca(data, choices, out, json)
