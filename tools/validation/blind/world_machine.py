"""Build the independent machine from the numbers of a Machine, without a law of hydrotele.

It reads what a machine file says, so that an effect of the library, which changes facts, and a
wrong number reach the independent equations the same way.
"""

import math

import numpy as np

from hydrotele.machine.machine import Machine as Facts
from hydrotele.machine.machine import find_channel_sensor
from hydrotele.machine.sensors import SensorError, SensorSet, make_channel_converter
from tools.validation.blind.world import Added, Drives, Forms, Machine, Mechanism, Sensors


def independent_machine(facts: Facts, sensors: SensorSet) -> Machine:
    """The independent machine with laws of the nominal form.

    Args:
        facts: a swing-boom-stick arm with tool `none`, or one cylinder that pushes a slide.
        sensors: its sensors.

    Returns:
        The machine.
    """
    n = len(facts.axes)
    zero = np.zeros(n)
    forms = Forms(
        soft_edge=zero, gain_extend=np.ones(n), gain_retract=np.ones(n), shape=np.ones(n),
        slew=zero, command_lag=zero, hose_soft=zero, hose_pressure=np.ones(n), air=0.0,
        leak_orifice=zero, exponential=zero, presliding=zero, load_friction=zero, quadratic=zero,
        drive_inertia=zero, gap=zero, contact=zero, contact_damping=zero, shaft_damping=zero,
        hardening=zero, relief_droop=0.0, pump_leak=0.0,
    )  # fmt: skip
    nothing = Added(
        -1, 0, np.zeros(2, np.int64), np.zeros(2, np.int64), np.zeros(2), np.ones(2), np.zeros(1),
        np.zeros((1, 2)), np.zeros(1), 0.0, 0, 0.0, 0.0,
    )  # fmt: skip
    machine = Machine(
        _mechanism(facts), _drives(facts), _with_transmissions(facts, forms), nothing,
        _sensors(facts, sensors),
    )  # fmt: skip
    return machine


def channels(facts: Facts) -> list[str]:
    """Names of the channels in the order of the independent machine."""
    names = list(facts.axes)
    return [
        *(f"{facts.position_kind(a)}.{a}" for a in names),
        *(f"length.{a}" for a in names if facts.axes[a].cylinder),
        *(f"pressure_head.{a}" for a in names),
        *(f"pressure_rod.{a}" for a in names),
        "pressure_supply",
    ]


def stated_errors(facts: Facts, sensors: SensorSet) -> tuple[np.ndarray, np.ndarray]:
    """Bound of the uniform error and converter step of every channel, (c,) each."""
    names = channels(facts)
    kinds = [find_channel_sensor(facts, sensors, name) for name in names]
    steps = [make_channel_converter(s, name).step for s, name in zip(kinds, names, strict=True)]
    return np.array([s.accuracy for s in kinds]), np.array(steps)


def _plane(position) -> complex:
    return complex(position[0], position[2])


def _mechanism(facts: Facts) -> Mechanism:
    if facts.arm is None:
        return _slide(facts)
    axes, links = facts.axes, facts.links
    swing, boom, stick = (facts.link_of(getattr(facts.arm, j)) for j in ("swing", "boom", "stick"))
    cylinders = [axes["boom"].cylinder, axes["stick"].cylinder]
    bars = [(c.tube, c.rod) for c in cylinders if c]
    parts = [(0, links[boom], 0j), (1, links[stick], 0j)]
    parts += [
        ([boom, stick].index(link.parent), link, _plane(link.position))
        for link in links.values()
        if link.joint is None and link.parent in (boom, stick)
    ]
    house = links[swing]
    return Mechanism(
        rig=False,
        slide_mass=0.0,
        boom_pin=_plane(links[boom].position),
        stick_pin=_plane(links[stick].position),
        plane=float(links[boom].position[1]),
        base_pin=np.array([_plane(c.base_pin.position) for c in cylinders if c]),
        rod_pin=np.array([_plane(c.rod_pin.position) for c in cylinders if c]),
        closed=np.array([0.0, *(c.closed_length for c in cylinders if c)]),
        frame=np.array([frame for frame, _, _ in parts]),
        mass=np.array([link.mass for _, link, _ in parts]),
        com=np.array([at + _plane(link.com) for _, link, at in parts]),
        inertia=np.array([link.inertia for _, link, _ in parts], dtype=float),
        bar_mass=np.array([[b.mass for b in pair] for pair in bars]),
        bar_com=np.array([[b.com for b in pair] for pair in bars], dtype=float),
        bar_inertia=np.array([[b.inertia for b in pair] for pair in bars], dtype=float),
        swing_inertia=house.inertia[2] + house.mass * (house.com[0] ** 2 + house.com[1] ** 2),
        swing_moment=house.mass * np.array(house.com[:2]),
        gravity=np.array(facts.gravity),
    )


