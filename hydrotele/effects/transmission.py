"""Effects of the transmission between drive and load: backlash and joint flexibility.

Both effects add a `Transmission` with a drive-side inertia, a spring and a damper to an axis.
Helper functions choose an inertia and a stiffness that a simulation with 1 ms steps can resolve.
"""

import math

import numpy as np

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    is_rotary_drive,
    max_drive_force,
    outboard_links,
    valve_axes,
    with_value,
)
from hydrotele.machine.drives import Transmission
from hydrotele.machine.machine import Machine

_DRIVE_INERTIA_FRACTION = 0.03  # of the load's inertia: rotor and gears of a slewing drive, referred to the ring
_CONTACT_FREQUENCY_RAD_S = 2.0 * math.pi * 40.0  # rad/s, drive on closed teeth: a radian takes four steps of 1 ms
_MAX_FREQUENCY_RAD_S = 2.0 * math.pi * 150.0  # rad/s, drive on spring and oil: 1 ms is half the step limit
_DEFAULT_DAMPING_RATIO = 0.3  # damping ratio of the drive on its spring: oil and friction of the teeth


def make_stiff_transmission(machine: Machine, axis: str) -> Transmission:
    """Return a nearly rigid transmission of a drive, to which backlash or compliance can be added.

    The drive-side inertia is the rod's mass, or for a motor 3 % of the load inertia in the home
    pose. The spring is so stiff that the drive-side inertia vibrates on it at 40 Hz, which a
    simulation with steps of 1 ms resolves well. The damping ratio is 0.3, the backlash 0.
    """
    cylinder = machine.axes[axis].cylinder
    inertia = cylinder.rod.mass if cylinder else _DRIVE_INERTIA_FRACTION * load_inertia(machine, axis)
    stiffness = inertia * _CONTACT_FREQUENCY_RAD_S**2
    return Transmission(
        inertia=inertia,
        stiffness=stiffness,
        damping=spring_damping(inertia, stiffness),
        backlash=0.0,
    )


def spring_damping(inertia: float, stiffness: float) -> float:
    """Return the damping coefficient that gives an inertia on a spring a damping ratio of 0.3 [N s/m] or [N m s/rad].

    Args:
        inertia: mass [kg] or moment of inertia [kg m^2] on the spring.
        stiffness: stiffness of the spring [N/m] or [N m/rad].
    """
    return 2.0 * _DEFAULT_DAMPING_RATIO * math.sqrt(stiffness * inertia)


def raise_to_resolvable_inertia(machine: Machine, axis: str, inertia: float, stiffness: float) -> float:
    """Return the drive-side inertia, increased if steps of 1 ms could not resolve its vibration.

    The result is large enough that the inertia vibrates on spring and oil at 150 Hz or less.

    Args:
        machine: the machine.
        axis: name of the axis.
        inertia: desired inertia [kg] or [kg m^2].
        stiffness: stiffness of the spring between drive and load [N/m] or [N m/rad].
    """
    return max(inertia, (stiffness + _oil_stiffness(machine, axis)) / _MAX_FREQUENCY_RAD_S**2)


def natural_frequency(machine: Machine, axis: str) -> float:
    """Return the natural frequency of the drive-side inertia of an axis with a transmission [rad/s].

    The inertia vibrates between the spring of the transmission and, for a hydraulic drive, the oil,
    whose stiffness is that at the end of the stroke.
    """
    facts = machine.axes[axis]
    assert facts.transmission
    oil = _oil_stiffness(machine, axis) if facts.is_hydraulic else 0.0
    return math.sqrt((facts.transmission.stiffness + oil) / facts.transmission.inertia)


def _oil_stiffness(machine: Machine, axis: str) -> float:
    """Return the stiffness of the oil in both chambers with the piston fully retracted [N/m] or [N m/rad].

    It is the sum over both chambers of bulk modulus times squared area over volume. In this
    position the head chamber has only its dead volume, so that the stiffness is largest.
    """
    drive, cylinder = machine.axes[axis].hydraulic_drive, machine.axes[axis].cylinder
    assert machine.supply
    head, rod = drive.effective_areas
    far = drive.dead_volume + (rod * cylinder.stroke if cylinder else 0.0)
    return machine.supply.bulk_modulus * (head**2 / drive.dead_volume + rod**2 / far)


def with_transmission(machine: Machine, axis: str, transmission: Transmission) -> Machine:
    """Return a copy of a machine with a transmission in an axis, which replaces a present one.

    For a motor, the drive-side inertia (minus that of a present transmission) is subtracted from
    the driven link, so that the total inertia about the motor axis does not change. It is not
    subtracted if the link's moments of inertia would become physically impossible.
    """
    facts = machine.axes[axis]
    before = facts.transmission.inertia if facts.transmission else 0.0
    machine = with_value(machine, f"axes.{axis}.transmission", transmission)
    if facts.cylinder:
        return machine
    name = machine.link_of(facts.joint)
    link, direction = machine.links[name], int(np.argmax(np.abs(machine.joints[facts.joint].axis)))
    inertia = list(link.inertia)
    inertia[direction] -= transmission.inertia - before
    a, b, c = sorted(inertia)
    if a <= 0.0 or a + b < c:
        return machine
    return with_value(machine, f"links.{name}.inertia", tuple(inertia))


