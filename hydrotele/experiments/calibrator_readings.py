"""Readings of a calibrator on a simulated machine: sensors, bent joints, drift, machines as built.

The kinematics of the closed chain, for studies of many seeds (`models/calibrator` is the same chain
with masses and hydraulics in MuJoCo), and the end point of an arm whose resolved motion uses a
nominal or a calibrated machine. Ground truth is used to make readings and to judge estimates only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from hydrotele.calibrate.arm import calibrated_machine, identify_arm, identify_jointly
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.design import STILL, SWEEPS, Clean, Sweep
from hydrotele.calibrate.loop import Loop, ball_place, frame_of, loop_of
from hydrotele.control.resolved_motion import pose_to_joints
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Pose
from hydrotele.simulate.mechanism import TIP_SITE, assemble, mjcf_document

RESOLVER = np.radians(0.1)
"""Bound of a resolver's error, uniform [rad]; Khoshzaban 1992 section 2.5."""


def simulate_readings(
    loop: Loop, clean: Clean, rng: np.random.Generator | None, accuracy: float = RESOLVER,
    extra: np.ndarray | None = None,
) -> Poses:  # fmt: skip
    """Simulate the readings of a stage.

    Args:
        loop: the true chain; its offsets are those of the sensors.
        clean: true poses.
        rng: of the errors, uniform within +-accuracy; None for none.
        accuracy: of every angle sensor [rad].
        extra: (M, N) errors to add, such as those of bent joints [rad].

    Returns:
        The poses as they are measured.
    """
    shown = clean.theta - loop.values[:, 0]
    if extra is not None:
        shown = shown + extra
    if rng is not None:
        shown = shown + rng.uniform(-accuracy, accuracy, shown.shape)
    sigma = np.full(len(loop) - loop.moved, accuracy / np.sqrt(3.0))
    return Poses(
        clean.link, shown[:, loop.moved :], sigma,
        {name: shown[:, k] for k, name in enumerate(loop.links[: loop.moved]) if name != "pitch"},
        accuracy / np.sqrt(3.0), f"simulated {clean.link}",
    )  # fmt: skip


def draw_sweeps(
    rng: np.random.Generator, drift: bool = True, share: float = 1.0
) -> dict[str, Sweep]:
    """Draw how every link is moved, within the ranges of Khoshzaban 1992 Figs 16 to 18.

    The scan does not show the motion's form in time: its number of cycles is uniform in 1 to 3, and
    its first pose is anywhere in a cycle.

    Args:
        rng: of cycles and phase.
        drift: whether held links drift as in the figures.
        share: of the number of poses that are used.

    Returns:
        Link -> sweep.
    """
    return {
        link: sweep._replace(
            cycles=float(rng.uniform(1.0, 3.0)), phase=float(rng.uniform(0.0, 2.0 * np.pi)),
            poses=round(share * sweep.poses),
        )
        for link, sweep in (SWEEPS if drift else STILL).items()
    }  # fmt: skip


def bend_level_joints(
    loop: Loop, clean: Clean, rng: np.random.Generator, degrees: float = 1.0, share: float = 0.35,
    lasting: bool = False,
) -> np.ndarray:  # fmt: skip
    """Draw errors of bent joints as Khoshzaban 1992 section 3.7.3 (p. 61) makes them.

    N(0, 1 deg) is added to grapple and yoke where gravity bends them most: in the poses in which
    the calibrator's arm lies most nearly level.

    Args:
        loop: the true chain.
        clean: true poses.
        rng: of the errors.
        degrees: their standard deviation.
        share: of the poses that are bent; the document gives none.
        lasting: whether a joint has one error in all bent poses, instead of one in each.

    Returns:
        (M, N) errors [rad].
    """
    _, turn = frame_of(loop, len(loop) - 2, clean.theta)
    slope = np.abs(turn[:, 2, 2])  # of the arm's direction along the vertical
    bent = slope <= np.quantile(slope, share)
    extra = np.zeros_like(clean.theta)
    places = [loop.moved, loop.moved + 1]
    drawn = rng.standard_normal((1 if lasting else bent.sum(), 2))
    extra[np.ix_(bent, places)] = np.radians(degrees) * drawn
    return extra


