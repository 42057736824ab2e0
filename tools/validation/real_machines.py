"""Run the workflow on public records of real machines and compare with published results.

    python tools/validation/real_machines.py ../shared/real [--only emps eha] [--jobs 2]

EMPS, from the published model with symmetric friction: names what lacks, and the relative error of
the force on the samples that were not fitted. Volvo EC20: fitted to free runs on one part of the
record and judged on another, beside black boxes; then the whole workflow. Electro-hydraulic
actuator: free runs by pump speed and by duty, and runs of the MuJoCo plant under the published
controller, against the figures in the folder's README.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hydrotele.estimate.baselines import fit_baseline
from hydrotele.estimate.free_run import Prepare, free_run_errors, machine_runner
from hydrotele.estimate.output_error import fit_free_runs, uncertain_parameters
from hydrotele.gap.find import find_gap
from hydrotele.gap.result import Gap
from hydrotele.identify.zero_phase_filter import filter_zero_phase
from hydrotele.logs.dataset import Dataset, RunData, load_dataset
from hydrotele.logs.dataset_reduction import find_exciting_segment
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from hydrotele.terms.drive_state import NO_DRIVES, DriveState
from hydrotele.terms.table import FORCE, encode_terms_table, sum_terms

WINDOW, LEAD = 5.0, 0.5  # s; of each window the lead has readings, the rest none
PUSH = (176.0, 7.3, 0.7)  # N, s, s: half of the drive's largest force
ENCODER = 5.0e-6  # m, an accuracy that the record's makers do not state
_MINUTE = 60.0  # s
FIRST_THREE_QUARTERS = "first 75 % -> last 25 %"
MINUTE = "busiest 60 s -> last 25 %"
_GAP = 0.1  # s without readings that may be bridged: the logger repeats them
_EDGE = 100  # rows that the filters' ends spoil


def force_error(machine: Machine, run: RunData, cutoff: float) -> float:
    """Relative error of the drive force along the measured motion [%].

    Force and motion pass the same zero-phase filter, as is usual in identification.
    """
    axis = machine.axes["slide"]
    drive, friction = axis.force, axis.force.friction
    motion = filter_zero_phase(run.reading[:, 0], run.period, cutoff)
    force = filter_zero_phase(drive.gain * run.command[:, 0], run.period, cutoff).value
    v, way = motion.rate, np.tanh(motion.rate / friction.smoothing_velocity)
    modelled = (
        machine.links["carriage"].mass * motion.acceleration
        + friction.viscous * (1.0 + friction.viscous_asymmetry * np.sign(v)) * v
        + friction.coulomb * (1.0 + friction.coulomb_asymmetry * np.sign(v)) * way
        + drive.offset
        - _added(machine, run, motion.value, motion.rate)
    )
    inner = slice(_EDGE, -_EDGE)
    left = (force - modelled)[inner]
    return float(100.0 * np.linalg.norm(left) / np.linalg.norm(force[inner]))


def _added(machine: Machine, run: RunData, position: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Forces (n,) that learned laws and other terms add to the drive along a motion [N]."""
    total, table = np.zeros(len(rate)), encode_terms_table(machine.terms, ["slide"])
    nothing = DriveState(*[0.0] * len(DriveState._fields))
    for row, (x, v) in enumerate(zip(position, rate, strict=True)):
        command = float(run.command[row, 0])
        state = nothing._replace(
            time=run.start + row * run.period, position=x, velocity=v, command=command,
            force=machine.axes["slide"].force.gain * command,
        )  # fmt: skip
        total[row] = sum_terms(table, FORCE, 0, state, NO_DRIVES)
    return total


def velocity_fit(prepare: Prepare, run: RunData, cutoff: float) -> np.ndarray:
    """Fit (c,) of the velocities where a model has had no reading for half a second or more [%].

    100 % less the size of the difference over that of the velocity itself about its mean. The model
    runs freely through windows side by side, its rates are put one behind the other, and both
    velocities pass the same zero-phase filter.
    """
    known = np.flatnonzero(np.isfinite(run.reading).all(axis=1))
    run = run.select_rows(known[0], known[-1] + 1)
    rows, lead = round(WINDOW / run.period), round(LEAD / run.period)
    starts = np.arange(lead, len(run.reading) - rows, rows)
    bridge = round(_GAP / run.period)
    reading = filter_zero_phase(run.reading, run.period, cutoff, max_gap=bridge)
    measured = reading.rate[starts[0] : starts[-1] + rows]
    made = prepare(run).run(starts, rows)
    rates = np.diff(made, axis=1, prepend=made[:, :1]) / run.period
    rates[:, 0] = rates[:, 1]
    modelled = filter_zero_phase(rates.reshape(measured.shape), run.period, cutoff).value
    judged = np.arange(len(measured)) % rows >= lead
    gone = np.linalg.norm((measured - modelled)[judged], axis=0)
    whole = np.linalg.norm((measured - measured.mean(axis=0))[judged], axis=0)
    return 100.0 * (1.0 - gone / whole)


