"""The best answer so far: handed on when it is better, with what it changes."""

import time

import numpy as np

from hydrotele.estimate.evidence import Judged
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, calibration, hypotheses
from hydrotele.gap.interim import keep_better
from hydrotele.machine.machine_file import load_machine


def test_only_better_answers_are_handed_on():
    machine = load_machine("cat215")
    (payload,) = hypotheses(machine, ["payload"])
    group = calibration(machine)
    guess = Guess(((payload, np.array([0.5] * payload.size)), (group, np.zeros(group.size))))
    kept = []
    consider = keep_better(machine, kept.append, time.perf_counter())
    for guess_, loss in ((Guess(), 100.0), (guess, 40.0), (Guess(), 60.0), (guess, np.inf)):
        consider(Judged(guess_, (), loss))
    assert [answer.document["evidence_gain"] for answer in kept] == [0.0, 60.0]
    first, last = kept
    assert first.machine is machine and first.document["effects"] == []
    assert [effect["name"] for effect in last.document["effects"]] == ["payload"]
    assert last.machine.links["payload"].mass > 0.0
    assert set(last.document["calibration"]) == set(group.parameters) and group.name == CALIBRATION
