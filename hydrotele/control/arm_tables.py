"""Tables of an arm in its machine, and which arms can be felt through their drives."""

import numpy as np

from hydrotele.control.resolved_motion import arm_facts
from hydrotele.control.tip_balance import Arm, Body, Work
from hydrotele.core.errors import InputError
from hydrotele.dynamics.mechanism import HOME, coordinate_names
from hydrotele.dynamics.model import model_space, reduced_model, state_size
from hydrotele.machine.machine import Machine


def arm_joints(machine: Machine) -> tuple[str, ...]:
    """Joints of the arm from swing outwards.

    Raises:
        InputError: the machine has no arm.
    """
    arm = machine.arm
    if arm is None:
        raise InputError(f"machine {machine.name}", "has no arm, so there is no tip to feel with")
    return tuple(j for j in (arm.swing, arm.boom, arm.stick, arm.tool, arm.head) if j)


def gravity_size(joints: int) -> int:
    """Number of parameters of the static model of an arm with that many joints."""
    return 7 if joints == 5 else 2 * (joints - 1)


def free_axes(machine: Machine, where: str) -> tuple[str, ...]:
    """Axes of the independent coordinates, all of which must be driven, those of the arm by valves.

    Args:
        machine: the machine.
        where: who asks, for messages.

    Returns:
        Axis names in the order of the coordinates.

    Raises:
        InputError: names the joints that cannot be felt.
    """
    names, driver = coordinate_names(machine), {a.joint: n for n, a in machine.axes.items()}
    free = [names[i] for i in reduced_model(machine, ()).mech.free]
    if loose := [joint for joint in free if joint not in driver]:
        raise InputError(where, f"no drive holds {', '.join(loose)}: their motion is not measured")
    joints = arm_joints(machine)
    if plain := [joint for joint in joints if driver[joint] not in machine.hydraulic_axes]:
        raise InputError(where, f"no valve drives {', '.join(plain)}: their torque is not measured")
    return tuple(driver[joint] for joint in free)


def arm_tables(machine: Machine, where: str) -> Arm:
    """Tables of an arm, whose transmissions are taken as rigid and without inertia.

    Args:
        machine: the machine.
        where: who asks, for messages.

    Returns:
        The tables, standing at home without pressures.

    Raises:
        InputError: a joint is not driven, or a joint of the arm not by a valve.
    """
    free = free_axes(machine, where)
    rigid = {n: a.model_copy(update={"transmission": None}) for n, a in machine.axes.items()}
    model = reduced_model(machine.model_copy(update={"axes": rigid}), ())
    space, z, (task, axes, _) = model_space(model), np.zeros(state_size(model)), arm_facts(machine)
    n, m = len(free), len(axes)
    z[:n] = model.mech.joint[HOME][model.mech.free]
    return Arm(
        model=Body(model.mech, model.user, model.hydraulic, model.gear, model.transmission),
        space=Work(space.motion, space.drive, space.row),
        z=z,
        joint=np.array([free.index(name) for name in axes]),
        task=task,
        gravity=np.zeros(gravity_size(m)),
        acceleration=np.zeros(n),
        rate_noise=np.zeros(n),
        angle=np.zeros(m),
        table=np.zeros((m, m)),
        work=np.zeros(n),
    )
