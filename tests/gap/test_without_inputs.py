"""Effects that unknown inputs would hide stand out where none is let act."""

import dataclasses

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, calibration, hypotheses
from hydrotele.estimate.track import STEP
from hydrotele.gap.search import without_inputs
from hydrotele.machine.machine_file import load_machine
from tests.estimate.test_filter import machine_data

NAMES = ("payload", "com_offset", "external_force", "pressure_lag", "command_delay")


def early(truth):
    """Options for data of another machine, and the loss of the given one."""
    nominal = load_machine("cat215")
    data, _ = machine_data(nominal, truth)
    data = dataclasses.replace(data, fit=(data.heldout.select_rows(0, 300),))
    evidence = Evidence(data, data.fit, 2, STEP, lacking=True)
    try:
        base = evidence.set_base(Guess())
        return without_inputs(evidence, base, hypotheses(nominal, NAMES)).options
    finally:
        evidence.close()


def test_a_payload_heavier_than_the_stick_stands_out():
    found = early(apply_effect(load_machine("cat215"), "payload", "tool", {"mass": 990.0}))
    (judged, score), *_ = found
    ((hypothesis, deviation),) = judged.guess.parts
    assert hypothesis.key == ("payload", "tool")
    assert abs(hypothesis.values(deviation)["mass"] - 990.0) < 50.0  # one round of a fit
    assert score > 1000.0


@pytest.mark.nightly
def test_an_effect_stands_out_where_all_numbers_are_off():
    """Numbers half a stated deviation off, each way by turns, and the payload."""
    nominal = load_machine("cat215")
    group = calibration(nominal)
    signs = np.where(np.arange(group.size) % 2, 0.5, -0.5)
    wrong = group.change(nominal, group.values(signs))
    found = early(apply_effect(wrong, "payload", "tool", {"mass": 990.0}))
    best, _ = max(found, key=lambda option: option[1])
    assert [h.name for h in best.guess.hypotheses] == ["payload", CALIBRATION]
    hypothesis, deviation = best.guess.parts[0]
    assert abs(hypothesis.values(deviation)["mass"] - 990.0) < 50.0  # all masses may be off by 2 %


@pytest.mark.nightly
def test_nothing_is_tried_where_little_is_lacking():
    assert early(load_machine("cat215")) == ()
