"""Format the output of `hydrotele --help` without importing typer.

Importing typer takes longer than all other work of `hydrotele --help`.
"""

import shutil
from textwrap import fill

USAGE = "Usage: hydrotele [OPTIONS] COMMAND [ARGS]..."
DESCRIPTION = "Simulation and teleoperation testbed for heavy hydraulic machines, built on MuJoCo."
OPTIONS = {
    "--version": "Print the version and exit.",
    "-q, --quiet": "Print only results, warnings and errors; also an option of each command.",
    "--install-completion": "Install completion for the current shell.",
    "--show-completion": "Print the completion script of the current shell.",
    "-h, --help": "Show this message and exit.",
}
COMMAND_GROUPS = {
    "Simulate and drive": {
        "run": "Simulate a scenario; write logs, a rerun recording, a summary and the MJCF.",
        "sweep": "Run variations of a scenario (grid or random samples); collect the results in a table.",
        "drive": "Drive a machine in real time; write the same files as `run`.",
        "serve": "Let a client program drive a simulated machine over ZeroMQ; write the same files as `run`.",
        "haptic-device": "Connect a haptic device to `hydrotele drive` over UDP: send its pose, apply forces.",
        "demo": "Simulate an excavator, replay its log and draw the results.",
    },
    "Compare with measurements": {
        "replay": "Simulate the model with the commands of a log; print the prediction errors.",
        "compare": "Compare open-loop predictions of several models with logs: RMS error per channel.",
        "gap": "Find differences between model and logs, identify their cause, correct the model.",
        "contact": "Find intervals in which the tool touches the ground or carries a load, from cylinder pressures.",
        "review": "Show a run in the rerun viewer: 3D machine, joints, pressures, flows and forces.",
    },
    "Identify and calibrate": {
        "excite": "Design the motion from which a machine's parameters can be identified best, within its limits.",
        "identify": "Identify masses, friction and hydraulics from logs; write the identified machine.",
        "identify-operator": "Fit the operator model to a log of a tracking task: delay, margins, lag, remnant.",
        "calibrate": "Calibrate the kinematics of a mechanism from measured poses.",
    },
    "Analyse": {
        "analyse": "Analyse a teleoperator by linear two-port theory.",
        "linearise": "Compute linear state-space models of a machine at poses; list natural frequencies and damping.",
        "experiments": "Repeat the experiments of a publication; compare its tables and figures with simulation.",
    },
    "Learn": {
        "train": "Train a policy for a control task with PPO; compare it with the reference controller.",
        "record": "Record episodes of a control task as a Minari data set, from a controller, a policy or logs.",
    },
    "Models and files": {
        "new": "Create a machine from a robot description: URDF, xacro or MJCF.",
        "list": "List the available machines, scenarios, sweeps, effects and environments.",
        "validate": "Check a machine, joystick, scenario, sweep or log; report errors with file and line.",
        "export": "Write the complete MJCF of a machine or joystick, or an image of it.",
        "import": "Convert ROS bags, MCAP, MATLAB and CSV files to logs that all commands read.",
        "export-log": "Write a log as an MCAP file of standard messages for Foxglove, PlotJuggler and rerun.",
    },
    "Installation": {
        "compile": "Compile all numerical functions now, so that later commands start without delay.",
        "bench": "Measure the speed of the simulation: mechanism, hydraulics, scenarios, batches, start-up.",
    },
}
"""Summary of each command by group: the first line of its help text."""
COMMANDS = {name: text for group in COMMAND_GROUPS.values() for name, text in group.items()}
"""Summary of each command."""


def format_program_help(width: int | None = None) -> str:
    """Format the output of `hydrotele --help`: usage, options, and a summary of each command.

    Args:
        width: line length [characters], default that of the terminal; at most 120.
    """
    width = min(width or shutil.get_terminal_size().columns, 120)
    parts = [fill(text, width) for text in (USAGE, DESCRIPTION)]
    indent = max(map(len, (*OPTIONS, *COMMANDS))) + 4
    for title, rows in {"Options": OPTIONS, **COMMAND_GROUPS}.items():
        lines = [
            fill(text, width, initial_indent=f"  {name}".ljust(indent),
                 subsequent_indent=" " * indent, break_on_hyphens=False)
            for name, text in rows.items()
        ]  # fmt: skip
        parts.append("\n".join([f"{title}:", *lines]))
    parts.append(fill("hydrotele COMMAND --help describes a command and its options.", width))
    return "\n\n".join(parts)
