"""Detection and removal of corrupted calibrator readings.

The fitted chain predicts the readings of the calibrator's sensors. With the moving joint's own
sensor, each pose gives three equations: the ball's distance from the moving axis, its height along
the axis, and its angle about the axis. A region is a sequence of poses with significantly large
residuals. The faulty joint is the one whose sensor error explains most of these residuals.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.stats

from hydrotele.calibrate.arm_identification import (
    ArmFit,
    StageEquations,
    assemble_fit,
    candidate_parameters,
    check_poses,
    classify_candidates,
    identify_stage,
    initial_parameters,
    sort_stages,
)
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.calibration_loop import CalibrationLoop, ball_position_and_derivatives

FALSE_ALARM_PROBABILITY = 0.005
"""Probability of finding a region in a complete measurement without corruption."""

_MAX_ROUNDS = 8
_CONSISTENT_FRACTION = 0.6  # fraction of the poses used by the first, robust fit of a stage
_MIN_EXCESS_RATIO = 2.0  # squared residual over its expected value, above which a pose adds to a region
_MIN_DEVIATION = 1.0e-4  # m, as in `arm`
_ANGLE_ZERO_STD = 1.0e3  # prior standard deviation over noise of the third equation's unknown zero
_OUTLIER_RATIO = 16.0  # squared residual over its typical value, above which a pose is an outlier
_MAX_CHI2_DIFFERENCE = 20.0  # chi-square difference that excludes a joint: probability of 1 in 20 000
_MAX_REMOVED_FRACTION = 0.7  # maximum fraction of a stage's poses that may be left out


class CorruptedRegion(NamedTuple):
    """Sequence of poses with corrupted readings in a stage, the poses while one link moves.

    Attributes:
        link: the moving link.
        first: index of the first pose in the stage.
        last: index of the last pose, included.
        joint: the calibrator joint whose sensor is wrong; empty for the moving link's own sensor.
        size: root mean square error of this sensor [rad].
        explained: fraction of the region's squared residual that this sensor's error explains [1].
        possible: all joints that the poses do not exclude, the most likely first; joints whose
            axes are parallel in all poses of a region cannot be distinguished.
    """

    link: str
    first: int
    last: int
    joint: str
    size: float
    explained: float
    possible: tuple[str, ...]


class CleanedFit(NamedTuple):
    """Result of an identification without corrupted poses.

    Attributes:
        fit: hierarchical fit of the remaining poses.
        stages: the remaining poses, by moving link.
        regions: the sequences of poses with corrupted readings. Their poses were left out, except
            where only the moving link's own sensor is wrong (`joint` is empty).
    """

    fit: ArmFit
    stages: list[Poses]
    regions: list[CorruptedRegion]


class WhitenedResiduals(NamedTuple):
    """Residuals of all M poses of a stage, scaled to unit variance if sensor noise is the only error.

    Attributes:
        rows: (M, E) residuals; E is 3 with the moving joint's sensor, otherwise 2.
        by_readings: (M, E, S) derivatives by the calibrator's readings [1/rad].
        by_own_reading: (M, E) derivatives by the moving joint's reading [1/rad], zero for E = 2.
    """

    rows: np.ndarray
    by_readings: np.ndarray
    by_own_reading: np.ndarray


class ParameterUncertainty(NamedTuple):
    """Names of p parameters and their covariance (p, p)."""

    names: tuple[str, ...]
    covariance: np.ndarray


def whitened_residuals(
    loop: CalibrationLoop,
    poses: Poses,
    parameters: Mapping[str, float],
    known: ParameterUncertainty | None = None,
) -> WhitenedResiduals:
    """Compute the residuals of a stage's poses (one moving link), scaled to unit variance by the sensor noise.

    Each pose has the equations of the distance of the calibrator's end (the ball) from the moving
    joint's axis and of its height along it. If that joint has a sensor, the equation of the ball's
    angle about the axis is added, which is not part of the identification. Residuals due to parameter
    uncertainty are removed: the parameters are moved within their covariance to fit the majority of
    the poses.

    Args:
        loop: the nominal chain.
        poses: poses of the stage.
        parameters: parameter values of a fit, by name.
        known: names and covariance of the uncertain parameters; None to take all as exact.

    Returns:
        Residuals and derivatives, whitened.
    """
    equations = StageEquations(loop, poses)
    error, slopes, sensed = equations.residual_and_jacobian(parameters)
    own = np.zeros((len(poses), 2))
    spread = sensed * poses.sigma[..., None, :]
    covariance = spread @ spread.transpose(0, 2, 1) + _MIN_DEVIATION**2 * np.eye(2)
    if poses.link in poses.manipulator:
        seen, theta = equations.chain_and_angles(parameters)
        s, by = ball_position_and_derivatives(seen, equations.place, theta)
        reach = np.hypot(s[:, 0], s[:, 1])
        around = np.stack([-s[:, 1], s[:, 0]], 1) / reach[:, None]
        by_sensed = by[:, :, loop.powered_count - equations.place :, 0]
        angle = np.unwrap(np.arctan2(s[:, 1], s[:, 0]) + poses.manipulator[poses.link])
        third = reach * angle - (poses.drift.ball[:, 2] if poses.drift else 0.0)
        third = reach.mean() * (third / reach)
        third = third - np.median(third)
        turn = around[:, 0, None] * by_sensed[:, 0] + around[:, 1, None] * by_sensed[:, 1]
        tangent = around[:, 0, None, None] * by[:, 0] + around[:, 1, None, None] * by[:, 1]
        slopes = np.concatenate([slopes, tangent[:, None]], axis=1)
        error = np.column_stack([error, third])
        sensed = np.concatenate([sensed, turn[:, None]], axis=1)
        own = np.stack([0.0 * reach, 0.0 * reach, reach], axis=1)
        spread = sensed * poses.sigma[..., None, :]
        covariance = spread @ spread.transpose(0, 2, 1) + _MIN_DEVIATION**2 * np.eye(3)
        covariance[:, 2, 2] += (reach * poses.manipulator_sigma) ** 2
    whitening = np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)
    rows = (whitening @ error[..., None])[..., 0]
    if known and len(known.names):
        rows = _remove_parameter_errors(
            rows, whitening @ equations.select_parameter_derivatives(slopes, known.names), known.covariance
        )
    return WhitenedResiduals(rows, whitening @ sensed, (whitening @ own[..., None])[..., 0])


def _remove_parameter_errors(rows: np.ndarray, slopes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Subtract the part of the residuals (M, E) that parameter errors within their covariance explain.

    Args:
        rows: (M, E) whitened residuals.
        slopes: (M, E, p) their derivatives by the parameters.
        covariance: (p, p) covariance of the parameters.

    Returns:
        (M, E) remaining residuals. Poses whose squared residual exceeds 16 times its typical value
        do not affect the parameter change. For E = 3 the unknown zero of the angle is removed, too.
    """
    root = np.linalg.cholesky(covariance + 1.0e-18 * np.eye(len(covariance)))
    scaled = slopes @ root
    if rows.shape[1] == 3:  # the zero of the third equation is unknown
        third = np.zeros((*rows.shape, 1))
        third[:, 2, 0] = _ANGLE_ZERO_STD
        scaled = np.concatenate([scaled, third], axis=2)
    count = scaled.shape[2]
    left, usual = rows, scipy.stats.chi2.median(rows.shape[1])
    for _ in range(4):
        square = np.sum(left**2, axis=1)
        near = square < _OUTLIER_RATIO * max(1.0, float(np.median(square)) / usual)
        matrix = scaled[near].reshape(-1, count)
        move = np.linalg.solve(np.eye(count) + matrix.T @ matrix, -matrix.T @ rows[near].ravel())
        left = rows + scaled @ move
    return left


