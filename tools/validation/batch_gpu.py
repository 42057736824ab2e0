"""Measure batches of the reduced model on a CUDA device in less than ten minutes: speed, parity, compile time.

    python tools/validation/batch_gpu.py --out batch_gpu.json

Install `hydrotele[gpu]` first. The results are printed as they come and written as JSON: first step with and
without the cache, steps per second for 256 to 262 144 machines, differences from the CPU after 2 s of random
commands, equal bits of two runs on the device, and machines whose state is not finite after 10^9 steps.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from hydrotele.batch import Batch
from hydrotele.batch.measure import CUDA_COUNTS, measure_batch, measure_parity
from hydrotele.core.device import import_cuda
from hydrotele.machine.machine_file import load_machine

RANDOM_STEPS = 10**9  # time steps of all machines together without a state that is not finite
_FIRST_STEP = (
    "import sys; from hydrotele.batch.measure import measure_batch; from hydrotele.machine.machine_file import"
    " load_machine; print(measure_batch(load_machine('cat215', sys.argv[1]), 'cuda', (256,), 0.1)[0]['first_step_s'])"
)


def measure_first_step(tool: str) -> float:
    """Return the duration of the first step in a new process [s]."""
    done = subprocess.run([sys.executable, "-c", _FIRST_STEP, tool], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def count_failures(tool: str, machines: int) -> int:
    """Return the number of machines that are not finite after `RANDOM_STEPS` steps with full random commands."""
    batch, rng = Batch(load_machine("cat215", tool), machines, device="cuda"), np.random.default_rng(2)
    failed, done = np.zeros(machines, bool), 0
    while done < RANDOM_STEPS:
        batch.step(rng.uniform(-1.0, 1.0, (machines, len(batch.axes))), 10)
        failed |= batch.to_host(batch.machines.failed) > 0
        done += 200 * machines
    return int(failed.sum())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("batch_gpu.json"), help="file of the results")
    parser.add_argument("--tool", default="bucket", help="tool of the cat215")
    chosen = parser.parse_args()
    begin, machine = time.perf_counter(), load_machine("cat215", chosen.tool)
    found: dict = {"device": import_cuda().get_current_device().name.decode(), "tool": chosen.tool}
    for name, measure in (
        ("first_step_s", lambda: measure_first_step(chosen.tool)),
        ("second_process_s", lambda: measure_first_step(chosen.tool)),
        ("sizes", lambda: measure_batch(machine, "cuda", CUDA_COUNTS, 5.0)),
        ("parity", lambda: measure_parity(machine, 2.0)),
        ("failed_in_1e9_steps", lambda: count_failures(chosen.tool, 65536)),
    ):
        found[name] = measure()
        print(f"{time.perf_counter() - begin:6.1f} s  {name}: {found[name]}", flush=True)
        chosen.out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
