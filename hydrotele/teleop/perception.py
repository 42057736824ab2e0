"""Perception of force, displacement and stiffness by a hand, with errors in proportion to their size (Weber's law).

Combining force and displacement to a stiffness adds another error. People resolve compliance by 22 %
when they cannot use work or terminal force (Tan, Durlach, Beauregard and Srinivasan 1995, Perception
& Psychophysics 57). They resolve force alone by some 7 % (Pang, Tan and Durlach 1991, ibid. 49) and
limb movement by 8 % (Jones, Hunter and Irwin 1992, ibid. 52). The errors stay constant during one
exploration of the handle.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.teleop.operator_parameters import Operator


class PerceptionErrors(NamedTuple):
    """Random errors of perceived forces, displacements and stiffnesses in n decisions.

    Attributes:
        force: (n,) factor on the perceived force.
        displacement: (n,) factor on the perceived displacement.
        stiffness: (n,) additional factor on a perceived stiffness, due to the combination of force
            and displacement.
        stiffness_deviation: relative standard deviation of a perceived stiffness, known to the operator [1].
    """

    force: np.ndarray
    displacement: np.ndarray
    stiffness: np.ndarray
    stiffness_deviation: float


def draw_perception_errors(operator: Operator, rng: np.random.Generator, count: int, step: float) -> PerceptionErrors:
    """Draw random perception errors for all decisions of a run.

    They are log-normal and constant during one exploration of the handle.

    Args:
        operator: operator with Weber fractions (relative standard deviations of perceived quantities);
            an exploration lasts `correction_interval`.
        rng: random generator of the errors.
        count: number of decisions.
        step: time between two decisions [s].

    Returns:
        The errors.
    """
    exploration = (step * np.arange(count) / operator.correction_interval).astype(int)
    drawn = rng.standard_normal((exploration[-1] + 1, 3))[exploration]
    weber = np.array([operator.force_weber, operator.position_weber, operator.integration_weber])
    errors = np.exp(weber * drawn)
    return PerceptionErrors(*errors.T, stiffness_deviation=math.hypot(*weber))


def perceive_stiffness(
    force: float, displacement: float, errors: PerceptionErrors, decision: int
) -> float:  # fmt: skip
    """Return the stiffness of a spring as a hand perceives it: force over displacement, with errors.

    Args:
        force: force on the hand [N].
        displacement: displacement of the hand [m], not 0.
        errors: perception errors.
        decision: number of the decision.

    Returns:
        The perceived stiffness [N/m].
    """
    felt = force * errors.force[decision] / (displacement * errors.displacement[decision])
    return float(felt * errors.stiffness[decision])
