"""Run the search under trial for mechanisms; the process gets only a model and logs.

    python mechanism_workflow.py MJCF COLUMNS DATA...

Prints one line of JSON per folder of logs: what `hydrotele gap --mjcf MJCF --columns COLUMNS --data
DATA --json` prints. Nothing of the generator is imported here.
"""

import argparse
import dataclasses
import json
from pathlib import Path

from hydrotele.cli.gap_command import compute_open_loop_errors
from hydrotele.core.errors import InputError
from hydrotele.gap.force_find import find_force_gap
from hydrotele.gap.result import gap_document
from hydrotele.identify.mechanism import load_mechanism, load_mechanism_records


def main() -> None:
    """Search and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mjcf", type=Path)
    parser.add_argument("columns", type=Path)
    parser.add_argument("data", type=Path, nargs="+")
    asked = parser.parse_args()
    mechanism = load_mechanism(asked.mjcf, asked.columns)
    for folder in asked.data:
        try:
            fit, judge, said = load_mechanism_records([folder], mechanism, keep_measured_joints=True)
            gap = find_force_gap(asked.mjcf, asked.columns, fit, judge, notes=said)
            loop = compute_open_loop_errors(gap, [folder], mechanism, None)
            document = gap_document(dataclasses.replace(gap, open_loop=loop))
        except InputError as error:
            document = {"error": str(error)}
        print(json.dumps(document, allow_nan=False), flush=True)


if __name__ == "__main__":
    main()
