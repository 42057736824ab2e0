"""Numbers of a calibration that stop at the end of their range."""

import numpy as np
import pytest

from hydrotele.effects import Parameter
from hydrotele.estimate.calibration import CALIBRATION
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.gap.calibrating import _further, _gain_of_freedom, ended, given_again


def number(name: str, high: float = 6.0) -> Hypothesis:
    """One number whose nominal is 0, from 0 to `high`, in units of its uncertainty."""
    return Hypothesis(name, "stick", {"value": Parameter("N", 0.0, 0.0, high, 1.0, 0.1)})


class OneNumber:
    """Evidence whose only error is how far a number is from the true one."""

    def __init__(self, true: float) -> None:
        self.true = true

    def step_of(self, guess: Guess, step: float) -> float:
        return step

    def map(self, function, items):
        return [function(item) for item in items]

    def errors(self, guess: Guess, step: float) -> np.ndarray:
        return guess.deviation - self.true


def test_a_number_at_its_end_is_told_from_one_within():
    for deviation, at_end in ((6.0, True), (5.9, False), (0.0, False)):
        guess = Guess(((number(CALIBRATION), np.array([deviation])),))
        assert ended(guess) is at_end
    assert not ended(Guess(((number("coulomb_friction"), np.array([6.0])),)))


def test_how_far_a_number_would_go_is_tried():
    guess = Guess(((number("coulomb_friction", 100.0), np.array([6.0])),))
    further, fall = _further(OneNumber(25.0), guess)
    assert further.deviation.tolist() == [24.0] and fall == 1.0 - 19.0**2
    same, none = _further(OneNumber(5.0), guess)
    assert same.deviation.tolist() == [6.0] and none == 0.0


def test_the_gain_of_freedom_is_the_ratio_of_evidences():
    """Against both evidences of a linear model, by the determinants of their readings."""
    rng = np.random.default_rng(4)
    slopes, ratio, free = rng.normal(size=(30, 4)), np.array([0.25, 0.6]), [0, 2]
    slopes[:, 3] = slopes[:, 0] + 0.3 * rng.normal(size=30)  # does nearly the same
    readings = slopes @ np.array([6.0, 0.5, -2.0, 0.0]) + rng.normal(size=30)
    widths = np.ones(4)

    def loss():
        spread = np.eye(30) + (slopes * widths**2) @ slopes.T
        return readings @ np.linalg.solve(spread, readings) + np.linalg.slogdet(spread)[1]

    covariance = np.linalg.inv(slopes.T @ slopes + np.eye(4))
    deviation = covariance @ slopes.T @ readings
    gain = _gain_of_freedom(deviation[free], covariance[np.ix_(free, free)], ratio)
    before = loss()
    widths[free] = 1.0 / ratio
    assert gain == pytest.approx(before - loss(), rel=1e-9)  # rounding


def test_numbers_of_an_axis_are_given_again_and_those_of_others_and_effects_stay():
    names = ("mass.stick", "mass.boom.rod", "bulk_modulus.all")
    table = {name: Parameter("1", 0.0, -3.0, 3.0, 1.0, 0.0) for name in names}
    group, effect = Hypothesis(CALIBRATION, "all", table), number("payload")
    guess = Guess(((group, np.array([1.0, 2.0, 3.0])), (effect, np.array([4.0]))))
    again = given_again(guess, ["boom"])
    assert again.hypotheses == guess.hypotheses
    np.testing.assert_array_equal(again.deviation, [1.0, 0.0, 3.0, 4.0])
