"""The machine with its calibrated arm: link positions, joint axes, sensor offsets."""

from collections.abc import Mapping, Sequence

import numpy as np

from hydrotele.calibrate.arm import ArmFit
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.loop import Loop, link_chain
from hydrotele.effects.effect import changed
from hydrotele.kinematics.serial_chain import forward, joint_axes
from hydrotele.machine.machine import Closure, Machine
from hydrotele.machine.sensors import SensorError


def machine_with_loop(machine: Machine, nominal: Loop, loop: Loop) -> Machine:
    """A machine whose links and joints are those of a chain.

    Joint zeros stay the machine's: a changed offset of a chain is a sensor's matter. Cylinder pins
    keep their places on their links.

    Args:
        machine: the machine.
        nominal: its own chain.
        loop: a chain with other numbers.

    Returns:
        The machine with the chain's lengths and twists, and the ball joint at its place.
    """
    rest = nominal.values[:, 0]
    points, ways = joint_axes(link_chain(loop.values), rest[None])
    old, old_ways = joint_axes(link_chain(nominal.values), rest[None])
    tip = forward(link_chain(loop.values), rest[None]).position[0]
    origin: dict[str, np.ndarray] = {"world": np.zeros(3)}
    before: dict[str, np.ndarray] = {"world": np.zeros(3)}
    places = {machine.link_of(joint): k for k, joint in enumerate(loop.joints)}
    changes: dict[str, object] = {}
    for name in _in_tree_order(machine):
        link = machine.links[name]
        before[name] = before[link.parent] + np.array(link.position)
        origin[name] = origin[link.parent] + np.array(link.position)
        if name not in places:
            continue
        k = places[name]
        way, aside = ways[0, k], before[name] - old[0, k] - nominal.base
        origin[name] = points[0, k] + loop.base + way * (old_ways[0, k] @ aside)
        assert link.joint
        position = tuple(map(float, origin[name] - origin[link.parent]))
        axis = tuple(map(float, way * loop.signs[k]))
        changes[f"links.{name}.position"] = position
        changes[f"links.{name}.joint.axis"] = axis
    last = machine.link_of(loop.joints[-1])
    for path, value in changes.items():
        machine = changed(machine, path, value)
    closures = {}
    for name, closure in machine.closures.items():
        ends = [closure.a, closure.b]
        for k, end in enumerate(ends):
            if end.link == last:
                at = tuple(map(float, tip + loop.base - origin[last]))
                ends[k] = end.model_copy(update={"position": at})
                other = ends[1 - k]
                ball = tuple(map(float, loop.base + loop.ball))
                ends[1 - k] = other.model_copy(update={"position": ball})
        closures[name] = Closure(a=ends[0], b=ends[1])
    machine = machine.model_copy(update={"closures": closures})
    return _with_tip(machine, before, origin)


def _in_tree_order(machine: Machine) -> list[str]:
    ordered, waiting = [], list(machine.links)
    while waiting:
        for name in list(waiting):
            if machine.links[name].parent in ("world", *ordered):
                ordered.append(name)
                waiting.remove(name)
    return ordered


def _with_tip(machine: Machine, before: Mapping, origin: Mapping) -> Machine:
    """Move the arm's tip with the link that hangs there."""
    if machine.arm is None:
        return machine
    tip = machine.arm.tip
    for name, link in machine.links.items():
        old = before[name] - before[link.parent]
        if link.parent == tip.link and np.allclose(old, tip.position, atol=1e-9):
            new = tuple(map(float, origin[name] - origin[link.parent]))
            return changed(machine, "arm.tip.position", new)
    return machine


def calibrated_machine(machine: Machine, fit: ArmFit, stages: Sequence[Poses]) -> Machine:
    """The machine with everything that a calibration found.

    Args:
        machine: the nominal machine.
        fit: of its arm.
        stages: the poses; where the manipulator has sensors, the angles at which links were held
            tell the sensors' offsets.

    Returns:
        The machine: lengths, twists, ball joint, and `sensor_errors` of the calibrator's sensors
        and of the manipulator's.
    """
    loop, nominal = fit.loop, fit.nominal
    made = machine_with_loop(machine, nominal, loop)
    errors = dict(made.sensor_errors)

    def put(channel: str, offset: float) -> None:
        known = errors.get(channel, SensorError())
        errors[channel] = known.model_copy(update={"offset": known.offset + offset})

    for k, (link, channel) in enumerate(zip(loop.links, loop.channels, strict=True)):
        if k >= loop.moved and f"offset.{link}" in fit.names:
            put(channel, float(loop.signs[k] * (nominal.values[k, 0] - loop.values[k, 0])))
        held = f"held.{link}"
        if k < loop.moved and held in fit.names:
            seen = [p for p in stages if p.link == loop.links[k - 1] and link in p.manipulator]
            if seen:
                shown = float(np.mean(seen[0].manipulator[link])) + nominal.values[k, 0]
                put(channel, float(loop.signs[k] * (shown - fit.value(held))))
    return made.model_copy(update={"sensor_errors": errors})
