"""PaLiDA, the hexapod of Abdellatif 2008.

Published parameters (Table 2), the shipped model with its regressor, and simulated measurements
with force and encoder noise.
"""

import json
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from hydrotele.core.files import models_folder
from hydrotele.identify.excitation import DriveLimits, Excitation
from hydrotele.identify.identifiability import Identifiability, classify_parameters
from hydrotele.identify.mechanism import Mechanism, load_mechanism
from hydrotele.identify.record import IdentificationRecord
from hydrotele.identify.regressor_setup import RegressorSetup
from hydrotele.multibody.closed_chain_kinematics import solve_joint_positions
from hydrotele.multibody.inverse_dynamics import project_on_drives

_MAX_ROWS = 1000  # rows computed together; reused memory is faster than new memory
LEGS = range(1, 7)
PLOTTED_DRIVE = 4  # index of the drive in figures: actuator 5, as in Fig. 11
CHI2_LIMIT = 36.42  # 95 % quantile of chi^2 with 24 degrees of freedom, as printed (5.3)
HOME_POSE = np.array([0.0, 0.0, 0.55, 0.0, 0.0, 0.0])
# Assumed (see the model's README.md): the document gives neither noise nor limits.
SAMPLE_RATE = 1000.0  # Hz
FORCE_NOISE_RATIO = 53.0  # force noise over the published standard deviation of the dry friction
LENGTH_NOISE = 10e-6  # m, standard deviation of a measured leg length
FORCE_NOISE_CORRELATION = 0.6  # correlation of the force noise of any two drives
STROKE, MAX_SPEED, MAX_ACCELERATION = (0.60, 1.06), 1.2, 25.0  # m, m/s, m/s^2 of every drive
POSE_LOW = np.array([-0.20, -0.20, 0.42, -0.35, -0.35, -0.25])  # limits of the pose [m], [rad]
POSE_HIGH = np.array([0.20, 0.20, 0.70, 0.35, 0.35, 0.25])


class PublishedParameter(NamedTuple):
    """One row of Abdellatif 2008, Table 2: an identified parameter, in SI units.

    Attributes:
        symbol: printed symbol.
        column: name of the regressor column that represents this base parameter.
        value: identified value.
        interval: 95 % confidence interval, value -+ 2 standard deviations by (30).
        prior: a-priori value; 0 for friction, which has none. The document prints the prior of p5
            without its sign.
    """

    symbol: str
    column: str
    value: float
    interval: tuple[float, float]
    prior: float = 0.0

    @property
    def std(self) -> float:
        """Standard deviation of the parameter: a quarter of the width of the printed 95 % interval.

        The standard deviations printed in Abdellatif 2008, Table 2, agree with it to rounding
        except for p6 to p9, which are shifted cyclically by one row: p6 has that of p9, p7 that of
        p6, p8 that of p7 and p9 that of p8.
        """
        return 0.25 * (self.interval[1] - self.interval[0])


PUBLISHED_PARAMETERS = (
    PublishedParameter("p1", "inertia_zz.ring_1", -0.0447, (-0.0526, -0.0369), 0.0074),
    PublishedParameter("p2", "inertia_xx.stator_1", 1.0892, (1.0753, 1.1032), 0.9439),
    PublishedParameter("p3", "inertia_zz.stator_1", 1.0077, (0.9988, 1.0166), 0.9458),
    PublishedParameter("p4", "moment_y.stator_1", 0.5995, (0.5922, 0.6068), 0.6201),
    PublishedParameter("p5", "moment_z.slider_1", -1.2885, (-1.2998, -1.2772), -1.2295),
    PublishedParameter("p6", "inertia_xx.platform", 0.3078, (0.3049, 0.3106), 0.2878),
    PublishedParameter("p7", "inertia_yy.platform", 0.3021, (0.2996, 0.3045), 0.2878),
    PublishedParameter("p8", "inertia_zz.platform", 0.1176, (0.1152, 0.1201), 0.1217),
    PublishedParameter("p9", "moment_z.platform", 1.8896, (1.8774, 1.9017), 1.9012),
    PublishedParameter("p10", "mass.platform", 16.3081, (16.2161, 16.4002), 16.1920),
    PublishedParameter("r_alpha", "coulomb.alpha_1", 0.5756, (0.5440, 0.6072)),
    PublishedParameter("r_beta", "coulomb.beta_1", 0.9195, (0.8837, 0.9552)),
    PublishedParameter("r11", "coulomb.slide_1", 11.9772, (11.4803, 12.4742)),
    PublishedParameter("r12", "coulomb.slide_2", 4.8071, (4.4350, 5.1793)),
    PublishedParameter("r13", "coulomb.slide_3", 20.1528, (19.5075, 20.7980)),
    PublishedParameter("r14", "coulomb.slide_4", 5.1518, (4.7884, 5.5151)),
    PublishedParameter("r15", "coulomb.slide_5", 1.5857, (1.0620, 2.1094)),
    PublishedParameter("r16", "coulomb.slide_6", 5.0057, (4.3018, 5.7096)),
    PublishedParameter("r21", "viscous.slide_1", 16.8771, (15.8235, 17.9307)),
    PublishedParameter("r22", "viscous.slide_2", 16.7406, (15.9981, 17.4830)),
    PublishedParameter("r23", "viscous.slide_3", 6.3408, (5.1968, 7.4848)),
    PublishedParameter("r24", "viscous.slide_4", 23.1662, (22.4065, 23.9259)),
    PublishedParameter("r25", "viscous.slide_5", 26.4675, (25.5754, 27.3596)),
    PublishedParameter("r26", "viscous.slide_6", 22.8053, (21.6974, 23.9131)),
)
SYMBOLS = tuple(one.symbol for one in PUBLISHED_PARAMETERS)