def find_corrupted_regions(
    loop: CalibrationLoop, poses: Poses, parameters: Mapping[str, float], total: int,
    false_alarm: float = FALSE_ALARM_PROBABILITY,
    known: ParameterUncertainty | None = None,
) -> list[CorruptedRegion]:  # fmt: skip
    """Find sequences of poses (regions) whose residuals are too large to be sensor noise.

    A score is summed along the poses: the squared residual of a pose minus twice its expected value.
    If the median squared residual exceeds that of sensor noise, squared residuals are first divided
    by this ratio. Ranges of poses with the largest sums are regions if the sum exceeds a threshold.
    Noise alone exceeds it in a fraction `false_alarm` of the measurements (extreme value of a random
    walk with negative drift).

    Args:
        loop: the nominal chain.
        poses: all poses of a stage.
        parameters: parameters of a fit.
        total: number of poses of the whole measurement.
        false_alarm: probability of a region in a measurement without corruption.
        known: uncertainty of the fit's parameters.

    Returns:
        The regions in the order of the poses, each with the joint whose sensor is probably wrong.

    Source: Karlin and Altschul 1990 (high-scoring segments).
    """
    found = whitened_residuals(loop, poses, parameters, known)
    square, freedom = np.sum(found.rows**2, axis=1), found.rows.shape[1]
    usual = max(1.0, float(np.median(square)) / scipy.stats.chi2.median(freedom))
    score = square / usual - _MIN_EXCESS_RATIO * freedom
    rate = scipy.optimize.brentq(
        lambda r: -0.5 * freedom * np.log1p(-2.0 * r) - _MIN_EXCESS_RATIO * freedom * r,
        0.05,
        0.4999,
    )
    threshold = np.log(total / false_alarm) / rate
    regions = []
    for first, last in _find_high_segments(score, threshold):
        regions.append(_attribute_region_to_joint(loop, poses, found, first, last))
    return regions


