"""Data processing of Abdellatif 2008: compute the platform's motion from measured leg lengths.

The module compares unfiltered, time-domain and frequency-domain processing (sections 4.1 and 5.2,
Figs 6 and 7).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from hydrotele.experiments.comparison import Changes, Claim, Evaluation, Experiment, Panel, Sample, merge_settings
from hydrotele.experiments.palida import (
    PLOTTED_DRIVE,
    POSE_HIGH,
    POSE_LOW,
    SAMPLE_RATE,
    RepeatedMotion,
    compute_force_covariance,
    load_robot,
    simulate_excitation,
    simulate_measurement,
    simulate_motion,
)
from hydrotele.experiments.statistical_checks import check_bootstrapped_statistic, check_mean, collect_values
from hydrotele.identify.joint_motion import Processing, compute_joint_motion, estimate_resolution
from hydrotele.identify.linear_least_squares import estimate_linear_parameters
from hydrotele.identify.mechanism import convert_to_given_joints
from hydrotele.identify.record import IdentificationRecord

HARMONICS = 5
"""Number of harmonics of the excitation and of the frequency window (section 5.2)."""
METHOD_NAMES = {"raw": "raw", "zero_phase": "time domain", "periodic": "frequency domain"}
MAX_VISIBLE_ERROR = 0.01
"""Largest RMS error over RMS signal that counts as "almost no noise": a printed line's width."""
Y_AXIS = 1  # index of y in the pose; Fig. 6 shows y
CIRCLE_SPEED, CIRCLE_RADIUS = 0.5, 0.10  # m/s and m; the circle is a validation motion


class AveragedPeriod(NamedTuple):
    """One averaged period of motion and force.

    Attributes:
        motion: (3, n, 6) poses, rates and accelerations.
        force: (n, 6) mean force over all periods [N].
        covariance: (6, 6) noise covariance of one force reading, from the differences between
            periods [N^2].
    """

    motion: np.ndarray
    force: np.ndarray
    covariance: np.ndarray


def average_periods(record: IdentificationRecord, period: float) -> AveragedPeriod:
    """Average repeated periods and filter the pose in the frequency domain.

    Leg lengths and forces are averaged over the periods. Forward kinematics converts the mean leg lengths
    to poses. The first five harmonics of the pose are kept and differentiated.

    Args:
        record: leg lengths and forces of at least two whole periods.
        period: length of one period [s].

    Returns:
        Motion, mean force and force noise covariance of one period.

    Source: Abdellatif 2008, section 4.1, (27).
    """
    rows = round(period / record.period)
    length, force = (part.reshape(-1, rows, 6).copy() for part in (record.position, record.force))
    mean, covariance = average_force_over_periods(force)
    averaged = replace(record, position=length.mean(axis=0), force=mean)
    return AveragedPeriod(compute_motion_from_lengths(averaged, period, "periodic"), mean, covariance)


