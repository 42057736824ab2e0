"""Summary of a run: speed, pins, contact, tracking, and what produced it."""

import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import hydrotele
from hydrotele.control.plan import Plan
from hydrotele.hydraulics.circuit import ACTIVATIONS
from hydrotele.scenario.scenario import Scenario
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import Record

_VACUUM = -1.0e5  # Pa below the atmosphere, as far as pressure can fall


def summarise(
    plant: Plant, scenario: Scenario, plan: Plan, record: Record, pins: float, wall: float
) -> dict[str, Any]:
    """What `summary.json` says, but for the balances.

    Args:
        plant: what ran.
        scenario: what was asked.
        plan: what was asked of every axis.
        record: the states at the log's rows.
        pins: largest pin opening seen at a control tick [m].
        wall: time that the loop took [s].

    Returns:
        Plain numbers and texts; units stand in the keys, or in `unit`.
    """
    return {
        "kind": "run",
        "scenario": scenario.name,
        "machine": plant.machine.name,
        "tool": plant.machine.tool,
        "seed": scenario.seed,
        "effects": [planted.model_dump() for planted in scenario.effects],
        "simulated_seconds": scenario.duration,
        "wall_seconds": round(wall, 4),
        "realtime_factor": round(scenario.duration / wall, 1),
        "physics_steps": round(scenario.duration / scenario.timestep),
        "largest_pin_opening_mm": pins * 1e3,
        "notes": [*plan.notes, *_doubts(plant, record)],
        "largest_contact_force_N": float(np.linalg.norm(record.contact, axis=1).max()),
        "tracking": _tracking(plant, plan, record),
        "versions": _versions(),
        "git_commit": _git_commit(),
    }


def _doubts(plant: Plant, record: Record) -> list[str]:
    """Sentences about states that no machine can have."""
    if not plant.hydraulic:
        return []
    act = record.act[:, : ACTIVATIONS * plant.hydraulic]
    pressures = act.reshape(len(record.time), -1, ACTIVATIONS)[:, :, 2:]
    lowest = pressures.min(initial=0.0)
    if lowest < _VACUUM:
        return [f"a chamber falls to {lowest / 1e6:.1f} MPa, which oil cannot: check the machine"]
    return []


def _tracking(plant: Plant, plan: Plan, record: Record) -> dict[str, Any]:
    """Largest and RMS deviation of every followed axis, and of the tip from its desired pose."""
    rows = np.searchsorted(plan.time, record.time - 1e-9)
    result: dict[str, Any] = {}
    for i, name in enumerate(plan.axes):
        if plan.closed[i]:
            error = record.qpos[:, plant.qpos[i]] - plan.reference[rows, i]
            result[name] = _size(
                error, "rad" if plant.machine.position_kind(name) == "angle" else "m"
            )
    if plan.pose is not None and record.tip.shape[1]:
        desired = plan.pose[rows]
        r = np.hypot(record.tip[:, 0], record.tip[:, 1]) - desired[:, 0]
        arm = plant.machine.arm
        joints = [j for j in (arm.boom, arm.stick, arm.tool) if j] if arm else []
        places = [plant.model.joint(j).qposadr[0] for j in joints]
        attitude = record.qpos[:, places].sum(axis=1) - desired[:, 3]
        z = record.tip[:, 2] - desired[:, 2]
        result["tip_r"], result["tip_z"] = _size(r, "m"), _size(z, "m")
        result["tip_attitude"] = _size(attitude, "rad")
    return result


def _size(error: np.ndarray, unit: str) -> dict[str, Any]:
    rms, largest = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    return {"rms": rms, "max": largest, "unit": unit}


def _versions() -> dict[str, str]:
    names = ("mujoco", "dm-control", "numpy", "scipy", "numba", "pyarrow", "rerun-sdk")
    return {"hydrotele": hydrotele.__version__, **{n: version(n) for n in names}}


def _git_commit() -> str | None:
    """Commit of the checkout that this package runs from, with `+` if it has changes."""
    folder = Path(hydrotele.__file__).parent.parent
    if not (folder / ".git").exists():
        return None
    git = ["git", "-C", str(folder)]
    how: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 5}
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], **how)
        dirty = subprocess.run([*git, "status", "--porcelain", "-uno"], **how)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return head.stdout.strip() + ("+" if dirty.stdout.strip() else "") or None