@dataclass(frozen=True)
class Robot:
    """The model of the robot PaLiDA and its parameters in the order of Table 2.

    Attributes:
        mechanism: mechanism as loaded by `hydrotele identify --mjcf`, with equal legs and 19
            inertial parameters that are 0 by symmetry.
        base_parameters: base parameters, found from the null space of the regressor.
        order: (24,) position of the parameter of every row of Table 2 in `base_parameters`.
        truth: (24,) base parameter values of the model, in the order of Table 2.
    """

    mechanism: Mechanism
    base_parameters: Identifiability
    order: np.ndarray
    truth: np.ndarray

    @property
    def setup(self) -> RegressorSetup:
        """Setup of the regressor of drive forces in coordinates of the platform's pose."""
        return self.mechanism.setup

    def matrix(self, motion: np.ndarray) -> np.ndarray:
        """Compute the regressor (n, 6, 24): force of each drive per unit of each parameter at n samples.

        The parameters are those of Abdellatif 2008, Table 2.

        Args:
            motion: (3, n, 6) poses, rates and accelerations.
        """
        out, start = [], None
        for first in range(0, motion.shape[1], _MAX_ROWS):
            some = motion[:, first : first + _MAX_ROWS]
            found = project_on_drives(self.setup.chain, self.setup.given_joints, *some, start=start)
            start = found.position[-1]
            out.append(self.setup.compute_regressor(found).matrix[:, :, self.base_parameters.base[self.order]])
        return np.concatenate(out)

    def compute_leg_lengths(self, motion: np.ndarray) -> np.ndarray:
        """Return the leg lengths (n, 6) [m] at platform poses `motion` (n, 6) [m], [rad]."""
        q = solve_joint_positions(self.setup.chain, self.setup.given_joints, motion)
        return q[:, [self.setup.chain.index(name) for name in self.setup.chain.drives]]


