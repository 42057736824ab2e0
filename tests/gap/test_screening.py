"""Screening on made-up signatures, where the best candidate and its size are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from hydrotele.effects import Parameter
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.gap.screening import _spans, busy_window, screen

ROWS, CHANNELS = 400, 3


def candidate(name, low=-3.0):
    return Hypothesis(name, "boom", {"size": Parameter("1", 0.0, low, 3.0, 1.0, 0.01)})


class MadeUp:
    """Evidence whose errors are `errors - sum of signature(d)`; one run, no machine."""

    def __init__(self, errors, signatures):
        self.tracks = (SimpleNamespace(whitened=errors.reshape(ROWS, CHANNELS)),)
        self.signatures = signatures

    def errors(self, guess, step, tracks):
        del step
        left = np.concatenate([track.whitened.ravel() for track in tracks])
        for hypothesis, (d,) in guess.parts:
            left = left - self.signatures[hypothesis.name](d)
        return left

    def base_slopes_of(self, tracks):
        """The one part of `test_what_is_there_may_follow_a_candidate`."""
        del tracks
        return -self.signatures["there"](1.0)[:, None]

    def step_of(self, guess, step):
        del guess
        return step

    def map(self, function, items):
        return [function(item) for item in items]


@pytest.fixture
def parts():
    generator = np.random.default_rng(0)
    return generator.normal(size=(3, ROWS * CHANNELS))


def test_a_straight_signature_is_rated_by_its_best_size(parts):
    noise, signature, other = parts
    evidence = MadeUp(noise + 0.7 * signature, {"true": lambda d: d * signature, "other": lambda d: d * other})
    best, _ = screen(evidence, Guess(), [candidate("other"), candidate("true")])
    assert best.hypothesis.name == "true"
    # 1200 readings with a signature of size 1: known to 0.03
    assert best.start == pytest.approx([0.7], abs=0.1)
    assert best.gain == pytest.approx(0.7**2 * 1200.0, rel=0.15)


def test_friction_that_sticks_on_one_side_only_is_rated_by_what_was_tried(parts):
    """To one side the errors fall like a root, to the other they jump somewhere else."""
    noise, signature, elsewhere = parts

    def funnel(d):
        return np.sqrt(min(-d, 1.0)) * signature if d < 0.0 else 3.0 * d * elsewhere

    evidence = MadeUp(noise + signature, {"true": funnel, "decoy": lambda d: d * (signature + 2.0 * elsewhere)})
    best, second = screen(evidence, Guess(), [candidate("decoy"), candidate("true")])
    assert (best.hypothesis.name, second.hypothesis.name) == ("true", "decoy")
    assert best.start[0] < 0.0
    assert best.gain > second.gain > 100.0


def test_what_is_there_may_follow_a_candidate(parts):
    """A candidate that looks like a named effect brings nothing on top of it."""
    noise, signature, other = parts
    there = candidate("there")
    evidence = MadeUp(noise, {"there": lambda d: d * signature, "twin": lambda d: d * (signature + 0.01 * other)})
    (twin,) = screen(evidence, Guess(((there, np.array([0.3])),)), [there, candidate("twin")])
    assert twin.gain < 5.0  # noise alone: chi-square of one degree


def test_a_candidate_at_its_bound_is_tried_to_the_other_side_only(parts):
    noise, signature, _ = parts
    seen = []

    def signature_of(d):
        seen.append(d)
        return d * signature

    evidence = MadeUp(noise + 0.4 * signature, {"true": signature_of})
    (only,) = screen(evidence, Guess(), [candidate("true", low=0.0)])
    assert only.start == pytest.approx([0.4], abs=0.1)
    assert min(seen) >= 0.0


CLOCK = np.linspace(0.0, 20.0, 1000, endpoint=False)
INSIDE = (CLOCK > 6.1) & (CLOCK < 11.4)


def test_a_window_is_seen_where_a_lack_is_there_for_a_while():
    rng, known = np.random.default_rng(3), np.ones(1000, bool)
    quiet = [(CLOCK, known, rng.normal(size=1000)) for _ in range(3)]
    busy = [(c, k, u * np.where(INSIDE, 5.0, 0.5)) for c, k, u in quiet]
    begin, end = busy_window(busy)
    assert (begin, end) == (pytest.approx(6.1, abs=0.26), pytest.approx(11.4, abs=0.26))
    assert busy_window(quiet) == ()
    tail = [(c, k, u + np.where((c >= end) & (c < end + 1.0), 2.0, 0.0)) for c, k, u in busy]
    longer = busy_window(tail)
    assert longer and longer[1] > end, "what fades after it belongs to it"
    assert busy_window(tail, 0.25) == (begin, end)
    assert busy_window([(CLOCK, known, np.zeros(1000))]) == ()
    late = [(c + 40.0, k, u) for c, k, u in busy]  # stretches of a long record
    assert busy_window(late) == pytest.approx((begin + 40.0, end + 40.0))


def test_a_pulse_is_looked_for_where_all_runs_lack_something():
    """In one run it is told as short and strong, in another with the wrong sign."""
    rng = np.random.default_rng(4)
    short = (CLOCK > 7.0) & (CLOCK < 8.0)
    told = [np.where(short, -60.0, np.where(INSIDE, -4.0, 0.0)), np.where(INSIDE, -25.0, 0.0),
            np.where(INSIDE, 20.0, 0.0)]  # fmt: skip
    track = SimpleNamespace(run=SimpleNamespace(period=0.02, start=0.0))
    pairs = [(track, u + rng.normal(size=1000)) for u in told]
    loud, common = _spans(pairs)
    assert loud[1] == pytest.approx(7.0, abs=0.3) and loud[2] == pytest.approx(1.0, abs=0.3)
    assert common[1] == pytest.approx(6.1, abs=0.3) and common[2] == pytest.approx(5.3, abs=0.5)


def test_a_rare_size_with_a_curved_signature_is_rated_where_it_shows(parts):
    """An inertia 9 times the model's, 40 typical deviations away; its slope at nominal says less.

    The far start costs 25^2 = 625 by a unit-normal prior, more than the evidence that there is.
    """
    noise, signature, _ = parts
    ratio = Parameter("1", 1.0, 0.05, 20.0, 0.2, 0.05, start_values=(1.0, 6.0))
    inertia = Hypothesis("inertia_error", "boom", {"ratio": ratio})

    def curved(d):
        return 0.5 * (1.0 - np.exp(-d / 10.0)) * signature

    evidence = MadeUp(noise + curved(40.0), {"inertia_error": curved})
    (found,) = screen(evidence, Guess(), [inertia])
    whole = float(np.sum(curved(40.0) ** 2))
    assert whole < 625.0
    assert 0.8 * whole < found.score < whole
    assert found.start[0] > 20.0
