"""The next experiment: a motion that separates effects which the data cannot tell apart."""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydrotele.core.resources import models_folder
from hydrotele.gap import experiment_motions as motions
from hydrotele.gap.experiment_motions import Leg, Stage
from hydrotele.kinematics.from_machine import axis_linkage
from hydrotele.machine.machine import Machine


class Motion(NamedTuple):
    """A way of moving, and what it brings out.

    Attributes:
        legs: (stage, axes) -> where to go, leg by leg.
        every: whether all axes have to move, wherever the effect sits.
        why: what it separates, one sentence.
    """

    legs: Callable[[Stage, Sequence[str]], Iterator[Leg]]
    every: bool
    why: str


MOTIONS: Mapping[str, Motion] = {
    "sweeps": Motion(
        motions.sweeps, False,
        "Sweep the whole stroke, ends included: an offset stays the same over it, a scale grows"
        " with it, and a wrong pin or link bends the curve of length over angle.",
    ),
    "steps": Motion(
        motions.steps, False,
        "Sharp steps of several sizes from rest: a delay shifts the whole response, a slow spool"
        " rounds its start, a dead band swallows the small ones, a gain scales all alike.",
    ),
    "shakes": Motion(
        motions.shakes, False,
        "Small reversals from slow to fast: a gap costs the same at every speed, a spring more the"
        " faster it goes, and friction acts at the slow ones too.",
    ),
    "reversals": Motion(
        motions.reversals, False,
        "Back and forth at constant speeds from creeping to fast: Coulomb friction is equal at"
        " all, viscous grows with speed, Stribeck shows while creeping, an asymmetry in the"
        " difference of the directions.",
    ),
    "poses": Motion(
        motions.poses, True,
        "Rests in folded and stretched poses with fast ways between: weight and its place show at"
        " rest, inertia while speeding up, a pressure offset in neither alone.",
    ),
    "slews": Motion(
        motions.slews, True,
        "The stretched arm at rest at headings all around: a tilt of the base changes sign with"
        " the heading, no friction or offset does.",
    ),
    "stairs": Motion(
        motions.stairs, False,
        "Steps with full and with empty chambers: soft oil gives with the volume, a soft hose gives"
        " the same at every stroke.",
    ),
    "holds": Motion(
        motions.holds, False,
        "Long rests under load with the valves closed: a leak keeps creeping.",
    ),
    "surges": Motion(
        motions.surges, True,
        "All axes at once and then none: the pump's flow limits the motion, the relief valve the"
        " pressure at rest.",
    ),
}  # fmt: skip
"""Ways of moving by name, in the order in which they are done."""

OF_EFFECT: Mapping[str, tuple[str, ...]] = {
    "payload": ("poses",),
    "com_offset": ("poses",),
    "inertia_error": ("poses",),
    "base_tilt": ("slews",),
    "coulomb_friction": ("reversals",),
    "viscous_friction": ("reversals",),
    "stribeck_friction": ("reversals",),
    "friction_asymmetry": ("reversals",),
    "backlash": ("shakes",),
    "joint_flexibility": ("shakes",),
    "link_length": ("sweeps", "poses"),
    "pin_offset": ("sweeps",),
    "angle_offset": ("sweeps",),
    "angle_scale": ("sweeps",),
    "length_offset": ("sweeps",),
    "angle_delay": ("steps",),
    "pressure_delay": ("steps",),
    "angle_lag": ("steps",),
    "pressure_lag": ("steps",),
    "clock_offset": ("steps",),
    "command_delay": ("steps",),
    "spool_lag": ("steps",),
    "valve_deadband": ("steps", "reversals"),
    "valve_gain": ("steps",),
    "internal_leakage": ("holds",),
    "hose_compliance": ("stairs",),
    "bulk_modulus": ("stairs",),
    "pump_flow_limit": ("surges",),
    "relief_pressure": ("surges",),
    "pressure_offset": ("poses", "reversals"),
    "pressure_scale": ("poses", "reversals"),
    "external_force": ("poses", "reversals"),
    "load_dependent_friction": ("poses", "reversals"),
    "force_pulse": ("reversals",),
    "speed_dependent_force": ("reversals",),
    "warming": ("reversals",),
    "position_dependent_friction": ("sweeps", "reversals"),
    "end_stop_stiffness": ("sweeps",),
    "orifice_leakage": ("holds",),
    "load_holding": ("holds",),
    "command_offset": ("steps",),
    "valve_gain_direction": ("steps",),
    "valve_deadband_direction": ("steps",),
    "flow_curve": ("steps",),
    "metering_edges": ("steps",),
    "spool_slew": ("steps",),
    "load_compensation": ("steps",),
    "pump_droop": ("surges",),
    "pump_lag": ("surges",),
    "presliding": ("reversals", "steps"),
    "pump_displacement": ("steps",),
    "pump_leakage": ("holds", "steps"),
    "pump_torque_loss": ("steps",),
    "motor_constant": ("steps",),
    "motor_inertia": ("steps",),
    "motor_drag": ("steps",),
    "motor_viscous_drag": ("steps",),
    "line_compliance": ("stairs",),
    "accumulator_pressure": ("poses",),
    "load_relief": ("reversals",),
    "load_friction": ("reversals",),
}
"""Effect -> the motions that bring it out."""

OF_LAW: Mapping[str, tuple[str, ...]] = {
    "force": ("reversals", "poses"),
    "flow": ("stairs", "holds"),
    "valve": ("steps", "reversals"),
    "supply": ("surges",),
    "geometry": ("sweeps",),
    "timing": ("steps",),
    "sensor": ("sweeps", "steps"),
}
"""Law that fails without a known effect -> the motions that show how."""

