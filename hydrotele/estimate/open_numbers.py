"""What an estimated machine leaves open of its drives, as hypotheses for a fit to free runs.

A machine file that was written from a brochure knows neither what its valves let through at which
command, nor how late they do, nor its cylinder pins to the centimetre. Each is a few numbers with a
wide prior; every one is the logarithm of a ratio to the machine as it is, so that none changes its
sign, and 0 is nominal.
"""

import math
from collections.abc import Mapping

import numpy as np

from hydrotele.effects import Parameter, changed
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.kinematics.from_machine import range_at_drive
from hydrotele.machine.drives import FlowCurve, Metering
from hydrotele.machine.machine import Machine

TRAVEL = (0.0, 0.15, 0.3, 0.5, 0.75, 1.0)
"""Knots of a flow table in travel beyond the dead band [1], closest where valves begin to open."""

UNCERTAINTY = {
    "flow_table": 1.0, "delay": 0.05, "spool_lag": 1.4, "valve_damping": 0.4, "linkage": 0.15,
    "relief_pressure": 0.4, "pump_flow_limit": 0.4,
}  # fmt: skip
"""Prior standard deviations: of logarithms [1], of the delay [s]."""

LOG = "log"
"""Unit of a parameter that is the logarithm of a ratio to the machine as it is."""

DIRECTIONS = ("positive", "negative")
_LOWEST, _HIGHEST = -5.0, 2.5  # logarithms of a table's steps: from closed to 12 times as steep
_SHAPE, _DEADBAND = 0.5, 0.15  # standard deviations of steps and dead bands, per one of the gain
_WIDEST = 0.6  # dead band [1]
_EVEN = 1.0e-3  # least step of a table, in openings: a flat one could not be scaled up
_LONGEST_DELAY = 0.5  # s
_CLEARANCE = 0.02  # m, by which a closed cylinder is longer than its stroke


def states_open_numbers(machine: Machine) -> bool:
    """Whether a machine file says how uncertain its flow tables or linkages are.

    Args:
        machine: the machine.

    Returns:
        True with a key `flow_table` or `linkage`, for all axes or one, in its `uncertainty`.
    """
    return any(key.partition(".")[0] in ("flow_table", "linkage") for key in machine.uncertainty)


def open_numbers(machine: Machine) -> Guess:
    """All that an estimate leaves open of the machine's drives, at nominal.

    Args:
        machine: the nominal machine.

    Returns:
        Flow tables, timing and linkages of all axes, and the supply; only those that it has.
    """
    found = []
    for axis, facts in machine.axes.items():
        found.append(timing(machine, axis))
        if facts.valve:
            found.append(flow_table(machine, axis))
        if range_at_drive(machine, axis) and facts.cylinder and not facts.four_bar:
            found.append(linkage(machine, axis))
    if machine.supply and machine.hydraulic_axes:
        found.append(supply_limits(machine))
    return Guess(tuple((hypothesis, np.zeros(hypothesis.size)) for hypothesis in found))


def flow_table(machine: Machine, axis: str) -> Hypothesis:
    """Flow over command of both directions: a dead band, a gain and a monotone table each.

    The opening at knot k is the gain times the sum of the steps up to it; the parameters are the
    logarithms of the ratios to the present ones, so that no table ever falls. Gain and dead band
    are in the steps, too; as numbers of their own they say that a table is moved and stretched as a
    whole rather than bent, which a minute of data needs to be told.

    Args:
        machine: the nominal machine.
        axis: one with a valve.

    Returns:
        The hypothesis, of 14 parameters.
    """
    scale = _share(machine, "flow_table", axis)
    valve = machine.axes[axis].valve
    assert valve
    shape, band = _SHAPE * scale, _DEADBAND * scale
    parameters = {}
    for way, present in zip(DIRECTIONS, valve.deadbands, strict=True):
        most = max(_WIDEST, present)
        parameters[f"deadband_{way}"] = Parameter("1", present, 0.0, most, band, 0.1 * band)
        parameters[f"gain_{way}"] = Parameter(LOG, 0.0, _LOWEST, _HIGHEST, scale, 0.1 * scale)
        step = Parameter(LOG, 0.0, _LOWEST, _HIGHEST, shape, 0.1 * shape)
        parameters |= {f"{way}_{k}": step for k in range(1, len(TRAVEL))}

    def change(nominal: Machine, values: Mapping[str, float]) -> Machine:
        valve = nominal.axes[axis].valve
        assert valve
        for way, present in zip(DIRECTIONS, valve.deadbands, strict=True):
            path = f"axes.{axis}.valve.{way}"
            steps = [values[f"{way}_{k}"] for k in range(1, len(TRAVEL))]
            logs = values[f"gain_{way}"] + np.array(steps)
            if np.any(logs):
                nominal = changed(nominal, f"{path}.curve", stretched(getattr(valve, way), logs))
            if values[f"deadband_{way}"] != present:
                nominal = changed(nominal, f"{path}.deadband", values[f"deadband_{way}"])
        return nominal

    return Hypothesis("flow_table", axis, parameters, change)


def stretched(present: Metering, logs: np.ndarray) -> FlowCurve:
    """A direction's flow curve with its steps between the knots of `TRAVEL` made larger or smaller.

    Args:
        present: the direction; straight without a curve.
        logs: (5,) logarithms of the steps' ratios [1].

    Returns:
        The curve.

    Source: a sum of positive steps never falls.

    >>> curve = stretched(Metering(), np.array([-5.0, -5.0, 0.0, 0.0, 0.0]))
    >>> [round(opening, 3) for opening in curve.opening]
    [0.0, 0.001, 0.002, 0.202, 0.452, 0.702]
    """
    opening = np.concatenate([[0.0], np.cumsum(table_steps(present) * np.exp(logs))])
    return FlowCurve(travel=TRAVEL, opening=tuple(float(o) for o in opening))