def _find_high_segments(score: np.ndarray, threshold: float) -> list[tuple[int, int]]:
    """Return disjoint ranges (first, last index) with the largest sums of scores, each above a threshold.

    The range with the largest sum is found first, then those in the parts before and after it. The
    last index is included.
    """
    found: list[tuple[int, int]] = []
    waiting = [(0, len(score))]
    while waiting:
        low, high = waiting.pop()
        best, first, last = _max_sum_segment(score[low:high])
        if best > threshold:
            found.append((low + first, low + last))
            waiting += [(low, low + first), (low + last + 1, high)]
    return sorted(found)


def _max_sum_segment(score: np.ndarray) -> tuple[float, int, int]:
    """Return sum, first and last index (included) of the contiguous range of scores with the largest sum."""
    best, first, last = -np.inf, 0, -1
    run, begin = 0.0, 0
    for k, value in enumerate(score):
        if run <= 0.0:
            run, begin = 0.0, k
        run += value
        if run > best:
            best, first, last = run, begin, k
    return best, first, last


def _attribute_region_to_joint(
    loop: CalibrationLoop, poses: Poses, found: WhitenedResiduals, first: int, last: int
) -> CorruptedRegion:
    """Build the region of poses `first` to `last`, and find the joint whose sensor error explains it best.

    Each joint's error in every pose is fitted to the residuals `found`. The selected calibrator joint
    leaves the smallest squared residual. The moving link's own sensor is selected instead only if
    the squared residual that it leaves is smaller by more than 20.
    """
    inside = slice(first, last + 1)
    rows = found.rows[inside]
    whole = float(np.sum(rows**2))
    explained, errors = {}, {}
    names = list(loop.links[loop.powered_count :])
    slopes = {name: found.by_readings[inside, :, k] for k, name in enumerate(names)}
    if rows.shape[1] == 3:
        slopes[""] = found.by_own_reading[inside]
    for name, slope in slopes.items():
        length = np.maximum(np.sum(slope**2, axis=1), 1.0e-12)
        error = np.sum(slope * rows, axis=1) / length
        explained[name] = float(np.sum(error**2 * length) / whole)
        errors[name] = error
    left = {name: whole * (1.0 - part) for name, part in explained.items()}
    best = min((n for n in left if n), key=lambda name: left[name])
    if left.get("", np.inf) < left[best] - _MAX_CHI2_DIFFERENCE:
        best = ""  # only if clear, because the calibrator is under test
    usual = max(1.0, left[best] / max(1, rows.size - len(rows)))
    order = sorted(left, key=lambda name: left[name])
    possible = tuple(n for n in order if n and left[n] - left[best] < _MAX_CHI2_DIFFERENCE * usual)
    size = float(np.sqrt(np.mean(errors[best] ** 2)))
    return CorruptedRegion(poses.link, first, last, best, size, explained[best], possible if best else ("",))


