"""Which law fails, and where: balances of the measured runs next to those of a clean machine."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.dataset.load import Dataset, RunData
from hydrotele.dynamics.integrate import simulate_rows
from hydrotele.dynamics.model import model_space, reduced_model, state_names, state_size
from hydrotele.errors import InputError
from hydrotele.gap.balances import Balance, balances
from hydrotele.gap.unknown_signals import run_log
from hydrotele.kinematics.triangle import LoopOpen
from hydrotele.machine import Machine
from hydrotele.prediction.start import start_state
from hydrotele.prediction.track import STEP

CLEAR = 1.25  # excess from which a law counts as broken; clean machines stay below 1.2
_LATE = 2.0  # the same for timing, whose noise is known less well
_WORST_CLEAN = 2.0  # a simulation without feedback may leave the places where the data were taken
# Correlation and slope of what mending a reading does to the flow and what the flow lacks: 1 and 1
# for a bad reading but for the noise of the force, below 0.3 or far from 1 for all else.
_LIKE, _SLOPES = 0.5, (0.4, 1.7)
_EVERYWHERE = 1.5  # excess on every axis that speaks of one cause for all
_ALSO = 0.3  # of the largest excess, from which another law is worth telling
_SEED = 0
Table = Mapping[tuple[str, str], float]
Found = Mapping[str, Mapping[str, Balance]]


@dataclass(frozen=True)
class Verdict:
    """What fails.

    Attributes:
        law: `force`, `flow`, `supply`, `geometry`, `timing` or `sensor`.
        balance: name of the balance that shows it best, such as `flow_rod`.
        place: axis of that balance, or `supply`.
        side: `head` or `rod` of a bad pressure sensor, else empty.
        excess: normalised RMS of the balance over that of a clean machine [1].
        everywhere: whether the flows of all axes fail.
        others: other balances that fail, (name, place), the worst first.
    """

    law: str
    balance: str
    place: str
    side: str
    excess: float
    everywhere: bool
    others: tuple[tuple[str, str], ...] = ()


_LAW = {
    "force": "force", "flow_head": "flow", "flow_rod": "flow", "supply": "supply",
    "closure": "geometry", "timing": "timing",
}  # fmt: skip


def measured_balances(machine: Machine, data: Dataset) -> tuple[Found, ...]:
    """Balances of the held-out run, then of the fit runs; empty where a run allows none."""
    runs = (data.heldout, *data.fit)
    return tuple(_balances(machine, data, run, run.reading) for run in runs)


def clean_balances(machine: Machine, data: Dataset) -> tuple[Found, ...]:
    """The same of the machine itself: simulated with the runs' commands and sensor noise."""
    model = reduced_model(machine, data.channels)
    generator, found = np.random.default_rng(_SEED), []
    for run in (data.heldout, *data.fit):
        start, _ = start_state(machine, data, run, model, state_names(machine))
        shown = np.empty((len(run.command), len(data.channels)))
        states = np.empty((len(run.command), state_size(model)))
        simulate_rows(
            model, model_space(model), start.copy(), run.command, run.period,
            max(1, round(run.period / STEP)), shown, states,
        )  # fmt: skip
        noise = generator.uniform(-1.0, 1.0, shown.shape) * np.sqrt(3.0) * np.nan_to_num(data.noise)
        reading = np.where(np.isnan(run.reading), np.nan, shown + noise)
        found.append(_balances(machine, data, run, reading))
    return tuple(found)


def excesses(measured: Sequence[Found], clean: Sequence[Found]) -> dict[tuple[str, str], float]:
    """(law, place) -> normalised RMS of all runs over a clean machine's, which counts as 1 .. 2."""
    reference = _pooled(clean)
    return {
        key: value / float(np.clip(reference.get(key, 1.0), 1.0, _WORST_CLEAN))
        for key, value in _pooled(measured).items()
    }


