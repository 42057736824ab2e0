"""The next experiment: a motion that separates effects which the data cannot tell apart.

Motions that each bring out one kind of effect, inside the joint ranges and above the ground.
"""

import dataclasses
import itertools
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from hydrotele.core.files import models_folder, resolve_path
from hydrotele.kinematics import feller_arm
from hydrotele.kinematics.arm import forward_kinematics
from hydrotele.kinematics.arm_dimensions import arm_geometry, feller_geometry
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.machine.machine import Machine

_MARGIN = 0.06  # of a joint's range that is left at each end, for overshoot
_UNBOUNDED = 1.5  # [rad] or [m] to either side of home, of a joint without a range
_GROUND = 0.4  # [m] that tip and stick pin stay above the ground
_WAY = 40  # points on a way at which its height is looked at
_SHARE = 0.5  # of what valve and pump give one axis at most: others move too, and servos overshoot
_FORCE_PASS = 1.2  # [s] in which a force drive crosses its range
_EDGE = 0.02  # [s] of a step
_STEP = 0.4  # [s] at full speed that the largest step amounts to


class Leg(NamedTuple):
    """Axes go to their targets [rad] or [m] in `duration` [s]; the others stay."""

    duration: float
    target: Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Stage:
    """What the axes of a machine can do.

    Attributes:
        machine: the machine.
        home: axis -> where it rests [rad] or [m].
        low: axis -> least position, with all others at home.
        high: axis -> greatest position, likewise.
        speed: axis -> a fast but possible speed [rad/s] or [m/s].
        wide: axis -> (least, greatest position, where the others have to be for it).
    """

    machine: Machine
    home: Mapping[str, float]
    low: Mapping[str, float]
    high: Mapping[str, float]
    speed: Mapping[str, float]
    wide: Mapping[str, tuple[float, float, Mapping[str, float]]]

    def part(self, axis: str, share: float) -> float:
        """Position at a share of an axis' free range."""
        return self.low[axis] + share * (self.high[axis] - self.low[axis])

    def leg(self, target: Mapping[str, float], here: Mapping[str, float], share: float) -> Leg:
        """The way there at a share of the fast speed, the slowest axis setting the time."""
        times = [abs(target[a] - here.get(a, self.home[a])) / self.speed[a] for a in target]
        return Leg(max(*times, 0.1) / share, target)


def stage(machine: Machine) -> Stage:
    """Free ranges and speeds of a machine's axes."""
    ends = {name: _travel(machine, name) for name in machine.axes}
    home = {
        name: min(max(machine.home.get(axis.joint, 0.0), ends[name][0]), ends[name][1])
        for name, axis in machine.axes.items()
    }
    low, high, speed, wide = {}, {}, {}, {}
    for name in machine.axes:
        low[name], high[name] = _free(machine, home, name, ends[name])
        width = max(high[name] - low[name], 1e-6)
        speed[name] = _speed(machine, name, home[name], width)
        others = [other for other in machine.axes if other != name]
        places = itertools.product(*((home[o], *ends[o]) for o in others))
        tried = []
        for place in places:
            aside = dict(zip(others, place, strict=True))
            free = _free(machine, {**home, **aside}, name, ends[name])
            moved = sum(aside[o] != home[o] for o in others)
            tried.append((round(free[0] - free[1], 6), moved, len(tried), *free, aside))
        *_, first, last, aside = min(tried)
        wide[name] = (first, last, {o: q for o, q in aside.items() if q != home[o]})
    return Stage(machine, home, low, high, speed, wide)


def _travel(machine: Machine, name: str) -> tuple[float, float]:
    """Ends of an axis' range less a margin; its home and its surroundings without a range."""
    bounds = machine.joints[machine.axes[name].joint].range
    if bounds is None:
        rest = machine.home.get(machine.axes[name].joint, 0.0)
        return rest - _UNBOUNDED, rest + _UNBOUNDED
    margin = _MARGIN * (bounds[1] - bounds[0])
    return bounds[0] + margin, bounds[1] - margin


