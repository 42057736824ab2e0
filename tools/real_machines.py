"""The workflow on the public records of two real machines, with figures that others can check.

    python tools/real_machines.py ../shared/real [--only emps] [--jobs 2]

EMPS, from the published model with symmetric friction: names what lacks, and the relative error of
the force on the samples that were not fitted. Volvo EC20, from a valve without delay and dead band:
names what lacks, and the fit of the velocities over 5 s without readings, on the stretch that was
not fitted.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np

from hydrotele.dataset.load import Dataset, RunData, load_dataset
from hydrotele.dynamics.model import state_names
from hydrotele.effects import apply_effect
from hydrotele.gap.find import find_gap
from hydrotele.gap.result import Gap
from hydrotele.identify.zero_phase import zero_phase
from hydrotele.machine import Machine
from hydrotele.machine_file import load_machine
from hydrotele.prediction.levels import find_levels
from hydrotele.prediction.stretches import busiest
from hydrotele.prediction.track import track_run

WINDOW, LEAD = 5.0, 0.5  # s; of each window the lead has readings, the rest none
_EDGE = 100  # rows that the filters' ends spoil


def force_error(machine: Machine, run: RunData, cutoff: float) -> float:
    """Relative error of the drive force along the measured motion [%].

    Force and motion pass the same zero-phase filter, as is usual in identification.
    """
    axis = machine.axes["slide"]
    drive, friction = axis.force, axis.force.friction
    motion = zero_phase(run.reading[:, 0], run.period, cutoff)
    force = zero_phase(drive.gain * run.command[:, 0], run.period, cutoff).value
    v, way = motion.rate, np.tanh(motion.rate / friction.smoothing_velocity)
    modelled = (
        machine.links["carriage"].mass * motion.acceleration
        + friction.viscous * (1.0 + friction.viscous_asymmetry * np.sign(v)) * v
        + friction.coulomb * (1.0 + friction.coulomb_asymmetry * np.sign(v)) * way
        + drive.offset
    )
    inner = slice(_EDGE, -_EDGE)
    left = (force - modelled)[inner]
    return float(100.0 * np.linalg.norm(left) / np.linalg.norm(force[inner]))


def read_throughout(run: RunData) -> RunData:
    """A run from the first row in which all channels are read to the last one."""
    known = np.flatnonzero(np.isfinite(run.reading).all(axis=1))
    return run.part(known[0], known[-1] + 1)


def velocity_fit(machine: Machine, data: Dataset, cutoff: float) -> dict[str, float]:
    """Fit of the velocities in the held-out run, where the model has had no reading [%].

    100 % less the size of the difference over that of the velocity itself about its mean; both
    velocities pass the same zero-phase filter.
    """
    run = read_throughout(data.heldout)
    rows, lead = round(WINDOW / run.period), round(LEAD / run.period)
    hidden = np.arange(len(run.reading)) % rows >= lead
    reading = np.where(hidden[:, None], np.nan, run.reading)
    states = track_run(machine, data, dataclasses.replace(run, reading=reading)).states
    names, fits = state_names(machine), {}
    for column, channel in enumerate(data.channels):
        axis = channel.partition(".")[2]
        measured = zero_phase(run.reading[:, column], run.period, cutoff).rate
        rate = states[:, names.index(f"rate.{machine.axes[axis].joint}")]
        modelled = zero_phase(rate, run.period, cutoff).value
        gone = np.linalg.norm((measured - modelled)[hidden])
        whole = np.linalg.norm((measured - measured.mean())[hidden])
        fits[axis] = float(100.0 * (1.0 - gone / whole))
    return fits


def named(gap: Gap) -> str:
    """What was named, with its rivals and the probability that they leave."""
    return "; ".join(
        f"{e.name}({e.location}), "
        + ", ".join(f"{k} {p.value:.4g} [{p.low:.4g}, {p.high:.4g}] {p.unit}"
                    for k, p in e.parameters.items())
        + "".join(f", {e.probability:.2f}, or {a.name}({a.location})" for a in e.alternatives)
        for e in gap.effects
    )  # fmt: skip


def emps(folder: Path, jobs: int) -> None:
    """Name what the published model of EMPS lacks."""
    machine = load_machine("emps")
    data = load_dataset(folder / "emps" / "main.parquet", machine)
    gap = find_gap(data, jobs=jobs)
    print(f"EMPS: {gap.verdict}: {named(gap)}  ({gap.seconds:.0f} s)")
    for cutoff in (20.0, 40.0, 100.0):
        before = force_error(machine, data.heldout, cutoff)
        after = force_error(gap.patched, data.heldout, cutoff)
        print(f"  relative force error, held out, {cutoff:.0f} Hz: {before:.2f} -> {after:.2f} %")


def plain_valves(record: Path) -> Dataset:
    """The EC20's record with a machine whose valves have neither delay nor dead band."""
    machine = load_machine("ec20")
    for axis in ("boom", "stick"):
        machine = apply_effect(machine, "valve_deadband", axis, {"deadband": 0.0})
    return load_dataset(record, machine)


def ec20(folder: Path, jobs: int) -> None:
    """Name what a valve without delay and dead band lacks."""
    data = plain_valves(folder / "volvo_ec20" / "long.parquet")
    machine = data.machine
    gap = find_gap(data, lambda text, _: print(f"  {text}", file=sys.stderr), jobs=jobs)
    print(f"EC20: {gap.verdict}: {named(gap)}  ({gap.seconds:.0f} s)")
    judged = find_levels(busiest(data))
    before, after = (velocity_fit(m, judged, 2.0) for m in (machine, gap.patched))
    for axis, fit in before.items():
        print(f"  velocity fit, held out, {axis}: {fit:.1f} -> {after[axis]:.1f} %")


STUDIES = {"emps": emps, "ec20": ec20}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="with emps/ and volvo_ec20/")
    parser.add_argument("--only", choices=STUDIES, nargs="+", default=list(STUDIES))
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    for name in args.only:
        STUDIES[name](args.folder, args.jobs)
