"""Entry point of the program `hydrotele`."""

import os
import sys

from hydrotele.cli.program_help import format_program_help


def main() -> None:
    """Print the overview for `--help`; otherwise import typer and run the command."""
    if sys.argv[1:] in (["--help"], ["-h"]):
        try:
            print(format_program_help(), flush=True)
        except BrokenPipeError:  # the reading program, such as `head`, has closed the pipe
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return
    from hydrotele.cli.main import main as run_command

    run_command()
