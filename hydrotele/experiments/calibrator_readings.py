"""Simulate calibrator readings with sensor errors, bent joints, drift and manufacturing errors.

The calibrator is a passive arm with angle sensors. It connects the manipulator's tool to a ball
joint on the chassis, which closes the kinematic chain. The module uses only the kinematics of this
chain, which is fast enough for many seeds. The same chain with masses and hydraulics in MuJoCo is
`models/calibrator`. The module also computes the tip error of an arm positioned with a nominal or a
calibrated machine. Ground truth is used only to generate readings and to evaluate estimates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from hydrotele.calibrate.arm_identification import identify_arm, identify_jointly
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.calibration_loop import CalibrationLoop, ball_position_from_axis, build_loop, frame_after_links
from hydrotele.calibrate.link_sweeps import DRIFT_FREE_SWEEPS, PUBLISHED_SWEEPS, Sweep, SweepPoses
from hydrotele.calibrate.machine_correction import calibrated_machine
from hydrotele.control.arm_kinematics import pose_to_joints
from hydrotele.machine.machine import Machine
from hydrotele.scenario.pilots import Pose
from hydrotele.simulate.mechanism import TIP_SITE, assemble_mjcf, mjcf_document

MAX_RESOLVER_ERROR = np.radians(0.1)
"""Largest error of a resolver, uniformly distributed [rad]; Khoshzaban 1992, section 2.5."""


def simulate_readings(
    loop: CalibrationLoop, clean: SweepPoses, rng: np.random.Generator | None, accuracy: float = MAX_RESOLVER_ERROR,
    extra_errors: np.ndarray | None = None,
) -> Poses:  # fmt: skip
    """Simulate the sensor readings of one calibration stage, in which one link moves.

    Args:
        loop: true chain; its offsets are the sensor offsets.
        clean: true poses (M poses of N joints).
        rng: random generator of the errors, uniform within +-accuracy; None for no errors.
        accuracy: largest error of every angle sensor [rad].
        extra_errors: (M, N) additional errors, such as those of bent joints [rad].

    Returns:
        The readings of all poses: true angle minus sensor offset plus errors. The joint `pitch` has no
        sensor and therefore no readings.
    """
    shown = clean.theta - loop.values[:, 0]
    if extra_errors is not None:
        shown = shown + extra_errors
    if rng is not None:
        shown = shown + rng.uniform(-accuracy, accuracy, shown.shape)
    sigma = np.full(len(loop) - loop.powered_count, accuracy / np.sqrt(3.0))
    return Poses(
        clean.link, shown[:, loop.powered_count :], sigma,
        {name: shown[:, k] for k, name in enumerate(loop.links[: loop.powered_count]) if name != "pitch"},
        accuracy / np.sqrt(3.0), f"simulated {clean.link}",
    )  # fmt: skip


def sample_sweeps(rng: np.random.Generator, drift: bool = True, pose_fraction: float = 1.0) -> dict[str, Sweep]:
    """Draw a random back-and-forth motion of every link within the ranges of Khoshzaban 1992, Figs 16 to 18.

    The scanned figures do not show the motion over time. The number of cycles is therefore drawn
    uniformly from 1 to 3, and the phase of the first pose uniformly from a whole cycle.

    Args:
        rng: random generator of cycles and phase.
        drift: whether held links drift as in the figures.
        pose_fraction: fraction of the published number of poses.

    Returns:
        Moving link -> sweep: its range, the angles and drifts of held links, and number of poses.
    """
    return {
        link: sweep._replace(
            cycles=float(rng.uniform(1.0, 3.0)), phase=float(rng.uniform(0.0, 2.0 * np.pi)),
            poses=round(pose_fraction * sweep.poses),
        )
        for link, sweep in (PUBLISHED_SWEEPS if drift else DRIFT_FREE_SWEEPS).items()
    }  # fmt: skip


def sample_gravity_bends(
    loop: CalibrationLoop, clean: SweepPoses, rng: np.random.Generator, deviation_deg: float = 1.0,
    bent_fraction: float = 0.35,
    constant: bool = False,
) -> np.ndarray:  # fmt: skip
    """Draw random angle errors of joints bent by gravity, as in Khoshzaban 1992, section 3.7.3 (p. 61).

    The errors of the grapple and yoke joints are drawn from N(0, `deviation_deg`) in the poses in which
    gravity bends them most. In these poses the calibrator's arm is closest to horizontal. All other
    errors are 0.

    Args:
        loop: true chain.
        clean: true poses (M poses of N joints).
        rng: random generator of the errors.
        deviation_deg: standard deviation of the errors [deg].
        bent_fraction: fraction of the poses in which joints bend, which the thesis does not state.
        constant: whether a joint has the same error in all bent poses.

    Returns:
        (M, N) errors of all joints in all poses [rad].
    """
    _, turn = frame_after_links(loop, len(loop) - 2, clean.theta)
    slope = np.abs(turn[:, 2, 2])  # of the arm's direction along the vertical
    bent = slope <= np.quantile(slope, bent_fraction)
    extra = np.zeros_like(clean.theta)
    places = [loop.powered_count, loop.powered_count + 1]
    drawn = rng.standard_normal((1 if constant else bent.sum(), 2))
    extra[np.ix_(bent, places)] = np.radians(deviation_deg) * drawn
    return extra


def compute_retraction_bends(
    loop: CalibrationLoop,
    clean: SweepPoses,
    max_errors: Mapping[str, float],
    bent_fraction: float = 0.28,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute angle errors of joints that bend when the stick is retracted (Khoshzaban 1992, p. 69).

    The stick is retracted at large stick angles. The bent region holds the fraction `bent_fraction` of
    the poses with the largest stick angles. The error increases linearly with the stick angle, from zero
    at the edge of this region to its largest value at the largest angle.

    Args:
        loop: true chain.
        clean: true poses (M poses of N joints); the errors are zero unless the stick moves.
        max_errors: calibrator joint -> largest error [rad].
        bent_fraction: fraction of the poses in the bent region.

    Returns:
        (errors (M, N) [rad], whether a pose is in the bent region (M,)).
    """
    extra, inside = np.zeros_like(clean.theta), np.zeros(len(clean.theta), bool)
    if clean.link == "stick":
        angle = clean.theta[:, loop.links.index("stick")]
        edge = np.quantile(angle, 1.0 - bent_fraction)
        inside = angle > edge
        depth = np.clip((angle - edge) / (angle.max() - edge), 0.0, None)
        for joint, size in max_errors.items():
            extra[:, loop.links.index(joint)] = size * depth
    return extra, inside


