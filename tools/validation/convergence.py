"""Replay the independent nominal logs at several time steps; print errors and their ratios.

    python tools/validation/convergence.py ../shared/measured/nominal_truth --steps 1 0.5 0.25 0.1

Angles in degrees RMS (worst axis), pressures in % of 28 MPa RMS (worst chamber).
"""

import argparse
from pathlib import Path

import numpy as np

from hydrotele.logs.log import load_logs
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.replay import replay_log

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("logs", type=Path, help="folder of logs with initial_state")
parser.add_argument("--machine", default="cat215")
parser.add_argument("--steps", type=float, nargs="+", default=[1.0, 0.5, 0.25, 0.1], help="[ms]")
arguments = parser.parse_args()

machine = load_machine(arguments.machine)
relief = machine.supply.relief_pressure
print("| run | step [ms] | angle [deg] | pressure [% of 28 MPa] | angle error / step [deg/ms] |")
print("| --- | ---: | ---: | ---: | ---: |")
for log in load_logs(arguments.logs):
    for step in arguments.steps:
        channels = replay_log(log, machine, step * 1e-3).channels
        angle = max(np.degrees(c.rms) for n, c in channels.items() if n.startswith("angle"))
        pressure = max(100 * c.rms / relief for n, c in channels.items() if n.startswith("press"))
        print(
            f"| {log.name} | {step:g} | {angle:.5f} | {pressure:.5f} | {angle / step:.4f} |",
            flush=True,
        )