def table_steps(present: Metering) -> np.ndarray:
    """Steps of a direction's opening between the knots of `TRAVEL`.

    Args:
        present: the direction; straight without a curve.

    Returns:
        (5,) steps, none of them less than a thousandth [1].
    """
    old = present.curve or FlowCurve(travel=(0.0, 1.0), opening=(0.0, 1.0))
    return np.maximum(np.diff(np.interp(TRAVEL, old.travel, old.opening)), _EVEN)


def timing(machine: Machine, axis: str) -> Hypothesis:
    """Delay of an axis' command; bandwidth and damping of its spool, if it has one.

    Args:
        machine: the nominal machine.
        axis: any.

    Returns:
        The hypothesis, of one or three parameters.
    """
    facts = machine.axes[axis]
    scale, delay = _share(machine, "delay", axis), facts.command_delay
    high = max(_LONGEST_DELAY, 2.0 * delay)
    parameters = {"delay": Parameter("s", delay, 0.0, high, scale, 0.05 * scale)}
    if facts.valve:
        parameters["bandwidth"] = _log(_share(machine, "spool_lag", axis), math.log(20.0))
        parameters["damping"] = _log(_share(machine, "valve_damping", axis), math.log(4.0))

    def change(nominal: Machine, values: Mapping[str, float]) -> Machine:
        nominal = changed(nominal, f"axes.{axis}.command_delay", values["delay"])
        valve = nominal.axes[axis].valve
        for field in ("bandwidth", "damping") if valve else ():
            value = getattr(valve, field) * math.exp(values[field])
            nominal = changed(nominal, f"axes.{axis}.valve.{field}", value)
        return nominal

    return Hypothesis("timing", axis, parameters, change)


def linkage(machine: Machine, axis: str) -> Hypothesis:
    """Where the pins of a cylinder sit, seen from the joint that it moves.

    `base` and `rod` are logarithms of the pins' distances from the joint, `angle` turns the rod pin
    about it [rad]. Closed length and stroke go along, so that the joint keeps its range between the
    same ends.

    Args:
        machine: the nominal machine.
        axis: one with a cylinder between the two links that its joint connects.

    Returns:
        The hypothesis, of three parameters.
    """
    scale = _share(machine, "linkage", axis)
    ratio, angle = _log(scale, math.log(2.0)), Parameter("rad", 0.0, -0.6, 0.6, scale, 0.1 * scale)

    def change(nominal: Machine, values: Mapping[str, float]) -> Machine:
        if not any(values.values()):
            return nominal
        before = range_at_drive(nominal, axis)
        cylinder, joint = nominal.axes[axis].cylinder, nominal.axes[axis].joint
        assert cylinder and before
        name = nominal.link_of(joint)
        moved = nominal
        for end, pin in (("base_pin", cylinder.base_pin), ("rod_pin", cylinder.rod_pin)):
            grown = math.exp(values["base" if end == "base_pin" else "rod"])
            centre = np.zeros(3) if pin.link == name else np.array(nominal.links[name].position)
            arm = grown * (np.array(pin.position) - centre)
            if end == "rod_pin":
                arm = _turned(arm, np.array(nominal.joints[joint].axis), values["angle"])
            place = tuple(float(x) for x in centre + arm)
            moved = changed(moved, f"axes.{axis}.cylinder.{end}.position", place)
        after = range_at_drive(moved, axis)
        if after is None:  # the linkage would turn back within the joint's range
            return nominal
        stroke = cylinder.stroke + (after[1] - after[0]) - (before[1] - before[0])
        closed = max(cylinder.closed_length + after[0] - before[0], stroke + _CLEARANCE)
        moved = changed(moved, f"axes.{axis}.cylinder.stroke", stroke)
        return changed(moved, f"axes.{axis}.cylinder.closed_length", closed)

    return Hypothesis("linkage", axis, {"base": ratio, "rod": ratio, "angle": angle}, change)


def supply_limits(machine: Machine) -> Hypothesis:
    """Relief pressure and pump flow.

    Args:
        machine: the nominal machine, with valves.

    Returns:
        The hypothesis, of two parameters, one on a constant-pressure supply.
    """
    assert machine.supply
    parameters = {
        "relief_pressure": _log(_share(machine, "relief_pressure", "supply"), math.log(3.0))
    }
    if machine.supply.kind != "constant_pressure":
        share = _share(machine, "pump_flow_limit", "supply")
        parameters["pump_flow"] = _log(share, math.log(3.0))

    def change(nominal: Machine, values: Mapping[str, float]) -> Machine:
        assert nominal.supply
        for field, value in values.items():
            new = getattr(nominal.supply, field) * math.exp(value)
            nominal = changed(nominal, f"supply.{field}", new)
        return nominal

    return Hypothesis("supply", "supply", parameters, change)


def _log(scale: float, most: float) -> Parameter:
    return Parameter(LOG, 0.0, -most, most, scale, 0.1 * scale)


def _share(machine: Machine, kind: str, place: str) -> float:
    """Prior standard deviation, as the machine states it or by default."""
    stated = machine.uncertainty
    return stated.get(f"{kind}.{place}", stated.get(kind, UNCERTAINTY[kind]))


def _turned(vector: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    """A vector (3,) turned about a unit axis (3,) by an angle [rad] (Rodrigues)."""
    return (
        vector * math.cos(angle)
        + np.cross(axis, vector) * math.sin(angle)
        + axis * (axis @ vector) * (1.0 - math.cos(angle))
    )