def named(gap: Gap) -> str:
    """What was named, with its rivals and the probability that they leave."""
    return "; ".join(
        f"{e.name}({e.location}), "
        + ", ".join(f"{k} {p.value:.4g} [{p.low:.4g}, {p.high:.4g}] {p.unit}"
                    for k, p in e.parameters.items())
        + "".join(f", {e.probability:.2f}, or {a.name}({a.location})" for a in e.alternatives)
        for e in gap.effects
    )  # fmt: skip


def pushed(data: Dataset, size: float, start: float, duration: float) -> Dataset:
    """The record as if something else had pushed the carriage with a force for a while [N], [s].

    The motion stays as it was measured; the drive's share of the force is less by the push.
    """
    gain = data.machine.axes["slide"].force.gain

    def taken(run: RunData) -> RunData:
        time = run.start + run.period * np.arange(len(run.command))
        inside = (time >= start) & (time < start + duration)
        return dataclasses.replace(run, command=run.command - inside[:, None] * size / gain)

    return dataclasses.replace(data, fit=tuple(map(taken, data.fit)), heldout=taken(data.heldout))


def emps(folder: Path, jobs: int) -> None:
    """Name what the published model of EMPS lacks: as it is, with stated accuracy, pushed."""
    machine = load_machine("emps")
    data = load_dataset(folder / "emps" / "main.parquet", machine)
    variants = {
        "as recorded": data,
        f"accuracy stated, {ENCODER:g} m": dataclasses.replace(data, noise=np.array([ENCODER])),
        "hidden push of {:g} N from {:g} s for {:g} s".format(*PUSH): pushed(data, *PUSH),
    }
    for name, variant in variants.items():
        gap = find_gap(variant, jobs=jobs)
        print(f"EMPS, {name}: {gap.verdict}: {named(gap)}  ({gap.seconds:.0f} s)")
        for law in gap.learned:
            print(f"  learned: {law.description} {law.formula}")
        for cutoff in (20.0, 40.0, 100.0):
            before = force_error(machine, data.heldout, cutoff)
            after = force_error(gap.patched, data.heldout, cutoff)
            print(f"  relative force error, held out, {cutoff:.0f} Hz: {before:.2f} -> {after:.2f} %")


def joined(runs: Sequence[RunData]) -> RunData:
    """Pieces of one record as one run again."""
    tables = {
        name: np.concatenate([getattr(run, name) for run in runs]) for name in ("command", "command_known", "reading")
    }
    valid = None
    if any(run.valid is not None for run in runs):
        valid = np.concatenate([
            np.ones(len(run.reading), bool) if run.valid is None else run.valid for run in runs
        ])  # fmt: skip
    return dataclasses.replace(runs[0], **tables, valid=valid)


def ec20_splits(data: Dataset) -> dict[str, Dataset]:
    """The EC20's record, fitted on one part and judged on another, and on a minute of it."""
    quarters = [*data.fit, data.heldout]
    parts = {
        "first half -> second": (quarters[:2], quarters[2:]),
        "second half -> first": (quarters[2:], quarters[:2]),
        FIRST_THREE_QUARTERS: (quarters[:3], quarters[3:]),
    }
    splits = {
        name: dataclasses.replace(data, fit=(joined(fit),), heldout=joined(held)) for name, (fit, held) in parts.items()
    }
    whole = splits[FIRST_THREE_QUARTERS]
    run = whole.fit[0]
    rows = find_exciting_segment(run, round(_MINUTE / run.period))
    minute = run.select_rows(rows.start, rows.stop)
    return splits | {MINUTE: dataclasses.replace(whole, fit=(minute,))}


def free_run_words(prepare: Prepare, run: RunData) -> str:
    """RMS errors of the angles over 5, 10 and 30 s, boom / stick [deg]."""
    errors = free_run_errors(prepare(run), run, (5.0, 10.0, 30.0), to_end=False)
    return "  ".join(
        f"{seconds} s " + " / ".join(f"{np.degrees(x):5.2f}" for x in horizon.rms)
        for seconds, horizon in errors.horizons.items()
    )