def bend_pulled_in_joints(
    loop: Loop, clean: Clean, sizes: Mapping[str, float], share: float = 0.28
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of joints that bend where the stick is pulled in (Khoshzaban 1992, p. 69).

    The error grows linearly with the stick's angle from zero at the edge of the region to its size
    at the largest angle.

    Args:
        loop: the true chain.
        clean: true poses of the stick's stage; the errors of another stage are zero.
        sizes: calibrator joint -> largest error [rad].
        share: of the poses that are in the region.

    Returns:
        (errors (M, N) [rad], whether a pose is in the region (M,)).
    """
    extra, inside = np.zeros_like(clean.theta), np.zeros(len(clean.theta), bool)
    if clean.link == "stick":
        angle = clean.theta[:, loop.links.index("stick")]
        edge = np.quantile(angle, 1.0 - share)
        inside = angle > edge
        depth = np.clip((angle - edge) / (angle.max() - edge), 0.0, None)
        for joint, size in sizes.items():
            extra[:, loop.links.index(joint)] = size * depth
    return extra, inside


def perturb_loop(
    loop: Loop, rng: np.random.Generator, length: float = 0.03, angle: float = 1.0,
    sensors: float = 0.0,
) -> Loop:  # fmt: skip
    """Draw a true chain that differs from the nominal one as a machine built and worn does.

    Lengths of the manipulator and the ball's place differ by N(0, length) [m], its twists and the
    offsets of grapple, yoke and twist by N(0, angle) [deg]. The calibrator's own links, known from
    the laboratory, do not. The manipulator's own sensors read with offsets of N(0, sensors) [deg].
    """
    values, m = loop.values.copy(), loop.moved
    for k in range(m + 1):
        values[k, 2] += length * rng.standard_normal()
        values[k, 1] += np.radians(angle) * rng.standard_normal()
        if k < m and loop.parallel[k]:
            values[k, 4] += np.radians(angle) * rng.standard_normal()
    values[1, 3] += length * rng.standard_normal()
    values[m, 3] += length * rng.standard_normal()
    values[m : m + 3, 0] += np.radians(angle) * rng.standard_normal(3)
    if sensors:
        values[1:m, 0] += np.radians(sensors) * rng.standard_normal(m - 1)
    ball = loop.ball + np.array([1.0, 0.0, 1.0]) * length * rng.standard_normal(3)
    return replace(loop, values=values, ball=ball)


def true_numbers(
    loop: Loop, nominal: Loop, names: Sequence[str], clean: Sequence[Clean]
) -> np.ndarray:
    """Return the true values of identified parameters.

    Args:
        loop: the true chain.
        nominal: the nominal one, whose d a stage's p_z counts from.
        names: (p) of the parameters.
        clean: true poses; a held angle is its mean in the stage that identifies it.

    Returns:
        (p,) [rad] or [m].
    """
    stages = {one.link: one for one in clean}
    found = []
    for name in names:
        kind, _, link = name.partition(".")
        place = loop.links.index(link)
        if kind == "held":
            found.append(float(stages[loop.links[place - 1]].theta[:, place].mean()))
        elif kind in ("p_xy", "p_z"):
            seen = ball_place(loop, place, stages[link].theta[:1, place + 1 :])[0]
            height = seen[2] - loop.values[place, 3] + nominal.values[place, 3]
            found.append(float(np.hypot(*seen[:2]) if kind == "p_xy" else height))
        else:
            found.append(loop.value(name))
    return np.array(found)


TARGETS = tuple(
    (r, z, theta) for r in (4.2, 5.0, 5.8) for z in (1.8, 2.6, 3.4) for theta in (-0.6, 0.5)
)
"""Places of the tip that are asked for: r [m], z [m] above ground, theta [rad]."""


def tip_errors(
    nominal: Machine, true: Machine, loop: Loop, stages: Sequence[Poses]
) -> tuple[float, float]:
    """Return the RMS distance of the true arm's tip from where it is asked to be.

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