def judge(
    machine: Machine, data: Dataset, excess: Table, measured: Sequence[Found]
) -> Verdict | None:
    """The law that fails most; None where all balances hold.

    A pressure sensor is blamed if force and flow of the same chamber fail and mending its readings
    by what the force lacks mends the flow, too. Timing is blamed only where nothing else fails: a
    wrong flow shifts the motion as well.
    """
    lags = {k: v for k, v in excess.items() if k[0] == "timing"}
    rest = {k: v for k, v in excess.items() if k[0] != "timing"}
    for table, limit in ((rest, CLEAR), (lags, _LATE)):
        if table and max(table.values()) >= limit:
            (balance, place), value = max(table.items(), key=lambda item: item[1])
            break
    else:
        return None
    everywhere = len(machine.hydraulic_axes) > 1 and all(
        max(excess.get((f"flow_{side}", axis), 0.0) for side in ("head", "rod")) > _EVERYWHERE
        for axis in machine.hydraulic_axes
    )
    law, side = _LAW[balance], ""
    if not everywhere and law in ("force", "flow"):
        side = _bad_sensor(machine, data, excess, measured, place)
    if side:
        law, balance = "sensor", "force"
    shown = {(balance, place)} | ({("force", place), (f"flow_{side}", place)} if side else set())
    loud = max(CLEAR, _ALSO * value)
    others = sorted((k for k in rest if rest[k] >= loud and k not in shown), key=lambda k: -rest[k])
    return Verdict(law, balance, place, side, value, everywhere and law == "flow", tuple(others))


def lacking_pressure(machine: Machine, place: str, side: str, force: np.ndarray) -> np.ndarray:
    """(n,) error [Pa] of a chamber's reading that a force residual [N] or [N m] amounts to."""
    head, rod = machine.axes[place].hydraulic_drive.areas
    return force / head if side == "head" else -force / rod


def _bad_sensor(machine, data: Dataset, excess: Table, measured, place: str) -> str:
    if excess.get(("force", place), 0.0) < CLEAR:
        return ""
    flows = {s: excess.get((f"flow_{s}", place), 0.0) for s in ("head", "rod")}
    side = max(flows, key=lambda s: flows[s])
    if flows[side] < CLEAR:
        return ""
    law, column = f"flow_{side}", data.channels.index(f"pressure_{side}.{place}")
    likeness, slopes = [], []
    for run, found in zip((data.heldout, *data.fit), measured, strict=True):
        if place not in found.get("force", {}) or place not in found.get(law, {}):
            continue
        mended = run.reading.copy()
        mended[:, column] -= lacking_pressure(machine, place, side, found["force"][place].residual)
        after = _balances(machine, data, run, mended).get(law, {}).get(place)
        if after is None:
            continue
        noise = found[law][place].noise
        lacks = found[law][place].residual / noise
        mends = lacks - after.residual / noise
        likeness.append(lacks @ mends / np.sqrt((lacks @ lacks) * (mends @ mends)))
        slopes.append(lacks @ mends / (mends @ mends))
    if not likeness:
        return ""
    fits = np.median(likeness) > _LIKE and _SLOPES[0] < np.median(slopes) < _SLOPES[1]
    return side if fits else ""


def _balances(machine: Machine, data: Dataset, run: RunData, reading: np.ndarray) -> Found:
    try:
        return balances(machine, run_log(data, run, reading), data.sensors)
    except (InputError, LoopOpen, ValueError, ArithmeticError, np.linalg.LinAlgError):
        return {}


def _pooled(runs: Sequence[Found]) -> dict[tuple[str, str], float]:
    squares: dict[tuple[str, str], list[np.ndarray]] = {}
    for run in runs:
        for law, places in run.items():
            for place, found in places.items():
                with np.errstate(all="ignore"):
                    ratio = found.residual / found.noise
                squares.setdefault((law, place), []).append(ratio[np.isfinite(ratio)] ** 2)
    joined = {key: np.concatenate(parts) for key, parts in squares.items()}
    return {key: float(np.sqrt(v.mean())) for key, v in joined.items() if len(v)}