GENERIC = ("sweeps", "steps", "reversals")
"""Motions where nothing is known."""

_RATE = 50.0  # [Hz] of sensors that state none
_STILL = ("holds",)  # motions in which the valves have to stay closed at rest


def next_experiment(
    machine: Machine, reason: str, effects: Sequence[tuple[str, str]]
) -> dict[str, Any]:
    """Propose a motion that separates effects, or shows an unknown one better.

    Args:
        machine: the model.
        reason: what is open, one sentence; what the motion does is added to it.
        effects: (name, location) of the effects that cannot be told apart; a law in place of the
            name, such as `("flow", "boom")`, where the effect is unknown.

    Returns:
        `reason`, and `scenario` as `load_scenario` reads it: joint references above the ground and
        inside the joint ranges, commands held from row to row.
    """
    s, plan = motions.stage(machine), _plan(machine, effects)
    legs: list[Leg] = []
    why = []
    for name, axes in plan.items():
        legs += [*MOTIONS[name].legs(s, axes), s.leg(dict(s.home), _ends(s), 1.0), Leg(1.0, {})]
        why.append(MOTIONS[name].why)
    time, columns = _table(s, [Leg(1.0, {}), *legs])
    sensors = next(iter(machine.sensors), "ideal")
    rate = machine.sensors[sensors].rate if machine.sensors else _RATE
    moved = {axis: values for axis, values in columns.items() if len(set(values)) > 1}
    scenario = {
        "name": _name(effects),
        "description": " ".join(why),
        "machine": _reference(machine),
        **({"tool": machine.tool} if len(machine.tools) > 1 else {}),
        "duration": round(time[-1] + 1.0, 2),
        "control_rate": rate,
        "log_rate": rate,
        "sensors": sensors,
        "ground": False,
        "start": {"joints": {machine.axes[a].joint: round(q, 4) for a, q in s.home.items()}},
        "pilot": {
            "kind": "table", "of": "joint", "interpolate": "linear", "time": time,
            "columns": moved,
        },
        "servo": _servo(machine, any(name in _STILL for name in plan)),
    }  # fmt: skip
    return {
        "reason": " ".join([reason, *why]).strip(),
        "scenario": json.loads(json.dumps(scenario)),
    }


def _plan(machine: Machine, effects: Sequence[tuple[str, str]]) -> dict[str, tuple[str, ...]]:
    """Motion -> the axes that make it, in the order of `MOTIONS`."""
    wanted: dict[str, list[str]] = {}
    for name, location in effects:
        for motion in OF_EFFECT.get(name, OF_LAW.get(name, GENERIC)):
            wanted.setdefault(motion, []).extend(_axes(machine, location))
    for motion in () if wanted else GENERIC:
        wanted[motion] = list(machine.axes)
    return {
        name: tuple(a for a in machine.axes if motion.every or a in wanted[name])
        for name, motion in MOTIONS.items()
        if name in wanted
    }


def _axes(machine: Machine, location: str) -> tuple[str, ...]:
    """Axes that an effect at this place shows on; all for `all`, `tool`, `base` and the like."""
    place = location.partition(".")[0]
    if place in machine.axes:
        return (place,)
    of_link = (a for a, axis in machine.axes.items() if machine.link_of(axis.joint) == place)
    return tuple(of_link) or tuple(machine.axes)


def _ends(s: Stage) -> dict[str, float]:
    """The end of each axis that is farther from home, where the way home is longest."""
    return {a: max((s.low[a], s.high[a]), key=lambda q: abs(q - s.home[a])) for a in s.home}


def _table(s: Stage, legs: Sequence[Leg]) -> tuple[list[float], dict[str, list[float]]]:
    """Break points of the references: time [s], and position by axis [rad] or [m]."""
    time, here = [0.0], {axis: round(q, 4) for axis, q in s.home.items()}
    columns = {axis: [q] for axis, q in here.items()}
    for leg in legs:
        here |= {axis: round(float(q), 4) for axis, q in leg.target.items()}
        time.append(round(time[-1] + max(leg.duration, 0.01), 3))
        for axis, q in here.items():
            columns[axis].append(q)
    return time, columns


def _servo(machine: Machine, still: bool) -> dict[str, float]:
    """Gains for the machine's drives; without dead-band compensation valves stay shut at rest."""
    forces = [name for name, axis in machine.axes.items() if axis.force]
    if not forces:
        return {"lead": 0.06, **({"deadband_compensation": 0.0} if still else {})}
    loads = [_inertia(machine, name) for name in forces]
    return {"position_gain": 20.0, "velocity_gain": round(40.0 * min(loads), 3), "lead": 0.0}


def _inertia(machine: Machine, axis: str) -> float:
    """What a drive moves, roughly [kg] or [kg m^2]: its own link."""
    joint = machine.axes[axis].joint
    link = machine.links[machine.link_of(joint)]
    if machine.joints[joint].type == "slide":
        return link.mass * abs(float(axis_linkage(machine, axis).rate(0.0)))
    return max(link.inertia) + link.mass * sum(x * x for x in link.com)


def _reference(machine: Machine) -> str:
    """Name of a shipped machine, else the folder of a user's."""
    own = Path(machine.folder).resolve()
    shipped = (models_folder() / machine.name).is_dir() and models_folder().resolve() in (
        own, *own.parents)  # fmt: skip
    return machine.name if shipped or not machine.folder else str(own)


def _name(effects: Sequence[tuple[str, str]]) -> str:
    names = "_or_".join(dict.fromkeys(name for name, _ in effects)) or "overview"
    return re.sub(r"[^a-z0-9_]+", "_", f"separate_{names}".lower())[:80]