def _free(machine: Machine, pose: Mapping[str, float], name: str, ends: tuple[float, float]) -> tuple[float, float]:
    """The part of an axis' range around its place in a pose in which the tip is above ground."""
    low, high = (_clear(machine, pose, {name: end})[name] for end in ends)
    return low, high


def _speed(machine: Machine, name: str, at: float, width: float) -> float:
    """Speed of a joint [rad/s] or [m/s] that half the flow of its valve or of the pump gives."""
    axis = machine.axes[name]
    if axis.pump:
        return _SHARE * axis.pump.rated_flow / axis.hydraulic_drive.effective_areas[0]
    if axis.valve is None or machine.supply is None:
        return width / _FORCE_PASS
    drop = 0.5 * (machine.supply.relief_pressure - machine.supply.tank_pressure)
    flow = axis.valve.rated_flow * math.sqrt(drop / axis.valve.rated_pressure_drop)
    arm = max(abs(float(axis_linkage(machine, name).rate(at))), 1e-3)
    flow = min(flow, machine.pumps[machine.pump_of(name)].pump_flow)
    return _SHARE * flow / (axis.hydraulic_drive.effective_areas[0] * arm)


def _clear(machine: Machine, home: Mapping[str, float], target: Mapping[str, float]) -> dict[str, float]:
    """The straight way from home to the target, as far as the arm stays above the ground."""
    clear = {axis: home[axis] for axis in target}
    for step in range(1, _WAY + 1):
        pose = {a: home[a] + step / _WAY * (q - home[a]) for a, q in target.items()}
        if _height(machine, {**home, **pose}) < _GROUND:
            break
        clear = pose
    return clear


def _height(machine: Machine, pose: Mapping[str, float]) -> float:
    """Height of the lower of tip and stick pin above the ground [m], without an arm infinite."""
    arm = machine.arm
    if arm is None:
        return math.inf
    of_joint = {axis.joint: pose[name] for name, axis in machine.axes.items()}
    joints = [j for j in (arm.swing, arm.boom, arm.stick, arm.tool, arm.head) if j is not None]
    if not all(joint in of_joint for joint in joints):
        return math.inf
    q = [of_joint[joint] for joint in joints]
    if arm.head:
        feller = feller_geometry(machine)
        elbow = feller.base_height + feller.boom_length * math.sin(of_joint[arm.boom])
        return min(elbow, feller_arm.forward_kinematics(feller, q).z)
    geometry = arm_geometry(machine)
    elbow = geometry.boom_pin_height + geometry.boom_length * math.sin(of_joint[arm.boom])
    return min(elbow, forward_kinematics(geometry, q)[2])


def steps(s: Stage, axes: Sequence[str]) -> Iterator[Leg]:
    """Sharp steps of several sizes from rest, one axis after the other."""
    for axis in axes:
        size = min(_STEP * s.speed[axis], 0.2 * (s.high[axis] - s.low[axis]))
        middle = min(max(s.home[axis], s.low[axis] + size), s.high[axis] - size)
        yield s.leg({axis: middle}, {}, 0.5)
        for share in (1.0, 0.0, -1.0, 0.0, 0.4, -0.4, 0.0, 0.15, -0.15, 0.0, 0.7, -0.7):
            yield Leg(_EDGE, {axis: middle + share * size})
            yield Leg(0.8, {})
        yield Leg(_EDGE, {axis: s.home[axis]})


def shakes(s: Stage, axes: Sequence[str]) -> Iterator[Leg]:
    """Small fast reversals about home, from slow to as fast as the drive can."""
    for axis in axes:
        for period in (1.6, 0.8, 0.4):
            size = min(0.25 * period * s.speed[axis], 0.1 * (s.high[axis] - s.low[axis]))
            middle = min(max(s.home[axis], s.low[axis] + size), s.high[axis] - size)
            for _ in range(4):
                yield Leg(0.5 * period, {axis: middle + size})
                yield Leg(0.5 * period, {axis: middle - size})
            yield Leg(0.5, {})