def _slide(facts: Facts) -> Mechanism:
    (axis,) = facts.axes.values()
    cylinder, link = axis.cylinder, facts.links[facts.link_of(axis.joint)]
    assert cylinder
    ahead = link.position[0] + cylinder.rod_pin.position[0] - cylinder.base_pin.position[0]
    none, bars = np.zeros(2, complex), np.zeros((2, 2))
    return Mechanism(
        rig=True, slide_mass=link.mass + cylinder.rod.mass, boom_pin=0j, stick_pin=0j, plane=0.0,
        base_pin=none, rod_pin=none, closed=np.array([cylinder.closed_length - ahead]),
        frame=np.zeros(1, np.int64), mass=np.zeros(1), com=np.zeros(1, complex),
        inertia=np.zeros((1, 3)), bar_mass=bars, bar_com=bars, bar_inertia=np.zeros((2, 2, 3)),
        swing_inertia=0.0, swing_moment=np.zeros(2), gravity=np.array(facts.gravity),
    )  # fmt: skip


def _drives(facts: Facts) -> Drives:
    supply, axes = facts.supply, list(facts.axes.values())
    assert supply and all(a.valve and a.valve.rated_pressure_drop > 0 for a in axes)
    drives, valves = [a.hydraulic_drive for a in axes], [a.valve for a in axes if a.valve]
    rub = [d.friction for d in drives]

    def of(items, name):
        return np.array([float(getattr(item, name)) for item in items])

    return Drives(
        cylinder=np.array([a.cylinder is not None for a in axes]),
        area_head=np.array([d.effective_areas[0] for d in drives]),
        area_rod=np.array([d.effective_areas[1] for d in drives]),
        dead_volume=of(drives, "dead_volume"),
        stroke=np.array([a.cylinder.stroke if a.cylinder else 0.0 for a in axes]),
        leakage=of(drives, "leakage"),
        hose=of(drives, "hose_compliance"),
        bandwidth=of(valves, "bandwidth"),
        damping=of(valves, "damping"),
        deadband=of(valves, "deadband"),
        flow_gain=of(valves, "rated_flow") / np.sqrt(of(valves, "rated_pressure_drop")),
        smoothing=of(valves, "smoothing"),
        port_relief=of(valves, "port_relief"),
        relief_gain=of(valves, "port_relief_gain"),
        makeup_gain=of(valves, "makeup_gain"),
        coulomb=of(rub, "coulomb"),
        stribeck=of(rub, "stribeck_extra"),
        stribeck_velocity=of(rub, "stribeck_velocity"),
        viscous=of(rub, "viscous"),
        sign_velocity=of(rub, "smoothing_velocity"),
        coulomb_asymmetry=of(rub, "coulomb_asymmetry"),
        viscous_asymmetry=of(rub, "viscous_asymmetry"),
        delay=of(axes, "command_delay"),
        bulk_modulus=supply.bulk_modulus,
        dissolved_air=supply.dissolved_air,
        tank=supply.tank_pressure,
        relief=supply.relief_pressure,
        pump=supply.pump_flow,
    )


def _with_transmissions(facts: Facts, forms: Forms) -> Forms:
    """What gives between a motor and its load, as spring with play; of a cylinder it is refused."""
    columns = {name: np.zeros(len(facts.axes)) for name in (
        "drive_inertia", "gap", "contact", "contact_damping", "shaft_damping")}  # fmt: skip
    for i, axis in enumerate(facts.axes.values()):
        if (t := axis.transmission) is None:
            continue
        if axis.cylinder:
            raise ValueError("the independent machine has no spring between a cylinder and its link")
        columns["drive_inertia"][i], columns["gap"][i] = t.inertia, t.backlash
        columns["contact"][i] = t.stiffness
        # Hunt and Crossley's factor that takes a tap of 0.05 rad/s as the linear damper does
        columns["contact_damping"][i] = min(5.0, 0.05 * t.damping / math.sqrt(t.stiffness))
        columns["shaft_damping"][i] = t.damping
    return forms._replace(**columns)


def _sensors(facts: Facts, sensors: SensorSet) -> Sensors:
    names = channels(facts)
    errors = [facts.sensor_errors.get(name, SensorError()) for name in names]
    converters = [make_channel_converter(find_channel_sensor(facts, sensors, name), name) for name in names]
    return Sensors(
        scale=np.array([e.scale for e in errors]),
        offset=np.array([e.offset for e in errors]),
        drift=np.zeros(len(names)),
        delay=np.array([e.delay for e in errors]),
        lag=np.array([getattr(e, "time_constant", 0.0) for e in errors]),
        step=np.array([c.step for c in converters]),
        low=np.array([c.low for c in converters]),
        high=np.array([c.high for c in converters]),
    )
