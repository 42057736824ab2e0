"""Probabilities of explanations: better in a few places only is not surely better."""

import numpy as np
import pytest

from hydrotele.gap.rivals import weights

_STRETCHES = 80


def test_better_everywhere_is_sure():
    """Better by 1 in each of 80 stretches, 80 in all; a draw of the stretches hardly matters."""
    base = np.full(_STRETCHES, 100.0)
    assert weights([base - 1.0, base], [10.0, 0.0])[0] > 0.999


def test_better_in_two_stretches_only_is_not_sure():
    """The same 80 in two stretches: a draw leaves both out with probability e^-2 = 0.14 or so."""
    better = np.full(_STRETCHES, 100.0)
    better[[10, 50]] -= 40.0
    chances = weights([better, np.full(_STRETCHES, 100.0)], [10.0, 0.0])
    assert 0.6 < chances[0] < 0.99
    plain = 1.0 / (1.0 + np.exp(-0.5 * (80.0 - 10.0)))
    assert plain > 0.999999  # what the likelihood alone would say


def test_charges_count_and_chances_sum_to_one():
    """With the same likelihood everywhere only the charge tells: odds exp(charge / 2)."""
    same = np.full(_STRETCHES, 3.0)
    chances = weights([same, same, same], [0.0, 2.0, 4.0])
    assert chances.sum() == pytest.approx(1.0)
    assert chances[1] / chances[0] == pytest.approx(np.exp(-1.0), rel=1e-9)  # rounding
    assert chances[2] / chances[0] == pytest.approx(np.exp(-2.0), rel=1e-9)


def test_a_constant_in_all_changes_nothing():
    rng = np.random.default_rng(2)
    table = rng.normal(size=(3, _STRETCHES))
    own = weights(list(table), [0.0, 1.0, 2.0])
    moved = weights(list(table + rng.normal(size=_STRETCHES)), [0.0, 1.0, 2.0])
    np.testing.assert_allclose(moved, own, rtol=1e-9)  # rounding