def reversals(s: Stage, axes: Sequence[str]) -> Iterator[Leg]:
    """Back and forth at four speeds, each constant, from creeping to fast."""
    for share in (0.04, 0.12, 0.4, 1.0):
        there, back = {}, {}
        for axis in axes:
            half = 0.5 * min(3.0 * share * s.speed[axis], 0.5 * (s.high[axis] - s.low[axis]))
            middle = min(max(s.home[axis], s.low[axis] + half), s.high[axis] - half)
            there[axis], back[axis] = middle + half, middle - half
        yield s.leg(back, {}, 0.7)
        for target, here in ((there, back), (back, there)) * 2:
            yield s.leg(target, here, share)


def poses(s: Stage, axes: Sequence[str]) -> Iterator[Leg]:
    """Fast ways between folded and stretched poses, and a rest in each."""
    here = dict(s.home)
    for k in range(5):
        share = {a: 0.8 if (k + i) // 2 % 2 else 0.2 for i, a in enumerate(axes)}
        target = _clear(s.machine, s.home, {a: s.part(a, v) for a, v in share.items()})
        yield s.leg(target, here, 1.0)
        yield Leg(2.5, {})
        here |= target


def slews(s: Stage, axes: Sequence[str]) -> Iterator[Leg]:
    """The first axis turned to headings all around, with rests; the others as stretched as free."""
    first, *others = axes
    stretched = _clear(s.machine, s.home, {a: s.high[a] for a in others})
    yield s.leg(stretched or {first: s.home[first]}, {}, 0.7)
    here = {first: s.home[first]}
    for share in (0.0, 0.5, 1.0, 0.5, 0.0):
        target = {first: s.part(first, share)}
        yield s.leg(target, here, 0.7)
        yield Leg(2.0, {})
        here = target


def sweeps(s: Stage, axes: Sequence[str]) -> Iterator[Leg]:
    """Each axis through its whole free range, almost to both ends, the others out of its way."""
    for axis in axes:
        low, high, aside = s.wide[axis]
        here = {axis: s.home[axis]}
        yield from _step_aside(s, aside)
        for target in (low, high, s.home[axis]):
            yield s.leg({axis: target}, here, 0.6)
            yield Leg(0.8, {})
            here = {axis: target}
        yield from _return(s, aside)


def stairs(s: Stage, axes: Sequence[str]) -> Iterator[Leg]:
    """Steps all the way from one end of the stroke to the other: full and empty chambers."""
    for axis in axes:
        low, high, aside = s.wide[axis]
        size = min(0.6 * _STEP * s.speed[axis], 0.1 * (high - low))
        here = s.home[axis]
        yield from _step_aside(s, aside)
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            middle = low + size + share * (high - low - 2 * size)
            yield s.leg({axis: middle}, {axis: here}, 0.6)
            yield Leg(0.5, {})
            for sign in (1.0, -1.0, 0.0):
                yield Leg(_EDGE, {axis: middle + sign * size})
                yield Leg(0.7, {})
            here = middle
        yield s.leg({axis: s.home[axis]}, {axis: here}, 0.6)
        yield from _return(s, aside)


def _step_aside(s: Stage, aside: Mapping[str, float]) -> Iterator[Leg]:
    if aside:
        yield s.leg(aside, {}, 0.6)


def _return(s: Stage, aside: Mapping[str, float]) -> Iterator[Leg]:
    if aside:
        yield s.leg({axis: s.home[axis] for axis in aside}, aside, 0.6)


def holds(s: Stage, axes: Sequence[str]) -> Iterator[Leg]:
    """Long rests under load, in two poses."""
    here = dict(s.home)
    for share in (0.7, 0.3):
        target = _clear(s.machine, s.home, {a: s.part(a, share) for a in axes})
        yield s.leg(target, here, 0.6)
        yield Leg(12.0, {})
        here |= target


def surges(s: Stage, axes: Sequence[str]) -> Iterator[Leg]:
    """All axes at once, faster than the pump allows, and rests in which the relief valve opens."""
    here = dict(s.home)
    for share in (0.8, 0.2, 0.8, 0.2):
        target = _clear(s.machine, s.home, {a: s.part(a, share) for a in axes})
        yield s.leg(target, here, 2.0)
        yield Leg(2.5, {})
        here |= target


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
        sweeps, False,
        "Sweep the whole stroke including its ends: an offset is constant over the stroke, a scale"
        " error grows with it, and a wrong pin or link changes the curve of length over angle.",
    ),
    "steps": Motion(
        steps, False,
        "Command steps of several sizes from rest: a delay shifts the whole response, a slow spool"
        " smooths its start, a dead band suppresses small steps, a gain scales all steps equally.",
    ),
    "shakes": Motion(
        shakes, False,
        "Small reversals from slow to fast: the lost motion of a backlash does not depend on speed,"
        " that of a spring grows with speed, and friction also acts at low speed.",
    ),
    "reversals": Motion(
        reversals, False,
        "Back and forth at constant speeds from very slow to fast: Coulomb friction is independent"
        " of speed, viscous friction grows with speed, Stribeck friction acts at very low speed, an"
        " asymmetry appears as a difference between the directions.",
    ),
    "poses": Motion(
        poses, True,
        "Rests in folded and stretched poses with fast motions in between: mass and centre of mass"
        " act at rest, inertia during acceleration, a pressure offset equally in both.",
    ),
    "slews": Motion(
        slews, True,
        "Rests of the stretched arm at headings over a full turn: the effect of a base tilt changes"
        " sign with the heading, unlike friction or an offset.",
    ),
    "stairs": Motion(
        stairs, False,
        "Steps with full and with empty chambers: the compliance of oil is proportional to the"
        " chamber volume, that of a hose does not depend on the stroke.",
    ),
    "holds": Motion(
        holds, False,
        "Long rests under load with closed valves: a leak causes a continuous slow motion.",
    ),
    "surges": Motion(
        surges, True,
        "All axes at once, then rest: the pump flow limits the motion, the relief valve limits the"
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
    "angle_drift": ("sweeps",),
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
    "tank_leakage": ("holds",),
    "hose_compliance": ("stairs",),
    "bulk_modulus": ("stairs",),
    "entrained_air": ("stairs",),
    "pump_flow_limit": ("surges",),
    "merging_valve": ("surges",),
    "relief_pressure": ("surges",),
    "pressure_offset": ("poses", "reversals"),
    "pressure_scale": ("poses", "reversals"),
    "external_force": ("poses", "reversals"),
    "load_dependent_friction": ("poses", "reversals"),
    "force_pulse": ("reversals",),
    "speed_dependent_force": ("reversals",),
    "warming": ("reversals",),
    "oil_viscosity": ("reversals", "holds"),
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
    "joint_bending": ("sweeps", "poses"),
    "sensor_misalignment": ("sweeps",),
    "sensor_backlash": ("sweeps", "reversals"),
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


def next_experiment(machine: Machine, reason: str, effects: Sequence[tuple[str, str]]) -> dict[str, Any]:
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
    s, plan = stage(machine), _plan(machine, effects)
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
            "kind": "table", "quantity": "joint", "interpolate": "linear", "time": time,
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
    own = resolve_path(machine.folder)
    shipped = (models_folder() / machine.name).is_dir() and resolve_path(models_folder()) in (
        own, *own.parents)  # fmt: skip
    return machine.name if shipped or not machine.folder else str(own)


def _name(effects: Sequence[tuple[str, str]]) -> str:
    names = "_or_".join(dict.fromkeys(name for name, _ in effects)) or "overview"
    return re.sub(r"[^a-z0-9_]+", "_", f"separate_{names}".lower())[:80]