def perturb_loop(
    loop: CalibrationLoop, rng: np.random.Generator, length_deviation: float = 0.03, angle_deviation: float = 1.0,
    sensor_offset: float = 0.0,
) -> CalibrationLoop:  # fmt: skip
    """Draw a true chain with random manufacturing and wear errors relative to the nominal chain.

    All errors are normal with mean zero. The calibrator's links are known and get no length errors.

    Args:
        loop: nominal chain.
        rng: random generator of the errors.
        length_deviation: standard deviation of the manipulator's lengths and of the ball's x and z [m].
        angle_deviation: standard deviation of the manipulator's twists and of the sensor offsets of
            grapple, yoke and twist joint [deg].
        sensor_offset: standard deviation of the offsets of the manipulator's sensors [deg].

    Returns:
        The true chain.
    """
    values, m = loop.values.copy(), loop.powered_count
    for k in range(m + 1):
        values[k, 2] += length_deviation * rng.standard_normal()
        values[k, 1] += np.radians(angle_deviation) * rng.standard_normal()
        if k < m and loop.parallel[k]:
            values[k, 4] += np.radians(angle_deviation) * rng.standard_normal()
    values[1, 3] += length_deviation * rng.standard_normal()
    values[m, 3] += length_deviation * rng.standard_normal()
    values[m : m + 3, 0] += np.radians(angle_deviation) * rng.standard_normal(3)
    if sensor_offset:
        values[1:m, 0] += np.radians(sensor_offset) * rng.standard_normal(m - 1)
    ball = loop.ball + np.array([1.0, 0.0, 1.0]) * length_deviation * rng.standard_normal(3)
    return replace(loop, values=values, ball=ball)