def load_inertia(machine: Machine, axis: str) -> float:
    """Return the inertia [kg m^2] or mass [kg] that the joint of an axis moves in the home pose.

    For a hinge it is the moment of inertia of all links outboard of the joint about the joint's
    axis, for a slide their mass. Cylinders are not included.
    """
    joint = machine.axes[axis].joint
    first = machine.link_of(joint)
    carried = outboard_links(machine, first)
    if machine.joints[joint].type == "slide":
        return sum(machine.links[name].mass for name in carried)
    frames = {name: _link_pose(machine, name) for name in carried}
    origin, turn = frames[first]
    way = turn @ np.array(machine.joints[joint].axis)
    total = 0.0
    for name, (position, rotation) in frames.items():
        link = machine.links[name]
        arm = position + rotation @ np.array(link.com) - origin
        total += link.mass * float(arm @ arm - (arm @ way) ** 2)
        total += float(np.array(link.inertia) @ (rotation.T @ way) ** 2)
    return total


def _link_pose(machine: Machine, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) [m] and rotation matrix (3, 3) of a link in the world frame, in the home pose."""
    if name == "world":
        return np.zeros(3), np.eye(3)
    link = machine.links[name]
    position, rotation = _link_pose(machine, link.parent)
    position = position + rotation @ np.array(link.position)
    if link.joint:
        value, axis = machine.home.get(link.joint.name, 0.0), np.array(link.joint.axis)
        if link.joint.type == "slide":
            return position + rotation @ axis * value, rotation
        rotation = rotation @ _rotation_matrix(axis, value)
    return position, rotation


def _rotation_matrix(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) about a unit axis by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


_MIN_BACKLASH_RAD = 1.0e-6  # rad: smaller backlash is omitted; it moves a slewing ring's tooth by 1 um


def _backlash_axes(machine: Machine) -> tuple[str, ...]:
    return tuple(n for n, a in machine.axes.items() if a.motor and is_rotary_drive(machine, n))


def _backlash_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of the backlash between a motor and its load.

    The parameters are backlash, drive-side inertia, damping ratio and contact frequency. The latter is
    the natural frequency at which the drive vibrates while its teeth touch, 30 to 100 Hz for steel. A
    worn slewing ring has half a degree of backlash, a new one 1 mrad, the smallest relevant change.
    All parameters but the backlash are optional, because they are known only roughly.
    """
    drive = _transmission_or_default(machine, location)
    present, rings = drive.backlash, _spring_frequency(drive)
    return {
        "gap": Parameter("rad", present, 0.0, max(0.05, present), 0.01, 1e-3, start_values=(0.003, 0.01, 0.03)),
        "drive_inertia": _drive_inertia_parameter("kg m^2", drive.inertia),
        "damping_ratio": _damping_ratio_parameter(drive),
        "contact_frequency": Parameter("Hz", rings, min(10.0, rings), max(110.0, rings), 20.0, 20.0, optional=True),
    }


def _drive_inertia_parameter(unit: str, own: float, least: float = 0.0, usual: float = 0.0) -> Parameter:
    """Return nominal value, bounds and prior of the drive-side inertia, an optional parameter.

    It is known only to a factor and does not indicate a defect.

    Args:
        unit: unit of the inertia, "kg" or "kg m^2".
        own: nominal value [unit].
        least: smallest inertia that the simulation can resolve; limits the lower bound [unit].
        usual: smallest standard deviation of the prior [unit].
    """
    scale, low = max(own, usual), min(own, max(0.1 * own, least))
    return Parameter(unit, own, low, own + 4.0 * scale, scale, scale, optional=True)


def _damping_ratio_parameter(drive: Transmission) -> Parameter:
    ratio = _transmission_damping_ratio(drive)
    return Parameter("1", ratio, min(1e-3, ratio), max(2.0, ratio), 0.3, 0.3, optional=True)


def _spring_frequency(drive: Transmission) -> float:
    """Return the natural frequency of the drive side on its spring [Hz]."""
    return math.sqrt(drive.stiffness / drive.inertia) / (2.0 * math.pi)


def _transmission_or_default(machine: Machine, location: str) -> Transmission:
    return machine.axes[location].transmission or make_stiff_transmission(machine, location)


def _transmission_damping_ratio(drive: Transmission) -> float:
    return drive.damping / (2.0 * math.sqrt(drive.stiffness * drive.inertia))