def sample_states() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw 100 random poses, rates and accelerations of PaLiDA's platform, each (100, 6), with a fixed seed.

    Poses lie within the limits of the pose, so that all parameters affect the drive forces.
    """
    rng = np.random.default_rng(0)
    poses = 0.5 * (POSE_LOW + POSE_HIGH)
    poses = poses + 0.4 * (POSE_HIGH - POSE_LOW) * rng.uniform(-1.0, 1.0, (100, 6))
    return poses, rng.normal(0.0, 1.0, (100, 6)), rng.normal(0.0, 10.0, (100, 6))


@cache
def load_robot() -> Robot:
    """Load the shipped model of PaLiDA and find its base parameters from 100 random states."""
    folder = models_folder() / "palida"
    mechanism = load_mechanism(folder / "palida.xml", folder / "columns.yaml")
    setup = mechanism.setup
    table = setup.compute_regressor(project_on_drives(setup.chain, setup.given_joints, *sample_states()))
    rows = table.matrix.reshape(-1, len(table.names))
    structure = classify_parameters(rows, table.names, table.units, [one.column for one in PUBLISHED_PARAMETERS])
    names = [table.names[b] for b in structure.base]
    order = np.array([names.index(one.column) for one in PUBLISHED_PARAMETERS])
    return Robot(mechanism, structure, order, (structure.combination @ table.nominal)[order])


def compute_force_covariance() -> np.ndarray:
    """Return the covariance (6, 6) of the noise of PaLiDA's six drive forces [N^2].

    The noise is independent from sample to sample. Abdellatif 2008 calls it high and
    cross-correlated but gives no value. The standard deviations, 10 to 19 N, are proportional to
    the published ones of each drive's dry friction. Their size and the robot's geometry are chosen
    to give about the published standard deviations of the parameters.
    """
    size = FORCE_NOISE_RATIO * np.array([one.std for one in PUBLISHED_PARAMETERS[12:18]])
    return np.outer(size, size) * (FORCE_NOISE_CORRELATION + (1.0 - FORCE_NOISE_CORRELATION) * np.eye(6))


@cache
def load_excitation() -> Excitation:
    """Load the excitation motion of PaLiDA that was designed by `tools/studies/palida_study.py --design 1`."""
    found = json.loads((models_folder() / "palida" / "excitation.json").read_text(encoding="utf-8"))
    mean, sin, cos = (np.array(found[key]) for key in ("mean", "sin", "cos"))
    return Excitation(
        load_robot().setup.given_joints, found["period"], mean, sin, cos, found["criterion"],
        found["worst"], len(PUBLISHED_PARAMETERS),
    )  # fmt: skip


def make_drive_limits() -> DriveLimits:
    """Return PaLiDA's limits of the pose and of the drives' stroke, speed and acceleration, to design motions."""
    return DriveLimits(
        load_robot().setup,
        POSE_LOW,
        POSE_HIGH,
        np.tile(STROKE, (6, 1)),
        MAX_SPEED,
        MAX_ACCELERATION,
    )


class RepeatedMotion(NamedTuple):
    """One period of a repeated motion with n rows.

    Attributes:
        period: length of the period [s].
        motion: (3, n, 6) true poses, rates and accelerations.
        length: (n, 6) true leg lengths [m].
        matrix: (n, 6, 24) true regressor of Table 2's parameters.
        force: (n, 6) true drive forces [N].
    """

    period: float
    motion: np.ndarray
    length: np.ndarray
    matrix: np.ndarray
    force: np.ndarray


def simulate_motion(motion: np.ndarray, period: float) -> RepeatedMotion:
    """Compute PaLiDA's leg lengths, regressor and drive forces along one period of a motion.

    Args:
        motion: (3, n, 6) poses, rates and accelerations.
        period: length of the period [s].
    """
    own = load_robot()
    matrix = own.matrix(motion)
    return RepeatedMotion(period, motion, own.compute_leg_lengths(motion[0]), matrix, matrix @ own.truth)


@cache
def simulate_excitation() -> RepeatedMotion:
    """Compute PaLiDA's noise-free leg lengths, regressor and drive forces in one period of its excitation motion.

    The motion is that of `load_excitation`, sampled at 1 kHz.
    """
    motion = load_excitation()
    time = np.arange(round(motion.period * SAMPLE_RATE)) / SAMPLE_RATE
    return simulate_motion(motion.evaluate(time), motion.period)


def sample_force_noise(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Draw normal random noise of the six drive forces [N] with covariance `compute_force_covariance`.

    The result has the shape (*shape, 6); all samples are independent.
    """
    return rng.standard_normal((*shape, 6)) @ np.linalg.cholesky(compute_force_covariance()).T


def simulate_measurement(
    cycle: RepeatedMotion, periods: int, rng: np.random.Generator,
    feedback_gains: tuple[float, float] = (0.0, 0.0), length_noise: float = LENGTH_NOISE,
) -> IdentificationRecord:  # fmt: skip
    """Simulate a measurement of repeated periods with noise of leg lengths and drive forces.

    Args:
        cycle: one period of the true motion.
        periods: number of repetitions.
        rng: random generator of the noise.
        feedback_gains: controller gains from errors of the measured length [N/m] and of its rate
            [N s/m] to the drive force, which feed encoder noise back into the forces.
        length_noise: standard deviation of a measured leg length [m].

    Returns:
        A record of measured leg lengths [m] and drive forces [N].
    """
    n = len(cycle.length) * periods
    error = length_noise * rng.standard_normal((n, 6))
    noise = sample_force_noise((n,), rng)
    noise -= feedback_gains[0] * error
    noise -= feedback_gains[1] * np.gradient(error, 1.0 / SAMPLE_RATE, axis=0)
    drives = load_robot().setup.chain.drives
    return IdentificationRecord(
        "excitation", 1.0 / SAMPLE_RATE, drives, np.tile(cycle.length, (periods, 1)) + error,
        np.full(6, length_noise), np.tile(cycle.force, (periods, 1)) + noise,
        np.sqrt(np.diag(compute_force_covariance())),
    )  # fmt: skip