def ec20_free_runs(data: Dataset, jobs: int) -> None:
    """The shipped machine, fitted to free runs, beside black boxes that saw the same or more."""
    for name, split in ec20_splits(data).items():
        begin = time.perf_counter()
        fit = fit_free_runs(split, uncertain_parameters(data.machine), jobs=jobs)
        seconds = time.perf_counter() - begin
        print(f"EC20, {name}, boom / stick: fitted in {seconds:.0f} s", flush=True)
        models = {"as shipped": machine_runner(data.machine, split)}
        models["fitted"] = machine_runner(fit.machine, split)
        if name != MINUTE:
            for which in ("table", "arx", "mlp"):
                models[which] = fit_baseline(which, split)
            itself = dataclasses.replace(split, fit=(split.heldout,))  # what the form can reach
            there = fit_free_runs(itself, uncertain_parameters(data.machine), jobs=jobs)
            models["fitted there"] = machine_runner(there.machine, itself)
        for which, prepare in models.items():
            speeds = velocity_fit(prepare, split.heldout, 2.0)
            print(
                f"  {which:12} velocity fit {speeds[0]:5.1f} / {speeds[1]:5.1f} %  RMS angle error"
                f" [deg] {free_run_words(prepare, split.heldout)}", flush=True,
            )  # fmt: skip


def ec20(folder: Path, jobs: int) -> None:
    """Fit the shipped machine to free runs on several splits; then the whole workflow."""
    data = load_dataset(folder / "volvo_ec20" / "long.parquet", load_machine("ec20"))
    ec20_free_runs(data, jobs)
    gap = find_gap(data, lambda text, _: print(f"  {text}", file=sys.stderr), jobs=jobs)
    print(f"EC20: {gap.verdict}: {named(gap)}  ({gap.seconds:.0f} s)")
    for note in gap.notes:
        print(f"  {note}")
    for which, machine in (("as shipped", gap.machine), ("patched", gap.patched)):
        speeds = velocity_fit(machine_runner(machine, data), data.heldout, 2.0)
        print(f"  {which:10} velocity fit, held out, {speeds[0]:.1f} / {speeds[1]:.1f} %")


# Run -> the authors' position RMS under control [mm]; then open loop as the folder's README has it:
# position [mm], head and rod pressure [bar].
_EHA_FIGURES = {
    "1_1": (0.32, 1.5, 1.3, 1.8),
    "1_4": (0.38, 1.1, 1.3, 2.0),
    "2_2": (0.38, 1.0, 2.3, 2.0),
    "3_1": (0.40, 1.4, 3.4, 2.0),
    "3_3": (0.45, 1.2, 4.0, 2.2),
    "4_2": (0.53, 2.1, 5.5, 1.8),
    "4_4": (0.56, 1.8, 5.8, 1.7),
    "5_3": (1.34, 2.0, 6.7, 5.7),
}


def eha(folder: Path, _jobs: int) -> None:
    """RMS differences of every run of the electro-hydraulic actuator, beside the figures."""
    from tools.studies.eha_control import under_control
    from tools.studies.eha_fit import free_run
    from tools.studies.eha_runs import LOADS, differences, load_runs

    print("EHA: RMS differences; position [mm], head and rod pressure [bar]")
    for run in load_runs(folder / "eha"):
        machine = load_machine("eha", LOADS[run.group])
        authors, *simple = _EHA_FIGURES.get(run.name, (np.nan,) * 4)
        ways = {
            "under its controller": under_control(machine, run),
            "pump speed and valve in": free_run(machine, run, by_speed=True),
            "duty and valve in": free_run(machine, run, by_speed=False),
        }
        for way, simulated in ways.items():
            figures = [authors, np.nan, np.nan] if way.startswith("under") else simple
            pairs = zip(differences(run, simulated), figures, strict=True)
            text = "  ".join(f"{here:5.2f} (figure {figure:4.2f})" for here, figure in pairs)
            print(f"  {run.name} {way:24} {text}".replace("(figure  nan)", " " * 13), flush=True)


STUDIES = {"emps": emps, "ec20": ec20, "eha": eha}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with emps/, volvo_ec20/ and eha/")
    parser.add_argument("--only", choices=STUDIES, nargs="+", default=list(STUDIES))
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    for name in args.only:
        STUDIES[name](args.folder, args.jobs)
