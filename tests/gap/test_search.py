"""Rivals of a named effect: what seems better must settle better."""

from types import SimpleNamespace

import numpy as np
import pytest

from hydrotele.gap import search
from hydrotele.machine_file import load_machine
from hydrotele.prediction.evidence import Fit
from hydrotele.prediction.hypothesis import Guess, hypotheses


@pytest.fixture
def parts():
    return hypotheses(load_machine("cat215"), ("valve_deadband", "command_delay"))


def fit_of(hypothesis, gain):
    guess = Guess(((hypothesis, np.full(hypothesis.size, 50.0)),))
    return Fit(guess, 0.0, gain, 2.0, np.eye(hypothesis.size))


@pytest.mark.parametrize("settled, wins", [(5.0, True), (-7.0, False), (-np.inf, False)])
def test_a_rival_counts_by_what_it_settles_at(monkeypatch, parts, settled, wins):
    """With kept gains the rival seems better by 40; with its own it is so by `settled`."""
    own, rival = fit_of(parts[0], 100.0), fit_of(parts[1], 140.0)
    flattered = fit_of(parts[0], 170.0)  # what was beaten, seen from the winner
    bases = []
    evidence = SimpleNamespace(set_base=bases.append)
    monkeypatch.setattr(
        search, "compare", lambda *_: (rival, (flattered,)) if bases else (own, (rival,))
    )
    monkeypatch.setattr(
        search, "_settled_gain",
        lambda _, guess, other: (bases.append(other), (other, rival, settled))[1],
    )  # fmt: skip
    guess, _, first, others = search._weighed(evidence, own.guess, own, 0, ())
    assert (guess.parts[0][0] is parts[1]) == wins == (first is rival)
    assert others[0].score == first.score - abs(settled)
    if not wins:
        assert bases[-1] is own.guess  # the evidence stands as before
