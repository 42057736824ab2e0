"""Read the recorded runs of the electro-hydraulic actuator and compute their error measures.

Imported by `eha_fit.py` and `real_machines.py`; `../shared/real/README.md` describes the runs and
the way of judging.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.effects.effect import with_value
from hydrotele.logs.log import Log, load_log
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.sensors import SensorError

LOADS = {1: "none", 2: "load_20_bar", 3: "load_30_bar", 4: "load_40_bar", 5: "load_50_bar"}
CHANNELS = ("position.piston", "pressure_head.piston", "pressure_rod.piston")
FIRMWARE_RPM = 16.65  # rpm per count and ms, where 60 000 / 4096 is right
STRETCH = FIRMWARE_RPM * 4096 / 60_000  # of the logged speed
_STANDING = 1500  # rows before the reference moves
_BEFORE, _JUDGED = 2000, 25_000  # rows: what is judged begins 2 s before the reference moves
_SMOOTHED = 51  # rows
_CREEP = 1.0e-6  # rad/s: keeps the sign of the valve while the pump stands


class EhaRun(NamedTuple):
    """One run.

    Attributes:
        name: such as `3_1`: load group, stroke in steps of 12.5 mm.
        log: the log.
        start: channel -> mean over 1.5 s at rest before it starts [Pa].
        speed: (n,) pump speed from the firmware's estimate, signed with the valve [rad/s].
        measured: (n, 3) position [m] and both pressures, smoothed [Pa].
        judged: the rows that are judged.
        active: rows in which the controller is on.
    """

    name: str
    log: Log
    start: dict[str, float]
    speed: np.ndarray
    measured: np.ndarray
    judged: slice
    active: slice

    @property
    def group(self) -> int:
        """Load group, 1 to 5."""
        return int(self.name[0])


def load_run(path: Path) -> EhaRun:
    """Read a run `run_<group>_<stroke>.parquet`."""
    machine = load_machine("eha")
    log = load_log(path, aliases=machine.log_columns)
    valve, moving = log["command.valve"], np.flatnonzero(np.diff(log["reference.piston"]))
    name, first = path.stem.removeprefix("run_"), int(moving[0])
    on = np.flatnonzero(valve)
    return EhaRun(
        name=name,
        log=log,
        start={c: float(log[c][:_STANDING].mean()) for c in CHANNELS[1:]},
        speed=np.maximum(np.abs(log["speed.pump"]) / STRETCH, _CREEP) * valve,
        measured=smoothed(np.column_stack([log[c] for c in CHANNELS])),
        judged=slice(max(0, first - _BEFORE), first - _BEFORE + _JUDGED),
        active=slice(0, int(on[-1]) + 1),
    )


def load_runs(folder: Path) -> list[EhaRun]:
    """All runs of a folder, sorted by name."""
    return [load_run(path) for path in sorted(folder.glob("run_*.parquet"))]


def smoothed(values: np.ndarray, rows: int = _SMOOTHED) -> np.ndarray:
    """(n, 3) position as it is, pressures as a centred mean over `rows`, fewer at the ends."""
    kernel = np.ones(rows)
    weight = np.convolve(np.ones(len(values)), kernel, "same")
    columns = [np.convolve(column, kernel, "same") / weight for column in values.T[1:]]
    return np.column_stack([values[:, 0], *columns])


def differences(run: EhaRun, simulated: np.ndarray) -> tuple[float, float, float]:
    """RMS differences of position [mm] and of head and rod pressure [bar]."""
    error = (smoothed(simulated) - run.measured)[run.judged]
    position, head, rod = np.sqrt(np.mean(error**2, axis=0)) * [1.0e3, 1.0e-5, 1.0e-5]
    return float(position), float(head), float(rod)


def true_start(machine: Machine, run: EhaRun) -> dict[str, float]:
    """Channel -> pressure [Pa] at the start, the sensors' zeros taken off."""
    errors = machine.sensor_errors
    return {c: value - errors.get(c, SensorError()).offset for c, value in run.start.items()}


def without_motor(machine: Machine) -> Machine:
    """The machine whose command is the speed of its pump over the rated one."""
    return with_value(machine, "axes.piston.pump.motor", None)
