"""Correction of a machine model by an arm calibration: link positions, joint axes and sensor offsets."""

from collections.abc import Mapping, Sequence

import numpy as np

from hydrotele.calibrate.arm_identification import ArmFit
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.calibration_loop import (
    CalibrationLoop,
    link_chain,
)
from hydrotele.effects.effect import with_value
from hydrotele.kinematics.serial_chain import chain_poses, joint_axes
from hydrotele.machine.machine import Closure, Machine
from hydrotele.machine.sensors import SensorError


def update_machine_geometry(machine: Machine, nominal: CalibrationLoop, loop: CalibrationLoop) -> Machine:
    """Return a machine whose link positions and joint axes are those of a calibrated chain.

    The joint zeros of the machine are kept, because a changed angle offset in the chain describes a
    sensor error. Cylinder pins keep their positions on their links.

    Args:
        machine: the machine.
        nominal: the chain of this machine.
        loop: the calibrated chain.

    Returns:
        The machine with the chain's lengths, twists and ball joint position.
    """
    rest = nominal.values[:, 0]
    points, ways = joint_axes(link_chain(loop.values), rest[None])
    old, old_ways = joint_axes(link_chain(nominal.values), rest[None])
    tip = chain_poses(link_chain(loop.values), rest[None]).position[0]
    origin: dict[str, np.ndarray] = {"world": np.zeros(3)}
    before: dict[str, np.ndarray] = {"world": np.zeros(3)}
    places = {machine.link_of(joint): k for k, joint in enumerate(loop.joints)}
    changes: dict[str, object] = {}
    for name in _sort_links_by_depth(machine):
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
        machine = with_value(machine, path, value)
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
    return _move_tip(machine, before, origin)


def _sort_links_by_depth(machine: Machine) -> list[str]:
    ordered, waiting = [], list(machine.links)
    while waiting:
        for name in list(waiting):
            if machine.links[name].parent in ("world", *ordered):
                ordered.append(name)
                waiting.remove(name)
    return ordered


def _move_tip(machine: Machine, before: Mapping, origin: Mapping) -> Machine:
    """Return the machine with the arm's tip moved to a link that was attached at the tip.

    If a link had its origin at the tip before the calibration, the tip gets the link's new origin.
    Otherwise the machine is unchanged. `before` and `origin` contain the origins of all links before
    and after the calibration [m].
    """
    if machine.arm is None:
        return machine
    tip = machine.arm.tip
    for name, link in machine.links.items():
        old = before[name] - before[link.parent]
        if link.parent == tip.link and np.allclose(old, tip.position, atol=1e-9):
            new = tuple(map(float, origin[name] - origin[link.parent]))
            return with_value(machine, "arm.tip.position", new)
    return machine


def calibrated_machine(machine: Machine, fit: ArmFit, stages: Sequence[Poses]) -> Machine:
    """Return the machine with all results of an arm calibration: geometry and sensor offsets.

    Args:
        machine: the nominal machine.
        fit: the calibrated arm.
        stages: the poses. If they contain readings of a held link's own sensor while the next link
            towards the chassis moves, the offset of this sensor is the mean reading minus the
            identified held angle.

    Returns:
        The machine with calibrated lengths, twists and ball joint, and with `sensor_errors` of
        calibrator and manipulator sensors.
    """
    loop, nominal = fit.loop, fit.nominal
    made = update_machine_geometry(machine, nominal, loop)
    errors = dict(made.sensor_errors)

    def add_offset(channel: str, offset: float) -> None:
        known = errors.get(channel, SensorError())
        errors[channel] = known.model_copy(update={"offset": known.offset + offset})

    for k, (link, channel) in enumerate(zip(loop.links, loop.channels, strict=True)):
        if k >= loop.powered_count and f"offset.{link}" in fit.names:
            add_offset(channel, float(loop.signs[k] * (nominal.values[k, 0] - loop.values[k, 0])))
        held = f"held.{link}"
        if k < loop.powered_count and held in fit.names:
            seen = [p for p in stages if p.link == loop.links[k - 1] and link in p.manipulator]
            if seen:
                shown = float(np.mean(seen[0].manipulator[link])) + nominal.values[k, 0]
                add_offset(channel, float(loop.signs[k] * (shown - fit.value(held))))
    return made.model_copy(update={"sensor_errors": errors})
