"""Regressors and simulated motions of the CAT 215 for chapter 4 of Khoshzaban 1992.

The complete model has 82 parameters: ten inertial parameters of each of seven bodies, Coulomb
friction of three drives and six pins, and three force offsets. The reduced model contains only the
major links: ten inertial parameters of each of three bodies, friction and offset of three drives.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from hydrotele.identify.identifiability import Identifiability, classify_parameters, reference_sizes
from hydrotele.identify.regressor_setup import DynamicModel, RegressorSetup, machine_setup
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.regressor import FrictionTerm, Regressor, passive_friction_terms
from hydrotele.simulate.closed_loops import load_closed_chain

DRIVES = ("swing", "boom", "stick")
UNITS = ("N m", "N", "N")
SAMPLE_PERIOD = 0.02
"""Sample period [s] (p. 21, 50 Hz)."""

DURATION = 5.0
"""Duration of the simulated motion [s] (Figs 30 to 32)."""

_DEG = np.pi / 180.0
# Ranges of start and end [deg] and of the largest rate [rad/s] of swing, boom and stick in this
# project's signs, from the axis limits of Figs 30 to 32.
_START_ANGLES = ((-40.0, -20.0), (0.0, 10.0), (-50.0, -25.0))
_END_ANGLES = ((0.0, 20.0), (40.0, 50.0), (-150.0, -100.0))
_PEAK_RATES = ((0.3, 0.4), (0.3, 0.4), (1.0, 1.5))
_QUINTIC_PEAK = 1.875  # largest rate of a fifth-order polynomial of unit travel and duration

Motion = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Positions, rates and accelerations (n, 3) of swing, boom and stick [rad], [rad/s], [rad/s^2]."""


@cache
def make_thesis_regressor_setup(
    model: DynamicModel = "complete", ball_joints: bool = True, tilt_deg: float = 0.0
) -> RegressorSetup:
    """Return the setup of the regressor in Khoshzaban 1992, chapter 4, for the CAT 215.

    Args:
        model: `complete` (82 parameters) or `reduced` to the major links (36).
        ball_joints: whether the cylinders end in ball joints, as in Khoshzaban 1992, or in pins.
        tilt_deg: slope of the ground, about the machine's y axis.

    Returns:
        The setup; friction and offsets are zero, as in Khoshzaban 1992, Table 13.

    Source: Khoshzaban 1992, p. 92, Eq. 4.23; pp. 97 to 98, Eqs 4.51 to 4.56.
    """
    machine = load_machine("cat215")
    chain = load_closed_chain(machine)
    slope = np.array([np.sin(_DEG * tilt_deg), 0.0, np.cos(_DEG * tilt_deg)])
    gravity = -float(np.linalg.norm(chain.tree.gravity)) * slope
    chain = replace(chain, tree=chain.tree._replace(gravity=gravity))
    setup = machine_setup(machine, chain, model, ball_joints=ball_joints)
    rubbing = [FrictionTerm(joint, {"coulomb": 0.0}) for joint in chain.drives]
    if model == "complete":
        rubbing += passive_friction_terms(chain)
    return replace(setup, friction_terms=tuple(rubbing))


def make_regressor(setup: RegressorSetup, motion: Motion) -> Regressor:
    """Compute the regressor of the drive forces of swing, boom and stick along a motion."""
    return setup.compute_regressor(setup.project_motion_on_drives(*motion))


def stack_rows(table: Regressor) -> np.ndarray:
    """Return the regressor of n samples, three drives and m parameters as a (3 n, m) matrix, rows by sample."""
    return table.matrix.reshape(-1, len(table.names))


def sample_states(count: int, seed: int = 0) -> Motion:
    """Draw independent random poses, rates and accelerations of swing, boom and stick, uniformly distributed.

    Args:
        count: number n of states.
        seed: seed of the random generator.

    Returns:
        Poses within the machine's ranges, rates within +-1 rad/s, accelerations within
        +-2 rad/s^2.
    """
    rng = np.random.default_rng(seed)
    low, high = np.array([-3.0, -0.7, -2.6]), np.array([3.0, 1.0, -0.5])
    return (rng.uniform(low, high, (count, 3)), rng.uniform(-1.0, 1.0, (count, 3)),
            rng.uniform(-2.0, 2.0, (count, 3)))  # fmt: skip


