"""Motions that each bring out one kind of effect, inside the joint ranges and above the ground."""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from hydrotele.kinematics import five_dof
from hydrotele.kinematics.arm import forward
from hydrotele.kinematics.from_machine import arm_geometry, axis_linkage, feller_geometry
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
    ends = {name: _ends(machine, name) for name in machine.axes}
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


def _ends(machine: Machine, name: str) -> tuple[float, float]:
    """Ends of an axis' range less a margin; its home and its surroundings without a range."""
    bounds = machine.joints[machine.axes[name].joint].range
    if bounds is None:
        rest = machine.home.get(machine.axes[name].joint, 0.0)
        return rest - _UNBOUNDED, rest + _UNBOUNDED
    margin = _MARGIN * (bounds[1] - bounds[0])
    return bounds[0] + margin, bounds[1] - margin


def _free(
    machine: Machine, pose: Mapping[str, float], name: str, ends: tuple[float, float]
) -> tuple[float, float]:
    """The part of an axis' range around its place in a pose in which the tip is above ground."""
    low, high = (_clear(machine, pose, {name: end})[name] for end in ends)
    return low, high


def _speed(machine: Machine, name: str, at: float, width: float) -> float:
    """Speed of a joint [rad/s] or [m/s] that half the flow of its valve or of the pump gives."""
    axis = machine.axes[name]
    if axis.pump:
        return _SHARE * axis.pump.rated_flow / axis.hydraulic_drive.areas[0]
    if axis.valve is None or machine.supply is None:
        return width / _FORCE_PASS
    drop = 0.5 * (machine.supply.relief_pressure - machine.supply.tank_pressure)
    flow = axis.valve.rated_flow * math.sqrt(drop / axis.valve.rated_pressure_drop)
    arm = max(abs(float(axis_linkage(machine, name).rate(at))), 1e-3)
    return _SHARE * min(flow, machine.supply.pump_flow) / (axis.hydraulic_drive.areas[0] * arm)


def _clear(
    machine: Machine, home: Mapping[str, float], target: Mapping[str, float]
) -> dict[str, float]:
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
        return min(elbow, five_dof.forward(feller, q).z)
    geometry = arm_geometry(machine)
    elbow = geometry.boom_pin_height + geometry.boom_length * math.sin(of_joint[arm.boom])
    return min(elbow, forward(geometry, q)[2])


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