def identify_without_bad_data(
    loop: CalibrationLoop, stages: Sequence[Poses], false_alarm: float = FALSE_ALARM_PROBABILITY
) -> CleanedFit:
    """Identify the arm link by link without corrupted poses, which are found in each stage first.

    Regions are sequences of poses whose residuals are too large to be sensor noise. A stage with
    regions is first refitted to its poses with the smallest residuals, so that a fit to corrupted
    poses does not mask them. Poses of regions in which only the moving link's own sensor is wrong
    stay in the fit, because the identification does not use that sensor.

    Args:
        loop: the nominal chain.
        stages: all poses, one item (stage) per moving link.
        false_alarm: probability of a region in a measurement without corruption.

    Returns:
        The fit, the remaining poses, and the regions.

    Raises:
        InputError: as in `identify_arm`.
    """
    order = sort_stages(loop, stages)
    for poses in order:
        check_poses(loop, poses)
    numbers = initial_parameters(loop, order)
    start = dict(numbers)
    total = sum(map(len, order))
    names: tuple[str, ...] = ()
    covariance = np.zeros((0, 0))
    parts, kept_stages, regions = [], [], []
    for poses in order:
        wanted = candidate_parameters(loop, poses.link)
        at = start | {n: numbers[n] for n in names}
        told = classify_candidates(StageEquations(loop, poses), at, wanted)
        own = [told.names[k] for k in sorted(told.base)]

        def fit_kept_poses(kept, near, numbers=numbers, poses=poses, own=own, told=told,
                  wanted=wanted, names=names, covariance=covariance):  # fmt: skip
            return identify_stage(
                StageEquations(loop, poses.select(kept)), numbers, own, names, covariance, told, wanted,
                start_is_close=near,
            )  # fmt: skip

        kept = np.ones(len(poses), bool)
        found = fit_kept_poses(kept, False)
        every = (*names, *own)
        inside = find_corrupted_regions(
            loop, poses, found[1], total, false_alarm, ParameterUncertainty(every, found[2])
        )
        if inside:
            found, inside = _refit_until_regions_stable(
                loop, poses, fit_kept_poses, found, total, false_alarm, every, own
            )
        kept = _mask_uncorrupted_poses(inside, len(poses))
        found = fit_kept_poses(kept, True) if inside else found
        stage, numbers, covariance = found
        names = (*names, *own)
        parts.append(stage)
        kept_stages.append(poses.select(kept))
        regions += inside
    fit = assemble_fit(loop, numbers, start, names, covariance, parts, "hierarchical")
    return CleanedFit(fit, kept_stages, regions)


def _refit_until_regions_stable(loop, poses, solve, found, total, false_alarm, names, own):
    """Alternate between the fit of a stage and the search for corrupted regions until the regions stay the same.

    The first three fits use only the poses with the smallest residuals, at least 60 %. The search
    also ends after eight rounds, or before a fit from which more than 70 % of the poses would be
    removed.

    Args:
        loop: the nominal chain.
        poses: all poses of the stage.
        solve: function of a mask of poses, and whether the start is close, to a fit as returned by
            `identify_stage`.
        found: fit of all poses, as returned by `solve`.
        total: number of poses of the whole measurement.
        false_alarm: probability of a region in a measurement without corruption.
        names: names of the parameters identified in this and earlier stages.
        own: names of the parameters identified in this stage.

    Returns:
        (last fit, as returned by `solve`; the regions whose poses it omits).
    """
    for _ in range(3):
        known = ParameterUncertainty(names, found[2])
        square = np.sum(whitened_residuals(loop, poses, found[1], known).rows ** 2, axis=1)
        width = max(5, len(poses) // 40)
        smooth = np.convolve(np.pad(square, width, mode="edge"), np.ones(2 * width + 1), "valid")
        core = smooth <= np.quantile(smooth, max(_CONSISTENT_FRACTION, min(1.0, 3.0 * len(own) / len(poses))))
        found = solve(core, True)
    inside: list[CorruptedRegion] = []
    for _ in range(_MAX_ROUNDS):
        fresh = find_corrupted_regions(loop, poses, found[1], total, false_alarm, ParameterUncertainty(names, found[2]))
        kept = _mask_uncorrupted_poses(fresh, len(poses))
        if [r[:3] for r in fresh] == [r[:3] for r in inside] or kept.mean() < 1.0 - _MAX_REMOVED_FRACTION:
            break
        inside = fresh
        found = solve(kept, True)
    return found, inside


def _mask_uncorrupted_poses(regions: Sequence[CorruptedRegion], count: int) -> np.ndarray:
    """Return a mask (count,), true for poses outside all regions with a faulty calibrator sensor."""
    kept = np.ones(count, bool)
    for region in regions:
        if region.joint:
            kept[region.first : region.last + 1] = False
    return kept


def predict_reading_from_others(loop: CalibrationLoop, poses: Poses, parameters: Mapping[str, float]) -> np.ndarray:
    """Predict the reading of each calibrator sensor from those of the other sensors at the same pose.

    Args:
        loop: the nominal chain.
        poses: poses of a stage.
        parameters: parameters of a fit.

    Returns:
        (M, S) readings [rad]: for each sensor the value that best satisfies the pose's equations,
        linearised at the readings, while the other sensors keep their readings.
    """
    found = whitened_residuals(loop, poses, parameters)
    length = np.maximum(np.sum(found.by_readings**2, axis=1), 1.0e-12)
    return poses.theta - np.einsum("mes,me->ms", found.by_readings, found.rows) / length
