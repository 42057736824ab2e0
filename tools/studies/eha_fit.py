"""Fit the unpublished parameters of the electro-hydraulic actuator to its recorded runs.

    python tools/studies/eha_fit.py ../shared/real/eha [--rounds 12] [--without 3_1] [--each]

Output error of position and both pressures, free run over the judged 25 s from the measured start,
driven by the pump speed and, besides, by the duty. `--without` leaves runs out of the fit; `--each`
fits eight times, always without the run that is then judged. Every number starts 15 % away from
that of `models/eha`.
"""

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from hydrotele.effects.effect import with_value
from hydrotele.estimate.reduced_model import model_space, reduced_model, simulate_rows, state_names
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from tools.studies.eha_runs import (
    CHANNELS,
    LOADS,
    EhaRun,
    differences,
    load_runs,
    smoothed,
    true_start,
    without_motor,
)

UNIT = np.array([0.5e-3, 1.5e5, 1.5e5])  # m, Pa, Pa: what counts as one
_COARSE = 4  # rows of 1 ms per row of the fit, which the model crosses in two steps
_EVERY = 6  # of these rows between residuals
_INDEPENDENT = 500  # rows over which differences are alike
_ASIDE = 0.15  # of its logarithm, every other one up and down: where the fit starts
_WORST = 50.0  # units, of a run that leaves the model's range
_PRIOR = 0.02  # residual of a number e times its start, which keeps what no run shows
_TABLE = {2: 20.0e5, 3: 30.0e5, 4: 40.0e5, 5: 50.0e5}  # Pa, the authors' load table
_BELOW, _ZERO, _RETURN = "relief below the table", "zero of pressure_rod", "return force, group 5"
_CYLINDER = ("area_rod", "friction.coulomb", "friction.viscous")
_PUMP = (
    "displacement", "leakage", "torque_loss", "compliance_head", "compliance_rod", "air_head",
    "air_rod", "accumulator.pressure", "accumulator.line_extending",
    "accumulator.line_retracting", "motor.torque_constant", "motor.inertia", "motor.drag", "motor.breakaway",
    "motor.breakaway_speed", "motor.viscous",
)  # fmt: skip
_LOAD = ("unfilled_travel", "air_pressure", "relief_override", "friction")
_PATHS = [f"axes.piston.cylinder.{n}" for n in _CYLINDER] + [f"axes.piston.pump.{n}" for n in _PUMP]
_ROD = "pressure_rod.piston"


def first_values(machines: dict[int, Machine]) -> dict[str, float]:
    """Name -> value of every fitted number, as the model folder has it."""
    load, rod = machines[3].loads["piston"], machines[1].sensor_errors[_ROD]
    values = {path: _number(machines[1], path) for path in _PATHS}
    values |= {f"load.{name}": getattr(load, name) for name in _LOAD}
    values |= {_BELOW: _TABLE[3] - load.relief_pressure, _ZERO: rod.offset}
    return values | {_RETURN: machines[5].loads["piston"].return_force}


def _number(machine: Machine, path: str) -> float:
    node: Any = machine
    for name in path.split("."):
        node = node[name] if isinstance(node, dict) else getattr(node, name)
    return float(node)


def with_values(machine: Machine, group: int, values: dict[str, float]) -> Machine:
    """The machine of a load group with other values."""
    for path in _PATHS:
        machine = with_value(machine, path, values[path])
    rod = machine.sensor_errors[_ROD].model_copy(update={"offset": values[_ZERO]})
    machine = with_value(machine, "sensor_errors", {**machine.sensor_errors, _ROD: rod})
    if group == 1:
        return machine
    update = {name: values[f"load.{name}"] for name in _LOAD}
    update |= {"relief_pressure": _TABLE[group] - values[_BELOW]}
    update |= {"return_force": values[_RETURN]} if group == 5 else {}
    return with_value(machine, "loads", {"piston": machine.loads["piston"].model_copy(update=update)})