def average_force_over_periods(force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Average repeated periods of the drive forces, and estimate the noise covariance of one reading.

    Args:
        force: (p, n, 6) forces of p periods [N].

    Returns:
        ((n, 6) mean force over the periods [N], (6, 6) covariance of the noise [N^2]).
    """
    mean = force.mean(axis=0)
    rest = (force - mean).reshape(-1, 6)
    return mean, rest.T @ rest / ((len(force) - 1) * len(mean))


def compute_motion_from_lengths(
    record: IdentificationRecord, period: float, method: str, harmonics: int = HARMONICS
) -> np.ndarray:
    """Compute poses, rates and accelerations of the platform from measured leg lengths.

    Args:
        record: record with the leg lengths.
        period: period of the motion [s].
        method: `raw` (no filter), `zero_phase` (time domain) or `periodic` (frequency domain).
        harmonics: number of harmonics that `periodic` keeps.

    Returns:
        (3, n, 6) poses, rates and accelerations of the platform at the n samples of the record.
    """
    pose = convert_to_given_joints(record, load_robot().setup)
    found = estimate_resolution(pose.position, pose.period, pose.position_noise)
    processing = (
        Processing("periodic", period=period, harmonics=harmonics) if method == "periodic"
        else Processing(method)  # pyright: ignore[reportArgumentType]
    )  # fmt: skip
    smoothed = compute_joint_motion(pose.position, pose.period, found, processing)
    return np.stack([smoothed.value, smoothed.rate, smoothed.acceleration])


@cache
def simulate_circle() -> RepeatedMotion:
    """Compute PaLiDA's noise-free leg lengths and drive forces along one lap of a horizontal circle.

    The circle has a radius of 0.1 m and a constant tool speed of 0.5 m/s. It is the motion on which
    identified models are validated.
    """
    rows = round(2.0 * np.pi * CIRCLE_RADIUS / CIRCLE_SPEED * SAMPLE_RATE)
    angle = 2.0 * np.pi * np.arange(rows) / rows
    speed = 2.0 * np.pi * SAMPLE_RATE / rows
    motion = np.zeros((3, rows, 6))
    motion[0] = 0.5 * (POSE_LOW + POSE_HIGH)
    for order in range(3):
        phase = angle + 0.5 * np.pi * order
        turned = np.stack([np.cos(phase), np.sin(phase)], axis=1)
        motion[order, :, :2] += CIRCLE_RADIUS * speed**order * turned
    return simulate_motion(motion, rows / SAMPLE_RATE)


def compare_processing_methods(seed: int, changes: Changes) -> Sample:
    """Compare unfiltered, time-domain and frequency-domain processing of measured leg lengths.

    With each method the motion is reconstructed and a model is identified, which then predicts the
    drive forces on a circle.

    Args:
        seed: seed of the measurement noise.
        changes: `harmonics`: number of harmonics that the frequency-domain method keeps.

    Returns:
        Per method, `METHOD 0`, `METHOD 1` and `METHOD 2`: standard deviation of the error of the
        reconstructed y coordinate, its rate and its acceleration, over that of the true signal.
        `METHOD variance` and `METHOD true variance`: mean squared difference of the predicted force on
        the circle from the measured and from the true force, over all drives [N^2].
    """
    settings = merge_settings({"harmonics": HARMONICS}, changes)
    cycle, lap, own, periods = simulate_excitation(), simulate_circle(), load_robot(), 2
    rng = np.random.default_rng([7, seed])
    record = simulate_measurement(cycle, periods, rng)
    check = simulate_measurement(lap, 3, rng)
    rows, middle = len(cycle.force), slice(len(lap.force), 2 * len(lap.force))
    true = cycle.motion[:, :, Y_AXIS]
    values, rebuilt, predicted = {}, {}, {}
    for way in METHOD_NAMES:
        motion = compute_motion_from_lengths(record, cycle.period, way, settings["harmonics"])
        rebuilt[way] = motion[:, :rows, Y_AXIS]
        for order, error in enumerate(rebuilt[way] - true):
            values[f"{way} {order}"] = float(np.std(error) / np.std(true[order]))
        value = estimate_linear_parameters(own.matrix(motion), record.force, compute_force_covariance(), order=0).value
        circle = compute_motion_from_lengths(check, lap.period, way, settings["harmonics"])[:, middle]
        force = own.matrix(circle) @ value
        values[f"{way} variance"] = float(np.mean((force - check.force[middle]) ** 2))
        values[f"{way} true variance"] = float(np.mean((force - lap.force) ** 2))
        predicted[way] = force[:, PLOTTED_DRIVE]
    panels = (*_draw_reconstruction(rebuilt, true, record.force[:rows, PLOTTED_DRIVE], cycle.period,
                                    settings["harmonics"]),
              *_draw_prediction(predicted, check.force[middle, PLOTTED_DRIVE]))  # fmt: skip
    return Sample(values, panels)


_DERIVATIVE_LABELS = ("y [m]", "rate of y [m/s]", "acceleration of y [m/s^2]")


def _draw_reconstruction(
    rebuilt: dict[str, np.ndarray], true: np.ndarray, force: np.ndarray, period: float,
    harmonics: int,
) -> list[Panel]:  # fmt: skip
    """Draw amplitude spectra of measured motion and force, and the reconstructed y coordinate with its errors."""
    lines = np.arange(1, 6 * HARMONICS + 1)
    frequency = lines / period
    panels, spectrum = [], 2.0 * np.fft.rfft(rebuilt["raw"][0])[lines] / true.shape[1]
    spectra = [np.abs(spectrum * (2.0 * np.pi * frequency) ** order) for order in range(3)]
    for label, amplitude in zip(_DERIVATIVE_LABELS, spectra, strict=True):
        window = np.where(lines <= harmonics, amplitude.max(), np.nan)
        panels.append(Panel(f"amplitude of {label}", frequency,
                            {"measured": amplitude, "window": window}, "frequency [Hz]", log=True,
                            discrete=True))  # fmt: skip
    amplitude = np.abs(2.0 * np.fft.rfft(force)[lines] / len(force))  # forces are not filtered
    panels.append(Panel("amplitude of force of drive 5 [N]", frequency, {"measured": amplitude},
                        "frequency [Hz]", log=True, discrete=True))  # fmt: skip
    time = np.arange(true.shape[1]) / SAMPLE_RATE
    for order, label in enumerate(_DERIVATIVE_LABELS):
        panels.append(Panel(
            label, time, {"frequency domain": rebuilt["periodic"][order], "true": true[order]},
            errors={METHOD_NAMES[way]: rebuilt[way][order] - true[order] for way in METHOD_NAMES if way != "raw"},
            error_label=f"error of {label}",
        ))  # fmt: skip
    return panels


def _draw_prediction(predicted: dict[str, np.ndarray], force: np.ndarray) -> list[Panel]:
    time = np.arange(len(force)) / SAMPLE_RATE
    return [
        Panel(
            f"force of drive 5, {METHOD_NAMES[way]} [N]",
            time,
            {"measured": force, "predicted": one},
        )
        for way, one in predicted.items()
    ]


def evaluate_reconstruction(samples: Sequence[Sample]) -> Evaluation:
    """Check that frequency-domain filtering reconstructs y, its rate and acceleration to 1 %.

    y is a coordinate of the platform. The standard deviation of the error must be at most 1 % of that of
    the true signal.
    """
    checks = tuple(
        check_mean(f"relative RMS error of {label.partition(' [')[0]}",
                   collect_values(samples, f"periodic {order}"), (0.0, MAX_VISIBLE_ERROR),
                   '"almost no noise": below the width of a printed line, 1 % of the signal')
        for order, label in enumerate(_DERIVATIVE_LABELS)
    )  # fmt: skip
    others = ", ".join(
        f"{np.mean(collect_values(samples, f'{way} 2')):.2g} {METHOD_NAMES[way]}" for way in ("raw", "zero_phase")
    )
    return Evaluation(checks, note=f"acceleration by the other methods: {others}")


def evaluate_prediction(samples: Sequence[Sample]) -> Evaluation:
    """Check that frequency-domain processing predicts forces best and unfiltered processing worst.

    The criterion is the mean squared error of the predicted against the measured drive forces on a
    circle that the models were not identified from. Frequency-domain must be below time-domain, and
    time-domain below unfiltered processing (geometric mean of the ratio over repetitions).
    """
    checks = tuple(
        check_bootstrapped_statistic(
            f"error variance of the predicted force, {METHOD_NAMES[one]} over {METHOD_NAMES[other]}",
            collect_values(samples, f"{one} variance") / collect_values(samples, f"{other} variance"),
            lambda ratios: float(np.exp(np.mean(np.log(ratios)))), (0.0, 1.0),
            "smaller")
        for one, other in (("periodic", "zero_phase"), ("zero_phase", "raw"))
    )  # fmt: skip
    measured, true = (
        ", ".join(f"{np.mean(collect_values(samples, f'{way} {kind}')):.3g} N^2 {words}"
                  for way, words in METHOD_NAMES.items())
        for kind in ("variance", "true variance")
    )  # fmt: skip
    return Evaluation(checks, note=f"variance of measured minus predicted force: {measured}; of true"
                     f" minus predicted force: {true}")  # fmt: skip


PROCESSING = Experiment(
    "data processing",
    compare_processing_methods,
    (
        Claim(
            "reconstruction of the motion",
            '"The effectiveness of the proposed filter is obvious, since the calculated signals'
            ' exhibit almost no noise or disturbance corruption."',
            "Fig. 6, section 5.2", "document", evaluate_reconstruction,
            {"harmonics": 200}, "the frequency filter keeps 200 instead of 5 harmonics",
            (*(f"amplitude of {label}" for label in (*_DERIVATIVE_LABELS, "force of drive 5 [N]")),
            *_DERIVATIVE_LABELS),
        ),
        Claim(
            "prediction on a circle",
            '"The frequency-domain processing yields the best prediction quality corresponding to'
            ' the smallest error variance σ2 . Time-domain filtering is not accurate enough to'
            ' extract all information at the relevant frequencies."',
            "Fig. 7, section 5.2", "document", evaluate_prediction,
            {"harmonics": 200}, "the frequency filter keeps 200 instead of 5 harmonics",
            tuple(f"force of drive 5, {words} [N]" for words in METHOD_NAMES.values()),
        ),
    ),
    max_repetitions=10,
)  # fmt: skip
