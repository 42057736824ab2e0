"""Numbers of a Machine's drives in the order in which the native hydraulics reads them."""

import math

import numpy as np

from hydrotele.drives import Axis
from hydrotele.hydraulics.circuit import SLOTS, Kind, Slot
from hydrotele.machine import Machine, Supply

MARKER = 215325.0  # CAT 215, CAT 325: no other model writes this into actuator_user[0]


def actuator_order(machine: Machine) -> list[str]:
    """Axis names in actuator order: the valve-controlled ones first, as they share the supply."""
    return [*machine.hydraulic_axes, *(n for n, a in machine.axes.items() if not a.hydraulic)]


def actuator_numbers(machine: Machine) -> dict[str, np.ndarray]:
    """`actuator_user` of every axis, in actuator order.

    Args:
        machine: the machine.

    Returns:
        Axis name -> (SLOTS,) numbers in SI, placed as `circuit.Slot` says.
    """
    count = len(machine.hydraulic_axes)
    table = {}
    for name in actuator_order(machine):
        numbers = np.zeros(SLOTS)
        axis = machine.axes[name]
        numbers[Slot.MARKER] = MARKER
        numbers[Slot.COUNT] = count if axis.hydraulic else 0
        _write_friction(numbers, axis)
        if axis.transmission:
            numbers[Slot.DRIVE_INERTIA] = axis.transmission.inertia
        if axis.hydraulic and machine.supply:
            _write_hydraulics(numbers, axis, machine.supply)
        else:
            numbers[Slot.KIND] = Kind.FORCE
            numbers[Slot.OFFSET] = axis.force.offset if axis.force else 0.0
        table[name] = numbers
    return table


def _write_friction(numbers: np.ndarray, axis: Axis) -> None:
    friction = axis.drive.friction
    numbers[Slot.COULOMB] = friction.coulomb
    numbers[Slot.STRIBECK] = friction.stribeck_extra
    numbers[Slot.STRIBECK_VELOCITY] = friction.stribeck_velocity
    numbers[Slot.VISCOUS] = friction.viscous
    numbers[Slot.COULOMB_VELOCITY] = friction.smoothing_velocity
    numbers[Slot.COULOMB_ASYMMETRY] = friction.coulomb_asymmetry
    numbers[Slot.VISCOUS_ASYMMETRY] = friction.viscous_asymmetry


def _write_hydraulics(numbers: np.ndarray, axis: Axis, supply: Supply) -> None:
    valve = axis.valve
    assert valve is not None
    drive = axis.hydraulic_drive
    numbers[Slot.KIND] = Kind.CYLINDER if axis.cylinder else Kind.MOTOR
    numbers[Slot.STROKE] = axis.cylinder.stroke if axis.cylinder else 0.0
    numbers[Slot.AREA_HEAD], numbers[Slot.AREA_ROD] = drive.areas
    numbers[Slot.VOLUME_HEAD] = numbers[Slot.VOLUME_ROD] = drive.dead_volume
    numbers[Slot.LEAKAGE] = drive.leakage
    numbers[Slot.HOSE_COMPLIANCE] = drive.hose_compliance
    numbers[Slot.BANDWIDTH], numbers[Slot.DAMPING] = valve.bandwidth, valve.damping
    numbers[Slot.DEADBAND] = valve.deadband
    numbers[Slot.FLOW_GAIN] = valve.rated_flow / math.sqrt(valve.rated_pressure_drop)
    numbers[Slot.ORIFICE_SMOOTHING] = valve.smoothing
    numbers[Slot.PORT_RELIEF] = valve.port_relief
    numbers[Slot.RELIEF_GAIN] = valve.port_relief_gain
    numbers[Slot.MAKEUP_GAIN] = valve.makeup_gain
    numbers[Slot.BULK_MODULUS] = supply.bulk_modulus
    numbers[Slot.TANK_PRESSURE] = supply.tank_pressure
    numbers[Slot.RELIEF_PRESSURE] = supply.relief_pressure
    numbers[Slot.PUMP_FLOW] = supply.pump_flow