def free_run(machine: Machine, run: EhaRun, by_speed: bool, coarse: int = 1) -> np.ndarray:
    """(n / coarse, 3) what the sensors show in a free run of the reduced model, in `CHANNELS`.

    Args:
        machine: the machine with the load of the run.
        run: gives start and command.
        by_speed: whether the pump speed drives it, else the duty.
        coarse: rows of the log per row of the result; beyond 1 the step is 2 ms instead of 1 ms.
    """
    command = run.log["command.piston"]
    if by_speed:
        machine = without_motor(machine)
        command = run.speed / _number(machine, "axes.piston.pump.rated_speed")
    model, names = reduced_model(machine, CHANNELS), state_names(machine)
    z = np.zeros(len(names))
    for channel, value in true_start(machine, run).items():
        z[names.index(channel)] = value
    rows = len(command) // coarse
    column = command[: rows * coarse].reshape(rows, coarse).mean(axis=1, keepdims=True)
    shown, states = np.empty((rows, 3)), np.empty((rows, len(z)))
    steps = max(1, coarse // 2)
    simulate_rows(model, model_space(model), z, column, 1.0e-3 * coarse, steps, shown, states)
    return shown


def _errors(run: EhaRun, coarse: np.ndarray) -> np.ndarray:
    """(k, 3) differences of a coarse free run in `UNIT`, of the judged rows."""
    first, stop = run.judged.start // _COARSE, run.judged.stop // _COARSE
    error = smoothed(coarse, 13) - run.measured[::_COARSE][: len(coarse)]
    return (error / UNIT)[first:stop:_EVERY]


def fit(runs: list[EhaRun], rounds: int, say: Callable[[str], None]) -> tuple[dict[str, float], dict[str, float]]:
    """Least squares over all runs; returns values and standard errors as a share of them.

    The standard errors count one row in 500 as independent.
    """
    machines = {group: load_machine("eha", tool) for group, tool in LOADS.items()}
    first = first_values(machines)

    def values(z: np.ndarray) -> dict[str, float]:
        steps = dict(zip(first, z, strict=True))
        return {name: value * math.exp(steps[name]) for name, value in first.items()}

    def residual(z: np.ndarray) -> np.ndarray:
        now = values(z)
        groups = {run.group for run in runs}
        built = {group: with_values(machines[group], group, now) for group in groups}
        rows = [
            _errors(run, free_run(built[run.group], run, by_speed, _COARSE))
            for run in runs
            for by_speed in (True, False)
        ]
        weight = math.sqrt(_EVERY * _COARSE / 25_000)
        errors = np.nan_to_num(np.concatenate(rows).ravel(), nan=_WORST)
        return np.concatenate([np.clip(errors, -_WORST, _WORST) * weight, _PRIOR * z])

    def report(intermediate_result) -> None:
        say(f"cost {intermediate_result.cost:.3f}")

    begin = _ASIDE * (-1.0) ** np.arange(len(first))
    solution = least_squares(
        residual, begin, x_scale=0.3, diff_step=3.0e-3, max_nfev=rounds,
        bounds=(-3.0, 3.0), callback=report,
    )  # fmt: skip
    scatter = 2.0 * solution.cost / len(runs) / 6.0  # per sum of one channel over a run's rows
    independent = 25_000 / _INDEPENDENT
    curvature = solution.jac.T @ solution.jac * independent / scatter
    errors = np.sqrt(np.diag(np.linalg.inv(curvature)))
    return values(solution.x), dict(zip(first, errors, strict=True))


def table(runs: list[EhaRun], values: dict[str, float]) -> None:
    """Print the differences of free runs."""
    print("run    speed: mm  head  rod bar   duty: mm  head  rod bar")
    for run in runs:
        machine = with_values(load_machine("eha", LOADS[run.group]), run.group, values)
        found = [differences(run, free_run(machine, run, by_speed)) for by_speed in (True, False)]
        text = "    ".join(f"{x:9.2f} {h:5.2f} {r:5.2f}" for x, h, r in found)
        print(f"{run.name}  {text}", flush=True)


def main() -> None:
    """Fit, print the values and how far free runs are off."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with run_<group>_<stroke>.parquet")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--without", nargs="*", default=[], help="runs to leave out of the fit")
    parser.add_argument("--each", action="store_true", help="leave every run out in turn")
    args = parser.parse_args()
    runs = load_runs(args.folder)

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    for out in [[run.name] for run in runs] if args.each else [args.without]:
        kept = [run for run in runs if run.name not in out]
        values, errors = fit(kept, args.rounds, say)
        if not args.each:
            for name, value in values.items():
                print(f"{name}: {value:.5g}  (+- {100.0 * errors[name]:.1f} %)")
        judged = [run for run in runs if run.name in out] or runs
        table(judged, values)


if __name__ == "__main__":
    main()
