"""The end point of an arm whose resolved motion uses a nominal or a calibrated machine."""

from collections.abc import Sequence

import mujoco
import numpy as np

from hydrotele.calibrate.arm import identify_arm, identify_jointly
from hydrotele.calibrate.arm_machine import calibrated_machine
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.loop import Loop, loop_of
from hydrotele.control.resolved_motion import pose_to_joints
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Pose
from hydrotele.simulate.mechanism import TIP_SITE, assemble, mjcf_document

TARGETS = tuple(
    (r, z, theta) for r in (4.2, 5.0, 5.8) for z in (1.8, 2.6, 3.4) for theta in (-0.6, 0.5)
)
"""Places of the tip that are asked for: r [m], z [m] above ground, theta [rad]."""


def tip_errors(
    nominal: Machine, true: Machine, loop: Loop, stages: Sequence[Poses]
) -> tuple[float, float]:
    """RMS distance of the true arm's tip from where it is asked to be.

    Resolved motion turns each place into joint angles with the machine that it knows. The joints
    are then moved until the arm's own sensors, less the offsets that this machine knows of, show
    these angles; where the tip is then, MuJoCo says for the true machine.

    Args:
        nominal: machine as it is believed to be.
        true: machine as it is.
        loop: the true chain, whose offsets are those of the sensors.
        stages: readings to calibrate from.

    Returns:
        (with the nominal machine, with the calibrated one) [m].
    """
    known = loop_of(nominal)
    hierarchical = identify_arm(known, stages)
    fit = identify_jointly(hierarchical, stages)
    made = calibrated_machine(nominal, fit, stages)
    document = mjcf_document(assemble(true, ground=False, looks=False))
    model = document.compile()
    data = mujoco.MjData(model)
    sums = []
    for machine in (nominal, made):
        squares = [_miss(machine, known, loop, model, data, target) for target in TARGETS]
        sums.append(float(np.sqrt(np.mean(squares))))
    return sums[0], sums[1]


def _miss(machine: Machine, known: Loop, loop: Loop, model, data, target) -> float:
    """Squared distance of the tip from a target [m^2]."""
    r, z, theta = target
    here = {name: machine.home.get(axis.joint, 0.0) for name, axis in machine.axes.items()}
    joints = pose_to_joints(machine, Pose(r=r, z=z, theta=theta), here, "target")
    data.qpos[:] = 0.0
    for k, link in enumerate(loop.links[: loop.moved]):
        if link not in joints:
            continue
        error = machine.sensor_errors.get(loop.channels[k])
        shown = joints[link] + (error.offset if error else 0.0)
        offset = (loop.values[k, 0] - known.values[k, 0]) * loop.signs[k]  # of the true sensor
        data.qpos[model.joint(loop.joints[k]).qposadr[0]] = shown + offset
    mujoco.mj_kinematics(model, data)
    tip = data.site_xpos[model.site(TIP_SITE).id]
    return float(np.sum((tip - (r * np.cos(theta), r * np.sin(theta), z)) ** 2))
