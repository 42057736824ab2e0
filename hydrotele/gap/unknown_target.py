"""What an unknown effect has to explain: residuals of one law at one place, and signals beside."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.gap.balances import BAND
from hydrotele.gap.result import Prediction
from hydrotele.gap.unknown_laws import Found, Verdict, lacking_pressure
from hydrotele.gap.unknown_signals import Scene, drive_position
from hydrotele.machine import Machine
from hydrotele.signals import parse_channel

_SETTLE = 1.0  # s at both ends of a run that filters and the unknown start spoil
_BELOW_RELIEF = 0.97  # of the relief pressure: above it the supply pressure tells no flow
_APART = 3.0 * BAND  # Hz: samples of a balance this often are nearly independent
_LOUD = 4.0  # times the usual noise: an open port relief or make-up valve drowns all else
_OPEN_APART = 10.0  # Hz, the same of the supply's flow, which only smoothing ties together
_MEGA = 1e-6
_MOST = 2000  # samples of a run: more only take time
_ENOUGH = 40  # samples that a run needs to be judged


@dataclass(frozen=True)
class Part:
    """One run.

    Attributes:
        scene: its signals.
        rows: (k,) rows of the scene that are used.
        wanted: (k,) what has to be explained there.
        weight: (k,) 1, less where its noise is larger than usual.
    """

    scene: Scene
    rows: np.ndarray
    wanted: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Target:
    """What has to be explained.

    Attributes:
        law: `force`, `flow`, `supply`, `geometry` or `sensor`.
        unit: of what is wanted; `1` where it is in units of its spread.
        parts: the held-out run, then the fit runs; fit runs that say nothing are absent, and all
            are if the held-out run does.
        roles: role in a term -> name of the signal.
        banded: whether it was low-passed, as the terms must be then.
    """

    law: str
    unit: str
    parts: Sequence[Part]
    roles: Mapping[str, str]
    banded: bool


def roles(machine: Machine, place: str, side: str = "head") -> dict[str, str]:
    """Names of the signals by role, for an axis seen from one of its chambers.

    `t` time, `x` position of the drive, `q` of the joint, `v` rate, `a` acceleration, `u` command,
    `p` pressure of the chamber, `o` of the other one, `d` the change of p, `f` valve flow, `k` its
    change with the spool, `b` with the tank pressure, `z` dead band, `s` supply pressure, `r`
    return flow of all axes.
    """
    common = {"t": "time", "s": "pressure_supply", "r": "return"}
    if place not in machine.axes:
        return common
    other = "rod" if side == "head" else "head"
    return common | {
        "x": drive_position(machine, place), "q": f"{machine.position_kind(place)}.{place}",
        "v": f"rate.{place}", "a": f"acceleration.{place}", "u": f"command.{place}",
        "p": f"pressure_{side}.{place}", "o": f"pressure_{other}.{place}",
        "d": f"change_{side}.{place}", "f": f"valve_{side}.{place}",
        "k": f"opened_{side}.{place}", "b": f"drained_{side}.{place}", "z": f"overlap.{place}",
    }  # fmt: skip


def signal(scene: Scene, name: str) -> np.ndarray:
    """(n,) a signal as the terms take it: pressures in MPa."""
    kind = name.partition(".")[0]
    pressure = kind.startswith(("pressure", "change"))
    return scene.values[name] * (_MEGA if pressure else 1.0)


def law_target(
    machine: Machine, verdict: Verdict, scenes: Sequence[Scene], measured: Sequence[Found]
) -> Target:
    """Residuals of the balance that fails; a supply's as missing flow, a sensor's as its error."""
    side = verdict.side or ("rod" if verdict.balance == "flow_rod" else "head")
    parts, unit = [], ""
    for scene, found in zip(scenes, measured, strict=True):
        balance = found.get(verdict.balance, {}).get(verdict.place)
        if balance is None:
            parts.append(None)
            continue
        wanted, unit = balance.residual, balance.unit
        if verdict.law == "sensor":
            wanted, unit = lacking_pressure(machine, verdict.place, side, wanted), "Pa"
        if verdict.law == "supply":
            if "demand" not in scene.values or machine.supply is None:
                parts.append(None)
                continue
            wanted, unit = scene.values["demand"] - machine.supply.pump_flow, "m^3/s"
            open_pump = scene.values["pressure_supply"] < (
                _BELOW_RELIEF * machine.supply.relief_pressure
            )
            wanted = np.where(open_pump, wanted, np.nan)
        apart = {"geometry": np.inf, "supply": _OPEN_APART}.get(verdict.law, _APART)
        noise = None if verdict.law == "supply" else balance.noise
        stride = max(1, round(1.0 / (apart * scene.period)))
        parts.append(_part(scene, wanted, noise, stride))
    banded = verdict.balance not in ("closure", "supply")
    names = roles(machine, verdict.place, side)
    return Target(verdict.law, unit, _usable(parts), names, banded)


def channel_target(
    machine: Machine, channel: str, scenes: Sequence[Scene], after: Sequence[Prediction]
) -> Target:
    """Whitened prediction errors of a channel, where no balance tells the law."""
    parsed = parse_channel(channel)
    side = "rod" if parsed.kind == "pressure_rod" else "head"
    law = {"pressure_head": "flow", "pressure_rod": "flow", "pressure_supply": "supply"}.get(
        parsed.kind, "force"
    )
    parts = []
    for scene, run in zip(scenes, after, strict=True):
        wanted = run.whitened[:, run.channels.index(channel)]
        size = min(len(wanted), len(scene.values["time"]))
        padded = np.full(len(scene.values["time"]), np.nan)
        padded[:size] = wanted[:size]
        parts.append(_part(scene, padded, None, 1))
    names = roles(machine, parsed.axis or "supply", side)
    return Target(law, "1", _usable(parts), names, False)


def _usable(parts: Sequence[Part | None]) -> list[Part]:
    """Nothing without the held-out run, which comes first: no term could be held to it."""
    return [part for part in parts if part] if parts and parts[0] else []


def _part(scene: Scene, wanted: np.ndarray, noise: np.ndarray | None, stride: int) -> Part | None:
    edge = round(_SETTLE / scene.period)
    rows = np.arange(edge, len(wanted) - edge, max(stride, len(wanted) // _MOST))
    rows = rows[np.isfinite(wanted[rows])]
    weight = np.ones(len(rows))
    if noise is not None and len(rows) and (usual := np.nanmedian(noise[rows])) > 0.0:
        loud = np.nan_to_num(noise[rows] / usual, nan=np.inf)
        rows, weight = rows[loud < _LOUD], 1.0 / np.maximum(loud[loud < _LOUD], 1.0)
    if len(rows) < _ENOUGH:
        return None
    return Part(scene, rows, wanted[rows], weight)
