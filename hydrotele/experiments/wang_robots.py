"""Simulated robots with manufacturing errors, measured with wires, for Wang 2012.

Dimensions, noise and manufacturing errors are assumptions (models/iwr/README.md), because the
available part of the thesis gives none.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.calibrate.hybrid_calibration import calibrate_hybrid_robot
from hydrotele.calibrate.hybrid_measurement import Measurement, measurement_from_wires
from hydrotele.experiments.comparison import (
    Claim,
    Comparison,
    Evaluation,
    Marginals,
    Panel,
    Sample,
)
from hydrotele.kinematics.hybrid_error_model import (
    ErrorModel,
    ErrorModelKind,
    apply_geometry_errors,
    build_error_model,
    refined_model_parameters,
)
from hydrotele.kinematics.hybrid_robot import HybridRobot, forward_kinematics, load_hybrid, pose_difference
from hydrotele.kinematics.wire_measurement import wire_lengths
from hydrotele.simulate.pose_measurements import (
    PLATFORM_TILT,
    default_wires,
    sample_manufacturing_errors,
    sample_poses,
    simulate_measured_poses,
)

SENSOR_NOISE = {"leg": 1e-5, "prismatic": 1e-5, "revolute": 2e-5, "wire": 2e-5}
"""Standard deviations of the sensor noise [m] or [rad]."""

REQUIRED_ACCURACY = 1e-4
"""Required position accuracy [m]: `high accuracy (±0.1 mm) for the assembly robot`, page 19."""

_SEED = 2012


class SimulatedRobot(NamedTuple):
    """A robot with manufacturing errors, and its measurement.

    Attributes:
        model: model of the parameter errors.
        errors: (p,) true parameter errors [model.units].
        robot: robot with these errors.
        measurement: measured poses for the calibration.
        test_commands: carriage joint positions (M, n) and leg readings (M, 6) that command M held-out
            poses, which are not used in the calibration.
    """

    model: ErrorModel
    errors: np.ndarray
    robot: HybridRobot
    measurement: Measurement
    test_commands: tuple[np.ndarray, np.ndarray]


def simulate_robot(
    seed: int, poses: int, kind: ErrorModelKind = "dh", refined_only: bool = True, noise: float = 1.0,
) -> SimulatedRobot:  # fmt: skip
    """Simulate a robot IWR with manufacturing errors and measure its poses with wires.

    The manufacturing errors have standard deviations of 1 mm and 1 mrad.

    Args:
        seed: seed of errors, poses and noise.
        poses: number of poses for the calibration.
        kind: kind of the error model, D-H or POE.
        refined_only: whether only the 36 parameters of the refined model of Wang 2012 have errors.
        noise: factor of the standard deviations in `SENSOR_NOISE`; 0 for exact measurements.

    Returns:
        The robot, its measurement and 25 held-out poses.
    """
    rng, wires, nominal = np.random.default_rng([_SEED, seed]), default_wires(), load_hybrid("iwr")
    model = build_error_model(nominal, kind)
    errors = sample_manufacturing_errors(model, rng, refined_model_parameters(model) if refined_only else None)
    robot = apply_geometry_errors(model, errors)
    sizes = {name: noise * size for name, size in SENSOR_NOISE.items()}
    commands = sample_poses(nominal, poses, rng, wires)
    read = simulate_measured_poses(robot, *commands, wires, sizes, rng)
    stated = sizes if noise > 0.0 else SENSOR_NOISE
    measurement = measurement_from_wires(
        nominal, read.joints, read.legs, read.wires, wires, stated, f"simulated robot {seed}"
    )
    return SimulatedRobot(model, errors, robot, measurement, sample_poses(nominal, 25, rng, wires))


def measure_nominal_robot(poses: int, seed: int, tilt: float = PLATFORM_TILT) -> Measurement:
    """Simulate a measurement of the robot IWR without manufacturing errors and without sensor noise.

    Args:
        poses: number of poses.
        seed: seed of the poses.
        tilt: largest Euler angle of the platform from its home orientation [rad].

    Returns:
        The measurement, whose platform poses are computed from wire lengths.
    """
    robot, wires = load_hybrid("iwr"), default_wires()
    joints, legs = sample_poses(robot, poses, np.random.default_rng([_SEED, seed]), tilt=tilt)
    lengths = wire_lengths(wires, forward_kinematics(robot, joints, legs))
    return measurement_from_wires(robot, joints, legs, lengths, wires, SENSOR_NOISE, "exact")


def compute_test_pose_errors(simulated: SimulatedRobot, robot: HybridRobot) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose errors of a robot model at the M held-out poses of a simulated robot.

    Model and true robot get the same commands of joints and legs.

    Args:
        simulated: true robot with its held-out commands.
        robot: model whose forward kinematics is tested.

    Returns:
        ((M,) position errors [m], (M,) orientation errors [rad]).
    """
    difference = pose_difference(
        forward_kinematics(robot, *simulated.test_commands),
        forward_kinematics(simulated.robot, *simulated.test_commands),
    )
    return np.linalg.norm(difference[:, :3], axis=1), np.linalg.norm(difference[:, 3:], axis=1)


def count_errors_within_intervals(seed: int) -> tuple[int, int]:
    """Count how many true parameter errors lie within the 95 % intervals of a least-squares calibration.

    The 36 parameters of the refined D-H model of a simulated robot IWR are calibrated from 25 poses.

    Args:
        seed: seed of the simulated robot.

    Returns:
        (number of true errors inside their intervals, number of parameters).
    """
    simulated = simulate_robot(1000 + seed, 25)
    names = refined_model_parameters(simulated.model)
    fit = calibrate_hybrid_robot(load_hybrid("iwr"), simulated.measurement, "dh", names).fit
    truth = simulated.errors[simulated.model.parameter_indices(fit.names)]
    return int(np.sum((truth > fit.intervals[:, 0]) & (truth < fit.intervals[:, 1]))), len(names)


def compute_rms(values: np.ndarray) -> float:
    """Return the root mean square of an array."""
    return float(np.sqrt(np.mean(np.square(values))))


Drawing = Callable[[Sequence[Sample]], tuple[tuple[Panel, ...], Marginals | None]]


@dataclass(frozen=True)
class DrawnClaim(Claim):
    """A claim whose curves are computed from all samples by the function `draw`.

    Attributes:
        draw: samples -> (panels, posterior samples or None); None for a claim without curves.
    """

    draw: Drawing | None = None

    def compare(self, samples: Sequence[Sample]) -> Comparison:
        """Evaluate the claim, and return its row of the result table with the curves that `draw` computes."""
        row = super().compare(samples)
        panels, marginals = self.draw(samples) if self.draw else ((), None)
        return row._replace(panels=panels, marginals=marginals)


def make_caption_claim(
    name: str, item: str, quote: str, note: Callable[[Sequence[Sample]], str],
    draw: Drawing | None = None,
) -> Claim:  # fmt: skip
    """Return a claim without verdict for a table or figure of which only the caption is available.

    Args:
        name: name of the claim.
        item: table or figure with its page.
        quote: caption, in quotation marks.
        note: samples -> text with the simulated values.
        draw: samples -> (curves, posterior samples to draw or None); None for no curves.
    """
    return DrawnClaim(
        name, item=item, quote=quote, kind="caption", draw=draw,
        evaluate=lambda samples: Evaluation(note=note(samples)),
    )  # fmt: skip
