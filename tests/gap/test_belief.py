"""How far effects are believed where something is lacking still."""

import numpy as np
import pytest

from hydrotele.effects.effect import Parameter
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis
from hydrotele.gap.residuals import believed, believed_part, has_sizes
from hydrotele.gap.result import LearnedLaw, NamedEffect

LEFT = {"": 0.05, "boom": 0.02, "stick": 0.6}


def effect(name, location, probability=0.95):
    return NamedEffect(name, location, probability, {})


def law(axis, share):
    return LearnedLaw("force", axis, "", "", "", "", np.zeros(0), np.zeros(0), np.zeros(0), "N", "", share)


def chances(named, laws=(), left=LEFT, lost=("stick",)):
    return {e.name: e.probability for e in believed(named, laws, left, lost)}


def test_without_anything_lacking_nothing_changes():
    named = (effect("hose_compliance", "stick"), effect("viscous_friction", "boom"))
    assert believed(named, (), LEFT, ()) == named


def test_an_effect_that_leaves_much_of_its_axis_is_hardly_believed():
    named = (effect("hose_compliance", "stick"), effect("viscous_friction", "boom"))
    found = chances(named)
    assert found["hose_compliance"] < 1e-3
    assert found["viscous_friction"] == 0.95, "another axis' channels are predicted well"


def test_the_right_effect_in_another_form_leaves_little_and_is_believed():
    assert chances([effect("hose_compliance", "boom")], lost=("boom",))["hose_compliance"] > 0.9


def test_what_a_law_had_to_close_the_effect_left():
    named = [effect("hose_compliance", "boom")]
    assert chances(named, [law("boom", 0.5)], lost=("boom",))["hose_compliance"] < 0.01
    assert chances(named, [law("swing", 0.5)], lost=("boom",))["hose_compliance"] > 0.9


def test_several_effects_of_one_axis_share_what_they_do_together():
    named = [effect(name, "boom") for name in ("command_offset", "flow_curve", "valve_gain")]
    assert max(chances(named, lost=("boom",)).values()) < 0.34


def test_an_effect_that_does_most_by_itself_is_no_piece_of_another():
    named = [effect("force_pulse", "boom", 0.999), effect("friction_asymmetry", "boom", 0.9)]
    assert min(chances(named, lost=("boom",)).values()) > 0.8


def test_effects_of_all_axes_are_judged_by_all_channels():
    found = chances([effect("bulk_modulus", "all")], left={"": 0.5, "stick": 0.6})
    assert found["bulk_modulus"] < 0.01


@pytest.mark.parametrize(("part", "low", "high"), [(0.1, 0, 0.1), (0.35, 0.49, 0.51), (0.7, 0.9, 1)])
def test_the_part_of_what_was_lacking(part, low, high):
    assert low < believed_part(part) < high


def test_only_sizes_of_effects_can_be_constant_over_runs():
    size = {"value": Parameter("1", 0.0, -1.0, 1.0, 1.0, 0.1)}
    opened = (Hypothesis("learned_law", "boom", {}), np.zeros(0))
    calibrated = (Hypothesis(CALIBRATION, "", size), np.zeros(1))
    effect = (Hypothesis("payload", "tool", size), np.zeros(1))
    assert not has_sizes(Guess((calibrated, opened)))
    assert has_sizes(Guess((calibrated, opened, effect)))
