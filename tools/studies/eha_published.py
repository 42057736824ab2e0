"""Compute the prediction error caused by each published parameter of the actuator `models/eha`.

    python tools/studies/eha_published.py ../shared/real/eha

Free runs of `models/eha` with one number as published in the place of the fitted one; mean over the
runs of the RMS differences: position [mm], head and rod pressure [bar].
"""

import argparse
from pathlib import Path

import numpy as np

from hydrotele.effects.effect import with_value
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from tools.studies.eha_fit import free_run
from tools.studies.eha_runs import LOADS, STRETCH, EhaRun, differences, load_runs

_PUMP = "axes.piston.pump"
PUBLISHED = {  # what -> path -> value in SI
    "rod 20 mm": {"axes.piston.cylinder.area_rod": 1649.336e-6},
    "1.6 cm3 per turn": {f"{_PUMP}.displacement": 1.6e-6 / (2.0 * np.pi)},
    "volumetric efficiency 0.92 at 1500 rpm, 250 bar": {f"{_PUMP}.leakage": 1.28e-13},
    "9 mV/rpm": {f"{_PUMP}.motor.torque_constant": 0.0859},
    "inertia 0.01 kg m2": {f"{_PUMP}.motor.inertia": 0.01},
    "no friction": {f"axes.piston.cylinder.friction.{name}": 0.0 for name in ("coulomb", "stribeck_extra")}
    | {"axes.piston.cylinder.friction.viscous": 1.0e3},
    "no torque losses": {
        f"{_PUMP}.torque_loss": 0.0,
        f"{_PUMP}.motor.drag": 0.0,
        f"{_PUMP}.motor.breakaway": 0.0,
        f"{_PUMP}.motor.viscous": 0.0,
    },
    "stiff lines, oil without air": {
        f"{_PUMP}.compliance_head": 0.0,
        f"{_PUMP}.compliance_rod": 0.0,
        f"{_PUMP}.air_head": 0.0,
        f"{_PUMP}.air_rod": 0.0,
    },
}
TABLE = {2: 20.0e5, 3: 30.0e5, 4: 40.0e5, 5: 50.0e5}  # Pa


def as_published(machine: Machine, group: int, what: str) -> Machine:
    """The machine with what the authors say."""
    for path, value in PUBLISHED.get(what, {}).items():
        machine = with_value(machine, path, value)
    if what == "pressure zeros of the calibration":
        machine = with_value(machine, "sensor_errors", {})
    if what == "load table" and group > 1:
        load = machine.loads["piston"].model_copy(update={"relief_pressure": TABLE[group]})
        machine = with_value(machine, "loads", {"piston": load})
    return machine


def figures(runs: list[EhaRun], what: str, by_speed: bool) -> np.ndarray:
    """(3,) mean over the runs of the RMS differences."""
    rows = []
    for run in runs:
        machine = as_published(load_machine("eha", LOADS[run.group]), run.group, what)
        if what == "speed as logged":
            run = run._replace(speed=run.speed * STRETCH)
        rows.append(differences(run, free_run(machine, run, by_speed)))
    return np.mean(rows, axis=0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with run_<group>_<stroke>.parquet")
    the_runs = load_runs(parser.parse_args().folder)
    others = ["speed as logged", "pressure zeros of the calibration", "load table"]
    print("by pump speed: mm, bar, bar; by duty: mm, bar, bar")
    for what in ["as fitted", *PUBLISHED, *others]:
        pair = [figures(the_runs, what, by_speed) for by_speed in (True, False)]
        print("   ".join(" ".join(f"{x:6.2f}" for x in row) for row in pair), what, flush=True)
