"""What a hand feels: force, displacement and stiffness, each as well as a person can tell it.

A force or a displacement is felt with an error in proportion to its size (Weber's law). Putting
both together to a stiffness adds an error of its own: people resolve compliance by 22 % when they
cannot use work or terminal force (Tan, Durlach, Beauregard and Srinivasan 1995, Perception &
Psychophysics 57), though force alone by some 7 % (Pang, Tan and Durlach 1991, ibid. 49) and limb
movement by 8 % (Jones, Hunter and Irwin 1992, ibid. 52). One exploration gives one impression.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.teleop.operator_parameters import Operator


class Feeling(NamedTuple):
    """Errors of what a hand feels, by decision; n decisions.

    Attributes:
        force: (n,) factor on a felt force.
        displacement: (n,) factor on a felt displacement.
        stiffness: (n,) factor of putting both together.
        share: standard deviation of a felt stiffness, of which he knows [1].
    """

    force: np.ndarray
    displacement: np.ndarray
    stiffness: np.ndarray
    share: float


def feeling(him: Operator, rng: np.random.Generator, count: int, step: float) -> Feeling:
    """Impressions of a run, one per exploration.

    Args:
        him: the operator, with his Weber fractions; an exploration lasts his `dwell`.
        rng: of the impressions.
        count: number of decisions.
        step: between them [s].

    Returns:
        The errors.
    """
    exploration = (step * np.arange(count) / him.dwell).astype(int)
    drawn = rng.standard_normal((exploration[-1] + 1, 3))[exploration]
    weber = np.array([him.force_weber, him.position_weber, him.integration_weber])
    errors = np.exp(weber * drawn)
    return Feeling(*errors.T, share=math.hypot(*weber))


def felt_stiffness(
    force: float, displacement: float, errors: Feeling, number: int
) -> float:  # fmt: skip
    """Stiffness that a hand feels in a spring.

    Args:
        force: on the hand [N].
        displacement: of the hand [m], not 0.
        errors: of what he feels.
        number: of the decision.

    Returns:
        The felt stiffness [N/m].
    """
    felt = force * errors.force[number] / (displacement * errors.displacement[number])
    return float(felt * errors.stiffness[number])
