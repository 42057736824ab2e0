"""Teeth that ring: found without slopes, where white noise on the rate would explain anything."""

import dataclasses

import pytest

import hydrotele.gap.screening as gap_rattling
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.machine.machine_file import load_machine
from tests.estimate.test_filter import machine_data

GAP = 0.012  # rad


def looked(truth):
    """What is found in readings of a machine by a search that knows the CAT 215."""
    machine = load_machine("cat215")
    data, _ = machine_data(machine, truth, twist=0.5 * GAP)
    data = dataclasses.replace(data, fit=(data.heldout.select_rows(0, 300),))
    evidence = Evidence(data, data.fit, 2, lacking=True)
    try:
        base = evidence.set_base(Guess())
        axes = gap_rattling.shaken(evidence, hypotheses(machine, ("backlash",)), (base,))
        return base, gap_rattling.rattling(evidence, base.guess, base, axes)
    finally:
        evidence.close()


@pytest.mark.nightly
def test_ringing_teeth_are_found_with_inertia_and_damping_unlike_the_librarys(monkeypatch):
    """With few steps: a gap between two of the grid is found in them."""
    monkeypatch.setattr(gap_rattling, "_EVALUATIONS", 15)
    machine = load_machine("cat215")
    usual = EFFECTS["backlash"].parameters(machine, "swing")["drive_inertia"].nominal
    teeth = {"gap": GAP, "drive_inertia": 0.6 * usual, "damping_ratio": 0.02}
    truth = apply_effect(machine, "backlash", "swing", teeth)
    base, found = looked(truth)
    assert found and found.loss < base.loss
    ((hypothesis, deviation),) = found.guess.parts
    assert hypothesis.key == ("backlash", "swing")
    assert hypothesis.values(deviation)["gap"] == pytest.approx(GAP, rel=0.1)


@pytest.mark.nightly
def test_a_machine_without_teeth_is_not_looked_at():
    _, found = looked(load_machine("cat215"))
    assert found is None
