"""Tests of the residuals: which models have effects whose sizes can be compared between runs."""

import numpy as np

from hydrotele.effects.effect import Parameter
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis
from hydrotele.gap.residuals import has_sizes


def test_only_sizes_of_effects_can_be_constant_over_runs():
    size = {"value": Parameter("1", 0.0, -1.0, 1.0, 1.0, 0.1)}
    opened = (Hypothesis("learned_law", "boom", {}), np.zeros(0))
    calibrated = (Hypothesis(CALIBRATION, "", size), np.zeros(1))
    effect = (Hypothesis("payload", "tool", size), np.zeros(1))
    assert not has_sizes(Guess((calibrated, opened)))
    assert has_sizes(Guess((calibrated, opened, effect)))
