"""Tables of an arm in its machine, and which arms can be felt through their drives."""

import numpy as np

from hydrotele.dynamics.mechanism import HOME, body_names, coordinate_names
from hydrotele.dynamics.model import model_space, reduced_model, state_size
from hydrotele.errors import InputError
from hydrotele.machine import Machine
from hydrotele.operate.tip_balance import Arm, Body, Work


def arm_joints(machine: Machine) -> tuple[str, ...]:
    """Joints of the arm from swing outwards.

    Raises:
        InputError: the machine has no arm.
    """
    arm = machine.arm
    if arm is None:
        raise InputError(f"machine {machine.name}", "has no arm, so there is no tip to feel with")
    joints = (arm.swing, arm.boom, arm.stick, arm.tool, getattr(arm, "head", None))
    return tuple(j for j in joints if j)


def gravity_size(joints: int) -> int:
    """Number of parameters of the static model of an arm with that many joints."""
    return 7 if joints == 5 else 2 * (joints - 1)


def arm_tables(machine: Machine, axes: tuple[str, ...], where: str) -> Arm:
    """Tables of an arm.

    Args:
        machine: the machine.
        axes: axes whose readings there are.
        where: who asks, for messages.

    Returns:
        The tables, standing at home.

    Raises:
        InputError: a joint is not driven, not by a valve, or not measured.
    """
    joints, model = arm_joints(machine), reduced_model(machine, ())
    names, driver = coordinate_names(machine), {a.joint: n for n, a in machine.axes.items()}
    free = [names[i] for i in model.mech.free]
    if loose := [j for j in free if j not in driver]:
        raise InputError(where, f"no drive holds {', '.join(loose)}: their motion is not measured")
    if plain := [j for j in joints if driver[j] not in machine.hydraulic_axes]:
        raise InputError(where, f"no valve drives {', '.join(plain)}: their torque is not measured")
    if missing := [driver[j] for j in free if driver[j] not in axes]:
        raise InputError(where, f"readings of {', '.join(missing)} are missing")
    assert machine.arm
    bodies, n, m = body_names(machine), len(free), len(joints)
    space, z = model_space(model), np.zeros(state_size(model))
    z[:n] = model.mech.joint[HOME][model.mech.free]
    return Arm(
        model=Body(model.mech, model.user, model.gear, model.transmission),
        space=Work(space.motion, space.drive, space.row),
        z=z,
        joint=np.array([free.index(j) for j in joints]),
        bends=np.array([float(1 <= i <= 3) for i in range(m)]),
        tip=np.array(machine.arm.tip.position, float),
        links=np.array(
            [bodies.index(k) for k in (machine.arm.tip.link, machine.link_of(joints[0]))]
        ),
        gravity=np.zeros(gravity_size(m)),
        acceleration=np.zeros(n),
        push=np.zeros(model.hydraulic),
        rate_noise=np.zeros(n),
        outside=np.zeros(n),
        table=np.zeros((m, m)),
    )