def _set_backlash(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with backlash in an axis: a motor-side inertia behind a stiff spring with a gap.

    The inertia is subtracted from the driven link. Parameters that are not stated keep the values
    of the present transmission, or of `make_stiff_transmission`. Without a present transmission, a
    gap below 1 urad changes nothing.
    """
    gap, before = values["gap"], machine.axes[location].transmission
    if gap < _MIN_BACKLASH_RAD and before is None:
        return machine
    drive = _transmission_or_default(machine, location)
    inertia = values.get("drive_inertia", drive.inertia)
    ratio, rings = (
        values.get("damping_ratio", _transmission_damping_ratio(drive)),
        _spring_frequency(drive),
    )
    frequency = values.get("contact_frequency", rings)
    stiffness = drive.stiffness * (inertia / drive.inertia) * (frequency / rings) ** 2
    damping = drive.damping
    if (inertia, ratio, frequency) != (drive.inertia, _transmission_damping_ratio(drive), rings):
        damping = 2.0 * ratio * math.sqrt(stiffness * inertia)
    transmission = Transmission(inertia=inertia, stiffness=stiffness, damping=damping, backlash=gap)
    return with_transmission(machine, location, transmission)


BACKLASH = Effect(
    "backlash", "backlash between a motor and its load", "force", _backlash_axes, _backlash_parameters, _set_backlash
)  # fmt: skip


_MIN_COMPLIANCE_RATIO = 0.02  # of the smallest relevant compliance: stiffer than parts modelled as rigid
_MOTOR_DEFLECTION_RAD = 0.015  # rad, deflection of a slewing drive's gears and shafts at full torque


def _typical_deflection(machine: Machine, location: str) -> float:
    """Return the typical deflection between a drive and its load at full force [m] or [rad].

    It is 1 % of the stroke for cylinders and 15 mrad for motors.
    """
    cylinder = machine.axes[location].cylinder
    return 0.01 * cylinder.stroke if cylinder else _MOTOR_DEFLECTION_RAD


def _flexibility_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of the compliance between a drive and its load.

    The parameters are compliance, drive-side inertia and damping ratio. The smallest relevant compliance
    deflects by 1.5 mm per metre of stroke, or by about 2 mrad, at full force. Inertia and damping are
    optional, because they are known only roughly. The inertia has a lower bound, below which the
    simulation with 1 ms steps would not resolve the vibration.
    """
    usual = _typical_deflection(machine, location) / max_drive_force(machine, location)
    transmission = machine.axes[location].transmission
    present = 1.0 / transmission.stiffness if transmission else 0.0
    drive = transmission or make_stiff_transmission(machine, location)
    resolved = [raise_to_resolvable_inertia(machine, location, 0.0, k) for k in (0.0, 1.0 / usual)]
    inertia = drive.inertia if transmission else max(drive.inertia, resolved[0])
    high = max(4.0 * usual, present)
    starts = (0.3 * usual, 1.0 * usual, 3.0 * usual)
    least = 0.15 * usual
    turns = is_rotary_drive(machine, location)
    unit, of_inertia = ("rad/(N m)", "kg m^2") if turns else ("m/N", "kg")
    return {
        "compliance": Parameter(unit, present, 0.0, high, usual, least, starts),
        "drive_inertia": _drive_inertia_parameter(of_inertia, inertia, *resolved),
        "damping_ratio": _damping_ratio_parameter(drive),
    }


def _set_flexibility(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with a spring of stiffness 1 / compliance between a drive and its load.

    An existing backlash is kept. A cylinder's spring is in line with it, between piston and rod
    pin, so that length sensor and oil follow the piston. The drive-side inertia is the stated
    value, otherwise that of the present transmission, or the rod's mass or 3 % of a motor's load
    inertia. It is increased if 1 ms steps could not resolve its vibration on the spring.

    The machine is returned unchanged if all stated values are nominal. It is also unchanged without
    a present transmission if the compliance is below 2 % of the smallest relevant compliance.
    """
    compliance, before = values["compliance"], machine.axes[location].transmission
    table = _flexibility_parameters(machine, location)
    least = _MIN_COMPLIANCE_RATIO * table["compliance"].min_relevant_change
    unlike = [key for key in table if key in values and values[key] != table[key].nominal]
    if not unlike or (before is None and compliance < least):
        return machine
    transmission = before or make_stiff_transmission(machine, location)
    stiffness = 1.0 / max(compliance, least) if "compliance" in unlike else transmission.stiffness
    inertia = values.get("drive_inertia", transmission.inertia)
    inertia = raise_to_resolvable_inertia(machine, location, inertia, stiffness)
    ratio = values.get("damping_ratio", _transmission_damping_ratio(transmission))
    damping = 2.0 * ratio * math.sqrt(stiffness * inertia)
    soft = {"stiffness": stiffness, "inertia": inertia, "damping": damping}
    return with_transmission(machine, location, transmission.model_copy(update=soft))


JOINT_FLEXIBILITY = Effect(
    "joint_flexibility", "compliance between a drive and its load", "force", valve_axes,
    _flexibility_parameters, _set_flexibility,
)  # fmt: skip

EFFECTS = (BACKLASH, JOINT_FLEXIBILITY)