def find_true_parameters(
    loop: CalibrationLoop,
    nominal: CalibrationLoop,
    names: Sequence[str],
    clean: Sequence[SweepPoses],
) -> np.ndarray:
    """Return the true values of the parameters that a calibration identifies.

    Args:
        loop: true chain.
        nominal: nominal chain. A stage's ball height p_z is relative to the nominal length d of the
            moving link, which the calibration cannot separate from p_z.
        names: (p) names of the parameters.
        clean: true poses of every stage; the true value of a held link's angle is its mean in the stage
            in which the link before it moves.

    Returns:
        (p,) true values [rad] or [m].
    """
    stages = {one.link: one for one in clean}
    found = []
    for name in names:
        kind, _, link = name.partition(".")
        place = loop.links.index(link)
        if kind == "held":
            found.append(float(stages[loop.links[place - 1]].theta[:, place].mean()))
        elif kind in ("p_xy", "p_z"):
            seen = ball_position_from_axis(loop, place, stages[link].theta[:1, place + 1 :])[0]
            height = seen[2] - loop.values[place, 3] + nominal.values[place, 3]
            found.append(float(np.hypot(*seen[:2]) if kind == "p_xy" else height))
        else:
            found.append(loop.value(name))
    return np.array(found)


TIP_TARGETS = tuple((r, z, theta) for r in (4.2, 5.0, 5.8) for z in (1.8, 2.6, 3.4) for theta in (-0.6, 0.5))
"""Tip target positions: r [m], z [m] above ground, theta [rad]."""


def compute_tip_errors(
    nominal: Machine, true: Machine, loop: CalibrationLoop, stages: Sequence[Poses]
) -> tuple[float, float]:
    """Return the RMS distance of the true arm's tip from the `TIP_TARGETS`, before and after calibration.

    The inverse kinematics of the nominal or the calibrated machine converts each target to joint angles.
    The true joints are set so that the sensors, corrected by the offsets that this machine knows, read
    these angles. MuJoCo then computes the tip position of the true machine.

    Args:
        nominal: nominal machine.
        true: true machine.
        loop: true chain; its offsets are the sensor offsets.
        stages: readings used for the calibration.

    Returns:
        (RMS distance with the nominal machine, RMS distance with the calibrated machine) [m].
    """
    known = build_loop(nominal)
    hierarchical = identify_arm(known, stages)
    fit = identify_jointly(hierarchical, stages)
    made = calibrated_machine(nominal, fit, stages)
    document = mjcf_document(assemble_mjcf(true, ground=False, visuals=False))
    model = document.compile()
    data = mujoco.MjData(model)
    sums = []
    for machine in (nominal, made):
        squares = [_compute_squared_tip_error(machine, known, loop, model, data, target) for target in TIP_TARGETS]
        sums.append(float(np.sqrt(np.mean(squares))))
    return sums[0], sums[1]


def _compute_squared_tip_error(
    machine: Machine, known: CalibrationLoop, loop: CalibrationLoop, model, data, target
) -> float:
    """Return the squared distance [m^2] of the true arm's tip from a target position.

    The commanded joint angles are computed with `machine`, a nominal or calibrated model. MuJoCo
    computes the tip of the true machine, whose sensors read these angles.
    """
    r, z, theta = target
    here = {name: machine.home.get(axis.joint, 0.0) for name, axis in machine.axes.items()}
    joints = pose_to_joints(machine, Pose(r=r, z=z, theta=theta), here, "target")
    data.qpos[:] = 0.0
    for k, link in enumerate(loop.links[: loop.powered_count]):
        if link not in joints:
            continue
        error = machine.sensor_errors.get(loop.channels[k])
        shown = joints[link] + (error.offset if error else 0.0)
        offset = (loop.values[k, 0] - known.values[k, 0]) * loop.signs[k]  # of the true sensor
        data.qpos[model.joint(loop.joints[k]).qposadr[0]] = shown + offset
    mujoco.mj_kinematics(model, data)
    tip = data.site_xpos[model.site(TIP_SITE).id]
    return float(np.sum((tip - (r * np.cos(theta), r * np.sin(theta), z)) ** 2))
