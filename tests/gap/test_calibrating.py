"""Numbers of a calibration that stop at the end of their range."""

from types import SimpleNamespace

import numpy as np
import pytest

from hydrotele.effects import Parameter
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis, calibration, hypotheses
from hydrotele.gap.calibrating import (
    _further,
    _gain_of_freedom,
    ended,
    given_again,
    let_out,
    taken_back,
)
from hydrotele.machine.machine_file import load_machine


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


class Given:
    """Evidence of a machine alone."""

    data = SimpleNamespace(machine=load_machine("cat215"))


@pytest.mark.parametrize(("sizes", "back"), [
    (-0.97, True),  # a valve's gain 4.9 % below the model's, which is uncertain by 5 %
    (-3.1, False),  # more than three times what is stated
])  # fmt: skip
def test_an_effect_that_a_calibration_let_out_is_taken_back_as_it_was(sizes, back):
    machine = Given.data.machine
    group = calibration(machine)
    deviation = 0.1 * np.arange(group.size) / group.size
    deviation[list(group.parameters).index("valve_gain.swing.ratio")] = sizes
    guess = Guess(((group, deviation),))
    gain = next(h for h in hypotheses(machine) if h.key == ("valve_gain", "swing"))
    out = let_out(Given(), guess, 0, gain)
    assert out.hypotheses[0].size == group.size - 1
    again = taken_back(out, machine, 1)
    if not back:
        assert again is None
        return
    assert [h.parameters for h in again.hypotheses] == [group.parameters]
    np.testing.assert_allclose(again.deviation, deviation, rtol=0.0, atol=1e-12)


def test_what_no_calibration_knows_is_not_taken_back():
    machine = Given.data.machine
    group = calibration(machine)
    offset = next(h for h in hypotheses(machine) if h.name == "command_offset")
    guess = Guess(((group, np.zeros(group.size)), (offset, np.array([0.1]))))
    assert taken_back(guess, machine, 1) is None
    assert taken_back(guess, machine, 0) is None, "the calibration itself"
    assert taken_back(Guess(((offset, np.array([0.1])),)), machine, 0) is None, "none there"
