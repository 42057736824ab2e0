"""Backlash is found by a direct search with the noise of the sensors alone."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.estimate.evidence import Evidence, Judged
from hydrotele.estimate.filter import Input
from hydrotele.estimate.hypothesis import Guess
from hydrotele.estimate.track import STEP
from hydrotele.gap import backlash
from hydrotele.gap.backlash import add_backlash, is_unexplained
from hydrotele.machine.machine_file import load_machine
from tests.estimate.test_filter import machine_data

GAP = 0.012  # rad


def search_swing(truth):
    """Return the given machine and the model with backlash of the swing, from readings of a machine."""
    data, _ = machine_data(load_machine("cat215"), truth, twist=0.5 * GAP)
    data = dataclasses.replace(data, fit=(data.heldout.select_rows(0, 300),))
    evidence = Evidence(data, data.fit, 2, STEP, lacking=True)
    try:
        base = evidence.set_base(Guess())
        return base, add_backlash(evidence, base.guess, "swing")
    finally:
        evidence.close()


@pytest.mark.nightly
def test_backlash_with_another_inertia_and_damping_than_those_of_the_library_is_found(monkeypatch):
    """With few evaluations; the size lies between two of the starts."""
    monkeypatch.setattr(backlash, "_EVALUATIONS", 15)
    machine = load_machine("cat215")
    usual = EFFECTS["backlash"].parameters(machine, "swing")["drive_inertia"].nominal
    values = {"gap": GAP, "drive_inertia": 0.6 * usual, "damping_ratio": 0.02}
    base, found = search_swing(apply_effect(machine, "backlash", "swing", values))
    assert found and found.loss < base.loss
    ((hypothesis, deviation),) = found.guess.parts
    assert hypothesis.key == ("backlash", "swing")
    assert hypothesis.values(deviation)["gap"] == pytest.approx(GAP, rel=0.1)


@pytest.mark.nightly
def test_no_backlash_brings_evidence_on_a_machine_without_it(monkeypatch):
    monkeypatch.setattr(backlash, "_EVALUATIONS", 15)
    base, found = search_swing(load_machine("cat215"))
    assert found is None or found.loss > base.loss


@pytest.mark.parametrize(("sizes", "axis", "unexplained"), [
    ([2.0, 0.5], "boom", True),
    ([0.0, 0.5], "boom", False),  # the residual input of the axis has the size 0
    ([2.0, 0.5], "swing", False),
])  # fmt: skip
def test_an_axis_is_unexplained_where_it_has_a_residual_input(sizes, axis, unexplained):
    levels = SimpleNamespace(inputs=[Input("force", "boom"), Input("command", "stick")], sizes=np.array(sizes))
    tracks: Any = (SimpleNamespace(levels=levels),)
    assert is_unexplained(Judged(Guess(), tracks, 0.0), axis) is unexplained
