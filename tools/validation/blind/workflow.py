"""Run the workflow under trial as a separate process that gets only a folder of logs.

    python workflow.py DATA MACHINE [THREADS]

Prints the `gap.json` document, with `open_loop` (RMS errors over 5 s of the given and the patched
machine on the held-out run, mean square over the channels, in units of the noise) and
`memory_bytes` (the process's peak). Nothing of the generator is imported here.
"""

import argparse
import json
import math
import resource

from hydrotele.gap.find import find_gap
from hydrotele.gap.result import gap_document
from hydrotele.logs.dataset import load_dataset
from hydrotele.machine.machine_file import load_machine
from tools.validation.blind.open_loop import HORIZON, open_loop_error


def main() -> None:
    """Search and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data")
    parser.add_argument("machine")
    parser.add_argument("threads", type=int, nargs="?", default=1)
    arguments = parser.parse_args()
    dataset = load_dataset(arguments.data, load_machine(arguments.machine))
    gap = find_gap(dataset, jobs=arguments.threads)
    document = gap_document(gap)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    errors: dict[str, float | None] = {"horizon": HORIZON}
    for key, machine in (("before", gap.machine), ("after", gap.patched)):
        sizes = open_loop_error(machine, dataset, dataset.heldout).values()
        whole = math.sqrt(sum(size**2 for size in sizes) / len(sizes))
        errors[key] = whole if math.isfinite(whole) else None
    print(json.dumps(document | {"open_loop": errors, "memory_bytes": 1024 * peak}))


if __name__ == "__main__":
    main()
