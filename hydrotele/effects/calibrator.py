"""Effects of a calibrator arm: link bending, misaligned sensor couplings and coupling backlash.

Khoshzaban 1992, sections 3.4.2 and 3.7.3: joint flexibility and misaligned sensors spoil a
calibration most; backlash and looseness less.
"""

import math

from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine, SensorError


def _joints(machine: Machine) -> tuple[str, ...]:
    return machine.undriven_sensed_joints


def _error(machine: Machine, joint: str) -> SensorError:
    return machine.sensor_errors.get(f"angle.{joint}", SensorError())


def _with(machine: Machine, joint: str, **numbers: float) -> Machine:
    error = _error(machine, joint).model_copy(update=numbers)
    errors = {name: e for name, e in machine.sensor_errors.items() if name != f"angle.{joint}"}
    if error != SensorError():
        errors[f"angle.{joint}"] = error
    return machine.model_copy(update={"sensor_errors": errors})


def _bending(machine: Machine, joint: str) -> dict[str, Parameter]:
    """Specify the compliance across a joint.

    One degree under 200 N m, the weight of an extended calibrator, is 9e-5 rad/(N m).
    """
    present = machine.joints[joint].bending
    high = max(5.0e-4, present)
    return {"compliance": Parameter("rad/(N m)", present, 0.0, high, 5.0e-5, 2.0e-6, (5.0e-5,))}


def _bend(machine: Machine, joint: str, values: Values) -> Machine:
    return changed(machine, f"links.{machine.link_of(joint)}.joint.bending", values["compliance"])


def _misalignment(machine: Machine, joint: str) -> dict[str, Parameter]:
    """Specify the tilt of a sensor coupling.

    Couplings are aligned to a few degrees. A tilt of 3 degrees causes an error of 0.04 degrees
    twice per revolution.
    """
    one = math.radians(1.0)
    present = _error(machine, joint).tilt
    high = max(20.0 * one, present)
    return {"tilt": Parameter("rad", present, 0.0, high, 5.0 * one, 3.0 * one, (10.0 * one,))}


def _misalign(machine: Machine, joint: str, values: Values) -> Machine:
    return _with(machine, joint, tilt=values["tilt"])


def _backlash(machine: Machine, joint: str) -> dict[str, Parameter]:
    """Specify the backlash of a sensor coupling.

    A loose coupling has some tenths of a degree; the resolver resolves one tenth.
    """
    one = math.radians(1.0)
    present = _error(machine, joint).backlash
    high = max(5.0 * one, present)
    return {"gap": Parameter("rad", present, 0.0, high, 0.5 * one, 0.1 * one, (0.5 * one,))}


def _loosen(machine: Machine, joint: str, values: Values) -> Machine:
    return _with(machine, joint, backlash=values["gap"])


EFFECTS = (
    Effect("joint_bending", "bending of a link across its sensed joint", "geometry", _joints,
           _bending, _bend),
    Effect("sensor_misalignment", "a tilted coupling of a joint's sensor", "sensor", _joints,
           _misalignment, _misalign),
    Effect("sensor_backlash", "backlash in the coupling of a joint's sensor", "sensor", _joints,
           _backlash, _loosen),
)  # fmt: skip