def sample_motion(rng: np.random.Generator) -> Motion:
    """Draw a random motion of swing, boom and stick within the axis limits of Khoshzaban 1992, Figs 30 to 32.

    The curves are not legible in the available text. Start, end and largest rate are drawn within
    the axis limits. All links move from rest to rest by fifth-order polynomials and then hold their
    final position.

    Args:
        rng: random generator.

    Returns:
        Motion of five seconds at 50 Hz.
    """
    start, end, peak = (
        np.array([rng.uniform(*pair) for pair in pairs])
        for pairs in (_START_ANGLES, _END_ANGLES, _PEAK_RATES)
    )  # fmt: skip
    start, way = _DEG * start, _DEG * (end - start)
    lasting = np.minimum(_QUINTIC_PEAK * np.abs(way) / peak, DURATION)
    s = np.clip(np.arange(0.0, DURATION, SAMPLE_PERIOD)[:, None] / lasting, 0.0, 1.0)
    return (
        start + way * (10 * s**3 - 15 * s**4 + 6 * s**5),
        way * (30 * s**2 - 60 * s**3 + 30 * s**4) / lasting,
        way * (60 * s - 180 * s**2 + 120 * s**3) / lasting**2,
    )


def join_motions(motions: Sequence[Motion]) -> Motion:
    """Concatenate motions along time."""
    position, rate, acceleration = (np.concatenate(parts) for parts in zip(*motions, strict=True))
    return position, rate, acceleration


def scale_cylinder_inertia(table: Regressor, scale: float, bodies: Sequence[str] | None = None):
    """Return the parameters (m,) with the inertial parameters of the cylinders' tubes and rods scaled.

    Args:
        table: regressor with the nominal parameters.
        scale: factor of mass, mass moments and inertia.
        bodies: tubes and rods to scale; all by default.
    """
    places = [name.partition(".")[2] for name in table.names]
    bars = [p for p in places if p.endswith(("_tube", "_rod"))] if bodies is None else bodies
    inertial = [n.startswith(("mass.", "moment_", "inertia_")) for n in table.names]
    chosen = np.array(inertial) & np.isin(places, bars)
    return np.where(chosen, scale * table.nominal, table.nominal)


@dataclass(frozen=True)
class BaseParameters:
    """Base parameters of a model: a minimal set that determines the drive forces.

    Attributes:
        setup: setup of the regressor.
        classification: identifiability of all parameters.
        names: (p,) names of the parameters whose regressor columns represent the base parameters.
        truth: (p,) base parameters of the CAT 215 without friction, as in Khoshzaban 1992, Table 13.
        sizes: (p,) typical magnitudes of the base parameters, with which their errors are compared.
    """

    setup: RegressorSetup
    classification: Identifiability
    names: tuple[str, ...]
    truth: np.ndarray
    sizes: np.ndarray

    def estimate(self, motion: Motion, forces: np.ndarray) -> np.ndarray:
        """Estimate the base parameters by least squares.

        Args:
            motion: measured positions, rates and accelerations of n samples.
            forces: (n, 3) measured torque and forces [N m], [N]; or (c, n, 3) for c cases.

        Returns:
            (p,) or (c, p) estimates. Columns are scaled to length 1, and singular values at
            rounding level are treated as zero.

        Source: Khoshzaban 1992, p. 99, Eq. 4.58; p. 100.
        """
        rows = self.build_regressor(motion)
        length = np.linalg.norm(rows, axis=0)
        right = forces.reshape(*forces.shape[:-2], -1).T
        q, r = np.linalg.qr(rows / length)
        return np.linalg.lstsq(r, q.T @ right, rcond=_RANK_TOLERANCE)[0].T / length

    def build_regressor(self, motion: Motion) -> np.ndarray:
        """Return the (3 n, p) regressor of the base parameters along a motion of n samples."""
        return stack_rows(make_regressor(self.setup, motion))[:, self.classification.base]


_RANK_TOLERANCE = 1e-13  # relative to the largest singular value: some 100 times the rounding of doubles
_RANDOM_STATES = 300  # random states; each gives three equations for at most 82 parameters


@cache
def find_base_parameters(model: DynamicModel, ball_joints: bool = True) -> BaseParameters:
    """Find the base parameters of the complete or the reduced model from its regressor at random states.

    Args:
        model: `complete` or `reduced`.
        ball_joints: whether the cylinders end in ball joints, otherwise in pins.

    Returns:
        The base parameters.
    """
    setup = make_thesis_regressor_setup(model, ball_joints)
    table = make_regressor(setup, sample_states(_RANDOM_STATES))
    told = classify_parameters(stack_rows(table), table.names, table.units)
    usual = np.sqrt(np.mean((table.matrix @ table.nominal) ** 2, axis=0))
    return BaseParameters(
        setup, told, tuple(table.names[b] for b in told.base), told.combination @ table.nominal,
        reference_sizes(table, setup, usual)[told.base],
    )  # fmt: skip
