"""Effects of a calibrator, a passive measuring arm with sensors in its joints.

The effects are bending of links, misaligned couplings of joint sensors, and their backlash. Khoshzaban
1992, sections 3.4.2 and 3.7.3: joint flexibility and misaligned sensors spoil a calibration most;
backlash and looseness less.
"""

import math

from hydrotele.effects.effect import Effect, Parameter, Values, with_value
from hydrotele.machine.machine import Machine
from hydrotele.machine.sensors import SensorError


def _undriven_sensed_joints(machine: Machine) -> tuple[str, ...]:
    return machine.undriven_sensed_joints


def _sensor_error(machine: Machine, joint: str) -> SensorError:
    return machine.sensor_errors.get(f"angle.{joint}", SensorError())


def _with_sensor_error(machine: Machine, joint: str, **numbers: float) -> Machine:
    error = _sensor_error(machine, joint).model_copy(update=numbers)
    errors = {name: e for name, e in machine.sensor_errors.items() if name != f"angle.{joint}"}
    if error != SensorError():
        errors[f"angle.{joint}"] = error
    return machine.model_copy(update={"sensor_errors": errors})


def _bending_parameters(machine: Machine, joint: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of `compliance`, the bending angle of a link per torque.

    The torque acts perpendicular to the axis of the link's joint. The smallest relevant change is
    2e-6 rad/(N m). For comparison, one degree of bending by 200 N m, the weight torque of an
    extended calibrator, is 9e-5 rad/(N m).
    """
    present = machine.joints[joint].bending
    high = max(5.0e-4, present)
    return {"compliance": Parameter("rad/(N m)", present, 0.0, high, 5.0e-5, 2.0e-6, (5.0e-5,))}


def _set_bending(machine: Machine, joint: str, values: Values) -> Machine:
    return with_value(machine, f"links.{machine.link_of(joint)}.joint.bending", values["compliance"])


def _sensor_misalignment_parameters(machine: Machine, joint: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the tilt between a joint and its angle sensor.

    Couplings are aligned to a few degrees. The smallest relevant tilt is 3 degrees. It causes an angle
    error with an amplitude of 0.04 degrees and two periods per revolution of the joint.
    """
    one = math.radians(1.0)
    present = _sensor_error(machine, joint).tilt
    high = max(20.0 * one, present)
    return {"tilt": Parameter("rad", present, 0.0, high, 5.0 * one, 3.0 * one, (10.0 * one,))}


def _set_sensor_misalignment(machine: Machine, joint: str, values: Values) -> Machine:
    return _with_sensor_error(machine, joint, tilt=values["tilt"])


def _sensor_backlash_parameters(machine: Machine, joint: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the backlash between a joint and its angle sensor.

    A loose coupling has a backlash of some tenths of a degree. The smallest relevant backlash is a
    tenth of a degree, the resolution of the sensor.
    """
    one = math.radians(1.0)
    present = _sensor_error(machine, joint).backlash
    high = max(5.0 * one, present)
    return {"gap": Parameter("rad", present, 0.0, high, 0.5 * one, 0.1 * one, (0.5 * one,))}


def _set_sensor_backlash(machine: Machine, joint: str, values: Values) -> Machine:
    return _with_sensor_error(machine, joint, backlash=values["gap"])


EFFECTS = (
    Effect("joint_bending", "bending of a link across its sensed joint", "geometry", _undriven_sensed_joints,
           _bending_parameters, _set_bending),
    Effect("sensor_misalignment", "a tilted coupling of a joint's sensor", "sensor", _undriven_sensed_joints,
           _sensor_misalignment_parameters, _set_sensor_misalignment),
    Effect("sensor_backlash", "backlash in the coupling of a joint's sensor", "sensor", _undriven_sensed_joints,
           _sensor_backlash_parameters, _set_sensor_backlash),
)  # fmt: skip
