"""Probabilities of an effect and its rivals, and the fraction of a gap that an effect explains."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hydrotele.effects import Parameter
from hydrotele.estimate.evidence import Judged
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.gap import rivals
from hydrotele.gap.rivals import moved_last, part_taken, weights

_SEGMENTS = 80


def test_a_model_that_is_better_in_every_segment_is_certain():
    """Better by 1 in each of 80 segments, 80 in all: the weights of the segments hardly matter."""
    base = np.full(_SEGMENTS, 100.0)
    assert weights([base - 1.0, base], [10.0, 0.0])[0] > 0.999


def test_a_model_that_is_better_in_two_segments_only_is_not_certain():
    """The same 80 in two segments: the weights of both may be small."""
    ahead = np.full(_SEGMENTS, 100.0)
    ahead[[10, 50]] -= 40.0
    chances = weights([ahead, np.full(_SEGMENTS, 100.0)], [10.0, 0.0])
    assert 0.6 < chances[0] < 0.99
    plain = 1.0 / (1.0 + np.exp(-0.5 * (80.0 - 10.0)))
    assert plain > 0.999999  # by the likelihood alone


def test_penalties_count_and_probabilities_sum_to_one():
    """With equal likelihoods the odds are exp(penalty / 2)."""
    same = np.full(_SEGMENTS, 3.0)
    chances = weights([same, same, same], [0.0, 2.0, 4.0])
    assert chances.sum() == pytest.approx(1.0)
    assert chances[1] / chances[0] == pytest.approx(np.exp(-1.0), rel=1e-9)  # rounding
    assert chances[2] / chances[0] == pytest.approx(np.exp(-2.0), rel=1e-9)


def test_a_constant_in_all_models_changes_nothing():
    rng = np.random.default_rng(2)
    table = rng.normal(size=(3, _SEGMENTS))
    own = weights(list(table), [0.0, 1.0, 2.0])
    moved = weights(list(table + rng.normal(size=_SEGMENTS)), [0.0, 1.0, 2.0])
    np.testing.assert_allclose(moved, own, rtol=1e-9)  # rounding


@pytest.mark.parametrize(("after", "ideal", "part"), [
    (900.0, 0.0, 0.1),
    (900.0, 880.0, 100 / 120),  # nearly nothing is left
    (900.0, 950.0, 1.0),  # nothing is missing any more
    (1010.0, 0.0, -0.01),  # worse
])  # fmt: skip
def test_the_fraction_that_an_effect_explains_is_relative_to_a_perfect_model(monkeypatch, after, ideal, part):
    monkeypatch.setattr(rivals, "undisturbed_loss", lambda track: track.ideal)
    tracks: Any = (SimpleNamespace(ideal=0.25 * ideal), SimpleNamespace(ideal=0.75 * ideal))
    now, more = Judged(Guess(), (), 1000.0), Judged(Guess(), tracks, after)
    assert part_taken(now, more) == pytest.approx(part)


def test_the_parameters_of_a_part_are_moved_to_the_end():
    one = Parameter("1", 0.0, -9.0, 9.0, 1.0, 0.0)
    sizes = {"first": ("a", "b"), "second": ("c",), "third": ("d",)}
    parts = [(Hypothesis(n, "", dict.fromkeys(keys, one)), np.zeros(len(keys))) for n, keys in sizes.items()]
    found = moved_last(np.arange(16.0).reshape(4, 4), Guess(tuple(parts)), 0)
    np.testing.assert_array_equal(np.diag(found), [10.0, 15.0, 0.0, 5.0])
