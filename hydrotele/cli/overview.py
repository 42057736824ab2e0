"""The page of `hydrotele --help`, written without importing the command-line library.

Importing typer takes longer than the rest of `hydrotele --help`.
"""

import shutil
from textwrap import fill

USAGE = "Usage: hydrotele [OPTIONS] COMMAND [ARGS]..."
DESCRIPTION = "Simulation and teleoperation testbed for heavy hydraulic machines, built on MuJoCo."
OPTIONS = {
    "--version": "Print the version and exit.",
    "--install-completion": "Install completion for the current shell.",
    "--show-completion": "Print the completion script of the current shell.",
    "-h, --help": "Show this page and exit.",
}
COMMANDS = {
    "run": "Simulate a scenario; write logs, a rerun recording, a summary and the MJCF.",
    "drive": "Drive a machine in real time; write a folder as `run` does.",
    "haptic-device": "Connect a haptic device to a machine: poses out, wrenches in, watchdog.",
    "sweep": "Run variations of a scenario (grid or random samples) and collect one table.",
    "compare": "Compare models by free runs on measured commands: RMS error per channel.",
    "identify-operator": "Fit the operator model to a tracking log: delay, margins, lag, remnant.",
    "replay": "Drive the model with the commands of a log; print the prediction errors.",
    "gap": "Find where the model and measured logs disagree, name the effect, patch the model.",
    "identify": "Identify masses, friction and hydraulics from measured logs; write the machine.",
    "excite": "Design the most informative trajectory within a machine's limits.",
    "review": "Show a run in rerun: the machine in 3D, joints, pressures, flows and forces.",
    "list": "List what is shipped: machines, scenarios, sweeps, effects, environments.",
    "validate": "Check a machine, joystick, scenario, sweep or log; report errors and their place.",
    "export": "Write the complete MJCF of a machine or joystick, or a picture of it.",
    "experiments": "Repeat a published document's experiments; compare every table and figure.",
    "compile": "Compile all numerical functions now, so that no later command waits for it.",
    "bench": "Measure speed: mechanism, hydraulics, a whole scenario, batches, start-up.",
    "demo": "Run an excavator, replay its log, draw the pictures.",
    "analyse": "Analyse a teleoperator by linear two-port theory.",
    "calibrate": "Calibrate the kinematics of a mechanism from measured poses.",
}
"""One line for each command."""


def format_overview(width: int | None = None) -> str:
    """Return the help page of the program, wrapped to a width in characters (the terminal's)."""
    width = min(width or shutil.get_terminal_size().columns, 120)
    parts = [fill(text, width) for text in (USAGE, DESCRIPTION)]
    for title, rows in ("Options", OPTIONS), ("Commands", COMMANDS):
        indent = max(map(len, rows)) + 4
        lines = [
            fill(text, width, initial_indent=f"  {name}".ljust(indent),
                 subsequent_indent=" " * indent, break_on_hyphens=False)
            for name, text in rows.items()
        ]  # fmt: skip
        parts.append("\n".join([f"{title}:", *lines]))
    parts.append(fill("hydrotele COMMAND --help describes a command and its options.", width))
    return "\n\n".join(parts)
