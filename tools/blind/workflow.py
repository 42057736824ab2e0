"""The workflow under trial, as a process of its own that knows nothing but a folder of logs.

    python workflow.py DATA MACHINE [THREADS]

Prints the `gap.json` document. Nothing of the generator is imported here.
"""

import argparse
import json

from hydrotele.dataset.load import load_dataset
from hydrotele.gap.find import find_gap
from hydrotele.gap.gap_json import gap_document
from hydrotele.machine_file import load_machine

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("data")
parser.add_argument("machine")
parser.add_argument("threads", type=int, nargs="?", default=1)
arguments = parser.parse_args()

dataset = load_dataset(arguments.data, load_machine(arguments.machine))
print(json.dumps(gap_document(find_gap(dataset, jobs=arguments.threads))))
